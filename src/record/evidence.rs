//! What was seen on a machine: the small file that `flotilla verify --report` writes. `docs/develop/evidence.md` is made of
//! such.

use serde::{Deserialize, Serialize};

use super::folder::now;

/// Of the files' layout.
pub const SCHEMA: u32 = 1;

/// What a file tells.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sighting {
    /// [`SCHEMA`].
    pub schema: u32,
    /// How much it is worth.
    pub tier: Tier,
    /// Day, UTC: "2026-01-31".
    pub date: String,
    /// Of the program.
    pub version: String,
    /// What the program was built from, where that is known.
    pub commit: Option<String>,
    /// What the program was built for: "x86_64-unknown-linux-gnu".
    pub target: String,
    /// The compiler that built it: "rustc 1.95.0 (…)".
    pub toolchain: String,
    /// What the processor calls itself, where the system says.
    pub processor: Option<String>,
    /// The widest instruction set that it was played by.
    pub instructions: Option<String>,
    /// Anything else that was there: an emulator, a driver.
    pub note: Option<String>,
    /// What was done and found besides comparing, in words.
    #[serde(default)]
    pub findings: Vec<String>,
    /// Backends compared, bit by bit.
    #[serde(default)]
    pub comparisons: Vec<Compared>,
    /// What short trainings came to.
    #[serde(default)]
    pub trained: Vec<ShortTraining>,
}

/// How much a row is worth, the most first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Tier {
    /// It ran there, and the bits were compared.
    Executed,
    /// A driver's own compiler made code for it, which was read.
    MachineCodeRead,
    /// It compiles.
    Compiled,
}

/// Episodes and trainings played on two sides.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Compared {
    /// What was compared: an adapter with its driver, or "cpu (AVX2)".
    pub adapter: String,
    /// Where that is a GPU.
    pub pass: Option<String>,
    /// How its shaders were made: `generic`, or `specialised` for each world.
    pub kernel: Option<String>,
    /// What it was compared with: "cpu (SSE2)".
    pub against: String,
    /// Worlds that were found equal.
    pub worlds: usize,
    /// Steps of agents in these.
    pub agent_steps: u64,
    /// Whether every bit was the same.
    pub equal: bool,
    /// What differs, or went wrong.
    pub failure: Option<String>,
}

/// A training, and the digest that `flotilla train` prints of it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShortTraining {
    /// What was trained.
    pub config: String,
    /// SHA-256 of its results.
    pub digest: String,
}

impl Sighting {
    /// Of this program, today.
    pub fn new(tier: Tier) -> Sighting {
        Sighting {
            schema: SCHEMA,
            tier,
            date: now()[..10].into(),
            version: env!("CARGO_PKG_VERSION").into(),
            commit: crate::COMMIT.map(String::from),
            target: env!("FLOTILLA_TARGET").into(),
            toolchain: env!("FLOTILLA_RUSTC").into(),
            processor: None,
            instructions: None,
            note: None,
            findings: vec![],
            comparisons: vec![],
            trained: vec![],
        }
    }

    /// Reads the text of such a file.
    ///
    /// # Errors
    /// What is wrong with it, in words.
    pub fn parse(text: &str) -> Result<Sighting, String> {
        let found: Sighting = serde_json::from_str(text).map_err(|error| format!("it is no evidence: {error}"))?;
        match found.schema {
            SCHEMA => Ok(found),
            other => Err(format!("it has schema {other}, known is {SCHEMA}")),
        }
    }

    /// As a file holds it.
    pub fn to_json(&self) -> String {
        let text = serde_json::to_string_pretty(self).expect("texts and numbers are JSON");
        format!("{text}\n")
    }
}
