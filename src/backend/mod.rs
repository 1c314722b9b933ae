//! The seam between training and the hardware: whole episodes of many teams.

use std::any::Any;
use std::fmt::Debug;

use glam::Vec2;

use crate::config::Fitness;
use crate::declare::shared;
use crate::evolve::{self, Breeding};
use crate::parallel::current_num_threads;
use crate::world::{INPUTS, OUTPUTS, World};

pub mod compare;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;

/// Populations of a trial that take so many bytes are held where nothing else is asked for, but never by a software
/// renderer: about what goes over the bus in the time of the few dispatches that holding costs. An estimate, not a
/// measurement.
pub const HELD_FROM: u64 = 1 << 20;

/// Records of a batch that take so many bytes are packed where nothing else is asked for, but never by a software
/// renderer: about what goes over the bus in the time that one more dispatch costs. An estimate, not a measurement.
pub const PACKED_FROM: u64 = 1 << 20;

/// Bytes of one buffer that a batch on a GPU aims for: enough to fill it, small enough to overlap batches.
pub const BATCH_BYTES: u64 = 256 << 20;
/// Weights that a GPU's thread reads at once.
const FOUR: usize = 4;

/// Words of a team's record: sets, counts and, where they are needed, sights.
fn record_words(world: &World, need: Need) -> usize {
    let sights = if need.sights() { world.sight_words() } else { 0 };
    world.set_words() + world.leaders() * world.followers() + sights
}

/// Bytes of a team's record.
pub fn record_bytes(world: &World, need: Need) -> u64 {
    (record_words(world, need) * size_of::<u32>()) as u64
}

/// Weights of a team as an episode on a GPU reads them, four at a time.
fn fours(world: &World) -> usize {
    world.leaders() * world.parameters().div_ceil(FOUR)
}

/// Bytes of a team's weights as an episode on a GPU reads them.
pub fn weight_bytes(world: &World) -> u64 {
    (fours(world) * size_of::<[f32; FOUR]>()) as u64
}

/// Bytes that a GPU holds of a trial's populations, `[populations, slots, parameters]`, where it does: a buffer a
/// population and one more, and every slot's parent.
pub fn held_bytes([populations, slots, parameters]: [usize; 3]) -> u64 {
    let [populations, population, parents] =
        [populations, 4 * slots * parameters, 4 * populations * slots].map(|count| count as u64);
    if populations * population < HELD_FROM { 0 } else { (populations + 1) * population + parents }
}

/// Teams of one world that start alike and are made of one set of policies.
#[derive(Clone, Copy, Debug)]
pub struct Group<'a> {
    /// The world that they play in.
    pub world: &'a World,
    /// Start positions `[agents]`, leaders first; after them places of the POIs, `[pois]`, unless these are the
    /// world's.
    pub starts: &'a [Vec2],
    /// The policies.
    pub weights: Weights<'a>,
    /// Policies a leader has to choose from.
    pub policies: usize,
    /// The policy each leader plays in each team, `[teams][leaders]`.
    pub teams: &'a [u32],
    /// What its episodes must tell.
    pub need: Need,
}

/// What is wanted of an episode. A backend may tell more, and does where that costs nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Need {
    /// The whole record, but for who was seen at which step.
    Record,
    /// The whole record: what every fitness is worked out from.
    Sights,
    /// What every fitness but Dt is worked out from.
    Scores,
    /// What this fitness is worked out from.
    Score(Fitness),
}

impl Need {
    /// Every need of scores alone.
    pub const OF_SCORES: [Need; 6] = [
        Need::Scores,
        Need::Score(Fitness::G),
        Need::Score(Fitness::D),
        Need::Score(Fitness::Df),
        Need::Score(Fitness::Dpp),
        Need::Score(Fitness::Dt),
    ];

    /// How many agents a set must have to make a difference, where so many must be near; none where the whole record
    /// is wanted.
    pub fn least(self, coupling: u32) -> Option<u32> {
        match self {
            // Dt asks when.
            Need::Record | Need::Sights | Need::Score(Fitness::Dt) => None,
            // D++ asks how many are missing.
            Need::Scores | Need::Score(Fitness::Dpp) => Some(1),
            Need::Score(Fitness::G | Fitness::D | Fitness::Df) => Some(coupling),
        }
    }

