//! Tests that flotilla never replaces or deletes files that it did not make.
//!
//! It must not write through symbolic links in its own folders either, because these may lead to files of others.

use crate::support;
use std::fs;
use std::path::{Path, PathBuf};

use crate::recovery::{Fails, reference, session, with_each_failure};
use crate::support::{Place, SMALL, files};
use flotilla::config::Config;
use flotilla::front::cpu;
use flotilla_app::record::disk::Disk;
use flotilla_app::record::folder::{METRICS, POLICIES, RUN, Run, Start, Status};
use flotilla_app::record::ownership::{self, LIST};

const SWEEP: &str = "
[world]
leaders = [[10, 5], [20, 5]]
pois = [[10, 9], [20, 9]]
steps = 5
[learning]
population = 4
generations = 2
trials = 1
[grid]
\"world.coupling\" = [1, 2]
";

fn place() -> Place {
    Place::new(&[("small.toml", SMALL), ("grid.toml", SWEEP)]).on_cpu()
}

/// Creates a folder with a run in `run`.
fn with_run() -> Place {
    let place = place();
    place.good("train small.toml --out run --quiet");
    place
}

#[test]
fn pictures_of_others_are_not_replaced() {
    let place = place();
    fs::create_dir(place.path("v")).unwrap();
    place.write("v/curves.svg", "precious");
    for flag in ["", "--force"] {
        let stderr = place.refused(1, &format!("train small.toml --out v --quiet {flag}"));
        assert!(
            stderr.contains("v/curves.svg was not made by flotilla") && stderr.contains("move it away"),
            "{stderr}"
        );
        assert_eq!((place.read("v/curves.svg"), place.path("v/run.json").exists()), ("precious".into(), false));
    }
    // With --resume the run is trained, and a note says that the picture was not drawn.
    let (_, stderr) = place.good("train small.toml --out v --quiet --resume");
    assert!(stderr.contains("v/curves.svg: not drawn") && place.path("v/run.json").exists(), "{stderr}");
    assert_eq!(place.read("v/curves.svg"), "precious");
    place.fails(1, "plot v", &["v/curves.svg was not made by flotilla"]);
    assert_eq!(place.read("v/curves.svg"), "precious");
    place.good("plot v --out v/curves.svg");
    assert!(place.read("v/curves.svg").starts_with("<svg"), "a file named by --out is replaced");
}

#[test]
fn an_edited_picture_is_kept() {
    let place = with_run();
    place.good("plot run");
    place.good("replay run --quiet");
    place.good("replay run --quiet --trial 1");
    let edited = place.read("run/curves.svg").replace("</svg>", "<!-- for the thesis --></svg>");
    place.write("run/curves.svg", &edited);
    place.fails(1, "plot run", &["not made by flotilla"]);
    place.refused(1, "train small.toml --out run --quiet --force");
    place.notes("train small.toml --out run --quiet --resume --generations 8", &["curves.svg: not drawn"]);
    assert_eq!(place.read("run/curves.svg"), edited);
    // A line of the list of files that a crash truncated must not invalidate the next line.
    let list = place.read(Path::new("run").join(LIST));
    place.write(Path::new("run").join(LIST), format!("{list}0123"));
    fs::remove_file(place.path("run/curves.svg")).unwrap();
    place.good("plot run");
    place.good("plot run");
}

#[test]
fn force_removes_only_files_of_the_run() {
    let place = place();
    fs::create_dir(place.path("v")).unwrap();
    place.write("v/replay.html", "precious");
    place.good("train small.toml --out v --quiet --force");
    assert_eq!(place.read("v/replay.html"), "precious", "there was no run to replace");
    place.good("train small.toml --out v --quiet --force");
    assert_eq!(place.read("v/replay.html"), "precious");
    place.fails(1, "replay v --quiet", &["v/replay.html was not made by flotilla"]);
    fs::remove_file(place.path("v/replay.html")).unwrap();
    place.good("replay v --quiet");
    place.good("train small.toml --out v --quiet --force");
    assert!(!place.path("v/replay.html").exists(), "the replay showed the replaced run");
}

