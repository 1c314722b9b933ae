//! Faults injected into a device: dropped submissions, old bytes, watchdogs, waits without end, missing memory, wrong
//! kernels, other speeds. None of them may give wrong bits unnoticed.

#![cfg(feature = "gpu")]

mod support;

use std::collections::{HashMap, HashSet};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering::SeqCst};
use std::sync::{Arc, Mutex, mpsc};
use std::thread;
use std::time::Duration;

use flotilla::backend::cpu::Cpu;
use flotilla::backend::gpu::device::{DeviceError, Gpu, Request, WaitLimit, report_stalls};
use flotilla::backend::gpu::episode::{GpuBackend, Kernel, Records, ResidencyPolicy};
use flotilla::backend::gpu::exact::Pass;
use flotilla::backend::gpu::faults::Faults;
use flotilla::backend::gpu::{self, self_test};
use flotilla::backend::{Backend, BackendError, Group};
use flotilla::config::{Config, Fitness, Sharing};
use flotilla::evolve::{Breeding, Key, Purpose};
use flotilla::sample;
use flotilla::trainer::{Row, Trainer};
use flotilla::world::World;

fn config() -> Config {
    let mut config = Config::parse(support::SMALL, "small.toml").unwrap();
    config.learning.fitness = Fitness::Df;
    // Few teams observe these at first, and more later, so that rows show who has played.
    config.world.pois = vec![[10.0, 10.0], [20.0, 10.5]];
    config
}

/// Injects faults into a device that was opened without any.
fn failing(gpu: &Gpu, faults: &Arc<impl Faults + 'static>) -> Gpu {
    // SAFETY: the edits in this file change numbers; indices and loops stay as they are.
    #[expect(unsafe_code, reason = "edited shaders are compiled without bounds checks")]
    unsafe {
        gpu.clone().failing(faults.clone())
    }
}

/// A fresh device. A lost one stays lost.
fn opened(request: &Request) -> Gpu {
    gpu::open(Request { pass: Some(Pass::NoContraction), ..request.clone() }).unwrap()
}

/// Every way that results come to the host.
const WAYS: [(ResidencyPolicy, Records); 4] = [
    (ResidencyPolicy::Never, Records::Whole),
    (ResidencyPolicy::Never, Records::Packed),
    (ResidencyPolicy::Always, Records::Whole),
    (ResidencyPolicy::Always, Records::Packed),
];

fn backend(gpu: Gpu, (holding, records): (ResidencyPolicy, Records)) -> GpuBackend {
    GpuBackend::new(gpu).unwrap().playing(Kernel::Generic).holding(holding).with_records(records)
}

/// Trains to the end. Changes to the CPU if the device is lost. Returns the rows, the policies and how often it was lost.
fn train(mut device: GpuBackend) -> (Vec<Row>, Vec<Vec<f32>>, usize) {
    let mut trainer = Trainer::new([config().validate().unwrap()]);
    let (mut rows, mut lost) = (Vec::new(), 0);
    while !trainer.is_done() {
        let played = match lost {
            0 => trainer.advance(&mut device),
            _ => trainer.advance(&mut Cpu::default()),
        };
        match played {
            Ok(played) => rows.extend(played),
            Err(BackendError::Gpu(DeviceError::Lost { .. })) => lost += 1,
            Err(error) => panic!("{error}"),
        }
        assert!(
            trainer.take_setback().is_none_or(|error| matches!(error, BackendError::Gpu(DeviceError::Lost { .. })))
        );
    }
    (rows, trainer.policies(0), lost)
}

fn expected() -> (Vec<Row>, Vec<Vec<f32>>) {
    let mut trainer = Trainer::new([config().validate().unwrap()]);
    let rows = trainer.finish(&mut Cpu::default()).unwrap();
    let different: HashSet<_> = rows.iter().map(|row| row.mean_g.to_bits()).collect();
    assert!(different.len() > 8, "rows do not show who has played: {different:?}");
    (rows, trainer.policies(0))
}

/// Drops the nth submission with this name.
struct Dropping {
    what: &'static str,
    left: AtomicUsize,
}

impl Faults for Dropping {
    fn drops(&self, what: &str, _: u64) -> bool {
        what == self.what && self.left.fetch_sub(1, SeqCst) == 1
    }
}

