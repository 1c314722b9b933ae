//! Plays teams of policies from a file, and scores every leader.

use std::fs::File;
use std::io::{self, Read, Write};
use std::ops::ControlFlow::{Break, Continue};
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::{BackendSource, ConfigText, Context, Error, ProcessorInfo, output, sweep, with_remedy};
use crate::choice::Work;
use crate::import;
use crate::record::digests::{Digests, Verification};
use crate::record::{RecordError, folder, policies, tensors};
use crate::report::map;
use crate::report::runs::ReadError;
use crate::run::RunError;
use flotilla::backend::{Backend, Group};
use flotilla::config::{self, Config, Learning, Override};
use flotilla::escape::PathExt;
use flotilla::evaluate::{self, Batch, Evaluation, Spread, Starts};
use flotilla::file;
use flotilla::memory;
use flotilla::model::class::Class;
use flotilla::model::classes::Frame;
use flotilla::model::sense::{ChannelConstants, ChannelShape};
use flotilla::parallel;
use flotilla::world::{OUTPUTS, World};
use glam::Vec2;

/// The first columns of scores.
const SCORES: &str = "team,leader,g,d,df,dpp,dt";
/// Columns of a trace. Only agents that learn fill the others: the inputs and outputs of their policies.
const STATES: &str = "team,step,agent,role,x,y,heading_x,heading_y,speed";
/// The inputs of one class that senses POIs and agents by quadrants.
const QUADRANTS: &str = "pois_back_right,pois_front_right,pois_front_left,pois_back_left,\
                         agents_back_right,agents_front_right,agents_front_left,agents_back_left";

/// Returns the columns of what policies sense and answer. The inputs of several classes have numbers.
fn sensed(world: &World) -> String {
    let by_quadrants = |channels: &[ChannelConstants]| {
        let is_quadrants = |channel: &ChannelShape| {
            channel.sectors == 4 && channel.each == 0 && channel.frame == Frame::Heading as u32
        };
        matches!(channels, [pois, agents] if pois.shape.of_pois != 0 && agents.shape.of_pois == 0)
            && channels.iter().all(|channel| is_quadrants(&channel.shape))
    };
    let mut learning = world.classes.iter().map(Class::channels).filter(|channels| !channels.is_empty());
    let inputs = match learning.all(by_quadrants) {
        true => QUADRANTS.into(),
        false => (0..world.inputs()).map(|input| format!("input_{input}")).collect::<Vec<_>>().join(","),
    };
    format!("{inputs},turn_output,speed_output")
}

/// A request to play teams.
#[derive(Clone, Debug)]
pub struct RolloutRequest {
    /// A run's folder, or a config file.
    pub path: PathBuf,
    /// Config keys to set.
    pub set: Vec<Override>,
    /// The file of policies. The run's own by default.
    pub policies: Option<PathBuf>,
    /// The trial whose policies play, if the file has several.
    pub trial: Option<usize>,
    /// The config's stage to play in. The world before any stage by default.
    pub stage: Option<usize>,
    /// A file to write every agent's states to.
    pub trace: Option<PathBuf>,
    /// A file to write every leader's scores to.
    pub scores: Option<PathBuf>,
    /// Whether files that differ from their digests are read.
    pub unverified: bool,
    /// Number of held-out starts. The config's own start by default.
    pub episodes: Option<u32>,
    /// Random seed of held-out starts, 0 by default.
    pub seed: Option<u64>,
}

