//! Tests that classes of agents and groups of POIs are read, written and refused with precise messages.

use std::collections::HashSet;

use crate::support::table;
use flotilla::config::{
    Actions, AgentClass, Choice, Combine, Config, Control, ControlKind, Coupling, Frame, Heading, Measure, Mobility,
    Observers, Override, Paradigm, Sectors, Sharing,
};
use flotilla::reader::Document;
use flotilla::sample;
use flotilla::world::World;
use proptest::collection::vec;
use proptest::prelude::*;

const TEXT: &str = r#"[world]
steps = 20
[[agents]]
name = "uav"
at = [[25, 25], [26, 25]]
motion = { kind = "free", max_speed = 1.0 }
senses = [
  { of = "pois", range = 25 },
  { of = ["uav", "dog"], range = 5, measure = "closeness" },
]
leads = "dog"
[[agents]]
name = "dog"
at = [[20, 25]]
control = "follow"
rule = [{ of = "agents", to = 5, gain = -1 }]
[[pois]]
name = "a"
at = [[1, 2], [3, 4]]
coupling = 1
[[pois]]
name = "b"
at = [[5, 6]]
coupling = 2
after = "a"
"#;

fn parse(text: &str) -> Config {
    Config::parse(text, "x.toml").unwrap_or_else(|error| panic!("{text}\n{error}"))
}

/// Returns the text with one part replaced.
fn with(from: &str, to: &str) -> String {
    assert_eq!(TEXT.matches(from).count(), 1, "{from}");
    TEXT.replace(from, to)
}

fn many(count: usize) -> String {
    format!("at = [{}]", "[1, 1], ".repeat(count))
}

/// Each part of the text is replaced by another, with the problems that this causes.
#[test]
fn every_problem_names_key_line_found_and_allowed() {
    for [from, to, expected] in table(include_str!("data/refusals/classes.txt"), 135) {
        let text = with(&from, &to);
        let error = Config::parse(&text, "x.toml").expect_err(&text).to_string();
        let found: Vec<&str> = error.lines().filter(|line| !line.ends_with("problems in x.toml")).collect();
        let expected: Vec<String> = expected.lines().map(|problem| format!("x.toml:{problem}")).collect();
        assert_eq!(found, expected, "{to}");
    }
}

