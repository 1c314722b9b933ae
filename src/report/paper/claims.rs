//! Every measurable sentence of the paper about these experiments, tested as it is worded.
//!
//! Each claim has one measure and, for each source of policies, a verdict. It is *yes* if the interval lies within what
//! the words allow, *no* if it lies outside, and *not decided* if it contains the threshold. If the paper gives no
//! number, [`SMALL`] and [`FEW`] replace its words.
//!
//! All measures are of champions, unless a claim is about random teams. The paper's curves are averages over trials, so
//! claims about curves are judged by averages. The verdicts on evolved teams are corrected for each other using Holm's
//! method: the p-value of a verdict is the smallest alpha at which the interval of confidence 1 - alpha decides it.

use serde::Serialize;

use super::{Course, Evidence, LAYOUTS, SOURCES, Source};
use crate::config::Paradigm;
use crate::statistics::{self, Estimate};

/// Maximum difference, as a share of the POIs, that counts as "about similar", "comparable" or "slight".
pub const SMALL: f64 = 0.1;
/// Maximum share of trials that counts as "almost never". A larger share is "some of the time".
pub const FEW: f64 = 0.1;
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
        f.write_str(match self {
            Verdict::Yes => "yes",
            Verdict::No => "no",
            Verdict::Undecided => "not decided",
            Verdict::Open => "open",
        })
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

/// One claim of the paper.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Claim {
    /// The section of the paper.
    pub place: &'static str,
    /// The layout that the claim is about.
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
const ABOVE_0: Band = [f64::MIN_POSITIVE, f64::INFINITY];
const BELOW_0: Band = [f64::NEG_INFINITY, 0.0];
const MOST: Band = [0.5 + f64::EPSILON, f64::INFINITY];
/// The level of significance of all verdicts, after correction.
const ALPHA: f64 = 1.0 - statistics::CONFIDENCE;

/// The measured values, and the values that the words allow.
enum Criterion {
    /// Values per trial, in POIs.
    Mean(Vec<f64>, Band),
    /// Differences per pair of trials, in POIs.
    Difference(Vec<f64>, Band),
    /// Differences per pair of trials, in shares of the POIs. The smallest step is 0.25, because layouts have at most
    /// four POIs.
    Shares(Vec<f64>, Band),
    /// Differences per pair of trials, in generations.
    Generations(Vec<f64>, Band),
    /// The number of trials or pairs that meet the criterion, and the number of all.
    Share(usize, usize, Band),
}

