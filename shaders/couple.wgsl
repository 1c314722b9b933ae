// Coupling: whether an agent is close enough to a POI to observe it (paper, Equations 3 and 4).
//
// Uses: lib/math.wgsl, episode.wgsl (world).

// Reports whether the POI at offset (`dx`, `dy`) is within its observation radius.
fn observes(dx: f32, dy: f32) -> bool {
    return within(dx, dy, world.observation_radius2);
}
