//! Compares populations in GPU memory with populations in host memory, bit for bit: breeding, training and snapshots.
//!
//! A fake device fails at a chosen call, which tests that a run survives the loss of the device.

use crate::support;
use std::any::Any;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering::SeqCst};

use fearless_simd::Level;
use flotilla::backend::Machine;
use flotilla::backend::cpu::Cpu;
use flotilla::backend::gpu;
use flotilla::backend::gpu::device::{self, DeviceError, Kind};
use flotilla::backend::gpu::episode::{GpuBackend, ResidencyPolicy};
use flotilla::backend::{Backend, BackendError, DevicePopulation, Group, GroupScores, HELD_FROM, Trace, Weights};
use flotilla::config::{
    Config, Coupling, Elites, Fitness, Learning, Leniency, Method, Mutation, Paradigm, Parents, Sharing, Teams,
    ValidConfig,
};
use flotilla::evolve::{self, Breeding, Key, Purpose, UNCHANGED};
use flotilla::front::cpu;
use flotilla::trainer::{Row, Snapshot, SnapshotError, Trainer};
use flotilla_app::record::disk::Disk;
use flotilla_app::record::folder::{POLICIES, RUN, Run, Start, Status};
use flotilla_app::run::{Session, SessionEnd};

fn learning() -> Learning {
    support::layout("generally_forward").learning
}

/// Returns random weights `[populations][slots][parameters]`. Some are zero or have the largest or smallest magnitude.
fn population([populations, slots, parameters]: [usize; 3], seed: u64) -> Vec<f32> {
    let key = Key::new(seed, 0, Purpose::Weights);
    let mut weights = vec![0.0; populations * slots * parameters];
    for (policy, weights) in weights.chunks_exact_mut(parameters).enumerate() {
        evolve::random_policy(Level::new(), key.at(0, policy / slots, policy % slots), weights);
        for (index, weight) in weights.iter_mut().enumerate() {
            match (index + policy) % 11 {
                0 => *weight = 0.0,
                1 => *weight = evolve::MAX_WEIGHT.copysign(*weight),
                2 => *weight = evolve::MIN_WEIGHT.copysign(*weight),
                _ => {}
            }
        }
    }
    weights
}

fn bits(weights: &[f32]) -> &[u32] {
    bytemuck::cast_slice(weights)
}

/// Returns a parent for every slot. Every fifth slot is unchanged.
fn parents([leaders, slots, _]: [usize; 3], generation: usize) -> Vec<u32> {
    let parent = |place: usize| ((place * 7 + generation * 3 + 1) % slots) as u32;
    (0..leaders * slots).map(|place| parent(place) | if place % 5 == 2 { UNCHANGED } else { 0 }).collect()
}

#[test]
fn breeding_gives_the_same_bits_as_on_the_host() {
    for (request, info) in support::adapters("breeding_gives_the_same_bits_as_on_the_host") {
        let mut backend = GpuBackend::new(gpu::open(request).unwrap()).unwrap().with_residency(ResidencyPolicy::Always);
        let mut mutated = 0;
        for sizes in [[1, 2, 1], [3, 5, 97], [4, 51, 112], [2, 301, 64], [2, 17, 1000], [1, 300, 65], [257, 2, 18]] {
            for (case, probability) in [0.0, 0.1, 0.999, 1.0].into_iter().enumerate() {
                let mutation = [Mutation::Scaled, Mutation::Additive][case % 2];
                let mut learning = Learning { mutation_probability: probability, mutation, ..learning() };
                let mut expected = population(sizes, case as u64);
                let mut held = backend.hold(&expected, sizes).unwrap().expect("every population is held");
                for generation in 0..5 {
                    learning.mutation = if generation % 2 == 0 { Mutation::Scaled } else { Mutation::Additive };
                    learning.mutation_sigma = [0.1, 3.0, 100.0, 1e-6, 0.0][generation];
                    let parents = parents(sizes, generation);
                    let key = Key::new(9, case, Purpose::Mutation);
                    let breeding = Breeding { parents: &parents, key, generation, learning: &learning };
                    let before = expected.clone();
                    expected = breeding.on_host(sizes, &before).unwrap();
                    mutated += expected.iter().zip(&before).filter(|(a, b)| a != b).count();
                    held.breed(&breeding).unwrap();
                    let mut found = vec![f32::NAN; expected.len()];
                    held.fetch(&mut found).unwrap();
                    assert!(
                        bits(&found) == bits(&expected),
                        "{info}, {sizes:?}, {probability}, generation {generation}"
                    );
                }
            }
        }
        assert!(mutated > 1_000_000, "{mutated}");
    }
}

