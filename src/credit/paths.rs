//! Scores from paths: for POIs that count by distance or by when, and for learners that lead learners.

use fearless_simd::{Simd, prelude::*};
use glam::Vec2;

use super::assignment::{first_most, lead};
use super::{Paths, each_bit, share, stepping_stone};
use crate::config::{Fitness, Score, When};
use crate::kernels::math::within;
use crate::kernels::{larger, select, smaller, splat};
use crate::model::couple::observes;
use crate::world::{PathRule, World};

/// Scratch memory for scores from paths. Moment m of an episode is its state after m steps. Vectors have neighbouring
/// moments, so rows have as many as fill whole vectors.
#[derive(Clone, Debug, Default)]
pub(super) struct PathCredit {
    /// The moments of a row.
    width: usize,
    /// `[2][agents][width]`.
    positions: Vec<f32>,
    /// The learners that influence each agent, and those that lead it, `[words of leaders][agents][width + 1]`: a vector may
    /// be written one moment later. Empty if those that are taken out are the same at all moments.
    sights: Vec<u32>,
    led: Vec<u32>,
    /// The number of moments at which each agent was influenced by each learner, `[agents][leaders]`.
    counts: Vec<u32>,
    /// The agents that are taken out for each learner at any moment, `[leaders][words]`.
    ever_taken: Vec<u32>,
    /// Agents that are ever near the POI and count there, and at each moment their squared distance, infinite unless it
    /// is near and the moment counts: `[observers]`, `[observers][width]`.
    observers: Vec<usize>,
    near: Vec<f32>,
    /// The squared distances of the nearest observers, `[coupling][lanes]`.
    nearest: Vec<f32>,
    /// The worth that each learner would lose, `[leaders]`, and gain by so many copies, `[leaders][copies]`.
    lost: Vec<u32>,
    gains: Vec<u32>,
}

/// A change of the team.
#[derive(Clone, Copy)]
enum Change {
    None,
    /// Without those that are taken out for a learner.
    Without(usize),
    /// With more copies of a learner.
    With(usize, u32),
}

impl PathCredit {
    /// Scores every learner of a team by `fitness` into `scores`, `[leaders]`, and returns what the POIs are worth that
    /// the team observed.
    pub(super) fn score<S: Simd>(
        &mut self,
        simd: S,
        paths: &Paths<'_>,
        world: &World,
        rule: &PathRule,
        fitness: Fitness,
        scores: &mut [f32],
    ) -> u32 {
        let (leaders, words) = (world.leaders(), world.constants.words as usize);
        self.load::<S>(paths, world);
        if fitness != Fitness::G {
            self.take_out(simd, world, rule, fitness);
        }
        let most = if fitness == Fitness::Dpp { world.coupling.iter().copied().max().unwrap_or(0) } else { 0 };
        let row = most as usize + 1;
        self.lost.clear();
        self.lost.resize(leaders, 0);
        self.gains.clear();
        self.gains.resize(leaders * row, 0);
        let mut observed = 0;
        for (poi, &at) in paths.pois.iter().enumerate() {
            simd.vectorize(
                #[inline(always)]
                || self.find_observers(simd, world, rule, poi, at),
            );
            if self.observers.is_empty() {
                continue;
            }
            let value = self.value(simd, world, rule, poi, Change::None);
            observed += value;
            if fitness == Fitness::G {
                continue;
            }
            for leader in 0..leaders {
                let ever = &self.ever_taken[leader * words..][..words];
                let is_taken = |&agent: &usize| ever[agent / 32] >> (agent % 32) & 1 != 0;
                if value > 0 && self.observers.iter().any(is_taken) {
                    self.lost[leader] += value - self.value(simd, world, rule, poi, Change::Without(leader));
                }
                if self.observers.contains(&leader) {
                    for copies in 1..=most {
                        let gain = self.value(simd, world, rule, poi, Change::With(leader, copies)) - value;
                        self.gains[leader * row + copies as usize] += gain;
                    }
                }
            }
        }
        let total = world.total_worth;
        for (leader, score) in scores.iter_mut().enumerate().take(leaders) {
            let (lost, gains) = (self.lost[leader], &self.gains[leader * row..][..row]);
            *score = match fitness {
                Fitness::G => share(observed, total.into()),
                Fitness::D | Fitness::Df | Fitness::Dt => share(lost, total.into()),
                Fitness::Dpp => {
                    stepping_stone(lost, most, gains[most as usize], total, |copies| gains[copies as usize])
                }
            };
        }
        observed
    }

