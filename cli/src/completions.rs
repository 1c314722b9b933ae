//! `flotilla completions`: prints a script that completes commands and flags in a shell.

use clap::CommandFactory;
use clap_complete::Shell;

use super::{Cli, Error, print};

#[derive(clap::Args)]
pub struct Args {
    /// Shell to complete in
    #[arg(value_enum)]
    shell: Shell,
}

/// Prints the script. `docs/reference/commands.md` describes where each shell looks for it.
pub fn run(args: Args) -> Result<(), Error> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut Cli::command(), "flotilla", &mut script);
    print(&String::from_utf8_lossy(&script))
}
