//! Compares experiments: those that were trained, or runs that were opened.

use std::path::PathBuf;

use flotilla::config::Config;
use flotilla::statistics::Average;
use flotilla::trainer::Row;
use flotilla_app::report::comparison::{self, At, Cohort, Question, Trial};
use flotilla_app::report::curves::{Band, Curve};
use serde::Deserialize;
use serde_json::{Value, json};

use crate::answer::{Refusal, refuse};

/// G whose first generation is compared, as in `flotilla compare`.
const REACH: f64 = 0.75;

/// An experiment of a comparison.
#[derive(Deserialize)]
pub struct Experiment {
    name: String,
    text: String,
    /// The number of generations that each trial has played, including generation 0.
    lengths: Vec<usize>,
}

/// Returns the curves of the champions with their 95 % intervals, and the tables of `flotilla compare`.
///
/// `bytes` are G of the best team, of the champion and of the tested best team as f64,
/// `[experiments][trials][generations][3]`. The last is NaN without test episodes. If they cannot be compared, `refused` says
/// why, and there are no tables.
pub fn compare(experiments: Vec<Experiment>, bytes: &[u8]) -> Result<Value, Refusal> {
    let numbers: Vec<f64> = bytemuck::pod_collect_to_vec(&bytes[..bytes.len() / 8 * 8]);
    let mut pairs = numbers.as_chunks::<3>().0;
    let (mut cohorts, mut curves) = (Vec::new(), Vec::new());
    for Experiment { name, text, lengths } in experiments {
        let config = Config::parse(&text, "the config")?;
        // A training that was stopped may have played some trials further than others.
        let shared = lengths.iter().copied().min().unwrap_or(0);
        let (mut trials, mut champions) = (Vec::new(), vec![Average::default(); shared]);
        for (trial, length) in lengths.into_iter().enumerate() {
            let (scores, rest) = pairs.split_at_checked(length).ok_or_else(|| refuse("the rows are incomplete"))?;
            pairs = rest;
            champions.iter_mut().zip(scores).for_each(|(champion, [_, g, _])| champion.add(*g));
            let key = (config.learning.seed, trial);
            let row = |(generation, &[best_g, champion_g, test_g]): (usize, &[f64; 3])| Row {
                experiment: 0,
                trial,
                generation,
                best_g,
                mean_g: best_g,
                champion_g,
                test_g: Some(test_g).filter(|g| !g.is_nan()),
            };
            trials.push(Trial { key, rows: scores.iter().enumerate().map(row).collect(), from: config.last_from() });
        }
        let (curve, _) = Curve::new(&champions, 1.0).thinned();
        let band = curve.outline(Band::Interval, 1.0);
        curves.push(json!({ "generation": curve.generation, "mean": curve.mean, "band": band }));
        let folders = vec![PathBuf::from(&name)];
        cohorts.push(Cohort { name, folders, planned: config.learning.generations, trials });
    }
    let question = Question { at: vec![At::Last], reach: REACH, paired: false };
    Ok(match comparison::compare("", &cohorts, &question) {
        Ok(found) => {
            let pairs = if cohorts.len() > 1 { found.pairs() } else { vec![] };
            let legend = comparison::legend(std::slice::from_ref(&found), &question);
            json!({ "curves": curves, "means": found.means(), "pairs": pairs, "legend": legend, "notes": found.notes })
        }
        Err(error) => json!({ "curves": curves, "refused": error.to_string() }),
    })
}
