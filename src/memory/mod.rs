//! Estimate of a run's peak memory, made before the run starts.
//!
//! [`StageBytes`] lists every array that grows with the run. [`PROGRAM`] covers everything that does not grow.
//!
//! Nothing else is as large. Checkpoints and policies are written directly from the populations or from a single copy,
//! see [`copies_checkpoint`]. A sweep limits its batches to half of the available memory.

use crate::backend::{self, BATCH_BYTES, cpu};
use crate::config::{Config, Fitness, Method, StageConfig, ValidConfig};
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

/// Words of 4 bytes per episode of a batch, on any backend.
const EPISODE_WORDS: u64 = 40;

/// Bytes of the arrays of all trials of a config in one stage.
#[derive(Clone, Copy, Default)]
struct StageBytes {
    /// This generation and the next, its schedules and its scores.
    training: u64,
    /// The team schedules alone. If a GPU holds the populations, those of the next generation are drawn early.
    schedules: u64,
    /// The start positions of agents, and the positions of POIs if they move.
    starts: u64,
    /// On the CPU: the queue of all vectors of teams.
    queue: u64,
    /// On the CPU: a thread's vector of teams.
    block: u64,
    /// On a GPU: the weights, the records, the states and the tasks of all teams.
    on_gpu: [u64; 4],
    /// The largest of these of one team.
    largest_of_team: u64,
}

impl StageBytes {
    fn of(config: &StageConfig) -> StageBytes {
        let (world, learning) = (World::new(config), &config.learning);
        let sizes = [learning.trials, config.populations(), learning.population];
        let fitnesses = config.fitnesses();
        let largest = |bytes: fn(&World, Fitness) -> u64| {
            fitnesses.iter().map(|&fitness| bytes(&world, fitness)).fold(0, u64::max)
        };
        let [trials, populations, policies] = sizes.map(|size| size as u64);
        let [leaders, teams, episodes] = [config.learners(), config.max_teams(), learning.episodes_per_team];
        let [leaders, teams, episodes] = [leaders, teams, episodes].map(|size| size as u64);
        let tests = learning.test_episodes as u64;
        let (slots, parameters) = (learning.slots() as u64, config.parameters() as u64);
        let moved = match world.drawn_headings.is_empty() {
            true if config.pois_move() => world.pois.len(),
            true => 0,
            false => world.pois.len() + world.agents(),
        };
        let starts = 4 * trials * (episodes + tests) * 2 * (world.agents() + moved) as u64;
        let schedules = 4 * trials * (populations * learning.team_count() as u64 + leaders * teams) + starts;
        // Fitness is summed in 64 bits if a policy plays in several teams.
        let is_summed = learning.partners > 1 || learning.hall_of_fame > 0;
        let words_of_trial = 2 * populations * slots * parameters // this generation and the next
            + config.fitness_len() as u64 + populations * slots // fitness and parents
            + episodes * teams * (1 + leaders) // POIs observed and scores
            + if is_summed { 2 * populations * policies } else { 0 }
            + (episodes + tests) * EPISODE_WORDS;
        let played = trials * (episodes * teams).max(tests);
        let record = largest(backend::record_bytes) + backend::sum_bytes(&world);
        let states = largest(|world, fitness| backend::dispatch_bytes(world, fitness)[0]);
        let tasks = largest(|world, fitness| backend::dispatch_bytes(world, fitness)[1]);
        let of_team = [backend::weight_bytes(&world), record, states, tasks];
        StageBytes {
            training: 4 * trials * words_of_trial + schedules,
            schedules,
            starts,
            queue: played.div_ceil(cpu::lanes()) * 16,
            block: largest(cpu::block_bytes),
            on_gpu: of_team.map(|bytes| played.saturating_mul(bytes)),
            largest_of_team: of_team.into_iter().fold(0, u64::max),
        }
    }

