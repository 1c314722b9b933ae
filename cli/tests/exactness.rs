//! Tests that shaders use only exact operations, that the compile passes cover all arithmetic, and that devices are
//! exact.

#![expect(unsafe_code, reason = "test shaders are compiled without bounds checks")]

use crate::support;
use std::path::{Path, PathBuf};

use flotilla::backend::gpu::device::{self, AdapterChoice, AdapterInfo, DeviceError, Kind, Request};
use flotilla::backend::gpu::episode::{self, Kernel};
use flotilla::backend::gpu::exact::{self, Pass, ShaderError};
use flotilla::backend::gpu::source::Binding;
use flotilla::backend::gpu::{self, shaders};
use naga::back::{hlsl, msl};
use naga::proc::{BoundsCheckPolicies, BoundsCheckPolicy};
use naga::valid::{Capabilities, FunctionInfo, ValidationFlags, Validator};
use naga::{BinaryOperator, Expression, Function, Module, ScalarKind};
use wgpu::BufferUsages;

const BOTH: [Pass; 2] = [Pass::NoContraction, Pass::Guarded];
/// The only shader without floats.
const INTEGERS: &str = "count";

/// Returns a shader that computes one expression of the floats x, y, the vectors v, u, the matrix values.m and the
/// integers i, j.
fn shader(expression: &str) -> String {
    format!(
        "struct Values {{ m: mat2x2<f32>, x: f32, y: f32, i: i32, j: u32, v: vec2<f32>, u: vec2<f32> }}
        @group(0) @binding(1) var<storage, read> values: Values;
        @group(0) @binding(2) var<storage, read_write> word: atomic<u32>;
        @compute @workgroup_size(1) fn main() {{
            let x = values.x; let y = values.y; let i = values.i; let j = values.j; let v = values.v; let u = values.u;
            let result = {expression};
            atomicStore(&word, u32(result));
        }}"
    )
}

/// Returns the inexact operations that the lint finds in an expression.
fn inexact(expression: &str) -> Vec<String> {
    let (module, _) = exact::parse(&shader(expression)).unwrap_or_else(|error| panic!("{expression}: {error}"));
    exact::inexact_operations(&module)
}

/// Returns all files below a folder.
fn files(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).expect("a readable folder");
    let paths = entries.map(|entry| entry.expect("a readable entry").path());
    paths.flat_map(|path| if path.is_dir() { files(&path) } else { vec![path] }).collect()
}

#[test]
fn every_shader_file_is_part_of_a_tested_shader() {
    let texts = shaders();
    for path in files(&Path::new(crate::ROOT).join("shaders")) {
        let file = std::fs::read_to_string(&path).expect("a text file");
        assert!(texts.iter().any(|(_, text)| text.contains(file.trim())), "{} is in no shader", path.display());
    }
}

#[test]
fn shaders_use_only_core_operations() {
    for (name, text) in shaders() {
        let (module, _) = exact::parse(&text).unwrap_or_else(|error| panic!("{name} {error}"));
        assert_eq!(exact::inexact_operations(&module), Vec::<String>::new(), "{name}");
    }
}

#[test]
fn the_lint_accepts_core_operations() {
    for expression in [
        "x + y * x - 2.0",
        "-x",
        "abs(x)",
        "floor(y)",
        "select(x, y, x <= y)",
        "(v * u + x * v).y",
        "(vec2(x, y) - u.yx).x",
        "bitcast<f32>(bitcast<u32>(x) ^ 5u)",
        "f32(i) + f32(j)",
        "i32(x) / 3 % i",
        "j / 3u + j % 7u + (j << 2u)",
        "min(j, 4u) + bitcast<u32>(clamp(i, 2, 5)) + max(j, 1u)",
        "countOneBits(j) + firstTrailingBit(j) + firstLeadingBit(j) + reverseBits(j) + u32(abs(i))",
        "select(0u, 1u, any(v < u) || all(v == u))",
        "atomicAdd(&word, 1u) + atomicLoad(&word)",
    ] {
        assert_eq!(inexact(expression), Vec::<String>::new(), "{expression}");
    }
}

