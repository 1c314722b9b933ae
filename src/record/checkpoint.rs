//! Checkpoints: all that a run needs to go on, in `checkpoints/GENERATION.safetensors`.
//!
//! A [`Keeper`] writes them on a thread of its own and keeps the last two. Each says which config it belongs to and up
//! to where `metrics.csv` had come, and stands under the checksum of [`super::tensors`].
//!
//! A finished run leaves one more, to be extended from: its weights are those of `policies.safetensors`, put back into
//! the order that their fitness tells.

use std::collections::BTreeMap;
use std::fs;
use std::io::{ErrorKind, Read, Seek, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use safetensors::tensor::Dtype;

use super::disk::{self, Disk, Output};
use super::metrics::Extent;
use super::policies;
use super::tensors::{self, Tensor, TensorFile};
use super::{RecordError, config_digest};
use crate::config::Config;
use crate::evolve;
use crate::file;
use crate::host::Instant;
use crate::parallel::Aside;
use crate::trainer::{Row, Snapshot};

const KIND: &str = "checkpoint 1";
/// Maximum training time of a checkpoint, 30 000 years. A longer one counts as 0.
const MAX_SECONDS: f64 = 1e12;
/// Tensors, of all trials together.
const WEIGHTS: &str = "weights.0";
const FITNESS: &str = "fitness.0";
const PENDING: &str = "pending.0";
/// Metadata: [`Snapshot::last`].
const LAST: &str = "generations";
/// Metadata: [`Checkpoint::init`].
const INIT: &str = "init";
const EXTENSION: &str = ".safetensors";
/// Digits of the generation in a checkpoint's name.
const DIGITS: usize = 9;
/// How many are kept.
const KEPT: usize = 2;
/// Of a run's time, checkpoints by the clock take one part in this at most.
const SHARE: u32 = 20;

/// A run at one moment.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint<N = Vec<f32>> {
    /// [`config_digest`] of the run's config.
    pub config: String,
    /// [`policies::Init::digest`] of what the run started from, if not at random.
    pub init: Option<String>,
    /// Time trained.
    pub seconds: f64,
    /// How far `metrics.csv` had come.
    pub metrics: Extent,
    /// Without weights where these are kept in `policies.safetensors`.
    pub snapshot: Snapshot<N>,
}

impl<N> Checkpoint<N> {
    /// Whether it is of a run of this config, or of the same that was to be shorter.
    pub fn is_of(&self, config: &Config) -> bool {
        let last = self.snapshot.last;
        last <= config.learning.generations && self.config == config_digest(&of_length(config, last))
    }
}

/// The config of a run that is as long as this: stages that begin later are none of it.
pub fn of_length(config: &Config, last: usize) -> Config {
    let mut config = config.clone();
    config.learning.generations = last;
    config.stages.retain(|stage| stage.from <= last);
    config
}

impl<N: AsRef<[f32]>> Checkpoint<N> {
    /// Writes it, whole or not at all.
    ///
    /// # Errors
    /// The file cannot be written; nothing else was touched then.
    pub fn write(&self, disk: &Disk, path: &Path, of: &Config) -> std::io::Result<()> {
        disk.replace(path, |output| self.put(output, of))
    }

