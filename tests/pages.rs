//! Every command of README.md, CONTRIBUTING.md and the pages below docs/, as it stands there. Python blocks are run by
//! `python/tests/test_docs.py`.
//!
//! The blocks of a page are run in order, in a folder of its own that is empty but for the repository's `configs/`:
//!
//! - A fenced block without a language (or `sh`), and an indented one, holds commands, each a line of its own (`\` goes on
//!   in the next). What is printed, and what is not for a shell, has a language: `text`, `toml`, `yaml`.
//! - A `toml` block is a file where the paragraph before it names one (`` `sweep.toml` ``).
//! - `<!-- not run: WHY -->` before a block leaves it out.
//! - `<!-- short: FLAGS -->` before a block of long studies runs it with these flags, each with a value. They replace those of a
//!   command, or are added where the command takes them.
//! - `<!-- output -->` before a `text` block holds the block to what the last command printed: its lines are printed in this
//!   order, with others between them or not; `…` stands for any part of a line.
//!
//! `FLOTILLA_PAGE=first-run` runs the pages with this in their names.
//!
//! Commands that are not run, and those inside a text (`` `flotilla …` ``), have to be such that the program takes their
//! flags; a word in capitals stands for a value there.

#![cfg(feature = "cli")]

mod support;

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use clap::error::{ContextKind, ContextValue, ErrorKind};
use tempfile::TempDir;

/// The time limit of one command.
const PATIENCE: Duration = Duration::from_secs(300);

fn pages() -> Vec<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut pages = Vec::new();
    let mut folders = vec![root.join("docs")];
    while let Some(folder) = folders.pop() {
        for path in fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "md") {
                pages.push(path);
            }
        }
    }
    pages.sort();
    pages.splice(0..0, ["README.md", "CONTRIBUTING.md"].map(|page| root.join(page)));
    pages
}

/// A block of code, its lines each with its number in the page.
#[derive(Debug, Default, PartialEq)]
struct Block {
    language: String,
    /// Why it is left out.
    not_run: Option<String>,
    /// Flags that make its commands short.
    short: Option<String>,
    /// Whether the last command printed this.
    output: bool,
    /// The file that a `toml` block is.
    file: Option<String>,
    lines: Vec<(usize, String)>,
}

impl Block {
    /// The commands, each with its line's number.
    fn commands(&self) -> Vec<(usize, String)> {
        let mut commands: Vec<(usize, String)> = Vec::new();
        let mut goes_on = false;
        for (number, line) in &self.lines {
            match commands.last_mut().filter(|_| goes_on) {
                Some((_, command)) => *command += line,
                None => commands.push((*number, line.clone())),
            }
            goes_on = line.ends_with('\\');
            if let Some((_, command)) = commands.last_mut().filter(|_| goes_on) {
                command.pop();
            }
        }
        commands.retain(|(_, command)| !command.trim().is_empty() && !command.trim_start().starts_with('#'));
        commands
    }
}

/// The blocks of a page, and its commands in back-ticks.
fn read(text: &str) -> (Vec<Block>, Vec<(usize, String)>) {
    let (mut blocks, mut inline): (Vec<Block>, _) = (vec![], vec![]);
    let (mut next, mut paragraph, mut in_list) = (Block::default(), String::new(), false);
    let mut lines = (1..).zip(text.lines()).peekable();
    let mut after_blank = true;
    while let Some((number, line)) = lines.next() {
        let comment = line.trim().strip_prefix("<!--").and_then(|line| line.strip_suffix("-->")).map(str::trim);
        if let Some(comment) = comment {
            let why = |kind: &str| comment.strip_prefix(kind).map(|why| why.trim().to_string());
            next.not_run = why("not run:").or(next.not_run);
            next.short = why("short:").or(next.short);
            next.output |= comment == "output";
        } else if let Some(fence) = line.trim_start().strip_prefix("```") {
            let mut block = Block { language: fence.trim().into(), ..std::mem::take(&mut next) };
            let named =
                paragraph.split('`').skip(1).step_by(2).filter(|name| name.ends_with(".toml") && !name.contains('/'));
            block.file = named.last().filter(|_| block.language == "toml").map(String::from);
            while let Some((number, line)) = lines.next().filter(|(_, line)| !line.trim_start().starts_with("```")) {
                block.lines.push((number, line.into()));
            }
            blocks.push(block);
        } else if line.starts_with("    ") && after_blank && !in_list {
            let mut block = std::mem::take(&mut next);
            block.lines.push((number, line.trim().into()));
            while let Some((number, line)) = lines.next_if(|(_, line)| line.starts_with("    ")) {
                block.lines.push((number, line.trim().into()));
            }
            blocks.push(block);
        } else {
            if !line.trim().is_empty() {
                next = Block::default();
                in_list = line.starts_with("- ") || line.starts_with("1. ") || in_list && line.starts_with(' ');
                paragraph = if after_blank { String::new() } else { paragraph } + line + " ";
            }
            let spans = line.split('`').skip(1).step_by(2).filter(|span| span.starts_with("flotilla "));
            inline.extend(spans.map(|span| (number, span.to_string())));
        }
        after_blank = line.trim().is_empty();
    }
    (blocks, inline)
}

