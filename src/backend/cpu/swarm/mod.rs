//! Episodes of large teams, one team at a time: a vector has agents of one class, and a grid of cells finds those within
//! reach of each other.
//!
//! Every sum over agents is of integers, so that its order does not matter. The formulas are those of [`crate::model`], and
//! the bits are those of a vector of teams ([`super::block`]).

use std::ops::Range;

use fearless_simd::{Simd, prelude::*};
use glam::Vec2;

use super::agent::Agent;
use super::batch::WorldBatch;
use super::network::Network;
use super::together::{Observer, Together};
use super::{Moment, ScoreTable, StepArrays};
use crate::config::{Combine, ControlKind, Measure};
use crate::credit::Episode;
use crate::kernels::math::on_lattice;
use crate::kernels::{clamp_to, splat};
use crate::model::class::{Class, ClassLanes};
use crate::model::classes::MAX_SECTORS;
use crate::model::follow::{self, SteeringForce, Sum, TermLanes};
use crate::model::motion::MotionLanes;
use crate::model::sense::{self, ChannelLanes};
use crate::model::{self, Lanes, couple, motion, policy};
use crate::world::{GoneWithin, OUTPUTS, World};

mod cells;

use cells::{Cells, Slots};

/// The parts of a team's record besides the sets of agents at POIs.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) struct Recorded {
    /// The number of steps at which each follower saw each leader.
    pub counts: bool,
    /// The leaders that each follower saw at each step.
    pub sights: bool,
    /// The forces on followers.
    pub forces: bool,
}

/// One large team: its state, policies and record.
pub(crate) struct Swarm<S: Simd> {
    pub simd: S,
    /// The number of each lane.
    lanes: S::u32s,
    world: Lanes<S>,
    /// As in the world.
    constants: Vec<Class>,
    radii2: Vec<f32>,
    values: Vec<f32>,
    gone_within: Vec<GoneWithin>,
    recorded: Recorded,
    /// `[classes]`.
    plans: Vec<Plan>,
    cells: Vec<Cells>,
    /// The POI positions, `[pois]`, and whether they are gone.
    pois: Vec<Vec2>,
    gone: Vec<bool>,
    network: Network<S>,
    /// Inputs of the leaders' policies, `[vectors of leaders][inputs]`, and their outputs, `[vectors of leaders]`. A leader
    /// keeps its lane.
    inputs: Vec<S::f32s>,
    pub outputs: Vec<[S::f32s; OUTPUTS]>,
    /// The forces on followers at the last step, `[followers]`; empty unless recorded.
    forces: Vec<[f32; 2]>,
    /// The record, see [`Episode`]. Parts that are not recorded are empty.
    pub sets: Vec<u32>,
    counts: Vec<u32>,
    sights: Vec<u32>,
    paths: Vec<u32>,
}

/// The classes that the agents of a class look at.
struct Plan {
    /// Those that each channel senses, `[channels]`.
    channels: Vec<Vec<usize>>,
    /// Terms that are added together, see [`follow::rings`], and those that they count.
    terms: Vec<(Range<usize>, Vec<usize>)>,
}

impl Plan {
    fn new(world: &World, class: &Class) -> Plan {
        let of = |ranges: &model::Ranges| {
            let is_in = |agents: Range<usize>| {
                model::each(ranges).any(|run| run.start <= agents.start && agents.end <= run.end)
            };
            (0..world.classes.len()).filter(|&class| is_in(world.classes[class].agents())).collect::<Vec<_>>()
        };
        let terms = follow::rings(class.terms()).into_iter();
        Plan {
            channels: class.channels().iter().map(|channel| of(&channel.shape.ranges)).collect(),
            terms: terms.map(|ring| (ring.clone(), of(&class.terms()[ring.start].shape.ranges))).collect(),
        }
    }
}

/// Returns the bytes of the states and cells of so many agents.
pub(super) fn bytes(agents: usize) -> usize {
    // Two copies of six numbers, the cell of each, and about a cell per agent. Memory grows in larger steps.
    agents * (2 * 6 + 1 + 2) * size_of::<u32>()
}

