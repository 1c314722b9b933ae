//! A layout of the paper, the teams of it that one workgroup plays, and what must come of that.

use flotilla::backend::cpu::Cpu;
use flotilla::backend::gpu::episode::{Kernel, Workgroup, workgroup_of};
use flotilla::backend::gpu::exact::Pass;
use flotilla::backend::{Backend, Group};
use flotilla::bench::operations::{self, Reach};
use flotilla::config::Sharing;
use flotilla::sample;
use flotilla::world::World;

use crate::driver::Compiled;
use crate::machine::{Chip, Cost, GARBAGE};
use crate::support;

/// The bindings of the record and of where the agents stand in the end.
const RECORD: usize = 5;
const STATES: usize = 7;

pub struct Case {
    pub name: String,
    kernel: Kernel,
    /// Whether a smaller workgroup than it takes by itself was asked for.
    is_cut: bool,
    pub workgroup: Workgroup,
    /// The CPU's result.
    record: Vec<u32>,
    states: Vec<u32>,
    /// The operations counted for a step of a team.
    operations: f64,
    steps: usize,
    pub agent_steps: u64,
}

/// The result of running it on a chip.
pub struct Run {
    /// Words of the record, and of where the agents stand in the end, that are not the CPU's.
    pub differ: usize,
    pub cost: Cost,
    /// The part of the chip's f32 rate that is counted operations.
    pub share: f64,
}

impl Case {
    /// The paper's layouts, by kernels and by the threads of the largest workgroup, where these make a difference.
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
        const MOST: usize = 64;
        let weights = sample::weights(world, MOST, 1);
        let choice: Vec<u32> = (0..MOST * world.leaders()).map(|seat| (seat / world.leaders()) as u32).collect();
        let group = |teams: usize| Group {
            world,
            starts: &world.starts,
            weights: weights[..].into(),
            policies: MOST,
            sharing: Sharing::PerLeader,
            teams: &choice[..teams * world.leaders()],
            fitnesses: &[],
        };
        let name = format!("{name}, {kernel}, {threads}");
        let workgroup = workgroup_of(&group(MOST), kernel, threads).unwrap_or_else(|error| panic!("{name}: {error}"));
        let teams = workgroup.teams;
        let trace = Cpu::default().trace(&group(teams)).expect("the CPU plays");
        let mut record = vec![0; workgroup.buffers[RECORD].len()];
        for team in 0..teams {
            let episode = trace.episode(world, team);
            for (index, word) in episode.sets.iter().chain(episode.seen.words().iter()).enumerate() {
                record[index * teams + team] = word;
            }
        }
        let ends = &trace.moments[world.steps() * teams * world.agents()..];
        let states = ends.iter().flat_map(|end| {
            let ([x, y], [hx, hy]) = (end.position, end.heading);
            [x, y, hx, hy, end.speed].map(f32::to_bits)
        });
        let reach = Reach::of(world, &trace);
        Case {
            name,
            kernel,
            is_cut: threads < 1024,
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

    /// Runs what a chip's compiler made of its kernel.
    pub fn run(&self, chip: &Chip, Compiled { statistics, assembly }: &Compiled) -> Run {
        let mut buffers = self.workgroup.buffers.clone();
        buffers[RECORD].fill(GARBAGE);
        buffers[STATES].fill(GARBAGE);
        let cost = chip.run(assembly, self.workgroup.threads, &mut buffers);
        let differ = |binding: usize, expected: &[u32]| {
            assert_eq!(buffers[binding].len(), expected.len());
            buffers[binding].iter().zip(expected).filter(|(a, b)| a != b).count()
        };
        let differ = differ(RECORD, &self.record) + differ(STATES, &self.states);
        let registers = statistics["VGPRs"] as usize;
        let share = chip.share(self.operations * self.team_steps(), self.workgroup.threads, registers, cost);
        Run { differ, cost, share }
    }

    /// Lanes' turns that a step of a team takes, whether they have anything to do or not.
    pub fn slots(&self, chip: &Chip, cost: Cost) -> f64 {
        (cost.vector * chip.wave as u64) as f64 / self.team_steps()
    }

    /// Cycles that a step takes the slowest wave alone.
    pub fn alone(&self, cost: Cost) -> f64 {
        cost.alone as f64 / self.steps as f64
    }

    /// The share of a chip's f32 rate that is asked of it: of kernels made for their world, in workgroups as large as
    /// they are best.
    pub fn least(&self, chip: &Chip, pass: Pass) -> f64 {
        match (pass, self.kernel) {
            (_, Kernel::Generic) => 0.0,
            _ if self.is_cut => 0.0,
            (Pass::Guarded, _) => 0.4,
            // RDNA 3 gets by with fewer registers, and waits longer for memory.
            _ if self.name.starts_with("chaotic") || chip.family == "GFX1100" => 0.6,
            _ => 0.7,
        }
    }
}
