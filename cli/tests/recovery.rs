//! Tests that a run stopped at any point resumes to the same bits as an uninterrupted run.
//!
//! Runs are stopped between generations, by failing disk operations, kills and signals. `FLOTILLA_KILLS` sets how often
//! the real program is killed (default: 20). Lost devices are in `population.rs`.

use crate::support::{self, Place};
use std::fs;
use std::io::{self, Cursor, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering::SeqCst};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use crate::support::{tiny, train};
use flotilla::backend::gpu;
use flotilla::backend::gpu::episode::GpuBackend;
use flotilla::backend::{Machine, OpenBackend};
use flotilla::config::{CheckpointConfig, Config};
use flotilla::front::cpu;
use flotilla_app::record::checkpoint::{self, Checkpoint, CheckpointWriter};
use flotilla_app::record::disk::{Disk, Operation};
use flotilla_app::record::folder::{self, CONFIG, Folder, METRICS, Note, POLICIES, RUN, Run, Start, StartFrom, Status};
use flotilla_app::record::{RecordError, metrics, policies};
use flotilla_app::run::{Results, RunError, Session, SessionEnd};
use rand::{RngExt, SeedableRng, rngs::ChaCha8Rng};
use tempfile::TempDir;

/// A run of 14 generations that takes milliseconds.
fn text() -> String {
    tiny(14, "generations = 1\nseconds = 0")
}

fn small() -> Config {
    Config::parse(&text(), "small.toml").unwrap()
}

/// Outcome of one session. `notes` are about the folder. `start` and `reached` are the next generations at its start
/// and at its end.
pub struct Outcome {
    pub end: Result<SessionEnd, RunError>,
    pub results: Option<Results>,
    notes: Vec<Note>,
    start: usize,
    reached: usize,
}

/// Trains a run until generation `stop_at` is next, or to its end.
pub fn session(
    config: &Config,
    path: &Path,
    start: Start,
    disk: Disk,
    backend: OpenBackend,
    stop_at: Option<usize>,
) -> Outcome {
    let (mut session, notes) = match Session::open(vec![(config.clone(), path.into())], start, &disk) {
        Ok(opened) => opened,
        Err(error) => return Outcome { end: Err(error), results: None, notes: vec![], start: 0, reached: 0 },
    };
    let notes = notes.into_iter().map(|(_, note)| note).collect();
    if session.is_done() {
        let results = session.results(0).cloned();
        return Outcome { end: Ok(SessionEnd::Finished), results, notes, start: 0, reached: 0 };
    }
    let start = session.generations()[0];
    let end = train(&mut session, backend, &mut |_| None, &mut |next| stop_at.is_some_and(|at| next[0] >= at));
    Outcome { end, results: session.results(0).cloned(), notes, start, reached: session.generations()[0] }
}

/// Resumes a run to its end, on a disk without failures.
fn resume(config: &Config, path: &Path) -> (Results, Outcome) {
    let outcome = session(config, path, Start::Resume, Disk::default(), cpu(), None);
    assert!(matches!(outcome.end, Ok(SessionEnd::Finished)), "{:?}", outcome.end);
    (outcome.results.clone().unwrap(), outcome)
}

/// Creates a folder. Returns it, and the path of a run in it.
fn run_folder() -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run");
    (folder, path)
}

/// Trains without interruption. Returns the results and the files.
pub fn reference(config: &Config) -> (Results, (Vec<Vec<String>>, Vec<u8>)) {
    let (_folder, path) = run_folder();
    let outcome = session(config, &path, Start::Fresh, Disk::default(), cpu(), None);
    assert!(matches!(outcome.end, Ok(SessionEnd::Finished)), "{:?}", outcome.end);
    (outcome.results.unwrap(), support::results(&path))
}

#[test]
fn checkpoints_do_not_change_results() {
    let config = small();
    let mut never = config.clone();
    never.checkpoint.generations = 0;
    assert_eq!(reference(&config), reference(&never));
}

#[test]
fn checkpoints_are_due_by_generations_or_by_time() {
    let writer = CheckpointWriter::new(Disk::default(), "checkpoints".into(), small(), vec![], 4);
    let due = |generations, seconds| {
        let schedule = CheckpointConfig { generations, seconds };
        [4, 5, 6, 7].map(|next| writer.is_due(&schedule, next))
    };
    assert_eq!(due(0, 0.0), [false; 4]);
    assert_eq!(due(2, 0.0), [false, false, true, true]);
    // No checkpoint was written yet, so its cost is 0.
    assert_eq!(due(0, f64::MIN_POSITIVE), [false, true, true, true]);
    assert_eq!(due(0, 1e9), [false; 4]);
    assert_eq!(due(2, 1e9), [false, false, true, true]);
}

#[test]
fn no_checkpoint_is_due_by_time_while_the_previous_one_is_written() {
    let (folder, _, paths) = stopped_run(&small());
    let checkpoint = Checkpoint::read(fs::File::open(&paths[1]).unwrap(), &small()).unwrap();
    let gate = Arc::new(Mutex::new(()));
    let disk = Disk::failing({
        let gate = gate.clone();
        move |_, _| {
            drop(gate.lock());
            Ok(())
        }
    });
    let metrics = Disk::default().create(&folder.path().join("metrics")).unwrap();
    let mut writer = CheckpointWriter::new(disk, folder.path().into(), small(), vec![], 4);
    let schedule = CheckpointConfig { generations: 0, seconds: f64::MIN_POSITIVE };
    // While this is locked, the writer waits.
    let closed = gate.lock().unwrap();
    let since = Instant::now();
    writer.save(checkpoint, metrics, since).unwrap();
    // The known part of the checkpoint's cost is at most this long.
    let cost = since.elapsed();
    while since.elapsed() < cost * 50 {
        assert!(!writer.is_due(&schedule, 10));
    }
    drop(closed);
    writer.wait().unwrap();
    assert_eq!(writer.newest(), Some(9));
}

#[test]
fn one_slow_write_does_not_stop_timed_checkpoints() {
    let (folder, _, paths) = stopped_run(&small());
    let checkpoint = Checkpoint::read(fs::File::open(&paths[1]).unwrap(), &small()).unwrap();
    let slow = Duration::from_millis(500);
    let disk = Disk::failing(move |operation, _| {
        if operation == Operation::Rename {
            std::thread::sleep(slow);
        }
        Ok(())
    });
    let metrics = Disk::default().create(&folder.path().join("metrics")).unwrap();
    let mut writer = CheckpointWriter::new(disk, folder.path().into(), small(), vec![], 4);
    writer.save(checkpoint, metrics, Instant::now()).unwrap();
    writer.wait().unwrap();
    let written = Instant::now();
    let schedule = |seconds| CheckpointConfig { generations: 0, seconds };
    // A checkpoint is due after ten times the interval at the latest.
    while !writer.is_due(&schedule(0.01), 10) {
        assert!(written.elapsed() < slow * 2);
        std::thread::sleep(Duration::from_millis(10));
    }
    // The average counts: a quarter of the time, and not all of it, is multiplied by 20.
    while !writer.is_due(&schedule(0.3), 10) {
        assert!(written.elapsed() < slow * 12);
        std::thread::sleep(Duration::from_millis(10));
    }
}

