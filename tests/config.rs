//! Tests that configs have the documented defaults, survive a round trip, and are refused with precise messages.
//!
//! Property tests generate valid configs and mangled text. No text may make the parser panic.

use std::path::Path;

use crate::support::{GOOD, table, with_line};
use flotilla::config::{
    Actions, CheckpointConfig, Config, ConfigError, Coupling, CreditConfig, Density, Elites, Fitness, Follow, Heading,
    Initial, Learning, LedBy, Leniency, MAX_EPISODES, MAX_GENERATIONS, MAX_HALL_OF_FAME, MAX_HIDDEN_LAYERS,
    MAX_HIDDEN_UNITS, MAX_PARTNERS, MAX_POPULATION, MAX_STEPS, MAX_TRIALS, Method, Motion, Mutation, Observers,
    Override, Paradigm, Parents, Policy, Problem, Sense, Sharing, Teams, WorldConfig,
};
use flotilla::reader::Document;
use proptest::collection::vec;
use proptest::prelude::*;

const SMALLEST: &str = "[world]\nleaders = [[1, 2]]\npois = [[3, 4]]\n";
const LAYOUTS: [&str; 3] = ["generally_forward", "strictly_forward", "chaotic"];

fn problems(text: &str) -> Vec<Problem> {
    match Config::parse(text, "test.toml") {
        Err(ConfigError::Invalid { problems, .. }) => problems,
        other => panic!("expected problems, got {other:?}"),
    }
}

#[test]
fn every_key_but_leaders_and_pois_has_its_default() {
    let config = Config::parse(SMALLEST, "test.toml").unwrap();
    let expected = Config {
        world: WorldConfig {
            map: [50.0, 50.0],
            leaders: vec![[1.0, 2.0]],
            followers: vec![],
            pois: vec![[3.0, 4.0]],
            coupling: Coupling::Same(1), // 3 with three or more agents
            observation_radius: 5.0,
            observers: Observers::All,
            windows: vec![],
            after: vec![],
            steps: 25,
            start_counts: false,
            dt: 0.2,
            heading: Heading::Same(std::f64::consts::FRAC_PI_2),
            speed: 0.0,
        },
        motion: Motion {
            min_speed: 0.0,
            max_speed: 3.0,
            max_acceleration: 5.0,
            max_turn_rate: std::f64::consts::FRAC_PI_2,
        },
        follow: Follow {
            attraction_radius: 5.0,
            repulsion_radius: 1.0,
            attraction_gain: 5.0,
            repulsion_gain: 1.0,
            wall_gain: 1.0,
        },
        sense: Sense { poi_range: f64::INFINITY, agent_range: 5.0, density: Density::Linear, gain: 1.0 },
        policy: Policy { hidden: vec![10], actions: Actions::Direct },
        learning: Learning {
            paradigm: Paradigm::LeaderFollower,
            sharing: Sharing::PerLeader,
            groups: vec![],
            fitness: Fitness::Df,
            population: 50,
            partners: 1,
            teams: Teams::Random,
            temperature: 1.0,
            hall_of_fame: 0,
            leniency: Leniency::Mean,
            generations: 100,
            trials: 5,
            initial: Initial::Normal,
            initial_scale: 1.0,
            elites: Elites::Count(1),
            team_elites: 0,
            team_g_elites: 0,
            parents: Parents::All,
            method: Method::Tournament,
            search_sigma: 0.3,
            search_step: 1.0,
            mutation: Mutation::Scaled,
            mutation_probability: 0.15,
            mutation_sigma: 0.1,
            episodes_per_team: 1,
            start_jitter: 0.0,
            poi_jitter: 0.0,
            test_episodes: 0,
            seed: 0,
        },
        credit: CreditConfig { led_by: LedBy::MostSeen, led_within: 0, removes: vec![], add_g: false },
        checkpoint: CheckpointConfig { generations: 0, seconds: 30.0 },
        agents: vec![],
        pois: vec![],
        stages: vec![],
    };
    assert_eq!(config, expected);
}