/// No message may suggest a flag with which the next attempt is refused, too.
#[test]
fn folders_with_files_of_others_are_refused_with_every_flag() {
    let place = place();
    for (name, text) in [
        ("metrics.csv", "loss,step\n1,2\n"),
        ("policies.safetensors", "theirs"),
        ("config.toml", "theirs = true\n"),
        ("run.json", "{\"job\": 7}\n"),
        ("checkpoints/000000004.safetensors", "theirs"),
    ] {
        let out = place.path(name.replace('/', "-"));
        let file = out.join(name);
        fs::create_dir_all(file.parent().unwrap()).unwrap();
        fs::write(&file, text).unwrap();
        let before = files(&out);
        for flags in [&[][..], &["--force"], &["--resume"]] {
            let words = [&["train", "small.toml", "--quiet", "--out", out.to_str().unwrap()], flags].concat();
            let stderr = place.fails(1, &words, &[&format!("{name} was not made by flotilla")]);
            assert!(
                stderr.contains("move it away, or choose another --out") && !stderr.contains("--force"),
                "{stderr}"
            );
            assert_eq!(files(&out), before, "{name} {flags:?}");
        }
    }
    // A folder with nothing but a user's config can become a run of this config. No other config replaces it.
    fs::create_dir(place.path("own")).unwrap();
    let own = format!("# Mine.\n{SMALL}");
    place.write("own/config.toml", &own);
    let stderr = place.refused(1, "train small.toml --out own --quiet --force --seed 3");
    assert!(stderr.contains("own/config.toml was not made by flotilla"), "{stderr}");
    place.good("train own/config.toml --out own --quiet");
    assert_eq!(place.read("own/config.toml"), own);
}

#[test]
fn temporary_files_of_others_are_kept() {
    let place = with_run();
    for name in ["checkpoints/notes.tmp", "checkpoints/a.safetensors.tmp", "run.json.tmp", "metrics.csv.tmp"] {
        fs::write(place.path("run").join(name), "precious").unwrap();
    }
    place.write("run/checkpoints/.flotilla-000000003.safetensors.tmp", "left by a writer that was killed");
    place.good("train small.toml --out run --quiet --resume --generations 9");
    for name in ["checkpoints/notes.tmp", "checkpoints/a.safetensors.tmp", "run.json.tmp", "metrics.csv.tmp"] {
        assert_eq!(place.read(Path::new("run").join(name)), "precious");
    }
    assert!(!place.path("run/checkpoints/.flotilla-000000003.safetensors.tmp").exists());
}

#[test]
fn the_list_of_pictures_stays_short_and_complete() {
    let place = with_run();
    place.good("replay run");
    let list = place.path("run/.flotilla.sha256");
    let of_run = fs::read_to_string(&list).unwrap();
    let digests = |count: usize| (0..count).map(|index| format!("{index:064x}  replay.html\n")).collect::<String>();
    // The newest lines are at the end, after more bytes than are read.
    fs::write(&list, digests(300_000) + &of_run).unwrap();
    place.good("replay run --generation 1");
    place.good("replay run --generation 2");
    let lines = fs::read_to_string(&list).unwrap().lines().count();
    assert!(lines < 100, "{lines}");
    for line in of_run.lines().filter(|line| line.ends_with("curves.svg")) {
        assert!(fs::read_to_string(&list).unwrap().contains(line));
    }
}

#[test]
fn checkpoints_of_other_runs_are_not_replayed() {
    let place = with_run();
    place.good("train small.toml --quiet --out other --seed 9");
    place.good("train small.toml --quiet --out warm --init other/policies.safetensors --set checkpoint.generations=2");
    let page = || {
        place.good("replay run --generation 5 --out page.html");
        place.read("page.html")
    };
    fs::remove_dir_all(place.path("run/checkpoints")).unwrap();
    fs::create_dir(place.path("run/checkpoints")).unwrap();
    let before = page();
    for entry in fs::read_dir(place.path("warm/checkpoints")).unwrap() {
        let name = entry.unwrap().file_name();
        fs::copy(place.path("warm/checkpoints").join(&name), place.path("run/checkpoints").join(&name)).unwrap();
    }
    place.write("run/checkpoints/000000005.safetensors", "mine");
    assert!(page() == before);
}

#[test]
#[cfg(unix)]
fn nothing_is_written_at_the_root_of_the_file_system() {
    let place = place();
    std::os::unix::fs::symlink("/", place.path("top")).unwrap();
    for words in ["train small.toml", "train small.toml --resume", "sweep sweep.toml"] {
        for out in ["/", "/../.", "top"] {
            place.write("sweep.toml", format!("{SMALL}[grid]\n\"learning.fitness\" = ['D', 'Df']\n"));
            let stderr = place.refused(1, &*format!("{words} --out {out}"));
            assert!(stderr.contains("it is the root of the file system; choose a folder in it"), "{stderr}");
        }
    }
}

