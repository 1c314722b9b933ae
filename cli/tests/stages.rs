//! Tests curricula (`[[stages]]`) and warm starts (`--init`).
//!
//! Errors in stages name their line. A resumed run must end in the same results as one without a stop, byte for byte.

use std::fs;
use std::path::Path;

use crate::support::{self, Place, SMALL, files, metrics_without_seconds, results, table};
use flotilla::backend::cpu::Cpu;
use flotilla::config::{Config, Sharing};
use flotilla::front;
use flotilla::trainer::{Row, Trainer};
use flotilla::verify;
use flotilla_app::record::digests::Verification;
use flotilla_app::record::disk::Disk;
use flotilla_app::record::folder::{Folder, POLICIES, RUN, Run, Start, StartFrom};
use flotilla_app::record::metrics::Lines;
use flotilla_app::record::policies::{self, Init, read_init};
use flotilla_app::report::replay::{Which, replay};
use flotilla_app::run::{Results, RunError, Session, SessionEnd};
use tempfile::TempDir;

const STAGES: &str = "
[[stages]]
from = 2
set = { 'world.coupling' = 3, 'world.steps' = 14, 'learning.episodes_per_team' = 2, 'learning.start_jitter' = 0.5 }
[[stages]]
from = 4
set = { 'world.pois' = [[10, 9], [20, 9], [30, 12]], 'learning.poi_jitter' = 1.0 }
";

fn config(text: &str) -> Config {
    Config::parse(text, "test.toml").unwrap_or_else(|error| panic!("{error}"))
}

fn staged() -> Config {
    config(&[SMALL, STAGES].concat())
}

/// Returns the error message for an invalid config, line by line.
fn error_lines(text: &str) -> Vec<String> {
    Config::parse(text, "test.toml").expect_err(text).to_string().lines().map(String::from).collect()
}

#[test]
fn each_stage_changes_the_config_of_the_file() {
    let config = staged();
    assert_eq!(Config::parse(&config.to_toml(), "again").unwrap(), config, "{}", config.to_toml());
    let valid = config.validate().unwrap();
    let stages = valid.stages();
    let froms: Vec<usize> = stages.iter().map(|(from, _)| *from).collect();
    assert_eq!(froms, [0, 2, 4]);
    let without_stages = Config { stages: vec![], ..config.clone() };
    assert_eq!(*stages[0].1, without_stages);
    // Changes of one stage do not carry over to the next.
    assert_eq!((stages[1].1.world.steps, stages[2].1.world.steps), (14, 9));
    assert_eq!((stages[1].1.world.pois.len(), stages[2].1.world.pois.len(), valid.pois()), (2, 3, None));
    assert_eq!((0..7).map(|generation| valid.stage_of(generation)).collect::<Vec<_>>(), [0, 0, 1, 1, 2, 2, 2]);
    let lengths: Vec<usize> = valid.stage_lengths().map(|(generations, _)| generations).collect();
    assert_eq!(lengths, [2, 2, 3]);
    let immediate = self::config(&format!("{SMALL}[[stages]]\nfrom = 0\nset = {{ world.coupling = 1 }}\n"));
    let immediate = immediate.validate().unwrap();
    assert_eq!((immediate.stages().len(), immediate.stage_of(6)), (1, 0));
    assert_eq!(immediate.at(0).world.coupling, flotilla::config::Coupling::Same(1));
    // `metrics.csv` numbers the stages in the same way.
    let column = |config: &Config, generation: usize| {
        let row = Row { experiment: 0, trial: 0, generation, best_g: 0.0, mean_g: 0.0, champion_g: 0.0, test_g: None };
        Lines::of(config).line(&row, 0.0).trim_end().rsplit(',').next().unwrap().parse().unwrap()
    };
    assert_eq!((0..7).map(|generation| column(&config, generation)).collect::<Vec<usize>>(), [0, 0, 1, 1, 2, 2, 2]);
    assert_eq!([0, 6].map(|generation| column(&immediate, generation)), [0, 0]);
}