#[derive(Clone, Debug, Serialize)]
pub struct RolloutOutcome {
    pub teams: usize,
    /// Leaders per team.
    pub leaders: usize,
    pub pois: usize,
    /// The trial whose policies play, if it is known.
    pub trial: Option<usize>,
    /// The config's stage, if it is not the world before any stage.
    pub stage: Option<usize>,
    /// Episodes per team.
    pub episodes: usize,
    /// Random seed of held-out starts.
    pub seed: Option<u64>,
    /// Largest offset of a start.
    pub start_jitter: Option<f64>,
    /// Largest offset of a POI.
    pub poi_jitter: Option<f64>,
    /// POIs that the first team observes.
    pub team_0: Spread,
    /// POIs that the best team observes.
    pub best: Best,
    /// POIs that all teams observe.
    pub mean: Spread,
    /// Whether files were read that differ from their digests.
    pub unverified: bool,
    /// See [`Config::weighted_by`].
    #[serde(skip)]
    pub weighted_by: Option<&'static str>,
    /// Whether starts or POIs are drawn from regions.
    #[serde(skip)]
    pub is_drawn: bool,
    #[serde(flatten)]
    pub processor: ProcessorInfo,
}

/// The best team.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Best {
    /// Number of the team.
    pub team: usize,
    /// POIs that it observes.
    #[serde(flatten)]
    pub spread: Spread,
}

impl RolloutRequest {
    /// Returns where episodes of a config start. Without own starts, an episode is drawn.
    fn starts(&self, config: &Config) -> Result<Starts, Error> {
        let Learning { start_jitter: jitter, poi_jitter, .. } = config.learning;
        let episodes = self.episodes.or(config.draws_starts().then_some(1));
        let (Some(episodes), seed) = (episodes, self.seed.unwrap_or(0)) else { return Ok(Starts::Own) };
        if !config.starts_move() && !config.pois_move() && (episodes > 1 || self.seed.is_some()) {
            return Err(Error::Usage(with_remedy(
                format!("--episodes {episodes}: learning.start_jitter is 0, so all episodes are the same"),
                "set it or learning.poi_jitter in the config, or give --start-jitter or --poi-jitter",
            )));
        }
        Ok(Starts::Drawn { episodes, seed, jitter, poi_jitter })
    }
}

