//! The authors' later program, influence shaping, as the reference: what its own sensors gave in random scenes.

use std::fmt::Write;
use std::ops::ControlFlow;

use flotilla::backend::cpu::Cpu;
use flotilla::config::{Config, Fitness};
use flotilla::front;
use flotilla::stepping::{Recording, Stepper};
use flotilla::world::World;
use serde_json::Value;

/// 200 scenes with the outputs of the authors' program (github.com/AADILab/influence-shaping), rounded to nine digits. Each
/// has agents with sensors of their own, and POIs, some of which only some agents sense.
const SCENES: &str = include_str!("data/influence_inputs.jsonl");
const MAP: f64 = 100.0;

fn text<'a>(value: &'a Value, key: &str) -> &'a str {
    value[key].as_str().unwrap()
}

/// Returns an upper bound of the distances below which the inverse measures would stop growing: the smallest distance from
/// an agent to anything.
fn nearest(agents: &[Value], pois: &[Value]) -> f64 {
    let at = |of: &Value| [0, 1].map(|axis| of["at"][axis].as_f64().unwrap());
    let mut nearest = 1.0f64;
    for (index, agent) in agents.iter().enumerate() {
        for other in agents.iter().skip(index + 1).chain(pois) {
            let ([ax, ay], [bx, by]) = (at(agent), at(other));
            nearest = nearest.min((ax - bx).hypot(ay - by));
        }
    }
    (nearest * 0.99).max(0.01)
}

/// Returns a scene as a config in which every agent is a class, and which kinds each agent's channels sense.
fn config(scene: &Value) -> (String, Vec<Vec<usize>>) {
    let (agents, pois) = (scene["agents"].as_array().unwrap(), scene["pois"].as_array().unwrap());
    let sectors = 360 / scene["resolution_degrees"].as_u64().unwrap();
    let nearest = nearest(agents, pois);
    let mut config = format!("[world]\nmap = [{MAP}, {MAP}]\nsteps = 1\n");
    let mut channels = vec![];
    for (index, agent) in agents.iter().enumerate() {
        let measure = match text(agent, "measure") {
            "inverse_distance" => "inverse",
            "inverse_distance_squared" => "inverse-squared",
            "exponential_negative_distance" => "exponential",
            "distance_over_observation_radius" => "distance",
            "one_minus_inverse_distance_over_observation_radius" => "closeness",
            other => panic!("the measure {other} is new"),
        };
        let combine = if text(agent, "accumulate") == "sum" { "sum" } else { "mean" };
        let (range, empty) = (&agent["radius"], &agent["default"]);
        let channel = |of: &str| {
            format!(
                "  {{ {of}, sectors = {sectors}, frame = \"map\", range = {range}, measure = \"{measure}\", \
                 nearest = {nearest}, combine = \"{combine}\", empty = {empty} }},\n"
            )
        };
        let of_type = |kind: &str| -> Vec<String> {
            let is_one = |(_, other): &(usize, &Value)| text(other, "type") == kind;
            agents.iter().enumerate().filter(is_one).map(|(other, _)| format!("\"agent{other}\"")).collect()
        };
        // Rovers never sense hidden POIs, and others only those of their subtypes.
        let is_sensed = |poi: &Value| {
            let listed = || agent["senses_subtypes"].as_array().unwrap().contains(&poi["subtype"]);
            text(poi, "type") != "hidden"
                || text(agent, "type") != "rover" && (text(poi, "subtype").is_empty() || listed())
        };
        let sensed: Vec<String> =
            pois.iter().enumerate().filter(|(_, poi)| is_sensed(poi)).map(|(poi, _)| format!("\"poi{poi}\"")).collect();
        let mut senses = String::new();
        let mut kinds = vec![];
        for (kind, names) in [of_type("rover"), of_type("uav"), sensed].into_iter().enumerate() {
            if !names.is_empty() {
                kinds.push(kind);
                let names = format!("[{}]", names.join(", "));
                let of = if kind == 2 { format!("of = \"pois\", pois = {names}") } else { format!("of = {names}") };
                senses += &channel(&of);
            }
        }
        channels.push(kinds);
        let at = &agent["at"];
        write!(
            config,
            "[[agents]]\nname = \"agent{index}\"\nat = [{at}]\nmotion = {{ kind = \"free\" }}\nsenses = [\n{senses}]\n"
        )
        .unwrap();
    }
    for (index, poi) in pois.iter().enumerate() {
        let (at, value) = (&poi["at"], &poi["value"]);
        write!(config, "[[pois]]\nname = \"poi{index}\"\nat = [{at}]\nvalue = {value}\ncoupling = 1\n").unwrap();
    }
    // A world has at least one POI. Nobody senses this one.
    config += "[[pois]]\nname = \"unseen\"\nat = [[0, 0]]\ncoupling = 1\n";
    (config, channels)
}

