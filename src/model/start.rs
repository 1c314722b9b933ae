//! Start headings of agents.

use std::f64::consts::TAU;

use crate::reader::OneOrEach;

/// The agents' headings at the start, in radians from the x axis towards the y axis: one heading for all agents; one per
/// leader, which its followers share; or one per agent, leaders first.
pub type Heading = OneOrEach<f64>;

impl Heading {
    /// Returns a note if a heading is larger than a full turn: it was likely meant in degrees. `key` is its name.
    pub(crate) fn likely_degrees(&self, key: &str) -> Option<String> {
        let headings = match self {
            Heading::Same(heading) => std::slice::from_ref(heading),
            Heading::Each(headings) => headings,
        };
        let large = headings.iter().find(|heading| heading.abs() > TAU)?;
        Some(format!(
            "{key} has {large}, which is more than a full turn: headings are in radians, and {large} degrees \
             would be {:.4}",
            large.to_radians()
        ))
    }

    /// Returns the heading of each agent in radians, leaders first, from the start positions.
    pub fn of_agents(&self, leaders: &[[f64; 2]], followers: &[[f64; 2]]) -> Vec<f64> {
        match self {
            Heading::Same(heading) => vec![*heading; leaders.len() + followers.len()],
            Heading::Each(headings) if headings.len() == leaders.len() => {
                let own = |follower: &[f64; 2]| headings[nearest(follower, leaders)];
                headings.iter().copied().chain(followers.iter().map(own)).collect()
            }
            Heading::Each(headings) => headings.clone(),
        }
    }
}

/// Returns the index of the nearest place. Ties go to the first.
pub fn nearest(from: &[f64; 2], places: &[[f64; 2]]) -> usize {
    let distance2 = |at: &[f64; 2]| {
        let [dx, dy] = [at[0] - from[0], at[1] - from[1]];
        dx * dx + dy * dy
    };
    (0..places.len()).min_by(|&a, &b| distance2(&places[a]).total_cmp(&distance2(&places[b]))).unwrap_or(0)
}
