//! Every measurable sentence of the paper about these experiments, tested as it is worded.
//!
//! Each claim has one measure and, for each source of policies, a verdict. It is *yes* if the 95 % interval lies within
//! what the words allow, *no* if it lies outside, and *not decided* if it contains the threshold. If the paper gives no
//! number, [`SMALL`] and [`FEW`] replace its words.

use serde::Serialize;

use super::{Course, Evidence, LAYOUTS, SOURCES, Source};
use crate::config::Paradigm;
use crate::statistics::{self, Estimate};

/// Maximum difference, as a share of the POIs, that counts as "about similar", "comparable" or "slight".
pub const SMALL: f64 = 0.1;
/// Maximum share of trials that counts as "almost never". A larger share is "some of the time". "All" requires a share
/// of at least 1 - [`FEW`], with no counterexample.
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
    /// Whether the claim holds.
    pub verdict: Verdict,
    /// The measurement as text: "3.58 [3.43, 3.73]".
    pub measured: String,
    /// The measured number with its interval, if there is one.
    #[serde(flatten)]
    pub estimate: Option<Estimate>,
    /// Two-sided p-value of a test of difference.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub p: Option<f64>,
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
    /// The findings, one per source.
    pub findings: Vec<Finding>,
}

impl Claim {
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

/// The measured values, and the values that the words allow.
enum Criterion {
    /// Values per trial, in POIs.
    Mean(Vec<f64>, Band),
    /// Differences per pair of trials, in POIs.
    Difference(Vec<f64>, Band),
    /// Differences per pair of trials, in shares of the POIs. The smallest step is 0.25, because layouts have at most
    /// four POIs.
    Shares(Vec<f64>, Band),
    /// The same as [`Criterion::Difference`], with the p-value of its test.
    Tested(Vec<f64>, Band),
    /// The number of trials or pairs that meet the criterion, and the number of all.
    Share(usize, usize, Band),
    /// The same numbers as [`Criterion::Share`]. All trials should meet the criterion.
    All(usize, usize),
}

impl Criterion {
    /// Tests the criterion for teams that can observe `pois` POIs.
    fn find(self, column: usize, of: String, certain: bool, pois: f64) -> Option<Finding> {
        let estimate = |values: &[f64], least: f64| match certain {
            true => values.first().copied().map(Estimate::exact),
            false => Some(statistics::mean(values, 1.0)?.within(least, pois)),
        };
        let share = |count: usize, of: usize| match certain {
            true => (of > 0).then(|| Estimate::exact((count > 0).into())),
            false => statistics::share(count, of),
        };
        let (estimate, verdict, measured) = match &self {
            Criterion::Mean(values, allowed) => {
                let estimate = estimate(values, 0.0)?;
                (estimate, judge(estimate, *allowed), format!("{:.2}", estimate.value))
            }
            Criterion::Difference(values, allowed) | Criterion::Tested(values, allowed) => {
                let estimate = estimate(values, -pois)?;
                (estimate, judge(estimate, *allowed), format!("{:+.2}", estimate.value))
            }
            Criterion::Shares(values, allowed) => {
                let estimate = match certain {
                    true => Estimate::exact(*values.first()?),
                    false => statistics::mean(values, 0.25)?.within(-1.0, 1.0),
                };
                (estimate, judge(estimate, *allowed), format!("{:+.2}", estimate.value))
            }
            &Criterion::Share(count, of, allowed) => {
                let estimate = share(count, of)?;
                (estimate, judge(estimate, allowed), format!("{count} of {of}"))
            }
            &Criterion::All(count, of) => {
                let estimate = share(count, of)?;
                // One counterexample refutes the claim. To confirm it, the interval of the share must start at 1 - FEW
                // or above.
                let verdict = if count < of { Verdict::No } else { judge(estimate, [1.0 - FEW, f64::INFINITY]) };
                (estimate, verdict, format!("{count} of {of}"))
            }
        };
        let p = match &self {
            Criterion::Tested(values, _) if !certain => statistics::p_value(values),
            _ => None,
        };
        let interval = if certain { String::new() } else { format!(" [{:.2}, {:.2}]", estimate.low, estimate.high) };
        let test = p.map_or(String::new(), |p| if p < 0.001 { ", p < 0.001".into() } else { format!(", p = {p:.3}") });
        // Typographic minus signs.
        let measured = format!("{measured}{interval}{test}").replace("-", "−");
        Some(Finding { column, of, verdict, measured, estimate: Some(estimate), p })
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
    /// Returns the first generation at which each trial's best team observes every POI. None within a trial means never
    /// up to `last`.
    fn solved(&self, last: usize) -> Option<Vec<Option<usize>>> {
        self.best.iter().map(|trial| Some(trial.get(..=last)?.iter().position(|&g| g >= 1.0))).collect()
    }

    /// Returns the number of trials whose best team observes every POI at or before `last`.
    fn count_solved(&self, last: usize) -> Option<usize> {
        Some(self.solved(last)?.iter().flatten().count())
    }

    fn trials(&self) -> usize {
        self.best.len()
    }
}

/// A claim and how to test it.
struct Test {
    place: &'static str,
    layout: usize,
    words: &'static str,
    measure: &'static str,
    /// The last generation that the claim needs.
    needs: usize,
    sources: &'static [Source],
    find: fn(Lookup<'_>) -> Option<Criterion>,
}

/// The sources for claims about all-leaders teams. Df is omitted because it equals D without followers.
const ALONE: &[Source] = SOURCES.split_at(4).0;
const EVOLVED: &[Source] = SOURCES.split_at(2).1;
const G: Source = SOURCES[2];
const D: Source = SOURCES[3];
const DF: Source = SOURCES[4];

/// Sources for comparisons with all-leaders teams that choose among behaviours, each with the same fitness. The order
/// must differ from [`EVOLVED`], because [`Test::finding`] treats that slice as comparisons between fitnesses.
const AGAINST_SELECTING: &[Source] = &[DF, D, G];

const GENERAL: usize = 0;
const STRICT: usize = 1;
const CHAOTIC: usize = 2;
const EIGHT: usize = 3;

const MORE_OPTIMAL: &str = "“a more optimal joint policy” led than alone";
const MORE_POIS: &str = "POIs at generation 100, leader-follower less all-leaders, by pair: above 0";
const MUCH_FASTER: &str = "“much faster” led than alone";
const HALF_THE_TIME: &str =
    "pairs in which leader-follower first observes all POIs in half of all-leaders' generations or fewer: over half";
const MORE_RELIABLY: &str = "“more reliably” led than alone";
const ODD_PAIRS: &str =
    "of the pairs in which only one observes all POIs at generation 100, leader-follower does in: over half";

fn more_optimal(view: Lookup<'_>) -> Option<Criterion> {
    Some(Criterion::Difference(view.lead()?, ABOVE_0))
}

fn much_faster(view: Lookup<'_>) -> Option<Criterion> {
    let (led, all) = (view.led()?.solved(END)?, view.all()?.solved(END)?);
    // A trial that never succeeds counts as succeeding after the end.
    let sooner = |(led, all): &(&Option<usize>, &Option<usize>)| {
        led.is_some_and(|led| 2 * led <= all.unwrap_or(END + 1) && Some(led) != **all)
    };
    Some(Criterion::Share(led.iter().zip(&all).filter(sooner).count(), led.len(), MOST))
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
    words: "led, “a more optimal solution” than “those learning to select between policies”",
    measure: "POIs at generation 100, leader-follower less all-leaders who choose among behaviours, by pair: above 0",
    needs: END,
    sources: AGAINST_SELECTING,
    find: |view| {
        let (led, selecting) = (view.led()?.observed(END)?, view.selecting()?.observed(END)?);
        Some(Criterion::Difference(less(&led, &selecting), ABOVE_0))
    },
};
const FASTER_THAN_SELECTING: Test = Test {
    words: "led, “faster” than “those learning to select between policies”",
    measure: "pairs in which leader-follower observes all POIs before all-leaders who choose among behaviours do: over half",
    find: |view| sooner(view.led()?, view.selecting()?),
    ..MORE_THAN_SELECTING
};

/// Counts the pairs in which the first observes all POIs before the second does, or the second never does.
fn sooner(one: Course<'_>, other: Course<'_>) -> Option<Criterion> {
    let (one, other) = (one.solved(END)?, other.solved(END)?);
    let pairs = one.iter().zip(&other);
    let sooner =
        |(one, other): &(&Option<usize>, &Option<usize>)| one.is_some_and(|one| other.is_none_or(|other| one < other));
    Some(Criterion::Share(pairs.filter(sooner).count(), one.len(), MOST))
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
        needs: END,
        sources: &SOURCES,
        find: more_optimal,
    },
    Test {
        place: "Abstract, §5",
        layout: GENERAL,
        words: MUCH_FASTER,
        measure: HALF_THE_TIME,
        needs: END,
        sources: &SOURCES,
        find: much_faster,
    },
    Test {
        place: "Abstract, §5",
        layout: GENERAL,
        words: MORE_RELIABLY,
        measure: ODD_PAIRS,
        needs: END,
        sources: &SOURCES,
        find: more_reliably,
    },
    Test {
        place: "§5.1",
        layout: GENERAL,
        words: "alone, “they struggle to learn to observe all 4 POIs”",
        measure: "all-leaders, trials that ever observe all 4 up to generation 100: under half",
        needs: END,
        sources: ALONE,
        find: |view| Some(Criterion::Share(view.all()?.count_solved(END)?, view.all()?.trials(), [0.0, 0.5])),
    },
    Test {
        place: "§5.1, Fig. 4",
        layout: GENERAL,
        words: "alone, “after 100 generations, they average observing less than a single POI”",
        measure: "all-leaders, POIs at generation 100: under 1",
        needs: END,
        sources: ALONE,
        find: |view| Some(Criterion::Mean(view.all()?.observed(END)?, [f64::NEG_INFINITY, 1.0])),
    },
    Test {
        place: "§5.1",
        layout: GENERAL,
        words: "led, “in fewer than 20 generations, they all observe at least 3, on average”",
        measure: "leader-follower, POIs at generation 19: at least 3",
        needs: 19,
        sources: &SOURCES,
        find: |view| Some(Criterion::Mean(view.led()?.observed(19)?, [3.0, f64::INFINITY])),
    },
    Test {
        place: "§5.1, Fig. 4",
        layout: GENERAL,
        words: "led, “quickly able to learn to observe all of the POIs”",
        measure: "leader-follower, trials that ever observe all 4 up to generation 40: all",
        needs: 40,
        sources: &SOURCES,
        find: |view| Some(Criterion::All(view.led()?.count_solved(40)?, view.led()?.trials())),
    },
    Test {
        place: "§5.1",
        layout: GENERAL,
        words: "led, “they all consistently observe all 4 POIs within 40 generations”",
        measure: "leader-follower, trials that observe all 4 at every generation from 40 to 100: all",
        needs: END,
        sources: &SOURCES,
        find: |view| {
            let led = view.led()?;
            let always = |trial: &&Vec<f64>| trial[40..=END].iter().all(|&g| g >= 1.0);
            Some(Criterion::All(led.best.iter().filter(always).count(), led.trials()))
        },
    },
    Test {
        place: "§5",
        layout: STRICT,
        words: MORE_OPTIMAL,
        measure: MORE_POIS,
        needs: END,
        sources: &SOURCES,
        find: more_optimal,
    },
    Test {
        place: "Abstract, §5",
        layout: STRICT,
        words: MUCH_FASTER,
        measure: HALF_THE_TIME,
        needs: END,
        sources: &SOURCES,
        find: much_faster,
    },
    Test {
        place: "Abstract, §5",
        layout: STRICT,
        words: MORE_RELIABLY,
        measure: ODD_PAIRS,
        needs: END,
        sources: &SOURCES,
        find: more_reliably,
    },
    Test {
        place: "§5.2",
        layout: STRICT,
        words: "alone, “almost never able to learn to obtain any reward using any of the reward functions”",
        measure: "all-leaders, trials that ever observe a POI up to generation 100: under 1 in 10",
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
        words: "alone, failing “is more drastic than in the previous configuration”",
        measure: "all-leaders, share of the POIs at generation 100, less that in generally forward, by pair: below 0",
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
        words: "led, “learning to observe 3 of the 4 POIs on average withing 30 generations”",
        measure: "leader-follower, POIs at generation 30: at least 1.5 of the 2 that this layout has",
        needs: 30,
        sources: &SOURCES,
        find: |view| Some(Criterion::Mean(view.led()?.observed(30)?, [view.pois(0.75), f64::INFINITY])),
    },
    Test {
        place: "§5.2",
        layout: STRICT,
        words: "led, “able to use any of the reward functions to successfully solve the task”",
        measure: "leader-follower, trials that ever observe both POIs up to generation 100: all",
        needs: END,
        sources: &SOURCES,
        find: |view| Some(Criterion::All(view.led()?.count_solved(END)?, view.led()?.trials())),
    },
    Test {
        place: "§5.2",
        layout: STRICT,
        words: "led, “the impact of the various reward structures is not as readily apparent based solely on the \
                average reward”",
        measure: "leader-follower, POIs at generation 100 under one fitness less those under another, by pair: less \
                  than 0.2 apart",
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
        words: "led, under Df “the variance of the performance of the system was significantly higher”",
        measure: "leader-follower, distance of a trial's POIs at generation 100 from the median trial's, Df less the \
                  other, by pair (Brown-Forsythe): above 0",
        needs: END,
        sources: &[G, D],
        find: |view| Some(Criterion::Tested(view.between(DF, view.source, statistics::distances)?, ABOVE_0)),
    },
    Test {
        place: "§5",
        layout: CHAOTIC,
        words: MORE_OPTIMAL,
        measure: MORE_POIS,
        needs: END,
        sources: &SOURCES,
        find: more_optimal,
    },
    Test {
        place: "Abstract, Fig. 6",
        layout: CHAOTIC,
        words: MUCH_FASTER,
        measure: HALF_THE_TIME,
        needs: END,
        sources: &SOURCES,
        find: much_faster,
    },
    Test {
        place: "Abstract, §5",
        layout: CHAOTIC,
        words: MORE_RELIABLY,
        measure: ODD_PAIRS,
        needs: END,
        sources: &SOURCES,
        find: more_reliably,
    },
    Test {
        place: "§5.3",
        layout: CHAOTIC,
        words: "alone, “a high likelihood of random actions successfully causing the agents to observe the POI”",
        measure: "all-leaders, trials in which one of generation 0's random teams observes a POI: over half",
        needs: 0,
        // Before any selection, fitness has no effect.
        sources: &[Source::Random, G],
        find: |view| {
            let all = view.all()?;
            Some(Criterion::Share(all.observed(0)?.iter().filter(|&&pois| pois > 0.0).count(), all.trials(), MOST))
        },
    },
    Test {
        place: "Fig. 6",
        layout: CHAOTIC,
        words: "alone, “able to solve the problem some of the time”",
        measure: "all-leaders, trials that ever observe all 4 up to generation 100: 1 in 10 to 9 in 10",
        needs: END,
        sources: ALONE,
        find: |view| Some(Criterion::Share(view.all()?.count_solved(END)?, view.all()?.trials(), [FEW, 1.0 - FEW])),
    },
    Test {
        place: "§5.3",
        layout: CHAOTIC,
        words: "alone, “a rather large variance in the average policy performance”",
        measure: "all-leaders, mean distance of a trial's POIs at generation 100 from the median trial's: at least 0.5, \
                  as if every second trial were a POI off",
        needs: END,
        sources: ALONE,
        find: |view| Some(Criterion::Mean(statistics::distances(&view.all()?.observed(END)?), [0.5, f64::INFINITY])),
    },
    Test {
        place: "§5.3",
        layout: CHAOTIC,
        words: "led, “the agents learn about a similar policy”",
        measure: "POIs at generation 100, leader-follower less all-leaders, by pair: less than 0.4 apart",
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
        words: "led, “at least a comparable policy”",
        measure: "POIs at generation 100, leader-follower less all-leaders, by pair: above −0.4",
        needs: END,
        sources: &SOURCES,
        find: |view| Some(Criterion::Difference(view.lead()?, [-view.pois(SMALL), f64::INFINITY])),
    },
    Test {
        place: "§5.3, Fig. 6",
        layout: CHAOTIC,
        words: "led, “more consistently” than alone",
        measure: "distance of a trial's POIs at generation 100 from the median trial's, leader-follower less \
                  all-leaders, by pair (Brown-Forsythe): below 0",
        needs: END,
        sources: &SOURCES,
        find: |view| {
            let distances = |course: Course<'_>| Some(statistics::distances(&course.observed(END)?));
            Some(Criterion::Tested(less(&distances(view.led()?)?, &distances(view.all()?)?), BELOW_0))
        },
    },
    Test {
        place: "§5.3",
        layout: CHAOTIC,
        words: "led, “a slight benefit of using the leader-follower trajectory assignment” over the global reward",
        measure: "leader-follower, POIs at generation 100 under Df less those under G, by pair: above 0, under 0.4",
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
        words: "led, the global reward is “enough of a learning signal to direct agent to solve the task”",
        measure: "leader-follower, trials that ever observe all 4 up to generation 100: all",
        needs: END,
        sources: &[Source::Straight, Source::Random, G],
        find: |view| Some(Criterion::All(view.led()?.count_solved(END)?, view.led()?.trials())),
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
        words: "led, “a similarly performant policy”, “even as this ratio of followers to leaders is increased”",
        measure: "POIs at generation 100, leader-follower less all-leaders, by pair: less than 0.2 apart",
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
        words: "led, “faster than when using all learners”, “even as this ratio of followers to leaders is increased”",
        measure: "pairs in which leader-follower observes all POIs before all-leaders do: over half",
        needs: END,
        sources: &SOURCES,
        find: |view| sooner(view.led()?, view.all()?),
    },
];

/// Tests every claim of the paper on these results.
pub fn claims(results: Evidence<'_>) -> Vec<Claim> {
    TESTS.iter().map(|test| test.claim(results)).collect()
}

impl Test {
    /// Returns the same claim for another layout.
    const fn within(self, layout: usize) -> Test {
        Test { layout, ..self }
    }

    fn claim(&self, results: Evidence<'_>) -> Claim {
        let findings = self.sources.iter().filter_map(|&source| self.finding(results, source)).collect();
        let Test { place, layout, words, measure, .. } = *self;
        Claim { place, layout: LAYOUTS[layout].name, words, measure, findings }
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
            Some(Finding { column, of: of.clone(), verdict, measured, estimate: None, p: None })
        };
        if course.best.iter().any(|trial| trial.len() <= self.needs) {
            return without(Verdict::Open, format!("takes {} generations", self.needs));
        }
        if course.trials() < 2 && !course.certain {
            return without(Verdict::Open, "takes 2 trials".into());
        }
        let found = (self.find)(view)?.find(column, of.clone(), course.certain, course.pois as f64);
        found.or_else(|| without(Verdict::Undecided, "no pair differs".into()))
    }
}
