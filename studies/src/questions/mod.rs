//! The open questions of the paper, as sweeps in `studies/configs/questions/`, and their results.
//!
//! [`QUESTIONS`] lists them. A [`Study`] is one sweep. Its arms are compared along one axis, as in [`comparison`]. Each
//! combination of the other axes is a row of its results.
//!
//! This module adds two experiments that a sweep cannot express. Some runs start from the policies of other runs, and
//! some champions play where they did not learn.

use std::path::{Path, PathBuf};

use flotilla::backend::{Backend, BackendError};
use flotilla::baseline::{self, Baselines};
use flotilla::config::{Config, ConfigError, Override};
use flotilla::escape::PathExt;
use flotilla::evaluate::Starts;
use flotilla::front;
use flotilla_app::ops::Error;
use flotilla_app::record::RecordError;
use flotilla_app::record::digests::Verification;
use flotilla_app::record::disk::Place;
use flotilla_app::record::folder::POLICIES;
use flotilla_app::record::policies::{self, Policies};
use flotilla_app::report::comparison::{self, At, Cohort, Comparison, Mean, Measure, Measured, Named};
use flotilla_app::report::grid::{Dots, Interval};
use flotilla_app::report::scene::Scene;
use flotilla_app::report::table;
use flotilla_app::sweep::results::point_folder;
use flotilla_app::sweep::{Axis, Point, Sweep};

mod list;
pub mod run;

pub use list::QUESTIONS;

/// Number of episodes that champions play with moved POIs.
pub const EPISODES: u32 = 200;
/// The mark after each part's table in a question's page.
pub const END: &str = "<!-- so far -->";

/// A question, with the studies that answer it.
#[derive(Clone, Copy, Debug)]
pub struct OpenQuestion {
    /// The letter that selects the question.
    pub letter: char,
    /// The heading on a page.
    pub title: &'static str,
    /// The studies, each a sweep.
    pub parts: &'static [Study],
}

