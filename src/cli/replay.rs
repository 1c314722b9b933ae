//! `flotilla replay`: shows the episode of a team from any trial and generation.

use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering::Relaxed;

use serde_json::json;

use super::output::Destination;
use super::recovery::Signals;
use super::{Error, RunOptions, backend, between, points, print, print_json, said, say, whole, words};
use crate::choice::Work;
use crate::config::{Config, Learning};
use crate::escape::PathExt;
use crate::record::RecordError;
use crate::record::archive::RunFolder;
use crate::record::digests::{self, UNVERIFIED, Verification};
use crate::record::disk::Disk;
use crate::record::ownership::{self, REPLAY};
use crate::report::curves::PRINT;
use crate::report::progress::Meter;
use crate::report::replay::{self, FPS, Film, History, ReplayError, Replayed, Which};
use crate::report::scene::Format;
use crate::{file, shell};

#[derive(clap::Args)]
pub struct Args {
    /// Run directory, made by `flotilla train`, or a zip file of a run
    #[arg(value_name = "RUN")]
    folder: PathBuf,
    /// Trial to look at: a number from 0, or the one with the largest (best) or smallest (worst) G
    #[arg(long, value_name = "best|worst|N", default_value = "0")]
    trial: WhichTrial,
    /// Generation whose team plays [default: the newest]
    #[arg(long, value_name = "N", value_parser = whole)]
    generation: Option<usize>,
    /// Team to look at: the best of its generation, the champion (the team of every population's best policy), or a
    /// number from 0
    #[arg(long, value_name = "best|champion|N", default_value = "best")]
    team: Which,
    /// Another generation of the trial, side by side
    #[arg(long, value_name = "N", value_parser = whole)]
    compare: Option<usize>,
    /// Step to stop at, in a still picture [default: the last]
    #[arg(long, value_name = "N", value_parser = whole)]
    step: Option<usize>,
    /// File to write: .html plays in a browser, .gif moves, .svg, .pdf and .png are stills. A .png name with %d or %04d
    /// writes numbered pictures for a film [default: replay.html in RUN]
    #[arg(long, short, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Width of a .gif or .png in pixels [default: a .gif fits into 960 x 720, a .png has 300 dots per inch]
    #[arg(long, value_name = "PIXELS", value_parser = between(100..=8192u32))]
    width: Option<u32>,
    /// Pictures per second, for a .gif or a film [default: 20]
    #[arg(long, value_name = "N", value_parser = between(1..=50u32))]
    fps: Option<u32>,
    /// Also read files that differ from their digests in run.json, and mark the results as unverified
    #[arg(long)]
    unverified: bool,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
    /// Print no progress and no summary; --json still prints its object
    #[arg(long, short)]
    quiet: bool,
    #[command(flatten)]
    run: RunOptions,
}

/// The trial to show.
#[derive(Clone, Copy, Debug)]
enum WhichTrial {
    Best,
    Worst,
    Number(usize),
}

impl std::str::FromStr for WhichTrial {
    type Err = String;

    fn from_str(text: &str) -> Result<WhichTrial, String> {
        match text {
            "best" => Ok(WhichTrial::Best),
            "worst" => Ok(WhichTrial::Worst),
            number => number
                .parse()
                .map(WhichTrial::Number)
                .map_err(|_| "allowed best, worst or a whole number, from 0".into()),
        }
    }
}

impl WhichTrial {
    /// Returns the trial's number in a run.
    fn find(
        self,
        folder: &Path,
        config: &Config,
        generation: Option<usize>,
        which: Which,
        verification: Verification,
    ) -> Result<usize, Error> {
        let [best, worst] = match self {
            WhichTrial::Number(trial) => return Ok(trial),
            WhichTrial::Best | WhichTrial::Worst => {
                replay::extreme_trials(folder, config, generation, which, verification)?
            }
        };
        Ok(if matches!(self, WhichTrial::Best) { best } else { worst })
    }
}

