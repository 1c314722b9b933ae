//! Tests the keys of `[learning]` that form and test teams through the program: files, extension, pictures and tables.

use std::fs;

use serde_json::Value;

use crate::support::Place;

/// Two groups whose starts vary. Teams are formed by fitness, the best plays again, and is tested.
const TESTED: &str = "
[world]
map = [30.0, 20.0]
leaders = [[8.0, 5.0], [20.0, 5.0]]
followers = [[9.0, 3.0], [7.0, 3.0], [21.0, 3.0], [19.0, 3.0]]
pois = [[8.0, 10.0], [20.0, 10.0]]
coupling = 2
steps = 20
[learning]
population = 10
generations = 6
trials = 2
start_jitter = 1.0
test_episodes = 3
teams = 'softmax'
temperature = 0.5
team_elites = 1
team_g_elites = 2
";

/// Returns the rows of a run without their seconds.
fn metrics(place: &Place, run: &str) -> Vec<String> {
    let text = fs::read_to_string(place.path(run).join("metrics.csv")).unwrap();
    text.lines().map(|line| line.rsplit_once(',').unwrap().0.to_string()).collect()
}

fn json(place: &Place, words: &str) -> Value {
    serde_json::from_str(&place.good(words).0).unwrap()
}

#[test]
fn the_tested_team_is_in_files_pictures_and_tables() {
    let plain = TESTED.replace("test_episodes = 3\n", "");
    let sweep = format!("{TESTED}[grid]\n'learning.test_episodes' = [0, 2]\n");
    let tested = format!("{TESTED}[grid]\n'learning.temperature' = [0.1, 2.0]\n");
    let place =
        Place::new(&[("x.toml", TESTED), ("plain.toml", &plain), ("sweep.toml", &sweep), ("tested.toml", &tested)]);
    let trained = json(&place, "train x.toml --out run --quiet --json --backend cpu");
    let rows = metrics(&place, "run");
    assert_eq!(rows[0], "trial,generation,best_g,mean_g,champion_g,test_g");
    let last = rows[rows.len() - 2..].iter().map(|row| row.rsplit_once(',').unwrap().1.parse::<f64>().unwrap());
    let mean = last.sum::<f64>() / 2.0;
    assert_eq!(trained["last"]["test_g"]["mean"].as_f64(), Some(mean));
    assert!(mean > 0.0, "no tested team observed anything, so this tests little");
    let (report, _) = place.good("train x.toml --out again --backend cpu");
    assert!(report.lines().any(|line| line.ends_with("tested best team")), "{report}");

    // Test episodes change nothing else.
    place.good("train plain.toml --out plain --quiet --backend cpu");
    let untested = rows.iter().map(|row| row.rsplit_once(',').unwrap().0);
    assert!(metrics(&place, "plain").iter().map(String::as_str).eq(untested));

    // A shorter run, extended, is the same run.
    place.good("train x.toml --generations 3 --out short --quiet --backend cpu");
    let extended = json(&place, "train x.toml --out short --resume --quiet --json --backend cpu");
    assert_eq!((metrics(&place, "short"), &extended["digest"]), (rows, &trained["digest"]));

    let episodes = json(&place, "replay run --team best --generation 4 --json --backend cpu");
    assert_eq!(episodes["episodes"][0]["which"], "best", "{episodes}");

    place.good("plot run --measure test --out test.svg");
    assert!(fs::read_to_string(place.path("test.svg")).unwrap().contains("G of the tested best team"));
    assert!(fs::read_to_string(place.path("run/curves.svg")).unwrap().contains("aria-label=\"tested best team\""));
    assert!(!fs::read_to_string(place.path("plain/curves.svg")).unwrap().contains("tested"));
    let error = place.refused(1, "plot run plain --measure test --out none.svg");
    assert!(error.contains("plain: it has no tested best team, because learning.test_episodes is 0"), "{error}");
    let measures = |words: &str| {
        let compared = json(&place, words);
        let measures = compared["comparisons"][0]["measures"].as_array().unwrap();
        measures.iter().map(|measured| measured["measure"].as_str().unwrap().to_string()).collect::<Vec<_>>()
    };
    assert_eq!(measures("compare run again --json"), ["champion_g", "test_g", "best_g", "generations_to_reach"]);
    assert_eq!(measures("compare run plain --json"), ["champion_g", "best_g", "generations_to_reach"]);

    let swept = json(&place, "sweep sweep.toml --out swept --quiet --json --backend cpu");
    let [without, with] = [0, 1].map(|point| &swept["points"][point]);
    assert!(without["test_g"].is_null() && with["test_g"].is_f64(), "{swept}");
    for (name, column) in [("results.csv", 7), ("points.csv", 11)] {
        let mut table = csv::Reader::from_path(place.path("swept").join(name)).unwrap();
        assert_eq!(table.headers().unwrap().iter().nth(column), Some("test_g"), "{name}");
        let records: Vec<csv::StringRecord> = table.records().map(Result::unwrap).collect();
        let is_known = |record: &csv::StringRecord| !record[column].is_empty();
        assert!(!is_known(&records[0]) && is_known(records.last().unwrap()), "{name}");
    }
    let error = place.refused(2, "sweep sweep.toml --out other --measure test --backend cpu");
    assert!(error.contains("--measure test: point 0000: it has no tested best team"), "{error}");
    place.good("sweep tested.toml --out measured --measure test --quiet --backend cpu");
}
