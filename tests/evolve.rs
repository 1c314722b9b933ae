//! Tests teams, starts, selection and mutation, and compares the trainer with a plain implementation of the paper's
//! Algorithm 1.
//!
//! Statistical tests use seeded draws. Counts and means must be within five standard deviations of their expected
//! values.

use crate::golden::cases;
use crate::support;
use std::collections::HashSet;
use std::f64::consts::TAU;
use std::ops::Range;

use fearless_simd::Level;
use flotilla::backend::cpu::{Cpu, level_name};
use flotilla::backend::{Backend, Group};
use flotilla::config::{
    Choice, Config, Elites, Fitness, Learning, Leniency, Method, Mutation, Parents, Sharing, Teams, ValidConfig,
    own_populations,
};
use flotilla::credit::Credit;
use flotilla::evaluate::Starts;
use flotilla::evolve::{
    self, Key, MAX_WEIGHT, MIN_WEIGHT, Purpose, Selection, TEST_EPISODES, TRAINING_EPISODES, UNCHANGED,
};
use flotilla::sample;
use flotilla::stepping::{Recording, Stepper};
use flotilla::trainer::{Row, Trainer};
use flotilla::world::{GRID, World};
use glam::Vec2;
use proptest::prelude::*;

const PURPOSES: [Purpose; 12] = [
    Purpose::Weights,
    Purpose::Teams,
    Purpose::Starts,
    Purpose::Tournament,
    Purpose::Mutation,
    Purpose::Baseline,
    Purpose::HeldOut,
    Purpose::Pois,
    Purpose::HeldOutPois,
    Purpose::ConstantActions,
    Purpose::Search,
    Purpose::HallOfFame,
];
const GENERALLY_FORWARD: &str = "generally_forward";
const CHAOTIC: &str = "chaotic";

fn config(layout: &str, change: impl FnOnce(&mut Config)) -> Config {
    let mut config = support::layout(layout);
    change(&mut config);
    // Tests use only configs that the program accepts.
    config.with(&[]).unwrap()
}

fn learning(mutation: Mutation, probability: f64, sigma: f64) -> Learning {
    let change = |config: &mut Config| {
        let Learning { mutation: kind, mutation_probability, mutation_sigma, .. } = &mut config.learning;
        (*kind, *mutation_probability, *mutation_sigma) = (mutation, probability, sigma);
    };
    config(GENERALLY_FORWARD, change).learning
}

/// Mutates with scratch memory that is not empty, as after another policy.
fn mutate(level: Level, key: Key, learning: &Learning, weights: &mut [f32]) {
    evolve::mutate(level, key, learning, weights, &mut vec![7; 9]);
}

#[track_caller]
fn assert_near(what: &str, actual: f64, expected: f64, deviation: f64) {
    assert!((actual - expected).abs() <= 5.0 * deviation, "{what}: {actual}, expected {expected} ± {deviation}");
}

/// Compares counts with the probability of each index, using a chi-square test.
#[track_caller]
fn assert_distribution(what: &str, counts: &[u32], probability: impl Fn(usize) -> f64) {
    let total: u32 = counts.iter().sum();
    let term = |(index, &count): (usize, &u32)| {
        let expected = f64::from(total) * probability(index);
        assert!(expected > 5.0, "{what}: too few draws for a chi-square test");
        (f64::from(count) - expected).powi(2) / expected
    };
    let freedom = (counts.len() - 1) as f64;
    assert_near(what, counts.iter().enumerate().map(term).sum(), freedom, (2.0 * freedom).sqrt());
}

fn uniform(word: u32) -> f64 {
    f64::from(word) / (1u64 << 32) as f64
}

fn bits(weights: &[f32]) -> Vec<u32> {
    weights.iter().map(|weight| weight.to_bits()).collect()
}

proptest! {
    #[test]
    fn every_policy_is_on_exactly_one_team_per_round(
        seed in 0..u64::MAX / 2, generation in 0usize..200, partners in 1usize..4, leaders in 1usize..30,
        population in 2usize..300, elites in 0usize..3,
    ) {
        let learning = Learning { seed, partners, population, elites: Elites::Count(elites), ..config(CHAOTIC, |_| ()).learning };
        let teams = evolve::contemporary_teams(&learning, 3, generation, own_populations(leaders));
        for round in teams.chunks(population * leaders) {
            for leader in 0..leaders {
                let mut policies: Vec<u32> = round.iter().skip(leader).step_by(leaders).copied().collect();
                policies.sort_unstable();
                prop_assert!(policies.into_iter().eq(0..population as u32));
            }
        }
    }

    /// Scores have few distinct values, so that nearly all are tied.
    #[test]
    fn elites_are_sorted_and_ties_go_to_the_lower_index(
        scores in prop::collection::vec(0u8..6, 1..80), share in 0.0..=1.0f64,
    ) {
        let scores: Vec<f32> = scores.into_iter().map(|score| f32::from(score) / 4.0).collect();
        let count = (share * scores.len() as f64) as usize;
        let mut order: Vec<usize> = (0..scores.len()).collect();
        // A stable sort keeps the order of ties.
        order.sort_by(|&a, &b| scores[b].partial_cmp(&scores[a]).unwrap());
        prop_assert_eq!(evolve::top_indices(&scores, count), &order[..count]);
    }

    #[test]
    fn starts_stay_on_the_map_and_on_the_grid(
        seed: u64, jitter in 1e-6..30.0f64, width in 1.0..60.0f64, height in 1.0..60.0f64,
    ) {
        let config = config(GENERALLY_FORWARD, |config| {
            config.world.map = [width, height];
            for places in [&mut config.world.leaders, &mut config.world.followers, &mut config.world.pois] {
                places.iter_mut().for_each(|place| *place = [place[0].min(width), place[1].min(height)]);
            }
        });
        let world = World::new(&config.validate().unwrap());
        let mut starts = vec![Vec2::NAN; 2];
        evolve::jitter_starts(Key::new(seed, 0, Purpose::Starts), 7, 1, &world, jitter, &mut starts);
        prop_assert_eq!(starts.len(), world.agents());
        for (start, from) in starts.iter().zip(&world.starts) {
            for (at, from, wall) in [(start.x, from.x, world.map().x), (start.y, from.y, world.map().y)] {
                prop_assert!((0.0..=wall).contains(&at));
                prop_assert!((at * GRID).fract() == 0.0 || at == wall, "{} is off the grid", at);
                let farthest = jitter + 1.0 / f64::from(GRID) + 1e-5;
                prop_assert!(f64::from((at - from).abs()) <= farthest, "{} from {}", at, from);
            }
        }
    }
}

/// Shuffles, which several elites need.
#[test]
fn all_ways_to_form_teams_are_equally_likely() {
    let (leaders, population) = (3, 4);
    let learning = Learning { population, elites: Elites::Count(2), ..config(CHAOTIC, |_| ()).learning };
    // Counts the three teams of the policies 0 jointly, because the populations are shuffled independently.
    let mut joint = vec![0; population * population * population];
    let mut orders = vec![0; 256];
    for generation in 0..12_000 {
        let teams = evolve::contemporary_teams(&learning, 0, generation, own_populations(leaders));
        joint[teams_of_first(&teams, leaders)] += 1;
        let order = (0..population).fold(0, |order, team| order * 4 + teams[team * leaders] as usize);
        orders[order] += 1;
    }
    assert_distribution("teams of the policies 0", &joint, |_| 1.0 / 64.0);
    orders.retain(|&count| count > 0);
    assert_eq!(orders.len(), 24);
    assert_distribution("orders of four policies", &orders, |_| 1.0 / 24.0);
}

/// The index of the teams of the policies 0 of three leaders among all such triples.
fn teams_of_first(teams: &[u32], leaders: usize) -> usize {
    let population = teams.len() / leaders;
    let team = |leader: usize| (0..population).position(|team| teams[team * leaders + leader] == 0).unwrap();
    (team(0) * population + team(1)) * population + team(2)
}

