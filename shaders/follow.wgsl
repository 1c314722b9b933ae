// The rule of agents that do not learn: a force from other agents and walls (paper, Section 4.1, Figure 2b).
//
// Uses: lib/math.wgsl, motion.wgsl (rotate, limits), generic.wgsl (shape), agent.wgsl (own), and from src/model: TINY.

// The sum over the agents that count for a term, in lattice distances, and their number.
struct Sum {
    x: i32,
    y: i32,
    count: i32,
}

// The numbers of a term that kernels are not specialised for.
struct Pull {
    inner2: f32,
    outer2: f32,
    scale: f32,
}

// A heading and the wanted speed along it.
struct Steering {
    hx: f32,
    hy: f32,
    speed: f32,
}

// Returns a sum with an offset or a heading, on its lattice, if the squared distance is within the term's. Compares bits,
// which are in the order of the numbers because only a distance within which nothing is can be negative.
fn with_other(sum: Sum, pull: Pull, d2: f32, x: i32, y: i32) -> Sum {
    let bits = bitcast<i32>(d2);
    let counts = bits <= bitcast<i32>(pull.outer2) && bits > bitcast<i32>(pull.inner2);
    return Sum(sum.x + select(0, x, counts), sum.y + select(0, y, counts), sum.count + select(0, 1, counts));
}

// The force on an agent that obeys a rule, and whether any agent or wall is near.
struct SteeringForce {
    x: f32,
    y: f32,
    influenced: bool,
}

// Adds the scaled mean of a term's sum.
fn add_term(pull: Pull, sum: Sum, force: ptr<function, SteeringForce>) {
    let scale = recip(nearest_f32(max(sum.count, 1))) * pull.scale;
    (*force).x += nearest_f32(sum.x) * scale;
    (*force).y += nearest_f32(sum.y) * scale;
    (*force).influenced = (*force).influenced || sum.count > 0;
}

// Returns the push of the two walls of one axis, and a number that is not negative if either is within their radius. The
// first pushes up to `near`, and the other is at `end`.
fn walls(at: f32, near: f32, end: f32) -> vec2<f32> {
    let low = near - at;
    let high = own.wall_radius - (end - at);
    let push = select(0.0, low, low > 0.0) - select(0.0, high, high > 0.0);
    return vec2(push * own.wall_gain, select(high, low, low > high));
}

// Adds the walls' push at a position to the force of all terms.
fn with_walls(terms: SteeringForce, x: f32, y: f32) -> SteeringForce {
    var near = vec2(own.wall_radius);
    if shape.confines {
        near = vec2(own.near_x, own.near_y);
    }
    let bounds = limits();
    let walls_x = walls(x, near.x, bounds.z);
    let walls_y = walls(y, near.y, bounds.w);
    let influenced = terms.influenced || walls_x.y >= 0.0 || walls_y.y >= 0.0;
    return SteeringForce(flush(terms.x + walls_x.x, TINY), flush(terms.y + walls_y.x, TINY), influenced);
}

// Returns the squared size of a force, and the inverse of its size.
fn sizes(force: SteeringForce) -> vec2<f32> {
    let force2 = force.x * force.x + force.y * force.y;
    return vec2(force2, rsqrt(force2));
}

// Turns the heading towards the force by at most the maximum turn. Returns the heading and the wanted speed.
//
// No angle is computed. The sine or cosine shows whether the force's direction is within the maximum turn. If so, it
// becomes the heading. Otherwise the heading turns by the maximum, to the side of the force.
fn steer(force: SteeringForce, sizes: vec2<f32>, hx: f32, hy: f32, speed: f32) -> Steering {
    let force2 = sizes.x;
    let inverse = sizes.y;
    let ux = force.x * inverse;
    let uy = force.y * inverse;
    let along = hx * ux + hy * uy;
    let across = hx * uy - hy * ux;
    let sine = select(0.0 - own.max_turn_sin, own.max_turn_sin, across >= 0.0);
    let turned = rotate(hx, hy, own.max_turn_cos, sine);
    let has_force = force2 > 0.0;
    // A cosine near 1 cannot resolve small angles, and a sine near 1 cannot resolve large ones. Without a force,
    // `along` is 0.
    var reached = along >= own.max_turn_cos && has_force;
    if own.by_sine != 0u {
        reached = along > 0.0 && abs(across) <= own.max_turn_sin;
    }
    let next_x = select(select(hx, turned.x, has_force), ux, reached);
    let next_y = select(select(hy, turned.y, has_force), uy, reached);
    let ahead = select(own.min_speed, force2 * inverse, along > 0.0);
    let wanted = select(speed, select(0.0, ahead, has_force), force.influenced);
    return Steering(next_x, next_y, wanted);
}
