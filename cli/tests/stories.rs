//! Tests the results of the paper's claims (Sections 1, 5 and 6, Figures 4 to 6) over 200 trials.
//!
//! The tables of docs/results/claims-measured.md and the files docs/results/claims/*.csv must have these results,
//! whether the claims hold or not. trials.csv has every trial's result at generation 100.
//!
//! By default the first trial is trained again, and the means on the page are compared with trials.csv.
//! `cargo test --release stories:: -- --ignored` trains everything. With `FLOTILLA_WRITE_CLAIMS=1`, it writes the
//! files, tables and figures again.

use std::fs;
use std::path::{Path, PathBuf};

use flotilla::backend::cpu::Cpu;
use flotilla::baseline::Baselines;
use flotilla::config::{Override, ValidConfig};
use flotilla::statistics;
use flotilla::trainer::Row;
use flotilla::trainer::Trainer;
use flotilla_studies::paper::{self, Evidence, Experiment, claims, tables};

const TRIALS: usize = 200;
const SEED: u32 = 777;
/// The generation that the page reports.
const LAST: usize = 100;

/// Trains the paper's experiments.
fn train_experiments(trials: usize) -> Vec<Experiment> {
    let set = |key: &str, value: u32| Override::new(key, value, key);
    let mut arms = paper::arms(&[set("learning.trials", trials as u32), set("learning.seed", SEED)]).unwrap();
    let learning = &arms[0].config.learning;
    assert_eq!((learning.population, learning.generations), (50, LAST));
    let (configs, places) = paper::trained(&arms);
    let mut trainer = Trainer::new(ValidConfig::all(&configs).unwrap());
    for row in trainer.finish(&mut Cpu::default()).unwrap() {
        let shared = (0..arms.len()).filter(|&arm| places[arm] == row.experiment);
        shared.for_each(|arm| arms[arm].add(&Row { experiment: arm, ..row }));
    }
    arms
}

fn root(path: &str) -> PathBuf {
    Path::new(crate::ROOT).join(path)
}

/// Returns one row per experiment: its name, then one digit per trial for the POIs that the champion observed, and one
/// digit per trial for those of the best team.
fn trials_csv(arms: &[Experiment]) -> String {
    let mut text = String::from("arm,champion_pois,best_pois\n");
    for arm in arms {
        let digits = |g: &[Vec<f64>]| -> String {
            g.iter().map(|trial| (trial[LAST] * arm.pois() as f64).round().to_string()).collect()
        };
        text += &format!("{:?},{},{}\n", arm.name(), digits(&arm.champion), digits(&arm.best));
    }
    text
}

#[test]
fn trials_csv_agrees_with_training_and_the_page() {
    let text = fs::read_to_string(root("docs/results/claims/trials.csv")).unwrap();
    let page = fs::read_to_string(root("docs/results/claims-measured.md")).unwrap();
    let arms = train_experiments(1);
    let mut table = csv::Reader::from_reader(text.as_bytes());
    let mut rows = table.records().map(Result::unwrap);
    for line in trials_csv(&arms).lines().skip(1) {
        let row = rows.next().unwrap();
        let (name, results) = line.rsplit_once("\",").unwrap();
        assert_eq!(&row[0], name.trim_matches('"'));
        let first: Vec<&str> = results.split(',').collect();
        assert!(row[1].starts_with(first[0]) && row[2].starts_with(first[1]), "{name}: {results}");
        assert!(row[1].len() == TRIALS && row[2].len() == TRIALS, "{name}");
    }
    for (arm, row) in arms.iter().zip(csv::Reader::from_reader(text.as_bytes()).records().map(Result::unwrap)) {
        let [champion, best] = [&row[1], &row[2]]
            .map(|digits| -> Vec<f64> { digits.bytes().map(|digit| f64::from(digit - b'0')).collect() });
        let mean = statistics::bounded(&champion.iter().collect(), [0.0, arm.pois() as f64]).unwrap();
        let best = best.iter().sum::<f64>() / TRIALS as f64;
        let cell = format!("{:.2} [{:.2}, {:.2}] ({best:.2})", mean.value, mean.low, mean.high);
        let name = format!("| {}, {} ", arm.layout.name, arm.paradigm);
        let line = page.lines().find(|line| line.starts_with(&name)).unwrap();
        // Experiments with behaviours are not in this table.
        assert!(arm.selects || line.contains(&cell), "{}: {cell}", arm.name());
    }
}

