//! The paper's experiments, its figures 4 to 6, and its claims about them.
//!
//! | module | contents |
//! |---|---|
//! | this | the experiments, their results, and the figures |
//! | [`claims`] | every measurable sentence of the paper about them, with its measure and verdict |
//! | [`tables`] | the results as text, those without learning first |

use serde::Serialize;

use flotilla::baseline::Baseline;
use flotilla::config::{self, Config, ConfigError, Fitness, Override, Paradigm, Problem};
use flotilla::model::policy::Actions;
use flotilla::statistics::Average;
use flotilla::trainer::Row;
use flotilla_app::report::curves::{Curve, Figure, Panel};

pub mod claims;
pub mod run;
pub mod tables;

/// A layout of the paper's section 4.4 or of its conclusion.
#[derive(Clone, Copy, Debug)]
pub struct Layout {
    /// The paper's name for the layout.
    pub name: &'static str,
    /// The paper's figure with its results, if it shows any.
    pub figure: Option<usize>,
    config: &'static str,
}

/// The paper's layouts in its order, and one with more followers per leader than any of them.
pub const LAYOUTS: [Layout; 4] = [
    Layout { name: "generally forward", figure: Some(4), config: config::LAYOUTS[0].1 },
    Layout { name: "strictly forward", figure: Some(5), config: config::LAYOUTS[1].1 },
    Layout { name: "chaotic", figure: Some(6), config: config::LAYOUTS[2].1 },
    Layout {
        name: "eight followers",
        figure: None,
        config: include_str!("../../configs/questions/eight_followers.toml"),
    },
];
/// The paradigms, one panel per figure: (a) and (b).
pub(crate) const PARADIGMS: [Paradigm; 2] = [Paradigm::AllLeaders, Paradigm::LeaderFollower];
/// The fitnesses, one curve per panel.
pub const FITNESSES: [Fitness; 3] = [Fitness::G, Fitness::D, Fitness::Df];

/// One experiment: a curve of a figure, or a comparison for one.
#[derive(Clone, Debug)]
pub struct Experiment {
    pub layout: Layout,
    pub paradigm: Paradigm,
    /// Whether policies choose among known behaviours.
    pub selects: bool,
    pub fitness: Fitness,
    pub config: Config,
    /// G of the champion, the team of every population's best policy, `[trials][generations + 1]`.
    pub champion: Vec<Vec<f64>>,
    /// G of the best team, `[trials][generations + 1]`.
    pub best: Vec<Vec<f64>>,
}

/// The keys that the experiments fix. Stages could change the fitness.
const FIXED: [&str; 4] = ["learning.paradigm", "learning.fitness", "policy.actions", "stages"];

/// Returns all experiments of the paper, with some keys changed in each.
///
/// The order is by layout, then paradigm, then fitness. The experiments that "learn to select between policies" follow.
/// They are all-leaders, on the layouts of the paper's figures.
///
/// # Errors
/// An override is invalid, or sets a key that the experiments fix.
pub fn arms(overrides: &[Override]) -> Result<Vec<Experiment>, ConfigError> {
    check_fixed(overrides, &FIXED, "the paper's experiments")?;
    let shown = |layout: &Layout| layout.figure.is_some();
    let places = LAYOUTS.into_iter().flat_map(|layout| PARADIGMS.map(|paradigm| (layout, paradigm, false)));
    let rivals = LAYOUTS.into_iter().filter(shown).map(|layout| (layout, Paradigm::AllLeaders, true));
    let mut arms = Vec::new();
    for (layout, paradigm, selects) in places.chain(rivals) {
        for fitness in FITNESSES {
            let folder = if shown(&layout) { "configs" } else { "studies/configs/questions" };
            let name = format!("{folder}/{}.toml", layout.name.replace(' ', "_"));
            let mut config = Config::read(layout.config, &name, &[], overrides)?;
            (config.learning.paradigm, config.learning.fitness) = (paradigm, fitness);
            if selects {
                config.policy.actions = Actions::Behaviours;
            }
            let none = vec![Vec::with_capacity(config.learning.generations + 1); config.learning.trials];
            arms.push(Experiment { layout, paradigm, selects, fitness, config, champion: none.clone(), best: none });
        }
    }
    Ok(arms)
}

