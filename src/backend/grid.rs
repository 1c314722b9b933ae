//! The grid of cells of a class, in which large teams find the agents near a place.

use crate::config::MAX_LEARNERS;
use crate::model;
use crate::model::class::Class;
use crate::model::follow::TermConstants;
use crate::world::World;

/// Limits the memory of cells on long and narrow maps.
const MOST_CELLS_PER_SIDE: f32 = 8192.0;

/// Smaller teams are faster in vectors of teams, where all pairs are visited: on a CPU with 256 agents 15 times, with 512 eight
/// times, if a third of them learns.
pub(crate) const LARGE_FROM: usize = MAX_LEARNERS + 1;

/// Reports whether teams of a world play one at a time, in cells: those of at least so many agents, with everything but
/// pursuit, senses of each agent, and motion near others only.
pub(crate) fn is_large(world: &World, from: usize) -> bool {
    world.agents() >= from
        && world.classes.iter().all(|class| {
            let shape = &class.constants.shape;
            !shape.pursues() && shape.end_near == 0 && class.channels().iter().all(|channel| channel.shape.each == 0)
        })
}

/// The sizes of a grid.
#[derive(Clone, Copy)]
pub(super) struct Grid {
    pub columns: usize,
    pub rows: usize,
    /// Cells per unit.
    pub inverse: f32,
    /// The distance by which rounding could move a place.
    pub margin: f32,
}

impl Grid {
    /// Returns the grid of a class: cells as large as the radius within which most agents look for it, and about one cell
    /// per agent at most.
    pub fn new(world: &World, class: &Class) -> Grid {
        let (map, longest) = (world.map(), world.map().max_element());
        let agents = class.agents().len().max(1);
        let smallest = (map.x * map.y / agents as f32).sqrt().max(longest / MOST_CELLS_PER_SIDE);
        let side = radius(world, class).clamp(smallest, longest);
        let count = |length: f32| (length / side) as usize + 1;
        Grid { columns: count(map.x), rows: count(map.y), inverse: 1.0 / side, margin: longest / (1 << 20) as f32 }
    }

    /// Returns the number of cells.
    pub fn cells(&self) -> usize {
        self.columns * self.rows
    }

    /// Returns the column of an x coordinate.
    #[inline(always)]
    pub fn column(&self, x: f32) -> usize {
        ((x * self.inverse) as usize).min(self.columns - 1)
    }

    /// Returns the row of a y coordinate.
    #[inline(always)]
    pub fn row(&self, y: f32) -> usize {
        ((y * self.inverse) as usize).min(self.rows - 1)
    }
}

/// Returns the radius within which most agents look for those of a class.
fn radius(world: &World, class: &Class) -> f32 {
    let counts = |term: &&TermConstants| model::each(&term.shape.ranges).any(|run| run.contains(&class.agents().start));
    let of_terms = world.classes.iter().flat_map(Class::terms).filter(counts).map(|term| term.outer2);
    let of_pois = || world.radii2.iter().copied().fold(0.0, f32::max);
    of_terms.reduce(f32::max).unwrap_or_else(of_pois).sqrt()
}
