//! Trains the teams of a config in a run's folder.

use std::collections::BTreeMap;
use std::io;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::{BackendSource, ConfigText, Context, Error, Event, ProcessorInfo, check_memory, escaped, with_remedy};
use crate::choice::Work;
use crate::record::digests::Verification;
use crate::record::disk::Disk;
use crate::record::finished::{Finished, Storage};
use crate::record::folder::{self, CONFIG, FirstAndLastRows, METRICS, POLICIES, RUN, RUNS, Start, StartFrom};
use crate::record::ownership::{self, CURVES};
use crate::record::policies::{self, Init};
use crate::record::runs;
use crate::record::{RecordError, command_to_resume};
use crate::report::runs::{RunMetrics, figure_of};
use crate::report::scene::Scene;
use crate::run::{Progress, RunError, Session, SessionEnd};
use crate::shell;
use flotilla::backend::OpenBackend;
use flotilla::config::{Config, Score, When};
use flotilla::escape::PathExt;
use flotilla::file;
use flotilla::front::{self, Generation, Trained};
use flotilla::host::Instant;
use flotilla::trainer::Row;

/// The files of a run by their content.
const FILES: [(&str, &str); 5] =
    [("config", CONFIG), ("run", RUN), ("metrics", METRICS), ("policies", POLICIES), ("curves", CURVES)];

#[derive(Clone, Debug)]
pub struct TrainRequest {
    pub config: ConfigText,
    /// The name of the run. Its folder has this name by default.
    pub name: String,
    /// The folder. `runs/NAME`, or the next that is free, by default.
    pub out: Option<PathBuf>,
    /// Treatment of a run that is in the folder.
    pub start: Start,
    /// A file with the policies to start from.
    pub init: Option<PathBuf>,
}

#[derive(Clone, Debug, Serialize)]
pub struct TrainOutcome {
    #[serde(serialize_with = "escaped")]
    pub folder: PathBuf,
    /// The run's name.
    pub config: String,
    pub digest: String,
    pub seed: u64,
    pub trials: usize,
    /// Policies per population.
    pub population: usize,
    /// Generations after the random start.
    pub generations: usize,
    /// Number of POIs, if it is the same in all stages.
    pub pois: Option<usize>,
    /// Sum of the values of all POIs, if it is the same in all stages.
    pub poi_value: Option<f64>,
    /// Generations that were trained now.
    pub trained_generations: usize,
    /// Seconds that this took.
    pub seconds: f64,
    /// Notes for the config's author.
    pub notes: Vec<String>,
    /// Scores of the random start.
    pub first: GenerationScores,
    pub last: GenerationScores,
    /// The files by their content.
    pub files: BTreeMap<&'static str, String>,
    /// The processor of the run's last session.
    #[serde(flatten)]
    pub processor: ProcessorInfo,
    /// The rows of the random start and of the last generation.
    #[serde(skip)]
    pub rows: FirstAndLastRows,
    /// Number of teams per generation.
    #[serde(skip)]
    pub teams: usize,
    /// See [`Config::weighted_by`].
    #[serde(skip)]
    pub weighted_by: Option<&'static str>,
    /// The stage of the last generation, if there are several.
    #[serde(skip)]
    pub last_stage: Option<usize>,
    /// The processor in words, or `None` if the run was finished before.
    #[serde(skip)]
    pub trained_on: Option<String>,
}

/// Scores of a generation, over trials.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct GenerationScores {
    pub best_g: Extremes,
    pub mean_g: Extremes,
    pub champion_g: Extremes,
    /// G of the tested best team, if the config has test episodes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub test_g: Option<Extremes>,
}

impl GenerationScores {
    fn of(rows: &[Row]) -> GenerationScores {
        let of = |share: fn(&Row) -> f64| Extremes::of(rows.iter().map(share));
        GenerationScores {
            best_g: of(|row| row.best_g),
            mean_g: of(|row| row.mean_g),
            champion_g: of(|row| row.champion_g),
            test_g: rows
                .iter()
                .map(|row| row.test_g)
                .collect::<Option<Vec<f64>>>()
                .map(|test| Extremes::of(test.into_iter())),
        }
    }
}

/// The mean, lowest and highest value over trials.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Extremes {
    pub mean: f64,
    pub lowest: f64,
    pub highest: f64,
}

impl Extremes {
    /// Returns the extremes of shares, which are at least 0.
    pub fn of(shares: impl Iterator<Item = f64>) -> Extremes {
        let (mut count, mut spread) = (0.0, Extremes { mean: 0.0, lowest: f64::INFINITY, highest: 0.0 });
        for share in shares {
            count += 1.0;
            spread.mean += share;
            spread.lowest = spread.lowest.min(share);
            spread.highest = spread.highest.max(share);
        }
        Extremes { mean: spread.mean / count, ..spread }
    }
}

