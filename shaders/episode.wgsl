// Whole episodes: a workgroup plays some teams from start to end, with state in registers and workgroup memory. Long
// episodes take several dispatches, with the state stored in between.
//
// Uses: lib/layout.wgsl, lib/math.wgsl, generic.wgsl (shape, set_shape, class_shape, act, sense_all, obey_all, decide),
// sense.wgsl, policy.wgsl, follow.wgsl, pursue.wgsl, motion.wgsl, couple.wgsl.
//
// One text makes two kernels. In the specialised one all sizes and the shapes of all classes are constants. In the generic
// one they are read with the task (`generic.wgsl`). The host prepends:
//   WORKGROUP     threads per workgroup
//   ROLE          each class starts at a multiple of this many threads
//   SLOTS         agents per thread, played one after another
//   SHARED        agents of a workgroup's teams
//   INPUTS        room for the inputs of a policy
//   MOMENT_WORDS  words of a moment
//   ALIGNS        whether any rule aligns headings
//   PURSUES       whether agents of any class move straight to others
//   CONFINES      whether agents of any class cannot leave a part of the map, or move only near others
//   TRACE         whether every stage of every step is recorded
//   SIGHTINGS     whether the leaders that each follower sees at each step are recorded
//   COUNTS_IN_REGISTERS, COUNTED_LEADERS
//                 whether a follower counts the leaders it sees in registers, not in the record, and how many registers
//   shape         the sizes
//   set_shape     sets them for a task
//   class_shape   the shape of a class
//   act           the step of an agent
//   sense_all     what an agent senses
//   obey_all      the force of a rule's terms
//   decide        a leader's policy
//
// Neighbouring threads play the same agent of neighbouring teams. They execute the same code, load neighbouring
// weights, and are often all out of reach of the same agent. Each class starts at the next multiple of ROLE threads, so
// that two rarely share a warp.

// Sizes that are constant in a kernel, or for a task.
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
}

// The task's world, and the class of the agent that the thread plays.
var<private> world: Constants;
var<private> own: ClassConstants;
var<private> own_class: u32;

// Positions of all agents, `[agents][teams]`, after the last step and after this step. The two halves alternate, so
// that one barrier per step is enough.
var<workgroup> positions: array<vec2<f32>, 2u * SHARED>;

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

// Returns the agent of a place in the workgroup.
fn assign_agent(place: u32, teams: u32) -> Agent {
    var agent: Agent;
    var start = 0u;
    for (var index = 0u; index < shape.classes; index++) {
        let of_class = class_shape(index);
        let count = (of_class.end_agent - of_class.first_agent) * shape.teams;
        if place >= start && place < start + count {
            agent.class_index = index;
            agent.index = of_class.first_agent * shape.teams + place - start;
            agent.team = agent.index % shape.teams;
            agent.agent = agent.index / shape.teams;
            agent.plays = agent.team < teams;
        }
        start = (start + count + ROLE - 1u) / ROLE * ROLE;
    }
    return agent;
}

