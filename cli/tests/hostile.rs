//! Tests that no file makes its reader panic, hang or use much memory.
//!
//! Each reader gets mutations of valid files. `FLOTILLA_FUZZ` sets how many; the default is 20 000.

use std::fs;
use std::io::Cursor;
use std::time::{Duration, Instant};

use flotilla::backend::Machine;
use flotilla::backend::cpu::Cpu;
use flotilla::config::Config;
use flotilla::evolve::{MAX_WEIGHT, MIN_WEIGHT};
use flotilla::trainer::Trainer;
use flotilla_app::record::checkpoint::{self, Checkpoint};
use flotilla_app::record::disk::Disk;
use flotilla_app::record::folder::{METRICS, POLICIES, RUN, Run, Start};
use flotilla_app::record::metrics::Rows;
use flotilla_app::record::tensors::MAX_HEADER_BYTES;
use flotilla_app::record::{hex, policies};
use flotilla_app::run::{Options, Session};
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

/// Maximum memory of the whole process at any time.
const MAX_MEMORY: u64 = 256 << 20;
/// Time limit for one input on a busy machine. Most take microseconds.
const MAX_TIME: Duration = Duration::from_secs(5);

fn config() -> Config {
    Config::parse(CONFIG, "config.toml").unwrap()
}

/// The files of a real run: run.json, metrics, policies, and its last two checkpoints.
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
    let mut options =
        Options { command: "flotilla train", stop: &stop, save: &save, fallback: &mut |_| None, watch: &mut |_| {} };
    session.train(&mut (Box::new(Cpu::default()), Machine::default()), &mut options).unwrap();
    let read = |name: &str| fs::read(path.join(name)).unwrap();
    let checkpoints = path.join("checkpoints");
    let [before, end] = checkpoint::list(&checkpoints).unwrap()[..] else { panic!("two checkpoints are kept") };
    Files {
        run: read(RUN),
        metrics: read(METRICS),
        policies: read(POLICIES),
        checkpoints: [before, end].map(|generation| fs::read(checkpoint::path(&checkpoints, generation)).unwrap()),
    }
}

/// Pieces that have a meaning in one of the formats, separated by spaces. The first [`NUMBERS`] are numbers.
const PIECES: &str = "0 -1 1e999 -0.0 1e-40 nan inf 18446744073709551615 9223372036854775807 99999999999999999999 \
                      4294967296 0.5 1.0000001 \" \\u0000 \\ [ ] [[ { } , : \n \r\n null true é \u{1f6a2} F32 F64 \
                      F4 BOOL shape dtype data_offsets __metadata__ weights.0 weights sha256 flotilla [world] \
                      leaders = . # trial,generation";
const NUMBERS: usize = 12;

/// Returns a mutated copy of one of the seeds.
fn mutate(random: &mut ChaCha8Rng, seeds: &[&[u8]]) -> Vec<u8> {
    let pieces: Vec<&str> = PIECES.split(' ').collect();
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
                let piece = pieces[random.random_range(0..pieces.len())];
                bytes.splice(at..end, piece.bytes());
            }
            _ => {
                // Replace a number by another.
                if let Some(digit) = bytes[at..].iter().position(u8::is_ascii_digit) {
                    let start = at + digit;
                    let count = bytes[start..].iter().take_while(|byte| byte.is_ascii_digit()).count();
                    let piece = pieces[random.random_range(0..NUMBERS)];
                    bytes.splice(start..start + count, piece.bytes());
                }
            }
        }
    }
    // With a wrong header length, readers would reject most files before they read the header.
    if random.random_range(0..4) > 0 {
        reseal(&mut bytes);
    }
    bytes
}

/// Corrects the header's length and the checksum, so that a reader checks the rest of the file.
fn reseal(bytes: &mut [u8]) {
    const KEY: &[u8] = b"\"sha256\":\"";
    if bytes.get(8) != Some(&b'{') {
        return;
    }
    // The header ends with the last brace, and spaces, in the text at the start.
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

/// Reads mutated inputs. `read` returns whether it accepted an input.
fn fuzz(name: &str, seeds: &[&[u8]], mut read: impl FnMut(&[u8]) -> bool) {
    let count: u64 = std::env::var("FLOTILLA_FUZZ").map_or(20_000, |text| text.parse().expect("a number of inputs"));
    for seed in seeds {
        assert!(read(seed), "{name}: the unchanged input is rejected");
    }
    let mut random = ChaCha8Rng::seed_from_u64(7);
    let (mut accepted, mut slowest) = (0, Duration::ZERO);
    for index in 0..count {
        let input = mutate(&mut random, seeds);
        let start = Instant::now();
        accepted += u64::from(read(&input));
        let time = start.elapsed();
        assert!(time < MAX_TIME, "{name}: input {index} took {time:?}");
        slowest = slowest.max(time);
    }
    // If every input fails, mutations may never pass the first check.
    assert!(accepted > 0 && accepted < count, "{name}: {accepted} of {count} accepted");
    println!(
        "{name}: {count} inputs, {accepted} accepted, slowest {slowest:?}, peak memory {} MB",
        peak_memory() >> 20
    );
    assert!(peak_memory() < MAX_MEMORY);
}

/// Returns the process's peak memory in bytes, or 0 if the system does not report it.
fn peak_memory() -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    line.map_or(0, |line| line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() << 10)
}