#[test]
#[cfg(unix)]
fn a_copy_of_hard_links_is_not_changed_and_not_locked() {
    fn link(from: &Path, to: &Path) {
        fs::create_dir(to).unwrap();
        for entry in fs::read_dir(from).unwrap() {
            let (path, to) = (entry.as_ref().unwrap().path(), to.join(entry.unwrap().file_name()));
            if path.is_dir() { link(&path, &to) } else { fs::hard_link(path, to).unwrap() }
        }
    }
    let folder = tempfile::tempdir().unwrap();
    let [path, copy] = ["run", "copy"].map(|name| folder.path().join(name));
    session(&small(), &path, Start::Fresh, Disk::default(), cpu(), Some(9));
    // A list of pictures, to which lines are added.
    fs::write(path.join(".flotilla.sha256"), "0  x\n").unwrap();
    link(&path, &copy);
    let before = support::files(&copy);
    let disk = Disk::default().within(&path).unwrap();
    disk.extend(&path.join(".flotilla.sha256"), b"1  y\n").unwrap();
    let (results, _) = resume(&small(), &path);
    assert_eq!(results, reference(&small()).0);
    assert_eq!(support::files(&copy), before);
    // Both can be used at the same time.
    let open = |path: &Path| Folder::open(path, Start::Resume, &small(), StartFrom::Random, Disk::default());
    let (_run, _copy) = (open(&path).unwrap(), open(&copy).unwrap());
    for (path, name) in [(&path, "run"), (&copy, "copy")] {
        assert!(matches!(open(path), Err(RecordError::Locked { .. })), "{name}");
    }
}

#[test]
fn a_finished_run_is_resumed_where_nothing_can_be_written() {
    let (_folder, path) = run_folder();
    session(&small(), &path, Start::Fresh, Disk::default(), cpu(), None);
    for kind in [io::ErrorKind::ReadOnlyFilesystem, io::ErrorKind::PermissionDenied] {
        let disk = Disk::failing(move |operation, _| match operation {
            Operation::CreateFolder => Ok(()),
            _ => Err(kind.into()),
        });
        let done = session(&small(), &path, Start::Resume, disk.clone(), cpu(), None);
        assert!(matches!(done.end, Ok(SessionEnd::Finished)), "{:?}", done.end);
        assert_eq!(done.results, Some(reference(&small()).0));
        // A longer run cannot be written.
        let longer = session(&with_generations(&small(), 20), &path, Start::Resume, disk.clone(), cpu(), None);
        assert!(matches!(longer.end, Err(RunError::Record(RecordError::Write { .. }))), "{:?}", longer.end);
        let force = session(&small(), &path, Start::Force, disk, cpu(), None);
        assert!(matches!(force.end, Err(RunError::Record(RecordError::Write { .. }))), "{:?}", force.end);
    }
}

#[test]
fn names_are_flushed_once_and_after_the_last_file() {
    let (folder, operations) = (tempfile::tempdir().unwrap(), Arc::new(Mutex::new(Vec::new())));
    let (path, seen) = (folder.path().join("run"), operations.clone());
    let disk = Disk::failing(move |operation, path| {
        seen.lock().unwrap().push((operation, path.to_path_buf()));
        Ok(())
    });
    let mut config = small();
    config.checkpoint.generations = 0;
    session(&config, &path, Start::Fresh, disk, cpu(), None);
    let operations = operations.lock().unwrap();
    let is_flush = |(operation, _): &&(Operation, PathBuf)| *operation == Operation::Flush;
    // config.toml, run.json three times, metrics.csv, policies.safetensors, a checkpoint and two folders.
    assert_eq!(operations.iter().filter(is_flush).count(), 9, "{operations:?}");
    for (at, (operation, name)) in operations.iter().enumerate() {
        if *operation == Operation::Rename {
            let mut later = operations[at..].iter().filter(is_flush);
            assert!(later.any(|(_, flushed)| Some(&**flushed) == name.parent()), "{}", name.display());
        }
    }
}

#[test]
fn a_run_stopped_before_any_generation_resumes_to_the_same_results() {
    crate::stages::check_resumes(&small(), &[], &[]);
}

#[test]
fn a_finished_run_is_not_trained_again() {
    let config = small();
    let (_folder, path) = run_folder();
    let expected = reference(&config);
    session(&config, &path, Start::Fresh, Disk::default(), cpu(), None).end.unwrap();
    let before = fs::read(path.join(METRICS)).unwrap();
    let disk = Disk::failing(|operation, path| match operation {
        Operation::CreateFolder => Ok(()),
        _ if path.ends_with(".lock") => Ok(()),
        _ => panic!("{operation:?} {}", path.display()),
    });
    let outcome = session(&config, &path, Start::Resume, disk, cpu(), None);
    assert_eq!((outcome.end.unwrap(), outcome.results), (SessionEnd::Finished, Some(expected.0.clone())));
    assert_eq!(fs::read(path.join(METRICS)).unwrap(), before);
    // If a result file is damaged, the run resumes from its last checkpoint and restores the file.
    for (name, at) in [(POLICIES, 500), (METRICS, 60)] {
        let mut bytes = fs::read(path.join(name)).unwrap();
        bytes[at] ^= 1;
        fs::write(path.join(name), bytes).unwrap();
        let (results, _) = resume(&config, &path);
        assert_eq!((results, support::results(&path)), expected, "{name}");
    }
}

#[test]
fn a_finished_run_whose_metrics_cannot_be_read_is_not_changed() {
    let config = small();
    let (_folder, path) = run_folder();
    session(&config, &path, Start::Fresh, Disk::default(), cpu(), None).end.unwrap();
    let files = || [RUN, POLICIES].map(|name| fs::read(path.join(name)).unwrap());
    let (metrics, before) = (fs::read(path.join(METRICS)).unwrap(), files());
    // A directory can be read by nobody, not even by root.
    fs::remove_file(path.join(METRICS)).unwrap();
    fs::create_dir(path.join(METRICS)).unwrap();
    let error = session(&config, &path, Start::Resume, Disk::default(), cpu(), None).end.unwrap_err();
    // Without this error, the run would be trained again, and fail when it opens the metrics for writing.
    assert!(matches!(&error, RunError::Record(RecordError::Read { path, .. }) if path.ends_with(METRICS)), "{error}");
    assert_eq!(files(), before);
    // If the file can be read again, the run is finished.
    fs::remove_dir(path.join(METRICS)).unwrap();
    fs::write(path.join(METRICS), metrics).unwrap();
    let outcome = session(&config, &path, Start::Resume, Disk::default(), cpu(), None);
    assert_eq!((outcome.end.unwrap(), outcome.results), (SessionEnd::Finished, Some(reference(&config).0)));
}

/// Windows has other errors for these paths.
#[cfg(unix)]
#[test]
fn only_a_missing_entry_has_no_kind() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    fs::write(&file, "").unwrap();
    for disk in [Disk::default(), Disk::default().within(folder.path()).unwrap()] {
        assert!(disk.kind(&file).unwrap().is_some());
        assert!(disk.kind(&folder.path().join("missing")).unwrap().is_none());
        assert!(disk.kind(&folder.path().join("missing/file")).unwrap().is_none());
        // No file system allows a name of this length.
        assert!(disk.kind(&folder.path().join("x".repeat(10_000))).is_err());
        assert!(disk.kind(&file.join("x")).is_err());
    }
}

/// Returns the config with another number of generations.
fn with_generations(config: &Config, generations: usize) -> Config {
    let mut config = config.clone();
    config.learning.generations = generations;
    config
}

