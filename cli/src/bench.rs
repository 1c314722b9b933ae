//! `flotilla bench`: measures how fast teams are played, alone and within whole generations.

use std::fmt::Write;
use std::path::PathBuf;
use std::time::Duration;

use fearless_simd::Level;
use serde_json::json;

use super::{
    BackendChoice, Breed, Error, Overrides, ProcessorInfo, RunOptions, backend, between, print, print_json, with_remedy,
};
use crate::measure::{self, Profile, Subject, Timing};
use flotilla::backend::Machine;
use flotilla::backend::cpu::{Cpu, level_name};
use flotilla::config::{self, Config};
use flotilla::front;
use flotilla::memory::Peaks;
use flotilla_app::import;
use flotilla_app::run::RunError;

/// Default numbers of teams, for the table and for JSON.
const TEAMS: [u32; 3] = [50, 4096, 131_072];
const JSON_TEAMS: u32 = 4096;

#[derive(clap::Args)]
pub struct Args {
    /// Config file (TOML), or - for standard input [default: the paper's generally forward layout]
    config: Option<PathBuf>,
    #[command(flatten)]
    overrides: Overrides,
    #[command(flatten)]
    run: RunOptions,
    /// Teams per generation, one or several [default: 50,4096,131072; with --json, 4096]
    #[arg(long, value_name = "N,…", value_delimiter = ',',
        value_parser = between(2..=config::MAX_POPULATION as u32))]
    teams: Vec<u32>,
    /// Steps per episode, one or several [default: the config's]
    #[arg(long, value_name = "N,…", value_delimiter = ',',
        value_parser = between(1..=config::MAX_STEPS as u32))]
    steps: Vec<u32>,
    /// Agents per team, one or several: leaders and followers in the config's ratio, laid out in groups as by
    /// `flotilla sweep` [default: the config's]
    #[arg(long, value_name = "N,…", value_delimiter = ',',
        value_parser = between(1..=config::MAX_LEARNERS as u32))]
    agents: Vec<u32>,
    /// Train for this many generations first. Trained teams observe more POIs, so that scoring them takes longer
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = between(0..=1000u32))]
    trained: u32,
    /// Measure rollouts only, not whole generations
    #[arg(long)]
    rollout_only: bool,
    /// Also print where a generation's time goes, and on a GPU the bytes over its bus
    #[arg(long, conflicts_with = "rollout_only")]
    profile: bool,
    /// Instruction set of the CPU backend [default: the widest that this processor has]
    #[arg(long, value_name = "NAME")]
    instructions: Option<String>,
    /// Print JSON objects, one per line
    #[arg(long)]
    json: bool,
}

/// Prints a table or JSON objects, with one row per combination of teams, steps and agents.
pub fn run(args: Args) -> Result<(), Error> {
    if !measure::has_clock() {
        let message = "the system's monotonic clock does not advance, so nothing can be timed; run bench where it does";
        return Err(Error::Refused(message.into()));
    }
    let (name, text) = match &args.config {
        Some(path) => (config::name(path), import::read_file(path)?),
        None => ("configs/generally_forward.toml".into(), config::LAYOUTS[0].1.into()),
    };
    // Only the first stage is measured.
    let config = Config::read(&text, &name, &[], &args.overrides.list())?.validate()?;
    let configs = combinations(config.at(0), &args)?;
    let (mut subject, machine) = open(&args)?;
    for config in &configs {
        let plan = Peaks::of([&config.validate()?], rayon::current_num_threads());
        plan.check(machine.backend == "gpu").map_err(RunError::from)?;
    }
    if !args.json {
        print(&format!("{name} on {}\n{HEADER}\n", subject.backend().describe()))?;
    }
    for config in configs {
        let timing = measure::measure(&config, &mut subject, args.trained as usize, args.rollout_only, args.profile)?;
        let profile = timing.generation.as_ref().map(|(_, profile)| profile).filter(|_| args.profile);
        match args.json {
            true => {
                let mut object = json(&timing, profile);
                ProcessorInfo::of(&machine, &subject.backend().describe()).add_to(&mut object);
                print_json(&object)?;
            }
            false => print(&line(&timing, profile))?,
        }
    }
    if args.json { Ok(()) } else { print(LEGEND) }
}

