//! Tests that `docs/reference/config.md` agrees with the table of keys. `FLOTILLA_WRITE=1` writes the page again.

use std::fmt::Write;

use flotilla::config::{self, Config, Coupling, Definition, Override};

const PAGE: &str = "docs/reference/config.md";
const OPENING: &str = "\
# Config keys

For users who write configs: every key, its unit, range, default and meaning.

A config is a TOML file with the sections below. `world.leaders` and `world.pois` are required; every other key has the default shown
here. [Classes of agents](#agents) and [groups of POIs](#pois) can take the place of some of these keys. `flotilla check CONFIG` prints all
values and reports every error at once, with its line. Lengths are in map units, times in seconds, angles in radians.

[The model](../explain/model.md) has the equations. The last column is the section and equation of the paper, *Structural Credit
Assignment for Multiagent Leader-Based Learning*. It is empty if the paper does not mention the key. The paper gives numbers for hardly any
key; [choices](../explain/choices.md) explains how the others were chosen.

This page is made from the program's table of keys by `FLOTILLA_WRITE=1 cargo test reference::`.
";

/// The heading and the text above the table of each list or table.
const TABLES: [(&str, &str); 7] = [
    (
        "agents",
        "\
## `[[agents]]`

Classes of agents, in the place of `world.leaders`, `followers`, `heading`, `speed` and `observers`, `[motion]`, `[follow]`, `[sense]` and
`learning.paradigm`. A config that has them cannot have these keys. `flotilla check --expand CONFIG` prints a config with them. There are
up to 8 classes.
",
    ),
    (
        "agents.in",
        "\
### `in`

The region in which the `count` agents of a class start: `in = { disc = [25.0, 25.0, 5.0] }`. It has one of these keys.
",
    ),
    (
        "agents.motion",
        "\
### `motion`

`motion = { kind = \"free\", max_speed = 1.0 }`. A free agent has `max_speed` only.
",
    ),
    (
        "agents.senses",
        "\
### `senses`

A list of channels: `senses = [{ of = \"pois\", range = 10.0 }, { of = \"agents\" }]`. An agent never senses itself. In all channels of a
class there are up to 64 sectors. Policies of classes with fewer than others have zeros as their last inputs.
",
    ),
    (
        "agents.rule",
        "\
### `rule`

A list of terms: `rule = [{ of = \"agents\", to = 5.0, gain = -1.0 }]`. The force on an agent is the sum of its terms and of the push of
the walls. The agent turns towards it, with the force's size as its wanted speed.
",
    ),
    (
        "pois",
        "\
## `[[pois]]`

Groups of POIs, in the place of `world.pois`, `coupling`, `observation_radius`, `observers`, `windows` and `after`. A config that has them
cannot have these keys.
",
    ),
    (
        "pois.in",
        "\
### `in` of POIs

The region of the `count` POIs of a group, with one of these keys.
",
    ),
];

const CLOSING: &str = "
## `[[stages]]`

Up to 256 stages, in order of `from`. Each starts from the file's own values and changes some of them. Defaults that depend on other
keys stay as in the file ([curricula](../explain/model.md#learning-section-43-algorithm-1)).

| key | unit | type | range | default | meaning | paper |
|---|---|---|---|---|---|---|
| `from` | generations | whole number | 0 to 1000000, more than that of the stage before | none: it has to be given | the first generation of the stage; it lasts until that of the next | 2.1 |
| `set` |  | table of keys | any of the keys of sections, of classes as `agents.NAME.speed`, and of groups of POIs as `pois.NAME.coupling`, but `policy.*`, `checkpoint.*`, `learning.paradigm`, `sharing`, `groups`, `population`, `hall_of_fame`, `elites`, `team_elites`, `team_g_elites`, `parents`, `method`, `search_sigma`, `generations`, `trials`, `initial`, `initial_scale`, `test_episodes` and `seed`; the classes that learn have the same sizes, inputs and outputs | `{}` | the keys that differ from the file, `{ \"world.coupling\" = 1 }`; a key in quotes can have a whole table | 2.1 |
";

/// Returns text as a cell of a Markdown table.
fn cell(text: &str) -> String {
    text.replace('|', "\\|")
}

fn page() -> String {
    let mut page = OPENING.to_string();
    for keys in config::keys().chunk_by(|a, b| section(a) == section(b)) {
        let _ = write!(page, "\n## `[{}]`\n\n", section(&keys[0]));
        page += "| key | unit | type | range | default | meaning | paper |\n|---|---|---|---|---|---|---|\n";
        for key in keys {
            let Definition { name, unit, kind, range, default, meaning, paper } = key;
            let leaf = name.split_once('.').map_or(*name, |(_, leaf)| leaf);
            let default = default.as_ref().map_or("none: it has to be given".into(), |default| format!("`{default}`"));
            let cells = [&format!("`{leaf}`"), *unit, kind, range, &default, meaning, paper].map(cell);
            let _ = writeln!(page, "| {} |", cells.join(" | "));
        }
    }
    let tables = config::table_keys();
    assert_eq!(tables.iter().map(|(name, _)| *name).collect::<Vec<_>>(), TABLES.map(|(name, _)| name));
    for ((_, keys), (_, opening)) in tables.iter().zip(TABLES) {
        let _ =
            write!(page, "\n{opening}\n| key | unit | type | range | default | meaning |\n|---|---|---|---|---|---|\n");
        for Definition { name, unit, kind, range, default, meaning, .. } in keys {
            let leaf = name.rsplit('.').next().unwrap_or_default();
            let is_value = |text: &&String| format!("x = {text}").parse::<toml::Table>().is_ok();
            let default = match default {
                None => "none: it has to be given".into(),
                Some(default) => {
                    Some(default).filter(is_value).map_or(default.clone(), |default| format!("`{default}`"))
                }
            };
            let cells = [&format!("`{leaf}`"), *unit, kind, range, &default, meaning].map(cell);
            let _ = writeln!(page, "| {} |", cells.join(" | "));
        }
    }
    page + CLOSING
}

fn section(key: &Definition) -> &str {
    key.name.split_once('.').expect("keys are dotted").0
}

#[test]
fn the_page_agrees_with_the_table_of_keys() {
    let page = page();
    let path = crate::support::root(PAGE);
    if std::env::var("FLOTILLA_WRITE").as_deref() == Ok("1") {
        std::fs::write(&path, &page).unwrap();
    }
    let written = std::fs::read_to_string(&path).unwrap();
    let difference = written.lines().zip(page.lines()).find(|(written, page)| written != page);
    assert!(written == page, "{PAGE} is out of date ({difference:?}); FLOTILLA_WRITE=1 cargo test reference::");
}

#[test]
fn keys_are_in_the_order_of_a_config_with_correct_defaults() {
    let keys = config::keys();
    let smallest = "[world]\nleaders = [[1, 2], [3, 4], [5, 6]]\npois = [[3, 4]]\n";
    let config = Config::parse(smallest, "smallest").unwrap();
    let mut names = Vec::new();
    let mut section = String::new();
    for line in config.to_toml().lines().filter(|line| !line.is_empty()) {
        match line.split_once(" = ") {
            Some((leaf, _)) => names.push(format!("{section}.{leaf}")),
            None => section = line.trim_matches(['[', ']']).into(),
        }
    }
    assert_eq!(names, keys.iter().map(|key| key.name).collect::<Vec<_>>());
    for key in &keys {
        assert!(!key.meaning.is_empty() && !key.meaning.ends_with('.') && !key.range.is_empty(), "{key:?}");
        // Setting a key to its documented default must change nothing.
        if let Some(default) = &key.default {
            let set = Override { key: key.name.into(), text: default.clone(), name: key.name.into() };
            assert_eq!(config.with(&[set]).as_ref(), Ok(&config), "{}", key.name);
        }
    }
    assert_eq!(config.world.coupling, Coupling::Same(3));
}

/// The ends of each documented range must be valid, and values beyond them invalid.
#[test]
fn documented_ranges_equal_those_of_validation() {
    // Only the tested key is set.
    let smallest = "[world]\nleaders = [[1, 2]]\npois = [[3, 4]]\n";
    let is_valid = |key: &Definition, text: String| {
        let set = Override { key: key.name.into(), text, name: key.name.into() };
        Config::read(smallest, "smallest", &[], &[set]).is_ok()
    };
    let mut checked = 0;
    for key in config::keys().iter().filter(|key| key.kind.ends_with("number")) {
        let bounds = key.range.trim_end_matches(" or inf (unlimited)").trim_start_matches("0 or ").split_once(" to ");
        let Some((Ok(low), Ok(high))) = bounds.map(|(low, high)| (low.parse::<f64>(), high.parse::<f64>())) else {
            continue;
        };
        checked += 1;
        let zero = key.range.starts_with("0 ") || (low < 0.0 && 0.0 < high);
        assert_eq!(is_valid(key, "0".into()), zero, "{key:?}");
        assert_eq!(is_valid(key, "inf".into()), key.range.contains("inf"), "{key:?}");
        if key.kind == "number" {
            assert!(is_valid(key, format!("{low:e}")) && is_valid(key, format!("{high:e}")), "{key:?}");
            assert!(!is_valid(key, format!("{:e}", low - low.abs() * 1e-6 - 1e-12)), "{key:?}");
            assert!(!is_valid(key, format!("{:e}", high * (1.0 + 1e-6))), "{key:?}");
        }
    }
    assert!(checked >= 20, "{checked}");
}
