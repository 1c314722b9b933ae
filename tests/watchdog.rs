//! Tests what happens when a device fails: dropped submissions, stale reads, stalls, missing memory, edited kernels.
//!
//! Faults are injected. Every fault must either be reported or leave all results unchanged.

use crate::support;
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
use flotilla::backend::{Backend, BackendError};
use flotilla::config::{Config, Fitness};
use flotilla::evolve::{Breeding, Key, Purpose};
use flotilla::trainer::{Row, Trainer};

fn config() -> Config {
    let mut config = Config::parse(support::SMALL, "small.toml").unwrap();
    config.learning.fitness = Fitness::Df;
    // Few teams observe these POIs at first, and more do later. So the rows depend on which policies have played.
    config.world.pois = vec![[10.0, 10.0], [20.0, 10.5]];
    config
}

/// Returns the device with injected faults.
fn with_faults(gpu: &Gpu, faults: &Arc<impl Faults + 'static>) -> Gpu {
    // SAFETY: the edits in this file change numbers; indices and loops stay as they are.
    #[expect(unsafe_code, reason = "edited shaders are compiled without bounds checks")]
    unsafe {
        gpu.clone().failing(faults.clone())
    }
}

/// Opens a new device, because a lost one stays lost.
fn open_gpu(request: &Request) -> Gpu {
    gpu::open(Request { pass: Some(Pass::NoContraction), ..request.clone() }).unwrap()
}

/// All combinations of where populations are kept and how records are copied.
const MODES: [(ResidencyPolicy, Records); 4] = [
    (ResidencyPolicy::Never, Records::Whole),
    (ResidencyPolicy::Never, Records::CountedFrom(0)),
    (ResidencyPolicy::Always, Records::Whole),
    (ResidencyPolicy::Always, Records::CountedFrom(0)),
];

fn backend(gpu: Gpu, (holding, records): (ResidencyPolicy, Records)) -> GpuBackend {
    GpuBackend::new(gpu).unwrap().with_kernel(Kernel::Generic).with_residency(holding).with_records(records)
}

/// Trains to the end. Returns the rows and the policies, or `None` if the device is lost.
fn train(mut device: GpuBackend) -> Option<(Vec<Row>, Vec<Vec<f32>>)> {
    let mut trainer = Trainer::new([config().validate().unwrap()]);
    match trainer.finish(&mut device) {
        Ok(rows) => Some((rows, trainer.policies(0))),
        Err(BackendError::Gpu(DeviceError::Lost { .. })) => None,
        Err(error) => panic!("{error}"),
    }
}

