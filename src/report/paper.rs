//! The paper's experiments, its figures 4 to 6, and what it claims of them.

use serde::Serialize;

use super::curves::{Curve, Figure, Panel, Tally};
use crate::config::{Config, ConfigError, Fitness, Override, Paradigm};
use crate::record::metrics::Row;

/// A layout of the paper's section 4.4.
#[derive(Clone, Copy, Debug)]
pub struct Layout {
    pub name: &'static str,
    /// The paper's figure with its results.
    pub figure: usize,
    config: &'static str,
}

/// The paper's layouts, in its order.
pub const LAYOUTS: [Layout; 3] = [
    Layout { name: "generally forward", figure: 4, config: include_str!("../../configs/generally_forward.toml") },
    Layout { name: "strictly forward", figure: 5, config: include_str!("../../configs/strictly_forward.toml") },
    Layout { name: "chaotic", figure: 6, config: include_str!("../../configs/chaotic.toml") },
];
/// Panels (a) and (b) of each figure.
pub const PARADIGMS: [Paradigm; 2] = [Paradigm::AllLeaders, Paradigm::LeaderFollower];
/// One curve each.
pub const FITNESSES: [Fitness; 3] = [Fitness::G, Fitness::D, Fitness::Df];

/// One experiment: a curve of one of the figures.
#[derive(Clone, Debug)]
pub struct Arm {
    pub layout: Layout,
    pub paradigm: Paradigm,
    pub fitness: Fitness,
    pub config: Config,
    /// G of the best team, `[trials][generations + 1]`.
    pub best: Vec<Vec<f64>>,
}

/// All of the paper's experiments, with some keys changed in each: layouts, in each the paradigms, in each the fitnesses.
///
/// # Errors
/// What is wrong with the overrides.
pub fn arms(overrides: &[Override]) -> Result<Vec<Arm>, ConfigError> {
    let mut arms = Vec::new();
    for layout in LAYOUTS {
        for paradigm in PARADIGMS {
            for fitness in FITNESSES {
                let name = format!("configs/{}.toml", layout.name.replace(' ', "_"));
                let mut config = Config::read(layout.config, &name, &[], overrides)?;
                config.learning.paradigm = paradigm;
                config.learning.fitness = fitness;
                let best = vec![Vec::with_capacity(config.learning.generations + 1); config.learning.trials];
                arms.push(Arm { layout, paradigm, fitness, config, best });
            }
        }
    }
    Ok(arms)
}

/// The configs to train for all arms, and which of these each arm is: where everyone leads, nobody follows, and Df is D.
pub fn trained(arms: &[Arm]) -> (Vec<Config>, Vec<usize>) {
    let mut configs: Vec<Config> = Vec::new();
    let place = |arm: &Arm| {
        let mut config = arm.config.clone();
        if (arm.paradigm, arm.fitness) == (Paradigm::AllLeaders, Fitness::Df) {
            config.learning.fitness = Fitness::D;
        }
        configs.iter().position(|other| *other == config).unwrap_or_else(|| {
            configs.push(config);
            configs.len() - 1
        })
    };
    let places = arms.iter().map(place).collect();
    (configs, places)
}

impl Arm {
    /// Takes in a row; a trial's rows come in order of generations.
    pub fn add(&mut self, row: &Row) {
        self.best[row.trial].push(row.best_g);
    }

    /// "chaotic, all-leaders, Df".
    pub fn name(&self) -> String {
        format!("{}, {}, {}", self.layout.name, self.paradigm, self.fitness)
    }

    pub fn pois(&self) -> usize {
        self.config.world.pois.len()
    }

    /// POIs that the best team observed, over trials, by generation.
    fn tallies(&self) -> Vec<Tally> {
        let mut tallies = vec![Tally::default(); self.config.learning.generations + 1];
        for trial in &self.best {
            tallies.iter_mut().zip(trial).for_each(|(tally, best)| tally.add(best * self.pois() as f64));
        }
        tallies
    }
}

