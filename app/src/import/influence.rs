//! Configs of influence shaping, which trains rovers and UAVs.

use super::table::{Row, Section, To, quoted};
use super::yaml::At;
use flotilla::config::{MOST_MEASURED, Problem};
use toml::Value;

const WORLD: &[Row] = &[
    ("env.map_size", To::Need("map")),
    ("ccea.num_steps", To::Need("steps")),
    ("env.agents", To::Code("rovers uavs")),
    ("env.pois", To::Code("rover_pois hidden_pois")),
];

const AGENT: &[Row] = &[
    ("position", To::Code("spawn_rule fixed random_uniform random_circle")),
    ("observation_radius", To::Code("")),
    ("resolution", To::Code("")),
    ("sensor", To::Code("type accum_type measurement_type default_value")),
    ("observable_subtypes", To::Code("")),
    ("policy.type", To::Code("")),
    ("policy.network", To::Nothing("one key, policy.hidden, is for all policies")),
    ("action.type", To::Code("")),
    ("reward_type", To::Code("")),
    ("IndirectDifference.type", To::Only("removal", "credits take agents out")),
    ("IndirectDifference", To::Code("assignment manual automatic.timescale automatic.credit add_G")),
    ("influence", To::Nothing("UAVs influence rovers within 5 units, as in the newest version of the program")),
    ("bounds", To::Code("low_x low_y high_x high_y")),
    ("needs_uav_to_move", To::Code("")),
];

const POI: &[Row] = &[
    ("position", To::Code("spawn_rule fixed random_uniform random_circle")),
    ("observation_radius", To::Code("")),
    ("capture_radius", To::Code("")),
    ("subtype", To::Code("")),
    ("value", To::Code("")),
    ("coupling", To::Need("coupling")),
    ("constraint", To::Word("when", "final", &[("sequential", "ever"), ("final", "end")])),
    ("disappear_bool", To::Code("")),
];

const POLICY: &[Row] = &[
    ("ccea.network.hidden_layers", To::List("hidden")),
    ("ccea.network.rover_max_velocity", To::Code("")),
    ("ccea.network.uav_max_velocity", To::Code("")),
];

const LEARNING: &[Row] = &[
    ("ccea.populations.agent_population_size", To::Code("")),
    ("ccea.population.subpopulation_size", To::Code("")),
    ("ccea.num_generations", To::Need("generations")),
    ("experiment.num_trials", To::Need("trials")),
    ("debug.random_seed.set_seed", To::Key("seed")),
    ("debug.random_seed.increment_every_trial", To::Only("true", "trials always differ")),
    ("debug.reward_equals_G", To::Only("false", "it is a check of the program")),
    ("ccea.selection.selection_method", To::Only("NElitesBinaryTournament", "elites and binary tournaments select")),
    ("ccea.selection.n_elites_binary_tournament.n_individual_elites", To::Key("elites")),
    ("ccea.selection.n_elites_binary_tournament.n_elites", To::Key("elites")),
    ("ccea.selection.n_elites_binary_tournament.n_team_elites", To::Key("team_elites")),
    ("ccea.selection.n_elites_binary_tournament.n_individual_elites_based_on_team_fitness", To::Key("team_g_elites")),
    (
        "ccea.selection.n_elites_binary_tournament.include_elites_in_tournament",
        To::Only("true", "tournaments draw from the whole population"),
    ),
    (
        "ccea.team_formation.type",
        To::Word(
            "teams",
            "random_teams",
            &[("random_teams", "random"), ("softmax_teams", "softmax"), ("fixed_teams", "sorted")],
        ),
    ),
    ("ccea.mutation.independent_probability", To::Need("mutation_probability")),
    ("ccea.mutation.std_deviation", To::Need("mutation_sigma")),
    ("ccea.mutation.mean", To::Only("0.0", "mutations have mean 0")),
    (
        "ccea.weight_initialization",
        To::Nothing("the newest version of the program draws from -1 to 1, too; initial_scale changes that"),
    ),
    ("ccea.evaluation.multi_rollout.num_rollouts", To::Key("episodes_per_team")),
    ("ccea.evaluation.multi_evaluation.num_evaluations", To::Key("episodes_per_team")),
    ("ccea.evaluation.multi_evaluation.aggregation_method", To::Only("average", "scores of episodes are averaged")),
    ("ccea.evaluation.test_adhoc_team_switch", To::Only("false", "test_episodes are of the team with the largest G")),
    (
        "ccea.evaluation.hall_of_fame",
        To::Nothing("learning.hall_of_fame adds teams with past champions, but does not mix scores"),
    ),
    ("ccea.evaluation.evaluation_method", To::Nothing("see learning.hall_of_fame")),
    ("data", To::Nothing("a run saves checkpoints and results by itself, and `flotilla replay` shows episodes")),
    ("processing", To::Nothing("training uses all cores, or as many as --threads says")),
];

