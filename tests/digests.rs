//! Files of a run that were changed after it are noticed by everything that reads them.

#![cfg(feature = "cli")]

mod support;

use std::fs;
use std::path::Path;

use serde_json::Value;
use support::{Place, tiny};

fn place() -> Place {
    let grid = "[grid]\n\"learning.fitness\" = ['D', 'Df']\n";
    let small = tiny(4, "generations = 2");
    let place = Place::new(&[("small.toml", &small), ("grid.toml", &format!("{small}{grid}"))]).on_cpu();
    place.good("train small.toml --out run");
    place
}

/// Changes the first of these texts that is in a file.
fn edit(place: &Place, name: &str, pairs: &[(&str, &str)]) {
    let text = place.read(name);
    let (from, to) = pairs.iter().find(|(from, _)| text.contains(from)).expect("the text is there");
    place.write(name, text.replacen(from, to, 1));
}

/// Gives the best team of one row another G.
fn edit_metrics(place: &Place, name: &str) {
    let text = place.read(name);
    let line = text.lines().nth(3).expect("there are rows");
    let fields: Vec<&str> = line.split(',').collect();
    let best = if fields[2] == "0.5" { "1" } else { "0.5" };
    let other = [&fields[..2], &[best], &fields[3..]].concat().join(",");
    place.write(name, text.replacen(line, &other, 1));
}

const ROLLOUT: &str = "rollout run/config.toml --policies run/policies.safetensors --backend cpu";

#[test]
fn an_edited_metric_is_noticed_by_every_reader() {
    let place = place();
    place.good("train small.toml --out other --seed 3");
    place.good("sweep grid.toml --out swept");
    edit_metrics(&place, "run/metrics.csv");
    edit_metrics(&place, "swept/points/0001/metrics.csv");
    for command in ["plot run", "plot run other", "compare run other"] {
        let told = run(&place, 1, command);
        assert!(told.contains("run/metrics.csv: it has changed since the run wrote it"), "{command}: {told}");
        assert!(told.contains("--resume` ") || told.contains("--resume`,"), "{command}: {told}");
        assert!(told.contains("--unverified"), "{command}: {told}");
    }
    let told = place.refused(1, "replay run");
    assert!(told.contains("run/metrics.csv: it has changed since the run wrote it"), "{told}");
    let told = run(&place, 1, "compare swept");
    assert!(told.contains("swept/points/0001/metrics.csv: it has changed since the run wrote it"), "{told}");
    let told = run(&place, 1, "sweep grid.toml --out swept --collect");
    assert!(told.contains("1 of 2 points are missing"), "{told}");
    assert!(told.contains("points/0001/metrics.csv: it has changed since the run wrote it"), "{told}");

    // Whoever wants them gets them, marked.
    let mark = "Unverified: files were not compared with the digests in run.json";
    let good = |command: &str| run(&place, 0, command);
    assert!(good("plot run --unverified").contains(mark));
    assert!(place.read("run/curves.svg").contains(mark));
    assert_eq!(json(&good("plot run --unverified --json"))["unverified"], true);
    assert_eq!(json(&good("plot other --json"))["unverified"], false);
    assert!(good("compare run other --unverified").starts_with(mark));
    assert!(good("compare run other --unverified --latex").starts_with(&format!("% {mark}")));
    assert_eq!(json(&good("compare run other --unverified --json"))["unverified"], true);
    assert!(good("sweep grid.toml --out swept --collect --unverified").contains(mark));
    assert!(place.read("swept/final.svg").contains(mark));
    let told = place.good("sweep grid.toml --out swept --collect --unverified --json").0;
    assert_eq!(json(&told)["unverified"], true);
    // The advice: the run makes its metrics again.
    place.good("train run/config.toml --out run --resume");
    good("plot run");
}

