//! Random worlds for verification. They vary in size, shape and gains, and have many of the exact ties that real
//! layouts have.

use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};

use crate::config::*;
use crate::evolve::MIN_WEIGHT;
use crate::world::World;

/// The layout of a world's agents and POIs.
#[derive(Clone, Copy)]
enum Placing {
    /// Anywhere on the map.
    Scattered,
    /// Within a few radii of one point, like a team that has gathered.
    Crowded,
    /// On a grid of spacing 0.5, so that distances equal radii and positions lie on quadrant borders exactly.
    Grid,
    /// As in the paper: groups side by side, followers behind or around their leader, a POI straight ahead.
    Groups,
    /// All at one point.
    OnePoint,
    /// On walls and in corners.
    Walls,
    /// On the axes and diagonals through the first leader. Offsets per axis are 0 or exactly a radius or a range.
    Boundaries,
}

const LAYOUTS: [Placing; 10] = [
    Placing::Scattered,
    Placing::Scattered,
    Placing::Crowded,
    Placing::Crowded,
    Placing::Grid,
    Placing::Groups,
    Placing::Groups,
    Placing::OnePoint,
    Placing::Walls,
    Placing::Boundaries,
];

/// Returns a valid config of 1 to 40 agents and 1 to 8 POIs, a pure function of the seed.
///
/// A hundred consecutive seeds cover every kind of layout, both paradigms, all densities and 0 to 3 hidden layers. They
/// cover gains, speeds and turn rates down to 0. They cover every kind of observers, windows and POI order, and worlds
/// without any of these.
pub fn world(seed: u64) -> Config {
    let mut config = plain_world(seed);
    // A separate random stream leaves the rest of the world unchanged.
    let rng = &mut ChaCha8Rng::seed_from_u64(seed ^ 0x7275_6c65);
    if rng.random_bool(0.5) {
        observe_otherwise(rng, &mut config);
    }
    config.credit.led_within = [0, 1, rng.random_range(2..=10)][rng.random_range(0..3)];
    config.credit.led_by = word(rng);
    config
}

/// Sets the observers of a world and maybe the windows and the order of its POIs.
fn observe_otherwise(rng: &mut ChaCha8Rng, config: &mut Config) {
    let (leaders, agents) = (config.learners(), config.world.leaders.len() + config.world.followers.len());
    let world = &mut config.world;
    let pois = world.pois.len();
    let counted = |observers: Observers| observers.among(leaders, agents - leaders).len();
    world.observers = [Observers::All, word(rng)][rng.random_range(0..2)];
    if counted(world.observers) == 0 {
        world.observers = Observers::All;
    }
    let most = counted(world.observers);
    match &mut world.coupling {
        Coupling::Same(coupling) => *coupling = most.min(*coupling),
        Coupling::Each(couplings) => couplings.iter_mut().for_each(|coupling| *coupling = most.min(*coupling)),
    }
    if rng.random_bool(0.6) {
        let window = |rng: &mut ChaCha8Rng| {
            let first = rng.random_range(1..=world.steps);
            match rng.random_range(0..4) {
                0 => [first, first],
                1 => [first, rng.random_range(first..=world.steps)],
                2 => [1, first],
                _ => [1, world.steps],
            }
        };
        world.windows = (0..pois).map(|_| window(rng)).collect();
    }
    if rng.random_bool(0.6) {
        // Each POI comes after some of the POIs before it in an order that starts at any POI.
        let (first, step) = (rng.random_range(0..pois), if rng.random_bool(0.5) { 1 } else { pois - 1 });
        let order: Vec<usize> = (0..pois).map(|place| (first + place * step) % pois).collect();
        world.after = vec![vec![]; pois];
        for (place, &poi) in order.iter().enumerate() {
            let before = order[..place].iter().copied().filter(|_| rng.random_bool(0.4));
            world.after[poi] = before.collect();
        }
    }
}

