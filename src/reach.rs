//! Bounds on how far agents can travel, and the POIs that no team can observe.
//!
//! A POI that is reported here cannot be observed by any policy. A POI that is not reported may still be out of reach,
//! because the bounds ignore turns and the formation of a team.

use std::fmt::{self, Display};

use glam::DVec2;

use crate::config::{
    AgentClass, Classes, Config, Control, MAX_STEPS, Mobility, PoiGroup, Region, StageConfig, WorldConfig,
};
use crate::model::rule::{NEVER, Rule};
use crate::world::{GRID, on_grid};

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
        /// The name of the agents that count: "agent", or their class if there are others.
        who: String,
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

/// Returns the maximum distance that an agent of a class travels after each step, in units: `[steps + 1]`, 0 at the start.
///
/// The agent accelerates as fast as it can and never turns. Walls can only shorten its path.
pub fn travel(config: &Config, class: &AgentClass, steps: usize) -> Vec<f64> {
    let WorldConfig { map, dt, .. } = config.world;
    // Positions are rounded to f32 and then to the grid, on both axes.
    let rounding = 2f64.sqrt() * (1.0 / f64::from(GRID) + map[0].max(map[1]) * f64::from(f32::EPSILON));
    let (mut speed, mut far) = (class.speed, 0.0);
    let step = |_| {
        speed = match &class.motion {
            _ if class.control == Control::Still => return far,
            Mobility::Steered(motion) => {
                (speed + motion.max_acceleration * dt).max(motion.min_speed).min(motion.max_speed)
            }
            Mobility::Free { max_speed } => 2f64.sqrt() * max_speed,
        };
        far += speed * dt * (1.0 + ROUNDING) + rounding;
        far
    };
    std::iter::once(0.0).chain((0..steps).map(step)).collect()
}

/// The distances that agents travel, and those from each POI at which its observers start.
struct Distances {
    /// The maximum distance that an agent of each class travels, `[classes][steps + 1]`.
    travel: Vec<Vec<f64>>,
    /// The class of observers, their start distance less jitter in units, and how many start there, `[pois]`.
    observers: Vec<Vec<(usize, f64, usize)>>,
    /// The number of observers that each POI needs, `[pois]`.
    couplings: Vec<u32>,
    /// The observation radius of each POI in units, `[pois]`.
    radii: Vec<f64>,
}

impl Distances {
    fn new(config: &StageConfig, classes: &Classes, steps: usize) -> Distances {
        // Jitter moves agent and POI, each by up to this much per axis. Regions are replaced by their middles.
        let jitter = 2f64.sqrt() * (config.learning.start_jitter + config.learning.poi_jitter);
        let map = DVec2::from(config.world.map).as_vec2();
        let on_grid = |at: [f64; 2]| on_grid(DVec2::from(at).as_vec2(), map).as_dvec2();
        let middles = |at: &[[f64; 2]], size: usize, region: Option<Region>| -> Vec<(DVec2, f64, usize)> {
            match region.map(Region::extent) {
                Some((middle, reach)) => vec![(on_grid(middle), reach, size)],
                None => at.iter().map(|&at| (on_grid(at), 0.0, 1)).collect(),
            }
        };
        let starts: Vec<_> =
            classes.agents.iter().map(|class| middles(&class.at, class.size(), class.region)).collect();
        let places = |group: &PoiGroup| middles(&group.at, group.size(), group.region);
        let places = classes.pois.iter().map(places).enumerate().flat_map(|(group, places)| {
            places.into_iter().flat_map(move |(place, reach, size)| vec![(group, place, reach); size])
        });
        let groups = classes.group_of_each();
        let observers = |(group, place, poi_reach): (usize, DVec2, f64)| {
            let left = |start: DVec2, reach: f64| (start.distance(place) - jitter - poi_reach - reach).max(0.0);
            let counted = starts.iter().enumerate().filter(|(class, _)| classes.observes(*class, group));
            let of_class = |(class, starts)| {
                let starts: &Vec<(DVec2, f64, usize)> = starts;
                starts.iter().map(move |&(start, reach, size)| (class, left(start, reach), size))
            };
            counted.flat_map(of_class).collect()
        };
        Distances {
            travel: classes.agents.iter().map(|class| travel(config, class, steps)).collect(),
            observers: places.map(observers).collect(),
            couplings: classes.couplings(),
            radii: groups.iter().map(|&group| classes.pois[group].radius).collect(),
        }
    }

