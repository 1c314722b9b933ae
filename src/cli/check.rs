//! `flotilla check`: prints the resolved config, and the cost of a run.

use std::path::PathBuf;

use serde::Serialize;

use super::{ConfigArgs, Error, output, plot, print, print_json, warnings};
use crate::backend;
use crate::config::Config;
use crate::memory::Peaks;
use crate::reach;
use crate::report::map;
use crate::world::World;

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    config: ConfigArgs,
    /// Print one JSON object with `config`, `cost` and `notes` (an unlimited range is null)
    #[arg(long)]
    json: bool,
    /// Draw the layout before any training: .svg, .pdf or .png
    #[arg(long, short, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// The cost of a whole run: all trials, all generations including the random start, all teams and the champions.
#[derive(Serialize)]
struct Cost {
    agents: usize,
    learners: usize,
    /// Largest distance that an agent can travel in an episode, in units.
    travel: f64,
    /// Number of episodes, each played by one team.
    teams: u128,
    team_steps: u128,
    agent_steps: u128,
    /// Weights of one policy.
    parameters: usize,
    /// Bytes of all trials' policies.
    policy_bytes: u64,
    /// Bytes of one team's record. It contains which agents were at which POI at each step, which leader each follower
    /// saw and, for Dt, when.
    record_bytes: u64,
    /// Peak memory of the process if the CPU plays, and the part of it that is used only while a checkpoint is written.
    host_bytes: u64,
    checkpoint_bytes: u64,
    /// Peak memory of the process if a GPU plays, and of the GPU's buffers.
    gpu_host_bytes: u64,
    adapter_bytes: u64,
}

impl Cost {
    fn of(config: &Config) -> Cost {
        let wide = |count: usize| count as u128;
        let [mut teams, mut team_steps, mut agent_steps] = [0; 3];
        let (mut agents, mut record_bytes, mut travel) = (0, 0, 0.0_f64);
        // Over the stages, played episodes and steps add up. Sizes are those of the largest stage.
        for share in config.shares() {
            let (world, learning) = (World::new(&share), &share.learning);
            let played = wide(learning.trials)
                * wide(learning.generations + 1)
                * wide(learning.teams() + 1)
                * wide(learning.episodes_per_team);
            teams += played;
            team_steps += played * wide(world.steps());
            agent_steps += played * wide(world.steps()) * wide(world.agents());
            agents = agents.max(world.agents());
            travel = reach::travel(&world, world.steps()).into_iter().fold(travel, f64::max);
            record_bytes = record_bytes.max(backend::record_bytes(&world, learning.fitness));
        }
        let plan = Peaks::of([config], rayon::current_num_threads());
        Cost {
            agents,
            learners: config.learners(),
            travel,
            teams,
            team_steps,
            agent_steps,
            parameters: config.parameters(),
            policy_bytes: config.policy_bytes(),
            record_bytes,
            host_bytes: plan.host,
            checkpoint_bytes: plan.checkpoint,
            gpu_host_bytes: plan.gpu_host,
            adapter_bytes: plan.adapter,
        }
    }
}

#[derive(Serialize)]
struct Report<'a> {
    config: &'a Config,
    cost: &'a Cost,
    notes: &'a [String],
}

/// Prints the config with the cost as comments below it, so that standard output is a config file again.
pub fn run(args: Args) -> Result<(), Error> {
    super::backend::start_threads(None);
    let kind = args.out.as_deref().map(plot::kind_of).transpose()?;
    output::check(&[("--out", args.out.as_deref())], &[&args.config.file.path])?;
    let (config, notes) = args.config.load(vec![])?;
    if let (Some(out), Some(kind)) = (&args.out, kind) {
        let name = args.config.name();
        plot::write(&map::layout(&name, &config), kind, out)?;
    }
    let cost = Cost::of(&config);
    warnings::unreachable(&config);
    if args.json {
        let report = Report { config: &config, cost: &cost, notes: &notes };
        return print_json(&report);
    }
    let Cost {
        agents, learners, travel, teams, team_steps, agent_steps, parameters, policy_bytes, record_bytes, ..
    } = cost;
    let Cost { host_bytes, checkpoint_bytes, gpu_host_bytes, adapter_bytes, .. } = cost;
    print(&format!(
        "{}
# A run of this plays {teams} teams, champions included:
#   agents per team         {agents}, of which {learners} learn
#   distance per episode    at most {travel:.1} units per agent
#   team-steps              {team_steps}
#   agent-steps             {agent_steps}
#   parameters per policy   {parameters}
#   policies of all trials  {policy_bytes} bytes
#   record of one team      {record_bytes} bytes
#   peak memory, CPU        {host_bytes} bytes; {checkpoint_bytes} of them only while a checkpoint is written
#   peak memory, GPU        {adapter_bytes} bytes on the GPU, {gpu_host_bytes} bytes of main memory
",
        config.to_toml()
    ))
}
