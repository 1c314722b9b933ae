// The followers' preset behaviour: attraction to agents in sight, repulsion from close ones and walls (paper, Section
// 4.1, Figure 2b).
//
// Uses: lib/math.wgsl, motion.wgsl (rotate), episode.wgsl (world), generic.wgsl (variant), and from src/model: TINY.

// Sums, in lattice distances, and counts of the offsets to agents within a follower's radii.
struct Sums {
    repel_x: i32,
    repel_y: i32,
    repel_count: u32,
    attract_x: i32,
    attract_y: i32,
    attract_count: u32,
}

// A heading and the wanted speed along it.
struct Steering {
    hx: f32,
    hy: f32,
    speed: f32,
}

// Reports whether a follower sees the agent at offset (`dx`, `dy`): it is within the attraction radius.
fn sees(dx: f32, dy: f32) -> bool {
    return within(dx, dy, world.attraction_radius2);
}

// Adds the agent at offset (`dx`, `dy`), and reports whether the follower sees it.
fn influence(dx: f32, dy: f32, sums: ptr<function, Sums>) -> bool {
    let seen = within(dx, dy, world.attraction_radius2);
    if seen {
        let near = within(dx, dy, world.repulsion_radius2);
        let x = on_lattice(dx, world.offset_base);
        let y = on_lattice(dy, world.offset_base);
        (*sums).repel_x += select(0, x, near);
        (*sums).repel_y += select(0, y, near);
        (*sums).repel_count += u32(near);
        (*sums).attract_x += select(x, 0, near);
        (*sums).attract_y += select(y, 0, near);
        (*sums).attract_count += u32(!near);
    }
    return seen;
}

// The force on a follower, and whether any agent or wall is near.
struct SteeringForce {
    x: f32,
    y: f32,
    influenced: bool,
}

// Returns the push of the two walls of one axis, at 0 and at `size`, and a number that is not negative if either is
// within the repulsion radius.
fn walls(at: f32, size: f32) -> vec2<f32> {
    let low = world.repulsion_radius - at;
    let high = world.repulsion_radius - (size - at);
    let push = select(0.0, low, low > 0.0) - select(0.0, high, high > 0.0);
    return vec2(push * world.wall_gain, select(high, low, low > high));
}

// Returns the sum of repulsion, attraction and wall push at a position. Each mean offset is scaled by gain over radius.
fn force(sums: Sums, x: f32, y: f32) -> SteeringForce {
    let repel = recip(f32(max(sums.repel_count, 1u))) * world.repulsion_scale;
    let attract = recip(f32(max(sums.attract_count, 1u))) * world.attraction_scale;
    let walls_x = walls(x, world.map_x);
    let walls_y = walls(y, world.map_y);
    let force_x = nearest_f32(sums.attract_x) * attract - nearest_f32(sums.repel_x) * repel + walls_x.x;
    let force_y = nearest_f32(sums.attract_y) * attract - nearest_f32(sums.repel_y) * repel + walls_y.x;
    let influenced = sums.repel_count + sums.attract_count > 0u || walls_x.y >= 0.0 || walls_y.y >= 0.0;
    return SteeringForce(flush(force_x, TINY), flush(force_y, TINY), influenced);
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
    let sine = select(0.0 - world.max_turn_sin, world.max_turn_sin, across >= 0.0);
    let turned = rotate(hx, hy, world.max_turn_cos, sine);
    let has_force = force2 > 0.0;
    // A cosine near 1 cannot resolve small angles, and a sine near 1 cannot resolve large ones. Without a force,
    // `along` is 0.
    var reached = along >= world.max_turn_cos && has_force;
    if variant.by_sine != 0u {
        reached = along > 0.0 && abs(across) <= world.max_turn_sin;
    }
    let next_x = select(select(hx, turned.x, has_force), ux, reached);
    let next_y = select(select(hy, turned.y, has_force), uy, reached);
    let ahead = select(world.min_speed, force2 * inverse, along > 0.0);
    let wanted = select(speed, select(0.0, ahead, has_force), force.influenced);
    return Steering(next_x, next_y, wanted);
}
