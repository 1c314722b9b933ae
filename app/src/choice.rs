//! Chooses the processor that is expected to finish first, if the user requests none. Results do not depend on it.
//!
//! Opening a GPU and compiling for it takes seconds, so short runs play on the CPU. Long runs measure both processors
//! once. The measurement is kept in a file per device, in the user's cache folder.

use std::fs;
use std::io;
use std::ops::AddAssign;
use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::record::hex;
use flotilla::backend::cpu::Cpu;
use flotilla::backend::gpu::device::{self, AdapterChoice, AdapterInfo, DeviceError};
use flotilla::backend::gpu::episode::{GpuBackend, ResidencyPolicy};
use flotilla::backend::{Backend, BackendError};
use flotilla::config::Config;
use flotilla::escape::PathExt;
use flotilla::front::{self, Found, Processor};
use flotilla::host::Instant;
use flotilla::parallel::current_num_threads;
use flotilla::trainer::Trainer;
use flotilla::version::VERSION;
use flotilla::world::World;

/// Rough number of agent-steps per second of one CPU thread, for deciding whether a run is worth a measurement.
const CPU_RATE: f64 = 1e8;
/// Minimum seconds of work on the CPU for opening a GPU, which takes about as long.
const MIN_GPU_WORK_SECONDS: f64 = 5.0;
/// Teams of the generations that are timed: of a GPU's fixed cost, of its rate, and of the CPU's rate.
const SMALL_TEAMS: usize = 50;
const LARGE_TEAMS: usize = 16_384;
const CPU_TEAMS: usize = 2048;
/// Timed generations, of which the shortest counts.
const REPEATS: usize = 3;
/// The layout that is timed.
const CONFIG: &str = flotilla::config::LAYOUTS[0].1;

/// Episodes to play.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Work {
    generations: f64,
    agent_steps: f64,
}

impl Work {
    /// Returns the work of trainings that advance side by side.
    pub fn of<'a>(configs: impl IntoIterator<Item = &'a Config>) -> Work {
        configs.into_iter().fold(Work::default(), |work, config| {
            let generations = (config.learning.generations + 1) as f64;
            let trials = config.learning.trials as f64;
            Work {
                generations: work.generations.max(generations),
                agent_steps: work.agent_steps + generations * trials * generation(config),
            }
        })
    }

    /// Returns the work of one generation of a config.
    pub fn of_generation(config: &Config) -> Work {
        Work { generations: 1.0, agent_steps: config.learning.trials as f64 * generation(config) }
    }

    /// Returns the work of playing this many teams of a config.
    pub fn of_teams(config: &Config, teams: usize) -> Work {
        Work { generations: 1.0, agent_steps: teams as f64 * team(config) }
    }
}

impl AddAssign for Work {
    fn add_assign(&mut self, other: Work) {
        self.generations += other.generations;
        self.agent_steps += other.agent_steps;
    }
}

/// The total work of a process that plays many short pieces. Together they may be worth a GPU.
#[derive(Debug, Default)]
pub struct WorkTotal {
    /// All work so far.
    all: Work,
    /// All work when a GPU was last searched for.
    looked: Work,
}

impl WorkTotal {
    /// Returns a total of no work.
    pub const fn new() -> WorkTotal {
        const NONE: Work = Work { generations: 0.0, agent_steps: 0.0 };
        WorkTotal { all: NONE, looked: NONE }
    }

    /// Adds some work. Returns the total if [`find`] should choose again: when it is no longer short, and each time it
    /// has doubled.
    pub fn add(&mut self, work: Work) -> Option<Work> {
        self.add_for(work, current_num_threads())
    }

    fn add_for(&mut self, work: Work, threads: usize) -> Option<Work> {
        self.all += work;
        let is_due = self.all.agent_steps >= 2.0 * self.looked.agent_steps;
        if !is_due || choose(self.all, threads, None).is_some() {
            return None;
        }
        self.looked = self.all;
        Some(self.all)
    }
}

