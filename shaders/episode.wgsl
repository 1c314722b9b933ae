// Whole episodes: a workgroup plays some teams from start to end, state in registers and workgroup memory. Long ones
// take several dispatches, with the state kept in between.
//
// The host puts these constants in front:
//   WORKGROUP  threads of a workgroup
//   SLOTS      agents a thread plays, one after another
//   SHARED     agents of a workgroup's teams
//   WIDEST     widest layer of any policy, inputs included
//   TRACE      whether every stage of every step is kept
//
// Roles are packed: the leaders of all teams come first, followers start at the next multiple of ROLE threads, so
// that the two rarely share a warp.

const ROLE: u32 = 32u;

// This task's world.
var<private> world: World;

// Positions of all agents, `[teams][agents]`, as of the last step.
var<workgroup> positions: array<vec2<f32>, SHARED>;

// What one thread plays: an agent of a team, with its state and what it wants next.
struct Agent {
    plays: bool,
    team: u32,
    agent: u32,
    x: f32,
    y: f32,
    hx: f32,
    hy: f32,
    speed: f32,
    next: Course,
    // For the trace: what was sensed and answered, or the force.
    inputs: array<f32, 8>,
    outputs: array<f32, 2>,
    force: vec2<f32>,
}

// The agent that place `index` of the workgroup plays.
fn seat(index: u32, teams: u32) -> Agent {
    var agent: Agent;
    let leaders = teams * world.leaders;
    let first_follower = (leaders + ROLE - 1u) / ROLE * ROLE;
    if index < leaders {
        agent.plays = true;
        agent.team = index / world.leaders;
        agent.agent = index % world.leaders;
    } else if index >= first_follower && index - first_follower < teams * world.followers {
        agent.plays = true;
        agent.team = (index - first_follower) / world.followers;
        agent.agent = world.leaders + (index - first_follower) % world.followers;
    }
    return agent;
}

// A leader senses POIs, then the other agents, and decides.
fn lead(task: Task, me: ptr<function, Agent>) {
    let agents = world.leaders + world.followers;
    let team = (*me).team;
    let leader = (*me).agent;
    let x = (*me).x;
    let y = (*me).y;
    let hx = (*me).hx;
    let hy = (*me).hy;
    var inputs: array<f32, WIDEST>;
    var sums = array<f32, 4>(0.0, 0.0, 0.0, 0.0);
    for (var poi = 0u; poi < world.pois; poi++) {
        let place = places[task.pois + poi];
        let dx = place.x - x;
        let dy = place.y - y;
        sense(density(world.poi_range2, dx, dy), dx, dy, hx, hy, &sums);
    }
    for (var quadrant = 0u; quadrant < 4u; quadrant++) {
        inputs[quadrant] = sums[quadrant] * world.poi_share;
    }
    sums = array<f32, 4>(0.0, 0.0, 0.0, 0.0);
    for (var other = 0u; other < agents; other++) {
        let place = positions[team * agents + other];
        if other != leader {
            let dx = place.x - x;
            let dy = place.y - y;
            sense(density(world.agent_range2, dx, dy), dx, dy, hx, hy, &sums);
        }
    }
    for (var quadrant = 0u; quadrant < 4u; quadrant++) {
        inputs[4u + quadrant] = sums[quadrant] * world.agent_share;
    }
    if TRACE {
        for (var input = 0u; input < 8u; input++) {
            (*me).inputs[input] = inputs[input];
        }
    }
    let stride = task.teams * world.leaders;
    var first = task.weights + team * world.leaders + leader;
    for (var layer = 0u; layer < world.layers; layer++) {
        let rows = world.widths[layer];
        let columns = world.widths[layer + 1u];
        var units: array<f32, WIDEST>;
        for (var column = 0u; column < columns; column++) {
            let sum = tame(weigh(&inputs, rows, first + column * stride, columns * stride));
            units[column] = whole_tangent(half_tangent(sum));
        }
        inputs = units;
        first += (rows + 1u) * columns * stride;
    }
    if TRACE {
        (*me).outputs = array<f32, 2>(inputs[0], inputs[1]);
    }
    let heading = turn(hx, hy, wanted_turn(inputs[0]));
    (*me).next = Course(heading.x, heading.y, wanted_speed(inputs[1]));
}

// A follower counts the leaders that it sees and follows whoever is near.
fn follow(task: Task, me: ptr<function, Agent>) {
    let agents = world.leaders + world.followers;
    let team = (*me).team;
    let agent = (*me).agent;
    let x = (*me).x;
    let y = (*me).y;
    var sums = Sums();
    for (var other = 0u; other < agents; other++) {
        let place = positions[team * agents + other];
        if other != agent {
            let seen = influence(place.x - x, place.y - y, &sums);
            if seen && other < world.leaders {
                record[task.seen + ((agent - world.leaders) * world.leaders + other) * task.teams + team] += 1u;
            }
        }
    }
    let pull = force(sums, x, y);
    if TRACE {
        (*me).force = vec2(pull.x, pull.y);
    }
    (*me).next = steer(pull, sizes(pull), (*me).hx, (*me).hy, (*me).speed);
}