#[test]
fn the_lint_names_inexact_operations() {
    for (expression, name) in [
        ("x / y", "Divide"),
        ("x % y", "Modulo"),
        ("(v / u).x", "Divide"),
        ("(v / 2.0).x", "Divide"),
        ("min(x, y)", "Min"),
        ("max(v, u).x", "Max"),
        ("clamp(x, 0.0, y)", "Clamp"),
        ("saturate(x)", "Saturate"),
        ("sign(x)", "Sign"),
        ("sqrt(x)", "Sqrt"),
        ("inverseSqrt(x)", "InverseSqrt"),
        ("exp(x)", "Exp"),
        ("log2(x)", "Log2"),
        ("pow(x, y)", "Pow"),
        ("sin(x)", "Sin"),
        ("atan2(x, y)", "Atan2"),
        ("tanh(x)", "Tanh"),
        ("ceil(x)", "Ceil"),
        ("round(x)", "Round"),
        ("trunc(x)", "Trunc"),
        ("fract(x)", "Fract"),
        ("fma(x, y, x)", "Fma"),
        ("mix(x, y, 0.5)", "Mix"),
        ("step(x, y)", "Step"),
        ("smoothstep(x, y, 0.5)", "SmoothStep"),
        ("dot(v, u)", "Dot"),
        ("length(v)", "Length"),
        ("distance(v, u)", "Distance"),
        ("normalize(v).x", "Normalize"),
        ("reflect(v, u).x", "Reflect"),
        ("ldexp(x, i)", "Ldexp"),
        ("unpack2x16snorm(j).x", "Unpack2x16snorm"),
        ("(values.m * v).x", "Matrix"),
    ] {
        let reported = inexact(expression);
        assert!(
            reported.iter().any(|line| line.starts_with("main: ") && line.contains(name)),
            "{expression}: {reported:?}"
        );
    }
}

/// DX12 without `dxcompiler.dll` compiles by FXC, which refuses such stores.
#[test]
fn a_store_to_a_variable_component_of_a_vector_is_found() {
    let found = |store: &str| {
        let text = format!(
            "@group(0) @binding(1) var<storage, read_write> places: array<i32>;
            @compute @workgroup_size(1) fn main() {{
                var v = vec4(0); var all: array<i32, 4>; let i = places[0]; {store} places[1] = v.x + all[i];
            }}"
        );
        exact::inexact_operations(&exact::parse(&text).unwrap().0)
    };
    for store in ["v[2] = i;", "v.y = i;", "all[i] = v[i];"] {
        assert_eq!(found(store), Vec::<String>::new(), "{store}");
    }
    assert!(matches!(&found("v[i] = 1;")[..], [line] if line.starts_with("main: Store")), "{:?}", found("v[i] = 1;"));
}

#[test]
fn an_inexact_operation_inside_a_function_and_a_loop_is_found() {
    let text = "fn deep(x: f32) -> f32 { var y = x; loop { if y > 9.0 { break; } y = y + 1.0 / x; } return y; }
        @group(0) @binding(1) var<storage, read_write> value: f32;
        @compute @workgroup_size(1) fn main() { value = deep(value); }";
    let (module, _) = exact::parse(text).expect("valid WGSL");
    assert_eq!(exact::inexact_operations(&module), ["deep: float Divide"]);
}

/// Tests that src/ does not call the platform's math library. Its rounding differs between platforms, which would
/// change results and pictures.
#[test]
fn no_source_calls_the_platforms_math_functions() {
    const PLATFORM: [&str; 26] = [
        "sin", "cos", "tan", "sin_cos", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "asinh", "acosh",
        "atanh", "exp", "exp2", "exp_m1", "ln", "ln_1p", "log", "log2", "log10", "powf", "powi", "cbrt", "hypot",
    ];
    let code = files(&crate::support::root("src"))
        .into_iter()
        .filter(|path| path.extension().is_some_and(|ending| ending == "rs"));
    let code: Vec<PathBuf> = code.collect();
    assert!(code.len() > 50, "only {code:?} were read");
    for path in code {
        let text = std::fs::read_to_string(&path).unwrap();
        for name in PLATFORM {
            for call in [format!(".{name}("), format!("f32::{name}("), format!("f64::{name}(")] {
                assert!(
                    !text.contains(&call),
                    "{}: {call}…) calls the platform's function; use libm's",
                    path.display()
                );
            }
        }
    }
}

