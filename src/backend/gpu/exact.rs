//! The compile pass that makes plain WGSL arithmetic exact, and the lints that keep it so.
//!
//! A driver may fuse `a * b + c` and reassociate sums. Two ways take that freedom away:
//!
//! - [`Pass::NoContraction`] decorates every float result of the SPIR-V and hands it to a Vulkan driver unchanged.
//! - [`Pass::Guarded`] rewrites the naga IR so that every float sum and product that anything might be joined with passes
//!   through the bits of an integer `x | guard`, with `guard` a zero that only the run time knows. It works wherever wgpu
//!   does. See [`guarded`] for why no compiler can take it away.
//!
//! Shaders know of neither: they declare nothing for the passes, but leave `@group(0) @binding(0)` to the guard.
//! Both passes refuse a shader that leaves the exact core (see [`foreign_operations`]), since no pass could save it.
//!
//! Two things a pass cannot see, because naga folds constants before: an expression of literals is evaluated in f64 and
//! rounded once, and a built-in of literals by the host's libm. Write constants as literals.

use std::borrow::Cow;

use naga::back::spv;
use naga::proc::{BoundsCheckPolicies, BoundsCheckPolicy};
use naga::valid::{Capabilities, FunctionInfo, ModuleInfo, ValidationFlags, Validator};
use naga::{
    AddressSpace, Arena, Barrier, BinaryOperator, Block, Expression, Function, GlobalVariable, Handle, MathFunction,
    Module, Range, RelationalFunction, ResourceBinding, Scalar, ScalarKind, Span, Statement, Type, TypeInner,
};

/// The compile pass that keeps a shader's float arithmetic from being contracted and reassociated.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Pass {
    /// SPIR-V with every float result decorated `NoContraction`. Vulkan only. Costs no instruction.
    NoContraction,
    /// naga IR whose float sums and products pass through integer bits. Works everywhere. Costs one `or` each.
    Guarded,
    /// No protection. Never chosen; for tests that show that differences are detected.
    Plain,
}

impl std::fmt::Display for Pass {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            Pass::NoContraction => "no-contraction",
            Pass::Guarded => "guarded",
            Pass::Plain => "plain",
        })
    }
}

