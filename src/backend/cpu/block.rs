//! The state of one vector of teams, and one step of it.

use fearless_simd::{Simd, prelude::*};
use glam::Vec2;

use super::agent::Agent;
use super::neighbours::{self, Bounds};
use super::pois::PoiPosition;
use crate::backend::Moment;
use crate::config_enum::ConstDispatch;
use crate::kernels::math::within;
use crate::kernels::splat;
use crate::model::{Lanes, follow, motion, policy, sense};
use crate::world::{INPUTS, OUTPUTS, World};

/// The state of one vector of teams, one team per lane, with scratch memory for a step. A step reads only the
/// previous state.
pub(crate) struct Block<S: Simd> {
    pub simd: S,
    pub(super) world: Lanes<S>,
    /// `[agents]`, leaders first.
    pub agents: Vec<Agent<S>>,
    /// Inputs of the leaders, `[leaders]`.
    pub inputs: Vec<[S::f32s; INPUTS]>,
    /// Outputs of the leaders' policies, `[leaders]`.
    pub outputs: Vec<[S::f32s; OUTPUTS]>,
    /// Wanted speeds in units per second, `[agents]`.
    pub(super) wanted: Vec<S::f32s>,
    /// `[followers]`.
    pub(super) followers: Vec<Follower<S>>,
    /// The number of steps at which each follower saw each leader, `[followers][leaders]`.
    pub counts: Vec<S::u32s>,
    /// The pairs of agents that may be in reach in some lane, one bit each, `[words][agents]`.
    pub(super) near: Vec<u64>,
    pub(super) bounds: Vec<Bounds<S>>,
}

/// The part of a [`Block`] that the next step depends on, after [`Block::sense`].
pub(crate) struct BlockState<S: Simd> {
    pub agents: Vec<Agent<S>>,
    /// Empty unless scores need them.
    pub counts: Vec<S::u32s>,
    pub(super) near: Vec<u64>,
}

#[derive(Clone, Copy)]
pub(super) struct Follower<S: Simd> {
    sums: follow::Sums<S>,
    force: follow::SteeringForce<S>,
    /// The squared size of the force, and the inverse of its size.
    sizes: (S::f32s, S::f32s),
}

impl<S: Simd> Block<S> {
    pub fn new(simd: S, world: &World) -> Block<S> {
        let zero = splat(simd, 0.0);
        let (agents, leaders, followers) = (world.agents(), world.leaders(), world.followers());
        let force = follow::SteeringForce { x: zero, y: zero, influenced: S::mask32s::splat(simd, false) };
        Block {
            simd,
            world: Lanes::new(simd, world.constants),
            agents: vec![Agent { x: zero, y: zero, hx: zero, hy: zero, speed: zero }; agents],
            inputs: vec![[zero; INPUTS]; leaders],
            outputs: vec![[zero; OUTPUTS]; leaders],
            wanted: vec![zero; agents],
            followers: vec![Follower { sums: follow::Sums::new(simd), force, sizes: (zero, zero) }; followers],
            counts: vec![S::u32s::splat(simd, 0); followers * leaders],
            near: vec![0; agents.div_ceil(64) * agents],
            bounds: vec![Bounds::nowhere(simd); agents.div_ceil(S::f32s::LEN)],
        }
    }

    /// Returns the state to keep, with the counts or without.
    pub fn into_state(self, counted: bool) -> BlockState<S> {
        let Block { agents, counts, near, .. } = self;
        BlockState { agents, counts: if counted { counts } else { vec![] }, near }
    }

