//! Compares the kernels with a float64 model of a step, as described in docs/explain/model.md, on random worlds.
//!
//! The model starts every step from the kernels' state, because radii and quadrants amplify rounding errors within a
//! few steps.
//!
//! A step is borderline if a value is so close to a threshold that rounding may decide. Borderline steps are counted,
//! but not compared. If all operations before a threshold are exact, the step is compared, so that ties in a layout are
//! tested. A step is also borderline if its rounding errors exceed [`STATE`], because a policy may be steep and forces
//! may cancel.

use crate::support;
use std::f64::consts::PI;

use flotilla::backend::cpu::{Cpu, level_name};
use flotilla::backend::{Backend, Group, Moment, Trace};
use flotilla::config::{
    Actions, AgentClass, Channel, Combine, Config, Control, Coupling, Density, Fitness, Measure, Mobility, Paradigm,
    Sectors, own_populations,
};
use flotilla::evolve::aligned_teams;
use flotilla::sample;
use flotilla::stepping::{Recording, Stepper};
use flotilla::world::{GRID, World, on_grid};
use flotilla_cli::measure::with_agents;
use glam::{DVec2, Vec2};
use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};
use rayon::prelude::*;

/// Relative distance from a threshold below which rounding may decide.
const MARGIN: f64 = 3e-7;
/// Tolerance of positions, headings and speeds.
const STATE: f64 = 3e-5;
/// Tolerance of sensed densities, and of forces relative to the lengths of their parts.
const INPUT: f64 = 1e-5;
/// Tolerance of outputs for the same inputs, in addition to the rounding errors that the network amplifies.
const OUTPUT: f64 = 1e-5;

/// An offset between two points. `exact` is true if f32 gives the same offset and the same squared length.
struct Offset {
    r: DVec2,
    d: f64,
    exact: bool,
}

impl Offset {
    fn new(from: DVec2, to: DVec2) -> Offset {
        let r = to - from;
        let (x, y) = (r.x as f32, r.y as f32);
        let exact = DVec2::new(x.into(), y.into()) == r && f64::from(x * x + y * y) == r.x * r.x + r.y * r.y;
        Offset { r, d: (r.x * r.x + r.y * r.y).sqrt(), exact }
    }

    /// Returns d ≤ radius. Sets `borderline` if f32 may give another answer.
    fn within(&self, radius: f64, borderline: &mut bool) -> bool {
        let square = radius * radius;
        *borderline |= (self.d - radius).abs() < MARGIN * radius && !(self.exact && f64::from(square as f32) == square);
        self.d <= radius
    }
}

/// Returns the sum of two products. Sets `borderline` if its sign may differ in f32, where products and sum are
/// rounded.
fn signed_sum(a: f64, b: f64, borderline: &mut bool) -> f64 {
    *borderline |= a + b != 0.0 && (a + b).abs() < MARGIN * (a.abs() + b.abs()) && a != 0.0 && b != 0.0;
    a + b
}

/// Sum of the offsets to agents. `exact` is true if f32 gives the same sum.
#[derive(Default)]
struct Pull {
    sum: DVec2,
    /// The sum of the offsets' lengths, with what rounding them to the lattice may change.
    length: f64,
    count: u32,
    exact: bool,
}

impl Pull {
    fn new() -> Pull {
        Pull { exact: true, ..Pull::default() }
    }

    fn add(&mut self, offset: &Offset) {
        // On a wall, an agent may be between two points of the lattice.
        let grid = f64::from(GRID);
        let rounding = (offset.r - (offset.r * grid).round() / grid).length();
        self.sum += offset.r;
        self.length += offset.d + rounding / MARGIN;
        self.count += 1;
        self.exact &= rounding == 0.0 && self.sum.as_vec2().as_dvec2() == self.sum;
    }

    fn mean(&self) -> DVec2 {
        if self.count == 0 { DVec2::ZERO } else { self.sum / f64::from(self.count) }
    }
}

/// The force on a follower.
struct Force {
    s: DVec2,
    /// Sum of the lengths of all parts. Rounding errors of `s` are proportional to it.
    parts: f64,
    /// Whether another agent or a wall is in range.
    near: bool,
    /// Per axis, whether a zero of `s` is also zero in f32.
    sure_zero: [bool; 2],
    /// Whether `s` has a single part, from an exact sum. Rounding may change its length, but not its direction.
    plain: bool,
}

impl Force {
    /// Returns how far rounding may turn `s`, in radians. If parts cancel, their rounding errors remain.
    fn blur(&self) -> f64 {
        if self.plain || self.s == DVec2::ZERO { 0.0 } else { MARGIN * self.parts / self.s.length() }
    }
}

/// State of an agent.
#[derive(Clone, Copy)]
struct State {
    position: DVec2,
    heading: DVec2,
    speed: f64,
}

impl State {
    fn of(moment: &Moment) -> State {
        let vector = |v: [f32; 2]| Vec2::from(v).as_dvec2();
        State { position: vector(moment.position), heading: vector(moment.heading), speed: moment.speed.into() }
    }
}

struct Model {
    config: Config,
    leaders: usize,
    agents: usize,
    map: DVec2,
    pois: Vec<DVec2>,
    /// Positions of the POIs in the episode, if they differ from those of the world.
    moved: Option<Vec<DVec2>>,
}

impl Model {
    fn new(config: &Config) -> Model {
        let world = &config.world;
        let agents = world.leaders.len() + world.followers.len();
        let leaders = if config.learning.paradigm == Paradigm::AllLeaders { agents } else { world.leaders.len() };
        let single = |point: &[f64; 2]| DVec2::from(*point).as_vec2().as_dvec2();
        let map = single(&world.map).as_vec2();
        Model {
            moved: None,
            config: config.clone(),
            leaders,
            agents,
            map: single(&world.map),
            pois: world.pois.iter().map(|&poi| on_grid(single(&poi).as_vec2(), map).as_dvec2()).collect(),
        }
    }