/// Why a shader could not be compiled.
#[derive(Debug, thiserror::Error)]
pub enum ShaderError {
    /// The text is not WGSL; naga's message.
    #[error("does not parse:\n{0}")]
    Parse(String),
    /// naga's validation fails; its message.
    #[error("is not valid: {0}")]
    Invalid(String),
    /// Some operations are not known to be exact on every device.
    #[error("leaves the exact core: {}", .0.join("; "))]
    Foreign(Vec<String>),
    /// It uses the guard's binding.
    #[error("binds group 0 binding 0, which is the guard's")]
    GuardTaken,
    /// It exceeds a limit of the device.
    #[error("needs {what} {needed}, the device allows {allowed}")]
    Limit {
        /// The name of the limit.
        what: &'static str,
        /// The shader's need.
        needed: u64,
        /// The limit.
        allowed: u64,
    },
    /// naga cannot write it as SPIR-V.
    #[error("no SPIR-V: {0}")]
    Spirv(#[from] spv::Error),
}

/// Joins the parts of a shader's text, in order.
pub fn assemble(parts: &[&str]) -> String {
    parts.join("\n")
}

/// Parses and validates a shader. The capabilities are those of plain WebGPU (no f16, f64, subgroups).
///
/// # Errors
/// It does not parse, or is not valid.
pub fn parse(wgsl: &str) -> Result<(Module, ModuleInfo), ShaderError> {
    let module = naga::front::wgsl::parse_str(wgsl).map_err(|error| ShaderError::Parse(error.emit_to_string(wgsl)))?;
    let info = validate(&module).map_err(|error| ShaderError::Invalid(error.emit_to_string(wgsl)))?;
    Ok((module, info))
}

type Invalid = naga::WithSpan<naga::valid::ValidationError>;

fn validate(module: &Module) -> Result<ModuleInfo, Box<Invalid>> {
    Validator::new(ValidationFlags::all(), Capabilities::empty()).validate(module).map_err(Box::new)
}

/// Returns the SPIR-V of all entry points, with every float result decorated `NoContraction`.
///
/// `checked` keeps naga's bounds checks, loop bounds, division checks and zeroed workgroup memory.
///
/// # Errors
/// It does not parse, is not valid, or has no SPIR-V.
pub fn spirv(wgsl: &str, checked: bool) -> Result<Vec<u32>, ShaderError> {
    let (module, info) = parse(wgsl)?;
    Ok(decorate(&emit(&module, &info, checked)?))
}

/// Returns naga's own SPIR-V of a module, which is not yet exact.
///
/// # Errors
/// It has no SPIR-V.
pub fn emit(module: &Module, info: &ModuleInfo, checked: bool) -> Result<Vec<u32>, ShaderError> {
    let policy = if checked { BoundsCheckPolicy::Restrict } else { BoundsCheckPolicy::Unchecked };
    let options = spv::Options {
        // Every Vulkan driver accepts 1.0. wgpu does not report the maximum.
        lang_version: (1, 0),
        flags: spv::WriterFlags::empty(),
        fake_missing_bindings: true,
        bounds_check_policies: BoundsCheckPolicies {
            index: policy,
            buffer: policy,
            image_load: policy,
            binding_array: policy,
        },
        zero_initialize_workgroup_memory: if checked {
            spv::ZeroInitializeWorkgroupMemoryMode::Polyfill
        } else {
            spv::ZeroInitializeWorkgroupMemoryMode::None
        },
        force_loop_bounding: checked,
        emit_int_div_checks: checked,
        ..Default::default()
    };
    Ok(spv::write_vec(module, info, &options, None)?)
}

/// The SPIR-V opcodes that the decorating pass needs (SPIR-V 1.6, Sections 3.20 and 3.49).
mod op {
    /// Words before the first instruction.
    pub const HEADER: usize = 5;
    pub const EXT_INST: u32 = 12;
    pub const TYPES: std::ops::RangeInclusive<u32> = 19..=39;
    pub const DECORATE: u32 = 71;
    pub const NO_CONTRACTION: u32 = 42;
    /// An instruction of `GLSL.std.450`, the only set that naga uses.
    pub const FMA: u32 = 50;

