//! Compiled kernels: which worlds get one of their own, and how many are kept.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, HashSet};

use super::GpuBackend;
use super::shape::{Capacity, Kernel, MAX_OFFSET, Recorded, Shape, Workgroup};
use super::source::{packing, source};
use crate::backend::Group;
use crate::backend::gpu::device::{Binding, DeviceError};
use crate::parallel::*;

/// Maximum number of specialised kernels per rollout under [`Kernel::Best`]: each takes a fraction of a second to compile.
const MAX_SPECIALISED: usize = 16;
/// Default maximum of kernels per batch, and of kernels kept from one batch to the next: a driver needs megabytes for
/// each.
pub(super) const KEPT_KERNELS: usize = 64;
/// Returns the shapes that get a specialised kernel: those that have one, and of the others those with most
/// agent-steps, up to [`MAX_SPECIALISED`] in all.
fn worth_compiling(work: BTreeMap<Shape, u64>, compiled: &HashSet<Shape>) -> HashSet<Shape> {
    let (mut shapes, mut new): (Vec<_>, Vec<_>) = work.into_iter().partition(|(shape, _)| compiled.contains(shape));
    let free = MAX_SPECIALISED.saturating_sub(shapes.len());
    new.sort_by_key(|(_, agent_steps)| Reverse(*agent_steps));
    shapes.extend(new.into_iter().take(free));
    shapes.into_iter().map(|(shape, _)| shape).collect()
}

impl GpuBackend {
    /// Returns the limits of the device and of this backend for a batch.
    pub(super) fn capacity(&self) -> Capacity {
        let limits = &self.gpu.limits;
        Capacity {
            batch: self.batch_bytes,
            kernels: self.kept_kernels,
            buffer: limits.max_buffer_size.min(limits.max_storage_buffer_binding_size).min(MAX_OFFSET),
            workgroup: limits.max_compute_invocations_per_workgroup.min(limits.max_compute_workgroup_size_x) as usize,
            workgroup_bytes: limits.max_compute_workgroup_storage_size as usize,
        }
    }

    /// Returns the shapes that get a specialised kernel.
    pub(super) fn specialised(&self, groups: &[Group<'_>], trace: bool) -> HashSet<Shape> {
        let mut work: BTreeMap<Shape, u64> = BTreeMap::new();
        for group in groups {
            if let Some(workgroup) = Workgroup::specialised(group.world, self.capacity()) {
                let agent_steps = group.team_count() * group.world.agents() * group.world.steps();
                let shape = Shape::specialised(group.world, workgroup, Recorded::of(group, trace));
                *work.entry(shape).or_default() += agent_steps as u64;
            }
        }
        match self.kernel {
            Kernel::Generic => HashSet::new(),
            Kernel::Specialised => work.into_keys().collect(),
            // Traces are not worth a compilation.
            Kernel::Best if trace => HashSet::new(),
            Kernel::Best => worth_compiling(work, &self.pipelines.keys().copied().collect()),
        }
    }

    /// Compiles the kernel that packs records, unless that was done before.
    pub(super) fn prepare_packing(&mut self) -> Result<(), DeviceError> {
        use Binding::{Read, Write};
        if self.pack.is_none() {
            let layout = self.gpu.layout("pack", &[Read, Read, Read, Write, Write])?;
            let pipeline = self.gpu.own_pipeline("pack", &packing(), "pack", &layout)?;
            self.pack = Some((pipeline, layout));
        }
        Ok(())
    }

    /// Compiles the kernels of a batch that are new, side by side. Evicts others if there are too many.
    pub(super) fn prepare_pipelines(&mut self, shapes: &BTreeSet<Shape>) -> Result<(), DeviceError> {
        let new: Vec<Shape> = shapes.iter().filter(|shape| !self.pipelines.contains_key(shape)).copied().collect();
        if self.pipelines.len() + new.len() > self.kept_kernels {
            self.pipelines.retain(|shape, _| shapes.contains(shape));
        }
        let (gpu, layout) = (&self.gpu, &self.layout);
        let compile = |shape: Shape| Ok((shape, gpu.own_pipeline("episode", &source(shape), "episode", layout)?));
        let compiled: Vec<_> = new.into_par_iter().map(compile).collect::<Result<_, DeviceError>>()?;
        self.pipelines.extend(compiled);
        Ok(())
    }
}
