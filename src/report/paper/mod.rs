//! The paper's experiments, its figures 4 to 6, and what it claims of them.
//!
//! | module | holds |
//! |---|---|
//! | this | the experiments, what came out of them, and the figures |
//! | [`claims`] | every sentence of the paper that can be measured on them, with its measure and verdict |
//! | [`tables`] | what came out, as text: what needs no learning first |

use serde::Serialize;

use super::curves::{Curve, Figure, Panel};
use crate::baseline::Baseline;
use crate::config::{Config, ConfigError, Fitness, Override, Paradigm};
use crate::model::policy::Actions;
use crate::statistics::Average;
use crate::trainer::Row;

pub mod claims;
pub mod tables;

/// A layout of the paper's section 4.4, or one that its conclusion speaks of.
#[derive(Clone, Copy, Debug)]
pub struct Layout {
    /// As the paper calls it.
    pub name: &'static str,
    /// The paper's figure with its results, if it shows any.
    pub figure: Option<usize>,
    config: &'static str,
}

/// The paper's layouts, in its order, and one with more followers to a leader than any of them.
pub const LAYOUTS: [Layout; 4] = [
    Layout {
        name: "generally forward",
        figure: Some(4),
        config: include_str!("../../../configs/generally_forward.toml"),
    },
    Layout {
        name: "strictly forward",
        figure: Some(5),
        config: include_str!("../../../configs/strictly_forward.toml"),
    },
    Layout { name: "chaotic", figure: Some(6), config: include_str!("../../../configs/chaotic.toml") },
    Layout {
        name: "eight followers",
        figure: None,
        config: include_str!("../../../configs/questions/eight_followers.toml"),
    },
];
/// Panels (a) and (b) of each figure.
pub const PARADIGMS: [Paradigm; 2] = [Paradigm::AllLeaders, Paradigm::LeaderFollower];
/// One curve each.
pub const FITNESSES: [Fitness; 3] = [Fitness::G, Fitness::D, Fitness::Df];

/// One experiment: a curve of one of the figures, or what these are held against.
#[derive(Clone, Debug)]
pub struct Experiment {
    /// Where it is played.
    pub layout: Layout,
    /// Who learns.
    pub paradigm: Paradigm,
    /// Whether its agents learn to choose among known behaviours.
    pub selects: bool,
    /// By which score.
    pub fitness: Fitness,
    /// All of it.
    pub config: Config,
    /// G of the best team, `[trials][generations + 1]`.
    pub best: Vec<Vec<f64>>,
}

/// All of the paper's experiments, with some keys changed in each: layouts, in each the paradigms, in each the fitnesses;
/// then, of the layouts that it shows, those "learning to select between policies", where everyone leads.
///
/// # Errors
/// What is wrong with the overrides.
pub fn arms(overrides: &[Override]) -> Result<Vec<Experiment>, ConfigError> {
    let shown = |layout: &Layout| layout.figure.is_some();
    let places = LAYOUTS.into_iter().flat_map(|layout| PARADIGMS.map(|paradigm| (layout, paradigm, false)));
    let rivals = LAYOUTS.into_iter().filter(shown).map(|layout| (layout, Paradigm::AllLeaders, true));
    let mut arms = Vec::new();
    for (layout, paradigm, selects) in places.chain(rivals) {
        for fitness in FITNESSES {
            let folder = if shown(&layout) { "configs" } else { "configs/questions" };
            let name = format!("{folder}/{}.toml", layout.name.replace(' ', "_"));
            let mut config = Config::read(layout.config, &name, &[], overrides)?;
            (config.learning.paradigm, config.learning.fitness) = (paradigm, fitness);
            if selects {
                config.policy.actions = Actions::Behaviours;
            }
            let best = vec![Vec::with_capacity(config.learning.generations + 1); config.learning.trials];
            arms.push(Experiment { layout, paradigm, selects, fitness, config, best });
        }
    }
    Ok(arms)
}