/// Plays the teams. Team j consists of policy j of every leader.
pub fn run(
    request: &RolloutRequest,
    backends: &mut dyn BackendSource,
    context: Context<'_>,
) -> Result<RolloutOutcome, Error> {
    let path = &request.path;
    let (config_path, trained) = match path.is_dir() {
        true => {
            sweep::config_of_run(path, Verification::unless(request.unverified))?;
            let policies = path.join(folder::POLICIES);
            if request.policies.is_none() && !policies.exists() {
                let reason = format!("it has no {} yet", folder::POLICIES);
                return Err(ReadError::Unfinished { folder: path.clone(), reason }.into());
            }
            (path.join(folder::CONFIG), Some(policies))
        }
        false if file::is_zip(path) => return Err(ReadError::NoFolder(path.clone()).into()),
        false => (path.clone(), None),
    };
    let Some(policies) = request.policies.clone().or(trained) else {
        if !config::is_standard_input(path) {
            import::read_file(path)?;
        }
        return Err(Error::Usage(with_remedy(
            "--policies: a config file needs a file of policies",
            format!("or name a run's folder in place of {}", request.path.escaped()),
        )));
    };
    let outputs = [("--scores", request.scores.as_deref()), ("--trace", request.trace.as_deref())];
    output::check(&outputs, &[&config_path, &policies])?;
    for (flag, path) in outputs {
        let Some(path) = path.filter(|path| path.is_file()) else { continue };
        let mut start = vec![];
        let read = File::open(path).and_then(|file| file.take(STATES.len() as u64).read_to_end(&mut start));
        read.map_err(RecordError::read(path))?;
        if !start.is_empty() && ![SCORES, STATES].iter().any(|columns| start.starts_with(columns.as_bytes())) {
            return Err(Error::Usage(with_remedy(
                format!("{flag} {}: this file has neither scores nor a trace", path.escaped()),
                "move it away, or name another to write",
            )));
        }
    }
    let (text, name) = (import::read_file(&config_path)?, config::name(&config_path));
    let config = ConfigText { text, name, set: request.set.clone() }.in_stage(request.stage, context)?;
    let starts = request.starts(&config)?;
    // A run's file has the policies of all trials.
    let trial = request.trial.or(request.policies.is_none().then_some(0));
    if request.trial.is_none() && trial.is_some() && config.learning.trials > 1 {
        let trials = config.learning.trials;
        context.note(format_args!("note: this plays trial 0 of {trials}; --trial N plays another"));
    }
    verify(&config_path, &policies, request.unverified)?;
    let policies = policies::read(&policies, &config, request.trial)?;
    let world = World::new(&config.validate()?);
    let work = Work::of_teams(&config, policies.policies * request.episodes.unwrap_or(1) as usize);
    let ((backend, machine), on) = backends.open(work)?;
    context.message(format_args!("playing on {on}"));
    let teams = evaluate::aligned_teams(policies.policies, world.leaders());
    let group = Group {
        // The config may be that of another layout, so the file decides which leaders share a policy.
        populations: &policies.populations,
        fitnesses: if request.scores.is_some() { evaluate::SCORES_AND_DT } else { evaluate::SCORES },
        ..Group::new(&world, &policies.weights[..], policies.policies, &teams)
    };
    let playing = format!("playing {}", counted(policies.policies, starts.episodes()));
    let each = &mut |batch: Batch<'_>| {
        context.fraction(batch.share, &playing);
        if context.is_stopped() { Break(()) } else { Continue(()) }
    };
    let threads = parallel::current_num_threads();
    memory::check_rollout(&world, group.fitnesses, threads, 0).map_err(RunError::from)?;
    let evaluation = evaluate::evaluate(&mut **backend, &group, &starts, each);
    context.pause();
    let evaluation = evaluation?;
    context.check_not_stopped()?;
    if let Some(path) = &request.scores {
        output::write_with(path, |file| write_scores(file, &evaluation))?;
    }
    if let Some(path) = &request.trace {
        write_trace(path, &mut **backend, &group, &starts, context)?;
    }
    let (seed, start_jitter, poi_jitter) = match starts {
        Starts::Drawn { seed, jitter, poi_jitter, .. } => (Some(seed), Some(jitter), Some(poi_jitter)),
        Starts::Own => (None, None, None),
    };
    let best = evaluation.best();
    Ok(RolloutOutcome {
        teams: evaluation.observed.len(),
        leaders: evaluation.leaders,
        pois: evaluation.pois,
        trial,
        stage: request.stage,
        episodes: evaluation.episodes,
        seed,
        start_jitter,
        poi_jitter,
        team_0: evaluation.team(0),
        best: Best { team: best, spread: evaluation.team(best) },
        mean: evaluation.mean(),
        unverified: request.unverified,
        weighted_by: config.weighted_by(),
        is_drawn: config.draws_starts(),
        processor: ProcessorInfo::of(machine, &backend.describe()),
    })
}

/// Compares a config and policies with the digests in `run.json`, if they belong to a run.
fn verify(config: &Path, policies: &Path, unverified: bool) -> Result<(), Error> {
    let verification = Verification::unless(unverified);
    if config.ends_with(folder::CONFIG) {
        Digests::read(file::folder(config), verification)?.compare_config(config, &Config::load(config)?)?;
    }
    if policies.ends_with(folder::POLICIES) {
        let checksum = tensors::open(policies)?.checksum().map(String::from);
        Digests::read(file::folder(policies), verification)?.compare_policies(policies, checksum.as_deref())?;
    }
    Ok(())
}

/// Returns the number of teams and of episodes, for people.
pub fn counted(teams: usize, episodes: usize) -> String {
    match episodes {
        1 => map::counted(teams, "team"),
        _ => format!("{}, {episodes} episodes each", map::counted(teams, "team")),
    }
}