    /// Part 1 of a step: returns what a leader senses.
    fn sense(&self, states: &[State], leader: usize, borderline: &mut bool) -> [f64; 8] {
        let sense = &self.config.sense;
        let here = states[leader];
        let diagonal = 2f64.sqrt() * self.map.max_element();
        let (mut inputs, mut counts) = ([0.0; 8], [0usize; 8]);
        let mut add_points = |first: usize, points: &[DVec2], range: f64, size: usize| {
            for &point in points {
                let offset = Offset::new(here.position, point);
                if !offset.within(range, borderline) {
                    continue;
                }
                let fx = signed_sum(here.heading.x * offset.r.x, here.heading.y * offset.r.y, borderline);
                let fy = signed_sum(here.heading.x * offset.r.y, -here.heading.y * offset.r.x, borderline);
                let left = fy > 0.0 || (fy == 0.0 && fx >= 0.0);
                let front = fx > 0.0 || (fx == 0.0 && fy <= 0.0);
                let quadrant = match (front, left) {
                    (false, false) => 0,
                    (true, false) => 1,
                    (true, true) => 2,
                    (false, true) => 3,
                };
                let value = match sense.density {
                    Density::Linear => 1.0 - offset.d / diagonal,
                    Density::Inverse | Density::Mean => 1.0 / offset.d.max(1.0),
                };
                let (input, count) = (&mut inputs[first + quadrant], &mut counts[first + quadrant]);
                *count += 1;
                match sense.density {
                    Density::Mean => *input += (value - *input) / *count as f64,
                    _ => *input += value / size as f64,
                }
            }
        };
        add_points(0, &self.pois, sense.poi_range, self.pois.len());
        let others = states.iter().enumerate().filter(|&(agent, _)| agent != leader).map(|(_, state)| state.position);
        add_points(4, &others.collect::<Vec<_>>(), sense.agent_range, self.agents);
        inputs
    }

    /// Part 2: returns the outputs of a leader's policy, each with a bound on the error of f32 if inputs differ by up
    /// to `error`.
    fn policy(&self, weights: &[f32], inputs: [f64; 8], error: f64) -> Vec<(f64, f64)> {
        let mut values: Vec<(f64, f64)> = inputs.map(|input| (input, error)).to_vec();
        let mut first = 0;
        for &width in self.config.policy.hidden.iter().chain(&[self.config.policy.actions.outputs()]) {
            let rows = values.len() + 1;
            let weight = |row: usize, column: usize| f64::from(weights[first + row * width + column]);
            values = (0..width)
                .map(|column| {
                    let bias = weight(rows - 1, column);
                    let (mut sum, mut size, mut error) = (bias, bias.abs(), 0.0);
                    for (row, (value, off)) in values.iter().enumerate() {
                        let weight = weight(row, column);
                        sum += weight * value;
                        size += (weight * value).abs();
                        error += weight.abs() * off;
                    }
                    error += 2e-7 * size;
                    let slope = 1.0 - (sum.abs() - error).max(0.0).tanh().powi(2);
                    (sum.tanh(), slope * error + 1e-6)
                })
                .collect();
            first += rows * width;
        }
        values
    }

    /// Part 2 if outputs choose a behaviour: returns the outputs of a direct policy for the same turn and speed.
    /// Returns None if f32 may choose another behaviour.
    fn choose(&self, weights: &[f32], inputs: [f64; 8]) -> Option<[f64; 2]> {
        let outputs = self.policy(weights, inputs, 0.0);
        let chosen = (0..5).fold(0, |best, index| if outputs[index].0 > outputs[best].0 { index } else { best });
        let is_certain = |other: usize| {
            other == chosen || outputs[chosen].0 - outputs[other].0 > OUTPUT + outputs[chosen].1 + outputs[other].1
        };
        if !(0..5).all(is_certain) {
            return None;
        }
        const MIDDLES: [f64; 4] = [-0.75, -0.25, 0.25, 0.75];
        let towards = |first: usize, opposite: usize| {
            let densities = &inputs[first..first + 4];
            let largest = densities.iter().copied().fold(0.0, f64::max);
            let quadrant = densities.iter().position(|&density| density == largest && largest > 0.0);
            [quadrant.map_or(0.0, |quadrant| MIDDLES[(quadrant + opposite) % 4]), 1.0]
        };
        Some(match chosen {
            0 => [0.0, -1.0],
            1 => towards(0, 0),
            2 => towards(0, 2),
            3 => towards(4, 0),
            _ => towards(4, 2),
        })
    }

    /// Part 4, first half: returns the force on a follower.
    fn force(&self, states: &[State], agent: usize, borderline: &mut bool) -> Force {
        let follow = &self.config.follow;
        let (mut repulsion, mut attraction) = (Pull::new(), Pull::new());
        for other in (0..self.agents).filter(|&other| other != agent) {
            let offset = Offset::new(states[agent].position, states[other].position);
            let (near, close) = (
                offset.within(follow.attraction_radius, borderline),
                offset.within(follow.repulsion_radius, borderline),
            );
            if close {
                repulsion.add(&offset);
            } else if near {
                attraction.add(&offset);
            }
        }
        let someone = repulsion.count + attraction.count > 0;
        let (mut push, mut wall) = (DVec2::ZERO, false);
        let (mut parts, radius) = (0.0, f64::from(follow.repulsion_radius as f32));
        for axis in 0..2 {
            let at = states[agent].position[axis];
            for (distance, away) in [(at, 1.0), (self.map[axis] - at, -1.0)] {
                let rounding = (f64::from(distance as f32) - distance).abs();
                // The push of a wall grows from 0. So rounding at its radius only matters if no agent is in range.
                *borderline |= !someone && (distance - radius).abs() < rounding;
                if distance <= radius {
                    wall = true;
                    push[axis] += away * follow.wall_gain * (radius - distance);
                    parts += follow.wall_gain * (radius - distance + rounding / MARGIN);
                }
            }
        }
        let repel = -repulsion.mean() / follow.repulsion_radius * follow.repulsion_gain;
        let attract = attraction.mean() / follow.attraction_radius * follow.attraction_gain;
        let size = |pull: &Pull, gain: f64, radius: f64| pull.length / f64::from(pull.count.max(1)) / radius * gain;
        parts += size(&repulsion, follow.repulsion_gain, follow.repulsion_radius)
            + size(&attraction, follow.attraction_gain, follow.attraction_radius);
        let exact =
            (repulsion.exact || follow.repulsion_gain == 0.0) && (attraction.exact || follow.attraction_gain == 0.0);
        let pulls = [repel, attract].iter().filter(|&&pull| pull != DVec2::ZERO).count();
        let zero = |axis: usize| exact && repel[axis] == 0.0 && attract[axis] == 0.0 && push[axis] == 0.0;
        Force {
            s: repel + attract + push,
            parts,
            near: someone || wall,
            sure_zero: [zero(0), zero(1)],
            plain: exact && pulls == 1 && push == DVec2::ZERO,
        }
    }

