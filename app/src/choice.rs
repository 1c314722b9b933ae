//! Chooses the processor that is expected to finish first, if the user requests none. Results do not depend on it.

use std::ops::AddAssign;

use flotilla::backend::BackendError;
use flotilla::backend::gpu::device::DeviceError;
use flotilla::backend::gpu::episode::{GpuBackend, ResidencyPolicy};
use flotilla::config::Config;
use flotilla::front::{self, Processor};

/// Minimum agent-steps per generation for a GPU. An NVIDIA H100 and 16 threads beside it take the same time for
/// generations of about 1000 teams of 12 agents and 25 steps: at 512 teams the threads are faster, at 4096 the GPU is
/// (docs/help/gpus.md).
const MIN_PER_GENERATION: f64 = 1000.0 * 12.0 * 25.0;
/// Minimum agent-steps in all for opening a GPU, which takes 0.2 s on an H100. These threads need about 5 s for them.
const MIN_TOTAL: f64 = 4e9;

/// Episodes to play.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Work {
    generations: f64,
    agent_steps: f64,
}

impl Work {
    /// Returns the work of trainings that advance side by side.
    pub fn of<'a>(configs: impl IntoIterator<Item = &'a Config>) -> Work {
        configs.into_iter().fold(Work::default(), |work, config| {
            let generations = (config.learning.generations + 1) as f64;
            let trials = config.learning.trials as f64;
            Work {
                generations: work.generations.max(generations),
                agent_steps: work.agent_steps + generations * trials * generation(config),
            }
        })
    }

    pub fn of_generation(config: &Config) -> Work {
        let agent_steps = config.learning.trials as f64 * generation(config);
        Work { generations: 1.0, agent_steps }
    }

    /// Returns the work of playing this many teams of a config.
    pub fn of_teams(config: &Config, teams: usize) -> Work {
        Work { generations: 1.0, agent_steps: teams as f64 * team(config) }
    }
}

impl AddAssign for Work {
    fn add_assign(&mut self, other: Work) {
        self.generations += other.generations;
        self.agent_steps += other.agent_steps;
    }
}

impl Work {
    /// Returns why a GPU does not pay for this work, for people. `None` means that it does.
    fn is_little(self) -> Option<&'static str> {
        match self {
            _ if self.agent_steps < MIN_TOTAL => Some("too little work for a GPU to pay"),
            _ if self.agent_steps < MIN_PER_GENERATION * self.generations => {
                Some("too few teams per generation for a GPU to pay")
            }
            _ => None,
        }
    }
}

/// The total work of a process that plays many short pieces. Together they may be worth a GPU.
#[derive(Debug, Default)]
pub struct WorkTotal {
    /// All work so far.
    all: Work,
    /// All work when a GPU was last searched for.
    looked: Work,
}

impl WorkTotal {
    /// Returns a total of no work.
    pub const fn new() -> WorkTotal {
        const NONE: Work = Work { generations: 0.0, agent_steps: 0.0 };
        WorkTotal { all: NONE, looked: NONE }
    }

    /// Adds some work. Returns the total if [`find`] should choose again: when it is no longer little, and each time it
    /// has doubled.
    pub fn add(&mut self, work: Work) -> Option<Work> {
        self.all += work;
        let is_due = self.all.agent_steps >= 2.0 * self.looked.agent_steps && self.all.is_little().is_none();
        is_due.then(|| {
            self.looked = self.all;
            self.all
        })
    }
}

/// A search for the processor that plays some work.
#[derive(Default)]
pub struct Chosen {
    /// The opened GPU, if one plays. Otherwise the CPU does.
    pub gpu: Option<GpuBackend>,
    /// Why it was chosen, for people, if nobody asked for it.
    pub reason: Option<&'static str>,
    /// The reason why an existing GPU cannot be used.
    pub passed_over: Option<DeviceError>,
}

/// Opens the GPU that a processor asks for, if any, see [`front::find_gpu`]. With [`Processor::Auto`], `work` decides.
/// Without it, any usable GPU is taken.
pub fn find(
    processor: &Processor,
    holding: Option<ResidencyPolicy>,
    work: Option<Work>,
) -> Result<Chosen, BackendError> {
    let work = work.filter(|_| *processor == Processor::Auto && holding != Some(ResidencyPolicy::Always));
    if let Some(reason) = work.and_then(Work::is_little) {
        return Ok(Chosen { reason: Some(reason), ..Chosen::default() });
    }
    let (gpu, passed_over) = front::find_gpu(processor, holding)?;
    let reason = if gpu.is_some() { "enough work for a GPU to pay" } else { "no GPU found" };
    let reason = work.filter(|_| passed_over.is_none()).map(|_| reason);
    Ok(Chosen { gpu, reason, passed_over })
}

/// Returns the agent-steps of one trial's generation.
fn generation(config: &Config) -> f64 {
    (config.max_teams() * config.learning.episodes_per_team) as f64 * team(config)
}

/// Returns the agent-steps of one team's episode. This is an estimate, which ignores stages.
fn team(config: &Config) -> f64 {
    (config.agent_count() * config.world.steps) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn work(population: usize, generations: usize, trials: usize) -> Work {
        let text = flotilla::config::LAYOUTS[0].1;
        let mut config = Config::parse(text, "generally_forward.toml").unwrap();
        (config.learning.population, config.learning.generations) = (population, generations);
        config.learning.trials = trials;
        Work::of([&config])
    }

    #[test]
    fn long_runs_with_large_generations_get_a_gpu() {
        let is_little = |population, generations| work(population, generations, 1).is_little();
        assert_eq!(is_little(50, 200), Some("too little work for a GPU to pay"));
        assert_eq!(is_little(1 << 20, 5), Some("too little work for a GPU to pay"));
        assert_eq!(is_little(512, 1_000_000), Some("too few teams per generation for a GPU to pay"));
        assert_eq!(is_little(4096, 10_000), None);
        assert_eq!(is_little(1 << 20, 200), None);
        // Trials advance side by side.
        assert_eq!(work(512, 100_000, 10).is_little(), None);
    }

    #[test]
    fn many_short_calls_are_worth_a_look_for_a_gpu() {
        let (mut total, short) = (WorkTotal::new(), work(4096, 20, 1));
        let looked: Vec<usize> = (1..=64 * 64).filter(|_| total.add(short).is_some()).collect();
        // Not at first, and ever more rarely.
        let first = looked[0];
        assert!(first > 1 && looked.len() > 3, "{looked:?}");
        assert!(looked.windows(2).all(|pair| pair[1] == 2 * pair[0]), "{looked:?}");
        // Work that takes no time is no reason.
        assert_eq!(total.add(Work::default()), None);
        assert!(WorkTotal::new().add(work(1 << 20, 200, 1)).is_some());
    }

    #[test]
    fn experiments_side_by_side_share_their_generations() {
        let text = flotilla::config::LAYOUTS[0].1;
        let (one, mut config) = (work(50, 200, 4), Config::parse(text, "generally_forward.toml").unwrap());
        (config.learning.population, config.learning.generations, config.learning.trials) = (50, 100, 4);
        let both = {
            let mut longer = config.clone();
            longer.learning.generations = 200;
            Work::of([&longer, &config])
        };
        assert_eq!(both.generations, one.generations);
        assert!(both.agent_steps > 1.4 * one.agent_steps && both.agent_steps < 1.6 * one.agent_steps);
    }
}
