//! The paper's geometry for any number of groups and followers.
//!
//! Group g = 1, 2, … has its leader at (10 g, 5) and a POI at (10 g, 15). The map is 50 high and 10 (groups + 1) wide,
//! at least 50.
//!
//! Followers start on the first of 64 [`places`] around their leader. The first two are those of the paper at (±2, −3),
//! the next two those of its chaotic layout at (±2, +2). Each further place is the point of the unit lattice within 5
//! of the leader that is farthest from all earlier places. A layout with fewer followers is therefore a part of one
//! with more. Agents start at least 1 apart, and more than 5 away from every POI.

use toml::{Table, Value};

use super::{Axis, Grid, problem};
use flotilla::config::{Override, POIS, Problem};

/// The key for followers per leader (0 to 64; 2 if only the other axis is given).
pub(crate) const FOLLOWERS: &str = "followers_per_leader";
/// The key for leaders, each with followers and a POI (1 to 256; 4 if only the other axis is given).
pub const GROUPS: &str = "groups";
/// Both keys.
pub(crate) const AXES: [&str; 2] = [FOLLOWERS, GROUPS];
const DEFAULT_FOLLOWERS: usize = 2;
const DEFAULT_GROUPS: usize = 4;
/// Maximum number of followers per leader.
pub const MAX_FOLLOWERS: usize = 64;
/// Maximum number of groups, one per POI.
pub const MAX_GROUPS: usize = flotilla::config::MAX_POIS;
/// The distance between neighbouring groups, and between a leader and its POI.
const SPACING: i32 = 10;
const LEADER_Y: i32 = 5;

/// Returns the start positions of followers relative to their leader, in the order of their use.
pub fn places() -> Vec<[i32; 2]> {
    let mut places = vec![[2, -3], [-2, -3], [2, 2], [-2, 2]];
    let squared = |[x, y]: [i32; 2], [u, v]: [i32; 2]| (x - u).pow(2) + (y - v).pow(2);
    // Rows 1 to 9 of the map: within 5 of the leader, beyond 5 of any POI, and clear of the wall.
    let lattice: Vec<_> =
        (-4..=4).flat_map(|x| (-4..=4).map(move |y| [x, y])).filter(|&place| squared(place, [0, 0]) <= 25).collect();
    while places.len() < MAX_FOLLOWERS {
        let room = |place: [i32; 2]| {
            // The neighbouring groups have the same places.
            let taken = places.iter().copied().chain([[0, 0]]);
            let copies = taken.flat_map(|[x, y]| [[x, y], [x - SPACING, y], [x + SPACING, y]]);
            copies.map(|other| squared(place, other)).min()
        };
        // Ties: the place nearest to the leader, then the rear one, then the right one.
        let best = lattice.iter().max_by_key(|&&[x, y]| (room([x, y]), -squared([x, y], [0, 0]), -y, x));
        places.extend(best);
    }
    places
}

/// The start positions of a world.
pub struct Positions {
    pub leaders: Vec<[i32; 2]>,
    /// The positions of the followers, group by group.
    pub followers: Vec<[i32; 2]>,
    /// The positions of the POIs, one per group.
    pub pois: Vec<[i32; 2]>,
    /// The width and the height of the map.
    pub map: [i32; 2],
}

/// Lays out groups with these numbers of followers, on the first of the [`places`].
pub fn positions(places: &[[i32; 2]], followers: &[usize]) -> Positions {
    let leaders: Vec<_> = (1..).zip(followers).map(|(group, _)| [SPACING * group, LEADER_Y]).collect();
    let around = |(&[x, y], &count): (&[i32; 2], &usize)| places[..count].iter().map(move |[dx, dy]| [x + dx, y + dy]);
    Positions {
        followers: leaders.iter().zip(followers).flat_map(around).collect(),
        pois: leaders.iter().map(|[x, y]| [*x, y + SPACING]).collect(),
        map: [(SPACING * (leaders.len() as i32 + 1)).max(50), 50],
        leaders,
    }
}