    /// Copies positions, so that the moments of an agent follow each other.
    fn load<S: Simd>(&mut self, paths: &Paths<'_>, world: &World) {
        let (agents, moments) = (world.agents(), world.steps() + 1);
        let width = moments.next_multiple_of(S::f32s::LEN);
        self.width = width;
        self.positions.resize(2 * agents * width, 0.0);
        let (x, y) = self.positions.split_at_mut(agents * width);
        let mut from = paths.positions.iter();
        for (moment, agent) in (0..moments).flat_map(|moment| (0..agents).map(move |agent| (moment, agent))) {
            for axis in [&mut *x, &mut *y] {
                axis[agent * width + moment] = f32::from_bits(from.next().expect("a path has every moment"));
            }
        }
    }

    /// Returns some neighbouring moments of an agent: its x and y.
    #[inline(always)]
    fn at<S: Simd>(&self, simd: S, agents: usize, agent: usize, first: usize) -> [S::f32s; 2] {
        let row = |axis: usize| &self.positions[(axis * agents + agent) * self.width + first..][..S::f32s::LEN];
        [S::f32s::from_slice(simd, row(0)), S::f32s::from_slice(simd, row(1))]
    }

    /// Finds whom each learner takes out, and when.
    fn take_out<S: Simd>(&mut self, simd: S, world: &World, rule: &PathRule, fitness: Fitness) {
        let (leaders, agents, words) = (world.leaders(), world.agents(), world.constants.words as usize);
        self.ever_taken.clear();
        self.ever_taken.resize(leaders * words, 0);
        match fitness {
            Fitness::D if !rule.removes.is_empty() => self.ever_taken.copy_from_slice(&rule.removes),
            _ => (0..leaders).for_each(|leader| self.ever_taken[leader * words + leader / 32] |= 1 << (leader % 32)),
        }
        self.sights.clear();
        self.led.clear();
        if !matches!(fitness, Fitness::Df | Fitness::Dt) {
            return;
        }
        if fitness == Fitness::Dt {
            let places = world.leader_words() * agents * (self.width + 1);
            self.sights.resize(places, 0);
            self.led.resize(places, 0);
        }
        simd.vectorize(
            #[inline(always)]
            || self.find_influences(simd, world, rule),
        );
        if fitness == Fitness::Dt {
            return self.find_leading(world);
        }
        for (agent, counts) in self.counts.chunks_exact(leaders).enumerate() {
            if let Some(leader) = first_most(counts.iter().copied()) {
                self.ever_taken[leader * words + agent / 32] |= 1 << (agent % 32);
            }
        }
    }

    /// Finds which learners lead each agent at each moment.
    fn find_leading(&mut self, world: &World) {
        let (leaders, agents, words) = (world.leaders(), world.agents(), world.constants.words as usize);
        let (row, moments) = (self.width + 1, world.steps() + 1);
        let place = |moment: usize, agent: usize, word: usize| (word * agents + agent) * row + moment;
        let sights = &self.sights;
        lead(|place| sights[place], &mut self.led, [moments, agents, leaders], world.led, place);
        for (place, led) in self.led.chunks_exact(row).enumerate() {
            let (word, agent) = (place / agents, place % agents);
            for bit in each_bit(led[..moments].iter().fold(0, |ever, led| ever | led)) {
                self.ever_taken[(word * 32 + bit) * words + agent / 32] |= 1 << (agent % 32);
            }
        }
    }

