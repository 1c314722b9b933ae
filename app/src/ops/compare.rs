//! Compares runs, or the points of a sweep along an axis, with intervals and tests.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::sweep::command_to_resume;
use super::{Context, Error, with_remedy};
use crate::record;
use crate::record::digests::Verification;
use crate::record::folder::{self, CONFIG, RUN, Run, SWEEP};
use crate::report::comparison::{self, At, Cohort, Comparison, ComparisonError, Question};
use crate::report::runs::{self, MAX_RUNS, ReadError};
use crate::shell;
use crate::sweep::{Sweep, results};
use flotilla::config::{AgentClass, Config, PoiGroup};
use flotilla::escape::PathExt;
use flotilla::file;
use flotilla::statistics;

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CompareRequest {
    /// Folders of runs, two at least, or the folder of one sweep.
    pub folders: Vec<PathBuf>,
    /// The axis of a sweep whose values are compared. The default is the only axis.
    pub by: Option<String>,
    /// Generations at which to compare G, as numbers, or `last`.
    pub at: Vec<String>,
    /// G whose first generation is compared, 0 to 1.
    pub reach: f64,
    /// Whether to compare pair by pair.
    pub paired: bool,
    /// Whether files that differ from their digests are read.
    pub unverified: bool,
}

/// Parses a generation to compare at.
pub fn at(text: &str) -> Result<At, String> {
    match text {
        "last" => Ok(At::Last),
        _ => text.parse().map(At::Generation).map_err(|_| "allowed generations, from 0, or last".into()),
    }
}

#[derive(Clone, Debug, Serialize)]
pub struct CompareOutcome {
    /// The confidence of every interval.
    pub confidence: f64,
    /// The test: `mann-whitney` or `wilcoxon`.
    pub test: &'static str,
    pub comparisons: Vec<Comparison>,
    pub notes: Vec<String>,
    /// Whether files were read that differ from their digests.
    pub unverified: bool,
    /// The question that was answered.
    #[serde(skip)]
    pub question: Question,
}

/// The arms of one comparison, after a description of what they have in common.
type Contest = (String, Vec<Cohort>);

/// Compares runs, or points of a sweep.
pub fn run(args: &CompareRequest, context: Context<'_>) -> Result<CompareOutcome, Error> {
    let at = args.at.iter().map(|text| at(text).map_err(|error| Error::Usage(format!("--at {text}: {error}").into())));
    let question = Question { at: at.collect::<Result<_, _>>()?, reach: args.reach, paired: args.paired };
    if args.folders.is_empty() {
        return Err(Error::Usage("no runs; name two at least, or the folder of a sweep".into()));
    }
    let mut notes = Vec::new();
    let groups = match &*args.folders {
        [folder] if folder::collection(folder) == Some("a sweep") => of_sweep(folder, args, &mut notes)?,
        folders => vec![(String::new(), of_runs(folders, args, &mut notes)?)],
    };
    // Printed even if nothing can be compared, because the notes may explain that.
    let report = |notes: &[String]| notes.iter().for_each(|note| context.warn(format_args!("note: {note}")));
    report(&notes);
    let reported = notes.len();
    let compare = |(place, arms): &Contest| {
        comparison::compare(place, arms, &question).map_err(|error| match error {
            ComparisonError::Beyond { at, .. } => Error::Usage(format!("--at {at}: {error}").into()),
            ComparisonError::NoPairs(..) => Error::Usage(format!("--paired: {error}").into()),
            ComparisonError::OneTrial(_) => {
                Error::Refused(format!("{error}: `flotilla train CONFIG --trials 5`").into())
            }
            ComparisonError::TooShort(_) => Error::Missing(error.to_string().into()),
        })
    };
    let all = groups.iter().map(compare).collect::<Result<Vec<Comparison>, Error>>()?;
    for comparison in &all {
        let place = if comparison.place.is_empty() { String::new() } else { format!("{}: ", comparison.place) };
        notes.extend(comparison.notes.iter().map(|note| format!("{place}{note}")));
    }
    let nothing = |arm: &Cohort| {
        arm.trials.iter().flat_map(|trial| &trial.rows).all(|row| row.best_g == 0.0 && row.champion_g == 0.0)
    };
    if groups.iter().all(|(_, arms)| arms.iter().all(nothing)) {
        notes.push(
            "no team of these runs scored in any generation: there is nothing to compare; `flotilla check CONFIG` names POIs \
             that cannot be reached"
                .into(),
        );
    }
    // For several runs, the notes so far report different layouts or copies. Then pairing is no useful advice.
    let alike = args.folders.len() == 1 || reported == 0;
    let enough = |arms: &[Cohort]| comparison::paired(arms) && arms[0].trials.len() >= runs::ENOUGH_PAIRS;
    if !args.paired && alike && groups.iter().all(|(_, arms)| enough(arms)) {
        notes.push("these arms have the same seeds, so their trials are pairs: --paired compares pair by pair".into());
    }
    report(&notes[reported..]);
    Ok(CompareOutcome {
        confidence: statistics::CONFIDENCE,
        test: if args.paired { "wilcoxon" } else { "mann-whitney" },
        comparisons: all,
        notes,
        unverified: args.unverified,
        question,
    })
}