/// Runs a command, checks its exit code, and returns standard output followed by standard error.
fn run(place: &Place, code: i32, command: &str) -> String {
    let mut line = place.command();
    line.args(command.split_whitespace());
    if command.starts_with("sweep") {
        line.args(["--backend", "cpu", "--quiet"]);
    }
    let output = line.output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(code), "{command}: {told}");
    String::from_utf8_lossy(&output.stdout).into_owned() + &told
}

fn json(text: &str) -> Value {
    let line = text.lines().find(|line| line.starts_with('{')).expect("an object");
    serde_json::from_str(line).unwrap()
}

#[test]
fn an_edited_config_is_noticed_by_whoever_plays() {
    let place = place();
    edit(&place, "run/config.toml", &[("coupling = 2", "coupling = 1"), ("coupling = [2, 2]", "coupling = [1, 1]")]);
    for command in ["replay run", ROLLOUT] {
        let told = place.refused(1, command);
        assert!(told.contains("run/config.toml: it has changed since the run wrote it"), "{command}: {told}");
    }
    let told = place.good(&format!("{ROLLOUT} --unverified")).0;
    assert!(told.contains("Unverified"), "{told}");
    assert_eq!(json(&place.good(&format!("{ROLLOUT} --unverified --json")).0)["unverified"], true);
    // Nor does a run go on with it, which would be another run.
    let before = files(&place.path("run"));
    let told = place.refused(1, "train run/config.toml --out run --resume");
    assert!(told.contains("it is not the config that this run was started with"), "{told}");
    assert_eq!(files(&place.path("run")), before);
    // A config with comments, or that is saved at other times, says the same.
    place.write("run/config.toml", format!("# mine\n{}", tiny(4, "generations = 1")));
    place.good("replay run");
}

#[test]
fn a_replay_of_unverified_files_is_marked() {
    let place = place();
    let text = place.read("run/run.json");
    let mut record: Value = serde_json::from_str(&text).unwrap();
    record["files"]["metrics.csv"] = "0".repeat(64).into();
    place.write("run/run.json", record.to_string());
    place.refused(1, "replay run");
    let (told, _) = place.good("replay run --unverified");
    assert!(told.contains("Unverified"), "{told}");
    assert!(place.read("run/replay.html").contains("(unverified)"));
    place.good("replay run --unverified --out still.svg");
    assert!(place.read("still.svg").contains("Unverified: files were not compared"));
    assert_eq!(json(&place.good("replay run --unverified --json").0)["unverified"], true);
}

#[test]
fn policies_of_another_run_are_noticed() {
    let place = place();
    place.good("train small.toml --out other --seed 3");
    fs::copy(place.path("other/policies.safetensors"), place.path("run/policies.safetensors")).unwrap();
    let told = place.refused(1, ROLLOUT);
    assert!(told.contains("run/policies.safetensors: it has changed since the run wrote it"), "{told}");
    place.good(&format!("{ROLLOUT} --unverified"));
    // Somebody's own config and copies of policies are compared with nothing.
    fs::copy(place.path("other/policies.safetensors"), place.path("mine.safetensors")).unwrap();
    place.good("rollout small.toml --policies mine.safetensors");
}

#[test]
fn runs_without_digests_are_read_and_said_to_be() {
    let place = place();
    let text = place.read("run/run.json");
    let mut record: Value = serde_json::from_str(&text).unwrap();
    let fields = record.as_object_mut().unwrap();
    assert!(fields.remove("files").is_some() && fields.remove("origin").is_some());
    place.write("run/run.json", record.to_string());
    edit_metrics(&place, "run/metrics.csv");
    let told = run(&place, 0, "plot run");
    assert_eq!(told.matches("are not verified").count(), 1, "{told}");
    let (_, told) = place.good("train small.toml --out run --resume");
    assert!(told.contains("metrics.csv has changed since") || told.contains("resuming"), "{told}");
}

