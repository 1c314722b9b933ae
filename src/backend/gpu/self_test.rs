//! The self-test of a device: small computations whose bits must equal the CPU's.

use std::collections::BTreeSet;
use std::sync::Mutex;

use glam::Vec2;
use wgpu::BufferUsages;

use super::device::{self, Binding, DeviceError, Gpu, Kind, Request};
use super::episode::{GpuBackend, Kernel, Records, ResidencyPolicy};
use super::exact::Pass;
use crate::backend::compare::{compare_breeding, compare_traces};
use crate::backend::cpu::Cpu;
use crate::backend::{Backend, BackendError, Group, Weights};
use crate::config::{Config, Fitness, Learning};
use crate::config_enum::Choice;
use crate::credit::{Episode, Seen};
use crate::model::sense::Density;
use crate::parallel::lock;
use crate::sample;
use crate::world::World;

/// The shader of the arithmetic probe.
pub(super) const SHADER: &str = include_str!("../../../shaders/probe.wgsl");

/// One probe. Describes the first difference from the CPU under the device's current pass, if any.
type Probe = fn(&Gpu) -> Result<Option<String>, BackendError>;

/// All probes that a pass must survive, the quickest first.
///
/// A new probe is a function here. It compiles its shader with `gpu.own_pipeline`, which applies the pass under test.
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
        match self_test(&gpu.keeping_pipelines()) {
            Ok(None) => return Ok(gpu),
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
    let refused = |error| match error {
        BackendError::Gpu(error) => error,
        error => DeviceError::Refused { adapter: gpu.adapter.to_string(), reason: error.to_string() },
    };
    ALL.iter().find_map(|probe| probe(gpu).transpose()).transpose().map_err(refused)
}

/// The computations of [`arithmetic`], in the order of `shaders/probe.wgsl`.
const NAMES: [&str; 37] = [
    "x*y + z",
    "x*y - z",
    "z - x*y",
    "x*y + y*z",
    "x*y - x*z",
    "x*y - y*x",
    "(x + y) - x",
    "(x - y) + y",
    "((x + y) + z) + w",
    "x + (y + (z + w))",
    "((x*y)*z)*w",
    "x*(y*(z*w))",
    "x + x + x",
    "(x*0.1)*10",
    "(x + 4096) - 4096",
    "x*2.7 + x*0.3",
    "x*x + y*y + z*z",
    "-(x*y) + z",
    "abs(x*y - z)",
    "product(x, y) + z",
    "a product kept over a branch",
    "a selected product, plus z",
    "vectors, v*v + v",
    "vectors, v*y - (v + v)",
    "a polynomial",
    "Newton's reciprocal",
    "Newton's reciprocal root",
    "a sum in a loop",
    "a sum of products in a loop",
    "floor(x*y)",
    "u32 to f32",
    "i32 to f32",
    "f32 to u32 and i32",
    "comparisons",
    "selection by comparison",
    "bit casts",
    "sums compared by their bits",
];

/// Groups of four values, the inputs of [`arithmetic`].
const ITEMS: usize = 4096;
const WORKGROUP: usize = 64;

/// Tests contraction, reassociation, conversion and comparison on [`ITEMS`] groups of values.
fn arithmetic(gpu: &Gpu) -> Result<Option<String>, BackendError> {
    let values = values();
    let bytes = (ITEMS * NAMES.len() * size_of::<u32>()) as u64;
    let from = gpu.upload("probe values", &values, BufferUsages::STORAGE)?;
    let to = gpu.buffer("probe words", bytes, BufferUsages::STORAGE | BufferUsages::COPY_SRC)?;
    let layout = gpu.layout("probe", &[Binding::Read, Binding::Write])?;
    let pipeline = gpu.own_pipeline("probe", SHADER, "probe", &layout)?;
    let buffers = gpu.bind("probe", &layout, &[from.as_entire_buffer_binding(), to.as_entire_buffer_binding()])?;
    gpu.dispatch("probe", &pipeline, &buffers, [ITEMS.div_ceil(WORKGROUP) as u32, 1, 1])?;
    let words: Vec<u32> = gpu.read(&[(&to, 0..bytes)])?;
    Ok((0..ITEMS).zip(words.chunks_exact(NAMES.len())).find_map(|(item, words)| {
        let expected = expected(&values, item);
        let differs = (0..NAMES.len()).find(|&probe| words[probe] != expected[probe])?;
        let inputs: Vec<String> = values[item * 4..][..4].iter().map(|value| format!("{value:e}")).collect();
        Some(format!(
            "probe \"{}\" gives {:#010x} instead of {:#010x} from {}",
            NAMES[differs],
            words[differs],
            expected[differs],
            inputs.join(", ")
        ))
    }))
}

