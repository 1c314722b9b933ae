//! Tests `flotilla compare` on runs with known metrics, and on small sweeps.

use std::fmt::Write;
use std::fs;

use crate::support::Place;
use flotilla::config::{Config, Override};
use flotilla::statistics;
use flotilla_app::record::metrics::HEADER;
use serde_json::Value;

const WORLD: &str = "[world]\nleaders = [[10, 5], [20, 5]]\nfollowers = [[12, 2]]\npois = [[10, 15], [20, 15]]\n";

/// Writes a run with the champion's G per trial and generation. The best team's G is halfway from there to 1.
fn run(place: &Place, name: &str, keys: &[(&str, &str)], trials: &[&[f64]]) {
    let set = |(key, value): &(&str, &str)| Override { key: (*key).into(), text: (*value).into(), name: (*key).into() };
    let count = trials.len().to_string();
    let overrides: Vec<Override> = [("learning.trials", &*count)].iter().chain(keys).map(set).collect();
    let config = Config::read(WORLD, name, &[], &overrides).unwrap();
    let path = place.path(name);
    fs::create_dir_all(&path).unwrap();
    fs::write(path.join("config.toml"), config.to_toml()).unwrap();
    let mut metrics = format!("{HEADER}\n");
    for generation in 0..trials.iter().map(|trial| trial.len()).max().unwrap() {
        for (number, trial) in trials.iter().enumerate().filter(|(_, trial)| trial.len() > generation) {
            let champion = trial[generation];
            let _ = writeln!(metrics, "{number},{generation},{},0,{champion},0.5", (champion + 1.0) / 2.0);
        }
    }
    fs::write(path.join("metrics.csv"), metrics).unwrap();
}

fn json(place: &Place, line: &str) -> Value {
    place.json(&format!("{line} --json"))
}

/// Runs a command that must fail with this code. Its error must contain these words.
fn assert_fails(place: &Place, line: &str, code: i32, words: &[&str]) {
    let stderr = place.fails(code, line, words);
    let error = stderr.lines().position(|line| line.starts_with("error: ")).expect("no line starts with `error: `");
    // Only notes may come before the error.
    assert!(stderr.lines().take(error).all(|line| line.starts_with("note: ")), "{line}: {stderr}");
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is not a number"))
}

const GENERATIONS: (&str, &str) = ("learning.generations", "1");
const FITNESS_G: (&str, &str) = ("learning.fitness", "'G'");
const SEED_1: (&str, &str) = ("learning.seed", "1");

/// Returns trials whose G rises from 0 to these values.
fn rising_to(ends: &[f64]) -> Vec<[f64; 2]> {
    ends.iter().map(|&end| [0.0, end]).collect()
}

fn slices(trials: &[[f64; 2]]) -> Vec<&[f64]> {
    trials.iter().map(|trial| &trial[..]).collect()
}

