//! Computes the golden digests and the short trainings as WebAssembly. `run.mjs` runs it in Node.

use flotilla::backend::cpu::Cpu;
use flotilla::backend::Backend;

#[allow(dead_code, unused_imports, reason = "only `check` and `train` are used")]
#[path = "../golden.rs"]
mod golden;

#[link(wasm_import_module = "host")]
unsafe extern "C" {
    /// Receives a line of text.
    fn say(text: *const u8, length: usize);
}

fn print(line: &str) {
    // SAFETY: the text is valid until `say` returns.
    unsafe { say(line.as_ptr(), line.len()) }
}

/// Trains every golden case. If a digest differs, it panics, which is a trap in WebAssembly. Then prints the name and
/// the digest of each short training, separated by a tab.
#[unsafe(no_mangle)]
pub extern "C" fn run() {
    std::panic::set_hook(Box::new(|panic| print(&panic.to_string())));
    let mut backend = Cpu::default();
    golden::check("WebAssembly", &mut backend);
    print(&backend.describe());
    let (names, configs): (Vec<_>, Vec<_>) = flotilla::verify::short_trainings().into_iter().unzip();
    for (name, (digest, _)) in names.iter().zip(golden::train(&configs, &mut backend)) {
        print(&format!("{name}\t{}", digest.sha256));
    }
}
