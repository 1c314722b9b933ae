//! `flotilla rollout`: plays teams of policies from a file, and scores every leader.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use clap::builder::PossibleValuesParser as Words;
use serde_json::json;

use super::{
    ConfigFile, Error, Processor, RunOptions, SetKeys, backend, between, canonical, output, points, print, print_json,
    real, said, say, whole,
};
use crate::backend::{Backend, Group, Moment};
use crate::choice::Work;
use crate::config::{Choice, Config, Override, Paradigm, Sharing};
use crate::escape::PathExt;
use crate::evaluate::{self, Evaluation, MAX_EPISODES, Spread, Starts};
use crate::file;
use crate::record::archive::RunFolder;
use crate::record::digests::{self, Digests, UNVERIFIED, Verification};
use crate::record::{folder, policies, tensors};
use crate::report::progress::Meter;
use crate::report::replay::numbered;
use crate::world::World;

const HELD_OUT: &str = "Held-out starts";
/// Columns of a trace. Only leaders fill `SENSED`: the eight inputs and two outputs of their policies.
const STATES: &str = "team,step,agent,role,x,y,heading_x,heading_y,speed";
const SENSED: &str = "pois_back_right,pois_front_right,pois_front_left,pois_back_left,\
                      agents_back_right,agents_front_right,agents_front_left,agents_back_left,turn_output,speed_output";

#[derive(clap::Args)]
pub struct Args {
    /// Run directory, or a zip file of a run; with --policies also a config file (TOML), or - for standard input
    #[arg(value_name = "RUN|CONFIG")]
    path: PathBuf,
    #[command(flatten)]
    set: SetKeys,
    /// Paradigm of the policies, if it is not the config's
    #[arg(long, value_name = "NAME", value_parser = Words::new(Paradigm::names()), ignore_case = true)]
    paradigm: Option<String>,
    #[command(flatten)]
    run: RunOptions,
    /// Safetensors file with a tensor `weights` or `weights.N`, f32 [leaders, policies, parameters] [default: the
    /// run's policies.safetensors]
    #[arg(long, value_name = "FILE")]
    policies: Option<PathBuf>,
    /// Take the tensor `weights.N` [default: `weights`, or else `weights.0`]
    #[arg(long, value_name = "N", value_parser = whole)]
    trial: Option<usize>,
    /// Play in the world of the config's stage N, from 0 [default: the world before any stage]
    #[arg(long, value_name = "N", value_parser = whole)]
    stage: Option<usize>,
    /// Write every agent's state after each step, and every leader's inputs and outputs
    #[arg(long, value_name = "FILE")]
    trace: Option<PathBuf>,
    /// Write every leader's scores: team,leader,g,d,df,dpp,dt; for several episodes their means, and the spread of POIs
    #[arg(long, value_name = "FILE")]
    scores: Option<PathBuf>,
    /// Also read files that differ from their digests in run.json, and mark the results as unverified
    #[arg(long)]
    unverified: bool,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
    /// Print no progress
    #[arg(long, short)]
    quiet: bool,

    /// Play every team from this many held-out starts [default: once, from the config's own start]
    #[arg(long, value_name = "N", value_parser = between(1..=MAX_EPISODES),
        help_heading = HELD_OUT)]
    episodes: Option<u32>,
    /// Random seed of these starts [default: 0, so that all policies get the same starts]
    #[arg(long, value_name = "S", requires = "episodes", value_parser = between(0..=i64::MAX as u64),
        help_heading = HELD_OUT)]
    seed: Option<u64>,
    /// Largest offset of a start on each axis [default: the config's learning.start_jitter]
    #[arg(long, value_name = "J", requires = "episodes", value_parser = real, help_heading = HELD_OUT)]
    start_jitter: Option<f64>,
    /// Largest offset of a POI on each axis [default: the config's learning.poi_jitter]
    #[arg(long, value_name = "J", requires = "episodes", value_parser = real, help_heading = HELD_OUT)]
    poi_jitter: Option<f64>,
}

impl Args {
    /// Returns where episodes start, given the config's jitters.
    fn starts(&self, jitter: f64, poi_jitter: f64) -> Result<Starts, Error> {
        let (Some(episodes), seed) = (self.episodes, self.seed.unwrap_or(0)) else { return Ok(Starts::Own) };
        if jitter == 0.0 && poi_jitter == 0.0 && (episodes > 1 || self.seed.is_some()) {
            return Err(Error::Usage(said(
                format!("--episodes {episodes}: learning.start_jitter is 0, so all episodes are the same"),
                "\
                 set it or learning.poi_jitter in the config, or give --start-jitter or --poi-jitter",
            )));
        }
        Ok(Starts::Drawn { episodes, seed, jitter, poi_jitter })
    }
}