/// Fails if an override sets a key that some experiments fix. `experiments` names them in the error.
pub(crate) fn check_fixed(overrides: &[Override], fixed: &[&str], experiments: &str) -> Result<(), ConfigError> {
    let message = format!("{experiments} fix this key: leave it out");
    let set = overrides.iter().filter(|set| fixed.contains(&set.key.as_str()));
    let problems: Vec<_> =
        set.map(|set| Problem { line: None, key: set.name.clone(), message: message.clone() }).collect();
    match problems.is_empty() {
        true => Ok(()),
        false => Err(ConfigError::Invalid { name: experiments.into(), problems, unlisted: 0 }),
    }
}

/// Returns the configs to train, and for each arm the index of its config. All-leaders with Df share the training with
/// D, because Df equals D without followers.
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
    /// Adds a row. The rows of a trial must come in order of generations.
    pub fn add(&mut self, row: &Row) {
        self.champion[row.trial].push(row.champion_g);
        self.best[row.trial].push(row.best_g);
    }

    /// Returns a name like "chaotic, all-leaders, Df".
    pub fn name(&self) -> String {
        let behaviours = if self.selects { ", behaviours" } else { "" };
        format!("{}, {}{behaviours}, {}", self.layout.name, self.paradigm, self.fitness)
    }

    /// Returns the number of POIs of the layout.
    pub fn pois(&self) -> usize {
        self.config.poi_count()
    }
}

/// Returns the configs to play baselines of, one per layout and paradigm. The fitness does not matter for them.
pub fn baseline_configs(arms: &[Experiment]) -> Vec<Config> {
    let firsts = arms.iter().filter(|arm| arm.fitness == FITNESSES[0] && !arm.selects);
    firsts.map(|arm| arm.config.clone()).collect()
}

#[derive(Clone, Copy, Debug)]
pub struct Evidence<'a> {
    /// The experiments of [`arms()`], with their results.
    pub arms: &'a [Experiment],
    /// The baselines of [`baseline_configs`].
    pub baselines: &'a [Baseline],
}

/// The source of a team's policies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Source {
    /// The best constant speed, straight ahead.
    Constant,
    /// The best so far of as many random constant actions as evolution evaluated teams.
    Actions,
    /// The best so far of as many random networks as evolution evaluated teams.
    Random,
    /// The same for random networks that all leaders share.
    Shared,
    /// Open-loop actions, by hill climbing with as many teams.
    OpenLoop,
    /// The best team of networks that hill climbing finds with as many teams.
    HillClimbing,
    /// Teams that evolved with this fitness.
    Evolved(Fitness),
}

/// Number of baselines among [`SOURCES`].
pub(crate) const BASELINES: usize = 6;
/// All sources, the baselines first.
pub const SOURCES: [Source; BASELINES + FITNESSES.len()] = [
    Source::Constant,
    Source::Actions,
    Source::Random,
    Source::Shared,
    Source::OpenLoop,
    Source::HillClimbing,
    Source::Evolved(FITNESSES[0]),
    Source::Evolved(FITNESSES[1]),
    Source::Evolved(FITNESSES[2]),
];

impl std::fmt::Display for Source {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Source::Constant => f.write_str("constant speed"),
            Source::Actions => f.write_str("constant actions"),
            Source::Random => f.write_str("random networks"),
            Source::Shared => f.write_str("shared random networks"),
            Source::OpenLoop => f.write_str("open-loop actions"),
            Source::HillClimbing => f.write_str("hill climbing"),
            Source::Evolved(fitness) => fitness.fmt(f),
        }
    }
}

