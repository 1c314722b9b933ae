//! The large teams behind a [`Stepper`](super::Stepper), which step one by one.

use fearless_simd::Simd;
use glam::Vec2;

use super::Recording;
use super::engine::{Command, Observations, Vectors};
use super::state::Saved;
use crate::backend::cpu::{Recorded, StepArrays, Swarm, step_sizes};
use crate::credit::Episode;
use crate::parallel::*;
use crate::world::{OUTPUTS, World};

/// Large teams of one world.
struct LargeTeams<S: Simd> {
    teams: Vec<Swarm<S>>,
    recording: Recording,
}

/// The [`Observations`] of a team, with its actions if it steps.
struct Slices<'a> {
    arrays: StepArrays<'a>,
    newly: &'a mut [bool],
    observed: &'a mut [bool],
    step: &'a mut u32,
}

/// Returns large teams.
pub(super) fn large_teams<S: Simd>(simd: S, world: &World, teams: usize, recording: Recording) -> Box<dyn Vectors> {
    let recorded = Recorded {
        counts: recording != Recording::None,
        sights: recording == Recording::SetsAndSights && world.paths.is_none(),
        forces: false,
    };
    Box::new(LargeTeams { teams: (0..teams).map(|_| Swarm::new(simd, world, recorded)).collect(), recording })
}

/// Returns the numbers of a team, so many each, or none of an empty array.
fn of_team<T>(numbers: &[T], team: usize, each: usize) -> &[T] {
    numbers.get(team * each..(team + 1) * each).unwrap_or_default()
}

impl<S: Simd> Vectors for LargeTeams<S> {
    fn run(&mut self, world: &World, moved: &[Vec2], command: Command<'_>, observations: &mut Observations) {
        let Observations { inputs, agents_at_poi, newly, observed, steps, positions, headings, speeds } = observations;
        let mut all = StepArrays { positions, headings, speeds, inputs, agents_at_poi, ..StepArrays::default() };
        let (sizes, pois) = (step_sizes(world, 1, 1), world.pois.len());
        let flags = newly.chunks_mut(pois).zip(observed.chunks_mut(pois)).zip(steps);
        let mut parts: Vec<_> = (self.teams.iter_mut().zip(flags))
            .map(|(team, ((newly, observed), step))| {
                (team, Slices { arrays: all.split(sizes, 1), newly, observed, step })
            })
            .collect();
        let pois_of = |team| moved.chunks_exact(pois).nth(team).unwrap_or(&world.pois);
        parts.par_iter_mut().enumerate().for_each(|(index, (team, slices))| {
            let has_changed = match command {
                Command::Reset { chosen, .. } if chosen.is_some_and(|chosen| !chosen[index]) => false,
                Command::Reset { starts, headings, .. } => {
                    let starts = starts.map_or(&world.starts[..], |starts| of_team(starts, index, world.agents()));
                    let headings =
                        headings.map_or(&world.headings[..], |headings| of_team(headings, index, world.agents()));
                    team.start(starts, headings, pois_of(index));
                    slices.reset();
                    true
                }
                Command::Step(actions) => slices.step(world, team, of_team(actions, index, world.leaders() * OUTPUTS)),
                Command::Restore(saved) => {
                    restore(team, saved, index, [world.agents(), world.gone_within.len()], pois_of(index));
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

impl Slices<'_> {
    fn reset(&mut self) {
        self.arrays.agents_at_poi.fill(0);
        [&mut self.newly, &mut self.observed].into_iter().for_each(|flags| flags.fill(false));
        *self.step = 0;
    }

    /// Plays a step with the actions of a team, `[leaders][2]`. Returns whether its episode was not over.
    fn step<S: Simd>(&mut self, world: &World, team: &mut Swarm<S>, actions: &[f32]) -> bool {
        self.newly.fill(false);
        let step = *self.step as usize;
        if step >= world.steps() {
            return false;
        }
        team.take(actions);
        team.step(step);
        let sets = of_team(&team.sets, step, world.words_per_step());
        self.arrays.agents_at_poi.copy_from_slice(sets);
        *self.step += 1;
        for (poi, set) in sets.chunks_exact(world.constants.words as usize).enumerate() {
            self.newly[poi] = !self.observed[poi]
                && world.rule.is_open(poi, *self.step, self.observed)
                && world.rule.count(poi, set.iter().copied()) >= world.coupling[poi];
        }
        self.observed.iter_mut().zip(&*self.newly).for_each(|(observed, newly)| *observed |= *newly);
        true
    }
}

/// Puts a team into a saved state.
fn restore<S: Simd>(
    team: &mut Swarm<S>,
    saved: &Saved<'_>,
    index: usize,
    [agents, gone_within]: [usize; 2],
    pois: &[Vec2],
) {
    let [positions, headings] = [saved.positions, saved.headings].map(bytemuck::cast_slice);
    let speeds = of_team(saved.speeds, index, agents);
    team.place(of_team(positions, index, agents), of_team(headings, index, agents), pois, |agent, _| speeds[agent]);
    team.set_gone(of_team(saved.gone, index, gone_within));
    for (record, saved) in team.record_mut().into_iter().zip([saved.record, saved.counts, saved.trail]) {
        if !saved.is_empty() {
            let each = record.len();
            record.copy_from_slice(of_team(saved, index, each));
        }
    }
}
