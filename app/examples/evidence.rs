//! Makes `docs/develop/evidence.md` from the files in `docs/develop/evidence/`, one per machine.
//!
//! ```text
//! flotilla verify --report docs/develop/evidence/my-machine.json
//! cargo run --example evidence
//! ```

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::{env, fs};

use flotilla_app::record::evidence::{Compared, MachineReport, Tier};

#[allow(dead_code, reason = "tests/evidence.rs includes this file and calls only `page`, `read` and `digests`")]
fn main() -> ExitCode {
    let docs = env::args_os().nth(1).map_or("docs/develop".into(), PathBuf::from);
    let written = page(&docs.join("evidence")).and_then(|page| {
        let path = docs.join("evidence.md");
        fs::write(&path, page).map_err(|error| format!("{}: {error}", path.display()))
    });
    match written {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

const HEAD: &str = "\
# Evidence of equal bits

For readers who ask on which machines the same bits were seen, and for anyone who wants to add a machine.

<!-- made of the files in docs/develop/evidence by: cargo run --example evidence -->

Config and seed decide every bit of a run, on every machine. Nobody can try all compilers, drivers and processors. This page lists what was
tried. Each row was written by a program that compared results, and holds for the machine, driver and toolchain that it names.

- *executed*: it ran there, or in the emulator that the row names, and its bits were compared;
- *machine code read*: a compiler for an absent device made code, and a test inspected it and ran it in an emulator if the row says so;
- *compiled*: it compiles for that target; nothing ran.

Every GPU, listed or not, has to pass flotilla's own tests each time that it is opened. Otherwise it is refused.

## Add your machine

```sh
flotilla verify --worlds 20 --report my-machine.json
```

This compares the processor's instruction sets with each other and every GPU with the CPU, and trains six short runs. It writes the results,
with the names of processor, driver and compiler, into one small file. `--note` adds a remark. Send the file in, or put it into
`docs/develop/evidence/` and run `cargo run --example evidence`. Differences belong here, too. A build with `--features scalar` also compares
with code that uses no vector instructions.
";

const TAIL: &str = "\
## What exactness relies on

flotilla does not control the following. Each line names the functions in `tests/` that would notice a change.

| assumption | why it might fail | noticed by |
|---|---|---|
| float sums and products are rounded to nearest, ties to even | WGSL leaves the rounding of `+ - *` open | probes whenever a GPU is opened; `devices_are_exact_under_both_passes` |
| no product is fused with a sum, no sum reordered | WGSL allows both, and drivers do both | the same probes; `the_probes_catch_a_device_without_a_pass`, `compiled_shaders_are_exact_small_and_fast` |
| a guard `x \\| 0` remains, because the zero is known only at run time | a compiler that knew the zero could remove it | `guards_are_not_cancelled`; `every_sum_and_product_is_guarded_in_metal_and_directx_text` |
| a sum has a guard, or only a comparison of its bits as an integer reads it | a compiler might treat that as a float comparison; none is known to | the probes; `only_results_compared_as_integers_need_no_guard` |
| naga writes no option or function that fuses operations for Metal and DirectX | a later version might | `every_sum_and_product_is_guarded_in_metal_and_directx_text` |
| a driver keeps `NoContraction` | Vulkan requires it of drivers | the probes; `every_float_result_is_decorated` |
| numbers of normal size are not flushed to zero | they never are; numbers below 2^-126 may be, so none occurs | `flush_makes_small_values_positive_zero`, `no_value_comes_near_the_denormals`, `twins_have_the_same_numbers` |
| `bitcast` of a NaN is never needed, nor is one ever made | WGSL may change a NaN's bits and may assume that none exists | `a_valid_config_makes_normal_constants`, `kernels_follow_the_model` |
| constants in shaders have the value that they show | naga folds literals in f64 and built-ins with the host's library | `shaders_use_only_core_operations` |
| sines, cosines and logarithms of the host | each platform's library rounds them differently | none is called: `no_source_calls_the_platforms_math_functions` |
| Rust's compiler neither fuses nor reorders | it does so only on request | golden digests with every instruction set: `every_instruction_set` |
| instruction sets round alike | masks and conversions differ in corner cases | `levels_give_the_same_bits`, `every_instruction_set` |
| text becomes the nearest float, and floats become text and back | Rust's own library does both | `train_records_the_same_digest` |

Two things are not promised: times, and processes that change the rounding mode of their threads. Intervals and p-values are computed
with `libm`, too.

On Metal only the guarded pass is used. It does not depend on compiler options. Between a product and the sum after it stands an integer
operation with a word read from a buffer, whose value no compiler can know. Nobody has run flotilla on Metal or on DirectX yet.
";

/// Returns the page for the files of a directory.
///
/// # Errors
/// A file cannot be read, or `flotilla verify --report` did not write it.
pub fn page(folder: &Path) -> Result<String, String> {
    let rows = read(folder)?;
    let mut text = format!("{HEAD}\n{}", overview(&rows));
    for (tier, title) in
        [(Tier::Executed, "Executed"), (Tier::MachineCodeRead, "Machine code read"), (Tier::Compiled, "Compiled")]
    {
        text += &format!("\n## {title}\n");
        let of_tier: Vec<_> = rows.iter().filter(|(_, evidence)| evidence.tier == tier).collect();
        of_tier.iter().for_each(|(name, evidence)| text += &section(name, evidence));
        text += if of_tier.is_empty() { "\nNothing so far.\n" } else { "" };
    }
    Ok(format!("{text}\n{TAIL}"))
}

/// Reads all reports of a directory. Keys are file names without extension.
///
/// # Errors
/// As for [`page`].
pub fn read(folder: &Path) -> Result<BTreeMap<String, MachineReport>, String> {
    let message = |path: &Path, error: &dyn std::fmt::Display| format!("{}: {error}", path.display());
    let mut rows = BTreeMap::new();
    for entry in fs::read_dir(folder).map_err(|error| message(folder, &error))? {
        let path = entry.map_err(|error| message(folder, &error))?.path();
        let text = fs::read_to_string(&path).map_err(|error| message(&path, &error))?;
        let evidence = MachineReport::parse(&text).map_err(|error| message(&path, &error))?;
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        rows.insert(name, evidence);
    }
    Ok(rows)
}

/// Returns a table with one row per file, and a table of the digests.
fn overview(rows: &BTreeMap<String, MachineReport>) -> String {
    let mut text = String::from(
        "## All rows\n\n| row | tier | built for | compared | agent-steps | result | short trainings | date |\n\
         |---|---|---|---|---|---|---|---|\n",
    );
    let digests = digests(rows);
    for (name, evidence) in rows {
        let tier = match evidence.tier {
            Tier::Executed => "executed",
            Tier::MachineCodeRead => "machine code read",
            Tier::Compiled => "compiled",
        };
        let steps: u64 = evidence.comparisons.iter().map(|comparison| comparison.agent_steps).sum();
        let failed = evidence.comparisons.iter().filter(|comparison| !comparison.equal).count();
        let result = match (evidence.comparisons.len(), failed) {
            (0, _) => "·".into(),
            (_, 0) => "equal".into(),
            (total, failed) => format!("**{failed} of {total} different**"),
        };
        let trained = match evidence.trained.iter().filter(|run| digests[&run.config] != run.digest).count() {
            _ if evidence.trained.is_empty() => "·".into(),
            0 => "equal".to_string(),
            others => format!("**{others} of {} other digests**", evidence.trained.len()),
        };
        let MachineReport { target, date, comparisons, .. } = evidence;
        text += &format!(
            "| [{name}](#{name}) | {tier} | {target} | {} | {} | {result} | {trained} | {date} |\n",
            count(comparisons.len() as u64),
            count(steps)
        );
    }
    if !digests.is_empty() {
        let reports = rows.values().filter(|evidence| !evidence.trained.is_empty()).count();
        text += &format!(
            "\nThe short trainings (two trials of ten generations) and the digests of most of {reports} rows:\n\n\
             | training | SHA-256 |\n|---|---|\n"
        );
        digests.iter().for_each(|(config, digest)| text += &format!("| {config} | `{digest}` |\n"));
    }
    text
}

/// Returns the most frequent digest of each training.
pub fn digests(rows: &BTreeMap<String, MachineReport>) -> BTreeMap<String, String> {
    let mut votes: BTreeMap<&str, BTreeMap<&str, usize>> = BTreeMap::new();
    for run in rows.values().flat_map(|evidence| &evidence.trained) {
        *votes.entry(&run.config).or_default().entry(&run.digest).or_default() += 1;
    }
    let most = |votes: BTreeMap<&str, usize>| {
        votes.into_iter().max_by_key(|(_, votes)| *votes).map(|(digest, _)| digest.into())
    };
    votes.into_iter().filter_map(|(config, votes)| Some((config.into(), most(votes)?))).collect()
}

/// Returns the section of one file.
fn section(name: &str, evidence: &MachineReport) -> String {
    let MachineReport { date, version, commit, target, toolchain, processor, instructions, note, .. } = evidence;
    let commit =
        commit.as_ref().map_or(String::new(), |commit| format!(" of commit {}", &commit[..commit.len().min(10)]));
    let mut text = format!("\n### {name}\n\nflotilla {version}{commit}, built for {target} by {toolchain}");
    for (label, value) in [("", processor), ("widest instructions ", instructions), ("", note)] {
        text.extend(value.iter().map(|value| format!("; {label}{value}")));
    }
    text += &format!(". {date}.\n");
    if !evidence.findings.is_empty() {
        text += "\n";
        evidence.findings.iter().for_each(|finding| text += &format!("- {finding}\n"));
    }
    if !evidence.comparisons.is_empty() {
        text += "\n| compared | with | pass, kernel | worlds | agent-steps | result |\n|---|---|---|---|---|---|\n";
    }
    for Compared { adapter, pass, kernel, against, worlds, agent_steps, equal, failure } in &evidence.comparisons {
        let how: Vec<&str> = [pass, kernel].into_iter().flatten().map(String::as_str).collect();
        let result = match failure {
            Some(failure) => format!("**{}**", failure.replace('|', "\\|").replace('\n', " ")),
            None => if *equal { "equal" } else { "**different**" }.into(),
        };
        let (how, worlds, steps) = (how.join(", "), count(*worlds as u64), count(*agent_steps));
        text += &format!("| {adapter} | {against} | {how} | {worlds} | {steps} | {result} |\n");
    }
    text
}

/// Formats a number with spaces between thousands, and 0 as a dot.
fn count(number: u64) -> String {
    let digits = number.to_string();
    let spaced = digits.char_indices().map(|(at, digit)| match (digits.len() - at) % 3 {
        0 if at > 0 => format!(" {digit}"),
        _ => digit.to_string(),
    });
    if number == 0 { "·".into() } else { spaced.collect() }
}