impl<S: Simd> Swarm<S> {
    pub fn new(simd: S, world: &World, recorded: Recorded) -> Swarm<S> {
        let zero = splat(simd, 0.0);
        let (leaders, followers) = (world.leaders(), world.followers());
        let vectors = leaders.div_ceil(S::f32s::LEN);
        let zeros = |is_recorded: bool, words: usize| vec![0; if is_recorded { words } else { 0 }];
        let cells = |class: &Class| Cells::new(world, class, S::f32s::LEN);
        Swarm {
            simd,
            lanes: S::u32s::from_fn(simd, |lane| lane as u32),
            world: Lanes::new(simd, world.constants, &world.classes),
            constants: world.classes.clone(),
            radii2: world.radii2.clone(),
            values: world.values.clone(),
            gone_within: world.gone_within.clone(),
            recorded,
            plans: world.classes.iter().map(|class| Plan::new(world, class)).collect(),
            cells: world.classes.iter().map(cells).collect(),
            pois: world.pois.clone(),
            gone: vec![false; world.pois.len()],
            network: Network::new(simd, &world.constants.policy, vec![0; vectors], vec![world.inputs(); vectors]),
            inputs: vec![zero; vectors * world.inputs()],
            outputs: vec![[zero; OUTPUTS]; vectors],
            forces: vec![[0.0; 2]; if recorded.forces { followers } else { 0 }],
            sets: vec![0; world.set_words()],
            counts: zeros(recorded.counts, followers * leaders),
            sights: zeros(recorded.sights, world.sight_words()),
            paths: zeros(world.paths.is_some(), world.path_words()),
        }
    }

    /// Puts the agents at their start, with their headings, both `[agents]`, and the POIs into their places.
    pub fn start(&mut self, starts: &[Vec2], headings: &[Vec2], pois: &[Vec2]) {
        self.place(starts, headings, pois, |_, initial| initial);
        [&mut self.sets, &mut self.counts, &mut self.sights].into_iter().for_each(|record| record.fill(0));
        // Episodes may be scored before their end. Agents are then at no place at the moments that are left.
        self.paths.fill(f32::NAN.to_bits());
        self.record_positions(0);
    }

    /// Puts agents and POIs into their places. No POI is gone. `speed` returns the speed of an agent from its index and its
    /// initial speed.
    pub fn place(&mut self, places: &[Vec2], headings: &[Vec2], pois: &[Vec2], speed: impl Fn(usize, f32) -> f32) {
        self.pois.clear();
        self.pois.extend(pois);
        self.gone.fill(false);
        for (cells, class) in self.cells.iter_mut().zip(&self.constants) {
            cells.place(places, headings, |agent| speed(agent, class.constants.motion.speed));
        }
    }

    /// Returns whether each POI of [`GoneWithin`] is gone, all bits or none, `[gone_within]`.
    pub fn gone(&self) -> impl Iterator<Item = u32> {
        self.gone_within.iter().map(|of| if self.gone[of.poi] { u32::MAX } else { 0 })
    }

    /// Sets which POIs are gone, as [`Swarm::gone`] returns them.
    pub fn set_gone(&mut self, gone: &[u32]) {
        self.gone_within.iter().zip(gone).for_each(|(of, &gone)| self.gone[of.poi] = gone != 0);
    }

    /// Returns the sets and counts of the record, and its paths, or its sightings if it has no paths.
    pub fn record_mut(&mut self) -> [&mut [u32]; 3] {
        let Swarm { sets, counts, sights, paths, .. } = self;
        [sets, counts, if paths.is_empty() { sights } else { paths }]
    }

    /// Uses actions, `[leaders][2]`, as the policies' outputs.
    pub fn take(&mut self, actions: &[f32]) {
        for (leader, &action) in actions.as_chunks::<OUTPUTS>().0.iter().enumerate() {
            for (output, action) in self.outputs[leader / S::f32s::LEN].iter_mut().zip(action) {
                output[leader % S::f32s::LEN] = action.clamp(-1.0, 1.0);
            }
        }
    }

    /// Plays a step by the leaders' outputs, and records it.
    pub fn step(&mut self, step: usize) {
        self.simd.vectorize(
            #[inline(always)]
            || {
                self.record_sightings(step);
                for class in 0..self.cells.len() {
                    self.advance(class);
                }
                for (cells, class) in self.cells.iter_mut().zip(&self.constants) {
                    if class.constants.shape.control() != ControlKind::Still {
                        cells.sort();
                    }
                }
                self.record_poi_sets(step);
                self.record_positions(step + 1);
            },
        );
    }

