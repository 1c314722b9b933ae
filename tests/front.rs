//! The library's functions give the program's results, and refuse wrong input without a panic.

#![cfg(feature = "cli")]

mod support;

use std::fs;
use std::ops::ControlFlow::{Break, Continue};
use std::path::Path;

use flotilla::Config;
use flotilla::backend::cpu::Cpu;
use flotilla::backend::{Backend, Group};
use flotilla::config::Sharing;
use flotilla::config::{Fitness, MAX_AGENTS, MAX_POPULATION, MAX_STEPS, Stage};
use flotilla::evaluate::Starts;
use flotilla::front::{self, Failure, Processor, Trained};
use flotilla::record::digests::Verification;
use flotilla::record::disk::Disk;
use flotilla::record::folder::Start;
use flotilla::record::policies::{self, Init, Policies};
use flotilla::run::{Ended, Options, Session};
use flotilla::sample;
use flotilla::stepping::StepError;
use flotilla::world::World;

#[path = "../examples/play.rs"]
mod play;
#[path = "../examples/step.rs"]
mod step;
#[path = "../examples/train.rs"]
mod train;

#[test]
fn the_examples_run() {
    train::main().expect("it trains");
    play::main().expect("it plays");
    step::main().expect("it steps");
}

/// A random world that trains quickly.
fn config(seed: u64) -> Config {
    let mut config = sample::world(seed);
    (config.learning.generations, config.learning.trials) = (6, 3);
    config
}

/// The program's result for a config in a folder.
fn recorded(config: &Config, folder: &Path) -> String {
    recorded_from(config, folder, None)
}

fn recorded_from(config: &Config, folder: &Path, init: Option<Init>) -> String {
    let runs = vec![(config.clone(), folder.to_path_buf(), init)];
    let (mut session, _) = Session::open_from(runs, Start::Fresh, &Disk::default()).expect("the folder is free");
    let none = std::sync::atomic::AtomicBool::default();
    let ended = session.train(
        &mut front::cpu(),
        &mut Options {
            command: "",
            stop: &none,
            save: &none,
            instead: &mut |_| None,
            setback: &mut |_| (),
            watch: &mut |_| (),
        },
    );
    assert_eq!(ended.expect("it trains"), Ended::Done);
    session.results(0).expect("it is done").digest.clone()
}

#[test]
fn champions_are_given_without_changing_the_training() {
    let mut config = Config::parse(include_str!("../configs/chaotic.toml"), "chaotic.toml").expect("it is valid");
    (config.learning.generations, config.learning.trials) = (6, 3);
    let mut told = Vec::new();
    let watch = |generation: front::Generation<'_>| {
        told.push(generation.champions.expect("they were asked for").to_vec());
        Continue(())
    };
    let trained = front::train_with_champions(&config, &mut Cpu::default(), watch).expect("it trains");
    assert_eq!(trained, flotilla::train(&config, &mut Cpu::default(), |_| Continue(())).expect("it trains"));
    let (population, parameters) = (config.learning.population, config.parameters());
    let populations = trained.policies.iter().flat_map(|trial| trial.chunks(population * parameters));
    let best: Vec<f32> = populations.flat_map(|policies| policies[..parameters].to_vec()).collect();
    assert_eq!(told.len(), 7);
    assert_eq!(told[6], best);
    // Otherwise, the champions of the generation before would pass, too.
    assert_ne!(told[5], best);
}

