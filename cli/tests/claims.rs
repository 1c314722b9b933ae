//! Tests the report on the paper's claims: its statistics, baselines and verdicts.
//!
//! Statistics are compared with results of scipy (`statistics.json`), and baselines with teams that a backend plays.

use fearless_simd::Level;
use flotilla::backend::cpu::Cpu;
use flotilla::backend::{Backend, Group};
use flotilla::baseline::{self, Baseline, Baselines};
use flotilla::config::{Fitness, Mutation, Override, Paradigm, Sharing, ValidConfig, own_populations};
use flotilla::evaluate::{self, Starts};
use flotilla::evolve::{self, Key, Purpose};
use flotilla::statistics::{self, Average, CONFIDENCE, Estimate, Tested};
use flotilla::world::World;
use flotilla_studies::paper::claims::{Claim, Verdict, claims};
use flotilla_studies::paper::{self, Evidence, Experiment, LAYOUTS, SOURCES, Source, tables};
use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};
use serde_json::Value;

/// Returns the paper's experiments with these numbers of trials and generations.
fn arms(trials: u32, generations: u32) -> Vec<Experiment> {
    let few = [("learning.trials", trials), ("learning.generations", generations), ("learning.seed", 3)];
    paper::arms(&few.map(|(key, value)| Override::new(key, value, key))).unwrap()
}

/// Returns the p-value of the test that the mean of differences of up to `width` is 0: the smallest alpha whose interval
/// excludes 0.
fn p_value(differences: &[f64], width: f64) -> f64 {
    let excludes = |Estimate { low, high, .. }| low > 0.0 || high < 0.0;
    let interval = |confidence| {
        let factor = statistics::bounded_factor(confidence, differences.len());
        statistics::paired_by(factor, &differences.iter().collect(), width)
    };
    statistics::smallest_alpha(|confidence| interval(confidence).is_some_and(excludes)).unwrap_or(1.0)
}

#[test]
fn intervals_and_tests_equal_those_of_scipy() {
    let cases: Value = serde_json::from_str(include_str!("statistics.json")).unwrap();
    let list = |name: &str| cases[name].as_array().unwrap().clone();
    let numbers = |value: &Value| value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect::<Vec<_>>();
    let near = |ours: f64, theirs: &Value| {
        let theirs = theirs.as_f64().unwrap();
        assert!((ours - theirs).abs() <= 1e-9 * theirs.abs() + 1e-12, "{ours} is not {theirs}");
    };
    let [shares, spreads] = ["shares", "spreads"].map(list);
    assert!(shares.len() > 20 && spreads.len() > 3);
    for case in shares {
        let [count, of] = ["count", "of"].map(|key| case[key].as_u64().unwrap() as usize);
        let share = statistics::share_at(CONFIDENCE, count, of).unwrap();
        near(share.value, &(count as f64 / of as f64).into());
        near(share.low, &case["low"]);
        near(share.high, &case["high"]);
    }
    for case in spreads {
        let [one, other] = ["one", "other"].map(|key| statistics::distances(&numbers(&case[key])));
        let differences: Vec<f64> = one.iter().zip(&other).map(|(one, other)| one - other).collect();
        near(differences.iter().collect::<Average>().mean(), &case["difference"]);
        near(p_value(&differences, 4.0), &case["p"]);
    }
    let [ranks, signs, intervals, corrected] = ["ranks", "signs", "intervals", "corrected"].map(list);
    assert!(ranks.len() > 8 && signs.len() > 5 && intervals.len() > 3 && corrected.len() > 2);
    for case in ranks {
        let tested = statistics::rank_sum(&numbers(&case["one"]), &numbers(&case["other"])).unwrap();
        near(tested.a, &case["a"]);
        near(tested.p, &case["p"]);
    }
    for case in signs {
        let differences = numbers(&case["less"]);
        let tested = statistics::signed_rank(&differences).unwrap();
        near(tested.p, &case["p"]);
        let ahead = |difference: &f64| if *difference > 0.0 { 1.0 } else { f64::from(*difference == 0.0) / 2.0 };
        near(tested.a, &(differences.iter().map(ahead).sum::<f64>() / differences.len() as f64).into());
    }
    let average = |values: &Value| -> Average { numbers(values).iter().collect() };
    for case in intervals {
        let [one, other] = ["one", "other"].map(|key| average(&case[key]));
        let pairs = numbers(&case["one"]).into_iter().zip(numbers(&case["other"]));
        let differences: Vec<f64> = pairs.map(|(one, other)| one - other).collect();
        for (ours, key) in [
            (statistics::bounded(&one, [0.0, 1.0]), "mean"),
            (statistics::difference(&one, &other, [0.0, 1.0]), "difference"),
            (statistics::paired(&differences.iter().collect(), 1.0), "paired"),
        ] {
            let ours = ours.unwrap();
            let ends = case[key].as_array().unwrap();
            [ours.value, ours.low, ours.high].into_iter().zip(ends).for_each(|(ours, theirs)| near(ours, theirs));
        }
    }
    for case in list("medians") {
        let median = statistics::median(&numbers(&case["values"])).unwrap();
        let places = [median.low, median.high].map(|end| end.is_finite().then_some(end));
        assert_eq!(Value::from(vec![Some(median.value), places[0], places[1]]), case["median"]);
    }
    for case in corrected {
        let holm = statistics::holm(&numbers(&case["p"]));
        holm.iter().zip(case["holm"].as_array().unwrap()).for_each(|(&ours, theirs)| near(ours, theirs));
    }
}

