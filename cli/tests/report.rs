//! Tests `plot`, `replay`, `check --out` and `paper`, mostly on small runs that each test trains.
//!
//! The tests check pictures and replay pages, and the messages about damaged runs.

use crate::support::{self, Place, Words, page_data};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use flotilla::backend::cpu::Cpu;
use flotilla::config::{Config, Fitness, Override};
use flotilla::trainer::Trainer;
use flotilla_app::record::digests::Verification;
use flotilla_app::record::ownership::LIST;
use flotilla_app::report::curves::{distinct, poi_ticks};
use flotilla_app::report::map;
use flotilla_app::report::replay::{self, Which};
use flotilla_app::report::scene::{Color, text_width};
use flotilla_studies::paper;
use serde_json::Value;

/// Runs a command that must fail with this exit code. Its error message must come first, and contain all of `parts`.
fn fail(place: &Place, code: i32, words: impl Words, parts: &[&str]) {
    let message = place.fails(code, words, parts);
    assert!(message.starts_with("error: "), "{message}");
}

/// Two leaders with two followers each, and two POIs within reach.
const CONFIG: &str = "
[world]
map = [30.0, 20.0]
leaders = [[8.0, 5.0], [20.0, 5.0]]
followers = [[9.0, 3.0], [7.0, 3.0], [21.0, 3.0], [19.0, 3.0]]
pois = [[8.0, 10.0], [20.0, 10.0]]
coupling = 2
steps = 20
[learning]
population = 10
generations = 6
trials = 3
";

/// Creates a folder with a config in `small.toml`, and with a run of it in `run`.
fn trained(config: &str) -> Place {
    let place = Place::new(&[("small.toml", config)]).on_cpu().slow();
    train(&place, "run", "");
    place
}

fn train(place: &Place, run: &str, flags: &str) {
    place.good(&format!("train small.toml --out {run} {flags} --quiet"));
}

/// Marks the run as unfinished. Files of unfinished runs are not compared with digests, so that tests can change them.
fn mark_unfinished(place: &Place) {
    place.write("run/run.json", place.read("run/run.json").replace("\"done\"", "\"running\""));
}

/// Returns G of a run's best team per trial and generation.
fn best(place: &Place, run: &str) -> BTreeMap<(usize, usize), f64> {
    let row = |line: &str| {
        let fields: Vec<&str> = line.split(',').collect();
        ((fields[0].parse().unwrap(), fields[1].parse().unwrap()), fields[2].parse().unwrap())
    };
    place.read(format!("{run}/metrics.csv")).lines().skip(1).map(row).collect()
}

fn floats(text: &Value) -> Vec<f32> {
    let bytes = BASE64_STANDARD.decode(text.as_str().unwrap()).unwrap();
    bytes.chunks_exact(4).map(|bytes| f32::from_le_bytes(bytes.try_into().unwrap())).collect()
}

/// Counts the elements of this name in an SVG, and checks that the document is complete.
fn count(svg: &str, element: &str) -> usize {
    assert!(svg.starts_with("<svg ") && svg.trim_end().ends_with("</svg>"));
    svg.matches(&format!("<{element} ")).count()
}

#[test]
fn plot_writes_svg_and_png() {
    let place = trained(CONFIG);
    place.good("plot run");
    let svg = place.read("run/curves.svg");
    for label in ["best team", "champion", "mean team", "Generation", "G (share of POIs observed)"] {
        assert!(svg.contains(label), "{label}");
    }
    place.good("plot run --out run/curves.png");
    let png = place.bytes("run/curves.png");
    assert_eq!(png[..8], *b"\x89PNG\r\n\x1a\n");
    // The width of a paper's column at 300 dots per inch, which are 11811 per metre.
    assert_eq!(u32::from_be_bytes(png[16..20].try_into().unwrap()), 1004);
    let physical = png.windows(4).position(|window| window == b"pHYs").expect("a pHYs chunk");
    let field = |at: usize| u32::from_be_bytes(png[physical + at..physical + at + 4].try_into().unwrap());
    assert!(field(4).abs_diff(11_811) <= 12 && field(8) == field(4) && png[physical + 12] == 1);
}

#[test]
fn curves_follow_the_metrics() {
    // A single trial has no error band, and the mean over trials is the trial itself.
    let place = Place::new(&[("small.toml", CONFIG)]).on_cpu().slow();
    let [svg, with_bands] = ["1", "3"].map(|trials| {
        train(&place, trials, &format!("--trials {trials}"));
        place.good(&format!("plot {trials}"));
        place.read(format!("{trials}/curves.svg"))
    });
    assert!(count(&svg, "polygon") < count(&with_bands, "polygon"));
    let line = svg.lines().filter(|line| line.starts_with("<polyline")).find(|line| line.matches(',').count() == 7);
    let points = line.unwrap().split('"').nth(1).unwrap();
    let heights: Vec<f64> = points.split(' ').map(|point| point.split(',').nth(1).unwrap().parse().unwrap()).collect();
    let metrics = place.read("1/metrics.csv");
    let champion: Vec<f64> =
        metrics.lines().skip(1).map(|row| row.split(',').nth(4).unwrap().parse().unwrap()).collect();
    for (first, first_height) in heights.iter().enumerate() {
        for (second, second_height) in heights.iter().enumerate() {
            let (a, b) = (champion[first], champion[second]);
            assert_eq!(a.partial_cmp(&b), second_height.partial_cmp(first_height), "{first} and {second}");
        }
    }
}

#[test]
fn several_runs_are_labelled_by_the_keys_that_differ() {
    let place = Place::new(&[("small.toml", CONFIG)]).on_cpu().slow();
    train(&place, "first", "--fitness G");
    train(&place, "second", "--fitness D++");
    train(&place, "six", "--fitness G --trials 6");
    train(&place, "other", "--fitness D++ --trials 6");
    place.good("plot first second --out both.svg");
    let svg = place.read("both.svg");
    assert!(svg.contains("\"fitness G\"") && svg.contains("\"fitness D++\""), "{svg}");
    assert!(!svg.contains("population"));
    // Three pairs are too few to compare them.
    for (runs, trials_are_pairs) in [("six other", true), ("six second", false), ("first second", false)] {
        let (_, notes) = place.good(&format!("plot {runs} --out both.svg"));
        assert_eq!(notes.contains("their trials are pairs"), trials_are_pairs, "{notes}");
    }
}

#[test]
fn runs_with_equal_configs_are_labelled_by_their_folders() {
    let place = trained(CONFIG);
    place.good("plot run run --out both.svg");
    assert!(place.read("both.svg").contains("run\""));
}

