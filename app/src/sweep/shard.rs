//! The assignment of points to processes: a pure function of the sweep, so that processes need not communicate.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::fmt::{self, Display};
use std::str::FromStr;

use super::Point;
use flotilla::config::StageConfig;
use flotilla::world::World;

/// Maximum number of shards of a sweep.
pub const MAX_SHARDS: usize = 1 << 16;

/// Shard `index` (from 1) of `count`; written `1/4` to `4/4`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shard {
    /// The number of this shard, from 1.
    pub index: usize,
    pub count: usize,
}

impl Shard {
    /// The only shard.
    pub(crate) const WHOLE: Shard = Shard { index: 1, count: 1 };

    /// Returns a shard.
    ///
    /// # Errors
    /// A message if there is no such shard.
    pub fn new(index: usize, count: usize) -> Result<Shard, String> {
        match count {
            1..=MAX_SHARDS if (1..=count).contains(&index) => Ok(Shard { index, count }),
            1..=MAX_SHARDS => {
                Err(format!("there is no shard {index} of {count}; they are 1/{count} to {count}/{count}"))
            }
            _ => Err(format!("found {count} shards, allowed 1 to {MAX_SHARDS}")),
        }
    }

    /// Returns the shard of this process in a job array, or none outside of an array. `get` reads an environment
    /// variable.
    ///
    /// Slurm sets all required variables, and its ids may start anywhere. A Kubernetes indexed job sets
    /// `JOB_COMPLETION_INDEX`, and `FLOTILLA_SHARDS` must be its `completions`.
    ///
    /// # Errors
    /// A message about variables that contradict each other.
    pub fn from_env(get: impl Fn(&str) -> Option<String>) -> Result<Option<Shard>, String> {
        let number = |name: &str| match get(name) {
            None => Ok(None),
            Some(text) => {
                text.trim().parse::<usize>().map(Some).map_err(|_| format!("{name}={text} is not a whole number"))
            }
        };
        let (index, count, names) = if let Some(id) = number("SLURM_ARRAY_TASK_ID")? {
            let count =
                number("SLURM_ARRAY_TASK_COUNT")?.ok_or("SLURM_ARRAY_TASK_ID is set without SLURM_ARRAY_TASK_COUNT")?;
            let first = number("SLURM_ARRAY_TASK_MIN")?.unwrap_or(1);
            let step = number("SLURM_ARRAY_TASK_STEP")?.unwrap_or(1).max(1);
            let past = id.checked_sub(first).filter(|past| past % step == 0).ok_or_else(|| {
                format!(
                    "SLURM_ARRAY_TASK_ID={id} does not fit SLURM_ARRAY_TASK_MIN={first}, SLURM_ARRAY_TASK_STEP={step}"
                )
            })?;
            (past / step, count, "SLURM_ARRAY_TASK_ID and SLURM_ARRAY_TASK_COUNT")
        } else if let Some(index) = number("JOB_COMPLETION_INDEX")? {
            let count = number("FLOTILLA_SHARDS")?.ok_or(
                "JOB_COMPLETION_INDEX is set, but not FLOTILLA_SHARDS, which has to be the job's `completions`; \
                 or pass --shard I/N",
            )?;
            (index, count, "JOB_COMPLETION_INDEX and FLOTILLA_SHARDS")
        } else {
            return Ok(None);
        };
        let shard = Shard::new(index.saturating_add(1), count);
        shard.map(Some).map_err(|error| format!("{names}: {error}; pass --shard I/N if the array has gaps"))
    }

    /// Returns the points of this shard in order, see [`assign_to_shards`].
    pub fn take<'a>(&self, points: &'a [Point]) -> Vec<&'a Point> {
        let of = assign_to_shards(points, self.count);
        points.iter().zip(of).filter(|(_, of)| *of == self.index).map(|(point, _)| point).collect()
    }
}

/// Assigns each point to one of `count` shards, from 1: in order of decreasing cost, each to the least loaded shard.
pub fn assign_to_shards(points: &[Point], count: usize) -> Vec<usize> {
    let mut order: Vec<(u128, usize)> = points.iter().map(cost).zip(0..).collect();
    order.sort_by_key(|&(cost, at)| (Reverse(cost), points[at].index));
    let mut loads: BinaryHeap<_> = (1..=count).map(|shard| Reverse((0, shard))).collect();
    let mut of = vec![0; points.len()];
    for (cost, at) in order {
        if let Some(mut least) = loads.peek_mut() {
            of[at] = least.0.1;
            least.0.0 += cost;
        }
    }
    of
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Shard, String> {
        let part = |text: &str| text.parse::<usize>().ok();
        let parts = text.split_once('/').and_then(|(index, count)| part(index).zip(part(count)));
        let (index, count) = parts.ok_or("allowed I/N, shard I of N: 1/4 to 4/4")?;
        Shard::new(index, count)
    }
}

impl Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.index, self.count)
    }
}

/// Estimates the number of operations of a point: teams × steps × operations per step (networks, pairs of agents,
/// sensing, coupling).
pub fn cost(point: &Point) -> u128 {
    point.config.stage_lengths().map(cost_of_stage).sum()
}

fn cost_of_stage((generations, config): (usize, &StageConfig)) -> u128 {
    let learning = &config.learning;
    let world = World::new(config);
    let wide = |count: usize| count as u128;
    let teams = wide(learning.trials) * wide(generations) * wide(config.max_teams()) * wide(learning.episodes_per_team);
    let (agents, leaders, pois) = (wide(world.agents()), wide(world.leaders()), wide(world.pois.len()));
    let step = leaders * (2 * wide(world.parameters()) + 25 * pois) + agents * (4 * agents + 6 * pois + 100);
    teams * wide(world.steps()) * step
}
