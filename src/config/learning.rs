//! The sections `[learning]` and `[checkpoint]`: their data and keys.

use super::MAX_LEARNERS;
use crate::config_enum::config_enum;
use crate::model::classes::Fitness;
use crate::model::{LEAST, LONGEST};
use crate::reader::{CountOrPercentage, Reader, between, section};

/// Maximum number of teams in one generation, and of policies in a population.
pub const MAX_POPULATION: usize = 1 << 20;
/// Maximum number of teams that a policy plays in per generation.
pub const MAX_PARTNERS: usize = 16;
/// Maximum number of generations whose champions are kept as partners.
pub const MAX_HALL_OF_FAME: usize = 1000;
/// Maximum number of generations after the random start.
pub const MAX_GENERATIONS: usize = 1_000_000;
/// Maximum number of trials in one run.
pub const MAX_TRIALS: usize = 4096;
/// Maximum number of episodes that a team's score is averaged over.
pub const MAX_EPISODES: usize = 1000;
section! {
    /// `[learning]`: the cooperative coevolution.
    Learning = "learning" {
        /// who learns: the leaders, or every agent
        paradigm: Paradigm = "", "4.1, 4.4",
        /// leaders that share a policy: none, those of a group, or all; they share a population, whose policies are
        /// selected by the mean of their leaders' scores
        sharing: Sharing = "", "2.1",
        /// for sharing = "group": the learners of each group, counted from 0; without them, a group is a class,
        /// or without classes a leader and the learners in followers' places that start nearest to it
        groups: Vec<Vec<usize>> = "", "",
        /// what policies are selected by: the team's score G, D without a leader, Df without a leader and its
        /// followers, D++ with copies of a leader, or Dt without a leader and, at each step, the followers that it
        /// leads then
        fitness: Fitness = "", "3.2, Eq. 1; 4.2, Eq. 5; 2.2",
        /// k: policies per population; a generation has k·m teams, or k·(m + L) with a hall of fame
        population: usize = "policies", "4.3",
        /// m: teams that each policy plays in per generation, each with other random partners; 1 if leaders share a
        /// policy
        partners: usize = "teams", "",
        /// what a policy's fitness is: the mean score of its teams, or the largest, which is lenient with bad partners
        leniency: Leniency = "", "",
        /// how teams are formed: at random; population by population, drawing policies with probability ∝
        /// exp(fitness / temperature); or the best of each population together, then the second best, and so on.
        /// A policy's fitness is its last, or its parent's if it is new
        teams: Teams = "", "",
        /// for teams = "softmax": temperature in the unit of POI values, such as 1 for one observed POI of value 1
        temperature: f64 = "", "",
        /// h: last generations whose champions are kept; from generation 1 on, each policy also plays in a team with
        /// the champions of one of them, drawn at random; 0 means none
        hall_of_fame: usize = "generations", "",
        /// number of generations after the random start
        generations: usize = "generations", "4.3, Alg. 1",
        /// independent repetitions
        trials: usize = "trials", "5",
        /// distribution of the weights of the first policies: normal, or uniform in −1 to 1
        initial: Initial = "", "4.3, Alg. 1",
        /// what these weights are multiplied by
        initial_scale: f64 = "", "",
        /// n: the best of a population, which survive unchanged; a share is rounded to the nearest whole number, and is
        /// at least 1
        elites: Elites = "policies", "4.3, Alg. 1",
        /// teams with the largest G that play again unchanged; their policies are selected among the others, too
        team_elites: usize = "teams", "",
        /// further policies of a population that survive unchanged: those whose teams had the largest G
        team_g_elites: usize = "policies", "",
        /// which policies the parents of a generation are drawn from: by binary tournaments of the whole population, or
        /// uniformly from its elites (truncation selection)
        parents: Parents = "", "4.3, Alg. 1",
        /// how a generation follows from the one before: by elites, tournaments and mutation, or by an evolution
        /// strategy, which samples policies around a mean policy: that of OpenAI, or separable natural evolution
        /// strategies
        method: Method = "", "4.3, Alg. 1",
        /// for evolution strategies: standard deviation of the samples around the mean; "snes" adapts it from there
        search_sigma: f64 = "", "",
        /// for "openai-es": α, how far the mean moves along the estimated gradient
        search_step: f64 = "", "",
        /// what a mutated weight w gains: w·N(0, σ) if scaled, N(0, σ) if additive
        mutation: Mutation = "", "2.4, 4.3",
        /// probability that a weight of a new policy mutates
        mutation_probability: f64 = "", "2.4, 4.3",
        /// σ: standard deviation of a mutation
        mutation_sigma: f64 = "", "2.4, 4.3",
        /// number of episodes over which a team's scores are averaged
        episodes_per_team: usize = "episodes", "",
        /// j: in every episode each agent's start is moved by a uniform offset in −j to j on both axes, the same for
        /// all teams of a generation
        start_jitter: f64 = "units", "",
        /// the same for POIs: largest offset of each POI on both axes in every episode
        poi_jitter: f64 = "units", "",
        /// new episodes that the best team of each generation plays, with random numbers of their own; its mean G is
        /// the column test_g of metrics.csv; 0 means none
        test_episodes: usize = "episodes", "",
        /// random seed: config and seed decide every bit of a run
        seed: u64 = "", "",
    }
}