/// Rotations put the elite on a uniformly random team in each population, independently. The others are exchangeable.
#[test]
fn rotations_put_elites_on_independent_teams() {
    let (leaders, population) = (3, 5);
    let learning = Learning { population, ..config(CHAOTIC, |_| ()).learning };
    let mut joint = vec![0; population * population * population];
    for generation in 1..=12_000 {
        let teams = evolve::contemporary_teams(&learning, 0, generation, own_populations(leaders));
        joint[teams_of_first(&teams, leaders)] += 1;
        for pair in teams.chunks(leaders).collect::<Vec<_>>().windows(2) {
            let next = pair[0].iter().map(|policy| (policy + 1) % population as u32);
            assert!(next.eq(pair[1].iter().copied()), "generation {generation}: {teams:?}");
        }
    }
    assert_distribution("teams of the elites", &joint, |_| 1.0 / 125.0);
}

/// Returns a selection without any policies that survive.
fn selection(parents: Parents) -> Selection {
    Selection { elites: 0, team_elites: 0, team_g_elites: 0, parents }
}

/// The champions of tied teams: with G, the policies of one team have equal scores in all populations.
#[test]
fn tied_champions_are_drawn_independently_unless_the_elite_is_among_them() {
    let mut scores = vec![0.25; 20];
    let tied = [3, 4, 9, 17];
    tied.iter().for_each(|&policy| scores[policy] = 0.75);
    let key = Key::new(5, 0, Purpose::Tournament);
    let selection = Selection { elites: 1, ..selection(Parents::All) };
    let mut joint = vec![0; 16];
    let mut plan = vec![0; 21];
    for generation in 0..8000 {
        let champion = |plan: &[u32]| tied.iter().position(|&policy| plan[20] == policy as u32 | UNCHANGED);
        let [first, second] = [0, 1].map(|population| {
            evolve::keep_parents(key, generation, population, selection, &scores, &mut plan);
            let kept = champion(&plan).expect("the champion is one of the best");
            evolve::draw_parents(Level::new(), key, generation, population, selection, &scores, &mut plan);
            assert_eq!(champion(&plan), Some(kept));
            assert_eq!(plan[0], plan[20], "the champion is the elite");
            let ranking = evolve::ranking(key, generation, population, selection, &scores);
            assert_eq!(ranking[0], tied[kept]);
            let mut others = tied.to_vec();
            others.remove(kept);
            assert_eq!(ranking[1..4], others);
            kept
        });
        joint[4 * first + second] += 1;
    }
    assert_distribution("champions of two populations", &joint, |_| 1.0 / 16.0);
    scores[0] = 0.75;
    for population in 0..50 {
        evolve::keep_parents(key, 7, population, selection, &scores, &mut plan);
        assert_eq!(plan[20], UNCHANGED, "the elite stays champion");
    }
}

#[test]
fn start_jitter_is_uniform_and_differs_between_episodes() {
    let world = World::new(&config(GENERALLY_FORWARD, |_| ()).validate().unwrap());
    let key = Key::new(1, 2, Purpose::Starts);
    let mut starts = Vec::new();
    evolve::jitter_starts(key, 3, 4, &world, 0.0, &mut starts);
    assert_eq!(starts, world.starts, "without jitter, starts are those of the config");

    let (jitter, mut counts, mut seen) = (1.5, vec![0; 30], HashSet::new());
    for generation in 0..100 {
        for episode in 0..10 {
            evolve::jitter_starts(key, generation, episode, &world, jitter, &mut starts);
            for (start, from) in starts.iter().zip(&world.starts) {
                for offset in (*start - *from).to_array() {
                    let share = (f64::from(offset) / jitter + 1.0) / 2.0;
                    counts[((share * 30.0) as usize).min(29)] += 1;
                }
            }
            seen.insert(starts.iter().flat_map(|start| start.to_array().map(f32::to_bits)).collect::<Vec<_>>());
        }
    }
    assert_distribution("offsets", &counts, |_| 1.0 / 30.0);
    assert_eq!(seen.len(), 1000, "no two episodes start alike");
}

