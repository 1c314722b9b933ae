//! Warnings about experiments that cannot show anything.

use super::say;
use crate::config::Config;
use crate::ops::sweep::unreachable as lines;

/// Warns about every POI of a config that no team can observe.
pub(super) fn unreachable(config: &Config) {
    lines(config).iter().for_each(|line| say(format_args!("warning: {line}")));
}