#[test]
fn two_arms_are_reported_with_intervals_and_a_test() {
    let place = Place::new(&[]);
    let (df_ends, g_ends) = ([1.0, 1.0, 0.75, 1.0, 1.0], [0.5, 0.75, 0.5, 0.5, 0.25]);
    run(&place, "df", &[GENERATIONS], &slices(&rising_to(&df_ends)));
    run(&place, "g", &[GENERATIONS, FITNESS_G, SEED_1], &slices(&rising_to(&g_ends)));
    let (text, stderr) = place.good("compare df g");
    assert_eq!(stderr, "");
    for words in [
        "| arm                | trials | champion's G, generation 1 | best team's G, generation 1 | generations to G 0.75",
        "| fitness Df, seed 0 | 5      | 0.950 [0.",
        "| fitness G, seed 1  | 5      | 0.500 [",
        "| 1 (5 of 5)",
        "| not reached (1 of 5)",
        "| champion's G, generation 1  | fitness Df, seed 0 − fitness G, seed 1 | +0.450 [",
        "| 0.98 | 0.016 | 0.016    |",
        "| –                      | 0.10",
        "A median is not reached if half of the trials or more never reach G 0.75.",
    ] {
        assert!(text.contains(words), "{words:?} is missing from\n{text}");
    }
    let report = json(&place, "compare df g");
    let comparison = &report["comparisons"][0];
    assert_eq!((&report["test"], &comparison["generation"]), (&"mann-whitney".into(), &1.into()));
    let [champion, best, reach] = [0, 1, 2].map(|measure| &comparison["measures"][measure]);
    assert_eq!((&champion["measure"], &champion["generation"]), (&"champion_g".into(), &1.into()));
    // The expected values are scipy's for the first case in tests/statistics.json.
    let pair = &champion["pairs"][0];
    assert!((number(&pair["a"]) - 0.98).abs() < 1e-12 && (number(&pair["p"]) - 4.0 / 252.0).abs() < 1e-12, "{pair}");
    let difference = statistics::difference(&df_ends.iter().collect(), &g_ends.iter().collect(), [0.0, 1.0]).unwrap();
    for (key, expected) in [("value", difference.value), ("low", difference.low), ("high", difference.high)] {
        assert!((number(&pair[key]) - expected).abs() < 1e-12, "{pair}");
    }
    assert_eq!((number(&best["arms"][0]["value"]), &best["measure"]), (0.975, &"best_g".into()));
    // Most trials of the second arm do not reach G 0.75, so there is no median. Five trials are too few for its interval.
    assert_eq!([0, 1].map(|arm| reach["arms"][arm]["value"].as_f64()), [Some(1.0), None]);
    assert_eq!(["low", "high"].map(|end| reach["arms"][0][end].as_f64()), [None; 2]);
    assert_eq!(["value", "low", "high"].map(|key| reach["pairs"][0][key].as_f64()), [None; 3]);
    assert_eq!([0, 1].map(|arm| number(&reach["arms"][arm]["reached"])), [5.0, 1.0]);
    // In reverse order the difference changes its sign.
    let reversed = &json(&place, "compare g df")["comparisons"][0]["measures"][0]["pairs"][0];
    assert!((number(&reversed["value"]) + difference.value).abs() < 1e-12);
    assert_eq!(number(&reversed["p"]), number(&pair["p"]));
    assert!((number(&reversed["a"]) - 0.02).abs() < 1e-12);
}

/// G of an easier stage is not comparable, so only generations of the last stage count.
#[test]
fn generations_to_reach_count_only_in_the_last_stage() {
    let place = Place::new(&[]);
    let course: [&[f64]; 2] = [&[1.0, 1.0, 1.0, 0.0, 1.0, 0.0], &[1.0, 1.0, 1.0, 0.0, 0.0, 0.0]];
    let five = ("learning.generations", "5");
    run(&place, "plain", &[five], &course);
    let stages = ("stages", "[{ from = 3, set = { 'world.coupling' = 1 } }]");
    run(&place, "staged", &[five, stages], &course);
    let report = json(&place, "compare plain staged");
    let reach = &report["comparisons"][0]["measures"][2];
    assert_eq!([0, 1].map(|arm| reach["arms"][arm]["value"].as_f64()), [Some(0.0), None]);
    assert_eq!([0, 1].map(|arm| number(&reach["arms"][arm]["reached"])), [2.0, 1.0]);
    assert_eq!(
        [0, 1].map(|arm| report["comparisons"][0]["arms"][arm]["name"].as_str().unwrap()),
        ["no stages", "1 stage"]
    );
    // The last stage has not begun.
    run(&place, "early", &[five, stages], &course.map(|trial| &trial[..3]));
    let (table, stderr) = place.good("compare plain early --csv");
    assert!(table.contains("champion_g") && !table.contains("generations_to_reach"), "{table}");
    assert!(stderr.contains("not compared, because the last stage has not begun in 1 stage"), "{stderr}");
}

