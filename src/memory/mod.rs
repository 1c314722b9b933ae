//! Estimate of a run's peak memory, made before the run starts.
//!
//! Every array that grows with the run is counted in the module that owns it. [`trainer`] counts what every run needs,
//! and [`backend`] counts what episodes need. [`PROGRAM`] covers everything that does not grow.
//!
//! Nothing else is as large. Checkpoints and policies are written directly from the populations or from a single copy,
//! see [`copies_checkpoint`]. A sweep limits its batches to half of the available memory.

use crate::backend::{self, BATCH_BYTES, PACKED_FROM, cpu};
use crate::config::{Config, Method, ValidConfig};
use crate::trainer;
use crate::world::World;

#[cfg(any(test, not(any(target_os = "macos", windows))))]
mod linux;

/// Bytes for the program itself: its code, the stacks of its threads and its input. The driver of a GPU is not
/// included.
pub const PROGRAM: u64 = 8 << 20;
/// Maximum bytes of populations that are copied for a checkpoint, so that it can be written while training continues.
const COPIED: u64 = 64 << 20;

/// Bytes per generation for a run's learning curves, drawn at its end: for each of three curves the average over trials
/// and a point. The arrays double as they grow.
const DRAWN: u64 = 3 * (32 + 32);

/// Peaks of memory use, in bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Peaks {
    /// Peak of the process if the CPU plays.
    pub host: u64,
    /// Part of the process's peak that is only used while a checkpoint is written.
    pub checkpoint: u64,
    /// Peak of the process if a GPU plays, without the memory of its driver.
    pub gpu_host: u64,
    /// Peak of the GPU's buffers. For buffers that are read back, this includes only the adapter's side.
    pub adapter: u64,
}

/// A run needs more memory than is available.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "this needs {} of memory at its peak, and {} is available; choose a smaller population, fewer trials{} or another \
     machine",
    human(*needed), human(*available),
    if *checkpoint > 0 { format!(", no checkpoints (they take {} of it)", human(*checkpoint)) } else { String::new() }
)]
pub struct TooLittle {
    /// Bytes at the peak of the run.
    pub needed: u64,
    /// Bytes that are available.
    pub available: u64,
    /// Part of the needed bytes that is used for checkpoints.
    pub checkpoint: u64,
}

impl Peaks {
    /// Returns the peaks for training these configs together on `threads` threads.
    pub fn of<'a>(configs: impl IntoIterator<Item = &'a ValidConfig>, threads: usize) -> Peaks {
        let lanes = cpu::lanes();
        let [mut training, mut next, mut checkpoint, mut queue, mut drawing] = [0_u64; 5];
        let [mut weights, mut record, mut states] = [0_u64; 3];
        let [mut block, mut order, mut populations, mut held] = [0_u64; 4];
        for config in configs {
            let staged: Vec<(&Config, World)> =
                config.stages().iter().map(|(_, config)| (&**config, World::new(config))).collect();
            // The largest stage determines each size.
            let most = |size: &dyn Fn(&Config, &World) -> u64| {
                staged.iter().map(|(config, world)| size(config, world)).max().unwrap_or(0)
            };
            let (trials, policies) = (config.learning.trials as u64, config.learning.population);
            let teams = |config: &Config| trials * config.learning.episodes_per_team as u64 * config.max_teams() as u64;
            training += trainer::bytes(config);
            next += trainer::next_schedule_bytes(config);
            checkpoint += checkpoint_bytes(config);
            drawing = drawing.max(DRAWN * (config.learning.generations as u64 + 1).next_power_of_two());
            queue += most(&|config, _| teams(config).div_ceil(lanes) * 16);
            block = block.max(most(&|config, world| cpu::block_bytes(world, config.learning.fitness)));
            // An evolution strategy also needs the utilities.
            let strategy = config.learning.method != Method::Tournament;
            let ranked = size_of::<usize>() + if strategy { size_of::<f64>() } else { 0 };
            order = order.max((policies * ranked) as u64);
            populations += trials * config.populations() as u64;
            if !strategy {
                held +=
                    trials * backend::held_bytes([config.populations(), config.learning.slots(), config.parameters()]);
            }
            weights = weights.saturating_add(most(&|config, world| teams(config) * backend::weight_bytes(world)));
            record = record.saturating_add(most(&|config, world| {
                teams(config).saturating_mul(backend::record_bytes(world, config.learning.fitness))
            }));
            states = states.saturating_add(most(&|config, world| {
                teams(config).saturating_mul(backend::state_bytes(world, config.learning.fitness))
            }));
        }
        // Episodes, the final sorting of each population and the picture do not happen at the same time.
        let playing = threads as u64 * block + queue;
        let ending = (populations.min(threads as u64) * order).max(drawing);
        let always = PROGRAM + training + checkpoint;
        // A batch ends when the largest of its three large buffers is full. Two batches are in progress at a time.
        let share = |bytes: u64, batches: u64| {
            let batch =
                u128::from(bytes) * u128::from(BATCH_BYTES) / u128::from(weights.max(record).max(states).max(1));
            bytes.min(batch as u64 * batches)
        };
        // The packed form of a record takes at most as much again. If it does not fit, the whole record is read back.
        let records = share(record, 2) * if record < PACKED_FROM { 1 } else { 2 };
        Peaks {
            host: always + playing.max(ending),
            checkpoint,
            // One batch is assembled on the host, and two are being transferred to or from the adapter.
            gpu_host: always + next + (share(weights, 1) + share(weights, 2) + records).max(ending),
            adapter: share(weights, 2) + records + share(states, 2) + held,
        }
    }

    /// Fails if the peak exceeds the available memory. Passes if the system does not report that value.
    ///
    /// # Errors
    /// The available memory is smaller than the peak.
    pub fn check(&self, gpu: bool) -> Result<(), TooLittle> {
        check(if gpu { self.gpu_host } else { self.host }, self.checkpoint)
    }
}