    /// Returns the record of the team that was played.
    pub fn episode(&self) -> Episode<'_> {
        let (trail, pois) = match self.paths.is_empty() {
            true => (&self.sights, None),
            false => (&self.paths, Some(&*self.pois)),
        };
        Episode::whole(&self.sets, &self.counts, trail, pois)
    }

    /// Computes the inputs of the leaders' policies, channel by channel.
    pub fn sense(&mut self) {
        self.simd.vectorize(
            #[inline(always)]
            || {
                self.find_gone();
                self.sense_channels();
            },
        );
    }

    #[inline(always)]
    fn find_gone(&mut self) {
        let Swarm { simd, cells, pois, gone, gone_within, .. } = self;
        for GoneWithin { poi, distance2, classes } in gone_within {
            for &class in &*classes {
                each_within(
                    *simd,
                    &cells[class],
                    pois[*poi],
                    *distance2,
                    #[inline(always)]
                    |_| gone[*poi] = true,
                );
            }
        }
    }

    #[inline(always)]
    fn sense_channels(&mut self) {
        let mut inputs = std::mem::take(&mut self.inputs);
        for (index, class) in self.world.classes.iter().enumerate() {
            let cells = &self.cells[index];
            for (channel, of) in class.channels.iter().zip(&self.plans[index].channels) {
                let mut sense = |slots| self.sense_together(index, channel, of, slots, &mut inputs);
                // Agents that sense everything need not be near each other.
                if channel.shape.of_pois != 0 || channel.range2[0] >= self.diagonal2() {
                    for slot in (0..cells.len()).step_by(S::f32s::LEN) {
                        sense(slot..(slot + S::f32s::LEN).min(cells.len()));
                    }
                } else {
                    cells.each_group(S::f32s::LEN, sense);
                }
            }
        }
        self.inputs = inputs;
    }

    /// Writes the inputs of a channel of some agents of a class.
    fn sense_together(
        &self,
        class: usize,
        channel: &ChannelLanes<S>,
        of: &[usize],
        slots: Range<usize>,
        inputs: &mut [S::f32s],
    ) {
        let sensed = self.simd.vectorize(
            #[inline(always)]
            || self.sensed(class, channel, of, slots.clone()),
        );
        let width = self.world.constants.policy.inputs();
        for (lane, slot) in slots.enumerate() {
            let leader = self.cells[class].slots.agents[slot] as usize;
            let to = &mut inputs[leader / S::f32s::LEN * width + channel.shape.input as usize..];
            for (to, sensed) in to.iter_mut().zip(&sensed[..channel.shape.sectors as usize]) {
                to[leader % S::f32s::LEN] = sensed[lane];
            }
        }
    }

    fn diagonal2(&self) -> f32 {
        let map = &self.world.constants.map;
        map.map_x * map.map_x + map.map_y * map.map_y
    }

    /// Returns the inputs of a channel of some agents of a class, `[sectors]`.
    #[inline(always)]
    fn sensed(
        &self,
        class: usize,
        channel: &ChannelLanes<S>,
        of: &[usize],
        slots: Range<usize>,
    ) -> [S::f32s; MAX_SECTORS] {
        let (simd, own) = (self.simd, &self.cells[class]);
        let agent = own.load(simd, slots.start);
        let mut sensing = Sensing {
            channel,
            agent,
            heading: channel.heading(agent.hx, agent.hy),
            in_quadrants: channel.shape.is_in_quadrants(),
            quadrants: sense::Quadrants::new(simd),
            sectors: sense::Sectors::new(simd, Combine::of(channel.shape.combine)),
        };
        if channel.shape.of_pois != 0 {
            let all = S::mask32s::splat(simd, true);
            for poi in model::each(&channel.shape.ranges).flatten().filter(|&poi| !self.gone[poi]) {
                sensing.add(self.pois[poi], self.values[poi], all);
            }
        } else if channel.range2[0] >= 0.0 {
            let corners = own.corners(slots.clone());
            for &other in of {
                let cells = &self.cells[other];
                let own = if other == class { slots.clone() } else { 0..0 };
                cells.each_run(
                    corners,
                    channel.range2[0].sqrt(),
                    #[inline(always)]
                    |run| {
                        for slot in run {
                            let at = Vec2::new(cells.slots.x[slot], cells.slots.y[slot]);
                            sensing.add(at, 1.0, self.others(&own, slot));
                        }
                    },
                );
            }
        }
        sensing.inputs()
    }

    /// Returns the lanes of `own` slots that another slot is not.
    #[inline(always)]
    fn others(&self, own: &Range<usize>, slot: usize) -> S::mask32s {
        let lane = if own.contains(&slot) { slot - own.start } else { S::f32s::LEN };
        !self.lanes.simd_eq(S::u32s::splat(self.simd, lane as u32))
    }

    /// Moves the agents of a class, from the state before the step.
    #[inline(always)]
    fn advance(&mut self, index: usize) {
        if self.constants[index].constants.shape.control() == ControlKind::Still {
            return;
        }
        let leaders = self.world.constants.leaders as usize;
        let (mut next, mut forces) = (std::mem::take(&mut self.cells[index].next), std::mem::take(&mut self.forces));
        let (class, cells) = (&self.world.classes[index], &self.cells[index]);
        let learns = class.control().learns();
        cells.each_group(
            S::f32s::LEN,
            #[inline(always)]
            |slots| {
                let agents = &cells.slots.agents[slots.clone()];
                let agent = cells.load(self.simd, slots.start);
                let agent = if learns {
                    let mut output = [splat(self.simd, 0.0); OUTPUTS];
                    for (lane, &leader) in agents.iter().enumerate() {
                        let outputs = self.outputs[leader as usize / S::f32s::LEN];
                        for (to, from) in output.iter_mut().zip(outputs) {
                            to[lane] = from[leader as usize % S::f32s::LEN];
                        }
                    }
                    self.lead(class, agent, output)
                } else {
                    let force = self.force(index, slots.clone());
                    if !forces.is_empty() {
                        for (lane, &follower) in agents.iter().enumerate() {
                            forces[follower as usize - leaders] = [force.x[lane], force.y[lane]];
                        }
                    }
                    self.follow(class, agent, force)
                };
                // Lanes without an agent write to slots that the next group overwrites, or that are spare.
                next.agents[slots.clone()].copy_from_slice(agents);
                next.store(slots.start, agent);
            },
        );
        (self.cells[index].next, self.forces) = (next, forces);
    }

    /// Moves learners by their outputs.
    #[inline(always)]
    fn lead(&self, class: &ClassLanes<S>, agent: Agent<S>, [first, second]: [S::f32s; OUTPUTS]) -> Agent<S> {
        let motion = &class.constants.motion;
        if class.constants.shape.free != 0 {
            return self.drift(motion, agent, [first * motion.max_speed, second * motion.max_speed]);
        }
        let (hx, hy) = motion::turn::<S>(motion, agent.hx, agent.hy, policy::wanted_turn::<S>(first));
        self.drive(class, Agent { hx, hy, ..agent }, policy::wanted_speed::<S>(motion, second))
    }

    /// Moves followers by the force on them.
    #[inline(always)]
    fn follow(&self, class: &ClassLanes<S>, agent: Agent<S>, force: SteeringForce<S>) -> Agent<S> {
        let (shape, motion) = (&class.constants.shape, &class.constants.motion);
        if shape.free != 0 {
            let most = motion.max_speed;
            return self.drift(
                motion,
                agent,
                [clamp_to::<S>(force.x, -most, most), clamp_to::<S>(force.y, -most, most)],
            );
        }
        let (sizes, Agent { hx, hy, speed, .. }) = (follow::sizes::<S>(&force), agent);
        let (hx, hy, wanted) = match shape.by_sine != 0 {
            true => follow::steer::<S, true>(motion, &force, sizes, hx, hy, speed),
            false => follow::steer::<S, false>(motion, &force, sizes, hx, hy, speed),
        };
        self.drive(class, Agent { hx, hy, ..agent }, wanted)
    }

    /// Moves agents by velocities.
    #[inline(always)]
    fn drift(&self, motion: &MotionLanes<S>, agent: Agent<S>, [x, y]: [S::f32s; 2]) -> Agent<S> {
        let dt = self.world.map.dt;
        let x = motion::advance::<S>(agent.x, dt, x, [motion.low_x, motion.high_x]);
        let y = motion::advance::<S>(agent.y, dt, y, [motion.low_y, motion.high_y]);
        Agent { x, y, ..agent }
    }

    /// Moves agents along their headings.
    #[inline(always)]
    fn drive(&self, class: &ClassLanes<S>, agent: Agent<S>, wanted: S::f32s) -> Agent<S> {
        let motion = &class.constants.motion;
        let (hx, hy) = motion::renormalize::<S>(agent.hx, agent.hy);
        let speed = motion::accelerate::<S>(motion, agent.speed, wanted);
        let step = speed * self.world.map.dt;
        let x = motion::advance::<S>(agent.x, step, hx, [motion.low_x, motion.high_x]);
        let y = motion::advance::<S>(agent.y, step, hy, [motion.low_y, motion.high_y]);
        Agent { x, y, hx, hy, speed }
    }

    /// Returns the force on some followers of a class.
    #[inline(always)]
    fn force(&self, index: usize, slots: Range<usize>) -> SteeringForce<S> {
        let (class, cells) = (&self.world.classes[index], &self.cells[index]);
        let corners = cells.corners(slots.clone());
        let Agent { x, y, .. } = cells.load(self.simd, slots.start);
        let mut force = SteeringForce::none(self.simd);
        for (terms, of) in &self.plans[index].terms {
            let terms = &class.terms[terms.clone()];
            let attraction = Attraction { swarm: self, index, slots: slots.clone(), corners, x, y, terms, of };
            match (terms.len(), terms[0].shape.aligns != 0) {
                (1, true) => attraction.add::<1, true>(&mut force),
                (1, false) => attraction.add::<1, false>(&mut force),
                (_, true) => attraction.add::<2, true>(&mut force),
                (_, false) => attraction.add::<2, false>(&mut force),
            }
        }
        force.add_walls(&class.constants.rule, &class.constants.motion, x, y);
        force
    }

    /// Records which leaders each follower sees.
    #[inline(always)]
    fn record_sightings(&mut self, step: usize) {
        if !self.recorded.counts && !self.recorded.sights {
            return;
        }
        let Swarm { simd, constants, cells, counts, sights, .. } = self;
        let (leaders, followers) = (self.world.constants.leaders as usize, self.world.constants.followers as usize);
        let words = leaders.div_ceil(32);
        for (class, leading) in constants.iter().zip(&*cells).filter(|(class, _)| class.agents().start < leaders) {
            for slot in 0..leading.len() {
                let leader = leading.slots.agents[slot] as usize;
                let at = Vec2::new(leading.slots.x[slot], leading.slots.y[slot]);
                for (led, &influence2) in cells.iter().zip(&class.constants.influence2) {
                    if led.agents.start < leaders {
                        continue;
                    }
                    each_within(
                        *simd,
                        led,
                        at,
                        influence2,
                        #[inline(always)]
                        |agent| {
                            let follower = agent - leaders;
                            if let Some(count) = counts.get_mut(follower * leaders + leader) {
                                *count += 1;
                            }
                            if let Some(word) = sights.get_mut((step * followers + follower) * words + leader / 32) {
                                *word |= 1 << (leader % 32);
                            }
                        },
                    );
                }
            }
        }
    }

    /// Records the agents at each POI after a step. A restored team may play the step again.
    #[inline(always)]
    fn record_poi_sets(&mut self, step: usize) {
        let Swarm { simd, cells, pois, radii2, sets, .. } = self;
        let words = self.world.constants.words as usize;
        let sets = sets[step * pois.len() * words..].chunks_exact_mut(words);
        for ((&at, &radius2), set) in pois.iter().zip(&*radii2).zip(sets) {
            set.fill(0);
            for cells in &*cells {
                each_within(
                    *simd,
                    cells,
                    at,
                    radius2,
                    #[inline(always)]
                    |agent| set[agent / 32] |= 1 << (agent % 32),
                );
            }
        }
    }

    /// Records where the agents are, if scores need it.
    fn record_positions(&mut self, moment: usize) {
        let mut paths = std::mem::take(&mut self.paths);
        let width = paths.len() / (self.world.constants.steps as usize + 1);
        let to = &mut paths[moment * width..][..width];
        if !to.is_empty() {
            self.each_agent(|agent, cells, slot| {
                (to[agent * 2], to[agent * 2 + 1]) = (cells.slots.x[slot].to_bits(), cells.slots.y[slot].to_bits());
            });
        }
        self.paths = paths;
    }

    /// Calls `visit` with each agent, its class's cells and its slot.
    fn each_agent(&self, mut visit: impl FnMut(usize, &Cells, usize)) {
        for cells in &self.cells {
            (0..cells.len()).for_each(|slot| visit(cells.slots.agents[slot] as usize, cells, slot));
        }
    }

    /// Writes the positions, headings, `[agents][2]`, and speeds, `[agents]`. Empty arrays are not written.
    pub fn write_states(&self, positions: &mut [f32], headings: &mut [f32], speeds: &mut [f32]) {
        self.each_agent(|agent, cells, slot| {
            let slots = &cells.slots;
            if let Some(to) = positions.get_mut(agent * 2..agent * 2 + 2) {
                to.copy_from_slice(&[slots.x[slot], slots.y[slot]]);
            }
            if let Some(to) = headings.get_mut(agent * 2..agent * 2 + 2) {
                to.copy_from_slice(&[slots.hx[slot], slots.hy[slot]]);
            }
            if let Some(to) = speeds.get_mut(agent) {
                *to = slots.speed[slot];
            }
        });
    }

    /// Writes the leaders' inputs, `[leaders][inputs]`, or outputs, `[leaders][2]`.
    pub fn write_inputs(&self, to: &mut [f32]) {
        write_lanes::<S>(&self.inputs, self.world.constants.policy.inputs(), to);
    }
}