/// Distance up to which the program's UAVs influence rovers, in units.
const INFLUENCE_RADIUS: f64 = 5.0;
/// The names of measures here, with the power of 1/d and the distance below which they do not grow, or zeros.
const MEASURES: &[(&str, (&str, f64, f64))] = &[
    // 1/max(0.001, d²).
    ("inverse_distance_squared", ("inverse-squared", 2.0, 0.03162277660168379)),
    // 1/max(0.001, d) there; 0.01 is the least here.
    ("inverse_distance", ("inverse", 1.0, 0.01)),
    ("exponential_negative_distance", ("exponential", 0.0, 0.0)),
    ("distance_over_observation_radius", ("distance", 0.0, 0.0)),
    ("one_minus_inverse_distance_over_observation_radius", ("closeness", 0.0, 0.0)),
];
const SENSORS: &[(&str, Sensor)] =
    &[("SmartLidar", Sensor::Smart), ("RoverLidar", Sensor::Rover), ("UavDistanceLidar", Sensor::UavDistance)];

#[derive(Clone, Copy, PartialEq)]
enum Sensor {
    Smart,
    Rover,
    UavDistance,
}

/// Agents that differ in their positions only, or POIs.
struct Group<'a> {
    /// For a name.
    stem: String,
    section: Section,
    /// Fixed positions, or regions, of each member.
    places: Vec<Place>,
    /// The position of the first member.
    position: At<'a>,
    /// Indices of agents in the program: rovers, then UAVs.
    members: Vec<usize>,
    learns: bool,
    credit: Credit,
    /// As in the YAML file, of POIs.
    subtype: Option<Value>,
    value: f64,
}

#[derive(Clone, PartialEq)]
enum Place {
    At([f64; 2]),
    In(String),
}

/// How an agent is scored.
#[derive(Clone, Default, PartialEq)]
struct Credit {
    fitness: &'static str,
    led_by: Option<&'static str>,
    removes: Option<Vec<usize>>,
    adds_g: bool,
}

impl<'a> Group<'a> {
    fn new(at: &At<'a>, stem: String, section: Section) -> Result<Group<'a>, Problem> {
        Ok(Group {
            stem,
            section,
            places: vec![place(at)?],
            position: at.need("position")?,
            members: vec![],
            learns: true,
            credit: Credit::default(),
            subtype: None,
            value: 0.0,
        })
    }

    /// Reports whether another member can be in this group.
    fn fits(&self, other: &Group<'_>) -> bool {
        let texts = |group: &Group<'_>| {
            let lines = group.section.lines.iter().map(|line| line.text.clone());
            lines.filter(|text| !text.is_empty()).collect::<Vec<_>>()
        };
        let kind = |place: &Place| matches!(place, Place::In(_)).then(|| place.clone());
        // Ties between agents depend on their order, and POIs have no members.
        self.members.last().map(|last| last + 1) == other.members.first().copied()
            && kind(&self.places[0]) == kind(&other.places[0])
            && (&self.stem, self.learns, &self.credit) == (&other.stem, other.learns, &other.credit)
            && self.subtype == other.subtype
            && texts(self) == texts(other)
    }
}

/// Puts POIs, or neighbouring agents, that differ in their positions only together, and names the groups.
fn grouped(members: Vec<Group<'_>>) -> Vec<(String, Group<'_>)> {
    let mut groups: Vec<Group<'_>> = Vec::new();
    for member in members {
        match groups.iter_mut().find(|group| group.fits(&member)) {
            Some(group) => {
                group.places.extend(member.places);
                group.members.extend(member.members);
                group.section.lines.extend(member.section.lines.into_iter().filter(|line| line.text.is_empty()));
            }
            None => groups.push(member),
        }
    }
    // Classes that learn come first.
    groups.sort_by_key(|group| !group.learns);
    let named =
        |(i, group): (usize, &Group<'_>)| match groups[..i].iter().filter(|other| other.stem == group.stem).count() {
            0 => group.stem.clone(),
            before => format!("{}_{}", group.stem, before + 1),
        };
    let names: Vec<String> = groups.iter().enumerate().map(named).collect();
    names.into_iter().zip(groups).collect()
}

