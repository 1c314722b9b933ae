//! Sets `FLOTILLA_TARGET` and `FLOTILLA_COMMIT` for the compiler. `FLOTILLA_COMMIT` is empty if the commit is unknown.
//!
//! Only release builds contain the commit, because a crate that contains it is recompiled at every commit.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

fn main() {
    let variable = |name| std::env::var(name).unwrap_or_default();
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rustc-env=FLOTILLA_TARGET={}", variable("TARGET"));
    let (commit, files) = match variable("PROFILE").as_str() {
        "release" => state(Path::new(&variable("CARGO_MANIFEST_DIR"))),
        _ => Default::default(),
    };
    files.iter().for_each(|file| println!("cargo::rerun-if-changed={}", file.display()));
    println!("cargo::rustc-env=FLOTILLA_COMMIT={}", commit.unwrap_or_default());
}

/// Returns the commit of a source tree, and the files that determine it. `-dirty` follows the commit if files differ
/// from it. `-unchecked` follows if git cannot check that.
pub fn state(root: &Path) -> (Option<String>, Vec<PathBuf>) {
    let (commit, mut files) = commit(root);
    let Some(commit) = commit else { return (None, files) };
    let dirty = match fs::read_to_string(root.join(".cargo_vcs_info.json")) {
        Ok(text) => Some(text.replace(char::is_whitespace, "").contains("\"dirty\":true")),
        Err(_) => {
            let sources = SOURCES.iter().map(|name| root.join(name)).filter(|path| path.exists());
            files.extend(sources);
            differs(root)
        }
    };
    let mark = match dirty {
        Some(false) => "",
        Some(true) => "-dirty",
        None => "-unchecked",
    };
    (Some(commit + mark), files)
}

/// The files and folders that a build reads.
const SOURCES: [&str; 10] =
    ["Cargo.toml", "Cargo.lock", "app", "build.rs", "cli/src", "configs", "python/src", "shaders", "src", "studies"];

/// Returns whether tracked files differ from the commit, or `None` if git fails.
fn differs(root: &Path) -> Option<bool> {
    let line = ["status", "--porcelain", "--untracked-files=no"];
    let output = Command::new("git").args(line).current_dir(root).output().ok()?;
    output.status.success().then_some(!output.stdout.is_empty())
}

/// Returns the commit of a source tree, and the files that determine it. A checkout (whole, shallow or a worktree) has
/// the commit that `HEAD` names. A crate's archive has a file with the commit, written by cargo.
pub fn commit(root: &Path) -> (Option<String>, Vec<PathBuf>) {
    let archive = root.join(".cargo_vcs_info.json");
    if let Ok(text) = fs::read_to_string(&archive) {
        let hash = text.split('"').skip_while(|word| *word != "sha1").nth(2).and_then(hash);
        return (hash, vec![archive]);
    }
    let mut git = root.join(".git");
    if let Ok(text) = fs::read_to_string(&git) {
        // In a worktree, `.git` is a file with the path of the git directory.
        git = root.join(text.trim_start_matches("gitdir:").trim());
    }
    let head = git.join("HEAD");
    let Ok(text) = fs::read_to_string(&head) else { return (None, vec![]) };
    let Some(name) = text.strip_prefix("ref:").map(str::trim) else { return (hash(&text), vec![head]) };
    let shared = fs::read_to_string(git.join("commondir")).map_or(git.clone(), |path| git.join(path.trim()));
    let loose = shared.join(name);
    if let Ok(text) = fs::read_to_string(&loose) {
        return (hash(&text), vec![head, loose]);
    }
    let packed = shared.join("packed-refs");
    let text = fs::read_to_string(&packed).unwrap_or_default();
    let found = text.lines().find_map(|line| line.strip_suffix(name)?.strip_suffix(' ').and_then(hash));
    // The next commit creates the loose ref, which changes its folder. Cargo treats a missing file as changed, so only
    // existing files are listed.
    let folder = loose.ancestors().skip(1).find(|folder| folder.exists()).map(PathBuf::from);
    (found, [head, packed].into_iter().filter(|file| file.exists()).chain(folder).collect())
}

fn hash(text: &str) -> Option<String> {
    let text = text.trim();
    ([40, 64].contains(&text.len()) && text.bytes().all(|byte| byte.is_ascii_hexdigit())).then(|| text.to_string())
}
