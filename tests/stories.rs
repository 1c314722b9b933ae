//! The paper's claims (Sections 1, 5 and 6, Figures 4 to 6) over thirty trials: tables in docs/results/claims.md and
//! docs/results/claims-measured.md are what comes out, verdict by verdict, whether the paper's claims hold or not.
//!
//! Where results change on purpose, `FLOTILLA_WRITE_CLAIMS=1 cargo test --test stories` writes the tables anew.

#![cfg(feature = "cli")]

use std::fs;
use std::path::Path;

use flotilla::backend::cpu::Cpu;
use flotilla::baseline::Baselines;
use flotilla::config::{Override, ValidConfig};
use flotilla::report::paper::{self, Evidence, claims, tables};
use flotilla::trainer::Row;
use flotilla::trainer::Trainer;

const TRIALS: u32 = 30;
const SEED: u32 = 777;

#[test]
fn the_pages_tell_what_comes_out() {
    let set = |key: &str, value: u32| Override::new(key, value, key);
    let mut arms = paper::arms(&[set("learning.trials", TRIALS), set("learning.seed", SEED)]).unwrap();
    let learning = arms[0].config.learning.clone();
    assert_eq!((learning.population, learning.generations), (50, 100));
    let (configs, places) = paper::trained(&arms);
    let (mut trainer, mut backend) = (Trainer::new(ValidConfig::all(&configs).unwrap()), Cpu::default());
    for row in trainer.finish(&mut backend).unwrap() {
        let of = (0..arms.len()).filter(|&arm| places[arm] == row.arm);
        of.for_each(|arm| arms[arm].add(&Row { arm, ..row }));
    }
    let mut baselines = Baselines::new(paper::grounds(&arms));
    while !baselines.is_done() {
        baselines.advance(&mut backend).unwrap();
    }
    let baselines = baselines.found();
    let results = Evidence { arms: &arms, baselines: &baselines };
    let claims = claims::claims(results);
    let (baseline, heading) = (tables::without_learning(results), tables::heading(&learning, &claims));
    let first_page = format!("{baseline}\n{heading}\n\n{}", tables::verdicts(&claims));
    println!("{first_page}");
    let all = format!("{heading}\n\n{}", tables::full(&claims));
    holds("docs/results/claims.md", &first_page);
    holds("docs/results/claims-measured.md", &all);
}

/// Fails unless a page has this between its marks, or puts it there if that is asked for.
fn holds(page: &str, text: &str) {
    const MARKS: [&str; 2] = ["<!-- what comes out: cargo test --test stories -->\n", "<!-- so far -->\n"];
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(page);
    let whole = fs::read_to_string(&path).unwrap();
    let (before, rest) = whole.split_once(MARKS[0]).unwrap_or_else(|| panic!("{page} has no {:?}", MARKS[0]));
    let (there, after) = rest.split_once(MARKS[1]).unwrap_or_else(|| panic!("{page} has no {:?}", MARKS[1]));
    let here = format!("\n{text}\n");
    if std::env::var_os("FLOTILLA_WRITE_CLAIMS").is_some() {
        fs::write(&path, [before, MARKS[0], &here, MARKS[1], after].concat()).unwrap();
    } else if there != here {
        let differs = there.lines().zip(here.lines()).find(|(there, here)| there != here);
        panic!(
            "{page} does not tell what comes out; there, and here: {differs:#?}\n(see the head of tests/stories.rs)"
        );
    }
}
