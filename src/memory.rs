//! What a run takes in memory at its peak, told before it starts.
//!
//! Every array that grows with the run is counted where it lives: [`trainer`] tells what every run has, [`backend`]
//! what episodes take. What does not grow is [`PROGRAM`]. Nothing else is as large: checkpoints and policies are
//! written straight from the populations, or from one copy, see [`copies_checkpoint`]. A sweep keeps its batches to
//! half of what is available.

use std::fs;
use std::path::Path;

use crate::backend::{self, BATCH_BYTES, PACKED_FROM, RecordRequest, cpu};
use crate::config::Config;
use crate::trainer;
use crate::world::World;

/// Bytes of the program itself: its code, its threads' stacks and what it reads. A GPU's driver comes on top.
pub const PROGRAM: u64 = 8 << 20;
/// Most bytes of populations of which a checkpoint takes a copy, to be written while training goes on.
const COPIED: u64 = 64 << 20;

/// Peaks, in bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Peaks {
    /// Of the process, where the CPU plays.
    pub host: u64,
    /// How much of that is only while a checkpoint is written.
    pub checkpoint: u64,
    /// Of the process, where a GPU plays, without what its driver keeps there.
    pub gpu_host: u64,
    /// Of the GPU's buffers; of those that are read back, the adapter's side.
    pub adapter: u64,
}

/// There is less memory than a run needs.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "this needs {} of memory at its peak, and {} is available; choose a smaller population, fewer trials{} or another \
     machine",
    human(*needed), human(*available),
    if *checkpoint > 0 { format!(", no checkpoints (they take {} of it)", human(*checkpoint)) } else { String::new() }
)]
pub struct TooLittle {
    /// Bytes at the run's peak.
    pub needed: u64,
    /// Bytes that the system has to give.
    pub available: u64,
    /// How much of what is needed is for checkpoints.
    pub checkpoint: u64,
}

impl Peaks {
    /// What it takes to train these (valid) configs side by side, on so many threads.
    pub fn of<'a>(configs: impl IntoIterator<Item = &'a Config>, threads: usize) -> Peaks {
        let lanes = cpu::lanes();
        let [mut training, mut next, mut checkpoint, mut queue, mut weights, mut record] = [0_u64; 6];
        let [mut block, mut order, mut populations, mut held] = [0_u64; 4];
        for config in configs {
            let staged: Vec<(Config, World)> = (config.staged().into_iter())
                .map(|(_, config)| {
                    let world = World::new(&config);
                    (config, world)
                })
                .collect();
            let need = |config: &Config| RecordRequest::Score(config.learning.fitness);
            // Of what a stage decides, the largest counts.
            let most = |size: &dyn Fn(&Config, &World) -> u64| {
                staged.iter().map(|(config, world)| size(config, world)).max().unwrap_or(0)
            };
            let (trials, policies) = (config.learning.trials as u64, config.learning.population);
            let teams = |config: &Config| trials * config.learning.episodes_per_team as u64 * (policies as u64 + 1);
            training += trainer::bytes(config);
            next += trainer::next_bytes(config);
            checkpoint += checkpoint_bytes(config);
            queue += most(&|config, _| teams(config).div_ceil(lanes) * 16);
            block = block.max(most(&|config, world| cpu::block_bytes(world, need(config))));
            order = order.max((policies * size_of::<usize>()) as u64);
            populations += trials * config.populations() as u64;
            held += trials * backend::held_bytes([config.populations(), policies + 1, config.parameters()]);
            weights = weights.saturating_add(most(&|config, world| teams(config) * backend::weight_bytes(world)));
            record = record.saturating_add(most(&|config, world| {
                teams(config).saturating_mul(backend::record_bytes(world, need(config)))
            }));
        }
        // Episodes and the final sorting of each population take turns.
        let playing = threads as u64 * block + queue;
        let sorting = populations.min(threads as u64) * order;
        let always = PROGRAM + training + checkpoint;
        // A batch ends where the larger of its two large buffers is full; two are under way.
        let share = |bytes: u64, batches: u64| {
            let batch = u128::from(bytes) * u128::from(BATCH_BYTES) / u128::from(weights.max(record).max(1));
            bytes.min(batch as u64 * batches)
        };
        // What is packed of a record takes at most as much again, and where it does not fit the record comes whole.
        let records = share(record, 2) * if record < PACKED_FROM { 1 } else { 2 };
        Peaks {
            host: always + playing.max(sorting),
            checkpoint,
            // A batch is gathered, and two are on their way to the adapter or back.
            gpu_host: always + next + (share(weights, 1) + share(weights, 2) + records).max(sorting),
            adapter: share(weights, 2) + records + held,
        }
    }

    /// Refuses what does not fit in the memory that is available now; lets pass where the system does not tell.
    ///
    /// # Errors
    /// There is less.
    pub fn check(&self, gpu: bool) -> Result<(), TooLittle> {
        check(if gpu { self.gpu_host } else { self.host }, self.checkpoint)
    }
}

