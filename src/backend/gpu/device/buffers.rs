//! Buffers, and bytes to and from the device.

use std::ops::Range;
use std::sync::atomic::Ordering::Relaxed;

use bytemuck::Pod;
use futures_channel::oneshot;

use super::{DeviceError, Gpu};
use crate::host;

/// Bytes between host and device.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    /// To the device.
    pub up: u64,
    /// From the device.
    pub down: u64,
}

impl std::ops::Sub for Traffic {
    type Output = Traffic;

    fn sub(self, other: Traffic) -> Traffic {
        Traffic { up: self.up - other.up, down: self.down - other.down }
    }
}

impl std::ops::AddAssign for Traffic {
    fn add_assign(&mut self, other: Traffic) {
        (self.up, self.down) = (self.up + other.up, self.down + other.down);
    }
}

impl Gpu {
    /// Creates a buffer of `bytes` bytes, all zero.
    ///
    /// # Errors
    /// It exceeds the device's limits, or there is too little memory.
    pub fn buffer(&self, what: &str, bytes: u64, usage: wgpu::BufferUsages) -> Result<wgpu::Buffer, DeviceError> {
        let mut allowed = self.limits.max_buffer_size;
        if usage.contains(wgpu::BufferUsages::STORAGE) {
            allowed = allowed.min(self.limits.max_storage_buffer_binding_size);
        }
        if usage.contains(wgpu::BufferUsages::UNIFORM) {
            allowed = allowed.min(self.limits.max_uniform_buffer_binding_size);
        }
        if bytes > allowed {
            return Err(DeviceError::TooLarge { adapter: self.adapter.to_string(), what: what.into(), bytes, allowed });
        }
        if self.faults.as_ref().is_some_and(|faults| faults.lacks_memory(what)) {
            return Err(DeviceError::OutOfMemory { adapter: self.adapter.to_string(), what: what.into() });
        }
        let descriptor = wgpu::BufferDescriptor { label: Some(what), size: bytes, usage, mapped_at_creation: false };
        self.scoped(what, || self.device.create_buffer(&descriptor))
    }

    /// Creates a buffer that holds `contents`.
    ///
    /// # Errors
    /// It exceeds the device's limits, or there is too little memory.
    pub fn upload<T: Pod>(
        &self,
        what: &str,
        contents: &[T],
        usage: wgpu::BufferUsages,
    ) -> Result<wgpu::Buffer, DeviceError> {
        let bytes = bytemuck::cast_slice(contents);
        let buffer = self.buffer(what, bytes.len() as u64, usage | wgpu::BufferUsages::COPY_DST)?;
        self.scoped(what, || self.write(&buffer, 0, bytes))?;
        Ok(buffer)
    }

    /// Writes to a buffer (usage `COPY_DST`) before everything that is submitted from now on. `offset` is in bytes; it
    /// and the length are multiples of 4. Errors appear in the next [`Gpu::scoped`] or [`Gpu::check`].
    pub fn write(&self, buffer: &wgpu::Buffer, offset: u64, bytes: &[u8]) {
        self.traffic[0].fetch_add(bytes.len() as u64, Relaxed);
        self.queue.write_buffer(buffer, offset, bytes);
    }

    /// Returns the bytes written to and read from the device since it was opened.
    pub fn traffic(&self) -> Traffic {
        let [up, down] = [0, 1].map(|way| self.traffic[way].load(Relaxed));
        Traffic { up, down }
    }

    /// Waits for all work, and reads ranges of buffers, one after another (in bytes, multiples of 4; usage `COPY_SRC`).
    ///
    /// # Errors
    /// The device was lost, or has too little memory for the copy.
    pub fn read<T: Pod>(&self, ranges: &[(&wgpu::Buffer, Range<u64>)]) -> Result<Vec<T>, DeviceError> {
        let readback_buffer = self.readback_buffer(ranges.iter().map(|(_, bytes)| bytes.end - bytes.start).sum())?;
        self.read_through(&readback_buffer, ranges, bytemuck::pod_collect_to_vec)
    }

    /// Creates a buffer of `bytes` bytes for [`Gpu::read_through`].
    ///
    /// # Errors
    /// It exceeds the device's limits, or there is too little memory.
    pub(in crate::backend::gpu) fn readback_buffer(&self, bytes: u64) -> Result<wgpu::Buffer, DeviceError> {
        self.buffer("reading back", bytes, wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ)
    }

    /// Reads like [`Gpu::read`], through a buffer of [`Gpu::readback_buffer`] that several reads share, because drivers take long
    /// to create one. Calls `show` with the bytes of all ranges.
    ///
    /// # Errors
    /// The device was lost, or the buffer cannot be read.
    pub(in crate::backend::gpu) fn read_through<T>(
        &self,
        readback_buffer: &wgpu::Buffer,
        ranges: &[(&wgpu::Buffer, Range<u64>)],
        show: impl FnOnce(&[u8]) -> T,
    ) -> Result<T, DeviceError> {
        let mut size = 0;
        self.scoped("reading back", || {
            let mut encoder = self.device.create_command_encoder(&Default::default());
            for (buffer, bytes) in ranges {
                encoder.copy_buffer_to_buffer(buffer, bytes.start, readback_buffer, size, bytes.end - bytes.start);
                size += bytes.end - bytes.start;
            }
            self.submit_commands("reading back", 0, encoder);
        })?;
        self.wait()?;
        self.mapped(readback_buffer, 0..size, show)
    }

    /// Calls `show` with a range of a buffer (in bytes, multiples of 4; usage `MAP_READ`). All work that writes it must
    /// have been waited for.
    ///
    /// # Errors
    /// The device was lost, or the buffer cannot be read.
    pub(in crate::backend::gpu) fn mapped<T>(
        &self,
        buffer: &wgpu::Buffer,
        bytes: Range<u64>,
        show: impl FnOnce(&[u8]) -> T,
    ) -> Result<T, DeviceError> {
        self.traffic[1].fetch_add(bytes.end - bytes.start, Relaxed);
        let (send, receive) = oneshot::channel();
        // The receiver is dropped only after an error.
        self.scoped("reading back", || {
            buffer.map_async(wgpu::MapMode::Read, bytes.clone(), move |result| drop(send.send(result)));
        })?;
        // The work is done, so one poll completes the mapping.
        let polled = self.device.poll(wgpu::PollType::Poll);
        self.check()?;
        polled.map_err(|error| self.failed("reading back", error))?;
        let mapped = host::wait(receive).map_err(|error| self.failed("reading back", error))?;
        mapped.map_err(|error| self.failed("reading back", error))?;
        let view = buffer.get_mapped_range(bytes).map_err(|error| self.failed("reading back", error))?;
        let instead = self.faults.as_ref().and_then(|faults| faults.reads(buffer, &view));
        let shown = show(instead.as_deref().unwrap_or(&view));
        drop(view);
        buffer.unmap();
        Ok(shown)
    }
}
