//! The binary on what a careless or hostile user types and leaves in files: one clear line, nothing lost, no waiting.
#![cfg(feature = "cli")]
#![cfg(unix)]

mod support;

use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::process::Command;

use support::{Place, TINY};

const SWEEP: &str = "[grid]\n\"world.coupling\" = [1, 2]\n\"learning.fitness\" = [\"G\", \"Df\"]\n";

/// A folder to type in, with `small.toml` and `grid.toml`.
fn place() -> Place {
    Place::new(&[("small.toml", TINY), ("grid.toml", &format!("{TINY}{SWEEP}"))])
}

/// With a run in `run`.
fn with_run() -> Place {
    let place = place();
    place.good("train small.toml --out run --quiet");
    place
}

#[test]
fn a_bare_name_is_a_file_in_the_present_folder() {
    let place = with_run();
    place.good("train small.toml --out other --seed 1 --quiet");
    place.good("plot run --out curves.png");
    place.good("plot run other");
    for name in ["replay.html", "replay.svg", "replay.png", "replay.gif"] {
        assert_eq!(
            place.good(&["replay", "run", "--out", name]).0.lines().last().unwrap().split(' ').next(),
            Some(name)
        );
    }
    place.good("sweep grid.toml --out sweep --slurm=job.sh");
    place.good("rollout small.toml --policies run/policies.safetensors --scores s.csv --trace t.csv");
    for name in ["curves.png", "comparison.svg", "replay.html", "replay.gif", "job.sh", "s.csv", "t.csv"] {
        assert!(fs::metadata(place.path(name)).unwrap().len() > 100, "{name}");
    }
}

#[test]
fn no_output_is_written_over_what_is_needed() {
    let place = with_run();
    std::os::unix::fs::symlink("run/metrics.csv", place.path("link.csv")).unwrap();
    let before: Vec<_> = ["run/policies.safetensors", "run/metrics.csv", "run/config.toml", "small.toml", "grid.toml"]
        .map(|name| (name, fs::read(place.path(name)).unwrap()))
        .into();
    let rollout = ["rollout", "small.toml", "--policies", "run/policies.safetensors"];
    for (flags, why) in [
        (&["--scores", "run/policies.safetensors"][..], "is read from"),
        (&["--trace", "run/../run/policies.safetensors"], "is read from"),
        (&["--scores", "./small.toml"], "is read from"),
        (&["--scores", "run/metrics.csv"], "belongs to what is in"),
        (&["--trace", "link.csv"], "belongs to what is in"),
        (&["--trace", "run/run.json"], "belongs to what is in"),
        (&["--trace", "run/.lock"], "belongs to what is in"),
        (&["--trace", "run/checkpoints/x"], "belongs to what is in"),
        (&["--scores", "x.csv", "--trace", "./x.csv"], "is written by --scores"),
    ] {
        let told = place.refused(2, &[&rollout[..], flags].concat());
        assert!(told.contains(why) && told.contains(flags[flags.len() - 1]) && told.lines().count() == 1, "{told}");
    }
    assert!(place.refused(2, "sweep grid.toml --out o --slurm=grid.toml").contains("is read from"));
    for (name, content) in before {
        assert_eq!(fs::read(place.path(name)).unwrap(), content, "{name}");
    }
    // Pictures and tables of one's own beside a run are no harm.
    place.good(&[&rollout[..], &["--scores", "run/scores.csv", "--trace", "/dev/null"]].concat());
    assert!(place.read("run/scores.csv").starts_with("team,leader,g"));
    assert!(!fs::metadata("/dev/null").unwrap().is_file());
}

