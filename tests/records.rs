//! What comes home of a GPU's episodes: scores are the same from whole and from packed records, whatever matters of them,
//! and little goes over the bus.

#![cfg(feature = "cli")]

mod support;

use flotilla::backend::cpu::Cpu;
use flotilla::backend::gpu::episode::{GpuBackend, Kernel, Records, ResidencyPolicy};
use flotilla::backend::gpu::{self, device::Request};
use flotilla::backend::{Backend, Group, GroupScores};
use flotilla::config::{Config, Coupling, Fitness, Observers, Paradigm, Sharing, ValidConfig};
use flotilla::credit::Credit;
use flotilla::evaluate::SCORES_AND_DT;
use flotilla::sample;
use flotilla::sweep::Sweep;
use flotilla::trainer::Trainer;
use flotilla::verify::KINDS;
use flotilla::world::World;

/// Some teams of one world; their policies' weights are random, or all 0.
struct Teams {
    world: World,
    weights: Vec<f32>,
    choice: Vec<u32>,
}

impl Teams {
    fn new(config: &Config, teams: usize, random: bool) -> Teams {
        let world = World::new(config);
        let mut weights = sample::weights(&world, 5, config.learning.seed);
        if !random {
            weights.fill(0.0);
        }
        Teams { choice: (0..teams * world.leaders()).map(|place| (place * 7 % 5) as u32).collect(), weights, world }
    }

    fn group(&self, fitnesses: &'static [Fitness]) -> Group<'_> {
        let (world, sharing) = (&self.world, Sharing::PerLeader);
        let (starts, weights, teams) = (&world.starts, self.weights[..].into(), &self.choice[..]);
        Group { world, starts, weights, policies: 5, sharing, teams, fitnesses }
    }

    /// Bytes of their whole record.
    fn whole(&self) -> u64 {
        let words = self.world.set_words() + self.world.leaders() * self.world.followers();
        (self.choice.len() / self.world.leaders() * words * 4) as u64
    }
}

/// The fitnesses that a group is scored by: those that a packed record answers come by turns, from `first` on; or Dt,
/// which none does.
fn fitnesses_of(group: usize, first: usize) -> &'static [Fitness] {
    let (packed, dt) = KINDS.split_at(5);
    if first == DT { dt[0] } else { packed[(group + first) % packed.len()] }
}

const DT: usize = usize::MAX;

/// Plays all teams as one batch, the fitnesses of the groups by turns from `first` on.
fn scores(backend: &mut dyn Backend, all: &[Teams], first: usize) -> Vec<GroupScores> {
    let groups: Vec<_> = all.iter().enumerate().map(|(index, teams)| teams.group(fitnesses_of(index, first))).collect();
    backend.play(&groups).unwrap()
}

/// The same from the whole record, traced on the CPU.
fn expected(all: &[Teams], first: usize) -> Vec<GroupScores> {
    let of_group = |(index, teams): (usize, &Teams)| {
        let group = teams.group(SCORES_AND_DT);
        let (world, leaders, mut credit) = (group.world, group.world.leaders(), Credit::default());
        let mut scores = GroupScores::default();
        for (team, teams) in group.teams.chunks(leaders).enumerate() {
            let trace = Cpu::default().trace(&Group { teams, ..group }).unwrap();
            for (place, &fitness) in fitnesses_of(index, first).iter().enumerate() {
                let mut one = vec![0.0; leaders];
                let observed = credit.score(&trace.episode(world, 0), world, fitness, &mut one);
                scores.scores.extend(one);
                match place {
                    0 => scores.observed.push(observed),
                    _ => assert_eq!(scores.observed[team], observed),
                }
            }
        }
        scores
    };
    all.iter().enumerate().map(of_group).collect()
}

/// Whether every team observed so many POIs.
fn all_observed(scores: &[GroupScores], pois: u32) -> bool {
    scores.iter().flat_map(|scores| &scores.observed).all(|&observed| observed == pois)
}

