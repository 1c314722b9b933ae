//! Golden digests and short trainings, for whoever runs WebAssembly: `run.mjs` does, in Node.

use flotilla::backend::cpu::Cpu;
use flotilla::backend::Backend;

#[allow(dead_code, unused_imports, reason = "its tests are not built here")]
#[path = "../golden.rs"]
mod golden;

#[link(wasm_import_module = "host")]
unsafe extern "C" {
    /// Takes a line of text.
    fn say(text: *const u8, length: usize);
}

fn tell(line: &str) {
    // SAFETY: the text is there until `say` comes back.
    unsafe { say(line.as_ptr(), line.len()) }
}

/// Trains every golden case, which panics (and so traps) where one differs, and then tells of each short training its
/// name and digest with a tab between.
#[unsafe(no_mangle)]
pub extern "C" fn run() {
    std::panic::set_hook(Box::new(|panic| tell(&panic.to_string())));
    let mut backend = Cpu::default();
    golden::check("WebAssembly", &mut backend);
    tell(&backend.describe());
    let (names, configs): (Vec<_>, Vec<_>) = flotilla::verify::short_trainings().into_iter().unzip();
    for (name, (came, _)) in names.iter().zip(golden::train(&configs, &mut backend)) {
        tell(&format!("{name}\t{}", came.sha256));
    }
}
