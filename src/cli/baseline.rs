//! `flotilla baseline`: plays teams that do not learn.

use serde_json::json;

use super::{ConfigFile, Error, Processor, RunOptions, SetKeys, backend, between, number, print, print_json, say};
use crate::baseline::{self, Baselines, Outcome, SPEEDS};
use crate::choice::Work;
use crate::config::{Actions, Choice, Config, Override, Paradigm};
use crate::evaluate::MAX_EPISODES;
use crate::report::progress::Meter;
use crate::report::table::markdown;
use crate::statistics;
use clap::builder::PossibleValuesParser as Words;

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    config: ConfigFile,
    /// Independent repetitions of the random baselines
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = between(1..=4096u32))]
    seeds: u32,
    /// Held-out episodes per team, if starts or POIs vary; as many others choose the team
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = between(1..=MAX_EPISODES))]
    episodes: u32,
    /// Draw as many random teams as a training with this many generations plays [default: the config's]
    #[arg(long, value_name = "N", value_parser = number)]
    generations: Option<String>,
    /// Draw as many random teams as a training with this population plays [default: the config's]
    #[arg(long, value_name = "N", value_parser = number)]
    population: Option<String>,
    /// Who learns [default: the config's]
    #[arg(long, value_name = "NAME", value_parser = Words::new(Paradigm::names()))]
    paradigm: Option<String>,
    #[command(flatten)]
    set: SetKeys,
    /// Print one JSON object (docs/reference/json.md)
    #[arg(long)]
    json: bool,
    /// Print no progress
    #[arg(long, short)]
    quiet: bool,
    #[command(flatten)]
    run: RunOptions,
}

/// Plays the baselines of a config, one repetition after the other.
pub fn run(args: Args) -> Result<(), Error> {
    let set = |key: &str, value: Option<String>| {
        Some(Override::of_text(format!("learning.{key}"), value?, format!("--{key}")))
    };
    let overrides = [
        set("generations", args.generations.clone()),
        set("population", args.population.clone()),
        set("paradigm", args.paradigm.clone().map(|name| toml::Value::from(name).to_string())),
    ];
    let config =
        args.config.load(&overrides.into_iter().flatten().chain(args.set.set.iter().cloned()).collect::<Vec<_>>())?;
    let (mut backend, machine) = backend::open_for(&args.run, Work::of([&config]))?.0;
    if !args.quiet {
        say(format_args!("playing on {}", backend.describe()));
    }
    let generations = config.learning.generations + 1;
    let mut meter = Meter::new(args.quiet);
    let mut outcomes = Vec::new();
    for seed in 0..args.seeds as usize {
        let mut baselines = Baselines::of_trial(config.clone(), seed);
        while !baselines.is_done() {
            baselines.advance(&mut *backend)?;
            let done = seed * generations + baselines.generation();
            let part = done as f64 / (args.seeds as usize * generations) as f64;
            meter.show(part, || format!("playing random teams of seed {seed}"));
        }
        outcomes.extend(baselines.outcomes(&mut *backend, args.episodes)?.concat());
    }
    meter.clear();
    let found = Found { config: &config, episodes: args.episodes, outcomes };
    if !args.json {
        return print(&found.in_words());
    }
    let mut object = found.in_json();
    Processor::of(&machine, &backend.describe()).add_to(&mut object);
    print_json(&object)
}

/// The outcomes of all seeds.
struct Found<'a> {
    config: &'a Config,
    episodes: u32,
    outcomes: Vec<Outcome>,
}

