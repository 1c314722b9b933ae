//! The pass for Vulkan: SPIR-V whose float results are decorated `NoContraction`.

use naga::Module;
use naga::back::spv;
use naga::proc::{BoundsCheckPolicies, BoundsCheckPolicy};
use naga::valid::ModuleInfo;

use super::ShaderError;

/// Returns naga's own SPIR-V of a module, which is not yet exact. `checked` keeps naga's bounds checks, loop bounds, division
/// checks and zeroed workgroup memory.
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
    spv::write_vec(module, info, &options, None).map_err(|error| ShaderError::Other(format!("no SPIR-V: {error}")))
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

/// Returns the SPIR-V with `OpDecorate %id NoContraction` added for every float arithmetic result.
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
