//! Tests that commands detect files of a run that were changed after the run wrote them.

use std::fs;
use std::path::Path;

use crate::support::{Place, files, tiny};
use serde_json::Value;

fn place() -> Place {
    let grid = "[grid]\n\"learning.fitness\" = ['D', 'Df']\n";
    let small = tiny(4, "generations = 2");
    let place = Place::new(&[("small.toml", &small), ("grid.toml", &format!("{small}{grid}"))]).on_cpu();
    place.good("train small.toml --out run");
    place
}

/// Replaces the first of the pairs' texts that the file contains.
fn edit(place: &Place, name: &str, pairs: &[(&str, &str)]) {
    let text = place.read(name);
    let (from, to) = pairs.iter().find(|(from, _)| text.contains(from)).expect("one of the texts");
    place.write(name, text.replacen(from, to, 1));
}

/// Changes G of the best team in one row.
fn edit_metrics(place: &Place, name: &str) {
    let text = place.read(name);
    let line = text.lines().nth(3).expect("three rows");
    let fields: Vec<&str> = line.split(',').collect();
    let best = if fields[2] == "0.5" { "1" } else { "0.5" };
    let changed = [&fields[..2], &[best], &fields[3..]].concat().join(",");
    place.write(name, text.replacen(line, &changed, 1));
}

const ROLLOUT: &str = "rollout run/config.toml --policies run/policies.safetensors --backend cpu";

#[test]
fn every_reader_detects_edited_metrics() {
    let place = place();
    place.good("train small.toml --out other --seed 3");
    place.good("sweep grid.toml --out swept");
    edit_metrics(&place, "run/metrics.csv");
    edit_metrics(&place, "swept/points/0001/metrics.csv");
    for command in ["plot run", "plot run other", "compare run other"] {
        let output = output_of(&place, 1, command);
        assert!(output.contains("run/metrics.csv: it has changed since the run wrote it"), "{command}: {output}");
        assert!(output.contains("--resume` ") || output.contains("--resume`,"), "{command}: {output}");
        assert!(output.contains("--unverified"), "{command}: {output}");
    }
    place.fails(1, "replay run", &["run/metrics.csv: it has changed since the run wrote it"]);
    let output = output_of(&place, 1, "compare swept");
    assert!(output.contains("swept/points/0001/metrics.csv: it has changed since the run wrote it"), "{output}");
    let output = output_of(&place, 1, "sweep grid.toml --out swept --collect");
    assert!(output.contains("1 of 2 points are missing"), "{output}");
    assert!(output.contains("points/0001/metrics.csv: it has changed since the run wrote it"), "{output}");

    // `--unverified` reads the files all the same, and marks the results.
    let notice = "Unverified: files were not compared with the digests in run.json";
    let succeed = |command: &str| output_of(&place, 0, command);
    assert!(succeed("plot run --unverified").contains(notice));
    assert!(place.read("run/curves.svg").contains(notice));
    assert_eq!(json(&succeed("plot run --unverified --json"))["unverified"], true);
    assert_eq!(json(&succeed("plot other --json"))["unverified"], false);
    assert!(succeed("compare run other --unverified").starts_with(notice));
    assert!(succeed("compare run other --unverified --latex").starts_with(&format!("% {notice}")));
    assert_eq!(json(&succeed("compare run other --unverified --json"))["unverified"], true);
    assert!(succeed("sweep grid.toml --out swept --collect --unverified").contains(notice));
    assert!(place.read("swept/final.svg").contains(notice));
    let stdout = place.good("sweep grid.toml --out swept --collect --unverified --json").0;
    assert_eq!(json(&stdout)["unverified"], true);
    // The suggested command repairs the run: it writes its metrics again.
    place.good("train run/config.toml --out run --resume");
    succeed("plot run");
}

/// Runs a command, checks its exit code, and returns standard output followed by standard error.
fn output_of(place: &Place, code: i32, command: &str) -> String {
    let mut line = place.command();
    line.args(command.split_whitespace());
    if command.starts_with("sweep") {
        line.args(["--backend", "cpu", "--quiet"]);
    }
    let output = line.output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(code), "{command}: {stderr}");
    String::from_utf8_lossy(&output.stdout).into_owned() + &stderr
}

fn json(text: &str) -> Value {
    let line = text.lines().find(|line| line.starts_with('{')).expect("an object");
    serde_json::from_str(line).unwrap()
}

#[test]
fn replay_rollout_and_resume_detect_an_edited_config() {
    let place = place();
    edit(&place, "run/config.toml", &[("coupling = 2", "coupling = 1"), ("coupling = [2, 2]", "coupling = [1, 1]")]);
    for command in ["replay run", ROLLOUT] {
        place.fails(1, command, &["run/config.toml: it has changed since the run wrote it"]);
    }
    place.prints(&format!("{ROLLOUT} --unverified"), &["Unverified"]);
    assert_eq!(json(&place.good(&format!("{ROLLOUT} --unverified --json")).0)["unverified"], true);
    // A run does not resume with another config.
    let before = files(&place.path("run"));
    let stderr = place.refused(1, "train run/config.toml --out run --resume");
    assert!(stderr.contains("it is not the config that this run was started with"), "{stderr}");
    assert_eq!(files(&place.path("run")), before);
    // Comments and checkpoint settings do not make another config.
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
    place.prints("replay run --unverified", &["Unverified"]);
    assert!(place.read("run/replay.html").contains("(unverified)"));
    place.good("replay run --unverified --out still.svg");
    assert!(place.read("still.svg").contains("Unverified: files were not compared"));
    assert_eq!(json(&place.good("replay run --unverified --json").0)["unverified"], true);
}

