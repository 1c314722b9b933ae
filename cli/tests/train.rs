//! Tests `train` and `rollout` as a user runs them: the files, the output on each stream, and the exit codes.

use std::cell::Cell;
use std::collections::{BTreeMap, HashMap};
use std::fs;
use std::ops::ControlFlow::Continue;
use std::path::{Path, PathBuf};

use crate::support::{self, Place, SMALL};
use flotilla::trainer::Row;
use flotilla::{Config, front};
use flotilla_app::ops;
use flotilla_app::ops::train::TrainRequest;
use flotilla_app::record::RecordError;
use flotilla_app::record::disk::Disk;
use flotilla_app::record::finished::{Content, Finished, Storage};
use flotilla_app::record::folder::{Folder, ProcessorInfo, Run, Start, StartFrom};
use flotilla_app::record::hex;
use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};
use sha2::{Digest, Sha256};

const PARAMETERS: usize = 9 * 5 + 6 * 2;

/// Returns a folder with `small.toml`. Commands run on the CPU, because a GPU's driver may print messages of its own.
fn place() -> Place {
    Place::new(&[("small.toml", SMALL)]).on_cpu()
}

/// Writes a safetensors file with one tensor, as another program would.
fn write_tensor(path: PathBuf, tensor: &str, dtype: Dtype, shape: &[usize], data: &[u8], layers: Option<&str>) {
    let view = TensorView::new(dtype, shape.to_vec(), data).unwrap();
    let metadata = layers.map(|layers| HashMap::from([("layers".to_string(), layers.to_string())]));
    fs::write(path, safetensors::serialize([(tensor, view)], metadata).unwrap()).unwrap();
}

/// Writes a file of policies, as another program would.
fn write_weights(path: PathBuf, shape: [usize; 3], weights: &[f32]) {
    write_tensor(path, "weights", Dtype::F32, &shape, bytemuck::cast_slice(weights), None);
}

/// Splits a CSV file into its header and rows.
fn rows(text: &str) -> (&str, Vec<Vec<&str>>) {
    let (header, rest) = text.split_once('\n').unwrap();
    (header, rest.lines().map(|line| line.split(',').collect()).collect())
}

#[test]
fn train_writes_a_complete_folder() {
    let place = place();
    let (summary, stderr) = place.good("train small.toml --backend cpu");
    assert!(stderr.starts_with("training on cpu ("), "{stderr}");
    let files = ["config.toml", "run.json", "metrics.csv", "policies.safetensors", "checkpoints"];
    for name in files {
        assert!(place.path("runs/small").join(name).exists(), "{name}");
    }
    for word in ["POIs observed, of 2", "start", "generation 6", "flotilla replay runs/small", "metrics.csv"] {
        assert!(summary.contains(word), "{word}: {summary}");
    }

    // One row per trial and generation, in order.
    let metrics = place.read("runs/small/metrics.csv");
    let (header, rows) = rows(&metrics);
    assert_eq!(header, "trial,generation,best_g,mean_g,champion_g,seconds");
    let order: Vec<(usize, usize)> =
        rows.iter().map(|row| (row[1].parse().unwrap(), row[0].parse().unwrap())).collect();
    assert_eq!(order, (0..7).flat_map(|generation| (0..3).map(move |trial| (generation, trial))).collect::<Vec<_>>());
    let mut seconds = 0.0;
    for row in &rows {
        let [best, mean, champion, time] = [2, 3, 4, 5].map(|column| row[column].parse::<f64>().unwrap());
        assert!(
            (0.0..=1.0).contains(&mean) && mean <= best && best <= 1.0 && (0.0..=1.0).contains(&champion),
            "{row:?}"
        );
        assert!(time >= seconds, "{row:?}");
        seconds = time;
    }

    // The policies are readable with the safetensors crate.
    let bytes = place.bytes("runs/small/policies.safetensors");
    let (_, header) = SafeTensors::read_metadata(&bytes).unwrap();
    assert_eq!(header.metadata().as_ref().unwrap()["layers"], "8,5,2");
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    assert_eq!(tensors.len(), 3);
    // The digest covers the metrics without their times, and the policies.
    let mut hash = Sha256::new();
    metrics.lines().for_each(|line| hash.update(line.rsplit_once(',').unwrap().0.to_string() + "\n"));
    for trial in 0..3 {
        let tensor = tensors.tensor(&format!("weights.{trial}")).unwrap();
        assert_eq!((tensor.dtype(), tensor.shape()), (Dtype::F32, &[2, 8, PARAMETERS][..]));
        hash.update(tensor.data());
    }
    let run: serde_json::Value = serde_json::from_str(&place.read("runs/small/run.json")).unwrap();
    assert_eq!(run["digest"], hex(&hash.finalize()));
    assert_eq!((&run["state"], &run["backend"], &run["seed"]), (&"done".into(), &"cpu".into(), &0.into()));
    assert_eq!(run["version"], env!("CARGO_PKG_VERSION"));
    assert!(run["threads"].as_u64().unwrap() >= 1 && run["started"].as_str().unwrap().ends_with('Z'), "{run}");
    assert!(summary.contains(run["digest"].as_str().unwrap()));

    // The resolved config reproduces the run, also with another number of threads.
    place.prints("train runs/small/config.toml --out again --threads 1", &[run["digest"].as_str().unwrap()]);
    assert_eq!(place.bytes("again/policies.safetensors"), bytes);
    assert_eq!(place.read("again/config.toml"), place.read("runs/small/config.toml"));
}

#[test]
fn flags_are_in_the_resolved_config_and_quiet_prints_nothing_to_stderr() {
    let place = place();
    let (_, stderr) = place.good(
        "train small.toml --seed 4 --trials 1 --generations 2 --population 5 --fitness D++ --paradigm all-leaders \
         --checkpoint-generations 1 --checkpoint-seconds 0.5 --quiet --backend cpu",
    );
    assert_eq!(stderr, "");
    let config = place.read("runs/small/config.toml");
    for line in [
        "seed = 4",
        "trials = 1",
        "generations = 2",
        "population = 5",
        "fitness = \"D++\"",
        "paradigm = \"all-leaders\"",
        "[checkpoint]\ngenerations = 1\nseconds = 0.5",
    ] {
        assert!(config.contains(line), "{line}: {config}");
    }
    assert_eq!(place.read("runs/small/metrics.csv").lines().count(), 1 + 3);
    place.fails(2, "train small.toml --checkpoint-seconds -1", &["--checkpoint-seconds: found -1"]);
    // A config that is refused leaves no folder.
    assert!(!place.path("runs/small-2").exists());
}

