//! Compares credit with its definition: agents are removed from a record, or copies added, and G is counted again.
//!
//! Random records cover every rule, fitness and memory layout. Small records made by hand test one property each.

use crate::support;
use flotilla::backend::cpu::Cpu;
use flotilla::backend::{Backend, Group, GroupScores};
use flotilla::config::{Choice, Config, Coupling, Fitness, LedBy, MAX_LEARNERS, Observers, Score, When, WorldConfig};
use flotilla::credit::{Credit, Episode, Scores, Strided};
use flotilla::evolve::aligned_teams;
use flotilla::front;
use flotilla::sample;
use flotilla::world::{Led, PathRule, World};
use rand::rngs::ChaCha8Rng;
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rayon::prelude::*;

/// The record of one team, with sets as lists of agents.
#[derive(Clone, Debug)]
struct Record {
    leaders: usize,
    followers: usize,
    coupling: Vec<u32>,
    /// The agents within the observation radius, `[steps][pois]`.
    near: Vec<Vec<Vec<usize>>>,
    /// The number of steps at which a follower saw a leader, `[followers][leaders]`.
    seen: Vec<Vec<u32>>,
    /// The leaders that a follower saw at a step, `[steps][followers]`.
    sights: Vec<Vec<Vec<usize>>>,
    rule: Rule,
    led: Led,
}

/// The rule by which POIs are observed, as in a config.
#[derive(Clone, Debug)]
struct Rule {
    observers: Observers,
    windows: Vec<[usize; 2]>,
    after: Vec<Vec<usize>>,
}

/// The fields that a record made by hand omits.
const EMPTY: Record = Record {
    leaders: 0,
    followers: 0,
    coupling: vec![],
    near: vec![],
    seen: vec![],
    sights: vec![],
    rule: PLAIN,
    led: Led { within: 0, by: LedBy::MostSeen },
};

const PLAIN: Rule = Rule { observers: Observers::All, windows: vec![], after: vec![] };

impl Record {
    fn world(&self) -> World {
        let mut config = support::layout("generally_forward");
        let Rule { observers, windows, after } = self.rule.clone();
        let place = [1.0, 1.0];
        config.world = WorldConfig {
            leaders: vec![place; self.leaders],
            followers: vec![place; self.followers],
            pois: vec![place; self.coupling.len()],
            coupling: Coupling::Each(self.coupling.iter().map(|&coupling| coupling as usize).collect()),
            steps: self.near.len(),
            observers,
            windows,
            after,
            ..config.world
        };
        (config.credit.led_within, config.credit.led_by) = (self.led.within, self.led.by);
        World::new(&config.validate().unwrap())
    }

    /// Adds followers that are never at a POI, until no coupling exceeds the number of observers.
    fn with_enough_observers(mut self) -> Record {
        let wanted = *self.coupling.iter().max().unwrap() as usize;
        let leaders = if self.rule.observers == Observers::Followers { 0 } else { self.leaders };
        self.followers = self.followers.max(wanted.saturating_sub(leaders));
        self.seen.resize(self.followers, vec![0; self.leaders]);
        self.sights.iter_mut().for_each(|sights| sights.resize(self.followers, vec![]));
        self
    }

    /// Returns the sets, counts and sights in a backend's memory layout. The words of neighbouring teams are noise.
    fn words(&self, stride: usize, offset: usize, rng: &mut ChaCha8Rng) -> [Vec<u32>; 3] {
        let mut noise = |words: usize| -> Vec<u32> { (0..words * stride).map(|_| rng.random()).collect() };
        let set = |set: &[usize], word: usize| -> u32 {
            set.iter().filter(|&&member| member / 32 == word).map(|member| 1 << (member % 32)).sum()
        };
        let words = (self.leaders + self.followers).div_ceil(32);
        let mut sets = noise(self.near.len() * self.coupling.len() * words);
        for (index, near) in self.near.iter().flatten().enumerate() {
            (0..words).for_each(|word| sets[(index * words + word) * stride + offset] = set(near, word));
        }
        let mut seen = noise(self.followers * self.leaders);
        for (index, &steps) in self.seen.iter().flatten().enumerate() {
            seen[index * stride + offset] = steps;
        }
        let words = self.leaders.div_ceil(32);
        let mut sights = noise(self.near.len() * self.followers * words);
        for (index, seen) in self.sights.iter().flatten().enumerate() {
            (0..words).for_each(|word| sights[(index * words + word) * stride + offset] = set(seen, word));
        }
        [sets, seen, sights]
    }