    /// Finds which learners influence each agent at each moment, and how often.
    ///
    /// If the start counts, influence and observation are of the same moment. Otherwise agents influence others before they
    /// move, as the leaders that followers see.
    #[inline(always)]
    fn find_influences<S: Simd>(&mut self, simd: S, world: &World, rule: &PathRule) {
        let (leaders, agents, row) = (world.leaders(), world.agents(), self.width + 1);
        let later = usize::from(!rule.start_counts);
        let counted = world.steps() + 1 - later;
        self.counts.clear();
        self.counts.resize(agents * leaders, 0);
        for (class, led) in world.classes.iter().enumerate() {
            for leading in &world.classes {
                let influence2 = leading.constants.influence2[class];
                let learners = leading.agents().take_while(|&agent| agent < leaders && influence2 >= 0.0);
                for (leader, agent) in learners.flat_map(|leader| led.agents().map(move |agent| (leader, agent))) {
                    if leader == agent {
                        continue;
                    }
                    for first in (0..counted).step_by(S::f32s::LEN) {
                        let ([x, y], [led_x, led_y]) =
                            (self.at(simd, agents, leader, first), self.at(simd, agents, agent, first));
                        let sees = within::<S>(x - led_x, y - led_y, splat(simd, influence2));
                        let all = (counted - first).min(S::f32s::LEN);
                        let counts = sees.to_bitmask() & (u64::MAX >> (64 - all));
                        self.counts[agent * leaders + leader] += counts.count_ones();
                        let place = (leader / 32 * agents + agent) * row + first + later;
                        if let Some(sights) = self.sights.get_mut(place..place + S::f32s::LEN) {
                            let bit = S::u32s::splat(simd, 1 << (leader % 32));
                            let seen = sees.to_vector().bitcast::<S::u32s>() & bit;
                            (S::u32s::from_slice(simd, sights) | seen).store_slice(sights);
                        }
                    }
                }
            }
        }
    }

    /// Finds the observers that are ever near a POI, and when.
    #[inline(always)]
    fn find_observers<S: Simd>(&mut self, simd: S, world: &World, rule: &PathRule, poi: usize, at: Vec2) {
        let (agents, width) = (world.agents(), self.width);
        // A window of all steps includes the start, if that counts. POIs without one have it if others have windows.
        let window = world.rule.window(poi).filter(|&window| window != [1, world.constants.steps]);
        let [first, last] = window.map_or([0, world.steps()], |window| window.map(|step| step as usize));
        let first = first.max(usize::from(!rule.start_counts));
        self.observers.clear();
        self.near.clear();
        let radius2 = splat(simd, world.radii2[poi]);
        for agent in (0..agents).filter(|&agent| world.rule.counts_at(poi, agent)) {
            let start = self.near.len();
            self.near.resize(start + width, f32::INFINITY);
            let mut ever = false;
            for chunk in (0..width).step_by(S::f32s::LEN) {
                let [x, y] = self.at(simd, agents, agent, chunk);
                let (dx, dy) = (x - at.x, y - at.y);
                let is_near = observes::<S>(radius2, dx, dy);
                if is_near.any_true() {
                    let near = select::<S>(splat(simd, f32::INFINITY), dx * dx + dy * dy, is_near);
                    near.store_slice(&mut self.near[start + chunk..][..S::f32s::LEN]);
                    ever = true;
                }
            }
            if ever {
                let near = &mut self.near[start..];
                near[..first].fill(f32::INFINITY);
                near[last + 1..].fill(f32::INFINITY);
                self.observers.push(agent);
            } else {
                self.near.truncate(start);
            }
        }
    }

    /// Returns what a POI counts for, in units of its worth.
    fn value<S: Simd>(&mut self, simd: S, world: &World, rule: &PathRule, poi: usize, change: Change) -> u32 {
        simd.vectorize(
            #[inline(always)]
            || self.value_of(simd, world, rule, poi, change),
        )
    }

    #[inline(always)]
    fn value_of<S: Simd>(&mut self, simd: S, world: &World, rule: &PathRule, poi: usize, change: Change) -> u32 {
        let ((score, when), coupling) = (rule.scores[poi], world.coupling[poi] as usize);
        let value = |squared: f32| match squared.is_finite() {
            true => (f64::from(world.worth[poi]) / f64::from(squared).sqrt()).round() as u32,
            false => 0,
        };
        let (mut best, mut sum, steps) = (splat(simd, f32::INFINITY), 0_u64, world.steps());
        // The last vector has the last moment.
        let from = if when == When::End { self.width - S::f32s::LEN } else { 0 };
        for first in (from..self.width).step_by(S::f32s::LEN) {
            let squared = match (score, coupling) {
                (Score::Observed, _) => self.observed::<S>(simd, world, coupling as u32, first, change),
                (Score::Closeness, 1) => self.closest::<S>(simd, world, first, change),
                (Score::Closeness, _) => self.close::<S>(simd, world, coupling, first, change),
            };
            match when {
                When::Ever => best = smaller::<S>(squared, best),
                When::End => best = splat(simd, squared.as_slice()[steps - first]),
                When::Mean => sum += squared.as_slice().iter().map(|&squared| u64::from(value(squared))).sum::<u64>(),
            }
        }
        if when == When::Mean {
            let moments = steps as u64 + u64::from(rule.start_counts);
            return ((sum + moments / 2) / moments) as u32;
        }
        value(best.as_slice().iter().copied().fold(f32::INFINITY, f32::min))
    }

