//! The self-test of a device: small computations whose bits must equal the CPU's.

use glam::Vec2;

use super::device::{self, DeviceError, Executor, Gpu, Kind, Request, Workspace};
use super::episode::{GpuBackend, Kernel, Records, ResidencyPolicy};
use super::exact::Pass;
use super::recording::{Buffer, Command, Recording};
use super::source::Pipeline;
use crate::backend::compare::{compare_breeding, compare_traces, first_difference};
use crate::backend::cpu::Cpu;
use crate::backend::{Backend, BackendError, Group, Weights};
use crate::config::{Config, Fitness, Learning};
use crate::config_enum::Choice;
use crate::evolve::aligned_teams;
use crate::kernels::math;
use crate::model::sense::Density;
use crate::sample;
use crate::world::World;

/// One probe. Describes the first difference from the CPU under the device's current pass, if any.
type Probe = fn(&Executor) -> Result<Option<String>, BackendError>;

/// All probes that a pass must survive, the quickest first.
const ALL: &[Probe] = &[arithmetic, episode, training];

/// Opens an adapter, and finds the first pass under which every probe gives the CPU's bits: no contraction on Vulkan,
/// else guarded.
///
/// # Errors
/// There is no such adapter, it cannot be opened, or it is not exact under any pass.
pub fn open(request: impl Into<Request>) -> Result<Gpu, DeviceError> {
    let request = request.into();
    let (adapter, info) = device::choose(&request.adapter)?;
    let (passthrough, timestamps) = (wgpu::Features::PASSTHROUGH_SHADERS, wgpu::Features::TIMESTAMP_QUERY);
    let features = adapter.features() & (passthrough | timestamps);
    let own = adapter.get_info().backend == wgpu::Backend::Vulkan && features.contains(passthrough);
    let candidates = match request.pass {
        Some(Pass::NoContraction) if !own => {
            let reason = "the no-contraction pass needs Vulkan".into();
            return Err(DeviceError::Refused { adapter: info.to_string(), reason });
        }
        Some(pass) => vec![pass],
        None if own => vec![Pass::NoContraction, Pass::Guarded],
        None => vec![Pass::Guarded],
    };
    let limits = if request.default_limits { wgpu::Limits::defaults() } else { adapter.limits() };
    let gpu = Gpu::new(&adapter, info, candidates[0], limits, features, request.checked)?;
    find_exact(gpu, &candidates)
}

/// Returns a device under the first of some passes that survives every probe. [`Pass::Plain`] is not tested.
///
/// # Errors
/// None does, or the device failed.
#[doc(hidden)]
pub fn find_exact(mut gpu: Gpu, candidates: &[Pass]) -> Result<Gpu, DeviceError> {
    let mut failures = Vec::new();
    for &pass in candidates {
        gpu.pass = pass;
        if pass == Pass::Plain {
            return Ok(gpu);
        }
        let executor = Executor::new(gpu.clone());
        match run(&executor) {
            Ok(None) => return Ok(gpu.with_tested(executor.pipelines())),
            Ok(Some(mismatch)) => failures.push((pass, mismatch)),
            // These say nothing about the arithmetic.
            Err(error @ (DeviceError::Lost { .. } | DeviceError::OutOfMemory { .. })) => return Err(error),
            Err(error) => failures.push((pass, error.to_string())),
        }
    }
    Err(DeviceError::Inexact { adapter: gpu.adapter.to_string(), failures })
}

/// Runs every probe under the device's current pass. Describes the first difference from the CPU, if any.
///
/// # Errors
/// The device failed.
pub fn self_test(gpu: &Gpu) -> Result<Option<String>, DeviceError> {
    run(&Executor::new(gpu.clone()))
}

fn run(executor: &Executor) -> Result<Option<String>, DeviceError> {
    let refused = |error| match error {
        BackendError::Gpu(error) => error,
        error => DeviceError::Refused { adapter: executor.gpu.adapter.to_string(), reason: error.to_string() },
    };
    ALL.iter().find_map(|probe| probe(executor).transpose()).transpose().map_err(refused)
}

/// Words per group of values.
const WORDS: usize = 37;
/// Groups of four values, the inputs of [`arithmetic`].
const ITEMS: usize = 4096;
const WORKGROUP: usize = 64;