#[test]
fn every_float_result_is_decorated() {
    for (name, text) in shaders() {
        let (module, info) = exact::parse(&text).expect("shaders are valid");
        for checked in [false, true] {
            let plain = exact::emit(&module, &info, checked).expect("shaders compile to SPIR-V");
            let exact = exact::decorate(&plain);
            let has_undecorated = exact::undecorated(&plain) > 0 || name == INTEGERS;
            assert!(has_undecorated, "{name}: naga already decorates everything, so this test cannot fail");
            assert_eq!(exact::undecorated(&exact), 0, "{name}");
            assert_eq!(
                exact.len(),
                plain.len() + 3 * exact::undecorated(&plain),
                "{name}: the pass changed more than decorations"
            );
        }
    }
}

#[test]
fn every_kind_of_float_arithmetic_is_decorated() {
    for expression in ["x + y", "x - y", "x * y", "-x", "x / y", "x % y", "(v * x).x", "dot(v, u)", "fma(x, y, x)"] {
        let (module, info) = exact::parse(&shader(expression)).expect("a valid module");
        let plain = exact::emit(&module, &info, false).expect("the shader compiles to SPIR-V");
        assert!(exact::undecorated(&plain) > 0, "{expression}");
        assert_eq!(exact::undecorated(&exact::decorate(&plain)), 0, "{expression}");
    }
}

#[test]
fn every_sum_and_product_is_guarded() {
    for (name, text) in shaders() {
        let (module, _) = exact::parse(&text).expect("shaders are valid");
        assert!(exact::unguarded(&module).expect("shaders are valid") > 0 || name == INTEGERS, "{name}");
        let guarded = exact::guarded(&module).unwrap_or_else(|error| panic!("{name} {error}"));
        assert_eq!(exact::unguarded(&guarded).expect("guarded shaders are valid"), 0, "{name}");
    }
}

/// Tests which results need no guard: only those whose bits are compared as integers. Any other use may pass the result
/// to a float operation, or let a compiler treat it as one.
#[test]
fn only_results_compared_as_integers_need_no_guard() {
    let count_guards = |statement: &str| {
        let text = format!(
            "@group(0) @binding(1) var<storage, read_write> values: array<f32, 4>;
            fn write_flag(value: bool) {{ values[3] = select(0.0, 1.0, value); }}
            fn use_it(x: f32) -> bool {{ return bitcast<i32>(x) < 7; }}
            @compute @workgroup_size(1) fn main() {{
                let a = values[0]; let b = values[1]; let c = values[2]; var kept = 0.0; {statement}
            }}"
        );
        let (module, _) = exact::parse(&text).unwrap_or_else(|error| panic!("{statement}: {error}"));
        let guarded = exact::guarded(&module).unwrap_or_else(|error| panic!("{statement}: {error}"));
        assert_eq!(exact::unguarded(&guarded).expect("a valid module"), 0, "{statement}");
        let is_or = |e: &Expression| matches!(e, Expression::Binary { op: BinaryOperator::InclusiveOr, .. });
        let count_ors = |module: &Module| {
            module.entry_points[0].function.expressions.iter().filter(|(_, expression)| is_or(expression)).count()
        };
        (count_ors(&guarded) - count_ors(&module), exact::unguarded(&module).expect("a valid module"))
    };
    for (statement, expected) in [
        ("write_flag(bitcast<i32>(a + b) <= bitcast<i32>(c));", 0),
        ("write_flag(bitcast<u32>(a * b) == 9u);", 0),
        ("let d = a + b; write_flag(bitcast<i32>(d) < 1 || bitcast<i32>(d) > 8);", 0),
        // Results that the compared one is computed from are guarded.
        ("write_flag(bitcast<i32>(a * a + b * b) <= bitcast<i32>(c));", 2),
        ("write_flag(bitcast<i32>((a + b) + c) <= 5);", 1),
        // The result has other uses.
        ("write_flag(a + b <= c);", 1),
        ("values[0] = floor(a + b);", 1),
        ("values[0] = a + b;", 1),
        ("kept = a + b;", 1),
        ("write_flag(use_it(a + b));", 1),
        ("let d = a + b; write_flag(bitcast<i32>(d) <= 3); values[0] = d;", 1),
        ("let d = a + b; write_flag(bitcast<i32>(d) <= 3); write_flag(d < c);", 1),
        ("write_flag(u32(a + b) < 3u);", 1),
        ("write_flag(bitcast<i32>(abs(a + b)) <= 3);", 1),
        ("write_flag(bitcast<i32>(-(a + b)) <= 3);", 1),
        ("write_flag((bitcast<u32>(a + b) & 7u) < 3u);", 1),
        ("write_flag((bitcast<u32>(a + b) | 1u) < 3u);", 1),
        ("write_flag((bitcast<u32>(a + b) ^ bitcast<u32>(a - b)) == 0u);", 2),
        ("values[0] = bitcast<f32>(bitcast<u32>(a + b));", 1),
        ("write_flag(bitcast<i32>(select(a + b, c, a < b)) < 3);", 1),
    ] {
        assert_eq!(count_guards(statement), (expected, expected), "{statement}");
    }
}