#[test]
fn rank_tests_handle_equal_values_extremes_and_ties() {
    let equal = [0.75; 8];
    let no_difference = Some(Tested { a: 0.5, p: 1.0 });
    assert_eq!(statistics::rank_sum(&equal, &equal[..3]), no_difference);
    assert_eq!(statistics::rank_sum(&[0.75; 80], &[0.75; 90]), no_difference);
    assert_eq!(statistics::signed_rank(&[0.0; 4]), no_difference);
    assert_eq!((statistics::rank_sum(&equal, &[]), statistics::signed_rank(&[])), (None, None));
    // The smallest possible p: 2 of 32 sign patterns of 5 pairs, and 2 of 252 arrangements of 5 and 5 values.
    assert_eq!(statistics::signed_rank(&[1.0; 5]), Some(Tested { a: 1.0, p: 2.0 / 32.0 }));
    let [one, other] = [[1.0; 5], [0.0; 5]];
    assert_eq!(statistics::rank_sum(&one, &other), Some(Tested { a: 1.0, p: 2.0 / 252.0 }));
    // These differences are 1/3 or -1/3 except for rounding, so they are ties.
    let thirds = [1.0 / 3.0, 2.0 / 3.0 - 1.0 / 3.0, 2.0 / 3.0 - 1.0, 1.0 - 2.0 / 3.0];
    assert_eq!(statistics::signed_rank(&thirds), statistics::signed_rank(&[1.0, 1.0, -1.0, 1.0]));
}

#[test]
fn an_average_does_not_depend_on_the_order_of_its_values() {
    let average_of = |values: &[f64]| {
        let average: Average = values.iter().collect();
        (average.count(), average.mean(), average.deviation(), average.error())
    };
    assert_eq!(average_of(&[]), (0, 0.0, 0.0, 0.0));
    // In f64, the sum of seven times 0.1 is not 0.7.
    assert_eq!(average_of(&[0.1; 7]), (7, 0.1, 0.0, 0.0));
    for values in [[0.0, 0.5, 1.0, 0.5], [0.5, 1.0, 0.5, 0.0]] {
        let (count, mean, deviation, error) = average_of(&values);
        assert_eq!((count, mean), (4, 0.5));
        assert!((deviation - (0.5f64 / 3.0).sqrt()).abs() < 1e-15, "{deviation}");
        assert!((error - deviation / 2.0).abs() < 1e-15, "{error}");
    }
    assert_eq!([[0.75, 1.0, 0.0, 0.0], [0.0, 0.75, 0.0, 1.0]].map(|values| average_of(&values).1), [0.4375; 2]);
}

/// Adds each way to draw `trials` scores from 0 to 1 in steps of 0.25, with the number of each score.
fn draws(trials: usize, scores: usize) -> Vec<Vec<usize>> {
    if scores == 1 {
        return vec![vec![trials]];
    }
    let first =
        |count: usize| draws(trials - count, scores - 1).into_iter().map(move |rest| [vec![count], rest].concat());
    (0..=trials).flat_map(first).collect()
}

