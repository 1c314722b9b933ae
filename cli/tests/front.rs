//! Tests that the library's functions give the program's results, and that invalid input returns an error.

use crate::support;
use std::fs;
use std::ops::ControlFlow::{Break, Continue};
use std::path::Path;

use flotilla::Config;
use flotilla::backend::cpu::Cpu;
use flotilla::backend::{Backend, Group};
use flotilla::config::own_populations;
use flotilla::config::{Fitness, MAX_LEARNERS, MAX_POPULATION, MAX_STEPS, Stage};
use flotilla::evaluate::Starts;
use flotilla::evolve::aligned_teams;
use flotilla::front::{self, Coevolution, Failure, Processor};
use flotilla::sample;
use flotilla::stepping::StepError;
use flotilla::world::World;
use flotilla_app::record::checkpoint;
use flotilla_app::record::digests::Verification;
use flotilla_app::record::disk::Disk;
use flotilla_app::record::folder::{Start, StartFrom};
use flotilla_app::record::policies::{self, Init, Policies};
use flotilla_app::record::runs;
use flotilla_app::run::{Session, SessionEnd};

#[path = "../../app/examples/play.rs"]
mod play;
#[path = "../../app/examples/step.rs"]
mod step;
#[path = "../../app/examples/train.rs"]
mod train;

#[test]
fn the_examples_run() {
    train::main().expect("the train example runs");
    play::main().expect("the play example runs");
    step::main().expect("the step example runs");
}

/// A random world that trains quickly.
fn config(seed: u64) -> Config {
    let mut config = sample::world(seed);
    (config.learning.generations, config.learning.trials) = (6, 3);
    config
}

/// Trains a config as the program does, in this directory. Returns the digest.
fn run_digest(config: &Config, folder: &Path) -> String {
    run_digest_from(config, folder, None)
}

fn run_digest_from(config: &Config, folder: &Path, init: Option<Init>) -> String {
    let runs = vec![(config.clone(), folder.to_path_buf(), init)];
    let (mut session, _) = Session::open_from(runs, StartFrom::Unspecified, Start::Fresh, &Disk::default())
        .expect("the directory is empty");
    let ended = support::train(&mut session, front::cpu(), &mut |_| None, &mut |_| false);
    assert_eq!(ended.expect("training succeeds"), SessionEnd::Finished);
    session.results(0).expect("the run is finished").digest.clone()
}

#[test]
fn requesting_champions_does_not_change_training() {
    let mut config = Config::parse(include_str!("../../configs/chaotic.toml"), "chaotic.toml").expect("a valid config");
    (config.learning.generations, config.learning.trials) = (6, 3);
    let mut champions = Vec::new();
    let watch = |generation: front::Generation<'_>| {
        champions.push(generation.champions.expect("champions were requested").to_vec());
        Continue(())
    };
    let trained = front::train_with_champions(&config, &mut Cpu::default(), watch).expect("training succeeds");
    assert_eq!(trained, flotilla::train(&config, &mut Cpu::default(), |_| Continue(())).expect("training succeeds"));
    let (population, parameters) = (config.learning.population, config.parameters());
    let populations = trained.policies.iter().flat_map(|trial| trial.chunks(population * parameters));
    let best: Vec<f32> = populations.flat_map(|policies| policies[..parameters].to_vec()).collect();
    assert_eq!(champions.len(), 7);
    assert_eq!(champions[6], best);
    // Without this, champions of the previous generation would pass, too.
    assert_ne!(champions[5], best);
}

/// If the last champions could not be played, only they are left, and no team has to be scored.
#[test]
fn coevolution_continues_with_the_last_champions_alone() {
    let (config, mut backend) = (config(0), Cpu::default());
    let new = || Coevolution::new(&config).expect("a valid config");
    let mut coevolution = new();
    while !coevolution.is_done() {
        coevolution.tell(&mut backend, None).expect("training succeeds");
    }
    let expected = coevolution.finish().expect("all generations were played");
    let mut state = coevolution.state().expect("there is enough memory");
    state.snapshot.generation -= 1;
    state.rows.truncate(config.learning.generations * config.learning.trials);
    let mut restored = new();
    restored.restore(state).expect("the state is of this config");
    assert_eq!(restored.play(&mut backend).expect("the champions play"), (vec![], vec![]));
    restored.tell(&mut backend, None).expect("training succeeds");
    assert_eq!(restored.finish().expect("all generations were played"), expected);
}

