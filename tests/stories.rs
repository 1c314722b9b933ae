//! The paper's three stories (Section 5, Figures 4 to 6) over ten seeds of five trials each.
//!
//! Every claim is about the best team of a generation, in POIs, as the mean over all 50 trials; "by generation N" is at
//! some generation up to N, "spread" the standard deviation over the trials. Without followers Df is D, so
//! leader-follower Df is held against all-leaders D. `cargo test --test stories -- --nocapture` prints the tables.

use std::fmt::Write;

use flotilla::backend::cpu::Cpu;
use flotilla::config::{Config, Fitness, Paradigm};
use flotilla::trainer::Trainer;

const SEEDS: u64 = 10;
const ARMS: [(Paradigm, Fitness); 5] = [
    (Paradigm::AllLeaders, Fitness::G),
    (Paradigm::AllLeaders, Fitness::D),
    (Paradigm::LeaderFollower, Fitness::G),
    (Paradigm::LeaderFollower, Fitness::D),
    (Paradigm::LeaderFollower, Fitness::Df),
];
const TOLD: [usize; 6] = [0, 10, 20, 30, 40, 100];

/// What the best team of each generation observed in every trial, in POIs: `[generations][trials]`.
struct Curve(Vec<Vec<f64>>);

impl Curve {
    fn mean(&self, generation: usize) -> f64 {
        let trials = &self.0[generation];
        trials.iter().sum::<f64>() / trials.len() as f64
    }

    /// The standard deviation over the trials, as of a sample.
    fn spread(&self, generation: usize) -> f64 {
        let (trials, mean) = (&self.0[generation], self.mean(generation));
        (trials.iter().map(|g| (g - mean).powi(2)).sum::<f64>() / (trials.len() - 1) as f64).sqrt()
    }

    /// The highest mean at any generation up to `last`.
    fn by(&self, last: usize) -> f64 {
        (0..=last).map(|generation| self.mean(generation)).fold(0.0, f64::max)
    }
}

/// One layout's arms, each trained from every seed.
struct Story {
    layout: &'static str,
    pois: usize,
    curves: Vec<Curve>,
    /// What the paper says of an arm, what came out, and whether that is so.
    claims: Vec<(Paradigm, Fitness, String, bool)>,
}

impl Story {
    fn train(layout: &'static str, text: &str) -> Story {
        let config = Config::parse(text, layout).unwrap();
        assert_eq!((config.learning.population, config.learning.generations, config.learning.trials), (50, 100, 5));
        let pois = config.world.pois.len();
        let mut curves: Vec<Curve> = ARMS.map(|_| Curve(vec![Vec::new(); 101])).into();
        for seed in 0..SEEDS {
            let arms = ARMS.map(|(paradigm, fitness)| {
                let mut config = config.clone();
                (config.learning.paradigm, config.learning.fitness, config.learning.seed) = (paradigm, fitness, seed);
                config
            });
            let (mut trainer, mut backend) = (Trainer::new(arms.to_vec()), Cpu::default());
            while !trainer.is_done() {
                for row in trainer.advance(&mut backend).unwrap() {
                    curves[row.arm].0[row.generation].push(row.best_g * pois as f64);
                }
            }
        }
        for trials in curves.iter().flat_map(|curve| &curve.0) {
            assert_eq!(trials.len() as u64, SEEDS * 5);
        }
        Story { layout, pois, curves, claims: Vec::new() }
    }

    fn curve(&self, paradigm: Paradigm, fitness: Fitness) -> &Curve {
        &self.curves[ARMS.iter().position(|&arm| arm == (paradigm, fitness)).unwrap()]
    }

    /// Leader-follower and all-leaders by the same fitness; without followers, Df is D.
    fn rivals(&self, fitness: Fitness) -> [&Curve; 2] {
        let alone = if fitness == Fitness::Df { Fitness::D } else { fitness };
        [self.curve(Paradigm::LeaderFollower, fitness), self.curve(Paradigm::AllLeaders, alone)]
    }

