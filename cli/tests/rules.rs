//! Tests the rules of tasks, from the command line to tables, pictures and pages.
//!
//! Rules say which agents observe, when and in which order POIs can be observed, and who counts as leading a follower.

use crate::support::{Place, page_data};
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use flotilla::backend::cpu::Cpu;
use flotilla::config::{Config, Fitness, LedBy, Observers, Override};
use flotilla::evaluate::Starts;
use flotilla_app::record::config_digest;
use flotilla_app::sweep::Sweep;

/// Two leaders with two followers each. Only followers observe. The second POI counts only after the first.
const RELAY: &str = "
[world]
map = [30.0, 20.0]
leaders = [[8.0, 5.0], [20.0, 5.0]]
followers = [[9.0, 3.0], [7.0, 3.0], [21.0, 3.0], [19.0, 3.0]]
pois = [[8.0, 10.0], [20.0, 10.0]]
coupling = 2
steps = 20
observers = \"followers\"
windows = [[3, 12], [2, 20]]
after = [[], [0]]
[learning]
fitness = \"Dt\"
population = 20
generations = 15
trials = 1
[credit]
led_within = 4
";

/// Creates a folder with the config [`RELAY`], and with a run of it in `run`.
fn trained() -> Place {
    let place = Place::new(&[("relay.toml", RELAY)]).on_cpu().slow();
    place.good("train relay.toml --out run --quiet");
    place
}

#[test]
fn every_rule_key_can_be_a_grid_axis() {
    let plain = RELAY
        .replace("windows = [[3, 12], [2, 20]]\nafter = [[], [0]]\n", "")
        .replace("[credit]\nled_within = 4\n", "");
    let grid = "[grid]\n\"world.observers\" = ['all', 'followers']\n\"world.windows\" = [[], [[1, 9], [4, 20]]]\n\
                \"world.after\" = [[], [[1], []]]\n\"learning.fitness\" = ['D', 'Dt']\n\
                \"credit.led_within\" = [0, 3]\n\"credit.led_by\" = ['most-seen', 'any-seen']\n";
    let base = plain.replace("observers = \"followers\"\n", "").replace("fitness = \"Dt\"\n", "");
    let sweep = Sweep::read(&format!("{base}{grid}"), "x.toml", &[], false).unwrap();
    assert_eq!(sweep.points.len(), 64);
    let last = &sweep.points[63].config;
    assert_eq!((last.world.observers, &last.world.windows), (Observers::Followers, &vec![[1, 9], [4, 20]]));
    assert_eq!(last.world.after, [vec![1], vec![]]);
    assert_eq!((last.learning.fitness, last.credit.led_within, last.credit.led_by), (Fitness::Dt, 3, LedBy::AnySeen));
    assert_eq!(*sweep.points[0].config, Config::parse(&base, "x").unwrap().with(&[fitness("D")]).unwrap());
}

fn fitness(word: &str) -> Override {
    Override::new("learning.fitness", word, "--fitness")
}

#[test]
fn check_predicts_the_memory_for_dt() {
    let place = Place::new(&[("relay.toml", RELAY)]);
    let cost = |fitness: &str| place.json(&format!("check relay.toml --fitness {fitness} --json"))["cost"].clone();
    let (df, dt) = (cost("Df"), cost("Dt"));
    // Sets of two POIs, and counts of four followers. Dt adds one word per follower and step.
    assert_eq!(
        (&df["record_bytes"], &dt["record_bytes"]),
        (&(4 * (20 * 2 + 4 * 2)).into(), &(4 * (48 + 20 * 4)).into())
    );
    for key in ["host_bytes", "adapter_bytes"] {
        assert!(dt[key].as_u64() > df[key].as_u64(), "{key}: {dt}, {df}");
    }
}

/// Only followers observe, so D is 0 and Dt is not.
#[test]
fn rollout_and_library_report_the_same_dt() {
    let place = trained();
    let score_rows = |flags: &str| -> Vec<Vec<f32>> {
        let files = "run/config.toml --policies run/policies.safetensors --scores run/scores.csv";
        place.good(&format!("rollout {files} --quiet {flags}"));
        let file = place.read("run/scores.csv");
        assert!(file.starts_with("team,leader,g,d,df,dpp,dt"), "{file}");
        file.lines().skip(1).map(|line| line.split(',').map(|word| word.parse().unwrap()).collect()).collect()
    };
    let rows = score_rows("");
    let bytes = place.bytes("run/policies.safetensors");
    let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let weights: Vec<f32> = bytemuck::pod_collect_to_vec(file.tensor("weights.0").unwrap().data());
    let config = Config::load(&place.path("run/config.toml")).unwrap();
    let played = |config: &Config| flotilla::play(config, &mut Cpu::default(), 20, &weights, &Starts::Own).unwrap();
    let by_dt = played(&config);
    let column = |index: usize| rows.iter().map(|row| row[index]).collect::<Vec<f32>>();
    assert_eq!((column(3), column(4), column(6)), (by_dt.d.clone(), by_dt.df.clone(), by_dt.dt.clone()));
    assert!(by_dt.observed.iter().any(|&observed| observed > 0.0), "nothing is observed: {rows:?}");
    assert!(by_dt.dt.iter().any(|&dt| dt > 0.0) && by_dt.d.iter().all(|&d| d == 0.0), "{rows:?}");
    // Dt is computed only if it is the config's fitness.
    let by_df = played(&config.with(&[fitness("Df")]).unwrap());
    assert_eq!((by_df.df, by_df.dt), (by_dt.df, vec![]));
    let several = score_rows("--episodes 3 --start-jitter 0.5");
    assert_eq!((several.len(), several[0].len()), (40, 12));
}

