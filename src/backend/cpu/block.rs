//! The state of one vector of teams, and one step of it.

use fearless_simd::{Simd, prelude::*};
use glam::Vec2;

use super::agent::Agent;
use super::neighbours::{self, Bounds};
use crate::backend::Moment;
use crate::declare::Fixed;
use crate::kernels::math::within;
use crate::kernels::{only, splat};
use crate::model::{Lanes, follow, motion, policy, sense};
use crate::world::{INPUTS, OUTPUTS, World};

/// Where a POI is.
pub(crate) trait Locus<S: Simd>: Copy {
    /// One team a lane.
    fn lanes(self, simd: S) -> [S::f32s; 2];
}

/// The same in all teams.
impl<S: Simd> Locus<S> for Vec2 {
    #[inline(always)]
    fn lanes(self, simd: S) -> [S::f32s; 2] {
        [splat(simd, self.x), splat(simd, self.y)]
    }
}

/// In each team its own.
impl<S: Simd> Locus<S> for [S::f32s; 2] {
    #[inline(always)]
    fn lanes(self, _: S) -> [S::f32s; 2] {
        self
    }
}

/// The state of one vector of teams, everything a lane a team, and a step of it. Every read in a step is of the state
/// before it.
pub(crate) struct Block<S: Simd> {
    pub(super) simd: S,
    pub(super) world: Lanes<S>,
    /// Leaders first.
    pub agents: Vec<Agent<S>>,
    pub inputs: Vec<[S::f32s; INPUTS]>,
    pub outputs: Vec<[S::f32s; OUTPUTS]>,
    /// The speed that each agent wants next.
    pub(super) wanted: Vec<S::f32s>,
    pub(super) followers: Vec<Follower<S>>,
    /// At how many steps each follower saw each leader, `[followers][leaders]`.
    pub counts: Vec<S::u32s>,
    /// A bit for each pair of agents that may be in reach in some lane: `[words][agents]`.
    pub(super) near: Vec<u64>,
    pub(super) bounds: Vec<Bounds<S>>,
}

/// What of a [`Block`] must be kept from one step to the next, once it has looked.
pub(crate) struct Standing<S: Simd> {
    pub agents: Vec<Agent<S>>,
    /// None where nobody asks for them.
    pub counts: Vec<S::u32s>,
    pub(super) near: Vec<u64>,
}

#[derive(Clone, Copy)]
pub(super) struct Follower<S: Simd> {
    sums: follow::Sums<S>,
    pull: follow::Pull<S>,
    sizes: (S::f32s, S::f32s),
}

impl<S: Simd> Block<S> {
    pub fn new(simd: S, world: &World) -> Block<S> {
        let zero = splat(simd, 0.0);
        let (agents, leaders, followers) = (world.agents(), world.leaders(), world.followers());
        let pull = follow::Pull { x: zero, y: zero, influenced: S::mask32s::splat(simd, false) };
        Block {
            simd,
            world: Lanes::new(simd, world.constants),
            agents: vec![Agent { x: zero, y: zero, hx: zero, hy: zero, speed: zero }; agents],
            inputs: vec![[zero; INPUTS]; leaders],
            outputs: vec![[zero; OUTPUTS]; leaders],
            wanted: vec![zero; agents],
            followers: vec![Follower { sums: follow::Sums::new(simd), pull, sizes: (zero, zero) }; followers],
            counts: vec![S::u32s::splat(simd, 0); followers * leaders],
            near: vec![0; agents.div_ceil(64) * agents],
            bounds: vec![Bounds::nowhere(simd); agents.div_ceil(S::f32s::LEN)],
        }
    }

    /// Only what is kept, with the counts or without.
    pub fn into_standing(self, counted: bool) -> Standing<S> {
        let Block { agents, counts, near, .. } = self;
        Standing { agents, counts: if counted { counts } else { vec![] }, near }
    }

    /// Takes on what stands of other teams, for what stands of these.
    #[inline(always)]
    pub fn swap(&mut self, standing: &mut Standing<S>) {
        std::mem::swap(&mut self.agents, &mut standing.agents);
        if !standing.counts.is_empty() {
            std::mem::swap(&mut self.counts, &mut standing.counts);
        }
        std::mem::swap(&mut self.near, &mut standing.near);
    }

    /// Puts one lane's agents where they start, with their first headings.
    #[inline(always)]
    pub fn place(&mut self, lane: usize, starts: &[Vec2], headings: &[Vec2]) {
        for ((agent, start), heading) in self.agents.iter_mut().zip(starts).zip(headings) {
            agent.x[lane] = start.x;
            agent.y[lane] = start.y;
            agent.hx[lane] = heading.x;
            agent.hy[lane] = heading.y;
        }
    }

    /// Sets all lanes' agents to their first speed.
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

    /// What leaders sense, for the policies to answer.
    #[inline(always)]
    pub fn look(&mut self, pois: &[impl Locus<S>]) {
        neighbours::find_near(&self.world, &self.agents, &mut self.near, &mut self.bounds);
        self.sense(pois);
    }

    /// Everyone moves: leaders as their policies answered, followers after whoever was near.
    #[inline(always)]
    pub fn go(&mut self) {
        self.act();
        self.follow();
        self.advance();
    }

    /// Leaders sense: all POIs, then the other agents, each in ascending order.
    #[inline(always)]
    fn sense(&mut self, pois: &[impl Locus<S>]) {
        self.world.constants.variant.density().fix(Sensing { block: self, pois });
    }