/// Tests contraction, reassociation, conversion and comparison on [`ITEMS`] groups of values.
fn arithmetic(executor: &Executor) -> Result<Option<String>, BackendError> {
    let values = values();
    let mut recording = Recording::new("probe");
    let bytes = (ITEMS * WORDS * size_of::<u32>()) as u64;
    let bindings = vec![recording.input(Buffer::Input, &values), recording.buffer(Buffer::Output, bytes)];
    let (output, grid) = (bindings[1].clone(), [ITEMS.div_ceil(WORKGROUP) as u32, 1, 1]);
    recording.commands.push(Command::Dispatch { pipeline: Pipeline::Probe, bindings, grid, iterations: 0 });
    recording.read_back(output);
    let mut workspace = Workspace::default();
    let submitted = executor.run(&recording, &mut workspace, &[])?;
    let words: Vec<u32> = executor.read(&submitted, &workspace, &recording.readback, bytemuck::pod_collect_to_vec)?;
    Ok((0..ITEMS).zip(words.chunks_exact(WORDS)).find_map(|(item, words)| {
        let mut probes = expected(&values, item).into_iter().zip(words);
        let ((name, expected), found) = probes.find(|((_, expected), found)| expected != *found)?;
        let inputs: Vec<String> = values[item * 4..][..4].iter().map(|value| format!("{value:e}")).collect();
        let inputs = inputs.join(", ");
        Some(format!("probe \"{name}\" gives {found:#010x} instead of {expected:#010x} from {inputs}"))
    }))
}

/// A world with what the paper's layouts lack.
const CLASSES: &str = include_str!("self_test.toml");

/// Returns the world of the paper's first layout, with a density, and its config.
fn world(density: Density) -> (World, Config) {
    let mut config = Config::parse(include_str!("../../../configs/generally_forward.toml"), "generally_forward.toml")
        .expect("the project's own config");
    config.sense.density = density;
    (World::new(&config.validate().expect("the project's own config")), config)
}

/// Tests an episode with each density, and one with classes of agents, stage by stage.
fn episode(executor: &Executor) -> Result<Option<String>, BackendError> {
    const TEAMS: usize = 8;
    let mut backend = GpuBackend::with_executor(executor.clone());
    if executor.gpu.adapter.kind != Kind::Software {
        backend = backend.with_kernel(Kernel::Specialised);
    }
    let classes = Config::parse(CLASSES, "self_test.toml").and_then(|config| config.validate());
    let classes = World::new(&classes.expect("the project's own config"));
    let worlds = Density::ALL.iter().map(|&(name, density)| (format!("{name} density"), world(density).0));
    for (name, world) in worlds.chain([("classes of agents".into(), classes)]) {
        let weights = sample::weights(&world, TEAMS, 0);
        let teams = aligned_teams(TEAMS, world.leaders());
        let group = Group::new(&world, &weights[..], TEAMS, &teams);
        if let Some(mismatch) = compare_traces(&group, &mut Cpu::default(), &mut backend)? {
            return Ok(Some(format!("an episode with {name} differs: {mismatch}")));
        }
    }
    Ok(None)
}

/// Tests what a generation of training uses: populations on the device, from which teams are gathered, both kernels, and
/// sums of their records.
fn training(executor: &Executor) -> Result<Option<String>, BackendError> {
    const TEAMS: usize = 64;
    let (world, config) = world(Density::ALL[0].1);
    let (leaders, sizes) = (world.leaders(), [world.leaders(), TEAMS, world.parameters()]);
    let weights = sample::weights(&world, TEAMS, 1);
    let place = |place: usize| ((place / leaders * (2 * (place % leaders) + 1) + place % leaders) % TEAMS) as u32;
    let teams: Vec<u32> = (0..TEAMS * leaders).map(place).collect();
    // Wrong sums show if just enough agents are at a POI, and if followers at one saw no leader. So each POI has three
    // agents, two of them only followers. D++ shows what copies add, so one POI has only a leader there.
    const POI_OF_AGENT: [usize; 12] = [1, 1, 2, 2, 0, 0, 0, 3, 3, 3, 1, 2];
    let start = |(agent, &poi): (usize, &usize)| {
        world.pois[poi] + Vec2::new((agent % 3) as f32, 0.5 * (agent / leaders) as f32)
    };
    let together: Vec<Vec2> = POI_OF_AGENT.iter().enumerate().map(start).collect();
    let away = |(agent, &start): (usize, &Vec2)| if agent % 3 == 2 { start + Vec2::new(0.0, 20.0) } else { start };
    let apart: Vec<Vec2> = together.iter().enumerate().map(away).collect();
    let group = Group::new(&world, &weights[..], TEAMS, &teams);
    let groups = [
        Group { starts: &together, fitnesses: &[Fitness::D, Fitness::Df], ..group },
        Group { starts: &apart, fitnesses: &[Fitness::Dpp], ..group },
    ];
    let expected = Cpu::default().play(&groups)?;
    let learning = Learning { mutation_probability: 0.5, ..config.learning };
    // Software renderers play by the generic kernel, see [`GpuBackend::with_kernel`].
    let kernels = [Kernel::Generic, Kernel::Specialised];
    let kernels = if executor.gpu.adapter.kind == Kind::Software { &kernels[..1] } else { &kernels };
    for &kernel in kernels {
        let backend = GpuBackend::with_executor(executor.clone()).with_kernel(kernel);
        let mut backend = backend.with_residency(ResidencyPolicy::Always).with_records(Records::CountedFrom(0));
        if let Some(mismatch) = compare_breeding(&weights, sizes, &learning, &mut backend)? {
            return Ok(Some(format!("breeding differs: {mismatch}")));
        }
        let held = backend.hold(&weights, sizes)?.expect("the device holds all populations");
        let groups = groups.map(|group| Group { weights: Weights::OnDevice(&*held), ..group });
        if let Some((_, mismatch)) = first_difference(&groups, &expected, &backend.play(&groups)?) {
            return Ok(Some(format!("a rollout as in training by the {kernel} kernel differs: {mismatch}")));
        }
    }
    Ok(None)
}

