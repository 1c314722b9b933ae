//! Pipelines: the texts of their shaders, and the structs that these share with the host.

use std::collections::HashSet;
use std::fmt::Write;

use super::shape::{Capacity, ClassKind, MAX_THREADS, ROLE, Recorded, Shape, Sizes, WIDTHS, WORKGROUPS};
use crate::backend::grid::LARGE_FROM;
use crate::backend::{MOMENT_WORDS, VECTOR};
use crate::config::{Config, MAX_CLASSES, MAX_SECTORS, Policy};
use crate::config_enum::{Choice, config_enum};
use crate::evolve::{MAX_WEIGHT, MIN_WEIGHT, UNCHANGED};
use crate::gpu_struct::{GpuStruct, gpu_constants, gpu_struct};
use crate::model;
use crate::model::class::{ClassConstants, ClassShape};
use crate::model::follow::TermShape;
use crate::model::policy::{Actions, BEHAVIOURS};
use crate::model::sense::ChannelShape;
use crate::world::{OUTPUTS, World};

/// Maximum agents of teams whose positions are in a workgroup's memory.
const MAX_SHARED: usize = LARGE_FROM - 1;
/// Threads that share the agents of a cell when a learner of a large team senses.
const LANES: usize = 8;
/// Maximum leaders whose sightings a follower counts in registers.
const MAX_COUNTED_LEADERS: usize = 8;
/// Maximum loop iterations per thread and dispatch, over all loops: Mesa's llvmpipe 22.3 abandons every loop after 65 535
/// iterations, and drivers stop a dispatch that runs for seconds.
pub(super) const MAX_ITERATIONS: usize = 60_000;
/// Threads per workgroup of the pipeline that counts, and of those that work on populations.
pub(super) const COUNT_WORKGROUP: usize = 64;
pub(super) const POPULATION_WORKGROUP: usize = 256;
/// Rows and columns of the tile that a workgroup transposes when it gathers policies.
const TILE: usize = 32;
/// Leaders per dispatch that gathers. With three other storage buffers they stay below the 8 that every WebGPU device
/// allows.
pub(super) const LEADERS_PER_GATHER: usize = 4;
/// Sentinel: no offset.
pub(super) const NOWHERE: u32 = u32::MAX;
/// Agents that are taken out or added for a sum of `shaders/count.wgsl`: a leader (D), a leader with its followers (Df), or
/// copies of a leader (D++). 0 means nobody.
pub(super) const LEADER: u32 = 1;
pub(super) const GROUP: u32 = 2;
pub(super) const COPIES: u32 = 3;
/// Coupling from which D++ needs too many copies for a device.
pub(super) const MAX_COPIES: usize = 64;
/// Position of the number of copies in a sum of D++.
pub(super) const COPIES_SHIFT: u32 = 25;

gpu_struct! {
    /// The work of one workgroup: some teams of one group. All offsets are in elements.
    #[derive(Default)]
    pub struct Task {
        /// The index of the world in the batch.
        pub world: u32,
        /// The offset of the agents' start positions.
        pub starts: u32,
        /// The offset of the POI positions.
        pub pois: u32,
        /// The offset of the weights.
        pub weights: u32,
        /// The offset of the sets of agents at each POI.
        pub sets: u32,
        /// The offset of the numbers of steps at which followers saw leaders.
        pub counts: u32,
        /// The offset of a trace.
        pub traced: u32,
        /// The offset of the agents' states between two dispatches.
        pub states: u32,
        /// The number of teams.
        pub teams: u32,
        /// The first step of a dispatch.
        pub first: u32,
        /// The step before which a dispatch ends.
        pub end: u32,
        /// The offset of the coupling, worth and observers of POIs, for `shaders/count.wgsl`.
        pub scoring: u32,
        /// The kinds of sums, two bits each.
        pub kinds: u32,
        /// The offset of the sums, or all ones if the whole record is copied.
        pub counted: u32,
        /// The offset of the status word in the record. The first dispatch writes the nonce there; each later one adds
        /// 1.
        pub status: u32,
        /// A number that no earlier work of the device had.
        pub nonce: u32,
    }

    /// The state of an agent between two dispatches.
    pub struct State {
        /// x, in units.
        pub x: f32,
        /// y, in units.
        pub y: f32,
        /// The heading's cosine.
        pub hx: f32,
        /// The heading's sine.
        pub hy: f32,
        /// The speed, in units per second.
        pub speed: f32,
    }

    /// How to breed one population's next generation.
    pub struct BreedJob {
        /// The slots' key before the slot is xored in, see [`Key::of_population`](crate::evolve::Key::of_population).
        pub key: [u32; 4],
        /// Slots per population.
        pub slots: u32,
        /// Weights per policy.
        pub parameters: u32,
        /// The index of the population.
        pub population: u32,
        /// The offset of its parents in the plan.
        pub parents: u32,
        /// A weight mutates if its random word is below this threshold.
        pub threshold: u32,
        /// Not 0 if every weight mutates.
        pub all: u32,
        /// Not 0 if noise scales with the weight.
        pub scaled: u32,
        /// The standard deviation of the noise.
        pub sigma: f32,
    }

    /// A request to gather policies for consecutive tasks of one group.
    pub struct GatherJob {
        /// Leaders per team.
        pub leaders: u32,
        /// The first leader to gather.
        pub first: u32,
        /// Leaders to gather, up to 4 (`LEADERS_PER_GATHER`).
        pub count: u32,
        /// Weights per policy.
        pub parameters: u32,
        /// Teams of these tasks.
        pub teams: u32,
        /// Teams per task. The last task has the remainder.
        pub teams_per_task: u32,
        /// The offset of the teams' policies in their buffer.
        pub choices: u32,
        /// The offset of the output.
        pub weights: u32,
    }
}

