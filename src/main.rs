use std::process::ExitCode;

use flotilla::cli::{self, Error};

fn main() -> ExitCode {
    match cli::run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let word = if matches!(error, Error::Stopped(_)) { "stopped" } else { "error" };
            cli::say(format_args!("{word}: {error}"));
            ExitCode::from(error.exit_code())
        }
    }
}
