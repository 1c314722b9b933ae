//! The test of large teams' kernel, before it plays for the first time. Few trainings need it, so the self-test at opening has
//! none.

use super::super::device::Executor;
use super::GpuBackend;
use crate::backend::compare::compare_traces;
use crate::backend::cpu::Cpu;
use crate::backend::{BackendError, Group};
use crate::config::Config;
use crate::sample;
use crate::world::World;

/// Plays the classes of the self-test, without those that large teams cannot have. Describes the first difference from the
/// CPU, if any.
pub(super) fn large_teams(executor: &Executor) -> Result<Option<String>, BackendError> {
    const TEAMS: usize = 4;
    let mut config =
        Config::parse(include_str!("../self_test.toml"), "self_test.toml").expect("the project's own config");
    config.agents.retain(|class| class.control.target().is_none());
    let world = World::new(&config.validate().expect("the project's own config"));
    let (weights, teams) = (sample::weights(&world, 1, 0), vec![0; TEAMS * world.leaders()]);
    let group = Group::new(&world, &weights[..], 1, &teams);
    let mut backend = GpuBackend::with_executor(executor.clone()).with_large_from(0);
    let mismatch = compare_traces(&group, &mut Cpu::default(), &mut backend)?;
    Ok(mismatch.map(|mismatch| format!("an episode of a large team differs: {mismatch}")))
}
