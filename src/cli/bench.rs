//! `flotilla bench`: how fast teams are played, alone and within whole generations.

use std::cell::RefCell;
use std::hint::black_box;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::{Duration, Instant};

use fearless_simd::Level;
use serde_json::json;

use super::{BackendChoice, Error, Overrides, RunOptions, backend, print};
use crate::backend::cpu::{Cpu, level_name};
use crate::backend::{Backend, Group};
use crate::config::{self, Config};
use crate::credit::Credit;
use crate::evolve::{Key, Purpose, form_teams, random_policy};
use crate::run::Machine;
use crate::trainer::Trainer;
use crate::world::World;

/// Team counts of the table.
const TEAMS: [u32; 3] = [50, 4096, 131_072];
/// Timed repeats, of which the median counts, and the least time that each takes.
const REPEATS: usize = 5;
const LEAST: Duration = Duration::from_millis(200);

#[derive(clap::Args)]
pub struct Args {
    /// Config file (TOML) [default: the paper's generally forward layout]
    config: Option<PathBuf>,
    #[command(flatten)]
    overrides: Overrides,
    #[command(flatten)]
    run: RunOptions,
    /// Teams of a generation [default: 50, 4096 and 131072; with --json, 4096]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..=config::MAX_POPULATION as i64))]
    teams: Option<u32>,
    /// Instruction set of the CPU backend, of those that this processor has [default: the widest]
    #[arg(long, value_name = "NAME")]
    instructions: Option<String>,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// What was measured at one number of teams.
struct Measure {
    teams: usize,
    agents: usize,
    steps: usize,
    /// Seconds of one rollout (episodes, record and scores) and of one generation (that, selection and mutation).
    rollout: f64,
    generation: f64,
    mean_g: f64,
}

impl Measure {
    fn team_steps(&self) -> f64 {
        (self.teams * self.steps) as f64
    }
}

/// Prints a table, a line a number of teams, or one JSON object.
pub fn run(args: Args) -> Result<(), Error> {
    let (name, text) = match &args.config {
        Some(path) => (path.display().to_string(), config::read_file(path)?),
        None => {
            let text = include_str!("../../configs/generally_forward.toml");
            ("configs/generally_forward.toml".into(), text.into())
        }
    };
    let mut config = Config::read(&text, &name, &[], &args.overrides.list())?;
    config.learning.trials = 1;
    config.learning.generations = config::MAX_GENERATIONS;
    let (mut backend, machine) = open(&args)?;
    let counts = match args.teams {
        Some(teams) => vec![teams],
        None if args.json => vec![TEAMS[1]],
        None => TEAMS.to_vec(),
    };
    if !args.json {
        print(&format!(
            "{} on {}\n{:>8} {:>14} {:>14} {:>16} {:>16}\n",
            name,
            backend.describe(),
            "teams",
            "rollouts/s",
            "generations/s",
            "team-steps/s",
            "of rollout alone"
        ))?;
    }
    for teams in counts {
        let measure = measure(&config, teams as usize, &mut *backend)?;
        print(&if args.json { json(&measure, &machine) } else { line(&measure) })?;
    }
    Ok(())
}

fn open(args: &Args) -> Result<(Box<dyn Backend>, Machine), Error> {
    let Some(name) = &args.instructions else { return backend::open(&args.run) };
    if args.run.backend == BackendChoice::Gpu {
        return Err(Error::Usage("--instructions is for the CPU backend; leave out --backend gpu".into()));
    }
    let levels = Cpu::levels();
    let chosen = levels.iter().find(|level| level_name(**level).eq_ignore_ascii_case(name));
    let Some(&level) = chosen else {
        let names: Vec<_> = levels.iter().map(|level| level_name(*level)).collect();
        return Err(Error::Usage(format!("--instructions: found {name}, this processor has {}", names.join(", "))));
    };
    backend::start_threads(&args.run)?;
    let (_, machine) = backend::cpu();
    Ok((Box::new(Cpu::at_level(level)), machine))
}

fn measure(config: &Config, teams: usize, backend: &mut dyn Backend) -> Result<Measure, Error> {
    let mut config = config.clone();
    config.learning.population = teams;
    config.learning.elites = config.learning.elites.min(teams);
    let world = World::new(&config);
    let (rollout, mean_g) = rollout(&config, &world, backend)?;
    let mut trainer = Trainer::new(vec![config]);
    let generation = median_seconds(|| trainer.advance(backend).map(drop))?;
    Ok(Measure { teams, agents: world.agents(), steps: world.steps(), rollout, generation, mean_g })
}

/// Seconds of one rollout of random policies, scored as in training, and the mean G.
fn rollout(config: &Config, world: &World, backend: &mut dyn Backend) -> Result<(f64, f64), Error> {
    thread_local! { static CREDIT: RefCell<(Credit, Vec<f32>)> = RefCell::default(); }
    let (population, leaders, seed) = (config.learning.population, world.leaders(), config.learning.seed);
    let mut weights = vec![0.0; leaders * population * world.parameters()];
    let key = Key::new(seed, 0, Purpose::Weights);
    for (policy, weights) in weights.chunks_exact_mut(world.parameters()).enumerate() {
        random_policy(Level::new(), key.at(0, policy / population, policy % population), weights);
    }
    let mut teams = vec![0; population * leaders];
    form_teams(Key::new(seed, 0, Purpose::Teams), 0, leaders, &mut teams);
    let group = Group { world, starts: &world.starts, weights: &weights, policies: population, teams: &teams };
    let observed = AtomicU64::new(0);
    let seconds = median_seconds(|| {
        observed.store(0, Relaxed);
        backend.rollout(&[group], &|episode| {
            CREDIT.with_borrow_mut(|(credit, scores)| {
                scores.resize(leaders, 0.0);
                let pois = credit.score(&episode, world, config.learning.fitness, scores);
                observed.fetch_add(u64::from(pois), Relaxed);
                black_box(scores);
            });
        })
    })?;
    Ok((seconds, observed.into_inner() as f64 / (population * world.pois.len()) as f64))
}

/// The median over [`REPEATS`] of the time of one call, each repeat calling for [`LEAST`] at least.
fn median_seconds<E: Into<Error>>(mut call: impl FnMut() -> Result<(), E>) -> Result<f64, Error> {
    call().map_err(Into::into)?;
    let mut seconds = Vec::with_capacity(REPEATS);
    for _ in 0..REPEATS {
        let (start, mut calls) = (Instant::now(), 0);
        while calls == 0 || start.elapsed() < LEAST {
            call().map_err(Into::into)?;
            calls += 1;
        }
        seconds.push(start.elapsed().as_secs_f64() / f64::from(calls));
    }
    seconds.sort_by(f64::total_cmp);
    Ok(seconds[REPEATS / 2])
}

fn line(measure: &Measure) -> String {
    format!(
        "{:>8} {:>14.2} {:>14.2} {:>16.4e} {:>15.0}%\n",
        measure.teams,
        1.0 / measure.rollout,
        1.0 / measure.generation,
        measure.team_steps() / measure.rollout,
        100.0 * measure.rollout / measure.generation,
    )
}

fn json(measure: &Measure, machine: &Machine) -> String {
    let Measure { teams, agents, steps, rollout, generation, mean_g } = measure;
    let object = json!({
        "backend": machine.backend,
        "adapter": machine.adapter,
        "threads": machine.threads,
        "teams": teams,
        "agents": agents,
        "steps": steps,
        "team_steps_per_s": measure.team_steps() / rollout,
        "generations_per_s": 1.0 / generation,
        "generation_team_steps_per_s": measure.team_steps() / generation,
        "mean_g": mean_g,
    });
    format!("{object}\n")
}
