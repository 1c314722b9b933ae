//! Evaluation of teams: every team plays from the same starts, the config's own or drawn ones. The results are means
//! and spreads.

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

/// Maximum number of episodes per evaluation.
pub const MAX_EPISODES: u32 = 1_000_000;
/// Limits per batch: bytes of scores that wait to be summed, and number of episodes.
const BATCH_BYTES: usize = 1 << 26;
const BATCH_EPISODES: usize = 256;
/// Maximum number of bytes of a trace in memory, unless one team needs more.
const TRACE_BYTES: usize = 1 << 26;

/// The start positions of agents and the positions of POIs in each episode.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Starts {
    /// One episode from the config's own starts.
    Own,
    /// Several episodes with moved starts. Each agent moves by a uniform offset in `-jitter..jitter` on both axes, and
    /// each POI by one in `-poi_jitter..poi_jitter`. The draws are held out: no training uses them, whatever its seed.
    Drawn {
        /// Number of episodes per team.
        episodes: u32,
        /// Random seed.
        seed: u64,
        /// Jitter of agents, in units.
        jitter: f64,
        /// Jitter of POIs, in units.
        poi_jitter: f64,
    },
}

impl Starts {
    /// Returns the number of episodes per team.
    pub fn episodes(&self) -> usize {
        match *self {
            Starts::Own => 1,
            Starts::Drawn { episodes, .. } => episodes as usize,
        }
    }

    /// Returns an episode's start positions, `[agents]`, the same for all teams. If POIs move, their positions follow.
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

/// Splits a group into parts whose traces fit in a limited amount of memory. Yields each part with the index of its
/// first team.
pub fn parts<'a>(group: &Group<'a>) -> impl Iterator<Item = (usize, Group<'a>)> {
    let (group, leaders) = (*group, group.world.leaders());
    let moments = (group.world.steps() + 1) * group.world.agents() * size_of::<Moment>();
    let teams = (TRACE_BYTES / (moments + group.world.set_words() * size_of::<u32>())).max(1);
    let parts = group.teams.chunks(teams * leaders).enumerate();
    parts.map(move |(part, chosen)| (part * teams, Group { teams: chosen, ..group }))
}

/// Count, sum and sum of squares of a whole number over episodes. Sums are exact, so the order does not matter.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Tally {
    count: u64,
    sum: u64,
    squares: u128,
}

/// The mean of a [`Tally`], its spread over episodes, and its confidence interval.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spread {
    /// Mean over episodes.
    pub mean: f64,
    /// Sample standard deviation over episodes. None for one episode.
    pub deviation: Option<f64>,
    /// The 95 % interval of the mean, see [`statistics::mean`]. None for one episode.
    pub interval: Option<[f64; 2]>,
}

impl Tally {
    /// Adds a value.
    pub fn add(&mut self, value: u64) {
        self.count += 1;
        self.sum += value;
        self.squares += u128::from(value) * u128::from(value);
    }

    /// Returns the mean, or 0 without values.
    pub fn mean(&self) -> f64 {
        self.sum as f64 / self.count.max(1) as f64
    }

    /// Returns the spread of the values divided by `unit`. The interval is clamped to `0..=most`.
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

/// The results of teams over all episodes.
#[derive(Clone, Debug, PartialEq)]
pub struct Evaluation {
    /// Number of episodes per team.
    pub episodes: usize,
    /// Number of leaders per team.
    pub leaders: usize,
    /// Number of POIs.
    pub pois: usize,
    /// POIs observed, `[teams]`.
    pub observed: Vec<Tally>,
    /// Sum of the POIs observed by all teams, per episode.
    pub together: Tally,
    /// Sums over episodes of D, Df, D++ and Dt, `[teams][leaders]`. Dt is 0 unless it was requested.
    credits: Vec<[f64; 4]>,
    /// Whether Dt was requested.
    timed: bool,
}

impl Evaluation {
    /// Returns the spread of the POIs observed by a team.
    pub fn team(&self, team: usize) -> Spread {
        self.observed[team].spread(1, self.pois)
    }

    /// Returns the spread over episodes of the POIs observed by the mean team.
    pub fn mean(&self) -> Spread {
        self.together.spread(self.observed.len(), self.pois)
    }

    /// Returns the index of the team that observes most. Ties go to the lower index.
    pub fn best(&self) -> usize {
        let sum = |team: usize| self.observed[team].sum;
        (1..self.observed.len()).fold(0, |best, team| if sum(team) > sum(best) { team } else { best })
    }

    /// Returns a leader's mean G, D, Df and D++ over episodes.
    pub fn scores(&self, team: usize, leader: usize) -> [f32; 4] {
        let g = self.observed[team].mean() / self.pois as f64;
        let [d, df, dpp, _] = self.credits[team * self.leaders + leader].map(|sum| sum / self.episodes as f64);
        [g, d, df, dpp].map(|score| score as f32)
    }

    /// Returns a leader's mean Dt over episodes, if the group [needed](RecordRequest::sights) sights.
    pub fn dt(&self, team: usize, leader: usize) -> Option<f32> {
        self.timed.then(|| (self.credits[team * self.leaders + leader][3] / self.episodes as f64) as f32)
    }
}

/// Plays every team of a group from every start and computes every fitness. Dt is computed only if the group needs
/// sights.
///
/// Memory limits the number of episodes per batch. `watch` receives the finished share, in 0..1, from any thread.
///
/// # Errors
/// The backend fails.
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
        // Episodes are added in order, so that float sums do not depend on which episode finished first.
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