#[test]
fn classes_and_groups_have_their_limits() {
    let uav = "at = [[25, 25], [26, 25]]";
    assert_eq!(parse(&with(uav, &many(1023))).agent_count(), 1024);
    assert_eq!(parse(&with("at = [[5, 6]]", &many(254))).poi_count(), 256);
    for (from, to, expected) in [
        (
            "at = [[20, 25]]",
            "count = 1048575\nin = { disc = [9, 9, 5] }".into(),
            "x.toml:14: agents[1].count: found 1048575, which makes 1048577 agents with those before, allowed 1 to 1048576",
        ),
        (
            "at = [[5, 6]]",
            many(255),
            "x.toml:23: pois[1].at: found 255, which makes 257 POIs with those before, allowed 1 to 256",
        ),
        (
            "[[pois]]\nname = \"a\"",
            format!("{}[[pois]]\nname = \"a\"", "[[agents]]\n".repeat(7)),
            "x.toml:3: agents: found a list of 9, allowed a list of 1 to 8 tables [[agents]]",
        ),
    ] {
        assert_eq!(Config::parse(&with(from, &to), "x.toml").unwrap_err().to_string(), expected);
    }
    // All of them learn.
    let dogs = "at = [[1, 1]]\nsenses = [{ of = \"pois\" }]";
    let all = TEXT.replace("at = [[25, 25], [26, 25]]", &many(1024)).replace("at = [[20, 25]]", dogs);
    let all = all.replace("control = \"follow\"\nrule = [{ of = \"agents\", to = 5, gain = -1 }]\n", "");
    assert_eq!(
        Config::parse(&all.replace("leads = \"dog\"\n", ""), "x.toml").unwrap_err().to_string(),
        "x.toml:3: agents: found 1025 agents that learn, allowed up to 1024"
    );
    let none = with("name = \"a\"", "name = \"a\"").split("[[pois]]").next().unwrap().to_string();
    let error = |text: String| Config::parse(&text, "x.toml").unwrap_err().to_string();
    assert_eq!(
        error(format!("pois = []\n{none}")),
        "x.toml:1: pois: found a list of 0, allowed a list of 1 to 256 tables [[pois]]"
    );
    assert_eq!(
        error(
            TEXT.replace("[[agents]]\nname = \"uav\"", "[agents]\nname = \"uav\"")
                .replace("[[agents]]\nname = \"dog\"", "[x]")
        ),
        "2 problems in x.toml\nx.toml:3: agents: found a section, allowed tables [[agents]]\nx.toml:12: x: unknown section"
    );
    let (head, rest) = TEXT.split_once("[[agents]]").unwrap();
    let (uav, rest) = rest.split_once("[[agents]]").unwrap();
    let (dog, groups) = rest.split_once("[[pois]]").unwrap();
    assert_eq!(
        error(format!("{head}[[agents]]{dog}[[agents]]{uav}[[pois]]{groups}")),
        "x.toml:8: agents[1].control: found a class that learns after \"dog\", which does not; allowed before all classes \
         that do not learn"
    );
    assert_eq!(
        error(format!("{head}[[agents]]{dog}[[pois]]{}", groups.replace("coupling = 2", "coupling = 1"))),
        "x.toml:3: agents: found no class that learns, allowed one or more with control = \"policy\""
    );
    let blind = TEXT.replace("name = \"uav\"", "name = \"uav\"\nobserves = false");
    let blind = blind.replace("name = \"dog\"", "name = \"dog\"\nobserves = false");
    let nobody = "missing, and no class observes; allowed names of classes";
    assert_eq!(
        error(blind.clone()),
        format!("2 problems in x.toml\nx.toml:19: pois[0].observers: {nobody}\nx.toml:23: pois[1].observers: {nobody}")
    );
    let blind = blind.split("[[pois]]").next().unwrap().replace("steps", "pois = [[1, 1]]\nsteps");
    assert_eq!(
        error(blind),
        "x.toml:4: agents: found no class that observes, allowed one or more with observes = true"
    );
    // Without groups, POIs are needed in short, and the other way around.
    assert_eq!(error(none), "x.toml:1: world.pois: missing, allowed a list of 1 to 256 positions [x, y]");
}

#[test]
fn flags_set_keys_of_classes_and_groups() {
    let set = |key: &str, value: &str| {
        let set = Override::of_text(key, value, "--set");
        let of_text = Config::read(TEXT, "x.toml", &[], std::slice::from_ref(&set));
        // A config that was read can be changed, too.
        assert_eq!(parse(TEXT).with(std::slice::from_ref(&set)).is_ok(), of_text.is_ok(), "{key}");
        of_text
    };
    for (key, value, from, to) in [
        ("agents.uav.motion.max_speed", "2.5", "max_speed = 1.0", "max_speed = 2.5"),
        ("agents.uav.senses[1].range", "7", "range = 5,", "range = 7,"),
        ("agents[1].rule[0].gain", "-2", "gain = -1", "gain = -2"),
        ("agents.dog.at", "[[1, 1], [2, 2]]", "[[20, 25]]", "[[1, 1], [2, 2]]"),
        ("agents.dog.observes", "false", "name = \"dog\"", "name = \"dog\"\nobserves = false"),
        ("pois.b.coupling", "3", "coupling = 2", "coupling = 3"),
    ] {
        assert_eq!(set(key, value).unwrap(), parse(&with(from, to)), "{key}");
    }
    let problem = |key: &str, value: &str| {
        let error = set(key, value).unwrap_err();
        assert!(error.is_usage(), "{error}");
        error.to_string()
    };
    for [key, value, expected] in table(include_str!("data/refusals/flags.txt"), 10) {
        assert_eq!(problem(&key, &value), expected, "{key}");
    }
    assert_eq!(
        problem(&format!("agents{}", ".x".repeat(200_000)), "3"),
        "--set: found 200000 parts after `agents`, allowed up to 8"
    );
    let set = Override::of_text("agents.leader.speed", "3", "--set");
    let short = "[world]\nleaders = [[1, 1]]\npois = [[9, 9]]\ncoupling = 1\n";
    assert_eq!(
        Config::read(short, "x.toml", &[], &[set]).unwrap_err().to_string(),
        "--set: found a config without [[agents]]; `flotilla check --expand` writes them"
    );
}

