//! Helpers for tests: small configs, a temporary directory in which commands run, and GPU adapters.
#![allow(dead_code, reason = "no test program uses all helpers")]

use std::io::Write;

use flotilla::config::{Config, Paradigm};
use flotilla::world::World;

/// A small config that trains in milliseconds.
pub const SMALL: &str = "
[world]
leaders = [[10, 5], [20, 5]]
followers = [[12, 2], [22, 2], [30, 2]]
pois = [[10, 9], [20, 9]]
coupling = 2
steps = 9
[policy]
hidden = [5]
[learning]
population = 8
generations = 6
trials = 3
";

/// A smaller config, for tests that train many times.
pub const TINY: &str = "\
[world]
leaders = [[10, 5], [20, 5]]
followers = [[12, 2], [22, 2]]
pois = [[10, 9], [20, 9]]
coupling = 2
steps = 8
[policy]
hidden = [3]
[learning]
population = 6
generations = 4
trials = 2
";

/// Returns [`TINY`] with the given number of generations, and with the given lines in a section `[checkpoint]`.
pub fn tiny(generations: usize, checkpoint: &str) -> String {
    format!("{}[checkpoint]\n{checkpoint}\n", TINY.replace("generations = 4", &format!("generations = {generations}")))
}

/// A valid config with two leaders, four followers and two POIs. Tests replace lines of it by their number.
pub const GOOD: &str = "\
[world]
map = [50, 40]
leaders = [[10, 5], [20, 5]]
followers = [[12, 2], [8, 2], [22, 2], [18, 2]]
pois = [[10, 15], [20, 15]]
coupling = 3
steps = 25
dt = 0.2
heading = 1.5
speed = 0
[motion]
min_speed = 0
max_speed = 3
[follow]
attraction_radius = 5
repulsion_radius = 1
[sense]
poi_range = inf
density = 'linear'
[policy]
hidden = [10]
[learning]
population = 50
";

/// Returns [`GOOD`] with one line replaced, numbered from 1.
pub fn with_line(number: usize, line: &str) -> String {
    GOOD.lines().enumerate().map(|(at, old)| if at + 1 == number { line } else { old }).collect::<Vec<_>>().join("\n")
}

/// Returns the rows of a table: one per line, with columns separated by ` => ` and line breaks written as `\n`. Lines
/// that start with `#` are comments.
///
/// Panics if a row has another number of columns, or if there are fewer than `least` rows.
pub fn table<const N: usize>(text: &str, least: usize) -> Vec<[String; N]> {
    let row = |line: &str| {
        let columns: Vec<String> = line.split(" => ").map(|column| column.replace("\\n", "\n")).collect();
        <[String; N]>::try_from(columns).unwrap_or_else(|_| panic!("not {N} columns: {line}"))
    };
    let rows: Vec<_> = text.lines().filter(|line| !line.starts_with('#')).map(row).collect();
    assert!(rows.len() >= least, "only {} rows", rows.len());
    rows
}

/// Loads a config of the directory `configs/` by its name.
pub fn layout(name: &str) -> Config {
    let path = format!("{}/configs/{name}.toml", crate::ROOT);
    Config::load(path.as_ref()).unwrap_or_else(|error| panic!("{error}"))
}

/// Returns the worlds of the paper's layouts in both paradigms, with their names.
pub fn papers_worlds() -> Vec<(String, World)> {
    let layouts = ["generally_forward", "strictly_forward", "chaotic"];
    let paradigms = [(Paradigm::LeaderFollower, ""), (Paradigm::AllLeaders, ", all leaders")];
    let pairs = layouts.into_iter().flat_map(|name| paradigms.map(|paradigm| (name, paradigm)));
    pairs
        .map(|(name, (paradigm, suffix))| {
            let mut config = layout(name);
            config.learning.paradigm = paradigm;
            (format!("{}{suffix}", name.replace('_', " ")), World::new(&config.validate().unwrap()))
        })
        .collect()
}

/// Whether tests run in their long forms, as in `.ci/nightly`.
pub fn is_long() -> bool {
    std::env::var("FLOTILLA_LONG").is_ok_and(|long| long == "1")
}

/// Prints that a test was skipped, and why.
///
/// Writes to the stream, because the output of `eprintln!` is not shown for a passing test.
pub fn skip(test: &str, reason: &str) {
    writeln!(std::io::stderr(), "\n{test}: skipped: {reason}").expect("standard error is writable");
}

/// Prints that a test was skipped because a program of this machine is missing.
///
/// With `FLOTILLA_REQUIRE_TOOLS=1`, as in `.ci/run`, panics instead.
pub fn skip_without(test: &str, reason: &str) {
    let required = std::env::var("FLOTILLA_REQUIRE_TOOLS").is_ok_and(|required| required == "1");
    assert!(!required, "{test}: {reason}, but it is required");
    skip(test, reason);
}
