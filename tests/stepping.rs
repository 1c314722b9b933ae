//! Tests that teams stepped by hand have the same states, observations and scores as in a backend's traces.
//!
//! They have to be equal bit for bit, with every instruction set, number of teams and order of resets. Invalid input is
//! refused and changes nothing.

use crate::support;
use fearless_simd::Level;
use flotilla::backend::cpu::{Cpu, level_name};
use flotilla::backend::{Backend, Group, Moment, Trace};
use flotilla::config::{Config, Fitness, MAX_POPULATION, own_populations};
use flotilla::credit::{self, Credit, Scores};
use flotilla::evaluate::Starts;
use flotilla::evolve::aligned_teams;
use flotilla::sample;
use flotilla::stepping::{Recording, StepError, Stepper};
use flotilla::world::World;
use glam::Vec2;

/// Episodes of teams of random policies, played by the CPU.
struct Played {
    world: World,
    starts: Vec<Vec2>,
    trace: Trace,
}

impl Played {
    fn new(seed: u64, teams: usize) -> Played {
        let world = World::new(&sample::any_world(seed).validate().unwrap());
        let starts = match seed % 2 {
            0 => world.starts.clone(),
            _ => Starts::Drawn { episodes: 1, seed, jitter: 0.7, poi_jitter: 0.0 }.of(0, &world),
        };
        let weights = sample::weights(&world, teams, seed);
        let order = aligned_teams(teams, world.leaders());
        let group = Group {
            starts: &starts,
            populations: own_populations(world.leaders()),
            fitnesses: &[Fitness::Dt],
            ..Group::new(&world, &weights[..], teams, &order)
        };
        let trace = Cpu::default().trace(&group).expect("the group is valid");
        Played { world, starts, trace }
    }

    /// Returns the actions of a team's leaders at a step, with steps from 0.
    fn actions(&self, step: usize, team: usize) -> impl Iterator<Item = f32> {
        (0..self.world.leaders()).flat_map(move |leader| self.trace.moment(step + 1, team, leader).outputs)
    }

    fn starts_of(&self, teams: usize) -> Vec<f32> {
        bytemuck::cast_slice(&self.starts).repeat(teams)
    }

    /// Compares the state of a stepper's team after a step with the trace, bit for bit.
    fn check(&self, stepper: &mut Stepper, step: usize, team: usize, case: &str) {
        let (leaders, agents) = (self.world.leaders(), self.world.agents());
        let case = format!("{case}, team {team}, step {step}");
        let bits = |numbers: &[f32]| numbers.iter().map(|number| number.to_bits()).collect::<Vec<_>>();
        let moments = |step: usize, count| (0..count).map(move |agent| *self.trace.moment(step, team, agent));
        if step < self.world.steps() {
            let inputs = (0..leaders).flat_map(|leader| self.trace.inputs_of(step + 1, team, leader));
            let sensed: Vec<f32> = inputs.copied().collect();
            assert_eq!(bits(&stepper.inputs()[team * sensed.len()..][..sensed.len()]), bits(&sensed), "inputs, {case}");
        }
        let states = stepper.states();
        let expected: [Vec<f32>; 3] = [
            moments(step, agents).flat_map(|Moment { position, .. }| position).collect(),
            moments(step, agents).flat_map(|Moment { heading, .. }| heading).collect(),
            moments(step, agents).map(|Moment { speed, .. }| speed).collect(),
        ];
        for (found, expected) in [states.positions, states.headings, states.speeds].into_iter().zip(expected) {
            assert_eq!(bits(&found[team * expected.len()..][..expected.len()]), bits(&expected), "states, {case}");
        }
        let (pois, words) = (self.world.pois.len(), self.world.constants.words as usize);
        let sets = self.trace.sets[team * self.world.set_words()..][..self.world.set_words()].chunks(pois * words);
        let sets: Vec<&[u32]> = sets.collect();
        let now = step.checked_sub(1).map_or(vec![0; pois * words], |step| sets[step].to_vec());
        assert_eq!(stepper.agents_at_poi()[team * now.len()..][..now.len()], now, "near, {case}");
        let words = &self.trace.sets[team * self.world.set_words()..][..self.world.set_words()];
        let at = credit::observed_at(credit::Strided { words, stride: 1, offset: 0 }, &self.world);
        let by = |step: usize| at.iter().map(move |at| at.is_some_and(|at| at <= step)).collect::<Vec<bool>>();
        let (observed, before) = (by(step), by(step.saturating_sub(1)));
        let newly: Vec<bool> = observed.iter().zip(before).map(|(&observed, before)| observed && !before).collect();
        assert_eq!(stepper.observed()[team * pois..][..pois], observed, "observed, {case}");
        assert_eq!(stepper.steps()[team] as usize, step, "{case}");
        assert_eq!(stepper.is_over(team), step == self.world.steps(), "{case}");
        // A team that was over before the last call of `step` newly observed nothing, unlike its trace.
        if step < self.world.steps() || stepper.newly_observed()[team * pois..][..pois].contains(&true) {
            assert_eq!(stepper.newly_observed()[team * pois..][..pois], newly, "newly observed, {case}");
        }
    }

