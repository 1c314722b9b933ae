//! Replays the episode of a team from any trial and generation, as a page, a film or a picture.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::output::{self, Destination};
use super::{BackendSource, Context, Error, check_memory, escaped, sweep, with_remedy};
use crate::choice::Work;
use crate::record::RecordError;
use crate::record::digests::Verification;
use crate::record::disk::Disk;
use crate::record::ownership::{self, REPLAY};
use crate::report::map;
use crate::report::replay::{self, FPS, Film, ReplayError, Replayed, Which};
use crate::report::runs;
use crate::report::scene::{Format, PRINT};
use crate::run::RunError;
use flotilla::config::{Config, Learning, ValidConfig};
use flotilla::escape::PathExt;
use flotilla::file;
use flotilla::memory;
use flotilla::world::World;

#[derive(Clone, Debug)]
pub struct ReplayRequest {
    /// A run's folder.
    pub folder: PathBuf,
    pub trial: WhichTrial,
    /// The generation. The newest by default.
    pub generation: Option<usize>,
    pub team: Which,
    /// Another generation of the trial, side by side.
    pub compare: Option<usize>,
    /// The step that a still picture shows. The last by default.
    pub step: Option<usize>,
    /// The file. `replay.html` in the run's folder by default.
    pub out: Option<PathBuf>,
    /// Width in pixels.
    pub width: Option<u32>,
    /// Pictures per second.
    pub fps: Option<u32>,
    /// Whether files that differ from their digests are read.
    pub unverified: bool,
}

#[derive(Clone, Debug, Serialize)]
pub struct ReplayOutcome {
    #[serde(flatten)]
    pub written: Written,
    pub episodes: Vec<Episode>,
    /// Whether files were read that differ from their digests.
    pub unverified: bool,
}

/// The files that a replay wrote.
#[derive(Clone, Debug, Serialize)]
#[serde(untagged)]
pub enum Written {
    File {
        #[serde(serialize_with = "escaped")]
        out: PathBuf,
        bytes: usize,
    },
    /// Numbered pictures.
    Film {
        /// The first picture.
        #[serde(serialize_with = "escaped")]
        first: PathBuf,
        /// The last picture.
        #[serde(serialize_with = "escaped")]
        last: PathBuf,
        /// Number of pictures.
        frames: usize,
    },
}

#[derive(Clone, Debug, Serialize)]
pub struct Episode {
    pub trial: usize,
    pub generation: usize,
    /// The team as it was requested: best, champion or number.
    pub which: &'static str,
    /// The team's number in its generation. The champion has none.
    pub team: Option<usize>,
    /// G of the team as `best_g`, `champion_g` or `g`.
    #[serde(flatten)]
    pub g: BTreeMap<&'static str, f64>,
    /// The episode for people.
    #[serde(skip)]
    pub text: String,
}

impl Episode {
    fn of(config: &Config, played: &Replayed) -> Episode {
        let &Replayed { trial, generation, which, team, team_g, .. } = played;
        let (which, team, g) = match which {
            Which::Best => ("best", Some(team), "best_g"),
            Which::Champion => ("champion", None, "champion_g"),
            Which::Number(_) => ("number", Some(team), "g"),
        };
        Episode { trial, generation, which, team, g: [(g, team_g)].into(), text: described(config, played) }
    }
}

#[derive(Clone, Copy, Debug)]
pub enum WhichTrial {
    /// The one with the largest G.
    Best,
    /// The one with the smallest G.
    Worst,
    /// The one with this number, from 0.
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
    pub fn find(
        self,
        folder: &Path,
        config: &Config,
        generation: Option<usize>,
        which: Which,
        verification: Verification,
    ) -> Result<usize, Error> {
        let extremes = || replay::extreme_trials(folder, config, generation, which, verification);
        Ok(match self {
            WhichTrial::Number(trial) => trial,
            WhichTrial::Best => extremes()?[0],
            WhichTrial::Worst => extremes()?[1],
        })
    }
}