#[test]
fn stages_keep_tables() {
    let set = Override::new("learning.population", 7, "--population");
    let config = parse(TEXT);
    assert_eq!(config.with(&[set]).unwrap().learning.population, 7);
    let staged = parse(&format!("{TEXT}[[stages]]\nfrom = 3\nset = {{ \"world.steps\" = 30 }}\n"));
    assert_eq!((staged.stages.len(), &staged.agents), (1, &config.agents));
    assert_eq!(parse(&staged.to_toml()), staged);
    // A stage can change groups of POIs, with quotes or without.
    let staged =
        parse(&format!("{TEXT}[[stages]]\nfrom = 3\nset = {{ \"pois.b.coupling\" = 1, pois.a.radius = 2 }}\n"));
    let valid = staged.validate().unwrap();
    let [before, after] = [2, 3].map(|generation| World::new(valid.at(generation)));
    assert_eq!((&before.coupling[..], before.radii2[0]), (&[1, 1, 2][..], 25.0));
    assert_eq!((&after.coupling[..], after.radii2[0]), (&[1, 1, 1][..], 4.0));
    assert_eq!(parse(&staged.to_toml()), staged);
    // It can change classes.
    let staged = parse(&format!("{TEXT}[[stages]]\nfrom = 3\nset = {{ agents.dog.motion.max_speed = 2 }}\n"));
    let valid = staged.validate().unwrap();
    assert_eq!([2, 3].map(|generation| valid.at(generation).agents[1].motion.max_speed()), [3.0, 2.0]);
    assert_eq!(parse(&staged.to_toml()), staged);
    // Values may have tables, and a key in quotes may have one, which replaces that of the file.
    let set = "'agents.dog.motion' = { kind = 'free', max_speed = 2 }, 'pois.b' = { name = 'b', at = [[5, 6]], coupling = 1 }, \
               agents.uav.senses = [{ of = 'pois', range = 9 }, { of = 'agents' }], agents.dog.rule = [{ of = 'uav', to = 7, gain = 2 }]";
    let staged = parse(&format!("{TEXT}[[stages]]\nfrom = 3\nset = {{ {set} }}\n"));
    let valid = staged.validate().unwrap();
    let changed = Config { stages: vec![], ..Config::clone(valid.at(3)) };
    let flags = [
        ("agents.dog.motion", "{ kind = 'free', max_speed = 2 }"),
        ("agents.dog.rule", "[{ of = 'uav', to = 7, gain = 2 }]"),
        ("agents.uav.senses", "[{ of = 'pois', range = 9 }, { of = 'agents' }]"),
        ("pois.b", "{ name = 'b', at = [[5, 6]], coupling = 1 }"),
    ];
    let flags = flags.map(|(key, value)| Override::of_text(key, value, "--set"));
    assert_eq!(changed, *Config::read(TEXT, "x.toml", &[], &flags).unwrap().validate().unwrap());
    assert_eq!(parse(&staged.to_toml()), staged);
    // It is refused if policies get other inputs, or if other classes learn.
    let each = with("{ of = \"pois\", range = 25 }", "{ of = \"pois\", range = 25, sectors = \"each\" }");
    let anytime = with("after = \"a\"\n", "");
    for (text, set) in [
        (&*each, "\"pois.b.at\" = [[5, 6], [7, 8]]"),
        (TEXT, "agents.uav.senses = [{ of = \"pois\", range = 25 }]"),
        (TEXT, "agents.uav.at = [[5, 6]]"),
        (
            &anytime,
            "agents.uav.influence_radius = 5, agents.dog.control = \"policy\", agents.dog.rule = [], \
             agents.dog.senses = [{ of = \"pois\", range = 25 }]",
        ),
    ] {
        let error = Config::parse(&format!("{text}[[stages]]\nfrom = 3\nset = {{ {set} }}\n"), "x.toml").unwrap_err();
        let line = text.lines().count() + 1;
        let other = "the classes that learn have other sizes, inputs or outputs in this stage than in all others";
        assert_eq!(error.to_string(), format!("x.toml:{line}: stages[0]: {other}"));
    }
}

