use std::process::ExitCode;

use flotilla::cli::{self, Error};

fn main() -> ExitCode {
    calm_drivers();
    #[cfg(unix)]
    allow_many_files();
    match fail_large_files().and_then(|()| cli::run()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let word = if matches!(error, Error::Stopped(_)) { "stopped" } else { "error" };
            cli::say(format_args!("{word}: {error}"));
            ExitCode::from(error.exit_code())
        }
    }
}

/// Vulkan's layers look for a Wayland display, and its library complains on standard error where XDG_RUNTIME_DIR does
/// not say in which folder. Nobody's display is wanted here, so it is given a folder that cannot be.
fn calm_drivers() {
    let name = "XDG_RUNTIME_DIR";
    let valid = std::env::var_os(name).is_some_and(|folder| std::path::Path::new(&folder).is_absolute());
    if cfg!(target_os = "linux") && !valid {
        // SAFETY: the process has no other thread yet that could read the environment.
        #[expect(unsafe_code, reason = "the environment is only safe to change while there is one thread")]
        unsafe {
            std::env::set_var(name, "/dev/null");
        }
    }
}

/// A sweep keeps files of all its points open, and some systems allow a process 256 unless it asks for more.
#[cfg(unix)]
fn allow_many_files() {
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    /// macOS allows no more, whatever it says that it would.
    const MOST: u64 = 10_240;
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    let wanted = maximum.map_or(MOST, |maximum| maximum.min(MOST));
    if current.is_some_and(|current| current < wanted) {
        // Refused, it stays as it was, and what is too much is told when it happens.
        let _ = setrlimit(Resource::Nofile, Rlimit { current: Some(wanted), maximum });
    }
}

/// Where the system limits the size of files (`ulimit -f`), writing beyond it is an error to be told, not the end.
fn fail_large_files() -> Result<(), Error> {
    #[cfg(unix)]
    signal_hook::flag::register(signal_hook::consts::SIGXFSZ, std::sync::Arc::default()).map_err(Error::Signals)?;
    Ok(())
}
