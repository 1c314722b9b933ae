//! How fast episodes are played, alone and within whole generations, and how much of what a machine can do that takes.

use std::cell::RefCell;
use std::hint::black_box;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::Duration;

use fearless_simd::Level;

use crate::backend::cpu::Cpu;
use crate::backend::gpu::device::Traffic;
use crate::backend::gpu::episode::{GpuEpisodes, Stages};
use crate::backend::gpu::probe;
use crate::backend::{Backend, BackendError, Group, Need, Weights};
use crate::config::{Config, Coupling};
use crate::credit::Credit;
use crate::evolve::{Key, Purpose, random_policy, teams_of};
use crate::host::Instant;
use crate::sweep::layout::{self, MAX_FOLLOWERS, MAX_GROUPS};
use crate::trainer::{Times, Trainer};
use crate::world::World;

pub mod ceiling;
pub mod operations;

use operations::Reach;

/// Timed repeats, of which the median counts, and the least time that each takes.
const REPEATS: usize = 5;
const LEAST: Duration = Duration::from_millis(200);
/// Repeats of what takes longer than this at a time.
const FEW_REPEATS: usize = 3;
const LONG: Duration = Duration::from_secs(2);
/// Reads of a clock after which it counts as standing still. They take longer than any clock needs to advance.
const CLOCK_READS: usize = 1 << 22;
/// Teams that are traced to see who is in reach of whom, and how many pairs are looked at, as far as one team allows.
const TRACED_TEAMS: usize = 64;
const TRACED_PAIRS: usize = 1 << 28;

/// What is measured.
pub enum Subject {
    /// The CPU, by this instruction set.
    Cpu(Cpu, Level),
    /// A GPU.
    Gpu(Box<GpuEpisodes>),
}

impl Subject {
    /// What plays.
    pub fn backend(&mut self) -> &mut dyn Backend {
        match self {
            Subject::Cpu(cpu, _) => cpu,
            Subject::Gpu(gpu) => &mut **gpu,
        }
    }

    /// Readies what measures how many f32 sums and products a second, none fused, it can do at most.
    ///
    /// # Errors
    /// When the GPU fails.
    fn ceiling(&self) -> Result<Box<Peak>, BackendError> {
        Ok(match self {
            &Subject::Cpu(_, level) => Box::new(move || Ok(ceiling::measure(level))),
            Subject::Gpu(gpu) => {
                let ceiling = probe::Ceiling::new(gpu.gpu())?;
                Box::new(move || Ok(ceiling.measure()?))
            }
        })
    }
}

type Peak = dyn FnMut() -> Result<f64, BackendError>;

/// What was measured of one config.
pub struct Timing {
    /// Teams that play at once.
    pub teams: usize,
    /// Of a team.
    pub leaders: usize,
    /// Of a team.
    pub followers: usize,
    /// Of the world.
    pub pois: usize,
    /// Of an episode.
    pub steps: usize,
    /// Seconds of one rollout (episodes, record and scores).
    pub rollout: f64,
    /// Seconds of one generation (that, selection and mutation), where it was asked for.
    pub generation: Option<f64>,
    /// Where the time of generations went, where it was asked for.
    pub profile: Option<Profile>,
    /// Mean G of the random teams of the rollout.
    pub mean_g: f64,
    /// Who was in reach of whom, on which the work depends.
    pub reach: Reach,
    /// Lane operations of a team-step.
    pub operations: f64,
    /// Lane operations a second that the machine can do at most.
    pub ceiling: f64,
}

/// Where the time of some generations went.
pub struct Profile {
    /// How many these times are of, together.
    pub generations: usize,
    /// By what was done.
    pub times: Times,
    /// What a GPU's rollouts are made of.
    pub stages: Option<Stages>,
    /// What went over its bus, in rollouts and between them.
    pub traffic: Traffic,
}

