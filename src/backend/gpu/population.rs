//! Populations that stay on the device. The host plans the parent of each slot; the device copies and mutates.

use std::ops::Range;

use super::device::{DeviceError, Executor, Workspace};
use super::recording::{BINDING_ALIGNMENT, Buffer, Command, Recording, Slice, grid};
use super::source::{BreedJob, POPULATION_WORKGROUP, Pipeline};
use crate::backend::{BackendError, DevicePopulation};
use crate::config::Mutation;
use crate::evolve::{self, Breeding};
use crate::parallel::*;

/// Bytes that one thread copies at a time.
const COPIED_TOGETHER: usize = 1 << 20;
/// Bytes per transfer, so that little memory is needed besides the populations.
const MAX_TRANSFER: usize = 64 << 20;

/// The state of a trial's populations on a device, as far as plans depend on it.
#[derive(Clone, Debug)]
pub(super) struct Held {
    /// `[populations, slots, parameters]`.
    pub(super) sizes: [usize; 3],
    /// The index of the first population's buffer. The others follow, and one more for children.
    pub(super) turn: usize,
    /// The status words if everything was done that was submitted: per population the number of workgroups that have
    /// bred, then the nonces of the pieces that were copied to the device. One more word is for the nonce of the last
    /// copy to the host.
    pub(super) status: Vec<u32>,
}

impl Held {
    /// Returns the buffer of a population.
    fn index_of(&self, population: usize) -> usize {
        (self.turn + population) % (self.sizes[0] + 1)
    }

    /// Returns the policies of a population, for a group.
    pub(super) fn policies_of(&self, group: usize, population: usize) -> Slice {
        Slice { buffer: Buffer::GroupPolicies(group, self.index_of(population)), bytes: 0..self.bytes() }
    }

    /// Returns the bytes per buffer.
    fn bytes(&self) -> u64 {
        let [_, slots, parameters] = self.sizes;
        ((slots * parameters * size_of::<f32>()) as u64).max(BINDING_ALIGNMENT as u64)
    }

    /// Returns the ranges of weights in which one population is transferred.
    fn pieces(&self) -> impl Iterator<Item = Range<usize>> + use<> {
        let ([_, slots, parameters], most) = (self.sizes, MAX_TRANSFER / size_of::<f32>());
        (0..slots * parameters).step_by(most).map(move |start| start..(start + most).min(slots * parameters))
    }

    /// Returns what breeds the next generation, and notes what that changes. Children replace the parents of the
    /// population before; those of the first go to the spare buffer.
    fn record_breeding<'a>(&mut self, breeding: &Breeding<'a>, most_workgroups: u32) -> Recording<'a> {
        let [populations, slots, parameters] = self.sizes;
        let Breeding { parents, key, generation, learning } = *breeding;
        let threshold = evolve::mutation_threshold(learning.mutation_probability);
        let job = |population: usize| BreedJob {
            key: key.of_population(generation, population),
            slots: slots as u32,
            parameters: parameters as u32,
            population: population as u32,
            parents: (population * slots) as u32,
            threshold: threshold.unwrap_or_default(),
            all: u32::from(threshold.is_none()),
            scaled: u32::from(learning.mutation == Mutation::Scaled),
            sigma: learning.mutation_sigma as f32,
        };
        let mut recording = Recording::new("breeding");
        let jobs = recording.jobs(Buffer::Jobs, &(0..populations).map(job).collect::<Vec<_>>());
        let plan = recording.input(Buffer::Parents, parents);
        let status = Slice { buffer: Buffer::Status, bytes: 0..status_bytes(self.status.len()) };
        let threads = slots * parameters.div_ceil(64) * 16;
        let grid = grid(threads.div_ceil(POPULATION_WORKGROUP), most_workgroups);
        for (population, job) in jobs.into_iter().enumerate() {
            let [policies, children] = [population, population + populations].map(|index| Slice {
                buffer: Buffer::Policies((self.turn + index) % (populations + 1)),
                bytes: 0..self.bytes(),
            });
            let bindings = vec![job, plan.clone(), policies, children, status.clone()];
            recording.commands.push(Command::Dispatch { pipeline: Pipeline::Breed, bindings, grid, iterations: 0 });
        }
        self.turn = (self.turn + populations) % (populations + 1);
        let workgroups = grid.iter().product();
        self.status[..populations].iter_mut().for_each(|count| *count = count.wrapping_add(workgroups));
        recording
    }
}

