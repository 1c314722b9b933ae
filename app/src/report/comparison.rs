//! Compares arms: the mean of every measure over trials with its 95 % interval, and a test of every pair of arms.

use std::fmt::Write;
use std::path::PathBuf;

use serde::Serialize;

use super::runs::{self, ReadError};
use super::table;
use crate::record::digests::Verification;
use flotilla::config::Config;
use flotilla::escape::{self, PathExt};
use flotilla::statistics::{self, Estimate, Tested, power_of};
use flotilla::trainer::Row;

/// The trials of one arm of a comparison.
#[derive(Clone, Debug, PartialEq)]
pub struct Cohort {
    /// The arm's name, such as "fitness Df".
    pub name: String,
    /// The directories of the runs that the trials belong to.
    pub folders: Vec<PathBuf>,
    /// The largest number of generations that one of the runs was configured to train.
    pub planned: usize,
    /// The trials of all runs, run by run.
    pub trials: Vec<Trial>,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Trial {
    /// The run's seed and the trial's number. Trials of two arms with the same key form a pair.
    pub key: (u64, usize),
    /// The trial's rows, `[generations]`.
    pub rows: Vec<Row>,
    /// The first generation of the run's last stage; 0 without stages.
    pub from: usize,
}

impl Cohort {
    /// Reads the trials of some runs, which may be unfinished.
    pub fn read(name: String, folders: Vec<PathBuf>, verification: Verification) -> Result<Cohort, ReadError> {
        let mut arm = Cohort { name, folders: vec![], planned: 0, trials: vec![] };
        folders.into_iter().try_for_each(|folder| arm.add(folder, verification).map(drop))?;
        Ok(arm)
    }

    /// Adds the trials of a run, which may be unfinished. Returns its config.
    pub(crate) fn add(&mut self, folder: PathBuf, verification: Verification) -> Result<Config, ReadError> {
        let config = runs::config(&folder, verification)?;
        let trials = runs::trials(&folder, &config, verification)?.into_iter().enumerate();
        let from = config.last_from();
        self.trials.extend(trials.map(|(trial, rows)| Trial { key: (config.learning.seed, trial), rows, from }));
        self.planned = self.planned.max(config.learning.generations);
        self.folders.push(folder);
        Ok(config)
    }

    /// Returns the arm's name and its directories, for messages.
    fn described(&self) -> String {
        const MAX_NAMED_FOLDERS: usize = 3;
        let folders: Vec<String> = self.folders.iter().map(|folder| folder.escaped()).collect();
        match folders.len().checked_sub(MAX_NAMED_FOLDERS) {
            _ if folders == [&*self.name] || self.name.ends_with(&format!("({})", folders.concat())) => {
                self.name.clone()
            }
            None | Some(0) => format!("{} ({})", self.name, folders.join(", ")),
            Some(more) => format!("{} ({} and {more} more)", self.name, folders[..MAX_NAMED_FOLDERS].join(", ")),
        }
    }

    /// Returns the last generation that all its trials have reached, if any.
    fn last(&self) -> Option<usize> {
        self.trials.iter().map(|trial| trial.rows.len()).min()?.checked_sub(1)
    }

    fn keys(&self) -> Vec<(u64, usize)> {
        self.trials.iter().map(|trial| trial.key).collect()
    }
}

/// Reports whether all arms have the same seeds and trials, so that their trials form pairs.
pub fn paired(arms: &[Cohort]) -> bool {
    arms.iter().all(|arm| arm.keys() == arms[0].keys())
}

/// A generation to compare at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum At {
    /// A given generation, from 0.
    Generation(usize),
    /// The last generation that all trials of all arms have reached.
    Last,
}

/// The smallest and the largest G.
const G: [f64; 2] = [0.0, 1.0];

