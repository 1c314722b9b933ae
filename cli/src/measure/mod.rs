//! The speed of episodes and of whole generations, and the share of the machine's arithmetic ceiling that they reach.

use std::time::Duration;

use fearless_simd::Level;

use flotilla::backend::cpu::Cpu;
use flotilla::backend::gpu::device::Traffic;
use flotilla::backend::gpu::episode::{GpuBackend, PhaseTimes};
use flotilla::backend::{Backend, BackendError, Group, Weights};
use flotilla::config::{Config, Coupling};
use flotilla::evolve::contemporary_teams;
use flotilla::host::Instant;
use flotilla::trainer::{GenerationTimes, Trainer};
use flotilla::world::World;
use flotilla_app::sweep::layout::{self, MAX_FOLLOWERS, MAX_GROUPS};

mod ceiling;
mod gpu_ceiling;
pub mod operations;

use operations::Reach;

/// Timed repeats, of which the median counts, and the minimum time of each.
const REPEATS: usize = 5;
const MIN_REPEAT_TIME: Duration = Duration::from_millis(200);
/// Repeats of anything that takes longer than this.
const FEW_REPEATS: usize = 3;
const MAX_TIME_OF_REPEATS: Duration = Duration::from_secs(2);
/// Reads of a clock after which it counts as standing still. They take longer than any clock needs to advance.
const CLOCK_READS: usize = 1 << 22;
/// Teams that are traced to count neighbours, and the maximum number of pairs in that trace, beyond the first team.
const TRACED_TEAMS: usize = 64;
const TRACED_PAIRS: usize = 1 << 28;

/// The hardware that is measured.
pub(crate) enum Subject {
    /// The CPU, with an instruction set.
    Cpu(Cpu, Level),
    Gpu(Box<GpuBackend>),
}

impl Subject {
    pub fn backend(&mut self) -> &mut dyn Backend {
        match self {
            Subject::Cpu(cpu, _) => cpu,
            Subject::Gpu(gpu) => &mut **gpu,
        }
    }

    /// Prepares the measurement of its arithmetic ceiling.
    ///
    /// # Errors
    /// The GPU failed.
    fn ceiling(&self) -> Result<Box<Peak>, BackendError> {
        Ok(match self {
            &Subject::Cpu(_, level) => Box::new(move || Ok(ceiling::measure(level))),
            Subject::Gpu(gpu) => {
                let mut ceiling = gpu_ceiling::Ceiling::new(gpu.gpu())?;
                Box::new(move || Ok(ceiling.measure()?))
            }
        })
    }
}

type Peak = dyn FnMut() -> Result<f64, BackendError>;

/// The measurements of one config.
pub(crate) struct Timing {
    /// Teams that play at once.
    pub teams: usize,
    /// The world that they play in.
    pub world: World,
    /// Seconds per rollout: episodes, record and scores.
    pub rollout: f64,
    /// Seconds per generation: a rollout, selection and mutation; and the time of generations by phase. `None` if only
    /// rollouts were measured.
    pub generation: Option<(f64, Profile)>,
    /// Mean G of the teams of the rollout.
    pub mean_g: f64,
    /// The numbers of entities in reach of agents. The operations depend on them.
    pub reach: Reach,
    /// Lane operations per team-step.
    pub operations: f64,
    /// Lane operations per second at the arithmetic ceiling.
    pub ceiling: f64,
}

/// The time of some generations by phase.
pub(crate) struct Profile {
    /// The number of these generations.
    pub generations: usize,
    /// The trainer's phases.
    pub times: GenerationTimes,
    /// The phases of a GPU's rollouts.
    pub gpu_times: Option<PhaseTimes>,
    /// Bytes over the bus, in rollouts and between them.
    pub traffic: Traffic,
}

impl Timing {
    /// Returns the steps of all teams together.
    pub(crate) fn team_steps(&self) -> f64 {
        (self.teams * self.world.steps()) as f64
    }

    /// Returns the share of the arithmetic ceiling that rollouts reach.
    pub(crate) fn ceiling_share(&self) -> f64 {
        self.operations * self.team_steps() / self.rollout / self.ceiling
    }
}

