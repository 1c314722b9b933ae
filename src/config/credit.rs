//! The section `[credit]`: what is taken out of an episode to see what a learner was worth.

use super::{MAX_AGENTS, MAX_STEPS};
use crate::config_enum::config_enum;
use crate::reader::{Reader, between, section};

section! {
    /// `[credit]`: whom D, Df and Dt take out. `led_within` and `led_by` are a world's [`Led`](crate::world::Led).
    CreditConfig = "credit" {
        /// for Dt: the learners that lead an agent at a step, of those that influenced it within led_within: the one that
        /// did at most steps, every one, the first by its number, the only one, or, if anyone did, all learners
        led_by: LedBy = "", "4.2, 5",
        /// for Dt: number of last steps, the present one included, that decide who leads an agent; 0 means all steps so
        /// far; 0 by default with led_by = "most-seen", else 1
        led_within: usize = "steps", "",
        /// for D: the agents that it takes out, counted from 0, instead of the learner: a list per learner, or one for
        /// all
        removes: Vec<Vec<usize>> = "", "",
        /// whether a fitness other than G is added to G
        add_g: bool = "", "",
    }
}

config_enum! {
    /// The learners that lead an agent, of those that influenced it: of the leaders that a follower saw.
    LedBy {
        /// The one that influenced it at the most steps.
        MostSeen = "most-seen",
        /// All of them.
        AnySeen = "any-seen",
        /// The one with the lowest number.
        First = "first",
        /// The only one, if there is only one.
        Alone = "alone",
        /// All learners, if there is any.
        Anyone = "anyone",
    }
}

impl CreditConfig {
    /// Reads the section, for teams of so many learners and agents. They are 0 if they are unknown.
    pub(super) fn read(r: &mut Reader<'_>, learners: usize, agents: usize) -> CreditConfig {
        let led_by = CreditConfig::led_by(r).choice(LedBy::MostSeen);
        let agent = between(0, if agents == 0 { MAX_AGENTS } else { agents } - 1).because("the last agent");
        let one_or_each = |lists: &[Vec<usize>]| match lists.len() {
            count if count == 1 || count == learners || learners == 0 => vec![],
            count => vec![(0, format!("found {count} lists, allowed one, or {learners} (one per learner)"))],
        };
        CreditConfig {
            led_by,
            led_within: CreditConfig::led_within(r)
                .number(between(0, MAX_STEPS), usize::from(led_by != LedBy::MostSeen)),
            removes: CreditConfig::removes(r).lists(
                "lists of agents",
                ("learners, or one for all", None),
                0..=MAX_AGENTS,
                agent,
                one_or_each,
            ),
            add_g: CreditConfig::add_g(r).flag(false),
        }
    }
}
