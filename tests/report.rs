//! Pictures and replays of small real runs, and what becomes of damaged ones.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use assert_cmd::Command;
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use flotilla::backend::cpu::Cpu;
use flotilla::config::{Config, Fitness, Override};
use flotilla::report::paper;
use flotilla::trainer::Trainer;
use serde_json::Value;
use tempfile::TempDir;

fn flotilla(arguments: &[&str]) -> Output {
    Command::cargo_bin("flotilla").unwrap().args(arguments).output().unwrap()
}

fn succeed(arguments: &[&str]) -> String {
    let output = flotilla(arguments);
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// Fails with exit code 1 and gives the message, which must name all of `said` and no panic.
fn fail(arguments: &[&str], said: &[&str]) {
    let output = flotilla(arguments);
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{arguments:?}: {message}");
    assert!(message.starts_with("error: "), "{message}");
    for word in said {
        assert!(message.contains(word), "{arguments:?}: {message:?} does not say {word:?}");
    }
}

/// Two leaders with two followers each, and two POIs within reach.
const CONFIG: &str = "
[world]
map = [30.0, 20.0]
leaders = [[8.0, 5.0], [20.0, 5.0]]
followers = [[9.0, 3.0], [7.0, 3.0], [21.0, 3.0], [19.0, 3.0]]
pois = [[8.0, 10.0], [20.0, 10.0]]
coupling = 2
steps = 20
[learning]
population = 10
generations = 6
trials = 3
";

struct Run {
    folder: TempDir,
}

impl Run {
    fn new(config: &str, arguments: &[&str]) -> Run {
        let folder = TempDir::new().unwrap();
        let (config_path, out) = (folder.path().join("small.toml"), folder.path().join("run"));
        fs::write(&config_path, config).unwrap();
        let mut all = vec!["train", config_path.to_str().unwrap(), "--out", out.to_str().unwrap(), "--backend", "cpu"];
        all.extend(arguments);
        all.push("--quiet");
        succeed(&all);
        Run { folder }
    }

    fn path(&self) -> PathBuf {
        self.folder.path().join("run")
    }

    fn file(&self, name: &str) -> PathBuf {
        self.path().join(name)
    }

    fn text(&self) -> String {
        self.path().to_str().unwrap().to_string()
    }

    /// G of the best team by trial and generation.
    fn best(&self) -> BTreeMap<(usize, usize), f64> {
        let text = fs::read_to_string(self.file("metrics.csv")).unwrap();
        text.lines()
            .skip(1)
            .map(|line| {
                let fields: Vec<&str> = line.split(',').collect();
                ((fields[0].parse().unwrap(), fields[1].parse().unwrap()), fields[2].parse().unwrap())
            })
            .collect()
    }
}

/// What a page plays.
fn data(path: &Path) -> Value {
    let page = fs::read_to_string(path).unwrap();
    let start = page.find("id=\"data\">").unwrap() + "id=\"data\">".len();
    let end = start + page[start..].find("</script>").unwrap();
    serde_json::from_str(&page[start..end]).unwrap()
}

fn floats(text: &Value) -> Vec<f32> {
    let bytes = BASE64_STANDARD.decode(text.as_str().unwrap()).unwrap();
    bytes.chunks_exact(4).map(|bytes| f32::from_le_bytes(bytes.try_into().unwrap())).collect()
}

/// SVG elements by name, with a check that the document is closed.
fn count(svg: &str, element: &str) -> usize {
    assert!(svg.starts_with("<svg ") && svg.trim_end().ends_with("</svg>"));
    svg.matches(&format!("<{element} ")).count()
}

#[test]
fn a_run_plots_as_svg_and_png() {
    let run = Run::new(CONFIG, &[]);
    succeed(&["plot", &run.text()]);
    let svg = fs::read_to_string(run.file("curves.svg")).unwrap();
    for label in ["best team", "champion", "mean team", "Generation", "POIs observed"] {
        assert!(svg.contains(label), "{label}");
    }
    let picture = run.file("curves.png");
    succeed(&["plot", &run.text(), "--out", picture.to_str().unwrap()]);
    let png = fs::read(picture).unwrap();
    assert_eq!(png[..8], *b"\x89PNG\r\n\x1a\n");
    // A column of a paper at 300 dots an inch.
    assert_eq!(u32::from_be_bytes(png[16..20].try_into().unwrap()), 1004);
}

#[test]
fn curves_stand_where_the_metrics_say() {
    // One trial has no error, and its mean is itself.
    let run = Run::new(CONFIG, &["--trials", "1"]);
    succeed(&["plot", &run.text()]);
    let svg = fs::read_to_string(run.file("curves.svg")).unwrap();
    assert_eq!(count(&svg, "polygon"), count(&svg.replace("stroke=\"#ffffff\"", ""), "polygon"));
    let line = svg.lines().filter(|line| line.starts_with("<polyline")).find(|line| line.matches(',').count() == 7);
    let points = line.unwrap().split('"').nth(1).unwrap();
    let heights: Vec<f64> = points.split(' ').map(|point| point.split(',').nth(1).unwrap().parse().unwrap()).collect();
    let best = run.best();
    for (generation, height) in heights.iter().enumerate() {
        for (other, other_height) in heights.iter().enumerate() {
            let (a, b) = (best[&(0, generation)], best[&(0, other)]);
            assert_eq!(a.partial_cmp(&b), other_height.partial_cmp(height), "{generation} and {other}");
        }
    }
}

#[test]
fn training_draws_its_curves() {
    let run = Run::new(CONFIG, &[]);
    assert!(fs::read_to_string(run.file("curves.svg")).unwrap().contains("champion"));
}

#[test]
fn event_files_have_every_generation_of_every_trial_once() {
    let run = Run::new(CONFIG, &["--tensorboard"]);
    for trial in 0..3 {
        let folder = run.file("tensorboard").join(format!("trial-{trial}"));
        let files: Vec<_> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
        let bytes = fs::read(&files[0]).unwrap();
        assert_eq!(files.len(), 1);
        // Records: length, checksum, content, checksum.
        let (mut rest, mut records) = (&bytes[..], 0);
        while !rest.is_empty() {
            let length = u64::from_le_bytes(rest[..8].try_into().unwrap()) as usize;
            rest = &rest[12 + length + 4..];
            records += 1;
        }
        assert_eq!(records, 1 + 7, "the version, and generations 0 to 6");
    }
}

#[test]
fn several_runs_are_labelled_by_what_differs() {
    let (one, other) = (Run::new(CONFIG, &["--fitness", "G"]), Run::new(CONFIG, &["--fitness", "D++"]));
    let out = one.file("both.svg");
    succeed(&["plot", &one.text(), &other.text(), "--out", out.to_str().unwrap()]);
    let svg = fs::read_to_string(out).unwrap();
    assert!(svg.contains(">fitness G<") && svg.contains(">fitness D++<"), "{svg}");
    assert!(!svg.contains("population"));
}

#[test]
fn runs_that_differ_in_nothing_are_labelled_by_their_folders() {
    let run = Run::new(CONFIG, &[]);
    let out = run.file("both.svg");
    succeed(&["plot", &run.text(), &run.text(), "--out", out.to_str().unwrap()]);
    assert!(fs::read_to_string(out).unwrap().contains("run<"));
}

#[test]
fn folders_that_are_no_runs_are_told_apart() {
    let empty = TempDir::new().unwrap();
    let nowhere = empty.path().join("nowhere");
    let file = empty.path().join("file");
    fs::write(&file, "").unwrap();
    for command in ["plot", "replay"] {
        fail(&[command, nowhere.to_str().unwrap()], &["no such folder", "flotilla train"]);
        fail(&[command, file.to_str().unwrap()], &["is a file"]);
        fail(&[command, empty.path().to_str().unwrap()], &["config.toml", "flotilla train"]);
    }
}

#[test]
fn damaged_runs_say_what_is_wrong() {
    let run = Run::new(CONFIG, &[]);
    let metrics = fs::read_to_string(run.file("metrics.csv")).unwrap();
    let with = |text: &[u8], said: &[&str]| {
        fs::write(run.file("metrics.csv"), text).unwrap();
        fail(&["plot", &run.text()], said);
        fail(&["replay", &run.text()], said);
    };
    let header = metrics.lines().next().unwrap();
    with(b"", &["metrics.csv", "line 1"]);
    with(b"\xff\xfe\0\0", &["metrics.csv", "line 1"]);
    with(format!("{header}\n").as_bytes(), &["no rows yet", "--resume"]);
    with(format!("{header}\n0,0,nan,0,0,0\n").as_bytes(), &["line 2"]);
    with(format!("{header}\n0,0,1e999,0,0,0\n").as_bytes(), &["line 2"]);
    with(format!("{header}\n3,0,0,0,0,0\n").as_bytes(), &["line 2", "config.toml"]);
    with(format!("{header}\n0,1000000,0,0,0,0\n").as_bytes(), &["line 2", "config.toml"]);
    with(format!("{header}\n{}\n", "9".repeat(1 << 20)).as_bytes(), &["rows"]);
    fs::remove_file(run.file("metrics.csv")).unwrap();
    fail(&["plot", &run.text()], &["metrics.csv", "--resume"]);
    fs::write(run.file("config.toml"), "[world").unwrap();
    fail(&["plot", &run.text()], &["config.toml", "flotilla train"]);
}

#[test]
fn a_half_written_run_plots_and_replays_as_far_as_it_came() {
    let run = Run::new(CONFIG, &[]);
    let metrics = fs::read_to_string(run.file("metrics.csv")).unwrap();
    let lines: Vec<&str> = metrics.lines().take(1 + 3 * 4).collect();
    fs::write(run.file("metrics.csv"), lines.join("\n") + "\n0,4,0.").unwrap();
    succeed(&["plot", &run.text()]);
    let said = succeed(&["replay", &run.text(), "--backend", "cpu"]);
    assert!(said.contains("generation 3"), "{said}");
    fail(&["replay", &run.text(), "--generation", "5", "--backend", "cpu"], &["generation 5", "newest is 3"]);
}

#[test]
fn every_generation_replays_with_the_score_it_had() {
    let run = Run::new(CONFIG, &["--checkpoint-generations", "2"]);
    assert!(run.best().values().any(|&best| best > 0.0));
    for ((trial, generation), best) in run.best() {
        let (trial_text, generation_text) = (trial.to_string(), generation.to_string());
        let arguments = ["replay", &run.text(), "--trial", &trial_text, "--generation", &generation_text];
        let said = succeed(&[&arguments[..], &["--backend", "cpu"]].concat());
        assert!(said.contains(&format!("G = {best} of")), "{said}");
        let page = data(&run.file("replay.html"));
        let episode = &page["episodes"][0];
        assert_eq!(episode["g"].as_f64().unwrap(), best);
        let observed = episode["observed"].as_array().unwrap().iter().filter(|step| !step.is_null()).count();
        assert_eq!(observed as f64 / 2.0, best);
    }
}

#[test]
fn a_replay_shows_what_rollout_traces() {
    // In the last generation, the file's policies are the populations that played, in another order: team by team the
    // champions' team, the first, may be found among them, and its trace is rollout's.
    let run = Run::new(CONFIG, &["--population", "2", "--trials", "1"]);
    succeed(&["replay", &run.text(), "--backend", "cpu"]);
    let page = data(&run.file("replay.html"));
    let episode = &page["episodes"][0];
    assert_eq!(page["exact"], true);
    let positions = floats(&episode["positions"]);
    let headings = floats(&episode["headings"]);
    let (agents, steps) = (6, 20);
    assert_eq!(positions.len(), (steps + 1) * agents * 2);

    let policies = run.file("policies.safetensors");
    let bytes = fs::read(&policies).unwrap();
    let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let tensor = file.tensor("weights.0").unwrap();
    let shape = tensor.shape().to_vec();
    let numbers: Vec<f32> =
        tensor.data().chunks_exact(4).map(|bytes| f32::from_le_bytes(bytes.try_into().unwrap())).collect();
    // All four ways to choose a policy a leader.
    let parameters = shape[2];
    let of = |leader: usize, policy: usize| &numbers[(leader * 2 + policy) * parameters..][..parameters];
    let teams = [[0, 0], [0, 1], [1, 0], [1, 1]];
    let weights: Vec<f32> =
        (0..2).flat_map(|leader| teams.iter().flat_map(move |team| of(leader, team[leader]).to_vec())).collect();
    let raw: Vec<u8> = weights.iter().flat_map(|weight| weight.to_le_bytes()).collect();
    let view = safetensors::tensor::TensorView::new(safetensors::Dtype::F32, vec![2, 4, parameters], &raw).unwrap();
    let all = run.file("all.safetensors");
    fs::write(&all, safetensors::serialize([("weights", view)], None).unwrap()).unwrap();
    let trace = run.file("trace.csv");
    succeed(&[
        "rollout",
        run.file("config.toml").to_str().unwrap(),
        "--policies",
        all.to_str().unwrap(),
        "--trace",
        trace.to_str().unwrap(),
        "--backend",
        "cpu",
    ]);
    let mut traced = vec![vec![[0f32; 4]; (steps + 1) * agents]; 4];
    for line in fs::read_to_string(trace).unwrap().lines().skip(1) {
        let fields: Vec<&str> = line.split(',').collect();
        let [team, step, agent] = [0, 1, 2].map(|field| fields[field].parse::<usize>().unwrap());
        traced[team][step * agents + agent] = [4, 5, 6, 7].map(|field| fields[field].parse().unwrap());
    }
    let shown: Vec<[f32; 4]> =
        positions.chunks_exact(2).zip(headings.chunks_exact(2)).map(|(p, h)| [p[0], p[1], h[0], h[1]]).collect();
    assert!(traced.contains(&shown), "no team moves as the page shows");
}

#[test]
fn a_replay_of_other_metrics_is_refused() {
    let run = Run::new(CONFIG, &[]);
    let metrics = fs::read_to_string(run.file("metrics.csv")).unwrap();
    let forged: String = metrics
        .lines()
        .map(|line| {
            let mut fields: Vec<&str> = line.split(',').collect();
            if fields[0] == "0" && fields[1] == "6" {
                fields[2] = if fields[2] == "1" { "0.5" } else { "1" };
            }
            fields.join(",") + "\n"
        })
        .collect();
    fs::write(run.file("metrics.csv"), forged).unwrap();
    fail(&["replay", &run.text(), "--backend", "cpu"], &["generation 6", "metrics.csv says"]);
    fail(&["replay", &run.text(), "--trial", "3", "--backend", "cpu"], &["no trial 3", "0 to 2"]);
}

#[test]
fn pictures_of_replays_are_whole() {
    let run = Run::new(CONFIG, &[]);
    let write = |name: &str| {
        let out = run.file(name);
        succeed(&["replay", &run.text(), "--compare", "0", "--out", out.to_str().unwrap(), "--backend", "cpu"]);
        fs::read(out).unwrap()
    };
    let svg = String::from_utf8(write("still.svg")).unwrap();
    assert!(svg.contains("Generation 0") && svg.contains("Generation 6"));
    // Six agents in each of two episodes.
    assert!(count(&svg, "polygon") >= 12);
    assert_eq!(write("still.png")[..4], *b"\x89PNG");
    let gif = write("moving.gif");
    let mut decoder = gif::DecodeOptions::new().read_info(&gif[..]).unwrap();
    let mut frames = 0;
    while decoder.read_next_frame().unwrap().is_some() {
        frames += 1;
    }
    assert_eq!(frames, 21);
}

#[test]
fn long_episodes_of_large_teams_stay_small() {
    let leaders: Vec<String> = (0..40).map(|i| format!("[{}.0, 5.0]", 2 + i * 4)).collect();
    let followers: Vec<String> =
        (0..260).map(|i| format!("[{:.1}, {}.0]", 2.0 + (i % 65) as f64 * 2.4, 8 + i / 65)).collect();
    let config = format!(
        "[world]\nmap = [170.0, 60.0]\nleaders = [{}]\nfollowers = [{}]\npois = [[20.0, 30.0], [90.0, 30.0]]\n\
         coupling = 3\nsteps = 1500\n[learning]\npopulation = 2\ngenerations = 1\ntrials = 1\n",
        leaders.join(", "),
        followers.join(", ")
    );
    let run = Run::new(&config, &[]);
    succeed(&["replay", &run.text(), "--compare", "0", "--backend", "cpu"]);
    let size = fs::metadata(run.file("replay.html")).unwrap().len();
    assert!(size < 2_000_000, "{size} bytes");
    let page = data(&run.file("replay.html"));
    assert_eq!(page["exact"], false);
    let shown = page["episodes"][0]["shown"].as_array().unwrap();
    assert_eq!((shown[0].as_u64(), shown.last().unwrap().as_u64()), (Some(0), Some(1500)));
}

#[test]
fn long_runs_plot_into_small_files() {
    let run = Run::new(CONFIG, &[]);
    let config = fs::read_to_string(run.file("config.toml")).unwrap();
    let config = config.replace("generations = 6", "generations = 10000").replace("trials = 3", "trials = 20");
    fs::write(run.file("config.toml"), config).unwrap();
    let mut metrics = "trial,generation,best_g,mean_g,champion_g,seconds\n".to_string();
    for generation in 0..=10_000 {
        for trial in 0..20 {
            let g = ((generation * 7 + trial * 3) % 11) as f64 / 10.0;
            metrics += &format!("{trial},{generation},{g},{},{g},1.000\n", g / 2.0);
        }
    }
    fs::write(run.file("metrics.csv"), metrics).unwrap();
    succeed(&["plot", &run.text()]);
    let svg = fs::read_to_string(run.file("curves.svg")).unwrap();
    assert!(svg.len() < 100_000, "{} bytes", svg.len());
    assert!(svg.contains("each point the mean of"));
}

#[test]
fn what_is_trained_once_for_two_arms_is_the_same_for_both() {
    // Enough for teams of leaders to observe a POI: before, all fitnesses come to the same.
    let few = [("learning.generations", 12), ("learning.trials", 2)];
    let few = few.map(|(key, value)| Override::new(key, value, key));
    let arms = paper::arms(&few).unwrap();
    let (configs, places) = paper::trained(&arms);
    assert_eq!((configs.len(), places.len()), (15, 18));
    let course = |config: &Config| {
        let mut trainer = Trainer::new(vec![config.clone()]);
        while !trainer.is_done() {
            trainer.advance(&mut Cpu::default()).unwrap();
        }
        trainer.policies(0)
    };
    let mut told_apart = 0;
    for (arm, &place) in arms.iter().zip(&places).filter(|(arm, place)| arm.config != configs[**place]) {
        let policies = course(&arm.config);
        assert!(policies == course(&configs[place]), "{}", arm.name());
        let mut other = arm.config.clone();
        other.learning.fitness = Fitness::G;
        told_apart += usize::from(policies != course(&other));
    }
    assert!(told_apart > 0, "no policy shows by which fitness it was selected");
}

#[test]
fn the_papers_figures_come_with_its_claims() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("paper");
    let said = succeed(&[
        "paper",
        "--out",
        out.to_str().unwrap(),
        "--trials",
        "2",
        "--generations",
        "3",
        "--backend",
        "cpu",
        "--quiet",
    ]);
    for figure in 4..=6 {
        let svg = fs::read_to_string(out.join(format!("figure{figure}.svg"))).unwrap();
        assert!(svg.contains("All leaders") && svg.contains("Leaders and followers"));
        assert!(svg.contains("straight ahead") && svg.contains("best of as many random teams"));
        assert!(fs::metadata(out.join(format!("figure{figure}.png"))).unwrap().len() > 10_000);
    }
    let summary: Value = serde_json::from_str(&fs::read_to_string(out.join("summary.json")).unwrap()).unwrap();
    let arms = summary["arms"].as_array().unwrap();
    assert_eq!(arms.len(), 18 + 12);
    for arm in arms {
        for curve in ["generation", "mean", "error", "deviation"] {
            assert_eq!(arm[curve].as_array().unwrap().len(), 4, "{curve}");
        }
    }
    // Three generations cannot say what happens after 100, and the table says that.
    assert!(said.contains(" open (too few generations or trials)"), "{said}");
    let claims = fs::read_to_string(out.join("claims.md")).unwrap();
    assert_eq!(claims.lines().filter(|line| line.starts_with("| ")).count(), (2 + 6) + (2 + 6) + (2 + 28));
    // What needs no learning comes first, wherever something is shown.
    assert!(claims.find("straight ahead").unwrap() < claims.find("The paper says").unwrap());
    assert!(said.find("straight ahead").unwrap() < said.find("The paper says").unwrap());
    let straight = arms.iter().filter(|arm| arm["source"] == "straight ahead");
    let solved = straight
        .filter(|arm| arm["mean"].as_array().unwrap().iter().all(|mean| *mean == arm["pois"].as_f64().unwrap()));
    assert_eq!(solved.count(), 4);
}