#[test]
fn layout_configs_match_the_paper() {
    for (name, groups, offsets, coupling, steps) in [
        (LAYOUTS[0], vec![10.0, 20.0, 30.0, 40.0], vec![[2.0, -3.0], [-2.0, -3.0]], 3, 25),
        (LAYOUTS[1], vec![10.0, 40.0], vec![[2.0, -3.0], [-2.0, -3.0]], 3, 25),
        (LAYOUTS[2], vec![10.0, 20.0, 30.0, 40.0], vec![[2.0, -3.0], [-2.0, -3.0], [2.0, 2.0], [-2.0, 2.0]], 5, 50),
    ] {
        let config = Config::load(Path::new(&format!("configs/{name}.toml"))).unwrap();
        let place = |y: f64| groups.iter().map(|&x| [x, y]).collect::<Vec<_>>();
        let followers: Vec<[f64; 2]> =
            groups.iter().flat_map(|x| offsets.iter().map(move |[dx, dy]| [x + dx, 5.0 + dy])).collect();
        let mut expected = Config::parse(SMALLEST, "test.toml").unwrap();
        expected.world.leaders = place(5.0);
        expected.world.followers = followers;
        expected.world.pois = place(15.0);
        expected.world.coupling = Coupling::Same(coupling);
        expected.world.steps = steps;
        assert_eq!(config, expected, "{name}");
    }
}

#[test]
fn an_unlimited_range_is_written_as_inf_and_read_back() {
    let mut config =
        Config::parse(&format!("{SMALLEST}[sense]\nagent_range = inf\npoi_range = 7"), "test.toml").unwrap();
    assert_eq!((config.sense.agent_range, config.sense.poi_range), (f64::INFINITY, 7.0));
    config.sense.poi_range = f64::INFINITY;
    assert!(config.to_toml().contains("poi_range = inf\nagent_range = inf\n"));
    assert_eq!(Config::parse(&config.to_toml(), "again.toml"), Ok(config));
}

#[test]
fn defaults_are_clamped_to_explicit_values() {
    let text = format!("{SMALLEST}[motion]\nmin_speed = 1\n[follow]\nattraction_radius = 0.5\n");
    let config = Config::parse(&text, "test.toml").unwrap();
    assert_eq!((config.world.speed, config.follow.repulsion_radius), (1.0, 0.5));
}

#[test]
fn minus_zero_is_read_as_zero() {
    let config = Config::parse(&format!("{SMALLEST}speed = -0.0\nheading = -0.0"), "test.toml").unwrap();
    assert!(config.world.speed.is_sign_positive() && config.world.headings()[0].is_sign_positive());
}

#[test]
fn a_wrong_value_is_the_only_problem_reported() {
    for (text, key) in [
        ("[world]\nmap = [1e9, 50]\nleaders = [[900, 2]]\npois = [[3, 4]]", "world.map[0]"),
        ("[world]\nleaders = 3\npois = [[3, 4]]\ncoupling = 7", "world.leaders"),
        ("[world]\nleaders = [[3, 4]]\npois = 3\ncoupling = [1, 1, 1]", "world.pois"),
        ("[world]\nleaders = [[3, 4]]\npois = 3\nafter = [[7], [1]]\nwindows = [[1, 2]]", "world.pois"),
        (&format!("{SMALLEST}speed = 2\n[motion]\nmin_speed = 'x'"), "motion.min_speed"),
        (&format!("{SMALLEST}[motion]\nmax_speed = -1\nmin_speed = 9"), "motion.max_speed"),
        (&format!("{SMALLEST}[follow]\nattraction_radius = nan\nrepulsion_radius = 9"), "follow.attraction_radius"),
        (&format!("{SMALLEST}[learning]\npopulation = 1\nelites = 9"), "learning.population"),
    ] {
        let keys: Vec<String> = problems(text).into_iter().map(|problem| problem.key).collect();
        assert_eq!(keys, [key], "{text}");
    }
}

#[test]
fn overrides_are_validated_with_the_file_and_named_by_their_source() {
    let text = format!("{SMALLEST}coupling = 2");
    let follower = Override::new("world.followers", vec![vec![5.0, 5.0]], "grid \"world.followers\"");
    assert!(Config::parse(&text, "test.toml").is_err(), "one agent cannot satisfy a coupling of 2");
    let config = Config::read(&text, "test.toml", &[], std::slice::from_ref(&follower)).unwrap();
    assert_eq!(config.world.coupling, Coupling::Same(2));
    let error = Config::read(
        &text,
        "test.toml",
        &[],
        &[
            follower,
            Override::new("learning.population", 1, "--population"),
            Override::new("world.pois", vec![vec![5.0, 51.0]], "grid \"world.pois\""),
            Override::new("world.dtt", 1, "grid \"world.dtt\""),
        ],
    );
    assert_eq!(
        error.unwrap_err().to_string(),
        "3 problems in test.toml\n\
         grid \"world.pois\"[0][1]: found 51.0, allowed 0 to 50 (the map)\n\
         --population: found 1, allowed 2 to 1048576\n\
         grid \"world.dtt\": unknown key, did you mean `world.dt`?"
    );
    let changed = config.with(&[Override::new("learning.fitness", "D++", "--fitness")]).unwrap();
    assert_eq!(changed.learning.fitness, Fitness::Dpp);
}