/// Options of a comparison.
#[derive(Clone, Debug, PartialEq)]
pub struct Question {
    /// Generations at which G is compared.
    pub at: Vec<At>,
    /// G of the champion, in 0..1. The first generation that reaches it is compared.
    pub reach: f64,
    /// Whether trials are compared pair by pair.
    pub paired: bool,
}

/// Why arms cannot be compared.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ComparisonError {
    /// An arm, by its name, has a single trial.
    #[error("{0} has one trial; an interval needs two or more")]
    OneTrial(String),
    /// The trials of an arm, by its name, have no generation in common.
    #[error("{0} has no generation that every trial has reached")]
    TooShort(String),
    /// Some arms have not reached a requested generation.
    #[error("the arms have only reached generation {last}; choose one up to that")]
    Beyond {
        /// The requested generation.
        at: usize,
        /// The last generation that all arms have reached.
        last: usize,
    },
    /// Two arms, by their names, cannot be compared pair by pair.
    #[error("{0} and {1} have different seeds or numbers of trials, so their trials are no pairs")]
    NoPairs(String, String),
}

/// A quantity that is measured in every trial.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(tag = "measure", rename_all = "snake_case")]
pub enum Measure {
    /// G of the best team at a generation.
    BestG {
        /// The generation, from 0.
        generation: usize,
    },
    /// G of the champion at a generation.
    ChampionG {
        /// The generation, from 0.
        generation: usize,
    },
    /// Mean G of the best team at a generation over the episodes that test it.
    TestG {
        /// The generation, from 0.
        generation: usize,
    },
    /// The first generation at which the champion's G is at least `reach`. With stages, only the last stage counts.
    ///
    /// It is infinite for a trial that does not reach it by `generation`. Arms are described by their medians.
    GenerationsToReach {
        /// G to reach, in 0..1.
        reach: f64,
        /// The last generation to look at.
        generation: usize,
    },
    /// Mean G of the last champion over episodes in which each POI moves by up to `poi_jitter` on both axes.
    ///
    /// With a jitter of 0, POIs stay in place and one episode suffices.
    Played {
        /// The largest shift per axis, in world units.
        poi_jitter: f64,
        episodes: u32,
    },
}

impl Measure {
    /// Returns the measured value of a trial, or none if the trial's scores do not determine it.
    fn of(self, trial: &Trial) -> Option<f64> {
        match self {
            Measure::BestG { generation } => Some(trial.rows[generation].best_g),
            Measure::ChampionG { generation } => Some(trial.rows[generation].champion_g),
            Measure::TestG { generation } => trial.rows[generation].test_g,
            Measure::GenerationsToReach { reach, generation } => {
                let reached = (trial.from..=generation).find(|&at| trial.rows[at].champion_g >= reach);
                Some(reached.map_or(f64::INFINITY, |at| at as f64))
            }
            Measure::Played { .. } => None,
        }
    }

    /// Counts the trials that reached G, if this measures when they do.
    fn reached(self, values: &[f64]) -> Option<usize> {
        match self {
            Measure::GenerationsToReach { .. } => Some(values.iter().filter(|value| value.is_finite()).count()),
            _ => None,
        }
    }

    /// Returns a mean, a median or a difference as text, with its interval.
    pub fn text(self, value: Estimate, signed: bool) -> String {
        match self {
            Measure::GenerationsToReach { .. } => generations(value, signed),
            _ => estimate(value, 3, signed),
        }
    }

    /// Returns the name of the measure in CSV.
    fn key(self) -> &'static str {
        match self {
            Measure::BestG { .. } => "best_g",
            Measure::ChampionG { .. } => "champion_g",
            Measure::TestG { .. } => "test_g",
            Measure::GenerationsToReach { .. } => "generations_to_reach",
            Measure::Played { poi_jitter: 0.0, .. } => "fixed_pois_g",
            Measure::Played { .. } => "moved_pois_g",
        }
    }
}

