//! Compares GPUs with the CPU, bit for bit: every stage on random worlds, batches, and training runs.
//!
//! Every test uses all adapters. One test edits shaders to show that the comparison can fail. Comments name the bugs
//! that tests have found.

use crate::support;
use flotilla::backend::cpu::Cpu;
use flotilla::backend::gpu::device::{Gpu, Request};
use flotilla::backend::gpu::episode::{GpuBackend, Kernel, Records, ResidencyPolicy};
use flotilla::backend::gpu::exact::{self, Pass};
use flotilla::backend::gpu::source::{BreedJob, GatherJob, State, Task};
use flotilla::backend::{Backend, Group, Weights};
use flotilla::config::{Config, Coupling, Fitness, Observers, ValidConfig, own_populations};
use flotilla::evaluate::{SCORES_AND_DT, Starts, evaluate};
use flotilla::evolve::{Breeding, Key, Purpose};
use flotilla::gpu_struct::GpuStruct;
use flotilla::model::class::Class;
use flotilla::trainer::Trainer;
use flotilla::verify::{Agreement, Plan, compare};
use flotilla::world::{Constants, World};
use flotilla::{backend::gpu, sample};

/// The specialised kernel plays fewer worlds, because software drivers need a second to compile it for each world.
const KERNELS: [Kernel; 2] = [Kernel::Generic, Kernel::Specialised];

/// Opens a GPU as a [`backend`].
fn open(request: &Request, pass: Pass, kernel: Kernel) -> GpuBackend {
    backend(gpu::open(Request { pass: Some(pass), ..request.clone() }).unwrap(), kernel)
}

/// Returns a backend that holds all populations and adds up all records.
fn backend(gpu: Gpu, kernel: Kernel) -> GpuBackend {
    let backend = GpuBackend::new(gpu).unwrap().with_kernel(kernel);
    backend.with_residency(ResidencyPolicy::Always).with_records(Records::CountedFrom(0))
}

/// Returns a group of teams with separate policies per leader, scored by every fitness.
fn group_of_teams<'a>(world: &'a World, weights: &'a [f32], policies: usize, teams: &'a [u32]) -> Group<'a> {
    let (populations, fitnesses) = (own_populations(world.leaders()), SCORES_AND_DT);
    Group { populations, fitnesses, ..Group::new(world, weights, policies, teams) }
}

fn check(plan: &Plan, mut backend: GpuBackend) -> Agreement {
    compare(plan, &mut Cpu::default(), &mut backend, |_| ()).unwrap()
}

/// Found a rollout that cast an empty slice of moments with the wrong alignment.
#[test]
fn random_worlds_agree_under_both_passes_and_kernels() {
    for (request, info) in support::adapters("random_worlds_agree_under_both_passes_and_kernels") {
        for pass in [Pass::NoContraction, Pass::Guarded] {
            for (kernel, seeds) in KERNELS.into_iter().zip([0..40, 0..12]) {
                let outcome = check(&Plan::random(seeds, 9), open(&request, pass, kernel));
                println!("{info}, {pass}, {kernel}: {} worlds, {} agent-steps", outcome.worlds, outcome.agent_steps);
                assert_eq!(outcome.mismatch, None, "{info}, {pass}, {kernel}");
            }
        }
    }
}

#[test]
fn checked_shaders_and_default_limits_agree() {
    for (request, info) in support::adapters("checked_shaders_and_default_limits_agree") {
        for request in
            [Request { checked: true, ..request.clone() }, Request { default_limits: true, ..request.clone() }]
        {
            let gpu = gpu::open(request.clone()).unwrap();
            for (kernel, seeds) in KERNELS.into_iter().zip([100..112, 100..102]) {
                let mismatch = check(&Plan::random(seeds, 5), backend(gpu.clone(), kernel)).mismatch;
                assert_eq!(mismatch, None, "{info}, {kernel}, {request:?}");
            }
        }
    }
}