fn open(request: &Request, records: Records) -> GpuBackend {
    GpuBackend::new(gpu::open(request.clone()).unwrap()).unwrap().with_records(records)
}

/// Returns the bytes of the status words of this many workgroups.
fn status(workgroups: u64) -> u64 {
    4 * workgroups
}

/// Bytes that came from the device since the last call.
fn down(backend: &mut GpuBackend) -> u64 {
    backend.take_stages().traffic.down
}

fn config(text: &str) -> Config {
    Config::parse(text, "records.toml").unwrap()
}

/// `[[x, y], …]`, a step apart from each other.
fn line(count: usize, [x, y]: [f64; 2], [dx, dy]: [f64; 2]) -> String {
    let places = (0..count).map(|i| format!("[{:?}, {:?}]", x + i as f64 * dx, y + i as f64 * dy));
    format!("[{}]", places.collect::<Vec<_>>().join(", "))
}

/// Random worlds; more agents than a word has bits, more leaders than a byte tells apart, more POIs than threads.
fn worlds() -> Vec<Config> {
    let odd = [
        format!(
            "[world]\nleaders = {}\nfollowers = {}\npois = {}\nsteps = 12\ncoupling = [3, 20, 70]\n\
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
    ];
    let random = (0..28).map(|seed| {
        let mut config = sample::world(seed);
        // By such rules no record is packed.
        config.world.windows.clear();
        config.world.after.clear();
        config
    });
    random.chain(odd.iter().map(|text| config(text))).collect()
}

#[test]
fn scores_are_the_same_from_whole_and_packed_records() {
    let all: Vec<Teams> = worlds().iter().map(|config| Teams::new(config, 37, true)).collect();
    let expected: Vec<Vec<GroupScores>> = (0..2).map(|first| expected(&all, first)).collect();
    let different = expected[0].iter().flat_map(|scores| &scores.observed).filter(|&&observed| observed > 0).count();
    assert!(different > 100, "only {different} teams observe anything");
    for (request, info) in support::adapters("scores_are_the_same_from_whole_and_packed_records") {
        for (first, expected) in expected.iter().enumerate() {
            for (records, bytes) in [(Records::Whole, 1 << 28), (Records::Packed, 1 << 28), (Records::Packed, 1 << 15)]
            {
                let mut backend = open(&request, records).batched(bytes).playing(Kernel::Generic);
                let found = scores(&mut backend, &all, first);
                assert!(found == *expected, "{info}: fitnesses from {first} on, {records:?}, batches of {bytes} bytes");
            }
        }
        let mut checked = open(&Request { checked: true, ..request }, Records::Packed);
        assert!(scores(&mut checked, &all, 0) == expected[0], "{info}: checked");
    }
}

/// The canary: each part of the rule, changed in the shader, changes scores.
#[test]
fn a_changed_rule_is_noticed() {
    type Edit = fn(String) -> String;
    let edits: [Edit; 4] = [
        |text| text.replace("size >= enough", "size > enough"),
        |text| text.replace("if less != 0u", "if more == 0u"),
        |text| text.replace("step < sizes.steps", "step + 1u < sizes.steps"),
        |text| text.replace("if steps > most", "if steps >= most"),
    ];
    let all: Vec<Teams> = worlds().iter().map(|config| Teams::new(config, 37, true)).collect();
    let expected = expected(&all, 0);
    for (request, info) in support::adapters("a_changed_rule_is_noticed") {
        for (index, edit) in edits.into_iter().enumerate() {
            // SAFETY: the edits change comparisons and shorten a loop; every index stays in bounds.
            #[expect(unsafe_code, reason = "an edited shader is compiled without bounds checks")]
            let mut backend = unsafe { open(&request, Records::Packed).edited(edit) };
            assert!(scores(&mut backend, &all, 0) != expected, "{info}: edit {index} was not noticed");
        }
    }
}

/// Agents in single file at a steady pace: at every step another one is at the POI, so every set matters, the packed record
/// is as large as the whole one, and does not fit. Then nobody comes near a POI, and nothing matters.
#[test]
fn everything_or_nothing_may_matter() {
    let file = |poi: f64| {
        let text = format!(
            "[world]\nspeed = 1.5\nleaders = {}\npois = [[10.0, {poi:?}]]\nsteps = 24\ncoupling = 1\n\
             observation_radius = 0.14\n[policy]\nhidden = []",
            line(24, [10.0, 20.0], [0.0, -0.3])
        );
        vec![Teams::new(&config(&text), 500, false)]
    };
    let (dense, empty) = (file(20.3), file(45.0));
    let [for_dense, for_empty] = [&dense, &empty].map(|teams| expected(teams, 0));
    assert!(all_observed(&for_dense, 1) && all_observed(&for_empty, 0));
    let (whole, table) = (dense[0].whole(), 501 * 4);
    for (request, info) in support::adapters("everything_or_nothing_may_matter") {
        let mut backend = open(&request, Records::PackedFrom(0)).playing(Kernel::Generic);
        let mut play = |all: &[Teams], expected: &[GroupScores]| {
            assert!(scores(&mut backend, all, 0) == *expected, "{info}");
            down(&mut backend)
        };
        let first = play(&empty, &for_empty);
        assert!(first >= table && first < whole / 4, "{info}: {first} of {whole} bytes");
        let overflown = play(&dense, &for_dense);
        assert!(overflown > whole && overflown < whole + whole / 4, "{info}: {overflown} of {whole} bytes");
        assert_eq!(play(&dense, &for_dense), whole + 8 + status(100), "{info}: known to be dense");
        // It packs again once less matters.
        let again = (0..60).map(|_| play(&empty, &for_empty)).find(|&bytes| bytes < whole / 4);
        assert!(again.is_some(), "{info}: whole records for ever");
    }
}

/// Whole records come home where one dispatch cannot pack them, and where that is not worth it.
#[test]
fn whole_records_come_where_they_must() {
    let text = |steps: usize| {
        format!(
            "[world]\nleaders = [[10.0, 5.0], [20.0, 5.0]]\nfollowers = [[12.0, 2.0], [8.0, 2.0]]\n\
             pois = [[10.0, 15.0], [30.0, 40.0]]\nsteps = {steps}\ncoupling = 1\n[policy]\nhidden = []"
        )
    };
    let of = |steps: usize| vec![Teams::new(&config(&text(steps)), 20, true)];
    let (short, long, longest) = (of(100), of(3000), of(10_000));
    let [for_short, for_long, for_longest] = [&short, &long, &longest].map(|teams| expected(teams, 0));
    for (request, info) in support::adapters("whole_records_come_where_they_must") {
        let mut backend = open(&request, Records::PackedFrom(0)).playing(Kernel::Generic);
        // Several dispatches.
        assert!(scores(&mut backend, &long, 0) == for_long, "{info}");
        assert!(down(&mut backend) < long[0].whole(), "{info}: 3000 steps");
        assert!(scores(&mut backend, &longest, 0) == for_longest, "{info}");
        assert_eq!(down(&mut backend), longest[0].whole() + status(2), "{info}: 10 000 steps");
        let mut small = open(&request, Records::PackedFrom(1 << 20)).playing(Kernel::Generic);
        assert!(scores(&mut small, &short, 0) == for_short, "{info}");
        assert_eq!(down(&mut small), short[0].whole() + status(2), "{info}: not worth packing");
    }
}

/// Bytes over the bus, up and down, of every generation of generally forward under Df, its populations held, by team:
/// at 2^20 teams 100 MB are 95. More teams by `FLOTILLA_TEAMS`.
#[test]
fn a_generation_moves_less_than_95_bytes_a_team() {
    let mut config = support::layout("generally_forward");
    let teams = std::env::var("FLOTILLA_TEAMS").map_or(1 << 11, |teams| teams.parse().unwrap());
    (config.learning.trials, config.learning.population, config.learning.generations) = (1, teams, 60);
    config.learning.fitness = Fitness::Df;
    for (request, info) in support::adapters("a_generation_moves_less_than_95_bytes_a_team") {
        let mut backend = open(&request, Records::PackedFrom(0)).holding(ResidencyPolicy::Always);
        let mut trainer = Trainer::new([config.validate().unwrap()]);
        let mut before = backend.gpu().traffic();
        for generation in 0..=50 {
            let rows = trainer.advance(&mut backend).unwrap();
            let (whole, played) = (backend.gpu().traffic(), backend.take_stages().traffic);
            let held = (teams as u64 + 1) * 4 * 112 * 4;
            let traffic = whole - std::mem::replace(&mut before, whole);
            // The populations go up once.
            let up = traffic.up - if generation == 0 { held } else { 0 };
            let a_team = |bytes: u64| bytes as f64 / teams as f64;
            let mean_g = rows.first().map_or(0.0, |row| row.mean_g);
            println!(
                "{info}: generation {generation}, mean G of the last {mean_g:.2}: {:.1} bytes a team up ({:.1} of it \
                 rollouts), {:.1} down",
                a_team(up),
                a_team(played.up),
                a_team(traffic.down)
            );
            if [0, 50].contains(&generation) {
                assert!(a_team(up + traffic.down) * f64::from(1 << 20) <= 1e8, "{info}: generation {generation}");
            }
        }
    }
}

/// Whether a POI is observed may hang on when somebody was near: such records come whole. Whose presence counts does not.
#[test]
fn records_are_packed_only_where_time_does_not_matter() {
    let of = |change: fn(&mut Config)| {
        let mut config = config(include_str!("../configs/generally_forward.toml"));
        config.world.steps = 60;
        change(&mut config);
        vec![Teams::new(&config, 200, true)]
    };
    let cases: [(_, _, fn(&mut Config)); 4] = [
        ("by the default rule", true, |_| ()),
        ("observed by followers", true, |config| {
            (config.world.observers, config.world.coupling) = (Observers::Followers, Coupling::Same(2));
        }),
        ("at some steps", false, |config| config.world.windows = vec![[20, 40]; 4]),
        ("one after the other", false, |config| config.world.after = vec![vec![], vec![0], vec![0], vec![0]]),
    ];
    for (request, info) in support::adapters("records_are_packed_only_where_time_does_not_matter") {
        for (what, packed, change) in cases {
            let all = of(change);
            let expected = expected(&all, 0);
            assert!(!all_observed(&expected, 0), "{what}: nothing is observed");
            let mut backend = open(&request, Records::PackedFrom(0)).playing(Kernel::Generic);
            assert!(scores(&mut backend, &all, 0) == expected, "{info}, {what}");
            let moved = down(&mut backend);
            assert_eq!(moved < all[0].whole() / 2, packed, "{info}, {what}: {moved} bytes");
            // Dt asks when its followers were led: nothing is packed, and sights come with the rest.
            let expected = self::expected(&all, DT);
            assert!(scores(&mut backend, &all, DT) == expected, "{info}, {what}, Dt");
            let sights = (200 * 4 * all[0].world.sight_words()) as u64;
            assert_eq!(down(&mut backend), all[0].whole() + sights + status(10), "{info}, {what}, Dt");
        }
    }
}

/// Seconds that all threads have computed so far, whoever else did meanwhile (Linux counts in hundredths).
fn processor_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").expect("this is Linux");
    // After the name, which may hold blanks, the times are the 12th and the 13th.
    let fields = stat.rsplit(')').next().unwrap_or_default().split_whitespace().skip(11).take(2);
    fields.map(|ticks| ticks.parse::<f64>().expect("a count") / 100.0).sum()
}

