//! Tests the commands and links in README.md, CONTRIBUTING.md and the pages below docs/.
//!
//! `python/tests/test_docs.py` runs the Python blocks. This test runs the other blocks of a page in order, in an empty
//! directory with a copy of the repository's `configs/`:
//!
//! - A fenced block without a language, one marked `sh`, and an indented block contain commands, one per line. `\`
//!   continues a line. Output and other text has a language: `text`, `toml`, `yaml`.
//! - A `toml` block is written to the file that the paragraph before it names (`` `sweep.toml` ``), if any.
//! - `<!-- not run: WHY -->` before a block skips it.
//! - `<!-- short: FLAGS -->` before a block of long studies shortens its commands with these flags, each with a value.
//!   They replace the same flags of a command, or are added if the command takes them. A pair of other words replaces
//!   the first word with the second.
//! - `<!-- output -->` before a `text` block compares it with what the last command printed. Its lines have to be
//!   printed in this order; other lines may be between them. `…` matches any part of a line.
//!
//! Skipped commands, and commands inside a text (`` `flotilla …` ``), are only parsed: the program must accept their
//! flags. A word in capitals is a placeholder for a value.
//!
//! `FLOTILLA_PAGE=first-run` selects the pages with this in their names.

use crate::support;
use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use clap::error::{ContextKind, ContextValue, ErrorKind};
use rayon::prelude::*;
use tempfile::TempDir;

/// The time limit of one command.
const TIME_LIMIT: Duration = Duration::from_secs(300);