    /// Returns the squared distance of an observer, infinite if it is not near or taken out, and how often it counts.
    #[inline(always)]
    fn near<S: Simd>(&self, simd: S, world: &World, index: usize, first: usize, change: Change) -> (S::f32s, u32) {
        let agent = self.observers[index];
        let near = S::f32s::from_slice(simd, &self.near[index * self.width + first..][..S::f32s::LEN]);
        match change {
            Change::Without(leader) => {
                let of_leader = &self.ever_taken[leader * world.constants.words as usize..];
                if of_leader[agent / 32] >> (agent % 32) & 1 == 0 {
                    return (near, 1);
                }
                if self.led.is_empty() || agent == leader {
                    return (splat(simd, f32::INFINITY), 1);
                }
                let place = (leader / 32 * world.agents() + agent) * (self.width + 1) + first;
                let led = S::u32s::from_slice(simd, &self.led[place..][..S::f32s::LEN]);
                let stays = (led & S::u32s::splat(simd, 1 << (leader % 32))).simd_eq(0);
                (select::<S>(splat(simd, f32::INFINITY), near, stays), 1)
            }
            Change::With(leader, copies) if leader == agent => (near, 1 + copies),
            Change::With(..) | Change::None => (near, 1),
        }
    }

    /// Returns 1 at moments with enough observers, else infinity.
    #[inline(always)]
    fn observed<S: Simd>(&self, simd: S, world: &World, coupling: u32, first: usize, change: Change) -> S::f32s {
        let (infinity, mut count) = (splat(simd, f32::INFINITY), S::u32s::splat(simd, 0));
        for index in 0..self.observers.len() {
            let (near, times) = self.near(simd, world, index, first, change);
            count += near.simd_lt(infinity).to_vector().bitcast::<S::u32s>() & S::u32s::splat(simd, times);
        }
        select::<S>(infinity, splat(simd, 1.0), count.simd_ge(coupling))
    }

    /// Returns the square of max(d, 1) for the distance d of the nearest observer.
    #[inline(always)]
    fn closest<S: Simd>(&self, simd: S, world: &World, first: usize, change: Change) -> S::f32s {
        let mut closest = splat(simd, f32::INFINITY);
        for index in 0..self.observers.len() {
            closest = smaller::<S>(self.near(simd, world, index, first, change).0, closest);
        }
        larger::<S>(closest, splat(simd, 1.0))
    }

    /// Returns the product of the squares of max(d, 1) over the distances d of so many nearest observers.
    #[inline(always)]
    fn close<S: Simd>(&mut self, simd: S, world: &World, coupling: usize, first: usize, change: Change) -> S::f32s {
        let mut nearest = std::mem::take(&mut self.nearest);
        nearest.clear();
        nearest.resize(coupling * S::f32s::LEN, f32::INFINITY);
        for index in 0..self.observers.len() {
            let (near, times) = self.near(simd, world, index, first, change);
            for _ in 0..times {
                let mut farther = near;
                for row in nearest.chunks_exact_mut(S::f32s::LEN) {
                    let kept = S::f32s::from_slice(simd, row);
                    smaller::<S>(farther, kept).store_slice(row);
                    farther = larger::<S>(farther, kept);
                }
            }
        }
        let mut product = splat(simd, 1.0);
        for row in nearest.chunks_exact(S::f32s::LEN) {
            product *= larger::<S>(S::f32s::from_slice(simd, row), splat(simd, 1.0));
        }
        self.nearest = nearest;
        product
    }
}