#[test]
fn policies_cannot_be_replaced_once_they_were_played() {
    let (config, mut backend) = (config(1), Cpu::default());
    let first = flotilla::train(&config, &mut backend, |_| Continue(())).expect("training succeeds").policies;
    let mut coevolution = Coevolution::new(&config).expect("a valid config");
    coevolution.start_from(config.learning.population, &first).expect("the policies fit");
    coevolution.play(&mut backend).expect("the policies play");
    let refused = coevolution.start_from(config.learning.population, &first);
    assert!(matches!(refused, Err(Failure::State)), "{refused:?}");
}

#[test]
fn policies_of_one_wrong_trial_change_no_trial() {
    let (config, mut backend) = (config(1), Cpu::default());
    let mut first = flotilla::train(&config, &mut backend, |_| Continue(())).expect("training succeeds").policies;
    *first.last_mut().and_then(|trial| trial.last_mut()).expect("there are policies") = f32::NAN;
    let new = || Coevolution::new(&config).expect("a valid config");
    let before = new().state().expect("there is enough memory").snapshot.weights;
    let mut coevolution = new();
    let refused = coevolution.start_from(config.learning.population, &first);
    assert!(matches!(refused, Err(Failure::Weight { .. })), "{refused:?}");
    assert_eq!(coevolution.state().expect("there is enough memory").snapshot.weights, before);
}

/// Credits are means over the episodes that were played.
#[test]
fn an_evaluation_that_is_stopped_has_the_scores_of_its_episodes() {
    let text = include_str!("../../configs/chaotic.toml");
    let alone = text.replace("coupling = 5", "coupling = 1");
    assert_ne!(alone, text);
    let mut config = Config::parse(&alone, "chaotic.toml").expect("a valid config");
    config.learning.fitness = Fitness::Dt;
    let weights = vec![0.5; config.populations() * config.parameters()];
    let play = |episodes, stops: bool| {
        let (starts, mut played) = (Starts::Drawn { episodes, seed: 0, jitter: 3.0, poi_jitter: 0.0 }, 0);
        let mut each = |batch: flotilla::evaluate::Batch<'_>| {
            played += batch.observed.len() as u32;
            if stops && played > 0 { Break(()) } else { Continue(()) }
        };
        let found = front::play_until(&config, &mut Cpu::default(), 1, &weights, &starts, &mut each);
        (found.expect("the policies play"), played)
    };
    let (stopped, played) = play(100_000, true);
    assert!((1..100_000).contains(&played), "{played}");
    let (whole, _) = play(played, false);
    let scores = |found: &flotilla::evaluate::Evaluation, leader| (found.scores(0, leader), found.dt(0, leader));
    let leaders = config.learners();
    assert!((0..leaders).any(|leader| scores(&whole, leader).0[2] > 0.0));
    (0..leaders).for_each(|leader| assert_eq!(scores(&stopped, leader), scores(&whole, leader), "leader {leader}"));
}

#[test]
fn a_finished_run_has_no_ending_without_its_own_last_checkpoint() {
    let folder = tempfile::tempdir().expect("a folder for runs");
    let [own, other] = ["own", "other"].map(|name| folder.path().join(name));
    let config = config(0);
    let mut other_config = config.clone();
    other_config.learning.seed += 1;
    run_digest(&config, &own);
    run_digest(&other_config, &other);
    let last = |run: &Path| checkpoint::path(&run.join("checkpoints"), 7);
    let read = || runs::trained(&own, Verification::Required).expect("the run is complete");
    let mut expected = read();
    assert!(expected.ending.take().is_some());
    fs::copy(last(&other), last(&own)).expect("both runs have a last checkpoint");
    assert_eq!(read(), expected);
    fs::remove_file(last(&own)).expect("the file was just written");
    assert_eq!(read(), expected);
}