/// Returns the config of every row.
fn combinations(config: &Config, args: &Args) -> Result<Vec<Config>, Error> {
    let own_agents = [config.clone()];
    let laid_out = |&agents: &u32| {
        measure::with_agents(config, agents as usize)
            .map_err(|message| Error::Usage(format!("--agents: {message}").into()))
    };
    let laid_out = args.agents.iter().map(laid_out).collect::<Result<Vec<_>, _>>()?;
    let worlds = if laid_out.is_empty() { &own_agents[..] } else { &laid_out };
    let own_steps = [config.world.steps as u32];
    let steps = if args.steps.is_empty() { &own_steps[..] } else { &args.steps };
    let teams = match (&args.teams[..], args.json) {
        ([], false) => &TEAMS[..],
        ([], true) => &[JSON_TEAMS],
        (teams, _) => teams,
    };
    let mut configs = Vec::with_capacity(worlds.len() * steps.len() * teams.len());
    for world in worlds {
        for &steps in steps {
            for &teams in teams {
                let mut config = world.clone();
                config.world.steps = steps as usize;
                config.learning.population = teams as usize;
                config.learning.trials = 1;
                config.learning.episodes_per_team = 1;
                config.learning.test_episodes = 0;
                config.learning.generations = config::MAX_GENERATIONS;
                configs.push(config);
            }
        }
    }
    Ok(configs)
}

fn open(args: &Args) -> Result<(Subject, Machine), Error> {
    let cpu = |level| (Subject::Cpu(Cpu::at_level(level), level), front::cpu().1);
    let Some(name) = &args.instructions else {
        return Ok(match backend::open_gpu(&args.run, None)?.0 {
            Some(gpu) => {
                let machine = Machine::of_gpu(&gpu);
                (Subject::Gpu(Box::new(gpu)), machine)
            }
            None => cpu(Level::new()),
        });
    };
    let refused = |advice| Err(Error::Usage(with_remedy("--instructions is for the CPU backend", advice)));
    if args.run.backend == BackendChoice::Gpu {
        return refused("leave out --backend gpu");
    }
    let levels = Cpu::levels();
    let Some(&level) = levels.iter().find(|level| level_name(**level).eq_ignore_ascii_case(name)) else {
        let names: Vec<_> = levels.iter().map(|level| level_name(*level)).collect();
        let names = names.join(", ");
        return Err(Error::Usage(format!("--instructions: found {name}, this processor has {names}").into()));
    };
    if args.run.adapter.is_some() || args.run.breed == Breed::Device {
        return refused("leave out --adapter and --breed device");
    }
    backend::start_threads(args.run.threads);
    Ok(cpu(level))
}

const HEADER: &str = "   teams  agents  steps   rollouts/s  team-steps/s  ns/agent-step  generations  of ceiling";
const LEGEND: &str = "\
A rollout plays and scores all teams once; generations also select and mutate: their rate, of rollouts alone.
The ceiling is what chains of f32 sums and products in registers reach, none fused; benches/README.md says what counts.
";

fn line(measure: &Timing, profile: Option<&Profile>) -> String {
    let Timing { teams, world, rollout, generation, .. } = measure;
    let (agents, steps) = (world.agents(), world.steps());
    let generations =
        generation.as_ref().map_or("-".into(), |(generation, _)| format!("{:.0}%", 100.0 * rollout / generation));
    let mut line = format!(
        "{teams:>8} {agents:>7} {steps:>6} {:>12.3} {:>13.4e} {:>14.2} {generations:>12} {:>10.0}%\n",
        1.0 / rollout,
        measure.team_steps() / rollout,
        1e9 * rollout / (measure.team_steps() * agents as f64),
        100.0 * measure.ceiling_share(),
    );
    if let Some(profile) = profile {
        let phases = phases(profile);
        let whole: f64 = phases.iter().filter(|(_, part, _)| !part).map(|(.., ms)| ms).sum();
        for (name, part, ms) in phases {
            let name = format!("{}{}", if part { "  of it, " } else { "" }, name.replace('_', " "));
            let _ = writeln!(line, "{:>8} {name:<24} {ms:>12.4} ms {:>5.1}%", "", 100.0 * ms / whole);
        }
        if let Some(times) = &profile.gpu_times {
            let ms = 1e3 * times.longest.as_secs_f64();
            let _ = writeln!(line, "{:>8} {:<24} {ms:>12.4} ms", "", "longest submission");
        }
        for (name, part, bytes) in traffic(profile) {
            let name = format!("{}{}", if part { "  of it, " } else { "" }, name.replace('_', " "));
            let _ = writeln!(line, "{:>8} {name:<24} {:>12.4} MB", "", 1e-6 * bytes);
        }
    }
    line
}

