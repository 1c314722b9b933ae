//! Whatever stands in a file, its reader neither panics nor hangs nor takes much memory.
//!
//! `FLOTILLA_FUZZ` is how many mutated inputs each reader gets (20 000 if left out).

#![cfg(feature = "cli")]

use std::fs;
use std::io::Cursor;
use std::time::{Duration, Instant};

use flotilla::backend::Machine;
use flotilla::backend::cpu::Cpu;
use flotilla::config::Config;
use flotilla::evolve::{MAX_WEIGHT, MIN_WEIGHT};
use flotilla::record::checkpoint::{self, Checkpoint};
use flotilla::record::disk::Disk;
use flotilla::record::folder::{METRICS, POLICIES, RUN, Run, Start};
use flotilla::record::metrics::Rows;
use flotilla::record::tensors::MAX_HEADER_BYTES;
use flotilla::record::{hex, policies};
use flotilla::run::{Options, Session};
use flotilla::trainer::Trainer;
use rand::{RngExt, SeedableRng, rngs::ChaCha8Rng};
use sha2::{Digest, Sha256};

const CONFIG: &str = "
[world]
leaders = [[10, 5], [20, 5]]
followers = [[12, 2]]
pois = [[10, 9], [20, 9]]
coupling = [2, 1]
steps = 3
[policy]
hidden = [2]
[learning]
population = 3
generations = 4
trials = 2
";

/// Most bytes the whole process may have had in memory at once.
const MOST_MEMORY: u64 = 256 << 20;
/// Longest that one input may take on a busy machine; most take microseconds.
const LONGEST: Duration = Duration::from_secs(5);

fn config() -> Config {
    Config::parse(CONFIG, "config.toml").unwrap()
}

/// The files of a real run: config, run.json, metrics, policies, its last checkpoint and the one that it ended with.
struct Files {
    run: Vec<u8>,
    metrics: Vec<u8>,
    policies: Vec<u8>,
    checkpoints: [Vec<u8>; 2],
}

fn files() -> Files {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run");
    let mut config = config();
    config.checkpoint.generations = 1;
    let (mut session, _) = Session::open(vec![(config, path.clone())], Start::Fresh, &Disk::default()).unwrap();
    let (stop, save) = Default::default();
    let mut options = Options {
        command: "flotilla train",
        stop: &stop,
        save: &save,
        instead: &mut |_| None,
        setback: &mut |_| {},
        watch: &mut |_| {},
    };
    session.train(&mut (Box::new(Cpu::default()), Machine::default()), &mut options).unwrap();
    let read = |name: &str| fs::read(path.join(name)).unwrap();
    let checkpoints = path.join("checkpoints");
    let [before, end] = checkpoint::list(&checkpoints).unwrap()[..] else { panic!("two are kept") };
    Files {
        run: read(RUN),
        metrics: read(METRICS),
        policies: read(POLICIES),
        checkpoints: [before, end].map(|generation| fs::read(checkpoint::path(&checkpoints, generation)).unwrap()),
    }
}

/// Pieces that mean something to one of the formats.
const PIECES: &[&str] = &[
    "0",
    "-1",
    "1e999",
    "-0.0",
    "1e-40",
    "nan",
    "inf",
    "18446744073709551615",
    "9223372036854775807",
    "99999999999999999999",
    "4294967296",
    "0.5",
    "1.0000001",
    "\"",
    "\\u0000",
    "\\",
    "[",
    "]",
    "[[",
    "{",
    "}",
    ",",
    ":",
    "\n",
    "\r\n",
    "null",
    "true",
    "é",
    "\u{1f6a2}",
    "F32",
    "F64",
    "F4",
    "BOOL",
    "shape",
    "dtype",
    "data_offsets",
    "__metadata__",
    "weights.0",
    "weights",
    "sha256",
    "flotilla",
    "[world]",
    "leaders",
    "=",
    ".",
    "#",
    "trial,generation",
];