fn plain_world(seed: u64) -> Config {
    let rng = &mut ChaCha8Rng::seed_from_u64(seed);
    let layout = LAYOUTS[(seed % LAYOUTS.len() as u64) as usize];
    let exact = matches!(layout, Placing::Grid | Placing::Groups | Placing::OnePoint | Placing::Boundaries);
    let number = |rng: &mut ChaCha8Rng, low: f64, high: f64| {
        let value = rng.random_range(low..high);
        if exact { (value * 2.0).ceil() / 2.0 } else { value }
    };
    let map = match rng.random_range(0..5) {
        0 => [number(rng, 2.0, 10.0), number(rng, 2.0, 10.0)],
        1 => [number(rng, 50.0, 200.0), number(rng, 20.0, 200.0)],
        _ => [50.0, 50.0],
    };
    let agents = match rng.random_range(0..8) {
        0 => 1,
        1 => rng.random_range(30..=40),
        _ => rng.random_range(2..=20),
    };
    let leaders = rng.random_range(1..=agents.min(8));
    let pois = rng.random_range(1..=8);
    let attraction_radius = number(rng, 0.5, 8.0);
    let repulsion_radius = number(rng, 0.2, 2.0).min(attraction_radius);
    let observation_radius = number(rng, 0.5, 8.0);
    let unlimited = [rng.random_bool(0.4), rng.random_bool(0.2)];
    let [poi_range, agent_range] =
        unlimited.map(|unlimited| if unlimited { f64::INFINITY } else { number(rng, 1.0, 15.0) });

    let centre = map.map(|side| number(rng, 0.0, side).min(side));
    let radii = [
        attraction_radius,
        repulsion_radius,
        observation_radius,
        if agent_range.is_finite() { agent_range } else { 5.0 },
    ];
    let mut place = |index: usize, agent: bool| -> [f64; 2] {
        let offset = match layout {
            Placing::Scattered => map.map(|side| rng.random_range(0.0..1.0) * side),
            Placing::Crowded => {
                let reach = 1.5 * attraction_radius;
                centre.map(|at| at + rng.random_range(-reach..reach))
            }
            Placing::Grid => {
                let reach = if agent { 8 } else { 16 };
                centre.map(|at| at + f64::from(rng.random_range(-reach..=reach)) / 2.0)
            }
            Placing::Groups => {
                let group = (index % 4) as f64;
                let [x, y] = match (agent, index / 4) {
                    (true, 0) => [0.0, 0.0],
                    (true, 1) => [2.0, -3.0],
                    (true, 2) => [-2.0, -3.0],
                    (true, 3) => [2.0, 2.0],
                    (true, _) => [-2.0, 2.0],
                    (false, row) => [0.0, 10.0 + 5.0 * row as f64],
                };
                [10.0 + 10.0 * group + x, 5.0 + y]
            }
            Placing::OnePoint => centre,
            Placing::Walls => {
                let mut at = map.map(|side| rng.random_range(0.0..1.0) * side);
                let axis = rng.random_range(0..2);
                at[axis] = if rng.random_bool(0.5) { 0.0 } else { map[axis] };
                if rng.random_bool(0.3) {
                    at[1 - axis] = 0.0;
                }
                at
            }
            Placing::Boundaries if agent && index == 0 => centre,
            Placing::Boundaries => {
                let radius = radii[rng.random_range(0..radii.len())];
                let [x, y] = [[1, 0], [0, 1], [-1, 0], [0, -1], [1, 1], [-1, 1], [-1, -1], [1, -1]]
                    [rng.random_range(0..8)]
                .map(f64::from);
                [centre[0] + radius * x, centre[1] + radius * y]
            }
        };
        [offset[0].clamp(0.0, map[0]), offset[1].clamp(0.0, map[1])]
    };
    let starts: Vec<_> = (0..agents).map(|agent| place(agent, true)).collect();
    let pois: Vec<_> = (0..pois).map(|poi| place(poi, false)).collect();

    let quarter = std::f64::consts::FRAC_PI_2;
    let max_speed = [0.5, 3.0, 3.0, 5.0][rng.random_range(0..4)];
    let min_speed = [0.0, 0.0, 0.0, 0.25][rng.random_range(0..4)];
    let mut coupling = || rng.random_range(1..=agents.min(5));
    let coupling = if seed.is_multiple_of(3) {
        Coupling::Each(pois.iter().map(|_| coupling()).collect())
    } else {
        Coupling::Same(coupling())
    };
    // Keys that were added later draw from a separate stream, so the other keys of each seed stay the same.
    let later = &mut ChaCha8Rng::seed_from_u64(!seed);
    let actions = if later.random_bool(0.3) { Actions::Behaviours } else { Actions::Direct };
    // Generations from 2 on may play longer episodes with moved POIs. The stage has at least as many steps as the
    // world, so windows stay valid.
    let stages = match later.random_bool(0.2) {
        true => {
            let set = [
                ("world.steps", toml::Value::Integer(later.random_range(60..=70))),
                ("learning.poi_jitter", toml::Value::Float(1.5)),
                ("learning.episodes_per_team", toml::Value::Integer(later.random_range(1..=2))),
            ];
            vec![Stage { from: 2, set: set.map(|(key, value)| (key.to_string(), value)).into() }]
        }
        false => vec![],
    };
    let gain = |rng: &mut ChaCha8Rng, high: f64| if rng.random_bool(0.1) { 0.0 } else { rng.random_range(0.1..high) };
    let Config { world, learning, credit, checkpoint, .. } =
        Config::parse("[world]\nleaders = [[0, 0]]\npois = [[0, 0]]\ncoupling = 1", "the defaults")
            .expect("a valid config");
    Config {
        world: WorldConfig {
            map,
            leaders: starts[..leaders].to_vec(),
            followers: starts[leaders..].to_vec(),
            pois,
            coupling,
            observation_radius,
            steps: rng.random_range(20..=60),
            dt: [0.05, 0.2, 0.2, 0.5, 1.0][rng.random_range(0..5)],
            heading: Heading::Same(if exact || rng.random_bool(0.3) {
                quarter * f64::from(rng.random_range(-2..=2))
            } else {
                rng.random_range(-4.0..4.0)
            }),
            speed: if rng.random_bool(0.5) { min_speed } else { max_speed },
            ..world
        },
        motion: Motion {
            min_speed,
            max_speed,
            max_acceleration: [0.5, 5.0, 5.0, 100.0][rng.random_range(0..4)],
            max_turn_rate: match rng.random_range(0..8) {
                0 => 0.0,
                1 => 100.0,
                2 => rng.random_range(0.1..10.0),
                _ => quarter,
            },
        },
        follow: Follow {
            attraction_radius,
            repulsion_radius,
            attraction_gain: gain(rng, 10.0),
            repulsion_gain: gain(rng, 5.0),
            wall_gain: gain(rng, 5.0),
        },
        sense: Sense { poi_range, agent_range, density: word(rng), gain: 1.0 },
        policy: Policy {
            hidden: match rng.random_range(0..5) {
                0 => vec![],
                1 => vec![16, 7],
                2 => vec![5, 5, 5],
                _ => vec![10],
            },
            actions,
        },
        learning: Learning {
            paradigm: if rng.random_bool(0.25) { Paradigm::AllLeaders } else { Paradigm::LeaderFollower },
            sharing: match later.random_bool(0.2) {
                true => Sharing::Shared,
                false if seed % 4 == 1 => Sharing::Group,
                false => Sharing::PerLeader,
            },
            fitness: word(rng),
            population: rng.random_range(2..=20),
            generations: 3,
            trials: 1,
            initial: if seed % 5 == 2 { Initial::Uniform } else { Initial::Normal },
            initial_scale: if seed % 5 < 2 { 1.0 } else { 2.0 },
            mutation: if rng.random_bool(0.5) { Mutation::Scaled } else { Mutation::Additive },
            poi_jitter: if later.random_bool(0.3) { later.random_range(0.5..5.0) } else { 0.0 },
            test_episodes: usize::from(seed % 6 == 4),
            seed,
            ..learning
        },
        credit,
        checkpoint,
        agents: vec![],
        pois: vec![],
        stages,
    }
}