#[test]
fn train_gives_the_results_of_a_recorded_run() {
    let folder = tempfile::tempdir().expect("a folder for runs");
    for seed in 0..6 {
        let (config, path) = (config(seed), folder.path().join(seed.to_string()));
        let mut scores = Vec::new();
        let trained = flotilla::train(&config, &mut Cpu::default(), |generation| {
            assert_eq!((generation.last, generation.rows.len()), (6, 3));
            scores.extend(generation.rows.iter().map(|row| (generation.generation, row.trial, row.champion_g)));
            Continue(())
        });
        let trained = trained.unwrap_or_else(|error| panic!("seed {seed}: {error}"));
        let expected = (0..7).flat_map(|generation| (0..3).map(move |trial| (generation, trial)));
        let expected =
            expected.map(|(generation, trial)| (generation, trial, trained.champion_g[trial * 7 + generation]));
        assert_eq!(scores, expected.collect::<Vec<_>>(), "seed {seed}");
        assert_eq!(trained.digest(), run_digest(&config, &path), "seed {seed}");
        assert_eq!(runs::trained(&path, Verification::Required).expect("the run is complete"), trained, "seed {seed}");
    }
    assert!(runs::trained(folder.path(), Verification::Required).is_err());

    // A missing row, an additional row, and two swapped rows.
    let (run, path) = (folder.path().join("0"), folder.path().join("0/metrics.csv"));
    let rows = fs::read_to_string(&path).expect("the run has metrics");
    let mut lines: Vec<&str> = rows.lines().collect();
    let read_error = |lines: &[&str]| {
        fs::write(&path, lines.join("\n") + "\n").expect("the file is writable");
        runs::trained(&run, Verification::Skipped).expect_err("the rows are invalid").to_string()
    };
    let short = read_error(&lines[..lines.len() - 1]);
    assert!(short.contains("metrics.csv has 20 rows of 21"), "{short}");
    let late = lines[lines.len() - 1].replacen("2,6,", "2,7,", 1);
    let late = read_error(&[&lines[..], &[&late]].concat());
    assert!(late.contains("line 23 is trial 2, generation 7, which the run's config.toml does not have"), "{late}");
    let more = read_error(&[&lines[..], &lines[lines.len() - 1..]].concat());
    assert!(more.contains("it must have one row per trial and generation, in order"), "{more}");
    lines.swap(1, 4);
    let swapped = read_error(&lines);
    assert!(swapped.contains("it must have one row per trial and generation, in order"), "{swapped}");
    // Policies of other runs: with a larger population, and of another network.
    lines.swap(1, 4);
    fs::write(&path, lines.join("\n") + "\n").expect("the file is writable");
    assert!(runs::trained(&run, Verification::Required).is_ok());
    let config = config(0);
    for (change, message) in [
        ((|config| config.learning.population += 1) as fn(&mut Config), "policies of each leader, not"),
        (|config| config.policy.hidden = vec![9, 9], "but the config needs F32"),
    ] {
        let mut changed = config.clone();
        change(&mut changed);
        let trained = flotilla::train(&changed, &mut Cpu::default(), |_| Continue(())).expect("training succeeds");
        policies::write(&Disk::default(), &run.join("policies.safetensors"), &changed, &trained.policies).unwrap();
        let error =
            runs::trained(&run, Verification::Required).expect_err("the policies belong to another run").to_string();
        assert!(error.contains("policies.safetensors: ") && error.contains(message), "{error}");
    }
}

#[test]
fn stopped_training_equals_training_with_fewer_generations() {
    let mut staged = config(3);
    let stage = |from| Stage { from, set: [("world.steps".to_string(), toml::Value::from(60))].into() };
    staged.stages = vec![stage(2), stage(5)];
    let cases = [(3, 0), (4, 2), (5, 4), (6, 5), (7, 6)].map(|(seed, after)| (config(seed), after));
    for (config, after) in cases.into_iter().chain((0..=6).map(|after| (staged.clone(), after))) {
        let (case, mut calls) = (format!("seed {}, after {after}", config.learning.seed), 0);
        let stopped = flotilla::train(&config, &mut Cpu::default(), |generation| {
            calls += 1;
            if generation.generation == after { Break(()) } else { Continue(()) }
        });
        let stopped = stopped.unwrap_or_else(|error| panic!("{case}: {error}"));
        let (generations, stages) = (stopped.config.learning.generations, stopped.config.stages.len());
        assert_eq!((generations, stages, calls), (6.min(after + 2), config.stages.len(), after + 1), "{case}");
        let whole = flotilla::train(&stopped.config, &mut Cpu::default(), |_| Continue(()));
        assert_eq!(whole.unwrap_or_else(|error| panic!("{case}: {error}")), stopped, "{case}");
    }
}

