//! Tests the structure of the crate: modules import downwards, only one module reads the clock, the browser page
//! offers every fitness, and CONTRIBUTING.md knows the folders.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use flotilla::config::{Choice, Fitness};

/// Returns the Rust files of a module, given its path without an extension.
fn files(module: &Path) -> Vec<PathBuf> {
    let file = module.with_extension("rs");
    if file.is_file() {
        return vec![file];
    }
    let mut paths = Vec::new();
    for entry in fs::read_dir(module).unwrap_or_else(|error| panic!("{}: {error}", module.display())) {
        let path = entry.unwrap().path();
        if path.is_dir() {
            paths.extend(files(&path));
        } else if path.extension().is_some_and(|ending| ending == "rs") {
            paths.push(path);
        }
    }
    paths.sort();
    paths
}

/// Returns a file's code without comment lines and without unit tests.
fn code(path: &Path) -> String {
    let text = fs::read_to_string(path).unwrap();
    let text = text.split("\n#[cfg(test)]\nmod tests").next().unwrap_or_default();
    text.lines().filter(|line| !line.trim_start().starts_with("//")).collect::<Vec<_>>().join("\n")
}

/// Returns the modules in the table of a module's documentation, in its order.
fn table_modules(text: &str) -> Vec<String> {
    let cells = text.lines().filter_map(|line| line.strip_prefix("//! | [")?.split('|').next());
    let names = cells.flat_map(|cell| cell.split('`').skip(1).step_by(2));
    names.map(|name| name.trim_start_matches("mod@").to_string()).collect()
}

/// Returns the modules that a text imports from `root` ("crate", "super").
fn imports(code: &str, root: &str) -> Vec<String> {
    let mut modules = Vec::new();
    for (at, _) in code.match_indices(&format!("{root}::")) {
        if code[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_' || c == ':') {
            continue;
        }
        let rest = &code[at + root.len() + 2..];
        let names: Vec<&str> = match rest.strip_prefix('{') {
            // Split at the commas outside of inner braces.
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
        modules.extend(names.into_iter().map(word));
    }
    modules
}

/// Fails if a module imports one below it in the table. Returns the number of imports.
fn count_imports(doc: &Path, folder: &Path, root: &str) -> usize {
    let text = fs::read_to_string(doc).unwrap();
    let modules = table_modules(&text);
    let declared = text.lines().filter_map(|line| {
        let name = line.strip_prefix("pub mod ").or(line.strip_prefix("pub(crate) mod "));
        name?.strip_suffix(';')
    });
    let (mut declared, mut sorted) = (declared.map(String::from).collect::<Vec<_>>(), modules.clone());
    declared.sort();
    sorted.sort();
    assert_eq!(sorted, declared, "{}: the table of modules does not match the declared ones", doc.display());
    let mut violations = Vec::new();
    let mut count = 0;
    for (place, module) in modules.iter().enumerate() {
        for path in files(&folder.join(module)) {
            for name in imports(&code(&path), root) {
                let Some(other) = modules.iter().position(|module| *module == name) else { continue };
                count += usize::from(other != place);
                if other > place {
                    violations.push(format!("{} imports {name}, which is listed below {module}", path.display()));
                }
            }
        }
    }
    assert!(violations.is_empty(), "{}", violations.join("\n"));
    count
}

#[test]
fn modules_import_downwards() {
    for (folder, least) in [("src", 100), ("app/src", 100), ("studies/src", 1)] {
        let folder = Path::new(folder);
        let count = count_imports(&folder.join("lib.rs"), folder, "crate");
        assert!(count > least, "only {count} imports were found in {}", folder.display());
    }
    let gpu = Path::new("src/backend/gpu");
    let count = count_imports(&gpu.join("mod.rs"), gpu, "super");
    assert!(count > 5, "only {count} imports were found");
}

/// Returns the modules of a directory, each with its imports from the same directory.
fn sibling_imports(folder: &Path) -> BTreeMap<String, Vec<String>> {
    let root = folder.iter().skip_while(|name| *name != "src").skip(1).map(|name| name.to_str().unwrap());
    let root = ["crate"].into_iter().chain(root).collect::<Vec<_>>().join("::");
    let stem = |path: PathBuf| path.file_stem().unwrap().to_str().unwrap().to_string();
    let siblings = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let siblings =
        siblings.filter(|path| path.is_dir() || path.extension().is_some_and(|ending| ending == "rs")).map(stem);
    let siblings: Vec<String> = siblings.filter(|name| !["mod", "lib", "main"].contains(&&**name)).collect();
    let module_imports = |name: &String| {
        let module = folder.join(name);
        let mut imported: Vec<String> = files(&module).iter().flat_map(|path| imports(&code(path), &root)).collect();
        if module.with_extension("rs").is_file() {
            imported.extend(imports(&code(&module.with_extension("rs")), "super"));
        }
        imported.retain(|other| other != name && siblings.contains(other));
        (name.clone(), imported)
    };
    siblings.iter().map(module_imports).collect()
}

#[test]
fn modules_of_a_directory_have_no_import_cycles() {
    let mut folders = ["src", "app/src", "studies/src", "cli/src"].map(PathBuf::from).to_vec();
    let mut next = 0;
    while let Some(folder) = folders.get(next).cloned() {
        let inside = fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().path());
        folders.extend(inside.filter(|path| path.is_dir()));
        let mut remaining = sibling_imports(&folder);
        // Repeatedly remove the modules that import none of the remaining ones.
        while !remaining.is_empty() {
            let independent: Vec<String> = remaining
                .iter()
                .filter(|(_, imported)| !imported.iter().any(|other| remaining.contains_key(other)))
                .map(|(name, _)| name.clone())
                .collect();
            assert!(
                !independent.is_empty(),
                "{}: some of these modules import each other: {remaining:?}",
                folder.display()
            );
            remaining.retain(|name, _| !independent.contains(name));
        }
        next += 1;
    }
    assert!(folders.len() > 8, "only {folders:?} were checked");
}