/// A world whose POIs are all there eight times gives every team the same G, and other teams by softmax, since these depend
/// on the sum of values.
#[test]
fn the_first_teams_of_a_stage_depend_on_what_was_observed_before_it() {
    const POIS: &str = "[[20, 30], [12, 26], [27, 28], [20, 15]]";
    let eight = format!("[{}]", [&POIS[1..POIS.len() - 1]; 8].join(", "));
    let text = |pois: &str| {
        format!(
            "[world]\nmap = [40, 40]\nleaders = [[15, 18], [24, 20]]\npois = {pois}\ncoupling = 2\nsteps = 40\n\
             [learning]\npopulation = 6\nelites = 6\ntrials = 60\ngenerations = 1\nfitness = 'G'\n\
             teams = 'softmax'\ntemperature = 0.3\n"
        )
    };
    let stage = format!("[[stages]]\nfrom = 1\nset = {{ 'world.pois' = {eight} }}\n");
    let last = |text: &str| {
        let rows = Trainer::new([config(text).validate().unwrap()]).finish(&mut Cpu::default()).unwrap();
        rows.into_iter().filter(|row| row.generation == 1).map(|row| row.mean_g).collect::<Vec<f64>>()
    };
    let [once, all_eight, staged] = [text(POIS), text(&eight), text(POIS) + &stage].map(|text| last(&text));
    assert_eq!(staged, once);
    assert_ne!(staged, all_eight);
}

#[test]
fn errors_in_stages_name_their_line() {
    let lines = SMALL.lines().count();
    let stage = |from: &str, set: &str| format!("[[stages]]\nfrom = {from}\nset = {{ {set} }}\n");
    for [text, line, message] in table(include_str!("refusals/stages.txt"), 15) {
        let found = error_lines(&[SMALL, &text].concat());
        let expected = format!("test.toml:{}: {message}", lines + line.parse::<usize>().unwrap());
        assert!(found.len() == 1 && found[0].starts_with(&expected), "{text}: {found:?} is not {expected}");
    }
    assert!(error_lines(&["stages = 3\n", SMALL].concat())[0].starts_with("test.toml:1: stages: allowed a list"));
    // Groups are those of the file.
    let grouped = SMALL.replace("population", "paradigm = 'all-leaders'\nsharing = 'group'\npopulation");
    let swapped = "'world.leaders' = [[20, 5], [10, 5]], 'world.followers' = [[11, 2], [12, 2], [13, 2]]";
    let error = error_lines(&format!("{grouped}{}", stage("1", swapped)));
    assert!(error.len() == 1 && error[0].contains("stages[0]: other leaders are nearest"), "{error:?}");
    // In the all-leaders paradigm, followers learn too, so a stage cannot change their number.
    let all_leaders = SMALL.replace("population", "paradigm = 'all-leaders'\npopulation");
    let text = format!("{all_leaders}{}", stage("1", "'world.followers' = [[1, 2]]"));
    let error = &error_lines(&text)[0];
    assert!(error.contains("world.followers: 3 leaders learn in this stage, 5 in all others"), "{text}");
}

/// Trains until `stops` returns true for the next generation, or to the end.
fn train_until(session: &mut Session, stops: impl Fn(usize) -> bool) -> Result<SessionEnd, RunError> {
    support::train(session, front::cpu(), &mut |_| None, &mut |next| stops(next[0]))
}

/// Opens a run and trains it until generation `until` is next, or to the end. Returns the results of a finished run.
fn train(
    config: &Config,
    path: &Path,
    init: Option<Init>,
    start: Start,
    until: usize,
) -> Result<Option<Results>, RunError> {
    let (mut session, _) = Session::open_from(
        vec![(config.clone(), path.to_path_buf(), init)],
        StartFrom::Unspecified,
        start,
        &Disk::default(),
    )?;
    let ended = train_until(&mut session, |next| next >= until)?;
    Ok((ended == SessionEnd::Finished).then(|| session.results(0).cloned().unwrap()))
}

/// Trains up to generation `until` and makes it the last (`Session::end`). Plays it too if `finish` is set. Returns the
/// last generation.
fn train_shorter(config: &Config, path: &Path, init: Option<Init>, until: usize, finish: bool) -> usize {
    let runs = vec![(config.clone(), path.to_path_buf(), init)];
    let (mut session, _) = Session::open_from(runs, StartFrom::Unspecified, Start::Fresh, &Disk::default()).unwrap();
    assert!(train_until(&mut session, |next| next == until).unwrap() == SessionEnd::Stopped);
    let last = session.end().unwrap();
    if finish {
        assert!(train_until(&mut session, |_| false).unwrap() == SessionEnd::Finished);
    }
    last
}