/// Returns a world in the short form for even seeds, else one with classes of agents.
pub fn any_world(seed: u64) -> Config {
    if seed.is_multiple_of(2) { world(seed) } else { classes_world(seed) }
}

/// Returns a valid config with 1 to 5 classes of agents and 1 to 4 groups of POIs, a pure function of the seed.
///
/// Places, map and learning are those of [`world`] for the same seed, so layouts are as degenerate. A hundred consecutive
/// seeds cover every control, motion, frame, measure and combination, terms with gains and with alignments, and groups with
/// values, radii, observers, windows and orders.
pub fn classes_world(seed: u64) -> Config {
    let mut config = plain_world(seed);
    // Keys that are not drawn below are those of the short form.
    let short = config.classes();
    let rng = &mut ChaCha8Rng::seed_from_u64(seed ^ 0x636c_6173);
    let starts = [&config.world.leaders[..], &config.world.followers].concat();
    let classes = rng.random_range(1..=starts.len().min(5));
    let learning = rng.random_range(1..=classes);
    let groups = rng.random_range(1..=config.world.pois.len().min(4));
    let names: Vec<String> =
        ["rover", "uav", "sheep-1", "dog_2", "X"][..classes].iter().map(|name| (*name).into()).collect();
    let group_names: Vec<String> = ["near", "far", "p-3", "q_4"][..groups].iter().map(|name| (*name).into()).collect();
    // In exact layouts, distances equal these exactly.
    let lengths = Lengths {
        pool: [
            config.follow.attraction_radius,
            config.follow.repulsion_radius,
            config.world.observation_radius,
            Some(config.sense.agent_range).filter(|range| range.is_finite()).unwrap_or(5.0),
            1.0,
            2.5,
        ],
    };
    let is_behaviours = config.policy.actions == Actions::Behaviours;
    let control = |class: usize| match class < learning {
        true => Control::Policy,
        false if rng.random_bool(0.8) => Control::Follow,
        false => Control::Still,
    };
    let controls: Vec<Control> = (0..classes).map(control).collect();
    let parts = split(rng, &starts, classes);
    let class = |(index, at): (usize, Vec<[f64; 2]>)| {
        let control = &controls[index];
        let motion = if rng.random_bool(0.35) && !(is_behaviours && *control == Control::Policy) {
            Mobility::Free { max_speed: [0.0, 0.5, 1.0, 3.0][rng.random_range(0..4)] }
        } else {
            let max_speed = [0.5, 3.0, 5.0][rng.random_range(0..3)];
            Mobility::Steered(Motion {
                min_speed: [0.0, 0.0, 0.25][rng.random_range(0..3)],
                max_speed,
                max_acceleration: [0.5, 5.0, 100.0][rng.random_range(0..3)],
                max_turn_rate: [0.0, 1.0, std::f64::consts::FRAC_PI_2, 100.0][rng.random_range(0..4)],
            })
        };
        let [slow, fast] = match &motion {
            Mobility::Steered(motion) => [motion.min_speed, motion.max_speed],
            Mobility::Free { max_speed } => [0.0, *max_speed],
        };
        let is_free = matches!(motion, Mobility::Free { .. });
        let heading = |rng: &mut ChaCha8Rng| match rng.random_bool(0.5) {
            true => std::f64::consts::FRAC_PI_2 * f64::from(rng.random_range(-2..=2)),
            false => rng.random_range(-4.0..4.0),
        };
        let heading = match rng.random_bool(0.5) {
            true => Heading::Same(heading(rng)),
            false => Heading::Each(at.iter().map(|_| heading(rng)).collect()),
        };
        // Those of a few classes are drawn.
        let heading = Some(heading).filter(|_| at.len() % 5 != 4);
        let mut senses = vec![];
        if *control == Control::Policy {
            let count = rng.random_range(1..=4);
            senses.extend((0..count).map(|_| channel(rng, is_free, &names, &group_names, &lengths)));
            if is_behaviours {
                let quadrants = |of: &str, channel: &Channel| Channel {
                    of: vec![of.into()],
                    pois: vec![],
                    sectors: Sectors::Equal(4),
                    frame: Frame::Heading,
                    ..channel.clone()
                };
                let [pois, agents] = [POIS, AGENTS].map(|of| quadrants(of, &senses[0]));
                senses.splice(0..0, [pois, agents]);
            }
            while senses.iter().map(|channel| channel.sectors.count()).sum::<usize>() > MAX_INPUTS {
                senses.pop();
            }
        }
        let mut rule = vec![];
        if *control == Control::Follow {
            let count = rng.random_range(1..=4);
            rule.extend((0..count).map(|_| term(rng, &names, &lengths)));
        }
        let others = names.iter().zip(&controls).filter(|(_, control)| **control != Control::Policy);
        let leads: Vec<String> = match control {
            Control::Policy => others.filter(|_| rng.random_bool(0.6)).map(|(name, _)| name.clone()).collect(),
            _ => vec![],
        };
        let needs_radius =
            names.iter().zip(&controls).any(|(name, control)| leads.contains(name) && *control == Control::Still);
        let influence_radius = (!leads.is_empty() && (needs_radius || rng.random_bool(0.5))).then(|| lengths.draw(rng));
        AgentClass {
            name: names[index].clone(),
            at,
            heading,
            speed: if rng.random_bool(0.5) { slow } else { fast },
            control: control.clone(),
            motion,
            senses,
            rule,
            wall_radius: if rng.random_bool(0.3) { 0.0 } else { lengths.draw(rng) },
            wall_gain: [0.0, 1.0, 4.0][rng.random_range(0..3)],
            leads,
            influence_radius,
            observes: rng.random_bool(0.8),
            ..short.agents[0].clone()
        }
    };
    let mut agents: Vec<AgentClass> = parts.into_iter().enumerate().map(class).collect();
    let mut order: Vec<usize> = (0..groups).collect();
    order.rotate_left(rng.random_range(0..groups));
    let steps = config.world.steps;
    let parts = split(rng, &config.world.pois, groups);
    let group = |(index, at): (usize, Vec<[f64; 2]>)| {
        let mut observers: Vec<String> = vec![];
        if rng.random_bool(0.4) {
            observers.extend(names.iter().filter(|_| rng.random_bool(0.5)).cloned());
        }
        let count = |observers: &[String]| {
            let counted = |class: &&AgentClass| match observers {
                [] => class.observes,
                _ => observers.contains(&class.name),
            };
            agents.iter().filter(counted).map(|class| class.size()).sum::<usize>()
        };
        if count(&observers) == 0 {
            observers = vec![names[0].clone()];
        }
        let most = count(&observers).min(5);
        let coupling = match rng.random_bool(0.5) {
            true => Coupling::Same(rng.random_range(1..=most)),
            false => Coupling::Each(at.iter().map(|_| rng.random_range(1..=most)).collect()),
        };
        let windows = match rng.random_bool(0.3) {
            true => {
                let window = |_: &_| {
                    let first = rng.random_range(1..=steps);
                    [first, rng.random_range(first..=steps)]
                };
                at.iter().map(window).collect()
            }
            false => vec![],
        };
        let place = order.iter().position(|&other| other == index).unwrap_or(0);
        let before = order[..place].iter().filter(|_| rng.random_bool(0.3));
        let after = before.map(|&other| group_names[other].clone()).collect();
        PoiGroup {
            name: group_names[index].clone(),
            value: [1.0, 0.5, 3.0][rng.random_range(0..3)],
            coupling,
            radius: lengths.draw(rng),
            observers,
            windows,
            after,
            at,
            ..short.pois[0].clone()
        }
    };
    let mut pois: Vec<PoiGroup> = parts.into_iter().enumerate().map(group).collect();
    if seed % 4 == 1 {
        pois.iter_mut().for_each(|group| group.gone_within = if rng.random() { lengths.draw(rng) } else { 0.0 });
    }
    if seed % 10 == 7 {
        let [width, height] = config.world.map;
        let middle = [width / 2.0, height / 2.0, width.min(height) / 4.0];
        for (class, region) in agents.iter_mut().zip([Region::Box([0.0, 0.0, width, height]), Region::Disc(middle)]) {
            (class.count, class.region, class.at) = (Some(class.size()), Some(region), vec![]);
        }
        let group = &mut pois[0];
        (group.count, group.region, group.at) = (Some(group.size()), Some(Region::Circle(middle)), vec![]);
    }
    if config.learning.sharing == Sharing::Group {
        let learners = agents.iter().filter(|class| class.learns()).map(|class| class.size()).sum();
        let of_group = |group: usize| (0..learners).filter(|learner| learner % 2 == group).collect();
        config.learning.groups = (0..learners.min(2)).map(of_group).collect();
    }
    (config.agents, config.pois) = (agents, pois);
    // Separate random streams, as in `world`.
    move_otherwise(&mut ChaCha8Rng::seed_from_u64(seed ^ 0x6d6f_7665), &mut config, &lengths);
    score_otherwise(&mut ChaCha8Rng::seed_from_u64(seed ^ 0x7061_7468), &mut config, &lengths);
    config.without_replaced()
}

