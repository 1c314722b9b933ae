//! `train` and `rollout` as a user meets them: the files, what is printed and where, exit codes.

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use assert_cmd::cargo::cargo_bin_cmd;
use flotilla::record::hex;
use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};
use sha2::{Digest, Sha256};
use tempfile::TempDir;

const CONFIG: &str = "
[world]
leaders = [[10, 5], [20, 5]]
followers = [[12, 2], [22, 2], [30, 2]]
pois = [[10, 9], [20, 9]]
coupling = 2
steps = 9
[policy]
hidden = [5]
[learning]
population = 8
generations = 6
trials = 3
";
const PARAMETERS: usize = 9 * 5 + 6 * 2;

/// A folder with `small.toml` in it, where commands run.
struct Place(TempDir);

impl Place {
    fn new() -> Place {
        let place = Place(tempfile::tempdir().unwrap());
        fs::write(place.path("small.toml"), CONFIG).unwrap();
        place
    }

    fn path(&self, name: impl AsRef<Path>) -> PathBuf {
        self.0.path().join(name)
    }

    /// Runs a command, on the CPU unless it says otherwise: a GPU's driver may have things to tell of its own.
    fn run(&self, line: &str) -> Output {
        let backend = if line.contains("--backend") { "" } else { " --backend cpu" };
        let line = line.to_string() + backend;
        cargo_bin_cmd!("flotilla").args(line.split_whitespace()).current_dir(self.0.path()).output().unwrap()
    }

    /// Standard output and standard error of a command that must succeed.
    fn good(&self, line: &str) -> (String, String) {
        let output = self.run(line);
        let told = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(0), "{line}: {told}");
        (String::from_utf8(output.stdout).unwrap(), told)
    }

    /// The error of a command that must fail with a code and say nothing on standard output.
    fn refused(&self, line: &str, code: i32) -> String {
        let output = self.run(line);
        let told = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(code), "{line}: {told}");
        assert!(output.stdout.is_empty(), "{line}");
        told[told.find("error: ").unwrap_or_else(|| panic!("{line}: {told}"))..].to_string()
    }

    fn read(&self, name: &str) -> String {
        fs::read_to_string(self.path(name)).unwrap()
    }

    /// Writes a safetensors file with one tensor, as another program would.
    fn tensor(&self, name: &str, tensor: &str, dtype: Dtype, shape: &[usize], data: &[u8], layers: Option<&str>) {
        let view = TensorView::new(dtype, shape.to_vec(), data).unwrap();
        let metadata = layers.map(|layers| HashMap::from([("layers".to_string(), layers.to_string())]));
        fs::write(self.path(name), safetensors::serialize([(tensor, view)], metadata).unwrap()).unwrap();
    }

    fn weights(&self, name: &str, shape: [usize; 3], weights: &[f32]) {
        self.tensor(name, "weights", Dtype::F32, &shape, bytemuck::cast_slice(weights), None);
    }
}

/// Rows of a CSV file as text, and its header.
fn rows(text: &str) -> (&str, Vec<Vec<&str>>) {
    let (header, rest) = text.split_once('\n').unwrap();
    (header, rest.lines().map(|line| line.split(',').collect()).collect())
}

#[test]
fn training_writes_a_folder_that_says_everything() {
    let place = Place::new();
    let (summary, told) = place.good("train small.toml --backend cpu");
    assert!(told.starts_with("training on cpu ("), "{told}");
    let files = ["config.toml", "run.json", "metrics.csv", "policies.safetensors", "checkpoints"];
    for name in files {
        assert!(place.path("runs/small").join(name).exists(), "{name}");
    }
    for word in ["POIs observed, of 2", "start", "generation 6", "flotilla replay runs/small", "metrics.csv"] {
        assert!(summary.contains(word), "{word}: {summary}");
    }

    // One row a trial and generation, in order.
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

    // The policies, for any program that reads safetensors.
    let bytes = fs::read(place.path("runs/small/policies.safetensors")).unwrap();
    let (_, header) = SafeTensors::read_metadata(&bytes).unwrap();
    assert_eq!(header.metadata().as_ref().unwrap()["layers"], "8,5,2");
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    assert_eq!(tensors.len(), 3);
    // The digest is what its description says.
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

    // The resolved config alone repeats the run, with other threads.
    let (again, _) = place.good("train runs/small/config.toml --out again --threads 1 --quiet");
    assert!(again.contains(run["digest"].as_str().unwrap()), "{again}");
    assert_eq!(fs::read(place.path("again/policies.safetensors")).unwrap(), bytes);
    assert_eq!(place.read("again/config.toml"), place.read("runs/small/config.toml"));
}

