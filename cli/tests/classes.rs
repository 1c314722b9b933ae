//! Tests that every config of the repository can be written in full, and that `flotilla check --expand` does.

use std::path::{Path, PathBuf};

use flotilla::config::{Config, GRID, VARY};
use flotilla_app::sweep::Sweep;

use crate::support::{Place, root};

/// Returns every config and sweep file of the repository.
fn files() -> Vec<PathBuf> {
    fn add(folder: &Path, files: &mut Vec<PathBuf>) {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                add(&path, files);
            } else if path.extension().is_some_and(|extension| extension == "toml") {
                files.push(path);
            }
        }
    }
    let mut files = Vec::new();
    ["configs", "studies/configs"].iter().for_each(|folder| add(Path::new(&root(folder)), &mut files));
    files.sort();
    files
}

#[test]
fn every_config_can_be_written_in_full() {
    let (mut configs, mut sweeps) = (0, 0);
    for path in files() {
        let text = std::fs::read_to_string(&path).unwrap();
        let table: toml::Table = text.parse().unwrap();
        let config = if table.contains_key(GRID) || table.contains_key(VARY) {
            sweeps += 1;
            assert!(text.starts_with("# "), "{} does not begin with a comment", path.display());
            (*Sweep::load(&path, &[], false).unwrap_or_else(|error| panic!("{error}")).points[0].config).clone()
        } else {
            configs += 1;
            Config::load(&path).unwrap()
        };
        let name = path.display();
        let full =
            Config::parse(&config.expanded().to_toml(), "full.toml").unwrap_or_else(|error| panic!("{name}: {error}"));
        assert_eq!(full, config.expanded(), "{name}");
        assert_eq!(full.classes(), config.classes(), "{name}");
        assert_eq!(full.population_of_each(), config.population_of_each(), "{name}");
        let has_both = !full.agents.is_empty() && !full.pois.is_empty();
        assert!(has_both || !config.stages.is_empty(), "{name}");
    }
    assert!(configs > 5 && sweeps > 20, "{configs} configs, {sweeps} sweeps");
}

#[test]
fn check_prints_a_config_in_full_and_nothing_else() {
    let chaotic = std::fs::read_to_string(root("configs/chaotic.toml")).unwrap();
    let keys = "paradigm = \"all-leaders\"\nsharing = \"group\" ";
    let grouped = chaotic.replace("paradigm = \"leader-follower\"", keys);
    let place = Place::new(&[("chaotic.toml", &chaotic), ("grouped.toml", &grouped)]);
    for name in ["chaotic.toml", "grouped.toml"] {
        let short = Config::load(&place.path(name)).unwrap();
        let (full, _) = place.good(&format!("check --expand {name}"));
        assert_eq!(full, short.expanded().to_toml());
        assert_eq!(Config::parse(&full, "full.toml").unwrap().classes(), short.classes());
        // In full already, it is printed as it is.
        place.write("full.toml", &full);
        assert_eq!(place.good("check --expand full.toml").0, full);
    }
    assert!(place.read("full.toml").contains("groups = [[0, 4, 5, 6, 7], [1, "));
    let seeded = place.good("check --expand chaotic.toml --seed 7").0;
    assert!(seeded.contains("seed = 7\n"));
    let refused = place.refused(2, "check full.toml --set world.coupling=2");
    assert!(refused.contains("--set world.coupling: a config with [[pois]] has no such key"), "{refused}");
    let staged = format!("{chaotic}[[stages]]\nfrom = 3\nset = {{ \"world.coupling\" = 3 }}\n");
    place.write("staged.toml", staged);
    let (full, noted) = place.good("check --expand staged.toml");
    assert!(full.contains("[[agents]]") && !full.contains("[[pois]]"), "{full}");
    assert!(noted.contains("[[pois]] is not written, because a stage sets a key that it would replace"), "{noted}");
}

/// Two classes that learn, one with a rule, and POIs that differ in radius and value.
const HERD: &str = r#"
world = { map = [40, 40], steps = 20 }
learning = { population = 6, generations = 2, trials = 2, seed = 3 }

[[agents]]
name = "rover"
at = [[10, 10], [14, 10]]
senses = [{ of = "pois" }, { of = "sheep" }]
leads = "sheep"

