// Episodes of large teams: a step takes several dispatches, and each agent finds those near it in a grid of cells.
//
// Uses: lib/layout.wgsl, lib/math.wgsl, generic.wgsl (set_shape, channel_of), agent.wgsl, sense.wgsl, follow.wgsl, couple.wgsl.
//
// The host prepends, with what agent.wgsl needs:
//   WORKGROUP   threads per workgroup
//   LANES       threads that share the agents of a cell when a learner senses
//
// Before the first step `clear` and `enter` run, and then in every step:
//   allocate  gives each cell as many slots as it has agents
//   fill      copies the agents to the slots of their cells
//   learn     learners sense, decide and move: a workgroup each, because some sense everything
//   obey_rule the others move
//
// Every class has cells of its own, and its slots have the numbers of its agents. Cells get their slots, and agents theirs
// in a cell, in any order: sums over agents are of integers, so that no bit depends on it.
//
// Per task there are the states before and after a step, which alternate, and those before it by slot, in which the speed
// is the number of the agent. Each task has one team.

// The cells of a class: row by row, with so many per unit. `word` is where the first is after the task's status word.
struct Grid {
    columns: u32,
    rows: u32,
    inverse: f32,
    word: u32,
}

// Words of a cell: the first of its slots, the slot after its last, and the agents that have come since.
const CELL_WORDS: u32 = 3u;
const END: u32 = 1u;
const COME: u32 = 2u;

// Slots that a workgroup gives to the cells of each class, and the first of them.
var<workgroup> given: array<atomic<u32>, MAX_CLASSES>;
var<workgroup> first_given: array<atomic<u32>, MAX_CLASSES>;
// What the threads of a learner sense: sums and counts of each input, or of four for quadrants.
var<workgroup> all_sums: array<atomic<i32>, INPUTS>;
var<workgroup> all_counts: array<atomic<i32>, INPUTS>;

// Loads the numbers of a task.
fn load_task(index: u32) -> Task {
    let task = tasks[index];
    world = worlds[task.world];
    set_shape(task);
    return task;
}

// Returns the grid of a class. Grids come after the last numbers of POIs.
fn grid_of(task: Task, class_number: u32) -> Grid {
    let at = task.pois + select(2u, 3u, shape.gone) * shape.pois + shape.agents + 2u * class_number;
    return Grid(u32(places[at].x), u32(places[at].y), places[at + 1u].x, u32(places[at + 1u].y));
}

// Returns the row or the column of a coordinate.
fn cell_at(at: f32, inverse: f32, count: u32) -> u32 {
    return u32(clamp_to(at * inverse, 0.0, f32(count - 1u)));
}

// Returns the words of the cell in which an agent of a class is.
fn cell_of(task: Task, class_number: u32, x: f32, y: f32) -> u32 {
    let grid = grid_of(task, class_number);
    let cell = cell_at(y, grid.inverse, grid.rows) * grid.columns + cell_at(x, grid.inverse, grid.columns);
    return task.status + 1u + grid.word + cell * CELL_WORDS;
}

// Cells of a class that are visited one after another, and the slots of one of them.
struct Search {
    // The words of the grid's first cell, and the cells of a row.
    cells: u32,
    columns: u32,
    first_column: u32,
    last_column: u32,
    last_row: u32,
    // The next cell.
    column: u32,
    row: u32,
    // The slot, and the one after the cell's last.
    slot: u32,
    end: u32,
    // Every so many cells, and in them every so many slots from this one on, are visited.
    parts: u32,
    lanes: u32,
    lane: u32,
}

// Returns a search for the agents of a class within a squared distance of a place. `part` of `parts * lanes` threads visits
// its share of them.
fn search(
    task: Task,
    class_number: u32,
    x: f32,
    y: f32,
    range2: f32,
    part: u32,
    parts: u32,
    lanes: u32,
) -> Search {
    var found: Search;
    if range2 >= world.map_x * world.map_x + world.map_y * world.map_y {
        // The class's slots are consecutive.
        let of_class = class_shape(class_number);
        found.lanes = parts * lanes;
        found.slot = of_class.first_agent + part - found.lanes;
        found.end = of_class.end_agent;
        found.row = 1u;
        return found;
    }
    let grid = grid_of(task, class_number);
    // Rounding must not hide an agent.
    let reach = exact_sqrt(range2) * 1.001 + (world.map_x + world.map_y) * 9.536743e-7;
    found.cells = task.status + 1u + grid.word;
    found.columns = grid.columns;
    found.first_column = cell_at(x - reach, grid.inverse, grid.columns);
    found.last_column = cell_at(x + reach, grid.inverse, grid.columns);
    found.last_row = cell_at(y + reach, grid.inverse, grid.rows);
    found.column = found.first_column + part / lanes;
    found.row = cell_at(y - reach, grid.inverse, grid.rows);
    found.parts = parts;
    found.lanes = lanes;
    found.lane = part % lanes;
    return found;
}

