//! Scores from paths: for POIs that count by distance or by when, and for learners that lead learners.

use fearless_simd::{Simd, prelude::*};

use super::assignment::{first_most, lead};
use super::{Paths, Strided, each_bit, fill_with_zeros, share, stepping_stone};
use crate::config::{Fitness, Score, When};
use crate::kernels::math::within;
use crate::kernels::{larger, select, smaller, splat};
use crate::model::couple::observes;
use crate::world::{PathRule, World};

/// Scores from paths, with scratch memory for the next. Moment m of an episode is its state after m steps. A vector has
/// neighbouring moments of one team, or one moment of as many teams as it has lanes. Rows are `[moments][teams]`, filled up
/// to whole vectors.
#[derive(Clone, Debug, Default)]
pub(crate) struct PathCredit {
    /// The length of a row.
    width: usize,
    /// A copy of one team's positions, f32 as bits, `[2][agents][width]`; not used for several teams.
    positions: Vec<u32>,
    /// `[pois][2][lanes]`.
    pois: Vec<f32>,
    /// The learners that influence each agent under Dt, `[words of leaders][agents][width + teams]`, because a vector may be
    /// written one moment later.
    sights: Vec<u32>,
    /// The learners that lead each agent. Under Dt it has the shape of `sights`. Under Df nothing depends on the moment:
    /// `[words of leaders][agents][lanes]`. Empty if [`PathCredit::ever_taken`] is enough, as for one team.
    led: Vec<u32>,
    /// The number of moments at which one agent was influenced by each learner, `[leaders][teams]`.
    counts: Vec<u32>,
    /// The agents that are taken out for each learner at any moment in any team, `[leaders][words]`.
    ever_taken: Vec<u32>,
    /// Agents that are ever near the POI and count there, `[observers]`.
    observers: Vec<usize>,
    /// Their squared distance at each moment, infinite unless it is near and the moment counts, and then the vector of its
    /// smallest distances if [`Scored::is_closest_ever`], `[observers][width + lanes]`. It has room for all agents.
    near: Vec<f32>,
    /// The beginning of each vector in which an observer is near. Empty if [`Scored::is_closest_ever`].
    vectors: Vec<usize>,
    /// The observers of the team whose worth is computed.
    counted: Vec<Counted>,
    /// The squared distances of the nearest observers, `[coupling][lanes]`.
    nearest: Vec<f32>,
    /// Sums over moments, `[teams]`.
    sums: Vec<u64>,
    /// The worth of the POI to each team, `[teams]`, and to the team after a [`Change`].
    whole: Vec<Worth>,
    changed: Vec<Worth>,
    /// The summed worth of all POIs to each team, `[teams]`.
    observed: Vec<u32>,
    /// The summed worth that is lost without each learner, `[leaders][teams]`.
    lost: Vec<u32>,
    /// The summed worth that this number of copies of a learner adds, `[leaders][copies][teams]`.
    gains: Vec<u32>,
    /// `[teams][leaders]`.
    scores: Vec<f32>,
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

/// An observer that counts, at least at some moments.
#[derive(Clone, Copy, Debug)]
struct Counted {
    /// The beginning of its row in [`PathCredit::near`].
    near: usize,
    /// How often it counts.
    times: u32,
    /// The beginning and the stride of its row in [`PathCredit::led`], if bits there determine when it is taken out.
    led: Option<[usize; 2]>,
}

/// The worth of a POI to one team.
#[derive(Clone, Copy, Debug)]
struct Worth {
    /// The square of the distance that determines it, at least 1; NaN for a mean.
    squared: f32,
    /// The worth, see [`WorldParts::worth`](crate::world::WorldParts::worth).
    value: u32,
}

/// The teams of a vector, and the rules by which they are scored.
struct Scored<'a> {
    positions: Positions<'a>,
    /// One, or as many as there are lanes.
    teams: usize,
    world: &'a World,
    rule: &'a PathRule,
    fitness: Fitness,
}

impl Scored<'_> {
    /// Reports whether the worth of a POI depends only on the smallest distance of any observer at any moment.
    fn is_closest_ever(&self, poi: usize) -> bool {
        self.rule.scores[poi] == (Score::Closeness, When::Ever) && self.world.coupling[poi] == 1
    }
}

