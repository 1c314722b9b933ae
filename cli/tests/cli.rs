//! Tests the command line: exit codes, messages, and the streams that they are printed to.

use crate::support;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use tempfile::TempDir;

/// A valid config with two leaders, four followers and two POIs. Tests replace lines of it by their number.
const GOOD: &str = "\
[world]
map = [50, 40]
leaders = [[10, 5], [20, 5]]
followers = [[12, 2], [8, 2], [22, 2], [18, 2]]
pois = [[10, 15], [20, 15]]
coupling = 3
steps = 25
dt = 0.2
heading = 1.5
speed = 0
[motion]
min_speed = 0
max_speed = 3
[follow]
attraction_radius = 5
repulsion_radius = 1
[sense]
poi_range = inf
density = 'linear'
[policy]
hidden = [10]
[learning]
population = 50
";

fn flotilla(args: &[&str]) -> Output {
    support::flotilla().args(args).output().unwrap()
}

fn write_config(text: impl AsRef<[u8]>) -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.toml");
    fs::write(&path, text).unwrap();
    (folder, path)
}

fn check(text: impl AsRef<[u8]>, flags: &[&str]) -> Output {
    let (_folder, path) = write_config(text);
    flotilla(&[&["check", path.to_str().unwrap()], flags].concat())
}

/// Returns the error message of a command that failed with exit code 1, without the folder's name.
fn failure_message(output: Output) -> String {
    assert_eq!(output.status.code(), Some(1), "{}", String::from_utf8_lossy(&output.stderr));
    error_message(output)
}

/// Returns the error message of a command, without the folder's name. Checks that standard output is empty.
fn error_message(output: Output) -> String {
    let error = String::from_utf8(output.stderr).unwrap();
    assert!(output.stdout.is_empty(), "{}", String::from_utf8_lossy(&output.stdout));
    let error = error.strip_prefix("error: ").expect(&error).trim_end();
    let name = |line: &str| line.find("x.toml").map_or(line.to_string(), |at| line[at..].to_string());
    error.lines().map(name).collect::<Vec<_>>().join("\n")
}

/// Returns [`GOOD`] with one line replaced, numbered from 1.
fn with_line(number: usize, line: &str) -> String {
    GOOD.lines().enumerate().map(|(at, old)| if at + 1 == number { line } else { old }).collect::<Vec<_>>().join("\n")
}

#[test]
fn check_prints_the_resolved_config_and_accepts_it_again() {
    let output = check(GOOD, &[]);
    assert_eq!(output.status.code(), Some(0));
    assert!(output.stderr.is_empty());
    let text = String::from_utf8(output.stdout).unwrap();
    for line in [
        "poi_range = inf",
        "agent_range = 5.0",
        "fitness = \"Df\"",
        "# A run of this plays 25755 teams, champions included:", // 5 trials × 101 generations × 51 teams
        "#   agents per team         6, of which 2 learn",
        "#   team-steps              643875",
        "#   agent-steps             3863250",
        "#   parameters per policy   112",          // 9·10 + 11·2
        "#   policies of all trials  224000 bytes", // 5 × 2 × 50 × 112 × 4
        "#   record of one team      232 bytes",    // (25 × 2 + 4 × 2) × 4
    ] {
        assert!(text.lines().any(|found| found == line), "no {line:?} in\n{text}");
    }
    assert_eq!(String::from_utf8(check(&text, &[]).stdout).unwrap(), text);
}

#[test]
fn a_heading_in_degrees_causes_a_note() {
    let stderr = |text: &str| String::from_utf8(check(text, &[]).stderr).unwrap();
    let note =
        "world.heading has 90, which is more than a full turn: headings are in radians, and 90 degrees would be 1.5708";
    let text = GOOD.replacen("heading = 1.5\n", "heading = 90\n", 1);
    assert!(stderr(&text).contains(note), "{}", stderr(&text));
    let text = GOOD.replacen("heading = 1.5\n", "heading = 1.5708\n", 1);
    assert!(!stderr(&text).contains("full turn"), "{}", stderr(&text));
}

#[test]
fn json_is_one_object_with_config_and_cost() {
    let output = check(GOOD, &["--json", "--paradigm", "all-leaders", "--fitness", "D++", "--seed", "7"]);
    let json: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(json["config"]["learning"]["fitness"], "D++");
    assert_eq!(json["config"]["learning"]["seed"], 7);
    assert_eq!(json["config"]["sense"]["poi_range"], serde_json::Value::Null);
    assert_eq!((json["cost"]["learners"].as_u64(), json["cost"]["agents"].as_u64()), (Some(6), Some(6)));
    assert_eq!(json["cost"]["team_steps"], 643_875);
}

