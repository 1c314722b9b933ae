//! Tests that classes of agents and groups of POIs are read, written and refused with precise messages.

use std::collections::HashSet;

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
    let at = "at = [[20, 25]]";
    let leads = "leads = \"dog\"";
    let rule = "to = 5, gain = -1";
    let control = "control = \"follow\"";
    let pois = "{ of = \"pois\", range = 25 },";
    let of = "of = \"pois\"";
    let range = "range = 25";
    let motion = "\"free\", max_speed = 1.0";
    let coupling = "coupling = 1";
    let steps = "steps = 20";
    let replaced = |list: &str| {
        format!(
            "found in a config with [[{list}]], which replaces this key: remove one of the two; without [[{list}]], \
             `flotilla check --expand` writes it from the other keys"
        )
    };
    let [agents, groups] = ["agents", "pois"].map(replaced);
    for (from, to, expected) in [
        (
            "coupling = 2",
            "coupling = 2\ngone_within = 0.001",
            "25: pois[1].gone_within: found 0.001, allowed 0 or 0.01 to 10000",
        ),
        (
            "range = 5,",
            "rnge = 5,",
            "9: agents[0].senses[1].range: missing, allowed 0 to 10000 with measure = \"closeness\"\n9: agents[0].senses[1].rnge: unknown key, did you mean `range`?",
        ),
        (
            "range = 5,",
            "range = 5, colour = 1,",
            "9: agents[0].senses[1].colour: unknown key, allowed combine, empty, frame, gain, measure, nearest, of, pois, range, sectors",
        ),
        ("range = 5,", "range = -1,", "9: agents[0].senses[1].range: found -1, allowed 0 to 10000 or inf (unlimited)"),
        (
            "range = 5,",
            "range = \"far\",",
            "9: agents[0].senses[1].range: found \"far\", allowed a number, 0 to 10000 or inf (unlimited)",
        ),
        (
            "range = 5,",
            "range = inf,",
            "9: agents[0].senses[1].range: found inf, allowed 0 to 10000 with measure = \"closeness\"",
        ),
        (
            "range = 5, measure",
            "measure",
            "9: agents[0].senses[1].range: missing, allowed 0 to 10000 with measure = \"closeness\"",
        ),
        (range, "range = 25, sectors = 17", "8: agents[0].senses[0].sectors: found 17, allowed 1 to 16"),
        (
            range,
            "range = 25, sectors = 2.5",
            "8: agents[0].senses[0].sectors: found 2.5, allowed a whole number, 1 to 16, or \"each\"",
        ),
        (
            range,
            "range = 25, sectors = \"all\"",
            "8: agents[0].senses[0].sectors: found \"all\", allowed a whole number, 1 to 16, or \"each\"",
        ),
        (
            range,
            "measure = \"inverse-squared\", nearest = 0.02",
            "8: agents[0].senses[0].measure: found \"inverse-squared\", up to 2500 with nearest = 0.02, times a POI's value of 1; allowed up to 2000",
        ),
        (
            "range = 5, measure = \"closeness\"",
            "measure = \"inverse-squared\", nearest = 0.02",
            "9: agents[0].senses[1].measure: found \"inverse-squared\", up to 2500 with nearest = 0.02; allowed up to 2000",
        ),
        (
            range,
            "range = 25, measure = \"near\"",
            "8: agents[0].senses[0].measure: found \"near\", allowed \"linear\" or \"inverse\" or \"inverse-squared\" or \"exponential\" or \"distance\" or \"closeness\"",
        ),
        (
            range,
            "range = 25, combine = \"average\"",
            "8: agents[0].senses[0].combine: found \"average\", allowed \"share\" or \"sum\" or \"mean\" or \"closest\"",
        ),
        (
            range,
            "range = 25, frame = \"heading\"",
            "8: agents[0].senses[0].frame: found \"heading\" with free motion, which has no heading; allowed \"map\"",
        ),
        (
            range,
            "range = 25, empty = 1e-9",
            "8: agents[0].senses[0].empty: found 1e-9, allowed -1000 to -0.000001 or 0 or 0.000001 to 1000",
        ),
        (range, "range = 25, gain = 0", "8: agents[0].senses[0].gain: found 0, allowed 0.001 to 1000"),
        (range, "range = 25, nearest = 0", "8: agents[0].senses[0].nearest: found 0, allowed 0.01 to 10000"),
        (
            "{ of = \"pois\", range = 25 }",
            "{ range = 25 }",
            "8: agents[0].senses[0].of: missing, allowed \"agents\" or \"pois\" or \"uav\" or \"dog\" or a list of names",
        ),
        ("{ of = \"pois\", range = 25 }", "3", "8: agents[0].senses[0]: found 3, allowed a table"),
        (
            of,
            "of = \"poi\"",
            "8: agents[0].senses[0].of: found \"poi\", allowed \"agents\" or \"pois\" or \"uav\" or \"dog\"; did you mean \"pois\"?",
        ),
        (of, "of = 3", "8: agents[0].senses[0].of: found 3, allowed \"agents\" or \"pois\" or \"uav\" or \"dog\""),
        (of, "of = []", "8: agents[0].senses[0].of: found a list of 0, allowed a list of 1 to 4 names"),
        (of, "of = [\"pois\", \"uav\"]", "8: agents[0].senses[0].of: found \"pois\" with other names, allowed alone"),
        (
            of,
            "of = \"agents\", pois = \"a\"",
            "8: agents[0].senses[0].pois: found without of = \"pois\", allowed with it",
        ),
        (
            of,
            "of = \"pois\", pois = [\"a\", \"c\"]",
            "8: agents[0].senses[0].pois[1]: found \"c\", allowed \"a\" or \"b\"",
        ),
        (of, "of = [\"uav\", \"uav\"]", "8: agents[0].senses[0].of[1]: found \"uav\" again"),
        (
            pois,
            "{ of = \"pois\", sectors = 16 },{ of = \"pois\", sectors = 16 },{ of = \"pois\", sectors = 16 },{ of = \"pois\", sectors = 16 },",
            "7: agents[0].senses: found 68 sectors, allowed up to 64 in all channels",
        ),
        (
            pois,
            "{ of = \"pois\", sectors = 1 },{ of = \"pois\", sectors = 1 },{ of = \"pois\", sectors = 1 },{ of = \"pois\", sectors = 1 },{ of = \"pois\", sectors = 1 },{ of = \"pois\", sectors = 1 },{ of = \"pois\", sectors = 1 },{ of = \"pois\", sectors = 1 },",
            "7: agents[0].senses: found a list of 9, allowed a list of 0 to 8 channels",
        ),
        (motion, "\"flying\"", "6: agents[0].motion.kind: found \"flying\", allowed \"steered\" or \"free\""),
        (motion, "\"free\", min_speed = 1.0", "6: agents[0].motion.min_speed: unknown key, did you mean `max_speed`?"),
        (motion, "\"free\", max_speed = 1001", "6: agents[0].motion.max_speed: found 1001, allowed 0 to 1000"),
        (
            motion,
            "\"steered\", min_speed = 4",
            "6: agents[0].motion.min_speed: found 4, allowed 0 to 3 (motion.max_speed)",
        ),
        ("{ kind = \"free\", max_speed = 1.0 }", "\"free\"", "6: agents[0].motion: found \"free\", allowed a table"),
        (
            leads,
            "leads = \"uav\"",
            "3: agents[0].influence_radius: missing, and \"uav\" has no rule to take it from; allowed 0.01 to 10000",
        ),
        (leads, "leads = \"cat\"", "11: agents[0].leads: found \"cat\", allowed \"uav\" or \"dog\""),
        (
            leads,
            "leads = []\ninfluence_radius = 3",
            "12: agents[0].influence_radius: found without `leads`, which it is the radius of",
        ),
        (
            leads,
            "leads = \"dog\"\ninfluence_radius = 0",
            "12: agents[0].influence_radius: found 0, allowed 0.01 to 10000",
        ),
        (
            control,
            "control = \"still\"\nfitness = \"D\"",
            "16: agents[1].fitness: found with control = \"still\", allowed with \"policy\" or \"choose:CLASS\"\n17: agents[1].rule: found with control = \"still\", allowed with \"follow\"",
        ),
        (
            leads,
            "fitness = \"E\"",
            "11: agents[0].fitness: found \"E\", allowed \"G\" or \"D\" or \"Df\" or \"D++\" or \"Dt\"",
        ),
        (
            steps,
            "steps = 20\nstart_counts = true",
            "18: pois: found \"b\", which comes after others, allowed without world.start_counts",
        ),
        (
            "after = \"a\"",
            "score = \"near\"\nwhen = \"once\"",
            "25: pois[1].score: found \"near\", allowed \"observed\" or \"closeness\"\n26: pois[1].when: found \"once\", allowed \"ever\" or \"end\" or \"mean\"",
        ),
        (
            "after = \"a\"",
            "score = \"closeness\"\n[credit]\nremoves = [[0], [3]]\nled_by = \"none\"",
            "27: credit.removes[1][0]: found 3, allowed 0 to 2 (the last agent)\n28: credit.led_by: found \"none\", allowed \"most-seen\" or \"any-seen\" or \"first\" or \"alone\" or \"anyone\"",
        ),
        (
            "after = \"a\"",
            "[credit]\nremoves = 3",
            "26: credit.removes: found 3, allowed a list of 1 or more lists of agents, or none",
        ),
        (
            "after = \"a\"",
            "[credit]\nremoves = [[0], [1], [2]]",
            "26: credit.removes[0]: found 3 lists, allowed one, or 2 (one per learner)",
        ),
        (leads, "observes = 1", "11: agents[0].observes: found 1, allowed true or false"),
        (leads, "speed = 2", "11: agents[0].speed: found 2, allowed 0 to 1 (motion.max_speed)"),
        (
            leads,
            "heading = [1, 2, 3]",
            "11: agents[0].heading: found a list of 3, allowed a list of 2 numbers, each -1000 to 1000",
        ),
        (leads, "wall_radius = 0.001", "11: agents[0].wall_radius: found 0.001, allowed 0 or 0.01 to 10000"),
        (leads, "wall_gain = 2000", "11: agents[0].wall_gain: found 2000, allowed 0 to 1000"),
        (
            leads,
            "foo = 3",
            "11: agents[0].foo: unknown key, allowed at, control, count, fitness, heading, in, influence_radius, leads, motion, moves_near, name, observes, reach, rule, senses, speed, stays_in, wall_gain, wall_radius",
        ),
        (
            leads,
            "rule = [{ of = \"agents\", to = 1, gain = 1 }]",
            "11: agents[0].rule: found with control = \"policy\", allowed with \"follow\"",
        ),
        (
            "control = \"follow\"\nrule = [{ of = \"agents\", to = 5, gain = -1 }]",
            "control = \"still\"",
            "3: agents[0].influence_radius: missing, and \"dog\" has no rule to take it from; allowed 0.01 to 10000",
        ),
        (control, "control = \"still\"", "16: agents[1].rule: found with control = \"still\", allowed with \"follow\""),
        (
            control,
            "control = \"policy\"",
            "12: agents[1].senses: missing, allowed a list of 1 to 8 channels\n16: agents[1].rule: found with control = \"policy\", allowed with \"follow\"",
        ),
        (
            control,
            "control = \"fly\"",
            "15: agents[1].control: found \"fly\", allowed \"policy\" or \"follow\" or \"nearest:CLASS\" or \"choose:CLASS\" or \"still\"",
        ),
        (
            control,
            "control = \"near:uav\"",
            "15: agents[1].control: found \"near:uav\", allowed \"policy\" or \"follow\" or \"nearest:CLASS\" or \"choose:CLASS\" or \"still\"",
        ),
        (
            control,
            "control = \"nearest:cat\"",
            "15: agents[1].control: found \"nearest:cat\", allowed \"nearest:uav\" or \"nearest:dog\"",
        ),
        (
            control,
            "control = \"nearest:uav\"\nreach = 0",
            "16: agents[1].reach: found 0, allowed 0.01 to 10000 or inf (unlimited)\n17: agents[1].rule: found with control = \"nearest:uav\", allowed with \"follow\"",
        ),
        (
            control,
            "control = \"follow\"\nreach = 5",
            "16: agents[1].reach: found with control = \"follow\", allowed with \"nearest:CLASS\"",
        ),
        (leads, "stays_in = [10, 10, 60, 20]", "11: agents[0].stays_in[2]: found 60, allowed 0 to 50 (the map)"),
        (
            leads,
            "stays_in = [20, 10, 10, 20]",
            "11: agents[0].stays_in: found [20, 10, 10, 20], allowed x0 <= x1 and y0 <= y1",
        ),
        (
            leads,
            "stays_in = [25, 25, 25.5, 25]",
            "5: agents[0].at: found a start at (26, 25), allowed within stays_in, (25, 25) to (25.5, 25)",
        ),
        (leads, "moves_near = \"cat\"", "11: agents[0].moves_near: found \"cat\", allowed a class that it senses"),
        (
            control,
            "control = \"follow\"\nmoves_near = \"uav\"",
            "16: agents[1].moves_near: found \"uav\", allowed a class that it senses",
        ),
        (
            control,
            "control = \"follow\"\nsenses = [{ of = \"pois\" }]",
            "16: agents[1].senses: found with control = \"follow\", allowed with \"policy\" or \"choose:CLASS\"",
        ),
        (
            control,
            "control = \"follow\"\nleads = \"dog\"",
            "16: agents[1].leads: found with control = \"follow\", allowed with \"policy\" or \"choose:CLASS\": others cannot lead yet",
        ),
        (
            "rule = [{ of = \"agents\", to = 5, gain = -1 }]",
            "",
            "12: agents[1].rule: missing, allowed a list of 1 to 8 terms",
        ),
        (
            "rule = [{ of = \"agents\", to = 5, gain = -1 }]",
            "rule = []",
            "16: agents[1].rule: missing, allowed a list of 1 to 8 terms",
        ),
        (rule, "gain = -1", "16: agents[1].rule[0].to: missing, allowed 0.01 to 10000"),
        (rule, "to = 5", "16: agents[1].rule[0].gain: missing, allowed either this or `align`"),
        (rule, "to = 5, gain = 1, align = 1", "16: agents[1].rule[0].align: found with `gain`, allowed either of them"),
        (rule, "to = 5, align = -2000", "16: agents[1].rule[0].align: found -2000, allowed -1000 to 1000"),
        (
            rule,
            "to = 5, gain = 1e-5",
            "16: agents[1].rule[0].gain: found 1e-5, allowed -1000 to -0.001 or 0 or 0.001 to 1000",
        ),
        (rule, "from = 6, to = 5, gain = 1", "16: agents[1].rule[0].from: found 6, allowed 0 to 5 (`to`)"),
        (rule, "to = 0, gain = 1", "16: agents[1].rule[0].to: found 0, allowed 0.01 to 10000"),
        (
            "of = \"agents\", to = 5",
            "of = \"pois\", to = 5",
            "16: agents[1].rule[0].of: found \"pois\", allowed \"agents\" or \"uav\" or \"dog\"",
        ),
        (
            "of = \"agents\", to = 5",
            "of = [\"agents\", \"dog\"], to = 5",
            "16: agents[1].rule[0].of: found \"agents\" with other names, allowed alone",
        ),
        ("name = \"dog\"", "name = \"uav\"", "13: agents[1].name: found \"uav\" again, allowed another name"),
        (
            "name = \"dog\"",
            "name = \"agents\"",
            "13: agents[1].name: found \"agents\", which names all of them, allowed another name",
        ),
        (
            "name = \"dog\"",
            "name = \"a dog\"",
            "13: agents[1].name: found \"a dog\", allowed a name of letters, digits, _ and -",
        ),
        ("name = \"dog\"", "name = 3", "13: agents[1].name: found 3, allowed a name of letters, digits, _ and -"),
        ("name = \"uav\"\n", "", "3: agents[0].name: missing, allowed a name of letters, digits, _ and -"),
        (
            "at = [[20, 25]]\n",
            "",
            "12: agents[1].at: missing, allowed a list of 1 to 1024 positions [x, y], or `count` with `in`",
        ),
        (at, "count = 2", "12: agents[1].in: missing, allowed a table with one of box, disc and circle"),
        (at, "in = { disc = [25, 25, 5] }", "12: agents[1].count: missing, allowed 1 to 1048576, the number of agents"),
        (
            at,
            "at = [[20, 25]]\nin = { disc = [25, 25, 5] }",
            "15: agents[1].in: found with `at`, allowed either of them",
        ),
        (at, "at = [[20, 25]]\ncount = 1", "15: agents[1].count: found with `at`, allowed with `in`"),
        (at, "count = 0\nin = { disc = [25, 25, 5] }", "14: agents[1].count: found 0, allowed 1 to 1048576"),
        (
            at,
            "count = 2\nin = { disc = [45, 25, 6] }",
            "15: agents[1].in.disc: found a circle from (39, 19) to (51, 31), allowed within the map, (0, 0) to (50, 50)",
        ),
        (
            at,
            "count = 2\nin = { circle = [25, 4, 5] }",
            "15: agents[1].in.circle: found a circle from (20, -1) to (30, 9), allowed within the map, (0, 0) to (50, 50)",
        ),
        (
            at,
            "count = 2\nin = { box = [10, 10, 51, 20] }",
            "15: agents[1].in.box[2]: found 51, allowed 0 to 50 (the map)",
        ),
        (
            at,
            "count = 2\nin = { box = [10, 30, 20, 20] }",
            "15: agents[1].in.box: found [10, 30, 20, 20], allowed x0 <= x1 and y0 <= y1",
        ),
        (
            at,
            "count = 2\nin = { box = [10, 30, 20] }",
            "15: agents[1].in.box: found a list of 3, allowed a list of 4 numbers",
        ),
        (at, "count = 2\nin = {}", "15: agents[1].in: found none of its keys, allowed one of box, disc and circle"),
        (
            at,
            "count = 2\nin = { disc = [9, 9, 2], circle = [9, 9, 2] }",
            "15: agents[1].in: found several of its keys, allowed one of box, disc and circle",
        ),
        (at, "count = 2\nin = 3", "15: agents[1].in: found 3, allowed a table"),
        (
            "at = [[20, 25]]",
            "at = []",
            "14: agents[1].at: found a list of 0, allowed a list of 1 to 1024 positions [x, y]",
        ),
        ("at = [[20, 25]]", "at = [[20, 51]]", "14: agents[1].at[0][1]: found 51, allowed 0 to 50 (the map)"),
        ("coupling = 2", "coupling = 4", "24: pois[1].coupling: found 4, allowed 1 to 3 (the number of its observers)"),
        ("coupling = 2", "coupling = 0", "24: pois[1].coupling: found 0, allowed 1 to 3 (the number of its observers)"),
        (
            coupling,
            "coupling = [1, 2, 3]",
            "20: pois[0].coupling: found a list of 3, allowed a list of 2 numbers, each 1 to 3 (the number of its observers)",
        ),
        (
            coupling,
            "coupling = 2\nobservers = \"dog\"",
            "20: pois[0].coupling: found 2, allowed 1 (the number of its observers)",
        ),
        (
            coupling,
            "coupling = 1\nobservers = \"cat\"",
            "21: pois[0].observers: found \"cat\", allowed \"uav\" or \"dog\"",
        ),
        (coupling, "coupling = 1\nvalue = 0", "21: pois[0].value: found 0, allowed 0.001 to 1000"),
        (coupling, "coupling = 1\nradius = 0", "21: pois[0].radius: found 0, allowed 0.01 to 10000"),
        (
            coupling,
            "coupling = 1\nwindows = [[1, 2], [1, 3], [1, 4]]",
            "21: pois[0].windows: found a list of 3, allowed a list of 2 pairs [first, last], or of one for all, or none",
        ),
        (
            coupling,
            "coupling = 1\nwindows = [[3, 2]]",
            "21: pois[0].windows[0]: found the steps from 3 to 2, allowed the earlier one first",
        ),
        (
            coupling,
            "coupling = 1\nwindows = [[1, 21]]",
            "21: pois[0].windows[0][1]: found 21, allowed 1 to 20 (world.steps)",
        ),
        (
            coupling,
            "coupling = 1\nafter = \"b\"",
            "21: pois[0].after: found \"a\" after \"b\" after \"a\", which can never begin",
        ),
        (coupling, "coupling = 1\nafter = \"c\"", "21: pois[0].after: found \"c\", allowed \"a\" or \"b\""),
        ("after = \"a\"", "after = \"b\"", "25: pois[1].after: found \"b\" after \"b\", which can never begin"),
        (
            "after = \"a\"",
            "foo = 3",
            "25: pois[1].foo: unknown key, allowed after, at, count, coupling, gone_within, in, name, observers, radius, score, value, when, windows",
        ),
        ("name = \"b\"", "name = \"a\"", "22: pois[1].name: found \"a\" again, allowed another name"),
        (
            "name = \"b\"",
            "name = \"pois\"",
            "22: pois[1].name: found \"pois\", which names all of them, allowed another name",
        ),
        (steps, "leaders = [[1, 1]]", &*format!("2: world.leaders: {agents}")),
        (steps, "speed = 1", &*format!("2: world.speed: {agents}")),
        (steps, "pois = [[1, 1]]", &*format!("2: world.pois: {groups}")),
        (steps, "observers = \"leaders\"", &*format!("2: world.observers: {agents}")),
        (steps, "windows = [[1, 2]]", &*format!("2: world.windows: {groups}")),
        (steps, "[sense]\ngain = 2", &*format!("3: sense.gain: {agents}")),
        (steps, "[motion]\nmax_speed = 2", &*format!("3: motion.max_speed: {agents}")),
        (steps, "[follow]\nwall_gain = 2", &*format!("3: follow.wall_gain: {agents}")),
        (steps, "[learning]\nparadigm = \"all-leaders\"", &*format!("3: learning.paradigm: {agents}")),
        (
            steps,
            "[learning]\nsharing = \"group\"\ngroups = [[0], [2]]",
            "4: learning.groups[1][0]: found 2, allowed 0 to 1 (the last learner)",
        ),
        (
            steps,
            "[policy]\nactions = \"behaviours\"",
            "3: policy.actions: found \"behaviours\", but the senses of \"uav\" do not begin with POIs and agents in 4 sectors around the heading",
        ),
        (
            steps,
            "[[stages]]\nfrom = 1\nset = { \"agents\" = 3 }",
            "4: stages[0].set.agents: this key cannot change between stages",
        ),
        (
            steps,
            "[[stages]]\nfrom = 1\nset = { \"pois.radius\" = 3 }",
            "4: stages[0].set.pois.radius: found no radius in a list of 2, allowed a, b",
        ),
        (
            steps,
            "[[stages]]\nfrom = 1\nset = { pois.b.coupling = 0 }",
            "4: stages[0].set.pois.b.coupling: found 0, allowed 1 to 3 (the number of its observers)",
        ),
        (
            steps,
            "[[stages]]\nfrom = 1\nset = { \"pois.b.radius\" = 3, \"pois[1].radius\" = 4, pois.b.radius = 5 }",
            "4: stages[0].set.pois.b.radius: pois.b.radius sets this, too: remove one of the two\n\
             4: stages[0].set.pois[1].radius: pois.b.radius sets this, too: remove one of the two",
        ),
        (
            steps,
            "[[stages]]\nfrom = 1\nset = { \"pois.b.x\" = {} }",
            "4: stages[0].set.pois.b.x: unknown key, allowed after, at, count, coupling, gone_within, in, name, observers, radius, score, value, when, windows",
        ),
        (
            steps,
            "[[stages]]\nfrom = 1\nset = { \"world.coupling\" = 3 }",
            &*format!("4: stages[0].set.world.coupling: {groups}"),
        ),
        (
            steps,
            "[[stages]]\nfrom = 1\nset = { \"world.map\" = [20, 20] }",
            "2: stages[0]: agents[0].at[0][0]: found 25.0, allowed 0 to 20 (the map)\n2: stages[0]: agents[0].at[0][1]: found 25.0, allowed 0 to 20 (the map)\n2: stages[0]: agents[0].at[1][0]: found 26.0, allowed 0 to 20 (the map)\n2: stages[0]: agents[0].at[1][1]: found 25.0, allowed 0 to 20 (the map)\n2: stages[0]: agents[1].at[0][1]: found 25.0, allowed 0 to 20 (the map)",
        ),
        (
            "[[pois]]\nname = \"a\"",
            "[[poi]]\nname = \"a\"",
            "17: poi: unknown key, did you mean `pois`?\n25: pois[0].after: found \"a\", allowed \"b\"",
        ),
    ] {
        let text = with(from, to);
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
    let problems: Vec<String> = [
        ("agents", "3"),
        ("agents[9].speed", "3"),
        ("agents.wolf.speed", "3"),
        ("agents.dog", "3"),
        ("agents.dog.speed", "-3"),
        ("agents.dog.sped", "3"),
        ("agents.dog.name.x", "3"),
        ("agents.uav.senses[2].range", "3"),
        (&format!("agents{}", ".x".repeat(200_000)), "3"),
        ("agents.dog.at[0][1]", "'x'"),
        ("learning.paradigm", "'all-leaders'"),
    ]
    .map(|(key, value)| {
        let error = set(key, value).unwrap_err();
        assert!(error.is_usage(), "{error}");
        error.to_string()
    })
    .into();
    assert_eq!(
        problems,
        [
            "--set: found 3, allowed a list of 1 to 8 tables [[agents]]",
            "--set: found no 9 in a list of 2, allowed uav, dog",
            "--set: found no wolf in a list of 2, allowed uav, dog",
            "--set: found 3, allowed a table",
            "--set: found -3, allowed 0 to 3 (motion.min_speed to motion.max_speed)",
            "--set: unknown key, did you mean `speed`?",
            "--set: found \"dog\", which has no key x",
            "--set: found no 2 in a list of 2",
            "--set: found 200000 parts after `agents`, allowed up to 8",
            "--set: found 'x', allowed a number, 0 to 50 (the map)",
            "--set: found in a config with [[agents]], which replaces this key: remove one of the two; without \
             [[agents]], `flotilla check --expand` writes it from the other keys",
        ]
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