    /// Claims something of every arm of a paradigm.
    fn claim(&mut self, paradigm: Paradigm, what: impl Fn(&Story, Fitness) -> (String, bool)) {
        for (_, fitness) in ARMS.into_iter().filter(|arm| arm.0 == paradigm) {
            let (text, holds) = what(self, fitness);
            self.claims.push((paradigm, fitness, text, holds));
        }
    }

    fn under(&mut self, paradigm: Paradigm, limit: f64, generation: usize) {
        self.claim(paradigm, |story, fitness| {
            let mean = story.curve(paradigm, fitness).mean(generation);
            (format!("under {limit} at {generation}: {mean:.2}"), mean < limit)
        });
    }

    fn reaches(&mut self, paradigm: Paradigm, level: f64, last: usize) {
        self.claim(paradigm, |story, fitness| {
            let most = story.curve(paradigm, fitness).by(last);
            (format!("at least {level} by {last}: {most:.2}"), most >= level)
        });
    }

    /// Prints the tables, and fails with the claims that do not hold.
    fn close(self) {
        let mut text = format!("\n{} (of {} POIs)\n\n| paradigm | fitness |", self.layout, self.pois);
        TOLD.iter().for_each(|generation| write!(text, " {generation} |").unwrap());
        text += &format!(" the paper's claims |\n|---|---|{}---|\n", "---|".repeat(TOLD.len()));
        for (&(paradigm, fitness), curve) in ARMS.iter().zip(&self.curves) {
            write!(text, "| {paradigm} | {fitness} |").unwrap();
            for generation in TOLD {
                write!(text, " {:.2} ± {:.2} |", curve.mean(generation), curve.spread(generation)).unwrap();
            }
            let claims = self.claims.iter().filter(|claim| (claim.0, claim.1) == (paradigm, fitness));
            let claims: Vec<_> =
                claims.map(|(.., text, holds)| format!("{text} {}", if *holds { "✓" } else { "✗" })).collect();
            writeln!(text, " {} |", claims.join("; ")).unwrap();
        }
        println!("{text}");
        let broken: Vec<_> = self.claims.iter().filter(|claim| !claim.3).collect();
        assert!(broken.is_empty(), "{}: {broken:?}", self.layout);
    }
}

#[test]
fn generally_forward() {
    let mut story = Story::train("Generally forward", include_str!("../configs/generally_forward.toml"));
    story.under(Paradigm::AllLeaders, 1.0, 100);
    story.reaches(Paradigm::LeaderFollower, 3.0, 20);
    story.close();
}

#[test]
fn strictly_forward() {
    let mut story = Story::train("Strictly forward", include_str!("../configs/strictly_forward.toml"));
    story.under(Paradigm::AllLeaders, 0.4, 100);
    story.reaches(Paradigm::LeaderFollower, 1.8, 30);
    story.close();
}

#[test]
fn chaotic() {
    let mut story = Story::train("Chaotic", include_str!("../configs/chaotic.toml"));
    story.claim(Paradigm::LeaderFollower, |story, fitness| {
        let [followed, alone] = story.rivals(fitness);
        let lead = (5..=100).map(|generation| followed.mean(generation) - alone.mean(generation));
        let least = lead.fold(f64::INFINITY, f64::min);
        (format!("ahead from 5 on: by {least:.2} or more"), least > 0.0)
    });
    story.claim(Paradigm::LeaderFollower, |story, fitness| {
        let [followed, alone] = story.rivals(fitness);
        let (most, level) = (followed.by(10), alone.mean(100));
        (format!("past all-leaders' {level:.2} by 10: {most:.2}"), most > level)
    });
    story.claim(Paradigm::LeaderFollower, |story, fitness| {
        let [followed, alone] = story.rivals(fitness);
        let (spread, other) = (followed.spread(100), alone.spread(100));
        (format!("smaller spread at 100: {spread:.2} under {other:.2}"), spread < other)
    });
    story.close();
}
