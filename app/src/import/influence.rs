//! Configs of influence shaping, which trains rovers and UAVs.

use super::table::{Row, Section, To, quoted};
use super::yaml::At;
use flotilla::config::Problem;

const WORLD: &[Row] = &[
    ("env.map_size", To::Need("map")),
    ("ccea.num_steps", To::Need("steps")),
    ("env.agents", To::Code("")),
    ("env.pois", To::Code("")),
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
    ("IndirectDifference", To::Code("assignment manual automatic add_G")),
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
    ("disappear_bool", To::Only("false", "UAVs sense POIs also after a rover was there")),
];

const POLICY: &[Row] = &[
    ("ccea.network.hidden_layers", To::List("hidden")),
    ("ccea.network.rover_max_velocity", To::Code("")),
    ("ccea.network.uav_max_velocity", To::Code("")),
];

const LEARNING: &[Row] = &[
    ("ccea.populations.agent_population_size", To::Key("population")),
    ("ccea.population.subpopulation_size", To::Key("population")),
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
/// The names of measures here, with the distance below which they do not grow.
const MEASURES: &[(&str, (&str, &str))] = &[
    // 1/max(0.001, d²).
    ("inverse_distance_squared", ("inverse-squared", " nearest = 0.03162277660168379,")),
    // 1/max(0.001, d) there; 0.01 is the least here.
    ("inverse_distance", ("inverse", " nearest = 0.01,")),
    ("exponential_negative_distance", ("exponential", "")),
    ("distance_over_observation_radius", ("distance", "")),
    ("one_minus_inverse_distance_over_observation_radius", ("closeness", "")),
];

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

impl Group<'_> {
    /// Reports whether another member can be in this group.
    fn fits(&self, other: &Group<'_>) -> bool {
        let texts = |group: &Group<'_>| {
            let lines = group.section.lines.iter().map(|line| line.text.clone());
            lines.filter(|text| !text.is_empty()).collect::<Vec<_>>()
        };
        let kind = |place: &Place| matches!(place, Place::In(_)).then(|| place.clone());
        kind(&self.places[0]) == kind(&other.places[0])
            && (&self.stem, self.learns, &self.credit) == (&other.stem, other.learns, &other.credit)
            && texts(self) == texts(other)
    }
}