/// Returns the config with another number of agents, laid out in the groups of [`layout`]. The ratio of leaders to
/// followers stays as close as integers allow. The number of POIs stays; they are ahead of the first groups.
///
/// # Errors
/// The config has tables of classes or groups, there are more leaders than groups, or more followers per leader than positions.
pub fn with_agents(config: &Config, agents: usize) -> Result<Config, String> {
    if !config.agents.is_empty() || !config.pois.is_empty() {
        return Err("only a config in short, without [[agents]] and [[pois]], can have other numbers of agents".into());
    }
    let (leaders, followers) = (config.world.leaders.len(), config.world.followers.len());
    let groups = ((agents * leaders) as f64 / (leaders + followers) as f64).round().max(1.0) as usize;
    let followers = agents - groups;
    if groups > MAX_GROUPS || followers.div_ceil(groups) > MAX_FOLLOWERS {
        return Err(format!(
            "{agents} agents in the config's ratio are {groups} leaders and {followers} followers; \
             allowed {MAX_GROUPS} leaders of {MAX_FOLLOWERS} followers"
        ));
    }
    let places = layout::places();
    let shares: Vec<_> = (0..groups).map(|g| followers / groups + usize::from(g < followers % groups)).collect();
    let agents_at = layout::positions(&places, &shares);
    let pois_at = layout::positions(&places, &vec![0; config.world.pois.len()]);
    let list = |list: Vec<[i32; 2]>| list.into_iter().map(|place| place.map(f64::from)).collect();
    let mut config = config.clone();
    config.world.map = agents_at.map.max(pois_at.map).map(f64::from);
    config.world.leaders = list(agents_at.leaders);
    config.world.followers = list(agents_at.followers);
    config.world.pois = list(pois_at.pois);
    match &mut config.world.coupling {
        Coupling::Same(count) => *count = agents.min(*count),
        Coupling::Each(counts) => counts.iter_mut().for_each(|count| *count = agents.min(*count)),
    }
    Ok(config)
}

/// Times rollouts of the teams of one trial after `trained` generations, and its next generations unless only rollouts
/// are wanted. `profile` asks for the GPU's own clock.
///
/// # Errors
/// The backend failed.
pub(crate) fn measure(
    config: &Config,
    subject: &mut Subject,
    trained: usize,
    rollout_only: bool,
    profile: bool,
) -> Result<Timing, BackendError> {
    let world = World::new(&config.validate()?);
    let ceiling = &mut subject.ceiling()?;
    let mut trainer = Trainer::new([config.validate()?]);
    (0..trained).try_for_each(|_| trainer.advance(subject.backend()).map(drop))?;
    let ([rollout, ceiling], mean_g, reach) = rollout(config, &world, &mut trainer, subject.backend(), ceiling)?;
    if let (Subject::Gpu(gpu), true) = (&mut *subject, profile) {
        gpu.use_clock();
    }
    let generation = if rollout_only { None } else { Some(generations(&mut trainer, subject)?) };
    Ok(Timing {
        teams: config.max_teams() - 1,
        rollout,
        generation,
        mean_g,
        operations: operations::per_team_step(&world, &reach),
        reach,
        ceiling,
        world,
    })
}

/// Returns seconds per generation, and its phases. The next generation is not counted, because it may compile and
/// allocate.
fn generations(trainer: &mut Trainer, subject: &mut Subject) -> Result<(f64, Profile), BackendError> {
    trainer.advance(subject.backend())?;
    let take = |trainer: &mut Trainer, subject: &mut Subject| {
        let (gpu_times, traffic) = match subject {
            Subject::Cpu(..) => (None, Traffic::default()),
            Subject::Gpu(gpu) => (Some(gpu.take_times()), gpu.gpu().traffic()),
        };
        Profile { generations: trainer.generation(0), times: trainer.take_times(), gpu_times, traffic }
    };
    let before = take(trainer, subject);
    let [seconds, _] = time(|| trainer.advance(subject.backend()).map(drop), || Ok(0.0))?;
    let profile = take(trainer, subject);
    let generations = profile.generations - before.generations;
    Ok((seconds, Profile { generations, traffic: profile.traffic - before.traffic, ..profile }))
}