/// The paper's first layout.
fn config() -> Config {
    Config::parse(include_str!("../../../configs/generally_forward.toml"), "generally_forward.toml")
        .expect("the project's own config")
}

/// Tests an episode with each density, stage by stage.
fn episode(gpu: &Gpu) -> Result<Option<String>, BackendError> {
    const TEAMS: usize = 8;
    let mut backend = GpuBackend::new(gpu.clone())?;
    if gpu.adapter.kind != Kind::Software {
        backend = backend.with_kernel(Kernel::Specialised);
    }
    for (_, density) in Density::ALL {
        let mut config = config();
        config.sense.density = *density;
        let world = World::new(&config.validate().expect("the project's own config"));
        let weights = sample::weights(&world, TEAMS, 0);
        let teams: Vec<u32> = (0..TEAMS as u32).flat_map(|team| vec![team; world.leaders()]).collect();
        let group = Group {
            world: &world,
            starts: &world.starts,
            weights: weights[..].into(),
            policies: TEAMS,
            teams: &teams,
            populations: &world.populations,
            fitnesses: &[],
        };
        if let Some(mismatch) = compare_traces(&group, &mut Cpu::default(), &mut backend)? {
            return Ok(Some(format!("an episode with {density} density differs: {mismatch}")));
        }
    }
    Ok(None)
}

/// Tests what a generation of training uses: populations on the device, from which 64 teams are gathered, both kernels,
/// and packed records.
fn training(gpu: &Gpu) -> Result<Option<String>, BackendError> {
    const TEAMS: usize = 64;
    let config = config();
    let world = World::new(&config.validate().expect("the project's own config"));
    let (leaders, sizes) = (world.leaders(), [world.leaders(), TEAMS, world.parameters()]);
    let weights = sample::weights(&world, TEAMS, 1);
    let place = |place: usize| ((place / leaders * (2 * (place % leaders) + 1) + place % leaders) % TEAMS) as u32;
    let teams: Vec<u32> = (0..TEAMS * leaders).map(place).collect();
    // Leaders start at POIs, alone, and followers out of sight, so that small sets and followers without a leader
    // matter.
    let start = |agent: usize| match agent.checked_sub(leaders) {
        None => world.pois[agent % world.pois.len()],
        Some(follower) => world.pois[follower % world.pois.len()] + Vec2::new(0.0, 11.0 + 3.5 * follower as f32 / 2.0),
    };
    let starts: Vec<Vec2> = (0..world.agents()).map(start).collect();
    let group = Group {
        world: &world,
        starts: &starts,
        weights: weights[..].into(),
        policies: TEAMS,
        populations: &world.populations,
        teams: &teams,
        fitnesses: &[Fitness::D, Fitness::Df, Fitness::Dpp],
    };
    let trace = Cpu::default().trace(&group)?;
    let expected: Vec<_> = (0..TEAMS).map(|team| what_scores_depend_on(&world, &trace.episode(&world, team))).collect();
    let learning = Learning { mutation_probability: 0.5, ..config.learning };
    // Software renderers play by the generic kernel, see [`GpuBackend::with_kernel`].
    let kernels = [Kernel::Generic, Kernel::Specialised];
    let kernels = if gpu.adapter.kind == Kind::Software { &kernels[..1] } else { &kernels };
    for &kernel in kernels {
        let backend = GpuBackend::new(gpu.clone())?.with_kernel(kernel);
        let mut backend = backend.with_residency(ResidencyPolicy::Always).with_records(Records::Packed);
        if let Some(mismatch) = compare_breeding(&weights, sizes, &learning, &mut backend)? {
            return Ok(Some(format!("breeding differs: {mismatch}")));
        }
        let held = backend.hold(&weights, sizes)?.expect("the device holds all populations");
        let found = Mutex::new(vec![Vec::new(); TEAMS]);
        let note = |_, team: usize, episode: &Episode<'_>| {
            let words = what_scores_depend_on(&world, episode);
            lock(&found)[team] = words;
        };
        backend.visit(&[Group { weights: Weights::OnDevice(&*held), ..group }], &note)?;
        let found = lock(&found);
        if let Some(team) = (0..TEAMS).find(|&team| expected[team] != found[team]) {
            return Ok(Some(format!("a rollout as in training by the {kernel} kernel differs: team {team}")));
        }
    }
    Ok(None)
}