    /// Whether it matters which leader a follower saw most.
    pub fn owners(self) -> bool {
        matches!(self, Need::Record | Need::Sights | Need::Scores | Need::Score(Fitness::Df))
    }

    /// Whether it matters which leaders a follower saw at which step.
    pub fn sights(self) -> bool {
        matches!(self, Need::Sights | Need::Score(Fitness::Dt))
    }
}

impl<'a> Group<'a> {
    /// How many teams play.
    pub fn team_count(&self) -> usize {
        self.teams.len() / self.world.leaders()
    }

    /// Where its POIs are, if not where the world has them.
    pub fn moved_pois(&self) -> Option<&'a [Vec2]> {
        Some(&self.starts[self.world.agents()..]).filter(|pois| !pois.is_empty())
    }

    /// Where the weights of a leader's policy start among those on the host.
    #[inline]
    pub(crate) fn place(&self, weights: &[f32], leader: usize, policy: usize) -> usize {
        let parameters = self.world.parameters();
        let shared = weights.len() == self.policies * parameters;
        (if shared { policy } else { leader * self.policies + policy }) * parameters
    }

    /// Whether its parts fit each other. Every backend asks this before it plays.
    ///
    /// # Errors
    /// Places, weights or choices are too few or too many, or a team plays a policy that there is not.
    pub fn check(&self) -> Result<(), BackendError> {
        let Group { world, starts, weights, policies, teams, .. } = *self;
        let invalid = |text: String| Err(BackendError::InvalidInput(text));
        if let Err(field) = world.validate() {
            return invalid(format!("the world is inconsistent: its {field} do not match the rest"));
        }
        let (agents, leaders) = (world.agents(), world.leaders());
        if starts.len() != agents && starts.len() != agents + world.pois.len() {
            return invalid(format!("{} start positions for {agents} agents", starts.len()));
        }
        if !teams.len().is_multiple_of(leaders) {
            return invalid(format!("{} choices of policies for teams of {leaders} leaders", teams.len()));
        }
        let shared = policies * world.parameters();
        let numbers = leaders * shared;
        if let Weights::OnHost(weights) = weights
            && ![shared, numbers].contains(&weights.len())
        {
            return invalid(format!("{} weights, but {policies} policies a leader have {numbers}", weights.len()));
        }
        match teams.iter().position(|&policy| policy as usize >= policies) {
            None => Ok(()),
            Some(place) => invalid(format!(
                "leader {} of team {} plays policy {} of {policies} (they count from 0)",
                place % leaders,
                place / leaders,
                teams[place]
            )),
        }
    }
}

/// What the policies of a group are, `[leaders][policies][parameters]`, or `[1][policies][parameters]` where all
/// leaders choose from the same: each number 0 or of size 2^-30 to 2^20.
#[derive(Clone, Copy, Debug)]
pub enum Weights<'a> {
    /// In the host's memory.
    OnHost(&'a [f32]),
    /// In the memory of the backend that plays.
    Held(&'a (dyn Held + 'static)),
}

impl<'a> From<&'a [f32]> for Weights<'a> {
    fn from(weights: &'a [f32]) -> Weights<'a> {
        Weights::OnHost(weights)
    }
}

impl<'a> Weights<'a> {
    /// The numbers, where they are at hand.
    ///
    /// # Errors
    /// Another backend holds them.
    pub fn on_host(self) -> Result<&'a [f32], BackendError> {
        match self {
            Weights::OnHost(weights) => Ok(weights),
            Weights::Held(_) => Err(BackendError::HeldElsewhere),
        }
    }
}

