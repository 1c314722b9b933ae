//! The paper's claims, layout by layout, as data: a sentence, what represents it, and the criterion.

use super::{ALMOST_NEVER, BASELINES, Band, Criterion, END, Lookup, SMALL, SOURCES, Source, Test, TrialCurves, less};
use flotilla::statistics;

const ABOVE_0: Band = [f64::MIN_POSITIVE, f64::INFINITY];
const BELOW_0: Band = [f64::NEG_INFINITY, 0.0];
const IN_MOST_TRIALS: Band = [0.5 + f64::EPSILON, f64::INFINITY];

/// Returns a claim about every source on the paper's own experiments, which needs all generations.
const fn claim(
    place: &'static str,
    words: &'static str,
    measure: &'static str,
    find: fn(Lookup<'_>) -> Option<Criterion>,
) -> Test {
    Test { place, words, measure, exploratory: false, needs: END, sources: &SOURCES, find }
}

impl Test {
    const fn at(self, place: &'static str) -> Test {
        Test { place, ..self }
    }

    const fn needs(self, needs: usize) -> Test {
        Test { needs, ..self }
    }

    const fn about(self, sources: &'static [Source]) -> Test {
        Test { sources, ..self }
    }

    /// Marks an experiment that the paper does not describe.
    const fn ours(self) -> Test {
        Test { exploratory: true, ..self }
    }
}

/// The sources for claims about all-leaders teams. Df is omitted because it equals D without followers.
const ALONE: &[Source] = SOURCES.split_at(BASELINES + 2).0;
pub(super) const EVOLVED: &[Source] = SOURCES.split_at(BASELINES).1;
pub(super) const G: Source = EVOLVED[0];
pub(super) const D: Source = EVOLVED[1];
pub(super) const DF: Source = EVOLVED[2];

/// Sources for comparisons with all-leaders teams that choose among behaviours, each with the same fitness. The order
/// must differ from [`EVOLVED`], because [`Test::finding`] treats that slice as comparisons between fitnesses.
const AGAINST_SELECTING: &[Source] = &[DF, D, G];

const GENERAL: usize = 0;
const STRICT: usize = 1;
const CHAOTIC: usize = 2;
const EIGHT: usize = 3;

const SOONER: &str = "generations until all POIs are observed (at most 101), all-leaders' less leader-follower's, by \
                      pair, 0 if neither observes all: above 0. Where a side observes all in fewer than half of its \
                      trials: pairs in which leader-follower is sooner, of those that are no ties: over half";

/// Returns the values that "all POIs" allows for an average: at least a share of 1 - [`SMALL`].
fn nearly_all(view: Lookup<'_>) -> Band {
    [view.pois(1.0 - SMALL), f64::INFINITY]
}

const MORE_OPTIMAL: Test = claim(
    "§5",
    "“a more optimal joint policy”, leader-follower than all-leaders",
    "POIs at generation 100, leader-follower less all-leaders, by pair: above 0",
    |view| Some(Criterion::Difference(view.lead()?, ABOVE_0)),
);
const MUCH_FASTER: Test = claim(
    "Abstract, §5",
    "“much faster”, leader-follower than all-leaders",
    "generations until all POIs are observed (at most 101), half of all-leaders' less leader-follower's, by pair, 0 if \
     neither observes all: above 0. Where a side observes all in fewer than half of its trials: pairs in which \
     leader-follower needs at most half as many, of those that are no ties: over half",
    |view| sooner(view.led()?, view.all()?, 2),
);
const MORE_RELIABLY: Test = claim(
    "Abstract, §5",
    "“more reliably”, leader-follower than all-leaders",
    "of the pairs in which only one observes all POIs at generation 100, leader-follower does in: over half",
    |view| {
        let pois = view.pois(1.0);
        let (led, all) = (view.led()?.observed(END)?, view.all()?.observed(END)?);
        let pairs = || led.iter().zip(&all).map(|(led, all)| (*led >= pois, *all >= pois));
        let odd = pairs().filter(|(led, all)| led != all).count();
        Some(Criterion::Share(pairs().filter(|pair| *pair == (true, false)).count(), odd, IN_MOST_TRIALS))
    },
);

/// Claims about every layout, compared with agents that learn to select between known behaviours.
const MORE_THAN_SELECTING: Test = claim(
    "§1",
    "leader-follower: “a more optimal solution” than “those learning to select between policies”",
    "POIs at generation 100, leader-follower less all-leaders who choose among behaviours, by pair: above 0",
    |view| {
        let (led, selecting) = (view.led()?.observed(END)?, view.selecting()?.observed(END)?);
        Some(Criterion::Difference(less(&led, &selecting), ABOVE_0))
    },
)
.about(AGAINST_SELECTING)
.ours();
const FASTER_THAN_SELECTING: Test =
    claim("§1", "leader-follower: “faster” than “those learning to select between policies”", SOONER, |view| {
        sooner(view.led()?, view.selecting()?, 1)
    })
    .about(AGAINST_SELECTING)
    .ours();

/// Compares the generations until all POIs are observed: those of the second, divided by a factor, less those of the
/// first. A trial that never observes all counts as [`END`] + 1, and a pair in which neither does is a tie.
///
/// If a side observes all in fewer than half of its trials, most of its times are censored. The sign test then replaces
/// the mean.
fn sooner(one: TrialCurves<'_>, other: TrialCurves<'_>, factor: usize) -> Option<Criterion> {
    let (one, other) = (one.solved(END)?, other.solved(END)?);
    let censored = |times: &[Option<usize>]| 2 * times.iter().flatten().count() < times.len();
    let time = |solved: Option<usize>| solved.unwrap_or(END + 1);
    let pairs = || one.iter().copied().zip(other.iter().copied());
    if censored(&one) || censored(&other) {
        let untied = pairs().filter(|(one, other)| one != other);
        let sooner = untied.clone().filter(|&(one, other)| one.is_some() && factor * time(one) <= time(other));
        return Some(Criterion::Share(sooner.count(), untied.count(), IN_MOST_TRIALS));
    }
    let less = |(one, other): (Option<usize>, Option<usize>)| match one.or(other) {
        None => 0.0,
        Some(_) => time(other) as f64 / factor as f64 - time(one) as f64,
    };
    Some(Criterion::Generations(pairs().map(less).collect(), ABOVE_0))
}

/// Returns the fitness that a fitness is compared with, so that every pair of fitnesses occurs once.
pub(super) fn next(source: Source) -> Source {
    match source {
        G => D,
        D => DF,
        _ => G,
    }
}

/// The claims about each layout, in the paper's order.
pub(super) const TESTS: &[(usize, &[Test])] = &[
    (
        GENERAL,
        &[
            MORE_OPTIMAL,
            MUCH_FASTER,
            MORE_RELIABLY,
            claim(
                "§5.1",
                "all-leaders: “they struggle to learn to observe all 4 POIs”",
                "all-leaders, trials that ever observe all 4 up to generation 100: under half",
                |view| Some(Criterion::Share(view.all()?.count_solved(END)?, view.all()?.trials(), [0.0, 0.5])),
            )
            .about(ALONE),
            claim(
                "§5.1, Fig. 4",
                "all-leaders: “after 100 generations, they average observing less than a single POI”",
                "all-leaders, POIs at generation 100: under 1",
                |view| Some(Criterion::Mean(view.all()?.observed(END)?, [f64::NEG_INFINITY, 1.0])),
            )
            .about(ALONE),
            claim(
                "§5.1",
                "leader-follower: “in fewer than 20 generations, they all observe at least 3, on average”",
                "leader-follower, POIs at generation 19: at least 3",
                |view| Some(Criterion::Mean(view.led()?.observed(19)?, [3.0, f64::INFINITY])),
            )
            .needs(19),
            claim(
                "§5.1, Fig. 4",
                "leader-follower: “quickly able to learn to observe all of the POIs”",
                "leader-follower, POIs at generation 40: at least 3.6",
                |view| Some(Criterion::Mean(view.led()?.observed(40)?, nearly_all(view))),
            )
            .needs(40),
            claim(
                "§5.1",
                "leader-follower: “they all consistently observe all 4 POIs within 40 generations”",
                "leader-follower, POIs in the mean over generations 40 to 100: at least 3.6",
                |view| {
                    let led = view.led()?;
                    let mean =
                        |trial: &Vec<f64>| trial[40..=END].iter().sum::<f64>() / (END - 39) as f64 * led.pois as f64;
                    Some(Criterion::Mean(led.champion.iter().map(mean).collect(), nearly_all(view)))
                },
            ),
        ],
    ),
    (
        STRICT,
        &[
            MORE_OPTIMAL,
            MUCH_FASTER,
            MORE_RELIABLY,
            claim(
                "§5.2",
                "all-leaders: “almost never able to learn to obtain any reward using any of the reward functions”",
                "all-leaders, trials that ever observe a POI up to generation 100: under 1 in 10",
                |view| {
                    let all = view.all()?;
                    let any = all.observed_by(END)?.iter().filter(|&&pois| pois > 0.0).count();
                    Some(Criterion::Share(any, all.trials(), [0.0, ALMOST_NEVER]))
                },
            )
            .about(ALONE),
            claim(
                "Fig. 5",
                "all-leaders: failing “is more drastic than in the previous configuration”",
                "all-leaders, share of the POIs at generation 100, less that in generally forward, by pair: below 0",
                |view| {
                    let share = |view: Lookup<'_>| {
                        let all = view.all()?;
                        Some(all.observed(END)?.iter().map(|pois| pois / all.pois as f64).collect::<Vec<_>>())
                    };
                    Some(Criterion::Shares(less(&share(view)?, &share(Lookup { layout: GENERAL, ..view })?), BELOW_0))
                },
            )
            .about(ALONE),
            claim(
                "Fig. 5",
                "leader-follower: “learning to observe 3 of the 4 POIs on average withing 30 generations”",
                "leader-follower, POIs at generation 30: at least 1.5 of the 2 that this layout has",
                |view| Some(Criterion::Mean(view.led()?.observed(30)?, [view.pois(0.75), f64::INFINITY])),
            )
            .needs(30),
            claim(
                "§5.2",
                "leader-follower: “able to use any of the reward functions to successfully solve the task”",
                "leader-follower, POIs at generation 100: at least 1.8",
                |view| Some(Criterion::Mean(view.led()?.observed(END)?, nearly_all(view))),
            ),
            claim(
                "§5.2",
                "leader-follower: “the impact of the various reward structures is not as readily apparent based \
                 solely on the average reward”",
                "leader-follower, POIs at generation 100 under one fitness less those under another, by pair: less \
                  than 0.2 apart",
                |view| {
                    let margin = view.pois(SMALL);
                    let differences = view.between(view.source, next(view.source), <[f64]>::to_vec)?;
                    Some(Criterion::Difference(differences, [-margin, margin]))
                },
            )
            .about(EVOLVED),
            claim(
                "§5.2",
                "leader-follower: under Df “the variance of the performance of the system was significantly higher”",
                "leader-follower, distance of a trial's POIs at generation 100 from the median trial's, Df less the \
                  other, by pair (Brown-Forsythe): above 0",
                |view| Some(Criterion::Difference(view.between(DF, view.source, statistics::distances)?, ABOVE_0)),
            )
            .about(&[G, D]),
        ],
    ),
    (
        CHAOTIC,
        &[
            MORE_OPTIMAL,
            MUCH_FASTER.at("Abstract, Fig. 6"),
            MORE_RELIABLY,
            // Before any selection, fitness has no effect.
            claim(
                "§5.3",
                "all-leaders: “a high likelihood of random actions successfully causing the agents to observe the POI”",
                "all-leaders, trials in which one of generation 0's random teams observes a POI: over half",
                |view| {
                    let all = view.all()?;
                    Some(Criterion::Share(
                        all.of_best().observed(0)?.iter().filter(|&&pois| pois > 0.0).count(),
                        all.trials(),
                        IN_MOST_TRIALS,
                    ))
                },
            )
            .needs(0)
            .about(&[Source::Actions, Source::Random, G]),
            claim(
                "Fig. 6",
                "all-leaders: “able to solve the problem some of the time”",
                "all-leaders, trials that ever observe all 4 up to generation 100: 1 in 10 to 9 in 10",
                |view| {
                    Some(Criterion::Share(
                        view.all()?.count_solved(END)?,
                        view.all()?.trials(),
                        [ALMOST_NEVER, 1.0 - ALMOST_NEVER],
                    ))
                },
            )
            .about(ALONE),
            claim(
                "§5.3",
                "all-leaders: “a rather large variance in the average policy performance”",
                "all-leaders, mean distance of a trial's POIs at generation 100 from the median trial's: at least 0.5, \
                  as if every second trial were a POI off",
                |view| Some(Criterion::Mean(statistics::distances(&view.all()?.observed(END)?), [0.5, f64::INFINITY])),
            )
            .about(ALONE),
            claim(
                "§5.3",
                "leader-follower: “the agents learn about a similar policy”",
                "POIs at generation 100, leader-follower less all-leaders, by pair: less than 0.4 apart",
                |view| {
                    let margin = view.pois(SMALL);
                    Some(Criterion::Difference(view.lead()?, [-margin, margin]))
                },
            ),
            claim(
                "Fig. 6",
                "leader-follower: “at least a comparable policy”",
                "POIs at generation 100, leader-follower less all-leaders, by pair: above −0.4",
                |view| Some(Criterion::Difference(view.lead()?, [-view.pois(SMALL), f64::INFINITY])),
            ),
            claim(
                "§5.3, Fig. 6",
                "leader-follower: “more consistently” than all-leaders",
                "distance of a trial's POIs at generation 100 from the median trial's, leader-follower less \
                  all-leaders, by pair (Brown-Forsythe): below 0",
                |view| {
                    let distances = |curves: TrialCurves<'_>| Some(statistics::distances(&curves.observed(END)?));
                    Some(Criterion::Difference(less(&distances(view.led()?)?, &distances(view.all()?)?), BELOW_0))
                },
            ),
            claim(
                "§5.3",
                "leader-follower: “a slight benefit of using the leader-follower trajectory assignment” over the \
                 global reward",
                "leader-follower, POIs at generation 100 under Df less those under G, by pair: above 0, under 0.4",
                |view| {
                    let differences = view.between(DF, view.source, <[f64]>::to_vec)?;
                    Some(Criterion::Difference(differences, [f64::MIN_POSITIVE, view.pois(SMALL)]))
                },
            )
            .about(&[G]),
            claim(
                "§5.3",
                "leader-follower: the global reward is “enough of a learning signal to direct agent to solve the task”",
                "leader-follower, POIs at generation 100: at least 3.6",
                |view| Some(Criterion::Mean(view.led()?.observed(END)?, nearly_all(view))),
            )
            .about(&[SOURCES[0], SOURCES[1], SOURCES[2], G]),
        ],
    ),
    (GENERAL, &[MORE_THAN_SELECTING, FASTER_THAN_SELECTING]),
    (STRICT, &[MORE_THAN_SELECTING, FASTER_THAN_SELECTING]),
    (CHAOTIC, &[MORE_THAN_SELECTING, FASTER_THAN_SELECTING]),
    (
        EIGHT,
        &[
            claim(
                "§6",
                "leader-follower: “a similarly performant policy”, “even as this ratio of followers to leaders is \
                 increased”",
                "POIs at generation 100, leader-follower less all-leaders, by pair: less than 0.2 apart",
                |view| {
                    let margin = view.pois(SMALL);
                    Some(Criterion::Difference(view.lead()?, [-margin, margin]))
                },
            )
            .ours(),
            claim(
                "§6",
                "leader-follower: “faster than when using all learners”, “even as this ratio of followers to leaders \
                 is increased”",
                SOONER,
                |view| sooner(view.led()?, view.all()?, 1),
            )
            .ours(),
        ],
    ),
];
