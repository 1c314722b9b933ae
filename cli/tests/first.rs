//! Tests the commands of a new user's first experiment: a new layout is trained, replayed and filmed.

use std::fs;

use flotilla::backend::cpu::Cpu;
use flotilla_app::record::digests::Verification;
use flotilla_app::record::runs;
use flotilla_app::report::replay::{self, Film, Frames, Which};

use crate::support::Place;

/// Two groups between two POIs, with a short training. In some trials the champion observes more than in others.
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

/// Reads one column of the run's metrics at a generation, by trial. Column 2 is `best_g`, and 4 is `champion_g`.
fn metric(place: &Place, generation: usize, column: usize) -> Vec<f64> {
    let text = place.read("run/metrics.csv");
    let rows = text.lines().skip(1).map(|line| line.split(',').collect::<Vec<_>>());
    rows.filter(|row| row[1] == generation.to_string()).map(|row| row[column].parse().unwrap()).collect()
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
        place.good(&["replay", "run", "--width", "100", "--fps", "2", "--out", pattern]);
        assert!(place.path(first).exists() && place.path(second).exists(), "{pattern}: {:?}", place.names());
    }
}

#[test]
fn replays_have_the_scores_in_the_metrics() {
    let place = small();
    for generation in [0, 2, 4] {
        let [best, champion] = [2, 4].map(|column| metric(&place, generation, column));
        for trial in 0..4 {
            let line = format!("replay run --json --trial {trial} --generation {generation} -o r.svg --team ");
            let episode = |team: &str| place.json(&(line.clone() + team))["episodes"][0].clone();
            let replay = episode("champion");
            assert_eq!((&replay["champion_g"], &replay["which"]), (&champion[trial].into(), &"champion".into()));
            let replay = episode("best");
            assert_eq!((&replay["best_g"], &replay["which"]), (&best[trial].into(), &"best".into()));
            let team = replay["team"].as_u64().unwrap();
            assert_eq!(episode(&team.to_string())["g"], best[trial], "team {team}");
        }
    }
    // Without checkpoints, training is repeated, with the same result.
    let line = "replay run --json --trial 1 --team champion -o r.svg";
    let from_checkpoints = place.json(line);
    fs::remove_dir_all(place.path("run/checkpoints")).unwrap();
    assert_eq!(place.json(line), from_checkpoints);
}

#[test]
fn replay_finds_the_best_and_worst_trial() {
    let place = small();
    for (team, column) in [("champion", 4), ("best", 2)] {
        for generation in [0, 4] {
            let g = metric(&place, generation, column);
            for (choice, extreme) in [("best", f64::max as fn(f64, f64) -> f64), ("worst", f64::min)] {
                let line =
                    format!("replay run --json --trial {choice} --team {team} --generation {generation} -o r.svg");
                let expected_g = g.iter().copied().reduce(extreme).unwrap();
                let first = g.iter().position(|&g| g == expected_g).unwrap();
                assert_eq!(place.json(&line)["episodes"][0]["trial"], first, "{line}: {g:?}");
            }
        }
    }
    let [champions, best] = [4, 2].map(|column| metric(&place, 4, column));
    assert!(champions.iter().any(|&g| g != champions[0]) && champions != best, "{champions:?}: all trials are equal");
    place.fails(2, "replay run --trial first", &["allowed best, worst or a whole number, from 0"]);
    place.fails(2, "replay run --team 12", &["no team 12: a generation has 12 teams, 0 to 11"]);
}

/// Whether a picture contains this label.
fn has_label(svg: &str, text: &str) -> bool {
    svg.contains(&format!("aria-label=\"{text}\""))
}

