//! Tests `flotilla import`, with configs that have the structure of the authors' programs.

use flotilla::config::{Config, Sectors};

use crate::support::Place;

/// Two equal rovers and one that differs, two UAVs that know other POIs, and three kinds of positions.
const INFLUENCE: &str = "\
env:
  map_size: [60.0, 40.0]
  agents:
    rovers:
    - &rover
      observation_radius: 6.0
      resolution: 90
      reward_type: Difference
      needs_uav_to_move: false
      sensor: {type: RoverLidar, accum_type: sum, default_value: 0.0, \
measurement_type: one_minus_inverse_distance_over_observation_radius}
      position: {spawn_rule: fixed, fixed: [30.0, 20.0]}
    - *rover
    - observation_radius: 4
      resolution: 45
      reward_type: Global
      bounds: {low_x: 0, high_x: 30, low_y: 0, high_y: 40}
      position: {spawn_rule: random_uniform, random_uniform: {low_x: 5, high_x: 10, low_y: 6, high_y: 12}}
    uavs:
    - observation_radius: 30.0
      resolution: 120
      observable_subtypes: [A]
      reward_type: IndirectDifference
      IndirectDifference:
        type: removal
        assignment: automatic
        manual: []
        automatic: {timescale: timestep, credit: Local}
        add_G: true
      position: {spawn_rule: fixed, fixed: [31, 20]}
    - observation_radius: 30.0
      resolution: 120
      reward_type: IndirectDifference
      IndirectDifference: {assignment: manual, manual: [0, 3], automatic: {timescale: timestep, credit: System}}
      position: {spawn_rule: fixed, fixed: [29, 20]}
  pois:
    rover_pois:
    - {value: 2.0, coupling: 1, observation_radius: 3.0, position: {spawn_rule: fixed, fixed: [50, 10]}}
    hidden_pois:
    - &hidden
      value: 1.0
      coupling: 1
      observation_radius: 5.0
      capture_radius: 8.0
      constraint: sequential
      disappear_bool: true
      subtype: A
      position: {spawn_rule: random_circle, random_circle: {center: [30.0, 20.0], radius: 10.0}}
    - *hidden
ccea:
  num_steps: 40
  num_generations: 7
  populations: {agent_population_size: 20}
  network: {hidden_layers: [12], rover_max_velocity: 1.0, uav_max_velocity: 1.5}
  mutation: {independent_probability: 0.25, mean: 0, std_deviation: 0.2}
  selection: {n_elites_binary_tournament: {n_individual_elites: 4, n_team_elites: 2}}
  team_formation: {type: softmax_teams}
  evaluation: {multi_rollout: {num_rollouts: 3}}
  weight_initialization: {lower_bound: -0.5, upper_bound: 0.5}
experiment: {num_trials: 6}
debug: {random_seed: {set_seed: 9, increment_every_trial: true}}
processing: {num_threads: 3, use_multiprocessing: true}
novelty: 1
";

/// Two leaders with three followers.
const LEADERS: &str = "\
num_generations: 30
load_population: ~
CCEA:
  sub_population_size: 24
  mutation_rate: !eval 1/8
  mutation_probability: 0.2
  nn_hidden: [9]
  num_workers: 5
  config:
    BoidsEnv:
      max_steps: !eval 4*9
      render_mode: none
      init_seed: 3
      config:
        map_dimensions: {x: 50, y: 40}
        StateBounds: {min_velocity: 0, max_velocity: 8, max_acceleration: 4, max_angular_velocity: 1.5, num_leaders: 2, num_followers: 3}
        BoidSpawner:
          spawn_rule: Individual
          position_rule: Set
          velocity_rule: FixedStart
          heading_rule: FixedStart
          velocity_fraction: 0.25
          start_heading: !eval 3.14159/2
          leader_positions: [[10, 5], [20, 5]]
          follower_positions: [[11, 4], [21, 4], [22, 4]]
        BoidsColony: {dt: 0.2, radius_attraction: 6, radius_orientation: 2, radius_repulsion: 1, attraction_multiplier: 3, \
orientation_multiplier: 0.5, repulsion_multiplier: 2, wall_avoidance_multiplier: 1}
        ObservationManager: {observation_rule: Individual, num_poi_bins: 4, num_swarm_bins: 8, full_observability: true, \
poi_sensor_type: Density, swarm_sensor_type: Density, observation_radius: ~}
        POIColony: {coupling: 2, observation_radius: 5}
        POISpawner: {poi_spawn_rule: Set, positions: [[10, 20], [20, 20]]}
        FitnessCalculator: {which_G: MinDiscrete, which_D: DFollow}
        Renderer: {pixels_per_unit: 10}
