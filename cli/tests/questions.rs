//! Tests `flotilla paper --questions`, and that docs/results/questions-*-tables.md have its results.
//!
//! `cargo test --release questions:: -- --ignored` trains all questions in full. If results change on purpose, run
//! `flotilla paper --questions --out DIR`. Then `FLOTILLA_WRITE_QUESTIONS=DIR`, with the same command, writes the pages'
//! tables, figures and files again.

use std::fs;
use std::path::{Path, PathBuf};

use crate::support::Place;
use flotilla::statistics::Estimate;
use flotilla_app::report::comparison;
use flotilla_studies::questions::{END, QUESTIONS, Study, mark, parts};

/// Returns the block of a part in a page, with its marks.
fn block<'a>(page: &'a str, part: &Study) -> &'a str {
    let start = page.find(&mark(part.name)).unwrap_or_else(|| panic!("no {}", mark(part.name)));
    &page[start..start + page[start..].find(END).unwrap() + END.len()]
}

#[test]
fn a_short_form_of_the_study_writes_its_page_and_files() {
    let place = Place::new(&[]).on_cpu().slow();
    let short = "paper --questions=a,b,c,d,f,g --trials 2 --generations 2 --out short";
    let (out, stderr) = place.good(short);
    assert!(stderr.contains("training 126 experiments on "), "{stderr}");
    let page = place.read("short/questions.md");
    assert!(out.starts_with(&page), "{out}");
    let selected = parts(&['a', 'b', 'c', 'd', 'f', 'g']);
    for part in &selected {
        let block = block(&page, part);
        assert!(block.lines().count() > 4, "{block}");
        for ending in ["svg", "png", "pdf", "csv"] {
            let file = place.path("short").join(part.name).with_extension(ending);
            assert!(fs::metadata(&file).is_ok_and(|data| data.len() > 500), "{}", file.display());
        }
    }
    // Each part is an ordinary sweep, and `compare` gives the same numbers.
    let (compared, _) = place.good("compare short/relay_twice --csv");
    let saved = place.read("short/relay_twice.csv");
    let columns = |text: &str| -> Vec<Vec<String>> {
        let rows = text.lines().skip(1).map(|line| line.split(',').skip(6).map(String::from).collect());
        rows.collect()
    };
    assert_eq!(columns(&compared), columns(&saved));
    // Warm starts begin with learned policies. Champions are scored with moved POIs, too.
    let warm = |name: &str| place.read(format!("short/warm/warm/{name}/run.json"));
    assert!(warm("0000-0").contains("\"init\"") && warm("0001-2").contains("\"init\""));
    assert!(block(&page, selected.last().unwrap()).contains("POIs moved by up to 5"), "{page}");

    assert_eq!(place.good(&format!("{short} --resume --quiet")).0, out);
    place.fails(1, &format!("{short} --quiet"), &["--resume"]);
    place.fails(1, &format!("{short} --quiet --resume --seed 4"), &["holds another sweep"]);

    // The results of another question are not replaced. A study without results yet may take more questions.
    let mixed = |letters: &str| format!("paper --questions={letters} --trials 2 --generations 2 --out mixed --quiet");
    place.good(&mixed("d"));
    place.fails(1, &mixed("b"), &["mixed holds observers.svg already; pass --resume"]);
    let files = fs::read_dir(place.path("mixed")).unwrap().map(|entry| entry.unwrap().path());
    files.filter(|path| path.is_file()).for_each(|path| fs::remove_file(path).unwrap());
    // An error in one part is reported before any part is trained.
    place.fails(1, &mixed("b,d"), &["--resume"]);
    assert!(!place.path("mixed/behaviours/points").exists());

    // Curricula have stages, so they need more generations.
    let json = place.json("paper --questions=e --trials 2 --generations 60 --out e --quiet --json");
    assert_eq!(json["questions"][0]["comparisons"].as_array().unwrap().len(), 6);
    place.fails(2, "paper --questions=e,x", &["allowed a, b, c, d, e, f, g"]);
    place.fails(1, "paper --questions=e --out e/curricula", &["holds a sweep"]);
}

#[test]
fn a_refused_resume_leaves_a_paper_that_can_be_resumed() {
    let place = Place::new(&[]).on_cpu().slow();
    let paper = "paper --trials 1 --quiet --resume --out paper --set learning.population";
    place.good(&format!("{paper}=12 --generations 1"));
    place.fails(1, &format!("{paper}=14 --generations 2"), &["a run of another config"]);
    place.good(&format!("{paper}=12 --generations 1"));
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
    let place = Place::new(&[]).on_cpu().slow();
    let (out, _) = place.good("paper --questions --quiet --out all");
    for (part, path) in parts_and_pages() {
        assert_eq!(
            block(&fs::read_to_string(&path).unwrap(), part),
            block(&out, part),
            "{}; see the head of cli/tests/questions.rs",
            path.display()
        );
        for ending in ["svg", "csv"] {
            let expected = results_file(&file_name(part, ending));
            let actual = place.path("all").join(part.name).with_extension(ending);
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