/// Makes some classes move to or near agents of others, or stay in a part of the map, and some channels sense each agent
/// or POI.
fn move_otherwise(rng: &mut ChaCha8Rng, config: &mut Config, lengths: &Lengths) {
    let names: Vec<(String, usize)> = config.agents.iter().map(|class| (class.name.clone(), class.size())).collect();
    let groups: Vec<(String, usize)> = config.pois.iter().map(|group| (group.name.clone(), group.size())).collect();
    let behaves = config.policy.actions == Actions::Behaviours;
    let map = config.world.map;
    for class in &mut config.agents {
        let target = names[rng.random_range(0..names.len())].0.clone();
        if class.control == Control::Policy && rng.random_bool(0.25) {
            class.control = Control::Choose(target);
        } else if class.control == Control::Follow && rng.random_bool(0.35) {
            class.control = Control::Nearest(target);
            class.reach = rng.random_bool(0.6).then(|| lengths.draw(rng));
            class.rule.clear();
        }
        if rng.random_bool(0.2) {
            let corners = class.region.map(Region::corners).unwrap_or_default();
            let places = if class.region.is_some() { &corners[..] } else { &class.at };
            let margin = if rng.random_bool(0.3) { 0.0 } else { lengths.draw(rng) };
            let side = |axis: usize, most: f64| {
                let ends = places
                    .iter()
                    .map(|place| place[axis])
                    .fold([most, 0.0], |[low, high], at: f64| [at.min(low), at.max(high)]);
                [(ends[0] - margin).max(0.0), (ends[1] + margin).min(most)]
            };
            let [[x0, x1], [y0, y1]] = [side(0, map[0]), side(1, map[1])];
            class.stays_in = Some([x0, y0, x1, y1]);
        }
        for index in if behaves { 2 } else { 0 }..class.senses.len() {
            let channel = &class.senses[index];
            let has = |name: &str| channel.of.iter().any(|of| of == name);
            let is_named = |name: &String| channel.pois.is_empty() || channel.pois.contains(name);
            let count: usize = match has(POIS) {
                true => groups.iter().filter(|(name, _)| is_named(name)).map(|(_, size)| size).sum(),
                false => names.iter().filter(|(name, _)| has(AGENTS) || has(name)).map(|(_, size)| size).sum(),
            };
            let inputs = class.inputs() - channel.sectors.count() + count;
            if rng.random_bool(0.2) && inputs <= MAX_INPUTS {
                class.senses[index].sectors = Sectors::Each(count);
            }
        }
        let senses = |name: &str| class.senses.iter().any(|channel| channel.senses(name) && channel.range > 0.0);
        let near = names.iter().map(|(name, _)| name).find(|name| senses(name)).filter(|_| rng.random_bool(0.25));
        class.moves_near = near.cloned();
    }
    let is_ruleless = |class: &&AgentClass| class.rule.is_empty();
    let ruleless: Vec<String> = config.agents.iter().filter(is_ruleless).map(|class| class.name.clone()).collect();
    for class in &mut config.agents {
        if class.influence_radius.is_none() && class.leads.iter().any(|led| ruleless.contains(led)) {
            class.influence_radius = Some(lengths.draw(rng));
        }
    }
}

