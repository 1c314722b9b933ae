//! What AMD's own compiler makes of every shader, for chips that are not there: no fused multiply-add, no scratch, no
//! spills, registers and instructions under a ceiling.
//!
//! Mesa's RADV compiles for whatever chip `RADV_FORCE_FAMILY` names. It reads that as it starts, so each chip takes a
//! process of its own: this program once more, as the test `compile`. Without RADV all is skipped in plain sight, or
//! fails where `FLOTILLA_REQUIRE_RADV=1` says that it is needed.
//!
//! With `FLOTILLA_EVIDENCE=FOLDER` what was read is noted there, as a row of `docs/evidence.md`.
//!
//! `cargo test --test radv -- table --ignored --nocapture` makes the table of `benches/README.md`.

#![cfg(feature = "gpu")]

#[expect(unsafe_code, reason = "a Vulkan driver is called directly")]
mod driver;
#[path = "../support/mod.rs"]
mod support;

use std::collections::BTreeMap;
use std::ffi::CString;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

use driver::{Compiled, Driver};
use flotilla::backend::gpu::episode::{Kernel, shader_of};
use flotilla::backend::gpu::exact::{self, Pass};
use flotilla::backend::gpu::shaders;
use naga::valid::{Capabilities, ValidationFlags, Validator};
use naga::{BinaryOperator, Expression, Module};

/// A chip, as RADV calls it.
#[derive(Clone, Copy)]
struct Chip {
    family: &'static str,
    /// Whether it has an unfused multiply-add (`v_mad_f32`, `v_mac_f32`: product and sum are rounded) instead.
    unfused: bool,
}

/// Three generations; the later two in waves of 32, as games have them.
const CHIPS: [Chip; 3] = [
    Chip { family: "VEGA20", unfused: true },
    Chip { family: "NAVI21", unfused: false },
    Chip { family: "GFX1100", unfused: false },
];
const PASSES: [Pass; 2] = [Pass::NoContraction, Pass::Guarded];

/// Vector registers and instructions that an episode's kernel takes at most at the paper's layouts. Ceilings, not
/// measurements: with more registers fewer waves hide each other's waiting.
const REGISTERS: u64 = 72;
const INSTRUCTIONS: u64 = 3600;

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
        let message = format!("{test}: skipped: no radeon_icd*.json in {}", MANIFESTS.join(", "));
        assert!(std::env::var("FLOTILLA_REQUIRE_RADV").as_deref() != Ok("1"), "{message}, but it is required");
        writeln!(std::io::stderr(), "\n{message}").expect("standard error takes a line");
    }
    found
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
        .envs([("RADV_FORCE_FAMILY", chip.family), ("RADV_DEBUG", "nocache"), ("RADV_PERFTEST", "cswave32")])
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

/// The kernels that play the paper's layouts: by the threads of the largest workgroup, generic and specialised.
fn episodes() -> Vec<(String, String)> {
    let shaders = support::papers_worlds().into_iter().flat_map(|(name, world)| {
        [(Kernel::Generic, 256), (Kernel::Specialised, 256), (Kernel::Specialised, 1024)]
            .map(|(kernel, threads)| (format!("{name}, {kernel}, {threads}"), shader_of(&world, kernel, threads)))
    });
    shaders.collect()
}