/// A figure of the paper: one panel a paradigm, one curve a fitness.
pub fn figure(arms: &[Arm], layout: &Layout) -> Figure {
    let arms: Vec<&Arm> = arms.iter().filter(|arm| arm.layout.figure == layout.figure).collect();
    let panel = |(letter, paradigm): (&str, Paradigm)| Panel {
        title: format!("({letter}) {}", title(paradigm)),
        curves: arms
            .iter()
            .filter(|arm| arm.paradigm == paradigm)
            .map(|arm| (place(arm.fitness), Curve::new(&arm.tallies())))
            .collect(),
    };
    Figure {
        panels: ["a", "b"].into_iter().zip(PARADIGMS).map(panel).collect(),
        legend: FITNESSES.map(|fitness| fitness.to_string()).to_vec(),
        y_label: "POIs observed".into(),
        y_max: arms.iter().map(|arm| arm.pois() as f64).fold(1.0, f64::max),
        ..Figure::default()
    }
}

fn title(paradigm: Paradigm) -> &'static str {
    match paradigm {
        Paradigm::AllLeaders => "All leaders",
        Paradigm::LeaderFollower => "Leaders and followers",
    }
}

/// A fitness's place in legends, so that it looks the same in every figure.
fn place(fitness: Fitness) -> usize {
    FITNESSES.iter().position(|&other| other == fitness).unwrap_or(FITNESSES.len())
}

/// Whether a claim came out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    Yes,
    /// Missed, but by less than two standard errors: more trials would tell.
    Near,
    No,
    /// There are too few generations or trials to tell.
    Open,
}

impl From<bool> for Verdict {
    fn from(holds: bool) -> Verdict {
        if holds { Verdict::Yes } else { Verdict::No }
    }
}

/// What one claim of the paper came to for one fitness.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    pub measured: String,
    pub holds: Verdict,
}

/// One claim of the paper, of the mean over trials of each generation's best team.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Claim {
    pub figure: usize,
    pub layout: &'static str,
    /// What the paper says, with the measure it is held against here.
    pub claim: &'static str,
    /// By fitness, in the order of [`FITNESSES`].
    pub findings: Vec<Finding>,
}

/// The course of one arm, for judging claims.
struct Course {
    /// POIs of the best team over trials, by generation.
    tallies: Vec<Tally>,
    /// The same over trials, the mean of all generations.
    whole: Tally,
    pois: f64,
}

impl Course {
    fn new(arm: &Arm) -> Course {
        let mut whole = Tally::default();
        for trial in &arm.best {
            whole.add(trial.iter().sum::<f64>() / trial.len().max(1) as f64 * arm.pois() as f64);
        }
        Course { tallies: arm.tallies(), whole, pois: arm.pois() as f64 }
    }

    fn last(&self) -> &Tally {
        self.tallies.last().expect("generation 0 is there")
    }

    fn generations(&self) -> usize {
        self.tallies.len() - 1
    }

    /// The highest mean of any generation.
    fn most(&self) -> f64 {
        self.tallies.iter().map(|tally| tally.mean).fold(0.0, f64::max)
    }

    /// The first generation whose mean is at least a number of POIs.
    fn reaches(&self, pois: f64) -> Option<usize> {
        self.tallies.iter().position(|tally| tally.mean >= pois - SLACK)
    }

    /// Holds if a share of the POIs is reached by a generation.
    fn by(&self, share: f64, limit: usize) -> Finding {
        let (pois, reached) = (share * self.pois, self.reaches(share * self.pois));
        if let Some(generation) = reached.filter(|&generation| generation <= limit) {
            return Finding { measured: format!("at generation {generation}"), holds: Verdict::Yes };
        }
        let Some(tally) = self.tallies.get(limit) else {
            return Finding { measured: format!("at most {:.2}", self.most()), holds: Verdict::Open };
        };
        Finding {
            measured: format!("{} at generation {limit}", plus_minus(tally)),
            holds: judge(pois - tally.mean, tally),
        }
    }