    /// OpFNegate, OpFAdd, OpFSub, OpFMul, OpFDiv, OpFRem, OpFMod, then OpVectorTimesScalar to OpDot.
    pub fn is_float_arithmetic(opcode: u32) -> bool {
        matches!(opcode, 127 | 129 | 131 | 133 | 136 | 140 | 141 | 142..=148)
    }
}

/// Returns the opcode, the offset and the words of each instruction.
fn instructions(words: &[u32]) -> impl Iterator<Item = (u32, usize, &[u32])> {
    let mut at = op::HEADER;
    std::iter::from_fn(move || {
        let first = *words.get(at)?;
        let instruction = words.get(at..at + (first >> 16).max(1) as usize)?;
        let place = at;
        at += instruction.len();
        Some((first & 0xffff, place, instruction))
    })
}

/// Returns the ids of all float arithmetic results.
fn float_results(words: &[u32]) -> impl Iterator<Item = u32> {
    instructions(words).filter_map(|(opcode, _, instruction)| {
        let fused = opcode == op::EXT_INST && instruction.get(4) == Some(&op::FMA);
        (fused || op::is_float_arithmetic(opcode)).then(|| instruction.get(2).copied()).flatten()
    })
}

/// Adds `OpDecorate %id NoContraction` for every float arithmetic result.
pub fn decorate(words: &[u32]) -> Vec<u32> {
    // Annotations end where the types begin. Every module has a type.
    let end = instructions(words).find(|(opcode, ..)| op::TYPES.contains(opcode)).map_or(words.len(), |(_, at, _)| at);
    let decorations = float_results(words).flat_map(|id| [3 << 16 | op::DECORATE, id, op::NO_CONTRACTION]);
    words[..end].iter().copied().chain(decorations).chain(words[end..].iter().copied()).collect()
}

/// Counts the float arithmetic results of a SPIR-V module that are not decorated `NoContraction`.
pub fn undecorated(words: &[u32]) -> usize {
    let decorated: std::collections::HashSet<u32> = instructions(words)
        .filter(|(opcode, _, i)| *opcode == op::DECORATE && i.get(2) == Some(&op::NO_CONTRACTION))
        .map(|(_, _, instruction)| instruction[1])
        .collect();
    float_results(words).filter(|id| !decorated.contains(id)).count()
}

/// The module with f32 sums and products passed through `bitcast<f32>(bitcast<u32>(x) | guard)`: all but those of which
/// nothing but comparisons of whole numbers reads the bits, as of `bitcast<i32>(d2) <= bitcast<i32>(radius2)`. Behind such
/// a one stands no float operation that it could be fused or reordered with; what it is made of is guarded. (A comparison
/// of floats is no such end: `x + 1 <= y` might become `x <= y - 1`.)
///
/// `guard` is a new uniform at group 0, binding 0, that must hold zero. Products alone would not do: a driver could
/// still reassociate the sums.
///
/// # Why nothing takes a guard away
///
/// A compiler does not know the guard, so what it makes of a shader must be right for every guard. With `^` that is no
/// hindrance: for every guard, `(x ^ guard) ^ guard` is `x`. It comes up where the operation between two guards falls
/// away, as the first `0.0 + product` of an unrolled sum does: AMD's compiler then cancelled the two, and fused the
/// bare product with the next sum. With `|` nothing can bring `x` back. A guard with a bit set makes that bit of
/// `x | guard` the same for all `x`, so no function of `x | guard` and the guard is `x` for every guard; and the pass
/// hands no float operation anything else of `x`. A fused or reordered sum needs a bare product or sum, so it would be wrong for some
/// guard. Operation by operation, of those that may follow:
///
/// - `| guard` again, the operation between having fallen away (`0.0 + x`, `1.0 * x`, a selection, a copy): the two are
///   one, `x | guard`, which still stands between `x` and what comes after.
/// - Selections, loops' carried values and vectors: the guard may move behind them, `(x or y) | guard`, but no sum or
///   product is among them, and it stands before the next one.
/// - `&`, `|`, shifts by and with other words, and `abs`: a guard may move through, masked or shifted alike, and stays
///   unknown wherever a bit of `x` is left. Bits that are masked off carry neither.
/// - `^` with other words, negation, integer sums and conversions: no guard moves through.
/// - `&`, `^` and sums of two guarded words, as `(x | guard) ^ (y | guard) = (x ^ y) & ~guard`: a guard may be shared, but
///   what is under it is an integer operation, and neither a float sum nor a product.
/// - `floor`, comparisons: of the guarded value, as any other; no guard moves through.
/// - Nothing else meets the guard: the shader cannot name it, and the pass uses it in no other way.
///
/// # Errors
/// The module is not valid.
pub fn guarded(module: &Module) -> Result<Module, ShaderError> {
    let info = validate(module).map_err(|error| ShaderError::Invalid(error.to_string()))?;
    let foreign = foreign_in(module, &info);
    if !foreign.is_empty() {
        return Err(ShaderError::Foreign(foreign));
    }
    if module.global_variables.iter().any(|(_, variable)| variable.binding == Some(GUARD)) {
        return Err(ShaderError::GuardTaken);
    }
    let mut guarded = module.clone();
    let word = Type { name: None, inner: TypeInner::Scalar(Scalar::U32) };
    let variable = GlobalVariable {
        name: Some("guard".into()),
        space: AddressSpace::Uniform,
        binding: Some(GUARD),
        ty: guarded.types.insert(word, Span::UNDEFINED),
        init: None,
        memory_decorations: Default::default(),
    };
    let guard = guarded.global_variables.append(variable, Span::UNDEFINED);
    for (handle, function) in guarded.functions.iter_mut() {
        guard_function(function, &info[handle], module, guard);
    }
    for (index, entry) in guarded.entry_points.iter_mut().enumerate() {
        guard_function(&mut entry.function, info.get_entry_point(index), module, guard);
    }
    Ok(guarded)
}

fn guard_function(function: &mut Function, info: &FunctionInfo, module: &Module, guard: Handle<GlobalVariable>) {
    let mut expressions = Arena::new();
    let mut append = |expression, span| expressions.append(expression, span);
    let pointer = append(Expression::GlobalVariable(guard), Span::UNDEFINED);
    let zero = append(Expression::Load { pointer }, Span::UNDEFINED);
    // The first and the last expression that replace each old one. The last has its value.
    let mut moved: Vec<(Handle<Expression>, Handle<Expression>)> = Vec::new();
    let exposed = exposed(function, info, module, None);
    for (old, expression) in function.expressions.iter() {
        let span = function.expressions.get_span(old);
        let mut expression = expression.clone();
        for operand in operands(&mut expression).into_iter().flatten() {
            *operand = moved[operand.index()].1;
        }
        let inner = info[old].ty.inner_with(&module.types);
        let guards = rounds(&expression, inner) && exposed[old.index()];
        let first = append(expression, span);
        let last = if guards {
            let zeros = match *inner {
                TypeInner::Vector { size, .. } => append(Expression::Splat { size, value: zero }, span),
                _ => zero,
            };
            let bits = append(Expression::As { expr: first, kind: ScalarKind::Uint, convert: None }, span);
            let op = BinaryOperator::InclusiveOr;
            let same = append(Expression::Binary { op, left: bits, right: zeros }, span);
            append(Expression::As { expr: same, kind: ScalarKind::Float, convert: None }, span)
        } else {
            first
        };
        moved.push((first, last));
    }
    function.expressions = expressions;
    for (_, variable) in function.local_variables.iter_mut() {
        variable.init = variable.init.map(|init| moved[init.index()].1);
    }
    function.named_expressions =
        function.named_expressions.drain(..).map(|(old, name)| (moved[old.index()].1, name)).collect();
    move_block(&mut function.body, &moved);
    let load = Statement::Emit(Range::new_from_bounds(zero, zero));
    function.body.splice(0..0, Block::from_vec(vec![load]));
}

/// Returns, per expression, whether anything may read it except guards and integer comparisons of its bits.
fn exposed(
    function: &Function,
    info: &FunctionInfo,
    module: &Module,
    guard: Option<Handle<GlobalVariable>>,
) -> Vec<bool> {
    let expressions = &function.expressions;
    let mut exposed = vec![false; expressions.len()];
    let mut blocks = vec![function.body.clone()];
    while let Some(mut block) = blocks.pop() {
        for (handles, inside) in block.iter_mut().filter_map(parts) {
            handles.into_iter().for_each(|handle| exposed[handle.index()] = true);
            blocks.extend(inside.into_iter().map(|block| block.clone()));
        }
    }
    let is_guard = |handle: Handle<Expression>| {
        let zero = match expressions[handle] {
            Expression::Splat { value, .. } => value,
            _ => handle,
        };
        let Expression::Load { pointer } = expressions[zero] else { return false };
        matches!(expressions[pointer], Expression::GlobalVariable(variable) if Some(variable) == guard)
    };
    // Readers come after what they read.
    for (reader, expression) in expressions.iter().collect::<Vec<_>>().into_iter().rev() {
        let exposes = match *expression {
            Expression::Binary { op, left, .. } if compares(op) => is_float(info[left].ty.inner_with(&module.types)),
            Expression::Binary { op: BinaryOperator::InclusiveOr, right, .. } => !is_guard(right),
            Expression::As { kind: ScalarKind::Sint | ScalarKind::Uint, convert: None, .. } => exposed[reader.index()],
            _ => true,
        };
        if exposes {
            for operand in operands(&mut expression.clone()).into_iter().flatten() {
                exposed[operand.index()] = true;
            }
        }
    }
    exposed
}

fn compares(op: BinaryOperator) -> bool {
    use BinaryOperator::{Equal, Greater, GreaterEqual, Less, LessEqual, NotEqual};
    matches!(op, Equal | NotEqual | Less | LessEqual | Greater | GreaterEqual)
}

/// The binding of the guard.
const GUARD: ResourceBinding = ResourceBinding { group: 0, binding: 0 };

/// Reports whether an expression is a float sum or product, scalar or vector.
fn rounds(expression: &Expression, inner: &TypeInner) -> bool {
    use BinaryOperator::{Add, Multiply, Subtract};
    matches!(expression, Expression::Binary { op: Add | Subtract | Multiply, .. }) && is_float(inner)
}

/// Counts the float sums and products of a module that are neither guarded nor compared only by their bits. 0 after
/// [`guarded`].
///
/// # Errors
/// The module is not valid.
pub fn unguarded(module: &Module) -> Result<usize, ShaderError> {
    let info = validate(module).map_err(|error| ShaderError::Invalid(error.to_string()))?;
    let guard = module.global_variables.iter().find(|(_, variable)| variable.binding == Some(GUARD));
    let guard = guard.map(|(handle, _)| handle);
    let count = |(_, function, info): (&str, &Function, &FunctionInfo)| {
        let exposed = exposed(function, info, module, guard);
        let bare = |(handle, expression): &(Handle<Expression>, &Expression)| {
            exposed[handle.index()] && rounds(expression, info[*handle].ty.inner_with(&module.types))
        };
        function.expressions.iter().filter(bare).count()
    };
    Ok(functions(module, &info).map(count).sum())
}

/// Returns every function of a module, entry points last, with its name and the validator's information.
fn functions<'a>(
    module: &'a Module,
    info: &'a ModuleInfo,
) -> impl Iterator<Item = (&'a str, &'a Function, &'a FunctionInfo)> {
    let functions = module.functions.iter().map(|(handle, function)| {
        let name = function.name.as_deref().unwrap_or("a function");
        (name, function, &info[handle])
    });
    let entries = module.entry_points.iter().enumerate();
    functions.chain(entries.map(|(index, e)| (e.name.as_str(), &e.function, info.get_entry_point(index))))
}