#[test]
fn paths_without_a_run_are_refused_with_the_reason() {
    let place = Place::new(&[("file", "")]).on_cpu();
    for command in ["plot", "replay"] {
        fail(&place, 1, &[command, "nowhere"], &["no such folder", "flotilla train"]);
        fail(&place, 1, &[command, "file"], &["is a file"]);
        fail(&place, 1, &[command, "."], &["config.toml", "flotilla train"]);
    }
}

#[test]
fn errors_about_damaged_runs_name_the_file_and_line() {
    let place = trained(CONFIG);
    mark_unfinished(&place);
    let metrics = place.read("run/metrics.csv");
    let refuses_metrics = |text: &[u8], expected: &[&str]| {
        place.write("run/metrics.csv", text);
        fail(&place, 1, "plot run", expected);
        fail(&place, 1, "replay run", expected);
    };
    let header = metrics.lines().next().unwrap();
    refuses_metrics(b"", &["metrics.csv", "line 1"]);
    refuses_metrics(b"\xff\xfe\0\0", &["metrics.csv", "line 1"]);
    refuses_metrics(format!("{header}\n").as_bytes(), &["no rows yet", "--resume"]);
    refuses_metrics(format!("{header}\n0,0,nan,0,0,0\n").as_bytes(), &["line 2"]);
    refuses_metrics(format!("{header}\n0,0,1e999,0,0,0\n").as_bytes(), &["line 2"]);
    refuses_metrics(format!("{header}\n3,0,0,0,0,0\n").as_bytes(), &["line 2", "config.toml"]);
    refuses_metrics(format!("{header}\n0,1000000,0,0,0,0\n").as_bytes(), &["line 2", "config.toml"]);
    refuses_metrics(format!("{header}\n{}\n", "9".repeat(1 << 20)).as_bytes(), &["rows"]);
    fs::remove_file(place.path("run/metrics.csv")).unwrap();
    fail(&place, 1, "plot run", &["metrics.csv", "--resume"]);
    place.write("run/config.toml", "[world");
    fail(&place, 1, "plot run", &["config.toml", "flotilla train"]);
}

#[test]
fn an_unfinished_run_plots_and_replays_up_to_its_last_whole_generation() {
    let place = trained(CONFIG);
    mark_unfinished(&place);
    let metrics = place.read("run/metrics.csv");
    let lines: Vec<&str> = metrics.lines().take(1 + 3 * 4).collect();
    // Only one of three trials has a row of generation 4.
    place.write("run/metrics.csv", lines.join("\n") + "\n0,4,1,1,1,0.000\n1,4,0.");
    place.good("plot run");
    let svg = place.read("run/curves.svg");
    assert!(svg.contains("at generation 3") && !svg.contains("at generation 4"), "{svg}");
    place.write("run/metrics.csv", lines[..3].join("\n") + "\n");
    fail(&place, 1, "plot run", &["no generation of all trials", "--resume"]);
    place.write("run/metrics.csv", lines.join("\n") + "\n0,4,0.");
    place.prints("replay run", &["generation 3"]);
    fail(&place, 2, "replay run --generation 5", &["generation 5", "newest is 3"]);
    fs::remove_file(place.path("run/policies.safetensors")).unwrap();
    fail(&place, 1, "rollout run", &["has no policies.safetensors yet", "finish the run with `flotilla train"]);
}

#[test]
fn removing_a_leader_lowers_g_by_its_credit() {
    // D removes only the leader. Df also removes its group over the whole episode, and Dt its group at each step.
    let place = Place::new(&[("small.toml", CONFIG)]).on_cpu().slow();
    let mut positive = 0;
    for fitness in ["Df", "Dt"] {
        // Some generations are played again from a checkpoint.
        train(&place, fitness, &format!("--fitness {fitness} --checkpoint-generations 2"));
        let run = place.path(fitness);
        for ((trial, generation), best) in best(&place, fitness) {
            let (which, verification) = (Which::Best, Verification::Required);
            let watch = &mut |_| true;
            let played = replay::replay(&run, trial, &[generation], which, verification, &mut Cpu::default(), watch);
            let played = &played.unwrap()[0];
            let count = |observed: &[Option<usize>]| observed.iter().flatten().count() as f32;
            assert_eq!((played.team_g, f64::from(count(&played.observed)) / 2.0), (best, best), "{trial} {generation}");
            let by_group = if fitness == "Dt" { &played.scores.dt } else { &played.scores.df };
            for (leader, (&alone, &with_group)) in played.scores.d.iter().zip(by_group).enumerate() {
                for (group, score) in [(false, alone), (true, with_group)] {
                    let without = played.without(leader, group);
                    let difference = (count(&played.observed) - count(&without.observed)) / 2.0;
                    assert_eq!(difference, score, "{fitness} {trial} {generation} {leader} {group}");
                    positive += usize::from(difference > 0.0);
                }
            }
        }
    }
    assert!(positive > 10, "only {positive} credits are above 0");
}

#[test]
fn a_zipped_run_is_refused_with_the_command_that_unpacks_it() {
    let (place, file) = (trained(CONFIG), "my run.zip");
    place.write(file, b"PK\x03\x04 and the rest of a zip file");
    for words in [&["plot", file][..], &["replay", file], &["rollout", file], &["compare", file, "run"]] {
        fail(&place, 1, words, &["my run.zip is a file", "unpack it with `unzip 'my run.zip'`"]);
    }
    fail(&place, 1, &["train", file, "--resume"], &["my run.zip", "it is a zip file; unpack it"]);
}