#[test]
fn the_cost_of_the_largest_run_does_not_overflow() {
    let text = GOOD.replace("steps = 25", "steps = 10000").replace("population = 50", "population = 1048576")
        + "trials = 100\ngenerations = 1000000\nepisodes_per_team = 1000\n";
    let output = check(text, &["--json"]);
    let text = String::from_utf8(output.stdout).unwrap();
    // 100 × 1 000 001 × 1 048 577 × 1000 × 10 000 does not fit in 64 bits.
    assert!(text.contains("\"team_steps\":1048578048577000000000"), "{text}");
}

#[test]
fn another_language_is_one_problem() {
    for (text, line, language) in [
        ("# a config\nworld:\n  leaders: [[1, 2]]\n  steps: 5\n", 2, "YAML"),
        ("---\nsteps: 5\n", 1, "YAML"),
        ("{\n  \"world\": {\"steps\": 5},\n  \"learning\": {}\n}\n", 1, "JSON"),
    ] {
        let output = check(text, &[]);
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{stderr}");
        let found = format!(":{line}: found {language}, allowed TOML");
        assert!(stderr.contains(&found) && stderr.matches(": found").count() == 1, "{stderr}");
    }
}

/// Each message has the line, the key, the value found and the allowed values.
#[test]
fn wrong_values_are_reported_with_line_and_range() {
    let many = |count: usize| format!("[{}]", vec!["[1, 1]"; count].join(", "));
    let agents = "found 1028 agents with the leaders, allowed 1 to 1024";
    let leaders = format!("leaders = {}", many(1025));
    let pois = format!("pois = {}", many(257));
    let followers = format!("followers = {}", many(1022 + 4));
    for (line, text, expected) in [
        // unknown keys and sections
        (13, "max_sped = 3", "motion.max_sped: unknown key, did you mean `motion.max_speed`?"),
        (10, "max_speed = 3", "world.max_speed: unknown key, did you mean `motion.max_speed`?"),
        (21, "hiden = [10]", "policy.hiden: unknown key, did you mean `policy.hidden`?"),
        (21, "qwertz = 1", "policy.qwertz: unknown key; [policy] has actions, hidden"),
        (20, "[polcy]", "polcy: unknown section, did you mean `policy`?"),
        // wrong types
        (8, "dt = 'fast'", "world.dt: found 'fast', allowed a number, 0.0001 to 10"),
        (8, "dt = true", "world.dt: found true, allowed a number, 0.0001 to 10"),
        (8, "dt = [1]", "world.dt: found a list of 1, allowed a number, 0.0001 to 10"),
        (8, "dt = {}", "world.dt: found a table, allowed a number, 0.0001 to 10"),
        (8, "dt = 1979-05-27", "world.dt: found 1979-05-27, allowed a number, 0.0001 to 10"),
        (7, "steps = 2.5", "world.steps: found 2.5, allowed a whole number, 1 to 10000"),
        (2, "map = 50", "world.map: found 50, allowed a list of 2 numbers"),
        (2, "map = [50 60]", "found `50 60`, allowed numbers with a comma between them"),
        (2, "map = [50]", "world.map: found a list of 1, allowed a list of 2 numbers"),
        (3, "leaders = [[1, 2], 3]", "world.leaders[1]: found 3, allowed a list of 2 numbers"),
        (3, "leaders = [[1, 2, 3]]", "world.leaders[0]: found a list of 3, allowed a list of 2 numbers"),
        (3, "leaders = [[1, 'a']]", "world.leaders[0][1]: found 'a', allowed a number, 0 to 40 (the map)"),
        (19, "density = 3", "sense.density: found 3, allowed \"linear\" or \"inverse\" or \"mean\""),
        (19, "density = 'flat'", "sense.density: found 'flat', allowed \"linear\" or \"inverse\" or \"mean\""),
        (23, "fitness = 'x'", "learning.fitness: found 'x', allowed \"G\" or \"D\" or \"Df\" or \"D++\" or \"Dt\""),
        (
            23,
            "fitness = 'df'",
            "learning.fitness: found 'df', allowed \"G\" or \"D\" or \"Df\" or \"D++\" or \"Dt\"; did you mean \"Df\"?",
        ),
        (
            23,
            "paradigm = 'all-leader'",
            "learning.paradigm: found 'all-leader', allowed \"leader-follower\" or \"all-leaders\"; did you mean \"all-leaders\"?",
        ),
        (
            23,
            "elites = 0.1",
            "learning.elites: found 0.1, allowed a whole number, 0 to 50 (learning.population), or a percentage such as \"10%\"",
        ),
        (23, "mutation = ''", "learning.mutation: found '', allowed \"scaled\" or \"additive\""),
        (23, "paradigm = 'x'", "learning.paradigm: found 'x', allowed \"leader-follower\" or \"all-leaders\""),
        // NaN and infinity
        (8, "dt = nan", "world.dt: found nan, allowed 0.0001 to 10"),
        (8, "dt = inf", "world.dt: found inf, allowed 0.0001 to 10"),
        (2, "map = [50, inf]", "world.map[1]: found inf, allowed 1 to 10000"),
        (9, "heading = -inf", "world.heading: found -inf, allowed -1000 to 1000"),
        (18, "poi_range = nan", "sense.poi_range: found nan, allowed 0 to 10000 or inf (unlimited)"),
        (18, "poi_range = -inf", "sense.poi_range: found -inf, allowed 0 to 10000 or inf (unlimited)"),
        (18, "agent_range = -1", "sense.agent_range: found -1, allowed 0 to 10000 or inf (unlimited)"),
        (18, "agent_range = 1e-3", "sense.agent_range: found 1e-3, allowed 0 or 0.01 to 10000 or inf (unlimited)"),
        // one heading, one per leader, or one per agent
        (
            9,
            "heading = [1, 2, 3]",
            "world.heading: found a list of 3, allowed one number or a list of 2 (one per leader) or 6 (one per agent)",
        ),
        (
            9,
            "heading = []",
            "world.heading: found a list of 0, allowed one number or a list of 2 (one per leader) or 6 (one per agent)",
        ),
        (9, "heading = [1, 'a']", "world.heading[1]: found 'a', allowed a number, -1000 to 1000"),
        // out of range
        (8, "dt = 0", "world.dt: found 0, allowed 0.0001 to 10"),
        (8, "dt = -0.2", "world.dt: found -0.2, allowed 0.0001 to 10"),
        (8, "dt = 99999999999999999999", "world.dt: found 99999999999999999999, allowed 0.0001 to 10"),
        (2, "map = [0, 40]", "world.map[0]: found 0, allowed 1 to 10000"),
        (7, "steps = 0", "world.steps: found 0, allowed 1 to 10000"),
        (7, "steps = 10_001", "world.steps: found 10_001, allowed 1 to 10000"),
        (7, "observation_radius = 0", "world.observation_radius: found 0, allowed 0.01 to 10000"),
        (10, "speed = 4", "world.speed: found 4, allowed 0 to 3 (motion.min_speed to motion.max_speed)"),
        (12, "min_speed = 4", "motion.min_speed: found 4, allowed 0 to 3 (motion.max_speed)"),
        (13, "max_speed = 1e4", "motion.max_speed: found 1e4, allowed 0 to 1000"),
        (13, "max_speed = 1e-40", "motion.max_speed: found 1e-40, allowed 0 or 0.000001 to 1000"),
        (13, "max_acceleration = -1", "motion.max_acceleration: found -1, allowed 0 to 1000"),
        (13, "max_turn_rate = -1", "motion.max_turn_rate: found -1, allowed 0 to 1000"),
        (15, "attraction_radius = 0", "follow.attraction_radius: found 0, allowed 0.01 to 10000"),
        (16, "repulsion_radius = 6", "follow.repulsion_radius: found 6, allowed 0.01 to 5 (follow.attraction_radius)"),
        (16, "attraction_gain = -1", "follow.attraction_gain: found -1, allowed 0 to 1000"),
        (16, "repulsion_gain = 1e9", "follow.repulsion_gain: found 1e9, allowed 0 to 1000"),
        (16, "wall_gain = -1", "follow.wall_gain: found -1, allowed 0 to 1000"),
        (23, "population = 1", "learning.population: found 1, allowed 2 to 1048576"),
        (23, "population = 1048577", "learning.population: found 1048577, allowed 2 to 1048576"),
        (23, "elites = 51", "learning.elites: found 51, allowed 0 to 50 (learning.population)"),
        (
            23,
            "elites = \"0%\"",
            "learning.elites: found \"0%\", allowed 0 to 50 (learning.population), or above \"0%\", up to \"100%\"",
        ),
        (
            23,
            "elites = \"ten\"",
            "learning.elites: found \"ten\", allowed 0 to 50 (learning.population), or above \"0%\", up to \"100%\"",
        ),
        (
            23,
            "parents = \"elites\"\nelites = 0",
            "learning.parents: found \"elites\" with learning.elites = 0, allowed with 1 or more",
        ),
        (23, "partners = 17", "learning.partners: found 17, allowed 1 to 16"),
        (
            23,
            "partners = 3\nsharing = \"all\"",
            "learning.partners: found 3 with learning.sharing = \"all\", allowed 1: a team has a single policy",
        ),
        (
            23,
            "partners = 2\nsharing = \"group\"\ngroups = [[0, 1]]",
            "learning.partners: found 2 with learning.sharing = \"group\", allowed 1: a team has a single policy",
        ),
        (23, "groups = [[0, 1]]", "learning.groups: found with learning.sharing = \"none\", allowed with \"group\""),
        (
            23,
            "groups = [[0, 1], [1]]\nsharing = \"group\"",
            "learning.groups[1]: found learner 1 again, allowed in one group",
        ),
        (
            23,
            "groups = [[1]]\nsharing = \"group\"",
            "learning.groups[0]: found no learner 0, allowed every learner in one group",
        ),
        (
            23,
            "groups = [[0, 2]]\nsharing = \"group\"",
            "learning.groups[0][1]: found 2, allowed 0 to 1 (the last learner)",
        ),
        (
            23,
            "partners = 2\npopulation = 600000",
            "learning.partners: found 2, which makes 1200000 teams per generation, allowed 1048576",
        ),
        (23, "hall_of_fame = 1001", "learning.hall_of_fame: found 1001, allowed 0 to 1000"),
        (
            23,
            "hall_of_fame = 3\nsharing = \"all\"",
            "learning.hall_of_fame: found 3 with learning.sharing = \"all\", allowed 0: a team has a single policy",
        ),
        (
            23,
            "hall_of_fame = 3\nmethod = \"snes\"",
            "learning.hall_of_fame: found 3, allowed 0 unless learning.method is \"tournament\"",
        ),
        (
            23,
            "hall_of_fame = 3\npopulation = 400000",
            "learning.hall_of_fame: found 3, which makes 1200000 teams per generation, allowed 1048576",
        ),
        (
            23,
            "teams = \"sorted\"\nsharing = \"all\"",
            "learning.teams: found \"sorted\" with learning.sharing = \"all\", allowed \"random\": a team has a single policy",
        ),
        (
            23,
            "teams = \"softmax\"\nmethod = \"snes\"",
            "learning.teams: found \"softmax\", allowed \"random\" unless learning.method is \"tournament\"",
        ),
        (
            23,
            "team_elites = 2\npartners = 3",
            "learning.team_elites: found 2 with learning.partners = 3, allowed 0: a policy plays in several teams",
        ),
        (
            23,
            "team_g_elites = 1\nhall_of_fame = 4",
            "learning.team_g_elites: found 1 with learning.hall_of_fame = 4, allowed 0: a policy plays in several teams",
        ),
        (
            23,
            "team_elites = 40\nteam_g_elites = 10",
            "learning.team_elites: found 1 elites, 40 team_elites and 10 team_g_elites, allowed 50 together: learning.population",
        ),
        (23, "team_elites = 51", "learning.team_elites: found 51, allowed 0 to 50 (learning.population)"),
        (23, "temperature = 0", "learning.temperature: found 0, allowed 0.000001 to 1000000"),
        (23, "initial = \"zero\"", "learning.initial: found \"zero\", allowed \"normal\" or \"uniform\""),
        (23, "initial_scale = 0", "learning.initial_scale: found 0, allowed 0.000001 to 1000"),
        (23, "test_episodes = 1001", "learning.test_episodes: found 1001, allowed 0 to 1000"),
        (23, "leniency = \"min\"", "learning.leniency: found \"min\", allowed \"mean\" or \"max\""),
        (23, "generations = -1", "learning.generations: found -1, allowed 0 to 1000000"),
        (23, "trials = 0", "learning.trials: found 0, allowed 1 to 4096"),
        (23, "episodes_per_team = 0", "learning.episodes_per_team: found 0, allowed 1 to 1000"),
        (23, "start_jitter = -1", "learning.start_jitter: found -1, allowed 0 to 10000"),
        (23, "mutation_sigma = -1", "learning.mutation_sigma: found -1, allowed 0 to 100"),
        (23, "mutation_probability = 1.5", "learning.mutation_probability: found 1.5, allowed 0 to 1"),
        (23, "seed = -1", "learning.seed: found -1, allowed 0 to 9223372036854775807"),
        (
            23,
            "seed = 18446744073709551615",
            "learning.seed: found 18446744073709551615, allowed 0 to 9223372036854775807",
        ),
        // positions, coupling and sizes
        (3, "leaders = [[10, 41]]", "world.leaders[0][1]: found 41, allowed 0 to 40 (the map)"),
        (4, "followers = [[51, 4]]", "world.followers[0][0]: found 51, allowed 0 to 50 (the map)"),
        (5, "pois = [[1, 1], [1, -1]]", "world.pois[1][1]: found -1, allowed 0 to 40 (the map)"),
        (3, "leaders = []", "world.leaders: found a list of 0, allowed a list of 1 to 1024 positions [x, y]"),
        (5, "pois = []", "world.pois: found a list of 0, allowed a list of 1 to 256 positions [x, y]"),
        (3, &leaders, "world.leaders: found a list of 1025, allowed a list of 1 to 1024 positions [x, y]"),
        (5, &pois, "world.pois: found a list of 257, allowed a list of 1 to 256 positions [x, y]"),
        (4, &followers, "world.followers: found a list of 1026, allowed a list of 0 to 1023 positions [x, y]"),
        (6, "coupling = 9", "world.coupling: found 9, allowed 1 to 6 (the number of agents)"),
        (6, "coupling = 0", "world.coupling: found 0, allowed 1 to 6 (the number of agents)"),
        (6, "coupling = [3, 7]", "world.coupling[1]: found 7, allowed 1 to 6 (the number of agents)"),
        (
            6,
            "coupling = [3]",
            "world.coupling: found a list of 1, allowed a list of 2 numbers, each 1 to 6 (the number of agents)",
        ),
        (
            21,
            "hidden = [9, 9, 9, 9]",
            "policy.hidden: found a list of 4, allowed a list of 0 to 3 numbers, each 1 to 64",
        ),
        (21, "hidden = [65]", "policy.hidden[0]: found 65, allowed 1 to 64"),
        (21, "hidden = [10, 0]", "policy.hidden[1]: found 0, allowed 1 to 64"),
        (21, "hidden = 10", "policy.hidden: found 10, allowed a list of 0 to 3 numbers, each 1 to 64"),
    ] {
        let expected = format!("x.toml:{line}: {expected}");
        let found = failure_message(check(with_line(line, text), &[]));
        assert_eq!(found.lines().next(), Some(expected.as_str()), "{text}");
    }
    let crowd =
        GOOD.replace("[[12, 2], [8, 2], [22, 2], [18, 2]]", &many(1023)).replace("[[10, 5], [20, 5]]", &many(5));
    assert_eq!(failure_message(check(crowd, &[])), format!("x.toml:4: world.followers: {agents}"));
    for (key, problem) in [
        ("hall_of_fame = 3", "hall_of_fame: found 3 with a single leader, allowed 0: it has no partners"),
        ("partners = 2", "partners: found 2 with a single leader, allowed 1: it has no partners"),
        ("teams = 'sorted'", "teams: found \"sorted\" with a single leader, allowed \"random\": it has no partners"),
    ] {
        let single = GOOD.replace("[[10, 5], [20, 5]]", "[[10, 5]]") + key + "\n";
        assert_eq!(failure_message(check(single, &[])), format!("x.toml:24: learning.{problem}"));
    }
}