/// Trains a run without a stop, stops it before each generation, and extends runs of the given lengths to its length.
/// The results must be the same, and the given generations must replay. Returns the folder, with the run in `whole`.
pub fn check_resumes(config: &Config, lengths: &[usize], replayed: &[usize]) -> TempDir {
    let place = tempfile::tempdir().unwrap();
    let path = |name: &str, number: usize| place.path().join(format!("{name}-{number}"));
    let open = |config: &Config, path: &Path, start: Start| {
        Session::open(vec![(config.clone(), path.into())], start, &Disk::default()).unwrap().0
    };
    let whole = place.path().join("whole");
    let expected = train(config, &whole, None, Start::Fresh, 99).unwrap();
    // The last step completes the run, which leaves nothing to stop.
    let done = config.learning.generations + 2;
    let resumes = |path: &Path, next: usize| {
        let mut session = open(config, path, Start::Resume);
        assert_eq!((session.generations(), session.is_done()), (&[next][..], next == done), "{}", path.display());
        assert_eq!(train_until(&mut session, |_| false).unwrap(), SessionEnd::Finished);
        assert_eq!(session.results(0), expected.as_ref(), "{}", path.display());
        assert_eq!(results(path), results(&whole), "{}", path.display());
    };
    for until in 1..=done {
        let path = path("stopped", until);
        let mut session = open(config, &path, Start::Fresh);
        let end = if until == done { SessionEnd::Finished } else { SessionEnd::Stopped };
        assert_eq!(train_until(&mut session, |next| next >= until).unwrap(), end, "{until}");
        assert_eq!(session.generations(), [until]);
        drop(session);
        resumes(&path, until);
    }
    for &generations in lengths {
        let path = path("extended", generations);
        let mut short = config.clone();
        short.learning.generations = generations;
        assert!(train(&short, &path, None, Start::Fresh, 99).unwrap().is_some());
        resumes(&path, generations + 1);
    }
    // The best team and the champions of each generation can be replayed.
    for which in [Which::Best, Which::Champion].into_iter().filter(|_| !replayed.is_empty()) {
        let again = replay(&whole, 1, replayed, which, Verification::Required, &mut Cpu::default(), &mut |_| true);
        assert_eq!(again.unwrap_or_else(|error| panic!("{which:?}: {error}")).len(), replayed.len());
    }
    place
}

fn policy_bytes(path: &Path) -> Vec<u8> {
    fs::read(path.join(POLICIES)).unwrap()
}

#[test]
fn a_staged_run_resumes_to_the_same_results() {
    let config = staged();
    let place = check_resumes(&config, &[], &[]);
    let whole = place.path().join("whole");
    let (metrics, valid) = (metrics_without_seconds(&whole), config.validate().unwrap());
    assert_eq!(metrics[0], ["trial", "generation", "best_g", "mean_g", "champion_g", "stage"]);
    for row in &metrics[1..] {
        assert_eq!(row[5], valid.stage_of(row[1].parse().unwrap()).to_string());
    }
    // Before generation 2, where a stage begins, the metrics equal those of a run without stages.
    let plain = place.path().join("plain");
    train(&Config { stages: vec![], ..config.clone() }, &plain, None, Start::Fresh, 99).unwrap();
    let without: Vec<_> = metrics_without_seconds(&plain).iter().map(|row| row.to_vec()).collect();
    assert!((1..7).all(|row| metrics[row][..5] == without[row][..5]) && metrics[7][..5] != without[7][..5]);
    // A run cannot be resumed with other stages.
    let mut other = config.clone();
    other.stages[1].from = 5;
    let error = train(&other, &whole, None, Start::Resume, 99).unwrap_err().to_string();
    assert!(error.contains("stages[1]: { from = 4") && error.contains("{ from = 5"), "{error}");
}

/// Stages change the number of partners.
#[test]
fn a_run_with_several_partners_resumes_to_the_same_results() {
    let text = SMALL.replace("population = 8", "population = 8\npartners = 3\nleniency = 'max'");
    let stages = "[[stages]]\nfrom = 3\nset = { learning.partners = 1 }\n\
                  [[stages]]\nfrom = 5\nset = { learning.partners = 2, learning.leniency = 'mean' }\n";
    let config = config(&[&text, stages].concat());
    let place = check_resumes(&config, &[], &[0, 2, 3, 5, 6]);
    let whole = place.path().join("whole");
    // Team 23 is the last of three rounds of 8 policies, and generation 3 has a single round.
    let team = |generation| {
        let mut backend = Cpu::default();
        let generations = [generation];
        replay(&whole, 0, &generations, Which::Number(23), Verification::Required, &mut backend, &mut |_| true)
    };
    assert!(team(2).is_ok() && team(3).is_err());
}

