//! Tests the machine code that AMD's compiler makes of every shader, without an AMD GPU.
//!
//! The code must have no fused multiply-adds, no scratch and no spills. Registers and instructions are limited. The
//! kernels of the paper's layouts also run in an emulator. There they must give the CPU's bits, and reach a share of
//! the chip's f32 rate.
//!
//! Mesa's RADV compiles for the chip that `RADV_FORCE_FAMILY` names. RADV reads this variable when it starts, so each
//! chip needs a new process. The process is this program again, with the ignored test `compile`. If RADV is not
//! installed, tests print that they are skipped. With `FLOTILLA_REQUIRE_RADV=1`, they fail instead. With
//! `FLOTILLA_REQUIRE_RADV=0`, they are always skipped.
//!
//! With `--nocapture`, the findings are printed, for `docs/develop/evidence.md`.
//!
//! `cargo test --test radv -- table --ignored --nocapture` prints the tables of `benches/static-figures.md`.

mod assembly;
mod case;
#[expect(unsafe_code, reason = "it calls a Vulkan driver")]
mod driver;
mod machine;
/// The root of the checkout.
const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/..");

#[path = "../../../tests/support/mod.rs"]
mod support;

use std::collections::{BTreeMap, HashMap};
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

/// The tested chips: three generations. The later two run waves of 32, like games do. The second also runs waves of 64.
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
    // RADV's default for compute shaders.
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

/// Maximum vector registers of an episode's kernel in the paper's layouts. With more registers, fewer waves run at the
/// same time and hide each other's latency.
const MAX_REGISTERS: u64 = 64;
/// Numbers that the shader of scores keeps in further registers, one per copy that D++ may need.
const COPIES: u64 = 64;
/// Maximum instructions of such a kernel, for each of [`PASSES`].
const MAX_INSTRUCTIONS: [u64; 2] = [2650, 3500];

/// The version of RADV to which these limits apply, and whose instructions the emulator knows.
const KNOWN_VERSION: &str = "radv Mesa 22.3";

/// The directories in which Vulkan looks for drivers.
const MANIFESTS: [&str; 3] = ["/usr/share/vulkan/icd.d", "/usr/local/share/vulkan/icd.d", "/etc/vulkan/icd.d"];

/// Returns RADV's manifest. Skips the test if RADV is not installed or not wanted.
fn radv(test: &str) -> Option<PathBuf> {
    if setting() == "0" {
        skip(test, "FLOTILLA_REQUIRE_RADV is 0");
        return None;
    }
    let entries = MANIFESTS.iter().filter_map(|folder| fs::read_dir(folder).ok()).flatten().flatten();
    let named = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        name.starts_with("radeon_icd") && name.ends_with(".json")
    };
    let manifest = entries.map(|entry| entry.path()).find(named);
    if manifest.is_none() {
        skip(test, &format!("no radeon_icd*.json in {}", MANIFESTS.join(", ")));
    }
    manifest
}

/// Prints that a test is skipped, or panics if RADV is required.
fn skip(test: &str, reason: &str) {
    let message = format!("{test}: skipped: {reason}");
    assert!(!is_required(), "{message}, but it is required");
    writeln!(std::io::stderr(), "\n{message}").expect("standard error is writable");
}

fn is_required() -> bool {
    setting() == "1"
}

/// Returns the value of `FLOTILLA_REQUIRE_RADV`, or an empty text.
fn setting() -> String {
    std::env::var("FLOTILLA_REQUIRE_RADV").unwrap_or_default()
}

/// Reports whether to emulate the code of this version of RADV and to check its size and speed. Another version may use
/// instructions that the emulator does not know.
fn is_known(test: &str, version: &str) -> bool {
    let known = version.starts_with(KNOWN_VERSION) || is_required();
    if !known {
        skip(test, &format!("emulation, size and speed are tested only with {KNOWN_VERSION}, not with {version}"));
    }
    known
}

