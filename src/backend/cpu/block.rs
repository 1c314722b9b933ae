//! The state of one vector of teams, and one step of it.

use std::ops::Range;

use fearless_simd::{Simd, prelude::*};
use glam::Vec2;

use super::agent::Agent;
use super::neighbours::{self, Bounds, Masks, masks};
use crate::backend::Moment;
use crate::config::{Combine, ControlKind, Frame, Measure};
use crate::kernels::math::{on_lattice, within};
use crate::kernels::{clamp_to, select, splat};
use crate::model::class::{Class, ClassLanes};
use crate::model::follow::{self, Sum};
use crate::model::sense::{self, ChannelConstants, ChannelLanes};
use crate::model::{self, Lanes, motion, policy, pursue};
use crate::world::{GoneWithin, OUTPUTS, World};

/// The state of one vector of teams, one team per lane, with scratch memory for a step. A step reads only the
/// previous state.
pub(crate) struct Block<S: Simd> {
    pub simd: S,
    pub(super) world: Lanes<S>,
    /// `[agents]`, leaders first.
    pub agents: Vec<Agent<S>>,
    /// Inputs of the leaders, `[leaders][inputs]`.
    pub inputs: Vec<S::f32s>,
    /// Outputs of the leaders' policies, `[leaders]`.
    pub outputs: Vec<[S::f32s; OUTPUTS]>,
    /// Wanted speeds of agents that steer, `[agents]`, and velocities of those that move freely, `[agents]`, in units per
    /// second.
    wanted: Vec<S::f32s>,
    velocities: Vec<[S::f32s; 2]>,
    /// The headings before the step, `[agents]`; empty unless a rule aligns them.
    headings: Vec<[S::f32s; 2]>,
    /// The agents of classes that move only near others, before the step, and the lanes in which they move.
    kept: Vec<(Agent<S>, S::mask32s)>,
    /// `[followers]`.
    followers: Vec<Follower<S>>,
    /// The number of steps at which each follower saw each leader, `[followers][leaders]`.
    pub counts: Vec<S::u32s>,
    /// The pairs of agents that may be in reach in some lane, one bit each, `[words][agents]`.
    pub(super) near: Vec<u64>,
    pub(super) bounds: Vec<Bounds<S>>,
    /// See [`neighbours::find_near`].
    reach2: Vec<f32>,
    /// `[classes]`.
    plans: Vec<Plan>,
    /// The squared observation radius and the value of each POI, `[pois]`.
    pub(super) radii2: Vec<f32>,
    pub(super) values: Vec<f32>,
    /// See [`WorldParts::gone_within`](crate::world::WorldParts::gone_within).
    pub(super) gone_within: Vec<GoneWithin>,
    /// Whether each of these POIs is gone, all bits of a lane or none, `[gone_within]`.
    pub gone: Vec<S::u32s>,
    /// Where each POI is, and where it is sensed, `[pois]`.
    pub(super) pois: Vec<[S::f32s; 2]>,
    sensed: Vec<[S::f32s; 2]>,
}

/// The part of a [`Block`] that the next step depends on, after [`Block::sense`].
pub(crate) struct BlockState<S: Simd> {
    pub agents: Vec<Agent<S>>,
    /// Empty unless scores need them.
    pub counts: Vec<S::u32s>,
    pub(super) near: Vec<u64>,
    pub gone: Vec<S::u32s>,
}

#[derive(Clone, Copy)]
pub(super) struct Follower<S: Simd> {
    /// The sums of a [`Ring`]'s terms.
    sums: [Sum<S>; 2],
    force: follow::SteeringForce<S>,
    /// The squared size of the force, and the inverse of its size.
    sizes: (S::f32s, S::f32s),
}

impl<S: Simd> Follower<S> {
    #[inline(always)]
    fn new(force: follow::SteeringForce<S>) -> Follower<S> {
        let (simd, zero) = (force.x.token(), splat(force.x.token(), 0.0));
        Follower { sums: [Sum::new(simd); 2], force, sizes: (zero, zero) }
    }
}