impl std::fmt::Display for Measure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Measure::BestG { generation } => write!(f, "best team's G, generation {generation}"),
            Measure::ChampionG { generation } => write!(f, "champion's G, generation {generation}"),
            Measure::TestG { generation } => write!(f, "tested best team's G, generation {generation}"),
            Measure::GenerationsToReach { reach, .. } => write!(f, "generations to G {reach}"),
            Measure::Played { poi_jitter: 0.0, .. } => f.write_str("champion's G, POIs where they stand"),
            Measure::Played { poi_jitter, .. } => write!(f, "champion's G, POIs moved by up to {poi_jitter}"),
        }
    }
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// Settings that all arms of a sweep share, such as "coupling 3". Empty when runs are compared.
    #[serde(rename = "where")]
    pub place: String,
    /// The last generation that all arms have reached.
    pub generation: usize,
    /// The arms, in the order given.
    pub arms: Vec<Named>,
    /// One result per measure.
    pub measures: Vec<Measured>,
    /// Remarks for the reader, such as arms that are unfinished.
    pub notes: Vec<String>,
}

/// An arm as output names it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Named {
    /// The arm's name, such as "fitness Df".
    pub name: String,
    /// The directories of the arm's runs, escaped for output.
    pub folders: Vec<String>,
    pub trials: usize,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Measured {
    #[serde(flatten)]
    pub measure: Measure,
    /// Means of the arms, or their medians of generations, `[arms]`.
    pub arms: Vec<Mean>,
    /// Differences between arms, one per pair of arms.
    pub pairs: Vec<Versus>,
}

/// The mean over an arm's trials, or the median of generations.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Mean {
    /// The mean with its 95 % interval. A median or an end that is not reached is infinite, which is null in JSON.
    #[serde(flatten)]
    pub mean: Estimate,
    /// Number of trials that reached G, if that was measured.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reached: Option<usize>,
}

/// The difference between two arms.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Versus {
    /// Indices of the two arms.
    pub arms: [usize; 2],
    /// The first arm's mean minus the second's. Differences of medians have no interval: its ends are NaN, and so is the
    /// difference if a median is infinite. NaN is null in JSON.
    #[serde(flatten)]
    pub difference: Estimate,
    #[serde(flatten)]
    pub test: Tested,
    /// The p value with Holm's correction for the number of pairs.
    pub p_holm: f64,
}

/// Compares every pair of two or more arms. `place` states what the arms have in common.
///
/// # Errors
/// An arm has too few trials or generations, or pairs were requested and the trials do not form pairs.
pub fn compare(place: &str, arms: &[Cohort], options: &Question) -> Result<Comparison, ComparisonError> {
    let mut last = usize::MAX;
    for arm in arms {
        if arm.trials.len() < 2 {
            return Err(ComparisonError::OneTrial(arm.described()));
        }
        last = last.min(arm.last().ok_or_else(|| ComparisonError::TooShort(arm.described()))?);
    }
    if let Some(other) = arms.iter().find(|arm| options.paired && arm.keys() != arms[0].keys()) {
        return Err(ComparisonError::NoPairs(arms[0].described(), other.described()));
    }
    let mut generations = Vec::new();
    for &at in &options.at {
        let at = if let At::Generation(at) = at { at } else { last };
        if at > last {
            return Err(ComparisonError::Beyond { at, last });
        }
        if !generations.contains(&at) {
            generations.push(at);
        }
    }
    let champion = generations.iter().map(|&generation| Measure::ChampionG { generation });
    let best = generations.iter().map(|&generation| Measure::BestG { generation });
    // All arms need test episodes.
    let tested = arms.iter().flat_map(|arm| &arm.trials).all(|trial| trial.rows[last].test_g.is_some());
    let test = generations.iter().filter(|_| tested).map(|&generation| Measure::TestG { generation });
    // No trial can reach a G in a stage that has not begun.
    let begun = arms.iter().flat_map(|arm| &arm.trials).all(|trial| trial.from <= last);
    let reach = begun.then_some(Measure::GenerationsToReach { reach: options.reach, generation: last });
    let measures = champion.chain(test).chain(best).chain(reach).map(|measure| {
        let values = |arm: &Cohort| arm.trials.iter().filter_map(|trial| measure.of(trial)).collect();
        measured(measure, &arms.iter().map(values).collect::<Vec<_>>(), options.paired)
    });
    let measures = measures.collect();

    let mut notes: Vec<String> = arms
        .iter()
        .filter_map(|arm| Some((arm, arm.last().filter(|&come| come < arm.planned)?)))
        .map(|(arm, come)| format!("{} has reached generation {come} of {}", arm.name, arm.planned))
        .collect();
    if arms.iter().any(|arm| arm.planned > last) {
        notes.push(format!("arms are compared up to generation {last}, which all have reached"));
    }
    if let Some(arm) = arms.iter().find(|arm| arm.trials.iter().any(|trial| trial.from > last)) {
        let text = "generations to a G are not compared, because the last stage has not begun in";
        notes.push(format!("{text} {}", arm.name));
    }
    let named = |arm: &Cohort| Named {
        name: arm.name.clone(),
        folders: arm.folders.iter().map(|folder| folder.escaped()).collect(),
        trials: arm.trials.len(),
    };
    Ok(Comparison { place: place.into(), generation: last, arms: arms.iter().map(named).collect(), measures, notes })
}