/// A shader to compile: name, entry point and SPIR-V.
type Job = (String, &'static str, Vec<u32>);

/// The compiled shaders by name.
type Results = BTreeMap<String, Compiled>;

/// Compiles shaders for a chip, in a new process. Returns the version of the driver and the results.
fn compile_for(manifest: &Path, chip: Chip, jobs: &[Job]) -> (String, Results) {
    let folder = tempfile::tempdir().expect("a temporary directory");
    for (name, entry, words) in jobs {
        let path = folder.path().join(format!("{name}@{entry}.spv"));
        fs::write(path, bytemuck::cast_slice(words)).expect("the file is writable");
    }
    let program = std::env::current_exe().expect("the path of this program");
    let output = Command::new(program)
        .args(["compile", "--exact", "--ignored", "--nocapture"])
        .env("FLOTILLA_RADV_FOLDER", folder.path())
        .env("XDG_RUNTIME_DIR", folder.path())
        .envs([("VK_DRIVER_FILES", manifest), ("VK_ICD_FILENAMES", manifest)])
        .envs([("RADV_FORCE_FAMILY", chip.family), ("RADV_DEBUG", "nocache")])
        .env("RADV_PERFTEST", if chip.wave == 32 { "cswave32" } else { "" })
        .output()
        .expect("this program starts");
    assert!(output.status.success(), "{}: {}", chip.family, String::from_utf8_lossy(&output.stdout));
    let read = |name: &str, extension: &str| {
        let path = folder.path().join(format!("{name}.{extension}"));
        fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
    };
    let results = jobs.iter().map(|(name, ..)| {
        let statistics = read(name, "statistics")
            .lines()
            .filter_map(|line| line.split_once('='))
            .map(|(name, count)| (name.to_string(), count.parse().expect("a number")))
            .collect();
        (name.clone(), Compiled { statistics, assembly: read(name, "assembly") })
    });
    (read("driver", "txt"), results.collect())
}

/// Runs in the process that [`compile_for`] starts. Compiles all shaders of a directory for the chip that the
/// environment names.
#[test]
#[ignore = "other tests start it as a process, once per chip"]
fn compile() {
    let Ok(folder) = std::env::var("FLOTILLA_RADV_FOLDER") else { return };
    let folder = Path::new(&folder);
    let driver = Driver::open().unwrap_or_else(|error| panic!("RADV cannot be opened: {error}"));
    fs::write(folder.join("driver.txt"), &driver.version).expect("the file is writable");
    for entry in fs::read_dir(folder).expect("the directory is readable") {
        let path = entry.expect("the directory is readable").path();
        let file = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let Some((name, point)) = file.strip_suffix(".spv").and_then(|name| name.split_once('@')) else { continue };
        let bytes = fs::read(&path).expect("the shader is readable");
        let point = CString::new(point).expect("a name without a zero byte");
        let words = bytemuck::pod_collect_to_vec::<u8, u32>(&bytes);
        let Compiled { statistics, assembly } = driver.compile(&words, &point).expect("the driver compiles the shader");
        let lines: Vec<_> = statistics.iter().map(|(name, count)| format!("{name}={count}")).collect();
        fs::write(folder.join(format!("{name}.statistics")), lines.join("\n")).expect("the file is writable");
        fs::write(folder.join(format!("{name}.assembly")), assembly).expect("the file is writable");
    }
}

/// Returns a module as SPIR-V.
fn emit(module: &Module) -> Vec<u32> {
    let info = Validator::new(ValidationFlags::all(), Capabilities::empty()).validate(module);
    exact::emit(module, &info.expect("a valid shader"), false).expect("valid SPIR-V")
}

/// Compiles WGSL to SPIR-V with an exactness pass.
fn spirv(pass: Pass, wgsl: &str) -> Vec<u32> {
    let (module, _) = exact::parse(wgsl).unwrap_or_else(|error| panic!("{error}"));
    match pass {
        Pass::NoContraction => exact::decorate(&emit(&module)),
        Pass::Guarded => emit(&exact::guarded(&module).unwrap_or_else(|error| panic!("{error}"))),
        Pass::Plain => emit(&module),
    }
}

/// Returns the kernels that play the cases.
fn episodes(pass: Pass, cases: &[Case]) -> impl Iterator<Item = Job> {
    cases.iter().map(move |case| (case.name.clone(), "episode", spirv(pass, &case.workgroup.shader)))
}

/// Returns the kernels of the cases, and all other shaders.
fn jobs(pass: Pass, cases: &[Case]) -> Vec<Job> {
    let others = shaders().into_iter().flat_map(|(name, text)| {
        let (module, _) = exact::parse(&text).expect("shaders are valid");
        let entries: Vec<_> = module.entry_points.iter().map(|entry| entry.name.clone()).collect();
        let words = spirv(pass, &text);
        entries.into_iter().map(move |entry| (format!("{name}, {entry}"), &*entry.leak(), words.clone()))
    });
    episodes(pass, cases).chain(others).collect()
}

/// Returns the instructions that round a product and a sum only once.
///
/// Leaves out those with a power of two of at least 1 as a factor, a literal or one that a scalar register holds, because
/// their product is exact.
fn fused(assembly: &str) -> Vec<&str> {
    let literal = |operand: &str| operand.strip_prefix("0x").and_then(|hex| u32::from_str_radix(hex, 16).ok());
    let scales = |bits: u32| bits & 0x7f_ffff == 0 && (127..255).contains(&(bits >> 23));
    // Pairs and longer runs of registers are written as ranges.
    let writes = |to: &str, register: &str| {
        let number = |text: &str| text.parse::<u32>().ok();
        let range = to.strip_prefix("s[").and_then(|range| range.trim_end_matches(']').split_once(':'));
        let range = range.and_then(|(first, last)| Some(number(first)?..=number(last)?));
        let in_range =
            range.zip(register.strip_prefix('s').and_then(number)).is_some_and(|(all, one)| all.contains(&one));
        to == register || to == "vcc" && register.starts_with("vcc") || in_range
    };
    // What scalar registers hold, as far as the lines before say.
    let mut held: HashMap<&str, u32> = HashMap::new();
    let mut fused = vec![];
    for line in assembly.lines() {
        let (instruction, operands) = line.trim().split_once(' ').unwrap_or((line.trim(), ""));
        let text = operands.split(';').next().unwrap_or_default();
        let operands: Vec<&str> = text.split([',', ' ']).filter(|operand| !operand.is_empty()).collect();
        // The operands are a result, two factors, and maybe a term.
        let is_exact = ["v_fma_f32", "v_fmac_f32"].iter().any(|name| instruction.starts_with(name))
            && operands
                .iter()
                .skip(1)
                .take(2)
                .any(|factor| literal(factor).or_else(|| held.get(factor).copied()).is_some_and(scales));
        if instruction.contains("fma") && !is_exact {
            fused.push(line);
        }
        match operands[..] {
            [to, from] if instruction == "s_mov_b32" && literal(from).is_some() => {
                held.extend(literal(from).map(|bits| (to, bits)));
            }
            [to, ..] => held.retain(|register, _| !writes(to, register)),
            [] => (),
        }
    }
    fused
}

/// Reports whether the text is assembly at all: every shader has a sum or a product.
fn has_arithmetic(assembly: &str) -> bool {
    assembly.contains("v_mul_f32") || assembly.contains("v_mul_lo_u32") || assembly.contains("v_add")
}

#[test]
fn fused_instructions_are_recognised() {
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
        "s_mov_b32 s4, 0x45800001\nv_fmac_f32_e32 v1, s4, v2",
        "s_mov_b32 s4, 0x45800000\ns_add_u32 s4, s4, s5\nv_fmac_f32_e32 v1, s4, v2",
    ] {
        assert_eq!(fused(fused_line).len(), 1, "{fused_line}");
    }
    for exact in [
        "v_fma_f32 v1, 0x48800000, v2, 0.5",
        "v_fma_f32 v1, v2, 0x48800000, 0.5",
        "v_mac_f32 v1, v2, v3",
        "v_mul_f32 v1, v2, v3",
        "s_mov_b32 vcc_hi, 0x45800000\nv_fmac_f32_e32 v1, vcc_hi, v2 ; 565a586b",
    ] {
        assert_eq!(fused(exact), Vec::<&str>::new(), "{exact}");
    }
}

