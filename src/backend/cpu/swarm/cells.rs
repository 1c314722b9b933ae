//! The agents of one class in a grid of cells, so that those near a place are found without a look at all others.

use std::ops::Range;

use fearless_simd::{Simd, prelude::*};
use glam::Vec2;

use crate::backend::cpu::agent::Agent;
use crate::backend::grid::Grid;
use crate::model::class::Class;
use crate::world::World;

/// The states of the agents of a class, in any order, one slot each. Every array has spare slots at its end, so that a
/// vector can be loaded from each slot.
#[derive(Clone, Default)]
pub(super) struct Slots {
    /// The agents, by their index in the team.
    pub agents: Vec<u32>,
    pub x: Vec<f32>,
    pub y: Vec<f32>,
    pub hx: Vec<f32>,
    pub hy: Vec<f32>,
    pub speed: Vec<f32>,
}

impl Slots {
    fn new(agents: Range<usize>, spare: usize) -> Slots {
        let none = vec![0.0; agents.len() + spare];
        let mut agents: Vec<u32> = agents.map(|agent| agent as u32).collect();
        agents.resize(none.len(), 0);
        Slots { agents, x: none.clone(), y: none.clone(), hx: none.clone(), hy: none.clone(), speed: none }
    }

    /// Writes the states of a vector of agents from a slot on.
    #[inline(always)]
    pub fn store<S: Simd>(&mut self, slot: usize, agent: Agent<S>) {
        let to = slot..slot + S::f32s::LEN;
        agent.x.store_slice(&mut self.x[to.clone()]);
        agent.y.store_slice(&mut self.y[to.clone()]);
        agent.hx.store_slice(&mut self.hx[to.clone()]);
        agent.hy.store_slice(&mut self.hy[to.clone()]);
        agent.speed.store_slice(&mut self.speed[to]);
    }

    /// Copies one slot of others to a slot.
    #[inline(always)]
    pub fn put(&mut self, slot: usize, others: &Slots, from: usize) {
        self.agents[slot] = others.agents[from];
        self.x[slot] = others.x[from];
        self.y[slot] = others.y[from];
        self.hx[slot] = others.hx[from];
        self.hy[slot] = others.hy[from];
        self.speed[slot] = others.speed[from];
    }
}

/// The agents of a class, sorted by cell, row by row. So the agents of neighbouring cells of a row are in one run of
/// slots.
pub(super) struct Cells {
    /// The agents' states, sorted.
    pub slots: Slots,
    /// The states after a step, in the order before it.
    pub next: Slots,
    /// The class's agents, by their index in the team.
    pub agents: Range<usize>,
    grid: Grid,
    /// The first slot of each cell, and the number of agents, `[cells + 1]`; one more while sorting.
    starts: Vec<u32>,
    /// The cell of each slot while sorting.
    cells: Vec<u32>,
}

/// Columns that a group may extend beyond its first.
const MOST_COLUMNS: usize = 16;

impl Cells {
    /// Returns memory for the agents of a class, with some spare slots.
    pub fn new(world: &World, class: &Class, spare: usize) -> Cells {
        let (agents, grid) = (class.agents(), Grid::new(world, class));
        let slots = Slots::new(agents.clone(), spare);
        Cells {
            next: slots.clone(),
            cells: vec![0; slots.x.len()],
            starts: vec![0; grid.cells() + 2],
            slots,
            agents,
            grid,
        }
    }

    /// Returns the number of agents.
    #[inline(always)]
    pub fn len(&self) -> usize {
        self.agents.len()
    }

    /// Returns the states of a vector of agents from a slot on.
    #[inline(always)]
    pub fn load<S: Simd>(&self, simd: S, slot: usize) -> Agent<S> {
        let (slots, from) = (&self.slots, slot..slot + S::f32s::LEN);
        Agent {
            x: S::f32s::from_slice(simd, &slots.x[from.clone()]),
            y: S::f32s::from_slice(simd, &slots.y[from.clone()]),
            hx: S::f32s::from_slice(simd, &slots.hx[from.clone()]),
            hy: S::f32s::from_slice(simd, &slots.hy[from.clone()]),
            speed: S::f32s::from_slice(simd, &slots.speed[from]),
        }
    }

    /// Puts the agents into their places, with their headings, both `[agents]` of the team. `speed` returns the speed of an
    /// agent from its index.
    pub fn place(&mut self, starts: &[Vec2], headings: &[Vec2], speed: impl Fn(usize) -> f32) {
        let own = self.agents.clone();
        for (slot, (agent, (start, heading))) in
            own.clone().zip(starts[own.clone()].iter().zip(&headings[own])).enumerate()
        {
            let next = &mut self.next;
            next.agents[slot] = agent as u32;
            (next.x[slot], next.y[slot]) = (start.x, start.y);
            (next.hx[slot], next.hy[slot]) = (heading.x, heading.y);
            next.speed[slot] = speed(agent);
        }
        self.sort();
    }

    /// Sorts the states after a step into the cells.
    pub fn sort(&mut self) {
        let count = self.len();
        self.starts.fill(0);
        for slot in 0..count {
            let cell = self.grid.row(self.next.y[slot]) * self.grid.columns + self.grid.column(self.next.x[slot]);
            self.cells[slot] = cell as u32;
            self.starts[cell + 2] += 1;
        }
        let mut before = 0;
        for start in &mut self.starts {
            before += *start;
            *start = before;
        }
        for (from, &cell) in self.cells[..count].iter().enumerate() {
            // Ends as the first slot of the next cell.
            let slot = &mut self.starts[cell as usize + 1];
            self.slots.put(*slot as usize, &self.next, from);
            *slot += 1;
        }
    }

    /// Calls `visit` with every run of slots that may be within a radius of a rectangle, given by its corners.
    #[inline(always)]
    pub fn each_run(&self, [low, high]: [Vec2; 2], radius: f32, mut visit: impl FnMut(Range<usize>)) {
        let (grid, reach) = (&self.grid, radius * 1.001 + self.grid.margin);
        let (first, last) = (grid.column(low.x - reach), grid.column(high.x + reach));
        for row in grid.row(low.y - reach)..=grid.row(high.y + reach) {
            let cell = row * grid.columns;
            let slots = self.starts[cell + first] as usize..self.starts[cell + last + 1] as usize;
            if !slots.is_empty() {
                visit(slots);
            }
        }
    }

    /// Calls `visit` with groups of at most `most` slots that are near each other: of one row, and a few columns.
    #[inline(always)]
    pub fn each_group(&self, most: usize, mut visit: impl FnMut(Range<usize>)) {
        let grid = &self.grid;
        for row in 0..grid.rows {
            let cell = row * grid.columns;
            let (mut slot, end) = (self.starts[cell] as usize, self.starts[cell + grid.columns] as usize);
            while slot < end {
                let first = grid.column(self.slots.x[slot]);
                let mut count = most.min(end - slot);
                while count > 1 && grid.column(self.slots.x[slot + count - 1]) > first + MOST_COLUMNS {
                    count /= 2;
                }
                visit(slot..slot + count);
                slot += count;
            }
        }
    }

    /// Returns the corners of the rectangle around some agents.
    #[inline(always)]
    pub fn corners(&self, slots: Range<usize>) -> [Vec2; 2] {
        let (mut low, mut high) = (Vec2::INFINITY, Vec2::NEG_INFINITY);
        for slot in slots {
            let at = Vec2::new(self.slots.x[slot], self.slots.y[slot]);
            (low, high) = (low.min(at), high.max(at));
        }
        [low, high]
    }
}