/// Returns row `row` of an array of `rows` rows, or nothing of an empty array.
fn part<T>(array: &mut [T], (row, rows): (usize, usize)) -> &mut [T] {
    let width = array.len() / rows;
    &mut array[row * width..][..width]
}

impl<S: Simd> Together<S> for Swarm<S> {
    const MAX_TEAMS: usize = 1;

    fn allocate(simd: S, batch: &WorldBatch<'_>, traced: bool) -> Swarm<S> {
        let recorded = Recorded { counts: batch.counted || traced, sights: batch.sighted, forces: traced };
        Swarm::new(simd, batch.world, recorded)
    }

    fn fits(&self, batch: &WorldBatch<'_>) -> bool {
        let world = batch.world;
        bytemuck::cast_slice::<_, u8>(&self.constants) == bytemuck::cast_slice::<_, u8>(&world.classes)
            && self.world.constants == world.constants
            && [&self.radii2, &self.values] == [&world.radii2, &world.values]
            && self.gone_within == world.gone_within
            && self.recorded == Recorded { counts: batch.counted, sights: batch.sighted, forces: false }
            && self.paths.is_empty() == world.paths.is_none()
    }

    #[inline(always)]
    fn play<O: Observer<S, Self>>(&mut self, batch: &WorldBatch<'_>, teams: Range<usize>, observer: &mut O) {
        let place = batch.locate(teams.start);
        let group = &batch.groups[place.0];
        let (leaders, steps) = (batch.world.leaders(), batch.world.steps());
        self.network.load_policies(
            #[inline(always)]
            |vector, lane| batch.policy((vector * S::f32s::LEN + lane).min(leaders - 1), place),
        );
        self.start(group.starts, group.headings(), group.pois());
        observer.started(self);
        for step in 0..steps {
            self.sense();
            self.network.decide(&self.inputs, &mut self.outputs);
            observer.decided(self, step);
            self.step(step);
            observer.moved(self, step);
        }
    }