/// Sets the fitness of classes, and mostly scores that need paths.
fn score_otherwise(rng: &mut ChaCha8Rng, config: &mut Config, lengths: &Lengths) {
    let learns: Vec<(String, bool)> = config.agents.iter().map(|class| (class.name.clone(), class.learns())).collect();
    for class in config.agents.iter_mut().filter(|class| class.learns()) {
        class.fitness = rng.random_bool(0.3).then(|| word(rng));
    }
    config.credit.add_g = rng.random_bool(0.2);
    if rng.random_bool(0.4) {
        return;
    }
    for group in &mut config.pois {
        group.score = word(rng);
        group.when = if rng.random_bool(0.5) { When::Ever } else { word(rng) };
    }
    for class in config.agents.iter_mut().filter(|class| class.learns()) {
        let others = learns.iter().filter(|(_, learns)| *learns && rng.random_bool(0.5));
        class.leads.extend(others.map(|(name, _)| name.clone()));
        if !class.leads.is_empty() && class.influence_radius.is_none() {
            class.influence_radius = Some(lengths.draw(rng));
        }
    }
    config.world.start_counts = rng.random_bool(0.3);
    let (learners, agents) = (config.learners(), config.agent_count());
    if rng.random_bool(0.2) {
        let lists = if rng.random_bool(0.5) { 1 } else { learners };
        let list = |_| (0..agents).filter(|_| rng.random_bool(0.3)).collect();
        config.credit.removes = (0..lists).map(list).collect();
    }
    if !config.needs_paths().is_empty() {
        config.pois.iter_mut().for_each(|group| group.after.clear());
    }
}

