//! Populations that stay on the device. The host plans the parent of each slot; the device copies and mutates.

use std::fmt;
use std::ops::Range;
use std::sync::Arc;

use bytemuck::Pod;

use super::device::{BINDING_ALIGNMENT, Binding, Bindings, DeviceError, Gpu, grid};
use super::exact;
use crate::backend::{BackendError, DevicePopulation};
use crate::config::Mutation;
use crate::evolve::{self, Breeding, MAX_WEIGHT, MIN_WEIGHT, UNCHANGED};
use crate::gpu_struct::{GpuStruct, gpu_constants, gpu_struct};
use crate::parallel::*;

/// Threads per workgroup.
const WORKGROUP: usize = 256;
/// Rows and columns of the tile that a workgroup of `gather` transposes.
const TILE: usize = 32;
/// Leaders per gather dispatch. With three other storage buffers they stay below the 8 that every WebGPU device allows.
pub(super) const LEADERS_PER_GATHER: usize = 4;
/// Bytes that one thread copies at a time.
const COPIED_TOGETHER: usize = 1 << 20;
/// Bytes per transfer, so that little memory is needed besides the populations.
const MAX_TRANSFER: usize = 64 << 20;

gpu_struct! {
    /// How to breed one population's next generation.
    pub struct BreedJob {
        /// The slots' key before the slot is xored in, see [`Key::of_population`](crate::evolve::Key::of_population).
        pub key: [u32; 4],
        /// Slots per population.
        pub slots: u32,
        /// Weights per policy.
        pub parameters: u32,
        /// The index of the population.
        pub population: u32,
        /// The offset of its parents in the plan.
        pub parents: u32,
        /// A weight mutates if its random word is below this threshold.
        pub threshold: u32,
        /// Not 0 if every weight mutates.
        pub all: u32,
        /// Not 0 if noise scales with the weight.
        pub scaled: u32,
        /// The standard deviation of the noise.
        pub sigma: f32,
    }

    /// A request to gather policies for consecutive tasks of one group.
    pub struct GatherJob {
        /// Leaders per team.
        pub leaders: u32,
        /// The first leader to gather.
        pub first: u32,
        /// Leaders to gather, up to 4 (`LEADERS_PER_GATHER`).
        pub count: u32,
        /// Weights per policy.
        pub parameters: u32,
        /// Teams of these tasks.
        pub teams: u32,
        /// Teams per task. The last task has the remainder.
        pub teams_per_task: u32,
        /// The offset of the teams' policies in their buffer.
        pub choices: u32,
        /// The offset of the output.
        pub weights: u32,
    }
}

impl GatherJob {
    /// Returns the number of workgroups.
    pub(super) fn tiles(&self) -> usize {
        (self.teams as usize * self.count as usize).div_ceil(TILE) * (self.parameters as usize).div_ceil(TILE)
    }
}

/// The kernels that work on the populations of one device.
pub(super) struct Kernels {
    gpu: Gpu,
    breed: (wgpu::ComputePipeline, Bindings),
    gather: (wgpu::ComputePipeline, Bindings),
}

/// A pipeline, its bindings and its workgroups.
pub(super) type Dispatch = (wgpu::ComputePipeline, wgpu::BindGroup, [u32; 3]);

impl fmt::Debug for Kernels {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Kernels").field("gpu", &self.gpu).finish_non_exhaustive()
    }
}

impl Kernels {
    /// Compiles the kernels.
    ///
    /// # Errors
    /// The device does not support them.
    pub(super) fn new(gpu: Gpu) -> Result<Kernels, DeviceError> {
        use Binding::{Read, Write};
        let text = source();
        let pipeline = |entry, buffers: &[Binding]| -> Result<_, DeviceError> {
            let layout = gpu.layout(entry, buffers)?;
            Ok((gpu.own_pipeline(entry, &text, entry, &layout)?, layout))
        };
        let breed = pipeline("breed", &[Read, Read, Read, Write, Write])?;
        let gather = pipeline("gather", &[Read, Read, Read, Write, Read, Read, Read])?;
        Ok(Kernels { breed, gather, gpu })
    }