    #[inline(always)]
    fn sense_by<P: Locus<S>, const DENSITY: u32>(&mut self, pois: &[P]) {
        let Block { simd, world, agents, near, inputs, .. } = self;
        for (leader, (agent, inputs)) in agents.iter().zip(inputs).enumerate() {
            let &Agent { x, y, hx, hy, .. } = agent;
            let mut of_pois = [splat(*simd, 0.0); 4];
            let (fours, rest) = pois.as_chunks::<4>();
            for pois in fours {
                let mut densities = [x; 4];
                for (density, poi) in densities.iter_mut().zip(pois) {
                    let [px, py] = poi.lanes(*simd);
                    let [dx, dy] = [px - x, py - y];
                    *density = sensed::<S, DENSITY>(world, world.sense.poi_range2, dx, dy);
                }
                for (&density, poi) in densities.iter().zip(pois) {
                    let [px, py] = poi.lanes(*simd);
                    let [dx, dy] = [px - x, py - y];
                    sense::sense::<S>(density, dx, dy, hx, hy, &mut of_pois);
                }
            }
            for poi in rest {
                let [px, py] = poi.lanes(*simd);
                let [dx, dy] = [px - x, py - y];
                let density = sensed::<S, DENSITY>(world, world.sense.poi_range2, dx, dy);
                sense::sense::<S>(density, dx, dy, hx, hy, &mut of_pois);
            }
            let mut of_agents = [splat(*simd, 0.0); 4];
            neighbours::each_near(
                near,
                agents,
                leader,
                #[inline(always)]
                |_, other| {
                    let (dx, dy) = (other.x - x, other.y - y);
                    let density = sensed::<S, DENSITY>(world, world.sense.agent_range2, dx, dy);
                    sense::sense::<S>(density, dx, dy, hx, hy, &mut of_agents);
                },
            );
            *inputs = sense::weigh_in::<S>(world, of_pois, of_agents);
        }
    }

    /// Leaders turn and wish for a speed as their policies say.
    #[inline(always)]
    fn act(&mut self) {
        let Block { world, agents, outputs, wanted, .. } = self;
        for ((agent, wanted), &[turn, speed]) in agents.iter_mut().zip(wanted).zip(&*outputs) {
            (agent.hx, agent.hy) = motion::turn::<S>(world, agent.hx, agent.hy, policy::wanted_turn::<S>(turn));
            *wanted = policy::wanted_speed::<S>(world, speed);
        }
    }

    /// Followers count the leaders they see and follow whoever is near.
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

    /// Everyone moves.
    #[inline(always)]
    fn advance(&mut self) {
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

    /// One lane's agents as they stand; before the first step nothing has been sensed yet.
    pub(super) fn moments(&self, lane: usize, sensed: bool, moments: &mut [Moment]) {
        let leaders = self.outputs.len();
        for (index, (agent, moment)) in self.agents.iter().zip(moments).enumerate() {
            if sensed && index < leaders {
                moment.inputs = self.inputs[index].map(|input| input[lane]);
                moment.outputs = self.outputs[index].map(|output| output[lane]);
            } else if sensed {
                let follower = &self.followers[index - leaders];
                moment.force = [follower.pull.x[lane], follower.pull.y[lane]];
            }
            moment.position = [agent.x[lane], agent.y[lane]];
            moment.heading = [agent.hx[lane], agent.hy[lane]];
            moment.speed = agent.speed[lane];
        }
    }
}

/// Leaders sense by one of the densities.
struct Sensing<'a, S: Simd, P> {
    block: &'a mut Block<S>,
    pois: &'a [P],
}

impl<S: Simd, P: Locus<S>> Fixed for Sensing<'_, S, P> {
    type Output = ();

    #[inline(always)]
    fn with<const DENSITY: u32>(self) {
        self.block.sense_by::<P, DENSITY>(self.pois);
    }
}

/// Turns followers to where they are pulled. In short loops: the processor sees far enough ahead to keep its units
/// busy.
#[inline(always)]
fn steer<S: Simd, const BY_SINE: bool>(
    world: &Lanes<S>,
    agents: &mut [Agent<S>],
    followers: &mut [Follower<S>],
    wanted: &mut [S::f32s],
) {
    for (agent, follower) in agents.iter().zip(&mut *followers) {
        follower.pull = follow::force::<S>(world, &follower.sums, agent.x, agent.y);
    }
    for follower in &mut *followers {
        follower.sizes = follow::sizes::<S>(&follower.pull);
    }
    for ((agent, wanted), follower) in agents.iter_mut().zip(wanted).zip(followers) {
        let &mut Agent { hx, hy, speed, .. } = agent;
        let &mut Follower { pull, sizes, .. } = follower;
        (agent.hx, agent.hy, *wanted) = follow::steer::<S, BY_SINE>(world, &pull, sizes, hx, hy, speed);
    }
}

/// What an entity at offset (`dx`, `dy`) adds to the density of its quadrant: nothing beyond the range.
#[inline(always)]
fn sensed<S: Simd, const DENSITY: u32>(world: &Lanes<S>, range2: S::f32s, dx: S::f32s, dy: S::f32s) -> S::f32s {
    only::<S>(sense::density::<S, DENSITY>(world, dx, dy), within::<S>(dx, dy, range2))
}