/// Returns every shader, and the specialised episode kernels of the paper's six experiments.
fn kernels() -> Vec<(String, String)> {
    let specialised = support::papers_worlds().into_iter().flat_map(|(name, world)| {
        [64, 256, 1024].map(|threads| {
            let text = episode::shader_of(&world, Kernel::Specialised, threads);
            (format!("{name}, {threads} threads"), text)
        })
    });
    shaders().into_iter().map(|(name, text)| (name.to_string(), text)).chain(specialised).collect()
}

/// Returns the number of used float sums, differences and products of a module.
fn rounding_operations(module: &Module) -> usize {
    let info = Validator::new(ValidationFlags::all(), Capabilities::empty()).validate(module).expect("a valid module");
    let floats = |function: &Function, info: &FunctionInfo| {
        let rounds = function.expressions.iter().filter(|(handle, expression)| {
            let float = info[*handle].ty.inner_with(&module.types).scalar_kind() == Some(ScalarKind::Float);
            let op = match expression {
                Expression::Binary { op, .. } => *op,
                _ => return false,
            };
            float && matches!(op, BinaryOperator::Add | BinaryOperator::Subtract | BinaryOperator::Multiply)
        });
        rounds.filter(|(handle, _)| info[*handle].ref_count > 0).count()
    };
    let functions = module.functions.iter().map(|(handle, function)| floats(function, &info[handle]));
    let entries = module.entry_points.iter().enumerate();
    functions.chain(entries.map(|(at, entry)| floats(&entry.function, info.get_entry_point(at)))).sum()
}

/// Counts the sums, differences and products in a text that are inside one of `casts` and are followed by ` | `.
fn guarded_operations(text: &str, casts: &[&str]) -> usize {
    let is_guarded = |inside: &str| {
        let (mut depth, mut operator) = (0, false);
        for (at, letter) in inside.char_indices() {
            let (before, after) = (&inside[..at], &inside[at + letter.len_utf8()..]);
            match letter {
                '(' | '[' => depth += 1,
                ')' if depth == 0 => return operator && after.trim_start_matches(')').starts_with(" | "),
                ')' | ']' => depth -= 1,
                '+' | '-' | '*' => operator |= depth == 0 && before.ends_with(' ') && after.starts_with(' '),
                _ => {}
            }
        }
        false
    };
    let positions = casts.iter().flat_map(|cast| text.match_indices(cast));
    positions.filter(|(at, cast)| is_guarded(&text[at + cast.len()..])).count()
}