#[test]
fn unknown_sections_are_ignored_only_when_listed() {
    let text = format!("{SMALLEST}[grid]\n\"world.coupling\" = [1, 2]\n");
    assert_eq!(problems(&text)[0].key, "grid");
    assert_eq!(Config::read(&text, "test.toml", &["grid"], &[]), Config::parse(SMALLEST, "test.toml"));
}

#[test]
fn a_quoted_dotted_key_is_not_a_nested_key() {
    let found = problems(&format!("\"world.dt\" = 0.1\n{SMALLEST}"));
    assert_eq!((found.len(), found[0].line, found[0].key.as_str()), (1, Some(1), "world.dt"));
}

#[test]
fn long_lists_of_problems_are_truncated() {
    let text = format!("[world]\npois = [[1, 1]]\nleaders = [{}]", "[-1, -1],".repeat(1000));
    let message = Config::parse(&text, "test.toml").unwrap_err().to_string();
    assert_eq!(message.lines().count(), 52);
    assert!(message.starts_with("2000 problems in test.toml\n") && message.ends_with("… and 1950 more"), "{message}");
}

/// Generates a size from `low` to `high`, uniform in its logarithm.
fn size(low: f64, high: f64) -> impl Strategy<Value = f64> {
    (0.0..=1.0f64).prop_map(move |t| (low * (high / low).powf(t)).clamp(low, high))
}

fn size_or_zero(low: f64, high: f64) -> impl Strategy<Value = f64> {
    prop_oneof![1 => Just(0.0), 4 => size(low, high)]
}

/// Generates any value of a key that has a fixed list of values.
fn choice<T: flotilla::config::Choice + std::fmt::Debug>() -> impl Strategy<Value = T> {
    (0..T::ALL.len()).prop_map(|index| T::ALL[index].1)
}

/// Generates valid `[world]` and `[motion]` sections.
fn worlds() -> impl Strategy<Value = (WorldConfig, Motion)> {
    let speeds = (size_or_zero(1e-6, 1e3), 0.0..=1.0, 0.0..=1.0).prop_map(|(max, a, b): (f64, f64, f64)| {
        // Positive speeds below 1e-6 are not valid.
        let valid = |speed: f64| if speed < 1e-6 { 0.0 } else { speed };
        let min = valid(max * a);
        (min, valid(min + (max - min) * b).clamp(min, max), max)
    });
    (size(1.0, 1e4), size(1.0, 1e4), 1..20usize, 0..20usize, 1..9usize, speeds).prop_flat_map(
        |(x, y, leaders, followers, pois, (min_speed, speed, max_speed))| {
            let places =
                move |count| vec((size_or_zero(1e-6, x), size_or_zero(1e-6, y)).prop_map(|(x, y)| [x, y]), count);
            let coupling = choice().prop_flat_map(move |observers| {
                let (observers, most) = match observers {
                    Observers::All => (observers, leaders + followers),
                    Observers::Followers if followers > 0 => (observers, leaders.min(followers)),
                    _ => (Observers::Leaders, leaders),
                };
                let each = vec(1..=most, pois).prop_map(Coupling::Each);
                (prop_oneof![(1..=most).prop_map(Coupling::Same), each], Just(observers))
            });
            let rest = (size(0.01, 1e4), 1..=MAX_STEPS, size(1e-4, 10.0));
            let rules = (vec((0.0..=1.0f64, 0.0..=1.0f64), pois), vec(vec(any::<bool>(), pois), pois), 0..4usize);
            let heading = prop_oneof![
                (-1e3..=1e3).prop_map(Heading::Same),
                vec(-1e3..=1e3, leaders).prop_map(Heading::Each),
                vec(-1e3..=1e3, leaders + followers).prop_map(Heading::Each),
            ];
            let rest = (rest, rules, heading);
            let motion = (size_or_zero(1e-3, 1e3), size_or_zero(1e-3, 1e3));
            (places(leaders), places(followers), places(pois), coupling, rest, motion).prop_map(
                move |(leaders, followers, pois, (coupling, observers), (rest, rules, heading), motion)| {
                    let ((observation_radius, steps, dt), (parts, follows, kind), heading) = (rest, rules, heading);
                    let map = [x, y];
                    let step = |part: f64| 1 + (part * (steps - 1) as f64) as usize;
                    let windows: Vec<_> =
                        parts.iter().map(|&(a, b)| [step(a.min(b)), step(a.max(b))]).filter(|_| kind & 1 > 0).collect();
                    let before = |(poi, follows): (usize, Vec<bool>)| {
                        (0..poi).filter(|&other| follows[other]).collect::<Vec<_>>()
                    };
                    let after: Vec<_> = follows.into_iter().enumerate().map(before).filter(|_| kind & 2 > 0).collect();
                    (
                        WorldConfig {
                            map,
                            leaders,
                            followers,
                            pois,
                            coupling,
                            observation_radius,
                            observers,
                            windows,
                            start_counts: after.is_empty() && kind & 1 > 0,
                            after,
                            steps,
                            dt,
                            heading,
                            speed,
                        },
                        Motion { min_speed, max_speed, max_acceleration: motion.0, max_turn_rate: motion.1 },
                    )
                },
            )
        },
    )
}