/// Positions of every agent and moment, f32 as bits. The strides are those of a row's elements, of agents and of axes.
struct Positions<'a> {
    words: &'a [u32],
    stride: usize,
    agent_stride: usize,
    axis_stride: usize,
}

impl Positions<'_> {
    /// Returns a vector of an agent's row: its x and y.
    #[inline(always)]
    fn at<S: Simd>(&self, simd: S, agent: usize, first: usize) -> [S::f32s; 2] {
        let x = &self.words[first * self.stride + agent * self.agent_stride..];
        let [x, y] = [&x[..S::f32s::LEN], &x[self.axis_stride..][..S::f32s::LEN]];
        [S::u32s::from_slice(simd, x).bitcast(), S::u32s::from_slice(simd, y).bitcast()]
    }
}

/// Returns a vector of squared distances, infinite where a leader's bit is set.
#[inline(always)]
fn unless_led<S: Simd>(simd: S, near: &[f32], led: &[u32], bit: u32) -> S::f32s {
    let stays = (S::u32s::from_slice(simd, led) & S::u32s::splat(simd, bit)).simd_eq(0);
    select::<S>(splat(simd, f32::INFINITY), S::f32s::from_slice(simd, near), stays)
}

impl PathCredit {
    /// Scores every learner of one team by `fitness` into `scores`, `[leaders]`, and returns what the POIs are worth that
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
        self.pois.clear();
        for axis in paths.pois.iter().flat_map(|at| at.to_array()) {
            self.pois.extend(std::iter::repeat_n(axis, S::f32s::LEN));
        }
        let (agents, moments) = (world.agents(), world.steps() + 1);
        let width = moments.next_multiple_of(S::f32s::LEN);
        let mut words = std::mem::take(&mut self.positions);
        words.resize(2 * agents * width, 0);
        let (x, y) = words.split_at_mut(agents * width);
        let mut from = paths.positions.iter();
        for (moment, agent) in (0..moments).flat_map(|moment| (0..agents).map(move |agent| (moment, agent))) {
            for axis in [&mut *x, &mut *y] {
                axis[agent * width + moment] = from.next().expect("a path has every moment");
            }
        }
        let positions = Positions { words: &words, stride: 1, agent_stride: width, axis_stride: agents * width };
        self.score_vector(simd, &Scored { positions, teams: 1, world, rule, fitness });
        self.positions = words;
        scores.iter_mut().zip(&self.scores).for_each(|(to, score)| *to = *score);
        self.observed[0]
    }

    /// Scores every learner of a vector of teams. `positions` are at the start and after each step in units, f32 as bits,
    /// `[steps + 1][agents][2][lanes]`, and `pois` are those of the POIs.
    pub(crate) fn score_teams<S: Simd>(
        &mut self,
        simd: S,
        positions: &[u32],
        pois: &[[S::f32s; 2]],
        world: &World,
        rule: &PathRule,
        fitness: Fitness,
    ) {
        self.pois.clear();
        pois.as_flattened().iter().for_each(|axis| self.pois.extend_from_slice(axis.as_slice()));
        let (teams, agents) = (S::f32s::LEN, world.agents());
        let (stride, agent_stride) = (2 * agents, 2 * teams);
        let positions = Positions { words: positions, stride, agent_stride, axis_stride: teams };
        self.score_vector(simd, &Scored { positions, teams, world, rule, fitness });
    }

    /// Returns what the POIs are worth that one of the teams observed.
    pub(crate) fn observed(&self, team: usize) -> u32 {
        self.observed[team]
    }

    /// Returns the scores of one team's leaders.
    pub(crate) fn scores(&self, team: usize) -> impl Iterator<Item = f32> {
        let leaders = self.scores.len() / self.observed.len();
        self.scores[team * leaders..][..leaders].iter().copied()
    }

    fn score_vector<S: Simd>(&mut self, simd: S, scored: &Scored<'_>) {
        let &Scored { teams, world, fitness, .. } = scored;
        let (leaders, words) = (world.leaders(), world.constants.words as usize);
        self.width = ((world.steps() + 1) * teams).next_multiple_of(S::f32s::LEN);
        if fitness != Fitness::G {
            self.take_out(simd, scored);
        }
        let most = if fitness == Fitness::Dpp { world.coupling.iter().copied().max().unwrap_or(0) } else { 0 };
        let row = most as usize + 1;
        fill_with_zeros(&mut self.observed, teams);
        fill_with_zeros(&mut self.lost, leaders * teams);
        fill_with_zeros(&mut self.gains, leaders * row * teams);
        for poi in 0..world.pois.len() {
            simd.vectorize(
                #[inline(always)]
                || self.find_observers(simd, scored, poi),
            );
            if self.observers.is_empty() {
                continue;
            }
            self.whole.clear();
            self.find_worth(simd, scored, poi, Change::None);
            std::mem::swap(&mut self.whole, &mut self.changed);
            self.observed.iter_mut().zip(&self.whole).for_each(|(observed, whole)| *observed += whole.value);
            if fitness == Fitness::G {
                continue;
            }
            let is_worth = self.whole.iter().any(|whole| whole.value > 0);
            for leader in 0..leaders {
                let ever = &self.ever_taken[leader * words..][..words];
                let is_taken = |&agent: &usize| ever[agent / 32] >> (agent % 32) & 1 != 0;
                if is_worth && self.observers.iter().any(is_taken) {
                    self.find_worth(simd, scored, poi, Change::Without(leader));
                    add_differences(&mut self.lost[leader * teams..], &self.whole, &self.changed);
                }
                if self.observers.contains(&leader) {
                    for copies in 1..=most {
                        self.find_worth(simd, scored, poi, Change::With(leader, copies));
                        let gains = &mut self.gains[(leader * row + copies as usize) * teams..];
                        add_differences(gains, &self.changed, &self.whole);
                    }
                }
            }
        }
        let total = world.total_worth;
        self.scores.clear();
        for (team, leader) in (0..teams).flat_map(|team| (0..leaders).map(move |leader| (team, leader))) {
            let (lost, gains) = (self.lost[leader * teams + team], &self.gains[leader * row * teams + team..]);
            self.scores.push(match fitness {
                Fitness::G => share(self.observed[team], total.into()),
                Fitness::D | Fitness::Df | Fitness::Dt => share(lost, total.into()),
                Fitness::Dpp => {
                    let gain = |copies: u32| gains[copies as usize * teams];
                    stepping_stone(lost, most, gain(most), total, gain)
                }
            });
        }
    }

    /// Finds whom each learner takes out, and when.
    fn take_out<S: Simd>(&mut self, simd: S, scored: &Scored<'_>) {
        let &Scored { teams, world, rule, fitness, .. } = scored;
        let (leaders, agents, words) = (world.leaders(), world.agents(), world.constants.words as usize);
        fill_with_zeros(&mut self.ever_taken, leaders * words);
        match fitness {
            Fitness::D if !rule.removes.is_empty() => self.ever_taken.copy_from_slice(&rule.removes),
            _ => (0..leaders).for_each(|leader| self.ever_taken[leader * words + leader / 32] |= 1 << (leader % 32)),
        }
        let rows = world.leader_words() * agents;
        let places = if fitness == Fitness::Dt { rows * (self.width + teams) } else { 0 };
        fill_with_zeros(&mut self.sights, places);
        fill_with_zeros(&mut self.led, if fitness == Fitness::Df && teams > 1 { rows * S::f32s::LEN } else { places });
        if matches!(fitness, Fitness::Df | Fitness::Dt) {
            simd.vectorize(
                #[inline(always)]
                || self.find_influences(simd, scored),
            );
        }
        if fitness == Fitness::Dt {
            self.find_leading(scored);
        }
    }

    /// Finds which learners lead each agent at each moment.
    fn find_leading(&mut self, scored: &Scored<'_>) {
        let &Scored { teams, world, .. } = scored;
        let (leaders, agents, words) = (world.leaders(), world.agents(), world.constants.words as usize);
        let (row, moments) = (self.width + teams, world.steps() + 1);
        let place = |moment: usize, agent: usize, word: usize| {
            (word * agents + agent / teams) * row + moment * teams + agent % teams
        };
        lead(&Strided::contiguous(&self.sights), &mut self.led, [moments, agents * teams, leaders], world.led, place);
        for (place, led) in self.led.chunks_exact(row).enumerate() {
            let (word, agent) = (place / agents, place % agents);
            for bit in each_bit(led[..moments * teams].iter().fold(0, |ever, led| ever | led)) {
                self.ever_taken[(word * 32 + bit) * words + agent / 32] |= 1 << (agent % 32);
            }
        }
    }

    /// Finds which learners influence each agent at each moment, or under Df which influences it most often.
    ///
    /// If the start counts, influence and observation are of the same moment. Otherwise agents influence others before they
    /// move, as the leaders that followers see.
    #[inline(always)]
    fn find_influences<S: Simd>(&mut self, simd: S, scored: &Scored<'_>) {
        let &Scored { ref positions, teams, world, rule, fitness } = scored;
        let (leaders, agents) = (world.leaders(), world.agents());
        let (row, later) = (self.width + teams, if rule.start_counts { 0 } else { teams });
        let end = (world.steps() + 1) * teams - later;
        let agents_led = |class: usize| world.classes[class].agents().map(move |agent| (class, agent));
        for (class, agent) in (0..world.classes.len()).flat_map(agents_led) {
            fill_with_zeros(&mut self.counts, leaders * teams);
            for leading in &world.classes {
                let influence2 = leading.constants.influence2[class];
                let learners = leading.agents().take_while(|&learner| learner < leaders && influence2 >= 0.0);
                for leader in learners.filter(|&leader| leader != agent) {
                    let mut counts = S::u32s::splat(simd, 0);
                    for first in (0..end).step_by(S::f32s::LEN) {
                        let ([x, y], [led_x, led_y]) =
                            (positions.at(simd, leader, first), positions.at(simd, agent, first));
                        let sees = within::<S>(x - led_x, y - led_y, splat(simd, influence2));
                        let mut sees = sees.to_vector().bitcast::<S::u32s>();
                        if end - first < S::f32s::LEN {
                            sees &= S::u32s::from_fn(simd, |lane| if first + lane < end { u32::MAX } else { 0 });
                        }
                        counts -= sees;
                        let place = (leader / 32 * agents + agent) * row + first + later;
                        if let Some(sights) = self.sights.get_mut(place..place + S::f32s::LEN) {
                            let bit = S::u32s::splat(simd, 1 << (leader % 32));
                            (S::u32s::from_slice(simd, sights) | sees & bit).store_slice(sights);
                        }
                    }
                    for (lane, count) in counts.as_slice().iter().enumerate() {
                        self.counts[leader * teams + lane % teams] += count;
                    }
                }
            }
            if fitness == Fitness::Df {
                self.find_owners(scored, agent, S::f32s::LEN);
            }
        }
    }

    /// Finds the learner that influences an agent most often, in each team.
    fn find_owners(&mut self, scored: &Scored<'_>, agent: usize, lanes: usize) {
        let &Scored { teams, world, .. } = scored;
        for team in 0..teams {
            let counts = self.counts[team..].iter().step_by(teams);
            if let Some(leader) = first_most(counts.copied()) {
                let words = world.constants.words as usize;
                self.ever_taken[leader * words + agent / 32] |= 1 << (agent % 32);
                if let Some(led) = self.led.get_mut((leader / 32 * world.agents() + agent) * lanes + team) {
                    *led |= 1 << (leader % 32);
                }
            }
        }
    }

    /// Finds the observers that are ever near a POI, and when.
    #[inline(always)]
    fn find_observers<S: Simd>(&mut self, simd: S, scored: &Scored<'_>, poi: usize) {
        let &Scored { ref positions, teams, world, rule, .. } = scored;
        let (agents, width, row) = (world.agents(), self.width, self.width + S::f32s::LEN);
        // A window of all steps includes the start, if that counts. POIs without one have it if others have windows.
        let window = world.rule.window(poi).filter(|&window| window != [1, world.constants.steps]);
        let [first, last] = window.map_or([0, world.steps()], |window| window.map(|step| step as usize));
        let first = first.max(usize::from(!rule.start_counts));
        self.observers.clear();
        // Not cleared, because all that is read is written first.
        self.near.resize(agents * row, 0.0);
        let (poi_x, poi_y) = self.pois[poi * 2 * S::f32s::LEN..][..2 * S::f32s::LEN].split_at(S::f32s::LEN);
        let (poi_x, poi_y) = (S::f32s::from_slice(simd, poi_x), S::f32s::from_slice(simd, poi_y));
        let (radius2, infinity) = (splat(simd, world.radii2[poi]), splat(simd, f32::INFINITY));
        let is_closest_ever = scored.is_closest_ever(poi);
        for agent in (0..agents).filter(|&agent| world.rule.counts_at(poi, agent)) {
            let (near, smallest) = self.near[self.observers.len() * row..][..row].split_at_mut(width);
            let mut ever = S::u32s::splat(simd, 0);
            for (vector, near) in near.chunks_exact_mut(S::f32s::LEN).enumerate() {
                let [x, y] = positions.at(simd, agent, vector * S::f32s::LEN);
                let (dx, dy) = (x - poi_x, y - poi_y);
                let is_near = observes::<S>(radius2, dx, dy);
                select::<S>(infinity, dx * dx + dy * dy, is_near).store_slice(near);
                ever |= is_near.to_vector().bitcast::<S::u32s>();
            }
            if ever.simd_gt(0).any_true() {
                near[..first * teams].fill(f32::INFINITY);
                near[(last + 1) * teams..].fill(f32::INFINITY);
                if is_closest_ever {
                    let mut closest = infinity;
                    for near in near.chunks_exact(S::f32s::LEN) {
                        closest = smaller::<S>(S::f32s::from_slice(simd, near), closest);
                    }
                    closest.store_slice(smallest);
                }
                self.observers.push(agent);
            }
        }
        self.vectors.clear();
        if is_closest_ever {
            return;
        }
        for first in (0..width).step_by(S::f32s::LEN) {
            let mut is_anyone_near = false;
            for near in self.near.chunks_exact(row).take(self.observers.len()) {
                let near = S::f32s::from_slice(simd, &near[first..][..S::f32s::LEN]);
                is_anyone_near |= near.simd_lt(infinity).any_true();
            }
            if is_anyone_near {
                self.vectors.push(first);
            }
        }
    }

    /// Finds the worth of a POI to each team after a change.
    fn find_worth<S: Simd>(&mut self, simd: S, scored: &Scored<'_>, poi: usize, change: Change) {
        let (world, agents) = (scored.world, scored.world.agents());
        self.counted.clear();
        for (index, &agent) in self.observers.iter().enumerate() {
            let mut counted = Counted { near: index * (self.width + S::f32s::LEN), times: 1, led: None };
            match change {
                Change::Without(leader) => {
                    let of_leader = &self.ever_taken[leader * world.constants.words as usize..];
                    if of_leader[agent / 32] >> (agent % 32) & 1 != 0 {
                        if self.led.is_empty() || agent == leader {
                            continue;
                        }
                        let row = self.led.len() / (world.leader_words() * agents);
                        let stride = usize::from(row > S::f32s::LEN);
                        counted.led = Some([(leader / 32 * agents + agent) * row, stride]);
                    }
                }
                Change::With(leader, copies) if leader == agent => counted.times += copies,
                Change::With(..) | Change::None => {}
            }
            self.counted.push(counted);
        }
        simd.vectorize(
            #[inline(always)]
            || self.find_worth_of_counted(simd, scored, poi, change),
        );
    }

    /// Finds the worth of a POI that is observed by those who count.
    #[inline(always)]
    fn find_worth_of_counted<S: Simd>(&mut self, simd: S, scored: &Scored<'_>, poi: usize, change: Change) {
        let &Scored { teams, world, rule, .. } = scored;
        let ((score, when), coupling) = (rule.scores[poi], world.coupling[poi] as usize);
        let value = |squared: f32| match squared.is_finite() {
            true => (f64::from(world.worth[poi]) / f64::from(squared).sqrt()).round() as u32,
            false => 0,
        };
        let end = world.steps() * teams;
        let bit = match change {
            Change::Without(leader) => 1 << (leader % 32),
            _ => 0,
        };
        let mut best = match scored.is_closest_ever(poi) {
            true => self.closest_ever(simd, bit),
            false => splat(simd, f32::INFINITY),
        };
        fill_with_zeros(&mut self.sums, teams);
        for index in 0..self.vectors.len() {
            let first = self.vectors[index];
            // The last vector has the last moment.
            if when == When::End && first + S::f32s::LEN < self.width {
                continue;
            }
            let squared = match (score, coupling) {
                (Score::Observed, _) => self.observed_at::<S>(simd, coupling as u32, first, bit),
                (Score::Closeness, _) => self.close::<S>(simd, coupling, first, bit),
            };
            match when {
                When::Ever => best = smaller::<S>(squared, best),
                When::End => best = S::f32s::from_fn(simd, |lane| squared[end - first + lane % teams]),
                When::Mean => {
                    for (lane, &squared) in squared.as_slice().iter().enumerate() {
                        self.sums[lane % teams] += u64::from(value(squared));
                    }
                }
            }
        }
        self.changed.clear();
        for (team, &sum) in self.sums.iter().enumerate() {
            if when == When::Mean {
                let moments = world.steps() as u64 + u64::from(rule.start_counts);
                self.changed.push(Worth { squared: f32::NAN, value: ((sum + moments / 2) / moments) as u32 });
                continue;
            }
            let squared = best.as_slice()[team..].iter().step_by(teams).copied().fold(f32::INFINITY, f32::min);
            let same = self.whole.get(team).filter(|whole| whole.squared == squared);
            self.changed.push(same.copied().unwrap_or_else(|| Worth { squared, value: value(squared) }));
        }
    }

    /// Returns the squared distance of an observer, infinite if it is not near or taken out. `bit` is that of the learner for
    /// whom it is taken out.
    #[inline(always)]
    fn near<S: Simd>(&self, simd: S, counted: &Counted, first: usize, bit: u32) -> S::f32s {
        let near = &self.near[counted.near + first..][..S::f32s::LEN];
        match counted.led {
            None => S::f32s::from_slice(simd, near),
            Some([row, stride]) => unless_led(simd, near, &self.led[row + first * stride..][..S::f32s::LEN], bit),
        }
    }

    /// Returns 1 at moments with enough observers, else infinity.
    #[inline(always)]
    fn observed_at<S: Simd>(&self, simd: S, coupling: u32, first: usize, bit: u32) -> S::f32s {
        let (infinity, mut count) = (splat(simd, f32::INFINITY), S::u32s::splat(simd, 0));
        for counted in &self.counted {
            let is_near = self.near(simd, counted, first, bit).simd_lt(infinity);
            count += is_near.to_vector().bitcast::<S::u32s>() & S::u32s::splat(simd, counted.times);
        }
        select::<S>(infinity, splat(simd, 1.0), count.simd_ge(coupling))
    }

    /// Returns the square of max(d, 1) for the smallest distance d of any observer at any moment.
    #[inline(always)]
    fn closest_ever<S: Simd>(&self, simd: S, bit: u32) -> S::f32s {
        let mut closest = splat(simd, f32::INFINITY);
        for counted in &self.counted {
            // Its smallest distance is known, unless it depends on the moment whether it is taken out.
            let Some([row, 1]) = counted.led else {
                closest = smaller::<S>(self.near(simd, counted, self.width, bit), closest);
                continue;
            };
            let near = self.near[counted.near..][..self.width].chunks_exact(S::f32s::LEN);
            for (near, led) in near.zip(self.led[row..].chunks_exact(S::f32s::LEN)) {
                closest = smaller::<S>(unless_led(simd, near, led, bit), closest);
            }
        }
        larger::<S>(closest, splat(simd, 1.0))
    }

    /// Returns the product of the squares of max(d, 1) over the distances d of so many nearest observers.
    #[inline(always)]
    fn close<S: Simd>(&mut self, simd: S, coupling: usize, first: usize, bit: u32) -> S::f32s {
        let mut nearest = std::mem::take(&mut self.nearest);
        nearest.clear();
        nearest.resize(coupling * S::f32s::LEN, f32::INFINITY);
        for counted in &self.counted {
            for _ in 0..counted.times {
                let mut farther = self.near(simd, counted, first, bit);
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

/// Adds the difference of two worths of each team.
fn add_differences(to: &mut [u32], more: &[Worth], less: &[Worth]) {
    to.iter_mut().zip(more.iter().zip(less)).for_each(|(to, (more, less))| *to += more.value - less.value);
}
