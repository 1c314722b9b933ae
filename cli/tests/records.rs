//! Tests how a GPU's records are copied to the host.
//!
//! A device may add up what is lost without each leader. Scores by these sums have to equal those from whole records, and
//! the sums have to be small.

use crate::support;
use flotilla::backend::cpu::Cpu;
use flotilla::backend::gpu::episode::{GpuBackend, Kernel, Records, ResidencyPolicy};
use flotilla::backend::gpu::{self, device::Request};
use flotilla::backend::{Backend, Group, GroupScores};
use flotilla::config::{Config, Coupling, Fitness, Observers, Paradigm, ValidConfig, own_populations};
use flotilla::credit::Credit;
use flotilla::evaluate::SCORES_AND_DT;
use flotilla::sample;
use flotilla::trainer::Trainer;
use flotilla::verify::KINDS;
use flotilla::world::World;
use flotilla_app::sweep::Sweep;

/// Teams of one world, of five policies with random weights.
struct Teams {
    world: World,
    weights: Vec<f32>,
    choice: Vec<u32>,
}

impl Teams {
    fn new(config: &Config, teams: usize) -> Teams {
        let world = World::new(&config.validate().unwrap());
        let weights = sample::weights(&world, 5, config.learning.seed);
        Teams { choice: (0..teams * world.leaders()).map(|place| (place * 7 % 5) as u32).collect(), weights, world }
    }

    fn group(&self, fitnesses: &'static [Fitness]) -> Group<'_> {
        let populations = own_populations(self.world.leaders());
        Group { populations, fitnesses, ..Group::new(&self.world, &self.weights[..], 5, &self.choice) }
    }

    /// Returns the size of the whole record in bytes.
    fn whole_bytes(&self) -> u64 {
        let words = self.world.set_words() + self.world.leaders() * self.world.followers();
        (self.choice.len() / self.world.leaders() * words * 4) as u64
    }
}

/// Returns the fitnesses that a group is scored by. Groups take turns with those that sums suffice for,
/// starting from `first`. [`DT`] selects Dt, which needs the whole record.
fn fitnesses_of(group: usize, first: usize) -> &'static [Fitness] {
    let (counted, dt) = KINDS.split_at(5);
    if first == DT { dt[0] } else { counted[(group + first) % counted.len()] }
}

const DT: usize = usize::MAX;
const COUNTED: Records = Records::CountedFrom(0);

/// Plays all teams as one batch. Returns their scores by [`fitnesses_of`] each group.
fn scores(backend: &mut dyn Backend, batch: &[Teams], first: usize) -> Vec<GroupScores> {
    let groups: Vec<_> =
        batch.iter().enumerate().map(|(index, teams)| teams.group(fitnesses_of(index, first))).collect();
    backend.play(&groups).unwrap()
}

/// Returns the same scores from whole records, which the CPU traces.
fn expected(batch: &[Teams], first: usize) -> Vec<GroupScores> {
    let group_scores = |(index, teams): (usize, &Teams)| {
        let group = teams.group(SCORES_AND_DT);
        let (world, leaders, mut credit) = (group.world, group.world.leaders(), Credit::default());
        let mut scores = GroupScores::default();
        for (team, teams) in group.teams.chunks(leaders).enumerate() {
            let trace = Cpu::default().trace(&Group { teams, ..group }).unwrap();
            for (place, &fitness) in fitnesses_of(index, first).iter().enumerate() {
                let mut slot_scores = vec![0.0; leaders];
                let observed = credit.score(&trace.episode(world, 0), world, fitness, &mut slot_scores);
                scores.scores.extend(slot_scores);
                match place {
                    0 => scores.observed.push(observed),
                    _ => assert_eq!(scores.observed[team], observed),
                }
            }
        }
        scores
    };
    batch.iter().enumerate().map(group_scores).collect()
}

fn open(request: &Request, records: Records) -> GpuBackend {
    GpuBackend::new(gpu::open(request.clone()).unwrap()).unwrap().with_records(records)
}

/// Returns the bytes of the status words of this many workgroups.
fn status(workgroups: u64) -> u64 {
    4 * workgroups
}

/// Returns the bytes copied from the device since the last call.
fn downloaded(backend: &mut GpuBackend) -> u64 {
    backend.take_times().traffic.down
}

fn config(text: &str) -> Config {
    Config::parse(text, "records.toml").unwrap()
}

