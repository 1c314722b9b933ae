//! Populations that stay on the device: the CPU decides who is copied from whom, the device copies and mutates.

use std::fmt;
use std::ops::Range;
use std::sync::Arc;

use bytemuck::Pod;

use super::device::{BINDING_ALIGNMENT, Binding, Bindings, DeviceError, Gpu, grid};
use super::exact;
use crate::backend::{BackendError, Held};
use crate::config::Mutation;
use crate::declare::{Shared, shared};
use crate::evolve::{self, Breeding};

/// Threads of a workgroup.
const WORKGROUP: usize = 256;
/// Weights that a workgroup of `gather` turns at a time, along policies and across them (`TILE` in the shader).
const TILE: usize = 32;
/// Leaders whose policies are gathered together: as many buffers as every WebGPU device binds beside the others.
pub const TOGETHER: usize = 4;
/// Bytes that go to or come from the device at a time, so that as much memory beside the populations is enough.
const PIECE: usize = 64 << 20;

shared! {
    /// How one leader's next generation is made.
    pub struct Brood {
        /// The slots' key, which has the generation and the population in it but not the slot.
        pub key: [u32; 4],
        /// Policies of the leader, the champion's place included.
        pub slots: u32,
        /// Weights of a policy.
        pub parameters: u32,
        /// Where the leader's parents start in the plan.
        pub parents: u32,
        /// Weights whose random word is below it mutate.
        pub threshold: u32,
        /// Not 0 where all weights do.
        pub all: u32,
        /// Whether noise is of a weight's own size.
        pub scaled: u32,
        /// The noise's standard deviation.
        pub sigma: f32,
    }

    /// Some leaders' policies in some teams of one group, which tasks share.
    pub struct Stretch {
        /// Leaders of a team.
        pub leaders: u32,
        /// The first of those gathered.
        pub first: u32,
        /// How many are gathered, up to [`TOGETHER`].
        pub count: u32,
        /// Weights of a policy.
        pub parameters: u32,
        /// Teams of the group that these tasks play.
        pub teams: u32,
        /// Every task has so many, the last what is left.
        pub teams_a_task: u32,
        /// Where the teams' choices of policies start in their buffer.
        pub choices: u32,
        /// Where the weights go in theirs.
        pub weights: u32,
    }
}

impl Stretch {
    /// Workgroups that it takes.
    pub fn tiles(&self) -> usize {
        (self.teams as usize * self.count as usize).div_ceil(TILE) * (self.parameters as usize).div_ceil(TILE)
    }
}

/// What works on the populations of one device.
pub struct Kernels {
    gpu: Gpu,
    breed: (wgpu::ComputePipeline, Bindings),
    gather: (wgpu::ComputePipeline, Bindings),
}

/// One dispatch, with all that it uses.
pub type Dispatch<'a> = (&'a wgpu::ComputePipeline, wgpu::BindGroup, [u32; 3]);

impl fmt::Debug for Kernels {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Kernels").field("gpu", &self.gpu).finish_non_exhaustive()
    }
}

impl Kernels {
    /// Compiles them; `edit` changes the shader's text.
    ///
    /// # Errors
    /// The device does not take them.
    pub fn new(gpu: Gpu, edit: fn(String) -> String) -> Result<Kernels, DeviceError> {
        use Binding::{Read, Write};
        let text = edit(source());
        let pipeline = |entry, buffers: &[Binding]| -> Result<_, DeviceError> {
            let layout = gpu.layout(entry, buffers)?;
            Ok((gpu.own_pipeline(entry, &text, entry, &layout)?, layout))
        };
        let breed = pipeline("breed", &[Read, Read, Read, Write])?;
        let gather = pipeline("gather", &[Read, Read, Read, Write, Read, Read, Read])?;
        Ok(Kernels { breed, gather, gpu })
    }

    /// Takes the populations of a trial, `[leaders][slots][parameters]`, of a size that fits a buffer a leader.
    ///
    /// # Errors
    /// They do not fit the device.
    pub fn hold(
        self: &Arc<Kernels>,
        weights: &[f32],
        [leaders, slots, parameters]: [usize; 3],
    ) -> Result<Population, DeviceError> {
        use wgpu::BufferUsages as Usage;
        let size = slots * parameters;
        let (gpu, usage) = (&self.gpu, Usage::STORAGE | Usage::COPY_SRC | Usage::COPY_DST);
        let buffer = |_| gpu.buffer("a population", (size * size_of::<f32>()) as u64, usage);
        let buffers = (0..=leaders).map(buffer).collect::<Result<Vec<_>, _>>()?;
        let input = Usage::STORAGE | Usage::COPY_DST;
        let broods = gpu.buffer("broods", (leaders * BINDING_ALIGNMENT) as u64, input)?;
        let plan = gpu.buffer("the parents", (leaders * slots * size_of::<u32>()) as u64, input)?;
        for (buffer, weights) in buffers.iter().zip(weights.chunks_exact(size)) {
            for (index, piece) in weights.chunks(PIECE / size_of::<f32>()).enumerate() {
                let bytes = bytemuck::cast_slice(piece);
                gpu.scoped("a population", || {
                    gpu.write(buffer, (index * PIECE) as u64, bytes);
                    gpu.queue.submit([]);
                })?;
                gpu.wait()?;
            }
        }
        Ok(Population { kernels: self.clone(), buffers, broods, plan, leaders, slots, parameters })
    }