/// Returns experiments that differ in everything that breeding and gathering depend on, and in length.
fn experiments() -> Vec<Config> {
    let mut first = support::layout("generally_forward");
    (first.learning.trials, first.learning.generations, first.learning.population) = (2, 5, 21);
    let mut second = support::layout("chaotic");
    (second.learning.trials, second.learning.generations, second.learning.population) = (1, 3, 40);
    (second.learning.start_jitter, second.learning.episodes_per_team) = (0.5, 2);
    (second.learning.fitness, second.learning.elites) = (Fitness::D, 0.into());
    second.learning.mutation = Mutation::Additive;
    let mut third = support::layout("strictly_forward");
    (third.learning.trials, third.learning.generations, third.learning.population) = (1, 6, 7);
    (third.learning.paradigm, third.learning.mutation_probability) = (Paradigm::AllLeaders, 1.0);
    third.policy.hidden = vec![5, 30, 3];
    // Six leaders, more than are gathered at a time, share a population.
    let mut fourth = support::layout("strictly_forward");
    (fourth.learning.trials, fourth.learning.generations, fourth.learning.population) = (2, 4, 35);
    (fourth.learning.paradigm, fourth.learning.sharing) = (Paradigm::AllLeaders, Sharing::Shared);
    // Parents are drawn from the elites, a share of the population.
    let mut fifth = support::layout("chaotic");
    (fifth.learning.trials, fifth.learning.generations, fifth.learning.population) = (2, 4, 30);
    (fifth.learning.elites, fifth.learning.parents) = (Elites::Percentage(20.0), Parents::Elites);
    fifth.sense.gain = 3.0;
    // Every policy plays in three teams. Its fitness is the best of them.
    let mut sixth = support::layout("strictly_forward");
    (sixth.learning.trials, sixth.learning.generations, sixth.learning.population) = (2, 4, 14);
    (sixth.learning.partners, sixth.learning.leniency) = (3, Leniency::Max);
    (sixth.learning.start_jitter, sixth.learning.episodes_per_team) = (0.5, 2);
    // Evolution strategies sample on the host.
    let mut seventh = support::layout("generally_forward");
    (seventh.learning.trials, seventh.learning.generations, seventh.learning.population) = (2, 5, 15);
    (seventh.learning.method, seventh.world.coupling) = (Method::OpenAiEs, Coupling::Same(1));
    let mut eighth = support::layout("strictly_forward");
    (eighth.learning.trials, eighth.learning.generations, eighth.learning.population) = (1, 4, 12);
    (eighth.learning.method, eighth.learning.sharing) = (Method::Snes, Sharing::Shared);
    eighth.world.coupling = Coupling::Same(1);
    // Every policy plays with past champions, too.
    let mut ninth = support::layout("generally_forward");
    (ninth.learning.trials, ninth.learning.generations, ninth.learning.population) = (2, 6, 9);
    (ninth.learning.hall_of_fame, ninth.world.coupling) = (3, Coupling::Same(2));
    // Teams depend on results, and some play again.
    let mut tenth = support::layout("generally_forward");
    (tenth.learning.trials, tenth.learning.generations, tenth.learning.population) = (2, 5, 11);
    (tenth.learning.teams, tenth.world.coupling) = (Teams::Softmax, Coupling::Same(2));
    (tenth.learning.temperature, tenth.learning.test_episodes, tenth.learning.start_jitter) = (0.3, 2, 0.5);
    let mut eleventh = support::layout("chaotic");
    (eleventh.learning.trials, eleventh.learning.generations, eleventh.learning.population) = (1, 5, 12);
    (eleventh.learning.teams, eleventh.world.coupling) = (Teams::Sorted, Coupling::Same(2));
    (eleventh.learning.team_elites, eleventh.learning.team_g_elites) = (2, 2);
    vec![first, second, third, fourth, fifth, sixth, seventh, eighth, ninth, tenth, eleventh]
}