#[test]
fn sensors_measure_what_the_authors_program_measures() {
    let mut compared = 0;
    for (line, scene) in SCENES.lines().enumerate() {
        let scene: Value = serde_json::from_str(scene).unwrap();
        let (text, channels) = config(&scene);
        let config = Config::parse(&text, "scene.toml").unwrap_or_else(|error| panic!("scene {line}: {error}\n{text}"));
        let world = World::new(&config.validate().unwrap());
        let (agents, width) = (world.agents(), world.inputs());
        let stepper = Stepper::new(world, 1, Recording::None).unwrap();
        let sectors = 360 / scene["resolution_degrees"].as_u64().unwrap() as usize;
        for agent in 0..agents {
            let found = &stepper.inputs()[agent * width..][..width];
            let expected = scene["inputs"][agent].as_array().unwrap();
            assert_eq!(expected.len(), 3 * sectors);
            for (place, &kind) in channels[agent].iter().enumerate() {
                for sector in 0..sectors {
                    let expected = expected[kind * sectors + sector].as_f64().unwrap();
                    let found = f64::from(found[place * sectors + sector]);
                    assert!(
                        (found - expected).abs() <= 1e-5 * (1.0 + expected.abs()),
                        "scene {line}, agent {agent}, kind {kind}, sector {sector}: {found}, not {expected}\n{text}"
                    );
                    compared += 1;
                }
            }
        }
    }
    assert!(compared > 10_000, "{compared} inputs");
}

/// 150 random paths with the rewards of the authors' program, of nine kinds.
const PATHS: &str = include_str!("data/influence_rewards.jsonl");

/// Returns the config of a case, with the sections of one kind of reward, and the factor between values and rewards.
fn rewarded(case: &Value, fitness: &str, credit: &str) -> String {
    let number = |key: &str| case[key].as_f64().unwrap();
    let paths = case["paths"].as_array().unwrap();
    let places = |range: std::ops::Range<usize>| {
        let at: Vec<String> = range.map(|agent| paths[agent][0].to_string()).collect();
        at.join(", ")
    };
    let (rovers, uavs) = (case["rovers"].as_u64().unwrap() as usize, case["uavs"].as_u64().unwrap() as usize);
    let sense = "senses = [{ of = \"pois\", range = 1.0 }]\nmotion = { kind = \"free\", max_speed = 1.0 }";
    let mut config = format!(
        "[world]\nmap = [1000.0, 1000.0]\nsteps = {}\nstart_counts = true\n[learning]\nfitness = \"{fitness}\"\n[credit]\n\
         {credit}\n[[agents]]\nname = \"rover\"\nat = [{}]\n{sense}\n[[agents]]\nname = \"uav\"\nat = [{}]\n{sense}\n\
         observes = false\nleads = \"rover\"\ninfluence_radius = 5.0\n",
        paths[0].as_array().unwrap().len() - 1,
        places(0..rovers),
        places(rovers..rovers + uavs),
    );
    for (index, poi) in case["pois"].as_array().unwrap().iter().enumerate() {
        let (capture, coupling) = (poi["capture_radius"].as_f64().unwrap(), poi["coupling"].as_u64().unwrap());
        let radius = capture.max(number("observation_radius").min(number("poi_observation_radius")));
        let (value, when) = (poi["value"].as_f64().unwrap(), if poi["ever"] == true { "ever" } else { "end" });
        write!(
            config,
            "[[pois]]\nname = \"poi{index}\"\nat = [{}]\nvalue = {}\ncoupling = {coupling}\nradius = {radius}\n\
             score = \"closeness\"\nwhen = \"{when}\"\n",
            poi["at"],
            // The authors multiply closeness by the coupling.
            value * coupling as f64,
        )
        .unwrap();
    }
    config
}

