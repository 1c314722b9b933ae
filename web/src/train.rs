//! Trains generation by generation, and replays the champion of any generation.

use std::collections::BTreeMap;

use flotilla::backend::Backend;
use flotilla::backend::cpu::Cpu;
use flotilla::config::{Config, Fitness, ValidConfig};
use flotilla::host::Instant;
use flotilla::trainer::{Row, Snapshot, Trainer};
use flotilla_app::report::replay;
use serde::Deserialize;
use serde_json::{Value, json};

use crate::answer::{Answer, Refusal, refuse};

/// A config, and the trials of it that this worker trains. `None` means all trials.
#[derive(Deserialize)]
pub struct Chosen {
    text: String,
    trials: Option<Vec<usize>>,
}

/// Maximum bytes of the snapshots from which generations are replayed.
const KEPT_BYTES: usize = 48 << 20;

/// Trials that advance together: all trials of several configs, or a single trial.
struct Batch {
    trainer: Trainer,
    /// Per experiment of the trainer, the index of its run, and the trial if it is a single one.
    experiments: Vec<(usize, Option<usize>)>,
}

/// Snapshots of single trials, by run, trial and generation.
struct Kept {
    snapshots: BTreeMap<(usize, usize, usize), Snapshot>,
    /// Generations between snapshots.
    every: usize,
}

/// The training of one worker.
#[derive(Default)]
pub struct Training {
    configs: Vec<ValidConfig>,
    batches: Vec<Batch>,
    kept: Kept,
}

impl Default for Kept {
    fn default() -> Kept {
        Kept { snapshots: BTreeMap::new(), every: 5 }
    }
}

impl Training {
    pub fn new(runs: Vec<Chosen>) -> Result<Training, Refusal> {
        let parse = |chosen: &Chosen| Ok(Config::parse(&chosen.text, "the config")?.validate()?);
        let configs = runs.iter().map(parse).collect::<Result<Vec<_>, Refusal>>()?;
        let mut batches = Vec::new();
        let whole: Vec<usize> = (0..runs.len()).filter(|&run| runs[run].trials.is_none()).collect();
        if !whole.is_empty() {
            let trainer = Trainer::new(whole.iter().map(|&run| configs[run].clone()));
            batches.push(Batch { trainer, experiments: whole.into_iter().map(|run| (run, None)).collect() });
        }
        for (run, chosen) in runs.iter().enumerate() {
            for &trial in chosen.trials.iter().flatten() {
                if trial >= configs[run].learning.trials {
                    return Err(refuse(format!("no trial {trial}")));
                }
                let trainer = Trainer::of_trial(&configs[run], trial);
                batches.push(Batch { trainer, experiments: vec![(run, Some(trial))] });
            }
        }
        let mut training = Training { configs, batches, kept: Kept::default() };
        training.keep()?;
        Ok(training)
    }

    /// Plays at least one generation, at most `most`, and starts none after `time` milliseconds.
    ///
    /// The numbers of the answer are the rows, `[rows][7]` f64: run, trial, generation, best, mean and champion G, and the
    /// tested best team's, or NaN.
    pub fn advance(&mut self, backend: &mut dyn Backend, most: usize, time: f64) -> Result<Answer, Refusal> {
        let (start, mut rows, mut played) = (Instant::now(), Vec::new(), 0);
        while played < most && !self.is_done() && (played == 0 || start.elapsed().as_secs_f64() * 1000.0 < time) {
            for Batch { trainer, experiments } in self.batches.iter_mut().filter(|batch| !batch.trainer.is_done()) {
                for Row { experiment, trial, generation, best_g, mean_g, champion_g, test_g } in
                    trainer.advance(backend).map_err(refuse)?
                {
                    rows.extend([
                        experiments[experiment].0 as f64,
                        trial as f64,
                        generation as f64,
                        best_g,
                        mean_g,
                        champion_g,
                        test_g.unwrap_or(f64::NAN),
                    ]);
                }
            }
            played += 1;
            self.keep()?;
        }
        let next = self.batches.iter().map(|batch| batch.trainer.generation(0)).min();
        let words =
            json!({ "next": next, "played": played, "done": self.is_done(), "seconds": start.elapsed().as_secs_f64() });
        Ok((words, bytemuck::cast_slice(&rows).to_vec()))
    }

    fn is_done(&self) -> bool {
        self.batches.iter().all(|batch| batch.trainer.is_done())
    }

    /// Keeps snapshots of the trials whose generation is due. Above [`KEPT_BYTES`], drops every second generation.
    fn keep(&mut self) -> Result<(), Refusal> {
        for batch in &mut self.batches {
            for experiment in 0..batch.experiments.len() {
                let generation = batch.trainer.generation(experiment);
                let last = self.configs[batch.experiments[experiment].0].learning.generations;
                if generation.is_multiple_of(self.kept.every) && generation <= last {
                    batch.keep(experiment, &mut self.kept)?;
                }
            }
        }
        while self.kept.bytes() > KEPT_BYTES {
            let every = 2 * self.kept.every;
            self.kept.every = every;
            self.kept.snapshots.retain(|(_, _, generation), _| generation.is_multiple_of(every));
            if self.kept.snapshots.keys().all(|(_, _, generation)| *generation == 0) {
                break;
            }
        }
        Ok(())
    }

