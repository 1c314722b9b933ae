//! Estimates from trials with their confidence intervals, and tests of differences.
//!
//! [`bounded`] gives the interval of a mean of scores, [`difference`] that of the difference of two arms, and [`paired`]
//! that of pairs. They are used wherever G is shown with an interval. Trials of two arms with the same seed are pairs.
//! They share their starts and, if sizes agree, their first populations. [`Average`] gives mean, deviation and standard
//! error of any values.
//!
//! [`rank_sum`] tests two samples, and [`signed_rank`] tests pairs. [`holm`] corrects for multiple tests. G takes few
//! values, so ranks have many ties, and both tests compute exact p-values for ties here.
//!
//! The special functions are those of `special`, which calls `libm` only: a table has the same digits on every system.
//! Other crates of statistics call the system's functions as soon as any dependency asks for that.

use serde::Serialize;
use special::{Beta, Error};

/// Confidence level of all intervals.
pub const CONFIDENCE: f64 = 0.95;
/// Maximum number of values, counting both samples, for exact p-values. Larger samples use the normal distribution.
pub(crate) const EXACT: usize = 100;

/// A number with its 95 % interval. Both ends are included.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Estimate {
    /// The number.
    pub value: f64,
    /// Lower end of the interval.
    pub low: f64,
    /// Upper end of the interval.
    pub high: f64,
}

impl Estimate {
    /// Returns an estimate without uncertainty.
    pub fn exact(value: f64) -> Estimate {
        Estimate { value, low: value, high: value }
    }

    /// Returns the estimate with its interval clamped to `min..=max`.
    pub fn within(self, min: f64, max: f64) -> Estimate {
        Estimate { low: self.low.max(min), high: self.high.min(max), ..self }
    }
}

/// Mean, standard deviation and standard error of values that are added one by one.
///
/// If all values are equal, the mean is exactly that value and the error is 0. Otherwise the mean does not depend on
/// the order if the sum is exact, as for halves and quarters.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Average {
    count: u32,
    sum: f64,
    /// The running mean and the sum of squared distances from it, by Welford's recurrence.
    mean: f64,
    squares: f64,
}

impl Average {
    /// Returns the average of so many values with this mean and standard deviation.
    pub(crate) fn of(count: u32, mean: f64, deviation: f64) -> Average {
        let degrees = f64::from(count.saturating_sub(1));
        Average { count, sum: mean * f64::from(count), mean, squares: deviation * deviation * degrees }
    }

    /// Adds a value.
    pub fn add(&mut self, value: f64) {
        self.count += 1;
        self.sum += value;
        let before = value - self.mean;
        self.mean += before / f64::from(self.count);
        self.squares += before * (value - self.mean);
    }

    /// Returns the number of values.
    pub fn count(&self) -> u32 {
        self.count
    }

    /// Returns the mean, or 0 without values.
    pub fn mean(&self) -> f64 {
        if self.squares == 0.0 { self.mean } else { self.sum / f64::from(self.count) }
    }

    /// Returns the sample standard deviation, or 0 for fewer than two values.
    pub fn deviation(&self) -> f64 {
        if self.count < 2 { 0.0 } else { (self.squares / f64::from(self.count - 1)).sqrt() }
    }

    /// Returns the standard error of the mean, or 0 for fewer than two values.
    pub fn error(&self) -> f64 {
        if self.count < 2 { 0.0 } else { self.deviation() / f64::from(self.count).sqrt() }
    }
}

impl<'a> FromIterator<&'a f64> for Average {
    fn from_iter<I: IntoIterator<Item = &'a f64>>(values: I) -> Average {
        let mut average = Average::default();
        values.into_iter().for_each(|&value| average.add(value));
        average
    }
}

/// Returns a share with the exact interval of Clopper and Pearson for a confidence level. None if `of` is 0.
pub fn share_at(confidence: f64, count: usize, of: usize) -> Option<Estimate> {
    let (some, others) = (count as f64, of.checked_sub(count)? as f64);
    let bound = |a: f64, b: f64, at: f64| at.inv_inc_beta(a, b, a.ln_beta(b));
    let tail = (1.0 - confidence) / 2.0;
    Some(Estimate {
        value: (of > 0).then_some(some / of as f64)?,
        low: if count == 0 { 0.0 } else { bound(some, others + 1.0, tail) },
        high: if count == of { 1.0 } else { bound(some + 1.0, others, 1.0 - tail) },
    })
}