/// Reads every run as an arm, named after what sets it apart from the others.
fn of_runs(folders: &[PathBuf], args: &CompareRequest, notes: &mut Vec<String>) -> Result<Vec<Cohort>, Error> {
    let verification = Verification::unless(args.unverified);
    if let Some(by) = &args.by {
        return Err(Error::Usage(
            format!("--by {by}: needs the folder of one sweep, and {} is not one", folders[0].escaped()).into(),
        ));
    }
    if folders.len() < 2 {
        let folder = folders[0].escaped();
        // Problems of the folder are reported first.
        runs::config(&folders[0], verification)?;
        let config = shell::argument(&folders[0].join(CONFIG));
        let words = ["flotilla".into(), "train".into(), config, "--set".into()];
        return Err(Error::Usage(with_remedy(
            format!("{folder} is one run"),
            format!(
                "name another to compare it with; `{} KEY=VALUE --out OTHER` trains one that differs in a key",
                shell::command(words)
            ),
        )));
    }
    too_many(folders.len(), "runs")?;
    let mut seen = BTreeSet::new();
    if let Some(twice) = folders.iter().find(|folder| !seen.insert(file::resolved(folder))) {
        return Err(Error::Usage(with_remedy(format!("{} is named twice", twice.escaped()), "name other runs")));
    }
    let configs = folders.iter().map(|folder| runs::config(folder, verification)).collect::<Result<Vec<_>, _>>()?;
    let differs = |differs: fn(&Config, &Config) -> bool| configs.iter().any(|config| differs(config, &configs[0]));
    // The short form and the long form of one layout are the same.
    let parts = |config: &Config| (config.world.map, agents(&config.classes().agents), pois(&config.classes().pois));
    let layouts = [
        ("world.map", differs(|a, b| a.world.map != b.world.map)),
        ("world.leaders", differs(|a, b| a.world.leaders != b.world.leaders)),
        ("world.followers", differs(|a, b| a.world.followers != b.world.followers)),
        ("world.pois", differs(|a, b| a.world.pois != b.world.pois)),
        ("agents", differs(|a, b| agents(&a.agents) != agents(&b.agents))),
        ("pois", differs(|a, b| pois(&a.pois) != pois(&b.pois))),
    ];
    let layouts: Vec<&str> = layouts.into_iter().filter(|(_, differ)| *differ).map(|(key, _)| key).collect();
    if !layouts.is_empty() && configs.iter().any(|config| parts(config) != parts(&configs[0])) {
        notes.push(format!("the arms play in different layouts: {} differ", layouts.join(", ")));
    }
    notes.extend(copies(folders, &configs));
    let arms = runs::labels(folders, &configs).into_iter().zip(folders);
    let read = |(name, folder): (String, &PathBuf)| Cohort::read(name, vec![folder.clone()], verification);
    Ok(arms.map(read).collect::<Result<_, _>>()?)
}

