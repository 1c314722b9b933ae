//! Shaders and inputs of one workgroup, to see what compilers make of them.

use super::Records;
use super::plan::{PlannedTask, plan};
use crate::backend::gpu::shape::{Capacity, Kernel, Recorded, Shape, specialised_shapes};
use crate::backend::gpu::source::{Pipeline, State};
use crate::backend::{BackendError, Group, weight_vectors};
use crate::model::Constants;
use crate::world::World;

/// Returns the shader that would play a world, to inspect what compilers make of it: the specialised one if there is
/// one, else the generic one. `threads` is the maximum per workgroup.
#[doc(hidden)]
pub fn shader_of(world: &World, kernel: Kernel, threads: usize) -> String {
    let (capacity, records) = (Capacity::of_workgroups(threads), Recorded { trace: false, sightings: false });
    let specialised = Shape::specialised(world, capacity, records).filter(|_| kernel != Kernel::Generic);
    let (shape, _) = specialised.unwrap_or_else(|| Shape::generic(world, capacity, false));
    Pipeline::Episode(shape).text()
}

/// The inputs and outputs of one workgroup that plays a group's first teams, to run what compilers make of its shader.
#[doc(hidden)]
pub struct WorkgroupBuffers {
    /// The text of the shader.
    pub shader: String,
    /// Threads of the workgroup.
    pub threads: usize,
    /// Teams that it plays.
    pub teams: usize,
    /// The words of each binding: the guard (empty), worlds, tasks, positions, weights; the outputs record, trace
    /// (empty) and states; and the classes.
    pub buffers: [Vec<u32>; 9],
}

/// Returns the workgroup that plays a group's first teams in one dispatch, with policies on the host. It writes the
/// agents' final states, as if another dispatch followed. `threads` is the maximum per workgroup.
///
/// # Errors
/// A team exceeds the limits of any device.
#[doc(hidden)]
pub fn workgroup_of(group: &Group<'_>, kernel: Kernel, threads: usize) -> Result<WorkgroupBuffers, BackendError> {
    let capacity = Capacity::of_workgroups(threads);
    let kernel = if kernel == Kernel::Best { Kernel::Specialised } else { kernel };
    let specialised = specialised_shapes(&[*group], false, kernel, capacity, &|_| false);
    let batches = plan(&[*group], false, Records::Whole, capacity, &specialised)?;
    let batch = &batches[0];
    let (PlannedTask { task, .. }, shape) = (batch.tasks[0], batch.parts[0].shape);
    let mut weights = Vec::new();
    batch.stage(&[*group], &mut weights);
    weights.truncate(task.teams as usize * weight_vectors(group.world));
    let words = |bytes: &[u8]| bytemuck::pod_collect_to_vec(bytes);
    let world = Constants { steps: task.end + 1, ..batch.worlds[0] };
    let agents = group.world.agents() * task.teams as usize;
    Ok(WorkgroupBuffers {
        shader: Pipeline::Episode(shape).text(),
        threads: shape.workgroup,
        teams: task.teams as usize,
        buffers: [
            vec![0; 4],
            words(bytemuck::bytes_of(&world)),
            words(bytemuck::bytes_of(&task)),
            words(bytemuck::cast_slice(&batch.places)),
            words(bytemuck::cast_slice(&weights)),
            vec![0; task.status as usize + 1],
            Vec::new(),
            vec![0; agents * size_of::<State>() / 4],
            words(bytemuck::cast_slice(&batch.classes)),
        ],
    })
}