/// One sweep, and what its table and figure show.
#[derive(Clone, Copy, Debug)]
pub struct Study {
    /// The name of its config, folder and files.
    pub name: &'static str,
    config: &'static str,
    /// The title of its table and figure.
    pub title: &'static str,
    /// The axis whose values are the arms. Empty if there is none.
    by: &'static str,
    /// The axis with one panel of the figure per value, if any.
    panels: Option<&'static str>,
    /// Words for the values of axes that are not self-explanatory.
    words: &'static [(&'static str, &'static [&'static str])],
    /// The two arms of each difference in the table.
    pairs: &'static [[usize; 2]],
    /// Generations at which G is reported. Empty means the last.
    at: &'static [usize],
    /// The G whose first generation is reported, if any.
    reach: Option<f64>,
    /// A source study with indices of its points, each with a name. The points of this study also start from the
    /// policies of those points, as additional arms.
    warm_from: Option<(&'static str, &'static [(usize, &'static str)])>,
    /// The jitter of POIs, in units, with which champions play in addition to fixed POIs. Nothing else is then
    /// measured, and the best constant speed is an additional arm.
    moved: Option<f64>,
}

/// A run that starts from the policies of another run.
pub struct Warm {
    /// The name of the arm.
    pub from: &'static str,
    pub config: Config,
    /// The folder of the run, which may not exist yet.
    pub folder: PathBuf,
    /// The file with the other run's policies.
    pub policies: PathBuf,
}

/// Parses a question's letter.
///
/// # Errors
/// There is no such question.
pub fn letter(text: &str) -> Result<char, String> {
    let is = |question: &&OpenQuestion| text == question.letter.to_string();
    let letters = || QUESTIONS.iter().map(|question| question.letter.to_string()).collect::<Vec<_>>().join(", ");
    QUESTIONS.iter().find(is).map(|question| question.letter).ok_or_else(|| format!("allowed {}", letters()))
}

/// Returns the studies that questions with these letters need, each once. Sources of other studies come first.
pub fn parts(letters: &[char]) -> Vec<&'static Study> {
    let mut parts: Vec<&'static Study> = Vec::new();
    for part in QUESTIONS.iter().filter(|question| letters.contains(&question.letter)).flat_map(|asked| asked.parts) {
        for part in part.source().into_iter().chain([part]) {
            if !parts.iter().any(|other| other.name == part.name) {
                parts.push(part);
            }
        }
    }
    parts
}

impl Study {
    /// Returns the sweep, with some keys changed.
    ///
    /// # Errors
    /// An override is invalid.
    pub fn sweep(&self, overrides: &[Override]) -> Result<Sweep, ConfigError> {
        Sweep::read(self.config, &format!("studies/configs/questions/{}.toml", self.name), overrides, false)
    }

    /// Returns the study whose runs the runs of this study start from, if any.
    pub fn source(&self) -> Option<&'static Study> {
        let (name, _) = self.warm_from?;
        QUESTIONS.iter().flat_map(|question| question.parts).find(|part| part.name == name)
    }

    /// Returns the runs that start from other runs' policies. `out` has the folders of all studies.
    pub(crate) fn warm(&self, sweep: &Sweep, out: &Path) -> Vec<Warm> {
        sweep.points.iter().flat_map(|point| self.warm_of(point, out)).collect()
    }

    /// Returns the runs of one point that start from other runs' policies.
    fn warm_of(&self, point: &Point, out: &Path) -> Vec<Warm> {
        let Some((source, places)) = self.warm_from else { return vec![] };
        let run = |(at, &(index, from)): (usize, &(usize, &'static str))| Warm {
            from,
            config: Config::clone(&point.config),
            folder: out.join(self.name).join("warm").join(format!("{:04}-{at}", point.index)),
            policies: out.join(source).join("points").join(format!("{index:04}")).join(POLICIES),
        };
        places.iter().enumerate().map(run).collect()
    }

    /// Returns the name of an axis's value.
    fn word(&self, axis: &Axis, value: usize) -> String {
        match self.words.iter().find(|(leaf, _)| *leaf == axis.leaf()) {
            Some((_, words)) => words[value].into(),
            None if axis.values[value].is_str() => axis.label(value),
            None => format!("{} {}", axis.leaf().replace('_', " "), axis.label(value)),
        }
    }

    /// Returns the study's results from the folders of all its finished runs. There is one comparison per combination
    /// of the axes that are not arms.
    ///
    /// # Errors
    /// A run cannot be read, or a champion cannot be played.
    pub fn answer(&self, sweep: &Sweep, out: &Path, backend: &mut dyn Backend) -> Result<Answer, Error> {
        let by = sweep.axis(self.by);
        // Groups by the values of the axes that are not arms, in order.
        let place = |point: &Point| -> Vec<(usize, usize)> {
            point.values.iter().copied().enumerate().filter(|&(axis, _)| Some(axis) != by).collect()
        };
        let mut places: Vec<Vec<&Point>> = Vec::new();
        for point in &sweep.points {
            match places.iter_mut().find(|points| place(points[0]) == place(point)) {
                Some(points) => points.push(point),
                None => places.push(vec![point]),
            }
        }
        let mut rows = Vec::new();
        for points in places {
            let place = place(points[0]);
            let words = || place.iter().map(|&(axis, value)| (&sweep.axes[axis], value));
            let is_panel = |axis: &Axis| Some(axis.leaf()) == self.panels;
            let panel = words().find(|(axis, _)| is_panel(axis)).map(|(axis, value)| self.word(axis, value));
            let name: Vec<_> =
                words().filter(|(axis, _)| !is_panel(axis)).map(|(axis, value)| self.word(axis, value)).collect();
            let name = name.join(", ");
            let all = [Some(self.name), panel.as_deref(), Some(&*name).filter(|name| !name.is_empty())];
            let place = all.into_iter().flatten().collect::<Vec<_>>().join(", ");

            let name_of = |point: &Point| {
                by.map_or("from random policies".into(), |by| self.word(&sweep.axes[by], point.values[by]))
            };
            let folder = |point: &Point| point_folder(&out.join(self.name), point);
            let mut arms: Vec<_> = points.iter().map(|point| (name_of(point), folder(point))).collect();
            for warm in points.iter().flat_map(|point| self.warm_of(point, out)) {
                arms.push((warm.from.into(), warm.folder));
            }
            let learning = &points[0].config.learning;
            let comparison = match self.moved {
                Some(jitter) => self.played(&place, &points[0].config, &arms, jitter, backend)?,
                None => {
                    let read = |(name, folder)| Cohort::read(name, vec![folder], Verification::Required);
                    let arms = arms.into_iter().map(read).collect::<Result<Vec<_>, _>>()?;
                    let at = match self.at {
                        [] => vec![At::Last],
                        at => at.iter().map(|&at| At::Generation(at.min(learning.generations))).collect(),
                    };
                    let reach = self.reach.unwrap_or(0.75);
                    comparison::compare(&place, &arms, &comparison::Question { at, reach, paired: false })?
                }
            };
            rows.push(AnswerRow { panel, name, comparison });
        }
        Ok(Answer { part: *self, rows })
    }

    /// Plays every trial's champion, and the best constant speed, with fixed POIs and with moved ones.
    fn played(
        &self,
        place: &str,
        config: &Config,
        arms: &[(String, PathBuf)],
        jitter: f64,
        backend: &mut dyn Backend,
    ) -> Result<Comparison, Error> {
        let trials = config.learning.trials;
        let mut named = Vec::new();
        let mut weights = Vec::new();
        for (name, folder) in arms {
            named.push(Named { name: name.clone(), folders: vec![folder.escaped()], trials });
            weights.push(champions(&folder.join(POLICIES), config)?);
        }
        named.push(Named { name: "best constant speed".into(), folders: vec![], trials });
        weights.push(best_constant(config, jitter, backend)?.repeat(trials * config.learners()));
        let mut values = Vec::new();
        for (poi_jitter, episodes) in [(0.0, 1), (jitter, EPISODES)] {
            let mut config = config.clone();
            config.learning.poi_jitter = poi_jitter;
            let starts = match episodes {
                1 => Starts::Own,
                _ => Starts::Drawn { episodes, seed: config.learning.seed, jitter: 0.0, poi_jitter },
            };
            let of_arms = weights.iter().map(|weights| play(&config, weights, &starts, backend));
            values.push((Measure::Played { poi_jitter, episodes }, of_arms.collect::<Result<_, _>>()?));
        }
        Ok(comparison::of_values(place, config.learning.generations, named, values)?)
    }
}

/// Returns the policy of the constant speed that observes most of the moved POIs. The episodes that choose it are not
/// those that measure it.
fn best_constant(config: &Config, jitter: f64, backend: &mut dyn Backend) -> Result<Vec<f32>, BackendError> {
    let mut config = Config { stages: vec![], ..config.clone() };
    (config.learning.poi_jitter, config.learning.generations, config.learning.trials) = (jitter, 0, 1);
    let mut baselines = Baselines::of_constants(&config.validate()?);
    while !baselines.is_done() {
        baselines.advance(backend)?;
    }
    let outcome = baselines.outcomes(backend, EPISODES)?.concat().remove(0);
    let mut policy = vec![0.0; config.parameters()];
    baseline::constant_policy(&baseline::constants(config.policy.actions)[outcome.best_constant], &mut policy);
    Ok(policy)
}

/// Plays one team per trial, `[leaders][trials][parameters]`, from all starts. Returns G of each.
pub(crate) fn play(
    config: &Config,
    weights: &[f32],
    starts: &Starts,
    backend: &mut dyn Backend,
) -> Result<Vec<f64>, Error> {
    let played = front::play(config, backend, config.learning.trials, weights, starts)?;
    Ok(played.observed.iter().map(|observed| observed / config.poi_count() as f64).collect())
}

/// Returns the champion of every trial as one team each, `[leaders][trials][parameters]`.
///
/// # Errors
/// The policies cannot be read, or belong to another config.
pub fn champions<'a>(place: impl Into<Place<'a>>, config: &Config) -> Result<Vec<f32>, RecordError> {
    let place = place.into();
    let (leaders, trials, parameters) = (config.learners(), config.learning.trials, config.parameters());
    let mut champions = vec![0.0; leaders * trials * parameters];
    for trial in 0..trials {
        let Policies { policies, populations, weights } = policies::read(place, config, Some(trial))?;
        for (leader, population) in populations.into_iter().enumerate() {
            let champion = &weights[population as usize * policies * parameters..][..parameters];
            champions[(leader * trials + trial) * parameters..][..parameters].copy_from_slice(champion);
        }
    }
    Ok(champions)
}

