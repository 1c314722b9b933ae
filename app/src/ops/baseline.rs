//! Plays teams that do not learn.

use serde::Serialize;
use serde_json::{Value, json};

use super::{BackendSource, ConfigText, Context, Error, ProcessorInfo, check_memory};
use crate::choice::Work;
use flotilla::backend::Backend;
use flotilla::baseline::{self, Baselines, SPEEDS};
use flotilla::config::{Actions, AgentClass, Config, Control, Mobility, Paradigm, ValidConfig};
use flotilla::statistics;

/// A request to play baselines.
#[derive(Clone, Debug)]
pub struct BaselineRequest {
    /// The config.
    pub config: ConfigText,
    /// The config's stage to play in. The world before any stage by default.
    pub stage: Option<usize>,
    /// Independent repetitions of the random baselines.
    pub seeds: u32,
    /// Held-out episodes per team, if starts or POIs vary. As many others choose the team.
    pub episodes: u32,
}

/// Results of baselines, in POIs observed.
#[derive(Clone, Debug, Serialize)]
pub struct BaselineOutcome {
    /// Who learns.
    pub paradigm: Paradigm,
    /// Number of POIs.
    pub pois: usize,
    /// Number of random teams of each kind per seed.
    pub teams: usize,
    /// Number of seeds.
    pub seeds: usize,
    /// Episodes per team.
    pub episodes: u32,
    /// Every constant action.
    pub constants: Vec<Constant>,
    /// The best constant action of each seed.
    pub chosen: Vec<Value>,
    /// The best constant action.
    pub constant: BaselineScore,
    /// The best random constant actions.
    pub action: BaselineScore,
    /// The best random networks.
    pub network: BaselineScore,
    /// The best random networks that all leaders share.
    pub shared: BaselineScore,
    /// Open-loop actions, by hill climbing.
    pub open_loop: BaselineScore,
    /// The best team of networks that hill climbing finds.
    pub hill_climbing: BaselineScore,
    /// The processor.
    #[serde(flatten)]
    pub processor: ProcessorInfo,
    /// The things that the policies choose.
    #[serde(skip)]
    pub choosing: Choosing,
    /// Whether a class that learns moves freely, so that its actions are velocities along x and y.
    #[serde(skip)]
    pub free: bool,
    /// Who learns, for people: the paradigm, or the classes that learn.
    #[serde(skip)]
    pub learners: String,
    /// See [`Config::weighted_by`](flotilla::Config::weighted_by).
    #[serde(skip)]
    pub weighted_by: Option<&'static str>,
    /// Whether starts or POIs move. If they do, some episodes choose a team and others measure it.
    #[serde(skip)]
    pub moves: bool,
}

/// The things that policies choose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Choosing {
    /// Actions or behaviours.
    Moves(Actions),
    /// Agents.
    Agents,
    /// Agents in some classes, and actions or behaviours in others.
    Both(Actions),
}

impl Choosing {
    fn of(config: &Config) -> Choosing {
        let actions = config.policy.actions;
        let chooses = |class: &AgentClass| matches!(class.control, Control::Choose(_));
        let mut learners = config.agents.iter().filter(|class| class.learns());
        match (learners.clone().any(chooses), learners.all(chooses)) {
            (false, _) => Choosing::Moves(actions),
            (true, true) => Choosing::Agents,
            (true, false) => Choosing::Both(actions),
        }
    }

    /// Returns what a constant is, by its index.
    fn constant(self, index: usize, pois: f64) -> Constant {
        let none = Constant { speed: None, behaviour: None, choice: None, pois };
        let choice = Some(index);
        match self {
            Choosing::Agents => Constant { choice, ..none },
            Choosing::Both(actions) => Constant { choice, ..Choosing::Moves(actions).constant(index, pois) },
            Choosing::Moves(Actions::Direct) => {
                Constant { speed: Some((index % SPEEDS + 1) as f64 / SPEEDS as f64), ..none }
            }
            Choosing::Moves(Actions::Behaviours) => {
                Constant { behaviour: Some(index % baseline::constants(Actions::Behaviours).len()), ..none }
            }
        }
    }
}

/// A constant action.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Constant {
    /// The share of the largest speed, if policies choose the speed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub speed: Option<f64>,
    /// The behaviour, if policies choose one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub behaviour: Option<usize>,
    /// The number of the choice, if policies choose agents. Among n agents it counts modulo n + 1: the agent's index, or n
    /// for nobody.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub choice: Option<usize>,
    /// POIs observed, as a mean over seeds.
    pub pois: f64,
}

