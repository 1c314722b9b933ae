//! Tests careless and hostile input, in arguments and in files.
//!
//! Commands have to report it clearly, lose no file, and not hang.

#![cfg(unix)]

use crate::support;
use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::process::{Command, Stdio};

use crate::support::{Place, TINY, page_data};

const SWEEP: &str = "[grid]\n\"world.coupling\" = [1, 2]\n\"learning.fitness\" = [\"G\", \"Df\"]\n";

/// Creates a folder with `small.toml` and `grid.toml`.
fn place() -> Place {
    Place::new(&[("small.toml", TINY), ("grid.toml", &format!("{TINY}{SWEEP}"))])
}

/// Creates the same folder with a run in `run`.
fn with_run() -> Place {
    let place = place();
    place.good("train small.toml --out run --quiet");
    place
}

/// Returns the path of a device like `/dev/null` (minor number 3) or `/dev/full` (7). Root gets one in the test's folder
/// where that is possible: a program that replaced outputs would replace the system's own.
fn device(place: &Place, name: &str, minor: &str) -> String {
    let own = place.path(name);
    let made = Command::new("mknod").arg(&own).args(["c", "1", minor]).stderr(Stdio::null()).status();
    let works = made.is_ok_and(|status| status.success()) && fs::File::options().write(true).open(&own).is_ok();
    if works { own.display().to_string() } else { format!("/dev/{name}") }
}