#[test]
fn compiled_shaders_are_exact_small_and_fast() {
    let test = "compiled_shaders_are_exact_small_and_fast";
    let Some(manifest) = radv(test) else { return };
    let cases = Case::all();
    for (pass, max_instructions) in PASSES.into_iter().zip(MAX_INSTRUCTIONS) {
        let jobs = jobs(pass, &cases);
        for chip in CHIPS {
            let (version, results) = compile_for(&manifest, chip, &jobs);
            let is_known = is_known(test, &version);
            for (name, Compiled { statistics, assembly }) in &results {
                let context = format!("{chip} under the {pass} pass, {name} ({version})");
                if !has_arithmetic(assembly) {
                    return skip(test, &format!("{context}: not assembly: {assembly}"));
                }
                assert_eq!(fused(assembly), Vec::<&str>::new(), "{context}: fused");
                // The multiply-adds v_mad_f32 and v_mac_f32 round the product and the sum. Only GCN has them.
                if !chip.gcn {
                    assert!(!assembly.contains("v_mad_f32") && !assembly.contains("v_mac_f32"), "{context}");
                }
                let count = |name: &str| {
                    *statistics.get(name).unwrap_or_else(|| panic!("{context}: no \"{name}\" in {statistics:?}"))
                };
                // The limits do not apply to the other episode shaders. They index arrays, for several agents per
                // thread or wide networks, or they trace, which need not be fast.
                if name.starts_with("episode, ") || name.starts_with("swarm, traced, ") || !is_known {
                    continue;
                }
                assert_eq!(count("Scratch size"), 0, "{context}: scratch memory");
                // The generic kernel plays any classes of agents, so it is larger.
                if name.contains(", generic, ") {
                    continue;
                }
                assert_eq!(count("Spilled VGPRs"), 0, "{context}");
                // The kernels of large teams play any classes as well. A few scalar registers may be spilled: into lanes of
                // vector registers, not to memory.
                if name.starts_with("swarm, ") {
                    assert!(count("Spilled SGPRs") <= 4, "{context}: {} spilled SGPRs", count("Spilled SGPRs"));
                    continue;
                }
                assert_eq!(count("Spilled SGPRs"), 0, "{context}");
                let most = MAX_REGISTERS + if name.starts_with("count, ") { COPIES } else { 0 };
                assert!(count("VGPRs") <= most, "{context}: {} registers", count("VGPRs"));
                assert!(count("Instructions") <= max_instructions, "{context}: {} instructions", count("Instructions"));
            }
            let mut finding = format!("{chip}, {pass} pass: {} shaders, none fused", results.len());
            if is_known {
                let steps: u64 = cases.par_iter().map(|case| run(case, chip, pass, &results[&case.name])).sum();
                let kernels = cases.len();
                finding += &format!("; {kernels} run in an emulator for {steps} agent-steps, with the CPU's bits");
            }
            println!("{finding} ({version})");
        }
    }
}