impl<S: Simd> Block<S> {
    pub fn new(simd: S, world: &World) -> Block<S> {
        let zero = splat(simd, 0.0);
        let (agents, leaders, followers) = (world.agents(), world.leaders(), world.followers());
        let force = follow::SteeringForce::none(simd);
        let pois: Vec<_> = world.pois.iter().map(|poi| [splat(simd, poi.x), splat(simd, poi.y)]).collect();
        Block {
            simd,
            world: Lanes::new(simd, world.constants, &world.classes),
            agents: vec![Agent { x: zero, y: zero, hx: zero, hy: zero, speed: zero }; agents],
            inputs: vec![zero; leaders * world.inputs()],
            outputs: vec![[zero; OUTPUTS]; leaders],
            wanted: vec![zero; agents],
            velocities: vec![[zero; 2]; agents],
            headings: vec![[zero; 2]; if world.aligns() { agents } else { 0 }],
            kept: vec![],
            followers: vec![Follower::new(force); followers],
            counts: vec![S::u32s::splat(simd, 0); followers * leaders],
            near: vec![0; agents.div_ceil(64) * agents],
            bounds: vec![Bounds::nowhere(simd); agents.div_ceil(S::f32s::LEN)],
            reach2: reach2(world),
            plans: Plan::all(world),
            radii2: world.radii2.clone(),
            values: world.values.clone(),
            gone_within: world.gone_within.clone(),
            gone: vec![S::u32s::splat(simd, 0); world.gone_within.len()],
            pois: pois.clone(),
            sensed: pois,
        }
    }

    /// Returns the state to keep, with the counts or without.
    pub fn into_state(self, counted: bool) -> BlockState<S> {
        let Block { agents, counts, near, gone, .. } = self;
        BlockState { agents, counts: if counted { counts } else { vec![] }, near, gone }
    }

    /// Exchanges this block's state for another.
    #[inline(always)]
    pub fn swap(&mut self, state: &mut BlockState<S>) {
        std::mem::swap(&mut self.agents, &mut state.agents);
        if !state.counts.is_empty() {
            std::mem::swap(&mut self.counts, &mut state.counts);
        }
        std::mem::swap(&mut self.near, &mut state.near);
        std::mem::swap(&mut self.gone, &mut state.gone);
    }

    /// Puts one lane's agents at their start positions, with their initial headings.
    #[inline(always)]
    pub fn place(&mut self, lane: usize, starts: &[Vec2], headings: &[Vec2]) {
        for ((agent, start), heading) in self.agents.iter_mut().zip(starts).zip(headings) {
            agent.x[lane] = start.x;
            agent.y[lane] = start.y;
            agent.hx[lane] = heading.x;
            agent.hy[lane] = heading.y;
        }
    }

    /// Puts one lane's POIs in their places.
    #[inline(always)]
    pub fn place_pois(&mut self, lane: usize, places: &[Vec2]) {
        for (([x, y], sensed), place) in self.pois.iter_mut().zip(&mut self.sensed).zip(places) {
            (x[lane], y[lane]) = (place.x, place.y);
            (sensed[0][lane], sensed[1][lane]) = (place.x, place.y);
        }
    }

    /// Sets all lanes' agents to their initial speed.
    #[inline(always)]
    pub fn start(&mut self) {
        let Block { simd, world, agents, counts, gone, .. } = self;
        for class in &world.classes {
            agents[class.agents()].iter_mut().for_each(|agent| agent.speed = class.constants.motion.speed);
        }
        [counts, gone].into_iter().for_each(|lanes| lanes.fill(S::u32s::splat(*simd, 0)));
    }

    /// [`Block::start`] of one lane.
    #[inline(always)]
    pub fn start_lane(&mut self, lane: usize) {
        let Block { world, agents, counts, gone, .. } = self;
        for class in &world.classes {
            let speed = class.constants.motion.speed[lane];
            agents[class.agents()].iter_mut().for_each(|agent| agent.speed[lane] = speed);
        }
        counts.iter_mut().chain(gone).for_each(|lanes| lanes[lane] = 0);
    }

    /// Computes the inputs of the leaders' policies, channel by channel.
    ///
    /// This, [`Block::step`] and [`Network::decide`](super::network::Network::decide) are most of the compiled code. They
    /// are functions of their own, so that whole episodes, traces, records and single steps share them.
    pub fn sense(&mut self) {
        self.simd.vectorize(
            #[inline(always)]
            || {
                if !self.gone_within.is_empty() {
                    self.find_gone();
                }
                self.sense_channels();
            },
        );
    }

    /// Finds the POIs that are gone, and puts them where no range reaches.
    #[inline(always)]
    fn find_gone(&mut self) {
        let Block { simd, world, agents, gone_within, gone, pois, sensed, .. } = self;
        for (GoneWithin { poi, distance2, classes }, gone) in gone_within.iter().zip(gone) {
            let [x, y] = pois[*poi];
            for agent in classes.iter().flat_map(|&class| world.classes[class].agents()) {
                let near = within::<S>(x - agents[agent].x, y - agents[agent].y, splat(*simd, *distance2));
                *gone |= near.to_vector().bitcast::<S::u32s>();
            }
            sensed[*poi][0] = select::<S>(x, splat(*simd, f32::INFINITY), gone.simd_gt(S::u32s::splat(*simd, 0)));
        }
    }

