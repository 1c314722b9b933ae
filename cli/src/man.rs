//! `flotilla man`: writes manual pages, one per command.

use std::fs;
use std::path::PathBuf;

use clap::CommandFactory;
use clap_mangen::Man;

use super::{Cli, Error, print};
use flotilla::escape::PathExt;
use flotilla_app::record::RecordError;
use flotilla_app::record::disk::Disk;
use flotilla_app::record::ownership;

#[derive(clap::Args)]
pub struct Args {
    /// Directory for the pages flotilla.1, flotilla-train.1, …
    #[arg(long, short, value_name = "DIR", default_value = "man")]
    out: PathBuf,
}

/// The text by which a manual page of this program is recognised, so that it can be overwritten.
const TITLE: &str = ".TH flotilla";

/// Writes the pages, and overwrites earlier versions of them.
pub fn run(args: Args) -> Result<(), Error> {
    let disk = ownership::create_output_folder(&Disk::default(), &args.out, true)?;
    let mut all = Cli::command().disable_help_subcommand(true);
    all.build();
    let commands: Vec<_> = std::iter::once(&all).chain(all.get_subcommands()).cloned().collect();
    for page in
        commands.into_iter().map(|command| Man::new(command).source(concat!("flotilla ", env!("CARGO_PKG_VERSION"))))
    {
        let path = args.out.join(page.get_filename());
        if path.symlink_metadata().is_ok() && !fs::read_to_string(&path).is_ok_and(|text| text.contains(TITLE)) {
            return Err(RecordError::NotOurs(path).into());
        }
        disk.replace(&path, |output| page.render(output)).map_err(RecordError::write(&path))?;
    }
    print(&format!("{}\n", args.out.escaped()))
}
