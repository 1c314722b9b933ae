//! `flotilla train`: trains the teams of a config, and saves the run.

use std::fmt::Write;
use std::path::PathBuf;

use super::recovery::{Checkpoints, quoted};
use super::{ConfigArgs, Error, ExistingResults, Printed, RunOptions, console, with_remedy};
use flotilla::escape::PathExt;
use flotilla::file;
use flotilla_app::ops::train::{self, Extremes, TrainOutcome, TrainRequest};
use flotilla_app::record::folder::{self, CONFIG, METRICS, POLICIES, RUN, Start};
use flotilla_app::record::ownership::CURVES;
use flotilla_app::report::map::{counted, weighted};
use flotilla_app::report::runs::TeamKind;

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    config: ConfigArgs,
    #[command(flatten)]
    run: RunOptions,
    /// Output directory [default: runs/NAME after the config's file, or the next free runs/NAME-2, …;
    /// with --resume the latest of them, with --force runs/NAME]
    #[arg(long, short, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    existing: ExistingResults,
    /// Start from the policies in a safetensors file instead of random ones. Trial i takes the tensor `weights.i`, or
    /// all take `weights`: f32 [populations, policies, parameters]. Missing policies are random
    #[arg(long, value_name = "FILE")]
    init: Option<PathBuf>,
    #[command(flatten)]
    printed: Printed,
    #[command(flatten)]
    checkpoints: Checkpoints,
}

pub fn run(args: Args) -> Result<(), Error> {
    let Args { config, run, out, existing, init, printed, checkpoints } = args;
    let (name, start) = (config.name(), existing.start());
    // Without its folder, the run in `runs/config` would be meant.
    if let (None, Start::Resume | Start::Force, Some(_)) = (&out, start, folder::owner(&config.file.path)) {
        let run = file::folder(&config.file.path);
        let text = format!("{} is the config of the run in {}", config.file.path.escaped(), run.escaped());
        return Err(Error::Usage(with_remedy(
            text,
            format!("name that folder with --out {}, or another", quoted(run)),
        )));
    }
    let request = TrainRequest { config: config.text(checkpoints.list())?, name, out, start, init };
    let found = console::run(&run, printed.quiet, |backends, context| train::run(&request, backends, context))?;
    printed.summary(&found, report)
}

/// Returns a time in seconds, or in milliseconds if it is short.
fn time(seconds: f64) -> String {
    match seconds * 1000.0 {
        short if short < 9.95 => format!("{short:.1} ms"),
        short if short < 99.5 => format!("{short:.0} ms"),
        _ => format!("{seconds:.1} s"),
    }
}

/// Returns the report of a run for people.
fn report(found: &TrainOutcome) -> String {
    let TrainOutcome { folder, rows: ends, digest, .. } = found;
    let trained = match &found.trained_on {
        None => "This run was done already".into(),
        Some(on) => format!(
            "Trained {} of {} teams, {}, in {} ({:.1} generations/s) on {on}",
            counted(found.trials, "trial"),
            found.teams,
            match found.generations - found.trained_generations.min(found.generations) {
                0 => counted(found.generations, "generation"),
                before => format!("{} after generation {before}", counted(found.trained_generations, "generation")),
            },
            time(found.seconds),
            found.trained_generations as f64 / found.seconds.max(1e-9),
        ),
    };
    // `None` if stages have different numbers of POIs.
    let pois_of_all = found.pois;
    let weighted = weighted(found.weighted_by);
    let what = pois_of_all.map_or("Share of POIs observed".into(), |pois| format!("POIs observed, of {pois}"));
    let what = what + &weighted;
    let pois = pois_of_all.unwrap_or(1);
    let mut text = format!("{trained}.\n\n{what}: mean over trials (lowest to highest trial)\n");
    // Rows of different stages are of different tasks.
    let (mut first, mut last) = (String::from("start"), format!("generation {}", found.generations));
    if let Some(stage) = found.last_stage {
        first += ", stage 0";
        let _ = write!(last, ", stage {stage}");
    }
    let known = TeamKind::ALL.into_iter().filter(|score| ends.last.iter().all(|row| score.of(row).is_some()));
    let known: Vec<TeamKind> = known.collect();
    let mut table = vec![[""].into_iter().chain(known.iter().map(|score| score.name())).map(String::from).collect()];
    let rows = [(&*first, &ends.first), (&*last, &ends.last)];
    // A run without generations after the start has one row.
    let shown = if found.generations == 0 { 1 } else { rows.len() };
    for (name, rows) in rows.into_iter().take(shown) {
        let cells = known.iter().map(|score| {
            let shares = rows.iter().filter_map(|row| score.of(row));
            let Extremes { mean, lowest, highest } = Extremes::of(shares.map(|share| share * pois as f64));
            format!("{mean:.2} ({lowest:.2} to {highest:.2})")
        });
        table.push([name.to_string()].into_iter().chain(cells).collect::<Vec<String>>());
    }
    // Columns fit their contents, because 100 POIs need more room than 4.
    let width = |column: usize| table.iter().map(|row| row[column].len()).max().unwrap_or(0);
    for row in &table {
        let cells: Vec<String> =
            row.iter().zip(0..).map(|(cell, column)| format!("{cell:<0$}", width(column))).collect();
        let line = format!("  {}  {}", cells[0], cells[1..].join("   "));
        let _ = writeln!(text, "{}", line.trim_end());
    }
    let replayed = quoted(folder);
    let film = quoted(&folder.join("champion.gif"));
    let best = ends.last.iter().reduce(|a, b| if b.champion_g > a.champion_g { b } else { a });
    let (best, observed) = best.map_or((0, 0.0), |row| (row.trial, row.champion_g * pois as f64));
    let what = pois_of_all.map_or("share of POIs".into(), |pois| format!("of {}", counted(pois, "POI")));
    let _ = match observed > 0.0 {
        true => write!(text, "\nThe best champion is that of trial {best}: {observed:.2} {what}{weighted}.\n"),
        false => write!(text, "\nNo champion observed any POI. The film below shows what that of trial {best} does.\n"),
    };
    let _ = write!(
        text,
        "
Files in {}:
  {METRICS:<22}every trial, generation by generation
  {POLICIES:<22}what was learned, best policy first
  {CURVES:<22}its learning curves, to look at
  {:<22}the config, every default written out
  {:<22}what it ran on; digest {digest}

Next:
  flotilla replay {replayed} --trial {best}
  flotilla replay {replayed} --trial {best} --out {film}
  flotilla rollout {replayed} --trial {best} --scores scores.csv
",
        folder.escaped(),
        CONFIG,
        RUN,
    );
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_and_times_are_as_people_write_them() {
        assert_eq!([0, 1, 2].map(|count| counted(count, "trial")), ["0 trials", "1 trial", "2 trials"]);
        let times = [0.0004, 0.0123, 0.0994, 0.0996, 12.34].map(time);
        assert_eq!(times, ["0.4 ms", "12 ms", "99 ms", "0.1 s", "12.3 s"]);
    }
}