/// The metrics and the final policies of [`experiments`].
#[derive(Debug, PartialEq)]
struct Outcome {
    rows: Vec<Row>,
    policies: Vec<Vec<Vec<f32>>>,
}

fn policies(trainer: &Trainer) -> Vec<Vec<Vec<f32>>> {
    (0..experiments().len()).map(|experiment| trainer.policies(experiment)).collect()
}

/// Takes a snapshot of every experiment.
fn snapshots_of(trainer: &mut Trainer) -> Result<Vec<Snapshot>, SnapshotError> {
    (0..experiments().len()).map(|experiment| trainer.snapshot(experiment)).collect()
}

fn restored(snapshots: &[Snapshot]) -> Trainer {
    let mut trainer = Trainer::new(ValidConfig::all(&experiments()).unwrap());
    for (experiment, snapshot) in snapshots.iter().enumerate() {
        assert!(trainer.restore(experiment, snapshot.clone()));
    }
    trainer
}

fn train(trainer: &mut Trainer, backend: &mut dyn Backend) -> Outcome {
    Outcome { rows: trainer.finish(backend).unwrap(), policies: policies(trainer) }
}

/// Trains on the CPU. Returns the outcome and the snapshots before each generation.
fn reference() -> (Outcome, Vec<Vec<Snapshot>>) {
    let (mut trainer, mut rows, mut snapshots) =
        (Trainer::new(ValidConfig::all(&experiments()).unwrap()), Vec::new(), Vec::new());
    while !trainer.is_done() {
        snapshots.push(snapshots_of(&mut trainer).unwrap());
        rows.extend(trainer.advance(&mut Cpu::default()).unwrap());
    }
    (Outcome { rows, policies: policies(&trainer) }, snapshots)
}

#[test]
fn populations_of_wrong_sizes_are_refused() {
    for (request, info) in support::adapters("populations_of_wrong_sizes_are_refused") {
        for residency in [ResidencyPolicy::Always, ResidencyPolicy::Never] {
            let mut backend = GpuBackend::new(gpu::open(request.clone()).unwrap()).unwrap().with_residency(residency);
            let weights = vec![0.0; 24];
            for (count, sizes) in [(23, [2, 3, 4]), (24, [2, 3, 5]), (0, [0, 3, 4]), (0, [2, 0, 4]), (0, [2, 3, 0])] {
                let error = backend.hold(&weights[..count], sizes).expect_err("the sizes do not match");
                assert!(matches!(&error, BackendError::InvalidInput(_)), "{info}, {sizes:?}: {error}");
                assert!(error.to_string().contains(&format!("{count} weights for {}", sizes[0])), "{info}: {error}");
            }
            // The device still works.
            let held = backend.hold(&weights, [2, 3, 4]).unwrap();
            assert_eq!(held.is_some(), residency == ResidencyPolicy::Always, "{info}");
        }
    }
}