/// Emulates the compiled kernel of a case, and checks its results and its speed. Returns the number of agent-steps.
fn run(case: &Case, chip: Chip, pass: Pass, compiled: &Compiled) -> u64 {
    let context = format!("{chip} under the {pass} pass, {}", case.name);
    let Run { differences, cost, share } = case.run(&chip, compiled);
    assert_eq!(differences, 0, "{context}: words of the record and the final states that differ from the CPU's");
    assert_eq!(cost.denormal, 0, "{context}: results that the chip may flush to zero");
    let min = case.min_share(&chip, pass);
    assert!(share >= min, "{context}: {:.1} % of the f32 rate, not {:.0}", 100.0 * share, 100.0 * min);
    case.agent_steps
}

/// A canary: without a pass, the compiler fuses. Both the search for instructions and the emulator must detect this.
#[test]
fn without_a_pass_the_compiler_fuses() {
    let Some(manifest) = radv("without_a_pass_the_compiler_fuses") else { return };
    let cases = Case::all();
    let jobs: Vec<_> = jobs(Pass::Plain, &cases).into_iter().filter(|(_, entry, _)| *entry == "episode").collect();
    for chip in CHIPS.into_iter().filter(|chip| !chip.gcn) {
        let (version, results) = compile_for(&manifest, chip, &jobs);
        for (name, Compiled { assembly, .. }) in &results {
            let count = fused(assembly).len();
            assert!(count >= 20, "{chip}, {name}: only {count} instructions are fused");
        }
        let is_known = is_known("without_a_pass_the_compiler_fuses", &version);
        for case in cases.iter().filter(|_| is_known) {
            assert!(
                case.run(&chip, &results[&case.name]).differences > 0,
                "{chip}, {}: the emulator's results are equal",
                case.name
            );
        }
    }
}