/// Five trials are equal in most experiments if few of all trials fail. So an interval needs a width even then. Coverage
/// is exact here: every possible outcome counts with its probability.
#[test]
fn intervals_of_few_discrete_scores_cover_the_mean() {
    const SCORES: [f64; 5] = [0.0, 0.25, 0.5, 0.75, 1.0];
    let mut random = ChaCha8Rng::seed_from_u64(7);
    let mut distributions: Vec<[f64; 5]> = Vec::new();
    for share in [0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 0.98] {
        for other in 0..4 {
            let mut chances = [0.0; 5];
            (chances[other], chances[4]) = (1.0 - share, share);
            distributions.push(chances);
        }
    }
    for _ in 0..30 {
        // Powers make most of them uneven.
        let chances = [(); 5].map(|()| f64::from(random.random::<f32>()).powi(4));
        distributions.push(chances.map(|chance| chance / chances.iter().sum::<f64>()));
    }
    for (trials, least) in [(3, 0.95), (5, 0.93), (10, 0.94), (20, 0.94)] {
        let cases: Vec<(Vec<usize>, Average)> = draws(trials, 5)
            .into_iter()
            .map(|counts| {
                let values = counts.iter().zip(&SCORES).flat_map(|(&count, score)| std::iter::repeat_n(score, count));
                let average = values.collect();
                (counts, average)
            })
            .collect();
        let intervals: Vec<Estimate> =
            cases.iter().map(|(_, average)| statistics::bounded(average, [0.0, 1.0]).unwrap()).collect();
        assert!(intervals.iter().all(|interval| {
            0.0 <= interval.low
                && interval.low <= interval.value
                && interval.value <= interval.high
                && interval.high <= 1.0
        }));
        assert!(intervals.iter().all(|interval| interval.high - interval.low > 0.1), "{trials}");
        for chances in &distributions {
            let mean: f64 = chances.iter().zip(SCORES).map(|(chance, score)| chance * score).sum();
            let covered =
                cases.iter().zip(&intervals).filter(|(_, at)| at.low - 1e-9 <= mean && mean <= at.high + 1e-9);
            let probability = |counts: &[usize]| {
                let (mut left, mut product) = (trials, 1.0);
                for (&count, chance) in counts.iter().zip(chances) {
                    for place in 0..count {
                        product *= chance * (left - place) as f64 / (place + 1) as f64;
                    }
                    left -= count;
                }
                product
            };
            let coverage: f64 = covered.map(|((counts, _), _)| probability(counts)).sum();
            assert!(coverage >= least, "{coverage} of {trials} trials with chances {chances:?}");
        }
    }
    for few in [&[][..], &[1.0]] {
        assert_eq!(statistics::bounded(&few.iter().collect(), [0.0, 1.0]), None);
    }
    let share = |count, of| statistics::share_at(CONFIDENCE, count, of);
    assert_eq!((share(0, 0), share(2, 1)), (None, None));
}

/// Most pairs are equal in the worst case, and the others all differ in one direction.
#[test]
fn intervals_of_pairs_cover_as_much_as_documented() {
    for (pairs, least) in [(5, 0.90), (10, 0.88), (20, 0.86), (50, 0.86)] {
        let sample = |ones: usize| (0..pairs).map(move |pair| f64::from(u8::from(pair < ones)));
        let all: Vec<Estimate> = (0..=pairs)
            .map(|ones| statistics::paired(&sample(ones).collect::<Vec<_>>().iter().collect(), 1.0).unwrap())
            .collect();
        let coverage = |chance: f64| {
            let mut probability = (1.0 - chance).powi(pairs as i32);
            let mut covered = 0.0;
            for (ones, at) in all.iter().enumerate() {
                if at.low <= chance && chance <= at.high {
                    covered += probability;
                }
                probability *= (pairs - ones) as f64 / (ones + 1) as f64 * chance / (1.0 - chance);
            }
            covered
        };
        let worst = (1..1000).map(|chance| coverage(f64::from(chance) / 1000.0)).fold(1.0, f64::min);
        assert!((least..least + 0.02).contains(&worst), "{worst} of {pairs} pairs");
    }
}

/// Plays baselines to the end.
fn played(mut baselines: Baselines) -> Baselines {
    while !baselines.is_done() {
        baselines.advance(&mut Cpu::default()).unwrap();
    }
    baselines
}