/// Returns the items of a list, of which there can be as many as a team can have agents.
fn few<'a>(root: &At<'a>, path: &str) -> Result<Vec<At<'a>>, Problem> {
    const MOST: usize = 1024;
    let items = root.list(path)?;
    match items.get(MOST) {
        None => Ok(items),
        Some(_) => Err(root.need(path)?.problem(format!("found {} items, allowed up to {MOST}", items.len()))),
    }
}

/// Translates a config.
pub(super) fn translate(root: &At<'_>) -> Result<Vec<Section>, Problem> {
    let mut world = Section::new("[world]");
    world.fill(root, WORLD)?;
    world.set("dt", "1.0", "an action is a displacement");
    world.set("start_counts", "true", "the program scores the start, too");

    let kinds = [("rover", few(root, "env.agents.rovers")?), ("uav", few(root, "env.agents.uavs")?)];
    let reach = |rover: &At<'_>| Ok((rover.need("observation_radius")?.number()?, sensor(rover)? == Sensor::Smart));
    let reaches = kinds[0].1.iter().map(reach).collect::<Result<Vec<_>, Problem>>()?;
    let (mut pois, mut needed) = (Vec::new(), 0.0);
    for kind in ["rover", "hidden"] {
        for poi in few(root, &format!("env.pois.{kind}_pois"))? {
            let (group, reach) = of_poi(&poi, kind, &reaches)?;
            pois.push(group);
            needed = reach.max(needed);
        }
    }
    let is_random = |group: &Group<'_>| matches!(group.places[0], Place::In(_));
    let mut random = pois.iter().any(is_random);
    let pois = grouped(pois);
    let [rovers, uavs] = [0, 1].map(|kind| kinds[kind].1.len());
    for (is_empty, what) in [(rovers == 0, "env.agents.rovers"), (pois.is_empty(), "env.pois")] {
        if is_empty {
            return Err(root.need(what)?.problem("empty; there has to be at least one"));
        }
    }
    let all = || kinds.iter().flat_map(|(kind, agents)| agents.iter().map(move |at| (*kind, at)));
    let credits = all().map(|(_, at)| credit_of(at, rovers + uavs)).collect::<Result<Vec<_>, _>>()?;
    // One rule, and one choice to add G, are for all agents. UAVs have rovers to lead.
    let led_by = credits[rovers..].iter().chain(&credits).find_map(|credit| credit.led_by);
    let adds_g = credits.iter().any(|credit| credit.adds_g);
    // One fitness of all is not written per class, so that `--fitness` and sweeps can change it.
    let learns = |credit: &&Credit| !credit.fitness.is_empty();
    let shared = credits.iter().find(learns).map(|credit| credit.fitness);
    let shared = shared.filter(|fitness| credits.iter().filter(learns).all(|credit| credit.fitness == *fitness));
    let mut agents = Vec::new();
    for (i, ((kind, at), credit)) in all().zip(credits).enumerate() {
        let max_speed = root.need(&format!("ccea.network.{kind}_max_velocity"))?;
        let mut agent = of_agent(at, kind, &max_speed, &pois, uavs > 0)?;
        agent.members = vec![i];
        if reaches.get(i).is_some_and(|(reach, _)| *reach < needed) {
            let radius = at.need("observation_radius")?;
            agent.section.skip(&radius, "here, POIs count within the largest one for all rovers");
        }
        if agent.learns {
            if shared.is_none() {
                agent.section.put("fitness", quoted(credit.fitness), &at.need("reward_type")?);
            }
            if credit.led_by.is_some() && credit.led_by != led_by {
                agent
                    .section
                    .skip(&at.need("IndirectDifference.automatic.credit")?, "credit.led_by is one for all agents");
            }
            if credit.adds_g != adds_g && credit.fitness != "G" {
                let at = at.get("IndirectDifference.add_G").unwrap_or(at.need("reward_type")?);
                agent.section.skip(&at, "credit.add_g is one for all agents");
            }
            agent.credit = Credit { led_by: None, adds_g: false, ..credit };
        }
        // The program compares `index <= number of rovers`.
        let uses_rovers =
            i == rovers && max_speed.number()? != root.need("ccea.network.rover_max_velocity")?.number()?;
        if uses_rovers {
            agent.section.skip(&max_speed, "there, the first UAV has the largest speed of rovers instead");
        }
        agents.push(agent);
    }
    random |= agents.iter().any(is_random);
    let agents = grouped(agents);

    let mut policy = Section::new("[policy]");
    policy.fill(root, POLICY)?;
    let mut learning = Section::new("[learning]");
    let elites = |key: &str| root.get(&format!("ccea.selection.n_elites_binary_tournament.{key}"));
    let kept = elites("n_team_elites").map_or(Ok(0.0), |kept| kept.number())?;
    let first = |keys: [&str; 2]| keys.iter().find_map(|key| root.get(&format!("ccea.{key}")));
    if let Some(size) = first(["populations.agent_population_size", "population.subpopulation_size"]) {
        let added = if kept > 0.0 { " + n_team_elites, which are not part of it there" } else { "" };
        learning.derive("population", size.number()? + kept, &size, &format!("{}{added}", size.path));
    }
    learning.fill(root, LEARNING)?;
    if let Some(elites) = elites("n_individual_elites") {
        learning.skip(&elites, "there, tournaments compare the team's G, and each elite is listed twice, so that about half as many survive");
    }
    if let Some(teams) = root.get("ccea.team_formation.type").filter(|teams| !teams.shown().contains("random")) {
        learning.skip(&teams, "there, a mutated policy has fitness 0 when teams form, and here its parent's");
    }
    if let Some(fitness) = shared {
        learning.set("fitness", quoted(fitness), "the agents' reward_type");
    }
    learning.set("mutation", quoted("additive"), "as in the program");
    learning.set("initial", quoted("uniform"), "as in the program");
    let episodes = first(["evaluation.multi_rollout.num_rollouts", "evaluation.multi_evaluation.num_evaluations"]);
    if let Some(episodes) = episodes.filter(|_| random) {
        learning.put("test_episodes", episodes.value()?, &episodes);
    }
    learning.skip_unknown(root, &[WORLD, POLICY, LEARNING]);
    let credit = credit(&agents, led_by, adds_g);

    let names = |kind: &str| {
        let of_kind: Vec<_> =
            agents.iter().filter(|(_, group)| group.stem == kind).map(|(name, _)| quoted(name)).collect();
        if let [name] = &of_kind[..] { name.to_string() } else { toml::Value::Array(of_kind).to_string() }
    };
    let of_uav = agents.iter().flat_map(|(_, group)| &group.section.lines).find(|line| line.text.contains(UAV));
    if let (Some(line), true) = (of_uav, agents.iter().filter(|(_, group)| group.stem == "uav").count() != 1) {
        let message = match uavs {
            0 => "found, but there are no UAVs",
            _ => "found, allowed if all UAVs differ in their positions only",
        };
        return Err(Problem { line: Some(line.line), key: line.path.clone(), message: message.into() });
    }
    let [rovers, uavs] = ["rover", "uav"].map(names);
    let finish = |(name, group): (String, Group<'_>)| {
        let mut section = Section::new(group.section.head);
        section.set("name", quoted(&name), &format!("{} of them", group.places.len()));
        match &group.places[0] {
            Place::In(region) => {
                section.set("count", group.places.len(), "drawn anew for every episode");
                section.derive("in", region, &group.position, "position");
            }
            Place::At(_) => {
                let at =
                    group.places.iter().filter_map(|place| if let Place::At(at) = place { Some(at) } else { None });
                section.derive("at", format!("{:?}", at.collect::<Vec<_>>()), &group.position, "position");
            }
        }
        section.lines.extend(group.section.lines);
        for line in &mut section.lines {
            line.text = line.text.replace(ROVERS, &rovers).replace(UAVS, &uavs).replace(UAV, "uav");
        }
        section
    };
    let sections = [vec![world], agents.into_iter().chain(pois).map(finish).collect(), vec![credit, policy, learning]];
    Ok(sections.into_iter().flatten().collect())
}