/// Lengths for radii and ranges.
struct Lengths {
    pool: [f64; 6],
}

impl Lengths {
    fn draw(&self, rng: &mut ChaCha8Rng) -> f64 {
        if rng.random_bool(0.7) { self.pool[rng.random_range(0..self.pool.len())] } else { rng.random_range(0.2..15.0) }
    }
}

/// Splits places into consecutive parts, none of which is empty.
fn split(rng: &mut ChaCha8Rng, places: &[[f64; 2]], parts: usize) -> Vec<Vec<[f64; 2]>> {
    let mut rest = places;
    let part = |index: usize| {
        let most = rest.len() - (parts - 1 - index);
        let (part, others) = rest.split_at(if index + 1 == parts { rest.len() } else { rng.random_range(1..=most) });
        rest = others;
        part.to_vec()
    };
    (0..parts).map(part).collect()
}

/// Returns some names of classes, at least one.
fn some_names(rng: &mut ChaCha8Rng, names: &[String]) -> Vec<String> {
    let mut some: Vec<String> = names.iter().filter(|_| rng.random_bool(0.4)).cloned().collect();
    if some.is_empty() {
        some.push(names[rng.random_range(0..names.len())].clone());
    }
    some
}

fn channel(rng: &mut ChaCha8Rng, is_free: bool, names: &[String], groups: &[String], lengths: &Lengths) -> Channel {
    let of = match rng.random_range(0..3) {
        0 => vec![POIS.into()],
        1 => vec![AGENTS.into()],
        _ => some_names(rng, names),
    };
    let measure = word(rng);
    let is_finite = matches!(measure, Measure::Distance | Measure::Closeness);
    Channel {
        pois: if of == [POIS] && rng.random_bool(0.3) { some_names(rng, groups) } else { vec![] },
        of,
        sectors: Sectors::Equal([4, 4, 4, 1, 2, 3, 8, MAX_SECTORS][rng.random_range(0..8)]),
        frame: if is_free || rng.random_bool(0.3) { Frame::Map } else { Frame::Heading },
        range: match rng.random_range(0..10) {
            0 => 0.0,
            1..=3 if !is_finite => f64::INFINITY,
            _ => lengths.draw(rng),
        },
        measure,
        nearest: [1.0, 0.5, 2.0][rng.random_range(0..3)],
        combine: word(rng),
        empty: [0.0, 0.0, -1.0, 1.0][rng.random_range(0..4)],
        gain: [1.0, 0.5, 3.0][rng.random_range(0..3)],
    }
}

