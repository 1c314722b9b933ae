//! Plays policies that flotilla did not train, here random ones. All leaders of a team share a policy.
//!
//! ```text
//! cargo run --release --example play
//! ```

use std::error::Error;
use std::path::Path;

use flotilla::Config;
use flotilla::evaluate::Starts;
use flotilla::front::Processor;
use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};

pub fn main() -> Result<(), Box<dyn Error>> {
    let config = Config::load(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/chaotic.toml")))?;
    let ((mut backend, _), _) = flotilla::open(&Processor::Auto)?;

    // [1][teams][parameters]: one policy for all leaders of a team.
    let (teams, parameters) = (1000, config.parameters());
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let policies: Vec<f32> = (0..teams * parameters).map(|_| random.random_range(-2.0..2.0)).collect();
    let played = flotilla::play(&config, &mut *backend, teams, &policies, &Starts::Own)?;
    let best = (0..teams).fold(0, |best, team| if played.g[team] > played.g[best] { team } else { best });
    println!("the best of {teams} random policies observes {} POIs", played.observed[best]);

    // Play the best policy from 100 random starts, for its mean score and the leaders' credits.
    let policy = &policies[best * parameters..][..parameters];
    let starts = Starts::Drawn { episodes: 100, seed: 1, jitter: 0.5, poi_jitter: 0.0 };
    let played = flotilla::play(&config, &mut *backend, 1, policy, &starts)?;
    println!("and {:.2} of them on average from jittered starts", played.observed[0]);
    println!("its leaders' D are {:.2?}, their Df {:.2?}", played.d, played.df);

    let traced = flotilla::trace(&config, 1, policy, &Starts::Own, 0)?;
    let last = &traced.positions[traced.positions.len() - config.world.leaders.len().max(1) * 2..];
    println!("the last agents end at {last:.1?}");
    Ok(())
}
