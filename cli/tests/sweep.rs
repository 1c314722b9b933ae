//! Tests sweeps: the points of a sweep file, their division into shards, and the results.
//!
//! Results must not depend on shards, batches or kills.

use crate::support::{self, Place};
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use flotilla::backend::cpu::Cpu;
use flotilla::config::{Config, Coupling, Override, ValidConfig};
use flotilla::trainer::Trainer;
use flotilla_app::record::disk::Disk;
use flotilla_app::record::folder::{Folder, Start, StartFrom};
use flotilla_app::record::ownership::LIST;
use flotilla_app::sweep::shard::{Shard, cost};
use flotilla_app::sweep::{Sweep, layout, run};
use proptest::prelude::*;

/// Eight points of different couplings, steps and lengths.
const SMALL: &str = "\
[world]
leaders = [[10, 5], [20, 5]]
followers = [[12, 2], [8, 2], [22, 2], [18, 2]]
pois = [[10, 15], [20, 15]]
[learning]
population = 10
trials = 2
seed = 5
[checkpoint]
generations = 2
seconds = 0
[grid]
\"world.coupling\" = [1, 3]
\"world.steps\" = [8, 25]
\"learning.generations\" = [3, 12]
";

fn parse(text: &str) -> Sweep {
    Sweep::read(text, "x.toml", &[], false).unwrap_or_else(|error| panic!("{error}"))
}

fn parse_error(text: &str) -> String {
    Sweep::read(text, "x.toml", &[], false).unwrap_err().to_string()
}

/// Creates a folder with a sweep in `x.toml`. Commands run on the CPU.
fn place(sweep: &str) -> Place {
    Place::new(&[("x.toml", sweep)]).on_cpu().slow()
}

/// Creates a folder with a sweep over this many seeds.
fn place_of_seeds(points: usize) -> Place {
    let seeds: Vec<usize> = (0..points).collect();
    place(&format!("{}[grid]\n\"learning.seed\" = {seeds:?}\n", support::TINY))
}

/// Returns the command that trains the sweep into a folder.
fn line(out: &str, flags: &str) -> String {
    format!("sweep x.toml --out {out} {flags}")
}

/// Checks that a command succeeded. Returns its standard output.
fn succeed(output: Output) -> String {
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(0), "{error}");
    String::from_utf8(output.stdout).unwrap()
}

/// Checks the exit code. Returns standard error without warnings, because no agent reaches the POIs of these small
/// sweeps.
fn failure(output: Output, code: i32) -> String {
    let error = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(code), "{error}");
    error.split_inclusive('\n').filter(|line| !line.starts_with("warning: ")).collect()
}

/// Runs a command that must fail with this exit code. Its [`failure`] must contain all of `parts`, and is returned.
fn fail(place: &Place, code: i32, line: &str, parts: &[&str]) -> String {
    let error = failure(place.run(line), code);
    for part in parts {
        assert!(error.contains(part), "{line}: {part:?} is not in: {error}");
    }
    error
}

/// Returns the files of a folder, without its subfolders.
fn results(out: &Path) -> Vec<(String, Vec<u8>)> {
    let mut files: Vec<_> = fs::read_dir(out)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        // The list of written files is left out, because it keeps lines about earlier versions.
        .filter(|path| path.is_file() && !path.ends_with(LIST))
        .map(|path| (path.file_name().unwrap().to_str().unwrap().to_string(), fs::read(&path).unwrap()))
        .collect();
    files.sort();
    files
}

/// Returns the policies of every point.
fn policies(out: &Path) -> Vec<Vec<u8>> {
    let mut points: Vec<_> = fs::read_dir(out.join("points")).unwrap().map(|entry| entry.unwrap().path()).collect();
    points.sort();
    points.iter().map(|point| fs::read(point.join("policies.safetensors")).unwrap()).collect()
}

#[test]
fn the_first_axis_changes_slowest_and_every_point_has_its_values() {
    let sweep = parse(SMALL);
    let actual: Vec<_> = sweep
        .points
        .iter()
        .map(|point| {
            let Coupling::Same(coupling) = point.config.world.coupling else { panic!("a list of couplings") };
            (coupling, point.config.world.steps, point.config.learning.generations)
        })
        .collect();
    let expected = [(1, 8, 3), (1, 8, 12), (1, 25, 3), (1, 25, 12), (3, 8, 3), (3, 8, 12), (3, 25, 3), (3, 25, 12)];
    assert_eq!(actual, expected);
    assert_eq!(sweep.describe(&sweep.points[5]), "world.coupling = 3, world.steps = 8, learning.generations = 12");
    // The text that is written into the folder describes the same sweep.
    let reparsed = parse(&sweep.text);
    assert_eq!((reparsed.text.as_str(), &reparsed.points), (sweep.text.as_str(), &sweep.points));
}

#[test]
fn keys_need_no_quotes_and_values_may_be_lists() {
    let text = "[world]\nleaders = [[1, 1]]\npois = [[5, 5], [9, 9]]\n[grid]\nworld.coupling = [1, [1, 1]]\n\
                policy.hidden = [[4], [6, 5]]\n";
    let sweep = parse(text);
    assert_eq!(sweep.points.len(), 4);
    assert_eq!(sweep.points[2].config.world.coupling, Coupling::Each(vec![1, 1]));
    assert_eq!(sweep.points[3].config.policy.hidden, [6, 5]);
}

/// Returns the config of a layout with this many followers per leader and this many groups.
fn config_of_layout(followers: usize, groups: usize) -> Config {
    let text = format!(
        "[world]\ncoupling = 1\n[learning]\npopulation = 2\n\
         [grid]\nfollowers_per_leader = [{followers}]\ngroups = [{groups}]\n"
    );
    parse(&text).points.remove(0).config.into_config()
}

#[test]
fn axes_reproduce_the_papers_layouts() {
    for (name, followers) in [("generally_forward", 2), ("chaotic", 4)] {
        let paper = Config::load(&crate::support::root(&format!("configs/{name}.toml"))).unwrap().world;
        let world = config_of_layout(followers, 4).world;
        let set = |places: &[[f64; 2]]| places.iter().map(|place| place.map(f64::to_bits)).collect::<BTreeSet<_>>();
        assert_eq!((world.map, &world.leaders, &world.pois), (paper.map, &paper.leaders, &paper.pois), "{name}");
        assert_eq!(set(&world.followers), set(&paper.followers), "{name}");
        assert_eq!(world.followers.len(), paper.followers.len(), "{name}");
    }
}