/// Each edit changes a constant or a comparison in one shader. The reported mismatch has to name its stage.
#[cfg(debug_assertions)]
#[test]
fn a_changed_shader_is_reported_with_its_stage() {
    type Edit = fn(String) -> String;
    // Beside each edit is a random world that shows it. More worlds would take minutes to compile.
    let edits: [(&str, u64, Edit); 13] = [
        ("sense", 999, |text| {
            replaced(text, "less_base(value + base - exact", "less_base(1.000001 * value + base - exact")
        }),
        ("sense", 0, |text| replaced(text, "place.y - y, range2", "place.y - y, 0.99 * range2")),
        ("sense", 999, |text| replaced(text, "before % 32u), before < 32u", "before % 32u), before > 32u")),
        ("policy", 0, |text| replaced(text, "14.7163315", "14.716334")),
        ("follow", 3, |text| replaced(text, "vec2(push * own.wall_gain", "vec2(push * 1.01 * own.wall_gain")),
        ("move", 999, |text| replaced(text, "let scale = 1.5", "let scale = 1.5000001")),
        ("couple", 999, |text| {
            replaced(text, "return within(dx, dy, radius2)", "return within(dx, dy, 0.99 * radius2)")
        }),
        ("influence", 1, |text| replaced(text, "seen = u32(", "seen = 2u * u32(")),
        ("policy", 6, |text| replaced(text, "if wanted[3] > most", "if wanted[3] >= most")),
        ("policy", 17, |text| replaced(text, "if densities.y > most", "if densities.y >= most")),
        ("breed", 999, |text| replaced(text, "* breed_job.sigma", "* 1.0000001 * breed_job.sigma")),
        ("sight", 4, |text| replaced(text, "place.y - at.y, influence2)", "place.y - at.y, 0.99 * influence2)")),
        ("sight", 4, |text| replaced(text, "sights + (step * rows + row)", "sights + (step * rows + rows - 1u - row)")),
    ];
    for (stage, _, edit) in edits {
        assert!(support::edits_a_shader(edit), "an edit of stage {stage} changes no shader");
    }
    for (request, info) in support::adapters("a_changed_shader_is_reported_with_its_stage") {
        let gpu = gpu::open(Request { pass: Some(Pass::NoContraction), ..request }).unwrap();
        for ((stage, world, edit), kernel) in edits.into_iter().zip(KERNELS.into_iter().cycle()) {
            let backend = backend(gpu.clone(), kernel);
            // SAFETY: the edits change numbers, and an index within its row; loops stay as they are.
            #[expect(unsafe_code, reason = "an edited shader is compiled without bounds checks")]
            let backend = unsafe { backend.edited(edit) };
            let mismatch = check(&Plan::random(world..world + 1, 9), backend).mismatch;
            let named = mismatch.as_ref().is_some_and(|text| text.contains(&format!("stage {stage},")));
            assert!(named, "{info}: a change of stage {stage} was reported as {mismatch:?}");
        }
    }
}

/// Replaces `from` in the one shader that contains it.
#[cfg(debug_assertions)]
fn replaced(text: String, from: &str, to: &str) -> String {
    assert!(text.matches(from).count() <= 1, "{from} occurs more than once");
    text.replace(from, to)
}

/// Large worlds have several agents per thread, many words per set, and three wide layers.
#[test]
fn large_worlds_agree() {
    let config = |text: &str| Config::parse(text, "large.toml").unwrap();
    let places = |count: usize, y: f64| -> String {
        (0..count).map(|i| format!("[{:?}, {:?}],", (i % 40) as f64 * 1.2, y + (i / 40) as f64)).collect()
    };
    let crowd = config(&format!(
        "[world]\nleaders = [{}]\nfollowers = [{}]\npois = [{}]\nsteps = 3\n[policy]\nhidden = [64, 64, 64]",
        places(300, 5.0),
        places(724, 14.0),
        places(256, 25.0)
    ));
    let leaders_only = config(&format!(
        "[world]\nleaders = [{}]\npois = [{}]\nsteps = 3\n[sense]\nagent_range = inf",
        places(257, 5.0),
        places(33, 20.0)
    ));
    for (request, info) in support::adapters("large_worlds_agree") {
        let worlds = vec![("crowd".into(), crowd.clone()), ("leaders only".into(), leaders_only.clone())];
        let plan = Plan { worlds, teams: 2, seed: 0, generations: 0 };
        let backend = GpuBackend::new(gpu::open(request).unwrap()).unwrap().with_records(Records::CountedFrom(0));
        // Training would take minutes on software drivers, so these worlds are only traced and played in batches.
        let plan = Plan { worlds: plan.worlds.into_iter().map(small_population).collect(), ..plan };
        assert_eq!(check(&plan, backend).mismatch, None, "{info}");
    }
}

