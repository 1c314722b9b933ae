//! `flotilla verify`: every adapter against the CPU, bit for bit.

use std::path::PathBuf;

use serde_json::json;

use super::{Error, between, print};
use crate::backend::cpu::Cpu;
use crate::backend::gpu;
use crate::backend::gpu::device::{self, AdapterInfo, DeviceError, Request, Wanted};
use crate::backend::gpu::episode::{GpuEpisodes, Holding, Kernel, Records};
use crate::backend::gpu::exact::Pass;
use crate::config::{self, Config};
use crate::report::progress::Meter;
use crate::verify::{Agreement, Plan, compare};

#[derive(clap::Args)]
pub struct Args {
    /// Compare this experiment alone (- is standard input), instead of random worlds of every kind
    config: Option<PathBuf>,
    /// Random teams of each world
    #[arg(long, value_name = "N", default_value_t = 48, value_parser = between(1..=65_536u32))]
    teams: u32,
    /// Random worlds
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = between(1..=100_000u32))]
    worlds: u32,
    /// Start of all randomness
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = between(0..=u32::MAX))]
    seed: u32,
    /// Only the adapter whose name contains this, or of this number
    #[arg(long, value_name = "NAME")]
    adapter: Option<String>,
    /// Only this pass, instead of all exact ones that the adapter takes; `plain` shows what the passes are for
    #[arg(long, value_name = "PASS", value_parser = ["no-contraction", "guarded", "plain"])]
    pass: Option<String>,
    /// Only this kernel, instead of both
    #[arg(long, value_name = "KERNEL", value_parser = ["generic", "specialised"])]
    kernel: Option<String>,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
    /// No progress on standard error
    #[arg(long, short)]
    quiet: bool,
}

/// One line of the table; an error of the device counts as a failure.
struct Line {
    adapter: String,
    pass: Pass,
    kernel: Kernel,
    result: Result<Agreement, Error>,
}

impl Line {
    /// What differs, or went wrong.
    fn failure(&self) -> Option<String> {
        match &self.result {
            Ok(outcome) => outcome.mismatch.clone(),
            Err(error) => Some(error.to_string()),
        }
    }

    /// Worlds and agent-steps compared.
    fn compared(&self) -> (usize, u64) {
        self.result.as_ref().map_or((0, 0), |outcome| (outcome.worlds, outcome.agent_steps))
    }
}

/// Prints a table of adapters, passes and kernels, and after it what differs.
pub fn run(args: Args) -> Result<(), Error> {
    let plan = plan(&args)?;
    let adapters = adapters(args.adapter.as_deref())?;
    let mut lines = Vec::new();
    for (choice, info) in adapters {
        for pass in passes(args.pass.as_deref(), &info) {
            for kernel in kernels(args.kernel.as_deref()) {
                let request = Request { pass: Some(pass), ..choice.clone().into() };
                let result = verify(&plan, request, kernel, &info, args.quiet);
                lines.push(Line { adapter: info.to_string(), pass, kernel, result });
            }
        }
    }
    print(&if args.json { in_json(&lines) } else { in_words(&lines) })?;
    match lines.iter().filter(|line| line.failure().is_some()).count() {
        0 => Ok(()),
        failed => Err(Error::Different(format!(
            "{failed} of {} comparisons found other bits than the CPU's; until that is mended, use --backend cpu",
            lines.len()
        ))),
    }
}

/// A table, and below it what differs.
fn in_words(lines: &[Line]) -> String {
    let mut text =
        format!("{:<15} {:<12} {:>7} {:>13} {:<10} adapter\n", "pass", "kernel", "worlds", "agent-steps", "result");
    let mut failures = String::new();
    for line in lines {
        let Line { adapter, pass, kernel, .. } = line;
        let (worlds, agent_steps) = line.compared();
        let failure = line.failure();
        let result = if failure.is_some() { "DIFFERENT" } else { "equal" };
        text += &format!("{pass:<15} {kernel:<12} {worlds:>7} {agent_steps:>13} {result:<10} {adapter}\n");
        failures.extend(failure.map(|what| format!("\n{adapter}, {pass} pass, {kernel} kernel:\n  {what}\n")));
    }
    text + &failures
}

fn in_json(lines: &[Line]) -> String {
    let comparison = |line: &Line| {
        let ((worlds, agent_steps), failure) = (line.compared(), line.failure());
        json!({
            "adapter": line.adapter,
            "pass": line.pass.to_string(),
            "kernel": line.kernel.to_string(),
            "worlds": worlds,
            "agent_steps": agent_steps,
            "equal": failure.is_none(),
            "failure": failure,
        })
    };
    let equal = lines.iter().all(|line| line.failure().is_none());
    let comparisons: Vec<_> = lines.iter().map(comparison).collect();
    format!("{}\n", json!({ "equal": equal, "comparisons": comparisons }))
}

fn plan(args: &Args) -> Result<Plan, Error> {
    let (seed, teams) = (u64::from(args.seed), args.teams as usize);
    Ok(match &args.config {
        None => Plan::random(seed..seed + u64::from(args.worlds), teams),
        Some(path) => {
            let worlds = vec![(config::name(path), Config::load(path)?)];
            Plan { worlds, teams, seed, generations: 5 }
        }
    })
}

/// The adapters to verify, each with what opens it.
fn adapters(name: Option<&str>) -> Result<Vec<(Wanted, AdapterInfo)>, Error> {
    let found = device::adapters();
    let all = found.iter().cloned().enumerate().map(|(index, info)| (Wanted::Named(index.to_string()), info));
    match name {
        Some(name) => {
            let named = Wanted::Named(name.into());
            let index = device::position(&named, &found)?;
            Ok(vec![(named, found[index].clone())])
        }
        None if found.is_empty() => Err(DeviceError::NoAdapter.into()),
        None => Ok(all.collect()),
    }
}

fn passes(name: Option<&str>, info: &AdapterInfo) -> Vec<Pass> {
    let all = [Pass::NoContraction, Pass::Guarded, Pass::Plain];
    match name {
        Some(name) => all.into_iter().filter(|pass| pass.to_string() == name).collect(),
        None if info.backend == "vulkan" => vec![Pass::NoContraction, Pass::Guarded],
        None => vec![Pass::Guarded],
    }
}

fn kernels(name: Option<&str>) -> impl Iterator<Item = Kernel> {
    let all = [Kernel::Generic, Kernel::Specialised];
    all.into_iter().filter(move |kernel| name.is_none_or(|name| kernel.to_string() == name))
}

fn verify(plan: &Plan, request: Request, kernel: Kernel, info: &AdapterInfo, quiet: bool) -> Result<Agreement, Error> {
    let pass = request.pass.map_or_else(String::new, |pass| format!(", {pass} pass, {kernel} kernel"));
    let mut meter = Meter::new(quiet);
    let gpu = gpu::open(request)?;
    if let Some(mismatch) = gpu::self_test(&gpu)? {
        return Ok(Agreement { mismatch: Some(mismatch.to_string()), ..Agreement::default() });
    }
    let mut gpu = GpuEpisodes::new(gpu)?.playing(kernel).holding(Holding::Always).bringing(Records::Packed);
    let compared = compare(plan, &mut Cpu::default(), &mut gpu, |outcome| {
        let (done, all) = (outcome.worlds, plan.worlds.len());
        meter.show(done as f64 / all as f64, || format!("{}{pass}: {done} of {all} worlds", info.name));
    });
    meter.clear();
    Ok(compared?)
}