#[test]
fn a_run_extended_from_any_length_has_the_same_results() {
    let config = small();
    let expected = reference(&config);
    // With an interval of 0, the only checkpoint is the one at the end.
    for interval in [0, 1, 4] {
        for length in 1..config.learning.generations {
            let mut short = with_generations(&config, length);
            short.checkpoint.generations = interval;
            let (_folder, path) = run_folder();
            session(&short, &path, Start::Fresh, Disk::default(), cpu(), None).end.unwrap();
            let (results, outcome) = resume(&config, &path);
            assert_eq!(outcome.start, length + 1, "{:?}", outcome.notes);
            assert_eq!((results, support::results(&path)), expected, "from {length} generations");
            assert_eq!(fs::read_to_string(path.join("config.toml")).unwrap(), config.to_toml());
            // The extended run is finished.
            assert_eq!(resume(&config, &path).1.reached, 0);
        }
    }
}

#[test]
fn a_run_with_missing_or_damaged_files_is_extended() {
    let config = small();
    let expected = reference(&config);
    let short = with_generations(&config, 7);
    let run = || {
        let (folder, path) = run_folder();
        session(&short, &path, Start::Fresh, Disk::default(), cpu(), None).end.unwrap();
        let checkpoints = path.join("checkpoints");
        assert_eq!(checkpoint::list(&checkpoints).unwrap(), [7, 8]);
        (folder, path, [7, 8].map(|generation| checkpoint::path(&checkpoints, generation)))
    };
    let resumes = |path: &Path, start: usize| {
        let (results, outcome) = resume(&config, path);
        assert_eq!(outcome.start, start, "{:?}", outcome.notes);
        assert_eq!((results, support::results(path)), expected);
    };
    // Runs of earlier versions have no checkpoint of their end.
    let (_folder, path, [_, end]) = run();
    fs::remove_file(&end).unwrap();
    resumes(&path, 7);
    let (_folder, path, ends) = run();
    ends.iter().for_each(|end| fs::remove_file(end).unwrap());
    resumes(&path, 0);
    // The policies are another run's, damaged, or missing.
    let other = with_generations(&config, 6);
    let other_folder = tempfile::tempdir().unwrap();
    session(&other, other_folder.path(), Start::Fresh, Disk::default(), cpu(), None).end.unwrap();
    let others = fs::read(other_folder.path().join(POLICIES)).unwrap();
    for (damage, policies) in [Some(others), Some(b"none".to_vec()), None].iter().enumerate() {
        let (_folder, path, _) = run();
        match policies {
            Some(bytes) => fs::write(path.join(POLICIES), bytes).unwrap(),
            None => fs::remove_file(path.join(POLICIES)).unwrap(),
        }
        let (results, outcome) = resume(&config, &path);
        assert_eq!((outcome.start, outcome.notes.len()), (7, 1), "{damage}: {:?}", outcome.notes);
        assert_eq!((results, support::results(&path)), expected);
    }
    // The policies cannot be read for now: a folder has the file's name.
    let (_folder, path, _) = run();
    let (policies, elsewhere) = (path.join(POLICIES), path.join("elsewhere"));
    fs::rename(&policies, &elsewhere).unwrap();
    fs::create_dir(&policies).unwrap();
    let error = session(&config, &path, Start::Resume, Disk::default(), cpu(), None).end.unwrap_err().to_string();
    assert!(error.contains("policies.safetensors: cannot be read"), "{error}");
    fs::remove_dir(&policies).unwrap();
    fs::rename(&elsewhere, &policies).unwrap();
    resumes(&path, 8);
    // A run stopped after its last generation, before its end, has the weights in its checkpoint.
    let stopped = tempfile::tempdir().unwrap();
    session(&short, stopped.path(), Start::Fresh, Disk::default(), cpu(), Some(8)).end.unwrap();
    resumes(stopped.path(), 8);
    // While a run is extended, the digests of the shorter run are not recorded.
    let (_folder, path, _) = run();
    let recorded = || Run::read(&path.join(RUN)).unwrap();
    assert!(recorded().state == Status::Done && recorded().digest.is_some() && recorded().files.is_some());
    let opened = Folder::open(&path, Start::Resume, &config, StartFrom::Unspecified, Disk::default()).unwrap();
    assert_eq!((recorded().state, recorded().digest, recorded().files), (Status::Running, None, None));
    drop(opened);
    resumes(&path, 8);

    // A run cannot become shorter. The refusal changes no file.
    let (_folder, path, _) = run();
    let before = support::results(&path);
    let outcome = session(&with_generations(&config, 6), &path, Start::Resume, Disk::default(), cpu(), None);
    let error = outcome.end.unwrap_err().to_string();
    assert!(error.contains("is a run of 7 generations, which cannot become one of 6"), "{error}");
    assert_eq!(support::results(&path), before);
    // An extension cannot change other keys.
    let mut changed = config.clone();
    changed.learning.seed = 3;
    let error = session(&changed, &path, Start::Resume, Disk::default(), cpu(), None).end.unwrap_err().to_string();
    assert!(error.contains("learning.seed: 0 there, 3 here") && !error.contains("generations:"), "{error}");
}

/// Lets every disk operation of an extension fail. Each time, the run must resume to the same results.
#[test]
fn an_extension_survives_every_failing_disk_operation() {
    let config = with_generations(&small(), 9);
    let mut short = with_generations(&config, 5);
    short.checkpoint.generations = 3;
    let expected = reference(&config);
    let mut without_checkpoints = config.clone();
    without_checkpoints.checkpoint.generations = 0;
    let before = |path: &Path| {
        session(&short, path, Start::Fresh, Disk::default(), cpu(), None).end.unwrap();
    };
    let check = |path: &Path, _: Outcome, _: Operation, context: &str| {
        let (results, resumed) = resume(&config, path);
        assert_eq!((results, support::results(path)), expected, "{context}");
        assert!(resumed.notes.len() <= 1, "{context}: {:?}", resumed.notes);
        // The run resumes from the end of the shorter run, or is already finished.
        assert!(resumed.start >= 6 || resumed.reached == 0, "{context}: {:?}", resumed.notes);
        assert_eq!(leftovers(path), Vec::<PathBuf>::new(), "{context}");
    };
    let both = [Fails::Once, Fails::FromThere];
    let operations = with_each_failure(before, &without_checkpoints, Start::Resume, &both, check);
    assert!(operations > 20, "{operations}");
}

/// Trains runs of different lengths, sizes and progress in one session, and compares each with the same run trained
/// alone.
#[test]
fn runs_trained_together_equal_runs_trained_alone() {
    let mut configs = [small(), with_generations(&small(), 5), with_generations(&small(), 9), small()];
    configs[2].learning.population = 9;
    configs[3].learning.seed = 4;
    configs[3].checkpoint.generations = 0;
    let expected: Vec<_> = configs.iter().map(reference).collect();
    let folder = tempfile::tempdir().unwrap();
    let path = |run: usize| folder.path().join(run.to_string());
    // The first run is stopped before generation 11, the second is finished, and the others have not started.
    session(&configs[0], &path(0), Start::Fresh, Disk::default(), cpu(), Some(11)).end.unwrap();
    session(&configs[1], &path(1), Start::Fresh, Disk::default(), cpu(), None).end.unwrap();
    let open = || {
        let runs = configs.iter().enumerate().map(|(run, config)| (config.clone(), path(run))).collect();
        Session::open(runs, Start::Resume, &Disk::default()).unwrap()
    };
    let (mut session, notes) = open();
    assert_eq!(session.generations(), [11, 7, 0, 0]);
    assert_eq!(notes.iter().map(|(run, _)| *run).collect::<Vec<_>>(), [0, 2, 3]);
    let stopped = train(&mut session, cpu(), &mut |_| None, &mut |next| next[2] >= 3);
    assert_eq!((stopped.unwrap(), session.generations()), (SessionEnd::Stopped, &[14, 7, 3, 3][..]));
    drop(session);
    let (mut session, _) = open();
    let done = train(&mut session, cpu(), &mut |_| None, &mut |_| false);
    assert_eq!((done.unwrap(), session.generations()), (SessionEnd::Finished, &[16, 7, 11, 16][..]));
    for (run, expected) in expected.iter().enumerate() {
        assert_eq!(
            (session.results(run), support::results(&path(run))),
            (Some(&expected.0), expected.1.clone()),
            "run {run}"
        );
    }
    // If one of the folders cannot be used, no folder is changed.
    drop(session);
    let runs = [(configs[0].clone(), folder.path().join("new")), (configs[1].clone(), path(1))];
    assert!(Session::open(runs.to_vec(), Start::Fresh, &Disk::default()).is_err());
    assert!(!folder.path().join("new").exists());
}