#[test]
fn random_baselines_equal_the_best_teams_that_a_backend_plays() {
    let arms = arms(2, 2);
    let configs = paper::baseline_configs(&arms);
    let found = played(Baselines::new(&ValidConfig::all(&configs).unwrap())).found();
    assert!(found.iter().all(|found| found.constant[1] == [1.0; 3]), "a constant speed solves every layout");
    assert!(found.iter().any(|found| found.random[0] != found.random[1]), "both trials drew the same policies");
    for (config, found) in configs.iter().zip(&found) {
        let world = World::new(&config.validate().unwrap());
        let (population, parameters) = (config.learning.population, world.parameters());
        for purpose in [Purpose::Baseline, Purpose::SharedBaseline, Purpose::ConstantActions] {
            let mut best = 0.0f64;
            for generation in 0..=2 {
                let mut weights = Vec::new();
                for leader in 0..world.leaders() {
                    for slot in 0..population {
                        let mut policy = vec![0.0; parameters];
                        let leader = if purpose == Purpose::SharedBaseline { 0 } else { leader };
                        let key = Key::new(3, 1, purpose).at(generation, leader, slot);
                        match purpose {
                            Purpose::Baseline | Purpose::SharedBaseline => {
                                evolve::random_policy(Level::new(), key, &mut policy)
                            }
                            _ => {
                                let uniform = |of: u32| f64::from(key.draw(of)[0]) / (1u64 << 31) as f64 - 1.0;
                                baseline::constant_policy(&[uniform(0), uniform(1)], &mut policy);
                            }
                        }
                        weights.extend(policy);
                    }
                }
                let observed = observed(&world, &weights, population);
                best = best.max(f64::from(observed.into_iter().max().unwrap()) / world.pois.len() as f64);
                let found = match purpose {
                    Purpose::Baseline => &found.random,
                    Purpose::SharedBaseline => &found.shared,
                    _ => &found.actions,
                };
                assert_eq!(found[1][generation], best, "{purpose:?}, generation {generation}");
            }
        }
    }
}

/// Returns the number of POIs that each team observes. Team j has policy j of every leader.
fn observed(world: &World, weights: &[f32], policies: usize) -> Vec<u32> {
    let teams = evolve::aligned_teams(policies, world.leaders());
    let populations = own_populations(world.leaders());
    let group = Group { populations, ..Group::new(world, weights, policies, &teams) };
    Cpu::default().play(&[group]).unwrap().remove(0).observed
}

#[test]
fn constant_speed_baselines_equal_stepped_teams_and_solve_every_layout() {
    for (place, config) in paper::baseline_configs(&arms(1, 0)).into_iter().enumerate() {
        let found = played(Baselines::of_trial(&config.validate().unwrap(), 0));
        let outcome = found.outcomes(&mut Cpu::default(), 1).unwrap().concat().remove(0);
        let teams = baseline::SPEEDS;
        let mut stepper = flotilla::stepper(&config, teams, false).unwrap();
        let speed = |team: usize| (2 * (team + 1)) as f32 / teams as f32 - 1.0;
        let actions: Vec<f32> =
            (0..teams).flat_map(|team| (0..config.learners()).flat_map(move |_| [0.0, speed(team)])).collect();
        (0..config.world.steps).for_each(|_| stepper.step(&actions).unwrap());
        let pois = config.world.pois.len();
        let g = |pois: &[bool]| pois.iter().filter(|&&observed| observed).count() as f64 / pois.len() as f64;
        let stepped: Vec<f64> = stepper.observed().chunks(pois).map(g).collect();
        let name = format!("{}, {pois} POIs, {} steps", config.learning.paradigm, config.world.steps);
        assert_eq!(outcome.constants, stepped, "{name}");
        // Speeds from 60 to 95 % of the largest solve the paper's three layouts, in both paradigms.
        let solves = outcome.constants[11..19].iter().all(|&g| g == 1.0);
        assert!(solves || place >= 6, "{name}: {:?}", outcome.constants);
        assert_eq!(outcome.constants[outcome.best_constant], 1.0, "{name}");
    }
}