    /// Counts the observed POIs if each agent counts `weight(step, agent)` times, with steps from 0. A POI that is
    /// observed at one step opens others from the next step on.
    fn observed(&self, weight: impl Fn(usize, usize) -> u32) -> u32 {
        let mut observed = vec![false; self.coupling.len()];
        for (step, sets) in self.near.iter().enumerate() {
            let before = observed.clone();
            for (poi, set) in sets.iter().enumerate() {
                let Rule { observers, windows, after } = &self.rule;
                let in_window = windows.is_empty() || (windows[poi][0]..=windows[poi][1]).contains(&(step + 1));
                let open = after.is_empty() || after[poi].iter().all(|&other| before[other]);
                let counts = |&&agent: &&usize| match observers {
                    Observers::All => true,
                    Observers::Leaders => agent < self.leaders,
                    Observers::Followers => agent >= self.leaders,
                };
                let count: u32 = set.iter().filter(counts).map(|&agent| weight(step, agent)).sum();
                observed[poi] |= in_window && open && count >= self.coupling[poi];
            }
        }
        observed.iter().filter(|&&observed| observed).count() as u32
    }

    /// Returns the leader to whose group an agent belongs.
    fn owner(&self, agent: usize) -> Option<usize> {
        if agent < self.leaders {
            return Some(agent);
        }
        let seen = &self.seen[agent - self.leaders];
        let most = *seen.iter().max()?;
        (most > 0).then(|| seen.iter().position(|&steps| steps == most).unwrap())
    }

    /// Returns whether a leader leads an agent at a step, with steps from 0.
    fn leads(&self, leader: usize, step: usize, agent: usize) -> bool {
        let Some(follower) = agent.checked_sub(self.leaders) else { return leader == agent };
        let first = if self.led.within == 0 { 0 } else { (step + 1).saturating_sub(self.led.within) };
        let count =
            |leader: usize| (first..=step).filter(|&step| self.sights[step][follower].contains(&leader)).count();
        let counted: Vec<usize> = (0..self.leaders).filter(|&leader| count(leader) > 0).collect();
        match self.led.by {
            LedBy::AnySeen => counted.contains(&leader),
            LedBy::First => counted.first() == Some(&leader),
            LedBy::Alone => counted == [leader],
            LedBy::Anyone => !counted.is_empty(),
            LedBy::MostSeen => {
                count(leader) > 0
                    && (0..leader).all(|other| count(other) < count(leader))
                    && (leader + 1..self.leaders).all(|other| count(other) <= count(leader))
            }
        }
    }

    /// Returns the scores by their definition.
    fn scores(&self) -> Scores {
        let share = |count: u32, of: u32| count as f32 / of as f32;
        let pois = self.coupling.len() as u32;
        let observed = self.observed(|_, _| 1);
        let owners: Vec<_> = (0..self.leaders + self.followers).map(|agent| self.owner(agent)).collect();
        let without = |leader| observed - self.observed(|_, agent| (agent != leader) as u32);
        let without_group = |leader| observed - self.observed(|_, agent| (owners[agent] != Some(leader)) as u32);
        let without_led = |leader| observed - self.observed(|step, agent| !self.leads(leader, step, agent) as u32);
        let gain = |leader, copies| self.observed(|_, agent| 1 + if agent == leader { copies } else { 0 }) - observed;
        // a/b < c/d, without rounding.
        let less = |(a, b): (u32, u32), (c, d): (u32, u32)| u64::from(c) * u64::from(b) > u64::from(a) * u64::from(d);
        let stepping_stone = |leader| {
            let (d, most) = (without(leader), *self.coupling.iter().max().unwrap());
            if !less((d, 1), (gain(leader, most), most)) {
                return share(d, pois);
            }
            let copies = (1..).find(|&n| !less((gain(leader, n), n), (gain(leader, n + 1), n + 1))).unwrap();
            share(gain(leader, copies), pois * copies)
        };
        Scores {
            observed,
            g: share(observed, pois),
            d: (0..self.leaders).map(|leader| share(without(leader), pois)).collect(),
            df: (0..self.leaders).map(|leader| share(without_group(leader), pois)).collect(),
            dpp: (0..self.leaders).map(stepping_stone).collect(),
            dt: (0..self.leaders).map(|leader| share(without_led(leader), pois)).collect(),
        }
    }
}

