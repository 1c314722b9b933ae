//! Scripted teams: leaders that drive to given places, whatever they sense. They show that a task can be solved.
//!
//! A script is a CSV table with the columns `leader,until,x,y,speed`. Until step `until`, the leader drives to (x, y) at
//! no more than this speed, and waits there. A leader's rows are in ascending order of `until`. After the last it stops.

use std::f32::consts::PI;

use serde::Deserialize;

use flotilla::config::{Config, Mobility, StageConfig};
use flotilla::evaluate::Starts;
use flotilla::stepping::{Recording, StepError, Stepper};
use flotilla::world::World;

/// The places that a team's leaders drive to.
#[derive(Clone, Debug, Default)]
pub struct Script(Vec<Leg>);

/// A target of one leader, until a step.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Leg {
    leader: usize,
    until: u32,
    /// The target, in units.
    x: f32,
    y: f32,
    /// The largest speed, in units per second.
    speed: f32,
}

impl Script {
    /// Reads a script from a CSV table.
    ///
    /// # Errors
    /// A column is missing or unknown, or a value is not a number.
    pub fn parse(table: &str) -> Result<Script, csv::Error> {
        let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(table.as_bytes());
        Ok(Script(reader.deserialize().collect::<Result<_, _>>()?))
    }

    /// Checks that the script is for the leaders of a config.
    ///
    /// # Errors
    /// There are no rows, a leader does not exist, a number is out of range, or a leader's rows are not in order.
    pub fn check(&self, config: &Config) -> Result<(), String> {
        if self.0.is_empty() {
            return Err("there are no rows".into());
        }
        let mut last = vec![0; config.learners()];
        for (row, leg) in (1..).zip(&self.0) {
            let leaders = last.len();
            let Some(last) = last.get_mut(leg.leader) else {
                return Err(format!("row {row}: leader {} of {leaders}; they count from 0", leg.leader));
            };
            if ![leg.x, leg.y, leg.speed].iter().all(|number| number.is_finite()) || leg.speed < 0.0 {
                return Err(format!("row {row}: x, y and speed have to be finite, and speed at least 0"));
            }
            if leg.until <= *last {
                return Err(format!("row {row}: `until` has to be larger than in this leader's row before"));
            }
            *last = leg.until;
        }
        Ok(())
    }

    /// Plays one team from the start of an episode. Returns the step at which each POI was first observed, `[pois]`.
    ///
    /// # Errors
    /// There is too little memory, or a target is not finite, see [`Script::check`].
    pub fn play_from(
        &self,
        config: &StageConfig,
        starts: &Starts,
        episode: usize,
    ) -> Result<Vec<Option<u32>>, StepError> {
        let mut stepper = Stepper::new(World::new(config), 1, Recording::None)?;
        let places = starts.of(episode, stepper.world());
        stepper.reset_to(&places.iter().flat_map(|place| place.to_array()).collect::<Vec<_>>())?;
        let (leaders, classes) = (config.learners(), config.classes());
        let class_of = classes.class_of_each();
        // Actions of a leader that stays where it is.
        let rest: Vec<[f32; 2]> = class_of[..leaders]
            .iter()
            .map(
                |&class| {
                    if matches!(classes.agents[class].motion, Mobility::Free { .. }) { [0.0; 2] } else { [0.0, -1.0] }
                },
            )
            .collect();
        let mut first = vec![None; config.poi_count()];
        while !stepper.is_over(0) {
            let step = stepper.steps()[0];
            let states = stepper.states();
            let mut actions = rest.concat();
            for (leader, action) in actions.chunks_exact_mut(2).enumerate() {
                let leg = self.0.iter().find(|leg| leg.leader == leader && step < leg.until);
                let Some(leg) = leg else { continue };
                let vector = |vectors: &[f32]| [vectors[2 * leader], vectors[2 * leader + 1]];
                let ([x, y], [hx, hy]) = (vector(states.positions), vector(states.headings));
                let (dx, dy) = (leg.x - x, leg.y - y);
                // `libm` gives the same bits on every system.
                let turn = libm::atan2f(hx * dy - hy * dx, hx * dx + hy * dy);
                // Slow down near the place, and if it is not ahead.
                let away = libm::hypotf(dx, dy);
                let speed = leg.speed.min(2.0 * away);
                match &classes.agents[class_of[leader]].motion {
                    Mobility::Steered(motion) => {
                        let speed = speed * libm::cosf(turn).max(0.0);
                        let wanted = 2.0 * speed / motion.max_speed as f32 - 1.0;
                        action.copy_from_slice(&[turn / PI, wanted.clamp(-1.0, 1.0)]);
                    }
                    Mobility::Free { max_speed } => {
                        let share = speed / (away * *max_speed as f32).max(f32::MIN_POSITIVE);
                        action.copy_from_slice(&[dx, dy].map(|offset| (offset * share).clamp(-1.0, 1.0)));
                    }
                }
            }
            stepper.step(&actions)?;
            for (first, &observed) in first.iter_mut().zip(stepper.observed()) {
                if observed && first.is_none() {
                    *first = Some(step + 1);
                }
            }
        }
        Ok(first)
    }
}