    /// Part 4, second half: returns the wanted change of heading and the wanted speed. None keeps both.
    fn follow(&self, state: &State, force: &Force, borderline: &mut bool) -> Option<(f64, f64)> {
        if !force.near {
            return None;
        }
        let Force { s, sure_zero, .. } = *force;
        let length = s.length();
        if length == 0.0 {
            *borderline |= !(sure_zero[0] && sure_zero[1]);
            return Some((0.0, 0.0));
        }
        let blur = force.blur();
        *borderline |= blur > 0.1;
        // If one term is exactly zero, the sum has the sign of the other, however small.
        let (mut zeros, mut signs) = ([false; 2], [false; 2]);
        for axis in 0..2 {
            zeros[axis] = s[axis] == 0.0 && sure_zero[axis];
            signs[axis] = zeros[axis] || s[axis].abs() > MARGIN * force.parts;
        }
        let (heading, unit) = (state.heading, s / length);
        let sure = |x: f64, y: f64| (x == 0.0 || zeros[0]) && signs[1] || (y == 0.0 || zeros[1]) && signs[0];
        let (dot, cross) = (heading.dot(unit), heading.perp_dot(unit));
        let close = |sum: f64, term: f64| sum.abs() < MARGIN * (term.abs() + (sum - term).abs()) + blur;
        *borderline |= close(dot, heading.x * unit.x) && !sure(heading.x, heading.y);
        let any_turn = self.config.motion.max_turn_rate * self.config.world.dt >= PI;
        *borderline |= !any_turn && dot < 0.0 && close(cross, heading.x * unit.y) && !sure(heading.y, heading.x);
        // A half turn is to the left, whatever the sign of the zero.
        let angle = if cross == 0.0 { 0f64.atan2(dot) } else { cross.atan2(dot) };
        Some((angle, if angle.abs() < PI / 2.0 && dot > 0.0 { length } else { self.config.motion.min_speed }))
    }

    /// Part 5: applies the proportional controller and its limits.
    fn step(&self, state: &State, turn: f64, wanted: f64) -> State {
        let (motion, dt) = (&self.config.motion, self.config.world.dt);
        let (max_turn, max_change) = (motion.max_turn_rate * dt, motion.max_acceleration * dt);
        let angle = state.heading.y.atan2(state.heading.x) + turn.clamp(-max_turn, max_turn);
        let heading = DVec2::new(angle.cos(), angle.sin());
        let speed = state.speed + (wanted - state.speed).clamp(-max_change, max_change);
        let speed = speed.clamp(motion.min_speed, motion.max_speed);
        let position = (state.position + heading * speed * dt).clamp(DVec2::ZERO, self.map);
        State { position, heading, speed }
    }
}

/// Numbers of comparisons, and the differences.
#[derive(Default)]
struct Tally {
    agent_steps: u64,
    borderline: u64,
    /// Agent-steps and borderline ones in worlds where leaders choose behaviours.
    choosing: [u64; 2],
    /// Number of choices of a behaviour that rounding may change.
    unchosen: u64,
    /// Largest differences of inputs, outputs, force, position, heading and speed.
    worst: [f64; 6],
    wrong: Vec<String>,
}

impl Tally {
    fn merge(mut self, other: Tally) -> Tally {
        self.agent_steps += other.agent_steps;
        self.borderline += other.borderline;
        self.choosing.iter_mut().zip(other.choosing).for_each(|(mine, theirs)| *mine += theirs);
        self.unchosen += other.unchosen;
        self.worst.iter_mut().zip(other.worst).for_each(|(mine, theirs)| *mine = mine.max(theirs));
        self.wrong.extend(other.wrong);
        self
    }

    /// Compares values of one stage with the model's. Returns the largest difference.
    fn compare(&mut self, stage: usize, actual: &[f32], expected: &[f64], tolerance: f64, place: &str) -> f64 {
        let mut largest = 0f64;
        for (&actual, &expected) in actual.iter().zip(expected) {
            let difference = (f64::from(actual) - expected).abs();
            let agrees = difference <= tolerance; // a NaN does not
            if !agrees {
                let name = ["input", "output", "force", "position", "heading", "speed"][stage];
                self.wrong.push(format!("{place}: {name} {actual}, expected {expected} within {tolerance:e}"));
            }
            largest = largest.max(difference);
        }
        self.worst[stage] = self.worst[stage].max(largest);
        largest
    }
}

/// Plays teams in a world, and compares every step of every agent with the model.
fn check(cpu: &mut Cpu, world: &Config, model: &Model, seed: u64) -> Tally {
    const TEAMS: usize = 9;
    let compiled = World::new(&world.validate().unwrap());
    let rng = &mut ChaCha8Rng::seed_from_u64(seed);
    let policies = 4;
    let weights = sample::weights(&compiled, policies, seed);
    let teams: Vec<u32> = (0..TEAMS * model.leaders).map(|_| rng.random_range(0..policies as u32)).collect();
    let jitter = if seed.is_multiple_of(4) { 0.5 } else { 0.0 };
    let starts: Vec<Vec2> = (compiled.starts.iter())
        .map(|start| start + Vec2::new(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0)) * jitter)
        .map(|start| on_grid(start, model.map.as_vec2()))
        .collect();
    // An episode may have POIs in other places than its world.
    let moved: Vec<Vec2> = model.moved.iter().flatten().map(|poi| poi.as_vec2()).collect();
    let places = [&starts[..], &moved].concat();
    let group = Group {
        starts: &places,
        populations: own_populations(compiled.leaders()),
        fitnesses: &[Fitness::Dt],
        ..Group::new(&compiled, &weights[..], policies, &teams)
    };
    let trace = cpu.trace(&group).unwrap();
    assert_eq!((trace.teams, trace.agents), (TEAMS, model.agents));
    let mut tally = Tally::default();
    for team in 0..TEAMS {
        let policy = |leader: usize| {
            let index = leader * policies + teams[team * model.leaders + leader] as usize;
            &weights[index * compiled.parameters()..][..compiled.parameters()]
        };
        check_team(&trace, model, team, policy, &starts, seed, &mut tally);
    }
    tally
}