/// Generates a random record of at most `agents` agents. Sets have sizes near the coupling: then single agents matter.
fn random(rng: &mut ChaCha8Rng, agents: usize) -> Record {
    let agents = rng.random_range(1..=agents);
    let leaders = if rng.random_bool(0.2) { agents } else { rng.random_range(1..=agents) };
    let followers = agents - leaders;
    let (pois, steps) = (rng.random_range(1..=8), rng.random_range(1..=20));
    let random_coupling = |rng: &mut ChaCha8Rng| match rng.random_range(0..6) {
        0 => 1,
        1 => agents,
        2 => agents + 1,
        3 => rng.random_range(1..=agents),
        _ => rng.random_range(1..=agents.min(6)),
    } as u32;
    let same = random_coupling(rng);
    let each = rng.random_bool(0.3);
    let coupling: Vec<u32> = (0..pois).map(|_| if each { random_coupling(rng) } else { same }).collect();
    let mut near: Vec<Vec<Vec<usize>>> = Vec::new();
    // If the same agents return to a POI (`regular`), the loss of one of them changes G.
    let (empty, stay, regular) = (rng.random_range(0.0..1.0), rng.random_range(0.0..0.8), rng.random_bool(0.7));
    for step in 0..steps {
        let sets = (0..pois).map(|poi| {
            if step > 0 && rng.random_bool(stay) {
                return near[step - 1][poi].clone();
            }
            if rng.random_bool(empty) {
                return Vec::new();
            }
            let wanted = coupling[poi] as i32 + rng.random_range(-3..=2);
            let size = wanted.clamp(1, agents as i32) as usize;
            let first = if regular { poi % agents } else { rng.random_range(0..agents) };
            let stride = if regular || rng.random_bool(0.5) { 1 } else { rng.random_range(1..=agents) };
            let mut set: Vec<_> = (0..size).map(|i| (first + i * stride) % agents).collect();
            if rng.random_bool(0.3) {
                set[0] = rng.random_range(0..agents);
            }
            set.sort_unstable();
            set.dedup();
            set
        });
        let sets = sets.collect();
        near.push(sets);
    }
    let most = if rng.random_bool(0.5) { 2 } else { steps as u32 };
    let row = |rng: &mut ChaCha8Rng| match rng.random_range(0..5) {
        0 => vec![0; leaders],
        1 => vec![most; leaders],
        _ => (0..leaders).map(|_| rng.random_range(0..=most)).collect(),
    };
    let seen = (0..followers).map(|_| row(rng)).collect();
    // A follower mostly sees the leaders that it saw at the step before.
    let (change, many) = (rng.random_range(0.05..0.6), rng.random_range(0.1..0.7));
    let mut sights: Vec<Vec<Vec<usize>>> = Vec::new();
    for step in 0..steps {
        let of = |follower: usize| match step > 0 && !rng.random_bool(change) {
            true => sights[step - 1][follower].clone(),
            false => (0..leaders).filter(|_| rng.random_bool(many)).take(6).collect(),
        };
        let now = (0..followers).map(of).collect();
        sights.push(now);
    }
    let within = if rng.random_bool(0.3) { 0 } else { rng.random_range(1..=steps + 1) };
    let led = Led { within, by: LedBy::ALL[rng.random_range(0..LedBy::ALL.len())].1 };
    Record { leaders, followers, coupling, near, seen, sights, rule: PLAIN, led }.with_enough_observers()
}

/// Returns the record with a random rule.
fn with_random_rule(rng: &mut ChaCha8Rng, record: Record) -> Record {
    let (pois, steps) = (record.coupling.len(), record.near.len());
    let observers = match rng.random_range(0..4) {
        0 => Observers::Leaders,
        1 if record.followers > 0 => Observers::Followers,
        _ => Observers::All,
    };
    let window = |rng: &mut ChaCha8Rng| {
        let (a, b) = (rng.random_range(1..=steps), rng.random_range(1..=steps));
        if rng.random_bool(0.5) { [1, steps] } else { [a.min(b), a.max(b)] }
    };
    let windows = if rng.random_bool(0.5) { (0..pois).map(|_| window(rng)).collect() } else { vec![] };
    let mut after = vec![];
    if rng.random_bool(0.6) {
        let mut order: Vec<usize> = (0..pois).collect();
        order.shuffle(rng);
        after = vec![vec![]; pois];
        for place in 1..pois {
            let some = order[..place].iter().copied().filter(|_| rng.random_bool(0.5));
            after[order[place]] = some.collect();
        }
    }
    let mut record = Record { rule: Rule { observers, windows, after }, ..record };
    // At most as many as the leaders, or the followers that fit, can be needed.
    let most = match observers {
        Observers::All => MAX_LEARNERS,
        Observers::Leaders => record.leaders,
        Observers::Followers => MAX_LEARNERS - record.leaders,
    };
    record.coupling.iter_mut().for_each(|coupling| *coupling = (*coupling).min(most as u32));
    record.with_enough_observers()
}