#[test]
fn flags_stand_in_the_resolved_config_and_quiet_is_quiet() {
    let place = Place::new();
    let (_, told) = place.good(
        "train small.toml --seed 4 --trials 1 --generations 2 --population 5 --fitness D++ --paradigm all-leaders \
         --checkpoint-generations 1 --checkpoint-seconds 0.5 --quiet --backend cpu",
    );
    assert_eq!(told, "");
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
    let error = place.refused("train small.toml --checkpoint-seconds -1", 2);
    assert!(error.contains("--checkpoint-seconds: found -1"), "{error}");
    // A config that is refused leaves no folder.
    assert!(!place.path("runs/small-2").exists());
}

#[test]
fn a_run_is_written_over_only_when_that_is_asked_for() {
    let place = Place::new();
    let short = "--generations 1 --quiet";
    place.good(&format!("train small.toml {short}"));
    // Without --out, a free folder is taken.
    place.good(&format!("train small.toml {short}"));
    place.good(&format!("train small.toml {short}"));
    assert!(place.path("runs/small-2/run.json").exists() && place.path("runs/small-3/run.json").exists());
    let error = place.refused(&format!("train small.toml --out runs/small {short}"), 1);
    assert!(error.contains("runs/small holds a run already"), "{error}");
    let error = place.refused(&format!("train small.toml --out runs/small --resume --seed 9 {short}"), 1);
    assert!(error.contains("learning.seed: 0 there, 9 here"), "{error}");
    place.good(&format!("train small.toml --out runs/small --force --seed 9 {short}"));
    assert!(place.read("runs/small/config.toml").contains("seed = 9"));
    // Resuming what is done tells what it came to, and changes nothing.
    let before = place.read("runs/small-3/run.json");
    let (summary, _) = place.good(&format!("train small.toml --resume {short}"));
    assert!(summary.contains("runs/small-3") && summary.starts_with("This run was done already."), "{summary}");
    assert_eq!(place.read("runs/small-3/run.json"), before);
    assert_eq!(place.run("train small.toml --resume --force").status.code(), Some(2));
    // What is not there yet is started.
    place.good(&format!("train small.toml --out fresh --resume {short}"));
    assert!(place.path("fresh/run.json").exists());
}

#[test]
fn an_adapter_is_for_gpus() {
    let place = Place::new();
    let output = place.run("train small.toml --backend cpu --adapter Voodoo");
    assert_eq!(output.status.code(), Some(2));
    assert!(!place.path("runs").exists());
}

