// A leader's policy: a fully connected network with a bias and tanh in every layer (Sections 2.4 and 3.1).

// Sums under this size count as 0.
const TINY: f32 = 0x1p-30f;

// One unit before its tanh: the bias (the last of its weights) and the weighted inputs, added in order.
//
// Its weights are `rows` weights and the bias, `stride` apart, from `first` on.
fn weigh(inputs: ptr<function, array<f32, WIDEST>>, rows: u32, first: u32, stride: u32) -> f32 {
    var sum = weights[first + rows * stride];
    for (var row = 0u; row < rows; row++) {
        sum += (*inputs)[row] * weights[first + row * stride];
    }
    return sum;
}

// The sum, ready for its tanh; sums too small to matter become 0, which keeps the next layer away from denormals.
fn tame(sum: f32) -> f32 {
    return limit_tangent(flush(sum, TINY));
}

// The wanted turn, in radians to the left, of the policy's first output in -1..1.
fn wanted_turn(output: f32) -> f32 {
    return output * 3.14159274;
}

// The wanted speed of the policy's second output in -1..1.
fn wanted_speed(output: f32) -> f32 {
    return (output + 1.0) * 0.5 * world.max_speed;
}