/// Generates valid configs without stages.
fn configs() -> impl Strategy<Value = Config> {
    let gain = || size_or_zero(1e-3, 1e3);
    let follow = (size(0.01, 1e4), 0.0..=1.0, gain(), gain(), gain()).prop_map(
        |(attraction_radius, part, attraction_gain, repulsion_gain, wall_gain): (f64, f64, f64, f64, f64)| Follow {
            attraction_radius,
            repulsion_radius: (attraction_radius * part).max(0.01),
            attraction_gain,
            repulsion_gain,
            wall_gain,
        },
    );
    let range = || prop_oneof![Just(0.0), Just(f64::INFINITY), size(0.01, 1e4)];
    let sense = (range(), range(), choice(), size(1e-3, 1e3))
        .prop_map(|(poi_range, agent_range, density, gain)| Sense { poi_range, agent_range, density, gain });
    let policy = (vec(1..=MAX_HIDDEN_UNITS, 0..=MAX_HIDDEN_LAYERS), choice())
        .prop_map(|(hidden, actions)| Policy { hidden, actions });
    let elites = prop_oneof![(0.0..=1.0f64).prop_map(Ok), size(1e-3, 100.0).prop_map(Err)];
    let teams = (2..=5000usize, 1..=MAX_PARTNERS, 0..=MAX_HALL_OF_FAME, choice());
    let sizes = (teams, 0..=MAX_GENERATIONS, 1..=9usize, (elites, choice()), 1..=MAX_EPISODES);
    let mutation = (choice(), size_or_zero(1e-6, 1.0), size_or_zero(1e-6, 100.0));
    let credit = (choice(), 0..=MAX_STEPS, proptest::bool::ANY).prop_map(|(led_by, led_within, add_g)| CreditConfig {
        led_by,
        led_within,
        removes: vec![],
        add_g,
    });
    let search = (choice(), size(1e-6, 100.0), size(1e-6, 100.0));
    let first = (choice(), size(1e-6, 1e3), 0..=MAX_EPISODES);
    let forming = (choice(), size(1e-6, 1e6), 0..=3usize, 0..=3usize);
    let jitters = (size_or_zero(1e-6, 1e4), size_or_zero(1e-6, 1e4));
    let added = (jitters, first, forming);
    let learning = ((choice(), choice()), choice(), sizes, (mutation, search), added, 0..=i64::MAX as u64).prop_map(
        |(
            (paradigm, sharing),
            fitness,
            ((population, partners, hall_of_fame, leniency), generations, trials, (part, parents), episodes_per_team),
            (mutation, (method, search_sigma, search_step)),
            ((start_jitter, poi_jitter), (initial, initial_scale, test_episodes), (teams, temperature, kept, by_g)),
            seed,
        )| {
            let (mutation, mutation_probability, mutation_sigma) = mutation;
            // Teams are chosen only in simple tournaments of several populations, whose policies play once.
            let chosen = sharing != Sharing::Shared && method == Method::Tournament && partners == 1 && population > 20;
            let (teams, kept, by_g) = if chosen { (teams, kept, by_g) } else { (Teams::Random, 0, 0) };
            let chosen = teams != Teams::Random || kept + by_g > 0;
            Learning {
                paradigm,
                sharing,
                groups: vec![],
                fitness,
                population,
                partners: if sharing == Sharing::Shared { 1 } else { partners },
                // A hall of fame requires leaders with partners and the tournament method.
                hall_of_fame: match sharing == Sharing::Shared || method != Method::Tournament || chosen {
                    true => 0,
                    false => hall_of_fame,
                },
                teams,
                temperature,
                leniency,
                generations,
                trials,
                initial,
                initial_scale,
                elites: match part {
                    _ if kept + by_g > 0 => Elites::Count(1),
                    Ok(part) => Elites::Count((population as f64 * part) as usize),
                    Err(percentage) => Elites::Percentage(percentage),
                },
                team_elites: kept,
                team_g_elites: by_g,
                parents,
                method,
                search_sigma,
                search_step,
                mutation,
                mutation_probability,
                mutation_sigma,
                episodes_per_team,
                start_jitter,
                poi_jitter,
                test_episodes,
                seed,
            }
        },
    );
    let checkpoint = (0..=MAX_GENERATIONS, prop_oneof![Just(0.0), 0.01..=1e9])
        .prop_map(|(generations, seconds)| CheckpointConfig { generations, seconds });
    (worlds(), follow, sense, policy, learning, (credit, checkpoint)).prop_map(
        |((mut world, motion), follow, sense, policy, mut learning, (credit, checkpoint))| {
            if learning.elites == Elites::Count(0) {
                learning.parents = Parents::All;
            }
            if learning.paradigm == Paradigm::AllLeaders && world.observers == Observers::Followers {
                world.observers = Observers::Leaders;
            }
            let mut config = Config {
                world,
                motion,
                follow,
                sense,
                policy,
                learning,
                credit,
                checkpoint,
                agents: vec![],
                pois: vec![],
                stages: vec![],
            };
            if config.populations() == 1 {
                let Learning { partners, hall_of_fame, teams, team_elites, team_g_elites, .. } = &mut config.learning;
                (*partners, *hall_of_fame, *teams, *team_elites, *team_g_elites) = (1, 0, Teams::Random, 0, 0);
            }
            config
        },
    )
}