    #[inline(always)]
    fn sense_channels(&mut self) {
        let Block { simd, world, agents, near, bounds, reach2, plans, values, inputs, sensed: pois, .. } = self;
        neighbours::find_near(reach2, agents, near, bounds);
        let width = world.constants.policy.inputs();
        for (class, plan) in world.classes.iter().zip(plans) {
            let shape = &class.constants.shape;
            for (channel, plan) in class.channels.iter().zip(&plan.channels) {
                let scene = Scene { simd: *simd, channel, pois, values, agents, near, plan };
                let (observers, inputs) = (shape.agents(), Inputs { all: &mut *inputs, width });
                if channel.shape.each != 0 {
                    scene.sense_each(observers, inputs);
                } else if channel.shape.is_in_quadrants() {
                    scene.sense_measured_quadrants(observers, inputs);
                } else {
                    scene.sense_sectors(observers, inputs);
                }
            }
        }
    }

    /// Plays a step by the leaders' outputs. Writes which leaders each follower sees before it moves, unless `sights` is
    /// empty, and the agents at each POI after it if wanted, see [`Block::record_sightings`] and [`Block::record_poi_sets`].
    pub fn step(&mut self, sights: &mut [u32], sets: Option<&mut [u32]>) {
        self.simd.vectorize(
            #[inline(always)]
            || {
                if !sights.is_empty() {
                    self.record_sightings(sights);
                }
                self.keep();
                self.lead();
                self.follow();
                self.move_agents();
            },
        );
        if let Some(sets) = sets {
            self.record_poi_sets(sets);
        }
    }

    /// Keeps the agents of classes that move only near others, and finds out whether they move.
    #[inline(always)]
    fn keep(&mut self) {
        let Block { world, agents, kept, .. } = self;
        kept.clear();
        for class in world.classes.iter().filter(|class| class.constants.shape.end_near > 0) {
            let (shape, near2) = (&class.constants.shape, class.constants.pursuit.near2);
            for agent in class.agents() {
                let near = offsets(agents, agent, shape.first_near..shape.end_near);
                kept.push((agents[agent], pursue::nearest::<S>(agent, near2, near).1));
            }
        }
    }

    /// Leaders turn, and set their wanted speed or their velocity, by their policies' outputs.
    #[inline(always)]
    fn lead(&mut self) {
        let Block { world, agents, outputs, wanted, velocities, headings, .. } = self;
        headings.iter_mut().zip(&*agents).for_each(|(heading, agent)| *heading = [agent.hx, agent.hy]);
        for class in world.classes.iter().filter(|class| class.control().learns()) {
            let (shape, motion) = (&class.constants.shape, &class.constants.motion);
            let own = shape.agents();
            if shape.control() == ControlKind::Choose {
                let pursuit = &class.constants.pursuit;
                for agent in own {
                    let targets = offsets(agents, agent, shape.first_target..shape.end_target);
                    let to = pursue::chosen::<S>(pursuit, outputs[agent][0], targets);
                    let mut one = [Follower::new(pursue::towards::<S>(pursuit, motion, to))];
                    let it = agent..agent + 1;
                    obey(class, &mut agents[it.clone()], &mut one, &mut wanted[it.clone()], &mut velocities[it]);
                }
                continue;
            }
            if shape.free != 0 {
                for (velocity, &[x, y]) in velocities[own.clone()].iter_mut().zip(&outputs[own]) {
                    *velocity = [x * motion.max_speed, y * motion.max_speed];
                }
                continue;
            }
            let moved = agents[own.clone()].iter_mut().zip(&mut wanted[own.clone()]);
            for ((agent, wanted), &[turn, speed]) in moved.zip(&outputs[own]) {
                (agent.hx, agent.hy) = motion::turn::<S>(motion, agent.hx, agent.hy, policy::wanted_turn::<S>(turn));
                *wanted = policy::wanted_speed::<S>(motion, speed);
            }
        }
    }

