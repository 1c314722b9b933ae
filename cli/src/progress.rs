//! Progress on standard error: a bar or the learning curve of every arm on a terminal, otherwise a line every few
//! seconds.

use std::io::{self, IsTerminal, Write};
use std::time::Duration;

use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};

use flotilla::host::Instant;
use flotilla::trainer::Row;

/// Characters per curve. With the longest name and the value, a line fits the usual 80 columns.
const CURVE: usize = 24;
/// Maximum number of curves on a terminal.
const MAX_BARS: usize = 24;
/// Interval between lines without a terminal. The next one is the interval between redraws on a terminal.
const LINES: Duration = Duration::from_secs(10);
const DRAWS: Duration = Duration::from_millis(100);
/// Number of steps of a full bar.
const PARTS: u64 = 1000;

/// Reports whether standard error can be redrawn. `name` is the value of `TERM`.
fn is_capable(terminal: bool, name: Option<&str>) -> bool {
    terminal && name.map_or(cfg!(windows), |name| name != "dumb")
}

/// Shows the progress of one task on standard error: a fraction, or the training of several arms.
pub(crate) struct Progress {
    quiet: bool,
    /// When progress was last shown, and the interval after which it is shown again.
    shown: Instant,
    pause: Duration,
    /// The bars, which a terminal shows. `None` without a terminal: then lines are written.
    terminal: Option<MultiProgress>,
    lines: Box<dyn Write + Send>,
    /// The bar of the whole task. It estimates the rate and the time left, whether it is drawn or not.
    whole: ProgressBar,
    /// The curve of every arm, and its line on the terminal. Empty for a fraction.
    arms: Vec<(GrowingCurve, ProgressBar)>,
}

/// One arm's curve so far: for each part of the run, the sum of the champions' G and the number of rows.
struct GrowingCurve {
    /// Number of POIs. None if stages differ in it.
    pois: Option<usize>,
    parts: Vec<(f64, u32)>,
    newest: Newest,
}

/// The newest generation: sums of the champions' and the mean teams' G over trials.
#[derive(Clone, Copy, Default)]
struct Newest {
    generation: usize,
    champion: f64,
    mean: f64,
    trials: u32,
}

impl GrowingCurve {
    fn add(&mut self, row: &Row, last: usize) {
        let part = (row.generation * self.parts.len() / (last + 1)).min(self.parts.len() - 1);
        self.parts[part].0 += row.champion_g;
        self.parts[part].1 += 1;
        if row.generation != self.newest.generation {
            self.newest = Newest { generation: row.generation, ..Newest::default() };
        }
        self.newest.champion += row.champion_g;
        self.newest.mean += row.mean_g;
        self.newest.trials += 1;
    }

    /// Returns the curve so far, one character per part of the run.
    fn spark(&self) -> String {
        const LEVELS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];
        let level = |&(sum, count): &(f64, u32)| match count {
            0 => ' ',
            _ => LEVELS[((sum / f64::from(count) * LEVELS.len() as f64) as usize).min(LEVELS.len() - 1)],
        };
        self.parts.iter().map(level).collect()
    }

    /// Returns the newest generation's mean over trials, in POIs if their number is known. `in_words` adds the mean
    /// team and labels.
    fn value(&self, in_words: bool) -> String {
        let Newest { champion, mean, trials, .. } = self.newest;
        let pois = |sum: f64| sum / f64::from(trials.max(1)) * self.pois.unwrap_or(1) as f64;
        match (in_words, self.pois) {
            (true, Some(all)) => format!("champion {:.2}, mean {:.2} of {all} POIs", pois(champion), pois(mean)),
            (true, None) => format!("champion {:.2}, mean {:.2} of the POIs", pois(champion), pois(mean)),
            (false, Some(all)) => format!("{:.2}/{all}", pois(champion)),
            (false, None) => format!("{:.2}", pois(champion)),
        }
    }
}

impl Progress {
    fn new(quiet: bool, length: u64, template: &str) -> Progress {
        let is_terminal = !quiet && is_capable(io::stderr().is_terminal(), std::env::var("TERM").ok().as_deref());
        let terminal = is_terminal.then(|| MultiProgress::with_draw_target(ProgressDrawTarget::stderr()));
        let whole =
            ProgressBar::with_draw_target(Some(length), ProgressDrawTarget::hidden()).with_style(style(template));
        let pause = if is_terminal { DRAWS } else { LINES };
        let lines = Box::new(io::stderr());
        Progress { quiet, shown: Instant::now(), pause, terminal, lines, whole, arms: vec![] }
    }

    /// Starts to show a fraction. With `quiet` nothing is ever shown.
    pub fn of_fraction(quiet: bool) -> Progress {
        let progress = Progress::new(quiet, PARTS, "{bar:24} {percent}%  {msg}  {eta} left");
        progress.terminal.iter().for_each(|terminal| drop(terminal.add(progress.whole.clone())));
        progress
    }

