// Motion: a proportional controller, limited in turn, acceleration and speed (paper, Section 3.1).
//
// Uses: lib/math.wgsl, generic.wgsl (shape), agent.wgsl (world, own), and from src/model: TINY, GRID, INVERSE_GRID.

// Rotates a heading to the left, by the angle of this cosine and sine.
fn rotate(hx: f32, hy: f32, cosine: f32, sine: f32) -> vec2<f32> {
    return vec2(hx * cosine - hy * sine, hx * sine + hy * cosine);
}

// Turns a heading by a wanted angle (radians, to the left), at most the maximum turn.
fn turn(hx: f32, hy: f32, wanted: f32) -> vec2<f32> {
    let angle = clamp_to(wanted, -own.max_turn, own.max_turn);
    let turned = sin_cos(angle);
    return rotate(hx, hy, turned.y, turned.x);
}

// Scales a heading back to length 1 by one Newton step, because each turn adds a rounding error.
fn renormalize(hx: f32, hy: f32) -> vec2<f32> {
    let scale = 1.5 - (hx * hx + hy * hy) * 0.5;
    return vec2(flush(hx * scale, TINY), flush(hy * scale, TINY));
}

// Changes the speed towards the wanted one, within the limits.
fn accelerate(speed: f32, wanted: f32) -> f32 {
    let limit = own.max_speed_change;
    let change = clamp_to(wanted - speed, -limit, limit);
    return clamp_to(speed + change, own.min_speed, own.max_speed);
}

// Moves one coordinate by a distance along one component of a heading, rounded to the grid and clamped to limits.
fn advance(at: f32, step: f32, heading: f32, low: f32, high: f32) -> f32 {
    return clamp_to(snap(at + step * heading), low, high);
}

// Returns the limits of an agent's coordinates: the lower ones, then the upper ones.
fn limits() -> vec4<f32> {
    if shape.confines {
        return vec4(own.low_x, own.low_y, own.high_x, own.high_y);
    }
    return vec4(0.0, 0.0, world.map_x, world.map_y);
}

// Rounds a coordinate to the grid.
fn snap(at: f32) -> f32 {
    return floor(at * GRID + 0.5) * INVERSE_GRID;
}
