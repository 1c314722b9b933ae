//! `policies.safetensors`: what a run learned.
//!
//! One f32 tensor `weights.N` a trial, `[leaders, policies, parameters]`, or `[1, policies, parameters]` where all
//! leaders share a policy; best policy first in each population, so that the team of all first policies is the trial's
//! champion; metadata `layers` is the policies' network, "8,10,2", and `config` the digest of the config that they were
//! trained by. Other programs may write such files too, also with a single tensor `weights`.

use std::collections::BTreeMap;
use std::io::{self, Read, Seek, Write};
use std::path::Path;

use safetensors::tensor::Dtype;
use sha2::{Digest, Sha256};

use super::RecordError;
use super::disk::Disk;
use super::tensors::{self, Tensor, TensorFile};
use crate::config::{Config, MAX_POPULATION};
use crate::escape;
use crate::evolve::{MAX_WEIGHT, admit};

const KIND: &str = "policies 1";
/// The tensor of a file for all trials.
const ALL: &str = "weights";
/// Metadata: [`super::config_digest`] of the config.
pub(super) const CONFIG: &str = "config";

/// Policies of one trial.
#[derive(Clone, Debug, PartialEq)]
pub struct Policies {
    /// How many each leader has.
    pub policies: usize,
    /// `[leaders][policies][parameters]`, or `[1][policies][parameters]` for all leaders.
    pub weights: Vec<f32>,
}

/// What the tensor of a trial is called.
fn tensor(trial: usize) -> String {
    format!("weights.{trial}")
}

/// Widths of a config's policies, "8,10,2".
pub fn layers(config: &Config) -> String {
    config.policy.widths().iter().map(ToString::to_string).collect::<Vec<_>>().join(",")
}

/// Writes the policies of all trials of a config, each `[populations][population][parameters]`. Returns the file's
/// checksum.
///
/// # Errors
/// The file cannot be written; the one before it is then still there.
pub fn write(disk: &Disk, path: &Path, config: &Config, trials: &[impl AsRef<[f32]>]) -> Result<String, RecordError> {
    let mut checksum = String::new();
    let content = |output: &mut dyn Write| put(output, config, trials).map(|sum| checksum = sum);
    disk.replace(path, content).map_err(RecordError::write(path))?;
    Ok(checksum)
}

/// Whether a file can be read and says that it is of a run of this config.
pub fn are_of(path: &Path, config: &Config) -> bool {
    mark(path).0 == Some(super::config_digest(config))
}

/// The digest of the config that a file says it is of, and its checksum; none where it does not say so or cannot be read.
pub fn mark(path: &Path) -> (Option<String>, Option<String>) {
    let Ok(file) = tensors::open(path) else { return (None, None) };
    (file.metadata(CONFIG).map(String::from), file.checksum().map(String::from))
}

/// Writes what such a file holds into a stream. Returns its checksum.
///
/// # Errors
/// The stream refuses it.
pub fn put(output: &mut dyn Write, config: &Config, trials: &[impl AsRef<[f32]>]) -> io::Result<String> {
    let shape = vec![config.populations(), config.learning.population, config.parameters()];
    let of_trial = |(trial, weights)| Tensor::floats(tensor(trial), shape.clone(), [weights]);
    let tensors: Vec<_> = trials.iter().map(AsRef::as_ref).enumerate().map(of_trial).collect();
    let metadata =
        BTreeMap::from([("layers".to_string(), layers(config)), (CONFIG.to_string(), super::config_digest(config))]);
    tensors::put(output, KIND, &metadata, &tensors)
}

/// Reads the policies of one trial for teams of a config: tensor `weights.N`, or without a number `weights`, else
/// `weights.0`. A policy that all leaders share fits any number of them.
///
/// # Errors
/// No such file, damage, another shape than the config's, or weights that no policy may have.
pub fn read(path: &Path, config: &Config, trial: Option<usize>) -> Result<Policies, RecordError> {
    let mut file = tensors::open(path)?;
    from_file(&mut file, config, &[config.learners(), 1], trial).map_err(|reason| match trial {
        Some(trial) if file.kind().is_none_or(|kind| kind == KIND) && file.info(&tensor(trial)).is_none() => {
            RecordError::NoTrial { path: path.into(), reason }
        }
        _ => RecordError::damaged(path, reason),
    })
}

/// What a run starts from, in place of policies drawn at random.
#[derive(Clone, Debug, PartialEq)]
pub struct Init {
    /// SHA-256 of the file.
    pub digest: String,
    /// A trial each, of as many populations as the config has.
    pub trials: Vec<Policies>,
}