impl GatherJob {
    /// Returns the number of workgroups.
    pub(super) fn workgroups(&self) -> usize {
        (self.teams as usize * self.count as usize).div_ceil(TILE) * (self.parameters as usize).div_ceil(TILE)
    }
}

/// The use of a buffer by a shader.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Binding {
    /// `var<uniform>`.
    Uniform,
    /// `var<storage, read>`.
    Read,
    /// `var<storage, read_write>`.
    Write,
}

/// A pipeline of the crate's own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Pipeline {
    /// Tests a device's arithmetic.
    Probe,
    /// Measures a device's arithmetic ceiling.
    Ceiling,
    /// Makes a population's next generation.
    Breed,
    /// Gathers the policies of a batch's teams.
    Gather,
    /// Computes the sums that scores follow from.
    Count,
    /// Plays episodes.
    Episode(Shape),
    /// Plays a part of a step of large teams.
    Swarm(SwarmPart, Shape),
}

config_enum! {
    /// The parts of a step of large teams, in order, and their entry points in `shaders/swarm.wgsl`.
    #[derive(PartialOrd, Ord)]
    SwarmPart {
        /// Clears the record and the cells before the first step.
        Clear = "clear",
        /// Puts the agents at their start.
        Enter = "enter",
        /// Gives slots to cells.
        Allocate = "allocate",
        /// Puts the agents into the slots.
        Fill = "fill",
        /// Moves learners.
        Learn = "learn",
        /// Moves the other agents.
        ObeyRule = "obey_rule",
    }
}

impl Pipeline {
    /// Returns the name of the shader's entry point.
    pub fn entry(self) -> &'static str {
        match self {
            Pipeline::Probe => "probe",
            Pipeline::Ceiling => "ceiling",
            Pipeline::Breed => "breed",
            Pipeline::Gather => "gather",
            Pipeline::Count => "count_task",
            Pipeline::Episode(_) => "episode",
            Pipeline::Swarm(part, _) => SwarmPart::ALL[part as usize].0,
        }
    }

    /// Returns what an episode's kernel is compiled for.
    pub(super) fn shape(&self) -> Option<Shape> {
        match self {
            Pipeline::Episode(shape) | Pipeline::Swarm(_, shape) => Some(*shape),
            _ => None,
        }
    }

    /// Returns the use of each buffer, from binding 1 of group 0 on. Binding 0 is the guard's.
    pub fn bindings(self) -> &'static [Binding] {
        use Binding::{Read, Write};
        match self {
            Pipeline::Probe => &[Read, Write],
            Pipeline::Ceiling => &[Read, Read, Write],
            Pipeline::Breed => &[Read, Read, Read, Write, Write],
            Pipeline::Gather => &[Read, Read, Read, Write, Read, Read, Read],
            Pipeline::Count => &[Read, Read, Read, Write, Write],
            Pipeline::Episode(_) | Pipeline::Swarm(..) => &[Read, Read, Read, Read, Write, Write, Write, Read],
        }
    }

    /// Returns the text of the shader.
    pub fn text(self) -> String {
        match self {
            Pipeline::Probe => include_str!("../../../shaders/probe.wgsl").into(),
            Pipeline::Ceiling => include_str!("../../../shaders/ceiling.wgsl").into(),
            Pipeline::Breed | Pipeline::Gather => [
                &*gpu_constants!(WORKGROUP = POPULATION_WORKGROUP, TILE, UNCHANGED, MIN_WEIGHT, MAX_WEIGHT),
                &[BreedJob::wgsl(), GatherJob::wgsl()].concat(),
                include_str!("../../../shaders/lib/math.wgsl"),
                include_str!("../../../shaders/population.wgsl"),
            ]
            .join("\n"),
            Pipeline::Count => [
                &*declarations(),
                RECORD_WORD,
                &gpu_constants!(WORKGROUP = COUNT_WORKGROUP, MAX_COPIES, COPIES_SHIFT, LEADER, GROUP, COPIES),
                include_str!("../../../shaders/lib/layout.wgsl"),
                include_str!("../../../shaders/count.wgsl"),
            ]
            .join("\n"),
            Pipeline::Episode(shape) | Pipeline::Swarm(_, shape) => episode(shape),
        }
    }
}