#[test]
fn paired_trials_print_a_note_and_are_compared_with_paired() {
    let place = Place::new(&[]);
    let (df_ends, g_ends) = ([1.0, 0.75, 0.5, 1.0, 0.25], [0.75, 0.5, 0.25, 0.75, 0.0]);
    run(&place, "df", &[GENERATIONS], &slices(&rising_to(&df_ends)));
    run(&place, "g", &[GENERATIONS, FITNESS_G], &slices(&rising_to(&g_ends)));
    // Five pairs cannot give a p-value below 0.05, so that pairs are no advice.
    let (_, stderr) = place.good("compare df g");
    assert!(stderr.is_empty(), "{stderr}");
    let with_sixth = |ends: [f64; 5], sixth: f64| rising_to(&[&ends[..], &[sixth]].concat());
    run(&place, "df6", &[GENERATIONS], &slices(&with_sixth(df_ends, 0.5)));
    run(&place, "g6", &[GENERATIONS, FITNESS_G], &slices(&with_sixth(g_ends, 0.25)));
    place.notes("compare df6 g6", &["note: these arms have the same seeds", "--paired"]);
    let (text, stderr) = place.good("compare df g --paired");
    assert!(stderr.is_empty() && text.contains("Wilcoxon's signed-rank test"), "{stderr}{text}");
    let report = json(&place, "compare df g --paired");
    let pair = &report["comparisons"][0]["measures"][0]["pairs"][0];
    // In every pair the arms differ by 0.25, which gives the smallest p of five pairs.
    assert_eq!(["value", "a", "p"].map(|key| number(&pair[key])), [0.25, 1.0, 2.0 / 32.0]);
    let interval = statistics::paired(&[0.25; 5].iter().collect(), 1.0).unwrap();
    for (key, end) in [("low", interval.low), ("high", interval.high)] {
        assert!((number(&pair[key]) - end).abs() < 1e-12, "{pair}");
    }
    let unpaired = &json(&place, "compare df g")["comparisons"][0]["measures"][0]["pairs"][0];
    assert!(number(&unpaired["p"]) > 0.3 && number(&unpaired["a"]) < 0.8, "{unpaired}");

    run(&place, "seed", &[GENERATIONS, SEED_1], &slices(&rising_to(&df_ends)));
    run(&place, "more", &[GENERATIONS, FITNESS_G], &slices(&rising_to(&[1.0; 6])));
    assert_fails(&place, "compare df seed --paired", 2, &["--paired: ", "no pairs"]);
    assert_fails(&place, "compare df more --paired", 2, &["--paired: ", "numbers of trials"]);
    let uneven = &json(&place, "compare df more")["comparisons"][0];
    assert_eq!([0, 1].map(|arm| number(&uneven["arms"][arm]["trials"])), [5.0, 6.0]);
}

#[test]
fn equal_arms_do_not_differ() {
    let place = Place::new(&[]);
    for name in ["a", "b_50%"] {
        run(&place, name, &[GENERATIONS], &slices(&rising_to(&[0.5; 4])));
    }
    let report = json(&place, "compare a b_50%");
    for measure in report["comparisons"][0]["measures"].as_array().unwrap() {
        let pair = &measure["pairs"][0];
        assert_eq!(["a", "p", "p_holm"].map(|key| number(&pair[key])), [0.5, 1.0, 1.0], "{measure}");
        if measure["measure"] == "generations_to_reach" {
            assert!(pair["value"].is_null(), "{measure}");
        } else {
            // Equal trials do not exclude a difference.
            assert_eq!((number(&pair["value"]), number(&pair["low"])), (0.0, -number(&pair["high"])), "{measure}");
            assert!(number(&pair["high"]) > 0.25, "{measure}");
        }
    }
    // The arms have the same config, so they are named after their directories.
    let (text, _) = place.good("compare a b_50% --latex");
    assert!(
        text.starts_with("% Values are means over trials")
            && text.contains(r"& not reached (0 of 4) \\")
            && text.contains(r"champion's G, generation 1 & a $-$ b\_50\% & +0.000")
    );
    for (open, close) in [(r"\begin{tabular}", r"\end{tabular}"), ("{", "}")] {
        assert_eq!(text.matches(open).count(), text.matches(close).count(), "{text}");
    }
    let columns = |line: &str| line.matches(" & ").count();
    let rows: Vec<usize> = text.lines().filter(|line| line.contains(r" \\")).map(columns).collect();
    assert_eq!(rows, [4, 4, 4, 5, 5, 5, 5], "{text}");
}

