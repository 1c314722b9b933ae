//! Arms side by side: what their trials came to, with 95 % intervals, and a test of every pair.

use std::fmt::Write;
use std::io;
use std::path::PathBuf;

use serde::Serialize;

use super::runs::{self, ReadError};
use super::table;
use crate::escape::{self, PathExt};
use crate::record::digests::Verification;
use crate::statistics::{self, Estimate, Tested};

/// Trials that are compared with those of others.
#[derive(Clone, Debug, PartialEq)]
pub struct Cohort {
    /// What sets it apart: "fitness Df".
    pub name: String,
    /// The runs whose trials these are.
    pub folders: Vec<PathBuf>,
    /// Generations that these were to have.
    pub planned: usize,
    /// All of them, run by run.
    pub trials: Vec<Trial>,
}

/// One trial of a run.
#[derive(Clone, Debug, PartialEq)]
pub struct Trial {
    /// The run's seed and the trial's number: trials of two arms that share both are a pair.
    pub key: (u64, usize),
    /// G of the best team and of the champion, by generation.
    pub course: Vec<[f64; 2]>,
    /// The first generation of its last stage; 0 where it has none.
    pub from: usize,
}

impl Cohort {
    /// Reads the trials of some runs, as far as they have come.
    ///
    /// # Errors
    /// A run cannot be read.
    pub fn read(name: String, folders: Vec<PathBuf>, verification: Verification) -> Result<Cohort, ReadError> {
        let mut arm = Cohort { name, folders, planned: 0, trials: vec![] };
        for folder in &arm.folders {
            let config = runs::config(folder, verification)?;
            let courses = runs::trials(folder, &config, verification)?.into_iter().enumerate();
            let from = config.last_from();
            arm.trials.extend(courses.map(|(trial, course)| Trial {
                key: (config.learning.seed, trial),
                course,
                from,
            }));
            arm.planned = arm.planned.max(config.learning.generations);
        }
        Ok(arm)
    }

    /// Its name, and where its runs are.
    fn told(&self) -> String {
        const MOST: usize = 3;
        let folders: Vec<String> = self.folders.iter().map(|folder| folder.escaped().to_string()).collect();
        match folders.len().checked_sub(MOST) {
            _ if folders == [&*self.name] || self.name.ends_with(&format!("({})", folders.concat())) => {
                self.name.clone()
            }
            None | Some(0) => format!("{} ({})", self.name, folders.join(", ")),
            Some(more) => format!("{} ({} and {more} more)", self.name, folders[..MOST].join(", ")),
        }
    }

    /// The last generation that all its trials have come to.
    fn last(&self) -> Option<usize> {
        self.trials.iter().map(|trial| trial.course.len()).min()?.checked_sub(1)
    }

    fn keys(&self) -> Vec<(u64, usize)> {
        self.trials.iter().map(|trial| trial.key).collect()
    }
}

/// Whether all arms have the same seeds and trials, so that these are pairs.
pub fn paired(arms: &[Cohort]) -> bool {
    arms.iter().all(|arm| arm.keys() == arms[0].keys())
}

/// A generation to compare at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum At {
    /// This one, from 0.
    Generation(usize),
    /// The last one that all trials of all arms have come to.
    Last,
}

/// What is compared, and how.
#[derive(Clone, Debug, PartialEq)]
pub struct Question {
    /// At which generations G is compared.
    pub at: Vec<At>,
    /// The best team's G (in 0..1) whose first generation is compared.
    pub reach: f64,
    /// Compare pair by pair.
    pub paired: bool,
}

/// Why arms cannot be compared.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ComparisonError {
    /// An arm, by its name, of a single trial.
    #[error("{0} has one trial, of which no interval can be had; that takes two or more")]
    OneTrial(String),
    /// An arm, by its name, whose trials have no generation in common.
    #[error("{0} has no generation that every trial has come to")]
    TooShort(String),
    /// A generation that the arms have not come to.
    #[error("the arms have come to generation {last}")]
    Beyond {
        /// The one asked for.
        at: usize,
        /// The last that all have.
        last: usize,
    },
    /// Two arms, by their names, that cannot be compared pair by pair.
    #[error("{0} and {1} have not the same seeds and numbers of trials, so their trials are no pairs")]
    NoPairs(String, String),
}

