//! Makes `docs/develop/evidence.md` of the files in `docs/develop/evidence/`, each of which a run wrote.
//!
//! ```text
//! flotilla verify --report docs/develop/evidence/my-machine.json
//! cargo run --example evidence
//! ```

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::{env, fs};

use flotilla::record::evidence::{Compared, Sighting, Tier};

#[allow(dead_code, reason = "a test that takes this file in calls `page`")]
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
# The same bits everywhere: what was seen

<!-- made of the files in docs/develop/evidence by: cargo run --example evidence -->

Config and seed are to decide every bit of a run, on every machine. That is a claim about compilers, drivers and processors that
nobody can try all of, so here is what was tried, each row by a program that wrote down what it found. A row holds for the
machine, the driver *and* the toolchain that it names.

- *executed*: it ran there, or under the emulator that the row names, and its bits were compared;
- *machine code read*: a compiler for a device that was not there, its driver's own or its maker's, made code, and a test read it
  and ran it in an emulator, where the row says so;
- *compiled*: it compiles for there; nothing ran.

What no row shows is argued [below](#what-it-relies-on). Every GPU, in a row or not, has to pass `flotilla`'s own probes each time
that it is opened, or it is refused.

## Add your machine

```sh
flotilla verify --worlds 20 --report my-machine.json
```

compares the instruction sets of the processor with each other and every GPU with the CPU, trains six short runs, and
writes all that, with the names of processor, driver and compiler, into one small file. `--note` adds what else there is to
know. Send the file in, or put it into `docs/develop/evidence/` and say `cargo run --example evidence`. What differs belongs there as well.
Built with `--features scalar` the instruction sets are compared with code that has none.
";

const TAIL: &str = "\
## What it relies on

and does not control, with the test that would notice. Names are those of functions in `tests/`.

| relied on | why it might not be so | noticed by |
|---|---|---|
| a float sum or product is rounded to nearest, ties to even | WGSL leaves the rounding of `+ - *` open | probes whenever a GPU is opened; `devices_are_exact_under_both_passes` |
| no product is fused with a sum, no sum reordered | WGSL allows both, and drivers do both | the same probes; `the_probes_catch_a_device_without_a_pass`, `what_the_compiler_writes_is_exact_small_and_fast` |
| a guard `x \\| 0` with a zero that only the run time knows stays | a compiler that knew the zero could drop it | `guards_are_not_cancelled`; `every_product_is_guarded_in_metals_and_directx_text` |
| a sum has a guard, or nothing reads it but a comparison of whole numbers, by its bits | a compiler might take that for one of floats, and move the sum across it; none is known to | the probes; `only_what_is_compared_by_its_bits_needs_no_guard` |
| naga writes no options and no function that fuses into Metal's and DirectX's text | a later version might | `every_product_is_guarded_in_metals_and_directx_text` |
| a driver keeps `NoContraction` | Vulkan asks it of drivers | the probes; `every_float_result_is_decorated` |
| numbers of normal size are not flushed to zero | they never are; those below 2^-126 may be, so none comes up | `flush_makes_small_values_positive_zero`, `no_value_comes_near_the_denormals`, `twins_have_the_same_numbers` |
| `bitcast` of a NaN is never needed, nor is one ever made | WGSL may change a NaN's bits, and may assume that there is none | `a_valid_config_makes_normal_constants`, `kernels_follow_the_model` |
| constants in shaders are what they look like | naga folds expressions of literals in f64, and built-ins by the host's library | `no_shader_leaves_the_core` |
| sines, cosines and logarithms of the host | each platform's library rounds them as it likes | none is asked: `nothing_asks_the_platform_for_a_function` |
| the compiler of Rust neither fuses nor reorders | it never does unless told to | golden digests by every instruction set: `every_instruction_set` |
| instruction sets round alike | lanes, masks and conversions differ in their corners | `levels_give_the_same_bits`, `every_instruction_set` |
| text becomes the nearest float, and floats become text and back | Rust's own library does both | `the_program_tells_the_same_digest` |

Three things are outside the promise: how long anything takes; the last digits of p-values and intervals in comparisons, where
the `statrs` crate asks the platform for logarithms; and a process whose host has changed the rounding of its threads.

On Metal the guarded pass alone is used. It hangs on no compile option: what stands between a product and the sum after it
is an integer operation with a word that is read from a buffer, and no option lets a compiler guess that word. The other way
would be `#pragma METAL fp contract(off)` at the head of the text, which on Apple's compilers has kept a product and a sum
apart where no option did; naga has no place for it. Nobody has run flotilla on a GPU of hardware, on Metal or on DirectX yet.
";

/// The page, of all files of a folder.
///
/// # Errors
/// A file cannot be read, or is not what `flotilla verify --report` writes.
pub fn page(folder: &Path) -> Result<String, String> {
    let rows = read(folder)?;
    let mut text = format!("{HEAD}\n{}", overview(&rows));
    for (tier, title) in
        [(Tier::Executed, "Executed"), (Tier::MachineCodeRead, "Machine code read"), (Tier::Compiled, "Compiled")]
    {
        text += &format!("\n## {title}\n");
        let there: Vec<_> = rows.iter().filter(|(_, evidence)| evidence.tier == tier).collect();
        there.iter().for_each(|(name, evidence)| text += &section(name, evidence));
        text += if there.is_empty() { "\nNothing so far.\n" } else { "" };
    }
    Ok(format!("{text}\n{TAIL}"))
}

/// Every file of a folder, by its name without ending.
///
/// # Errors
/// As for [`page`].
pub fn read(folder: &Path) -> Result<BTreeMap<String, Sighting>, String> {
    let told = |path: &Path, error: &dyn std::fmt::Display| format!("{}: {error}", path.display());
    let mut rows = BTreeMap::new();
    for entry in fs::read_dir(folder).map_err(|error| told(folder, &error))? {
        let path = entry.map_err(|error| told(folder, &error))?.path();
        let text = fs::read_to_string(&path).map_err(|error| told(&path, &error))?;
        let evidence = Sighting::parse(&text).map_err(|error| told(&path, &error))?;
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        rows.insert(name, evidence);
    }
    Ok(rows)
}

/// One line a file, and the digests.
fn overview(rows: &BTreeMap<String, Sighting>) -> String {
    let mut text = String::from(
        "## All rows\n\n| row | tier | built for | compared | agent-steps | result | short trainings | date |\n|---|---|---|---|---|---|---|---|\n",
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
            (all, failed) => format!("**{failed} of {all} different**"),
        };
        let trained = match evidence.trained.iter().filter(|came| digests[&came.config] != came.digest).count() {
            _ if evidence.trained.is_empty() => "·".into(),
            0 => "equal".to_string(),
            others => format!("**{others} of {} other digests**", evidence.trained.len()),
        };
        let Sighting { target, date, comparisons, .. } = evidence;
        text += &format!(
            "| [{name}](#{name}) | {tier} | {target} | {} | {} | {result} | {trained} | {date} |\n",
            count(comparisons.len() as u64),
            count(steps)
        );
    }
    if !digests.is_empty() {
        let of = rows.values().filter(|evidence| !evidence.trained.is_empty()).count();
        text += &format!(
            "\nThe short trainings (two trials of ten generations) and the digests that most of {of} rows came to:\n\n| training | SHA-256 |\n|---|---|\n"
        );
        digests.iter().for_each(|(config, digest)| text += &format!("| {config} | `{digest}` |\n"));
    }
    text
}