#[test]
fn a_run_is_overwritten_only_with_force() {
    let place = place();
    let short = "--generations 1 --quiet";
    place.good(&format!("train small.toml {short}"));
    // Without --out, `train` chooses a free folder.
    place.good(&format!("train small.toml {short}"));
    place.good(&format!("train small.toml {short}"));
    assert!(place.path("runs/small-2/run.json").exists() && place.path("runs/small-3/run.json").exists());
    place.fails(1, &format!("train small.toml --out runs/small {short}"), &["runs/small holds a run already"]);
    let error = place.refused(1, &format!("train small.toml --out runs/small --resume --seed 9 {short}"));
    assert!(error.contains("learning.seed: 0 there, 9 here"), "{error}");
    place.good(&format!("train small.toml --out runs/small --force --seed 9 {short}"));
    assert!(place.read("runs/small/config.toml").contains("seed = 9"));
    // Resuming a finished run prints its summary and changes nothing.
    let before = place.read("runs/small-3/run.json");
    let (summary, _) = place.good(&format!("train small.toml --resume {short}").replace("--quiet", ""));
    assert!(summary.contains("runs/small-3") && summary.starts_with("This run was done already."), "{summary}");
    assert_eq!(place.read("runs/small-3/run.json"), before);
    assert_eq!(place.run("train small.toml --resume --force").status.code(), Some(2));
    // --resume also starts a new run.
    place.good(&format!("train small.toml --out fresh --resume {short}"));
    assert!(place.path("fresh/run.json").exists());
    // The name of a config may be that of another config's second run.
    for name in ["small-2.toml", "small-4.toml"] {
        place.write(name, place.read("small.toml"));
    }
    let error = place.refused(1, &format!("train small-2.toml --force {short}"));
    assert!(error.contains("runs/small-2 is a run of small; choose another --out"), "{error}");
    place.good(&format!("train small-4.toml {short}"));
    place.good("train small.toml --resume --generations 2 --quiet");
    let last = |run: &str| place.read(format!("runs/{run}/metrics.csv")).lines().count();
    assert!(last("small-3") > last("small-4"), "another config's run is extended");
}

#[test]
fn the_first_team_of_a_rollout_is_the_trials_champion() {
    let place = place();
    place.good("train small.toml --out run --generations 9 --quiet");
    let metrics = place.read("run/metrics.csv");
    for trial in 0..3 {
        let line = format!(
            "rollout small.toml --policies run/policies.safetensors --trial {trial} \
             --scores scores.csv --trace trace.csv"
        );
        let (summary, _) = place.good(&line);
        assert!(summary.starts_with("8 teams, POIs observed of 2: team 0 "), "{summary}");
        let last = format!("{trial},9,");
        let row = metrics.lines().find(|line| line.starts_with(&last)).unwrap();
        let champion: f64 = row.split(',').nth(4).unwrap().parse().unwrap();
        let scores = place.read("scores.csv");
        let (header, scores) = rows(&scores);
        assert_eq!(header, "team,leader,g,d,df,dpp,dt");
        assert_eq!(scores.len(), 8 * 2);
        assert_eq!(scores[0][2].parse::<f64>().unwrap(), champion);
        for (index, row) in scores.iter().enumerate() {
            assert_eq!((row[0].parse(), row[1].parse()), (Ok(index / 2), Ok(index % 2)));
            let [g, d, df] = [2, 3, 4].map(|column| row[column].parse::<f32>().unwrap());
            assert!(0.0 <= d && d <= df && df <= g && g <= 1.0, "{row:?}");
        }
    }
    let trace = place.read("trace.csv");
    let (header, trace) = rows(&trace);
    assert!(header.starts_with("team,step,agent,role,x,y,heading_x,heading_y,speed,"), "{header}");
    assert_eq!(trace.len(), 8 * 10 * 5);
    for (index, row) in trace.iter().enumerate() {
        let (team, step, agent) = (index / 50, index / 5 % 10, index % 5);
        assert_eq!((row[0].parse(), row[1].parse(), row[2].parse()), (Ok(team), Ok(step), Ok(agent)));
        assert_eq!(row[3], if agent < 2 { "leader" } else { "follower" });
    }
    assert_eq!(trace[2][4..9], ["12", "2", "0", "1", "0"]);
    // Printed floats read back to the same bits.
    let float = |text: &str| text.is_empty() || text.parse::<f32>().unwrap().to_string() == *text;
    assert!(trace.iter().all(|row| row[4..].iter().all(|text| float(text))));
}