#[test]
fn outputs_are_whole_or_not_there_and_devices_stay_devices() {
    let place = with_run();
    let rollout = ["rollout", "small.toml", "--policies", "run/policies.safetensors"];
    if fs::metadata("/dev/full").is_ok() {
        let told = place.refused(1, &[&rollout[..], &["--scores", "/dev/full"]].concat());
        assert!(
            told.contains("/dev/full: cannot be written") && told.contains("free some space, then run it again"),
            "{told}"
        );
        assert!(!told.contains("--resume"), "rollout has none: {told}");
        assert!(!fs::metadata("/dev/full").unwrap().is_file());
    }
    let (scores, _) = place.good(&[&rollout[..], &["--scores", "/dev/stdout"]].concat());
    assert!(scores.starts_with("team,leader,g,d,df,dpp,dt\n0,0,"), "{scores}");
    // A file that is cut off leaves the one before.
    fs::write(place.path("trace.csv"), "before").unwrap();
    let names = place.names();
    let output = place
        .shell("ulimit -f 1; exec flotilla rollout small.toml --policies run/policies.safetensors --trace trace.csv");
    let told = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{:?} {told}", output.status);
    assert!(told.contains("trace.csv: cannot be written") && told.contains("ulimit -f"), "{told}");
    assert_eq!(place.read("trace.csv"), "before");
    assert_eq!(place.names(), names);
    // A link is followed, so that it stays one.
    std::os::unix::fs::symlink("trace.csv", place.path("link")).unwrap();
    place.good(&[&rollout[..], &["--trace", "link"]].concat());
    assert!(place.read("trace.csv").starts_with("team,step"));
    assert!(fs::symlink_metadata(place.path("link")).unwrap().is_symlink());
}

#[test]
fn a_limit_on_files_is_a_full_disk_and_the_run_goes_on_after_it() {
    let place = place();
    let output = place.shell("ulimit -f 1; exec flotilla train small.toml --out run --quiet");
    let told = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{:?} {told}", output.status);
    assert!(told.contains("cannot be written") && told.contains("ulimit -f") && told.contains("--resume"), "{told}");
    assert_eq!(told.lines().count(), 1, "{told}");
    place.good("train small.toml --out run --resume --quiet");
    place.good("train small.toml --out whole --quiet");
    assert_eq!(
        fs::read(place.path("run/policies.safetensors")).unwrap(),
        fs::read(place.path("whole/policies.safetensors")).unwrap()
    );
}

#[test]
fn what_is_no_file_is_not_waited_for() {
    let place = with_run();
    let pipe = place.path("pipe");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    for command in [
        &["check", "pipe"][..],
        &["train", "pipe"],
        &["sweep", "pipe"],
        &["verify", "pipe"],
        &["rollout", "small.toml", "--policies", "pipe"],
        &["check", "/dev/zero"],
        &["rollout", "small.toml", "--policies", "/dev/zero"],
    ] {
        let told = place.refused(1, command);
        assert!(told.contains("it is a pipe or a device, not a file"), "{told}");
    }
    for command in ["train small.toml", "sweep grid.toml", "paper --trials 1 --generations 1"] {
        let told = place.refused(1, &format!("{command} --backend cpu --out pipe"));
        assert!(told.ends_with("a file is where a folder is needed; choose another name\n"), "{told}");
    }
    for name in ["config.toml", "metrics.csv", ".lock"] {
        let place = with_run();
        fs::remove_file(place.path("run").join(name)).unwrap();
        fs::rename(place.path("small.toml"), place.path("s.toml")).unwrap();
        assert!(Command::new("mkfifo").arg(place.path("run").join(name)).status().unwrap().success());
        // A damaged config is written anew; what else cannot be read is told.
        let output = place.run("train s.toml --out run --resume --quiet");
        assert!(matches!(output.status.code(), Some(0 | 1)), "{:?}", output.status);
        let output = place.run("plot run");
        assert!(matches!(output.status.code(), Some(0 | 1)), "{:?}", output.status);
    }
    // What the shell hands over is there to be read.
    let output = place.shell("flotilla check /dev/stdin < small.toml && flotilla check <(cat small.toml)");
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let output = place.shell("cat small.toml | flotilla check /dev/stdin");
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
}

