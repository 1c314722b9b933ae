//! `flotilla verify`: every adapter against the CPU, bit for bit.

use std::ops::ControlFlow::Continue;
use std::path::PathBuf;
use std::process::Command;

use fearless_simd::Level;
use serde_json::json;

use super::{Error, between, output, print};
use crate::backend::Backend;
use crate::backend::cpu::{Cpu, level_name};
use crate::backend::gpu;
use crate::backend::gpu::device::{self, AdapterInfo, DeviceError, Request, Wanted};
use crate::backend::gpu::episode::{GpuBackend, Kernel, Records, ResidencyPolicy};
use crate::backend::gpu::exact::Pass;
use crate::config::{self, Config};
use crate::escape;
use crate::front::{self, Failure};
use crate::record::evidence::{Compared, ShortTraining, Sighting, Tier};
use crate::report::progress::Meter;
use crate::verify::{Agreement, Plan, compare, short_trainings};

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
    /// Random seed
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
    /// Write comparisons, hardware and the digests of short trainings as a row of docs/develop/evidence.md; compares the
    /// processor's instruction sets, too, and needs no adapter
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    /// A remark about the machine, for the report
    #[arg(long, value_name = "TEXT", requires = "report")]
    note: Option<String>,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
    /// No progress on standard error
    #[arg(long, short)]
    quiet: bool,
}

/// Prints a table of adapters, passes and kernels, and after it what differs.
pub fn run(args: Args) -> Result<(), Error> {
    let config = args.config.as_deref().filter(|path| !config::is_standard_input(path));
    output::check(&[("--report", args.report.as_deref())], config.as_slice())?;
    let plan = plan(&args)?;
    let mut lines = Vec::new();
    if args.report.is_some() {
        lines.extend(instruction_sets(&plan, args.quiet));
    }
    let adapters = match adapters(args.adapter.as_deref()) {
        // Then the processor alone has something to tell.
        Err(Error::NoneToVerify(DeviceError::NoAdapter)) if args.report.is_some() => vec![],
        adapters => adapters?,
    };
    for (choice, info) in adapters {
        for pass in passes(args.pass.as_deref(), &info) {
            for kernel in kernels(args.kernel.as_deref()) {
                let request = Request { pass: Some(pass), ..choice.clone().into() };
                let result = verify(&plan, request, kernel, &info, args.quiet);
                lines.push(Compared {
                    pass: Some(pass.to_string()),
                    kernel: Some(kernel.to_string()),
                    ..line(info.to_string(), &Cpu::default(), result)
                });
            }
        }
    }
    if let Some(path) = &args.report {
        let evidence = evidence(&lines, args.note.clone(), args.quiet)?;
        output::write(path, |file| file.write_all(evidence.to_json().as_bytes()))?;
    }
    print(&if args.json { in_json(&lines) } else { in_words(&lines) })?;
    match lines.iter().filter(|line| !line.equal).count() {
        0 => Ok(()),
        failed => Err(Error::Different(format!(
            "{failed} of {} comparisons found other bits than the CPU's; until that is mended, use --backend cpu",
            lines.len()
        ))),
    }
}

/// One line of the table; an error of the device counts as a failure.
fn line(adapter: String, reference: &Cpu, result: Result<Agreement, Error>) -> Compared {
    let against = reference.describe();
    let outcome =
        result.unwrap_or_else(|error| Agreement { mismatch: Some(error.to_string()), ..Agreement::default() });
    let Agreement { worlds, agent_steps, mismatch: failure } = outcome;
    let equal = failure.is_none();
    Compared { adapter, pass: None, kernel: None, against, worlds, agent_steps, equal, failure }
}

/// Every instruction set of the processor against the narrowest.
fn instruction_sets(plan: &Plan, quiet: bool) -> Vec<Compared> {
    let levels = Cpu::levels();
    let wider = levels[1..].iter().map(|&level| {
        let (mut reference, mut wider) = (Cpu::at_level(levels[0]), Cpu::at_level(level));
        let mut meter = Meter::new(quiet);
        let compared = compare(plan, &mut reference, &mut wider, meter_of(&mut meter, plan, level_name(level).into()));
        meter.clear();
        line(wider.describe(), &reference, compared.map_err(Error::from))
    });
    wider.collect()
}