/// Replays episodes, and writes them.
pub fn run(
    request: &ReplayRequest,
    backends: &mut dyn BackendSource,
    context: Context<'_>,
) -> Result<ReplayOutcome, Error> {
    let ReplayRequest { generation, team, compare, step, width, fps, unverified, .. } = *request;
    let verification = Verification::unless(unverified);
    let folder = &*request.folder;
    let place = match &request.out {
        Some(out) => Destination::Named(out.clone()),
        None => Destination::OfRun(folder.join(REPLAY)),
    };
    let out = place.path();
    let kind = Form::of(out)?;
    kind.takes(out, request)?;
    let config = sweep::config_of_run(folder, verification)?.validate()?;
    let trial = request.trial.find(folder, &config, generation, team, verification)?;
    let generation = match generation {
        Some(generation) => generation,
        None if trial < config.learning.trials => {
            runs::trials(folder, &config, verification)?[trial].len().saturating_sub(1)
        }
        None => 0,
    };
    let generations: Vec<usize> = compare.into_iter().chain([generation]).collect();
    let steps = stage(&config, &generations)?.world.steps;
    if let Some(step) = step.filter(|&step| step > steps) {
        return Err(Error::Usage(format!("--step {step}: the episode has steps 0 to {steps}").into()));
    }
    prepare_output(&place, &kind, &request.folder)?;
    let (config, played) = play(folder, trial, &generations, team, verification, backends, context)?;

    let name = folder.canonicalize().ok().and_then(|path| Some(path.file_name()?.to_string_lossy().into_owned()));
    let name = name.unwrap_or_else(|| folder.escaped());
    let motion = Film { width, fps: fps.unwrap_or(FPS) };
    let frames = || replay::Frames::new(&config, &played, motion);
    let watch = |number: usize, count: usize| {
        context.fraction(number as f64 / count as f64, format!("drawing picture {number} of {count}"));
        !context.is_stopped()
    };
    let content = match kind {
        Form::Page => Ok(replay::page(&name, &config, &played).into_bytes()),
        Form::Gif => {
            let frames = frames();
            let film = replay::gif(&frames, motion, |number| watch(number, frames.places.len()));
            context.pause();
            let stopped = || Error::Stopped("before all pictures were drawn; nothing was written".into());
            film.transpose().ok_or_else(stopped)?
        }
        Form::Still(kind) => {
            let scene = replay::still(&config, &played, step.unwrap_or(steps));
            scene.file(kind, width.map_or(PRINT, |width| f64::from(width) / scene.width))
        }
        Form::Film(numbered) => {
            let written = write_film(&numbered, out, &frames(), watch);
            context.pause();
            return Ok(outcome(written?, &config, &played));
        }
    };
    let content = content.map_err(RecordError::write(out))?;
    place.write(&content)?;
    Ok(outcome(Written::File { out: out.into(), bytes: content.len() }, &config, &played))
}

/// Replays the episode of one team in each given generation of a trial. Returns the config of the stage that all the
/// generations belong to, and the episodes in the order of the generations.
///
/// # Errors
/// The run cannot be read, the request does not fit it, the generations cannot be shown side by side, the backend
/// fails, or the caller stops the replay.
pub fn play(
    folder: &Path,
    trial: usize,
    generations: &[usize],
    team: Which,
    verification: Verification,
    backends: &mut dyn BackendSource,
    context: Context<'_>,
) -> Result<(Config, Vec<Replayed>), Error> {
    let config = stage(&sweep::config_of_run(folder, verification)?.validate()?, generations)?.clone();
    let learning = Learning { trials: 1, ..config.learning.clone() };
    let trained = Config { learning, ..config.clone() }.validate()?;
    let (open, _) = backends.open(Work::of([&*trained]))?;
    check_memory([&trained], open)?;
    memory::check_rollout(&World::new(&trained), &[], 1, generations.len()).map_err(RunError::from)?;
    let last = generations.iter().max().copied().unwrap_or(0);
    let mut watch = |generation: usize| {
        let text = format!("training trial {trial} again: generation {generation} of {last}");
        context.fraction(generation as f64 / (last + 1) as f64, text);
        !context.is_stopped()
    };
    let played = replay::replay(folder, trial, generations, team, verification, &mut *open.0, &mut watch);
    context.pause();
    let episodes = played.map_err(|error| match error {
        ReplayError::Stopped => Error::Stopped("before the episode was played; nothing was written".into()),
        error => error.into(),
    })?;
    Ok((config, episodes))
}

/// Returns the config that all the generations play with.
fn stage<'a>(config: &'a ValidConfig, generations: &[usize]) -> Result<&'a Config, Error> {
    let refused = |text: String| Err(Error::Usage(text.into()));
    let first = generations.first().copied().unwrap_or(0);
    if let Some(other) = generations.iter().find(|&&other| config.stage_of(other) != config.stage_of(first)) {
        return refused(format!("generations {first} and {other} are of different stages: show one alone"));
    }
    let stage = config.at(first);
    if generations.len() > 1 && stage.pois_move() {
        let key = if stage.learning.poi_jitter > 0.0 { "learning.poi_jitter" } else { "pois.in" };
        return refused(format!("POIs are elsewhere in every generation ({key}): show one alone"));
    }
    Ok(stage)
}

