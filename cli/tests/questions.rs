//! Tests `flotilla paper --questions`, and that docs/results/questions-*-tables.md have its results.
//!
//! `cargo test --release questions:: -- --ignored` trains all questions in full. If results change on purpose, run
//! `flotilla paper --questions --out DIR`. Then `FLOTILLA_WRITE_QUESTIONS=DIR`, with the same command, writes the pages'
//! tables, figures and files again.

use std::fs;
use std::path::{Path, PathBuf};

use assert_cmd::cargo::cargo_bin_cmd;
use flotilla::statistics::Estimate;
use flotilla_app::report::comparison;
use flotilla_studies::questions::{END, QUESTIONS, Study, mark, parts};
use tempfile::TempDir;

fn run_paper(folder: &Path, line: &str) -> (Option<i32>, String, String) {
    let line = format!("paper {line} --backend cpu");
    let output = cargo_bin_cmd!("flotilla").args(line.split_whitespace()).current_dir(folder).output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

fn succeed(folder: &Path, line: &str) -> String {
    let (code, out, stderr) = run_paper(folder, line);
    assert_eq!(code, Some(0), "{line}: {stderr}");
    out
}

/// Returns the block of a part in a page, with its marks.
fn block<'a>(page: &'a str, part: &Study) -> &'a str {
    let start = page.find(&mark(part.name)).unwrap_or_else(|| panic!("no {}", mark(part.name)));
    &page[start..start + page[start..].find(END).unwrap() + END.len()]
}

#[test]
fn a_short_form_of_the_study_writes_its_page_and_files() {
    let place = TempDir::new().unwrap();
    let folder = place.path();
    let short = "--questions=a,b,c,d,f,g --trials 2 --generations 2 --out short";
    let (code, out, stderr) = run_paper(folder, short);
    assert_eq!(code, Some(0), "{stderr}");
    assert!(stderr.contains("training 126 experiments on "), "{stderr}");
    let page = fs::read_to_string(folder.join("short/questions.md")).unwrap();
    assert!(out.starts_with(&page), "{out}");
    let selected = parts(&['a', 'b', 'c', 'd', 'f', 'g']);
    for part in &selected {
        let block = block(&page, part);
        assert!(block.lines().count() > 4, "{block}");
        for ending in ["svg", "png", "pdf", "csv"] {
            let file = folder.join("short").join(part.name).with_extension(ending);
            assert!(fs::metadata(&file).is_ok_and(|data| data.len() > 500), "{}", file.display());
        }
    }
    // Each part is an ordinary sweep, and `compare` gives the same numbers.
    let line = "compare short/relay_twice --csv";
    let compared = cargo_bin_cmd!("flotilla").args(line.split_whitespace()).current_dir(folder).output().unwrap();
    let compared = String::from_utf8(compared.stdout).unwrap();
    let saved = fs::read_to_string(folder.join("short/relay_twice.csv")).unwrap();
    let columns = |text: &str| -> Vec<Vec<String>> {
        let rows = text.lines().skip(1).map(|line| line.split(',').skip(6).map(String::from).collect());
        rows.collect()
    };
    assert_eq!(columns(&compared), columns(&saved));
    // Warm starts begin with learned policies. Champions are scored with moved POIs, too.
    let warm = |name: &str| fs::read_to_string(folder.join("short/warm/warm").join(name).join("run.json")).unwrap();
    assert!(warm("0000-0").contains("\"init\"") && warm("0001-2").contains("\"init\""));
    assert!(block(&page, selected.last().unwrap()).contains("POIs moved by up to 5"), "{page}");

    assert_eq!(succeed(folder, &format!("{short} --resume --quiet")), out);
    let (code, _, stderr) = run_paper(folder, &format!("{short} --quiet"));
    assert!(code == Some(1) && stderr.contains("--resume"), "{stderr}");
    let (code, _, stderr) = run_paper(folder, &format!("{short} --quiet --resume --seed 4"));
    assert!(code == Some(1) && stderr.contains("holds another sweep"), "{stderr}");

    // The results of another question are not replaced. A study without results yet may take more questions.
    succeed(folder, "--questions=d --trials 2 --generations 2 --out mixed --quiet");
    let (code, _, stderr) = run_paper(folder, "--questions=b --trials 2 --generations 2 --out mixed --quiet");
    assert!(code == Some(1) && stderr.contains("mixed holds observers.svg already; pass --resume"), "{stderr}");
    let files = fs::read_dir(folder.join("mixed")).unwrap().map(|entry| entry.unwrap().path());
    files.filter(|path| path.is_file()).for_each(|path| fs::remove_file(path).unwrap());
    // An error in one part is reported before any part is trained.
    let (code, _, stderr) = run_paper(folder, "--questions=b,d --trials 2 --generations 2 --out mixed --quiet");
    assert!(
        code == Some(1) && stderr.contains("--resume") && !folder.join("mixed/behaviours/points").exists(),
        "{stderr}"
    );

    // Curricula have stages, so they need more generations.
    let json = succeed(folder, "--questions=e --trials 2 --generations 60 --out e --quiet --json");
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!(json["questions"][0]["comparisons"].as_array().unwrap().len(), 6);
    let (code, _, stderr) = run_paper(folder, "--questions=e,x");
    assert!(code == Some(2) && stderr.contains("allowed a, b, c, d, e, f, g"), "{stderr}");
    let (code, _, stderr) = run_paper(folder, "--questions=e --out e/curricula");
    assert!(code == Some(1) && stderr.contains("holds a sweep"), "{stderr}");
}