    /// Followers count the leaders they see, and obey their class's rule. Several short loops: out-of-order execution
    /// overlaps iterations only if they are short.
    #[inline(always)]
    fn follow(&mut self) {
        let Block { world, agents, wanted, velocities, headings, near, followers, counts, plans, .. } = self;
        let leaders = world.constants.leaders as usize;
        let follow = world.classes.iter().zip(plans).filter(|(class, _)| class.agents().start >= leaders);
        for (class, plan) in follow {
            let (shape, motion, own) = (&class.constants.shape, &class.constants.motion, class.agents());
            let counts = &mut counts[(own.start - leaders) * leaders..(own.end - leaders) * leaders];
            let followers = &mut followers[own.start - leaders..own.end - leaders];
            if let Some(leaders) = &plan.leaders {
                count_leaders(agents, near, own.clone(), leaders, &plan.influences2, counts);
            }
            match shape.control() {
                ControlKind::Nearest => {
                    let pursuit = &class.constants.pursuit;
                    for (agent, follower) in own.clone().zip(&mut *followers) {
                        let targets = offsets(agents, agent, shape.first_target..shape.end_target);
                        let (to, _) = pursue::nearest::<S>(agent, pursuit.reach2, targets);
                        follower.force = pursue::towards::<S>(pursuit, motion, to);
                    }
                }
                ControlKind::Follow => {
                    for (index, (terms, others)) in plan.terms.iter().enumerate() {
                        let counting = index == 0 && plan.leaders.is_none();
                        let is_last = index + 1 == plan.terms.len();
                        let terms = &class.terms[terms.clone()];
                        let ring = Ring {
                            class,
                            terms,
                            is_first: index == 0,
                            is_last,
                            agents,
                            headings,
                            near,
                            others,
                            leaders,
                        };
                        match (terms.len(), counting) {
                            (1, true) => ring.add::<1, true>(own.clone(), followers, counts),
                            (1, false) => ring.add::<1, false>(own.clone(), followers, counts),
                            (_, true) => ring.add::<2, true>(own.clone(), followers, counts),
                            (_, false) => ring.add::<2, false>(own.clone(), followers, counts),
                        }
                    }
                }
                _ => continue,
            }
            obey(class, &mut agents[own.clone()], followers, &mut wanted[own.clone()], &mut velocities[own]);
        }
    }

    /// Moves all agents.
    #[inline(always)]
    fn move_agents(&mut self) {
        let Block { world, agents, wanted, velocities, kept, .. } = self;
        let map = &world.map;
        for class in &world.classes {
            let (shape, motion) = (&class.constants.shape, &class.constants.motion);
            let own = shape.agents();
            if shape.control() == ControlKind::Still {
                continue;
            }
            let (in_x, in_y) = ([motion.low_x, motion.high_x], [motion.low_y, motion.high_y]);
            if shape.free != 0 {
                for (agent, &[x, y]) in agents[own.clone()].iter_mut().zip(&velocities[own]) {
                    agent.x = motion::advance::<S>(agent.x, map.dt, x, in_x);
                    agent.y = motion::advance::<S>(agent.y, map.dt, y, in_y);
                }
                continue;
            }
            let agents = &mut agents[own.clone()];
            for agent in &mut *agents {
                (agent.hx, agent.hy) = motion::renormalize::<S>(agent.hx, agent.hy);
            }
            for (agent, &wanted) in agents.iter_mut().zip(&wanted[own]) {
                agent.speed = motion::accelerate::<S>(motion, agent.speed, wanted);
            }
            for agent in agents {
                let step = agent.speed * map.dt;
                agent.x = motion::advance::<S>(agent.x, step, agent.hx, in_x);
                agent.y = motion::advance::<S>(agent.y, step, agent.hy, in_y);
            }
        }
        let keep = world.classes.iter().filter(|class| class.constants.shape.end_near > 0).flat_map(ClassLanes::agents);
        for (agent, &(before, moves)) in keep.zip(&*kept) {
            let to = &mut agents[agent];
            to.x = select::<S>(before.x, to.x, moves);
            to.y = select::<S>(before.y, to.y, moves);
            to.hx = select::<S>(before.hx, to.hx, moves);
            to.hy = select::<S>(before.hy, to.hy, moves);
            to.speed = select::<S>(before.speed, to.speed, moves);
        }
    }

    /// Writes the moments of one lane's agents, and the inputs of its leaders, `[leaders][inputs]`. Before the first step
    /// nothing has been sensed.
    pub(super) fn moments(&self, lane: usize, sensed: bool, moments: &mut [Moment], inputs: &mut [f32]) {
        let leaders = self.outputs.len();
        for (index, (agent, moment)) in self.agents.iter().zip(moments).enumerate() {
            if sensed && index < leaders {
                moment.outputs = self.outputs[index].map(|output| output[lane]);
            } else if sensed {
                let follower = &self.followers[index - leaders];
                moment.force = [follower.force.x[lane], follower.force.y[lane]];
            }
            moment.position = [agent.x[lane], agent.y[lane]];
            moment.heading = [agent.hx[lane], agent.hy[lane]];
            moment.speed = agent.speed[lane];
        }
        if sensed {
            inputs.iter_mut().zip(&self.inputs).for_each(|(to, input)| *to = input[lane]);
        }
    }
}

