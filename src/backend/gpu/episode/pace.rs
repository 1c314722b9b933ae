//! How long submissions take, so that none is long enough for a watchdog: Windows ends a submission after 2 s, other
//! systems even earlier.

use std::time::Duration;

/// Target time of a submission, in seconds.
const TARGET: f64 = 0.1;
/// Work of the first submission of a kernel, in iterations. It takes milliseconds on the slowest GPUs.
const FIRST_ITERATIONS: u64 = 1 << 24;
/// Minimum time of a trial whose duration says something about the device's speed.
const MIN_TRIAL_TIME: Duration = Duration::from_millis(5);

/// The speed at which a device plays a kernel, as far as it is known. Work is counted in loop iterations over all
/// threads, as the planner estimates them.
pub(super) struct Pace {
    /// Iterations of the next trial.
    trial: u64,
    /// Iterations per second of the last trial. Some drivers compile in the first dispatch, so two trials are timed.
    last_trial_rate: Option<f64>,
    /// Iterations per second.
    rate: Option<f64>,
}

impl Default for Pace {
    fn default() -> Pace {
        Pace { trial: FIRST_ITERATIONS, last_trial_rate: None, rate: None }
    }
}

impl Pace {
    /// Reports whether the speed is known.
    pub(super) fn is_known(&self) -> bool {
        self.rate.is_some()
    }

    /// Returns how many tasks of so many iterations may join a submission that takes `load` seconds without them.
    pub(super) fn tasks(&self, iterations: u64, load: f64) -> usize {
        match self.rate {
            Some(rate) => ((TARGET - load).max(0.0) * rate / iterations as f64) as usize,
            None if load > 0.0 => 0,
            None => (self.trial / iterations) as usize,
        }
    }

    /// Returns the estimated time of some work, in seconds.
    pub(super) fn seconds(&self, iterations: u64) -> f64 {
        self.rate.map_or(0.0, |rate| iterations as f64 / rate)
    }

    /// Notes how long a trial took. The device had nothing else to do.
    pub(super) fn record_trial(&mut self, iterations: u64, elapsed: Duration) {
        let rate = iterations as f64 / elapsed.as_secs_f64().max(1e-9);
        if elapsed < MIN_TRIAL_TIME {
            // The overhead of a submission hides the speed.
            self.trial = self.trial.saturating_mul(8);
        } else if let Some(first) = self.last_trial_rate.replace(rate) {
            self.rate = Some(rate.max(first));
        }
    }

    /// Notes how long a whole batch took, if the speed is known and the batch is long enough to tell. Unless `exact`,
    /// the device may have been done earlier.
    pub(super) fn observe(&mut self, iterations: u64, elapsed: Duration, exact: bool) {
        let Some(known) = &mut self.rate else { return };
        let rate = iterations as f64 / elapsed.as_secs_f64().max(1e-9);
        if elapsed >= MIN_TRIAL_TIME && (exact || rate > *known) {
            *known = rate;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn submissions_are_sized_by_the_time_of_trials() {
        let mut pace = Pace::default();
        assert_eq!(pace.tasks(1 << 20, 0.0), 16);
        // Too short to tell: a larger trial. Then two that tell, the first with a compilation.
        pace.record_trial(1 << 24, Duration::from_millis(1));
        assert_eq!(pace.tasks(1 << 20, 0.0), 128);
        pace.record_trial(1 << 27, Duration::from_secs(1));
        assert!(!pace.is_known());
        pace.record_trial(1 << 27, Duration::from_millis(50));
        assert!(pace.is_known());
        assert_eq!(pace.tasks(1 << 20, 0.0), 256);
        assert_eq!(pace.tasks(1 << 20, 0.05), 128);
        assert_eq!(pace.tasks(1 << 20, 0.2), 0);
        // Half as fast, then a time that is only a bound.
        pace.observe(1 << 27, Duration::from_millis(100), true);
        pace.observe(1 << 27, Duration::from_millis(900), false);
        assert_eq!(pace.tasks(1 << 20, 0.0), 128);
    }
}