/// Returns the smallest alpha, from 1e-12 to 1, at which a condition holds for the interval of confidence 1 - alpha.
///
/// This is the p-value of the test that the interval inverts. The condition must hold for narrower intervals, too. None
/// if it does not hold for the narrowest.
pub fn smallest_alpha(holds: impl Fn(f64) -> bool) -> Option<f64> {
    let alpha = |exponent: f64| libm::pow(10.0, exponent);
    let (mut fails, mut meets) = (-12.0, -1e-9);
    if !holds(1.0 - alpha(meets)) {
        return None;
    }
    if holds(1.0 - alpha(fails)) {
        return Some(alpha(fails));
    }
    for _ in 0..50 {
        let middle = (fails + meets) / 2.0;
        *if holds(1.0 - alpha(middle)) { &mut meets } else { &mut fails } = middle;
    }
    Some(alpha(meets))
}

/// Returns the distance of each value from the median of all values.
///
/// The mean of the distances measures spread. Testing the paired differences of two arms' distances is the
/// Brown-Forsythe test for pairs.
pub fn distances(values: &[f64]) -> Vec<f64> {
    let median = median(values).map_or(0.0, |median| median.value);
    values.iter().map(|value| (value - median).abs()).collect()
}

/// Returns the value that Student's distribution exceeds with probability `tail`, at most 0.5.
fn student(tail: f64, freedom: f64) -> f64 {
    // With one degree of freedom it is Cauchy's, and the general formula loses digits.
    if freedom == 1.0 {
        return 1.0 / libm::tan(std::f64::consts::PI * tail);
    }
    let half = freedom / 2.0;
    let share = (2.0 * tail).inv_inc_beta(half, 0.5, half.ln_beta(0.5));
    (freedom * (1.0 - share) / share).sqrt()
}

/// Returns the probability that a normal variable exceeds `z`.
fn normal_above(z: f64) -> f64 {
    (z * std::f64::consts::FRAC_1_SQRT_2).compl_error() / 2.0
}

/// Returns the mean of values in `min..=max` with an interval that is right for few trials with few different
/// outcomes. None for fewer than two values.
///
/// It is Student's interval of the sample with two more values, `min` and `max`, clamped to that range. So it has a
/// width even if all values are equal. For proportions these are the intervals of Agresti and Caffo, *Simple and
/// effective confidence intervals for proportions and differences of proportions result from adding two successes and
/// two failures*, The American Statistician 54 (2000), with Student's quantile for few trials.
///
/// Student's interval of the sample alone and bootstrap intervals have no width for equal values. If one trial in ten
/// fails, five trials are equal in most experiments, and such an interval misses the mean in each of these.
pub fn bounded(average: &Average, range: [f64; 2]) -> Option<Estimate> {
    bounded_by(bounded_factor(CONFIDENCE, average.count as usize), average, range)
}

/// Returns the half-width of the intervals of [`bounded`] and [`paired`] for so many values, in standard errors.
pub fn bounded_factor(confidence: f64, count: usize) -> f64 {
    student((1.0 - confidence) / 2.0, (count + 1) as f64)
}

/// Returns the same as [`bounded`], with a factor that is already known.
pub fn bounded_by(factor: f64, average: &Average, [min, max]: [f64; 2]) -> Option<Estimate> {
    let more = Extended::new(average, (min + max) / 2.0, (max - min) * (max - min) / 2.0)?;
    Some(more.around(average.mean(), more.mean, factor * more.variance.sqrt()).within(min, max))
}

/// Returns the mean difference of two samples of values in a range, with the interval of Agresti and Caffo. None for
/// fewer than two values in a sample.
///
/// Each sample gets two more values, as for [`bounded`]. The quantile is that of the normal distribution.
pub fn difference(one: &Average, other: &Average, [min, max]: [f64; 2]) -> Option<Estimate> {
    const NORMAL: f64 = 1.959_963_984_540_054;
    let width = max - min;
    let more = |average| Extended::new(average, (min + max) / 2.0, width * width / 2.0);
    let (first, second) = (more(one)?, more(other)?);
    let half = NORMAL * (first.variance + second.variance).sqrt();
    Some(first.around(one.mean() - other.mean(), first.mean - second.mean, half).within(-width, width))
}

/// Returns the mean difference of pairs of values in a range of this width, with an interval like that of [`bounded`].
/// None for fewer than two pairs.
///
/// The sample gets two more pairs. Half a pair has each combination of the smallest and the largest value, as in Agresti
/// and Min, *Simple improved confidence intervals for comparing matched proportions*, Statistics in Medicine 24 (2005).
pub fn paired(differences: &Average, width: f64) -> Option<Estimate> {
    paired_by(bounded_factor(CONFIDENCE, differences.count as usize), differences, width)
}

