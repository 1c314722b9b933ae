//! `flotilla replay`: shows the episode of a team from any trial and generation.

use std::path::{Path, PathBuf};

use super::{Error, Printed, RunOptions, between, console, whole, words};
use flotilla::escape::PathExt;
use flotilla_app::ops::replay::{self, ReplayOutcome, ReplayRequest, WhichTrial, Written};
use flotilla_app::record::digests::UNVERIFIED;
use flotilla_app::report::replay::{FPS, Which};
use flotilla_app::shell;

#[derive(clap::Args)]
pub struct Args {
    /// Run directory, made by `flotilla train`
    #[arg(value_name = "RUN")]
    folder: PathBuf,
    /// Trial to look at: a number from 0, or the one with the largest (best) or smallest (worst) G
    #[arg(long, value_name = "best|worst|N", default_value = "0")]
    trial: WhichTrial,
    /// Generation whose team plays [default: the newest]
    #[arg(long, value_name = "N", value_parser = whole)]
    generation: Option<usize>,
    /// Team to look at: the champion (the team of every population's best policy), the best of its generation, or a
    /// number from 0
    #[arg(long, value_name = "best|champion|N", default_value = "champion")]
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
    #[command(flatten)]
    printed: Printed,
    #[command(flatten)]
    run: RunOptions,
}

pub fn run(args: Args) -> Result<(), Error> {
    let Args { folder, trial, generation, team, compare, step, out, width, fps, unverified, printed, run } = args;
    if let Some(out) = &out {
        refuse_video(out, fps)?;
    }
    let request = ReplayRequest { folder, trial, generation, team, compare, step, out, width, fps, unverified };
    let found = console::run(&run, printed.quiet, |backends, context| replay::run(&request, backends, context))?;
    printed.summary(&found, in_words)
}

/// Returns what was played and where it was written.
fn in_words(found: &ReplayOutcome) -> String {
    let mut text: String = found.episodes.iter().map(|episode| format!("{}\n", episode.text)).collect();
    if found.unverified {
        text += &format!("{UNVERIFIED}\n");
    }
    text + &match &found.written {
        Written::File { out, bytes } => format!("{} ({} kB)\n", out.escaped(), bytes.div_ceil(1000)),
        Written::Film { first, last, .. } => format!("{} to {}\n", first.escaped(), last.escaped()),
    }
}

/// Refuses to write a video, and explains how to make one with `ffmpeg`, from one picture per moment.
fn refuse_video(path: &Path, fps: Option<u32>) -> Result<(), Error> {
    let extension = path.extension().map(|extension| extension.to_ascii_lowercase());
    let videos = ["mp4", "m4v", "mov", "mkv", "webm", "avi"];
    if !extension.is_some_and(|extension| videos.iter().any(|video| extension == *video)) {
        return Ok(());
    }
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
    let text = format!(
        "--out {out}: this format takes ffmpeg, which joins numbered pictures:\n  {pictures}\n  {}\nor write an animated \
         picture: --out {}",
        shell::command(joined),
        path.with_extension("gif").escaped()
    );
    Err(Error::Usage(text.into()))
}