/// A finished run can also be extended to the same results as a longer run.
#[test]
fn a_run_with_a_hall_of_fame_resumes_to_the_same_results() {
    const FAR: &str = "pois = [[10, 12], [20, 13]]\ncoupling = 1\nsteps = 20";
    let small = SMALL.replace("pois = [[10, 9], [20, 9]]\ncoupling = 2\nsteps = 9", FAR);
    let small = small.replace("population = 8", "population = 8\nhall_of_fame = 3");
    let stage = "[[stages]]\nfrom = 3\nset = { learning.partners = 2, world.coupling = 2 }\n";
    let config = config(&[&small, stage].concat());
    let place = check_resumes(&config, &[], &[0, 2, 3, 6]);
    check_resumes(&Config { stages: vec![], ..config.clone() }, &[0, 1, 3, 5], &[]);
    let [whole, path] = ["whole", "without"].map(|name| place.path().join(name));
    let mut without = config;
    without.learning.hall_of_fame = 0;
    train(&without, &path, None, Start::Fresh, 99).unwrap();
    assert!(policy_bytes(&path) != policy_bytes(&whole), "the hall of fame changed nothing");
}

/// Checkpoints include the mean and the standard deviations of the search. A stage changes its step size. A finished
/// run can also be extended to the same results as a longer run.
#[test]
fn evolution_strategies_resume_to_the_same_results() {
    const FAR: &str = "pois = [[10, 12], [20, 13]]\ncoupling = 1\nsteps = 20";
    let stage = "[[stages]]\nfrom = 3\nset = { learning.search_step = 2.0, world.coupling = 2 }\n";
    for method in ["openai-es", "snes"] {
        let method = format!("population = 9\nmethod = '{method}'\nfitness = 'G'");
        // The POIs are far enough away that policies differ in how many they reach.
        let small = SMALL.replace("pois = [[10, 9], [20, 9]]\ncoupling = 2\nsteps = 9", FAR);
        let config = config(&[&small.replace("population = 8", &method), stage].concat());
        let place = check_resumes(&config, &[], &[0, 2, 3, 6]);
        check_resumes(&Config { stages: vec![], ..config.clone() }, &[0, 1, 3, 5], &[]);
        let whole = place.path().join("whole");
        let varied = metrics_without_seconds(&whole)[1..].iter().filter(|row| row[2] != row[3]).count();
        assert!(varied > 10, "{method}: teams differ in only {varied} rows, so the search hardly moves");
        // A search that starts from given policies resumes, too.
        let init = || Some(read_init(&whole.join(POLICIES), &config).unwrap());
        let [warm, again] = ["warm", "again"].map(|name| place.path().join(name));
        train(&config, &warm, init(), Start::Fresh, 99).unwrap();
        train(&config, &again, init(), Start::Fresh, 2).unwrap();
        train(&config, &again, init(), Start::Resume, 99).unwrap();
        assert_eq!(results(&again), results(&warm));
        assert!(policy_bytes(&warm) != policy_bytes(&whole));
    }
}

/// Policies after the last generation are bred with the settings of its stage.
#[test]
fn a_finished_run_is_extended_with_the_settings_of_its_last_stage() {
    let stage = "[[stages]]\nfrom = 3\nset = { learning.mutation = 'additive', learning.mutation_probability = 0.9 }\n";
    check_resumes(&config(&[SMALL, stage].concat()), &[3, 5], &[]);
}

