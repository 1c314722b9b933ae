//! Configs of leader-follower, whose teams of leaders and followers the paper has.

use super::table::{Row, Section, To, quoted};
use super::yaml::At;
use flotilla::config::Problem;

const RUN: &[Row] = &[
    ("num_generations", To::Need("generations")),
    ("CCEA.sub_population_size", To::Need("population")),
    ("CCEA.mutation_probability", To::Need("mutation_probability")),
    ("CCEA.mutation_rate", To::Need("mutation_sigma")),
    ("CCEA.num_evaluations", To::Key("episodes_per_team")),
    ("CCEA.config.BoidsEnv.init_seed", To::Key("seed")),
    ("CCEA.num_parents", To::Nothing("parents are drawn by binary tournaments, as in the newest version")),
    ("CCEA.num_workers", To::Nothing("training uses all cores, or as many as --threads says")),
    ("CCEA.config.BoidsEnv.render_mode", To::Only("none", "`flotilla replay` shows episodes")),
    ("load_population", To::Nothing("`flotilla train --init` starts from policies of a run")),
    ("CCEA.use_difference_rewards", To::Code("")),
    ("CCEA.use_difference_evaluations", To::Code("")),
    ("CCEA.config.BoidsEnv.config", To::Code("")),
];

const POLICY: &[Row] = &[("CCEA.nn_hidden", To::List("hidden"))];

const WORLD: &[Row] = &[("CCEA.config.BoidsEnv.max_steps", To::Need("steps"))];

const LISTED: &str = "positions are the listed ones, which other rules ignore";

/// Keys below `CCEA.config.BoidsEnv.config`, for the world.
const ENVIRONMENT: &[Row] = &[
    ("map_dimensions", To::Code("x y")),
    ("BoidsColony.dt", To::Need("dt")),
    (
        "BoidsColony",
        To::Code(
            "radius_repulsion radius_orientation radius_attraction repulsion_multiplier orientation_multiplier \
             attraction_multiplier wall_avoidance_multiplier",
        ),
    ),
    (
        "StateBounds",
        To::Code("min_velocity max_velocity max_acceleration max_angular_velocity num_leaders num_followers"),
    ),
    ("BoidSpawner.spawn_rule", To::Only("Individual", LISTED)),
    ("BoidSpawner.position_rule", To::Only("Set", LISTED)),
    ("BoidSpawner.velocity_rule", To::Only("FixedStart", "speeds at the start are fixed")),
    ("BoidSpawner.heading_rule", To::Only("FixedStart", "headings at the start are fixed")),
    ("BoidSpawner", To::Code("velocity_fraction leader_positions follower_positions start_heading")),
    ("ObservationManager.observation_rule", To::Only("Individual", "each leader senses by itself")),
    ("ObservationManager.poi_sensor_type", To::Only("Density", "inputs are densities of sectors")),
    ("ObservationManager.swarm_sensor_type", To::Only("Density", "inputs are densities of sectors")),
    ("ObservationManager", To::Code("num_poi_bins num_swarm_bins observation_radius full_observability")),
    ("POISpawner.poi_spawn_rule", To::Only("Set", LISTED)),
    ("POISpawner", To::Code("positions")),
    ("POIColony", To::Code("coupling observation_radius")),
    ("FitnessCalculator.which_G", To::Code("")),
    ("FitnessCalculator.which_D", To::Code("")),
    ("reward_type", To::Code("")),
    ("FitnessCalculator.follower_switch", To::Code("")),
    ("FitnessCalculator.which_F", To::Only("G", "there are no potentials")),
    ("FitnessCalculator.use_drip", To::Only("Regular", "there are no potentials")),
    ("Renderer", To::Nothing("`flotilla replay` shows episodes")),
];

const LEADERS: &[Row] = &[("BoidSpawner.leader_positions", To::Need("at"))];

const FOLLOWERS: &[Row] = &[
    ("BoidSpawner.follower_positions", To::Need("at")),
    ("BoidsColony.radius_repulsion", To::Need("wall_radius")),
    ("BoidsColony.wall_avoidance_multiplier", To::Need("wall_gain")),
];

