// What the host hands to an episode, and what it gets back. The host declares the structs, and puts them in front.

@group(0) @binding(1) var<storage, read> worlds: array<Constants>;
@group(0) @binding(2) var<storage, read> tasks: array<Task>;
// Start positions and POIs.
@group(0) @binding(3) var<storage, read> places: array<vec2<f32>>;
// Of each task `[fours of a policy's weights][leaders][teams]`: neighbouring threads read neighbouring weights.
@group(0) @binding(4) var<storage, read> weights: array<vec4<f32>>;
// Of each task the sets `[steps][pois][words][teams]`, the counts `[followers][leaders][teams]` and, where SIGHTED
// holds, the sights `[steps][followers][words of leaders][teams]`.
@group(0) @binding(5) var<storage, read_write> record: array<u32>;
// Of each task `[steps + 1][teams][agents]`; written only where TRACE holds.
@group(0) @binding(6) var<storage, read_write> moments: array<Moment>;
// Of each task `[teams][agents]`; used only by episodes of several dispatches.
@group(0) @binding(7) var<storage, read_write> states: array<State>;
