//! What AMD's own compiler makes of every shader, for chips that are not there: no fused multiply-add, no scratch, no
//! spills, registers and instructions under a ceiling. The kernels of the paper's layouts are run by an emulator, too: to
//! the CPU's bits, and at no less than a share of the chip's f32 rate.
//!
//! Mesa's RADV compiles for whatever chip `RADV_FORCE_FAMILY` names. It reads that as it starts, so each chip takes a
//! process of its own: this program once more, as the test `compile`. Without RADV all is skipped in plain sight, or
//! fails where `FLOTILLA_REQUIRE_RADV=1` says that it is needed.
//!
//! With `FLOTILLA_EVIDENCE=FOLDER` what was read is noted there, as a row of `docs/develop/evidence.md`.
//!
//! `cargo test --test radv -- table --ignored --nocapture` makes the tables of `benches/static-figures.md`.

#![cfg(feature = "cli")]

mod assembly;
mod case;
#[expect(unsafe_code, reason = "a Vulkan driver is called directly")]
mod driver;
mod machine;
#[path = "../support/mod.rs"]
mod support;

use std::collections::BTreeMap;
use std::ffi::CString;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

use case::{Case, Run};
use driver::{Compiled, Driver};
use flotilla::backend::gpu::exact::{self, Pass};
use flotilla::backend::gpu::shaders;
use machine::Chip;
use naga::valid::{Capabilities, ValidationFlags, Validator};
use naga::{BinaryOperator, Expression, Module};
use rayon::prelude::*;

/// Three generations; the later two in waves of 32, as games have them, the second in waves of 64 too.
const CHIPS: [Chip; 4] = [
    Chip {
        family: "VEGA20",
        wave: 64,
        lanes: 16,
        units: 4,
        registers: 256,
        granule: 4,
        waves: 10,
        latency: 1,
        gcn: true,
    },
    NAVI21,
    // As RADV would have it if it were not asked.
    Chip { wave: 64, registers: 512, granule: 8, ..NAVI21 },
    Chip { family: "GFX1100", registers: 1536, granule: 24, ..NAVI21 },
];
const NAVI21: Chip = Chip {
    family: "NAVI21",
    wave: 32,
    lanes: 32,
    units: 2,
    registers: 1024,
    granule: 16,
    waves: 16,
    latency: 5,
    gcn: false,
};
const PASSES: [Pass; 2] = [Pass::NoContraction, Pass::Guarded];

/// Vector registers, and instructions under each pass, that an episode's kernel takes at most at the paper's layouts.
/// Ceilings, not measurements: with more registers fewer waves hide each other's waiting.
const REGISTERS: u64 = 64;
const INSTRUCTIONS: [u64; 2] = [2600, 3500];

/// The version that these are of, and that the emulator knows.
const KNOWN: &str = "radv Mesa 22.3";

/// Where the loader looks for drivers' manifests.
const MANIFESTS: [&str; 3] = ["/usr/share/vulkan/icd.d", "/usr/local/share/vulkan/icd.d", "/etc/vulkan/icd.d"];

/// RADV's manifest, if it is installed.
fn radv(test: &str) -> Option<PathBuf> {
    let entries = MANIFESTS.iter().filter_map(|folder| fs::read_dir(folder).ok()).flatten().flatten();
    let named = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        name.starts_with("radeon_icd") && name.ends_with(".json")
    };
    let found = entries.map(|entry| entry.path()).find(named);
    if found.is_none() {
        skip(test, &format!("no radeon_icd*.json in {}", MANIFESTS.join(", ")));
    }
    found
}

fn skip(test: &str, why: &str) {
    let message = format!("{test}: skipped: {why}");
    assert!(!is_required(), "{message}, but it is required");
    writeln!(std::io::stderr(), "\n{message}").expect("standard error takes a line");
}

fn is_required() -> bool {
    std::env::var("FLOTILLA_REQUIRE_RADV").as_deref() == Ok("1")
}

/// Whether what this version writes is to be run and as small and fast as is asked: another may write what the emulator
/// has never met.
fn is_known(test: &str, version: &str) -> bool {
    let known = version.starts_with(KNOWN) || is_required();
    if !known {
        skip(test, &format!("running what {version} writes, and its size and speed; this is for {KNOWN}"));
    }
    known
}