fn small_population((name, mut config): (String, Config)) -> (String, Config) {
    (config.learning.population, config.learning.trials) = (2, 1);
    (name, config)
}

/// Long episodes need several dispatches. Found that llvmpipe ends all loops after 65 535 iterations.
#[test]
fn long_episodes_agree() {
    let text = "[world]\nleaders = [[10.0, 5.0], [20.0, 5.0]]\nfollowers = [[12.0, 2.0], [8.0, 2.0]]\n\
                pois = [[10.0, 15.0], [30.0, 40.0]]\nsteps = 3000\n[learning]\npopulation = 2\ntrials = 1";
    let config = Config::parse(text, "long.toml").unwrap();
    for (request, info) in support::adapters("long_episodes_agree") {
        for kernel in KERNELS {
            let plan = Plan { worlds: vec![("long".into(), config.clone())], teams: 9, seed: 0, generations: 0 };
            let backend = GpuBackend::new(gpu::open(request.clone()).unwrap()).unwrap().with_kernel(kernel);
            let backend = backend.with_records(Records::CountedFrom(0));
            assert_eq!(check(&plan, backend).mismatch, None, "{info}, {kernel}");
        }
    }
}

/// The size of batches depends on the device's memory.
#[test]
fn small_batches_give_the_same_scores() {
    let config = sample::world(3);
    let world = World::new(&config.validate().unwrap());
    let (policies, teams) = (4, 300);
    let weights = sample::weights(&world, policies, 1);
    let choice: Vec<u32> = (0..teams * world.leaders()).map(|i| (i * 7 % policies) as u32).collect();
    let group = group_of_teams(&world, &weights, policies, &choice);
    let expected = Cpu::default().play(&[group]).unwrap();
    for (request, info) in support::adapters("small_batches_give_the_same_scores") {
        for bytes in [1 << 12, 1 << 15, 1 << 28] {
            let backend = GpuBackend::new(gpu::open(request.clone()).unwrap()).unwrap();
            assert_eq!(
                backend.with_batch_bytes(bytes).play(&[group]).unwrap(),
                expected,
                "{info}, batches of {bytes} bytes"
            );
        }
    }
}