/// Puts members that differ in their positions only together, and names the groups.
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
    let reach = kinds[0].1.iter().map(|rover| rover.need("observation_radius")?.number());
    let reach = reach.collect::<Result<Vec<_>, _>>()?.into_iter().fold(0.0, f64::max);
    let mut pois = Vec::new();
    for kind in ["rover", "hidden"] {
        for poi in few(root, &format!("env.pois.{kind}_pois"))? {
            pois.push(of_poi(&poi, kind, reach)?);
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
    // One rule, and one choice to add G, are for all agents.
    let led_by = credits.iter().find_map(|credit| credit.led_by);
    let adds_g = credits.iter().any(|credit| credit.adds_g);
    let mut agents = Vec::new();
    for (i, ((kind, at), credit)) in all().zip(credits).enumerate() {
        let max_speed = root.need(&format!("ccea.network.{kind}_max_velocity"))?;
        let mut agent = of_agent(at, kind, &max_speed, &pois, uavs > 0)?;
        agent.members = vec![i];
        if agent.learns {
            agent.section.put("fitness", quoted(credit.fitness), &at.need("reward_type")?);
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
    learning.fill(root, LEARNING)?;
    learning.set("mutation", quoted("additive"), "as in the program");
    learning.set("initial", quoted("uniform"), "as in the program");
    if let Some(episodes) = root.get("ccea.evaluation.multi_rollout.num_rollouts").filter(|_| random) {
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
        let message = "found, allowed if all UAVs differ in their positions only".into();
        return Err(Problem { line: Some(line.line), key: line.path.clone(), message });
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
                section.derive("at", format!("{:?}", at.collect::<Vec<_>>()), &group.position, "position.fixed");
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

/// Translates a POI. `reach` is the largest radius of rovers.
fn of_poi<'a>(at: &At<'a>, kind: &str, reach: f64) -> Result<Group<'a>, Problem> {
    let mut section = Section::new("[[pois]]");
    let (observed, captured) = (at.need("observation_radius")?, at.number_or("capture_radius", -1.0)?);
    let radius = captured.max(reach.min(observed.number()?));
    section.derive(
        "radius",
        format!("{radius:?}"),
        &at.get("capture_radius").unwrap_or(observed),
        "capture_radius, or the less of a rover's and the POI's observation_radius",
    );
    section.fill(at, POI)?;
    section.set("score", quoted("closeness"), "as in the program");
    let (value, coupling) = (at.need("value")?, at.need("coupling")?.number()?);
    section.put("value", format!("{:?}", value.number()? * coupling), &value);
    if coupling != 1.0 {
        section
            .skip(&value, "the program scores it times the coupling, as here, but UAVs sense the value itself there");
    }
    section.skip_unknown(at, &[POI]);
    let subtype = at.get("subtype").map_or(String::new(), |subtype| format!("_{}", word(&subtype)));
    let (position, places, stem) = (at.need("position")?, vec![place(at)?], format!("{kind}{subtype}"));
    Ok(Group { stem, section, places, position, members: vec![], learns: true, credit: Credit::default() })
}

/// Returns a value as part of a name.
fn word(at: &At<'_>) -> String {
    at.shown().chars().filter(|c| c.is_ascii_alphanumeric() || *c == '-').collect()
}

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
    let follows = at.word("policy.type", "network", &[("network", false), ("follow", true)])?;
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
        section.put("control", format!("\"nearest:{UAV}\""), &at.need("policy.type")?);
        let radius = at.need("observation_radius")?;
        section.put("reach", format!("{:?}", radius.number()?), &radius);
    } else {
        if picks {
            section.put("control", format!("\"choose:{UAV}\""), &at.need("action.type")?);
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
    Ok(Group {
        stem: kind.into(),
        section,
        places: vec![place(at)?],
        position: at.need("position")?,
        members: vec![],
        learns: !follows,
        credit: Credit::default(),
    })
}

/// Adds what an agent senses.
fn senses(
    at: &At<'_>,
    kind: &str,
    pois: &[(String, Group<'_>)],
    has_uavs: bool,
    section: &mut Section,
) -> Result<(), Problem> {
    let resolution = at.need("resolution")?;
    let sectors = (360.0 / resolution.number()?).floor();
    if !(1.0..=16.0).contains(&sectors) {
        return Err(
            resolution.problem(format!("found {}, allowed degrees that make 1 to 16 sectors", resolution.shown()))
        );
    }
    let radius = at.need("observation_radius")?;
    let range = radius.number()?;
    let (measure, nearest) = at.word("sensor.measurement_type", "inverse_distance_squared", MEASURES)?;
    let combine = at.word("sensor.accum_type", "average", &[("average", "mean"), ("sum", "sum")])?;
    let empty = at.number_or("sensor.default_value", -1.0)?;
    let channel = |of: &str, range: f64, measure: &str, combine: &str, empty: f64| {
        format!(
            "    {{ of = {of}, sectors = {sectors}, frame = \"map\", range = {range:?}, measure = \"{measure}\",{nearest} \
             combine = \"{combine}\", empty = {empty:?} }},\n"
        )
    };
    let nothing = || channel("\"pois\"", 0.0, measure, combine, empty);
    let sensor =
        at.word("sensor.type", "SmartLidar", &[("SmartLidar", 0), ("RoverLidar", 1), ("UavDistanceLidar", 2)])?;
    let channels = if sensor == 2 {
        format!(
            "    {{ of = {UAVS}, sectors = \"each\", range = {range:?}, measure = \"distance\", combine = \"sum\", empty = -1.0 }},\n"
        )
    } else {
        let of_uavs = if has_uavs { channel(UAVS, range, measure, combine, empty) } else { nothing() };
        let of_agents = channel(ROVERS, range, measure, combine, empty) + &of_uavs;
        let seen = |(_, group): &&(String, Group<'_>)| {
            let subtypes = at.list("observable_subtypes").unwrap_or_default();
            let knows = |subtype: &str| subtypes.iter().any(|other| word(other) == subtype);
            group.stem.starts_with("rover") || kind == "uav" && group.stem.strip_prefix("hidden_").is_none_or(knows)
        };
        let groups: Vec<_> = pois.iter().filter(seen).map(|(name, _)| quoted(name)).collect();
        let of_pois = match groups.len() {
            0 => nothing(),
            seen if seen == pois.len() => channel("\"pois\"", range, measure, combine, empty),
            _ => channel(&format!("\"pois\", pois = {}", toml::Value::Array(groups)), range, measure, combine, empty),
        };
        if sensor == 0 { of_agents + &of_pois } else { of_agents }
    };
    section.derive("senses", format!("[\n{channels}]"), &radius, "sensor, resolution and observation_radius");
    Ok(())
}

/// Reads how one of `agents` agents is scored.
fn credit_of(at: &At<'_>, agents: usize) -> Result<Credit, Problem> {
    let of = |key: &str| format!("IndirectDifference.{key}");
    let adds_g = at.word(&of("add_G"), "false", &[("false", false), ("true", true)])?;
    let credit = |fitness| Credit { fitness, adds_g, led_by: None, removes: None };
    at.need("reward_type")?;
    let kinds = [("Global", Some("G")), ("Difference", Some("D")), ("IndirectDifference", None)];
    if let Some(fitness) = at.word("reward_type", "", &kinds)? {
        return Ok(credit(fitness));
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
