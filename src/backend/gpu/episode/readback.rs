//! Reading back: waits for a batch and passes its record on for scoring.

use std::time::Duration;

use super::GpuBackend;
use super::flight::{Buffers, PackedReadback};
use super::planner::{BatchPlan, PACKED_HEAD, PlannedTask};
use crate::backend::Moment;
use crate::backend::gpu::device::DeviceError;
use crate::host::Instant;
use crate::parallel::*;

/// A wait of at least this long ends when the device is done.
const WAITED: Duration = Duration::from_millis(1);

/// The record of a batch, in the host's memory.
#[derive(Clone, Copy)]
pub(super) enum Readback<'a> {
    /// The whole record.
    Whole(&'a [u32]),
    /// The part that the scores depend on, as `shaders/pack.wgsl` writes it.
    Packed(&'a [u32]),
}

/// Called for each task with the record and the moments of its batch.
pub(super) type Done<'a> = dyn Fn(&PlannedTask, Readback<'_>, &[Moment]) + Sync + 'a;

impl GpuBackend {
    /// Waits for one batch, and passes its record on.
    pub(super) fn collect(
        &mut self,
        flight: usize,
        work: &BatchPlan,
        trace: bool,
        done: &Done<'_>,
    ) -> Result<(), DeviceError> {
        let start = Instant::now();
        self.gpu.wait_for(self.flights[flight].submitted.clone())?;
        let done_waiting = Instant::now();
        self.note_pace(flight, work, done_waiting, done_waiting - start);
        let mut score = Duration::ZERO;
        // Both stay as they are if the device did not do the work that its driver reports as done.
        let nonce = self.flights[flight].nonce;
        let mut share_out = |record: Readback<'_>, moments: &[Moment]| {
            let done_by_device = |share: &PlannedTask| {
                let status = match record {
                    Readback::Whole(words) => words[share.task.status as usize],
                    Readback::Packed(words) => words[share.packed_status()],
                };
                status == share.final_status(nonce)
            };
            if !work.shares.par_iter().all(done_by_device) {
                return Err(self.gpu.lose_undone("an episode"));
            }
            let start = Instant::now();
            work.shares.par_iter().for_each(|share| done(share, record, moments));
            score += start.elapsed();
            Ok(())
        };
        let record_bytes = (work.record * size_of::<u32>()) as u64;
        let moment_bytes = (work.moments * size_of::<Moment>()) as u64;
        let buffers = &mut self.flights[flight];
        let mut fits = false;
        if let Some(back) = buffers.populations_back.as_ref().filter(|_| !buffers.populations.is_empty()) {
            let expected: &[u8] = bytemuck::cast_slice(&buffers.populations);
            if !self.gpu.mapped(back, 0..expected.len() as u64, |bytes| bytes == expected)? {
                return Err(self.gpu.lose_undone("breeding"));
            }
        }
        if let (Some(head), Some(PackedReadback { room, bytes }), Some(back)) =
            (work.head, buffers.sent, &buffers.packed_back)
        {
            let used = self.gpu.mapped(back, 0..bytes, |bytes| {
                let words: &[u32] = bytemuck::cast_slice(bytes);
                let used = words[0] as usize;
                fits = used <= room && words.len() > PACKED_HEAD;
                match fits {
                    true => share_out(Readback::Packed(&words[PACKED_HEAD..]), &[]).map(|()| used),
                    false => Ok(used),
                }
            })??;
            // The next generation may keep more, so there is room for half as much again. The room shrinks slowly.
            let kept = 1.5 * used.saturating_sub(head) as f64 / work.sets as f64;
            self.kept_share = kept.max(0.9 * self.kept_share);
        }
        if !fits {
            if !buffers.whole {
                buffers.bring_record(&self.gpu, record_bytes)?;
            }
            match (&buffers.record_back, &buffers.moments_back) {
                (Some(record), Some(moments)) if trace => self.gpu.mapped(record, 0..record_bytes, |record| {
                    self.gpu.mapped(moments, 0..moment_bytes, |moments| {
                        share_out(Readback::Whole(bytemuck::cast_slice(record)), bytemuck::cast_slice(moments))
                    })
                })???,
                (Some(record), _) => self.gpu.mapped(record, 0..record_bytes, |record| {
                    share_out(Readback::Whole(bytemuck::cast_slice(record)), &[])
                })??,
                _ => unreachable!("a batch was submitted"),
            }
        }
        for watch in buffers.watches.iter().take(buffers.submissions) {
            let time = watch.read(&self.gpu)?;
            self.stages.gpu += time;
            self.stages.longest = self.stages.longest.max(time);
        }
        self.stages.wait += done_waiting - start;
        self.stages.score += score;
        self.stages.read_back += done_waiting.elapsed().saturating_sub(score);
        Ok(())
    }

    /// Notes how long a batch took that is `done`, after the host has waited for it.
    fn note_pace(&mut self, flight: usize, work: &BatchPlan, done: Instant, waited: Duration) {
        let Buffers { started, iterations, submissions, .. } = self.flights[flight];
        // The device plays one batch after the other.
        let before = self.done_at.replace(done);
        let Some(started) = started.map(|started| before.map_or(started, |before| started.max(before))) else { return };
        let elapsed = self.gpu.taken(iterations, done - started);
        if !self.clock {
            self.stages.longest = self.stages.longest.max(elapsed / submissions.max(1) as u32);
        }
        if let (1, Some(pace)) = (work.shapes.len(), work.shapes.first().and_then(|shape| self.paces.get_mut(shape))) {
            pace.observe(iterations, elapsed, waited > WAITED);
        }
    }
}