/// What compiling takes: the first two generations of two teams less twice the third, of everything that a GPU would compile, and of
/// what a software renderer compiles by default. Drivers' caches have to be off (Mesa's by `MESA_SHADER_CACHE_DISABLE=true`).
#[test]
#[ignore = "prints a table"]
fn compiling() {
    let small = |mut config: Config| {
        (config.learning.population, config.learning.trials, config.learning.generations) = (2, 1, 9);
        config
    };
    let paper = [
        ("generally forward", include_str!("../configs/generally_forward.toml")),
        ("strictly forward", include_str!("../configs/strictly_forward.toml")),
        ("chaotic", include_str!("../configs/chaotic.toml")),
    ];
    let mut cases = Vec::new();
    for (name, text) in paper {
        for paradigm in [Paradigm::LeaderFollower, Paradigm::AllLeaders] {
            let mut config = small(config(text));
            config.learning.paradigm = paradigm;
            cases.push((format!("{name}, {paradigm:?}"), vec![config]));
        }
    }
    let sweep = Sweep::read(include_str!("../configs/sweeps/large.toml"), "large.toml", &[], false).unwrap();
    cases.push(("large.toml".into(), sweep.points.into_iter().map(|point| small(point.config)).collect()));
    for (request, info) in support::adapters("compiling") {
        for (name, configs) in &cases {
            let backend = || GpuBackend::new(gpu::open(request.clone()).unwrap()).unwrap();
            let gpu =
                backend().playing(Kernel::Best).holding(ResidencyPolicy::Always).with_records(Records::PackedFrom(0));
            for (what, mut backend) in [("by default", backend()), ("as on a GPU", gpu)] {
                let mut trainer = Trainer::new(ValidConfig::all(configs).unwrap());
                let mut seconds = || {
                    let start = processor_seconds();
                    trainer.advance(&mut backend).unwrap();
                    processor_seconds() - start
                };
                // Breeding is compiled while the second one waits for it.
                let (first, second, third) = (seconds(), seconds(), seconds());
                let [generic, specialised] = backend.compiled();
                println!(
                    "{name}, {what}: {:.2} s, {generic} generic and {specialised} specialised kernels, {info}",
                    first + second - 2.0 * third
                );
            }
        }
    }
}