// Goes to the next slot. Reports whether there is one.
fn find(near: ptr<function, Search>) -> bool {
    var at = *near;
    at.slot += at.lanes;
    while at.slot >= at.end && at.row <= at.last_row {
        if at.column > at.last_column {
            at.column -= at.last_column - at.first_column + 1u;
            at.row += 1u;
        } else {
            let cell = at.cells + (at.row * at.columns + at.column) * CELL_WORDS;
            at.slot = atomicLoad(&record[cell]) + at.lane;
            at.end = atomicLoad(&record[cell + END]);
            at.column += at.parts;
        }
    }
    *near = at;
    return at.slot < at.end;
}

// Returns the index of the first state by slot.
fn slots_of(task: Task) -> u32 {
    return task.states + 2u * shape.agents;
}

// Reports whether all agents of a class are in a range: a range has all of a class or none.
fn has_class(range: vec2<u32>, class_number: u32) -> bool {
    let of_class = class_shape(class_number);
    return range.x <= of_class.first_agent && of_class.first_agent < range.y;
}

// Returns the position of an agent. Its team's states start at `first`.
fn position_of(first: u32, agent: u32) -> vec2<f32> {
    return vec2(states[first + agent].x, states[first + agent].y);
}

// Senses the agents of a range that are this thread's part.
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
    for (var class_number = 0u; class_number < shape.classes && gauge.range2 >= 0.0; class_number++) {
        if has_class(range, class_number) {
            var near = search(task, class_number, (*me).x, (*me).y, gauge.range2, part, WORKGROUP / LANES, LANES);
            while find(&near) {
                let other = states[slots_of(task) + near.slot];
                if u32(other.speed) != (*me).agent {
                    add_sensed(channel, gauge, index, 1.0, other.x - (*me).x, other.y - (*me).y, me, sensed);
                }
            }
        }
    }
}

// Adds the offsets or the headings of the agents of a range to two terms.
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
    let outer2 = select(one.outer2, two.outer2, two.outer2 > one.outer2);
    for (var class_number = 0u; class_number < shape.classes && outer2 >= 0.0; class_number++) {
        if has_class(range, class_number) {
            var near = search(task, class_number, (*me).x, (*me).y, outer2, 0u, 1u, 1u);
            while find(&near) {
                let other = states[slots_of(task) + near.slot];
                let dx = other.x - (*me).x;
                let dy = other.y - (*me).y;
                let d2 = dx * dx + dy * dy;
                if bitcast<i32>(d2) <= bitcast<i32>(outer2) && u32(other.speed) != (*me).agent {
                    var x = on_lattice(dx, own.offset_base);
                    var y = on_lattice(dy, own.offset_base);
                    if aligns {
                        x = on_lattice(other.hx, own.heading_base);
                        y = on_lattice(other.hy, own.heading_base);
                    }
                    (*sums)[0] = with_other((*sums)[0], one, d2, x, y);
                    (*sums)[1] = with_other((*sums)[1], two, d2, x, y);
                }
            }
        }
    }
}

// Counts the leaders that a follower sees, and records them if `shape.sightings`.
fn count_leaders(task: Task, first: u32, me: ptr<function, Agent>) {
    let words = (shape.leaders + 31u) / 32u;
    let followers = shape.agents - shape.leaders;
    // Sightings come after the counts.
    let sights = task.counts + followers * shape.leaders
        + (task.first * followers + (*me).agent - shape.leaders) * words;
    for (var class_number = 0u; class_shape(class_number).first_agent < shape.leaders; class_number++) {
        let influence2 = classes[world.first_class + class_number].influence2[own_class];
        if influence2 >= 0.0 {
            var near = search(task, class_number, (*me).x, (*me).y, influence2, 0u, 1u, 1u);
            while find(&near) {
                let other = states[slots_of(task) + near.slot];
                if within(other.x - (*me).x, other.y - (*me).y, influence2) {
                    let leader = u32(other.speed);
                    atomicAdd(&record[sight(task, me, leader)], 1u);
                    if shape.sightings {
                        atomicOr(&record[sights + leader / 32u], 1u << (leader % 32u));
                    }
                }
            }
        }
    }
}