#[test]
fn policies_above_the_memory_limit_are_refused() {
    let text = GOOD.replace("population = 50", "population = 1048576\ntrials = 4096");
    assert_eq!(
        failure_message(check(text, &[])),
        "x.toml:23: learning.population: found 1048576, whose policies of all trials take 3584 GiB, allowed 256 GiB"
    );
}

#[test]
fn several_problems_are_reported_together_in_line_order() {
    let text = GOOD.replace("coupling = 3", "coupling = 9").replace("max_speed", "max_sped").replace("[10]", "[65]");
    assert_eq!(
        failure_message(check(format!("{text}trials = 0\nfoo = 1\n"), &["--population", "1"])),
        "x.toml
x.toml:6: world.coupling: found 9, allowed 1 to 6 (the number of agents)
x.toml:13: motion.max_sped: unknown key, did you mean `motion.max_speed`?
x.toml:21: policy.hidden[0]: found 65, allowed 1 to 64
x.toml:24: learning.trials: found 0, allowed 1 to 4096
x.toml:25: learning.foo: unknown key; [learning] has elites, episodes_per_team, fitness, generations, groups, hall_of_fame, initial, \
         initial_scale, leniency, method, mutation, mutation_probability, mutation_sigma, paradigm, parents, partners, poi_jitter, population, search_sigma, search_step, seed, sharing, start_jitter, team_elites, team_g_elites, teams, temperature, test_episodes, trials
--population: found 1, allowed 2 to 1048576"
    );
}