#[test]
fn a_replay_shows_the_episode_that_rollout_traces() {
    // After the last generation, the policies file has the populations that played, in another order. So the replayed
    // team is one of the four possible teams, and `rollout` must trace its episode.
    let place = Place::new(&[("small.toml", CONFIG)]).on_cpu().slow();
    train(&place, "run", "--population 2 --trials 1");
    place.good("replay run");
    let page = page_data(&place.path("run/replay.html"));
    let episode = &page["episodes"][0];
    assert_eq!(page["exact"], true);
    let observed = episode["observed"].as_array().unwrap().iter().filter(|step| !step.is_null()).count();
    assert_eq!(episode["g"].as_f64(), Some(observed as f64 / 2.0));
    let positions = floats(&episode["positions"]);
    let headings = floats(&episode["headings"]);
    let (agents, steps) = (6, 20);
    assert_eq!(positions.len(), (steps + 1) * agents * 2);

    let bytes = place.bytes("run/policies.safetensors");
    let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let tensor = file.tensor("weights.0").unwrap();
    let shape = tensor.shape().to_vec();
    let numbers: Vec<f32> =
        tensor.data().chunks_exact(4).map(|bytes| f32::from_le_bytes(bytes.try_into().unwrap())).collect();
    // All four teams, with one of two policies per leader.
    let parameters = shape[2];
    let policy_of = |leader: usize, policy: usize| &numbers[(leader * 2 + policy) * parameters..][..parameters];
    let teams = [[0, 0], [0, 1], [1, 0], [1, 1]];
    let weights: Vec<f32> =
        (0..2).flat_map(|leader| teams.iter().flat_map(move |team| policy_of(leader, team[leader]).to_vec())).collect();
    let raw: Vec<u8> = weights.iter().flat_map(|weight| weight.to_le_bytes()).collect();
    let view = safetensors::tensor::TensorView::new(safetensors::Dtype::F32, vec![2, 4, parameters], &raw).unwrap();
    place.write("all.safetensors", safetensors::serialize([("weights", view)], None).unwrap());
    place.good("rollout run/config.toml --policies all.safetensors --trace trace.csv");
    let mut traced = vec![vec![[0f32; 4]; (steps + 1) * agents]; 4];
    for line in place.read("trace.csv").lines().skip(1) {
        let fields: Vec<&str> = line.split(',').collect();
        let [team, step, agent] = [0, 1, 2].map(|field| fields[field].parse::<usize>().unwrap());
        traced[team][step * agents + agent] = [4, 5, 6, 7].map(|field| fields[field].parse().unwrap());
    }
    let shown: Vec<[f32; 4]> =
        positions.chunks_exact(2).zip(headings.chunks_exact(2)).map(|(p, h)| [p[0], p[1], h[0], h[1]]).collect();
    assert!(traced.contains(&shown), "no team's trace equals the page's episode");
}

#[test]
fn a_replay_that_contradicts_the_metrics_is_refused() {
    let place = trained(CONFIG);
    mark_unfinished(&place);
    let metrics = place.read("run/metrics.csv");
    let forged: String = metrics
        .lines()
        .map(|line| {
            let mut fields: Vec<&str> = line.split(',').collect();
            if fields[0] == "0" && fields[1] == "6" {
                fields[4] = if fields[4] == "1" { "0.5" } else { "1" };
            }
            fields.join(",") + "\n"
        })
        .collect();
    place.write("run/metrics.csv", forged);
    fail(&place, 1, "replay run", &["generation 6", "metrics.csv has"]);
    fail(&place, 2, "replay run --trial 3", &["no trial 3", "0 to 2"]);
}

#[test]
fn replay_writes_svg_png_and_pdf() {
    let place = trained(CONFIG);
    let write = |name: &str| {
        place.good(&format!("replay run --compare 0 --out {name}"));
        place.bytes(name)
    };
    let svg = String::from_utf8(write("still.svg")).unwrap();
    assert!(svg.contains("trial 0, generation 0") && svg.contains("trial 0, generation 6"));
    // Six agents in each of two episodes.
    assert!(count(&svg, "polygon") >= 12);
    assert_eq!(write("still.png")[..4], *b"\x89PNG");
    assert_eq!(write("still.pdf")[..5], *b"%PDF-");
}

#[test]
fn gifs_and_frames_have_the_requested_size_and_rate() {
    let place = trained(&CONFIG.replace("steps = 20", "steps = 5"));
    let line = |name: &str, flags: &str| format!("replay run --compare 0 --out {name} {flags}");
    let render = |name: &str, flags: &str| {
        place.good(&line(name, flags));
        place.path(name)
    };
    // Returns a GIF's size and the end of each frame, in hundredths of a second.
    let size_and_ends = |path: &Path| {
        let bytes = fs::read(path).unwrap();
        let mut decoder = gif::DecodeOptions::new().read_info(&bytes[..]).unwrap();
        let size = (decoder.width(), decoder.height());
        let mut ends = vec![];
        while let Some(frame) = decoder.read_next_frame().unwrap() {
            ends.push(ends.last().unwrap_or(&0) + u32::from(frame.delay));
        }
        (size, ends)
    };
    // Five steps of 0.2 seconds at 20 frames per second. The last frame stays for two seconds.
    let (size, ends) = size_and_ends(&render("moving.gif", ""));
    assert!(size.0 == 960 || size.1 == 720, "{size:?}");
    assert_eq!((ends.len(), ends[19], ends[20]), (21, 100, 300));
    let (size, ends) = size_and_ends(&render("small.gif", "--width 333 --fps 30"));
    assert_eq!(size.0, 333);
    assert_eq!((ends.len(), ends[29]), (31, 100));

    // A name with `%03d` writes one numbered file per frame.
    let film = render("film/%03d.png", "--fps 10 --width 400");
    let mut names: Vec<_> = fs::read_dir(film.parent().unwrap()).unwrap().map(|entry| entry.unwrap().path()).collect();
    names.sort();
    assert_eq!(names.len(), 11);
    assert_eq!(names[10].file_name().unwrap(), "010.png");
    for name in names {
        assert_eq!(fs::read(name).unwrap()[16..20], 400_u32.to_be_bytes());
    }

    // A still picture of any step of the episode, with the requested width.
    render("still.svg", "--step 5");
    place.fails(2, &line("late.svg", "--step 6"), &["the episode has steps 0 to 5"]);
    assert!(!place.path("late.svg").exists());
    assert_eq!(fs::read(render("still.png", "--width 300")).unwrap()[16..20], 300_u32.to_be_bytes());

    // Flags that do nothing for a format are refused.
    for (name, flags, flag) in [
        ("a.svg", "--width 400", "--width"),
        ("a.html", "--width 400", "--width"),
        ("a.png", "--fps 10", "--fps"),
        ("a.gif", "--step 3", "--step"),
    ] {
        place.fails(2, &line(name, flags), &[flag]);
        assert!(!place.path(name).exists());
    }
}

