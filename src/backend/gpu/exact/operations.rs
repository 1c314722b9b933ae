//! The operations that shaders may use, and a walk over them in naga's IR.

use naga::valid::{FunctionInfo, ModuleInfo};
use naga::{
    Barrier, BinaryOperator, Block, Expression, Function, Handle, MathFunction, Module, RelationalFunction, ScalarKind,
    Statement, TypeInner,
};

use super::validate;

/// Returns all functions of a module with their names and the validator's information. Entry points come last.
pub(super) fn functions<'a>(
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

/// Returns the operands of an expression, or `None` if shaders may not use it.
pub(super) fn operands(expression: &mut Expression) -> Option<Vec<&mut Handle<Expression>>> {
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

pub(super) type OperandsAndBlocks<'a> = (Vec<&'a mut Handle<Expression>>, Vec<&'a mut Block>);

/// Returns the expressions and blocks of a statement, or `None` if shaders may not use it. The range of an `Emit` is
/// not included.
pub(super) fn operands_and_blocks(statement: &mut Statement) -> Option<OperandsAndBlocks<'_>> {
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

/// Returns the operations of a module whose results may differ between devices, or that some compiler refuses, as
/// `function: operation`.
///
/// Allowed are f32 `+ - *`, negation, comparison, `select`, `abs`, `floor`, bit casts; all integer arithmetic;
/// conversions between u32, i32 and f32; vectors of these; loads, stores, integer atomics, calls, control flow,
/// workgroup barriers. DX12's older compiler refuses stores to a component of a vector by a variable index.
pub fn inexact_operations(module: &Module) -> Vec<String> {
    match validate(module) {
        Ok(info) => inexact_in(module, &info),
        Err(error) => vec![format!("not valid: {error}")],
    }
}

pub(super) fn inexact_in(module: &Module, info: &ModuleInfo) -> Vec<String> {
    let mut found = Vec::new();
    for (_, value) in module.overrides.iter() {
        found.push(format!("override {}", value.name.as_deref().unwrap_or("without a name")));
    }
    for (name, function, info) in functions(module, info) {
        let mut report = |what: String| found.push(format!("{name}: {what}"));
        for (handle, expression) in function.expressions.iter() {
            let of = |handle: Handle<Expression>| info[handle].ty.inner_with(&module.types);
            if let Some(what) = inexact_expression(expression, of(handle), of) {
                report(what);
            }
        }
        let is_component = |pointer: Handle<Expression>| {
            let inner = info[pointer].ty.inner_with(&module.types);
            matches!(
                (&function.expressions[pointer], inner),
                (Expression::Access { .. }, TypeInner::ValuePointer { .. })
            )
        };
        inexact_statements(&function.body, &is_component, &mut report);
    }
    found
}

pub(super) fn is_float(inner: &TypeInner) -> bool {
    inner.scalar_kind() == Some(ScalarKind::Float)
}

fn inexact_expression<'a>(
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

/// `is_component` reports whether a pointer is to a component of a vector, by a variable index.
fn inexact_statements(
    block: &Block,
    is_component: &impl Fn(Handle<Expression>) -> bool,
    report: &mut impl FnMut(String),
) {
    for statement in block.iter() {
        let mut statement = statement.clone();
        let outside = match &statement {
            Statement::ControlBarrier(barrier) | Statement::MemoryBarrier(barrier) => {
                barrier.intersects(Barrier::SUB_GROUP | Barrier::TEXTURE)
            }
            Statement::Store { pointer, .. } => is_component(*pointer),
            _ => false,
        };
        match operands_and_blocks(&mut statement) {
            Some((_, blocks)) if !outside => {
                for block in blocks {
                    inexact_statements(block, is_component, report);
                }
            }
            _ => report(format!("{statement:?}")),
        }
    }
}
