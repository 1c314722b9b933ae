//! Training with a callback.

use std::ops::ControlFlow;

use super::coevolution::Coevolution;
use super::{Failure, Generation, Trained};
use crate::backend::Backend;
use crate::config::Config;
use crate::trainer::Row;

/// Trains all trials of a config and calls `watch` after every generation.
///
/// If `watch` returns [`ControlFlow::Break`], one more generation plays and the training ends. The results are then bit
/// for bit those of a config with that many generations.
///
/// # Errors
/// The config is invalid, its memory does not fit this machine, or the backend fails.
pub fn train(
    config: &Config,
    backend: &mut dyn Backend,
    watch: impl FnMut(Generation<'_>) -> ControlFlow<()>,
) -> Result<Trained, Failure> {
    train_from(config, backend, 0, &[], watch)
}

/// Trains as [`train`] does, but starts from given policies instead of random ones.
///
/// `first` has one array `[leaders][policies][parameters]` per trial, or one for all trials. If leaders share a policy,
/// the shape is `[1][policies][parameters]`. A larger population fills its remaining slots with random policies. A
/// smaller one takes the first policies.
///
/// # Errors
/// As for [`train`], or the policies do not fit the config.
pub fn train_from(
    config: &Config,
    backend: &mut dyn Backend,
    policies: usize,
    first: &[Vec<f32>],
    watch: impl FnMut(Generation<'_>) -> ControlFlow<()>,
) -> Result<Trained, Failure> {
    train_any(config, backend, (policies, first), false, watch)
}

/// Trains as [`train`] does, and gives `watch` the champions of every generation. A device that holds populations
/// returns them after every generation.
///
/// # Errors
/// As for [`train`].
pub fn train_with_champions(
    config: &Config,
    backend: &mut dyn Backend,
    watch: impl FnMut(Generation<'_>) -> ControlFlow<()>,
) -> Result<Trained, Failure> {
    train_any(config, backend, (0, &[]), true, watch)
}

fn train_any(
    config: &Config,
    backend: &mut dyn Backend,
    (policies, first): (usize, &[Vec<f32>]),
    with_champions: bool,
    mut watch: impl FnMut(Generation<'_>) -> ControlFlow<()>,
) -> Result<Trained, Failure> {
    let mut training = Coevolution::on_any_processor(config)?;
    training.start_from(policies, first)?;
    let mut stopped = false;
    while !training.is_done() {
        // Champions play together with the next generation, which completes the rows of theirs.
        let champions = with_champions.then(|| training.previous_champions()).transpose()?;
        let last = training.config().learning.generations;
        let rows = training.advance(backend, None)?;
        if let Some(&Row { generation, .. }) = rows.first().filter(|_| !stopped) {
            stopped = watch(Generation { generation, last, rows, champions: champions.as_deref() }).is_break();
            if stopped {
                training.end();
            }
        }
    }
    training.finish()
}