#[test]
fn training_is_the_same_wherever_populations_are_stored() {
    let (expected, snapshots) = reference();
    assert!(expected.rows.iter().any(|row| row.best_g > 0.0), "no POI was observed");
    for (request, info) in support::adapters("training_is_the_same_wherever_populations_are_stored") {
        let gpu = gpu::open(request).unwrap();
        let open = |holding| GpuBackend::new(gpu.clone()).unwrap().with_residency(holding);
        // Some populations are larger than this limit, others smaller.
        let some = ResidencyPolicy::From(4 * 30 * 112 * 4);
        for holding in [ResidencyPolicy::Always, ResidencyPolicy::Never, some] {
            assert_eq!(
                train(&mut Trainer::new(ValidConfig::all(&experiments()).unwrap()), &mut open(holding)),
                expected,
                "{info}, {holding:?}"
            );
        }
        // A batch has only some of the teams.
        let mut small = open(ResidencyPolicy::Always).with_batch_bytes(1 << 14);
        assert_eq!(
            train(&mut Trainer::new(ValidConfig::all(&experiments()).unwrap()), &mut small),
            expected,
            "{info}, small batches"
        );
        // Snapshots equal those of the CPU. Training resumes from them on any backend.
        let (mut device, mut other_device) = (open(ResidencyPolicy::Always), open(ResidencyPolicy::Always));
        let (mut trainer, mut rows) = (Trainer::new(ValidConfig::all(&experiments()).unwrap()), Vec::new());
        for (generation, snapshot) in snapshots.iter().enumerate() {
            assert_eq!(&snapshots_of(&mut trainer).unwrap(), snapshot, "{info}, before generation {generation}");
            // Software devices need seconds for each.
            let restarts = support::is_long() || [0, snapshots.len() / 2, snapshots.len() - 1].contains(&generation);
            for backend in
                [&mut Cpu::default() as &mut dyn Backend, &mut other_device].into_iter().take(1 + usize::from(restarts))
            {
                let rest = train(&mut restored(snapshot), backend);
                assert_eq!(rest.policies, expected.policies, "{info}, from generation {generation}");
                assert!(expected.rows.ends_with(&rest.rows), "{info}, from generation {generation}");
            }
            rows.extend(trainer.advance(&mut device).unwrap());
        }
        assert_eq!((&rows, policies(&trainer)), (&expected.rows, expected.policies.clone()), "{info}");
        // Another backend refuses populations that it does not hold. A snapshot moves them.
        let mut trainer = Trainer::new(ValidConfig::all(&experiments()).unwrap());
        trainer.advance(&mut device).unwrap();
        assert!(matches!(trainer.advance(&mut other_device), Err(BackendError::HeldElsewhere)), "{info}");
        assert_eq!(&snapshots_of(&mut trainer).unwrap(), &snapshots[1], "{info}");
    }
}

/// Their results are the same as if they all began together.
#[test]
fn experiments_at_different_generations_train_together() {
    let (expected, snapshots) = reference();
    for first in 0..snapshots.len() {
        let from = [first, (first + 3) % snapshots.len(), snapshots.len() - 1 - first];
        let mixed: Vec<Snapshot> = (0..3).map(|experiment| snapshots[from[experiment]][experiment].clone()).collect();
        let mut trainer = restored(&mixed);
        let rows = trainer.finish(&mut FakeDevice::failing_at(0, false)).unwrap();
        assert_eq!(policies(&trainer), expected.policies, "from {from:?}");
        for (experiment, &from) in from.iter().enumerate() {
            let own_rows =
                |rows: &[Row]| rows.iter().filter(|row| row.experiment == experiment).copied().collect::<Vec<_>>();
            let expected_rows =
                own_rows(&expected.rows).into_iter().filter(|row| row.generation + 1 >= from).collect::<Vec<_>>();
            assert_eq!(own_rows(&rows), expected_rows, "experiment {experiment} from {from}");
        }
    }
}

/// Returns a short training with stages. Its task is so easy that champions observe POIs.
fn staged(stages: &str) -> Config {
    let mut config = support::layout("generally_forward");
    (config.learning.trials, config.learning.generations, config.learning.population) = (2, 7, 40);
    config.world.coupling = Coupling::Same(1);
    Config::parse(&(config.to_toml() + stages), "staged.toml").unwrap()
}

/// If a device holds the populations, the teams and starts of the next generation are drawn while one plays. They have
/// to respect a stage that begins there, and an early end.
#[test]
fn stages_and_early_ends_apply_wherever_populations_are_stored() {
    let config = staged(
        "[[stages]]\nfrom = 2\nset = { learning.start_jitter = 3.0, learning.episodes_per_team = 2 }\n\
         [[stages]]\nfrom = 5\nset = { world.coupling = 2, learning.poi_jitter = 2.0 }\n",
    );
    let outcome = |backend: &mut dyn Backend, end: usize| {
        let (mut trainer, mut rows) = (Trainer::new([config.validate().unwrap()]), Vec::new());
        while !trainer.is_done() {
            rows.extend(trainer.advance(backend).unwrap());
            if trainer.generation(0) == end {
                assert_eq!(trainer.end(0), end.min(7));
            }
        }
        (rows, trainer.policies(0))
    };
    let adapters = support::adapters("stages_and_early_ends_apply_wherever_populations_are_stored");
    for end in 1..=8 {
        let expected = outcome(&mut Cpu::default(), end);
        assert_eq!(outcome(&mut FakeDevice::failing_at(0, false), end), expected, "ended at {end}");
        for (request, info) in &adapters {
            let mut gpu =
                GpuBackend::new(gpu::open(request.clone()).unwrap()).unwrap().with_residency(ResidencyPolicy::Always);
            assert_eq!(outcome(&mut gpu, end), expected, "{info}, ended at {end}");
        }
        assert!(
            expected.0.iter().all(|row| row.champion_g > 0.0),
            "champions observe nothing, so their starts are not tested"
        );
    }
}