pub fn run(args: Args) -> Result<(), Error> {
    let Args { folder, trial, generation, team, compare, step, out, width, fps, unverified, json, quiet, run } = args;
    let verification = Verification::unless(unverified);
    let opened = RunFolder::open(&folder)?;
    let folder = opened.path().to_path_buf();
    let place = match out {
        Some(out) => Destination::Named(out),
        None if opened.is_unpacked() => Destination::Here(REPLAY.into()),
        None => Destination::OfRun(folder.join(REPLAY)),
    };
    let out = place.path().to_path_buf();
    let kind = Form::of(&out, fps)?;
    kind.takes(&out, width, fps, step)?;
    let config = points::config(&folder, verification)?;
    digests::without([&*folder]).into_iter().for_each(say);
    let trial = trial.find(&folder, &config, generation, team, verification)?;
    let generation = match generation {
        Some(generation) => generation,
        None if trial < config.learning.trials => {
            History::read(&folder, &config, trial, verification)?.newest().unwrap_or(0)
        }
        None => 0,
    };
    let generations: Vec<usize> = compare.into_iter().chain([generation]).collect();
    if let Some(other) = generations.iter().find(|&&other| config.stage_of(other) != config.stage_of(generation)) {
        return Err(Error::Usage(
            format!("generations {other} and {generation} are of different stages: show one alone").into(),
        ));
    }
    let config = config.at(generation);
    if generations.len() > 1 && config.learning.poi_jitter > 0.0 {
        return Err(Error::Usage(
            "POIs are elsewhere in every generation (learning.poi_jitter): show one alone".into(),
        ));
    }
    place.check()?;
    let steps = config.world.steps;
    if let Some(step) = step.filter(|&step| step > steps) {
        return Err(Error::Usage(format!("--step {step}: the episode has steps 0 to {steps}").into()));
    }
    let learning = Learning { trials: 1, ..config.learning.clone() };
    let ((mut backend, _), _) = backend::open_for(&run, Work::of([&Config { learning, ..config.clone() }]))?;
    let signals = Signals::listen()?;
    let (mut meter, last) = (Meter::new(quiet), generations.iter().max().copied().unwrap_or(0));
    let mut watch = |generation: usize| {
        let part = generation as f64 / (last + 1) as f64;
        meter.show(part, || format!("training trial {trial} again: generation {generation} of {last}"));
        !signals.stop.load(Relaxed)
    };
    let played = replay::replay(&folder, trial, &generations, team, verification, &mut *backend, &mut watch);
    meter.clear();
    let played = played.map_err(|error| match error {
        ReplayError::Stopped => Error::Stopped(said("before the episode was played", "nothing was written")),
        error => error.into(),
    })?;

    let failed = |error| RecordError::Write { path: out.clone(), error };
    let name = folder.canonicalize().ok().and_then(|path| Some(path.file_name()?.to_string_lossy().into_owned()));
    let name = name.unwrap_or_else(|| folder.escaped().to_string());
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
            let mut names = (0..frames.places.len()).map(|number| out.with_file_name(numbered.name(number)));
            if let Some(path) = names.find(|path| path.symlink_metadata().is_ok() && !ownership::is_drawing(path)) {
                return Err(RecordError::NotOurs { path }.into());
            }
            let disk = ownership::enter(&disk, file::folder(&out), true)?;
            for (number, &place) in frames.places.iter().enumerate() {
                let (scene, per_mm) = frames.scene(place);
                let path = out.with_file_name(numbered.name(number));
                let content = scene.png(per_mm);
                let written = content.and_then(|content| disk.replace(&path, |output| output.write_all(&content)));
                written.map_err(|error| RecordError::Write { path, error })?;
            }
            let count = frames.places.len();
            let [first, last] = [0, count - 1].map(|number| out.with_file_name(numbered.name(number)));
            let text = format!("{} to {}\n", first.escaped(), last.escaped());
            return report(
                &played,
                json,
                quiet,
                &text,
                json!({ "first": first.escaped().to_string(), "last": last.escaped().to_string(), "frames": count }),
            );
        }
    };
    place.write(|output| output.write_all(&content))?;
    let text = format!("{} ({} kB)\n", out.escaped(), content.len().div_ceil(1000));
    report(&played, json, quiet, &text, json!({ "out": out.escaped().to_string(), "bytes": content.len() }))
}

/// Prints what was played and where it was written, as text or as one JSON object.
fn report(
    played: &[Replayed],
    json: bool,
    quiet: bool,
    text: &str,
    mut object: serde_json::Value,
) -> Result<(), Error> {
    if quiet && !json {
        return Ok(());
    }
    if !json {
        played.iter().try_for_each(|played| print(&tell(played)))?;
        if played.iter().any(|played| played.unverified) {
            print(&format!("{UNVERIFIED}\n"))?;
        }
        return print(text);
    }
    let episode = |played: &Replayed| {
        let Replayed { trial, generation, which, team, team_g, .. } = played;
        let (which, team, g) = match which {
            Which::Best => ("best", Some(team), "best_g"),
            Which::Champion => ("champion", None, "champion_g"),
            Which::Number(_) => ("number", Some(team), "g"),
        };
        json!({ "trial": trial, "generation": generation, "which": which, "team": team, g: team_g })
    };
    object["unverified"] = played.iter().any(|played| played.unverified).into();
    object["episodes"] = played.iter().map(episode).collect();
    print_json(&object)
}