/// Shows how far a comparison has come.
fn meter_of<'a>(meter: &'a mut Meter, plan: &'a Plan, what: String) -> impl FnMut(&Agreement) + 'a {
    move |outcome| {
        let (done, all) = (outcome.worlds, plan.worlds.len());
        meter.show(done as f64 / all as f64, || format!("{what}: {done} of {all} worlds"));
    }
}

/// What was compared, on what, and what short trainings come to here.
fn evidence(lines: &[Compared], note: Option<String>, quiet: bool) -> Result<Sighting, Error> {
    let (mut trained, mut meter) = (Vec::new(), Meter::new(quiet));
    let trainings = short_trainings();
    for (index, (name, config)) in trainings.iter().enumerate() {
        meter.show(index as f64 / trainings.len() as f64, || format!("training {name}"));
        let came = front::train(config, &mut Cpu::default(), |_| Continue(())).map_err(|error| match error {
            Failure::Backend(error) => Error::Backend(error),
            other => Error::Refused(other.to_string()),
        })?;
        trained.push(ShortTraining { config: name.clone(), digest: came.digest() });
    }
    meter.clear();
    Ok(Sighting {
        processor: processor(),
        instructions: Some(level_name(Level::new()).into()),
        note,
        comparisons: lines.to_vec(),
        trained,
        ..Sighting::new(Tier::Executed)
    })
}

/// What the processor calls itself, where the system says.
fn processor() -> Option<String> {
    let told = match std::env::consts::OS {
        "linux" => std::fs::read_to_string("/proc/cpuinfo").ok().and_then(|text| {
            let names = text.lines().filter_map(|line| line.split_once(':'));
            names.into_iter().find(|(key, _)| key.trim() == "model name").map(|(_, name)| name.to_string())
        }),
        "macos" => Command::new("/usr/sbin/sysctl")
            .args(["-n", "machdep.cpu.brand_string"])
            .output()
            .ok()
            .map(|output| String::from_utf8_lossy(&output.stdout).into_owned()),
        _ => std::env::var("PROCESSOR_IDENTIFIER").ok(),
    };
    told.map(|name| escape::line(name.trim()).into_owned()).filter(|name| !name.is_empty())
}

/// A table, and below it what differs.
fn in_words(lines: &[Compared]) -> String {
    let mut text =
        format!("{:<15} {:<12} {:>7} {:>13} {:<10} adapter\n", "pass", "kernel", "worlds", "agent-steps", "result");
    let mut failures = String::new();
    for Compared { adapter, pass, kernel, against, worlds, agent_steps, equal, failure } in lines {
        let result = if *equal { "equal" } else { "DIFFERENT" };
        let [pass, kernel] = [pass, kernel].map(|name| name.as_deref().unwrap_or("-"));
        text += &format!("{pass:<15} {kernel:<12} {worlds:>7} {agent_steps:>13} {result:<10} {adapter}\n");
        failures.extend(failure.iter().map(|what| match pass {
            "-" => format!("\n{adapter}, against {against}:\n  {what}\n"),
            pass => format!("\n{adapter}, {pass} pass, {kernel} kernel:\n  {what}\n"),
        }));
    }
    text + &failures
}

fn in_json(lines: &[Compared]) -> String {
    format!("{}\n", json!({ "equal": lines.iter().all(|line| line.equal), "comparisons": lines }))
}

fn plan(args: &Args) -> Result<Plan, Error> {
    let (seed, teams) = (u64::from(args.seed), args.teams as usize);
    Ok(match &args.config {
        None => Plan::random(seed..seed + u64::from(args.worlds), teams),
        Some(path) => {
            let config = Config::load(path)?;
            let stages = config.staged().into_iter().enumerate().skip(1);
            let stages: Vec<_> =
                stages.map(|(stage, (_, config))| (format!("{}, stage {stage}", config::name(path)), config)).collect();
            let worlds = [vec![(config::name(path), config)], stages].concat();
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
            let index = device::position(&named, &found).map_err(|error| match found.is_empty() {
                true => Error::NoneToVerify(error),
                false => error.into(),
            })?;
            Ok(vec![(named, found[index].clone())])
        }
        None if found.is_empty() => Err(Error::NoneToVerify(DeviceError::NoAdapter)),
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
    let mut gpu = GpuBackend::new(gpu)?.playing(kernel).holding(ResidencyPolicy::Always).bringing(Records::Packed);
    let shown = meter_of(&mut meter, plan, format!("{}{pass}", info.name));
    let compared = compare(plan, &mut Cpu::default(), &mut gpu, shown);
    meter.clear();
    Ok(compared?)
}