/// Checks the output, and creates the folder of a film. Called before the trial is trained again, which may take hours.
/// `run` is the run's folder.
fn prepare_output(place: &Destination, kind: &Form, run: &Path) -> Result<(), Error> {
    let Destination::Named(out) = place else { return Ok(place.check()?) };
    if matches!(kind, Form::Film(_)) {
        Disk::default().create_folder(file::folder(out)).map_err(RecordError::write(out))?;
    }
    output::check(&[("--out", Some(out.as_path()))], &[run])
}

fn outcome(written: Written, config: &Config, played: &[Replayed]) -> ReplayOutcome {
    let unverified = played.iter().any(|played| played.unverified);
    ReplayOutcome { written, episodes: played.iter().map(|played| Episode::of(config, played)).collect(), unverified }
}

/// Writes one numbered picture per moment. The folder must exist. Before each picture, `watch` gets its number and that of
/// all; if it returns false, no more are written.
fn write_film(
    numbered: &Numbered,
    out: &Path,
    frames: &replay::Frames<'_>,
    watch: impl Fn(usize, usize) -> bool,
) -> Result<Written, Error> {
    let place = |number: usize| out.with_file_name(numbered.name(number));
    let count = frames.places.len();
    if let Some(path) =
        (0..count).map(place).find(|path| path.symlink_metadata().is_ok() && !ownership::is_drawing(path))
    {
        return Err(RecordError::NotOurs(path).into());
    }
    let disk = ownership::open_output_folder(&Disk::default(), file::folder(out), true)?;
    for (number, &moment) in frames.places.iter().enumerate() {
        if !watch(number, count) {
            return Err(Error::Stopped(format!("after {number} of {count} pictures").into()));
        }
        let (scene, per_mm) = frames.scene(moment);
        let (path, content) = (place(number), scene.png(per_mm));
        let written = content.and_then(|content| disk.replace(&path, |output| output.write_all(&content)));
        written.map_err(RecordError::write(&path))?;
    }
    // Otherwise the pictures of a longer film that was there would follow.
    for path in (count..).map(place).take_while(|path| ownership::is_drawing(path)) {
        disk.remove(&path).map_err(RecordError::write(&path))?;
    }
    Ok(Written::Film { first: place(0), last: place(count - 1), frames: count })
}

/// Returns what was played, for people.
fn described(config: &Config, played: &Replayed) -> String {
    let Replayed { team_g, episodes, world, which, .. } = played;
    let pois = world.pois.len();
    let weighted = map::weighted(config.weighted_by());
    let digits = if *episodes > 1 || !weighted.is_empty() { 2 } else { 0 };
    format!(
        "{} of {}: observed {:.digits$} of {pois} POIs{weighted}{}{}",
        played.name(),
        played.place(),
        team_g * pois as f64,
        if *episodes > 1 {
            format!(" (mean of {episodes} episodes, of which the first is shown)")
        } else {
            String::new()
        },
        if matches!(which, Which::Number(_)) { "" } else { ", as in metrics.csv" },
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
                let path = path.escaped();
                Err(Error::Usage(format!("--out {path}: its name must end in .html, .gif, .svg, .pdf or .png").into()))
            }
        }
    }

    /// Rejects flags that have no effect.
    fn takes(&self, out: &Path, request: &ReplayRequest) -> Result<(), Error> {
        let ReplayRequest { width, fps, step, .. } = request;
        let moves = matches!(self, Form::Gif | Form::Film(_));
        let pixels = moves || matches!(self, Form::Still(Format::Png));
        let unused = [
            ("--width", width.is_some() && !pixels, "a .gif or .png"),
            ("--fps", fps.is_some() && !moves, "a .gif, or pictures like %04d.png"),
            ("--step", step.is_some() && !matches!(self, Form::Still(_)), "a still picture (.svg, .pdf or .png)"),
        ];
        match unused.into_iter().find(|(_, unused, _)| *unused) {
            Some((flag, _, of)) => {
                let text = format!("{flag} does not apply to --out {}", out.escaped());
                Err(Error::Usage(with_remedy(text, format!("use it with {of}"))))
            }
            None => Ok(()),
        }
    }
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
