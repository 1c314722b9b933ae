//! The text of the episode's shaders.

use std::collections::HashSet;
use std::fmt::Write;

use crate::backend::gpu::exact;
use crate::backend::{BackendError, FOUR, Group, Moment, Weights, fours};
use crate::config::MAX_AGENTS;
use crate::gpu_struct::{GpuStruct, gpu_constants};
use crate::model::policy::Actions;
use crate::model::{self, Constants, Variant};
use crate::world::{INPUTS, OUTPUTS, World};

use super::Records;
use super::planner::{NOWHERE, PACK_WORKGROUP, PlannedTask, State, Task, gather, plan};
use super::shape::{Capacity, Kernel, ROLE, Recorded, Shape, Sizes, TEAMS, WIDTHS, WORKGROUPS, Workgroup};

/// Maximum leaders whose sightings a follower counts in registers.
const SIGHTS: usize = 8;

/// Returns the shader that packs records.
pub(super) fn packing() -> String {
    let most = WORKGROUPS[WORKGROUPS.len() - 1].max(TEAMS[0]);
    let structs = [model::declarations(), Task::wgsl(), State::wgsl(), Moment::wgsl()].concat();
    exact::assemble(&[
        &structs,
        &gpu_constants!(WORKGROUP = PACK_WORKGROUP, TEAMS = most, NOWHERE),
        include_str!("../../../../shaders/lib/layout.wgsl"),
        include_str!("../../../../shaders/pack.wgsl"),
    ])
}

/// Returns the episode's shader for a shape.
pub(super) fn source(shape: Shape) -> String {
    let Shape { workgroup, slots, records: Recorded { trace, sights: sighted }, sizes } = shape;
    let (shared, tally, sights) = match sizes {
        // The agents of one large team, or of several small ones.
        Sizes::Any { .. } => ((workgroup * slots).min(MAX_AGENTS), false, 1),
        Sizes::Fixed { teams, leaders, agents, .. } => {
            let tally = leaders < agents && leaders as usize <= SIGHTS;
            (teams * agents as usize, tally, if tally { leaders } else { 1 })
        }
    };
    let constants = gpu_constants!(
        ROLE,
        WORKGROUP = workgroup,
        SLOTS = slots,
        SHARED = shared,
        TRACE = trace,
        SIGHTED = sighted,
        TALLY = tally,
        SIGHTS = sights,
    );
    let front = match sizes {
        Sizes::Any { widest, chooses } => {
            let variant = Variant::copied_from("world");
            let generic = include_str!("../../../../shaders/generic.wgsl");
            format!(
                "{}fn world_variant() -> Variant {{ return {variant}; }}\n{generic}",
                gpu_constants!(WIDEST = widest, CHOOSES = chooses)
            )
        }
        Sizes::Fixed { teams, leaders, agents, pois, widths, variant } => format!(
            "const shape = Shape({leaders}u, {agents}u, {pois}u, {words}u, {teams}u);\nconst variant = {variant};\n\
             fn set_shape(task: Task) {{}}\n{}",
            straight_policy(&widths),
            words = agents.div_ceil(32),
            variant = variant.value()
        ),
    };
    let structs = [Task::wgsl(), State::wgsl(), Moment::wgsl()].concat();
    let (front, math) =
        ([constants, front, model::declarations(), structs], include_str!("../../../../shaders/lib/math.wgsl"));
    let front = front.iter().map(String::as_str).chain([include_str!("../../../../shaders/lib/layout.wgsl"), math]);
    let parts = front.chain(model::WGSL).chain([include_str!("../../../../shaders/episode.wgsl")]);
    exact::assemble(&parts.collect::<Vec<_>>())
}

/// Returns a policy of these widths as straight-line code: `decide` of `shaders/generic.wgsl` with its loops unrolled.
/// Each unit is a variable. Weights are loaded four at a time, in order of use, so that a compiler may start many loads
/// before it waits for the first.
fn straight_policy(widths: &[u32; WIDTHS]) -> String {
    let mut text = String::from("fn decide(start: u32, stride: u32, inputs: array<f32, INPUTS>) -> vec2<f32> {\n");
    let mut line = |line: std::fmt::Arguments<'_>| writeln!(text, "    {line}").expect("a string takes a line");
    let mut read = HashSet::new();
    let mut inputs: Vec<String> = (0..INPUTS).map(|input| format!("inputs[{input}]")).collect();
    let mut first = 0;
    let layers = widths.windows(2).take_while(|pair| pair[1] > 0);
    for (layer, pair) in layers.enumerate() {
        let (rows, columns) = (pair[0] as usize, pair[1] as usize);
        // Biases first.
        for row in std::iter::once(rows).chain(0..rows) {
            for column in 0..columns {
                let weight = first + row * columns + column;
                let (four, axis) = (weight / FOUR, AXES[weight % FOUR]);
                if read.insert(four) {
                    line(format_args!("let w{four} = weights[start + {four}u * stride];"));
                }
                match row == rows {
                    true => line(format_args!("var s{layer}_{column} = w{four}.{axis};")),
                    false => line(format_args!("s{layer}_{column} += {} * w{four}.{axis};", inputs[row])),
                }
            }
        }
        inputs = (0..columns).map(|column| format!("u{layer}_{column}")).collect();
        for (column, unit) in inputs.iter().enumerate() {
            line(format_args!("let {unit} = activate(s{layer}_{column});"));
        }
        first += (rows + 1) * columns;
    }
    match inputs.len() {
        OUTPUTS => line(format_args!("return vec2({});", inputs.join(", "))),
        _ => line(format_args!("return choose(inputs, array({}));", inputs.join(", "))),
    }
    text + "}\n"
}