/// Compares two or more arms by given values per measure, `[arms][trials]` each.
pub fn of_values(
    place: &str,
    generation: usize,
    arms: Vec<Named>,
    values: Vec<(Measure, Vec<Vec<f64>>)>,
) -> Result<Comparison, ComparisonError> {
    if let Some(arm) = arms.iter().find(|arm| arm.trials < 2) {
        return Err(ComparisonError::OneTrial(arm.name.clone()));
    }
    let measures = values.iter().map(|(measure, values)| measured(*measure, values, false)).collect();
    Ok(Comparison { place: place.into(), generation, arms, measures, notes: vec![] })
}

/// Evaluates one measure of values `[arms][trials]` with at least two trials per arm.
fn measured(measure: Measure, values: &[Vec<f64>], paired: bool) -> Measured {
    const TWO: &str = "arms of two trials or more";
    let means = values.iter().map(|values| {
        let mean = match measure {
            Measure::GenerationsToReach { .. } => statistics::median(values),
            _ => statistics::bounded(&values.iter().collect(), G),
        };
        Mean { mean: mean.expect(TWO), reached: measure.reached(values) }
    });
    let means: Vec<Mean> = means.collect();
    // Trials that never reach G are ties for the tests, after all others.
    let ranked = |values: &Vec<f64>| -> Vec<f64> {
        match measure {
            Measure::GenerationsToReach { generation, .. } => {
                values.iter().map(|value| value.min(generation as f64 + 1.0)).collect()
            }
            _ => values.clone(),
        }
    };
    let values: Vec<Vec<f64>> = values.iter().map(ranked).collect();
    let mut pairs = Vec::new();
    for (first, one) in values.iter().enumerate() {
        for (second, other) in values.iter().enumerate().skip(first + 1) {
            let less: Vec<f64> = one.iter().zip(other).map(|(one, other)| one - other).collect();
            let difference = match measure {
                Measure::GenerationsToReach { .. } => {
                    let [one, other] = [first, second].map(|arm| means[arm].mean.value);
                    let value = if one.is_finite() && other.is_finite() { one - other } else { f64::NAN };
                    Some(Estimate { value, low: f64::NAN, high: f64::NAN })
                }
                _ if paired => statistics::paired(&less.iter().collect(), G[1] - G[0]),
                _ => statistics::difference(&one.iter().collect(), &other.iter().collect(), G),
            };
            let test = if paired { statistics::signed_rank(&less) } else { statistics::rank_sum(one, other) };
            let (difference, test) = (difference.expect(TWO), test.expect(TWO));
            pairs.push(Versus { arms: [first, second], difference, test, p_holm: 0.0 });
        }
    }
    let corrected = statistics::holm(&pairs.iter().map(|pair| pair.test.p).collect::<Vec<_>>());
    pairs.iter_mut().zip(corrected).for_each(|(pair, p)| pair.p_holm = p);
    Measured { measure, arms: means, pairs }
}