/// Lets every disk operation of a run fail. Each time, the run must resume to the same results.
#[test]
fn a_run_survives_every_failing_disk_operation() {
    let config = small();
    let expected = reference(&config);
    let mut reported = Vec::new();
    let check = |path: &Path, outcome: Outcome, operation: Operation, context: &str| {
        if let Err(error) = outcome.end {
            let error = flotilla_cli::Error::from(error).to_string();
            assert!(error.contains("free some space, then continue with --resume"), "{context}: {error}");
            reported.push(operation);
        }
        let (results, resumed) = resume(&config, path);
        assert_eq!((results, support::results(path)), expected, "{context}");
        // No file is reported as damaged. The only possible note is the generation of the resume.
        assert!(resumed.notes.len() <= 1, "{context}: {:?}", resumed.notes);
        // With a checkpoint per generation, at most two generations are played again.
        assert!(
            resumed.start + 2 >= outcome.reached || outcome.reached > 15,
            "{context}: {} {}",
            resumed.start,
            outcome.reached
        );
        assert_eq!(leftovers(path), Vec::<PathBuf>::new(), "{context}");
    };
    let operations = with_each_failure(|_| (), &config, Start::Fresh, &[Fails::Once, Fails::FromThere], check);
    assert!(operations > 14 * 5, "{operations}");
    for operation in [
        Operation::CreateFolder,
        Operation::Create,
        Operation::Write,
        Operation::Flush,
        Operation::Rename,
        Operation::Remove,
    ] {
        assert!(reported.contains(&operation), "no failure of {operation:?} was reported");
    }
}

/// How a disk fails.
#[derive(Clone, Copy, Debug)]
pub enum Fails {
    /// One operation fails.
    Once,
    /// An operation and all later ones fail, as if the process were killed there.
    FromThere,
}

/// Trains a run once for each of its disk operations and each way to fail, and lets that operation fail. A write that
/// fails leaves its first half. Returns the number of operations.
///
/// `before` prepares a new folder each time. `check` gets the folder, the outcome, the operation that failed, and a
/// text that describes the case.
pub fn with_each_failure(
    before: impl Fn(&Path),
    config: &Config,
    start: Start,
    ways: &[Fails],
    mut check: impl FnMut(&Path, Outcome, Operation, &str),
) -> usize {
    let attempt = |fails: Box<dyn Fn(usize) -> bool + Send + Sync>| {
        let folder = in_memory();
        let path = folder.path().join("run");
        before(&path);
        let (count, failed) = (Arc::new(AtomicUsize::new(0)), Arc::new(Mutex::new(None)));
        let disk = Disk::failing({
            let (count, failed) = (count.clone(), failed.clone());
            move |operation, path| {
                if fails(count.fetch_add(1, SeqCst)) {
                    *failed.lock().unwrap() = Some((operation, path.to_path_buf()));
                    return Err(io::Error::from(io::ErrorKind::StorageFull));
                }
                Ok(())
            }
        });
        let outcome = session(config, &path, start, disk, cpu(), None);
        let failed = failed.lock().unwrap().clone();
        (folder, path, outcome, count.load(SeqCst), failed)
    };
    let (_, _, outcome, operations, _) = attempt(Box::new(|_| false));
    assert_eq!((outcome.end.unwrap(), outcome.results), (SessionEnd::Finished, Some(reference(config).0)));
    let mut unreached = 0;
    for at in 0..operations {
        for &way in ways {
            let (_folder, path, outcome, _, failed) = attempt(Box::new(move |operation| match way {
                Fails::Once => operation == at,
                Fails::FromThere => operation >= at,
            }));
            // On a busy machine, the attempt that was counted may have had more operations.
            let Some((operation, file)) = failed else {
                assert_eq!(outcome.end.unwrap(), SessionEnd::Finished, "operation {at} of {operations}");
                unreached += 1;
                continue;
            };
            let context = format!("operation {at}, {way:?}: {operation:?} {}", file.display());
            check(&path, outcome, operation, &context);
        }
    }
    assert!(unreached * 10 < operations, "{unreached} of {operations} operations did not fail");
    operations
}

/// Creates a folder in memory, where flushes are fast, if the system has `/dev/shm`.
fn in_memory() -> TempDir {
    tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).unwrap()
}

/// Returns the temporary files that an interrupted write has left.
fn leftovers(path: &Path) -> Vec<PathBuf> {
    let checkpoints = path.join("checkpoints");
    let entries = [path, &checkpoints].into_iter().flat_map(|folder| fs::read_dir(folder).into_iter().flatten());
    entries.map(|entry| entry.unwrap().path()).filter(|path| path.extension().is_some_and(|e| e == "tmp")).collect()
}

/// Trains a run that stops before generation 9. Returns its folder and its checkpoints, oldest first.
fn stopped_run(config: &Config) -> (TempDir, PathBuf, Vec<PathBuf>) {
    let (folder, path) = run_folder();
    session(config, &path, Start::Fresh, Disk::default(), cpu(), Some(9)).end.unwrap();
    let checkpoints = path.join("checkpoints");
    let generations = checkpoint::list(&checkpoints).unwrap();
    assert_eq!(generations, [8, 9]);
    let paths = generations.into_iter().map(|generation| checkpoint::path(&checkpoints, generation)).collect();
    (folder, path, paths)
}

/// Returns damaged copies of a file: cut to every length, every byte changed in three ways, and one byte longer.
fn damaged(whole: &[u8]) -> impl Iterator<Item = (String, Vec<u8>)> {
    let cut = (0..whole.len()).map(|length| (format!("cut to {length}"), whole[..length].to_vec()));
    let flipped = (0..whole.len()).flat_map(|at| [0x01, 0x20, 0xff].map(|mask| (at, mask))).map(|(at, mask)| {
        let mut bytes = whole.to_vec();
        bytes[at] ^= mask;
        (format!("byte {at} ^ {mask:#x}"), bytes)
    });
    let longer = [("one byte more".to_string(), [whole, b" "].concat())];
    cut.chain(flipped).chain(longer)
}

#[test]
fn a_folder_that_cannot_be_read_is_not_a_folder_without_checkpoints() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    fs::write(&file, "").unwrap();
    assert_eq!(checkpoint::list(&file).unwrap(), [0; 0]);
    assert_eq!(checkpoint::list(&folder.path().join("missing")).unwrap(), [0; 0]);
    // No file system of Unix allows a name of this length. Windows says that the file is missing.
    if cfg!(unix) {
        let error = checkpoint::list(&folder.path().join("x".repeat(10_000))).unwrap_err();
        assert!(matches!(error, RecordError::Read { .. }), "{error}");
    }
}