#[test]
fn mutated_configs() {
    let resolved = config().to_toml();
    fuzz("config", &[CONFIG.as_bytes(), resolved.as_bytes()], |bytes| {
        std::str::from_utf8(bytes).is_ok_and(|text| Config::parse(text, "config.toml").is_ok())
    });
}

#[test]
fn mutated_run_files() {
    fuzz("run.json", &[&files().run], |bytes| std::str::from_utf8(bytes).is_ok_and(|text| Run::parse(text).is_ok()));
}

#[test]
fn mutated_metrics() {
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
fn mutated_policies() {
    let (config, files) = (config(), files());
    // Files of other programs have no checksum, so more of their content is checked.
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
fn mutated_checkpoints() {
    let (config, files) = (config(), files());
    let mut backend = Cpu::default();
    let mut longer = config.clone();
    longer.learning.generations += 2;
    let [before, end] = &files.checkpoints;
    fuzz("checkpoint", &[before, end], |bytes| {
        let Ok(read) = Checkpoint::read(Cursor::new(bytes), &longer) else { return false };
        let mut trainer = Trainer::new([longer.validate().unwrap()]);
        if read.snapshot.weights.is_empty() {
            // Finished runs keep their weights in the policies file, whose reader checks them.
            assert_eq!(read.snapshot.generation, read.snapshot.last + 1);
            assert!(!trainer.restore(0, read.snapshot));
            return true;
        }
        // Training can resume from every accepted checkpoint.
        assert!(trainer.restore(0, read.snapshot));
        let rows = trainer.finish(&mut backend).unwrap();
        assert!(rows.iter().all(|row| (0.0..=1.0).contains(&row.mean_g)));
        true
    });
}

/// Headers of the maximum size, made to use as much memory and time as possible.
#[test]
fn costly_headers_fail_quickly() {
    let config = config();
    let max = MAX_HEADER_BYTES as usize;
    let repeat = |open: &str, piece: &str, close: &str| {
        let count = (max - open.len() - close.len()) / piece.len();
        format!("{open}{}{close}", piece.repeat(count))
    };
    let numbered = |open: &str, piece: &dyn Fn(usize) -> String, close: &str| {
        let mut text = open.to_string();
        for index in 0.. {
            let piece = piece(index);
            if text.len() + piece.len() + close.len() > max {
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
        assert!(start.elapsed() < MAX_TIME, "{}", &header[..40]);
    }
    // Headers whose stated size is larger than allowed.
    for length in [MAX_HEADER_BYTES + 1, u64::MAX, 1 << 40] {
        let bytes = [&length.to_le_bytes()[..], b"{}"].concat();
        let error = policies::from_source(Cursor::new(&bytes), &config, None).unwrap_err();
        assert!(error.contains("it is not a safetensors file"), "{error}");
    }
    assert!(peak_memory() < MAX_MEMORY, "{} MB", peak_memory() >> 20);
}

/// Lines without an end.
#[test]
fn endless_lines_fail() {
    let endless = "1".repeat(64 << 20);
    assert!(Rows::new(endless.as_bytes()).is_err());
    let long = format!("{}\n{endless}", flotilla_app::record::metrics::HEADER);
    assert!(Rows::new(long.as_bytes()).unwrap().next().unwrap().unwrap_err().to_string().contains("longer than"));
}

#[test]
fn invalid_rows_of_metrics_fail() {
    use flotilla_app::record::metrics::HEADER;
    let staged = &format!("{HEADER},stage");
    let row = |header: &str, line: &str| Rows::new(format!("{header}\n{line}\n").as_bytes()).unwrap().next().unwrap();
    assert_eq!(row(HEADER, "0,0,1,0.5,0,2.5").unwrap().1, 2.5);
    assert_eq!(row(staged, "0,0,1,0.5,0,2.5,1").unwrap().1, 2.5);
    for line in ["0,0,1,0.5,0,-1", "0,0,1,0.5,0,NaN", "0,0,1,0.5,0,inf", "0,0,1,0.5,0", "0,0,1,0.5,0,2.5,1"] {
        assert!(row(HEADER, line).is_err(), "{line}");
    }
    for line in ["0,0,1,0.5,0,2.5", "0,0,1,0.5,0,2.5,x", "0,0,1,0.5,0,2.5,1,1"] {
        assert!(row(staged, line).is_err(), "{line}");
    }
}
