//! Tests `--json`: standard output is always JSON, and a failure is one object.

use std::fs;

use crate::support::{Place, SMALL, Words};
use flotilla::backend::cpu::Cpu;
use serde_json::Value;

/// Names that file systems allow, but that need escapes in JSON, in a shell or in a terminal.
const ODD_NAMES: [&str; 5] = ["a\"b", "back\\slash", "it's", "Zürich – 東京", "{\"code\": 1}"];
/// Names that every command rejects.
const INVALID_NAMES: [&str; 4] = ["line\nbreak", "red\u{1b}[31m", "left\u{202e}right", "c1\u{9b}"];

/// Runs a command with `--json`. Returns its exit code and the objects on standard output, line by line.
fn run_json(place: &Place, words: impl Words) -> (i32, Vec<Value>) {
    let words = [words.words(), vec!["--json".into()]].concat();
    let output = place.run(&words);
    let text = String::from_utf8(output.stdout).expect("JSON is UTF-8");
    assert!(text.ends_with('\n'), "{words:?} printed {text:?}");
    assert!(!text.contains(['\u{202e}', '\u{9b}', '\u{1b}']), "{words:?} could control a terminal: {text:?}");
    let parse = |line: &str| serde_json::from_str(line).unwrap_or_else(|error| panic!("{words:?}: {error}: {line}"));
    (output.status.code().unwrap(), text.lines().map(parse).collect())
}

/// Runs a command that must succeed, and returns its object.
fn result(place: &Place, words: impl Words) -> Value {
    let words = words.words();
    let (code, objects) = run_json(place, &words);
    assert_eq!((code, objects.len()), (0, 1), "{words:?}: {objects:?}");
    assert!(objects[0].get("code").is_none(), "{words:?}: {objects:?}");
    objects.into_iter().next().unwrap()
}

/// Runs a command that must fail with the same exit code with and without `--json`. Returns its error code and message.
fn failure(place: &Place, words: impl Words) -> (String, String) {
    let words = words.words();
    let (code, objects) = run_json(place, &words);
    assert_eq!(place.run(&words).status.code(), Some(code), "{words:?}");
    let [object] = &objects[..] else { panic!("{words:?}: {objects:?}") };
    let names: Vec<_> = object.as_object().unwrap().keys().map(String::as_str).collect();
    assert_eq!(names, ["code", "message", "remedy"], "{words:?}");
    assert!(object["remedy"].is_null() || object["remedy"].as_str().is_some_and(|text| !text.is_empty()), "{object}");
    let text = |name: &str| object[name].as_str().unwrap_or_else(|| panic!("{words:?}: {object}")).to_string();
    assert!(!text("message").is_empty(), "{words:?}");
    assert_eq!(code == 2, text("code") == "usage", "{words:?}: exit code {code}");
    (text("code"), text("message"))
}

#[test]
fn names_that_need_escapes_give_valid_json() {
    let place = Place::new(&[]).on_cpu();
    for name in ODD_NAMES {
        let config = format!("{name}.toml");
        place.write(&config, SMALL);
        let trained = result(&place, &["train", &config, "--out", name]);
        assert_eq!((&trained["folder"], &trained["config"]), (&name.into(), &name.into()));
        for field in ["backend", "description", "adapter", "driver", "threads"] {
            assert!(trained.get(field).is_some(), "{field}");
        }
        assert_eq!(trained["backend"], "cpu");
        let picture = format!("{name}.svg");
        assert_eq!(result(&place, &["plot", name, "--out", &picture])["out"], *picture);
        let replayed = result(&place, &["replay", name]);
        assert!(replayed["out"].as_str().unwrap().starts_with(name), "{replayed}");
        assert_eq!(result(&place, &["rollout", name])["backend"], "cpu");
    }
    let place = Place::new(&[("x.toml", SMALL)]).on_cpu();
    for (name, seed) in [(ODD_NAMES[0], "0"), (ODD_NAMES[1], "1")] {
        result(&place, &["train", "x.toml", "--out", name, "--seed", seed]);
    }
    let compared = result(&place, &["compare", ODD_NAMES[0], ODD_NAMES[1]]);
    let folders = compared["comparisons"][0]["arms"].as_array().unwrap().iter().map(|arm| &arm["folders"][0]);
    assert_eq!(folders.collect::<Vec<_>>(), ODD_NAMES[..2].iter().collect::<Vec<_>>());
    result(&place, &["plot", ODD_NAMES[0], ODD_NAMES[1], "--out", "\"both\".svg"]);
}

