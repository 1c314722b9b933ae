// The bindings of an episode. The host prepends the structs, and RecordWord: u32, or an atomic one in large teams.

@group(0) @binding(1) var<storage, read> worlds: array<Constants>;
@group(0) @binding(2) var<storage, read> tasks: array<Task>;
// Per group the start positions, POI positions, headings, and of each POI its squared radius and its value. Large
// teams have their grids of cells after that, see swarm.wgsl.
@group(0) @binding(3) var<storage, read> places: array<vec2<f32>>;
// Per task `[vectors of a policy's weights][leaders][teams]`, so that neighbouring threads load neighbouring weights.
@group(0) @binding(4) var<storage, read> weights: array<vec4<f32>>;
// Per task the sets `[steps][pois][words][teams]`, the counts `[followers][leaders][teams]`, sightings if they are recorded,
// `[steps][followers][words of leaders][teams]`, a word per POI and team if POIs may be gone, and a status word. Large teams
// have their cells after that.
@group(0) @binding(5) var<storage, read_write> record: array<RecordWord>;
// Per task the moments `[steps + 1][teams][agents]`, and the inputs of leaders `[steps + 1][teams][leaders][inputs]`;
// written only if TRACE.
@group(0) @binding(6) var<storage, read_write> traced: array<f32>;
// Per task `[teams][agents]`; used only by episodes of several dispatches, see `state_of` and swarm.wgsl.
@group(0) @binding(7) var<storage, read_write> states: array<State>;
// The classes of all worlds.
@group(0) @binding(8) var<storage, read> classes: array<Class>;
