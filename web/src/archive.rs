//! Exports and imports runs as zip archives of a run's folder, in the format of `flotilla train`.

use std::io::{self, Cursor, Read};
use std::ops::Range;

use flotilla::backend::{Group, cpu::Cpu};
use flotilla::config::Config;
use flotilla::evolve;
use flotilla::trainer::{Ending, Row};
use flotilla::world::World;
use flotilla_app::ops::{self, ProcessorInfo};
use flotilla_app::record::finished::{Content, Finished, Storage};
use flotilla_app::record::folder::{self, Origin, Run};
use flotilla_app::record::{RecordError, hex, metrics, policies};
use flotilla_app::report::replay;
use serde::Deserialize;
use serde_json::{Value, json};
use zip::{ZipArchive, ZipWriter, write::SimpleFileOptions};

use crate::answer::{Answer, Refusal, described, floats, refuse};

/// Maximum bytes read from one file of an archive.
const MAX_FILE_BYTES: u64 = 1 << 30;

/// Describes a finished run to export.
///
/// The numbers start with the rows, `[rows][8]` f64, in the order of `metrics.csv`. A row is run, trial, generation,
/// best, mean and champion G, seconds. After the rows follow each trial's policies and fitness, as f32, and with an
/// evolution strategy or a hall of fame the weights after the last generation.
#[derive(Deserialize)]
pub struct Recorded {
    /// The folder in the archive that holds the run.
    name: String,
    text: String,
    command: String,
    #[serde(flatten)]
    processor: ProcessorInfo,
    started: String,
    rows: usize,
}

/// Returns the digest of a finished run, and its folder as a zip archive.
pub fn write(recorded: &Recorded, bytes: &[u8]) -> Result<Answer, Refusal> {
    let config = Config::parse(&recorded.text, "the config")?;
    let (trials, last) = (config.learning.trials, config.learning.generations);
    let fitness = config.fitness_len();
    let policies = config.populations() * config.learning.population * config.parameters();
    let slots = config.populations() * config.learning.slots() * config.parameters();
    let weights = if config.learning.extends_from_policies() { 0 } else { slots };
    let (numbers, trial) = (recorded.rows * 8 * size_of::<f64>(), (policies + fitness + weights) * size_of::<f32>());
    if bytes.len() != numbers + trials * trial || recorded.rows != trials * (last + 1) {
        return Err(refuse("the results of the run do not fit its config"));
    }
    let (numbers, rest) = bytes.split_at(numbers);
    let rows: Vec<(Row, f64)> = bytemuck::pod_collect_to_vec::<u8, f64>(numbers)
        .as_chunks::<8>()
        .0
        .iter()
        .map(|&[_, trial, generation, best_g, mean_g, champion_g, test_g, seconds]| {
            let (trial, generation) = (trial as usize, generation as usize);
            let test_g = Some(test_g).filter(|test_g| !test_g.is_nan());
            (Row { experiment: 0, trial, generation, best_g, mean_g, champion_g, test_g }, seconds)
        })
        .collect();
    let parts: Vec<Vec<f32>> = rest.chunks_exact(trial).map(floats).collect();
    let part = |range: Range<usize>| parts.iter().map(move |part| &part[range.clone()]);
    let policies_of: Vec<&[f32]> = part(0..policies).collect();
    let copies = |range| part(range).map(<[f32]>::to_vec).collect();
    let rest = policies + fitness;
    let ending = Ending {
        weights: if weights == 0 { vec![] } else { copies(rest..rest + weights) },
        fitness: copies(policies..rest),
    };
    let run = recorded.processor.clone().record(&config, &recorded.command, recorded.started.clone());
    let mut zip = Zip { folder: recorded.name.clone(), writer: ZipWriter::new(Cursor::new(Vec::new())) };
    let finished = Finished { config: &config, rows: &rows, policies: &policies_of, ending: Some(ending), run };
    let digest = ops::train::save(finished, &mut zip).map_err(refuse)?;
    let archive = zip.writer.finish().map_err(refuse)?.into_inner();
    Ok((json!({ "digest": digest }), archive))
}

/// An archive that holds a run's folder.
struct Zip {
    folder: String,
    writer: ZipWriter<Cursor<Vec<u8>>>,
}

impl Storage for Zip {
    fn put(&mut self, name: &str, content: Content<'_>) -> Result<(), RecordError> {
        let path = format!("{}/{name}", self.folder);
        let started = self.writer.start_file(&path, SimpleFileOptions::default()).map_err(io::Error::from);
        let written = started.and_then(|()| content(&mut self.writer));
        written.map_err(|error| RecordError::Write { path: path.into(), error })
    }
}