/// By training, the digest that the most rows have.
pub fn digests(rows: &BTreeMap<String, Sighting>) -> BTreeMap<String, String> {
    let mut votes: BTreeMap<&str, BTreeMap<&str, usize>> = BTreeMap::new();
    for came in rows.values().flat_map(|evidence| &evidence.trained) {
        *votes.entry(&came.config).or_default().entry(&came.digest).or_default() += 1;
    }
    let most = |votes: BTreeMap<&str, usize>| {
        votes.into_iter().max_by_key(|(_, votes)| *votes).map(|(digest, _)| digest.into())
    };
    votes.into_iter().filter_map(|(config, votes)| Some((config.into(), most(votes)?))).collect()
}

/// All of one file.
fn section(name: &str, evidence: &Sighting) -> String {
    let Sighting { date, version, commit, target, toolchain, processor, instructions, note, .. } = evidence;
    let commit =
        commit.as_ref().map_or(String::new(), |commit| format!(" of commit {}", &commit[..commit.len().min(10)]));
    let mut text = format!("\n### {name}\n\nflotilla {version}{commit}, built for {target} by {toolchain}");
    for (what, told) in [("", processor), ("widest instructions ", instructions), ("", note)] {
        text.extend(told.iter().map(|told| format!("; {what}{told}")));
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

/// With a space between thousands; nothing for none.
fn count(number: u64) -> String {
    let digits = number.to_string();
    let spaced = digits.char_indices().map(|(at, digit)| match (digits.len() - at) % 3 {
        0 if at > 0 => format!(" {digit}"),
        _ => digit.to_string(),
    });
    if number == 0 { "·".into() } else { spaced.collect() }
}
