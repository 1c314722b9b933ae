//! Tests commands and options that are not about training or scores.
//!
//! These are versions, starter configs, standard input, job arrays, shell completions, manual pages and JSON output.

use crate::support;
use std::fs;
use std::path::Path;
use std::process::Command;

use crate::support::Place;
use assert_cmd::cargo::cargo_bin_cmd;
use flotilla::config::{self, Config};

#[allow(dead_code, reason = "its main is cargo's")]
#[path = "../../build.rs"]
mod build;

fn output_of(flag: &str) -> String {
    let output = cargo_bin_cmd!("flotilla").arg(flag).output().unwrap();
    assert!(output.status.success());
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn short_version_is_one_line_and_long_version_adds_commit_and_target() {
    let name = concat!("flotilla ", env!("CARGO_PKG_VERSION"));
    assert_eq!(output_of("-V"), format!("{name}\n"));
    let long = output_of("--version");
    let lines: Vec<&str> = long.lines().collect();
    assert_eq!(lines[0], name, "{long}");
    assert!(lines[1].starts_with("commit  "), "{long}");
    let target = lines[2].strip_prefix("target  ").expect(&long);
    assert!(target.starts_with(std::env::consts::ARCH) && target.contains('-'), "{long}");
    // Debug builds record no commit, so that cargo does not rebuild them at every commit.
    let commit = build::state(Path::new(crate::ROOT)).0.filter(|_| !cfg!(debug_assertions));
    assert_eq!(flotilla::COMMIT, commit.as_deref());
    assert!(lines[1].ends_with(&commit.unwrap_or("not recorded".into())), "{long}");
}

#[test]
fn build_script_reads_the_same_commit_as_git() {
    let folder = tempfile::tempdir().unwrap();
    let git = |place: &Path, line: &str| {
        let output = Command::new("git")
            .args(["-c", "user.name=x", "-c", "user.email=x@example.org", "-c", "init.defaultBranch=trunk"])
            .args(line.split(' '))
            .current_dir(place)
            .output();
        output.ok().map(|output| {
            assert!(output.status.success(), "{line}: {}", String::from_utf8_lossy(&output.stderr));
            String::from_utf8(output.stdout).unwrap().trim().to_string()
        })
    };
    let tree = folder.path().join("tree");
    fs::create_dir(&tree).unwrap();
    if git(&tree, "init -q").is_none() {
        return support::skip_without("build_script_reads_the_same_commit_as_git", "there is no git");
    }
    // Cargo rebuilds if a file that the build script watches is missing, so all of them must exist.
    let read = |place: &Path| {
        let (commit, files) = build::commit(place);
        assert!(files.iter().all(|file| file.exists()), "{files:?}");
        (commit, files)
    };
    let check_commit = |place: &Path| {
        let (commit, files) = read(place);
        assert_eq!(commit, git(place, "rev-parse HEAD"));
        files
    };
    assert_eq!(read(&tree).0, None, "a repository without commits has none");
    git(&tree, "commit -q --allow-empty -m one");
    let files = check_commit(&tree);
    assert!(files.iter().any(|file| file.ends_with("refs/heads/trunk")), "{files:?}");
    git(&tree, "pack-refs --all");
    assert!(!tree.join(".git/refs/heads/trunk").exists());
    check_commit(&tree);
    git(&tree, "commit -q --allow-empty -m two");
    check_commit(&tree);
    git(&tree, "worktree add -q ../side -b topic/side");
    let side = folder.path().join("side");
    git(&side, "commit -q --allow-empty -m three");
    let files = check_commit(&side);
    assert_ne!(read(&side).0, read(&tree).0);
    assert!(files.iter().any(|file| file.ends_with("refs/heads/topic/side")), "{files:?}");
    git(&tree, "checkout -q --detach HEAD~1");
    check_commit(&tree);
    let url = format!("clone -q --depth 1 file://{} ../shallow", tree.display());
    git(&tree, &url);
    check_commit(&folder.path().join("shallow"));
}

/// A build with uncommitted changes must not claim to be a build of the commit.
#[test]
fn uncommitted_changes_are_recorded_as_dirty() {
    let folder = tempfile::tempdir().unwrap();
    let tree = folder.path();
    let git = |line: &str| {
        let mut command = Command::new("git");
        command.args(["-c", "user.name=x", "-c", "user.email=x@example.org"]).args(line.split(' ')).current_dir(tree);
        command.output().is_ok_and(|output| output.status.success())
    };
    if !git("init -q") {
        return support::skip_without("uncommitted_changes_are_recorded_as_dirty", "there is no git");
    }
    fs::create_dir(tree.join("src")).unwrap();
    fs::write(tree.join("src/lib.rs"), "// one\n").unwrap();
    assert!(git("add src/lib.rs") && git("commit -q -m one"));
    let hash = build::commit(tree).0.unwrap();
    let (state, files) = build::state(tree);
    assert_eq!(state.as_ref(), Some(&hash));
    assert!(files.contains(&tree.join("src")), "the build script runs again if a source changes: {files:?}");
    fs::write(tree.join("notes"), "not tracked").unwrap();
    assert_eq!(build::state(tree).0.as_ref(), Some(&hash));
    fs::write(tree.join("src/lib.rs"), "// two\n").unwrap();
    assert_eq!(build::state(tree).0, Some(hash.clone() + "-dirty"));
    assert!(git("add src/lib.rs"));
    assert_eq!(build::state(tree).0, Some(hash + "-dirty"));
}

#[test]
fn without_git_the_commit_comes_from_the_archive() {
    let folder = tempfile::tempdir().unwrap();
    assert_eq!(build::commit(folder.path()), (None, vec![]));
    let hash = "0123456789abcdef0123456789abcdef01234567";
    // In the format of `cargo package`.
    let text = format!("{{\n  \"git\": {{\n    \"sha1\": \"{hash}\"\n  }},\n  \"path_in_vcs\": \"\"\n}}");
    fs::write(folder.path().join(".cargo_vcs_info.json"), text).unwrap();
    assert_eq!(build::commit(folder.path()).0.as_deref(), Some(hash));
    assert_eq!(build::state(folder.path()).0.as_deref(), Some(hash));
    let text = fs::read_to_string(folder.path().join(".cargo_vcs_info.json")).unwrap();
    let dirty = text.replace("67\"\n", "67\",\n    \"dirty\": true\n");
    fs::write(folder.path().join(".cargo_vcs_info.json"), dirty).unwrap();
    assert_eq!(build::state(folder.path()).0, Some(format!("{hash}-dirty")));
    fs::remove_file(folder.path().join(".cargo_vcs_info.json")).unwrap();
    fs::create_dir(folder.path().join(".git")).unwrap();
    fs::write(folder.path().join(".git/HEAD"), "no hash\n").unwrap();
    assert_eq!(build::commit(folder.path()).0, None);
    assert_eq!(build::state(folder.path()).0, None);
    fs::write(folder.path().join(".git/HEAD"), hash).unwrap();
    assert_eq!(build::state(folder.path()).0, Some(format!("{hash}-unchecked")), "git cannot read this directory");
}

/// Runs a command that must succeed, with text on standard input. Returns its standard output and standard error.
fn good_with_input(place: &Place, line: &str, input: &str) -> (String, String) {
    let output = place.command().args(line.split_whitespace()).write_stdin(input).output().unwrap();
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(0), "{line}: {stderr}");
    (String::from_utf8(output.stdout).unwrap(), stderr)
}