";

/// Translates a text. Returns the config, its text and what was printed to standard error.
fn import(text: &str) -> (Config, String, String) {
    let place = Place::new(&[("config.yaml", text)]);
    let (printed, listed) = place.good("import config.yaml");
    let (out, again) = place.good("import config.yaml --out config.toml");
    assert_eq!((out.trim(), &*place.read("config.toml"), again), ("config.toml", &*printed, listed.clone()));
    // Positions that are random in a region can make POIs unreachable, which `check` warns about.
    place.good("check config.toml");
    (Config::parse(&printed, "config.toml").unwrap(), printed, listed)
}

/// Translates the text after a replacement, which has to occur. It must fail with this message.
fn fails(text: &str, from: &str, to: &str, message: &str) {
    assert!(text.contains(from), "{from}");
    let place = Place::new(&[("config.yaml", &text.replacen(from, to, 1))]);
    place.fails(1, "import config.yaml", &[message]);
}

#[test]
fn rovers_and_uavs_become_classes() {
    let (config, text, listed) = import(INFLUENCE);
    let has = |lines: &[&str]| {
        let text: String = text.split_whitespace().collect::<Vec<_>>().join(" ");
        lines.iter().for_each(|line| assert!(text.contains(line), "{line}\n{text}"));
    };
    has(&[
        "map = [60.0, 40.0] # env.map_size (line 2)",
        "steps = 40 # ccea.num_steps (line ",
        "name = \"rover\" # 2 of them at = [[30.0, 20.0], [30.0, 20.0]]",
        "name = \"rover_2\" # 1 of them count = 1 # drawn anew for every episode in = { box = [5.0, 6.0, 10.0, 12.0] }",
        "{ of = [\"rover\", \"rover_2\"], sectors = 4, frame = \"map\", range = 6.0, measure = \"closeness\", combine = \
         \"sum\", empty = 0.0 }",
        "{ of = [\"rover\", \"rover_2\"], sectors = 8, frame = \"map\", range = 4.0, measure = \"inverse-squared\", nearest = \
         0.03162277660168379, combine = \"mean\", empty = -1.0 }",
        // Rovers see their POIs only. The first UAV knows the subtype, the second does not.
        "{ of = \"pois\", pois = [\"rover\"], sectors = 8, frame = \"map\", range = 4.0",
        "{ of = \"pois\", sectors = 3, frame = \"map\", range = 30.0",
        "{ of = \"pois\", pois = [\"rover\"], sectors = 3, frame = \"map\", range = 30.0",
        "name = \"hidden-A\" # 2 of them count = 2 # drawn anew for every episode in = { circle = [30.0, 20.0, 10.0] }",
        "stays_in = [0.0, 0.0, 30.0, 40.0] # env.agents.rovers[2].bounds (line 16)",
        "led_by = \"any-seen\" # IndirectDifference.automatic.credit",
        "removes = [[0], [1], [2], [3], [0, 3]]",
        "add_g = true",
        "elites = 4 # ccea.selection.n_elites_binary_tournament.n_individual_elites (line 55)",
        "test_episodes = 3",
    ]);
    let classes: Vec<_> =
        config.agents.iter().map(|class| (&*class.name, class.fitness.map(|f| f.to_string()))).collect();
    let fitness = |name: &str| Some(name.to_string());
    let expected = [("rover", "D"), ("rover_2", "G"), ("uav", "Dt"), ("uav_2", "D")];
    assert_eq!(classes, expected.map(|(name, of)| (name, fitness(of))));
    // Classes have no fitness of their own if all rewards are equal. Then --fitness can change it.
    let equal = ["reward_type: Difference", "reward_type: IndirectDifference"]
        .iter()
        .fold(INFLUENCE.to_string(), |text, reward| text.replace(reward, "reward_type: Global"));
    let (equal, ..) = import(&equal);
    assert!(equal.learning.fitness.to_string() == "G" && equal.agents.iter().all(|class| class.fitness.is_none()));
    let pois: Vec<_> = config.pois.iter().map(|group| (&*group.name, group.radius, group.value)).collect();
    // A rover observes within the smaller radius, or within the capture radius.
    assert_eq!(pois, [("rover", 3.0, 2.0), ("hidden-A", 8.0, 1.0)]);
    let learning = &config.learning;
    // Kept teams have slots of the population.
    assert_eq!((learning.population, learning.generations, learning.trials, learning.seed), (22, 7, 6, 9));
    assert_eq!((learning.team_elites, learning.episodes_per_team, learning.mutation_sigma), (2, 3, 0.2));
    // One line per key without an exact equivalent, each with its place, and none for the others.
    for place in [
        "disappear_bool = true: there, it disappears only for rovers with a SmartLidar",
        "n_individual_elites = 4: there, tournaments compare the team's G, and each elite is listed twice",
        "team_formation.type = \"softmax_teams\": there, a mutated policy has fitness 0",
        "config.yaml:8: no exact equivalent: env.agents.rovers[0].reward_type = \"Difference\": credit.add_g is one for all",
        "config.yaml:53: no exact equivalent: ccea.network.uav_max_velocity = 1.5: there, the first UAV has",
        "ccea.weight_initialization.lower_bound = -0.5",
        "processing.num_threads = 3",
        "novelty = 1: unknown",
    ] {
        assert!(listed.contains(place), "{place}\n{listed}");
    }
    assert!(!["needs_uav_to_move", "sensor", "mutation.mean"].iter().any(|key| listed.contains(key)), "{listed}");
    let lines = listed.lines().filter(|line| line.contains(": no exact equivalent: ")).count();
    assert_eq!(lines, text.matches("# no exact equivalent: ").count());
    assert!(
        listed.ends_with(&format!("keys without an exact equivalent: {lines}; the config has them as comments\n")),
        "{listed}"
    );
}