    /// Holds, if the run is long enough to tell, where a mean is under a number of POIs.
    fn under(&self, tally: &Tally, pois: f64) -> Finding {
        Finding { measured: plus_minus(tally), holds: self.at_end(judge(tally.mean - pois + 2.0 * SLACK, tally)) }
    }

    /// A verdict on what came out in the end, if that was reached.
    fn at_end(&self, verdict: impl Into<Verdict>) -> Verdict {
        if self.generations() < END { Verdict::Open } else { verdict.into() }
    }

    /// Standard deviation over trials, the mean of the second half of the generations.
    fn spread(&self) -> f64 {
        let half = &self.tallies[self.tallies.len() / 2..];
        half.iter().map(Tally::deviation).sum::<f64>() / half.len() as f64
    }

    /// A verdict on the spread over trials, if there are trials to spread.
    fn of_spread(&self, holds: bool) -> Verdict {
        if self.last().count < 2 { Verdict::Open } else { self.at_end(holds) }
    }
}

/// What sums of tenths may be off by.
const SLACK: f64 = 1e-9;
/// Generations after which the paper judges; fewer leave its claims about the end open.
const END: usize = 100;

/// Whether a mean misses a claim, by so much.
fn judge(miss: f64, mean: &Tally) -> Verdict {
    match miss {
        _ if miss <= SLACK => Verdict::Yes,
        _ if miss <= 2.0 * mean.error() => Verdict::Near,
        _ => Verdict::No,
    }
}

/// `0.60 ± 0.24`.
fn plus_minus(tally: &Tally) -> String {
    format!("{:.2} ± {:.2}", tally.mean, tally.error())
}

/// Every claim of the paper on these experiments, in the order of its figures.
pub fn claims(arms: &[Arm]) -> Vec<Claim> {
    let claim = |layout: &Layout, claim, find: &dyn Fn(&Course, &Course) -> Finding| {
        let course = |paradigm, fitness| {
            let place = (layout.figure, paradigm, fitness);
            arms.iter().find(|arm| (arm.layout.figure, arm.paradigm, arm.fitness) == place).map(Course::new)
        };
        let finding = |f| Some(find(&course(Paradigm::AllLeaders, f)?, &course(Paradigm::LeaderFollower, f)?));
        Claim {
            figure: layout.figure,
            layout: layout.name,
            claim,
            findings: FITNESSES.into_iter().filter_map(finding).collect(),
        }
    };
    let [general, strict, chaotic] = &LAYOUTS;
    vec![
        claim(general, "all-leaders: under 1 POI of 4 after 100 generations", &|all, _| all.under(all.last(), 1.0)),
        claim(general, "leader-follower: 3 POIs within 20 generations", &|_, led| led.by(0.75, 20)),
        claim(general, "leader-follower: 4 POIs (3.8 or more) by about 40 (45 or less)", &|_, led| led.by(0.95, 45)),
        claim(strict, "all-leaders: almost nothing (under 0.2 POIs of 2, mean of all generations)", &|all, _| {
            all.under(&all.whole, 0.2)
        }),
        claim(strict, "leader-follower: 75 % of the POIs within 30 generations", &|_, led| led.by(0.75, 30)),
        claim(chaotic, "all-leaders: some of the time (more than nothing, less than all, at the end)", &|all, _| {
            let mean = all.last().mean;
            Finding { measured: plus_minus(all.last()), holds: all.at_end(mean > 0.0 && mean < all.pois) }
        }),
        claim(chaotic, "all-leaders: a large spread (standard deviation over 0.5 POIs, second half)", &|all, _| {
            Finding { measured: format!("{:.2}", all.spread()), holds: all.of_spread(all.spread() > 0.5) }
        }),
        claim(chaotic, "leader-follower: at least as good at the end", &|all, led| {
            let (mean, other) = (led.last().mean, all.last().mean);
            Finding { measured: format!("{mean:.2} against {other:.2}"), holds: all.at_end(mean >= other - SLACK) }
        }),
        claim(
            chaotic,
            "leader-follower: much sooner (all-leaders' best mean in half the generations or less)",
            &|all, led| {
                let (later, sooner) = (all.reaches(all.most()).unwrap_or(0), led.reaches(all.most()));
                let measured = match sooner {
                    Some(sooner) => format!("generation {sooner} against {later}"),
                    None => format!("never against {later}"),
                };
                Finding { measured, holds: all.at_end(sooner.is_some_and(|sooner| 2 * sooner <= later)) }
            },
        ),
        claim(
            chaotic,
            "leader-follower: more alike (smaller standard deviation over trials, second half)",
            &|all, led| {
                let (spread, other) = (led.spread(), all.spread());
                Finding { measured: format!("{spread:.2} against {other:.2}"), holds: all.of_spread(spread < other) }
            },
        ),
    ]
}

