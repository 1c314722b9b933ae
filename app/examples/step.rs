//! Steps a batch of teams with a hand-written rule. Every leader turns to the quadrant with the most POIs, and slows
//! down near other agents.
//!
//! ```text
//! cargo run --release --example step
//! ```

use std::error::Error;
use std::path::Path;

use flotilla::Config;
use flotilla::evaluate::Starts;

/// The turn towards each quadrant that a leader senses, as a share of a half turn to the left. The quadrants are back
/// right, front right, front left and back left.
const TURNS: [f32; 4] = [-0.75, -0.25, 0.25, 0.75];

pub fn main() -> Result<(), Box<dyn Error>> {
    let config = Config::load(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/generally_forward.toml")))?;
    let teams = 100;
    let mut stepper = flotilla::stepper(&config, teams, true)?;

    // Every team gets its own random start.
    let drawn = Starts::Drawn { episodes: teams as u32, seed: 1, jitter: 0.5, poi_jitter: 0.0 };
    let starts = (0..teams).flat_map(|team| drawn.of(team, stepper.world()));
    let starts: Vec<f32> = starts.flat_map(|start| start.to_array()).collect();
    stepper.reset_to(&starts)?;

    let mut actions = vec![0.0; teams * stepper.world().leaders() * 2];
    while !stepper.is_over(0) {
        for (action, inputs) in actions.chunks_exact_mut(2).zip(stepper.inputs().chunks_exact(8)) {
            let (pois, agents) = inputs.split_at(4);
            let most = (0..4).fold(1, |most, quadrant| if pois[quadrant] > pois[most] { quadrant } else { most });
            action[0] = TURNS[most];
            action[1] = 1.0 - agents.iter().sum::<f32>();
        }
        stepper.step(&actions)?;
    }

    let observed = stepper.observed().iter().filter(|&&observed| observed).count();
    println!("{teams} teams with this rule observe {:.2} POIs on average", observed as f64 / teams as f64);
    let scores = stepper.scores(0)?;
    println!("in team 0, which observes {}, the leaders' D are {:?}", scores.observed, scores.d);
    Ok(())
}