/// Compares the scores of a record with their definition. Returns them.
fn compare(record: &Record, credit: &mut Credit, rng: &mut ChaCha8Rng, stride: usize) -> Scores {
    let world = record.world();
    let offset = rng.random_range(0..stride);
    let [sets, seen, sights] = record.words(stride, offset, rng);
    let strided = |words| Strided { words, stride, offset };
    let (sights, seen) = (strided(&sights), strided(&seen));
    let episode = Episode { sets: strided(&sets), seen, sights, paths: None };
    let expected = record.scores();
    assert_eq!(credit.all(&episode, &world), expected);
    let without_sights = Episode { sights: Strided::NONE, ..episode };
    let dt = if record.followers == 0 { expected.dt.clone() } else { vec![] };
    assert_eq!(credit.all(&without_sights, &world), Scores { dt, ..expected.clone() });
    let mut g = vec![f32::NAN; record.leaders];
    assert_eq!(credit.score(&episode, &world, Fitness::G, &mut g), expected.observed);
    assert_eq!(g, vec![expected.g; record.leaders]);
    let mut dt = vec![f32::NAN; record.leaders];
    assert_eq!(credit.score(&episode, &world, Fitness::Dt, &mut dt), expected.observed);
    assert_eq!(dt, expected.dt);
    expected
}

#[test]
fn every_fitness_equals_its_definition() {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut credit = Credit::default();
    // Numbers of records whose scores differ, with the default rule and with a random rule.
    let mut differ = [0; 7];
    let mut by_rule = [0; 5];
    for case in 0..6000 {
        let agents = [3, 12, 20, 32, 33, 70][case % 6];
        let record = random(&mut rng, agents);
        let other_rule = with_random_rule(&mut rng, record.clone());
        let found = compare(&other_rule, &mut credit, &mut rng, [1, 8, 16][case % 3]);
        let stride = [1, 8, 16][case % 3];
        let scores = compare(&record, &mut credit, &mut rng, stride);
        let any = |list: &[f32]| list.iter().any(|&score| score > 0.0);
        let kinds = [found != scores, any(&found.d), found.df != found.d, found.dpp != found.d, found.dt != found.df];
        by_rule.iter_mut().zip(kinds).for_each(|(count, is)| *count += is as u32);
        differ[0] += any(&scores.d) as u32;
        differ[1] += (scores.df != scores.d) as u32;
        differ[2] += (scores.dpp != scores.d) as u32;
        differ[3] += (scores.observed as usize == record.coupling.len()) as u32;
        differ[4] += (scores.observed == 0) as u32;
        differ[5] += (scores.dt != scores.d) as u32;
        differ[6] += (scores.dt != scores.df) as u32;
    }
    // Critical leaders, critical groups, gains by copies, all POIs and no POI observed: each has to be frequent.
    assert!(differ.iter().all(|&cases| cases > 300), "{differ:?}");
    assert!(by_rule.iter().all(|&cases| cases > 300), "{by_rule:?}");
}

#[test]
fn every_fitness_equals_its_definition_with_a_thousand_agents() {
    // One of the first cases takes half a minute.
    let first = if support::is_long() { 0 } else { 11 };
    (first..30).into_par_iter().for_each(|case| {
        let mut rng = ChaCha8Rng::seed_from_u64(1000 + case);
        let record = random(&mut rng, 1000);
        let record = if case % 2 == 0 { record } else { with_random_rule(&mut rng, record) };
        compare(&record, &mut Credit::default(), &mut rng, [1, 8, 16][case as usize % 3]);
    });
}

/// Returns the scores of a record made by hand, after comparing them with their definition.
fn scores_of(record: &Record) -> Scores {
    let mut record = record.clone();
    // If a record omits the sights, no follower saw a leader.
    record.sights.resize(record.near.len(), vec![vec![]; record.followers]);
    compare(&record.with_enough_observers(), &mut Credit::default(), &mut ChaCha8Rng::seed_from_u64(0), 8)
}

/// Equations 1 and 2 with C = 2.
#[test]
fn two_agents_observe_a_poi_only_at_the_same_step() {
    let near = vec![vec![vec![0, 1], vec![0]], vec![vec![], vec![1]]];
    let scores =
        scores_of(&Record { leaders: 2, followers: 0, coupling: vec![2, 2], near, seen: vec![], rule: PLAIN, ..EMPTY });
    assert_eq!((scores.observed, scores.g), (1, 0.5));
    assert_eq!((scores.d, scores.df), (vec![0.5, 0.5], vec![0.5, 0.5]));
}

/// Three agents are near a POI with C = 2. No single agent is critical, but a leader with its follower is.
#[test]
fn df_credits_a_leader_that_d_does_not() {
    let near = vec![vec![vec![0, 1, 2]]];
    let record =
        Record { leaders: 2, followers: 1, coupling: vec![2], near, seen: vec![vec![3, 1]], rule: PLAIN, ..EMPTY };
    let scores = scores_of(&record);
    assert_eq!(scores.d, [0.0, 0.0]);
    assert_eq!(scores.df, [1.0, 0.0]);
    let tied = scores_of(&Record { seen: vec![vec![2, 2]], ..record });
    assert_eq!(tied.df, [1.0, 0.0]);
}