/// Fails if a peak exceeds the available memory. `checkpoint` is the part of it that checkpoints use. Passes if the
/// system does not report the available memory.
///
/// # Errors
/// The available memory is smaller than the peak.
pub fn check(needed: u64, checkpoint: u64) -> Result<(), TooLittle> {
    match available() {
        Some(available) if available < needed => Err(TooLittle { needed, available, checkpoint }),
        _ => Ok(()),
    }
}

/// Reports whether a checkpoint of these configs is copied and written while training continues. Larger checkpoints are
/// written directly from the populations, and training waits.
pub fn copies_checkpoint<'a>(configs: impl IntoIterator<Item = &'a Config>) -> bool {
    configs.into_iter().map(trainer::snapshot_bytes).sum::<u64>() <= COPIED
}

/// Returns the bytes that a checkpoint copies.
fn checkpoint_bytes(config: &Config) -> u64 {
    let due = config.checkpoint.generations > 0 || config.checkpoint.seconds > 0.0;
    if due && copies_checkpoint([config]) { trainer::snapshot_bytes(config) } else { 0 }
}

/// Returns the bytes that this process may still use, or `None` if the system does not report them.
///
/// This is what the system has free or can free, within the limits of the process's control groups and address space.
/// On macOS and Windows, only the program (the feature `cli`) can query it.
pub fn available() -> Option<u64> {
    match () {
        #[cfg(any(target_os = "macos", windows))]
        () => free_of_system(),
        #[cfg(not(any(target_os = "macos", windows)))]
        () => linux::available(std::path::Path::new("/")),
    }
}

/// Returns the bytes that macOS or Windows has free.
#[cfg(any(target_os = "macos", windows))]
fn free_of_system() -> Option<u64> {
    let mut system = sysinfo::System::new();
    system.refresh_memory_specifics(sysinfo::MemoryRefreshKind::nothing().with_ram());
    Some(system.available_memory()).filter(|&bytes| bytes > 0)
}

/// Formats bytes, such as "3.6 GiB".
fn human(bytes: u64) -> String {
    let mib = bytes as f64 / f64::from(1 << 20);
    if mib < 1024.0 { format!("{mib:.1} MiB") } else { format!("{:.1} GiB", mib / 1024.0) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_too_large_says_what_to_do() {
        let text = TooLittle { needed: 3 << 30, available: 5 << 20, checkpoint: 1 << 20 }.to_string();
        for part in ["3.0 GiB", "5.0 MiB", "smaller population", "no checkpoints (they take 1.0 MiB"] {
            assert!(text.contains(part), "{text}");
        }
    }
}
