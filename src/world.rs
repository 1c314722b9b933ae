//! One experiment's constants and start state, in the form that kernels and shaders read.

use glam::{DVec2, Vec2};

use crate::config::{Config, LedBy, MAX_AGENTS, MAX_HIDDEN_UNITS, MAX_POIS, MAX_STEPS};
use crate::declare::Choice;
use crate::model::couple::CoupleConstants;
use crate::model::follow::FollowConstants;
use crate::model::motion::MotionConstants;
use crate::model::policy::PolicyConstants;
use crate::model::rule::Rule;
use crate::model::sense::{Density, SenseConstants};

pub use crate::model::motion::GRID;
pub use crate::model::policy::{BEHAVIOURS, OUTPUTS};
pub use crate::model::sense::INPUTS;
pub use crate::model::{Constants, Variant};

/// One world: constants, start positions of all agents (leaders first), POIs, how many agents each needs, and by what
/// rule these observe.
#[derive(Clone, Debug, PartialEq)]
pub struct World {
    /// What kernels read.
    pub constants: Constants,
    /// In units, on the kernels' grid: `[agents]`.
    pub starts: Vec<Vec2>,
    /// Unit vectors, at the start: `[agents]`.
    pub headings: Vec<Vec2>,
    /// In units, on the kernels' grid: `[pois]`.
    pub pois: Vec<Vec2>,
    /// Agents that each POI needs at once (C): `[pois]`.
    pub coupling: Vec<u32>,
    /// Who observes, when and in what order.
    pub rule: Rule,
    /// Whom Dt counts as led.
    pub led: Led,
}

/// Whom a follower is led by at a step, which [`Dt`](crate::config::Fitness::Dt) asks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Led {
    /// Steps that tell it, the last ones up to this; 0 is all since the start.
    pub within: usize,
    /// By which of the leaders that it saw at these.
    pub by: LedBy,
}

impl Default for Led {
    fn default() -> Led {
        Led { within: 0, by: LedBy::MostSeen }
    }
}

impl World {
    /// Builds the world of a valid config; in the all-leaders paradigm the followers' places hold leaders.
    pub fn new(config: &Config) -> World {
        let Config { world, motion, follow, sense, policy, .. } = config;
        let (agents, leaders) = (world.leaders.len() + world.followers.len(), config.learners());
        let pois = world.pois.len();
        let motion = MotionConstants::new(motion, world.dt, world.map);
        let constants = Constants {
            leaders: leaders as u32,
            followers: (agents - leaders) as u32,
            pois: pois as u32,
            steps: world.steps as u32,
            words: agents.div_ceil(32) as u32,
            speed: world.speed as f32,
            variant: Variant { density: sense.density as u32, by_sine: motion.by_sine().into() },
            policy: PolicyConstants::new(policy),
            motion,
            couple: CoupleConstants::new(world.observation_radius),
            follow: FollowConstants::new(follow),
            sense: SenseConstants::new(sense, agents, pois, world.map),
        };
        let map = Vec2::new(motion.map_x, motion.map_y);
        let points =
            |list: &[[f64; 2]]| list.iter().map(|&at| on_grid(DVec2::from(at).as_vec2(), map)).collect::<Vec<_>>();
        World {
            constants,
            starts: [points(&world.leaders), points(&world.followers)].concat(),
            headings: world.headings().into_iter().map(unit).collect(),
            pois: points(&world.pois),
            coupling: world.coupling.of_each(pois),
            led: Led { within: config.learning.led_within, by: config.learning.led_by },
            rule: Rule::new(world.observers.among(leaders, agents - leaders), agents, &world.windows, &world.after),
        }
    }

    /// Its width and height.
    pub fn map(&self) -> Vec2 {
        Vec2::new(self.constants.motion.map_x, self.constants.motion.map_y)
    }

    /// Checks that the fields agree with each other. Shaders run without bounds checks and rely on this.
    ///
    /// # Errors
    /// The name of the first inconsistent field.
    pub fn validate(&self) -> Result<(), &'static str> {
        let (constants, pois) = (&self.constants, self.pois.len());
        let PolicyConstants { layers, widths, parameters } = constants.policy;
        let used = widths.get(..=layers as usize).unwrap_or_default();
        let weights: Option<u32> = used
            .windows(2)
            .try_fold(0_u32, |sum, widths| sum.checked_add(widths[0].checked_add(1)?.checked_mul(widths[1])?));
        let ends = used.len() > 1 && used[0] as usize == INPUTS && constants.policy.actions().is_some();
        let small = used.iter().all(|&width| (1..=MAX_HIDDEN_UNITS.max(INPUTS) as u32).contains(&width));
        let fits = [
            ("leaders", constants.leaders > 0),
            (
                "agents",
                constants.leaders.checked_add(constants.followers).is_some_and(|all| all as usize <= MAX_AGENTS),
            ),
            ("POIs", (1..=MAX_POIS).contains(&pois) && pois == self.coupling.len() && pois == constants.pois as usize),
            ("steps", (1..=MAX_STEPS).contains(&(constants.steps as usize))),
            (
                "start positions",
                self.starts.len() as u64 == u64::from(constants.leaders) + u64::from(constants.followers),
            ),
            ("start headings", self.headings.len() == self.starts.len()),
            ("sets", constants.words as usize == self.starts.len().div_ceil(32)),
            ("observers, windows and order of POIs", self.rule.fits(constants.words as usize, pois)),
            ("density", (constants.variant.density as usize) < Density::ALL.len()),
            (
                "policies",
                ends && small && weights == Some(parameters) && widths[used.len()..].iter().all(|&left| left == 0),
            ),
        ];
        fits.into_iter().find(|(_, fits)| !fits).map_or(Ok(()), |(field, _)| Err(field))
    }

    /// Agents that have a policy, the first of all.
    pub fn leaders(&self) -> usize {
        self.constants.leaders as usize
    }

    /// Agents that follow.
    pub fn followers(&self) -> usize {
        self.constants.followers as usize
    }

    /// Leaders and followers.
    pub fn agents(&self) -> usize {
        self.leaders() + self.followers()
    }

    /// Steps of an episode.
    pub fn steps(&self) -> usize {
        self.constants.steps as usize
    }

    /// Weights of one policy.
    pub fn parameters(&self) -> usize {
        self.constants.policy.parameters as usize
    }

    /// Words of a bit a leader.
    pub fn leader_words(&self) -> usize {
        self.leaders().div_ceil(32)
    }

    /// Words in one team's record of sights: steps × followers × words of leaders.
    pub fn sight_words(&self) -> usize {
        self.steps() * self.followers() * self.leader_words()
    }

    /// Words in one team's record of sets: steps × POIs × words a set.
    pub fn set_words(&self) -> usize {
        self.steps() * self.pois.len() * self.constants.words as usize
    }
}

/// The nearest place of the kernels' grid that is on the map.
pub fn on_grid(place: Vec2, map: Vec2) -> Vec2 {
    ((place * GRID + 0.5).floor() / GRID).clamp(Vec2::ZERO, map)
}

/// The unit vector of an angle; a component under 1e-6 in size is 0, so that layouts full of exact ties keep them.
///
/// Sines and cosines here are [`libm`]'s: those of the platform may differ in the last bit from one system to another.
fn unit(angle: f64) -> Vec2 {
    let tidy = |component: f64| if component.abs() < 1e-6 { 0.0 } else { component as f32 };
    Vec2::new(tidy(libm::cos(angle)), tidy(libm::sin(angle)))
}
