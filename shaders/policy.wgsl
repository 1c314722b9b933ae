// A leader's policy: a fully connected network with a bias and tanh in every layer (Sections 2.4 and 3.1).

// Sums under this size count as 0.
const TINY: f32 = 0x1p-30f;

// A unit's sum after its tanh; sums too small to matter become 0, which keeps the next layer away from denormals.
fn activate(sum: f32) -> f32 {
    return whole_tanh(half_tanh(limit_tanh(flush(sum, TINY))));
}

// The wanted turn, in radians to the left, of the policy's first output in -1..1.
fn wanted_turn(output: f32) -> f32 {
    return output * 3.14159274;
}

// The wanted speed of the policy's second output in -1..1.
fn wanted_speed(output: f32) -> f32 {
    return (output + 1.0) * 0.5 * world.max_speed;
}