    fn score(&mut self, batch: &WorldBatch<'_>, teams: Range<usize>, scores: &ScoreTable<'_>) {
        let (group, team) = batch.locate(teams.start);
        scores.score(batch.first + group, team, &self.episode());
    }

    fn episode_of<'a>(&'a self, _: &WorldBatch<'a>, _: usize) -> Episode<'a> {
        self.episode()
    }

    fn outputs(&mut self) -> &mut [[S::f32s; OUTPUTS]] {
        &mut self.outputs
    }

    fn outputs_at(leader: usize) -> (usize, usize) {
        (leader / S::f32s::LEN, leader % S::f32s::LEN)
    }

    fn moments(&self, _: usize, sensed: bool, moments: &mut [Moment], inputs: &mut [f32]) {
        let leaders = self.world.constants.leaders as usize;
        self.each_agent(|agent, cells, slot| {
            let (slots, moment) = (&cells.slots, &mut moments[agent]);
            if sensed && agent < leaders {
                moment.outputs = self.outputs[agent / S::f32s::LEN].map(|output| output[agent % S::f32s::LEN]);
            } else if sensed {
                moment.force = self.forces[agent - leaders];
            }
            moment.position = [slots.x[slot], slots.y[slot]];
            moment.heading = [slots.hx[slot], slots.hy[slot]];
            moment.speed = slots.speed[slot];
        });
        if sensed {
            self.write_inputs(inputs);
        }
    }