/// Returns the horizontal texts of an SVG with their areas, `[left, top, right, bottom]` in millimetres.
fn texts(svg: &str) -> Vec<(String, [f64; 4])> {
    let attribute = |line: &str, name: &str| {
        line.split(&format!(" {name}=\"")).nth(1).map(|rest| rest.split('"').next().unwrap().to_string())
    };
    let mut areas = vec![];
    for line in svg.lines().filter(|line| line.starts_with("<g aria-label=")) {
        let text = attribute(line, "aria-label").unwrap();
        let transform = attribute(line, "transform").unwrap();
        let numbers: Vec<f64> = transform.split([' ', '(', ')']).filter_map(|part| part.parse().ok()).collect();
        if transform.contains("rotate") {
            continue;
        }
        let (x, y, size) = (numbers[0] / 10.0, numbers[1] / 10.0, numbers[2] * 2048.0 / 10.0);
        let first = attribute(line.split("<use").nth(1).unwrap(), "x").unwrap().parse::<f64>().unwrap();
        let left = x + first * size / 2048.0;
        areas.push((text.clone(), [left, y - 0.72 * size, left + text_width(&text, size), y]));
    }
    areas
}

fn assert_no_overlap(what: &str, texts: &[(String, [f64; 4])]) {
    for (index, (text, a)) in texts.iter().enumerate() {
        for (other, b) in &texts[..index] {
            let overlap = a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];
            assert!(!overlap, "{what}: {text:?} at {a:?} overlaps {other:?} at {b:?}");
        }
    }
}

/// Returns a config with a square map, this many POIs, and this many leaders with one follower each.
fn crowded(pois: usize, leaders: usize) -> String {
    let columns = (pois as f64).sqrt().ceil() as usize;
    let place = |index: usize| format!("[{}, {}]", 4 + index % columns * 3, 12 + index / columns * 3);
    let map = (4 + 3 * columns).max(20 + 3 * leaders);
    let start = |index: usize, y: f64| format!("[{}.0, {y:.1}]", 3 + index * 3);
    let list = |count: usize, each: &dyn Fn(usize) -> String| (0..count).map(each).collect::<Vec<_>>().join(", ");
    format!(
        "[world]\nmap = [{map}, {map}]\nleaders = [{}]\nfollowers = [{}]\npois = [{}]\ncoupling = 2\nsteps = 15\n\
         observation_radius = 2.0\n[learning]\npopulation = 2\ngenerations = 1\ntrials = 1\n",
        list(leaders, &|index| start(index, 5.0)),
        list(leaders, &|index| start(index, 3.0)),
        list(pois, &place),
    )
}

#[test]
fn labels_of_many_pois_and_leaders_do_not_overlap() {
    for (pois, leaders) in [(1, 1), (4, 2), (20, 6), (64, 20), (256, 40)] {
        let place = trained(&crowded(pois, leaders));
        place.good("replay run --out still.svg");
        let (stdout, _) = place.good("check run/config.toml --out layout.svg");
        assert_eq!(stdout, place.good("check run/config.toml").0);
        for what in ["still", "layout"] {
            let svg = place.read(format!("{what}.svg"));
            assert!(svg.len() < 400_000, "{} bytes", svg.len());
            let labels = texts(&svg);
            assert_no_overlap(&format!("{what} of {pois} POIs"), &labels);
            // Up to 12 leaders are all numbered, and of more at least half. Either all POIs are labelled or none.
            let occurrences = |text: &str| labels.iter().filter(|(other, _)| other == text).count();
            let (numbers, poi_labels) = match what {
                "still" => (
                    leaders,
                    labels.iter().filter(|(text, _)| text.ends_with("/2") || text.starts_with("at step ")).count(),
                ),
                // In a layout, labels are numbers, which cannot be distinguished from those of the scale.
                _ => (0, pois),
            };
            assert!(poi_labels == pois || poi_labels == 0, "{poi_labels} labels of {pois}");
            let numbered = (0..numbers).filter(|number| occurrences(&number.to_string()) > 0).count();
            assert!(if numbers <= 12 { numbered == numbers } else { 2 * numbered > numbers }, "{labels:?}");
        }
    }
}

#[test]
fn a_layout_picture_shows_the_config() {
    let config = CONFIG.replace("coupling = 2", "coupling = [7, 1]").replace("followers = [", "followers = [[1, 1], ");
    let place = Place::new(&[("small.toml", &config)]);
    for name in ["layout.svg", "layout.png", "layout.pdf"] {
        place.good(&format!("check small.toml --out {name}"));
        assert!(place.bytes(name).len() > 2_000);
    }
    let svg = place.read("layout.svg");
    let labels: Vec<String> = texts(&svg).into_iter().map(|(text, _)| text).collect();
    for text in ["7", "1", "0", "2 leaders, 5 followers, 2 POIs", "number at a POI: agents it needs, within 5 of it"] {
        assert!(labels.iter().any(|label| label == text), "{text:?} is not in {labels:?}");
    }
    assert!(svg.contains("Leaders at (8, 5), (20, 5)") && svg.contains("POIs at (8, 10), (20, 10)"));
    assert_eq!(place.run("check small.toml --out layout.gif").status.code(), Some(2));
}

#[test]
fn svgs_need_no_fonts_and_describe_themselves() {
    let place = trained(CONFIG);
    let svg = |line: &str| {
        place.good(&format!("{line} --out picture.svg"));
        place.read("picture.svg")
    };
    let (curves, still) = (svg("plot run"), svg("replay run --compare 0"));
    for svg in [&curves, &still, &svg("check run/config.toml")] {
        // The file contains the outlines of its letters, so that viewers need no font.
        assert!(!svg.contains("<text") && !svg.contains("font"), "{svg}");
        for glyph in svg.split("xlink:href=\"#").skip(1).map(|rest| rest.split('"').next().unwrap()) {
            assert_eq!(count(svg, &format!("path id=\"{glyph}\"")), 1);
        }
        assert!(svg.contains("role=\"img\" aria-labelledby=\"title description\""));
        for element in ["<title id=\"title\">", "<desc id=\"description\">"] {
            assert!(svg.split(element).nth(1).unwrap().split('<').next().unwrap().len() > 20, "{svg}");
        }
        assert!(svg.len() < 50_000 && svg.lines().count() < 250, "{} bytes", svg.len());
    }
    // Descriptions contain the numbers that the pictures show.
    let best = best(&place, "run").into_iter();
    let last: Vec<f64> = best.filter(|((_, generation), _)| *generation == 6).map(|(_, g)| g).collect();
    let mean = format!("{:.3}", last.iter().sum::<f64>() / 3.0);
    let mean = mean.trim_end_matches('0').trim_end_matches('.');
    let described = curves.split("<desc").nth(1).unwrap().split("</desc").next().unwrap();
    assert!(described.contains("best team from ") && described.contains(&format!(" to {mean}")), "{mean}: {described}");
    assert!(curves.contains("mean and 95 % interval over 3 trials"));
    assert!(still.contains("generation 6, step 20 of 20: ") && still.contains(" of 2 POIs observed"));
    // With one trial, there is no band to explain.
    train(&place, "single", "--trials 1");
    assert!(!svg("plot single").contains("interval over"));
}