fn move_block(block: &mut Block, moved: &[(Handle<Expression>, Handle<Expression>)]) {
    for statement in block.iter_mut() {
        if let Statement::Emit(range) = statement
            && let Some((first, last)) = range.first_and_last()
        {
            *range = Range::new_from_bounds(moved[first.index()].0, moved[last.index()].1);
        }
        let Some((handles, blocks)) = parts(statement) else { continue };
        for handle in handles {
            *handle = moved[handle.index()].1;
        }
        for block in blocks {
            move_block(block, moved);
        }
    }
}

/// Returns the operands of an expression of the core, or `None` for one outside it.
fn operands(expression: &mut Expression) -> Option<Vec<&mut Handle<Expression>>> {
    use Expression as E;
    Some(match expression {
        E::Literal(_) | E::Constant(_) | E::ZeroValue(_) | E::FunctionArgument(_) => vec![],
        E::GlobalVariable(_) | E::LocalVariable(_) | E::CallResult(_) => vec![],
        E::AtomicResult { .. } | E::WorkGroupUniformLoadResult { .. } => vec![],
        E::Compose { components, .. } => components.iter_mut().collect(),
        E::Access { base, index } => vec![base, index],
        E::AccessIndex { base, .. } => vec![base],
        E::Splat { value, .. } => vec![value],
        E::Swizzle { vector, .. } => vec![vector],
        E::Load { pointer } => vec![pointer],
        E::Unary { expr, .. } | E::As { expr, .. } | E::ArrayLength(expr) => vec![expr],
        E::Binary { left, right, .. } => vec![left, right],
        E::Select { condition, accept, reject } => vec![condition, accept, reject],
        E::Relational { argument, .. } => vec![argument],
        E::Math { arg, arg1, arg2, arg3, .. } => {
            [Some(arg), arg1.as_mut(), arg2.as_mut(), arg3.as_mut()].into_iter().flatten().collect()
        }
        _ => return None,
    })
}