#[test]
fn every_damaged_byte_of_a_checkpoint_is_detected() {
    let config = small();
    let (folder, _, paths) = stopped_run(&config);
    let whole = fs::read(&paths[1]).unwrap();
    // Unlike a weight, a fitness may be of any size.
    let mut told = Checkpoint::read(Cursor::new(&whole), &config).unwrap();
    told.snapshot.fitness[0].fill(1e-12);
    told.snapshot.fitness[1].fill(3e9);
    let path = folder.path().join("told");
    told.write(&Disk::default(), &path, &config).unwrap();
    assert_eq!(Checkpoint::read(fs::File::open(&path).unwrap(), &config).unwrap(), told);
    for (damage, bytes) in damaged(&whole) {
        let read = Checkpoint::read(Cursor::new(&bytes), &config);
        assert!(read.is_err(), "{damage}");
    }
}

#[test]
fn every_damaged_byte_of_a_policies_file_is_detected() {
    let config = small();
    let (_, (_, whole)) = reference(&config);
    for trial in [None, Some(0), Some(1)] {
        policies::from_source(Cursor::new(&whole), &config, trial).unwrap();
    }
    for (damage, bytes) in damaged(&whole) {
        assert!(policies::from_source(Cursor::new(&bytes), &config, None).is_err(), "{damage}");
    }
}

#[test]
fn a_damaged_checkpoint_is_reported_and_the_previous_one_is_used() {
    let config = small();
    let expected = reference(&config);
    let (_folder, path, paths) = stopped_run(&config);
    let originals: Vec<_> = paths.iter().map(|path| (path, fs::read(path).unwrap())).collect();
    let metrics = fs::read(path.join(METRICS)).unwrap();
    for (damage, bytes) in damaged(&originals[1].1).step_by(97) {
        for (path, bytes) in &originals {
            fs::write(path, bytes).unwrap();
        }
        fs::write(path.join(METRICS), &metrics).unwrap();
        fs::write(&paths[1], bytes).unwrap();
        let outcome = session(&config, &path, Start::Resume, Disk::default(), cpu(), Some(10));
        assert_eq!(outcome.start, 8, "{damage}");
        let note = outcome.notes[0].to_string();
        assert!(outcome.notes[0].is_damage && note.contains("000000009.safetensors: "), "{damage}: {note}");
        assert_eq!(checkpoint::list(&path.join("checkpoints")).unwrap(), [9, 10]);
        for generation in [9, 10] {
            fs::remove_file(checkpoint::path(&path.join("checkpoints"), generation)).unwrap();
        }
    }
    // If both checkpoints are damaged, the run starts over.
    for (path, bytes) in &originals {
        fs::write(path, &bytes[..bytes.len() - 1]).unwrap();
    }
    fs::write(path.join(METRICS), &metrics).unwrap();
    let (results, outcome) = resume(&config, &path);
    assert_eq!((outcome.start, outcome.notes.len()), (0, 3), "{:?}", outcome.notes);
    let ends = ["; set aside, and the one before is tried", "; set aside, and there is no other"];
    let notes = outcome.notes.iter().map(ToString::to_string);
    assert!(notes.zip(ends).all(|(note, end)| note.ends_with(end)), "{:?}", outcome.notes);
    assert_eq!((results, support::results(&path)), expected);
}

#[test]
fn a_checkpoint_of_another_run_is_set_aside_and_the_previous_one_is_used() {
    let config = small();
    let expected = reference(&config);
    let (_folder, path, paths) = stopped_run(&config);
    let mut other = config.clone();
    other.learning.seed = 3;
    let (_other_folder, _, others) = stopped_run(&other);
    fs::copy(&others[1], &paths[1]).unwrap();
    let (results, outcome) = resume(&config, &path);
    let note = outcome.notes[0].to_string();
    assert!(note.contains("000000009.safetensors: it is of another run"), "{note}");
    assert_eq!(outcome.start, 8, "{:?}", outcome.notes);
    assert_eq!((results, support::results(&path)), expected);
}

/// A file of which one read fails, after `left` others.
struct FailingRead<R> {
    source: R,
    left: Option<usize>,
    kind: io::ErrorKind,
}

impl<R: Read> Read for FailingRead<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let fails = self.left == Some(0);
        self.left = self.left.and_then(|left| left.checked_sub(1));
        if fails { Err(self.kind.into()) } else { self.source.read(buffer) }
    }
}

impl<R: Seek> Seek for FailingRead<R> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.source.seek(to)
    }
}

#[test]
fn an_interrupted_read_is_repeated_and_a_failed_one_is_reported() {
    let config = small();
    let (_folder, _, paths) = stopped_run(&config);
    let whole = fs::read(&paths[1]).unwrap();
    let expected = Checkpoint::read(Cursor::new(&whole), &config).unwrap();
    for reads in 0.. {
        let read = |kind| {
            let mut file = FailingRead { source: Cursor::new(&whole), left: Some(reads), kind };
            (Checkpoint::read(&mut file, &config), file.left.is_none())
        };
        assert_eq!(read(io::ErrorKind::Interrupted).0.unwrap(), expected, "after {reads} reads");
        let (found, failed) = read(io::ErrorKind::TimedOut);
        if !failed {
            assert!(reads >= 5, "a checkpoint took only {reads} reads");
            return;
        }
        let error = found.expect_err("a read failed");
        assert!(error.contains("cannot be read"), "after {reads} reads: {error}");
    }
}

#[test]
fn a_run_with_cut_metrics_resumes_before_the_cut() {
    let config = small();
    let expected = reference(&config);
    for (cut, start) in [(0, 9), (1, 8), (100, 0)] {
        let (_folder, path, _) = stopped_run(&config);
        let metrics = fs::read(path.join(METRICS)).unwrap();
        fs::write(path.join(METRICS), &metrics[..metrics.len() - cut]).unwrap();
        let (results, outcome) = resume(&config, &path);
        assert_eq!(outcome.start, start, "{:?}", outcome.notes);
        assert_eq!((results, support::results(&path)), expected);
    }
}

#[test]
fn a_changed_config_is_refused_with_the_names_of_its_keys() {
    let config = small();
    let (_folder, path, _) = stopped_run(&config);
    let mut changed = config.clone();
    changed.learning.seed = 5;
    changed.world.steps = 9;
    changed.checkpoint.seconds = 1.0;
    let error = session(&changed, &path, Start::Resume, Disk::default(), cpu(), None).end.unwrap_err().to_string();
    assert!(
        error.contains("learning.seed: 0 there, 5 here") && error.contains("world.steps: 8 there, 9 here"),
        "{error}"
    );
    assert!(!error.contains("checkpoint.") && !error.contains('…'), "{error}");
    // The values of a key with a long text are cut.
    let mut long = config.clone();
    long.world.pois = vec![[10.0, 10.0]; 20];
    let differences = folder::differences(&config, &long);
    assert!(differences.len() == 1 && differences[0].ends_with("… here"), "{differences:?}");
    let mut late = long.clone();
    late.world.pois[18] = [10.0, 11.0];
    let differences = folder::differences(&long, &late);
    assert!(
        differences[0].starts_with("  world.pois: …") && differences[0].contains("[10.0, 11.0]"),
        "{differences:?}"
    );
    // Without the config file, the checkpoint still identifies its config.
    fs::remove_file(path.join("config.toml")).unwrap();
    let error = session(&changed, &path, Start::Resume, Disk::default(), cpu(), None).end.unwrap_err().to_string();
    assert!(error.contains("is a run of another config, so it cannot continue with this one"), "{error}");
    // The interval of checkpoints may change.
    let mut rarer = config;
    rarer.checkpoint.generations = 0;
    assert_eq!(resume(&rarer, &path).1.start, 9);
}

