//! What a process sets up before its command, for the program and for the command that comes with the Python package.

use super::Error;

/// Sets the process up: calms drivers, and makes the system's limits errors instead of surprises.
///
/// # Errors
/// The system does not let signals be listened for.
pub fn set_up() -> Result<(), Error> {
    calm_drivers();
    #[cfg(unix)]
    {
        allow_many_files();
        fail_large_files()?;
    }
    Ok(())
}

/// Vulkan's layers look for a Wayland display, and its library complains on standard error if XDG_RUNTIME_DIR does not say
/// in which folder. Nothing here needs a display, so this names a folder that cannot exist. Processes that have threads
/// already (Python's, once NumPy is loaded) set this themselves.
fn calm_drivers() {
    let name = "XDG_RUNTIME_DIR";
    let valid = std::env::var_os(name).is_some_and(|folder| std::path::Path::new(&folder).is_absolute());
    let alone = || std::fs::read_dir("/proc/self/task").is_ok_and(|threads| threads.count() == 1);
    if cfg!(target_os = "linux") && !valid && alone() {
        // SAFETY: the process has no other thread that could read the environment.
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
        // If this is refused, the error appears when a file cannot be opened.
        let _ = setrlimit(Resource::Nofile, Rlimit { current: Some(wanted), maximum });
    }
}

/// Where the system limits the size of files (`ulimit -f`), writing beyond it is an error to report, not the end.
#[cfg(unix)]
fn fail_large_files() -> Result<(), Error> {
    let never_read = std::sync::Arc::default();
    signal_hook::flag::register(signal_hook::consts::SIGXFSZ, never_read).map_err(Error::Signals)?;
    Ok(())
}
