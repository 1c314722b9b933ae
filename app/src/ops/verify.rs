//! Compares every adapter with the CPU, bit for bit.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::{Context, Error, with_remedy};
use flotilla::backend::Backend;
use flotilla::backend::cpu::{Cpu, level_name};
use flotilla::backend::gpu;
use flotilla::backend::gpu::device::{self, AdapterChoice, AdapterInfo, DeviceError};
use flotilla::backend::gpu::episode::{GpuBackend, Kernel, Records, ResidencyPolicy};
use flotilla::backend::gpu::exact::Pass;
use flotilla::config::{Config, Override};
use flotilla::host::Instant;
use flotilla::verify::{Agreement, Plan, compare};
use flotilla::version::{COMMIT, VERSION};

/// A request to compare adapters with the CPU.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct VerifyRequest {
    /// The name and the text of a config to compare, instead of random worlds.
    pub config: Option<(String, String)>,
    /// Config keys to set.
    pub set: Vec<Override>,
    /// Random teams per world. [`TEAMS`] by default.
    pub teams: Option<u32>,
    /// Random worlds. By default as many of the first 200 as take about a minute.
    pub worlds: Option<u32>,
    /// Random seed.
    pub seed: u32,
    /// The only adapter to compare, by its number or a part of its name. [`CPU`] compares instruction sets instead.
    pub adapter: Option<String>,
    /// The only pass to compare.
    pub pass: Option<String>,
    /// The only kernel to compare.
    pub kernel: Option<String>,
}

/// Default number of random teams of each world.
pub const TEAMS: u32 = 48;
/// The name of the processor, in place of an adapter's.
pub const CPU: &str = "cpu";

/// Results of a verification.
#[derive(Clone, Debug, Serialize)]
pub struct VerifyOutcome {
    /// Whether all comparisons are equal.
    pub equal: bool,
    /// The comparisons.
    pub comparisons: Vec<Compared>,
    /// Version of the program.
    pub version: &'static str,
    /// Commit that the program was built from, if known.
    pub commit: Option<&'static str>,
    /// Target that the program was built for, such as "x86_64-unknown-linux-gnu".
    pub target: &'static str,
}

/// Comparison of episodes and trainings on two backends.
#[derive(Clone, Debug, Serialize)]
pub struct Compared {
    /// The compared processor: an adapter with its driver, or "cpu (AVX2)".
    pub adapter: String,
    /// Compile pass of the shaders, for a GPU.
    pub pass: Option<String>,
    /// How the shaders were compiled: `generic`, or `specialised` for each world.
    pub kernel: Option<String>,
    /// The reference processor, such as "cpu (SSE2)".
    pub against: String,
    /// Number of worlds with equal results.
    pub worlds: usize,
    /// Number of agent steps in these worlds.
    pub agent_steps: u64,
    /// Whether all bits were equal.
    pub equal: bool,
    /// Description of a difference or an error.
    pub failure: Option<String>,
}

impl VerifyOutcome {
    fn new(comparisons: Vec<Compared>) -> VerifyOutcome {
        VerifyOutcome {
            equal: comparisons.iter().all(|line| line.equal),
            comparisons,
            version: VERSION,
            commit: COMMIT,
            target: flotilla::version::TARGET,
        }
    }

    /// Returns an error if a comparison differs.
    pub fn difference(&self) -> Option<Error> {
        let failed = self.comparisons.iter().filter(|line| !line.equal).count();
        (failed > 0).then(|| {
            Error::Different(with_remedy(
                format!("{failed} of {} comparisons found other bits than the CPU's", self.comparisons.len()),
                "until this is fixed, use --backend cpu",
            ))
        })
    }
}

