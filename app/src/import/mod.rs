//! Translates configs of the authors' programs, which are YAML.
//!
//! Each program has a module with tables of its keys and their translations. To translate a further key, add a
//! row. A key without a row is listed as unknown.
//!
//! | module | contents |
//! |---|---|
//! | [`yaml`] | YAML as a tree with lines |
//! | [`table`] | tables of keys, and the config that they make |
//! | [`influence`] | keys of influence shaping |
//! | [`leader_follower`] | keys of leader-follower |

use std::path::Path;

use serde::Serialize;

use crate::record::folder::{CONFIG, SWEEP};
use crate::shell;
use flotilla::config::{self, Config, ConfigError, Problem};
use flotilla::escape::{self, PathExt};
use table::Section;
use yaml::At;

mod influence;
mod leader_follower;
mod table;
mod yaml;

/// A translated config.
#[derive(Clone, Debug, Serialize)]
pub struct Imported {
    /// The config, with comments.
    pub text: String,
    /// The keys without an exact equivalent, each with its file, line and reason.
    pub skipped: Vec<String>,
}

/// Translates the root of a file to the sections of a config.
type Translate = fn(&At<'_>) -> Result<Vec<Section>, Problem>;

/// The programs: a key at the top of their configs, and what translates these.
const PROGRAMS: [(&str, &str, Translate); 3] = [
    ("env", "influence shaping", influence::translate),
    ("CCEA", "leader-follower", leader_follower::translate),
    ("leader_positions", "leader-follower, with positions only", positions),
];

/// Translates a config of positions only.
fn positions(root: &At<'_>) -> Result<Vec<Section>, Problem> {
    let mut world = Section::new("[world]");
    let rows = [
        ("leader_positions", table::To::Need("leaders")),
        ("follower_positions", table::To::Key("followers")),
        ("poi_positions", table::To::Need("pois")),
    ];
    world.fill(root, &rows)?;
    world.skip_unknown(root, &[&rows]);
    Ok(vec![world])
}

/// Translates a config of one of the authors' programs. `name` is the file in errors. The result is a valid config.
///
/// # Errors
/// The text is not YAML, has not the keys of a program, or has values that no config can have.
pub fn translate(text: &str, name: &str) -> Result<Imported, ConfigError> {
    let refused = |problems| ConfigError::Invalid { name: name.into(), problems, unlisted: 0 };
    let root = yaml::parse(text).map_err(|problem| refused(vec![problem]))?;
    let root = At::root(&root);
    let Some((_, program, translate)) = PROGRAMS.iter().find(|(key, ..)| root.get(key).is_some()) else {
        let keys = PROGRAMS.map(|(key, program, _)| format!("{key} ({program})")).join(", ");
        return Err(refused(vec![root.problem(format!(
            "found none of the keys {keys}; name a config.yaml of one of these programs, not a sweep of several"
        ))]));
    };
    let sections = translate(&root).map_err(|problem| refused(vec![problem]))?;
    let lines = sections.iter().flat_map(|section| &section.lines).filter(|line| line.text.is_empty());
    let mut lines: Vec<_> = lines.collect();
    lines.sort_by_key(|line| line.line);
    let skipped =
        lines.into_iter().map(|line| format!("{name}:{}: {}", line.line, escape::line(&line.comment))).collect();
    let heading = format!("# From {name} of the authors' program {program}, by `flotilla import`.\n");
    let (text, origins) = table::write(&heading, &sections);
    match Config::parse(&text, name) {
        Ok(_) => Ok(Imported { text, skipped }),
        Err(ConfigError::Invalid { mut problems, unlisted, .. }) => {
            // The problems name keys of the config. The user has the lines and keys of the YAML file.
            for problem in &mut problems {
                let origin = problem.line.and_then(|line| origins.get(line - 1)).filter(|(line, _)| *line > 0);
                problem.line = origin.map(|(line, _)| *line);
                problem.key += &origin.map_or(String::new(), |(_, path)| format!(", from {path}"));
            }
            Err(ConfigError::Invalid { name: name.into(), problems, unlisted })
        }
        Err(error) => Err(error),
    }
}

/// Reads the text of a config or sweep file as [`config::read_file`] does, and refuses YAML.
///
/// # Errors
/// The file cannot be read, or is YAML. For the folder of a run or a sweep, the error names its config.
pub fn read_file(path: &Path) -> Result<String, ConfigError> {
    if let Some(file) = [CONFIG, SWEEP].map(|name| path.join(name)).iter().find(|file| file.is_file()) {
        let reason = format!("it is a directory; name its config, {}", file.escaped());
        return Err(ConfigError::Unreadable { name: config::name(path), reason, is_missing: false });
    }
    let text = config::read_file(path)?;
    if text.parse::<toml::Table>().is_err() && is_yaml(&text, path) {
        let file = if config::is_standard_input(path) { path.into() } else { shell::argument(path) };
        let reason = format!(
            "it is YAML, and configs are TOML; `flotilla import {}` translates configs of the authors' programs",
            shell::quoted(file)
        );
        return Err(ConfigError::Unreadable { name: config::name(path), reason, is_missing: false });
    }
    Ok(text)
}

fn is_yaml(text: &str, path: &Path) -> bool {
    let has_extension = path.extension().is_some_and(|extension| extension == "yaml" || extension == "yml");
    // YAML with an error is YAML, too, and so is JSON.
    let is_known = |line: &str| {
        let after = |key: &str| line.trim_start_matches(['{', ' ', '"']).strip_prefix(key);
        PROGRAMS.iter().any(|(key, ..)| after(key).is_some_and(|rest| rest.trim_start_matches('"').starts_with(':')))
    };
    has_extension || text.lines().any(is_known)
}
