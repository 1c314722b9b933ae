//! `flotilla replay`: the episode of the best team of any trial and generation, to look at.

use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering::Relaxed;

use serde_json::json;

use super::recovery::Signals;
use super::{Error, RunOptions, backend, output, print, whole};
use crate::file;
use crate::record::RecordError;
use crate::record::disk::Disk;
use crate::report::curves::PRINT;
use crate::report::progress::Meter;
use crate::report::replay::{self, FPS, Film, History, ReplayError, Replayed};
use crate::report::runs;
use crate::report::scene::Format;

#[derive(clap::Args)]
pub struct Args {
    /// Folder that `flotilla train` made
    #[arg(value_name = "RUN")]
    folder: PathBuf,
    /// Trial to look at
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = whole)]
    trial: usize,
    /// Generation whose best team plays [default: the newest]
    #[arg(long, value_name = "N", value_parser = whole)]
    generation: Option<usize>,
    /// Another generation of the trial, side by side
    #[arg(long, value_name = "N", value_parser = whole)]
    compare: Option<usize>,
    /// Step to stop at, in a still picture [default: the last]
    #[arg(long, value_name = "N", value_parser = whole)]
    step: Option<usize>,
    /// File to write: .html to play, .gif moving, .svg, .pdf or .png still; %04d.png: a numbered .png a moment, for a
    /// film [default: replay.html in RUN]
    #[arg(long, short, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Pixels across, of a .gif or .png [default: a .gif fits into 960 x 720, a .png has 300 an inch]
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(100..=8192))]
    width: Option<u32>,
    /// Pictures a second, of a .gif or a film [default: 20]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=50))]
    fps: Option<u32>,
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
    let Args { folder, trial, generation, compare, step, out, width, fps, json, quiet, run } = args;
    let out = out.unwrap_or_else(|| folder.join("replay.html"));
    let kind = Form::of(&out)?;
    kind.takes(&out, width, fps, step)?;
    let config = runs::config(&folder)?;
    let generation = match generation {
        Some(generation) => generation,
        None if trial < config.learning.trials => History::read(&folder, &config, trial)?.newest().unwrap_or(0),
        None => 0,
    };
    let generations: Vec<usize> = compare.into_iter().chain([generation]).collect();
    if let Some(other) = generations.iter().find(|&&other| config.stage_of(other) != config.stage_of(generation)) {
        return Err(Error::Usage(format!(
            "generations {other} and {generation} are of different stages: show one alone"
        )));
    }
    let config = config.at(generation);
    if generations.len() > 1 && config.learning.poi_jitter > 0.0 {
        return Err(Error::Usage(
            "POIs are elsewhere in every generation (learning.poi_jitter): show one alone".into(),
        ));
    }
    let steps = config.world.steps;
    if let Some(step) = step.filter(|&step| step > steps) {
        return Err(Error::Usage(format!("--step {step}: the episode has steps 0 to {steps}")));
    }
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
    let motion = Film { width, fps: fps.unwrap_or(FPS) };
    let disk = Disk::default();
    let content = match kind {
        Form::Page => replay::page(&name, &config, &played).into_bytes(),
        Form::Gif => replay::gif(&config, &played, motion).map_err(failed)?,
        Form::Still(kind) => {
            let scene = replay::still(&config, &played, step.unwrap_or(steps));
            let per_mm = width.map_or(PRINT, |width| f64::from(width) / scene.width);
            scene.file(kind, per_mm).map_err(failed)?
        }
        Form::Film(numbered) => {
            disk.create_folder(file::folder(&out)).map_err(failed)?;
            let frames = replay::Frames::new(&config, &played, motion);
            for (number, &place) in frames.places.iter().enumerate() {
                let (scene, per_mm) = frames.scene(place);
                let path = out.with_file_name(numbered.name(number));
                let content = scene.png(per_mm);
                let written = content.and_then(|content| disk.replace(&path, |output| output.write_all(&content)));
                written.map_err(|error| RecordError::Write { path, error })?;
            }
            let count = frames.places.len();
            let [first, last] = [0, count - 1].map(|number| out.with_file_name(numbered.name(number)));
            let text = format!("{} to {}\n", first.display(), last.display());
            return report(
                &played,
                json,
                &text,
                json!({ "first": first.display().to_string(), "last": last.display().to_string(), "frames": count }),
            );
        }
    };
    output::write(&out, |output| output.write_all(&content))?;
    let text = format!("{} ({} kB)\n", out.display(), content.len().div_ceil(1000));
    report(&played, json, &text, json!({ "out": out.display().to_string(), "bytes": content.len() }))
}

