//! The first experiment of a new user: a ring of POIs of one's own, trained, looked at and filmed.

#![cfg(feature = "cli")]

mod support;

use std::fs;

use support::Place;

/// Two groups between two POIs, trained for a moment; in some trials the champion observes more than in others.
const SMALL: &str = "\
[world]
map = [30, 30]
leaders = [[10, 8], [20, 8]]
followers = [[11, 6], [9, 6], [21, 6], [19, 6]]
pois = [[10, 20], [20, 20]]
coupling = 3
steps = 30
[learning]
population = 12
generations = 4
trials = 4
episodes_per_team = 2
start_jitter = 1.0
";

fn small() -> Place {
    let place = Place::new(&[("small.toml", SMALL)]).on_cpu();
    place.good("train small.toml --out run");
    place
}

/// A column of the run's metrics at a generation, by trial: `best_g` is 2, `champion_g` is 4.
fn metric(place: &Place, generation: usize, column: usize) -> Vec<f64> {
    let text = place.read("run/metrics.csv");
    let rows = text.lines().skip(1).map(|line| line.split(',').collect::<Vec<_>>());
    rows.filter(|row| row[1] == generation.to_string()).map(|row| row[column].parse().unwrap()).collect()
}

fn json(place: &Place, line: &str) -> serde_json::Value {
    serde_json::from_str(&place.good(line).0).unwrap()
}

#[test]
fn only_a_numbered_name_makes_a_film() {
    let place = small();
    for name in ["100%done.png", "50%.png", "%04done.png", "%5d.png", "%s.png"] {
        place.good(&["replay", "run", "--out", name]);
        assert!(place.path(name).exists(), "{name}");
    }
    assert_eq!(place.names().len(), 7, "{:?}", place.names());
    for (pattern, first, second) in [
        ("f%04d.png", "f0000.png", "f0001.png"),
        ("%d.png", "0.png", "1.png"),
        ("9%-%02d.png", "9%-00.png", "9%-01.png"),
    ] {
        place.good(&["replay", "run", "--out", pattern]);
        assert!(place.path(first).exists() && place.path(second).exists(), "{pattern}: {:?}", place.names());
    }
}

#[test]
fn champions_and_teams_replay_with_the_score_they_had() {
    let place = small();
    for generation in [0, 2, 4] {
        let [best, champion] = [2, 4].map(|column| metric(&place, generation, column));
        for trial in 0..4 {
            let line = format!("replay run --json --trial {trial} --generation {generation} -o r.svg --team ");
            let episode = |team: &str| json(&place, &(line.clone() + team))["episodes"][0].clone();
            let told = episode("champion");
            assert_eq!((&told["champion_g"], &told["which"]), (&champion[trial].into(), &"champion".into()));
            let told = episode("best");
            assert_eq!((&told["best_g"], &told["which"]), (&best[trial].into(), &"best".into()));
            let team = told["team"].as_u64().unwrap();
            assert_eq!(episode(&team.to_string())["g"], best[trial], "team {team}");
        }
    }
    // Without the folder of checkpoints everything is trained again, to the same.
    let line = "replay run --json --trial 1 --team champion -o r.svg";
    let kept = json(&place, line);
    fs::remove_dir_all(place.path("run/checkpoints")).unwrap();
    assert_eq!(json(&place, line), kept);
}

#[test]
fn the_best_and_the_worst_trial_are_found() {
    let place = small();
    for (team, column) in [("champion", 4), ("best", 2)] {
        for generation in [0, 4] {
            let g = metric(&place, generation, column);
            for (which, extreme) in [("best", f64::max as fn(f64, f64) -> f64), ("worst", f64::min)] {
                let line =
                    format!("replay run --json --trial {which} --team {team} --generation {generation} -o r.svg");
                let wanted = g.iter().copied().reduce(extreme).unwrap();
                let first = g.iter().position(|&g| g == wanted).unwrap();
                assert_eq!(json(&place, &line)["episodes"][0]["trial"], first, "{line}: {g:?}");
            }
        }
    }
    let [champions, best] = [4, 2].map(|column| metric(&place, 4, column));
    assert!(champions.iter().any(|&g| g != champions[0]) && champions != best, "{champions:?}: nothing to tell apart");
    let told = place.refused(2, "replay run --trial first");
    assert!(told.contains("allowed best, worst or a whole number, from 0"), "{told}");
    let told = place.refused(2, "replay run --team 12");
    assert!(told.contains("no team 12: a generation has 12 teams, 0 to 11"), "{told}");
}

