//! The batch script of a Slurm job array that runs a sweep, a shard a task.

use std::path::Path;

use crate::{escape, shell};

/// What the script asks for.
#[derive(Clone, Debug, PartialEq)]
pub struct Job<'a> {
    /// The sweep's name.
    pub name: &'a str,
    /// The command line that runs a shard, without `--shard` and `--resume`.
    pub command: Vec<String>,
    /// The sweep's folder.
    pub out: &'a Path,
    /// Tasks of the array.
    pub shards: usize,
    /// Time limit of a task, as Slurm reads it: `01:00:00`.
    pub time: &'a str,
    /// GPUs of a task.
    pub gpus: usize,
    /// Processors of a task.
    pub cpus: usize,
    /// More `#SBATCH` options: `--partition=…`, `--account=…`.
    pub options: &'a [String],
}

impl Job<'_> {
    /// The script.
    ///
    /// # Errors
    /// A word that a line of a script cannot hold, or a folder whose logs Slurm could not name.
    pub fn script(&self) -> Result<String, String> {
        let words = self.command.iter().chain(self.options).map(String::as_str).chain([self.time]);
        // A path that is not UTF-8 was written with this in the place of what it is.
        if let Some(word) =
            words.into_iter().find(|word| word.contains(escape::is_control) || word.contains('\u{fffd}'))
        {
            let word = escape::line(word);
            return Err(format!("a batch script cannot hold '{word}'; choose names in UTF-8, without line breaks"));
        }
        let Job { name, command, out, shards, time, gpus, cpus, options } = self;
        let name: String =
            name.chars().map(|c| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '-' }).collect();
        let command = shell::command(command);
        let out = out.display().to_string();
        if out.contains('\\') {
            return Err(format!("Slurm numbers no logs in a folder with a backslash, {out}; choose another --out"));
        }
        let log = shell::quoted(&format!("{}/slurm-%a.log", out.replace('%', "%%")));
        let gpus =
            if *gpus > 0 { format!("#SBATCH --gpus-per-task={gpus}\n#SBATCH --ntasks=1\n") } else { String::new() };
        let options: String = options.iter().map(|option| format!("#SBATCH {option}\n")).collect();
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
# A minute before the time limit Slurm sends USR1 to this shell. The run is told to save and stop, and the task goes
# back into the queue, to go on from there. So it does when Slurm itself preempts the task or loses its node.
# When all tasks are done: {collect}
run=
warned=
warn() {{ warned=1; [ -z "$run" ] || kill -TERM "$run"; }}
trap warn USR1 TERM

{command} --shard "$SLURM_ARRAY_TASK_ID/{shards}" --resume &
run=$!
wait "$run"
code=$?
# A trapped signal ends `wait` early; the run itself is still saving.
while kill -0 "$run" 2>/dev/null; do
    wait "$run"
    code=$?
done
if [ -n "$warned" ] && [ "$code" -ne 0 ]; then
    echo "time is nearly up: back into the queue"
    exec scontrol requeue "${{SLURM_ARRAY_JOB_ID}}_$SLURM_ARRAY_TASK_ID"
fi
exit "$code"
"#,
            collect = format_args!("{command} --collect"),
        ))
    }
}