// Everyone moves.
fn go(me: ptr<function, Agent>) {
    let next = (*me).next;
    let heading = straighten(next.hx, next.hy);
    let speed = accelerate((*me).speed, next.speed);
    let step = speed * world.dt;
    (*me).x = advance((*me).x, step, heading.x, world.map_x);
    (*me).y = advance((*me).y, step, heading.y, world.map_y);
    (*me).hx = heading.x;
    (*me).hy = heading.y;
    (*me).speed = speed;
}

// Records who is near each POI after a step: one thread a POI, word and team.
fn couple(task: Task, step: u32, thread: u32) {
    let agents = world.leaders + world.followers;
    let rows = world.pois * world.words;
    for (var item = thread; item < rows * task.teams; item += WORKGROUP) {
        let team = item % task.teams;
        let row = item / task.teams;
        let place = places[task.pois + row / world.words];
        let first = row % world.words * 32u;
        let last = min(first + 32u, agents);
        var near = 0u;
        for (var agent = first; agent < last; agent++) {
            let at = positions[team * agents + agent];
            near |= select(0u, 1u << (agent - first), observes(place.x - at.x, place.y - at.y));
        }
        record[task.sets + step * rows * task.teams + item] = near;
    }
}

fn trace(task: Task, step: u32, me: ptr<function, Agent>) {
    let agents = world.leaders + world.followers;
    var moment: Moment;
    moment.inputs = (*me).inputs;
    moment.outputs = (*me).outputs;
    moment.force = array<f32, 2>((*me).force.x, (*me).force.y);
    moment.position = array<f32, 2>((*me).x, (*me).y);
    moment.heading = array<f32, 2>((*me).hx, (*me).hy);
    moment.speed = (*me).speed;
    moments[task.moments + (step * task.teams + (*me).team) * agents + (*me).agent] = moment;
}

// The start of an episode.
fn begin(task: Task, me: ptr<function, Agent>) {
    let start = places[task.starts + (*me).agent];
    (*me).x = start.x;
    (*me).y = start.y;
    (*me).hx = world.heading_x;
    (*me).hy = world.heading_y;
    (*me).speed = world.speed;
    for (var leader = 0u; leader < world.leaders && (*me).agent >= world.leaders; leader++) {
        let pair = ((*me).agent - world.leaders) * world.leaders + leader;
        record[task.seen + pair * task.teams + (*me).team] = 0u;
    }
    if TRACE {
        trace(task, 0u, me);
    }
}

// Where the dispatch before this one left off.
fn resume(task: Task, me: ptr<function, Agent>) {
    let state = states[task.states + (*me).team * (world.leaders + world.followers) + (*me).agent];
    (*me).x = state.x;
    (*me).y = state.y;
    (*me).hx = state.hx;
    (*me).hy = state.hy;
    (*me).speed = state.speed;
}

@compute @workgroup_size(WORKGROUP)
fn episode(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    // A dispatch may hold a few workgroups more than there are tasks; their tasks are empty.
    let index = workgroup.y * workgroups.x + workgroup.x;
    let task = tasks[index];
    world = worlds[task.world];
    let agents = world.leaders + world.followers;

    var team: array<Agent, SLOTS>;
    for (var slot = 0u; slot < SLOTS; slot++) {
        var me = seat(slot * WORKGROUP + thread, task.teams);
        if me.plays {
            if task.first == 0u {
                begin(task, &me);
            } else {
                resume(task, &me);
            }
            positions[me.team * agents + me.agent] = vec2(me.x, me.y);
        }
        team[slot] = me;
    }
    workgroupBarrier();

    for (var step = task.first; step < task.end; step++) {
        for (var slot = 0u; slot < SLOTS; slot++) {
            var me = team[slot];
            if me.plays {
                if me.agent < world.leaders {
                    lead(task, &me);
                } else {
                    follow(task, &me);
                }
                go(&me);
                if TRACE {
                    trace(task, step + 1u, &me);
                }
            }
            team[slot] = me;
        }
        workgroupBarrier();
        for (var slot = 0u; slot < SLOTS; slot++) {
            if team[slot].plays {
                positions[team[slot].team * agents + team[slot].agent] = vec2(team[slot].x, team[slot].y);
            }
        }
        workgroupBarrier();
        couple(task, step, thread);
    }
    for (var slot = 0u; slot < SLOTS && task.end < world.steps; slot++) {
        if team[slot].plays {
            let me = team[slot];
            states[task.states + me.team * agents + me.agent] = State(me.x, me.y, me.hx, me.hy, me.speed);
        }
    }
}