/// Returns the error in the flags of a command, if any.
fn misread(command: &str) -> Option<String> {
    let (mut words, mut quote) = (vec![String::new()], None);
    for c in command.chars() {
        match quote {
            Some(open) if open == c => quote = None,
            None if c == '\'' || c == '"' => quote = Some(c),
            None if c.is_whitespace() => words.push(String::new()),
            _ => words.last_mut().unwrap().push(c),
        }
    }
    words.retain(|word| !word.is_empty());
    let error = flotilla::cli::command().try_get_matches_from(words).err()?;
    let stands_for_a_value = |value: &str| {
        value.contains(['$', '{', '…']) || value.contains(char::is_uppercase) && !value.contains(char::is_lowercase)
    };
    match (error.kind(), error.get(ContextKind::InvalidValue)) {
        // In a text not all that a command needs has to be said.
        (ErrorKind::DisplayHelp | ErrorKind::DisplayVersion | ErrorKind::MissingRequiredArgument, _) => None,
        (_, Some(ContextValue::String(value))) if stands_for_a_value(value) => None,
        _ => Some(error.to_string()),
    }
}

/// The program's commands in a line for a shell.
fn calls(line: &str) -> Vec<String> {
    let line = line.split(" #").next().unwrap_or_default().split(" ::: ").next().unwrap_or_default();
    let mut line = line.replace("cargo run --release -- ", "flotilla ");
    while let Some((start, end)) =
        line.find("$((").and_then(|start| Some((start, start + line[start..].find("))")? + 2)))
    {
        line.replace_range(start..end, "N");
    }
    let parts = line.split([';', '|', '&']).filter_map(|part| Some(part[part.find("flotilla ")?..].trim().to_string()));
    parts.collect()
}

/// Returns a command with flags that make it short.
fn shortened(command: &str, flags: &str) -> String {
    let mut command = command.split(" #").next().unwrap_or_default().trim_end().to_string();
    if !command.starts_with("flotilla ") {
        return command;
    }
    let words: Vec<&str> = flags.split_whitespace().collect();
    for flag in words.chunks(2) {
        let [name, value] = flag else { panic!("{flags}: not every flag has a value") };
        let before = command.clone();
        let mut parts: Vec<&str> = before.split(' ').collect();
        let place = parts.iter().position(|part| part == name);
        match place {
            Some(place) => parts[place + 1] = value,
            None => parts.extend([name, value]),
        }
        let after = parts.join(" ");
        if place.is_some() || misread(&after).is_none() {
            command = after;
        }
    }
    command
}

/// Runs a command as a shell does, and returns what it printed, as an error if it failed.
fn run(command: &str, folder: &Path) -> Result<String, String> {
    let said = folder.join(".said");
    let output = fs::File::create(&said).unwrap();
    let mut bash = support::shell("bash", command);
    bash.current_dir(folder).stdin(Stdio::null());
    let mut child = bash.stderr(output.try_clone().unwrap()).stdout(output).spawn().unwrap();
    let start = Instant::now();
    let status = loop {
        match child.try_wait().unwrap() {
            Some(status) => break status.to_string(),
            None if start.elapsed() > PATIENCE => {
                let _ = child.kill();
                let _ = child.wait();
                break format!("it was ended after {PATIENCE:?}");
            }
            None => std::thread::sleep(Duration::from_millis(5)),
        }
    };
    let printed = fs::read_to_string(&said).unwrap_or_default();
    if status == "exit status: 0" { Ok(printed) } else { Err(format!("{status}\n{printed}")) }
}

/// The first line of a block that was not printed, after the lines before it.
fn not_printed<'a>(block: &'a Block, printed: &str) -> Option<&'a (usize, String)> {
    let mut printed = printed.lines();
    let is = |line: &str, shown: &str| {
        let mut rest = line.trim_end();
        let parts: Vec<_> = shown.trim_end().split('…').collect();
        let (first, others) = parts.split_first().unwrap();
        let Some(left) = rest.strip_prefix(first) else { return false };
        rest = left;
        for part in others {
            let Some(at) = rest.find(part) else { return false };
            rest = &rest[at + part.len()..];
        }
        rest.is_empty() || parts.last().is_some_and(|last| last.is_empty())
    };
    block.lines.iter().find(|(_, shown)| !shown.trim().is_empty() && !printed.any(|line| is(line, shown)))
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap().map(Result::unwrap) {
        let to = to.join(entry.file_name());
        match entry.file_type().unwrap().is_dir() {
            true => copy(&entry.path(), &to),
            false => drop(fs::copy(entry.path(), to).unwrap()),
        }
    }
}