// Returns which of up to 32 agents from `base` to before `end` are within a squared range, one bit each. Their team's
// positions start at `first`.
fn reached(first: u32, base: u32, end: u32, x: f32, y: f32, range2: f32) -> u32 {
    var near = 0u;
    for (var other = base; other < min(base + 32u, end); other++) {
        let place = positions[first + other * shape.teams];
        near |= select(0u, 1u << (other - base), within(place.x - x, place.y - y, range2));
    }
    return near;
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

// Senses the POIs from `begin` to before `end`.
fn sense_pois(
    task: Task,
    channel: ChannelShape,
    gauge: Gauge,
    index: u32,
    begin: u32,
    end: u32,
    me: ptr<function, Agent>,
    sensed: ptr<function, Sensed>,
) {
    for (var poi = begin; poi < end; poi++) {
        let place = places[task.pois + poi];
        add_sensed(channel, gauge, index, poi_of(task, poi).y, place.x - (*me).x, place.y - (*me).y, me, sensed);
    }
}

// Returns a POI's squared radius and value. They come after the headings.
fn poi_of(task: Task, poi: u32) -> vec2<f32> {
    return places[task.pois + shape.pois + shape.agents + poi];
}

// Senses the agents from `begin` to before `end`. Its team's positions start at `first`.
fn sense_agents(
    first: u32,
    channel: ChannelShape,
    gauge: Gauge,
    index: u32,
    begin: u32,
    end: u32,
    me: ptr<function, Agent>,
    sensed: ptr<function, Sensed>,
) {
    for (var base = begin; base < end; base += 32u) {
        // The first loop finds the agents in reach, and the second iterates over these only. A warp then takes as many
        // iterations as its busiest thread, not as many as there are agents in reach of any thread.
        var near = reached(first, base, end, (*me).x, (*me).y, gauge.range2);
        let before = (*me).agent - base;
        near &= ~select(0u, 1u << (before % 32u), before < 32u);
        while near != 0u {
            let place = positions[first + (base + firstTrailingBit(near)) * shape.teams];
            add_sensed(channel, gauge, index, 1.0, place.x - (*me).x, place.y - (*me).y, me, sensed);
            near &= near - 1u;
        }
    }
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
            } else {
                place = positions[first + index * shape.teams];
                other = index != (*me).agent;
            }
            let found = measured(channel, gauge, value, place.x - (*me).x, place.y - (*me).y);
            let within = found.within && other;
            (*inputs)[input] = input_of(channel, gauge, select(0, found.measure, other), select(0, 1, within));
            input++;
        }
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
    var sensed = Sensed();
    if channel.combine == COMBINE_CLOSEST {
        for (var sector = 0u; sector < channel.sectors; sector++) {
            sensed.sums[sector] = NO_MEASURE;
        }
    }
    for (var run = 0u; run < MAX_RANGES; run++) {
        let range = range_of(channel.ranges, run);
        if range.x == range.y {
            break;
        }
        if channel.of_pois != 0u {
            sense_pois(task, channel, gauge, index, range.x, range.y, me, &sensed);
        } else {
            sense_agents(first, channel, gauge, index, range.x, range.y, me, &sensed);
        }
    }
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