#[test]
fn rollout_reads_files_of_other_programs_and_refuses_invalid_ones() {
    let place = place();
    let count = 2 * 3 * PARAMETERS;
    let good: Vec<f32> = (0..count).map(|index| (index as f32 - 90.0) / 50.0).collect();
    write_weights(place.path("good.safetensors"), [2, 3, PARAMETERS], &good);
    let line = |file: &str| format!("rollout small.toml --policies {file}.safetensors --scores scores.csv");
    place.good(&line("good"));
    let scores = place.read("scores.csv");
    assert_eq!(scores.lines().count(), 1 + 3 * 2);

    // Weights too small for the kernels are 0.
    let mut tiny = good.clone();
    tiny[5] = 0.0;
    write_weights(place.path("zero.safetensors"), [2, 3, PARAMETERS], &tiny);
    tiny[5] = 1e-40;
    write_weights(place.path("tiny.safetensors"), [2, 3, PARAMETERS], &tiny);
    let [zero, tiny] = ["zero", "tiny"].map(|name| {
        place.good(&(line(name) + " --trace trace.csv"));
        (place.read("scores.csv"), place.read("trace.csv"))
    });
    assert_eq!(zero, tiny);

    for (value, text) in [(f32::NAN, "NaN"), (f32::NEG_INFINITY, "-inf"), (2e6, "2000000")] {
        let mut bad = good.clone();
        bad[PARAMETERS * 4 + 7] = value;
        write_weights(place.path("bad.safetensors"), [2, 3, PARAMETERS], &bad);
        let error = place.refused(1, &line("bad"));
        assert!(
            error.contains(&format!("weights[1, 1, 7] is {text}, allowed are numbers of size up to 1048576")),
            "{error}"
        );
    }

    let needs = format!("but the config needs F32 [2, 1 to 1048576, {PARAMETERS}]");
    let bytes = bytemuck::cast_slice(&good);
    for (dtype, shape, description) in [
        (Dtype::F32, vec![3, 2, PARAMETERS], format!("weights is F32 [3, 2, {PARAMETERS}]")),
        (Dtype::F32, vec![2, PARAMETERS, 3], format!("weights is F32 [2, {PARAMETERS}, 3]")),
        (Dtype::F32, vec![6 * PARAMETERS], format!("weights is F32 [{}]", 6 * PARAMETERS)),
        (Dtype::F64, vec![1, 3, PARAMETERS], format!("weights is F64 [1, 3, {PARAMETERS}]")),
        (Dtype::I32, vec![2, 3, PARAMETERS], format!("weights is I32 [2, 3, {PARAMETERS}]")),
    ] {
        write_tensor(place.path("bad.safetensors"), "weights", dtype, &shape, bytes, None);
        place.fails(1, &line("bad"), &[&description, &needs]);
    }
    write_tensor(place.path("bad.safetensors"), "weights", Dtype::F32, &[2, 0, PARAMETERS], &[], None);
    place.fails(1, &line("bad"), &[&needs]);
    write_tensor(place.path("bad.safetensors"), "weights", Dtype::F32, &[2, 3, PARAMETERS], bytes, Some("8,4,1,2"));
    place.fails(1, &line("bad"), &["layers \"8,4,1,2\", but the config's have \"8,5,2\""]);
    write_tensor(place.path("bad.safetensors"), "w", Dtype::F32, &[2, 3, PARAMETERS], bytes, None);
    place.fails(1, &line("bad"), &["it has no tensor weights.0; it has w"]);
    place.fails(2, &(line("good") + " --trial 2"), &["it has no tensor weights.2; it has weights"]);
    // A checkpoint is refused, although it has weights.
    place.good("train small.toml --out run --trials 1");
    let newest = fs::read_dir(place.path("run/checkpoints")).unwrap().next().unwrap().unwrap().path();
    let checkpoint = ["rollout", "small.toml", "--policies", newest.to_str().unwrap()];
    place.fails(1, &checkpoint, &["it holds \"checkpoint "]);
    // The file must have policies for every leader.
    place.fails(1, &(line("good") + " --paradigm all-leaders"), &["needs F32 [5, "]);

    let complete = place.bytes("good.safetensors");
    for length in [0, 7, 8, 40, complete.len() - 1] {
        place.write("bad.safetensors", &complete[..length]);
        place.fails(1, &line("bad"), &["bad.safetensors: it is cut short"]);
    }
    place.write("bad.safetensors", "not tensors at all");
    let error = place.refused(1, &line("bad"));
    assert!(error.contains("it is not a safetensors file") && !error.contains("1048576"), "{error}");
    place.fails(1, &line("missing"), &["missing.safetensors: cannot be read"]);
    place.refused(1, "rollout small.toml --policies good.safetensors --scores no/such/folder.csv");
    assert_eq!(place.run("rollout small.toml").status.code(), Some(2));
}

#[cfg(unix)]
#[test]
fn printed_commands_can_be_run() {
    let place = place();
    let typed = r#"flotilla train small.toml --backend cpu --out "it's my \$HOME; run""#;
    let output = place.shell(typed);
    let stdout = String::from_utf8(output.stdout).unwrap();
    let (_, next) = stdout.split_once("Next:\n").expect(&stdout);
    let commands: Vec<&str> = next.lines().map(str::trim).filter(|line| !line.is_empty()).collect();
    assert_eq!(commands.len(), 3, "{stdout}");
    for command in commands {
        place.script(0, &format!("{command} --backend cpu"), &[]);
    }
    // run.json has the typed command, quoted for a shell.
    let record: serde_json::Value = serde_json::from_str(&place.read("it's my $HOME; run/run.json")).unwrap();
    let recorded = record["command"].as_str().unwrap().to_string() + " --force";
    place.script(0, &recorded, &[]);
    assert!(record.get("commit").is_some_and(|commit| *commit != ""));
}

#[test]
fn the_json_summary_agrees_with_the_files() {
    let place = place();
    let (stdout, stderr) = place.good("train small.toml --out run --json --quiet");
    assert_eq!(stderr, "");
    let summary: serde_json::Value = serde_json::from_str(&stdout).unwrap();
    assert_eq!(stdout.lines().count(), 1);
    for (key, value) in [("folder", "run"), ("config", "small")] {
        assert_eq!(summary[key], value);
    }
    for (key, value) in
        [("seed", 0), ("trials", 3), ("population", 8), ("generations", 6), ("pois", 2), ("trained_generations", 7)]
    {
        assert_eq!(summary[key], value, "{key}");
    }
    let run: serde_json::Value = serde_json::from_str(&place.read("run/run.json")).unwrap();
    assert_eq!(summary["digest"], run["digest"]);
    for file in summary["files"].as_object().unwrap().values() {
        assert!(place.path(file.as_str().unwrap()).exists(), "{file}");
    }
    // The scores agree with the metrics.
    let metrics = place.read("run/metrics.csv");
    let (_, rows) = rows(&metrics);
    for (moment, generation) in [("first", "0"), ("last", "6")] {
        for (column, name) in [(2, "best_g"), (3, "mean_g"), (4, "champion_g")] {
            let fields = rows.iter().filter(|row| row[1] == generation).map(|row| row[column].parse::<f64>().unwrap());
            let values: Vec<f64> = fields.collect();
            let score = |key: &str| summary[moment][name][key].as_f64().unwrap();
            assert!((score("mean") - values.iter().sum::<f64>() / 3.0).abs() < 1e-12);
            assert_eq!(score("lowest"), values.iter().copied().fold(f64::INFINITY, f64::min));
            assert_eq!(score("highest"), values.iter().copied().fold(0.0, f64::max));
        }
    }
    let resumed = place.json("train small.toml --out run --json --resume");
    assert_eq!((&resumed["digest"], &resumed["trained_generations"]), (&summary["digest"], &0.into()));
}