const POIS: &[Row] = &[
    ("POISpawner.positions", To::Need("at")),
    ("POIColony.coupling", To::Need("coupling")),
    ("POIColony.observation_radius", To::Need("radius")),
    (
        "FitnessCalculator.which_G",
        To::Word(
            "score",
            "MinDiscrete",
            &[
                ("MinDiscrete", "observed"),
                ("ContinuousObsRad", "closeness"),
                ("ContinuousObsRadLastStep", "closeness"),
            ],
        ),
    ),
    (
        "FitnessCalculator.which_G",
        To::Word(
            "when",
            "MinDiscrete",
            &[("MinDiscrete", "ever"), ("ContinuousObsRad", "mean"), ("ContinuousObsRadLastStep", "end")],
        ),
    ),
];

/// Translates a config.
pub(super) fn translate(root: &At<'_>) -> Result<Vec<Section>, Problem> {
    let env = root.need("CCEA.config.BoidsEnv.config")?;
    let size = env.need("map_dimensions")?;
    let mut world = Section::new("[world]");
    world.put("map", format!("[{:?}, {:?}]", size.need("x")?.number()?, size.need("y")?.number()?), &size);
    world.fill(root, WORLD)?;
    world.fill(&env, ENVIRONMENT)?;
    world.set("start_counts", env.get("FitnessCalculator").is_some(), "as in the program");

    let mut pois = Section::new("[[pois]]");
    pois.set("name", quoted("poi"), "");
    pois.fill(&env, POIS)?;
    if let Some(which) = env.get("FitnessCalculator.which_G").filter(|which| which.shown().contains("Continuous")) {
        pois.skip(&which, "the program has 1 over the mean of the distances, and here is the product of 1 over each");
    }

    let (mut policy, mut learning) = (Section::new("[policy]"), Section::new("[learning]"));
    policy.fill(root, POLICY)?;
    learning.fill(root, RUN)?;
    learning.set("mutation", quoted("scaled"), "as in the program");
    learning.set("elites", 1, "as in the program");
    learning.set("fitness", quoted(fitness(root, &env)?), "the program's difference reward, or G without one");
    learning.skip_unknown(root, &[RUN, POLICY, WORLD]);
    learning.skip_unknown(&env, &[ENVIRONMENT]);

    let count = |role: &str| {
        let places = env.list(&format!("BoidSpawner.{role}_positions"))?.len();
        match env.get(&format!("StateBounds.num_{role}s")) {
            Some(count) if places > 0 && count.number()? != places as f64 => {
                Err(count.problem(format!("found {}, but there are {places} {role}_positions", count.shown())))
            }
            _ => Ok(places),
        }
    };
    count("leader")?;
    let has_followers = count("follower")? > 0;
    let follower = if has_followers { Some(follower(&env)?) } else { None };
    let switch = "FitnessCalculator.follower_switch";
    let all = "UseLeadersAndFollowers";
    let followers_only = env.word(switch, all, &[(all, false), ("UseFollowersOnly", true)])?;
    if let Some(switch) = env.get(switch).filter(|_| followers_only) {
        match has_followers {
            true => pois.put("observers", quoted("follower"), &switch),
            false => pois.skip(&switch, "there are no followers"),
        }
    }
    let sections =
        [Some(world), Some(leader(&env, has_followers)?), follower, Some(pois), Some(policy), Some(learning)];
    Ok(sections.into_iter().flatten().collect())
}

/// Returns the fitness, which versions of the program have in different places.
fn fitness(root: &At<'_>, env: &At<'_>) -> Result<&'static str, Problem> {
    if env.get("FitnessCalculator.which_D").is_some() {
        return env.word("FitnessCalculator.which_D", "", &[("G", "G"), ("D", "D"), ("DFollow", "Df")]);
    }
    let switch = |key: &str| root.word(key, "null", &[("null", None), ("false", Some(false)), ("true", Some(true))]);
    let default = match switch("CCEA.use_difference_rewards")?.or(switch("CCEA.use_difference_evaluations")?) {
        // The program ignores the reward type then.
        Some(false) => return Ok("G"),
        Some(true) => "difference_leader_follower",
        None => "global",
    };
    let kinds = [("global", "G"), ("difference_leader", "D"), ("difference_leader_follower", "Df")];
    env.word("reward_type", default, &kinds)
}