/// A search for the processor that plays some work.
#[derive(Default)]
pub struct Chosen {
    /// The opened GPU, if one plays. Otherwise the CPU does.
    pub gpu: Option<GpuBackend>,
    /// Why it was chosen, for people, if nobody asked for it.
    pub reason: Option<String>,
    /// The reason why an existing GPU cannot be used.
    pub passed_over: Option<DeviceError>,
    /// Why a measurement could not be kept, for people.
    pub forgotten: Option<String>,
}

impl Chosen {
    fn cpu(reason: String) -> Chosen {
        Chosen { reason: Some(reason), ..Chosen::default() }
    }
}

/// Opens the GPU that a processor asks for, if any, see [`front::find_gpu`]. With [`Processor::Auto`], `work` decides.
/// Without it, any usable GPU is taken.
///
/// # Errors
/// The requested GPU does not exist, cannot be used, or fails.
pub fn find(
    processor: &Processor,
    holding: Option<ResidencyPolicy>,
    work: Option<Work>,
) -> Result<Chosen, BackendError> {
    let threads = current_num_threads();
    let work = work.filter(|_| *processor == Processor::Auto && holding != Some(ResidencyPolicy::Always));
    let mut measured = None;
    if let Some(work) = work {
        if let Some(choice) = choose(work, threads, None) {
            return Ok(Chosen::cpu(choice.reason));
        }
        let found = device::adapters();
        measured = device::position(&AdapterChoice::Real, &found).ok().and_then(|index| recall(&found[index]));
        let choice = measured.and_then(|measured| choose(work, threads, Some(measured)));
        if let Some(choice) = choice.filter(|choice| !choice.gpu) {
            return Ok(Chosen::cpu(choice.reason));
        }
    }
    let start = Instant::now();
    let Found { mut gpu, passed_over, .. } = front::find_gpu(processor, holding)?;
    let Some(work) = work else { return Ok(Chosen { gpu, passed_over, ..Chosen::default() }) };
    let Some(opened) = &mut gpu else {
        let reason = passed_over.is_none().then(|| "no GPU found".into());
        return Ok(Chosen { passed_over, reason, ..Chosen::default() });
    };
    let mut forgotten = None;
    let measured = match measured {
        Some(measured) => measured,
        None => {
            let measured = measure(opened, start.elapsed().as_secs_f64(), threads)?;
            forgotten = remember(&opened.gpu().adapter, &measured).err();
            measured
        }
    };
    let choice = choose(work, threads, Some(measured));
    let gpu = gpu.filter(|_| choice.as_ref().is_none_or(|choice| choice.gpu));
    Ok(Chosen { gpu, reason: choice.map(|choice| choice.reason), passed_over, forgotten })
}

/// Returns the agent-steps of one trial's generation.
fn generation(config: &Config) -> f64 {
    (config.max_teams() * config.learning.episodes_per_team) as f64 * team(config)
}

/// Returns the agent-steps of one team's episode. This is an estimate, which ignores stages.
fn team(config: &Config) -> f64 {
    let world = &config.world;
    ((world.leaders.len() + world.followers.len()) * world.steps) as f64
}

/// Measurements of a GPU and of the CPU beside it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Measured {
    /// Seconds to open the GPU.
    open_s: f64,
    /// Seconds per generation of a small population.
    generation_s: f64,
    /// Agent-steps per second beyond that.
    agent_steps_per_s: f64,
    /// Agent-steps per second of one CPU thread.
    cpu_agent_steps_per_s: f64,
}

/// A choice, and the reason for people.
#[derive(Clone, Debug, PartialEq)]
struct Choice {
    gpu: bool,
    reason: String,
}