#[test]
fn missing_positions_and_non_table_sections_are_named() {
    let leaders = "world.leaders: missing, allowed a list of 1 to 1024 positions [x, y]";
    let pois = "world.pois: missing, allowed a list of 1 to 256 positions [x, y]";
    assert_eq!(failure_message(check("", &[])), format!("x.toml\nx.toml:1: {leaders}\nx.toml:1: {pois}"));
    let found = failure_message(check("# no positions\n\n[world]\nsteps = 3\n", &[]));
    assert_eq!(found, format!("x.toml\nx.toml:3: {leaders}\nx.toml:3: {pois}"));
    let found = failure_message(check(
        format!("learning = 3\nseed = 1\n{GOOD}").replace("[learning]\npopulation = 50\n", ""),
        &[],
    ));
    let expected = "x.toml\nx.toml:1: learning: found 3, allowed a section [learning]\n\
                    x.toml:2: seed: unknown key, did you mean `learning.seed`?";
    assert_eq!(found, expected);
}

#[test]
fn toml_syntax_errors_name_their_line() {
    for (line, text, reported_line, part) in [
        (8, "dt =", 8, ""),
        (8, "dt = 0.2 0.3", 8, "0.2 0.3"),
        (8, "steps = 3", 8, "steps"),
        (13, "max speed = 3", 13, ""),
        (2, "map = [50, 40", 3, "comma"),
    ] {
        let found = failure_message(check(with_line(line, text), &[]));
        let start = format!("x.toml:{reported_line}: ");
        assert!(found.starts_with(&start) && found.len() > start.len() && found.contains(part), "{text}: {found}");
        assert_eq!(found.lines().count(), 1, "{text}: {found}");
    }
    let two_errors = failure_message(check(with_line(8, "dt =").replace("max_speed = 3", "max_speed ="), &[]));
    assert_eq!(two_errors.lines().filter(|line| line.starts_with("x.toml:")).count(), 2, "{two_errors}");
}