    /// The dispatch that lays out a stretch of teams: the stretch stands alone in its part of a buffer.
    ///
    /// # Errors
    /// The device does not take the buffers.
    pub fn gather(
        &self,
        (stretches, part): (&wgpu::Buffer, usize),
        stretch: &Stretch,
        choices: &wgpu::Buffer,
        population: &Population,
        weights: &wgpu::Buffer,
    ) -> Result<Dispatch<'_>, DeviceError> {
        // Where there are fewer leaders, nobody reads the buffers that are left.
        let last = population.leaders - 1;
        let leader = |index: u32| {
            let leader = (stretch.first + index.min(stretch.count - 1)) as usize;
            // All leaders may choose from the same.
            &population.buffers[leader.min(last)]
        };
        let [first, second, third, fourth] = [0, 1, 2, 3].map(|index| leader(index).as_entire_buffer_binding());
        let (choices, weights) = (choices.as_entire_buffer_binding(), weights.as_entire_buffer_binding());
        let buffers = [part_of::<Stretch>(stretches, part), choices, first, weights, second, third, fourth];
        let group = self.gpu.bind("gather", &self.gather.1, &buffers)?;
        Ok((&self.gather.0, group, grid(stretch.tiles(), &self.gpu.limits)))
    }
}

/// Structs one after another, each from where a binding may start.
pub fn parts<T: Pod>(structs: &[T]) -> Vec<u8> {
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
pub struct Population {
    kernels: Arc<Kernels>,
    /// A leader's policies each, `[slots][parameters]`, and room for one leader's more.
    buffers: Vec<wgpu::Buffer>,
    broods: wgpu::Buffer,
    plan: wgpu::Buffer,
    leaders: usize,
    slots: usize,
    parameters: usize,
}

impl Population {
    /// Whether these kernels may work on it.
    pub fn is_of(&self, kernels: &Arc<Kernels>) -> bool {
        Arc::ptr_eq(&self.kernels, kernels)
    }

    /// Whether teams of these sizes, `[leaders, slots, parameters]`, may choose from it.
    ///
    /// # Errors
    /// It has others.
    pub fn check(&self, sizes: [usize; 3]) -> Result<(), BackendError> {
        let own = [if self.leaders == 1 { sizes[0] } else { self.leaders }, self.slots, self.parameters];
        let text = || format!("populations of {own:?} leaders, policies and weights stand for some of {sizes:?}");
        if own == sizes { Ok(()) } else { Err(BackendError::InvalidInput(text())) }
    }

    /// Bytes of the pieces that one leader's policies come back in.
    fn pieces(&self) -> impl Iterator<Item = Range<usize>> + use<> {
        let size = self.slots * self.parameters * size_of::<f32>();
        (0..size).step_by(PIECE).map(move |start| start..size.min(start + PIECE))
    }
}

impl Held for Population {
    fn breed(&mut self, breeding: &Breeding<'_>) -> Result<(), BackendError> {
        breeding.check([self.leaders, self.slots, self.parameters])?;
        let Kernels { gpu, breed: (pipeline, layout), .. } = &*self.kernels;
        let Breeding { parents, key, generation, learning } = *breeding;
        let threshold = evolve::mutation_threshold(learning.mutation_probability);
        let broods: Vec<Brood> = (0..self.leaders)
            .map(|leader| Brood {
                key: key.of_population(generation, leader),
                slots: self.slots as u32,
                parameters: self.parameters as u32,
                parents: (leader * self.slots) as u32,
                threshold: threshold.unwrap_or_default(),
                all: u32::from(threshold.is_none()),
                scaled: u32::from(learning.mutation == Mutation::Scaled),
                sigma: learning.mutation_sigma as f32,
            })
            .collect();
        let threads = self.slots * self.parameters.div_ceil(64) * 16;
        let [x, y, z] = grid(threads.div_ceil(WORKGROUP), &gpu.limits);
        // A leader's children go where the leader before had its parents, the first one's into the free room.
        let homes = std::iter::once(&self.buffers[self.leaders]).chain(&self.buffers);
        let mut groups = Vec::with_capacity(self.leaders);
        for (leader, (policies, children)) in self.buffers[..self.leaders].iter().zip(homes).enumerate() {
            let buffers = [
                part_of::<Brood>(&self.broods, leader),
                self.plan.as_entire_buffer_binding(),
                policies.as_entire_buffer_binding(),
                children.as_entire_buffer_binding(),
            ];
            groups.push(gpu.bind("breed", layout, &buffers)?);
        }
        gpu.scoped("breeding", || {
            gpu.write(&self.broods, 0, &parts(&broods));
            gpu.write(&self.plan, 0, bytemuck::cast_slice(parents));
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            let mut pass = encoder.begin_compute_pass(&Default::default());
            pass.set_pipeline(pipeline);
            for group in &groups {
                pass.set_bind_group(0, group, &[]);
                pass.dispatch_workgroups(x, y, z);
            }
            drop(pass);
            gpu.queue.submit([encoder.finish()]);
        })?;
        self.buffers.rotate_right(1);
        Ok(())
    }

    fn fetch(&self, weights: &mut [f32]) -> Result<(), BackendError> {
        let policies = weights.chunks_exact_mut(self.slots * self.parameters);
        for (buffer, policies) in self.buffers.iter().zip(policies) {
            for bytes in self.pieces() {
                let piece = self.kernels.gpu.read::<f32>(buffer, bytes.start as u64..bytes.end as u64)?;
                policies[bytes.start / size_of::<f32>()..][..piece.len()].copy_from_slice(&piece);
            }
        }
        Ok(())
    }
}

/// The whole shader, with what it has in front.
fn source() -> String {
    exact::assemble(&[
        &format!("const WORKGROUP: u32 = {WORKGROUP}u;"),
        &[Brood::wgsl(), Stretch::wgsl()].concat(),
        include_str!("../../../shaders/lib/math.wgsl"),
        include_str!("../../../shaders/population.wgsl"),
    ])
}

/// The shader, for the lints.
pub fn shaders() -> Vec<(&'static str, String)> {
    vec![("population", source())]
}
