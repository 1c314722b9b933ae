//! What a layout gives without any learning: a team that goes straight ahead, and the best of as many random teams as
//! evolution evaluates.
//!
//! Both are played by a backend like any team, from the starts of the trial that they are held against. Random teams
//! are drawn as generation 0 draws policies, by a purpose of their own, so that no result of a training changes.

use std::cell::RefCell;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use fearless_simd::Level;
use glam::Vec2;

use crate::backend::{Backend, BackendError, Episode, Group, RecordRequest};
use crate::config::{Config, Fitness, Learning};
use crate::credit::Credit;
use crate::evolve::{self, Key, Purpose};
use crate::parallel::*;
use crate::world::World;

/// What came out for one config: G in 0..1, `[trials][generations + 1]`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Baseline {
    /// A team whose weights are all zero: every leader goes straight ahead at half its highest speed.
    pub straight: Vec<Vec<f64>>,
    /// The best of all random teams so far, as many in each generation as the population has.
    pub random: Vec<Vec<f64>>,
}

/// Plays the baselines of any number of configs side by side, generation by generation: each in the world of the file's own
/// keys, whatever its stages change.
pub struct Baselines {
    places: Vec<Setting>,
    generation: usize,
}

/// One config and its trials.
struct Setting {
    config: Config,
    world: World,
    /// `[trials][populations][population + 1][parameters]`; the last policy is zero.
    weights: Vec<Vec<f32>>,
    /// `[trials][episodes][agents]`, with POIs if they move.
    starts: Vec<Vec<Vec<Vec2>>>,
    /// Team j is every leader's policy j, `[population + 1][leaders]`.
    teams: Vec<u32>,
    /// POIs observed in all episodes of the present generation, `[trials][population + 1]`.
    observed: Vec<AtomicU32>,
    found: Baseline,
}

impl Baselines {
    /// Of valid configs; fitness, selection and mutation have no say.
    pub fn new(configs: Vec<Config>) -> Baselines {
        Baselines { places: configs.into_iter().map(Setting::new).collect(), generation: 0 }
    }

    /// The generation that plays next.
    pub fn generation(&self) -> usize {
        self.generation
    }

    /// Whether every config's last generation has been played.
    pub fn is_done(&self) -> bool {
        self.places.iter().all(|place| place.config.learning.generations < self.generation)
    }

    /// Plays one generation's teams of every config that has one left.
    ///
    /// # Errors
    /// When the backend fails; this generation can then be played again.
    pub fn advance(&mut self, backend: &mut dyn Backend) -> Result<(), BackendError> {
        thread_local! { static CREDIT: RefCell<(Credit, Vec<f32>)> = RefCell::default(); }
        let generation = self.generation;
        let mut playing: Vec<_> =
            self.places.iter_mut().filter(|place| generation <= place.config.learning.generations).collect();
        playing.iter_mut().for_each(|place| place.prepare(generation));
        let (mut groups, mut homes) = (Vec::new(), Vec::new());
        for place in &playing {
            let policies = place.config.learning.population + 1;
            for (trial, (weights, starts)) in place.weights.iter().zip(&place.starts).enumerate() {
                for starts in starts {
                    let (world, weights, teams) = (&place.world, weights[..].into(), &*place.teams);
                    groups.push(Group {
                        world,
                        starts,
                        weights,
                        policies,
                        teams,
                        need: RecordRequest::Score(Fitness::G),
                    });
                    homes.push((&**place, trial * policies));
                }
            }
        }
        backend.rollout(&groups, &|episode: Episode<'_>| {
            let (place, first) = homes[episode.group];
            CREDIT.with_borrow_mut(|(credit, scores)| {
                scores.resize(place.world.leaders(), 0.0);
                let observed = credit.score(&episode, &place.world, Fitness::G, scores);
                place.observed[first + episode.team].fetch_add(observed, Relaxed);
            });
        })?;
        playing.iter_mut().for_each(|place| place.conclude());
        self.generation += 1;
        Ok(())
    }

    /// What came out, by config.
    pub fn found(self) -> Vec<Baseline> {
        self.places.into_iter().map(|place| place.found).collect()
    }
}

impl Setting {
    fn new(config: Config) -> Setting {
        let world = World::new(&config);
        let Learning { trials, population, episodes_per_team, generations, .. } = config.learning;
        let none = || vec![Vec::with_capacity(generations + 1); trials];
        Setting {
            weights: vec![vec![0.0; config.populations() * (population + 1) * world.parameters()]; trials],
            starts: vec![vec![vec![]; episodes_per_team]; trials],
            teams: (0..=population as u32).flat_map(|team| vec![team; world.leaders()]).collect(),
            observed: std::iter::repeat_with(AtomicU32::default).take(trials * (population + 1)).collect(),
            found: Baseline { straight: none(), random: none() },
            config,
            world,
        }
    }

    /// Draws a generation's policies and starts.
    fn prepare(&mut self, generation: usize) {
        let Setting { config, world, weights, starts, observed, .. } = self;
        let Learning { seed, population, .. } = config.learning;
        let (level, parameters) = (Level::new(), world.parameters());
        weights.par_iter_mut().zip(starts).enumerate().for_each(|(trial, (weights, starts))| {
            let key = Key::new(seed, trial, Purpose::Baseline);
            let populations = weights.par_chunks_exact_mut((population + 1) * parameters).enumerate();
            populations.for_each(|(leader, policies)| {
                let drawn = policies.chunks_exact_mut(parameters).take(population).enumerate();
                drawn.for_each(|(slot, policy)| evolve::random_policy(level, key.at(generation, leader, slot), policy));
            });
            for (episode, starts) in starts.iter_mut().enumerate() {
                evolve::places(&config.learning, trial, generation, episode, world, starts);
            }
        });
        observed.iter().for_each(|observed| observed.store(0, Relaxed));
    }

    /// Takes in what the generation's teams observed.
    fn conclude(&mut self) {
        let Learning { population, episodes_per_team, .. } = self.config.learning;
        let whole = (self.world.pois.len() * episodes_per_team) as f64;
        let Baseline { straight, random } = &mut self.found;
        let trials = self.observed.chunks_exact(population + 1);
        for ((straight, random), observed) in straight.iter_mut().zip(random).zip(trials) {
            let g = |team: &AtomicU32| f64::from(team.load(Relaxed)) / whole;
            straight.push(g(&observed[population]));
            random.push(observed[..population].iter().map(g).chain(random.last().copied()).fold(0.0, f64::max));
        }
    }
}