impl Comparison {
    /// Returns a table with one row per arm and one column per measure.
    pub fn means(&self) -> Vec<Vec<String>> {
        let mut head = vec!["arm".to_string(), "trials".into()];
        head.extend(self.measures.iter().map(|measured| measured.measure.to_string()));
        let rows = self.arms.iter().enumerate().map(|(at, arm)| {
            let cell = |Measured { measure, arms, .. }: &Measured| {
                let reached = arms[at].reached.map_or(String::new(), |count| format!(" ({count} of {})", arm.trials));
                measure.text(arms[at].mean, false) + &reached
            };
            [arm.name.clone(), arm.trials.to_string()].into_iter().chain(self.measures.iter().map(cell)).collect()
        });
        [head].into_iter().chain(rows).collect()
    }

    /// Returns a table with one row per measure and pair.
    pub fn pairs(&self) -> Vec<Vec<String>> {
        let head = ["measure", "pair", "difference", "A", "p", "p (Holm)"].map(String::from).to_vec();
        let row = |measure: Measure, pair: &Versus| {
            let names = pair.arms.map(|arm| &*self.arms[arm].name);
            let difference = measure.text(pair.difference, true);
            let (a, p) = (format!("{:.2}", pair.test.a), [pair.test.p, pair.p_holm].map(probability));
            [vec![measure.to_string(), names.join(" − "), difference, a], p.to_vec()].concat()
        };
        let rows = self
            .measures
            .iter()
            .flat_map(|Measured { measure, pairs, .. }| pairs.iter().map(|pair| row(*measure, pair)));
        [head].into_iter().chain(rows).collect()
    }
}

/// Formats a median of generations as "3.5 [3, 12]", with the interval if there is one.
fn generations(Estimate { value, low, high }: Estimate, signed: bool) -> String {
    let word = |generation: f64| match generation {
        _ if generation.is_nan() => "–".to_string(),
        f64::INFINITY => "not reached".into(),
        _ if signed => format!("{generation:+}").replace('-', "−"),
        _ => generation.to_string(),
    };
    let interval = if low.is_finite() { format!(" [{}, {}]", word(low), word(high)) } else { String::new() };
    word(value) + &interval
}

/// Formats an estimate as "0.92 [0.86, 0.97]", with typographic minus signs.
pub fn estimate(Estimate { value, low, high }: Estimate, digits: usize, signed: bool) -> String {
    // Adding 0.0 turns -0.0 into 0.0, which prints no sign.
    let [value, low, high] = [value, low, high].map(|x| {
        let tens = power_of(10.0, digits);
        (x * tens).round() / tens + 0.0
    });
    let value = if signed { format!("{value:+.digits$}") } else { format!("{value:.digits$}") };
    format!("{value} [{low:.digits$}, {high:.digits$}]").replace('-', "−")
}

/// Formats a probability as "0.042" or "< 0.001".
pub fn probability(p: f64) -> String {
    if p < 0.001 { "< 0.001".into() } else { format!("{p:.3}") }
}