/// A rollout whose starts move far enough that a team's score differs between episodes.
const JITTERY: &str = "rollout small.toml --policies run/policies.safetensors --start-jitter 2.5";

/// Returns a folder with trained policies in `run/`.
fn trained() -> Place {
    let place = place();
    place.good("train small.toml --out run --generations 4 --trials 1 --quiet");
    place
}

/// Returns the numbers of a trace by episode, team, step and agent: the state, then the policy's inputs and outputs.
fn traced(text: &str, episodes: usize) -> Vec<Vec<Vec<Vec<Vec<f64>>>>> {
    let (teams, steps, agents) = (8, 10, 5);
    let columns = text.lines().next().unwrap().split(',').count();
    assert_eq!(columns, if episodes == 1 { 19 } else { 20 });
    let mut rows = text.lines().skip(1);
    let mut row = |episode: usize, team: usize, step: usize, agent: usize| {
        let row: Vec<&str> = rows.next().unwrap().split(',').collect();
        assert_eq!(row[..3], [team, step, agent].map(|number| number.to_string()));
        assert_eq!(row.len(), columns);
        assert!(episodes == 1 || row[19] == episode.to_string(), "{row:?}");
        row[4..19].iter().filter(|text| !text.is_empty()).map(|text| text.parse().unwrap()).collect()
    };
    let of_step =
        |e, t, s, row: &mut dyn FnMut(_, _, _, _) -> _| (0..agents).map(|a| row(e, t, s, a)).collect::<Vec<_>>();
    let of_team = |e, t, row: &mut dyn FnMut(_, _, _, _) -> _| (0..steps).map(|s| of_step(e, t, s, row)).collect();
    let numbers = (0..episodes).map(|e| (0..teams).map(|t| of_team(e, t, &mut row)).collect()).collect();
    assert!(rows.next().is_none());
    numbers
}

/// Returns the number of POIs that a traced team observed in the world of [`SMALL`].
fn observed(steps: &[Vec<Vec<f64>>], pois: [[f64; 2]; 2]) -> f64 {
    let within_radius = |agent: &[f64], [x, y]: [f64; 2]| (agent[0] - x).powi(2) + (agent[1] - y).powi(2) <= 25.0;
    let is_observed =
        |poi| steps[1..].iter().any(|agents| agents.iter().filter(|agent| within_radius(agent, poi)).count() >= 2);
    pois.into_iter().filter(|&poi| is_observed(poi)).count() as f64
}

#[test]
fn held_out_episodes_are_summarised_by_mean_deviation_and_interval() {
    let place = trained();
    let flags = "--episodes 12 --seed 3 --scores scores.csv --trace trace.csv";
    let (summary, stderr) = place.good(&format!("{JITTERY} {flags}"));
    assert!(stderr.starts_with("playing on cpu ("), "{stderr}");
    let (scores, trace) = (place.read("scores.csv"), place.read("trace.csv"));
    let episodes = traced(&trace, 12);

    // In an episode, all teams have the same starts, near those of the config. Starts differ between episodes.
    let start = |episode: &[Vec<Vec<Vec<f64>>>]| -> Vec<Vec<f64>> {
        let start = |team: &Vec<Vec<Vec<f64>>>| team[0].iter().map(|agent| agent[..2].to_vec()).collect::<Vec<_>>();
        assert!(episode.iter().all(|team| start(team) == start(&episode[0])));
        start(&episode[0])
    };
    let starts: Vec<_> = episodes.iter().map(|episode| start(episode)).collect();
    let unmoved = [[10.0, 5.0], [20.0, 5.0], [12.0, 2.0], [22.0, 2.0], [30.0, 2.0]];
    for (index, start) in starts.iter().enumerate() {
        assert!(!starts[..index].contains(start));
        for (agent, unmoved) in start.iter().zip(unmoved) {
            assert!(
                agent.iter().zip(unmoved).all(|(at, unmoved)| (at - unmoved).abs() <= 2.5 && *at >= 0.0),
                "{start:?}"
            );
        }
    }

    // Computes from the trace what the file and the summary must contain.
    let statistics = |values: &[f64]| {
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let deviation = (values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / (n - 1.0)).sqrt();
        // Student's t with 13 degrees of freedom, for the values and the smallest and the largest possible one.
        let more = [values, &[0.0, 2.0]].concat();
        let middle = more.iter().sum::<f64>() / (n + 2.0);
        let squares: f64 = more.iter().map(|value| (value - middle).powi(2)).sum();
        let half = 2.160369 * (squares / (n + 1.0) / (n + 2.0)).sqrt();
        [mean, deviation, (middle - half).max(0.0), (middle + half).min(2.0)]
    };
    let assert_close = |actual: &[f64], expected: &[f64]| {
        assert_eq!(actual.len(), expected.len());
        assert!(actual.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-4), "{actual:?} is not {expected:?}");
    };
    let pois = [[10.0, 9.0], [20.0, 9.0]];
    let teams: Vec<Vec<f64>> =
        (0..8).map(|team| episodes.iter().map(|episode| observed(&episode[team], pois)).collect()).collect();
    let (header, rows) = rows(&scores);
    assert_eq!(header, "team,leader,g,d,df,dpp,dt,episodes,pois,pois_deviation,pois_low,pois_high");
    assert_eq!(rows.len(), 8 * 2);
    let mut varied = 0;
    for (index, row) in rows.iter().enumerate() {
        let expected = statistics(&teams[index / 2]);
        assert_eq!(row[7], "12");
        assert_close(&[8, 9, 10, 11].map(|column| row[column].parse().unwrap()), &expected);
        assert_close(&[row[2].parse().unwrap()], &[expected[0] / 2.0]);
        varied += usize::from(expected[1] > 0.0);
    }
    assert!(varied > 0, "no team's score differs between episodes");
    let means: Vec<f64> = teams.iter().map(|team| statistics(team)[0]).collect();
    let best = (0..8).rev().max_by(|&a, &b| means[a].total_cmp(&means[b])).unwrap();
    let means_of_teams: Vec<f64> =
        (0..12).map(|episode| teams.iter().map(|team| team[episode]).sum::<f64>() / 8.0).collect();
    let lines: Vec<&str> = summary.lines().collect();
    assert_eq!(lines[0], "8 teams, 12 episodes each, starts moved by up to 2.5 (seed 3). POIs observed, of 2:");
    let (json, stderr) = place.good(&format!("{JITTERY} {flags} --json -q"));
    assert_eq!(stderr, "");
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!([&json["teams"], &json["pois"], &json["episodes"], &json["seed"]], [8, 2, 12, 3]);
    assert_eq!((json["start_jitter"].as_f64(), json["best"]["team"].as_u64()), (Some(2.5), Some(best as u64)));
    for (line, name, key, values) in [
        (2, "team 0".to_string(), "team_0", &teams[0]),
        (3, format!("best (team {best})"), "best", &teams[best]),
        (4, "mean of all teams".to_string(), "mean", &means_of_teams),
    ] {
        let expected = statistics(values);
        let numbers = lines[line].trim_start().strip_prefix(&name).unwrap().replace("to", " ");
        let printed: Vec<f64> = numbers.split_whitespace().map(|text| text.parse().unwrap()).collect();
        assert!(printed.iter().zip(expected).all(|(a, b)| (a - b).abs() <= 0.0051), "{summary} is not {expected:?}");
        let numbers = &json[key];
        let actual =
            [&numbers["mean"], &numbers["standard_deviation"], &numbers["interval_95"][0], &numbers["interval_95"][1]];
        assert_close(&actual.map(|number| number.as_f64().unwrap()), &expected);
    }

    // Another number of threads gives the same bits. Another seed gives other starts.
    place.good(&format!("{JITTERY} {flags} --threads 1"));
    assert_eq!((place.read("scores.csv"), place.read("trace.csv")), (scores.clone(), trace));
    place.good(&format!("{JITTERY} --episodes 12 --seed 4 --trace trace.csv"));
    let other_starts: Vec<_> = traced(&place.read("trace.csv"), 12).iter().map(|episode| start(episode)).collect();
    assert!(other_starts.iter().all(|start| !starts.contains(start)));

    // A score is the mean of the scores of single episodes from these starts.
    let mut sums = vec![[0.0; 4]; 16];
    for start in &starts {
        let moved = SMALL
            .replace("[[10, 5], [20, 5]]", &format!("{:?}", &start[..2]))
            .replace("[[12, 2], [22, 2], [30, 2]]", &format!("{:?}", &start[2..]));
        place.write("moved.toml", moved);
        place.good("rollout moved.toml --policies run/policies.safetensors --scores one.csv");
        for (sums, row) in sums.iter_mut().zip(self::rows(&place.read("one.csv")).1) {
            sums.iter_mut().zip(&row[2..]).for_each(|(sum, text)| *sum += text.parse::<f32>().unwrap() as f64);
        }
    }
    for (sums, row) in sums.iter().zip(&rows) {
        let actual: Vec<f32> = row[2..6].iter().map(|text| text.parse().unwrap()).collect();
        assert!(actual.iter().zip(sums).all(|(actual, sum)| (actual - (sum / 12.0) as f32).abs() < 1e-7), "{row:?}");
    }
}