/// Experiments trained side by side also have the same weights as each alone.
#[test]
fn training_gives_the_same_metrics_and_weights() {
    let mut config = support::layout("generally_forward");
    (config.learning.trials, config.learning.generations, config.learning.population) = (2, 4, 20);
    let mut jittered = support::layout("chaotic");
    (jittered.learning.trials, jittered.learning.generations, jittered.learning.population) = (1, 2, 20);
    (jittered.learning.start_jitter, jittered.learning.episodes_per_team) = (0.5, 3);
    jittered.learning.fitness = Fitness::Dpp;
    let mut relay = Config::parse(include_str!("../configs/generally_forward.toml"), "config").unwrap();
    (relay.learning.trials, relay.learning.generations, relay.learning.population) = (1, 3, 20);
    (relay.learning.fitness, relay.credit.led_within) = (Fitness::Dt, 4);
    (relay.world.observers, relay.world.coupling) = (Observers::Followers, Coupling::Same(1));
    (relay.world.steps, relay.world.after) = (40, vec![vec![], vec![0], vec![], vec![2]]);
    let train = |backend: &mut dyn Backend, configs: &[Config]| {
        let mut trainer = Trainer::new(ValidConfig::all(configs).unwrap());
        let rows = trainer.finish(backend).unwrap();
        let weights: Vec<Vec<Vec<f32>>> = (0..configs.len()).map(|experiment| trainer.policies(experiment)).collect();
        (rows, weights)
    };
    let configs = [config.clone(), jittered.clone(), relay.clone()];
    let (rows, weights) = train(&mut Cpu::default(), &configs);
    assert!(rows.iter().any(|row| row.experiment == 2 && row.best_g > 0.0), "the relay observed no POI: {rows:?}");
    assert!(rows.iter().any(|row| row.best_g > 0.0), "no POI was observed: {rows:?}");
    for (experiment, config) in configs.iter().enumerate() {
        assert_eq!(train(&mut Cpu::default(), std::slice::from_ref(config)).1[0], weights[experiment]);
    }
    for (request, info) in support::adapters("training_gives_the_same_metrics_and_weights") {
        let mut backend = GpuBackend::new(gpu::open(request).unwrap()).unwrap();
        assert_eq!(train(&mut backend, &configs), (rows.clone(), weights.clone()), "{info}");
    }
}

/// A difference would mean that only one side has padding.
#[test]
fn structs_have_the_same_size_in_shaders_and_on_the_host() {
    let texts = gpu::shaders();
    let modules: Vec<_> = texts.iter().map(|(_, text)| exact::parse(text).unwrap().0).collect();
    fn check<T: GpuStruct>(modules: &[naga::Module]) {
        let mut types = modules.iter().flat_map(|module| module.types.iter());
        let (_, found) = types.find(|(_, ty)| ty.name.as_deref() == Some(T::NAME)).unwrap();
        let naga::TypeInner::Struct { span, .. } = &found.inner else { panic!("{} is a struct", T::NAME) };
        assert_eq!(*span as usize, size_of::<T>(), "{}", T::NAME);
    }
    check::<Constants>(&modules);
    check::<Task>(&modules);
    check::<State>(&modules);
    check::<BreedJob>(&modules);
    check::<GatherJob>(&modules);
    check::<Class>(&modules);
}

/// Drawn starts make one group per episode, so a batch has many groups of few teams.
#[test]
fn held_out_episodes_give_the_same_results_on_every_backend() {
    let mut config = support::layout("generally_forward");
    // In longer episodes, agents see each other at different steps.
    config.world.steps = 40;
    let world = World::new(&config.validate().unwrap());
    let (policies, leaders) = (5, world.leaders());
    let weights = sample::weights(&world, policies, 11);
    let teams: Vec<u32> = (0..policies as u32).flat_map(|policy| std::iter::repeat_n(policy, leaders)).collect();
    let group = group_of_teams(&world, &weights, policies, &teams);
    let starts = Starts::Drawn { episodes: 300, seed: 5, jitter: 6.0, poi_jitter: 4.0 };
    let expected =
        evaluate(&mut Cpu::default(), &group, &starts, &mut |_| std::ops::ControlFlow::Continue(())).unwrap();
    let others = Starts::Drawn { episodes: 300, seed: 5, jitter: 6.0, poi_jitter: 0.0 };
    assert_ne!(
        evaluate(&mut Cpu::default(), &group, &others, &mut |_| std::ops::ControlFlow::Continue(())).unwrap(),
        expected,
        "moved POIs changed nothing"
    );
    let spreads: Vec<_> = (0..policies).map(|team| expected.team(team)).collect();
    assert!(spreads.iter().any(|spread| spread.deviation > Some(0.0)), "no team observes a POI: {spreads:?}");
    for (request, info) in support::adapters("held_out_episodes_give_the_same_results_on_every_backend") {
        let found = evaluate(&mut open(&request, Pass::Guarded, Kernel::Best), &group, &starts, &mut |_| {
            std::ops::ControlFlow::Continue(())
        })
        .unwrap();
        assert_eq!(found, expected, "{info}");
    }
}