/// Returns the section of a class, with what leaders and followers have in common.
fn class(name: &str, env: &At<'_>, rows: &[Row]) -> Result<Section, Problem> {
    let mut section = Section::new("[[agents]]");
    section.set("name", quoted(name), "");
    section.fill(env, rows)?;
    let bounds = env.need("StateBounds")?;
    let limit = |key: &str| bounds.need(key)?.number();
    let [min, max] = [limit("min_velocity")?, limit("max_velocity")?];
    let [acceleration, turn] = [limit("max_acceleration")?, limit("max_angular_velocity")?];
    let motion = format!(
        "{{ min_speed = {min:?}, max_speed = {max:?}, max_acceleration = {acceleration:?}, max_turn_rate = {turn:?} }}"
    );
    section.put("motion", motion, &bounds);
    section.fill(env, &[("BoidSpawner.start_heading", To::Key("heading"))])?;
    if let Some(part) = env.get("BoidSpawner.velocity_fraction") {
        section.put("speed", format!("{:?}", part.number()? * (max - min) + min), &part);
    }
    Ok(section)
}

/// Returns the section of the leaders. They sense agents within the attraction radius only.
fn leader(env: &At<'_>, has_followers: bool) -> Result<Section, Problem> {
    let mut section = class("leader", env, LEADERS)?;
    let manager = env.need("ObservationManager")?;
    let sees_all = manager.word("full_observability", "false", &[("false", false), ("true", true)])?;
    let radius = manager.get("observation_radius").filter(|_| !sees_all);
    let radius = radius.map(|radius| radius.number()).transpose()?;
    let attraction = env.need("BoidsColony.radius_attraction")?.number()?;
    let (measure, pois) = match radius {
        Some(radius) => ("closeness", format!("range = {radius:?}, ")),
        None => ("linear", String::new()),
    };
    let agents = radius.map_or(attraction, |radius| radius.min(attraction));
    if radius.is_some_and(|radius| radius > agents) {
        section.skip(&manager.need("observation_radius")?, "agents are sensed relative to the attraction radius here");
    }
    let bins = |key: &str| manager.need(key)?.value();
    let senses = format!(
        "[\n    {{ of = \"pois\", sectors = {}, {pois}measure = \"{measure}\" }},\n    \
         {{ of = \"agents\", sectors = {}, range = {agents:?}, measure = \"{measure}\" }},\n]",
        bins("num_poi_bins")?,
        bins("num_swarm_bins")?,
    );
    section.put("senses", senses, &manager);
    if has_followers {
        section.set("leads", quoted("follower"), "as in the program");
    }
    Ok(section)
}

fn follower(env: &At<'_>) -> Result<Section, Problem> {
    let mut section = class("follower", env, FOLLOWERS)?;
    let colony = env.need("BoidsColony")?;
    let number = |key: &str| colony.need(key)?.number();
    let [near, middle, far] =
        [number("radius_repulsion")?, number("radius_orientation")?, number("radius_attraction")?];
    let [push, pull] = [number("repulsion_multiplier")?, number("attraction_multiplier")?];
    let align = colony.need("orientation_multiplier")?;
    let mut rule = format!("[\n    {{ of = \"agents\", to = {near:?}, gain = {:?} }},\n", -push);
    if align.number()? != 0.0 {
        rule +=
            &format!("    {{ of = \"agents\", from = {near:?}, to = {middle:?}, align = {:?} }},\n", align.number()?);
        section.skip(&align, "the program multiplies a sum of headings, and here is their mean");
    }
    rule += &format!("    {{ of = \"agents\", from = {middle:?}, to = {far:?}, gain = {pull:?} }},\n]");
    section.set("control", quoted("follow"), "as in the program");
    section.put("rule", rule, &colony);
    Ok(section)
}