/// Stands for the names of all classes of rovers until these are known.
const ROVERS: &str = "\u{0}rovers";
/// See [`ROVERS`].
const UAVS: &str = "\u{0}uavs";
/// Stands for the name of the only class of UAVs.
const UAV: &str = "\u{0}one uav";

fn place(at: &At<'_>) -> Result<Place, Problem> {
    let position = at.need("position")?;
    // Earlier versions of the program have the position itself.
    if position.items().is_ok() {
        return Ok(Place::At(position.point()?));
    }
    let kinds = [("fixed", 0), ("random_uniform", 1), ("random_circle", 2)];
    position.need("spawn_rule")?;
    Ok(match position.word("spawn_rule", "", &kinds)? {
        0 => Place::At(position.need("fixed")?.point()?),
        1 => {
            let number = |key: &str| position.need(&format!("random_uniform.{key}"))?.number();
            let [x0, y0, x1, y1] = [number("low_x")?, number("low_y")?, number("high_x")?, number("high_y")?];
            Place::In(format!("{{ box = [{x0:?}, {y0:?}, {x1:?}, {y1:?}] }}"))
        }
        _ => {
            let [x, y] = position.need("random_circle.center")?.point()?;
            let r = position.need("random_circle.radius")?.number()?;
            Place::In(format!("{{ circle = [{x:?}, {y:?}, {r:?}] }}"))
        }
    })
}