/// Reads a file that was dropped on the page.
///
/// An archive of a run gives its config, the rows `[rows][8]` f64, and each trial's policies as f32. Any other file is
/// read as policies for the config in `text`.
pub fn read(text: Option<&str>, bytes: &[u8]) -> Result<Answer, Refusal> {
    if !bytes.starts_with(b"PK") {
        let config = Config::parse(text.unwrap_or_default(), "the config")?;
        let found = policies::from_source(Cursor::new(bytes), &config, None)
            .map_err(|reason| refuse(format!("these policies are not for this config: {reason}")))?;
        let numbers = bytemuck::cast_slice(&found.weights).to_vec();
        return Ok((json!({ "policies": found.policies }), numbers));
    }
    let mut zip =
        ZipArchive::new(Cursor::new(bytes)).map_err(|error| refuse(format!("not an archive of a run: {error}")))?;
    let names: Vec<String> = zip.file_names().flatten().map(Into::into).collect();
    // All files are read from the folder of one config. Otherwise, files of several runs could be mixed.
    let runs: Vec<&str> = names.iter().filter_map(|path| inside(path, folder::CONFIG)).collect();
    let &[top] = &runs[..] else {
        return Err(refuse(match runs.len() {
            0 => format!("it is not the archive of a run (no {})", folder::CONFIG),
            count => format!("it has {count} runs; unpack it, and open an archive of one of them"),
        }));
    };
    let mut file = |name: &str| -> Result<Vec<u8>, Refusal> {
        let path = format!("{top}{name}");
        if !names.contains(&path) {
            return Err(refuse(format!("the archive has no {path}: it is not a run")));
        }
        let mut content = Vec::new();
        let file = zip.by_name(&path).map_err(refuse)?;
        file.take(MAX_FILE_BYTES).read_to_end(&mut content).map_err(refuse)?;
        Ok(content)
    };
    let text = String::from_utf8(file(folder::CONFIG)?).map_err(|_| refuse("config.toml is not UTF-8 text"))?;
    let config = Config::parse(&text, "config.toml")?.validate()?;
    let (metrics, weights) = (file(folder::METRICS)?, file(folder::POLICIES)?);
    let run = Run::parse(&String::from_utf8_lossy(&file(folder::RUN)?))
        .map_err(|error| refuse(format!("run.json: {error}")))?;
    if run.origin != Origin::of(&config) {
        return Err(refuse("config.toml is not the config that this run was trained with"));
    }
    if run.own_fitness {
        // The page would show the config's fitness, and train generations again with it.
        return Err(refuse(
            "its fitness is not the config's, which this page needs; use `flotilla replay` and `flotilla plot`",
        ));
    }
    let expected = run.digest.ok_or_else(|| {
        refuse("run.json has no digest: the run is not finished; finish it with `flotilla train --resume`")
    })?;
    let mut numbers: Vec<f64> = Vec::new();
    let mut rows = metrics::Rows::new(&metrics[..]).map_err(|error| refuse(format!("metrics.csv: {error}")))?;
    let mut plain = Vec::new();
    for row in &mut rows {
        let (row, seconds) = row.map_err(|error| refuse(format!("metrics.csv: {error}")))?;
        let Row { trial, generation, best_g, mean_g, champion_g, test_g, .. } = row;
        let test_g = test_g.unwrap_or(f64::NAN);
        numbers.extend([0.0, trial as f64, generation as f64, best_g, mean_g, champion_g, test_g, seconds]);
        plain.push(row);
    }
    let (trials, whole) = (config.learning.trials, config.learning.trials * (config.learning.generations + 1));
    let in_turn = |(at, row): (usize, &Row)| (row.generation, row.trial) == (at / trials, at % trials);
    if plain.len() != whole || !plain.iter().enumerate().all(in_turn) {
        return Err(refuse(format!(
            "metrics.csv: these are not the {whole} rows of all trials, generation by generation"
        )));
    }
    let trial = |trial| policies::from_source(Cursor::new(&weights), &config, Some(trial));
    let trials: Result<Vec<_>, String> = (0..config.learning.trials).map(trial).collect();
    let trials = trials.map_err(|reason| refuse(format!("policies.safetensors: {reason}")))?;
    let weights: Vec<&[f32]> = trials.iter().map(|trial| &trial.weights[..]).collect();
    let digest = hex(&metrics::digest(plain.into_iter(), &weights));
    if expected != digest {
        return Err(refuse(format!("the run is damaged: its digest is {digest}, run.json says {expected}")));
    }
    let count = numbers.len() / 8;
    let mut bytes: Vec<u8> = bytemuck::cast_slice(&numbers).to_vec();
    weights.iter().for_each(|weights| bytes.extend_from_slice(bytemuck::cast_slice(weights)));
    let mut words = described(&config);
    words["rows"] = count.into();
    words["digest"] = digest.into();
    Ok((words, bytes))
}

/// Returns the folder of a file in the archive, empty or ending in `/`, if the file has the given name.
fn inside<'a>(path: &'a str, name: &str) -> Option<&'a str> {
    let folder = path.strip_suffix(name)?;
    (folder.is_empty() || folder.ends_with('/')).then_some(folder)
}

/// Returns the population of each leader, or `None` if these weights are not for the config. `weights` are
/// `[populations][policies][parameters]`.
pub fn populations_of(config: &Config, policies: usize, weights: &mut [f32]) -> Option<Vec<u32>> {
    let numbers = policies.saturating_mul(config.parameters());
    let populations = weights.len().checked_div(numbers).and_then(|count| config.populations_for(count))?;
    let fits = weights.len().is_multiple_of(numbers) && evolve::flush_and_validate(weights).is_none();
    fits.then_some(populations)
}

/// Plays the champions, the first policy of every leader, in the world of the last generation.
///
/// `weights` are `[populations][policies][parameters]`.
pub fn play(config: &Config, policies: usize, mut weights: Vec<f32>) -> Result<Value, Refusal> {
    let config = config.validate()?;
    let config = config.at(config.learning.generations);
    let world = World::new(config);
    let Some(populations) = populations_of(config, policies, &mut weights) else {
        return Err(refuse("these policies are not for this config"));
    };
    let (teams, fitnesses) = (vec![0; world.leaders()], flotilla::evaluate::scores_beside(config));
    let group = Group { populations: &populations, fitnesses, ..Group::new(&world, &weights[..], policies, &teams) };
    let played = replay::one(&group, &mut Cpu::default()).map_err(refuse)?;
    let generation = config.learning.generations;
    Ok(replay::detailed("", config, &[replay::Replayed { generation, ..played }]))
}