#[test]
fn pictures_are_labelled_with_the_team_they_show() {
    let place = small();
    let picture = |flags: &str| {
        let (stdout, _) = place.good(&format!("replay run -o r.svg {flags}"));
        (stdout, place.read("r.svg"))
    };
    let (stdout, svg) = picture("--trial 2 --team champion --generation 3");
    let observed = format!(
        "observed {:.2} of 2 POIs (mean of 2 episodes, of which the first is shown), as in metrics",
        2.0 * metric(&place, 3, 4)[2]
    );
    assert!(stdout.starts_with(&format!("Champion of trial 2, generation 3: {observed}")), "{stdout}");
    assert!(has_label(&svg, "Champion") && has_label(&svg, "trial 2, generation 3, first of 2 episodes"), "{svg}");
    let (stdout, svg) = picture("--trial 1 --team 5");
    assert!(stdout.starts_with("Team number 5 of trial 1, generation 4: observed "), "{stdout}");
    assert!(has_label(&svg, "Team number 5") && has_label(&svg, "trial 1, generation 4, first of 2 episodes"));
    // Axis labels, the number of agents needed, and the step at which a POI was observed.
    assert!(has_label(&svg, "x, map units") && has_label(&svg, "y, map units"));
    let (_, svg) = picture("--trial best --team champion");
    assert!(svg.contains("2/3: 2 agents near of 3 needed") && svg.contains("aria-label=\"at step "), "{svg}");
    place.write("one.toml", SMALL.replace("coupling = 3", "coupling = 1"));
    place.good("train one.toml --out one");
    place.good("replay one -o one.svg");
    assert!(place.read("one.svg").contains("0/1: 0 agents near of 1 needed"));
    // POIs that are observed have no number of agents to explain.
    let near = SMALL.replace("coupling = 3", "coupling = 1").replace("[[10, 20], [20, 20]]", "[[10, 9], [20, 9]]");
    place.write("near.toml", near);
    place.good("train near.toml --out near");
    place.good("replay near -o near.svg");
    let svg = place.read("near.svg");
    assert!(has_label(&svg, "observed POI, with its step") && !has_label(&svg, "POI"), "{svg}");
    assert!(!svg.contains("needed"), "{svg}");
    // A film begins before they are observed.
    let (run, mut cpu) = (place.path("near"), Cpu::default());
    let config = runs::config(&run, Verification::Required).unwrap();
    let played =
        replay::replay(&run, 0, &[4], Which::Champion, Verification::Required, &mut cpu, &mut |_| true).unwrap();
    let svg = Frames::new(&config, &played, Film { width: None, fps: 20 }).scene(0.0).0.svg();
    assert!(has_label(&svg, "POI") && svg.contains("needed"), "{svg}");
    place.good("replay run --trial 1 --team champion");
    assert!(place.read("run/replay.html").contains("\"name\":\"Champion\""));
}

#[test]
fn film_formats_print_commands_that_make_them() {
    let place = small();
    let stderr = place.refused(2, "replay run --trial 1 --team champion --out champ.mp4 --fps 10");
    assert!(!place.path("champ.mp4").exists());
    let commands: Vec<&str> = stderr.lines().filter_map(|line| line.strip_prefix("  ")).collect();
    let [pictures, film] = commands[..] else { panic!("{stderr}") };
    assert!(film.starts_with("ffmpeg -framerate 10 -i champ-%04d.png ") && film.ends_with(" champ.mp4"), "{film}");
    place.script(0, pictures, &[]);
    assert!(place.path("champ-0000.png").exists(), "{pictures}: {:?}", place.names());
    for out in ["-o champ.mp4", "--out=champ.mp4", "-ochamp.mp4"] {
        place.fails(2, &format!("replay run {out}"), &["champ-%04d.png --backend cpu\n"]);
    }
}

#[test]
fn quiet_prints_the_summary_only_if_asked() {
    let place = small();
    for line in ["train small.toml --out again --quiet", "replay run --quiet"] {
        assert_eq!(place.good(line), (String::new(), String::new()), "{line}");
    }
    let trained = place.json("train small.toml --out third --quiet --json");
    assert_eq!((&trained["pois"], trained["poi_value"].as_f64()), (&2.into(), Some(2.0)));
}

/// POIs too far away for 25 steps, so that none is ever observed.
const FAR: &str = "\
[world]
map = [60, 60]
leaders = [[30, 30], [33, 30]]
followers = [[31, 28]]
pois = [[3, 30], [57, 30]]
coupling = 3
[learning]
population = 4
generations = 2
trials = 2
";