/// Counts the guards in the text for Metal and DirectX, with several options. By default, Metal's compiler may fuse and
/// reorder operations. So every sum and product needs a guard, except the few that are compared by their bits.
#[test]
fn every_sum_and_product_is_guarded_in_metal_and_directx_text() {
    for (name, text) in kernels() {
        let (module, _) = exact::parse(&text).unwrap_or_else(|error| panic!("{name} {error}"));
        let guarded = exact::guarded(&module).unwrap_or_else(|error| panic!("{name} {error}"));
        let info =
            Validator::new(ValidationFlags::all(), Capabilities::empty()).validate(&guarded).expect("a valid module");
        // Results that are compared by their bits: one in `within`, and two in the probe.
        let count_exempt = |function: &Function| usize::from(function.name.as_deref() == Some("within"));
        let exempt: usize = guarded.functions.iter().map(|(_, function)| count_exempt(function)).sum();
        let expected = rounding_operations(&guarded) - exempt - if name == "probe" { 2 } else { 0 };
        assert!(expected > 0 || name == INTEGERS, "{name}: nothing to guard");
        let policy = |checked| match checked {
            true => BoundsCheckPolicy::Restrict,
            false => BoundsCheckPolicy::Unchecked,
        };
        for (lang_version, checked) in [((2, 0), false), ((2, 0), true), ((3, 2), false)] {
            let policy = policy(checked);
            let options = msl::Options {
                lang_version,
                bounds_check_policies: BoundsCheckPolicies {
                    index: policy,
                    buffer: policy,
                    image_load: policy,
                    binding_array: policy,
                },
                zero_initialize_workgroup_memory: checked,
                force_loop_bounding: checked,
                emit_int_div_checks: checked,
                ..Default::default()
            };
            let (metal, _) =
                msl::write_string(&guarded, &info, &options, &Default::default()).expect("it has Metal text");
            check_text(
                &format!("{name}, Metal {lang_version:?}"),
                &metal,
                expected,
                &["as_type<uint>(", "as_type<metal::uint2>(", "as_type<metal::uint3>(", "as_type<metal::uint4>("],
            );
        }
        let mut directx = String::new();
        let (options, pipeline) = (hlsl::Options::default(), hlsl::PipelineOptions::default());
        let written = hlsl::Writer::new(&mut directx, &options, &pipeline).write(&guarded, &info, None);
        written.unwrap_or_else(|error| panic!("{name}: {error}"));
        check_text(&format!("{name}, DirectX"), &directx, expected, &["asuint(("]);
        // Without the pass, no operation may count as guarded. Otherwise this test could not fail.
        let info =
            Validator::new(ValidationFlags::all(), Capabilities::empty()).validate(&module).expect("a valid module");
        let (plain, _) =
            msl::write_string(&module, &info, &Default::default(), &Default::default()).expect("it has text");
        assert_eq!(guarded_operations(&plain, &["as_type<uint>("]), 0, "{name}");
    }
}

fn check_text(name: &str, text: &str, expected: usize, casts: &[&str]) {
    assert_eq!(guarded_operations(text, casts), expected, "{name}: number of guarded operations in\n{text}");
    for forbidden in ["fma(", "mad(", "fast::", "dot(", "mix(", "lerp(", "#pragma"] {
        assert!(!text.contains(forbidden), "{name} contains {forbidden}");
    }
}