#[test]
fn keys_of_tables_have_their_defaults() {
    let config = parse(TEXT);
    let [uav, dog] = &config.agents[..] else { panic!("{:?}", config.agents) };
    assert_eq!(
        (uav.control.clone(), uav.speed, uav.observes, uav.wall_radius, uav.wall_gain),
        (Control::Policy, 0.0, true, 1.0, 1.0)
    );
    assert_eq!(
        (&uav.motion, &uav.heading),
        (&Mobility::Free { max_speed: 1.0 }, &Some(Heading::Same(std::f64::consts::FRAC_PI_2)))
    );
    assert_eq!((uav.leads.clone(), uav.influence_radius), (vec!["dog".to_string()], None));
    let [pois, agents] = &uav.senses[..] else { panic!("{:?}", uav.senses) };
    assert_eq!(
        (pois.sectors, pois.frame, pois.measure, pois.combine),
        (Sectors::Equal(4), Frame::Map, Measure::Linear, Combine::Share)
    );
    assert_eq!((pois.nearest, pois.empty, pois.gain, pois.range), (1.0, 0.0, 1.0, 25.0));
    assert_eq!(agents.of, ["uav", "dog"]);
    let short = parse("[world]\nleaders = [[1, 1]]\npois = [[2, 2]]\n");
    assert_eq!(dog.motion, Mobility::Steered(short.motion.clone()));
    assert_eq!((dog.rule[0].from, dog.rule[0].to, dog.rule[0].gain, dog.rule[0].align), (0.0, 5.0, Some(-1.0), None));
    let group = &config.pois[0];
    assert_eq!((group.value, group.radius, &group.coupling), (1.0, 5.0, &Coupling::Same(1)));
    let timed = parse(&with("coupling = 1", "coupling = 1\nwindows = [[1, 9]]"));
    // Stages change the values of the file.
    let more = format!("[[stages]]\nfrom = 3\nset = {{ pois.{}.at = [[5, 6], [7, 8], [9, 9]] }}\n", timed.pois[0].name);
    let more = parse(&(with("coupling = 1", "coupling = 1\nwindows = [[1, 9]]") + &more)).validate().unwrap();
    assert_eq!(more.at(3).classes().windows(20), [[1, 9], [1, 9], [1, 9], [1, 20]]);
    assert_eq!(timed.classes().windows(20), [[1, 9], [1, 9], [1, 20]]);
    assert_eq!(config.classes().after(), [vec![], vec![], vec![0, 1]]);
    // The other keys are as in an empty config.
    assert_eq!((&config.motion, &config.sense, &config.follow), (&short.motion, &short.sense, &short.follow));
    assert_eq!((config.learners(), config.agent_count(), config.poi_count(), config.inputs()), (2, 3, 3, 8));
    assert_eq!(config.classes().influence_radius(0, 1), Some(5.0));
    let wide = parse(&with("range = 25", "range = 25, sectors = 12"));
    assert_eq!((wide.inputs(), wide.widths()), (16, vec![16, 10, 2]));
    assert_eq!(wide.parameters(), 17 * 10 + 11 * 2);
}

/// Classes and groups may refer to those of the short form.
#[test]
fn one_list_may_be_in_full_and_the_other_in_short() {
    let (agents, pois) = TEXT.split_once("[[pois]]").unwrap();
    let agents = agents.replace("steps = 20", "pois = [[5, 6], [7, 8]]\ncoupling = 1\nafter = [[], [0]]");
    let agents = parse(&agents.replace("of = \"pois\"", "of = \"pois\", pois = \"poi1\""));
    assert_eq!((agents.agents.len(), agents.pois.len(), agents.classes().pois.len()), (2, 0, 2));
    let text = format!("[world]\nleaders = [[1, 1]]\nfollowers = [[2, 2]]\n[[pois]]{pois}");
    let groups = parse(&text.replace("coupling = 1", "coupling = 1\nobservers = \"follower\""));
    assert_eq!((groups.agents.len(), groups.pois.len(), groups.classes().agents.len()), (0, 2, 2));
    let error = |text: String| Config::parse(&text, "x.toml").unwrap_err().to_string();
    assert_eq!(
        error(text.replace("coupling = 1", "coupling = 2\nobservers = \"follower\"")),
        "x.toml:7: pois[0].coupling: found 2, allowed 1 (the number of its observers)"
    );
    let alone = text.replace("coupling = 1", "observers = \"follower\"") + "[learning]\nparadigm = \"all-leaders\"\n";
    assert_eq!(error(alone), "x.toml:7: pois[0].observers: found \"follower\", allowed \"leader\"");
    for config in [agents, groups] {
        assert_eq!(parse(&config.to_toml()), config);
        assert_eq!(parse(&config.expanded().to_toml()).classes(), config.classes());
    }
}