    fn scores(&self, team: usize) -> Scores {
        Credit::default().all(&self.trace.episode(&self.world, team), &self.world)
    }
}

/// Returns every instruction set, and the numbers of agents from which teams are large: all that may be, or none.
fn ways_to_step() -> Vec<(Level, usize)> {
    Cpu::levels().into_iter().flat_map(|level| [(level, 0), (level, usize::MAX)]).collect()
}

#[test]
fn stepping_with_traced_actions_gives_the_bits_of_the_trace() {
    for (level, large_from) in ways_to_step() {
        // Fewer teams than a vector has lanes, as many, one more, and more vectors than one thread plays.
        let most = if large_from == 0 { 3 } else { usize::MAX };
        for (seed, teams) in (0..40).zip([1, 3, 16, 17, 37, 150].map(|teams| most.min(teams)).into_iter().cycle()) {
            let played = Played::new(seed, teams);
            let case = format!("seed {seed}, {teams} teams, {}, large from {large_from}", level_name(level));
            let stepper = Stepper::at_level(level, large_from, played.world.clone(), teams, Recording::SetsAndSights);
            let mut stepper = stepper.unwrap_or_else(|error| panic!("{case}: {error}"));
            stepper.reset_to(&played.starts_of(teams)).expect("the starts are on the map");
            let mut observed = vec![0; teams];
            for step in 0..=played.world.steps() {
                (0..teams).for_each(|team| played.check(&mut stepper, step, team, &case));
                let newly = stepper.newly_observed().chunks(played.world.pois.len());
                observed.iter_mut().zip(newly).for_each(|(sum, newly)| {
                    let worth = newly.iter().zip(&played.world.worth).filter(|(newly, _)| **newly);
                    *sum += worth.map(|(_, worth)| worth).sum::<u32>();
                });
                if step < played.world.steps() {
                    let actions: Vec<f32> = (0..teams).flat_map(|team| played.actions(step, team)).collect();
                    stepper.step(&actions).unwrap_or_else(|error| panic!("{case}: {error}"));
                }
            }
            let leaders = played.world.leaders();
            let mut dpp = vec![-1.0; teams * leaders];
            stepper.fitness(Fitness::Dpp, &mut dpp).expect("a record is kept");
            let mut dt = vec![-1.0; teams * leaders];
            stepper.fitness(Fitness::Dt, &mut dt).expect("sights are kept");
            for (team, dpp) in dpp.chunks(leaders).enumerate() {
                let scores = played.scores(team);
                assert_eq!(stepper.scores(team).as_ref(), Ok(&scores), "{case}, team {team}");
                assert_eq!(&scores.dpp[..], dpp, "{case}, team {team}");
                // Without paths, G is what the newly observed POIs are worth.
                if played.world.paths.is_none() {
                    assert_eq!(scores.observed, observed[team], "{case}, team {team}");
                }
                assert_eq!(scores.dt, dt[team * leaders..][..leaders], "{case}, team {team}");
            }
        }
    }
}