/// A baseline.
#[derive(Clone, Debug, Serialize)]
pub struct BaselineScore {
    /// The mean over seeds.
    pub mean: f64,
    /// The 95 % interval of the mean. Constant actions have none if nothing moves, because all seeds are the same.
    pub interval_95: Option<[f64; 2]>,
    /// Each seed.
    pub seeds: Vec<f64>,
}

/// Plays the baselines of a config, one repetition after the other.
pub fn run(
    request: &BaselineRequest,
    backends: &mut dyn BackendSource,
    context: Context<'_>,
) -> Result<BaselineOutcome, Error> {
    if request.seeds == 0 {
        return Err(Error::Usage("--seeds 0: allowed 1 or more".into()));
    }
    let config = request.config.in_stage(request.stage, context)?.validate()?;
    let (open, on) = backends.open(Work::of([&*config]))?;
    check_memory([&config], open)?;
    context.message(format_args!("playing on {on}"));
    let outcomes = play(&config, request.seeds as usize, request.episodes, &mut *open.0, context);
    context.pause();
    let outcomes = outcomes?;
    let (learning, pois, choosing) = (&config.learning, config.poi_count(), Choosing::of(&config));
    let moves = config.starts_move() || config.pois_move();
    let observed = |g: &dyn Fn(&baseline::Outcome) -> f64| -> Vec<f64> {
        outcomes.iter().map(|outcome| g(outcome) * pois as f64).collect()
    };
    let mean = |observed: &[f64]| observed.iter().sum::<f64>() / observed.len() as f64;
    let found = |seeds: Vec<f64>, differ: bool| {
        let interval = statistics::bounded(&seeds.iter().collect(), [0.0, pois as f64]).filter(|_| differ);
        BaselineScore { mean: mean(&seeds), interval_95: interval.map(|mean| [mean.low, mean.high]), seeds }
    };
    let constant = |index: usize| choosing.constant(index, mean(&observed(&|outcome| outcome.constants[index])));
    let chosen = |outcome: &baseline::Outcome| match choosing.constant(outcome.best_constant, 0.0) {
        Constant { speed: Some(speed), choice: None, .. } => json!(speed),
        _ => json!(outcome.best_constant),
    };
    let classes = config.agents.iter().filter(|class| class.learns());
    let free = classes.clone().any(|class| matches!(class.motion, Mobility::Free { .. }));
    let classes: Vec<_> = classes.map(|class| format!("{} × {}", class.size(), class.name)).collect();
    Ok(BaselineOutcome {
        learners: if classes.is_empty() { learning.paradigm.to_string() } else { classes.join(", ") },
        weighted_by: config.weighted_by(),
        paradigm: learning.paradigm,
        pois,
        teams: learning.team_count() * (learning.generations + 1),
        seeds: outcomes.len(),
        episodes: if moves { request.episodes } else { 1 },
        constants: (0..outcomes[0].constants.len()).map(constant).collect(),
        chosen: outcomes.iter().map(chosen).collect(),
        constant: found(observed(&|outcome| outcome.constants[outcome.best_constant]), moves),
        action: found(observed(&|outcome| outcome.action), true),
        network: found(observed(&|outcome| outcome.network), true),
        shared: found(observed(&|outcome| outcome.shared), true),
        open_loop: found(observed(&|outcome| outcome.open_loop), true),
        hill_climbing: found(observed(&|outcome| outcome.hill_climbing), true),
        processor: ProcessorInfo::of(&open.1, &open.0.describe()),
        choosing,
        free,
        moves,
    })
}

/// Plays the baselines of a config from several seeds.
pub fn play(
    config: &ValidConfig,
    seeds: usize,
    episodes: u32,
    backend: &mut dyn Backend,
    context: Context<'_>,
) -> Result<Vec<baseline::Outcome>, Error> {
    let generations = config.learning.generations + 1;
    let mut outcomes = Vec::new();
    for seed in 0..seeds {
        let mut baselines = Baselines::of_trial(config, seed);
        while !baselines.is_done() {
            baselines.advance(backend)?;
            let done = seed * generations + baselines.generation();
            let part = done as f64 / (seeds * generations) as f64;
            context.fraction(part, format!("playing random teams of seed {seed}"));
            context.check_not_stopped()?;
        }
        outcomes.extend(baselines.outcomes(backend, episodes)?.concat());
    }
    Ok(outcomes)
}