#[test]
fn p_values_are_corrected_and_csv_equals_json() {
    let place = Place::new(&[]);
    let ends = [[0.0, 0.25, 0.25, 0.0, 0.5, 0.25], [0.5, 0.75, 0.5, 0.5, 0.25, 0.5], [1.0, 1.0, 0.75, 1.0, 1.0, 0.5]];
    for (name, ends) in ["x", "y", "z"].into_iter().zip(&ends) {
        run(&place, name, &[GENERATIONS], &slices(&rising_to(ends)));
    }
    let report = json(&place, "compare x y z --at 0,last,1 --reach 1");
    let measures = report["comparisons"][0]["measures"].as_array().unwrap();
    // The last generation is 1, so it is listed once.
    let names: Vec<_> =
        measures.iter().map(|measure| (measure["measure"].as_str().unwrap(), number(&measure["generation"]))).collect();
    let expected =
        [("champion_g", 0.0), ("champion_g", 1.0), ("best_g", 0.0), ("best_g", 1.0), ("generations_to_reach", 1.0)];
    assert_eq!(names, expected);
    let pairs = measures[1]["pairs"].as_array().unwrap();
    let p: Vec<f64> =
        [[0, 1], [0, 2], [1, 2]].iter().map(|[a, b]| statistics::rank_sum(&ends[*a], &ends[*b]).unwrap().p).collect();
    assert_eq!(pairs.iter().map(|pair| number(&pair["p"])).collect::<Vec<_>>(), p);
    assert_eq!(pairs.iter().map(|pair| number(&pair["p_holm"])).collect::<Vec<_>>(), statistics::holm(&p));
    assert!(number(&pairs[0]["p_holm"]) > p[0], "{pairs:?}");

    let (text, _) = place.good("compare x y z --at 0,last,1 --reach 1 --csv");
    let mut table = csv::Reader::from_reader(text.as_bytes());
    let rows: Vec<std::collections::HashMap<String, String>> = table.deserialize().map(Result::unwrap).collect();
    assert_eq!(rows.len(), 5 * (3 + 3));
    let is_last = |row: &std::collections::HashMap<String, String>| row["generation"] == "1" && row["other"] == "z";
    let row = rows.iter().find(|row| row["measure"] == "champion_g" && is_last(row)).unwrap();
    assert_eq!((&*row["arm"], &*row["trials"], &*row["other_trials"]), ("x", "6", "6"));
    for key in ["value", "low", "high", "a", "p", "p_holm"] {
        assert!((row[key].parse::<f64>().unwrap() - number(&pairs[1][key])).abs() < 1e-12, "{key}");
    }
    let row = rows.iter().find(|row| row["reach"] == "1" && row["arm"] == "z" && row["other"].is_empty()).unwrap();
    assert_eq!((&*row["reached"], &*row["value"]), ("4", "1"));
    // Half of the trials never reach G 1, which is no number.
    let row = rows.iter().find(|row| row["reach"] == "1" && row["arm"] == "x" && row["other"].is_empty()).unwrap();
    assert_eq!((&*row["reached"], &*row["value"], &*row["high"]), ("0", "", ""));
}

#[test]
fn unfinished_runs_are_compared_up_to_the_last_common_generation() {
    let place = Place::new(&[]);
    const WHOLE: [f64; 11] = [0.0, 0.5, 0.5, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0];
    let ten = ("learning.generations", "10");
    run(&place, "whole", &[ten], &[&WHOLE[..]; 3]);
    // The last trial is a generation behind, and the file ends with an incomplete line.
    run(&place, "part", &[ten, FITNESS_G], &[&[0.0, 0.5, 0.75, 1.0], &[0.0, 0.0, 0.0, 1.0], &[0.5, 0.75, 0.5]]);
    let metrics = place.path("part/metrics.csv");
    fs::write(&metrics, fs::read_to_string(&metrics).unwrap() + "2,3,1,0.").unwrap();
    let (text, stderr) = place.good("compare whole part");
    assert!(stderr.contains("note: fitness G has reached generation 2 of 10\n"), "{stderr}");
    assert!(stderr.contains("note: arms are compared up to generation 2, which all have reached\n"), "{stderr}");
    assert!(text.contains("champion's G, generation 2"), "{text}");
    let report = json(&place, "compare whole part");
    let reach = &report["comparisons"][0]["measures"][2];
    // Only generations 0 to 2 are known of all trials. The second arm reaches G 0.75 at 2, never, and at 1.
    assert_eq!([0, 1].map(|arm| reach["arms"][arm]["value"].as_f64()), [None, Some(2.0)]);
    assert_eq!([0, 1].map(|arm| number(&reach["arms"][arm]["reached"])), [0.0, 2.0]);
    assert_fails(&place, "compare whole part --at 3", 2, &["--at 3: ", "generation 2"]);

    // Runs of different lengths also print a note.
    run(&place, "short", &[GENERATIONS], &slices(&rising_to(&[0.5, 1.0])));
    let (_, stderr) = place.good("compare whole short");
    assert_eq!(
        stderr.lines().next(),
        Some("note: arms are compared up to generation 1, which all have reached"),
        "{stderr}"
    );

    fs::write(&metrics, fs::read_to_string(&metrics).unwrap().replace("\n1,1,", "\n1,2,")).unwrap();
    assert_fails(&place, "compare whole part", 1, &["metrics.csv: trial 1 of generation 2 is out of order"]);
}