#[test]
fn training_starts_from_given_policies() {
    let config = config(5);
    let learned = flotilla::train(&config, &mut Cpu::default(), |_| Continue(())).unwrap();
    let policies = config.learning.population;
    let train_from = |policies: usize, first: &[Vec<f32>]| {
        flotilla::front::train_from(&config, &mut Cpu::default(), policies, first, |_| Continue(()))
    };
    let warm = train_from(policies, &learned.policies).unwrap();
    let of_trial = |weights: &Vec<f32>| Policies {
        policies,
        populations: own_populations(config.learners()).to_vec(),
        weights: weights.clone(),
    };
    let trials = learned.policies.iter().map(of_trial).collect();
    let folder = tempfile::tempdir().unwrap();
    let init = Init { digest: "of no file".into(), trials };
    assert_eq!(warm.digest(), run_digest_from(&config, folder.path(), Some(init)));
    assert_ne!(warm.digest(), learned.digest());
    let columns = config.learning.generations + 1;
    assert_eq!(train_from(policies, &learned.policies[..1]).unwrap().best_g[..columns], warm.best_g[..columns]);
    for wrong in [0, policies - 1, policies + 1, usize::MAX, usize::MAX / config.parameters()] {
        assert!(matches!(train_from(wrong, &learned.policies), Err(Failure::Weights { teams, .. }) if teams == wrong));
    }
    assert!(matches!(train_from(0, &[vec![]]), Err(Failure::Weights { found: 0, .. })));
    let [two, four] = [learned.policies[..2].to_vec(), [&learned.policies[..], &learned.policies[..1]].concat()];
    for (count, trials) in [(2, two), (4, four)] {
        let error = train_from(policies, &trials).expect_err("the number of trials differs").to_string();
        assert!(error.starts_with(&format!("{count} trials have policies, but the config has 3 trials; ")), "{error}");
    }
    let mut wrong = learned.policies.clone();
    wrong[1][3] = f32::NAN;
    assert!(matches!(train_from(policies, &wrong), Err(Failure::Weight { leader: 0, team: 0, parameter: 3, .. })));
}

#[test]
fn play_and_trace_treat_each_team_separately() {
    let mut backend = Cpu::default();
    for seed in 0..12 {
        let (config, teams) = (sample::world(seed), 1 + seed as usize * 3);
        let world = World::new(&config.validate().unwrap());
        let (leaders, parameters) = (world.leaders(), world.parameters());
        let starts = Starts::Drawn { episodes: 5, seed, jitter: 0.4, poi_jitter: 0.0 };
        let weights = sample::weights(&world, teams, seed);
        let played = flotilla::play(&config, &mut backend, teams, &weights, &starts).expect("valid weights");
        let sizes = [&played.d, &played.df, &played.dpp].map(Vec::len);
        assert_eq!((played.observed.len(), played.g.len(), sizes), (teams, teams, [teams * leaders; 3]));

        // A team gets the same scores alone as among others. One shared policy equals a copy for each leader.
        let team = teams - 1;
        let own = |leader: usize| &weights[(leader * teams + team) * parameters..][..parameters];
        let alone_weights: Vec<f32> = (0..leaders).flat_map(own).copied().collect();
        let alone_scores = flotilla::play(&config, &mut backend, 1, &alone_weights, &starts).expect("valid weights");
        assert_eq!(
            (alone_scores.g[0], &alone_scores.dpp[..]),
            (played.g[team], &played.dpp[team * leaders..]),
            "seed {seed}"
        );
        let shared = flotilla::play(&config, &mut backend, 1, own(0), &starts).expect("valid weights");
        let repeated =
            flotilla::play(&config, &mut backend, 1, &own(0).repeat(leaders), &starts).expect("valid weights");
        assert_eq!(shared, repeated, "seed {seed}");

        let traced = flotilla::trace(&config, teams, &weights, &starts, 3).expect("valid weights");
        let episode_starts = starts.of(3, &world);
        let order = aligned_teams(teams, leaders);
        let populations = own_populations(leaders);
        let group = Group { starts: &episode_starts, populations, ..Group::new(&world, &weights[..], teams, &order) };
        let trace = backend.trace(&group).expect("a valid group");
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
                assert_eq!(traced.inputs[at * 8..][..8], *trace.inputs_of(step, team, agent), "seed {seed}");
                assert_eq!(traced.outputs[at * 2..][..2], moment.outputs, "seed {seed}");
            }
        }
        assert_eq!(traced.agents_at_poi, trace.sets, "seed {seed}");
        let lengths = [traced.positions.len(), traced.headings.len(), traced.speeds.len() * 2];
        assert_eq!(lengths, [teams * (steps + 1) * agents * 2; 3]);
        assert_eq!([traced.inputs.len() / 8, traced.outputs.len() / 2], [teams * steps * leaders; 2]);
    }
}