    /// Returns class and distance of the last observer that a POI needs at a step, if they come as near as they can.
    fn last(&self, poi: usize, step: usize) -> (usize, f64) {
        let mut observers = self.observers[poi].clone();
        let left = |&(class, distance, _): &(usize, f64, usize)| distance - self.travel[class][step];
        observers.sort_by(|a, b| left(a).total_cmp(&left(b)));
        let mut needed = self.couplings[poi] as usize;
        let is_last = |&&(_, _, size): &&(usize, f64, usize)| {
            needed = needed.saturating_sub(size);
            needed == 0
        };
        observers.iter().find(is_last).map_or((0, f64::INFINITY), |&(class, distance, _)| (class, distance))
    }

    /// Returns the first step at which enough observers can be within a POI's radius, times this factor.
    fn first(&self, poi: usize, factor: f64) -> Option<usize> {
        let there = |step: usize| {
            let (class, distance) = self.last(poi, step);
            distance <= self.travel[class][step] + self.radii[poi] * factor
        };
        let steps = self.travel[0].len() - 1;
        let (mut from, mut to) = (0, steps + 1);
        while from < to {
            let middle = (from + to) / 2;
            if there(middle) { to = middle } else { from = middle + 1 }
        }
        (from <= steps).then_some(from)
    }
}

/// Returns the POIs that no team can observe in any episode. Uses the config's own keys and ignores its stages.
pub fn unreachable(config: &StageConfig) -> Vec<Unreachable> {
    let (classes, steps) = (config.classes(), config.world.steps);
    let distances = Distances::new(config, &classes, steps);
    let (pois, agents) = (distances.radii.len(), classes.class_of_each().len());
    let rule = Rule::new(&vec![vec![0..agents]; pois], agents, &classes.windows(steps), &classes.after());
    let first: Vec<_> = (0..pois).map(|poi| distances.first(poi, 1.0 + ROUNDING)).collect();
    let there = |poi: usize, step: u32| first[poi].is_some_and(|first| first <= step as usize);
    let mut observed = vec![NEVER; pois];
    rule.observe(steps as u32, &mut observed, |poi, mut open| open.find(|&step| there(poi, step)));
    let groups = classes.group_of_each();
    let who = |poi: usize| {
        let counted = (0..classes.agents.len()).filter(|&class| classes.observes(class, groups[poi]));
        match counted.collect::<Vec<_>>()[..] {
            [class] if classes.agents.len() > 1 => classes.agents[class].name.clone(),
            _ => "agent".into(),
        }
    };
    let why = |poi: usize| {
        let last = rule.window(poi).map_or(steps as u32, |[_, last]| last.min(steps as u32));
        let latest = rule.after(poi).iter().copied().max_by_key(|&other| observed[other]);
        match latest {
            Some(other) if there(poi, last) => {
                Why::After { other, observed: (observed[other] != NEVER).then_some(observed[other] as usize) }
            }
            _ => {
                let (class, distance) = distances.last(poi, last as usize);
                Why::Far {
                    needed: distances.couplings[poi] as usize,
                    who: who(poi),
                    distance,
                    radius: distances.radii[poi],
                    travel: distances.travel[class][last as usize],
                    steps: last as usize,
                }
            }
        }
    };
    let never = (0..pois).filter(|&poi| observed[poi] == NEVER);
    never.map(|poi| Unreachable { poi, why: why(poi) }).collect()
}