/// Compares adapters, passes and kernels with the CPU.
///
/// # Errors
/// There is nothing to compare, or the request is invalid. A difference is an outcome.
pub fn run(args: &VerifyRequest, context: Context<'_>) -> Result<VerifyOutcome, Error> {
    let (plan, budget) = plan(args)?;
    let mut combinations = match args.adapter.as_deref() {
        Some(CPU) => instruction_sets(args)?,
        name => gpus(name, args)?,
    };
    let count = combinations.len();
    if count == 0 {
        return Err(Error::Usage("no adapter has this pass or kernel".into()));
    }
    if args.adapter.as_deref() != Some(CPU) {
        context.message(expected(&plan, budget, count));
    }
    let budget = budget.map(|all| all / count as u32);
    let mut lines = Vec::new();
    for (place, Combination { names, pass, kernel, reference, open }) in combinations.iter_mut().enumerate() {
        if context.is_stopped() {
            return Err(Error::Stopped("before everything was compared".into()));
        }
        let since = Instant::now();
        let shown = |now: &Agreement| {
            let (done, of) = match budget {
                Some(budget) => ((since.elapsed().as_secs_f64() / budget.as_secs_f64()).min(1.0), String::new()),
                None => (now.worlds as f64 / plan.worlds.len() as f64, format!(" of {}", plan.worlds.len())),
            };
            context.fraction((place as f64 + done) / count as f64, format!("{}: {}{of} worlds", names[1], now.worlds));
        };
        let result = open().and_then(|opened| match opened {
            Err(mismatch) => Ok(Agreement { mismatch: Some(mismatch), ..Agreement::default() }),
            Ok(mut backend) => Ok(compare_within(&plan, budget, |part, before| {
                compare(part, reference, &mut *backend, |now| {
                    shown(&Agreement { worlds: before.worlds + now.worlds, ..now.clone() });
                })
            })?),
        });
        let [pass, kernel] = [pass.map(|pass| pass.to_string()), kernel.map(|kernel| kernel.to_string())];
        lines.push(Compared { pass, kernel, ..line(names[0].clone(), reference, result) });
    }
    context.pause();
    Ok(VerifyOutcome::new(lines))
}

/// Default number of random worlds. A time budget may leave out the last ones.
const WORLDS: u32 = 200;
/// Number of worlds that are compared between two checks of the clock: one of each layout.
const PART: usize = 10;
/// Time for all comparisons, if no config or number of worlds is requested.
const BUDGET: Duration = Duration::from_secs(60);

/// A processor to compare with a reference.
struct Combination<'a> {
    /// The processor's name in the table, and in progress.
    names: [String; 2],
    pass: Option<Pass>,
    kernel: Option<Kernel>,
    reference: Cpu,
    open: Box<dyn Fn() -> Result<Opened, Error> + 'a>,
}

/// An open processor, or a difference that its self-test found.
type Opened = Result<Box<dyn Backend>, String>;

/// Returns a message about what is compared and how long that takes.
fn expected(plan: &Plan, budget: Option<Duration>, combinations: usize) -> String {
    let by = format!(
        "{combinations} {} of adapter, pass and kernel",
        if combinations == 1 { "combination" } else { "combinations" }
    );
    match budget {
        Some(budget) => format!(
            "comparing random worlds by {by}, at least {PART} by each, for about {} s; --worlds N sets how many",
            budget.as_secs()
        ),
        None => format!(
            "comparing {} worlds by each of {by}, which can take minutes; the time left is shown every now and then",
            plan.worlds.len()
        ),
    }
}

/// Compares a plan part by part until the budget is spent, but at least one part. Without a budget, it compares the
/// whole plan at once.
fn compare_within<E>(
    plan: &Plan,
    budget: Option<Duration>,
    mut compare: impl FnMut(&Plan, &Agreement) -> Result<Agreement, E>,
) -> Result<Agreement, E> {
    let since = Instant::now();
    let mut all = Agreement::default();
    let part = if budget.is_some() { PART } else { plan.worlds.len() };
    for (index, worlds) in plan.worlds.chunks(part.max(1)).enumerate() {
        let begun = Instant::now();
        let part = Plan { worlds: worlds.to_vec(), seed: plan.seed + (index * PART) as u64, ..plan.clone() };
        let found = compare(&part, &all)?;
        all.worlds += found.worlds;
        all.agent_steps += found.agent_steps;
        all.mismatch = found.mismatch;
        let is_spent = budget.is_some_and(|budget| since.elapsed() + begun.elapsed() > budget);
        if all.mismatch.is_some() || is_spent {
            break;
        }
    }
    Ok(all)
}