/// The order in which the agents of a class visit others.
struct Plan {
    /// `[channels]`.
    channels: Vec<ChannelPlan>,
    /// Terms that are added together, see [`follow::rings`], and their agents.
    terms: Vec<(Range<usize>, Masks)>,
    /// The leaders, unless the first terms count them because they visit all of them and have their radius.
    leaders: Option<Masks>,
    /// The squared distance up to which each leader leads agents of this class, `[leaders]`.
    influences2: Vec<f32>,
}

/// What the agents of a class visit for a channel.
struct ChannelPlan {
    agents: Masks,
    pois: Vec<Range<usize>>,
    /// Whether it counts no entities, and each has value 1.
    is_plain: bool,
}

impl ChannelPlan {
    fn new(channel: &ChannelConstants, values: &[f32]) -> ChannelPlan {
        let shape = &channel.shape;
        let of = |pois: bool| model::each(&shape.ranges).filter(move |_| pois == (shape.of_pois != 0));
        let has_values = of(true).flatten().any(|poi| values[poi] != 1.0);
        ChannelPlan { agents: masks(of(false)), pois: of(true).collect(), is_plain: shape.counts == 0 && !has_values }
    }
}

impl Plan {
    /// Plans every class of a world.
    fn all(world: &World) -> Vec<Plan> {
        let leaders = 0..world.leaders();
        let leading: Vec<&Class> = leaders.clone().map(|leader| world.class_of(leader)).collect();
        let plan = |(index, class): (usize, &Class)| {
            let of = |ring: &Range<usize>| masks(model::each(&class.terms()[ring.start].shape.ranges));
            let terms: Vec<(Range<usize>, Masks)> =
                follow::rings(class.terms()).into_iter().map(|ring| (ring.clone(), of(&ring))).collect();
            let influences2: Vec<f32> = leading.iter().map(|class| class.constants.influence2[index]).collect();
            let visits = |constants: &follow::TermConstants| {
                model::each(&constants.shape.ranges).any(|range| range.start == 0 && range.end >= leaders.end)
                    && influences2.iter().all(|&influence2| influence2 == constants.outer2)
            };
            let is_led = influences2.iter().any(|&influence2| influence2 >= 0.0);
            let counted = terms.first().is_some_and(|(range, _)| visits(&class.terms()[range.end - 1]));
            Plan {
                channels: class.channels().iter().map(|of| ChannelPlan::new(of, &world.values)).collect(),
                terms,
                leaders: (!counted).then(|| masks(is_led.then(|| leaders.clone()))),
                influences2,
            }
        };
        world.classes.iter().enumerate().map(plan).collect()
    }
}

/// Returns the largest squared distance at which each agent and any after it matter to each other, `[agents]`.
fn reach2(world: &World) -> Vec<f32> {
    let mut reach2: Vec<f32> =
        world.classes.iter().flat_map(|class| vec![class.reach2(); class.agents().len()]).collect();
    for agent in (1..reach2.len()).rev() {
        reach2[agent - 1] = reach2[agent].max(reach2[agent - 1]);
    }
    reach2
}

/// The inputs of all leaders, `[leaders][width]`.
struct Inputs<'a, S: Simd> {
    all: &'a mut [S::f32s],
    width: usize,
}

impl<S: Simd> Inputs<'_, S> {
    /// Returns the inputs of one leader's channel.
    #[inline(always)]
    fn of(&mut self, leader: usize, channel: &ChannelLanes<S>) -> &mut [S::f32s] {
        &mut self.all[leader * self.width + channel.shape.input as usize..][..channel.shape.sectors as usize]
    }
}

/// Returns the offset of a place from (`x`, `y`).
#[inline(always)]
fn offset<F: std::ops::Sub<Output = F>>([px, py]: [F; 2], x: F, y: F) -> [F; 2] {
    [px - x, py - y]
}

/// The entities that one channel senses.
struct Scene<'a, S: Simd> {
    simd: S,
    channel: &'a ChannelLanes<S>,
    pois: &'a [[S::f32s; 2]],
    values: &'a [f32],
    agents: &'a [Agent<S>],
    near: &'a [u64],
    plan: &'a ChannelPlan,
}