/// The trainer draws the starts of a stage in advance. Then it is restored, and ends before this stage.
#[test]
fn starts_drawn_in_advance_are_discarded_after_a_restore() {
    let config = staged("[[stages]]\nfrom = 3\nset = { learning.start_jitter = 3.0 }\n");
    let outcome = |backend: &mut dyn Backend| {
        let mut trainer = Trainer::new([config.validate().unwrap()]);
        while trainer.generation(0) < 2 {
            trainer.advance(backend).unwrap();
        }
        let before = trainer.snapshot(0).unwrap();
        trainer.advance(backend).unwrap();
        assert!(trainer.restore(0, before));
        assert_eq!(trainer.end(0), 2);
        (trainer.finish(backend).unwrap(), trainer.policies(0))
    };
    let expected = outcome(&mut Cpu::default());
    assert!(
        expected.0.iter().all(|row| row.champion_g > 0.0),
        "champions observe nothing, so their starts are not tested"
    );
    assert_eq!(outcome(&mut FakeDevice::failing_at(0, false)), expected);
}

/// A population has to fit in a buffer. If it does not, `ResidencyPolicy::Always` is an error.
#[test]
fn populations_too_large_for_the_device_stay_on_the_host() {
    for (request, info) in support::adapters("populations_too_large_for_the_device_stay_on_the_host") {
        let gpu = gpu::open(device::Request { default_limits: true, ..request }).unwrap();
        // The smallest size above WebGPU's 128 MiB.
        let sizes = [1, (128 << 20) / 4 / 112 + 1, 112];
        let large = vec![0.0; sizes.iter().product()];
        let open = |holding| GpuBackend::new(gpu.clone()).unwrap().with_residency(holding);
        assert!(open(ResidencyPolicy::From(1)).hold(&large, sizes).unwrap().is_none(), "{info}");
        let error = open(ResidencyPolicy::Always).hold(&large, sizes).unwrap_err().to_string();
        assert!(error.contains("134217") && error.contains("breed on the host"), "{info}: {error}");
        assert!(open(ResidencyPolicy::Never).hold(&[0.0; 2], [1, 2, 1]).unwrap().is_none(), "{info}");
        // The default policy holds populations from `HELD_FROM` bytes on, except on software renderers.
        let weights = vec![0.0; HELD_FROM as usize / 4];
        let mut backend = GpuBackend::new(gpu.clone()).unwrap();
        let held = backend.hold(&weights, [2, weights.len() / 2, 1]).unwrap();
        assert_eq!(held.is_some(), info.kind != Kind::Software, "{info}");
        assert!(backend.hold(&weights[1..], [1, weights.len() - 1, 1]).unwrap().is_none(), "{info}");
    }
}

/// A fake device that fails at its nth call, permanently or once. If it holds populations, it does so in host memory.
struct FakeDevice {
    cpu: Cpu,
    state: Arc<State>,
    holds: bool,
}

struct State {
    left: AtomicUsize,
    permanent: bool,
    lost: AtomicBool,
}

impl State {
    fn call(&self) -> Result<(), BackendError> {
        let left = self.left.fetch_update(SeqCst, SeqCst, |left| Some(left.saturating_sub(1))).unwrap();
        if left == 1 {
            self.lost.store(self.permanent, SeqCst);
        }
        match left == 1 || self.lost.load(SeqCst) {
            true => Err(DeviceError::Lost { adapter: "test".into(), reason: "pulled out".into() }.into()),
            false => Ok(()),
        }
    }
}