fn expected() -> (Vec<Row>, Vec<Vec<f32>>) {
    let mut trainer = Trainer::new([config().validate().unwrap()]);
    let rows = trainer.finish(&mut Cpu::default()).unwrap();
    let distinct: HashSet<_> = rows.iter().map(|row| row.mean_g.to_bits()).collect();
    assert!(distinct.len() > 8, "rows are too similar to show which policies played: {distinct:?}");
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

/// Metal after a time-out and DX12 after a removed device signal the fence without running the commands.
#[test]
fn a_dropped_submission_counts_as_a_lost_device() {
    let expected = expected();
    for (request, info) in support::adapters("a_dropped_submission_counts_as_a_lost_device") {
        for mode in MODES {
            for what in ["a population", "episodes", "breeding", "reading back"] {
                for nth in 1.. {
                    let faults = Arc::new(Dropping { what, left: AtomicUsize::new(nth) });
                    let result = train(backend(with_faults(&open_gpu(&request), &faults), mode));
                    let dropped = faults.left.load(SeqCst) == 0 || faults.left.load(SeqCst) > nth;
                    let case = format!("{info}, {mode:?}: {what} {nth}");
                    assert_eq!(result.is_none(), dropped, "{case}");
                    assert!(result.is_none_or(|result| result == expected), "{case}");
                    if !dropped {
                        assert!(nth > 1 || what != "episodes", "{case}: nothing was submitted");
                        break;
                    }
                }
            }
        }
    }
}

/// A watchdog may also stop breeding after some of its workgroups. The fetched policies may not have played yet, so
/// only the fetch can detect this.
#[test]
fn fetching_an_incomplete_population_reports_a_lost_device() {
    const SIZES: [usize; 3] = [2, 50, 64];
    let learning = config().learning;
    let weights: Vec<f32> = (0..SIZES.iter().product()).map(|index| index as f32).collect();
    let parents: Vec<u32> = (0..SIZES[0] * SIZES[1]).map(|place| (place * 7 % SIZES[1]) as u32).collect();
    let key = Key::new(0, 0, Purpose::Mutation);
    let breeding = |generation| Breeding { parents: &parents, key, generation, learning: &learning };
    let skip_a_workgroup: fn(String) -> String = |text| {
        let start = "let counters = (breed_job.parameters";
        text.replace(start, &format!("if workgroup.x == 2u {{ return; }}\n    {start}"))
    };
    assert!(support::edits_a_shader(skip_a_workgroup), "the edit changes no shader");
    for (request, info) in support::adapters("fetching_an_incomplete_population_reports_a_lost_device") {
        let gpu = open_gpu(&request);
        let dropping = |what, nth| Arc::new(Dropping { what, left: AtomicUsize::new(nth) });
        let cases = [
            ("nothing", gpu.clone(), true),
            ("the second population", with_faults(&gpu, &dropping("a population", 2)), false),
            ("the first breeding", with_faults(&open_gpu(&request), &dropping("breeding", 1)), false),
            ("the second breeding", with_faults(&open_gpu(&request), &dropping("breeding", 2)), false),
            ("a workgroup", with_faults(&open_gpu(&request), &Arc::new(Edited(skip_a_workgroup))), false),
        ];
        for (missing, gpu, expected) in cases {
            let case = format!("{info}: {missing} is missing");
            let mut held =
                backend(gpu, MODES[2]).hold(&weights, SIZES).unwrap().expect("the device holds all populations");
            (0..2).for_each(|generation| held.breed(&breeding(generation)).unwrap());
            match held.fetch(&mut vec![0.0; weights.len()]) {
                Err(BackendError::Gpu(DeviceError::Lost { .. })) => assert!(!expected, "{case}"),
                result => assert!(result.is_ok() && expected, "{case}: {result:?}"),
            }
        }
    }
}

/// Returns the previous contents of a buffer at the nth read.
struct Stale {
    left: AtomicUsize,
    before: Mutex<HashMap<wgpu::Buffer, Vec<u8>>>,
    returned: AtomicBool,
}

impl Faults for Stale {
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
fn stale_reads_count_as_a_lost_device() {
    let expected = expected();
    for (request, info) in support::adapters("stale_reads_count_as_a_lost_device") {
        for mode in MODES {
            let mut cases = 0;
            for nth in 1..24 {
                let left = AtomicUsize::new(nth);
                let faults = Arc::new(Stale { left, before: Mutex::default(), returned: AtomicBool::new(false) });
                let result = train(backend(with_faults(&open_gpu(&request), &faults), mode));
                let returned = faults.returned.load(SeqCst);
                assert_eq!(result.is_none(), returned, "{info}, {mode:?}: read {nth}");
                assert!(result.is_none_or(|result| result == expected), "{info}, {mode:?}: read {nth}");
                cases += usize::from(returned);
            }
            assert!(cases > 2, "{info}, {mode:?}: {cases} stale reads");
        }
    }
}

/// A device with a fixed speed and a watchdog that ends submissions of more than two seconds.
struct Slow {
    turns_a_second: u64,
    longest: AtomicU64,
    ended: AtomicUsize,
    /// Submissions of episodes, and waits.
    submitted: AtomicUsize,
    waited: AtomicUsize,
}

impl Faults for Slow {
    fn drops(&self, what: &str, turns: u64) -> bool {
        let turns = if what == "episodes" { turns } else { 0 };
        self.submitted.fetch_add(usize::from(what == "episodes"), SeqCst);
        self.longest.fetch_max(turns, SeqCst);
        let ended = turns > 2 * self.turns_a_second;
        self.ended.fetch_add(usize::from(ended), SeqCst);
        ended
    }

    fn stalls(&self) -> bool {
        self.waited.fetch_add(1, SeqCst);
        false
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
        for mode in [MODES[0], MODES[3]] {
            let (longest, [ended, submitted, waited]) = (AtomicU64::new(0), [0; 3].map(AtomicUsize::new));
            let faults = Arc::new(Slow { turns_a_second: 150_000_000, longest, ended, submitted, waited });
            let mut device = backend(with_faults(&open_gpu(&request), &faults), mode);
            let result = Trainer::new(configs()).finish(&mut device);
            let longest = faults.longest.load(SeqCst) as f64 / faults.turns_a_second as f64;
            assert_eq!(
                faults.ended.load(SeqCst),
                0,
                "{info}: a submission of {longest} s was ended: {:?}",
                result.err()
            );
            assert_eq!(result.unwrap(), rows, "{info}");
            // The speed is unknown at the first trial, so it may take longer than the intended 0.1 s.
            assert!(longest <= 0.25, "{info}: a submission takes {longest} s");
            // A batch of many submissions makes progress with each.
            assert!(faults.waited.load(SeqCst) >= faults.submitted.load(SeqCst), "{info}: submissions share a wait");
            let stages = device.take_times();
            assert!(stages.longest.as_secs_f64() <= 0.25 && !stages.longest.is_zero(), "{:?}", stages.longest);
        }
    }
}

/// Waits never end. Counts them.
struct Stalled(AtomicUsize);

impl Faults for Stalled {
    fn stalls(&self) -> bool {
        self.0.fetch_add(1, SeqCst);
        true
    }
}

static REPORTED: Mutex<Vec<String>> = Mutex::new(Vec::new());

/// Runs a test in its own thread, and fails if it takes longer than `most`. A thread that hangs ends with the process.
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
fn a_stalled_device_is_reported_and_counts_as_lost() {
    within(Duration::from_secs(120), check_stall);
}

fn check_stall() {
    report_stalls(|text| REPORTED.lock().unwrap().push(text.into()));
    for (request, info) in support::adapters("a_stalled_device_is_reported_and_counts_as_lost") {
        let faults = Arc::new(Stalled(AtomicUsize::new(0)));
        let wait_limit = WaitLimit { wait: Duration::from_millis(20), waits: 3 };
        let result = train(backend(with_faults(&open_gpu(&request), &faults).with_wait_limit(wait_limit), MODES[0]));
        assert_eq!(result, None, "{info}");
        assert_eq!(faults.0.load(SeqCst), 3);
        let reported = REPORTED.lock().unwrap().split_off(0);
        assert_eq!(reported.len(), 2, "{reported:?}");
        assert!(reported[0].contains(&info.name) && reported[0].contains("no progress"), "{reported:?}");
    }
}

/// Has no memory for the buffers with this name.
struct OutOfMemory(&'static str);

impl Faults for OutOfMemory {
    fn lacks_memory(&self, what: &str) -> bool {
        what == self.0
    }
}

#[test]
fn a_device_out_of_memory_is_not_reported_as_inexact() {
    for (request, info) in support::adapters("a_device_out_of_memory_is_not_reported_as_inexact") {
        let gpu = open_gpu(&request);
        for what in ["input", "record", "counted", "policies(0)"] {
            let error =
                self_test::find_exact(with_faults(&gpu, &Arc::new(OutOfMemory(what))), &[gpu.pass]).unwrap_err();
            assert!(matches!(error, DeviceError::OutOfMemory { .. }), "{info}, {what}: {error}");
        }
        self_test::find_exact(gpu.clone(), &[gpu.pass]).unwrap();
    }
}

/// Edits the source of shaders.
struct Edited(fn(String) -> String);

impl Faults for Edited {
    fn edits(&self, text: String) -> String {
        (self.0)(text)
    }
}

/// The self-test at opening also covers every measure, and the kernels that only training uses.
#[test]
fn opening_detects_an_edit_of_any_kernel() {
    type Edit = fn(String) -> String;
    let edits: [(&str, Edit); 19] = [
        ("linear density", |text| {
            text.replace("base - exact_sqrt(d2) * (gauge.slope * value)", "base - exact_sqrt(d2)")
        }),
        ("distance", |text| {
            text.replace(
                "on_lattice(exact_sqrt(d2) * (gauge.slope * value), base)",
                "on_lattice(exact_sqrt(d2) * gauge.slope, base) + 1",
            )
        }),
        ("exponential measure", |text| text.replace("k * 2.1219444e-4", "k * 2.13e-4")),
        ("inverse density", |text| text.replace("select(gauge.nearest2, d2, d2 > gauge.nearest2)", "1.001 * d2")),
        ("inverse-squared measure", |text| {
            text.replace("inverse * inverse * value", "inverse * 1.001 * inverse * value")
        }),
        ("mean density", |text| text.replace("recip(nearest_f32(max(count, 1)))", "recip(nearest_f32(max(count, 2)))")),
        ("closest entity", |text| text.replace("max(most, measured.measure)", "min(most, measured.measure)")),
        ("aligned headings", |text| {
            text.replace("on_lattice((*state).hx, own.heading_base)", "on_lattice((*state).hy, own.heading_base)")
        }),
        ("each agent sensed", |text| text.replace("select(0, found.measure, other)", "found.measure + 1")),
        ("nearest agent", |text| text.replace("d2 < least", "d2 > least")),
        ("chosen agent", |text| text.replace("f32(choice) * own.choice_step", "f32(choice + 1u) * own.choice_step")),
        ("moves near others", |text| text.replace("own.near2, me)", "0.3 * own.near2, me)")),
        ("box", |text| text.replace("vec4(own.low_x, own.low_y,", "vec4(own.low_x, own.low_y + 0.5,")),
        ("count", |text| text.replace("size >= coupling", "size > coupling")),
        ("count", |text| text.replace("if most > 0u", "if most >= 0u")),
        ("count", |text| text.replace("completed[coupling - largest] += value", "completed[1] += value")),
        ("gather", |text| text.replace("vec4(tile[start], tile[start + 1u]", "vec4(tile[start + 1u], tile[start]")),
        ("breed", |text| text.replace("* breed_job.sigma", "* 1.0000001 * breed_job.sigma")),
        ("generic kernel", |text| text.replace("sum += inputs[row] * weight", "sum -= inputs[row] * weight")),
    ];
    for (what, edit) in edits {
        assert!(support::edits_a_shader(edit), "an edit of {what} changes no shader");
    }
    for (request, info) in support::adapters("opening_detects_an_edit_of_any_kernel") {
        let gpu = open_gpu(&request);
        for (what, edit) in edits {
            let result = self_test::find_exact(with_faults(&gpu, &Arc::new(Edited(edit))), &[gpu.pass]);
            assert!(
                matches!(result, Err(DeviceError::Inexact { .. })),
                "{info}: an edit of {what} is not detected: {result:?}"
            );
        }
    }
}