/// Returns the same as [`paired`], with a factor that is already known.
pub fn paired_by(factor: f64, differences: &Average, width: f64) -> Option<Estimate> {
    let more = Extended::new(differences, 0.0, width * width)?;
    let half = factor * more.variance.sqrt();
    Some(more.around(differences.mean(), more.mean, half).within(-width, width))
}

/// A sample with two more values.
struct Extended {
    mean: f64,
    /// The variance of the mean.
    variance: f64,
}

impl Extended {
    /// Adds two values with this mean. `squares` is the sum of their squared distances from it.
    fn new(average: &Average, mean: f64, squares: f64) -> Option<Extended> {
        let before = f64::from(average.count);
        let count = before + 2.0;
        let off = mean - average.mean();
        let all = average.squares + squares + off * off * 2.0 * before / count;
        let variance = all / (count - 1.0) / count;
        (average.count > 1).then_some(Extended { mean: average.mean() + off * 2.0 / count, variance })
    }

    fn around(&self, value: f64, middle: f64, half: f64) -> Estimate {
        Estimate { value, low: middle - half, high: middle + half }
    }
}

/// Returns the median with its interval. None without values.
///
/// The interval needs no assumption about the distribution: its ends are two of the values, chosen by the binomial
/// distribution (Conover, *Practical Nonparametric Statistics*, section 3.2). Values may be infinite. For fewer than six
/// values no such interval covers 95 %, and its ends are infinite.
pub fn median(values: &[f64]) -> Option<Estimate> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let (low, high) = (sorted.get(values.len().checked_sub(1)? / 2)?, sorted.get(values.len() / 2)?);
    let count = values.len() as f64;
    // The probability that at most so many of the values are below the median.
    let tail = |below: &f64| 0.5.inc_beta(count - below, below + 1.0, (count - below).ln_beta(below + 1.0));
    let below = (0..values.len()).map(|below| below as f64);
    let outside = below.take_while(|below| tail(below) <= (1.0 - CONFIDENCE) / 2.0).count();
    let ends = outside
        .checked_sub(1)
        .map_or([f64::NEG_INFINITY, f64::INFINITY], |place| [sorted[place], sorted[values.len() - 1 - place]]);
    Some(Estimate { value: (low + high) / 2.0, low: ends[0], high: ends[1] })
}

/// The result of a test of two samples or of pairs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Tested {
    /// Vargha and Delaney's A: the share of pairings in which the first sample has the larger value, plus half of the
    /// ties. 0.5 means that neither is ahead.
    pub a: f64,
    /// The two-sided p-value.
    pub p: f64,
}

/// Returns the Mann-Whitney test over all pairings of two samples. None if one is empty.
///
/// The p-value is exact up to [`EXACT`] values: twice the smaller tail over all assignments of the values, with their
/// ties. For more values it uses the normal distribution, corrected for ties and continuity.
pub fn rank_sum(one: &[f64], other: &[f64]) -> Option<Tested> {
    if one.is_empty() || other.is_empty() || !one.iter().chain(other).all(|value| value.is_finite()) {
        return None;
    }
    let ranks = twice_ranks(&[one, other].concat());
    let (count, all) = (one.len(), ranks.len());
    let sum: usize = ranks[..count].iter().sum();
    let pairings = (count * other.len()) as f64;
    let a = (sum - count * (count + 1)) as f64 / 2.0 / pairings;
    let p = if all <= EXACT {
        // The smaller sample has fewer sums to enumerate.
        let (size, sum) = if 2 * count <= all { (count, sum) } else { (other.len(), ranks[count..].iter().sum()) };
        two_sided(&sums_of(&ranks, size), sum)
    } else {
        let middle = (all + 1) as f64;
        let squares: f64 = ranks.iter().map(|&rank| power_of(rank as f64 - middle, 2)).sum();
        normal(sum as f64 - count as f64 * middle, pairings * squares / (all * (all - 1)) as f64)
    };
    Some(Tested { a, p })
}

/// Returns a power by multiplication. The precision of `powi` is not specified, so it could differ between systems.
pub fn power_of(base: f64, exponent: usize) -> f64 {
    (0..exponent).fold(1.0, |power, _| power * base)
}