/// Plays the teams. Team j consists of policy j of every leader.
pub fn run(args: Args) -> Result<(), Error> {
    let outputs = [("--scores", args.scores.as_deref()), ("--trace", args.trace.as_deref())];
    let opened = RunFolder::open(&args.path)?;
    let (config, trained) = match opened.path() {
        path if path.is_dir() => {
            points::config(path, Verification::unless(args.unverified))?;
            (path.join(folder::CONFIG), Some(path.join(folder::POLICIES)))
        }
        path => (path.to_path_buf(), None),
    };
    let Some(policies) = args.policies.clone().or(trained) else {
        return Err(Error::Usage(said(
            "--policies: a config file needs a file of policies",
            format!("or name a run's folder in place of {}", args.path.escaped()),
        )));
    };
    let config_path = config.clone();
    let config = ConfigFile { path: config };
    output::check(&outputs, &[&config.path, &policies])?;
    let set = |key: &str, value: Option<toml::Value>| {
        Some(Override::new(format!("learning.{key}"), value?, format!("--{}", key.replace('_', "-"))))
    };
    let overrides = [
        set("paradigm", args.paradigm.as_ref().map(|typed| canonical(Paradigm::names(), typed))),
        set("start_jitter", args.start_jitter.map(toml::Value::from)),
        set("poi_jitter", args.poi_jitter.map(toml::Value::from)),
    ];
    let config =
        config.load(&overrides.into_iter().flatten().chain(args.set.set.iter().cloned()).collect::<Vec<_>>())?;
    let config = match args.stage {
        None => config,
        Some(stage) => {
            let mut staged = config.staged();
            if stage >= staged.len() {
                let stages = staged.len();
                return Err(Error::Usage(
                    format!("--stage {stage}: the config has {}", numbered(stages, "stage")).into(),
                ));
            }
            staged.swap_remove(stage).1
        }
    };
    let starts = args.starts(config.learning.start_jitter, config.learning.poi_jitter)?;
    verify(&config_path, &policies, args.unverified)?;
    let policies = policies::read(&policies, &config, args.trial)?;
    let world = World::new(&config);
    // The file says whether its leaders share a policy, not the config, which may be another layout's.
    let own = policies.policies * world.leaders() * world.parameters();
    let sharing = if policies.weights.len() == own { Sharing::PerLeader } else { Sharing::Shared };
    let work = Work::of_teams(&config, policies.policies * args.episodes.unwrap_or(1) as usize);
    let ((mut backend, machine), on) = backend::open_for(&args.run, work)?;
    if !args.quiet {
        say(format_args!("playing on {on}"));
    }
    let teams = evaluate::one_policy_a_team(policies.policies, world.leaders());
    let group = Group {
        world: &world,
        starts: &world.starts,
        weights: policies.weights[..].into(),
        policies: policies.policies,
        teams: &teams,
        sharing,
        fitnesses: if args.scores.is_some() { evaluate::SCORES_AND_DT } else { evaluate::SCORES },
    };

    let mut meter = Meter::new(args.quiet);
    let evaluation = evaluate::evaluate(&mut *backend, &group, &starts, &mut |part| {
        let (teams, episodes) = (policies.policies, starts.episodes());
        meter.show(part, || format!("playing {}", counted(teams, episodes)));
    });
    meter.clear();
    let evaluation = evaluation?;
    if let Some(path) = &args.scores {
        output::write(path, |file| write_scores(file, &evaluation))?;
    }
    if let Some(path) = &args.trace {
        write_trace(path, &mut *backend, &group, &starts, &mut meter)?;
    }
    if args.json {
        let mut object = in_json(&evaluation, &starts);
        Processor::of(&machine, &backend.describe()).add_to(&mut object);
        object["unverified"] = args.unverified.into();
        return print_json(&object);
    }
    let mark = if args.unverified { format!("{UNVERIFIED}\n") } else { String::new() };
    print(&(in_words(&evaluation, &starts) + &mark))
}

/// Compares a config and policies with the digests in `run.json`, if they belong to a run.
fn verify(config: &Path, policies: &Path, unverified: bool) -> Result<(), Error> {
    let verification = Verification::unless(unverified);
    let mut folders = Vec::new();
    if config.ends_with(folder::CONFIG) {
        Digests::read(file::folder(config), verification)?.compare_config(config, &Config::load(config)?)?;
        folders.push(file::folder(config));
    }
    if policies.ends_with(folder::POLICIES) {
        let checksum = tensors::open(policies)?.checksum().map(String::from);
        Digests::read(file::folder(policies), verification)?.compare_policies(policies, checksum.as_deref())?;
        folders.push(file::folder(policies));
    }
    folders.dedup();
    digests::without(folders).into_iter().for_each(say);
    Ok(())
}

fn counted(teams: usize, episodes: usize) -> String {
    match episodes {
        1 => format!("{teams} teams"),
        _ => format!("{teams} teams, {episodes} episodes each"),
    }
}

