// Whole episodes: a workgroup plays some teams from start to end, with state in registers and workgroup memory. Long
// episodes take several dispatches, with the state stored in between.
//
// Uses: lib/layout.wgsl, lib/math.wgsl, generic.wgsl (shape, set_shape, decide), sense.wgsl, policy.wgsl, follow.wgsl,
// motion.wgsl, couple.wgsl.
//
// One text makes two kernels. In the specialised one all sizes are constants. In the generic one they are read with the
// task (`generic.wgsl`). The host prepends:
//   WORKGROUP  threads per workgroup
//   ROLE       followers start at multiples of this many threads
//   SLOTS      agents per thread, played one after another
//   SHARED     agents of a workgroup's teams
//   TRACE      whether every stage of every step is recorded
//   SIGHTINGS  whether the leaders that each follower sees at each step are recorded
//   COUNTS_IN_REGISTERS, COUNTED_LEADERS
//              whether a follower counts the leaders it sees in registers, not in the record, and how many registers
//   shape      the sizes
//   variant    the choices between formulas
//   set_shape  sets both for a task
//   decide     a leader's policy
//
// Neighbouring threads play the same agent of neighbouring teams. They execute the same code, load neighbouring
// weights, and are often all out of reach of the same agent. Leaders come first. Followers start at the next multiple
// of ROLE threads, so that the two rarely share a warp.

// Sizes that are constant in a kernel, or for a task.
struct Shape {
    leaders: u32,
    agents: u32,
    pois: u32,
    words: u32,
    // Teams per workgroup. A task may have fewer.
    teams: u32,
}

// The task's world.
var<private> world: Constants;

// Positions of all agents, `[agents][teams]`, after the last step and after this step. The two halves alternate, so
// that one barrier per step is enough.
var<workgroup> positions: array<vec2<f32>, 2u * SHARED>;

// What one thread plays: an agent of a team, its state, and its wanted course.
struct Agent {
    plays: bool,
    team: u32,
    agent: u32,
    // Its index in `positions`.
    index: u32,
    x: f32,
    y: f32,
    hx: f32,
    hy: f32,
    speed: f32,
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
    let leaders = shape.teams * shape.leaders;
    let first_follower = (leaders + ROLE - 1u) / ROLE * ROLE;
    let follows = place >= first_follower;
    agent.index = select(place, place - first_follower + leaders, follows);
    agent.team = agent.index % shape.teams;
    agent.agent = agent.index / shape.teams;
    agent.plays = (follows || place < leaders) && agent.agent < shape.agents && agent.team < teams;
    return agent;
}

// Returns which of 32 agents from `base` on are within a leader's range, one bit each. Its team's positions start at
// `first`.
fn reached(first: u32, base: u32, x: f32, y: f32) -> u32 {
    var near = 0u;
    for (var other = base; other < min(base + 32u, shape.agents); other++) {
        let place = positions[first + other * shape.teams];
        near |= select(0u, 1u << (other - base), within(place.x - x, place.y - y, world.agent_range2));
    }
    return near;
}

// A leader senses POIs, then the other agents, and decides. Its team's positions start at `first`.
fn lead(task: Task, first: u32, me: ptr<function, Agent>) {
    let leader = (*me).agent;
    let x = (*me).x;
    let y = (*me).y;
    let hx = (*me).hx;
    let hy = (*me).hy;
    var of_pois = Quadrants();
    for (var poi = 0u; poi < shape.pois; poi++) {
        let place = places[task.pois + poi];
        let dx = place.x - x;
        let dy = place.y - y;
        let sensed = select(0, density(dx, dy), within(dx, dy, world.poi_range2));
        add_sensed(sensed, dx, dy, hx, hy, &of_pois);
    }
    var of_agents = Quadrants();
    for (var word = 0u; word < shape.words; word++) {
        // The first loop finds the agents in reach, and the second iterates over these only. A warp then takes as many
        // iterations as its busiest thread, not as many as there are agents in reach of any thread.
        let base = word * 32u;
        var near = reached(first, base, x, y);
        near &= ~select(0u, 1u << (leader % 32u), leader / 32u == word);
        while near != 0u {
            let place = positions[first + (base + firstTrailingBit(near)) * shape.teams];
            let dx = place.x - x;
            let dy = place.y - y;
            add_sensed(density(dx, dy), dx, dy, hx, hy, &of_agents);
            near &= near - 1u;
        }
    }
    let inputs = scale_inputs(of_pois, of_agents);
    let start = task.weights + leader * task.teams + (*me).team;
    let outputs = decide(start, shape.leaders * task.teams, inputs);
    if TRACE {
        (*me).inputs = inputs;
        (*me).outputs = outputs;
    }
    let heading = turn(hx, hy, wanted_turn(outputs.x));
    (*me).next = Steering(heading.x, heading.y, wanted_speed(outputs.y));
}