type Parts<'a> = (Vec<&'a mut Handle<Expression>>, Vec<&'a mut Block>);

/// Returns the expressions and blocks in a statement of the core, without an `Emit`'s range, or `None` for one outside
/// it.
fn parts(statement: &mut Statement) -> Option<Parts<'_>> {
    use Statement as S;
    Some(match statement {
        S::Emit(_) | S::Break | S::Continue | S::ControlBarrier(_) | S::MemoryBarrier(_) => (vec![], vec![]),
        S::Block(block) => (vec![], vec![block]),
        S::If { condition, accept, reject } => (vec![condition], vec![accept, reject]),
        S::Switch { selector, cases } => (vec![selector], cases.iter_mut().map(|case| &mut case.body).collect()),
        S::Loop { body, continuing, break_if } => (break_if.iter_mut().collect(), vec![body, continuing]),
        S::Return { value } => (value.iter_mut().collect(), vec![]),
        S::Store { pointer, value } => (vec![pointer, value], vec![]),
        S::Atomic { pointer, fun, value, result } => {
            let mut handles = vec![pointer, value];
            handles.extend(result);
            if let naga::AtomicFunction::Exchange { compare } = fun {
                handles.extend(compare);
            }
            (handles, vec![])
        }
        S::WorkGroupUniformLoad { pointer, result } => (vec![pointer, result], vec![]),
        S::Call { arguments, result, .. } => (arguments.iter_mut().chain(result).collect(), vec![]),
        _ => return None,
    })
}

