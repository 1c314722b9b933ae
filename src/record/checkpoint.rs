//! Checkpoints: all that a run needs to go on, in `checkpoints/GENERATION.safetensors`.
//!
//! A [`Keeper`] writes them on a thread of its own and keeps the last two. Each says which config it belongs to and up
//! to where `metrics.csv` had come, and stands under the checksum of [`super::tensors`].

use std::collections::BTreeMap;
use std::fs;
use std::io::{Read, Seek};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use safetensors::tensor::Dtype;
use sha2::{Digest, Sha256};

use super::disk::{self, Disk, Output};
use super::metrics::{Mark, Row};
use super::policies::admit;
use super::tensors::{self, Tensor, TensorFile};
use super::{RecordError, hex};
use crate::config::{self, Config};
use crate::file;

const KIND: &str = "checkpoint 1";
const EXTENSION: &str = ".safetensors";
/// Digits of the generation in a checkpoint's name.
const DIGITS: usize = 9;
/// How many are kept.
const KEPT: usize = 2;
/// Of a run's time, checkpoints by the clock take one part in this at most.
const SHARE: u32 = 20;

/// What training needs to go on from where it was: the populations about to play, and each trial's unfinished row.
///
/// Its numbers are its own, or (`N` a slice) a trainer's.
#[derive(Clone, Debug, PartialEq)]
pub struct Snapshot<N = Vec<f32>> {
    /// The generation that plays next.
    pub generation: usize,
    /// `[arms][trials]` of weights `[leaders][policies + 1][parameters]`.
    pub weights: Vec<Vec<N>>,
    /// `[arms][trials]` of the scores of the generation before, `[leaders][policies]`.
    pub fitness: Vec<Vec<N>>,
    pub pending: Vec<Vec<Option<Row>>>,
}

/// A run at one moment.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint<N = Vec<f32>> {
    /// [`digest`] of the run's config.
    pub config: String,
    /// Time trained.
    pub seconds: f64,
    pub metrics: Mark,
    pub snapshot: Snapshot<N>,
}

/// SHA-256 of all of a config that has a say in the results.
pub fn digest(config: &Config) -> String {
    hex(&Sha256::digest(without_checkpoint(config).to_toml()))
}

/// The config with `[checkpoint]`, which may differ between sessions of one run, at its defaults.
pub fn without_checkpoint(config: &Config) -> Config {
    Config { checkpoint: config::Checkpoint::default(), ..config.clone() }
}

impl<N: AsRef<[f32]>> Checkpoint<N> {
    /// Writes it, whole or not at all.
    ///
    /// # Errors
    /// The file cannot be written; nothing else was touched then.
    pub fn write(&self, disk: &Disk, path: &Path, configs: &[Config]) -> std::io::Result<()> {
        let Checkpoint { config, seconds, metrics, snapshot } = self;
        let metadata = BTreeMap::from(
            [
                ("config", config.clone()),
                ("generation", snapshot.generation.to_string()),
                ("seconds", seconds.to_string()),
                ("metrics_bytes", metrics.bytes.to_string()),
                ("metrics_sha256", metrics.sha256.clone()),
            ]
            .map(|(key, value)| (key.to_string(), value)),
        );
        let pending: Vec<Vec<[f64; 2]>> = snapshot
            .pending
            .iter()
            .map(|trials| trials.iter().flatten().map(|row| [row.best_g, row.mean_g]).collect())
            .collect();
        let mut list = Vec::new();
        for (arm, config) in configs.iter().enumerate() {
            let Shapes { weights, fitness, .. } = Shapes::of(config);
            if !pending[arm].is_empty() {
                let (shape, parts) = (vec![pending[arm].len(), 2], vec![bytemuck::cast_slice(&pending[arm])]);
                list.push(Tensor { name: format!("pending.{arm}"), dtype: Dtype::F64, shape, parts });
            }
            list.push(Tensor::floats(
                format!("weights.{arm}"),
                weights.into(),
                snapshot.weights[arm].iter().map(AsRef::as_ref),
            ));
            list.push(Tensor::floats(
                format!("fitness.{arm}"),
                fitness.into(),
                snapshot.fitness[arm].iter().map(AsRef::as_ref),
            ));
        }
        // Numbers of 8 bytes first, so that all are aligned.
        list.sort_by_key(|tensor| tensor.dtype != Dtype::F64);
        tensors::write(disk, path, KIND, &metadata, &list)
    }
}

