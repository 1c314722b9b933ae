//! The paper's claims with some keys changed in every experiment: how much hangs on what the paper leaves open.
//!
//! ```text
//! cargo run --release --example claims -- --trials 20 --seed 9001 sense.density=inverse
//! ```

use std::process::ExitCode;

use flotilla::backend::cpu::Cpu;
use flotilla::baseline::Baselines;
use flotilla::config::{Override, ValidConfig};
use flotilla::report::paper::{self, Evidence, claims, tables};
use flotilla::trainer::Row;
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

/// Trains every experiment of the paper with these keys; what each came to, and the verdicts on the claims.
fn measure(keys: &[Override]) -> Result<String, String> {
    let mut arms = paper::arms(keys).map_err(|error| error.to_string())?;
    let (configs, places) = paper::trained(&arms);
    let mut backend = Cpu::default();
    let mut trainer = Trainer::new(ValidConfig::all(&configs).unwrap());
    for row in trainer.finish(&mut backend).map_err(|error| error.to_string())? {
        for (arm, _) in places.iter().enumerate().filter(|&(_, &place)| place == row.experiment) {
            arms[arm].add(&Row { experiment: arm, ..row });
        }
    }
    let mut baselines = Baselines::new(paper::grounds(&arms));
    while !baselines.is_done() {
        baselines.advance(&mut backend).map_err(|error| error.to_string())?;
    }
    let results = Evidence { arms: &arms, baselines: &baselines.found() };
    let claims = claims::claims(results);
    let heading = tables::heading(&arms[0].config.learning, &claims);
    Ok(format!("{}\n{}\n{heading}\n", tables::without_learning(results), tables::verdicts(&claims)))
}