fn pages() -> Vec<PathBuf> {
    let root = Path::new(crate::ROOT);
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

/// A code block. Each line comes with its number in the page.
#[derive(Debug, Default, PartialEq)]
struct Block {
    language: String,
    /// The reason why the block is skipped.
    not_run: Option<String>,
    /// Flags that shorten its commands.
    short: Option<String>,
    /// Whether the block is compared with the last command's output.
    output: bool,
    /// The file that a `toml` block is written to.
    file: Option<String>,
    lines: Vec<(usize, String)>,
}

impl Block {
    /// Returns the commands, each with the number of its first line.
    fn commands(&self) -> Vec<(usize, String)> {
        let mut commands: Vec<(usize, String)> = Vec::new();
        let mut continues = false;
        for (number, line) in &self.lines {
            match commands.last_mut().filter(|_| continues) {
                Some((_, command)) => *command += line,
                None => commands.push((*number, line.clone())),
            }
            continues = line.ends_with('\\');
            if let Some((_, command)) = commands.last_mut().filter(|_| continues) {
                command.pop();
            }
        }
        commands.retain(|(_, command)| !command.trim().is_empty() && !command.trim_start().starts_with('#'));
        commands
    }
}

/// Returns the code blocks of a page, and its commands in back-ticks.
fn parse_page(text: &str) -> (Vec<Block>, Vec<(usize, String)>) {
    let (mut blocks, mut inline): (Vec<Block>, _) = (vec![], vec![]);
    let (mut next, mut paragraph, mut in_list) = (Block::default(), String::new(), false);
    let mut lines = (1..).zip(text.lines()).peekable();
    let mut after_blank = true;
    while let Some((number, line)) = lines.next() {
        let comment = line.trim().strip_prefix("<!--").and_then(|line| line.strip_suffix("-->")).map(str::trim);
        if let Some(comment) = comment {
            let value = |kind: &str| comment.strip_prefix(kind).map(|value| value.trim().to_string());
            next.not_run = value("not run:").or(next.not_run);
            next.short = value("short:").or(next.short);
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
fn flag_error(command: &str) -> Option<String> {
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
    let error = flotilla_cli::command().try_get_matches_from(words).err()?;
    let is_placeholder = |value: &str| {
        value.contains(['$', '{', '…']) || value.contains(char::is_uppercase) && !value.contains(char::is_lowercase)
    };
    match (error.kind(), error.get(ContextKind::InvalidValue)) {
        // A command inside a text may omit required arguments.
        (ErrorKind::DisplayHelp | ErrorKind::DisplayVersion | ErrorKind::MissingRequiredArgument, _) => None,
        (_, Some(ContextValue::String(value))) if is_placeholder(value) => None,
        _ => Some(error.to_string()),
    }
}

/// Returns the calls of the program in a line of shell script.
fn program_calls(line: &str) -> Vec<String> {
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

/// Returns the command with its flags replaced by `flags`, or extended with those that it takes.
fn shortened(command: &str, flags: &str) -> String {
    let mut command = command.split(" #").next().unwrap_or_default().trim_end().to_string();
    if !command.starts_with("flotilla ") {
        return command;
    }
    let words: Vec<&str> = flags.split_whitespace().collect();
    for flag in words.chunks(2) {
        let [name, value] = flag else { panic!("{flags}: not every flag has a value") };
        if !name.starts_with('-') {
            command =
                command.split(' ').map(|word| if word == *name { value } else { word }).collect::<Vec<_>>().join(" ");
            continue;
        }
        let before = command.clone();
        let mut parts: Vec<&str> = before.split(' ').collect();
        let place = parts.iter().position(|part| part == name);
        match place {
            Some(place) => parts[place + 1] = value,
            None => parts.extend([name, value]),
        }
        let after = parts.join(" ");
        if place.is_some() || flag_error(&after).is_none() {
            command = after;
        }
    }
    command
}

/// Runs a command with `bash`. Returns what it printed, as an error if it failed.
fn run(command: &str, folder: &Path) -> Result<String, String> {
    let log = folder.join(".log");
    let output = fs::File::create(&log).unwrap();
    let mut bash = support::shell("bash", command);
    bash.current_dir(folder).stdin(Stdio::null());
    let mut child = bash.stderr(output.try_clone().unwrap()).stdout(output).spawn().unwrap();
    let start = Instant::now();
    let status = loop {
        match child.try_wait().unwrap() {
            Some(status) => break status.to_string(),
            None if start.elapsed() > TIME_LIMIT => {
                let _ = child.kill();
                let _ = child.wait();
                break format!("killed after {TIME_LIMIT:?}");
            }
            None => std::thread::sleep(Duration::from_millis(5)),
        }
    };
    let printed = fs::read_to_string(&log).unwrap_or_default();
    if status == "exit status: 0" { Ok(printed) } else { Err(format!("{status}\n{printed}")) }
}

/// Returns the first line of an output block that is missing from the printed lines, in their order.
fn not_printed<'a>(block: &'a Block, printed: &str) -> Option<&'a (usize, String)> {
    let mut printed = printed.lines();
    let matches = |line: &str, shown: &str| {
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
    block.lines.iter().find(|(_, shown)| !shown.trim().is_empty() && !printed.any(|line| matches(line, shown)))
}

/// The results of a page's commands.
#[derive(Default)]
struct PageResult {
    ran: usize,
    parsed: usize,
    left_out: Vec<String>,
    failed: Vec<String>,
}

fn check_page(name: &str, text: &str) -> PageResult {
    let folder: TempDir = tempfile::tempdir().unwrap();
    for configs in ["configs", "studies/configs"] {
        support::copy(&Path::new(crate::ROOT).join(configs), &folder.path().join(configs));
    }
    let mut result = PageResult::default();
    let (blocks, inline) = parse_page(text);
    let parse = |result: &mut PageResult, number: usize, command: &str| {
        result.parsed += 1;
        if let Some(error) = flag_error(command) {
            result.failed.push(format!("{name}:{number}: {command}\n{error}"));
        }
    };
    inline.iter().for_each(|(number, command)| parse(&mut result, *number, command));
    let (mut broken, mut printed, mut after_python) = (false, String::new(), false);
    for block in blocks {
        // The Python package's tests run Python blocks and compare their output.
        after_python = block.language == "python" || after_python && block.output;
        if block.output && !broken && !after_python {
            if let Some((number, line)) = not_printed(&block, &printed) {
                result.failed.push(format!(
                    "{name}:{number}: {line}\nwas not printed by the last command, which printed:\n{printed}"
                ));
            }
            continue;
        }
        let text = || block.lines.iter().map(|(_, line)| line.clone() + "\n").collect::<String>();
        match &*block.language {
            "toml" => {
                let line = block.lines.first().map_or(0, |(number, _)| *number);
                if let Err(error) = text().parse::<toml::Table>() {
                    result.failed.push(format!("{name}:{line}: not TOML: {error}"));
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
                program_calls(&command).iter().for_each(|call| parse(&mut result, number, call));
                result.left_out.push(format!("{name}:{number}: {command}  ({why})"));
            } else if !broken {
                result.ran += 1;
                let command = block.short.as_ref().map_or(command.clone(), |flags| shortened(&command, flags));
                match run(&command, folder.path()) {
                    Ok(output) => printed = output,
                    Err(output) => {
                        result.failed.push(format!("{name}:{number}: {command}\n{output}"));
                        // Later commands may depend on this one, so they are not run.
                        broken = true;
                    }
                }
            }
        }
    }
    result
}

#[test]
fn every_command_on_the_pages_works() {
    let (mut failed, mut summary) = (Vec::new(), String::new());
    let mut ran = 0;
    let only = std::env::var("FLOTILLA_PAGE").unwrap_or_default();
    let name = |page: &PathBuf| page.strip_prefix(crate::ROOT).unwrap().display().to_string();
    let chosen: Vec<PathBuf> = pages().into_iter().filter(|page| name(page).contains(&only)).collect();
    // Each page has a directory of its own.
    let results: Vec<PageResult> =
        chosen.par_iter().map(|page| check_page(&name(page), &fs::read_to_string(page).unwrap())).collect();
    for (page, mut result) in chosen.iter().zip(results) {
        ran += result.ran;
        summary += &format!(
            "{}: {} commands run, {} only parsed, {} left out\n",
            name(page),
            result.ran,
            result.parsed,
            result.left_out.len()
        );
        result.left_out.iter().for_each(|line| summary += &format!("  left out {line}\n"));
        failed.append(&mut result.failed);
    }
    // Written to the stream directly, because the output of `eprintln!` in a passing test is hidden.
    write!(std::io::stderr(), "\n{summary}").unwrap();
    assert!(failed.is_empty(), "{} commands of the pages fail:\n\n{}", failed.len(), failed.join("\n\n"));
    assert!(ran >= 100 || !only.is_empty(), "only {ran} commands were found");
}

#[test]
fn failures_are_reported_with_page_and_line() {
    let page = "# Page\n\n`few.toml` is\n\n```toml\n[x]\n```\n\n```\ncat few.toml # it is there\n\
                true \\\n  && ls configs\nflotilla chekc x\n```\n\n    false\n\n<!-- not run: WHY -->\n\n\
                ```\nflotilla check --sed 1\n```\n\
                Text `flotilla train CONFIG --trials N`, `flotilla plot --ot x`.\n\n```text\nno command\n```\n";
    let PageResult { ran, failed, left_out, parsed } = check_page("p.md", page);
    assert_eq!((ran, parsed), (3, 3), "{failed:?}");
    assert_eq!(left_out, ["p.md:21: flotilla check --sed 1  (WHY)"]);
    let places: Vec<_> = failed.iter().map(|failed| failed.lines().next().unwrap()).collect();
    let expected = ["p.md:23: flotilla plot --ot x", "p.md:13: flotilla chekc x", "p.md:21: flotilla check --sed 1"];
    assert_eq!(places, expected, "{failed:?}");
    assert!(failed[1].contains("exit status: 2\n") && failed[1].contains("chekc"), "{failed:?}");
}

#[test]
fn short_flags_replace_or_extend_those_of_a_command() {
    let flags = "--trials 2 --population 20";
    let short = |command| shortened(command, flags);
    assert_eq!(short("flotilla paper --trials 200 --out a # b"), "flotilla paper --trials 2 --out a");
    assert_eq!(short("flotilla train c.toml --population 5000"), "flotilla train c.toml --population 20 --trials 2");
    assert_eq!(short("flotilla compare a --csv"), "flotilla compare a --csv");
    let words = shortened("flotilla tasks a/*.toml --out b", "a/*.toml a/c.toml d e");
    assert_eq!(words, "flotilla tasks a/c.toml --out b");
    let page = "<!-- short: --teams 2 -->\n```\nfalse\n```\n";
    assert_eq!(check_page("p.md", page).failed.len(), 1);
}

#[test]
fn output_of_python_blocks_is_not_compared() {
    let page = "```\necho one\n```\n\n```python\nprint(2)\n```\n\n<!-- output -->\n\n```text\n2\n```\n";
    assert!(check_page("p.md", page).failed.is_empty());
    let page = page.replace("python\nprint(2)", "\necho two");
    assert_eq!(check_page("p.md", &page).failed.len(), 1);
}

#[test]
fn output_that_differs_is_reported() {
    let page = "```\nprintf 'one 1\\ntwo 2\\nthree 3\\n'\n```\n\n<!-- output -->\n\n```text\none 1\nth…3\n```\n";
    assert!(check_page("p.md", page).failed.is_empty());
    for (from, to) in [("one 1\nth…3", "th…3\none 1"), ("th…3", "th…4"), ("one 1\n", "one\n")] {
        let page =
            page.replace(&format!("text\n{}", "one 1\nth…3"), &format!("text\n{}", "one 1\nth…3".replace(from, to)));
        assert_eq!(check_page("p.md", &page).failed.len(), 1, "{page}");
    }
}

/// Returns the anchor that GitHub gives a heading.
fn anchor(heading: &str) -> String {
    let kept = heading.trim().to_lowercase();
    kept.chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c)).map(|c| if c == ' ' { '-' } else { c }).collect()
}

/// Returns the relative links of a page whose file or anchor does not exist.
fn broken_links(page: &Path) -> Vec<String> {
    let anchors = |text: &str| -> Vec<String> {
        text.lines().filter(|line| line.starts_with('#')).map(|line| anchor(line.trim_start_matches('#'))).collect()
    };
    // Comments that start with `site:` appear only on the site. `tests/site.py` checks their links.
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
fn every_relative_link_has_a_target() {
    let root = Path::new(crate::ROOT);
    let others = [
        "CHANGELOG.md",
        "python/README.md",
        "benches/README.md",
        "benches/static-figures.md",
        "benches/log-tables.md",
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

/// Reads a file of comma-separated values.
fn read_csv(path: std::path::PathBuf) -> Vec<BTreeMap<String, String>> {
    csv::Reader::from_path(path).unwrap().deserialize().map(Result::unwrap).collect()
}

/// Every line of the tables on swarms is in the published files.
#[test]
fn the_page_on_swarms_agrees_with_its_files() {
    let folder = crate::support::root("docs/results");
    let page = fs::read_to_string(folder.join("swarms.md")).unwrap();
    let number = |row: &BTreeMap<String, String>, key: &str| row[key].parse::<f64>().unwrap();
    for row in read_csv(folder.join("swarms/baselines.csv")) {
        let keys = ["constant_speed", "random_networks", "random_shared_networks", "hill_climbing"];
        let cells = keys.map(|key| format!("{:.2}", number(&row, key))).join(" | ");
        let line = format!("| {} | {cells} |", row["followers_per_leader"]);
        assert!(page.contains(&line), "{line}");
    }
    let rows = read_csv(folder.join("swarms/champions.csv"));
    for means in rows.iter().filter(|row| row["other"].is_empty()).collect::<Vec<_>>().chunks(4) {
        let cell = |row: &&BTreeMap<String, String>| {
            let [g, low, high] = ["value", "low", "high"].map(|key| number(row, key));
            format!("{g:.2} [{low:.2}, {high:.2}]")
        };
        let cells = means.iter().map(cell).collect::<Vec<_>>().join(" | ");
        let trials = &means[0]["trials"];
        let trials = if trials == "10" { String::new() } else { format!(", {trials} trials") };
        let line = format!("| {}{trials} | {cells} |", means[0]["followers_per_leader"]);
        assert!(page.contains(&line), "{line}");
    }
    let p = |arm: &str, other: &str| {
        let is = |row: &&BTreeMap<String, String>| {
            row["trials"] == "10" && row["arm"].starts_with(arm) && row["other"].starts_with(other)
        };
        let pairs = rows.iter().filter(is).filter(|row| row["arm"].ends_with("none") && row["other"].ends_with("none"));
        pairs.map(|row| number(row, "p_holm")).collect::<Vec<_>>()
    };
    assert!(p("fitness G,", "fitness Df,").iter().all(|&p| p >= 0.07));
    assert!(p("fitness G,", "fitness D,")[2..].iter().all(|&p| p < 0.05));

    let teams = read_csv(folder.join("swarms/one_leader.csv"));
    for followers in teams.iter().filter(|row| row["team"] == "champion" && row["seed"] == "0") {
        let followers = &followers["followers"];
        let of = |team: &str| {
            let of_cell = teams.iter().filter(|row| row["followers"] == *followers && row["team"] == team);
            of_cell.map(|row| number(row, "g")).collect::<Vec<_>>()
        };
        let cells = ["champion", "constant", "network", "hill_climbing"].map(|team| match &of(team)[..] {
            [] => String::new(),
            g => format!(" {:.2}", g.iter().sum::<f64>() / g.len() as f64),
        });
        let trials = of("champion").len();
        let trials = if trials == 10 { String::new() } else { format!(", {trials} trials") };
        let line = format!("| {followers}{trials} |{} |", cells.join(" |"));
        assert!(page.contains(&line), "{line}");
    }
}

#[test]
fn the_page_on_herding_agrees_with_its_file() {
    let folder = crate::support::root("docs/results");
    let page = fs::read_to_string(folder.join("herding.md")).unwrap();
    let trials = read_csv(folder.join("herding/test_g.csv"));
    assert_eq!(trials.len(), 250);
    for dogs in ["1", "2", "4", "8", "16"] {
        let cells = ["5", "10", "20", "40", "80"].map(|sheep| {
            let of_cell = trials.iter().filter(|row| row["dogs"] == dogs && row["sheep"] == sheep);
            let g: Vec<f64> = of_cell.map(|row| row["test_g"].parse().unwrap()).collect();
            format!("{:.2}", g.iter().sum::<f64>() / g.len() as f64)
        });
        let line = format!("| {dogs} | {} |", cells.join(" | "));
        assert!(page.contains(&line), "{line}");
    }
    let best = trials.iter().map(|row| row["test_g"].parse::<f64>().unwrap()).fold(0.0, f64::max);
    assert!(page.contains(&format!("the best of 250 trained teams reaches {best:.2}")), "{best}");
}

/// Every cell of the tables on rovers and UAVs is in the published files. No pair of credits differs at fixed places, and all of
/// four do where POIs are drawn anew.
#[test]
fn the_page_on_rovers_and_uavs_agrees_with_its_files() {
    let folder = crate::support::root("docs/results");
    let page = fs::read_to_string(folder.join("influence.md")).unwrap();
    let read = |name: String| read_csv(folder.join("influence").join(name));
    let layouts = ["rover_uav", "3_rovers_1_uav", "3_rovers_3_uavs", "4_rovers_4_uavs"];
    let tables: Vec<_> = layouts.iter().map(|layout| read(format!("{layout}.csv"))).collect();
    let rule = |rule: &'static str| ("Dt", rule);
    let credits = [
        ("G", "alone"),
        ("D", "alone"),
        ("Df", "alone"),
        rule("any-seen"),
        rule("first"),
        rule("alone"),
        rule("anyone"),
    ];
    for (fitness, led_by) in credits {
        let cells = tables.iter().map(|rows| {
            let is = |row: &&BTreeMap<String, String>| {
                row["learning.fitness"] == fitness && row["credit.led_by"] == led_by && row["trials"] == "30"
            };
            let row = rows.iter().find(is).unwrap_or_else(|| panic!("{fitness}, {led_by}"));
            let [g, low, high] =
                ["champion_g", "champion_g_low", "champion_g_high"].map(|key| row[key].parse::<f64>().unwrap());
            format!("{g:.2} [{low:.2}, {high:.2}]")
        });
        let name = if fitness == "Dt" { format!("Dt, `{led_by}`") } else { fitness.into() };
        let line = format!("| {name} | {} |", cells.collect::<Vec<_>>().join(" | "));
        assert!(page.contains(&line), "{line}");
    }
    let (mut pairs, mut uncorrected) = (0, 0);
    for layout in layouts {
        for row in read(format!("{layout}_pairs.csv")) {
            assert!(row["p_holm"].parse::<f64>().unwrap() >= 0.05, "{layout}: {row:?}");
            uncorrected += usize::from(row["p"].parse::<f64>().unwrap() < 0.05);
            pairs += 1;
        }
    }
    assert_eq!((pairs, uncorrected), (84, 1));
    let large = read("3_rovers_3_uavs_2000.csv".into());
    let range = |values: &mut dyn Iterator<Item = f64>| values.fold([1.0, 0.0], |[a, b], g| [g.min(a), g.max(b)]);
    let [least, most] = range(&mut large.iter().map(|row| row["champion_g"].parse().unwrap()));
    assert!(page.contains(&format!("champions of 30 trials reach {least:.2} to {most:.2}")), "{least} {most}");
    let reached = large.iter().map(|row| (&*row["learning.fitness"], &*row["credit.led_by"], &*row["reached"]));
    let reached: Vec<_> = reached.filter(|(fitness, led_by, _)| *fitness != "Dt" || *led_by != "any-seen").collect();
    assert!(reached.len() == 6 && large.iter().all(|row| row["trials"] == "30"));
    assert!(reached.iter().all(|&(fitness, _, trials)| trials == if fitness == "Dt" { "7" } else { "0" }));
    let pairs = read("3_rovers_3_uavs_2000_pairs.csv".into());
    let [p, holm] = ["p", "p_holm"].map(|key| range(&mut pairs.iter().map(|row| row[key].parse().unwrap()))[0]);
    assert!(page.contains(&format!("the smallest p is {p:.3}, and {holm:.2} by Holm")) && holm >= 0.05, "{p} {holm}");
    let page = page + &fs::read_to_string(folder.join("influence-drawn.md")).unwrap();
    let studies = ["3_rovers_3_uavs_random_pairs.csv", "random_again.csv"].map(|name| read(name.into()));
    let near = read("near.csv".into());
    for (fitness, led_by) in credits {
        let arm = format!("led_by {led_by}, fitness {fitness}");
        let cells = studies.iter().map(|rows| {
            let row = rows.iter().find(|row| row["arm"] == arm && row["other"].is_empty()).unwrap();
            let [g, low, high] = ["value", "low", "high"].map(|key| row[key].parse::<f64>().unwrap());
            format!("{g:.2} [{low:.2}, {high:.2}]")
        });
        let share = near.iter().find(|row| row["fitness"] == fitness && row["led_by"] == led_by).unwrap();
        let name = if fitness == "Dt" { format!("Dt, `{led_by}`") } else { fitness.into() };
        let cells = cells.collect::<Vec<_>>().join(" | ");
        let line = format!("| {name} | {cells} | {:.2} |", share["share"].parse::<f64>().unwrap());
        assert!(page.contains(&line), "{line}");
    }
    let four = ["Dt", "G", "D", "Df"].map(|fitness| format!("led_by alone, fitness {fitness}"));
    let is_of_four = |row: &&BTreeMap<String, String>| four.contains(&row["arm"]) && four.contains(&row["other"]);
    let pairs: Vec<_> = studies[1].iter().filter(is_of_four).collect();
    assert!(pairs.len() == 6 && pairs.iter().all(|row| row["p_holm"].parse::<f64>().unwrap() < 0.05));
    let baselines = read("baselines.csv".into());
    for (layout, baseline, g) in [
        ("3_rovers_3_uavs_random", "open-loop actions", "0.88"),
        ("3_rovers_3_uavs_random", "random networks", "0.28"),
        ("3_rovers_3_uavs_random", "hill climbing", "0.31"),
        ("3_rovers_3_uavs", "random networks", "0.56"),
        ("4_rovers_4_uavs", "random networks", "0.59"),
        ("3_rovers_3_uavs", "hill climbing", "0.71"),
        ("4_rovers_4_uavs", "hill climbing", "0.64"),
    ] {
        let row = baselines.iter().find(|row| row["layout"] == layout && row["baseline"] == baseline).unwrap();
        assert_eq!(format!("{:.2}", row["g"].parse::<f64>().unwrap()), g, "{layout}, {baseline}");
        assert!(page.contains(g), "{g}");
    }
}