/// Generates a piece of text: mostly one that has a meaning in TOML or in a config.
fn token() -> impl Strategy<Value = String> {
    let known = "[ ] [[ ]] = , . # \" ''' { } inf -inf nan -0.0 1e999 -1 0 3 0x7f \
                 99999999999999999999 1e-40 true 1979-05-27 [world] [learning] [grid] \
                 world.dt leaders pois coupling hidden = [] [[1,2],[3]] é \u{1f6a2}";
    let known: Vec<String> = known.split(' ').map(str::to_string).chain(["\n".into(), "\\u0000".into()]).collect();
    prop_oneof![4 => (0..known.len()).prop_map(move |index| known[index].clone()), 1 => "\\PC{0,6}"]
}

#[test]
fn learners_share_the_population_of_their_group() {
    let text = "[world]\nleaders = [[10, 5], [20, 5]]\nfollowers = [[21, 2], [11, 2], [15, 5]]\npois = [[9, 9]]\n\
                coupling = 1\n[learning]\n";
    let populations = |keys: &str| {
        let config = Config::parse(&format!("{text}{keys}"), "groups.toml").unwrap();
        assert_eq!(Config::parse(&config.to_toml(), "again.toml").unwrap(), config);
        (config.populations(), config.population_of_each())
    };
    let all = "paradigm = 'all-leaders'\n";
    assert_eq!(populations(all), (5, vec![0, 1, 2, 3, 4]));
    assert_eq!(populations(&format!("{all}sharing = 'all'")), (1, vec![0; 5]));
    // The last follower's place is as far from both leaders.
    assert_eq!(populations(&format!("{all}sharing = 'group'")), (2, vec![0, 1, 1, 0, 0]));
    assert_eq!(populations("sharing = 'group'"), (2, vec![0, 1]));
    assert_eq!(populations("sharing = 'group'\ngroups = [[1, 0]]"), (1, vec![0, 0]));
    assert_eq!(
        populations(&format!("{all}sharing = 'group'\ngroups = [[4], [1, 0], [3, 2]]")),
        (3, vec![1, 1, 2, 2, 0])
    );
    // With classes, each is a group.
    let classes = "[[agents]]\nname = 'rover'\nat = [[1, 5], [2, 5]]\nsenses = [{ of = 'pois' }]\n\
                   [[agents]]\nname = 'drone'\nat = [[3, 5]]\nsenses = [{ of = 'pois' }]\n\
                   [[agents]]\nname = 'sheep'\nat = [[1, 9]]\ncontrol = 'still'\n\
                   [[pois]]\nname = 'poi'\nat = [[9, 9]]\n[learning]\nsharing = 'group'";
    let config = Config::parse(classes, "classes.toml").unwrap();
    assert_eq!(config.population_of_each(), [0, 0, 1]);
    let config = Config::parse(&format!("{text}{all}sharing = 'group'"), "groups.toml").unwrap();
    let of = |populations| config.populations_for(populations);
    assert_eq!([of(1), of(2), of(3), of(5)].map(|of| of.map(|of| of[2])), [Some(0), Some(1), None, Some(2)]);
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_config_survives_a_round_trip_through_toml(config in configs()) {
        let text = config.to_toml();
        prop_assert_eq!(Config::parse(&text, "test.toml"), Ok(config), "{}", text);
    }

    /// Checks that no constant is infinite, NaN or denormal. The exact arithmetic depends on it.
    #[test]
    fn a_valid_config_makes_normal_constants(config in configs()) {
        let world = flotilla::world::World::new(&config.validate().unwrap());
        let headings = world.headings.iter().flat_map(|heading| heading.to_array());
        let mut numbers: Vec<f32> = headings.chain(world.radii2.iter().copied()).collect();
        for class in &world.classes {
            let constants = &class.constants;
            numbers.extend(bytemuck::cast_slice::<_, f32>(std::slice::from_ref(&constants.motion)));
            numbers.extend(bytemuck::cast_slice::<_, f32>(std::slice::from_ref(&constants.rule)));
            numbers.extend(constants.influence2);
            for channel in class.channels() {
                numbers.extend([channel.range2, channel.base, channel.slope, channel.nearest2, channel.scale]);
                numbers.extend(channel.boundaries);
            }
            numbers.extend(class.terms().iter().flat_map(|term| [term.inner2, term.outer2, term.scale]));
        }
        for value in numbers {
            prop_assert!(value == 0.0 || (2f32.powi(-100)..=1e30).contains(&value.abs()), "{:?}", world.classes);
        }
        let c = &world.constants;
        prop_assert_eq!(config.parameters(), c.policy.parameters as usize);
        prop_assert_eq!(config.learners(), c.leaders as usize);
    }

    #[test]
    fn mangled_bytes_never_panic(
        layout in 0..LAYOUTS.len(),
        edits in vec((any::<prop::sample::Index>(), 0..12usize, token()), 1..6),
    ) {
        let mut text = std::fs::read_to_string(format!("configs/{}.toml", LAYOUTS[layout])).unwrap().into_bytes();
        for (at, cut, token) in edits {
            let at = at.index(text.len() + 1);
            let end = (at + cut).min(text.len());
            text.splice(at..end, token.into_bytes());
        }
        let text = String::from_utf8_lossy(&text);
        if let Err(error) = Config::parse(&text, "test.toml") {
            prop_assert!(error.to_string().contains("test.toml"));
        }
    }

    /// Sets one key of a valid config to an arbitrary value. An error has to name the value found.
    #[test]
    fn one_changed_value_is_accepted_or_refused(
        config in configs(),
        key in any::<prop::sample::Index>(),
        value in token(),
    ) {
        let table: toml::Table = config.to_toml().parse().unwrap();
        let keys: Vec<String> = table
            .iter()
            .flat_map(|(section, keys)| keys.as_table().unwrap().keys().map(move |key| format!("{section}.{key}")))
            .collect();
        let key = &keys[key.index(keys.len())];
        if let Ok(value) = format!("x = {value}").parse::<toml::Table>() {
            let changed = Override::new(key, value["x"].clone(), "the change");
            if let Err(error) = config.with(&[changed]) {
                prop_assert!(error.to_string().contains("found"), "{}: {}", key, error);
            }
        }
    }
}