#[test]
fn a_follower_that_saw_no_leader_belongs_to_no_group() {
    let near = vec![vec![vec![1, 2]]];
    let scores = scores_of(&Record {
        leaders: 1,
        followers: 2,
        coupling: vec![2],
        near,
        seen: vec![vec![0], vec![0]],
        rule: PLAIN,
        ..EMPTY
    });
    assert_eq!((scores.g, scores.d, scores.df), (1.0, vec![0.0], vec![0.0]));
}

#[test]
fn a_leader_is_not_critical_if_others_observe_at_another_step() {
    let near = vec![vec![vec![0, 1]], vec![vec![2, 3]]];
    let scores =
        scores_of(&Record { leaders: 4, followers: 0, coupling: vec![2], near, seen: vec![], rule: PLAIN, ..EMPTY });
    assert_eq!((scores.g, scores.d), (1.0, vec![0.0; 4]));
}

/// Two POIs with C = 3. Leader 0, alone at the first POI, needs two copies there. At the second POI one copy is enough,
/// because two leaders are there.
#[test]
fn dpp_is_the_gain_per_copy() {
    let near = vec![vec![vec![0], vec![0, 1]]];
    let scores =
        scores_of(&Record { leaders: 3, followers: 0, coupling: vec![3, 3], near, seen: vec![], rule: PLAIN, ..EMPTY });
    // Leader 0: one copy completes 1 of 2 POIs (value 1/2), two copies both (2/2 over 2 = 1/2), which is not larger.
    // Leader 1: one copy completes the second POI. Leader 2 was near no POI.
    assert_eq!((scores.d, scores.dpp), (vec![0.0; 3], vec![0.5, 0.5, 0.0]));
}

/// The search ends at the first number of copies whose value the next number does not exceed. If a POI needs three
/// copies, one and two copies both have the value 0, so the search ends there.
#[test]
fn dpp_finds_a_gain_by_two_copies_but_not_by_three() {
    let near = |set: &[usize]| vec![vec![set.to_vec()]];
    let alone = |coupling| Record {
        leaders: 1,
        followers: 0,
        coupling: vec![coupling],
        near: near(&[0]),
        seen: vec![],
        rule: PLAIN,
        ..EMPTY
    };
    assert_eq!(scores_of(&alone(2)).dpp, [1.0]);
    assert_eq!(scores_of(&alone(3)).dpp, [0.5]);
    assert_eq!(scores_of(&alone(4)).dpp, [0.0]);
}

#[test]
fn a_leader_gets_credit_for_pois_that_it_opens() {
    // Leader 0 alone observes POI 0 at step 1; leader 1 is at POI 1 at steps 1 and 2, which is observed at step 2.
    let near = vec![vec![vec![0], vec![1]], vec![vec![], vec![1]]];
    let rule = Rule { after: vec![vec![], vec![0]], ..PLAIN };
    let record = Record { leaders: 2, followers: 0, coupling: vec![1, 1], near, seen: vec![], rule, ..EMPTY };
    let scores = scores_of(&record);
    assert_eq!((scores.observed, scores.d), (2, vec![1.0, 0.5]));
    // A POI does not open another at the same step.
    let near = record.near[..1].to_vec();
    assert_eq!(scores_of(&Record { near, ..record.clone() }).observed, 1);
    // The window of POI 1 ends before POI 0 opens it.
    let rule = Rule { windows: vec![[1, 2], [1, 1]], ..record.rule.clone() };
    let scores = scores_of(&Record { rule, ..record });
    assert_eq!((scores.observed, scores.d), (1, vec![0.5, 0.0]));
}

#[test]
fn df_credits_a_leader_if_only_followers_observe() {
    let near = vec![vec![vec![0, 1, 2]]];
    let rule = Rule { observers: Observers::Followers, ..PLAIN };
    let record =
        Record { leaders: 1, followers: 2, coupling: vec![2], near, seen: vec![vec![0], vec![1]], rule, ..EMPTY };
    let scores = scores_of(&record);
    assert_eq!(
        (scores.observed, &scores.d[..], &scores.df[..], &scores.dpp[..]),
        (1, &[0.0][..], &[1.0][..], &[0.0][..])
    );
    let near = vec![vec![vec![0, 1]]];
    assert_eq!(scores_of(&Record { near, ..record }).observed, 0);
}