#[test]
fn rewards_are_those_of_the_authors_program() {
    const KINDS: [(&str, &str, &str); 9] = [
        ("G", "G", ""),
        ("D", "D", ""),
        ("trajectory", "Df", ""),
        ("step-local", "Dt", "led_by = \"any-seen\""),
        ("step-all-or-nothing", "Dt", "led_by = \"first\""),
        ("step-difference", "Dt", "led_by = \"alone\""),
        ("step-system", "Dt", "led_by = \"anyone\""),
        ("manual", "D", "removes = [MANUAL]"),
        ("step-difference+G", "Dt", "led_by = \"alone\"\nadd_g = true"),
    ];
    let (mut compared, mut different) = (0, [0; KINDS.len()]);
    for (line, case) in PATHS.lines().enumerate() {
        let case: Value = serde_json::from_str(case).unwrap();
        let paths = case["paths"].as_array().unwrap();
        let moments = paths[0].as_array().unwrap().len();
        let mut positions = vec![];
        for moment in 0..moments {
            for path in paths {
                positions.extend([0, 1].map(|axis| path[moment][axis].as_f64().unwrap() as f32));
            }
        }
        for (index, (kind, fitness, credit)) in KINDS.into_iter().enumerate() {
            let text = rewarded(&case, fitness, &credit.replace("MANUAL", &case["manual"].to_string()));
            let config =
                Config::parse(&text, "case.toml").unwrap_or_else(|error| panic!("case {line}: {error}\n{text}"));
            let total: f64 = config.pois.iter().map(|group| group.value).sum();
            let scored = front::score(&config, &positions).unwrap();
            for (agent, &found) in scored.fitness.iter().enumerate() {
                // The authors' program credits agent 0 with what nobody influences.
                if kind == "step-all-or-nothing" && agent == 0 {
                    continue;
                }
                let expected = case["rewards"][kind][agent].as_f64().unwrap();
                let found = f64::from(found) * total;
                let error = (found - expected).abs();
                assert!(
                    error <= 1e-5 || error <= 1e-5 * expected.abs(),
                    "case {line}, {kind}, agent {agent}: {found}, not {expected}\n{text}"
                );
                compared += 1;
                different[index] += usize::from(expected != case["rewards"]["G"][agent].as_f64().unwrap());
            }
        }
    }
    assert!(compared > 6000 && different[1..].iter().all(|&count| count > 100), "{compared}, {different:?}");
}

/// A UAV that always influences the only rover is worth what the rover is worth, which is all.
#[test]
fn one_rover_and_one_uav_learn_alike_under_any_credit() {
    let trained = |fitness: Fitness| {
        let mut config = Config::parse(include_str!("../configs/influence/rover_uav.toml"), "rover_uav.toml").unwrap();
        (config.learning.trials, config.learning.generations) = (2, 30);
        config.agents[1].influence_radius = Some(100.0);
        config.agents.iter_mut().for_each(|class| class.fitness = None);
        config.learning.fitness = fitness;
        let trained = front::train(&config, &mut Cpu::default(), |_| ControlFlow::Continue(())).unwrap();
        (trained.digest(), trained.champion_g.clone())
    };
    let (expected, g) = trained(Fitness::G);
    assert!(g.iter().any(|&g| g > 0.0), "{g:?}");
    for fitness in [Fitness::Df, Fitness::Dt] {
        assert_eq!(trained(fitness).0, expected, "{fitness}");
    }
    assert_ne!(trained(Fitness::D).0, expected);
}

/// Rovers lead nobody, so that their Dt is D.
#[test]
fn each_class_may_have_its_own_fitness() {
    let trained = |of_classes: [Option<Fitness>; 2], fitness: Fitness| {
        let text = include_str!("../configs/influence/3_rovers_1_uav.toml");
        let mut config = Config::parse(text, "3_rovers_1_uav.toml").unwrap();
        (config.learning.trials, config.learning.generations) = (1, 20);
        (config.agents[0].fitness, config.agents[1].fitness) = (of_classes[0], of_classes[1]);
        config.learning.fitness = fitness;
        front::train(&config, &mut Cpu::default(), |_| ControlFlow::Continue(())).unwrap().digest()
    };
    let expected = trained([None, None], Fitness::Dt);
    assert_eq!(trained([Some(Fitness::D), Some(Fitness::Dt)], Fitness::G), expected);
    assert_ne!(trained([Some(Fitness::Dt), None], Fitness::D), expected);
    assert_ne!(trained([None, Some(Fitness::G)], Fitness::Dt), expected);
}