/// Returns every operation of a module outside the exact core, as `function: operation`. Empty if the module is exact.
///
/// The core: f32 `+ - *`, negation, comparison, `select`, `abs`, `floor`, bit casts; all integer arithmetic;
/// conversions between u32, i32 and f32; vectors of these; loads, stores, integer atomics, calls, control flow,
/// workgroup barriers.
pub fn foreign_operations(module: &Module) -> Vec<String> {
    match validate(module) {
        Ok(info) => foreign_in(module, &info),
        Err(error) => vec![format!("not valid: {error}")],
    }
}

fn foreign_in(module: &Module, info: &ModuleInfo) -> Vec<String> {
    let mut found = Vec::new();
    for (_, value) in module.overrides.iter() {
        found.push(format!("override {}", value.name.as_deref().unwrap_or("without a name")));
    }
    for (name, function, info) in functions(module, info) {
        let mut report = |what: String| found.push(format!("{name}: {what}"));
        for (handle, expression) in function.expressions.iter() {
            let of = |handle: Handle<Expression>| info[handle].ty.inner_with(&module.types);
            if let Some(what) = foreign_expression(expression, of(handle), of) {
                report(what);
            }
        }
        foreign_statements(&function.body, &mut report);
    }
    found
}

fn is_float(inner: &TypeInner) -> bool {
    inner.scalar_kind() == Some(ScalarKind::Float)
}

fn foreign_expression<'a>(
    expression: &Expression,
    inner: &TypeInner,
    of: impl Fn(Handle<Expression>) -> &'a TypeInner,
) -> Option<String> {
    use MathFunction as M;
    let core = match *expression {
        Expression::Binary { op: BinaryOperator::Divide | BinaryOperator::Modulo, .. } => !is_float(inner),
        Expression::Math { fun: M::Abs | M::Floor, .. } => true,
        Expression::Math {
            fun:
                M::Min
                | M::Max
                | M::Clamp
                | M::CountTrailingZeros
                | M::CountLeadingZeros
                | M::CountOneBits
                | M::ReverseBits
                | M::ExtractBits
                | M::InsertBits
                | M::FirstTrailingBit
                | M::FirstLeadingBit,
            arg,
            ..
        } => !is_float(of(arg)),
        Expression::Math { .. } => false,
        Expression::Relational { fun, .. } => matches!(fun, RelationalFunction::All | RelationalFunction::Any),
        Expression::AtomicResult { .. } => !is_float(inner),
        ref other => operands(&mut other.clone()).is_some(),
    };
    let odd_type = matches!(inner, TypeInner::Matrix { .. })
        || inner.scalar().is_some_and(|scalar| scalar.width > 4)
        || is_float(inner) && inner.scalar_width() != Some(4);
    match (core, odd_type) {
        (true, false) => None,
        (true, true) => Some(format!("a value of type {inner:?}")),
        (false, _) => Some(match expression {
            Expression::Binary { op, .. } => format!("float {op:?}"),
            Expression::Math { fun, .. } => format!("{fun:?}"),
            Expression::Relational { fun, .. } => format!("{fun:?}"),
            other => format!("{other:?}"),
        }),
    }
}