/// Returns Wilcoxon's signed-rank test of the differences of pairs. None without differences.
///
/// Pairs with a difference of 0 do not affect p. For up to [`EXACT`] others p is exact, over all their signs. For more
/// it uses the normal distribution, as in [`rank_sum`]. A is over the pairs themselves, including those with a
/// difference of 0.
pub fn signed_rank(differences: &[f64]) -> Option<Tested> {
    if !differences.iter().all(|difference| difference.is_finite()) {
        return None;
    }
    let differences: Vec<f64> = differences.iter().map(|&difference| grained(difference)).collect();
    let (up, down) = (|value: &&f64| **value > 0.0, |value: &&f64| **value < 0.0);
    let [up_count, down_count] =
        [differences.iter().filter(up).count(), differences.iter().filter(down).count()].map(|count| count as f64);
    let some: Vec<f64> = differences.iter().copied().filter(|&difference| difference != 0.0).collect();
    let ranks = twice_ranks(&some.iter().map(|difference| difference.abs()).collect::<Vec<_>>());
    let sum: usize = ranks.iter().zip(&some).filter(|(_, difference)| **difference > 0.0).map(|(rank, _)| rank).sum();
    let p = if some.len() <= EXACT {
        two_sided(&sums_of_any(&ranks), sum)
    } else {
        let [all, squares] = [1, 2].map(|power| ranks.iter().map(|&rank| power_of(rank as f64, power)).sum::<f64>());
        normal(sum as f64 - all / 2.0, squares / 4.0)
    };
    let count = (!differences.is_empty()).then_some(differences.len() as f64)?;
    Some(Tested { a: (1.0 + (up_count - down_count) / count) / 2.0, p })
}

/// Returns p-values with Holm's correction for multiple tests, in the given order, each at most 1.
pub fn holm(p: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..p.len()).collect();
    order.sort_by(|&a, &b| p[a].total_cmp(&p[b]));
    let (mut corrected, mut most) = (vec![0.0; p.len()], 0.0f64);
    for (at, place) in order.into_iter().enumerate() {
        most = most.max(p[place] * (p.len() - at) as f64).min(1.0);
        corrected[place] = most;
    }
    corrected
}

/// Rounds a value to 12 decimal places, so that rounding errors do not break ties.
fn grained(value: f64) -> f64 {
    (value * 1e12).round() / 1e12
}

/// Returns twice the rank of every value, from 1. Ties share their mean rank; doubling makes it a whole number.
fn twice_ranks(values: &[f64]) -> Vec<usize> {
    let values: Vec<f64> = values.iter().map(|&value| grained(value)).collect();
    let mut sorted = values.clone();
    sorted.sort_by(f64::total_cmp);
    let up_to = |value: f64| sorted.partition_point(|&other| other <= value);
    values.iter().map(|&value| sorted.partition_point(|&other| other < value) + up_to(value) + 1).collect()
}

/// Returns the number of ways to choose `size` ranks for each sum.
fn sums_of(ranks: &[usize], size: usize) -> Vec<f64> {
    let most = ranks.iter().sum::<usize>();
    let mut ways = vec![vec![0.0; most + 1]; size + 1];
    ways[0][0] = 1.0;
    for (seen, &rank) in ranks.iter().enumerate() {
        for chosen in (1..=size.min(seen + 1)).rev() {
            let (fewer, with) = ways.split_at_mut(chosen);
            with[0][rank..].iter_mut().zip(&fewer[chosen - 1]).for_each(|(with, without)| *with += without);
        }
    }
    ways.swap_remove(size)
}

/// Returns the probability of each sum if every rank is chosen with probability 1/2.
fn sums_of_any(ranks: &[usize]) -> Vec<f64> {
    let mut ways = vec![0.0; ranks.iter().sum::<usize>() + 1];
    ways[0] = 1.0;
    for &rank in ranks {
        for sum in (0..ways.len()).rev() {
            ways[sum] = 0.5 * (ways[sum] + if sum < rank { 0.0 } else { ways[sum - rank] });
        }
    }
    ways
}

/// Returns the two-sided p-value of a sum: twice the smaller tail of the distribution, at most 1.
fn two_sided(ways: &[f64], sum: usize) -> f64 {
    let [low, high, all] = [&ways[..=sum], &ways[sum..], ways].map(|ways| ways.iter().sum::<f64>());
    (2.0 * low.min(high) / all).min(1.0)
}

/// Returns the two-sided p-value of a sum of doubled ranks by the normal distribution. `off` is its distance from the
/// mean.
fn normal(off: f64, variance: f64) -> f64 {
    // Continuity correction: half a rank is 1 after doubling.
    let z = (off.abs() - 1.0) / variance.sqrt();
    if variance > 0.0 { (2.0 * normal_above(z)).min(1.0) } else { 1.0 }
}