impl Found<'_> {
    /// Returns the number of random teams of each kind per seed.
    fn teams(&self) -> usize {
        self.config.learning.teams() * (self.config.learning.generations + 1)
    }

    fn pois(&self) -> usize {
        self.config.world.pois.len()
    }

    /// Returns whether starts or POIs move. If they do, some episodes choose a team and others measure it.
    fn moves(&self) -> bool {
        self.config.learning.start_jitter > 0.0 || self.config.learning.poi_jitter > 0.0
    }

    /// Returns the number of observed POIs per seed.
    fn observed(&self, g: impl Fn(&Outcome) -> f64) -> Vec<f64> {
        self.outcomes.iter().map(|outcome| g(outcome) * self.pois() as f64).collect()
    }

    /// Returns each baseline's key, its name and the POIs that it observes per seed.
    fn baselines(&self) -> [(&'static str, String, Vec<f64>); 3] {
        let constant = match self.config.policy.actions {
            Actions::Direct => format!("best of {SPEEDS} constant speeds, straight ahead"),
            Actions::Behaviours => "best constant behaviour".into(),
        };
        let teams = self.teams();
        [
            ("constant", constant, self.observed(|outcome| outcome.constants[outcome.best_constant])),
            ("action", format!("best of {teams} random constant actions"), self.observed(|outcome| outcome.action)),
            ("network", format!("best of {teams} random networks"), self.observed(|outcome| outcome.network)),
        ]
    }

    /// Returns the 95 % interval of a mean over seeds. The constant-action baseline has none if nothing moves, because
    /// all seeds are the same.
    fn interval(&self, key: &str, observed: &[f64]) -> Option<[f64; 2]> {
        let mean = statistics::mean(observed, 1.0).filter(|_| key != "constant" || self.moves())?;
        let mean = mean.within(0.0, self.pois() as f64);
        Some([mean.low, mean.high])
    }

    /// Returns the POIs that each constant action observes, as a mean over seeds.
    fn constants(&self) -> Vec<f64> {
        let seeds = self.outcomes.len() as f64;
        let mean = |index| self.observed(|outcome| outcome.constants[index]).iter().sum::<f64>() / seeds;
        (0..baseline::constants(self.config.policy.actions).len()).map(mean).collect()
    }

    fn in_words(&self) -> String {
        let (pois, seeds, teams) = (self.pois(), self.outcomes.len(), self.teams());
        let head = [&format!("POIs observed, of {pois}"), "mean [95 % interval]", "lowest", "highest"];
        let mut rows = vec![head.map(|head| head.to_string()).to_vec()];
        for (key, name, observed) in self.baselines() {
            let mean = observed.iter().sum::<f64>() / seeds as f64;
            let interval = self.interval(key, &observed);
            let interval = interval.map_or(String::new(), |[low, high]| format!(" [{low:.2}, {high:.2}]"));
            let (low, high) = observed.iter().fold((f64::MAX, f64::MIN), |(l, h), &o| (l.min(o), h.max(o)));
            rows.push(vec![name, format!("{mean:.2}{interval}"), format!("{low:.2}"), format!("{high:.2}")]);
        }
        let solved = self.constants().iter().map(|&observed| observed >= pois as f64).collect::<Vec<_>>();
        let played = match self.moves() {
            true => format!("Each team was chosen by {0} episodes and plays {0} held-out episodes.", self.episodes),
            false => "Every team plays from the config's starts.".into(),
        };
        format!(
            "{}, {} seeds. N = {teams} random teams per seed, as many as one trial of training evaluates. {played}\n\n\
             {}\n{}\n",
            self.config.learning.paradigm,
            seeds,
            markdown(&rows),
            self.solved(&solved)
        )
    }

    /// Returns a sentence about which constant actions observe every POI.
    fn solved(&self, solved: &[bool]) -> String {
        let unit = |index: usize| match self.config.policy.actions {
            Actions::Direct => format!("{} %", (index + 1) * 100 / SPEEDS),
            Actions::Behaviours => format!("{index}"),
        };
        let mut ranges: Vec<String> = vec![];
        let mut from = None;
        for (index, &all) in solved.iter().chain([&false]).enumerate() {
            match (all, from) {
                (true, None) => from = Some(index),
                (false, Some(first)) => {
                    let last = index - 1;
                    ranges.push(if first == last { unit(first) } else { format!("{} to {}", unit(first), unit(last)) });
                    from = None;
                }
                _ => {}
            }
        }
        let ranges = ranges.join(", ");
        match (self.config.policy.actions, ranges.is_empty()) {
            (Actions::Direct, true) => "No constant speed observes every POI.".into(),
            (Actions::Direct, false) => {
                format!("A team that drives straight ahead at {ranges} of motion.max_speed observes every POI.")
            }
            (Actions::Behaviours, true) => "No constant behaviour observes every POI.".into(),
            (Actions::Behaviours, false) => {
                format!("A team that always chooses the behaviour {ranges} observes every POI.")
            }
        }
    }

    fn in_json(&self) -> serde_json::Value {
        let actions = self.config.policy.actions;
        let name = match actions {
            Actions::Direct => "speed",
            Actions::Behaviours => "behaviour",
        };
        let value = |index: usize| match actions {
            Actions::Direct => json!((index + 1) as f64 / SPEEDS as f64),
            Actions::Behaviours => json!(index),
        };
        let constants = self.constants().into_iter().enumerate();
        let constants: Vec<_> = constants.map(|(index, pois)| json!({ name: value(index), "pois": pois })).collect();
        let chosen: Vec<_> = self.outcomes.iter().map(|outcome| value(outcome.best_constant)).collect();
        let baselines = self.baselines().map(|(key, _, observed)| {
            let mean = observed.iter().sum::<f64>() / observed.len() as f64;
            (key, json!({ "mean": mean, "interval_95": self.interval(key, &observed), "seeds": observed }))
        });
        let mut object = json!({
            "paradigm": self.config.learning.paradigm,
            "pois": self.pois(),
            "teams": self.teams(),
            "seeds": self.outcomes.len(),
            "episodes": if self.moves() { self.episodes } else { 1 },
            "constants": constants,
            "chosen": chosen,
        });
        for (key, found) in baselines {
            object[key] = found;
        }
        object
    }
}
