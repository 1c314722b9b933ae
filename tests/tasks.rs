//! The tasks in `configs/tasks/`, and scripted teams that solve some of them.
//!
//! A scripted team is a table beside the config, `leader,until,x,y,speed`. Before step `until`, the leader drives to a
//! place with at most this speed, and waits there. Rows of a leader are in order.

#![cfg(feature = "cli")]

use std::f32::consts::PI;
use std::fs;
use std::path::{Path, PathBuf};

use assert_cmd::cargo::cargo_bin_cmd;
use flotilla::Config;
use tempfile::TempDir;

fn files(ending: &str) -> Vec<PathBuf> {
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

/// Drives one team by a script, and returns the step at which each POI was observed.
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
            let at = |of: &[f32]| [of[2 * leader], of[2 * leader + 1]];
            let ([x, y], [ahead, up]) = (at(states.positions), at(states.headings));
            let (dx, dy) = (leg.place[0] - x, leg.place[1] - y);
            let distance = dx.hypot(dy);
            let turn = (ahead * dy - up * dx).atan2(ahead * dx + up * dy);
            action[0] = turn / PI;
            // Slow down near the place, and where it is not ahead.
            let speed = leg.speed.min(2.0 * distance) * turn.cos().max(0.0);
            action[1] = 2.0 * speed / config.motion.max_speed as f32 - 1.0;
        }
        stepper.step(&actions).unwrap();
        for (first, _) in observed.iter_mut().zip(stepper.observed()).filter(|(first, seen)| first.is_none() && **seen)
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
    let scripts = files("csv");
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
        // Without its script, the team observes nothing that way.
        assert!(play(&config, &[]).iter().all(Option::is_none), "{}", path.display());
    }
    assert!(!scripts.is_empty());
}

/// The page's table between these marks is what the command above it prints.
const MARKS: [&str; 2] = ["<!-- what comes out: cargo test --test tasks -->\n", "<!-- so far -->\n"];

/// Runs `flotilla tasks` without large populations, and returns its exit code and what it prints.
fn run(folder: &Path, line: &str) -> (Option<i32>, String, String) {
    let line = format!("tasks {line} --population 0 --backend cpu --quiet");
    let output = cargo_bin_cmd!("flotilla").args(line.split_whitespace()).current_dir(folder).output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

/// Where results change on purpose, `FLOTILLA_WRITE_TASKS=1 cargo test --test tasks` writes the table anew.
#[test]
fn no_baseline_and_no_small_population_solves_a_task() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/results/tasks.md");
    let page = fs::read_to_string(&path).unwrap();
    let tasks = files("toml");
    assert!(tasks.len() >= 8, "{tasks:?}");
    for task in &tasks {
        let name = task.file_stem().unwrap().to_str().unwrap();
        assert!(page.contains(&format!("(tasks/{name}.svg)")), "{name} has no picture");
        assert!(path.with_file_name("tasks").join(name).with_extension("svg").is_file(), "{name}");
    }
    let list: Vec<String> = tasks.iter().map(|task| task.display().to_string()).collect();
    let folder = TempDir::new().unwrap();
    let (code, table, error) = run(folder.path(), &format!("{} --trials 10", list.join(" ")));
    println!("{table}");
    assert_eq!(code, Some(0), "{error}");
    let (before, rest) = page.split_once(MARKS[0]).unwrap();
    let (there, after) = rest.split_once(MARKS[1]).unwrap();
    let here = format!("\n{table}");
    match std::env::var_os("FLOTILLA_WRITE_TASKS") {
        Some(_) => fs::write(&path, [before, MARKS[0], &here, MARKS[1], after].concat()).unwrap(),
        None => assert_eq!(there, here, "docs/results/tasks.md"),
    }
}

#[test]
fn a_task_resumes_and_one_that_a_constant_speed_solves_is_refused() {
    let folder = TempDir::new().unwrap();
    let run = |line: &str| run(folder.path(), &format!("{line} --trials 2"));
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
    let file = |name: &str| configs.join(name).display().to_string();
    let (task, easy) = (file("tasks/return.toml"), file("strictly_forward.toml"));
    let (code, table, error) = run(&format!("{task} --out a"));
    assert_eq!(code, Some(0), "{error}");
    // The same command resumes, and does not write over the runs by itself.
    assert_eq!(run(&format!("{task} --out a --resume")).1, table);
    assert_eq!(run(&format!("{task} --out a")).0, Some(1));
    let (code, _, error) = run(&format!("{easy} --out b"));
    assert!(code == Some(1) && error.contains("G of the best constant speed is 1.00"), "{error}");
    let (code, _, error) = run(&format!("{task} {task} --out c"));
    assert!(code == Some(2) && error.contains("two configs"), "{error}");
}