#[test]
fn the_example_of_the_documentation_is_a_whole_config() {
    let page = include_str!("../../docs/how-to/from-the-authors-programs.md");
    let example = page.split("```yaml\n").nth(1).and_then(|rest| rest.split("```").next()).unwrap();
    let config = import(example).0;
    let learning = &config.learning;
    assert_eq!((config.agent_count(), learning.trials, learning.fitness.to_string()), (2, 3, "D".to_string()));
}

fn line_of(text: &str, part: &str) -> usize {
    text.lines().position(|line| line.contains(part)).unwrap() + 1
}

#[test]
fn every_word_of_an_influence_config_has_a_translation() {
    let credit = |timescale: &str, credit: &str| {
        let to = format!("timescale: {timescale}, credit: {credit}");
        import(&INFLUENCE.replace("timescale: timestep, credit: Local", &to)).0
    };
    for (theirs, ours) in
        [("Local", "any-seen"), ("AllOrNothing", "first"), ("System", "anyone"), ("Difference", "alone")]
    {
        assert_eq!(credit("timestep", theirs).credit.led_by.to_string(), ours);
    }
    assert_eq!(credit("trajectory", "AllOrNothing").agents[2].fitness.unwrap().to_string(), "Df");
    for (theirs, ours) in [
        ("inverse_distance_squared", "inverse-squared"),
        ("inverse_distance", "inverse"),
        ("exponential_negative_distance", "exponential"),
        ("distance_over_observation_radius", "distance"),
    ] {
        let (config, ..) = import(&INFLUENCE.replace("one_minus_inverse_distance_over_observation_radius", theirs));
        assert_eq!(config.agents[0].senses[0].measure.to_string(), ours);
    }
    for (theirs, ours) in [("random_teams", "random"), ("softmax_teams", "softmax"), ("fixed_teams", "sorted")] {
        assert_eq!(import(&INFLUENCE.replace("softmax_teams", theirs)).0.learning.teams.to_string(), ours);
    }
    // Earlier versions have other keys.
    let earlier = INFLUENCE
        .replace("populations: {agent_population_size: 20}", "population: {subpopulation_size: 20}")
        .replace(
            "multi_rollout: {num_rollouts: 3}",
            "multi_evaluation: {num_evaluations: 3, aggregation_method: average}",
        )
        .replace("n_individual_elites: 4, n_team_elites: 2", "n_elites: 4");
    let (config, ..) = import(&earlier);
    let learning = &config.learning;
    assert_eq!((learning.population, learning.episodes_per_team, learning.test_episodes), (20, 3, 3));
    let (config, ..) = import(&INFLUENCE.replace("{spawn_rule: fixed, fixed: [31, 20]}", "[31, 20]"));
    assert_eq!(config.agents, import(INFLUENCE).0.agents);
}