/// The results of one source for one layout and paradigm.
#[derive(Clone, Copy, Debug)]
pub struct TrialCurves<'a> {
    /// G of the champion, `[trials][generations + 1]`. For baselines, the same as `best`.
    pub champion: &'a [Vec<f64>],
    /// G of the best team, `[trials][generations + 1]`.
    pub best: &'a [Vec<f64>],
    /// Number of POIs of the layout.
    pub pois: usize,
    /// Whether chance does not matter, because all trials are the same.
    pub certain: bool,
}

impl Evidence<'_> {
    /// Returns the results of a source on one of [`LAYOUTS`]. None if there are no such arms.
    pub fn curves(&self, layout: usize, paradigm: Paradigm, source: Source) -> Option<TrialCurves<'_>> {
        let name = LAYOUTS.get(layout)?.name;
        let is_here = |arm: &&Experiment| (arm.layout.name, arm.paradigm, arm.selects) == (name, paradigm, false);
        let mut here = self.arms.iter().filter(is_here);
        let pois = here.clone().next()?.pois();
        let index = PARADIGMS.len() * layout + PARADIGMS.iter().position(|&other| other == paradigm)?;
        let baseline = self.baselines.get(index);
        let (champion, best) = match source {
            Source::Constant => (&baseline?.constant, &baseline?.constant),
            Source::Actions => (&baseline?.actions, &baseline?.actions),
            Source::Random => (&baseline?.random, &baseline?.random),
            Source::Shared => (&baseline?.shared, &baseline?.shared),
            Source::OpenLoop => (&baseline?.open_loop, &baseline?.open_loop),
            Source::HillClimbing => (&baseline?.hill_climbing, &baseline?.hill_climbing),
            Source::Evolved(fitness) => {
                here.find(|arm| arm.fitness == fitness).map(|arm| (&arm.champion, &arm.best))?
            }
        };
        // The paper's starts are fixed. If starts or POIs move, results depend on the trial.
        let certain = source == Source::Constant && best.windows(2).all(|pair| pair[0] == pair[1]);
        Some(TrialCurves { champion, best, pois, certain })
    }

    /// Returns the results of all-leaders teams on one of [`LAYOUTS`] that choose among known behaviours.
    pub(crate) fn selecting(&self, layout: usize, fitness: Fitness) -> Option<TrialCurves<'_>> {
        let name = LAYOUTS.get(layout)?.name;
        let arm = self.arms.iter().find(|arm| (arm.layout.name, arm.selects, arm.fitness) == (name, true, fitness))?;
        Some(TrialCurves { champion: &arm.champion, best: &arm.best, pois: arm.pois(), certain: false })
    }
}

impl TrialCurves<'_> {
    /// Returns the POIs that the champion observed, per trial. None if the run is shorter.
    pub fn observed(&self, generation: usize) -> Option<Vec<f64>> {
        self.champion.iter().map(|trial| Some(trial.get(generation)? * self.pois as f64)).collect()
    }

    /// Returns the most POIs that champions observed so far, per trial. None if the run is shorter.
    pub(crate) fn observed_by(&self, generation: usize) -> Option<Vec<f64>> {
        let most = |trial: &Vec<f64>| Some(trial.get(..=generation)?.iter().copied().fold(0.0, f64::max));
        self.champion.iter().map(|trial| Some(most(trial)? * self.pois as f64)).collect()
    }

    /// Returns these curves with the best team in place of the champion.
    pub(crate) fn of_best(self) -> Self {
        TrialCurves { champion: self.best, ..self }
    }

    /// Averages the champion's POIs over trials, per generation.
    fn tallies(&self) -> Vec<Average> {
        let mut tallies = vec![Average::default(); self.champion.iter().map(Vec::len).max().unwrap_or(0)];
        for trial in self.champion {
            tallies.iter_mut().zip(trial).for_each(|(tally, best)| tally.add(best * self.pois as f64));
        }
        tallies
    }

    fn curve(&self) -> Curve {
        Curve::new(&self.tallies(), self.pois as f64)
    }
}