/// Whoever is to read a pipe may come later: nothing is lost, and whoever waits is told what for.
#[test]
fn a_pipe_that_nobody_reads_from_is_waited_for_and_that_is_told() {
    let place = with_run();
    assert!(Command::new("mkfifo").arg(place.path("pipe")).status().unwrap().success());
    let rollout = "flotilla rollout small.toml --policies run/policies.safetensors --quiet --scores";
    let patient = "for _ in $(seq 600); do grep -q waiting told && break; sleep 0.1; done; cat pipe";
    for (reader, told) in [("cat pipe", ""), (patient, "waiting for somebody to read from pipe\n")] {
        place.write("told", "");
        let output =
            place.shell(&format!("({reader}) > read.csv & {rollout} pipe 2> told && wait && {rollout} scores.csv"));
        assert_eq!(place.read("told"), told);
        assert!(output.status.success() && place.read("read.csv") == place.read("scores.csv"));
    }
}

#[test]
fn a_done_run_that_cannot_be_read_for_a_moment_is_not_trained_again() {
    let place = with_run();
    let seconds = |place: &Place| fs::read_to_string(place.path("run/metrics.csv")).unwrap();
    let before = seconds(&place);
    for name in ["run.json", "policies.safetensors", "metrics.csv"] {
        let (path, away) = (place.path("run").join(name), place.path("away"));
        fs::rename(&path, &away).unwrap();
        assert!(Command::new("mkfifo").arg(&path).status().unwrap().success());
        let told = place.refused(1, "train small.toml --out run --resume --quiet");
        assert!(told.contains(name) && told.contains("cannot be read"), "{told}");
        fs::rename(&away, &path).unwrap();
        place.good("train small.toml --out run --resume --quiet");
        assert!(seconds(&place) == before, "{name}: it was trained again");
    }
}

#[test]
fn a_sweep_and_a_config_are_told_apart() {
    let place = place();
    for command in ["check", "train", "verify"] {
        let told = place.refused(1, &[command, "grid.toml"]);
        assert!(told.contains("grid.toml:13: grid: ") && told.contains("`flotilla sweep`"), "{told}");
        assert_eq!(told.lines().count(), 1, "{told}");
    }
    let told = place.refused(1, "sweep small.toml");
    assert!(told.contains("grid: missing") && told.contains("`flotilla train`") && told.lines().count() == 1, "{told}");
}

#[test]
fn folders_of_many_runs_are_no_runs() {
    let place = place();
    place.good("sweep grid.toml --out sweep --quiet");
    let picture = fs::read(place.path("sweep/curves.svg")).unwrap();
    for flags in [&[][..], &["--force"], &["--resume"]] {
        let told = place.refused(1, &[&["train", "small.toml", "--out", "sweep"], flags].concat());
        assert!(told.contains("sweep holds a sweep, not a run"), "{told}");
    }
    assert_eq!(fs::read(place.path("sweep/curves.svg")).unwrap(), picture);
    assert!(place.refused(1, "plot sweep").contains("name one of the runs in it, as sweep/points/0000"));
    assert!(place.refused(1, "replay sweep").contains("name one of its points:\n  sweep/points/0000  "));
    place.good("replay sweep/points/0000");
}

#[test]
fn what_is_gone_of_a_done_run_is_written_again() {
    let place = with_run();
    let config = fs::read(place.path("run/config.toml")).unwrap();
    fs::write(place.path("run/config.toml"), "x = 1").unwrap();
    fs::remove_file(place.path("run/curves.svg")).unwrap();
    place.good("train small.toml --out run --resume --quiet");
    assert_eq!(fs::read(place.path("run/config.toml")).unwrap(), config);
    assert!(place.path("run/curves.svg").exists());
    place.good("replay run");
}