/// The result of a page.
#[derive(Default)]
struct Tried {
    ran: usize,
    parsed: usize,
    left_out: Vec<String>,
    failed: Vec<String>,
}

fn try_page(name: &str, text: &str) -> Tried {
    let folder: TempDir = tempfile::tempdir().unwrap();
    copy(&Path::new(env!("CARGO_MANIFEST_DIR")).join("configs"), &folder.path().join("configs"));
    let mut tried = Tried::default();
    let (blocks, inline) = read(text);
    let parse = |tried: &mut Tried, number: usize, command: &str| {
        tried.parsed += 1;
        if let Some(error) = misread(command) {
            tried.failed.push(format!("{name}:{number}: {command}\n{error}"));
        }
    };
    inline.iter().for_each(|(number, command)| parse(&mut tried, *number, command));
    let (mut broken, mut printed, mut after_python) = (false, String::new(), false);
    for block in blocks {
        // The Python package's tests run Python and compare what it prints.
        after_python = block.language == "python" || after_python && block.output;
        if block.output && !broken && !after_python {
            if let Some((number, line)) = not_printed(&block, &printed) {
                tried.failed.push(format!("{name}:{number}: {line}\nis not what the last command printed:\n{printed}"));
            }
            continue;
        }
        let text = || block.lines.iter().map(|(_, line)| line.clone() + "\n").collect::<String>();
        match &*block.language {
            "toml" => {
                let line = block.lines.first().map_or(0, |(number, _)| *number);
                if let Err(error) = text().parse::<toml::Table>() {
                    tried.failed.push(format!("{name}:{line}: it is not TOML: {error}"));
                }
                if let Some(file) = &block.file {
                    fs::write(folder.path().join(file), text()).unwrap();
                }
                continue;
            }
            "" | "sh" | "bash" => {}
            _ => continue,
        }
        for (number, command) in block.commands() {
            if let Some(why) = &block.not_run {
                calls(&command).iter().for_each(|call| parse(&mut tried, number, call));
                tried.left_out.push(format!("{name}:{number}: {command}  ({why})"));
            } else if !broken {
                tried.ran += 1;
                let command = block.short.as_ref().map_or(command.clone(), |flags| shortened(&command, flags));
                match run(&command, folder.path()) {
                    Ok(output) => printed = output,
                    Err(output) => {
                        tried.failed.push(format!("{name}:{number}: {command}\n{output}"));
                        // What follows would fail for want of this.
                        broken = true;
                    }
                }
            }
        }
    }
    tried
}

#[test]
fn every_command_of_the_pages_does_what_it_says() {
    let (mut failed, mut told) = (Vec::new(), String::new());
    let mut all = 0;
    let only = std::env::var("FLOTILLA_PAGE").unwrap_or_default();
    for page in pages() {
        let name = page.strip_prefix(env!("CARGO_MANIFEST_DIR")).unwrap().display().to_string();
        if !name.contains(&only) {
            continue;
        }
        let mut tried = try_page(&name, &fs::read_to_string(&page).unwrap());
        all += tried.ran;
        told += &format!(
            "{name}: {} commands run, {} only read, {} left out\n",
            tried.ran,
            tried.parsed,
            tried.left_out.len()
        );
        tried.left_out.iter().for_each(|line| told += &format!("  left out {line}\n"));
        failed.append(&mut tried.failed);
    }
    // Straight to the stream: what a passing test prints by macro is not shown.
    write!(std::io::stderr(), "\n{told}").unwrap();
    assert!(failed.is_empty(), "{} commands of the pages fail:\n\n{}", failed.len(), failed.join("\n\n"));
    assert!(all >= 10 || !only.is_empty(), "only {all} commands were found");
}

#[test]
fn what_fails_in_a_page_is_told_with_its_place() {
    let page = "# Page\n\n`few.toml` is\n\n```toml\n[x]\n```\n\n```\ncat few.toml # it is there\ntrue \\\n  && ls configs\n\
                flotilla chekc x\n```\n\n    false\n\n<!-- not run: WHY -->\n\n```\nflotilla check --sed 1\n```\n\
                Text `flotilla train CONFIG --trials N`, `flotilla plot --ot x`.\n\n```text\nno command\n```\n";
    let Tried { ran, failed, left_out, parsed } = try_page("p.md", page);
    assert_eq!((ran, parsed), (3, 3), "{failed:?}");
    assert_eq!(left_out, ["p.md:21: flotilla check --sed 1  (WHY)"]);
    let places: Vec<_> = failed.iter().map(|failed| failed.lines().next().unwrap()).collect();
    let expected = ["p.md:23: flotilla plot --ot x", "p.md:13: flotilla chekc x", "p.md:21: flotilla check --sed 1"];
    assert_eq!(places, expected, "{failed:?}");
    assert!(failed[1].contains("exit status: 2\n") && failed[1].contains("chekc"), "{failed:?}");
}

