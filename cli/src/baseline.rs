//! `flotilla baseline`: plays teams that do not learn.

use super::{ConfigFile, Error, Overrides, Printed, RunOptions, SetKeys, between, console, number, whole};
use clap::builder::PossibleValuesParser as Words;
use flotilla::baseline::{SEGMENTS, SPEEDS};
use flotilla::config::{Actions, Choice, Paradigm};
use flotilla::evaluate::MAX_EPISODES;
use flotilla_app::ops::baseline::{self, BaselineOutcome, BaselineRequest, Choosing};
use flotilla_app::report::map::{counted, weighted};
use flotilla_app::report::table::markdown;

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    config: ConfigFile,
    /// Play in the world of the config's stage N, from 0 [default: the world before any stage]
    #[arg(long, value_name = "N", value_parser = whole)]
    stage: Option<usize>,
    /// Independent repetitions of the random baselines
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = between(1..=4096u32))]
    seeds: u32,
    /// Held-out episodes per team, if starts or POIs vary; as many others choose the team
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = between(1..=MAX_EPISODES))]
    episodes: u32,
    /// Draw as many random teams as a training with this many generations plays [default: the config's]
    #[arg(long, value_name = "N", value_parser = number)]
    generations: Option<String>,
    /// Draw as many random teams as a training with this population plays [default: the config's]
    #[arg(long, value_name = "N", value_parser = number)]
    population: Option<String>,
    /// Who learns [default: the config's]
    #[arg(long, value_name = "NAME", value_parser = Words::new(Paradigm::names()), ignore_case = true)]
    paradigm: Option<String>,
    #[command(flatten)]
    set: SetKeys,
    #[command(flatten)]
    printed: Printed,
    #[command(flatten)]
    run: RunOptions,
}

pub fn run(args: Args) -> Result<(), Error> {
    let Args { config, stage, seeds, episodes, generations, population, paradigm, set, printed, run } = args;
    let overrides = Overrides { generations, population, paradigm, set, ..Overrides::default() };
    let config = config.text(overrides.list())?;
    let request = BaselineRequest { config, stage, seeds, episodes };
    let found = console::play(&run, printed.quiet, |backends, context| baseline::run(&request, backends, context))?;
    printed.outcome(&found, in_words)
}

fn in_words(found: &BaselineOutcome) -> String {
    let &BaselineOutcome { pois, seeds, teams, ref learners, weighted_by, choosing, free, .. } = found;
    let head =
        [&format!("POIs observed, of {pois}{}", weighted(weighted_by)), "mean [95 % interval]", "lowest", "highest"];
    let mut rows = vec![head.map(|head| head.to_string()).to_vec()];
    let constants = match choosing {
        Choosing::Moves(Actions::Direct) => format!("best of {SPEEDS} constant {}", speeds(free)),
        Choosing::Moves(Actions::Behaviours) => "best constant behaviour".into(),
        Choosing::Agents => "best constant choice".into(),
        Choosing::Both(Actions::Direct) => format!("best of the constant choices and {}", speeds(free)),
        Choosing::Both(Actions::Behaviours) => "best constant choice and behaviour".into(),
    };
    for (name, found) in [
        (constants, &found.constant),
        (format!("best of {teams} random constant actions"), &found.action),
        (format!("best of {teams} random networks"), &found.network),
        (format!("best of {teams} random networks, the same for all leaders"), &found.shared),
        (format!("hill climbing, {teams} open-loop teams of {SEGMENTS} actions per leader"), &found.open_loop),
        (format!("hill climbing, {teams} teams of networks"), &found.hill_climbing),
    ] {
        let interval = found.interval_95.map_or(String::new(), |[low, high]| format!(" [{low:.2}, {high:.2}]"));
        let (low, high) = found.seeds.iter().fold((f64::MAX, f64::MIN), |(l, h), &o| (l.min(o), h.max(o)));
        rows.push(vec![name, format!("{:.2}{interval}", found.mean), format!("{low:.2}"), format!("{high:.2}")]);
    }
    let played = match found.moves {
        true => format!("Each team was chosen by {0} episodes and plays {0} held-out episodes.", found.episodes),
        false => "Every team plays from the config's starts.".into(),
    };
    let solved: Vec<usize> =
        (0..found.constants.len()).filter(|&index| found.constants[index].pois >= pois as f64).collect();
    format!(
        "{learners}, {}. Each search plays {teams} teams per seed, as many as one trial of training. \
         {played}\n\n{}\n{}\n",
        counted(seeds, "seed"),
        markdown(&rows),
        described(choosing, free, &solved)
    )
}

/// Returns what constant actions are. `free` tells whether some agents move freely.
fn speeds(free: bool) -> &'static str {
    if free { "speeds, straight ahead, or along y with free motion" } else { "speeds, straight ahead" }
}

/// Returns a sentence about the constant actions that observe every POI, by their indices. `free` tells whether some agents
/// move freely.
fn described(choosing: Choosing, free: bool, solved: &[usize]) -> String {
    let unit = |index: usize| match choosing {
        // With free motion this is a velocity, from -1 to 1.
        Choosing::Moves(Actions::Direct) if free => format!("{:.1}", 2.0 * (index + 1) as f64 / SPEEDS as f64 - 1.0),
        Choosing::Moves(Actions::Direct) => format!("{} %", (index + 1) * 100 / SPEEDS),
        _ => format!("{index}"),
    };
    let range = |range: &[usize]| match *range {
        [first, .., last] => format!("{} to {}", unit(first), unit(last)),
        _ => unit(range[0]),
    };
    let ranges: Vec<String> = solved.chunk_by(|index, next| index + 1 == *next).map(range).collect();
    let ranges = ranges.join(", ");
    match (choosing, ranges.is_empty()) {
        (Choosing::Moves(Actions::Direct), true) => "No constant speed observes every POI.".into(),
        (Choosing::Moves(Actions::Direct), false) if free => {
            format!("A team whose actions are always 0 and {ranges} observes every POI.")
        }
        (Choosing::Moves(Actions::Direct), false) => {
            format!("A team that drives straight ahead at {ranges} of motion.max_speed observes every POI.")
        }
        (Choosing::Moves(Actions::Behaviours), true) => "No constant behaviour observes every POI.".into(),
        (Choosing::Moves(Actions::Behaviours), false) => {
            format!("A team that always chooses the behaviour {ranges} observes every POI.")
        }
        (_, true) => "No constant choice observes every POI.".into(),
        (_, false) => format!("A team with the constant choice {ranges} observes every POI."),
    }
}