#[test]
fn a_bare_file_name_is_in_the_current_folder() {
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
fn outputs_do_not_replace_inputs_or_files_of_a_run() {
    let place = with_run();
    std::os::unix::fs::symlink("run/metrics.csv", place.path("link.csv")).unwrap();
    let before: Vec<_> = ["run/policies.safetensors", "run/metrics.csv", "run/config.toml", "small.toml", "grid.toml"]
        .map(|name| (name, place.bytes(name)))
        .into();
    let rollout = ["rollout", "small.toml", "--policies", "run/policies.safetensors"];
    for (flags, why) in [
        (&["--scores", "run/policies.safetensors"][..], "is read from"),
        (&["--trace", "run/../run/policies.safetensors"], "is read from"),
        (&["--scores", "./small.toml"], "is read from"),
        (&["--scores", "run/metrics.csv"], "is part of the run, sweep or paper in"),
        (&["--trace", "link.csv"], "is part of the run, sweep or paper in"),
        (&["--trace", "run/run.json"], "is part of the run, sweep or paper in"),
        (&["--trace", "run/.lock"], "is part of the run, sweep or paper in"),
        (&["--trace", "run/.flotilla.sha256"], "is part of the run, sweep or paper in"),
        (&["--trace", "run/checkpoints/x"], "is part of the run, sweep or paper in"),
        (&["--scores", "x.csv", "--trace", "./x.csv"], "is written by --scores"),
    ] {
        let stderr = place.refused(2, &[&rollout[..], flags].concat());
        assert!(
            stderr.contains(why) && stderr.contains(flags[flags.len() - 1]) && stderr.lines().count() == 1,
            "{stderr}"
        );
    }
    place.fails(2, "sweep grid.toml --out o --slurm=grid.toml", &["is read from"]);
    for flag in ["--scores", "--trace"] {
        let stderr = place.refused(2, &[&rollout[..], &[flag, "grid.toml"]].concat());
        assert!(stderr.contains("grid.toml: this file has neither scores nor a trace; move it away"), "{stderr}");
    }
    for (name, content) in before {
        assert_eq!(place.bytes(name), content, "{name}");
    }
    // Other file names in a run's folder are allowed, and so are devices.
    let null = &device(&place, "null", "3")[..];
    place.good(&[&rollout[..], &["--scores", "run/scores.csv", "--trace", null]].concat());
    assert!(place.read("run/scores.csv").starts_with("team,leader,g"));
    place.good(&[&rollout[..], &["--scores", null, "--trace", null]].concat());
    // Only the file paper.toml of a paper's folder belongs to the paper.
    fs::create_dir_all(place.path("paper/arms")).unwrap();
    place.good(&[&rollout[..], &["--scores", "paper/scores.csv", "--trace", "paper.toml"]].concat());
    let stderr = place.refused(2, &[&rollout[..], &["--scores", "paper/paper.toml"]].concat());
    assert!(stderr.contains("is part of the run, sweep or paper in"), "{stderr}");
    assert!(!fs::metadata(null).unwrap().is_file());
    for flags in [&["--scores", "none/x.csv"][..], &["--scores", "x.csv", "--trace", "none/x.csv"]] {
        let stderr = place.refused(1, &[&rollout[..], flags].concat());
        assert!(stderr.contains("none/x.csv") && !stderr.contains("playing"), "{stderr}");
        assert!(stderr.contains("the folder none does not exist; make it first"), "{stderr}");
    }
    // The folder is checked before a backend is opened.
    let stderr = place.refused(1, &["replay", "run", "--out", "none/r.html", "--adapter", "no such adapter"]);
    assert!(stderr.contains("the folder none does not exist; make it first"), "{stderr}");
    // A folder is refused before anything is played and written.
    let stderr = place.refused(1, &[&rollout[..], &["--scores", "x.csv", "--trace", "run"]].concat());
    assert!(stderr.contains("run: cannot be written") && !place.path("x.csv").exists(), "{stderr}");
}

#[test]
fn help_that_cannot_be_printed_is_an_error() {
    let place = place();
    let full = device(&place, "full", "7");
    if fs::metadata(&full).is_err() {
        return support::skip("help_that_cannot_be_printed_is_an_error", "this system has no full device");
    }
    for command in ["--help", "--version", "train --help", "help train", "completions bash", "man", "init"] {
        place.script(1, &format!("flotilla {command} > {full}"), &["standard output cannot be written"]);
    }
}

#[test]
fn outputs_are_complete_or_absent_and_devices_are_not_replaced() {
    let place = with_run();
    let rollout = ["rollout", "small.toml", "--policies", "run/policies.safetensors"];
    let full = &device(&place, "full", "7")[..];
    if fs::metadata(full).is_ok() {
        let stderr = place.refused(1, &[&rollout[..], &["--scores", full]].concat());
        assert!(
            stderr.contains("full: cannot be written") && stderr.contains("free some space, then run it again"),
            "{stderr}"
        );
        assert!(!stderr.contains("--resume"), "rollout has no --resume: {stderr}");
        assert!(!fs::metadata(full).unwrap().is_file());
    }
    let (scores, _) = place.good(&[&rollout[..], &["--scores", "/dev/stdout"]].concat());
    assert!(scores.starts_with("team,leader,g,d,df,dpp,dt\n0,0,"), "{scores}");
    // If writing fails halfway, the previous file remains.
    let before = "team,step,agent,role,x,y,heading_x,heading_y,speed,before";
    place.write("trace.csv", before);
    let names = place.names();
    let script = format!("ulimit -f 1; exec flotilla {} --trace trace.csv", rollout.join(" "));
    place.script(1, &script, &["trace.csv: cannot be written", "ulimit -f"]);
    assert_eq!(place.read("trace.csv"), before);
    assert_eq!(place.names(), names);
    // A link is followed, not replaced.
    std::os::unix::fs::symlink("trace.csv", place.path("link")).unwrap();
    place.good(&[&rollout[..], &["--trace", "link"]].concat());
    assert!(place.read("trace.csv").starts_with("team,step"));
    assert!(fs::symlink_metadata(place.path("link")).unwrap().is_symlink());
}

/// Runs on x86-64, because the flag has another value elsewhere.
#[cfg(all(target_os = "linux", target_arch = "x86_64"))]
#[test]
fn an_interrupted_trace_leaves_no_file() {
    use std::os::unix::fs::OpenOptionsExt;
    const O_TMPFILE: i32 = 0o20_200_000;
    let place = with_run();
    if fs::File::options().write(true).custom_flags(O_TMPFILE).open(place.root()).is_err() {
        let why = "the file system of the temporary directory has no unnamed files";
        return support::skip("an_interrupted_trace_leaves_no_file", why);
    }
    // A file anywhere, and one in the folder of a run.
    for trace in ["trace.csv", "run/mine.csv"] {
        let folder = place.path(trace).parent().unwrap().canonicalize().unwrap();
        let names = || {
            let mut names: Vec<_> = fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().file_name()).collect();
            names.sort();
            names
        };
        let before = names();
        let mut command = support::flotilla();
        command.current_dir(place.root()).args(["rollout", "run", "--backend", "cpu", "--quiet", "--trace", trace]);
        command.args(["--start-jitter", "1", "--episodes", "1000", "--set", "world.steps=1000"]);
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        let written = |file: fs::DirEntry| {
            let large = fs::metadata(file.path()).is_ok_and(|file| file.len() > 1 << 20 && file.is_file());
            large && fs::read_link(file.path()).is_ok_and(|path| path.starts_with(&folder))
        };
        let begun = std::time::Instant::now();
        while !fs::read_dir(format!("/proc/{}/fd", child.id())).unwrap().flatten().any(written) {
            assert_eq!(child.try_wait().unwrap(), None);
            assert!(begun.elapsed().as_secs() < 60, "nothing was written");
            std::thread::sleep(std::time::Duration::from_millis(10));
        }
        child.kill().unwrap();
        child.wait().unwrap();
        assert_eq!(names(), before);
    }
}

