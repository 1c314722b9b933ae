//! The configs of the golden digests, which `golden.txt` describes. `cases.txt` lists them.

use std::sync::LazyLock;

use flotilla::config::{Config, Override};

/// Returns the text of a config by its name. It is part of the program, because WebAssembly has no file system.
fn text(name: &str) -> &'static str {
    match name {
        "generally_forward" => include_str!("../../configs/generally_forward.toml"),
        "strictly_forward" => include_str!("../../configs/strictly_forward.toml"),
        "chaotic" => include_str!("../../configs/chaotic.toml"),
        "rovers_and_uavs" => include_str!("../../configs/influence/3_rovers_3_uavs.toml"),
        "forty_agents" => include_str!("forty_agents.toml"),
        "regions" => include_str!("regions.toml"),
        "pursuit" => include_str!("pursuit.toml"),
        "gone" => include_str!("gone.toml"),
        "swarm" => include_str!("swarm.toml"),
        _ => panic!("no config is named {name}"),
    }
}

/// Name, description, name of the config, and the keys that are changed, as in `cases.txt`.
pub type Case = (&'static str, &'static str, &'static str, &'static str);

pub static CASES: LazyLock<Vec<Case>> = LazyLock::new(|| {
    let case = |line: &'static str| {
        let columns: Vec<&str> = line.split(" | ").collect();
        let [name, base, changes, description] = columns[..] else { panic!("not four columns: {line}") };
        (name, description, base, changes)
    };
    include_str!("cases.txt").lines().filter(|line| !line.starts_with('#')).map(case).collect()
});

pub static CONFIGS: LazyLock<Vec<Config>> = LazyLock::new(|| {
    let small = "learning.trials = 2; learning.generations = 8; learning.population = 20";
    CASES.iter().map(|&(_, _, base, changes)| config(base, &[small, changes])).collect()
});

/// Returns a config by its name, with changed keys as in `cases.txt`. Later changes replace earlier ones.
pub fn config(base: &str, changes: &[&str]) -> Config {
    let parsed = Config::parse(text(base), base).unwrap_or_else(|error| panic!("{error}"));
    changes.iter().fold(parsed, |config, changes| {
        let change = |change: &str| {
            let (key, text) = change.split_once(" = ").unwrap_or_else(|| panic!("not a key and a value: {change}"));
            Override::of_text(key, text, key)
        };
        let changed: Vec<Override> = changes.split("; ").filter(|change| !change.is_empty()).map(change).collect();
        config.with(&changed).unwrap_or_else(|error| panic!("{base}, {changes}: {error}"))
    })
}
