//! Tests what NVIDIA's compiler makes of every specialised kernel, without an NVIDIA GPU.
//!
//! naga writes a kernel as Metal source, and a header turns that into CUDA for `nvcc`. Vulkan's driver contains the
//! same compiler with another front end. So registers and spills are estimates of what the driver will use.
//!
//! Without `nvcc` the tests are skipped with a message, or fail if `FLOTILLA_REQUIRE_NVCC=1`. `FLOTILLA_CUDA_INCLUDE`
//! names the directory of CUDA's headers if the compiler does not find it. `.ci/ports nvidia` installs both.
//!
//! With `--nocapture`, the findings are printed, for `docs/develop/evidence.md`.
//!
//! `cargo test nvidia::table -- --ignored --nocapture` prints the table of `benches/static-figures.md`.

use crate::support;
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;
use std::process::Command;

use flotilla::backend::gpu::episode::{Kernel, shader_of};
use flotilla::backend::gpu::exact::{self, Pass};
use naga::back::msl;
use naga::proc::{BoundsCheckPolicies, BoundsCheckPolicy};
use naga::valid::{Capabilities, ValidationFlags, Validator};

/// Turing, Ampere and Hopper.
const CHIPS: [&str; 3] = ["sm_75", "sm_86", "sm_90"];

/// Maximum bytes of local memory per thread. `ptxas` spills some registers if that lets another workgroup run on the same
/// processor.
const STACK: u64 = 40;

/// Defines Metal's types and functions in CUDA.
const HEADER: &str = "
#define INLINE __host__ __device__ __forceinline__ constexpr
namespace metal {
using uint = unsigned int;
template <class T> struct alignas(2 * sizeof(T)) pair {
  T x, y;
  pair() = default;
  INLINE pair(T x, T y) : x(x), y(y) {}
  INLINE explicit pair(T all) : x(all), y(all) {}
};
template <class T> struct triple { T x, y, z; };
template <class T> struct alignas(4 * sizeof(T)) four {
  T x, y, z, w;
  four() = default;
  INLINE four(T x, T y, T z, T w) : x(x), y(y), z(z), w(w) {}
  INLINE explicit four(T all) : x(all), y(all), z(all), w(all) {}
  INLINE T operator[](uint at) const { return at == 0 ? x : at == 1 ? y : at == 2 ? z : w; }
};
using float2 = pair<float>; using float4 = four<float>;
using uint2 = pair<uint>; using uint3 = triple<uint>; using uint4 = four<uint>;
using int2 = pair<int>; using int4 = four<int>; using bool4 = four<bool>;
#define COMPONENTS(op) \\
  template <class T> INLINE pair<T> operator op(pair<T> a, pair<T> b) { return {a.x op b.x, a.y op b.y}; } \\
  template <class T> INLINE four<T> operator op(four<T> a, four<T> b) { \\
    return {a.x op b.x, a.y op b.y, a.z op b.z, a.w op b.w}; } \\
  template <class T> INLINE pair<T> operator op(pair<T> a, T b) { return a op pair<T>(b); } \\
  template <class T> INLINE four<T> operator op(four<T> a, T b) { return a op four<T>(b); }
COMPONENTS(+) COMPONENTS(-) COMPONENTS(*) COMPONENTS(^) COMPONENTS(|) COMPONENTS(&) COMPONENTS(>>) COMPONENTS(<<)
template <class T> INLINE T select(T no, T yes, bool which) { return which ? yes : no; }
template <class T> INLINE four<T> select(four<T> no, four<T> yes, bool4 which) {
  return {which.x ? yes.x : no.x, which.y ? yes.y : no.y, which.z ? yes.z : no.z, which.w ? yes.w : no.w}; }
template <class T> INLINE T min(T a, T b) { return b < a ? b : a; }
template <class T> INLINE T max(T a, T b) { return a < b ? b : a; }
template <class T> INLINE T clamp(T x, T low, T high) { return min(max(x, low), high); }
__device__ inline float abs(float x) { return fabsf(x); }
__device__ inline float floor(float x) { return floorf(x); }
__device__ inline uint ctz(uint x) { return __clz(__brev(x)); }
enum class mem_flags { mem_device, mem_threadgroup };
__device__ inline void threadgroup_barrier(mem_flags) { __syncthreads(); }
}
template <class T, class U> __device__ inline T as_type(U from) {
  T to;
  static_assert(sizeof to == sizeof from);
  memcpy(&to, &from, sizeof to);
  return to;
}
using metal::uint;
";

