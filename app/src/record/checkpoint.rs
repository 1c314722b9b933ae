//! Checkpoints: the state from which a run resumes, in `checkpoints/GENERATION.safetensors`.
//!
//! A [`CheckpointWriter`] writes them on a separate thread. It keeps the last two, and also the checkpoint of
//! generation 0 if there is one. Each checkpoint records the digest of its config and the length of `metrics.csv` at that time. The
//! checksum of [`super::tensors`] protects it.
//!
//! A finished run leaves one more checkpoint, so that the run can be extended. Its weights are those of
//! `policies.safetensors`, put back into the order given by their fitness. With an evolution strategy or a hall of
//! fame it has weights of its own, because the run continues from more than the policies.

use std::ffi::OsString;
use std::io::{ErrorKind, Read, Seek, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use safetensors::tensor::Dtype;

use super::disk::{self, Disk, Output, Place};
use super::metrics::Extent;
use super::policies;
use super::tensors::{self, Tensor, TensorFile};
use super::{RecordError, config_digest};
use flotilla::config::{CheckpointConfig, Config};
use flotilla::evolve::{self, Key, Purpose, Selection};
use flotilla::host::Instant;
use flotilla::parallel::BackgroundTask;
use flotilla::trainer::{Row, Snapshot};

const KIND: &str = "checkpoint 1";
/// Maximum training time in a checkpoint, in seconds (30 000 years). A larger value is read as 0.
const MAX_SECONDS: f64 = 1e12;
/// Names of the tensors. Each holds all trials.
const WEIGHTS: &str = "weights.0";
const FITNESS: &str = "fitness.0";
const PENDING: &str = "pending.0";
/// Metadata key of [`Snapshot::last`].
const LAST: &str = "generations";
/// Metadata key of [`Checkpoint::init`].
const INIT: &str = "init";
const EXTENSION: &str = ".safetensors";
/// Number of digits of the generation in a file name.
const DIGITS: usize = 9;
/// Number of recent checkpoints that are kept.
const KEPT: usize = 2;
/// Checkpoints that are due by time take one part in `SHARE` of the run's time on average, unless [`MAX_STRETCH`] times
/// their interval is shorter.
const SHARE: f64 = 20.0;
/// Maximum extension of an interval. A stalled disk must not stop checkpoints for long.
const MAX_STRETCH: f64 = 10.0;

/// State of a run before a generation.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint<N = Vec<f32>> {
    /// [`config_digest`] of the config of the run.
    pub config: String,
    /// [`policies::Init::digest`] of the policies that the run started from. `None` for a random start.
    pub init: Option<String>,
    /// Training time in seconds.
    pub seconds: f64,
    /// Length and hash of `metrics.csv`.
    pub metrics: Extent,
    /// State of the trainer. The weights are empty if `policies.safetensors` has them.
    pub snapshot: Snapshot<N>,
}

impl<N> Checkpoint<N> {
    /// Reports whether the checkpoint belongs to a run of this config, or to the same run with fewer generations.
    pub fn is_of(&self, config: &Config) -> bool {
        let last = self.snapshot.last;
        last <= config.learning.generations && self.config == config_digest(&of_length(config, last))
    }
}

/// Returns the config with `last` generations.
pub(crate) fn of_length(config: &Config, last: usize) -> Config {
    let mut config = config.clone();
    config.learning.generations = last;
    config
}

impl<N: AsRef<[f32]>> Checkpoint<N> {
    /// Writes the checkpoint, whole or not at all.
    ///
    /// # Errors
    /// The file cannot be written. Nothing else was changed in that case.
    pub fn write(&self, disk: &Disk, path: &Path, of: &Config) -> std::io::Result<()> {
        disk.replace(path, |output| self.put(output, of))
    }

    /// Flushes the metrics to the disk, then writes the checkpoint in its folder.
    fn write_after(&self, metrics: &Output, disk: &Disk, folder: &Path, of: &Config) -> Result<(), RecordError> {
        let path = path(folder, self.snapshot.generation);
        metrics.sync().map_err(RecordError::write(metrics.path()))?;
        let written = self.write(disk, &path, of).and_then(|()| disk.sync_folder(folder));
        written.map_err(RecordError::write(&path))
    }