    /// Returns the episode of a generation's champion, as [`replay::detailed`].
    ///
    /// The CPU plays it, which gives the same bits as a GPU.
    ///
    /// `generation` defaults to the newest that is finished, or 0.
    pub fn champion(&mut self, run: usize, trial: usize, generation: Option<usize>) -> Result<Value, Refusal> {
        let config = self.configs.get(run).ok_or_else(|| refuse(format!("no run {run}")))?;
        if trial >= config.learning.trials {
            return Err(refuse(format!("no trial {trial}")));
        }
        let is_of = |&(of, alone): &(usize, Option<usize>)| of == run && alone.is_none_or(|alone| alone == trial);
        let batch = self.batches.iter_mut().find_map(|batch| Some((batch.experiments.iter().position(is_of)?, batch)));
        let last = config.learning.generations;
        let at_hand = batch.as_ref().map_or(last, |(experiment, batch)| batch.trainer.generation(*experiment));
        let generation = generation.unwrap_or(at_hand.saturating_sub(1)).min(last);
        // A champion is in its slot once its generation is over.
        let wanted = generation + 1;
        if let Some((experiment, batch)) = batch.filter(|_| at_hand == wanted) {
            batch.keep(experiment, &mut self.kept)?;
        }
        let mut trainer = Trainer::of_trial(config, trial);
        let before = self.kept.snapshots.range((run, trial, 0)..=(run, trial, wanted)).next_back();
        if let Some((_, snapshot)) = before {
            // The sizes always match. If they did not, training from the start would give the same result.
            let _ = trainer.restore(0, snapshot.clone());
        }
        let mut cpu = Cpu::default();
        while trainer.generation(0) < wanted {
            trainer.advance(&mut cpu).map_err(refuse)?;
        }
        let config = config.at(generation);
        // Under Dt, what Dt needs is recorded, and every other credit, too.
        let mut timed = Config::clone(config);
        timed.learning.fitness = Fitness::Dt;
        timed.agents.iter_mut().for_each(|class| class.fitness = None);
        let mut played = replay::champion(config, &timed, &mut trainer, trial, &mut cpu).map_err(refuse)?;
        if !config.fitnesses().contains(&Fitness::Dt) {
            // Then followers are drawn with the leader that they saw most.
            played.led.clear();
        }
        Ok(replay::detailed("", config, &[played]))
    }

    /// Returns the results of a run's trials that this worker has finished.
    ///
    /// The numbers are, per trial, the policies, the fitness, and the weights after the last generation if they are
    /// needed, as f32.
    pub fn ends(&mut self, run: usize) -> Result<Answer, Refusal> {
        let (mut words, mut numbers) = (Vec::new(), Vec::<u8>::new());
        for Batch { trainer, experiments } in self.batches.iter_mut().filter(|batch| batch.trainer.is_done()) {
            let own: Vec<usize> =
                (0..experiments.len()).filter(|&experiment| experiments[experiment].0 == run).collect();
            for ((policies, end), &experiment) in trainer.ends(&own).into_iter().zip(&own) {
                for (trial, (policies, fitness)) in policies.iter().zip(&end.fitness).enumerate() {
                    let weights = end.weights.get(trial).copied().unwrap_or_default();
                    words.push(json!({
                        "trial": experiments[experiment].1.unwrap_or(trial),
                        "policies": policies.len(),
                        "numbers": policies.len() + fitness.len() + weights.len(),
                    }));
                    for part in [*policies, *fitness, weights] {
                        numbers.extend_from_slice(bytemuck::cast_slice(part));
                    }
                }
            }
        }
        Ok((words.into(), numbers))
    }
}

impl Batch {
    /// Keeps a snapshot of each trial of an experiment.
    fn keep(&mut self, experiment: usize, kept: &mut Kept) -> Result<(), Refusal> {
        let (run, alone) = self.experiments[experiment];
        let Snapshot { generation, last, weights, fitness, pending } =
            self.trainer.snapshot(experiment).map_err(refuse)?;
        for (trial, ((weights, fitness), pending)) in weights.into_iter().zip(fitness).zip(pending).enumerate() {
            let snapshot =
                Snapshot { generation, last, weights: vec![weights], fitness: vec![fitness], pending: vec![pending] };
            kept.snapshots.insert((run, alone.unwrap_or(trial), generation), snapshot);
        }
        Ok(())
    }
}

impl Kept {
    fn bytes(&self) -> usize {
        let bytes = |snapshot: &Snapshot| snapshot.weights.iter().map(Vec::len).sum::<usize>() * size_of::<f32>();
        self.snapshots.values().map(bytes).sum()
    }
}