/// Returns a figure of the paper: one panel per paradigm, one curve per fitness, and the baselines without learning in
/// grey.
pub fn figure(results: Evidence<'_>, layout: usize) -> Figure {
    let (_, evolved) = SOURCES.split_at(BASELINES);
    let sources = [evolved, &[Source::Constant, Source::Shared]].concat();
    let panel = |(letter, paradigm): (&str, Paradigm)| Panel {
        title: format!("({letter}) {}", title(paradigm)),
        curves: sources
            .iter()
            .filter_map(|&source| results.curves(layout, paradigm, source))
            .map(|curves| curves.curve())
            .enumerate()
            .collect(),
        stages: vec![],
    };
    let pois = |paradigm| results.curves(layout, paradigm, evolved[0]).map_or(1.0, |curves| curves.pois as f64);
    Figure {
        panels: ["a", "b"].into_iter().zip(PARADIGMS).map(panel).collect(),
        legend: evolved.iter().map(Source::to_string).collect(),
        references: vec!["best constant speed".into(), "best of as many shared random networks".into()],
        y_label: "POIs observed by the champion".into(),
        y_max: PARADIGMS.into_iter().map(pois).fold(1.0, f64::max),
        ..Figure::default()
    }
}

fn title(paradigm: Paradigm) -> &'static str {
    match paradigm {
        Paradigm::AllLeaders => "All-leaders teams",
        Paradigm::LeaderFollower => "Leader-follower teams",
    }
}

/// All measurements, for `summary.json`.
#[derive(Serialize)]
pub(crate) struct Summary<'a> {
    /// Version of the program.
    pub version: &'static str,
    /// The backend that played the episodes, "cpu" or "gpu".
    pub backend: String,
    /// Description of the backend.
    pub description: String,
    /// Duration of the whole experiment, in seconds.
    pub seconds: f64,
    /// Random seed of every experiment.
    pub seed: u64,
    /// Number of trials of every experiment.
    pub trials: usize,
    /// Number of generations of every experiment.
    pub generations: usize,
    /// The other keys that were changed, `key = value`.
    pub set: Vec<String>,
    /// The curves of every arm and of the baselines without learning.
    #[serde(rename = "arms")]
    pub curves: Vec<Trajectory>,
    /// The paper's claims with their verdicts.
    pub claims: &'a [claims::Claim],
}

/// One curve: the POIs observed by the champion of each generation. For baselines, by the best team so far.
#[derive(Serialize)]
pub(crate) struct Trajectory {
    pub layout: &'static str,
    pub paradigm: Paradigm,
    /// The name of the baseline, or the fitness.
    pub source: String,
    /// The fitness, for evolved teams only.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fitness: Option<Fitness>,
    /// Whether policies choose among known behaviours.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub selects: bool,
    /// Number of POIs of the layout.
    pub pois: usize,
    /// Means and standard errors, per generation.
    #[serde(flatten)]
    pub curve: Curve,
    /// Standard deviations over trials, per generation.
    pub deviation: Vec<f64>,
    /// Means of the POIs observed by the best of all teams of a generation.
    pub best_mean: Vec<f64>,
}

impl Trajectory {
    /// Returns every curve by layout, paradigm and source. The curves of teams that choose among behaviours follow.
    pub fn all(results: Evidence<'_>) -> Vec<Trajectory> {
        let mut all = Vec::new();
        let mut add = |layout: usize, paradigm, source: Source, selects, curves: Option<TrialCurves<'_>>| {
            let Some(curves) = curves else { return };
            let fitness = if let Source::Evolved(fitness) = source { Some(fitness) } else { None };
            all.push(Trajectory {
                layout: LAYOUTS[layout].name,
                paradigm,
                source: source.to_string(),
                fitness,
                selects,
                pois: curves.pois,
                curve: curves.curve(),
                deviation: curves.tallies().iter().map(Average::deviation).collect(),
                best_mean: curves.of_best().tallies().iter().map(Average::mean).collect(),
            });
        };
        for layout in 0..LAYOUTS.len() {
            for paradigm in PARADIGMS {
                for source in SOURCES {
                    add(layout, paradigm, source, false, results.curves(layout, paradigm, source));
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