config_enum! {
    /// The agents that learn.
    Paradigm {
        /// Leaders learn. Followers keep their preset behaviour.
        LeaderFollower = "leader-follower",
        /// All agents learn. The followers' start positions become leaders, appended after the other leaders.
        AllLeaders = "all-leaders",
    }
}

config_enum! {
    /// The leaders that share a policy, which comes from the population that they share.
    Sharing {
        /// No leaders: each has its own population.
        PerLeader = "none",
        /// The leaders of a group, see [`Learning::groups`].
        Group = "group",
        /// All leaders: there is one population.
        Shared = "all",
    }
}

config_enum! {
    /// How the scores of the teams that a policy plays in make its fitness.
    Leniency {
        /// Their mean.
        Mean = "mean",
        /// The largest.
        Max = "max",
    }
}

config_enum! {
    /// The way in which a generation's teams are formed.
    Teams {
        /// All ways have the same probability.
        Random = "random",
        /// Policies are drawn without replacement, fitter ones earlier with a higher probability.
        Softmax = "softmax",
        /// The best policies together, then the second best, and so on.
        Sorted = "sorted",
    }
}

config_enum! {
    /// The distribution of the weights of the first policies.
    Initial {
        /// N(0, 1).
        Normal = "normal",
        /// Uniform in -1..1.
        Uniform = "uniform",
    }
}

config_enum! {
    /// The policies that may become parents.
    Parents {
        /// All policies, by binary tournaments.
        All = "all",
        /// The elites, each with the same probability.
        Elites = "elites",
    }
}

config_enum! {
    /// How a generation follows from the one before.
    Method {
        /// Elites survive, and the others are mutated winners of tournaments, see [`Parents`].
        Tournament = "tournament",
        /// The evolution strategy of OpenAI: mirrored samples, centred ranks, one standard deviation.
        OpenAiEs = "openai-es",
        /// Separable natural evolution strategies: a standard deviation per weight, which adapts.
        Snes = "snes",
    }
}

/// The number of policies in a population that survive unchanged.
pub type Elites = CountOrPercentage;

impl Elites {
    /// Returns the number of elites in a population. A percentage is rounded to the nearest whole number, and gives at
    /// least 1. The result never exceeds the population.
    pub fn count(self, population: usize) -> usize {
        let count = match self {
            Elites::Count(count) => count,
            Elites::Percentage(percentage) => ((population as f64 * percentage / 100.0).round() as usize).max(1),
        };
        count.min(population)
    }
}

config_enum! {
    /// The noise that is added to a mutated weight w.
    Mutation {
        /// w·N(0, σ).
        Scaled = "scaled",
        /// N(0, σ).
        Additive = "additive",
    }
}

impl Paradigm {
    /// Reads the paradigm. It is read before other keys, because they depend on which agents learn.
    pub(super) fn read(r: &mut Reader<'_>) -> Paradigm {
        Learning::paradigm(r).choice(Paradigm::LeaderFollower)
    }
}

impl Learning {
    /// Returns the number of slots for policies in a population's memory.
    ///
    /// The policies come first, then the champion of the previous generation, then the champions of the hall of fame.
    /// An evolution strategy has its mean in place of the champion, and its standard deviations after that.
    pub fn slots(&self) -> usize {
        self.population + 1 + usize::from(self.method != Method::Tournament) + self.hall_of_fame
    }