/// The populations of one trial in a backend's own memory; dropped, they leave it.
///
/// After an error they may be of any generation.
pub trait Held: Any + Debug + Send + Sync {
    /// Makes the next generation, to the bits of [`crate::evolve::mutate`].
    ///
    /// # Errors
    /// The plan does not fit the populations, or the device failed.
    fn breed(&mut self, breeding: &Breeding<'_>) -> Result<(), BackendError>;

    /// Copies all weights to the host, `[populations][slots][parameters]`.
    ///
    /// # Errors
    /// The device failed.
    fn fetch(&self, weights: &mut [f32]) -> Result<(), BackendError>;
}

/// What one team did, as far as credit needs it.
#[derive(Clone, Copy, Debug)]
pub struct Episode<'a> {
    /// Index of its group in the batch.
    pub group: usize,
    /// Index of the team in the group.
    pub team: usize,
    /// The agents near each POI after each step, a bit an agent: `[steps][pois][words]`. Where only scores are
    /// [needed](Need), there may be fewer steps, down to none, whose sets give the same scores, see [`crate::credit`].
    pub sets: Strided<'a>,
    /// Which leaders its followers saw, as counts or as what [is needed](Need) of them.
    pub seen: Seen<'a>,
    /// The leaders that each follower saw before the move of each step, a bit a leader:
    /// `[steps][followers][words of leaders]`. Empty where nobody [needs](Need::sights) it.
    pub sights: Strided<'a>,
}

/// Which leaders the followers of one team saw.
#[derive(Clone, Copy, Debug)]
pub enum Seen<'a> {
    /// At how many steps each follower saw each leader: `[followers][leaders]`.
    Counts(Strided<'a>),
    /// The leader that each follower saw at most steps, as [`crate::credit::assign`] has it: [`owner_bits`] bits a
    /// follower, all ones for nobody, from the lowest of a word on. Empty where nobody [needs](Need) it.
    Most(Strided<'a>),
}

impl<'a> Seen<'a> {
    /// The words, whichever they are.
    pub fn words(self) -> Strided<'a> {
        match self {
            Seen::Counts(words) | Seen::Most(words) => words,
        }
    }
}

/// Bits that a leader's index takes in [`Seen::Most`].
pub fn owner_bits(leaders: u32) -> u32 {
    if leaders < 255 { 8 } else { 16 }
}

/// Words of one team among those of its neighbours: word i of this team is `words[i * stride + offset]`.
#[derive(Clone, Copy, Debug)]
pub struct Strided<'a> {
    /// The words of all these teams.
    pub words: &'a [u32],
    /// How many words on a team's next word is.
    pub stride: usize,
    /// Where this team's first word is, under the stride.
    pub offset: usize,
}

impl<'a> Strided<'a> {
    /// No words.
    pub const NONE: Strided<'static> = Strided { words: &[], stride: 1, offset: 0 };

    /// All words of this team.
    pub fn iter(self) -> impl Iterator<Item = u32> + 'a {
        (0..self.len()).map(move |index| self.get(index))
    }

    /// Word `index` of this team.
    #[inline]
    pub fn get(&self, index: usize) -> u32 {
        self.words[index * self.stride + self.offset]
    }

    /// Words of each team.
    pub fn len(&self) -> usize {
        self.words.len() / self.stride
    }

    /// Whether there is no word.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

shared! {
    /// Floats that a [`Trace`] holds of one agent at one step, in this order.
    ///
    /// The inputs and the outputs are a leader's, the force a follower's; who has none has zeros. So does step 0, the
    /// start.
    pub struct Moment {
        /// Sensed densities.
        pub inputs: [f32; INPUTS],
        /// What the policy answered, each in -1..1.
        pub outputs: [f32; OUTPUTS],
        /// Attraction, repulsion and wall push together.
        pub force: [f32; 2],
        /// Where the agent is after the step, x and y in units.
        pub position: [f32; 2],
        /// Where it heads then, a unit vector.
        pub heading: [f32; 2],
        /// How fast it is then, in units a second.
        pub speed: f32,
    }
}

