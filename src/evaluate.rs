//! How well teams do: every team plays from the same starts, its own or drawn ones, and is told by mean and spread.

use std::cell::RefCell;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

use glam::Vec2;

use crate::backend::{Backend, BackendError, Group, Moment, RecordRequest};
use crate::credit::Credit;
use crate::evolve::{self, Key, Purpose};
use crate::statistics::{self, Estimate};
use crate::world::World;

pub use crate::evolve::one_policy_a_team;

/// Most episodes of one evaluation.
pub const MAX_EPISODES: u32 = 1_000_000;
/// Most bytes of scores that wait to be summed, and most episodes that play as one batch.
const BATCH_BYTES: usize = 1 << 26;
const BATCH_EPISODES: usize = 256;
/// Most bytes of a trace in memory at once, unless one team's are more.
const TRACE_BYTES: usize = 1 << 26;

/// Where the agents of each episode start, and where its POIs are.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Starts {
    /// One episode, from where the config says.
    Own,
    /// So many episodes, every start moved by a uniform offset in `-jitter..jitter` on both axes, and every POI
    /// likewise by `poi_jitter`, drawn from the seed. No training draws from where these are drawn, whatever its seed.
    Drawn {
        /// Of each team.
        episodes: u32,
        /// What they are drawn from.
        seed: u64,
        /// Of agents, in units.
        jitter: f64,
        /// Of POIs, in units.
        poi_jitter: f64,
    },
}

impl Starts {
    /// Episodes of each team.
    pub fn episodes(&self) -> usize {
        match *self {
            Starts::Own => 1,
            Starts::Drawn { episodes, .. } => episodes as usize,
        }
    }

    /// Start positions of an episode, `[agents]`, the same for all teams; after them places of the POIs, if they move.
    pub fn of(&self, episode: usize, world: &World) -> Vec<Vec2> {
        let mut starts = world.starts.clone();
        if let Starts::Drawn { seed, jitter, poi_jitter, .. } = *self {
            let key = |purpose| Key::new(seed, 0, purpose);
            evolve::jitter_starts(key(Purpose::HeldOut), 0, episode, world, jitter, &mut starts);
            evolve::jitter_pois(key(Purpose::HeldOutPois), 0, episode, world, poi_jitter, &mut starts);
        }
        starts
    }
}

/// A group in parts whose traces do not take much memory at once, each with its first team.
pub fn parts<'a>(group: &Group<'a>) -> impl Iterator<Item = (usize, Group<'a>)> {
    let (group, leaders) = (*group, group.world.leaders());
    let moments = (group.world.steps() + 1) * group.world.agents() * size_of::<Moment>();
    let teams = (TRACE_BYTES / (moments + group.world.set_words() * size_of::<u32>())).max(1);
    let parts = group.teams.chunks(teams * leaders).enumerate();
    parts.map(move |(part, chosen)| (part * teams, Group { teams: chosen, ..group }))
}

/// What a whole number came to over episodes; sums are exact, whatever their order.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Tally {
    count: u64,
    sum: u64,
    squares: u128,
}

/// Mean, spread and what the mean would be over all episodes there could be, of a [`Tally`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spread {
    /// Over episodes.
    pub mean: f64,
    /// Sample standard deviation over episodes; none of one.
    pub deviation: Option<f64>,
    /// The 95 % interval of the mean ([`statistics::mean`]'s); none of one episode.
    pub interval: Option<[f64; 2]>,
}

impl Tally {
    /// Adds a value.
    pub fn add(&mut self, value: u64) {
        self.count += 1;
        self.sum += value;
        self.squares += u128::from(value) * u128::from(value);
    }

    /// The mean; 0 without values.
    pub fn mean(&self) -> f64 {
        self.sum as f64 / self.count.max(1) as f64
    }

    /// Of values that are counted in parts of which `unit` make one, and none is above `most`.
    pub fn spread(&self, unit: usize, most: usize) -> Spread {
        let (count, unit) = (self.count as f64, unit as f64);
        let mean = self.mean() / unit;
        let deviation = (self.count > 1).then(|| {
            let sum = u128::from(self.sum);
            let squares = u128::from(self.count) * self.squares - sum * sum;
            (squares as f64 / (count * (count - 1.0))).sqrt() / unit
        });
        let interval = deviation.map(|deviation| {
            let error = deviation / count.sqrt();
            let Estimate { low, high, .. } = statistics::interval(mean, error, self.count as usize, 1.0 / unit);
            [low.max(0.0), high.min(most as f64)]
        });
        Spread { mean, deviation, interval }
    }
}

/// What teams came to over all episodes.
#[derive(Clone, Debug, PartialEq)]
pub struct Evaluation {
    /// Of each team.
    pub episodes: usize,
    /// Of a team.
    pub leaders: usize,
    /// Of the world.
    pub pois: usize,
    /// POIs observed, `[teams]`.
    pub observed: Vec<Tally>,
    /// POIs observed by all teams of an episode together.
    pub together: Tally,
    /// Sums over episodes of D, Df, D++ and, where it was asked for, Dt, `[teams][leaders]`.
    credits: Vec<[f64; 4]>,
    /// Whether it was.
    timed: bool,
}

