use std::io::{self, Write};
use std::process::ExitCode;

fn main() -> ExitCode {
    match flotilla::cli::run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            // With standard error gone there is nobody left to tell.
            let _ = writeln!(io::stderr(), "error: {error}");
            ExitCode::FAILURE
        }
    }
}