/// The configs to train for all arms, and which of these each arm is: where everyone leads, nobody follows, and Df is D.
pub fn trained(arms: &[Experiment]) -> (Vec<Config>, Vec<usize>) {
    let mut configs: Vec<Config> = Vec::new();
    let place = |arm: &Experiment| {
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

impl Experiment {
    /// Takes in a row; a trial's rows come in order of generations.
    pub fn add(&mut self, row: &Row) {
        self.best[row.trial].push(row.best_g);
    }

    /// "chaotic, all-leaders, Df".
    pub fn name(&self) -> String {
        let behaviours = if self.selects { ", behaviours" } else { "" };
        format!("{}, {}{behaviours}, {}", self.layout.name, self.paradigm, self.fitness)
    }

    /// POIs of its layout.
    pub fn pois(&self) -> usize {
        self.config.world.pois.len()
    }
}

/// The configs to play baselines of, one a layout and paradigm, in their order: fitness has no say in them.
pub fn grounds(arms: &[Experiment]) -> Vec<Config> {
    let firsts = arms.iter().filter(|arm| arm.fitness == FITNESSES[0] && !arm.selects);
    firsts.map(|arm| arm.config.clone()).collect()
}

/// All that came out.
#[derive(Clone, Copy, Debug)]
pub struct Evidence<'a> {
    /// Those of [`arms()`].
    pub arms: &'a [Experiment],
    /// Those of [`grounds`].
    pub baselines: &'a [Baseline],
}

/// What a team's policies come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Source {
    /// All weights are zero: straight ahead at half speed.
    Straight,
    /// The best so far of as many random teams as evolution evaluated.
    Random,
    /// The best of a generation that evolved by this fitness.
    Evolved(Fitness),
}

/// All of them: what needs no learning first.
pub const SOURCES: [Source; 5] = [
    Source::Straight,
    Source::Random,
    Source::Evolved(FITNESSES[0]),
    Source::Evolved(FITNESSES[1]),
    Source::Evolved(FITNESSES[2]),
];

impl std::fmt::Display for Source {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Source::Straight => f.write_str("straight ahead"),
            Source::Random => f.write_str("random teams"),
            Source::Evolved(fitness) => fitness.fmt(f),
        }
    }
}

/// What one source came to in one place.
#[derive(Clone, Copy, Debug)]
pub struct Course<'a> {
    /// G of the best team, `[trials][generations + 1]`.
    pub best: &'a [Vec<f64>],
    /// Of the layout.
    pub pois: usize,
    /// Whether chance has no part in it: every trial is the same.
    pub certain: bool,
}

impl Evidence<'_> {
    /// What a source came to in one of [`LAYOUTS`]; none where there are no such arms.
    pub fn course(&self, layout: usize, paradigm: Paradigm, source: Source) -> Option<Course<'_>> {
        let name = LAYOUTS.get(layout)?.name;
        let is_here = |arm: &&Experiment| (arm.layout.name, arm.paradigm, arm.selects) == (name, paradigm, false);
        let mut here = self.arms.iter().filter(is_here);
        let pois = here.clone().next()?.pois();
        let ground = PARADIGMS.len() * layout + PARADIGMS.iter().position(|&other| other == paradigm)?;
        let best = match source {
            Source::Straight => &self.baselines.get(ground)?.straight,
            Source::Random => &self.baselines.get(ground)?.random,
            Source::Evolved(fitness) => &here.find(|arm| arm.fitness == fitness)?.best,
        };
        // The paper's starts are fixed; where something moves, it hangs on the trial.
        let certain = source == Source::Straight && best.windows(2).all(|pair| pair[0] == pair[1]);
        Some(Course { best, pois, certain })
    }

    /// What agents came to in one of [`LAYOUTS`] that all lead and choose among known behaviours.
    pub fn selecting(&self, layout: usize, fitness: Fitness) -> Option<Course<'_>> {
        let name = LAYOUTS.get(layout)?.name;
        let arm = self.arms.iter().find(|arm| (arm.layout.name, arm.selects, arm.fitness) == (name, true, fitness))?;
        Some(Course { best: &arm.best, pois: arm.pois(), certain: false })
    }
}

impl Course<'_> {
    /// POIs that the best team observed, by trial; none where the run is shorter.
    pub fn observed(&self, generation: usize) -> Option<Vec<f64>> {
        self.best.iter().map(|trial| Some(trial.get(generation)? * self.pois as f64)).collect()
    }

    /// The same for the best team so far.
    pub fn observed_by(&self, generation: usize) -> Option<Vec<f64>> {
        let most = |trial: &Vec<f64>| Some(trial.get(..=generation)?.iter().copied().fold(0.0, f64::max));
        self.best.iter().map(|trial| Some(most(trial)? * self.pois as f64)).collect()
    }

    /// POIs over trials, by generation.
    fn tallies(&self) -> Vec<Average> {
        let mut tallies = vec![Average::default(); self.best.iter().map(Vec::len).max().unwrap_or(0)];
        for trial in self.best {
            tallies.iter_mut().zip(trial).for_each(|(tally, best)| tally.add(best * self.pois as f64));
        }
        tallies
    }

    fn curve(&self) -> Curve {
        Curve::new(&self.tallies())
    }
}