/// A team that is over does not move until its reset.
#[test]
fn each_team_can_be_reset_at_any_step() {
    for (seed, (level, large_from)) in (0..40).zip(ways_to_step().into_iter().cycle()) {
        let teams = if large_from == 0 { 5 } else { 21 };
        let played = Played::new(seed, teams);
        let (last, starts) = (played.world.steps(), played.starts_of(teams));
        let stepper = Stepper::at_level(level, large_from, played.world.clone(), teams, Recording::SetsAndSights);
        let mut stepper = stepper.unwrap_or_else(|error| panic!("{error}"));
        stepper.reset_to(&starts).expect("the starts are on the map");
        let mut steps = vec![0; teams];
        let mut over = 0;
        for tick in 0..3 * last {
            let actions: Vec<f32> = (0..teams)
                .flat_map(|team| match steps[team] {
                    step if step < last => played.actions(step, team).collect::<Vec<_>>(),
                    _ => vec![0.3; 2 * played.world.leaders()],
                })
                .collect();
            stepper.step(&actions).expect("the actions are valid");
            over += steps.iter().filter(|&&step| step == last).count();
            steps.iter_mut().for_each(|step| *step = last.min(*step + 1));
            // Some of these teams are over, others are in the middle of an episode.
            let chosen: Vec<bool> = (0..teams).map(|team| (tick * 7 + team * 5).is_multiple_of(2 * last)).collect();
            stepper.reset_some(&chosen, Some(&starts)).expect("the starts are on the map");
            for (team, step) in steps.iter_mut().enumerate() {
                *step = if chosen[team] { 0 } else { *step };
                played.check(&mut stepper, *step, team, &format!("seed {seed}, {}", level_name(level)));
                if *step == last {
                    assert_eq!(stepper.scores(team), Ok(played.scores(team)), "seed {seed}, team {team}");
                }
            }
        }
        assert!(over > teams, "hardly any team was stepped after its end");
    }
}

fn world() -> World {
    World::new(&support::layout("generally_forward").validate().unwrap())
}

#[test]
fn invalid_input_is_refused_and_changes_nothing() {
    let world = world();
    assert!(matches!(Stepper::new(world.clone(), 0, Recording::None), Err(StepError::Teams(0))));
    assert!(matches!(Stepper::new(world.clone(), MAX_POPULATION + 1, Recording::None), Err(StepError::Teams(_))));
    assert!(matches!(Stepper::new(world.clone(), usize::MAX, Recording::None), Err(StepError::Teams(_))));
    let mut stepper = Stepper::new(world.clone(), 3, Recording::None).expect("three teams are allowed");
    let (good, leaders) = ([0.25; 24], world.leaders());
    stepper.step(&good).expect("the actions are valid");
    let before = (stepper.inputs().to_vec(), stepper.states().positions.to_vec(), stepper.steps().to_vec());
    let message = |result: Result<(), StepError>| result.expect_err("the input is invalid").to_string();
    let mut messages = vec![
        message(stepper.step(&good[1..])),
        message(stepper.step(&[])),
        message(stepper.reset_to(&[1.0; 71])),
        message(stepper.reset_some(&[true; 2], None)),
        message(stepper.reset_some(&[true, false, true], Some(&[f32::NAN; 72]))),
        message(stepper.fitness(Fitness::D, &mut [0.0; 11])),
        message(stepper.fitness(Fitness::D, &mut [0.0; 12])),
        message(stepper.scores(1).map(drop)),
        message(stepper.scores(3).map(drop)),
    ];
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut actions = good;
        actions[(leaders + 2) * 2 + 1] = bad;
        messages.push(message(stepper.step(&actions)));
    }
    for at in [-0.001, 50.001, f32::NAN, f32::INFINITY] {
        let mut starts = [1.0; 72];
        starts[2 * 24 + 2 * 5 + 1] = at;
        messages.push(message(stepper.reset_to(&starts)));
        // Starts of teams that are not reset are not validated.
        let mut other = Stepper::new(world.clone(), 3, Recording::None).expect("three teams are allowed");
        other.reset_some(&[true, true, false], Some(&starts)).expect("the starts of the chosen teams are on the map");
    }
    let expected = [
        "23 actions, but [teams][leaders][2] are 24",
        "0 actions, but [teams][leaders][2] are 24",
        "71 coordinates, but [teams][agents][2] are 72",
        "2 choices, but [teams] are 3",
        "agent 0 of team 0 would start at (NaN, NaN), which is not on the map",
        "11 scores, but [teams][leaders] are 12",
        "no record to score; create the stepper with `Recording::Sets`",
        "no record to score; create the stepper with `Recording::Sets`",
        "team 3 does not exist: there are 3, counted from 0",
        "the speed of leader 2 in team 1 is NaN, which is no finite number",
        "the speed of leader 2 in team 1 is inf, which is no finite number",
        "the speed of leader 2 in team 1 is -inf, which is no finite number",
        "agent 5 of team 2 would start at (1, -0.001), which is not on the map",
        "agent 5 of team 2 would start at (1, 50.001), which is not on the map",
        "agent 5 of team 2 would start at (1, NaN), which is not on the map",
        "agent 5 of team 2 would start at (1, inf), which is not on the map",
    ];
    assert_eq!(messages, expected);
    assert_eq!((stepper.inputs().to_vec(), stepper.states().positions.to_vec(), stepper.steps().to_vec()), before);
}

