//! The POI positions of one vector of teams: the world's, or one per lane.

use fearless_simd::{Simd, prelude::*};
use glam::Vec2;

use crate::kernels::splat;
use crate::world::World;

/// The position of a POI.
pub(crate) trait PoiPosition<S: Simd>: Copy {
    /// Returns x and y, one team per lane.
    fn lanes(self, simd: S) -> [S::f32s; 2];
}

/// The same position in all teams.
impl<S: Simd> PoiPosition<S> for Vec2 {
    #[inline(always)]
    fn lanes(self, simd: S) -> [S::f32s; 2] {
        [splat(simd, self.x), splat(simd, self.y)]
    }
}

/// One position per team.
impl<S: Simd> PoiPosition<S> for [S::f32s; 2] {
    #[inline(always)]
    fn lanes(self, _: S) -> [S::f32s; 2] {
        self
    }
}

/// Fills `moved`, `[pois]`, with the POI positions of each lane. `None` stands for the world's. Leaves `moved` empty if
/// every lane has the world's.
#[inline(always)]
pub(crate) fn load_pois<'a, S: Simd>(
    simd: S,
    world: &World,
    moved: &mut Vec<[S::f32s; 2]>,
    pois_of: impl Fn(usize) -> Option<&'a [Vec2]>,
) {
    moved.clear();
    if (0..S::f32s::LEN).all(|lane| pois_of(lane).is_none()) {
        return;
    }
    moved.resize(world.pois.len(), [splat(simd, 0.0); 2]);
    for lane in 0..S::f32s::LEN {
        for ([x, y], poi) in moved.iter_mut().zip(pois_of(lane).unwrap_or(&world.pois)) {
            (x[lane], y[lane]) = (poi.x, poi.y);
        }
    }
}

/// Evaluates an expression with the POI positions that [`load_pois`] left: those of each lane, or the world's. The
/// expression is compiled for both types of [`PoiPosition`].
macro_rules! with_pois {
    ($moved:expr, $world:expr, $pois:ident => $do:expr) => {
        if $moved.is_empty() {
            let $pois = &$world.pois[..];
            $do
        } else {
            let $pois = &$moved[..];
            $do
        }
    };
}
pub(crate) use with_pois;