    fn store_states(&self, row: (usize, usize), arrays: &mut StepArrays<'_>) {
        let [positions, headings, speeds] =
            [&mut *arrays.positions, arrays.headings, arrays.speeds].map(|array| part(array, row));
        self.write_states(positions, headings, speeds);
    }

    fn store_inputs(&self, row: (usize, usize), arrays: &mut StepArrays<'_>) {
        self.write_inputs(part(arrays.inputs, row));
    }

    fn store_outputs(&self, row: (usize, usize), outputs: &mut [f32]) {
        write_lanes::<S>(self.outputs.as_flattened(), OUTPUTS, part(outputs, row));
    }

    fn store_sets(&self, row: (usize, usize), arrays: &mut StepArrays<'_>) {
        let sets = part(arrays.agents_at_poi, row);
        sets.copy_from_slice(&self.sets[row.0 * sets.len()..][..sets.len()]);
    }
}

/// Writes numbers of leaders, `[vectors of leaders][width]`, as `[leaders][width]`.
fn write_lanes<S: Simd>(vectors: &[S::f32s], width: usize, to: &mut [f32]) {
    for (leader, to) in to.chunks_exact_mut(width).enumerate() {
        for (to, vector) in to.iter_mut().zip(&vectors[leader / S::f32s::LEN * width..]) {
            *to = vector[leader % S::f32s::LEN];
        }
    }
}

