// What the host hands to an episode, and what it gets back. The host's side of each struct is named beside it.

// `Constants` in src/world.rs.
struct World {
    leaders: u32,
    followers: u32,
    pois: u32,
    steps: u32,
    words: u32,
    layers: u32,
    widths: array<u32, 5>,
    parameters: u32,
    map_x: f32,
    map_y: f32,
    dt: f32,
    heading_x: f32,
    heading_y: f32,
    speed: f32,
    min_speed: f32,
    max_speed: f32,
    max_speed_change: f32,
    max_turn: f32,
    max_turn_cos: f32,
    max_turn_sin: f32,
    observation_radius2: f32,
    attraction_radius2: f32,
    repulsion_radius2: f32,
    poi_range2: f32,
    agent_range2: f32,
    repulsion_radius: f32,
    attraction_scale: f32,
    repulsion_scale: f32,
    wall_gain: f32,
    poi_share: f32,
    agent_share: f32,
    density: u32,
    inverse_diagonal: f32,
}

// One workgroup's share of the work: some teams of one group. `Task` in src/backend/gpu/episode.rs.
struct Task {
    world: u32,
    // Where each of these starts in its buffer.
    starts: u32,
    pois: u32,
    weights: u32,
    sets: u32,
    seen: u32,
    moments: u32,
    states: u32,
    teams: u32,
    // The steps that this dispatch plays: from `first` on, before `end`.
    first: u32,
    end: u32,
    // Where packing finds and leaves what (`pack.wgsl`).
    least: u32,
    table: u32,
    owners: u32,
}

// An agent between two dispatches. `State` in src/backend/gpu/episode.rs.
struct State {
    x: f32,
    y: f32,
    hx: f32,
    hy: f32,
    speed: f32,
}

// `Moment` in src/backend/mod.rs.
struct Moment {
    inputs: array<f32, 8>,
    outputs: array<f32, 2>,
    force: array<f32, 2>,
    position: array<f32, 2>,
    heading: array<f32, 2>,
    speed: f32,
}

@group(0) @binding(1) var<storage, read> worlds: array<World>;
@group(0) @binding(2) var<storage, read> tasks: array<Task>;
// Start positions and POIs.
@group(0) @binding(3) var<storage, read> places: array<vec2<f32>>;
// Of each task `[fours of a policy's weights][leaders][teams]`: neighbouring threads read neighbouring weights.
@group(0) @binding(4) var<storage, read> weights: array<vec4<f32>>;
// Of each task the sets `[steps][pois][words][teams]` and the counts `[followers][leaders][teams]`.
@group(0) @binding(5) var<storage, read_write> record: array<u32>;
// Of each task `[steps + 1][teams][agents]`; written only where TRACE holds.
@group(0) @binding(6) var<storage, read_write> moments: array<Moment>;
// Of each task `[teams][agents]`; used only by episodes of several dispatches.
@group(0) @binding(7) var<storage, read_write> states: array<State>;