#[test]
fn other_commands_print_json() {
    let sweep = SMALL.replace("coupling = 2\n", "") + "[grid]\n\"world.coupling\" = [1, 2]\n";
    let place = Place::new(&[("x.toml", SMALL), ("s.toml", &sweep), ("\"x\".toml", SMALL)]).on_cpu();
    assert!(result(&place, "check \"x\".toml")["cost"].is_object());
    assert!(result(&place, "devices")["cpu"].is_string());
    let flags = "--seeds 2 --generations 1 --population 8 --paradigm all-leaders";
    assert_eq!(result(&place, &format!("baseline x.toml {flags}"))["teams"], 16);
    let baseline = result(&place, "baseline x.toml --seeds 2 --set learning.generations=1");
    // Two generations of 8 random teams: generation 0, and generation 1 as in training.
    assert_eq!((&baseline["backend"], &baseline["teams"]), (&"cpu".into(), &16.into()));
    for name in ["constant", "action", "network", "shared", "open_loop", "hill_climbing"] {
        let seeds = baseline[name]["seeds"].as_array().unwrap().iter().map(|pois| pois.as_f64().unwrap());
        assert_eq!(baseline[name]["mean"].as_f64(), Some(seeds.sum::<f64>() / 2.0), "{name}");
    }
    // Random episodes are played only if starts or POIs move. Then constant actions have an interval, too.
    assert!(baseline["episodes"] == 1 && baseline["constant"]["interval_95"].is_null(), "{baseline}");
    for key in ["start_jitter", "poi_jitter"] {
        let flags = format!("--seeds 2 --episodes 5 --generations 1 --set learning.{key}=2");
        let moved = result(&place, &format!("baseline x.toml {flags}"));
        assert!(moved["episodes"] == 5 && moved["constant"]["interval_95"].is_array(), "{moved}");
    }
    let swept = result(&place, &["sweep", "s.toml", "--out", ODD_NAMES[0]]);
    assert_eq!(swept["points"].as_array().unwrap().len(), 2);
    // The reason why a point is missing quotes the text of its file.
    place.write(format!("{}/points/0001/config.toml", ODD_NAMES[0]), "[world]\n\"x\u{202e}\u{9b}y\" = 1\n");
    let (code, collected) = run_json(&place, &["sweep", "s.toml", "--out", ODD_NAMES[0], "--collect"]);
    let missing = collected[0]["points"][1]["missing"].as_str().unwrap();
    assert!(code == 1 && missing.contains("x\u{202e}"), "{missing:?}");
    let (code, lines) = run_json(&place, "bench x.toml --rollout-only --teams 4,8 --agents 6");
    assert_eq!((code, lines.len()), (0, 2));
    assert!(lines.iter().all(|line| line["backend"] == "cpu" && line["description"].is_string()));
    if Cpu::levels().len() > 1 {
        let verified = result(&place, "verify x.toml --set world.steps=2 --teams 2 --adapter cpu");
        assert_eq!((&verified["equal"], &verified["version"]), (&true.into(), &env!("CARGO_PKG_VERSION").into()));
        assert_eq!(verified["comparisons"].as_array().unwrap().len(), Cpu::levels().len() - 1);
    }
}