    /// Writes what such a file holds into a stream.
    ///
    /// # Errors
    /// The stream refuses it.
    pub fn put(&self, output: &mut dyn Write, of: &Config) -> std::io::Result<()> {
        let Checkpoint { config, init, seconds, metrics, snapshot } = self;
        let mut metadata = BTreeMap::from(
            [
                ("config", config.clone()),
                ("generation", snapshot.generation.to_string()),
                (LAST, snapshot.last.to_string()),
                ("seconds", seconds.to_string()),
                ("metrics_bytes", metrics.bytes.to_string()),
                ("metrics_sha256", metrics.sha256.clone()),
                (tensors::VERSION, crate::VERSION.into()),
            ]
            .map(|(key, value)| (key.to_string(), value)),
        );
        metadata.extend(init.iter().map(|digest| (INIT.to_string(), digest.clone())));
        let Shapes { weights, fitness, .. } = Shapes::of(of);
        let pending: Vec<[f64; 2]> = snapshot.pending.iter().flatten().map(|row| [row.best_g, row.mean_g]).collect();
        let mut list = Vec::new();
        // Numbers of 8 bytes first, so that all are aligned.
        if !pending.is_empty() {
            let (shape, parts) = (vec![pending.len(), 2], vec![bytemuck::cast_slice(&pending)]);
            list.push(Tensor { name: PENDING.into(), dtype: Dtype::F64, shape, parts });
        }
        if !snapshot.weights.is_empty() {
            let trials = snapshot.weights.iter().map(AsRef::as_ref);
            list.push(Tensor::floats(WEIGHTS.into(), weights.into(), trials));
        }
        let trials = snapshot.fitness.iter().map(AsRef::as_ref);
        list.push(Tensor::floats(FITNESS.into(), fitness.into(), trials));
        tensors::put(output, KIND, &metadata, &list).map(drop)
    }
}

impl Checkpoint {
    /// Reads a checkpoint of a run of a config.
    ///
    /// # Errors
    /// What is wrong with it, in words.
    pub fn read(source: impl Read + Seek, of: &Config) -> Result<Checkpoint, String> {
        let mut file = TensorFile::open(source)?;
        if file.kind() != Some(KIND) {
            return Err(format!("it holds {:?}, not {KIND:?}", file.kind().unwrap_or("something else")));
        }
        let text = |key: &str| file.metadata(key).map(String::from).ok_or_else(|| format!("it does not say its {key}"));
        let number = |key: &str| {
            text(key)?.parse::<u64>().map_err(|error| format!("its {key} is no number that can be: {error}"))
        };
        let config = text("config")?;
        // A longer time would make lines of metrics.csv too long for every reader. It has no influence on results.
        let seconds: Option<f64> = text("seconds")?.parse().ok();
        let seconds = seconds.filter(|seconds| (0.0..=MAX_SECONDS).contains(seconds)).unwrap_or(0.0);
        let metrics = Extent { bytes: number("metrics_bytes")?, sha256: text("metrics_sha256")? };
        let generation = number("generation")? as usize;
        let learning = &of.learning;
        // Those of an earlier version do not say it, and are of runs that were not extended.
        let last = file.metadata(LAST).map_or(Ok(learning.generations as u64), |_| number(LAST))? as usize;
        if generation > last + 1 {
            return Err(format!("its generation is {generation}, past the last, {last}"));
        }
        let shapes = Shapes::of(of);
        // What comes after the last generation may be kept elsewhere.
        let elsewhere = generation == last + 1 && file.info(WEIGHTS).is_none();
        let mut floats = |name: &str, shape: &[usize]| -> Result<Vec<Vec<f32>>, String> {
            let mut trials: Vec<Vec<f32>> = file.read(name, Dtype::F32, shape, shape[0])?;
            match trials.iter_mut().any(|numbers| evolve::admit(numbers).is_some()) {
                true => Err(format!("{name} has numbers that cannot be")),
                false => Ok(trials),
            }
        };
        let weights = if elsewhere { vec![] } else { floats(WEIGHTS, &shapes.weights)? };
        let fitness = floats(FITNESS, &shapes.fitness)?;
        // Rows wait from the first generation on until the champions have played.
        let pending: Vec<[f64; 2]> = match generation {
            0 => vec![],
            _ => file.read(PENDING, Dtype::F64, &[learning.trials, 2], 1)?.pop().unwrap_or_default(),
        };
        if pending.iter().flatten().any(|share| !(0.0..=1.0).contains(share)) {
            return Err(format!("{PENDING} has numbers that cannot be"));
        }
        let row = |trial: usize| {
            let &[best_g, mean_g] = pending.get(trial)?;
            Some(Row { arm: 0, trial, generation: generation - 1, best_g, mean_g, champion_g: 0.0 })
        };
        let pending = (0..learning.trials).map(row).collect();
        let snapshot = Snapshot { generation, last, weights, fitness, pending };
        let init = file.metadata(INIT).map(String::from);
        Ok(Checkpoint { config, init, seconds, metrics, snapshot })
    }