/// Guards that use `^` do not work. The first sum of an unrolled loop adds to 0 and is removed. The guards before and
/// after it then cancel each other. Guards that use `|` do not cancel.
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
    let jobs: [Job; 2] = [("or".into(), "sum", emit(&by_or)), ("xor".into(), "sum", emit(&by_xor))];
    for chip in CHIPS.into_iter().filter(|chip| !chip.gcn) {
        let (_, results) = compile_for(&manifest, chip, &jobs);
        assert_eq!(fused(&results["or"].assembly), Vec::<&str>::new(), "{}", chip.family);
        assert!(
            !fused(&results["xor"].assembly).is_empty(),
            "{}: guards with ^ were not cancelled, so this test is useless",
            chip.family
        );
    }
}

/// Prints the tables by chip of `benches/static-figures.md`.
#[test]
#[ignore = "prints a table"]
fn table() {
    let Some(manifest) = radv("table") else { return };
    let cases = Case::all();
    let mut rows: BTreeMap<(usize, usize), Vec<String>> = BTreeMap::new();
    let mut columns = Vec::new();
    let mut versions = Vec::new();
    for pass in PASSES {
        let jobs: Vec<Job> = episodes(pass, &cases).collect();
        for chip in CHIPS {
            let (version, results) = compile_for(&manifest, chip, &jobs);
            versions.push(version);
            columns.push(format!("{chip}, {pass}"));
            let runs: Vec<Run> = cases.par_iter().map(|case| case.run(&chip, &results[&case.name])).collect();
            for (index, (case, Run { cost, share, .. })) in cases.iter().zip(runs).enumerate() {
                let count = |name: &str| results[&case.name].statistics[name];
                let cells = [
                    format!("{:.0}", 100.0 * share),
                    format!("{:.0}, {:.0}", case.slots(&chip, cost), case.cycles(cost)),
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
        println!("| layout, kernel, threads | {} |", columns.join(" | "));
        println!("|---|{}", "---|".repeat(columns.len()));
        for (index, case) in cases.iter().enumerate() {
            println!("| {} | {} |", case.name, rows[&(table, index)].join(" | "));
        }
    }
}

mod emulator {
    use super::*;

    /// A program in which three threads add their number to a word of memory, double the sum, and store it.
    const PROGRAM: &str = "BB0:
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
    fn the_emulator_runs_and_times_a_wave() {
        let chip = CHIPS[1];
        let floats = |values: &[f32]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
        let mut buffers = [vec![], vec![], floats(&[0.0, 1.0, 2.0, 3.0, 4.0])];
        let cost = chip.run(PROGRAM, 32, &mut buffers);
        assert_eq!(buffers[2], floats(&[2.0, 6.0, 10.0, 3.0, 4.0]));
        assert_eq!((cost.vector, cost.denormal), (4, 0));
        // The descriptor takes 1 + 200 and its wait 1, the load 1 + 320 and its wait 1. The sum takes 1. The store
        // waits 4 for it and takes 1.
        assert_eq!(cost.slowest_wave, 530);
        // With few cycles of the slowest wave, the vector instructions decide: one per cycle and unit.
        let cost = machine::Cost { vector: 6400, slowest_wave: 100, denormal: 0 };
        assert_eq!(chip.share(102_400.0, 512, 64, cost), 0.5);
        // With many, they decide. Two concurrent workgroups of 16 waves halve them; with 65 registers, only one fits.
        let cost = machine::Cost { slowest_wave: 12_800, ..cost };
        assert_eq!(chip.share(102_400.0, 512, 64, cost), 0.25);
        assert_eq!(chip.share(102_400.0, 512, 65, cost), 0.125);
    }

    #[test]
    #[should_panic(expected = "unknown instruction `v_sin_f32_e32 v1, v0`")]
    fn unknown_instructions_are_named() {
        CHIPS[0].run("BB0:\n\tv_sin_f32_e32 v1, v0\n\ts_endpgm\n", 64, &mut []);
    }
}