/// Chooses by the work, the CPU's threads and the measurement. `None` if there is none and it is worth its time.
fn choose(work: Work, threads: usize, measured: Option<Measured>) -> Option<Choice> {
    let rate = measured.map_or(CPU_RATE, |measured| measured.cpu_agent_steps_per_s);
    let on_cpu = work.agent_steps / (rate * threads.max(1) as f64);
    match measured {
        _ if on_cpu < MIN_GPU_WORK_SECONDS => {
            Some(Choice { gpu: false, reason: format!("{} of work, too little for a GPU to pay", time(on_cpu)) })
        }
        None => None,
        Some(Measured { open_s, generation_s, agent_steps_per_s, .. }) => {
            let on_gpu = open_s + work.generations * generation_s + work.agent_steps / agent_steps_per_s;
            let reason = format!("{} there, {} on the CPU, as measured", time(on_gpu), time(on_cpu));
            let instead = format!("{} there, {} on the GPU, as measured", time(on_cpu), time(on_gpu));
            Some(match on_gpu < on_cpu {
                true => Choice { gpu: true, reason },
                false => Choice { gpu: false, reason: instead },
            })
        }
    }
}

fn time(seconds: f64) -> String {
    match seconds {
        ..1.0 => "under a second".into(),
        1.0..120.0 => format!("about {seconds:.0} s"),
        _ => format!("about {}", humantime::format_duration(Duration::from_secs((seconds / 60.0).round() as u64 * 60))),
    }
}

/// Times generations on a GPU that took `open_s` seconds to open, and on the CPU.
fn measure(gpu: &mut GpuBackend, open_s: f64, threads: usize) -> Result<Measured, BackendError> {
    let (small, _) = seconds(gpu, SMALL_TEAMS)?;
    let (large, steps) = seconds(gpu, LARGE_TEAMS)?;
    let (cpu, cpu_steps) = seconds(&mut Cpu::default(), CPU_TEAMS)?;
    Ok(Measured {
        open_s,
        generation_s: small,
        agent_steps_per_s: steps / (large - small).max(1e-6),
        cpu_agent_steps_per_s: cpu_steps / cpu.max(1e-6) / threads.max(1) as f64,
    })
}

/// Returns the seconds per generation of this many teams, and its agent-steps.
fn seconds(backend: &mut dyn Backend, teams: usize) -> Result<(f64, f64), BackendError> {
    let mut config = Config::parse(CONFIG, "generally_forward.toml").expect("the project's own config");
    (config.learning.trials, config.learning.population) = (1, teams);
    let world = World::new(&config);
    let mut trainer = Trainer::new([config.validate()?]);
    // The first generation compiles and allocates.
    trainer.advance(backend)?;
    let mut shortest = f64::INFINITY;
    for _ in 0..REPEATS {
        let start = Instant::now();
        trainer.advance(backend)?;
        shortest = shortest.min(start.elapsed().as_secs_f64());
    }
    Ok((shortest, (teams * world.agents() * world.steps()) as f64))
}

/// Returns the file that keeps the measurement of a device, if there is a place for it. `FLOTILLA_CACHE` names the
/// folder; if it is empty, nothing is kept.
fn file(adapter: &AdapterInfo) -> Option<PathBuf> {
    let variable = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    let folder = match std::env::var_os("FLOTILLA_CACHE") {
        Some(folder) => Some(PathBuf::from(folder)).filter(|folder| !folder.as_os_str().is_empty()),
        None if cfg!(windows) => variable("LOCALAPPDATA").map(|folder| folder.join("flotilla")),
        None if cfg!(target_os = "macos") => variable("HOME").map(|home| home.join("Library/Caches/flotilla")),
        None => variable("XDG_CACHE_HOME")
            .or_else(|| variable("HOME").map(|home| home.join(".cache")))
            .map(|folder| folder.join("flotilla")),
    };
    // Another driver or version may be faster or slower.
    let digest = Sha256::digest(format!("{adapter} {VERSION}"));
    folder.map(|folder| folder.join(format!("device-{}.json", hex(&digest[..8]))))
}

/// Returns an earlier measurement of a device. A damaged file counts as none.
fn recall(adapter: &AdapterInfo) -> Option<Measured> {
    let text = fs::read(file(adapter)?).ok()?;
    let measured: Measured = serde_json::from_slice(&text).ok()?;
    let Measured { open_s, generation_s, agent_steps_per_s, cpu_agent_steps_per_s } = measured;
    let sound = [open_s, generation_s, agent_steps_per_s, cpu_agent_steps_per_s].iter().all(|&number| number > 0.0);
    sound.then_some(measured)
}

