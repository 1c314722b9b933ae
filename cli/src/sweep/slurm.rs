//! The batch script of a Slurm job array that trains a sweep, one shard per task.

use std::ffi::{OsStr, OsString};
use std::path::Path;

use super::Args;
use crate::BackendChoice;
use flotilla::escape::{self, PathExt};
use flotilla_app::shell;

/// Returns the script for a sweep with a name. `command` is the command line of a shard, without `--shard` and
/// `--resume`, and `out` the sweep's folder.
///
/// # Errors
/// A word that cannot be part of a line, or a folder in which Slurm cannot number logs.
pub fn script(name: &str, command: &[OsString], out: &Path, args: &Args) -> Result<String, String> {
    let Args { shards, time, sbatch, .. } = args;
    let options = sbatch.iter().map(OsStr::new);
    let words = command.iter().map(OsString::as_os_str).chain(options).chain([OsStr::new(time)]);
    let is_plain = |word: &OsStr| word.to_str().is_some_and(|word| !word.contains(escape::is_control));
    if let Some(word) = words.into_iter().find(|word| !is_plain(word)) {
        let word = Path::new(word).escaped();
        let word = escape::line(&word);
        return Err(format!("a batch script cannot hold '{word}'; choose names in UTF-8, without line breaks"));
    }
    let name: String =
        name.chars().map(|c| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '-' }).collect();
    let command = shell::command(command);
    let out = out.escaped();
    if out.contains('\\') {
        return Err(format!(
            "{out}: Slurm cannot number logs in a folder whose name has a backslash; choose another --out"
        ));
    }
    let log = shell::quoted(format!("{}/slurm-%a.log", out.replace('%', "%%")));
    let gpus = args.gpus.unwrap_or(usize::from(args.run.backend != BackendChoice::Cpu));
    let gpus = if gpus > 0 { format!("#SBATCH --gpus-per-task={gpus}\n#SBATCH --ntasks=1\n") } else { String::new() };
    let cpus = args.run.threads.map_or(2, usize::from);
    let options: String = sbatch.iter().map(|option| format!("#SBATCH {option}\n")).collect();
    Ok(format!(
        r#"#!/bin/bash
#SBATCH --job-name={name}
#SBATCH --array=1-{shards}
#SBATCH --time={time}
#SBATCH --cpus-per-task={cpus}
{gpus}#SBATCH --signal=B:USR1@60
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output={log}
{options}
# A minute before the time limit Slurm sends USR1 to this shell: flotilla saves and stops, and the task returns to the
# queue and resumes. TERM arrives when the task is cancelled, preempted or out of time: flotilla saves and stops, and
# the task does not return by itself. Slurm requeues tasks that it preempts or whose node fails (--requeue).
# When all tasks are done: {collect}
run=
warned=
ended=
signalled=
stop() {{ signalled=1; [ -z "$run" ] || kill -TERM "$run" 2>/dev/null; }}
trap 'warned=1; stop' USR1
trap 'ended=1; stop' TERM

{command} --shard "$SLURM_ARRAY_TASK_ID/{shards}" --resume &
run=$!
[ -z "$signalled" ] || stop
# A trapped signal interrupts `wait` while flotilla is still saving.
code=127
while
    signalled=
    wait "$run"
    status=$?
    [ "$status" -eq 127 ] || code=$status
    [ -n "$signalled" ]
do :; done
# 75: stopped by a signal, with everything saved.
if [ "$code" -eq 75 ] && [ -n "$warned" ] && [ -z "$ended" ]; then
    echo "the time limit is near: the task returns to the queue"
    exec scontrol requeue "${{SLURM_ARRAY_JOB_ID}}_$SLURM_ARRAY_TASK_ID"
fi
exit "$code"
"#,
        collect = format_args!("{command} --collect"),
    ))
}
