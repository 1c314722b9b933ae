//! Tests the tasks in `configs/tasks/`, with scripted teams that solve some of them.
//!
//! A scripted team is a table next to the config, with the columns `leader,until,x,y,speed`. Before step `until`, the
//! leader drives to a place with at most this speed, and waits there. A leader's rows are in order.
//!
//! Baselines and small populations play one task. With `FLOTILLA_LONG=1`, they play all.
//!
//! `FLOTILLA_TRACE=1` prints positions every five steps. `FLOTILLA_TASKS=DIR` tests the tasks in another directory.

#![cfg(feature = "cli")]

mod support;

use std::collections::BTreeMap;
use std::f32::consts::PI;
use std::fs;
use std::path::{Path, PathBuf};

use assert_cmd::cargo::cargo_bin_cmd;
use flotilla::Config;
use tempfile::TempDir;

fn task_files(ending: &str) -> Vec<PathBuf> {
    let folder = std::env::var_os("FLOTILLA_TASKS").map(PathBuf::from);
    let folder = folder.unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/tasks"));
    let paths = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let mut paths: Vec<PathBuf> = paths.filter(|path| path.extension().is_some_and(|other| other == ending)).collect();
    paths.sort();
    paths
}

/// A leader's target before a step.
struct Leg {
    leader: usize,
    until: u32,
    place: [f32; 2],
    speed: f32,
}

/// Plays one team by a script, and returns the step at which each POI was first observed.
fn play(config: &Config, script: &[Leg]) -> Vec<Option<u32>> {
    let mut stepper = flotilla::stepper(config, 1, false).unwrap();
    let leaders = config.learners();
    let mut observed = vec![None; config.world.pois.len()];
    while !stepper.is_over(0) {
        let step = stepper.steps()[0];
        let mut actions = [0.0, -1.0].repeat(leaders);
        let states = stepper.states();
        for (leader, action) in actions.chunks_exact_mut(2).enumerate() {
            let Some(leg) = script.iter().find(|leg| leg.leader == leader && step < leg.until) else { continue };
            let vector = |vectors: &[f32]| [vectors[2 * leader], vectors[2 * leader + 1]];
            let ([x, y], [ahead, up]) = (vector(states.positions), vector(states.headings));
            let (dx, dy) = (leg.place[0] - x, leg.place[1] - y);
            let distance = dx.hypot(dy);
            let turn = (ahead * dy - up * dx).atan2(ahead * dx + up * dy);
            action[0] = turn / PI;
            // Slow down near the place, and if it is not ahead.
            let speed = leg.speed.min(2.0 * distance) * turn.cos().max(0.0);
            action[1] = 2.0 * speed / config.motion.max_speed as f32 - 1.0;
        }
        stepper.step(&actions).unwrap();
        for (first, _) in observed
            .iter_mut()
            .zip(stepper.observed())
            .filter(|(first, observed_now)| first.is_none() && **observed_now)
        {
            *first = Some(step + 1);
        }
        if std::env::var_os("FLOTILLA_TRACE").is_some() && step % 5 == 4 {
            let places: Vec<String> =
                stepper.states().positions.chunks(2).map(|at| format!("{:.0},{:.0}", at[0], at[1])).collect();
            println!("{:3} {} {:?}", step + 1, places.join(" "), stepper.observed());
        }
    }
    observed
}

#[test]
fn scripted_teams_observe_every_poi() {
    let scripts = task_files("csv");
    for path in &scripts {
        let config = Config::load(&path.with_extension("toml")).unwrap();
        let mut table = csv::Reader::from_path(path).unwrap();
        assert_eq!(table.headers().unwrap(), vec!["leader", "until", "x", "y", "speed"]);
        let script: Vec<Leg> = table
            .records()
            .map(|row| {
                let row = row.unwrap();
                let number = |at: usize| row[at].trim().parse::<f32>().unwrap();
                let place = [number(2), number(3)];
                Leg { leader: number(0) as usize, until: number(1) as u32, place, speed: number(4) }
            })
            .collect();
        let observed = play(&config, &script);
        println!("{}: {observed:?}", path.display());
        assert!(
            std::env::var_os("FLOTILLA_TRACE").is_some() || observed.iter().all(Option::is_some),
            "{}: {observed:?}",
            path.display()
        );
        // A team that does not move observes nothing, so the script matters.
        assert!(play(&config, &[]).iter().all(Option::is_none), "{}", path.display());
    }
    assert!(!scripts.is_empty());
}

