// One agent: what it senses, decides and obeys, and how it moves. Both kinds of kernels use this.
//
// Uses: lib/layout.wgsl, lib/math.wgsl, generic.wgsl (shape, class_shape, sense_all, obey_all, decide), sense.wgsl,
// policy.wgsl, follow.wgsl, pursue.wgsl, motion.wgsl, and of the kernel, episode.wgsl or swarm.wgsl:
//   position_of    the position of another agent
//   sense_agents   senses other agents
//   obey_agents    adds other agents to the terms of a rule
//   count_leaders  counts the leaders that a follower sees
//   is_gone        whether a POI is gone: nobody senses it any more
//
// The host prepends:
//   INPUTS           room for the inputs of a policy
//   MOMENT_WORDS     words of a moment
//   TRACE            whether every stage of every step is recorded
//   COUNTED_LEADERS  leaders that a follower counts in registers, not in the record; at least 1
//   shape            the sizes, and what the world uses
//   class_shape      the shape of a class
//   sense_all        what an agent senses
//   obey_all         the force of a rule's terms
//   decide           a leader's policy

// What is constant in a kernel, or for a task.
struct Shape {
    leaders: u32,
    agents: u32,
    pois: u32,
    words: u32,
    classes: u32,
    // Inputs of a policy.
    inputs: u32,
    // Teams per workgroup. A task may have fewer.
    teams: u32,
    // Whether any rule aligns headings.
    aligns: bool,
    // Whether agents of any class may move straight to others, or only near others.
    pursues: bool,
    // Whether agents of any class may be unable to leave a part of the map.
    confines: bool,
    // Whether any POI is gone once an observer has come near.
    gone: bool,
    // Whether the leaders that each follower sees at each step are recorded.
    sightings: bool,
}

// The task's world, and the class of the agent that the thread plays.
var<private> world: Constants;
var<private> own: ClassConstants;
var<private> own_class: u32;

// What one thread plays: an agent of a team, its state, and its wanted course.
struct Agent {
    plays: bool,
    team: u32,
    agent: u32,
    class_index: u32,
    // Its index in `positions`.
    index: u32,
    x: f32,
    y: f32,
    hx: f32,
    hy: f32,
    speed: f32,
    // Its next heading and wanted speed, or if it moves freely, its velocity.
    next: Steering,
    // The number of steps at which it saw each leader.
    counts: array<u32, COUNTED_LEADERS>,
    // For the trace: a leader's inputs and outputs, or a follower's force.
    inputs: array<f32, INPUTS>,
    outputs: vec2<f32>,
    force: vec2<f32>,
}

// Returns the numbers of a channel.
fn gauge_of(class_number: u32, index: u32) -> Gauge {
    let channel = &classes[world.first_class + class_number].channels[index];
    return Gauge(
        (*channel).range2,
        (*channel).base,
        (*channel).slope,
        (*channel).nearest2,
        (*channel).scale,
        (*channel).empty,
    );
}

// The sums of a channel while an agent senses.
struct Sensed {
    quadrants: Quadrants,
    // Of the measures of each sector, or the largest of them, and of numbers of entities.
    sums: array<i32, MAX_SECTORS>,
    counts: array<i32, MAX_SECTORS>,
}

// Less than every measure.
const NO_MEASURE: i32 = -2147483648;

fn has_quadrants(channel: ChannelShape) -> bool {
    return channel.sectors == 4u && channel.combine != COMBINE_CLOSEST;
}

// Adds an entity of this value at offset (`dx`, `dy`).
fn add_sensed(
    channel: ChannelShape,
    gauge: Gauge,
    index: u32,
    value: f32,
    dx: f32,
    dy: f32,
    me: ptr<function, Agent>,
    sensed: ptr<function, Sensed>,
) {
    let measured = measured(channel, gauge, value, dx, dy);
    let of_map = channel.frame == FRAME_MAP;
    let hx = select((*me).hx, 1.0, of_map);
    let hy = select((*me).hy, 0.0, of_map);
    if has_quadrants(channel) {
        var quadrants = (*sensed).quadrants;
        add_to_quadrant(channel, measured, dx, dy, hx, hy, &quadrants);
        (*sensed).quadrants = quadrants;
        return;
    }
    var f = turned(dx, dy, hx, hy);
    // What is at the same place is straight ahead.
    f.x = select(f.x, 1.0, f.x == 0.0 && f.y == 0.0);
    let class_number = world.first_class + own_class;
    let first = is_after(boundary_of(class_number, index, 0u), f);
    var begun = first;
    for (var sector = 0u; sector < channel.sectors; sector++) {
        var inside = begun;
        if channel.sectors == 1u {
            inside = true;
        } else if channel.sectors == 2u {
            inside = (sector == 0u) == first;
        } else {
            var next = first;
            if sector + 1u < channel.sectors {
                next = is_after(boundary_of(class_number, index, sector + 1u), f);
            }
            inside = begun && !next;
            begun = next;
        }
        inside = inside && measured.within;
        if channel.combine == COMBINE_CLOSEST {
            let most = (*sensed).sums[sector];
            (*sensed).sums[sector] = select(most, max(most, measured.measure), inside);
        } else {
            (*sensed).sums[sector] += select(0, measured.measure, inside);
        }
        (*sensed).counts[sector] += select(0, 1, inside);
    }
}