/// Returns reproducible values on which rounding shows: zeros, equal pairs, small integers, sums that nearly cancel,
/// and full mantissas over 2^-12 to 2^12. No intermediate value is below 2^-100 other than 0.
fn values() -> Vec<f32> {
    let mut values = Vec::with_capacity(ITEMS * 4);
    for item in 0..ITEMS {
        let mut group = math::pcg4d_scalar([item as u32, 0, 0, 0]).map(|word| {
            let exponent = 127 - 12 + (word >> 23 & 0xff) % 24;
            f32::from_bits(word & 0x807f_ffff | exponent << 23)
        });
        match item % 8 {
            0 => group[item / 8 % 4] = 0.0,
            1 => group[1] = group[0],
            2 => group = group.map(|value| (value * 0.01).round()),
            3 => group[2] = group[0] * group[1],
            4 => group[2] = -(group[0] * group[1]),
            _ => {}
        }
        // `+ 0.0` turns a -0 from rounding into 0.
        values.extend(group.map(|value| value + 0.0));
    }
    values
}

fn bits(x: f32) -> u32 {
    let word = x.to_bits();
    if word == 0x8000_0000 { 0 } else { word }
}

fn mixed(v: [f32; 4]) -> u32 {
    let [x, y, z, w] = v.map(bits);
    x ^ y.wrapping_mul(3) ^ z.wrapping_mul(5) ^ w.wrapping_mul(7)
}

fn product(a: f32, b: f32) -> f32 {
    a * b
}

fn reciprocal(d: f32) -> f32 {
    let mut r = f32::from_bits(0x7ef3_11c3 - d.to_bits());
    for _ in 0..3 {
        r = r * (2.0 - d * r);
    }
    r
}

fn reciprocal_root(d: f32) -> f32 {
    let mut r = f32::from_bits(0x5f37_59df - (d.to_bits() >> 1));
    for _ in 0..3 {
        r = r * (1.5 - 0.5 * d * r * r);
    }
    r
}