/// The claims as a Markdown table that also reads well as plain text.
pub fn table(claims: &[Claim]) -> String {
    let mut rows = vec![["Figure", "The paper says"].map(String::from).to_vec()];
    rows[0].extend(FITNESSES.iter().map(Fitness::to_string));
    for claim in claims {
        let mut row = vec![claim.figure.to_string(), format!("{}, {}", claim.layout, claim.claim)];
        row.extend(claim.findings.iter().map(|Finding { measured, holds }| match holds {
            Verdict::Yes => format!("yes: {measured}"),
            Verdict::Near => format!("near: {measured}"),
            Verdict::No => format!("NO: {measured}"),
            Verdict::Open => format!("open: {measured}"),
        }));
        rows.push(row);
    }
    let columns = rows[0].len();
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..columns).map(width).collect();
    let line = |row: &[String]| {
        let cells: Vec<String> = row.iter().zip(&widths).map(|(cell, &width)| format!("{cell:width$}")).collect();
        format!("| {} |\n", cells.join(" | "))
    };
    let rule = line(&widths.iter().map(|&width| "-".repeat(width)).collect::<Vec<_>>());
    let (head, body) = (line(&rows[0]), rows[1..].iter().map(|row| line(row)));
    std::iter::once(head).chain([rule]).chain(body).collect()
}

/// How many claims hold, in words.
pub fn count(claims: &[Claim]) -> String {
    let count =
        |verdict| claims.iter().flat_map(|claim| &claim.findings).filter(|found| found.holds == verdict).count();
    let [yes, near, no, open] = [Verdict::Yes, Verdict::Near, Verdict::No, Verdict::Open].map(count);
    let mut text = format!("{yes} of {} claims hold", yes + near + no + open);
    let others = [
        (near, "missed within two standard errors, as \"near\" (more trials would tell)"),
        (no, "missed"),
        (open, "open (100 generations and 2 trials would tell)"),
    ];
    for (count, what) in others.into_iter().filter(|&(count, _)| count > 0) {
        text += &format!(", {count} {} {what}", if count == 1 { "is" } else { "are" });
    }
    text
}

/// Everything measured, for `summary.json`.
#[derive(Serialize)]
pub struct Summary<'a> {
    pub version: &'static str,
    /// What it ran on.
    pub backend: String,
    pub seconds: f64,
    pub seed: u64,
    pub trials: usize,
    pub generations: usize,
    pub arms: Vec<Measured>,
    pub claims: &'a [Claim],
}

/// One arm's curve, in POIs observed by the best team of each generation.
#[derive(Serialize)]
pub struct Measured {
    pub layout: &'static str,
    pub paradigm: Paradigm,
    pub fitness: Fitness,
    pub pois: usize,
    #[serde(flatten)]
    pub curve: Curve,
    /// Over trials.
    pub deviation: Vec<f64>,
}

impl Measured {
    pub fn of(arm: &Arm) -> Measured {
        let tallies = arm.tallies();
        Measured {
            layout: arm.layout.name,
            paradigm: arm.paradigm,
            fitness: arm.fitness,
            pois: arm.pois(),
            curve: Curve::new(&tallies),
            deviation: tallies.iter().map(Tally::deviation).collect(),
        }
    }
}