pub struct Answer {
    part: Study,
    rows: Vec<AnswerRow>,
}

/// The comparison of the arms at one combination of the other axes.
struct AnswerRow {
    panel: Option<String>,
    name: String,
    comparison: Comparison,
}

impl Answer {
    pub(crate) fn comparisons(&self) -> impl Iterator<Item = &Comparison> {
        self.rows.iter().map(|row| &row.comparison)
    }

    /// Returns the measures to report, with their index among all. The best team's G is reported with the champion's.
    fn reported(&self) -> Vec<(usize, Measure)> {
        let measures = self.rows.first().map_or(&[][..], |row| &row.comparison.measures);
        let is_reported = |measure: &Measure| match measure {
            Measure::ChampionG { .. } | Measure::TestG { .. } | Measure::Played { .. } => true,
            Measure::GenerationsToReach { .. } => self.part.reach.is_some(),
            Measure::BestG { .. } => false,
        };
        let measures = measures.iter().map(|measured| measured.measure).enumerate();
        measures.filter(|(_, measure)| is_reported(measure)).collect()
    }

    /// Returns one table per measure for a page, with means and differences. Beside the champion's G, in parentheses, is
    /// the best team's.
    pub fn tables(&self) -> String {
        let tables = self.reported().into_iter().map(|(at, measure)| {
            let arms = self.rows.first().map_or(&[][..], |row| &row.comparison.arms);
            let mut head = vec![measure.to_string()];
            head.extend(arms.iter().map(|arm| arm.name.clone()));
            head.extend(
                self.part.pairs.iter().map(|&[one, other]| format!("{} − {}", arms[one].name, arms[other].name)),
            );
            let rows = self.rows.iter().map(|AnswerRow { panel, name, comparison }| {
                let Measured { arms, pairs, .. } = &comparison.measures[at];
                let place: Vec<&str> =
                    panel.iter().chain(Some(name).filter(|name| !name.is_empty())).map(|word| &**word).collect();
                let best = comparison.measures.iter().find(|other| match (other.measure, measure) {
                    (Measure::BestG { generation: best }, Measure::ChampionG { generation }) => best == generation,
                    _ => false,
                });
                let mean = |(at, (mean, named)): (usize, (&Mean, &Named))| {
                    let note = match (best, mean.reached) {
                        (Some(best), _) => format!(" ({:.3})", best.arms[at].mean.value),
                        (None, Some(count)) => format!(" ({count} of {})", named.trials),
                        (None, None) => String::new(),
                    };
                    measure.text(mean.mean, false) + &note
                };
                let mut row = vec![place.join(", ")];
                row.extend(arms.iter().zip(&comparison.arms).enumerate().map(mean));
                row.extend(self.part.pairs.iter().map(|pair| {
                    pairs.iter().find(|versus| versus.arms == *pair).map_or(String::new(), |versus| {
                        let p = comparison::probability(versus.p_holm);
                        let sign = if p.starts_with('<') { "" } else { "= " };
                        format!("{}, p {sign}{p}", measure.text(versus.difference, true))
                    })
                }));
                row
            });
            table::markdown(&[head].into_iter().chain(rows).collect::<Vec<_>>())
        });
        tables.collect::<Vec<_>>().join("\n")
    }