#[test]
fn invalid_input_returns_an_error() {
    let config = sample::world(1);
    let (leaders, parameters) = (config.learners(), config.parameters());
    let mut backend = Cpu::default();
    let valid = vec![0.5; leaders * 2 * parameters];
    let mut play = |config: &Config, teams, weights: &[f32], starts| {
        let traced = flotilla::trace(config, teams, weights, &starts, 0).map(drop);
        let played = flotilla::play(config, &mut backend, teams, weights, &starts).map(drop);
        assert_eq!(played.as_ref().map_err(ToString::to_string), traced.as_ref().map_err(ToString::to_string));
        played
    };
    play(&config, 2, &valid, Starts::Own).expect("valid input");
    assert!(matches!(play(&config, 0, &[], Starts::Own), Err(Failure::Teams(0))));
    assert!(matches!(play(&config, usize::MAX, &valid, Starts::Own), Err(Failure::Teams(_))));
    assert!(matches!(play(&config, 2, &valid[1..], Starts::Own), Err(Failure::Weights { teams: 2, .. })));
    let more = [&valid[..], &[0.5]].concat();
    assert!(matches!(play(&config, 2, &more, Starts::Own), Err(Failure::Weights { teams: 2, .. })));
    assert!(matches!(play(&config, 5, &[], Starts::Own), Err(Failure::Weights { found: 0, .. })));
    for (value, is_valid) in [(f32::NAN, false), (f32::INFINITY, false), (2e6, false), (1e-20, true), (-0.0, true)] {
        let mut weights = valid.clone();
        weights[(leaders * 2 - 1) * parameters + 3] = value;
        match play(&config, 2, &weights, Starts::Own) {
            Ok(()) => assert!(is_valid, "{value}"),
            Err(Failure::Weight { leader, team, parameter, .. }) => {
                assert!(!is_valid && (leader, team, parameter) == (leaders - 1, 1, 3), "{value}");
            }
            Err(error) => panic!("{value}: {error}"),
        }
    }
    for (episodes, jitter) in [(0, 0.1), (u32::MAX, 0.1), (1, f64::NAN), (1, f64::INFINITY), (1, -0.1)] {
        let drawn = Starts::Drawn { episodes, seed: 1, jitter, poi_jitter: 0.0 };
        assert!(matches!(play(&config, 2, &valid, drawn), Err(Failure::Starts { .. })), "{episodes}, {jitter}");
        let moved = Starts::Drawn { episodes, seed: 1, jitter: 0.1, poi_jitter: jitter };
        assert!(matches!(play(&config, 2, &valid, moved), Err(Failure::Starts { .. })), "{episodes}, POIs by {jitter}");
    }

    let drawn = Starts::Drawn { episodes: 2, seed: 1, jitter: 0.1, poi_jitter: 0.0 };
    let trace = |episode| flotilla::trace(&config, 2, &valid, &drawn, episode);
    trace(1).expect("the last episode exists");
    assert!(matches!(trace(2), Err(Failure::NoEpisode { episode: 2, episodes: 2 })));

    // The steps of a million large teams need more memory than any machine has.
    let followers = "[1, 1], ".repeat(MAX_LEARNERS - 1);
    let text = format!(
        "[world]\nleaders = [[2, 2]]\nfollowers = [{followers}]\npois = [[9, 9]]\n\
         steps = {MAX_STEPS}\n[policy]\nhidden = []"
    );
    let large = Config::parse(&text, "large.toml").expect("a valid config");
    let weights = vec![0.5; large.parameters() * MAX_POPULATION];
    let traced = flotilla::trace(&large, MAX_POPULATION, &weights, &Starts::Own, 0);
    assert!(matches!(traced, Err(Failure::Memory { what: "all steps of all teams", .. })));

    // Configs that were built in code are validated like files.
    let broken: [fn(&mut Config); 6] = [
        |config| config.policy.hidden = vec![3; 9],
        |config| config.world.leaders.clear(),
        |config| config.world.dt = f64::NAN,
        |config| config.world.pois = vec![[-1.0, 0.0]],
        |config| config.learning.population = 0,
        |config| config.learning.seed = u64::MAX,
    ];
    for (index, make_invalid) in broken.into_iter().enumerate() {
        let mut config = config.clone();
        make_invalid(&mut config);
        let refused = |error| matches!(error, Failure::Config(_));
        assert!(refused(play(&config, 2, &valid, Starts::Own).expect_err("the config is invalid")), "{index}");
        let trained = flotilla::train(&config, &mut Cpu::default(), |_| Continue(()));
        assert!(refused(trained.expect_err("the config is invalid")), "{index}");
        assert!(flotilla::stepper(&config, 1, false).is_err_and(refused), "{index}");
    }
    assert!(matches!(flotilla::stepper(&config, 0, true), Err(Failure::Step(StepError::Teams(0)))));
    // Sights are recorded only if the fitness needs them.
    let mut config = support::layout("generally_forward");
    for (fitness, kept) in [(Fitness::Df, false), (Fitness::Dt, true)] {
        config.learning.fitness = fitness;
        let stepper = flotilla::stepper(&config, 2, true).expect("valid options");
        assert_eq!(stepper.fitness(Fitness::Dt, &mut [0.0; 8]).is_ok(), kept, "{fitness}");
    }
}