    /// Takes the weights that it lacks from `policies.safetensors`; false where that is not of the same run.
    #[must_use]
    fn complete(&mut self, mut file: TensorFile<impl Read + Seek>, of: &Config) -> bool {
        // One without a kind has no checksum either: another program's.
        if file.kind().is_none() || file.metadata(policies::CONFIG) != Some(&self.config) {
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
            for ((slots, sorted), fitness) in populations.zip(sorted).zip(fitness.chunks_exact(population)) {
                let mut put = |slot: usize, policy: &[f32]| {
                    slots[slot * parameters..(slot + 1) * parameters].copy_from_slice(policy);
                };
                // The best of all is the champion.
                put(population, &sorted[..parameters]);
                let order = evolve::best(fitness, population);
                order.into_iter().zip(sorted.chunks_exact(parameters)).for_each(|(slot, policy)| put(slot, policy));
            }
            weights.push(slots);
        }
        self.snapshot.weights = weights;
        true
    }
}

/// Shapes of the tensors, all trials together.
struct Shapes {
    weights: [usize; 4],
    fitness: [usize; 3],
}

impl Shapes {
    fn of(config: &Config) -> Shapes {
        let (trials, populations, policies) =
            (config.learning.trials, config.populations(), config.learning.population);
        Shapes {
            weights: [trials, populations, policies + 1, config.parameters()],
            fitness: [trials, populations, policies],
        }
    }
}

/// The generations of the checkpoints in a folder, oldest first; leftovers of writing are none.
///
/// # Errors
/// The folder cannot be read.
pub fn list(folder: &Path) -> Result<Vec<usize>, RecordError> {
    let entries = match fs::read_dir(folder) {
        Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => return Ok(vec![]),
        entries => entries.map_err(RecordError::read(folder))?,
    };
    let mut generations = Vec::new();
    for entry in entries {
        let entry = entry.map_err(RecordError::read(folder))?;
        generations.extend(entry.file_name().to_str().and_then(generation_of));
    }
    generations.sort_unstable();
    Ok(generations)
}

/// The generation that a checkpoint's name says; none of any other name.
fn generation_of(name: &str) -> Option<usize> {
    let digits = name.strip_suffix(EXTENSION)?;
    (digits.len() == DIGITS && digits.bytes().all(|byte| byte.is_ascii_digit())).then(|| digits.parse().ok()).flatten()
}

/// Where the checkpoint of a generation is.
pub fn path(folder: &Path, generation: usize) -> PathBuf {
    folder.join(format!("{generation:0DIGITS$}{EXTENSION}"))
}

/// Opens one and reads it, with the weights that a finished run keeps in its `policies`; none where these are of
/// another run by now.
///
/// # Errors
/// It or the policies cannot be read, or it is damaged.
pub fn read(path: &Path, policies: &Path, config: &Config) -> Result<Option<Checkpoint>, RecordError> {
    let file = file::open(path).map_err(RecordError::read(path))?;
    let mut found = Checkpoint::read(file, config).map_err(|reason| RecordError::damaged(path, reason))?;
    let whole = !found.snapshot.weights.is_empty()
        || match tensors::open(policies) {
            Ok(file) => found.complete(file, config),
            // The system may let it be read another time.
            Err(RecordError::Read { path, error }) if error.kind() != ErrorKind::NotFound => {
                return Err(RecordError::Read { path, error });
            }
            Err(_) => false,
        };
    Ok(whole.then_some(found))
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
    config: Arc<Config>,
    /// Generations of the checkpoints that are whole, oldest first.
    kept: Vec<usize>,
    writing: Option<Aside<Result<(usize, Duration), RecordError>>>,
    /// The generation, the moment and the cost of the last.
    last: (usize, Instant, Duration),
}