/// The page of a run with Dt shows which leader led each follower at every step, and the rules for POIs.
#[test]
fn replays_show_rules_and_who_leads_whom() {
    let place = trained();
    place.good("replay run");
    let data = page_data(&place.path("run/replay.html"));
    assert_eq!(data["observers"], "followers");
    assert_eq!(data["windows"], serde_json::json!([[3, 12], [2, 20]]));
    assert_eq!(data["after"], serde_json::json!([[], [0]]));
    let episode = &data["episodes"][0];
    assert_eq!(episode["dt"].as_array().unwrap().len(), 2);
    let words = |name: &str| -> Vec<u32> {
        let bytes = BASE64_STANDARD.decode(episode[name].as_str().unwrap()).unwrap();
        bytes.chunks_exact(4).map(|bytes| u32::from_le_bytes(bytes.try_into().unwrap())).collect()
    };
    let positions: Vec<f32> = words("positions").into_iter().map(f32::from_bits).collect();
    let at = |step: usize, agent: usize| [positions[(step * 6 + agent) * 2], positions[(step * 6 + agent) * 2 + 1]];
    // Whether a follower sees a leader at a step, counted from 1, before the step's move.
    let sees = |step: usize, follower: usize, leader: usize| {
        let ([x, y], [u, v]) = (at(step - 1, 2 + follower), at(step - 1, leader));
        (u - x) * (u - x) + (v - y) * (v - y) <= 25.0
    };
    let led = words("led");
    assert_eq!(led.len(), 21 * 4);
    let mut leaders = [0; 3];
    for (frame, follower) in (0..=20).flat_map(|frame| (0..4).map(move |follower| (frame, follower))) {
        let step: usize = frame.max(1);
        let count =
            |leader: usize| (step.saturating_sub(3).max(1)..=step).filter(|&step| sees(step, follower, leader)).count();
        let expected = match (count(0), count(1)) {
            (0, 0) => 0,
            (first, second) if second > first => 2,
            _ => 1,
        };
        assert_eq!(led[frame * 4 + follower], expected, "follower {follower}, step {step}");
        leaders[expected as usize] += 1;
    }
    assert!(leaders[1] > 0 && leaders[2] > 0, "{leaders:?}");

    place.good("replay run --step 1 --out run/still.svg");
    place.good("check run/config.toml --out run/layout.svg");
    let [still, layout] = ["still", "layout"].map(|name| place.read(format!("run/{name}.svg")));
    for (picture, label) in [
        (&still, "/2, steps 2 to 20, after 0\""),
        (&still, "\"does not observe\""),
        (&layout, "\"0: 2, steps 3 to 12\""),
        (&layout, "\"1: 2, steps 2 to 20, after 0\""),
        (&layout, "\"POI that cannot be observed now\""),
        (&layout, "Only followers observe. POIs can be observed: 0: "),
    ] {
        assert!(picture.contains(label), "{label} is missing from {picture}");
    }
}

#[test]
fn each_key_changes_a_configs_digest() {
    let config = Config::parse(include_str!("../../configs/generally_forward.toml"), "config").unwrap();
    let with = |key: &str, value: &str| Override { key: key.into(), text: value.into(), name: key.into() };
    let config = config.with(&[with("world.coupling", "1")]).unwrap();
    let mut digests = vec![config_digest(&config)];
    for (key, value) in [
        ("world.observers", "'leaders'"),
        ("world.windows", "[[1, 25], [1, 25], [1, 25], [1, 25]]"),
        ("world.after", "[[], [], [], [0]]"),
        ("credit.led_within", "1"),
        ("credit.led_by", "'any-seen'"),
        ("sense.gain", "2.0"),
        ("learning.parents", "'elites'"),
        ("learning.partners", "2"),
        ("learning.hall_of_fame", "2"),
        ("learning.leniency", "'max'"),
        ("learning.method", "'snes'"),
        ("learning.search_sigma", "0.5"),
        ("learning.search_step", "0.5"),
        ("learning.initial", "'uniform'"),
        ("learning.initial_scale", "0.5"),
        ("learning.teams", "'sorted'"),
        ("learning.temperature", "0.5"),
        ("learning.team_elites", "1"),
        ("learning.team_g_elites", "1"),
        ("learning.test_episodes", "1"),
    ] {
        digests.push(config_digest(&config.with(&[with(key, value)]).unwrap()));
    }
    digests.sort();
    digests.dedup();
    assert_eq!(digests.len(), 21);
}