/// Another version of an input, a few edits away from it or from another.
fn mutate(random: &mut ChaCha8Rng, seeds: &[&[u8]]) -> Vec<u8> {
    let mut bytes = seeds[random.random_range(0..seeds.len())].to_vec();
    for _ in 0..random.random_range(1..6) {
        let at = random.random_range(0..=bytes.len());
        let end = (at + random.random_range(0..24)).min(bytes.len());
        match random.random_range(0..8) {
            0 if at < bytes.len() => bytes[at] ^= 1 << random.random_range(0..8),
            1 if at < bytes.len() => bytes[at] = random.random(),
            2 => bytes.truncate(at),
            3 => drop(bytes.drain(at..end)),
            4 => {
                let copy = bytes[at..end].to_vec();
                let to = random.random_range(0..=bytes.len());
                bytes.splice(to..to, copy);
            }
            5 => {
                let other = seeds[random.random_range(0..seeds.len())];
                let from = random.random_range(0..=other.len());
                let piece = &other[from..(from + random.random_range(0..200)).min(other.len())];
                bytes.splice(at..end, piece.iter().copied());
            }
            6 => {
                let piece = PIECES[random.random_range(0..PIECES.len())];
                bytes.splice(at..end, piece.bytes());
            }
            _ => {
                // A number where a number was.
                if let Some(digit) = bytes[at..].iter().position(u8::is_ascii_digit) {
                    let start = at + digit;
                    let count = bytes[start..].iter().take_while(|byte| byte.is_ascii_digit()).count();
                    let piece = PIECES[random.random_range(0..12)];
                    bytes.splice(start..start + count, piece.bytes());
                }
            }
        }
    }
    // Where a header says how long it is, mostly keep that right, or its text is never looked at.
    if random.random_range(0..4) > 0 {
        reseal(&mut bytes);
    }
    bytes
}

/// Makes the header's length and the checksum fit what stands there, so that a reader looks further.
fn reseal(bytes: &mut [u8]) {
    const KEY: &[u8] = b"\"sha256\":\"";
    if bytes.get(8) != Some(&b'{') {
        return;
    }
    // The header ends with the brace, and spaces, before the first byte that is no text.
    let text = bytes[8..].iter().take_while(|&&byte| (b' '..0x7f).contains(&byte)).count();
    if let Some(brace) = bytes[8..8 + text].iter().rposition(|&byte| byte == b'}') {
        let spaces = bytes[8 + brace + 1..].iter().take_while(|&&byte| byte == b' ').count();
        bytes[..8].copy_from_slice(&((brace + 1 + spaces) as u64).to_le_bytes());
    }
    if let Some(place) = bytes.windows(KEY.len()).position(|window| window == KEY) {
        let digits = place + KEY.len()..place + KEY.len() + 64;
        if digits.end <= bytes.len() {
            bytes[digits.clone()].fill(b'0');
            let checksum = hex(&Sha256::digest(&*bytes));
            bytes[digits].copy_from_slice(checksum.as_bytes());
        }
    }
}

/// Reads mutated inputs; `read` says whether it took the input. Gives how many it took.
fn fuzz(name: &str, seeds: &[&[u8]], mut read: impl FnMut(&[u8]) -> bool) {
    let count: u64 = std::env::var("FLOTILLA_FUZZ").map_or(20_000, |text| text.parse().expect("a number of inputs"));
    for seed in seeds {
        assert!(read(seed), "{name}: the unchanged input is good");
    }
    let mut random = ChaCha8Rng::seed_from_u64(7);
    let (mut taken, mut slowest) = (0, Duration::ZERO);
    for index in 0..count {
        let input = mutate(&mut random, seeds);
        let start = Instant::now();
        taken += u64::from(read(&input));
        let time = start.elapsed();
        assert!(time < LONGEST, "{name}: input {index} took {time:?}");
        slowest = slowest.max(time);
    }
    // Else the inputs are too far off to test more than the first check.
    assert!(taken > 0 && taken < count, "{name}: {taken} of {count} taken");
    println!("{name}: {count} inputs, {taken} taken, slowest {slowest:?}, peak memory {} MB", peak_memory() >> 20);
    assert!(peak_memory() < MOST_MEMORY);
}

/// The most bytes this process had in memory, where the system tells.
fn peak_memory() -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    line.map_or(0, |line| line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() << 10)
}

#[test]
fn configs() {
    let resolved = config().to_toml();
    fuzz("config", &[CONFIG.as_bytes(), resolved.as_bytes()], |bytes| {
        std::str::from_utf8(bytes).is_ok_and(|text| Config::parse(text, "config.toml").is_ok())
    });
}

#[test]
fn runs() {
    fuzz("run.json", &[&files().run], |bytes| std::str::from_utf8(bytes).is_ok_and(|text| Run::parse(text).is_ok()));
}

#[test]
fn metrics() {
    fuzz("metrics", &[&files().metrics], |bytes| {
        let Ok(mut rows) = Rows::new(bytes) else { return false };
        rows.all(|row| {
            row.is_ok_and(|(row, seconds)| {
                let shares = [row.best_g, row.mean_g, row.champion_g];
                assert!(shares.iter().all(|share| (0.0..=1.0).contains(share)) && seconds.is_finite());
                true
            })
        })
    });
}

