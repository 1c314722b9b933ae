//! Tests the study of rovers and UAVs, `flotilla paper --influence`.

use std::collections::BTreeMap;
use std::fs;
use std::process::Stdio;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::Duration;

use crate::support::{Place, flotilla};
use flotilla::config::Override;
use flotilla::front;
use flotilla_app::ops::{Context, Event};
use flotilla_app::record::folder::Start;
use flotilla_studies::influence;
use flotilla_studies::paper::run::Request;

/// Returns the contents of the files with results.
fn tables(place: &Place, out: &str) -> BTreeMap<String, Vec<u8>> {
    let files = fs::read_dir(place.path(out)).unwrap().map(|entry| entry.unwrap().path());
    let tables = files.filter(|path| path.extension().is_some_and(|extension| extension == "csv"));
    tables.map(|path| (path.file_name().unwrap().to_str().unwrap().into(), fs::read(&path).unwrap())).collect()
}

#[test]
fn a_killed_study_resumes_to_the_same_tables() {
    let place = Place::new(&[]);
    let line = "paper --influence=rover_uav,3_rovers_1_uav --trials 3 --generations 8 --set learning.population=10 \
                --backend cpu";
    let (printed, _) = place.good(&format!("{line} --out whole --quiet"));
    let whole = tables(&place, "whole");
    let names: Vec<_> = whole.keys().map(|name| &**name).collect();
    let of =
        ["3_rovers_1_uav.csv", "3_rovers_1_uav_pairs.csv", "baselines.csv", "rover_uav.csv", "rover_uav_pairs.csv"];
    assert_eq!(names, of);
    assert!(printed.as_bytes().starts_with(&whole["baselines.csv"]), "{printed}");
    let rows = |name: &str| String::from_utf8_lossy(&whole[name]).lines().count() - 1;
    // G, D, Df and Dt under four rules are seven credits, with 21 pairs. There are six baselines.
    assert_eq!((rows("rover_uav.csv"), rows("rover_uav_pairs.csv"), rows("baselines.csv")), (7, 21, 12));

    // Killed several times, each time a little later.
    let resumed = format!("{line} --out killed --quiet --resume");
    let mut kills = 0;
    for moment in (1..7).map(|kills| Duration::from_millis(100 * kills)) {
        let mut command = flotilla();
        command.args(resumed.split_whitespace()).current_dir(place.root()).stderr(Stdio::null()).stdout(Stdio::null());
        let mut child = command.spawn().unwrap();
        std::thread::sleep(moment);
        child.kill().unwrap();
        kills += u32::from(!child.wait().unwrap().success());
    }
    assert!(kills > 1, "killed {kills} times");
    place.good(&resumed);
    assert!(tables(&place, "killed") == whole, "killed {kills} times");

    // The tables are those of the sweep, and of a comparison of its runs.
    assert_eq!(place.bytes("whole/rover_uav/points.csv"), whole["rover_uav.csv"]);
    let points: Vec<String> = (0..7).map(|point| format!("whole/rover_uav/points/{point:04}")).collect();
    let (compared, _) = place.good(&format!("compare {} --paired --csv", points.join(" ")));
    let lines = String::from_utf8_lossy(&whole["rover_uav_pairs.csv"]).into_owned();
    assert!(lines.lines().all(|line| compared.lines().any(|other| other == line)), "{lines}\n{compared}");

    place.fails(1, &format!("{line} --out whole"), &["--resume"]);
    let other = line.replace("rover_uav,3_rovers_1_uav", "3_rovers_3_uavs");
    place.fails(1, &format!("{other} --out whole"), &["whole holds rover_uav.csv already"]);
    assert!(tables(&place, "whole") == whole);
    place.fails(1, &format!("{line} --out whole --resume --seed 4"), &["holds another sweep"]);
    place.fails(2, "paper --influence=nowhere", &["3_rovers_3_uavs"]);
    for study in ["influence", "questions"] {
        let error = place.refused(2, &format!("paper --{study} --trials 1 --out none"));
        assert!(error.contains("--trials 1: intervals and tests take two trials or more"), "{error}");
        assert!(!place.path("none").exists());
    }
}

#[test]
fn a_stop_while_baselines_play_leaves_a_study_to_resume() {
    let (place, stop) = (Place::new(&[]), AtomicBool::new(false));
    let few = [("learning.trials", 2), ("learning.generations", 1), ("learning.population", 10)];
    let request = Request {
        out: place.path("out"),
        start: Start::Fresh,
        set: few.map(|(key, value)| Override::new(key, value, key)).to_vec(),
        questions: vec![],
        populations: vec![],
        influence: vec!["rover_uav".into()],
    };
    let report = |event: Event<'_>| {
        if matches!(&event, Event::Fraction(_, text) if text.starts_with("playing random teams")) {
            stop.store(true, Relaxed);
        }
    };
    let context = Context { stop: &stop, ..Context::new(&report) };
    let error = influence::run(&request, &mut &mut front::cpu(), context).unwrap_err();
    assert_eq!((error.code(), &*error.to_string()), ("stopped", "with everything saved"));
}

/// The populations' own tests are in `searchers.rs`.
#[test]
fn studies_do_not_replace_other_results_and_refuse_keys_that_they_fix() {
    for (file, what) in [("paper.toml", "a paper"), ("sweep.toml", "a sweep"), ("run.json", "a run")] {
        let place = Place::new(&[(file, "")]).on_cpu();
        for study in ["populations=chaotic", "influence=rover_uav", "questions=d"] {
            let error = place.refused(1, &format!("paper --{study} --trials 2 --generations 1 --out . --resume"));
            assert!(error.contains(&format!(". holds {what}; choose another --out")), "{error}");
        }
        assert_eq!(place.names(), [file]);
    }
    let place = Place::new(&[]).on_cpu();
    let study = "--trials 2 --generations 1 --set learning.population=12 --out study --quiet";
    place.good(&format!("paper --populations=chaotic {study}"));
    let before = tables(&place, "study");
    let error = place.refused(1, &format!("paper --populations=coupling-6 {study}"));
    assert!(error.contains("study holds cells.csv already; pass --resume"), "{error}");
    assert!(tables(&place, "study") == before);
    for (layout, set) in [("chaotic", "sense.density=mean"), ("coupling-6", "world.steps=9")] {
        let error = place.refused(2, &format!("paper --populations={layout} --set {set} --out none"));
        assert!(error.contains("fix this key: leave it out") && !place.path("none").exists(), "{error}");
    }
}