/// One leader brings the follower to a POI, another leader brings it to the next. Df gives both POIs to the leader that
/// the follower saw most.
#[test]
fn dt_gives_each_poi_to_the_leader_that_led_there() {
    // The follower, agent 2, is at POI 0 at step 3, led by leader 0, and at POI 1 at step 5, led by leader 1.
    let mut near = vec![vec![vec![], vec![]]; 5];
    (near[2][0], near[4][1]) = (vec![2], vec![2]);
    let sights = [0, 0, 0, 1, 1].map(|leader| vec![vec![leader]]).to_vec();
    let led = Led { within: 2, by: LedBy::MostSeen };
    let record =
        Record { leaders: 2, followers: 1, coupling: vec![1, 1], near, seen: vec![vec![3, 2]], sights, led, ..EMPTY };
    let scores = scores_of(&record);
    assert_eq!((scores.d, scores.df, scores.dt), (vec![0.0; 2], vec![1.0, 0.0], vec![0.5, 0.5]));
    // Counted over all steps, leader 0 leads until the end. With `AnySeen`, leader 1 leads as well from step 4 on.
    let dt = |led: Led| scores_of(&Record { led, ..record.clone() }).dt;
    assert_eq!(dt(Led { within: 0, by: LedBy::MostSeen }), [1.0, 0.0]);
    assert_eq!(dt(Led { within: 0, by: LedBy::AnySeen }), [1.0, 0.5]);
    assert_eq!(dt(Led { within: 1, by: LedBy::AnySeen }), [0.5, 0.5]);
    // If the first POI opens the second, both depend on leader 0.
    let rule = Rule { after: vec![vec![], vec![0]], ..PLAIN };
    assert_eq!(scores_of(&Record { rule, ..record.clone() }).dt, [1.0, 0.5]);
}

/// The CPU scores whole vectors of teams where it can. Whatever it scores by, the scores are those of each team's record.
#[test]
fn played_teams_get_the_scores_of_their_records() {
    let fitnesses: Vec<Vec<Fitness>> = Fitness::ALL
        .iter()
        .map(|&(_, fitness)| vec![fitness])
        .chain([vec![], vec![Fitness::Df, Fitness::D], vec![Fitness::G, Fitness::Dpp]])
        .collect();
    let (mut cpu, mut credit) = (Cpu::default(), Credit::default());
    let mut observed_by_rule = [0, 0];
    for seed in 0..100 {
        let world = World::new(&sample::any_world(seed).validate().unwrap());
        let (leaders, policies) = (world.leaders(), 5);
        let populations: Vec<u32> = (0..leaders as u32).collect();
        let weights = sample::weights(&world, policies, seed);
        let teams: Vec<u32> = (0..37 * leaders).map(|place| (place * 7 % policies) as u32).collect();
        let group = Group { populations: &populations, ..Group::new(&world, &weights[..], policies, &teams) };
        let group = |fitnesses| Group { fitnesses, ..group };
        let trace = cpu.trace(&group(&[Fitness::Dt])).unwrap();
        for fitnesses in &fitnesses {
            let found = cpu.play(&[group(fitnesses)]).unwrap();
            let mut expected = GroupScores::default();
            for team in 0..37 {
                let (episode, mut scores) = (trace.episode(&world, team), vec![f32::NAN; leaders]);
                expected.observed.push(credit.score(&episode, &world, Fitness::G, &mut scores));
                for &fitness in fitnesses {
                    credit.score(&episode, &world, fitness, &mut scores);
                    expected.scores.extend(&scores);
                }
            }
            assert_eq!(found, [expected], "world {seed}, {fitnesses:?}");
            let is_plain = !world.rule.is_timed();
            observed_by_rule[usize::from(is_plain)] += found[0].observed.iter().filter(|&&count| count > 0).count();
        }
    }
    assert!(observed_by_rule.iter().all(|&teams| teams > 500), "{observed_by_rule:?}");
}

/// Every fitness, in the order of [`Scores`].
const EVERY: [Fitness; 5] = [Fitness::G, Fitness::D, Fitness::Df, Fitness::Dpp, Fitness::Dt];

/// Plays a few teams of random policies on the CPU. Returns their scores by [`EVERY`] fitness, `[teams][fitnesses][leaders]`,
/// and their paths, `[teams][steps + 1][agents][2]`.
fn paths_of(world: &World, seed: u64) -> (Vec<f32>, Vec<f32>) {
    let (policies, leaders) = (4, world.leaders());
    let weights = sample::weights(world, policies, seed);
    let populations: Vec<u32> = (0..leaders as u32).collect();
    let teams = aligned_teams(policies, leaders);
    let group = Group::new(world, &weights[..], policies, &teams);
    let group = Group { populations: &populations, fitnesses: &EVERY, ..group };
    let (mut cpu, mut positions) = (Cpu::default(), vec![]);
    let trace = cpu.trace(&group).unwrap();
    for team in 0..policies {
        for step in 0..=world.steps() {
            positions.extend((0..world.agents()).flat_map(|agent| trace.moment(step, team, agent).position));
        }
    }
    (cpu.play(&[group]).unwrap().remove(0).scores, positions)
}