    /// Starts the curves of experiments, each with its name and number of POIs (none if that changes during the run).
    ///
    /// The arms train up to generation `last`. This session starts at generation `from`.
    pub fn of_arms(arms: Vec<(String, Option<usize>)>, from: usize, last: usize, quiet: bool) -> Progress {
        let mut progress = Progress::new(quiet, last as u64, "{bar:32} generation {pos}/{len}  {msg}  {eta} left");
        let width = arms.iter().map(|(name, _)| name.chars().count()).max().unwrap_or(0);
        let line = style(if width == 0 { "{msg}" } else { "{prefix}  {msg}" });
        for (at, (name, pois)) in arms.into_iter().enumerate() {
            let bar = ProgressBar::hidden().with_style(line.clone()).with_prefix(format!("{name:width$}"));
            progress.terminal.iter().filter(|_| at < MAX_BARS).for_each(|terminal| drop(terminal.add(bar.clone())));
            let curve = GrowingCurve { pois, parts: vec![(0.0, 0); CURVE.min(last + 1)], newest: Newest::default() };
            progress.arms.push((curve, bar));
        }
        progress.terminal.iter().for_each(|terminal| drop(terminal.add(progress.whole.clone())));
        progress.whole.set_position(from as u64);
        progress.whole.reset_eta();
        progress
    }

    /// Reports whether the arms of a training are shown, and not a fraction.
    pub fn has_arms(&self) -> bool {
        !self.arms.is_empty()
    }

    /// Reports whether it is time to show progress. If so, restarts the interval.
    fn is_due(&mut self) -> bool {
        let due = !self.quiet && self.shown.elapsed() >= self.pause;
        if due {
            self.shown = Instant::now();
        }
        due
    }

    /// Writes a line. Errors are ignored, because a closed standard error must not stop the work.
    fn line(&mut self, text: &str) {
        let _ = writeln!(self.lines, "{text}");
    }

    /// Shows the completed fraction, 0 to 1. `describe` describes the current work and is called only if it is shown.
    pub fn show(&mut self, part: f64, describe: impl FnOnce() -> String) {
        self.whole.set_position((part * PARTS as f64) as u64);
        if !self.is_due() {
            return;
        }
        if self.terminal.is_some() {
            return self.whole.set_message(describe());
        }
        let left =
            if self.whole.position() > 0 { format!(", {} s left", self.whole.eta().as_secs()) } else { String::new() };
        self.line(&format!("{}, {:.0} %{left}", describe(), part * 100.0));
    }

    /// Adds complete rows. `next` is the generation that plays next.
    pub fn add(&mut self, next: usize, rows: &[Row]) {
        let last = self.whole.length().unwrap_or(0) as usize;
        for row in rows {
            if let Some((curve, _)) = self.arms.get_mut(row.experiment) {
                curve.add(row, last);
            }
        }
        self.whole.set_position(next.min(last) as u64);
        // Large teams take long until anything is known.
        let newest = self.arms.iter().filter(|(curve, _)| curve.newest.trials > 0);
        let newest = newest.map(|(curve, _)| curve.newest.generation).max();
        let Some(generation) = newest.filter(|_| self.is_due()) else { return };
        let rate = format!("{:.1} generations/s", self.whole.per_sec());
        if self.terminal.is_some() {
            for (curve, bar) in self.arms.iter().take(MAX_BARS) {
                bar.set_message(format!("{}  {}", curve.spark(), curve.value(self.arms.len() == 1)));
            }
            return self.whole.set_message(rate);
        }
        let values = match &*self.arms {
            [(curve, _)] => curve.value(true),
            arms => format!("{} experiments", arms.len()),
        };
        let left = self.whole.eta().as_secs();
        self.line(&format!("generation {generation}/{last}  {values}  {rate}  {left} s left"));
    }

    /// Clears the bars, so that other output can follow.
    pub fn clear(&self) {
        if let Some(terminal) = &self.terminal {
            let _ = terminal.clear();
        }
    }
}

fn style(template: &str) -> ProgressStyle {
    ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar())
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use super::*;

    #[test]
    fn bars_are_for_terminals_that_can_draw_over_them() {
        assert!(is_capable(true, Some("xterm-256color")));
        assert!(!is_capable(true, Some("dumb")));
        assert!(!is_capable(false, Some("xterm")));
        assert_eq!(is_capable(true, None), cfg!(windows));
    }

    /// A writer that sends every piece through a channel.
    struct Sent(mpsc::Sender<String>);

    impl Write for Sent {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.send(String::from_utf8_lossy(bytes).into_owned()).map_err(io::Error::other)?;
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn elsewhere_a_line_is_written_now_and_then() {
        let (sender, lines) = mpsc::channel();
        let pause = Duration::from_millis(50);
        let meter = |quiet| {
            let lines = Box::new(Sent(sender.clone()));
            Progress { pause, terminal: None, lines, quiet, ..Progress::of_fraction(true) }
        };
        let (mut meter, mut quiet) = (meter(false), meter(true));
        let shown = || lines.try_iter().collect::<String>();
        meter.show(0.1, || panic!("too soon for words"));
        std::thread::sleep(pause);
        meter.show(0.0, || "1 of 4 worlds".into());
        assert_eq!(shown(), "1 of 4 worlds, 0 %\n");
        std::thread::sleep(pause);
        meter.show(1.0, || "4 of 4 worlds".into());
        meter.show(1.0, || panic!("too soon again"));
        quiet.show(0.5, || panic!("never"));
        assert_eq!(shown(), "4 of 4 worlds, 100 %, 0 s left\n");
    }
}
