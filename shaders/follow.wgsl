// A follower's preset behaviour: drawn to agents in sight, pushed off close ones and walls (Section 4.1, Figure 2b).

// Offsets to the agents within a follower's radii, summed and counted.
struct Sums {
    repel_x: f32,
    repel_y: f32,
    repel_count: f32,
    attract_x: f32,
    attract_y: f32,
    attract_count: f32,
}

// A heading and the wanted speed along it.
struct Course {
    hx: f32,
    hy: f32,
    speed: f32,
}

// Adds the agent at offset (`dx`, `dy`); tells whether it is within the attraction radius.
fn influence(dx: f32, dy: f32, sums: ptr<function, Sums>) -> bool {
    let d2 = dx * dx + dy * dy;
    let near = d2 <= world.repulsion_radius2;
    let seen = d2 <= world.attraction_radius2;
    let far = seen && !near;
    (*sums).repel_x += select(0.0, dx, near);
    (*sums).repel_y += select(0.0, dy, near);
    (*sums).repel_count += select(0.0, 1.0, near);
    (*sums).attract_x += select(0.0, dx, far);
    (*sums).attract_y += select(0.0, dy, far);
    (*sums).attract_count += select(0.0, 1.0, far);
    return seen;
}

// The push of the two walls of one axis, at 0 and at `size`.
fn wall_push(at: f32, size: f32) -> f32 {
    let radius = world.repulsion_radius;
    let low = radius - at;
    let high = radius - (size - at);
    let push = select(0.0, low, low > 0.0) - select(0.0, high, high > 0.0);
    return push * world.wall_gain;
}

// Whether a wall of one axis is within the repulsion radius.
fn wall_near(at: f32, size: f32) -> bool {
    let high = size - at;
    return at <= world.repulsion_radius || high <= world.repulsion_radius;
}

// The sum of repulsion, attraction and wall push at a place: mean offsets, scaled by gain over radius.
fn force(sums: Sums, x: f32, y: f32) -> vec2<f32> {
    let repel = recip(select(1.0, sums.repel_count, sums.repel_count > 1.0)) * world.repulsion_scale;
    let attract = recip(select(1.0, sums.attract_count, sums.attract_count > 1.0)) * world.attraction_scale;
    let force_x = sums.attract_x * attract - sums.repel_x * repel + wall_push(x, world.map_x);
    let force_y = sums.attract_y * attract - sums.repel_y * repel + wall_push(y, world.map_y);
    return vec2(flush(force_x, TINY), flush(force_y, TINY));
}

// The heading turned towards the force by at most the largest turn, and the wanted speed.
//
// No angle is needed: the force's direction is taken where it lies within the largest turn (by its sine or cosine),
// else the heading turns by that much, to the side of the force.
fn steer(force_x: f32, force_y: f32, influenced: bool, hx: f32, hy: f32, speed: f32) -> Course {
    let force2 = force_x * force_x + force_y * force_y;
    let inverse = rsqrt(force2);
    let ux = force_x * inverse;
    let uy = force_y * inverse;
    let along = hx * ux + hy * uy;
    let across = hx * uy - hy * ux;
    let sine = select(0.0 - world.max_turn_sin, world.max_turn_sin, across >= 0.0);
    let turned = rotate(hx, hy, world.max_turn_cos, sine);
    // A cosine near 1 cannot tell small angles apart, a sine near 1 cannot tell large ones.
    var reached = along >= world.max_turn_cos;
    if world.max_turn_cos > 0.7 {
        reached = along > 0.0 && abs(across) <= world.max_turn_sin;
    }
    let pulled = force2 > 0.0;
    let next_x = select(hx, select(turned.x, ux, reached), pulled);
    let next_y = select(hy, select(turned.y, uy, reached), pulled);
    let ahead = select(world.min_speed, force2 * inverse, along > 0.0);
    let wanted = select(speed, select(0.0, ahead, pulled), influenced);
    return Course(next_x, next_y, wanted);
}