    /// Returns the largest size of each array in any stage. In the generation that begins a stage, the starts of the
    /// stage before are kept too.
    fn most(config: &ValidConfig) -> StageBytes {
        let most = config.stages().iter().fold(StageBytes::default(), |most, (_, stage)| {
            let stage = StageBytes::of(stage);
            StageBytes {
                training: most.training.max(stage.training),
                schedules: most.schedules.max(stage.schedules),
                starts: most.starts.max(stage.starts),
                queue: most.queue.max(stage.queue),
                block: most.block.max(stage.block),
                on_gpu: std::array::from_fn(|array| most.on_gpu[array].max(stage.on_gpu[array])),
                largest_of_team: most.largest_of_team.max(stage.largest_of_team),
            }
        });
        let before = if config.stages.is_empty() { 0 } else { most.starts };
        StageBytes { training: most.training + before, schedules: most.schedules + before, ..most }
    }
}

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
    "this needs {} of memory at its peak, and {} is available; choose fewer policies, trials, agents or steps{}, or \
     another machine",
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
        let [mut training, mut next, mut checkpoint, mut queue, mut drawing] = [0_u64; 5];
        let [mut block, mut order, mut populations, mut held] = [0_u64; 4];
        let (mut on_gpu, mut batch) = ([0_u64; 4], BATCH_BYTES);
        for config in configs {
            let most = StageBytes::most(config);
            let trials = config.learning.trials as u64;
            training += most.training;
            next += most.schedules;
            checkpoint += checkpoint_bytes(config);
            drawing = drawing.max(DRAWN * (config.learning.generations as u64 + 1).next_power_of_two());
            queue += most.queue;
            block = block.max(most.block);
            // An evolution strategy also needs the utilities.
            let strategy = config.learning.method != Method::Tournament;
            let ranked = size_of::<usize>() + if strategy { size_of::<f64>() } else { 0 };
            order = order.max((config.learning.population * ranked) as u64);
            populations += trials * config.populations() as u64;
            if !strategy {
                held +=
                    trials * backend::held_bytes([config.populations(), config.learning.slots(), config.parameters()]);
            }
            batch = batch.max(most.largest_of_team);
            on_gpu.iter_mut().zip(most.on_gpu).for_each(|(sum, bytes)| *sum = sum.saturating_add(bytes));
        }
        let [weights, record, states, tasks] = on_gpu;
        // Episodes, the final sorting of each population and the picture do not happen at the same time.
        let playing = threads as u64 * block + queue;
        let ending = (populations.min(threads as u64) * order).max(drawing);
        let always = PROGRAM + training + checkpoint;
        // A batch ends when the largest of its large buffers is full, and has at least one team. Two batches are in progress
        // at a time.
        let fullest = on_gpu.into_iter().fold(1, u64::max);
        let share = |bytes: u64, batches: u64| {
            let of_batch = u128::from(bytes) * u128::from(batch) / u128::from(fullest);
            bytes.min(of_batch as u64 * batches)
        };
        let records = share(record, 2);
        Peaks {
            host: always + playing.max(ending),
            checkpoint,
            // One batch is assembled on the host, and two are being transferred to or from the adapter.
            gpu_host: always + next + (share(weights + tasks, 1) + share(weights + tasks, 2) + records).max(ending),
            adapter: share(weights, 2) + records + share(states, 2) + share(tasks, 2) + held,
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

/// Fails if teams cannot be played and scored on so many threads of the CPU, with traces of some of them.
///
/// # Errors
/// The available memory is smaller than what they need.
pub fn check_rollout(world: &World, fitnesses: &[Fitness], threads: usize, traced: usize) -> Result<(), TooLittle> {
    let block = fitnesses.iter().map(|&fitness| cpu::block_bytes(world, fitness)).max().unwrap_or(0);
    let traces = backend::trace_bytes(world).saturating_mul(traced as u64);
    check(traces.saturating_add(threads as u64 * block), 0)
}

/// Reports whether so many bytes can be allocated now. An allocation that fails later would abort the process.
pub fn can_allocate(bytes: u128) -> bool {
    usize::try_from(bytes).is_ok_and(|bytes| Vec::<u8>::new().try_reserve_exact(bytes).is_ok())
}

/// Reports whether a checkpoint of these configs is copied and written while training continues. Larger checkpoints are
/// written directly from the populations, and training waits.
pub fn copies_checkpoint<'a>(configs: impl IntoIterator<Item = &'a Config>) -> bool {
    configs.into_iter().map(snapshot_bytes).sum::<u64>() <= COPIED
}

/// Returns the bytes of the weights and scores in a [`Snapshot`](crate::trainer::Snapshot).
pub(crate) fn snapshot_bytes(config: &Config) -> u64 {
    let (learning, populations) = (&config.learning, config.populations() as u64);
    let weights = populations * learning.slots() as u64 * config.parameters() as u64;
    4 * learning.trials as u64 * (weights + config.fitness_len() as u64)
}

/// Returns the bytes that a checkpoint copies.
fn checkpoint_bytes(config: &Config) -> u64 {
    let due = config.checkpoint.generations > 0 || config.checkpoint.seconds > 0.0;
    if due && copies_checkpoint([config]) { snapshot_bytes(config) } else { 0 }
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
        for part in ["3.0 GiB", "5.0 MiB", "fewer policies", "no checkpoints (they take 1.0 MiB"] {
            assert!(text.contains(part), "{text}");
        }
    }
}
