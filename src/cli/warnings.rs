//! Warnings about experiments that cannot show anything.

use std::collections::BTreeMap;

use super::say;
use crate::config::Config;
use crate::reach;
use crate::sweep::{Point, Sweep};

/// Maximum number of POIs that are named one by one.
const MOST: usize = 6;

/// Warns about every POI of a config that no team can observe.
pub(super) fn unreachable(config: &Config) {
    lines(config).iter().for_each(|line| say(format_args!("warning: {line}")));
}

/// Warns about every POI of a sweep's points that no team can observe, each warning once.
pub(super) fn unreachable_in(sweep: &Sweep, points: &[&Point]) {
    let mut found: BTreeMap<String, (usize, String)> = BTreeMap::new();
    for point in points {
        for line in lines(&point.config) {
            found.entry(line).or_insert_with(|| (0, sweep.describe(point))).0 += 1;
        }
    }
    for (line, (count, first)) in found.iter().take(2 * MOST) {
        say(format_args!("warning: {line}; at {count} of {} points, the first {first}", points.len()));
    }
    if let more @ 1.. = found.len().saturating_sub(2 * MOST) {
        say(format_args!("warning: … and {more} more; `flotilla check` lists those of one config"));
    }
}

fn lines(config: &Config) -> Vec<String> {
    let staged = config.staged();
    let mut lines = Vec::new();
    for (index, (_, config)) in staged.iter().enumerate() {
        let place = if staged.len() > 1 { format!("stage {index}: ") } else { String::new() };
        let found = reach::unreachable(config);
        lines.extend(found.iter().take(MOST).map(|found| format!("{place}{found}")));
        if let more @ 1.. = found.len().saturating_sub(MOST) {
            lines.push(format!("{place}{more} more POIs cannot be observed"));
        }
        if let Some(steps) = reach::fewest_steps(config, &found) {
            lines.push(format!(
                "{place}to reach these POIs, set world.steps to at least {steps}, raise motion.max_speed, or let agents \
                 start nearer"
            ));
        }
    }
    lines
}
