//! Large teams behind a [`Stepper`](super::Stepper). Each steps by itself.

use fearless_simd::Simd;
use glam::Vec2;

use super::Recording;
use super::engine::{Command, Observations, Slices, Vectors};
use super::state::Saved;
use crate::backend::cpu::{Recorded, StepArrays, Swarm};
use crate::credit::Episode;
use crate::parallel::*;
use crate::world::{OUTPUTS, World};

/// Large teams of one world.
struct LargeTeams<S: Simd> {
    teams: Vec<Swarm<S>>,
    recording: Recording,
}

/// Returns teams without a state. A reset gives them one.
pub(super) fn large_teams<S: Simd>(simd: S, world: &World, teams: usize, recording: Recording) -> Box<dyn Vectors> {
    let recorded = Recorded {
        counts: recording != Recording::None,
        sights: recording == Recording::SetsAndSights && world.paths.is_none(),
        forces: false,
    };
    Box::new(LargeTeams { teams: (0..teams).map(|_| Swarm::new(simd, world, recorded)).collect(), recording })
}

/// Returns a part of an array whose parts have the same length. An empty array has empty parts.
fn part<T>(numbers: &[T], index: usize, length: usize) -> &[T] {
    numbers.get(index * length..(index + 1) * length).unwrap_or_default()
}

impl<S: Simd> Vectors for LargeTeams<S> {
    fn run(&mut self, world: &World, moved: &[Vec2], command: Command<'_>, observations: &mut Observations) {
        let mut parts: Vec<_> = self.teams.iter_mut().zip(observations.split(world, 1)).collect();
        let pois_of = |team| moved.chunks_exact(world.pois.len()).nth(team).unwrap_or(&world.pois);
        parts.par_iter_mut().enumerate().for_each(|(index, (team, slices))| {
            let has_changed = match command {
                Command::Reset { chosen, .. } if chosen.is_some_and(|chosen| !chosen[index]) => false,
                Command::Reset { starts, headings, .. } => {
                    let starts = starts.map_or(&world.starts[..], |starts| part(starts, index, world.agents()));
                    let headings =
                        headings.map_or(&world.headings[..], |headings| part(headings, index, world.agents()));
                    team.start(starts, headings, pois_of(index));
                    slices.reset(world, 0);
                    true
                }
                Command::Step(actions) => step(world, team, part(actions, index, world.leaders() * OUTPUTS), slices),
                Command::Restore(saved) => {
                    restore(world, team, saved, index, pois_of(index));
                    true
                }
                Command::Show => {
                    let StepArrays { positions, headings, speeds, .. } = &mut slices.arrays;
                    team.write_states(positions, headings, speeds);
                    false
                }
            };
            if has_changed {
                team.sense();
                team.write_inputs(slices.arrays.inputs);
            }
        });
    }

    fn gone(&self, team: usize) -> Vec<u32> {
        self.teams[team].gone().collect()
    }

    fn episode<'a>(&'a self, team: usize, _: &'a World, _: &'a [Vec2], _: &'a mut Vec<u32>) -> Option<Episode<'a>> {
        (self.recording != Recording::None).then(|| self.teams[team].episode())
    }
}

/// Plays a step with the actions of a team, `[leaders][2]`. Returns false if its episode is over already.
fn step<S: Simd>(world: &World, team: &mut Swarm<S>, actions: &[f32], slices: &mut Slices<'_>) -> bool {
    let Slices { arrays, newly, observed, steps } = slices;
    newly.fill(false);
    let step = steps[0] as usize;
    if step >= world.steps() {
        return false;
    }
    team.take(actions);
    team.step(step);
    let sets = part(&team.sets, step, world.words_per_step());
    arrays.agents_at_poi.copy_from_slice(sets);
    steps[0] += 1;
    for (poi, set) in sets.chunks_exact(world.constants.words as usize).enumerate() {
        newly[poi] = !observed[poi]
            && world.rule.is_open(poi, steps[0], observed)
            && world.rule.count(poi, set.iter().copied()) >= world.coupling[poi];
    }
    observed.iter_mut().zip(&**newly).for_each(|(observed, newly)| *observed |= *newly);
    true
}

/// Puts a team into a saved state. `index` is its index among the saved teams.
fn restore<S: Simd>(world: &World, team: &mut Swarm<S>, saved: &Saved<'_>, index: usize, pois: &[Vec2]) {
    let agents = world.agents();
    let [positions, headings] = [saved.positions, saved.headings].map(bytemuck::cast_slice);
    let speeds = part(saved.speeds, index, agents);
    team.place(part(positions, index, agents), part(headings, index, agents), pois, |agent, _| speeds[agent]);
    team.set_gone(part(saved.gone, index, world.gone_within.len()));
    for (record, saved) in team.record_mut().into_iter().zip([saved.record, saved.counts, saved.trail]) {
        if !saved.is_empty() {
            let each = record.len();
            record.copy_from_slice(part(saved, index, each));
        }
    }
}