#[test]
fn outputs_are_looked_at_before_anything_is_done() {
    let place = with_run();
    fs::copy(place.path("small.toml"), place.path("small.svg")).unwrap();
    assert!(place.refused(2, "check small.svg --out small.svg").contains("is read from"));
    assert_eq!(fs::read(place.path("small.svg")).unwrap(), fs::read(place.path("small.toml")).unwrap());
    let policies = "run/policies.safetensors";
    let nowhere = ["rollout", "small.toml", "--policies", policies, "--scores", "s.csv", "--trace", "none/t.csv"];
    let told = place.refused(1, &nowhere);
    assert!(told.contains("none/t.csv") && !told.contains("playing"), "{told}");
    assert!(!place.path("s.csv").exists());
}

#[test]
fn what_cannot_be_seen_is_not_said_to_be_missing() {
    let place = with_run();
    let hide = |name: &str| {
        let path = place.path("run").join(name);
        fs::remove_file(&path).unwrap();
        // Not to be resolved by anybody, the superuser included.
        std::os::unix::fs::symlink(name, path).unwrap();
    };
    hide("metrics.csv");
    let told = place.refused(1, "plot run");
    assert!(told.contains("run/metrics.csv: cannot be read") && !told.contains("has no"), "{told}");
    std::os::unix::fs::symlink("sweep.toml", place.path("run/sweep.toml")).unwrap();
    for flags in [&[][..], &["--collect"]] {
        let told = place.refused(1, &[&["sweep", "grid.toml", "--out", "run"], flags].concat());
        assert!(told.contains("run/sweep.toml: cannot be read") && told.lines().count() == 1, "{told}");
    }
    hide("config.toml");
    for command in ["plot", "replay"] {
        let told = place.refused(1, &[command, "run"]);
        assert!(told.contains("run/config.toml: cannot be read") && !told.contains("has no"), "{told}");
    }
    let told = place.refused(1, "train small.toml --out small.toml");
    assert!(!told.contains("File exists") && told.contains("small.toml"), "{told}");
}

#[test]
fn a_replay_counts_pois() {
    let place = with_run();
    let (told, _) = place.good("replay run --out r.svg");
    assert!(!told.contains("G = ") && told.contains(" of 2 POIs"), "{told}");
    let nine: Vec<_> = (1..=9).map(|at| format!("[{}, 9]", 5 * at)).collect();
    let config =
        TINY.replace("[[10, 9], [20, 9]]", &format!("[{}]", nine.join(", "))).replace("coupling = 2", "coupling = 1");
    fs::write(place.path("nine.toml"), &config).unwrap();
    place.good("train nine.toml --out nine --quiet");
    let (told, _) = place.good("replay nine --out r.svg");
    let count = told.split(": observed ").nth(1).and_then(|told| told.split(' ').next()).unwrap();
    assert!(count.parse::<u32>().is_ok_and(|count| (1..=9).contains(&count)), "{told}");
    fs::write(place.path("mean.toml"), config + "episodes_per_team = 3\nstart_jitter = 2.0\n").unwrap();
    place.good("train mean.toml --out mean --quiet");
    let (told, _) = place.good("replay mean --out r.svg");
    assert!(told.contains(" of 9 POIs (mean of 3 episodes)") && !told.contains("3333"), "{told}");
}