#[test]
fn unreachable_pois_print_warnings_before_and_after_training() {
    let place = Place::new(&[("far.toml", FAR), ("near.toml", SMALL)]);
    let warning = "warning: POI 0 cannot be reached by the 3 agents that it needs: at best the last of them is \
                  30.0 units away, and an agent travels at most 14.4 units in 25 steps";
    let (text, stderr) = place.good("check far.toml");
    assert!(stderr.contains(warning) && stderr.contains("set world.steps to at least 4"), "{stderr}");
    assert!(text.contains("#   distance per episode    at most 14.4 units per agent\n"), "{text}");
    let cost = place.json("check near.toml --json")["cost"].clone();
    assert!((17.4..17.5).contains(&cost["travel"].as_f64().unwrap()), "{cost}");
    assert_eq!(place.good("check near.toml").1, "");
    for line in ["train far.toml --out far --backend cpu --quiet", "train far.toml --out again --backend cpu --seed 3"]
    {
        let (_, stderr) = place.good(line);
        assert!(stderr.contains(warning), "{stderr}");
        assert!(stderr.contains("warning: no team observed any POI in any generation"), "{stderr}");
        assert!(stderr.contains("world.steps") && stderr.contains("a smaller coupling"), "{stderr}");
    }
    place.notes("compare far again", &["no team of these runs scored in any generation"]);
    let (_, stderr) = place.good("train near.toml --out near --backend cpu");
    assert!(!stderr.contains("warning"), "{stderr}");
    assert!(!place.good("compare near far").1.contains("no team of these runs"));
    let text = FAR.to_string() + "[grid]\n'world.steps' = [20, 60]\n";
    place.write("grid.toml", text);
    place.notes(
        "sweep grid.toml --out grid --backend cpu --quiet",
        &["units in 20 steps", "; at 1 of 2 points, the first world.steps = 20"],
    );
}

/// Plays random teams. The bound for reachability must not exclude a POI that any of them observes.
#[test]
fn observed_pois_are_never_reported_as_unreachable() {
    use flotilla::{evaluate::Starts, reach, sample, world::World};
    let (mut unreachable_count, mut observed_count) = (0, 0);
    for seed in 0..150 {
        let mut config = sample::world(seed);
        config.stages.clear();
        // Short episodes, so that some POIs are unreachable.
        config.world.steps = 4 + (seed as usize % 5) * 4;
        config.world.windows.clear();
        let (world, teams) = (World::new(&config.validate().unwrap()), 12);
        let weights = sample::weights(&world, teams, seed);
        let unreachable: Vec<usize> =
            reach::unreachable(config.validate().unwrap().as_ref()).iter().map(|entry| entry.poi).collect();
        let traced = flotilla::trace(&config, teams, &weights, &Starts::Own, 0).unwrap();
        let pois = world.pois.len();
        for team in 0..teams {
            let mut observed = vec![u32::MAX; pois];
            world.rule.observe(config.world.steps as u32, &mut observed, |poi, mut open| {
                open.find(|&step| {
                    let place = world.pois[poi].as_dvec2();
                    let near = (0..world.agents()).filter(|&agent| {
                        let offset = ((team * (config.world.steps + 1) + step as usize) * world.agents() + agent) * 2;
                        let [x, y] = [traced.positions[offset], traced.positions[offset + 1]].map(f64::from);
                        world.rule.counts(agent) && (place.x - x).hypot(place.y - y) <= config.world.observation_radius
                    });
                    near.count() >= world.coupling[poi] as usize
                })
            });
            for poi in (0..pois).filter(|&poi| observed[poi] != u32::MAX) {
                assert!(
                    !unreachable.contains(&poi),
                    "seed {seed}: team {team} observes POI {poi}, reported as unreachable"
                );
                observed_count += 1;
            }
        }
        unreachable_count += unreachable.len();
    }
    assert!(
        unreachable_count > 50 && observed_count > 500,
        "{unreachable_count} unreachable, {observed_count} observed"
    );
}

#[test]
fn commands_in_the_summary_work_for_the_best_champion() {
    let place = Place::new(&[("small.toml", SMALL)]);
    let (text, _) = place.good("train small.toml --out run --backend cpu");
    let champions = metric(&place, 4, 4);
    let best_g = champions.iter().copied().fold(0.0, f64::max);
    let best = champions.iter().position(|&g| g == best_g).unwrap();
    assert!(
        text.contains(&format!("The best champion is that of trial {best}: {:.2} of 2 POIs.\n", 2.0 * best_g)),
        "{text}"
    );
    let film = text.lines().find(|line| line.contains("champion.gif")).unwrap().trim();
    place.script(0, film, &[]);
    assert!(place.path("run/champion.gif").exists(), "{film}");
    let scores = text.lines().find(|line| line.contains("flotilla rollout")).unwrap().trim();
    place.script(0, scores, &[]);
}

#[test]
fn rollout_accepts_a_run_directory() {
    let place = small();
    let from_directory = place.good("rollout run --trial 0 --json --quiet").0;
    let from_files =
        place.good("rollout run/config.toml --policies run/policies.safetensors --trial 0 --json --quiet").0;
    assert_eq!(from_directory, from_files);
    place.fails(2, "rollout small.toml", &["--policies: a config file needs a file of policies"]);
    place.fails(2, "rollout run --stage 1", &["--stage 1: the config has no [[stages]]\n"]);
}

