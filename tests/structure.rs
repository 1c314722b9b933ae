//! The crate is laid out as its documentation says: modules import downwards, and only one asks for the time.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// The Rust files of a module, given its path without an ending.
fn files(module: &Path) -> Vec<PathBuf> {
    let file = module.with_extension("rs");
    if file.is_file() {
        return vec![file];
    }
    let mut found = Vec::new();
    for entry in fs::read_dir(module).unwrap_or_else(|error| panic!("{}: {error}", module.display())) {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(files(&path));
        } else if path.extension().is_some_and(|ending| ending == "rs") {
            found.push(path);
        }
    }
    found.sort();
    found
}

/// A file's code: its lines without comments, and without what its unit tests take.
fn code(path: &Path) -> String {
    let text = fs::read_to_string(path).unwrap();
    let text = text.split("\n#[cfg(test)]\nmod tests").next().unwrap_or_default();
    text.lines().filter(|line| !line.trim_start().starts_with("//")).collect::<Vec<_>>().join("\n")
}

/// The modules that a table of a module's documentation names, in its order.
fn listed(text: &str) -> Vec<String> {
    let cells = text.lines().filter_map(|line| line.strip_prefix("//! | [")?.split('|').next());
    let names = cells.flat_map(|cell| cell.split('`').skip(1).step_by(2));
    names.map(|name| name.trim_start_matches("mod@").to_string()).collect()
}

/// The modules that a text imports from `root` ("crate", "super").
fn imports(code: &str, root: &str) -> Vec<String> {
    let mut found = Vec::new();
    for (at, _) in code.match_indices(&format!("{root}::")) {
        if code[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_' || c == ':') {
            continue;
        }
        let rest = &code[at + root.len() + 2..];
        let names: Vec<&str> = match rest.strip_prefix('{') {
            // The names at the first level of the braces.
            Some(rest) => {
                let mut depth = 0;
                let end = rest.find(|c| {
                    depth += i32::from(c == '{') - i32::from(c == '}');
                    depth < 0
                });
                let mut depth = 0;
                let parts = rest[..end.unwrap_or(0)].split(move |c| {
                    depth += i32::from(c == '{') - i32::from(c == '}');
                    depth == 0 && c == ','
                });
                parts.collect()
            }
            None => vec![rest],
        };
        let word =
            |text: &str| text.trim().chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect::<String>();
        found.extend(names.into_iter().map(word));
    }
    found
}