/// Returns one line of the table. An error of the device counts as a difference.
fn line(adapter: String, reference: &Cpu, result: Result<Agreement, Error>) -> Compared {
    let against = reference.describe();
    let outcome =
        result.unwrap_or_else(|error| Agreement { mismatch: Some(error.to_string()), ..Agreement::default() });
    let Agreement { worlds, agent_steps, mismatch: failure } = outcome;
    let equal = failure.is_none();
    Compared { adapter, pass: None, kernel: None, against, worlds, agent_steps, equal, failure }
}

/// Returns the comparisons of every instruction set of the processor with the narrowest.
fn instruction_sets<'a>(args: &VerifyRequest) -> Result<Vec<Combination<'a>>, Error> {
    let levels = Cpu::levels();
    let (&narrowest, wider) = levels.split_first().expect("every processor has an instruction set");
    if args.pass.is_some() || args.kernel.is_some() {
        let text = "--adapter cpu compares instruction sets, which have no passes and kernels";
        return Err(Error::Usage(with_remedy(text, "leave out --pass and --kernel")));
    }
    if wider.is_empty() {
        let text = format!("this processor has one instruction set, {}: nothing to compare", level_name(narrowest));
        return Err(Error::Refused(text.into()));
    }
    let combination = |&level| Combination {
        names: [Cpu::at_level(level).describe(), level_name(level).to_string()],
        pass: None,
        kernel: None,
        reference: Cpu::at_level(narrowest),
        open: Box::new(move || Ok(Ok(Box::new(Cpu::at_level(level))))),
    };
    Ok(wider.iter().map(combination).collect())
}

/// Returns the comparisons of every adapter, pass and kernel with the CPU, or of the requested ones.
fn gpus<'a>(name: Option<&str>, args: &VerifyRequest) -> Result<Vec<Combination<'a>>, Error> {
    let mut combinations = Vec::new();
    for (choice, info) in adapters(name)? {
        for pass in passes(args.pass.as_deref(), &info) {
            for kernel in kernels(args.kernel.as_deref()) {
                let choice = choice.clone();
                let open = move || -> Result<Opened, Error> {
                    let gpu = gpu::open(device::Request { pass: Some(pass), ..choice.clone().into() })?;
                    if let Some(mismatch) = gpu::self_test(&gpu)? {
                        return Ok(Err(mismatch.to_string()));
                    }
                    let gpu = GpuBackend::new(gpu)?.with_kernel(kernel).with_residency(ResidencyPolicy::Always);
                    Ok(Ok(Box::new(gpu.with_records(Records::CountedFrom(0)))))
                };
                combinations.push(Combination {
                    names: [info.to_string(), format!("{}, {pass} pass, {kernel} kernel", info.name)],
                    pass: Some(pass),
                    kernel: Some(kernel),
                    reference: Cpu::default(),
                    open: Box::new(open),
                });
            }
        }
    }
    Ok(combinations)
}

