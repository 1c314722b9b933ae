// Whole episodes: a workgroup plays some teams from start to end, state in registers and workgroup memory.
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
fn lead(task: Task, self_: ptr<function, Agent>) {
    let agents = world.leaders + world.followers;
    let team = (*self_).team;
    let leader = (*self_).agent;
    let x = (*self_).x;
    let y = (*self_).y;
    let hx = (*self_).hx;
    let hy = (*self_).hy;
    var from: array<f32, WIDEST>;
    var sums = array<f32, 4>(0.0, 0.0, 0.0, 0.0);
    for (var poi = 0u; poi < world.pois; poi++) {
        let place = places[task.pois + poi];
        sense(world.poi_range2, place.x - x, place.y - y, hx, hy, &sums);
    }
    for (var quadrant = 0u; quadrant < 4u; quadrant++) {
        from[quadrant] = sums[quadrant] * world.poi_share;
    }
    sums = array<f32, 4>(0.0, 0.0, 0.0, 0.0);
    for (var other = 0u; other < agents; other++) {
        let place = positions[team * agents + other];
        if other != leader {
            sense(world.agent_range2, place.x - x, place.y - y, hx, hy, &sums);
        }
    }
    for (var quadrant = 0u; quadrant < 4u; quadrant++) {
        from[4u + quadrant] = sums[quadrant] * world.agent_share;
    }
    if TRACE {
        for (var input = 0u; input < 8u; input++) {
            (*self_).inputs[input] = from[input];
        }
    }
    let stride = task.teams * world.leaders;
    var first = task.weights + team * world.leaders + leader;
    for (var layer = 0u; layer < world.layers; layer++) {
        let rows = world.widths[layer];
        let columns = world.widths[layer + 1u];
        var to: array<f32, WIDEST>;
        for (var column = 0u; column < columns; column++) {
            to[column] = activate(weigh(&from, rows, first + column * stride, columns * stride));
        }
        from = to;
        first += (rows + 1u) * columns * stride;
    }
    if TRACE {
        (*self_).outputs = array<f32, 2>(from[0], from[1]);
    }
    let heading = turn(hx, hy, wanted_turn(from[0]));
    (*self_).next = Course(heading.x, heading.y, wanted_speed(from[1]));
}

// A follower counts the leaders that it sees and follows whoever is near.
fn follow(task: Task, self_: ptr<function, Agent>) {
    let agents = world.leaders + world.followers;
    let team = (*self_).team;
    let agent = (*self_).agent;
    let x = (*self_).x;
    let y = (*self_).y;
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
    let influenced = sums.repel_count + sums.attract_count > 0.0 || wall_near(x, world.map_x) || wall_near(y, world.map_y);
    if TRACE {
        (*self_).force = pull;
    }
    (*self_).next = steer(pull.x, pull.y, influenced, (*self_).hx, (*self_).hy, (*self_).speed);
}

// Everyone moves.
fn go(self_: ptr<function, Agent>) {
    let next = (*self_).next;
    let heading = straighten(next.hx, next.hy);
    let speed = accelerate((*self_).speed, next.speed);
    let step = speed * world.dt;
    (*self_).x = advance((*self_).x, step, heading.x, world.map_x);
    (*self_).y = advance((*self_).y, step, heading.y, world.map_y);
    (*self_).hx = heading.x;
    (*self_).hy = heading.y;
    (*self_).speed = speed;
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
        var set = 0u;
        for (var agent = first; agent < last; agent++) {
            let at = positions[team * agents + agent];
            set |= select(0u, 1u << (agent - first), observes(place.x - at.x, place.y - at.y));
        }
        record[task.sets + step * rows * task.teams + item] = set;
    }
}

fn trace(task: Task, step: u32, self_: ptr<function, Agent>) {
    let agents = world.leaders + world.followers;
    var moment: Moment;
    moment.inputs = (*self_).inputs;
    moment.outputs = (*self_).outputs;
    moment.force = array<f32, 2>((*self_).force.x, (*self_).force.y);
    moment.position = array<f32, 2>((*self_).x, (*self_).y);
    moment.heading = array<f32, 2>((*self_).hx, (*self_).hy);
    moment.speed = (*self_).speed;
    moments[task.moments + (step * task.teams + (*self_).team) * agents + (*self_).agent] = moment;
}

@compute @workgroup_size(WORKGROUP)
fn episode(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    // A dispatch may hold a few workgroups more than there are tasks; they play the last one's empty share.
    let index = workgroup.y * workgroups.x + workgroup.x;
    let task = tasks[index];
    world = worlds[task.world];
    let agents = world.leaders + world.followers;

    var team: array<Agent, SLOTS>;
    for (var slot = 0u; slot < SLOTS; slot++) {
        var self_ = seat(slot * WORKGROUP + thread, task.teams);
        if self_.plays {
            let start = places[task.starts + self_.agent];
            self_.x = start.x;
            self_.y = start.y;
            self_.hx = world.heading_x;
            self_.hy = world.heading_y;
            self_.speed = world.speed;
            positions[self_.team * agents + self_.agent] = start;
            for (var leader = 0u; leader < world.leaders && self_.agent >= world.leaders; leader++) {
                record[task.seen + ((self_.agent - world.leaders) * world.leaders + leader) * task.teams + self_.team] = 0u;
            }
            if TRACE {
                trace(task, 0u, &self_);
            }
        }
        team[slot] = self_;
    }
    workgroupBarrier();

    let steps = worlds[task.world].steps;
    for (var step = 0u; step < steps; step++) {
        for (var slot = 0u; slot < SLOTS; slot++) {
            var self_ = team[slot];
            if self_.plays {
                if self_.agent < world.leaders {
                    lead(task, &self_);
                } else {
                    follow(task, &self_);
                }
                go(&self_);
                if TRACE {
                    trace(task, step + 1u, &self_);
                }
            }
            team[slot] = self_;
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
}
