//! The requests of a page, and their dispatch.

use std::path::PathBuf;

use flotilla::backend::cpu::Cpu;
use flotilla::backend::gpu::device::{AdapterChoice, Gpu, Request};
use flotilla::backend::gpu::episode::{GpuBackend, Records, ResidencyPolicy};
use flotilla::backend::gpu::{self, exact::Pass};
use flotilla::backend::{Machine, OpenBackend};
use flotilla::config::{Config, Override};
use flotilla::front;
use flotilla::verify::{self, Plan};
use flotilla_app::report::{replay, runs};
use serde::Deserialize;
use serde_json::{Value, json};

use crate::answer::{Answer, Refusal, described, floats, refuse};
use crate::archive::{self, Recorded};
use crate::baseline::{Constant, Random};
use crate::drive::Drive;
use crate::edit;
use crate::experiments;
use crate::train::{Chosen, Training};

/// A request of the page.
#[derive(Deserialize)]
#[serde(tag = "ask", rename_all = "snake_case")]
enum Ask {
    /// Returns a config with some keys changed, complete, as TOML and as JSON.
    Resolve { text: String, name: String, changes: Vec<(String, String)> },
    /// Returns a config's text with some keys set to TOML values. Comments and layout are kept.
    Edit { text: String, changes: Vec<(String, String)> },
    /// Plays generations of the constant actions, and returns G of the best after the last.
    Constant { text: String, milliseconds: f64 },
    /// Returns learning curves with their intervals, and the comparison of experiments. The numbers are G, see
    /// [`experiments::compare`].
    Compare {
        #[serde(rename = "arms")]
        experiments: Vec<experiments::Experiment>,
    },
    /// Names runs by what differs between their configs, or by their files.
    Labels { texts: Vec<String>, names: Vec<String> },
    /// Starts the baseline of random networks.
    Random { text: String },
    /// Plays generations of that baseline, and returns G of the best network so far.
    MoreRandom { milliseconds: f64 },
    /// Joins pictures to a GIF. The numbers are RGBA `[pictures][height][width][4]`. `delay` is in hundredths of a
    /// second.
    Gif { width: u16, height: u16, delay: u16 },
    /// Returns the version.
    About,
    /// Chooses the backend: the CPU, or the browser's GPU. Without `pass`, the first exact pass is used.
    Open { gpu: bool, pass: Option<String> },
    /// Starts training the chosen trials of each config.
    Train { runs: Vec<Chosen> },
    /// Plays at least one generation, until either limit is reached. The numbers of the answer are the rows.
    Advance { generations: usize, milliseconds: f64 },
    /// Replays the champion of a generation of a trial. Without `generation`, that is the newest finished one.
    Champion { run: usize, trial: usize, generation: Option<usize> },
    /// Returns the results of a run's finished trials. The numbers are policies and fitness.
    Ends { run: usize },
    /// Returns a finished run's folder as an archive, made from its rows, policies and fitness.
    Record(Recorded),
    /// Reads an archive or a file of policies, see [`archive::read`].
    Read { text: Option<String> },
    /// Plays an episode of the champion: the team of every leader's first policy.
    Play { text: String, policies: usize },
    /// Compares the GPU with the CPU on random worlds. Without `pass`, the first exact pass is used.
    Verify { worlds: u64, teams: usize, seed: u64, pass: Option<String> },
    /// Starts an episode in which the visitor drives one leader.
    ///
    /// The other leaders use the policies in the numbers, or the zero policy if there are none that fit.
    Drive { text: String, leader: usize, policies: usize },
    /// Plays one step of the driven episode.
    Step { turn: f32, speed: f32 },
}

/// Target bytes of one buffer of a batch.
///
/// The size should let slow devices finish a batch within a frame or two, and fit a tab's memory. It was estimated, not
/// measured.
const BATCH_BYTES: u64 = 16 << 20;

/// State that a worker keeps between requests.
pub struct Session {
    backend: OpenBackend,
    training: Training,
    drive: Option<Drive>,
    constant: Option<Constant>,
    random: Option<Random>,
}

impl Default for Session {
    fn default() -> Session {
        Session { backend: front::cpu(), training: Training::default(), drive: None, constant: None, random: None }
    }
}

fn parse(text: &str) -> Result<Config, Refusal> {
    Ok(Config::parse(text, "the config")?)
}