#[test]
fn a_warm_started_run_resumes_to_the_same_results() {
    let place = tempfile::tempdir().unwrap();
    let (config, first) = (config(SMALL), place.path().join("first"));
    train(&config, &first, None, Start::Fresh, 99).unwrap();
    let file = first.join(POLICIES);
    let mut longer = config.clone();
    longer.learning.generations += 2;
    let init = || Some(read_init(&file, &config).unwrap());
    let digest = init().unwrap().digest;
    // The policies of the file are generation 0, in the same order.
    let learned = policies::read_all(&file, &config).unwrap();
    let whole = place.path().join("whole");
    let expected = train(&config, &whole, init(), Start::Fresh, 99).unwrap().unwrap();
    let mut trainer = Trainer::new([config.validate().unwrap()]);
    let (policies, parameters) = (8, config.parameters());
    for (trial, weights) in learned.iter().enumerate() {
        assert!(trainer.start_from(0, trial, policies, weights));
        let slots = trainer.weights(0, trial).unwrap();
        for (slots, given) in slots.chunks(9 * parameters).zip(weights.chunks(8 * parameters)) {
            assert_eq!(&slots[..8 * parameters], given);
        }
    }
    assert!(!trainer.start_from(0, 0, policies, &learned[0][1..]));
    let trained = trainer.advance(&mut Cpu::default()).and_then(|_| trainer.advance(&mut Cpu::default())).unwrap();
    for (metrics, row) in metrics_without_seconds(&whole)[1..].iter().zip(&trained) {
        assert_eq!(metrics[2..4], [row.best_g.to_string(), row.mean_g.to_string()], "trial {}", row.trial);
    }
    // Each trial starts from the policies of the same trial.
    let given: Vec<Vec<f32>> = init().unwrap().trials.into_iter().map(|trial| trial.weights).collect();
    assert!(given == learned && learned[0] != learned[1]);
    // With more policies than the population needs, the first are used. With fewer, random policies fill the rest.
    let drawn = Trainer::new([config.validate().unwrap()]).weights(0, 0).unwrap().to_vec();
    for given in [3, 20] {
        let mut trainer = Trainer::new([config.validate().unwrap()]);
        let weights: Vec<f32> = (0..2 * given * parameters).map(|number| number as f32).collect();
        assert!(trainer.start_from(0, 0, given, &weights));
        let taken = given.min(policies) * parameters;
        let slots = trainer.weights(0, 0).unwrap().chunks(9 * parameters).zip(drawn.chunks(9 * parameters));
        for ((slots, drawn), weights) in slots.zip(weights.chunks(given * parameters)) {
            assert_eq!((&slots[..taken], &slots[taken..]), (&weights[..taken], &drawn[taken..]), "{given} policies");
        }
    }
    assert_eq!(Run::read(&whole.join(RUN)).unwrap().init, Some(digest.clone()));
    for until in 0..=7 {
        let path = place.path().join(format!("stopped-{until}"));
        train(&config, &path, init(), Start::Fresh, until).unwrap();
        // The file may be given again, but need not be.
        let given = if until % 2 == 0 { init() } else { None };
        assert_eq!(train(&config, &path, given, Start::Resume, 99).unwrap().as_ref(), Some(&expected), "{until}");
        assert_eq!(results(&path), results(&whole), "{until}");
    }
    // A run cannot be resumed with another file, or with a file if it did not start from one.
    let other = read_init(&whole.join(POLICIES), &config).unwrap();
    for config in [&config, &longer] {
        let before = [&whole, &first].map(|path| files(path));
        let error = train(config, &whole, Some(other.clone()), Start::Resume, 99).unwrap_err().to_string();
        assert!(error.contains("started from a file of policies with SHA-256") && !error.contains('\n'), "{error}");
        // The message has the start of both digests.
        assert!(
            [&digest, &other.digest].iter().all(|digest| error.contains(&format!(" {}…", &digest[..16]))),
            "{error}"
        );
        let error = train(config, &first, init(), Start::Resume, 99).unwrap_err().to_string();
        assert!(error.contains("did not start from a file"), "{error}");
        assert!(before == [&whole, &first].map(|path| files(path)), "a refused command changed files");
    }
    // Without a checkpoint, the file has to be given again.
    let bare = place.path().join("bare");
    let (folder, _) = Folder::open(&bare, Start::Fresh, &config, StartFrom::Unspecified, Disk::default()).unwrap();
    folder.write_run(&Run { init: Some(digest), ..Run::new(&config) }).unwrap();
    drop(folder);
    let error = train(&config, &bare, None, Start::Resume, 99).unwrap_err().to_string();
    assert!(error.contains("has no checkpoint yet"), "{error}");
    // The same holds for a run that was killed before its first generation.
    let early = place.path().join("early");
    let runs = vec![(config.clone(), early.clone(), init())];
    drop(Session::open_from(runs, StartFrom::Unspecified, Start::Fresh, &Disk::default()).unwrap());
    let error = train(&config, &early, None, Start::Resume, 99).unwrap_err().to_string();
    assert!(error.contains("has no checkpoint yet"), "{error}");
    assert_eq!(train(&config, &early, init(), Start::Resume, 99).unwrap().as_ref(), Some(&expected));
    assert_eq!(train(&config, &bare, init(), Start::Resume, 99).unwrap().as_ref(), Some(&expected));
}