/// Reads what all trials of a config start from: trial i from tensor `weights.i`, or where there is none from
/// `weights`.
///
/// # Errors
/// See [`read`].
pub fn read_init(path: &Path, config: &Config) -> Result<Init, RecordError> {
    let mut hash = Sha256::new();
    io::copy(&mut crate::file::open(path).map_err(RecordError::read(path))?, &mut HashWriter(&mut hash))
        .map_err(RecordError::read(path))?;
    let mut file = tensors::open(path)?;
    let trial = |trial| {
        let own = file.info(&tensor(trial)).is_some() || file.info(ALL).is_none();
        from_file(&mut file, config, &[config.populations()], own.then_some(trial))
    };
    let trials = (0..config.learning.trials).map(trial).collect::<Result<_, String>>();
    let trials = trials.map_err(|reason| RecordError::damaged(path, reason))?;
    Ok(Init { digest: super::hex(&hash.finalize()), trials })
}

/// Takes what is written into a digest.
struct HashWriter<'a>(&'a mut Sha256);

impl Write for HashWriter<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.update(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Reads the policies of all trials of a config's own training.
///
/// # Errors
/// See [`read`]; or they are not as many as the config's populations have.
pub fn read_all(path: &Path, config: &Config) -> Result<Vec<Vec<f32>>, RecordError> {
    let mut file = tensors::open(path)?;
    let trial = |trial| {
        let Policies { policies, weights } = from_file(&mut file, config, &[config.populations()], Some(trial))?;
        let population = config.learning.population;
        match policies == population {
            true => Ok(weights),
            false => Err(format!("{} has {policies} policies of each leader, not {population}", tensor(trial))),
        }
    };
    (0..config.learning.trials)
        .map(trial)
        .collect::<Result<_, String>>()
        .map_err(|reason| RecordError::damaged(path, reason))
}

/// [`read`], from anything.
///
/// # Errors
/// What is wrong, in words.
pub fn from_source(source: impl Read + Seek, config: &Config, trial: Option<usize>) -> Result<Policies, String> {
    from_file(&mut TensorFile::open(source)?, config, &[config.learners(), 1], trial)
}

/// [`read`], from a file that is open, which has one of so many populations.
///
/// # Errors
/// What is wrong, in words.
pub fn from_file(
    file: &mut TensorFile<impl Read + Seek>,
    config: &Config,
    populations: &[usize],
    trial: Option<usize>,
) -> Result<Policies, String> {
    if let Some(kind) = file.kind().filter(|kind| *kind != KIND) {
        return Err(format!("it holds {kind:?}, not {KIND:?}"));
    }
    let name = match trial {
        None if file.info(ALL).is_some() => ALL.to_string(),
        trial => tensor(trial.unwrap_or(0)),
    };
    let Some(info) = file.info(&name) else {
        let mut names = file.names();
        let more = if names.len() > 8 { ", …" } else { "" };
        names.truncate(8);
        names.iter_mut().for_each(|name| *name = escape::line(name).into());
        return Err(format!("it has no tensor {name}; it has {}{more}", names.join(", ")));
    };
    let parameters = config.parameters();
    let fits = info.dtype == Dtype::F32
        && matches!(info.shape[..], [l, p, w] if populations.contains(&l) && w == parameters && (1..=MAX_POPULATION).contains(&p));
    if !fits {
        return Err(format!(
            "{name} is {:?} {:?}, but the config needs F32 [{}, 1 to {MAX_POPULATION}, {parameters}] \
             (leaders{}, policies, parameters of layers {})",
            info.dtype,
            info.shape,
            populations[0],
            if populations.contains(&1) && populations[0] > 1 { ", or 1 for all" } else { "" },
            layers(config)
        ));
    }
    if let Some(found) = file.metadata("layers").filter(|found| *found != layers(config)) {
        return Err(format!("its policies have layers {found:?}, but the config's have {:?}", layers(config)));
    }
    let shape = info.shape.clone();
    let mut weights: Vec<f32> = file.read(&name, Dtype::F32, &shape, 1)?.pop().unwrap_or_default();
    if let Some(index) = admit(&mut weights) {
        let (policy, parameter) = (index / parameters, index % parameters);
        return Err(format!(
            "{name}[{}, {}, {parameter}] is {}, allowed are numbers of size up to {MAX_WEIGHT}",
            policy / shape[1],
            policy % shape[1],
            weights[index]
        ));
    }
    Ok(Policies { policies: shape[1], weights })
}