/// Returns `[[x, y], …]` with equal distances.
fn line(count: usize, [x, y]: [f64; 2], [dx, dy]: [f64; 2]) -> String {
    let places = (0..count).map(|i| format!("[{:?}, {:?}]", x + i as f64 * dx, y + i as f64 * dy));
    format!("[{}]", places.collect::<Vec<_>>().join(", "))
}

/// Random worlds, some with classes of agents and values of POIs, and four unusual ones: more than 64 agents, more than 256
/// leaders with more POIs than threads, and values whose sums take 16 or 32 bits.
fn worlds() -> Vec<Config> {
    let values = |value: &str| {
        format!(
            "[world]\nleaders = [[25.0, 14.0], [25.0, 36.0], [25.0, 20.0]]\n[policy]\nhidden = []\n\
             [[pois]]\nname = \"low\"\nat = [[25.0, 12.0]]\ncoupling = 1\n\
             [[pois]]\nname = \"high\"\nat = [[25.0, 38.0]]\ncoupling = 1\nvalue = {value}"
        )
    };
    let odd = [
        format!(
            "[world]\nleaders = {}\nfollowers = {}\npois = {}\nsteps = 12\ncoupling = [3, 20, 60]\n\
             [policy]\nhidden = []",
            line(30, [10.0, 5.0], [0.3, 0.0]),
            line(41, [10.0, 4.0], [0.2, 0.0]),
            line(3, [12.0, 8.0], [2.0, 0.0])
        ),
        format!(
            "[world]\nleaders = {}\nfollowers = {}\npois = {}\nsteps = 3\ncoupling = 1\n[policy]\nhidden = []",
            line(260, [5.0, 5.0], [0.1, 0.0]),
            line(5, [30.5, 4.0], [0.1, 0.0]),
            line(70, [5.0, 6.0], [0.5, 0.1])
        ),
        values("300"),
        values("0.3"),
    ];
    let random = (0..20).map(|seed| {
        let mut config = sample::world(seed);
        // Nothing is counted of worlds with windows or an order.
        config.world.windows.clear();
        config.world.after.clear();
        config
    });
    let classes = (0..).map(sample::classes_world).filter(|config| {
        let world = World::new(&config.validate().unwrap());
        world.paths.is_none() && !world.rule.is_timed()
    });
    random.chain(classes.take(3)).chain(odd.iter().map(|text| config(text))).collect()
}

#[test]
fn scores_are_the_same_from_sums_and_whole_records() {
    let batch: Vec<Teams> = worlds().iter().map(|config| Teams::new(config, 37)).collect();
    let expected: Vec<Vec<GroupScores>> = (0..2).map(|first| expected(&batch, first)).collect();
    let observing = expected[0].iter().flat_map(|scores| &scores.observed).filter(|&&observed| observed > 0).count();
    assert!(observing > 100, "only {observing} teams observe a POI");
    for range in [0..1 << 8, 1 << 8..1 << 16, 1 << 16..u32::MAX] {
        assert!(batch.iter().any(|teams| range.contains(&teams.world.total_worth)), "no sums up to {range:?}");
    }
    let whole: u64 = batch.iter().map(Teams::whole_bytes).sum();
    for (request, info) in support::adapters("scores_are_the_same_from_sums_and_whole_records") {
        for (first, expected) in expected.iter().enumerate() {
            for (records, bytes) in [(Records::Whole, 1 << 28), (COUNTED, 1 << 28), (COUNTED, 1 << 15)] {
                let mut backend = open(&request, records).with_batch_bytes(bytes).with_kernel(Kernel::Generic);
                let actual = scores(&mut backend, &batch, first);
                assert!(
                    actual == *expected,
                    "{info}: fitnesses from {first} on, {records:?}, batches of {bytes} bytes"
                );
                let downloaded = downloaded(&mut backend);
                assert_eq!(downloaded < whole, records == COUNTED, "{info}: {downloaded} of {whole} bytes");
            }
        }
        let mut checked = open(&Request { checked: true, ..request }, COUNTED);
        assert!(scores(&mut checked, &batch, 0) == expected[0], "{info}: checked");
    }
}

