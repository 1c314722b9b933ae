// Adds up what scores depend on of each team's record, so that little has to be copied to the host: what its POIs are
// worth, and what is lost without each leader. src/credit/fast.rs is the plain twin.
//
// Uses: lib/layout.wgsl.
//
// The host prepends:
//   WORKGROUP       threads per workgroup
//   MAX_COPIES      coupling from which D++ needs too many copies
//   COPIES_SHIFT    position of the number of copies in a sum of D++
//   LEADER, GROUP, COPIES
//                   who is taken out or added for a sum: a leader (D), a leader with its followers (Df), copies of a
//                   leader (D++); with 0 nobody

// Replaces bindings of the episode. Per group the bits of a sum; then per POI its coupling, its worth and its observers,
// `[words]`.
@group(0) @binding(3) var<storage, read> scoring: array<u32>;
// Per task its sums: what the observed POIs are worth, then what each leader of each kind is worth, `[rows][teams]`. After
// them its status word.
@group(0) @binding(4) var<storage, read_write> counted: array<atomic<u32>>;

// The worth of the unobserved POIs that this number of copies of one leader would complete.
var<private> completed: array<u32, MAX_COPIES>;

// The sizes of a world that counting needs.
struct Sizes {
    leaders: u32,
    agents: u32,
    pois: u32,
    words: u32,
    steps: u32,
}

// Returns where the record has a follower's numbers of steps at which it saw each leader.
fn row_of(task: Task, sizes: Sizes, team: u32, follower: u32) -> u32 {
    return task.counts + (follower - sizes.leaders) * sizes.leaders * task.teams + team;
}

// Returns the first follower of a word of agents.
fn first_follower(sizes: Sizes, word: u32) -> u32 {
    return max(word * 32u, sizes.leaders);
}

// Replaces the numbers of the first follower of a word by the followers of each leader in that word. Each follower belongs
// to the leader that it saw most; ties go to the lower index.
fn gather_groups(task: Task, sizes: Sizes, team: u32, word: u32) {
    let groups = row_of(task, sizes, team, first_follower(sizes, word));
    let end = min(word * 32u + 32u, sizes.agents);
    for (var follower = first_follower(sizes, word); follower < end; follower++) {
        let row = row_of(task, sizes, team, follower);
        var most = 0u;
        var owner = 0u;
        for (var leader = 0u; leader < sizes.leaders; leader++) {
            let steps = record[row + leader * task.teams];
            if steps > most {
                most = steps;
                owner = leader;
            }
            if row == groups {
                record[row + leader * task.teams] = 0u;
            }
        }
        if most > 0u {
            record[groups + owner * task.teams] |= 1u << (follower % 32u);
        }
    }
}

// Returns the agents of one word that are taken out or copied for a leader.
fn members(task: Task, sizes: Sizes, team: u32, kind: u32, leader: u32, word: u32) -> u32 {
    var bits = select(0u, 1u << (leader % 32u), kind != 0u && word == leader / 32u);
    if kind == GROUP && first_follower(sizes, word) < min(word * 32u + 32u, sizes.agents) {
        bits |= record[row_of(task, sizes, team, first_follower(sizes, word)) + leader * task.teams];
    }
    return bits;
}

// Returns the worth of the observed POIs if nobody is taken out, else the worth of those that are lost. For D++ it returns
// two numbers, see `stepping_stone`.
fn count(task: Task, sizes: Sizes, team: u32, kind: u32, leader: u32) -> u32 {
    let zeroth = members(task, sizes, team, kind, leader, 0u);
    let row = sizes.pois * sizes.words * task.teams;
    var most = 0u;
    var worth = 0u;
    var at_most = 0u;
    for (var copies = 0u; kind == COPIES && copies < MAX_COPIES; copies++) {
        completed[copies] = 0u;
    }
    for (var poi = 0u; poi < sizes.pois; poi++) {
        let about = task.scoring + 1u + poi * (2u + sizes.words);
        let coupling = scoring[about];
        most = max(most, coupling);
        var is_observed = false;
        var is_lost = kind != 0u;
        var largest = 0u;
        var first = task.sets + poi * sizes.words * task.teams + team;
        for (var step = 0u; step < sizes.steps; step++) {
            var size = 0u;
            var taken = 0u;
            for (var word = 0u; word < sizes.words; word++) {
                let observers = record[first + word * task.teams] & scoring[about + 2u + word];
                var own = zeroth;
                if word > 0u {
                    own = members(task, sizes, team, kind, leader, word);
                }
                size += countOneBits(observers);
                taken += countOneBits(observers & own);
            }
            if size >= coupling {
                is_observed = true;
                is_lost = is_lost && taken > size - coupling;
            } else if taken > 0u {
                largest = max(largest, size);
            }
            first += row;
        }
        let value = scoring[about + 1u];
        if is_observed {
            worth += select(0u, value, is_lost || kind == 0u);
        } else if kind == COPIES && largest > 0u {
            completed[coupling - largest] += value;
            at_most += value;
        }
    }
    if kind == COPIES {
        return stepping_stone(worth, most, at_most);
    }
    return worth;
}

// Returns a sum, and the number of copies by which the host divides it. src/credit/mod.rs has the plain twin. No product
// exceeds u32, because all POIs together are worth at most 2^24.
fn stepping_stone(lost: u32, most: u32, at_most: u32) -> u32 {
    if lost * most >= at_most {
        return lost | (1u << COPIES_SHIFT);
    }
    var now = completed[1];
    for (var copies = 1u; copies < most; copies++) {
        let next = now + completed[copies + 1u];
        if next * copies <= now * (copies + 1u) {
            return now | (copies << COPIES_SHIFT);
        }
        now = next;
    }
    return now | (most << COPIES_SHIFT);
}

// Counts one task per workgroup.
@compute @workgroup_size(WORKGROUP)
fn count_task(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let task = tasks[workgroup.x];
    let world = task.world;
    let leaders = worlds[world].leaders;
    let agents = leaders + worlds[world].followers;
    let sizes = Sizes(leaders, agents, worlds[world].pois, worlds[world].words, worlds[world].steps);
    // The kinds are in groups of two bits, each at least 1.
    var rows = 1u;
    var has_groups = false;
    for (var kinds = task.kinds; kinds > 0u; kinds >>= 2u) {
        rows += leaders;
        has_groups = has_groups || (kinds & 3u) == GROUP;
    }
    let bits = scoring[task.scoring];
    let sums = rows * task.teams;
    let end = (sums * bits + 31u) / 32u;
    for (var word = thread; word < end; word += WORKGROUP) {
        atomicStore(&counted[task.counted + word], 0u);
    }
    // Neighbouring threads read neighbouring teams.
    let first_word = leaders / 32u;
    let group_words = select(0u, (sizes.words - first_word) * task.teams, has_groups);
    for (var item = thread; item < group_words; item += WORKGROUP) {
        gather_groups(task, sizes, item % task.teams, first_word + item / task.teams);
    }
    storageBarrier();
    for (var item = thread; item < sums; item += WORKGROUP) {
        let row = item / task.teams;
        var kind = 0u;
        var leader = 0u;
        if row > 0u {
            kind = (task.kinds >> ((row - 1u) / leaders * 2u)) & 3u;
            leader = (row - 1u) % leaders;
        }
        let sum = count(task, sizes, item % task.teams, kind, leader);
        atomicOr(&counted[task.counted + item * bits / 32u], sum << (item * bits % 32u));
    }
    storageBarrier();
    if thread == 0u {
        atomicStore(&counted[task.counted + end], record[task.status]);
    }
}