// Reports whether a POI is gone. Its word has the first moment at which an observer was near enough, all bits inverted, or 0.
// A moment is needed because other workgroups already record the next one while this one senses.
fn is_gone(task: Task, team: u32, poi: u32) -> bool {
    return shape.gone && atomicLoad(&record[gone_word(task, team, poi)]) >= ~task.first;
}

// Stores an agent's state after `moment` steps, counts it in its cell, and records the POIs that it is at or that it makes gone.
fn settle(task: Task, moment: u32, me: ptr<function, Agent>) {
    states[state_of(task, moment % 2u == 1u, 0u, (*me).agent)] = current_state(me);
    atomicAdd(&record[cell_of(task, own_class, (*me).x, (*me).y) + COME], 1u);
    if TRACE {
        trace(task, moment, me);
    }
    for (var poi = 0u; poi < shape.pois; poi++) {
        let place = places[task.pois + poi];
        if shape.gone {
            let gone_within = gone_within_of(task, poi);
            let counts = (u32(gone_within.y) >> own_class & 1u) != 0u;
            if counts && within(place.x - (*me).x, place.y - (*me).y, gone_within.x) {
                atomicMax(&record[gone_word(task, 0u, poi)], ~moment);
            }
        }
        if moment > 0u && observes(poi_of(task, poi).x, place.x - (*me).x, place.y - (*me).y) {
            let words = task.sets + ((moment - 1u) * shape.pois + poi) * shape.words;
            atomicOr(&record[words + (*me).agent / 32u], 1u << ((*me).agent % 32u));
        }
    }
}

// Returns the agent in a slot, in its state before the step.
fn agent_in(task: Task, slot: u32) -> Agent {
    var me = agent_of(u32(states[slots_of(task) + slot].speed));
    load_state(state_of(task, task.first % 2u == 1u, 0u, me.agent), &me);
    return me;
}

// Returns an agent without a state.
fn agent_of(agent: u32) -> Agent {
    var me: Agent;
    me.agent = agent;
    me.class_index = class_of(agent);
    load_class(me.class_index);
    return me;
}

// Spoils the status word if the driver ends loops too soon. The host then takes nothing of the task.
//
// A thread of Mesa's llvmpipe 22.3 has 65 535 turns for all its loops together. After that each loop ends with its first
// turn, and so does this one, which should have two. Compilers cannot know that number, because it is from a buffer.
fn check_loops(task: Task) {
    var turns = 0u;
    for (var turn = task.first; turn <= task.end; turn++) {
        turns += 1u;
    }
    if turns < 2u {
        atomicSub(&record[task.status], 1u);
    }
}

@compute @workgroup_size(WORKGROUP)
fn clear(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(global_invocation_id) id: vec3<u32>,
) {
    let task = load_task(workgroup.y);
    let last = grid_of(task, shape.classes - 1u);
    let end = task.status + 1u + last.word + last.columns * last.rows * CELL_WORDS;
    for (var word = task.sets + id.x; word < end; word += workgroups.x * WORKGROUP) {
        atomicStore(&record[word], 0u);
    }
}

@compute @workgroup_size(WORKGROUP)
fn enter(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(global_invocation_id) id: vec3<u32>) {
    let task = load_task(workgroup.y);
    if id.x < shape.agents {
        var me = agent_of(id.x);
        start(task, &me);
        settle(task, 0u, &me);
    }
    if id.x == 0u {
        // Each step adds 1.
        atomicStore(&record[task.status], task.nonce - 1u);
    }
}

@compute @workgroup_size(WORKGROUP)
fn allocate(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let task = load_task(workgroup.y);
    if thread < MAX_CLASSES {
        atomicStore(&given[thread], 0u);
    }
    workgroupBarrier();
    let word = MAX_CLASSES + id.x * CELL_WORDS;
    var class_number = 0u;
    while class_number + 1u < shape.classes && word >= grid_of(task, class_number + 1u).word {
        class_number++;
    }
    let grid = grid_of(task, class_number);
    let exists = word < grid.word + grid.columns * grid.rows * CELL_WORDS;
    let cell = task.status + 1u + word;
    var offset = 0u;
    if exists {
        offset = atomicAdd(&given[class_number], atomicLoad(&record[cell + COME]));
    }
    workgroupBarrier();
    if thread < shape.classes {
        let count = atomicLoad(&given[thread]);
        atomicStore(&first_given[thread], atomicAdd(&record[task.status + 1u + thread], count));
    }
    workgroupBarrier();
    if exists {
        let first = class_shape(class_number).first_agent + atomicLoad(&first_given[class_number]) + offset;
        atomicStore(&record[cell], first);
        atomicStore(&record[cell + END], first);
        atomicStore(&record[cell + COME], 0u);
    }
}

