//! Teams that play together: a vector of teams, or one large team.

use std::any::Any;
use std::ops::Range;

use fearless_simd::Simd;

use super::arrays::StepArrays;
use super::batch::WorldBatch;
use super::{Moment, ScoreTable};
use crate::credit::Episode;
use crate::world::OUTPUTS;

/// The memory of teams that play together: of a vector of teams ([`EpisodeBlock`](super::episode::EpisodeBlock)), or of one
/// large team ([`Swarm`](super::swarm::Swarm)).
pub(super) trait Together<S: Simd>: Send + Sized + 'static {
    /// Maximum number of teams.
    const MAX_TEAMS: usize;

    /// Returns memory for teams of a batch. A trace also needs all counts and forces.
    fn allocate(simd: S, batch: &WorldBatch<'_>, traced: bool) -> Self;

    /// Reports whether it has the sizes and constants of a batch that is not traced.
    fn fits(&self, batch: &WorldBatch<'_>) -> bool;

    /// Plays the whole episodes of some teams of the batch.
    fn play<O: Observer<S, Self>>(&mut self, batch: &WorldBatch<'_>, teams: Range<usize>, observer: &mut O);

    /// Scores the teams that were played.
    fn score(&mut self, batch: &WorldBatch<'_>, teams: Range<usize>, scores: &ScoreTable<'_>);

    /// Returns the record of one of the teams that were played.
    fn episode_of<'a>(&'a self, batch: &WorldBatch<'a>, team: usize) -> Episode<'a>;

    /// Returns the outputs of the leaders' policies.
    fn outputs(&mut self) -> &mut [[S::f32s; OUTPUTS]];

    /// Returns where the outputs of a leader are: their index, and the lane of the first team.
    fn outputs_at(leader: usize) -> (usize, usize);

    /// Writes the moments of one team's agents, and the inputs of its leaders, `[leaders][inputs]`. Before the first step
    /// nothing has been sensed.
    fn moments(&self, team: usize, sensed: bool, moments: &mut [Moment], inputs: &mut [f32]);

    /// Writes positions, headings and speeds to row `row` of each team's `rows` rows.
    fn store_states(&self, row: (usize, usize), arrays: &mut StepArrays<'_>);

    /// Writes what the leaders sense.
    fn store_inputs(&self, row: (usize, usize), arrays: &mut StepArrays<'_>);

    /// Writes the outputs of the leaders' policies.
    fn store_outputs(&self, row: (usize, usize), outputs: &mut [f32]);

    /// Writes the agents at each POI after a step.
    fn store_sets(&self, row: (usize, usize), arrays: &mut StepArrays<'_>);
}

/// Follows the episodes of teams that play together. By default nothing is done.
pub(super) trait Observer<S: Simd, T: Together<S>> {
    /// Whether it reads the agents at each POI even if scores do not need them.
    const READS_SETS: bool = true;

    /// The teams are at their start.
    #[inline(always)]
    fn started(&mut self, _: &mut T) {}

    /// Policies have answered what leaders sense before this step, and agents are about to move. The outputs may be
    /// changed.
    #[inline(always)]
    fn decided(&mut self, _: &mut T, _step: usize) {}

    /// The agents have moved.
    #[inline(always)]
    fn moved(&mut self, _: &mut T, _step: usize) {}
}

/// The memory of a thread, as it was last used.
pub(super) type Workspace = Option<Box<dyn Any + Send>>;

/// Plays and scores some teams of a batch in the memory of a thread, and returns this.
pub(super) fn play_together<'a, S: Simd, T: Together<S>>(
    simd: S,
    workspace: &'a mut Workspace,
    batch: &WorldBatch<'_>,
    teams: Range<usize>,
    observer: &mut impl Observer<S, T>,
    scores: &ScoreTable<'_>,
) -> &'a T {
    let kept = workspace.take().filter(|kept| kept.downcast_ref().is_some_and(|kept: &T| kept.fits(batch)));
    let kept = workspace.insert(kept.unwrap_or_else(|| Box::new(T::allocate(simd, batch, false))));
    let together: &mut T = kept.downcast_mut().expect("it was just inserted");
    simd.vectorize(
        #[inline(always)]
        || {
            together.play(batch, teams.clone(), observer);
            together.score(batch, teams, scores);
        },
    );
    together
}