#[test]
fn a_refused_resume_leaves_a_paper_that_can_be_resumed() {
    let place = TempDir::new().unwrap();
    let paper = "--trials 1 --quiet --resume --out paper --set learning.population";
    succeed(place.path(), &format!("{paper}=12 --generations 1"));
    let (code, _, stderr) = run_paper(place.path(), &format!("{paper}=14 --generations 2"));
    assert!(code == Some(1) && stderr.contains("a run of another config"), "{stderr}");
    succeed(place.path(), &format!("{paper}=12 --generations 1"));
}

fn results_file(name: &str) -> PathBuf {
    Path::new(crate::ROOT).join("docs/results").join(name)
}

/// Returns every part with the page that has its tables.
fn parts_and_pages() -> impl Iterator<Item = (&'static Study, PathBuf)> {
    QUESTIONS.iter().flat_map(|question| {
        let page = results_file(&format!("questions-{}-tables.md", question.letter));
        question.parts.iter().map(move |part| (part, page.clone()))
    })
}

fn file_name(part: &Study, ending: &str) -> String {
    format!("questions/{}.{ending}", part.name)
}

#[test]
#[ignore = "trains for minutes; .ci/nightly runs it"]
fn the_pages_equal_a_new_study() {
    if let Some(source) = std::env::var_os("FLOTILLA_WRITE_QUESTIONS").map(PathBuf::from) {
        let written = fs::read_to_string(source.join("questions.md")).unwrap();
        for (part, path) in parts_and_pages() {
            let page = fs::read_to_string(&path).unwrap();
            fs::write(path, page.replace(block(&page, part), block(&written, part))).unwrap();
            for ending in ["svg", "csv"] {
                fs::copy(source.join(part.name).with_extension(ending), results_file(&file_name(part, ending)))
                    .unwrap();
            }
        }
        return;
    }
    let place = TempDir::new().unwrap();
    let out = succeed(place.path(), "--questions --quiet --out all");
    for (part, path) in parts_and_pages() {
        assert_eq!(
            block(&fs::read_to_string(&path).unwrap(), part),
            block(&out, part),
            "{}; see the head of cli/tests/questions.rs",
            path.display()
        );
        for ending in ["svg", "csv"] {
            let [expected, actual] = [
                results_file(&file_name(part, ending)),
                place.path().join("all").join(part.name).with_extension(ending),
            ];
            assert!(fs::read(&expected).unwrap() == fs::read(&actual).unwrap(), "{}", expected.display());
        }
    }
}

/// Covers in short what the test above trains: tables, figures and files must belong to one run.
#[test]
fn the_pages_tables_agree_with_their_files() {
    for (part, path) in parts_and_pages() {
        let page = fs::read_to_string(path).unwrap();
        let (block, mut checked) = (block(&page, part), 0);
        let mut table = csv::Reader::from_path(results_file(&file_name(part, "csv"))).unwrap();
        for row in table.records().map(Result::unwrap) {
            let field = |at: usize| row.get(at).unwrap();
            let number = |at: usize| field(at).parse::<f64>().unwrap();
            assert_eq!(field(6), "30", "trials");
            if !field(5).is_empty() || !["champion_g", "fixed_pois_g", "moved_pois_g"].contains(&field(1)) {
                continue;
            }
            let [value, low, high] = [8, 9, 10].map(number);
            let mean = comparison::estimate(Estimate { value, low, high }, 3, false);
            assert!(block.contains(&mean), "{}: {mean}", part.name);
            checked += 1;
        }
        assert!(checked >= 4, "{}", part.name);
        assert!(page.contains(&format!("]({})", file_name(part, "svg"))), "{}", part.name);
        assert!(fs::read_to_string(results_file(&file_name(part, "svg"))).unwrap().contains(part.title));
    }
}