[[agents]]
name = "drone"
at = [[30, 12]]
motion = { kind = "free" }
senses = [{ of = "pois", sectors = 3 }]

[[agents]]
name = "sheep"
at = [[12, 13], [15, 13]]
control = "follow"
rule = [{ of = "rover", to = 6, gain = 2 }]
observes = false

[[pois]]
name = "near"
at = [[12, 18], [30, 20]]
value = 2
coupling = [2, 1]
radius = 5

[[pois]]
name = "far"
at = [[22, 19]]
value = 0.5
coupling = 1
radius = 3
"#;

#[test]
fn a_stage_that_weighs_pois_is_told() {
    let alike = HERD.replace("value = 2\n", "").replace("value = 0.5\n", "");
    let stage = "[[stages]]\nfrom = 1\nset = { pois.far.value = 7.5 }\n";
    let place = Place::new(&[("herd.toml", &(alike + stage))]);
    place.prints("train herd.toml --out run", &["weighted by value"]);
    assert!(place.read("run/curves.svg").contains("G (weighted share of POIs)"));
}

/// The leader starts at the POI and has to leave it at once.
#[test]
fn replays_show_what_is_observed_at_the_start() {
    let text =
        "world = { steps = 5, dt = 1.0, start_counts = true, leaders = [[10, 10]], pois = [[10, 10]], coupling = 1,
observation_radius = 0.5, speed = 3 }
motion = { min_speed = 3, max_speed = 3 }
learning = { population = 4, generations = 1, trials = 1 }
";
    let place = Place::new(&[("start.toml", text)]).on_cpu();
    place.good("train start.toml --out run --quiet");
    place.prints("replay run --out start.svg", &["1 of 1"]);
    let picture = place.read("start.svg");
    assert!(picture.contains("1 of 1 POIs observed") && picture.contains("at step 0"), "{picture}");
    place.good("replay run --out start.html");
    assert!(place.read("start.html").contains("\"observed\":[0]"));
}

/// One scout chooses among four posts, and only the second sees the POI. A walker beside it needs fewer outputs.
#[test]
fn baselines_choose_agents() {
    let choosers = "world = { steps = 30, dt = 0.5 }
learning = { population = 10, generations = 1, trials = 1 }
[[agents]]
name = 'scout'
at = [[25, 10]]
control = 'choose:post'
motion = { kind = 'free', max_speed = 2 }
senses = [{ of = 'pois' }]
[[agents]]
name = 'post'
at = [[25, 30], [10, 10], [40, 10], [45, 45]]
control = 'still'
observes = false
[[pois]]
name = 'p'
at = [[10, 10]]
coupling = 1
radius = 2
";
    let walker = "[[agents]]
name = 'walker'
at = [[45, 30]]
motion = { kind = 'steered', max_speed = 2 }
senses = [{ of = 'pois' }]
";
    let place = Place::new(&[
        ("choose.toml", choosers),
        ("free.toml", &choosers.replace("control = 'choose:post'\n", "")),
        ("both.toml", &choosers.replacen("[[agents]]", &format!("{walker}[[agents]]"), 1)),
    ]);
    let pois = |constants: &serde_json::Value| -> Vec<_> {
        constants.as_array().unwrap().iter().map(|constant| constant["pois"].as_f64().unwrap()).collect()
    };
    let alone = place.json("baseline choose.toml --seeds 1 --json --backend cpu");
    let constants = &alone["constants"];
    assert_eq!(pois(constants), [0.0, 1.0, 0.0, 0.0, 0.0]);
    assert!(constants[4]["choice"] == 4 && constants[4]["speed"].is_null(), "{constants}");
    assert_eq!(alone["chosen"], serde_json::json!([1]));
    place.prints("baseline choose.toml --seeds 1", &["A team with the constant choice 1 observes every POI."]);
    let both = place.json("baseline both.toml --seeds 1 --json --backend cpu");
    let constants = &both["constants"];
    assert_eq!((pois(constants).len(), &pois(constants)[..7]), (20, &[0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0][..]));
    assert!(constants[19]["speed"] == 1.0 && constants[6]["choice"] == 6, "{constants}");
    // An agent that moves freely has no heading: its constant actions are velocities along y.
    let (text, _) = place.good("baseline free.toml --seeds 1 --set pois.p.at=[[25,18.5]]");
    assert!(text.contains("straight ahead, or along y with free motion"), "{text}");
    assert!(text.contains("A team whose actions are always 0 and 0.3 to 1.0 observes every POI."), "{text}");
    // A policy may have fewer weights than there are behaviours.
    let set = "--set policy.hidden=[] --set policy.actions=behaviours --set agents.post.at=[[10,10]] \
               --set agents.scout.senses=[{of='pois',sectors=1}]";
    let found = place.json(&format!("baseline choose.toml --seeds 1 --json --backend cpu {set}"));
    assert_eq!(found["constant"]["mean"].as_f64(), Some(1.0));
}