#[test]
fn actions_are_clamped_and_starts_are_rounded_to_the_grid() {
    let world = world();
    let positions = |action: [f32; 2], starts: Option<&[f32]>| {
        let mut stepper = Stepper::new(world.clone(), 5, Recording::None).expect("five teams are allowed");
        starts.into_iter().for_each(|starts| stepper.reset_to(starts).expect("the starts are on the map"));
        (0..10).for_each(|_| stepper.step(&action.repeat(5 * world.leaders())).expect("the actions are valid"));
        stepper.states().positions.to_vec()
    };
    assert_eq!(positions([7.0, 1e30], None), positions([1.0, 1.0], None));
    assert_eq!(positions([-1.5, -9.0], None), positions([-1.0, -1.0], None));
    assert_ne!(positions([1.0, 0.9], None), positions([1.0, 1.0], None));

    // Rounding leaves this speed one ULP below the maximum, also for actions above 1.
    let mut config = support::layout("generally_forward");
    (config.motion.max_speed, config.motion.max_acceleration) = (f64::from(3f32.next_up()), 100.0);
    config.world.speed = 0.5 + f64::from(f32::EPSILON);
    let speed = |wanted: f32| {
        let mut stepper =
            Stepper::new(World::new(&config.validate().unwrap()), 1, Recording::None).expect("one team is allowed");
        stepper.step(&[0.0, wanted].repeat(stepper.world().leaders())).expect("the actions are valid");
        stepper.states().speeds[0]
    };
    assert_eq!((speed(1.0), speed(7.0)), (3.0, 3.0));

    let on_grid: Vec<f32> = bytemuck::cast_slice(&world.starts).repeat(5);
    assert_eq!(positions([0.1, 0.2], Some(&on_grid)), positions([0.1, 0.2], None));
    // Starts between two points of the grid, nearer to the first.
    let off_grid: Vec<f32> =
        on_grid.iter().map(|at| at + if *at < 16.0 { 1.0 / (1 << 20) as f32 } else { 0.0 }).collect();
    assert_ne!(off_grid, on_grid);
    let mut stepper = Stepper::new(world.clone(), 5, Recording::None).expect("five teams are allowed");
    stepper.reset_to(&off_grid).expect("the starts are on the map");
    assert_eq!(stepper.states().positions, on_grid);
    assert_eq!(positions([0.1, 0.2], Some(&off_grid)), positions([0.1, 0.2], None));
}