fn check_team<'a>(
    trace: &Trace,
    model: &Model,
    team: usize,
    policy: impl Fn(usize) -> &'a [f32],
    starts: &[Vec2],
    seed: u64,
    tally: &mut Tally,
) {
    let Model { config, leaders, agents, .. } = model;
    let (leaders, agents, steps) = (*leaders, *agents, config.world.steps);
    let mut states: Vec<State> = (0..agents).map(|agent| State::of(trace.moment(0, team, agent))).collect();
    let headings = config.world.headings();
    for (agent, state) in states.iter().enumerate() {
        let rounded = |component: f64| if component.abs() < 1e-6 { 0.0 } else { f64::from(component as f32) };
        assert_eq!(state.position, starts[agent].as_dvec2());
        let heading = DVec2::new(headings[agent].cos(), headings[agent].sin());
        assert_eq!(state.heading, DVec2::new(rounded(heading.x), rounded(heading.y)));
        assert_eq!(state.speed, f64::from(config.world.speed as f32));
    }
    // Smallest and largest possible number of steps in which each follower sees each leader. Borderline steps make them
    // differ.
    let mut seen = vec![(0, 0); (agents - leaders) * leaders];
    for step in 1..=steps {
        let moments: Vec<&Moment> = (0..agents).map(|agent| trace.moment(step, team, agent)).collect();
        for agent in 0..agents {
            let (actual, place) = (moments[agent], format!("seed {seed} team {team} step {step} agent {agent}"));
            let mut borderline = false;
            let slack;
            let wanted = if agent < leaders {
                let found: [f32; 8] = trace.inputs_of(step, team, agent).try_into().expect("8 inputs");
                let mut inputs = model.sense(&states, agent, &mut borderline);
                if borderline {
                    inputs = found.map(f64::from);
                } else {
                    tally.compare(0, &found, &inputs, INPUT, &place);
                }
                let sensed = found.map(f64::from);
                let wanted = if config.policy.actions == Actions::Behaviours {
                    let chosen = model.choose(policy(agent), sensed);
                    match chosen {
                        Some(expected) => _ = tally.compare(1, &actual.outputs, &expected, 0.0, &place),
                        None => tally.unchosen += 1,
                    }
                    chosen.unwrap_or(actual.outputs.map(f64::from)).map(|output| (output, 1e-6))
                } else {
                    let outputs = model.policy(policy(agent), sensed, 0.0);
                    for (actual, (expected, error)) in actual.outputs.iter().zip(outputs) {
                        tally.compare(1, &[*actual], &[expected], OUTPUT + error, &place);
                    }
                    let outputs = model.policy(policy(agent), inputs, 1e-6);
                    [outputs[0], outputs[1]]
                };
                let [(turn, turn_error), (speed, speed_error)] = wanted;
                slack = (PI * turn_error, speed_error * config.motion.max_speed / 2.0);
                Some((PI * turn, (speed + 1.0) / 2.0 * config.motion.max_speed))
            } else {
                let force = model.force(&states, agent, &mut borderline);
                if !borderline {
                    let expected = if force.near { force.s } else { DVec2::ZERO };
                    tally.compare(2, &actual.force, &expected.to_array(), INPUT * (1.0 + force.parts), &place);
                }
                for leader in 0..leaders {
                    let mut tie = false;
                    let offset = Offset::new(states[agent].position, states[leader].position);
                    let near = offset.within(config.follow.attraction_radius, &mut tie);
                    let (least, most) = &mut seen[(agent - leaders) * leaders + leader];
                    *least += (near && !tie) as u32;
                    *most += (near || tie) as u32;
                    let words = leaders.div_ceil(32);
                    let row = (team * steps + step - 1) * (agents - leaders) + agent - leaders;
                    let sees = trace.trail[row * words + leader / 32] >> (leader % 32) & 1 == 1;
                    if sees != near && !tie {
                        tally.wrong.push(format!("{place}: sees leader {leader} {sees}, expected {near}"));
                    }
                }
                slack = (force.blur(), MARGIN * force.parts);
                model.follow(&states[agent], &force, &mut borderline)
            };
            let kept = states[agent];
            let expected = match wanted {
                Some((turn, speed)) => model.step(&kept, turn, speed),
                None => model.step(&kept, 0.0, kept.speed),
            };
            if agent < leaders || !borderline {
                let heading = expected.heading.to_array();
                let moved = config.world.dt * (slack.0 * config.motion.max_speed + slack.1);
                let position = expected.position.to_array();
                let largest = tally.compare(3, &actual.position, &position, STATE + moved, &place);
                let largest = largest.max(tally.compare(4, &actual.heading, &heading, STATE + slack.0, &place));
                let largest =
                    largest.max(tally.compare(5, &[actual.speed], &[expected.speed], STATE + slack.1, &place));
                borderline |= largest > STATE;
            }
            let after = State::of(actual);
            for (poi, &point) in model.pois.iter().enumerate() {
                let mut tie = false;
                let near = Offset::new(after.position, point).within(config.world.observation_radius, &mut tie);
                let words = agents.div_ceil(32);
                let set = (team * steps + step - 1) * model.pois.len() + poi;
                let actual = trace.sets[set * words + agent / 32] >> (agent % 32) & 1 == 1;
                if actual != near && !tie {
                    tally.wrong.push(format!("{place}: near POI {poi} {actual}, expected {near}"));
                }
                borderline |= tie;
            }
            tally.agent_steps += 1;
            tally.borderline += borderline as u64;
        }
        states = moments.into_iter().map(State::of).collect();
    }
    let actual = &trace.seen[team * seen.len()..][..seen.len()];
    for (index, (&actual, &(least, most))) in actual.iter().zip(&seen).enumerate() {
        if !(least..=most).contains(&actual) {
            tally.wrong.push(format!("seed {seed} team {team}: seen {index} {actual}, expected {least} to {most}"));
        }
    }
}

