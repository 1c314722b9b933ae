// Tests whether a device's arithmetic equals the CPU's. One invocation reads four values and writes one word per probe.
// Twin of `expected` in src/backend/gpu/self_test.rs: same names, same order.

const PROBES: u32 = 37u;

@group(0) @binding(1) var<storage, read> values: array<f32>;
@group(0) @binding(2) var<storage, read_write> words: array<u32>;

// Returns the bits of a float, with -0 as 0, because the sign of a zero differs between devices.
fn bits(x: f32) -> u32 {
    let word = bitcast<u32>(x);
    return select(word, 0u, word == 0x80000000u);
}

fn mixed(v: vec4<f32>) -> u32 {
    return bits(v.x) ^ (bits(v.y) * 3u) ^ (bits(v.z) * 5u) ^ (bits(v.w) * 7u);
}

fn product(a: f32, b: f32) -> f32 {
    return a * b;
}

// Returns 1/d for d > 0, from a guess in the bits.
fn reciprocal(d: f32) -> f32 {
    var r = bitcast<f32>(0x7ef311c3u - bitcast<u32>(d));
    for (var step = 0u; step < 3u; step++) {
        r = r * (2.0 - d * r);
    }
    return r;
}

// Returns 1/sqrt(d) for d > 0.
fn reciprocal_root(d: f32) -> f32 {
    var r = bitcast<f32>(0x5f3759dfu - (bitcast<u32>(d) >> 1u));
    for (var step = 0u; step < 3u; step++) {
        r = r * (1.5 - 0.5 * d * r * r);
    }
    return r;
}

@compute @workgroup_size(64)
fn probe(@builtin(global_invocation_id) id: vec3<u32>) {
    let item = id.x;
    let count = arrayLength(&values);
    if item * 4u >= count {
        return;
    }
    let x = values[item * 4u];
    let y = values[item * 4u + 1u];
    let z = values[item * 4u + 2u];
    let w = values[item * 4u + 3u];
    let out = item * PROBES;

    words[out] = bits(x * y + z);
    words[out + 1u] = bits(x * y - z);
    words[out + 2u] = bits(z - x * y);
    words[out + 3u] = bits(x * y + y * z);
    words[out + 4u] = bits(x * y - x * z);
    words[out + 5u] = bits(x * y - y * x);
    words[out + 6u] = bits((x + y) - x);
    words[out + 7u] = bits((x - y) + y);
    words[out + 8u] = bits(((x + y) + z) + w);
    words[out + 9u] = bits(x + (y + (z + w)));
    words[out + 10u] = bits(((x * y) * z) * w);
    words[out + 11u] = bits(x * (y * (z * w)));
    words[out + 12u] = bits(x + x + x);
    words[out + 13u] = bits((x * 0.1) * 10.0);
    words[out + 14u] = bits((x + 4096.0) - 4096.0);
    words[out + 15u] = bits(x * 2.7 + x * 0.3);
    words[out + 16u] = bits(x * x + y * y + z * z);
    words[out + 17u] = bits(-(x * y) + z);
    words[out + 18u] = bits(abs(x * y - z));
    words[out + 19u] = bits(product(x, y) + z);

    var kept = x * y;
    if w > 0.0 {
        kept = kept + z;
    } else {
        kept = kept - w;
    }
    words[out + 20u] = bits(kept);
    words[out + 21u] = bits(select(x * y, z * w, x < y) + z);

    let v = vec4(x, y, z, w);
    words[out + 22u] = mixed(v * v.yzwx + v.zwxy);
    words[out + 23u] = mixed(v * y - (v + v.wxyz));
    words[out + 24u] = bits(((x * 0.3 + 0.7) * x - 1.1) * x + 0.9);
    words[out + 25u] = bits(reciprocal(1.0 + abs(x)));
    words[out + 26u] = bits(reciprocal_root(1.0 + abs(y)));

    var sum = 0.0;
    var products = 0.0;
    for (var k = 0u; k < 16u; k++) {
        let value = values[(item * 4u + k) % count];
        sum = sum + value;
        products = products + value * y;
    }
    words[out + 27u] = bits(sum);
    words[out + 28u] = bits(products);

    words[out + 29u] = bits(floor(x * y));
    words[out + 30u] = bits(f32(bitcast<u32>(x) >> 8u));
    words[out + 31u] = bits(f32(bitcast<i32>(x) >> 7u));
    words[out + 32u] = u32(abs(x)) ^ bitcast<u32>(i32(y));
    words[out + 33u] = u32(x < y) | u32(x <= y) << 1u | u32(x == y) << 2u | u32(x >= y) << 3u | u32(x * y > z) << 4u;
    words[out + 34u] = bits(select(x, y, x <= y)) ^ bits(select(z, w, z >= w));
    words[out + 35u] = bits(bitcast<f32>(bitcast<u32>(z) & 0x7fffffffu) + bitcast<f32>(bitcast<u32>(w) & 0x7fff0000u));
    let size = abs(x);
    words[out + 36u] = u32(bitcast<i32>(size * 1.00001 + 4096.0) <= bitcast<i32>(size + 4096.0));
}