/// All of [`episodes`], and every other shader.
fn jobs(pass: Pass) -> Vec<Job> {
    let episodes = episodes().into_iter().map(|(name, text)| (name, "episode", under(pass, &text)));
    let others = shaders().into_iter().flat_map(|(name, text)| {
        let (module, _) = exact::parse(&text).expect("shaders are valid");
        let entries: Vec<_> = module.entry_points.iter().map(|entry| entry.name.clone()).collect();
        let words = under(pass, &text);
        entries.into_iter().map(move |entry| (format!("{name}, {entry}"), &*entry.leak(), words.clone()))
    });
    episodes.chain(others).collect()
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
fn no_shader_is_fused_spills_or_is_large() {
    let Some(manifest) = radv("no_shader_is_fused_spills_or_is_large") else { return };
    let mut read = Vec::new();
    for pass in PASSES {
        let jobs = jobs(pass);
        for chip in CHIPS {
            let (version, results) = compiled(&manifest, chip, &jobs);
            println!("{}: {version}, {} shaders, {pass} pass", chip.family, results.len());
            read.push((
                version.clone(),
                format!("{}, {pass} pass: {} shaders, none fused", chip.family, results.len()),
            ));
            for (name, Compiled { statistics, assembly }) in &results {
                let what = format!("{} under the {pass} pass, {name} ({version})", chip.family);
                assert!(has_arithmetic(assembly), "{what}: this is no assembly: {assembly}");
                assert_eq!(fused(assembly), Vec::<&str>::new(), "{what}: fused");
                if !chip.unfused {
                    assert!(!assembly.contains("v_mad_f32") && !assembly.contains("v_mac_f32"), "{what}");
                }
                let count = |named: &str| {
                    *statistics.get(named).unwrap_or_else(|| panic!("{what}: no \"{named}\" in {statistics:?}"))
                };
                // Several agents a thread and networks wider than the paper's are indexed, and nobody traces for speed.
                if name.starts_with("episode, ") {
                    continue;
                }
                for none in ["Scratch size", "Spilled SGPRs", "Spilled VGPRs"] {
                    assert_eq!(count(none), 0, "{what}: {none}");
                }
                assert!(count("VGPRs") <= REGISTERS, "{what}: {} registers", count("VGPRs"));
                assert!(count("Instructions") <= INSTRUCTIONS, "{what}: {} instructions", count("Instructions"));
            }
        }
    }
    note(read);
}

/// Notes what was read where `FLOTILLA_EVIDENCE` says, each with the driver that compiled it.
#[cfg(feature = "record")]
fn note(read: Vec<(String, String)>) {
    use flotilla::record::evidence::{Sighting, Tier};
    let Some(folder) = std::env::var_os("FLOTILLA_EVIDENCE") else { return };
    let note = read.first().map(|(version, _)| format!("Mesa's RADV, {version}, for chips that were not there"));
    let findings = read.into_iter().map(|(_, finding)| finding).collect();
    let sighting = Sighting { note, findings, ..Sighting::new(Tier::MachineCodeRead) };
    fs::write(Path::new(&folder).join("radv.json"), sighting.to_json()).expect("the folder takes a file");
}

#[cfg(not(feature = "record"))]
fn note(_: Vec<(String, String)>) {}

/// The canary: without a pass the compiler fuses, and it shows.
#[test]
fn without_a_pass_the_compiler_fuses() {
    let Some(manifest) = radv("without_a_pass_the_compiler_fuses") else { return };
    let jobs: Vec<_> = jobs(Pass::Plain).into_iter().filter(|(_, entry, _)| *entry == "episode").collect();
    for chip in CHIPS.into_iter().filter(|chip| !chip.unfused) {
        for (name, Compiled { assembly, .. }) in compiled(&manifest, chip, &jobs).1 {
            let found = fused(&assembly).len();
            assert!(found >= 20, "{}, {name}: only {found} of its instructions are fused", chip.family);
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
    for chip in CHIPS.into_iter().filter(|chip| !chip.unfused) {
        let (_, results) = compiled(&manifest, chip, &jobs);
        assert_eq!(fused(&results["or"].assembly), Vec::<&str>::new(), "{}", chip.family);
        assert!(!fused(&results["xor"].assembly).is_empty(), "{}: the test shows nothing", chip.family);
    }
}

/// Prints the table by chip of `benches/README.md`.
#[test]
#[ignore = "prints a table"]
fn table() {
    let Some(manifest) = radv("table") else { return };
    let texts: Vec<_> =
        episodes().into_iter().filter(|(name, _)| !name.starts_with("strictly") && !name.ends_with("256")).collect();
    let generic = episodes().into_iter().filter(|(name, _)| name.starts_with("generally forward, generic"));
    let texts: Vec<_> = generic.chain(texts).collect();
    let mut rows: BTreeMap<(usize, String), Vec<String>> = BTreeMap::new();
    let mut versions = Vec::new();
    for pass in PASSES {
        let jobs: Vec<Job> = texts.iter().map(|(name, text)| (name.clone(), "episode", under(pass, text))).collect();
        for chip in CHIPS {
            let (version, results) = compiled(&manifest, chip, &jobs);
            versions.push(version);
            for (index, (name, _)) in texts.iter().enumerate() {
                let count = |what: &str| results[name].statistics[what];
                let cell = format!("{}, {}", count("VGPRs"), count("Instructions"));
                rows.entry((index, name.clone())).or_default().push(cell);
            }
        }
    }
    versions.dedup();
    println!("Vector registers and instructions, {}:\n", versions.join(", "));
    let heads = PASSES.iter().flat_map(|pass| CHIPS.iter().map(move |chip| format!("{}, {pass}", chip.family)));
    println!("| layout, kernel, threads | {} |", heads.collect::<Vec<_>>().join(" | "));
    println!("|---|{}", "---|".repeat(PASSES.len() * CHIPS.len()));
    for ((_, name), cells) in rows {
        println!("| {name} | {} |", cells.join(" | "));
    }
}