fn foreign_statements(block: &Block, report: &mut impl FnMut(String)) {
    for statement in block.iter() {
        let mut statement = statement.clone();
        let outside = match &statement {
            Statement::ControlBarrier(barrier) | Statement::MemoryBarrier(barrier) => {
                barrier.intersects(Barrier::SUB_GROUP | Barrier::TEXTURE)
            }
            _ => false,
        };
        match parts(&mut statement) {
            Some((_, blocks)) if !outside => {
                for block in blocks {
                    foreign_statements(block, report);
                }
            }
            _ => report(format!("{statement:?}")),
        }
    }
}

/// Checks what wgpu does not check for passthrough shaders: workgroup sizes and memory.
fn check_limits(module: &Module, limits: &wgpu::Limits) -> Result<(), ShaderError> {
    let within = |what, needed: u64, allowed: u32| match needed <= allowed.into() {
        true => Ok(()),
        false => Err(ShaderError::Limit { what, needed, allowed: allowed.into() }),
    };
    for entry in &module.entry_points {
        let [x, y, z] = entry.workgroup_size.map(u64::from);
        within("a workgroup of", x * y * z, limits.max_compute_invocations_per_workgroup)?;
        within("a workgroup width of", x, limits.max_compute_workgroup_size_x)?;
        within("a workgroup height of", y, limits.max_compute_workgroup_size_y)?;
        within("a workgroup depth of", z, limits.max_compute_workgroup_size_z)?;
    }
    let shared = module.global_variables.iter().filter(|(_, variable)| variable.space == AddressSpace::WorkGroup);
    let bytes =
        shared.map(|(_, v)| module.types[v.ty].inner.try_size(module.to_ctx()).map_or(u64::MAX / 64, u64::from));
    within("workgroup memory, in bytes, of", bytes.sum(), limits.max_compute_workgroup_storage_size)
}

/// Compiles a shader for a device under a pass. Its pipelines need an explicit layout with dense bindings from 0 (the
/// guard) on. The driver's errors go to the device's error scopes.
///
/// Unless `checked`, shaders run without bounds checks, loop bounds, division checks and zeroed workgroup memory.
///
/// # Safety
/// See [`super::device::Gpu::pipeline`].
#[expect(unsafe_code, reason = "shaders are compiled without bounds checks")]
pub(super) unsafe fn compile(
    device: &wgpu::Device,
    label: &str,
    wgsl: &str,
    pass: Pass,
    checked: bool,
) -> Result<wgpu::ShaderModule, ShaderError> {
    let (module, info) = parse(wgsl)?;
    let foreign = foreign_in(&module, &info);
    if !foreign.is_empty() {
        return Err(ShaderError::Foreign(foreign));
    }
    check_limits(&module, &device.limits())?;
    let module = match pass {
        Pass::NoContraction => {
            let words = decorate(&emit(&module, &info, checked)?);
            let entry_points = module.entry_points.iter().map(|entry| wgpu::PassthroughShaderEntryPoint {
                name: entry.name.as_str().into(),
                workgroup_size: entry.workgroup_size.into(),
            });
            let descriptor = wgpu::ShaderModuleDescriptorPassthrough {
                label: Some(label),
                entry_points: entry_points.collect(),
                spirv: Some(words.into()),
                ..Default::default()
            };
            // SAFETY: naga validated the module and wrote the SPIR-V, to which only decorations were added. The limits
            // were checked above. The rest is the caller's obligation.
            return Ok(unsafe { device.create_shader_module_passthrough(descriptor) });
        }
        Pass::Guarded => guarded(&module)?,
        Pass::Plain => module,
    };
    let descriptor =
        wgpu::ShaderModuleDescriptor { label: Some(label), source: wgpu::ShaderSource::Naga(Cow::Owned(module)) };
    if checked {
        return Ok(device.create_shader_module(descriptor));
    }
    // SAFETY: wgpu validates the module. The rest is the caller's obligation.
    Ok(unsafe { device.create_shader_module_trusted(descriptor, wgpu::ShaderRuntimeChecks::unchecked()) })
}