fn sensor(agent: &At<'_>) -> Result<Sensor, Problem> {
    agent.word("sensor.type", "SmartLidar", SENSORS)
}

/// Translates a POI. `rovers` are their radii, and whether each has a SmartLidar. Also returns the radius that
/// rovers need to count from as far as any other, or 0.
fn of_poi<'a>(at: &At<'a>, kind: &str, rovers: &[(f64, bool)]) -> Result<(Group<'a>, f64), Problem> {
    let mut section = Section::new("[[pois]]");
    let (observed, captured) = (at.need("observation_radius")?, at.number_or("capture_radius", -1.0)?);
    let reach = rovers.iter().map(|(reach, _)| *reach).fold(0.0, f64::max);
    let needed = reach.min(observed.number()?);
    let radius = captured.max(needed);
    section.derive(
        "radius",
        format!("{radius:?}"),
        &at.get("capture_radius").unwrap_or(observed),
        "capture_radius, or the less of a rover's and the POI's observation_radius",
    );
    section.fill(at, POI)?;
    section.set("score", quoted("closeness"), "as in the program");
    let (factor, coupling) = (at.need("value")?, at.need("coupling")?.number()?);
    let value = factor.number()? * coupling;
    section.put("value", format!("{value:?}"), &factor);
    if coupling != 1.0 {
        section
            .skip(&factor, "the program scores it times the coupling, as here, but UAVs sense the value itself there");
    }
    // A rover with a SmartLidar hides such a POI from UAVs once it is this near.
    let hides = at.word("disappear_bool", "false", &[("false", false), ("true", kind == "hidden")])?;
    let near = rovers.iter().filter(|(_, is_smart)| *is_smart).map(|(reach, _)| reach.min(1.0)).fold(0.0, f64::max);
    if let Some(disappears) = at.get("disappear_bool").filter(|_| hides && near > 0.0) {
        section.put("gone_within", format!("{near:?}"), &disappears);
        if rovers.iter().any(|(reach, is_smart)| !is_smart || *reach < near) {
            section.skip(&disappears, "there, it disappears only for rovers with a SmartLidar that sense it");
        }
    }
    section.skip_unknown(at, &[POI]);
    let subtype = at.get("subtype");
    let shown = subtype.as_ref().map_or(String::new(), At::shown);
    let subtype = subtype.map(|subtype| subtype.value()).transpose()?.filter(|name| name.as_str() != Some(""));
    let plain: String = shown.chars().filter(|c| c.is_ascii_alphanumeric() || *c == '-').take(40).collect();
    // Numbers of groups follow a _, so that names are unique.
    let stem = if plain.is_empty() { kind.into() } else { format!("{kind}-{plain}") };
    let needed = if needed > captured { needed } else { 0.0 };
    Ok((Group { subtype, value, ..Group::new(at, stem, section)? }, needed))
}

/// Reports whether an agent follows UAVs and does not learn.
fn follows(at: &At<'_>) -> Result<bool, Problem> {
    at.word("policy.type", "network", &[("network", false), ("follow", true)])
}