/// As on Metal after a time-out, and on DX12 after a removed device: the fence is signalled, and nothing was done.
#[test]
fn a_dropped_submission_is_a_lost_device() {
    let (rows, policies) = expected();
    for (request, info) in support::adapters("a_dropped_submission_is_a_lost_device") {
        for way in WAYS {
            for what in ["a population", "episodes", "breeding", "reading back"] {
                for nth in 1.. {
                    let faults = Arc::new(Dropping { what, left: AtomicUsize::new(nth) });
                    let found = train(backend(failing(&opened(&request), &faults), way));
                    let dropped = faults.left.load(SeqCst) == 0 || faults.left.load(SeqCst) > nth;
                    let case = format!("{info}, {way:?}: {what} {nth}");
                    assert_eq!((&found.0, &found.1), (&rows, &policies), "{case}");
                    // A population that was copied back after it was lost is not asked for again.
                    assert_eq!(found.2 > 0, dropped, "{case}");
                    if !dropped {
                        assert!(nth > 1 || what != "episodes", "{case}: nothing was submitted");
                        break;
                    }
                }
            }
        }
    }
}

/// A watchdog may also end breeding after some of its workgroups. The host may fetch policies that have not played.
#[test]
fn a_fetched_population_that_was_not_copied_or_bred_is_a_lost_device() {
    const SIZES: [usize; 3] = [2, 50, 64];
    let learning = config().learning;
    let weights: Vec<f32> = (0..SIZES.iter().product()).map(|index| index as f32).collect();
    let parents: Vec<u32> = (0..SIZES[0] * SIZES[1]).map(|place| (place * 7 % SIZES[1]) as u32).collect();
    let key = Key::new(0, 0, Purpose::Mutation);
    let breeding = |generation| Breeding { parents: &parents, key, generation, learning: &learning };
    let in_part: fn(String) -> String = |text| {
        let start = "let counters = (brood.parameters";
        text.replace(start, &format!("if workgroup.x == 2u {{ return; }}\n    {start}"))
    };
    for (request, info) in support::adapters("a_fetched_population_that_was_not_copied_or_bred_is_a_lost_device") {
        let gpu = opened(&request);
        let dropping = |what, nth| Arc::new(Dropping { what, left: AtomicUsize::new(nth) });
        let cases = [
            ("nothing", gpu.clone(), true),
            ("the second population", failing(&gpu, &dropping("a population", 2)), false),
            ("the first breeding", failing(&opened(&request), &dropping("breeding", 1)), false),
            ("the second breeding", failing(&opened(&request), &dropping("breeding", 2)), false),
            ("a workgroup", failing(&opened(&request), &Arc::new(Edited(in_part))), false),
        ];
        for (left_out, gpu, expected) in cases {
            let case = format!("{info}: {left_out} is left out");
            let mut held = backend(gpu, WAYS[2]).hold(&weights, SIZES).unwrap().expect("all are held");
            (0..2).for_each(|generation| held.breed(&breeding(generation)).unwrap());
            match held.fetch(&mut vec![0.0; weights.len()]) {
                Err(BackendError::Gpu(DeviceError::Lost { .. })) => assert!(!expected, "{case}"),
                found => assert!(found.is_ok() && expected, "{case}: {found:?}"),
            }
        }
    }
}

/// Returns what was read from a buffer before, from the nth read of it on.
struct Old {
    left: AtomicUsize,
    before: Mutex<HashMap<wgpu::Buffer, Vec<u8>>>,
    returned: AtomicBool,
}

impl Faults for Old {
    fn reads(&self, buffer: &wgpu::Buffer, bytes: &[u8]) -> Option<Vec<u8>> {
        let mut before = self.before.lock().unwrap();
        let old = before.insert(buffer.clone(), bytes.to_vec());
        let due = self.left.fetch_sub(1, SeqCst) == 1;
        let old = old.filter(|old| due && old.len() == bytes.len());
        self.returned.fetch_or(old.is_some(), SeqCst);
        old
    }
}

