// Sensing: what agents and POIs add to the inputs of a policy, by channel and sector (paper, Section 3.1).
//
// Uses: lib/math.wgsl, and from src/model: ChannelShape, MEASURE_…, COMBINE_…, FRAME_….

// The numbers of a channel that kernels are not specialised for.
struct Gauge {
    range2: f32,
    base: f32,
    slope: f32,
    nearest2: f32,
    scale: f32,
    empty: f32,
}

// What an entity counts in lattice distances, 0 out of range, and whether it is in range.
struct Measured {
    measure: i32,
    within: bool,
}

// Returns what an entity of this value at offset (`dx`, `dy`) counts.
fn measured(channel: ChannelShape, gauge: Gauge, value: f32, dx: f32, dy: f32) -> Measured {
    let base = gauge.base;
    let d2 = dx * dx + dy * dy;
    var measure = 0;
    if channel.measure == MEASURE_LINEAR || channel.measure == MEASURE_CLOSENESS {
        measure = less_base(value + base - exact_sqrt(d2) * (gauge.slope * value), base);
    } else if channel.measure == MEASURE_DISTANCE {
        measure = on_lattice(exact_sqrt(d2) * (gauge.slope * value), base);
    } else if channel.measure == MEASURE_EXPONENTIAL {
        measure = on_lattice(exp_negative(exact_sqrt(d2)) * value, base);
    } else {
        let inverse = rsqrt(select(gauge.nearest2, d2, d2 > gauge.nearest2));
        if channel.measure == MEASURE_INVERSE {
            measure = on_lattice(inverse * value, base);
        } else {
            measure = on_lattice(inverse * inverse * value, base);
        }
    }
    let within = within(dx, dy, gauge.range2);
    return Measured(select(0, measure, within), within);
}

// Returns an offset relative to a heading: along it, and to its left.
fn turned(dx: f32, dy: f32, hx: f32, hy: f32) -> vec2<f32> {
    return vec2(dx * hx + dy * hy, dy * hx - dx * hy);
}

// A channel of four sectors, which are the quadrants around a heading: sums over all, over those on the left, in front,
// and both. It needs fewer operations than any number of sectors, and gives the same bits.
struct Quadrants {
    // Of measures, in lattice distances.
    sums: vec4<i32>,
    // Of numbers of entities.
    counts: vec4<i32>,
}

// Adds an entity with this measure at offset (`dx`, `dy`) from an agent with heading (`hx`, `hy`).
//
// The signs of the offset along the heading and to its left determine the quadrant. A tie goes to the counterclockwise
// quadrant, so that each boundary belongs to exactly one.
fn add_to_quadrant(
    channel: ChannelShape,
    measured: Measured,
    dx: f32,
    dy: f32,
    hx: f32,
    hy: f32,
    quadrants: ptr<function, Quadrants>,
) {
    let f = turned(dx, dy, hx, hy);
    let left = f.y > 0.0 || (f.y >= 0.0 && f.x >= 0.0);
    let front = f.x > 0.0 || (f.x >= 0.0 && !(f.y > 0.0));
    let halves = vec4(true, left, front, left && front);
    (*quadrants).sums += select(vec4(0), vec4(measured.measure), halves);
    if channel.counts != 0u {
        (*quadrants).counts += select(vec4(0), vec4(select(0, 1, measured.within)), halves);
    }
}

// Returns the sum of each quadrant: back right, front right, front left, back left.
fn quadrant_sums(halves: vec4<i32>) -> vec4<i32> {
    let all = halves.x;
    let left = halves.y;
    let front = halves.z;
    let both = halves.w;
    return vec4(all - left - front + both, front - both, both, left - both);
}

// Whether a direction is less than half a turn after the beginning of a sector.
fn is_after(boundary: vec2<f32>, f: vec2<f32>) -> bool {
    let across = boundary.x * f.y - boundary.y * f.x;
    return across > 0.0 || (across >= 0.0 && boundary.x * f.x + boundary.y * f.y >= 0.0);
}

// Returns the input of a sector from the sum, or the largest, of its measures, and the number of its entities.
fn input_of(channel: ChannelShape, gauge: Gauge, sum: i32, count: i32) -> f32 {
    var value = nearest_f32(sum);
    if channel.combine == COMBINE_MEAN {
        value = value * recip(nearest_f32(max(count, 1)));
    }
    value = value * gauge.scale;
    if channel.counts != 0u && count <= 0 {
        return gauge.empty;
    }
    return value;
}
