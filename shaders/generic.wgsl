// The sizes and the classes of a task's world, which are constants in specialised kernels.
//
// Uses: lib/layout.wgsl (weights, classes), policy.wgsl, follow.wgsl, pursue.wgsl, agent.wgsl (world, own, Shape, Agent).
//
// The host prepends:
//   MAY_PURSUE     whether agents may move straight to others, or only near others; those of large teams do not
//   shape_of       the shape of a class, channel_of of a channel, term_of of a term

var<private> shape: Shape;

fn set_shape(task: Task) {
    let agents = world.leaders + world.followers;
    // The record has sightings if something comes between the counts and the words of POIs.
    let gone_words = select(0u, world.pois * task.teams, world.gone != 0u);
    let sightings = task.status - gone_words > task.counts + world.followers * world.leaders * task.teams;
    shape = Shape(
        world.leaders, agents, world.pois, world.words, world.class_count, world.widths[0], task.teams,
        world.aligns != 0u, MAY_PURSUE, true, world.gone != 0u, sightings,
    );
}

// Returns the shape of a class.
fn class_shape(index: u32) -> ClassShape {
    return shape_of(world.first_class + index);
}

// The step of an agent. Its team's positions start at `first`.
fn act(task: Task, first: u32, me: ptr<function, Agent>) {
    load_class((*me).class_index);
    if (*me).agent < shape.leaders {
        lead(task, first, me);
    } else {
        follow(task, first, me);
    }
    move_agent(first, me);
}

// Senses all channels of the agent's class.
fn sense_all(task: Task, first: u32, me: ptr<function, Agent>, inputs: ptr<function, array<f32, INPUTS>>) {
    let class_number = world.first_class + own_class;
    for (var index = 0u; index < own.channel_count; index++) {
        sense_channel(task, first, channel_of(class_number, index), index, me, inputs);
    }
}

// Adds all terms of the rule of the agent's class to the force. Neighbours of one shape are added together.
fn obey_all(task: Task, first: u32, me: ptr<function, Agent>, force: ptr<function, SteeringForce>) {
    let class_number = world.first_class + own_class;
    for (var index = 0u; index < own.term_count; index++) {
        let term = term_of(class_number, index);
        var pair = index + 1u < own.term_count;
        if pair {
            pair = same_term(term, term_of(class_number, index + 1u));
        }
        obey_terms(task, first, term, index, pair, me, force);
        index += u32(pair);
    }
}

fn same_term(a: TermShape, b: TermShape) -> bool {
    var same = a.aligns == b.aligns;
    let x = a.ranges;
    let y = b.ranges;
    same = same && x[0] == y[0] && x[1] == y[1] && x[2] == y[2] && x[3] == y[3];
    return same && x[4] == y[4] && x[5] == y[5] && x[6] == y[6] && x[7] == y[7];
}

// Computes a leader's outputs: layer by layer, each unit's bias plus its weighted inputs in order.
fn decide(start: u32, stride: u32, sensed: array<f32, INPUTS>) -> vec2<f32> {
    // There is room for every layer.
    var inputs = sensed;
    var first = 0u;
    for (var layer = 0u; layer < world.layers; layer++) {
        let rows = world.widths[layer];
        let columns = world.widths[layer + 1u];
        var units: array<f32, INPUTS>;
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
    if shape.pursues && own.control == CONTROLKIND_CHOOSE {
        return choose_agent(inputs);
    }
    if world.actions == ACTIONS_BEHAVIOURS {
        let pois = vec4(sensed[0], sensed[1], sensed[2], sensed[3]);
        let agents = vec4(sensed[4], sensed[5], sensed[6], sensed[7]);
        return choose(pois, agents, array(inputs[0], inputs[1], inputs[2], inputs[3], inputs[4]));
    }
    return vec2(inputs[0], inputs[1]);
}

// Returns one of a policy's weights.
fn weight(start: u32, stride: u32, index: u32) -> f32 {
    return weights[start + index / 4u * stride][index % 4u];
}