#[test]
fn paths_and_sets_give_equal_scores() {
    let (mut compared, mut lost) = (0, [0; 5]);
    for seed in 0..240 {
        let mut config = sample::any_world(seed);
        config.world.after.clear();
        config.pois.iter_mut().for_each(|group| group.after.clear());
        let world = World::new(&config.validate().unwrap());
        if world.paths.is_some() || config.pois.iter().any(|group| group.region.is_some()) {
            continue;
        }
        let (expected, positions) = paths_of(&world, seed);
        let found = front::score(&config, &positions).unwrap();
        let leaders = world.leaders();
        for (team, expected) in expected.chunks_exact(5 * leaders).enumerate() {
            for (row, expected) in expected.chunks_exact(leaders).enumerate() {
                let each = [&found.d, &found.df, &found.dpp, &found.dt];
                for (leader, expected) in expected.iter().enumerate() {
                    let found = if row == 0 { found.g[team] } else { each[row - 1][team * leaders + leader] };
                    assert_eq!(found, *expected, "world {seed}, team {team}, leader {leader}, {:?}", EVERY[row]);
                    lost[row] += u32::from(*expected > 0.0);
                }
            }
            compared += 1;
        }
    }
    assert!(compared > 500 && lost.iter().all(|&count| count > 100), "{compared} teams, {lost:?}");
}

/// G by its definition, in units of worth, of the agents that count `times(moment, agent)` times.
fn worth_of_path(world: &World, paths: &PathRule, positions: &[f32], times: impl Fn(usize, usize) -> usize) -> u32 {
    let steps = world.steps();
    let worth_of = |poi: usize| {
        let (score, when) = paths.scores[poi];
        let value = |moment: usize| {
            let mut near = vec![];
            for agent in (0..world.agents()).filter(|&agent| world.rule.counts_at(poi, agent)) {
                let at = &positions[(moment * world.agents() + agent) * 2..][..2];
                let (dx, dy) = (at[0] - world.pois[poi].x, at[1] - world.pois[poi].y);
                let d2 = dx * dx + dy * dy;
                near.extend(vec![d2; if d2 <= world.radii2[poi] { times(moment, agent) } else { 0 }]);
            }
            near.sort_by(f32::total_cmp);
            let all = [1, steps as u32];
            let is_open = |window: [u32; 2]| window == all || (window[0]..=window[1]).contains(&(moment as u32));
            let is_open = world.rule.window(poi).is_none_or(is_open);
            let coupling = world.coupling[poi] as usize;
            match score {
                _ if !is_open || near.len() < coupling => 0,
                Score::Observed => world.worth[poi],
                Score::Closeness => {
                    let squared: f32 = near[..coupling].iter().map(|d2| d2.max(1.0)).product();
                    (f64::from(world.worth[poi]) / f64::from(squared).sqrt()).round() as u32
                }
            }
        };
        let moments = usize::from(!paths.start_counts)..=steps;
        match when {
            When::Ever => moments.map(value).max().unwrap(),
            When::End => value(steps),
            When::Mean => {
                let (count, sum) = (moments.clone().count() as u64, moments.map(|moment| u64::from(value(moment))));
                ((sum.sum::<u64>() + count / 2) / count) as u32
            }
        }
    };
    (0..world.pois.len()).map(worth_of).sum()
}

