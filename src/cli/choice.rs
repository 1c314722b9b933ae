//! `--backend auto`: chooses the processor that is expected to be done first. Results do not depend on it.
//!
//! Opening a GPU and compiling for it takes seconds, and short runs are over before. Long runs pay for a measurement of
//! both processors. It is kept in a file per device, in the user's cache.

use std::fs;
use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::{Error, say};
use crate::VERSION;
use crate::backend::Backend;
use crate::backend::cpu::Cpu;
use crate::backend::gpu::device::AdapterInfo;
use crate::backend::gpu::episode::GpuBackend;
use crate::config::Config;
use crate::escape::PathExt;
use crate::host::Instant;
use crate::trainer::Trainer;
use crate::world::World;

/// Agent-steps per second of one CPU thread, about. Only runs that take longer than [`SHORT`] by this are measured.
const CPU_RATE: f64 = 1e8;
/// Seconds of a run on the CPU below which no GPU is opened, because opening takes about as long.
const SHORT: f64 = 5.0;
/// Teams of the generations that are timed: of a GPU's fixed cost, of its rate, and of the CPU's rate.
const SMALL: usize = 50;
const LARGE: usize = 16_384;
const ON_CPU: usize = 2048;
/// Timed generations, of which the shortest counts.
const REPEATS: usize = 3;
/// The layout that is timed.
const CONFIG: &str = include_str!("../../configs/generally_forward.toml");

/// The episodes of a command.
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

    /// Returns the work of playing this many teams of a config.
    pub fn of_teams(config: &Config, teams: usize) -> Work {
        Work { generations: 1.0, agent_steps: teams as f64 * team(config) }
    }
}

/// Returns the agent-steps of one trial's generation.
fn generation(config: &Config) -> f64 {
    ((config.learning.teams() + 1) * config.learning.episodes_per_team) as f64 * team(config)
}

/// Returns the agent-steps of one team's episode.
fn team(config: &Config) -> f64 {
    let world = &config.at(0).world;
    ((world.leaders.len() + world.followers.len()) * world.steps) as f64
}

/// Measurements of a GPU and of the CPU beside it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Measured {
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
pub struct Choice {
    pub gpu: bool,
    pub reason: String,
}

/// Chooses by the work, the CPU's threads and what was measured. `None` if a measurement is worth its time.
pub fn choose(work: Work, threads: usize, measured: Option<Measured>) -> Option<Choice> {
    let rate = measured.map_or(CPU_RATE, |measured| measured.cpu_agent_steps_per_s);
    let on_cpu = work.agent_steps / (rate * threads.max(1) as f64);
    match measured {
        _ if on_cpu < SHORT => {
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
///
/// # Errors
/// The GPU failed.
pub fn measure(gpu: &mut GpuBackend, open_s: f64, threads: usize) -> Result<Measured, Error> {
    let (small, _) = seconds(gpu, SMALL)?;
    let (large, steps) = seconds(gpu, LARGE)?;
    let (cpu, cpu_steps) = seconds(&mut Cpu::default(), ON_CPU)?;
    Ok(Measured {
        open_s,
        generation_s: small,
        agent_steps_per_s: steps / (large - small).max(1e-6),
        cpu_agent_steps_per_s: cpu_steps / cpu.max(1e-6) / threads.max(1) as f64,
    })
}

/// Returns seconds per generation of so many teams, and its agent-steps.
fn seconds(backend: &mut dyn Backend, teams: usize) -> Result<(f64, f64), Error> {
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
/// directory; if it is empty, nothing is kept.
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
    let name: String = digest[..8].iter().map(|byte| format!("{byte:02x}")).collect();
    folder.map(|folder| folder.join(format!("device-{name}.json")))
}

/// Returns what was measured of a device before. A damaged file counts as none.
pub fn recall(adapter: &AdapterInfo) -> Option<Measured> {
    let text = fs::read(file(adapter)?).ok()?;
    let measured: Measured = serde_json::from_slice(&text).ok()?;
    let Measured { open_s, generation_s, agent_steps_per_s, cpu_agent_steps_per_s } = measured;
    let sound = [open_s, generation_s, agent_steps_per_s, cpu_agent_steps_per_s].iter().all(|&number| number > 0.0);
    sound.then_some(measured)
}

/// Keeps what was measured. Says so if that fails, because each run measures again.
pub fn remember(adapter: &AdapterInfo, measured: &Measured) {
    let Some(path) = file(adapter) else { return };
    let text = serde_json::to_vec_pretty(measured).expect("numbers have a JSON form");
    let folder = path.parent().map_or(Ok(()), fs::create_dir_all);
    // Whoever reads it meanwhile gets the old file or the new one.
    let new = path.with_extension(format!("{}", std::process::id()));
    if let Err(error) = folder.and_then(|()| fs::write(&new, text)).and_then(|()| fs::rename(&new, &path)) {
        let _ = fs::remove_file(&new);
        say(format_args!("note: {}: the GPU's speed cannot be kept: {error}; set FLOTILLA_CACHE", path.escaped()));
    }
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