#[test]
fn an_animation_does_not_replace_pictures_of_others() {
    let place = with_run();
    place.write("p0003.png", "precious");
    place.fails(1, "replay run --quiet --width 100 --out p%04d.png", &["p0003.png was not made by flotilla"]);
    assert_eq!(place.read("p0003.png"), "precious");
    assert!(!place.path("p0000.png").exists(), "no frame is written");
    place.good("replay run --quiet --width 100 --out q%04d.png");
    // An animation may replace its own frames. None of a longer one remain.
    let frames = || {
        fs::read_dir(place.path("."))
            .unwrap()
            .filter(|file| file.as_ref().unwrap().file_name().to_string_lossy().starts_with('q'))
            .count()
    };
    place.good("replay run --quiet --width 100 --out q%04d.png --trial 1 --fps 20");
    let before = frames();
    place.good("replay run --quiet --width 100 --out q%04d.png --fps 5");
    assert!(frames() < before, "{} of {before}", frames());
    // A comparison, which has a default name, may replace itself, but not a picture of others.
    place.good("train small.toml --out other --quiet --seed 3");
    place.good("plot run other");
    place.good("plot run other");
    place.write("comparison.svg", "<svg xmlns=\"http://www.w3.org/2000/svg\"><title>precious</title></svg>");
    place.fails(1, "plot run other", &["comparison.svg was not made by flotilla"]);
    assert!(place.read("comparison.svg").contains("precious"));
}

#[test]
fn a_users_config_is_copied_before_another_replaces_it() {
    let place = place();
    fs::create_dir(place.path("own")).unwrap();
    let own = format!("# Mine.\n{SMALL}");
    place.write("own/config.toml", &own);
    place.good("train own/config.toml --out own --quiet");
    place.notes("train own/config.toml --out own --quiet --resume --generations 15", &["kept as own/config.old.toml"]);
    assert_eq!(place.read("own/config.old.toml"), own);
    assert!(place.read("own/config.toml").contains("generations = 15"));
    // A config that flotilla wrote needs no copy.
    place.good("train own/config.toml --out own --quiet --resume --generations 16");
    assert!(!place.path("own/config.old-2.toml").exists());
    place.write("own/config.toml", format!("# Mine, too.\n{}", place.read("own/config.toml")));
    place.good("train small.toml --out own --quiet --force");
    assert!(place.read("own/config.old-2.toml").starts_with("# Mine, too.\n"));
}

#[test]
fn files_of_others_in_sweeps_man_pages_and_papers_are_kept() {
    let place = place();
    place.good("sweep grid.toml --out sweep --quiet");
    place.good("sweep grid.toml --out sweep --quiet --collect");
    for name in ["results.csv", "points.csv", "final.svg", "final.png", "final.pdf"] {
        let before = fs::read(place.path("sweep").join(name)).unwrap();
        place.write(Path::new("sweep").join(name), "precious");
        for flag in ["--collect", "--force", "--resume"] {
            let stderr = place.refused(1, &format!("sweep grid.toml --out sweep --quiet {flag}"));
            assert!(stderr.contains(&format!("sweep/{name} was not made by flotilla")), "{stderr}");
            assert_eq!(place.read(Path::new("sweep").join(name)), "precious");
        }
        place.write(Path::new("sweep").join(name), before);
    }
    place.good("sweep grid.toml --out sweep --quiet --force");
    place.command().arg("man").assert().success();
    place.command().arg("man").assert().success();
    let page = fs::read_dir(place.path("man")).unwrap().next().unwrap().unwrap().path();
    fs::write(&page, "precious").unwrap();
    place.command().arg("man").assert().code(1);
    assert_eq!(fs::read_to_string(page).unwrap(), "precious");
    // A paper.toml of another program does not make the folder a paper.
    fs::create_dir(place.path("thesis")).unwrap();
    place.write("thesis/paper.toml", "title = 'mine'\n");
    let stderr = place.refused(1, "paper --out thesis --force --trials 1 --generations 1 --quiet");
    assert!(stderr.contains("thesis/paper.toml was not made by flotilla"), "{stderr}");
    assert_eq!(place.read("thesis/paper.toml"), "title = 'mine'\n");
}

#[test]
fn folders_of_other_users_are_entered_only_if_named() {
    assert!(ownership::may_write(1000, 1000, false));
    assert!(!ownership::may_write(1001, 1000, false));
    assert!(!ownership::may_write(0, 1000, false) && !ownership::may_write(1000, 0, false));
    assert!(ownership::may_write(1001, 1000, true));
}

