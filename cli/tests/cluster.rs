//! Tests the program on shared machines.
//!
//! This covers batch systems, file systems without locks, broken clocks, and unusual names and files.
#![cfg(target_os = "linux")]

use crate::support;
use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::process::ExitStatusExt;
use std::process::{Command, Output};
use std::time::{Duration, Instant};

use crate::support::{Place, TINY, tiny};
use flotilla::Config;
use flotilla_app::record::checkpoint;
use flotilla_app::record::disk::Disk;
use flotilla_app::record::hex;
use sha2::{Digest, Sha256};

/// A config with many short generations, which takes minutes.
fn long_config() -> String {
    tiny(200000, "generations = 0")
}

fn place() -> Place {
    let small = tiny(4, "generations = 1");
    Place::new(&[("small.toml", &small), ("grid.toml", &format!("{small}[grid]\n\"world.coupling\" = [1, 2]\n"))])
}

/// Builds a library for `LD_PRELOAD` that replaces functions of the C library.
fn preload(place: &Place, source: &str) {
    place.write("preload.c", source);
    let mut compiler = Command::new("cc");
    compiler.args(["-shared", "-fPIC", "-o", "preload.so", "preload.c"]).current_dir(place.root());
    let output = compiler.output().expect("a C compiler");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Starts a long run in `out`, sends it signals once it trains, and returns its output.
fn signalled_run(place: &Place, out: &OsStr, signals: &[&str]) -> Output {
    place.write("long.toml", long_config());
    let mut child = support::flotilla();
    let mut flag = OsStr::new("--out=").to_owned();
    flag.push(out);
    child.args(["train", "long.toml", "--backend", "cpu", "--quiet"]).arg(flag).current_dir(place.root());
    let child = child.stderr(std::process::Stdio::piped()).stdout(std::process::Stdio::null()).spawn().unwrap();
    let start = Instant::now();
    while !place.path(out).join("run.json").exists() {
        assert!(start.elapsed() < Duration::from_secs(60));
        std::thread::sleep(Duration::from_millis(20));
    }
    for signal in signals {
        assert!(Command::new("kill").args([*signal, &child.id().to_string()]).status().unwrap().success());
    }
    child.wait_with_output().unwrap()
}

#[test]
fn repeated_sigterm_saves_and_exits_with_75() {
    let place = place();
    let output = signalled_run(&place, OsStr::new("run"), &["-TERM"; 5]);
    assert_eq!(output.status.code(), Some(75), "{} {:?}", stderr(&output), output.status.signal());
    assert!(stderr(&output).contains("with everything saved"), "{}", stderr(&output));
    assert!(place.read("run/run.json").contains("\"stopped\""));
}

#[test]
fn the_printed_resume_command_works_with_unusual_names() {
    for out in [&b"-y"[..], b"--force", b"a b'c", b"\xff$HOME"] {
        let place = place();
        let out = OsStr::from_bytes(out);
        let output = signalled_run(&place, out, &["-TERM"]);
        let text = stderr(&output);
        assert_eq!(output.status.code(), Some(75), "{text}");
        let command = text.lines().last().unwrap().trim();
        // The command finds the run, which cannot become shorter.
        place.write("script", format!("{command} --quiet --generations 1"));
        let output = place.shell("bash script");
        let (code, text) = (output.status.code(), stderr(&output));
        assert!(code == Some(1) && text.contains("is a run of"), "{command}: {text}");
    }
}

#[test]
fn a_config_named_dots_gets_its_own_directory() {
    let place = place();
    fs::copy(place.path("small.toml"), place.path("...toml")).unwrap();
    let existing = place.names();
    place.good("train ...toml --quiet");
    place.good("train ...toml --force --quiet");
    assert!(place.path("runs/config/run.json").exists());
    fs::copy(place.path("grid.toml"), place.path("...toml")).unwrap();
    place.good("sweep ...toml --quiet");
    assert!(place.path("runs/sweep/points/0000/run.json").exists());
    let added: Vec<_> = place.names().into_iter().filter(|name| !existing.contains(name)).collect();
    assert!(added.iter().all(|name| name.starts_with("runs")), "{added:?}");
}

#[test]
fn errors_in_a_stage_name_the_flag_that_caused_them() {
    let stage = "[[stages]]\nfrom = 3\nset = { \"world.coupling\" = 3 }\n";
    let place = Place::new(&[("staged.toml", &format!("{TINY}{stage}"))]);
    place.good("check staged.toml");
    let text = place.refused(2, "check staged.toml --seed 7 --set world.observers=\"leaders\"");
    assert!(text.contains("--set") && text.contains("stages[0]") && !text.contains("--seed"), "{text}");
    // Errors in the file do not mention flags.
    place.write("wrong.toml", format!("{TINY}{}", stage.replace("= 3 }", "= 300 }")));
    let text = place.refused(1, "check wrong.toml --seed 7");
    assert!(text.contains("wrong.toml:") && !text.contains("--seed"), "{text}");
}

#[test]
fn a_clock_beyond_the_year_9999_is_tolerated() {
    let place = place();
    preload(
        &place,
        "#define _GNU_SOURCE\n#include <dlfcn.h>\n#include <time.h>\n
        int clock_gettime(clockid_t clock, struct timespec *time) {
            static int (*real)(clockid_t, struct timespec *);
            if (!real) real = dlsym(RTLD_NEXT, \"clock_gettime\");
            int result = real(clock, time);
            if (clock == CLOCK_REALTIME) time->tv_sec = 253402300800;
            return result;
        }",
    );
    place.script(0, "LD_PRELOAD=$PWD/preload.so exec flotilla train small.toml --out run --backend cpu --quiet", &[]);
    assert!(place.read("run/run.json").contains("9999-12-31T23:59:59Z"));
}

#[test]
fn bench_rejects_a_clock_that_does_not_advance() {
    let place = place();
    preload(
        &place,
        "#include <time.h>\n#include <sys/syscall.h>\n#include <unistd.h>\n
        int clock_gettime(clockid_t clock, struct timespec *time) {
            if (clock != CLOCK_MONOTONIC) return syscall(SYS_clock_gettime, clock, time);
            time->tv_sec = 1000;
            time->tv_nsec = 0;
            return 0;
        }",
    );
    // The limit counts processor time, so that a busy machine does not matter.
    let script = "ulimit -t 60; LD_PRELOAD=$PWD/preload.so exec flotilla bench --backend cpu --threads 1 --teams 2";
    place.script(1, script, &["clock does not advance"]);
}

#[test]
fn a_file_system_without_locks_causes_a_warning() {
    let place = place();
    preload(
        &place,
        "#include <errno.h>\n
        int flock(int file, int operation) { errno = ENOLCK; return -1; }",
    );
    for command in ["train small.toml --out run", "sweep grid.toml --out sweep", "train small.toml --out run --resume"]
    {
        let script = format!("LD_PRELOAD=$PWD/preload.so exec flotilla {command} --backend cpu --quiet");
        let text = place.script(0, &script, &[]);
        assert_eq!(text.matches("this file system has no locks").count(), 1, "{command}: {text}");
    }
}

#[test]
fn names_are_escaped_in_tables() {
    let place = place();
    place.good("train small.toml --out run --quiet");
    place.shell("cp -r run '=1+1'; cp -r run 'a|b'; cp -r run -- -0.5");
    let (table, _) = place.good(&["compare", "=1+1", "a|b"][..]);
    for line in table.lines().filter(|line| line.starts_with('|')) {
        let columns = line.replace(r"\|", "").matches('|').count();
        assert!(columns == 5 || columns == 6 || columns == 7, "{line}");
    }
    assert!(table.contains(r"a\|b"), "{table}");
    let (csv, _) = place.good(&["compare", "=1+1", "./-0.5", "--csv"][..]);
    assert!(csv.contains(",'=1+1,") && !csv.contains(",=1+1,"), "{csv}");
}

#[test]
fn names_that_differ_print_differently() {
    let place = place();
    let texts = [&b"\xff"[..], b"\xfe"].map(|name| {
        let name = OsStr::from_bytes(name);
        let outputs = ["plot", "replay", "train"].map(|command| {
            let output = support::flotilla().arg(command).arg(name).current_dir(place.root()).output().unwrap();
            assert_eq!(output.status.code(), Some(1));
            stderr(&output)
        });
        outputs.concat()
    });
    assert!(texts[0] != texts[1] && texts[0].contains(r"\xff") && texts[1].contains(r"\xfe"), "{texts:?}");
    assert_eq!(texts[0].replace(r"\xff", r"\xfe"), texts[1]);
}

/// Overwrites a part of a file with the same number of bytes.
fn replace(bytes: &mut [u8], from: &[u8], to: &[u8]) {
    let start = bytes.windows(from.len()).position(|part| part == from).unwrap();
    bytes[start..start + to.len()].copy_from_slice(to);
}

#[test]
fn a_run_resumes_from_an_impossible_training_time() {
    let place = place();
    place.good("train small.toml --out run --quiet");
    place.good("train small.toml --out whole --generations 8 --quiet");
    let config = Config::load(&place.path("run/config.toml")).unwrap();
    let checkpoints = place.path("run/checkpoints");
    for generation in checkpoint::list(&checkpoints).unwrap() {
        let path = checkpoint::path(&checkpoints, generation);
        let original = checkpoint::read(&path, &place.path("run/policies.safetensors"), &config).unwrap();
        let mut forged = original.unwrap();
        // Has as many characters as its replacement below.
        forged.seconds = 12345.0;
        forged.write(&Disk::default(), &path, &config).unwrap();
        let mut bytes = fs::read(&path).unwrap();
        replace(&mut bytes, b"12345", b"1e250");
        let zeros = [b'0'; 64];
        let start = bytes.windows(10).position(|part| part == b"\"sha256\":\"").unwrap() + 10;
        bytes[start..start + 64].copy_from_slice(&zeros);
        let sum = hex(&Sha256::digest(&bytes));
        bytes[start..start + 64].copy_from_slice(sum.as_bytes());
        fs::write(&path, bytes).unwrap();
    }
    let (_, text) = place.good("train small.toml --out run --resume --generations 8 --quiet");
    assert!(text.contains("generation 5") && !text.contains("set aside"), "{text}");
    let digest = |run: &str| {
        let text = place.read(format!("{run}/run.json"));
        text.lines().find(|line| line.contains("\"digest\"")).unwrap().to_string()
    };
    assert_eq!(digest("run"), digest("whole"));
    place.good("plot run");
}

#[test]
fn errors_about_missing_files_suggest_a_remedy() {
    let place = place();
    for (command, remedy) in [
        ("train missing.toml", "check the path, or write a config with `flotilla init`"),
        ("sweep missing.toml", "check the path, or write a config with `flotilla init`"),
        ("rollout small.toml --policies missing.safetensors", "check the path"),
        ("train small.toml --init missing.safetensors", "check the path"),
    ] {
        place.fails(1, command, &["missing.", "cannot be read: ", remedy]);
    }
}

/// Texts of a megabyte, the maximum for a config. These took half a minute or more when reading took quadratic time.
#[test]
fn the_longest_configs_are_rejected_within_seconds() {
    const LENGTH: usize = 1 << 20;
    let repeated = |start: &str, part: &str, end: &str| {
        format!("{start}{}{end}", part.repeat((LENGTH - start.len() - end.len()) / part.len()))
    };
    let numbered = |start: &str, line: fn(usize) -> String| {
        let mut text = start.to_string();
        for number in 0.. {
            let line = line(number);
            if text.len() + line.len() > LENGTH {
                return text;
            }
            text += &line;
        }
        text
    };
    let stages = format!("{TINY}[[stages]]\nfrom = 1\n[stages.set]\n");
    let texts = [
        ("returns", repeated("", "\r", "")),
        ("escapes", repeated("a=\"", r"\q", "\"")),
        ("lines", repeated("", "=\n", "")),
        ("twice", repeated("", "a=1\n", "")),
        ("strays", numbered("", |number| format!("k{number}=1\n"))),
        ("sections", numbered("", |number| format!("[s{number}]\nx=1\n"))),
        ("keys", numbered("[world]\n", |number| format!("k{number}=1\n"))),
        ("stages", numbered(&stages, |number| format!("\"policy.{number}\"=1\n"))),
    ];
    for (name, text) in texts {
        let place = Place::new(&[("x.toml", &text)]);
        // The limit counts processor time, so that a busy machine does not matter.
        let lines = place.script(1, "ulimit -t 20; exec flotilla check x.toml", &[]).lines().count();
        assert!(lines <= 52, "{name}: {lines} lines");
    }
}
