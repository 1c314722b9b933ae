//! The page that plays episodes, and its data.

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use serde_json::json;

use super::{Counterfactual, Replayed, near};
use crate::record::folder::OWN_FITNESS;
use crate::report::map::{Form, GROUPS, GROUPS_DARK, sample_note};
use crate::report::scene::hex;
use flotilla::config::{AgentClass, Channel, Config, Control, Fitness, Mobility, PoiGroup, Sectors, drawn_agents};
use flotilla::credit;
use flotilla::world::OUTPUTS;

/// Maximum number of bytes of motion in a page, before base64 adds a third. Longer motion is thinned out.
const MOTION_BYTES: usize = 1_300_000;
/// Maximum number of bytes of motion that is stored as the exact f32 values.
const EXACT_BYTES: usize = 600_000;

/// Maximum number of bytes of the senses of an episode, and of what is observed without its leaders.
const DETAIL_BYTES: usize = 1_000_000;

impl Counterfactual<'_> {
    /// Returns the observation steps and the observers near each POI, base64 of u32 `[shown][pois]`.
    fn json(&self, shown: &[usize]) -> serde_json::Value {
        let count = |step: usize, poi| near(self.world, &self.start, &self.sets, step, poi);
        let counts = shown.iter().flat_map(|&step| (0..self.world.pois.len()).map(move |poi| count(step, poi)));
        let near: Vec<u8> = counts.flat_map(u32::to_le_bytes).collect();
        json!({ "observed": self.observed, "near": BASE64_STANDARD.encode(near) })
    }
}

/// Returns a page that plays episodes of one run side by side. `name` is the run's name.
pub fn page(name: &str, config: &Config, played: &[Replayed]) -> String {
    // Inside a script element, only "<" could end it early.
    let data = data(name, config, played).to_string().replace('<', "\\u003c");
    include_str!("page.html").replacen("\"STAGE\"", STAGE, 1).replacen("\"DATA\"", &data, 1)
}

/// The script that draws episodes. Every page that shows them includes it.
pub(crate) const STAGE: &str = include_str!("../stage.js");

/// Returns [`data`], and per episode D++, the senses and actions of leaders, and what the team observes without them.
///
/// Per episode that adds `dpp`, `[leaders]`; `senses`, base64 of f32 `[shown][leaders][inputs, 2 outputs]`; and
/// `without`, `[leaders]`. Its entries `alone` and `group` (with the followers that the leader led) have `observed` and
/// `near` like the episode. Very long episodes have neither of the last two.
pub fn detailed(name: &str, config: &Config, played: &[Replayed]) -> serde_json::Value {
    let mut data = data(name, config, played);
    for (played, episode) in played.iter().zip(data["episodes"].as_array_mut().into_iter().flatten()) {
        let shown: Vec<usize> =
            episode["shown"].as_array().into_iter().flatten().flat_map(|step| Some(step.as_u64()? as usize)).collect();
        let (leaders, pois) = (played.world.leaders(), played.world.pois.len());
        episode["dpp"] = json!(played.scores.dpp);
        if shown.len() * leaders * (played.world.inputs() + OUTPUTS) * size_of::<f32>() <= DETAIL_BYTES {
            let moments = shown.iter().flat_map(|&step| (0..leaders).map(move |leader| (step, leader)));
            let senses = moments.flat_map(|(step, leader)| {
                let inputs = played.trace.inputs_of(step, 0, leader).iter();
                let outputs = &played.trace.moment(step, 0, leader).outputs;
                inputs.chain(outputs).flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>()
            });
            episode["senses"] = BASE64_STANDARD.encode(senses.collect::<Vec<u8>>()).into();
        }
        if shown.len() * leaders * pois * 2 * size_of::<u32>() <= DETAIL_BYTES {
            let without = (0..leaders).map(|leader| {
                let [alone, group] = [false, true].map(|group| played.without(leader, group).json(&shown));
                json!({ "alone": alone, "group": group })
            });
            episode["without"] = without.collect();
        }
    }
    data
}

