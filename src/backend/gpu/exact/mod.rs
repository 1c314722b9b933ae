//! Compiles WGSL so that its float arithmetic is exact.
//!
//! A driver may fuse `a * b + c` and reassociate sums. Two passes prevent that:
//!
//! - [`Pass::NoContraction`] decorates every float result of the SPIR-V, which a Vulkan driver receives unchanged. See
//!   [`decorate`].
//! - [`Pass::Guarded`] makes every float sum and product depend on a zero that the compiler does not know. It works on
//!   all APIs. See [`guarded`].
//!
//! Shaders are written without regard to the passes, except that `@group(0) @binding(0)` is reserved for the guard.
//! Both passes refuse a shader with operations that no pass could make exact, see [`inexact_operations`].
//!
//! Neither pass sees expressions of constants, because naga evaluates them first: arithmetic in f64, rounded once, and
//! built-in functions using the host's libm. Write such constants as literals.

mod contraction;
mod guard;
mod operations;

use std::borrow::Cow;

use naga::valid::{Capabilities, ModuleInfo, ValidationFlags, Validator};
use naga::{AddressSpace, Module};

pub use contraction::{decorate, emit, undecorated};
pub use guard::{guarded, unguarded};
pub use operations::inexact_operations;

use crate::config_enum::config_enum;
use operations::inexact_in;

config_enum! {
    /// The compile pass that keeps a shader's float arithmetic from being contracted and reassociated.
    Pass {
        /// SPIR-V with every float result decorated `NoContraction`. Vulkan only. Costs no instruction.
        NoContraction = "no-contraction",
        /// naga IR whose float sums and products pass through integer bits. Works everywhere. Costs one `or` each.
        Guarded = "guarded",
        /// No protection. Never chosen; for tests that show that differences are detected.
        Plain = "plain",
    }
}

/// Why a shader could not be compiled.
#[derive(Debug, thiserror::Error)]
pub enum ShaderError {
    /// naga's validation fails; its message.
    #[error("is not valid: {0}")]
    Invalid(String),
    /// It uses operations whose results may differ between devices.
    #[error("uses operations that differ between devices: {}", .0.join("; "))]
    Inexact(Vec<String>),
    /// It uses the guard's binding.
    #[error("binds group 0 binding 0, which is the guard's")]
    GuardTaken,
    /// It does not parse, has no SPIR-V, or exceeds a limit of the device.
    #[error("{0}")]
    Other(String),
}

/// Parses and validates a shader. The capabilities are those of plain WebGPU (no f16, f64, subgroups).
///
/// # Errors
/// It does not parse, or is not valid.
pub fn parse(wgsl: &str) -> Result<(Module, ModuleInfo), ShaderError> {
    let module = naga::front::wgsl::parse_str(wgsl)
        .map_err(|error| ShaderError::Other(format!("does not parse:\n{}", error.emit_to_string(wgsl))))?;
    let info = validate(&module).map_err(|error| ShaderError::Invalid(error.emit_to_string(wgsl)))?;
    Ok((module, info))
}

type Invalid = naga::WithSpan<naga::valid::ValidationError>;

fn validate(module: &Module) -> Result<ModuleInfo, Box<Invalid>> {
    Validator::new(ValidationFlags::all(), Capabilities::empty()).validate(module).map_err(Box::new)
}

/// Checks what wgpu does not check for passthrough shaders: workgroup sizes and memory.
fn check_limits(module: &Module, limits: &wgpu::Limits) -> Result<(), ShaderError> {
    let within = |what, needed: u64, allowed: u32| match needed <= allowed.into() {
        true => Ok(()),
        false => Err(ShaderError::Other(format!("needs {what} {needed}, the device allows {allowed}"))),
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
    let inexact = inexact_in(&module, &info);
    if !inexact.is_empty() {
        return Err(ShaderError::Inexact(inexact));
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