/// The CPU's part of a generation: its phases on a device that plays only the first steps of each episode. By default of
/// 2^20 teams, more or fewer by `FLOTILLA_TEAMS`, with as many threads as `RAYON_NUM_THREADS` says.
#[test]
#[ignore = "prints a table"]
fn the_cpus_part_of_a_generation() {
    fn short(text: String) -> String {
        text.replace("step < task.end; step++", "step < min(task.end, task.first + 2u); step++")
    }
    let mut config = support::layout("generally_forward");
    let teams = std::env::var("FLOTILLA_TEAMS").map_or(1 << 20, |teams| teams.parse().unwrap());
    // A small generation is over too soon to be timed alone.
    let generations = (20_000 / teams).clamp(5, 400);
    (config.learning.trials, config.learning.population, config.learning.generations) = (1, teams, generations + 3);
    config.learning.fitness = Fitness::Df;
    // A leader's population has to fit into one buffer, of 128 MiB on lavapipe. The CPU moves no weights.
    config.policy.hidden = vec![];
    for (request, info) in support::adapters("the_cpus_part_of_a_generation") {
        let backend = open(&request, Records::PackedFrom(0)).holding(ResidencyPolicy::Always);
        // SAFETY: the edit only shortens a loop.
        #[expect(unsafe_code, reason = "edited shaders are compiled without bounds checks")]
        let mut backend = unsafe { backend.edited(short) };
        let mut trainer = Trainer::new([config.validate().unwrap()]);
        // Room for packed records is found by the first generations.
        for _ in 0..3 {
            trainer.advance(&mut backend).unwrap();
        }
        (_, _) = (trainer.take_times(), backend.take_stages());
        for _ in 0..generations {
            trainer.advance(&mut backend).unwrap();
        }
        let (times, stages) = (trainer.take_times(), backend.take_stages());
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
