//! The paper's claims with some keys changed in every experiment: how much hangs on what the paper leaves open.
//!
//! ```text
//! cargo run --release --example claims -- --trials 20 --seed 9001 sense.density=inverse
//! ```

use std::process::ExitCode;

use flotilla::backend::cpu::Cpu;
use flotilla::config::{Override, Paradigm};
use flotilla::record::metrics::Row;
use flotilla::report::paper;
use flotilla::trainer::Trainer;

fn main() -> ExitCode {
    match overrides(std::env::args().skip(1)).and_then(|keys| measure(&keys)) {
        Ok(text) => {
            print!("{text}");
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

/// `--trials N` and `--seed N` are `learning.trials=N` and `learning.seed=N`; words need no quotes.
fn overrides(words: impl Iterator<Item = String>) -> Result<Vec<Override>, String> {
    let mut words = words.map(|word| match word.strip_prefix("--") {
        Some(flag) => (format!("learning.{flag}"), None),
        None => match word.split_once('=') {
            Some((key, value)) => (key.to_string(), Some(value.to_string())),
            None => (String::new(), Some(word)),
        },
    });
    let mut overrides = Vec::new();
    while let Some((key, value)) = words.next() {
        let value = value.or_else(|| words.next().and_then(|(_, value)| value)).ok_or(format!("{key}: no value"))?;
        let plain = value.parse::<f64>().is_err() && !value.starts_with(['"', '[']);
        let text = if plain { format!("{value:?}") } else { value };
        overrides.push(Override { name: key.clone(), key, text });
    }
    Ok(overrides)
}

/// Trains every experiment of the paper with these keys; the table of claims, and what each arm came to.
fn measure(keys: &[Override]) -> Result<String, String> {
    let mut arms = paper::arms(keys).map_err(|error| error.to_string())?;
    let (configs, places) = paper::trained(&arms);
    let mut backend = Cpu::default();
    let mut trainer = Trainer::new(configs);
    while !trainer.is_done() {
        for row in trainer.advance(&mut backend).map_err(|error| error.to_string())? {
            for (arm, _) in places.iter().enumerate().filter(|&(_, &place)| place == row.arm) {
                arms[arm].add(&Row { arm, ..row });
            }
        }
    }
    let claims = paper::claims(&arms);
    let mut text = format!("{}\n{}.\n\n", paper::table(&claims), paper::count(&claims));
    for arm in &arms {
        let last: Vec<f64> = arm.best.iter().filter_map(|trial| trial.last()).map(|g| g * arm.pois() as f64).collect();
        let mean = last.iter().sum::<f64>() / last.len() as f64;
        // Where everyone leads, Df is D.
        if (arm.paradigm, arm.fitness.to_string().as_str()) != (Paradigm::AllLeaders, "Df") {
            text += &format!("{}: {mean:.2} of {} POIs in the last generation\n", arm.name(), arm.pois());
        }
    }
    Ok(text)
}