/// Holds a table's modules to importing only those above them.
fn check(doc: &Path, folder: &Path, root: &str) -> usize {
    let text = fs::read_to_string(doc).unwrap();
    let modules = listed(&text);
    let declared = text.lines().filter_map(|line| {
        let name = line.strip_prefix("pub mod ").or(line.strip_prefix("pub(crate) mod "));
        name?.strip_suffix(';')
    });
    let (mut declared, mut sorted) = (declared.map(String::from).collect::<Vec<_>>(), modules.clone());
    declared.sort();
    sorted.sort();
    assert_eq!(sorted, declared, "{}: the table names other modules than there are", doc.display());
    let mut wrong = Vec::new();
    let mut count = 0;
    for (place, module) in modules.iter().enumerate() {
        for path in files(&folder.join(module)) {
            for name in imports(&code(&path), root) {
                let Some(other) = modules.iter().position(|module| *module == name) else { continue };
                count += usize::from(other != place);
                if other > place {
                    wrong.push(format!("{} imports {name}, which stands below {module}", path.display()));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    count
}

#[test]
fn modules_import_downwards() {
    let count = check(Path::new("src/lib.rs"), Path::new("src"), "crate");
    assert!(count > 100, "only {count} imports were found");
    let gpu = Path::new("src/backend/gpu");
    let count = check(&gpu.join("mod.rs"), gpu, "super");
    assert!(count > 5, "only {count} imports were found");
}

/// The folder's modules, each with those beside it that it imports.
fn beside(folder: &Path) -> BTreeMap<String, Vec<String>> {
    let root = folder.strip_prefix("src").unwrap().iter().map(|name| name.to_str().unwrap());
    let root = ["crate"].into_iter().chain(root).collect::<Vec<_>>().join("::");
    let stem = |path: PathBuf| path.file_stem().unwrap().to_str().unwrap().to_string();
    let all = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let all = all.filter(|path| path.is_dir() || path.extension().is_some_and(|ending| ending == "rs")).map(stem);
    let all: Vec<String> = all.filter(|name| !["mod", "lib", "main"].contains(&&**name)).collect();
    let of = |name: &String| {
        let module = folder.join(name);
        let mut found: Vec<String> = files(&module).iter().flat_map(|path| imports(&code(path), &root)).collect();
        if module.with_extension("rs").is_file() {
            found.extend(imports(&code(&module.with_extension("rs")), "super"));
        }
        found.retain(|other| other != name && all.contains(other));
        (name.clone(), found)
    };
    all.iter().map(of).collect()
}

#[test]
fn no_modules_need_each_other() {
    let mut folders = vec![PathBuf::from("src")];
    let mut at = 0;
    while let Some(folder) = folders.get(at).cloned() {
        let inside = fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().path());
        folders.extend(inside.filter(|path| path.is_dir()));
        let mut left = beside(&folder);
        // Those that import nothing that is left are in order.
        while !left.is_empty() {
            let free: Vec<String> = left
                .iter()
                .filter(|(_, imported)| !imported.iter().any(|other| left.contains_key(other)))
                .map(|(name, _)| name.clone())
                .collect();
            assert!(!free.is_empty(), "{}: among these are some that import each other: {left:?}", folder.display());
            left.retain(|name, _| !free.contains(name));
        }
        at += 1;
    }
    assert!(folders.len() > 8, "only {folders:?} were looked through");
}

#[test]
fn one_module_asks_for_the_time_and_waits() {
    let mut wrong = Vec::new();
    for path in files(Path::new("src")) {
        let code = code(&path);
        let ways = ["std::time::Instant", "time::{Duration, Instant", "SystemTime", "block_on", ".recv()", "pollster"];
        let found = ways.iter().filter(|way| code.contains(**way) && !path.ends_with("host.rs"));
        wrong.extend(found.map(|way| format!("{}: {way}", path.display())));
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn imports_are_found_however_they_are_written() {
    let code = "use crate::a::{self, b};\nuse crate::{c, d::{e, f}, g};\nlet x = crate::h::i(); my_crate::j();";
    assert_eq!(imports(code, "crate"), ["a", "c", "d", "g", "h"]);
    assert_eq!(listed("//! | [`a`], [`mod@b`] | `c` | d |\n//! | x | [`y`] |\n"), ["a", "b"]);
}

/// The public items of a module, one a line, each method below its type.
fn face(path: &Path) -> Vec<String> {
    let (mut found, mut item, mut of) = (vec![format!("# {}", path.display())], String::new(), String::new());
    for line in code(path).lines() {
        let (text, indent) = (line.trim(), line.len() - line.trim_start().len());
        let variant = of.starts_with("pub enum") && indent == 4 && text.starts_with(char::is_uppercase);
        let method = of.starts_with("pub trait") && indent == 4 && text.starts_with("fn ");
        match item.is_empty() {
            true if indent == 0 && text.starts_with("impl") => of = text.trim_end_matches(" {").into(),
            true if text.starts_with("pub ") || variant || method => item = text.into(),
            true => continue,
            false => item = format!("{item} {text}"),
        }
        let count = |bracket: [char; 2]| bracket.map(|one| item.matches(one).count());
        let [[opened, closed], [from, to]] = [count(['(', ')']), count(['[', ']'])];
        if opened == closed && from == to && item.ends_with(['{', ';', ',', '}']) {
            if indent == 0 && item.starts_with("pub ") && item.ends_with('{') {
                of = item.trim_end_matches(" {").into();
            }
            let within = if indent > 0 && of.starts_with("impl") { format!("{of}: ") } else { String::new() };
            let shown =
                item.split(" = ").next().unwrap_or_default().trim_end_matches([';', ',']).trim_end_matches(" {");
            found.push(format!("{}{within}{shown}", " ".repeat(indent)));
            item.clear();
        }
    }
    found
}

#[test]
fn the_public_face_is_as_listed() {
    let paths =
        ["src/front", "src/front/coevolution", "src/ops"].into_iter().flat_map(|module| files(Path::new(module)));
    let face = paths.flat_map(|path| face(&path)).collect::<Vec<_>>().join("\n") + "\n";
    let path = "tests/face.txt";
    if std::env::var("FLOTILLA_WRITE").as_deref() == Ok("1") {
        fs::write(path, &face).unwrap();
    }
    let listed = fs::read_to_string(path).unwrap_or_default();
    let differs = face.lines().find(|line| !listed.lines().any(|other| other == *line));
    let gone = listed.lines().find(|line| !face.lines().any(|other| other == *line));
    assert!(
        listed == face,
        "the public interface has changed: {differs:?} is new, {gone:?} is gone. If programs that are built on it still \
         build, or this is a new minor version: FLOTILLA_WRITE=1 cargo test --test structure"
    );
}