/// Resuming, extending and replaying give the same results as for a run with this number of generations.
#[test]
fn a_run_that_was_ended_early_equals_a_shorter_run() {
    let place = tempfile::tempdir().unwrap();
    let first = place.path().join("first");
    train(&config(SMALL), &first, None, Start::Fresh, 99).unwrap();
    let init = Some(read_init(&first.join(POLICIES), &config(SMALL)).unwrap());
    // The early end is before all stages, between two stages, or there are no stages; with and without given policies.
    let late = "[[stages]]\nfrom = 6\nset = { 'world.coupling' = 3 }\n";
    let cases = [(late, None), (late, init.clone()), (STAGES, init.clone()), ("", init)];
    for (number, (stages, init)) in cases.into_iter().enumerate() {
        let config = config(&[SMALL, stages].concat());
        let [whole, done, killed] =
            ["whole", "done", "killed"].map(|name| place.path().join(format!("{number}-{name}")));
        let last = train_shorter(&config, &done, init.clone(), 3, true);
        assert_eq!(last, 3);
        let mut shorter = config.clone();
        shorter.learning.generations = 3;
        assert_eq!(Config::load(&done.join("config.toml")).unwrap(), shorter);
        let expected = train(&shorter, &whole, init.clone(), Start::Fresh, 99).unwrap();
        assert_eq!(train(&shorter, &done, None, Start::Resume, 99).unwrap(), expected, "{number}");
        let mut backend = Cpu::default();
        let replayed = replay(&done, 0, &[1, 3], Which::Best, Verification::Required, &mut backend, &mut |_| true);
        assert_eq!(replayed.unwrap_or_else(|error| panic!("{number}: {error}")).len(), 2);
        // Killed between the request to end early and the last generation.
        train_shorter(&config, &killed, init.clone(), 3, false);
        let (session, notes) =
            Session::open(vec![(shorter.clone(), killed.clone())], Start::Resume, &Disk::default()).unwrap();
        assert!(notes.iter().all(|(_, note)| !note.is_damage), "{number}: {notes:?}");
        drop(session);
        assert_eq!(train(&shorter, &killed, None, Start::Resume, 99).unwrap(), expected, "{number}");
        // Both can be extended.
        let mut longer = shorter.clone();
        longer.learning.generations = 7;
        let expected =
            train(&longer, &place.path().join(format!("{number}-longer")), init.clone(), Start::Fresh, 99).unwrap();
        for path in [&done, &killed] {
            let extended = train(&longer, path, None, Start::Resume, 99).unwrap();
            assert_eq!(extended.map(|results| results.digest), expected.as_ref().map(|results| results.digest.clone()));
        }
    }
    // Without its checkpoints, a warm-started run cannot be replayed.
    let done = place.path().join("3-done");
    fs::remove_dir_all(done.join("checkpoints")).unwrap();
    let error = replay(&done, 0, &[2], Which::Best, Verification::Required, &mut Cpu::default(), &mut |_| true);
    let error = error.err().unwrap().to_string();
    assert!(error.contains("started from given policies"), "{error}");
}

/// The first stage begins at generation 0, so it replaces the world of the file.
#[test]
fn verify_plays_the_world_of_the_first_stage() {
    let config = config(&format!("{SMALL}[[stages]]\nfrom = 0\nset = {{ 'world.steps' = 17 }}\n"));
    let worlds = vec![("at once".to_string(), config.clone())];
    let plan = verify::Plan { worlds, teams: 3, seed: 0, generations: 1 };
    let found = verify::compare(&plan, &mut Cpu::default(), &mut Cpu::default(), |_| {}).unwrap();
    let agents = (config.world.leaders.len() + config.world.followers.len()) as u64;
    assert!(found.mismatch.is_none() && config.world.steps != 17);
    // Each team plays 8 times: traced, recorded, and once for each of six kinds of scores.
    assert_eq!(found.agent_steps, 8 * 3 * agents * 17);
}