impl Criterion {
    /// Tests the criterion for teams that can observe `pois` POIs.
    fn find(self, column: usize, of: String, certain: bool, pois: f64) -> Option<Finding> {
        let last = END as f64;
        // Values are whole POIs or generations. Layouts have at most four POIs, so shares have steps of at least 0.25.
        let (values, step, [least, most], allowed, signed) = match &self {
            Criterion::Mean(values, allowed) => (values, 1.0, [0.0, pois], *allowed, false),
            Criterion::Difference(values, allowed) => (values, 1.0, [-pois, pois], *allowed, true),
            Criterion::Shares(values, allowed) => (values, 0.25, [-1.0, 1.0], *allowed, true),
            Criterion::Generations(values, allowed) => (values, 1.0, [-last - 1.0, last + 1.0], *allowed, true),
            Criterion::Share(_, _, allowed) => (&vec![], 0.0, [0.0, 1.0], *allowed, false),
        };
        let estimate = |confidence: f64| match (&self, certain) {
            (&Criterion::Share(count, of, _), true) => (of > 0).then(|| Estimate::exact((count > 0).into())),
            (&Criterion::Share(count, of, _), false) => statistics::share_at(confidence, count, of),
            (_, true) => values.first().copied().map(Estimate::exact),
            (_, false) => Some(statistics::mean_at(confidence, values, step)?.within(least, most)),
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
    fn course(&'a self, paradigm: Paradigm) -> Option<Course<'a>> {
        self.results.course(self.layout, paradigm, self.source)
    }

    /// Returns the results of all-leaders teams.
    fn all(&'a self) -> Option<Course<'a>> {
        self.course(Paradigm::AllLeaders)
    }

    /// Returns the results of leader-follower teams.
    fn led(&'a self) -> Option<Course<'a>> {
        self.course(Paradigm::LeaderFollower)
    }

    /// Returns the POIs observed by leader-follower teams minus those by all-leaders teams at generation [`END`], per
    /// pair.
    fn lead(&self) -> Option<Vec<f64>> {
        Some(less(&self.led()?.observed(END)?, &self.all()?.observed(END)?))
    }

    /// Returns the difference of a measure between two sources of leader-follower teams at generation [`END`], per
    /// pair.
    fn between(&self, by: Source, other: Source, measure: fn(&[f64]) -> Vec<f64>) -> Option<Vec<f64>> {
        let course = |source| self.results.course(self.layout, Paradigm::LeaderFollower, source)?.observed(END);
        Some(less(&measure(&course(by)?), &measure(&course(other)?)))
    }

    /// Returns the results of all-leaders teams that choose among known behaviours.
    fn selecting(&'a self) -> Option<Course<'a>> {
        let Source::Evolved(fitness) = self.source else { return None };
        self.results.selecting(self.layout, fitness)
    }

    /// Returns a share of the POIs as a number of POIs.
    fn pois(&self, share: f64) -> f64 {
        share * self.led().map_or(0, |course| course.pois) as f64
    }
}

/// Returns the differences, pair by pair.
fn less(values: &[f64], others: &[f64]) -> Vec<f64> {
    values.iter().zip(others).map(|(value, other)| value - other).collect()
}

impl Course<'_> {
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
struct Test {
    place: &'static str,
    layout: usize,
    words: &'static str,
    measure: &'static str,
    /// Whether the experiment is ours.
    exploratory: bool,
    /// The last generation that the claim needs.
    needs: usize,
    sources: &'static [Source],
    find: fn(Lookup<'_>) -> Option<Criterion>,
}

/// The sources for claims about all-leaders teams. Df is omitted because it equals D without followers.
const ALONE: &[Source] = SOURCES.split_at(5).0;
const EVOLVED: &[Source] = SOURCES.split_at(3).1;
const G: Source = SOURCES[3];
const D: Source = SOURCES[4];
const DF: Source = SOURCES[5];

/// Sources for comparisons with all-leaders teams that choose among behaviours, each with the same fitness. The order
/// must differ from [`EVOLVED`], because [`Test::finding`] treats that slice as comparisons between fitnesses.
const AGAINST_SELECTING: &[Source] = &[DF, D, G];

const GENERAL: usize = 0;
const STRICT: usize = 1;
const CHAOTIC: usize = 2;
const EIGHT: usize = 3;

const MORE_OPTIMAL: &str = "“a more optimal joint policy”, leader-follower than all-leaders";
const MORE_POIS: &str = "POIs at generation 100, leader-follower less all-leaders, by pair: above 0";
const MUCH_FASTER: &str = "“much faster”, leader-follower than all-leaders";
const HALF_THE_TIME: &str = "generations until all POIs are observed (at most 101), half of all-leaders' less \
                             leader-follower's, by pair, 0 if neither observes all: above 0. Where a side observes all \
                             in fewer than half of its trials: pairs in which leader-follower needs at most half as \
                             many, of those that are no ties: over half";
const SOONER: &str = "generations until all POIs are observed (at most 101), all-leaders' less leader-follower's, by \
                      pair, 0 if neither observes all: above 0. Where a side observes all in fewer than half of its \
                      trials: pairs in which leader-follower is sooner, of those that are no ties: over half";
const MORE_RELIABLY: &str = "“more reliably”, leader-follower than all-leaders";
const ODD_PAIRS: &str =
    "of the pairs in which only one observes all POIs at generation 100, leader-follower does in: over half";

/// Returns the values that "all POIs" allows for an average: at least a share of 1 - [`SMALL`].
fn nearly_all(view: Lookup<'_>) -> Band {
    [view.pois(1.0 - SMALL), f64::INFINITY]
}

fn more_optimal(view: Lookup<'_>) -> Option<Criterion> {
    Some(Criterion::Difference(view.lead()?, ABOVE_0))
}

fn much_faster(view: Lookup<'_>) -> Option<Criterion> {
    sooner(view.led()?, view.all()?, 2)
}

fn more_reliably(view: Lookup<'_>) -> Option<Criterion> {
    let pois = view.pois(1.0);
    let (led, all) = (view.led()?.observed(END)?, view.all()?.observed(END)?);
    let pairs = || led.iter().zip(&all).map(|(led, all)| (*led >= pois, *all >= pois));
    let odd = pairs().filter(|(led, all)| led != all).count();
    Some(Criterion::Share(pairs().filter(|pair| *pair == (true, false)).count(), odd, MOST))
}

/// The claims of section 1 about every layout, compared with agents that learn to select between known behaviours.
const MORE_THAN_SELECTING: Test = Test {
    place: "§1",
    layout: GENERAL,
    words: "leader-follower: “a more optimal solution” than “those learning to select between policies”",
    measure: "POIs at generation 100, leader-follower less all-leaders who choose among behaviours, by pair: above 0",
    exploratory: true,
    needs: END,
    sources: AGAINST_SELECTING,
    find: |view| {
        let (led, selecting) = (view.led()?.observed(END)?, view.selecting()?.observed(END)?);
        Some(Criterion::Difference(less(&led, &selecting), ABOVE_0))
    },
};
const FASTER_THAN_SELECTING: Test = Test {
    words: "leader-follower: “faster” than “those learning to select between policies”",
    measure: SOONER,
    find: |view| sooner(view.led()?, view.selecting()?, 1),
    ..MORE_THAN_SELECTING
};

/// Compares the generations until all POIs are observed: those of the second, divided by a factor, less those of the
/// first. A trial that never observes all counts as [`END`] + 1, and a pair in which neither does is a tie.
///
/// If a side observes all in fewer than half of its trials, most of its times are censored. The sign test then replaces
/// the mean.
fn sooner(one: Course<'_>, other: Course<'_>, factor: usize) -> Option<Criterion> {
    let (one, other) = (one.solved(END)?, other.solved(END)?);
    let censored = |times: &[Option<usize>]| 2 * times.iter().flatten().count() < times.len();
    let time = |solved: Option<usize>| solved.unwrap_or(END + 1);
    let pairs = || one.iter().copied().zip(other.iter().copied());
    if censored(&one) || censored(&other) {
        let untied = pairs().filter(|(one, other)| one != other);
        let sooner = untied.clone().filter(|&(one, other)| one.is_some() && factor * time(one) <= time(other));
        return Some(Criterion::Share(sooner.count(), untied.count(), MOST));
    }
    let less = |(one, other): (Option<usize>, Option<usize>)| match one.or(other) {
        None => 0.0,
        Some(_) => time(other) as f64 / factor as f64 - time(one) as f64,
    };
    Some(Criterion::Generations(pairs().map(less).collect(), ABOVE_0))
}

/// Returns the fitness that a fitness is compared with, so that every pair of fitnesses occurs once.
fn next(source: Source) -> Source {
    match source {
        G => D,
        D => DF,
        _ => G,
    }
}

/// The paper's claims, layout by layout.
const TESTS: &[Test] = &[
    Test {
        place: "§5",
        layout: GENERAL,
        words: MORE_OPTIMAL,
        measure: MORE_POIS,
        exploratory: false,
        needs: END,
        sources: &SOURCES,
        find: more_optimal,
    },
    Test {
        place: "Abstract, §5",
        layout: GENERAL,
        words: MUCH_FASTER,
        measure: HALF_THE_TIME,
        exploratory: false,
        needs: END,
        sources: &SOURCES,
        find: much_faster,
    },
    Test {
        place: "Abstract, §5",
        layout: GENERAL,
        words: MORE_RELIABLY,
        measure: ODD_PAIRS,
        exploratory: false,
        needs: END,
        sources: &SOURCES,
        find: more_reliably,
    },
    Test {
        place: "§5.1",
        layout: GENERAL,
        words: "all-leaders: “they struggle to learn to observe all 4 POIs”",
        measure: "all-leaders, trials that ever observe all 4 up to generation 100: under half",
        exploratory: false,
        needs: END,
        sources: ALONE,
        find: |view| Some(Criterion::Share(view.all()?.count_solved(END)?, view.all()?.trials(), [0.0, 0.5])),
    },
    Test {
        place: "§5.1, Fig. 4",
        layout: GENERAL,
        words: "all-leaders: “after 100 generations, they average observing less than a single POI”",
        measure: "all-leaders, POIs at generation 100: under 1",
        exploratory: false,
        needs: END,
        sources: ALONE,
        find: |view| Some(Criterion::Mean(view.all()?.observed(END)?, [f64::NEG_INFINITY, 1.0])),
    },
    Test {
        place: "§5.1",
        layout: GENERAL,
        words: "leader-follower: “in fewer than 20 generations, they all observe at least 3, on average”",
        measure: "leader-follower, POIs at generation 19: at least 3",
        exploratory: false,
        needs: 19,
        sources: &SOURCES,
        find: |view| Some(Criterion::Mean(view.led()?.observed(19)?, [3.0, f64::INFINITY])),
    },
    Test {
        place: "§5.1, Fig. 4",
        layout: GENERAL,
        words: "leader-follower: “quickly able to learn to observe all of the POIs”",
        measure: "leader-follower, POIs at generation 40: at least 3.6",
        exploratory: false,
        needs: 40,
        sources: &SOURCES,
        find: |view| Some(Criterion::Mean(view.led()?.observed(40)?, nearly_all(view))),
    },
    Test {
        place: "§5.1",
        layout: GENERAL,
        words: "leader-follower: “they all consistently observe all 4 POIs within 40 generations”",
        measure: "leader-follower, POIs in the mean over generations 40 to 100: at least 3.6",
        exploratory: false,
        needs: END,
        sources: &SOURCES,
        find: |view| {
            let led = view.led()?;
            let mean = |trial: &Vec<f64>| trial[40..=END].iter().sum::<f64>() / (END - 39) as f64 * led.pois as f64;
            Some(Criterion::Mean(led.champion.iter().map(mean).collect(), nearly_all(view)))
        },
    },
    Test {
        place: "§5",
        layout: STRICT,
        words: MORE_OPTIMAL,
        measure: MORE_POIS,
        exploratory: false,
        needs: END,
        sources: &SOURCES,
        find: more_optimal,
    },
    Test {
        place: "Abstract, §5",
        layout: STRICT,
        words: MUCH_FASTER,
        measure: HALF_THE_TIME,
        exploratory: false,
        needs: END,
        sources: &SOURCES,
        find: much_faster,
    },
    Test {
        place: "Abstract, §5",
        layout: STRICT,
        words: MORE_RELIABLY,
        measure: ODD_PAIRS,
        exploratory: false,
        needs: END,
        sources: &SOURCES,
        find: more_reliably,
    },
    Test {
        place: "§5.2",
        layout: STRICT,
        words: "all-leaders: “almost never able to learn to obtain any reward using any of the reward functions”",
        measure: "all-leaders, trials that ever observe a POI up to generation 100: under 1 in 10",
        exploratory: false,
        needs: END,
        sources: ALONE,
        find: |view| {
            let all = view.all()?;
            let any = all.observed_by(END)?.iter().filter(|&&pois| pois > 0.0).count();
            Some(Criterion::Share(any, all.trials(), [0.0, FEW]))
        },
    },
    Test {
        place: "Fig. 5",
        layout: STRICT,
        words: "all-leaders: failing “is more drastic than in the previous configuration”",
        measure: "all-leaders, share of the POIs at generation 100, less that in generally forward, by pair: below 0",
        exploratory: false,
        needs: END,
        sources: ALONE,
        find: |view| {
            let share = |view: Lookup<'_>| {
                let all = view.all()?;
                Some(all.observed(END)?.iter().map(|pois| pois / all.pois as f64).collect::<Vec<_>>())
            };
            Some(Criterion::Shares(less(&share(view)?, &share(Lookup { layout: GENERAL, ..view })?), BELOW_0))
        },
    },
    Test {
        place: "Fig. 5",
        layout: STRICT,
        words: "leader-follower: “learning to observe 3 of the 4 POIs on average withing 30 generations”",
        measure: "leader-follower, POIs at generation 30: at least 1.5 of the 2 that this layout has",
        exploratory: false,
        needs: 30,
        sources: &SOURCES,
        find: |view| Some(Criterion::Mean(view.led()?.observed(30)?, [view.pois(0.75), f64::INFINITY])),
    },
    Test {
        place: "§5.2",
        layout: STRICT,
        words: "leader-follower: “able to use any of the reward functions to successfully solve the task”",
        measure: "leader-follower, POIs at generation 100: at least 1.8",
        exploratory: false,
        needs: END,
        sources: &SOURCES,
        find: |view| Some(Criterion::Mean(view.led()?.observed(END)?, nearly_all(view))),
    },
    Test {
        place: "§5.2",
        layout: STRICT,
        words: "leader-follower: “the impact of the various reward structures is not as readily apparent based solely on \
                the average reward”",
        measure: "leader-follower, POIs at generation 100 under one fitness less those under another, by pair: less \
                  than 0.2 apart",
        exploratory: false,
        needs: END,
        sources: EVOLVED,
        find: |view| {
            let margin = view.pois(SMALL);
            let differences = view.between(view.source, next(view.source), <[f64]>::to_vec)?;
            Some(Criterion::Difference(differences, [-margin, margin]))
        },
    },
    Test {
        place: "§5.2",
        layout: STRICT,
        words: "leader-follower: under Df “the variance of the performance of the system was significantly higher”",
        measure: "leader-follower, distance of a trial's POIs at generation 100 from the median trial's, Df less the \
                  other, by pair (Brown-Forsythe): above 0",
        exploratory: false,
        needs: END,
        sources: &[G, D],
        find: |view| Some(Criterion::Difference(view.between(DF, view.source, statistics::distances)?, ABOVE_0)),
    },
    Test {
        place: "§5",
        layout: CHAOTIC,
        words: MORE_OPTIMAL,
        measure: MORE_POIS,
        exploratory: false,
        needs: END,
        sources: &SOURCES,
        find: more_optimal,
    },
    Test {
        place: "Abstract, Fig. 6",
        layout: CHAOTIC,
        words: MUCH_FASTER,
        measure: HALF_THE_TIME,
        exploratory: false,
        needs: END,
        sources: &SOURCES,
        find: much_faster,
    },
    Test {
        place: "Abstract, §5",
        layout: CHAOTIC,
        words: MORE_RELIABLY,
        measure: ODD_PAIRS,
        exploratory: false,
        needs: END,
        sources: &SOURCES,
        find: more_reliably,
    },
    Test {
        place: "§5.3",
        layout: CHAOTIC,
        words: "all-leaders: “a high likelihood of random actions successfully causing the agents to observe the POI”",
        measure: "all-leaders, trials in which one of generation 0's random teams observes a POI: over half",
        exploratory: false,
        needs: 0,
        // Before any selection, fitness has no effect.
        sources: &[Source::Actions, Source::Random, G],
        find: |view| {
            let all = view.all()?;
            Some(Criterion::Share(
                all.observed_by_best(0)?.iter().filter(|&&pois| pois > 0.0).count(),
                all.trials(),
                MOST,
            ))
        },
    },
    Test {
        place: "Fig. 6",
        layout: CHAOTIC,
        words: "all-leaders: “able to solve the problem some of the time”",
        measure: "all-leaders, trials that ever observe all 4 up to generation 100: 1 in 10 to 9 in 10",
        exploratory: false,
        needs: END,
        sources: ALONE,
        find: |view| Some(Criterion::Share(view.all()?.count_solved(END)?, view.all()?.trials(), [FEW, 1.0 - FEW])),
    },
    Test {
        place: "§5.3",
        layout: CHAOTIC,
        words: "all-leaders: “a rather large variance in the average policy performance”",
        measure: "all-leaders, mean distance of a trial's POIs at generation 100 from the median trial's: at least 0.5, \
                  as if every second trial were a POI off",
        exploratory: false,
        needs: END,
        sources: ALONE,
        find: |view| Some(Criterion::Mean(statistics::distances(&view.all()?.observed(END)?), [0.5, f64::INFINITY])),
    },
    Test {
        place: "§5.3",
        layout: CHAOTIC,
        words: "leader-follower: “the agents learn about a similar policy”",
        measure: "POIs at generation 100, leader-follower less all-leaders, by pair: less than 0.4 apart",
        exploratory: false,
        needs: END,
        sources: &SOURCES,
        find: |view| {
            let margin = view.pois(SMALL);
            Some(Criterion::Difference(view.lead()?, [-margin, margin]))
        },
    },
    Test {
        place: "Fig. 6",
        layout: CHAOTIC,
        words: "leader-follower: “at least a comparable policy”",
        measure: "POIs at generation 100, leader-follower less all-leaders, by pair: above −0.4",
        exploratory: false,
        needs: END,
        sources: &SOURCES,
        find: |view| Some(Criterion::Difference(view.lead()?, [-view.pois(SMALL), f64::INFINITY])),
    },
    Test {
        place: "§5.3, Fig. 6",
        layout: CHAOTIC,
        words: "leader-follower: “more consistently” than all-leaders",
        measure: "distance of a trial's POIs at generation 100 from the median trial's, leader-follower less \
                  all-leaders, by pair (Brown-Forsythe): below 0",
        exploratory: false,
        needs: END,
        sources: &SOURCES,
        find: |view| {
            let distances = |course: Course<'_>| Some(statistics::distances(&course.observed(END)?));
            Some(Criterion::Difference(less(&distances(view.led()?)?, &distances(view.all()?)?), BELOW_0))
        },
    },
    Test {
        place: "§5.3",
        layout: CHAOTIC,
        words: "leader-follower: “a slight benefit of using the leader-follower trajectory assignment” over the global reward",
        measure: "leader-follower, POIs at generation 100 under Df less those under G, by pair: above 0, under 0.4",
        exploratory: false,
        needs: END,
        sources: &[G],
        find: |view| {
            let differences = view.between(DF, view.source, <[f64]>::to_vec)?;
            Some(Criterion::Difference(differences, [f64::MIN_POSITIVE, view.pois(SMALL)]))
        },
    },
    Test {
        place: "§5.3",
        layout: CHAOTIC,
        words: "leader-follower: the global reward is “enough of a learning signal to direct agent to solve the task”",
        measure: "leader-follower, POIs at generation 100: at least 3.6",
        exploratory: false,
        needs: END,
        sources: &[SOURCES[0], SOURCES[1], SOURCES[2], G],
        find: |view| Some(Criterion::Mean(view.led()?.observed(END)?, nearly_all(view))),
    },
    MORE_THAN_SELECTING.within(GENERAL),
    FASTER_THAN_SELECTING.within(GENERAL),
    MORE_THAN_SELECTING.within(STRICT),
    FASTER_THAN_SELECTING.within(STRICT),
    MORE_THAN_SELECTING.within(CHAOTIC),
    FASTER_THAN_SELECTING.within(CHAOTIC),
    Test {
        place: "§6",
        layout: EIGHT,
        words: "leader-follower: “a similarly performant policy”, “even as this ratio of followers to leaders is \
                increased”",
        measure: "POIs at generation 100, leader-follower less all-leaders, by pair: less than 0.2 apart",
        exploratory: true,
        needs: END,
        sources: &SOURCES,
        find: |view| {
            let margin = view.pois(SMALL);
            Some(Criterion::Difference(view.lead()?, [-margin, margin]))
        },
    },
    Test {
        place: "§6",
        layout: EIGHT,
        words: "leader-follower: “faster than when using all learners”, “even as this ratio of followers to leaders is \
                increased”",
        measure: SOONER,
        exploratory: true,
        needs: END,
        sources: &SOURCES,
        find: |view| sooner(view.led()?, view.all()?, 1),
    },
];

/// Tests every claim of the paper on these results.
pub fn claims(results: Evidence<'_>) -> Vec<Claim> {
    let mut claims: Vec<Claim> = TESTS.iter().map(|test| test.claim(results)).collect();
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
    /// Returns the same claim for another layout.
    const fn within(self, layout: usize) -> Test {
        Test { layout, ..self }
    }

    fn claim(&self, results: Evidence<'_>) -> Claim {
        let findings = self.sources.iter().filter_map(|&source| self.finding(results, source)).collect();
        let Test { place, layout, words, measure, exploratory, .. } = *self;
        Claim { place, layout: LAYOUTS[layout].name, words, measure, exploratory, findings }
    }

    fn finding(&self, results: Evidence<'_>, source: Source) -> Option<Finding> {
        let column = SOURCES.iter().position(|&other| other == source)?;
        let view = Lookup { results, layout: self.layout, source };
        let course = view.led()?;
        let of = match self.sources {
            EVOLVED => format!("{source} − {}", next(source)),
            [G, D] | [G] => format!("{DF} − {source}"),
            _ => source.to_string(),
        };
        let without = |verdict, measured: String| {
            Some(Finding { column, of: of.clone(), verdict, measured, estimate: None, p: None, p_holm: None })
        };
        if course.champion.iter().any(|trial| trial.len() <= self.needs) {
            return without(Verdict::Open, format!("takes {} generations", self.needs));
        }
        if course.trials() < 2 && !course.certain {
            return without(Verdict::Open, "takes 2 trials".into());
        }
        let found = (self.find)(view)?.find(column, of.clone(), course.certain, course.pois as f64);
        found.or_else(|| without(Verdict::Undecided, "no pair differs".into()))
    }
}