#[test]
fn kernels_follow_the_model() {
    let tally = (0..400u64)
        .into_par_iter()
        .map_init(Cpu::default, |cpu, seed| {
            let config = sample::world(seed);
            let mut model = Model::new(&config);
            if seed % 3 == 0 {
                // Moves every POI to the place of another, and the last one to the first leader's start.
                model.pois.rotate_left(1);
                *model.pois.last_mut().unwrap() = World::new(&config.validate().unwrap()).starts[0].as_dvec2();
                model.moved = Some(model.pois.clone());
            }
            let tally = check(cpu, &config, &model, seed);
            let counts = [tally.agent_steps, tally.borderline];
            let chooses = config.policy.actions == Actions::Behaviours;
            Tally { choosing: if chooses { counts } else { [0; 2] }, ..tally }
        })
        .reduce(Tally::default, Tally::merge);
    let Tally { agent_steps, borderline, choosing, unchosen, worst, wrong } = tally;
    println!(
        "{agent_steps} agent-steps, {borderline} borderline ({choosing:?} where behaviours are chosen), \
         {unchosen} open choices, worst differences {worst:?}"
    );
    assert!(wrong.is_empty(), "{} differences, the first:\n{}", wrong.len(), wrong[..wrong.len().min(10)].join("\n"));
    assert!(agent_steps >= 1_000_000, "{agent_steps} agent-steps");
    // Leaders that choose among few turns often reach symmetric positions, which are ties.
    let direct = [agent_steps - choosing[0], borderline - choosing[1]];
    for ([steps, borderline], rarely) in [(direct, 1000), (choosing, 50)] {
        assert!(steps > 10_000 && borderline * rarely < steps, "{borderline} of {steps} agent-steps are borderline");
    }
    // Open choices are frequent, because large weights saturate several outputs at 1.
    assert!(unchosen * 20 < agent_steps, "{unchosen} of {agent_steps} agent-steps are open choices");
}

/// Tests ties between outputs and between quadrants, and leaders that sense nothing.
#[test]
fn ties_between_behaviours_or_quadrants_go_to_the_first() {
    // A leader in the middle faces up. POIs are in all quadrants but the last. The other leader is out of range.
    let text = "[world]
leaders = [[25, 25], [1, 1]]
pois = [[30, 20], [30, 30], [20, 30]]
coupling = 1
[policy]
hidden = []
actions = 'behaviours'";
    let (front_right, back_right) = ([-0.25, 1.0], [-0.75, 1.0]);
    let cases: [(&[usize], [f32; 2]); 8] = [
        (&[0], [0.0, -1.0]),
        (&[1], back_right),
        (&[2], [0.25, 1.0]),
        // No agent is in range: straight ahead.
        (&[3], [0.0, 1.0]),
        (&[4], [0.0, 1.0]),
        (&[1, 2, 4], back_right),
        (&[3, 4], [0.0, 1.0]),
        (&[0, 1, 2, 3, 4], [0.0, -1.0]),
    ];
    let config = Config::parse(text, "choice").unwrap();
    let world = World::new(&config.validate().unwrap());
    for (largest, expected) in cases {
        let mut weights = vec![0.0; world.parameters()];
        let biases = weights.len() - 5;
        largest.iter().for_each(|&behaviour| weights[biases + behaviour] = 0.5);
        let (weights, teams) = (weights.repeat(2), [0, 0]);
        let group = Group::new(&world, &weights[..], 1, &teams);
        for level in Cpu::levels() {
            let trace = Cpu::at_level(level).trace(&group).unwrap();
            assert_eq!(trace.moment(1, 0, 0).outputs, expected, "{largest:?}, {}", level_name(level));
        }
    }
    // Without the POI in the back right, the first of two equally dense quadrants is the front right.
    let two_pois = Config::parse(&text.replace("[30, 20], ", ""), "choice").unwrap();
    let world = World::new(&two_pois.validate().unwrap());
    let mut weights = vec![0.0; world.parameters() * 2];
    let biases = world.parameters() - 5;
    weights[biases + 1] = 0.5;
    let group = Group::new(&world, &weights[..], 1, &[0, 0]);
    let trace = Cpu::default().trace(&group).unwrap();
    assert_eq!(trace.moment(1, 0, 0).outputs, front_right);
    let inputs = trace.inputs_of(1, 0, 0);
    assert_eq!(inputs[0], 0.0);
    assert_eq!(inputs[1], inputs[2]);
}

/// Compares worlds of more than 32 agents, whose pairs are found with bounds. Sizes are around multiples of words and
/// vectors.
#[test]
fn crowds_follow_the_model() {
    let layout = support::layout("generally_forward");
    for agents in [33, 63, 64, 65, 127, 130] {
        let mut config = with_agents(&layout, agents).unwrap();
        config.world.steps = 8;
        for agent_range in [4.0, f64::INFINITY] {
            config.sense.agent_range = agent_range;
            for level in Cpu::levels() {
                let tally = check(&mut Cpu::at_level(level), &config, &Model::new(&config), agents as u64);
                let Tally { agent_steps, borderline, wrong, .. } = tally;
                let crowd = format!("{agents} agents, range {agent_range}, {}", level_name(level));
                assert!(wrong.is_empty(), "{crowd}: {} differences, the first: {}", wrong.len(), wrong[0]);
                assert!(borderline * 20 < agent_steps, "{crowd}: {borderline} of {agent_steps} are borderline");
            }
        }
    }
}