#[test]
fn training_comes_to_what_a_run_comes_to() {
    let folder = tempfile::tempdir().expect("a folder for runs");
    for seed in 0..6 {
        let (config, path) = (config(seed), folder.path().join(seed.to_string()));
        let mut told = Vec::new();
        let trained = flotilla::train(&config, &mut Cpu::default(), |generation| {
            assert_eq!((generation.last, generation.rows.len()), (6, 3));
            told.extend(generation.rows.iter().map(|row| (generation.generation, row.trial, row.champion_g)));
            Continue(())
        });
        let trained = trained.unwrap_or_else(|error| panic!("seed {seed}: {error}"));
        let expected = (0..7).flat_map(|generation| (0..3).map(move |trial| (generation, trial)));
        let expected =
            expected.map(|(generation, trial)| (generation, trial, trained.champion_g[trial * 7 + generation]));
        assert_eq!(told, expected.collect::<Vec<_>>(), "seed {seed}");
        assert_eq!(trained.digest(), recorded(&config, &path), "seed {seed}");
        assert_eq!(Trained::read(&path, Verification::Required).expect("the run is whole"), trained, "seed {seed}");
    }
    assert!(matches!(Trained::read(folder.path(), Verification::Required), Err(Failure::Run(_))));

    // A row that is missing, and two that changed places.
    let (run, path) = (folder.path().join("0"), folder.path().join("0/metrics.csv"));
    let rows = fs::read_to_string(&path).expect("the run has metrics");
    let mut lines: Vec<&str> = rows.lines().collect();
    let read = |lines: &[&str]| {
        fs::write(&path, lines.join("\n") + "\n").expect("the folder can be written");
        Trained::read(&run, Verification::Skipped).expect_err("rows are not as they were").to_string()
    };
    let short = read(&lines[..lines.len() - 1]);
    assert!(short.contains("metrics.csv has 20 rows of 21"), "{short}");
    let late = lines[lines.len() - 1].replacen("2,6,", "2,7,", 1);
    let late = read(&[&lines[..], &[&late]].concat());
    assert!(late.contains("line 23 is trial 2, generation 7, which the run's config.toml does not have"), "{late}");
    let more = read(&[&lines[..], &lines[lines.len() - 1..]].concat());
    assert!(more.contains("it must have one row per trial and generation, in order"), "{more}");
    lines.swap(1, 4);
    let mixed = read(&lines);
    assert!(mixed.contains("it must have one row per trial and generation, in order"), "{mixed}");
    // Policies of another run: fewer of each leader, and of another network.
    lines.swap(1, 4);
    fs::write(&path, lines.join("\n") + "\n").expect("the folder can be written");
    assert!(Trained::read(&run, Verification::Required).is_ok());
    let config = config(0);
    for (change, told) in [
        ((|config| config.learning.population += 1) as fn(&mut Config), "policies of each leader, not"),
        (|config| config.policy.hidden = vec![9, 9], "but the config needs F32"),
    ] {
        let mut other = config.clone();
        change(&mut other);
        let trained = flotilla::train(&other, &mut Cpu::default(), |_| Continue(())).expect("it trains");
        policies::write(&Disk::default(), &run.join("policies.safetensors"), &other, &trained.policies).unwrap();
        let error = Trained::read(&run, Verification::Required).expect_err("they are of another run").to_string();
        assert!(error.contains("policies.safetensors: ") && error.contains(told), "{error}");
    }
}

#[test]
fn a_training_that_is_stopped_is_one_of_fewer_generations() {
    for (seed, after) in [(3, 0), (4, 2), (5, 4), (6, 5), (7, 6)] {
        let config = config(seed);
        let mut calls = 0;
        let stopped = flotilla::train(&config, &mut Cpu::default(), |generation| {
            calls += 1;
            if generation.generation == after { Break(()) } else { Continue(()) }
        });
        let stopped = stopped.unwrap_or_else(|error| panic!("seed {seed}: {error}"));
        assert_eq!((stopped.config.learning.generations, calls), (6.min(after + 2), after + 1), "after {after}");
        let whole = flotilla::train(&stopped.config, &mut Cpu::default(), |_| Continue(()));
        assert_eq!(whole.unwrap_or_else(|error| panic!("seed {seed}: {error}")), stopped, "after {after}");
    }
    // Nor does a stage that begins where it ends make it longer.
    let mut config = config(3);
    let stage = |from| Stage { from, set: [("world.steps".to_string(), toml::Value::from(60))].into() };
    config.stages = vec![stage(2), stage(5)];
    for after in 0..=6 {
        let stopped = flotilla::train(&config, &mut Cpu::default(), |generation| {
            if generation.generation == after { Break(()) } else { Continue(()) }
        });
        let stopped = stopped.unwrap_or_else(|error| panic!("{error}"));
        let begun = [2, 5].into_iter().filter(|from| *from <= 6.min(after + 2)).count();
        assert_eq!((stopped.config.learning.generations, stopped.config.stages.len()), (6.min(after + 2), begun));
        let whole = flotilla::train(&stopped.config, &mut Cpu::default(), |_| Continue(()));
        assert_eq!(whole.unwrap_or_else(|error| panic!("{error}")), stopped, "stages, after {after}");
    }
}