    /// Reports whether a finished run can be extended from its policies and their fitness, without the other slots.
    pub fn extends_from_policies(&self) -> bool {
        self.method == Method::Tournament && self.hall_of_fame == 0
    }

    /// Returns the number of teams of contemporaries per generation of a trial, without the champions' team.
    pub fn team_count(&self) -> usize {
        self.population * self.partners
    }

    /// Reports whether policies survive because of their team's G.
    pub fn keeps_teams(&self) -> bool {
        self.team_elites + self.team_g_elites > 0
    }

    /// Returns each key of teams whose value is not its default, with the value and the default.
    pub(super) fn team_keys(&self) -> impl Iterator<Item = (&'static str, String, String)> + use<> {
        let word = |word: Teams| format!("\"{word}\"");
        let keys = [
            ("learning.hall_of_fame", self.hall_of_fame.to_string(), "0".into()),
            ("learning.teams", word(self.teams), word(Teams::Random)),
            ("learning.team_elites", self.team_elites.to_string(), "0".into()),
            ("learning.team_g_elites", self.team_g_elites.to_string(), "0".into()),
        ];
        keys.into_iter().filter(|(_, value, default)| value != default)
    }

    /// Reports keys of teams that the other keys do not allow.
    fn check_teams(&self, r: &mut Reader<'_>) {
        let Learning { partners, sharing, ref groups, hall_of_fame, method, population, .. } = *self;
        let single = sharing == Sharing::Shared || groups.len() == 1;
        for (key, found, default) in self.team_keys() {
            let past = key == "learning.hall_of_fame";
            let with = |other: &str, why: &str| format!(" with learning.{other}, allowed {default}: {why}");
            let several = "a policy plays in several teams";
            let problem = match () {
                () if single => with(&format!("sharing = \"{sharing}\""), "a team has a single policy"),
                () if method != Method::Tournament => {
                    format!(", allowed {default} unless learning.method is \"tournament\"")
                }
                () if !past && partners > 1 => with(&format!("partners = {partners}"), several),
                () if !past && hall_of_fame > 0 => with(&format!("hall_of_fame = {hall_of_fame}"), several),
                () => continue,
            };
            r.report_key(key, format!("found {found}{problem}"));
        }
        let kept = [self.elites.count(population), self.team_elites, self.team_g_elites];
        if r.error_count() == 0 && kept[1..] != [0, 0] && kept.iter().sum::<usize>() > population {
            let [elites, of_teams, by_g] = kept;
            let key = if of_teams > 0 { "learning.team_elites" } else { "learning.team_g_elites" };
            let text = format!(
                "found {elites} elites, {of_teams} team_elites and {by_g} team_g_elites, allowed {population} together: \
                 learning.population"
            );
            r.report_key(key, text);
        }
    }

