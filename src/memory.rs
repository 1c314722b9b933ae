//! Estimate of a run's peak memory, made before the run starts.
//!
//! Every array that grows with the run is counted in the module that owns it. [`trainer`] counts what every run needs,
//! and [`backend`] counts what episodes need. [`PROGRAM`] covers everything that does not grow.
//!
//! Nothing else is as large. Checkpoints and policies are written directly from the populations or from a single copy,
//! see [`copies_checkpoint`]. A sweep limits its batches to half of the available memory.

use std::fs;
use std::path::Path;

use crate::backend::{self, BATCH_BYTES, PACKED_FROM, cpu};
use crate::config::{Config, Method, ValidConfig};
use crate::trainer;
use crate::world::World;

/// Bytes for the program itself: its code, the stacks of its threads and its input. The driver of a GPU is not
/// included.
pub const PROGRAM: u64 = 8 << 20;
/// Maximum bytes of populations that are copied for a checkpoint, so that it can be written while training continues.
const COPIED: u64 = 64 << 20;

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
        let [mut training, mut next, mut checkpoint, mut queue] = [0_u64; 4];
        let [mut weights, mut record, mut states] = [0_u64; 3];
        let [mut block, mut order, mut populations, mut held] = [0_u64; 4];
        for config in configs {
            let staged: Vec<(&Config, World)> =
                config.stages().iter().map(|(_, config)| (config, World::new(config))).collect();
            // The largest stage determines each size.
            let most = |size: &dyn Fn(&Config, &World) -> u64| {
                staged.iter().map(|(config, world)| size(config, world)).max().unwrap_or(0)
            };
            let (trials, policies) = (config.learning.trials as u64, config.learning.population);
            let teams = |config: &Config| trials * config.learning.episodes_per_team as u64 * config.max_teams() as u64;
            training += trainer::bytes(config);
            next += trainer::next_bytes(config);
            checkpoint += checkpoint_bytes(config);
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
        // Episodes and the final sorting of each population do not happen at the same time.
        let playing = threads as u64 * block + queue;
        let sorting = populations.min(threads as u64) * order;
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
            host: always + playing.max(sorting),
            checkpoint,
            // One batch is assembled on the host, and two are being transferred to or from the adapter.
            gpu_host: always + next + (share(weights, 1) + share(weights, 2) + records).max(sorting),
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
        #[cfg(all(feature = "cli", any(target_os = "macos", windows)))]
        () => free_of_system(),
        #[cfg(not(all(feature = "cli", any(target_os = "macos", windows))))]
        () => available_under(Path::new("/")),
    }
}

/// Returns the bytes that macOS or Windows has free.
#[cfg(all(feature = "cli", any(target_os = "macos", windows)))]
fn free_of_system() -> Option<u64> {
    let mut system = sysinfo::System::new();
    system.refresh_memory_specifics(sysinfo::MemoryRefreshKind::nothing().with_ram());
    Some(system.available_memory()).filter(|&bytes| bytes > 0)
}

/// Implementation of [`available`] on Linux, with the system's files below `root`.
#[cfg(any(test, not(all(feature = "cli", any(target_os = "macos", windows)))))]
fn available_under(root: &Path) -> Option<u64> {
    let read = |path: &str| fs::read_to_string(root.join(path)).ok();
    let kib = |text: String, name: &str| field(&text, name).map(|kib| kib.saturating_mul(1024));
    let free = kib(read("proc/meminfo")?, "MemAvailable:")?;
    let address_space = || {
        let most = field(&read("proc/self/limits")?, "Max address space")?;
        Some(most.saturating_sub(kib(read("proc/self/status")?, "VmSize:")?))
    };
    let groups = read("proc/self/cgroup").unwrap_or_default();
    let limits = groups.lines().flat_map(|line| limits_of_group(root, line));
    limits.chain(address_space()).chain([free]).min()
}

/// Returns what the memory limits of a control group and of its parent groups leave. `line` is the line of the group in
/// `/proc/self/cgroup`. Its format is `0::/path` in version 2 and `number:controllers:/path` in version 1.
#[cfg(any(test, not(all(feature = "cli", any(target_os = "macos", windows)))))]
fn limits_of_group(root: &Path, line: &str) -> Vec<u64> {
    let mut parts = line.splitn(3, ':').skip(1);
    let (Some(controllers), Some(path)) = (parts.next(), parts.next()) else { return vec![] };
    // Per version: the folder, the file with the limit, and the memory in use without files, which can be dropped.
    let (mount, limit, held) = match controllers {
        "" => ("sys/fs/cgroup", "memory.max", "anon "),
        _ if controllers.split(',').any(|name| name == "memory") => {
            ("sys/fs/cgroup/memory", "memory.limit_in_bytes", "total_rss ")
        }
        _ => return vec![],
    };
    let left = |group: &Path| -> Option<u64> {
        let group = root.join(mount).join(group.strip_prefix("/").unwrap_or(group));
        let read = |file: &str| fs::read_to_string(group.join(file)).ok();
        let most: u64 = read(limit)?.trim().parse().ok()?;
        Some(most.saturating_sub(field(&read("memory.stat")?, held).unwrap_or(0)))
    };
    // In a container the path may be that of the host. Only the group at the top exists in that case.
    Path::new(path).ancestors().filter_map(left).collect()
}