/// Numbers are those of the order of agents and POIs, whether these are listed or drawn.
#[test]
fn classes_and_groups_in_regions_have_their_sizes() {
    let text = with("at = [[25, 25], [26, 25]]", "count = 3\nin = { box = [10, 10, 20, 30] }\nheading = [1, 2, 3]");
    let text = text.replace("at = [[5, 6]]", "count = 2\nin = { circle = [25, 25, 10] }\nwindows = [[1, 5], [2, 6]]");
    let config = parse(&text);
    assert_eq!((config.agent_count(), config.learners(), config.poi_count()), (4, 3, 4));
    assert_eq!((config.starts_move(), config.pois_move(), config.draws_starts()), (true, true, true));
    let classes = config.classes();
    assert_eq!(classes.class_of_each(), [0, 0, 0, 1]);
    assert_eq!(classes.group_of_each(), [0, 0, 1, 1]);
    assert_eq!(classes.headings()[..3], [1.0, 2.0, 3.0]);
    assert_eq!(
        (classes.couplings(), classes.after()),
        (vec![1, 1, 2, 2], vec![vec![], vec![], vec![0, 1], vec![0, 1]])
    );
    // Places are examples.
    let (starts, places) = (classes.starts(), classes.places());
    assert!(starts[..3].iter().all(|[x, y]| (10.0..20.0).contains(x) && (10.0..30.0).contains(y)), "{starts:?}");
    assert!(starts[0] != starts[1] && starts[3] == [20.0, 25.0] && places[..2] == [[1.0, 2.0], [3.0, 4.0]]);
    let far = |[x, y]: [f64; 2]| ((x - 25.0) * (x - 25.0) + (y - 25.0) * (y - 25.0)).sqrt();
    assert!(places[2..].iter().all(|&place| (far(place) - 10.0).abs() < 1e-9), "{places:?}");
    // The text has the regions in one line each.
    let written = config.to_toml();
    assert!(written.contains("count = 3\nin = { box = [10.0, 10.0, 20.0, 30.0] }\n"), "{written}");
    assert_eq!((parse(&written), config.validate().unwrap().into_config()), (config.clone(), config));
}

#[test]
fn keys_that_stages_set_stay_in_short() {
    let text =
        "[world]\nleaders = [[1, 1]]\nfollowers = [[2, 2]]\npois = [[3, 3]]\ncoupling = 1\nobservers = \"leaders\"\n";
    for (set, in_full) in [
        ("\"world.steps\" = 7", [true, true]),
        ("\"world.coupling\" = 1", [true, false]),
        ("\"sense.gain\" = 2", [false, false]),
        ("\"world.observers\" = \"all\"", [false, false]),
    ] {
        let config = parse(&format!("{text}[[stages]]\nfrom = 3\nset = {{ {set} }}\n"));
        let expanded = config.expanded();
        assert_eq!([!expanded.agents.is_empty(), !expanded.pois.is_empty()], in_full, "{set}");
        assert_eq!((parse(&expanded.to_toml()), expanded.classes()), (expanded, config.classes()));
    }
}

