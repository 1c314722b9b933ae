//! How many lane operations a team-step takes at least, counted from the formulas and from who is in reach of whom.
//!
//! Counted is what the episode's definition asks of any implementation of [`crate::model`], whose parts tell what they
//! take: each f32 or integer operation, comparison and selection is one, constants and moves are free, and what two
//! formulas share is counted once. An entity counts where it is in reach of its own team's agent, as a trace of random
//! teams finds it. Not counted is what an implementation adds: testing pairs that turn out to be out of reach, lanes
//! that wait for their neighbours, loading and storing, scoring.

use crate::backend::Trace;
use crate::model::{Constants, couple, follow, motion, sense};
use crate::world::World;

/// Who is in reach of whom, in the mean over a trace's teams and steps.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Reach {
    /// POIs within the range of a leader, summed over leaders.
    pub sensed_pois: f64,
    /// Agents within the range of a leader, summed over leaders.
    pub sensed_agents: f64,
    /// Agents within the attraction radius of a follower, summed over followers.
    pub drawn: f64,
    /// How many of those are leaders.
    pub seen: f64,
    /// Pairs of agents of which one senses or is drawn to the other, each counted once.
    pub pairs: f64,
}

impl Reach {
    /// Of a trace in its world, from the state before each step.
    pub fn of(world: &World, trace: &Trace) -> Reach {
        let Constants { sense, follow, .. } = world.constants;
        let (agents, leaders) = (world.agents(), world.leaders());
        let [mut sensed_pois, mut sensed_agents, mut drawn, mut seen, mut pairs] = [0u64; 5];
        for moments in trace.moments.chunks_exact(agents).take(world.steps() * trace.teams) {
            let d2 = |[ax, ay]: [f32; 2], [bx, by]: [f32; 2]| {
                let (dx, dy) = (bx - ax, by - ay);
                dx * dx + dy * dy
            };
            for (i, a) in moments.iter().enumerate() {
                if i < leaders {
                    let near = world.pois.iter().filter(|poi| d2(a.position, poi.to_array()) <= sense.poi_range2);
                    sensed_pois += near.count() as u64;
                }
                for (j, b) in moments.iter().enumerate().skip(i + 1) {
                    let d2 = d2(a.position, b.position);
                    let (senses, draws) = (d2 <= sense.agent_range2, d2 <= follow.attraction_radius2);
                    // The earlier of the two is a leader if any is.
                    let (first_leads, second_leads) = (i < leaders, j < leaders);
                    let sensing = u64::from(senses && first_leads) + u64::from(senses && second_leads);
                    let drawing = u64::from(draws && !first_leads) + u64::from(draws && !second_leads);
                    sensed_agents += sensing;
                    drawn += drawing;
                    seen += u64::from(draws && first_leads && !second_leads);
                    pairs += u64::from(sensing + drawing > 0);
                }
            }
        }
        let mean = |count: u64| count as f64 / (world.steps() * trace.teams) as f64;
        Reach {
            sensed_pois: mean(sensed_pois),
            sensed_agents: mean(sensed_agents),
            drawn: mean(drawn),
            seen: mean(seen),
            pairs: mean(pairs),
        }
    }
}

/// Lane operations of one team-step.
pub fn per_team_step(world: &World, reach: &Reach) -> f64 {
    let Constants { variant, policy, .. } = world.constants;
    let count = |count: usize, operations: u32| count as f64 * f64::from(operations);
    let sensed = (reach.sensed_pois + reach.sensed_agents) * f64::from(sense::operations(variant.density()));
    let met = reach.drawn * f64::from(follow::INFLUENCE) + reach.seen * f64::from(follow::SEEN);
    sensed
        + met
        + count(world.leaders(), sense::WEIGHED + policy.operations() + motion::TURN)
        + count(world.followers(), follow::FOLLOW)
        + count(world.agents(), motion::MOVE)
        + count(world.agents() * world.pois.len(), couple::OBSERVE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backend::cpu::Cpu;
    use crate::backend::{Backend, Group, Need};
    use crate::config::Config;
    use crate::sample;

    fn world(text: &str) -> World {
        World::new(&Config::parse(text, "test.toml").expect("a good config"))
    }

    fn reach(world: &World, teams: usize) -> Reach {
        let weights = sample::weights(world, teams, 0);
        let order: Vec<u32> = (0..teams as u32).flat_map(|team| vec![team; world.leaders()]).collect();
        let need = Need::Record;
        let group =
            Group { world, starts: &world.starts, weights: weights[..].into(), policies: teams, teams: &order, need };
        Reach::of(world, &Cpu::default().trace(&group).expect("the CPU plays"))
    }

    #[test]
    fn an_agent_alone() {
        let world = world("[world]\nleaders = [[10, 5]]\npois = [[10, 15], [40, 40]]\nsteps = 1\ncoupling = 1\n");
        let reach = reach(&world, 3);
        assert_eq!(reach, Reach { sensed_pois: 2.0, ..Reach::default() });
        // 2 POIs sensed; 8 inputs; 10 units of 8 inputs and 2 of 10; the turn and the speed; the move; 2 POIs tested.
        let units = 10.0 * (16.0 + 27.0) + 2.0 * (20.0 + 27.0);
        assert_eq!(per_team_step(&world, &reach), 2.0 * 45.0 + 8.0 + units + 38.0 + 36.0 + 2.0 * 8.0);
    }

    #[test]
    fn pairs_are_counted_from_both_sides() {
        // At the start, all of the first step: two leaders in reach of each other, a follower in reach of one, and a
        // follower alone.
        let world = world(
            "[world]\nleaders = [[10, 5], [14, 5]]\nfollowers = [[17, 5], [40, 40]]\npois = [[10, 15]]\nsteps = 1\n\
             coupling = 1\n[sense]\npoi_range = 10.5\nagent_range = 4\n",
        );
        let reach = reach(&world, 2);
        // The follower stands 3 from the second leader, who senses it; both leaders sense each other.
        let expected = Reach { sensed_pois: 1.0, sensed_agents: 3.0, drawn: 1.0, seen: 1.0, pairs: 2.0 };
        assert_eq!(reach, expected);
    }
}
