//! An episode in which the visitor drives one leader. The other leaders use trained policies or the zero policy.

use flotilla::backend::cpu;
use flotilla::config::{Config, drawn_agents};
use flotilla::front;
use flotilla::stepping::Stepper;
use flotilla::world::OUTPUTS;
use flotilla_app::report::replay;
use serde_json::{Value, json};

use crate::answer::{Refusal, refuse};
use crate::archive;

pub struct Drive {
    stepper: Stepper,
    leader: usize,
    /// Whether the other leaders use trained policies.
    learned: bool,
    /// One policy per leader, `[leaders][parameters]`.
    policies: Vec<f32>,
    /// The agents near each POI at the start, see [`replay::near_at_start`].
    start: Vec<u32>,
    /// The first step that observed each POI.
    observed: Vec<Option<usize>>,
}

impl Drive {
    /// Starts an episode.
    ///
    /// `weights` are `[populations][policies][parameters]`. The first policy of each leader's population plays. If the
    /// weights do not fit, the other leaders use the zero policy.
    pub fn new(config: &Config, leader: usize, policies: usize, mut weights: Vec<f32>) -> Result<Drive, Refusal> {
        let mut stepper = front::stepper(config, 1, true).map_err(refuse)?;
        let (leaders, parameters) = (stepper.world().leaders(), stepper.world().parameters());
        if leader >= leaders {
            return Err(refuse(format!("no leader {leader}")));
        }
        let populations = archive::populations_of(config, policies, &mut weights);
        let learned = populations.is_some();
        let champion = |population: u32| &weights[population as usize * policies * parameters..][..parameters];
        let policies = match populations {
            Some(populations) => populations.into_iter().flat_map(champion).copied().collect(),
            None => vec![0.0; leaders * parameters],
        };
        let positions: Vec<[f32; 2]> = bytemuck::pod_collect_to_vec(stepper.states().positions);
        let (world, observed) = (stepper.world(), vec![None; stepper.world().pois.len()]);
        let start = replay::near_at_start(world, &world.pois, |agent| positions[agent].into());
        Ok(Drive { stepper, leader, learned, policies, start, observed })
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
        let step = self.stepper.steps()[0] as usize;
        for (observed, &newly) in self.observed.iter_mut().zip(self.stepper.newly_observed()) {
            if newly {
                *observed = Some(step);
            }
        }
        Ok(())
    }

    /// Returns positions and headings of the agents that are drawn, and observed POIs, as JSON. After the last step, also
    /// G and each leader's D and Df.
    pub fn state(&mut self) -> Result<Value, Refusal> {
        let step = self.stepper.steps()[0] as usize;
        let words = self.stepper.agents_at_poi().len() / self.observed.len();
        let world = self.stepper.world();
        let drawn = drawn_agents(world.leaders(), world.agents());
        let count = |sets: &[u32], poi: usize| {
            sets.get(poi * words..(poi + 1) * words).map_or(0, |set| world.rule.count(poi, set.iter().copied()))
        };
        let near_at = |at: usize, poi: usize| match at {
            0 => count(&self.start, poi),
            _ if at == step => count(self.stepper.agents_at_poi(), poi),
            _ => 0,
        };
        let near: Vec<u32> = (0..self.observed.len()).map(|poi| near_at(step, poi)).collect();
        let observed = replay::as_scored(world, self.observed.clone(), near_at);
        let scores = self.stepper.is_over(0).then(|| self.stepper.scores(0)).transpose().map_err(refuse)?;
        let states = self.stepper.states();
        let of_drawn = |of_all: &[f32]| -> Vec<[f32; 2]> {
            let of_all = of_all.as_chunks().0;
            drawn.iter().map(|&agent| of_all[agent]).collect()
        };
        Ok(json!({
            "step": step,
            "learned": self.learned,
            "positions": of_drawn(states.positions).as_flattened(),
            "headings": of_drawn(states.headings).as_flattened(),
            "near": near,
            "observed": observed,
            "scores": scores.map(|scores| json!({ "g": scores.g, "d": scores.d, "df": scores.df })),
        }))
    }
}