#[test]
fn a_limit_on_file_sizes_is_reported_and_the_run_can_be_resumed() {
    let place = place();
    let script = "ulimit -f 1; exec flotilla train small.toml --out run --quiet";
    let stderr = place.script(1, script, &["cannot be written", "ulimit -f", "--resume"]);
    assert_eq!(stderr.lines().count(), 1, "{stderr}");
    place.good("train small.toml --out run --resume --quiet");
    place.good("train small.toml --out unlimited --quiet");
    assert_eq!(place.bytes("run/policies.safetensors"), place.bytes("unlimited/policies.safetensors"));
}

#[test]
fn commands_do_not_wait_for_input_from_pipes_and_devices() {
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
        place.fails(1, command, &["it is a pipe or a device, not a file"]);
    }
    for command in ["train small.toml", "sweep grid.toml", "paper --trials 1 --generations 1"] {
        let stderr = place.refused(1, &format!("{command} --backend cpu --out pipe"));
        assert!(stderr.ends_with("a part of this path is a file, not a folder; choose another path\n"), "{stderr}");
    }
    for name in ["config.toml", "metrics.csv", ".lock"] {
        let place = with_run();
        fs::remove_file(place.path("run").join(name)).unwrap();
        fs::rename(place.path("small.toml"), place.path("s.toml")).unwrap();
        assert!(Command::new("mkfifo").arg(place.path("run").join(name)).status().unwrap().success());
        // Depending on the file, it is replaced, or the command fails. Neither command may hang.
        let output = place.run("train s.toml --out run --resume --quiet");
        assert!(matches!(output.status.code(), Some(0 | 1)), "{:?}", output.status);
        let output = place.run("plot run");
        assert!(matches!(output.status.code(), Some(0 | 1)), "{:?}", output.status);
    }
    // Standard input and pipes that the shell opens are read.
    place.script(0, "flotilla check /dev/stdin < small.toml && flotilla check <(cat small.toml)", &[]);
    place.script(0, "cat small.toml | flotilla check /dev/stdin", &[]);
}