#[test]
fn invalid_comparisons_fail_with_a_clear_error() {
    let place = Place::new(&[]);
    run(&place, "a", &[GENERATIONS], &slices(&rising_to(&[0.5; 4])));
    run(&place, "b", &[GENERATIONS, FITNESS_G], &slices(&rising_to(&[0.5; 4])));
    run(&place, "one", &[GENERATIONS, FITNESS_G], &slices(&rising_to(&[0.5])));
    run(&place, "torn", &[GENERATIONS, FITNESS_G], &[&[0.5, 0.5], &[]]);
    fs::create_dir(place.path("paper")).unwrap();
    place.write("paper/paper.toml", "seed = 0\n");
    assert_fails(&place, "compare a", 2, &["a is one run", "another"]);
    assert_fails(&place, "compare a b ./a", 2, &["./a is named twice"]);
    assert_fails(&place, "compare a one", 1, &["one trial", "--trials"]);
    assert_fails(&place, "compare a torn", 1, &["no generation that every trial has reached"]);
    assert_fails(&place, "compare a none", 1, &["none: no such folder", "flotilla train"]);
    assert_fails(&place, "compare none", 1, &["none: no such folder"]);
    assert_fails(&place, "compare paper a", 1, &["paper holds a paper", "arms/"]);
    assert_fails(&place, "compare a b --at 2", 2, &["--at 2: ", "generation 1"]);
    assert_fails(&place, "compare a b --at then", 2, &["allowed generations, from 0, or last"]);
    assert_fails(&place, "compare a b --reach 2", 2, &["0..1"]);
    assert_fails(&place, "compare a b --by fitness", 2, &["--by fitness: ", "sweep"]);
    assert_fails(&place, "compare a b --json --csv", 2, &["--json", "--csv"]);
    let many = (0..25).map(|at| format!(" r{at}")).collect::<String>();
    assert_fails(&place, &format!("compare{many}"), 2, &["25 runs are too many", "24 at most"]);
    assert_eq!(place.run("compare").status.code(), Some(2));
}

/// A sweep over two couplings and two fitnesses. The two seeds only add trials.
const SWEEP: &str = "\
[learning]
population = 8
trials = 3
generations = 2
[grid]
\"world.coupling\" = [1, 2]
\"learning.fitness\" = [\"G\", \"Df\"]
\"learning.seed\" = [4, 5]
";