#[test]
fn a_training_starts_from_given_policies() {
    let config = config(5);
    let learned = flotilla::train(&config, &mut Cpu::default(), |_| Continue(())).unwrap();
    let policies = config.learning.population;
    let from = |policies: usize, first: &[Vec<f32>]| {
        flotilla::front::train_from(&config, &mut Cpu::default(), policies, first, |_| Continue(()))
    };
    let warm = from(policies, &learned.policies).unwrap();
    let trials = learned.policies.iter().map(|weights| Policies { policies, weights: weights.clone() }).collect();
    let folder = tempfile::tempdir().unwrap();
    let init = Init { digest: "of no file".into(), trials };
    assert_eq!(warm.digest(), recorded_from(&config, folder.path(), Some(init)));
    assert_ne!(warm.digest(), learned.digest());
    let columns = config.learning.generations + 1;
    assert_eq!(from(policies, &learned.policies[..1]).unwrap().best_g[..columns], warm.best_g[..columns]);
    for wrong in [0, policies - 1, policies + 1, usize::MAX, usize::MAX / config.parameters()] {
        assert!(matches!(from(wrong, &learned.policies), Err(Failure::Weights { teams, .. }) if teams == wrong));
    }
    assert!(matches!(from(0, &[vec![]]), Err(Failure::Weights { found: 0, .. })));
    let [two, four] = [learned.policies[..2].to_vec(), [&learned.policies[..], &learned.policies[..1]].concat()];
    for (found, given) in [(2, two), (4, four)] {
        let error = from(policies, &given).expect_err("three trials are trained").to_string();
        assert!(error.starts_with(&format!("policies of {found} trials, where 3 are trained; ")), "{error}");
    }
    let mut wrong = learned.policies.clone();
    wrong[1][3] = f32::NAN;
    assert!(matches!(from(policies, &wrong), Err(Failure::Weight { leader: 0, team: 0, parameter: 3, .. })));
}

#[test]
fn given_policies_are_played_and_traced_team_by_team() {
    let mut backend = Cpu::default();
    for seed in 0..12 {
        let (config, teams) = (sample::world(seed), 1 + seed as usize * 3);
        let world = World::new(&config);
        let (leaders, parameters) = (world.leaders(), world.parameters());
        let starts = Starts::Drawn { episodes: 5, seed, jitter: 0.4, poi_jitter: 0.0 };
        let weights = sample::weights(&world, teams, seed);
        let played = flotilla::play(&config, &mut backend, teams, &weights, &starts).expect("they fit");
        let sizes = [&played.d, &played.df, &played.dpp].map(Vec::len);
        assert_eq!((played.observed.len(), played.g.len(), sizes), (teams, teams, [teams * leaders; 3]));

        // A team by itself comes to what it comes to among others; so does a policy that leaders share.
        let team = teams - 1;
        let own = |leader: usize| &weights[(leader * teams + team) * parameters..][..parameters];
        let alone: Vec<f32> = (0..leaders).flat_map(own).copied().collect();
        let by_itself = flotilla::play(&config, &mut backend, 1, &alone, &starts).expect("they fit");
        assert_eq!(
            (by_itself.g[0], &by_itself.dpp[..]),
            (played.g[team], &played.dpp[team * leaders..]),
            "seed {seed}"
        );
        let shared = flotilla::play(&config, &mut backend, 1, own(0), &starts).expect("they fit");
        let written = flotilla::play(&config, &mut backend, 1, &own(0).repeat(leaders), &starts).expect("they fit");
        assert_eq!(shared, written, "seed {seed}");

        let traced = flotilla::trace(&config, &mut backend, teams, &weights, &starts, 3).expect("they fit");
        let from = starts.of(3, &world);
        let order: Vec<u32> = (0..teams as u32).flat_map(|team| vec![team; leaders]).collect();
        let group = Group {
            world: &world,
            starts: &from,
            weights: weights[..].into(),
            policies: teams,
            sharing: Sharing::PerLeader,
            teams: &order,
            fitnesses: &[],
        };
        let trace = backend.trace(&group).expect("it fits");
        let (agents, steps) = (world.agents(), world.steps());
        for (step, team, agent) in
            [(0, 0, 0), (steps, team, agents - 1), (steps / 2, team, agents / 2), (1, team, leaders - 1)]
        {
            let moment = trace.moment(step, team, agent);
            let at = (team * (steps + 1) + step) * agents + agent;
            assert_eq!(traced.positions[at * 2..][..2], moment.position, "seed {seed}");
            assert_eq!(traced.headings[at * 2..][..2], moment.heading, "seed {seed}");
            assert_eq!(traced.speeds[at], moment.speed, "seed {seed}");
            if agent < leaders && step > 0 {
                let at = (team * steps + step - 1) * leaders + agent;
                assert_eq!(traced.inputs[at * 8..][..8], moment.inputs, "seed {seed}");
                assert_eq!(traced.outputs[at * 2..][..2], moment.outputs, "seed {seed}");
            }
        }
        assert_eq!(traced.near, trace.sets, "seed {seed}");
        let lengths = [traced.positions.len(), traced.headings.len(), traced.speeds.len() * 2];
        assert_eq!(lengths, [teams * (steps + 1) * agents * 2; 3]);
        assert_eq!([traced.inputs.len() / 8, traced.outputs.len() / 2], [teams * steps * leaders; 2]);
    }
}