#[test]
fn rollout_detects_policies_of_another_run() {
    let place = place();
    place.good("train small.toml --out other --seed 3");
    fs::copy(place.path("other/policies.safetensors"), place.path("run/policies.safetensors")).unwrap();
    place.fails(1, ROLLOUT, &["run/policies.safetensors: it has changed since the run wrote it"]);
    place.good(&format!("{ROLLOUT} --unverified"));
    // The user's own configs and policies have no digests to compare with.
    fs::copy(place.path("other/policies.safetensors"), place.path("mine.safetensors")).unwrap();
    place.good("rollout small.toml --policies mine.safetensors");
}

#[test]
fn a_finished_run_without_digests_is_damaged() {
    let place = place();
    let text = place.read("run/run.json");
    let mut record: Value = serde_json::from_str(&text).unwrap();
    let fields = record.as_object_mut().unwrap();
    assert!(fields.remove("files").is_some() && fields.remove("origin").is_some());
    place.write("run/run.json", record.to_string());
    place.fails(
        1,
        "plot run",
        &[
            "run.json: not the record of a run",
            "restore it, or make it again with `flotilla train run/config.toml --out run --resume`",
        ],
    );
    place.good("plot run --unverified");
    place.good("train small.toml --out run --resume");
    assert_eq!(place.read("run/run.json").matches("\"digest\"").count(), 1);
    place.good("plot run");
}

/// Tests that a run whose digests were removed does not pass as compared.
#[test]
fn a_run_without_its_record_is_not_verified() {
    let place = place();
    place.good("train small.toml --out other --seed 3");
    fs::remove_file(place.path("run/run.json")).unwrap();
    for command in ["plot run", "compare run other", "replay run", "rollout run", ROLLOUT] {
        place.fails(1, command, &["run/run.json: it is missing", "--out run --resume`, or read it all the same"]);
    }
    place.good("plot run --unverified");
    place.good("train small.toml --out run --resume");
    place.good("plot run");
}

#[test]
fn unfinished_runs_are_not_verified() {
    let place = place();
    let text = place.read("run/run.json");
    place.write("run/run.json", text.replace("\"done\"", "\"running\""));
    edit_metrics(&place, "run/metrics.csv");
    output_of(&place, 0, "plot run");
}

/// Marks a tensor file as written in a newer format, and corrects its checksum.
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
    let start = content.windows(64).position(|window| window == "0".repeat(64).as_bytes()).unwrap();
    content[start..start + 64].copy_from_slice(checksum.as_bytes());
    fs::write(path, content).unwrap();
}

#[test]
fn files_of_a_newer_version_are_not_changed() {
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
            let stderr = place.refused(1, "train small.toml --out run --resume");
            let expected = format!("{name}: it was written by flotilla {}", version.unwrap_or("8.1.0"));
            assert!(stderr.contains(&expected) && stderr.contains("use that version"), "{stderr}");
            assert_eq!(files(&place.path("run")), before, "{name}");
        }
    }
    // A run.json that this version cannot read.
    let place = place();
    let text = place.read("run/run.json");
    place.write("run/run.json", text.replace("\"done\"", "\"paused\"").replace(flotilla::VERSION, "8.1.0"));
    let before = files(&place.path("run"));
    place.fails(1, "train small.toml --out run --resume", &["run.json: it was written by flotilla 8.1.0"]);
    assert_eq!(files(&place.path("run")), before);
    // The same text of this version is damaged.
    place.write("run/run.json", text.replace("\"done\"", "\"paused\""));
    place.fails(1, "plot run", &["run.json: not the record of a run"]);
}

#[test]
fn an_outdated_picture_is_drawn_again() {
    let place = place();
    let old = place.read("run/curves.svg");
    place.good("train small.toml --out run --resume --generations 6");
    let new = place.read("run/curves.svg");
    assert_ne!(old, new);
    // As if a session had ended before it drew the picture.
    place.write("run/curves.svg", old);
    place.good("train small.toml --out run --resume --generations 6");
    assert_eq!(place.read("run/curves.svg"), new);
    fs::remove_file(place.path("run/curves.svg")).unwrap();
    place.good("train small.toml --out run --resume --generations 6");
    assert_eq!(place.read("run/curves.svg"), new);
}

#[path = "../../tests/golden/cases.rs"]
mod cases;

/// The program trains each golden case alone, not side by side with the others.
#[test]
fn train_records_the_golden_digests() {
    let golden = include_str!("../../tests/golden.txt");
    let recorded: Vec<Vec<&str>> =
        golden.lines().filter(|line| !line.starts_with('#')).map(|line| line.split_whitespace().collect()).collect();
    assert_eq!(recorded.len(), cases::CASES.len());
    let place = Place::new(&[]);
    for (config, words) in cases::CONFIGS.iter().zip(&recorded) {
        let (name, digest) = (words[0], words[2]);
        place.write(format!("{name}.toml"), config.to_toml());
        place.good(&["train", "--quiet", "--backend", "cpu", "--out", name, &format!("{name}.toml")]);
        let run: serde_json::Value = serde_json::from_str(&place.read(format!("{name}/run.json"))).unwrap();
        assert_eq!(run["digest"], digest, "{name}");
    }
}