#[test]
fn failures_print_one_object() {
    let bad = "\"\u{202e}\\\"\" = 1\n[world]\n";
    let place = Place::new(&[("x.toml", SMALL), ("text", "no folder"), ("bad.toml", bad)]).on_cpu();
    result(&place, "train x.toml --out run");
    let code = |line: &str| failure(&place, line).0;
    assert_eq!(code("train none.toml"), "config_unreadable");
    assert_eq!(code("train bad.toml"), "config_invalid");
    assert_eq!(code("train x.toml --set world.steps=0"), "usage");
    assert_eq!(code("train x.toml --out run"), "exists");
    assert_eq!(code("train x.toml --out text"), "refused");
    assert_eq!(code("train x.toml --out text/run"), "not_written");
    assert_eq!(code("train x.toml --adapter 0"), "usage");
    assert_eq!(code("train x.toml --no-such-flag"), "usage");
    assert_eq!(code("paper --out run"), "refused");
    assert_eq!(code("replay nowhere"), "no_run");
    assert_eq!(code("replay run --trial 9"), "usage");
    assert_eq!(code("rollout x.toml"), "usage");
    assert_eq!(code("sweep none.toml"), "config_unreadable");
    assert_eq!(code("tasks none.toml"), "config_unreadable");
    assert_eq!(code("tasks x.toml --set world.steps=0"), "usage");
    assert_eq!(code("tasks x.toml ./x.toml"), "usage");
    assert_eq!(code("sweep x.toml --collect"), "config_invalid");
    assert_eq!(code("bench x.toml --teams 0"), "usage");
    assert_eq!(code("baseline none.toml"), "config_unreadable");
    assert_eq!(code("compare run"), "usage");
    assert_eq!(code("plot text --out a.svg"), "no_run");
    assert_eq!(code("plot run --out a.doc"), "usage");
    assert_eq!(code("check none.toml"), "config_unreadable");
    assert_eq!(code("verify --set world.steps=3"), "usage");
    assert_eq!(code("no-such-command"), "usage");
    for name in ["theirs", "locked"] {
        fs::create_dir(place.path(name)).unwrap();
    }
    place.write("theirs/metrics.csv", "of another program");
    assert_eq!(code("train x.toml --out theirs"), "not_ours");
    let lock = fs::File::create(place.path("locked/.lock")).unwrap();
    lock.lock().unwrap();
    assert_eq!(code("train x.toml --out locked --resume"), "locked");
    assert_eq!(code("rollout x.toml --policies none.safetensors"), "not_read");
    place.write("run/config.toml", SMALL.replace("steps = 9", "steps = 8"));
    assert_eq!(code("plot run --out a.svg"), "damaged");
    for name in INVALID_NAMES {
        let (kind, message) = failure(&place, &["check", name]);
        assert!(kind == "usage" && !message.contains(name), "{message}");
    }
    for name in ODD_NAMES {
        let (kind, message) = failure(&place, &["check", name]);
        assert!(kind == "config_unreadable" && message.contains(name), "{message}");
    }
}

#[test]
fn every_command_with_json_fails_in_json() {
    let place = Place::new(&[]);
    let mut count = 0;
    for command in flotilla_cli::command().get_subcommands() {
        if command.get_arguments().any(|arg| arg.get_long() == Some("json")) {
            let name = command.get_name();
            for word in ["--no-such-flag", "--a\"b", "--\\", "--\u{2028}", "--red\u{1b}[31m", "--left\u{202e}right\n"] {
                assert_eq!(failure(&place, &[name, word]).0, "usage", "{name} {word:?}");
            }
            count += 1;
        }
    }
    assert!(count > 10, "{count} commands have --json");
}

#[test]
fn collect_reports_missing_points() {
    let sweep = SMALL.replace("coupling = 2\n", "") + "[grid]\n\"world.coupling\" = [1, 2]\n";
    let place = Place::new(&[("s.toml", &sweep)]).on_cpu();
    result(&place, "sweep s.toml --out s --shard 1/2");
    let (code, collected) = run_json(&place, "sweep s.toml --out s --collect");
    assert_eq!((code, collected.len()), (1, 1));
    let points = collected[0]["points"].as_array().unwrap();
    assert_eq!(points.iter().filter(|point| point["missing"].is_string()).count(), 1);
}

#[test]
fn verify_json_lists_every_comparison() {
    for (index, (_, info)) in crate::support::adapters("verify_json_lists_every_comparison").into_iter().enumerate() {
        let adapter = index.to_string();
        let line = ["verify", "--worlds", "2", "--teams", "3", "--json", "-q", "--adapter", &adapter];
        let output = crate::support::flotilla().args(line).output().unwrap();
        assert!(output.status.success(), "{info}: {}", String::from_utf8_lossy(&output.stderr));
        let object: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        let comparisons = object["comparisons"].as_array().unwrap();
        assert_eq!((&object["equal"], comparisons.is_empty()), (&true.into(), false));
        for comparison in comparisons {
            assert_eq!(comparison["adapter"], info.to_string());
            assert_eq!((&comparison["worlds"], &comparison["equal"]), (&2.into(), &true.into()));
            assert!(comparison["agent_steps"].as_u64().unwrap() > 0 && comparison["failure"].is_null());
        }
    }
}
