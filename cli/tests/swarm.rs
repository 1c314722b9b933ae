//! Tests of large teams from config to picture.

use std::fs;

use flotilla::config::Config;
use flotilla::memory::Peaks;

use crate::support::{Place, root};

/// Returns the config of the repository with this many followers.
fn config(followers: usize) -> String {
    let text = fs::read_to_string(root("configs/swarm.toml")).unwrap();
    let edited = text.replace("count = 100000", &format!("count = {followers}"));
    assert!(edited != text || followers == 100_000);
    edited.replace("coupling = 10000", &format!("coupling = {}", followers / 10))
}

#[test]
fn a_swarm_trains_resumes_and_is_drawn_by_a_sample() {
    let place = Place::new(&[("swarm.toml", &config(5000))]);
    let train = ["train", "swarm.toml", "--backend", "cpu", "--set", "learning.population=4"];
    let run = |more: &[&str]| place.good(&[&train[..], more].concat()[..]);
    run(&["--generations", "2", "--out", "whole"]);
    run(&["--generations", "1", "--out", "parts"]);
    run(&["--generations", "2", "--out", "parts", "--resume"]);
    let [whole, parts] = ["whole", "parts"].map(|run| fs::read(place.path(run).join("policies.safetensors")).unwrap());
    assert!(whole == parts, "the policies differ");
    place.good("replay whole --out page.html");
    let page = place.read("page.html");
    assert!(page.contains("1 of 3 followers drawn"), "the page does not say that it has a sample");
    assert!(page.contains(r#""size":5000"#), "the legend does not count all followers");
    // 1667 of 5000 followers, at 76 moments.
    assert!(page.len() < 4 << 20, "{} bytes", page.len());
    place.good("replay whole --out still.svg");
    let still = place.read("still.svg");
    assert!(still.contains("1 of 3 followers drawn") && still.len() < 1 << 20, "{} bytes", still.len());
}

/// 16 bits are not enough to count 70 000 agents near a POI.
#[test]
fn pages_count_all_agents_near_a_poi() {
    let pois = "at = [[150.0, 100.0], [100.0, 150.0], [50.0, 100.0], [100.0, 50.0]]";
    let text = config(70_000).replace("steps = 75", "steps = 1").replace("radius = 20.0", "radius = 80.0");
    let place = Place::new(&[("swarm.toml", &text.replace(pois, "at = [[100.0, 100.0]]"))]);
    place.good("train swarm.toml --backend cpu --generations 0 --set learning.population=4 --out run");
    place.good("replay run --out page.html");
    let page = place.read("page.html");
    // 0 at the start and 70 000 at the only step.
    assert!(page.contains(r#""near":"AAAAAHARAQA=""#), "not all agents are counted");
}

#[test]
fn layouts_of_swarms_are_samples() {
    let place = Place::new(&[("swarm.toml", &config(100_000))]);
    place.good("check swarm.toml --out layout.svg");
    let layout = place.read("layout.svg");
    assert!(layout.contains("1 of 50 followers drawn") && layout.len() < 1 << 20, "{} bytes", layout.len());
}

#[test]
fn swarms_have_baselines() {
    let place = Place::new(&[("swarm.toml", &config(2000))]);
    let (table, _) = place.good("baseline swarm.toml --seeds 1 --generations 1 --population 4 --episodes 2");
    for name in ["constant speeds", "random networks", "open-loop", "teams of networks"] {
        assert!(table.contains(name), "{table}");
    }
}

/// Four teams of 2^20 agents on four threads.
#[test]
fn a_million_agents_fit_in_two_gibibytes() {
    let text = config((1 << 20) - 8).replace("population = 20", "population = 4");
    let config = Config::parse(&text, "million.toml").unwrap().validate().unwrap();
    let peak = Peaks::of([&config], 4).host;
    assert!((1 << 28..2 << 30).contains(&peak), "{peak} bytes");
}