/// Returns what to compare, and the time budget if no amount is requested.
fn plan(args: &VerifyRequest) -> Result<(Plan, Option<Duration>), Error> {
    let (seed, teams) = (u64::from(args.seed), args.teams.unwrap_or(TEAMS) as usize);
    let is_open = args.config.is_none() && args.worlds.is_none();
    let plan = match &args.config {
        None if !args.set.is_empty() => {
            return Err(Error::Usage(with_remedy(
                "--set changes a config, and none is given",
                "name a config to compare",
            )));
        }
        None => Plan::random(seed..seed + u64::from(args.worlds.unwrap_or(WORLDS)), teams),
        Some((name, text)) => {
            let config = Config::read(text, name, &[], &args.set)?.validate()?;
            let later = config.stages().iter().enumerate().skip(1);
            let later = later.map(|(stage, (_, config))| (format!("{name}, stage {stage}"), Config::clone(config)));
            let worlds = [(name.clone(), Config::clone(&config))].into_iter().chain(later).collect();
            Plan { worlds, teams, seed, generations: 5 }
        }
    };
    Ok((plan, is_open.then_some(BUDGET)))
}

/// Returns the adapters to verify, each with the request that opens it.
fn adapters(name: Option<&str>) -> Result<Vec<(AdapterChoice, AdapterInfo)>, Error> {
    let found = device::adapters();
    let all = found.iter().cloned().enumerate().map(|(index, info)| (AdapterChoice::Named(index.to_string()), info));
    match name {
        Some(name) => {
            let named = AdapterChoice::Named(name.into());
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_budget_is_kept_by_whole_parts() {
        let plan = Plan::random(0..35, 1);
        let found = |budget: Option<Duration>, wrong: usize| {
            let mut sizes = vec![];
            let compare = |part: &Plan, before: &Agreement| {
                assert_eq!(before.worlds, sizes.iter().sum::<usize>());
                assert_eq!(part.worlds[0].0, format!("random world {}", part.seed));
                sizes.push(part.worlds.len());
                let mismatch = (sizes.len() == wrong).then(|| "differs".to_string());
                Ok::<_, ()>(Agreement { worlds: part.worlds.len(), agent_steps: 7, mismatch })
            };
            let all = compare_within(&plan, budget, compare).unwrap();
            assert_eq!(all.agent_steps, 7 * sizes.len() as u64);
            assert_eq!((all.worlds, all.mismatch.is_some()), (sizes.iter().sum(), sizes.len() == wrong));
            sizes
        };
        assert_eq!(found(None, 0), [35]);
        assert_eq!(found(Some(Duration::ZERO), 0), [10]);
        assert_eq!(found(Some(BUDGET), 0), [10, 10, 10, 5]);
        assert_eq!(found(Some(BUDGET), 2), [10, 10]);
        assert!(expected(&plan, Some(BUDGET), 4).contains("about 60 s"));
        assert!(expected(&plan, None, 1).contains("35 worlds by each of 1 combination "));
    }

    #[test]
    fn only_a_bare_request_has_a_budget() {
        let config = ("small".to_string(), flotilla::config::LAYOUTS[0].1.to_string());
        let budget = |request: VerifyRequest| plan(&request).unwrap().1;
        assert_eq!(budget(VerifyRequest::default()), Some(BUDGET));
        assert_eq!(budget(VerifyRequest { worlds: Some(3), ..VerifyRequest::default() }), None);
        assert_eq!(budget(VerifyRequest { config: Some(config), ..VerifyRequest::default() }), None);
    }

    #[test]
    fn a_different_comparison_is_an_error_with_its_own_exit_code() {
        let compared = |failures: &[Option<&str>]| {
            let agreement =
                |failure: &Option<&str>| Agreement { mismatch: failure.map(String::from), ..Agreement::default() };
            let lines = failures.iter().map(|failure| line("a GPU".into(), &Cpu::default(), Ok(agreement(failure))));
            VerifyOutcome::new(lines.collect())
        };
        assert!(compared(&[None, None]).difference().is_none());
        let error = compared(&[Some("stage credit"), None, None]).difference().unwrap();
        assert_eq!((error.exit_code(), error.code()), (3, "different"));
        assert!(error.to_string().starts_with("1 of 3 comparisons found other bits than the CPU's"), "{error}");
    }
}