#[test]
fn baselines_with_moved_pois_are_measured_from_held_out_starts() {
    let mut config = paper::baseline_configs(&arms(2, 3))[1].clone();
    (config.learning.poi_jitter, config.learning.population, config.learning.episodes_per_team) = (5.0, 6, 2);
    let baselines = played(Baselines::of_trial(&config.validate().unwrap(), 5));
    let outcome = baselines.outcomes(&mut Cpu::default(), 30).unwrap().concat().remove(0);
    let world = World::new(&config.validate().unwrap());
    let constants = baseline::constants(config.policy.actions);
    let policies = constants.len();
    let mut weights = vec![0.0; world.leaders() * policies * world.parameters()];
    for (place, policy) in weights.chunks_mut(world.parameters()).enumerate() {
        baseline::constant_policy(&constants[place % policies], policy);
    }
    let teams = evolve::aligned_teams(policies, world.leaders());
    let populations = own_populations(world.leaders());
    let group = Group { populations, ..Group::new(&world, &weights[..], policies, &teams) };
    let held_out = Starts::Drawn { episodes: 30, seed: 0, jitter: 0.0, poi_jitter: 5.0 };
    let played =
        evaluate::evaluate(&mut Cpu::default(), &group, &held_out, &mut |_| std::ops::ControlFlow::Continue(()))
            .unwrap();
    let g: Vec<f64> = played.observed.iter().map(|tally| tally.mean() / world.pois.len() as f64).collect();
    for (found, g) in outcome.constants.iter().zip(&g) {
        assert!((found - g).abs() < 1e-12, "{:?} is not {g:?}", outcome.constants);
    }
    assert!(g.iter().any(|&other| other != g[0]) && outcome.all().iter().all(|&g| g > 0.0), "{outcome:?}");
    // Another trial has the same constant actions, but other random teams.
    let other = self::played(Baselines::of_trial(&config.validate().unwrap(), 6))
        .outcomes(&mut Cpu::default(), 30)
        .unwrap()
        .concat()
        .remove(0);
    assert_eq!(other.constants, outcome.constants);
    assert_ne!((other.network, other.action), (outcome.network, outcome.action));
}