    /// Writes the content of a checkpoint file to a stream.
    pub fn put(&self, output: &mut dyn Write, of: &Config) -> std::io::Result<()> {
        let Checkpoint { config, init, seconds, metrics, snapshot } = self;
        let metadata = [
            ("config", config.clone()),
            ("generation", snapshot.generation.to_string()),
            (LAST, snapshot.last.to_string()),
            ("seconds", seconds.to_string()),
            ("metrics_bytes", metrics.bytes.to_string()),
            ("metrics_sha256", metrics.sha256.clone()),
            (tensors::VERSION, flotilla::version::VERSION.into()),
        ];
        let metadata = metadata.into_iter().chain(init.clone().map(|digest| (INIT, digest)));
        let (weights, fitness) = shapes(of);
        // The scores of rows whose champions have yet to play.
        let known = |row: &Row| [row.best_g, row.mean_g].into_iter().chain(row.test_g);
        let pending: Vec<f64> = snapshot.pending.iter().flatten().flat_map(known).collect();
        let mut list = Vec::new();
        // The 8-byte numbers come first, so that all tensors are aligned.
        if !pending.is_empty() {
            let columns = pending.len() / snapshot.pending.len();
            let (shape, parts) = (vec![snapshot.pending.len(), columns], vec![bytemuck::cast_slice(&pending)]);
            list.push(Tensor { name: PENDING.into(), dtype: Dtype::F64, shape, parts });
        }
        if !snapshot.weights.is_empty() {
            let trials = snapshot.weights.iter().map(AsRef::as_ref);
            list.push(Tensor::floats(WEIGHTS.into(), weights.into(), trials));
        }
        let trials = snapshot.fitness.iter().map(AsRef::as_ref);
        list.push(Tensor::floats(FITNESS.into(), fitness.into(), trials));
        tensors::put(output, KIND, metadata, &list).map(drop)
    }
}

impl Checkpoint {
    /// Reads a checkpoint of a run with the given config.
    pub fn read(source: impl Read + Seek, of: &Config) -> Result<Checkpoint, String> {
        let mut file = TensorFile::open(source)?;
        if file.kind() != Some(KIND) {
            return Err(format!("it holds {:?}, not {KIND:?}", file.kind().unwrap_or("something else")));
        }
        let text = |key: &str| file.metadata(key).map(String::from).ok_or_else(|| format!("it has no {key}"));
        let number =
            |key: &str| text(key)?.parse::<u64>().map_err(|error| format!("its {key} is not a valid number: {error}"));
        let config = text("config")?;
        // A longer time would make lines of `metrics.csv` too long for its readers. It has no influence on results.
        let seconds: Option<f64> = text("seconds")?.parse().ok();
        let seconds = seconds.filter(|seconds| (0.0..=MAX_SECONDS).contains(seconds)).unwrap_or(0.0);
        let metrics = Extent { bytes: number("metrics_bytes")?, sha256: text("metrics_sha256")? };
        let generation = number("generation")? as usize;
        let learning = &of.learning;
        let last = number(LAST)? as usize;
        if generation > last + 1 {
            return Err(format!("its generation is {generation}, past the last, {last}"));
        }
        let (weights, fitness) = shapes(of);
        // After the last generation, `policies.safetensors` may hold the weights.
        let elsewhere = generation == last + 1 && file.info(WEIGHTS).is_none();
        let mut floats = |name: &str, shape: &[usize], is_wrong: fn(&mut Vec<f32>) -> bool| {
            let mut trials: Vec<Vec<f32>> = file.read(name, Dtype::F32, shape, shape[0])?;
            match trials.iter_mut().any(is_wrong) {
                true => Err(format!("{name} has numbers out of range")),
                false => Ok(trials),
            }
        };
        let weights = match elsewhere {
            true => vec![],
            false => floats(WEIGHTS, &weights, |numbers| evolve::flush_and_validate(numbers).is_some())?,
        };
        let fitness = floats(FITNESS, &fitness, |numbers| numbers.iter().any(|number| !number.is_finite()))?;
        // From generation 1 on, rows are pending until their champions have played.
        let columns = 2 + usize::from(learning.test_episodes > 0);
        let pending: Vec<f64> = match generation {
            0 => vec![],
            _ => file.read(PENDING, Dtype::F64, &[learning.trials, columns], 1)?.pop().unwrap_or_default(),
        };
        if pending.iter().any(|share| !(0.0..=1.0).contains(share)) {
            return Err(format!("{PENDING} has numbers out of range"));
        }
        let row = |trial: usize| {
            let known = pending.chunks_exact(columns).nth(trial)?;
            let (best_g, mean_g, test_g) = (known[0], known[1], known.get(2).copied());
            Some(Row { experiment: 0, trial, generation: generation - 1, best_g, mean_g, champion_g: 0.0, test_g })
        };
        let pending = (0..learning.trials).map(row).collect();
        let snapshot = Snapshot { generation, last, weights, fitness, pending };
        let init = file.metadata(INIT).map(String::from);
        Ok(Checkpoint { config, init, seconds, metrics, snapshot })
    }