/// What is measured in every trial.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(tag = "measure", rename_all = "snake_case")]
pub enum Measure {
    /// G of the best team at a generation.
    BestG {
        /// From 0.
        generation: usize,
    },
    /// G of the champion.
    ChampionG {
        /// From 0.
        generation: usize,
    },
    /// The first generation, of the last stage where there are stages, at which the best team's G is at least this. A
    /// trial that does not come to it up to a last generation counts as one that does at the next.
    GenerationsToReach {
        /// In 0..1.
        reach: f64,
        /// The last that is looked at.
        generation: usize,
    },
    /// G of the last champion over so many episodes in which each POI is moved by up to `poi_jitter` on both axes; of one
    /// episode where POIs stand.
    Played {
        /// In world units.
        poi_jitter: f64,
        /// How many.
        episodes: u32,
    },
}

impl Measure {
    /// None where the course of a trial does not tell.
    fn of(self, trial: &Trial) -> Option<f64> {
        match self {
            Measure::BestG { generation } => Some(trial.course[generation][0]),
            Measure::ChampionG { generation } => Some(trial.course[generation][1]),
            Measure::GenerationsToReach { reach, generation } => {
                let reached = (trial.from..=generation).find(|&at| trial.course[at][0] >= reach);
                Some(reached.unwrap_or(generation + 1) as f64)
            }
            Measure::Played { .. } => None,
        }
    }

    /// In how many trials it was reached, if that is the question.
    fn reached(self, values: &[f64]) -> Option<usize> {
        match self {
            Measure::GenerationsToReach { generation, .. } => {
                Some(values.iter().filter(|&&value| value <= generation as f64).count())
            }
            _ => None,
        }
    }

    /// Digits that are told of it.
    pub fn digits(self) -> usize {
        if let Measure::GenerationsToReach { .. } = self { 1 } else { 3 }
    }

    /// As in JSON and CSV.
    fn key(self) -> &'static str {
        match self {
            Measure::BestG { .. } => "best_g",
            Measure::ChampionG { .. } => "champion_g",
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
            Measure::GenerationsToReach { reach, .. } => write!(f, "generations to G {reach}"),
            Measure::Played { poi_jitter: 0.0, .. } => f.write_str("champion's G, POIs where they stand"),
            Measure::Played { poi_jitter, .. } => write!(f, "champion's G, POIs moved by up to {poi_jitter}"),
        }
    }
}

/// Arms side by side.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// What the arms of a sweep have in common: "coupling 3". Empty of runs.
    #[serde(rename = "where")]
    pub place: String,
    /// The last generation that all have come to.
    pub generation: usize,
    /// In the order given.
    pub arms: Vec<Named>,
    /// What was measured of them.
    pub measures: Vec<Measured>,
    /// What a reader has to know.
    pub notes: Vec<String>,
}

/// An arm as it is told of.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Named {
    /// What sets it apart.
    pub name: String,
    /// The runs whose trials these are.
    pub folders: Vec<String>,
    /// How many.
    pub trials: usize,
}

/// What one measure came to.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Measured {
    /// Which one.
    #[serde(flatten)]
    pub measure: Measure,
    /// By arm.
    pub arms: Vec<Mean>,
    /// Every two arms once.
    pub pairs: Vec<Versus>,
}

/// The mean over an arm's trials.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Mean {
    /// With its 95 % interval.
    #[serde(flatten)]
    pub mean: Estimate,
    /// In how many trials a G was reached.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reached: Option<usize>,
}

/// What sets two arms apart.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Versus {
    /// Their places among the arms.
    pub arms: [usize; 2],
    /// The first's mean less the second's.
    #[serde(flatten)]
    pub difference: Estimate,
    /// Whether that is more than chance.
    #[serde(flatten)]
    pub test: Tested,
    /// Corrected for the number of pairs.
    pub p_holm: f64,
}