impl Checkpoint {
    /// Reads a checkpoint of a trainer of these configs.
    ///
    /// # Errors
    /// What is wrong with it, in words.
    pub fn read(source: impl Read + Seek, configs: &[Config]) -> Result<Checkpoint, String> {
        let mut file = TensorFile::open(source)?;
        if file.kind() != Some(KIND) {
            return Err(format!("it holds {:?}, not {KIND:?}", file.kind().unwrap_or("something else")));
        }
        let text = |key: &str| file.metadata(key).map(String::from).ok_or_else(|| format!("it does not say its {key}"));
        let number = |key: &str| {
            text(key)?.parse::<u64>().map_err(|error| format!("its {key} is no number that can be: {error}"))
        };
        let config = text("config")?;
        let seconds = text("seconds")?.parse().ok().filter(|seconds: &f64| seconds.is_finite() && *seconds >= 0.0);
        let metrics = Mark { bytes: number("metrics_bytes")?, sha256: text("metrics_sha256")? };
        let generation = number("generation")? as usize;
        let last = configs.iter().map(|config| config.learning.generations).max().unwrap_or(0);
        if generation > last + 2 {
            return Err(format!("its generation is {generation}, past the last, {last}"));
        }
        let mut snapshot = Snapshot { generation, weights: vec![], fitness: vec![], pending: vec![] };
        for (arm, config) in configs.iter().enumerate() {
            let shapes = Shapes::of(config);
            let mut floats = |name: String, shape: &[usize]| -> Result<Vec<Vec<f32>>, String> {
                let mut trials: Vec<Vec<f32>> = file.read(&name, Dtype::F32, shape, shape[0])?;
                match trials.iter_mut().any(|numbers| admit(numbers).is_some()) {
                    true => Err(format!("{name} has numbers that cannot be")),
                    false => Ok(trials),
                }
            };
            snapshot.weights.push(floats(format!("weights.{arm}"), &shapes.weights)?);
            snapshot.fitness.push(floats(format!("fitness.{arm}"), &shapes.fitness)?);
            let name = format!("pending.{arm}");
            // An arm's rows wait from its first generation until its champions have played.
            let waiting = (1..=config.learning.generations + 1).contains(&generation);
            let pending: Vec<[f64; 2]> = match waiting {
                true => file.read(&name, Dtype::F64, &[config.learning.trials, 2], 1)?.pop().unwrap_or_default(),
                false => vec![],
            };
            if pending.iter().flatten().any(|share| !(0.0..=1.0).contains(share)) {
                return Err(format!("{name} has numbers that cannot be"));
            }
            let row = |trial: usize| {
                let &[best_g, mean_g] = pending.get(trial)?;
                Some(Row { arm, trial, generation: generation - 1, best_g, mean_g, champion_g: 0.0 })
            };
            snapshot.pending.push((0..config.learning.trials).map(row).collect());
        }
        let seconds = seconds.ok_or("its seconds are no number that can be")?;
        Ok(Checkpoint { config, seconds, metrics, snapshot })
    }
}

/// Shapes of an arm's tensors, all trials together.
struct Shapes {
    weights: [usize; 4],
    fitness: [usize; 3],
}

impl Shapes {
    fn of(config: &Config) -> Shapes {
        let (trials, leaders, policies) = (config.learning.trials, config.learners(), config.learning.population);
        Shapes { weights: [trials, leaders, policies + 1, config.parameters()], fitness: [trials, leaders, policies] }
    }
}

/// The generations of the checkpoints in a folder, oldest first; leftovers of writing are none.
///
/// # Errors
/// The folder cannot be read.
pub fn list(folder: &Path) -> Result<Vec<usize>, RecordError> {
    let entries = match fs::read_dir(folder) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(vec![]),
        entries => entries.map_err(RecordError::read(folder))?,
    };
    let generation = |name: &str| -> Option<usize> {
        let digits = name.strip_suffix(EXTENSION)?;
        (digits.len() == DIGITS && digits.bytes().all(|byte| byte.is_ascii_digit()))
            .then(|| digits.parse().ok())
            .flatten()
    };
    let mut generations = Vec::new();
    for entry in entries {
        let entry = entry.map_err(RecordError::read(folder))?;
        generations.extend(entry.file_name().to_str().and_then(generation));
    }
    generations.sort_unstable();
    Ok(generations)
}

/// Where the checkpoint of a generation is.
pub fn path(folder: &Path, generation: usize) -> PathBuf {
    folder.join(format!("{generation:0DIGITS$}{EXTENSION}"))
}

/// Opens one and reads it.
///
/// # Errors
/// It cannot be read, or is damaged.
pub fn read(path: &Path, configs: &[Config]) -> Result<Checkpoint, RecordError> {
    let file = file::open(path).map_err(RecordError::read(path))?;
    Checkpoint::read(file, configs).map_err(|reason| RecordError::damaged(path, reason))
}

/// When a run's checkpoints are due; 0 is never.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Schedule {
    /// After so many generations, waiting where the last one is still being written.
    pub generations: usize,
    /// After so many seconds, and not before writing has taken less than a twentieth of the time.
    pub seconds: f64,
}

/// Writes checkpoints beside training, one at a time.
pub struct Keeper {
    disk: Disk,
    folder: PathBuf,
    configs: Arc<Vec<Config>>,
    /// Generations of the checkpoints that are whole, oldest first.
    kept: Vec<usize>,
    writing: Option<JoinHandle<Result<(usize, Duration), RecordError>>>,
    /// The generation, the moment and the cost of the last.
    last: (usize, Instant, Duration),
}

