// What a leader senses: the density of POIs and of agents in four quadrants around its heading (Section 3.1).

// What an entity at squared distance `d2` adds to a density.
fn density(d2: f32) -> f32 {
    if world.density == 0u {
        return 1.0 - root(d2) * world.inverse_diagonal;
    }
    return rsqrt(select(1.0, d2, d2 > 1.0));
}

// Adds the entity at offset (`dx`, `dy`) to the sum of its quadrant, in the order of the policy's inputs:
// back-right, front-right, front-left, back-left.
//
// The quadrant is read off the signs of the offset along the heading and to its left; a tie goes one quarter turn
// clockwise, so that each boundary belongs to exactly one quadrant.
fn sense(range2: f32, dx: f32, dy: f32, hx: f32, hy: f32, sums: ptr<function, array<f32, 4>>) {
    let d2 = dx * dx + dy * dy;
    let fx = dx * hx + dy * hy;
    let fy = dy * hx - dx * hy;
    let value = select(0.0, density(d2), d2 <= range2);
    let left = fy > 0.0 || (fy >= 0.0 && fx >= 0.0);
    let front = fx > 0.0 || (fx >= 0.0 && fy <= 0.0);
    let value_left = select(0.0, value, left);
    let value_right = select(value, 0.0, left);
    (*sums)[0] += select(value_right, 0.0, front);
    (*sums)[1] += select(0.0, value_right, front);
    (*sums)[2] += select(0.0, value_left, front);
    (*sums)[3] += select(value_left, 0.0, front);
}