#[test]
fn init_layouts_have_the_requested_size_and_reachable_pois() {
    let place = Place::new(&[]);
    for (shape, groups, followers, pois) in [
        ("ring", 6, 3, 6),
        ("row", 1, 0, 3),
        ("row", 5, 2, 4),
        ("grid", 4, 3, 9),
        ("ring", 40, 8, 3),
        ("grid", 2, 20, 7),
    ] {
        let line = format!("init {shape} --groups {groups} --followers {followers} --pois {pois} --force --out x.toml");
        place.good(&line);
        let text = place.read("x.toml");
        assert!(text.to_lowercase().starts_with(&format!("# {shape}: {groups} group")), "{text}");
        let config = flotilla::Config::parse(&text, "x").unwrap();
        let world = &config.world;
        assert_eq!((world.leaders.len(), world.followers.len(), world.pois.len()), (groups, groups * followers, pois));
        assert_eq!(place.good("check x.toml").1, "", "{line}: warnings");
        if shape == "ring" {
            // A follower is placed behind its leader, with the same heading.
            let headings = world.headings();
            for (follower, heading) in headings[groups..].iter().enumerate() {
                assert_eq!(heading, &headings[follower / followers], "{line}: follower {follower}");
            }
        }
    }
    let stderr = place.refused(2, "init chaotic --groups 3");
    assert!(stderr.contains("--groups: the layout chaotic is the paper's; use it with ring, row or grid"), "{stderr}");
    place.fails(2, "init ring --groups 600 --followers 1 --pois 5", &["these are 1200 agents, allowed 1 to 1024"]);
    place.fails(2, "init row --pois 0", &["--pois 0: allowed 1 to 256"]);
    place.good("init row --coupling 8 --out eight.toml");
    let text = place.read("eight.toml");
    assert!(text.contains("\ncoupling = 8\n") && text.contains("when 8 agents are within"), "{text}");
    for (flags, wrong) in [("--coupling 0", "0: allowed 1 to 16"), ("--groups 2 --coupling 9", "9: allowed 1 to 8")] {
        place.fails(2, &format!("init row {flags}"), &[&format!("--coupling {wrong}, the number of agents")]);
    }
}

/// In the ring, the last teams must observe clearly more POIs than random ones.
#[test]
fn teams_learn_in_the_ring_layout() {
    let place = Place::new(&[]);
    place.good("init ring --groups 6 --out ring.toml");
    place.good("train ring.toml --out run --trials 3 --generations 40 --backend cpu --quiet");
    let sum = |generation| metric(&place, generation, 2).iter().sum::<f64>() * 6.0 / 3.0;
    assert!(sum(40) >= sum(0) + 1.0 && sum(40) >= 2.0, "{} of 6 POIs at the start, {} at the end", sum(0), sum(40));
}

#[test]
fn keys_are_set_from_the_command_line() {
    let place = Place::new(&[("small.toml", SMALL)]);
    let world = |flags: &str| place.json(&format!("check small.toml --json {flags}"))["config"].clone();
    let config = world("--set world.steps=44 --set learning.fitness=G --set policy.hidden=[4,5]");
    assert_eq!((&config["world"]["steps"], &config["learning"]["fitness"]), (&44.into(), &"G".into()));
    assert_eq!(config["policy"]["hidden"], serde_json::json!([4, 5]));
    assert_eq!(world("--fitness df")["learning"]["fitness"], "Df");
    let stderr = place.refused(2, "check small.toml --set world.stps=3");
    assert!(stderr.contains("--set world.stps: unknown key, did you mean `world.steps`?"), "{stderr}");
    place.fails(2, "check small.toml --set world.steps=0", &["--set world.steps: found 0, allowed 1 to 10000"]);
    for set in ["steps", "=3"] {
        place.fails(2, &format!("check small.toml --set {set}"), &["allowed KEY=VALUE, as world.steps=60"]);
    }
}

#[test]
fn errors_suggest_what_was_meant() {
    let place = small();
    let stderr = place.refused(2, "replay run --champion");
    assert!(stderr.contains("--team champion") && !stderr.contains("as a value"), "{stderr}");
    let stderr = place.refused(2, "compare run --set world.steps=3");
    assert!(!stderr.contains("as a value"), "{stderr}");
}