// Returns the direction at which a sector begins.
fn boundary_of(class_number: u32, index: u32, sector: u32) -> vec2<f32> {
    let channel = &classes[class_number].channels[index];
    return vec2((*channel).boundaries[2u * sector], (*channel).boundaries[2u * sector + 1u]);
}

// Returns the squared distance within which an observer makes a POI gone, and the classes of its observers, one bit each.
// They come after the radii and values of all POIs.
fn gone_within_of(task: Task, poi: u32) -> vec2<f32> {
    return places[task.pois + 2u * shape.pois + shape.agents + poi];
}

// Returns where the record says whether a POI is gone. These words come right before the status word.
fn gone_word(task: Task, team: u32, poi: u32) -> u32 {
    return task.status - (shape.pois - poi) * task.teams + team;
}

// Returns a POI's squared radius and value. They come after the headings.
fn poi_of(task: Task, poi: u32) -> vec2<f32> {
    return places[task.pois + shape.pois + shape.agents + poi];
}

// Returns one of some runs of agents or POIs.
fn range_of(ranges: array<u32, 2u * MAX_RANGES>, run: u32) -> vec2<u32> {
    let low = select(vec2(ranges[0], ranges[1]), vec2(ranges[2], ranges[3]), run == 1u);
    let high = select(vec2(ranges[4], ranges[5]), vec2(ranges[6], ranges[7]), run == 3u);
    return select(low, high, run > 1u);
}

// Senses each POI or agent of a channel in a sector of its own. Its team's positions start at `first`.
fn sense_each(
    task: Task,
    first: u32,
    channel: ChannelShape,
    gauge: Gauge,
    me: ptr<function, Agent>,
    inputs: ptr<function, array<f32, INPUTS>>,
) {
    var input = channel.input;
    for (var run = 0u; run < MAX_RANGES; run++) {
        let range = range_of(channel.ranges, run);
        for (var index = range.x; index < range.y; index++) {
            var place = vec2(0.0);
            var value = 1.0;
            var other = true;
            if channel.of_pois != 0u {
                place = places[task.pois + index];
                value = poi_of(task, index).y;
                other = !is_gone(task, (*me).team, index);
            } else {
                place = position_of(first, index);
                other = index != (*me).agent;
            }
            let found = measured(channel, gauge, value, place.x - (*me).x, place.y - (*me).y);
            let within = found.within && other;
            (*inputs)[input] = input_of(channel, gauge, select(0, found.measure, other), select(0, 1, within));
            input++;
        }
    }
}

// Returns the sums of a channel before anything is sensed.
fn nothing_sensed(channel: ChannelShape) -> Sensed {
    var sensed = Sensed();
    if channel.combine == COMBINE_CLOSEST {
        for (var sector = 0u; sector < channel.sectors; sector++) {
            sensed.sums[sector] = NO_MEASURE;
        }
    }
    return sensed;
}

// Adds what one of `parts` threads senses in a channel of the agent's class. Its team's positions start at `first`.
fn sense_part(
    task: Task,
    first: u32,
    channel: ChannelShape,
    gauge: Gauge,
    index: u32,
    part: u32,
    parts: u32,
    me: ptr<function, Agent>,
    sensed: ptr<function, Sensed>,
) {
    for (var run = 0u; run < MAX_RANGES; run++) {
        let range = range_of(channel.ranges, run);
        if range.x == range.y {
            break;
        }
        if channel.of_pois == 0u {
            sense_agents(task, first, channel, gauge, index, range, part, me, sensed);
            continue;
        }
        for (var poi = range.x + part; poi < range.y; poi += parts) {
            if !is_gone(task, (*me).team, poi) {
                let place = places[task.pois + poi];
                let value = poi_of(task, poi).y;
                add_sensed(channel, gauge, index, value, place.x - (*me).x, place.y - (*me).y, me, sensed);
            }
        }
    }
}

