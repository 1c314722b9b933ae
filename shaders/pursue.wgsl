// Pursuit: moving straight to an agent, the nearest of a class or the one that a policy chooses. Used only if
// `shape.pursues`.
//
// Uses: lib/math.wgsl, follow.wgsl, agent.wgsl (own, Agent), episode.wgsl (position_of), and from src/model: TINY.
//
// The host prepends CHOICES, room for a policy's outputs.

// Returns the actions of a policy that chooses an agent. It wants each of them, and at last nobody, by so much. The first
// action is the first of the most wanted: from -1, the first agent, to 1, nobody, in equal steps. The other is 0.
fn choose_agent(wanted: array<f32, CHOICES>) -> vec2<f32> {
    var outputs = wanted;
    var most = outputs[0];
    var choice = 0u;
    for (var index = 1u; index <= own.end_target - own.first_target; index++) {
        if outputs[index] > most {
            most = outputs[index];
            choice = index;
        }
    }
    return vec2(clamp_to(f32(choice) * own.choice_step - 1.0, -1.0, 1.0), 0.0);
}

// Returns the offset to the agent that an action chooses: 0 for nobody. Its team's positions start at `first`.
fn chosen(first: u32, action: f32, me: ptr<function, Agent>) -> vec2<f32> {
    let other = own.first_target + u32(floor((action + 1.0) * own.half_choices + 0.5));
    if other >= own.end_target {
        return vec2(0.0);
    }
    let place = position_of(first, other);
    return vec2(place.x - (*me).x, place.y - (*me).y);
}

// The smallest offset, and whether there is one. If not, it is 0.
struct Nearest {
    dx: f32,
    dy: f32,
    found: bool,
}

// Returns the smallest offset within a squared distance of the other agents from `begin` to before `end`, the first of
// equals. Compares bits, which are in the order of the numbers because only a distance within which nothing is can be
// negative. Its team's positions start at `first`.
fn nearest(first: u32, begin: u32, end: u32, reach2: f32, me: ptr<function, Agent>) -> Nearest {
    var to = Nearest(0.0, 0.0, false);
    var least = 0x7f7fffff;
    for (var other = begin; other < end; other++) {
        let place = position_of(first, other);
        let dx = place.x - (*me).x;
        let dy = place.y - (*me).y;
        let d2 = bitcast<i32>(dx * dx + dy * dy);
        if other != (*me).agent && d2 <= bitcast<i32>(reach2) && d2 < least {
            to = Nearest(dx, dy, true);
            least = d2;
        }
    }
    return to;
}

// Returns the force that moves an agent by an offset: straight, at most at the maximum speed, and not beyond. Without an
// offset, the agent stops.
fn towards(dx: f32, dy: f32) -> SteeringForce {
    let inverse = rsqrt(dx * dx + dy * dy);
    let scale = select(own.inverse_step, inverse, inverse < own.inverse_step);
    return SteeringForce(flush(dx * scale, TINY) * own.max_speed, flush(dy * scale, TINY) * own.max_speed, true);
}