/// A canary: each edit to the shader that counts must change scores. Without it, the other tests might pass by chance.
#[cfg(debug_assertions)]
#[test]
fn an_edited_sum_changes_scores() {
    type Edit = (usize, usize, fn(String) -> String);
    // Beside each edit are a world and a fitness that show it.
    let edits: [Edit; 8] = [
        (1, 1, |text| text.replace("size >= coupling", "size > coupling")),
        (7, 2, |text| text.replace("taken > size - coupling", "taken > 0u")),
        (24, 4, |text| text.replace("step < sizes.steps", "step + 1u < sizes.steps")),
        (17, 3, |text| text.replace("if steps > most", "if steps >= most")),
        (1, 1, |text| text.replace("& scoring[about + 2u + word]", "")),
        (2, 4, |text| text.replace("max(largest, size)", "size")),
        (22, 4, |text| text.replace("next * copies <= now", "next * copies < now")),
        (23, 3, |text| text.replace("own = members", "own = zeroth | members")),
    ];
    let worlds = worlds();
    for (request, info) in support::adapters("an_edited_sum_changes_scores") {
        let gpu = gpu::open(request).unwrap();
        for (index, (world, first, edit)) in edits.into_iter().enumerate() {
            let teams = [Teams::new(&worlds[world], 37)];
            let backend = GpuBackend::new(gpu.clone()).unwrap().with_records(COUNTED);
            // SAFETY: the edits change comparisons and shorten a loop; every index stays in bounds.
            #[expect(unsafe_code, reason = "an edited shader is compiled without bounds checks")]
            let mut edited = unsafe { backend.edited(edit) };
            assert!(
                scores(&mut edited, &teams, first) != expected(&teams, first),
                "{info}: edit {index} changed no score"
            );
        }
    }
}

/// A record is copied whole if one dispatch cannot count it, if that would save too little, or if D++ may need too many
/// copies.
#[test]
fn very_long_episodes_and_small_batches_are_copied_whole() {
    let text = |steps: usize| {
        format!(
            "[world]\nleaders = [[10.0, 5.0], [20.0, 5.0]]\nfollowers = [[12.0, 2.0], [8.0, 2.0]]\n\
             pois = [[10.0, 15.0], [30.0, 40.0]]\nsteps = {steps}\ncoupling = 1\n[policy]\nhidden = []"
        )
    };
    let teams_with_steps = |steps: usize| vec![Teams::new(&config(&text(steps)), 20)];
    let (short, long, longest) = (teams_with_steps(100), teams_with_steps(3000), teams_with_steps(10_000));
    let large = format!(
        "[world]\nleaders = {}\npois = [[20.0, 8.0]]\nsteps = 100\ncoupling = 64\n[policy]\nhidden = []",
        line(64, [10.0, 5.0], [0.3, 0.0])
    );
    // The fitness is D++.
    let (large, dpp) = (vec![Teams::new(&config(&large), 20)], 4);
    let for_large = expected(&large, dpp);
    let [for_short, for_long, for_longest] = [&short, &long, &longest].map(|teams| expected(teams, 0));
    for (request, info) in support::adapters("very_long_episodes_and_small_batches_are_copied_whole") {
        let mut backend = open(&request, COUNTED).with_kernel(Kernel::Generic);
        // This episode takes several dispatches and is still counted.
        assert!(scores(&mut backend, &long, 0) == for_long, "{info}");
        assert!(downloaded(&mut backend) < long[0].whole_bytes(), "{info}: 3000 steps");
        assert!(scores(&mut backend, &longest, 0) == for_longest, "{info}");
        assert_eq!(downloaded(&mut backend), longest[0].whole_bytes() + status(2), "{info}: 10 000 steps");
        assert!(scores(&mut backend, &large, dpp) == for_large, "{info}");
        assert!(downloaded(&mut backend) > large[0].whole_bytes(), "{info}: a coupling of 64");
        let mut small = open(&request, Records::CountedFrom(1 << 20)).with_kernel(Kernel::Generic);
        assert!(scores(&mut small, &short, 0) == for_short, "{info}");
        assert_eq!(downloaded(&mut small), short[0].whole_bytes() + status(2), "{info}: not worth counting");
    }
}

/// Counts bytes over the bus per team, with populations on the device. The config is generally forward with Df.
/// `FLOTILLA_TEAMS` sets the number of teams.
#[test]
fn a_generation_moves_less_than_50_bytes_per_team() {
    let mut config = support::layout("generally_forward");
    let teams = std::env::var("FLOTILLA_TEAMS").map_or(1 << 11, |teams| teams.parse().unwrap());
    (config.learning.trials, config.learning.population, config.learning.generations) = (1, teams, 60);
    config.learning.fitness = Fitness::Df;
    for (request, info) in support::adapters("a_generation_moves_less_than_50_bytes_per_team") {
        let mut backend = open(&request, COUNTED).with_residency(ResidencyPolicy::Always);
        let mut trainer = Trainer::new([config.validate().unwrap()]);
        let mut before = backend.gpu().traffic();
        for generation in 0..=2 {
            let rows = trainer.advance(&mut backend).unwrap();
            let (total, played) = (backend.gpu().traffic(), backend.take_times().traffic);
            let held = (teams as u64 + 1) * 4 * 112 * 4;
            let traffic = total - std::mem::replace(&mut before, total);
            // The populations are uploaded once, in generation 0.
            let up = traffic.up - if generation == 0 { held } else { 0 };
            let per_team = |bytes: u64| bytes as f64 / teams as f64;
            let mean_g = rows.first().map_or(0.0, |row| row.mean_g);
            println!(
                "{info}: generation {generation}, mean G of the last {mean_g:.2}: {:.1} bytes per team up ({:.1} of it \
                 for rollouts), {:.1} down",
                per_team(up),
                per_team(played.up),
                per_team(traffic.down)
            );
            assert!(per_team(up + traffic.down) < 50.0, "{info}: generation {generation}");
        }
    }
}

