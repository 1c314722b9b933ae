//! The configs of the golden digests, which `golden.txt` describes.

use std::sync::LazyLock;

use flotilla::config::{Config, Override};

const GENERALLY_FORWARD: &str = include_str!("../../configs/generally_forward.toml");
const STRICTLY_FORWARD: &str = include_str!("../../configs/strictly_forward.toml");
const CHAOTIC: &str = include_str!("../../configs/chaotic.toml");
const ROVERS_AND_UAVS: &str = include_str!("../../configs/influence/3_rovers_3_uavs.toml");
/// Ten groups of one leader and three followers. A set of 40 agents needs two words.
const FORTY_AGENTS: &str = "
[world]
leaders = [[5, 5], [15, 5], [25, 5], [35, 5], [45, 5], [5, 40], [15, 40], [25, 40], [35, 40], [45, 40]]
followers = [
    [7, 2], [3, 2], [5, 8], [17, 2], [13, 2], [15, 8], [27, 2], [23, 2], [25, 8], [37, 2], [33, 2], [35, 8],
    [47, 2], [43, 2], [45, 8], [7, 37], [3, 37], [5, 43], [17, 37], [13, 37], [15, 43], [27, 37], [23, 37], [25, 43],
    [37, 37], [33, 37], [35, 43], [47, 37], [43, 37], [45, 43],
]
pois = [[5, 12], [20, 12], [45, 12], [10, 47], [30, 47], [48, 30]]
coupling = 4
";

