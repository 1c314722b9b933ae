//! GPU work as data: a [`Recording`] lists what to upload, dispatch and read back.
//!
//! Planning is pure. It turns groups of teams or a breeding plan into recordings, with the size of every buffer and the
//! range of every binding, and needs no device. So tests check plans where there is no GPU. Buffers and pipelines are
//! ids. The [`Executor`](super::device::Executor) alone turns them into objects of wgpu, catches errors, waits, and
//! notices work that a device did not do.
//!
//! ```text
//! groups ─▶ plan ─▶ batches ─▶ Recording ─▶ Executor ─▶ bytes read back ─▶ scores
//! ```
//!
//! A recording has one or several submissions. All uploads of a submission come before its dispatches, and these before
//! the copies that are read back. Results end with status words, which the work itself writes: see
//! [`Gpu::nonces`](super::device::Gpu::nonces).

use std::borrow::Cow;
use std::collections::HashSet;
use std::ops::Range;

use bytemuck::Pod;

use super::source::Pipeline;

/// Offsets of bindings are multiples of this many bytes on every WebGPU device. No buffer is smaller.
pub const BINDING_ALIGNMENT: usize = 256;

/// A buffer of a recording.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Buffer {
    /// The worlds of a batch.
    Worlds,
    /// The tasks of a batch, for all its dispatches.
    Tasks,
    /// Start positions, POI positions and headings.
    Places,
    /// The weights of a batch's teams.
    Weights,
    /// The record of a batch.
    Record,
    /// The moments and inputs of a trace.
    Traced,
    /// The classes of a batch's worlds.
    Classes,
    /// The agents' states between two dispatches.
    States,
    /// The coupling, worth and observers of POIs.
    Scoring,
    /// The sums of a batch's records.
    Counted,
    /// The jobs of gathering or breeding, each aligned.
    Jobs,
    /// The policies that the teams of a batch play.
    Choices,
    /// The parent of each slot.
    Parents,
    /// One of the buffers of a population, by its index.
    Policies(usize),
    /// The status words of populations.
    Status,
    /// One of the populations that a group plays, by the indices of group and buffer.
    GroupPolicies(usize, usize),
    /// The status words of the populations that a group plays.
    GroupStatus(usize),
    /// The input of a probe or of a measurement.
    Input,
    /// The number of iterations of a measurement.
    Iterations,
    /// The output of a probe or of a measurement.
    Output,
    /// The copies that the host reads.
    Readback,
}

/// A range of a buffer, in bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Slice {
    /// The buffer.
    pub buffer: Buffer,
    /// The range. Its start is aligned if a pipeline uses it, else both ends are multiples of 4.
    pub bytes: Range<u64>,
}

/// One command of a recording.
#[derive(Clone, Debug)]
pub enum Command<'a> {
    /// Writes to a buffer.
    Upload {
        /// The buffer.
        to: Buffer,
        /// The offset in the buffer, in bytes.
        offset: u64,
        /// The bytes.
        bytes: Cow<'a, [u8]>,
    },
    /// Runs a pipeline.
    Dispatch {
        /// The pipeline.
        pipeline: Pipeline,
        /// The pipeline's buffers, in the order of its bindings.
        bindings: Vec<Slice>,
        /// The workgroups in each dimension.
        grid: [u32; 3],
        /// The estimated work: loop iterations over all threads. 0 for short work.
        iterations: u64,
    },
    /// Copies to [`Buffer::Readback`].
    ReadBack {
        /// The source.
        from: Slice,
        /// The offset in [`Buffer::Readback`], in bytes.
        offset: u64,
    },
    /// Ends a submission. The last one needs no such end.
    Submit,
}

/// Work for a device.
#[derive(Clone, Debug)]
pub struct Recording<'a> {
    /// The name for messages.
    pub what: &'static str,
    /// The buffers, and their minimum sizes in bytes. Contents of an existing buffer remain if it is large enough.
    pub buffers: Vec<(Buffer, u64)>,
    /// The commands, in order.
    pub commands: Vec<Command<'a>>,
    /// The bytes that the host reads.
    pub readback: Readback,
}

/// The bytes that a recording copies to the host.
#[derive(Clone, Debug, Default)]
pub struct Readback {
    /// The bytes of [`Buffer::Readback`].
    pub bytes: u64,
    /// The status words: where each is, in bytes, and its value if the device did the work.
    pub status: Vec<(usize, u32)>,
}