#[test]
fn counts_at_their_limits_are_valid() {
    let many = |count: usize| format!("[{}]", "[1, 1],".repeat(count));
    let text = format!(
        "[world]\nleaders = {}\nfollowers = {}\npois = {}\nsteps = {MAX_STEPS}\ncoupling = 1024\n\
         [policy]\nhidden = [64, 64, 64]\n[learning]\npopulation = 2\ntrials = 7\nseed = 9223372036854775807",
        many(1000),
        many(24),
        many(256)
    );
    let config = Config::parse(&text, "test.toml").unwrap();
    assert_eq!(config.learning.seed, i64::MAX as u64);
    assert_eq!(Config::parse(&config.to_toml(), "again.toml"), Ok(config));
    let (leaders, followers) = (many(1000), many(25));
    let text = format!(
        "[world]\nleaders = {leaders}\nfollowers = {followers}\npois = [[1, 1]]\n[learning]\nparadigm = 'all-leaders'"
    );
    let [Problem { key, message, .. }] = &problems(&text)[..] else { panic!("{text}") };
    assert_eq!((&**key, &**message), ("world.followers", "found 1025 agents with the leaders, allowed 1 to 1024"));
    for (key, most) in [("population", MAX_POPULATION), ("trials", MAX_TRIALS), ("generations", MAX_GENERATIONS)] {
        let text = |value: usize| format!("{SMALLEST}[learning]\n{key} = {value}");
        assert!(Config::parse(&text(most), "test.toml").is_ok());
        assert_eq!(problems(&text(most + 1))[0].key, format!("learning.{key}"));
    }
}