/// Returns the data that a page needs to play episodes of one run.
pub fn data(name: &str, config: &Config, played: &[Replayed]) -> serde_json::Value {
    let count = played.len().max(1);
    let size = |per_agent: usize, played: &Replayed| {
        let world = &played.world;
        let [drawn, led] = [drawn_agents(world.leaders(), world.agents()).len(), led_words(played)];
        drawn * per_agent + world.pois.len() * size_of::<u32>() + (drawn - world.leaders()) * led * 4
    };
    let exact = played.iter().map(|p| (p.world.steps() + 1) * size(16, p)).sum::<usize>() <= EXACT_BYTES;
    let episodes: Vec<_> = played
        .iter()
        .map(|played| {
            let room = if exact { usize::MAX } else { MOTION_BYTES / count / size(5, played) };
            episode(played, &played.shown(room), exact)
        })
        .collect();
    let world = &config.drawn();
    // Moving POIs are listed where the first episode had them.
    let pois = match played.first().filter(|_| config.pois_move()) {
        Some(first) => first.world.pois.iter().map(|poi| poi.as_dvec2().to_array()).collect(),
        None => world.pois.clone(),
    };
    let unverified = if played.iter().any(|played| played.unverified) { " (unverified)" } else { "" };
    let sample = played.iter().find_map(|played| sample_note(&played.world));
    let sample = sample.map_or(String::new(), |note| format!(" ({note})"));
    let fitnesses: Vec<String> = config.fitnesses().iter().map(Fitness::to_string).collect();
    let own_fitness = played.iter().any(|played| played.own_fitness);
    let mut data = json!({
        "run": format!("{name}{unverified}{sample}"),
        "paradigm": config.learning.paradigm,
        "fitness": if own_fitness { OWN_FITNESS.into() } else { fitnesses.join(" and ") },
        "map": world.map,
        "pois": pois,
        "observation_radius": world.observation_radius,
        "observers": world.observers,
        "windows": world.windows,
        "after": world.after,
        "attraction_radius": config.influence_radius(),
        "dt": world.dt,
        "steps": world.steps,
        "exact": exact,
        "colors": { "light": GROUPS.map(hex), "dark": GROUPS_DARK.map(hex) },
        "outline": Form::default().outline(),
        "episodes": episodes,
    });
    for (key, value) in parts(config) {
        data[key] = value;
    }
    if played.iter().any(|played| played.given) {
        data["given"] = true.into();
    }
    data
}

/// Returns a channel as pages have it.
fn sensed(channel: &Channel) -> serde_json::Value {
    let mut shown = json!(channel);
    shown["sectors"] = channel.sectors.count().into();
    shown["each"] = matches!(channel.sectors, Sectors::Each(_)).into();
    shown
}

/// Returns what only some pages have.
///
/// If agents share populations and none follows, there are `populations`, with that of each agent.
/// With `[[agents]]`, they have `classes`, those that learn first: their `name`, their `size`, the `count` of their agents that are
/// drawn, whether they move `free`, the `outline` of their marks, the class and the `agents` that they `choose` among, if
/// any, the distance up to which they `influence` others, and the channels of their `senses`, with the number of
/// `sectors` and whether `each` agent or POI has one. The `groups` of POIs
/// have their `name`, the `count` of their POIs, and the indices of the classes that are `observers`. Only if POIs differ
/// in their radius or value, there are `radii` or `values`.
pub fn parts(config: &Config) -> Vec<(&'static str, serde_json::Value)> {
    let (all, mut parts) = (config.classes(), Vec::new());
    let count = all.agents.len();
    let drawn = drawn_agents(config.learners(), config.agent_count());
    if config.agent_count() == config.learners() && config.populations() < config.learners() {
        parts.push(("populations", json!(config.population_of_each())));
    }
    if config.weighted_by().is_some() {
        parts.push(("weighted", true.into()));
    }
    if !config.agents.is_empty() {
        let is_free = |class: usize| matches!(config.agents[class].motion, Mobility::Free { .. });
        let class = |(index, class): (usize, &AgentClass)| {
            let free = is_free(index);
            let influence = (0..count).filter_map(|led| all.influence_radius(index, led)).fold(0.0, f64::max);
            let AgentClass { name, control, .. } = class;
            let senses: Vec<_> = class.senses.iter().map(sensed).collect();
            let places = all.agents_of(index);
            let count = drawn.iter().filter(|agent| places.contains(agent)).count();
            let outline = Form::of(index, |class| [is_free(class), config.agents[class].learns()]).outline();
            let mut class = json!({
                "name": name, "size": class.size(), "count": count, "free": free, "outline": outline, "influence": influence,
                "senses": senses,
            });
            if let Control::Choose(target) = control {
                let targets = all.agents.iter().position(|class| class.name == *target);
                let chosen: Vec<usize> = targets.map(|class| all.agents_of(class)).into_iter().flatten().collect();
                class["choose"] = json!({ "name": target, "agents": chosen });
            }
            class
        };
        parts.push(("classes", config.agents.iter().enumerate().map(class).collect()));
    }
    if !config.agents.is_empty() || !config.pois.is_empty() {
        let group = |(index, group): (usize, &PoiGroup)| {
            let observers: Vec<usize> = (0..count).filter(|&class| all.observes(class, index)).collect();
            json!({ "name": group.name, "count": group.size(), "observers": observers })
        };
        parts.push(("groups", all.pois.iter().enumerate().map(group).collect()));
        let of_each = |value: fn(&PoiGroup) -> f64| {
            let values = all.pois.iter().flat_map(|group| vec![value(group); group.size()]).collect::<Vec<_>>();
            values.windows(2).any(|pair| pair[0] != pair[1]).then(|| json!(values))
        };
        parts.extend(of_each(|group| group.radius).map(|radii| ("radii", radii)));
        parts.extend(of_each(|group| group.value).map(|values| ("values", values)));
    }
    parts
}