fn term(rng: &mut ChaCha8Rng, names: &[String], lengths: &Lengths) -> Term {
    let [a, b] = [lengths.draw(rng), lengths.draw(rng)];
    let size = if rng.random_bool(0.1) { 0.0 } else { rng.random_range(0.1..10.0) };
    let size = if rng.random_bool(0.4) { 0.0 - size } else { size };
    let is_gain = rng.random_bool(0.7);
    Term {
        of: if rng.random_bool(0.5) { vec![AGENTS.into()] } else { some_names(rng, names) },
        from: if rng.random_bool(0.5) { 0.0 } else { a.min(b) },
        to: a.max(b),
        gain: is_gain.then_some(size),
        align: (!is_gain).then_some(size),
    }
}

/// Draws how the policies of a valid config are selected and teamed, and whether starts vary. A hundred consecutive seeds
/// cover every method, kind of teams, parents and leniency, several partners, a hall of fame, and elites of teams.
pub fn learn_otherwise(seed: u64, config: &mut Config) {
    let rng = &mut ChaCha8Rng::seed_from_u64(seed ^ 0x6c65_6172);
    // Combinations that are not allowed are drawn again.
    for _ in 0..50 {
        let mut drawn = config.clone();
        let few = |rng: &mut ChaCha8Rng| if rng.random() { 0 } else { rng.random_range(1..=2) };
        drawn.learning = Learning {
            method: if rng.random() { Method::Tournament } else { word(rng) },
            teams: word(rng),
            temperature: [0.1, 1.0][rng.random_range(0..2)],
            team_elites: few(rng),
            team_g_elites: few(rng),
            hall_of_fame: few(rng),
            partners: 1 + few(rng),
            leniency: word(rng),
            parents: word(rng),
            elites: Elites::Count(rng.random_range(1..=config.learning.population)),
            // Most worlds keep the ties of their layouts.
            start_jitter: if rng.random_bool(0.8) { 0.0 } else { rng.random_range(0.0..2.0) },
            ..config.learning.clone()
        };
        if drawn.validate().is_ok() {
            *config = drawn;
            return;
        }
    }
}

