//! Every measurable sentence of the paper about these experiments, tested as it is worded.
//!
//! Each claim has one measure and, for each source of policies, a verdict. It is *yes* if the interval lies within what
//! the words allow, *no* if it lies outside, and *not decided* if it contains the threshold. If the paper gives no
//! number, [`SMALL`] and [`ALMOST_NEVER`] replace its words.
//!
//! All measures are of champions, unless a claim is about random teams. The paper's curves are averages over trials, so
//! claims about curves are judged by averages. The verdicts on evolved teams are corrected for each other using Holm's
//! method: the p-value of a verdict is the smallest alpha at which the interval of confidence 1 - alpha decides it.
//!
//! [`list`] has the sentences with their measures. This file tests them.

use serde::Serialize;

use super::{BASELINES, Evidence, LAYOUTS, SOURCES, Source, TrialCurves};
use flotilla::config::Paradigm;
use flotilla::statistics::{self, Average, Estimate};

mod list;

/// Maximum difference, as a share of the POIs, that counts as "about similar", "comparable" or "slight".
pub(crate) const SMALL: f64 = 0.1;
/// Maximum share of trials that counts as "almost never". A larger share is "some of the time".
pub(crate) const ALMOST_NEVER: f64 = 0.1;
/// The generation at which the paper judges results: "After 100 generations".
pub const END: usize = 100;

/// Whether a claim holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub enum Verdict {
    /// The claim holds, and chance does not explain it.
    #[serde(rename = "yes")]
    Yes,
    /// The claim does not hold, and chance does not explain it.
    #[serde(rename = "no")]
    No,
    /// The interval contains the threshold.
    #[serde(rename = "not decided")]
    Undecided,
    /// There are too few generations or trials to judge.
    #[serde(rename = "open")]
    Open,
}

impl std::fmt::Display for Verdict {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.serialize(f)
    }
}

/// The result of one claim for one source of policies.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    /// Index of the table column in [`SOURCES`].
    #[serde(skip)]
    pub column: usize,
    /// The measured source, or the two sources of a comparison ("Df − G").
    pub of: String,
    /// Whether the claim holds. For evolved teams, corrected for the number of verdicts.
    pub verdict: Verdict,
    /// The measurement as text, with its 95 % interval: "3.58 [3.43, 3.73]".
    pub measured: String,
    /// The measured number with its interval, if there is one.
    #[serde(flatten)]
    pub estimate: Option<Estimate>,
    /// The smallest alpha at which the interval decides. None if chance plays no part, or for baselines.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub p: Option<f64>,
    /// [`p`](Finding::p) with Holm's correction for all verdicts on evolved teams.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub p_holm: Option<f64>,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Claim {
    /// The section of the paper.
    pub place: &'static str,
    pub layout: &'static str,
    /// The paper's words.
    pub words: &'static str,
    /// The measure that represents the words.
    pub measure: &'static str,
    /// Whether the experiment is ours: the paper states the claim, but describes no such experiment.
    pub exploratory: bool,
    /// The findings, one per source.
    pub findings: Vec<Finding>,
}

impl Claim {
    /// Returns the verdict over all fitnesses. The paper's "they all" are its reward functions: the claim holds if it
    /// holds for each of them, and not if it fails for one.
    pub fn verdict(&self) -> Verdict {
        let worst = |found: &Finding| {
            [Verdict::Yes, Verdict::Undecided, Verdict::Open, Verdict::No]
                .into_iter()
                .position(|verdict| verdict == found.verdict)
                .map(|rank| (rank, found.verdict))
        };
        self.on_evolution().filter_map(worst).max_by_key(|&(rank, _)| rank).map_or(Verdict::Open, |(_, worst)| worst)
    }

    /// Returns the findings on evolved teams. The paper's claims are about no other teams.
    pub fn on_evolution(&self) -> impl Iterator<Item = &Finding> {
        self.findings.iter().filter(|found| matches!(SOURCES[found.column], Source::Evolved(_)))
    }
}

/// The values that the words allow: at least the first number, less than the second.
type Band = [f64; 2];
/// The level of significance of all verdicts, after correction.
const ALPHA: f64 = 1.0 - statistics::CONFIDENCE;

