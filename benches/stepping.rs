//! Compares the speed of stepping with that of rollouts. The same teams play the same steps as rollouts, as rollouts
//! with the smallest possible network, and with [`Stepper`], in alternating rounds.
//!
//! ```text
//! cargo bench --bench stepping [-- CONFIG [TEAMS [ROUNDS]]]
//! ```
//!
//! The output of each leader is constant, and drawn per leader. Networks of any size therefore play the same episodes.
//! The time that a network takes does not depend on its weights.

use std::error::Error;
use std::path::Path;
use std::time::{Duration, Instant};

use fearless_simd::Level;
use flotilla::backend::cpu::{Cpu, level_name};
use flotilla::backend::{Backend, Group};
use flotilla::config::{Config, own_populations};
use flotilla::evolve::{Key, Purpose, aligned_teams, random_policy};
use flotilla::stepping::{Recording, Stepper};
use flotilla::world::{OUTPUTS, World};

/// Minimum time per measurement.
const MIN_TIME: Duration = Duration::from_millis(150);

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|argument| argument != "--bench").collect();
    let config = Config::load(Path::new(arguments.first().map_or("configs/generally_forward.toml", |path| path)))?;
    let teams: usize = arguments.get(1).map_or(Ok(4096), |number| number.parse())?;
    let rounds: usize = arguments.get(2).map_or(Ok(9), |number| number.parse())?;
    for level in Cpu::levels().into_iter().filter(|level| ["AVX2", "AVX-512", "NEON"].contains(&level_name(*level))) {
        measure(&config, level, teams, rounds)?;
    }
    Ok(())
}

fn measure(config: &Config, level: Level, teams: usize, rounds: usize) -> Result<(), Box<dyn Error>> {
    let mut small = config.clone();
    small.policy.hidden.clear();
    let (world, small) = (World::new(&config.validate()?), World::new(&small.validate()?));
    let leaders = world.leaders();
    let weights = [&world, &small].map(|world| constant(world, teams, config.learning.seed));
    let order = aligned_teams(teams, leaders);
    let group =
        |world, weights| Group { populations: own_populations(leaders), ..Group::new(world, weights, teams, &order) };
    let groups = [group(&world, &weights[0][..]), group(&small, &weights[1][..])];
    let mut cpu = Cpu::at_level(level);
    let mut rollout = |group| cpu.play(&[group]).map(|scores| _ = std::hint::black_box(scores));

    // A trace of one step gives the constant outputs, which the stepper gets as actions.
    let mut one_step = config.clone();
    one_step.world.steps = 1;
    let one_step = World::new(&one_step.validate()?);
    let trace = Cpu::default().trace(&Group { world: &one_step, starts: &world.starts, ..groups[0] })?;
    let actions: Vec<f32> = (0..teams)
        .flat_map(|team| (0..leaders).map(move |leader| (team, leader)))
        .flat_map(|(team, leader)| trace.moment(1, team, leader).outputs)
        .collect();
    let mut stepper = Stepper::at_level(level, usize::MAX, world.clone(), teams, Recording::None)?;
    let mut states = 0.0;
    let mut steps = |with_states: bool| -> Result<(), Box<dyn Error>> {
        stepper.reset();
        for _ in 0..world.steps() {
            stepper.step(&actions)?;
            if with_states {
                states += stepper.states().speeds[0];
            }
        }
        Ok(())
    };

    let agent_steps = (teams * world.agents() * world.steps()) as f64;
    let mut rows = [const { Vec::new() }; 4];
    for _ in 0..rounds {
        rows[0].push(time(|| Ok(rollout(groups[0])?))?);
        rows[1].push(time(|| Ok(rollout(groups[1])?))?);
        rows[2].push(time(|| steps(false))?);
        rows[3].push(time(|| steps(true))?);
    }
    println!("{}, {teams} teams, {rounds} rounds: ns per agent-step, relative to the first", level_name(level));
    let names = ["rollout", "rollout without hidden units", "stepping", "stepping, and reading all states"];
    for (name, row) in names.into_iter().zip(&rows) {
        let shares = row.iter().zip(&rows[0]).map(|(time, rollout)| time / rollout);
        println!("  {name:<34}{:>6.2}{:>7.2}", median(row.clone()) / agent_steps * 1e9, median(shares.collect()));
    }
    Ok(())
}

/// Returns policies with constant outputs, `[leaders][teams][parameters]`. All weights are 0 except the biases of the
/// outputs.
fn constant(world: &World, teams: usize, seed: u64) -> Vec<f32> {
    let (key, parameters) = (Key::new(seed, 0, Purpose::Weights), world.parameters());
    let inputs = world.constants.policy.widths[world.constants.policy.layers as usize - 1] as usize;
    let mut weights = vec![0.0; world.leaders() * teams * parameters];
    for (index, policy) in weights.chunks_exact_mut(parameters).enumerate() {
        let mut biases = [0.0; OUTPUTS];
        random_policy(Level::new(), key.at(0, index / teams, index % teams), &mut biases);
        for (unit, bias) in biases.into_iter().enumerate() {
            policy[parameters - (OUTPUTS - 1 - unit) * (inputs + 1) - 1] = bias;
        }
    }
    weights
}

/// Returns the seconds per call.
fn time(mut call: impl FnMut() -> Result<(), Box<dyn Error>>) -> Result<f64, Box<dyn Error>> {
    let (start, mut calls) = (Instant::now(), 0);
    while calls == 0 || start.elapsed() < MIN_TIME {
        call()?;
        calls += 1;
    }
    Ok(start.elapsed().as_secs_f64() / f64::from(calls))
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