const LAYOUTS: [&str; 3] = ["generally_forward", "strictly_forward", "chaotic"];

#[test]
fn init_prints_every_key_with_its_layouts_values() {
    let place = Place::new(&[]);
    for layout in LAYOUTS {
        let (text, stderr) = place.good(&format!("init {}", layout.replace('_', "-")));
        assert_eq!(stderr, "");
        assert!(text.lines().all(|line| line.chars().count() <= 120), "{text}");
        let layout_text = fs::read_to_string(Path::new(crate::ROOT).join(format!("configs/{layout}.toml"))).unwrap();
        assert_eq!(text.lines().next(), layout_text.lines().next(), "the title line");
        let check_output = |text: &str| good_with_input(&place, "check -", text).0;
        assert_eq!(check_output(&text), check_output(&layout_text));
        // Each key appears once, below a comment with its meaning, unit, kind, range and default.
        let mut description = String::new();
        let mut descriptions = std::collections::BTreeMap::new();
        let mut section = "";
        for line in text.lines() {
            match (line.strip_prefix("# "), line.split_once(" = ")) {
                (Some(comment), _) => description += &format!("{comment} "),
                (_, Some((leaf, _))) => {
                    let before = descriptions.insert(format!("{section}.{leaf}"), std::mem::take(&mut description));
                    assert_eq!(before, None, "{line}");
                }
                _ if line.starts_with('[') => (section, description) = (line.trim_matches(['[', ']']), String::new()),
                _ => {}
            }
        }
        let keys = config::keys();
        assert_eq!(descriptions.len(), keys.len());
        for key in keys {
            let default = key.default.map_or("has to be given".into(), |default| format!("default {default}"));
            for part in [key.meaning, key.unit, &key.kind, &key.range, &default] {
                assert!(descriptions[key.name].contains(part), "{part} of {}: {}", key.name, descriptions[key.name]);
            }
        }
    }
    assert_eq!(place.good("init"), place.good("init generally-forward"));
    assert_eq!(place.good("init"), place.good("init generally_forward"));
    assert_eq!(place.run("init spiral").status.code(), Some(2));
    assert_eq!(place.run("init --force").status.code(), Some(2), "--force needs --out");
}

