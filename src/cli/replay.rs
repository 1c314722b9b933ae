//! `flotilla replay`: the episode of the best team of any trial and generation, to look at.

use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering::Relaxed;

use serde_json::json;

use super::recovery::Signals;
use super::{Error, RunOptions, backend, output, print};
use crate::record::RecordError;
use crate::report::curves::PRINT;
use crate::report::progress::Meter;
use crate::report::replay::{self, Played, ReplayError, Rows};
use crate::report::runs;

#[derive(clap::Args)]
pub struct Args {
    /// Folder that `flotilla train` made
    #[arg(value_name = "RUN")]
    folder: PathBuf,
    /// Trial to look at
    #[arg(long, value_name = "N", default_value_t = 0)]
    trial: usize,
    /// Generation whose best team plays [default: the newest]
    #[arg(long, value_name = "N")]
    generation: Option<usize>,
    /// Another generation of the trial, side by side
    #[arg(long, value_name = "N")]
    compare: Option<usize>,
    /// Step to stop at, in a still picture [default: the last]
    #[arg(long, value_name = "N")]
    step: Option<usize>,
    /// File to write: .html to play, .gif moving, .png or .svg still [default: replay.html in RUN]
    #[arg(long, short, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
    /// No progress on standard error
    #[arg(long, short)]
    quiet: bool,
    #[command(flatten)]
    run: RunOptions,
}

pub fn run(args: Args) -> Result<(), Error> {
    let Args { folder, trial, generation, compare, step, out, json, quiet, run } = args;
    let out = out.unwrap_or_else(|| folder.join("replay.html"));
    let kind = Kind::of(&out)?;
    let config = runs::config(&folder)?;
    let steps = config.world.steps;
    if let Some(step) = step.filter(|&step| step > steps) {
        return Err(Error::Usage(format!("--step {step}: the episode has steps 0 to {steps}")));
    }
    let generation = match generation {
        Some(generation) => generation,
        None if trial < config.learning.trials => Rows::read(&folder, &config, trial)?.newest().unwrap_or(0),
        None => 0,
    };
    let generations: Vec<usize> = compare.into_iter().chain([generation]).collect();
    let (mut backend, _) = backend::open(&run)?;
    let signals = Signals::listen()?;
    let (mut meter, last) = (Meter::new(quiet), generations.iter().max().copied().unwrap_or(0));
    let mut watch = |generation: usize| {
        let part = generation as f64 / (last + 1) as f64;
        meter.show(part, || format!("training trial {trial} again: generation {generation} of {last}"));
        !signals.stop.load(Relaxed)
    };
    let played = replay::replay(&folder, trial, &generations, &mut *backend, &mut watch);
    meter.clear();
    let played = played.map_err(|error| match error {
        ReplayError::Stopped => Error::Stopped("before the episode was played; nothing was written".into()),
        error => error.into(),
    })?;

    let failed = |error| RecordError::Write { path: out.clone(), error };
    let name = folder.canonicalize().ok().and_then(|path| Some(path.file_name()?.to_string_lossy().into_owned()));
    let name = name.unwrap_or_else(|| folder.display().to_string());
    let still = || replay::still(&config, &played, step.unwrap_or(steps));
    let content = match kind {
        Kind::Html => replay::page(&name, &config, &played).into_bytes(),
        Kind::Gif => replay::gif(&config, &played).map_err(failed)?,
        Kind::Png => still().png(PRINT).map_err(failed)?,
        Kind::Svg => still().svg().into_bytes(),
    };
    output::write(&out, |output| output.write_all(&content))?;
    if json {
        let episode = |played: &Played| {
            let Played { trial, generation, team, best_g, .. } = played;
            json!({ "trial": trial, "generation": generation, "team": team, "best_g": best_g })
        };
        let episodes: Vec<_> = played.iter().map(episode).collect();
        let object = json!({ "out": out.display().to_string(), "bytes": content.len(), "episodes": episodes });
        return print(&format!("{object}\n"));
    }
    for played in &played {
        print(&tell(played))?;
    }
    print(&format!("{} ({} kB)\n", out.display(), content.len().div_ceil(1000)))
}

/// What was played, in a line.
fn tell(played: &Played) -> String {
    let Played { trial, generation, team, best_g, episodes, world, .. } = played;
    let (pois, digits) = (world.pois.len(), if *episodes > 1 { 2 } else { 0 });
    format!(
        "trial {trial}, generation {generation}: team {team} is the best, it observed {:.digits$} of {pois} POIs{}, as \
         metrics.csv says\n",
        best_g * pois as f64,
        if *episodes > 1 { format!(" (mean of {episodes} episodes)") } else { String::new() }
    )
}

/// What an episode is written as.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    Html,
    Gif,
    Png,
    Svg,
}

impl Kind {
    fn of(path: &Path) -> Result<Kind, Error> {
        let extension = path.extension().map(|extension| extension.to_ascii_lowercase());
        match extension.as_ref().and_then(|extension| extension.to_str()) {
            Some("html") => Ok(Kind::Html),
            Some("gif") => Ok(Kind::Gif),
            Some("png") => Ok(Kind::Png),
            Some("svg") => Ok(Kind::Svg),
            _ => Err(Error::Usage(format!("--out {}: its name must end in .html, .gif, .png or .svg", path.display()))),
        }
    }
}