#[test]
fn a_folder_has_one_process_at_a_time_and_one_run() {
    let config = small();
    let (_folder, path, _) = stopped_run(&config);
    let refused = |start| match Folder::open(&path, start, &config, StartFrom::Unspecified, Disk::default()) {
        Err(error) => error,
        Ok(_) => panic!("opened"),
    };
    assert!(matches!(refused(Start::Fresh), RecordError::Exists { .. }));
    let lock = Folder::open(&path, Start::Resume, &config, StartFrom::Unspecified, Disk::default()).unwrap();
    assert!(matches!(refused(Start::Resume), RecordError::Locked { .. }));
    assert!(matches!(refused(Start::Force), RecordError::Locked { .. }));
    drop(lock);
    fs::write(path.join("notes.txt"), "mine").unwrap();
    let outcome = session(&config, &path, Start::Force, Disk::default(), cpu(), Some(3));
    assert_eq!(outcome.start, 0);
    assert_eq!(checkpoint::list(&path.join("checkpoints")).unwrap(), [2, 3]);
    assert_eq!(fs::read(path.join("notes.txt")).unwrap(), b"mine");
}

#[test]
fn a_run_can_alternate_between_cpu_and_gpu() {
    let config = small();
    let expected = reference(&config);
    for (request, info) in support::adapters("a_run_can_alternate_between_cpu_and_gpu") {
        let gpu = || -> OpenBackend {
            let backend = GpuBackend::new(gpu::open(request.clone()).unwrap()).unwrap();
            (Box::new(backend), Machine { backend: "gpu".into(), ..Machine::default() })
        };
        let (_folder, path) = run_folder();
        for (stop_at, backend) in [(4, cpu()), (9, gpu()), (12, cpu())] {
            let outcome = session(&config, &path, Start::Resume, Disk::default(), backend, Some(stop_at));
            assert_eq!((outcome.end.unwrap(), outcome.reached), (SessionEnd::Stopped, stop_at));
        }
        let outcome = session(&config, &path, Start::Resume, Disk::default(), gpu(), None);
        assert_eq!((outcome.end.unwrap(), outcome.results), (SessionEnd::Finished, Some(expected.0.clone())), "{info}");
        assert_eq!(support::results(&path), expected.1, "{info}");
    }
}

/// Creates a folder with a config in `config.toml`. Commands run on the CPU, which saves the search for GPUs.
fn place(config: &str) -> Place {
    Place::new(&[("config.toml", config)]).on_cpu().slow()
}

/// Returns the command that trains `config.toml` into a folder.
fn line(out: &str, flags: &str) -> String {
    format!("train config.toml --out {out} {flags}")
}