/// Creates a folder with three configs: without sharing, with a shared policy, and with more leaders that share one.
fn place() -> Place {
    let shared = SMALL.replace("population = 8", "population = 8\nsharing = 'all'");
    let more = shared.replace("[[10, 5], [20, 5]]", "[[10, 5], [20, 5], [40, 5]]").replace("trials = 3", "trials = 2");
    let more = more.replace("population = 8", "population = 12");
    Place::new(&[("small.toml", SMALL), ("shared.toml", &shared), ("more.toml", &more)]).on_cpu().slow()
}

#[test]
fn a_shared_policy_fits_any_number_of_leaders() {
    let place = place();
    let good = |line: &str| place.good(line).0;
    good("train shared.toml --out run");
    let bytes = place.bytes("run/policies.safetensors");
    let tensors = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    assert_eq!(tensors.tensor("weights.1").unwrap().shape(), [1, 8, 57]);
    // The file fits its own config, one without sharing, and one with more leaders.
    let own = good("rollout shared.toml --policies run/policies.safetensors --scores own.csv");
    assert_eq!(good("rollout small.toml --policies run/policies.safetensors --scores other.csv"), own);
    assert_eq!(place.read("own.csv"), place.read("other.csv"));
    good("rollout more.toml --policies run/policies.safetensors --scores more.csv");
    assert_eq!(place.read("more.csv").lines().count(), 1 + 8 * 3);
    // Training can start from it with a larger population and more leaders that share a policy.
    good("train more.toml --out warm --init run/policies.safetensors");
    good("replay warm --generation 1 --out replay.html");
    let few = "train shared.toml --population 3 --out few --init run/policies.safetensors";
    place.notes(few, &["8 policies of each leader; only the first 3 are used"]);
    let cold = "train small.toml --out cold --init";
    let reason = "weights.0 is F32 [1, 8, 57], but the config needs F32 [2, 1 to 1048576, 57]";
    let stderr = place.fails(1, &format!("{cold} run/policies.safetensors"), &[reason, "of another config"]);
    assert!(stderr.lines().count() == 1 && !stderr.contains("restore"), "{stderr}");
    // Every trial needs policies of its own.
    let more = "train shared.toml --trials 4 --out cold --init run/policies.safetensors";
    place.fails(1, more, &["it has no tensor weights.3; it has weights.0"]);
    let stderr = place.refused(1, &format!("{cold} small.toml"));
    assert!(stderr.starts_with("error: small.toml: ") && stderr.lines().count() == 1, "{stderr}");
    place.fails(1, &format!("{cold} missing.safetensors"), &["missing.safetensors: cannot be read"]);
    assert!(!place.path("cold").exists());
    assert_eq!(Config::load(&place.path("run/config.toml")).unwrap().learning.sharing, Sharing::Shared);
}

#[test]
fn all_problems_of_a_stage_are_counted() {
    let keys: String = (0..60).map(|key| format!("\"world.no_{key}\" = 1\n")).collect();
    let text = format!("{SMALL}\n[[stages]]\nfrom = 1\n[stages.set]\n{keys}");
    let error = Config::parse(&text, "many.toml").unwrap_err().to_string();
    assert!(error.starts_with("60 problems in many.toml\n") && error.ends_with("\n… and 10 more"), "{error}");
}