/// Each message has the line, the key, the value found and the allowed values.
#[test]
fn wrong_values_are_reported_with_line_and_range() {
    let message = |text: String| Config::parse(&text, "x.toml").expect_err(&text).to_string();
    for [line, text, expected] in table(include_str!("data/refusals/keys.txt"), 106) {
        let found = message(with_line(line.parse().unwrap(), &text));
        assert_eq!(found.lines().next(), Some(&*format!("x.toml:{line}: {expected}")), "{text}");
    }
    let many = |count: usize| format!("[{}]", vec!["[1, 1]"; count].join(", "));
    for (line, key, count, allowed) in
        [(3, "leaders", 1025, "1 to 1024"), (5, "pois", 257, "1 to 256"), (4, "followers", 1026, "0 to 1023")]
    {
        let problem = format!("found a list of {count}, allowed a list of {allowed} positions [x, y]");
        let found = message(with_line(line, &format!("{key} = {}", many(count))));
        assert_eq!(found.lines().next(), Some(&*format!("x.toml:{line}: world.{key}: {problem}")));
    }
    let crowd =
        GOOD.replace("[[12, 2], [8, 2], [22, 2], [18, 2]]", &many(1023)).replace("[[10, 5], [20, 5]]", &many(5));
    let agents = "found 1028 agents with the leaders, allowed 1 to 1024";
    assert_eq!(message(crowd), format!("x.toml:4: world.followers: {agents}"));
    for (key, problem) in [
        ("hall_of_fame = 3", "hall_of_fame: found 3 with a single leader, allowed 0: it has no partners"),
        ("partners = 2", "partners: found 2 with a single leader, allowed 1: it has no partners"),
        ("teams = 'sorted'", "teams: found \"sorted\" with a single leader, allowed \"random\": it has no partners"),
    ] {
        let single = GOOD.replace("[[10, 5], [20, 5]]", "[[10, 5]]") + key + "\n";
        assert_eq!(message(single), format!("x.toml:24: learning.{problem}"));
    }
}

/// Errors in observers, windows and order name the line and the index in the list.
#[test]
fn impossible_rules_are_refused_with_their_line_and_index() {
    let world = |rest: &str| {
        format!("[world]\nleaders = [[1, 2], [2, 2]]\nfollowers = [[1, 1]]\npois = [[3, 4], [5, 6], [7, 8]]\n{rest}")
    };
    for [rest, expected] in table(include_str!("data/refusals/rules.txt"), 18) {
        let error = Config::parse(&world(&rest), "rules.toml").expect_err(&rest).to_string();
        assert!(error.starts_with(&format!("rules.toml:{expected}")) && !error.contains('\n'), "{rest}: {error}");
    }
    let without_followers = "[world]\nleaders = [[1, 2]]\npois = [[3, 4]]\nobservers = 'followers'";
    let error = Config::parse(without_followers, "rules.toml").unwrap_err().to_string();
    assert_eq!(
        error,
        "rules.toml:4: world.observers: found \"followers\", but there are no followers, so nobody would observe"
    );
    // The same conflict, caused by a flag.
    let flag = Override::new("learning.paradigm", "all-leaders", "--paradigm");
    let text = world("observers = 'followers'");
    assert!(Config::read(&text, "rules.toml", &[], &[flag]).is_err());
    assert_eq!(Config::parse(&text, "rules.toml").unwrap().world.coupling, Coupling::Same(1));
}

/// A single heading applies to all agents. With one heading per leader, each follower gets that of the nearest leader,
/// and of the first one on a tie. With one heading per agent, each agent gets its own.
#[test]
fn followers_start_with_the_heading_of_the_nearest_leader() {
    let text = |heading: &str| {
        format!(
            "[world]\nleaders = [[10, 10], [20, 10]]\nfollowers = [[21, 10], [9, 10], [15, 10]]\npois = [[1, 1]]\n\
             heading = {heading}"
        )
    };
    let headings = |heading: &str| Config::parse(&text(heading), "headings").unwrap().world.headings();
    assert_eq!(headings("1.5"), [1.5; 5]);
    assert_eq!(headings("[1.0, 2.0]"), [1.0, 2.0, 2.0, 1.0, 1.0]);
    assert_eq!(headings("[1, 2, 3, 4, 5]"), [1.0, 2.0, 3.0, 4.0, 5.0]);
    let turned = Config::parse(&text("[0, 3.141592653589793]"), "headings").unwrap();
    let world = flotilla::world::World::new(&turned.validate().unwrap());
    let x: Vec<f32> = world.headings.iter().map(|heading| heading.x).collect();
    assert_eq!(x, [1.0, -1.0, -1.0, 1.0, 1.0]);
}

