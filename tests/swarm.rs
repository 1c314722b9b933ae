//! Large teams, one at a time with a grid of cells, against vectors of teams: equal bits, on the CPU and on GPUs.

#[cfg(feature = "gpu")]
use crate::support;
use flotilla::backend::Group;
use flotilla::backend::cpu::{Cpu, Noise, StepArrays, level_name};
#[cfg(feature = "gpu")]
use flotilla::backend::gpu::device::{AdapterInfo, Request};
#[cfg(feature = "gpu")]
use flotilla::backend::gpu::{self, episode::GpuBackend, episode::Records};
use flotilla::config::Config;
#[cfg(feature = "gpu")]
use flotilla::config::Sectors;
use flotilla::evaluate::SCORES_AND_DT;
use flotilla::evolve::{Key, Purpose};
use flotilla::sample;
use flotilla::verify::{Plan, compare};
use flotilla::world::World;

/// Compares traces, every fitness and whole trainings, on every instruction set.
fn check(worlds: &[(&str, Config)], teams: usize) {
    for level in Cpu::levels() {
        let worlds = worlds.iter().map(|(name, config)| (name.to_string(), config.clone())).collect();
        let plan = Plan { worlds, ..Plan::random(0..0, teams) };
        let [mut vectors, mut swarms] = [usize::MAX, 0].map(|from| Cpu::at_level(level).with_large_from(from));
        let outcome = compare(&plan, &mut vectors, &mut swarms, |_| ()).unwrap();
        assert_eq!(outcome.mismatch, None, "{}", level_name(level));
        assert!(outcome.agent_steps > 0);
    }
}

#[test]
fn random_worlds_are_equal_with_grids_and_without() {
    let worlds: Vec<(String, Config)> = Plan::random(0..120, 5).worlds;
    check(&worlds.iter().map(|(name, config)| (&**name, config.clone())).collect::<Vec<_>>(), 5);
}

/// As in `configs/swarm.toml`, with so few followers that all pairs can be visited, and more classes.
const SWARM: &str = r#"
[world]
map = [60.0, 90.0]
steps = 12

[[agents]]
name = "leader"
at = [[20.0, 30.0], [40.0, 30.0], [20.0, 60.0], [40.0, 60.0]]
senses = [{ of = "pois" }, { of = "agents" }, { of = "follower", range = 7.0, sectors = 5 }, { of = "stone", range = 9.0, combine = "closest" }]
leads = ["follower", "drifter"]
influence_radius = 12.0

[[agents]]
name = "follower"
count = 900
in = { disc = [30.0, 45.0, 25.0] }
control = "follow"
rule = [
    { of = "agents", to = 1.0, gain = -1.0 },
    { of = "agents", from = 1.0, to = 3.0, gain = 2.0 },
    { of = "follower", to = 2.0, align = 1.0 },
    { of = ["leader", "stone"], to = 15.0, gain = 3.0 },
]

[[agents]]
name = "drifter"
count = 300
in = { box = [0.0, 0.0, 60.0, 90.0] }
control = "follow"
motion = { kind = "free", max_speed = 2.0 }
rule = [{ of = "leader", to = 20.0, gain = -2.0 }, { of = "drifter", to = 1.5, gain = -1.0 }]

[[agents]]
name = "stone"
count = 20
in = { circle = [30.0, 45.0, 20.0] }
control = "still"

[[pois]]
name = "place"
at = [[30.0, 30.0], [10.0, 80.0]]
coupling = [60, 12]
radius = 5.0

# Some of these are gone at the start, and others in the course of an episode.
[[pois]]
name = "flower"
count = 200
in = { box = [0.0, 0.0, 60.0, 90.0] }
coupling = 1
observers = ["leader", "drifter"]
gone_within = 1.5

[learning]
population = 4
generations = 2
trials = 1
"#;

#[test]
fn a_swarm_is_equal_with_a_grid_and_without() {
    let config = Config::parse(SWARM, "swarm.toml").unwrap();
    let by_paths = Config::parse(&SWARM.replace("radius = 5.0", "radius = 5.0\nscore = \"closeness\""), "paths.toml");
    check(&[("swarm", config), ("swarm by paths", by_paths.unwrap())], 2);
}

/// Compares GPUs that play with cells whatever can be played so with a CPU that uses none.
#[cfg(feature = "gpu")]
fn check_gpus(adapters: Vec<(Request, AdapterInfo)>, plan: &Plan, edit: fn(GpuBackend) -> GpuBackend) {
    for (request, info) in adapters {
        let backend = GpuBackend::new(gpu::open(request).unwrap()).unwrap();
        let mut swarms = edit(backend.with_large_from(0).with_records(Records::CountedFrom(0)));
        let outcome = compare(plan, &mut Cpu::default().with_large_from(usize::MAX), &mut swarms, |_| ()).unwrap();
        println!("{info}: {} worlds, {} agent-steps", outcome.worlds, outcome.agent_steps);
        assert_eq!(outcome.mismatch, None, "{info}");
    }
}

