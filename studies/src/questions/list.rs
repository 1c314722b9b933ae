//! The questions and their studies, as data.

use super::{OpenQuestion, Study};

const PLAIN: Study = Study {
    name: "",
    config: "",
    title: "",
    by: "",
    panels: None,
    words: &[],
    pairs: &[[0, 1]],
    at: &[],
    reach: None,
    warm_from: None,
    moved: None,
};

macro_rules! part {
    ($name:literal, $($field:ident: $value:expr),* $(,)?) => {
        Study {
            name: $name,
            config: include_str!(concat!("../../configs/questions/", $name, ".toml")),
            $($field: $value,)*
            ..PLAIN
        }
    };
}

const SHARING: (&str, &[&str]) = ("sharing", &["own policies", "one policy"]);
/// The pairs G − Df, G − Dt and Df − Dt by their index among G, D, Df and Dt.
const OF_CREDIT: &[[usize; 2]] = &[[0, 2], [0, 3], [2, 3]];

pub const QUESTIONS: &[OpenQuestion] = &[
    OpenQuestion {
        letter: 'a',
        title: "One policy or many, as groups and asymmetry grow",
        parts: &[
            part!(
                "groups",
                title: "One policy for all leaders or one each, by number of groups",
                by: "sharing",
                panels: Some("paradigm"),
                words: &[SHARING],
                reach: Some(0.75),
            ),
            part!(
                "asymmetry",
                title: "One policy for all leaders or one each, in four layouts of increasing asymmetry",
                by: "sharing",
                panels: Some("paradigm"),
                words: &[SHARING, ("pois", &["ahead", "to either side", "ahead and behind", "each another way"])],
                reach: Some(0.75),
            ),
        ],
    },
    OpenQuestion {
        letter: 'b',
        title: "Known behaviours against direct control",
        parts: &[part!(
            "behaviours",
            title: "Known behaviours or direct control",
            by: "actions",
            panels: Some("paradigm"),
            words: &[("pois", &["ahead", "each another way"])],
            reach: Some(0.75),
        )],
    },
    OpenQuestion {
        letter: 'c',
        title: "Relays: the same followers, led by different leaders in turn",
        parts: &[
            part!(
                "relay",
                title: "Relay of two leaders, by the time in which its last POIs can be observed",
                by: "fitness",
                words: &[("windows", &[
                    "1 step",
                    "5 steps",
                    "10 steps",
                    "20 steps",
                    "30 steps",
                    "no windows",
                ])],
                pairs: OF_CREDIT,
                reach: Some(0.75),
            ),
            part!(
                "relay_forced",
                title: "Relay with an enforced hand-over",
                by: "fitness",
                words: &[("windows", &["1 step", "10 steps", "20 steps", "30 steps"])],
                pairs: OF_CREDIT,
                reach: Some(0.75),
            ),
            part!(
                "relay_order",
                title: "The relay's layout with POIs in a fixed order instead of time windows",
                by: "fitness",
                words: &[("after", &["any order", "in order"])],
                pairs: OF_CREDIT,
            ),
            part!(
                "relay_twice",
                title: "Two relays side by side",
                by: "fitness",
                pairs: OF_CREDIT,
                reach: Some(0.75),
            ),
            part!(
                "relay_led",
                title: "Relay under Dt, with other rules for who leads a follower",
                by: "led_within",
                words: &[("led_within", &["all steps", "the present step", "the last 10 steps"])],
                pairs: &[[0, 1], [0, 2]],
            ),
        ],
    },
    OpenQuestion {
        letter: 'd',
        title: "Followers as the only observers",
        parts: &[
            part!("observers", title: "Only followers observe, by number of followers per leader", by: "fitness", pairs: OF_CREDIT),
        ],
    },
    OpenQuestion {
        letter: 'e',
        title: "Curricula over coupling",
        parts: &[part!(
            "curricula",
            title: "Full coupling from the start, or raised in stages",
            by: "stages",
            panels: Some("paradigm"),
            words: &[("stages", &["at once", "step by step"])],
        )],
    },
    OpenQuestion {
        letter: 'f',
        title: "Warm starts from one layout to another",
        parts: &[part!(
            "warm",
            title: "POIs in different directions, from random policies or from policies of other layouts",
            pairs: &[[0, 1], [0, 2], [0, 3]],
            at: &[0, 10, 100],
            // These points are leader-follower teams in which each leader has its own policy.
            warm_from: Some(("asymmetry", &[(0, "from ahead"), (2, "from either side"), (4, "from ahead and behind")])),
        )],
    },
    OpenQuestion {
        letter: 'g',
        title: "Learned on fixed POIs, played on moved ones, and the other way round",
        parts: &[part!(
            "places",
            title: "Champions on fixed and on moved POIs",
            by: "poi_jitter",
            words: &[("poi_jitter", &["learned on fixed POIs", "learned on moved POIs"])],
            pairs: &[[0, 1], [0, 2], [1, 2]],
            moved: Some(5.0),
        )],
    },
];