/// The measured values, and the values that the words allow.
enum Criterion {
    /// Values per trial, in POIs.
    Mean(Vec<f64>, Band),
    /// Differences per pair of trials, in POIs.
    Difference(Vec<f64>, Band),
    /// Differences per pair of trials, in shares of the POIs.
    Shares(Vec<f64>, Band),
    /// Differences per pair of trials, in generations.
    Generations(Vec<f64>, Band),
    /// The number of trials or pairs that meet the criterion, and the number of all.
    Share(usize, usize, Band),
}

impl Criterion {
    /// Tests the criterion for teams that can observe `pois` POIs.
    fn find(self, column: usize, of: String, certain: bool, pois: f64) -> Option<Finding> {
        // `width` is the difference between the largest and the smallest possible value of a trial.
        let (values, width, allowed, signed) = match &self {
            Criterion::Mean(values, allowed) => (values, pois, *allowed, false),
            Criterion::Difference(values, allowed) => (values, pois, *allowed, true),
            Criterion::Shares(values, allowed) => (values, 1.0, *allowed, true),
            Criterion::Generations(values, allowed) => (values, (END + 1) as f64, *allowed, true),
            Criterion::Share(_, _, allowed) => (&vec![], 1.0, *allowed, false),
        };
        let average: Average = values.iter().collect();
        let factor = |confidence| statistics::bounded_factor(confidence, values.len());
        let estimate = |confidence: f64| match (&self, certain) {
            (&Criterion::Share(count, of, _), true) => (of > 0).then(|| Estimate::exact((count > 0).into())),
            (&Criterion::Share(count, of, _), false) => statistics::share_at(confidence, count, of),
            (_, true) => values.first().copied().map(Estimate::exact),
            (Criterion::Mean(..), false) => statistics::bounded_by(factor(confidence), &average, [0.0, width]),
            (_, false) => statistics::paired_by(factor(confidence), &average, width),
        };
        let at = estimate(statistics::CONFIDENCE)?;
        let measured = match &self {
            Criterion::Share(count, of, _) => format!("{count} of {of}"),
            Criterion::Generations(..) => format!("{:+.1}", at.value),
            _ if signed => format!("{:+.2}", at.value),
            _ => format!("{:.2}", at.value),
        };
        let interval = match (&self, certain) {
            (_, true) => String::new(),
            (Criterion::Generations(..), _) => format!(" [{:.1}, {:.1}]", at.low, at.high),
            _ => format!(" [{:.2}, {:.2}]", at.low, at.high),
        };
        let decided = |verdict: Verdict| {
            statistics::smallest_alpha(|confidence| {
                estimate(confidence).is_some_and(|estimate| judge(estimate, allowed) == verdict)
            })
        };
        let p = match certain {
            true => None,
            false => Some(decided(Verdict::Yes).or_else(|| decided(Verdict::No)).unwrap_or(1.0)),
        };
        // Typographic minus signs.
        let measured = format!("{measured}{interval}").replace('-', "−");
        Some(Finding { column, of, verdict: judge(at, allowed), measured, estimate: Some(at), p, p_holm: None })
    }
}

/// Returns the verdict on whether an interval lies within what is allowed.
fn judge(estimate: Estimate, [from, below]: Band) -> Verdict {
    match estimate {
        Estimate { low, high, .. } if low >= from && high < below => Verdict::Yes,
        Estimate { low, high, .. } if high < from || low >= below => Verdict::No,
        _ => Verdict::Undecided,
    }
}

/// The results that a claim is tested on.
#[derive(Clone, Copy)]
struct Lookup<'a> {
    results: Evidence<'a>,
    layout: usize,
    source: Source,
}