/// Every generation, episode and purpose has headings of its own. Teams start with them when they are played and stepped.
#[test]
fn drawn_headings_are_uniform_and_teams_start_with_them() {
    let text = "
[[agents]]
name = \"a\"
at = [[1, 2]]
heading = 0
senses = [{ of = \"pois\" }]
[[agents]]
name = \"b\"
at = [[10, 20], [11, 20], [12, 20], [13, 20]]
heading = \"random\"
control = \"still\"
[[pois]]
name = \"p\"
at = [[3, 4], [5, 6]]
coupling = 1
";
    let config = Config::parse(text, "headings").unwrap();
    assert_eq!(Config::parse(&config.to_toml(), "again").unwrap(), config, "the written config is another");
    let world = World::new(&config.validate().unwrap());
    let (mut counts, mut seen, mut places) = (vec![0; 16], HashSet::new(), Vec::new());
    let mut add = |places: &[Vec2]| {
        let [positions @ .., _, b, c, d, e] = places else { panic!("{places:?}") };
        assert_eq!(positions, [&world.starts[..], &world.pois].concat());
        assert_eq!(places[7], Vec2::X, "a heading that is given");
        for heading in [b, c, d, e] {
            assert!((heading.length() - 1.0).abs() < 1e-6, "{heading}");
            counts[((f64::from(heading.to_angle()) / TAU + 1.0) * 16.0) as usize % 16] += 1;
        }
        assert!(seen.insert(places[8..].iter().map(|at| at.to_array().map(f32::to_bits)).collect::<Vec<_>>()));
    };
    for (generation, episode) in (0..100).flat_map(|generation| (0..5).map(move |episode| (generation, episode))) {
        for purposes in [TRAINING_EPISODES, TEST_EPISODES] {
            evolve::episode_positions(&config.learning, 0, generation, (purposes, episode), &world, &mut places);
            add(&places);
        }
    }
    let held_out = Starts::Drawn { episodes: 100, seed: 0, jitter: 0.0, poi_jitter: 0.0 };
    (0..100).for_each(|episode| add(&held_out.of(episode, &world)));
    assert_distribution("headings", &counts, |_| 1.0 / 16.0);

    let weights = vec![0.0; world.parameters()];
    let group = Group { starts: &places, ..Group::new(&world, &weights[..], 1, &[0]) };
    let trace = Cpu::default().trace(&group).unwrap();
    let headings = |agent| Vec2::from(trace.moment(0, 0, agent).heading);
    assert_eq!((0..5).map(headings).collect::<Vec<_>>(), places[7..]);
    let mut stepper = Stepper::new(world.clone(), 1, Recording::None).unwrap();
    let numbers: Vec<f32> = places.iter().flat_map(|at| at.to_array()).collect();
    stepper.reset_to(&numbers).unwrap();
    assert_eq!(stepper.states().headings, &numbers[14..]);
    let long = [&numbers[..23], &[7.0]].concat();
    assert_eq!(
        stepper.reset_to(&long).unwrap_err().to_string(),
        format!("agent 4 of team 0 would have the heading ({}, 7), which is no unit vector", numbers[22])
    );
}

/// Every generation, episode and purpose has starts and POIs of its own, which jitter moves further.
#[test]
fn starts_and_pois_are_drawn_from_their_regions() {
    let text = "
[[agents]]
name = \"a\"
at = [[1, 2]]
senses = [{ of = \"pois\" }]
[[agents]]
name = \"b\"
count = 2
in = { box = [10, 20, 14, 22] }
control = \"still\"
[[pois]]
name = \"p\"
at = [[3, 4]]
coupling = 1
[[pois]]
name = \"q\"
count = 3
in = { disc = [40, 30, 5] }
coupling = 1
";
    let config = Config::parse(text, "regions").unwrap();
    let world = World::new(&config.validate().unwrap());
    let draw = |learning: &Learning, trial, generation, episode| {
        let mut places = Vec::new();
        evolve::episode_positions(learning, trial, generation, episode, &world, &mut places);
        places
    };
    let is_within = |places: &[Vec2], more: f32| {
        let [fixed, b, c, poi, pois @ ..] = places else { panic!("{places:?}") };
        let in_box = |at: &Vec2| (at - Vec2::new(12.0, 21.0)).abs().cmple(Vec2::new(2.0 + more, 1.0 + more)).all();
        (*fixed - Vec2::new(1.0, 2.0)).abs().max_element() <= more
            && (*poi - Vec2::new(3.0, 4.0)).abs().max_element() <= more
            && [b, c].into_iter().all(in_box)
            && pois.iter().all(|at| at.distance(Vec2::new(40.0, 30.0)) <= 5.0 + 2.0 * more + 1e-3)
    };
    let mut seen = HashSet::new();
    let mut add = |places: Vec<Vec2>| {
        assert!(is_within(&places, 0.0) && places.len() == 7, "{places:?}");
        let drawn = places[1..3].iter().chain(&places[4..]);
        drawn.for_each(|place| assert!(seen.insert(place.to_array().map(f32::to_bits)), "{place} again"));
    };
    for (generation, episode) in (0..20).flat_map(|generation| (0..5).map(move |episode| (generation, episode))) {
        for trial in 0..2 {
            add(draw(&config.learning, trial, generation, (TRAINING_EPISODES, episode)));
            add(draw(&config.learning, trial, generation, (TEST_EPISODES, episode)));
        }
    }
    let held_out = Starts::Drawn { episodes: 100, seed: 0, jitter: 0.0, poi_jitter: 0.0 };
    (0..100).for_each(|episode| add(held_out.of(episode, &world)));
    // The world's own places are an example, and an episode from them has no moved POIs.
    assert!(is_within(&[&world.starts[..], &world.pois].concat(), 0.0));
    assert_eq!(Starts::Own.of(0, &world), world.starts);
    let moved = Learning { start_jitter: 0.5, poi_jitter: 0.5, ..config.learning.clone() };
    let (still, moved) = [&config.learning, &moved].map(|learning| draw(learning, 0, 3, (TRAINING_EPISODES, 1))).into();
    assert!(is_within(&moved, 0.5) && still.iter().zip(&moved).all(|(still, moved)| still != moved));
}

#[test]
fn a_tournament_draws_every_pair_of_policies_with_the_same_probability() {
    let population = 20;
    let rising: Vec<f32> = (0..population).map(|index| index as f32).collect();
    let tied = vec![0.5; population];
    let mut first_is_higher = 0;
    let mut counts = vec![0; population * population];
    let tournaments = Key::new(9, 0, Purpose::Tournament);
    for generation in 0..400 {
        for slot in 0..100 {
            let key = tournaments.at(generation, 1, slot);
            // The same draw three times. With rising scores the higher index wins, and with falling ones the lower.
            let falling: Vec<f32> = rising.iter().map(|score| -score).collect();
            let (high, low) = (evolve::tournament(key, &rising), evolve::tournament(key, &falling));
            assert!(low < high, "expected two distinct policies, and the higher score to win: {low}, {high}");
            counts[low * population + high] += 1;
            let first = evolve::tournament(key, &tied);
            assert!(first == low || first == high, "a tie between {low} and {high} goes to {first}");
            first_is_higher += u32::from(first == high);
        }
    }
    counts.retain(|&count| count > 0);
    assert_eq!(counts.len(), 190, "number of pairs");
    assert_distribution("pairs", &counts, |_| 1.0 / 190.0);
    assert_distribution("ties", &[first_is_higher, 40_000 - first_is_higher], |_| 0.5);
    let mut duels = (0..100).map(|slot| evolve::tournament(tournaments.at(0, 0, slot), &[0.0, 1.0]));
    assert!(duels.all(|winner| winner == 1), "with two policies, both are drawn");
}

#[test]
fn a_policy_has_different_partners_in_every_round() {
    let learning =
        Learning { partners: 3, population: 20, elites: Elites::Count(2), ..config(CHAOTIC, |_| ()).learning };
    let (single, own) = (Learning { partners: 1, ..learning.clone() }, own_populations(4));
    let (all_rounds, first_round) =
        (evolve::contemporary_teams(&learning, 1, 5, own), evolve::contemporary_teams(&single, 1, 5, own));
    assert_eq!((all_rounds.len(), learning.team_count()), (3 * 20 * 4, 60));
    assert_eq!(all_rounds[..20 * 4], first_round, "the first round equals that with a single partner");
    let mut teams: Vec<&[u32]> = all_rounds.chunks(4).collect();
    teams.sort_unstable();
    teams.dedup();
    assert_eq!(teams.len(), 60, "no team plays twice");
    // Leaders that share a population play the same policy, that of the population's own schedule.
    let of_two = evolve::contemporary_teams(&learning, 1, 5, own_populations(2));
    let grouped = evolve::contemporary_teams(&learning, 1, 5, &[1, 0, 1]);
    let expected = of_two.chunks(2).flat_map(|team| [team[1], team[0], team[1]]);
    assert!(grouped.into_iter().eq(expected));
}

#[test]
fn past_champions_are_drawn_uniformly_from_the_hall_of_fame() {
    let learning = config(CHAOTIC, |config| config.learning.hall_of_fame = 4).learning;
    let (first, mut counts) = (learning.population + 1, [0; 4]);
    assert_eq!(learning.slots(), first + 4);
    for generation in 0..2000 {
        let slot = evolve::past_champions(&learning, 1, generation);
        match generation {
            0 => assert_eq!(slot, None, "there are no past champions"),
            _ => assert!((first..first + generation.min(4)).contains(&slot.unwrap()), "{generation}: {slot:?}"),
        }
        // The age of the drawn champions, in generations.
        if let Some(slot) = slot.filter(|_| generation >= 4) {
            counts[(generation - 1 - (slot - first)) % 4] += 1;
        }
    }
    assert_distribution("ages of past champions", &counts, |_| 0.25);
}

/// The first policy is drawn with probability ∝ exp(fitness / temperature), the second in the same way from the others.
#[test]
fn softmax_draws_fitter_policies_earlier_and_sorting_always() {
    let mut learning = config(GENERALLY_FORWARD, |config| config.learning.population = 4).learning;
    (learning.teams, learning.temperature) = (Teams::Softmax, 0.5);
    let fitness = [0.0, 1.0, 0.25, -0.5];
    let (mut order, mut counts) = ([0; 4], vec![0; 12]);
    let mut draw = |learning: &Learning, generation: usize, fitness: &[f64; 4]| {
        evolve::order_policies(Level::new(), learning, 0, generation, [0, 1], |slot| fitness[slot], &mut order);
        order.map(|policy| policy as usize)
    };
    for generation in 0..8000 {
        let [first, second, ..] = draw(&learning, generation, &fitness);
        counts[3 * first + second - usize::from(second > first)] += 1;
    }
    let weights = fitness.map(|fitness: f64| (fitness / 0.5).exp());
    let total: f64 = weights.iter().sum();
    let probability = |pair: usize| {
        let (first, rest) = (pair / 3, pair % 3);
        let second = rest + usize::from(rest >= first);
        weights[first] / total * weights[second] / (total - weights[first])
    };
    assert_distribution("the first two policies", &counts, probability);
    learning.teams = Teams::Sorted;
    let mut tied = vec![0; 2];
    for generation in 0..2000 {
        assert_eq!(draw(&learning, generation, &fitness), [1, 2, 0, 3]);
        let [first, second, rest @ ..] = draw(&learning, generation, &[0.0, 0.5, -0.0, 0.5]);
        assert!([first, second].contains(&1) && [first, second].contains(&3) && rest.iter().all(|slot| slot % 2 == 0));
        tied[rest[0] / 2] += 1;
    }
    assert_distribution("ties", &tied, |_| 0.5);
}

/// A policy that survives twice, as an elite and with its team, is in two slots. Further policies survive once.
#[test]
fn teams_survive_after_the_elites_and_further_policies_by_their_g() {
    let mut learning = config(GENERALLY_FORWARD, |config| config.learning.population = 8).learning;
    (learning.elites, learning.team_elites, learning.team_g_elites) = (1.into(), 2, 2);
    let selection = Selection::of(&learning);
    // Policy 3 is of the best team, policy 5 of the second, and so on. Policy 6 is the elite.
    let ranks = [-7.0, -4.0, -5.0, 0.0, -6.0, -1.0, -2.0, -3.0];
    let kept = |elite: u32| {
        let mut parents = vec![0; 9];
        parents[0] = elite | UNCHANGED;
        evolve::keep_teams(selection, &ranks, &mut parents);
        parents.into_iter().map(|parent| parent & !UNCHANGED).collect::<Vec<_>>()
    };
    assert_eq!(kept(6), [6, 3, 5, 7, 1, 0, 0, 0, 0]);
    assert_eq!(kept(3), [3, 3, 5, 6, 7, 0, 0, 0, 0]);
    for generation in 0..200 {
        let own = own_populations(3);
        let teams = evolve::contemporary_teams(&learning, 0, generation, own);
        for population in 0..3 {
            let mut policies: Vec<u32> = teams.iter().skip(population).step_by(3).copied().collect();
            assert!(generation == 0 || policies[..2] == [1, 2], "{policies:?}");
            policies.sort_unstable();
            assert_eq!(policies, (0..8).collect::<Vec<_>>(), "every policy plays once");
        }
    }
}

#[test]
fn the_champion_replaces_the_oldest_of_the_hall_of_fame() {
    let scores = [0.1, 0.3, 0.2];
    for generation in 0..7 {
        let (mut plan, mut last_plan) = ([0; 6], [0; 6]);
        let (key, selection) =
            (Key::new(3, 0, Purpose::Tournament), Selection { elites: 1, ..selection(Parents::All) });
        evolve::draw_parents(Level::new(), key, generation, 0, selection, &scores, &mut plan);
        let mut expected = [1, 4, 5].map(|slot| slot | UNCHANGED);
        if generation % 2 == 0 {
            expected[1] = 1 | UNCHANGED
        } else {
            expected[2] = 1 | UNCHANGED
        }
        assert_eq!(plan[3..], expected, "generation {generation}");
        evolve::keep_parents(key, generation, 0, selection, &scores, &mut last_plan);
        assert_eq!(
            last_plan[4..],
            [4, 5].map(|slot| slot | UNCHANGED),
            "the hall of fame is kept after the last generation"
        );
    }
}

#[test]
fn truncation_draws_every_elite_as_parent_with_the_same_probability() {
    let (policies, elites) = (200, 20);
    // Policy 7i mod 200 has rank i.
    let mut scores = vec![0.0; policies];
    (0..policies).for_each(|rank| scores[7 * rank % policies] = -(rank as f32));
    let mut counts = vec![0; elites];
    let mut plan = vec![0; policies + 1];
    for generation in 0..60 {
        let selection = Selection { elites, ..selection(Parents::Elites) };
        let key = Key::new(3, 0, Purpose::Tournament);
        evolve::draw_parents(Level::new(), key, generation, 1, selection, &scores, &mut plan);
        for (rank, &parent) in plan[..elites].iter().enumerate() {
            assert_eq!(parent, (7 * rank % policies) as u32 | UNCHANGED);
        }
        for &parent in &plan[elites..policies] {
            let rank = (0..elites).find(|rank| 7 * rank % policies == parent as usize);
            counts[rank.expect("every parent is an elite")] += 1;
        }
        assert_eq!(plan[policies], UNCHANGED, "the champion is the best policy, which is policy 0");
    }
    assert_distribution("elites as parents", &counts, |_| 1.0 / elites as f64);
}

#[test]
fn a_percentage_of_elites_is_rounded_to_the_nearest_number_and_at_least_one() {
    for (percentage, population, count) in
        [(10.0, 50, 5), (10.0, 5000, 500), (1.0, 50, 1), (1.0, 149, 1), (1.0, 150, 2), (0.001, 50, 1), (100.0, 7, 7)]
    {
        assert_eq!(Elites::Percentage(percentage).count(population), count, "{percentage}% of {population}");
    }
    assert_eq!(Elites::Count(9).count(7), 7, "there are no more elites than policies");
}

/// Compares the mean, standard deviation and distribution of numbers with N(0, 1).
#[track_caller]
fn assert_normal(what: &str, numbers: &[f64]) {
    let count = numbers.len() as f64;
    let mean = numbers.iter().sum::<f64>() / count;
    let deviation = (numbers.iter().map(|number| (number - mean).powi(2)).sum::<f64>() / count).sqrt();
    assert_near(what, mean, 0.0, 1.0 / count.sqrt());
    assert_near(what, deviation, 1.0, 1.0 / (2.0 * count).sqrt());
    // Φ at 0, 0.5, … 3, from tables, and 1 as the end of the last bin.
    let below = [0.5, 0.691462461, 0.841344746, 0.933192799, 0.977249868, 0.993790335, 0.998650102, 1.0];
    let cumulative = |bin: usize| if bin < 7 { 1.0 - below[7 - bin] } else { below[bin - 7] };
    let mut counts = vec![0; 14];
    numbers.iter().for_each(|number| counts[((number * 2.0).floor() + 7.0).clamp(0.0, 13.0) as usize] += 1);
    assert_distribution(what, &counts, |bin| cumulative(bin + 1) - cumulative(bin));
}

#[test]
fn weights_of_new_policies_are_normally_distributed() {
    let mut weights = vec![0.0; 200_000];
    evolve::random_policy(Level::new(), Key::new(0, 0, Purpose::Weights).at(0, 0, 0), &mut weights);
    assert_normal("new weights", &weights.iter().map(|&weight| f64::from(weight)).collect::<Vec<_>>());
}

#[test]
fn mutation_adds_normal_noise_to_the_configured_share_of_weights() {
    let old: Vec<f32> = (0..200_000).map(|index| [-2.0, 0.5, 1.25][index % 3] + (index % 97) as f32 * 1e-3).collect();
    let key = Key::new(3, 1, Purpose::Mutation).at(17, 2, 5);
    for (mutation, sigma) in [(Mutation::Scaled, 0.1), (Mutation::Additive, 0.1), (Mutation::Additive, 2.5)] {
        for probability in [0.0, 0.15, 1.0] {
            let what = format!("{mutation}, probability {probability}, sigma {sigma}");
            let mut new = old.clone();
            mutate(Level::new(), key, &learning(mutation, probability, sigma), &mut new);
            let noise = |(old, new): (&f32, &f32)| {
                let gain = f64::from(*new) - f64::from(*old);
                (old != new).then(|| gain / sigma / if mutation == Mutation::Scaled { f64::from(*old) } else { 1.0 })
            };
            let noise: Vec<f64> = old.iter().zip(&new).filter_map(noise).collect();
            let count = old.len() as f64;
            // Noise that is too small for f32 leaves a weight unchanged, which lowers the count.
            let deviation = (count * probability * (1.0 - probability)).sqrt() + 2.0 * probability;
            assert_near(&what, noise.len() as f64, count * probability, deviation);
            if probability == 0.0 {
                assert_eq!(bits(&new), bits(&old), "{what}");
            } else {
                assert_normal(&what, &noise);
            }
        }
    }
    let mut new = old.clone();
    mutate(Level::new(), key, &learning(Mutation::Additive, 1.0, 0.0), &mut new);
    assert_eq!(bits(&new), bits(&old), "with sigma 0");
}

/// Compares every weight with the Box-Muller transform in f64 of the draws for its index.
#[test]
fn weights_equal_the_box_muller_transform_of_their_draws() {
    let (weights, mutations) = (Key::new(8, 0, Purpose::Weights).at(0, 1, 2), Key::new(8, 0, Purpose::Mutation));
    let deviate = |a: u32, b: u32| {
        let unit = (f64::from(a >> 8) + 1.0) / (1u32 << 24) as f64;
        let angle = (f64::from(b >> 8) / (1u32 << 23) as f64 - 1.0) * std::f64::consts::PI;
        (-2.0 * unit.ln()).sqrt() * angle.cos()
    };
    let mut first = vec![0.0; 5000];
    evolve::random_policy(Level::new(), weights, &mut first);
    for (index, &weight) in first.iter().enumerate() {
        let [a, b, ..] = weights.draw(index as u32);
        assert!((f64::from(weight) - deviate(a, b)).abs() < 1e-5, "weight {index}: {weight}");
    }
    for mutation in [Mutation::Scaled, Mutation::Additive] {
        let key = mutations.at(4, 5, 6);
        let mut second = first.clone();
        mutate(Level::new(), key, &learning(mutation, 0.15, 0.1), &mut second);
        for (index, (&old, &new)) in first.iter().zip(&second).enumerate() {
            // One draw decides for four weights, 16 apart.
            let chance = key.draw((index / 64 * 16 + index % 16) as u32)[index / 16 % 4];
            let [a, b, ..] = key.fork().draw(index as u32);
            let scale = if mutation == Mutation::Scaled { f64::from(old) } else { 1.0 };
            let noise = if uniform(chance) < 0.15 { 0.1 * deviate(a, b) * scale } else { 0.0 };
            assert!((f64::from(new) - f64::from(old) - noise).abs() < 1e-5, "{mutation}, weight {index}: {old}, {new}");
        }
    }
}

/// Tests that weights stay in the range that the kernels support, after many and strong mutations.
#[test]
fn weights_stay_in_bounds() {
    let starts = [MAX_WEIGHT, -MAX_WEIGHT, MIN_WEIGHT, -MIN_WEIGHT, 0.0, 1e-4, 1.0, -1e5];
    let (mut smallest, mut largest, mut zeros) = (f32::MAX, 0f32, 0);
    for mutation in [Mutation::Scaled, Mutation::Additive] {
        for sigma in [1e-6, 0.9, 100.0] {
            let mut weights: Vec<f32> = starts.into_iter().cycle().take(4000).collect();
            for generation in 0..60 {
                let key = Key::new(2, 0, Purpose::Mutation).at(generation, 0, 0);
                mutate(Level::new(), key, &learning(mutation, 0.5, sigma), &mut weights);
                for &weight in &weights {
                    assert!(weight == 0.0 || (MIN_WEIGHT..=MAX_WEIGHT).contains(&weight.abs()), "{mutation}, {sigma}");
                    zeros += usize::from(weight == 0.0);
                    largest = largest.max(weight.abs());
                    smallest = if weight == 0.0 { smallest } else { smallest.min(weight.abs()) };
                }
            }
            if mutation == Mutation::Scaled {
                assert!(
                    weights.iter().skip(4).step_by(starts.len()).all(|&weight| weight == 0.0),
                    "0 times noise is 0"
                );
            }
        }
    }
    assert!(
        largest == MAX_WEIGHT && smallest < 2.0 * MIN_WEIGHT && zeros > 0,
        "{largest}, {smallest}: bounds not reached"
    );
}

/// Coordinates of a random draw: seed, trial, purpose, generation, population, slot, counter.
type Coordinates = [u64; 7];

fn draw(coordinates: Coordinates) -> [u32; 4] {
    let [seed, trial, purpose, generation, population, slot, counter] = coordinates;
    let key = Key::new(seed, trial as usize, PURPOSES[purpose as usize]);
    key.at(generation as usize, population as usize, slot as usize).draw(counter as u32)
}

#[test]
fn no_two_coordinates_share_a_draw() {
    let mut seen = HashSet::new();
    let mut points: Vec<Coordinates> = vec![[0; 7]];
    // Per coordinate, small values and one that differs only in its high bits.
    let values: [&[u64]; 7] = [
        &[0, 1, 1 << 32, 1 << 62],
        &[0, 1, 4095],
        &[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11],
        &[0, 1, 1 << 19],
        &[0, 1, 1023],
        &[0, 1, 2, (1 << 20) - 1],
        &[0, 1, 2, 1 << 12],
    ];
    for (axis, values) in values.into_iter().enumerate() {
        let with_each_value = |point: &Coordinates| {
            let mut point = *point;
            values.iter().map(move |&value| {
                point[axis] = value;
                point
            })
        };
        points = points.iter().flat_map(with_each_value).collect();
    }
    let draws: usize = points.iter().map(|&point| usize::from(seen.insert(draw(point)))).sum();
    assert_eq!(points.len(), 4 * 3 * PURPOSES.len() * 3 * 3 * 4 * 4);
    assert_eq!(draws, points.len());
}

/// Tests that draws at neighbouring coordinates are uncorrelated, both as bits and as numbers.
#[test]
fn neighbouring_draws_are_uncorrelated() {
    let pairs = 8192;
    // Steps along each coordinate but the purpose, and along the high half of the seed. Purposes are paired below.
    let steps: [Coordinates; 7] = [
        [1, 0, 0, 0, 0, 0, 0],
        [1 << 32, 0, 0, 0, 0, 0, 0],
        [0, 1, 0, 0, 0, 0, 0],
        [0, 0, 0, 1, 0, 0, 0],
        [0, 0, 0, 0, 1, 0, 0],
        [0, 0, 0, 0, 0, 1, 0],
        [0, 0, 0, 0, 0, 0, 1],
    ];
    let along =
        |step: Coordinates, from: Coordinates, index: u64| std::array::from_fn(|axis| from[axis] + step[axis] * index);
    let mut rows: Vec<(String, Vec<[[u32; 4]; 2]>)> = Vec::new();
    for purpose in 0..PURPOSES.len() as u64 {
        for step in steps {
            let from = [11, 2, purpose, 5, 1, 7, 3];
            let pair = |index| [draw(along(step, from, index)), draw(along(step, from, index + 1))];
            rows.push((format!("purpose {purpose}, step {step:?}"), (0..pairs).map(pair).collect()));
        }
        let other = (purpose + 1) % PURPOSES.len() as u64;
        let pair = |index| [purpose, other].map(|purpose| draw([11, 2, purpose, 5, 1, 7, index]));
        rows.push((format!("purposes {purpose} and {other}"), (0..pairs).map(pair).collect()));
    }
    let count = pairs as f64;
    for (what, pairs) in rows {
        let differ = |[a, b]: &[[u32; 4]; 2]| a.iter().zip(b).map(|(a, b)| (a ^ b).count_ones()).sum::<u32>();
        let differing = f64::from(pairs.iter().map(differ).sum::<u32>()) / count;
        assert_near(&format!("{what}: differing bits"), differing, 64.0, (32.0 / count).sqrt());
        for (a, b) in (0..16).map(|index| (index / 4, index % 4)) {
            let product = |[x, y]: &[[u32; 4]; 2]| (uniform(x[a]) - 0.5) * (uniform(y[b]) - 0.5) * 12.0;
            let correlation = pairs.iter().map(product).sum::<f64>() / count;
            assert_near(&format!("{what}: words {a} and {b}"), correlation, 0.0, 1.0 / count.sqrt());
        }
        for word in 0..4 {
            let mut counts = vec![0; 64];
            pairs.iter().for_each(|[x, _]| counts[(x[word] >> 26) as usize] += 1);
            assert_distribution(&format!("{what}: high bits of word {word}"), &counts, |_| 1.0 / 64.0);
            counts.fill(0);
            pairs.iter().for_each(|[x, _]| counts[(x[word] & 63) as usize] += 1);
            assert_distribution(&format!("{what}: low bits of word {word}"), &counts, |_| 1.0 / 64.0);
        }
    }
}

/// Tests that every instruction set gives the same policies. A weight depends on its index, not on the number of
/// weights.
#[test]
fn policies_are_equal_on_all_instruction_sets() {
    let key = |purpose| Key::new(77, 1, purpose).at(3, 4, 5);
    let evolved = |level, parameters: usize| {
        let mut weights = vec![0.0; parameters];
        evolve::random_policy(level, key(Purpose::Weights), &mut weights);
        let mut policies = vec![weights];
        for learning in [
            learning(Mutation::Scaled, 0.15, 0.1),
            learning(Mutation::Additive, 0.5, 100.0),
            learning(Mutation::Scaled, 1.0, 100.0),
        ] {
            let mut child = policies.last().unwrap().clone();
            mutate(level, key(Purpose::Mutation), &learning, &mut child);
            policies.push(child);
        }
        policies
    };
    let expected = evolved(Level::baseline(), 9_000);
    assert_ne!(expected[0], expected[1]);
    for level in Cpu::levels() {
        for parameters in (1..70).chain([112, 8_999, 9_000]) {
            for (actual, expected) in evolved(level, parameters).iter().zip(&expected) {
                assert_eq!(bits(actual), bits(&expected[..parameters]), "{}, {parameters}", level_name(level));
            }
        }
    }
}

/// Returns the experiments of `data/experiments.txt`.
fn experiments() -> Vec<Config> {
    let experiment = |line: &str| {
        let [layout, sizes, changes] = line.split(" | ").collect::<Vec<_>>()[..] else { panic!("{line}") };
        let keys = ["population", "generations", "trials"];
        let sizes = keys.iter().zip(sizes.split(' ')).map(|(key, size)| format!("learning.{key} = {size}; "));
        cases::config(layout, &[&(sizes.collect::<String>() + changes)])
    };
    include_str!("data/experiments.txt").lines().filter(|line| !line.starts_with('#')).map(experiment).collect()
}

/// Trains all experiments together. Returns the rows and policies of each.
fn train(configs: &[Config]) -> Vec<(Vec<Row>, Vec<Vec<f32>>)> {
    let (mut trainer, mut backend) = (Trainer::new(ValidConfig::all(configs).unwrap()), Cpu::default());
    let mut rows = vec![Vec::new(); configs.len()];
    for row in trainer.finish(&mut backend).unwrap() {
        rows[row.experiment].push(row);
    }
    rows.into_iter().enumerate().map(|(experiment, rows)| (rows, trainer.policies(experiment))).collect()
}

#[test]
fn experiments_trained_together_equal_experiments_trained_alone() {
    let configs = experiments();
    for (experiment, (rows, policies)) in train(&configs).into_iter().enumerate() {
        let (mut rows_alone, policies_alone) = train(&configs[experiment..=experiment]).remove(0);
        rows_alone.iter_mut().for_each(|row| row.experiment = experiment);
        assert_eq!(rows, rows_alone, "experiment {experiment}");
        assert_eq!(policies, policies_alone, "experiment {experiment}");
        let config = &configs[experiment].learning;
        let expected = (0..=config.generations).flat_map(|g| (0..config.trials).map(move |trial| (g, trial)));
        assert!(
            rows.iter().map(|row| (row.generation, row.trial)).eq(expected),
            "experiment {experiment}: expected one row per generation and trial"
        );
    }
}

/// Returns random worlds that learn in random ways.
fn random_experiments(count: u64) -> Vec<Config> {
    let random = |seed| {
        let mut config = sample::any_world(seed);
        sample::learn_otherwise(seed, &mut config);
        config
    };
    (0..count).map(random).collect()
}

#[test]
fn random_experiments_cover_every_way_to_learn() {
    let ways: HashSet<String> = random_experiments(100)
        .into_iter()
        .flat_map(|Config { learning, .. }| {
            let Learning { method, teams, parents, leniency, .. } = learning;
            let words = [method.to_string(), teams.to_string(), parents.to_string(), leniency.to_string()];
            let more = [
                ("partners", learning.partners > 1),
                ("hall of fame", learning.hall_of_fame > 0),
                ("team elites", learning.team_elites > 0),
                ("elites by G", learning.team_g_elites > 0),
                ("start jitter", learning.start_jitter > 0.0),
            ];
            words.into_iter().chain(more.map(|(name, is_so)| format!("{name}: {is_so}")))
        })
        .collect();
    assert_eq!(ways.len(), Method::ALL.len() + Teams::ALL.len() + Parents::ALL.len() + Leniency::ALL.len() + 2 * 5);
}

/// A snapshot that was taken after the last champions played continues with more generations, too.
#[test]
fn a_snapshot_of_a_finished_experiment_extends_it() {
    for (experiment, config) in experiments().into_iter().chain(random_experiments(100)).enumerate() {
        let trials = config.learning.trials;
        let mut longer = config.clone();
        longer.learning.generations += 2;
        let new = |config: &Config| Trainer::new([config.validate().unwrap()]);
        let (mut trainer, mut extended, mut whole) = (new(&config), new(&longer), new(&longer));
        trainer.finish(&mut Cpu::default()).unwrap();
        assert!(extended.restore(0, trainer.snapshot(0).unwrap()));
        let rows = extended.finish(&mut Cpu::default()).unwrap();
        let expected = whole.finish(&mut Cpu::default()).unwrap();
        assert_eq!(rows, expected[trials * config.learning.generations..], "experiment {experiment}");
        assert_eq!(extended.policies(0), whole.policies(0), "experiment {experiment}");
    }
}

/// A plain implementation of Algorithm 1 for one trial. It plays every team separately, with its own copy of the
/// weights.
struct PlainTrial<'a> {
    config: &'a Config,
    world: World,
    trial: usize,
    /// The population of each leader.
    populations: Vec<usize>,
    /// `[populations][policies][parameters]`.
    policies: Vec<Vec<Vec<f32>>>,
}

impl PlainTrial<'_> {
    fn key(&self, purpose: Purpose) -> Key {
        Key::new(self.config.learning.seed, self.trial, purpose)
    }

    /// Plays a team in a stage, with the random numbers of a generation. Returns the share of POIs observed over all
    /// episodes, and each leader's mean score.
    fn play(&self, generation: usize, stage: &Config, team: &[usize]) -> (f64, Vec<f32>) {
        self.play_episodes(generation, stage, team, [Purpose::Starts, Purpose::Pois], stage.learning.episodes_per_team)
    }

    /// Plays a number of episodes with random numbers of these purposes.
    fn play_episodes(
        &self,
        generation: usize,
        stage: &Config,
        team: &[usize],
        purposes: [Purpose; 2],
        episodes: usize,
    ) -> (f64, Vec<f32>) {
        let Learning { fitness, start_jitter, poi_jitter, .. } = stage.learning;
        let world = World::new(&stage.validate().unwrap());
        let population = |leader: usize| &self.policies[self.populations[leader]];
        let weights: Vec<f32> =
            team.iter().enumerate().flat_map(|(leader, &policy)| population(leader)[policy].clone()).collect();
        let (mut observed, mut totals) = (0, vec![0.0; team.len()]);
        for episode in 0..episodes {
            let mut starts = Vec::new();
            let [of_starts, of_pois] = purposes.map(|purpose| self.key(purpose));
            evolve::jitter_starts(of_starts, generation, episode, &world, start_jitter, &mut starts);
            evolve::jitter_pois(of_pois, generation, episode, &world, poi_jitter, &mut starts);
            let teams = vec![0; team.len()];
            let group = Group {
                starts: &starts,
                populations: own_populations(world.leaders()),
                fitnesses: &[Fitness::Dt],
                ..Group::new(&world, &weights[..], 1, &teams)
            };
            // Scores come from the full trace, which is independent of the scores that `play` of a backend returns.
            let trace = Cpu::default().trace(&group).unwrap();
            let scores = Credit::default().all(&trace.episode(&world, 0), &world);
            let by_leader = match fitness {
                Fitness::G => vec![scores.g; team.len()],
                Fitness::D => scores.d,
                Fitness::Df => scores.df,
                Fitness::Dpp => scores.dpp,
                Fitness::Dt => scores.dt,
            };
            observed += scores.observed;
            totals.iter_mut().zip(by_leader).for_each(|(total, score)| *total += f64::from(score));
        }
        (
            f64::from(observed) / (world.pois.len() * episodes) as f64,
            totals.iter().map(|total| (total / episodes as f64) as f32).collect(),
        )
    }

    /// Returns the policy of each population in each team, `[teams][populations]`. `past` is the fitness of each slot's
    /// policy in the generation before, or of its parent. `kept` are the slots of teams that play again.
    fn form_teams(&self, generation: usize, stage: &Config, past: &[Vec<f64>], kept: Range<usize>) -> Vec<u32> {
        let Learning { teams, temperature, population, .. } = stage.learning;
        let count = past.len();
        if teams == Teams::Random {
            let own: Vec<u32> = (0..count as u32).collect();
            return evolve::contemporary_teams(&stage.learning, self.trial, generation, &own);
        }
        let order = |of: usize| {
            let others = (0..population).filter(|slot| !kept.contains(slot)).enumerate().map(|(index, slot)| {
                let word = self.key(Purpose::Teams).at(generation, of, 0).draw(index as u32)[0];
                let uniform = (f64::from(word) + 0.5) / 2f64.powi(32);
                // Every POI of these worlds has the value 1.
                let fitness = past[of][slot] * stage.world.pois.len() as f64;
                let value = match teams {
                    Teams::Softmax => fitness / temperature - (-uniform.ln()).ln(),
                    _ => fitness,
                };
                (value, word, slot as u32)
            });
            let mut others: Vec<(f64, u32, u32)> = others.collect();
            others.sort_by(|a, b| (b.0, b.1).partial_cmp(&(a.0, a.1)).unwrap());
            kept.clone().map(|slot| slot as u32).chain(others.into_iter().map(|(_, _, slot)| slot)).collect::<Vec<_>>()
        };
        let orders: Vec<Vec<u32>> = (0..count).map(order).collect();
        (0..population).flat_map(|team| orders.iter().map(move |order| order[team])).collect()
    }

    /// Trains to the end. Returns the rows, and the policies with the best first.
    fn train(mut self) -> (Vec<Row>, Vec<f32>) {
        let Learning { population, generations, elites, team_elites, team_g_elites, parents, .. } =
            self.config.learning;
        let parameters = self.world.parameters();
        let mut search = vec![vec![0.0; 2 * parameters]; self.policies.len()];
        let elites = match elites {
            Elites::Count(count) => count,
            Elites::Percentage(percentage) => ((population as f64 * percentage / 100.0).round() as usize).max(1),
        };
        let of_each = self.populations.clone();
        let count = self.policies.len();
        // The mean score of a population's leaders.
        let mean_score = |scores: &[f32], population: usize| {
            let members = scores.iter().zip(&of_each).filter(|&(_, &of)| of == population);
            let members: Vec<f64> = members.map(|(&score, _)| f64::from(score)).collect();
            members.iter().sum::<f64>() / members.len() as f64
        };
        let mut rows = Vec::new();
        // The champions of all past generations.
        let mut past: Vec<Vec<Vec<f32>>> = Vec::new();
        let config = self.config.validate().unwrap();
        let mut inherited = vec![vec![0.0; population]; count];
        for generation in 0..=generations {
            let stage = config.at(generation);
            let Learning { partners, leniency, hall_of_fame, .. } = stage.learning;
            let kept = if generation > 0 { elites..elites + team_elites } else { 0..0 };
            let teams = self.form_teams(generation, stage, &inherited, kept);
            let chosen = &teams[..];
            let (mut observed, mut fitness) = (Vec::new(), vec![vec![0.0; population]; count]);
            let mut scored = vec![vec![Vec::new(); population]; count];
            for chosen in chosen.chunks(count) {
                let team: Vec<usize> = of_each.iter().map(|&of| chosen[of] as usize).collect();
                let (share, scores) = self.play(generation, stage, &team);
                observed.push(share);
                for (population, &policy) in chosen.iter().enumerate() {
                    scored[population][policy as usize].push(mean_score(&scores, population));
                }
            }
            let hall = hall_of_fame.min(generation);
            if hall > 0 {
                let word = self.key(Purpose::HallOfFame).at(generation, 0, 0).draw(0)[0];
                let champions = &past[generation - 1 - (uniform(word) * hall as f64) as usize];
                self.policies.iter_mut().zip(champions).for_each(|(policies, past)| policies.push(past.clone()));
                for (plays, policy) in (0..count).flat_map(|plays| (0..population).map(move |policy| (plays, policy))) {
                    let team: Vec<usize> =
                        of_each.iter().map(|&of| if of == plays { policy } else { population }).collect();
                    scored[plays][policy].push(mean_score(&self.play(generation, stage, &team).1, plays));
                }
                self.policies.iter_mut().for_each(|policies| policies.truncate(population));
            }
            let scores_per_policy = partners + usize::from(hall > 0);
            for (fitness, scores) in fitness.iter_mut().flatten().zip(scored.iter().flatten()) {
                assert_eq!(scores.len(), scores_per_policy);
                *fitness = match leniency {
                    Leniency::Mean => (scores.iter().sum::<f64>() / scores_per_policy as f64) as f32,
                    Leniency::Max => scores.iter().copied().reduce(f64::max).unwrap() as f32,
                };
            }
            let ranked: Vec<Vec<usize>> = (fitness.iter())
                .enumerate()
                .map(|(of, scores)| {
                    let mut order: Vec<usize> = (0..population).collect();
                    order.sort_by(|&a, &b| scores[b].partial_cmp(&scores[a]).unwrap());
                    // Of several best, the first policy stays the elite, or else one of them is drawn.
                    let tied: Vec<usize> =
                        (0..population).filter(|&policy| scores[policy] == scores[order[0]]).collect();
                    if elites <= 1 && tied[0] != 0 {
                        let [word, ..] = self.key(Purpose::Tournament).at(generation, of, population).draw(0);
                        let champion = order.remove((uniform(word) * tied.len() as f64) as usize);
                        order.insert(0, champion);
                    }
                    order
                })
                .collect();
            // The teams by G, kept ones first.
            let mut by_g: Vec<usize> = (0..observed.len()).collect();
            by_g.sort_by(|&a, &b| observed[b].partial_cmp(&observed[a]).unwrap());
            let team =
                |index: usize| of_each.iter().map(move |&of| chosen[index * count + of] as usize).collect::<Vec<_>>();
            let tests = stage.learning.test_episodes;
            let purposes = [Purpose::TestStarts, Purpose::TestPois];
            let test_g = (tests > 0).then(|| self.play_episodes(generation, stage, &team(by_g[0]), purposes, tests).0);
            // With an evolution strategy, the champion is the mean of its distribution. It is added to the policies for
            // one episode.
            let strategy = evolve::Strategy::of(Level::baseline(), &stage.learning, parameters);
            let mut ranked = ranked;
            for (leader, search) in search.iter_mut().enumerate() {
                if let Some(strategy) = &strategy {
                    let mut state = [self.policies[leader].concat(), search.clone()].concat();
                    strategy.update(Level::baseline(), generation, &fitness[leader], &mut state);
                    *search = state.split_off(population * parameters);
                    self.policies[leader].push(search[..parameters].to_vec());
                    ranked[leader].insert(0, population);
                }
            }
            // The champion plays together with the next generation, so it has that generation's starts.
            past.push((0..count).map(|of| self.policies[of][ranked[of][0]].clone()).collect());
            let champion: Vec<usize> = of_each.iter().map(|&of| ranked[of][0]).collect();
            let (champion, _) = self.play(generation + 1, stage, &champion);
            rows.push(Row {
                experiment: 0,
                trial: self.trial,
                generation,
                best_g: observed.iter().copied().fold(0.0, f64::max),
                mean_g: mean(&observed, stage),
                champion_g: champion,
                test_g,
            });
            for (leader, (policies, order)) in self.policies.clone().iter().zip(&ranked).enumerate() {
                let sorted = order.iter().take(population).map(|&policy| policies[policy].clone());
                self.policies[leader] = sorted.collect();
                if let Some(strategy) = &strategy {
                    if generation < generations {
                        let (mean, sigmas) = search[leader].split_at(parameters);
                        let (key, mut children) = (self.key(Purpose::Search), vec![0.0; population * parameters]);
                        let samples = evolve::Samples {
                            key,
                            generation,
                            population: leader,
                            policies: population,
                            first: 0,
                            mean,
                            sigmas,
                        };
                        strategy.sample(Level::baseline(), samples, &mut children, &mut vec![]);
                        self.policies[leader] = children.chunks(parameters).map(<[f32]>::to_vec).collect();
                    }
                    continue;
                }
                let of_team = |&team: &usize| chosen[team * count + leader] as usize;
                let by_g: Vec<usize> = by_g.iter().map(of_team).collect();
                let further = by_g.iter().skip(team_elites).filter(|policy| !order[..elites].contains(policy));
                let kept = by_g.iter().take(team_elites).chain(further.take(team_g_elites));
                let kept: Vec<usize> = order[..elites].iter().chain(kept).copied().collect();
                inherited[leader] = kept.iter().map(|&policy| f64::from(fitness[leader][policy])).collect();
                if generation < generations {
                    (self.policies[leader].iter_mut().zip(&kept))
                        .for_each(|(to, &kept)| to.clone_from(&policies[kept]));
                }
                for slot in if generation < generations { kept.len()..population } else { 0..0 } {
                    let key = self.key(Purpose::Tournament).at(generation, leader, slot);
                    let parent = match parents {
                        Parents::All => evolve::tournament(key, &fitness[leader]),
                        // The upper bits of the slot's first random word select the elite.
                        Parents::Elites => order[(uniform(key.draw(0)[0]) * elites as f64) as usize],
                    };
                    let mut child = policies[parent].clone();
                    let key = self.key(Purpose::Mutation).at(generation, leader, slot);
                    mutate(Level::baseline(), key, &stage.learning, &mut child);
                    self.policies[leader][slot] = child;
                    inherited[leader].push(f64::from(fitness[leader][parent]));
                }
            }
        }
        (rows, self.policies.concat().concat())
    }
}

/// Returns the mean of shares, computed from whole numbers of observed POIs.
fn mean(shares: &[f64], stage: &Config) -> f64 {
    let whole = (stage.world.pois.len() * stage.learning.episodes_per_team) as f64;
    let total: f64 = shares.iter().map(|share| (share * whole).round()).sum();
    total / (whole * shares.len() as f64)
}

/// Compares the fitness of shared policies by value. Comparisons of trained policies only depend on their ranks.
#[test]
fn a_shared_policy_scores_the_mean_of_its_leaders() {
    let config = config(GENERALLY_FORWARD, |config| {
        (config.learning.population, config.learning.trials) = (40, 1);
        (config.learning.sharing, config.learning.fitness) = (Sharing::Shared, Fitness::D);
        (config.world.coupling, config.world.steps) = (flotilla::config::Coupling::Same(1), 80);
        config.world.observation_radius = 8.0;
    });
    let (world, leaders) = (World::new(&config.validate().unwrap()), config.learners());
    let mut trainer = Trainer::new([config.validate().unwrap()]);
    let weights = trainer.weights(0, 0).unwrap().chunks(world.parameters()).map(<[f32]>::to_vec).collect();
    let plain = PlainTrial { config: &config, world, trial: 0, populations: vec![0; leaders], policies: vec![weights] };
    trainer.advance(&mut Cpu::default()).unwrap();
    let fitness = trainer.snapshot(0).unwrap().fitness.remove(0);
    let mut different = 0;
    for (policy, fitness) in fitness.into_iter().enumerate() {
        let (_, scores) = plain.play(0, &config, &vec![policy; leaders]);
        let sum: f64 = scores.iter().map(|&score| f64::from(score)).sum();
        assert_eq!(fitness, (sum / leaders as f64) as f32, "policy {policy}");
        different += usize::from(scores.iter().any(|&score| score != scores[0]));
    }
    assert!(different > 3, "leaders' scores differ in only {different} teams");
}

/// Tests that POIs are moved like starts, with separate random numbers. Without jitter, no places of POIs are appended.
#[test]
fn pois_are_jittered_with_separate_random_numbers() {
    let config = config(GENERALLY_FORWARD, |config| config.world.pois[0] = [0.5, 49.5]);
    let world = World::new(&config.validate().unwrap());
    let [starts, pois] = [Purpose::Starts, Purpose::Pois].map(|purpose| Key::new(4, 0, purpose));
    let draw = |key, generation, episode| {
        let mut places = vec![];
        evolve::jitter_pois(key, generation, episode, &world, 2.0, &mut places);
        places
    };
    let (mut sum, mut smallest, mut largest) = (Vec2::ZERO, f32::INFINITY, f32::NEG_INFINITY);
    for generation in 0..500 {
        for (index, (place, from)) in draw(pois, generation, 1).iter().zip(&world.pois).enumerate() {
            let moved = place - from;
            assert!(moved.abs().max_element() <= 2.0 && (place * 262_144.0).fract() == Vec2::ZERO, "{moved}");
            assert!(place.min_element() >= 0.0 && place.max_element() <= 50.0, "{place}");
            if index > 0 {
                sum += moved;
                (smallest, largest) = (smallest.min(moved.min_element()), largest.max(moved.max_element()));
            }
        }
        assert_ne!(draw(pois, generation, 0), draw(pois, generation, 1));
        assert_ne!(draw(pois, generation, 0), draw(starts, generation, 0));
    }
    // Bounds for 1500 uniform offsets with standard deviation 2/√3.
    assert!(
        sum.abs().max_element() / 1500.0 < 0.15 && smallest < -1.95 && largest > 1.95,
        "{sum}, {smallest}, {largest}"
    );
    let mut places = world.starts.clone();
    evolve::jitter_pois(pois, 0, 0, &world, 0.0, &mut places);
    assert_eq!(places, world.starts);
}

#[test]
fn the_trainer_equals_algorithm_1() {
    let configs = experiments();
    let mut improved = 0;
    for (experiment, (rows, policies)) in train(&configs).into_iter().enumerate() {
        let config = &configs[experiment];
        for (trial, policies) in policies.iter().enumerate() {
            let world = World::new(&config.validate().unwrap());
            let key = Key::new(config.learning.seed, trial, Purpose::Weights);
            let policy = |leader, slot| {
                let mut weights = vec![0.0; world.parameters()];
                evolve::initial_policy(Level::baseline(), key.at(0, leader, slot), &config.learning, &mut weights);
                weights
            };
            let population = |leader| (0..config.learning.population).map(|slot| policy(leader, slot)).collect();
            let fresh = (0..config.populations()).map(population).collect();
            let populations = config.population_of_each().into_iter().map(|of| of as usize).collect();
            let plain = PlainTrial { config, world, trial, populations, policies: fresh };
            let (expected, weights) = plain.train();
            let rows: Vec<Row> =
                rows.iter().filter(|row| row.trial == trial).map(|&row| Row { experiment: 0, ..row }).collect();
            assert_eq!(rows, expected, "experiment {experiment}, trial {trial}");
            assert_eq!(bits(policies), bits(&weights), "experiment {experiment}, trial {trial}");
            improved += usize::from(rows.last().unwrap().mean_g > rows[0].mean_g);
        }
    }
    assert!(improved > 2, "only {improved} trials improved, which hardly tests selection");
}