/// Whether `nvcc` runs. If not, prints that the test is skipped.
fn has_nvcc(test: &str) -> bool {
    let runs = Command::new("nvcc").arg("--version").output().is_ok_and(|output| output.status.success());
    if !runs {
        let message = format!("{test}: skipped: there is no nvcc in the PATH");
        assert!(std::env::var("FLOTILLA_REQUIRE_NVCC").as_deref() != Ok("1"), "{message}, but it is required");
        writeln!(std::io::stderr(), "\n{message}").expect("standard error takes a line");
    }
    runs
}

/// Returns the compiler's version.
fn version() -> String {
    let output = Command::new("nvcc").arg("--version").output().expect("nvcc runs");
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let line = text.lines().find_map(|line| Some(line.split_once("release ")?.1.to_string()));
    format!("nvcc {}", line.unwrap_or_default())
}

/// Returns a shader as Metal source after a pass. Whether products and sums are fused is left to the compiler's flags.
fn metal(wgsl: &str, pass: Pass) -> String {
    let (module, _) = exact::parse(wgsl).unwrap_or_else(|error| panic!("{error}"));
    let module = match pass {
        Pass::Guarded => exact::guarded(&module).unwrap_or_else(|error| panic!("{error}")),
        Pass::NoContraction | Pass::Plain => module,
    };
    let info = Validator::new(ValidationFlags::all(), Capabilities::empty()).validate(&module).expect("a valid shader");
    let unchecked = BoundsCheckPolicy::Unchecked;
    let options = msl::Options {
        lang_version: (2, 4),
        fake_missing_bindings: true,
        bounds_check_policies: BoundsCheckPolicies {
            index: unchecked,
            buffer: unchecked,
            image_load: unchecked,
            binding_array: unchecked,
        },
        zero_initialize_workgroup_memory: false,
        force_loop_bounding: false,
        emit_int_div_checks: false,
        ..Default::default()
    };
    msl::write_string(&module, &info, &options, &Default::default()).expect("naga writes Metal").0
}

/// Translates a kernel from Metal source to CUDA.
fn cuda(metal: &str) -> String {
    let start = metal.find("struct _mslBufferSizes").expect("a struct after Metal's headers");
    let (functions, kernel) = metal[start..].split_once("[[max_total_threads_per_threadgroup(").expect("a kernel");
    let mut text = format!("{HEADER}namespace shader {{\n");
    let is_function = |line: &str| {
        let name = line.split_once('(').and_then(|(head, _)| head.split_once(' '));
        name.is_some_and(|(kind, name)| {
            let word = |text: &str| text.chars().all(|letter| letter.is_alphanumeric() || "_:".contains(letter));
            word(kind) && word(name)
        })
    };
    for line in functions.lines() {
        if let Some(constant) = line.strip_prefix("constant ") {
            writeln!(text, "static constexpr {constant}").expect("memory");
        } else if line.starts_with("typedef") && line.ends_with("[1];") {
            // An array whose length is known only at run time.
            writeln!(text, "{}[1 << 20];", line.trim_end_matches("[1];")).expect("memory");
        } else if is_function(line) {
            writeln!(text, "static __device__ __forceinline__ {line}").expect("memory");
        } else {
            writeln!(text, "{line}").expect("memory");
        }
    }
    let (threads, kernel) = kernel.split_once(")]] kernel void ").expect("the number of threads");
    let (name, kernel) = kernel.split_once("(\n").expect("a parameter list");
    let (parameters, body) = kernel.split_once("\n) {\n").expect("a function body");
    let (mut arguments, mut declared) = (Vec::new(), String::new());
    for parameter in parameters.split('\n').map(|line| line.trim_start_matches(", ").trim()) {
        let (parameter, attribute) = parameter.split_once(" [[").unwrap_or((parameter, ""));
        let (kind, name) = parameter.rsplit_once(' ').expect("a type and a name");
        let built_in = |index: &str| format!("{kind} {name} = {{{index}.x, {index}.y, {index}.z}};");
        let line = match attribute {
            "threadgroup_position_in_grid]]" => built_in("blockIdx"),
            "threadgroups_per_grid]]" => built_in("gridDim"),
            "thread_position_in_grid]]" => {
                format!("{kind} {name} = {{blockIdx.x * {threads} + threadIdx.x, blockIdx.y, blockIdx.z}};")
            }
            "thread_index_in_threadgroup]]" => format!("{kind} {name} = threadIdx.x;"),
            _ if kind.starts_with("threadgroup ") => format!("__shared__ {} {name};", kind.trim_end_matches('&')),
            _ if kind.contains("_mslBufferSizes") => format!("const _mslBufferSizes {name}{{}};"),
            _ => {
                let kind = kind.trim_end_matches('&');
                arguments.push(format!("{kind}* __restrict__ {name}_at"));
                format!("{kind}& {name} = *{name}_at;")
            }
        };
        writeln!(declared, "    {line}").expect("memory");
    }
    let arguments = arguments.join(", ");
    write!(
        text,
        "extern \"C\" __global__ void __launch_bounds__({threads}) {name}({arguments}) {{\n{declared}{body}\n}}\n"
    )
    .expect("memory");
    // CUDA infers address spaces, so their names are removed. Without a suffix `f`, a literal would be a double.
    let mut lines = String::new();
    for line in text.lines() {
        let line = ["device ", "threadgroup ", "thread "].iter().fold(line.to_string(), |line, space| {
            line.split(space).fold(String::new(), |line, part| {
                match line.ends_with(|letter: char| letter.is_alphanumeric() || letter == '_') {
                    false => line + part,
                    true => line + space + part,
                }
            })
        });
        lines += &with_float_literals(&line.replace("constant ", "const "));
        lines.push('\n');
    }
    lines
}