@compute @workgroup_size(WORKGROUP)
fn fill(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(global_invocation_id) id: vec3<u32>) {
    let task = load_task(workgroup.y);
    if id.x < shape.agents {
        let agent = id.x;
        let state = states[state_of(task, task.first % 2u == 1u, 0u, agent)];
        let slot = atomicAdd(&record[cell_of(task, class_of(agent), state.x, state.y) + END], 1u);
        states[slots_of(task) + slot] = State(state.x, state.y, state.hx, state.hy, f32(agent));
    }
    if id.x < shape.classes {
        // For the next step.
        atomicStore(&record[task.status + 1u + id.x], 0u);
    }
}

@compute @workgroup_size(WORKGROUP)
fn learn(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let task = load_task(workgroup.y);
    let first = state_of(task, task.first % 2u == 1u, 0u, 0u);
    // More workgroups than another task's team has learners do nothing that remains.
    let exists = workgroup.x < shape.leaders;
    var me = agent_in(task, select(0u, workgroup.x, exists));
    let class_number = world.first_class + own_class;
    if thread == 0u {
        for (var index = 0u; index < own.channel_count; index++) {
            let channel = channel_of(class_number, index);
            for (var sector = 0u; sector < channel.sectors; sector++) {
                atomicStore(&all_sums[channel.input + sector], nothing_sensed(channel).sums[sector]);
                atomicStore(&all_counts[channel.input + sector], 0);
            }
        }
    }
    workgroupBarrier();
    for (var index = 0u; index < own.channel_count && exists; index++) {
        let channel = channel_of(class_number, index);
        var sensed = nothing_sensed(channel);
        sense_part(task, first, channel, gauge_of(own_class, index), index, thread, WORKGROUP, &me, &sensed);
        for (var sector = 0u; sector < channel.sectors; sector++) {
            let input = channel.input + sector;
            if has_quadrants(channel) {
                atomicAdd(&all_sums[input], sensed.quadrants.sums[sector]);
                atomicAdd(&all_counts[input], sensed.quadrants.counts[sector]);
            } else if channel.combine == COMBINE_CLOSEST {
                atomicMax(&all_sums[input], sensed.sums[sector]);
                atomicAdd(&all_counts[input], sensed.counts[sector]);
            } else {
                atomicAdd(&all_sums[input], sensed.sums[sector]);
                atomicAdd(&all_counts[input], sensed.counts[sector]);
            }
        }
    }
    workgroupBarrier();
    if thread == 0u && exists {
        var inputs: array<f32, INPUTS>;
        for (var index = 0u; index < own.channel_count; index++) {
            let channel = channel_of(class_number, index);
            var sensed: Sensed;
            for (var sector = 0u; sector < channel.sectors; sector++) {
                let sum = atomicLoad(&all_sums[channel.input + sector]);
                let count = atomicLoad(&all_counts[channel.input + sector]);
                sensed.sums[sector] = sum;
                sensed.counts[sector] = count;
                if has_quadrants(channel) {
                    let own_sector = vec4(sector) == vec4(0u, 1u, 2u, 3u);
                    sensed.quadrants.sums = select(sensed.quadrants.sums, vec4(sum), own_sector);
                    sensed.quadrants.counts = select(sensed.quadrants.counts, vec4(count), own_sector);
                }
            }
            write_inputs(channel, gauge_of(own_class, index), sensed, &inputs);
        }
        answer(task, first, inputs, &me);
        move_agent(first, &me);
        settle(task, task.first + 1u, &me);
    }
    check_loops(task);
}

@compute @workgroup_size(WORKGROUP)
fn obey_rule(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(global_invocation_id) id: vec3<u32>) {
    let task = load_task(workgroup.y);
    let slot = shape.leaders + id.x;
    if slot < shape.agents {
        let first = state_of(task, task.first % 2u == 1u, 0u, 0u);
        var me = agent_in(task, slot);
        follow(task, first, &me);
        move_agent(first, &me);
        settle(task, task.first + 1u, &me);
    }
    if id.x == 0u {
        atomicAdd(&record[task.status], 1u);
    }
    check_loops(task);
}