#[test]
fn rovers_follow_choose_and_need_uavs() {
    let first = INFLUENCE.find("    - observation_radius: 30.0").unwrap();
    let second = first + 1 + INFLUENCE[first + 1..].find("    - observation_radius: 30.0").unwrap();
    let end = INFLUENCE.find("  pois:").unwrap();
    // Both UAVs are scored by the agents that are taken out, so their class is one.
    let uav = &INFLUENCE[second..end];
    let equal = [&INFLUENCE[..first], uav, uav, &INFLUENCE[end..]].concat();
    let with = |keys: &str| equal.replace("    - &rover\n", &format!("    - &rover\n{keys}"));
    let follows = with("      policy: {type: follow}\n      action: {type: pick_uav}\n");
    let (config, text, listed) = import(&follows);
    let classes: Vec<_> = config.agents.iter().map(|class| (&*class.name, class.control.to_string())).collect();
    let expected = [("rover", "policy"), ("uav", "policy"), ("rover_2", "nearest:uav")];
    assert_eq!(classes, expected.map(|(name, control)| (name, control.to_string())), "{text}");
    assert_eq!(config.agents[2].reach, Some(6.0));
    // Agents have other numbers then: rovers 0 and 1 are the last.
    assert!(text.contains("removes = [[0], [3, 1], [3, 1]]"), "{text}");
    assert!(listed.contains("policy.type = \"follow\": there, dx and dy") && !listed.contains("pick_uav"), "{listed}");
    let picks = with("      action: {type: pick_uav}\n").replace("RoverLidar", "UavDistanceLidar");
    // The sensor does not use the resolution.
    let picks = picks.replacen("resolution: 90", "resolution: 1", 1);
    let (config, text, listed) = import(&picks.replace("needs_uav_to_move: false", "needs_uav_to_move: true"));
    assert!(listed.contains("action.type = \"pick_uav\": there, dx and dy"), "{listed}");
    let rover = &config.agents[0];
    assert_eq!((rover.control.to_string(), rover.moves_near.as_deref()), ("choose:uav".into(), Some("uav")), "{text}");
    assert_eq!(rover.senses.iter().map(|channel| channel.sectors).collect::<Vec<_>>(), [Sectors::Each(2)], "{text}");
    let message =
        "config.yaml:8: env.agents.rovers[0].action.type: found, allowed if all UAVs differ in their positions";
    let different = INFLUENCE
        .replace("      reward_type: Difference\n", "      action: {type: pick_uav}\n      reward_type: Difference\n");
    fails(&different, "RoverLidar", "UavDistanceLidar", message);
    let alone = [&INFLUENCE[..first], &INFLUENCE[end..]].concat();
    let message = "needs_uav_to_move: found, but there are no UAVs";
    fails(&alone, "needs_uav_to_move: false", "needs_uav_to_move: true", message);
    // The inputs in place of UAVs fit a large value.
    assert!(import(&alone.replace("value: 2.0", "value: 9.0")).1.contains("range = 0.0, measure = \"exponential\""));
}