/// Tests the positions of jittered POIs in a trace: what teams observe there is what their scores say.
#[test]
fn a_trace_has_the_positions_of_jittered_pois() {
    let place = trained();
    let flags = "--episodes 12 --poi-jitter 4 --scores scores.csv --trace trace.csv";
    place.good(&format!("rollout small.toml --policies run/policies.safetensors {flags}"));
    let (scores, trace) = (place.read("scores.csv"), place.read("trace.csv"));
    let (pois, agents): (Vec<&str>, Vec<&str>) = trace.lines().partition(|line| line.contains(",poi,"));
    let position = |episode: usize, poi: usize| {
        let row: Vec<&str> = pois[2 * episode + poi].split(',').collect();
        assert_eq!((row[..2].join(","), row[2], row[19]), ("0,0".into(), &*poi.to_string(), &*episode.to_string()));
        assert!(row[6..19].iter().all(|text| text.is_empty()), "{row:?}");
        [4, 5].map(|column| row[column].parse::<f64>().unwrap())
    };
    let drawn: Vec<_> = (0..12).map(|episode| [0, 1].map(|poi| position(episode, poi))).collect();
    assert!(pois.len() == 24 && drawn[0] != drawn[1]);
    let episodes = traced(&agents.join("\n"), 12);
    let (_, rows) = rows(&scores);
    let mut all = 0.0;
    for team in 0..8 {
        let expected: f64 = (0..12).map(|episode| observed(&episodes[episode][team], drawn[episode])).sum();
        assert_eq!(rows[2 * team][8].parse::<f64>().unwrap(), expected / 12.0, "team {team}");
        all += expected;
    }
    assert!(all > 0.0, "no team observes a POI");
}

#[test]
fn a_rollout_of_one_episode_has_no_columns_of_statistics() {
    let place = trained();
    place.good(&format!("{JITTERY} --episodes 1 --scores scores.csv --trace trace.csv"));
    assert!(place.read("scores.csv").starts_with("team,leader,g,d,df,dpp,dt\n0,0,"));
    let moved = place.read("trace.csv");
    place.good("rollout small.toml --policies run/policies.safetensors --trace trace.csv");
    assert_ne!(place.read("trace.csv"), moved, "--episodes 1 also moves the starts");
    let json = place.json("rollout small.toml --policies run/policies.safetensors --json");
    assert_eq!((&json["episodes"], &json["backend"]), (&1.into(), &"cpu".into()));
    for absent in [&json["seed"], &json["start_jitter"], &json["adapter"], &json["best"]["standard_deviation"]] {
        assert!(absent.is_null(), "{json}");
    }
    assert!(json["mean"]["mean"].as_f64().unwrap() <= json["best"]["mean"].as_f64().unwrap());
}