pub fn answer(session: &mut Session, text: &str, bytes: &[u8]) -> Result<Answer, Refusal> {
    let words = |words: Value| Ok((words, vec![]));
    match serde_json::from_str(text).map_err(refuse)? {
        Ask::Resolve { text, name, changes } => words(resolve(&text, &name, changes)?),
        Ask::Edit { text, changes } => words(json!({ "text": edit::set(&text, &changes).map_err(refuse)? })),
        Ask::Constant { text, milliseconds } => {
            let begun = session.constant.take().filter(|begun| begun.text == text);
            let begun = begun.map_or_else(|| Constant::new(&parse(&text)?.validate()?, text), Ok)?;
            words(session.constant.insert(begun).advance(milliseconds)?)
        }
        Ask::Compare { experiments } => words(experiments::compare(experiments, bytes)?),
        Ask::Labels { texts, names } => {
            let configs = texts.iter().map(|text| parse(text)).collect::<Result<Vec<_>, _>>()?;
            let names: Vec<PathBuf> = names.into_iter().map(PathBuf::from).collect();
            words(json!({ "labels": runs::labels(&names, &configs) }))
        }
        Ask::Random { text } => {
            session.random = Some(Random::new(&parse(&text)?.validate()?)?);
            words(json!({}))
        }
        Ask::MoreRandom { milliseconds } => {
            let random = session.random.as_mut().ok_or_else(|| refuse("no baseline was started"))?;
            words(random.advance(milliseconds)?)
        }
        Ask::Gif { width, height, delay } => {
            let size = usize::from(width) * usize::from(height) * 4;
            let last = bytes.rchunks_exact(size.max(1)).next().ok_or_else(|| refuse("no pictures"))?;
            // The last picture stays for two seconds.
            let count = bytes.len() / size;
            let delays = (1..=count).map(|picture| if picture == count { 200 } else { delay });
            let pictures = bytes.chunks_exact(size).map(<[u8]>::to_vec).zip(delays);
            Ok((json!({}), replay::animate([width, height], last, pictures).map_err(refuse)?))
        }
        Ask::About => words(json!({ "version": flotilla::VERSION })),
        Ask::Open { gpu, pass } => {
            session.backend = if gpu { front::on_gpu(episodes(open_gpu(pass.as_deref())?)?) } else { front::cpu() };
            words(machine(&session.backend))
        }
        Ask::Train { runs } => {
            session.training = Training::new(runs)?;
            words(json!({}))
        }
        Ask::Advance { generations, milliseconds } => {
            session.training.advance(&mut *session.backend.0, generations, milliseconds)
        }
        Ask::Champion { run, trial, generation } => words(session.training.champion(run, trial, generation)?),
        Ask::Ends { run } => session.training.ends(run),
        Ask::Record(recorded) => archive::write(&recorded, bytes),
        Ask::Read { text } => archive::read(text.as_deref(), bytes),
        Ask::Play { text, policies } => words(archive::play(&parse(&text)?, policies, floats(bytes))?),
        Ask::Verify { worlds, teams, seed, pass } => words(verify(worlds, teams, seed, pass.as_deref())?),
        Ask::Drive { text, leader, policies } => {
            let drive = session.drive.insert(Drive::new(&parse(&text)?, leader, policies, floats(bytes))?);
            words(drive.state()?)
        }
        Ask::Step { turn, speed } => {
            let drive =
                session.drive.as_mut().ok_or_else(|| refuse("no leader is driven yet; start an episode first"))?;
            drive.step([turn, speed])?;
            words(drive.state()?)
        }
    }
}

fn resolve(text: &str, name: &str, changes: Vec<(String, String)>) -> Result<Value, Refusal> {
    let change = |(key, text): (String, String)| Override { name: key.clone(), key, text };
    let changes: Vec<Override> = changes.into_iter().map(change).collect();
    let config = Config::read(text, name, &[], &changes)?.validate()?;
    let mut words = described(&config);
    // Besides training itself, snapshots are kept, and packing the archive copies all policies.
    words["bytes"] = (flotilla::memory::Peaks::of([&config], 1).host + 5 * config.policy_bytes()).into();
    Ok(words)
}

fn machine((backend, machine): &OpenBackend) -> Value {
    let Machine { backend: kind, adapter, driver, threads, .. } = machine;
    json!({ "description": backend.describe(), "backend": kind, "adapter": adapter, "driver": driver, "threads": threads })
}

/// Opens the browser's only GPU. Selecting it by index also accepts software renderers; the page decides about those.
fn open_gpu(pass: Option<&str>) -> Result<Gpu, Refusal> {
    let pass = pass.map(|name| {
        let all = [Pass::NoContraction, Pass::Guarded, Pass::Plain];
        all.into_iter().find(|pass| pass.to_string() == name).ok_or_else(|| refuse(format!("no pass {name}")))
    });
    let request = Request { pass: pass.transpose()?, ..AdapterChoice::Named("0".into()).into() };
    gpu::open(request).map_err(refuse)
}

fn episodes(gpu: Gpu) -> Result<GpuBackend, Refusal> {
    Ok(GpuBackend::new(gpu).map_err(refuse)?.with_batch_bytes(BATCH_BYTES))
}

fn verify(worlds: u64, teams: usize, seed: u64, pass: Option<&str>) -> Result<Value, Refusal> {
    let gpu = open_gpu(pass)?;
    // The probes run first, because an inexact pass may agree with the CPU on a few worlds by chance.
    if let Some(mismatch) = gpu::self_test(&gpu).map_err(refuse)? {
        return Ok(json!({ "worlds": 0, "agent_steps": 0, "mismatch": mismatch.to_string() }));
    }
    let mut gpu = episodes(gpu)?.with_residency(ResidencyPolicy::Always).with_records(Records::CountedFrom(0));
    let plan = Plan::random(seed..seed + worlds, teams);
    let told = |outcome: &verify::Agreement| {
        crate::progress(json!({ "verified": outcome.worlds, "worlds": worlds }));
    };
    let outcome = verify::compare(&plan, &mut Cpu::default(), &mut gpu, told).map_err(refuse)?;
    let verify::Agreement { worlds, agent_steps, mismatch } = outcome;
    Ok(json!({ "worlds": worlds, "agent_steps": agent_steps, "mismatch": mismatch }))
}