/// Returns the notes about a config with one leader, one follower and one POI, and `world` appended.
fn notes(world: &str) -> Vec<String> {
    let text = format!("[world]\nleaders = [[9, 9]]\nfollowers = [[8, 8]]\npois = [[5, 5]]\n{world}");
    Config::read_noted(&Document::parse(&text), "x.toml", &[], &[]).unwrap_or_else(|error| panic!("{error}")).1
}

#[test]
fn an_out_of_range_default_causes_a_note() {
    assert_eq!(
        notes(""),
        ["world.coupling is not set: 2 is used, because the default, 3, is not in the range allowed here, 1 to 2 \
          (the number of agents)"]
    );
    assert_eq!(notes("coupling = 2"), Vec::<String>::new());
    let found = notes("observers = \"leaders\"");
    assert!(found[0].contains("1 is used") && found[0].contains("the number of leaders"), "{found:?}");
    let found = notes("coupling = 1\n[motion]\nmin_speed = 1.5");
    assert!(found.len() == 1 && found[0].starts_with("world.speed is not set: 1.5 is used"), "{found:?}");
    // A written config has all values, so reading it back causes no notes.
    let config = Config::parse("[world]\nleaders = [[9, 9]]\npois = [[5, 5]]", "x.toml").unwrap();
    assert_eq!(
        Config::read_noted(&Document::parse(&config.to_toml()), "x.toml", &[], &[]).unwrap().1,
        Vec::<String>::new()
    );
}

/// Returns the distance that an agent travels along the x axis at a speed of 1 unit per second.
fn travelled(map: f64, dt: f64, from: f64, steps: usize) -> f64 {
    let text = format!(
        "[world]\nmap = [{map}, {map}]\nleaders = [[{from}, 5]]\npois = [[5, 5]]\ncoupling = 1\nsteps = {steps}\ndt = {dt}\n\
         heading = 0\nspeed = 1\n[motion]\nmax_speed = 1"
    );
    let mut stepper = flotilla::stepper(&Config::parse(&text, "x.toml").unwrap(), 1, false).unwrap();
    (0..steps).for_each(|_| stepper.step(&[0.0, 1.0]).unwrap());
    f64::from(stepper.states().positions[0]) - from
}

/// Positions are f32 on a grid, so very short steps lose distance to rounding. A note warns of such steps.
#[test]
fn steps_too_short_for_the_map_cause_a_note() {
    let noted = |map: f64, dt: f64, speed: f64| {
        let found = notes(&format!("coupling = 1\nmap = [{map}, 9]\ndt = {dt}\n[motion]\nmax_speed = {speed}"));
        assert!(found.iter().all(|note| note.starts_with("motion.max_speed times world.dt is ")), "{found:?}");
        !found.is_empty()
    };
    // The paper's step, then the shortest steps without a note: limited once by f32's spacing and once by the grid's.
    assert!(!noted(50.0, 0.2, 3.0));
    assert!(!noted(1000.0, 256.0 / 16384.0, 1.0) && noted(1000.0, 255.9 / 16384.0, 1.0));
    assert!(!noted(20.0, 1.0 / 1024.0, 1.0) && noted(20.0, 0.99 / 1024.0, 1.0));
    assert!(noted(10_000.0, 1e-4, 3.0) && noted(1000.0, 1e-3, 1.0) && !noted(1000.0, 1e-3, 0.0));
    let error =
        |map: f64, dt: f64, from: f64, steps: usize| travelled(map, dt, from, steps) / (dt * steps as f64) - 1.0;
    assert!(error(1000.0, 0.001, 600.0, 10_000) < -0.02, "steps that cause a note should lose distance");
    assert_eq!(travelled(10_000.0, 1e-4, 9000.0, 1000), 0.0);
    for (map, dt, from) in
        [(1000.0, 0.0157, 600.0), (1000.0, 0.01567, 900.0), (20.0, 0.000_98, 3.0), (60.0, 0.000_98, 40.0)]
    {
        let error = error(map, dt, from, 1000);
        assert!(error.abs() < 0.006, "{map}, {dt}: {error}");
    }
}
