//! How training comes on: every arm's curve as it grows on a terminal, a line from time to time elsewhere.

use std::io::{self, IsTerminal, Write};
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::record::metrics::Row;

/// Letters that a curve takes; with the longest name and the value it fits the usual 80.
const CURVE: usize = 24;
/// Curves that a terminal has lines for.
const MOST: usize = 24;
/// How often a line is written where there is no terminal, and how often a terminal changes.
const LINES: Duration = Duration::from_secs(10);
const DRAWS: Duration = Duration::from_millis(100);

/// Shows on standard error how arms train side by side.
pub struct Progress {
    arms: Vec<Growing>,
    last: usize,
    /// Where this session started, and when.
    from: usize,
    since: Instant,
    shown: Instant,
    quiet: bool,
    terminal: Option<Terminal>,
}

struct Terminal {
    all: MultiProgress,
    curves: Vec<ProgressBar>,
    generation: ProgressBar,
}

/// One arm's curve so far: the best teams' G, summed, by part of the run.
struct Growing {
    name: String,
    pois: usize,
    parts: Vec<(f64, u32)>,
    newest: Newest,
}

/// The newest generation: G of its best and mean teams, summed over so many trials.
#[derive(Clone, Copy, Default)]
struct Newest {
    generation: usize,
    best: f64,
    mean: f64,
    trials: u32,
}

impl Growing {
    fn add(&mut self, row: &Row, last: usize) {
        let part = (row.generation * self.parts.len() / (last + 1)).min(self.parts.len() - 1);
        self.parts[part].0 += row.best_g;
        self.parts[part].1 += 1;
        if row.generation != self.newest.generation {
            self.newest = Newest { generation: row.generation, ..Newest::default() };
        }
        self.newest.best += row.best_g;
        self.newest.mean += row.mean_g;
        self.newest.trials += 1;
    }

    /// The curve so far, a letter a part of the run.
    fn spark(&self) -> String {
        const LEVELS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];
        let level = |&(sum, count): &(f64, u32)| match count {
            0 => ' ',
            _ => LEVELS[((sum / f64::from(count) * LEVELS.len() as f64) as usize).min(LEVELS.len() - 1)],
        };
        self.parts.iter().map(level).collect()
    }

    /// What the newest generation came to, over trials: in POIs of the best team, or also in words.
    fn value(&self, in_words: bool) -> String {
        let Newest { best, mean, trials, .. } = self.newest;
        let pois = |sum: f64| sum / f64::from(trials.max(1)) * self.pois as f64;
        match in_words {
            true => format!("best {:.2}, mean {:.2} of {} POIs", pois(best), pois(mean), self.pois),
            false => format!("{:.2}/{}", pois(best), self.pois),
        }
    }
}

impl Progress {
    /// Arms by name and number of POIs, which train to generation `last`, this time from generation `from`.
    pub fn new(arms: Vec<(String, usize)>, from: usize, last: usize, quiet: bool) -> Progress {
        let parts = vec![(0.0, 0); CURVE.min(last + 1)];
        let arms: Vec<Growing> = arms
            .into_iter()
            .map(|(name, pois)| Growing { name, pois, parts: parts.clone(), newest: Newest::default() })
            .collect();
        let terminal = (!quiet && io::stderr().is_terminal()).then(|| Terminal::new(&arms, from, last));
        let now = Instant::now();
        Progress { arms, last, from, since: now, shown: now, quiet, terminal }
    }

    /// Takes in the rows that became complete; `next` is the generation that plays next.
    pub fn show(&mut self, next: usize, rows: &[Row]) {
        if self.quiet {
            return;
        }
        for row in rows {
            if let Some(arm) = self.arms.get_mut(row.arm) {
                arm.add(row, self.last);
            }
        }
        let pause = if self.terminal.is_some() { DRAWS } else { LINES };
        if self.shown.elapsed() < pause {
            return;
        }
        self.shown = Instant::now();
        let rate = (next - self.from.min(next)) as f64 / self.since.elapsed().as_secs_f64().max(1e-9);
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
                // With standard error gone there is nobody left to tell.
                let _ = writeln!(
                    io::stderr(),
                    "generation {}/{}  {}  {rate:.1} generations/s  {left:.0} s left",
                    next.saturating_sub(1).min(self.last),
                    self.last,
                    values.concat()
                );
            }
        }
    }

    /// Clears the terminal for what follows.
    pub fn clear(&self) {
        if let Some(Terminal { all, .. }) = &self.terminal {
            let _ = all.clear();
        }
    }
}

impl Terminal {
    fn new(arms: &[Growing], from: usize, last: usize) -> Terminal {
        let all = MultiProgress::with_draw_target(ProgressDrawTarget::stderr());
        let style = |template| ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
        let width = arms.iter().map(|arm| arm.name.chars().count()).max().unwrap_or(0);
        let curve = |arm: &Growing| {
            let bar =
                all.add(ProgressBar::new(1)).with_style(style(if width == 0 { "{msg}" } else { "{prefix}  {msg}" }));
            bar.with_prefix(format!("{:width$}", arm.name))
        };
        let curves = arms.iter().take(MOST).map(curve).collect();
        let generation = all.add(ProgressBar::new(last as u64));
        generation.set_style(style("{bar:32} generation {pos}/{len}  {msg}  {eta} left"));
        Terminal { curves, generation: generation.with_position(from as u64), all }
    }
}