// Returns the index in the record of a follower's count of a leader.
fn sight(task: Task, me: ptr<function, Agent>, leader: u32) -> u32 {
    return task.counts + (((*me).agent - shape.leaders) * shape.leaders + leader) * task.teams + (*me).team;
}

// A follower counts the leaders it sees, and follows the agents near it. Its team's positions start at `first`.
fn follow(task: Task, first: u32, me: ptr<function, Agent>) {
    let x = (*me).x;
    let y = (*me).y;
    var sums = Sums();
    for (var leader = 0u; leader < shape.leaders; leader++) {
        let place = positions[first + leader * shape.teams];
        let seen = u32(influence(place.x - x, place.y - y, &sums));
        if COUNTS_IN_REGISTERS {
            (*me).counts[leader] += seen;
        } else if seen != 0u {
            record[sight(task, me, leader)] += seen;
        }
    }
    for (var other = shape.leaders; other < shape.agents; other++) {
        let place = positions[first + other * shape.teams];
        if other != (*me).agent {
            influence(place.x - x, place.y - y, &sums);
        }
    }
    let force = force(sums, x, y);
    if TRACE {
        (*me).force = vec2(force.x, force.y);
    }
    (*me).next = steer(force, sizes(force), (*me).hx, (*me).hy, (*me).speed);
}

// Moves the agent.
fn move_agent(me: ptr<function, Agent>) {
    let next = (*me).next;
    let heading = renormalize(next.hx, next.hy);
    let speed = accelerate((*me).speed, next.speed);
    let step = speed * world.dt;
    (*me).x = advance((*me).x, step, heading.x, world.map_x);
    (*me).y = advance((*me).y, step, heading.y, world.map_y);
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
            let first = row % shape.words * 32u;
            let last = min(first + 32u, shape.agents);
            var near = 0u;
            for (var agent = first; agent < last; agent++) {
                let at = positions[now + agent * shape.teams + team];
                near |= select(0u, 1u << (agent - first), observes(place.x - at.x, place.y - at.y));
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
            let at = positions[now + (shape.leaders + row / words) * shape.teams + team];
            let first = row % words * 32u;
            let last = min(first + 32u, shape.leaders);
            var seen = 0u;
            for (var leader = first; leader < last; leader++) {
                let place = positions[now + leader * shape.teams + team];
                seen |= select(0u, 1u << (leader - first), sees(place.x - at.x, place.y - at.y));
            }
            record[sights + (step * rows + row) * task.teams + team] = seen;
        }
    }
}

fn trace(task: Task, step: u32, me: ptr<function, Agent>) {
    var moment: Moment;
    moment.inputs = (*me).inputs;
    moment.outputs = array<f32, 2>((*me).outputs.x, (*me).outputs.y);
    moment.force = array<f32, 2>((*me).force.x, (*me).force.y);
    moment.position = array<f32, 2>((*me).x, (*me).y);
    moment.heading = array<f32, 2>((*me).hx, (*me).hy);
    moment.speed = (*me).speed;
    moments[task.moments + (step * task.teams + (*me).team) * shape.agents + (*me).agent] = moment;
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
    (*me).speed = world.speed;
    for (var leader = 0u; !COUNTS_IN_REGISTERS && leader < shape.leaders && (*me).agent >= shape.leaders; leader++) {
        record[sight(task, me, leader)] = 0u;
    }
    if TRACE {
        trace(task, 0u, me);
    }
}

// Continues from the previous dispatch.
fn resume(task: Task, me: ptr<function, Agent>) {
    let state = states[task.states + (*me).team * shape.agents + (*me).agent];
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
        states[task.states + (*me).team * shape.agents + (*me).agent] = state;
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
            if task.first == 0u {
                begin(task, &me);
            } else {
                resume(task, &me);
            }
            positions[me.index] = vec2(me.x, me.y);
        }
        agents[slot] = me;
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
                if me.agent < shape.leaders {
                    lead(task, now + me.team, &me);
                } else {
                    follow(task, now + me.team, &me);
                }
                move_agent(&me);
                positions[next + me.index] = vec2(me.x, me.y);
                if TRACE {
                    trace(task, step + 1u, &me);
                }
            }
            agents[slot] = me;
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
