//! `flotilla paper --questions`: a short form of all of it, and that docs/results/questions-tables.md tells what comes out.
//!
//! One question is trained in full; `FLOTILLA_LONG=1` trains all. Where results change on purpose, the page's tables and
//! figures are written anew from what `flotilla paper --questions --out DIR` made by
//! `FLOTILLA_WRITE_QUESTIONS=DIR cargo test --test questions`.

#![cfg(feature = "cli")]

mod support;

use std::fs;
use std::path::{Path, PathBuf};

use assert_cmd::cargo::cargo_bin_cmd;
use flotilla::report::comparison;
use flotilla::statistics::Estimate;
use flotilla::sweep::questions::{END, QUESTIONS, Study, mark, parts};
use tempfile::TempDir;

fn run(folder: &Path, line: &str) -> (Option<i32>, String, String) {
    let line = format!("paper {line} --backend cpu");
    let output = cargo_bin_cmd!("flotilla").args(line.split_whitespace()).current_dir(folder).output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

fn good(folder: &Path, line: &str) -> String {
    let (code, out, told) = run(folder, line);
    assert_eq!(code, Some(0), "{line}: {told}");
    out
}

/// The text of a part in a page, with its marks.
fn block<'a>(page: &'a str, part: &Study) -> &'a str {
    let start = page.find(&mark(part.name)).unwrap_or_else(|| panic!("no {}", mark(part.name)));
    &page[start..start + page[start..].find(END).unwrap() + END.len()]
}

#[test]
fn few_trials_of_every_question_come_to_a_page() {
    let place = TempDir::new().unwrap();
    let folder = place.path();
    let short = "--questions=a,b,c,d,f,g --trials 2 --generations 2 --out short";
    let (code, out, told) = run(folder, short);
    assert_eq!(code, Some(0), "{told}");
    assert!(told.contains("training 126 experiments on "), "{told}");
    let page = fs::read_to_string(folder.join("short/questions.md")).unwrap();
    assert!(out.starts_with(&page), "{out}");
    let asked = parts(&['a', 'b', 'c', 'd', 'f', 'g']);
    for part in &asked {
        let block = block(&page, part);
        assert!(block.lines().count() > 4, "{block}");
        for ending in ["svg", "png", "pdf", "csv"] {
            let file = folder.join("short").join(part.name).with_extension(ending);
            assert!(fs::metadata(&file).is_ok_and(|data| data.len() > 500), "{}", file.display());
        }
    }
    // Each part is a sweep like any other, and compares as one.
    let line = "compare short/relay_twice --csv";
    let compared = cargo_bin_cmd!("flotilla").args(line.split_whitespace()).current_dir(folder).output().unwrap();
    let compared = String::from_utf8(compared.stdout).unwrap();
    let ours = fs::read_to_string(folder.join("short/relay_twice.csv")).unwrap();
    let numbers = |text: &str| -> Vec<Vec<String>> {
        let rows = text.lines().skip(1).map(|line| line.split(',').skip(6).map(String::from).collect());
        rows.collect()
    };
    assert_eq!(numbers(&compared), numbers(&ours));
    // Warm starts are from what was learned, champions play where they did not learn.
    let warm = |name: &str| fs::read_to_string(folder.join("short/warm/warm").join(name).join("run.json")).unwrap();
    assert!(warm("0000-0").contains("\"init\"") && warm("0001-2").contains("\"init\""));
    assert!(block(&page, asked.last().unwrap()).contains("POIs moved by up to 5"), "{page}");

    assert_eq!(good(folder, &format!("{short} --resume --quiet")), out);
    let (code, _, told) = run(folder, &format!("{short} --quiet"));
    assert!(code == Some(1) && told.contains("--resume"), "{told}");
    let (code, _, told) = run(folder, &format!("{short} --quiet --resume --seed 4"));
    assert!(code == Some(1) && told.contains("holds another sweep"), "{told}");

    // What cannot be had is told before any part is trained.
    good(folder, "--questions=d --trials 2 --generations 2 --out mixed --quiet");
    let (code, _, told) = run(folder, "--questions=b,d --trials 2 --generations 2 --out mixed --quiet");
    assert!(code == Some(1) && told.contains("--resume") && !folder.join("mixed/behaviours/points").exists(), "{told}");

    // Curricula take their stages.
    let json = good(folder, "--questions=e --trials 2 --generations 60 --out e --quiet --json");
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!(json["questions"][0]["comparisons"].as_array().unwrap().len(), 6);
    let (code, _, told) = run(folder, "--questions=e,x");
    assert!(code == Some(2) && told.contains("allowed a, b, c, d, e, f, g"), "{told}");
    let (code, _, told) = run(folder, "--questions=e --out e/curricula");
    assert!(code == Some(1) && told.contains("holds a sweep"), "{told}");
}

