//! Tests the tasks in `configs/tasks/`, with scripted teams that solve them.
//!
//! Baselines and small populations play one task. With `FLOTILLA_LONG=1`, they play all. `FLOTILLA_TASKS=DIR` tests the
//! tasks in another directory.

use crate::support;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;
use std::sync::atomic::AtomicBool;

use crate::support::{Place, TINY};
use flotilla::evaluate::Starts;
use flotilla::{Config, front};
use flotilla_app::ops::{ConfigText, Context};
use flotilla_app::record::folder::Start;
use flotilla_app::script::Script;
use flotilla_studies::questions::parts;
use flotilla_studies::tasks::{self, Request, Task};
use serde_json::Value;

fn task_files(ending: &str) -> Vec<PathBuf> {
    let folder = std::env::var_os("FLOTILLA_TASKS").map(PathBuf::from);
    let folder = folder.unwrap_or_else(|| Path::new(crate::ROOT).join("configs/tasks"));
    let paths = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let mut paths: Vec<PathBuf> = paths.filter(|path| path.extension().is_some_and(|other| other == ending)).collect();
    paths.sort();
    paths
}

fn play(config: &Config, path: &Path) -> Vec<Option<u32>> {
    let script = Script::parse(&fs::read_to_string(path).unwrap()).unwrap();
    let config = &config.validate().unwrap();
    // A team that does not move observes nothing, so the script matters.
    let play = |script: &Script| script.play_from(config.as_ref(), &Starts::Own, 0).unwrap();
    assert!(play(&Script::default()).iter().all(Option::is_none), "{}", path.display());
    play(&script)
}

#[test]
fn scripted_teams_observe_every_poi() {
    let scripts = task_files("csv");
    for path in &scripts {
        let observed = play(&Config::load(&path.with_extension("toml")).unwrap(), path);
        println!("{}: {observed:?}", path.display());
        assert!(observed.iter().all(Option::is_some), "{}: {observed:?}", path.display());
    }
    assert!(scripts.len() >= 8, "{scripts:?}");
}

/// Windows of 10 steps for the last POIs, as in one point of the study.
#[test]
fn a_scripted_team_solves_the_relay_with_an_enforced_hand_over() {
    let relay = parts(&['c']).into_iter().find(|part| part.name == "relay_forced").unwrap();
    let path = Path::new(crate::ROOT).join("studies/configs/questions/relay_forced.csv");
    let sweep = relay.sweep(&[]).unwrap();
    let config = &sweep.points[4].config;
    assert_eq!(config.world.windows[2], [37, 46]);
    let observed = play(config, &path);
    assert!(observed.iter().all(Option::is_some), "{observed:?}");
}

#[test]
fn invalid_scripts_are_refused_before_training() {
    let place = Place::new(&[]).on_cpu().slow();
    // Nobody reaches a POI in two steps.
    let task =
        TINY.replace("pois = [[10, 9], [20, 9]]", "pois = [[10, 40], [20, 40]]").replace("steps = 8", "steps = 2");
    place.write("task.toml", &task);
    let play = |words: &str| format!("tasks {words} --trials 2 --population 0 --quiet");
    let head = "leader,until,x,y,speed\n";
    for (rows, message) in [
        ("", "there are no rows"),
        ("7,5,1,1,1\n", "row 1: leader 7 of 2"),
        ("0,5,NaN,1,1\n", "row 1: x, y and speed have to be finite"),
        ("0,5,1,1,-1\n", "speed at least 0"),
        ("0,5,1,1,1\n0,5,2,2,1\n", "row 2: `until` has to be larger"),
        ("0,5,1,1,fast\n", "task.csv"),
    ] {
        place.write("task.csv", format!("{head}{rows}"));
        place.fails(2, &play("task.toml"), &[message]);
        assert!(!place.path("tasks").exists());
    }
    place.write("task.csv", format!("{head}0,5,1,1,1\n"));
    finds(&place, &play("task.toml"), "the scripted team has G 0.00");
    // Baselines and teams would play in different worlds.
    place.write("staged.toml", task + "\n[[stages]]\nfrom = 1\nset = { \"world.coupling\" = 1 }\n");
    place.fails(1, &play("staged.toml --resume"), &["leave the stages out"]);
    // Without a scripted team, a champion has to solve the task.
    fs::remove_file(place.path("task.csv")).unwrap();
    finds(&place, &play("task.toml --resume"), "no champion solves it, and there is no scripted team");
}

/// Between these marks, the page has what the test below prints.
const MARKS: [&str; 2] = ["<!-- what comes out: cargo test tasks:: -->\n", "<!-- so far -->\n"];

/// Runs a command that must fail with exit code 1 and this message. It may print a table before. Returns its output.
fn finds(place: &Place, line: &str, message: &str) -> Output {
    let output = place.run(line);
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(1) && error.contains(message), "{line}: {error}");
    output
}

/// Returns the cells of a table by the task, which is in the first column.
fn cells(table: &str) -> BTreeMap<String, Vec<String>> {
    let row = |line: &str| line.trim_matches('|').split('|').map(|cell| cell.trim().to_string()).collect();
    let rows = table.lines().filter(|line| line.starts_with("| ") && !line.starts_with("| -")).map(row);
    rows.map(|row: Vec<String>| (row[0].clone(), row)).collect()
}