#[test]
fn a_sweep_is_compared_along_an_axis_and_seeds_add_trials() {
    let place = Place::new(&[]);
    place.write("x.toml", format!("{WORLD}{SWEEP}"));
    place.good("sweep x.toml --out s --backend cpu --quiet");
    assert_fails(&place, "compare s", 2, &["several axes", "--by", "world.coupling, learning.fitness, learning.seed"]);
    assert_fails(&place, "compare s --by steps", 2, &["--by steps: ", "world.coupling, learning.fitness"]);
    let report = json(&place, "compare s --by fitness");
    let comparisons = report["comparisons"].as_array().unwrap();
    let places: Vec<_> = comparisons.iter().map(|comparison| &comparison["where"]).collect();
    assert_eq!(places, ["coupling 1", "coupling 2"]);
    // Points are ordered by coupling, fitness and seed. Those with coupling 2 and Df are 6 and 7.
    let arm = &comparisons[1]["arms"][1];
    assert_eq!((&arm["name"], &arm["trials"]), (&"fitness Df".into(), &6.into()));
    assert_eq!(arm["folders"], serde_json::json!(["s/points/0006", "s/points/0007"]));
    let ends: Vec<f64> = ["0006", "0007"]
        .iter()
        .flat_map(|point| {
            let text = fs::read_to_string(place.path("s/points").join(point).join("metrics.csv")).unwrap();
            let last = text.lines().filter(|line| line.split(',').nth(1) == Some("2"));
            last.map(|line| line.split(',').nth(4).unwrap().parse().unwrap()).collect::<Vec<f64>>()
        })
        .collect();
    assert_eq!(ends.len(), 6);
    let value = &comparisons[1]["measures"][0]["arms"][1]["value"];
    assert_eq!(number(value), ends.iter().sum::<f64>() / 6.0);
    let (text, _) = place.good("compare s --by learning.fitness --paired");
    assert!(text.starts_with("coupling 1\n\n| arm") && text.contains("\ncoupling 2\n\n"), "{text}");
    // `--by seed` compares the seeds of each coupling and fitness.
    assert_eq!(json(&place, "compare s --by seed")["comparisons"].as_array().unwrap().len(), 4);

    fs::remove_dir_all(place.path("s/points/0006")).unwrap();
    // A process that is killed early leaves no config.
    fs::remove_file(place.path("s/points/0002/config.toml")).unwrap();
    fs::remove_dir_all(place.path("s/points/0003")).unwrap();
    place.notes("compare s --by fitness", &["note: s/points/0006 was not run, and is left out: world.coupling = 2"]);
    let report = json(&place, "compare s --by fitness");
    assert_eq!(report["comparisons"].as_array().unwrap().len(), 1);
    assert_eq!(report["comparisons"][0]["arms"][1]["trials"], 3);
    fs::rename(place.path("s/points/0007"), place.path("s/points/0006")).unwrap();
    assert_fails(&place, "compare s --by fitness", 1, &["s/points/0006 is a run of another config"]);
    fs::remove_dir_all(place.path("s/points")).unwrap();
    assert_fails(
        &place,
        "compare s --by fitness",
        1,
        &["no two values of learning.fitness", "flotilla sweep s/sweep.toml --out s --resume"],
    );
}

#[test]
fn a_varied_key_is_compared_with_the_files_own_value() {
    let place = Place::new(&[]);
    let text = "[learning]\npopulation = 8\ntrials = 2\ngenerations = 1\n\
                [grid]\n\"learning.fitness\" = [\"G\", \"Df\"]\n\
                [vary]\n\"motion.max_speed\" = [2.0, 5.0]\n\"world.steps\" = [8]\n";
    place.write("x.toml", format!("{WORLD}{text}"));
    place.good("sweep x.toml --out s --backend cpu --quiet");
    let report = json(&place, "compare s --by max_speed");
    let names = |comparison: &Value| {
        let arms = comparison["arms"].as_array().unwrap().iter();
        arms.map(|arm| arm["name"].as_str().unwrap().to_string()).collect::<Vec<_>>()
    };
    let comparisons = report["comparisons"].as_array().unwrap();
    assert_eq!(
        comparisons.iter().map(|comparison| &comparison["where"]).collect::<Vec<_>>(),
        ["fitness G", "fitness Df"]
    );
    assert_eq!(names(&comparisons[0]), ["max_speed 3.0", "max_speed 2.0", "max_speed 5.0"]);
    // By an axis of the grid, points with another varied key are compared, too.
    let report = json(&place, "compare s --by fitness");
    let places: Vec<_> =
        report["comparisons"].as_array().unwrap().iter().map(|comparison| &comparison["where"]).collect();
    assert_eq!(places, ["as in the file", "steps 8", "max_speed 2.0", "max_speed 5.0"]);
}

/// Arms are named after up to six keys that differ. With more, the names would be too long to read.
#[test]
fn many_different_keys_are_no_name() {
    let place = Place::new(&[]);
    let keys = [
        "world.steps",
        "world.dt",
        "world.coupling",
        "world.speed",
        "sense.agent_range",
        "motion.max_speed",
        "motion.max_acceleration",
    ];
    let others: Vec<(&str, &str)> = keys.map(|key| (key, "1")).to_vec();
    run(&place, "usual", &[GENERATIONS], &slices(&rising_to(&[0.5; 3])));
    run(&place, "six", &[&[GENERATIONS], &others[..6]].concat(), &slices(&rising_to(&[0.5; 3])));
    run(&place, "seven", &[&[GENERATIONS], &others[..]].concat(), &slices(&rising_to(&[0.5; 3])));
    let name = |other: &str| {
        let arm = &json(&place, &format!("compare usual {other}"))["comparisons"][0]["arms"][1];
        arm["name"].as_str().unwrap().to_string()
    };
    assert!(name("six").contains("steps 1"), "{}", name("six"));
    assert_eq!(name("seven"), "seven");
}