// Writes the inputs of a channel from its sums.
fn write_inputs(channel: ChannelShape, gauge: Gauge, sensed: Sensed, inputs: ptr<function, array<f32, INPUTS>>) {
    let input = channel.input;
    if has_quadrants(channel) {
        let sums = quadrant_sums(sensed.quadrants.sums);
        let counts = quadrant_sums(sensed.quadrants.counts);
        // Sectors of the map begin at the x axis, which is straight ahead.
        let turn = select(0u, 2u, channel.frame == FRAME_MAP);
        (*inputs)[input + turn] = input_of(channel, gauge, sums.x, counts.x);
        (*inputs)[input + turn + 1u] = input_of(channel, gauge, sums.y, counts.y);
        (*inputs)[input + 2u - turn] = input_of(channel, gauge, sums.z, counts.z);
        (*inputs)[input + 3u - turn] = input_of(channel, gauge, sums.w, counts.w);
        return;
    }
    for (var sector = 0u; sector < channel.sectors; sector++) {
        (*inputs)[input + sector] = input_of(channel, gauge, sensed.sums[sector], sensed.counts[sector]);
    }
}

// Senses one channel of the agent's class, and writes its inputs. Its team's positions start at `first`.
fn sense_channel(
    task: Task,
    first: u32,
    channel: ChannelShape,
    index: u32,
    me: ptr<function, Agent>,
    inputs: ptr<function, array<f32, INPUTS>>,
) {
    let gauge = gauge_of(own_class, index);
    if channel.each != 0u {
        sense_each(task, first, channel, gauge, me, inputs);
        return;
    }
    var sensed = nothing_sensed(channel);
    sense_part(task, first, channel, gauge, index, 0u, 1u, me, &sensed);
    write_inputs(channel, gauge, sensed, inputs);
}

// A leader senses, and decides. Its team's positions start at `first`.
fn lead(task: Task, first: u32, me: ptr<function, Agent>) {
    var inputs: array<f32, INPUTS>;
    sense_all(task, first, me, &inputs);
    answer(task, first, inputs, me);
}

// A leader decides by its inputs. Its team's positions start at `first`.
fn answer(task: Task, first: u32, inputs: array<f32, INPUTS>, me: ptr<function, Agent>) {
    let start = task.weights + (*me).agent * task.teams + (*me).team;
    let outputs = decide(start, shape.leaders * task.teams, inputs);
    if TRACE {
        (*me).inputs = inputs;
        (*me).outputs = outputs;
    }
    if shape.pursues && own.control == CONTROLKIND_CHOOSE {
        let to = chosen(first, outputs.x, me);
        obey(towards(to.x, to.y), me);
        return;
    }
    if own.free != 0u {
        (*me).next = Steering(outputs.x * own.max_speed, outputs.y * own.max_speed, 0.0);
        return;
    }
    let heading = turn((*me).hx, (*me).hy, wanted_turn(outputs.x));
    (*me).next = Steering(heading.x, heading.y, wanted_speed(outputs.y));
}

// Returns the numbers of a term of the agent's class.
fn pull_of(class_number: u32, index: u32) -> Pull {
    let term = &classes[world.first_class + class_number].terms[index];
    return Pull((*term).inner2, (*term).outer2, (*term).scale);
}

// Returns the index of an agent's state before a step. If rules align headings, there are two of each, which alternate as
// positions do.
fn state_of(task: Task, second: bool, team: u32, agent: u32) -> u32 {
    return task.states + (select(0u, task.teams, second) + team) * shape.agents + agent;
}

// Adds one or two terms of the agent's class that have one shape to the force. Its team's positions start at `first`.
fn obey_terms(
    task: Task,
    first: u32,
    term: TermShape,
    index: u32,
    pair: bool,
    me: ptr<function, Agent>,
    force: ptr<function, SteeringForce>,
) {
    let one = pull_of(own_class, index);
    var two = Pull(0.0, -1.0, 0.0);
    if pair {
        two = pull_of(own_class, index + 1u);
    }
    var sums: array<Sum, 2>;
    for (var run = 0u; run < MAX_RANGES; run++) {
        let range = range_of(term.ranges, run);
        if range.x == range.y {
            break;
        }
        obey_agents(task, first, shape.aligns && term.aligns != 0u, range, one, two, me, &sums);
    }
    add_term(one, sums[0], force);
    if pair {
        add_term(two, sums[1], force);
    }
}

// Returns the index in the record of a follower's count of a leader.
fn sight(task: Task, me: ptr<function, Agent>, leader: u32) -> u32 {
    return task.counts + (((*me).agent - shape.leaders) * shape.leaders + leader) * task.teams + (*me).team;
}