#[test]
fn old_bytes_are_a_lost_device() {
    let (rows, policies) = expected();
    for (request, info) in support::adapters("old_bytes_are_a_lost_device") {
        for way in WAYS {
            let mut cases = 0;
            for nth in 1..24 {
                let left = AtomicUsize::new(nth);
                let faults = Arc::new(Old { left, before: Mutex::default(), returned: AtomicBool::new(false) });
                let found = train(backend(failing(&opened(&request), &faults), way));
                assert_eq!((&found.0, &found.1), (&rows, &policies), "{info}, {way:?}: read {nth}");
                let returned = faults.returned.load(SeqCst);
                assert_eq!(found.2 > 0, returned, "{info}, {way:?}: read {nth}");
                cases += usize::from(returned);
            }
            assert!(cases > 2, "{info}, {way:?}: {cases} reads of a buffer that was read before");
        }
    }
}

/// A device that takes a second for so many turns, with a watchdog that ends submissions of more than two.
struct Slow {
    turns_a_second: u64,
    longest: AtomicU64,
    ended: AtomicUsize,
}

impl Faults for Slow {
    fn drops(&self, what: &str, turns: u64) -> bool {
        let turns = if what == "episodes" { turns } else { 0 };
        self.longest.fetch_max(turns, SeqCst);
        let ended = turns > 2 * self.turns_a_second;
        self.ended.fetch_add(usize::from(ended), SeqCst);
        ended
    }

    fn takes(&self, turns: u64) -> Option<Duration> {
        Some(Duration::from_secs_f64(turns as f64 / self.turns_a_second as f64))
    }
}

#[test]
fn no_submission_is_long_enough_for_a_watchdog() {
    let mut config = support::layout("generally_forward");
    (config.learning.trials, config.learning.generations, config.learning.population) = (1, 1, 4096);
    let configs = || [config.clone().validate().unwrap()];
    let rows = Trainer::new(configs()).finish(&mut Cpu::default()).unwrap();
    for (request, info) in support::adapters("no_submission_is_long_enough_for_a_watchdog") {
        for way in [WAYS[0], WAYS[3]] {
            let (longest, ended) = (AtomicU64::new(0), AtomicUsize::new(0));
            let faults = Arc::new(Slow { turns_a_second: 150_000_000, longest, ended });
            let mut device = backend(failing(&opened(&request), &faults), way);
            let found = Trainer::new(configs()).finish(&mut device);
            let longest = faults.longest.load(SeqCst) as f64 / faults.turns_a_second as f64;
            assert_eq!(
                faults.ended.load(SeqCst),
                0,
                "{info}: a submission of {longest} s was ended: {:?}",
                found.err()
            );
            assert_eq!(found.unwrap(), rows, "{info}");
            // The first trial, at an unknown speed, may take longer than the 0.1 s that are aimed at.
            assert!(longest <= 0.25, "{info}: a submission takes {longest} s");
            let stages = device.take_stages();
            assert!(stages.longest.as_secs_f64() <= 0.25 && !stages.longest.is_zero(), "{:?}", stages.longest);
        }
    }
}

/// No wait ends.
struct Stalled(AtomicUsize);

impl Faults for Stalled {
    fn stalls(&self) -> bool {
        self.0.fetch_add(1, SeqCst);
        true
    }
}

static REPORTED: Mutex<Vec<String>> = Mutex::new(Vec::new());

/// Runs a test in a thread of its own, and fails if it takes longer than `most`. A thread that hangs ends with the process.
fn within(most: Duration, test: impl FnOnce() + Send + 'static) {
    let (send, done) = mpsc::channel();
    let running = thread::spawn(move || {
        test();
        let _ = send.send(());
    });
    if done.recv_timeout(most) == Err(mpsc::RecvTimeoutError::Timeout) {
        panic!("still waiting for the device after {most:?}");
    }
    running.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
}

#[test]
fn a_device_without_progress_is_reported_and_lost() {
    within(Duration::from_secs(120), stall);
}

fn stall() {
    report_stalls(|text| REPORTED.lock().unwrap().push(text.into()));
    let (rows, policies) = expected();
    for (request, info) in support::adapters("a_device_without_progress_is_reported_and_lost") {
        let faults = Arc::new(Stalled(AtomicUsize::new(0)));
        let patience = WaitLimit { wait: Duration::from_millis(20), waits: 3 };
        let found = train(backend(failing(&opened(&request), &faults).waiting(patience), WAYS[0]));
        assert_eq!((found.0, found.1, found.2), (rows.clone(), policies.clone(), 1), "{info}");
        assert_eq!(faults.0.load(SeqCst), 3);
        let reported = REPORTED.lock().unwrap().split_off(0);
        assert_eq!(reported.len(), 2, "{reported:?}");
        assert!(reported[0].contains(&info.name) && reported[0].contains("no progress"), "{reported:?}");
    }
}