/// What to measure of whole generations.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Generations {
    /// Only rollouts.
    LeftOut,
    /// How long one takes.
    Timed,
    /// How long one takes, and where that time goes.
    Profiled,
}

impl Timing {
    /// Agents of all teams together.
    pub fn agents(&self) -> usize {
        self.leaders + self.followers
    }

    /// Steps of all teams together.
    pub fn team_steps(&self) -> f64 {
        (self.teams * self.steps) as f64
    }

    /// The part of the arithmetic ceiling that rollouts reach.
    pub fn ceiling_share(&self) -> f64 {
        self.operations * self.team_steps() / self.rollout / self.ceiling
    }
}

/// The config with other numbers of agents, leaders and followers in its own ratio as nearly as whole numbers allow,
/// laid out in the groups of [`layout`]; POIs stay as many, ahead of the first groups.
///
/// # Errors
/// More leaders than groups, or more followers of one leader than there are places for.
pub fn with_agents(config: &Config, agents: usize) -> Result<Config, String> {
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

/// Times rollouts of one trial's random teams, and its generations.
///
/// # Errors
/// When the backend fails.
pub fn measure(config: &Config, player: &mut Subject, generations: Generations) -> Result<Timing, BackendError> {
    let world = World::new(config);
    let ceiling = &mut player.ceiling()?;
    let ([rollout, ceiling], mean_g, reach) = rollout(config, &world, player.backend(), ceiling)?;
    let (generation, profile) = match generations {
        Generations::LeftOut => (None, None),
        Generations::Timed => (Some(self::generations(config, player)?.0), None),
        Generations::Profiled => {
            if let Subject::Gpu(gpu) = player {
                gpu.use_clock()?;
            }
            let (generation, profile) = self::generations(config, player)?;
            (Some(generation), Some(profile))
        }
    };
    Ok(Timing {
        teams: config.learning.population,
        leaders: world.leaders(),
        followers: world.followers(),
        pois: world.pois.len(),
        steps: world.steps(),
        rollout,
        generation,
        profile,
        mean_g,
        operations: operations::per_team_step(&world, &reach),
        reach,
        ceiling,
    })
}

/// Seconds of one generation, and where they went; the first, which readies what the others use, does not count.
fn generations(config: &Config, player: &mut Subject) -> Result<(f64, Profile), BackendError> {
    let mut trainer = Trainer::new(vec![config.clone()]);
    trainer.advance(player.backend())?;
    let take = |trainer: &mut Trainer, player: &mut Subject| {
        let (stages, traffic) = match player {
            Subject::Cpu(..) => (None, Traffic::default()),
            Subject::Gpu(gpu) => (Some(gpu.take_stages()), gpu.gpu().traffic()),
        };
        Profile { generations: trainer.generation(0), times: trainer.take_times(), stages, traffic }
    };
    let before = take(&mut trainer, player);
    let [seconds, _] = time(|| trainer.advance(player.backend()).map(drop), || Ok(0.0))?;
    let profile = take(&mut trainer, player);
    let generations = profile.generations - before.generations;
    Ok((seconds, Profile { generations, traffic: profile.traffic - before.traffic, ..profile }))
}

/// Seconds of one rollout of random policies, scored as in training, with the ceiling meanwhile; the mean G; and who
/// was in reach of whom.
fn rollout(
    config: &Config,
    world: &World,
    backend: &mut dyn Backend,
    ceiling: &mut Peak,
) -> Result<([f64; 2], f64, Reach), BackendError> {
    thread_local! { static CREDIT: RefCell<(Credit, Vec<f32>)> = RefCell::default(); }
    let (population, leaders, seed) = (config.learning.population, world.leaders(), config.learning.seed);
    let mut weights = vec![0.0; config.populations() * population * world.parameters()];
    let key = Key::new(seed, 0, Purpose::Weights);
    for (policy, weights) in weights.chunks_exact_mut(world.parameters()).enumerate() {
        random_policy(Level::new(), key.at(0, policy / population, policy % population), weights);
    }
    let teams = teams_of(&config.learning, 0, 0, leaders);
    // Where generations play from the device's memory, so do rollouts.
    let held = backend.hold(&weights, [config.populations(), population, world.parameters()])?;
    let played = held.as_deref().map_or(weights[..].into(), Weights::Held);
    let need = Need::Score(config.learning.fitness);
    let group = Group { world, starts: &world.starts, weights: played, policies: population, teams: &teams, need };
    let observed = AtomicU64::new(0);
    let play = || {
        observed.store(0, Relaxed);
        backend.rollout(&[group], &|episode| {
            CREDIT.with_borrow_mut(|(credit, scores)| {
                scores.resize(leaders, 0.0);
                let pois = credit.score(&episode, world, config.learning.fitness, scores);
                observed.fetch_add(u64::from(pois), Relaxed);
                black_box(scores);
            });
        })
    };
    let times = time(play, ceiling)?;
    let mean_g = observed.into_inner() as f64 / (population * world.pois.len()) as f64;
    let pairs = world.steps() * world.agents() * world.agents();
    let traced = (TRACED_PAIRS / pairs).clamp(1, TRACED_TEAMS).min(population);
    // The CPU's, since every backend's is the same.
    let traced = Group { weights: weights[..].into(), teams: &teams[..traced * leaders], ..group };
    let trace = Cpu::default().trace(&traced)?;
    Ok((times, mean_g, Reach::of(world, &trace)))
}

/// Returns whether the system's clock advances. No measurement would end without that.
pub fn has_clock() -> bool {
    advances(Instant::now)
}

/// Returns whether a clock advances while it is read many times.
fn advances<T: PartialEq>(now: impl Fn() -> T) -> bool {
    let start = now();
    (0..CLOCK_READS).any(|_| now() != start)
}

/// Medians over a few repeats: seconds of one call, each repeat calling for [`LEAST`] at least, and what was measured
/// between them, so that a slow spell of the machine meets both.
fn time<E>(
    mut call: impl FnMut() -> Result<(), E>,
    mut between: impl FnMut() -> Result<f64, E>,
) -> Result<[f64; 2], E> {
    let start = Instant::now();
    call()?;
    let repeats = if start.elapsed() > LONG { FEW_REPEATS } else { REPEATS };
    let (mut seconds, mut others) = (Vec::with_capacity(repeats), Vec::with_capacity(repeats));
    for _ in 0..repeats {
        others.push(between()?);
        let (start, mut calls) = (Instant::now(), 0);
        while calls == 0 || start.elapsed() < LEAST {
            call()?;
            calls += 1;
        }
        seconds.push(start.elapsed().as_secs_f64() / f64::from(calls));
    }
    Ok([median(seconds), median(others)])
}

/// The middle of some (finite) values, of an even number the upper of two.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    fn config() -> Config {
        let text = include_str!("../../configs/generally_forward.toml");
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
        assert_eq!(World::new(&with_agents(&config(), 12).unwrap()), World::new(&config()));
    }

    #[test]
    fn any_number_of_agents_keeps_the_ratio_and_nobody_shares_a_start() {
        for agents in [1, 2, 3, 12, 24, 100, 256, 768] {
            let config = with_agents(&config(), agents).unwrap();
            let world = World::new(&config);
            assert_eq!(world.agents(), agents);
            assert!((world.leaders() as f64 - agents as f64 / 3.0).abs() <= 1.0, "{} of {agents}", world.leaders());
            let starts: HashSet<_> = world.starts.iter().map(|start| start.to_array().map(f32::to_bits)).collect();
            assert_eq!(starts.len(), agents);
            // As if it had been read from a file.
            Config::parse(&config.to_toml(), "laid out").unwrap();
        }
        let refusal = with_agents(&config(), 1024).unwrap_err();
        assert!(refusal.contains("341 leaders and 683 followers"), "{refusal}");
    }
}