#[test]
fn unreadable_config_files_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_string();
    let assert_refused = |path: &str, reason: &str| {
        let found = failure_message(flotilla(&["check", path]));
        assert!(found.contains(reason) && found.contains("x.toml"), "{found}");
    };
    assert_refused(&path("x.toml"), "cannot be read: ");
    fs::create_dir(path("dir-x.toml")).unwrap();
    assert_refused(&path("dir-x.toml"), "it is a directory; name a config file in it");
    fs::write(path("latin-x.toml"), b"[world]\n# caf\xe9\n").unwrap();
    assert_refused(&path("latin-x.toml"), "line 2 is not UTF-8 text");
    // 100 MB of zeros, refused before most of it is read.
    let big = path("big-x.toml");
    fs::File::create(Path::new(&big)).unwrap().set_len(100_000_000).unwrap();
    assert_refused(&big, "larger than 1048576 bytes");
}

#[test]
fn overrides_out_of_range_name_the_flag() {
    let whole = "allowed 0 to 9223372036854775807";
    for (flags, expected) in [
        (["--population", "1"], "--population: found 1, allowed 2 to 1048576"),
        (["--trials", "0"], "--trials: found 0, allowed 1 to 4096"),
        (["--generations", "-1"], "--generations: found -1, allowed 0 to 1000000"),
        (["--generations", "1e3"], "--generations: found 1000.0, allowed a whole number, 0 to 1000000"),
        (["--seed", "-1"], &format!("--seed: found -1, {whole}")),
    ] {
        let output = check(GOOD, &flags);
        assert_eq!(output.status.code(), Some(2), "an out-of-range flag is wrong usage");
        assert_eq!(error_message(output), expected);
    }
    let not_a_number = check(GOOD, &["--trials", "five"]);
    let message = error_message(not_a_number);
    assert!(message.starts_with("invalid value 'five' for '--trials <N>': allowed a number\n"), "{message}");
    // A negative number is parsed as the value of a flag, not as another flag.
    for (line, flag) in [
        ("replay x --trial -1", "--trial <best|worst|N>"),
        ("replay x --step -2", "--step <N>"),
        ("sweep x --shards -1", "--shards <N>"),
    ] {
        let output = flotilla(&line.split(' ').collect::<Vec<_>>());
        assert_eq!(output.status.code(), Some(2), "{line}");
        let message = error_message(output);
        assert!(message.contains(&format!("for '{flag}': allowed")) && !message.contains("tip:"), "{line}: {message}");
    }
    // A flag replaces an invalid value of the file.
    assert_eq!(check(with_line(23, "trials = 0"), &["--trials", "3"]).status.code(), Some(0));
}