/// Why a move to a UAV differs.
const STRAIGHT: &str = "there, dx and dy of a move to a UAV are limited each by itself; here it is straight";

/// Translates an agent but for its fitness.
fn of_agent<'a>(
    at: &At<'a>,
    kind: &str,
    max_speed: &At<'_>,
    pois: &[(String, Group<'_>)],
    has_uavs: bool,
) -> Result<Group<'a>, Problem> {
    let mut section = Section::new("[[agents]]");
    section.fill(at, AGENT)?;
    let follows = follows(at)?;
    let picks = at.word("action.type", "dxdy", &[("dxdy", false), ("pick_uav", true)])?;
    let needs_uav = at.word("needs_uav_to_move", "false", &[("false", false), ("true", true)])?;
    let motion = format!("{{ kind = \"free\", max_speed = {:?} }}", max_speed.number()?);
    section.put("motion", motion, max_speed);
    if let Some(bounds) = at.get("bounds") {
        let side = |key: &str| bounds.need(key)?.number();
        let stays_in = [side("low_x")?, side("low_y")?, side("high_x")?, side("high_y")?];
        section.put("stays_in", format!("{stays_in:?}"), &bounds);
    }
    if follows {
        let policy = at.need("policy.type")?;
        section.put("control", format!("\"nearest:{UAV}\""), &policy);
        section.skip(&policy, STRAIGHT);
        let radius = at.need("observation_radius")?;
        section.put("reach", format!("{:?}", radius.number()?), &radius);
    } else {
        if picks {
            let action = at.need("action.type")?;
            section.put("control", format!("\"choose:{UAV}\""), &action);
            section.skip(&action, STRAIGHT);
        }
        if needs_uav && kind == "rover" {
            section.put("moves_near", format!("\"{UAV}\""), &at.need("needs_uav_to_move")?);
        }
        senses(at, kind, pois, has_uavs, &mut section)?;
    }
    if kind == "uav" {
        section.set("observes", "false", "only rovers count at POIs");
        section.set("leads", ROVERS, "as in the program");
        section.set("influence_radius", format!("{INFLUENCE_RADIUS:?}"), "as in the program");
    }
    section.skip_unknown(at, &[AGENT]);
    Ok(Group { learns: !follows, ..Group::new(at, kind.into(), section)? })
}

