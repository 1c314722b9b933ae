//! Evaluation of teams: every team plays from the same starts, the config's own or drawn ones. The results are means
//! and spreads.

use std::ops::ControlFlow;
use std::time::Duration;

use glam::Vec2;

use crate::backend::{Backend, BackendError, Group, Moment};
use crate::config::{Config, Fitness};
use crate::evolve::{self, Key, Purpose};
use crate::host::Instant;
use crate::statistics::{self, Average, Estimate};
use crate::world::World;

pub use crate::evolve::aligned_teams;

/// The fitnesses of an evaluation, besides G.
pub const SCORES: &[Fitness] = &[Fitness::D, Fitness::Df, Fitness::Dpp];
/// [`SCORES`] and Dt, which needs a record of who was seen at every step.
pub const SCORES_AND_DT: &[Fitness] = &[Fitness::D, Fitness::Df, Fitness::Dpp, Fitness::Dt];

/// Returns the fitnesses that teams of a config are scored by: Dt only if it is the fitness of any class.
pub fn scores_beside(config: &Config) -> &'static [Fitness] {
    if config.fitnesses().contains(&Fitness::Dt) { SCORES_AND_DT } else { SCORES }
}

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
    /// One episode from the config's own starts, with examples for those drawn from regions.
    Own,
    /// Several episodes with moved starts. Starts and POIs are drawn from their regions. Then each agent moves by a uniform offset in `-jitter..jitter` on both axes, and
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

    /// Returns an episode's start positions, `[agents]`, the same for all teams. If POIs move, their positions follow, and
    /// then the headings if any are drawn, see [`Group::starts`].
    pub fn of(&self, episode: usize, world: &World) -> Vec<Vec2> {
        let mut starts = world.starts.clone();
        if let Starts::Drawn { seed, jitter, poi_jitter, .. } = *self {
            let key = |purpose| Key::new(seed, 0, purpose);
            evolve::jitter_starts(key(Purpose::HeldOut), 0, episode, world, jitter, &mut starts);
            evolve::jitter_pois(key(Purpose::HeldOutPois), 0, episode, world, poi_jitter, &mut starts);
            evolve::draw_headings(key(Purpose::HeldOut), 0, episode, world, &mut starts);
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
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Spread {
    /// Mean over episodes.
    pub mean: f64,
    /// Sample standard deviation over episodes. None for one episode.
    #[serde(rename = "standard_deviation")]
    pub deviation: Option<f64>,
    /// The 95 % interval of the mean, see [`statistics::bounded`]. None for one episode.
    #[serde(rename = "interval_95")]
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
    pub fn spread(&self, unit: f64, most: usize) -> Spread {
        let count = self.count as f64;
        let mean = self.mean() / unit;
        let deviation = (self.count > 1).then(|| {
            let sum = u128::from(self.sum);
            let squares = u128::from(self.count) * self.squares - sum * sum;
            (squares as f64 / (count * (count - 1.0))).sqrt() / unit
        });
        let interval = deviation.and_then(|deviation| {
            let average = Average::of(u32::try_from(self.count).ok()?, mean, deviation);
            let Estimate { low, high, .. } = statistics::bounded(&average, [0.0, most as f64])?;
            Some([low, high])
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
    /// The summed worth of the observed POIs, `[teams]`.
    pub observed: Vec<Tally>,
    /// Sum of that over all teams, per episode.
    pub together: Tally,
    /// Sums over episodes of D, Df, D++ and Dt, `[teams][leaders]`. Dt is 0 unless it was requested.
    credits: Vec<[f64; 4]>,
    /// Whether Dt was requested.
    timed: bool,
    /// The summed worth of all POIs.
    worth: f64,
}

impl Evaluation {
    /// Returns what a POI is worth on average: 1 if all have the same value.
    fn unit(&self) -> f64 {
        self.worth / self.pois as f64
    }

    /// Returns the mean number of POIs that a team observes, weighted by their values: G times the number of POIs.
    pub fn mean_observed(&self, team: usize) -> f64 {
        self.observed[team].mean() / self.unit()
    }

    /// Returns the spread of the same number.
    pub fn team(&self, team: usize) -> Spread {
        self.observed[team].spread(self.unit(), self.pois)
    }

    /// Returns the spread of the same number over episodes, for the mean team.
    pub fn mean(&self) -> Spread {
        self.together.spread(self.observed.len() as f64 * self.unit(), self.pois)
    }

    /// Returns the index of the team that observes most. Ties go to the lower index.
    pub fn best(&self) -> usize {
        let sum = |team: usize| self.observed[team].sum;
        (1..self.observed.len()).fold(0, |best, team| if sum(team) > sum(best) { team } else { best })
    }

    /// Returns a leader's mean G, D, Df and D++ over episodes.
    pub fn scores(&self, team: usize, leader: usize) -> [f32; 4] {
        let g = self.observed[team].mean() / self.worth;
        let [d, df, dpp, _] = self.mean_credits(team, leader);
        [g, d, df, dpp].map(|score| score as f32)
    }

    /// Returns a leader's mean Dt over episodes, if the group was scored by it.
    pub fn dt(&self, team: usize, leader: usize) -> Option<f32> {
        self.timed.then(|| self.mean_credits(team, leader)[3] as f32)
    }

    /// Returns a leader's mean credits over the episodes that were played.
    fn mean_credits(&self, team: usize, leader: usize) -> [f64; 4] {
        let played = self.observed[team].count.max(1) as f64;
        self.credits[team * self.leaders + leader].map(|sum| sum / played)
    }
}

/// Some episodes of all teams, as [`evaluate`] reports them.
#[derive(Clone, Copy, Debug)]
pub struct Batch<'a> {
    /// The share of all episodes that were played so far, in 0..1.
    pub share: f64,
    /// The first episode, and what the observed POIs are worth in it and the following ones, `[episodes][teams]`. Empty
    /// while episodes are incomplete.
    pub first: usize,
    /// See `first`.
    pub observed: &'a [u32],
    /// D, Df, D++ and Dt, `[episodes][teams][leaders]`.
    pub credits: &'a [[f32; 4]],
}

/// Plays every team of a group from every start and computes every fitness. Dt is computed only if the group needs
/// sights.
///
/// Memory limits the number of episodes per batch. `each` is called several times per second, from this thread and in
/// the order of episodes. If it breaks, the evaluation ends after the episodes reported so far.
///
/// # Errors
/// The backend fails.
pub fn evaluate(
    backend: &mut dyn Backend,
    group: &Group<'_>,
    starts: &Starts,
    each: &mut dyn FnMut(Batch<'_>) -> ControlFlow<()>,
) -> Result<Evaluation, BackendError> {
    let world = group.world;
    let (teams, leaders, episodes) = (group.team_count(), world.leaders(), starts.episodes());
    let timed = group.fitnesses.contains(&Fitness::Dt);
    let fitnesses = if timed { SCORES_AND_DT } else { SCORES };
    let fits = BATCH_BYTES / (teams * leaders * size_of::<[f32; 4]>()).max(1);
    let fits = fits.clamp(1, BATCH_EPISODES).min(episodes);
    let mut evaluation = Evaluation {
        episodes,
        leaders,
        pois: world.pois.len(),
        observed: vec![Tally::default(); teams],
        together: Tally::default(),
        credits: vec![[0.0; 4]; teams * leaders],
        timed,
        worth: world.total_worth.into(),
    };
    let (mut done, all) = (0, (teams * episodes) as f64);
    // Episodes of teams that are played at once, so that this takes a fraction of a second.
    let mut limit = (FIRST_STEPS / world.steps()).max(1);
    let mut first = 0;
    while first < episodes {
        let at_once = (limit / teams).clamp(1, fits).min(episodes - first);
        let batch: Vec<Vec<Vec2>> = (first..first + at_once).map(|episode| starts.of(episode, world)).collect();
        let (mut observed, mut credits) = (vec![0; at_once * teams], vec![[0_f32; 4]; at_once * teams * leaders]);
        let mut first_team = 0;
        while first_team < teams {
            let count = limit.max(1).min(teams - first_team);
            let chosen = &group.teams[first_team * leaders..(first_team + count) * leaders];
            let groups: Vec<Group<'_>> =
                batch.iter().map(|starts| Group { starts, fitnesses, teams: chosen, ..*group }).collect();
            let started = Instant::now();
            for (episode, scores) in backend.play(&groups)?.into_iter().enumerate() {
                let first = episode * teams + first_team;
                observed[first..first + count].copy_from_slice(&scores.observed);
                let of_teams = scores.scores.chunks_exact(fitnesses.len() * leaders);
                for (to, scores) in credits[first * leaders..].chunks_exact_mut(leaders).zip(of_teams) {
                    for (place, &score) in scores.iter().enumerate() {
                        to[place % leaders][place / leaders] = score;
                    }
                }
            }
            done += groups.len() * count;
            let took = started.elapsed();
            if took < SHORT_BATCH {
                limit = limit.saturating_mul(2);
            } else if took > LONG_BATCH {
                limit = (limit / 2).max(1);
            }
            first_team += count;
            let share = done as f64 / all;
            if first_team < teams && each(Batch { share, first, observed: &[], credits: &[] }).is_break() {
                return Ok(evaluation);
            }
        }
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
        let share = done as f64 / all;
        if each(Batch { share, first, observed: &observed, credits: &credits }).is_break() {
            break;
        }
        first += at_once;
    }
    Ok(evaluation)
}

/// Number of team-steps in the first batch of [`evaluate`].
const FIRST_STEPS: usize = 1 << 16;
/// Range of time that each later batch should take.
const SHORT_BATCH: Duration = Duration::from_millis(100);
const LONG_BATCH: Duration = Duration::from_millis(300);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mean_of_nothing_is_0() {
        let mut tally = Tally::default();
        assert_eq!(tally.mean(), 0.0);
        assert_eq!(tally.spread(2.0, 4), Spread { mean: 0.0, deviation: None, interval: None });
        tally.add(3);
        assert_eq!(tally.mean(), 3.0);
    }
}
