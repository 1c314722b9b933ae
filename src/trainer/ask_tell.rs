//! The teams of a generation and their scores, for callers that score policies themselves.
//!
//! Methods concern a trainer's first experiment, whose populations are [kept on the host](Trainer::keep_on_host).

use glam::Vec2;

use super::Trainer;
use super::stages::observed;
use crate::world::World;

/// Teams that one trial plays in a generation.
#[derive(Clone, Copy, Debug)]
pub struct Candidates<'a> {
    /// The populations, `[populations][slots][parameters]`, see [`Learning::slots`](crate::config::Learning::slots).
    pub weights: &'a [f32],
    /// The policy of each leader in each team, `[teams + 1][leaders]`. The teams with past champions come after the
    /// others, and the champions' team is the last.
    pub teams: &'a [u32],
    /// Start positions of every episode, followed by POI positions if POIs move, `[episodes][agents + pois]`.
    pub starts: &'a [Vec<Vec2>],
}

impl Trainer {
    /// Forms the teams of the next generation, and returns them, one entry per trial.
    pub(crate) fn candidates(&mut self) -> Vec<Candidates<'_>> {
        let experiment = &mut self.experiments[0];
        experiment.prepare(self.level);
        let pairs = experiment.trials.iter().zip(&experiment.schedules);
        let candidates = pairs.map(|(trial, schedule)| Candidates {
            weights: &trial.weights,
            teams: &schedule.teams,
            starts: &schedule.starts,
        });
        candidates.collect()
    }

    /// Returns the world of the next generation and its number of teams, without the champions' team. The number is 0
    /// if only the champions still have to play.
    pub(crate) fn world_and_teams(&self) -> (&World, usize) {
        let experiment = &self.experiments[0];
        let teams = if experiment.only_champions_left() { 0 } else { experiment.teams() };
        (&experiment.stage().world, teams)
    }

    /// Returns G, `[trials][teams]`, and the config's fitness of each leader, `[trials][teams][leaders]`, of the teams
    /// that [`Trainer::play`] played, as means over episodes. Both are empty if only the champions were left to play.
    pub(crate) fn scores(&self) -> (Vec<f64>, Vec<f32>) {
        let (stage, (world, teams)) = (self.experiments[0].stage(), self.world_and_teams());
        let (mut g, mut scores) = (Vec::new(), Vec::new());
        for trial in &self.experiments[0].trials {
            let all = f64::from(world.total_worth) * trial.scores.len() as f64;
            g.extend((0..teams).map(|team| observed(&trial.scores, team) as f64 / all));
            let places = (0..teams).flat_map(|team| (0..world.leaders()).map(move |leader| (team, leader)));
            scores.extend(places.map(|place| stage.mean_score(&trial.scores, place)));
        }
        (g, scores)
    }
}