/// Returns the estimated work of some commands.
pub(super) fn iterations(commands: &[Command<'_>]) -> u64 {
    let of = |command: &Command<'_>| match command {
        Command::Dispatch { iterations, .. } => *iterations,
        _ => 0,
    };
    commands.iter().map(of).sum()
}

impl<'a> Recording<'a> {
    /// Returns an empty recording.
    pub fn new(what: &'static str) -> Recording<'a> {
        Recording { what, buffers: Vec::new(), commands: Vec::new(), readback: Readback::default() }
    }

    /// Adds a buffer of `bytes` bytes, and returns all of it.
    pub fn buffer(&mut self, buffer: Buffer, bytes: u64) -> Slice {
        let bytes = bytes.max(BINDING_ALIGNMENT as u64);
        self.buffers.push((buffer, bytes));
        Slice { buffer, bytes: 0..bytes }
    }

    /// Adds a buffer that starts with some items, and returns all of it.
    pub fn input<T: Pod>(&mut self, to: Buffer, items: impl Into<Cow<'a, [T]>>) -> Slice {
        let items = items.into();
        let bytes = size_of_val(&*items) as u64;
        self.upload(to, 0, items);
        self.buffer(to, bytes)
    }

    /// Writes items to a buffer, from `offset` bytes on.
    pub fn upload<T: Pod>(&mut self, to: Buffer, offset: u64, items: impl Into<Cow<'a, [T]>>) {
        let bytes = match items.into() {
            Cow::Borrowed(items) => Cow::Borrowed(bytemuck::cast_slice(items)),
            Cow::Owned(items) => Cow::Owned(bytemuck::cast_slice(&items).to_vec()),
        };
        self.commands.push(Command::Upload { to, offset, bytes });
    }

    /// Adds a buffer that starts with some structs, each aligned, and returns the range of each.
    pub fn jobs<T: Pod>(&mut self, to: Buffer, structs: &[T]) -> Vec<Slice> {
        let mut bytes = vec![0; structs.len() * BINDING_ALIGNMENT];
        for (part, one) in bytes.chunks_exact_mut(BINDING_ALIGNMENT).zip(structs) {
            part[..size_of::<T>()].copy_from_slice(bytemuck::bytes_of(one));
        }
        self.buffer(to, bytes.len() as u64);
        self.commands.push(Command::Upload { to, offset: 0, bytes: bytes.into() });
        let start = |index: usize| (index * BINDING_ALIGNMENT) as u64;
        let slice = |index| Slice { buffer: to, bytes: start(index)..start(index) + size_of::<T>() as u64 };
        (0..structs.len()).map(slice).collect()
    }

    /// Returns the commands of each submission.
    pub fn submissions(&self) -> impl Iterator<Item = &[Command<'a>]> {
        self.commands.split(|command| matches!(command, Command::Submit))
    }

    /// Returns the pipelines that it needs.
    pub fn pipelines(&self) -> HashSet<Pipeline> {
        let needed = |command: &Command<'_>| match command {
            Command::Dispatch { pipeline, .. } => Some(*pipeline),
            _ => None,
        };
        self.commands.iter().filter_map(needed).collect()
    }

    /// Copies a range of a buffer to the host. Returns where it is in [`Buffer::Readback`], in bytes.
    pub fn read_back(&mut self, from: Slice) -> Range<usize> {
        let offset = self.readback.bytes;
        self.readback.bytes += from.bytes.end - from.bytes.start;
        self.commands.push(Command::ReadBack { from, offset });
        offset as usize..self.readback.bytes as usize
    }

    /// Copies status words to the host, from the start of a buffer.
    pub fn read_status(&mut self, buffer: Buffer, words: &[u32]) {
        let bytes = 0..size_of_val(words) as u64;
        let offsets = self.read_back(Slice { buffer, bytes }).step_by(size_of::<u32>());
        self.readback.status.extend(offsets.zip(words.iter().copied()));
    }
}

/// Returns a grid of at least `workgroups` workgroups, of at most `most` in each dimension.
pub fn grid(workgroups: usize, most: u32) -> [u32; 3] {
    let rows = workgroups.div_ceil(most as usize).max(1);
    [workgroups.div_ceil(rows) as u32, rows as u32, 1]
}