/// A figure of the paper: one panel a paradigm, one curve a fitness, and what needs no learning in grey.
pub fn figure(results: Evidence<'_>, layout: usize) -> Figure {
    let [straight, random, evolved @ ..] = SOURCES;
    let sources = [evolved.as_slice(), &[straight, random]].concat();
    let panel = |(letter, paradigm): (&str, Paradigm)| Panel {
        title: format!("({letter}) {}", title(paradigm)),
        curves: sources
            .iter()
            .filter_map(|&source| results.course(layout, paradigm, source))
            .map(|course| course.curve())
            .enumerate()
            .collect(),
        stages: vec![],
    };
    let pois = |paradigm| results.course(layout, paradigm, evolved[0]).map_or(1.0, |course| course.pois as f64);
    Figure {
        panels: ["a", "b"].into_iter().zip(PARADIGMS).map(panel).collect(),
        legend: evolved.map(|source| source.to_string()).to_vec(),
        references: vec!["straight ahead".into(), "best of as many random teams".into()],
        y_label: "POIs observed".into(),
        y_max: PARADIGMS.into_iter().map(pois).fold(1.0, f64::max),
        shares: false,
        source: None,
        warning: None,
    }
}

fn title(paradigm: Paradigm) -> &'static str {
    match paradigm {
        Paradigm::AllLeaders => "All leaders",
        Paradigm::LeaderFollower => "Leaders and followers",
    }
}

/// Everything measured, for `summary.json`.
#[derive(Serialize)]
pub struct Summary<'a> {
    /// Of the program.
    pub version: &'static str,
    /// What it ran on.
    pub backend: String,
    /// From start to end.
    pub seconds: f64,
    /// Of every experiment.
    pub seed: u64,
    /// Of every experiment.
    pub trials: usize,
    /// Of every experiment.
    pub generations: usize,
    /// Of every arm, and of what needs no learning.
    #[serde(rename = "arms")]
    pub curves: Vec<Trajectory>,
    /// The paper's, checked.
    pub claims: &'a [claims::Claim],
}

/// One curve, in POIs observed by the best team of each generation; of random teams, by the best so far.
#[derive(Serialize)]
pub struct Trajectory {
    /// Its name.
    pub layout: &'static str,
    /// Who learns.
    pub paradigm: Paradigm,
    /// `straight ahead`, `random teams`, or the fitness.
    pub source: String,
    /// Of what evolved.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fitness: Option<Fitness>,
    /// Whether it chose among known behaviours.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub selects: bool,
    /// Of the layout.
    pub pois: usize,
    /// Means and standard errors, by generation.
    #[serde(flatten)]
    pub curve: Curve,
    /// Over trials.
    pub deviation: Vec<f64>,
}

impl Trajectory {
    /// Every curve, by layout, paradigm and source; then of those who choose among behaviours.
    pub fn all(results: Evidence<'_>) -> Vec<Trajectory> {
        let mut all = Vec::new();
        let mut add = |layout: usize, paradigm, source: Source, selects, course: Option<Course<'_>>| {
            let Some(course) = course else { return };
            let fitness = if let Source::Evolved(fitness) = source { Some(fitness) } else { None };
            all.push(Trajectory {
                layout: LAYOUTS[layout].name,
                paradigm,
                source: source.to_string(),
                fitness,
                selects,
                pois: course.pois,
                curve: course.curve(),
                deviation: course.tallies().iter().map(Average::deviation).collect(),
            });
        };
        for layout in 0..LAYOUTS.len() {
            for paradigm in PARADIGMS {
                for source in SOURCES {
                    add(layout, paradigm, source, false, results.course(layout, paradigm, source));
                }
            }
        }
        for layout in 0..LAYOUTS.len() {
            for fitness in FITNESSES {
                let rival = results.selecting(layout, fitness);
                add(layout, Paradigm::AllLeaders, Source::Evolved(fitness), true, rival);
            }
        }
        all
    }
}