/// Returns the largest height of each band of a figure, in millimetres.
fn band_heights(svg: &str) -> Vec<f64> {
    let bands = svg.lines().filter(|line| line.starts_with("<polygon") && line.contains("fill-opacity=\"0.2\""));
    let height = |line: &str| {
        let points: Vec<[f64; 2]> = line
            .split('"')
            .nth(1)
            .unwrap()
            .split(' ')
            .map(|point| {
                let (x, y) = point.split_once(',').unwrap();
                [x.parse().unwrap(), y.parse().unwrap()]
            })
            .collect();
        let (upper, lower) = points.split_at(points.len() / 2);
        upper.iter().zip(lower.iter().rev()).map(|(a, b)| (b[1] - a[1]).abs() / 10.0).fold(0.0, f64::max)
    };
    bands.map(height).collect()
}

#[test]
fn curves_show_the_requested_team_and_band() {
    let place = trained(CONFIG);
    train(&place, "other", "--fitness G");
    let plot = |runs: &str, flags: &str| {
        place.good(&format!("plot {runs} --out picture.svg {flags}"));
        place.read("picture.svg")
    };
    for (measure, label) in [("best", "best team"), ("champion", "champion"), ("mean", "mean team")] {
        for runs in ["run", "run other"] {
            let svg = plot(runs, &format!("--measure {measure}"));
            assert!(svg.contains(&format!("aria-label=\"G of the {label}\"")), "{measure}: {svg}");
            // The curve is labelled with the measure only if there is a single run.
            assert_eq!(svg.contains(&format!("aria-label=\"{label}\"")), runs == "run", "{measure}");
        }
    }
    // By default, a plot of several runs shows their champions.
    assert!(plot("run other", "").contains("G of the champion"));
    let [interval, error, none] = ["interval", "error", "none"].map(|band| plot("run", &format!("--band {band}")));
    assert_eq!(plot("run", ""), interval);
    assert!(error.contains("mean ± standard error over 3 trials") && !none.contains("over 3 trials"));
    let [interval, error, none] = [interval, error, none].map(|svg| band_heights(&svg));
    // A curve whose trials are equal has no standard error. Their interval has a width at every generation.
    assert!(interval.len() == 3 && (1..=3).contains(&error.len()) && none.is_empty());
    let largest = |heights: &[f64]| heights.iter().copied().fold(0.0, f64::max);
    assert!(largest(&interval) > 1.5 * largest(&error), "{interval:?} {error:?}");
    fail(&place, 2, "plot run --band wide", &["allowed interval, error or none"]);
    fail(&place, 2, "plot run --measure worst", &["allowed champion, best, mean or test"]);
}

#[test]
fn pdfs_have_a_valid_object_table_and_an_embedded_font() {
    let place = trained(CONFIG);
    place.good("plot run --out run/curves.pdf");
    let pdf = place.bytes("run/curves.pdf");
    assert!(pdf.len() < 30_000, "{} bytes", pdf.len());
    let find = |text: &str, from: usize| {
        pdf[from..].windows(text.len()).position(|window| window == text.as_bytes()).map(|at| at + from)
    };
    // Every object begins at its offset in the table.
    let table = find("\nxref\n", 0).unwrap() + 1;
    let text = String::from_utf8_lossy(&pdf[table..]).into_owned();
    let entries: Vec<&str> = text.lines().skip(2).take_while(|line| !line.starts_with("trailer")).collect();
    assert!(entries.len() > 9, "{entries:?}");
    for (number, entry) in entries.iter().enumerate().skip(1) {
        let at: usize = entry[..10].parse().unwrap();
        assert!(pdf[at..].starts_with(format!("{number} 0 obj").as_bytes()), "{number}: {entry}");
    }
    for part in ["/FontFile2", "/ToUnicode", "/Title", "/Subject", "/Lang"] {
        assert!(find(part, 0).is_some(), "{part}");
    }
    // The width of a paper's column: 85 mm are 240.94 points.
    assert!(find("/MediaBox [0 0 240.94", 0).is_some());
}

#[test]
fn an_axis_of_pois_has_whole_numbers_from_0_to_all() {
    for pois in 1..=256 {
        let ticks = poi_ticks(pois);
        assert_eq!((ticks[0], *ticks.last().unwrap()), (0, pois), "{ticks:?}");
        assert!(ticks.len() <= 9 && (pois < 3 || ticks.len() >= 4), "{ticks:?}");
        // Ticks are at least 1/12 of the axis apart, so that labels have room.
        assert!(ticks.windows(2).all(|pair| pair[1] > pair[0] && 12 * (pair[1] - pair[0]) >= pois), "{ticks:?}");
    }
    assert_eq!(poi_ticks(9), [0, 3, 6, 9]);
    assert_eq!(poi_ticks(4), [0, 1, 2, 3, 4]);
    assert_eq!(poi_ticks(256), [0, 64, 128, 192, 256]);
}

#[test]
fn shortened_labels_keep_their_differences() {
    let label = |text: &str| text.to_string();
    let long = "a name that is far too long for any legend of a figure";
    let names = [format!("{long}/one/run"), format!("{long}/two/run"), format!("{long}/three/run")];
    let cut = distinct(&names, 30.0, 2.47);
    assert_eq!(cut, ["…one…", "…two…", "…three…"].map(label));
    // The first two labels differ only in the middle.
    let names = ["x", "y"].map(|middle| format!("1{long}{middle}{long}2"));
    let names = [names[0].clone(), names[1].clone(), format!("3{long}4")];
    let cut = distinct(&names, 30.0, 2.47);
    assert!(cut.iter().all(|label| text_width(label, 2.47) <= 30.0), "{cut:?}");
    assert!(cut[0] != cut[1] && cut[1] != cut[2], "{cut:?}");
    // Labels that fit are not shortened.
    assert_eq!(distinct(&["fitness G", "fitness D"].map(label), 30.0, 2.47), ["fitness G", "fitness D"].map(label));
}

