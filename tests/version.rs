//! What the program says it is.

use std::fs;
use std::path::Path;
use std::process::Command;

use assert_cmd::cargo::cargo_bin_cmd;

#[allow(dead_code, reason = "its main is cargo's")]
#[path = "../build.rs"]
mod build;

fn told(flag: &str) -> String {
    let output = cargo_bin_cmd!("flotilla").arg(flag).output().unwrap();
    assert!(output.status.success());
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn the_version_is_told_in_a_line_or_with_commit_and_target() {
    let name = concat!("flotilla ", env!("CARGO_PKG_VERSION"));
    assert_eq!(told("-V"), format!("{name}\n"));
    let long = told("--version");
    let lines: Vec<&str> = long.lines().collect();
    assert_eq!(lines[0], name, "{long}");
    assert!(lines[1].starts_with("commit  "), "{long}");
    let target = lines[2].strip_prefix("target  ").expect(&long);
    assert!(target.starts_with(std::env::consts::ARCH) && target.contains('-'), "{long}");
    // A debug build is not told, so as not to be compiled anew at every commit.
    let commit = build::commit(Path::new(env!("CARGO_MANIFEST_DIR"))).0.filter(|_| !cfg!(debug_assertions));
    assert_eq!(flotilla::COMMIT, commit.as_deref());
    assert!(lines[1].ends_with(&commit.unwrap_or("not recorded".into())), "{long}");
}

#[test]
fn the_commit_is_read_as_git_reads_it() {
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
        eprintln!("skipped: there is no git");
        return;
    }
    // Every file named as a reason to look again must be there: cargo takes a missing one for one that changed.
    let read = |place: &Path| {
        let (commit, files) = build::commit(place);
        assert!(files.iter().all(|file| file.exists()), "{files:?}");
        (commit, files)
    };
    let same = |place: &Path| {
        let (commit, files) = read(place);
        assert_eq!(commit, git(place, "rev-parse HEAD"));
        files
    };
    assert_eq!(read(&tree).0, None, "nothing is committed yet");
    git(&tree, "commit -q --allow-empty -m one");
    let files = same(&tree);
    assert!(files.iter().any(|file| file.ends_with("refs/heads/trunk")), "{files:?}");
    git(&tree, "pack-refs --all");
    assert!(!tree.join(".git/refs/heads/trunk").exists());
    same(&tree);
    git(&tree, "commit -q --allow-empty -m two");
    same(&tree);
    git(&tree, "worktree add -q ../side -b topic/side");
    let side = folder.path().join("side");
    git(&side, "commit -q --allow-empty -m three");
    let files = same(&side);
    assert_ne!(read(&side).0, read(&tree).0);
    assert!(files.iter().any(|file| file.ends_with("refs/heads/topic/side")), "{files:?}");
    git(&tree, "checkout -q --detach HEAD~1");
    same(&tree);
    let url = format!("clone -q --depth 1 file://{} ../shallow", tree.display());
    git(&tree, &url);
    same(&folder.path().join("shallow"));
}

#[test]
fn without_git_the_commit_is_what_the_archive_says_or_nothing() {
    let folder = tempfile::tempdir().unwrap();
    assert_eq!(build::commit(folder.path()), (None, vec![]));
    let hash = "0123456789abcdef0123456789abcdef01234567";
    // As cargo package writes it.
    let text = format!("{{\n  \"git\": {{\n    \"sha1\": \"{hash}\"\n  }},\n  \"path_in_vcs\": \"\"\n}}");
    fs::write(folder.path().join(".cargo_vcs_info.json"), text).unwrap();
    assert_eq!(build::commit(folder.path()).0.as_deref(), Some(hash));
    fs::remove_file(folder.path().join(".cargo_vcs_info.json")).unwrap();
    fs::create_dir(folder.path().join(".git")).unwrap();
    fs::write(folder.path().join(".git/HEAD"), "no hash\n").unwrap();
    assert_eq!(build::commit(folder.path()).0, None);
}
