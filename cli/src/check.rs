//! `flotilla check`: prints the resolved config, and the cost of a run, or the config in full.

use std::path::PathBuf;

use super::{ConfigArgs, Error, backend, console, print, print_json, say};
use flotilla::escape::PathExt;
use flotilla_app::ops::check::{self, CheckOutcome, CheckRequest, Cost};
use flotilla_app::ops::output;

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    config: ConfigArgs,
    /// Print one JSON object with `config`, `cost` and `notes` (an unlimited range is null)
    #[arg(long)]
    json: bool,
    /// Print the config in full, with its classes of agents as [[agents]] and its groups of POIs as [[pois]]
    #[arg(long, conflicts_with_all = ["json", "out"])]
    expand: bool,
    /// Draw the layout before any training: .svg, .pdf or .png
    #[arg(long, short, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// Prints the config with the cost as comments below it, so that standard output is a config file again.
pub fn run(args: Args) -> Result<(), Error> {
    backend::start_threads(None);
    let Args { config, json, expand, out } = args;
    output::check(&[("--out", out.as_deref())], &[&config.file.path])?;
    if expand {
        let text = config.text(vec![])?;
        let found = console::run_without_backend(false, |context| check::expand(&text, context))?;
        return print(&found.to_toml());
    }
    let replaces = out.as_ref().is_some_and(|out| out.is_file());
    let request = CheckRequest { name: config.name(), config: config.text(vec![])?, out };
    let found = console::run_without_backend(false, |context| check::run(&request, context))?;
    if let Some(out) = &request.out {
        let replaced = if replaces { ", in place of the file that was there" } else { "" };
        say(format_args!("the layout is drawn in {}{replaced}", out.escaped()));
    }
    if json {
        return print_json(&found);
    }
    let CheckOutcome { config, cost, .. } = found;
    let Cost {
        agents, learners, travel, teams, team_steps, agent_steps, parameters, policy_bytes, record_bytes, ..
    } = cost;
    let learn = if learners == 1 { "learns" } else { "learn" };
    let Cost { host_bytes, checkpoint_bytes, gpu_host_bytes, adapter_bytes, .. } = cost;
    print(&format!(
        "{}
# A run of this plays {teams} teams, champions included:
#   agents per team         {agents}, of which {learners} {learn}
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