// Returns the squared distance up to which a leader leads the agents of a class.
fn influence_of(leader: u32, class_number: u32) -> f32 {
    return classes[world.first_class + class_of(leader)].influence2[class_number];
}

// A follower counts the leaders it sees, and obeys its class's rule. Its team's positions start at `first`.
fn follow(task: Task, first: u32, me: ptr<function, Agent>) {
    count_leaders(task, first, me);
    if own.control == CONTROLKIND_STILL {
        return;
    }
    var force: SteeringForce;
    if shape.pursues && own.control == CONTROLKIND_NEAREST {
        let to = nearest(first, own.first_target, own.end_target, own.reach2, me);
        force = towards(to.dx, to.dy);
    } else {
        var terms = SteeringForce();
        obey_all(task, first, me, &terms);
        force = with_walls(terms, (*me).x, (*me).y);
    }
    if TRACE {
        (*me).force = vec2(force.x, force.y);
    }
    obey(force, me);
}

// An agent takes the wanted velocity, or heading and speed, from the force on it.
fn obey(force: SteeringForce, me: ptr<function, Agent>) {
    if own.free != 0u {
        let most = own.max_speed;
        (*me).next = Steering(clamp_to(force.x, -most, most), clamp_to(force.y, -most, most), 0.0);
        return;
    }
    (*me).next = steer(force, sizes(force), (*me).hx, (*me).hy, (*me).speed);
}

// Moves the agent. Its team's positions start at `first`.
fn move_agent(first: u32, me: ptr<function, Agent>) {
    let next = (*me).next;
    if own.control == CONTROLKIND_STILL {
        return;
    }
    if shape.pursues && own.end_near > 0u {
        if !nearest(first, own.first_near, own.end_near, own.near2, me).found {
            return;
        }
    }
    let bounds = limits();
    if own.free != 0u {
        (*me).x = advance((*me).x, world.dt, next.hx, bounds.x, bounds.z);
        (*me).y = advance((*me).y, world.dt, next.hy, bounds.y, bounds.w);
        return;
    }
    let heading = renormalize(next.hx, next.hy);
    let speed = accelerate((*me).speed, next.speed);
    let step = speed * world.dt;
    (*me).x = advance((*me).x, step, heading.x, bounds.x, bounds.z);
    (*me).y = advance((*me).y, step, heading.y, bounds.y, bounds.w);
    (*me).hx = heading.x;
    (*me).hy = heading.y;
    (*me).speed = speed;
}

// Returns the class of an agent.
fn class_of(agent: u32) -> u32 {
    var index = 0u;
    while agent >= class_shape(index).end_agent {
        index++;
    }
    return index;
}

fn trace(task: Task, step: u32, me: ptr<function, Agent>) {
    let row = step * task.teams + (*me).team;
    let moment = task.traced + (row * shape.agents + (*me).agent) * MOMENT_WORDS;
    traced[moment] = (*me).outputs.x;
    traced[moment + 1u] = (*me).outputs.y;
    traced[moment + 2u] = (*me).force.x;
    traced[moment + 3u] = (*me).force.y;
    traced[moment + 4u] = (*me).x;
    traced[moment + 5u] = (*me).y;
    traced[moment + 6u] = (*me).hx;
    traced[moment + 7u] = (*me).hy;
    traced[moment + 8u] = (*me).speed;
    if (*me).agent < shape.leaders {
        let moments = (world.steps + 1u) * task.teams * shape.agents * MOMENT_WORDS;
        let first = task.traced + moments + (row * shape.leaders + (*me).agent) * shape.inputs;
        for (var input = 0u; input < shape.inputs; input++) {
            traced[first + input] = (*me).inputs[input];
        }
    }
}

// Loads the class of the agent that the thread plays next.
fn load_class(index: u32) {
    own_class = index;
    own = class_constants(world.first_class + index);
}

// Puts the agent at its start.
fn start(task: Task, me: ptr<function, Agent>) {
    let place = places[task.starts + (*me).agent];
    (*me).x = place.x;
    (*me).y = place.y;
    // Headings come after the POIs.
    let heading = places[task.pois + shape.pois + (*me).agent];
    (*me).hx = heading.x;
    (*me).hy = heading.y;
    (*me).speed = own.speed;
}

// Loads the agent's state before a step.
fn load_state(index: u32, me: ptr<function, Agent>) {
    let state = states[index];
    (*me).x = state.x;
    (*me).y = state.y;
    (*me).hx = state.hx;
    (*me).hy = state.hy;
    (*me).speed = state.speed;
}

// Returns the agent's state.
fn current_state(me: ptr<function, Agent>) -> State {
    return State((*me).x, (*me).y, (*me).hx, (*me).hy, (*me).speed);
}
