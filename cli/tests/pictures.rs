//! Compares pictures with saved references, pixel by pixel. `FLOTILLA_WRITE=1` writes the references again.
//!
//! `tests/pictures.py` compares SVG files, drawn by another program, with PNG files.

use std::fs;
use std::io::Cursor;
use std::path::Path;

use flotilla::backend::cpu::Cpu;
use flotilla::config::{Config, Fitness};
use flotilla::trainer::Trainer;
use flotilla_app::report::replay;
use serde_json::Value;

use crate::support::{Place, tiny};

/// Pictures of a small run: the name of the reference, and the command that draws it.
const PICTURES: [(&str, &str); 4] = [
    ("layout", "check small.toml"),
    ("curves", "plot run"),
    ("comparison", "plot run other"),
    ("still", "replay run --team best --quiet"),
];
/// References are smaller than the pictures by this factor, and grey.
const SHRINK: usize = 4;

/// The pixels of a picture, row by row.
struct Pixels {
    width: usize,
    height: usize,
    colors: Vec<[u8; 3]>,
}

impl Pixels {
    fn from_png(bytes: &[u8]) -> Pixels {
        let mut reader = png::Decoder::new(Cursor::new(bytes)).read_info().unwrap();
        let mut content = vec![0; reader.output_buffer_size().unwrap()];
        let frame = reader.next_frame(&mut content).unwrap();
        let colors = match frame.color_type {
            png::ColorType::Rgb => content.as_chunks::<3>().0.to_vec(),
            png::ColorType::Grayscale => content.iter().map(|&grey| [grey; 3]).collect(),
            other => panic!("{other:?}"),
        };
        Pixels { width: frame.width as usize, height: frame.height as usize, colors }
    }

    /// Returns a grey picture, smaller by [`SHRINK`].
    fn shrunk(&self) -> Pixels {
        let (width, height) = (self.width / SHRINK, self.height / SHRINK);
        let grey = |at: usize| {
            let (x, y) = (at % width * SHRINK, at / width * SHRINK);
            let block = (0..SHRINK * SHRINK).map(|k| self.colors[(y + k / SHRINK) * self.width + x + k % SHRINK]);
            let sum: usize = block.flatten().map(usize::from).sum();
            [(sum / (3 * SHRINK * SHRINK)) as u8; 3]
        };
        Pixels { width, height, colors: (0..width * height).map(grey).collect() }
    }

    /// Returns the share of pixels in which a colour differs by more than `tolerance`.
    fn differing(&self, other: &Pixels, tolerance: u8) -> f64 {
        assert_eq!((self.width, self.height), (other.width, other.height));
        let differs = |(a, b): (&[u8; 3], &[u8; 3])| (0..3).any(|color| a[color].abs_diff(b[color]) > tolerance);
        let count = self.colors.iter().zip(&other.colors).filter(|&pair| differs(pair)).count();
        count as f64 / self.colors.len() as f64
    }

    fn write(&self, path: &Path) {
        let mut encoder = png::Encoder::new(fs::File::create(path).unwrap(), self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Grayscale);
        let grey: Vec<u8> = self.colors.iter().map(|color| color[0]).collect();
        encoder.write_header().unwrap().write_image_data(&grey).unwrap();
    }
}

fn place() -> Place {
    let place = Place::new(&[("small.toml", &tiny(6, "generations = 0"))]);
    place.good("train small.toml --out run --quiet --backend cpu");
    place.good("train small.toml --out other --fitness D --seed 3 --quiet --backend cpu");
    place
}

fn draw(place: &Place, command: &str, file: &str) -> Vec<u8> {
    place.good(&format!("{command} --out {file}"));
    place.bytes(file)
}

#[test]
fn pictures_equal_their_references() {
    let place = place();
    let folder = Path::new(crate::ROOT).join("cli/tests/pictures");
    for (name, command) in PICTURES {
        let drawn = Pixels::from_png(&draw(&place, command, "x.png")).shrunk();
        let path = folder.join(format!("{name}.png"));
        if std::env::var("FLOTILLA_WRITE").is_ok_and(|write| write == "1") {
            drawn.write(&path);
        }
        let reference = Pixels::from_png(&fs::read(&path).unwrap());
        let size = |pixels: &Pixels| (pixels.width, pixels.height);
        assert_eq!(size(&drawn), size(&reference), "{name}");
        let differing = drawn.differing(&reference, 8);
        assert!(differing == 0.0, "{name}: {differing} of the pixels differ from {}", path.display());
    }
}

/// The page opens with a recorded episode. If pages change, `node web/opening.mjs web/dist/index.html` records it again.
#[test]
fn the_episode_that_the_page_opens_with_is_current() {
    fn rounded(value: &mut Value) {
        match value {
            // JavaScript writes 1.0 as 1, and readers differ in the last bit of f64.
            Value::Number(number) => *value = (number.as_f64().unwrap() as f32).into(),
            Value::Array(values) => values.iter_mut().for_each(rounded),
            Value::Object(values) => values.values_mut().for_each(rounded),
            _ => (),
        }
    }
    let read = |path: &str| fs::read_to_string(Path::new(crate::ROOT).join("web").join(path)).unwrap();
    let mut opening: Value = serde_json::from_str(&read("page/opening.json")).unwrap();
    let [trial, generation] = ["trial", "generation"].map(|key| opening[key].as_u64().unwrap() as usize);
    let config = Config::parse(&read("gallery/two_groups.toml"), "two_groups.toml").unwrap().validate().unwrap();
    let mut trainer = Trainer::of_trial(&config, trial);
    while trainer.generation(0) <= generation {
        trainer.advance(&mut Cpu::default()).unwrap();
    }
    let mut timed = Config::clone(&config);
    timed.learning.fitness = Fitness::Dt;
    let config = config.at(generation);
    let mut played = replay::champion(config, &timed, &mut trainer, trial, &mut Cpu::default()).unwrap();
    played.led.clear();
    let mut data = replay::detailed("", config, &[played]);
    rounded(&mut data);
    rounded(&mut opening["data"]);
    assert!(data == opening["data"], "web/page/opening.json is out of date");
}
