//! Ask and tell: the caller scores the policies of a generation.
//!
//! The populations stay on the host. With the scores of [`Trainer::play_candidates`], the results equal those of
//! [`Trainer::advance`].

use glam::Vec2;

use super::experiment::Experiment;
use super::results::{self, mean_score};
use super::{Row, Trainer};
use crate::backend::{Backend, BackendError};
use crate::parallel::*;
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
    /// Forms the teams of the generation that an experiment plays next, and returns them, one entry per trial.
    ///
    /// # Panics
    /// A backend holds the populations since [`Trainer::advance`].
    pub fn ask(&mut self, experiment: usize) -> Vec<Candidates<'_>> {
        let experiment = &mut self.experiments[experiment];
        assert!(!experiment.residency.is_on_device(), "ask and advance take turns on one trainer");
        experiment.prepare(self.level);
        let pairs = experiment.trials.iter().zip(&experiment.schedules);
        let asked = pairs.map(|(trial, schedule)| Candidates {
            weights: &trial.weights,
            teams: &schedule.teams,
            starts: &schedule.starts,
        });
        asked.collect()
    }

    /// Plays the teams that [`Trainer::ask`] returns, and keeps their scores.
    ///
    /// # Errors
    /// The backend failed.
    pub(crate) fn play_candidates(&mut self, experiment: usize, backend: &mut dyn Backend) -> Result<(), BackendError> {
        let level = self.level;
        scope(|_| {
            let experiment = &mut self.experiments[experiment];
            experiment.prepare(level);
            let mut playing = [(0, experiment)];
            let scores = results::play(backend, &playing)?;
            results::keep(scores, &mut playing);
            Ok(())
        })
    }

    /// Returns the world of the next generation and its number of teams, without the champions' team. The number is 0
    /// if only the champions still have to play.
    pub(crate) fn candidates_world(&self, experiment: usize) -> (&World, usize) {
        let experiment = &self.experiments[experiment];
        let stage = experiment.stage();
        (&stage.world, if experiment.only_champions_left() { 0 } else { experiment.teams() })
    }

    /// Returns G, `[trials][teams]`, and the config's fitness of each leader, `[trials][teams][leaders]`, of the teams
    /// that [`Trainer::play_candidates`] played, as means over episodes.
    /// Both are empty if only the champions were left to play.
    pub fn played(&self, experiment: usize) -> (Vec<f64>, Vec<f32>) {
        let (world, teams) = self.candidates_world(experiment);
        let experiment = &self.experiments[experiment];
        let (mut g, mut scores) = (Vec::new(), Vec::new());
        for trial in &experiment.trials {
            let all = (world.pois.len() * trial.scores.len()) as f64;
            let observed =
                |team: usize| trial.scores.iter().map(|episode| u64::from(episode.observed[team])).sum::<u64>();
            g.extend((0..teams).map(|team| observed(team) as f64 / all));
            scores.extend((0..teams * world.leaders()).map(|place| mean_score(&trial.scores, place)));
        }
        (g, scores)
    }

    /// Breeds the next generation of an experiment whose teams were played. `fitness` is what each leader of each team
    /// was worth, `[trials][teams][leaders]`; `None` takes the config's fitness.
    ///
    /// Returns the rows that became complete: a generation's champions play with the next generation, and alone after
    /// the last.
    ///
    /// # Panics
    /// `fitness` has the wrong length, or a backend holds the populations since [`Trainer::advance`].
    pub fn tell(&mut self, index: usize, fitness: Option<&[f32]>) -> Vec<Row> {
        let level = self.level;
        let (world, teams) = self.candidates_world(index);
        let expected = self.experiments[index].trials.len() * teams * world.leaders();
        assert!(fitness.is_none_or(|fitness| fitness.len() == expected), "there are {expected} scores");
        scope(|_| {
            let experiment: &mut Experiment = &mut self.experiments[index];
            assert!(!experiment.residency.is_on_device(), "tell and advance take turns on one trainer");
            let mut rows = if experiment.only_champions_left() {
                experiment.collect_last_rows()
            } else {
                let rows = experiment.collect_results(index, fitness);
                experiment.breed_on_host(level);
                rows
            };
            rows.sort_by_key(|row| (row.experiment, row.trial, row.generation));
            rows
        })
    }
}