/// Appends `f` to every literal with a decimal point.
fn with_float_literals(line: &str) -> String {
    let mut out = String::new();
    let mut rest = line;
    while let Some(at) = rest.find(|letter: char| letter.is_ascii_digit()) {
        let name = rest[..at].ends_with(|letter: char| letter.is_alphanumeric() || letter == '_' || letter == '.');
        let mut length = 0;
        for (index, letter) in rest[at..].char_indices() {
            let exponent = rest[at..][..index].ends_with('e') && matches!(letter, '-' | '+');
            if !(letter.is_alphanumeric() || letter == '.' || exponent) {
                break;
            }
            length = index + 1;
        }
        let literal = &rest[at..at + length];
        let float = !name && literal.contains('.') && !literal.ends_with('f');
        out += &rest[..at + length];
        out += if float { "f" } else { "" };
        rest = &rest[at + length..];
    }
    out + rest
}

/// The result of compiling a kernel.
struct Compiled {
    registers: u64,
    /// Bytes of local memory.
    stack: u64,
    /// Bytes that spills write and read.
    spilled: u64,
    assembly: String,
}

/// Compiles a shader for a chip. `fuse` lets the compiler fuse products into sums.
fn compile(wgsl: &str, pass: Pass, chip: &str, fuse: bool) -> Compiled {
    let folder = tempfile::tempdir().expect("a folder for the kernel");
    let (source, binary) = (folder.path().join("kernel.cu"), folder.path().join("kernel.cubin"));
    std::fs::write(&source, cuda(&metal(wgsl, pass))).expect("the directory is writable");
    let mut nvcc = Command::new("nvcc");
    nvcc.args(["-cubin", "-std=c++17", "-ftz=true", "--expt-relaxed-constexpr", "-w", "-Xptxas", "-v", "-arch", chip])
        .arg(format!("-fmad={fuse}"))
        .args(std::env::var("FLOTILLA_CUDA_INCLUDE").map(|folder| format!("-I{folder}")))
        .args([source.as_path(), Path::new("-o"), &binary]);
    let output = nvcc.output().expect("nvcc runs");
    let output_text = [output.stderr, output.stdout].map(|text| String::from_utf8_lossy(&text).into_owned()).concat();
    assert!(output.status.success(), "nvcc does not compile this shader: {output_text}");
    let number = |label: &str| {
        let text = output_text.split_once(label).unwrap_or_else(|| panic!("no '{label}' in: {output_text}")).0;
        let digits = text.rsplit(|letter: char| !letter.is_ascii_digit()).find(|digits| !digits.is_empty());
        digits.expect("a number before the label").parse::<u64>().expect("a number")
    };
    let assembly = Command::new("nvdisasm").arg(&binary).output().expect("nvdisasm comes with nvcc");
    Compiled {
        registers: number(" registers"),
        stack: number(" bytes stack frame"),
        spilled: number(" bytes spill stores") + number(" bytes spill loads"),
        assembly: String::from_utf8_lossy(&assembly.stdout).into_owned(),
    }
}