/// The error names the inconsistency. No team is played.
#[test]
fn inconsistent_input_is_an_error_on_every_backend() {
    let world = World::new(&support::layout("generally_forward").validate().unwrap());
    let (policies, leaders) = (3, world.leaders());
    let weights = sample::weights(&world, policies, 1);
    let teams: Vec<u32> = (0..2 * leaders as u32).map(|place| place % 3).collect();
    let good = group_of_teams(&world, &weights, policies, &teams);
    let mut wrong = teams.clone();
    wrong[leaders + 2] = 3;
    let few = &weights[1..];
    let bad: [(Group<'_>, &str); 6] = [
        (Group { teams: &wrong, ..good }, "leader 2 of team 1 plays policy 3 of 3"),
        (Group { teams: &teams[1..], ..good }, "7 choices"),
        (Group { starts: &world.starts[1..], ..good }, "11 start positions for 12 agents"),
        (Group { weights: few.into(), ..good }, "weights"),
        (Group { populations: &vec![0; world.leaders()], ..good }, "1 populations of 3 have 336"),
        (Group { populations: &[0], ..good }, "populations of 1 leaders for"),
    ];
    let mut backends: Vec<Box<dyn Backend>> = vec![Box::new(Cpu::default())];
    for (request, _) in support::adapters("inconsistent_input_is_an_error_on_every_backend") {
        backends.push(Box::new(
            GpuBackend::new(gpu::open(request).unwrap()).unwrap().with_residency(ResidencyPolicy::Always),
        ));
    }
    for backend in &mut backends {
        for (group, named) in &bad {
            for error in [
                backend.play(std::slice::from_ref(group)).expect_err(named),
                backend.trace(group).map(drop).expect_err(named),
            ] {
                assert!(error.to_string().contains(named), "{}: {error}", backend.describe());
            }
        }
        backend.play(&[good]).unwrap();
        let sizes = [leaders, policies, world.parameters()];
        let Some(mut held) = backend.hold(&weights, sizes).unwrap() else { continue };
        let learning = support::layout("chaotic").learning;
        let key = Key::new(0, 0, Purpose::Mutation);
        for (parents, named) in [(vec![0; 11], "11 parents"), ([vec![0; 11], vec![3]].concat(), "policy 3 of 3")] {
            let breeding = Breeding { parents: &parents, key, generation: 0, learning: &learning };
            for error in
                [held.breed(&breeding).expect_err(named), breeding.on_host(sizes, &weights).expect_err(named).into()]
            {
                assert!(error.to_string().contains(named), "{}: {error}", backend.describe());
            }
        }
        // The errors left the population unchanged. It cannot be used with another number of policies.
        let mut found = vec![0.0; weights.len()];
        held.fetch(&mut found).unwrap();
        assert_eq!(found, weights);
        let other = Group { weights: Weights::OnDevice(&*held), policies: 4, ..good };
        let error = backend.play(&[other]).expect_err("the population has three policies");
        assert!(error.to_string().contains("populations of sizes [4, 3, 112]"), "{error}");
    }
}

/// Worlds that differ only in numbers share a kernel. A batch of many different worlds uses the generic kernel, because
/// compiling one for each would take minutes.
#[test]
fn kernels_are_compiled_for_few_worlds_and_shared() {
    // The worlds are small, because software drivers are slow.
    let text = "[world]\nleaders = [[10.0, 5.0]]\npois = [[10.0, 15.0]]\nsteps = 2\n[policy]\nhidden = []";
    let config = Config::parse(text, "small.toml").unwrap();
    let play = |backend: &mut GpuBackend, worlds: &[World]| {
        let weights: Vec<Vec<f32>> = worlds.iter().map(|world| sample::weights(world, 1, 0)).collect();
        let groups = worlds.iter().zip(&weights).map(|(world, weights)| group_of_teams(world, weights, 1, &[0]));
        backend.play(&groups.collect::<Vec<_>>()).unwrap();
        backend.compiled()
    };
    let gains = (1..5).map(|gain| {
        let mut config = config.clone();
        config.follow.wall_gain = f64::from(gain);
        World::new(&config.validate().unwrap())
    });
    let sizes = (1..=20).map(|pois| {
        let mut config = config.clone();
        config.world.pois = (0..pois).map(|poi| [2.0 * f64::from(poi), 15.0]).collect();
        World::new(&config.validate().unwrap())
    });
    let (gains, sizes): (Vec<_>, Vec<_>) = (gains.collect(), sizes.collect());
    for (request, info) in support::adapters("kernels_are_compiled_for_few_worlds_and_shared") {
        let mut backend = GpuBackend::new(gpu::open(request).unwrap()).unwrap().with_kernel(Kernel::Best);
        assert_eq!(play(&mut backend, &gains), [0, 1], "{info}: only the numbers differ");
        assert_eq!(play(&mut backend, &sizes), [1, 16], "{info}: the other worlds share the generic kernel");
        assert_eq!(play(&mut backend, &sizes), [1, 16], "{info}: nothing is compiled twice");
        backend = backend.with_kernel(Kernel::Generic);
        assert_eq!(play(&mut backend, &gains), [1, 16], "{info}: compiled kernels are used");
    }
}

/// A batch may have several specialised kernels, and a kernel may play several groups.
#[test]
fn worlds_with_kernels_of_their_own_share_a_batch() {
    let worlds: Vec<World> = (1..=5u32)
        .map(|pois| {
            let places: Vec<String> = (0..pois).map(|poi| format!("[{}.0, 7.0]", 2 * poi)).collect();
            let places = places.join(", ");
            let text = format!(
                "[world]\nleaders = [[10.0, 5.0]]\npois = [{places}]\nsteps = 9\ncoupling = 1\n[policy]\nhidden = []"
            );
            World::new(&Config::parse(&text, "small.toml").unwrap().validate().unwrap())
        })
        .collect();
    let weights: Vec<Vec<f32>> = worlds.iter().map(|world| sample::weights(world, 7, 0)).collect();
    let teams: Vec<u32> = (0..7).collect();
    let order = [0, 1, 2, 3, 4, 0];
    let groups: Vec<Group<'_>> = order.map(|index| group_of_teams(&worlds[index], &weights[index], 7, &teams)).into();
    let play = |backend: &mut dyn Backend, groups: &[Group<'_>]| backend.play(groups).unwrap();
    let expected = play(&mut Cpu::default(), &groups);
    assert!(expected.iter().any(|scores| scores.observed.iter().any(|&observed| observed > 0)));
    for (request, info) in support::adapters("worlds_with_kernels_of_their_own_share_a_batch") {
        let mut backend = GpuBackend::new(gpu::open(request).unwrap()).unwrap().with_kernel(Kernel::Specialised);
        for _ in 0..2 {
            assert_eq!(play(&mut backend, &groups), expected, "{info}");
            assert_eq!(backend.compiled(), [0, 5], "{info}");
        }
    }
}

/// Sums over agents and POIs are whole numbers, so their order does not matter: in a crowd, followers and POIs in another
/// order give every leader the same inputs, and every follower the same path.
#[test]
fn the_order_of_followers_and_pois_does_not_matter() {
    const FOLLOWERS: usize = 60;
    let place = |index: usize| [20.0 + (index * 37 % 61) as f64 * 0.113, 20.0 + (index * 53 % 67) as f64 * 0.097];
    let list = |places: Vec<[f64; 2]>| format!("{places:?}");
    for density in ["linear", "inverse", "mean"] {
        let paths = |order: &[usize]| {
            let text = format!(
                "[world]\nleaders = [[22, 22], [25, 24]]\nfollowers = {}\npois = {}\ncoupling = 2\nsteps = 40\n\
                 [sense]\ndensity = '{density}'\n[learning]\npopulation = 2\ntrials = 1",
                list(order.iter().map(|&index| place(index)).collect()),
                list(order.iter().take(30).map(|&index| place(index % 30).map(|at| at + 3.0)).collect()),
            );
            let world = World::new(&Config::parse(&text, "crowd.toml").unwrap().validate().unwrap());
            let weights = sample::weights(&world, 1, 5);
            let trace = Cpu::default().trace(&group_of_teams(&world, &weights, 1, &[0, 0])).unwrap();
            let of = |agent: usize| -> Vec<_> {
                let inputs = |step| if agent < 2 { trace.inputs_of(step, 0, agent).to_vec() } else { vec![] };
                let moments = (1..=40).map(|step| (trace.moment(step, 0, agent), inputs(step)));
                moments.map(|(moment, inputs)| (inputs, moment.force, moment.position, moment.heading)).collect()
            };
            let mut paths: Vec<_> = order.iter().enumerate().map(|(place, &index)| (index, of(2 + place))).collect();
            paths.sort_by_key(|&(index, _)| index);
            (of(0), of(1), paths)
        };
        let ascending: Vec<usize> = (0..FOLLOWERS).collect();
        let other = (0..FOLLOWERS).map(|index| (index % 30 * 7 + 3) % 30 + index / 30 * 30).collect::<Vec<_>>();
        assert!(paths(&ascending) == paths(&other), "{density}");
    }
}

/// Every agent has its own heading. Leaders with a range of 0 sense nothing, not even agents at the same position.
#[test]
fn own_headings_and_ranges_of_zero_agree() {
    let config = |ranges: &str| {
        let text = format!(
            "[world]\nleaders = [[10, 5], [10, 5]]\nfollowers = [[10, 5], [12, 3], [10, 5]]\npois = [[10, 5], [12, 6]]\n\
             coupling = 2\nsteps = 20\nheading = [0.5, -1.0, 2.0, 3.0, 0.0]\n[sense]\n{ranges}\n\
             [learning]\npopulation = 4\ntrials = 1"
        );
        Config::parse(&text, "zero.toml").unwrap()
    };
    let ranges = ["poi_range = 0", "agent_range = 0", "poi_range = 0\nagent_range = 0\ndensity = 'inverse'", ""];
    let worlds: Vec<_> = ranges.map(|ranges| (ranges.to_string(), config(ranges))).into();
    for (ranges, config) in &worlds {
        let world = World::new(&config.validate().unwrap());
        let weights = sample::weights(&world, 3, 5);
        let teams: Vec<u32> = (0..6).map(|slot| slot / 2).collect();
        let group = group_of_teams(&world, &weights, 3, &teams);
        let trace = Cpu::default().trace(&group).unwrap();
        for (agent, heading) in world.headings.iter().enumerate() {
            assert_eq!(trace.moment(0, 0, agent).heading, heading.to_array(), "{ranges}, agent {agent}");
        }
        let sensed = |from: usize| {
            let of = |team| (1..=20).flat_map(move |step| (0..2).map(move |leader| (step, team, leader)));
            (0..3).flat_map(of).any(|(step, team, leader)| {
                trace.inputs_of(step, team, leader)[from..from + 4].iter().any(|&input| input.to_bits() != 0)
            })
        };
        assert_eq!(
            (sensed(0), sensed(4)),
            (!ranges.contains("poi_range = 0"), !ranges.contains("agent_range = 0")),
            "{ranges}"
        );
    }
    for (request, info) in support::adapters("own_headings_and_ranges_of_zero_agree") {
        for kernel in KERNELS {
            let plan = Plan { worlds: worlds.clone(), teams: 9, seed: 3, generations: 2 };
            let backend = GpuBackend::new(gpu::open(request.clone()).unwrap()).unwrap().with_kernel(kernel);
            assert_eq!(check(&plan, backend.with_records(Records::CountedFrom(0))).mismatch, None, "{info}, {kernel}");
        }
    }
}