impl FakeDevice {
    /// Creates a device that holds populations and fails at call `nth`, counted from 1. With 0 it never fails.
    fn failing_at(nth: usize, permanent: bool) -> FakeDevice {
        let state = State { left: AtomicUsize::new(nth), permanent, lost: AtomicBool::new(false) };
        FakeDevice { cpu: Cpu::default(), state: Arc::new(state), holds: true }
    }

    /// Returns whether the device has failed.
    fn failed(&self) -> bool {
        self.state.left.load(SeqCst) == 0
    }
}

struct FakePopulation {
    state: Arc<State>,
    weights: Vec<f32>,
    sizes: [usize; 3],
}

impl std::fmt::Debug for FakePopulation {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("FakePopulation").field("sizes", &self.sizes).finish_non_exhaustive()
    }
}

impl DevicePopulation for FakePopulation {
    fn breed(&mut self, breeding: &Breeding<'_>) -> Result<(), BackendError> {
        self.state.call()?;
        self.weights = breeding.on_host(self.sizes, &self.weights)?;
        Ok(())
    }

    fn fetch(&self, weights: &mut [f32]) -> Result<(), BackendError> {
        // A failed copy leaves half of the weights.
        let half = weights.len() / 2;
        weights[..half].copy_from_slice(&self.weights[..half]);
        self.state.call()?;
        weights.copy_from_slice(&self.weights);
        Ok(())
    }
}

impl Backend for FakeDevice {
    fn play(&mut self, groups: &[Group<'_>]) -> Result<Vec<GroupScores>, BackendError> {
        self.state.call()?;
        let weights = |group: &Group<'_>| match group.weights {
            Weights::OnHost(weights) => Ok(weights.to_vec()),
            Weights::OnDevice(held) => {
                let held = (held as &dyn Any).downcast_ref::<FakePopulation>();
                held.map(|held| held.weights.clone()).ok_or(BackendError::HeldElsewhere)
            }
        };
        let weights: Vec<Vec<f32>> = groups.iter().map(weights).collect::<Result<_, _>>()?;
        let groups: Vec<Group<'_>> = groups
            .iter()
            .zip(&weights)
            .map(|(group, weights)| Group { weights: weights[..].into(), ..*group })
            .collect();
        self.cpu.play(&groups)
    }

    fn trace(&mut self, group: &Group<'_>) -> Result<Trace, BackendError> {
        self.cpu.trace(group)
    }

    fn hold(&mut self, weights: &[f32], sizes: [usize; 3]) -> Result<Option<Box<dyn DevicePopulation>>, BackendError> {
        let held = || FakePopulation { state: self.state.clone(), weights: weights.to_vec(), sizes };
        Ok(self.holds.then(|| Box::new(held()) as Box<dyn DevicePopulation>))
    }

    fn describe(&self) -> String {
        "a fake device".into()
    }
}

/// The device fails at each call in turn, permanently or once. After an error, the last snapshots continue on the CPU.
/// Rows and policies are the same. With `FLOTILLA_LONG=1`, every call fails. Otherwise one of four does, and each case
/// starts at another.
#[test]
fn training_continues_from_snapshots_after_the_loss_of_a_device() {
    let (expected, _) = reference();
    let step = if support::is_long() { 1 } else { 4 };
    let cases = [(true, 1), (true, 3), (true, 100), (false, 3), (false, 100)];
    for (at, (permanent, saves_every)) in cases.into_iter().enumerate() {
        for nth in (1 + at % step..).step_by(step) {
            let case = format!("fails at call {nth}, permanently: {permanent}, saved every {saves_every} generations");
            let (mut trainer, mut rows) = (Trainer::new(ValidConfig::all(&experiments()).unwrap()), Vec::new());
            let (mut device, mut saved) = (FakeDevice::failing_at(nth, permanent), (Vec::new(), 0));
            while !trainer.is_done() {
                if trainer.generation(2) % saves_every == 0 {
                    match snapshots_of(&mut trainer) {
                        Err(SnapshotError::Backend(_)) => assert!(device.failed(), "{case}"),
                        taken => saved = (taken.unwrap(), rows.len()),
                    }
                }
                match trainer.advance(&mut device) {
                    Ok(advanced) => rows.extend(advanced),
                    Err(error) => {
                        assert!(device.failed() && error.is_device_failure(), "{case}: {error}");
                        trainer = restored(&saved.0);
                        rows.truncate(saved.1);
                        rows.extend(trainer.finish(&mut Cpu::default()).unwrap());
                    }
                }
            }
            assert_eq!(rows, expected.rows, "{case}");
            assert_eq!(policies(&trainer), expected.policies, "{case}");
            if !device.failed() {
                assert!(nth > 20, "a run makes more calls than {nth}");
                break;
            }
        }
    }
}