    /// Reads the section. `learners` is the number of agents that learn.
    pub(super) fn read(r: &mut Reader<'_>, paradigm: Paradigm, learners: usize) -> Learning {
        let population = Learning::population(r).number(between(2, MAX_POPULATION), 50);
        let sharing = Learning::sharing(r).choice(Sharing::PerLeader);
        let groups = groups(r, sharing, learners);
        let partners = Learning::partners(r).number(between(1, MAX_PARTNERS), 1);
        let single = sharing == Sharing::Shared || groups.len() == 1;
        if partners > 1 && single {
            let text = format!(
                "found {partners} with learning.sharing = \"{sharing}\", allowed 1: a team has a single policy"
            );
            r.report_key("learning.partners", text);
        } else if population * partners > MAX_POPULATION {
            let teams = population * partners;
            let text = format!("found {partners}, which makes {teams} teams per generation, allowed {MAX_POPULATION}");
            r.report_key("learning.partners", text);
        }
        let method = Learning::method(r).choice(Method::Tournament);
        let elites = Learning::elites(r).count_or_percentage(between(0, population).because("learning.population"), 1);
        let parents = Learning::parents(r).choice(Parents::All);
        if parents == Parents::Elites && elites == Elites::Count(0) {
            r.report_key(
                "learning.parents",
                "found \"elites\" with learning.elites = 0, allowed with 1 or more".into(),
            );
        }
        let learning = Learning {
            paradigm,
            sharing,
            groups,
            fitness: Learning::fitness(r).choice(Fitness::Df),
            population,
            partners,
            leniency: Learning::leniency(r).choice(Leniency::Mean),
            teams: Learning::teams(r).choice(Teams::Random),
            temperature: Learning::temperature(r).number(between(1e-6, 1e6), 1.0),
            hall_of_fame: Learning::hall_of_fame(r).number(between(0, MAX_HALL_OF_FAME), 0),
            generations: Learning::generations(r).number(between(0, MAX_GENERATIONS), 100),
            trials: Learning::trials(r).number(between(1, MAX_TRIALS), 5),
            initial: Learning::initial(r).choice(Initial::Normal),
            initial_scale: Learning::initial_scale(r).number(between(LEAST, 1e3), 1.0),
            elites,
            team_elites: Learning::team_elites(r).number(between(0, population).because("learning.population"), 0),
            team_g_elites: Learning::team_g_elites(r).number(between(0, population).because("learning.population"), 0),
            parents,
            method,
            search_sigma: Learning::search_sigma(r).number(between(LEAST, 100.0), 0.3),
            search_step: Learning::search_step(r).number(between(LEAST, 100.0), 1.0),
            mutation: Learning::mutation(r).choice(Mutation::Scaled),
            mutation_probability: Learning::mutation_probability(r).number(between(LEAST, 1.0).or_zero(), 0.15),
            mutation_sigma: Learning::mutation_sigma(r).number(between(LEAST, 100.0).or_zero(), 0.1),
            episodes_per_team: Learning::episodes_per_team(r).number(between(1, MAX_EPISODES), 1),
            start_jitter: Learning::start_jitter(r).number(between(LEAST, LONGEST).or_zero(), 0.0),
            poi_jitter: Learning::poi_jitter(r).number(between(LEAST, LONGEST).or_zero(), 0.0),
            test_episodes: Learning::test_episodes(r).number(between(0, MAX_EPISODES), 0),
            seed: Learning::seed(r).number(between(0, i64::MAX as u64), 0),
        };
        learning.check_teams(r);
        learning
    }
}

/// Reads the groups of learners that share a population.
fn groups(r: &mut Reader<'_>, sharing: Sharing, learners: usize) -> Vec<Vec<usize>> {
    let each_in_one = |groups: &[Vec<usize>]| {
        let mut group_of = vec![None; learners];
        for (index, group) in groups.iter().enumerate() {
            for &learner in group {
                if group_of[learner].replace(index).is_some() {
                    return vec![(index, format!("found learner {learner} again, allowed in one group"))];
                }
            }
        }
        let missing = group_of.iter().position(Option::is_none);
        missing
            .map(|learner| (0, format!("found no learner {learner}, allowed every learner in one group")))
            .into_iter()
            .collect()
    };
    // Without valid leaders the number of learners is unknown, which is reported already.
    let places = if learners == 0 { MAX_LEARNERS } else { learners };
    let each_in_one = |groups: &[Vec<usize>]| if learners == 0 { vec![] } else { each_in_one(groups) };
    let learner = between(0, places - 1).because("the last learner");
    let groups = Learning::groups(r).lists("groups of learners", ("wanted", None), 1..=places, learner, each_in_one);
    if !groups.is_empty() && sharing != Sharing::Group {
        r.report_key("learning.groups", format!("found with learning.sharing = \"{sharing}\", allowed with \"group\""));
        return vec![];
    }
    groups
}

section! {
    /// `[checkpoint]`: how often a run writes a checkpoint. Results do not depend on it.
    CheckpointConfig = "checkpoint" {
        /// generations between checkpoints, which do not affect results; 0 means never
        generations: usize = "generations", "",
        /// seconds between checkpoints, which do not affect results; 0 means never
        seconds: f64 = "s", "",
    }
}

impl Default for CheckpointConfig {
    fn default() -> CheckpointConfig {
        CheckpointConfig { generations: 0, seconds: 30.0 }
    }
}

impl CheckpointConfig {
    pub(super) fn read(r: &mut Reader<'_>) -> CheckpointConfig {
        CheckpointConfig {
            generations: CheckpointConfig::generations(r).number(between(0, MAX_GENERATIONS), 0),
            seconds: CheckpointConfig::seconds(r)
                .number(between(0.01, 1e9).or_zero(), CheckpointConfig::default().seconds),
        }
    }
}
