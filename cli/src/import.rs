//! `flotilla import`: translates a config of the authors' programs.

use std::path::PathBuf;

use super::{Error, print, say, with_remedy};
use flotilla::config::{self, ConfigError};
use flotilla::escape::PathExt;
use flotilla_app::import;
use flotilla_app::ops::output;

#[derive(clap::Args)]
pub struct Args {
    /// Config file (YAML) of the program influence shaping or leader-follower, or - for standard input
    file: PathBuf,
    /// New file to write [default: standard output]
    #[arg(long, short, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Overwrite the file
    #[arg(long, requires = "out")]
    force: bool,
}

/// Prints or writes the config, and lists the keys without an exact equivalent on standard error.
pub fn run(args: Args) -> Result<(), Error> {
    let Args { file, out, force } = args;
    output::check(&[("--out", out.as_deref())], &[&file])?;
    let text = config::read_file(&file).map_err(|error| match error {
        // Other commands advise `flotilla init`, which writes no YAML.
        ConfigError::Unreadable { is_missing: true, .. } => {
            Error::Missing(with_remedy(error.to_string(), "check the path"))
        }
        error => error.into(),
    })?;
    let found = import::translate(&text, &config::name(&file))?;
    match &out {
        None => print(&found.text)?,
        Some(path) => {
            let write = if force { output::write } else { output::write_new };
            write(path, found.text.as_bytes())?;
            print(&format!("{}\n", path.escaped()))?;
        }
    }
    found.skipped.iter().for_each(say);
    if !found.skipped.is_empty() {
        say(format_args!("keys without an exact equivalent: {}; the config has them as comments", found.skipped.len()));
    }
    Ok(())
}
