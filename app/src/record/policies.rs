//! `policies.safetensors`: the policies that a run learned.
//!
//! The file has one f32 tensor `weights.N` per trial, `[populations, policies, parameters]`. The first size is 1 if all
//! leaders share a policy. Each population is sorted with the best policy first. The first policies of all populations
//! therefore form the champion team of the trial.
//!
//! The metadata key `layers` is the shape of the network, such as "8,10,2". The key `config` is the digest of the
//! config of the training. Other programs may write such files too, also with a single tensor `weights`.

use std::io::{self, Read, Seek, Write};
use std::path::Path;

use safetensors::tensor::Dtype;
use sha2::{Digest, Sha256};

use super::RecordError;
use super::disk::{Disk, Place};
use super::tensors::{self, Tensor, TensorFile};
use flotilla::config::{Config, MAX_POPULATION};
use flotilla::escape::{self, PathExt};
use flotilla::evolve::{MAX_WEIGHT, flush_and_validate};

const KIND: &str = "policies 1";
/// Name of a tensor that applies to all trials.
const ALL: &str = "weights";
/// Metadata key of the config's [`super::config_digest`].
pub(super) const CONFIG: &str = "config";

/// Policies of one trial.
#[derive(Clone, Debug, PartialEq)]
pub struct Policies {
    /// Number of policies per population.
    pub policies: usize,
    /// The population of each leader, `[leaders]`.
    pub populations: Vec<u32>,
    /// Parameters, `[populations][policies][parameters]`.
    pub weights: Vec<f32>,
}

fn tensor(trial: usize) -> String {
    format!("weights.{trial}")
}

/// Returns the layer widths of a config's policies, such as "8,10,2".
pub fn layers(config: &Config) -> String {
    config.widths().iter().map(ToString::to_string).collect::<Vec<_>>().join(",")
}

/// Writes the policies of all trials of a config, each `[populations][population][parameters]`. Returns the file's
/// checksum.
///
/// # Errors
/// The file cannot be written. The previous file remains in that case.
pub fn write(disk: &Disk, path: &Path, config: &Config, trials: &[impl AsRef<[f32]>]) -> Result<String, RecordError> {
    let mut checksum = String::new();
    let content = |output: &mut dyn Write| put(output, config, trials).map(|sum| checksum = sum);
    disk.replace(path, content).map_err(RecordError::write(path))?;
    Ok(checksum)
}

/// Returns the config digest and the checksum in a file. Each is `None` if it is missing or the file cannot be read.
pub(crate) fn digests_in(place: Place<'_>) -> (Option<String>, Option<String>) {
    let Ok(file) = tensors::open(place) else { return (None, None) };
    (file.metadata(CONFIG).map(String::from), file.checksum().map(String::from))
}

/// Writes the content of such a file to a stream. Returns its checksum.
pub fn put(output: &mut dyn Write, config: &Config, trials: &[impl AsRef<[f32]>]) -> io::Result<String> {
    let shape = vec![config.populations(), config.learning.population, config.parameters()];
    let of_trial = |(trial, weights)| Tensor::floats(tensor(trial), shape.clone(), [weights]);
    let tensors: Vec<_> = trials.iter().map(AsRef::as_ref).enumerate().map(of_trial).collect();
    let metadata = [("layers", layers(config)), (CONFIG, super::config_digest(config))];
    tensors::put(output, KIND, metadata, &tensors)
}

/// Reads the policies of one trial for teams of a config. Trial N is read from the tensor `weights.N`. Without a trial,
/// the tensor is `weights`, or else `weights.0`. A policy that all leaders share fits any number of leaders.
pub fn read<'a>(place: impl Into<Place<'a>>, config: &Config, trial: Option<usize>) -> Result<Policies, RecordError> {
    let place = place.into();
    let path = place.path();
    let mut file = tensors::open(place)?;
    from_file(&mut file, config, &[config.learners(), 1, config.populations()], trial).map_err(|reason| match trial {
        Some(trial) if file.kind().is_none_or(|kind| kind == KIND) && file.info(&tensor(trial)).is_none() => {
            RecordError::NoTrial { path: path.into(), reason }
        }
        _ => rejected(&file, path, config, reason),
    })
}

/// Returns the error for a file whose policies do not fit a config.
fn rejected(file: &TensorFile<impl Read + Seek>, path: &Path, config: &Config, reason: String) -> RecordError {
    match file.metadata(CONFIG).is_some_and(|digest| digest != super::config_digest(config)) {
        true => RecordError::refused(
            format!("{}: {reason}", path.escaped()),
            "they are of another config; `flotilla rollout RUN` plays a run's policies in its own",
        ),
        false => RecordError::damaged(path, reason),
    }
}

/// Initial policies of a run, instead of random ones.
#[derive(Clone, Debug, PartialEq)]
pub struct Init {
    /// SHA-256 of the file.
    pub digest: String,
    /// Policies of each trial. Each has as many populations as the config.
    pub trials: Vec<Policies>,
}

/// Reads the initial policies of all trials of a config. Trial i is read from the tensor `weights.i`, or from `weights`
/// if there is no `weights.i`.
pub fn read_init<'a>(place: impl Into<Place<'a>>, config: &Config) -> Result<Init, RecordError> {
    let place = place.into();
    let path = place.path();
    let mut hash = Sha256::new();
    place.open().and_then(|mut file| super::hash_rest(&mut file, &mut hash)).map_err(RecordError::read(path))?;
    let mut file = tensors::open(place)?;
    let trial = |trial| {
        let own = file.info(&tensor(trial)).is_some() || file.info(ALL).is_none();
        from_file(&mut file, config, &[config.populations()], own.then_some(trial))
    };
    let trials = (0..config.learning.trials).map(trial).collect::<Result<_, String>>();
    let trials = trials.map_err(|reason| rejected(&file, path, config, reason))?;
    Ok(Init { digest: super::hex(&hash.finalize()), trials })
}

/// Reads the policies of all trials that a run of this config wrote.
///
/// # Errors
/// See [`read`]. It is also an error if the number of policies is not the config's population size.
pub fn read_all<'a>(place: impl Into<Place<'a>>, config: &Config) -> Result<Vec<Vec<f32>>, RecordError> {
    let place = place.into();
    let mut file = tensors::open(place)?;
    let trial = |trial| {
        let Policies { policies, weights, .. } = from_file(&mut file, config, &[config.populations()], Some(trial))?;
        let population = config.learning.population;
        match policies == population {
            true => Ok(weights),
            false => Err(format!("{} has {policies} policies of each leader, not {population}", tensor(trial))),
        }
    };
    (0..config.learning.trials)
        .map(trial)
        .collect::<Result<_, String>>()
        .map_err(|reason| RecordError::damaged(place.path(), reason))
}

/// Reads like [`read`], from any source.
pub fn from_source(source: impl Read + Seek, config: &Config, trial: Option<usize>) -> Result<Policies, String> {
    from_file(&mut TensorFile::open(source)?, config, &[config.learners(), 1, config.populations()], trial)
}

/// Reads like [`read`], from an open file. `populations` lists the accepted numbers of populations.
pub(crate) fn from_file(
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
    if let Some(index) = flush_and_validate(&mut weights) {
        let (policy, parameter) = (index / parameters, index % parameters);
        return Err(format!(
            "{name}[{}, {}, {parameter}] is {}, allowed are numbers of size up to {MAX_WEIGHT}",
            policy / shape[1],
            policy % shape[1],
            weights[index]
        ));
    }
    let of_each = config.populations_for(shape[0]).ok_or("populations do not fit the config")?;
    Ok(Policies { policies: shape[1], populations: of_each, weights })
}
