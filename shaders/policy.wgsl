// A leader's policy: a fully connected network with biases and tanh in every layer (paper, Sections 2.4 and 3.1).
//
// Uses: lib/math.wgsl, agent.wgsl (own), and from src/model: TINY, BEHAVIOURS.

// Returns the tanh of a unit's sum. Small sums are flushed to 0, so that the next layer has no denormals.
fn activate(sum: f32) -> f32 {
    return whole_tanh(half_tanh(limit_tanh(flush(sum, TINY))));
}

// Returns the turn to the middle of the quadrant of highest density, or to the opposite one, in half turns to the left.
// 0 if nothing is sensed.
fn quadrant(densities: vec4<f32>, away: bool) -> f32 {
    var most = densities.x;
    var turn = -0.75;
    if densities.y > most {
        most = densities.y;
        turn = -0.25;
    }
    if densities.z > most {
        most = densities.z;
        turn = 0.25;
    }
    if densities.w > most {
        most = densities.w;
        turn = 0.75;
    }
    let back = turn + select(-1.0, 1.0, turn < 0.0);
    return select(0.0, select(turn, back, away), most > 0.0);
}

// Returns the actions of the most wanted behaviour: the first of the largest `wanted`, each in -1..1. `pois` and `agents`
// are the inputs of quadrants.
fn choose(pois: vec4<f32>, agents: vec4<f32>, wanted: array<f32, BEHAVIOURS>) -> vec2<f32> {
    var most = wanted[0];
    var behaviour = 0u;
    if wanted[1] > most {
        most = wanted[1];
        behaviour = 1u;
    }
    if wanted[2] > most {
        most = wanted[2];
        behaviour = 2u;
    }
    if wanted[3] > most {
        most = wanted[3];
        behaviour = 3u;
    }
    if wanted[4] > most {
        behaviour = 4u;
    }
    if behaviour == 0u {
        return vec2(0.0, -1.0);
    }
    return vec2(quadrant(select(agents, pois, behaviour < 3u), behaviour == 2u || behaviour == 4u), 1.0);
}

// Converts the first output, in -1..1, to a wanted turn in radians to the left.
fn wanted_turn(output: f32) -> f32 {
    return output * 3.14159274;
}

// Converts the second output, in -1..1, to a wanted speed.
fn wanted_speed(output: f32) -> f32 {
    return (output + 1.0) * 0.5 * own.max_speed;
}