#[test]
fn policies_files() {
    let (config, files) = (config(), files());
    // Another program's has no checksum, and is looked at more closely.
    let weights = vec![0.5f32; 2 * 5 * config.parameters()];
    let view = safetensors::tensor::TensorView::new(
        safetensors::Dtype::F32,
        vec![2, 5, config.parameters()],
        bytemuck::cast_slice(&weights),
    );
    let foreign = safetensors::serialize([("weights", view.unwrap())], None).unwrap();
    fuzz("policies", &[&files.policies, &foreign], |bytes| {
        [None, Some(1)].into_iter().any(|trial| {
            let Ok(read) = policies::from_source(Cursor::new(bytes), &config, trial) else { return false };
            assert_eq!(read.weights.len(), config.learners() * read.policies * config.parameters());
            assert!(read.weights.iter().all(|w| *w == 0.0 || (MIN_WEIGHT..=MAX_WEIGHT).contains(&w.abs())));
            true
        })
    });
}

#[test]
fn checkpoints() {
    let (config, files) = (config(), files());
    let mut backend = Cpu::default();
    let mut longer = config.clone();
    longer.learning.generations += 2;
    let [before, end] = &files.checkpoints;
    fuzz("checkpoint", &[before, end], |bytes| {
        let Ok(read) = Checkpoint::read(Cursor::new(bytes), &longer) else { return false };
        let mut trainer = Trainer::new([longer.validate().unwrap()]);
        if read.snapshot.weights.is_empty() {
            // They are the policies', and those are read with as much care.
            assert_eq!(read.snapshot.generation, read.snapshot.last + 1);
            assert!(!trainer.restore(0, read.snapshot));
            return true;
        }
        // Whatever is taken can be trained on.
        assert!(trainer.restore(0, read.snapshot));
        let rows = trainer.finish(&mut backend).unwrap();
        assert!(rows.iter().all(|row| (0.0..=1.0).contains(&row.mean_g)));
        true
    });
}

/// Headers as long as they may be, made to cost as much memory and time as they can.
#[test]
fn headers_made_to_cost() {
    let config = config();
    let most = MAX_HEADER_BYTES as usize;
    let repeat = |open: &str, piece: &str, close: &str| {
        let count = (most - open.len() - close.len()) / piece.len();
        format!("{open}{}{close}", piece.repeat(count))
    };
    let numbered = |open: &str, piece: &dyn Fn(usize) -> String, close: &str| {
        let mut text = open.to_string();
        for index in 0.. {
            let piece = piece(index);
            if text.len() + piece.len() + close.len() > most {
                break;
            }
            text += &piece;
        }
        text.trim_end_matches(',').to_string() + close
    };
    let headers = [
        repeat("", "[", ""),
        repeat("{\"a\":", "[", ""),
        repeat("{\"a\":[0", ",0", "]}"),
        repeat("{\"a\":[[]", ",[]", "]}"),
        repeat("{\"a\":[{}", ",{}", "]}"),
        repeat("{\"weights\":{\"dtype\":\"F32\",\"shape\":[0", ",0", "],\"data_offsets\":[0,0]}}"),
        repeat("{\"weights\":{\"dtype\":\"F32\",\"shape\":[1", ",9", "],\"data_offsets\":[0,0]}}"),
        repeat("{\"a", "a", "\":0}"),
        numbered("{\"__metadata__\":{", &|index| format!("\"{index:x}\":\"\","), "}}"),
        numbered(
            "{",
            &|index| format!("\"{index:x}\":{{\"dtype\":\"U8\",\"shape\":[0],\"data_offsets\":[0,0]}},"),
            "}",
        ),
        repeat("{\"__metadata__\":{\"sha256\":\"", "0", "\"}}"),
    ];
    for header in headers {
        let bytes = [&(header.len() as u64).to_le_bytes(), header.as_bytes()].concat();
        let start = Instant::now();
        assert!(policies::from_source(Cursor::new(&bytes), &config, None).is_err());
        assert!(Checkpoint::read(Cursor::new(&bytes), &config).is_err());
        assert!(start.elapsed() < LONGEST, "{}", &header[..40]);
    }
    // A header that says it is larger than memory.
    for length in [MAX_HEADER_BYTES + 1, u64::MAX, 1 << 40] {
        let bytes = [&length.to_le_bytes()[..], b"{}"].concat();
        let told = policies::from_source(Cursor::new(&bytes), &config, None).unwrap_err();
        assert!(told.contains("it is not a safetensors file"), "{told}");
    }
    assert!(peak_memory() < MOST_MEMORY, "{} MB", peak_memory() >> 20);
}

/// Text without an end.
#[test]
fn lines_made_to_cost() {
    let endless = "1".repeat(64 << 20);
    assert!(Rows::new(endless.as_bytes()).is_err());
    let long = format!("{}\n{endless}", flotilla::record::metrics::HEADER);
    assert!(Rows::new(long.as_bytes()).unwrap().next().unwrap().unwrap_err().to_string().contains("longer than"));
}
