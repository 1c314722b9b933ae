// Whole episodes: a workgroup plays some teams from start to end, with state in registers and workgroup memory. Long
// episodes take several dispatches, with the state stored in between.
//
// Uses: lib/layout.wgsl, lib/math.wgsl, generic.wgsl (set_shape, act), agent.wgsl, sense.wgsl, follow.wgsl, couple.wgsl.
//
// One text makes two kernels. In the specialised one all sizes and the shapes of all classes are constants. In the generic
// one they are read with the task (`generic.wgsl`). The host prepends, with what agent.wgsl needs:
//   WORKGROUP     threads per workgroup
//   ROLE          each class starts at a multiple of this many threads
//   SLOTS         agents per thread, played one after another
//   SHARED        agents of a workgroup's teams
//   MAY_ALIGN     whether rules may align headings, which agents share through storage
//   MAY_BE_GONE   whether POIs may be gone, which the threads of a workgroup find out together
//   COUNTS_IN_REGISTERS
//                 whether a follower counts the leaders it sees in registers
//   set_shape     sets the sizes for a task
//   act           the step of an agent
//
// Neighbouring threads play the same agent of neighbouring teams. They execute the same code, load neighbouring
// weights, and are often all out of reach of the same agent. Each class starts at the next multiple of ROLE threads, so
// that two rarely share a warp.

// Positions of all agents, `[agents][teams]`, after the last step and after this step. The two halves alternate, so
// that one barrier per step is enough.
var<workgroup> positions: array<vec2<f32>, 2u * SHARED>;

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

// Returns the position of an agent. Its team's positions start at `first`.
fn position_of(first: u32, agent: u32) -> vec2<f32> {
    return positions[first + agent * shape.teams];
}

// Returns which of up to 32 agents from `base` to before `end` are within a squared range, one bit each. Their team's
// positions start at `first`.
fn reached(first: u32, base: u32, end: u32, x: f32, y: f32, range2: f32) -> u32 {
    var near = 0u;
    for (var other = base; other < min(base + 32u, end); other++) {
        let place = position_of(first, other);
        near |= select(0u, 1u << (other - base), within(place.x - x, place.y - y, range2));
    }
    return near;
}

// Senses the agents of a range. Its team's positions start at `first`.
fn sense_agents(
    task: Task,
    first: u32,
    channel: ChannelShape,
    gauge: Gauge,
    index: u32,
    range: vec2<u32>,
    part: u32,
    me: ptr<function, Agent>,
    sensed: ptr<function, Sensed>,
) {
    for (var base = range.x; base < range.y; base += 32u) {
        // The first loop finds the agents in reach, and the second iterates over these only. A warp then takes as many
        // iterations as its busiest thread, not as many as there are agents in reach of any thread.
        var near = reached(first, base, range.y, (*me).x, (*me).y, gauge.range2);
        let before = (*me).agent - base;
        near &= ~select(0u, 1u << (before % 32u), before < 32u);
        while near != 0u {
            let place = position_of(first, base + firstTrailingBit(near));
            add_sensed(channel, gauge, index, 1.0, place.x - (*me).x, place.y - (*me).y, me, sensed);
            near &= near - 1u;
        }
    }
}

// Shares an agent's heading with those that align with it.
fn share_heading(task: Task, second: bool, me: ptr<function, Agent>) {
    if shape.aligns {
        states[state_of(task, second, (*me).team, (*me).agent)] = current_state(me);
    }
}

// Adds the offsets or the headings of the agents of a range to two terms. Its team's positions start at `first`.
fn obey_agents(
    task: Task,
    first: u32,
    aligns: bool,
    range: vec2<u32>,
    one: Pull,
    two: Pull,
    me: ptr<function, Agent>,
    sums: ptr<function, array<Sum, 2>>,
) {
    for (var other = range.x; other < range.y; other++) {
        let place = position_of(first, other);
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
            (*sums)[0] = with_other((*sums)[0], one, d2, x, y);
            (*sums)[1] = with_other((*sums)[1], two, d2, x, y);
        }
    }
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

// Records which POIs are gone before a step, from positions that start at `now`. One thread per POI and team.
fn find_gone(task: Task, step: u32, now: u32, thread: u32) {
    for (var item = thread; item < shape.pois * shape.teams; item += WORKGROUP) {
        let team = item % shape.teams;
        let poi = item / shape.teams;
        if team < task.teams {
            let word = gone_word(task, team, poi);
            let gone_within = gone_within_of(task, poi);
            let place = places[task.pois + poi];
            var gone = step > 0u && record[word] != 0u;
            for (var index = 0u; index < shape.classes; index++) {
                let of_class = class_shape(index);
                let counts = (u32(gone_within.y) >> index & 1u) != 0u;
                for (var agent = of_class.first_agent; counts && agent < of_class.end_agent; agent++) {
                    let at = positions[now + agent * shape.teams + team];
                    gone = gone || within(place.x - at.x, place.y - at.y, gone_within.x);
                }
            }
            record[word] = u32(gone);
        }
    }
}

// Reports whether a POI is gone.
fn is_gone(task: Task, team: u32, poi: u32) -> bool {
    return shape.gone && record[gone_word(task, team, poi)] != 0u;
}

// Counts the leaders that a follower sees. Its team's positions start at `first`.
fn count_leaders(task: Task, first: u32, me: ptr<function, Agent>) {
    for (var leader = 0u; leader < shape.leaders; leader++) {
        let place = position_of(first, leader);
        let seen = u32(within(place.x - (*me).x, place.y - (*me).y, influence_of(leader, own_class)));
        if COUNTS_IN_REGISTERS {
            (*me).counts[leader] += seen;
        } else if seen != 0u {
            record[sight(task, me, leader)] += seen;
        }
    }
}

// Starts an episode.
fn begin(task: Task, me: ptr<function, Agent>) {
    start(task, me);
    for (var leader = 0u; !COUNTS_IN_REGISTERS && leader < shape.leaders && (*me).agent >= shape.leaders; leader++) {
        record[sight(task, me, leader)] = 0u;
    }
    if TRACE {
        trace(task, 0u, me);
    }
}

// Continues from the previous dispatch.
fn resume(task: Task, me: ptr<function, Agent>) {
    load_state(state_of(task, false, (*me).team, (*me).agent), me);
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
        states[state_of(task, false, (*me).team, (*me).agent)] = current_state(me);
    }
}

@compute @workgroup_size(WORKGROUP)
fn episode(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let task = tasks[workgroup.x];
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
    if MAY_ALIGN {
        storageBarrier();
    }
    workgroupBarrier();

    var now = 0u;
    for (var step = task.first; step < task.end; step++) {
        let next = SHARED - now;
        if shape.sightings {
            record_sightings(task, step, now, thread);
        }
        if MAY_BE_GONE {
            if shape.gone {
                find_gone(task, step, now, thread);
            }
            storageBarrier();
            workgroupBarrier();
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
        // The next step replaces headings, and which POIs are gone.
        if MAY_ALIGN || MAY_BE_GONE {
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
    // Later dispatches of a task count up, so that none of them can be missing.
    storageBarrier();
    if thread == 0u {
        record[task.status] = select(record[task.status] + 1u, task.nonce, task.first == 0u);
    }
}