#[test]
fn what_is_wrong_is_told() {
    let config = sample::world(1);
    let (leaders, parameters) = (config.learners(), config.parameters());
    let mut backend = Cpu::default();
    let good = vec![0.5; leaders * 2 * parameters];
    let mut play = |config: &Config, teams, weights: &[f32], starts| {
        let traced = flotilla::trace(config, &mut backend, teams, weights, &starts, 0).map(drop);
        let played = flotilla::play(config, &mut backend, teams, weights, &starts).map(drop);
        assert_eq!(played.as_ref().map_err(ToString::to_string), traced.as_ref().map_err(ToString::to_string));
        played
    };
    play(&config, 2, &good, Starts::Own).expect("it is good");
    assert!(matches!(play(&config, 0, &[], Starts::Own), Err(Failure::Teams(0))));
    assert!(matches!(play(&config, usize::MAX, &good, Starts::Own), Err(Failure::Teams(_))));
    assert!(matches!(play(&config, 2, &good[1..], Starts::Own), Err(Failure::Weights { teams: 2, .. })));
    let more = [&good[..], &[0.5]].concat();
    assert!(matches!(play(&config, 2, &more, Starts::Own), Err(Failure::Weights { teams: 2, .. })));
    assert!(matches!(play(&config, 5, &[], Starts::Own), Err(Failure::Weights { found: 0, .. })));
    for (bad, fine) in [(f32::NAN, false), (f32::INFINITY, false), (2e6, false), (1e-20, true), (-0.0, true)] {
        let mut weights = good.clone();
        weights[(leaders * 2 - 1) * parameters + 3] = bad;
        match play(&config, 2, &weights, Starts::Own) {
            Ok(()) => assert!(fine, "{bad}"),
            Err(Failure::Weight { leader, team, parameter, .. }) => {
                assert!(!fine && (leader, team, parameter) == (leaders - 1, 1, 3), "{bad}");
            }
            Err(error) => panic!("{bad}: {error}"),
        }
    }
    for (episodes, jitter) in [(0, 0.1), (u32::MAX, 0.1), (1, f64::NAN), (1, f64::INFINITY), (1, -0.1)] {
        let drawn = Starts::Drawn { episodes, seed: 1, jitter, poi_jitter: 0.0 };
        assert!(matches!(play(&config, 2, &good, drawn), Err(Failure::Starts { .. })), "{episodes}, {jitter}");
        let moved = Starts::Drawn { episodes, seed: 1, jitter: 0.1, poi_jitter: jitter };
        assert!(matches!(play(&config, 2, &good, moved), Err(Failure::Starts { .. })), "{episodes}, POIs by {jitter}");
    }

    let drawn = Starts::Drawn { episodes: 2, seed: 1, jitter: 0.1, poi_jitter: 0.0 };
    let trace = |episode| flotilla::trace(&config, &mut Cpu::default(), 2, &good, &drawn, episode);
    trace(1).expect("it is the last");
    assert!(matches!(trace(2), Err(Failure::NoEpisode { episode: 2, episodes: 2 })));

    // All steps of a million large teams are more than any machine has.
    let followers = "[1, 1], ".repeat(MAX_AGENTS - 1);
    let text = format!(
        "[world]\nleaders = [[2, 2]]\nfollowers = [{followers}]\npois = [[9, 9]]\nsteps = {MAX_STEPS}\n[policy]\nhidden = []"
    );
    let large = Config::parse(&text, "large.toml").expect("all is within bounds");
    let weights = vec![0.5; large.parameters() * MAX_POPULATION];
    let traced = flotilla::trace(&large, &mut Cpu::default(), MAX_POPULATION, &weights, &Starts::Own, 0);
    assert!(matches!(traced, Err(Failure::Memory { what: "all steps of all teams", .. })));

    // Configs built by hand are checked like files.
    let broken: [fn(&mut Config); 6] = [
        |config| config.policy.hidden = vec![3; 9],
        |config| config.world.leaders.clear(),
        |config| config.world.dt = f64::NAN,
        |config| config.world.pois = vec![[-1.0, 0.0]],
        |config| config.learning.population = 0,
        |config| config.learning.seed = u64::MAX,
    ];
    for (index, break_it) in broken.into_iter().enumerate() {
        let mut config = config.clone();
        break_it(&mut config);
        let refused = |error| matches!(error, Failure::Config(_));
        assert!(refused(play(&config, 2, &good, Starts::Own).expect_err("it is broken")), "{index}");
        let trained = flotilla::train(&config, &mut Cpu::default(), |_| Continue(()));
        assert!(refused(trained.expect_err("it is broken")), "{index}");
        assert!(flotilla::stepper(&config, 1, false).is_err_and(refused), "{index}");
    }
    assert!(matches!(flotilla::stepper(&config, 0, true), Err(Failure::Step(StepError::Teams(0)))));
    // Sights are kept where they are asked for.
    let mut led = support::layout("generally_forward");
    for (fitness, kept) in [(Fitness::Df, false), (Fitness::Dt, true)] {
        led.learning.fitness = fitness;
        let stepper = flotilla::stepper(&led, 2, true).expect("two teams are few");
        assert_eq!(stepper.fitness(Fitness::Dt, &mut [0.0; 8]).is_ok(), kept, "{fitness}");
    }
}

