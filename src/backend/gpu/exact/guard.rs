//! The guarded pass, which works on every API that wgpu supports.
//!
//! It replaces a float sum, difference or product `x` with `bitcast<f32>(bitcast<u32>(x) | guard)`. The guard is a
//! uniform that always holds zero, so no value changes. A compiler does not know that: its code must be right for every
//! value of the guard. Guarding products alone would not be enough, because drivers may also reassociate sums.
//!
//! # Why no compiler can remove a guard
//!
//! To fuse or reorder `x` with the next operation, a compiler needs `x` itself. If a bit of the guard is set, that bit
//! of `x | guard` is 1 for all `x`. So `x` cannot be computed from `x | guard` and the guard, and the pass gives float
//! operations nothing else of `x`.
//!
//! An exclusive or would not be enough, because `(x ^ guard) ^ guard` is `x` for every guard. AMD's compiler used that
//! when an operation between two guards disappeared, as the first `0.0 + product` of an unrolled sum does. It cancelled
//! the two guards and fused the product with the next sum.
//!
//! Compilers may still do the following with guards, which is harmless:
//!
//! - Merge two guards if the operation between them disappears (`0.0 + x`, `1.0 * x`, a selection, a copy). The one that
//!   remains still separates `x` from the next operation.
//! - Move a guard behind a selection, a loop's carried value or a vector, as in `(x or y) | guard`. None of these is a sum
//!   or product, and the guard still precedes the next one.
//! - Move a guard through `&`, `|`, shifts and `abs`, masked or shifted in the same way. Bits of `x` that remain are still
//!   guarded.
//! - Share the guard of two operands of an integer operation, as in `(x | guard) ^ (y | guard) = (x ^ y) & ~guard`. No
//!   float sum or product becomes unguarded by that.
//!
//! No guard moves through `^` with other words, negation, integer sums, conversions, `floor` or comparisons. Shaders
//! cannot name the guard, and the pass uses it for nothing else.
//!
//! # Which results need no guard
//!
//! A result needs none if only integer comparisons read its bits, as in `bitcast<i32>(d2) <= bitcast<i32>(radius2)`. No
//! float operation follows with which it could be fused. Comparisons of floats do not count, because a compiler may
//! turn `x + 1 <= y` into `x <= y - 1`.

use naga::valid::FunctionInfo;
use naga::{
    AddressSpace, Arena, BinaryOperator, Block, Expression, Function, GlobalVariable, Handle, Module, Range,
    ResourceBinding, Scalar, ScalarKind, Span, Statement, Type, TypeInner,
};

use super::operations::{functions, inexact_in, is_float, operands, operands_and_blocks};
use super::{ShaderError, validate};

/// Returns a copy of a module whose float sums, differences and products pass through the guard.
///
/// The guard is a new uniform at group 0, binding 0, which must hold zero.
///
/// # Errors
/// The module is not valid, uses operations that differ between devices, or already binds the guard.
pub fn guarded(module: &Module) -> Result<Module, ShaderError> {
    let info = validate(module).map_err(|error| ShaderError::Invalid(error.to_string()))?;
    let inexact = inexact_in(module, &info);
    if !inexact.is_empty() {
        return Err(ShaderError::Inexact(inexact));
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

/// Guards the sums and products of a function that [`exposed`] marks.
fn guard_function(function: &mut Function, info: &FunctionInfo, module: &Module, guard: Handle<GlobalVariable>) {
    let mut expressions = Arena::new();
    let mut append = |expression, span| expressions.append(expression, span);
    let pointer = append(Expression::GlobalVariable(guard), Span::UNDEFINED);
    let zero = append(Expression::Load { pointer }, Span::UNDEFINED);
    // Each old expression becomes one or several new ones: the first of them, and the last, which has its value.
    let mut replaced: Vec<(Handle<Expression>, Handle<Expression>)> = Vec::new();
    let exposed = exposed(function, info, module, None);
    for (old, expression) in function.expressions.iter() {
        let span = function.expressions.get_span(old);
        let mut expression = expression.clone();
        for operand in operands(&mut expression).into_iter().flatten() {
            *operand = replaced[operand.index()].1;
        }
        let inner = info[old].ty.inner_with(&module.types);
        let guards = is_sum_or_product(&expression, inner) && exposed[old.index()];
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
        replaced.push((first, last));
    }
    function.expressions = expressions;
    for (_, variable) in function.local_variables.iter_mut() {
        variable.init = variable.init.map(|init| replaced[init.index()].1);
    }
    function.named_expressions =
        function.named_expressions.drain(..).map(|(old, name)| (replaced[old.index()].1, name)).collect();
    replace_in_block(&mut function.body, &replaced);
    let load = Statement::Emit(Range::new_from_bounds(zero, zero));
    function.body.splice(0..0, Block::from_vec(vec![load]));
}

/// Returns for each expression whether it needs a guard: whether anything reads it except guards and integer
/// comparisons.
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
        for (handles, inside) in block.iter_mut().filter_map(operands_and_blocks) {
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
    // Expressions come after their operands, so readers are visited first.
    for (reader, expression) in expressions.iter().collect::<Vec<_>>().into_iter().rev() {
        let exposes = match *expression {
            Expression::Binary { op, left, .. } if is_comparison(op) => {
                is_float(info[left].ty.inner_with(&module.types))
            }
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

fn is_comparison(op: BinaryOperator) -> bool {
    use BinaryOperator::{Equal, Greater, GreaterEqual, Less, LessEqual, NotEqual};
    matches!(op, Equal | NotEqual | Less | LessEqual | Greater | GreaterEqual)
}

/// The binding of the guard.
const GUARD: ResourceBinding = ResourceBinding { group: 0, binding: 0 };

/// Reports whether an expression is a sum, difference or product of floats, scalar or vector.
fn is_sum_or_product(expression: &Expression, inner: &TypeInner) -> bool {
    use BinaryOperator::{Add, Multiply, Subtract};
    matches!(expression, Expression::Binary { op: Add | Subtract | Multiply, .. }) && is_float(inner)
}

/// Counts the float sums and products of a module that lack a guard that they need. The result of [`guarded`] has none.
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
            exposed[handle.index()] && is_sum_or_product(expression, info[*handle].ty.inner_with(&module.types))
        };
        function.expressions.iter().filter(bare).count()
    };
    Ok(functions(module, &info).map(count).sum())
}

/// Replaces expressions in the statements of a block, pairs of old and new handles.
fn replace_in_block(block: &mut Block, replaced: &[(Handle<Expression>, Handle<Expression>)]) {
    for statement in block.iter_mut() {
        if let Statement::Emit(range) = statement
            && let Some((first, last)) = range.first_and_last()
        {
            *range = Range::new_from_bounds(replaced[first.index()].0, replaced[last.index()].1);
        }
        let Some((handles, blocks)) = operands_and_blocks(statement) else { continue };
        for handle in handles {
            *handle = replaced[handle.index()].1;
        }
        for block in blocks {
            replace_in_block(block, replaced);
        }
    }
}