#[test]
fn any_layout_keeps_agents_apart_and_on_the_map() {
    let reach = config_of_layout(0, 1).follow.attraction_radius;
    for groups in [1, 2, 4, 15] {
        for followers in 0..=layout::MAX_FOLLOWERS {
            let world = config_of_layout(followers, groups).world;
            assert_eq!(world.followers.len(), groups * followers);
            assert_eq!(world.pois.len(), groups);
            let distance = |a: &[f64; 2], b: &[f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
            let agents = [&world.leaders[..], &world.followers[..]].concat();
            for (index, agent) in agents.iter().enumerate() {
                assert!(agents[..index].iter().all(|other| distance(agent, other) >= 1.0), "{followers} × {groups}");
                assert!(agent.iter().zip(&world.map).all(|(&at, &side)| at >= 1.0 && at <= side - 1.0));
                assert!(world.pois.iter().all(|poi| distance(agent, poi) > world.observation_radius));
            }
            for (index, follower) in world.followers.iter().enumerate() {
                let own = &world.leaders[index / followers];
                assert!(distance(follower, own) <= reach, "a follower starts outside its leader's attraction radius");
                assert!(world.leaders.iter().all(|leader| distance(follower, own) <= distance(follower, leader)));
            }
        }
    }
}

#[test]
fn places_of_followers_do_not_depend_on_their_number() {
    let places = layout::places();
    assert_eq!(places.len(), layout::MAX_FOLLOWERS);
    assert_eq!(places[..4], [[2, -3], [-2, -3], [2, 2], [-2, 2]]);
    let ten = config_of_layout(10, 1).world.followers;
    assert_eq!(config_of_layout(7, 1).world.followers, ten[..7]);
}

#[test]
fn flags_count_as_if_they_were_in_the_file() {
    let text = "[learning]\npopulation = 4\n[grid]\ngroups = [1, 2]\n[vary]\n\"world.map\" = [[80, 60]]\n";
    let read = |key: &str, value: &str| {
        let flag = Override::new(key, value.parse::<toml::Value>().unwrap(), "--set");
        Sweep::read(text, "x.toml", &[flag], false)
    };
    let sweep = read("world.pois", "[[20, 20], [30, 30]]").unwrap();
    assert!(sweep.points.iter().all(|point| point.config.world.pois == [[20.0, 20.0], [30.0, 30.0]]));
    // The map is laid out where it is not varied.
    let maps: Vec<_> = sweep.points.iter().map(|point| point.config.world.map == [80.0, 60.0]).collect();
    assert_eq!(maps, [false, true, false, true]);
    let again = Sweep::read(&sweep.text, "sweep.toml", &[], false).unwrap();
    let configs = |sweep: &Sweep| sweep.points.iter().map(|point| point.config.clone()).collect::<Vec<_>>();
    assert_eq!(configs(&again), configs(&sweep));
    let error = read("world.leaders", "[[1, 1]]").unwrap_err().to_string();
    assert!(error.contains("grid.groups: it lays out world.leaders, which is given too"), "{error}");
}

#[test]
fn errors_in_sweeps_name_the_line() {
    let error_of = |grid: &str| parse_error(&SMALL.replace("\"world.coupling\" = [1, 3]", grid));
    for [grid, expected] in support::table(include_str!("refusals/grid.txt"), 15) {
        let error = error_of(&grid);
        assert!(error.contains(&expected), "{grid}: {error}");
    }
    let without = SMALL.split("[grid]").next().unwrap();
    assert!(parse_error(without).contains("missing, a sweep has a section [grid]"));
    assert!(parse_error(&format!("{without}[grid]\n")).contains("it has no axis"));
    assert!(parse_error(&format!("grid = 3\n{without}")).contains("x.toml:1: grid: allowed a section [grid]"));
    let many: Vec<_> = (0..100).map(|value| value.to_string()).collect();
    let axis = |key: &str| format!("\"{key}\" = [{}]\n", many.join(", "));
    let huge =
        [without, "[grid]\n", &axis("learning.seed"), &axis("world.steps"), &axis("learning.population")].concat();
    assert!(parse_error(&huge).contains("found 100 × 100 × 100 points, allowed 1 to 65536"), "{}", parse_error(&huge));
}

#[test]
fn impossible_points_are_reported_together_or_skipped_on_request() {
    let text = SMALL.replace("[1, 3]", "[1, 6, 7, 8]").replace("\"world.steps\" = [8, 25]", "");
    let error = parse_error(&text);
    for line in ["[2]: found 7, allowed 1 to 6 (the number of agents)", "[3]: found 8, allowed 1 to 6"] {
        assert!(error.contains(line), "{error}");
    }
    assert!(error.contains("at 2 of 8 points, the first world.coupling = 7, learning.generations = 3"), "{error}");
    // A value that is impossible at every point is an error even if impossible points are skipped.
    let error = Sweep::read(&text, "x.toml", &[], true).unwrap_err().to_string();
    assert!(error.contains("found 7") && error.contains("found 8"), "{error}");

    let triangle =
        "[learning]\npopulation = 2\n[grid]\nfollowers_per_leader = [0, 1, 2]\n\"world.coupling\" = [4, 8, 12]\n";
    assert!(parse_error(triangle).contains("--skip-impossible leaves such points out"), "{}", parse_error(triangle));
    for sweep in
        [Sweep::read(triangle, "x.toml", &[], true).unwrap(), parse(&format!("{triangle}skip_impossible = true\n"))]
    {
        assert_eq!((sweep.points.len(), sweep.skipped), (6, 3));
        assert_eq!(sweep.points.iter().map(|point| point.index).collect::<Vec<_>>(), [0, 3, 4, 6, 7, 8]);
    }
}

/// Returns a sweep with two fitnesses. For each fitness, two other keys change one at a time.
fn varied() -> String {
    let base = SMALL.split("[grid]").next().unwrap().replace("seed = 5", "seed = 5\ngenerations = 6");
    let grid = "[grid]\n\"learning.fitness\" = [\"G\", \"Df\"]\n";
    base + grid + "[vary]\n\"learning.generations\" = [3, 12]\nworld.coupling = [1, 7]\n"
}

#[test]
fn varied_keys_change_one_at_a_time() {
    let text = varied().replace("[1, 7]", "[1, 2]");
    let sweep = parse(&text);
    let descriptions: Vec<_> = sweep.points.iter().map(|point| sweep.describe(point)).collect();
    let changes = [
        "",
        ", learning.generations = 3",
        ", learning.generations = 12",
        ", world.coupling = 1",
        ", world.coupling = 2",
    ];
    let expected: Vec<_> =
        ["G", "Df"].iter().flat_map(|f| changes.map(|change| format!("learning.fitness = {f}{change}"))).collect();
    assert_eq!(descriptions, expected);
    for (index, point) in sweep.points.iter().enumerate() {
        let (generations, coupling) = [(6, 3), (3, 3), (12, 3), (6, 1), (6, 2)][index % 5];
        assert_eq!(point.config.learning.generations, generations);
        assert_eq!(point.config.world.coupling, Coupling::Same(coupling));
    }
    // The first value of a varied key is the file's value, or the default if the file has none.
    assert_eq!((sweep.axes[1].label(0), sweep.axes[2].label(0)), ("6".into(), "3".into()));
    let reparsed = parse(&sweep.text);
    assert_eq!((reparsed.text.as_str(), &reparsed.points), (sweep.text.as_str(), &sweep.points));

    // Without a grid, the only combination is the file's own.
    let without_grid = text.replace("[grid]\n\"learning.fitness\" = [\"G\", \"Df\"]\n", "");
    let without_grid = parse(&without_grid);
    assert_eq!(
        (without_grid.points.len(), without_grid.describe(&without_grid.points[0]).as_str()),
        (5, "as in the file")
    );
    assert_eq!(without_grid.describe(&without_grid.points[4]), "world.coupling = 2");
    assert_eq!(parse(&without_grid.text).points, without_grid.points);
}

#[test]
fn keys_that_set_the_same_are_refused() {
    const RIVER: &str = "[world]\n[[agents]]\nname = \"boat\"\nat = [[1, 1]]\nsenses = [{ of = \"pois\" }]\n\
                         [[pois]]\nname = \"buoy\"\nat = [[9, 9]]\ncoupling = 1\n[grid]\n";
    let range = "\"agents.boat.senses[0].range\" = [1.0, 2.0]\n";
    for keys in [
        "\"agents.boat.speed\" = [1.0]\n\"agents[0].speed\" = [2.0]\n",
        &format!("{range}\"agents.boat.senses\" = [[{{ of = \"pois\" }}]]\n"),
        &format!("{range}[vary]\n\"agents[0].senses[0].range\" = [3.0]\n"),
    ] {
        let error = parse_error(&format!("{RIVER}{keys}"));
        assert!(error.contains("sets the same; leave one of them out"), "{error}");
    }
    let other = "\"agents.boat.senses[0].nearest\" = [1.0, 2.0]\n";
    assert_eq!(Sweep::read(&format!("{RIVER}{range}{other}"), "x.toml", &[], false).unwrap().points.len(), 4);
    let flags = [Override::of_text("agents[0].senses", "[]", "--set")];
    let error = Sweep::read(&format!("{RIVER}{range}"), "x.toml", &flags, false).unwrap_err().to_string();
    assert!(error.contains("the grid has agents.boat.senses[0].range already"), "{error}");
}

#[test]
fn errors_in_varied_keys_name_the_line() {
    let error_of = |keys: &str| parse_error(&varied().replace("world.coupling = [1, 7]", keys));
    for [keys, expected] in support::table(include_str!("refusals/vary.txt"), 10) {
        let error = error_of(&keys);
        assert!(error.contains(&expected), "{keys}: {error}");
    }
    let base = SMALL.split("[grid]").next().unwrap();
    assert!(parse_error(&format!("{base}[vary]\n")).contains("x.toml:12: vary: it has no key"));
    assert!(parse_error(&format!("vary = 3\n{base}")).contains("x.toml:1: vary: allowed a section [vary]"));
    let flag = Override::new("learning.generations", 5, "--generations");
    let error = Sweep::read(&varied(), "x.toml", &[flag], true).unwrap_err().to_string();
    assert!(error.contains("--generations: [vary] has learning.generations already"), "{error}");
    // If one of two values is impossible, only that value is skipped.
    let grid = varied().replace(
        "[\"G\", \"Df\"]",
        "[\"G\"]\n\"world.followers\" = [[[12, 2]], [[12, 2], [8, 2], [9, 2], [7, 2], [6, 2]]]",
    );
    let sweep = Sweep::read(&grid, "x.toml", &[], true).unwrap_or_else(|error| panic!("{error}"));
    assert_eq!((sweep.points.len(), sweep.skipped), (9, 1));
}

#[test]
fn a_varied_sweep_has_columns_and_a_picture_of_its_keys() {
    let place = place(&varied());
    let [unsharded, sharded] = ["unsharded", "sharded"].map(|name| place.path(name));
    let skip = "--skip-impossible";
    fail(&place, 1, &line("unsharded", ""), &["found 7"]);
    place.write("x.toml", varied().replace("[1, 7]", "[1, 2]"));
    place.prints(&line("unsharded", "--list"), &["learning.fitness = Df, world.coupling = 2\n"]);
    let parts = ["10 of 10 points are done", "  final (.svg, .png, .pdf)"];
    place.prints(&line("unsharded", &format!("--quiet {skip}")), &parts);

    let table = place.read("unsharded/points.csv");
    let rows: Vec<Vec<&str>> = table.lines().map(|line| line.split(',').collect()).collect();
    assert_eq!(rows[0][..4], ["learning.fitness", "learning.generations", "world.coupling", "point"]);
    let axes: Vec<&[&str]> = rows[1..].iter().map(|row| &row[..3]).collect();
    assert_eq!(axes[..3], [["G", "6", "3"], ["G", "3", "3"], ["G", "12", "3"]]);
    assert_eq!(axes[8..], [["Df", "6", "1"], ["Df", "6", "2"]]);
    let names: Vec<String> = results(&unsharded).into_iter().map(|(name, _)| name).collect();
    assert_eq!(names, ["final.pdf", "final.png", "final.svg", "points.csv", "results.csv", "sweep.toml"]);

    let picture = place.read("unsharded/final.svg");
    assert!(picture.contains("as in the file; generations (6): 3 "), "{}", &picture[..800]);
    // Every varied value is a dot. The file's own values are lines.
    assert_eq!(picture.matches("<circle").count(), 8);

    for shard in ["1/2", "2/2"] {
        place.good(&line("sharded", &format!("--quiet {skip} --shard {shard}")));
    }
    // Nothing is impossible, so the flag makes no other sweep.
    place.good(&line("sharded", "--collect"));
    assert_eq!(results(&unsharded), results(&sharded));
    fail(&place, 2, &line("unsharded", "--collect --axes coupling"), &["one picture"]);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn shards_divide_the_points_evenly(
        steps in prop::collection::btree_set(1usize..2000, 1..12),
        populations in prop::collection::btree_set(2usize..200, 1..6),
        count in 1usize..20,
    ) {
        let text = SMALL.split("[grid]").next().unwrap().to_string()
            + &format!("[grid]\n\"world.steps\" = {steps:?}\n\"learning.population\" = {populations:?}\n")
                .replace('{', "[").replace('}', "]");
        let sweep = parse(&text);
        let shards: Vec<_> = (1..=count).map(|index| Shard::new(index, count).unwrap().take(&sweep.points)).collect();
        let mut taken: Vec<_> = shards.iter().flatten().map(|point| point.index).collect();
        taken.sort_unstable();
        prop_assert_eq!(taken, (0..sweep.points.len()).collect::<Vec<_>>());
        // The assignment is greedy, so that loads differ by the cost of one point at most.
        let largest = sweep.points.iter().map(cost).max().unwrap();
        let loads: Vec<u128> = shards.iter().map(|points| points.iter().map(|point| cost(point)).sum()).collect();
        prop_assert!(loads.iter().max().unwrap() - loads.iter().min().unwrap() <= largest);
    }

    #[test]
    fn no_text_makes_a_sweep_panic(text in "(\\[grid\\]\n)?([a-z.\"]{0,12} ?= ?[\\[\\]0-9a-z,.\"{}]{0,20}\n){0,6}") {
        let _ = Sweep::read(&text, "x.toml", &[], true);
    }
}

#[test]
fn the_shard_is_read_from_the_variables_of_job_arrays() {
    let shard = |pairs: &[(&str, &str)]| {
        let pairs = pairs.to_vec();
        Shard::from_env(move |name| pairs.iter().find(|(key, _)| *key == name).map(|(_, value)| value.to_string()))
    };
    let slurm = |id, min, step| {
        shard(&[
            ("SLURM_ARRAY_TASK_ID", id),
            ("SLURM_ARRAY_TASK_COUNT", "4"),
            ("SLURM_ARRAY_TASK_MIN", min),
            ("SLURM_ARRAY_TASK_STEP", step),
        ])
    };
    assert_eq!(shard(&[]), Ok(None));
    assert_eq!(slurm("1", "1", "1"), Ok(Some(Shard { index: 1, count: 4 })));
    assert_eq!(slurm("0", "0", "1"), Ok(Some(Shard { index: 1, count: 4 })));
    assert_eq!(slurm("16", "10", "2"), Ok(Some(Shard { index: 4, count: 4 })));
    assert!(slurm("17", "10", "2").unwrap_err().contains("does not fit"));
    assert!(slurm("9", "1", "1").unwrap_err().contains("there is no shard 9 of 4"));
    let kubernetes = [("JOB_COMPLETION_INDEX", "2"), ("FLOTILLA_SHARDS", "3")];
    assert_eq!(shard(&kubernetes), Ok(Some(Shard { index: 3, count: 3 })));
    assert!(shard(&kubernetes[..1]).unwrap_err().contains("FLOTILLA_SHARDS"));
    assert!(
        shard(&[("JOB_COMPLETION_INDEX", "x"), ("FLOTILLA_SHARDS", "3")]).unwrap_err().contains("not a whole number")
    );
}

#[test]
fn batches_fit_in_memory() {
    let sweep = parse(SMALL);
    let points: Vec<_> = sweep.points.iter().collect();
    let single = run::bytes(&points[0].config);
    assert!(single as u64 > points[0].config.policy_bytes());
    for memory in [0, single, 2 * single, 3 * single, usize::MAX] {
        let batches = run::batches(&points, memory);
        assert_eq!(batches.concat().iter().map(|point| point.index).collect::<Vec<_>>(), (0..8).collect::<Vec<_>>());
        for batch in batches {
            let used: usize = batch.iter().map(|point| run::bytes(&point.config)).sum();
            assert!(used <= memory || batch.len() == 1);
        }
    }
}

#[test]
fn collected_shards_equal_the_unsharded_sweep() {
    let place = place(SMALL);
    let unsharded = place.path("unsharded");
    place.prints(&line("unsharded", "--quiet"), &["8 of 8 points are done"]);
    let expected = results(&unsharded);
    assert_eq!(
        expected.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>(),
        [
            "curves.pdf",
            "curves.png",
            "curves.svg",
            "final.pdf",
            "final.png",
            "final.svg",
            "points.csv",
            "reach.pdf",
            "reach.png",
            "reach.svg",
            "results.csv",
            "sweep.toml"
        ]
    );
    // Heat maps and curves have the same label for G, and explain their colours.
    for (picture, labels) in [
        ("final.svg", &["G of the champion", "mean over trials; below: 95 % interval"][..]),
        // No trial reaches it, so there are no colours to explain.
        ("reach.svg", &["Generations until G of the champion is 0.75, median over trials", "never"]),
        ("curves.svg", &["G of the champion", "mean and 95 % interval over 2 trials"]),
    ] {
        let svg = place.read(Path::new("unsharded").join(picture));
        for label in labels {
            assert!(svg.contains(&format!("aria-label=\"{label}\"")), "{picture}: {label}");
        }
    }
    let text = place.read("unsharded/results.csv");
    let head = "world.coupling,world.steps,learning.generations,point,trial,generation,best_g,mean_g,champion_g";
    assert_eq!(text.lines().next(), Some(head));
    // Two trials each of 4 points with 3 generations and 4 points with 12, each plus generation 0.
    assert_eq!(text.lines().count(), 1 + 2 * (4 * 4 + 4 * 13));

    place.good(&line("unsharded", "--collect --measure best --band error"));
    let svg = place.read("unsharded/final.svg");
    assert!(svg.contains("G of the best team") && svg.contains("below: ± standard error"), "{svg}");

    for count in [2, 3, 11] {
        let out = format!("{count}");
        for index in (1..=count).rev() {
            if index == 1 {
                fail(&place, 1, &line(&out, "--collect"), &["points are missing", "it was not run"]);
            }
            // Shards also differ in the size of their batches.
            let memory = if index % 2 == 0 { "0.00001" } else { "1" };
            place.good(&line(&out, &format!("--quiet --shard {index}/{count} --memory {memory}")));
        }
        place.good(&line(&out, "--collect"));
        assert!(results(&place.path(&out)) == expected, "{count} shards");
        assert!(policies(&place.path(&out)) == policies(&unsharded), "{count} shards");
    }

    // A point equals a run with the same config.
    place.good("train unsharded/points/0003/config.toml --out alone --quiet");
    assert!(support::results(&place.path("alone")) == support::results(&unsharded.join("points/0003")));
}

#[test]
fn results_have_every_fifth_generation_and_the_last() {
    let place = place(SMALL);
    let out = place.path("out");
    place.good(&line("out", "--quiet --every 5 --reach 0.5 --axes steps"));
    let mut table = csv::Reader::from_path(out.join("results.csv")).unwrap();
    let rows: Vec<(usize, usize, usize)> = table
        .records()
        .map(|row| row.unwrap())
        .map(|row| (row[3].parse().unwrap(), row[4].parse().unwrap(), row[5].parse().unwrap()))
        .collect();
    let first: Vec<_> = rows.iter().filter(|row| row.0 <= 1 && row.1 == 0).map(|row| row.2).collect();
    assert_eq!(first, [0, 3, 0, 5, 10, 12]);

    // points.csv agrees with the metrics of every point.
    let mut points = csv::Reader::from_path(out.join("points.csv")).unwrap();
    for point in points.records() {
        let point = point.unwrap();
        let index: usize = point[3].parse().unwrap();
        let metrics = place.read(format!("out/points/{index:04}/metrics.csv"));
        let rows: Vec<Vec<f64>> =
            metrics.lines().skip(1).map(|line| line.split(',').map(|field| field.parse().unwrap()).collect()).collect();
        let last = rows.iter().map(|row| row[1]).fold(0.0, f64::max);
        for (place, column) in [(6, 4), (9, 2)] {
            let ends: Vec<f64> = rows.iter().filter(|row| row[1] == last).map(|row| row[column]).collect();
            assert_eq!(point[place].parse::<f64>().unwrap(), (ends[0] + ends[1]) / 2.0, "{point:?}");
        }
        let [mean, low, high] = [6, 7, 8].map(|place| point[place].parse::<f64>().unwrap());
        assert!(0.0 <= low && low <= mean && mean <= high && high <= 1.0 && low < high, "{point:?}");
        let first = |trial: f64| rows.iter().find(|row| row[0] == trial && row[4] >= 0.5).map(|row| row[1]);
        let reached = [first(0.0), first(1.0)];
        assert_eq!(point[11].parse::<usize>().unwrap(), reached.iter().flatten().count());
        let median = reached[0].zip(reached[1]).map(|(a, b)| (a + b) / 2.0);
        assert_eq!(point[12].parse::<f64>().ok(), median, "{point:?}");
    }
    fail(
        &place,
        2,
        &line("out", "--collect --axes radius"),
        &["it has world.coupling, world.steps, learning.generations"],
    );
    fail(&place, 2, &line("out", "--collect --axes steps,world.steps"), &["--axes: world.steps twice"]);
    // Windows does not replace open files.
    drop((table, points));
    place.good(&line("out", "--collect --axes steps,world.coupling"));
}

#[test]
fn a_large_sweep_prints_its_best_and_its_worst_points() {
    for points in [12, 15] {
        let place = place_of_seeds(points);
        let text = place.good(&line("out", "--quiet")).0;
        let mut table = csv::Reader::from_path(place.path("out/points.csv")).unwrap();
        let column = table.headers().unwrap().iter().position(|name| name == "champion_g").unwrap();
        let mut means: Vec<f64> = table.records().map(|row| row.unwrap()[column].parse().unwrap()).collect();
        means.sort_by(|a, b| b.total_cmp(a));
        let mut expected: Vec<String> = means.iter().map(|mean| format!("  {mean:.3}")).collect();
        if points == 15 {
            expected.splice(6..9, ["  … (3 more)".to_string()]);
        }
        let is_listed = |line: &&str| line.contains("learning.seed = ") || line.contains('…');
        let listed: Vec<&str> = text.lines().filter(is_listed).collect();
        assert_eq!(listed.len(), expected.len(), "{text}");
        assert!(listed.iter().zip(&expected).all(|(line, start)| line.starts_with(start)), "{expected:?}: {text}");
    }
}

/// Returns a sweep that takes long enough to be killed halfway.
fn long() -> String {
    SMALL.replace("[3, 12]", "[40, 120]").replace("[8, 25]", "[100, 101]")
}

/// Returns every complete checkpoint in a sweep's folder.
fn checkpoints(out: &Path) -> BTreeSet<PathBuf> {
    let points = fs::read_dir(out.join("points")).into_iter().flatten().flatten();
    let files = points.flat_map(|point| fs::read_dir(point.path().join("checkpoints")).into_iter().flatten().flatten());
    let is_complete = |path: &PathBuf| path.extension().is_some_and(|extension| extension == "safetensors");
    files.map(|file| file.path()).filter(is_complete).collect()
}

/// Starts a shard and waits until it has written a new checkpoint to `out`, or has finished.
fn start_until_checkpoint(place: &Place, flags: &str) -> Child {
    let out = &place.path("out");
    let before = checkpoints(out);
    let mut command = support::flotilla();
    command.current_dir(place.root()).args(line("out", flags).split_whitespace()).args(["--backend", "cpu"]);
    let mut child = command.stderr(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap();
    let start = Instant::now();
    while checkpoints(out).is_subset(&before) && child.try_wait().unwrap().is_none() {
        assert!(start.elapsed() < Duration::from_secs(60), "no checkpoint in a minute");
        std::thread::sleep(Duration::from_millis(1));
    }
    child
}

#[test]
fn killed_shards_resume_to_the_same_bytes() {
    let place = place(&long());
    let [out, uninterrupted] = ["out", "uninterrupted"].map(|name| place.path(name));
    place.good(&line("uninterrupted", "--quiet"));

    let shards = ["1/2", "2/2"];
    let mut interrupted = [0; 2];
    for (at, shard) in shards.into_iter().enumerate() {
        // Stops each shard three times, after different pauses: the first with SIGKILL, the second with SIGTERM. Windows
        // has no SIGTERM, so both are killed there.
        for pause in [0, 15, 40] {
            let mut child = start_until_checkpoint(&place, &format!("--quiet --resume --shard {shard} --band none"));
            std::thread::sleep(Duration::from_millis(pause));
            if at == 0 || cfg!(windows) {
                let _ = child.kill();
                interrupted[at] += usize::from(!child.wait().unwrap().success());
            } else {
                let id = child.id().to_string();
                let _ = Command::new("kill").args(["-TERM", &id]).status().unwrap();
                let output = child.wait_with_output().unwrap();
                let message = String::from_utf8(output.stderr).unwrap();
                assert!(matches!(output.status.code(), Some(75 | 0)), "{message}");
                if output.status.code() == Some(75) {
                    interrupted[at] += 1;
                    let command = message.lines().last().unwrap();
                    assert!(message.starts_with("stopped: everything is saved; continue with"), "{message}");
                    assert!(command.contains("--backend cpu --band none --shard 2/2 --resume"), "{message}");
                }
            }
        }
    }
    assert!(!interrupted.contains(&0), "shards finished before they were stopped: {interrupted:?}");
    fail(&place, 1, &line("out", "--quiet --shard 1/2"), &[]);
    // Points resume at generations of their own: one loses its checkpoints, another its whole folder.
    fs::remove_dir_all(out.join("points/0001/checkpoints")).unwrap();
    fs::remove_dir_all(out.join("points/0002")).unwrap();
    for shard in shards {
        place.good(&line("out", &format!("--quiet --resume --shard {shard}")));
    }
    place.good(&line("out", "--collect"));
    assert!(results(&out) == results(&uninterrupted));
    assert!(policies(&out) == policies(&uninterrupted));
    // Finished points are not trained again.
    let before = fs::read(out.join("points/0000/run.json")).unwrap();
    place.good(&line("out", "--quiet --resume"));
    assert!(fs::read(out.join("points/0000/run.json")).unwrap() == before);
}

#[test]
fn wrong_usage_is_refused_before_any_work() {
    let place = place(SMALL);
    let out = place.path("out");
    for (shard, expected) in [
        ("5/4", "there is no shard 5 of 4; they are 1/4 to 4/4"),
        ("0/4", "there is no shard 0 of 4"),
        ("1/0", "found 0 shards"),
        ("x", "allowed I/N"),
        ("-1/2", "allowed I/N"),
        ("1/99999999999", "allowed 1 to 65536"),
    ] {
        fail(&place, 2, &line("out", &format!("--shard {shard}")), &[expected]);
    }
    fail(
        &place,
        2,
        &line("out", "--seed 3 --skip-impossible --generations 3"),
        &["--generations: the grid has learning.generations already"],
    );
    let mut array = place.command();
    array.args(line("out", "--backend cpu").split_whitespace()).env("JOB_COMPLETION_INDEX", "1");
    let error = failure(array.output().unwrap(), 2);
    assert!(error.contains("FLOTILLA_SHARDS"), "{error}");
    fail(&place, 2, &line("out", "--collect"), &["holds no sweep"]);
    place.write("other.toml", SMALL.replace("[1, 3]", "[1, 9]"));
    fail(&place, 1, "sweep other.toml --out out", &["other.toml:13: ", "found 9, allowed 1 to 6"]);
    place.write("other.toml", SMALL.replace("[1, 3]", "[]"));
    fail(&place, 1, "sweep other.toml --out out", &["found no values"]);
    fail(&place, 1, "sweep out --out out", &["cannot be read"]);
    fail(&place, 1, &line("x.toml", ""), &["is a file; choose a folder"]);
    assert!(!out.exists(), "nothing was written");
}

#[test]
fn a_folder_with_another_sweep_or_a_run_is_refused() {
    let place = place(SMALL);
    let out = place.path("out");
    place.good(&line("out", "--quiet"));
    let before = results(&out);
    place.write("other.toml", SMALL.replace("[1, 3]", "[1, 2, 3]"));
    let parts = [
        "holds another sweep",
        "`flotilla sweep out/sweep.toml --out out --resume`",
        "there: \"world.coupling\" = [1, 3]",
        "here: \"world.coupling\" = [1, 2, 3]",
    ];
    for flags in ["--resume", "--force", "--collect", "--shard 1/3", ""] {
        let error = fail(&place, 1, &format!("sweep other.toml --out out {flags}"), &parts);
        assert!(!error.contains('…'), "{error}");
    }
    // At most eight lines are shown of each.
    let keys = ["seed=6", "population=12", "trials=3", "fitness='G'", "episodes_per_team=2"];
    let keys = keys.into_iter().chain(["start_jitter=1.0", "poi_jitter=1.0", "hall_of_fame=1", "elites=3"]);
    let set: String = keys.map(|key| format!(" --set learning.{key}")).collect();
    let error = fail(&place, 1, &line("out", &format!("--resume{set}")), &[]);
    assert!(error.matches("\n  here: ").count() == 8 && error.matches('…').count() == 1, "{error}");
    // Another seed makes another sweep. Another comment does not.
    fail(&place, 1, &line("out", "--seed 6 --resume"), &["there: seed = 5"]);
    place.write("x.toml", format!("# The same.\n{SMALL}"));
    place.good(&line("out", "--quiet --resume --skip-impossible"));
    assert!(results(&out) == before);
    // A file that is cut off is damaged, and not another sweep.
    let text = place.read("out/sweep.toml");
    place.write("out/sweep.toml", &text[..20]);
    let damaged = "sweep.toml is damaged; restore it, or choose another --out";
    for flag in ["--resume", "--force"] {
        fail(&place, 1, &line("out", &format!("--quiet {flag}")), &[damaged]);
    }
    place.write("out/sweep.toml", text);
    // A sweep does not write into a run's folder.
    fail(&place, 1, &line("out/points/0000", ""), &["holds a run, not a sweep"]);
    // A finished sweep needs --resume or --force. With --force, it is trained again to the same results.
    fail(&place, 1, &line("out", "--quiet"), &["--resume"]);
    place.good(&line("out", "--quiet --force"));
    assert!(results(&out) == before);
}

/// Tests that files with the names of results are overwritten only beside a sweep.toml, which a user may have written.
#[test]
fn files_of_others_in_a_sweeps_folder_are_not_overwritten() {
    let place = place(SMALL);
    for name in ["results.csv", "points.csv", "final.svg"] {
        fs::create_dir(place.path(name)).unwrap();
        place.write(Path::new(name).join(name), "mine");
        fail(&place, 1, &line(name, "--quiet --force"), &[&format!("holds {name} but no sweep.toml")]);
        assert_eq!(place.read(Path::new(name).join(name)), "mine");
    }
    // This sweep was started by hand.
    fs::create_dir(place.path("own")).unwrap();
    let text = format!("# Mine.\n{SMALL}");
    place.write("own/sweep.toml", &text);
    place.good("sweep own/sweep.toml --out own --quiet");
    assert_eq!(place.read("own/sweep.toml"), text);
    // A point may be resumed with another interval of checkpoints, which does not change its results.
    let point = "own/points/0000";
    fs::remove_file(place.path(point).join("run.json")).unwrap();
    place.good(&format!("train {point}/config.toml --out {point} --resume --checkpoint-seconds 5 --quiet"));
    place.good("sweep own/sweep.toml --out own --collect");
    // A sweep that needs more memory than any machine has is refused before anything starts.
    let grid =
        "[grid]\n\"learning.population\" = [1048576]\n\"policy.hidden\" = [[64, 64]]\n\"learning.trials\" = [1000]";
    place.write("huge.toml", SMALL.replacen("[grid]", grid, 1));
    fail(&place, 1, "sweep huge.toml --out huge --quiet", &["GiB"]);
    assert!(!place.path("huge/sweep.toml").exists());
}

/// Tests that --force overwrites nothing while another process trains a point, whatever its batch.
#[test]
fn nothing_is_overwritten_while_another_process_trains_a_point() {
    let place = place(SMALL);
    let out = place.path("out");
    place.good(&line("out", "--quiet"));
    let all_files = || {
        let points = (0..8).map(|point| out.join(format!("points/{point:04}")));
        let files = points.flat_map(|point| [results(&point), results(&point.join("checkpoints"))]);
        (results(&out), files.collect::<Vec<_>>())
    };
    let before = all_files();
    let point = out.join("points").join("0005");
    let config = Config::load(&point.join("config.toml")).unwrap();
    let lock = Folder::open(&point, Start::Resume, &config, StartFrom::Unspecified, Disk::default()).unwrap();
    for memory in ["1", "0.000001"] {
        let error = fail(&place, 1, &line("out", &format!("--quiet --force --memory {memory}")), &[]);
        let point = Path::new("out").join("points").join("0005");
        let expected = format!("error: another process is training in {}; ", point.display());
        assert!(error.starts_with(&expected) && error.lines().count() == 1, "{error}");
        assert!(all_files() == before, "files were overwritten, with --memory {memory}");
    }
    drop(lock);
    place.good(&line("out", "--quiet --force --memory 0.000001"));
    // Existing runs of later batches are reported before the first batch starts.
    fs::remove_dir_all(out.join("points/0000")).unwrap();
    let exists = format!("{} holds a run already", Path::new("points").join("0001").display());
    fail(&place, 1, &line("out", "--quiet --memory 0.000001"), &[&exists]);
    assert!(!out.join("points/0000").exists());
}

#[test]
fn damaged_points_are_reported_as_missing() {
    let place = place(SMALL);
    let out = place.path("out");
    place.good(&line("out", "--quiet"));
    let before = results(&out);
    let metrics = |point: usize| out.join(format!("points/{point:04}/metrics.csv"));
    let text = fs::read_to_string(metrics(1)).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    fs::write(metrics(1), lines[..5].join("\n") + "\n").unwrap();
    let record = out.join("points/0001/run.json");
    fs::write(&record, fs::read_to_string(&record).unwrap().replace("\"done\"", "\"running\"")).unwrap();
    let text = fs::read_to_string(metrics(2)).unwrap();
    fs::write(metrics(2), text.replacen("\n0,0,", "\n0,0,7", 1)).unwrap();
    fs::remove_file(metrics(3)).unwrap();
    fs::copy(out.join("points/0000/config.toml"), out.join("points/0004/config.toml")).unwrap();
    let expected = [
        "4 of 8 points are missing",
        "point 0001 (world.coupling = 1, world.steps = 8, learning.generations = 12): \
         it has 2 of 13 generations",
        "point 0002",
        "metrics.csv: line 2 is not",
        "it was not run",
        "it is of another config",
    ];
    fail(&place, 1, &line("out", "--collect"), &expected);
    // --resume trains damaged points again, but refuses a point with another config.
    fail(&place, 1, &line("out", "--quiet --resume"), &["another config"]);
    fs::remove_dir_all(out.join("points/0004")).unwrap();
    place.good(&line("out", "--quiet --resume"));
    assert!(results(&out) == before);
}

#[test]
fn at_most_twenty_missing_points_are_listed() {
    for points in [21, 22] {
        let place = place_of_seeds(points);
        place.good(&line("out", &format!("--quiet --shard 1/{points}")));
        let missing = format!("{} of {points} points are missing", points - 1);
        let error = fail(&place, 1, &line("out", "--collect"), &[&missing]);
        assert_eq!((error.matches("it was not run").count(), error.contains('…')), (20, points == 22), "{error}");
    }
}

#[test]
fn json_summaries_agree_with_the_files() {
    let place = place(SMALL);
    // The first task of a job array of two is the first shard.
    let mut shard = place.command();
    shard.args(line("out", "--backend cpu --quiet --json --every 2 --reach 0.5").split_whitespace());
    shard.env("SLURM_ARRAY_TASK_ID", "0").env("SLURM_ARRAY_TASK_COUNT", "2").env("SLURM_ARRAY_TASK_MIN", "0");
    let summary: serde_json::Value = serde_json::from_str(&succeed(shard.output().unwrap())).unwrap();
    assert_eq!((&summary["shard"], &summary["folder"]), (&"1/2".into(), &"out".into()));
    assert!(summary["collect"].as_str().unwrap().ends_with("--every 2 --reach 0.5 --collect"));
    let output = place.run(&line("out", "--collect --json"));
    assert_eq!(output.status.code(), Some(1));
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let missing =
        summary["points"].as_array().unwrap().iter().filter(|point| point["missing"] == "it was not run").count();
    assert!((1..8).contains(&missing), "{summary}");
    let summary = place.json(&line("out", "--quiet --json --resume"));
    let mut table = csv::Reader::from_path(place.path(summary["files"]["points"].as_str().unwrap())).unwrap();
    for (row, point) in table.records().map(|row| row.unwrap()).zip(summary["points"].as_array().unwrap()) {
        assert_eq!(row[0], point["values"]["world.coupling"].to_string());
        assert_eq!(row[3], point["point"].to_string());
        assert_eq!(row[6].parse::<f64>().unwrap(), point["champion_g"].as_f64().unwrap());
        assert_eq!(row[8].parse::<f64>().ok(), point["champion_g_interval_95"][1].as_f64());
        assert_eq!(row[11], point["reached"].to_string());
        let run = place.read(Path::new(point["folder"].as_str().unwrap()).join("run.json"));
        assert!(run.contains(point["digest"].as_str().unwrap()));
    }
    for picture in summary["files"]["pictures"].as_array().unwrap() {
        assert!(place.path(picture.as_str().unwrap()).exists(), "{picture}");
    }
}

#[test]
fn list_prints_costs_and_shards() {
    let place = place(SMALL);
    let stdout = place.good(&line("out", "--list --shards 3")).0;
    assert_eq!(stdout.lines().count(), 10, "{stdout}");
    let shares: f64 = stdout
        .lines()
        .skip(1)
        .take(8)
        .map(|line| line.split_whitespace().nth(1).unwrap().parse::<f64>().unwrap())
        .sum();
    assert!((shares - 100.0).abs() < 0.1, "{stdout}");
    assert!(!place.path("out").exists());
}

/// Slurm does not run on Windows, whose paths bash would not understand.
#[cfg(unix)]
#[test]
fn the_batch_script_runs_in_bash() {
    let place = place(SMALL);
    let (sweep, out) = (place.path("x.toml"), place.path("a folder's"));
    let run = |flags: &str| {
        let line = ["sweep", sweep.to_str().unwrap(), "--out", out.to_str().unwrap()];
        place.good(&line.into_iter().chain(flags.split_whitespace()).collect::<Vec<_>>()).0
    };
    let flags = "--shards 3 --time 02:00:00 --threads 4 --seed 7";
    let script = run(&format!("--slurm {flags} --sbatch=--partition=long"));
    for line in [
        "#SBATCH --array=1-3",
        "#SBATCH --time=02:00:00",
        "#SBATCH --cpus-per-task=4",
        "#SBATCH --signal=B:USR1@60",
        "#SBATCH --requeue",
        "#SBATCH --partition=long",
    ] {
        assert!(script.lines().any(|other| other == line), "{line}: {script}");
    }
    assert!(!script.contains("--gpus"), "a GPU is requested for a sweep on the CPU: {script}");
    let host_script = run("--slurm --seed 7 --breed host --axes steps --measure best");
    for then in ["--shard", "--collect"] {
        let words = format!("--backend cpu --breed host --axes steps --measure best {then}");
        assert!(host_script.contains(&words), "{host_script}");
    }
    assert!(
        script.contains("--seed 7 --backend cpu --threads 4 --shard \"$SLURM_ARRAY_TASK_ID/3\" --resume"),
        "{script}"
    );
    // As a task of the array, the script trains its shard. The folder's name needs quotes.
    run(&format!("--slurm {flags}"));
    run(&format!("--slurm=job.sh {flags}"));
    for task in ["1", "2", "3"] {
        let output = Command::new("bash").arg(place.path("job.sh")).env("SLURM_ARRAY_TASK_ID", task).output().unwrap();
        succeed(output);
    }
    run("--collect --seed 7");
}

/// Measures how much longer a batch takes than its points one by one. `benches/README.md` has results.
///
/// Run with `cargo test --release sweep:: -- --ignored --nocapture` on an idle machine.
#[test]
#[ignore = "a measurement"]
fn a_batch_of_unequal_points_takes_as_long_as_its_points() {
    let text = "[learning]\ngenerations = 20\ntrials = 2\n[grid]\nfollowers_per_leader = [0, 1, 4, 16]\n\
                \"world.coupling\" = [1, 4]\n\"world.steps\" = [10, 25, 100]\n";
    let sweep = parse(text);
    let seconds = |configs: Vec<ValidConfig>| {
        let mut trainer = Trainer::new(configs);
        let mut backend = Cpu::default();
        let start = Instant::now();
        trainer.finish(&mut backend).unwrap();
        start.elapsed().as_secs_f64()
    };
    let mut best = [f64::INFINITY; 2];
    for _ in 0..3 {
        let parts: f64 = sweep.points.iter().map(|point| seconds(vec![point.config.clone()])).sum();
        let batch = seconds(sweep.points.iter().map(|point| point.config.clone()).collect());
        best = [best[0].min(parts), best[1].min(batch)];
        println!("{} points: {parts:.2} s one by one, {batch:.2} s in one batch", sweep.points.len());
    }
    let ratio = best[1] / best[0];
    println!("batch / parts = {ratio:.2}");
    assert!(ratio <= 1.3, "{ratio}");
}

#[cfg(unix)]
#[test]
fn the_limit_of_open_files_is_raised_if_possible_and_reported_otherwise() {
    let points = "1, 2, 3, 4, 5, 6, 7, 8";
    let place = place(&format!("{SMALL}\"learning.seed\" = [{points}]\n"));
    let run = |limit: &str, out: &str, flags: &str| {
        let flags = format!("--quiet --backend cpu {flags}");
        place.shell(&format!("ulimit {limit} 48; exec flotilla {}", line(out, &flags)))
    };
    // The program raises a soft limit.
    succeed(run("-S -n", "soft", ""));
    let error = failure(run("-n", "hard", ""), 1);
    assert!(error.contains("ulimit -n") && error.contains("--resume"), "{error}");
    assert_eq!(error.lines().count(), 1, "{error}");
    // The points that were finished are kept.
    succeed(run("-S -n", "hard", "--resume"));
    assert_eq!(policies(&place.path("hard")), policies(&place.path("soft")));
}

#[test]
fn keys_of_classes_are_axes_flags_and_varied() {
    let own = include_str!("../../configs/rovers.toml");
    let axes = "[grid]\n\"pois.pair.coupling\" = [1, 3]\n[vary]\nagents.rover.motion.max_speed = [1.5]\n";
    let flag = Override::of_text("agents.drone.senses[1].sectors", "6", "--set agents.drone.senses[1].sectors");
    let sweep = Sweep::read(&format!("{own}{axes}"), "x.toml", &[flag], false).unwrap();
    let points = sweep.points.iter().map(|point| (sweep.describe(point), (*point.config).clone()));
    let edited = |coupling: &str, speed: &str| {
        let text = [
            ("coupling = 2", coupling),
            ("max_speed = 2.0", speed),
            ("\"rover\", sectors = 8", "\"rover\", sectors = 6"),
        ];
        let text = text.iter().fold(own.to_string(), |text, (old, new)| {
            assert_eq!(text.matches(old).count(), 1, "{old}");
            text.replace(old, new)
        });
        Config::parse(&text, "rovers.toml").unwrap()
    };
    let [one, three] = [1, 3].map(|coupling| format!("pois.pair.coupling = {coupling}"));
    let varied = "agents.rover.motion.max_speed = 1.5";
    let expected = [
        (one.clone(), edited("coupling = 1", "max_speed = 2.0")),
        (format!("{one}, {varied}"), edited("coupling = 1", "max_speed = 1.5")),
        (three.clone(), edited("coupling = 3", "max_speed = 2.0")),
        (format!("{three}, {varied}"), edited("coupling = 3", "max_speed = 1.5")),
    ];
    assert_eq!(points.collect::<Vec<_>>(), expected);
    assert_eq!(sweep.axes[1].values[0].to_string(), "2.0");
    // The recorded file is the same sweep.
    assert_eq!(parse(&sweep.text), sweep);
}