/// Returns the phases of a generation in order, each with its time in ms. `true` marks a part of the rollout before it.
fn phases(profile: &Profile) -> Vec<(&'static str, bool, f64)> {
    let Profile { generations, times, gpu_times, .. } = profile;
    let mut rows = vec![("teams_and_starts", false, times.prepare), ("rollout_and_scores", false, times.play)];
    if let Some(on_gpu) = gpu_times {
        rows.extend([
            ("gather", true, on_gpu.gather),
            ("upload", true, on_gpu.upload),
            ("wait", true, on_gpu.wait),
            ("read_back", true, on_gpu.read_back),
            ("score", true, on_gpu.score),
        ]);
        if !on_gpu.gpu.is_zero() {
            rows.push(("gpu_by_its_clock", true, on_gpu.gpu));
        }
    }
    rows.extend([("fitness_and_champions", false, times.collect), ("selection_and_mutation", false, times.breed)]);
    let ms = |time: Duration| 1e3 * time.as_secs_f64() / *generations as f64;
    rows.into_iter().map(|(name, part, time)| (name, part, ms(time))).collect()
}

/// Returns the bytes per generation that cross a GPU's bus, in both directions. `true` marks the rollout's part of the
/// total before it.
fn traffic(profile: &Profile) -> Vec<(&'static str, bool, f64)> {
    let Profile { generations, gpu_times, traffic, .. } = profile;
    let rows = gpu_times.iter().flat_map(|times| {
        let rollouts = times.traffic;
        [
            ("up_to_the_device", false, traffic.up),
            ("rollout_up", true, rollouts.up),
            ("down_from_it", false, traffic.down),
            ("rollout_down", true, rollouts.down),
        ]
    });
    rows.map(|(name, part, bytes)| (name, part, bytes as f64 / *generations as f64)).collect()
}

fn json(measure: &Timing, profile: Option<&Profile>) -> serde_json::Value {
    let Timing { teams, world, rollout, mean_g, reach, operations, ceiling, .. } = measure;
    let agents = world.agents();
    let mut object = json!({
        "teams": teams,
        "agents": agents,
        "leaders": world.leaders(),
        "followers": world.followers(),
        "pois": world.pois.len(),
        "steps": world.steps(),
        "rollouts_per_s": 1.0 / rollout,
        "team_steps_per_s": measure.team_steps() / rollout,
        "ns_per_agent_step": 1e9 * rollout / (measure.team_steps() * agents as f64),
        "mean_g": mean_g,
        "pairs_in_reach": reach.pairs,
        "sensed": reach.sensed.iter().flatten().sum::<f64>(),
        "met": reach.met.iter().flatten().sum::<f64>(),
        "operations_per_team_step": operations,
        "ceiling_operations_per_s": ceiling,
        "ceiling_share": measure.ceiling_share(),
    });
    if let Some((generation, _)) = measure.generation {
        object["generations_per_s"] = json!(1.0 / generation);
        object["generation_team_steps_per_s"] = json!(measure.team_steps() / generation);
        object["generation_share"] = json!(rollout / generation);
    }
    if let Some(profile) = profile {
        let phases = phases(profile).into_iter().map(|(name, _, ms)| (format!("{name}_ms"), json!(ms)));
        let traffic = traffic(profile).into_iter().map(|(name, _, bytes)| (format!("{name}_bytes"), json!(bytes)));
        let longest = profile.gpu_times.map(|times| 1e3 * times.longest.as_secs_f64());
        let longest = longest.map(|ms| ("longest_submission_ms".to_string(), json!(ms)));
        object["profile"] = serde_json::Value::Object(phases.chain(longest).chain(traffic).collect());
    }
    object
}

#[cfg(test)]
mod tests {
    use clap::{Args as _, FromArgMatches};

    use super::*;

    /// The time of a generation is compared with that of a rollout, which plays one episode per team.
    #[test]
    fn generations_play_one_episode_per_team() {
        let text = config::LAYOUTS[1].1;
        let text = text.replace("[learning]", "[learning]\nepisodes_per_team = 8\nstart_jitter = 1.0");
        let config = Config::parse(&text, "config.toml").unwrap();
        let words = ["bench", "--teams", "2,3", "--steps", "1,2"];
        let matches = Args::augment_args(clap::Command::new("bench")).get_matches_from(words);
        let configs = combinations(&config, &Args::from_arg_matches(&matches).unwrap()).unwrap();
        assert_eq!(configs.len(), 4);
        assert!(configs.iter().all(|config| config.learning.episodes_per_team == 1));
    }
}
