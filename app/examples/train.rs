//! Trains the paper's first experiment, and prints the curve. Training stops when every trial's champion observes all
//! POIs.
//!
//! ```text
//! cargo run --release --example train
//! ```

use std::error::Error;
use std::ops::ControlFlow::{Break, Continue};
use std::path::Path;

use flotilla::Config;
use flotilla::front::Processor;

pub fn main() -> Result<(), Box<dyn Error>> {
    let mut config =
        Config::load(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/generally_forward.toml")))?;
    config.learning.generations = 60;
    let ((mut backend, _), _) = flotilla::open(&Processor::Auto)?;

    let trained = flotilla::train(&config, &mut *backend, |generation| {
        let solved = generation.rows.iter().all(|row| row.champion_g == 1.0);
        if solved { Break(()) } else { Continue(()) }
    })?;

    let columns = trained.config.learning.generations + 1;
    println!("generation  champion's G, mean over {} trials", config.learning.trials);
    for generation in (0..columns).step_by(5) {
        let g = trained.champion_g.iter().skip(generation).step_by(columns);
        let mean = g.sum::<f64>() / config.learning.trials as f64;
        println!("{generation:>10}  {mean:.2} {}", "#".repeat((mean * 40.0) as usize));
    }
    println!("after generation {}: digest {}", columns - 1, trained.digest());
    Ok(())
}