/// A reader may open the pipe later and still gets everything. Until then, a message says what the program waits for.
#[test]
fn an_output_pipe_without_a_reader_is_waited_for_with_a_message() {
    let place = with_run();
    assert!(Command::new("mkfifo").arg(place.path("pipe")).status().unwrap().success());
    let rollout = "flotilla rollout small.toml --policies run/policies.safetensors --quiet --scores";
    let patient = "for _ in $(seq 600); do grep -q waiting stderr && break; sleep 0.1; done; cat pipe";
    for (reader, stderr) in [("cat pipe", ""), (patient, "waiting for a reader of pipe\n")] {
        place.write("stderr", "");
        let output =
            place.shell(&format!("({reader}) > read.csv & {rollout} pipe 2> stderr && wait && {rollout} scores.csv"));
        assert_eq!(place.read("stderr"), stderr);
        assert!(output.status.success() && place.read("read.csv") == place.read("scores.csv"));
    }
}

#[test]
fn a_finished_run_with_an_unreadable_file_is_not_trained_again() {
    let place = with_run();
    // Another training would change the column of seconds.
    let before = place.read("run/metrics.csv");
    for name in ["run.json", "policies.safetensors", "metrics.csv"] {
        let (path, away) = (place.path("run").join(name), place.path("away"));
        fs::rename(&path, &away).unwrap();
        assert!(Command::new("mkfifo").arg(&path).status().unwrap().success());
        place.fails(1, "train small.toml --out run --resume --quiet", &[name, "cannot be read"]);
        fs::rename(&away, &path).unwrap();
        place.good("train small.toml --out run --resume --quiet");
        assert!(place.read("run/metrics.csv") == before, "{name}: the run was trained again");
    }
}

#[test]
fn commands_name_the_right_command_for_sweeps_and_configs() {
    let place = place();
    for command in ["check", "train", "verify"] {
        let stderr = place.fails(1, &[command, "grid.toml"], &["grid.toml:13: grid: ", "`flotilla sweep`"]);
        assert_eq!(stderr.lines().count(), 1, "{stderr}");
    }
    let stderr = place.refused(1, "sweep small.toml");
    assert!(
        stderr.contains("small.toml: grid: missing")
            && stderr.contains("`flotilla train`")
            && stderr.lines().count() == 1,
        "{stderr}"
    );
}

/// Without `--out`, it would continue or overwrite `runs/config`.
#[test]
fn the_config_of_a_run_continues_it_only_with_its_folder() {
    let place = with_run();
    for flag in ["--resume", "--force"] {
        let stderr = place.refused(2, &["train", "run/config.toml", flag]);
        assert!(stderr.contains("is the config of the run in run; name that folder with --out run"), "{stderr}");
    }
    place.good("train run/config.toml --resume --out run --quiet");
    let stderr = place.refused(1, "train small.toml --out run --resume --population 9");
    assert!(
        stderr.contains("resume it as it was started with `flotilla train run/config.toml --out run --resume`"),
        "{stderr}"
    );
}

#[test]
fn a_rollout_says_whose_policies_it_plays() {
    let place = with_run();
    let note = "note: this plays trial 0 of";
    for (flags, noted, trial) in
        [("", true, "0"), ("--trial 1", false, "1"), ("--policies run/policies.safetensors", false, "null")]
    {
        let (stdout, stderr) = place.good(&format!("rollout run --json {flags}"));
        assert_eq!(stderr.contains(note), noted, "{flags}: {stderr}");
        assert!(stdout.contains(&format!("\"trial\":{trial},")), "{stdout}");
    }
}

#[test]
fn a_sweep_folder_is_not_a_run() {
    let place = place();
    place.good("sweep grid.toml --out sweep --quiet");
    let picture = place.bytes("sweep/curves.svg");
    for flags in [&[][..], &["--force"], &["--resume"]] {
        let stderr = place.refused(1, &[&["train", "small.toml", "--out", "sweep"], flags].concat());
        assert!(stderr.contains("sweep holds a sweep, not a run"), "{stderr}");
    }
    assert_eq!(place.bytes("sweep/curves.svg"), picture);
    place.fails(1, "plot sweep", &["name one of the runs in it, as sweep/points/0000"]);
    let stderr = place.refused(1, "replay sweep");
    let first = "sweep holds a sweep; name one of its points:\n  sweep/points/0000  world.coupling = 1, ";
    assert!(stderr.contains(first) && stderr.contains("\n  sweep/points/0003  world.coupling = 2, "), "{stderr}");
    place.good("replay sweep/points/0000");
}

