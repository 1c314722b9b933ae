//! Reading back: waits for a batch and passes its record on for scoring.

use std::time::Duration;

use super::GpuBackend;
use super::flight::{PackedReadback, SubmittedBatch};
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
        plan: &BatchPlan,
        mut batch: SubmittedBatch,
        done: &Done<'_>,
    ) -> Result<(), DeviceError> {
        let start = Instant::now();
        self.gpu.wait_for(Some(batch.last.clone()))?;
        let done_waiting = Instant::now();
        self.note_pace(&batch, done_waiting, done_waiting - start);
        self.check_populations(&batch)?;
        let score = match self.score_packed(plan, &batch, done)? {
            Some(score) => score,
            None => self.score_whole(plan, &mut batch, done)?,
        };
        for watch in self.flights[batch.flight].watches.iter().take(batch.submissions) {
            let time = watch.read(&self.gpu)?;
            self.times.gpu += time;
            self.times.longest = self.times.longest.max(time);
        }
        self.times.wait += done_waiting - start;
        self.times.score += score;
        self.times.read_back += done_waiting.elapsed().saturating_sub(score);
        Ok(())
    }

    /// Checks that the populations of a batch were bred as planned.
    fn check_populations(&self, batch: &SubmittedBatch) -> Result<(), DeviceError> {
        let Some((back, expected)) = &batch.readback.populations else { return Ok(()) };
        let expected: &[u8] = bytemuck::cast_slice(expected);
        match self.gpu.mapped(back, 0..expected.len() as u64, |bytes| bytes == expected)? {
            true => Ok(()),
            false => Err(self.gpu.lose_undone("breeding")),
        }
    }

    /// Passes the packed record on, if there is one and everything fitted. Returns how long that took.
    fn score_packed(
        &mut self,
        plan: &BatchPlan,
        batch: &SubmittedBatch,
        done: &Done<'_>,
    ) -> Result<Option<Duration>, DeviceError> {
        let (Some(head), Some((back, PackedReadback { room, bytes }))) = (plan.head, &batch.readback.packed) else {
            return Ok(None);
        };
        let (used, score) = self.gpu.mapped(back, 0..*bytes, |bytes| {
            let words: &[u32] = bytemuck::cast_slice(bytes);
            let used = words[0] as usize;
            if used > *room || words.len() == PACKED_HEAD {
                return Ok((used, None));
            }
            let record = Readback::Packed(&words[PACKED_HEAD..]);
            self.score_tasks(plan, batch.nonce, record, &[], done).map(|score| (used, Some(score)))
        })??;
        // The next generation may keep more, so there is room for half as much again. The room shrinks slowly.
        let kept = 1.5 * used.saturating_sub(head) as f64 / plan.sets as f64;
        self.kept_share = kept.max(0.9 * self.kept_share);
        Ok(score)
    }

    /// Passes the whole record on, with the moments of a trace. Returns how long that took.
    fn score_whole(
        &mut self,
        plan: &BatchPlan,
        batch: &mut SubmittedBatch,
        done: &Done<'_>,
    ) -> Result<Duration, DeviceError> {
        let [record_bytes, _, moment_bytes, _] = plan.used.bytes();
        let record = match batch.readback.record.take() {
            Some(record) => record,
            None => self.bring_record(batch, record_bytes)?,
        };
        self.gpu.mapped(&record, 0..record_bytes, |record| {
            let record = Readback::Whole(bytemuck::cast_slice(record));
            let score = |moments: &[Moment]| self.score_tasks(plan, batch.nonce, record, moments, done);
            match &batch.readback.moments {
                Some(back) => self.gpu.mapped(back, 0..moment_bytes, |bytes| score(bytemuck::cast_slice(bytes)))?,
                None => score(&[]),
            }
        })?
    }

    /// Calls `done` for each task, and returns how long that took.
    fn score_tasks(
        &self,
        plan: &BatchPlan,
        nonce: u32,
        record: Readback<'_>,
        moments: &[Moment],
        done: &Done<'_>,
    ) -> Result<Duration, DeviceError> {
        // The status stays as it is if the device did not do the work that its driver reports as done.
        let done_by_device = |planned: &PlannedTask| {
            let status = match record {
                Readback::Whole(words) => words[planned.task.status as usize],
                Readback::Packed(words) => words[planned.packed_status()],
            };
            status == planned.final_status(nonce)
        };
        if !plan.tasks.par_iter().all(done_by_device) {
            return Err(self.gpu.lose_undone("an episode"));
        }
        let start = Instant::now();
        plan.tasks.par_iter().for_each(|planned| done(planned, record, moments));
        Ok(start.elapsed())
    }

    /// Notes how long a batch took that is `done`, after the host has waited for it.
    fn note_pace(&mut self, batch: &SubmittedBatch, done: Instant, waited: Duration) {
        // The device plays one batch after the other.
        let before = self.done_at.replace(done);
        let Some(started) = batch.started.map(|started| before.map_or(started, |before| started.max(before))) else {
            return;
        };
        let elapsed = self.gpu.taken(batch.iterations, done - started);
        if !self.clock {
            self.times.longest = self.times.longest.max(elapsed / batch.submissions.max(1) as u32);
        }
        self.pace.observe(batch.iterations, elapsed, waited > WAITED);
    }
}