#[test]
fn a_restored_stepper_continues_with_the_same_bits() {
    for seed in 0..12 {
        let config = sample::world(seed);
        let world = World::new(&config.validate().unwrap());
        let (teams, leaders, agents, pois) = (13, world.leaders(), world.agents(), world.pois.len());
        let make = |level, large_from| {
            let recordings = [Recording::SetsAndSights, Recording::Sets, Recording::SetsAndSights, Recording::None];
            let recording = recordings[seed as usize % 4];
            Stepper::at_level(level, large_from, world.clone(), teams, recording).unwrap()
        };
        let mut original = make(Level::new(), if seed % 4 < 2 { 0 } else { usize::MAX });
        // In every third world, each team has its own POIs.
        let moved = if seed % 3 == 0 { pois } else { 0 };
        let starts: Vec<f32> = (0..teams * (agents + moved))
            .flat_map(|place| [(place % 7) as f32, (place % 5) as f32].map(|at| at * 0.125 * world.map().min_element()))
            .collect();
        original.reset_to(&starts).unwrap();
        let actions = |step: usize| -> Vec<f32> {
            (0..teams * leaders * 2).map(|index| ((index * 31 + step * 17) % 19) as f32 / 9.0 - 1.0).collect()
        };
        for step in 0..world.steps() / 2 {
            original.step(&actions(step)).unwrap();
        }
        // Teams at different steps.
        let chosen: Vec<bool> = (0..teams).map(|team| team % 4 == 1).collect();
        original.reset_some(&chosen, None).unwrap();
        original.step(&actions(99)).unwrap();
        let state = original.save();
        for (level, large_from) in ways_to_step() {
            let (mut restored, mut reference) = (make(level, large_from), make(Level::new(), usize::MAX));
            // What it did before does not matter.
            (0..world.steps()).for_each(|step| restored.step(&actions(step + 7)).unwrap());
            restored.restore(&state).unwrap();
            reference.restore(&state).unwrap();
            assert_eq!(restored.save(), state, "world {seed}");
            for step in 0..world.steps() + 2 {
                let results = |stepper: &mut Stepper| {
                    let states = stepper.states();
                    let bits = [states.positions, states.headings, states.speeds].concat();
                    let bits: Vec<u32> = bits.iter().chain(stepper.inputs()).map(|number| number.to_bits()).collect();
                    let counts =
                        (stepper.agents_at_poi().to_vec(), stepper.observed().to_vec(), stepper.steps().to_vec());
                    (
                        bits,
                        counts,
                        stepper.newly_observed().to_vec(),
                        (0..teams).map(|t| stepper.scores(t)).collect::<Vec<_>>(),
                    )
                };
                assert_eq!(results(&mut restored), results(&mut reference), "world {seed} step {step}");
                restored.step(&actions(step)).unwrap();
                reference.step(&actions(step)).unwrap();
            }
        }
        // The stepper that was never restored continues with the same bits.
        let mut inputs: Vec<Vec<u32>> = vec![];
        let mut restored = make(Level::new(), usize::MAX);
        restored.restore(&state).unwrap();
        for stepper in [&mut original, &mut restored] {
            (0..world.steps()).for_each(|step| stepper.step(&actions(step)).unwrap());
            inputs.push(stepper.inputs().iter().map(|input| input.to_bits()).collect());
        }
        assert_eq!(inputs[0], inputs[1], "world {seed}");
    }
}

/// A POI is gone in the teams in which an agent has passed it, until they are reset. Saved states keep that.
#[test]
fn a_poi_that_is_gone_stays_so_in_a_saved_state() {
    let text = "[world]\nsteps = 20\ndt = 1\n[[agents]]\nname = \"a\"\nat = [[10, 10]]\n\
                motion = { kind = \"free\", max_speed = 1 }\n\
                senses = [{ of = \"pois\", sectors = 1, measure = \"closeness\", range = 50 }]\n\
                [[pois]]\nname = \"p\"\nat = [[13, 10]]\ncoupling = 1\ngone_within = 1.5\n";
    let world = World::new(&Config::parse(text, "x.toml").unwrap().validate().unwrap());
    for (level, large_from) in ways_to_step() {
        let make = || Stepper::at_level(level, large_from, world.clone(), 3, Recording::SetsAndSights).unwrap();
        let mut stepper = make();
        let senses = |stepper: &Stepper| stepper.inputs().iter().map(|&input| input > 0.0).collect::<Vec<_>>();
        // The second team stays, and the others pass the POI.
        let actions = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0];
        let mut seen = vec![];
        for _ in 0..6 {
            seen.push(senses(&stepper));
            stepper.step(&actions).unwrap();
        }
        assert_eq!(
            seen,
            [
                [true; 3],
                [true; 3],
                [false, true, false],
                [false, true, false],
                [false, true, false],
                [false, true, false]
            ]
        );
        let mut restored = make();
        restored.restore(&stepper.save()).unwrap();
        assert_eq!((senses(&restored), restored.save()), (vec![false, true, false], stepper.save()));
        restored.reset_some(&[true, false, false], None).unwrap();
        assert_eq!(senses(&restored), [true, true, false]);
    }
}