/// Tests the passes with statements and expressions of the core that the probes do not use.
#[test]
fn all_core_statements_can_be_guarded() {
    let text = "struct Agent { place: vec2<f32>, speed: f32, seen: array<u32, 3> }
        @group(0) @binding(1) var<storage, read_write> agents: array<Agent>;
        @group(0) @binding(2) var<storage, read_write> counts: array<atomic<u32>>;
        @group(0) @binding(3) var<uniform> gains: vec4<f32>;
        const table = array<f32, 3>(0.5, 0.25, 0.125);
        var<private> calls: u32 = 2u;
        var<workgroup> shared_places: array<vec2<f32>, 64>;
        var<workgroup> flags: atomic<u32>;
        var<workgroup> total: u32;
        fn advance(place: ptr<function, vec2<f32>>, by: f32) { *place = *place + vec2(by * 2.0, by); calls += 1u; }
        fn gain(kind: u32, x: f32) -> f32 {
            switch kind {
                case 0u, 1u: { return x * gains.x + gains.y; }
                case 2u: { if x * x > 4.0 { break; } return x - 1.0; }
                default: { return -x * 3.0; }
            }
            return x + x;
        }
        @compute @workgroup_size(64) fn main(
            @builtin(local_invocation_index) lane: u32, @builtin(workgroup_id) group: vec3<u32>
        ) {
            var agent = agents[group.x * 64u + lane];
            var place = agent.place;
            advance(&place, agent.speed * gains[lane % 4u]);
            shared_places[lane] = place * 0.5;
            if lane == 0u { atomicStore(&flags, 0u); total = 7u; }
            workgroupBarrier();
            let limit = workgroupUniformLoad(&total);
            var sum = vec3<f32>();
            var other = 0u;
            loop {
                if other >= limit { break; }
                let offset = shared_places[other] - place;
                if all(offset == vec2(0.0)) { other += 1u; continue; }
                sum += vec3(offset, offset.x * offset.y) * table[other % 3u];
                continuing { other += 1u; break if sum.z > 1e6; }
            }
            let swapped = atomicCompareExchangeWeak(&counts[lane], 0u, u32(gain(lane & 3u, sum.x)));
            if !swapped.exchanged { atomicOr(&flags, 1u << (lane & 31u)); }
            agent.place = place - sum.xy * f32(atomicLoad(&flags));
            agent.speed *= sum[lane % 3u];
            agent.seen[lane % 3u] += calls;
            agents[group.x * 64u + lane] = agent;
        }";
    let (module, _) = exact::parse(text).unwrap_or_else(|error| panic!("{error}"));
    assert_eq!(exact::inexact_operations(&module), Vec::<String>::new());
    let guarded = exact::guarded(&module).unwrap_or_else(|error| panic!("{error}"));
    assert!(exact::unguarded(&module).expect("a valid module") > 10);
    assert_eq!(exact::unguarded(&guarded).expect("a valid module"), 0);
    for (request, _) in support::adapters("all_core_statements_can_be_guarded") {
        for (pass, checked) in [(BOTH[0], false), (BOTH[0], true), (BOTH[1], false), (BOTH[1], true)] {
            let gpu = match gpu::open(Request { pass: Some(pass), checked, ..request.clone() }) {
                Err(DeviceError::Refused { .. }) if pass == Pass::NoContraction => continue,
                opened => opened.unwrap_or_else(|error| panic!("{error}")),
            };
            let bindings = [Binding::Write, Binding::Write, Binding::Uniform];
            // SAFETY: the shader is compiled, but never run.
            let compiled = unsafe { gpu.pipeline("core", text, "main", &bindings) };
            compiled.unwrap_or_else(|error| panic!("{error}"));
        }
    }
}

#[test]
fn shaders_that_cannot_be_exact_are_refused() {
    let (module, _) = exact::parse(&shader("x / y")).expect("a valid module");
    assert!(matches!(exact::guarded(&module), Err(ShaderError::Inexact(_))));
    let (module, _) = exact::parse(&shader("x * y").replace("binding(1)", "binding(0)")).expect("a valid module");
    assert!(matches!(exact::guarded(&module), Err(ShaderError::GuardTaken)));
    let error = exact::parse(&shader("x * nothing")).expect_err("an unknown name").to_string();
    assert!(error.contains("x * nothing"), "{error}");
    assert!(matches!(exact::parse(&shader("x * i")), Err(ShaderError::Invalid(_))));
}

#[test]
fn devices_are_exact_under_both_passes() {
    for (request, info) in support::adapters("devices_are_exact_under_both_passes") {
        for pass in BOTH {
            for checked in [false, true] {
                match gpu::open(Request { pass: Some(pass), checked, ..request.clone() }) {
                    Ok(gpu) => assert_eq!((gpu.pass, gpu.checked), (pass, checked)),
                    Err(DeviceError::Refused { .. }) if pass == Pass::NoContraction && info.backend != "vulkan" => {}
                    Err(error) => panic!("{error}"),
                }
            }
        }
        let gpu = gpu::open(request).unwrap_or_else(|error| panic!("{error}"));
        assert_eq!(gpu.pass == Pass::NoContraction, info.backend == "vulkan", "{info}: expected the cheaper pass");
    }
}

