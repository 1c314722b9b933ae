//! Estimates from trials, with what chance leaves open, and tests of differences.
//!
//! Trials of two arms with one seed are pairs: the same starts and, where sizes agree, the same first populations. Their
//! differences are one sample, of which [`mean`] gives the interval and [`p_value`] the test.

use serde::Serialize;
use statrs::distribution::{Beta, ContinuousCDF, StudentsT};

/// The share of intervals that hold what they estimate.
pub const CONFIDENCE: f64 = 0.95;

/// A number with its 95 % interval, both ends included.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Estimate {
    pub value: f64,
    pub low: f64,
    pub high: f64,
}

impl Estimate {
    /// What is known without trials.
    pub fn exact(value: f64) -> Estimate {
        Estimate { value, low: value, high: value }
    }

    /// The same of a number that cannot lie beyond these.
    pub fn within(self, least: f64, most: f64) -> Estimate {
        Estimate { low: self.low.max(least), high: self.high.min(most), ..self }
    }
}

/// The mean of a sample by Student's t; none of fewer than two values.
///
/// Values that are all alike say nothing of how far they may lie apart. Then as many are taken to be off by one `step`,
/// the least by which two can differ, as could have gone unseen: none of n by [`share`].
pub fn mean(values: &[f64], step: f64) -> Option<Estimate> {
    let (value, error) = moments(values)?;
    let room = match error {
        0.0 => step * share(0, values.len())?.high,
        error => error * reach(values.len()),
    };
    Some(Estimate { value, low: value - room, high: value + room })
}

/// How many standard errors the interval of a mean of so many values, two at least, reaches to either side.
pub fn reach(count: usize) -> f64 {
    student(count).inverse_cdf(1.0 - (1.0 - CONFIDENCE) / 2.0)
}

/// A share by Clopper and Pearson's exact interval; none of nothing.
pub fn share(count: usize, of: usize) -> Option<Estimate> {
    let (some, others) = (count as f64, of.checked_sub(count)? as f64);
    let bound = |a: f64, b: f64, at: f64| Some(Beta::new(a, b).ok()?.inverse_cdf(at));
    let tail = (1.0 - CONFIDENCE) / 2.0;
    Some(Estimate {
        value: (of > 0).then_some(some / of as f64)?,
        low: if count == 0 { 0.0 } else { bound(some, others + 1.0, tail)? },
        high: if count == of { 1.0 } else { bound(some + 1.0, others, 1.0 - tail)? },
    })
}

/// The two-sided p of Student's test that the mean of a sample of differences is 0; where all are alike, which leaves
/// nothing to measure them by, that of the sign test.
pub fn p_value(differences: &[f64]) -> Option<f64> {
    let (mean, error) = moments(differences)?;
    Some(match error {
        0.0 if mean == 0.0 => 1.0,
        0.0 => 0.5f64.powi(differences.len() as i32 - 1),
        _ => 2.0 * student(differences.len()).cdf(-(mean / error).abs()),
    })
}

/// How far each value lies from the median of all. Their mean is how far apart the values are; between two arms, the
/// test of their paired differences is that of Brown and Forsythe for pairs.
pub fn distances(values: &[f64]) -> Vec<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let (low, high) = (values.len().saturating_sub(1) / 2, values.len() / 2);
    let median = sorted.get(low).zip(sorted.get(high)).map_or(0.0, |(low, high)| (low + high) / 2.0);
    values.iter().map(|value| (value - median).abs()).collect()
}

/// Mean and standard error; none of fewer than two values.
fn moments(values: &[f64]) -> Option<(f64, f64)> {
    let (first, count) = (*values.first()?, values.len() as f64);
    // Of the distances from the first: values that are alike come to exactly no error.
    let off = values.iter().map(|value| value - first).sum::<f64>() / count;
    let squares: f64 = values.iter().map(|value| (value - first - off).powi(2)).sum();
    (values.len() > 1).then(|| (first + off, (squares / (count - 1.0) / count).sqrt()))
}

/// Student's distribution for the mean of so many values, two at least.
fn student(count: usize) -> StudentsT {
    StudentsT::new(0.0, 1.0, (count - 1) as f64).expect("two values leave a degree of freedom")
}