// A leader senses, and decides. Its team's positions start at `first`.
fn lead(task: Task, first: u32, me: ptr<function, Agent>) {
    var inputs: array<f32, INPUTS>;
    sense_all(task, first, me, &inputs);
    let start = task.weights + (*me).agent * task.teams + (*me).team;
    let outputs = decide(start, shape.leaders * task.teams, inputs);
    if TRACE {
        (*me).inputs = inputs;
        (*me).outputs = outputs;
    }
    if PURSUES && own.control == CONTROLKIND_CHOOSE {
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

// Returns the index of an agent's state before a step. If ALIGNS, there are two of each, which alternate as positions do.
fn state_of(task: Task, second: bool, team: u32, agent: u32) -> u32 {
    return task.states + (select(0u, task.teams, second) + team) * shape.agents + agent;
}

// Shares an agent's heading with those that align with it.
fn share_heading(task: Task, second: bool, me: ptr<function, Agent>) {
    if ALIGNS {
        let state = State((*me).x, (*me).y, (*me).hx, (*me).hy, (*me).speed);
        states[state_of(task, second, (*me).team, (*me).agent)] = state;
    }
}

// Adds the offsets or the headings of the agents from `begin` to before `end` to two terms.
fn obey_range(
    task: Task,
    first: u32,
    aligns: bool,
    begin: u32,
    end: u32,
    one: Pull,
    two: Pull,
    me: ptr<function, Agent>,
    sums: ptr<function, array<Sum, 2>>,
) {
    for (var other = begin; other < end; other++) {
        let place = positions[first + other * shape.teams];
        let dx = place.x - (*me).x;
        let dy = place.y - (*me).y;
        let d2 = dx * dx + dy * dy;
        if other != (*me).agent && bitcast<i32>(d2) <= max(bitcast<i32>(one.outer2), bitcast<i32>(two.outer2)) {
            var x = on_lattice(dx, own.offset_base);
            var y = on_lattice(dy, own.offset_base);
            if aligns {
                let state = &states[state_of(task, first >= SHARED, (*me).team, other)];
                x = on_lattice((*state).hx, own.heading_base);
                y = on_lattice((*state).hy, own.heading_base);
            }
            var sum = (*sums)[0];
            add_to_term(one, d2, x, y, &sum);
            (*sums)[0] = sum;
            sum = (*sums)[1];
            add_to_term(two, d2, x, y, &sum);
            (*sums)[1] = sum;
        }
    }
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
        obey_range(task, first, ALIGNS && term.aligns != 0u, range.x, range.y, one, two, me, &sums);
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
    let x = (*me).x;
    let y = (*me).y;
    for (var leader = 0u; leader < shape.leaders; leader++) {
        let place = positions[first + leader * shape.teams];
        let seen = u32(within(place.x - x, place.y - y, influence_of(leader, own_class)));
        if COUNTS_IN_REGISTERS {
            (*me).counts[leader] += seen;
        } else if seen != 0u {
            record[sight(task, me, leader)] += seen;
        }
    }
    if own.control == CONTROLKIND_STILL {
        return;
    }
    var force: SteeringForce;
    if PURSUES && own.control == CONTROLKIND_NEAREST {
        let to = nearest(first, own.first_target, own.end_target, own.reach2, me);
        force = towards(to.dx, to.dy);
    } else {
        var terms = SteeringForce();
        obey_all(task, first, me, &terms);
        force = with_walls(terms, x, y);
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
    if CONFINES && own.end_near > 0u {
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

// Records the agents at each POI after a step, from positions that start at `now`. One thread per POI, word and team,
// from the last thread on, because followers finish before leaders.
fn record_poi_sets(task: Task, step: u32, now: u32, thread: u32) {
    let rows = shape.pois * shape.words;
    for (var item = WORKGROUP - 1u - thread; item < rows * shape.teams; item += WORKGROUP) {
        let team = item % shape.teams;
        let row = item / shape.teams;
        if team < task.teams {
            let place = places[task.pois + row / shape.words];
            let radius2 = poi_of(task, row / shape.words).x;
            let first = row % shape.words * 32u;
            let last = min(first + 32u, shape.agents);
            var near = 0u;
            for (var agent = first; agent < last; agent++) {
                let at = positions[now + agent * shape.teams + team];
                near |= select(0u, 1u << (agent - first), observes(radius2, place.x - at.x, place.y - at.y));
            }
            record[task.sets + (step * rows + row) * task.teams + team] = near;
        }
    }
}

// Returns the class of an agent.
fn class_of(agent: u32) -> u32 {
    var index = 0u;
    while agent >= class_shape(index).end_agent {
        index++;
    }
    return index;
}

// Records which leaders each follower sees before a step, from positions that start at `now`. One thread per follower,
// word and team.
fn record_sightings(task: Task, step: u32, now: u32, thread: u32) {
    let followers = shape.agents - shape.leaders;
    let words = (shape.leaders + 31u) / 32u;
    let rows = followers * words;
    // Sightings come after the counts.
    let sights = task.counts + followers * shape.leaders * task.teams;
    for (var item = thread; item < rows * shape.teams; item += WORKGROUP) {
        let team = item % shape.teams;
        let row = item / shape.teams;
        if team < task.teams {
            let follower = shape.leaders + row / words;
            let at = positions[now + follower * shape.teams + team];
            let class_number = class_of(follower);
            let first = row % words * 32u;
            let last = min(first + 32u, shape.leaders);
            var seen = 0u;
            for (var leader = first; leader < last; leader++) {
                let place = positions[now + leader * shape.teams + team];
                let influence2 = influence_of(leader, class_number);
                seen |= select(0u, 1u << (leader - first), within(place.x - at.x, place.y - at.y, influence2));
            }
            record[sights + (step * rows + row) * task.teams + team] = seen;
        }
    }
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

// Starts an episode.
fn begin(task: Task, me: ptr<function, Agent>) {
    let start = places[task.starts + (*me).agent];
    (*me).x = start.x;
    (*me).y = start.y;
    // Headings come after the POIs.
    let heading = places[task.pois + shape.pois + (*me).agent];
    (*me).hx = heading.x;
    (*me).hy = heading.y;
    (*me).speed = own.speed;
    for (var leader = 0u; !COUNTS_IN_REGISTERS && leader < shape.leaders && (*me).agent >= shape.leaders; leader++) {
        record[sight(task, me, leader)] = 0u;
    }
    if TRACE {
        trace(task, 0u, me);
    }
}

// Continues from the previous dispatch.
fn resume(task: Task, me: ptr<function, Agent>) {
    let state = states[state_of(task, false, (*me).team, (*me).agent)];
    (*me).x = state.x;
    (*me).y = state.y;
    (*me).hx = state.hx;
    (*me).hy = state.hy;
    (*me).speed = state.speed;
    for (var leader = 0u; COUNTS_IN_REGISTERS && leader < shape.leaders && (*me).agent >= shape.leaders; leader++) {
        (*me).counts[leader] = record[sight(task, me, leader)];
    }
}

// Stores the state at the end of a dispatch.
fn store_state(task: Task, me: ptr<function, Agent>) {
    for (var leader = 0u; COUNTS_IN_REGISTERS && leader < shape.leaders && (*me).agent >= shape.leaders; leader++) {
        record[sight(task, me, leader)] = (*me).counts[leader];
    }
    if task.end < world.steps {
        let state = State((*me).x, (*me).y, (*me).hx, (*me).hy, (*me).speed);
        states[state_of(task, false, (*me).team, (*me).agent)] = state;
    }
}

@compute @workgroup_size(WORKGROUP)
fn episode(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    // A dispatch may have a few more workgroups than tasks. Their tasks are empty.
    let index = workgroup.y * workgroups.x + workgroup.x;
    let task = tasks[index];
    world = worlds[task.world];
    set_shape(task);

    var agents: array<Agent, SLOTS>;
    for (var slot = 0u; slot < SLOTS; slot++) {
        var me = assign_agent(slot * WORKGROUP + thread, task.teams);
        if me.plays {
            load_class(me.class_index);
            if task.first == 0u {
                begin(task, &me);
            } else {
                resume(task, &me);
            }
            positions[me.index] = vec2(me.x, me.y);
            share_heading(task, false, &me);
        }
        agents[slot] = me;
    }
    if ALIGNS {
        storageBarrier();
    }
    workgroupBarrier();

    var now = 0u;
    for (var step = task.first; step < task.end; step++) {
        let next = SHARED - now;
        if SIGHTINGS {
            record_sightings(task, step, now, thread);
        }
        for (var slot = 0u; slot < SLOTS; slot++) {
            var me = agents[slot];
            if me.plays {
                act(task, now + me.team, &me);
                positions[next + me.index] = vec2(me.x, me.y);
                share_heading(task, next > 0u, &me);
                if TRACE {
                    trace(task, step + 1u, &me);
                }
            }
            agents[slot] = me;
        }
        if ALIGNS {
            storageBarrier();
        }
        workgroupBarrier();
        record_poi_sets(task, step, next, thread);
        now = next;
    }
    for (var slot = 0u; slot < SLOTS; slot++) {
        var me = agents[slot];
        if me.plays {
            store_state(task, &me);
        }
    }
    // Empty tasks have no status word. Later dispatches of a task count up, so that none of them can be missing.
    storageBarrier();
    if thread == 0u && task.teams > 0u {
        record[task.status] = select(record[task.status] + 1u, task.nonce, task.first == 0u);
    }
}