impl<S: Simd> Scene<'_, S> {
    /// Returns what an entity at an offset counts. `PLAIN` ones have value 1.
    #[inline(always)]
    fn measured<const MEASURE: u32, const PLAIN: bool>(
        &self,
        value: f32,
        [dx, dy]: [S::f32s; 2],
    ) -> (S::i32s, S::mask32s) {
        let value = splat(self.simd, if PLAIN { 1.0 } else { value });
        sense::measured::<S>(self.channel, const { Measure::of(MEASURE) }, value, dx, dy)
    }

    /// Senses by quadrants, compiled once for each measure.
    #[inline(always)]
    fn sense_measured_quadrants(&self, observers: Range<usize>, inputs: Inputs<'_, S>) {
        match Measure::of(self.channel.shape.measure) {
            Measure::Linear => self.sense_framed::<{ Measure::Linear as u32 }>(observers, inputs),
            Measure::Inverse => self.sense_framed::<{ Measure::Inverse as u32 }>(observers, inputs),
            Measure::InverseSquared => self.sense_framed::<{ Measure::InverseSquared as u32 }>(observers, inputs),
            Measure::Exponential => self.sense_framed::<{ Measure::Exponential as u32 }>(observers, inputs),
            Measure::Distance => self.sense_framed::<{ Measure::Distance as u32 }>(observers, inputs),
            Measure::Closeness => self.sense_framed::<{ Measure::Closeness as u32 }>(observers, inputs),
        }
    }

    #[inline(always)]
    fn sense_framed<const MEASURE: u32>(&self, observers: Range<usize>, inputs: Inputs<'_, S>) {
        match (self.plan.is_plain, self.channel.shape.frame == Frame::Map as u32) {
            (true, true) => self.sense_quadrants::<MEASURE, true, true>(observers, inputs),
            (true, false) => self.sense_quadrants::<MEASURE, true, false>(observers, inputs),
            (false, _) => self.sense_quadrants::<MEASURE, false, false>(observers, inputs),
        }
    }

    /// Senses by quadrants. `PLAIN` channels count no entities, and sense POIs of value 1 only. `MAP` is for quadrants that
    /// are fixed to the map, which need no rotation. It is a function of its own, so that registers hold its constants.
    fn sense_quadrants<const MEASURE: u32, const PLAIN: bool, const MAP: bool>(
        &self,
        observers: Range<usize>,
        mut inputs: Inputs<'_, S>,
    ) {
        self.simd.vectorize(
            #[inline(always)]
            || self.sense_each_quadrant::<MEASURE, PLAIN, MAP>(observers, &mut inputs),
        );
    }

    #[inline(always)]
    fn sense_each_quadrant<const MEASURE: u32, const PLAIN: bool, const MAP: bool>(
        &self,
        observers: Range<usize>,
        inputs: &mut Inputs<'_, S>,
    ) {
        let &Scene { simd, channel, pois, agents, near, plan, .. } = self;
        for observer in observers {
            let &Agent { x, y, hx, hy, .. } = &agents[observer];
            let heading = if PLAIN && !MAP { [hx, hy] } else { channel.heading(hx, hy) };
            let mut quadrants = sense::Quadrants::new(simd);
            neighbours::each_near(
                near,
                agents,
                observer,
                &plan.agents,
                #[inline(always)]
                |_, other| {
                    let offset = [other.x - x, other.y - y];
                    let measured = self.measured::<MEASURE, true>(1.0, offset);
                    quadrants.add::<PLAIN, MAP>(measured, offset, heading);
                },
            );
            for range in &plan.pois {
                let (fours, rest) = pois[range.clone()].as_chunks::<4>();
                let mut first = range.start;
                for pois in fours {
                    self.add_pois::<MEASURE, PLAIN, MAP, 4>(&mut quadrants, first, pois, [x, y], heading);
                    first += 4;
                }
                for (poi, first) in rest.iter().zip(first..) {
                    self.add_pois::<MEASURE, PLAIN, MAP, 1>(&mut quadrants, first, &[*poi], [x, y], heading);
                }
            }
            let inputs = inputs.of(observer, channel).as_chunks_mut().0;
            quadrants.write::<PLAIN>(channel, &mut inputs[0]);
        }
    }

    /// Adds so many POIs, from index `first` on, to the quadrants of an agent at a place. First all are measured:
    /// out-of-order execution overlaps them.
    #[inline(always)]
    fn add_pois<const MEASURE: u32, const PLAIN: bool, const MAP: bool, const POIS: usize>(
        &self,
        quadrants: &mut sense::Quadrants<S>,
        first: usize,
        pois: &[[S::f32s; 2]; POIS],
        [x, y]: [S::f32s; 2],
        heading: [S::f32s; 2],
    ) {
        let none = (S::i32s::splat(self.simd, 0), S::mask32s::splat(self.simd, false));
        let mut measures = [none; POIS];
        for index in 0..POIS {
            let value = if PLAIN { 1.0 } else { self.values[first + index] };
            measures[index] = self.measured::<MEASURE, PLAIN>(value, offset(pois[index], x, y));
        }
        for (measured, &poi) in measures.into_iter().zip(pois) {
            quadrants.add::<PLAIN, MAP>(measured, offset(poi, x, y), heading);
        }
    }

    /// Senses each POI or agent in a sector of its own.
    #[inline(always)]
    fn sense_each(&self, observers: Range<usize>, mut inputs: Inputs<'_, S>) {
        let &Scene { simd, channel, pois, values, agents, .. } = self;
        let measure = Measure::of(channel.shape.measure);
        for observer in observers {
            let &Agent { x, y, .. } = &agents[observer];
            let entities = model::each(&channel.shape.ranges).flatten();
            for (input, index) in inputs.of(observer, channel).iter_mut().zip(entities) {
                let (offset, value) = match channel.shape.of_pois {
                    0 => ([agents[index].x - x, agents[index].y - y], 1.0),
                    _ => (offset(pois[index], x, y), values[index]),
                };
                let (measured, within) =
                    sense::measured::<S>(channel, measure, splat(simd, value), offset[0], offset[1]);
                let other = S::mask32s::splat(simd, channel.shape.of_pois != 0 || index != observer);
                let within = (within & other).to_vector();
                *input = sense::input_of::<S>(channel, measured & within, -within);
            }
        }
    }

    /// Senses by any number of sectors.
    #[inline(always)]
    fn sense_sectors(&self, observers: Range<usize>, mut inputs: Inputs<'_, S>) {
        let &Scene { simd, channel, pois, values, agents, near, plan } = self;
        let measure = Measure::of(channel.shape.measure);
        for observer in observers {
            let &Agent { x, y, hx, hy, .. } = &agents[observer];
            let heading = channel.heading(hx, hy);
            let mut sectors = sense::Sectors::new(simd, Combine::of(channel.shape.combine));
            neighbours::each_near(
                near,
                agents,
                observer,
                &plan.agents,
                #[inline(always)]
                |_, other| {
                    let (offset, one) = ([other.x - x, other.y - y], splat(simd, 1.0));
                    let measured = sense::measured::<S>(channel, measure, one, offset[0], offset[1]);
                    sectors.add(channel, measured, offset, heading);
                },
            );
            for poi in plan.pois.iter().cloned().flatten() {
                let (offset, value) = (offset(pois[poi], x, y), splat(simd, values[poi]));
                let measured = sense::measured::<S>(channel, measure, value, offset[0], offset[1]);
                sectors.add(channel, measured, offset, heading);
            }
            sectors.write(channel, inputs.of(observer, channel));
        }
    }
}