/// If results change on purpose, `FLOTILLA_LONG=1 FLOTILLA_WRITE_TASKS=1 cargo test --release tasks::` writes the
/// page's table again.
#[test]
fn baselines_and_small_populations_do_not_solve_tasks() {
    let path = Path::new(crate::ROOT).join("docs/results/tasks-tables.md");
    let page = fs::read_to_string(&path).unwrap();
    let pictures = fs::read_to_string(path.with_file_name("tasks.md")).unwrap();
    let tasks = task_files("toml");
    assert!(tasks.len() >= 8, "{tasks:?}");
    for task in &tasks {
        let name = task.file_stem().unwrap().to_str().unwrap();
        assert!(pictures.contains(&format!("(tasks/{name}.svg)")), "{name} has no picture on the page");
        assert!(path.with_file_name("tasks").join(name).with_extension("svg").is_file(), "{name}");
    }
    // This task takes a twentieth of the time of all.
    let is_played = |task: &&PathBuf| support::is_long() || task.ends_with("slalom.toml");
    let list: Vec<String> = tasks.iter().filter(is_played).map(|task| task.display().to_string()).collect();
    let place = Place::new(&[]).on_cpu().slow();
    let (table, _) = place.good(&format!("tasks {} --trials 10 --population 0 --quiet", list.join(" ")));
    println!("{table}");
    let (before, rest) = page.split_once(MARKS[0]).unwrap();
    let (expected, after) = rest.split_once(MARKS[1]).unwrap();
    let (actual, rows) = (format!("\n{table}"), cells(expected));
    assert!(rows.len() == tasks.len() + 1, "{rows:?}");
    for (task, row) in cells(&table) {
        assert_eq!(rows[&task], row, "docs/results/tasks-tables.md");
    }
    if !support::is_long() {
        return;
    }
    match std::env::var_os("FLOTILLA_WRITE_TASKS") {
        Some(_) => fs::write(&path, [before, MARKS[0], &actual, MARKS[1], after].concat()).unwrap(),
        None => assert_eq!(expected, actual, "docs/results/tasks-tables.md"),
    }
}

#[test]
fn tasks_resume_and_those_that_a_constant_speed_solves_fail() {
    let place = Place::new(&[("tiny.toml", TINY)]).on_cpu().slow();
    let play = |words: &str| format!("tasks {words} --trials 2 --population 0 --quiet");
    // Only large populations fix the number of elites.
    let line = play("tiny.toml --out a --set learning.elites=1");
    let output = finds(&place, &line, "the baseline constant action reaches G 1.00");
    assert_eq!(place.run(&format!("{line} --resume")), output);
    // Without `--resume`, the same command does not overwrite the runs.
    place.fails(1, &play("tiny.toml --out a"), &["--resume"]);
    place.fails(2, &play("tiny.toml tiny.toml --out c"), &["two configs"]);
}

/// Both would train in the same directories.
#[test]
fn the_large_population_differs_from_the_small_ones() {
    let place = Place::new(&[("tiny.toml", TINY)]).on_cpu();
    let error = place.refused(2, "tasks tiny.toml --trials 2 --population 50 --out refused");
    assert!(error.contains("--population 50") && !place.path("refused").exists(), "{error}");
    for key in ["fitness=G", "trials=3", "elites=1"] {
        let error = place.refused(2, &format!("tasks tiny.toml --set learning.{key} --out refused"));
        assert!(error.contains("all tasks fix this key") && !place.path("refused").exists(), "{error}");
    }
}

#[test]
fn a_stop_while_baselines_play_leaves_a_suite_to_resume() {
    let place = Place::new(&[]);
    let config = ConfigText { text: TINY.into(), name: "tiny.toml".into(), set: vec![] };
    let tasks = vec![Task { name: "tiny".into(), config, script: None }];
    let (out, start, stop) = (place.path("out"), Start::Fresh, AtomicBool::new(true));
    let request = Request { tasks, out, named: true, start, trials: 2, population: 0, seed: 1 };
    let context = Context { stop: &stop, ..Context::new(&|_| ()) };
    let error = tasks::run(&request, &mut &mut front::cpu(), context).unwrap_err();
    assert_eq!((error.code(), &*error.to_string()), ("stopped", "with everything saved"));
}

#[test]
fn champions_play_held_out_episodes_if_starts_or_pois_move() {
    let place = Place::new(&[]).on_cpu();
    let (head, tail) = TINY.split_once("pois = [[10, 9], [20, 9]]\ncoupling = 2\n").unwrap();
    let region = "[[pois]]\nname = 'poi'\ncount = 2\nin = { box = [8, 7, 22, 11] }\ncoupling = 2\n";
    for (name, text) in [
        ("start_jitter", format!("{TINY}start_jitter = 2.0\n")),
        ("poi_jitter", format!("{TINY}poi_jitter = 2.0\n")),
        ("region", format!("{head}{tail}{region}")),
    ] {
        place.write(format!("{name}.toml"), text);
        let output = place.run(&format!("tasks {name}.toml --trials 2 --population 0 --quiet --json"));
        let found: Value = serde_json::Deserializer::from_slice(&output.stdout).into_iter().next().unwrap().unwrap();
        let task = &found["tasks"][0];
        assert!(task["scripted_g"].is_null() && task["scripted"] == false, "{task}");
        for trained in task["trained"].as_array().unwrap() {
            let run = format!("tasks/{name}/50-{}", trained["fitness"].as_str().unwrap());
            for trial in 0..2 {
                let line = format!("rollout {run} --trial {trial} --episodes 200 --seed 0 --json");
                let played = place.json(&line);
                // The champions are policy 0 of every leader.
                let expected = played["team_0"]["mean"].as_f64().unwrap() / played["pois"].as_f64().unwrap();
                assert_eq!(trained["champion_g"][trial].as_f64(), Some(expected), "{run}, trial {trial}");
            }
        }
    }
}