/// Writes a measurement to the cache. Returns a message if that fails, because each run then measures again.
fn remember(adapter: &AdapterInfo, measured: &Measured) -> Result<(), String> {
    let Some(path) = file(adapter) else { return Ok(()) };
    let text = serde_json::to_vec_pretty(measured).expect("numbers have a JSON form");
    let folder = path.parent().map_or(Ok(()), fs::create_dir_all);
    // Another process that reads it now gets the old file or the new one.
    let new = path.with_extension(format!("{}", std::process::id()));
    let written = folder.and_then(|()| fs::write(&new, text)).and_then(|()| fs::rename(&new, &path));
    written.map_err(|error: io::Error| {
        let _ = fs::remove_file(&new);
        format!("{}: the GPU's speed cannot be kept: {error}; set FLOTILLA_CACHE", path.escaped())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const FAST: Measured =
        Measured { open_s: 2.0, generation_s: 0.4e-3, agent_steps_per_s: 2e10, cpu_agent_steps_per_s: 1e8 };

    fn work(population: usize, generations: usize, trials: usize) -> Work {
        let mut config = Config::parse(CONFIG, "generally_forward.toml").unwrap();
        (config.learning.population, config.learning.generations) = (population, generations);
        config.learning.trials = trials;
        Work::of([&config])
    }

    #[test]
    fn short_runs_stay_on_the_cpu_and_long_ones_are_measured() {
        let short = choose(work(50, 200, 1), 2, None).unwrap();
        assert!(!short.gpu && short.reason.contains("too little for a GPU"), "{short:?}");
        assert_eq!(choose(work(50, 200, 1), 2, Some(FAST)).map(|choice| choice.gpu), Some(false));
        let long = work(1 << 20, 200, 1);
        assert_eq!(choose(long, 2, None), None);
        let chosen = choose(long, 2, Some(FAST)).unwrap();
        assert!(chosen.gpu && chosen.reason.contains("as measured"), "{chosen:?}");
        // As fast as a few threads, so that many are faster.
        let slow = Measured { agent_steps_per_s: 4e8, ..FAST };
        assert_eq!([2, 64].map(|threads| choose(long, threads, Some(slow)).unwrap().gpu), [true, false]);
        // Many short generations.
        let often = Measured { generation_s: 1.0, ..FAST };
        assert!(!choose(work(1000, 2000, 10), 2, Some(often)).unwrap().gpu);
    }

    #[test]
    fn many_short_calls_are_worth_a_look_for_a_gpu() {
        let (mut total, short) = (WorkTotal::new(), work(4096, 20, 1));
        let looked: Vec<usize> = (1..=64 * 64).filter(|_| total.add_for(short, 2).is_some()).collect();
        // Not at first, and ever more rarely.
        let first = looked[0];
        assert!(first > 1 && looked.len() > 3, "{looked:?}");
        assert!(looked.windows(2).all(|pair| pair[1] == 2 * pair[0]), "{looked:?}");
        // Work that takes no time is no reason.
        assert_eq!(total.add_for(Work::default(), 2), None);
        assert!(WorkTotal::new().add_for(work(1 << 20, 200, 1), 2).is_some());
    }

    #[test]
    fn experiments_side_by_side_share_their_generations() {
        let (one, mut config) = (work(50, 200, 4), Config::parse(CONFIG, "generally_forward.toml").unwrap());
        (config.learning.population, config.learning.generations, config.learning.trials) = (50, 100, 4);
        let both = {
            let mut longer = config.clone();
            longer.learning.generations = 200;
            Work::of([&longer, &config])
        };
        assert_eq!(both.generations, one.generations);
        assert!(both.agent_steps > 1.4 * one.agent_steps && both.agent_steps < 1.6 * one.agent_steps);
    }
}