/// Tests that the probes can fail: they must detect devices that are known to be inexact without a pass.
#[test]
fn the_probes_catch_a_device_without_a_pass() {
    for (request, info) in support::adapters("the_probes_catch_a_device_without_a_pass") {
        let gpu = gpu::open(Request { pass: Some(Pass::Plain), ..request }).unwrap_or_else(|error| panic!("{error}"));
        let mismatch = gpu::self_test(&gpu).unwrap_or_else(|error| panic!("{error}"));
        if ["llvmpipe", "SwiftShader"].iter().any(|known| info.name.contains(known)) {
            assert!(mismatch.is_some(), "{info} reassociates, but no probe detects it");
        }
    }
}

#[test]
fn webgpus_default_limits_are_enough() {
    for (request, _) in support::adapters("webgpus_default_limits_are_enough") {
        let gpu = gpu::open(Request { default_limits: true, ..request }).unwrap_or_else(|error| panic!("{error}"));
        assert_eq!(gpu.limits, wgpu::Limits::defaults());
        let error =
            gpu.buffer("the weights", (128 << 20) + 4, BufferUsages::STORAGE).expect_err("a buffer over 128 MiB");
        assert!(matches!(error, DeviceError::TooLarge { allowed, .. } if allowed == 128 << 20), "{error}");
        let message = error.to_string();
        assert!(message.contains("the weights") && message.contains("smaller batch"), "{message}");
    }
}

#[test]
fn a_shader_over_the_devices_limits_is_refused() {
    for (request, _) in support::adapters("a_shader_over_the_devices_limits_is_refused") {
        for pass in BOTH {
            let request = Request { default_limits: true, pass: Some(pass), ..request.clone() };
            let gpu = match gpu::open(request) {
                Err(DeviceError::Refused { .. }) if pass == Pass::NoContraction => continue,
                opened => opened.unwrap_or_else(|error| panic!("{error}")),
            };
            let wide = "@compute @workgroup_size(257) fn main() {}";
            let heavy = "var<workgroup> much: array<u32, 4097>;
                @compute @workgroup_size(1) fn main() { much[0] = 1u; }";
            for (text, named) in [(wide, "257"), (heavy, "16388")] {
                // SAFETY: the shader should be refused, and is never run.
                let compiled = unsafe { gpu.pipeline("test", text, "main", &[]) };
                let error = compiled.expect_err("a shader over the limits").to_string();
                assert!(error.contains(named), "{error}");
            }
        }
    }
}

#[test]
fn the_error_about_an_unknown_adapter_lists_all_adapters() {
    let error = gpu::open(AdapterChoice::Named("no such adapter".into())).expect_err("there is no such adapter");
    let message = flotilla_cli::Error::from(error).to_string();
    assert!(message.contains("no such adapter") && message.contains("--backend cpu") || !device::adapters().is_empty());
    for info in device::adapters() {
        assert!(message.contains(&info.name), "{message}");
    }
    for (request, info) in support::adapters("the_error_about_an_unknown_adapter_lists_all_adapters") {
        let by_name = AdapterChoice::Named(info.name.to_uppercase());
        let gpu = gpu::open(Request { adapter: by_name, ..request }).unwrap_or_else(|error| panic!("{error}"));
        assert_eq!(gpu.adapter.name, info.name);
    }
}

/// Returns two adapters with digits in their names.
fn two_adapters() -> Vec<AdapterInfo> {
    let adapter = |name: &str, kind| AdapterInfo {
        name: name.into(),
        driver: "Mesa 22.3.6".into(),
        backend: "vulkan".into(),
        kind,
        index: 0,
        pci: String::new(),
    };
    vec![adapter("GeForce RTX 4090", Kind::Discrete), adapter("llvmpipe (LLVM 15.0.6, 256 bits)", Kind::Software)]
}

#[test]
fn adapters_are_found_by_index_or_by_part_of_the_name() {
    let find = |name: &str| device::position(&AdapterChoice::Named(name.into()), &two_adapters());
    for (name, index) in [("0", 0), ("1", 1), ("rtx 4090", 0), ("LLVM", 1), ("LLVM 15", 1)] {
        assert_eq!(find(name).expect(name), index, "{name}");
    }
    for name in ["5", "15", "4090", "-1", "99999999999999999999999", "", " ", "7)"] {
        let error = find(name).expect_err(name).to_string();
        assert!(error.contains(&format!("\"{name}\"")) && error.contains("1: llvmpipe"), "{error}");
    }
}