#[test]
fn agents_keep_their_order_and_pois_their_subtypes() {
    let names = |from: &str, to: &str| {
        let (config, text, _) = import(&INFLUENCE.replace(from, to));
        let classes = config.agents.into_iter().map(|class| class.name).collect::<Vec<_>>().join(" ");
        let pois = config.pois.into_iter().map(|group| group.name).collect::<Vec<_>>().join(" ");
        (classes, pois, text)
    };
    // A neighbour joins a class, and an agent after others does not.
    assert_eq!(names("    uavs:\n", "    - *rover\n    uavs:\n").0, "rover rover_2 rover_3 uav uav_2");
    // POIs without a subtype are known to all UAVs.
    let (_, pois, text) = names("subtype: A", "subtype: ''");
    assert!(pois == "rover hidden" && !text.contains("pois = [\"rover\"], sectors = 3"), "{text}");
    // Names are plain, and UAVs know the subtypes in the file.
    let other = "subtype: A+\n      position: [30, 20]\n    - *hidden\n    - {value: 1, coupling: 1, observation_radius: 5, \
                 subtype: A, position: [30, 20]}\n    - {value: 3, coupling: 1, observation_radius: 5, subtype: A, \
                 position: [30, 20]}\n    - value: 1\n      coupling: 1\n      observation_radius: 5";
    let (_, pois, text) = names("subtype: A", other);
    assert_eq!(pois, "rover hidden-A hidden-A_2 hidden-A_3 hidden");
    assert!(text.contains("pois = [\"rover\", \"hidden-A_2\", \"hidden-A_3\", \"hidden\"], sectors = 3"), "{text}");
}

#[test]
fn what_an_influence_config_loses_is_listed() {
    let change = |from: &str, to: &str| {
        assert!(INFLUENCE.contains(from), "{from}");
        import(&INFLUENCE.replace(from, to))
    };
    // Smaller radii of rovers matter if they are smaller than a POI's.
    let smaller = "rovers[2].observation_radius = 4: here, POIs count within the largest one";
    assert!(change("observation_radius: 3.0", "observation_radius: 5.0").2.contains(smaller));
    assert!(!import(INFLUENCE).2.contains(smaller));
    // Rovers with a SmartLidar make hidden POIs disappear, and others do not.
    for (from, to, gone_within) in [
        ("RoverLidar", "SmartLidar", 1.0),
        ("      resolution: 45\n", "      resolution: 45\n      sensor: {type: RoverLidar}\n", 0.0),
    ] {
        let (config, text, listed) = change(from, to);
        assert!(config.pois[1].gone_within == gone_within && !listed.contains("disappear_bool"), "{text}{listed}");
    }
    // One rule is for all agents, that of UAVs. Twice G is G.
    let rule = "IndirectDifference\n      IndirectDifference: {automatic: {timescale: timestep, credit: System}}";
    let (config, _, listed) = change("Global", rule);
    assert!(
        config.credit.led_by.to_string() == "any-seen" && listed.contains("rovers[2].IndirectDifference.automatic")
    );
    let twice = INFLUENCE
        .replace("add_G: true", "add_G: false")
        .replace("Global", "Global\n      IndirectDifference: {add_G: true}");
    assert!(!import(&twice).0.credit.add_g);
    // The largest input from a POI is limited, also for a value that no POI of a channel has.
    let (_, text, listed) = change("- &hidden\n      value: 1.0", "- &hidden\n      value: 8.0");
    assert!(text.contains("nearest = 0.0632455532") && text.matches("nearest = 0.0316227766").count() == 8, "{text}");
    assert!(listed.contains("uavs[0].observation_radius = 30.0: here, a POI's value times"), "{listed}");
    let (config, _, listed) = change("novelty: 1", "novelty: .inf");
    assert!(listed.contains("novelty = inf: unknown") && config.pois.len() == 2);
    // Keys of unknown names are listed wherever they are.
    let unknown = INFLUENCE
        .replace("    uavs:\n", "    drones: [{resolution: 90}]\n    uavs:\n")
        .replace("    hidden_pois:\n", "    secret_pois: [{value: 5}]\n    hidden_pois:\n")
        .replace("timescale: timestep, credit: Local", "timescal: timestep, credit: Local");
    let (_, _, listed) = import(&unknown);
    for key in
        ["agents.drones[0].resolution = 90", "pois.secret_pois[0].value = 5", "automatic.timescal = \"timestep\""]
    {
        assert!(listed.contains(&format!("{key}: unknown")), "{key}\n{listed}");
    }
    // Numbers are read as Python's YAML reads them.
    assert_eq!(change("agent_population_size: 20", "agent_population_size: 030").0.learning.population, 26);
}