#[test]
fn names_cannot_leave_their_line() {
    let place = with_run();
    let long = "a\ntouch b";
    for words in [
        &["sweep", "grid.toml", "--out", long, "--slurm=job.sh"][..],
        &["sweep", "grid.toml", "--out", "o", "--slurm", "--sbatch=--comment=x\nrm y"],
        &["sweep", "grid.toml", "--out", "o", "--slurm", "--adapter", "x\r"],
        &["sweep", "grid.toml", "--axes", "\u{1b}[31m"],
        &["train", "small.toml", "--out", long],
        &["train", long],
        &["plot", "run", "--out", "x\u{1b}]0;title\u{7}.svg"],
        &["replay", "run\n"],
        &["plot", "run\u{202e}"],
        &["train", "small.toml", "--fitness", "\u{1b}[2J"],
        &["\u{1b}[2J"],
    ] {
        let told = place.refused(2, words);
        assert_eq!(told.lines().count(), 1, "{told}");
        assert!(!told.trim_end().contains(char::is_control), "{told:?}");
    }
    assert_eq!(place.names(), ["grid.toml", "run", "small.toml"]);
    // The folder that one is in may have any name; a script names it.
    let odd = place.path(long);
    fs::create_dir(&odd).unwrap();
    fs::copy(place.path("grid.toml"), odd.join("grid.toml")).unwrap();
    let output = place
        .command()
        .current_dir(&odd)
        .args(["sweep", "grid.toml", "--out", "o", "--slurm=job.sh"])
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(2));
    assert!(!odd.join("job.sh").exists());
    let output =
        place.command().current_dir(&odd).args(["sweep", "grid.toml", "--out", "o", "--quiet"]).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn hard_names_stay_names_in_scripts_pages_pictures_and_tables() {
    let place = place();
    let hard = "it's \"a\" </script><b>|,%#`touch x`$(touch y);&{}";
    // No folder of this name can be made with a slash.
    let hard = hard.replace('/', "");
    place.good(&["train", "small.toml", "--out", &hard, "--quiet"]);
    place.good("train small.toml --out other --seed 2 --quiet");
    place.good(&["replay", &hard, "--out", "page.html"]);
    let page = place.read("page.html");
    let data = page.split("id=\"data\">").nth(1).unwrap().split("</script>").next().unwrap();
    let data: serde_json::Value = serde_json::from_str(data).unwrap();
    assert_eq!(data["run"], hard.as_str());
    assert!(!page.contains("<b>"));
    // A picture labels what differs by nothing else by its folder.
    place.good("train small.toml --out same --quiet");
    place.good(&["plot", &hard, "same", "--out", "both.svg"]);
    let svg = place.read("both.svg");
    assert!(!svg.contains("<b>") && svg.contains("</svg>"));
    // A sweep of that name, as a script that runs.
    let sweep = format!("{hard}.toml");
    fs::copy(place.path("grid.toml"), place.path(&sweep)).unwrap();
    place.good(&[
        "sweep",
        &*sweep,
        "--out",
        &format!("sweep {hard}"),
        "--backend",
        "cpu",
        "--shards",
        "1",
        "--slurm=job.sh",
    ]);
    let output = place.shell("SLURM_ARRAY_TASK_ID=1 bash job.sh");
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(!place.path("x").exists() && !place.path("y").exists());
    place.good(&["sweep", &*sweep, "--out", &format!("sweep {hard}"), "--collect"]);
    let mut table = csv::Reader::from_path(place.path(format!("sweep {hard}")).join("results.csv")).unwrap();
    assert_eq!(table.headers().unwrap().iter().take(2).collect::<Vec<_>>(), ["world.coupling", "learning.fitness"]);
    assert_eq!(table.records().map(Result::unwrap).count(), 4 * 2 * 5);
    let svg = fs::read_to_string(place.path(format!("sweep {hard}")).join("curves.svg")).unwrap();
    assert!(!svg.contains("<b>"));
}

