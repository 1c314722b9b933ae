//! An episode in which the visitor drives one leader. The other leaders use trained policies or the zero policy.

use flotilla::backend::cpu;
use flotilla::config::Config;
use flotilla::evolve;
use flotilla::front;
use flotilla::stepping::Stepper;
use flotilla::world::OUTPUTS;
use serde_json::{Value, json};

use crate::answer::{Refusal, refuse};

pub struct Drive {
    stepper: Stepper,
    leader: usize,
    /// Whether the other leaders use trained policies.
    learned: bool,
    /// One policy per leader, `[leaders][parameters]`.
    policies: Vec<f32>,
    /// The step at which each POI was observed.
    observed: Vec<Option<u32>>,
}

impl Drive {
    /// Starts an episode.
    ///
    /// `weights` are `[leaders][policies][parameters]`, or `[1][policies][parameters]` if all leaders share a policy.
    /// The first policy of each leader plays. If the weights do not fit, the other leaders use the zero policy.
    pub fn new(config: &Config, leader: usize, policies: usize, mut weights: Vec<f32>) -> Result<Drive, Refusal> {
        let stepper = front::stepper(config, 1, true).map_err(refuse)?;
        let (leaders, parameters) = (stepper.world().leaders(), stepper.world().parameters());
        if leader >= leaders {
            return Err(refuse(format!("no leader {leader}")));
        }
        let numbers = policies.saturating_mul(parameters);
        let fits = policies > 0
            && [numbers, numbers.saturating_mul(leaders)].contains(&weights.len())
            && evolve::flush_and_validate(&mut weights).is_none();
        let policies = if fits {
            let champions = weights.chunks_exact(numbers).map(|policies| &policies[..parameters]);
            champions.cycle().take(leaders).flatten().copied().collect()
        } else {
            vec![0.0; leaders * parameters]
        };
        let observed = vec![None; stepper.world().pois.len()];
        Ok(Drive { stepper, leader, learned: fits, policies, observed })
    }

    /// Plays one step. `own` is the driven leader's turn and speed, each in -1..1.
    pub fn step(&mut self, own: [f32; 2]) -> Result<(), Refusal> {
        let world = self.stepper.world();
        let mut actions = vec![0.0; world.leaders() * OUTPUTS];
        for class in world.classes.iter().filter(|class| class.constants.shape.control().learns()) {
            let (own, width) = (class.agents(), world.inputs());
            let inputs = &self.stepper.inputs()[own.start * width..own.end * width];
            let to = &mut actions[own.start * OUTPUTS..own.end * OUTPUTS];
            let choices = class.constants.shape.choices();
            cpu::forward(&world.constants.policy, &self.policies, inputs, &|row| own.start + row, choices, to);
        }
        actions[self.leader * OUTPUTS..][..OUTPUTS].copy_from_slice(&own);
        self.stepper.step(&actions).map_err(refuse)?;
        let step = self.stepper.steps()[0];
        for (observed, &newly) in self.observed.iter_mut().zip(self.stepper.newly_observed()) {
            if newly {
                *observed = Some(step);
            }
        }
        Ok(())
    }

    /// Returns positions, headings and observed POIs as JSON. After the last step, also G and each leader's D and Df.
    pub fn state(&mut self) -> Result<Value, Refusal> {
        let step = self.stepper.steps()[0];
        let words = self.stepper.agents_at_poi().len() / self.observed.len();
        let rule = &self.stepper.world().rule;
        let near: Vec<u32> = self
            .stepper
            .agents_at_poi()
            .chunks(words)
            .enumerate()
            .map(|(poi, set)| rule.count(poi, set.iter().copied()))
            .collect();
        let scores = self.stepper.is_over(0).then(|| self.stepper.scores(0)).transpose().map_err(refuse)?;
        let states = self.stepper.states();
        Ok(json!({
            "step": step,
            "learned": self.learned,
            "positions": states.positions,
            "headings": states.headings,
            "near": near,
            "observed": self.observed,
            "scores": scores.map(|scores| json!({ "g": scores.g, "d": scores.d, "df": scores.df })),
        }))
    }
}