/// Returns the smallest number of steps in which every POI could be reached. None if longer episodes would not help.
pub fn fewest_steps(config: &StageConfig, unreachable: &[Unreachable]) -> Option<usize> {
    let far = unreachable.iter().filter(|unreachable| matches!(unreachable.why, Why::Far { .. }));
    let classes = config.classes();
    let (distances, windows) = (Distances::new(config, &classes, MAX_STEPS), classes.windows(MAX_STEPS));
    let is_open = |poi: usize, step: usize| windows.get(poi).is_none_or(|[_, last]| step <= *last);
    let first = |Unreachable { poi, .. }: &Unreachable| distances.first(*poi, 1.0).filter(|&step| is_open(*poi, step));
    let steps: Option<Vec<usize>> = far.map(first).collect();
    steps?.into_iter().max().filter(|&steps| steps > config.world.steps)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::ValidConfig;

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
        let travelled = |keys: &str, steps: usize| {
            let config = config(keys);
            travel(&config, &config.classes().agents[0], steps)
        };
        let far = travelled("coupling = 1\n", 25);
        // 1, 2 and then 3 units per second, for 0.2 s each.
        for (steps, expected) in [(0, 0.0), (1, 0.2), (2, 0.6), (3, 1.2), (25, 14.4)] {
            assert!(far[steps] >= expected && far[steps] < expected + 1e-3, "{steps}: {}", far[steps]);
        }
        let still = travelled("coupling = 1\nspeed = 3\n[motion]\nmax_acceleration = 0\n", 10);
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

    /// Slow, fast and still classes, POIs with radii and observers of their own.
    #[test]
    fn classes_have_their_speeds_and_groups_their_radii() {
        let found = |pois: &str| {
            let text = format!(
                "[world]\nsteps = 25\n\
                 [[agents]]\nname = \"fast\"\nat = [[0, 10]]\nmotion = {{ kind = \"free\", max_speed = 1 }}\n\
                 senses = [{{ of = \"pois\" }}]\n\
                 [[agents]]\nname = \"slow\"\nat = [[0, 20]]\nmotion = {{ max_speed = 0.2 }}\nsenses = [{{ of = \"pois\" }}]\n\
                 [[agents]]\nname = \"stone\"\nat = [[0, 30]]\ncontrol = \"still\"\n{pois}"
            );
            let config = Config::parse(&text, "test").unwrap().validate().unwrap();
            let found = unreachable(config.as_ref());
            let fewest = fewest_steps(config.as_ref(), &found);
            (found.into_iter().map(|found| found.to_string()).collect::<Vec<_>>(), fewest)
        };
        let group =
            |name: &str, at: [u32; 2], keys: &str| format!("[[pois]]\nname = \"{name}\"\nat = [{at:?}]\n{keys}\n");
        // In 25 steps of 0.2 s: 7.1 units, 1.0 units and none.
        let near = [
            group("a", [12, 10], "coupling = 1\nobservers = \"fast\""),
            group("b", [5, 20], "coupling = 1\nradius = 4.1\nobservers = \"slow\""),
            group("c", [0, 35], "coupling = 1\nobservers = \"stone\""),
        ];
        assert_eq!(found(&near.concat()), (vec![], None));
        let far = [
            group("a", [13, 10], "coupling = 1\nobservers = \"fast\""),
            group("b", [5, 20], "coupling = 1\nradius = 3.9\nobservers = \"slow\""),
        ];
        let (lines, fewest) = found(&far.concat());
        assert!(
            lines[0].contains("the nearest fast is 13.0 units away, and an agent travels at most 7.1 units"),
            "{lines:?}"
        );
        assert!(
            lines[1].contains("the nearest slow is 5.0 units away, and an agent travels at most 1.0 units"),
            "{lines:?}"
        );
        assert_eq!((lines.len(), fewest), (2, Some(29)));
        // The stone is needed, and never comes nearer.
        let (lines, fewest) = found(&group("c", [6, 20], "coupling = 3"));
        assert!(
            lines[0].contains("by the 3 agents that it needs: at best the last of them is 11.7 units away"),
            "{lines:?}"
        );
        assert_eq!(fewest, None);
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

    /// Only what no episode allows is reported.
    #[test]
    fn regions_count_from_their_nearest_places() {
        let found = |agents: &str, pois: &str| {
            let text = format!(
                "[world]\nsteps = 25\n[[agents]]\nname = \"a\"\n{agents}\n\
                 motion = {{ kind = \"free\", max_speed = 1 }}\nsenses = [{{ of = \"pois\" }}]\n\
                 [[pois]]\nname = \"p\"\ncoupling = 1\n{pois}\n"
            );
            let config = Config::parse(&text, "test").unwrap().validate().unwrap();
            unreachable(config.as_ref()).len()
        };
        // 7.1 units of travel, and an observation radius of 5.
        assert_eq!(found("at = [[10, 10]]", "at = [[23, 10]]"), 1);
        assert_eq!(found("at = [[10, 10]]", "count = 2\nin = { circle = [24, 10, 2] }"), 0);
        assert_eq!(found("at = [[10, 10]]", "count = 2\nin = { circle = [25, 10, 2] }"), 2);
        assert_eq!(found("count = 2\nin = { box = [7, 10, 13, 10] }", "count = 1\nin = { disc = [26, 10, 1] }"), 0);
        assert_eq!(found("count = 2\nin = { box = [7, 10, 13, 10] }", "count = 1\nin = { disc = [27, 10, 1] }"), 1);
    }

    #[test]
    fn as_many_steps_as_are_named_are_enough() {
        let near = config("coupling = 1\nsteps = 25\n");
        assert_eq!(fewest_steps(near.as_ref(), &unreachable(near.as_ref())), Some(26));
        let still = config("coupling = 1\n[motion]\nmax_speed = 0\n");
        assert_eq!(fewest_steps(still.as_ref(), &unreachable(still.as_ref())), None);
        // More steps do not open a window for longer.
        let closed = config("coupling = 1\nsteps = 25\nwindows = [[1, 25], [1, 25]]\n");
        assert_eq!(fewest_steps(closed.as_ref(), &unreachable(closed.as_ref())), None);
    }
}