#[test]
fn leaders_and_followers_become_classes() {
    let (config, text, listed) = import(LEADERS);
    let (leader, follower) = (&config.agents[0], &config.agents[1]);
    assert_eq!((leader.at.len(), follower.at.len(), config.world.steps), (2, 3, 36));
    assert_eq!((config.world.map, config.world.dt), ([50.0, 40.0], 0.2));
    assert_eq!((config.learning.population, config.learning.mutation_sigma), (24, 0.125));
    assert_eq!((config.learning.fitness.to_string(), config.learning.seed), ("Df".to_string(), 3));
    assert_eq!(config.policy.hidden, [9]);
    let text_of = text.split_whitespace().collect::<Vec<_>>().join(" ");
    for line in [
        "{ of = \"agents\", to = 1.0, gain = -2.0 }",
        "{ of = \"agents\", from = 1.0, to = 2.0, align = 0.5 }",
        "{ of = \"agents\", from = 2.0, to = 6.0, gain = 3.0 }",
        "{ of = \"pois\", sectors = 4, measure = \"linear\" }",
        "{ of = \"agents\", sectors = 8, range = 6.0, measure = \"linear\" }",
        "motion = { min_speed = 0.0, max_speed = 8.0, max_acceleration = 4.0, max_turn_rate = 1.5 }",
        "speed = 2.0",
        "at = [[10, 20], [20, 20]]",
    ] {
        assert!(text_of.contains(line), "{line}\n{text}");
    }
    assert!(listed.contains("orientation_multiplier = 0.5: the program multiplies a sum"), "{listed}");
    assert!(listed.contains("CCEA.num_workers = 5") && !listed.contains("load_population"), "{listed}");

    let all_leaders = LEADERS.replace("follower_positions: [[11, 4], [21, 4], [22, 4]]", "fix_all: true");
    let (config, _, listed) = import(&all_leaders);
    assert!(config.agents.len() == 1 && listed.contains("fix_all = true: unknown"), "{listed}");
    for (theirs, fitness, score) in [
        ("which_G: ContinuousObsRad, which_D: D", "D", "score = \"closeness\""),
        ("which_G: ContinuousObsRadLastStep, which_D: G", "G", "when = \"end\""),
    ] {
        let (config, text, listed) = import(&LEADERS.replace("which_G: MinDiscrete, which_D: DFollow", theirs));
        assert!(config.learning.fitness.to_string() == fitness && text.contains(score), "{text}");
        assert!(listed.contains("1 over the mean of the distances"), "{listed}");
    }
    let earlier = LEADERS
        .replace("FitnessCalculator: {which_G: MinDiscrete, which_D: DFollow}", "reward_type: difference_leader");
    for (switch, fitness) in
        [("", "D"), ("  use_difference_rewards: true\n", "D"), ("  use_difference_rewards: false\n", "G")]
    {
        let config = import(&earlier.replace("  num_workers: 5\n", switch)).0;
        assert_eq!(config.learning.fitness.to_string(), fitness);
    }
    for rule in ["spawn_rule: Individual", "position_rule: Set", "poi_spawn_rule: Set"] {
        let (key, _) = rule.split_once(':').unwrap();
        let (.., listed) = import(&LEADERS.replacen(rule, &format!("{key}: UniformRandom"), 1));
        assert!(listed.contains(&format!("{key} = \"UniformRandom\": positions are the listed ones")), "{listed}");
    }
    let only = LEADERS.replace("which_D: DFollow", "which_D: DFollow, follower_switch: UseFollowersOnly");
    let (config, text, _) = import(&only);
    assert_eq!(config.pois[0].observers, ["follower"], "{text}");
    let (config, ..) =
        import("leader_positions: [[2, 3]]\nfollower_positions: [[4, 5], [6, 7]]\npoi_positions: [[8, 9]]\n");
    assert_eq!((config.world.leaders.len(), config.world.followers.len(), config.world.pois.len()), (1, 2, 1));
}