impl Evaluation {
    /// POIs observed by a team.
    pub fn team(&self, team: usize) -> Spread {
        self.observed[team].spread(1, self.pois)
    }

    /// POIs observed by the mean team, its spread from episode to episode.
    pub fn mean(&self) -> Spread {
        self.together.spread(self.observed.len(), self.pois)
    }

    /// The team that observes most, ties to the lower index.
    pub fn best(&self) -> usize {
        let sum = |team: usize| self.observed[team].sum;
        (1..self.observed.len()).fold(0, |best, team| if sum(team) > sum(best) { team } else { best })
    }

    /// Means over episodes of G, D, Df and D++ of a leader of a team.
    pub fn scores(&self, team: usize, leader: usize) -> [f32; 4] {
        let g = self.observed[team].mean() / self.pois as f64;
        let [d, df, dpp, _] = self.credits[team * self.leaders + leader].map(|sum| sum / self.episodes as f64);
        [g, d, df, dpp].map(|score| score as f32)
    }

    /// The mean over episodes of Dt of a leader of a team, if the group [needed](RecordRequest::sights) sights.
    pub fn dt(&self, team: usize, leader: usize) -> Option<f32> {
        self.timed.then(|| (self.credits[team * self.leaders + leader][3] / self.episodes as f64) as f32)
    }
}

/// Plays every team of a group from every start, in batches of as many episodes as memory bears, and works out every
/// fitness, Dt only where the group needs sights; `watch` is told the share that is done, from any thread.
///
/// # Errors
/// When the backend fails.
pub fn evaluate(
    backend: &mut dyn Backend,
    group: &Group<'_>,
    starts: &Starts,
    watch: &(dyn Fn(f64) + Sync),
) -> Result<Evaluation, BackendError> {
    thread_local! { static CREDIT: RefCell<Credit> = RefCell::default(); }
    let world = group.world;
    let (teams, leaders, episodes) = (group.team_count(), world.leaders(), starts.episodes());
    let at_once = BATCH_BYTES / (teams * leaders * size_of::<[f32; 4]>()).max(1);
    let at_once = at_once.clamp(1, BATCH_EPISODES).min(episodes);
    let mut evaluation = Evaluation {
        episodes,
        leaders,
        pois: world.pois.len(),
        observed: vec![Tally::default(); teams],
        together: Tally::default(),
        credits: vec![[0.0; 4]; teams * leaders],
        timed: group.need.sights(),
    };
    let need = if group.need.sights() { RecordRequest::Sights } else { RecordRequest::Scores };
    let done = AtomicUsize::new(0);
    for first in (0..episodes).step_by(at_once) {
        let batch: Vec<Vec<Vec2>> =
            (first..episodes.min(first + at_once)).map(|episode| starts.of(episode, world)).collect();
        let groups: Vec<Group<'_>> = batch.iter().map(|starts| Group { starts, need, ..*group }).collect();
        let scored = Mutex::new((vec![0; batch.len() * teams], vec![[0_f32; 4]; batch.len() * teams * leaders]));
        backend.rollout(&groups, &|episode| {
            let scores = CREDIT.with_borrow_mut(|credit| credit.all(&episode, world));
            let place = episode.group * teams + episode.team;
            let mut scored = scored.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
            scored.0[place] = scores.observed;
            for (leader, to) in scored.1[place * leaders..][..leaders].iter_mut().enumerate() {
                let dt = scores.dt.get(leader).copied().unwrap_or(0.0);
                *to = [scores.d[leader], scores.df[leader], scores.dpp[leader], dt];
            }
            drop(scored);
            watch((done.fetch_add(1, Relaxed) + 1) as f64 / (teams * episodes) as f64);
        })?;
        let (observed, credits) = scored.into_inner().unwrap_or_else(|poisoned| poisoned.into_inner());
        // Episode after episode, so that sums of floats do not depend on who played first.
        for observed in observed.chunks_exact(teams) {
            evaluation.together.add(observed.iter().map(|&observed| u64::from(observed)).sum());
            evaluation.observed.iter_mut().zip(observed).for_each(|(tally, &observed)| tally.add(observed.into()));
        }
        for credits in credits.chunks_exact(teams * leaders) {
            for (sums, scores) in evaluation.credits.iter_mut().zip(credits) {
                sums.iter_mut().zip(scores).for_each(|(sum, &score)| *sum += f64::from(score));
            }
        }
    }
    Ok(evaluation)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mean_of_nothing_is_0() {
        let mut tally = Tally::default();
        assert_eq!(tally.mean(), 0.0);
        assert_eq!(tally.spread(2, 4), Spread { mean: 0.0, deviation: None, interval: None });
        tally.add(3);
        assert_eq!(tally.mean(), 3.0);
    }
}