#[test]
fn legends_of_many_runs_do_not_overlap_and_fit_the_figure() {
    let place = trained(CONFIG);
    let mut words = vec!["plot".into(), "--out".into(), PathBuf::from("many.svg")];
    for index in 0..24 {
        let name = place.path(format!("a run with a name that goes on and on, and on, number {index}"));
        fs::create_dir(&name).unwrap();
        for file in ["config.toml", "metrics.csv"] {
            fs::copy(place.path("run").join(file), name.join(file)).unwrap();
        }
        words.push(name);
    }
    place.good(&words);
    let svg = place.read("many.svg");
    // So many bands could not be told apart: each curve has a bar at its end.
    assert!(band_heights(&svg).is_empty() && svg.contains("mean and 95 % interval over 3 trials at the end"));
    let labels = texts(&svg);
    assert_no_overlap("24 runs", &labels);
    assert!((0..24).all(|index| labels.iter().any(|(text, _)| *text == format!("…{index}"))), "{labels:?}");
    assert!(labels.iter().all(|(_, area)| area[0] >= 0.0 && area[2] <= 85.0), "{labels:?}");
}

/// Converts sRGB to linear light, in 0..1.
fn linear(color: Color) -> [f64; 3] {
    color.map(|channel| {
        let share = f64::from(channel) / 255.0;
        if share <= 0.04045 { share / 12.92 } else { ((share + 0.055) / 1.055).powf(2.4) }
    })
}

/// Returns the contrast ratio of two colours, as defined by WCAG.
fn contrast(a: Color, b: Color) -> f64 {
    let [a, b] = [a, b].map(linear).map(|[r, g, b]| 0.2126 * r + 0.7152 * g + 0.0722 * b);
    (a.max(b) + 0.05) / (a.min(b) + 0.05)
}

/// Returns the smallest distance of two colours under normal, red-blind and green-blind vision. The distance is in
/// Oklab, the simulation of vision by Machado et al. (2009).
fn color_distance(a: Color, b: Color) -> f64 {
    type Matrix = [[f64; 3]; 3];
    const VISIONS: [Matrix; 3] = [
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
    ];
    const CONES: Matrix = [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ];
    const LAB: Matrix = [
        [0.2104542553, 0.793617785, -0.0040720468],
        [1.9779984951, -2.428592205, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.808675766],
    ];
    let times = |matrix: &Matrix, v: [f64; 3]| matrix.map(|row| row.iter().zip(v).map(|(a, b)| a * b).sum::<f64>());
    let lab = |vision: &Matrix, color: Color| {
        let seen = times(vision, linear(color)).map(|channel| channel.clamp(0.0, 1.0));
        times(&LAB, times(&CONES, seen).map(f64::cbrt))
    };
    let distance_for = |vision: &Matrix| {
        let pairs = lab(vision, a).into_iter().zip(lab(vision, b));
        pairs.map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
    };
    VISIONS.iter().map(distance_for).fold(f64::INFINITY, f64::min)
}

#[test]
fn leaders_colours_can_be_distinguished_on_both_backgrounds() {
    // Per theme: leaders' colours, the background, and the colours of an observed POI and an agent without a group.
    for (colors, background, others) in [
        (map::GROUPS, [250, 250, 250], [[0, 158, 115], [120, 120, 120]]),
        (map::GROUPS_DARK, [21, 25, 29], [[42, 199, 154], [150, 150, 150]]),
    ] {
        for (index, &color) in colors.iter().enumerate() {
            assert!(
                contrast(color, background) >= 3.0,
                "contrast of {color:?} with the background: {:.2}",
                contrast(color, background)
            );
            for &other in colors[..index].iter().chain(&others) {
                assert!(
                    color_distance(color, other) >= 0.05,
                    "distance of {color:?} and {other:?}: {:.3}",
                    color_distance(color, other)
                );
            }
        }
    }
}

#[test]
fn columns_of_the_training_summary_stay_apart_with_many_pois() {
    // Twelve POIs around two leaders need one agent each, so that all are observed at once.
    let pois: Vec<String> = (0..12).map(|index| format!("[{}, 6]", 8 + index)).collect();
    let config = CONFIG.replace("pois = [[8.0, 10.0], [20.0, 10.0]]", &format!("pois = [{}]", pois.join(", ")));
    let config = config.replace("coupling = 2", "coupling = 1\nobservation_radius = 8.0");
    let (stdout, _) = Place::new(&[("c.toml", &config)]).on_cpu().slow().good("train c.toml --out run");
    let rows: Vec<Vec<&str>> = stdout
        .lines()
        .filter(|line| line.starts_with("  ") && line.contains(" to 1"))
        .map(|line| line.split("  ").filter(|part| !part.is_empty()).map(str::trim).collect())
        .collect();
    assert_eq!(rows.len(), 2, "{stdout}");
    assert!(rows.iter().all(|row| row.len() == 4 && row[1] == "12.00 (12.00 to 12.00)"), "{rows:?}");
}

#[test]
fn replay_pages_of_long_episodes_stay_small() {
    let leaders: Vec<String> = (0..40).map(|i| format!("[{}.0, 5.0]", 2 + i * 4)).collect();
    let followers: Vec<String> =
        (0..260).map(|i| format!("[{:.1}, {}.0]", 2.0 + (i % 65) as f64 * 2.4, 8 + i / 65)).collect();
    let config = format!(
        "[world]\nmap = [170.0, 60.0]\nleaders = [{}]\nfollowers = [{}]\npois = [[20.0, 30.0], [90.0, 30.0]]\n\
         coupling = 3\nsteps = 1500\n[learning]\npopulation = 2\ngenerations = 1\ntrials = 1\n",
        leaders.join(", "),
        followers.join(", ")
    );
    let place = trained(&config);
    place.good("replay run --compare 0");
    let size = place.bytes("run/replay.html").len();
    assert!(size < 2_000_000, "{size} bytes");
    let page = page_data(&place.path("run/replay.html"));
    assert_eq!(page["exact"], false);
    let shown = page["episodes"][0]["shown"].as_array().unwrap();
    assert_eq!((shown[0].as_u64(), shown.last().unwrap().as_u64()), (Some(0), Some(1500)));
}

#[test]
fn plots_of_long_runs_stay_small() {
    let place = trained(CONFIG);
    mark_unfinished(&place);
    let config = place.read("run/config.toml").replace("generations = 6", "generations = 10000");
    place.write("run/config.toml", config.replace("trials = 3", "trials = 20"));
    let mut metrics = "trial,generation,best_g,mean_g,champion_g,seconds\n".to_string();
    for generation in 0..=10_000 {
        for trial in 0..20 {
            let g = ((generation * 7 + trial * 3) % 11) as f64 / 10.0;
            metrics += &format!("{trial},{generation},{g},{},{g},1.000\n", g / 2.0);
        }
    }
    place.write("run/metrics.csv", metrics);
    place.good("plot run");
    let svg = place.read("run/curves.svg");
    assert!(svg.len() < 100_000, "{} bytes", svg.len());
    assert!(svg.contains("Generation (means of "));
}

