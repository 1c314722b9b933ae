//! The followers' preset behaviour: attraction to agents in sight, repulsion from close ones and walls (paper, Section
//! 4.1, Figure 2b).

use fearless_simd::{Simd, prelude::*};

use super::{LONGEST, Lanes, TINY, motion::GRID, motion::rotate};
use crate::gpu_struct::gpu_struct;
use crate::kernels::{
    larger,
    math::{flush, lattice, nearest_f32, on_lattice, recip, rsqrt, within},
    select, splat, zero_unless,
};
use crate::reader::{Reader, between, section};

/// The shader of this part.
pub(crate) const WGSL: &str = include_str!("../../shaders/follow.wgsl");

/// Maximum gain of a force.
const MAX_GAIN: f64 = 1e3;

section! {
    /// `[follow]`: the followers' preset behaviour.
    Follow = "follow" {
        /// a follower sees other agents within this distance: they attract it, and the leaders among them count for Df
        /// and Dt
        attraction_radius: f64 = "units", "4.1, 4.2",
        /// agents and walls within this distance repel a follower
        repulsion_radius: f64 = "units", "4.1",
        /// pull of others at the attraction radius
        attraction_gain: f64 = "units/s", "4.1, Fig. 2b",
        /// push of others at the repulsion radius
        repulsion_gain: f64 = "units/s", "4.1, Fig. 2b",
        /// push of a wall for each unit nearer than the repulsion radius
        wall_gain: f64 = "1/s", "",
    }
}

impl Follow {
    /// Reads the section.
    pub(crate) fn read(r: &mut Reader<'_>) -> Follow {
        let attraction_radius = Follow::attraction_radius(r).number(between(0.01, LONGEST), 5.0);
        let closest = between(0.01, attraction_radius).because("follow.attraction_radius");
        let gain = between(1e-3, MAX_GAIN).or_zero();
        Follow {
            attraction_radius,
            repulsion_radius: Follow::repulsion_radius(r).number(closest, 1.0),
            attraction_gain: Follow::attraction_gain(r).number(gain, 5.0),
            repulsion_gain: Follow::repulsion_gain(r).number(gain, 1.0),
            wall_gain: Follow::wall_gain(r).number(gain, 1.0),
        }
    }
}

gpu_struct! {
    /// Constants of following.
    pub struct FollowConstants as FollowLanes {
        /// The attraction radius, squared.
        pub attraction_radius2: f32,
        /// The repulsion radius, squared.
        pub repulsion_radius2: f32,
        /// The distance within which walls push.
        pub repulsion_radius: f32,
        /// The base of the lattice of offsets, on which they are added.
        pub offset_base: f32,
        /// The attraction gain over the attraction radius, per lattice distance.
        pub attraction_scale: f32,
        /// The repulsion gain over the repulsion radius, per lattice distance.
        pub repulsion_scale: f32,
        /// The push per unit that a wall is nearer than the repulsion radius.
        pub wall_gain: f32,
    }
}

impl FollowConstants {
    /// Computes the constants of a valid section for teams of so many agents.
    pub fn new(follow: &Follow, agents: usize) -> FollowConstants {
        let squared = |radius: f64| (radius * radius) as f32;
        // Within a radius, which is squared and rounded, an offset may exceed it by rounding.
        let [offset_base, distance] = lattice(agents, follow.attraction_radius * 1.01, 1.0 / f64::from(GRID));
        let scale = |gain: f64, radius: f64| (gain / radius * f64::from(distance)) as f32;
        FollowConstants {
            attraction_radius2: squared(follow.attraction_radius),
            repulsion_radius2: squared(follow.repulsion_radius),
            repulsion_radius: follow.repulsion_radius as f32,
            offset_base,
            attraction_scale: scale(follow.attraction_gain, follow.attraction_radius),
            repulsion_scale: scale(follow.repulsion_gain, follow.repulsion_radius),
            wall_gain: follow.wall_gain as f32,
        }
    }
}

/// Sums, in lattice distances, and counts of the offsets to agents within a follower's radii.
#[derive(Clone, Copy)]
pub struct Sums<S: Simd> {
    /// The sum of x within the repulsion radius.
    pub repel_x: S::i32s,
    /// The sum of y within the repulsion radius.
    pub repel_y: S::i32s,
    /// The number of agents within the repulsion radius.
    pub repel_count: S::i32s,
    /// The sum of x within the attraction radius but not the repulsion radius.
    pub attract_x: S::i32s,
    /// The sum of y of the same agents.
    pub attract_y: S::i32s,
    /// The number of the same agents.
    pub attract_count: S::i32s,
}