    /// Adds the missing weights from `policies.safetensors`. Returns false if that file does not belong to the same
    /// run, or the run needs more than its policies.
    #[must_use]
    fn complete(&mut self, mut file: TensorFile<impl Read + Seek>, of: &Config) -> bool {
        // A file without a kind has no checksum either: another program wrote it.
        let is_of_run = file.kind().is_some() && file.metadata(policies::CONFIG) == Some(&self.config);
        if !is_of_run || !of.learning.extends_from_policies() {
            return false;
        }
        let (population, parameters) = (of.learning.population, of.parameters());
        let mut weights = Vec::new();
        for (trial, fitness) in self.snapshot.fitness.iter().enumerate() {
            let sorted = match policies::from_file(&mut file, of, &[of.populations()], Some(trial)) {
                Ok(sorted) if sorted.policies == population => sorted.weights,
                _ => return false,
            };
            let mut slots = vec![0.0; of.populations() * (population + 1) * parameters];
            let populations = slots.chunks_exact_mut((population + 1) * parameters);
            let sorted = sorted.chunks_exact(population * parameters);
            let key = Key::new(of.learning.seed, trial, Purpose::Tournament);
            let last = self.snapshot.generation - 1;
            for (index, ((slots, sorted), fitness)) in
                populations.zip(sorted).zip(fitness.chunks_exact(population)).enumerate()
            {
                let mut put = |slot: usize, policy: &[f32]| {
                    slots[slot * parameters..(slot + 1) * parameters].copy_from_slice(policy);
                };
                // The overall best policy is the champion.
                put(population, &sorted[..parameters]);
                let order = evolve::ranking(key, last, index, Selection::of(&of.learning), fitness);
                order.into_iter().zip(sorted.chunks_exact(parameters)).for_each(|(slot, policy)| put(slot, policy));
            }
            weights.push(slots);
        }
        self.snapshot.weights = weights;
        true
    }
}

/// Returns the shapes of the weights and of the fitness, with all trials in one tensor.
fn shapes(config: &Config) -> ([usize; 4], [usize; 3]) {
    let (trials, policies) = (config.learning.trials, config.learning.population);
    let weights = [trials, config.populations(), config.learning.slots(), config.parameters()];
    (weights, [trials, config.fitness_len() / policies, policies])
}

/// Returns the generations of the checkpoints in a folder, oldest first. Temporary files are ignored.
pub fn list<'a>(folder: impl Into<Place<'a>>) -> Result<Vec<usize>, RecordError> {
    let mut generations: Vec<usize> =
        names(folder.into())?.iter().filter_map(|name| name.to_str().and_then(generation_of)).collect();
    generations.sort_unstable();
    Ok(generations)
}