    /// Exchanges this block's state for another.
    #[inline(always)]
    pub fn swap(&mut self, state: &mut BlockState<S>) {
        std::mem::swap(&mut self.agents, &mut state.agents);
        if !state.counts.is_empty() {
            std::mem::swap(&mut self.counts, &mut state.counts);
        }
        std::mem::swap(&mut self.near, &mut state.near);
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

    /// Sets all lanes' agents to their initial speed.
    #[inline(always)]
    pub fn start(&mut self) {
        let Block { simd, world, agents, counts, .. } = self;
        for agent in agents {
            agent.speed = splat(*simd, world.constants.speed);
        }
        counts.fill(S::u32s::splat(*simd, 0));
    }

    /// [`Block::start`] of one lane.
    #[inline(always)]
    pub fn start_lane(&mut self, lane: usize) {
        let speed = self.world.constants.speed;
        for agent in &mut self.agents {
            agent.speed[lane] = speed;
        }
        self.counts.iter_mut().for_each(|count| count[lane] = 0);
    }

    /// Computes the inputs of the leaders' policies: leaders sense all POIs, then the other agents, each in ascending
    /// order.
    #[inline(always)]
    pub fn sense(&mut self, pois: &[impl PoiPosition<S>]) {
        neighbours::find_near(&self.world, &self.agents, &mut self.near, &mut self.bounds);
        self.world.constants.variant.density().dispatch(Sensing { block: self, pois });
    }

    /// Plays a step by the leaders' outputs. Writes which leaders each follower sees before it moves, unless `sights` is
    /// empty, and the agents at each POI after it, see [`Block::record_sightings`] and [`Block::record_poi_sets`].
    #[inline(always)]
    pub fn step(&mut self, pois: &[impl PoiPosition<S>], sights: &mut [u32], sets: &mut [u32]) {
        if !sights.is_empty() {
            self.record_sightings(sights);
        }
        self.lead();
        self.follow();
        self.move_agents();
        self.record_poi_sets(pois, sets);
    }

    #[inline(always)]
    fn sense_by<P: PoiPosition<S>, const DENSITY: u32>(&mut self, pois: &[P]) {
        let Block { simd, world, agents, near, inputs, .. } = self;
        for (leader, (agent, inputs)) in agents.iter().zip(inputs).enumerate() {
            let &Agent { x, y, hx, hy, .. } = agent;
            let mut of_pois = sense::Quadrants::new(*simd);
            let (fours, rest) = pois.as_chunks::<4>();
            for pois in fours {
                let mut densities = [S::i32s::splat(*simd, 0); 4];
                for (density, poi) in densities.iter_mut().zip(pois) {
                    let [px, py] = poi.lanes(*simd);
                    let [dx, dy] = [px - x, py - y];
                    *density = sensed::<S, DENSITY>(world, world.sense.poi_range2, dx, dy);
                }
                for (&density, poi) in densities.iter().zip(pois) {
                    let [px, py] = poi.lanes(*simd);
                    let [dx, dy] = [px - x, py - y];
                    of_pois.add::<DENSITY>(density, dx, dy, hx, hy);
                }
            }
            for poi in rest {
                let [px, py] = poi.lanes(*simd);
                let [dx, dy] = [px - x, py - y];
                let density = sensed::<S, DENSITY>(world, world.sense.poi_range2, dx, dy);
                of_pois.add::<DENSITY>(density, dx, dy, hx, hy);
            }
            let mut of_agents = sense::Quadrants::new(*simd);
            neighbours::each_near(
                near,
                agents,
                leader,
                #[inline(always)]
                |_, other| {
                    let (dx, dy) = (other.x - x, other.y - y);
                    let density = sensed::<S, DENSITY>(world, world.sense.agent_range2, dx, dy);
                    of_agents.add::<DENSITY>(density, dx, dy, hx, hy);
                },
            );
            *inputs = sense::scale_inputs::<S, DENSITY>(world, of_pois, of_agents);
        }
    }

    /// Leaders turn, and set their wanted speed, by their policies' outputs.
    #[inline(always)]
    fn lead(&mut self) {
        let Block { world, agents, outputs, wanted, .. } = self;
        for ((agent, wanted), &[turn, speed]) in agents.iter_mut().zip(wanted).zip(&*outputs) {
            (agent.hx, agent.hy) = motion::turn::<S>(world, agent.hx, agent.hy, policy::wanted_turn::<S>(turn));
            *wanted = policy::wanted_speed::<S>(world, speed);
        }
    }

    /// Followers count the leaders they see, and follow the agents near them.
    #[inline(always)]
    fn follow(&mut self) {
        let Block { simd, world, agents, wanted, near, followers, counts, .. } = self;
        let leaders = world.constants.leaders as usize;
        for (index, (follower, counts)) in followers.iter_mut().zip(counts.chunks_exact_mut(leaders)).enumerate() {
            let &Agent { x, y, .. } = &agents[leaders + index];
            let mut sums = follow::Sums::new(*simd);
            neighbours::each_near(
                near,
                agents,
                leaders + index,
                #[inline(always)]
                |index, other| {
                    let seen = follow::influence::<S>(world, other.x - x, other.y - y, &mut sums);
                    if let Some(count) = counts.get_mut(index) {
                        *count -= seen.to_vector().bitcast::<S::u32s>();
                    }
                },
            );
            follower.sums = sums;
        }
        let (agents, wanted) = (&mut agents[leaders..], &mut wanted[leaders..]);
        if world.constants.variant.by_sine != 0 {
            steer::<S, true>(world, agents, followers, wanted);
        } else {
            steer::<S, false>(world, agents, followers, wanted);
        }
    }

    /// Moves all agents along their headings.
    #[inline(always)]
    fn move_agents(&mut self) {
        let world = &self.world;
        for (agent, &wanted) in self.agents.iter_mut().zip(&self.wanted) {
            (agent.hx, agent.hy) = motion::renormalize::<S>(agent.hx, agent.hy);
            agent.speed = motion::accelerate::<S>(world, agent.speed, wanted);
        }
        for agent in &mut self.agents {
            let step = agent.speed * world.motion.dt;
            agent.x = motion::advance::<S>(agent.x, step, agent.hx, world.motion.map_x);
            agent.y = motion::advance::<S>(agent.y, step, agent.hy, world.motion.map_y);
        }
    }

    /// Writes the moments of one lane's agents. Before the first step nothing has been sensed.
    pub(super) fn moments(&self, lane: usize, sensed: bool, moments: &mut [Moment]) {
        let leaders = self.outputs.len();
        for (index, (agent, moment)) in self.agents.iter().zip(moments).enumerate() {
            if sensed && index < leaders {
                moment.inputs = self.inputs[index].map(|input| input[lane]);
                moment.outputs = self.outputs[index].map(|output| output[lane]);
            } else if sensed {
                let follower = &self.followers[index - leaders];
                moment.force = [follower.force.x[lane], follower.force.y[lane]];
            }
            moment.position = [agent.x[lane], agent.y[lane]];
            moment.heading = [agent.hx[lane], agent.hy[lane]];
            moment.speed = agent.speed[lane];
        }
    }
}

/// [`Block::sense_by`] with the density as a constant.
struct Sensing<'a, S: Simd, P> {
    block: &'a mut Block<S>,
    pois: &'a [P],
}

