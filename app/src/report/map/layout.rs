//! The layout of a config before training.

use glam::DVec2;

use super::{
    FAINT, Form, Legend, Marker, Poi, Team, Viewport, counted, is_timed, sample_note, time_label, values_differ,
};
use crate::report::scene::{Anchor, BLACK, Pen, Scene, text_width};
use flotilla::config::{AgentClass, Classes, Observers, PoiGroup, Region, StageConfig, When, drawn_agents};
use flotilla::world::World;

/// Returns the team of a config before training.
fn team(config: &StageConfig, world: &World) -> Team {
    let leaders = world.leaders();
    let agent = |index: usize| Marker {
        place: world.starts[index].as_dvec2(),
        heading: world.headings[index].as_dvec2(),
        form: Form::of_agent(world, index),
        group: (index < leaders).then_some(index),
        counts: world.rule.counts(index),
        trail: vec![],
    };
    let none = vec![false; world.pois.len()];
    let poi = |(poi, &place): (usize, &[f64; 2])| Poi::new(world, poi, place.into(), None, 1, &none);
    Team {
        leaders,
        agents: drawn_agents(leaders, world.agents()).into_iter().map(agent).collect(),
        pois: config.classes().places().iter().enumerate().map(poi).collect(),
    }
}

/// Outlines a region from which starts or POIs are drawn.
fn outline(view: &Viewport, scene: &mut Scene, region: Region) {
    let pen = Pen { dash: &[1.8, 1.0], ..Pen::new(FAINT, 0.3) };
    match region {
        Region::Box([x0, y0, x1, y1]) => {
            let corners = [[x0, y0], [x1, y0], [x1, y1], [x0, y1]];
            scene.polygon(corners.map(|corner| view.at(corner.into())).to_vec(), None, Some(pen));
        }
        Region::Disc([x, y, radius]) | Region::Circle([x, y, radius]) => {
            scene.circle(view.at([x, y].into()), radius * view.scale, None, Some(pen));
        }
    }
}