#[test]
fn files_cannot_steer_a_terminal() {
    let place = with_run();
    for (text, code) in [
        ("[world]\n\"\\u001b[31m\\u0007\" = 1\n", 1),
        ("[\"\\u001b[2J\\n\"]\nx = 1\n", 1),
        ("\"a\\nerror: b\" = 3\n", 1),
        ("[learning]\nfitness = \"\\u001b[31mG\\nx\"\n", 1),
        ("[world]\nleaders = \u{1b}[31m\n", 1),
    ] {
        fs::write(place.path("bad.toml"), text).unwrap();
        let told = place.refused(code, &["check", "bad.toml"]);
        assert!(!told.contains('\u{1b}') && !told.contains('\u{7}'), "{told:?}");
        assert!(told.lines().skip(1).all(|line| line.starts_with("bad.toml:")), "{told:?}");
    }
    for grid in [
        "\"a\\n\\u001b[31m\" = [1]",
        "\"learning.fitness\" = [\"x\\n\\u001b[31m\", \"G\"]",
        "\"learning.fitness\" = [\"x\\ny\", \"x\\ny\"]",
        "\"learning.fitness\" = \"x\\ny\"",
    ] {
        fs::write(place.path("bad.toml"), format!("{TINY}[grid]\n{grid}\n")).unwrap();
        let told = place.refused(1, "sweep bad.toml");
        assert!(!told.contains('\u{1b}') && told.lines().count() == 1, "{told:?}");
    }
    // A tensor's name.
    let header = "{\"w\\u001b[31m\\nx\":{\"dtype\":\"F32\",\"shape\":[1],\"data_offsets\":[0,4]}}";
    let bytes = [&(header.len() as u64).to_le_bytes()[..], header.as_bytes(), &[0; 4]].concat();
    fs::write(place.path("w.safetensors"), bytes).unwrap();
    let told = place.refused(1, "rollout small.toml --policies w.safetensors");
    assert!(!told.contains('\u{1b}') && told.lines().count() == 1, "{told:?}");
}

#[test]
fn a_wrong_value_by_flag_is_wrong_usage_wherever_it_is_found() {
    let place = with_run();
    let rollout = ["rollout", "small.toml", "--policies", "run/policies.safetensors"];
    for words in [
        &["train", "small.toml", "--seed", "-1"][..],
        &["train", "small.toml", "--population", "1"],
        &["train", "small.toml", "--checkpoint-seconds", "-1"],
        &["check", "small.toml", "--trials", "0"],
        &["sweep", "grid.toml", "--seed", "-1"],
        &["sweep", "grid.toml", "--fitness", "G"],
        &["sweep", "grid.toml", "--axes", "steps"],
        &["paper", "--trials", "0"],
        &["paper", "--set", "learning.fitness=G"],
        &["paper", "--questions=d", "--set", "learning.fitness=G"],
        &["replay", "run", "--trial", "2"],
        &["replay", "run", "--generation", "5"],
        &["replay", "run", "--compare", "5"],
        &["replay", "run", "--step", "9"],
        &["replay", "run", "--out", "x.txt"],
        &[&rollout[..], &["--trial", "2"]].concat(),
        &["train", "small.toml", "--adapter", "no such adapter"],
        &["train", "small.toml", "--adapter", "99"],
        &["train", "small.toml", "--adapter", ""],
        &["verify", "--adapter", "99"],
        &["verify", "--adapter", ""],
        &["verify", "--worlds", "4294967295"],
        &["sweep", "grid.toml", "--slurm", "--time", ":"],
        &["bench", "--adapter", "nonsense"],
    ] {
        place.refused(2, words);
    }
    // A file that is wrong is a failure, alone or with a flag.
    fs::write(place.path("wrong.toml"), TINY.replace("steps = 8", "steps = 0")).unwrap();
    place.refused(1, "check wrong.toml");
    place.refused(1, "check wrong.toml --seed -1");
    place.refused(1, "check missing.toml --seed -1");
    assert_eq!(place.names(), ["grid.toml", "run", "small.toml", "wrong.toml"]);
}

#[test]
fn nothing_of_a_drivers_noise_is_heard() {
    let place = place();
    for folder in [None, Some(""), Some("relative"), Some("/no/such/folder")] {
        let mut command = place.command();
        command.arg("devices");
        match folder {
            Some(folder) => command.env("XDG_RUNTIME_DIR", folder),
            None => command.env_remove("XDG_RUNTIME_DIR"),
        };
        let output = command.output().unwrap();
        assert_eq!(output.status.code(), Some(0));
        assert_eq!(String::from_utf8_lossy(&output.stderr), "", "XDG_RUNTIME_DIR {folder:?}");
    }
}