#[cfg(feature = "gpu")]
#[test]
fn random_worlds_with_grids_are_equal_on_gpus() {
    let mut plan = Plan::random(0..400, 3);
    // Teams with these are never large.
    plan.worlds.retain(|(_, config)| {
        config.agents.iter().all(|class| {
            let each = class.senses.iter().any(|channel| matches!(channel.sectors, Sectors::Each(_)));
            class.control.target().is_none() && class.moves_near.is_none() && !each
        })
    });
    let (worlds, generations) = if support::is_long() { (200, 3) } else { (6, 1) };
    plan.generations = generations;
    plan.worlds.truncate(worlds);
    assert_eq!(plan.worlds.len(), worlds);
    check_gpus(support::adapters("random_worlds_with_grids_are_equal_on_gpus"), &plan, |gpu| gpu);
}

#[cfg(feature = "gpu")]
#[test]
fn a_swarm_is_equal_on_gpus_whatever_the_order_in_cells() {
    let adapters = || support::adapters("a_swarm_is_equal_on_gpus_whatever_the_order_in_cells");
    let by_paths = SWARM.replace("radius = 5.0", "radius = 5.0\nscore = \"closeness\"");
    let worlds = [("swarm", SWARM), ("swarm by paths", &by_paths)]
        .map(|(name, text)| (name.to_string(), Config::parse(text, "swarm.toml").unwrap()));
    let mut plan = Plan { worlds: worlds.into(), ..Plan::random(0..0, 2) };
    check_gpus(adapters(), &plan, |gpu| gpu);
    // Agents enter their cells in the opposite order.
    plan.worlds.truncate(1);
    #[cfg(debug_assertions)]
    check_gpus(adapters(), &plan, |gpu| {
        let edit = |text: String| {
            let edited = text.replace("let agent = id.x;", "let agent = shape.agents - 1u - id.x;");
            assert!(edited != text || !text.contains("fn fill("), "the shader has this line");
            edited
        };
        // SAFETY: every agent still enters one slot.
        #[expect(unsafe_code, reason = "an edited shader is compiled without bounds checks")]
        unsafe {
            gpu.edited(edit)
        }
    });
}

/// Drivers may end loops that are longer. So a task in which a thread had one is not believed.
#[cfg(all(debug_assertions, feature = "gpu"))]
#[test]
fn loops_that_drivers_may_end_are_reported() {
    for (request, info) in support::adapters("loops_that_drivers_may_end_are_reported") {
        let backend = GpuBackend::new(gpu::open(request).unwrap()).unwrap();
        let edit = |text: String| text.replace("turn <= task.end", "turn < task.end");
        // SAFETY: the edit shortens a loop.
        #[expect(unsafe_code, reason = "an edited shader is compiled without bounds checks")]
        let mut backend = unsafe { backend.edited(edit) };
        let worlds = vec![("swarm".into(), Config::parse(SWARM, "swarm.toml").unwrap())];
        let plan = Plan { worlds, ..Plan::random(0..0, 1) };
        let error = compare(&plan, &mut Cpu::default(), &mut backend, |_| ()).unwrap_err();
        assert!(
            matches!(error, flotilla::backend::BackendError::Gpu(gpu::device::DeviceError::Lost { .. })),
            "{info}: {error}"
        );
    }
}

/// Mesa's llvmpipe 22.3 ends loops once they have had 65 535 turns. Other drivers play on.
#[cfg(feature = "gpu")]
#[test]
fn loops_that_a_driver_ends_change_no_bits() {
    let senses = ["{ of = 'agents' }"; 8].join(", ");
    let text = format!(
        "[world]\nmap = [400, 400]\nsteps = 1\n[[agents]]\nname = 'leader'\nat = [[99, 99]]\nsenses = [{senses}]\n\
         leads = 'follower'\ninfluence_radius = 5\n[[agents]]\nname = 'follower'\ncount = 600000\n\
         in = {{ disc = [200, 200, 190] }}\ncontrol = 'still'\n[[pois]]\nname = 'place'\nat = [[150, 100]]\n"
    );
    let worlds = vec![("large".into(), Config::parse(&text, "large.toml").unwrap())];
    let plan = Plan { worlds, ..Plan::random(0..0, 1) };
    for (request, info) in support::adapters("loops_that_a_driver_ends_change_no_bits") {
        let mut backend = GpuBackend::new(gpu::open(request).unwrap()).unwrap();
        match compare(&plan, &mut Cpu::default(), &mut backend, |_| ()) {
            Err(flotilla::backend::BackendError::Gpu(gpu::device::DeviceError::Lost { .. })) => (),
            outcome => assert_eq!(outcome.unwrap().mismatch, None, "{info}"),
        }
    }
}