impl TrainRequest {
    /// Returns the run's folder.
    fn folder(&self) -> Result<PathBuf, Error> {
        let runs = Path::new(RUNS);
        Ok(match (&self.out, self.start) {
            (Some(out), _) => out.clone(),
            (None, Start::Resume) => folder::latest(runs, &self.name),
            (None, Start::Force) => {
                let path = runs.join(&self.name);
                if let Some(other) = folder::other_name(&path, &self.name) {
                    let text = format!("{} is a run of {}", path.escaped(), Path::new(&other).escaped());
                    return Err(Error::Refused(with_remedy(text, "choose another --out")));
                }
                path
            }
            (None, Start::Fresh) => folder::next_free(runs, &self.name)?,
        })
    }
}

/// Starts or resumes a run, trains it to its end, and draws its curves.
pub fn run(
    request: &TrainRequest,
    backends: &mut dyn BackendSource,
    context: Context<'_>,
) -> Result<TrainOutcome, Error> {
    let (config, notes) = request.config.read_noted(context)?;
    let (backend, on) = backends.open(Work::of([&*config]))?;
    check_memory([&config], backend)?;
    context.warn_of_unreachable(&config);
    // Read before a folder is chosen, which is created.
    let init = request.init.as_deref().map(|path| policies::read_init(path, &config)).transpose()?;
    let most = init.iter().flat_map(|init| &init.trials).map(|trial| trial.policies).max().unwrap_or(0);
    if most > config.learning.population {
        context.note(format_args!(
            "note: --init has {most} policies of each leader; only the first {} are used, as learning.population says",
            config.learning.population
        ));
    }
    let folder = request.folder()?;
    let mut session = open_session(request, &config, init, &folder, context)?;
    let (since, from, was_done) = (Instant::now(), session.generations()[0], session.is_done());
    if !was_done {
        context.message(format_args!("training on {on}, into {}", folder.escaped()));
        (context.report)(Event::Begin(vec![(String::new(), config.pois())], from, config.learning.generations));
    }
    let last = train(&mut session, &folder, backend, context)?;
    let (config, results) = (session.config(0), session.results(0).expect("the run is done"));
    let (disk, curves) = (session.disk(0), folder.join(CURVES));
    let (mut metrics, mut most) = (RunMetrics::default(), 0.0_f64);
    runs::metrics(disk.at(&folder), config, Verification::Required, |row| {
        metrics.add(row);
        most = most.max(row.best_g).max(row.champion_g);
    })?;
    // A session that ended after the run but before its picture left an older picture, or none.
    let is_drawn = || {
        let svg = disk.at(&curves).open().and_then(io::read_to_string);
        svg.is_ok_and(|svg| Scene::shows(&svg, &results.digest))
    };
    if !was_done || !is_drawn() {
        let svg = figure_of(config, metrics, &results.digest).scene().svg();
        let drawn = ownership::publish_bytes(disk, &curves, svg.as_bytes())
            .and_then(|()| disk.sync_folder(&folder).map_err(RecordError::write(&folder)));
        if let Err(error) = drawn.map_err(Error::from) {
            // Everything that was learned is already saved.
            context.warn(format_args!("{}: not drawn: {}", curves.escaped(), error.message()));
        }
    }
    if most == 0.0 {
        warn_that_nothing_was_observed(&folder, config, context);
    }
    let (learning, valid) = (&config.learning, config.validate()?);
    Ok(TrainOutcome {
        config: request.name.clone(),
        digest: results.digest.clone(),
        seed: learning.seed,
        trials: learning.trials,
        population: learning.population,
        generations: learning.generations,
        pois: valid.pois(),
        poi_value: valid.poi_value(),
        trained_generations: if was_done { 0 } else { (last + 1).saturating_sub(from) },
        seconds: if was_done { 0.0 } else { since.elapsed().as_secs_f64() },
        notes,
        first: GenerationScores::of(&results.rows.first),
        last: GenerationScores::of(&results.rows.last),
        files: FILES.into_iter().map(|(name, file)| (name, folder.join(file).escaped())).collect(),
        processor: session.run(0).processor.clone(),
        rows: results.rows.clone(),
        teams: config.max_teams() - 1,
        weighted_by: valid.weighted_by(),
        last_stage: (valid.stages().len() > 1).then(|| valid.stage_of(learning.generations)),
        trained_on: (!was_done).then_some(on),
        folder,
    })
}