impl<S: Simd> Sums<S> {
    /// Returns empty sums.
    #[inline(always)]
    pub fn new(simd: S) -> Sums<S> {
        let none = S::i32s::splat(simd, 0);
        Sums { repel_x: none, repel_y: none, repel_count: none, attract_x: none, attract_y: none, attract_count: none }
    }
}

/// Returns the lanes in which a follower sees the agent at offset (`dx`, `dy`): it is within the attraction radius.
#[inline(always)]
pub(crate) fn sees<S: Simd>(world: &Lanes<S>, dx: S::f32s, dy: S::f32s) -> S::mask32s {
    within::<S>(dx, dy, world.follow.attraction_radius2)
}

/// Adds the agent at offset (`dx`, `dy`), and returns the lanes in which the follower sees it.
#[inline(always)]
pub(crate) fn influence<S: Simd>(world: &Lanes<S>, dx: S::f32s, dy: S::f32s, sums: &mut Sums<S>) -> S::mask32s {
    let near = within::<S>(dx, dy, world.follow.repulsion_radius2);
    let seen = within::<S>(dx, dy, world.follow.attraction_radius2);
    let (repels, attracts) = (near.to_vector(), (seen & !near).to_vector());
    let base = world.follow.offset_base;
    let [dx, dy] = [on_lattice::<S>(dx, base), on_lattice::<S>(dy, base)];
    sums.repel_x += dx & repels;
    sums.repel_y += dy & repels;
    sums.repel_count -= repels;
    sums.attract_x += dx & attracts;
    sums.attract_y += dy & attracts;
    sums.attract_count -= attracts;
    seen
}

/// The force on a follower.
#[derive(Clone, Copy)]
pub struct SteeringForce<S: Simd> {
    /// Along x, in units per second.
    pub x: S::f32s,
    /// Along y, in units per second.
    pub y: S::f32s,
    /// The lanes in which any agent or wall is near.
    pub influenced: S::mask32s,
}

/// Returns the push of the two walls of one axis, at 0 and at `size`, and a number that is not negative if either is
/// within the repulsion radius.
#[inline(always)]
fn walls<S: Simd>(world: &Lanes<S>, at: S::f32s, size: S::f32s) -> (S::f32s, S::f32s) {
    let zero = splat(at.token(), 0.0);
    let low = world.follow.repulsion_radius - at;
    let high = world.follow.repulsion_radius - (size - at);
    ((larger::<S>(low, zero) - larger::<S>(high, zero)) * world.follow.wall_gain, larger::<S>(low, high))
}

/// Returns the sum of repulsion, attraction and wall push at a position. Each mean offset is scaled by gain over
/// radius.
#[inline(always)]
pub fn force<S: Simd>(world: &Lanes<S>, sums: &Sums<S>, x: S::f32s, y: S::f32s) -> SteeringForce<S> {
    let repel = recip::<S>(sums.repel_count.max(1).to_float()) * world.follow.repulsion_scale;
    let attract = recip::<S>(sums.attract_count.max(1).to_float()) * world.follow.attraction_scale;
    let (push_x, near_x) = walls::<S>(world, x, world.motion.map_x);
    let (push_y, near_y) = walls::<S>(world, y, world.motion.map_y);
    let force_x = nearest_f32::<S>(sums.attract_x) * attract - nearest_f32::<S>(sums.repel_x) * repel + push_x;
    let force_y = nearest_f32::<S>(sums.attract_y) * attract - nearest_f32::<S>(sums.repel_y) * repel + push_y;
    SteeringForce {
        x: flush::<S>(force_x, TINY),
        y: flush::<S>(force_y, TINY),
        influenced: (sums.repel_count + sums.attract_count).simd_gt(0) | larger::<S>(near_x, near_y).simd_ge(0.0),
    }
}

/// Returns the squared size of a force, and the inverse of its size.
#[inline(always)]
pub fn sizes<S: Simd>(force: &SteeringForce<S>) -> (S::f32s, S::f32s) {
    let force2 = force.x * force.x + force.y * force.y;
    (force2, rsqrt::<S>(force2))
}