#[test]
fn only_host_rs_reads_the_clock_or_waits() {
    let mut violations = Vec::new();
    for path in files(Path::new("src")) {
        let code = code(&path);
        let calls = ["std::time::Instant", "time::{Duration, Instant", "SystemTime", "block_on", ".recv()", "pollster"];
        let used = calls.iter().filter(|call| code.contains(**call) && !path.ends_with("host.rs"));
        violations.extend(used.map(|call| format!("{}: {call}", path.display())));
    }
    assert!(violations.is_empty(), "{}", violations.join("\n"));
}

#[test]
fn imports_are_found_in_every_form() {
    let code = "use crate::a::{self, b};\nuse crate::{c, d::{e, f}, g};\nlet x = crate::h::i(); my_crate::j();";
    assert_eq!(imports(code, "crate"), ["a", "c", "d", "g", "h"]);
    assert_eq!(table_modules("//! | [`a`], [`mod@b`] | `c` | d |\n//! | x | [`y`] |\n"), ["a", "b"]);
}

/// Returns the public items of a module, one per line, with methods below their types.
fn public_items(path: &Path) -> Vec<String> {
    let (mut items, mut item, mut owner) = (vec![format!("# {}", path.display())], String::new(), String::new());
    for line in code(path).lines() {
        let (text, indent) = (line.trim(), line.len() - line.trim_start().len());
        let variant = owner.starts_with("pub enum") && indent == 4 && text.starts_with(char::is_uppercase);
        let method = owner.starts_with("pub trait") && indent == 4 && text.starts_with("fn ");
        match item.is_empty() {
            true if indent == 0 && text.starts_with("impl") => owner = text.trim_end_matches(" {").into(),
            true if text.starts_with("pub ") || variant || method => item = text.into(),
            true => continue,
            false => item = format!("{item} {text}"),
        }
        let count = |bracket: [char; 2]| bracket.map(|character| item.matches(character).count());
        let [[opened, closed], [from, to]] = [count(['(', ')']), count(['[', ']'])];
        if opened == closed && from == to && item.ends_with(['{', ';', ',', '}']) {
            if indent == 0 && item.starts_with("pub ") && item.ends_with('{') {
                owner = item.trim_end_matches(" {").into();
            }
            let within = if indent > 0 && owner.starts_with("impl") { format!("{owner}: ") } else { String::new() };
            let shown =
                item.split(" = ").next().unwrap_or_default().trim_end_matches([';', ',']).trim_end_matches(" {");
            items.push(format!("{}{within}{shown}", " ".repeat(indent)));
            item.clear();
        }
    }
    items
}

#[test]
fn the_public_interface_is_as_listed() {
    let paths = ["src/front", "app/src/ops"].into_iter().flat_map(|module| files(Path::new(module)));
    let public_items = paths.flat_map(|path| public_items(&path)).collect::<Vec<_>>().join("\n") + "\n";
    let path = "tests/public_api.txt";
    if std::env::var("FLOTILLA_WRITE").as_deref() == Ok("1") {
        fs::write(path, &public_items).unwrap();
    }
    let listed = fs::read_to_string(path).unwrap_or_default();
    let added = public_items.lines().find(|line| !listed.lines().any(|other| other == *line));
    let removed = listed.lines().find(|line| !public_items.lines().any(|other| other == *line));
    assert!(
        listed == public_items,
        "the public interface has changed: {added:?} was added, {removed:?} was removed. \
         If programs that use it still build, or this is a new minor version: \
         FLOTILLA_WRITE=1 cargo test structure::"
    );
}

#[test]
fn the_browser_page_has_every_fitness() {
    let page = fs::read_to_string("web/page/index.html").unwrap();
    let select = page.split("<select id=\"fitness\">").nth(1).and_then(|rest| rest.split("</select>").next()).unwrap();
    let compare = fs::read_to_string("web/page/compare.js").unwrap();
    for word in Fitness::names() {
        assert!(select.contains(&format!("<option>{word}</option>")), "index.html does not offer {word}");
        assert!(compare.contains(&format!("\"{word}\"")), "compare.js does not compare {word}");
    }
}

