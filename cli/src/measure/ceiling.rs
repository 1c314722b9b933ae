//! The arithmetic ceiling of the CPU: how many f32 sums and products per second all threads compute at most, none of
//! them fused.
//!
//! The measurement keeps independent chains of products and of sums in registers: enough to hide every unit's latency,
//! and few enough for the registers of the instruction set. It uses the threads and the instruction set of episodes, so
//! its rate is what an episode could reach without ever waiting.

use std::hint::black_box;
use std::time::Duration;

use fearless_simd::{Level, Simd, dispatch, prelude::*};

use flotilla::host::Instant;

/// Chains of products, and as many of sums. With factor and term they fill 16 registers. Two units of either kind with
/// a latency of 3 need 6. With 32 registers there may be 4 units.
const CHAINS: usize = if cfg!(target_arch = "aarch64") { 14 } else { 7 };
/// Links of every chain between two readings of the clock.
const LINKS: usize = 20_000;
/// Minimum time of a measurement.
const MIN_TIME: Duration = Duration::from_millis(20);

/// Returns lane operations per second, of all threads of the current rayon pool.
pub(crate) fn measure(level: Level) -> f64 {
    rayon::broadcast(|_| dispatch!(level, simd => thread(simd))).into_iter().sum()
}

/// Returns lane operations per second of one thread.
fn thread<S: Simd>(simd: S) -> f64 {
    let (start, mut links) = (Instant::now(), 0);
    while links == 0 || start.elapsed() < MIN_TIME {
        chains(simd);
        links += LINKS;
    }
    (links * 2 * CHAINS * S::f32s::LEN) as f64 / start.elapsed().as_secs_f64()
}

#[inline(never)]
fn chains<S: Simd>(simd: S) {
    simd.vectorize(
        #[inline(always)]
        || {
            // The compiler must not know these numbers. They keep all values of ordinary size.
            let lanes = |value: f32| S::f32s::splat(simd, black_box(value));
            let (factor, term) = (lanes(1.000_000_1), lanes(0.25));
            let mut products: [S::f32s; CHAINS] = std::array::from_fn(|i| lanes(1.0 + i as f32));
            let mut sums: [S::f32s; CHAINS] = std::array::from_fn(|i| lanes(2.0 + i as f32));
            for _ in 0..LINKS {
                for (product, sum) in products.iter_mut().zip(&mut sums) {
                    *product *= factor;
                    *sum += term;
                }
            }
            black_box((products, sums));
        },
    );
}
