//! How many f32 sums and products a second the processor does at most, all threads together, none of them fused.
//!
//! The probe keeps independent chains of products and of sums in registers: enough of either to fill every unit's
//! latency, few enough for the registers of the instruction set. It runs on the threads and at the instruction set that
//! episodes are played with, so that its rate is what an episode could reach that never waited for anything.

use std::hint::black_box;
use std::time::Duration;

use fearless_simd::{Level, Simd, dispatch, prelude::*};

use crate::host::Instant;

/// Chains of products, and as many of sums: with factor and term they fill 16 registers. Two units of either kind with
/// a latency of 3 need 6; where there are 32 registers, there may be 4 units.
const CHAINS: usize = if cfg!(target_arch = "aarch64") { 14 } else { 7 };
/// Links of every chain between two looks at the clock.
const LINKS: usize = 20_000;
/// Time that one measurement takes.
const LEAST: Duration = Duration::from_millis(20);

/// Lane operations a second, all threads of the current rayon pool together.
pub fn measure(level: Level) -> f64 {
    rayon::broadcast(|_| dispatch!(level, simd => thread(simd))).into_iter().sum()
}

/// Lane operations a second of one thread.
fn thread<S: Simd>(simd: S) -> f64 {
    let (start, mut links) = (Instant::now(), 0);
    while links == 0 || start.elapsed() < LEAST {
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
            // Numbers that the compiler cannot know, and that stay of ordinary size.
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