/// Between these marks, the page has what the test below prints.
const MARKS: [&str; 2] = ["<!-- what comes out: cargo test --test tasks -->\n", "<!-- so far -->\n"];

/// Runs `flotilla tasks` without large populations. Returns its exit code, standard output and standard error.
fn run(folder: &Path, line: &str) -> (Option<i32>, String, String) {
    let line = format!("tasks {line} --population 0 --backend cpu --quiet");
    let output = cargo_bin_cmd!("flotilla").args(line.split_whitespace()).current_dir(folder).output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

/// Returns the cells of a table by the task, which is in the first column.
fn cells(table: &str) -> BTreeMap<String, Vec<String>> {
    let row = |line: &str| line.trim_matches('|').split('|').map(|cell| cell.trim().to_string()).collect();
    let rows = table.lines().filter(|line| line.starts_with("| ") && !line.starts_with("| -")).map(row);
    rows.map(|row: Vec<String>| (row[0].clone(), row)).collect()
}

/// If results change on purpose, `FLOTILLA_LONG=1 FLOTILLA_WRITE_TASKS=1 cargo test --release --test tasks` writes the
/// page's table again.
#[test]
fn baselines_and_small_populations_do_not_solve_tasks() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/results/tasks.md");
    let page = fs::read_to_string(&path).unwrap();
    let tasks = task_files("toml");
    assert!(tasks.len() >= 8, "{tasks:?}");
    for task in &tasks {
        let name = task.file_stem().unwrap().to_str().unwrap();
        assert!(page.contains(&format!("(tasks/{name}.svg)")), "{name} has no picture on the page");
        assert!(path.with_file_name("tasks").join(name).with_extension("svg").is_file(), "{name}");
    }
    // This task takes a twentieth of the time of all.
    let is_played = |task: &&PathBuf| support::is_long() || task.ends_with("slalom.toml");
    let list: Vec<String> = tasks.iter().filter(is_played).map(|task| task.display().to_string()).collect();
    let folder = TempDir::new().unwrap();
    let (code, table, error) = run(folder.path(), &format!("{} --trials 10", list.join(" ")));
    println!("{table}");
    assert_eq!(code, Some(0), "{error}");
    let (before, rest) = page.split_once(MARKS[0]).unwrap();
    let (expected, after) = rest.split_once(MARKS[1]).unwrap();
    let (actual, rows) = (format!("\n{table}"), cells(expected));
    assert!(rows.len() == tasks.len() + 1, "{rows:?}");
    for (task, row) in cells(&table) {
        assert_eq!(rows[&task], row, "docs/results/tasks.md");
    }
    if !support::is_long() {
        return;
    }
    match std::env::var_os("FLOTILLA_WRITE_TASKS") {
        Some(_) => fs::write(&path, [before, MARKS[0], &actual, MARKS[1], after].concat()).unwrap(),
        None => assert_eq!(expected, actual, "docs/results/tasks.md"),
    }
}

#[test]
fn tasks_resume_and_those_that_a_constant_speed_solves_fail() {
    let folder = TempDir::new().unwrap();
    let run = |line: &str| run(folder.path(), &format!("{line} --trials 2"));
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
    let file = |name: &str| configs.join(name).display().to_string();
    let (task, solved) = (file("tasks/slalom.toml"), file("strictly_forward.toml"));
    let (code, table, error) = run(&format!("{task} --out a"));
    assert_eq!(code, Some(0), "{error}");
    // Without `--resume`, the same command does not overwrite the runs.
    assert_eq!(run(&format!("{task} --out a --resume")).1, table);
    assert_eq!(run(&format!("{task} --out a")).0, Some(1));
    let (code, _, error) = run(&format!("{solved} --out b"));
    assert!(code == Some(1) && error.contains("G of the best constant speed is 1.00"), "{error}");
    let (code, _, error) = run(&format!("{task} {task} --out c"));
    assert!(code == Some(2) && error.contains("two configs"), "{error}");
}
