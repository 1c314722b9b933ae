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

/// Decides whether and when progress is shown.
struct Pace {
    quiet: bool,
    terminal: bool,
    since: Instant,
    shown: Instant,
    pause: Duration,
}

impl Pace {
    fn new(quiet: bool) -> Pace {
        let terminal = !quiet && is_capable(io::stderr().is_terminal(), std::env::var("TERM").ok().as_deref());
        let now = Instant::now();
        Pace { quiet, terminal, since: now, shown: now, pause: if terminal { DRAWS } else { LINES } }
    }

    /// Reports whether it is time to show progress. If so, restarts the interval.
    fn is_due(&mut self) -> bool {
        let due = !self.quiet && self.shown.elapsed() >= self.pause;
        if due {
            self.shown = Instant::now();
        }
        due
    }

    fn seconds(&self) -> f64 {
        self.since.elapsed().as_secs_f64().max(1e-9)
    }
}

/// Reports whether standard error can be redrawn. `name` is the value of `TERM`.
fn is_capable(terminal: bool, name: Option<&str>) -> bool {
    terminal && name.map_or(cfg!(windows), |name| name != "dumb")
}

/// Writes a line. Errors are ignored, because a closed standard error must not stop the work.
fn line(to: &mut dyn Write, text: &str) {
    let _ = writeln!(to, "{text}");
}

/// Shows the progress of one task on standard error.
pub(crate) struct Meter {
    pace: Pace,
    bar: Option<ProgressBar>,
    lines: Box<dyn Write + Send>,
}

impl Meter {
    /// Starts a meter. With `quiet` it never shows anything.
    pub fn new(quiet: bool) -> Meter {
        let pace = Pace::new(quiet);
        let bar = pace.terminal.then(|| {
            let style = ProgressStyle::with_template("{bar:24} {percent}%  {msg}  {eta} left");
            let style = style.unwrap_or_else(|_| ProgressStyle::default_bar());
            ProgressBar::with_draw_target(Some(PARTS), ProgressDrawTarget::stderr()).with_style(style)
        });
        Meter { pace, bar, lines: Box::new(io::stderr()) }
    }

    /// Shows the completed fraction, 0 to 1. `describe` describes the current work and is called only if it is shown.
    pub fn show(&mut self, part: f64, describe: impl FnOnce() -> String) {
        if !self.pace.is_due() {
            return;
        }
        match &self.bar {
            Some(bar) => {
                bar.set_message(describe());
                bar.set_position((part * PARTS as f64) as u64);
            }
            None => {
                let left = self.pace.seconds() * (1.0 - part) / part.max(1e-9);
                let left = if part > 0.0 { format!(", {left:.0} s left") } else { String::new() };
                line(&mut self.lines, &format!("{}, {:.0} %{left}", describe(), part * 100.0));
            }
        }
    }

    /// Clears the bar, so that other output can follow.
    pub(crate) fn clear(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

/// Shows the training progress of several arms on standard error.
pub(crate) struct ProgressBars {
    arms: Vec<GrowingBar>,
    last: usize,
    /// The generation at which this session started.
    from: usize,
    pace: Pace,
    terminal: Option<Terminal>,
}

struct Terminal {
    all: MultiProgress,
    curves: Vec<ProgressBar>,
    generation: ProgressBar,
}

/// One arm's curve so far: for each part of the run, the sum of the champions' G and the number of rows.
struct GrowingBar {
    name: String,
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

impl GrowingBar {
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

impl ProgressBars {
    /// Starts the bars of experiments, each with its name and number of POIs (none if that changes during the run).
    ///
    /// The arms train up to generation `last`. This session starts at generation `from`.
    pub fn new(arms: Vec<(String, Option<usize>)>, from: usize, last: usize, quiet: bool) -> ProgressBars {
        let parts = vec![(0.0, 0); CURVE.min(last + 1)];
        let arms: Vec<GrowingBar> = arms
            .into_iter()
            .map(|(name, pois)| GrowingBar { name, pois, parts: parts.clone(), newest: Newest::default() })
            .collect();
        let pace = Pace::new(quiet);
        let terminal = pace.terminal.then(|| Terminal::new(&arms, from, last));
        ProgressBars { arms, last, from, pace, terminal }
    }

    /// Adds complete rows. `next` is the generation that plays next.
    pub fn show(&mut self, next: usize, rows: &[Row]) {
        for row in rows {
            if let Some(arm) = self.arms.get_mut(row.experiment) {
                arm.add(row, self.last);
            }
        }
        if !self.pace.is_due() {
            return;
        }
        let rate = (next - self.from.min(next)) as f64 / self.pace.seconds();
        match &self.terminal {
            Some(terminal) => {
                terminal.generation.set_position(next.min(self.last) as u64);
                terminal.generation.set_message(format!("{rate:.1} generations/s"));
                for (bar, arm) in terminal.curves.iter().zip(&self.arms) {
                    bar.set_message(format!("{}  {}", arm.spark(), arm.value(self.arms.len() == 1)));
                }
            }
            None => {
                let left = (self.last + 1).saturating_sub(next) as f64 / rate.max(1e-9);
                let values: Vec<String> = match &*self.arms {
                    [arm] => vec![arm.value(true)],
                    arms => vec![format!("{} experiments", arms.len())],
                };
                let (generation, last, values) = (next.saturating_sub(1).min(self.last), self.last, values.concat());
                let text =
                    format!("generation {generation}/{last}  {values}  {rate:.1} generations/s  {left:.0} s left");
                line(&mut io::stderr(), &text);
            }
        }
    }

    /// Clears the curves, so that other output can follow.
    pub(crate) fn clear(&self) {
        if let Some(Terminal { all, .. }) = &self.terminal {
            let _ = all.clear();
        }
    }
}

impl Terminal {
    fn new(arms: &[GrowingBar], from: usize, last: usize) -> Terminal {
        let all = MultiProgress::with_draw_target(ProgressDrawTarget::stderr());
        let style = |template| ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
        let width = arms.iter().map(|arm| arm.name.chars().count()).max().unwrap_or(0);
        let curve = |arm: &GrowingBar| {
            let bar =
                all.add(ProgressBar::new(1)).with_style(style(if width == 0 { "{msg}" } else { "{prefix}  {msg}" }));
            bar.with_prefix(format!("{:width$}", arm.name))
        };
        let curves = arms.iter().take(MAX_BARS).map(curve).collect();
        let generation = all.add(ProgressBar::new(last as u64));
        generation.set_style(style("{bar:32} generation {pos}/{len}  {msg}  {eta} left"));
        Terminal { curves, generation: generation.with_position(from as u64), all }
    }
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
            let now = Instant::now();
            let pace = Pace { quiet, terminal: false, since: now, shown: now, pause };
            Meter { pace, bar: None, lines: Box::new(Sent(sender.clone())) }
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