/// Returns the names in a folder. A missing folder has none.
fn names(folder: Place<'_>) -> Result<Vec<OsString>, RecordError> {
    match folder.list() {
        Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => Ok(vec![]),
        // Wine has another error for a file in the folder's place.
        Err(_) if folder.path().is_file() => Ok(vec![]),
        names => names.map_err(RecordError::read(folder.path())),
    }
}

/// Returns the generation in the file name of a checkpoint, or `None` for any other name.
fn generation_of(name: &str) -> Option<usize> {
    let digits = name.strip_suffix(EXTENSION)?;
    (digits.len() == DIGITS && digits.bytes().all(|byte| byte.is_ascii_digit())).then(|| digits.parse().ok()).flatten()
}

/// Returns the path of the checkpoint of a generation.
pub fn path(folder: &Path, generation: usize) -> PathBuf {
    folder.join(format!("{generation:0DIGITS$}{EXTENSION}"))
}

/// Reads the checkpoint at a path. The weights of a finished run come from the file `policies`. Returns `None` if that
/// file is missing, damaged or from another run.
pub fn read<'a>(
    place: impl Into<Place<'a>>,
    policies: impl Into<Place<'a>>,
    config: &Config,
) -> Result<Option<Checkpoint>, RecordError> {
    let place = place.into();
    let path = place.path();
    let file = place.open().map_err(RecordError::read(path))?;
    let mut found = Checkpoint::read(file, config).map_err(|reason| RecordError::damaged(path, reason))?;
    let whole = !found.snapshot.weights.is_empty()
        || match tensors::open(policies) {
            Ok(file) => found.complete(file, config),
            // The system may be able to read the file later, so the checkpoint must be kept.
            Err(RecordError::Read { path, error }) if error.kind() != ErrorKind::NotFound => {
                return Err(RecordError::Read { path, error });
            }
            Err(_) => false,
        };
    Ok(whole.then_some(found))
}

/// Writes checkpoints during training, one at a time.
pub struct CheckpointWriter {
    disk: Disk,
    folder: PathBuf,
    config: Arc<Config>,
    /// Generations of the complete checkpoints, oldest first.
    kept: Vec<usize>,
    writing: Option<BackgroundTask<Result<(usize, Duration), RecordError>>>,
    /// Generation and time of the last checkpoint.
    last: (usize, Instant),
    /// Average time that a checkpoint takes, in seconds. Later ones count more.
    cost: f64,
}

impl CheckpointWriter {
    /// Creates a writer for an existing folder with the checkpoints `kept`. The run resumes before `generation`.
    pub fn new(disk: Disk, folder: PathBuf, config: Config, kept: Vec<usize>, generation: usize) -> CheckpointWriter {
        let last = (generation, Instant::now());
        CheckpointWriter { disk, folder, config: Arc::new(config), kept, writing: None, last, cost: 0.0 }
    }

    /// Reports whether a checkpoint is due before a generation is played. By time, none is due while the
    /// previous one is being written, and the interval grows, up to tenfold, until writing takes at most 1/20 of it.
    pub fn is_due(&self, schedule: &CheckpointConfig, generation: usize) -> bool {
        let (last, moment) = self.last;
        if generation == last {
            return false;
        }
        let writing = self.writing.as_ref().is_some_and(|writing| !writing.is_finished());
        let seconds = schedule.seconds;
        schedule.generations > 0 && generation - last >= schedule.generations
            || seconds > 0.0
                && !writing
                && moment.elapsed().as_secs_f64() >= (self.cost * SHARE).clamp(seconds, MAX_STRETCH * seconds)
    }

    fn add_cost(&mut self, cost: Duration) {
        self.cost += (cost.as_secs_f64() - self.cost) / 4.0;
    }