#[test]
fn rollout_refuses_flags_without_effect() {
    let place = trained();
    let line = "rollout small.toml --policies run/policies.safetensors";
    for flags in ["--trials 2", "--generations 3", "--population 4", "--fitness D", "--seed 5", "--start-jitter 1"] {
        place.refused(2, &format!("{line} {flags}"));
    }
    for flags in ["--episodes 2", "--episodes 1 --seed 5", "--episodes 2 --start-jitter 0"] {
        let error = place.refused(2, &format!("{line} {flags}"));
        assert!(error.contains("learning.start_jitter is 0, so all episodes are the same"), "{error}");
        assert!(error.contains("--start-jitter"), "does not suggest a flag: {error}");
    }
    place.refused(2, &format!("{line} --episodes 0"));
    place.fails(2, &format!("{line} --episodes 2 --start-jitter -1"), &["--start-jitter: found -1"]);
    place.good(&format!("{line} --episodes 1"));
    // If the config has a start jitter, no flag is needed.
    place.write("small.toml", SMALL.to_string() + "start_jitter = 1.5\n");
    place.prints(&format!("{line} --episodes 3"), &["starts moved by up to 1.5 (seed 0)"]);
}

#[test]
fn a_trace_has_the_inputs_and_outputs_of_leaders() {
    let place = trained();
    place.good("rollout small.toml --policies run/policies.safetensors --trace trace.csv");
    let trace = place.read("trace.csv");
    assert_eq!(
        trace.lines().next().unwrap(),
        "team,step,agent,role,x,y,heading_x,heading_y,speed,\
         pois_back_right,pois_front_right,pois_front_left,pois_back_left,\
         agents_back_right,agents_front_right,agents_front_left,agents_back_left,turn_output,speed_output"
    );
    let bytes = place.bytes("run/policies.safetensors");
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let tensor = file.tensor("weights.0").unwrap();
    let weights: Vec<f64> =
        tensor.data().chunks_exact(4).map(|bytes| f32::from_le_bytes(bytes.try_into().unwrap()).into()).collect();
    let mut compared = 0;
    for (index, team) in traced(&trace, 1)[0].iter().enumerate() {
        for (step, agents) in team.iter().enumerate() {
            for (agent, row) in agents.iter().enumerate() {
                if agent >= 2 || step == 9 {
                    assert_eq!(row.len(), 5, "inputs of a follower, or after the last step: {row:?}");
                    continue;
                }
                let &[x, y, hx, hy, _] = &row[..5] else { panic!("a state") };
                let sense = |others: &[[f64; 2]], range: f64, share: f64| {
                    let mut sums = [0.0; 4];
                    for [dx, dy] in others.iter().map(|other| [other[0] - x, other[1] - y]) {
                        let (ahead, left, distance) = (dx * hx + dy * hy, dy * hx - dx * hy, dx.hypot(dy));
                        let density = if distance <= range { 1.0 - distance / (2f64.sqrt() * 50.0) } else { 0.0 };
                        let is_left = left > 0.0 || left == 0.0 && ahead >= 0.0;
                        let is_front = ahead > 0.0 || ahead == 0.0 && left <= 0.0;
                        sums[match (is_left, is_front) {
                            (false, false) => 0,
                            (false, true) => 1,
                            (true, true) => 2,
                            (true, false) => 3,
                        }] += density / share;
                    }
                    sums
                };
                let others = |other: &(usize, &Vec<f64>)| other.0 != agent;
                let others: Vec<[f64; 2]> =
                    agents.iter().enumerate().filter(others).map(|(_, other)| [other[0], other[1]]).collect();
                let inputs = [sense(&[[10.0, 9.0], [20.0, 9.0]], 1e9, 2.0), sense(&others, 5.0, 5.0)].concat();
                let mut units = row[5..13].to_vec();
                assert!(inputs.iter().zip(&units).all(|(a, b)| (a - b).abs() < 1e-5), "{inputs:?} is not {row:?}");
                let mut policy = &weights[(agent * 8 + index) * PARAMETERS..][..PARAMETERS];
                for width in [5, 2] {
                    units.push(1.0);
                    let unit = |unit: usize| {
                        units.iter().enumerate().map(|(row, x)| x * policy[row * width + unit]).sum::<f64>().tanh()
                    };
                    let next = (0..width).map(unit).collect();
                    policy = &policy[units.len() * width..];
                    units = next;
                }
                assert!(units.iter().zip(&row[13..]).all(|(a, b)| (a - b).abs() < 1e-4), "{units:?} is not {row:?}");
                compared += 1;
            }
        }
    }
    assert_eq!(compared, 8 * 9 * 2);
}

#[test]
fn held_out_starts_are_never_training_starts() {
    use flotilla::config::Config;
    use flotilla::evaluate::Starts;
    use flotilla::evolve::{TRAINING_EPISODES, episode_positions};
    use flotilla::world::World;

    let mut config = Config::parse(SMALL, "small").unwrap();
    (config.learning.start_jitter, config.learning.poi_jitter) = (2.0, 2.0);
    let world = World::new(&config.validate().unwrap());
    // Returns the bits of the agents' starts, and of the POIs.
    let bits = |places: &[glam::Vec2]| -> [Vec<u32>; 2] {
        let (starts, pois) = places.split_at(world.agents());
        assert_eq!(pois.len(), world.pois.len());
        [starts, pois].map(|places| places.iter().flat_map(|at| [at.x.to_bits(), at.y.to_bits()]).collect())
    };
    let mut held_out = std::collections::HashSet::new();
    for seed in 0..4 {
        let starts = Starts::Drawn { episodes: 64, seed, jitter: 2.0, poi_jitter: 2.0 };
        held_out.extend((0..64).flat_map(|episode| bits(&starts.of(episode, &world))));
    }
    assert_eq!(held_out.len(), 2 * 4 * 64);
    let mut drawn = Vec::new();
    for (seed, trial) in (0..4).flat_map(|seed| (0..3).map(move |trial| (seed, trial))) {
        config.learning.seed = seed;
        for (generation, episode) in (0..64).flat_map(|generation| (0..4).map(move |episode| (generation, episode))) {
            episode_positions(&config.learning, trial, generation, (TRAINING_EPISODES, episode), &world, &mut drawn);
            assert!(
                bits(&drawn).iter().all(|places| !held_out.contains(places)),
                "seed {seed}, generation {generation}"
            );
        }
    }
}