const RECORD_WORD: &str = "alias RecordWord = u32;\n";
/// Threads of several workgroups write one word of a large team's record.
const ATOMIC_RECORD_WORD: &str = "alias RecordWord = atomic<u32>;\n";

/// Returns the structs of episodes and records.
fn declarations() -> String {
    [model::declarations(), Task::wgsl(), State::wgsl()].concat()
}

/// Returns the shader of episodes for a shape, of large teams or of others.
fn episode(shape: Shape) -> String {
    let Shape { workgroup, slots, trace, sizes } = shape;
    let (shared, in_registers, counted) = match sizes {
        // The agents of one large team, or of several small ones.
        Sizes::Any { .. } => ((workgroup * slots).min(MAX_SHARED), false, 1),
        Sizes::Fixed { teams, leaders, agents, .. } => {
            let in_registers = leaders < agents && leaders as usize <= MAX_COUNTED_LEADERS;
            (teams * agents as usize, in_registers, if in_registers { leaders } else { 1 })
        }
    };
    let constants = gpu_constants!(
        ROLE,
        WORKGROUP = workgroup,
        SLOTS = slots,
        SHARED = shared,
        TRACE = trace,
        COUNTS_IN_REGISTERS = in_registers,
        COUNTED_LEADERS = counted,
        MAX_SECTORS,
        MAX_CLASSES,
        MOMENT_WORDS,
        LANES,
    );
    let own = format!(
        "fn class_constants(class_number: u32) -> ClassConstants {{ return {}; }}\n",
        ClassConstants::copied_from("classes[class_number]")
    );
    let front = match sizes {
        Sizes::Any { widest, large } => [
            gpu_constants!(
                INPUTS = widest,
                CHOICES = widest,
                MAY_ALIGN = true,
                MAY_BE_GONE = true,
                MAY_PURSUE = !large
            ),
            getter("shape_of", "class_number: u32", &ClassShape::copied_from("classes[class_number]"), "ClassShape"),
            getter(
                "channel_of",
                "class_number: u32, index: u32",
                &ChannelShape::copied_from("classes[class_number].channels[index]"),
                "ChannelShape",
            ),
            getter(
                "term_of",
                "class_number: u32, index: u32",
                &TermShape::copied_from("classes[class_number].terms[index]"),
                "TermShape",
            ),
            include_str!("../../../shaders/generic.wgsl").into(),
        ]
        .concat(),
        Sizes::Fixed { teams, leaders, agents, pois, widths, kinds, chooses, gone, sightings } => {
            let outputs = widths.into_iter().rfind(|&width| width > 0).expect("a policy has outputs");
            let (words, classes, inputs) = (agents.div_ceil(32), kinds.len(), widths[0]);
            let any = |is: fn(&ClassShape) -> bool| kinds.iter().any(|kind| is(&kind.shape));
            let pursues = any(|shape| shape.pursues() || shape.end_near > 0);
            let confines = any(|shape| shape.boxed != 0);
            let aligns = kinds.iter().flat_map(|kind| &kind.terms).any(|term| term.aligns != 0);
            format!(
                "{}const shape = Shape({leaders}u, {agents}u, {pois}u, {words}u, {classes}u, {inputs}u, {teams}u, {aligns}, \
                 {pursues}, {confines}, {gone}, {sightings});\nfn set_shape(task: Task) {{}}\n{}{}",
                gpu_constants!(INPUTS = inputs, CHOICES = outputs, MAY_ALIGN = aligns, MAY_BE_GONE = gone),
                straight_classes(kinds),
                straight_policy(&widths, chooses, pursues)
            )
        }
    };
    let structs = declarations();
    let libraries = [include_str!("../../../shaders/lib/layout.wgsl"), include_str!("../../../shaders/lib/math.wgsl")];
    let (word, driver) = match shape.is_large() {
        true => (ATOMIC_RECORD_WORD, include_str!("../../../shaders/swarm.wgsl")),
        false => (RECORD_WORD, include_str!("../../../shaders/episode.wgsl")),
    };
    let parts = [&*constants, &front, &own, &structs, word].into_iter().chain(libraries).chain(model::WGSL);
    parts.chain([include_str!("../../../shaders/agent.wgsl"), driver]).collect::<Vec<_>>().join("\n")
}

