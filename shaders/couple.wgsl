// Coupling: whether an agent is close enough to a POI to observe it (paper, Equations 3 and 4).
//
// Uses: lib/math.wgsl.

// Reports whether the POI at offset (`dx`, `dy`) is within its observation radius, given squared.
fn observes(radius2: f32, dx: f32, dy: f32) -> bool {
    return within(dx, dy, radius2);
}