#[test]
fn wrong_usage_exits_with_code_2() {
    for args in [
        &["check"][..],
        &["chekc", "configs/chaotic.toml"],
        &["check", "configs/chaotic.toml", "--sed", "1"],
        &["check", "configs/chaotic.toml", "--seed"],
        &["check", "configs/chaotic.toml", "--seed", "many"],
        &["check", "configs/chaotic.toml", "--fitness", "E"],
        &["check", "configs/chaotic.toml", "--paradigm", "leaders"],
        &["check", "configs/chaotic.toml", "another.toml"],
        &["verify", "configs/chaotic.toml", "--worlds", "3"],
        &["sweep", "configs/sweeps/coupling.toml", "--shards", "4"],
        &["sweep", "configs/sweeps/coupling.toml", "--gpus", "2"],
        &[],
    ] {
        let output = flotilla(args);
        assert_eq!(output.status.code(), Some(2), "{args:?}");
        assert!(output.stdout.is_empty() && !output.stderr.is_empty(), "{args:?}");
    }
    // All commands report wrong numbers in the same form.
    for (line, allowed) in [
        ("verify --worlds 0", "a whole number from 1 to 100000"),
        ("verify --seed -1", "a whole number from 0 to 4294967295"),
        ("bench --teams 2,x", "a whole number from 2 to 1048576"),
        ("bench --threads 0", "a whole number from 1 to 1024"),
        ("bench --agents 0", "a whole number from 1 to 1024"),
        ("bench --teams 1", "a whole number from 2 to 1048576"),
        ("bench --steps 25,10001", "a whole number from 1 to 10000"),
        ("replay run --fps 1.5", "a whole number from 1 to 50"),
        ("rollout x.toml --policies p --episodes 0", "a whole number from 1 to 1000000"),
        ("rollout x.toml --policies p --episodes 2 --start-jitter far", "a number"),
        ("rollout x.toml --policies p --episodes 2 --poi-jitter far", "a number"),
        ("baseline x.toml --seeds 0", "a whole number from 1 to 4096"),
        ("train x.toml --trials far", "a number"),
    ] {
        let output = flotilla(&line.split(' ').collect::<Vec<_>>());
        assert_eq!(output.status.code(), Some(2), "{line}");
        let (message, value) = (error_message(output), line.rsplit([' ', ',']).next().unwrap());
        assert!(message.contains(&format!(": allowed {allowed}\n")) && message.contains(value), "{line}: {message}");
    }
    let output = flotilla(&["bench", "--backend", "cpu", "--agents", "1024"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(error_message(output).contains("341 leaders and 683 followers"));
    // Suggested commands are quoted, so that they can be pasted into a shell.
    let message = failure_message(flotilla(&["plot", "no run; here"]));
    assert!(message.ends_with("`flotilla train CONFIG --out 'no run; here'` makes a run there"), "{message}");
    assert_eq!(flotilla(&["--help"]).status.code(), Some(0));
    assert_eq!(flotilla(&["--version"]).status.code(), Some(0));
}

#[test]
fn a_closed_standard_output_is_not_an_error() {
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let mut child = support::flotilla();
    let child = child.args(["check", "configs/chaotic.toml"]).stdout(writer).stderr(std::process::Stdio::piped());
    let output = child.spawn().unwrap().wait_with_output().unwrap();
    assert_eq!((output.status.code(), String::from_utf8_lossy(&output.stderr).as_ref()), (Some(0), ""));
}

/// Returns the JSON objects that `bench --json` prints, one per line.
fn bench_json(flags: &[&str]) -> Vec<serde_json::Value> {
    let output = flotilla(&[&["bench", "--backend", "cpu", "--json"], flags].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

#[test]
fn bench_json_has_plausible_values() {
    let objects = bench_json(&["--teams", "20"]);
    let [object] = &objects[..] else { panic!("one combination gives {} objects", objects.len()) };
    assert_eq!(object["backend"], "cpu");
    assert!(object["adapter"].is_null());
    assert_eq!([&object["teams"], &object["agents"], &object["steps"]], [20, 12, 25]);
    // Other programs on the machine change the rates and the share, so that they have no upper limits here.
    for rate in [
        "team_steps_per_s",
        "generations_per_s",
        "generation_team_steps_per_s",
        "ceiling_operations_per_s",
        "ceiling_share",
    ] {
        assert!(object[rate].as_f64().is_some_and(|rate| rate > 0.0), "{rate} of {object}");
    }
    // A wrong count of operations would leave this range.
    assert!(object["operations_per_team_step"].as_f64().is_some_and(|count| (4e3..8e3).contains(&count)), "{object}");
}

#[test]
fn bench_measures_every_combination() {
    let objects = bench_json(&["--teams", "2,3", "--steps", "1,2", "--agents", "3,7", "--rollout-only"]);
    let found: Vec<_> =
        objects.iter().map(|o| ["agents", "steps", "teams"].map(|key| o[key].as_u64().unwrap())).collect();
    let expected: Vec<_> = [3, 7]
        .into_iter()
        .flat_map(|agents| [1, 2].into_iter().flat_map(move |steps| [2, 3].map(|teams| [agents, steps, teams])))
        .collect();
    assert_eq!(found, expected);
    for object in &objects {
        assert_eq!(object["pois"], 4, "the config has 4 POIs: {object}");
        assert!(object.get("generations_per_s").is_none(), "only rollouts are measured: {object}");
    }
}

#[test]
fn bench_profile_reports_the_parts_of_a_generation() {
    let [object] = &bench_json(&["--teams", "50", "--profile"])[..] else { panic!("one combination gives one object") };
    let profile = object["profile"].as_object().unwrap();
    let parts =
        ["rollout_and_scores_ms", "teams_and_starts_ms", "fitness_and_champions_ms", "selection_and_mutation_ms"];
    for part in parts {
        assert!(profile[part].as_f64().is_some_and(|ms| ms > 0.0), "{part}: {object}");
    }
    assert_eq!(profile.len(), parts.len(), "the CPU has no other parts: {object}");
}

#[test]
fn bench_plays_trained_teams() {
    let mean_g = |generations: &str| {
        let flags = ["--teams", "50", "--trained", generations, "--rollout-only"];
        bench_json(&flags)[0]["mean_g"].as_f64().unwrap()
    };
    let (random, trained) = (mean_g("0"), mean_g("30"));
    assert!(trained > random + 0.1, "mean G {random} of random teams, {trained} of trained ones");
}

/// `bench` plays the first of several stages. Ten steps are enough for the windows of this stage only.
#[test]
fn bench_plays_the_first_stage() {
    let stage = |from, windows| format!("[[stages]]\nfrom = {from}\nset = {{ 'world.windows' = {windows} }}\n");
    let text = [
        include_str!("../../configs/strictly_forward.toml").replace("[world]", "[world]\nwindows = [[1, 25], [1, 25]]"),
        stage(0, "[[1, 10], [2, 10]]"),
        stage(1, "[[20, 25], [1, 25]]"),
    ]
    .concat();
    let (_folder, path) = write_config(text);
    let path = path.to_str().unwrap();
    assert_eq!(bench_json(&[path, "--teams", "50", "--steps", "10", "--rollout-only"]).len(), 1);
    let short = flotilla(&["bench", "--backend", "cpu", path, "--steps", "9", "--teams", "50"]);
    let error = String::from_utf8_lossy(&short.stderr);
    assert!(short.status.code().is_some_and(|code| (1..=2).contains(&code)) && error.contains("windows"), "{error}");
}

#[test]
fn an_unknown_flag_named_like_a_config_key_suggests_set() {
    let stderr = |arguments: &[&str]| String::from_utf8(flotilla(arguments).stderr).unwrap();
    assert!(stderr(&["train", "x.toml", "--steps", "50"]).contains("'--set world.steps=VALUE'"));
    assert!(stderr(&["check", "x.toml", "--start-jitter=2"]).contains("'--set learning.start_jitter=VALUE'"));
    // No suggestion if the command has no --set or does not use the key, or if the config has no such key.
    assert!(!stderr(&["rollout", "run", "--generations", "3"]).contains("VALUE"));
    assert!(!stderr(&["plot", "run", "--steps", "50"]).contains("--set"));
    assert!(!stderr(&["train", "x.toml", "--colour", "red"]).contains("VALUE"));
    let (_folder, path) = write_config(include_str!("../../configs/chaotic.toml"));
    let ambiguous = stderr(&["check", path.to_str().unwrap(), "--set", "generations=3"]);
    assert!(
        ambiguous.contains("`learning.generations`") && ambiguous.contains("`checkpoint.generations`"),
        "{ambiguous}"
    );
}

#[test]
fn help_lists_every_command_once_in_a_group() {
    let help = String::from_utf8(flotilla(&["help"]).stdout).unwrap();
    let mut group = "";
    let mut found = Vec::new();
    for line in help.lines() {
        match line.strip_prefix("  ") {
            Some(command) if !command.starts_with('-') => found.push((group, command.split(' ').next().unwrap())),
            Some(_) => {}
            None => group = line,
        }
    }
    let mut names: Vec<_> = found.iter().map(|(_, name)| name.to_string()).collect();
    names.sort();
    let mut commands: Vec<_> =
        flotilla_cli::command().get_subcommands().map(|command| command.get_name().to_string()).collect();
    commands.retain(|name| name != "help");
    commands.sort();
    assert_eq!(names, commands);
    assert!(found.contains(&("Train:", "sweep")) && found.contains(&("Look at results:", "replay")), "{found:?}");
}
