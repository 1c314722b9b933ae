//! Resolves a config, and computes the cost of a run.

use std::path::PathBuf;

use serde::Serialize;

use super::{ConfigText, Context, Error, output, plot};
use crate::report::map;
use flotilla::backend;
use flotilla::config::{Config, ValidConfig};
use flotilla::memory::Peaks;
use flotilla::parallel;
use flotilla::reach;
use flotilla::world::World;

/// A request to check a config.
#[derive(Clone, Debug)]
pub struct CheckRequest {
    /// The config.
    pub config: ConfigText,
    /// The name of the layout, for the picture.
    pub name: String,
    /// A picture of the layout to write.
    pub out: Option<PathBuf>,
}

/// Results of a check.
#[derive(Clone, Debug, Serialize)]
pub struct CheckOutcome {
    /// The config with all defaults.
    pub config: Config,
    /// The cost of a run.
    pub cost: Cost,
    /// Notes for the config's author.
    pub notes: Vec<String>,
}

/// Checks a config.
pub fn run(request: &CheckRequest, context: Context<'_>) -> Result<CheckOutcome, Error> {
    output::check(&[("--out", request.out.as_deref())], &[])?;
    let picture = request.out.as_deref().map(|out| Ok::<_, Error>((out, plot::kind_of(out)?))).transpose()?;
    let (config, notes) = request.config.read_noted(context)?;
    if let Some((out, kind)) = picture {
        output::write(out, &plot::content(&map::layout(&request.name, config.as_ref()), kind, out)?)?;
    }
    context.warn_of_unreachable(&config);
    Ok(CheckOutcome { cost: Cost::of(&config), config: config.into_config(), notes })
}

/// Reads a config, and returns it in full, see [`Config::expanded`].
pub fn expand(config: &ConfigText, context: Context<'_>) -> Result<Config, Error> {
    let config = config.read_noted(context)?.0.into_config();
    let expanded = config.expanded();
    for (list, is_short) in [("agents", expanded.agents.is_empty()), ("pois", expanded.pois.is_empty())] {
        if is_short {
            context
                .message(format_args!("[[{list}]] is not written, because a stage sets a key that it would replace"));
        }
    }
    Ok(expanded)
}

/// The cost of a whole run: all trials, all generations including the random start, all teams and the champions.
#[derive(Clone, Debug, Serialize)]
pub struct Cost {
    /// Agents per team.
    pub agents: usize,
    /// Agents that learn.
    pub learners: usize,
    /// Largest distance that an agent can travel in an episode, in units.
    pub travel: f64,
    /// Number of episodes, each played by one team.
    pub teams: u128,
    /// Steps of teams.
    pub team_steps: u128,
    /// Steps of agents.
    pub agent_steps: u128,
    /// Weights of one policy.
    pub parameters: usize,
    /// Bytes of all trials' policies.
    pub policy_bytes: u64,
    /// Bytes of one team's record. It contains which agents were at which POI at each step, which leader each follower
    /// saw and, for Dt, when.
    pub record_bytes: u64,
    /// Peak memory of the process if the CPU plays.
    pub host_bytes: u64,
    /// The part of it that is used only while a checkpoint is written.
    pub checkpoint_bytes: u64,
    /// Peak memory of the process if a GPU plays.
    pub gpu_host_bytes: u64,
    /// Peak memory of the GPU's buffers.
    pub adapter_bytes: u64,
}

impl Cost {
    fn of(config: &ValidConfig) -> Cost {
        let wide = |count: usize| count as u128;
        let [mut teams, mut team_steps, mut agent_steps] = [0; 3];
        let (mut agents, mut record_bytes, mut travel) = (0, 0, 0.0_f64);
        // Over the stages, played episodes and steps add up. Sizes are those of the largest stage.
        for (stage, (generations, config)) in config.stage_lengths().enumerate() {
            let (world, learning) = (World::new(config), &config.learning);
            // Generation 0 has no past champions.
            let without = if stage == 0 { wide(config.hall_teams(1)) } else { 0 };
            let of_trial = wide(generations) * wide(config.max_teams()) - without;
            let tests = wide(generations) * wide(learning.test_episodes);
            let played = wide(learning.trials) * (of_trial * wide(learning.episodes_per_team) + tests);
            teams += played;
            team_steps += played * wide(world.steps());
            agent_steps += played * wide(world.steps()) * wide(world.agents());
            agents = agents.max(world.agents());
            let classes = config.classes();
            let travelled =
                classes.agents.iter().flat_map(|class| reach::travel(config, class, config.world.steps).pop());
            travel = travelled.fold(travel, f64::max);
            let bytes = config.fitnesses().into_iter().map(|fitness| backend::record_bytes(&world, fitness));
            record_bytes = bytes.fold(record_bytes, u64::max);
        }
        let plan = Peaks::of([config], parallel::current_num_threads());
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