const AXES: [&str; FOUR] = ["x", "y", "z", "w"];

/// Returns some variants of the episode's shader, generic and specialised for the paper's first layout, each with a
/// name.
pub fn shaders() -> Vec<(&'static str, String)> {
    let generic = |workgroup, slots, widest, records: Recorded| {
        source(Shape { workgroup, slots, records, sizes: Sizes::Any { widest, chooses: records.trace } })
    };
    let specialised = |records, actions: Actions| {
        let widths = [INPUTS as u32, 10, actions.outputs() as u32, 0, 0];
        let variant = Variant { density: 0, by_sine: 1 };
        let sizes = Sizes::Fixed { teams: 32, leaders: 4, agents: 12, pois: 4, widths, variant };
        source(Shape { workgroup: 384, slots: 1, records, sizes })
    };
    let [little, sights, trace] =
        [(false, false), (false, true), (true, true)].map(|(trace, sights)| Recorded { trace, sights });
    vec![
        ("episode", generic(64, 1, 16, little)),
        ("episode, traced", generic(128, 1, 64, trace)),
        ("episode, large teams", generic(256, 5, 64, little)),
        ("episode, specialised", specialised(little, Actions::Direct)),
        ("episode, specialised, behaviours", specialised(little, Actions::Behaviours)),
        ("episode, specialised, with sights", specialised(sights, Actions::Direct)),
        ("episode, specialised, traced", specialised(trace, Actions::Direct)),
        ("pack", packing()),
    ]
}

/// Returns the shader that would play a world, to inspect what compilers make of it: the specialised one if there is
/// one, else the generic one. `threads` is the maximum per workgroup.
#[doc(hidden)]
pub fn shader_of(world: &World, kernel: Kernel, threads: usize) -> String {
    let capacity = Capacity::of_workgroups(threads);
    let little = Recorded { trace: false, sights: false };
    let made = Shape::asked_for(world, kernel, capacity, little);
    source(made.unwrap_or_else(|| Shape::generic(world, Workgroup::generic(world, threads), little)))
}

/// The inputs and outputs of one workgroup that plays a group's first teams, to run what compilers make of its shader.
#[doc(hidden)]
pub struct WorkgroupBuffers {
    /// The text of the shader.
    pub shader: String,
    /// Threads of the workgroup.
    pub threads: usize,
    /// Teams that it plays.
    pub teams: usize,
    /// The words of each binding: the guard (empty), worlds, tasks, positions, weights; and the outputs record, moments
    /// (empty) and states.
    pub buffers: [Vec<u32>; 8],
}

/// Returns the workgroup that plays a group's first teams in one dispatch, with policies on the host. It writes the
/// agents' final states, as if another dispatch followed. `threads` is the maximum per workgroup.
///
/// # Errors
/// A team exceeds the limits of any device.
#[doc(hidden)]
pub fn workgroup_of(group: &Group<'_>, kernel: Kernel, threads: usize) -> Result<WorkgroupBuffers, BackendError> {
    let capacity = Capacity::of_workgroups(threads);
    let made = Shape::asked_for(group.world, kernel, capacity, Recorded::of(group, false));
    let batches = plan(&[*group], false, Records::Whole, capacity, &made.into_iter().collect())?;
    let batch = &batches[0];
    let PlannedTask { task, first_team, shape, .. } = batch.tasks[0];
    let mut weights = vec![[0.0; FOUR]; fours(group.world) * task.teams as usize];
    if let Weights::OnHost(policies) = group.weights {
        gather(group, policies, first_team, task.teams as usize, &mut weights);
    }
    let words = |bytes: &[u8]| bytemuck::pod_collect_to_vec(bytes);
    let world = Constants { steps: task.end + 1, ..batch.worlds[0] };
    let agents = group.world.agents() * task.teams as usize;
    Ok(WorkgroupBuffers {
        shader: source(shape),
        threads: shape.workgroup,
        teams: task.teams as usize,
        buffers: [
            vec![0; 4],
            words(bytemuck::bytes_of(&world)),
            words(bytemuck::bytes_of(&task)),
            words(bytemuck::cast_slice(&batch.places)),
            words(bytemuck::cast_slice(&weights)),
            vec![0; task.status as usize + 1],
            Vec::new(),
            vec![0; agents * size_of::<State>() / 4],
        ],
    })
}