#[test]
fn init_writes_a_config_that_trains_and_overwrites_nothing() {
    let place = Place::new(&[]);
    assert_eq!(place.good("init -o my.toml").0, "my.toml\n");
    let written = place.read("my.toml");
    assert_eq!(written, place.good("init").0);
    place.good("train my.toml --backend cpu --generations 1 --trials 1 -q -o run");
    let refused = place.run("init chaotic --out my.toml");
    let stderr = String::from_utf8(refused.stderr).unwrap();
    assert_eq!(
        (refused.status.code(), stderr.contains("the file exists; choose another --out, or overwrite it with --force")),
        (Some(1), true),
        "{stderr}"
    );
    assert_eq!(place.read("my.toml"), written);
    place.good("init chaotic --out my.toml --force");
    assert_eq!(place.read("my.toml"), place.good("init chaotic").0);
}

const SMALL: &str = "
[world]
leaders = [[10, 5]]
followers = [[12, 2]]
pois = [[10, 9]]
coupling = 2
steps = 4
[learning]
population = 4
generations = 2
trials = 1
";

#[test]
fn every_command_that_reads_a_config_reads_standard_input() {
    let place = Place::new(&[]);
    let read = |name: &str| place.bytes(name);
    // The first folder of a series has no number, so these names are not in it.
    for name in ["config-1", "config-07", "config-9x", "config10"] {
        fs::create_dir_all(place.path("runs").join(name)).unwrap();
    }
    let (_, stderr) = good_with_input(&place, "train - --backend cpu --seed 3", SMALL);
    assert!(stderr.contains("into runs/config\n"), "{stderr}");
    // The saved config can be used like any other: training from it repeats the run.
    assert!(Config::load(&place.path("runs/config/config.toml")).is_ok());
    place.good("train runs/config/config.toml --backend cpu -q -o again");
    assert_eq!(read("again/policies.safetensors"), read("runs/config/policies.safetensors"));
    let (done, _) = good_with_input(&place, "train - --backend cpu --seed 3 --resume", SMALL);
    assert!(done.contains("runs/config"), "{done}");
    // A new run gets the largest number plus one, even if smaller numbers are unused. `--resume` takes the largest.
    fs::create_dir(place.path("runs/config-4")).unwrap();
    let (_, stderr) = good_with_input(&place, "train - --backend cpu", SMALL);
    assert!(stderr.contains("into runs/config-5\n"), "{stderr}");
    let (done, _) = good_with_input(&place, "train - --backend cpu --resume", SMALL);
    assert!(done.contains("runs/config-5"), "{done}");
    let policies = "--policies again/policies.safetensors";
    let small = place.path("small.toml");
    fs::write(&small, SMALL).unwrap();
    for line in ["check FILE", "check FILE --json", &format!("rollout FILE --backend cpu {policies} --json")] {
        let [from_file, from_input] =
            ["small.toml", "-"].map(|name| good_with_input(&place, &line.replace("FILE", name), SMALL).0);
        assert_eq!(from_file, from_input, "{line}");
    }
    good_with_input(&place, "bench - --backend cpu --teams 2 --rollout-only --json", SMALL);
    let wrong = SMALL.replace("steps = 4", "steps = 0");
    for line in ["check -", "train -", &format!("rollout - {policies}"), "verify -", "bench -", "sweep -"] {
        let grid = if line == "sweep -" { "[grid]\n'learning.seed' = [1]\n" } else { "" };
        let input = wrong.clone() + grid;
        let output = place.command().args(line.split_whitespace()).write_stdin(input).output().unwrap();
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert!(stderr.contains("standard input:7: world.steps: found 0, allowed 1 to 10000"), "{line}: {stderr}");
        assert_eq!(output.status.code(), Some(1));
    }
}