impl<'a> Lookup<'a> {
    fn curves(&'a self, paradigm: Paradigm) -> Option<TrialCurves<'a>> {
        self.results.curves(self.layout, paradigm, self.source)
    }

    /// Returns the results of all-leaders teams.
    fn all(&'a self) -> Option<TrialCurves<'a>> {
        self.curves(Paradigm::AllLeaders)
    }

    /// Returns the results of leader-follower teams.
    fn led(&'a self) -> Option<TrialCurves<'a>> {
        self.curves(Paradigm::LeaderFollower)
    }

    /// Returns the POIs observed by leader-follower teams minus those by all-leaders teams at generation [`END`], per
    /// pair.
    fn lead(&self) -> Option<Vec<f64>> {
        Some(less(&self.led()?.observed(END)?, &self.all()?.observed(END)?))
    }

    /// Returns the difference of a measure between two sources of leader-follower teams at generation [`END`], per
    /// pair.
    fn between(&self, by: Source, other: Source, measure: fn(&[f64]) -> Vec<f64>) -> Option<Vec<f64>> {
        let curves = |source| self.results.curves(self.layout, Paradigm::LeaderFollower, source)?.observed(END);
        Some(less(&measure(&curves(by)?), &measure(&curves(other)?)))
    }

    /// Returns the results of all-leaders teams that choose among known behaviours.
    fn selecting(&'a self) -> Option<TrialCurves<'a>> {
        let Source::Evolved(fitness) = self.source else { return None };
        self.results.selecting(self.layout, fitness)
    }

    /// Returns a share of the POIs as a number of POIs.
    fn pois(&self, share: f64) -> f64 {
        share * self.led().map_or(0, |curves| curves.pois) as f64
    }
}

/// Returns the differences, pair by pair.
fn less(values: &[f64], others: &[f64]) -> Vec<f64> {
    values.iter().zip(others).map(|(value, other)| value - other).collect()
}

impl TrialCurves<'_> {
    /// Returns the first generation at which each trial's champion observes every POI. None within a trial means never
    /// up to `last`.
    fn solved(&self, last: usize) -> Option<Vec<Option<usize>>> {
        self.champion.iter().map(|trial| Some(trial.get(..=last)?.iter().position(|&g| g >= 1.0))).collect()
    }

    /// Returns the number of trials whose champion observes every POI at or before `last`.
    fn count_solved(&self, last: usize) -> Option<usize> {
        Some(self.solved(last)?.iter().flatten().count())
    }

    fn trials(&self) -> usize {
        self.champion.len()
    }
}

/// A claim and how to test it.
#[derive(Clone, Copy)]
struct Test {
    place: &'static str,
    words: &'static str,
    measure: &'static str,
    /// Whether the experiment is ours.
    exploratory: bool,
    /// The last generation that the claim needs.
    needs: usize,
    sources: &'static [Source],
    find: fn(Lookup<'_>) -> Option<Criterion>,
}

/// Tests every claim of the paper on these results.
pub fn claims(results: Evidence<'_>) -> Vec<Claim> {
    let tests = list::TESTS.iter().flat_map(|(layout, tests)| tests.iter().map(|test| (*layout, test)));
    let mut claims: Vec<Claim> = tests.map(|(layout, test)| test.claim(results, layout)).collect();
    let mut tested: Vec<&mut Finding> = claims
        .iter_mut()
        .flat_map(|claim| &mut claim.findings)
        .filter(|found| found.p.is_some() && matches!(SOURCES[found.column], Source::Evolved(_)))
        .collect();
    let p: Vec<f64> = tested.iter().filter_map(|found| found.p).collect();
    for (found, p) in tested.iter_mut().zip(statistics::holm(&p)) {
        found.p_holm = Some(p);
        if p > ALPHA {
            found.verdict = Verdict::Undecided;
        }
        found.measured += &if p < 0.001 { ", p < 0.001".into() } else { format!(", p = {p:.3}") };
    }
    claims
}

impl Test {
    fn claim(&self, results: Evidence<'_>, layout: usize) -> Claim {
        let view = |source| Lookup { results, layout, source };
        let findings = self.sources.iter().filter_map(|&source| self.finding(view(source))).collect();
        let Test { place, words, measure, exploratory, .. } = *self;
        Claim { place, layout: LAYOUTS[layout].name, words, measure, exploratory, findings }
    }

    fn finding(&self, view: Lookup<'_>) -> Option<Finding> {
        let source = view.source;
        let column = SOURCES.iter().position(|&other| other == source)?;
        let curves = view.led()?;
        let of = match self.sources {
            list::EVOLVED => format!("{source} − {}", list::next(source)),
            [list::G, list::D] | [list::G] => format!("{} − {source}", list::DF),
            _ => source.to_string(),
        };
        let without = |verdict, measured: String| {
            Some(Finding { column, of: of.clone(), verdict, measured, estimate: None, p: None, p_holm: None })
        };
        if curves.champion.iter().any(|trial| trial.len() <= self.needs) {
            return without(Verdict::Open, format!("takes {} generations", self.needs));
        }
        if curves.trials() < 2 && !curves.certain {
            return without(Verdict::Open, "takes 2 trials".into());
        }
        let found = (self.find)(view)?.find(column, of.clone(), curves.certain, curves.pois as f64);
        found.or_else(|| without(Verdict::Undecided, "no pair differs".into()))
    }
}
