//! Bounds on how far agents can travel, and the POIs that no team can observe.
//!
//! A POI that is reported here cannot be observed by any policy. A POI that is not reported may still be out of reach,
//! because the bounds ignore turns and the formation of a team.

use std::fmt::{self, Display};

use crate::config::{Control, MAX_STEPS, Observers, StageConfig};
use crate::model::rule::NEVER;
use crate::world::{GRID, World};

/// Rounding of headings, speeds and squared distances, relative to their size.
const ROUNDING: f64 = 1e-5;

/// A POI that no team can observe.
#[derive(Clone, Debug, PartialEq)]
pub struct Unreachable {
    /// Index of the POI.
    pub poi: usize,
    /// The reason.
    pub why: Why,
}

/// The reason why no team can observe a POI.
#[derive(Clone, Debug, PartialEq)]
pub enum Why {
    /// Too few agents get there in time.
    Far {
        /// Number of agents that must be there in the same step.
        needed: usize,
        /// The name of the agents that count: "agent", "leader" or "follower".
        who: &'static str,
        /// Start distance between the POI and the farthest agent needed, less jitter, in units.
        distance: f64,
        /// The observation radius in units.
        radius: f64,
        /// Maximum distance that an agent travels until the POI's last step, in units.
        travel: f64,
        /// The last step at which the POI can be observed.
        steps: usize,
    },
    /// The POI comes after another one, and its last step is too early for that.
    After {
        /// The other POI.
        other: usize,
        /// The first step at which the other POI can be observed, if any.
        observed: Option<usize>,
    },
}

impl Unreachable {
    /// Reports whether a message gives the same reason for another POI, after rounding.
    pub fn same_reason(&self, other: &Unreachable) -> bool {
        self.to_string() == Unreachable { poi: self.poi, why: other.why.clone() }.to_string()
    }
}

impl Display for Unreachable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let poi = self.poi;
        match &self.why {
            Why::Far { needed, who, distance, radius, travel, steps } => {
                match needed {
                    1 => write!(f, "POI {poi} cannot be reached: the nearest {who} is {distance:.1} units away")?,
                    _ => write!(
                        f,
                        "POI {poi} cannot be reached by the {needed} {who}s that it needs: at best the last of them is \
                         {distance:.1} units away"
                    )?,
                }
                write!(
                    f,
                    ", and an agent travels at most {travel:.1} units in {steps} steps (the observation radius is {radius})"
                )
            }
            Why::After { other, observed: None } => {
                write!(f, "POI {poi} cannot be observed: it comes after POI {other}, which cannot be observed")
            }
            Why::After { other, observed: Some(step) } => write!(
                f,
                "POI {poi} cannot be observed in time: it comes after POI {other}, which takes until step {step} at least"
            ),
        }
    }
}

/// Returns the maximum distance that an agent of any class travels after each step, in units: `[steps + 1]`, 0 at the
/// start.
///
/// The agent accelerates as fast as it can and never turns. Walls can only shorten its path.
pub fn travel(world: &World, steps: usize) -> Vec<f64> {
    let [largest, dt] = [world.map().max_element(), world.constants.map.dt].map(f64::from);
    // Positions are rounded to f32 and then to the grid, on both axes.
    let rounding = 2f64.sqrt() * (1.0 / f64::from(GRID) + largest * f64::from(f32::EPSILON));
    let mut farthest = vec![0.0; steps + 1];
    for class in world.classes.iter().map(|class| &class.constants) {
        let motion = &class.motion;
        let [start, change, min, max] =
            [motion.speed, motion.max_speed_change, motion.min_speed, motion.max_speed].map(f64::from);
        let (mut speed, mut far) = (start, 0.0);
        for farthest in &mut farthest[1..] {
            speed = match (class.shape.control(), class.shape.free) {
                (Control::Still, _) => 0.0,
                // The maximum holds for each axis.
                (_, 1..) => max * 2f64.sqrt(),
                _ => (speed + change).max(min).min(max),
            };
            far += speed * dt * (1.0 + ROUNDING) + rounding;
            *farthest = far.max(*farthest);
        }
    }
    farthest
}

/// Returns the POIs that no team can observe in any episode. Uses the config's own keys and ignores its stages.
pub fn unreachable(config: &StageConfig) -> Vec<Unreachable> {
    let world = World::new(config);
    let steps = world.steps();
    let travel = travel(&world, steps);
    let radius = |poi: usize| f64::from(world.radii2[poi]).sqrt();
    // Jitter moves agent and POI, each by up to this much per axis.
    let jitter = 2f64.sqrt() * (config.learning.start_jitter + config.learning.poi_jitter);
    let who = match config.world.observers {
        Observers::All => "agent",
        Observers::Leaders => "leader",
        Observers::Followers => "follower",
    };
    // Distance to the farthest agent that a POI needs.
    let distance = |poi: usize| {
        let from = |agent: usize| world.starts[agent].as_dvec2().distance(world.pois[poi].as_dvec2());
        let mut distances: Vec<f64> =
            (0..world.agents()).filter(|&agent| world.rule.counts_at(poi, agent)).map(from).collect();
        distances.sort_by(f64::total_cmp);
        let last = (world.coupling[poi] as usize).saturating_sub(1);
        (distances.get(last).copied().unwrap_or(f64::INFINITY) - jitter).max(0.0)
    };
    let distances: Vec<f64> = (0..world.pois.len()).map(distance).collect();
    let there = |poi: usize, step: u32| distances[poi] <= travel[step as usize] + radius(poi) * (1.0 + ROUNDING);
    let mut observed = vec![NEVER; world.pois.len()];
    world.rule.observe(steps as u32, &mut observed, |poi, mut open| open.find(|&step| there(poi, step)));
    let why = |poi: usize| {
        let last = world.rule.window(poi).map_or(steps as u32, |[_, last]| last.min(steps as u32));
        let latest = world.rule.after(poi).iter().copied().max_by_key(|&other| observed[other]);
        match latest {
            Some(other) if there(poi, last) => {
                Why::After { other, observed: (observed[other] != NEVER).then_some(observed[other] as usize) }
            }
            _ => Why::Far {
                needed: world.coupling[poi] as usize,
                who,
                distance: distances[poi],
                radius: radius(poi),
                travel: travel[last as usize],
                steps: last as usize,
            },
        }
    };
    let never = (0..world.pois.len()).filter(|&poi| observed[poi] == NEVER);
    never.map(|poi| Unreachable { poi, why: why(poi) }).collect()
}