#[test]
fn an_unfinished_run_is_read_as_it_is() {
    let place = place();
    let text = place.read("run/run.json");
    place.write("run/run.json", text.replace("\"done\"", "\"running\""));
    edit_metrics(&place, "run/metrics.csv");
    run(&place, 0, "plot run");
}

/// Every file below a folder, with its content.
fn files(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let mut all = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        match path.is_dir() {
            true => all.extend(files(&path)),
            false => all.push((path.display().to_string(), fs::read(&path).unwrap())),
        }
    }
    all.sort();
    all
}

/// Says in a tensor file's header that it is of a later format, with the checksum that fits.
fn make_newer(path: &Path, version: Option<&str>) {
    use sha2::{Digest, Sha256};
    let bytes = fs::read(path).unwrap();
    let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let mut header: Value = serde_json::from_slice(&bytes[8..8 + length]).unwrap();
    let metadata = header["__metadata__"].as_object_mut().unwrap();
    let kind = metadata["flotilla"].as_str().unwrap().replace(" 1", " 2");
    metadata.insert("flotilla".into(), kind.into());
    metadata.remove("version");
    metadata.extend(version.map(|version| ("version".to_string(), version.into())));
    metadata.insert("sha256".into(), "0".repeat(64).into());
    let mut text = header.to_string();
    text.extend(std::iter::repeat_n(' ', text.len().next_multiple_of(8) - text.len()));
    let mut content = (text.len() as u64).to_le_bytes().to_vec();
    content.extend(text.as_bytes());
    content.extend(&bytes[8 + length..]);
    let checksum: String = Sha256::digest(&content).iter().map(|byte| format!("{byte:02x}")).collect();
    let at = content.windows(64).position(|window| window == "0".repeat(64).as_bytes()).unwrap();
    content[at..at + 64].copy_from_slice(checksum.as_bytes());
    fs::write(path, content).unwrap();
}

#[test]
fn files_of_a_newer_version_are_left_alone() {
    for (name, version) in [
        ("checkpoints/000000004.safetensors", Some("7.0.0")),
        ("checkpoints/000000005.safetensors", None),
        ("policies.safetensors", None),
    ] {
        for done in [true, false] {
            let place = place();
            let text = place.read("run/run.json");
            let state = if done { "\"done\"" } else { "\"stopped\"" };
            let text = text.replace("\"done\"", state).replace(flotilla::VERSION, "8.1.0");
            place.write("run/run.json", text);
            make_newer(&place.path("run").join(name), version);
            let before = files(&place.path("run"));
            let told = place.refused(1, "train small.toml --out run --resume");
            let expected = format!("{name}: it was written by flotilla {}", version.unwrap_or("8.1.0"));
            assert!(told.contains(&expected) && told.contains("use that version"), "{told}");
            assert_eq!(files(&place.path("run")), before, "{name}");
        }
    }
    // A record that this version cannot read.
    let place = place();
    let text = place.read("run/run.json");
    place.write("run/run.json", text.replace("\"done\"", "\"paused\"").replace(flotilla::VERSION, "8.1.0"));
    let before = files(&place.path("run"));
    let told = place.refused(1, "train small.toml --out run --resume");
    assert!(told.contains("run.json: it was written by flotilla 8.1.0"), "{told}");
    assert_eq!(files(&place.path("run")), before);
}

#[test]
fn an_older_picture_is_drawn_again() {
    let place = place();
    let old = place.read("run/curves.svg");
    place.good("train small.toml --out run --resume --generations 6");
    let drawn = place.read("run/curves.svg");
    assert_ne!(old, drawn);
    // A session that ended between the run and its picture.
    place.write("run/curves.svg", old);
    place.good("train small.toml --out run --resume --generations 6");
    assert_eq!(place.read("run/curves.svg"), drawn);
    fs::remove_file(place.path("run/curves.svg")).unwrap();
    place.good("train small.toml --out run --resume --generations 6");
    assert_eq!(place.read("run/curves.svg"), drawn);
}