/// Rovers that start in regions, a beacon that stays, and POIs in a region and at a place.
const REGIONS: &str = "
[world]
steps = 30
dt = 1.0
[[agents]]
name = \"rover\"
count = 3
in = { disc = [25, 25, 4] }
motion = { kind = \"free\", max_speed = 1.0 }
senses = [{ of = \"pois\", measure = \"closeness\", range = 50, combine = \"closest\" }, { of = \"agents\" }]
[[agents]]
name = \"scout\"
count = 2
in = { circle = [25, 25, 8] }
senses = [{ of = \"pois\", measure = \"inverse\" }, { of = \"rover\", combine = \"mean\" }]
[[agents]]
name = \"beacon\"
at = [[25, 25]]
control = \"still\"
[[pois]]
name = \"near\"
count = 2
in = { box = [10, 10, 40, 40] }
coupling = 1
[[pois]]
name = \"far\"
at = [[25, 38]]
coupling = 2
value = 2.0
";

/// UAVs in a box, which sense each POI and rover, scouts that choose rovers and move only near them, and rovers that follow
/// the nearest UAV.
const PURSUIT: &str = "
[world]
steps = 30
dt = 0.5
[[agents]]
name = \"uav\"
at = [[20, 20], [30, 20]]
motion = { kind = \"free\", max_speed = 3.0 }
stays_in = [15, 10, 40, 33.3]
senses = [
    { of = \"pois\", sectors = \"each\", measure = \"closeness\", range = 20, empty = -1 },
    { of = [\"rover\", \"uav\"], sectors = \"each\", measure = \"inverse\", combine = \"sum\" },
]
leads = \"rover\"
influence_radius = 8
observes = false
[[agents]]
name = \"scout\"
at = [[22, 24], [28, 24], [25, 17]]
control = \"choose:rover\"
senses = [{ of = \"rover\", range = 6, measure = \"closeness\", combine = \"closest\" }, { of = \"pois\" }]
moves_near = \"rover\"
[[agents]]
name = \"rover\"
at = [[18, 22], [25, 22], [33, 22], [26, 15]]
control = \"nearest:uav\"
reach = 9.0
motion = { kind = \"free\", max_speed = 1.5 }
[[agents]]
name = \"truck\"
at = [[24, 14], [25, 28]]
control = \"nearest:truck\"
stays_in = [20, 10, 30, 30]
[[pois]]
name = \"poi\"
at = [[16, 27], [26, 31], [36, 26], [25, 12]]
coupling = 2
";

/// POIs that are gone once a rover comes near, or near some of them a scout.
const GONE: &str = "
[world]
steps = 60
dt = 0.5
[[agents]]
name = \"rover\"
at = [[20, 20], [30, 20]]
senses = [{ of = \"pois\", measure = \"closeness\", range = 20 }, { of = \"agents\" }]
[[agents]]
name = \"scout\"
at = [[25, 26]]
motion = { kind = \"free\", max_speed = 2.0 }
senses = [{ of = \"pois\", sectors = \"each\", measure = \"inverse\" }]
[[pois]]
name = \"near\"
at = [[20, 26], [30, 26]]
coupling = 2
gone_within = 3.0
[[pois]]
name = \"far\"
at = [[25, 34], [12, 30], [38, 30]]
coupling = 1
gone_within = 1.5
observers = \"rover\"
";

/// A large team: three leaders, 1100 followers that align with each other, and walls that they reach.
const SWARM: &str = "
[world]
map = [40, 30]
steps = 8
dt = 0.5
[[agents]]
name = \"leader\"
at = [[12, 15], [28, 15], [20, 22]]
senses = [
    { of = \"pois\" },
    { of = \"follower\", range = 9, sectors = 3 },
    { of = \"agents\", range = 4, combine = \"closest\" },
]
leads = \"follower\"
influence_radius = 6
[[agents]]
name = \"follower\"
count = 1100
in = { box = [0, 0, 40, 30] }
control = \"follow\"
rule = [
    { of = \"follower\", to = 0.5, gain = -1 },
    { of = \"follower\", from = 0.5, to = 2, align = 0.5 },
    { of = \"leader\", to = 8, gain = 4 },
]
[[pois]]
name = \"poi\"
at = [[8, 15], [32, 15], [20, 27]]
coupling = 40
radius = 4
";

/// Name, description, config, and the keys that are changed.
pub type Case = (&'static str, &'static str, &'static str, &'static [(&'static str, &'static str)]);

/// Together these cases cover every choice in a config, and sizes on both sides of every special case.
pub const CASES: [Case; 48] = [
    ("generally-forward", "first layout, leader-follower, Df", GENERALLY_FORWARD, &[]),
    ("strictly-forward", "second layout, D++", STRICTLY_FORWARD, &[("learning.fitness", "'D++'")]),
    ("chaotic", "third layout, G", CHAOTIC, &[("learning.fitness", "'G'")]),
    (
        "all-leaders",
        "all-leaders, D, coupling 2",
        GENERALLY_FORWARD,
        &[("learning.paradigm", "'all-leaders'"), ("learning.fitness", "'D'"), ("world.coupling", "2")],
    ),
    (
        "all-leaders-chaotic",
        "20 leaders, D++",
        CHAOTIC,
        &[("learning.paradigm", "'all-leaders'"), ("learning.fitness", "'D++'")],
    ),
    (
        "jittered",
        "three episodes per team from jittered starts, D",
        GENERALLY_FORWARD,
        &[
            ("learning.start_jitter", "0.75"),
            ("learning.episodes_per_team", "3"),
            ("learning.population", "13"),
            ("learning.fitness", "'D'"),
        ],
    ),
    (
        "additive",
        "additive mutation of every weight, no elites",
        STRICTLY_FORWARD,
        &[
            ("learning.mutation", "'additive'"),
            ("learning.mutation_probability", "1.0"),
            ("learning.mutation_sigma", "0.3"),
            ("learning.elites", "0"),
        ],
    ),
    (
        "inverse",
        "inverse density, POIs sensed up to a distance of 12",
        GENERALLY_FORWARD,
        &[("sense.density", "'inverse'"), ("sense.poi_range", "12.0")],
    ),
    ("unlimited", "agents sensed at any distance", CHAOTIC, &[("sense.agent_range", "inf")]),
    (
        "two-hidden",
        "two hidden layers, three elites",
        GENERALLY_FORWARD,
        &[("policy.hidden", "[16, 7]"), ("learning.elites", "3")],
    ),
    ("no-hidden", "no hidden layer", GENERALLY_FORWARD, &[("policy.hidden", "[]")]),
    (
        "each-coupling",
        "one coupling per POI, a seed above 32 bits",
        CHAOTIC,
        &[("world.coupling", "[1, 2, 5, 7]"), ("learning.seed", "81985529216486895")],
    ),
    ("forty-agents", "40 agents, two words per set, six POIs", FORTY_AGENTS, &[]),
    (
        "followers-observe",
        "only followers observe, Df",
        GENERALLY_FORWARD,
        &[("world.observers", "'followers'"), ("world.coupling", "2")],
    ),
    (
        "leaders-observe",
        "only leaders observe, D++",
        GENERALLY_FORWARD,
        &[("world.observers", "'leaders'"), ("world.coupling", "1"), ("learning.fitness", "'D++'")],
    ),
    (
        "windows",
        "POIs that can be observed only in windows of steps, D",
        CHAOTIC,
        &[("world.windows", "[[1, 20], [16, 24], [30, 50], [21, 21]]"), ("learning.fitness", "'D'")],
    ),
    (
        "after",
        "POIs that have to be observed in order, Df, two words per set",
        FORTY_AGENTS,
        &[("world.after", "[[], [0], [1], [0], [3], [3]]"), ("world.coupling", "3")],
    ),
    (
        "behaviours",
        "policies choose behaviours, G",
        GENERALLY_FORWARD,
        &[("policy.actions", "'behaviours'"), ("learning.fitness", "'G'")],
    ),
    (
        "behaviours-of-all",
        "20 leaders choose behaviours, no hidden layer",
        CHAOTIC,
        &[("policy.actions", "'behaviours'"), ("policy.hidden", "[]"), ("learning.paradigm", "'all-leaders'")],
    ),
    (
        "shared",
        "all leaders share a policy, D of two episodes",
        GENERALLY_FORWARD,
        &[
            ("learning.sharing", "'all'"),
            ("learning.fitness", "'D'"),
            ("learning.start_jitter", "0.5"),
            ("learning.episodes_per_team", "2"),
        ],
    ),
    (
        "shared-by-all",
        "twelve leaders share a policy that chooses behaviours",
        GENERALLY_FORWARD,
        &[("learning.sharing", "'all'"), ("learning.paradigm", "'all-leaders'"), ("policy.actions", "'behaviours'")],
    ),
    (
        "moved-pois",
        "two episodes per team with moved POIs",
        GENERALLY_FORWARD,
        &[("learning.poi_jitter", "3.0"), ("learning.episodes_per_team", "2"), ("learning.population", "13")],
    ),
    (
        "stages",
        "coupling 1, from generation 3 on coupling 3 and jittered starts, from generation 6 on a larger speed",
        GENERALLY_FORWARD,
        &[(
            "stages",
            "[{from = 0, set = {'world.coupling' = 1}}, {from = 3, set = {'learning.start_jitter' = 0.5}}, \
             {from = 6, set = {'motion.max_speed' = 10.0}}]",
        )],
    ),
    (
        "led-step-by-step",
        "Dt, followers led by the leader that they saw most so far",
        CHAOTIC,
        &[("learning.fitness", "'Dt'")],
    ),
    (
        "relay",
        "Dt, followers led by all leaders seen in the last 3 steps, only followers observe, order and windows",
        CHAOTIC,
        &[
            ("learning.fitness", "'Dt'"),
            ("credit.led_within", "3"),
            ("learning.seed", "1"),
            ("credit.led_by", "'any-seen'"),
            ("world.observers", "'followers'"),
            ("world.coupling", "2"),
            ("world.after", "[[], [0], [1], []]"),
            ("world.windows", "[[1, 50], [20, 50], [25, 50], [10, 30]]"),
        ],
    ),
    (
        "first",
        "Dt, followers led by the first leader of those that they saw in the last 2 steps",
        CHAOTIC,
        &[
            ("learning.fitness", "'Dt'"),
            ("credit.led_within", "2"),
            ("credit.led_by", "'first'"),
            ("world.coupling", "3"),
        ],
    ),
    (
        "alone",
        "Dt, followers led by a leader that is the only one they see, added to G",
        CHAOTIC,
        &[
            ("learning.fitness", "'Dt'"),
            ("credit.led_by", "'alone'"),
            ("credit.add_g", "true"),
            ("world.coupling", "3"),
        ],
    ),
    (
        "anyone",
        "Dt, followers led by all leaders if they see one, the start counts",
        GENERALLY_FORWARD,
        &[
            ("learning.fitness", "'Dt'"),
            ("credit.led_by", "'anyone'"),
            ("world.start_counts", "true"),
            ("world.coupling", "2"),
        ],
    ),
    (
        "removes",
        "D without the agents of a list, all-leaders",
        GENERALLY_FORWARD,
        &[
            ("learning.fitness", "'D'"),
            ("learning.paradigm", "'all-leaders'"),
            ("credit.removes", "[[0, 4, 5]]"),
            ("world.coupling", "2"),
        ],
    ),
    ("influence", "rovers under D and UAVs that lead them under Dt, scores by distance", ROVERS_AND_UAVS, &[]),
    ("gone", "POIs that nobody senses once an observer has been near", GONE, &[]),
    (
        "truncation",
        "a fifth of each population are elites, and only they become parents",
        GENERALLY_FORWARD,
        &[("learning.elites", "'20%'"), ("learning.parents", "'elites'"), ("world.coupling", "2")],
    ),
    (
        "partners",
        "the mean of three teams per policy, D",
        GENERALLY_FORWARD,
        &[("learning.partners", "3"), ("learning.fitness", "'D'"), ("world.coupling", "2")],
    ),
    (
        "lenient",
        "the best of two teams per policy, all-leaders, two episodes from jittered starts",
        CHAOTIC,
        &[
            ("learning.partners", "2"),
            ("learning.leniency", "'max'"),
            ("learning.paradigm", "'all-leaders'"),
            ("learning.start_jitter", "0.5"),
            ("learning.episodes_per_team", "2"),
            ("world.coupling", "3"),
        ],
    ),
    (
        "hall-of-fame",
        "two teams per policy and one with champions of one of the last three generations, all-leaders, Df",
        CHAOTIC,
        &[
            ("learning.hall_of_fame", "3"),
            ("learning.partners", "2"),
            ("learning.paradigm", "'all-leaders'"),
            ("world.coupling", "3"),
        ],
    ),
    (
        "sense-gain",
        "inverse density with a gain of 8, coupling 3, all-leaders, D++",
        CHAOTIC,
        &[
            ("sense.density", "'inverse'"),
            ("sense.gain", "8.0"),
            ("world.coupling", "3"),
            ("learning.paradigm", "'all-leaders'"),
            ("learning.fitness", "'D++'"),
        ],
    ),
    (
        "mean-density",
        "densities are means of inverse distances, speed 10, all-leaders, D",
        GENERALLY_FORWARD,
        &[
            ("sense.density", "'mean'"),
            ("motion.max_speed", "10.0"),
            ("learning.paradigm", "'all-leaders'"),
            ("learning.fitness", "'D'"),
        ],
    ),
    (
        "group",
        "all-leaders, a policy per group, D, two teams per policy, and one with past champions",
        GENERALLY_FORWARD,
        &[
            ("learning.sharing", "'group'"),
            ("learning.paradigm", "'all-leaders'"),
            ("learning.fitness", "'D'"),
            ("learning.partners", "2"),
            ("learning.hall_of_fame", "2"),
            ("world.coupling", "2"),
        ],
    ),
    (
        "listed-groups",
        "separable natural evolution strategies, leaders 0 and 2 share a policy, as do 1 and 3",
        CHAOTIC,
        &[
            ("learning.sharing", "'group'"),
            ("learning.groups", "[[2, 0], [1, 3]]"),
            ("learning.method", "'snes'"),
            ("learning.fitness", "'Df'"),
            ("world.coupling", "3"),
        ],
    ),
    (
        "openai-es",
        "OpenAI's evolution strategy, an odd population",
        GENERALLY_FORWARD,
        &[
            ("learning.method", "'openai-es'"),
            ("learning.search_step", "0.3"),
            ("learning.population", "21"),
            ("world.coupling", "2"),
        ],
    ),
    (
        "snes",
        "separable natural evolution strategies, D++, two partners",
        CHAOTIC,
        &[
            ("learning.method", "'snes'"),
            ("learning.search_sigma", "0.5"),
            ("learning.partners", "2"),
            ("learning.fitness", "'D++'"),
            ("world.coupling", "3"),
        ],
    ),
    (
        "shared-openai-es",
        "OpenAI's evolution strategy, all leaders share a policy, larger steps from generation 4 on",
        GENERALLY_FORWARD,
        &[
            ("learning.method", "'openai-es'"),
            ("learning.search_step", "0.3"),
            ("learning.sharing", "'all'"),
            ("learning.fitness", "'G'"),
            ("world.coupling", "2"),
            ("stages", "[{from = 4, set = {'learning.search_step' = 1.5}}]"),
        ],
    ),
    (
        "softmax-teams",
        "teams by softmax, uniform first weights, two test episodes from jittered starts, D",
        GENERALLY_FORWARD,
        &[
            ("learning.teams", "'softmax'"),
            ("learning.temperature", "0.3"),
            ("learning.initial", "'uniform'"),
            ("learning.initial_scale", "2.0"),
            ("learning.start_jitter", "0.5"),
            ("learning.test_episodes", "2"),
            ("learning.fitness", "'D'"),
            ("world.coupling", "2"),
        ],
    ),
    (
        "sorted-teams",
        "teams of the best, the second best, and so on, all-leaders",
        CHAOTIC,
        &[("learning.teams", "'sorted'"), ("learning.paradigm", "'all-leaders'"), ("world.coupling", "3")],
    ),
    (
        "team-elites",
        "two teams play again, three policies survive by their team's G, moved POIs",
        GENERALLY_FORWARD,
        &[
            ("learning.team_elites", "2"),
            ("learning.team_g_elites", "3"),
            ("learning.elites", "2"),
            ("learning.poi_jitter", "1.0"),
            ("world.coupling", "2"),
        ],
    ),
    (
        "regions",
        "classes that start in regions, two episodes per team, one test episode, jittered starts, D",
        REGIONS,
        &[
            ("learning.episodes_per_team", "2"),
            ("learning.test_episodes", "1"),
            ("learning.start_jitter", "0.5"),
            ("learning.fitness", "'D'"),
        ],
    ),
    (
        "pursuit",
        "classes that move to the nearest agent, choose one, stay in a box and move only near others, Df",
        PURSUIT,
        &[("learning.start_jitter", "0.5")],
    ),
    (
        "swarm",
        "a large team, in a grid of cells, with jittered starts, Dt",
        SWARM,
        &[("learning.start_jitter", "0.5"), ("learning.fitness", "'Dt'")],
    ),
];

pub static CONFIGS: LazyLock<Vec<Config>> = LazyLock::new(|| {
    let small = [("learning.trials", "2"), ("learning.generations", "8"), ("learning.population", "20")];
    let config = |(name, _, text, changes): Case| {
        let change = |&(key, text): &(&str, &str)| Override { key: key.into(), text: text.into(), name: key.into() };
        let small: Vec<Override> = small.iter().map(change).collect();
        let changes: Vec<Override> = changes.iter().map(change).collect();
        let config = Config::parse(text, name).and_then(|config| config.with(&small)?.with(&changes));
        config.unwrap_or_else(|error| panic!("{name}: {error}"))
    };
    CASES.map(config).into()
});