#[test]
fn a_sweep_from_standard_input_resumes_from_its_directory() {
    let place = Place::new(&[]);
    let sweep = SMALL.to_string() + "[grid]\n'learning.seed' = [1, 2]\n";
    let (stdout, _) = good_with_input(&place, "sweep - --backend cpu -q --shard 1/2", &sweep);
    assert!(
        stdout.contains("flotilla sweep runs/sweep/sweep.toml --out runs/sweep --backend cpu --collect"),
        "{stdout}"
    );
    place.good("sweep runs/sweep/sweep.toml --out runs/sweep --backend cpu -q --shard 2/2");
    let (collected, _) = good_with_input(&place, "sweep - --collect", &sweep);
    assert!(collected.starts_with("2 of 2 points are done."), "{collected}");
    let (script, _) = good_with_input(&place, "sweep - --slurm", &sweep);
    assert!(script.contains("/runs/sweep/sweep.toml"), "{script}");
}

#[test]
fn a_job_array_of_unsuitable_size_prints_a_note() {
    let place = Place::new(&[]);
    let sweep = SMALL.to_string() + "[grid]\n'learning.seed' = [1, 2]\n";
    let (_, one_task) = good_with_input(&place, "sweep - --slurm", &sweep);
    assert!(one_task.contains("note: the job array has one task, which trains all points"), "{one_task}");
    let (_, many_tasks) = good_with_input(&place, "sweep - --slurm --shards 5", &sweep);
    assert!(
        many_tasks.contains("note: 3 of the 5 tasks get nothing to train, because the sweep has 2 points"),
        "{many_tasks}"
    );
    let (_, two_tasks) = good_with_input(&place, "sweep - --slurm --shards 2", &sweep);
    assert!(!two_tasks.contains("note:"), "{two_tasks}");
}

#[test]
fn errors_about_wrong_places_name_the_right_place() {
    let place = Place::new(&[]);
    let error_of = |line: &str, input: &str| {
        let output = place.command().args(line.split_whitespace()).write_stdin(input).output().unwrap();
        assert_ne!(output.status.code(), Some(0), "{line}");
        String::from_utf8(output.stderr).unwrap()
    };
    // A grid axis outside of the section [grid].
    let stderr = error_of("sweep -", &format!("groups = [2, 4]\n{SMALL}[grid]\n'learning.seed' = [1]\n"));
    assert!(stderr.contains("groups: this key belongs in the section [grid]: groups = [2, 4]"), "{stderr}");
    // A run named without its parent directory.
    good_with_input(&place, "train - --backend cpu -q -o runs/first", SMALL);
    let stderr = error_of("replay first", "");
    assert!(stderr.contains("; did you mean runs/first?"), "{stderr}");
    // A picture in a directory that does not exist.
    let stderr = error_of("plot runs/first -o pictures/curves.svg", "");
    assert!(stderr.contains("the folder pictures does not exist; make it first"), "{stderr}");
}

#[test]
fn pois_unreachable_for_one_reason_share_a_warning() {
    let place = Place::new(&[]);
    let far = SMALL.replace("pois = [[10, 9]]", "pois = [[50, 9], [50, 9], [10, 50]]");
    let (_, stderr) = good_with_input(&place, "check -", &far);
    assert_eq!(stderr.matches("cannot be reached by").count(), 2, "{stderr}");
    assert!(stderr.contains("; the same holds for POI 1\n"), "{stderr}");
}