    /// Copies the populations of a trial, `[populations][slots][parameters]`, to the device. Each must fit into one
    /// buffer.
    ///
    /// # Errors
    /// They do not fit the device.
    pub(super) fn hold(self: &Arc<Kernels>, weights: &[f32], sizes: [usize; 3]) -> Result<Population, DeviceError> {
        use wgpu::BufferUsages as Usage;
        let [populations, slots, parameters] = sizes;
        let size = slots * parameters;
        let (gpu, usage) = (&self.gpu, Usage::STORAGE | Usage::COPY_SRC | Usage::COPY_DST);
        let buffer = |_| gpu.buffer("a population", (size * size_of::<f32>()) as u64, usage);
        let buffers = (0..=populations).map(buffer).collect::<Result<Vec<_>, _>>()?;
        let input = Usage::STORAGE | Usage::COPY_DST;
        let breed_jobs = gpu.buffer("the breeding jobs", (populations * BINDING_ALIGNMENT) as u64, input)?;
        let plan = gpu.buffer("the parents", (populations * slots * size_of::<u32>()) as u64, input)?;
        let pieces = weights.chunks_exact(size).zip(&buffers).flat_map(|(weights, buffer)| {
            let pieces = weights.chunks(MAX_TRANSFER / size_of::<f32>()).enumerate();
            pieces.map(move |(index, piece)| (buffer, index, piece))
        });
        let mut done = vec![0; populations];
        let words = populations + populations * size.div_ceil(MAX_TRANSFER / size_of::<f32>()) + 1;
        let status = gpu.buffer("the status of a population", (words * size_of::<u32>()) as u64, usage)?;
        for (buffer, index, piece) in pieces {
            let nonce = gpu.nonces(1);
            let writes: [(_, _, &[u8]); 2] = [
                (buffer, index * MAX_TRANSFER, bytemuck::cast_slice(piece)),
                (&status, done.len() * size_of::<u32>(), &nonce.to_ne_bytes()),
            ];
            gpu.scoped("a population", || gpu.submit_writes("a population", &writes))?;
            gpu.wait()?;
            done.push(nonce);
        }
        Ok(Population { kernels: self.clone(), buffers, breed_jobs, plan, status, done, sizes })
    }

    /// Returns the dispatch that gathers the policies of a job. The job is an aligned element of a buffer, `(buffer,
    /// index)`.
    ///
    /// # Errors
    /// The device does not support the buffers.
    pub(super) fn gather(
        &self,
        (jobs, part): (&wgpu::Buffer, usize),
        job: &GatherJob,
        choices: &wgpu::Buffer,
        (population, populations): (&Population, &[u32]),
        weights: &wgpu::Buffer,
    ) -> Result<Dispatch, DeviceError> {
        // With fewer leaders, the remaining bindings are not read.
        let leader = |index: u32| {
            let leader = (job.first + index.min(job.count - 1)) as usize;
            &population.buffers[populations[leader] as usize]
        };
        let [first, second, third, fourth] = [0, 1, 2, 3].map(|index| leader(index).as_entire_buffer_binding());
        let (choices, weights) = (choices.as_entire_buffer_binding(), weights.as_entire_buffer_binding());
        let buffers = [part_of::<GatherJob>(jobs, part), choices, first, weights, second, third, fourth];
        let group = self.gpu.bind("gather", &self.gather.1, &buffers)?;
        Ok((self.gather.0.clone(), group, grid(job.tiles(), &self.gpu.limits)))
    }
}

/// Returns the bytes of structs, each aligned so that a binding may start there.
pub(super) fn parts<T: Pod>(structs: &[T]) -> Vec<u8> {
    let mut bytes = vec![0; structs.len() * BINDING_ALIGNMENT];
    for (part, one) in bytes.chunks_exact_mut(BINDING_ALIGNMENT).zip(structs) {
        part[..size_of::<T>()].copy_from_slice(bytemuck::bytes_of(one));
    }
    bytes
}

fn part_of<T>(buffer: &wgpu::Buffer, part: usize) -> wgpu::BufferBinding<'_> {
    let offset = (part * BINDING_ALIGNMENT) as u64;
    wgpu::BufferBinding { buffer, offset, size: wgpu::BufferSize::new(size_of::<T>() as u64) }
}

/// The populations of one trial in a device's memory.
#[derive(Debug)]
pub(super) struct Population {
    kernels: Arc<Kernels>,
    /// One buffer per population, `[slots][parameters]`, and one more for the children of the first.
    buffers: Vec<wgpu::Buffer>,
    breed_jobs: wgpu::Buffer,
    plan: wgpu::Buffer,
    /// Per population the number of workgroups that have bred, then the nonces of the pieces that were copied to the
    /// device, then the nonce of the last copy to the host.
    status: wgpu::Buffer,
    /// The content of `status` before its last word, if everything was done that was submitted.
    done: Vec<u32>,
    /// `[populations, slots, parameters]`.
    sizes: [usize; 3],
}

impl Population {
    /// Reports whether these kernels may work on it.
    pub(super) fn is_of(&self, kernels: &Arc<Kernels>) -> bool {
        Arc::ptr_eq(&self.kernels, kernels)
    }

    /// Checks that it has these sizes, `[populations, slots, parameters]`.
    ///
    /// # Errors
    /// The sizes differ.
    pub(super) fn check(&self, sizes: [usize; 3]) -> Result<(), BackendError> {
        let own = self.sizes;
        let text = || format!("populations of sizes {own:?} (populations, slots, parameters) instead of {sizes:?}");
        if own == sizes { Ok(()) } else { Err(BackendError::InvalidInput(text())) }
    }

    /// Returns the buffer of status words, and their values if everything was done that was submitted.
    pub(super) fn status(&self) -> (&wgpu::Buffer, &[u32]) {
        (&self.status, &self.done)
    }

    /// Returns the weights per population.
    fn population_len(&self) -> usize {
        let [_, slots, parameters] = self.sizes;
        slots * parameters
    }