/// Tests summaries of runs with 0 or 1 generations: no generation has two rows, and singular and plural are right.
#[test]
fn summaries_of_the_shortest_runs_have_the_right_rows_and_plurals() {
    let place = place();
    let (summary, _) = place.good("train small.toml --trials 1 --generations 0");
    assert!(summary.starts_with("Trained 1 trial of 8 teams, 0 generations, in "), "{summary}");
    assert!(summary.contains("\n  start ") && !summary.contains("generation 0"), "{summary}");
    let (summary, _) = place.good("train small.toml --generations 1");
    assert!(summary.starts_with("Trained 3 trials of 8 teams, 1 generation, in "), "{summary}");
    assert!(summary.contains("\n  start ") && summary.contains("\n  generation 1 "), "{summary}");
}

/// Tests that notes on a config, such as a replaced default, are printed and in the JSON.
#[test]
fn notes_on_a_config_are_printed() {
    let place = place();
    let text = "[world]\nleaders = [[9, 9]]\nfollowers = [[8, 8]]\npois = [[5, 5]]\nmap = [1000, 1000]\ndt = 0.001\n\
                [learning]\ntrials = 1\ngenerations = 0\n";
    place.write("noted.toml", text);
    for command in ["check noted.toml --json", "train noted.toml --json --quiet"] {
        let (stdout, stderr) = place.good(command);
        assert!(stderr.contains("note: world.coupling is not set: 2 is used"), "{command}: {stderr}");
        assert!(stderr.contains("note: motion.max_speed times world.dt is 3.00e-3 units"), "{command}: {stderr}");
        let json: serde_json::Value = serde_json::from_str(&stdout).unwrap();
        assert_eq!(json["notes"].as_array().unwrap().len(), 2, "{json}");
    }
    let (_, stderr) = place.good("train small.toml --out plain --quiet");
    assert!(!stderr.contains("note: world."), "{stderr}");
}

/// Tests that the error about a number too large for a config repeats the number as typed.
#[test]
fn errors_repeat_large_numbers_as_typed() {
    let place = place();
    for number in ["9223372036854775808", "18446744073709551616", "-9223372036854775809"] {
        place.fails(2, &["train", "small.toml", "--seed", number], &[&format!("--seed: found {number}, allowed")]);
    }
    place.good("train small.toml --seed 9223372036854775807 --generations 0 --quiet");
    assert!(place.read("runs/small/config.toml").contains("seed = 9223372036854775807"));
}

/// Files in memory, like those that the browser page puts into its archive.
#[derive(Default)]
struct Files(BTreeMap<String, Vec<u8>>);

impl Storage for Files {
    fn put(&mut self, name: &str, content: Content<'_>) -> Result<(), RecordError> {
        let mut bytes = Vec::new();
        content(&mut bytes).unwrap();
        self.0.insert(name.into(), bytes);
        Ok(())
    }
}

/// Returns the files of a run by name, without times, checksums and commands.
fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    fn without(text: &[u8], names: &[&str]) -> Vec<u8> {
        let mut value: serde_json::Value = serde_json::from_slice(text).unwrap();
        let drop = |value: &mut serde_json::Value| {
            value.as_object_mut().into_iter().for_each(|object| object.retain(|name, _| !names.contains(&&**name)));
        };
        drop(&mut value);
        value.get_mut("__metadata__").into_iter().for_each(drop);
        value.to_string().into_bytes()
    }
    let mut contents = support::files(folder);
    for (path, bytes) in &mut contents {
        match path.file_name().unwrap().to_str().unwrap() {
            "metrics.csv" => {
                let rows = support::metrics_without_seconds(&folder.join(path.parent().unwrap()));
                *bytes = format!("{rows:?}").into_bytes();
            }
            "run.json" => *bytes = without(bytes, &["started", "updated", "seconds", "command", "name"]),
            name if name.ends_with(".safetensors") && name != "policies.safetensors" => {
                let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
                let times = ["seconds", "metrics_bytes", "metrics_sha256", "checksum", "sha256"];
                *bytes = [without(&bytes[8..8 + length], &times), bytes[8 + length..].to_vec()].concat();
            }
            _ => {}
        }
    }
    contents
}

#[test]
fn the_command_and_the_library_write_the_same_files() {
    for method in ["tournament", "snes"] {
        compare_files(method);
    }
}

/// Trains with the command and with the library, which saves into a folder and into an archive. Compares the files,
/// and extends all three runs.
fn compare_files(method: &str) {
    let place = place();
    let set = format!("--set learning.method=\"{method}\"");
    place.good(&format!("train small.toml --out theirs --quiet {set}"));
    let text = SMALL.replacen("[learning]", &format!("[learning]\nmethod = \"{method}\""), 1);
    let config = Config::parse(&text, "small.toml").unwrap();
    assert!(config.to_toml().contains(&format!("method = \"{method}\"")));
    let mut backend = front::cpu();
    let trained = front::train(&config, &mut *backend.0, |_| Continue(())).unwrap();
    let columns = config.learning.generations + 1;
    let row = |(generation, trial): (usize, usize)| {
        let at = trial * columns + generation;
        let (best_g, mean_g, champion_g) = (trained.best_g[at], trained.mean_g[at], trained.champion_g[at]);
        (Row { experiment: 0, trial, generation, best_g, mean_g, champion_g, test_g: None }, generation as f64)
    };
    let rows: Vec<(Row, f64)> =
        (0..columns).flat_map(|generation| (0..3).map(move |trial| (generation, trial))).map(row).collect();
    let policies: Vec<&[f32]> = trained.policies.iter().map(|policies| &policies[..]).collect();
    let finished = || Finished {
        config: &config,
        rows: &rows,
        policies: &policies,
        ending: trained.ending.clone(),
        run: Run {
            version: flotilla::VERSION.into(),
            commit: flotilla::COMMIT.map(String::from),
            processor: ProcessorInfo::of(&backend.1, &backend.0.describe()),
            sessions: 1,
            ..Run::new(&config)
        },
    };
    let saved = place.path("saved");
    let (mut folder, _) = Folder::open(&saved, Start::Fresh, &config, StartFrom::Random, Disk::default()).unwrap();
    ops::train::save(finished(), &mut folder).unwrap();
    drop(folder);
    let mut archive = Files::default();
    ops::train::save(finished(), &mut archive).unwrap();
    for (name, content) in archive.0 {
        let path = place.path("archived").join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, content).unwrap();
    }
    let expected = files(&place.path("theirs"));
    for name in ["config.toml", "curves.svg", ".flotilla.sha256", "metrics.csv", "policies.safetensors", "run.json"] {
        assert!(expected.contains_key(Path::new(name)), "{name} is missing in {:?}", expected.keys());
    }
    for folder in ["saved", "archived"] {
        let mut actual = files(&place.path(folder));
        // An archive has no lock file.
        for (name, content) in expected.iter().filter(|(name, _)| folder == "saved" || !name.ends_with(".lock")) {
            let actual = actual.remove(name).unwrap_or_else(|| panic!("{folder}: no {}", name.display()));
            assert!(actual == *content, "{folder}/{}: {}", name.display(), String::from_utf8_lossy(&actual));
        }
        assert!(actual.is_empty(), "{folder}: {:?}", actual.keys());
    }
    let uninterrupted = place.json(&format!("train small.toml --out straight --generations 16 --json {set}"));
    for folder in ["theirs", "saved", "archived"] {
        let line = format!("train {folder}/config.toml --out {folder} --resume --generations 16 --json");
        let summary = place.json(&line);
        // Only the 10 new generations are trained.
        assert_eq!(
            (&summary["digest"], &summary["trained_generations"]),
            (&uninterrupted["digest"], &10.into()),
            "{folder}"
        );
    }
}