/// Tests that the comparison can fail: it must detect a model with one slightly changed constant.
#[test]
fn a_wrong_model_is_detected() {
    type Edit = fn(&mut Config);
    let edits: [(&str, Edit); 14] = [
        ("map", |c| c.world.map = c.world.map.map(|side| side * 0.999)),
        ("observation radius", |c| c.world.observation_radius *= 1.01),
        ("dt", |c| c.world.dt *= 1.001),
        ("min speed", |c| c.motion.min_speed += 0.001),
        ("max speed", |c| c.motion.max_speed *= 1.001),
        ("acceleration", |c| c.motion.max_acceleration *= 1.001),
        ("turn rate", |c| c.motion.max_turn_rate *= 1.001),
        ("attraction radius", |c| c.follow.attraction_radius *= 1.001),
        ("repulsion radius", |c| c.follow.repulsion_radius *= 0.999),
        ("attraction gain", |c| c.follow.attraction_gain *= 1.001),
        ("repulsion gain", |c| c.follow.repulsion_gain *= 1.001),
        ("wall gain", |c| c.follow.wall_gain *= 1.001),
        ("POI range", |c| c.sense.poi_range *= 1.01),
        ("agent range", |c| c.sense.agent_range *= 1.01),
    ];
    let mut cpu = Cpu::default();
    for (name, edit) in edits {
        let detected = (0..60u64).any(|seed| {
            let config = sample::world(seed);
            let mut edited = config.clone();
            edit(&mut edited);
            !check(&mut cpu, &config, &Model::new(&edited), seed).wrong.is_empty()
        });
        assert!(detected, "{name}");
    }
}

/// Tests that the random worlds cover every kind of config.
#[test]
fn random_worlds_cover_every_kind() {
    let worlds: Vec<Config> = (0..100).map(sample::world).collect();
    let at_least_three = |kind: fn(&Config) -> bool| worlds.iter().filter(|&world| kind(world)).count() >= 3;
    let agents = |c: &Config| c.world.leaders.len() + c.world.followers.len();
    let sizes: Vec<usize> = worlds.iter().map(agents).collect();
    assert!(sizes.contains(&1) && sizes.iter().any(|&size| size > 32) && sizes.iter().all(|&size| size <= 40));
    assert!(at_least_three(|c| c.learning.paradigm == Paradigm::AllLeaders));
    assert!(at_least_three(|c| c.learning.paradigm == Paradigm::LeaderFollower && !c.world.followers.is_empty()));
    assert!(at_least_three(|c| c.world.followers.is_empty()));
    assert!(
        at_least_three(|c| c.sense.density == Density::Linear)
            && at_least_three(|c| c.sense.density == Density::Inverse)
            && at_least_three(|c| c.sense.density == Density::Mean)
    );
    assert!(
        at_least_three(|c| c.sense.poi_range.is_infinite()) && at_least_three(|c| c.sense.agent_range.is_infinite())
    );
    assert!(at_least_three(|c| matches!(c.world.coupling, Coupling::Each(_))));
    for layers in [0, 1, 2, 3] {
        assert!(worlds.iter().any(|c| c.policy.hidden.len() == layers), "{layers} hidden layers");
    }
    assert!(
        at_least_three(|c| c.motion.max_turn_rate == 0.0)
            && at_least_three(|c| c.motion.max_turn_rate * c.world.dt > PI)
    );
    assert!(at_least_three(|c| c.follow.attraction_gain == 0.0) && at_least_three(|c| c.follow.repulsion_gain == 0.0));
    let inside = |c: &Config| {
        let points = c.world.leaders.iter().chain(&c.world.followers).chain(&c.world.pois);
        points.into_iter().all(|p| (0.0..=c.world.map[0]).contains(&p[0]) && (0.0..=c.world.map[1]).contains(&p[1]))
    };
    assert!(worlds.iter().all(inside));
    for world in &worlds {
        assert_eq!(Config::parse(&world.to_toml(), "sample").unwrap(), *world);
    }
}

/// A random world with classes, and the class of each of its agents.
struct Described {
    config: Config,
    class_of: Vec<usize>,
}

impl Described {
    fn class(&self, agent: usize) -> &AgentClass {
        &self.config.agents[self.class_of[agent]]
    }

    /// Returns the agents of a class other than this one.
    fn others(&self, class: &str, agent: usize) -> impl Iterator<Item = usize> {
        (0..self.class_of.len()).filter(move |&other| other != agent && self.class(other).name == class)
    }

    /// Returns the offset to the nearest agent of a class within a radius, the first of equals.
    fn nearest(
        &self,
        states: &[State],
        agent: usize,
        class: &str,
        radius: f64,
        borderline: &mut bool,
    ) -> Option<DVec2> {
        let mut best: Option<Offset> = None;
        for other in self.others(class, agent) {
            let offset = Offset::new(states[agent].position, states[other].position);
            if !offset.within(radius, borderline) {
                continue;
            }
            let Some(found) = &best else {
                best = Some(offset);
                continue;
            };
            *borderline |= (offset.d - found.d).abs() < MARGIN * found.d && !(offset.exact && found.exact);
            if offset.d < found.d {
                best = Some(offset);
            }
        }
        best.map(|found| found.r)
    }

    /// Returns the state after a step towards an agent at an offset.
    fn moved(&self, state: &State, class: &AgentClass, offset: DVec2, borderline: &mut bool) -> State {
        let (world, length) = (&self.config.world, offset.length());
        let most = class.motion.max_speed();
        let velocity = if length == 0.0 { DVec2::ZERO } else { offset * (1.0 / world.dt).min(most / length) };
        let [x0, y0, x1, y1] = class.stays_in.unwrap_or([0.0, 0.0, world.map[0], world.map[1]]);
        let place = |position: DVec2| position.clamp(DVec2::new(x0, y0), DVec2::new(x1, y1));
        let Mobility::Steered(motion) = &class.motion else {
            return State { position: place(state.position + velocity * world.dt), ..*state };
        };
        let (dot, cross) = (state.heading.dot(velocity), state.heading.perp_dot(velocity));
        let (angle, ahead) = (if velocity == DVec2::ZERO { 0.0 } else { cross.atan2(dot) }, velocity.length());
        // Rounding may change the side to which it turns, or whether the agent is ahead.
        *borderline |= ahead > 0.0 && (dot < 0.0 && cross.abs() < 1e-3 * ahead || dot.abs() < 1e-5 * ahead);
        let wanted = if dot > 0.0 || ahead == 0.0 { ahead } else { motion.min_speed };
        let (max_turn, max_change) = (motion.max_turn_rate * world.dt, motion.max_acceleration * world.dt);
        let angle = state.heading.to_angle() + angle.clamp(-max_turn, max_turn);
        let speed = state.speed + (wanted - state.speed).clamp(-max_change, max_change);
        let speed = speed.clamp(motion.min_speed, motion.max_speed);
        let heading = DVec2::from_angle(angle);
        State { position: place(state.position + heading * speed * world.dt), heading, speed }
    }