/// Says what was played and where it was written, as text or as one JSON object.
fn report(played: &[Replayed], json: bool, text: &str, mut object: serde_json::Value) -> Result<(), Error> {
    if !json {
        played.iter().try_for_each(|played| print(&tell(played)))?;
        return print(text);
    }
    let episode = |played: &Replayed| {
        let Replayed { trial, generation, team, best_g, .. } = played;
        json!({ "trial": trial, "generation": generation, "team": team, "best_g": best_g })
    };
    object["episodes"] = played.iter().map(episode).collect();
    print(&format!("{object}\n"))
}

/// What was played, in a line.
fn tell(played: &Replayed) -> String {
    let Replayed { trial, generation, team, best_g, episodes, world, .. } = played;
    let (pois, digits) = (world.pois.len(), if *episodes > 1 { 2 } else { 0 });
    format!(
        "trial {trial}, generation {generation}: team {team} is the best, it observed {:.digits$} of {pois} POIs{}, as \
         metrics.csv says\n",
        best_g * pois as f64,
        if *episodes > 1 { format!(" (mean of {episodes} episodes)") } else { String::new() }
    )
}

/// What an episode is written as.
enum Form {
    Page,
    Gif,
    Still(Format),
    Film(Numbered),
}

impl Form {
    fn of(path: &Path) -> Result<Form, Error> {
        let extension = path.extension().map(|extension| extension.to_ascii_lowercase());
        match (extension.as_ref().and_then(|extension| extension.to_str()), Format::of(path)) {
            (Some("html"), _) => Ok(Form::Page),
            (Some("gif"), _) => Ok(Form::Gif),
            (_, Some(kind)) => {
                let numbered = path.file_name().and_then(|name| Numbered::of(name.to_str()?));
                Ok(numbered.filter(|_| kind == Format::Png).map_or(Form::Still(kind), Form::Film))
            }
            _ => {
                let path = path.display();
                Err(Error::Usage(format!("--out {path}: its name must end in .html, .gif, .svg, .pdf or .png")))
            }
        }
    }

    /// Refuses flags that would say nothing.
    fn takes(&self, out: &Path, width: Option<u32>, fps: Option<u32>, step: Option<usize>) -> Result<(), Error> {
        let moves = matches!(self, Form::Gif | Form::Film(_));
        let pixels = moves || matches!(self, Form::Still(Format::Png));
        let unused = [
            ("--width", width.is_some() && !pixels, "a .gif or .png"),
            ("--fps", fps.is_some() && !moves, "a .gif, or pictures like %04d.png"),
            ("--step", step.is_some() && !matches!(self, Form::Still(_)), "a still picture (.svg, .pdf or .png)"),
        ];
        match unused.into_iter().find(|(_, unused, _)| *unused) {
            Some((flag, _, of)) => {
                Err(Error::Usage(format!("{flag} has no meaning for --out {}: it is of {of}", out.display())))
            }
            None => Ok(()),
        }
    }
}

/// A name with a place for a number, as `%04d`.
struct Numbered {
    before: String,
    digits: usize,
    after: String,
}

impl Numbered {
    fn of(name: &str) -> Option<Numbered> {
        let (before, rest) = name.split_once('%')?;
        let (digits, after) = rest.split_once('d')?;
        let digits = match digits {
            "" => 1,
            digits => digits.strip_prefix('0')?.parse().ok().filter(|digits| (1..=9).contains(digits))?,
        };
        Some(Numbered { before: before.into(), digits, after: after.into() })
    }

    fn name(&self, number: usize) -> String {
        let Numbered { before, digits, after } = self;
        format!("{before}{number:0digits$}{after}")
    }
}
