//! The learning curves of finished and unfinished runs.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::curves::{Band, Curve, Figure, Panel};
use super::map::counted;
use crate::record::digests::{Digests, UNVERIFIED, Verification};
use crate::record::folder::{OWN_FITNESS, Run};
pub use crate::record::runs::{ReadError, config, metrics};
use crate::record::{values_by_key, without_checkpoint};
use flotilla::config::Config;
use flotilla::escape::PathExt;
use flotilla::statistics::Average;
use flotilla::trainer::Row;

/// Maximum number of runs in one figure.
pub(crate) const MAX_RUNS: usize = 24;

/// The team of a generation whose G a picture shows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TeamKind {
    /// The team of the best policy of each population.
    #[default]
    Champion,
    /// The team with the largest G, a maximum that grows with the population.
    Best,
    /// The mean over all teams.
    Mean,
    /// The best team in the episodes that test it, if the config has any.
    Test,
}

impl TeamKind {
    pub const ALL: [TeamKind; 4] = [TeamKind::Champion, TeamKind::Best, TeamKind::Mean, TeamKind::Test];

    /// Returns the kind's name in pictures.
    pub fn name(self) -> &'static str {
        match self {
            TeamKind::Best => "best team",
            TeamKind::Champion => "champion",
            TeamKind::Mean => "mean team",
            TeamKind::Test => "tested best team",
        }
    }

    /// Returns the label of G of this kind of team, the same in all pictures.
    pub fn label(self) -> String {
        format!("G of the {}", self.name())
    }

    /// Returns this kind's G from a row of metrics, if the row has it.
    pub fn of(self, row: &Row) -> Option<f64> {
        match self {
            TeamKind::Best => Some(row.best_g),
            TeamKind::Champion => Some(row.champion_g),
            TeamKind::Mean => Some(row.mean_g),
            TeamKind::Test => row.test_g,
        }
    }

    /// Returns why a run of a config has no such G, if it has none.
    pub fn missing(self, config: &Config) -> Option<String> {
        let missing = self == TeamKind::Test && config.learning.test_episodes == 0;
        missing.then(|| "it has no tested best team, because learning.test_episodes is 0".into())
    }
}

named_by_serde!(TeamKind, "champion, best, mean or test");

/// A run's metrics by generation, as shares of the POIs averaged over trials: G of each [`TeamKind`].
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct RunMetrics([Vec<Average>; TeamKind::ALL.len()]);

impl RunMetrics {
    /// Returns G of one kind of team.
    pub fn of(&self, kind: TeamKind) -> &[Average] {
        &self.0[kind as usize]
    }

    /// Reads a run's metrics, up to the last generation that all trials have reached. Memory grows only with the number of
    /// generations.
    pub fn read(folder: &Path, config: &Config, verification: Verification) -> Result<RunMetrics, ReadError> {
        let mut run = RunMetrics::default();
        metrics(folder, config, verification, |row| run.add(row))?;
        let is_whole = |average: &Average| average.count() as usize == config.learning.trials;
        run.0.iter_mut().for_each(|averages| averages.truncate(averages.partition_point(is_whole)));
        if run.of(TeamKind::Best).is_empty() {
            let reason = "no generation of all trials is recorded yet".into();
            return Err(ReadError::Unfinished { folder: folder.into(), reason });
        }
        Ok(run)
    }

    pub fn add(&mut self, row: &Row) {
        let known = self.0.iter_mut().zip(TeamKind::ALL).filter_map(|(averages, kind)| Some((averages, kind.of(row)?)));
        for (averages, g) in known {
            if averages.len() <= row.generation {
                averages.resize(row.generation + 1, Average::default());
            }
            averages[row.generation].add(g);
        }
    }
}

/// Reads the rows of all trials, `[trials][generations]`, as far as the run has progressed.
pub fn trials(folder: &Path, config: &Config, verification: Verification) -> Result<Vec<Vec<Row>>, ReadError> {
    let mut trials = vec![vec![]; config.learning.trials];
    metrics(folder, config, verification, |row| trials[row.trial].push(*row))?;
    Ok(trials)
}

/// Returns the figure of G by generation: of one kind of team in each run, or of all kinds in a single run.
///
/// By default, one run shows all kinds of teams, and several runs show their champions. Several runs are labelled by
/// the config keys that differ.
pub fn figure(
    folders: &[PathBuf],
    measure: Option<TeamKind>,
    band: Band,
    verification: Verification,
) -> Result<Figure, ReadError> {
    let configs = folders.iter().map(|folder| config(folder, verification)).collect::<Result<Vec<_>, _>>()?;
    for (folder, config) in folders.iter().zip(&configs) {
        if let Some(reason) = measure.and_then(|kind| kind.missing(config)) {
            return Err(ReadError::Untested { folder: folder.clone(), reason });
        }
    }
    let all = folders.iter().zip(&configs).map(|(folder, config)| RunMetrics::read(folder, config, verification));
    let all = all.collect::<Result<Vec<_>, _>>()?;
    let shown = Figure {
        band,
        source: match folders {
            [folder] => Digests::read(folder, verification)?.run,
            _ => None,
        },
        warning: verification.is_skipped().then(|| UNVERIFIED.into()),
        ..figure_of_runs(&all, &configs, || labels(folders, &configs), measure)
    };
    Ok(shown)
}

/// Returns the learning curves of one run as [`figure`] does, from its metrics and its digest.
pub(crate) fn figure_of(config: &Config, run: RunMetrics, digest: &str) -> Figure {
    let figure = figure_of_runs(&[run], std::slice::from_ref(config), Vec::new, None);
    Figure { source: Some(digest.into()), ..figure }
}