fn count(assembly: &str, instruction: &str) -> usize {
    assembly
        .lines()
        .filter(|line| line.split_whitespace().any(|word| word.split('.').next() == Some(instruction)))
        .count()
}

/// Returns the specialised kernels of the paper's layouts, for workgroups of up to 256 and 1024 threads.
fn episodes() -> Vec<(String, String)> {
    let shaders = support::papers_worlds().into_iter().flat_map(|(name, world)| {
        [256, 1024].map(|threads| (format!("{name}, {threads}"), shader_of(&world, Kernel::Specialised, threads)))
    });
    shaders.collect()
}

#[test]
fn guards_prevent_fusing_and_registers_rarely_spill() {
    if !has_nvcc("guards_prevent_fusing_and_registers_rarely_spill") {
        return;
    }
    println!("{}, of naga's Metal text made CUDA", version());
    for pass in [Pass::NoContraction, Pass::Guarded] {
        for chip in CHIPS {
            let (mut max_registers, mut shaders) = (0, 0);
            for (name, text) in episodes() {
                // Vulkan's no-contraction decoration is a flag of nvcc, so only the guarded pass is tested with fusing.
                let kernel = compile(&text, pass, chip, pass == Pass::Guarded);
                let case = format!("{chip} under the {pass} pass, {name}");
                assert!(count(&kernel.assembly, "FMUL") > 50, "{case}: this is not assembly: {}", kernel.assembly);
                assert!(pass != Pass::Guarded || count(&kernel.assembly, "FFMA") == 0, "{case}: fused");
                assert!(kernel.stack <= STACK, "{case}: {} bytes of local memory", kernel.stack);
                assert!(kernel.stack <= kernel.spilled, "{case}: an array is in local memory");
                (max_registers, shaders) = (max_registers.max(kernel.registers), shaders + 1);
            }
            // Under the no-contraction pass nvcc must not fuse, so its result says nothing about the pass.
            let fused_note = if pass == Pass::Guarded { "none fused though nvcc may, " } else { "" };
            println!("{chip}, {pass} pass: {shaders} shaders, {fused_note}at most {max_registers} registers");
        }
    }
}

/// A canary: without a pass, the compiler fuses, and the test above can detect it.
#[test]
fn without_a_pass_the_compiler_fuses() {
    if !has_nvcc("without_a_pass_the_compiler_fuses") {
        return;
    }
    let (name, text) = episodes().swap_remove(0);
    let fused = count(&compile(&text, Pass::Plain, CHIPS[2], true).assembly, "FFMA");
    assert!(fused > 50, "{name}: only {fused} fused instructions");
}

/// Prints the table by chip for `benches/static-figures.md`.
#[test]
#[ignore = "prints a table"]
fn table() {
    if !has_nvcc("table") {
        return;
    }
    println!("{}\n", version());
    let passes = [Pass::NoContraction, Pass::Guarded];
    let heads = passes.iter().flat_map(|pass| CHIPS.iter().map(move |chip| format!("{chip}, {pass}")));
    println!("| layout, threads | {} |", heads.collect::<Vec<_>>().join(" | "));
    println!("|---|{}", "---|".repeat(passes.len() * CHIPS.len()));
    for (name, text) in episodes() {
        let cells = passes.iter().flat_map(|&pass| CHIPS.iter().map(move |chip| (pass, *chip))).map(|(pass, chip)| {
            let Compiled { registers, stack, spilled, .. } = compile(&text, pass, chip, pass == Pass::Guarded);
            format!("{registers}, {stack}, {spilled}")
        });
        println!("| {name} | {} |", cells.collect::<Vec<_>>().join(" | "));
    }
}