#[test]
fn missing_and_damaged_files_of_a_finished_run_are_restored() {
    let place = with_run();
    let config = place.bytes("run/config.toml");
    place.write("run/config.toml", "x = 1");
    fs::remove_file(place.path("run/curves.svg")).unwrap();
    place.good("train small.toml --out run --resume --quiet");
    assert_eq!(place.bytes("run/config.toml"), config);
    assert!(place.path("run/curves.svg").exists());
    place.good("replay run");
}

#[test]
fn outputs_are_validated_before_any_work_is_done() {
    let place = with_run();
    fs::copy(place.path("small.toml"), place.path("small.svg")).unwrap();
    place.fails(2, "check small.svg --out small.svg", &["is read from"]);
    assert_eq!(place.bytes("small.svg"), place.bytes("small.toml"));
}

#[test]
fn unreadable_files_are_not_reported_as_missing() {
    let place = with_run();
    let make_unreadable = |name: &str| {
        let path = place.path("run").join(name);
        fs::remove_file(&path).unwrap();
        // Nobody can resolve a link to itself. Permissions would not stop root.
        std::os::unix::fs::symlink(name, path).unwrap();
    };
    make_unreadable("metrics.csv");
    let stderr = place.refused(1, "plot run");
    assert!(stderr.contains("run/metrics.csv: cannot be read") && !stderr.contains("has no"), "{stderr}");
    std::os::unix::fs::symlink("sweep.toml", place.path("run/sweep.toml")).unwrap();
    for flags in [&[][..], &["--collect"]] {
        let stderr = place.refused(1, &[&["sweep", "grid.toml", "--out", "run"], flags].concat());
        assert!(stderr.contains("run/sweep.toml: cannot be read") && stderr.lines().count() == 1, "{stderr}");
    }
    make_unreadable("config.toml");
    for command in ["plot", "replay"] {
        let stderr = place.refused(1, &[command, "run"]);
        assert!(stderr.contains("run/config.toml: cannot be read") && !stderr.contains("has no"), "{stderr}");
    }
    let stderr = place.refused(1, "train small.toml --out small.toml");
    assert!(!stderr.contains("File exists") && stderr.contains("small.toml"), "{stderr}");
}

#[test]
fn replay_prints_the_number_of_observed_pois() {
    let place = with_run();
    let (stdout, _) = place.good("replay run --out r.svg");
    assert!(!stdout.contains("G = ") && stdout.contains(" of 2 POIs"), "{stdout}");
    let nine: Vec<_> = (1..=9).map(|at| format!("[{}, 9]", 5 * at)).collect();
    let config =
        TINY.replace("[[10, 9], [20, 9]]", &format!("[{}]", nine.join(", "))).replace("coupling = 2", "coupling = 1");
    place.write("nine.toml", &config);
    place.good("train nine.toml --out nine --quiet");
    let (stdout, _) = place.good("replay nine --out r.svg");
    let count = stdout.split(": observed ").nth(1).and_then(|rest| rest.split(' ').next()).unwrap();
    assert!(count.parse::<u32>().is_ok_and(|count| (1..=9).contains(&count)), "{stdout}");
    place.write("mean.toml", config + "episodes_per_team = 3\nstart_jitter = 2.0\n");
    place.good("train mean.toml --out mean --quiet");
    let (stdout, _) = place.good("replay mean --out r.svg");
    assert!(
        stdout.contains(" of 9 POIs (mean of 3 episodes, of which the first is shown)") && !stdout.contains("3333"),
        "{stdout}"
    );
}