/// With windows or an order, the time when an agent was near a POI can decide whether the POI is observed. Sums
/// do not have times, so such records are copied whole. The rule for observers does not depend on times.
#[test]
fn nothing_is_counted_if_times_matter() {
    let teams_with = |change: fn(&mut Config)| {
        let mut config = config(include_str!("../../configs/generally_forward.toml"));
        config.world.steps = 60;
        change(&mut config);
        vec![Teams::new(&config, 200)]
    };
    let by_paths = || {
        let expanded = config(include_str!("../../configs/generally_forward.toml")).expanded().to_toml();
        vec![Teams::new(&config(&expanded.replace("score = \"observed\"", "score = \"closeness\"")), 200)]
    };
    let cases: [(_, _, fn(&mut Config)); 4] = [
        ("default rules", true, |_| ()),
        ("followers observe", true, |config| {
            (config.world.observers, config.world.coupling) = (Observers::Followers, Coupling::Same(2));
        }),
        ("windows", false, |config| config.world.windows = vec![[20, 40]; 4]),
        ("POIs in order", false, |config| config.world.after = vec![vec![], vec![0], vec![0], vec![0]]),
    ];
    for (request, info) in support::adapters("nothing_is_counted_if_times_matter") {
        for (name, counted, change) in cases {
            let batch = teams_with(change);
            let expected = expected(&batch, 0);
            assert!(expected[0].observed.iter().any(|&observed| observed > 0), "{name}: nothing is observed");
            let mut backend = open(&request, COUNTED).with_kernel(Kernel::Generic);
            assert!(scores(&mut backend, &batch, 0) == expected, "{info}, {name}");
            let bytes = downloaded(&mut backend);
            assert_eq!(bytes < batch[0].whole_bytes() / 2, counted, "{info}, {name}: {bytes} bytes");
            // Dt needs the time when each follower was led. Nothing is counted, and sights are copied too.
            let expected = self::expected(&batch, DT);
            assert!(scores(&mut backend, &batch, DT) == expected, "{info}, {name}, Dt");
            let sights = (200 * 4 * batch[0].world.sight_words()) as u64;
            assert_eq!(downloaded(&mut backend), batch[0].whole_bytes() + sights + status(10), "{info}, {name}, Dt");
        }
        // Groups that are copied whole, or traced for their paths, take no others along.
        let mixed: Vec<_> = cases.iter().flat_map(|&(_, _, change)| teams_with(change)).chain(by_paths()).collect();
        let mut backend = open(&request, COUNTED).with_kernel(Kernel::Generic);
        let alone = mixed.iter().map(|teams| {
            backend.play(&[teams.group(&[Fitness::D])]).unwrap();
            downloaded(&mut backend)
        });
        let alone: u64 = alone.sum();
        backend.play(&mixed.iter().map(|teams| teams.group(&[Fitness::D])).collect::<Vec<_>>()).unwrap();
        assert_eq!(downloaded(&mut backend), alone, "{info}: as one batch");
    }
}

/// Returns the processor time of all threads of this process in seconds. Linux counts in hundredths of a second.
fn processor_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").expect("this is Linux");
    // The name may contain blanks. After it, the times are the 12th and 13th fields.
    let fields = stat.rsplit(')').next().unwrap_or_default().split_whitespace().skip(11).take(2);
    fields.map(|ticks| ticks.parse::<f64>().expect("a count") / 100.0).sum()
}

