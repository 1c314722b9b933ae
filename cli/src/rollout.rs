//! `flotilla rollout`: plays teams of policies from a file, and scores every leader.

use std::path::PathBuf;

use clap::builder::PossibleValuesParser as Words;

use super::{Error, Printed, RunOptions, SetKeys, between, canonical, console, real, whole};
use flotilla::config::{Choice, Override, Paradigm};
use flotilla::evaluate::{MAX_EPISODES, Spread};
use flotilla_app::ops::rollout::{self, RolloutOutcome, RolloutRequest, counted};
use flotilla_app::record::digests::UNVERIFIED;
use flotilla_app::report::map::weighted;

const HELD_OUT: &str = "Held-out starts";

#[derive(clap::Args)]
pub struct Args {
    /// Run directory; with --policies also a config file (TOML), or - for standard input
    #[arg(value_name = "RUN|CONFIG")]
    path: PathBuf,
    #[command(flatten)]
    set: SetKeys,
    /// Paradigm of the policies, if it is not the config's
    #[arg(long, value_name = "NAME", value_parser = Words::new(Paradigm::names()), ignore_case = true)]
    paradigm: Option<String>,
    #[command(flatten)]
    run: RunOptions,
    /// Safetensors file with a tensor `weights` or `weights.N`, f32 [populations, policies, parameters] [default: the
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
    #[command(flatten)]
    printed: Printed,

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

/// Plays the teams. Team j consists of policy j of every leader.
pub fn run(args: Args) -> Result<(), Error> {
    let Args { path, set, paradigm, policies, trial, stage, trace, scores, unverified, episodes, seed, .. } = args;
    let key = |key: &str, value: Option<toml::Value>| {
        Some(Override::new(format!("learning.{key}"), value?, format!("--{}", key.replace('_', "-"))))
    };
    let keys = [
        key("paradigm", paradigm.map(|typed| canonical(Paradigm::names(), &typed))),
        key("start_jitter", args.start_jitter.map(toml::Value::from)),
        key("poi_jitter", args.poi_jitter.map(toml::Value::from)),
    ];
    let set = keys.into_iter().flatten().chain(set.set).collect();
    let request = RolloutRequest { path, set, policies, trial, stage, trace, scores, unverified, episodes, seed };
    let (quiet, run) = (args.printed.quiet, &args.run);
    let found = console::play(run, quiet, |backends, context| rollout::run(&request, backends, context))?;
    args.printed.outcome(&found, in_words)
}

fn in_words(found: &RolloutOutcome) -> String {
    let RolloutOutcome { teams, pois, episodes, team_0, best, mean, unverified, .. } = found;
    let mark = if *unverified { format!("{UNVERIFIED}\n") } else { String::new() };
    let (counted, weighted) = (counted(*teams, *episodes), weighted(found.weighted_by));
    if *episodes == 1 {
        let [team, most, mean] = [team_0, &best.spread, mean].map(|spread| spread.mean);
        return format!(
            "{counted}, POIs observed of {pois}{weighted}: team 0 {team:.2}, best {most:.2} (team {}), mean {mean:.2}\n{mark}",
            best.team
        );
    }
    let mut from = if found.is_drawn { ", places drawn anew" } else { "" }.to_string();
    for (what, jitter) in [("starts", found.start_jitter), ("POIs", found.poi_jitter)] {
        if let Some(jitter) = jitter.filter(|&jitter| jitter > 0.0) {
            from += &format!(", {what} moved by up to {jitter}");
        }
    }
    if let Some(seed) = found.seed {
        from += &format!(" (seed {seed})");
    }
    let names = ["team 0".into(), format!("best (team {})", best.team), "mean of all teams".into()];
    let mut text = format!(
        "{counted}{from}. POIs observed, of {pois}{weighted}:\n  {:<20}{:>6}{:>22}   95 % interval of the mean\n",
        "", "mean", "standard deviation"
    );
    for (name, Spread { mean, deviation, interval }) in names.iter().zip([team_0, &best.spread, mean]) {
        let (deviation, [low, high]) = (deviation.unwrap_or(f64::NAN), interval.unwrap_or([f64::NAN; 2]));
        text += &format!("  {name:<20}{mean:>6.2}{deviation:>22.2}   {low:.2} to {high:.2}\n");
    }
    text + &mark
}