#[test]
fn an_invalid_saved_state_is_refused_and_changes_nothing() {
    let world = World::new(&sample::world(1).validate().unwrap());
    let make = |teams| Stepper::new(world.clone(), teams, Recording::SetsAndSights).unwrap();
    let mut stepper = make(3);
    stepper.step(&vec![0.5; 3 * world.leaders() * 2]).unwrap();
    let state = stepper.save();
    let refused = |stepper: &mut Stepper, state: &[u8]| {
        let before = stepper.save();
        assert!(matches!(stepper.restore(state), Err(StepError::State(_))), "{} bytes", state.len());
        assert_eq!(stepper.save(), before, "{} bytes", state.len());
    };
    for length in [0, 3, 20, 24, state.len() - 4, state.len() - 1] {
        refused(&mut stepper, &state[..length]);
    }
    refused(&mut stepper, &[&state[..], &[0; 4]].concat());
    refused(&mut Stepper::new(world.clone(), 3, Recording::None).unwrap(), &state);
    refused(&mut Stepper::new(world.clone(), 3, Recording::Sets).unwrap(), &state);
    refused(&mut make(4), &state);
    let mut scores = vec![0.0; 3 * world.leaders()];
    for (word, bits) in (0..state.len() / 4).flat_map(|word| [f32::NAN.to_bits(), u32::MAX].map(|bits| (word, bits))) {
        let mut damaged = state.clone();
        damaged[word * 4..word * 4 + 4].copy_from_slice(&bits.to_le_bytes());
        let before = stepper.save();
        match stepper.restore(&damaged) {
            Err(_) => assert_eq!(stepper.save(), before, "word {word}"),
            // Counts can have any bits, and sets any members, so some damage is accepted. Scores have to exist.
            Ok(()) => {
                (0..3).for_each(|team| drop(stepper.scores(team).unwrap()));
                stepper.fitness(Fitness::Dt, &mut scores).unwrap();
            }
        }
    }
    stepper.restore(&state).unwrap();
    assert_eq!(stepper.save(), state);
}

#[test]
fn each_team_can_have_its_own_pois() {
    let mut config = sample::world(2);
    let world = World::new(&config.validate().unwrap());
    let (teams, agents, pois) = (9, world.agents(), world.pois.len());
    let starts = Starts::Drawn { episodes: teams as u32, seed: 5, jitter: 1.0, poi_jitter: 3.0 };
    let drawn: Vec<Vec<Vec2>> = (0..teams).map(|team| starts.of(team, &world)).collect();
    let flat: Vec<f32> = drawn.iter().flatten().flat_map(|place| place.to_array()).collect();
    let mut together = Stepper::new(world.clone(), teams, Recording::None).unwrap();
    together.reset_to(&flat).unwrap();
    let actions = vec![0.75; world.leaders() * 2];
    for (team, places) in drawn.iter().enumerate() {
        // The same world with the POIs of this team.
        config.world.pois = places[agents..].iter().map(|place| place.as_dvec2().to_array()).collect();
        let mut alone = Stepper::new(World::new(&config.validate().unwrap()), 1, Recording::None).unwrap();
        let start: Vec<f32> = places[..agents].iter().flat_map(|place| place.to_array()).collect();
        alone.reset_to(&start).unwrap();
        together.reset_to(&flat).unwrap();
        assert_eq!(together.pois(team), &places[agents..]);
        for step in 0..world.steps() {
            let size = world.leaders() * 8;
            assert_eq!(&together.inputs()[team * size..][..size], alone.inputs(), "team {team} step {step}");
            together.step(&actions.repeat(teams)).unwrap();
            alone.step(&actions).unwrap();
            assert_eq!(&together.observed()[team * pois..][..pois], alone.observed());
        }
    }
    // A reset to the world's starts restores the world's POIs, for the chosen teams only.
    let chosen: Vec<bool> = (0..teams).map(|team| [0, 2].contains(&team)).collect();
    together.reset_some(&chosen, None).unwrap();
    assert_eq!((together.pois(0), together.pois(2)), (&world.pois[..], &world.pois[..]));
    assert_eq!((together.pois(1), together.pois(3)), (&drawn[1][agents..], &drawn[3][agents..]));
    together.reset();
    assert_eq!(together.pois(3), &world.pois[..]);
}