#[test]
fn a_processor_is_found() {
    let ((backend, machine), passed_over) = flotilla::open(&Processor::Cpu).expect("it is always there");
    assert!(backend.describe().starts_with("cpu") && machine.backend == "cpu" && passed_over.is_none());
    let error = flotilla::open(&Processor::Adapter("no such adapter".into())).err().expect("there is none");
    assert!(error.to_string().contains("no such adapter"), "{error}");
}

/// The command line names the flag that helps.
#[test]
fn errors_of_the_library_speak_of_no_flags() {
    fn walk(folder: &Path, found: &mut Vec<String>) {
        for entry in fs::read_dir(folder).expect("a folder of sources") {
            let path = entry.expect("its entries").path();
            if path.is_dir() {
                if !path.ends_with("src/cli") {
                    walk(&path, found);
                }
                continue;
            }
            let Ok(text) = fs::read_to_string(&path) else { continue };
            for error in text.split("#[error(").skip(1) {
                let error = error.split(")]").next().unwrap_or_default();
                let flag = error.split("--").skip(1).any(|rest| rest.starts_with(|c: char| c.is_ascii_lowercase()));
                if flag || error.contains("`flotilla") {
                    found.push(format!("{}: {error}", path.display()));
                }
            }
        }
    }
    let mut found = Vec::new();
    walk(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src"), &mut found);
    assert_eq!(found, Vec::<String>::new());
}