impl Keeper {
    /// Keeps checkpoints in a folder, which exists and has these already.
    pub fn new(disk: Disk, folder: PathBuf, config: Config, kept: Vec<usize>, generation: usize) -> Keeper {
        let last = (generation, Instant::now(), Duration::ZERO);
        Keeper { disk, folder, config: Arc::new(config), kept, writing: None, last }
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
        let (disk, config) = (self.disk.clone(), self.config.clone());
        let path = path(&self.folder, generation);
        self.writing = Some(Aside::start(move || {
            metrics.sync().map_err(RecordError::write(metrics.path()))?;
            checkpoint.write(&disk, &path, &config).map_err(RecordError::write(&path))?;
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
        checkpoint.write(&self.disk, &path, &self.config).map_err(RecordError::write(&path))?;
        self.last = (generation, Instant::now(), since.elapsed());
        self.keep(generation)
    }

    /// Waits until all is written, and removes what is not kept.
    ///
    /// # Errors
    /// The last checkpoint could not be written.
    pub fn wait(&mut self) -> Result<(), RecordError> {
        let Some(writing) = self.writing.take() else { return Ok(()) };
        let (generation, cost) = writing.finish()?;
        self.last.2 = cost;
        self.keep(generation)
    }

    /// Counts a checkpoint as whole, and removes what is not kept.
    fn keep(&mut self, generation: usize) -> Result<(), RecordError> {
        self.kept.retain(|&kept| kept != generation);
        self.kept.push(generation);
        // What a run started from is kept beside them: its first generations cannot be played again without it.
        let first = usize::from(self.kept.first() == Some(&0));
        while self.kept.len() > first + KEPT {
            let path = path(&self.folder, self.kept[first]);
            self.disk.remove(&path).map_err(RecordError::write(&path))?;
            self.kept.remove(first);
        }
        Ok(())
    }

    /// Makes all that are kept checkpoints of the same run, but as short as this config's.
    ///
    /// # Errors
    /// One could not be read or written.
    pub fn shorten(&mut self, config: &Config) -> Result<(), RecordError> {
        self.wait()?;
        for &generation in &self.kept {
            let path = path(&self.folder, generation);
            let file = file::open(&path).map_err(RecordError::read(&path))?;
            let mut kept =
                Checkpoint::read(file, &self.config).map_err(|reason| RecordError::damaged(&path, reason))?;
            kept.config = config_digest(config);
            kept.snapshot.last = config.learning.generations;
            kept.write(&self.disk, &path, config).map_err(RecordError::write(&path))?;
        }
        self.config = Arc::new(config.clone());
        Ok(())
    }

    /// Notices that a checkpoint is written, or could not be.
    ///
    /// # Errors
    /// The last checkpoint could not be written.
    pub fn poll(&mut self) -> Result<(), RecordError> {
        if self.writing.as_ref().is_some_and(Aside::is_finished) { self.wait() } else { Ok(()) }
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
            writing.end();
        }
    }
}

/// Clears away what an interrupted writer left, and gives what is there, oldest first.
///
/// # Errors
/// The folder cannot be read or written.
pub fn tidy(disk: &Disk, folder: &Path) -> Result<Vec<usize>, RecordError> {
    let generations = list(folder)?;
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        let whole = disk::of_temporary(&path);
        if whole.is_some_and(|name| generation_of(name).is_some()) {
            disk.remove(&path).map_err(RecordError::write(&path))?;
        }
    }
    Ok(generations)
}

/// Where a checkpoint that cannot be used is put aside.
pub fn aside(path: &Path) -> PathBuf {
    path.with_extension("safetensors.damaged")
}