#[test]
fn open_finds_the_cpu_and_rejects_unknown_adapters() {
    let ((backend, machine), skipped) = flotilla::open(&Processor::Cpu).expect("the CPU is always available");
    assert!(backend.describe().starts_with("cpu") && machine.backend == "cpu" && skipped.is_none());
    let error = flotilla::open(&Processor::Adapter("no such adapter".into())).err().expect("there is no such adapter");
    assert!(error.to_string().contains("no such adapter"), "{error}");
}

/// Only the command line knows flags and commands, so it adds the advice that names them.
#[test]
fn library_errors_mention_no_flags() {
    fn walk(folder: &Path, errors: &mut Vec<String>) {
        for entry in fs::read_dir(folder).expect("a readable directory") {
            let path = entry.expect("a readable entry").path();
            if path.is_dir() {
                walk(&path, errors);
                continue;
            }
            let Ok(text) = fs::read_to_string(&path) else { continue };
            for error in text.split("#[error(").skip(1) {
                let error = error.split(")]").next().unwrap_or_default();
                let flag = error.split("--").skip(1).any(|rest| rest.starts_with(|c: char| c.is_ascii_lowercase()));
                if flag || error.contains("`flotilla") {
                    errors.push(format!("{}: {error}", path.display()));
                }
            }
        }
    }
    let mut errors = Vec::new();
    ["src", "app/src", "studies/src"]
        .into_iter()
        .for_each(|folder| walk(&Path::new(crate::ROOT).join(folder), &mut errors));
    assert_eq!(errors, Vec::<String>::new());
}