#[test]
#[ignore = "trains for minutes; .ci/nightly runs it"]
fn pages_agree_with_the_full_study() {
    let arms = train_experiments(TRIALS);
    let mut baselines = Baselines::new(&ValidConfig::all(&paper::baseline_configs(&arms)).unwrap());
    while !baselines.is_done() {
        baselines.advance(&mut Cpu::default()).unwrap();
    }
    let baselines = baselines.found();
    let results = Evidence { arms: &arms, baselines: &baselines };
    let claims = claims::claims(results);
    let (baseline, heading) = (tables::without_learning(results), tables::heading(&arms[0].config.learning, &claims));
    let [meaning, pois, race] = baseline.split("\n\n").collect::<Vec<_>>()[..] else { panic!("{baseline}") };
    for (name, text) in [("trials.csv", trials_csv(&arms)), ("measured.csv", comma_separated(&tables::full(&claims)))] {
        let path = root("docs/results/claims").join(name);
        match std::env::var_os("FLOTILLA_WRITE_CLAIMS") {
            Some(_) => fs::write(path, text).unwrap(),
            None => assert_eq!(fs::read_to_string(path).unwrap(), text, "{name}"),
        }
    }
    for (index, layout) in paper::LAYOUTS.iter().enumerate() {
        let Some(number) = layout.figure else { continue };
        let (path, svg) =
            (root(&format!("docs/pictures/figure{number}.svg")), paper::figure(results, index).scene().svg());
        match std::env::var_os("FLOTILLA_WRITE_CLAIMS") {
            Some(_) => fs::write(path, svg).unwrap(),
            None => assert_eq!(fs::read_to_string(path).unwrap(), svg, "figure {number}"),
        }
    }
    let verdicts = tables::verdicts(&claims);
    let tables = format!("{meaning}\n\n{heading}\n\n{pois}\n\n{race}\n{verdicts}");
    check_or_write_page("docs/results/claims-measured.md", &tables);
}

/// Returns a Markdown table as comma-separated values.
fn comma_separated(table: &str) -> String {
    let mut rows = csv::Writer::from_writer(Vec::new());
    for line in table.lines().filter(|line| !line.starts_with("| --")) {
        let cells = line.trim_start_matches("| ").trim_end_matches(" |").split(" | ").map(str::trim);
        rows.write_record(cells).unwrap();
    }
    String::from_utf8(rows.into_inner().unwrap()).unwrap()
}

/// Fails unless the page has this text between its marks. With `FLOTILLA_WRITE_CLAIMS`, writes it there instead.
fn check_or_write_page(page: &str, text: &str) {
    const MARKS: [&str; 2] = ["<!-- what comes out: cargo test stories:: -->\n", "<!-- so far -->\n"];
    let path = root(page);
    let text_of_page = fs::read_to_string(&path).unwrap();
    let (before, rest) = text_of_page.split_once(MARKS[0]).unwrap_or_else(|| panic!("{page} has no {:?}", MARKS[0]));
    let (expected, after) = rest.split_once(MARKS[1]).unwrap_or_else(|| panic!("{page} has no {:?}", MARKS[1]));
    let actual = format!("\n{text}\n");
    if std::env::var_os("FLOTILLA_WRITE_CLAIMS").is_some() {
        fs::write(&path, [before, MARKS[0], &actual, MARKS[1], after].concat()).unwrap();
    } else if expected != actual {
        let difference = expected.lines().zip(actual.lines()).find(|(expected, actual)| expected != actual);
        panic!(
            "{page} differs from the results; on the page and now: {difference:#?}\n(see the head of cli/tests/stories.rs)"
        );
    }
}