/// Opens the run's folder, and reports what it found. `policies` are those of [`TrainRequest::init`].
fn open_session(
    request: &TrainRequest,
    config: &Config,
    policies: Option<Init>,
    folder: &Path,
    context: Context<'_>,
) -> Result<Session, Error> {
    let (init, start) = (request.init.as_deref(), request.start);
    if let Some(what) = folder::collection(folder) {
        let text = format!("{} holds {what}, not a run", folder.escaped());
        return Err(Error::Refused(with_remedy(text, "choose another --out")));
    }
    if let Some(path) = init.filter(|path| file::resolved(path) == file::resolved(&folder.join(POLICIES))) {
        let text = format!("--init {}: this run would be written over it", path.escaped());
        return Err(Error::Usage(with_remedy(text, "choose another --out")));
    }
    let disk = Disk::default();
    if folder.is_dir() {
        let disk = ownership::open_output_folder(&disk, folder, request.out.is_some())?;
        // A foreign picture must not prevent a run from being resumed.
        if start != Start::Resume {
            ownership::check(&disk, [folder.join(CURVES)])?;
        }
    }
    let runs = vec![(config.clone(), folder.to_path_buf(), policies)];
    let opened = Session::open_from(runs, StartFrom::Unspecified, start, &disk);
    let (mut session, found) = opened.map_err(|error| match error {
        // This avoids the advice to use `--resume`. Until the run's origin is recorded, a resumed run would start from
        // random policies.
        RunError::Record(error) if init.is_some() => Error::Record(error),
        error => Error::Run(error),
    })?;
    session.set_name(0, &request.name);
    for (_, note) in found {
        if note.is_damage { context.warn(note) } else { context.note(note) }
    }
    Ok(session)
}

/// Trains a run to its end, or until the user ends it. Returns the last generation, which is earlier in that case.
fn train(
    session: &mut Session,
    folder: &Path,
    backend: &mut OpenBackend,
    context: Context<'_>,
) -> Result<usize, Error> {
    let mut last = session.config(0).learning.generations;
    while !session.is_done() {
        let mut watch = |progress: &Progress<'_>| context.rows(progress.generations[0], progress.rows);
        let ended = context.train(&mut watch, |options| session.train(backend, options));
        context.pause();
        if ended? == SessionEnd::Finished {
            break;
        }
        if !context.ends() {
            let next = session.generations()[0];
            let remedy = match session.disk(0).has_moved() {
                true => format!("{} was moved: continue with --resume and its new path", folder.escaped()),
                false => format!("continue with\n  {}", command_to_resume(folder, context.flags)),
            };
            let stopped = format!("before generation {next} of {last}, with everything saved");
            return Err(Error::Stopped(with_remedy(stopped, remedy)));
        }
        last = session.end()?;
    }
    Ok(last)
}

/// Warns that G was 0 in every generation.
fn warn_that_nothing_was_observed(folder: &Path, config: &Config, context: Context<'_>) {
    let at_the_end = match config.pois.iter().any(|group| group.when == When::End) {
        true => " (if `when` is \"end\", only the last step counts)",
        false => "",
    };
    // The closeness of agents that are all far away rounds to 0.
    let cause = match config.pois.iter().any(|group| group.score == Score::Closeness) {
        true => "no team scored",
        false => "no team observed any POI",
    };
    context.warn(format_args!(
        "warning: {cause} in any generation{at_the_end}, so there was nothing to learn from; try more world.steps, a \
         smaller coupling, POIs nearer to the starts, or a larger learning.population; `flotilla replay {}` shows what \
         teams do",
        shell::quoted(shell::argument(folder))
    ));
}

/// Trains without a folder. [`save`] writes the results later. `champions` asks for the champions of every generation.
///
/// Returns the results, the seconds since the start at which each generation was complete, and the processor. If the
/// caller ended the training early, the config of the results has fewer generations.
pub fn in_memory(
    config: &Config,
    champions: bool,
    backends: &mut dyn BackendSource,
    context: Context<'_>,
) -> Result<(Trained, Vec<f64>, ProcessorInfo), Error> {
    let config = &config.validate()?;
    let (backend, on) = backends.open(Work::of([&**config]))?;
    context.notes(&config.notes());
    context.warn_of_unreachable(config);
    (context.report)(Event::Begin(vec![(String::new(), config.pois())], 0, config.learning.generations));
    let (since, mut seconds, mut stopped) = (Instant::now(), Vec::new(), false);
    let watch = |generation: Generation<'_>| {
        seconds.push(since.elapsed().as_secs_f64());
        let Generation { generation: number, rows, champions, .. } = generation;
        (context.report)(Event::Rows { next: number + 1, rows, champions });
        if !context.is_stopped() {
            return ControlFlow::Continue(());
        }
        stopped = !context.ends();
        ControlFlow::Break(())
    };
    let trained = match champions {
        true => front::train_with_champions(config, &mut *backend.0, watch)?,
        false => front::train(config, &mut *backend.0, watch)?,
    };
    if stopped {
        return Err(Error::Stopped("before the last generation; nothing was saved".into()));
    }
    // After an early end, one more generation is played and not reported.
    seconds.resize(trained.config.learning.generations + 1, since.elapsed().as_secs_f64());
    Ok((trained, seconds, ProcessorInfo::of(&backend.1, &on)))
}

/// Writes a finished run that was trained in memory, with the files of [`run`]. Returns its digest.
pub fn save(finished: Finished<'_>, storage: &mut dyn Storage) -> Result<String, RecordError> {
    let (config, rows) = (finished.config, finished.rows);
    let digest = finished.write(storage)?;
    let mut metrics = RunMetrics::default();
    rows.iter().for_each(|(row, _)| metrics.add(row));
    storage.publish(CURVES, figure_of(config, metrics, &digest).scene().svg().as_bytes())?;
    Ok(digest)
}
