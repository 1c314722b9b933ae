//! An episode in which the visitor drives one leader. The other leaders use trained policies or the zero policy.

use flotilla::config::Config;
use flotilla::front;
use flotilla::stepping::Stepper;
use flotilla::world::{INPUTS, OUTPUTS};
use serde_json::{Value, json};

use crate::answer::{Refusal, refuse};

pub struct Drive {
    stepper: Stepper,
    leader: usize,
    /// Whether the other leaders use trained policies.
    learned: bool,
    /// One policy per leader, `[leaders][parameters]`.
    policies: Vec<f32>,
    /// Widths of the policies' layers.
    widths: Vec<usize>,
    /// The step at which each POI was observed.
    observed: Vec<Option<u32>>,
}

impl Drive {
    /// Starts an episode.
    ///
    /// `weights` are `[leaders][policies][parameters]`, or `[1][policies][parameters]` if all leaders share a policy.
    /// The first policy of each leader plays. If the sizes do not match, the other leaders use the zero policy.
    pub fn new(config: &Config, leader: usize, policies: usize, weights: Vec<f32>) -> Result<Drive, Refusal> {
        let stepper = front::stepper(config, 1, true).map_err(refuse)?;
        let (leaders, parameters) = (stepper.world().leaders(), stepper.world().parameters());
        if leader >= leaders {
            return Err(refuse(format!("no leader {leader}")));
        }
        let numbers = policies.saturating_mul(parameters);
        let fits = policies > 0 && [numbers, numbers.saturating_mul(leaders)].contains(&weights.len());
        let policies = if fits {
            let champions = weights.chunks_exact(numbers).map(|policies| &policies[..parameters]);
            champions.cycle().take(leaders).flatten().copied().collect()
        } else {
            vec![0.0; leaders * parameters]
        };
        let observed = vec![None; stepper.world().pois.len()];
        let widths = config.policy.widths();
        Ok(Drive { stepper, leader, learned: fits, policies, widths, observed })
    }

    /// Plays one step. `own` is the driven leader's turn and speed, each in -1..1.
    pub fn step(&mut self, own: [f32; 2]) -> Result<(), Refusal> {
        let parameters = self.policies.len() / self.stepper.world().leaders();
        let inputs = self.stepper.inputs().as_chunks::<INPUTS>().0;
        let actions = inputs.iter().zip(self.policies.chunks_exact(parameters)).enumerate();
        let actions: Vec<f32> = actions
            .flat_map(
                |(leader, (inputs, policy))| {
                    if leader == self.leader { own } else { act(policy, &self.widths, inputs) }
                },
            )
            .collect();
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
        let words = self.stepper.near().len() / self.observed.len();
        let rule = &self.stepper.world().rule;
        let near: Vec<u32> = self.stepper.near().chunks(words).map(|set| rule.count(set.iter().copied())).collect();
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

/// Returns the action of a policy. It is not bit-exact, which a drawing does not need.
fn act(policy: &[f32], widths: &[usize], inputs: &[f32]) -> [f32; 2] {
    let (mut layer, mut policy) = (inputs.to_vec(), policy);
    for width in widths.windows(2) {
        let (weights, rest) = policy.split_at((width[0] + 1) * width[1]);
        // Weights are row-major `[inputs, units]`, followed by the biases `[units]`.
        let sum = |unit: usize| {
            let inputs = layer.iter().zip(weights[unit..].iter().step_by(width[1]));
            inputs.fold(weights[width[0] * width[1] + unit], |sum, (input, weight)| sum + input * weight)
        };
        layer = (0..width[1]).map(|unit| sum(unit).tanh()).collect();
        policy = rest;
    }
    match layer[..] {
        [turn, speed] => [turn, speed],
        ref wanted => choose(inputs, wanted),
    }
}

/// Returns the turn and speed of the most wanted behaviour, see [`flotilla::model::policy::choose`].
fn choose(inputs: &[f32], wanted: &[f32]) -> [f32; OUTPUTS] {
    let largest = |of: &[f32]| (1..of.len()).fold(0, |most, at| if of[at] > of[most] { at } else { most });
    let behaviour = largest(wanted);
    let quadrants = if behaviour < 3 { &inputs[..4] } else { &inputs[4..] };
    let quadrant = largest(quadrants);
    let turn = [-0.75, -0.25, 0.25, 0.75][quadrant];
    match behaviour {
        0 => [0.0, -1.0],
        _ if quadrants[quadrant] <= 0.0 => [0.0, 1.0],
        1 | 3 => [turn, 1.0],
        _ => [if turn < 0.0 { turn + 1.0 } else { turn - 1.0 }, 1.0],
    }
}