/// Explains how to read the tables.
pub fn legend(all: &[Comparison], options: &Question) -> String {
    let (test, a) = match options.paired {
        true => ("Wilcoxon's signed-rank test", "the first arm's trial of a pair"),
        false => ("the Mann-Whitney test", "a random trial of the first arm"),
    };
    let mut text = format!(
        "Values are means over trials, with 95 % intervals for few trials of bounded scores.\n\
         Generations are medians over trials. The interval of a median takes six trials.\n\
         Differences are the first arm minus the second.\n\
         A is the probability that {a} has the larger value; 0.5 means no difference.\n\
         p is two-sided, by {test}. Holm's correction is for the number of pairs. Decide by p, and use the interval for the size.\n"
    );
    let never = |measured: &Measured, all: &Comparison| {
        measured.arms.iter().zip(&all.arms).any(|(mean, arm)| mean.reached.is_some_and(|reached| reached < arm.trials))
    };
    if all.iter().any(|all| all.measures.iter().any(|measured| never(measured, all))) {
        let _ = writeln!(
            text,
            "A median is not reached if half of the trials or more never reach G {}. They are ties for the test, after the others.",
            options.reach
        );
    }
    text
}

/// Returns the comparisons as Markdown tables with a legend.
pub fn text(all: &[Comparison], options: &Question) -> String {
    let mut text = String::new();
    for comparison in all {
        if !comparison.place.is_empty() {
            let _ = writeln!(text, "{}\n", comparison.place);
        }
        let _ = writeln!(text, "{}\n{}", table::markdown(&comparison.means()), table::markdown(&comparison.pairs()));
    }
    text + &legend(all, options)
}

/// Returns two LaTeX tables per comparison, with the legend as comments.
pub fn latex(all: &[Comparison], options: &Question) -> String {
    let comment = |text: &str| text.lines().map(|line| format!("% {line}\n")).collect::<String>();
    let mut text = comment(&legend(all, options));
    for comparison in all {
        text += &comment(&comparison.place);
        let _ = writeln!(text, "{}\n{}", table::latex(&comparison.means()), table::latex(&comparison.pairs()));
    }
    text
}

/// Columns of the comparisons as CSV.
const COLUMNS: &str = "where,measure,generation,reach,arm,other,trials,other_trials,value,low,high,reached,a,p,p_holm";

/// Returns the comparisons as CSV: one row per measure and arm, then one per measure and pair.
pub fn csv(all: &[Comparison]) -> Vec<u8> {
    let mut table = csv::Writer::from_writer(format!("{COLUMNS}\n").into_bytes());
    let mut write = |row: &[String]| table.write_record(row).expect("memory takes all rows");
    for Comparison { place, generation: last, arms: named, measures, .. } in all {
        for Measured { measure, arms, pairs } in measures {
            let (generation, reach) = match *measure {
                Measure::BestG { generation } | Measure::ChampionG { generation } | Measure::TestG { generation } => {
                    (generation, String::new())
                }
                Measure::GenerationsToReach { reach, generation } => (generation, reach.to_string()),
                Measure::Played { .. } => (*last, String::new()),
            };
            let place =
                || [escape::csv_cell(place).into_owned(), measure.key().into(), generation.to_string(), reach.clone()];
            // Like JSON, CSV has no infinite numbers.
            let finite = |number: f64| if number.is_finite() { number.to_string() } else { String::new() };
            let numbers = |Estimate { value, low, high }| [value, low, high].map(finite);
            for (arm, Mean { mean, reached }) in named.iter().zip(arms) {
                let name = escape::csv_cell(&arm.name).into_owned();
                let whose = [name, String::new(), arm.trials.to_string(), String::new()];
                let reached = reached.map_or(String::new(), |count| count.to_string());
                let rest = [reached, String::new(), String::new(), String::new()];
                write(&[&place()[..], &whose, &numbers(*mean), &rest].concat());
            }
            for Versus { arms, difference, test, p_holm } in pairs {
                let [one, other] = arms.map(|arm| &named[arm]);
                let names = [one, other].map(|arm| escape::csv_cell(&arm.name).into_owned());
                let whose = [names, [one, other].map(|arm| arm.trials.to_string())].concat();
                let rest = [String::new(), test.a.to_string(), test.p.to_string(), p_holm.to_string()];
                write(&[&place()[..], &whose, &numbers(*difference), &rest].concat());
            }
        }
    }
    table.into_inner().expect("memory takes all rows")
}