#[test]
fn g_weighs_pois_by_value_in_metrics_replays_and_rollouts() {
    let place = Place::new(&[("herd.toml", HERD)]);
    let (report, _) = place.good("train herd.toml --out run");
    // What is not a count of POIs says so.
    assert!(report.contains("POIs observed, of 3, weighted by value: mean over trials"), "{report}");
    assert!(place.read("run/curves.svg").contains("G (weighted share of POIs)"));
    assert!(report.contains(" of 3 POIs, weighted by value.\n"), "{report}");
    let (text, _) = place.good("baseline herd.toml --seeds 1 --episodes 2");
    assert!(text.starts_with("2 × rover, 1 × drone, 1 seed. "), "{text}");
    assert!(text.contains("| POIs observed, of 3, weighted by value "), "{text}");
    let metrics = place.read("run/metrics.csv");
    let g = |row: &str| row.split(',').nth(2).unwrap().parse::<f64>().unwrap();
    let best: Vec<f64> = metrics.lines().skip(1).map(g).collect();
    // POIs are worth 4, 4 and 1 of 9.
    assert!(
        best.iter().all(|g| [0, 1, 4, 5, 8, 9].iter().any(|worth| (g * 9.0 - f64::from(*worth)).abs() < 1e-9)),
        "{metrics}"
    );
    assert!(best.iter().any(|g| *g > 4.0 / 9.0), "{metrics}");
    // A replay is compared with the metrics.
    for generation in 0..=2 {
        place.good(&format!("replay run --team best --generation {generation} --out best.svg"));
    }
    let (text, _) = place.good("rollout run --scores scores.csv");
    let most = place.read("scores.csv").lines().skip(1).map(g).fold(0.0, f64::max);
    assert!(text.contains(", POIs observed of 3, weighted by value: team 0 "), "{text}");
    assert!(most > 0.0 && text.contains(&format!("best {:.2} ", most * 3.0)), "{most}: {text}");
}

/// A team that passes a POI, and cannot stop.
const PASSING: &str = r#"
[world]
steps = 60

[[agents]]
name = "boat"
at = [[10, 5]]
motion = { min_speed = 3, max_speed = 3, max_turn_rate = 0 }
speed = 3
senses = [{ of = "pois" }]

[[pois]]
name = "buoy"
at = [[10, 15]]
coupling = 1
radius = 3
when = "end"

[learning]
population = 4
generations = 1
trials = 1
"#;

#[test]
fn a_poi_that_counts_at_the_end_is_observed_only_then() {
    let ever = PASSING.replace("when = \"end\"", "when = \"ever\"");
    let place = Place::new(&[("end.toml", PASSING), ("ever.toml", &ever)]);
    for (when, observed) in [("end", 0), ("ever", 1)] {
        let (_, warned) = place.good(&format!("train {when}.toml --out {when}"));
        assert_eq!(warned.contains("only the last step counts"), observed == 0, "{warned}");
        let (text, _) = place.good(&format!("replay {when} --out {when}.svg"));
        assert!(text.contains(&format!("observed {observed} of 1 POIs, as in metrics.csv")), "{text}");
        let picture = place.read(format!("{when}.svg"));
        assert!(picture.contains(&format!("POIs observed: {observed} of 1")), "{picture}");
    }
}