/// Returns each computation of `shaders/probe.wgsl`, in its order, and its word.
#[allow(clippy::eq_op, reason = "x*y - y*x is 0 but where it is contracted")]
fn expected(values: &[f32], item: usize) -> [(&'static str, u32); WORDS] {
    let v: [f32; 4] = std::array::from_fn(|i| values[item * 4 + i]);
    let [x, y, z, w] = v;
    let select = |otherwise: f32, then: f32, condition: bool| if condition { then } else { otherwise };
    let kept = if w > 0.0 { x * y + z } else { x * y - w };
    let mut sum = 0.0;
    let mut products = 0.0;
    for k in 0..16 {
        let value = values[(item * 4 + k) % values.len()];
        sum += value;
        products += value * y;
    }
    let flags = [x < y, x <= y, x == y, x >= y, x * y > z];
    [
        ("x*y + z", bits(x * y + z)),
        ("x*y - z", bits(x * y - z)),
        ("z - x*y", bits(z - x * y)),
        ("x*y + y*z", bits(x * y + y * z)),
        ("x*y - x*z", bits(x * y - x * z)),
        ("x*y - y*x", bits(x * y - y * x)),
        ("(x + y) - x", bits((x + y) - x)),
        ("(x - y) + y", bits((x - y) + y)),
        ("((x + y) + z) + w", bits(((x + y) + z) + w)),
        ("x + (y + (z + w))", bits(x + (y + (z + w)))),
        ("((x*y)*z)*w", bits(((x * y) * z) * w)),
        ("x*(y*(z*w))", bits(x * (y * (z * w)))),
        ("x + x + x", bits(x + x + x)),
        ("(x*0.1)*10", bits((x * 0.1) * 10.0)),
        ("(x + 4096) - 4096", bits((x + 4096.0) - 4096.0)),
        ("x*2.7 + x*0.3", bits(x * 2.7 + x * 0.3)),
        ("x*x + y*y + z*z", bits(x * x + y * y + z * z)),
        ("-(x*y) + z", bits(-(x * y) + z)),
        ("abs(x*y - z)", bits((x * y - z).abs())),
        ("product(x, y) + z", bits(product(x, y) + z)),
        ("a product kept over a branch", bits(kept)),
        ("a selected product, plus z", bits(select(x * y, z * w, x < y) + z)),
        ("vectors, v*v + v", mixed(std::array::from_fn(|i| v[i] * v[(i + 1) % 4] + v[(i + 2) % 4]))),
        ("vectors, v*y - (v + v)", mixed(std::array::from_fn(|i| v[i] * y - (v[i] + v[(i + 3) % 4])))),
        ("a polynomial", bits(((x * 0.3 + 0.7) * x - 1.1) * x + 0.9)),
        ("Newton's reciprocal", bits(reciprocal(1.0 + x.abs()))),
        ("Newton's reciprocal root", bits(reciprocal_root(1.0 + y.abs()))),
        ("a sum in a loop", bits(sum)),
        ("a sum of products in a loop", bits(products)),
        ("floor(x*y)", bits((x * y).floor())),
        ("u32 to f32", bits((x.to_bits() >> 8) as f32)),
        ("i32 to f32", bits((x.to_bits() as i32 >> 7) as f32)),
        ("f32 to u32 and i32", x.abs() as u32 ^ y as i32 as u32),
        ("comparisons", (0..).zip(flags).map(|(bit, flag)| u32::from(flag) << bit).sum()),
        ("selection by comparison", bits(select(x, y, x <= y)) ^ bits(select(z, w, z >= w))),
        ("bit casts", bits(f32::from_bits(z.to_bits() & 0x7fff_ffff) + f32::from_bits(w.to_bits() & 0x7fff_0000))),
        ("sums compared by their bits", u32::from(x.abs() * 1.00001 + 4096.0 <= x.abs() + 4096.0)),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    type Formula = fn([f32; 4]) -> f32;

    /// Returns how many groups give another word for `probe` by this formula.
    fn shown(probe: &str, formula: Formula) -> usize {
        let values = values();
        let differs = |item: &usize| {
            let group = std::array::from_fn(|i| values[item * 4 + i]);
            let (_, expected) =
                *expected(&values, *item).iter().find(|(name, _)| *name == probe).expect("a probe's name");
            bits(formula(group)) != expected
        };
        (0..ITEMS).filter(differs).count()
    }

    #[test]
    fn the_values_show_contraction_and_reassociation() {
        let fused: [(&str, Formula); 9] = [
            ("x*y + z", |[x, y, z, _]| x.mul_add(y, z)),
            ("x*y - z", |[x, y, z, _]| x.mul_add(y, -z)),
            ("z - x*y", |[x, y, z, _]| (-x).mul_add(y, z)),
            ("x*y + y*z", |[x, y, z, _]| x.mul_add(y, y * z)),
            ("x*y - y*x", |[x, y, ..]| x.mul_add(y, -(y * x))),
            ("x*x + y*y + z*z", |[x, y, z, _]| z.mul_add(z, x * x + y * y)),
            ("-(x*y) + z", |[x, y, z, _]| (-x).mul_add(y, z)),
            ("product(x, y) + z", |[x, y, z, _]| x.mul_add(y, z)),
            ("a product kept over a branch", |[x, y, z, w]| x.mul_add(y, if w > 0.0 { z } else { -w })),
        ];
        let reassociated: [(&str, Formula); 11] = [
            ("x*y + y*z", |[x, y, z, _]| y * (x + z)),
            ("x*y - x*z", |[x, y, z, _]| x * (y - z)),
            ("(x + y) - x", |[_, y, ..]| y),
            ("(x - y) + y", |[x, ..]| x),
            ("((x + y) + z) + w", |[x, y, z, w]| (x + y) + (z + w)),
            ("x + (y + (z + w))", |[x, y, z, w]| ((x + y) + z) + w),
            ("((x*y)*z)*w", |[x, y, z, w]| (x * y) * (z * w)),
            ("(x*0.1)*10", |[x, ..]| x),
            ("(x + 4096) - 4096", |[x, ..]| x),
            ("x*2.7 + x*0.3", |[x, ..]| x * 3.0),
            ("sums compared by their bits", |[x, ..]| f32::from_bits(u32::from(x.abs() * 1.00001 <= x.abs()))),
        ];
        for (probe, formula) in fused.into_iter().chain(reassociated) {
            let groups = shown(probe, formula);
            assert!(groups > ITEMS / 50, "{probe}: only {groups} groups show it");
        }
        assert_eq!(shown("x*y + z", |[x, y, z, _]| x * y + z), 0);
    }

    #[test]
    fn no_value_comes_near_the_denormals() {
        assert!(
            values().iter().all(|&value| value == 0.0 && value.is_sign_positive() || value.abs() >= 1.0 / 33_554_432.0)
        );
    }
}