#[cfg(unix)]
mod links {
    use std::os::unix::fs::{chown, symlink};

    use super::*;

    /// Creates a folder of somebody else, to which links lead and which must not change.
    fn victim(place: &Place) -> PathBuf {
        let victim = place.path("victim");
        fs::create_dir_all(victim.join("docs")).unwrap();
        for name in ["file", "docs/notes.tmp", "docs/000000006.safetensors", "docs/000000003.safetensors"] {
            fs::write(victim.join(name), "precious").unwrap();
        }
        victim
    }

    /// Runs commands that must report a symbolic link and leave the folder unchanged. Returns their standard error.
    fn assert_unchanged(place: &Place, folder: &Path, lines: &[&str]) -> String {
        let before = files(folder);
        let mut messages = String::new();
        for line in lines {
            let output = place.run(*line);
            let stderr = String::from_utf8(output.stderr).unwrap();
            assert!(!stderr.contains("panicked"), "{line}: {stderr}");
            assert!(stderr.contains("is a symbolic link"), "{line}: {stderr}");
            assert_eq!(files(folder), before, "{line}");
            messages += &stderr;
        }
        messages
    }

    #[test]
    fn pictures_and_pages_are_not_written_through_links() {
        let place = with_run();
        let victim = victim(&place);
        for (name, line) in [("replay.html", "replay run --quiet"), ("curves.svg", "plot run")] {
            let path = place.path("run").join(name);
            let _ = fs::remove_file(&path);
            symlink(victim.join("file"), &path).unwrap();
            let stderr = assert_unchanged(&place, &victim, &[line]);
            assert!(
                stderr.contains(&format!("run/{name} is a symbolic link")) && stderr.contains("remove the link"),
                "{stderr}"
            );
            assert!(path.is_symlink());
            fs::remove_file(&path).unwrap();
        }
        // A link to a missing file is not followed, nor one in place of the list of files that flotilla made.
        symlink(victim.join("new"), place.path("run/replay.html")).unwrap();
        assert_unchanged(&place, &victim, &["replay run --quiet"]);
        fs::remove_file(place.path("run/replay.html")).unwrap();
        // A run stays whole if its page cannot be removed.
        symlink(victim.join("file"), place.path("run/replay.html")).unwrap();
        assert_unchanged(&place, &place.path("run"), &["train small.toml --out run --quiet --force"]);
        fs::remove_file(place.path("run/replay.html")).unwrap();
        fs::remove_file(place.path("run").join(LIST)).unwrap();
        symlink(victim.join("file"), place.path("run").join(LIST)).unwrap();
        assert_unchanged(&place, &victim, &["replay run --quiet"]);
    }

    #[test]
    fn a_runs_own_files_are_not_written_through_links() {
        let place = with_run();
        let victim = victim(&place);
        let [force, resume] =
            ["--force", "--resume --generations 9"].map(|flags| format!("train small.toml --out run --quiet {flags}"));
        let both = [&*force, &*resume];
        // The checkpoints are a link to a folder with files that look like checkpoints.
        fs::rename(place.path("run/checkpoints"), place.path("kept")).unwrap();
        symlink(victim.join("docs"), place.path("run/checkpoints")).unwrap();
        assert_unchanged(&place, &victim, &both);
        fs::remove_file(place.path("run/checkpoints")).unwrap();
        fs::rename(place.path("kept"), place.path("run/checkpoints")).unwrap();
        for name in [".lock", METRICS, POLICIES, RUN] {
            let path = place.path("run").join(name);
            let kept = fs::read(&path).unwrap();
            fs::remove_file(&path).unwrap();
            symlink(victim.join("new"), &path).unwrap();
            assert_unchanged(&place, &victim, &both[..usize::from(name != RUN) + 1]);
            fs::remove_file(&path).unwrap();
            fs::write(&path, kept).unwrap();
        }
        // A link is refused even if it leads to the run's own metrics.
        fs::rename(place.path("run").join(METRICS), victim.join(METRICS)).unwrap();
        symlink(victim.join(METRICS), place.path("run").join(METRICS)).unwrap();
        assert_unchanged(&place, &victim, &both);
    }

    #[test]
    fn the_lock_of_a_new_run_is_not_created_through_a_link() {
        let place = place();
        let victim = victim(&place);
        fs::create_dir(place.path("v")).unwrap();
        symlink(victim.join("new"), place.path("v/.lock")).unwrap();
        assert_unchanged(
            &place,
            &victim,
            &["train small.toml --out v --quiet", "train small.toml --out v --quiet --resume"],
        );
    }