/// Returns the places and headings where classes of agents start.
fn agents(classes: &[AgentClass]) -> Vec<impl PartialEq + use<>> {
    let start = |class: &AgentClass| (class.at.clone(), class.count, class.region, class.heading.clone());
    classes.iter().map(start).collect()
}

/// Returns the places of groups of POIs.
fn pois(groups: &[PoiGroup]) -> Vec<impl PartialEq + use<>> {
    groups.iter().map(|group| (group.at.clone(), group.count, group.region)).collect()
}

/// Returns a note for each run with the results of another, because there is nothing to compare between them.
fn copies(folders: &[PathBuf], configs: &[Config]) -> Vec<String> {
    let digest = |folder: &PathBuf| Run::read(&folder.join(RUN)).ok()?.digest;
    let runs: Vec<_> = folders.iter().zip(configs.iter().map(record::without_checkpoint)).collect();
    let digests: Vec<_> = folders.iter().map(digest).collect();
    let original = |place: usize| {
        let first = (0..place).find(|&first| digests[first] == digests[place])?;
        digests[place].as_ref()?;
        let [this, other] = [place, first].map(|run| folders[run].escaped());
        Some(match runs[first].1 == runs[place].1 {
            true => format!("{this} is a copy of {other}: the same run"),
            false => format!("{this} has the digest of {other}: their settings differ, and their results do not"),
        })
    };
    (0..folders.len()).filter_map(original).collect()
}

/// Returns the values of an axis as arms, for each combination of the other axes. Notes list the points without runs.
fn of_sweep(out: &Path, args: &CompareRequest, notes: &mut Vec<String>) -> Result<Vec<Contest>, Error> {
    let sweep = Sweep::load(&out.join(SWEEP), &[], false)?;
    let by = match (&args.by, sweep.axes.len()) {
        (Some(name), _) => sweep.axis(name).ok_or_else(|| {
            Error::Usage(format!("--by {name}: names no single axis of the sweep; it has {}", sweep.keys()).into())
        })?,
        (None, 1) => 0,
        (None, _) => {
            return Err(Error::Usage(format!("the sweep has several axes; name one by --by: {}", sweep.keys()).into()));
        }
    };
    let verification = Verification::unless(args.unverified);
    let mut groups = Vec::new();
    for group in sweep.arms(by) {
        let mut arms = Vec::new();
        for (name, points) in group.arms {
            let mut arm = Cohort::read(name, vec![], verification)?;
            for point in points {
                let folder = results::point_folder(out, point);
                match arm.add(folder.clone(), verification) {
                    Ok(config) if record::without_checkpoint(&config) == record::without_checkpoint(&point.config) => {}
                    Ok(_) => {
                        return Err(Error::Refused(format!("{} is a run of another config", folder.escaped()).into()));
                    }
                    Err(ReadError::Missing(_) | ReadError::Foreign { .. } | ReadError::Unfinished { .. }) => {
                        let point = sweep.describe(point);
                        notes.push(format!("{} was not run, and is left out: {point}", folder.escaped()));
                    }
                    Err(error) => return Err(error.into()),
                }
            }
            if !arm.folders.is_empty() {
                arms.push(arm);
            }
        }
        too_many(arms.len(), "values")?;
        if arms.len() > 1 {
            groups.push((group.place, arms));
        }
    }
    match groups.is_empty() {
        false => Ok(groups),
        true => Err(Error::Missing(with_remedy(
            format!("{}: no two values of {} have runs to compare", out.escaped(), sweep.axes[by].key),
            format!("`{}` trains them", command_to_resume(out)),
        ))),
    }
}

/// Rejects more arms than a reader can compare.
fn too_many(count: usize, what: &str) -> Result<(), Error> {
    match count <= MAX_RUNS {
        true => Ok(()),
        false => Err(Error::Usage(with_remedy(
            format!("{count} {what} are too many to compare, two by two"),
            format!("{MAX_RUNS} at most"),
        ))),
    }
}