/// Writes the scores as CSV. Floats have the fewest digits that read back to the same bits.
fn write_scores(file: &mut dyn Write, evaluation: &Evaluation) -> io::Result<()> {
    let Evaluation { episodes, leaders, observed, .. } = evaluation;
    let several = if *episodes > 1 { ",episodes,pois,pois_deviation,pois_low,pois_high" } else { "" };
    writeln!(file, "{SCORES}{several}")?;
    for team in 0..observed.len() {
        let several = match evaluation.team(team) {
            Spread { mean, deviation: Some(deviation), interval: Some([low, high]) } => {
                format!(",{episodes},{mean},{deviation},{low},{high}")
            }
            _ => String::new(),
        };
        for leader in 0..*leaders {
            let [g, d, df, dpp] = evaluation.scores(team, leader);
            let dt = evaluation.dt(team, leader).unwrap_or(f32::NAN);
            writeln!(file, "{team},{leader},{g},{d},{df},{dpp},{dt}{several}")?;
        }
    }
    Ok(())
}

/// Writes a trace as CSV, with one row per episode, team, step and agent, and one per POI and episode if POIs or
/// headings are drawn.
fn write_trace(
    path: &Path,
    backend: &mut dyn Backend,
    group: &Group<'_>,
    starts: &Starts,
    context: Context<'_>,
) -> Result<(), Error> {
    let (leaders, agents, steps) = (group.world.leaders(), group.world.agents(), group.world.steps());
    let (whole, episodes) = (group.team_count(), starts.episodes());
    let mut failed = None;
    let written = output::write_with(path, |file| {
        writeln!(file, "{STATES},{}{}", sensed(group.world), if episodes > 1 { ",episode" } else { "" })?;
        for episode in 0..episodes {
            let starts = starts.of(episode, group.world);
            let last = if episodes > 1 { format!(",{episode}") } else { String::new() };
            let group = Group { starts: &starts, fitnesses: &[], ..*group };
            // The start has the positions of POIs only if something besides the agents' positions is drawn.
            let unused = ",".repeat(3 + group.world.inputs() + OUTPUTS);
            for (poi, Vec2 { x, y }) in group.moved_pois().unwrap_or_default().iter().enumerate() {
                writeln!(file, "0,0,{poi},poi,{x},{y}{unused}{last}")?;
            }
            for (first, part) in evaluate::parts(&group) {
                let enough = memory::check_rollout(part.world, &[], 1, part.team_count()).map_err(RunError::from);
                let trace = match enough.map_err(Error::from).and_then(|()| Ok(backend.trace(&part)?)) {
                    Ok(trace) => trace,
                    Err(error) => {
                        failed = Some(error);
                        return Err(io::ErrorKind::Other.into());
                    }
                };
                for team in 0..trace.teams {
                    for step in 0..=steps {
                        for agent in 0..agents {
                            let moment = trace.moment(step, team, agent);
                            let ([x, y], [hx, hy], speed) = (moment.position, moment.heading, moment.speed);
                            let role = if agent < leaders { "leader" } else { "follower" };
                            let index = first + team;
                            write!(file, "{index},{step},{agent},{role},{x},{y},{hx},{hy},{speed}")?;
                            // The inputs and outputs of a leader in this state are stored with the next state.
                            if agent < leaders && step < steps {
                                let inputs = trace.inputs_of(step + 1, team, agent).iter();
                                let outputs = &trace.moment(step + 1, team, agent).outputs;
                                inputs.chain(outputs).try_for_each(|value| write!(file, ",{value}"))?;
                            } else {
                                write!(file, "{}", ",".repeat(group.world.inputs() + OUTPUTS))?;
                            }
                            writeln!(file, "{last}")?;
                        }
                    }
                }
                let done = episode * whole + first + trace.teams;
                context
                    .fraction(done as f64 / (whole * episodes) as f64, format!("tracing {}", counted(whole, episodes)));
            }
        }
        Ok(())
    });
    context.pause();
    failed.map_or(written, Err)
}