/// Returns the number after a name at the start of a line.
#[cfg(any(test, not(all(feature = "cli", any(target_os = "macos", windows)))))]
fn field(text: &str, name: &str) -> Option<u64> {
    text.lines().find_map(|line| line.strip_prefix(name)?.split_whitespace().next()?.parse().ok())
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
    fn fields_are_found_by_name() {
        let text = "MemTotal:       25000000 kB\nMemAvailable:   12 kB\nanon 7\nanon_thp 9\n";
        assert_eq!(field(text, "MemAvailable:"), Some(12));
        assert_eq!(field(text, "anon "), Some(7));
        assert_eq!(field(text, "none"), None);
    }

    /// Creates a folder with files like those of Linux.
    fn system(files: &[(&str, &str)]) -> tempfile::TempDir {
        let root = tempfile::tempdir().unwrap();
        for (name, text) in files {
            let path = root.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        root
    }

    #[test]
    fn every_limit_of_the_system_counts() {
        const FREE: (&str, &str) = ("proc/meminfo", "MemTotal: 9000 kB\nMemAvailable:    8000 kB\n");
        const NONE: &str = "9223372036854771712\n";
        let available = |files: &[(&str, &str)]| available_under(system(files).path());
        assert_eq!(available(&[]), None);
        assert_eq!(available(&[FREE]), Some(8_192_000));
        // Version 2: the parent group has a limit, and the group itself has "max".
        let second = [
            FREE,
            ("proc/self/cgroup", "0::/jobs/one\n"),
            ("sys/fs/cgroup/jobs/one/memory.max", "max\n"),
            ("sys/fs/cgroup/jobs/one/memory.stat", "anon 100000\nfile 7\n"),
            ("sys/fs/cgroup/jobs/memory.max", "5000000\n"),
            ("sys/fs/cgroup/jobs/memory.stat", "anon 1000000\nanon_thp 9\n"),
        ];
        assert_eq!(available(&second), Some(4_000_000));
        // Version 1, as Slurm creates groups: the job has a limit, and its step has none.
        let first = [
            FREE,
            ("proc/self/cgroup", "5:cpuset:/\n4:hugetlb,memory:/slurm/job_7/step_0\n0::/\n"),
            ("sys/fs/cgroup/memory/memory.limit_in_bytes", NONE),
            ("sys/fs/cgroup/memory/memory.stat", "total_rss 6000000\n"),
            ("sys/fs/cgroup/memory/slurm/job_7/memory.limit_in_bytes", "3000000\n"),
            ("sys/fs/cgroup/memory/slurm/job_7/memory.stat", "cache 5\nrss 7\ntotal_cache 9\ntotal_rss 500000\n"),
            ("sys/fs/cgroup/memory/slurm/job_7/step_0/memory.limit_in_bytes", NONE),
            ("sys/fs/cgroup/memory/slurm/job_7/step_0/memory.stat", "total_rss 500000\n"),
        ];
        assert_eq!(available(&first), Some(2_500_000));
        // Version 1 in a container: the path is that of the host.
        let contained = [
            FREE,
            ("proc/self/cgroup", "4:memory:/docker/0123\n"),
            ("sys/fs/cgroup/memory/memory.limit_in_bytes", "2000000\n"),
            ("sys/fs/cgroup/memory/memory.stat", "total_rss 0\n"),
        ];
        assert_eq!(available(&contained), Some(2_000_000));
        // `ulimit -v`.
        let limited = "Limit                     Soft Limit           Hard Limit           Units     \n\
                       Max address space         3000000              unlimited            bytes     \n";
        let status = ("proc/self/status", "Name:\tx\nVmSize:\t    1000 kB\n");
        assert_eq!(available(&[FREE, ("proc/self/limits", limited), status]), Some(1_976_000));
        let unlimited = limited.replace("3000000  ", "unlimited");
        assert_eq!(available(&[FREE, ("proc/self/limits", &unlimited), status]), Some(8_192_000));
    }

    #[test]
    fn what_is_too_large_says_what_to_do() {
        let text = TooLittle { needed: 3 << 30, available: 5 << 20, checkpoint: 1 << 20 }.to_string();
        for part in ["3.0 GiB", "5.0 MiB", "smaller population", "no checkpoints (they take 1.0 MiB"] {
            assert!(text.contains(part), "{text}");
        }
    }
}