#[test]
fn a_closeness_that_rounds_to_0_is_not_called_unobserved() {
    let places: Vec<[f64; 2]> = (40..48).map(|x| [f64::from(x), 50.0]).collect();
    let text = format!(
        "[world]\nmap = [100, 100]\nsteps = 3\n[[agents]]\nname = \"a\"\nat = {places:?}\n\
         motion = {{ kind = \"free\", max_speed = 0 }}\nsenses = [{{ of = \"pois\" }}]\n[[pois]]\nname = \"p\"\nat = [[90, 50]]\n\
         coupling = 8\nradius = 60\nscore = \"closeness\"\n[learning]\npopulation = 4\ngenerations = 1\ntrials = 1\n"
    );
    let place = Place::new(&[("far.toml", &text)]);
    let stderr = place.notes("train far.toml --out far", &["warning: no team scored in any generation"]);
    assert!(!stderr.contains("no team observed any POI"), "{stderr}");
}

#[test]
fn pictures_and_pages_show_classes_radii_and_values() {
    let place = Place::new(&[("herd.toml", HERD)]);
    let drawn = "the layout is drawn in layout.svg";
    let (_, message) = place.good("check herd.toml --out layout.svg");
    assert!(message.ends_with(&format!("{drawn}\n")), "{message}");
    let (_, message) = place.good("check herd.toml --out layout.svg");
    assert!(message.ends_with(&format!("{drawn}, in place of the file that was there\n")), "{message}");
    let layout = place.read("layout.svg");
    let labels = [
        "2 × rover, 1 × drone, 2 × sheep, 3 POIs",
        "rover 0 to 1",
        "drone 2",
        "sheep",
        "2, value 2",
        "1, value 2",
        "1, value 0.5",
    ];
    for text in labels.into_iter().chain(["at a POI: agents it needs within its circle, and its value"]) {
        assert!(layout.contains(&format!("aria-label=\"{text}\"")), "{text}");
    }
    assert!(layout.contains(" rover or drone observes near and far."), "sheep do not observe");
    // One drone is on the map, and one in the legend.
    let discs = layout.lines().filter(|line| line.starts_with("<polygon") && line.matches(',').count() == 24);
    assert_eq!(discs.count(), 2, "what moves freely is a disc of 24 corners");
    // 80 mm show 40 units, and an SVG has 10 units per millimetre.
    for radius in [5, 3] {
        assert!(layout.contains(&format!("r=\"{}\" fill=\"#", radius * 20)), "a circle of {radius} units");
    }
    place.good("train herd.toml --out run");
    place.good("replay run --out page.html");
    let page = place.read("page.html");
    assert!(page.contains("\"classes\":[{\"count\":2,\"free\":false,\"influence\":"));
    assert!(page.contains("\"name\":\"rover\",\"outline\":[[1.0,0.0],"));
    assert!(page.contains("\"radii\":[5.0,5.0,3.0]") && page.contains("\"values\":[2.0,2.0,0.5]"));
}

#[test]
fn a_credit_that_is_always_0_is_noted() {
    let herd = std::fs::read_to_string(root("configs/herd.toml")).unwrap();
    let short = "world.leaders = [[5, 5]]\nworld.followers = [[4, 4]]\nworld.pois = [[9, 9]]\nworld.coupling = 1\n";
    let followers = format!("{short}world.observers = \"followers\"\n");
    let place = Place::new(&[("herd.toml", &herd), ("short.toml", short), ("followers.toml", &followers)]);
    let notes = |line: &str| place.good(line).1;
    let is_0 = |who: &str| {
        format!("note: {who} is always 0, because none counts at a POI: selection is random; use G, Df or Dt")
    };
    assert!(notes("check herd.toml --fitness D").contains(&is_0("D of every dog")));
    assert!(
        notes("train herd.toml --fitness D++ --generations 1 --trials 1 --population 4")
            .contains(&is_0("D++ of every dog"))
    );
    assert!(notes("check followers.toml --fitness D").contains(&is_0("D of every leader")));
    for line in [
        "check herd.toml --fitness Df",
        "check herd.toml --fitness D --set credit.add_g=true",
        "check followers.toml --fitness D --set credit.removes=[[1]]",
        "check short.toml --fitness D",
        "check followers.toml --fitness Dt",
    ] {
        assert!(!notes(line).contains("is always 0"), "{line}");
    }
    assert!(!notes("check herd.toml --fitness Df").contains("equals D"));
    let own = herd.replace("leads = \"sheep\"", "leads = \"sheep\"\nfitness = \"G\"");
    place.write("unused.toml", own.replace("[learning]\nfitness = \"G\"", "[learning]\nfitness = \"D\""));
    place.write("grid.toml", format!("{own}[grid]\n\"learning.fitness\" = [\"D\", \"Df\"]\n"));
    place.write("own.toml", own);
    let unused = "learning.fitness = \"D\" has no effect: every class that learns has its own";
    assert!(notes("check unused.toml").contains(unused));
    for line in ["check own.toml", "check herd.toml --fitness G"] {
        assert!(!notes(line).contains("has no effect"), "{line}");
    }
    // Also the default, and what classes have, would train the same again.
    let refused = "no effect, because every class that learns has its own";
    for line in ["check own.toml --fitness D", "check own.toml --fitness Df", "train own.toml --fitness G"] {
        place.fails(2, line, &[refused]);
    }
    place.fails(1, "sweep grid.toml", &[refused]);
}

