//! Waiting for a device, which may never answer.

use std::sync::OnceLock;
use std::time::Duration;

use futures_channel::oneshot;

use super::{DeviceError, Gpu};
use crate::host;

/// How long to wait for a device that makes no progress.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WaitLimit {
    /// The time of one wait. After the first, the second, the fourth and so on, the device is reported as slow.
    pub wait: Duration,
    /// Waits without progress after which the device counts as lost.
    pub waits: u32,
}

impl WaitLimit {
    /// The limit for GPUs: a message after 10 s, and an error after 2 minutes. No submission takes longer than a
    /// second.
    pub(super) const WITH_GPUS: WaitLimit = WaitLimit { wait: Duration::from_secs(10), waits: 12 };
    /// The limit for software renderers: an hour, because they wait for the processor like other programs.
    pub(super) const WITH_SOFTWARE: WaitLimit = WaitLimit { wait: Duration::from_secs(10), waits: 360 };
}

/// Reports a device without progress to people, see [`report_stalls`].
static REPORT: OnceLock<fn(&str)> = OnceLock::new();

/// Sets the function that reports to people, in a sentence, that a device makes no progress. Only the first call has an
/// effect.
pub fn report_stalls(report: fn(&str)) {
    let _ = REPORT.set(report);
}

impl Gpu {
    /// Sets how long to wait for a device that makes no progress.
    pub fn with_wait_limit(self, wait_limit: WaitLimit) -> Gpu {
        Gpu { wait_limit, ..self }
    }

    /// Waits until everything submitted is done.
    ///
    /// # Errors
    /// The device was lost, or a command failed.
    pub fn wait(&self) -> Result<(), DeviceError> {
        self.wait_until(None)
    }

    /// Waits for submissions, one after the other, because each that is done shows progress.
    ///
    /// # Errors
    /// The device was lost, or a command failed.
    pub(in crate::backend::gpu) fn wait_for(&self, submissions: &[wgpu::SubmissionIndex]) -> Result<(), DeviceError> {
        submissions.iter().try_for_each(|submission| self.wait_until(Some(submission.clone())))
    }

    /// Waits until a submission is done, or everything.
    fn wait_until(&self, submission_index: Option<wgpu::SubmissionIndex>) -> Result<(), DeviceError> {
        // A browser cannot poll. There, this waits for everything submitted so far.
        if cfg!(target_family = "wasm") {
            let (send, done) = oneshot::channel();
            self.queue.on_submitted_work_done(move || _ = send.send(()));
            // If nobody answers, the device was lost; `check` reports that.
            let _ = host::wait(done);
            return self.check();
        }
        let WaitLimit { wait, waits } = self.wait_limit;
        for waited in 1..=waits {
            let wanted = wgpu::PollType::Wait { submission_index: submission_index.clone(), timeout: Some(wait) };
            let polled = match self.faults().is_some_and(|faults| faults.stalls()) {
                true => Err(wgpu::PollError::Timeout),
                false => self.device.poll(wanted),
            };
            self.check()?;
            match polled {
                Ok(_) => return Ok(()),
                Err(wgpu::PollError::Timeout) => {
                    let (seconds, most) = ((wait * waited).as_secs_f64(), (wait * waits).as_secs_f64());
                    REPORT.get().filter(|_| waited.is_power_of_two()).inspect(|report| {
                        report(&format!(
                            "{}: no progress for {seconds:.0} s; it counts as lost after {most:.0} s",
                            self.adapter
                        ));
                    });
                }
                Err(error) => return Err(self.failed("waiting", error)),
            }
        }
        Err(self.lose(&format!("no progress for {:.0} s", (wait * waits).as_secs_f64())))
    }
}