fn figure_of_runs(
    all: &[RunMetrics],
    configs: &[Config],
    labels: impl FnOnce() -> Vec<String>,
    measure: Option<TeamKind>,
) -> Figure {
    let (legend, curves): (Vec<String>, Vec<Curve>) = match (all, measure) {
        ([run], None) => {
            let known =
                TeamKind::ALL.into_iter().filter(|&kind| configs.iter().all(|config| kind.missing(config).is_none()));
            known.map(|kind| (kind.name().to_string(), Curve::new(run.of(kind), 1.0))).unzip()
        }
        ([run], Some(kind)) => (vec![kind.name().to_string()], vec![Curve::new(run.of(kind), 1.0)]),
        (all, kind) => {
            let curves = all.iter().map(|run| Curve::new(run.of(kind.unwrap_or_default()), 1.0));
            labels().into_iter().zip(curves).unzip()
        }
    };
    let y_label = match (all.len(), measure) {
        (1, None) if configs[0].validate().is_ok_and(|config| config.weighted_by().is_some()) => {
            "G (weighted share of POIs)".into()
        }
        (1, None) => "G (share of POIs observed)".into(),
        (_, kind) => kind.unwrap_or_default().label(),
    };
    // Only stages that the run has reached are marked. If runs have different stages, none are marked.
    let last = curves.iter().filter_map(|curve| curve.generation.last()).fold(0.0_f64, |most, &last| most.max(last));
    let begun = |config: &Config| {
        let froms = config.stages.iter().map(|stage| stage.from);
        froms.filter(|from| (1..=last as usize).contains(from)).collect()
    };
    let mut staged: Vec<Vec<usize>> = configs.iter().map(begun).collect();
    staged.dedup();
    let stages = if staged.len() == 1 { staged.remove(0) } else { vec![] };
    Figure {
        panels: vec![Panel { title: String::new(), curves: curves.into_iter().enumerate().collect(), stages }],
        legend,
        y_label,
        y_max: 1.0,
        shares: true,
        ..Figure::default()
    }
}

/// Fewer pairs never give a p-value below 0.05.
pub(crate) const ENOUGH_PAIRS: usize = 6;

/// Reports whether trials of several runs form enough pairs to compare them, because all runs have the same seed and number
/// of trials.
///
/// Paired trials share their starts and all random numbers. If sizes agree, they also share their first populations.
pub fn paired(folders: &[PathBuf], verification: Verification) -> Result<bool, ReadError> {
    let trials =
        |folder: &PathBuf| config(folder, verification).map(|Config { learning, .. }| (learning.seed, learning.trials));
    let trials = folders.iter().map(trials).collect::<Result<Vec<_>, ReadError>>()?;
    Ok(trials.len() > 1 && trials[0].1 >= ENOUGH_PAIRS && trials.iter().all(|other| *other == trials[0]))
}

/// Most config keys in the label of a run. More are not read.
const MOST_KEYS: usize = 6;

/// Labels runs by the config keys that differ between them, or by their directories if none or more than [`MOST_KEYS`]
/// differ. A fitness that is not the config's is labelled [`OWN_FITNESS`].
pub fn labels(folders: &[PathBuf], configs: &[Config]) -> Vec<String> {
    let values = |(config, folder): (&Config, &PathBuf)| {
        // The checkpoint interval does not affect results.
        let mut values = values_by_key(&without_checkpoint(config));
        if Run::has_own_fitness(folder) {
            values.insert("learning.fitness".into(), OWN_FITNESS.into());
        }
        values
    };
    let tables: Vec<BTreeMap<String, toml::Value>> = configs.iter().zip(folders).map(values).collect();
    // Some keys are left out unless they are set.
    let keys: BTreeSet<&String> = tables.iter().flat_map(BTreeMap::keys).collect();
    let differs = |key: &&String| tables.iter().any(|table| table.get(*key) != tables[0].get(*key));
    let keys = keys.into_iter().filter(differs);
    let keys: Vec<_> = keys.filter_map(|key| Some((key, key.split_once('.')?.1))).collect();
    let staged = configs.iter().any(|config| config.stages != configs[0].stages);
    let label = |((folder, table), config): ((&PathBuf, &BTreeMap<String, toml::Value>), &Config)| {
        let stages = match config.stages.len() {
            0 => "no stages".into(),
            _ => counted(config.stages.len(), "stage"),
        };
        let part = |&(key, leaf): &(&String, &str)| {
            let value = table.get(key).map_or("-".into(), toml::Value::to_string);
            // Long values such as positions are unreadable in a label.
            Some(value.trim_matches('"')).filter(|value| value.len() <= 24).map(|value| format!("{leaf} {value}"))
        };
        let parts: Vec<String> = keys.iter().filter_map(part).chain(Some(stages).filter(|_| staged)).collect();
        if (1..=MOST_KEYS).contains(&parts.len()) { parts.join(", ") } else { folder.escaped() }
    };
    let labels: Vec<String> = folders.iter().zip(&tables).zip(configs).map(label).collect();
    // Equal labels mean that only a long value differs. Such labels also get the directory.
    let twice = |label: &String| labels.iter().filter(|other| *other == label).count() > 1;
    let full = |(label, folder): (&String, &PathBuf)| {
        let name = folder.escaped();
        if twice(label) && *label != name { format!("{label} ({name})") } else { label.clone() }
    };
    labels.iter().zip(folders).map(full).collect()
}