fn in_words(evaluation: &Evaluation, starts: &Starts) -> String {
    let Evaluation { observed, pois, episodes, .. } = evaluation;
    let best = evaluation.best();
    let told = [evaluation.team(0), evaluation.team(best), evaluation.mean()];
    let counted = counted(observed.len(), *episodes);
    if *episodes == 1 {
        let [team, most, mean] = told.map(|spread| spread.mean);
        return format!(
            "{counted}, POIs observed of {pois}: team 0 {team:.2}, best {most:.2} (team {best}), mean {mean:.2}\n"
        );
    }
    let from = match starts {
        Starts::Drawn { seed, jitter, poi_jitter: 0.0, .. } => {
            format!(", starts moved by up to {jitter} (seed {seed})")
        }
        Starts::Drawn { seed, jitter, poi_jitter, .. } => {
            format!(", starts moved by up to {jitter}, POIs by up to {poi_jitter} (seed {seed})")
        }
        Starts::Own => String::new(),
    };
    let names = ["team 0".into(), format!("best (team {best})"), "mean of all teams".into()];
    let mut text = format!(
        "{counted}{from}. POIs observed, of {pois}:\n  {:<20}{:>6}{:>22}   95 % interval of the mean\n",
        "", "mean", "standard deviation"
    );
    for (name, Spread { mean, deviation, interval }) in names.iter().zip(told) {
        let (deviation, [low, high]) = (deviation.unwrap_or(f64::NAN), interval.unwrap_or([f64::NAN; 2]));
        text += &format!("  {name:<20}{mean:>6.2}{deviation:>22.2}   {low:.2} to {high:.2}\n");
    }
    text
}

fn in_json(evaluation: &Evaluation, starts: &Starts) -> serde_json::Value {
    let spread = |spread: Spread| {
        let Spread { mean, deviation, interval } = spread;
        json!({ "mean": mean, "standard_deviation": deviation, "interval_95": interval })
    };
    let best = evaluation.best();
    let mut object = json!({
        "teams": evaluation.observed.len(),
        "leaders": evaluation.leaders,
        "pois": evaluation.pois,
        "episodes": evaluation.episodes,
        "seed": null,
        "start_jitter": null,
        "poi_jitter": null,
        "team_0": spread(evaluation.team(0)),
        "best": spread(evaluation.team(best)),
        "mean": spread(evaluation.mean()),
    });
    object["best"]["team"] = json!(best);
    if let Starts::Drawn { seed, jitter, poi_jitter, .. } = starts {
        (object["seed"], object["start_jitter"], object["poi_jitter"]) =
            (json!(seed), json!(jitter), json!(poi_jitter));
    }
    object
}

/// Writes the scores as CSV. Floats have the fewest digits that read back to the same bits.
fn write_scores(file: &mut dyn Write, evaluation: &Evaluation) -> io::Result<()> {
    let Evaluation { episodes, leaders, observed, .. } = evaluation;
    let several = if *episodes > 1 { ",episodes,pois,pois_deviation,pois_low,pois_high" } else { "" };
    writeln!(file, "team,leader,g,d,df,dpp,dt{several}")?;
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

/// Writes a trace as CSV, with one row per episode, team, step and agent.
fn write_trace(
    path: &Path,
    backend: &mut dyn Backend,
    group: &Group<'_>,
    starts: &Starts,
    meter: &mut Meter,
) -> Result<(), Error> {
    let (leaders, agents, steps) = (group.world.leaders(), group.world.agents(), group.world.steps());
    let (whole, episodes) = (group.team_count(), starts.episodes());
    let mut failed = None;
    let written = output::write(path, |file| {
        writeln!(file, "{STATES},{SENSED}{}", if episodes > 1 { ",episode" } else { "" })?;
        for episode in 0..episodes {
            let starts = starts.of(episode, group.world);
            let last = if episodes > 1 { format!(",{episode}") } else { String::new() };
            for (first, part) in evaluate::parts(&Group { starts: &starts, fitnesses: &[], ..*group }) {
                let trace = match backend.trace(&part) {
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
                            let next = (agent < leaders && step < steps).then(|| trace.moment(step + 1, team, agent));
                            match next {
                                Some(Moment { inputs, outputs, .. }) => {
                                    inputs.iter().chain(outputs).try_for_each(|value| write!(file, ",{value}"))?;
                                }
                                None => write!(file, ",,,,,,,,,,")?,
                            }
                            writeln!(file, "{last}")?;
                        }
                    }
                }
                let done = episode * whole + first + trace.teams;
                meter.show(done as f64 / (whole * episodes) as f64, || format!("tracing {}", counted(whole, episodes)));
            }
        }
        Ok(())
    });
    meter.clear();
    failed.map_or(written, |error| Err(error.into()))
}
