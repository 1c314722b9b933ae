//! Measures which packing of teams into workgroups is faster on a device. Large workgroups share more work, and more of
//! the small ones fit into a compute unit at once. The winner depends on the registers that the driver's compiler needs.

use std::time::Duration;

use super::GpuBackend;
use super::shape::{Kernel, Packing, TEAMS};
use crate::backend::{BackendError, Group};
use crate::host::Instant;

/// Teams per workgroup that are compared.
const CANDIDATES: [usize; 2] = [TEAMS[0], TEAMS[1]];
/// Minimum teams of a group whose time tells, as enough workgroups to occupy a GPU.
const TELLING: usize = 1024;
/// Timed rollouts of each candidate, after one that compiles.
const REPEATS: usize = 2;

impl GpuBackend {
    /// Plays groups by both packings and keeps the faster one, once, when the first large group comes.
    pub(super) fn measure_packing(&mut self, groups: &[Group<'_>]) -> Result<(), BackendError> {
        let tells = |group: &Group<'_>| {
            let packing = Packing::specialised(group.world, self.room());
            group.team_count() >= TELLING && packing.is_some_and(|packing| packing.teams == CANDIDATES[0])
        };
        if self.packing.is_some() || self.kernel == Kernel::Generic || !groups.iter().any(tells) {
            return Ok(());
        }
        let stages = self.stages;
        let mut best = (Duration::MAX, CANDIDATES[0]);
        for teams in CANDIDATES {
            self.packing = Some(teams);
            for repeat in 0..=REPEATS {
                let start = Instant::now();
                if let Err(error) = self.play_tasks(groups, false, &|_, _, _| ()) {
                    self.packing = None;
                    return Err(error);
                }
                if repeat > 0 {
                    best = best.min((start.elapsed(), teams));
                }
            }
        }
        (self.packing, self.stages) = (Some(best.1), stages);
        Ok(())
    }
}