#[test]
fn blind_channels_and_headings_in_degrees_cause_notes() {
    let notes = |text: &str| Config::read_noted(&Document::parse(text), "x.toml", &[], &[]).unwrap().1;
    assert_eq!(notes(TEXT), Vec::<String>::new());
    let blind = "agents[0].senses[0] never senses anything in this world";
    assert_eq!(notes(&with("range = 25", "range = 0")), [blind]);
    let alone = with("at = [[25, 25], [26, 25]]", "at = [[25, 25]]").replace("of = \"pois\"", "of = \"uav\"");
    assert_eq!(notes(&alone), [blind]);
    let turned = notes(&with("leads", "heading = 90\nleads"));
    assert!(turned.len() == 1 && turned[0].starts_with("agents[0].heading has 90"), "{turned:?}");
    let default = notes(&with("coupling = 1", "observers = \"dog\""));
    assert!(default.len() == 1 && default[0].starts_with("pois[0].coupling is not set: 1 is used"), "{default:?}");
    let short = notes(&with("control = \"follow\"", "control = \"follow\"\nmotion = { max_speed = 1e-6 }"));
    assert!(short.len() == 1 && short[0].starts_with("agents[1].motion.max_speed times world.dt"), "{short:?}");
}

/// Random configs are valid, and are the same after they were written and read, and in full.
#[test]
fn random_classes_survive_a_round_trip() {
    let mut seen = HashSet::new();
    let mut note = |what: &str, of: String| {
        seen.insert(format!("{what} {of}"));
    };
    for seed in 0..500 {
        let config = sample::classes_world(seed);
        let valid = config.validate().unwrap_or_else(|error| panic!("{seed}: {error}"));
        assert_eq!(*valid, config, "{seed}");
        let text = config.to_toml();
        assert_eq!(Config::parse(&text, "x.toml"), Ok(config.clone()), "{seed}: {text}");
        assert_eq!(config.expanded(), config, "{seed}");
        assert_eq!(sample::classes_world(seed), config, "{seed}");
        let learning = config.agents.iter().take_while(|class| class.learns()).map(AgentClass::inputs);
        assert_eq!(config.inputs(), learning.max().unwrap(), "{seed}");
        if seed >= 100 {
            continue;
        }
        for class in &config.agents {
            note("control", class.control.kind().to_string());
            note("motion", matches!(class.motion, Mobility::Free { .. }).to_string());
            note("stays in", class.stays_in.is_some().to_string());
            note("moves near", class.moves_near.is_some().to_string());
            for channel in &class.senses {
                note("measure", channel.measure.to_string());
                note("combine", channel.combine.to_string());
                note("frame", channel.frame.to_string());
                note("each", matches!(channel.sectors, Sectors::Each(_)).to_string());
            }
            class.rule.iter().for_each(|term| note("gain", term.gain.is_some().to_string()));
        }
        for group in &config.pois {
            note("windows", group.windows.is_empty().to_string());
            note("after", group.after.is_empty().to_string());
            note("observers", group.observers.is_empty().to_string());
            note("coupling", matches!(group.coupling, Coupling::Same(_)).to_string());
        }
        note("actions", config.policy.actions.to_string());
        note("sharing", config.learning.sharing.to_string());
    }
    let words = Measure::ALL.len() + Combine::ALL.len() + Frame::ALL.len() + ControlKind::ALL.len();
    assert_eq!(seen.len(), words + 9 * 2 + Actions::Direct.outputs() + Sharing::ALL.len(), "{seen:?}");
}

/// A config in short is the same in full: same classes, learners, populations and policies.
#[test]
fn a_config_in_short_has_the_same_classes_in_full() {
    for seed in 0..300 {
        let short = sample::world(seed);
        let full = parse(&short.expanded().to_toml());
        assert_eq!(full, short.expanded(), "{seed}");
        assert_eq!(full.classes(), short.classes(), "{seed}");
        assert_eq!(full.population_of_each(), short.population_of_each(), "{seed}");
        assert_eq!(
            [full.learners(), full.inputs(), full.parameters()],
            [short.learners(), 8, short.parameters()],
            "{seed}"
        );
        assert_eq!([full.agent_count(), full.poi_count()], [short.agent_count(), short.poi_count()], "{seed}");
        let (drawn, mut world) = (full.drawn(), short.world.clone());
        if short.learning.paradigm == Paradigm::AllLeaders {
            world.leaders.append(&mut world.followers);
        }
        let whole = |world: &flotilla::config::WorldConfig| {
            let observers = match world.followers.is_empty() {
                true => Observers::All,
                false => world.observers,
            };
            let after = if world.after.iter().all(Vec::is_empty) { vec![] } else { world.after.clone() };
            let coupling = world.coupling.of_each(world.pois.len());
            (world.leaders.clone(), world.followers.clone(), world.pois.clone(), coupling, observers, after)
        };
        assert_eq!(whole(&drawn), whole(&world), "{seed}");
        assert_eq!((&drawn.windows, drawn.observation_radius), (&world.windows, world.observation_radius), "{seed}");
        assert_eq!(drawn.headings(), world.headings(), "{seed}");
    }
}