/// Counts which leaders the agents of `own` see, `[own][leaders]`. `influences2` are the leaders' squared distances.
#[inline(always)]
fn count_leaders<S: Simd>(
    agents: &[Agent<S>],
    near: &[u64],
    own: Range<usize>,
    leaders: &Masks,
    influences2: &[f32],
    counts: &mut [S::u32s],
) {
    for (index, counts) in own.zip(counts.chunks_exact_mut(influences2.len())) {
        let &Agent { x, y, .. } = &agents[index];
        neighbours::each_near(
            near,
            agents,
            index,
            leaders,
            #[inline(always)]
            |leader, other| {
                let sees = within::<S>(other.x - x, other.y - y, splat(x.token(), influences2[leader]));
                counts[leader] -= sees.to_vector().bitcast::<S::u32s>();
            },
        );
    }
}

/// One term of a rule, or two [rings](follow::rings).
struct Ring<'a, S: Simd> {
    class: &'a ClassLanes<S>,
    terms: &'a [follow::TermLanes<S>],
    is_first: bool,
    is_last: bool,
    agents: &'a [Agent<S>],
    headings: &'a [[S::f32s; 2]],
    near: &'a [u64],
    others: &'a Masks,
    leaders: usize,
}

impl<S: Simd> Ring<'_, S> {
    /// Adds so many terms to the forces on the agents of `own`, and counts the leaders they see if wanted. The first ring
    /// starts the forces, and walls come after the last. Two loops, see [`Block::follow`].
    #[inline(always)]
    fn add<const TERMS: usize, const COUNTS: bool>(
        &self,
        own: Range<usize>,
        followers: &mut [Follower<S>],
        counts: &mut [S::u32s],
    ) {
        match self.terms[0].shape.aligns != 0 {
            true => self.add_quantity::<TERMS, COUNTS, true>(own, followers, counts),
            false => self.add_quantity::<TERMS, COUNTS, false>(own, followers, counts),
        }
    }

    #[inline(always)]
    fn add_quantity<const TERMS: usize, const COUNTS: bool, const ALIGNS: bool>(
        &self,
        own: Range<usize>,
        followers: &mut [Follower<S>],
        counts: &mut [S::u32s],
    ) {
        let &Ring { class, terms, is_first, is_last, agents, headings, near, others, leaders } = self;
        let (rule, motion) = (&class.constants.rule, &class.constants.motion);
        let terms: &[follow::TermLanes<S>; TERMS] = terms.try_into().expect("the caller counts the terms");
        let [inner, outer] = [&terms[0], &terms[TERMS - 1]];
        let each = || own.clone().zip(&agents[own.clone()]);
        for (((index, agent), follower), counts) in each().zip(&mut *followers).zip(counts.chunks_exact_mut(leaders)) {
            let &Agent { x, y, .. } = agent;
            let mut sums = [Sum::new(x.token()); TERMS];
            neighbours::each_near(
                near,
                agents,
                index,
                others,
                #[inline(always)]
                |index, other| {
                    let (dx, dy) = (other.x - x, other.y - y);
                    let d2 = dx * dx + dy * dy;
                    let ([x, y], base) =
                        if ALIGNS { (headings[index], rule.heading_base) } else { ([dx, dy], rule.offset_base) };
                    let quantity = [on_lattice::<S>(x, base), on_lattice::<S>(y, base)];
                    // Equal to the shader's comparisons of bits, because no squared distance is negative.
                    let within = d2.simd_le(outer.outer2);
                    if TERMS == 1 {
                        sums[0].add(within & d2.simd_gt(inner.inner2), quantity);
                    } else {
                        let near = d2.simd_le(inner.outer2);
                        sums[0].add(near, quantity);
                        sums[1].add(within & !near, quantity);
                    }
                    if COUNTS && let Some(count) = counts.get_mut(index) {
                        *count -= within.to_vector().bitcast::<S::u32s>();
                    }
                },
            );
            follower.sums[..TERMS].copy_from_slice(&sums);
        }
        for ((_, agent), follower) in each().zip(followers) {
            let mut force = if is_first { follow::SteeringForce::none(agent.x.token()) } else { follower.force };
            for (term, sum) in terms.iter().zip(&follower.sums) {
                force.add(term, sum);
            }
            if is_last {
                force.add_walls(rule, motion, agent.x, agent.y);
            }
            follower.force = force;
        }
    }
}