#[test]
fn every_command_supports_stages() {
    let place = place();
    place.write("staged.toml", [SMALL, STAGES].concat());
    let good = |line: &str| place.good(line).0;
    let report = good("train staged.toml --out run");
    assert!(report.contains("\n  start, stage 0  ") && report.contains("\n  generation 6, stage 2  "), "{report}");
    // Generations of all stages can be replayed.
    for generation in [1, 2, 3, 4, 6] {
        good(&format!("replay run --generation {generation} --out replay.html"));
    }
    place.fails(2, "replay run --generation 6 --compare 1", &["different stages"]);
    good("plot run --out curves.svg");
    let curves = place.read("curves.svg");
    assert!(curves.contains("Stage 1 begins at generation 2. Stage 2 begins at generation 4."), "{curves}");
    // A plot of several runs shows only stages that all have. A plot of a stopped run shows only the stages it reached.
    let rows = place.read("run/metrics.csv");
    let short: String = rows.split_inclusive('\n').take(1 + 3 * 3).collect();
    good("train small.toml --out plain");
    good("plot run plain --out both.svg");
    assert!(!place.read("both.svg").contains("begins at"));
    place.write("run/metrics.csv", short);
    good("plot run --unverified --out short.svg");
    let curves = place.read("short.svg");
    assert!(curves.contains("Stage 1 begins") && !curves.contains("Stage 2 begins"), "{curves}");
    place.write("run/metrics.csv", rows.split_once('\n').unwrap().1);
    let parts = ["line 1 is not trial,", "test_g and stage if the config"];
    place.fails(1, "plot run --unverified --out short.svg", &parts);
    place.write("run/metrics.csv", rows);
    let rollout = "rollout staged.toml --policies run/policies.safetensors";
    good(rollout);
    place.prints(&format!("{rollout} --stage 2"), &["of 3"]);
    place.fails(2, &format!("{rollout} --stage 3"), &["the config has 3 stages, 0 to 2"]);
    // A flag counts after the stage's own keys. Stages beyond the end can be played, too.
    let jitters = ["", " --poi-jitter 3.0"].map(|flag| {
        let found = place.json(&format!("{rollout} --json --episodes 2 --stage 2{flag}"));
        assert_eq!(found["stage"], 2);
        (found["pois"].as_u64(), found["poi_jitter"].as_f64())
    });
    assert_eq!(jitters, [(Some(3), Some(1.0)), (Some(3), Some(3.0))]);
    place.prints(&format!("{rollout} --episodes 2 --stage 2"), &["2 episodes each, POIs moved by up to 1 (seed 0)."]);
    good(&format!("{rollout} --set learning.generations=3 --stage 2"));
    let (text, stderr) = place.good("baseline staged.toml --seeds 1 --episodes 1");
    assert!(text.contains("of 2") && stderr.contains("note: this plays in the world before any stage"), "{stderr}");
    place.prints("baseline staged.toml --seeds 1 --episodes 1 --stage 2", &["of 3"]);
    // 27 teams play 9 steps in 2 generations, two episodes of 14 steps in 2 generations, and 9 steps in 3.
    let text = good("check staged.toml");
    let steps = text.lines().find_map(|line| line.strip_prefix("#   team-steps")).map(str::trim);
    assert_eq!(steps, Some(format!("{}", 27 * (2 * 9 + 2 * 2 * 14 + 3 * 9)).as_str()), "{text}");
    // Notes name their stage, and flags that a stage overrides.
    let noted = "[[stages]]\nfrom = 2\nset = { world.heading = 90, world.coupling = 1 }\n";
    place.write("noted.toml", [SMALL, noted].concat());
    let (_, stderr) = place.good("check noted.toml --set world.coupling=2 --set world.steps=9");
    assert!(stderr.contains("--set world.coupling: the stage from generation 2 on sets this, too"), "{stderr}");
    assert!(stderr.contains("note: stage 1: world.heading has 90"), "{stderr}");
    assert!(!stderr.contains("--set world.steps"), "{stderr}");
    // If --generations ends the run before a stage, either config can resume or extend it.
    let never = "note: the stage from generation 4 on is never played";
    place.notes("train staged.toml --generations 3 --out short --quiet", &[never]);
    good("train staged.toml --generations 3 --out short --resume");
    good("train short/config.toml --out short --resume --generations 4");
    let report = good("train staged.toml --out short --resume");
    assert!(report.starts_with("Trained 3 trials of 8 teams, 2 generations after generation 4, in "), "{report}");
    assert!(policy_bytes(&place.path("short")) == policy_bytes(&place.path("run")));
    // The same with sweeps, whose points tell what a stage overrides.
    let grid = "[grid]\n'world.coupling' = [1, 2]\n";
    place.write("sweep.toml", [SMALL, STAGES, grid].concat());
    let note = "grid.\"world.coupling\"[1]: the stage from generation 2 on sets this, too";
    let notes = [note, "4 on is never played, because", "at 2 of 2 points"];
    place.notes("sweep sweep.toml --generations 3 --out swept", &notes);
    good("compare swept");
    good("sweep swept/sweep.toml --out swept --resume");
    place.fails(2, "train staged.toml --set stages=[{from=true}]", &["--set stages: stages[0].from: found"]);
}