impl Keeper {
    /// Keeps checkpoints in a folder, which exists and has these already.
    pub fn new(disk: Disk, folder: PathBuf, configs: Vec<Config>, kept: Vec<usize>, generation: usize) -> Keeper {
        let last = (generation, Instant::now(), Duration::ZERO);
        Keeper { disk, folder, configs: Arc::new(configs), kept, writing: None, last }
    }

    /// Whether a checkpoint should be made before a generation plays.
    pub fn is_due(&self, schedule: &Schedule, generation: usize) -> bool {
        let (last, moment, cost) = self.last;
        if generation == last {
            return false;
        }
        let writing = self.writing.as_ref().is_some_and(|writing| !writing.is_finished());
        let (elapsed, seconds) = (moment.elapsed(), schedule.seconds);
        schedule.generations > 0 && generation - last >= schedule.generations
            || seconds > 0.0 && !writing && elapsed.as_secs_f64() >= seconds && elapsed >= cost * SHARE
    }

    /// Hands over a checkpoint to be written; waits for the one before it. `metrics` is brought to the disk first.
    ///
    /// # Errors
    /// The one before it could not be written.
    pub fn save(&mut self, checkpoint: Checkpoint, metrics: Output, since: Instant) -> Result<(), RecordError> {
        self.wait()?;
        let generation = checkpoint.snapshot.generation;
        self.last = (generation, Instant::now(), since.elapsed());
        let (disk, configs) = (self.disk.clone(), self.configs.clone());
        let path = path(&self.folder, generation);
        self.writing = Some(std::thread::spawn(move || {
            metrics.sync().map_err(RecordError::write(metrics.path()))?;
            checkpoint.write(&disk, &path, &configs).map_err(RecordError::write(&path))?;
            Ok((generation, since.elapsed()))
        }));
        Ok(())
    }

    /// [`Keeper::save`], here and now, of numbers that are not its own.
    ///
    /// # Errors
    /// This checkpoint or the one before it could not be written.
    pub fn save_now(
        &mut self,
        checkpoint: &Checkpoint<&[f32]>,
        metrics: &Output,
        since: Instant,
    ) -> Result<(), RecordError> {
        self.wait()?;
        let generation = checkpoint.snapshot.generation;
        let path = path(&self.folder, generation);
        metrics.sync().map_err(RecordError::write(metrics.path()))?;
        checkpoint.write(&self.disk, &path, &self.configs).map_err(RecordError::write(&path))?;
        self.last = (generation, Instant::now(), since.elapsed());
        self.keep(generation)
    }

    /// Waits until all is written, and removes what is not kept.
    ///
    /// # Errors
    /// The last checkpoint could not be written.
    pub fn wait(&mut self) -> Result<(), RecordError> {
        let Some(writing) = self.writing.take() else { return Ok(()) };
        let (generation, cost) = writing.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
        self.last.2 = cost;
        self.keep(generation)
    }

    /// Counts a checkpoint as whole, and removes what is not kept.
    fn keep(&mut self, generation: usize) -> Result<(), RecordError> {
        self.kept.retain(|&kept| kept != generation);
        self.kept.push(generation);
        while self.kept.len() > KEPT {
            let path = path(&self.folder, self.kept[0]);
            self.disk.remove(&path).map_err(RecordError::write(&path))?;
            self.kept.remove(0);
        }
        Ok(())
    }

    /// Notices that a checkpoint is written, or could not be.
    ///
    /// # Errors
    /// The last checkpoint could not be written.
    pub fn poll(&mut self) -> Result<(), RecordError> {
        if self.writing.as_ref().is_some_and(JoinHandle::is_finished) { self.wait() } else { Ok(()) }
    }

    /// The generation of the newest whole checkpoint.
    pub fn newest(&self) -> Option<usize> {
        self.kept.last().copied()
    }
}

impl Drop for Keeper {
    fn drop(&mut self) {
        // Whoever leaves early still lets the writer finish: the folder's lock goes next.
        if let Some(writing) = self.writing.take() {
            let _ = writing.join();
        }
    }
}

/// Clears away what an interrupted writer left, and gives what is there, oldest first.
///
/// # Errors
/// The folder cannot be read or written.
pub fn tidy(disk: &Disk, folder: &Path) -> Result<Vec<usize>, RecordError> {
    let generations = list(folder)?;
    if let Ok(entries) = fs::read_dir(folder) {
        for entry in entries.flatten() {
            let path = entry.path();
            if path.extension().is_some_and(|extension| extension == "tmp") {
                disk.remove(&path).map_err(RecordError::write(&path))?;
            }
        }
    }
    Ok(generations)
}

/// Where a checkpoint that cannot be used is put aside.
pub fn aside(path: &Path) -> PathBuf {
    let mut name = disk::temporary(path);
    name.set_extension("damaged");
    name
}
