//! The table of keys, but for those of the model's parts: each stands here once, with its unit, its meaning, where the
//! paper has it, what it allows and its default.
//!
//! A faulty number reads as the most that is allowed, a faulty list as none, so that what depends on it is not blamed as
//! well.

use std::f64::consts::FRAC_PI_2;

use super::{
    Checkpoint, Config, Coupling, Fitness, Follow, Learning, MAX_AGENTS, MAX_EPISODES, MAX_GENERATIONS, MAX_POIS,
    MAX_POLICY_BYTES, MAX_POPULATION, MAX_STEPS, MAX_TRIALS, Motion, Mutation, Paradigm, Policy, Sense, World,
};
use crate::model::couple::observation_radius;
use crate::model::{LEAST, LONGEST};
use crate::reader::{Allowed, Reader, between};

impl Config {
    /// Asks for every key.
    pub(super) fn ask(r: &mut Reader<'_>) -> Config {
        let (motion, start_speed) = Motion::read(r);
        let config = Config {
            world: World::read(r, start_speed),
            motion,
            follow: Follow::read(r),
            sense: Sense::read(r),
            policy: Policy::read(r),
            learning: Learning::read(r),
            checkpoint: Checkpoint::read(r),
        };
        if r.faults() == 0 && config.policy_bytes() > MAX_POLICY_BYTES {
            let gib = |bytes: u64| bytes.div_ceil(1 << 30);
            let (bytes, most) = (gib(config.policy_bytes()), gib(MAX_POLICY_BYTES));
            let population = config.learning.population;
            let text = format!("found {population}, whose policies of all trials take {bytes} GiB, allowed {most} GiB");
            r.blame_key("learning.population", text);
        }
        config
    }
}

impl World {
    /// Reads the section; agents start with one of these speeds.
    fn read(r: &mut Reader<'_>, start_speed: Allowed<f64>) -> World {
        let map = r
            .key("world.map", "units", "width and height; positions stay within 0 to these", "3.1")
            .pair(between(1.0, LONGEST), [50.0, 50.0]);
        let sides = map.map(|side| between(LEAST, side).or_zero().because("the map"));
        let leaders = r
            .key("world.leaders", "units", "start positions of the leaders, which are agents 0 to L − 1", "4.1, Fig. 3")
            .positions(1..=MAX_AGENTS, sides, None);
        let followers = r
            .key(
                "world.followers",
                "units",
                "start positions of the followers, agents L to N − 1; in the all-leaders paradigm leaders stand there",
                "4.1, Fig. 3",
            )
            .positions(0..=MAX_AGENTS - 1, sides, Some(vec![]));
        let pois = r
            .key(
                "world.pois",
                "units",
                "positions of the P points of interest, which stay where they are",
                "3.1, Fig. 3",
            )
            .positions(1..=MAX_POIS, sides, None);
        let agents = leaders.as_ref().zip(followers.as_ref()).map_or(MAX_AGENTS, |(l, f)| l.len() + f.len());
        if agents > MAX_AGENTS {
            let message = format!("found {agents} agents with the leaders, allowed 1 to {MAX_AGENTS}");
            r.blame_key("world.followers", message);
        }
        World {
            map,
            coupling: Coupling::read(r, agents.min(MAX_AGENTS), pois.as_ref().map(Vec::len)),
            leaders: leaders.unwrap_or_default(),
            followers: followers.unwrap_or_default(),
            pois: pois.unwrap_or_default(),
            observation_radius: observation_radius(r),
            steps: r
                .key("world.steps", "steps", "T: length of an episode", "3.2, Eq. 2")
                .number(between(1, MAX_STEPS), 25),
            dt: r.key("world.dt", "s", "time that a step takes", "").number(between(1e-4, 10.0), 0.2),
            heading: r
                .key(
                    "world.heading",
                    "rad",
                    "every agent's heading at the start, from the x axis towards the y axis: π/2 faces the POIs",
                    "3.1, Fig. 3",
                )
                .number(between(-1e3, 1e3), FRAC_PI_2),
            speed: r.key("world.speed", "units/s", "every agent's speed at the start", "3.1").number(start_speed, 0.0),
        }
    }
}

impl Learning {
    fn read(r: &mut Reader<'_>) -> Learning {
        let population = r
            .key("learning.population", "policies", "k: policies of each learner, and teams of a generation", "4.3")
            .number(between(2, MAX_POPULATION), 50);
        Learning {
            paradigm: r
                .key("learning.paradigm", "", "who learns: the leaders, or every agent", "4.1, 4.4")
                .choice(Paradigm::LeaderFollower),
            fitness: r
                .key(
                    "learning.fitness",
                    "",
                    "what policies are selected by: the team's score G, D without a leader, Df without a leader \
                     and its followers, or D++ with copies of a leader",
                    "3.2, Eq. 1; 4.2, Eq. 5; 2.2",
                )
                .choice(Fitness::Df),
            population,
            generations: r
                .key("learning.generations", "generations", "how many follow the random start", "4.3, Alg. 1")
                .number(between(0, MAX_GENERATIONS), 100),
            trials: r
                .key("learning.trials", "trials", "independent repetitions", "5")
                .number(between(1, MAX_TRIALS), 5),
            elites: r
                .key(
                    "learning.elites",
                    "policies",
                    "n: the best of a population, which survive unchanged",
                    "4.3, Alg. 1",
                )
                .number(between(0, population).because("learning.population"), 1),
            mutation: r
                .key(
                    "learning.mutation",
                    "",
                    "what a mutated weight w gains: w·N(0, σ) if scaled, N(0, σ) if additive",
                    "2.4, 4.3",
                )
                .choice(Mutation::Scaled),
            mutation_probability: r
                .key("learning.mutation_probability", "", "of each weight of a new policy, to mutate", "2.4, 4.3")
                .number(between(LEAST, 1.0).or_zero(), 0.15),
            mutation_sigma: r
                .key("learning.mutation_sigma", "", "σ: standard deviation of a mutation", "2.4, 4.3")
                .number(between(LEAST, 100.0).or_zero(), 0.1),
            episodes_per_team: r
                .key("learning.episodes_per_team", "episodes", "over which a team's scores are averaged", "")
                .number(between(1, MAX_EPISODES), 1),
            start_jitter: r
                .key(
                    "learning.start_jitter",
                    "units",
                    "j: in every episode each agent's start is moved by a uniform offset in −j to j on both axes, \
                     the same for all teams of a generation",
                    "",
                )
                .number(between(LEAST, LONGEST).or_zero(), 0.0),
            seed: r
                .key("learning.seed", "", "start of all randomness: config and seed decide every bit", "")
                .number(between(0, i64::MAX as u64), 0),
        }
    }
}

impl Checkpoint {
    fn read(r: &mut Reader<'_>) -> Checkpoint {
        Checkpoint {
            generations: r
                .key(
                    "checkpoint.generations",
                    "generations",
                    "between checkpoints, which change no result; 0 is never",
                    "",
                )
                .number(between(0, MAX_GENERATIONS), 0),
            seconds: r
                .key("checkpoint.seconds", "s", "between checkpoints, which change no result; 0 is never", "")
                .number(between(0.01, 1e9).or_zero(), Checkpoint::default().seconds),
        }
    }
}