#[test]
fn bad_input_is_refused_with_its_line() {
    // Values that no config can have are named by the YAML file's keys and lines.
    let line = |part: &str| line_of(INFLUENCE, part);
    let at = |part: &str, message: &str| format!("config.yaml:{}: {message}", line(part));
    fails(INFLUENCE, "[60.0, 40.0]", "[60.0]", &at("map_size", "world.map, from env.map_size: found "));
    fails(INFLUENCE, "[60.0, 40.0]", "{x: 1}", &at("map_size", "env.map_size: found a section, allowed a value"));
    fails(
        INFLUENCE,
        "num_steps: 40",
        "num_steps: many",
        &at("num_steps", "world.steps, from ccea.num_steps: found \"many\""),
    );
    for (part, wrong, message) in [
        ("fixed: [31, 20]", "fixed: [99, 20]", "at[0][0], from env.agents.uavs[0].position: "),
        ("capture_radius: 8.0", "capture_radius: 99999.0", "radius, from env.pois.hidden_pois[0].capture_radius: "),
    ] {
        fails(INFLUENCE, part, wrong, message);
        fails(INFLUENCE, part, wrong, &format!("config.yaml:{}: ", line(part)));
    }
    fails(INFLUENCE, "  num_steps: 40\n", "", "ccea.num_steps: missing, and the translation needs it");
    fails(
        INFLUENCE,
        "credit: Local",
        "credit: Best",
        "found \"Best\", allowed Local, AllOrNothing, System, Difference",
    );
    let (value, radius) = ("value: 2.0, coupling: 1", "observation_radius: 3.0");
    fails(INFLUENCE, "resolution: 90", "resolution: .nan", "rovers[0].resolution: found nan, allowed a number");
    fails(INFLUENCE, value, "value: .nan, coupling: 1", "rover_pois[0].value: found nan, allowed a number");
    fails(
        INFLUENCE,
        radius,
        "observation_radius: .nan",
        "rover_pois[0].observation_radius: found nan, allowed a number",
    );
    for wrong in ["resolution: 0", "resolution: 100"] {
        fails(INFLUENCE, "resolution: 90", wrong, "allowed degrees that divide 360 into 1 to 16 sectors");
    }
    fails(INFLUENCE, "[60.0, 40.0]", ".nan", &at("map_size", "world.map, from env.map_size: found nan"));
    fails(
        INFLUENCE,
        "fixed: [30.0, 20.0]",
        "fixed: 30",
        "env.agents.rovers[0].position.fixed: found 30, allowed a list",
    );
    for manual in ["[0, 99]", "[0, -2]", "[0, 1.5]"] {
        let manual = format!("manual: {manual}");
        let message = at("manual: [0, 3]", "env.agents.uavs[1].IndirectDifference.manual[1]: found ");
        fails(INFLUENCE, "manual: [0, 3]", &manual, &message);
    }
    fails(
        LEADERS,
        "num_followers: 3",
        "num_followers: 9",
        "num_followers: found 9, but there are 3 follower_positions",
    );
    fails(INFLUENCE, "    rovers:", "    cars:", "env.agents.rovers");
    fails(INFLUENCE, "num_steps: 40", "num_steps: 40\n  num_steps: 41", "duplicate");
    fails(INFLUENCE, "env:", "env: [", "config.yaml:3: not YAML that can be read");
    fails(LEADERS, "!eval 4*9", "!eval 4/0", "found \"4/0\", allowed a whole number");
    fails(LEADERS, "POISpawner:", "Spawner:", "POISpawner.positions: missing, and the translation needs it");
    fails(LEADERS, "num_generations: 30", "num_generations: [1, 2]", "learning.generations, from num_generations");

    let many = format!("    - *rover\n{}", "    - {a: 1}\n".repeat(2000));
    fails(INFLUENCE, "    - *rover\n", &many, "env.agents.rovers: found 2003 items, allowed up to 1024");

    // Rovers see all POIs but hidden ones, whatever their subtype.
    let (_, text, _) = import(&INFLUENCE.replace("- {value: 2.0,", "- {subtype: B, value: 2.0,"));
    assert!(text.contains("pois = [\"rover-B\"]"), "{text}");

    let (config, ..) = import(&INFLUENCE.replace("    - *rover\n", &"    - *rover\n".repeat(200)));
    assert_eq!(config.agent_count(), 204);

    let place = Place::new(&[]);
    let unknown: String = (0..60_000).map(|key| format!("key{key}: 1\n")).collect();
    place.write("long.yaml", format!("leader_positions: [[2, 3]]\npoi_positions: [[8, 9]]\n{unknown}"));
    let (_, listed) = place.good("import long.yaml --out long.toml");
    assert!(listed.ends_with("keys without an exact equivalent: 60000; the config has them as comments\n"));
    let mut bomb = String::from("env: &a0 [x, x, x, x, x, x, x, x, x]\n");
    (1..30).for_each(|i| bomb += &format!("b{i}: &a{i} [*a{0}, *a{0}, *a{0}, *a{0}, *a{0}, *a{0}]\n", i - 1));
    for (text, message) in [
        (bomb, "not YAML that can be read: "),
        ("[".repeat(100_000), "not YAML that can be read: "),
        ("a: ".repeat(20_000), "not YAML that can be read: "),
        ("- 1\n- 2\n".into(), "found none of the keys env (influence shaping), CCEA (leader-follower)"),
        (String::new(), "found none of the keys"),
        ("base_dict: {}\nparameter_dicts: []\n".into(), "not a sweep of several"),
        ("env: {}\n".into(), "env.map_size: missing"),
        ("CCEA: 3\n".into(), "CCEA.config.BoidsEnv.config: missing"),
        ("env: \u{1}".into(), "not YAML that can be read: "),
        ("[world]\nsteps = 5\n".into(), "; it is TOML, as configs of this program are"),
        ("env: 1\nenv: 2\n".into(), "; remove one of both"),
        ("# x\n".repeat(300_000), "cannot be read"),
    ] {
        place.write("bad.yaml", &text);
        let error = place.fails(1, "import bad.yaml", &["bad.yaml", message]);
        assert!(error.len() < 2000, "{error}");
    }
    place.write("good.yaml", "leader_positions: [[2, 3]]\npoi_positions: [[8, 9]]\n\"k\\nmap = 1\": \"v\\u0007\"\n");
    let (text, listed) = place.good("import good.yaml");
    assert!(
        text.contains("# no exact equivalent: k\\nmap = 1 = ") && listed.contains("k\\nmap = 1 = "),
        "{text}{listed}"
    );
    place.good("import good.yaml --out x.toml");
    place.fails(1, "import good.yaml --out x.toml", &["--force"]);
    place.good("import good.yaml --out x.toml --force");
    let error = place.refused(1, "import nothere.yaml");
    assert!(error.contains("nothere.yaml") && error.contains("check the path") && !error.contains("init"), "{error}");
    place.fails(2, "import good.yaml --out good.yaml --force", &["good.yaml"]);
}

