//! `[learning]` and `[checkpoint]`: their data and their keys.

use serde::Serialize;

use super::MAX_STEPS;
use crate::declare::choice;
use crate::model::{LEAST, LONGEST};
use crate::reader::{Reader, between};

/// Most teams (policies a population) in one generation.
pub const MAX_POPULATION: usize = 1 << 20;
/// Most generations after the random start.
pub const MAX_GENERATIONS: usize = 1_000_000;
/// Most trials in one run.
pub const MAX_TRIALS: usize = 4096;
/// Most episodes averaged for one team's score.
pub const MAX_EPISODES: usize = 1000;
/// `[learning]`: the cooperative coevolution.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Learning {
    pub paradigm: Paradigm,
    pub sharing: Sharing,
    pub fitness: Fitness,
    pub population: usize,
    pub generations: usize,
    pub trials: usize,
    pub elites: usize,
    pub mutation: Mutation,
    pub mutation_probability: f64,
    pub mutation_sigma: f64,
    /// See [`Led`](crate::world::Led).
    pub led_within: usize,
    pub led_by: LedBy,
    pub episodes_per_team: usize,
    pub start_jitter: f64,
    pub poi_jitter: f64,
    pub seed: u64,
}

choice! {
    /// Who learns.
    Paradigm {
        /// The leaders; followers keep their preset behaviour.
        LeaderFollower = "leader-follower",
        /// Every agent: the followers' places become leaders, appended after the leaders.
        AllLeaders = "all-leaders",
    }
}

choice! {
    /// Which leaders have a policy in common.
    Sharing {
        /// None: each has a population of its own.
        None = "none",
        /// All: there is one population, and every leader of a team plays the same policy.
        All = "all",
    }
}

choice! {
    /// Which score a policy is selected by (see [`crate::credit`]).
    Fitness {
        /// The team's score.
        G = "G",
        /// Difference evaluation.
        D = "D",
        /// Difference evaluation that takes a leader's followers out with it.
        Df = "Df",
        /// Difference evaluation with copies of the leader as stepping stones.
        Dpp = "D++",
        /// Difference evaluation that takes a leader's followers out with it at the steps at which it leads them.
        Dt = "Dt",
    }
}

choice! {
    /// By which of the leaders that it saw a follower is led.
    LedBy {
        /// The one that it saw at most steps.
        MostSeen = "most-seen",
        /// All of them.
        AnySeen = "any-seen",
    }
}

choice! {
    /// How a mutated weight gains its noise.
    Mutation {
        /// Times itself.
        Scaled = "scaled",
        /// Plainly.
        Additive = "additive",
    }
}

impl Paradigm {
    /// Asks for it; it says which agents there are.
    pub(super) fn read(r: &mut Reader<'_>) -> Paradigm {
        r.key("learning.paradigm", "", "who learns: the leaders, or every agent", "4.1, 4.4")
            .choice(Paradigm::LeaderFollower)
    }
}

impl Learning {
    pub(super) fn read(r: &mut Reader<'_>, paradigm: Paradigm) -> Learning {
        let population = r
            .key("learning.population", "policies", "k: policies of each learner, and teams of a generation", "4.3")
            .number(between(2, MAX_POPULATION), 50);
        Learning {
            paradigm,
            sharing: r
                .key(
                    "learning.sharing",
                    "",
                    "whose policy is the same: nobody's, or all leaders': then there is one population, whose policies are \
                     selected by the mean of their leaders' scores",
                    "2.1",
                )
                .choice(Sharing::None),
            fitness: r
                .key(
                    "learning.fitness",
                    "",
                    "what policies are selected by: the team's score G, D without a leader, Df without a leader \
                     and its followers, D++ with copies of a leader, or Dt without a leader and, at each step, the \
                     followers that it leads then",
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
            led_within: r
                .key(
                    "learning.led_within",
                    "steps",
                    "for Dt: how many of the last steps tell who leads a follower, the present one among them; 0 is all \
                     since the start",
                    "",
                )
                .number(between(0, MAX_STEPS), 0),
            led_by: r
                .key(
                    "learning.led_by",
                    "",
                    "for Dt: the leader that a follower saw at most of these steps leads it, or any that it saw",
                    "4.2, 5",
                )
                .choice(LedBy::MostSeen),
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
            poi_jitter: r
                .key(
                    "learning.poi_jitter",
                    "units",
                    "likewise, of each POI",
                    "",
                )
                .number(between(LEAST, LONGEST).or_zero(), 0.0),
            seed: r
                .key("learning.seed", "", "start of all randomness: config and seed decide every bit", "")
                .number(between(0, i64::MAX as u64), 0),
        }
    }
}

/// `[checkpoint]`: how often a run saves what it needs to go on, without a say in its results; 0 is never.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Saving {
    /// After so many generations.
    pub generations: usize,
    /// After so many seconds.
    pub seconds: f64,
}

impl Default for Saving {
    fn default() -> Saving {
        Saving { generations: 0, seconds: 30.0 }
    }
}

impl Saving {
    pub(super) fn read(r: &mut Reader<'_>) -> Saving {
        Saving {
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
                .number(between(0.01, 1e9).or_zero(), Saving::default().seconds),
        }
    }
}