/// Returns one line about what was played.
fn tell(played: &Replayed) -> String {
    let Replayed { team_g, episodes, world, which, .. } = played;
    let (pois, digits) = (world.pois.len(), if *episodes > 1 { 2 } else { 0 });
    format!(
        "{} of {}: observed {:.digits$} of {pois} POIs{}{}\n",
        played.name(),
        played.place(),
        team_g * pois as f64,
        if *episodes > 1 { format!(" (mean of {episodes} episodes)") } else { String::new() },
        if matches!(which, Which::Number(_)) { "" } else { ", as metrics.csv says" },
    )
}

/// The kind of file that an episode is written as.
enum Form {
    Page,
    Gif,
    Still(Format),
    Film(Numbered),
}

impl Form {
    fn of(path: &Path, fps: Option<u32>) -> Result<Form, Error> {
        let extension = path.extension().map(|extension| extension.to_ascii_lowercase());
        match (extension.as_ref().and_then(|extension| extension.to_str()), Format::of(path)) {
            (Some("html"), _) => Ok(Form::Page),
            (Some("gif"), _) => Ok(Form::Gif),
            (Some("mp4" | "m4v" | "mov" | "mkv" | "webm" | "avi"), _) => Err(Error::Usage(film(path, fps).into())),
            (_, Some(kind)) => {
                let numbered = path.file_name().and_then(|name| Numbered::of(name.to_str()?));
                Ok(numbered.filter(|_| kind == Format::Png).map_or(Form::Still(kind), Form::Film))
            }
            _ => {
                let path = path.escaped();
                Err(Error::Usage(format!("--out {path}: its name must end in .html, .gif, .svg, .pdf or .png").into()))
            }
        }
    }

    /// Rejects flags that have no effect.
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
                Err(Error::Usage(format!("{flag} has no meaning for --out {}: it is of {of}", out.escaped()).into()))
            }
            None => Ok(()),
        }
    }
}

/// Returns an error message that explains how to make a film with `ffmpeg`, from one picture per moment.
fn film(path: &Path, fps: Option<u32>) -> String {
    let (out, fps) = (path.to_string_lossy(), fps.unwrap_or(FPS).to_string());
    let frames = path.with_extension("");
    let frames = format!("{}-%04d.png", frames.to_string_lossy().replace('%', "_"));
    // The same command with another `--out`, in any spelling of that flag.
    let typed = words().into_iter().skip(1).map(|word| word.to_string_lossy().into_owned());
    let replaced = typed.map(|word| match word.strip_suffix(&*out) {
        Some(flag) if ["", "-o", "-o=", "--out="].contains(&flag) => format!("{flag}{frames}"),
        _ => word,
    });
    let pictures = shell::command(["flotilla".to_string()].into_iter().chain(replaced));
    // Video needs an even width and height.
    let even = "pad=ceil(iw/2)*2:ceil(ih/2)*2";
    let joined = ["ffmpeg", "-framerate", &fps, "-i", &frames, "-vf", even, "-pix_fmt", "yuv420p", &out];
    format!(
        "--out {out}: this format takes ffmpeg, which joins numbered pictures:\n  {pictures}\n  {}\nor write an animated \
         picture: --out {}",
        shell::command(joined),
        path.with_extension("gif").escaped()
    )
}

/// A file name with one place for a number: `%d`, or `%04d` for at least four digits.
struct Numbered {
    before: String,
    digits: usize,
    after: String,
}

impl Numbered {
    /// Finds the first place for a number. A letter or digit after it makes it an ordinary part of the name, as in
    /// `100%done`.
    fn of(name: &str) -> Option<Numbered> {
        name.match_indices('%').find_map(|(at, _)| {
            let rest = &name[at + 1..];
            let (digits, after) = match rest.as_bytes() {
                [b'd', ..] => (1, &rest[1..]),
                [b'0', digit @ b'1'..=b'9', b'd', ..] => (usize::from(digit - b'0'), &rest[3..]),
                _ => return None,
            };
            let ends = !after.starts_with(|next: char| next.is_alphanumeric());
            ends.then(|| Numbered { before: name[..at].into(), digits, after: after.into() })
        })
    }

    fn name(&self, number: usize) -> String {
        let Numbered { before, digits, after } = self;
        format!("{before}{number:0digits$}{after}")
    }
}