/// Refuses a peak, so much of it for checkpoints, that does not fit in the memory that is available now; lets pass
/// where the system does not tell.
///
/// # Errors
/// There is less.
pub fn check(needed: u64, checkpoint: u64) -> Result<(), TooLittle> {
    match available() {
        Some(available) if available < needed => Err(TooLittle { needed, available, checkpoint }),
        _ => Ok(()),
    }
}

/// Whether a checkpoint of these configs' trainer is a copy, written while training goes on. Larger ones are written
/// from the populations themselves, and training waits.
pub fn copies_checkpoint<'a>(configs: impl IntoIterator<Item = &'a Config>) -> bool {
    configs.into_iter().map(trainer::snapshot_bytes).sum::<u64>() <= COPIED
}

/// What a checkpoint copies.
fn checkpoint_bytes(config: &Config) -> u64 {
    let due = config.checkpoint.generations > 0 || config.checkpoint.seconds > 0.0;
    if due && copies_checkpoint([config]) { trainer::snapshot_bytes(config) } else { 0 }
}

/// Bytes that this process may still take: what the system has free or can free, within the limit of its control
/// group. None where the system does not tell.
pub fn available() -> Option<u64> {
    let free =
        field(&fs::read_to_string("/proc/meminfo").ok()?, "MemAvailable:").map(|kib| kib.saturating_mul(1024))?;
    let group = fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
    let group = group.lines().find_map(|line| line.strip_prefix("0::")).unwrap_or("/");
    // Any group above may be the one with a limit.
    let limits = Path::new(group).ancestors().filter_map(|group| {
        let group = Path::new("/sys/fs/cgroup").join(group.strip_prefix("/").unwrap_or(group));
        let read = |file: &str| fs::read_to_string(group.join(file)).ok();
        let most: u64 = read("memory.max")?.trim().parse().ok()?;
        // Files that are kept in memory give way.
        let used = field(&read("memory.stat")?, "anon ").unwrap_or(0);
        Some(most.saturating_sub(used))
    });
    limits.chain([free]).min()
}

/// The number after a name at the start of a line.
fn field(text: &str, name: &str) -> Option<u64> {
    text.lines().find_map(|line| line.strip_prefix(name)?.split_whitespace().next()?.parse().ok())
}

/// "3.6 GiB"
fn human(bytes: u64) -> String {
    let mib = bytes as f64 / f64::from(1 << 20);
    if mib < 1024.0 { format!("{mib:.1} MiB") } else { format!("{:.1} GiB", mib / 1024.0) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_found_by_name() {
        let text = "MemTotal:       25000000 kB\nMemAvailable:   12 kB\nanon 7\nanon_thp 9\n";
        assert_eq!(field(text, "MemAvailable:"), Some(12));
        assert_eq!(field(text, "anon "), Some(7));
        assert_eq!(field(text, "none"), None);
    }

    #[test]
    fn what_is_too_large_says_what_to_do() {
        let text = TooLittle { needed: 3 << 30, available: 5 << 20, checkpoint: 1 << 20 }.to_string();
        for part in ["3.0 GiB", "5.0 MiB", "smaller population", "no checkpoints (they take 1.0 MiB"] {
            assert!(text.contains(part), "{text}");
        }
    }
}