/// Steps with noise, as Python's `rollout` and `collect` get them.
#[test]
fn recorded_steps_are_equal_with_a_grid_and_without() {
    let world = World::new(&Config::parse(SWARM, "swarm.toml").unwrap().validate().unwrap());
    let (steps, agents, leaders, pois) = (world.steps(), world.agents(), world.leaders(), world.pois.len());
    let (weights, teams) = (sample::weights(&world, 3, 7), [0, 1, 2, 0, 2, 1, 0, 1]);
    let group = Group { fitnesses: SCORES_AND_DT, ..Group::new(&world, &weights[..], 3, &teams) };
    let key = Key::new(5, 0, Purpose::Exploration);
    let noise = Noise { key, deviations: &vec![[0.1, 0.2]; leaders], first: 3 };
    let record = |large_from: usize| {
        let zeros = |moments: usize, numbers: usize| vec![0.0; 2 * moments * numbers];
        let [mut positions, mut headings, mut speeds] = [2, 2, 1].map(|width| zeros(steps + 1, agents * width));
        let [mut inputs, mut outputs, mut actions] = [world.inputs(), 2, 2].map(|width| zeros(steps, leaders * width));
        let mut agents_at_poi = vec![0; 2 * world.set_words()];
        let mut observed_at = vec![0; 2 * pois];
        let arrays = StepArrays {
            positions: &mut positions,
            headings: &mut headings,
            speeds: &mut speeds,
            inputs: &mut inputs,
            outputs: &mut outputs,
            actions: &mut actions,
            agents_at_poi: &mut agents_at_poi,
            observed_at: &mut observed_at,
        };
        let cpu = Cpu::default().with_large_from(large_from);
        let scores = cpu.record(&[group], Some(noise), arrays).unwrap();
        let floats = [positions, headings, speeds, inputs, outputs, actions];
        (
            scores,
            floats.map(|array| array.into_iter().map(f32::to_bits).collect::<Vec<_>>()),
            agents_at_poi,
            observed_at,
        )
    };
    let (vectors, swarms) = (record(usize::MAX), record(0));
    assert!(vectors == swarms);
    assert!(
        vectors.1[5] != vectors.1[4] && vectors.2.iter().any(|&set| set != 0),
        "there is noise, and agents at POIs"
    );
}

/// Every POI may need all agents, in the short form as well.
#[test]
fn a_coupling_may_be_as_large_as_a_team() {
    let (head, _) = SWARM.split_once("[[pois]]").unwrap();
    let short = head.replace("steps = 12", "steps = 12\npois = [[30.0, 30.0]]\ncoupling = 1224");
    let config = Config::parse(&short, "short.toml").unwrap();
    assert_eq!(World::new(&config.validate().unwrap()).coupling, [1224]);
    let error = Config::parse(&short.replace("1224", "1225"), "short.toml").unwrap_err().to_string();
    assert!(error.contains("world.coupling: found 1225, allowed 1 to 1224"), "{error}");
}

#[test]
fn limits_of_large_teams_are_errors_with_their_key() {
    let found = |edits: &[(&str, &str)]| {
        let edit = |text: String, (from, to): &(&str, &str)| {
            assert!(text.contains(from), "{from}");
            text.replacen(from, to, 1)
        };
        Config::parse(&edits.iter().fold(SWARM.to_string(), edit), "swarm.toml").unwrap_err().to_string()
    };
    for (edits, message) in [
        (
            &[("count = 900", "count = 1048577")][..],
            "swarm.toml:15: agents[1].count: found 1048577, allowed 1 to 1048576",
        ),
        (&[("count = 300", "count = 1048576")], "which makes 1049480 agents with those before, allowed 1 to 1048576"),
        (
            &[(
                "at = [[20.0, 30.0], [40.0, 30.0], [20.0, 60.0], [40.0, 60.0]]",
                "count = 2000\nin = { disc = [9, 9, 5] }",
            )],
            "agents: found 2000 agents that learn, allowed up to 1024",
        ),
        (
            &[("count = 900", "count = 1000000"), ("steps = 12", "steps = 10000")],
            "swarm.toml:4: world.steps: found 10000, with which the record of an episode takes",
        ),
    ] {
        let error = found(edits);
        assert!(error.contains(message), "{error}");
    }
}
