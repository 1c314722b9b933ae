//! Sets up the process before its command, for the program and for the command in the Python package.

use super::{Error, say};
use flotilla_app::ops::output;

/// Sets the process up: silences drivers, and turns the system's limits into errors that can be reported.
pub fn set_up() -> Result<(), Error> {
    suppress_driver_noise();
    output::report_waiting(|text| say(text));
    #[cfg(unix)]
    {
        allow_many_files();
        fail_large_files()?;
    }
    Ok(())
}

/// Vulkan's layers look for a Wayland display. Its library prints a complaint if XDG_RUNTIME_DIR does not name the
/// display's folder. Nothing here needs a display, so this names a folder that cannot exist. A process that already has
/// threads is left alone, because changing its environment is unsafe. The Python package sets the variable itself.
fn suppress_driver_noise() {
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

/// Raises the limit of open files. A sweep keeps files of all its points open, and some systems allow only 256 by
/// default.
#[cfg(unix)]
fn allow_many_files() {
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    /// macOS allows no more, even if it reports a larger limit.
    const MAX_OPEN_FILES: u64 = 10_240;
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    let wanted = maximum.map_or(MAX_OPEN_FILES, |maximum| maximum.min(MAX_OPEN_FILES));
    if current.is_some_and(|current| current < wanted) {
        // If this is refused, the error appears when a file cannot be opened.
        let _ = setrlimit(Resource::Nofile, Rlimit { current: Some(wanted), maximum });
    }
}

/// Turns writing beyond the system's file size limit (`ulimit -f`) into an error. Otherwise the signal would end the
/// process.
#[cfg(unix)]
fn fail_large_files() -> Result<(), Error> {
    let never_read = std::sync::Arc::default();
    signal_hook::flag::register(signal_hook::consts::SIGXFSZ, never_read).map_err(Error::Signals)?;
    Ok(())
}
