// The sizes of a task's world, which are constants in specialised kernels.
//
// Uses: lib/layout.wgsl (weights), policy.wgsl, episode.wgsl (world, Shape).
//
// The host prepends:
//   WIDEST         the widest layer of any policy, inputs included
//   CHOOSES        whether outputs choose a behaviour
//   world_variant  the variant of this task's world

var<private> shape: Shape;
var<private> variant: Variant;

fn set_shape(task: Task) {
    let agents = world.leaders + world.followers;
    // An empty task has no team, but the number is a divisor.
    let teams = max(task.teams, 1u);
    shape = Shape(world.leaders, agents, world.pois, world.words, teams);
    variant = world_variant();
}

// Computes a leader's outputs: layer by layer, each unit's bias plus its weighted inputs in order.
fn decide(start: u32, stride: u32, sensed: array<f32, INPUTS>) -> vec2<f32> {
    var inputs: array<f32, WIDEST>;
    for (var input = 0u; input < INPUTS; input++) {
        inputs[input] = sensed[input];
    }
    var first = 0u;
    for (var layer = 0u; layer < world.layers; layer++) {
        let rows = world.widths[layer];
        let columns = world.widths[layer + 1u];
        var units: array<f32, WIDEST>;
        for (var column = 0u; column < columns; column++) {
            var index = first + column;
            var sum = weight(start, stride, index + rows * columns);
            for (var row = 0u; row < rows; row++) {
                sum += inputs[row] * weight(start, stride, index);
                index += columns;
            }
            units[column] = activate(sum);
        }
        inputs = units;
        first += (rows + 1u) * columns;
    }
    if CHOOSES {
        return choose(sensed, array(inputs[0], inputs[1], inputs[2], inputs[3], inputs[4]));
    }
    return vec2(inputs[0], inputs[1]);
}

// Returns one of a policy's weights.
fn weight(start: u32, stride: u32, index: u32) -> f32 {
    return weights[start + index / 4u * stride][index % 4u];
}
