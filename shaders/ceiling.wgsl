// The arithmetic ceiling: independent chains in registers, 6 of products and 6 of sums per thread. One iteration is
// OPERATIONS_PER_ITERATION lane operations (cli/src/measure/gpu_ceiling.rs).

// A factor, a term, and a value that the sum never equals.
@group(0) @binding(1) var<storage, read> numbers: array<f32>;
// The number of iterations.
@group(0) @binding(2) var<storage, read> iterations: array<u32>;
@group(0) @binding(3) var<storage, read_write> result: array<f32>;

@compute @workgroup_size(64)
fn ceiling(@builtin(local_invocation_index) thread: u32) {
    let factor = numbers[0];
    let term = numbers[1];
    let count = iterations[0];
    let first = 1.0 + f32(thread);
    var p = vec3<f32>(first, first + 1.0, first + 2.0);
    var q = vec3<f32>(first + 3.0, first + 4.0, first + 5.0);
    var s = vec3<f32>(first + 6.0, first + 7.0, first + 8.0);
    var t = vec3<f32>(first + 9.0, first + 10.0, first + 11.0);
    for (var iteration = 0u; iteration < count; iteration++) {
        p = p * factor;
        s = s + term;
        q = q * factor;
        t = t + term;
        p = p * factor;
        s = s + term;
        q = q * factor;
        t = t + term;
        p = p * factor;
        s = s + term;
        q = q * factor;
        t = t + term;
        p = p * factor;
        s = s + term;
        q = q * factor;
        t = t + term;
        p = p * factor;
        s = s + term;
        q = q * factor;
        t = t + term;
        p = p * factor;
        s = s + term;
        q = q * factor;
        t = t + term;
        p = p * factor;
        s = s + term;
        q = q * factor;
        t = t + term;
        p = p * factor;
        s = s + term;
        q = q * factor;
        t = t + term;
    }
    let all = p + q + s + t;
    // Without a use of the results the compiler would remove the chains.
    if (all.x + all.y + all.z == numbers[2]) {
        result[thread] = all.x;
    }
}