/// Prints the processor time of compiling: that of the first two generations minus twice that of the third.
///
/// *As on a GPU* forces all kernels that a GPU would compile; *by default* is what a software renderer compiles.
/// Disable drivers' caches (Mesa: `MESA_SHADER_CACHE_DISABLE=true`).
#[test]
#[ignore = "prints a table"]
fn compiling() {
    let small = |mut config: Config| {
        (config.learning.population, config.learning.trials, config.learning.generations) = (2, 1, 9);
        config
    };
    let paper = [
        ("generally forward", include_str!("../../configs/generally_forward.toml")),
        ("strictly forward", include_str!("../../configs/strictly_forward.toml")),
        ("chaotic", include_str!("../../configs/chaotic.toml")),
    ];
    let mut cases = Vec::new();
    for (name, text) in paper {
        for paradigm in [Paradigm::LeaderFollower, Paradigm::AllLeaders] {
            let mut config = small(config(text));
            config.learning.paradigm = paradigm;
            cases.push((format!("{name}, {paradigm:?}"), vec![config]));
        }
    }
    let sweep = Sweep::read(include_str!("../../configs/sweeps/large.toml"), "large.toml", &[], false).unwrap();
    cases
        .push(("large.toml".into(), sweep.points.into_iter().map(|point| small(point.config.into_config())).collect()));
    for (request, info) in support::adapters("compiling") {
        for (name, configs) in &cases {
            let backend = || GpuBackend::new(gpu::open(request.clone()).unwrap()).unwrap();
            let gpu = backend().with_kernel(Kernel::Best).with_residency(ResidencyPolicy::Always).with_records(COUNTED);
            for (setup, mut backend) in [("by default", backend()), ("as on a GPU", gpu)] {
                let mut trainer = Trainer::new(ValidConfig::all(configs).unwrap());
                let mut seconds = || {
                    let start = processor_seconds();
                    trainer.advance(&mut backend).unwrap();
                    processor_seconds() - start
                };
                // The second generation waits until the breeding kernels are compiled.
                let (first, second, third) = (seconds(), seconds(), seconds());
                let [generic, specialised] = backend.compiled();
                println!(
                    "{name}, {setup}: {:.2} s, {generic} generic and {specialised} specialised kernels, {info}",
                    first + second - 2.0 * third
                );
            }
        }
    }
}

/// Prints the CPU's part of a generation, by phase. The device plays only the first steps of each episode.
///
/// `FLOTILLA_TEAMS` sets the number of teams (2^20 by default), and `RAYON_NUM_THREADS` the number of threads. In release
/// builds, edits of shaders need `CARGO_PROFILE_RELEASE_DEBUG_ASSERTIONS=true`.
#[cfg(debug_assertions)]
#[test]
#[ignore = "prints a table"]
fn the_cpus_part_of_a_generation() {
    fn short(text: String) -> String {
        text.replace("step < task.end; step++", "step < min(task.end, task.first + 2u); step++")
    }
    let mut config = support::layout("generally_forward");
    let teams = std::env::var("FLOTILLA_TEAMS").map_or(1 << 20, |teams| teams.parse().unwrap());
    // One small generation is too short to be timed.
    let generations = (20_000 / teams).clamp(5, 400);
    (config.learning.trials, config.learning.population, config.learning.generations) = (1, teams, generations + 3);
    config.learning.fitness = Fitness::Df;
    // A leader's population has to fit into one buffer, which lavapipe limits to 128 MiB. The CPU moves no weights.
    config.policy.hidden = vec![];
    for (request, info) in support::adapters("the_cpus_part_of_a_generation") {
        let backend = open(&request, COUNTED).with_residency(ResidencyPolicy::Always);
        // SAFETY: the edit only shortens a loop.
        #[expect(unsafe_code, reason = "edited shaders are compiled without bounds checks")]
        let mut backend = unsafe { backend.edited(short) };
        let mut trainer = Trainer::new([config.validate().unwrap()]);
        // The first generations reserve memory.
        for _ in 0..3 {
            trainer.advance(&mut backend).unwrap();
        }
        (_, _) = (trainer.take_times(), backend.take_times());
        for _ in 0..generations {
            trainer.advance(&mut backend).unwrap();
        }
        let (times, stages) = (trainer.take_times(), backend.take_times());
        println!("{info}, {teams} teams, {} threads, ms per generation:", rayon::current_num_threads());
        for (name, time) in [
            ("prepare", times.prepare),
            ("play", times.play),
            ("  gather", stages.gather),
            ("  upload", stages.upload),
            ("  wait", stages.wait),
            ("  read back", stages.read_back),
            ("  score", stages.score),
            ("collect", times.collect),
            ("breed", times.breed),
        ] {
            println!("{name:>12} {:9.2}", 1e3 * time.as_secs_f64() / generations as f64);
        }
    }
}
