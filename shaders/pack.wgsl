// Packs what scores depend on of each team's record, so that little has to be copied to the host. The record stays
// unchanged.
//
// A set that another set of its POI contains changes no score (see src/credit/mod.rs). A POI's sets mostly grow as
// agents come near, then shrink. So one pass is enough that keeps the sets that neither the previous kept set nor the
// next set contains. A team's kept sets become the record of an episode with fewer steps.
//
// Uses: lib/layout.wgsl.
//
// The host prepends:
//   WORKGROUP  threads per workgroup
//   TEAMS      maximum teams per task
//   NOWHERE    sentinel: no offset

struct Packed {
    // Words used; more than `room` if they did not fit.
    used: atomic<u32>,
    room: u32,
    // Per task a table `[teams + 1]` of the offsets of its teams' sets, its status word and, if requested, the leaders
    // that followers saw most, `[words][teams]`. Then the sets, `[rows][pois][words]` per team.
    words: array<u32>,
}

// Replaces a binding of the episode. The minimum size of a kept set, per POI.
@group(0) @binding(3) var<storage, read> minimums: array<u32>;
@group(0) @binding(4) var<storage, read_write> packed: Packed;

// Rows per team, and the offsets of their sets, or NOWHERE if these do not fit.
var<workgroup> rows: array<atomic<u32>, TEAMS>;
var<workgroup> offsets: array<u32, TEAMS>;

// Returns how many sets of one POI of one team are kept. Unless `offset` is NOWHERE, writes them there, and empty sets
// up to `all` rows.
fn keep(task: Task, sizes: Sizes, team: u32, poi: u32, offset: u32, all: u32) -> u32 {
    let row = sizes.pois * sizes.words * task.teams;
    let first = task.sets + poi * sizes.words * task.teams + team;
    let enough = minimums[task.minimums + poi];
    var kept = 0u;
    // The offset of the set that is kept unless the next one contains it.
    var candidate = NOWHERE;
    for (var step = 0u; step < sizes.steps; step++) {
        var size = 0u;
        var more = 0u;
        var less = 0u;
        for (var word = 0u; word < sizes.words; word++) {
            let now = record[first + step * row + word * task.teams];
            var before = 0u;
            if candidate != NOWHERE {
                before = record[first + candidate + word * task.teams];
            }
            size += countOneBits(now);
            more |= now & ~before;
            less |= before & ~now;
        }
        if size >= enough && more != 0u {
            if less != 0u {
                if offset != NOWHERE {
                    copy(task, sizes, first + candidate, offset + (kept * sizes.pois + poi) * sizes.words);
                }
                kept += 1u;
            }
            candidate = step * row;
        }
    }
    if candidate != NOWHERE {
        if offset != NOWHERE {
            copy(task, sizes, first + candidate, offset + (kept * sizes.pois + poi) * sizes.words);
        }
        kept += 1u;
    }
    for (var empty = kept; offset != NOWHERE && empty < all; empty++) {
        for (var word = 0u; word < sizes.words; word++) {
            packed.words[offset + (empty * sizes.pois + poi) * sizes.words + word] = 0u;
        }
    }
    return kept;
}

fn copy(task: Task, sizes: Sizes, place: u32, offset: u32) {
    for (var word = 0u; word < sizes.words; word++) {
        packed.words[offset + word] = record[place + word * task.teams];
    }
}

// The sizes of a world that packing needs.
struct Sizes {
    leaders: u32,
    followers: u32,
    pois: u32,
    words: u32,
    steps: u32,
}

// Returns the leader that a follower saw most, or `nobody`. Ties go to the lower index.
fn owner(task: Task, sizes: Sizes, team: u32, follower: u32, nobody: u32) -> u32 {
    var most = 0u;
    var best = nobody;
    for (var leader = 0u; leader < sizes.leaders; leader++) {
        let steps = record[task.counts + (follower * sizes.leaders + leader) * task.teams + team];
        if steps > most {
            most = steps;
            best = leader;
        }
    }
    return best;
}

// Packs one task per workgroup.
@compute @workgroup_size(WORKGROUP)
fn pack(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    // Empty tasks have no teams.
    let task = tasks[workgroup.y * workgroups.x + workgroup.x];
    let world = task.world;
    let sizes = Sizes(
        worlds[world].leaders,
        worlds[world].followers,
        worlds[world].pois,
        worlds[world].words,
        worlds[world].steps,
    );
    for (var team = thread; team < task.teams; team += WORKGROUP) {
        atomicStore(&rows[team], 0u);
    }
    workgroupBarrier();
    // Neighbouring threads read neighbouring teams.
    let items = sizes.pois * task.teams;
    for (var item = thread; item < items; item += WORKGROUP) {
        let team = item % task.teams;
        atomicMax(&rows[team], keep(task, sizes, team, item / task.teams, NOWHERE, 0u));
    }
    workgroupBarrier();
    let row = sizes.pois * sizes.words;
    if thread == 0u && task.teams > 0u {
        var size = 0u;
        for (var team = 0u; team < task.teams; team++) {
            size += atomicLoad(&rows[team]) * row;
        }
        var offset = atomicAdd(&packed.used, size);
        let fits = offset + size <= packed.room;
        for (var team = 0u; team < task.teams; team++) {
            offsets[team] = select(NOWHERE, offset, fits);
            packed.words[task.table + team] = offset;
            offset += atomicLoad(&rows[team]) * row;
        }
        packed.words[task.table + task.teams] = offset;
    }
    workgroupBarrier();
    for (var item = thread; item < items; item += WORKGROUP) {
        let team = item % task.teams;
        keep(task, sizes, team, item / task.teams, offsets[team], atomicLoad(&rows[team]));
    }
    let nobody = select(0xffffu, 0xffu, sizes.leaders < 255u);
    let bits = select(16u, 8u, sizes.leaders < 255u);
    let owners_per_word = 32u / bits;
    let owner_words = (sizes.followers + owners_per_word - 1u) / owners_per_word;
    let owner_items = select(owner_words * task.teams, 0u, task.owners == NOWHERE);
    for (var item = thread; item < owner_items; item += WORKGROUP) {
        let team = item % task.teams;
        let first = item / task.teams * owners_per_word;
        let last = min(first + owners_per_word, sizes.followers);
        var word = 0u;
        for (var follower = first; follower < last; follower++) {
            word |= owner(task, sizes, team, follower, nobody) << ((follower - first) * bits);
        }
        packed.words[task.owners + item] = word;
    }
    storageBarrier();
    if thread == 0u && task.teams > 0u {
        packed.words[task.table + task.teams + 1u] = record[task.status];
    }
}