#[test]
fn scores_of_paths_equal_their_definition() {
    let (mut teams, mut kinds, mut differ) = (0, std::collections::HashSet::new(), [0; 3]);
    for seed in (1..401).step_by(2) {
        let config = sample::classes_world(seed);
        let world = World::new(&config.validate().unwrap());
        let Some(paths) = &world.paths else { continue };
        kinds.extend(paths.scores.iter().map(|kind| format!("{kind:?} {}", paths.start_counts)));
        let (leaders, words) = (world.leaders(), world.agents().div_ceil(32));
        let (scores, positions) = paths_of(&world, seed);
        let total = world.total_worth as f32;
        let size = positions.len() / 4;
        for (scores, positions) in scores.chunks_exact(5 * leaders).zip(positions.chunks_exact(size)) {
            let of = |times: &dyn Fn(usize, usize) -> usize| worth_of_path(&world, paths, positions, times);
            let whole = of(&|_, _| 1);
            for leader in 0..leaders {
                let removed = |agent: usize| match paths.removes[..] {
                    [] => agent == leader,
                    _ => paths.removes[leader * words + agent / 32] >> (agent % 32) & 1 != 0,
                };
                let lost = whole - of(&|_, agent| usize::from(!removed(agent)));
                let alone = whole - of(&|_, agent| usize::from(agent != leader));
                let most = *world.coupling.iter().max().unwrap();
                let gain = |copies: u32| of(&|_, agent| 1 + if agent == leader { copies as usize } else { 0 }) - whole;
                // The largest of D++(n), up to the first that the next does not exceed.
                let product = |a: u32, b: u32| u64::from(a) * u64::from(b);
                let mut dpp = alone as f32 / total;
                if product(alone, most) < u64::from(gain(most)) {
                    let last = (1..most).find(|&n| product(gain(n + 1), n) <= product(gain(n), n + 1)).unwrap_or(most);
                    dpp = gain(last) as f32 / (u64::from(world.total_worth) * u64::from(last)) as f32;
                }
                let row = |fitness: usize| scores[fitness * leaders + leader];
                assert_eq!(row(0), whole as f32 / total, "world {seed}, G");
                assert_eq!(row(1), lost as f32 / total, "world {seed}, D of leader {leader}");
                assert_eq!(row(3), dpp, "world {seed}, D++ of leader {leader}");
                let seen = [whole != 0 && whole != world.total_worth, lost != alone, dpp > alone as f32 / total];
                differ.iter_mut().zip(seen).for_each(|(count, seen)| *count += u32::from(seen));
            }
            teams += 1;
        }
    }
    assert!(
        teams > 200 && kinds.len() == 12 && differ.iter().all(|&count| count > 20),
        "{teams}, {kinds:?}, {differ:?}"
    );
}

/// More than 32 leaders need several words. A leader takes out itself and, at each moment, whom it alone influences.
#[test]
fn dt_of_many_leaders_equals_its_definition() {
    let mut differ = 0;
    for start_counts in [false, true] {
        let row = |y: f64| (0..40).map(|i| format!("[{:?}, {y:?}],", 5.0 + f64::from(i))).collect::<String>();
        let class = |name: &str, y: f64, more: &str| {
            format!(
                "[[agents]]\nname = \"{name}\"\nat = [{}]\nmotion = {{ kind = \"free\", max_speed = 1.0 }}\n\
                 senses = [{{ of = \"pois\", frame = \"map\", range = 50.0 }}]\n{more}\n",
                row(y)
            )
        };
        let text = format!(
            "[world]\nsteps = 20\ndt = 1.0\nstart_counts = {start_counts}\n{}{}[[pois]]\nname = \"poi\"\nat = [{}]\n\
             radius = 4.0\nscore = \"closeness\"\nwhen = \"mean\"\n[credit]\nled_by = \"alone\"\n[learning]\nfitness = \"Dt\"\n",
            class("rover", 20.0, ""),
            class("uav", 21.0, "observes = false\nleads = \"rover\"\ninfluence_radius = 1.5"),
            row(25.0)
        );
        let config = Config::parse(&text, "many.toml").unwrap();
        let world = World::new(&config.validate().unwrap());
        let paths = world.paths.as_ref().unwrap();
        let (scores, positions) = paths_of(&world, 5);
        let (agents, leaders, later) = (world.agents(), world.leaders(), usize::from(!start_counts));
        let size = positions.len() / 4;
        for (scores, positions) in scores.chunks_exact(5 * leaders).zip(positions.chunks_exact(size)) {
            let at = |moment: usize, agent: usize| {
                let place = &positions[(moment * agents + agent) * 2..][..2];
                [place[0], place[1]]
            };
            let influences = |moment: usize, uav: usize, rover: usize| {
                let ([x, y], [to_x, to_y]) = (at(moment, uav), at(moment, rover));
                (x - to_x) * (x - to_x) + (y - to_y) * (y - to_y) <= 1.5 * 1.5
            };
            let leads = |moment: usize, uav: usize, rover: usize| {
                moment >= later && influences(moment - later, uav, rover) && {
                    (40..80).filter(|&other| influences(moment - later, other, rover)).count() == 1
                }
            };
            let of = |times: &dyn Fn(usize, usize) -> usize| worth_of_path(&world, paths, positions, times);
            let whole = of(&|_, _| 1);
            for uav in 40..80 {
                let lost = whole
                    - of(&|moment, agent| usize::from(agent != uav && (agent >= 40 || !leads(moment, uav, agent))));
                assert_eq!(
                    scores[4 * leaders + uav],
                    lost as f32 / world.total_worth as f32,
                    "{start_counts}, Dt of {uav}"
                );
                differ += u32::from(lost > 0 && uav >= 64);
            }
        }
    }
    assert!(differ > 20, "{differ}");
}