/// Draws the layout of a config before training: start positions, headings and the coupling of each POI.
pub fn layout(name: &str, config: &StageConfig) -> Scene {
    const LEFT: f64 = 11.0;
    const EDGE: f64 = 3.0;
    const HEAD: f64 = 6.5;
    let world = World::new(config);
    let (leaders, team) = (world.leaders(), team(config, &world));
    let map = DVec2::from(config.world.map);
    let view = Viewport::new(config, [DVec2::ZERO, map], 80.0).moved_to([LEFT, HEAD]);
    let [width, height] = view.size();
    let classes = config.classes();
    let alike_radii = classes.pois.windows(2).all(|pair| pair[0].radius == pair[1].radius);
    let within = match classes.pois.first() {
        Some(group) if alike_radii => format!("within {} of it", group.radius),
        _ => "within its circle".into(),
    };
    let mut legend = Legend::new(config, &view, std::slice::from_ref(&team), "");
    let alike = world.coupling.windows(2).all(|pair| pair[0] == pair[1]);
    let needs = match (world.coupling.first(), view.poi_labels(&team)) {
        (_, Some(_)) if is_timed(&world) => {
            format!("at a POI: its number, agents it needs {within}, and when")
        }
        (_, Some(_)) if values_differ(&world) => format!("at a POI: agents it needs {within}, and its value"),
        (_, Some(_)) => format!("number at a POI: agents it needs, {within}"),
        (Some(&needed), None) if alike => {
            format!("each POI needs {} {within}", counted(needed as usize, "agent"))
        }
        _ => format!("what each POI needs has no room here; it counts {within}"),
    };
    legend.note(needs);
    if !is_timed(&world) && classes.pois.iter().any(|group| group.when == When::End) {
        legend.note("only the last step counts");
    }
    let observers = if config.agents.is_empty() { vec![] } else { observers(&classes) };
    if (2..=4).contains(&observers.len()) {
        legend.note(observers.join("; "));
    }
    sample_note(&world).into_iter().for_each(|note| legend.note(note));
    let agents = config.agents.iter().filter_map(|class| Some((format!("agents of {}", class.name), class.region?)));
    let pois = config.pois.iter().filter_map(|group| Some((format!("POIs of {}", group.name), group.region?)));
    let regions: Vec<(String, Region)> = agents.chain(pois).collect();
    let drawn = regions.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>().join(", ");
    if !regions.is_empty() {
        legend.note(format!("long dashes: regions from which {drawn} are drawn in every episode; shown is an example"));
    }
    if config.learning.start_jitter > 0.0 {
        legend.note(format!("starts move by up to {} on each axis", config.learning.start_jitter));
    }
    if config.learning.poi_jitter > 0.0 {
        legend.note(format!("POIs move by up to {} on each axis", config.learning.poi_jitter));
    }
    let whole = LEFT + width.max(50.0) + EDGE;
    let room = whole - 2.0 * EDGE;
    let mut scene = Scene::new(whole, HEAD + height + 9.5 + legend.height(room) + 0.5);
    let agents = match &config.agents[..] {
        [] => [counted(leaders, "leader"), counted(world.followers(), "follower")].join(", "),
        classes => {
            let size = |class: &AgentClass| format!("{} × {}", class.size(), class.name);
            classes.iter().map(size).collect::<Vec<_>>().join(", ")
        }
    };
    let described = format!("{agents}, {}", counted(team.pois.len(), "POI"));
    // The legend names the classes, too.
    let title = match text_width(&described, 3.0) * 1.1 < room {
        true => described.clone(),
        false => format!("{}, {}", counted(world.agents(), "agent"), counted(team.pois.len(), "POI")),
    };
    scene.bold([EDGE, 4.2], title, 3.0, Anchor::Start, BLACK);
    view.draw(&mut scene, &team);
    regions.iter().for_each(|(_, region)| outline(&view, &mut scene, *region));
    view.rule(&mut scene);
    legend.draw(&mut scene, [EDGE, HEAD + height + 11.8], room);
    scene.title = format!("The layout of {name}: {described}");
    let couplings = match (world.coupling.iter().min(), world.coupling.iter().max()) {
        (Some(least), Some(most)) if least == most => {
            format!("Each POI needs {} near at once", counted(*least as usize, "agent"))
        }
        (Some(least), Some(most)) => format!("A POI needs {least} to {most} agents near at once"),
        _ => String::new(),
    };
    let places = |what: &str, places: &[DVec2]| {
        let list: Vec<_> = places.iter().take(12).map(|place| format!("({}, {})", place.x, place.y)).collect();
        let more = if places.len() > 12 { ", …" } else { "" };
        format!("{what} at {}{more}. ", list.join(", "))
    };
    let who = match config.drawn().observers {
        _ if !config.agents.is_empty() => format!(" {}.", observers.join("; ")),
        Observers::All => String::new(),
        observers => format!(" Only {observers} observe."),
    };
    let timed = if is_timed(&world) { pois_in_words(&world) } else { String::new() };
    let starts: Vec<DVec2> = team.agents[..leaders].iter().map(|agent| agent.place).collect();
    let pois: Vec<DVec2> = team.pois.iter().map(|poi| poi.place).collect();
    let drawn = if regions.is_empty() { String::new() } else { format!(" Drawn in every episode: {drawn}.") };
    scene.description = format!(
        "A map of {} by {} units before any training. {}{}{couplings}, {within}.{who}{timed}{drawn}",
        map.x,
        map.y,
        places("Leaders", &starts),
        places("POIs", &pois),
    );
    scene
}

/// Returns who observes which groups of POIs, each as `rover observes near and pair`.
fn observers(classes: &Classes) -> Vec<String> {
    let mut groups_of: Vec<(String, Vec<&str>)> = vec![];
    for (group, PoiGroup { name, .. }) in classes.pois.iter().enumerate() {
        let observes =
            |(class, agents): (usize, &AgentClass)| classes.observes(class, group).then(|| agents.name.clone());
        let who = classes.agents.iter().enumerate().filter_map(observes).collect::<Vec<_>>().join(" or ");
        match groups_of.iter_mut().find(|(other, _)| *other == who) {
            Some((_, groups)) => groups.push(name),
            None => groups_of.push((who, vec![name.as_str()])),
        }
    }
    let named = |groups: Vec<&str>| match groups.len() {
        ..=6 => groups.join(" and "),
        count => format!("{} and {} more", groups[..5].join(", "), count - 5),
    };
    groups_of.into_iter().map(|(who, groups)| format!("{who} observes {}", named(groups))).collect()
}

