//! Classes of agents, as kernels and shaders read them: everything that agents of a class have in common.

use std::ops::Range;

use bytemuck::Zeroable;
use fearless_simd::Simd;

use super::classes::{AgentClass, Classes, ControlKind, MAX_CHANNELS, MAX_CLASSES, MAX_TERMS, PoiGroup, successive};
use super::follow::{RuleConstants, TermConstants};
use super::motion::{Mobility, MotionConstants};
use super::pursue::PursuitConstants;
use super::sense::{ChannelConstants, NOTHING};
use crate::gpu_struct::gpu_struct;

gpu_struct! {
    /// The parts of a class that kernels are specialised for.
    #[derive(Eq, Hash, Ord, PartialOrd)]
    pub struct ClassShape as itself {
        /// The first of its agents.
        pub first_agent: u32,
        /// The agent after its last.
        pub end_agent: u32,
        /// A [`ControlKind`], by its number.
        pub control: u32,
        /// The first of the agents to which its agents move.
        pub first_target: u32,
        /// The agent after the last of these.
        pub end_target: u32,
        /// The first of the agents near which its agents move.
        pub first_near: u32,
        /// The agent after the last of these. 0 if they move anywhere.
        pub end_near: u32,
        /// Not 0 if its agents cannot leave a part of the map.
        pub boxed: u32,
        /// Not 0 if it moves freely, 0 if it steers.
        pub free: u32,
        /// See [`MotionConstants::by_sine`].
        pub by_sine: u32,
        /// Channels of its senses.
        pub channel_count: u32,
        /// Terms of its rule.
        pub term_count: u32,
    }

    /// Constants of a class, without its channels and terms.
    pub struct ClassConstants as ClassConstantsLanes {
        /// The parts that kernels are specialised for.
        pub shape: ClassShape,
        /// Constants of motion.
        pub motion: MotionConstants,
        /// Constants of its rule.
        pub rule: RuleConstants,
        /// Constants of pursuit.
        pub pursuit: PursuitConstants,
        /// The squared distance up to which its agents lead those of each class; below 0 if they do not.
        pub influence2: [f32; MAX_CLASSES],
    }

    /// A class.
    pub struct Class as ClassLanes {
        /// The constants without channels and terms.
        pub constants: ClassConstants,
        /// The channels of its senses.
        pub channels: [ChannelConstants; MAX_CHANNELS],
        /// The terms of its rule.
        pub terms: [TermConstants; MAX_TERMS],
    }
}

impl Class {
    /// Computes the constants of all classes of a valid config. `values` are those of the POIs.
    pub(crate) fn all(described: &Classes, values: &[f32], map: [f64; 2], dt: f64) -> Vec<Class> {
        let classes = &described.agents;
        let places = successive(classes.iter().map(AgentClass::size));
        let groups = successive(described.pois.iter().map(PoiGroup::size));
        let end = places.last().map_or(0, |place| place.end);
        let of_class = |name: &str| {
            let index = classes.iter().position(|class| class.name == name);
            index.map_or(0..0, |index| places[index].clone())
        };
        let of_group = |name: &str| {
            let index = described.pois.iter().position(|group| group.name == name);
            index.map_or(0..0, |index| groups[index].clone())
        };
        let class = |(index, class): (usize, &AgentClass)| {
            let mut channels = [ChannelConstants::zeroed(); MAX_CHANNELS];
            let mut input = 0;
            for (to, channel) in channels.iter_mut().zip(&class.senses) {
                *to = ChannelConstants::new(channel, input, &of_class, &of_group, values, end, map);
                input += channel.sectors.count();
            }
            let mut terms = [TermConstants::zeroed(); MAX_TERMS];
            let own = TermConstants::all(class, &of_class, end);
            terms[..own.len()].copy_from_slice(&own);
            let motion = MotionConstants::new(&class.motion, class.speed, class.stays_in, map, dt);
            let targets = class.control.target().map_or(0..0, of_class);
            let near = class.moves_near.as_deref().map_or(0..0, of_class);
            let mut influence2 = [NOTHING; MAX_CLASSES];
            for (led, influence2) in influence2.iter_mut().enumerate().take(classes.len()) {
                if let Some(radius) = described.influence_radius(index, led) {
                    *influence2 = (radius * radius) as f32;
                }
            }
            let shape = ClassShape {
                first_agent: places[index].start as u32,
                end_agent: places[index].end as u32,
                control: class.control.kind() as u32,
                first_target: targets.start as u32,
                end_target: targets.end as u32,
                first_near: near.start as u32,
                end_near: near.end as u32,
                boxed: class.stays_in.is_some().into(),
                free: matches!(class.motion, Mobility::Free { .. }).into(),
                by_sine: motion.by_sine().into(),
                channel_count: class.senses.len() as u32,
                term_count: class.rule.len() as u32,
            };
            let rule = RuleConstants::new(class, &motion, end);
            let pursuit = PursuitConstants::new(class, targets.len(), dt);
            let constants = ClassConstants { shape, motion, rule, pursuit, influence2 };
            Class { constants, channels, terms }
        };
        classes.iter().enumerate().map(class).collect()
    }
}

impl Class {
    /// Returns its agents.
    pub fn agents(&self) -> Range<usize> {
        self.constants.shape.agents()
    }

    /// Returns the channels of its senses.
    pub fn channels(&self) -> &[ChannelConstants] {
        &self.channels[..self.constants.shape.channel_count as usize]
    }

    /// Returns the terms of its rule.
    pub fn terms(&self) -> &[TermConstants] {
        &self.terms[..self.constants.shape.term_count as usize]
    }

    /// Returns the number of inputs of its policies.
    pub fn inputs(&self) -> usize {
        self.channels().iter().map(|channel| channel.shape.sectors as usize).sum()
    }

    /// Returns the largest squared distance at which another agent matters to one of its agents.
    pub(crate) fn reach2(&self) -> f32 {
        let sensed = self.channels().iter().filter(|channel| channel.shape.of_pois == 0).map(|channel| channel.range2);
        let counted = self.terms().iter().map(|term| term.outer2);
        sensed.chain(counted).chain(self.constants.influence2).fold(NOTHING, f32::max)
    }
}

impl<S: Simd> ClassLanes<S> {
    /// Returns its agents.
    pub(crate) fn agents(&self) -> Range<usize> {
        self.constants.shape.agents()
    }

    /// Returns what decides how its agents move.
    pub(crate) fn control(&self) -> ControlKind {
        self.constants.shape.control()
    }
}

impl ClassShape {
    /// Returns its agents.
    pub fn agents(&self) -> Range<usize> {
        self.first_agent as usize..self.end_agent as usize
    }

    /// Returns what decides how its agents move.
    pub fn control(&self) -> ControlKind {
        ControlKind::of(self.control)
    }

    /// Returns the number of agents among which its policies choose: 0 unless they choose agents.
    pub fn choices(&self) -> usize {
        if self.control() == ControlKind::Choose { (self.end_target - self.first_target) as usize } else { 0 }
    }

    /// Reports whether its agents move straight to others.
    pub(crate) fn pursues(&self) -> bool {
        matches!(self.control(), ControlKind::Nearest | ControlKind::Choose)
    }
}