    #[test]
    fn sweeps_and_papers_are_not_written_through_links() {
        let place = with_run();
        let victim = victim(&place);
        place.good("sweep grid.toml --out sweep --quiet");
        for name in ["results.csv", "final.png"] {
            let path = place.path("sweep").join(name);
            fs::rename(&path, place.path("kept")).unwrap();
            symlink(victim.join("file"), &path).unwrap();
            assert_unchanged(&place, &victim, &["sweep grid.toml --out sweep --quiet --collect"]);
            fs::remove_file(&path).unwrap();
            fs::rename(place.path("kept"), &path).unwrap();
        }
        // A point is a link to another run, and then the folder of all points is a link.
        let runs = place.path("run");
        fs::rename(place.path("sweep/points/0000"), place.path("kept")).unwrap();
        symlink(&runs, place.path("sweep/points/0000")).unwrap();
        assert_unchanged(&place, &runs, &["sweep grid.toml --out sweep --quiet --force"]);
        fs::remove_file(place.path("sweep/points/0000")).unwrap();
        fs::rename(place.path("kept"), place.path("sweep/points/0000")).unwrap();
        fs::rename(place.path("sweep/points"), place.path("points")).unwrap();
        symlink(place.path("points"), place.path("sweep/points")).unwrap();
        assert_unchanged(&place, &place.path("points"), &["sweep grid.toml --out sweep --quiet --force"]);

        let paper = "paper --out paper --trials 1 --generations 1 --quiet";
        fs::create_dir(place.path("paper")).unwrap();
        symlink(&victim, place.path("paper/arms")).unwrap();
        place.write("paper/paper.toml", "seed = 0\ntrials = 1\ngenerations = 1\n");
        assert_unchanged(&place, &victim, &[&format!("{paper} --force"), &format!("{paper} --resume")]);
        fs::remove_file(place.path("paper/arms")).unwrap();
        symlink(victim.join("file"), place.path("paper/claims.md")).unwrap();
        assert_unchanged(&place, &victim, &[&format!("{paper} --force"), &format!("{paper} --resume")]);
    }

    /// Somebody else may have created the link before the user names it.
    #[test]
    fn links_in_runs_and_sweeps_are_refused_even_if_a_flag_names_them() {
        let place = with_run();
        let victim = victim(&place);
        place.good("sweep grid.toml --out sweep --quiet");
        let run = ["plot run --out run/x.svg", "replay run --quiet --out run/x.html"];
        let rollout = "rollout small.toml --policies run/policies.safetensors";
        let others = [
            format!("{rollout} --scores run/x.csv"),
            format!("{rollout} --trace sweep/points/0000/x.csv"),
            "sweep grid.toml --out new --slurm=sweep/x.sh".to_string(),
        ];
        for line in run.into_iter().chain(others.iter().map(String::as_str)) {
            let path = place.path(line.rsplit([' ', '=']).next().unwrap());
            for target in ["file", "new"] {
                symlink(victim.join(target), &path).unwrap();
                assert_unchanged(&place, &victim, &[line]);
                assert!(path.is_symlink(), "{line}");
                fs::remove_file(&path).unwrap();
            }
            place.good(line);
            assert!(path.is_file(), "{line}");
        }
        // The same holds inside the run, and if a folder in the path is a link.
        let inside = |line: &str| {
            let output = place.command().current_dir(place.path("run")).args(line.split(' ')).output().unwrap();
            String::from_utf8(output.stderr).unwrap()
        };
        fs::remove_file(place.path("run/x.svg")).unwrap();
        symlink(victim.join("file"), place.path("run/x.svg")).unwrap();
        assert!(inside("plot . --out x.svg").contains("is a symbolic link"));
        symlink(&victim, place.path("run/pictures")).unwrap();
        assert_unchanged(&place, &victim, &["plot run --out run/pictures/x.svg"]);
        // A link beside the run is the user's own and is followed.
        symlink(victim.join("file"), place.path("x.svg")).unwrap();
        place.good("plot run --out run/../x.svg");
        assert!(
            fs::read_to_string(victim.join("file")).unwrap().starts_with("<svg") && place.path("x.svg").is_symlink()
        );
    }