/// Returns what the scores of a team depend on, in a form that packing does not change: per POI the sets that no other
/// set contains, and the leader that each follower saw most. Sets are of one word. Scores alone would miss some edits of
/// the kernel that packs records.
fn what_scores_depend_on(world: &World, episode: &Episode<'_>) -> Vec<u32> {
    let (pois, leaders, followers) = (world.pois.len(), world.leaders(), world.followers());
    let mut words = Vec::new();
    for poi in 0..pois {
        let sets: BTreeSet<u32> = episode.sets.iter().skip(poi).step_by(pois).filter(|&set| set != 0).collect();
        let contained = |set: u32| sets.iter().any(|&other| other != set && other & set == set);
        words.extend(sets.iter().filter(|&&set| !contained(set)));
        // Where the sets of one POI end.
        words.push(0);
    }
    match episode.seen {
        Seen::Counts(counts) => words.extend((0..followers).map(|follower| {
            let steps = |leader: &usize| counts.get(follower * leaders + leader);
            // The first leader wins ties.
            let most = (0..leaders).rev().max_by_key(steps).filter(|leader| steps(leader) > 0);
            most.map_or(u32::from(u8::MAX), |leader| leader as u32)
        })),
        Seen::Owners(owners) => {
            words.extend((0..followers).map(|follower| owners.get(follower / 4) >> (8 * (follower % 4)) & 0xff));
        }
    }
    words
}

/// Returns reproducible values on which rounding shows: zeros, equal pairs, small integers, sums that nearly cancel,
/// and full mantissas over 2^-12 to 2^12. No intermediate value is below 2^-100 other than 0.
fn values() -> Vec<f32> {
    let mut state = 0u64;
    let mut next = || {
        // splitmix64
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut word = state;
        word = (word ^ (word >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        word = (word ^ (word >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        word ^ (word >> 31)
    };
    let mut values = Vec::with_capacity(ITEMS * 4);
    for item in 0..ITEMS {
        let mut group: [f32; 4] = std::array::from_fn(|_| {
            let word = next();
            let exponent = 127 - 12 + (word >> 32) as u32 % 24;
            let sign = (word >> 63) as u32;
            f32::from_bits(sign << 31 | exponent << 23 | word as u32 & 0x7f_ffff)
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

/// Twin of `probe` in `shaders/probe.wgsl`.
#[allow(clippy::eq_op, reason = "x*y - y*x is 0 but where it is contracted")]
fn expected(values: &[f32], item: usize) -> [u32; NAMES.len()] {
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
        bits(x * y + z),
        bits(x * y - z),
        bits(z - x * y),
        bits(x * y + y * z),
        bits(x * y - x * z),
        bits(x * y - y * x),
        bits((x + y) - x),
        bits((x - y) + y),
        bits(((x + y) + z) + w),
        bits(x + (y + (z + w))),
        bits(((x * y) * z) * w),
        bits(x * (y * (z * w))),
        bits(x + x + x),
        bits((x * 0.1) * 10.0),
        bits((x + 4096.0) - 4096.0),
        bits(x * 2.7 + x * 0.3),
        bits(x * x + y * y + z * z),
        bits(-(x * y) + z),
        bits((x * y - z).abs()),
        bits(product(x, y) + z),
        bits(kept),
        bits(select(x * y, z * w, x < y) + z),
        mixed(std::array::from_fn(|i| v[i] * v[(i + 1) % 4] + v[(i + 2) % 4])),
        mixed(std::array::from_fn(|i| v[i] * y - (v[i] + v[(i + 3) % 4]))),
        bits(((x * 0.3 + 0.7) * x - 1.1) * x + 0.9),
        bits(reciprocal(1.0 + x.abs())),
        bits(reciprocal_root(1.0 + y.abs())),
        bits(sum),
        bits(products),
        bits((x * y).floor()),
        bits((x.to_bits() >> 8) as f32),
        bits((x.to_bits() as i32 >> 7) as f32),
        x.abs() as u32 ^ y as i32 as u32,
        (0..).zip(flags).map(|(bit, flag)| u32::from(flag) << bit).sum(),
        bits(select(x, y, x <= y)) ^ bits(select(z, w, z >= w)),
        bits(f32::from_bits(z.to_bits() & 0x7fff_ffff) + f32::from_bits(w.to_bits() & 0x7fff_0000)),
        u32::from(x.abs() * 1.00001 + 4096.0 <= x.abs() + 4096.0),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    type Formula = fn([f32; 4]) -> f32;

    /// Returns how many groups give another word for `probe` by this formula.
    fn shown(probe: &str, formula: Formula) -> usize {
        let values = values();
        let index = NAMES.iter().position(|name| *name == probe).expect("it is one of the probes");
        let differs = |item: &usize| {
            let group = std::array::from_fn(|i| values[item * 4 + i]);
            bits(formula(group)) != expected(&values, *item)[index]
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