/// Returns the problems of the values of one of [`AXES`].
pub(super) fn problems<'a>(key: &str, values: &'a [Value]) -> impl Iterator<Item = String> + 'a {
    let (low, high) = if key == FOLLOWERS { (0, MAX_FOLLOWERS) } else { (1, MAX_GROUPS) };
    let fits = move |value: &Value| count(value).is_some_and(|count| (low..=high).contains(&count));
    values
        .iter()
        .filter(move |value| !fits(value))
        .map(move |value| format!("found {value}, allowed whole numbers {low} to {high}"))
}

fn count(value: &Value) -> Option<usize> {
    usize::try_from(value.as_integer()?).ok()
}

/// Reports whether the sweep sets this key at a point with these values.
fn sets(grid: &Grid, base: &Table, values: &[usize], key: &str) -> bool {
    let (section, leaf) = key.split_once('.').unwrap_or((key, ""));
    let is_set = |(axis, value): (&Axis, &usize)| axis.key == key && (!axis.varied || *value > 0);
    base.get(section).and_then(|section| section.get(leaf)).is_some()
        || grid.axes.iter().map(|(axis, _)| axis).zip(values).any(is_set)
}

/// Returns a problem for positions that are given although an axis lays them out.
pub(super) fn conflicts(grid: &Grid, base: &Table) -> Vec<Problem> {
    let Some((axis, line)) = grid.axes.iter().find(|(axis, _)| AXES.contains(&&*axis.key)) else { return vec![] };
    let anywhere = vec![usize::MAX; grid.axes.len()];
    let given = ["world.leaders", "world.followers"].into_iter().filter(|key| sets(grid, base, &anywhere, key));
    given
        .map(|key| {
            let message = format!("it lays out {key}, which is given too; leave one of them out");
            problem(Some(*line), &axis.name(), message)
        })
        .collect()
}

/// The layout of a sweep's points.
pub(super) struct Arrangement {
    axes: Option<[Option<usize>; 2]>,
    places: Vec<[i32; 2]>,
}

impl Arrangement {
    pub(super) fn of(grid: &Grid) -> Arrangement {
        let axes = AXES.map(|key| grid.axes.iter().position(|(axis, _)| axis.key == key));
        let used = axes.iter().any(Option::is_some);
        Arrangement { axes: used.then_some(axes), places: if used { places() } else { vec![] } }
    }

    /// Returns the positions of one combination, or nothing if no axis lays them out.
    pub(super) fn overrides(&self, grid: &Grid, base: &Table, values: &[usize]) -> Vec<Override> {
        let Some(axes) = self.axes else { return vec![] };
        let value = |axis: Option<usize>| axis.and_then(|axis| count(&grid.axes[axis].0.values[values[axis]]));
        let followers = value(axes[0]).unwrap_or(DEFAULT_FOLLOWERS);
        let groups = value(axes[1]).unwrap_or(DEFAULT_GROUPS);
        let Positions { leaders, followers, pois, map } = positions(&self.places, &vec![followers; groups]);
        let list = |list: Vec<[i32; 2]>| Value::Array(list.into_iter().map(|place| place.to_vec().into()).collect());
        let named = axes.iter().flatten().next().map_or(0, |&axis| axis);
        let name = grid.axes[named].0.name_of(values[named]);
        let set = |key: &str, value: Value| Override::new(format!("world.{key}"), value, &*name);
        let mut overrides = vec![set("leaders", list(leaders)), set("followers", list(followers))];
        if !sets(grid, base, values, "world.pois") && !base.contains_key(POIS) {
            overrides.push(set("pois", list(pois)));
        }
        if !sets(grid, base, values, "world.map") {
            overrides.push(set("map", map.to_vec().into()));
        }
        overrides
    }
}