    /// Returns the byte ranges in which one population is transferred.
    fn pieces(&self) -> impl Iterator<Item = Range<usize>> + use<> {
        let size = self.population_len() * size_of::<f32>();
        (0..size).step_by(MAX_TRANSFER).map(move |start| start..size.min(start + MAX_TRANSFER))
    }
}

impl DevicePopulation for Population {
    fn breed(&mut self, breeding: &Breeding<'_>) -> Result<(), BackendError> {
        breeding.check(self.sizes)?;
        let [populations, slots, parameters] = self.sizes;
        let Kernels { gpu, breed: (pipeline, layout), .. } = &*self.kernels;
        let Breeding { parents, key, generation, learning } = *breeding;
        let threshold = evolve::mutation_threshold(learning.mutation_probability);
        let breed_jobs: Vec<BreedJob> = (0..populations)
            .map(|population| BreedJob {
                key: key.of_population(generation, population),
                slots: slots as u32,
                parameters: parameters as u32,
                population: population as u32,
                parents: (population * slots) as u32,
                threshold: threshold.unwrap_or_default(),
                all: u32::from(threshold.is_none()),
                scaled: u32::from(learning.mutation == Mutation::Scaled),
                sigma: learning.mutation_sigma as f32,
            })
            .collect();
        let threads = slots * parameters.div_ceil(64) * 16;
        let [x, y, z] = grid(threads.div_ceil(WORKGROUP), &gpu.limits);
        // A population's children replace the parents of the one before it. Those of the first go to the spare buffer.
        let destinations = std::iter::once(&self.buffers[populations]).chain(&self.buffers);
        let mut groups = Vec::with_capacity(populations);
        for (index, (policies, children)) in self.buffers[..populations].iter().zip(destinations).enumerate() {
            let buffers = [
                part_of::<BreedJob>(&self.breed_jobs, index),
                self.plan.as_entire_buffer_binding(),
                policies.as_entire_buffer_binding(),
                children.as_entire_buffer_binding(),
                self.status.as_entire_buffer_binding(),
            ];
            groups.push(gpu.bind("breed", layout, &buffers)?);
        }
        gpu.scoped("breeding", || {
            gpu.write(&self.breed_jobs, 0, &parts(&breed_jobs));
            gpu.write(&self.plan, 0, bytemuck::cast_slice(parents));
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            let mut pass = encoder.begin_compute_pass(&Default::default());
            pass.set_pipeline(pipeline);
            for group in &groups {
                pass.set_bind_group(0, group, &[]);
                pass.dispatch_workgroups(x, y, z);
            }
            drop(pass);
            gpu.submit_commands("breeding", 0, encoder);
        })?;
        self.buffers.rotate_right(1);
        self.done[..populations].iter_mut().for_each(|workgroups| *workgroups = workgroups.wrapping_add(x * y * z));
        Ok(())
    }

    fn fetch(&self, weights: &mut [f32]) -> Result<(), BackendError> {
        let gpu = &self.kernels.gpu;
        let largest = self.pieces().next().map_or(0, |bytes| bytes.len() as u64);
        let readback_buffer = gpu.readback_buffer(largest + self.status.size())?;
        let policies = weights.chunks_exact_mut(self.population_len());
        for (buffer, policies) in self.buffers.iter().zip(policies) {
            for bytes in self.pieces() {
                // The status comes with each piece, so that neither the breeding nor the copy can be missing.
                let expected = [&self.done[..], &[gpu.nonces(1)]].concat();
                let [nonce_at, end] = [self.done.len(), expected.len()].map(|words| (words * size_of::<u32>()) as u64);
                let nonce = bytemuck::bytes_of(&expected[self.done.len()]);
                gpu.scoped("reading back", || gpu.write(&self.status, nonce_at, nonce))?;
                let ranges = [(buffer, bytes.start as u64..bytes.end as u64), (&self.status, 0..end)];
                let is_done = gpu.read_through(&readback_buffer, &ranges, |read| {
                    let (piece, status) = read.split_at(bytes.len());
                    // All threads copy, because the host's memory may be new, and the system then clears it page by page.
                    let target = &mut bytemuck::cast_slice_mut::<f32, u8>(policies)[bytes.clone()];
                    let parts = target.par_chunks_mut(COPIED_TOGETHER).zip(piece.par_chunks(COPIED_TOGETHER));
                    parts.for_each(|(to, from)| to.copy_from_slice(from));
                    status == bytemuck::cast_slice::<u32, u8>(&expected)
                })?;
                if !is_done {
                    return Err(gpu.lose_undone("breeding").into());
                }
            }
        }
        Ok(())
    }
}

/// Returns the whole shader.
fn source() -> String {
    exact::assemble(&[
        &gpu_constants!(WORKGROUP, TILE, UNCHANGED, MIN_WEIGHT, MAX_WEIGHT),
        &[BreedJob::wgsl(), GatherJob::wgsl()].concat(),
        include_str!("../../../shaders/lib/math.wgsl"),
        include_str!("../../../shaders/population.wgsl"),
    ])
}

/// Returns the shader and its name.
pub(super) fn shaders() -> Vec<(&'static str, String)> {
    vec![("population", source())]
}
