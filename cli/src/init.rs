//! `flotilla init`: writes a config to start from, with a comment about every key.

use std::path::PathBuf;

use clap::builder::{PossibleValue, PossibleValuesParser};
use toml::{Table, Value};

use super::layout::{SHAPES, StartLayout};
use super::{Error, print, whole, with_remedy};
use flotilla::config::{self, Config, Definition};
use flotilla::escape::PathExt;
use flotilla_app::ops::output;

/// The paper's layouts. Each has the name of the argument, the name of the config file, and the file's text.
const LAYOUTS: [([&str; 2], &str); 3] = [
    (["generally_forward", "generally-forward"], config::LAYOUTS[0].1),
    (["strictly_forward", "strictly-forward"], config::LAYOUTS[1].1),
    (["chaotic"; 2], config::LAYOUTS[2].1),
];
/// Maximum number of characters in a line.
const WIDTH: usize = 110;

#[derive(clap::Args)]
pub struct Args {
    /// Layout to start from: one of the paper's, or groups and POIs on a ring, in a row or in a grid
    #[arg(default_value = LAYOUTS[0].0[0], value_parser = layouts())]
    layout: String,
    /// Number of groups in a ring, row or grid, a leader with its followers each [default: 4]
    #[arg(long, value_name = "N", value_parser = whole)]
    groups: Option<usize>,
    /// Followers per group in a ring, row or grid [default: 3]
    #[arg(long, value_name = "N", value_parser = whole)]
    followers: Option<usize>,
    /// Number of POIs in a ring, row or grid [default: one per group]
    #[arg(long, value_name = "N", value_parser = whole)]
    pois: Option<usize>,
    /// Agents that a POI needs in a ring, row or grid [default: as many as a group has]
    #[arg(long, value_name = "N", value_parser = whole)]
    coupling: Option<usize>,
    /// New file to write [default: standard output]
    #[arg(long, short, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Overwrite the file
    #[arg(long, requires = "out")]
    force: bool,
}

/// Returns the parser of layout names. A paper's layout is also found by the name of its file.
fn layouts() -> PossibleValuesParser {
    let papers = LAYOUTS.map(|([name, file], _)| PossibleValue::new(name).alias(file));
    PossibleValuesParser::new(papers.into_iter().chain(SHAPES.map(|(name, _)| PossibleValue::new(name))))
}

pub fn run(args: Args) -> Result<(), Error> {
    let from = template(&args)?;
    let text = commented(&from, &Config::parse(&from, &args.layout)?);
    let Some(path) = args.out else { return print(&text) };
    output::check(&[("--out", Some(&path))], &[])?;
    match args.force {
        true => output::write(&path, text.as_bytes())?,
        false => output::write_new(&path, text.as_bytes())?,
    }
    print(&format!("{}\n", path.escaped()))
}

/// Returns the text of the config to start from: one of the paper's, or a layout with the requested groups and POIs.
fn template(args: &Args) -> Result<String, Error> {
    let Some((_, shape)) = SHAPES.into_iter().find(|(name, _)| *name == args.layout) else {
        let given = [
            ("--groups", args.groups),
            ("--followers", args.followers),
            ("--pois", args.pois),
            ("--coupling", args.coupling),
        ];
        if let Some((flag, _)) = given.into_iter().find(|(_, number)| number.is_some()) {
            let layout = &args.layout;
            return Err(Error::Usage(with_remedy(
                format!("{flag}: the layout {layout} is the paper's"),
                "use it with ring, row or grid",
            )));
        }
        let paper = LAYOUTS.into_iter().find(|(names, _)| names.contains(&&*args.layout));
        return Ok(paper.expect("no other is taken").1.into());
    };
    let (groups, followers) = (args.groups.unwrap_or(4), args.followers.unwrap_or(3));
    let coupling = args.coupling.unwrap_or(followers.saturating_add(1));
    let layout =
        StartLayout { shape, groups, followers, pois: args.pois.unwrap_or(groups.min(config::MAX_POIS)), coupling };
    match layout.problem() {
        Some(problem) => Err(Error::Usage(problem.into())),
        None => Ok(layout.text()?),
    }
}

/// Returns `config` as a config file, after the opening comment of the text `from`. Each key has a comment with its
/// meaning, unit, kind, range and default.
fn commented(from: &str, config: &Config) -> String {
    let values = Table::try_from(config).expect("a config that was read is TOML");
    let opening: String =
        from.lines().take_while(|line| line.starts_with('#')).map(|line| format!("{line}\n")).collect();
    let mut text = opening + "#\n# Every key follows, with its meaning and (unit; allowed values; default).\n";
    let mut section = "";
    for key in config::keys() {
        let (of, leaf) = key.name.split_once('.').expect("keys are dotted");
        if of != section {
            section = of;
            text += &format!("\n[{section}]\n");
        }
        text += &comment(&key);
        text += &format!("{leaf} = {}\n", written(&values[section][leaf]));
    }
    text + "\n# Classes of agents, [[agents]], and groups of POIs, [[pois]], can take the place of many of these keys:\n\
            # `flotilla check --expand FILE` prints this config with them.\n"
}

/// Returns a key's comment. Meaning and facts are on separate lines if they do not fit on one.
fn comment(Definition { unit, kind, range, default, meaning, .. }: &Definition) -> String {
    let unit = if unit.is_empty() { String::new() } else { format!("{unit}; ") };
    let default = default.as_ref().map_or("has to be given".into(), |default| format!("default {default}"));
    let facts = format!("({unit}{kind}, {range}; {default})");
    let one = format!("{meaning} {facts}");
    if one.chars().count() + 2 <= WIDTH { wrapped(&one) } else { wrapped(meaning) + &wrapped(&facts) }
}

fn wrapped(text: &str) -> String {
    let (mut lines, mut line) = (String::new(), String::from("#"));
    for word in text.split(' ') {
        if line.chars().count() + word.chars().count() > WIDTH {
            lines += &format!("{line}\n");
            line = "#".into();
        }
        line += &format!(" {word}");
    }
    lines + &line + "\n"
}

/// Returns a value as TOML. A list of more than four items is written in rows of four.
fn written(value: &Value) -> String {
    match value {
        Value::Array(items) if items.len() > 4 => {
            let rows = items.chunks(4).map(|row| {
                let row: Vec<_> = row.iter().map(Value::to_string).collect();
                format!("    {},\n", row.join(", "))
            });
            format!("[\n{}]", rows.collect::<String>())
        }
        value => value.to_string(),
    }
}
