//! Start headings of agents. The key is in `[world]`.

use std::f64::consts::{FRAC_PI_2, TAU};

use crate::reader::{OneOrEach, Reader, between};

/// The agents' headings at the start, in radians from the x axis towards the y axis: one heading for all agents; one per
/// leader, which its followers share; or one per agent, leaders first.
pub type Heading = OneOrEach<f64>;

impl Heading {
    /// Reads the key. `counts` are the numbers of leaders and followers, `None` if they are unknown.
    pub(crate) fn read(r: &mut Reader<'_>, counts: Option<[usize; 2]>) -> Heading {
        let errors_before = r.error_count();
        let heading = r
            .key(
                "world.heading",
                "rad",
                "headings at the start, from the x axis towards the y axis (π/2 faces the POIs of the paper's layouts): \
                 one number for all agents, one per leader (a follower takes that of the leader nearest to it), or one \
                 per agent",
                "3.1, Fig. 3",
            )
            .one_or_each(between(-1e3, 1e3), 0..=usize::MAX, FRAC_PI_2);
        if let (Heading::Each(headings), Some([leaders, followers])) = (&heading, counts)
            && r.error_count() == errors_before
            && ![leaders, leaders + followers].contains(&headings.len())
        {
            let per_agent = match followers {
                0 => String::new(),
                _ => format!(" or {} (one per agent)", leaders + followers),
            };
            let found = headings.len();
            let message = format!(
                "found a list of {found}, allowed one number or a list of {leaders} (one per leader){per_agent}"
            );
            r.report_key("world.heading", message);
        }
        heading
    }

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