#[test]
fn the_first_team_of_a_rollout_is_the_trials_champion() {
    let place = Place::new();
    place.good("train small.toml --out run --generations 9 --quiet");
    let metrics = place.read("run/metrics.csv");
    for trial in 0..3 {
        let line = format!(
            "rollout small.toml --policies run/policies.safetensors --trial {trial} --scores scores.csv --trace trace.csv"
        );
        let (summary, _) = place.good(&line);
        assert!(summary.starts_with("8 teams, POIs observed of 2: team 0 "), "{summary}");
        let last = format!("{trial},9,");
        let row = metrics.lines().find(|line| line.starts_with(&last)).unwrap();
        let champion: f64 = row.split(',').nth(4).unwrap().parse().unwrap();
        let scores = place.read("scores.csv");
        let (header, scores) = rows(&scores);
        assert_eq!(header, "team,leader,g,d,df,dpp");
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
    assert_eq!(header, "team,step,agent,role,x,y,heading_x,heading_y,speed");
    assert_eq!(trace.len(), 8 * 10 * 5);
    for (index, row) in trace.iter().enumerate() {
        let (team, step, agent) = (index / 50, index / 5 % 10, index % 5);
        assert_eq!((row[0].parse(), row[1].parse(), row[2].parse()), (Ok(team), Ok(step), Ok(agent)));
        assert_eq!(row[3], if agent < 2 { "leader" } else { "follower" });
    }
    assert_eq!(trace[2][4..], ["12", "2", "0", "1", "0"]);
    // Printed floats read back to the same bits.
    let float = |text: &str| text.parse::<f32>().unwrap().to_string() == *text;
    assert!(trace.iter().all(|row| row[4..].iter().all(|text| float(text))));
}

#[test]
fn rollout_takes_other_programs_files_and_refuses_what_it_cannot_play() {
    let place = Place::new();
    let count = 2 * 3 * PARAMETERS;
    let good: Vec<f32> = (0..count).map(|index| (index as f32 - 90.0) / 50.0).collect();
    place.weights("good.safetensors", [2, 3, PARAMETERS], &good);
    let line = |file: &str| format!("rollout small.toml --policies {file}.safetensors --scores scores.csv");
    place.good(&line("good"));
    let scores = place.read("scores.csv");
    assert_eq!(scores.lines().count(), 1 + 3 * 2);

    // Weights too small for the kernels are 0.
    let mut tiny = good.clone();
    tiny[5] = 0.0;
    place.weights("zero.safetensors", [2, 3, PARAMETERS], &tiny);
    tiny[5] = 1e-40;
    place.weights("tiny.safetensors", [2, 3, PARAMETERS], &tiny);
    let [zero, tiny] = ["zero", "tiny"].map(|name| {
        place.good(&(line(name) + " --trace trace.csv"));
        (place.read("scores.csv"), place.read("trace.csv"))
    });
    assert_eq!(zero, tiny);

    for (value, text) in [(f32::NAN, "NaN"), (f32::NEG_INFINITY, "-inf"), (2e6, "2000000")] {
        let mut bad = good.clone();
        bad[PARAMETERS * 4 + 7] = value;
        place.weights("bad.safetensors", [2, 3, PARAMETERS], &bad);
        let error = place.refused(&line("bad"), 1);
        assert!(
            error.contains(&format!("weights[1, 1, 7] is {text}, allowed are numbers of size up to 1048576")),
            "{error}"
        );
    }

    let needs = format!("but the config needs F32 [2, 1 to 1048576, {PARAMETERS}]");
    let bytes = bytemuck::cast_slice(&good);
    for (dtype, shape, found) in [
        (Dtype::F32, vec![3, 2, PARAMETERS], format!("weights is F32 [3, 2, {PARAMETERS}]")),
        (Dtype::F32, vec![2, PARAMETERS, 3], format!("weights is F32 [2, {PARAMETERS}, 3]")),
        (Dtype::F32, vec![6 * PARAMETERS], format!("weights is F32 [{}]", 6 * PARAMETERS)),
        (Dtype::F64, vec![1, 3, PARAMETERS], format!("weights is F64 [1, 3, {PARAMETERS}]")),
        (Dtype::I32, vec![2, 3, PARAMETERS], format!("weights is I32 [2, 3, {PARAMETERS}]")),
    ] {
        place.tensor("bad.safetensors", "weights", dtype, &shape, bytes, None);
        let error = place.refused(&line("bad"), 1);
        assert!(error.contains(&found) && error.contains(&needs), "{error}");
    }
    place.tensor("bad.safetensors", "weights", Dtype::F32, &[2, 0, PARAMETERS], &[], None);
    assert!(place.refused(&line("bad"), 1).contains(&needs));
    place.tensor("bad.safetensors", "weights", Dtype::F32, &[2, 3, PARAMETERS], bytes, Some("8,4,1,2"));
    assert!(place.refused(&line("bad"), 1).contains("layers \"8,4,1,2\", but the config's have \"8,5,2\""));
    place.tensor("bad.safetensors", "w", Dtype::F32, &[2, 3, PARAMETERS], bytes, None);
    assert!(place.refused(&line("bad"), 1).contains("it has no tensor weights.0; it has w"));
    assert!(place.refused(&(line("good") + " --trial 2"), 2).contains("it has no tensor weights.2; it has weights"));
    // Every learner needs policies.
    assert!(place.refused(&(line("good") + " --paradigm all-leaders"), 1).contains("needs F32 [5, "));

    let whole = fs::read(place.path("good.safetensors")).unwrap();
    for cut in [0, 7, 8, 40, whole.len() - 1] {
        fs::write(place.path("bad.safetensors"), &whole[..cut]).unwrap();
        let error = place.refused(&line("bad"), 1);
        assert!(error.contains("bad.safetensors: it is cut short"), "{error}");
    }
    fs::write(place.path("bad.safetensors"), "not tensors at all").unwrap();
    assert!(place.refused(&line("bad"), 1).contains("it is no safetensors file"));
    assert!(place.refused(&line("missing"), 1).contains("missing.safetensors: cannot be read"));
    place.refused("rollout small.toml --policies good.safetensors --scores no/such/folder.csv", 1);
    assert_eq!(place.run("rollout small.toml").status.code(), Some(2));
}