#[test]
fn arms_that_share_a_run_would_train_the_same_policies() {
    // After 12 generations, all-leaders teams observe a POI. Before that, all fitnesses select the same policies.
    let overrides = [("learning.generations", 12), ("learning.trials", 2)];
    let overrides = overrides.map(|(key, value)| Override::new(key, value, key));
    let arms = paper::arms(&overrides).unwrap();
    let (configs, places) = paper::trained(&arms);
    assert_eq!((configs.len(), places.len()), (26, 33));
    let train = |config: &Config| {
        let mut trainer = Trainer::new([config.validate().unwrap()]);
        trainer.finish(&mut Cpu::default()).unwrap();
        trainer.policies(0)
    };
    let mut different = 0;
    for (arm, &place) in arms.iter().zip(&places).filter(|(arm, place)| arm.config != configs[**place]) {
        let policies = train(&arm.config);
        assert!(policies == train(&configs[place]), "{}", arm.name());
        let mut with_g = arm.config.clone();
        with_g.learning.fitness = Fitness::G;
        different += usize::from(policies != train(&with_g));
    }
    assert!(different > 0, "fitness G selects the same policies");
}

#[test]
fn paper_writes_figures_runs_and_claims() {
    let place = Place::new(&[]).on_cpu().slow();
    let line = "paper --out paper --trials 2 --generations 3 --set learning.population=40 --quiet";
    let (stdout, _) = place.good(line);
    for figure in 4..=6 {
        let svg = place.read(format!("paper/figure{figure}.svg"));
        assert!(svg.contains("All-leaders teams") && svg.contains("Leader-follower teams"));
        assert!(svg.contains("best constant speed") && svg.contains("best of as many shared random networks"));
        assert!(["png", "pdf"].iter().all(|kind| place.bytes(format!("paper/figure{figure}.{kind}")).len() > 10_000));
    }
    let summary: Value = serde_json::from_str(&place.read("paper/summary.json")).unwrap();
    let arms = summary["arms"].as_array().unwrap();
    assert_eq!(arms.len(), 33 + 48);
    assert_eq!(summary["set"], serde_json::json!(["learning.population = 40"]));
    for arm in arms {
        for curve in ["generation", "mean", "error", "deviation"] {
            assert_eq!(arm[curve].as_array().unwrap().len(), 4, "{curve}");
        }
    }
    // Every arm has a run, including arms that share another arm's training.
    let folders = fs::read_dir(place.path("paper/arms")).unwrap().map(|entry| entry.unwrap().path());
    let folders: Vec<PathBuf> = folders.collect();
    assert_eq!(folders.len(), 33);
    let last = |folder: &str| {
        let matches = |arm: &&Value| {
            let [layout, paradigm, fitness] = ["layout", "paradigm", "source"].map(|key| arm[key].as_str().unwrap());
            let behaviours = if arm["selects"] == true { "-behaviours" } else { "" };
            folder == format!("{}-{paradigm}{behaviours}-{fitness}", layout.replace(' ', "-"))
        };
        let arm = arms.iter().find(matches).unwrap();
        arm["mean"][3].as_f64().unwrap() / arm["pois"].as_f64().unwrap()
    };
    for folder in &folders {
        assert!(fs::read_to_string(folder.join("config.toml")).unwrap().contains("\npopulation = 40\n"));
        let text = fs::read_to_string(folder.join("metrics.csv")).unwrap();
        let column = text.lines().next().unwrap().split(',').position(|name| name == "champion_g").unwrap();
        let champions: Vec<f64> = text
            .lines()
            .filter(|line| line.split(',').nth(1) == Some("3"))
            .map(|line| line.split(',').nth(column).unwrap().parse().unwrap())
            .collect();
        let name = folder.file_name().unwrap().to_str().unwrap();
        assert!((champions.iter().sum::<f64>() / 2.0 - last(name)).abs() < 1e-9, "{name}");
    }
    let shared = "paper/arms/chaotic-all-leaders-Df";
    place.good(&format!("train {shared}/config.toml --out again --quiet"));
    let [retrained, policies] = ["again", shared].map(|run| place.bytes(format!("{run}/policies.safetensors")));
    assert!(retrained == policies);
    let digest = |run: &str| {
        let run: Value = serde_json::from_str(&place.read(format!("{run}/run.json"))).unwrap();
        assert_eq!(run["state"], "done");
        run["digest"].clone()
    };
    assert_eq!(digest("again"), digest(shared));
    place.good(&format!("replay {shared} --trial 1"));
    place.good(&format!("plot {shared} paper/arms/chaotic-leader-follower-Df --out paper/x.svg"));
    // Three generations are too few for claims about 100 generations, and the table reports that.
    assert!(stdout.contains(" open (too few generations or trials)"), "{stdout}");
    let claims = place.read("paper/claims.md");
    assert!(claims.contains("2 trials, 3 generations, seed 0. Changed keys: `learning.population = 40`."), "{claims}");
    assert_eq!(claims.lines().filter(|line| line.starts_with("| ")).count(), (2 + 8) + (2 + 8) + (2 + 36));
    // Baselines without learning come first, on the page and in the output.
    assert!(claims.find("best constant speed").unwrap() < claims.find("The paper says").unwrap());
    assert!(stdout.find("best constant speed").unwrap() < stdout.find("The paper says").unwrap());
    let constant = arms.iter().filter(|arm| arm["source"] == "constant speed");
    let solved = constant
        .filter(|arm| arm["mean"].as_array().unwrap().iter().all(|mean| *mean == arm["pois"].as_f64().unwrap()));
    assert_eq!(solved.count(), 8);
}

/// Returns the files of a paper and the policies of its arms, by name.
fn outcome(out: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let entries = |folder: &Path| fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect::<Vec<_>>();
    let arms = entries(&out.join("arms")).into_iter().map(|arm| arm.join("policies.safetensors"));
    // The list of written files is left out, because it keeps lines about earlier versions.
    let files = entries(out).into_iter().filter(|path| path.is_file() && !path.ends_with(LIST));
    let files: Vec<PathBuf> = files.chain(arms).collect();
    let bytes = |path: PathBuf| {
        let bytes = fs::read(&path).unwrap();
        let name = path.strip_prefix(out).unwrap().to_path_buf();
        match name.to_str() {
            // The elapsed time differs between runs.
            Some("summary.json") => {
                let mut summary: Value = serde_json::from_slice(&bytes).unwrap();
                summary["seconds"] = 0.into();
                (name, summary.to_string().into_bytes())
            }
            _ => (name, bytes),
        }
    };
    files.into_iter().map(bytes).collect()
}

