//! Scores of given paths, from a real experiment or another simulator.

use super::Failure;
use crate::config::{Config, Fitness};
use crate::credit::{Credit, Episode};
use crate::parallel::*;
use crate::world::World;

/// The scores of given paths.
#[derive(Clone, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct Scored {
    /// The summed values of the POIs that each team observed, weighted by their scores, `[teams]`.
    pub value: Vec<f64>,
    /// G: this as a share of the summed values of all POIs, `[teams]`.
    pub g: Vec<f32>,
    /// D, `[teams][learners]`.
    pub d: Vec<f32>,
    /// Df, `[teams][learners]`.
    pub df: Vec<f32>,
    /// D++, `[teams][learners]`.
    pub dpp: Vec<f32>,
    /// Dt, `[teams][learners]`.
    pub dt: Vec<f32>,
    /// The fitness of each learner: one of these, added to G if `credit.add_g` is set, `[teams][learners]`.
    pub fitness: Vec<f32>,
}

/// Scores paths of teams of a config's world: positions at the start and after each step in units,
/// `[teams][steps + 1][agents][2]`. They need not be on the map, and nothing is simulated. Stages do not matter.
///
/// # Errors
/// The config is invalid, POIs come after others or are drawn from regions, the number of positions is wrong, or one is not
/// finite.
pub fn score(config: &Config, positions: &[f32]) -> Result<Scored, Failure> {
    let valid = config.validate()?;
    let world = World::scored_by_paths(&valid);
    if config.classes().pois.iter().any(|group| !group.after.is_empty()) {
        return Err(Failure::Paths("POIs that come after others cannot be scored from positions".into()));
    }
    if config.pois.iter().any(|group| group.region.is_some()) {
        return Err(Failure::Paths("POIs in regions have no place to score positions by; give `at`".into()));
    }
    let size = world.path_words();
    if positions.is_empty() || !positions.len().is_multiple_of(size) {
        let (found, moments, agents) = (positions.len(), world.steps() + 1, world.agents());
        return Err(Failure::Paths(format!(
            "{found} coordinates; [teams][{moments}][{agents}][2] are {size} per team"
        )));
    }
    if let Some(index) = positions.iter().position(|coordinate| !coordinate.is_finite()) {
        let (team, agent, moment) = (index / size, index / 2 % world.agents(), index % size / 2 / world.agents());
        let value = positions[index];
        return Err(Failure::Paths(format!("agent {agent} of team {team} is at {value} after step {moment}")));
    }
    let of_each = config.fitness_of_each();
    let teams: Vec<_> = positions
        .par_chunks_exact(size)
        .map_init(Credit::default, |credit, positions| {
            credit.all(&Episode::whole(&[], &[], bytemuck::cast_slice(positions), Some(&world.pois)), &world)
        })
        .collect();
    let (values, total) = (world.values.iter().map(|&value| f64::from(value)).sum::<f64>(), world.total_worth);
    let mut scored = Scored::default();
    for scores in teams {
        scored.value.push(f64::from(scores.observed) / f64::from(total) * values);
        for (leader, &fitness) in of_each.iter().enumerate() {
            let own = match fitness {
                Fitness::G => scores.g,
                Fitness::D => scores.d[leader],
                Fitness::Df => scores.df[leader],
                Fitness::Dpp => scores.dpp[leader],
                Fitness::Dt => scores.dt[leader],
            };
            let added = if config.credit.add_g && fitness != Fitness::G { scores.g } else { 0.0 };
            scored.fitness.push(own + added);
        }
        scored.g.push(scores.g);
        scored.d.extend(scores.d);
        scored.df.extend(scores.df);
        scored.dpp.extend(scores.dpp);
        scored.dt.extend(scores.dt);
    }
    Ok(scored)
}