/// Turns the heading towards the force by at most the maximum turn. Returns the heading and the wanted speed. The
/// second argument is the force's [`sizes`].
///
/// No angle is computed. The sine or cosine shows whether the force's direction is within the maximum turn. If so, it
/// becomes the heading. Otherwise the heading turns by the maximum, to the side of the force.
///
/// A cosine near 1 cannot resolve small angles, and a sine near 1 cannot resolve large ones. So `BY_SINE` is set if the
/// maximum turn is small.
#[inline(always)]
pub(crate) fn steer<S: Simd, const BY_SINE: bool>(
    world: &Lanes<S>,
    force: &SteeringForce<S>,
    (force2, inverse): (S::f32s, S::f32s),
    hx: S::f32s,
    hy: S::f32s,
    speed: S::f32s,
) -> (S::f32s, S::f32s, S::f32s) {
    let zero = splat(hx.token(), 0.0);
    let ux = force.x * inverse;
    let uy = force.y * inverse;
    let along = hx * ux + hy * uy;
    let across = hx * uy - hy * ux;
    let sine = select::<S>(zero - world.motion.max_turn_sin, world.motion.max_turn_sin, across.simd_ge(zero));
    let (turned_x, turned_y) = rotate::<S>(hx, hy, world.motion.max_turn_cos, sine);
    let has_force = force2.simd_gt(zero);
    // Without a force, `along` is 0.
    let reached = if BY_SINE {
        along.simd_gt(zero) & across.abs().simd_le(world.motion.max_turn_sin)
    } else {
        along.simd_ge(world.motion.max_turn_cos) & has_force
    };
    // The order matters for speed only: with the heading selected last, the compiler would emit a slow masked store.
    let next_x = select::<S>(select::<S>(hx, turned_x, has_force), ux, reached);
    let next_y = select::<S>(select::<S>(hy, turned_y, has_force), uy, reached);
    let ahead = select::<S>(world.motion.min_speed, force2 * inverse, along.simd_gt(zero));
    let wanted = select::<S>(speed, zero_unless::<S>(ahead, has_force), force.influenced);
    (next_x, next_y, wanted)
}

#[cfg(test)]
mod tests {
    use fearless_simd::{Level, dispatch};

    use super::*;
    use crate::config::Config;
    use crate::world::World;

    /// Each component of a force is at most the two gains, as each mean offset is within its radius, and the push of
    /// the walls, which is at most the gain times the radius or the side. So the square is in the range of [`rsqrt`],
    /// whose error holds up to 2^48.
    #[test]
    fn the_largest_force_of_any_config_is_in_the_range_of_rsqrt() {
        const RANGE: f64 = (1u64 << 48) as f64;
        let rounding = 1.0 + f64::from(f32::EPSILON) * 2048.0;
        let component = (2.0 * MAX_GAIN + LONGEST * MAX_GAIN) * rounding;
        assert!(2.0 * component * component < RANGE);
        // A follower in a corner of the largest map, with walls, radii and gains as large as may be.
        let text = format!(
            "[world]\nmap = [{LONGEST:?}, {LONGEST:?}]\nleaders = [[1, 1]]\nfollowers = [[0, 0]]\npois = [[9, 9]]\n\
             [follow]\nattraction_radius = {LONGEST:?}\nrepulsion_radius = {LONGEST:?}\nattraction_gain = {MAX_GAIN:?}\n\
             repulsion_gain = {MAX_GAIN:?}\nwall_gain = {MAX_GAIN:?}"
        );
        let config = Config::parse(&text, "largest.toml").expect("the largest values are valid");
        let world = World::new(&config.validate().unwrap());
        fn squared<S: Simd>(simd: S, world: &World) -> f32 {
            let (lanes, zero) = (Lanes::new(simd, world.constants), splat(simd, 0.0));
            let force2 = sizes::<S>(&force::<S>(&lanes, &Sums::new(simd), zero, zero)).0;
            force2[0]
        }
        let found = f64::from(dispatch!(Level::new(), simd => squared(simd, &world)));
        assert!((1e14..RANGE).contains(&found), "{found:e}");
        let over = text.replace(&format!("wall_gain = {MAX_GAIN:?}"), "wall_gain = 1001.0");
        assert!(Config::parse(&over, "larger.toml").is_err());
    }
}