#[test]
fn a_software_renderer_is_used_only_by_name() {
    let software = &two_adapters()[1..];
    let error = device::position(&AdapterChoice::Real, software).expect_err("there is no GPU");
    let error = flotilla_cli::Error::from(error).to_string();
    assert!(
        error.contains("0: llvmpipe") && error.contains("--adapter 0") && error.contains("--backend cpu"),
        "{error}"
    );
    assert_eq!(device::position(&AdapterChoice::Real, &two_adapters()).unwrap(), 0);
    assert!(matches!(device::position(&AdapterChoice::Real, &[]), Err(DeviceError::NoAdapter)));
}

#[test]
fn a_real_gpu_is_never_a_software_renderer() {
    match gpu::open(AdapterChoice::Real) {
        Ok(gpu) => assert!(gpu.adapter.kind.is_real(), "{}", gpu.adapter),
        Err(DeviceError::NoRealAdapter { found }) => assert!(found.iter().all(|info| !info.kind.is_real())),
        Err(DeviceError::NoAdapter) => assert!(device::adapters().is_empty()),
        Err(error) => panic!("{error}"),
    }
    for info in device::adapters().iter().filter(|info| info.name.contains("llvmpipe") || info.name.contains("Swift")) {
        assert_eq!(info.kind, Kind::Software, "{info}");
    }
}

#[test]
fn a_lost_device_is_an_error() {
    for (request, info) in support::adapters("a_lost_device_is_an_error") {
        let gpu = gpu::open(request).unwrap_or_else(|error| panic!("{error}"));
        gpu.check().expect("the device is not lost yet");
        gpu.device.destroy();
        let error = gpu.wait().and_then(|()| gpu.buffer("a buffer", 64, BufferUsages::STORAGE).map(drop));
        let error = error.expect_err("the device was destroyed");
        assert!(matches!(error, DeviceError::Lost { .. }), "{error}");
        assert!(error.to_string().contains(&info.name), "{error}");
    }
}

/// With NVIDIA's driver, a process crashed when one thread unloaded the driver while another one ended.
#[test]
fn threads_that_open_devices_may_end_at_any_time() {
    for (request, _) in support::adapters("threads_that_open_devices_may_end_at_any_time") {
        let open = || (0..3).for_each(|_| drop(gpu::open(request.clone()).unwrap_or_else(|error| panic!("{error}"))));
        std::thread::scope(|scope| (0..4).for_each(|_| drop(scope.spawn(open))));
    }
}

#[test]
fn running_out_of_memory_is_an_error() {
    for (request, info) in support::adapters("running_out_of_memory_is_an_error") {
        let gpu = gpu::open(request).unwrap_or_else(|error| panic!("{error}"));
        let bytes = gpu.limits.max_storage_buffer_binding_size.min(gpu.limits.max_buffer_size) & !3;
        // SwiftShader has too little memory for two of the largest buffers. On other devices, both may fit.
        let buffers = [(); 2].map(|()| gpu.buffer("the sets", bytes, BufferUsages::STORAGE));
        assert!(buffers[1].is_err() || !info.name.contains("SwiftShader"), "{info}");
        for error in buffers.into_iter().filter_map(Result::err) {
            assert!(matches!(error, DeviceError::OutOfMemory { .. }), "{error}");
            assert!(error.to_string().contains("the sets") && error.to_string().contains("smaller batch"), "{error}");
        }
        gpu.buffer("a small buffer", 1024, BufferUsages::STORAGE).expect("the device still works");
    }
}

#[test]
fn a_refusal_names_the_device_and_the_probe() {
    let mismatch = "probe \"x*y + z\" gives 0x00000002 instead of 0x00000001 from 1.5e0".to_string();
    let failures = vec![(Pass::NoContraction, mismatch.clone()), (Pass::Guarded, mismatch)];
    let message = flotilla_cli::Error::from(DeviceError::Inexact { adapter: "Some GPU".into(), failures }).to_string();
    for part in ["Some GPU", "x*y + z", "no-contraction", "guarded", "0x00000002", "1.5e0", "--backend cpu"] {
        assert!(message.contains(part), "{part}: {message}");
    }
}