/// Describes when POIs can be observed, for at most 12 of them.
fn pois_in_words(world: &World) -> String {
    let pois = world.pois.len();
    let time =
        |poi: usize| Some(time_label(world, poi)).filter(|time| !time.is_empty()).unwrap_or("at any time".into());
    let list: Vec<_> = (0..pois.min(12)).map(|poi| format!("{poi}: {}", time(poi))).collect();
    format!(" POIs can be observed: {}{}.", list.join("; "), if pois > 12 { "; …" } else { "" })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::map::{around, is_open, label_area, overlap, poi_label};
    use crate::report::replay::parts;

    #[test]
    fn pois_that_count_at_the_end_say_so() {
        let text = "[world]\nsteps = 7\n[[agents]]\nname = \"rover\"\nat = [[5, 5]]\nsenses = [{ of = \"pois\" }]\n\
            [[pois]]\nname = \"last\"\nat = [[9, 9]]\nwhen = \"end\"\n[[pois]]\nname = \"any\"\nat = [[30, 9]]\n";
        let config = flotilla::Config::parse(text, "end.toml").unwrap().validate().unwrap();
        let world = World::new(&config);
        let labels = [0, 1].map(|poi| poi_label(&world, poi, "1".into()));
        assert_eq!(labels, ["0: 1, step 7", "1: 1"]);
        assert!(pois_in_words(&world).contains("0: step 7; 1: at any time"), "{}", pois_in_words(&world));
        let open = [0, 1].map(|poi| [6, 7].map(|step| is_open(&world, poi, step, &[false; 2])));
        assert_eq!(open, [[false, true], [true, true]]);
    }

    #[test]
    fn classes_have_marks_of_their_own_and_pages_the_same() {
        for text in [
            include_str!("../../../../configs/rovers.toml"),
            include_str!("../../../../configs/herd.toml"),
            include_str!("../../../../configs/influence/4_rovers_4_uavs.toml"),
        ] {
            let config = flotilla::Config::parse(text, "classes.toml").unwrap().validate().unwrap();
            let world = World::new(&config);
            let outline = |class: usize| Form::of_agent(&world, world.classes[class].agents().start).outline();
            let learns = |class: usize| world.classes[class].agents().start < world.leaders();
            assert!(outline(0) != outline(1) || learns(0) != learns(1));
            let (_, classes) = parts(&config).into_iter().find(|(key, _)| *key == "classes").unwrap();
            let of_page: Vec<_> = classes.as_array().unwrap().iter().map(|class| class["outline"].clone()).collect();
            assert_eq!(of_page, [serde_json::json!(outline(0)), serde_json::json!(outline(1))]);
        }
    }

    #[test]
    fn labels_of_windows_and_couplings_avoid_agents() {
        for text in [
            include_str!("../../../../configs/tasks/decoy.toml"),
            include_str!("../../../../configs/tasks/merge.toml"),
            include_str!("../../../../configs/tasks/shuttle.toml"),
        ] {
            let config = flotilla::Config::parse(text, "task.toml").unwrap().validate().unwrap();
            let team = team(config.as_ref(), &World::new(&config));
            let view = Viewport::new(&config, [DVec2::ZERO, config.world.map.into()], 80.0);
            let arm = view.agent_size(&team);
            for (poi, (place, size)) in team.pois.iter().zip(view.poi_labels(&team).unwrap()) {
                let label = label_area(place, &poi.label, size);
                let crosses = |agent: &&Marker| overlap(label, around(view.at(agent.place), arm));
                assert!(!team.agents.iter().any(|agent| crosses(&agent)), "{}", poi.label);
            }
        }
    }
}