/// Compares every two of two or more arms; `place` is what they have in common.
///
/// # Errors
/// The arms have too few trials or generations, or are no pairs where pairs are asked for.
pub fn compare(place: &str, arms: &[Cohort], options: &Question) -> Result<Comparison, ComparisonError> {
    let mut last = usize::MAX;
    for arm in arms {
        if arm.trials.len() < 2 {
            return Err(ComparisonError::OneTrial(arm.told()));
        }
        last = last.min(arm.last().ok_or_else(|| ComparisonError::TooShort(arm.told()))?);
    }
    if let Some(other) = arms.iter().find(|arm| options.paired && arm.keys() != arms[0].keys()) {
        return Err(ComparisonError::NoPairs(arms[0].told(), other.told()));
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
    let best = generations.iter().map(|&generation| Measure::BestG { generation });
    let champion = generations.iter().map(|&generation| Measure::ChampionG { generation });
    let reach = Measure::GenerationsToReach { reach: options.reach, generation: last };
    let measures = best.chain(champion).chain([reach]).map(|measure| {
        let values = |arm: &Cohort| arm.trials.iter().filter_map(|trial| measure.of(trial)).collect();
        measured(measure, &arms.iter().map(values).collect::<Vec<_>>(), options.paired)
    });
    let measures = measures.collect();

    let mut notes: Vec<String> = arms
        .iter()
        .filter_map(|arm| Some((arm, arm.last().filter(|&come| come < arm.planned)?)))
        .map(|(arm, come)| format!("{} has come to generation {come} of {}", arm.name, arm.planned))
        .collect();
    if arms.iter().any(|arm| arm.planned > last) {
        notes.push(format!("arms are compared up to generation {last}, which all have come to"));
    }
    let named = |arm: &Cohort| Named {
        name: arm.name.clone(),
        folders: arm.folders.iter().map(|folder| folder.escaped().to_string()).collect(),
        trials: arm.trials.len(),
    };
    Ok(Comparison { place: place.into(), generation: last, arms: arms.iter().map(named).collect(), measures, notes })
}

/// Compares what trials of two or more arms came to by other measures than those of their courses, `[arms][trials]` each.
///
/// # Errors
/// An arm has fewer than two trials.
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

/// Of `[arms][trials]`, two trials each at least.
fn measured(measure: Measure, values: &[Vec<f64>], paired: bool) -> Measured {
    let two = "arms of two trials or more";
    let means = values
        .iter()
        .map(|values| Mean { mean: statistics::bootstrap(&[values]).expect(two), reached: measure.reached(values) });
    let mut pairs = Vec::new();
    for (first, one) in values.iter().enumerate() {
        for (second, other) in values.iter().enumerate().skip(first + 1) {
            let (difference, test) = if paired {
                let less: Vec<f64> = one.iter().zip(other).map(|(one, other)| one - other).collect();
                (statistics::bootstrap(&[&less]), statistics::signed_rank(&less))
            } else {
                (statistics::bootstrap(&[one, other]), statistics::rank_sum(one, other))
            };
            let (difference, test) = (difference.expect(two), test.expect(two));
            pairs.push(Versus { arms: [first, second], difference, test, p_holm: 0.0 });
        }
    }
    let corrected = statistics::holm(&pairs.iter().map(|pair| pair.test.p).collect::<Vec<_>>());
    pairs.iter_mut().zip(corrected).for_each(|(pair, p)| pair.p_holm = p);
    Measured { measure, arms: means.collect(), pairs }
}

impl Comparison {
    /// A row an arm, its means side by side.
    fn means(&self) -> Vec<Vec<String>> {
        let mut head = vec!["arm".to_string(), "trials".into()];
        head.extend(self.measures.iter().map(|measured| measured.measure.to_string()));
        let rows = self.arms.iter().enumerate().map(|(at, arm)| {
            let cell = |Measured { measure, arms, .. }: &Measured| {
                let reached = arms[at].reached.map_or(String::new(), |count| format!(" ({count} of {})", arm.trials));
                estimate(arms[at].mean, measure.digits(), false) + &reached
            };
            [arm.name.clone(), arm.trials.to_string()].into_iter().chain(self.measures.iter().map(cell)).collect()
        });
        [head].into_iter().chain(rows).collect()
    }

    /// A row a measure and pair.
    fn pairs(&self) -> Vec<Vec<String>> {
        let head = ["measure", "pair", "difference", "A", "p", "p (Holm)"].map(String::from).to_vec();
        let row = |measure: Measure, pair: &Versus| {
            let names = pair.arms.map(|arm| &*self.arms[arm].name);
            let difference = estimate(pair.difference, measure.digits(), true);
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

/// "0.92 [0.86, 0.97]", with minus signs as typeset.
pub fn estimate(Estimate { value, low, high }: Estimate, digits: usize, signed: bool) -> String {
    // No "-0.000".
    let [value, low, high] = [value, low, high].map(|x| {
        let tens = 10f64.powi(digits as i32);
        (x * tens).round() / tens + 0.0
    });
    let value = if signed { format!("{value:+.digits$}") } else { format!("{value:.digits$}") };
    format!("{value} [{low:.digits$}, {high:.digits$}]").replace('-', "−")
}

/// "0.042", or "< 0.001".
pub fn probability(p: f64) -> String {
    if p < 0.001 { "< 0.001".into() } else { format!("{p:.3}") }
}

/// How the tables are to be read.
fn legend(all: &[Comparison], options: &Question) -> String {
    let (test, a) = match options.paired {
        true => ("Wilcoxon's signed ranks", "a pair's first trial"),
        false => ("Mann and Whitney's test", "a trial of the first arm"),
    };
    let mut text = format!(
        "Means over trials with 95 % bootstrap intervals. Of a pair, the first arm less the second; A: how likely {a} has\n\
         the larger value, 0.5 if neither; p: two-sided, by {test}; Holm: corrected for the number of pairs.\n"
    );
    let never = |measured: &Measured, all: &Comparison| {
        measured.arms.iter().zip(&all.arms).any(|(mean, arm)| mean.reached.is_some_and(|reached| reached < arm.trials))
    };
    if all.iter().any(|all| all.measures.iter().any(|measured| never(measured, all))) {
        let _ = writeln!(
            text,
            "A trial that does not reach G {} counts as one that does a generation after the last.",
            options.reach
        );
    }
    text
}

/// For people.
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

/// For a paper: two tables a comparison, and how to read them as comments.
pub fn latex(all: &[Comparison], options: &Question) -> String {
    let comment = |text: &str| text.lines().map(|line| format!("% {line}\n")).collect::<String>();
    let mut text = comment(&legend(all, options));
    for comparison in all {
        text += &comment(&comparison.place);
        let _ = writeln!(text, "{}\n{}", table::latex(&comparison.means()), table::latex(&comparison.pairs()));
    }
    text
}

/// For other programs: a row a measure and arm, then one a measure and pair.
///
/// # Errors
/// The output cannot be written.
pub fn csv(all: &[Comparison], output: impl io::Write) -> io::Result<()> {
    let mut table = csv::Writer::from_writer(output);
    table.write_record([
        "where",
        "measure",
        "generation",
        "reach",
        "arm",
        "other",
        "trials",
        "other_trials",
        "value",
        "low",
        "high",
        "reached",
        "a",
        "p",
        "p_holm",
    ])?;
    for Comparison { place, generation: last, arms: named, measures, .. } in all {
        for Measured { measure, arms, pairs } in measures {
            let (generation, reach) = match *measure {
                Measure::BestG { generation } | Measure::ChampionG { generation } => (generation, String::new()),
                Measure::GenerationsToReach { reach, generation } => (generation, reach.to_string()),
                Measure::Played { .. } => (*last, String::new()),
            };
            let place =
                || [escape::csv_cell(place).into_owned(), measure.key().into(), generation.to_string(), reach.clone()];
            let numbers = |Estimate { value, low, high }| [value, low, high].map(|number: f64| number.to_string());
            for (arm, Mean { mean, reached }) in named.iter().zip(arms) {
                let name = escape::csv_cell(&arm.name).into_owned();
                let whose = [name, String::new(), arm.trials.to_string(), String::new()];
                let reached = reached.map_or(String::new(), |count| count.to_string());
                let rest = [reached, String::new(), String::new(), String::new()];
                table.write_record([&place()[..], &whose, &numbers(*mean), &rest].concat())?;
            }
            for Versus { arms, difference, test, p_holm } in pairs {
                let [one, other] = arms.map(|arm| &named[arm]);
                let names = [one, other].map(|arm| escape::csv_cell(&arm.name).into_owned());
                let whose = [names, [one, other].map(|arm| arm.trials.to_string())].concat();
                let rest = [String::new(), test.a.to_string(), test.p.to_string(), p_holm.to_string()];
                table.write_record([&place()[..], &whose, &numbers(*difference), &rest].concat())?;
            }
        }
    }
    table.flush()
}