impl<S: Simd, P: PoiPosition<S>> ConstDispatch for Sensing<'_, S, P> {
    type Output = ();

    #[inline(always)]
    fn with<const DENSITY: u32>(self) {
        self.block.sense_by::<P, DENSITY>(self.pois);
    }
}

/// Turns followers towards the force on them. Several short loops: out-of-order execution overlaps iterations only if
/// they are short.
#[inline(always)]
fn steer<S: Simd, const BY_SINE: bool>(
    world: &Lanes<S>,
    agents: &mut [Agent<S>],
    followers: &mut [Follower<S>],
    wanted: &mut [S::f32s],
) {
    for (agent, follower) in agents.iter().zip(&mut *followers) {
        follower.force = follow::force::<S>(world, &follower.sums, agent.x, agent.y);
    }
    for follower in &mut *followers {
        follower.sizes = follow::sizes::<S>(&follower.force);
    }
    for ((agent, wanted), follower) in agents.iter_mut().zip(wanted).zip(followers) {
        let &mut Agent { hx, hy, speed, .. } = agent;
        let &mut Follower { force, sizes, .. } = follower;
        (agent.hx, agent.hy, *wanted) = follow::steer::<S, BY_SINE>(world, &force, sizes, hx, hy, speed);
    }
}

/// Returns the density that an entity at offset (`dx`, `dy`) adds to its quadrant, in lattice distances: 0 out of range.
#[inline(always)]
fn sensed<S: Simd, const DENSITY: u32>(world: &Lanes<S>, range2: S::f32s, dx: S::f32s, dy: S::f32s) -> S::i32s {
    sense::density::<S, DENSITY>(world, dx, dy) & within::<S>(dx, dy, range2).to_vector()
}
