//! Tests the keys of `[learning]` that form and test teams through the program: files, extension, pictures and tables.

use serde_json::Value;

use crate::support::{Place, metrics_without_seconds};

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

#[test]
fn the_tested_team_is_in_files_pictures_and_tables() {
    let plain = TESTED.replace("test_episodes = 3\n", "");
    let sweep = format!("{TESTED}[grid]\n'learning.test_episodes' = [0, 2]\n");
    let tested = format!("{TESTED}[grid]\n'learning.temperature' = [0.1, 2.0]\n");
    let place =
        Place::new(&[("x.toml", TESTED), ("plain.toml", &plain), ("sweep.toml", &sweep), ("tested.toml", &tested)]);
    let trained = place.json("train x.toml --out run --quiet --json --backend cpu");
    let metrics = |run: &str| metrics_without_seconds(&place.path(run));
    let rows = metrics("run");
    assert_eq!(rows[0], ["trial", "generation", "best_g", "mean_g", "champion_g", "test_g"]);
    let last = rows[rows.len() - 2..].iter().map(|row| row[5].parse::<f64>().unwrap());
    let mean = last.sum::<f64>() / 2.0;
    assert_eq!(trained["last"]["test_g"]["mean"].as_f64(), Some(mean));
    assert!(mean > 0.0, "no tested team observed anything, so this tests little");
    let (report, _) = place.good("train x.toml --out again --backend cpu");
    assert!(report.lines().any(|line| line.ends_with("tested best team")), "{report}");

    // Test episodes change nothing else.
    place.good("train plain.toml --out plain --quiet --backend cpu");
    assert!(metrics("plain").iter().eq(rows.iter().map(|row| &row[..5])));

    // A shorter run, extended, is the same run.
    place.good("train x.toml --generations 3 --out short --quiet --backend cpu");
    let error = place.refused(1, "train x.toml --generations 2 --out short --resume --backend cpu");
    assert!(error.contains("short is a run of 3 generations, which cannot become one of 2"), "{error}");
    let (extended, stderr) = place.good("train x.toml --out short --resume --json --backend cpu");
    assert!(stderr.contains("resuming at generation 4"), "{stderr}");
    let extended: Value = serde_json::from_str(&extended).unwrap();
    assert_eq!((metrics("short"), &extended["digest"]), (rows, &trained["digest"]));
    // Generations from before and after the extension can be replayed.
    place.good("replay short --trial 1 --generation 3 --backend cpu");
    place.good("replay short --trial 1 --generation 5 --backend cpu");

    let episodes = place.json("replay run --team best --generation 4 --json --backend cpu");
    assert_eq!(episodes["episodes"][0]["which"], "best", "{episodes}");

    place.good("plot run --measure test --out test.svg");
    assert!(place.read("test.svg").contains("G of the tested best team"));
    assert!(place.read("run/curves.svg").contains("aria-label=\"tested best team\""));
    let curves = place.read("plain/curves.svg");
    assert!(curves.contains("champion") && !curves.contains("tested"));
    let error = place.refused(1, "plot run plain --measure test --out none.svg");
    assert!(error.contains("plain: it has no tested best team, because learning.test_episodes is 0"), "{error}");
    assert!(error.contains("--set learning.test_episodes=") && !error.contains("--resume"), "{error}");
    let measures = |words: &str| {
        let compared = place.json(words);
        let measures = compared["comparisons"][0]["measures"].as_array().unwrap();
        measures.iter().map(|measured| measured["measure"].as_str().unwrap().to_string()).collect::<Vec<_>>()
    };
    assert_eq!(measures("compare run again --json"), ["champion_g", "test_g", "best_g", "generations_to_reach"]);
    assert_eq!(measures("compare run plain --json"), ["champion_g", "best_g", "generations_to_reach"]);

    let swept = place.json("sweep sweep.toml --out swept --quiet --json --backend cpu");
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
    let measured = place.json("sweep tested.toml --out measured --measure test --quiet --json --backend cpu");
    assert_eq!([&swept["measure"], &measured["measure"]], ["champion", "test"]);
    // The folder of a run is no config, but has one.
    for (line, config) in [("train run", "run/config.toml"), ("sweep measured --collect", "measured/sweep.toml")] {
        let error = place.refused(1, line);
        assert!(error.contains(&format!("it is a directory; name its config, {config}")), "{error}");
    }
}

/// Rovers and POIs that are drawn from regions.
const REGIONS: &str = "
[world]
steps = 30
dt = 1.0
[[agents]]
name = 'rover'
count = 3
in = { disc = [25, 25, 4] }
motion = { kind = 'free', max_speed = 1.0 }
senses = [{ of = 'pois', measure = 'closeness', range = 50 }, { of = 'agents' }]
[[agents]]
name = 'beacon'
at = [[25, 30]]
control = 'still'
[[pois]]
name = 'ring'
count = 2
in = { circle = [25, 25, 10] }
coupling = 1
[[pois]]
name = 'field'
count = 1
in = { box = [20, 30, 30, 40] }
coupling = 1
[learning]
population = 8
generations = 3
trials = 2
test_episodes = 4
";

#[test]
fn every_command_takes_starts_and_pois_in_regions() {
    let place = Place::new(&[("x.toml", REGIONS)]);
    let (checked, warnings) = place.good("check x.toml --out layout.svg");
    assert!(checked.contains("of which 3 learn") && !warnings.contains("cannot be reached"), "{checked} {warnings}");
    let layout = place.read("layout.svg");
    assert!(layout.contains("long dashes: regions from which agents of rover, POIs of ring"));
    assert_eq!(layout.matches("stroke-dasharray=\"18 10").count(), 3);
    let full = place.prints("check x.toml --expand", &["in = { circle = [25.0, 25.0, 10.0] }"]);
    place.write("full.toml", &full);

    let trained = place.json("train x.toml --out run --quiet --json --backend cpu");
    assert_eq!(trained["digest"], place.json("train full.toml --out full --quiet --json --backend cpu")["digest"]);
    place.good("train x.toml --generations 1 --out short --quiet --backend cpu");
    let extended = place.json("train x.toml --out short --resume --quiet --json --backend cpu");
    assert_eq!(trained["digest"], extended["digest"]);

    let once = place.json("rollout run --json --backend cpu");
    assert_eq!((&once["episodes"], &once["seed"]), (&1.into(), &0.into()));
    let [first, again, other] = [0, 0, 1].map(|seed| {
        let played = place.json(&format!("rollout run --episodes 40 --seed {seed} --json --backend cpu"));
        played["mean"]["mean"].as_f64().unwrap()
    });
    assert!(first == again && first != other, "{first} {again} {other}");

    place.good("replay run --generation 2 --out page.html --backend cpu");
    place.good("replay run --team best --out still.svg --backend cpu");
    let error = place.refused(2, "replay run --generation 1 --compare 2 --out both.html --backend cpu");
    assert!(error.contains("POIs are elsewhere in every generation (pois.in): show one alone"), "{error}");
    let baseline = place.json("baseline x.toml --seeds 2 --episodes 5 --json --backend cpu");
    assert!(baseline["episodes"] == 5 && baseline["constant"]["interval_95"].is_array(), "{baseline}");
    place.good("bench x.toml --rollout-only --teams 4 --json --backend cpu");
    let error = place.refused(1, "check x.toml --set world.map=[30,30]");
    assert!(error.contains("pois[0].in.circle: found a circle from (15, 15) to (35, 35)"), "{error}");
}
