//! Computes the golden digests as WebAssembly. `run.mjs` runs it in Node.

use flotilla::backend::cpu::Cpu;
use flotilla::backend::Backend;

#[allow(dead_code, unused_imports, reason = "only `check` is used")]
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

/// Trains every golden case. If a digest differs, it panics, which is a trap in WebAssembly.
#[unsafe(no_mangle)]
pub extern "C" fn run() {
    std::panic::set_hook(Box::new(|panic| print(&panic.to_string())));
    let mut backend = Cpu::default();
    golden::check("WebAssembly", &mut backend);
    print(&format!("every golden digest is equal on {}", backend.describe()));
}