/// Every stage of every step: `moments[(step * teams + team) * agents + agent]`, steps `0..=steps`.
#[derive(Clone, Debug, PartialEq)]
pub struct Trace {
    /// Teams of the group.
    pub teams: usize,
    /// Agents of a team.
    pub agents: usize,
    /// `[steps + 1][teams][agents]`.
    pub moments: Vec<Moment>,
    /// The agents near each POI after each step, a bit an agent: `[teams][steps][pois][words]`.
    pub sets: Vec<u32>,
    /// At how many steps each follower saw each leader, `[teams][followers][leaders]`.
    pub seen: Vec<u32>,
    /// Where [needed](Need::sights), which leaders each follower saw before each step's move, a bit a leader:
    /// `[teams][steps][followers][words of leaders]`.
    pub sights: Vec<u32>,
}

impl Trace {
    /// What one agent of one team did at one step.
    pub fn moment(&self, step: usize, team: usize, agent: usize) -> &Moment {
        &self.moments[(step * self.teams + team) * self.agents + agent]
    }
}

/// Called once for each team, from any thread, in any order.
pub type Visit<'a> = dyn Fn(Episode<'_>) + Sync + 'a;

/// Plays episodes. Every implementation gives the same bits.
pub trait Backend: Send {
    /// Plays every team of every group once.
    ///
    /// # Errors
    /// A group does not fit together or does not fit the device, or the device failed.
    fn rollout(&mut self, groups: &[Group<'_>], visit: &Visit<'_>) -> Result<(), BackendError>;

    /// Plays one group and keeps every stage of every step.
    ///
    /// # Errors
    /// As for [`Backend::rollout`].
    fn trace(&mut self, group: &Group<'_>) -> Result<Trace, BackendError>;

    /// Takes the populations of one trial, `[populations][slots][parameters]`, a leader's each or one for all, into
    /// memory of its own, to breed them there; none where they had better stay on the host.
    ///
    /// # Errors
    /// They were asked to be held here and do not fit, or the device failed.
    fn hold(&mut self, _weights: &[f32], _sizes: [usize; 3]) -> Result<Option<Box<dyn Held>>, BackendError> {
        Ok(None)
    }

    /// What it runs on, for people: "cpu (AVX2, 2 threads)".
    fn describe(&self) -> String;
}

impl From<evolve::InvalidInput> for BackendError {
    fn from(error: evolve::InvalidInput) -> BackendError {
        BackendError::InvalidInput(error.to_string())
    }
}

/// What a run runs on, for `run.json`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Machine {
    /// "cpu" or "gpu".
    pub backend: String,
    /// What the GPU calls itself.
    pub adapter: Option<String>,
    /// The GPU's driver and its version.
    pub driver: Option<String>,
    /// Threads of the CPU that work.
    pub threads: usize,
}

impl Machine {
    /// The CPU, on the threads that there are.
    pub fn of_cpu() -> Machine {
        Machine { backend: "cpu".into(), threads: current_num_threads(), ..Machine::default() }
    }

    /// What a GPU backend runs on.
    #[cfg(feature = "gpu")]
    pub fn of_gpu(backend: &gpu::episode::GpuEpisodes) -> Machine {
        let adapter = &backend.gpu().adapter;
        Machine {
            backend: "gpu".into(),
            adapter: Some(adapter.name.clone()),
            driver: Some(adapter.driver.clone()),
            threads: current_num_threads(),
        }
    }
}

/// A backend and what it is.
pub type Player = (Box<dyn Backend>, Machine);

/// Why episodes could not be played.
#[derive(Debug, thiserror::Error)]
pub enum BackendError {
    /// A GPU could not be opened, or failed.
    #[cfg(feature = "gpu")]
    #[error(transparent)]
    Gpu(#[from] gpu::device::DeviceError),
    /// What was asked does not fit the device.
    #[error("{0}")]
    TooLarge(String),
    /// The input is inconsistent or out of range.
    #[error("{0}")]
    InvalidInput(String),
    /// Populations of one backend were handed to another.
    #[error("the populations are held by another device; bring them to the host first")]
    HeldElsewhere,
    /// Nobody has the populations of the present generation any more.
    #[error("the populations were lost with the device that held them")]
    Gone,
}