/// If the device is lost, the run continues on the CPU from its last checkpoint, provided that `fallback` returns it.
/// Otherwise it stops with an error, and can be resumed.
#[test]
fn a_run_survives_the_loss_of_its_device() {
    let mut config = experiments().remove(0);
    config.checkpoint = flotilla::config::CheckpointConfig { generations: 2, seconds: 0.0 };
    let folder = tempfile::tempdir().unwrap();
    let run = |name: &str, start: Start, device: Option<FakeDevice>, fall_back: bool| {
        let path = folder.path().join(name);
        let (mut session, _) = Session::open(vec![(config.clone(), path.clone())], start, &Disk::default()).unwrap();
        let (first, mut requests) = (session.generations()[0], 0);
        let backend = device.map_or_else(cpu, |device| (Box::new(device), Machine::default()));
        let mut fallback = |_: &BackendError| {
            requests += 1;
            fall_back.then(cpu)
        };
        let ended = support::train(&mut session, backend, &mut fallback, &mut |_| false).map(|outcome| {
            assert_eq!(outcome, SessionEnd::Finished);
            session.results(0).cloned().unwrap()
        });
        (ended, (support::metrics_without_seconds(&path), std::fs::read(path.join(POLICIES)).ok()), first, requests)
    };
    let (expected, files, ..) = run("cpu", Start::Fresh, None, false);
    let expected = expected.unwrap();
    let mut lost_populations = 0;
    // A device that holds no populations has one call per generation, and one for the last champions.
    let cases = (1..20).map(|nth| (nth, true)).chain((1..=config.learning.generations + 2).map(|nth| (nth, false)));
    for (nth, holds) in cases {
        let case = format!("call {nth}, populations on the device {holds}");
        let device = || Some(FakeDevice { holds, ..FakeDevice::failing_at(nth, true) });
        let (ended, found, _, requests) = run(&format!("fall-back-{nth}-{holds}"), Start::Fresh, device(), true);
        assert_eq!((ended.unwrap(), &found, requests), (expected.clone(), &files, 1), "{case}");
        let name = format!("stop-{nth}-{holds}");
        let (ended, ..) = run(&name, Start::Fresh, device(), false);
        let error = flotilla_cli::Error::from(ended.unwrap_err()).to_string();
        assert!(error.contains("the device was lost") && error.contains("--resume"), "{error}");
        assert_eq!(Run::read(&folder.path().join(&name).join(RUN)).unwrap().state, Status::Stopped, "{case}");
        let is_lost = error.contains("the populations were lost");
        assert!(holds || !is_lost, "{case}: {error}");
        lost_populations += usize::from(is_lost);
        let (ended, found, first, _) = run(&name, Start::Resume, None, false);
        assert_eq!((ended.unwrap(), &found), (expected.clone(), &files), "{case}");
        // The host still has the populations, so no generation is played again.
        assert!(holds || first == nth - 1, "{case}: generation {first}");
    }
    // A command that trains no run suggests to run it again.
    let lost = DeviceError::Lost { adapter: "test".into(), reason: "pulled out".into() };
    let unknown = DeviceError::UnknownAdapter { name: "test".into(), found: vec![] };
    for (error, end) in [(lost, "; run again, or use --backend cpu"), (unknown, "; use --backend cpu")] {
        let error = flotilla_cli::Error::from(BackendError::from(error)).to_string();
        assert!(error.ends_with(end), "{error}");
    }
    assert!(lost_populations > 0);
}