/// Returns a function that returns an expression.
fn getter(name: &str, parameters: &str, expression: &str, kind: &str) -> String {
    format!("fn {name}({parameters}) -> {kind} {{ return {expression}; }}\n")
}

/// Returns the functions of `shaders/generic.wgsl` that depend on the classes, with their loops unrolled and all shapes as
/// constants.
fn straight_classes(kinds: &[ClassKind]) -> String {
    let mut text = String::from("fn class_shape(index: u32) -> ClassShape {\n");
    let (last, others) = kinds.split_last().expect("a world has a class");
    for (index, kind) in others.iter().enumerate() {
        text += &format!("    if index == {index}u {{ return {}; }}\n", kind.shape.literal());
    }
    text += &format!("    return {};\n}}\n", last.shape.literal());
    let parameters = "task: Task, first: u32, me: ptr<function, Agent>";
    // With the class as a constant, all threads load the same numbers of it, once per wave.
    text += &format!("fn act({parameters}) {{\n");
    for (class, kind) in kinds.iter().enumerate() {
        let role = if kind.shape.control().learns() { "lead" } else { "follow" };
        text += &format!("    if (*me).class_index == {class}u {{\n        load_class({class}u);\n");
        text += &format!("        {role}(task, first, me);\n        move_agent(first, me);\n        return;\n    }}\n");
    }
    text += "}\n";
    text += &format!("fn sense_all({parameters}, inputs: ptr<function, array<f32, INPUTS>>) {{\n");
    for (class, kind) in kinds.iter().enumerate().filter(|(_, kind)| !kind.channels.is_empty()) {
        text += &format!("    if own_class == {class}u {{\n");
        for (index, channel) in kind.channels.iter().enumerate() {
            text += &format!("        sense_channel(task, first, {}, {index}u, me, inputs);\n", channel.literal());
        }
        text += "    }\n";
    }
    text += &format!("}}\nfn obey_all({parameters}, force: ptr<function, SteeringForce>) {{\n");
    for (class, kind) in kinds.iter().enumerate().filter(|(_, kind)| !kind.terms.is_empty()) {
        text += &format!("    if own_class == {class}u {{\n");
        let mut index = 0;
        for terms in kind.terms.chunk_by(|a, b| a == b).flat_map(|terms| terms.chunks(2)) {
            let (term, pair) = (terms[0].literal(), terms.len() == 2);
            text += &format!("        obey_terms(task, first, {term}, {index}u, {pair}, me, force);\n");
            index += terms.len();
        }
        text += "    }\n";
    }
    text + "}\n"
}

/// Returns a policy of these widths as straight-line code: `decide` of `shaders/generic.wgsl` with its loops unrolled.
/// Each unit is a variable. Weights are loaded four at a time, in order of use, so that a compiler may start many loads
/// before it waits for the first.
///
/// Policies of classes that choose agents do so if any `pursues`, and others choose behaviours if `chooses`.
fn straight_policy(widths: &[u32; WIDTHS], chooses: bool, pursues: bool) -> String {
    let mut text = String::from("fn decide(start: u32, stride: u32, inputs: array<f32, INPUTS>) -> vec2<f32> {\n");
    let mut line = |line: std::fmt::Arguments<'_>| writeln!(text, "    {line}").expect("a string takes a line");
    let mut read = HashSet::new();
    let mut inputs: Vec<String> = (0..widths[0]).map(|input| format!("inputs[{input}]")).collect();
    let mut first = 0;
    let layers = widths.windows(2).take_while(|pair| pair[1] > 0);
    for (layer, pair) in layers.enumerate() {
        let (rows, columns) = (pair[0] as usize, pair[1] as usize);
        // Biases first.
        for row in std::iter::once(rows).chain(0..rows) {
            for column in 0..columns {
                let weight = first + row * columns + column;
                let (vector, axis) = (weight / VECTOR, AXES[weight % VECTOR]);
                if read.insert(vector) {
                    line(format_args!("let w{vector} = weights[start + {vector}u * stride];"));
                }
                match row == rows {
                    true => line(format_args!("var s{layer}_{column} = w{vector}.{axis};")),
                    false => line(format_args!("s{layer}_{column} += {} * w{vector}.{axis};", inputs[row])),
                }
            }
        }
        inputs = (0..columns).map(|column| format!("u{layer}_{column}")).collect();
        for (column, unit) in inputs.iter().enumerate() {
            line(format_args!("let {unit} = activate(s{layer}_{column});"));
        }
        first += (rows + 1) * columns;
    }
    if pursues {
        let all = inputs.join(", ");
        line(format_args!("if own.control == CONTROLKIND_CHOOSE {{ return choose_agent(array({all})); }}"));
    }
    match chooses {
        false => line(format_args!("return vec2({});", inputs[..OUTPUTS].join(", "))),
        true => line(format_args!(
            "return choose(vec4(inputs[0], inputs[1], inputs[2], inputs[3]), vec4(inputs[4], inputs[5], inputs[6], \
             inputs[7]), array({}));",
            inputs[..BEHAVIOURS].join(", ")
        )),
    }
    text + "}\n"
}