#[test]
fn completions_cover_commands_flags_and_values() {
    let place = Place::new(&[]);
    for shell in ["bash", "elvish", "fish", "powershell", "zsh"] {
        let (script, _) = place.good(&format!("completions {shell}"));
        for word in ["rollout", "start-jitter", "completions"] {
            assert!(script.contains(word), "{word} in {shell}");
        }
    }
    assert_eq!(place.run("completions tcsh").status.code(), Some(2));
    // Call the completion function as bash would.
    place.write("flotilla.bash", place.good("completions bash").0);
    let complete = |line: &str| {
        let words: Vec<&str> = line.split(' ').collect();
        let (last, before) = (words[words.len() - 1], words[words.len() - 2]);
        let script = format!(
            "source flotilla.bash; COMP_WORDS=({line}); COMP_CWORD={}; _flotilla flotilla '{last}' '{before}'; \
             echo \"${{COMPREPLY[@]}}\"",
            words.len() - 1
        );
        let output = Command::new("bash").args(["-c", &script]).current_dir(place.root()).output().unwrap();
        assert!(output.stderr.is_empty(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap().trim().to_string()
    };
    assert_eq!(complete("flotilla tr"), "train");
    assert_eq!(complete("flotilla rollout --sc"), "--scores");
    assert_eq!(complete("flotilla train --paradigm le"), "leader-follower");
}

#[test]
fn every_command_has_a_manual_page() {
    let place = Place::new(&[]);
    place.good("man -o pages");
    let page = |name: &str| fs::read_to_string(place.path("pages").join(name)).unwrap();
    let first = page("flotilla.1");
    let mut commands = 0;
    for command in flotilla_cli::command().get_subcommands() {
        let name = format!("flotilla-{}", command.get_name());
        let page = page(&format!("{name}.1"));
        assert!(page.contains(&format!(".TH {name} 1 ")), "{page}");
        // Hyphens are escaped, so that flags can be copied from the rendered page.
        for flag in command.get_arguments().filter_map(|flag| flag.get_long()) {
            assert!(page.contains(&format!("\\-\\-{}", flag.replace('-', "\\-"))), "{flag} of {name}");
        }
        assert!(first.contains(&name.replace('-', "\\-")), "{name} in {first}");
        commands += 1;
    }
    assert_eq!(fs::read_dir(place.path("pages")).unwrap().count(), commands + 1);
}

/// Every command with `--out` also has `-o`, and every command with `--quiet` also has `-q`.
#[test]
fn short_flags_o_and_q_mean_the_same_in_every_command() {
    let mut counts = [0; 2];
    for command in flotilla_cli::command().get_subcommands() {
        for flag in command.get_arguments() {
            for (place, (long, short)) in [("out", 'o'), ("quiet", 'q')].into_iter().enumerate() {
                assert_eq!(flag.get_long() == Some(long), flag.get_short() == Some(short), "{}", command.get_name());
                counts[place] += usize::from(flag.get_long() == Some(long));
            }
        }
    }
    assert!(counts[0] >= 7 && counts[1] >= 6, "{counts:?}");
}

#[test]
fn plot_and_replay_report_as_json() {
    let place = Place::new(&[]);
    good_with_input(&place, "train - --backend cpu -q -o run", SMALL);
    let json = |line: &str| -> serde_json::Value {
        let (text, stderr) = place.good(line);
        assert_eq!(stderr, "", "{line}");
        serde_json::from_str(&text).unwrap()
    };
    let object = json("plot run --json -o curves.svg");
    assert_eq!((&object["out"], &object["runs"][0]), (&"curves.svg".into(), &"run".into()));
    let object = json("replay run --team best --json -q --backend cpu --compare 0 -o replay.svg");
    let bytes = fs::metadata(place.path("replay.svg")).unwrap().len();
    assert_eq!((&object["out"], &object["bytes"]), (&"replay.svg".into(), &bytes.into()));
    let metrics = place.read("run/metrics.csv");
    for (episode, generation) in [(0, 0), (1, 2)] {
        let episode = &object["episodes"][episode];
        assert_eq!((&episode["trial"], &episode["generation"]), (&0.into(), &generation.into()));
        let row = metrics.lines().find(|line| line.starts_with(&format!("0,{generation},"))).unwrap();
        assert_eq!(episode["best_g"].as_f64().unwrap(), row.split(',').nth(2).unwrap().parse::<f64>().unwrap());
    }
}

#[test]
fn citation_file_names_this_version() {
    let text = fs::read_to_string(Path::new(crate::ROOT).join("CITATION.cff")).unwrap();
    assert!(text.contains(&format!("\nversion: {}\n", env!("CARGO_PKG_VERSION"))), "{text}");
    assert!(text.contains("title: Structural Credit Assignment for Multiagent Leader-Based Learning"), "{text}");
}