    /// Starts to write a checkpoint after the previous one is complete. `metrics` is flushed to the disk first. The
    /// cost of the checkpoint counts from `since`.
    pub fn save(&mut self, checkpoint: Checkpoint, metrics: Output, since: Instant) -> Result<(), RecordError> {
        self.wait()?;
        let generation = checkpoint.snapshot.generation;
        self.last = (generation, Instant::now());
        let (disk, config, folder) = (self.disk.clone(), self.config.clone(), self.folder.clone());
        self.writing = Some(BackgroundTask::start(move || {
            checkpoint.write_after(&metrics, &disk, &folder, &config)?;
            Ok((generation, since.elapsed()))
        }));
        Ok(())
    }

    /// Writes a checkpoint of borrowed weights before it returns. See [`CheckpointWriter::save`].
    pub fn save_now(
        &mut self,
        checkpoint: &Checkpoint<&[f32]>,
        metrics: &Output,
        since: Instant,
    ) -> Result<(), RecordError> {
        self.wait()?;
        let generation = checkpoint.snapshot.generation;
        checkpoint.write_after(metrics, &self.disk, &self.folder, &self.config)?;
        self.last = (generation, Instant::now());
        self.add_cost(since.elapsed());
        self.keep(generation)
    }

    /// Waits until the last checkpoint is written, and removes old ones.
    pub fn wait(&mut self) -> Result<(), RecordError> {
        let Some(writing) = self.writing.take() else { return Ok(()) };
        let (generation, cost) = writing.finish()?;
        self.add_cost(cost);
        self.keep(generation)
    }

    /// Records a checkpoint as complete, and removes old ones.
    fn keep(&mut self, generation: usize) -> Result<(), RecordError> {
        self.kept.retain(|&kept| kept != generation);
        self.kept.push(generation);
        // The checkpoint of generation 0 is kept, because the first generations cannot be repeated without it.
        let first = usize::from(self.kept.first() == Some(&0));
        while self.kept.len() > first + KEPT {
            let path = path(&self.folder, self.kept[first]);
            self.disk.remove(&path).map_err(RecordError::write(&path))?;
            self.kept.remove(first);
        }
        Ok(())
    }

    /// Rewrites all checkpoints for the same run with the fewer generations of `config`.
    pub(crate) fn shorten(&mut self, config: &Config) -> Result<(), RecordError> {
        self.wait()?;
        for &generation in &self.kept {
            let path = path(&self.folder, generation);
            let file = self.disk.at(&path).open().map_err(RecordError::read(&path))?;
            let mut kept =
                Checkpoint::read(file, &self.config).map_err(|reason| RecordError::damaged(&path, reason))?;
            kept.config = config_digest(config);
            kept.snapshot.last = config.learning.generations;
            kept.write(&self.disk, &path, config).map_err(RecordError::write(&path))?;
        }
        self.config = Arc::new(config.clone());
        Ok(())
    }

    /// Completes the last checkpoint if its writer has finished.
    pub(crate) fn poll(&mut self) -> Result<(), RecordError> {
        if self.writing.as_ref().is_some_and(BackgroundTask::is_finished) { self.wait() } else { Ok(()) }
    }

    /// Returns the generation of the newest complete checkpoint.
    pub fn newest(&self) -> Option<usize> {
        self.kept.last().copied()
    }
}

impl Drop for CheckpointWriter {
    fn drop(&mut self) {
        // Wait for the writer even after an error, because the lock of the folder is released next.
        if let Some(writing) = self.writing.take() {
            writing.end();
        }
    }
}

/// Removes temporary files of interrupted writers, and returns the generations of the checkpoints, oldest first.
pub(crate) fn remove_temporary_files(disk: &Disk, folder: &Path) -> Result<Vec<usize>, RecordError> {
    let generations = list(disk.at(folder))?;
    for name in names(disk.at(folder))? {
        let path = folder.join(name);
        let whole = disk::of_temporary(&path);
        if whole.is_some_and(|name| generation_of(name).is_some()) {
            disk.remove(&path).map_err(RecordError::write(&path))?;
        }
    }
    Ok(generations)
}

/// Returns the path to which an unusable checkpoint is renamed.
pub(crate) fn quarantine_path(path: &Path) -> PathBuf {
    path.with_extension("safetensors.damaged")
}