/// Calls `visit` with each agent of a class within a radius, given squared; below 0 there are none.
#[inline(always)]
fn each_within<S: Simd>(simd: S, cells: &Cells, at: Vec2, radius2: f32, mut visit: impl FnMut(usize)) {
    if radius2 < 0.0 {
        return;
    }
    let (x, y, radius2_lanes) = (splat(simd, at.x), splat(simd, at.y), splat(simd, radius2));
    cells.each_run(
        [at; 2],
        radius2.sqrt(),
        #[inline(always)]
        |run| {
            for slot in run.clone().step_by(S::f32s::LEN) {
                let Agent { x: other_x, y: other_y, .. } = cells.load(simd, slot);
                let mut bits = couple::observes::<S>(radius2_lanes, x - other_x, y - other_y).to_bitmask();
                if run.end - slot < S::f32s::LEN {
                    bits &= (1 << (run.end - slot)) - 1;
                }
                while bits != 0 {
                    visit(cells.slots.agents[slot + bits.trailing_zeros() as usize] as usize);
                    bits &= bits - 1;
                }
            }
        },
    );
}

/// The sensing of some agents with one channel.
struct Sensing<'a, S: Simd> {
    channel: &'a ChannelLanes<S>,
    agent: Agent<S>,
    /// The heading that sectors turn with.
    heading: [S::f32s; 2],
    in_quadrants: bool,
    quadrants: sense::Quadrants<S>,
    sectors: sense::Sectors<S>,
}

impl<S: Simd> Sensing<'_, S> {
    /// Adds what is at a place, in the lanes in which it counts.
    #[inline(always)]
    fn add(&mut self, at: Vec2, value: f32, counts: S::mask32s) {
        let (simd, measure) = (self.agent.x.token(), Measure::of(self.channel.shape.measure));
        let offset = [splat(simd, at.x) - self.agent.x, splat(simd, at.y) - self.agent.y];
        let (measured, within) = sense::measured::<S>(self.channel, measure, splat(simd, value), offset[0], offset[1]);
        let measured = (measured & counts.to_vector(), within & counts);
        match self.in_quadrants {
            true => self.quadrants.add::<false, false>(measured, offset, self.heading),
            false => self.sectors.add(self.channel, measured, offset, self.heading),
        }
    }

    /// Returns the inputs, `[sectors]`.
    #[inline(always)]
    fn inputs(self) -> [S::f32s; MAX_SECTORS] {
        let mut inputs = [splat(self.agent.x.token(), 0.0); MAX_SECTORS];
        match self.in_quadrants {
            true => {
                self.quadrants.write::<false>(self.channel, inputs.first_chunk_mut().expect("there are at least four"))
            }
            false => self.sectors.write(self.channel, &mut inputs[..self.channel.shape.sectors as usize]),
        }
        inputs
    }
}

/// One term of a rule, or two [rings](follow::rings), and the agents that it acts on.
struct Attraction<'a, S: Simd> {
    swarm: &'a Swarm<S>,
    index: usize,
    slots: Range<usize>,
    corners: [Vec2; 2],
    x: S::f32s,
    y: S::f32s,
    terms: &'a [TermLanes<S>],
    /// The classes that count.
    of: &'a [usize],
}

impl<S: Simd> Attraction<'_, S> {
    #[inline(always)]
    fn add<const TERMS: usize, const ALIGNS: bool>(&self, force: &mut SteeringForce<S>) {
        let &Attraction { swarm, index, ref slots, corners, terms, of, .. } = self;
        let terms: &[TermLanes<S>; TERMS] = terms.try_into().expect("the caller counts the terms");
        let mut sums = [Sum::new(swarm.simd); TERMS];
        for &other in of {
            let others = &swarm.cells[other].slots;
            let own = if other == index { slots.clone() } else { 0..0 };
            swarm.cells[other].each_run(
                corners,
                terms[TERMS - 1].outer2[0].sqrt(),
                #[inline(always)]
                |run| {
                    // The own slots are within one run, or in none.
                    let [first, last] = [own.start, own.end].map(|slot| slot.clamp(run.start, run.end));
                    for slot in run.start..first {
                        self.count::<TERMS, ALIGNS>(terms, &mut sums, others, slot, None);
                    }
                    for slot in first..last {
                        let counts = Some(swarm.others(&own, slot));
                        self.count::<TERMS, ALIGNS>(terms, &mut sums, others, slot, counts);
                    }
                    for slot in last..run.end {
                        self.count::<TERMS, ALIGNS>(terms, &mut sums, others, slot, None);
                    }
                },
            );
        }
        for (term, sum) in terms.iter().zip(&sums) {
            force.add(term, sum);
        }
    }

    /// Adds the agent in a slot to the sums, in the lanes in which it counts, or all.
    #[inline(always)]
    fn count<const TERMS: usize, const ALIGNS: bool>(
        &self,
        terms: &[TermLanes<S>; TERMS],
        sums: &mut [Sum<S>; TERMS],
        others: &Slots,
        slot: usize,
        counts: Option<S::mask32s>,
    ) {
        let (simd, rule) = (self.swarm.simd, &self.swarm.world.classes[self.index].constants.rule);
        let [inner, outer] = [&terms[0], &terms[TERMS - 1]];
        let (dx, dy) = (splat(simd, others.x[slot]) - self.x, splat(simd, others.y[slot]) - self.y);
        let d2 = dx * dx + dy * dy;
        let ([x, y], base) = match ALIGNS {
            true => ([splat(simd, others.hx[slot]), splat(simd, others.hy[slot])], rule.heading_base),
            false => ([dx, dy], rule.offset_base),
        };
        let quantity = [on_lattice::<S>(x, base), on_lattice::<S>(y, base)];
        let mut within = d2.simd_le(outer.outer2);
        if let Some(counts) = counts {
            within &= counts;
        }
        if TERMS == 1 {
            sums[0].add(within & d2.simd_gt(inner.inner2), quantity);
        } else {
            let near = d2.simd_le(inner.outer2);
            sums[0].add(within & near, quantity);
            sums[1].add(within & !near, quantity);
        }
    }
}