fn docs(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/results").join(name)
}

fn named(part: &Study, ending: &str) -> String {
    format!("questions/{}.{ending}", part.name)
}

#[test]
fn the_page_tells_what_comes_out() {
    let page = fs::read_to_string(docs("questions-tables.md")).unwrap();
    if let Some(made) = std::env::var_os("FLOTILLA_WRITE_QUESTIONS").map(PathBuf::from) {
        let there = fs::read_to_string(made.join("questions.md")).unwrap();
        let mut page = page;
        for part in QUESTIONS.iter().flat_map(|question| question.parts) {
            page = page.replace(block(&page, part), block(&there, part));
            for ending in ["svg", "csv"] {
                fs::copy(made.join(part.name).with_extension(ending), docs(&named(part, ending))).unwrap();
            }
        }
        return fs::write(docs("questions-tables.md"), page).unwrap();
    }
    let long = std::env::var("FLOTILLA_LONG").is_ok_and(|long| long == "1");
    let letters = if long { vec!['a', 'b', 'c', 'd', 'e', 'f', 'g'] } else { vec!['g'] };
    let place = TempDir::new().unwrap();
    let list: Vec<String> = letters.iter().map(char::to_string).collect();
    let out = good(place.path(), &format!("--questions={} --quiet --out all", list.join(",")));
    for part in QUESTIONS.iter().filter(|asked| letters.contains(&asked.letter)).flat_map(|asked| asked.parts) {
        assert_eq!(
            block(&page, part),
            block(&out, part),
            "docs/results/questions-tables.md; see the head of tests/questions.rs"
        );
        for ending in ["svg", "csv"] {
            let [there, here] =
                [docs(&named(part, ending)), place.path().join("all").join(part.name).with_extension(ending)];
            assert!(fs::read(&there).unwrap() == fs::read(&here).unwrap(), "{}", there.display());
        }
    }
}

/// Also of the questions that are not trained anew: tables, figures and files are of one run.
#[test]
fn the_pages_tables_are_those_of_its_files() {
    let page = fs::read_to_string(docs("questions-tables.md")).unwrap();
    for part in QUESTIONS.iter().flat_map(|question| question.parts) {
        let (block, mut told) = (block(&page, part), 0);
        let mut table = csv::Reader::from_path(docs(&named(part, "csv"))).unwrap();
        for row in table.records().map(Result::unwrap) {
            let field = |at: usize| row.get(at).unwrap();
            let number = |at: usize| field(at).parse::<f64>().unwrap();
            assert_eq!(field(6), "30", "trials");
            if !field(5).is_empty() || !["best_g", "fixed_pois_g", "moved_pois_g"].contains(&field(1)) {
                continue;
            }
            let [value, low, high] = [8, 9, 10].map(number);
            let mean = comparison::estimate(Estimate { value, low, high }, 3, false);
            assert!(block.contains(&mean), "{}: {mean}", part.name);
            told += 1;
        }
        assert!(told >= 4, "{}", part.name);
        assert!(page.contains(&format!("]({})", named(part, "svg"))), "{}", part.name);
        assert!(fs::read_to_string(docs(&named(part, "svg"))).unwrap().contains(part.title));
    }
}