const AXES: [&str; VECTOR] = ["x", "y", "z", "w"];

/// Returns the name and the text of every shader, for lints and exactness tests. Of the episode's there are some
/// variants, generic and specialised for the paper's first layout.
pub fn shaders() -> Vec<(&'static str, String)> {
    const PLAIN: Recorded = Recorded { trace: false, sightings: false };
    const SIGHTINGS: Recorded = Recorded { sightings: true, ..PLAIN };
    const TRACE: Recorded = Recorded { trace: true, sightings: true };
    let generic = |workgroup, slots, widest, trace| {
        Pipeline::Episode(Shape { workgroup, slots, trace, sizes: Sizes::Any { widest, large: false } })
    };
    let swarm = |trace| {
        let sizes = Sizes::Any { widest: 16, large: true };
        Pipeline::Swarm(SwarmPart::Clear, Shape { workgroup: WORKGROUPS[0], slots: 1, trace, sizes })
    };
    let specialised = |records, actions: Actions| {
        let text = include_str!("../../../configs/generally_forward.toml");
        let config = Config::parse(text, "generally_forward.toml").expect("the project's own config");
        let config = Config { policy: Policy { actions, ..config.policy }, ..config };
        let world = World::new(&config.validate().expect("the project's own config"));
        let shape = Shape::specialised(&world, Capacity::of_workgroups(MAX_THREADS), records);
        Pipeline::Episode(shape.expect("the paper's layouts have specialised kernels").0)
    };
    let all = [
        ("probe", Pipeline::Probe),
        ("ceiling", Pipeline::Ceiling),
        ("episode", generic(64, 1, 16, false)),
        ("episode, traced", generic(128, 1, 64, true)),
        ("episode, agents in turn", generic(256, 5, 64, false)),
        ("episode, specialised", specialised(PLAIN, Actions::Direct)),
        ("episode, specialised, behaviours", specialised(PLAIN, Actions::Behaviours)),
        ("episode, specialised, with sights", specialised(SIGHTINGS, Actions::Direct)),
        ("episode, specialised, traced", specialised(TRACE, Actions::Direct)),
        ("swarm", swarm(false)),
        ("swarm, traced", swarm(true)),
        ("count", Pipeline::Count),
        ("population", Pipeline::Breed),
    ];
    all.map(|(name, pipeline)| (name, pipeline.text())).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Such policies have two outputs, fewer than there are behaviours.
    #[test]
    fn policies_that_all_choose_agents_may_have_the_actions_behaviours() {
        let text = "[policy]\nactions = 'behaviours'\n[[agents]]\nname = 'scout'\nat = [[1, 1]]\ncontrol = 'choose:post'\n\
                    motion = { kind = 'free' }\nsenses = [{ of = 'pois' }]\n[[agents]]\nname = 'post'\nat = [[2, 2]]\n\
                    control = 'still'\n[[pois]]\nname = 'place'\nat = [[5, 5]]\ncoupling = 1\n";
        let world = World::new(&Config::parse(text, "scout.toml").unwrap().validate().unwrap());
        let records = Recorded { trace: false, sightings: false };
        let (shape, _) = Shape::specialised(&world, Capacity::of_workgroups(MAX_THREADS), records).unwrap();
        assert!(Pipeline::Episode(shape).text().contains("choose_agent(array("));
    }
}