/// Returns the number of lines of code below a folder.
fn lines(folder: &Path) -> usize {
    let endings = ["rs", "wgsl", "py", "pyi", "js", "mjs", "css", "html"];
    let paths = fs::read_dir(folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
    let of_path = |path: PathBuf| {
        let is_made = ["dist", "node_modules", "target", ".venv"].iter().any(|made| path.ends_with(made));
        match path.extension() {
            _ if is_made => 0,
            _ if path.is_dir() => lines(&path),
            Some(ending) if endings.iter().any(|other| ending == *other) => {
                fs::read_to_string(&path).unwrap().lines().count()
            }
            _ => 0,
        }
    };
    paths.map(|entry| of_path(entry.unwrap().path())).sum()
}

#[test]
fn the_map_in_contributing_has_the_size_of_each_folder() {
    let page = fs::read_to_string("CONTRIBUTING.md").unwrap();
    let mut rows = 0;
    for (folders, rest) in page.lines().filter_map(|line| line.strip_prefix("| `")?.split_once("` | ")) {
        let Ok(listed) = rest.split(" | ").next().unwrap_or_default().parse::<f64>() else { continue };
        let counted = folders.split("`, `").map(|folder| lines(Path::new(folder))).sum::<usize>() as f64;
        assert!(
            (counted - listed).abs() < 0.2 * listed,
            "{folders} has {counted} lines, CONTRIBUTING.md lists {listed}"
        );
        rows += 1;
    }
    assert!(rows > 10, "{rows}");
}

/// The worked examples are diffs of some lines, each below the name of its file.
#[test]
fn the_worked_examples_in_contributing_still_apply() {
    let page = fs::read_to_string("CONTRIBUTING.md").unwrap();
    let diffs = page.split("```diff\n").skip(1).map(|rest| rest.split("```").next().unwrap());
    let mut hunks = 0;
    for hunk in diffs.flat_map(|diff| diff.split("--- ").skip(1)) {
        let (file, changes) = hunk.split_once('\n').unwrap();
        let before = changes.lines().filter(|line| !line.starts_with('+')).map(|line| format!("{}\n", &line[1..]));
        let before: String = before.collect();
        let found = fs::read_to_string(file).unwrap().matches(&before).count();
        assert!(!before.is_empty() && found == 1, "{file} has these lines {found} times:\n{before}");
        hunks += 1;
    }
    assert!(hunks > 10, "{hunks}");
}

/// Returns the functions, types, constants and variables that a shader declares, and its code without comments.
fn declared(text: &str) -> (Vec<String>, String) {
    let code: Vec<&str> = text.lines().map(|line| line.split("//").next().unwrap()).collect();
    let word = |text: &str| text.split(|c: char| !c.is_alphanumeric() && c != '_').next().unwrap().to_string();
    let names = code.iter().filter_map(|line| {
        // Functions are recognised by their calls, because variables may have the same name.
        let function = line.strip_prefix("fn ").map(|rest| format!("{}(", word(rest)));
        let other = ["struct ", "const "].iter().find_map(|keyword| line.strip_prefix(keyword)).map(word);
        let variable = || (line.starts_with("var<") || line.starts_with('@')).then(|| line.split_once("> ")).flatten();
        function.or(other).or_else(|| variable().map(|(_, rest)| word(rest)))
    });
    (names.collect(), code.join("\n"))
}

/// Shaders are joined to one text, in any order. Each names the files that it uses.
#[test]
fn every_shader_names_the_files_that_it_uses() {
    let episode = "lib/layout lib/math generic agent sense policy follow pursue motion couple episode";
    let episode: Vec<&str> = episode.split(' ').collect();
    let joined: [&[&str]; 3] = [&episode, &["lib/layout", "count"], &["lib/math", "population"]];
    let read = |name: &str| fs::read_to_string(format!("shaders/{name}.wgsl")).unwrap();
    let mut uses = 0;
    for files in joined {
        for name in files {
            let text = read(name);
            let (_, code) = declared(&text);
            let line = text.split_once("// Uses: ").map_or("", |(_, rest)| rest.split("\n//\n").next().unwrap());
            let line = line.split("\n\n").next().unwrap();
            for other in files.iter().filter(|other| *other != name) {
                let is_word_before =
                    |at: usize| code[..at].ends_with(|c: char| c.is_alphanumeric() || "_.".contains(c));
                let is_used = |used: &String| {
                    code.match_indices(&**used).any(|(at, _)| {
                        let after = code[at + used.len()..].starts_with(|c: char| c.is_alphanumeric() || c == '_');
                        !is_word_before(at) && (!after || used.ends_with('('))
                    })
                };
                let used: Vec<String> = declared(&read(other)).0.into_iter().filter(is_used).collect();
                let is_named = line.contains(&format!("{other}.wgsl"));
                uses += used.len();
                assert!(used.is_empty() || is_named, "{name}.wgsl does not say that it uses {other}.wgsl: {used:?}");
            }
        }
    }
    assert!(uses > 30, "{uses}");
}