/// Returns the words per follower and step of [`Replayed::led`].
fn led_words(Replayed { world, led, .. }: &Replayed) -> usize {
    led.len() / (world.steps() * world.followers()).max(1)
}

/// Returns one episode as the page reads it. Motion is base64 of little-endian numbers, `[shown][agents]`.
fn episode(played: &Replayed, shown: &[usize], exact: bool) -> serde_json::Value {
    let Replayed { world, scores, .. } = played;
    let map = world.map().to_array();
    let (leaders, drawn) = (world.leaders(), drawn_agents(world.leaders(), world.agents()));
    let (mut positions, mut headings, mut near, mut led) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for &step in shown {
        // These are the groups of the step that ended here, as in `Replayed::group`.
        let (words, first) = (led_words(played), step.saturating_sub(1) * world.followers());
        for &agent in &drawn[leaders..] {
            let of_follower = &played.led[(first + agent - leaders) * words..][..words];
            led.extend(of_follower.iter().flat_map(|word| word.to_le_bytes()));
        }
        for &agent in &drawn {
            let (place, heading) = (played.position(step, agent), played.heading(step, agent));
            if exact {
                positions.extend(place.iter().flat_map(|at| at.to_le_bytes()));
                headings.extend(heading.iter().flat_map(|at| at.to_le_bytes()));
            } else {
                let share = |axis: usize| (f64::from(place[axis]) / f64::from(map[axis]) * 65535.0).round() as u16;
                positions.extend([share(0), share(1)].iter().flat_map(|share| share.to_le_bytes()));
                let turn = libm::atan2(f64::from(heading[1]), f64::from(heading[0])) / std::f64::consts::TAU;
                headings.push((turn.rem_euclid(1.0) * 256.0).round() as u32 as u8);
            }
        }
        near.extend((0..world.pois.len()).flat_map(|poi| played.near(step, poi).to_le_bytes()));
    }
    let mut followers = vec![0; leaders];
    for &owner in played.owner[leaders..].iter().filter(|&&owner| owner != credit::UNASSIGNED) {
        followers[owner as usize] += 1;
    }
    let owner = drawn.iter().map(|&agent| played.owner[agent]);
    let owner: Vec<i64> = owner.map(|owner| if owner == credit::UNASSIGNED { -1 } else { i64::from(owner) }).collect();
    json!({
        "trial": played.trial,
        "generation": played.generation,
        "name": played.name(),
        "team": played.team,
        "team_g": played.team_g,
        "means_of": played.episodes,
        "g": scores.g,
        "d": scores.d,
        "df": scores.df,
        "dt": scores.dt,
        "leaders": world.leaders(),
        "agents": drawn.len(),
        "size": world.agents(),
        "followers": followers,
        "coupling": world.coupling,
        "owner": owner,
        "observed": played.observed,
        "shown": shown,
        "positions": BASE64_STANDARD.encode(positions),
        "headings": BASE64_STANDARD.encode(headings),
        "near": BASE64_STANDARD.encode(near),
        "led": BASE64_STANDARD.encode(led),
    })
}
