//! `docs/reference/config.md` says what the table of keys says. `FLOTILLA_WRITE=1` writes the page anew.

use std::fmt::Write;

use flotilla::config::{self, Config, Coupling, Definition, Override};

const PAGE: &str = "docs/reference/config.md";
const OPENING: &str = "\
# Config keys

For users who write configs: every key, its unit, range, default and meaning.

A config is a TOML file with the sections below. `world.leaders` and `world.pois` are required; every other key has the default shown
here. `flotilla check CONFIG` prints all values and reports every error at once, with its line. Lengths are in map units, times in seconds,
angles in radians.

[The model](../explain/model.md) has the equations. The last column is the section and equation of the paper, *Structural Credit
Assignment for Multiagent Leader-Based Learning*. It is empty if the paper does not mention the key. The paper gives numbers for hardly any
key; [choices](../explain/choices.md) explains how the others were chosen.

This page is made from the program's table of keys by `FLOTILLA_WRITE=1 cargo test --test reference`.
";

const CLOSING: &str = "
## `[[stages]]`

Any number of stages, in order of `from`. Each starts from the file's own keys and changes some of them
([curricula](../explain/model.md#learning-section-43-algorithm-1)).

| key | unit | type | range | default | meaning | paper |
|---|---|---|---|---|---|---|
| `from` | generations | whole number | 0 to learning.generations, more than that of the stage before | none: it has to be given | the first generation of the stage; it lasts until that of the next | 2.1 |
| `set` |  | table of keys | any of the keys above but `policy.*`, `checkpoint.*`, `learning.paradigm`, `sharing`, `population`, `elites`, `parents`, `method`, `search_sigma`, `generations`, `trials` and `seed`; as many leaders learn | `{}` | the keys that differ from the file, `{ \"world.coupling\" = 1 }` | 2.1 |
";

/// A cell of a Markdown table.
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
    page + CLOSING
}

fn section(key: &Definition) -> &str {
    key.name.split_once('.').expect("keys are dotted").0
}

#[test]
fn the_page_says_what_the_table_of_keys_says() {
    let page = page();
    if std::env::var("FLOTILLA_WRITE").as_deref() == Ok("1") {
        std::fs::write(PAGE, &page).unwrap();
    }
    let there = std::fs::read_to_string(PAGE).unwrap();
    let differs = there.lines().zip(page.lines()).find(|(there, page)| there != page);
    assert!(there == page, "{PAGE} is out of date ({differs:?}); FLOTILLA_WRITE=1 cargo test --test reference");
}

#[test]
fn every_key_is_told_of_once_and_in_the_order_of_a_config() {
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
        // A default written out is the default.
        if let Some(default) = &key.default {
            let set = Override { key: key.name.into(), text: default.clone(), name: key.name.into() };
            assert_eq!(config.with(&[set]).as_ref(), Ok(&config), "{}", key.name);
        }
    }
    assert_eq!(config.world.coupling, Coupling::Same(3));
}

/// The ranges are those that a config is held to: their ends are taken, and what is beyond is refused.
#[test]
fn ranges_are_those_that_configs_are_held_to() {
    // Keys left out give way to the one that is set.
    let smallest = "[world]\nleaders = [[1, 2]]\npois = [[3, 4]]\n";
    let holds = |key: &Definition, text: String| {
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
        assert_eq!(holds(key, "0".into()), zero, "{key:?}");
        assert_eq!(holds(key, "inf".into()), key.range.contains("inf"), "{key:?}");
        if key.kind == "number" {
            assert!(holds(key, format!("{low:e}")) && holds(key, format!("{high:e}")), "{key:?}");
            assert!(!holds(key, format!("{:e}", low - low.abs() * 1e-6 - 1e-12)), "{key:?}");
            assert!(!holds(key, format!("{:e}", high * (1.0 + 1e-6))), "{key:?}");
        }
    }
    assert!(checked >= 20, "{checked}");
}