    #[test]
    fn questions_are_not_written_through_links() {
        let place = place();
        let victim = victim(&place);
        let questions = "paper --questions=g --trials 2 --generations 1 --out questions --quiet";
        place.good(questions);
        let both = [format!("{questions} --resume"), format!("{questions} --force")];
        let both: Vec<&str> = both.iter().map(String::as_str).collect();
        for name in ["questions.md", "places.csv", "places.svg", "places/points/0000/metrics.csv"] {
            let path = place.path("questions").join(name);
            fs::rename(&path, place.path("kept")).unwrap();
            symlink(victim.join("file"), &path).unwrap();
            assert_unchanged(&place, &victim, &both);
            fs::remove_file(&path).unwrap();
            fs::rename(place.path("kept"), &path).unwrap();
        }
        let points = place.path("questions/places/points");
        fs::rename(&points, place.path("points")).unwrap();
        symlink(&victim, &points).unwrap();
        assert_unchanged(&place, &victim, &both);
        fs::remove_file(&points).unwrap();
        fs::rename(place.path("points"), &points).unwrap();
        place.good(both[0]);
    }

    #[test]
    fn a_link_to_a_run_folder_can_be_named() {
        let place = place();
        fs::create_dir(place.path("disk")).unwrap();
        symlink(place.path("disk"), place.path("runs")).unwrap();
        place.good("train small.toml --quiet");
        place.good("train small.toml --quiet --resume --generations 8");
        symlink(place.path("disk/small"), place.path("mine")).unwrap();
        place.good("train small.toml --out mine --quiet --force");
        place.good("replay mine --quiet");
        place.good("plot mine");
        assert!(place.path("disk/small/replay.html").exists());
    }

    #[test]
    fn a_run_of_another_user_is_changed_only_if_it_is_named() {
        let place = with_run();
        if chown(place.path("run"), Some(12345), None).is_err() {
            let test = "a_run_of_another_user_is_changed_only_if_it_is_named";
            return support::skip(test, "only root can change the owner of files");
        }
        let _ = fs::remove_file(place.path("run/curves.svg"));
        for line in ["replay run --quiet", "plot run"] {
            place.fails(1, line, &["run belongs to another user", "--out"]);
        }
        assert!(!place.path("run/replay.html").exists() && !place.path("run/curves.svg").exists());
        place.good("replay run --quiet --out run/replay.html");
        place.good("train small.toml --out run --quiet --resume --generations 8");
        // Without --out, runs/small is chosen by default, so nobody named it.
        fs::create_dir(place.path("runs")).unwrap();
        fs::rename(place.path("run"), place.path("runs/small")).unwrap();
        place.fails(1, "train small.toml --quiet --resume --generations 9", &["runs/small belongs to another user"]);
        place.good("train small.toml --quiet --resume --generations 9 --out runs/small");
    }
}

/// For each file operation of `--force`, this operation and all after it fail, as if the process were killed there. The
/// next session, with either flag, has to end in the same results as a new run.
#[test]
fn an_interrupted_replacement_is_completed_by_force_and_by_resume() {
    let old = Config::parse(SMALL, "small.toml").unwrap();
    let mut new = old.clone();
    (new.learning.seed, new.learning.population, new.checkpoint.generations) = (5, 6, 2);
    let expected = reference(&new).0.digest;
    let train = |config: &Config, path: &Path, start| session(config, path, start, Disk::default(), cpu(), None).end;
    let before = |path: &Path| {
        train(&old, path, Start::Fresh).unwrap();
        fs::write(path.join("notes.txt"), "mine").unwrap();
    };
    let mut replacing = 0;
    for start in [Start::Force, Start::Resume] {
        with_each_failure(before, &new, Start::Force, &[Fails::FromThere], |path, outcome, _, context| {
            assert!(outcome.end.is_err(), "{context}");
            let state = Run::read(&path.join(RUN)).map(|run| run.state);
            if matches!(state, Ok(Status::Replacing)) {
                replacing += 1;
                // A resume with another config is refused, and changes nothing.
                train(&old, path, Start::Resume).unwrap_err();
            }
            // Before the first operation the old run is complete. It cannot be resumed with another config.
            let is_old = matches!(state, Ok(Status::Done)) && Config::load(&path.join("config.toml")).unwrap() == old;
            train(&new, path, if is_old { Start::Force } else { start }).unwrap();
            let digest = Run::read(&path.join(RUN)).unwrap().digest;
            assert_eq!(digest.as_deref(), Some(&*expected), "{context}, {start:?}");
            assert_eq!(fs::read(path.join("notes.txt")).unwrap(), b"mine");
        });
    }
    assert!(replacing > 20, "only {replacing} failures were during the replacement");
}
