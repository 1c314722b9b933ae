// Populations that stay on the device. `breed` makes a population's next generation from the host's plan; `gather` lays
// out the weights of a batch's teams for the episode. One buffer holds one population, `[slots][parameters]`.
//
// Uses: lib/math.wgsl.
//
// The host prepends, from src/evolve and src/backend/gpu/source.rs:
//   WORKGROUP               threads per workgroup, a multiple of TILE
//   TILE                    rows and columns of a tile of `gather`
//   BreedJob, GatherJob     what to do
//   MIN_WEIGHT, MAX_WEIGHT  the range of sizes of a weight other than 0
//   UNCHANGED               the bit of a planned slot that does not mutate

@group(0) @binding(1) var<storage, read> breed_job: BreedJob;
// The slot that each slot is copied from, with UNCHANGED set if it does not mutate.
@group(0) @binding(2) var<storage, read> plan: array<u32>;
@group(0) @binding(3) var<storage, read> policies: array<f32>;
@group(0) @binding(4) var<storage, read_write> children: array<f32>;
// Per population the number of workgroups that finished, over all generations.
@group(0) @binding(5) var<storage, read_write> finished: array<atomic<u32>>;

@group(0) @binding(1) var<storage, read> job: GatherJob;
// The policy of each leader in each team, `[teams][leaders]`.
@group(0) @binding(2) var<storage, read> choices: array<u32>;
// Per task `[vectors of a policy's weights][leaders][teams]`.
@group(0) @binding(4) var<storage, read_write> weights: array<vec4<f32>>;
// The populations of the leaders after the first.
@group(0) @binding(5) var<storage, read> policies_1: array<f32>;
@group(0) @binding(6) var<storage, read> policies_2: array<f32>;
@group(0) @binding(7) var<storage, read> policies_3: array<f32>;

// Returns four random words for a counter, see `Key::draw`.
fn words(key: vec4<u32>, counter: u32) -> vec4<u32> {
    return pcg4d(vec4(key.xyz, key.w ^ counter));
}

// Clamps a weight to MAX_WEIGHT, and flushes it to 0 below MIN_WEIGHT.
fn within_limits(weight: f32) -> f32 {
    return flush(clamp_to(weight, -MAX_WEIGHT, MAX_WEIGHT), MIN_WEIGHT);
}

// Returns a mutated weight. `index` is its index in the policy, `noises` the policy's noise key.
fn mutated(noises: vec4<u32>, index: u32, weight: f32) -> f32 {
    let words = words(noises, index);
    let plain = normal(words.x, words.y) * breed_job.sigma;
    let noise = select(plain, plain * weight, breed_job.scaled != 0u);
    return within_limits(weight + noise);
}

// One thread per slot and draw, which decides on four weights. The word of counter 16·block + place decides on weight
// 64·block + 16·word + place. Neighbouring threads have neighbouring weights.
@compute @workgroup_size(WORKGROUP)
fn breed(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let counters = (breed_job.parameters + 63u) / 64u * 16u;
    let item = (workgroup.y * workgroups.x + workgroup.x) * WORKGROUP + thread;
    let slot = item / counters;
    let counter = item % counters;
    if slot < breed_job.slots {
        fill(slot, counter);
    }
    storageBarrier();
    if thread == 0u {
        atomicAdd(&finished[breed_job.population], 1u);
    }
}

// Copies four weights of a slot's parent, and mutates them.
fn fill(slot: u32, counter: u32) {
    let planned = plan[breed_job.parents + slot];
    let parent = (planned & ~UNCHANGED) * breed_job.parameters;
    let child = slot * breed_job.parameters;
    let first = counter / 16u * 64u + counter % 16u;
    for (var word = 0u; word < 4u && first + 16u * word < breed_job.parameters; word++) {
        let index = first + 16u * word;
        children[child + index] = policies[parent + index];
    }
    if (planned & UNCHANGED) != 0u {
        return;
    }
    let key = pcg4d(vec4(breed_job.key[0], breed_job.key[1], breed_job.key[2] ^ slot, breed_job.key[3]));
    let below = words(key, counter) < vec4(breed_job.threshold);
    let bits = select(vec4(0u), vec4(1u, 2u, 4u, 8u), below);
    // Each thread iterates over its own mutations only: a warp takes as many iterations as its busiest thread.
    var left = select(bits.x | bits.y | bits.z | bits.w, 15u, breed_job.all != 0u);
    let noises = words(key, 0xffffffffu);
    while left != 0u {
        let index = first + 16u * firstTrailingBit(left);
        if index < breed_job.parameters {
            children[child + index] = mutated(noises, index, policies[parent + index]);
        }
        left &= left - 1u;
    }
}

// Weights of some teams' leaders, `[leaders][teams][parameters]`. Rows have one word of padding, so that a column uses
// all banks.
var<workgroup> tile: array<f32, TILE * (TILE + 1u)>;

// Returns a weight of one of the gathered leaders.
fn weight_of(leader: u32, index: u32) -> f32 {
    switch leader {
        case 0u: { return policies[index]; }
        case 1u: { return policies_1[index]; }
        case 2u: { return policies_2[index]; }
        default: { return policies_3[index]; }
    }
}

// Transposes one tile of weights per workgroup: reads along policies, writes along teams, four weights at a time.
@compute @workgroup_size(WORKGROUP)
fn gather(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let across = (job.parameters + TILE - 1u) / TILE;
    let index = workgroup.y * workgroups.x + workgroup.x;
    let first_policy = index / across * TILE;
    let played = job.count * job.teams;
    let first_parameter = index % across * TILE;
    let column = thread % TILE;
    for (var row = thread / TILE; row < TILE; row += WORKGROUP / TILE) {
        let policy = first_policy + row;
        let parameter = first_parameter + column;
        // The last four weights of a policy may be fewer.
        var weight = 0.0;
        if policy < played && parameter < job.parameters {
            let leader = policy / job.teams;
            let choice = policy % job.teams * job.leaders + job.first + leader;
            weight = weight_of(leader, choices[job.choices + choice] * job.parameters + parameter);
        }
        tile[row * (TILE + 1u) + column] = weight;
    }
    workgroupBarrier();
    let policy = first_policy + column;
    let team = policy % job.teams;
    let leader = job.first + policy / job.teams;
    let before = team / job.teams_per_task * job.teams_per_task;
    let teams = min(job.teams_per_task, job.teams - before);
    let vectors = (job.parameters + 3u) / 4u;
    let task = job.weights + before * job.leaders * vectors;
    for (var row = thread / TILE; row < TILE / 4u && policy < played; row += WORKGROUP / TILE) {
        let vector = first_parameter / 4u + row;
        if vector < vectors {
            let start = column * (TILE + 1u) + 4u * row;
            let some = vec4(tile[start], tile[start + 1u], tile[start + 2u], tile[start + 3u]);
            weights[task + (vector * job.leaders + leader) * teams + team - before] = some;
        }
    }
}
