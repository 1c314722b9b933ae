//! Test cases: a layout of the paper, the teams that one workgroup plays, and the results that the CPU expects.

use flotilla::backend::cpu::Cpu;
use flotilla::backend::gpu::episode::{Kernel, WorkgroupBuffers, workgroup_of};
use flotilla::backend::gpu::exact::Pass;
use flotilla::backend::{Backend, Group};
use flotilla::config::own_populations;
use flotilla::evolve::aligned_teams;
use flotilla::sample;
use flotilla::world::World;
use flotilla_cli::measure::operations::{self, Reach};

use crate::driver::Compiled;
use crate::machine::{Chip, Cost, GARBAGE};
use crate::support;

/// The bindings of the record of the episode, and of the final states of the agents.
const RECORD: usize = 5;
const STATES: usize = 7;

pub struct Case {
    pub name: String,
    kernel: Kernel,
    /// Whether the size of workgroups is limited to less than the kernel would choose.
    is_limited: bool,
    pub workgroup: WorkgroupBuffers,
    /// The results of the CPU.
    record: Vec<u32>,
    states: Vec<u32>,
    /// Arithmetic operations per team and step, as counted by [`operations`].
    operations: f64,
    steps: usize,
    pub agent_steps: u64,
}

/// The result of running a case on an emulated chip.
pub struct Run {
    /// Number of words of the record and of the final states that differ from the CPU's.
    pub differences: usize,
    pub cost: Cost,
    /// The counted operations as a share of the chip's f32 rate.
    pub share: f64,
}

impl Case {
    /// Returns the paper's layouts with both kernels and two limits for the threads of a workgroup. Cases with equal
    /// shaders are left out.
    pub fn all() -> Vec<Case> {
        let kernels = [(Kernel::Generic, 256), (Kernel::Specialised, 1024), (Kernel::Specialised, 256)];
        let layouts = support::papers_worlds().into_iter();
        let mut cases: Vec<Case> = layouts
            .flat_map(|(name, world)| kernels.map(|(kernel, threads)| Case::new(&name, &world, kernel, threads)))
            .collect();
        cases.dedup_by(|b, a| a.workgroup.shader == b.workgroup.shader);
        cases
    }

    fn new(name: &str, world: &World, kernel: Kernel, threads: usize) -> Case {
        const MAX_TEAMS: usize = 64;
        let weights = sample::weights(world, MAX_TEAMS, 1);
        let choice = aligned_teams(MAX_TEAMS, world.leaders());
        let group = |teams: usize| Group {
            populations: own_populations(world.leaders()),
            ..Group::new(world, &weights[..], MAX_TEAMS, &choice[..teams * world.leaders()])
        };
        let name = format!("{name}, {kernel}, {threads}");
        let workgroup =
            workgroup_of(&group(MAX_TEAMS), kernel, threads).unwrap_or_else(|error| panic!("{name}: {error}"));
        let teams = workgroup.teams;
        let trace = Cpu::default().trace(&group(teams)).expect("the CPU plays");
        let mut record = vec![0; workgroup.buffers[RECORD].len()];
        for team in 0..teams {
            let episode = trace.episode(world, team);
            for (index, word) in episode.sets.iter().chain(episode.seen.iter()).enumerate() {
                record[index * teams + team] = word;
            }
        }
        let last = &trace.moments[world.steps() * teams * world.agents()..];
        let states = last.iter().flat_map(|agent| {
            let ([x, y], [hx, hy]) = (agent.position, agent.heading);
            [x, y, hx, hy, agent.speed].map(f32::to_bits)
        });
        let reach = Reach::of(world, &trace);
        Case {
            name,
            kernel,
            is_limited: threads < 1024,
            workgroup,
            record,
            states: states.collect(),
            operations: operations::per_team_step(world, &reach),
            steps: world.steps(),
            agent_steps: (teams * world.steps() * world.agents()) as u64,
        }
    }

    fn team_steps(&self) -> f64 {
        (self.workgroup.teams * self.steps) as f64
    }

    /// Runs the compiled kernel on an emulated chip.
    pub fn run(&self, chip: &Chip, Compiled { statistics, assembly }: &Compiled) -> Run {
        let mut buffers = self.workgroup.buffers.clone();
        buffers[RECORD].fill(GARBAGE);
        buffers[STATES].fill(GARBAGE);
        let cost = chip.run(assembly, self.workgroup.threads, &mut buffers);
        let compare = |binding: usize, expected: &[u32]| {
            assert_eq!(buffers[binding].len(), expected.len());
            buffers[binding].iter().zip(expected).filter(|(a, b)| a != b).count()
        };
        let differences = compare(RECORD, &self.record) + compare(STATES, &self.states);
        let registers = statistics["VGPRs"] as usize;
        let share = chip.share(self.operations * self.team_steps(), self.workgroup.threads, registers, cost);
        Run { differences, cost, share }
    }

    /// Returns the lane slots per team-step: vector instructions times lanes, including idle lanes.
    pub fn slots(&self, chip: &Chip, cost: Cost) -> f64 {
        (cost.vector * chip.wave as u64) as f64 / self.team_steps()
    }

    /// Returns the cycles per step of the slowest wave, if it has the machine for itself.
    pub fn cycles(&self, cost: Cost) -> f64 {
        cost.slowest_wave as f64 / self.steps as f64
    }

    /// Returns the required share of a chip's f32 rate. It is 0 except for specialised kernels in workgroups of the
    /// size that they choose.
    pub fn min_share(&self, chip: &Chip, pass: Pass) -> f64 {
        match (pass, self.kernel) {
            (_, Kernel::Generic) => 0.0,
            _ if self.is_limited => 0.0,
            (Pass::Guarded, _) => 0.33,
            // On RDNA 3, kernels use fewer registers and wait longer for memory.
            _ if self.name.starts_with("chaotic") || chip.family == "GFX1100" => 0.52,
            _ => 0.6,
        }
    }
}