#[test]
fn control_characters_in_arguments_are_refused_and_not_printed() {
    let place = with_run();
    let two_lines = "a\ntouch b";
    for words in [
        &["sweep", "grid.toml", "--out", two_lines, "--slurm=job.sh"][..],
        &["sweep", "grid.toml", "--out", "o", "--slurm", "--sbatch=--comment=x\nrm y"],
        &["sweep", "grid.toml", "--out", "o", "--slurm", "--adapter", "x\r"],
        &["sweep", "grid.toml", "--axes", "\u{1b}[31m"],
        &["train", "small.toml", "--out", two_lines],
        &["train", two_lines],
        &["plot", "run", "--out", "x\u{1b}]0;title\u{7}.svg"],
        &["replay", "run\n"],
        &["plot", "run\u{202e}"],
        &["train", "small.toml", "--fitness", "\u{1b}[2J"],
        &["\u{1b}[2J"],
    ] {
        let stderr = place.refused(2, words);
        assert_eq!(stderr.lines().count(), 1, "{stderr}");
        assert!(!stderr.trim_end().contains(char::is_control), "{stderr:?}");
    }
    assert_eq!(place.names(), ["grid.toml", "run", "small.toml"]);
    // The current folder may have any name, unless a script has to contain it.
    let odd = place.path(two_lines);
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
fn special_characters_in_names_are_escaped_in_every_output() {
    let place = place();
    let special = "it's \"a\" </script><b>|,%#`touch x`$(touch y);&{}";
    // The slash makes it a folder in a folder, and the path closes a script in a page.
    place.good(&["train", "small.toml", "--out", special, "--quiet"]);
    place.good("train small.toml --out other --seed 2 --quiet");
    place.good(&["replay", special, "--out", "page.html"]);
    let page = place.read("page.html");
    assert_eq!(page_data(&place.path("page.html"))["run"], special.rsplit('/').next().unwrap());
    assert!(!page.contains("<b>"));
    // Runs with equal configs are labelled by their folder.
    place.good("train small.toml --out same --quiet");
    place.good(&["plot", special, "same", "--out", "both.svg"]);
    let svg = place.read("both.svg");
    assert!(!svg.contains("<b>") && svg.contains("</svg>"));
    // The script of a sweep with such a name works, and does not run the commands in the name.
    let sweep = format!("{special}.toml");
    fs::copy(place.path("grid.toml"), place.path(&sweep)).unwrap();
    place.good(&[
        "sweep",
        &*sweep,
        "--out",
        &format!("sweep {special}"),
        "--backend",
        "cpu",
        "--shards",
        "1",
        "--slurm=job.sh",
    ]);
    place.script(0, "SLURM_ARRAY_TASK_ID=1 bash job.sh", &[]);
    assert!(!place.path("x").exists() && !place.path("y").exists());
    place.good(&["sweep", &*sweep, "--out", &format!("sweep {special}"), "--collect"]);
    let mut table = csv::Reader::from_path(place.path(format!("sweep {special}")).join("results.csv")).unwrap();
    assert_eq!(table.headers().unwrap().iter().take(2).collect::<Vec<_>>(), ["world.coupling", "learning.fitness"]);
    assert_eq!(table.records().map(Result::unwrap).count(), 4 * 2 * 5);
    let svg = fs::read_to_string(place.path(format!("sweep {special}")).join("curves.svg")).unwrap();
    assert!(!svg.contains("<b>"));
}

#[test]
fn files_cannot_print_terminal_control_characters() {
    let place = with_run();
    for (text, code) in [
        ("[world]\n\"\\u001b[31m\\u0007\" = 1\n", 1),
        ("[\"\\u001b[2J\\n\"]\nx = 1\n", 1),
        ("\"a\\nerror: b\" = 3\n", 1),
        ("[learning]\nfitness = \"\\u001b[31mG\\nx\"\n", 1),
        ("[world]\nleaders = \u{1b}[31m\n", 1),
    ] {
        place.write("bad.toml", text);
        let stderr = place.refused(code, &["check", "bad.toml"]);
        assert!(!stderr.contains('\u{1b}') && !stderr.contains('\u{7}'), "{stderr:?}");
        assert!(stderr.lines().skip(1).all(|line| line.starts_with("bad.toml:")), "{stderr:?}");
    }
    for grid in [
        "\"a\\n\\u001b[31m\" = [1]",
        "\"learning.fitness\" = [\"x\\n\\u001b[31m\", \"G\"]",
        "\"learning.fitness\" = [\"x\\ny\", \"x\\ny\"]",
        "\"learning.fitness\" = \"x\\ny\"",
    ] {
        place.write("bad.toml", format!("{TINY}[grid]\n{grid}\n"));
        let stderr = place.refused(1, "sweep bad.toml");
        assert!(!stderr.contains('\u{1b}') && stderr.lines().count() == 1, "{stderr:?}");
    }
    // A tensor's name has an escape sequence.
    let header = "{\"w\\u001b[31m\\nx\":{\"dtype\":\"F32\",\"shape\":[1],\"data_offsets\":[0,4]}}";
    let bytes = [&(header.len() as u64).to_le_bytes()[..], header.as_bytes(), &[0; 4]].concat();
    place.write("w.safetensors", bytes);
    let stderr = place.refused(1, "rollout small.toml --policies w.safetensors");
    assert!(!stderr.contains('\u{1b}') && stderr.lines().count() == 1, "{stderr:?}");
}

#[test]
fn a_wrong_value_of_a_flag_exits_with_code_2() {
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
        // A stage could change the fitness.
        &["paper", "--set", "stages=[{ from = 1, set = { 'learning.fitness' = 'G' } }]"],
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
    // A wrong file exits with code 1, also together with a wrong flag.
    place.write("wrong.toml", TINY.replace("steps = 8", "steps = 0"));
    place.refused(1, "check wrong.toml");
    place.refused(1, "check wrong.toml --seed -1");
    place.refused(1, "check missing.toml --seed -1");
    assert_eq!(place.names(), ["grid.toml", "run", "small.toml", "wrong.toml"]);
}

#[test]
fn a_wrong_start_leaves_no_folder() {
    let place = place();
    place.refused(1, "train small.toml --init missing.safetensors");
    assert_eq!(place.names(), ["grid.toml", "small.toml"]);
}

#[test]
fn generations_with_pois_in_different_places_are_not_compared() {
    let place = place();
    place.good("train small.toml --set learning.poi_jitter=0.5 --generations 2 --out moved --quiet");
    place.fails(2, "replay moved --compare 0", &["POIs are elsewhere in every generation (learning.poi_jitter)"]);
    place.good("replay moved");
}

#[test]
fn messages_of_drivers_are_not_printed() {
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
fn the_largest_number_of_shards_is_listed_before_the_timeout() {
    let place = place();
    let (list, _) = place.good("sweep grid.toml --list --shards 65536");
    assert_eq!(list.lines().count(), 1 + 4 + 1, "{list}");
}

#[test]
fn names_that_are_not_utf8_work_except_in_scripts() {
    let place = with_run();
    let name = OsStr::from_bytes(b"caf\xe9");
    place.good(&[OsStr::new("train"), OsStr::new("small.toml"), OsStr::new("--out"), name, OsStr::new("--quiet")]);
    place.good(&[OsStr::new("plot"), name]);
    place.good(&[OsStr::new("replay"), name]);
    assert!(place.path(name).join("replay.html").exists());
    let words = [OsStr::new("sweep"), OsStr::new("grid.toml"), OsStr::new("--out"), name, OsStr::new("--slurm=job.sh")];
    place.fails(2, &words, &["UTF-8"]);
    assert!(!place.path("job.sh").exists());
}

/// If the system refuses more threads, a training uses fewer and has the same results. A limit of processes does not
/// apply to root, so root runs the commands as another user.
#[cfg(target_os = "linux")]
#[test]
fn a_training_works_with_fewer_threads_than_requested() {
    let place = Place::new(&[("small.toml", TINY)]);
    let skip = |why| support::skip_without("a_training_works_with_fewer_threads_than_requested", why);
    if place.shell("prlimit --version && setpriv --version").status.code() != Some(0) {
        return skip("prlimit or setpriv is missing");
    }
    // Another user may be unable to enter the checkout, or to read new files.
    assert!(place.shell("cp $(command -v flotilla) . && chmod -R a+rwX .").status.success());
    let root = place.shell("test $(id -u) = 0").status.success();
    let user = if root { "setpriv --reuid=65534 --clear-groups" } else { "" };
    if !place.shell(&format!("{user} ./flotilla --version")).status.success() {
        return skip("another user cannot enter the temporary directory");
    }
    let digests: Vec<String> = [(1, "1 of"), (3, "3 of")]
        .into_iter()
        .map(|(limit, started)| {
            // The limit counts all processes of a user. Only `nobody` (65534) is assumed to have no others.
            let started = if root { started } else { "of" };
            let run = |command: &str| {
                place.script(0, &format!("exec {user} prlimit --nproc={limit} ./flotilla {command}"), &[])
            };
            let stderr = run(&format!(
                "train small.toml --backend cpu --threads 5 --quiet --out run{limit} --checkpoint-generations 1"
            ));
            assert!(stderr.contains(&format!("only {started}")) && stderr.contains("ulimit -u"), "{stderr}");
            run("check small.toml");
            run("devices");
            run(&format!("paper --backend cpu --trials 1 --generations 1 --quiet --out paper{limit}"));
            let run: serde_json::Value = serde_json::from_str(&place.read(format!("run{limit}/run.json"))).unwrap();
            run["digest"].as_str().unwrap().to_string()
        })
        .collect();
    assert_eq!(digests[0], digests[1]);
}

/// With little address space, a command succeeds or reports the lack of memory.
#[cfg(target_os = "linux")]
#[test]
fn too_little_address_space_is_reported() {
    let swarm = include_str!("../../configs/swarm.toml").replace("population = 20", "population = 2");
    let place = Place::new(&[("small.toml", TINY), ("swarm.toml", &swarm)]);
    place.good("train swarm.toml --set learning.generations=0 --set world.steps=20 --quiet --out large");
    for line in [
        "train small.toml --backend cpu --threads 4 --quiet --out run",
        "replay large --backend cpu --threads 1 --out replay.svg",
        "rollout large --backend cpu --threads 1 --trace trace.csv",
    ] {
        let mut refused = 0;
        for mib in (30..=120).step_by(10) {
            let line = line.replace("--out run", &format!("--out run{mib}"));
            let output = place.shell(&format!("ulimit -v {}; exec flotilla {line}", mib << 10));
            let stderr = String::from_utf8(output.stderr).unwrap();
            match output.status.code() {
                Some(0) => {}
                Some(1) => {
                    assert!(
                        stderr.contains("error: ") && stderr.contains("memory") && stderr.contains("ulimit -v"),
                        "{stderr}"
                    );
                    refused += 1;
                }
                // The system could not even load the program.
                Some(127) if stderr.contains("shared libraries") => {}
                // The program was loaded, but what is left does not even hold the stack for signals or its command line.
                None if refused == 0 && stderr.contains("failed to allocate an alternative stack") => {}
                None if refused == 0 && stderr.starts_with("memory allocation of") => {}
                other => panic!("{mib} MiB, {line}: {other:?}: {stderr}"),
            }
        }
        assert!(refused > 0, "no limit was too small for {line}");
    }
}