#[test]
fn a_long_command_is_run_in_short() {
    let flags = "--trials 2 --population 20";
    let short = |command| shortened(command, flags);
    assert_eq!(short("flotilla paper --trials 200 --out a # b"), "flotilla paper --trials 2 --out a");
    assert_eq!(short("flotilla train c.toml --population 5000"), "flotilla train c.toml --population 20 --trials 2");
    assert_eq!(short("flotilla compare a --csv"), "flotilla compare a --csv");
    let page = "<!-- short: --teams 2 -->\n```\nfalse\n```\n";
    assert_eq!(try_page("p.md", page).failed.len(), 1);
}

#[test]
fn output_of_python_is_left_to_pythons_tests() {
    let page = "```\necho one\n```\n\n```python\nprint(2)\n```\n\n<!-- output -->\n\n```text\n2\n```\n";
    assert!(try_page("p.md", page).failed.is_empty());
    let page = page.replace("python\nprint(2)", "\necho two");
    assert_eq!(try_page("p.md", &page).failed.len(), 1);
}

#[test]
fn output_that_differs_is_reported() {
    let page = "```\nprintf 'one 1\\ntwo 2\\nthree 3\\n'\n```\n\n<!-- output -->\n\n```text\none 1\nth…3\n```\n";
    assert!(try_page("p.md", page).failed.is_empty());
    for (from, to) in [("one 1\nth…3", "th…3\none 1"), ("th…3", "th…4"), ("one 1\n", "one\n")] {
        let page =
            page.replace(&format!("text\n{}", "one 1\nth…3"), &format!("text\n{}", "one 1\nth…3".replace(from, to)));
        assert_eq!(try_page("p.md", &page).failed.len(), 1, "{page}");
    }
}

/// The anchor that a heading gets.
fn anchor(heading: &str) -> String {
    let kept = heading.trim().to_lowercase();
    kept.chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c)).map(|c| if c == ' ' { '-' } else { c }).collect()
}

/// The relative links of a page that lead nowhere.
fn broken_links(page: &Path) -> Vec<String> {
    let anchors = |text: &str| -> Vec<String> {
        text.lines().filter(|line| line.starts_with('#')).map(|line| anchor(line.trim_start_matches('#'))).collect()
    };
    // What only the site shows leads to what only the site has; `tests/site.py` follows those links.
    let text = fs::read_to_string(page).unwrap().replace("<!-- site:", "\0<!--");
    let text: String = text
        .split('\0')
        .map(|part| part.split_once("-->").filter(|_| part.starts_with("<!--")).map_or(part, |(_, rest)| rest))
        .collect();
    let links = text.split("](").skip(1).filter_map(|rest| rest.split_once(')')).map(|(link, _)| link);
    let broken = links.filter(|link| {
        if link.contains("://") || link.starts_with("mailto:") || link.contains(char::is_whitespace) {
            return false;
        }
        let (path, fragment) = link.split_once('#').map_or((*link, None), |(path, fragment)| (path, Some(fragment)));
        let target = if path.is_empty() { page.to_path_buf() } else { page.with_file_name("").join(path) };
        let is_page = target.extension().is_some_and(|extension| extension == "md");
        let has = |fragment: &str| anchors(&fs::read_to_string(&target).unwrap()).iter().any(|there| there == fragment);
        !target.exists() || is_page && fragment.is_some_and(|fragment| !has(fragment))
    });
    broken.map(|link| format!("{}: {link}", page.display())).collect()
}

#[test]
fn every_link_of_the_pages_leads_somewhere() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let others = [
        "CHANGELOG.md",
        "python/README.md",
        "benches/README.md",
        "benches/static-figures.md",
        "benches/peers/README.md",
    ];
    let pages = pages().into_iter().chain(others.map(|other| root.join(other)));
    let broken: Vec<_> = pages.filter(|page| page.exists()).flat_map(|page| broken_links(&page)).collect();
    assert!(broken.is_empty(), "{broken:#?}");

    let folder = tempfile::tempdir().unwrap();
    let page = folder.path().join("page.md");
    fs::write(&page, "# One `two`: three\n[a](#one-two-three) [b](#four) [c](page.md#x) [d](none.md) [e](https://f.g)")
        .unwrap();
    assert_eq!(broken_links(&page).len(), 3, "{:?}", broken_links(&page));
}