/// Returns a command on the CPU that is not started yet, with captured output.
fn process(place: &Place, line: &str) -> Command {
    let mut command = support::flotilla();
    command.current_dir(place.root()).args(line.split_whitespace()).args(["--backend", "cpu"]);
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// Removes warnings. These short episodes cause one, because no agent reaches a POI.
fn without_warnings(text: &str) -> String {
    text.split_inclusive('\n').filter(|line| !line.starts_with("warning: ")).collect()
}

/// Returns the number of generations with complete rows in the metrics.
fn generations_recorded(path: &Path) -> usize {
    let metrics = fs::read_to_string(path.join(METRICS)).unwrap_or_default();
    let whole = metrics.rfind('\n').map_or("", |end| &metrics[..end]);
    whole.lines().skip(1).filter(|line| line.starts_with("1,")).count()
}

/// A run of one or two seconds, most of which are spent on checkpoints.
const HEAVY: &str = "
[world]
leaders = [[10, 5], [20, 5], [30, 5], [40, 5]]
followers = [[12, 2], [22, 2], [32, 2], [42, 2]]
pois = [[10, 9], [20, 9], [30, 9], [40, 9]]
coupling = 2
steps = 4
[policy]
hidden = [24, 24]
[learning]
population = 60
generations = 60
trials = 2
[checkpoint]
generations = 1
seconds = 0
";

#[test]
fn a_killed_run_resumes_to_the_same_results() {
    let kills: usize = std::env::var("FLOTILLA_KILLS").map_or(20, |text| text.parse().expect("a number of kills"));
    let config = Config::parse(HEAVY, "heavy.toml").unwrap();
    let expected = reference(&config);
    let place = place(HEAVY);
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let (mut killed, mut while_writing, mut runs) = (0, 0, 0);
    while killed < kills {
        let run = format!("run-{runs}");
        let out = place.path(&run);
        runs += 1;
        // Every second run first finishes with 25 generations, and is then extended.
        let mut lengths = if runs % 2 == 0 { vec!["60"] } else { vec!["60", "25"] };
        loop {
            let recorded = generations_recorded(&out);
            // The number of threads differs between starts.
            let threads = 1 + random.random_range(0..3);
            let length = lengths.last().expect("a length that remains");
            let flags = format!("--resume --threads {threads} --generations {length}");
            let moment = Instant::now() + Duration::from_micros(random.random_range(0..150_000));
            let is_time = || killed < kills && Instant::now() >= moment;
            let (ended, stderr) = run_or_kill(process(&place, &line(&run, &flags)), is_time);
            let stderr = without_warnings(&stderr);
            // A generation's row is written after the checkpoint before that generation. No recorded generation is
            // played again.
            if let Some((_, start)) = stderr.split_once("resuming at generation ") {
                let start: usize = start.split_whitespace().next().unwrap().parse().unwrap();
                // The last row is written before the policies. Without these, the run resumes at its last generation.
                let last: usize = length.parse().unwrap();
                assert!(start >= recorded.min(last), "{recorded} generations were recorded: {stderr}");
            } else {
                assert!(recorded == 0 || !stderr.contains("generation"), "{recorded} recorded: {stderr}");
            }
            if ended {
                lengths.pop();
                if lengths.is_empty() {
                    break;
                }
            } else {
                killed += 1;
                while_writing += usize::from(!leftovers(&out).is_empty());
            }
        }
        assert_eq!(support::results(&out), expected.1);
        assert_eq!(Run::read(&out.join("run.json")).unwrap().digest, Some(expected.0.digest.clone()));
        fs::remove_dir_all(out).unwrap();
    }
    println!("killed {killed} times, {while_writing} of them while a file was written, in {runs} runs");
}

/// Runs a command to its end, or kills it when `is_time` returns true. It must neither fail nor report damaged files.
/// Returns whether it ended by itself, and its standard error.
fn run_or_kill(mut command: Command, mut is_time: impl FnMut() -> bool) -> (bool, String) {
    let mut child = command.spawn().unwrap();
    let ended = loop {
        match child.try_wait().unwrap() {
            Some(status) => break Some(status),
            None if is_time() => {
                child.kill().unwrap();
                child.wait().unwrap();
                break None;
            }
            None => std::thread::sleep(Duration::from_micros(200)),
        }
    };
    let mut stderr = String::new();
    child.stderr.unwrap().read_to_string(&mut stderr).unwrap();
    assert!(!stderr.contains("set aside") && !stderr.contains("rewritten"), "{stderr}");
    assert!(ended.is_none_or(|status| status.success()), "{ended:?}: {stderr}");
    (ended.is_some(), stderr)
}

/// Kills and resumes a run up to `kills` times, then lets it finish. Returns the number of kills.
fn finish_under_kills(place: &Place, run: &str, flags: &str, kills: usize) -> usize {
    let out = &place.path(run);
    let (mut random, mut killed) = (ChaCha8Rng::seed_from_u64(2), 0);
    loop {
        let (before, start) = (generations_recorded(out), Instant::now());
        // Every kill waits for some progress, or 20 seconds, so that the run finishes eventually.
        let is_time = || {
            let progressed = generations_recorded(out) > before + random.random_range(0..9);
            killed < kills && (progressed || start.elapsed() > Duration::from_secs(20))
        };
        if run_or_kill(process(place, &line(run, &format!("--resume {flags}"))), is_time).0 {
            return killed;
        }
        killed += 1;
    }
}

#[test]
fn a_run_killed_around_changes_of_stage_resumes_to_the_same_results() {
    let staged = (1..20).map(|stage| {
        let (from, coupling) = (3 * stage, 1 + stage % 3);
        format!("[[stages]]\nfrom = {from}\nset = {{ world.coupling = {coupling}, learning.start_jitter = 0.5 }}\n")
    });
    let text = [HEAVY.to_string()].into_iter().chain(staged).collect::<String>();
    let expected = reference(&Config::parse(&text, "staged.toml").unwrap());
    let place = place(&text);
    let out = place.path("run");
    let killed = finish_under_kills(&place, "run", "", 8);
    assert!(killed >= 4, "killed {killed} times");
    assert_eq!(support::results(&out), expected.1);
    assert_eq!(Run::read(&out.join("run.json")).unwrap().digest, Some(expected.0.digest));
}

#[test]
fn a_killed_run_with_init_resumes_to_the_same_results() {
    let place = place(HEAVY);
    let [uninterrupted, out] = ["whole", "run"].map(|name| place.path(name));
    place.good(&line("source", "--generations 3"));
    let init = "--init source/policies.safetensors";
    place.good(&line("whole", init));
    let killed = finish_under_kills(&place, "run", init, 5);
    assert!(killed >= 3, "killed {killed} times");
    assert_eq!(support::results(&out), support::results(&uninterrupted));
    let digest = |path: &Path| Run::read(&path.join("run.json")).unwrap().digest;
    assert_eq!(digest(&out), digest(&uninterrupted));
    assert_ne!(digest(&out), Some(reference(&Config::parse(HEAVY, "heavy.toml").unwrap()).0.digest));
}

/// Waits until a condition is true, for at most 60 seconds.
fn wait_until(what: &str, mut condition: impl FnMut() -> bool) {
    let start = Instant::now();
    while !condition() {
        assert!(start.elapsed() < Duration::from_secs(60), "waited for 60 s: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn a_second_process_is_refused_until_the_first_ends() {
    let place = place(&HEAVY.replace("generations = 60", "generations = 100000"));
    let out = place.path("run");
    let mut first = process(&place, &line("run", "")).spawn().unwrap();
    wait_until("the run starts", || generations_recorded(&out) > 0);
    for flag in ["--resume", "--force"] {
        place.fails(1, &line("run", flag), &["error: another process is training in"]);
    }
    place.fails(1, &line("run", ""), &["holds a run already; pass --resume to continue it"]);
    first.kill().unwrap();
    first.wait().unwrap();
    place.fails(1, &line("run", "--resume --seed 3"), &["learning.seed: 0 there, 3 here"]);
    let mut resumed = process(&place, &line("run", "--resume")).spawn().unwrap();
    let recorded = generations_recorded(&out);
    wait_until("the run continues", || generations_recorded(&out) > recorded + 2);
    resumed.kill().unwrap();
    resumed.wait().unwrap();
}

#[test]
fn no_folder_is_changed_if_one_of_several_runs_cannot_start() {
    let place = tempfile::tempdir().unwrap();
    let [free, taken] = ["free", "taken"].map(|name| place.path().join(name));
    let open = |start: Start| {
        let runs = [&free, &taken].map(|path| (small(), path.clone()));
        Session::open(runs.into(), start, &Disk::default()).err().expect("an error about the taken folder").to_string()
    };
    let lock = Folder::open(&taken, Start::Fresh, &small(), StartFrom::Unspecified, Disk::default()).unwrap();
    assert!(open(Start::Fresh).contains("holds a run already") && !free.exists());
    fs::create_dir(&free).unwrap();
    fs::write(free.join(METRICS), metrics::HEADER).unwrap();
    assert!(open(Start::Force).starts_with("another process is training in"));
    assert_eq!(fs::read_to_string(free.join(METRICS)).unwrap(), metrics::HEADER);
    drop(lock);
}

/// Tests that no flag overwrites files that flotilla has not written.
#[test]
fn files_of_others_are_not_overwritten() {
    let text = format!("# Mine.\n{}", small().to_toml());
    let place = place(&text);
    fs::create_dir(place.path("mine")).unwrap();
    place.write("mine/config.toml", &text);
    // A run may start in a folder that has only its config file. That file is not rewritten.
    place.good("train mine/config.toml --out mine --resume --quiet");
    assert_eq!(place.read("mine/config.toml"), text);
    for name in [CONFIG, METRICS, POLICIES] {
        let out = format!("theirs {name}");
        fs::create_dir(place.path(&out)).unwrap();
        place.write(format!("{out}/{name}"), "of another program");
        for flag in ["--resume", "--force"] {
            let changed = "was not made by flotilla, or has been changed since, and would be";
            let words = ["train", "mine/config.toml", "--out", &out, flag];
            place.fails(1, &words, &[changed, name, "move it away"]);
            assert_eq!(place.read(format!("{out}/{name}")), "of another program");
            assert!(!place.path(&out).join(RUN).exists());
        }
    }
    // The policies of --init are not overwritten either.
    let policies = Path::new("mine").join(POLICIES);
    let before = place.bytes(&policies);
    for flag in ["--resume", "--force"] {
        let line = format!("train mine/config.toml --out mine {flag} --init {}", policies.display());
        place.fails(2, &line, &["would be written over it"]);
        assert!(place.bytes(&policies) == before && place.path("mine").join(RUN).exists());
    }
    // A run without its config file still refuses another config.
    fs::remove_file(place.path("mine/config.toml")).unwrap();
    place.refused(1, &line("mine", "--resume --seed 3"));
    place.good(&line("mine", "--resume"));
    assert!(place.bytes(&policies) == before);
}

/// Tests that a refused --force or --resume leaves all files of a paper unchanged.
#[test]
fn a_refused_paper_is_unchanged() {
    let place = Place::new(&[]).on_cpu().slow();
    let out = place.path("paper");
    let paper = |flags: &str| format!("paper --trials 1 --quiet --out paper {flags}");
    place.good(&paper("--generations 1"));
    let files = || {
        let names = fs::read_dir(&out).unwrap().map(|entry| entry.unwrap().path()).filter(|path| path.is_file());
        let mut files: Vec<_> = names.map(|path| (fs::read(&path).unwrap(), path)).collect();
        files.sort();
        files
    };
    let files_before = files();
    let mut arms: Vec<_> = fs::read_dir(out.join("arms")).unwrap().map(|entry| entry.unwrap().path()).collect();
    arms.sort();
    for arm in [&arms[0], &arms[arms.len() - 1]] {
        let config = Config::load(&arm.join(CONFIG)).unwrap();
        let lock = Folder::open(arm, Start::Resume, &config, StartFrom::Unspecified, Disk::default()).unwrap();
        let results = || arms.iter().map(|arm| support::results(arm)).collect::<Vec<_>>();
        let results_before = results();
        for flags in ["--generations 1 --force --seed 1", "--generations 2 --resume --seed 0"] {
            place.fails(1, &paper(flags), &["another process is training in"]);
            assert!(files() == files_before && results() == results_before, "{flags}");
        }
        drop(lock);
    }
}

#[cfg(unix)]
mod unix {
    use super::*;

    fn signal(child: &Child, name: &str) {
        let status = Command::new("kill").args([format!("-{name}"), child.id().to_string()]).status().unwrap();
        assert!(status.success());
    }

    /// Waits for the end of a process. Returns its status and what it printed to standard error.
    fn wait_for_end(child: Child) -> (ExitStatus, String) {
        let output = child.wait_with_output().unwrap();
        (output.status, String::from_utf8_lossy(&output.stderr).into_owned())
    }

    /// Reports whether a process ignores SIGHUP. On Linux only.
    fn ignores_hangup(process: &str) -> bool {
        let status = fs::read_to_string(format!("/proc/{process}/status")).unwrap();
        let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:")).unwrap();
        u64::from_str_radix(ignored.trim(), 16).unwrap() & 1 == 1
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_run_under_nohup_survives_a_hangup() {
        let place = place(HEAVY);
        let train = process(&place, &line("run", "--quiet"));
        let mut child = Command::new("nohup");
        child.current_dir(place.root()).arg(train.get_program()).args(train.get_args());
        let child = child.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        wait_until("the run starts", || place.path("run/run.json").exists());
        signal(&child, "HUP");
        let (status, message) = wait_for_end(child);
        assert_eq!(status.code(), Some(0), "{message}");
    }

    #[test]
    fn a_signal_stops_the_drawing_of_a_film() {
        let text = "[world]\nleaders = [[10, 5]]\npois = [[10, 9]]\nsteps = 200\n\
                    [learning]\npopulation = 4\ngenerations = 1\ntrials = 1\n";
        let place = place(text);
        place.good(&line("run", "--quiet"));
        let draw =
            |name: &str| process(&place, &format!("replay run --fps 50 --width 2000 --out {name}")).spawn().unwrap();
        let child = draw("%04d.png");
        wait_until("a picture is there", || place.path("0001.png").exists());
        signal(&child, "TERM");
        let (status, message) = wait_for_end(child);
        assert!(status.code() == Some(75) && message.contains("stopped: after "), "{message}");
        let pictures = place.names().len();
        let (_, all) = message.split_once(" of ").expect(&message);
        let all: usize = all.split(' ').next().unwrap().parse().unwrap();
        assert!(pictures < all, "{pictures} of {all}");
        // A GIF is written whole or not at all.
        let child = draw("film.gif");
        std::thread::sleep(Duration::from_millis(500));
        signal(&child, "TERM");
        let (status, message) = wait_for_end(child);
        assert!(status.code() == Some(75) && !place.path("film.gif").exists(), "{message}");
    }

    #[test]
    fn a_signal_stops_a_run_after_its_generation_and_prints_how_to_resume() {
        let config = Config::parse(HEAVY, "heavy.toml").unwrap();
        let expected = reference(&config);
        let place = place(HEAVY);
        // Only signals cause checkpoints here.
        let flags = "--checkpoint-generations 0 --checkpoint-seconds 0 --quiet";
        for name in ["TERM", "INT", "HUP"] {
            if name == "HUP" && (!cfg!(target_os = "linux") || ignores_hangup("self")) {
                continue;
            }
            let out = place.path(name);
            let child = process(&place, &line(name, flags)).spawn().unwrap();
            wait_until("the run starts", || out.join("run.json").exists());
            signal(&child, name);
            let (status, message) = wait_for_end(child);
            assert_eq!(status.code(), Some(75), "{message}");
            let (_, command) = message.split_once("continue with\n  flotilla ").expect(&message);
            assert!(
                without_warnings(&message).starts_with("stopped: before generation")
                    && command.contains("--backend cpu"),
                "{message}"
            );
            let (stdout, stderr) = place.good(command);
            assert!(stderr.contains("resuming at generation"), "{stderr}");
            assert!(stdout.contains(&expected.0.digest));
            assert_eq!(support::results(&out), expected.1);
        }
    }

    #[test]
    fn a_stopped_run_whose_folder_was_moved_is_not_resumed_at_its_old_path() {
        let place = place(HEAVY);
        let out = place.path("run");
        let child = process(&place, &line("run", "--quiet")).spawn().unwrap();
        wait_until("the run starts", || out.join(CONFIG).exists());
        fs::rename(&out, place.path("moved")).unwrap();
        signal(&child, "TERM");
        let (status, message) = wait_for_end(child);
        assert_eq!(status.code(), Some(75), "{message}");
        assert!(message.contains("was moved: continue with --resume and its new path"), "{message}");
        place.good(&line("moved", "--resume --quiet"));
    }

    #[test]
    fn an_interrupt_after_another_signal_stops_a_run_at_once() {
        let text = HEAVY.replace("population = 60", "population = 2000").replace("steps = 4", "steps = 10000");
        let place = place(&text);
        let child = process(&place, &line("run", "--threads 1")).spawn().unwrap();
        wait_until("the run starts", || place.path("run/run.json").exists());
        let start = Instant::now();
        signal(&child, "TERM");
        std::thread::sleep(Duration::from_millis(100));
        signal(&child, "INT");
        assert_eq!(wait_for_end(child).0.code(), Some(130));
        assert!(start.elapsed() < Duration::from_secs(5));
    }

    #[test]
    fn sigusr1_writes_a_checkpoint_and_the_run_continues() {
        let place = place(&HEAVY.replace("generations = 60", "generations = 100000"));
        let flags = "--checkpoint-generations 0 --checkpoint-seconds 0";
        let child = process(&place, &line("run", flags)).spawn().unwrap();
        wait_until("the run starts", || place.path("run/run.json").exists());
        let checkpoints = place.path("run/checkpoints");
        assert!(checkpoint::list(&checkpoints).unwrap().is_empty());
        for count in [1, 2] {
            signal(&child, "USR1");
            wait_until("a checkpoint", || checkpoint::list(&checkpoints).unwrap().len() == count);
        }
        signal(&child, "TERM");
        assert_eq!(wait_for_end(child).0.code(), Some(75));
    }

    /// Limits the size of files with `ulimit -f`, so that the system itself refuses a write.
    #[test]
    fn a_write_that_the_system_refuses_is_reported_and_the_run_resumes() {
        let config = Config::parse(HEAVY, "heavy.toml").unwrap();
        let expected = reference(&config);
        let place = place(HEAVY);
        // Not even a checkpoint fits.
        let resume = line("run", "--resume");
        let script = format!("trap '' XFSZ; ulimit -f 100; exec flotilla {resume} --backend cpu");
        let refused = support::shell("sh", &script).current_dir(place.root()).output().unwrap();
        let message = String::from_utf8_lossy(&refused.stderr);
        assert_eq!(refused.status.code(), Some(1), "{message}");
        assert!(message.contains(".safetensors: cannot be written"), "{message}");
        place.good(&resume);
        assert_eq!(support::results(&place.path("run")), expected.1);
    }

    #[test]
    fn an_output_folder_that_cannot_be_created_is_refused() {
        let place = place(&text());
        let message = place.fails(1, &line("config.toml", ""), &["is a file; choose a folder"]);
        assert!(message.starts_with("error: "), "{message}");
        // The parent is a file.
        place.fails(1, &line("config.toml/run", ""), &["cannot be written"]);
    }
}
