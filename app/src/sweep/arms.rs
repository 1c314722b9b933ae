//! The points of a sweep, grouped for comparison along one axis.

use std::collections::BTreeMap;

use super::{Axis, Point, Sweep};
use flotilla::escape;

/// The key whose values are repetitions: points that differ only in it belong to one arm.
const SEED: &str = "learning.seed";

/// Points that differ only in the values of one axis and in seeds.
#[derive(Clone, Debug, PartialEq)]
pub struct Series<'a> {
    /// The values of the other axes: "coupling 3, fitness Df". Empty if there are none.
    pub place: String,
    /// The points by value of the axis: "repulsion_gain 2.0".
    pub arms: Vec<(String, Vec<&'a Point>)>,
}

impl Sweep {
    /// Returns the axis with this key, with or without its section.
    pub fn axis(&self, name: &str) -> Option<usize> {
        self.axes.iter().position(|axis| axis.key == name || axis.leaf() == name)
    }

    /// Groups the points by the values of an axis, for each combination of the other axes with at least two values.
    pub fn arms(&self, by: usize) -> Vec<Series<'_>> {
        let describe =
            |axis: &Axis, value: usize| escape::line(&format!("{} {}", axis.leaf(), axis.label(value))).to_string();
        let mut groups: BTreeMap<Vec<usize>, BTreeMap<usize, Vec<&Point>>> = BTreeMap::new();
        for point in &self.points {
            let of = |(at, axis): (usize, &Axis)| if at == by || axis.key == SEED { 0 } else { point.values[at] };
            let place = self.axes.iter().enumerate().map(of).collect();
            groups.entry(place).or_default().entry(point.values[by]).or_default().push(point);
        }
        groups.retain(|_, arms| arms.len() > 1);
        let many = groups.len() > 1;
        let groups = groups.into_iter().map(|(place, arms)| {
            let others = self.axes.iter().zip(place).enumerate();
            let others =
                others.filter(|(at, (axis, value))| *at != by && axis.key != SEED && (!axis.varied || *value > 0));
            let place: Vec<_> = others.map(|(_, (axis, value))| describe(axis, value)).collect();
            let arms = arms.into_iter().map(|(value, points)| (describe(&self.axes[by], value), points));
            let place = if many && place.is_empty() { "as in the file".into() } else { place.join(", ") };
            Series { place, arms: arms.collect() }
        });
        groups.collect()
    }
}