/// Returns the smallest number of steps in which every POI could be reached. None if longer episodes would not help.
pub fn fewest_steps(config: &StageConfig, unreachable: &[Unreachable]) -> Option<usize> {
    let far = unreachable.iter().filter_map(|unreachable| match unreachable.why {
        Why::Far { distance, radius, .. } => Some(distance - radius),
        Why::After { .. } => None,
    });
    let farthest = far.reduce(f64::max)?;
    let steps = travel(&World::new(config), MAX_STEPS).iter().position(|&travel| travel >= farthest)?;
    (steps > config.world.steps).then_some(steps)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, ValidConfig};

    fn config(keys: &str) -> ValidConfig {
        let text = format!(
            "[world]\nmap = [60, 60]\nleaders = [[10, 10], [10, 20]]\nfollowers = [[12, 10]]\npois = [[10, 40], [12, 12]]\n{keys}"
        );
        Config::parse(&text, "test").unwrap().validate().unwrap()
    }

    fn found(keys: &str) -> Vec<(usize, String)> {
        unreachable(config(keys).as_ref()).into_iter().map(|found| (found.poi, found.to_string())).collect()
    }

    #[test]
    fn an_agent_accelerates_to_its_largest_speed() {
        let far = travel(&World::new(&config("coupling = 1\n")), 25);
        // 1, 2 and then 3 units per second, for 0.2 s each.
        for (steps, expected) in [(0, 0.0), (1, 0.2), (2, 0.6), (3, 1.2), (25, 14.4)] {
            assert!(far[steps] >= expected && far[steps] < expected + 1e-3, "{steps}: {}", far[steps]);
        }
        let still = travel(&World::new(&config("coupling = 1\nspeed = 3\n[motion]\nmax_acceleration = 0\n")), 10);
        assert!(still[10] >= 6.0 && still[10] < 6.001, "{still:?}");
    }

    #[test]
    fn the_last_agent_that_is_needed_decides() {
        // The agent at (10, 20) starts 20 units from the first POI, and the radius covers 5 of them. The others start
        // 30 away.
        assert!(found("coupling = 1\nsteps = 26\n").is_empty());
        assert_eq!(
            found("coupling = 1\nsteps = 25\n"),
            [(
                0,
                "POI 0 cannot be reached: the nearest agent is 20.0 units away, and an agent travels at most 14.4 units in \
                 25 steps (the observation radius is 5)"
                    .to_string()
            )]
        );
        let three = found("coupling = 3\nsteps = 40\n");
        assert!(
            three.len() == 1 && three[0].1.contains("by the 3 agents that it needs: at best the last"),
            "{three:?}"
        );
        assert!(found("coupling = 3\nsteps = 45\n").is_empty());
    }

    #[test]
    fn only_observers_count() {
        assert!(found("coupling = 1\nsteps = 26\nobservers = 'leaders'\n").is_empty());
        let followers = found("coupling = 1\nsteps = 26\nobservers = 'followers'\n");
        assert!(
            followers.len() == 1 && followers[0].1.contains("the nearest follower is 30.1 units away"),
            "{followers:?}"
        );
    }

    #[test]
    fn windows_end_early_and_pois_wait_for_others() {
        let closed = found("coupling = 1\nsteps = 40\nwindows = [[1, 25], [1, 40]]\n");
        assert!(closed.len() == 1 && closed[0].1.contains("14.4 units in 25 steps"), "{closed:?}");
        let waits = found("coupling = 1\nsteps = 25\nafter = [[], [0]]\n");
        assert_eq!(waits[1].1, "POI 1 cannot be observed: it comes after POI 0, which cannot be observed");
        let late = found("coupling = 1\nsteps = 40\nwindows = [[1, 40], [1, 26]]\nafter = [[], [0]]\n");
        assert_eq!(
            late[0].1,
            "POI 1 cannot be observed in time: it comes after POI 0, which takes until step 26 at least"
        );
        assert!(found("coupling = 1\nsteps = 40\nwindows = [[1, 40], [1, 27]]\nafter = [[], [0]]\n").is_empty());
    }

    #[test]
    fn jitter_brings_starts_and_pois_nearer() {
        assert!(found("coupling = 1\nsteps = 25\n[learning]\nstart_jitter = 0.5\n").is_empty());
        assert!(found("coupling = 1\nsteps = 25\n[learning]\npoi_jitter = 0.5\n").is_empty());
    }

    #[test]
    fn as_many_steps_as_are_named_are_enough() {
        let near = config("coupling = 1\nsteps = 25\n");
        assert_eq!(fewest_steps(near.as_ref(), &unreachable(near.as_ref())), Some(26));
        let still = config("coupling = 1\n[motion]\nmax_speed = 0\n");
        assert_eq!(fewest_steps(still.as_ref(), &unreachable(still.as_ref())), None);
    }
}