#[test]
fn as_many_shards_as_there_may_be_are_listed_in_no_time() {
    let place = place();
    let (list, _) = place.good("sweep grid.toml --list --shards 65536");
    assert_eq!(list.lines().count(), 1 + 4 + 1, "{list}");
}

#[test]
fn names_that_are_no_text_work_but_for_scripts() {
    let place = with_run();
    let name = OsStr::from_bytes(b"caf\xe9");
    place.good(&[OsStr::new("train"), OsStr::new("small.toml"), OsStr::new("--out"), name, OsStr::new("--quiet")]);
    place.good(&[OsStr::new("plot"), name]);
    place.good(&[OsStr::new("replay"), name]);
    assert!(place.path(name).join("replay.html").exists());
    let words = [OsStr::new("sweep"), OsStr::new("grid.toml"), OsStr::new("--out"), name, OsStr::new("--slurm=job.sh")];
    assert!(place.refused(2, &words).contains("UTF-8"));
    assert!(!place.path("job.sh").exists());
}

/// Where no or few more threads can be started, there are fewer, to the same results. Root is bound by no number of
/// processes, so it hands over to somebody else.
#[cfg(target_os = "linux")]
#[test]
fn few_threads_are_enough() {
    let place = Place::new(&[("small.toml", TINY)]);
    let all = std::os::unix::fs::PermissionsExt::from_mode(0o777);
    std::fs::set_permissions(place.root(), all).unwrap();
    if place.shell("prlimit --version && setpriv --version").status.code() != Some(0) {
        eprintln!("skipped: prlimit or setpriv is missing");
        return;
    }
    let root = place.shell("test $(id -u) = 0").status.success();
    let user = if root { "setpriv --reuid=65534 --clear-groups" } else { "" };
    let digests: Vec<String> = [(1, "0 of"), (3, "2 of")]
        .into_iter()
        .map(|(limit, started)| {
            // The limit counts what else a user runs; nobody runs anything else.
            let started = if root { started } else { "of" };
            let run = |command: &str| {
                let output =
                    place.shell(&format!("exec {user} prlimit --nproc={limit} $(command -v flotilla) {command}"));
                let told = String::from_utf8(output.stderr).unwrap();
                assert_eq!(output.status.code(), Some(0), "{limit}, {command}: {told}");
                told
            };
            let told = run(&format!(
                "train small.toml --backend cpu --threads 5 --quiet --out run{limit} --checkpoint-generations 1"
            ));
            assert!(told.contains(&format!("only {started}")) && told.contains("ulimit -u"), "{told}");
            run("check small.toml");
            run("devices");
            run(&format!("paper --backend cpu --trials 1 --generations 1 --quiet --out paper{limit}"));
            let run: serde_json::Value = serde_json::from_str(&place.read(format!("run{limit}/run.json"))).unwrap();
            run["digest"].as_str().unwrap().to_string()
        })
        .collect();
    assert_eq!(digests[0], digests[1]);
}

/// With little address space, a command works or says what it lacks.
#[cfg(target_os = "linux")]
#[test]
fn little_address_space_is_an_error() {
    let place = Place::new(&[("small.toml", TINY)]);
    let mut refused = 0;
    for mib in (20..=120).step_by(10) {
        let line = "flotilla train small.toml --backend cpu --threads 4 --quiet --out run";
        let output = place.shell(&format!("ulimit -v {}; exec {line}{mib}", mib << 10));
        let told = String::from_utf8(output.stderr).unwrap();
        match output.status.code() {
            Some(0) => {}
            Some(1) => {
                assert!(told.contains("error: ") && told.contains("memory") && told.contains("ulimit -v"), "{told}");
                refused += 1;
            }
            // The system could not even load the program.
            Some(127) if told.contains("shared libraries") => {}
            other => panic!("{mib} MiB: {other:?}: {told}"),
        }
    }
    assert!(refused > 0, "no limit was too small");
}
