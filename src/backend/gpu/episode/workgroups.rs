//! Measures how many teams per workgroup are faster on a device. Large workgroups share more work, and more of the
//! small ones fit into a compute unit at once. The winner depends on the registers that the driver's compiler needs.

use std::time::Duration;

use super::GpuBackend;
use super::shape::{Kernel, TEAMS, Workgroup};
use crate::backend::{BackendError, Group};
use crate::host::Instant;

/// Teams per workgroup that are compared.
const CANDIDATES: [usize; 2] = [TEAMS[0], TEAMS[1]];
/// Minimum teams of a group that is timed. They are enough workgroups to occupy a GPU.
const MIN_TEAMS: usize = 1024;
/// Timed rollouts of each candidate, after one that compiles.
const REPEATS: usize = 2;

impl GpuBackend {
    /// Plays groups with each number of teams per workgroup and keeps the faster one. Does so once, when the first
    /// large group comes.
    pub(super) fn measure_workgroups(&mut self, groups: &[Group<'_>]) -> Result<(), BackendError> {
        let is_timed = |group: &Group<'_>| {
            let workgroup = Workgroup::specialised(group.world, self.capacity());
            group.team_count() >= MIN_TEAMS && workgroup.is_some_and(|workgroup| workgroup.teams == CANDIDATES[0])
        };
        if self.teams_per_workgroup.is_some() || self.kernel == Kernel::Generic || !groups.iter().any(is_timed) {
            return Ok(());
        }
        let times = self.times;
        let measured = fastest(CANDIDATES, |teams| {
            self.teams_per_workgroup = Some(teams);
            let start = Instant::now();
            self.play_tasks(groups, false, &|_, _, _| ())?;
            Ok(self.gpu.rollout_taken(teams, start.elapsed()))
        });
        // After an error, the next rollout measures again.
        self.teams_per_workgroup = measured.as_ref().ok().copied();
        self.times = times;
        measured.map(drop)
    }
}

/// Times each candidate a few times, and returns the one with the shortest rollout. The first candidate wins ties.
fn fastest<E>(
    candidates: impl IntoIterator<Item = usize>,
    mut rollout: impl FnMut(usize) -> Result<Duration, E>,
) -> Result<usize, E> {
    let mut best = (Duration::MAX, 0);
    for teams in candidates {
        // The first rollout compiles.
        rollout(teams)?;
        for _ in 0..REPEATS {
            let time = rollout(teams)?;
            if time < best.0 {
                best = (time, teams);
            }
        }
    }
    Ok(best.1)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Chooses by the milliseconds of all rollouts: of 32 teams per workgroup, then of 16.
    fn chosen(times: &[u64]) -> usize {
        let mut times = times.iter();
        let chosen = fastest([32, 16], |_| times.next().map(|&time| Duration::from_millis(time)).ok_or("too many"));
        assert_eq!(times.next(), None, "not all rollouts were played");
        chosen.unwrap()
    }

    #[test]
    fn the_shortest_rollout_decides() {
        assert_eq!(chosen(&[90, 10, 10, 90, 11, 9]), 16);
        assert_eq!(chosen(&[90, 10, 8, 90, 9, 9]), 32);
        // Compiling does not count.
        assert_eq!(chosen(&[1, 10, 10, 90, 9, 9]), 16);
        assert_eq!(chosen(&[90, 10, 10, 1, 11, 11]), 32);
        assert_eq!(chosen(&[90, 10, 10, 90, 10, 10]), 32);
        assert_eq!(fastest([32, 16], |teams| if teams == 32 { Ok(Duration::ZERO) } else { Err("lost") }), Err("lost"));
    }
}