/// Whether a picture shows this text.
fn labelled(svg: &str, text: &str) -> bool {
    svg.contains(&format!("aria-label=\"{text}\""))
}

#[test]
fn pictures_say_which_team_they_show() {
    let place = small();
    let picture = |flags: &str| {
        let (told, _) = place.good(&format!("replay run -o r.svg {flags}"));
        (told, place.read("r.svg"))
    };
    let (told, svg) = picture("--trial 2 --team champion --generation 3");
    assert!(told.starts_with("Champion of trial 2, generation 3: observed "), "{told}");
    assert!(labelled(&svg, "Champion") && labelled(&svg, "trial 2, generation 3"), "{svg}");
    let (told, svg) = picture("--trial 1 --team 5");
    assert!(told.starts_with("Team number 5 of trial 1, generation 4: observed "), "{told}");
    assert!(labelled(&svg, "Team number 5") && labelled(&svg, "trial 1, generation 4"));
    // Axes, the number that is needed, and when a POI was observed.
    assert!(labelled(&svg, "x, map units") && labelled(&svg, "y, map units"));
    let (_, svg) = picture("--trial best --team champion");
    assert!(svg.contains("2/3: 2 agents near of 3 needed") && svg.contains("aria-label=\"at step "), "{svg}");
    place.write("one.toml", SMALL.replace("coupling = 3", "coupling = 1"));
    place.good("train one.toml --out one");
    place.good("replay one -o one.svg");
    assert!(place.read("one.svg").contains("1/1: 1 agent near of 1 needed"));
    place.good("replay run --trial 1 --team champion");
    assert!(place.read("run/replay.html").contains("\"name\":\"Champion\""));
}

#[test]
fn a_film_format_names_the_commands_that_make_it() {
    let place = small();
    let told = place.refused(2, "replay run --trial 1 --team champion --out champ.mp4 --fps 10");
    assert!(!place.path("champ.mp4").exists());
    let commands: Vec<&str> = told.lines().filter_map(|line| line.strip_prefix("  ")).collect();
    let [pictures, film] = commands[..] else { panic!("{told}") };
    assert!(film.starts_with("ffmpeg -framerate 10 -i champ-%04d.png ") && film.ends_with(" champ.mp4"), "{film}");
    assert!(place.shell(pictures).status.success(), "{pictures}");
    assert!(place.path("champ-0000.png").exists(), "{pictures}: {:?}", place.names());
    for out in ["-o champ.mp4", "--out=champ.mp4", "-ochamp.mp4"] {
        let told = place.refused(2, &format!("replay run {out}"));
        assert!(told.contains("champ-%04d.png --backend cpu\n"), "{told}");
    }
}

#[test]
fn quiet_prints_the_summary_only_if_asked() {
    let place = small();
    for line in ["train small.toml --out again --quiet", "replay run --quiet"] {
        assert_eq!(place.good(line), (String::new(), String::new()), "{line}");
    }
    assert_eq!(json(&place, "train small.toml --out third --quiet --json")["pois"], 2);
}

#[test]
fn the_folder_of_a_sweep_lists_its_points() {
    let place = Place::new(&[("s.toml", &format!("{SMALL}[grid]\n\"world.coupling\" = [2, 3]\n"))]).on_cpu();
    place.good("sweep s.toml --out s");
    let told = place.refused(1, "replay s");
    assert!(told.contains("s holds a sweep; name one of its points:\n"), "{told}");
    assert!(
        told.contains("s/points/0000  world.coupling = 2\n") && told.contains("s/points/0001  world.coupling = 3\n"),
        "{told}"
    );
}