    /// Returns the first of the largest outputs of a policy, unless rounding may decide.
    fn choice(&self, weights: &[f32], inputs: &[f32], choices: usize) -> Option<usize> {
        let mut values: Vec<f64> = inputs.iter().map(|&input| input.into()).collect();
        let mut first = 0;
        for widths in self.config.widths().windows(2) {
            let weight = |row: usize, column: usize| f64::from(weights[first + row * widths[1] + column]);
            let unit = |column: usize| {
                let inputs = values.iter().enumerate().map(|(row, value)| value * weight(row, column));
                (inputs.sum::<f64>() + weight(widths[0], column)).tanh()
            };
            values = (0..widths[1]).map(unit).collect();
            first += (widths[0] + 1) * widths[1];
        }
        let outputs = &values[..=choices];
        let best = (0..=choices).fold(0, |best, index| if outputs[index] > outputs[best] { index } else { best });
        let is_certain = |other: usize| other == best || outputs[best] - outputs[other] > 1e-3;
        (0..=choices).all(is_certain).then_some(best)
    }

    /// Notes the POIs that are gone because an observer is near now, and those of which rounding may decide it.
    fn find_gone(&self, world: &World, states: &[State], found: &mut [(bool, bool)]) {
        let classes = self.config.classes();
        for ((poi, group), (gone, open)) in classes.group_of_each().into_iter().enumerate().zip(found) {
            let within = classes.pois[group].gone_within;
            let observes = |&agent: &usize| within > 0.0 && classes.observes(self.class_of[agent], group);
            for agent in (0..states.len()).filter(observes) {
                let mut borderline = false;
                let offset = Offset::new(states[agent].position, world.pois[poi].as_dvec2());
                *gone |= offset.within(within, &mut borderline) && !borderline;
                *open |= borderline;
            }
        }
    }

    /// Returns the inputs of a channel that has a sector of each agent or POI, and what rounding may change. `gone` is
    /// what [`Described::find_gone`] found.
    fn sensed(
        &self,
        world: &World,
        channel: &Channel,
        states: &[State],
        gone: &[(bool, bool)],
        agent: usize,
    ) -> Vec<(f64, bool)> {
        let names = |of: &str| channel.of.iter().any(|name| name == of);
        let groups = self.config.classes().group_of_each();
        let group = |poi: usize| &self.config.pois[groups[poi]];
        // Where it is, its value, whether it is sensed in range, and whether rounding may change that.
        let entities: Vec<(DVec2, f64, bool, bool)> = match names("pois") {
            true => (0..world.pois.len())
                .filter(|&poi| channel.pois.is_empty() || channel.pois.contains(&group(poi).name))
                .map(|poi| (world.pois[poi].as_dvec2(), group(poi).value, !gone[poi].0, gone[poi].1))
                .collect(),
            false => (0..states.len())
                .filter(|&other| names("agents") || names(&self.class(other).name))
                .map(|other| (states[other].position, 1.0, other != agent, false))
                .collect(),
        };
        let map = self.config.world.map;
        let share = if channel.combine == Combine::Share { entities.len() as f64 } else { 1.0 };
        let input = |&(place, value, counts, open): &(DVec2, f64, bool, bool)| {
            let mut borderline = false;
            let offset = Offset::new(states[agent].position, place);
            if !(counts && channel.range > 0.0 && offset.within(channel.range, &mut borderline)) {
                return (channel.empty, (borderline || open) && counts);
            }
            borderline |= open;
            let near = offset.d.max(channel.nearest);
            let measure = match channel.measure {
                Measure::Linear => 1.0 - offset.d / (2f64.sqrt() * map[0].max(map[1])),
                Measure::Inverse => 1.0 / near,
                Measure::InverseSquared => 1.0 / (near * near),
                Measure::Exponential => (-offset.d).exp(),
                Measure::Distance => offset.d / channel.range,
                Measure::Closeness => 1.0 - offset.d / channel.range,
            };
            (channel.gain * value * measure / share, borderline)
        };
        entities.iter().map(input).collect()
    }
}