/// Returns seconds per rollout of a trainer's policies, scored as in training, and the arithmetic ceiling measured in
/// between; the mean G; and the entities in reach of agents.
fn rollout(
    config: &Config,
    world: &World,
    trainer: &mut Trainer,
    backend: &mut dyn Backend,
    ceiling: &mut Peak,
) -> Result<([f64; 2], f64, Reach), BackendError> {
    let (policies, leaders) = (config.learning.slots(), world.leaders());
    // Teams with past champions take as long as others, which stand in for them.
    let (count, generation) = (config.max_teams() - 1, trainer.generation(0));
    let teams = contemporary_teams(&config.learning, 0, generation, &world.populations);
    let teams: Vec<u32> = teams.into_iter().cycle().take(count * leaders).collect();
    let weights = trainer.weights(0, 0)?;
    // If generations play from the device's memory, so do these rollouts.
    let held = backend.hold(weights, [config.populations(), policies, world.parameters()])?;
    let played = held.as_deref().map_or(weights.into(), Weights::OnDevice);
    let fitnesses = config.fitnesses();
    let group = Group { fitnesses: &fitnesses, ..Group::new(world, played, policies, &teams) };
    let mut observed = 0;
    let play = || {
        observed = backend
            .play(&[group])?
            .iter()
            .flat_map(|scores| &scores.observed)
            .map(|&worth| u64::from(worth))
            .sum::<u64>();
        Ok(())
    };
    let times = time(play, ceiling)?;
    let mean_g = observed as f64 / (count * world.total_worth as usize) as f64;
    let pairs = world.steps() * world.agents() * world.agents();
    let traced = (TRACED_PAIRS / pairs).clamp(1, TRACED_TEAMS).min(count);
    // The CPU traces, because every backend's trace is the same.
    let traced = Group { weights: weights.into(), teams: &teams[..traced * leaders], ..group };
    let trace = Cpu::default().trace(&traced)?;
    Ok((times, mean_g, Reach::of(world, &trace)))
}

/// Reports whether the system's clock advances. No measurement would end without that.
pub(crate) fn has_clock() -> bool {
    advances(Instant::now)
}

/// Reports whether a clock advances while it is read many times.
fn advances<T: PartialEq>(now: impl Fn() -> T) -> bool {
    let start = now();
    (0..CLOCK_READS).any(|_| now() != start)
}

/// Returns medians over a few repeats: seconds per call, and the measurement between repeats, so that a slow phase of
/// the machine affects both. Each repeat takes at least [`MIN_REPEAT_TIME`].
fn time<E>(
    mut call: impl FnMut() -> Result<(), E>,
    mut between: impl FnMut() -> Result<f64, E>,
) -> Result<[f64; 2], E> {
    let start = Instant::now();
    call()?;
    let repeats = if start.elapsed() > MAX_TIME_OF_REPEATS { FEW_REPEATS } else { REPEATS };
    let (mut seconds, mut others) = (Vec::with_capacity(repeats), Vec::with_capacity(repeats));
    for _ in 0..repeats {
        others.push(between()?);
        let (start, mut calls) = (Instant::now(), 0);
        while calls == 0 || start.elapsed() < MIN_REPEAT_TIME {
            call()?;
            calls += 1;
        }
        seconds.push(start.elapsed().as_secs_f64() / f64::from(calls));
    }
    Ok([median(seconds), median(others)])
}

/// Returns the median of finite values; of an even number, the upper one.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    fn config() -> Config {
        let text = flotilla::config::LAYOUTS[0].1;
        Config::parse(text, "generally_forward.toml").expect("the project's own config")
    }

    #[test]
    fn a_clock_that_stands_still_is_noticed() {
        use std::cell::Cell;
        assert!(!advances(|| 7));
        let reads = Cell::new(0);
        assert!(advances(|| reads.replace(reads.get() + 1) / 1000));
        assert!(has_clock());
    }

    #[test]
    fn its_own_number_of_agents_is_the_papers_layout() {
        assert_eq!(with_agents(&config(), 12).unwrap(), config());
    }

    #[test]
    fn any_number_of_agents_keeps_the_ratio_and_nobody_shares_a_start() {
        for agents in [1, 2, 3, 12, 24, 100, 256, 768] {
            let config = with_agents(&config(), agents).unwrap();
            let world = World::new(&config.validate().unwrap());
            assert_eq!(world.agents(), agents);
            assert!((world.leaders() as f64 - agents as f64 / 3.0).abs() <= 1.0, "{} of {agents}", world.leaders());
            let starts: HashSet<_> = world.starts.iter().map(|start| start.to_array().map(f32::to_bits)).collect();
            assert_eq!(starts.len(), agents);
        }
        let refusal = with_agents(&config(), 1024).unwrap_err();
        assert!(refusal.contains("341 leaders and 683 followers"), "{refusal}");
    }
}
