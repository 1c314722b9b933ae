//! Record of a check on one machine. `flotilla verify --report` writes it as a small file, and
//! `docs/develop/evidence.md` is generated from these files.

use serde::{Deserialize, Serialize};

use super::folder::now;

/// Version of the file format.
pub const SCHEMA: u32 = 1;

/// Content of a report file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MachineReport {
    /// Version of the file format, [`SCHEMA`].
    pub schema: u32,
    /// Strength of the evidence.
    pub tier: Tier,
    /// Date in UTC, such as "2026-01-31".
    pub date: String,
    /// Version of the program.
    pub version: String,
    /// Commit that the program was built from, if known.
    pub commit: Option<String>,
    /// Target that the program was built for, such as "x86_64-unknown-linux-gnu".
    pub target: String,
    /// Compiler that built the program, such as "rustc 1.95.0 (…)".
    pub toolchain: String,
    /// Name of the processor, if the system reports it.
    pub processor: Option<String>,
    /// Widest instruction set that was used to play.
    pub instructions: Option<String>,
    /// Other conditions, such as an emulator or a driver.
    pub note: Option<String>,
    /// Other actions and findings, as text.
    #[serde(default)]
    pub findings: Vec<String>,
    /// Backends that were compared bit by bit.
    #[serde(default)]
    pub comparisons: Vec<Compared>,
    /// Results of short trainings.
    #[serde(default)]
    pub trained: Vec<ShortTraining>,
}

/// Strength of the evidence, strongest first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Tier {
    /// The program ran there, and the bits were compared.
    Executed,
    /// The driver's own compiler produced machine code, which was read.
    MachineCodeRead,
    /// The program compiles for it.
    Compiled,
}

/// Comparison of episodes and trainings on two backends.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Compared {
    /// The compared processor: an adapter with its driver, or "cpu (AVX2)".
    pub adapter: String,
    /// Compile pass of the shaders, for a GPU.
    pub pass: Option<String>,
    /// How the shaders were compiled: `generic`, or `specialised` for each world.
    pub kernel: Option<String>,
    /// The reference processor, such as "cpu (SSE2)".
    pub against: String,
    /// Number of worlds with equal results.
    pub worlds: usize,
    /// Number of agent steps in these worlds.
    pub agent_steps: u64,
    /// Whether all bits were equal.
    pub equal: bool,
    /// Description of a difference or an error.
    pub failure: Option<String>,
}

/// A short training and the digest that `flotilla train` prints for it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShortTraining {
    /// Name of the config.
    pub config: String,
    /// SHA-256 of the results.
    pub digest: String,
}

impl MachineReport {
    /// Creates a report of this program with today's date.
    pub fn new(tier: Tier) -> MachineReport {
        MachineReport {
            schema: SCHEMA,
            tier,
            date: now()[..10].into(),
            version: flotilla::version::VERSION.into(),
            commit: flotilla::version::COMMIT.map(String::from),
            target: flotilla::version::TARGET.into(),
            toolchain: flotilla::version::COMPILER.into(),
            processor: None,
            instructions: None,
            note: None,
            findings: vec![],
            comparisons: vec![],
            trained: vec![],
        }
    }

    /// Reads the text of a report file.
    ///
    /// # Errors
    /// Returns a description of the problem.
    pub fn parse(text: &str) -> Result<MachineReport, String> {
        let found: MachineReport =
            serde_json::from_str(text).map_err(|error| format!("not a machine report: {error}"))?;
        match found.schema {
            SCHEMA => Ok(found),
            other => Err(format!("schema {other} is unknown; this version reads {SCHEMA}")),
        }
    }

    /// Returns the text of a report file.
    pub fn to_json(&self) -> String {
        let text = serde_json::to_string_pretty(self).expect("texts and numbers are JSON");
        format!("{text}\n")
    }
}
