//! The version and commit of this build.

/// The commit that this build was made from, if it is known. Debug builds do not know it.
pub const COMMIT: Option<&str> = {
    let commit = env!("FLOTILLA_COMMIT");
    if commit.is_empty() { None } else { Some(commit) }
};

/// The version of this crate, as recorded in `run.json`.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");

/// The target that this build was made for.
pub const TARGET: &str = env!("FLOTILLA_TARGET");
