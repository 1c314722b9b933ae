//! Tests the command line: exit codes, messages, and the streams that they are printed to.

use crate::support::{self, GOOD, Place, Words, table, with_line};
use std::fs;
use std::process::Output;

use serde_json::Value;

/// Runs the program at the root of the checkout.
fn flotilla(words: impl Words) -> Output {
    support::flotilla().args(words.words()).output().unwrap()
}

fn check(text: impl AsRef<[u8]>, flags: &[&str]) -> Output {
    let place = Place::new(&[]);
    place.write("x.toml", text);
    place.run(&[&["check", "x.toml"], flags].concat())
}

/// Checks that a command failed with this exit code and printed nothing to standard output. Returns its error message,
/// of which each line begins at the name of the config if it has that.
fn error_message(code: i32, output: Output) -> String {
    let error = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(code), "{error}");
    assert!(output.stdout.is_empty(), "{}", String::from_utf8_lossy(&output.stdout));
    let error = error.strip_prefix("error: ").expect(&error).trim_end();
    let name = |line: &str| line.find("x.toml").map_or(line.to_string(), |at| line[at..].to_string());
    error.lines().map(name).collect::<Vec<_>>().join("\n")
}

fn failure_message(output: Output) -> String {
    error_message(1, output)
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
    let single = check(GOOD.replace("[[10, 5], [20, 5]]", "[[10, 5]]"), &[]);
    assert!(String::from_utf8(single.stdout).unwrap().contains("of which 1 learns\n"));
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
    let json: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(json["config"]["learning"]["fitness"], "D++");
    assert_eq!(json["config"]["learning"]["seed"], 7);
    assert_eq!(json["config"]["sense"]["poi_range"], Value::Null);
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

/// The program prints the messages of the engine, which `tests/config.rs` checks for every line of the table.
#[test]
fn wrong_values_are_reported_with_line_and_range() {
    for [line, text, expected] in table(include_str!("../../tests/data/refusals/keys.txt"), 106).iter().step_by(10) {
        let found = failure_message(check(with_line(line.parse().unwrap(), text), &[]));
        assert_eq!(found.lines().next(), Some(&*format!("x.toml:{line}: {expected}")), "{text}");
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
    let place = Place::new(&[]);
    fs::create_dir(place.path("dir-x.toml")).unwrap();
    place.write("latin-x.toml", b"[world]\n# caf\xe9\n");
    // 100 MB of zeros, refused before most of it is read.
    fs::File::create(place.path("big-x.toml")).unwrap().set_len(100_000_000).unwrap();
    for (name, reason) in [
        ("x.toml", "cannot be read: "),
        ("dir-x.toml", "it is a directory; name a config file in it"),
        ("latin-x.toml", "line 2 is not UTF-8 text"),
        ("big-x.toml", "larger than 1048576 bytes"),
    ] {
        let found = failure_message(place.run(&["check", name]));
        assert!(found.contains(reason) && found.contains("x.toml"), "{found}");
    }
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
        assert_eq!(error_message(2, check(GOOD, &flags)), expected);
    }
    let message = error_message(2, check(GOOD, &["--trials", "five"]));
    assert!(message.starts_with("invalid value 'five' for '--trials <N>': allowed a number\n"), "{message}");
    // A negative number is parsed as the value of a flag, not as another flag.
    for (line, flag) in [
        ("replay x --trial -1", "--trial <best|worst|N>"),
        ("replay x --step -2", "--step <N>"),
        ("sweep x --shards -1", "--shards <N>"),
    ] {
        let message = error_message(2, flotilla(line));
        assert!(message.contains(&format!("for '{flag}': allowed")) && !message.contains("tip:"), "{line}: {message}");
    }
    // A flag replaces an invalid value of the file.
    assert_eq!(check(with_line(23, "trials = 0"), &["--trials", "3"]).status.code(), Some(0));
}

#[test]
fn wrong_usage_exits_with_code_2() {
    for line in [
        "check",
        "chekc configs/chaotic.toml",
        "check configs/chaotic.toml --sed 1",
        "check configs/chaotic.toml --seed",
        "check configs/chaotic.toml --seed many",
        "check configs/chaotic.toml --fitness E",
        "check configs/chaotic.toml --paradigm leaders",
        "check configs/chaotic.toml another.toml",
        "verify configs/chaotic.toml --worlds 3",
        "sweep configs/sweeps/coupling.toml --shards 4",
        "sweep configs/sweeps/coupling.toml --gpus 2",
        "",
    ] {
        let output = flotilla(line);
        assert_eq!(output.status.code(), Some(2), "{line}");
        assert!(output.stdout.is_empty() && !output.stderr.is_empty(), "{line}");
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
        let (message, value) = (error_message(2, flotilla(line)), line.rsplit([' ', ',']).next().unwrap());
        assert!(message.contains(&format!(": allowed {allowed}\n")) && message.contains(value), "{line}: {message}");
    }
    let message = error_message(2, flotilla("bench --backend cpu --agents 1024"));
    assert!(message.contains("341 leaders and 683 followers"), "{message}");
    // Suggested commands are quoted, so that they can be pasted into a shell.
    let message = failure_message(flotilla(&["plot", "no run; here"]));
    assert!(message.ends_with("`flotilla train CONFIG --out 'no run; here'` makes a run there"), "{message}");
    assert_eq!(flotilla("--help").status.code(), Some(0));
    assert_eq!(flotilla("--version").status.code(), Some(0));
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
fn bench_json(flags: &str) -> Vec<Value> {
    let output = flotilla(&format!("bench --backend cpu --json {flags}"));
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

#[test]
fn bench_json_has_plausible_values() {
    let objects = bench_json("--teams 20");
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
    let objects = bench_json("--teams 2,3 --steps 1,2 --agents 3,7 --rollout-only");
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
    let [object] = &bench_json("--teams 50 --profile")[..] else { panic!("one combination gives one object") };
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
        let flags = format!("--teams 50 --trained {generations} --rollout-only");
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
    let place = Place::new(&[("x.toml", &text)]).on_cpu().slow();
    let measured = place.good("bench x.toml --json --teams 50 --steps 10 --rollout-only").0;
    assert!(measured.lines().count() == 1 && serde_json::from_str::<Value>(&measured).is_ok(), "{measured}");
    let short = place.run("bench x.toml --steps 9 --teams 50");
    let error = String::from_utf8_lossy(&short.stderr);
    assert!(short.status.code().is_some_and(|code| (1..=2).contains(&code)) && error.contains("windows"), "{error}");
}

#[test]
fn an_unknown_flag_named_like_a_config_key_suggests_set() {
    let stderr = |line: &str| String::from_utf8(flotilla(line).stderr).unwrap();
    assert!(stderr("train x.toml --steps 50").contains("'--set world.steps=VALUE'"));
    assert!(stderr("check x.toml --start-jitter=2").contains("'--set learning.start_jitter=VALUE'"));
    // No suggestion if the command has no --set or does not use the key, or if the config has no such key.
    assert!(!stderr("rollout run --generations 3").contains("VALUE"));
    assert!(!stderr("plot run --steps 50").contains("--set"));
    assert!(!stderr("train x.toml --colour red").contains("VALUE"));
    let ambiguous = stderr("check configs/chaotic.toml --set generations=3");
    assert!(
        ambiguous.contains("`learning.generations`") && ambiguous.contains("`checkpoint.generations`"),
        "{ambiguous}"
    );
}

#[test]
fn help_lists_every_command_once_in_a_group() {
    let help = String::from_utf8(flotilla("help").stdout).unwrap();
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