/// A shader on its way to the compiler: its name, its entry point and its SPIR-V.
type Job = (String, &'static str, Vec<u32>);

/// Every shader of a job's name, and what came of it.
type Results = BTreeMap<String, Compiled>;

/// Compiles all jobs for a chip.
fn compiled(manifest: &Path, chip: Chip, jobs: &[Job]) -> (String, Results) {
    let folder = tempfile::tempdir().expect("a folder for the shaders");
    for (name, entry, words) in jobs {
        let path = folder.path().join(format!("{name}@{entry}.spv"));
        fs::write(path, bytemuck::cast_slice(words)).expect("the folder takes a file");
    }
    let program = std::env::current_exe().expect("a program knows where it is");
    let output = Command::new(program)
        .args(["compile", "--exact", "--ignored", "--nocapture"])
        .env("FLOTILLA_RADV_FOLDER", folder.path())
        .env("XDG_RUNTIME_DIR", folder.path())
        .envs([("VK_DRIVER_FILES", manifest), ("VK_ICD_FILENAMES", manifest)])
        .envs([("RADV_FORCE_FAMILY", chip.family), ("RADV_DEBUG", "nocache")])
        .env("RADV_PERFTEST", if chip.wave == 32 { "cswave32" } else { "" })
        .output()
        .expect("this program can be run");
    assert!(output.status.success(), "{}: {}", chip.family, String::from_utf8_lossy(&output.stdout));
    let read = |name: &str, what: &str| {
        let path = folder.path().join(format!("{name}.{what}"));
        fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
    };
    let results = jobs.iter().map(|(name, ..)| {
        let statistics = read(name, "statistics")
            .lines()
            .filter_map(|line| line.split_once('='))
            .map(|(what, count)| (what.to_string(), count.parse().expect("a number")))
            .collect();
        (name.clone(), Compiled { statistics, assembly: read(name, "assembly") })
    });
    (read("driver", "txt"), results.collect())
}

/// The other side of `compiled`: compiles what lies in a folder, for the chip that the environment names.
#[test]
#[ignore = "runs as a process of its own, for one chip"]
fn compile() {
    let Ok(folder) = std::env::var("FLOTILLA_RADV_FOLDER") else { return };
    let folder = Path::new(&folder);
    let driver = Driver::open().unwrap_or_else(|error| panic!("RADV cannot be opened: {error}"));
    fs::write(folder.join("driver.txt"), &driver.version).expect("the folder takes a file");
    for entry in fs::read_dir(folder).expect("the folder can be listed") {
        let path = entry.expect("and its entries too").path();
        let file = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let Some((name, point)) = file.strip_suffix(".spv").and_then(|name| name.split_once('@')) else { continue };
        let bytes = fs::read(&path).expect("a shader can be read");
        let point = CString::new(point).expect("no zero in a name");
        let words = bytemuck::pod_collect_to_vec::<u8, u32>(&bytes);
        let Compiled { statistics, assembly } = driver.compile(&words, &point).expect("the driver takes it");
        let lines: Vec<_> = statistics.iter().map(|(what, count)| format!("{what}={count}")).collect();
        fs::write(folder.join(format!("{name}.statistics")), lines.join("\n")).expect("the folder takes a file");
        fs::write(folder.join(format!("{name}.assembly")), assembly).expect("the folder takes a file");
    }
}

fn emitted(module: &Module) -> Vec<u32> {
    let info = Validator::new(ValidationFlags::all(), Capabilities::empty()).validate(module);
    exact::emit(module, &info.expect("a valid shader"), false).expect("it has SPIR-V")
}

fn under(pass: Pass, wgsl: &str) -> Vec<u32> {
    let (module, _) = exact::parse(wgsl).unwrap_or_else(|error| panic!("{error}"));
    match pass {
        Pass::NoContraction => exact::decorate(&emitted(&module)),
        Pass::Guarded => emitted(&exact::guarded(&module).unwrap_or_else(|error| panic!("{error}"))),
        Pass::Plain => emitted(&module),
    }
}

/// The kernels that play the cases.
fn episodes(pass: Pass, cases: &[Case]) -> impl Iterator<Item = Job> {
    cases.iter().map(move |case| (case.name.clone(), "episode", under(pass, &case.workgroup.shader)))
}

/// These, and every other shader.
fn jobs(pass: Pass, cases: &[Case]) -> Vec<Job> {
    let others = shaders().into_iter().flat_map(|(name, text)| {
        let (module, _) = exact::parse(&text).expect("shaders are valid");
        let entries: Vec<_> = module.entry_points.iter().map(|entry| entry.name.clone()).collect();
        let words = under(pass, &text);
        entries.into_iter().map(move |entry| (format!("{name}, {entry}"), &*entry.leak(), words.clone()))
    });
    episodes(pass, cases).chain(others).collect()
}

/// Instructions that round a product and a sum at once.
///
/// Not those whose product is exact: `v_fma_f32` by a literal power of two of at least 1, which only scales.
fn fused(assembly: &str) -> Vec<&str> {
    let scales = |operand: &str| {
        let bits = operand.strip_prefix("0x").and_then(|hex| u32::from_str_radix(hex, 16).ok());
        bits.is_some_and(|bits| bits & 0x7f_ffff == 0 && (127..255).contains(&(bits >> 23)))
    };
    let is_fused = |line: &&str| {
        let (instruction, operands) = line.trim().split_once(' ').unwrap_or((line.trim(), ""));
        // To, factor, factor, term.
        let mut factors = operands.split([',', ' ']).filter(|operand| !operand.is_empty()).skip(1).take(2);
        instruction.contains("fma") && !(instruction.starts_with("v_fma_f32") && factors.any(scales))
    };
    assembly.lines().filter(is_fused).collect()
}

/// Whether the text is what it should be: no shader does without a sum or a product.
fn has_arithmetic(assembly: &str) -> bool {
    assembly.contains("v_mul_f32") || assembly.contains("v_mul_lo_u32") || assembly.contains("v_add")
}

#[test]
fn the_reader_of_assembly_knows_what_is_fused() {
    for fused_line in [
        "\tv_fma_f32 v1, v2, v3, v4 ; d5cb0001",
        "v_fmac_f32_e32 v1, v2, v3",
        "v_fmaak_f32 v1, v2, v3, 0x48800000",
        "v_fmamk_f32 v1, v2, 0x48800000, v3",
        "v_dual_fmac_f32 v1, v2, v3 :: v_dual_mul_f32 v4, v5, v6",
        "v_pk_fma_f32 v[0:1], v[2:3], v[4:5], v[6:7]",
        "v_fma_f32 v1, v2, v3, 0x48800000",
        "v_fma_f32 v1, 0x3e800000, v3, 0.5",
        "v_fma_f32 v1, 0x48800001, v3, 0.5",
    ] {
        assert_eq!(fused(fused_line).len(), 1, "{fused_line}");
    }
    for exact in [
        "v_fma_f32 v1, 0x48800000, v2, 0.5",
        "v_fma_f32 v1, v2, 0x48800000, 0.5",
        "v_mac_f32 v1, v2, v3",
        "v_mul_f32 v1, v2, v3",
    ] {
        assert_eq!(fused(exact), Vec::<&str>::new(), "{exact}");
    }
}

#[test]
fn what_the_compiler_writes_is_exact_small_and_fast() {
    let test = "what_the_compiler_writes_is_exact_small_and_fast";
    let Some(manifest) = radv(test) else { return };
    let (cases, mut read) = (Case::all(), Vec::new());
    for (pass, most_instructions) in PASSES.into_iter().zip(INSTRUCTIONS) {
        let jobs = jobs(pass, &cases);
        for chip in CHIPS {
            let (version, results) = compiled(&manifest, chip, &jobs);
            println!("{chip}: {version}, {} shaders, {pass} pass", results.len());
            let is_known = is_known(test, &version);
            for (name, Compiled { statistics, assembly }) in &results {
                let what = format!("{chip} under the {pass} pass, {name} ({version})");
                if !has_arithmetic(assembly) {
                    return skip(test, &format!("{what}: this is no assembly: {assembly}"));
                }
                assert_eq!(fused(assembly), Vec::<&str>::new(), "{what}: fused");
                // GCN has an unfused multiply-add: product and sum are rounded.
                if !chip.gcn {
                    assert!(!assembly.contains("v_mad_f32") && !assembly.contains("v_mac_f32"), "{what}");
                }
                let count = |named: &str| {
                    *statistics.get(named).unwrap_or_else(|| panic!("{what}: no \"{named}\" in {statistics:?}"))
                };
                // Several agents a thread and networks wider than the paper's are indexed, and nobody traces for speed.
                if name.starts_with("episode, ") || !is_known {
                    continue;
                }
                for none in ["Scratch size", "Spilled SGPRs", "Spilled VGPRs"] {
                    assert_eq!(count(none), 0, "{what}: {none}");
                }
                assert!(count("VGPRs") <= REGISTERS, "{what}: {} registers", count("VGPRs"));
                assert!(count("Instructions") <= most_instructions, "{what}: {} instructions", count("Instructions"));
            }
            let mut finding = format!("{chip}, {pass} pass: {} shaders, none fused", results.len());
            if is_known {
                let steps: u64 = cases.par_iter().map(|case| run(case, chip, pass, &results[&case.name])).sum();
                let kernels = cases.len();
                finding += &format!("; {kernels} run by an emulator for {steps} agent-steps, to the CPU's bits");
            }
            read.push((version, finding));
        }
    }
    note(read);
}

/// Runs what was compiled of a case: to the CPU's bits, and as fast as is asked. How many agent-steps that was.
fn run(case: &Case, chip: Chip, pass: Pass, compiled: &Compiled) -> u64 {
    let what = format!("{chip} under the {pass} pass, {}", case.name);
    let Run { differ, cost, share } = case.run(&chip, compiled);
    assert_eq!(differ, 0, "{what}: words of the record and of where agents stand");
    assert_eq!(cost.denormal, 0, "{what}: results that the chip may flush");
    let least = case.least(&chip, pass);
    assert!(share >= least, "{what}: {:.1} % of the f32 rate, not {:.0}", 100.0 * share, 100.0 * least);
    case.agent_steps
}

/// Notes what was read where `FLOTILLA_EVIDENCE` says, each with the driver that compiled it.
fn note(read: Vec<(String, String)>) {
    use flotilla::record::evidence::{MachineReport, Tier};
    let Some(folder) = std::env::var_os("FLOTILLA_EVIDENCE") else { return };
    let note = read.first().map(|(version, _)| format!("Mesa's RADV, {version}, for chips that were not there"));
    let findings = read.into_iter().map(|(_, finding)| finding).collect();
    let sighting = MachineReport { note, findings, ..MachineReport::new(Tier::MachineCodeRead) };
    fs::write(Path::new(&folder).join("radv.json"), sighting.to_json()).expect("the folder takes a file");
}

/// The canary: without a pass the compiler fuses, and it shows, in its code and in what that does.
#[test]
fn without_a_pass_the_compiler_fuses() {
    let Some(manifest) = radv("without_a_pass_the_compiler_fuses") else { return };
    let cases = Case::all();
    let jobs: Vec<_> = jobs(Pass::Plain, &cases).into_iter().filter(|(_, entry, _)| *entry == "episode").collect();
    for chip in CHIPS.into_iter().filter(|chip| !chip.gcn) {
        let (version, results) = compiled(&manifest, chip, &jobs);
        for (name, Compiled { assembly, .. }) in &results {
            let found = fused(assembly).len();
            assert!(found >= 20, "{chip}, {name}: only {found} of its instructions are fused");
        }
        let is_known = is_known("without_a_pass_the_compiler_fuses", &version);
        for case in cases.iter().filter(|_| is_known) {
            assert!(case.run(&chip, &results[&case.name]).differ > 0, "{chip}, {}: nothing shows", case.name);
        }
    }
}

/// Guards by `^` leaked: the first sum of an unrolled loop adds to 0, which falls away, and the two guards around it
/// cancelled. Guards by `|` do not.
#[test]
fn guards_are_not_cancelled() {
    let Some(manifest) = radv("guards_are_not_cancelled") else { return };
    let text = "@group(0) @binding(1) var<storage, read> values: array<f32>;
        @group(0) @binding(2) var<storage, read_write> result: array<f32>;
        @compute @workgroup_size(64) fn sum(@builtin(local_invocation_index) thread: u32) {
            let factor = values[thread];
            var sum = 0.0;
            for (var k = 0u; k < 4u; k++) {
                sum = sum + values[64u + k] * factor;
            }
            result[thread] = sum;
        }";
    let (module, _) = exact::parse(text).unwrap_or_else(|error| panic!("{error}"));
    let by_or = exact::guarded(&module).unwrap_or_else(|error| panic!("{error}"));
    let mut by_xor = by_or.clone();
    for entry in &mut by_xor.entry_points {
        for (_, expression) in entry.function.expressions.iter_mut() {
            if let Expression::Binary { op, .. } = expression
                && *op == BinaryOperator::InclusiveOr
            {
                *op = BinaryOperator::ExclusiveOr;
            }
        }
    }
    let jobs: [Job; 2] = [("or".into(), "sum", emitted(&by_or)), ("xor".into(), "sum", emitted(&by_xor))];
    for chip in CHIPS.into_iter().filter(|chip| !chip.gcn) {
        let (_, results) = compiled(&manifest, chip, &jobs);
        assert_eq!(fused(&results["or"].assembly), Vec::<&str>::new(), "{}", chip.family);
        assert!(!fused(&results["xor"].assembly).is_empty(), "{}: the test shows nothing", chip.family);
    }
}

/// Prints the table by chip of `benches/static-figures.md`.
#[test]
#[ignore = "prints a table"]
fn table() {
    let Some(manifest) = radv("table") else { return };
    let cases = Case::all();
    let mut rows: BTreeMap<(usize, usize), Vec<String>> = BTreeMap::new();
    let mut heads = Vec::new();
    let mut versions = Vec::new();
    for pass in PASSES {
        let jobs: Vec<Job> = episodes(pass, &cases).collect();
        for chip in CHIPS {
            let (version, results) = compiled(&manifest, chip, &jobs);
            versions.push(version);
            heads.push(format!("{chip}, {pass}"));
            let runs: Vec<Run> = cases.par_iter().map(|case| case.run(&chip, &results[&case.name])).collect();
            for (index, (case, Run { cost, share, .. })) in cases.iter().zip(runs).enumerate() {
                let count = |what: &str| results[&case.name].statistics[what];
                let cells = [
                    format!("{:.0}", 100.0 * share),
                    format!("{:.0}, {:.0}", case.slots(&chip, cost), case.alone(cost)),
                    format!("{}, {}", count("VGPRs"), count("Instructions")),
                ];
                for (table, cell) in cells.into_iter().enumerate() {
                    rows.entry((table, index)).or_default().push(cell);
                }
            }
        }
    }
    versions.dedup();
    let tables = [
        "% of the f32 rate",
        "Lane slots per team-step, cycles of the slowest wave per step",
        "Vector registers and instructions",
    ];
    for (table, title) in tables.into_iter().enumerate() {
        println!("\n{title}, {}:\n", versions.join(", "));
        println!("| layout, kernel, threads | {} |", heads.join(" | "));
        println!("|---|{}", "---|".repeat(heads.len()));
        for (index, case) in cases.iter().enumerate() {
            println!("| {} | {} |", case.name, rows[&(table, index)].join(" | "));
        }
    }
}

mod emulator {
    use super::*;

    /// A wave that adds its threads' numbers to what memory has, one by one, and leaves the sums there.
    const SUMS: &str = "BB0:
\ts_load_dwordx4 s[8:11], s[2:3], 0x20 ; a comment
\tv_lshlrev_b32_e32 v1, 2, v0
\tv_cvt_f32_u32_e32 v2, v0
\ts_waitcnt lgkmcnt(0)
\tbuffer_load_dword v3, v1, s[8:11], 0 offen offset:4
\tv_cmp_gt_u32_e32 vcc_lo, 3, v0
\ts_and_saveexec_b32 s4, vcc_lo
\ts_cbranch_execz BB2
BB1:
\ts_waitcnt vmcnt(0)
\tv_sub_f32_e64 v3, v3, -v2 mul:2
\tbuffer_store_dword v3, v1, s[8:11], 0 offen
BB2:
\ts_endpgm
";

    #[test]
    fn a_wave_is_run_and_timed() {
        let chip = CHIPS[1];
        let floats = |values: &[f32]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
        let mut buffers = [vec![], vec![], floats(&[0.0, 1.0, 2.0, 3.0, 4.0])];
        let cost = chip.run(SUMS, 32, &mut buffers);
        assert_eq!(buffers[2], floats(&[2.0, 6.0, 10.0, 3.0, 4.0]));
        assert_eq!((cost.vector, cost.denormal), (4, 0));
        // The descriptor 1 + 200 and its wait 1, the load 1 + 320 and its wait 1, the sum 1 and 4 until it can be stored, 1.
        assert_eq!(cost.alone, 530);
        // One instruction a cycle and unit; two workgroups of 16 waves side by side halve what is waited for.
        let cost = machine::Cost { vector: 6400, alone: 100, denormal: 0 };
        assert_eq!(chip.share(102_400.0, 512, 64, cost), 0.5);
        let cost = machine::Cost { alone: 12_800, ..cost };
        assert_eq!(chip.share(102_400.0, 512, 64, cost), 0.25);
        assert_eq!(chip.share(102_400.0, 512, 65, cost), 0.125);
    }

    #[test]
    #[should_panic(expected = "nobody knows `v_sin_f32_e32 v1, v0`")]
    fn what_is_unknown_is_named() {
        CHIPS[0].run("BB0:\n\tv_sin_f32_e32 v1, v0\n\ts_endpgm\n", 64, &mut []);
    }
}