#[test]
fn fitness_by_led_agents_that_nobody_leads_is_noted() {
    let herd = std::fs::read_to_string(root("configs/herd.toml")).unwrap();
    let alone = herd.replace("leads = \"sheep\"", "");
    assert_ne!(herd, alone);
    let counting = alone.replace("observes = false", "");
    let place = Place::new(&[("alone.toml", &alone), ("counting.toml", &counting)]);
    let always_0 = "always 0, because none counts at a POI: selection is random; use G, or Df with `leads`";
    for fitness in ["D", "Df", "Dt"] {
        let (_, notes) = place.good(&format!("check alone.toml --fitness {fitness}"));
        assert!(notes.contains(&format!("note: {fitness} of every dog is {always_0}")), "{notes}");
    }
    let close = herd.replacen("coupling = [2, 4, 6]", "coupling = [2, 300, 6]\nscore = \"closeness\"", 1);
    let sheep = close.find("at = [[23.0").unwrap();
    let end = sheep + close[sheep..].find('\n').unwrap();
    let close = [&close[..sheep], "count = 400\nin = { disc = [25, 20, 5] }", &close[end..]].concat();
    place.write("close.toml", close.replace("after = \"gate\"", ""));
    let cubic = "D++ by closeness takes a time that grows with the cube of the coupling, which is 300 here";
    place.notes("check close.toml --fitness D++", &[cubic]);
    assert!(!place.good("check close.toml --fitness D").1.contains(cubic));
    // Dt takes out the sheep that another class leads, if anyone may lead them.
    let bird = "[[agents]]\nname = \"bird\"\nat = [[1, 1]]\nsenses = [{ of = \"sheep\" }]\nleads = \"sheep\"\nobserves = false\n[[agents]]";
    place.write("bird.toml", alone.replacen("[[agents]]", bird, 1));
    for (led_by, is_0) in [("anyone", false), ("most-seen", true)] {
        let (_, notes) = place.good(&format!("check bird.toml --fitness Dt --set credit.led_by=\"{led_by}\""));
        assert_eq!(notes.contains("Dt of every dog is always 0"), is_0, "{led_by}: {notes}");
    }
    let rock =
        "[[agents]]\nname = \"rock\"\nat = [[1, 1], [2, 1], [3, 1], [4, 1], [5, 1], [6, 1]]\ncontrol = \"still\"\n";
    place.write(
        "rocks.toml",
        herd.replace("[[pois]]", "[[pois]]\nobservers = \"rock\"").replacen("[[pois]]", &format!("{rock}[[pois]]"), 1),
    );
    place.notes("check rocks.toml --fitness Df", &[&format!("note: Df of every dog is {always_0}")]);
    place.notes("check counting.toml --fitness Df", &["note: Df equals D here, because no class has `leads`"]);
    // Runs that differ in nothing but the name of their fitness.
    for fitness in ["D", "Df"] {
        let run = "--generations 1 --trials 2 --population 4";
        place.good(&format!("train counting.toml --fitness {fitness} {run} --out {fitness}"));
    }
    place.notes("compare D Df", &["note: Df has the digest of D: their settings differ, and their results do not"]);
}
