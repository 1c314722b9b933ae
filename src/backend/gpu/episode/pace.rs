//! How much work a submission may have, so that none is long enough for a watchdog: Windows ends a submission after 2 s,
//! other systems even earlier.

use std::time::Duration;

/// Target time of a submission, in seconds. Kernels differ in speed, so a submission may take several times as long.
const TARGET: f64 = 0.1;
/// Work of the first submission, in iterations. It takes milliseconds on the slowest GPUs.
const FIRST_CAP: u64 = 1 << 24;
/// Minimum time of work whose duration says something about the device's speed.
const MIN_TIME: Duration = Duration::from_millis(5);

/// The maximum work of a submission, by the measured speed of the device. Work is counted in loop iterations over all
/// threads, as the planner estimates them.
pub(super) struct Pace {
    cap: u64,
    is_measured: bool,
}

impl Default for Pace {
    fn default() -> Pace {
        Pace { cap: FIRST_CAP, is_measured: false }
    }
}

impl Pace {
    /// Reports whether the speed is known.
    pub(super) fn is_measured(&self) -> bool {
        self.is_measured
    }

    /// Returns how many tasks of so many iterations may join a submission that has `load` iterations.
    pub(super) fn tasks(&self, iterations: u64, load: u64) -> usize {
        (self.cap.saturating_sub(load) / iterations) as usize
    }

    /// Notes how long a trial took: the first submission, or the next one if that was too short to tell. The device had
    /// nothing else to do.
    pub(super) fn record_trial(&mut self, iterations: u64, elapsed: Duration) {
        match elapsed < MIN_TIME {
            true => self.cap = self.cap.saturating_mul(8),
            false => self.set(iterations, elapsed),
        }
    }

    /// Notes how long a whole batch took, if the speed is known and the batch is long enough to tell. Unless `exact`,
    /// the device may have been done earlier.
    pub(super) fn observe(&mut self, iterations: u64, elapsed: Duration, exact: bool) {
        let is_faster = iterations as f64 / elapsed.as_secs_f64().max(1e-9) * TARGET > self.cap as f64;
        if self.is_measured && elapsed >= MIN_TIME && (exact || is_faster) {
            self.set(iterations, elapsed);
        }
    }

    fn set(&mut self, iterations: u64, elapsed: Duration) {
        // Some drivers compile in the first dispatch, which makes the device seem slow.
        self.cap = ((iterations as f64 / elapsed.as_secs_f64() * TARGET) as u64).max(FIRST_CAP);
        self.is_measured = true;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn submissions_are_sized_by_the_measured_speed() {
        let mut pace = Pace::default();
        assert_eq!(pace.tasks(1 << 20, 0), 16);
        // Too short to tell: a larger trial.
        pace.record_trial(1 << 24, Duration::from_millis(1));
        assert_eq!(pace.tasks(1 << 20, 0), 128);
        assert!(!pace.is_measured());
        pace.record_trial(1 << 27, Duration::from_millis(50));
        assert!(pace.is_measured());
        assert_eq!(pace.tasks(1 << 20, 0), 256);
        assert_eq!(pace.tasks(1 << 20, 1 << 27), 128);
        assert_eq!(pace.tasks(1 << 20, 1 << 29), 0);
        // Half as fast, then a time that is only a bound.
        pace.observe(1 << 27, Duration::from_millis(100), true);
        pace.observe(1 << 27, Duration::from_millis(900), false);
        assert_eq!(pace.tasks(1 << 20, 0), 128);
    }
}