    /// Returns the tables between their marks in a page.
    pub(crate) fn block(&self) -> String {
        format!("{}\n\n{}\n{END}\n", mark(self.part.name), self.tables())
    }

    /// Draws the means with their intervals.
    pub fn scene(&self) -> Scene {
        let reported: Vec<_> = self
            .reported()
            .into_iter()
            .filter(|(_, measure)| !matches!(measure, Measure::GenerationsToReach { .. }))
            .collect();
        let mut groups: Vec<(String, Vec<String>)> = Vec::new();
        for AnswerRow { name, comparison, .. } in &self.rows {
            if !groups.iter().any(|(other, _)| other == name) {
                groups.push((name.clone(), comparison.arms.iter().map(|arm| arm.name.clone()).collect()));
            }
        }
        let of = |panel: &Option<String>, at: usize| {
            let rows = self.rows.iter().filter(|row| row.panel == *panel);
            let interval = |mean: &Mean| -> Option<Interval> { Some([mean.mean.value, mean.mean.low, mean.mean.high]) };
            rows.flat_map(|row| row.comparison.measures[at].arms.iter().map(interval)).collect::<Vec<_>>()
        };
        let mut panels: Vec<Option<String>> = self.rows.iter().map(|row| row.panel.clone()).collect();
        panels.dedup();
        let several = reported.len() > 1;
        let titled = reported.iter().flat_map(|(at, measure)| {
            panels.iter().map(move |panel| {
                let measure = Some(measure.to_string()).filter(|_| several);
                let title: Vec<_> = measure.into_iter().chain(panel.clone()).collect();
                (title.join(", "), panel, *at)
            })
        });
        let panels = titled.map(|(title, panel, at)| (title, None, of(panel, at))).collect();
        let x_label = match &reported[..] {
            [(_, measure)] => format!("{measure}: mean and 95 % interval"),
            _ => "G: mean and 95 % interval".into(),
        };
        Dots { title: self.part.title.into(), x_label, groups, panels }.scene()
    }
}

/// Returns the mark before a part's table in a page.
pub fn mark(name: &str) -> String {
    format!("<!-- {name}: flotilla paper --questions -->")
}

/// Returns the page with all results, one section per question.
pub fn page(answers: &[(OpenQuestion, Vec<Answer>)], heading: &str) -> String {
    let mut page = format!("# The questions that the paper leaves open\n\n{heading}\n");
    for (OpenQuestion { letter, title, .. }, answers) in answers {
        page += &format!("\n## ({letter}) {title}\n");
        for answer in answers {
            let Study { title, name, .. } = answer.part;
            page += &format!("\n![{title}]({name}.svg)\n\n{}", answer.block());
        }
    }
    page
}