/// Adds what an agent senses.
fn senses(
    at: &At<'_>,
    kind: &str,
    pois: &[(String, Group<'_>)],
    has_uavs: bool,
    section: &mut Section,
) -> Result<(), Problem> {
    let radius = at.need("observation_radius")?;
    let range = radius.number()?;
    let sensor = sensor(at)?;
    let channels = if sensor == Sensor::UavDistance {
        format!(
            "    {{ of = {UAVS}, sectors = \"each\", range = {range:?}, measure = \"distance\", combine = \"sum\", empty = -1.0 }},\n"
        )
    } else {
        let resolution = at.need("resolution")?;
        let sectors = 360.0 / resolution.number()?;
        if !(1.0..=16.0).contains(&sectors) || sectors.fract() != 0.0 {
            return Err(resolution.problem(format!(
                "found {}, allowed degrees that divide 360 into 1 to 16 sectors",
                resolution.shown()
            )));
        }
        let (measure, power, least) = at.word("sensor.measurement_type", "inverse_distance_squared", MEASURES)?;
        let combine = at.word("sensor.accum_type", "average", &[("average", "mean"), ("sum", "sum")])?;
        let empty = at.number_or("sensor.default_value", -1.0)?;
        // The distance below which the measure of POIs with this value does not grow.
        let nearest = |value: f64| (power > 0.0).then(|| f64::max(least, (value / MOST_MEASURED).powf(1.0 / power)));
        let channel = |of: &str, range: f64, measure: &str, nearest: Option<f64>| {
            let nearest = nearest.map_or(String::new(), |nearest| format!(" nearest = {nearest:?},"));
            format!(
                "    {{ of = {of}, sectors = {sectors}, frame = \"map\", range = {range:?}, measure = \"{measure}\",{nearest} \
                 combine = \"{combine}\", empty = {empty:?} }},\n"
            )
        };
        let nothing = || channel("\"pois\"", 0.0, "exponential", None);
        let of_uavs = if has_uavs { channel(UAVS, range, measure, nearest(1.0)) } else { nothing() };
        let of_agents = channel(ROVERS, range, measure, nearest(1.0)) + &of_uavs;
        let subtypes = at.list("observable_subtypes")?;
        let subtypes = subtypes.iter().map(At::value).collect::<Result<Vec<_>, _>>()?;
        let knows = |group: &Group<'_>| group.subtype.as_ref().is_none_or(|subtype| subtypes.contains(subtype));
        let seen = |(_, group): &&(String, Group<'_>)| group.stem.starts_with("rover") || kind == "uav" && knows(group);
        let (groups, values): (Vec<_>, Vec<_>) =
            pois.iter().filter(seen).map(|(name, group)| (quoted(name), group.value)).unzip();
        let limit = nearest(values.into_iter().fold(1.0, f64::max));
        let of_pois = match groups.len() {
            0 => nothing(),
            seen if seen == pois.len() => channel("\"pois\"", range, measure, limit),
            _ => channel(&format!("\"pois\", pois = {}", Value::Array(groups)), range, measure, limit),
        };
        if sensor == Sensor::Rover {
            of_agents
        } else {
            // POIs nearer than the limit then count as at the limit.
            if limit != nearest(1.0) {
                let why = format!("here, a POI's value times its measure is at most {MOST_MEASURED}");
                section.skip(at.get("sensor.measurement_type").as_ref().unwrap_or(&radius), &why);
            }
            of_agents + &of_pois
        }
    };
    section.derive("senses", format!("[\n{channels}]"), &radius, "sensor, resolution and observation_radius");
    Ok(())
}

/// Reads how one of `agents` agents is scored.
fn credit_of(at: &At<'_>, agents: usize) -> Result<Credit, Problem> {
    if follows(at)? {
        return Ok(Credit::default());
    }
    let of = |key: &str| format!("IndirectDifference.{key}");
    let adds_g = at.word(&of("add_G"), "false", &[("false", false), ("true", true)])?;
    let credit = |fitness| Credit { fitness, adds_g, led_by: None, removes: None };
    at.need("reward_type")?;
    let kinds = [("Global", Some("G")), ("Difference", Some("D")), ("IndirectDifference", None)];
    if let Some(fitness) = at.word("reward_type", "", &kinds)? {
        // Twice G has the same order.
        return Ok(Credit { adds_g: adds_g && fitness != "G", ..credit(fitness) });
    }
    if at.word(&of("assignment"), "automatic", &[("automatic", false), ("manual", true)])? {
        let manual = at.list(&of("manual"))?;
        let removes = manual.iter().map(|agent| agent.agent(agents)).collect::<Result<_, Problem>>()?;
        return Ok(Credit { removes: Some(removes), ..credit("D") });
    }
    if !at.word(&of("automatic.timescale"), "trajectory", &[("trajectory", false), ("timestep", true)])? {
        return Ok(credit("Df"));
    }
    let rules = [("Local", "any-seen"), ("AllOrNothing", "first"), ("System", "anyone"), ("Difference", "alone")];
    Ok(Credit { led_by: Some(at.word(&of("automatic.credit"), "AllOrNothing", &rules)?), ..credit("Dt") })
}

/// Returns the section with what all credits have in common.
fn credit(agents: &[(String, Group<'_>)], led_by: Option<&str>, adds_g: bool) -> Section {
    let mut section = Section::new("[credit]");
    if let Some(led_by) = led_by {
        let more = if led_by == "first" {
            "; the program also credits agent 0 with rovers that nobody influences"
        } else {
            ""
        };
        section.set("led_by", quoted(led_by), &format!("IndirectDifference.automatic.credit{more}"));
    }
    let groups = || agents.iter().map(|(_, group)| group);
    if groups().any(|group| group.credit.removes.is_some()) {
        let order: Vec<usize> = groups().flat_map(|group| group.members.clone()).collect();
        let here = |agent: &usize| order.iter().position(|other| other == agent).unwrap_or(*agent);
        let mut removes: Vec<Vec<usize>> = Vec::new();
        for group in groups().filter(|group| group.learns) {
            for member in &group.members {
                let list = group.credit.removes.as_deref().unwrap_or(std::slice::from_ref(member));
                removes.push(list.iter().map(here).collect());
            }
        }
        section.set("removes", format!("{removes:?}"), "IndirectDifference.manual");
    }
    if adds_g {
        section.set("add_g", "true", "IndirectDifference.add_G");
    }
    section
}