#[test]
fn different_layouts_print_a_note_and_are_not_paired() {
    let place = Place::new(&[]);
    let trials = [&[0.0, 0.5][..], &[0.0, 1.0]];
    run(&place, "here", &[GENERATIONS], &trials);
    run(&place, "again", &[GENERATIONS, ("learning.seed", "1")], &trials);
    assert!(!place.good("compare here again").1.contains("layouts"));
    for (key, value) in [
        ("world.map", "[50, 51]"),
        ("world.leaders", "[[20, 2], [30, 2]]"),
        ("world.followers", "[[25, 4]]"),
        ("world.pois", "[[10, 15], [20, 16]]"),
    ] {
        run(&place, key, &[GENERATIONS, (key, value)], &trials);
        let (_, stderr) = place.good(&format!("compare here {key}"));
        assert!(stderr.contains(&format!("note: the arms play in different layouts: {key} differ")), "{stderr}");
        assert!(!stderr.contains("--paired"), "{stderr}");
    }
    // The long form is the same layout.
    let (long, _) = place.good("check here/config.toml --expand");
    place.write("long.toml", long);
    place.good("train long.toml --backend cpu --out long");
    assert!(!place.good("compare here long").1.contains("layouts"));
}

#[test]
fn keys_of_classes_are_compared_one_by_one() {
    let place = Place::new(&[("rovers.toml", include_str!("../../configs/rovers.toml"))]);
    let train = "train rovers.toml --backend cpu --generations 1 --population 4 --trials 2";
    for fitness in ["G", "D"] {
        place.good(&format!("{train} --out {fitness} --set agents.drone.fitness={fitness}"));
    }
    let (text, stderr) = place.good("compare G D");
    assert!(text.contains("drone.fitness G") && text.contains("drone.fitness D"), "{text}");
    assert!(!stderr.contains("layouts"), "{stderr}");
    let error = place.refused(1, &format!("{train} --out G --resume --set agents.rover.motion.max_speed=9"));
    assert!(error.contains("agents.rover.motion.max_speed: ") && error.contains(" there, 9.0 here"), "{error}");
    place.good(&format!("{train} --out fast --set agents.rover.motion.max_speed=9"));
    assert!(!place.good("compare G fast").1.contains("layouts"));
    place.good(&format!("{train} --out turned --set agents.rover.heading=45"));
    place.notes("compare G turned", &["the arms play in different layouts: agents differ"]);
    // A key that only one run sets names both, in any order.
    place.good(&format!("{train} --out plain --seed 1"));
    for arms in ["plain G", "G plain"] {
        place.prints(&format!("compare {arms}"), &["drone.fitness G, seed 0", "drone.fitness -, seed 1"]);
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_folder_name_that_is_not_utf_8_is_escaped() {
    use std::ffi::OsStr;
    use std::os::unix::ffi::OsStrExt;

    let place = Place::new(&[]);
    let trials = [&[0.0, 0.5][..], &[0.0, 1.0]];
    run(&place, "one", &[GENERATIONS], &trials);
    run(&place, "two", &[GENERATIONS, FITNESS_G], &trials);
    let odd = OsStr::from_bytes(b"two\xff");
    fs::rename(place.path("two"), place.path(odd)).unwrap();
    let output = place.command().args(["compare", "--json", "one"]).arg(odd).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["comparisons"][0]["arms"][1]["folders"][0], r"two\xff");
}

#[test]
fn a_copied_run_prints_a_note() {
    let place = Place::new(&[("x.toml", &format!("{WORLD}[learning]\npopulation = 4\ngenerations = 1\ntrials = 2\n"))]);
    for (folder, flags) in [("a", ""), ("b", "--seed 1"), ("c", "--checkpoint-generations 1")] {
        place.good(&format!("train x.toml --out {folder} --backend cpu --quiet {flags}"));
    }
    let (_, stderr) = place.good("compare a b c");
    assert_eq!(stderr.lines().next(), Some("note: c is a copy of a: the same run"));
    assert!(!place.good("compare b c").1.contains("copy"));
}