/// Compares every step of random worlds with what the keys say: who is nearest or chosen and how an agent moves to it, who
/// stays where it is, what a channel senses of each, when POIs are gone, and that no agent leaves its box.
#[test]
fn agents_move_to_others_and_sense_each_as_described() {
    const TEAMS: usize = 5;
    // To the nearest, to nobody, to a chosen one; inputs, in boxes, and steps at which nobody was near; inputs of POIs when
    // some were gone. Borderline.
    let (mut counts, mut borderlines, mut wrong) = ([0; 7], 0, vec![]);
    for seed in (1..600u64).step_by(2) {
        let config = sample::classes_world(seed);
        let world = World::new(&config.validate().unwrap());
        let described = Described { class_of: config.classes().class_of_each(), config };
        let (leaders, steps) = (world.leaders(), world.steps());
        let weights = sample::weights(&world, TEAMS, seed);
        let teams = aligned_teams(TEAMS, leaders);
        let populations = own_populations(leaders);
        let group = Group { populations, ..Group::new(&world, &weights[..], TEAMS, &teams) };
        let trace = Cpu::default().trace(&group).unwrap();
        let mut gone = vec![];
        for (team, step) in (0..TEAMS).flat_map(|team| (1..=steps).map(move |step| (team, step))) {
            let states: Vec<State> =
                (0..world.agents()).map(|agent| State::of(trace.moment(step - 1, team, agent))).collect();
            if step == 1 {
                gone = vec![(false, false); world.pois.len()];
            }
            described.find_gone(&world, &states, &mut gone);
            for (agent, state) in states.iter().enumerate() {
                let (class, moment) = (described.class(agent), trace.moment(step, team, agent));
                let (now, place) = (State::of(moment), format!("seed {seed} team {team} step {step} agent {agent}"));
                if let Some([x0, y0, x1, y1]) = class.stays_in {
                    let (x, y) = (now.position.x, now.position.y);
                    counts[3] += 1;
                    // Corners are rounded to f32 and to the grid.
                    let is_in = |at: f64, low: f64, high: f64| (low - 2e-5..=high + 2e-5).contains(&at);
                    if !is_in(x, x0, x1) || !is_in(y, y0, y1) {
                        wrong.push(format!("{place} is at ({x}, {y}), outside {:?}", class.stays_in));
                    }
                }
                let mut first = 0;
                for channel in &class.senses {
                    if let Sectors::Each(count) = channel.sectors {
                        let found = &trace.inputs_of(step, team, agent)[first..first + count];
                        let expected = described.sensed(&world, channel, &states, &gone, agent);
                        assert_eq!(expected.len(), count, "{place}");
                        for (found, (expected, borderline)) in found.iter().zip(expected) {
                            counts[4] += 1;
                            counts[6] += u32::from(channel.of == ["pois"] && gone.iter().any(|poi| poi.0));
                            let off = (f64::from(*found) - expected).abs();
                            if !borderline && off > INPUT * (1.0 + expected.abs()) {
                                wrong.push(format!("{place} senses {found}, expected {expected}"));
                            }
                        }
                    }
                    first += channel.sectors.count();
                }
                let mut borderline = false;
                if let Some(near) = &class.moves_near {
                    let names = |channel: &&Channel| channel.of.iter().any(|of| of == near || of == "agents");
                    let range = class.senses.iter().filter(names).map(|channel| channel.range).fold(0.0, f64::max);
                    let is_near = described.nearest(&states, agent, near, range, &mut borderline).is_some();
                    if !is_near && !borderline {
                        counts[5] += 1;
                        let kept =
                            (now.position, now.heading, now.speed) == (state.position, state.heading, state.speed);
                        if !kept {
                            wrong.push(format!("{place} moved with no {near} near"));
                        }
                        continue;
                    }
                }
                let offset = match &class.control {
                    Control::Nearest(target) => {
                        let radius = class.reach.unwrap_or(f64::INFINITY);
                        let offset = described.nearest(&states, agent, target, radius, &mut borderline);
                        counts[usize::from(offset.is_none())] += 1;
                        offset.unwrap_or_default()
                    }
                    Control::Choose(target) => {
                        let all: Vec<usize> =
                            (0..states.len()).filter(|&other| described.class(other).name == *target).collect();
                        let [action, other] = moment.outputs.map(f64::from);
                        let index = ((action + 1.0) / 2.0 * all.len() as f64).round();
                        let exact = index * 2.0 / all.len() as f64 - 1.0;
                        let policy = &weights[(agent * TEAMS + team) * world.parameters()..][..world.parameters()];
                        let expected = described.choice(policy, trace.inputs_of(step, team, agent), all.len());
                        if (action - exact).abs() > 1e-6
                            || other != 0.0
                            || expected.is_some_and(|of| of != index as usize)
                        {
                            wrong.push(format!("{place} chooses {action} {other}, expected {expected:?}"));
                        }
                        counts[2] += u32::from(expected.is_some());
                        all.get(index as usize).map_or(DVec2::ZERO, |&to| states[to].position - state.position)
                    }
                    _ => continue,
                };
                let expected = described.moved(state, class, offset, &mut borderline);
                borderlines += u32::from(borderline);
                let off = [expected.position - now.position, expected.heading - now.heading].map(DVec2::length);
                if !borderline && (off[0] > STATE || off[1] > STATE || (expected.speed - now.speed).abs() > STATE) {
                    wrong.push(format!("{place} moves by {:?}, off by {off:?}", now.position - state.position));
                }
            }
        }
    }
    println!("{counts:?}, {borderlines} borderline");
    assert!(wrong.is_empty(), "{} differences, the first:\n{}", wrong.len(), wrong[..wrong.len().min(10)].join("\n"));
    assert!(counts.iter().all(|&count| count > 2000) && borderlines * 5 < counts[0] + counts[2], "{counts:?}");
}

/// Ties go to the first agent, whether it is the nearest or chosen. An action between two choices is the nearest one.
#[test]
fn ties_between_agents_go_to_the_first() {
    let text = "
world = { map = [50, 50], steps = 1, dt = 1.0, pois = [[1, 1]], coupling = 1 }
policy = { hidden = [] }
[[agents]]
name = 'scout'
at = [[25, 25]]
control = 'choose:post'
motion = { kind = 'free', max_speed = 1 }
senses = [{ of = 'pois' }]
[[agents]]
name = 'post'
at = [[25, 29], [21, 25], [29, 25]]
control = 'still'
[[agents]]
name = 'rover'
at = [[25, 25], [25, 35], [25, 28.5]]
control = 'nearest:post'
reach = 4
motion = { kind = 'free', max_speed = 1 }
";
    let world = World::new(&Config::parse(text, "ties").unwrap().validate().unwrap());
    let play = |largest: &[usize]| {
        let mut weights = vec![0.0; world.parameters()];
        let biases = weights.len() - 4;
        largest.iter().for_each(|&output| weights[biases + output] = 0.5);
        let group = Group::new(&world, &weights[..], 1, &[0]);
        let trace = Cpu::default().trace(&group).unwrap();
        let of = |agent: usize| trace.moment(1, 0, agent).position;
        (trace.moment(1, 0, 0).outputs[0], of(0), [of(4), of(5), of(6)])
    };
    // The first rover is 4 from all three, the second is out of reach, and the third arrives.
    let rovers = [[25.0, 26.0], [25.0, 35.0], [25.0, 29.0]];
    assert_eq!(play(&[]), (-1.0, [25.0, 26.0], rovers));
    assert_eq!(play(&[1, 2]).1, [24.0, 25.0]);
    assert_eq!(play(&[2, 3]).1, [26.0, 25.0]);
    assert_eq!(play(&[3]), (1.0, [25.0, 25.0], rovers));
    let mut stepper = Stepper::new(world, 5, Recording::None).unwrap();
    stepper.step(&[-0.8, 0.0, -0.5, 0.9, 0.2, 0.0, 0.8, 0.0, 7.0, 0.0]).unwrap();
    let states = stepper.states();
    let found: Vec<&[f32]> = states.positions.chunks_exact(14).map(|team| &team[..2]).collect();
    assert_eq!(found, [[25.0, 26.0], [24.0, 25.0], [26.0, 25.0], [25.0, 25.0], [25.0, 25.0]]);
}