/// Returns the bytes of the buffer of `words` status words and the nonce of the last copy.
fn status_bytes(words: usize) -> u64 {
    (((words + 1) * size_of::<u32>()) as u64).max(BINDING_ALIGNMENT as u64)
}

/// The populations of one trial in a device's memory.
#[derive(Debug)]
pub(super) struct Population {
    executor: Executor,
    pub(super) workspace: Workspace,
    pub(super) held: Held,
}

impl Population {
    /// Copies populations, `[populations][slots][parameters]`, to the device. Each must fit into one buffer.
    ///
    /// # Errors
    /// They do not fit the device.
    pub(super) fn new(executor: Executor, weights: &[f32], sizes: [usize; 3]) -> Result<Population, DeviceError> {
        let [populations, slots, parameters] = sizes;
        let mut held = Held { sizes, turn: 0, status: vec![0; populations] };
        let pieces: Vec<_> = held.pieces().collect();
        let words = populations * (pieces.len() + 1);
        let (mut workspace, bytes) = (Workspace::default(), held.bytes());
        for (population, weights) in weights.chunks_exact(slots * parameters).enumerate() {
            for piece in &pieces {
                let mut recording = Recording::new("a population");
                (0..=populations).for_each(|index| _ = recording.buffer(Buffer::Policies(index), bytes));
                recording.buffer(Buffer::Status, status_bytes(words));
                let offset = (piece.start * size_of::<f32>()) as u64;
                recording.upload(Buffer::Policies(population), offset, &weights[piece.clone()]);
                let (nonce, offset) = (executor.gpu.nonces(1), held.status.len() * size_of::<u32>());
                recording.upload(Buffer::Status, offset as u64, vec![nonce]);
                executor.run(&recording, &mut workspace, &[])?;
                executor.gpu.wait()?;
                held.status.push(nonce);
            }
        }
        Ok(Population { executor, workspace, held })
    }

    /// Reports whether a backend with this executor may play it.
    pub(super) fn is_of(&self, executor: &Executor) -> bool {
        self.executor.is_clone_of(executor)
    }

    /// Checks that it has these sizes, `[populations, slots, parameters]`.
    ///
    /// # Errors
    /// The sizes differ.
    pub(super) fn check(&self, sizes: [usize; 3]) -> Result<(), BackendError> {
        let own = self.held.sizes;
        let text = || format!("populations of sizes {own:?} (populations, slots, parameters) instead of {sizes:?}");
        if own == sizes { Ok(()) } else { Err(BackendError::InvalidInput(text())) }
    }
}

impl DevicePopulation for Population {
    fn breed(&mut self, breeding: &Breeding<'_>) -> Result<(), BackendError> {
        breeding.check(self.held.sizes)?;
        let most = self.executor.gpu.limits.max_compute_workgroups_per_dimension;
        let recording = self.held.record_breeding(breeding, most);
        self.executor.run(&recording, &mut self.workspace, &[])?;
        Ok(())
    }

    fn fetch(&self, weights: &mut [f32]) -> Result<(), BackendError> {
        let (gpu, [_, slots, parameters]) = (&self.executor.gpu, self.held.sizes);
        // The copies share a buffer, because drivers take long to create one.
        let mut workspace = Workspace::default();
        for (population, policies) in weights.chunks_exact_mut(slots * parameters).enumerate() {
            for piece in self.held.pieces() {
                // The status comes with each piece, so that neither the breeding nor the copy can be missing.
                let status = [&self.held.status[..], &[gpu.nonces(1)]].concat();
                let bytes = |count: usize| (count * size_of::<f32>()) as u64;
                let mut recording = Recording::new("reading back");
                recording.upload(Buffer::GroupStatus(0), bytes(status.len() - 1), &status[status.len() - 1..]);
                let buffer = Buffer::GroupPolicies(0, self.held.index_of(population));
                let back = recording.read_back(Slice { buffer, bytes: bytes(piece.start)..bytes(piece.end) });
                recording.read_status(Buffer::GroupStatus(0), &status);
                let submitted = self.executor.run(&recording, &mut workspace, &[Some(&self.workspace)])?;
                self.executor.read(&submitted, &workspace, &recording.readback, |read| {
                    // All threads copy, because the host's memory may be new, and the system then clears it page by page.
                    let target = bytemuck::cast_slice_mut::<f32, u8>(&mut policies[piece]);
                    let parts = read[back].par_chunks(COPIED_TOGETHER);
                    target.par_chunks_mut(COPIED_TOGETHER).zip(parts).for_each(|(to, from)| to.copy_from_slice(from));
                })?;
            }
        }
        Ok(())
    }
}