/// Returns the agents of a range, and the offsets of an agent to them.
#[inline(always)]
fn offsets<S: Simd>(
    agents: &[Agent<S>],
    agent: usize,
    others: Range<u32>,
) -> impl Iterator<Item = (usize, [S::f32s; 2])> {
    let &Agent { x, y, .. } = &agents[agent];
    (others.start as usize..others.end as usize).map(
        #[inline(always)]
        move |other| (other, [agents[other].x - x, agents[other].y - y]),
    )
}

/// Agents of a class take the wanted velocity, or heading and speed, from the force on them.
#[inline(always)]
fn obey<S: Simd>(
    class: &ClassLanes<S>,
    agents: &mut [Agent<S>],
    followers: &mut [Follower<S>],
    wanted: &mut [S::f32s],
    velocities: &mut [[S::f32s; 2]],
) {
    let (shape, motion) = (&class.constants.shape, &class.constants.motion);
    if shape.free != 0 {
        for (velocity, follower) in velocities.iter_mut().zip(followers) {
            let (follow::SteeringForce { x, y, .. }, most) = (follower.force, motion.max_speed);
            *velocity = [clamp_to::<S>(x, -most, most), clamp_to::<S>(y, -most, most)];
        }
    } else if shape.by_sine != 0 {
        steer::<S, true>(motion, agents, followers, wanted);
    } else {
        steer::<S, false>(motion, agents, followers, wanted);
    }
}

/// Turns followers towards the force on them. Several short loops: out-of-order execution overlaps iterations only if
/// they are short.
#[inline(always)]
fn steer<S: Simd, const BY_SINE: bool>(
    motion: &motion::MotionLanes<S>,
    agents: &mut [Agent<S>],
    followers: &mut [Follower<S>],
    wanted: &mut [S::f32s],
) {
    for follower in &mut *followers {
        follower.sizes = follow::sizes::<S>(&follower.force);
    }
    for ((agent, wanted), follower) in agents.iter_mut().zip(wanted).zip(followers) {
        let &mut Agent { hx, hy, speed, .. } = agent;
        let &mut Follower { force, sizes, .. } = follower;
        (agent.hx, agent.hy, *wanted) = follow::steer::<S, BY_SINE>(motion, &force, sizes, hx, hy, speed);
    }
}