/// Has no memory for one of the buffers that opening asks for.
struct Full(&'static str);

impl Faults for Full {
    fn lacks_memory(&self, what: &str) -> bool {
        what == self.0
    }
}

#[test]
fn a_full_device_is_not_called_inexact() {
    for (request, info) in support::adapters("a_full_device_is_not_called_inexact") {
        let gpu = opened(&request);
        for what in ["probe values", "record", "packed record", "a population"] {
            let error = self_test::find_exact(failing(&gpu, &Arc::new(Full(what))), &[gpu.pass]).unwrap_err();
            assert!(matches!(error, DeviceError::OutOfMemory { .. }), "{info}, {what}: {error}");
        }
        self_test::find_exact(gpu.clone(), &[gpu.pass]).unwrap();
    }
}

/// Changes the text of shaders.
struct Edited(fn(String) -> String);

impl Faults for Edited {
    fn edits(&self, text: String) -> String {
        (self.0)(text)
    }
}

/// What only training uses is tested at opening, too.
#[test]
fn opening_tests_everything_that_trains() {
    type Edit = fn(String) -> String;
    let edits: [(&str, Edit); 5] = [
        ("pack", |text| text.replace("size >= enough", "size > enough")),
        ("pack", |text| text.replace("if steps > most", "if steps >= most")),
        ("gather", |text| text.replace("vec4(tile[start], tile[start + 1u]", "vec4(tile[start + 1u], tile[start]")),
        ("breed", |text| text.replace("* brood.sigma", "* 1.0000001 * brood.sigma")),
        ("generic kernel", |text| text.replace("sum += inputs[row] * weight", "sum -= inputs[row] * weight")),
    ];
    for (request, info) in support::adapters("opening_tests_everything_that_trains") {
        let gpu = opened(&request);
        for (what, edit) in edits {
            let found = self_test::find_exact(failing(&gpu, &Arc::new(Edited(edit))), &[gpu.pass]);
            assert!(matches!(found, Err(DeviceError::Inexact { .. })), "{info}: a wrong {what} is taken: {found:?}");
        }
    }
}

/// Plays faster with so many teams per workgroup.
struct Favours(usize);

impl Faults for Favours {
    fn rollout_takes(&self, teams: usize) -> Option<Duration> {
        Some(Duration::from_millis(if teams == self.0 { 1 } else { 2 }))
    }
}

#[test]
fn the_faster_packing_is_kept_and_each_gives_the_same_records() {
    const TEAMS: usize = 1024;
    let world = World::new(&config());
    let weights = sample::weights(&world, 9, 0);
    let teams: Vec<u32> = (0..TEAMS * world.leaders()).map(|place| (place * 7 % 9) as u32).collect();
    let group = Group {
        world: &world,
        starts: &world.starts,
        weights: weights[..].into(),
        policies: 9,
        sharing: Sharing::PerLeader,
        teams: &teams,
        fitnesses: &[Fitness::Df, Fitness::Dpp],
    };
    let few = Group { teams: &teams[..100 * world.leaders()], ..group };
    let (scores, trace) = (Cpu::default().play(&[group]).unwrap(), Cpu::default().trace(&few).unwrap());
    for (request, info) in support::adapters("the_faster_packing_is_kept_and_each_gives_the_same_records") {
        let gpu = opened(&request);
        for (favoured, records) in
            [(32, Records::Whole), (16, Records::Whole), (32, Records::Packed), (16, Records::Packed)]
        {
            let case = format!("{info}, {favoured} teams per workgroup, {records:?}");
            let device = GpuBackend::new(failing(&gpu, &Arc::new(Favours(favoured)))).unwrap();
            let mut device = device.playing(Kernel::Specialised).with_records(records).packing(None);
            // Too few teams to tell.
            assert_eq!(device.trace(&few).unwrap(), trace, "{case}");
            assert_eq!(device.packed(), None, "{case}");
            assert_eq!(device.play(&[group]).unwrap(), scores, "{case}");
            assert_eq!(device.packed(), Some(favoured), "{case}");
            assert_eq!(device.trace(&few).unwrap(), trace, "{case}");
        }
    }
}