/// Generates a piece of text: mostly one that has a meaning in TOML or in a table.
fn token() -> impl Strategy<Value = String> {
    let known = "[ ] [[ ]] = , . # \" { } inf -inf nan -1 0 3 1e-40 true [[agents]] [[pois]] [agents] agents pois uav dog \
                 \"uav\" \"dog\" \"pois\" \"a\" \"b\" name at of to senses rule motion kind control after windows [[1,2],[3]]";
    let known: Vec<String> = known.split_whitespace().map(str::to_string).chain(["\n".into()]).collect();
    prop_oneof![4 => (0..known.len()).prop_map(move |index| known[index].clone()), 1 => "\\PC{0,6}"]
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn mangled_tables_never_panic(edits in vec((any::<prop::sample::Index>(), 0..12usize, token()), 1..6)) {
        let mut text = TEXT.as_bytes().to_vec();
        for (at, cut, token) in edits {
            let at = at.index(text.len() + 1);
            let end = (at + cut).min(text.len());
            text.splice(at..end, token.into_bytes());
        }
        let text = String::from_utf8_lossy(&text);
        match Config::parse(&text, "x.toml") {
            Ok(config) => prop_assert_eq!(Config::parse(&config.to_toml(), "again.toml"), Ok(config)),
            Err(error) => prop_assert!(error.to_string().contains("x.toml")),
        }
    }
}

/// Kernels have room for four runs of neighbouring groups per channel.
#[test]
fn a_channel_names_at_most_four_runs_of_groups() {
    let read = |named: &str| {
        let mut text = format!(
            "[[agents]]\nname = \"rover\"\nat = [[5, 5]]\nsenses = [\n{{ of = \"pois\", pois = [{named}] }},\n]\n"
        );
        for group in ["a", "b", "c", "d", "e", "f", "g", "h", "i"] {
            text += &format!("[[pois]]\nname = \"{group}\"\nat = [[9, 9]]\ncoupling = 1\n");
        }
        Config::parse(&text, "runs.toml").map(|config| World::new(&config.validate().unwrap()).pois.len())
    };
    assert_eq!(read(r#""a", "c", "d", "f", "h""#), Ok(9));
    let error = read(r#""a", "c", "e", "g", "i""#).unwrap_err().to_string();
    let expected =
        "runs.toml:5: agents[0].senses[0].pois: found 5 runs of neighbouring groups, allowed up to 4: reorder [[pois]]";
    assert_eq!(error, expected);
}

/// POIs that a channel cannot sense do not change its inputs, whatever they are worth.
#[test]
fn values_of_other_groups_do_not_change_inputs() {
    let inputs = |others: f64| {
        let text = format!(
            "[[agents]]\nname = \"rover\"\nat = [[5, 5]]\nsenses = [{{ of = \"pois\", pois = \"near\", \
             measure = \"inverse-squared\", nearest = 0.025 }}]\n\
             [[pois]]\nname = \"near\"\nat = [[6, 8]]\ncoupling = 1\n\
             [[pois]]\nname = \"other\"\nat = [[9, 9]]\ncoupling = 1\nvalue = {others}\n"
        );
        let config = parse(&text);
        flotilla::stepper(&config, 1, false).unwrap().inputs().to_vec()
    };
    assert_eq!(inputs(1000.0), inputs(1.0));
    assert!((inputs(1.0).iter().sum::<f32>() - 0.1).abs() < 1e-3, "{:?}", inputs(1.0));
}
