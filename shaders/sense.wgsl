// Sensing: the density of POIs and of agents in four quadrants around a leader's heading (paper, Section 3.1).
//
// Uses: lib/math.wgsl, episode.wgsl (world), generic.wgsl (variant), and from src/model: INPUTS, DENSITY_LINEAR,
// DENSITY_MEAN.

// Returns the density of an entity at offset (`dx`, `dy`). The caller checks that it is in range.
fn density(dx: f32, dy: f32) -> f32 {
    let d2 = dx * dx + dy * dy;
    if variant.density == DENSITY_LINEAR {
        return 1.0 - exact_sqrt(d2) * world.inverse_diagonal;
    }
    return rsqrt(select(1.0, d2, d2 > 1.0));
}

// The entities of one class around a leader, by quadrant in the order of the policy's inputs: back right, front right,
// front left, back left.
struct Quadrants {
    // The sums of their densities.
    sums: vec4<f32>,
    // The number of entities sensed. Only means need it.
    counts: vec4<f32>,
}

// Adds an entity with this density, which is 0 out of range, at offset (`dx`, `dy`) from a leader with heading (`hx`,
// `hy`).
fn add_sensed(density: f32, dx: f32, dy: f32, hx: f32, hy: f32, quadrants: ptr<function, Quadrants>) {
    var sums = (*quadrants).sums;
    sense(density, dx, dy, hx, hy, &sums);
    (*quadrants).sums = sums;
    if variant.density == DENSITY_MEAN {
        var counts = (*quadrants).counts;
        sense(select(0.0, 1.0, density > 0.0), dx, dy, hx, hy, &counts);
        (*quadrants).counts = counts;
    }
}

// Adds the density of the entity at offset (`dx`, `dy`) to the sum of its quadrant.
//
// The signs of the offset along the heading and to its left determine the quadrant. A tie goes to the counterclockwise
// quadrant, so that each boundary belongs to exactly one.
fn sense(density: f32, dx: f32, dy: f32, hx: f32, hy: f32, sums: ptr<function, vec4<f32>>) {
    let fx = dx * hx + dy * hy;
    let fy = dy * hx - dx * hy;
    let left = fy > 0.0 || (fy >= 0.0 && fx >= 0.0);
    let front = fx > 0.0 || (fx >= 0.0 && !(fy > 0.0));
    // One sum grows. Adding 0 to the others would not change their bits.
    let old = *sums;
    let grown = select(select(old.x, old.y, front), select(old.w, old.z, front), left) + density;
    (*sums).x = select(old.x, grown, !left && !front);
    (*sums).y = select(old.y, grown, !left && front);
    (*sums).z = select(old.z, grown, left && front);
    (*sums).w = select(old.w, grown, left && !front);
}

// Returns the sum of a quadrant, or its mean.
fn density_of(sum: f32, count: f32) -> f32 {
    return select(sum, sum * recip(select(1.0, count, count > 1.0)), variant.density == DENSITY_MEAN);
}

// Returns the densities of all quadrants.
fn densities(quadrants: Quadrants) -> vec4<f32> {
    let sums = quadrants.sums;
    let counts = quadrants.counts;
    return vec4(
        density_of(sums.x, counts.x),
        density_of(sums.y, counts.y),
        density_of(sums.z, counts.z),
        density_of(sums.w, counts.w),
    );
}

// Returns the policy's inputs: the densities of both kinds, each multiplied by its constant.
fn scale_inputs(of_pois: Quadrants, of_agents: Quadrants) -> array<f32, INPUTS> {
    let p = densities(of_pois) * world.poi_share;
    let a = densities(of_agents) * world.agent_share;
    return array(p.x, p.y, p.z, p.w, a.x, a.y, a.z, a.w);
}