/// Compares both climbers with a plain one that plays team by team.
#[test]
fn climbers_keep_the_best_of_sixteen_mutants() {
    let mut config = paper::baseline_configs(&arms(2, 2))[1].clone();
    (config.learning.population, config.learning.sharing) = (21, Sharing::Group);
    let config = config.validate().unwrap();
    let found = played(Baselines::of_trial(&config, 1)).found().remove(0);
    let (world, pois) = (World::new(&config), config.world.pois.len());
    let (leaders, parameters) = (world.leaders(), world.parameters());
    let networks = |team: &[f32]| observed(&world, team, 1)[0];
    let segments = |team: &[f32]| {
        let mut stepper = flotilla::stepper(&config, 1, false).unwrap();
        for step in 0..world.steps() {
            let segment = step * 4 / world.steps();
            let first = (0..=step).find(|step| step * 4 / world.steps() == segment).unwrap();
            // A turn takes as many steps as the largest turn per step allows.
            let turned = (world.classes[0].constants.motion.max_turn / std::f32::consts::PI) * (step - first) as f32;
            let left = |turn: f32| if turned < turn.abs() { turn - turned.copysign(turn) } else { 0.0 };
            let action = |leader: &[f32]| [left(leader[2 * segment]), leader[2 * segment + 1]];
            let actions: Vec<f32> = team.chunks(8).flat_map(action).collect();
            stepper.step(&actions).unwrap();
        }
        stepper.observed().iter().filter(|&&observed| observed).count() as u32
    };
    type Play<'a> = &'a dyn Fn(&[f32]) -> u32;
    let play: [(Purpose, usize, Play<'_>, &[f64]); 2] = [
        (Purpose::Climber, parameters, &networks, &found.hill_climbing[0]),
        (Purpose::OpenLoop, 8, &segments, &found.open_loop[0]),
    ];
    for (purpose, size, observed, found) in play {
        let (mut parent, mut most) = (vec![], 0);
        for (generation, &found) in found.iter().enumerate() {
            for first in [0, 16] {
                let mut best: Option<(Vec<f32>, u32)> = None;
                for slot in first..21.min(first + 16) {
                    let mut team = parent.clone();
                    team.resize(leaders * size, 0.0);
                    for (leader, part) in team.chunks_mut(size).enumerate() {
                        let key = Key::new(3, 1, purpose).at(generation, leader, slot);
                        let uniform = |of: u32| (f64::from(key.draw(of)[0]) / (1u64 << 31) as f64 - 1.0) as f32;
                        match (parent.is_empty(), purpose) {
                            (true, Purpose::Climber) => evolve::random_policy(Level::new(), key, part),
                            (true, _) => (0..).zip(part).for_each(|(of, number)| *number = uniform(of)),
                            (false, _) => {
                                let mut learning = config.learning.clone();
                                learning.mutation = Mutation::Additive;
                                (learning.mutation_probability, learning.mutation_sigma) =
                                    [(0.1, 1.0), (0.3, 0.3), (1.0, 0.1), (1.0, 0.03)][slot % 4];
                                evolve::mutate(Level::new(), key, &learning, part, &mut vec![]);
                                if purpose == Purpose::OpenLoop {
                                    part.iter_mut().for_each(|number| *number = number.clamp(-1.0, 1.0));
                                }
                            }
                        }
                    }
                    let count = observed(&team);
                    if best.as_ref().is_none_or(|(_, most)| count >= *most) {
                        best = Some((team, count));
                    }
                }
                if let Some((team, count)) = best.filter(|&(_, count)| parent.is_empty() || count >= most) {
                    (parent, most) = (team, count);
                }
            }
            assert_eq!(found, f64::from(most) / pois as f64, "{purpose:?}, generation {generation}");
        }
    }
}

/// Returns the claims about experiments whose champions have the G that `g` returns, given trial and generation.
fn judged(trials: u32, generations: u32, g: impl Fn(&Experiment, usize, usize) -> f64) -> Vec<Claim> {
    let mut arms = arms(trials, generations);
    for arm in &mut arms {
        let course = |trial| (0..=generations as usize).map(|at| g(arm, trial, at)).collect();
        arm.champion = (0..trials as usize).map(course).collect();
        arm.best.clone_from(&arm.champion);
    }
    let none = vec![vec![0.0; generations as usize + 1]; trials as usize];
    let baseline = Baseline {
        constant: none.clone(),
        actions: none.clone(),
        random: none.clone(),
        shared: none.clone(),
        open_loop: none.clone(),
        hill_climbing: none,
    };
    let baselines = vec![baseline; 8];
    claims(Evidence { arms: &arms, baselines: &baselines })
}

/// Returns the verdict on the claim about a layout that contains `words`, for one source.
fn verdict(claims: &[Claim], layout: usize, words: &str, source: Source) -> Verdict {
    let is = |claim: &&Claim| claim.layout == LAYOUTS[layout].name && claim.words.contains(words);
    let claim = claims.iter().find(is).unwrap();
    claim.findings.iter().find(|found| SOURCES[found.column] == source).unwrap().verdict
}

const G: Source = Source::Evolved(Fitness::G);

#[test]
fn verdicts_match_the_wording_of_the_claims() {
    let leader_follower = |arm: &Experiment| arm.paradigm == Paradigm::LeaderFollower;
    // Averages of 4, 3.9, 3.7 with few trials, and 3.25 POIs.
    let consistently = |trials, from: usize, g: f64| {
        let course = move |arm: &Experiment, trial: usize, _: usize| match leader_follower(arm) {
            true if trial % 4 >= from => g,
            true => 1.0,
            false => 0.0,
        };
        verdict(&judged(trials, 100, course), 0, "consistently", G)
    };
    assert_eq!(consistently(200, 4, 1.0), Verdict::Yes);
    assert_eq!(consistently(200, 3, 0.9), Verdict::Yes, "3.9 of 4");
    assert_eq!(consistently(12, 2, 0.85), Verdict::Undecided, "3.7 of 4, too few trials");
    assert_eq!(consistently(200, 1, 0.75), Verdict::No, "3.25 of 4");

    let perfect = judged(200, 100, |arm, _, _| f64::from(leader_follower(arm)));
    for (layout, words, expected) in [
        (0, "less than a single POI", Verdict::Yes),
        (0, "at least 3, on average", Verdict::Yes),
        (1, "almost never", Verdict::Yes),
        (1, "not as readily apparent", Verdict::Yes),
        (1, "significantly higher", Verdict::Undecided),
        (2, "high likelihood of random actions", Verdict::No),
        (2, "some of the time", Verdict::No),
        (2, "rather large variance", Verdict::No),
        (2, "about a similar policy", Verdict::No),
        (2, "comparable policy", Verdict::Yes),
        (2, "much faster", Verdict::Yes),
        (2, "more consistently", Verdict::Undecided),
        (2, "more reliably", Verdict::Yes),
        (2, "slight benefit", Verdict::Undecided),
    ] {
        assert_eq!(verdict(&perfect, layout, words, G), expected, "{words}");
    }
    // A constant speed has the same result in every trial, so the verdict is never undecided.
    assert_eq!(verdict(&perfect, 0, "at least 3, on average", Source::Constant), Verdict::No);

    // A mean of 3 with a spread is neither clearly below nor above 3.
    let around = judged(200, 100, |arm, trial, _| if leader_follower(arm) && trial % 2 == 0 { 1.0 } else { 0.5 });
    assert_eq!(verdict(&around, 0, "at least 3, on average", G), Verdict::Undecided);
    // All-leaders teams always observe half of the POIs, which is better than the paper says.
    assert_eq!(verdict(&around, 0, "less than a single POI", G), Verdict::No);
    assert_eq!(verdict(&around, 1, "almost never", G), Verdict::No);
    assert_eq!(verdict(&around, 1, "more drastic", G), Verdict::Undecided);

    // Df differs from G by a little, by much, and in its spread.
    let df = |arm: &Experiment| arm.fitness == Fitness::Df;
    let slight = judged(200, 100, |arm, trial, _| if df(arm) || trial % 5 > 0 { 1.0 } else { 0.75 });
    assert_eq!(verdict(&slight, 2, "slight benefit", G), Verdict::Yes);
    let great = judged(200, 100, |arm, _, _| if df(arm) { 1.0 } else { 0.5 });
    assert_eq!(verdict(&great, 2, "slight benefit", G), Verdict::No);
    let wild = judged(200, 100, |arm, trial, _| if df(arm) && trial % 2 > 0 { 0.0 } else { 1.0 });
    assert_eq!(verdict(&wild, 1, "significantly higher", G), Verdict::Yes);
    let calm = judged(200, 100, |arm, trial, _| if !df(arm) && trial % 2 > 0 { 0.0 } else { 1.0 });
    assert_eq!(verdict(&calm, 1, "significantly higher", G), Verdict::No);
    assert_eq!(verdict(&calm, 2, "some of the time", G), Verdict::Yes);

    // Teams that select between behaviours: equal to all others, then later, then never as good.
    let to_select = "learning to select between policies";
    let rival = |from: usize, up_to: f64| {
        judged(200, 100, move |arm, _, at| {
            if arm.selects && at < from {
                0.0
            } else if arm.selects {
                up_to
            } else {
                1.0
            }
        })
    };
    for (rivals, faster, better) in [
        (rival(0, 1.0), Verdict::Undecided, Verdict::Undecided),
        (rival(50, 1.0), Verdict::Yes, Verdict::Undecided),
        (rival(0, 0.75), Verdict::Yes, Verdict::Yes),
    ] {
        let words = ["“faster” than “those ", "“a more optimal solution” than “those "]
            .map(|word| word.to_string() + to_select);
        for layout in 0..3 {
            for source in [G, Source::Evolved(Fitness::Df)] {
                assert_eq!(verdict(&rivals, layout, &words[0], source), faster, "{layout}");
                assert_eq!(verdict(&rivals, layout, &words[1], source), better, "{layout}");
            }
        }
    }
    // Eight followers: leader-follower teams are as good as all-leaders teams but later, then earlier but worse.
    let slow = judged(200, 100, |arm, _, at| if leader_follower(arm) && at < 9 { 0.0 } else { 1.0 });
    let worse =
        judged(
            200,
            100,
            |arm, _, at| if leader_follower(arm) { if at == 9 { 1.0 } else { 0.5 } } else { 0.0 + f64::from(at > 50) },
        );
    for (claims, performant, faster) in [(slow, Verdict::Yes, Verdict::No), (worse, Verdict::No, Verdict::Yes)] {
        assert_eq!(verdict(&claims, 3, "a similarly performant policy", G), performant);
        assert_eq!(verdict(&claims, 3, "“faster than when using all learners”", G), faster);
    }
    assert_eq!(verdict(&calm, 2, "rather large variance", G), Verdict::Yes);
}

#[test]
fn claims_stay_open_if_a_run_is_too_short() {
    let short = judged(30, 39, |_, _, _| 1.0);
    assert_eq!(verdict(&short, 0, "at least 3, on average", G), Verdict::Yes);
    assert_eq!(verdict(&short, 0, "consistently", G), Verdict::Open);
    assert!(tables::count(&short).contains(" open (too few generations or trials)"), "{}", tables::count(&short));
    let single = judged(1, 100, |_, _, _| 1.0);
    assert!(single.iter().flat_map(Claim::on_evolution).all(|found| found.verdict == Verdict::Open));
}

/// Exploratory claims, which are not the paper's, are counted separately.
#[test]
fn a_claim_holds_only_if_it_holds_for_all_its_fitnesses() {
    let leader_follower = |arm: &Experiment| arm.paradigm == Paradigm::LeaderFollower;
    let overall_verdict =
        |claims: &[Claim], words: &str| claims.iter().find(|claim| claim.words.contains(words)).unwrap().verdict();
    let at_least_3 = "at least 3, on average";
    assert_eq!(
        overall_verdict(&judged(30, 100, |arm, _, _| f64::from(leader_follower(arm))), at_least_3),
        Verdict::Yes
    );
    let one_fails = |arm: &Experiment, _: usize, _: usize| match arm.fitness {
        Fitness::D => 0.5,
        _ => f64::from(leader_follower(arm)),
    };
    assert_eq!(overall_verdict(&judged(30, 100, one_fails), at_least_3), Verdict::No);
    let one_open = |arm: &Experiment, trial: usize, _: usize| match arm.fitness {
        Fitness::D if trial.is_multiple_of(2) => 0.5,
        _ => f64::from(leader_follower(arm)),
    };
    assert_eq!(overall_verdict(&judged(30, 100, one_open), at_least_3), Verdict::Undecided);
    let count = tables::count(&judged(30, 100, one_fails));
    assert!(count.starts_with("28 claims on the paper's experiments: "), "{count}");
    assert!(count.contains(". 8 exploratory claims (†): "), "{count}");
}

/// Times of trials that never observe all POIs are censored, and pairs in which neither does are ties.
#[test]
fn times_are_compared_by_restricted_means_and_ties_do_not_count() {
    let leader_follower = |arm: &Experiment| arm.paradigm == Paradigm::LeaderFollower;
    let found = |claims: &[Claim], words: &str| {
        let claim = claims.iter().find(|claim| claim.words.contains(words)).unwrap().clone();
        claim.findings.into_iter().find(|found| SOURCES[found.column] == G).unwrap()
    };
    // Leader-follower teams after 10 generations, all-leaders teams after 60, but neither in every fifth pair.
    let usual =
        judged(40, 100, |arm, trial, at| f64::from(trial % 5 > 0 && at >= if leader_follower(arm) { 10 } else { 60 }));
    let faster = found(&usual, "much faster");
    assert!(faster.measured.starts_with("+16.0 ["), "60 / 2 - 10 in four of five pairs: {}", faster.measured);
    assert_eq!(faster.verdict, Verdict::Yes);
    // All-leaders teams never observe all POIs. Most of their times are censored, so pairs are counted instead.
    let never = judged(40, 100, |arm, trial, at| f64::from(leader_follower(arm) && trial % 5 > 0 && at >= 10));
    assert!(found(&never, "much faster").measured.starts_with("32 of 32 ["));
    // If neither side observes all POIs, no pair differs, and the claim is undecided.
    let neither = judged(40, 100, |_, _, _| 0.5);
    let tied = found(&neither, "much faster");
    assert_eq!((tied.verdict, &*tied.measured), (Verdict::Undecided, "no pair differs"));
}

/// A claim that holds by its own p-value is undecided if its corrected p-value is large.
#[test]
fn verdicts_are_corrected_for_multiple_tests() {
    let leader_follower = |arm: &Experiment| arm.paradigm == Paradigm::LeaderFollower;
    // 3.5 POIs with a spread in 40 trials: the 95 % interval begins above 3, which many tests would reach by chance.
    let claims = judged(40, 100, |arm, trial, _| match leader_follower(arm) {
        true => [1.0, 1.0, 0.5, 1.0][trial % 4],
        false => [0.25, 0.5, 0.0, 0.75][trial % 4],
    });
    let claim = claims.iter().find(|claim| claim.words.contains("at least 3, on average")).unwrap();
    let found = claim.findings.iter().find(|found| SOURCES[found.column] == G).unwrap();
    let (estimate, p) = (found.estimate.unwrap(), found.p.unwrap());
    assert!(estimate.low > 3.0 && p < 0.05, "{found:?}");
    assert!(found.p_holm.unwrap() > 0.05 && found.verdict == Verdict::Undecided, "{found:?}");
    // scipy's ttest_1samp([4, 4, 2, 4] * 10 + [0, 4], 3): t is 2.7349 with 41 degrees of freedom.
    assert!((p - 0.009_175_102_495_957).abs() < 1e-12, "{p}");
}
