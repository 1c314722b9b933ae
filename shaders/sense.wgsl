// Sensing: the density of POIs and of agents in four quadrants around a leader's heading (paper, Section 3.1).
//
// Uses: lib/math.wgsl, episode.wgsl (world), generic.wgsl (variant), and from src/model: INPUTS, DENSITY_LINEAR,
// DENSITY_MEAN.

// Returns the density of an entity at offset (`dx`, `dy`) in lattice distances. The caller checks that it is in range.
fn density(dx: f32, dy: f32) -> i32 {
    let base = world.density_base;
    let d2 = dx * dx + dy * dy;
    if variant.density == DENSITY_LINEAR {
        return less_base(1.0 + base - exact_sqrt(d2) * world.inverse_diagonal, base);
    }
    return on_lattice(rsqrt(select(1.0, d2, d2 > 1.0)), base);
}

// The entities of one class around a leader: sums over all, over those on the left, in front, and both.
struct Quadrants {
    // Of their densities, in lattice distances.
    densities: vec4<i32>,
    // Of their number. Only means need it.
    counts: vec4<i32>,
}

// Adds an entity with this density, which is 0 out of range, at offset (`dx`, `dy`) from a leader with heading (`hx`,
// `hy`).
//
// The signs of the offset along the heading and to its left determine the quadrant. A tie goes to the counterclockwise
// quadrant, so that each boundary belongs to exactly one.
fn add_sensed(density: i32, dx: f32, dy: f32, hx: f32, hy: f32, quadrants: ptr<function, Quadrants>) {
    let fx = dx * hx + dy * hy;
    let fy = dy * hx - dx * hy;
    let left = fy > 0.0 || (fy >= 0.0 && fx >= 0.0);
    let front = fx > 0.0 || (fx >= 0.0 && !(fy > 0.0));
    let halves = vec4(true, left, front, left && front);
    (*quadrants).densities += select(vec4(0), vec4(density), halves);
    if variant.density == DENSITY_MEAN {
        (*quadrants).counts += select(vec4(0), vec4(select(0, 1, density > 0)), halves);
    }
}

// Returns the sum of each quadrant, in the order of the policy's inputs: back right, front right, front left, back left.
fn quadrant_sums(halves: vec4<i32>) -> vec4<f32> {
    let all = halves.x;
    let left = halves.y;
    let front = halves.z;
    let both = halves.w;
    return vec4(
        nearest_f32(all - left - front + both),
        nearest_f32(front - both),
        nearest_f32(both),
        nearest_f32(left - both),
    );
}

// Returns the sums of all quadrants, or the means.
fn sums_or_means(quadrants: Quadrants) -> vec4<f32> {
    let sums = quadrant_sums(quadrants.densities);
    if variant.density != DENSITY_MEAN {
        return sums;
    }
    let counts = quadrant_sums(quadrants.counts);
    return vec4(
        sums.x * recip(select(1.0, counts.x, counts.x > 1.0)),
        sums.y * recip(select(1.0, counts.y, counts.y > 1.0)),
        sums.z * recip(select(1.0, counts.z, counts.z > 1.0)),
        sums.w * recip(select(1.0, counts.w, counts.w > 1.0)),
    );
}

// Returns the policy's inputs: the densities of both kinds, each multiplied by its constant.
fn scale_inputs(of_pois: Quadrants, of_agents: Quadrants) -> array<f32, INPUTS> {
    let p = sums_or_means(of_pois) * world.poi_share;
    let a = sums_or_means(of_agents) * world.agent_share;
    return array(p.x, p.y, p.z, p.w, a.x, a.y, a.z, a.w);
}