#[test]
fn a_paper_is_overwritten_only_with_force() {
    let place = trained(CONFIG);
    let out = place.path("paper");
    let line = |out: &str, flags: &str| format!("paper --out {out} --trials 2 --quiet {flags}");
    let paper = |flags: &str| place.good(&line("paper", flags));
    let refused = |out: &str, flags: &str, parts: &[&str]| place.fails(1, &line(out, flags), parts);
    let summary = place.json(&line("paper", "--generations 4 --json"));
    assert_eq!((&summary["trials"], &summary["generations"], &summary["seed"]), (&2.into(), &4.into(), &0.into()));
    for arm in summary["arms"].as_array().unwrap() {
        let folder = arm["folder"].as_str().unwrap();
        let run: Value = serde_json::from_str(&place.read(format!("{folder}/run.json"))).unwrap();
        assert_eq!(run["digest"], arm["digest"]);
        let metrics = place.read(format!("{folder}/metrics.csv"));
        let rows = metrics.lines().map(|line| line.split(',').collect::<Vec<_>>()).filter(|row| row[1] == "4");
        let rows: Vec<_> = rows.collect();
        for (name, column) in [("champion_g", 4), ("best_g", 2)] {
            let [first, second] = [0, 1].map(|trial| rows[trial][column].parse::<f64>().unwrap());
            assert_eq!(arm[name].as_f64(), Some((first + second) / 2.0), "{name}: {arm}");
        }
    }
    let original = outcome(&out);
    refused("paper", "--generations 4", &["holds a paper already", "--resume", "--force"]);
    refused("paper", "--generations 3 --resume", &["another paper", "generations: 4 there, 3 here"]);
    refused("paper", "--generations 4 --seed 1 --resume", &["another paper", "seed: 0 there, 1 here"]);
    assert!(outcome(&out) == original);

    // --resume restores missing files, and does not train the other arms again.
    let run = out.join("arms/chaotic-leader-follower-G/run.json");
    let before = fs::read(&run).unwrap();
    for missing in ["figure5.svg", "claims.md", "arms/chaotic-all-leaders-Df/policies.safetensors"] {
        fs::remove_file(out.join(missing)).unwrap();
    }
    paper("--generations 4 --resume");
    assert!(outcome(&out) == original && fs::read(&run).unwrap() == before);

    // An extended paper equals one that was longer from the start.
    paper("--generations 6 --resume");
    place.good(&line("longer", "--generations 6"));
    assert!(outcome(&out) == outcome(&place.path("longer")));

    // --force overwrites only the paper's own files. A folder with other results is refused.
    fs::write(out.join("notes.txt"), "mine").unwrap();
    paper("--generations 4 --force");
    assert_eq!(fs::read(out.join("notes.txt")).unwrap(), b"mine");
    fs::remove_file(out.join("notes.txt")).unwrap();
    assert!(outcome(&out) == original);
    for flag in ["", "--resume"] {
        refused("run", &format!("--generations 4 {flag}"), &["holds a run, no paper"]);
    }
    for (folder, file) in [("sweep", "sweep.toml"), ("old", "figure4.svg")] {
        fs::create_dir(place.path(folder)).unwrap();
        place.write(format!("{folder}/{file}"), "");
    }
    refused("sweep", "", &["holds a sweep, no paper"]);
    for flag in ["", "--resume", "--force"] {
        refused("old", flag, &["holds figure4.svg but no paper.toml"]);
    }
    assert!(place.path("old/figure4.svg").exists());
    refused("sweep", "--force", &["holds a sweep, no paper"]);
    refused("sweep/sweep.toml", "", &["is a file"]);
}

#[cfg(unix)]
#[test]
fn a_paper_stopped_by_a_signal_resumes_to_the_same_files() {
    use std::process::{Command, Stdio};
    let place = Place::new(&[]).slow();
    let out = place.path("a paper");
    let flags = ["--trials", "1", "--generations", "25", "--backend", "cpu", "--quiet"];
    // The folder has an older paper, which --force overwrites. Its files must not disturb the resume.
    let older = ["--trials", "1", "--generations", "1", "--seed", "9", "--backend", "cpu", "--quiet"];
    place.good(&[&["paper", "--out", "a paper"], &older[..]].concat());
    let mut child = support::flotilla();
    child.args(["paper", "--force", "--out"]).arg(&out).args(flags);
    let child = child.stderr(Stdio::piped()).spawn().unwrap();
    let run = out.join("arms/chaotic-leader-follower-Df/run.json");
    let is_training =
        || fs::read_to_string(&run).is_ok_and(|text| text.contains("\"seed\": 0") && text.contains("running"));
    let start = std::time::Instant::now();
    while !is_training() {
        assert!(start.elapsed().as_secs() < 60, "training does not start");
        std::thread::sleep(std::time::Duration::from_millis(2));
    }
    assert!(Command::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap().success());
    let output = child.wait_with_output().unwrap();
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(75), "{stderr}");
    assert!(stderr.starts_with("stopped: before generation"), "{stderr}");
    let command = stderr.lines().last().unwrap().trim();
    assert!(command.starts_with("flotilla paper --out '") && command.ends_with("--resume --backend cpu"), "{command}");
    assert!(!out.join("claims.md").exists());
    let resumed = support::shell("sh", command).output().unwrap();
    assert!(resumed.status.success(), "{}", String::from_utf8_lossy(&resumed.stderr));
    place.good(&[&["paper", "--out", "whole"], &flags[..]].concat());
    assert!(outcome(&out) == outcome(&place.path("whole")));
}

/// Tests that pictures in docs/ have a title and a description, like the program's own pictures.
#[test]
fn pictures_in_the_docs_have_descriptions() {
    let mut folders = vec![Path::new(crate::ROOT).join("docs")];
    let mut pictures = 0;
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|ending| ending == "svg") {
                let svg = fs::read_to_string(&path).unwrap();
                for element in ["<title id=\"title\">", "<desc id=\"description\">"] {
                    let text = svg.split(element).nth(1).and_then(|rest| rest.split('<').next()).unwrap_or_default();
                    assert!(text.len() > 20, "{}: {element}", path.display());
                }
                pictures += 1;
            }
        }
    }
    assert!(pictures > 10);
}