#[test]
fn commands_that_take_a_config_say_that_it_is_yaml() {
    let wrong = format!("{LEADERS}CCEA: 1\n");
    let json = "{\n  \"env\": {\"map_size\": [9, 9]}\n}\n";
    let files = [("in it.yaml", INFLUENCE), ("no-extension", LEADERS), ("wrong", &wrong), ("mine.yml", "a: 1\n")];
    let place = Place::new(&files);
    place.write("json", json);
    let commands = ["check", "train", "baseline", "sweep", "bench", "verify", "tasks", "rollout --policies x"];
    for file in ["no-extension", "wrong", "mine.yml", "json"] {
        for command in commands {
            let error = place.refused(1, &format!("{command} {file}"));
            let first = error.lines().next().unwrap();
            let message = format!(
                "{file}: cannot be read: it is YAML, and configs are TOML; `flotilla import {file}` translates"
            );
            assert!(first.contains(&message), "{command}: {error}");
        }
    }
    place.fails(1, &["check", "in it.yaml"], &["`flotilla import 'in it.yaml'`"]);
    let mut command = crate::support::flotilla();
    command.args(["check", "-"]).stdin(std::fs::File::open(place.path("no-extension")).unwrap());
    let error = String::from_utf8(command.output().unwrap().stderr).unwrap();
    assert!(
        error.contains("standard input: cannot be read: it is YAML") && error.contains("`flotilla import -`"),
        "{error}"
    );
    // TOML with an error stays TOML, also under the name of a YAML file.
    place.write("x.toml", "[world]\nmap = [1\n");
    assert!(!place.refused(1, "check x.toml").contains("YAML"));
    let chaotic = std::fs::read_to_string(crate::support::root("configs/chaotic.toml")).unwrap();
    place.write("toml.yaml", &chaotic);
    place.good("check toml.yaml");
}