/// Runs a use case. `meanwhile` is called once, after some generations.
fn disturbed<R>(work: impl FnOnce(ops::Context<'_>) -> R, meanwhile: &dyn Fn()) -> R {
    let moved = Cell::new(false);
    let report = |event: ops::Event<'_>| {
        let begun = match event {
            ops::Event::Rows { next, .. } => next == 3,
            ops::Event::Fraction(part, _) => part > 0.4,
            _ => false,
        };
        if begun && !moved.replace(true) {
            meanwhile();
        }
    };
    let outcome = work(ops::Context::new(&report));
    assert!(moved.get());
    outcome
}

/// Returns `small.toml` with a seed, and with POIs that only some teams observe.
fn seeded(seed: u64) -> String {
    let text = SMALL.replace("[learning]", &format!("[learning]\nseed = {seed}"));
    text.replace("pois = [[10, 9], [20, 9]]", "pois = [[11, 9], [23, 9]]")
}

/// Trains `small.toml` with a seed into a folder. `meanwhile` is called once, after some generations.
fn train_disturbed(out: PathBuf, seed: u64, meanwhile: &dyn Fn()) -> serde_json::Value {
    let config = ops::ConfigText { text: seeded(seed), name: "small.toml".into(), set: vec![] };
    let request = TrainRequest { config, name: "small".into(), out: Some(out), start: Start::Fresh, init: None };
    let found = disturbed(|context| ops::train::run(&request, &mut &mut front::cpu(), context), meanwhile);
    serde_json::to_value(found.unwrap()).unwrap()
}

/// Returns the files of a folder that do not depend on the time and the place.
fn results(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let names =
        ["config.toml", "curves.svg", "policies.safetensors", "points/0001/policies.safetensors", "results.csv"];
    names.into_iter().filter_map(|name| Some((name.into(), fs::read(folder.join(name)).ok()?))).collect()
}

#[test]
fn a_run_whose_folder_is_moved_ends_where_it_is() {
    let place = place();
    let expected = train_disturbed(place.path("reference"), 1, &|| ());
    let other = train_disturbed(place.path("other"), 2, &|| ());
    assert_ne!(expected["first"], other["first"]);
    let check = |outcome: serde_json::Value, moved: &str, path: &str| {
        assert_eq!(outcome["digest"], expected["digest"]);
        assert_eq!(outcome["last"], expected["last"]);
        assert_eq!(results(&place.path(moved)), results(&place.path("reference")), "{moved}");
        assert_eq!(results(&place.path(path)), results(&place.path("other")), "{path}");
        for (folder, of) in [(moved, &expected), (path, &other)] {
            assert_eq!(
                Run::read(&place.path(folder).join("run.json")).unwrap().digest.as_deref(),
                of["digest"].as_str()
            );
            place.good(&format!("replay {folder}"));
        }
    };
    // Another run takes the path.
    let moved = train_disturbed(place.path("run"), 1, &|| {
        fs::rename(place.path("run"), place.path("moved")).unwrap();
        train_disturbed(place.path("run"), 2, &|| ());
    });
    check(moved, "moved", "run");
    // The path is a link, which leads to another folder later.
    #[cfg(unix)]
    {
        let lead = |to: &str| {
            let _ = fs::remove_file(place.path("latest"));
            fs::create_dir(place.path(to)).unwrap();
            std::os::unix::fs::symlink(to, place.path("latest")).unwrap();
        };
        lead("first");
        let linked = train_disturbed(place.path("latest"), 1, &|| {
            lead("second");
            train_disturbed(place.path("latest"), 2, &|| ());
        });
        check(linked, "first", "latest");
    }
    // Nothing takes the path.
    let moved = train_disturbed(place.path("run-2"), 1, &|| {
        fs::rename(place.path("run-2"), place.path("moved-2")).unwrap();
    });
    check(moved, "moved-2", "other");
    assert!(!place.path("run-2").exists());
}

#[test]
fn a_sweep_whose_folder_is_moved_ends_where_it_is() {
    let place = place();
    let sweep = |out: &str, seed: u64, meanwhile: &dyn Fn()| {
        let text = format!("{}\n[grid]\n\"learning.fitness\" = ['D', 'Df']\n", seeded(seed));
        let request = serde_json::json!({ "use_case": "sweep", "text": text, "name": "small.toml",
            "out": place.path(out), "named": true, "start": "fresh" });
        let request = serde_json::from_value(request).unwrap();
        let answer =
            |context: ops::Context<'_>| flotilla_cli::request::answer(&request, &mut &mut front::cpu(), context);
        disturbed(answer, meanwhile).unwrap();
    };
    sweep("reference", 1, &|| ());
    sweep("other", 2, &|| ());
    sweep("grid", 1, &|| {
        fs::rename(place.path("grid"), place.path("moved")).unwrap();
        sweep("grid", 2, &|| ());
    });
    assert_eq!(results(&place.path("reference")).len(), 3);
    assert_eq!(results(&place.path("moved")), results(&place.path("reference")));
    assert_eq!(results(&place.path("grid")), results(&place.path("other")));
}
