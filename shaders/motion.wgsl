// How agents move: a proportional controller within the limits of turn, acceleration and speed (Section 3.1).

// Positions lie on a grid of 2^-18 (or on a wall): their differences are exact, and their squares far from denormal.
const GRID: f32 = 262144.0;

// The heading turned by the angle of this cosine and sine, to the left.
fn rotate(hx: f32, hy: f32, cosine: f32, sine: f32) -> vec2<f32> {
    return vec2(hx * cosine - hy * sine, hx * sine + hy * cosine);
}

// The heading turned by a wanted angle (radians, to the left), as far as one step allows.
fn turn(hx: f32, hy: f32, wanted: f32) -> vec2<f32> {
    let angle = bound(wanted, -world.max_turn, world.max_turn);
    let turned = sin_cos(angle);
    return rotate(hx, hy, turned.y, turned.x);
}

// The heading scaled back to length 1, by one Newton step: turning lets it drift by a rounding.
fn renormalize(hx: f32, hy: f32) -> vec2<f32> {
    let scale = 1.5 - (hx * hx + hy * hy) * 0.5;
    return vec2(flush(hx * scale, TINY), flush(hy * scale, TINY));
}

// The speed brought towards the wanted one, as far as one step and the limits allow.
fn accelerate(speed: f32, wanted: f32) -> f32 {
    let limit = world.max_speed_change;
    let change = bound(wanted - speed, -limit, limit);
    return bound(speed + change, world.min_speed, world.max_speed);
}

// One coordinate after a step along the new heading, on the map and on the grid.
fn advance(at: f32, step: f32, heading: f32, size: f32) -> f32 {
    return bound(snap(at + step * heading), 0.0, size);
}

// The nearest place on the grid.
fn snap(at: f32) -> f32 {
    return floor(at * GRID + 0.5) * 0x1p-18f;
}