#[cfg(test)]
mod tests {
    use fearless_simd::{Level, dispatch};
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;
    use rand::seq::SliceRandom;

    use super::*;
    use crate::backend::Group;
    use crate::backend::grid::is_large;
    use crate::config::own_populations;
    use crate::evaluate::SCORES_AND_DT;
    use crate::sample;

    /// Puts the agents of each class into another order before they are sorted into cells.
    struct Shuffle(ChaCha8Rng);

    impl Shuffle {
        fn shuffle<S: Simd>(&mut self, swarm: &mut Swarm<S>) {
            for cells in &mut swarm.cells {
                let mut order: Vec<usize> = (0..cells.len()).collect();
                order.shuffle(&mut self.0);
                let slots = cells.slots.clone();
                order.into_iter().enumerate().for_each(|(to, from)| cells.next.put(to, &slots, from));
                cells.sort();
            }
        }
    }

    impl<S: Simd> Observer<S, Swarm<S>> for Shuffle {
        fn started(&mut self, swarm: &mut Swarm<S>) {
            self.shuffle(swarm);
        }

        fn moved(&mut self, swarm: &mut Swarm<S>, _: usize) {
            self.shuffle(swarm);
        }
    }

    /// Leaves the order as it is.
    impl<S: Simd> Observer<S, Swarm<S>> for () {}

    /// The record and the last positions of a team, with agents in two orders.
    fn in_two_orders<S: Simd>(simd: S, world: &World, seed: u64) -> [(Swarm<S>, Vec<f32>); 2] {
        let (weights, teams) = (sample::weights(world, 1, seed), vec![0; world.leaders()]);
        let (populations, fitnesses) = (own_populations(world.leaders()), SCORES_AND_DT);
        let group = Group { populations, fitnesses, ..Group::new(world, &weights[..], 1, &teams) };
        let batch = WorldBatch::new(std::slice::from_ref(&group), 0);
        let play = |watch: &mut Shuffle, shuffles: bool| {
            let mut swarm = Swarm::new(simd, world, Recorded { counts: true, sights: true, forces: false });
            match shuffles {
                true => swarm.play(&batch, 0..1, watch),
                false => swarm.play(&batch, 0..1, &mut ()),
            }
            let mut positions = vec![0.0; world.agents() * 2];
            swarm.write_states(&mut positions, &mut [], &mut []);
            (swarm, positions)
        };
        let mut watch = Shuffle(ChaCha8Rng::seed_from_u64(seed));
        [play(&mut watch, false), play(&mut watch, true)]
    }

    #[test]
    fn no_bit_depends_on_the_order_of_agents_in_cells() {
        let worlds = (0..400).map(|seed| (seed, World::new(&sample::any_world(seed).validate().unwrap())));
        let worlds: Vec<_> = worlds.filter(|(_, world)| is_large(world, 0)).collect();
        assert!(worlds.len() >= 200, "{}", worlds.len());
        for (seed, world) in worlds {
            let compare = |[(a, at_a), (b, at_b)]: [(Vec<&[u32]>, Vec<u32>); 2]| {
                assert_eq!(a, b, "{seed}");
                assert_eq!(at_a, at_b, "{seed}");
            };
            dispatch!(Level::new(), simd => {
                let both = in_two_orders(simd, &world, seed);
                let bits = |positions: &[f32]| positions.iter().map(|at| at.to_bits()).collect();
                compare(both.each_ref().map(|(swarm, positions)| {
                    (vec![&swarm.sets[..], &swarm.counts, &swarm.sights, &swarm.paths], bits(positions))
                }));
            });
        }
    }
}