/// Returns a random word of a choice.
fn word<T: Choice>(rng: &mut ChaCha8Rng) -> T {
    T::ALL[rng.random_range(0..T::ALL.len())].1
}

/// Returns weights `[leaders][policies][parameters]` that are approximately normal. Some policies have only small
/// weights, only large ones, or mostly zeros.
pub fn weights(world: &World, policies: usize, seed: u64) -> Vec<f32> {
    let rng = &mut ChaCha8Rng::seed_from_u64(seed);
    let mut weights = Vec::with_capacity(world.leaders() * policies * world.parameters());
    for _ in 0..world.leaders() * policies {
        let (scale, zeros) = match rng.random_range(0..8) {
            0 => (0.1, 0.0),
            1 => (4.0, 0.0),
            2 => (1.0, 0.8),
            _ => (1.0, 0.0),
        };
        weights.extend((0..world.parameters()).map(|_| {
            // The sum of twelve uniform numbers minus 6 has variance 1. It needs no function that platforms round
            // differently.
            let normal = (0..12).map(|_| rng.random::<f32>()).sum::<f32>() - 6.0;
            let weight = if rng.random_bool(zeros) { 0.0 } else { scale * normal };
            // Smaller weights become 0, so that no product in the kernels is denormal.
            if weight.abs() < MIN_WEIGHT { 0.0 } else { weight }
        }));
    }
    weights
}
