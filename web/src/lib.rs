//! flotilla in a browser tab: the crate, compiled to WebAssembly, and its interface to the page.
//!
//! Each worker has its own instance. A request is passed with [`put`] and run with [`call`]. The response is read with
//! [`answer`], as JSON, and [`bytes`], as little-endian numbers.
//!
//! Only `call` may wait for a GPU. If the browser can suspend WebAssembly, the page calls it as a promise. Otherwise
//! the page uses the CPU, which never waits.
#![cfg(target_family = "wasm")]

use std::cell::RefCell;
use std::time::Duration;

use flotilla::host::{self, Host};
use serde_json::{Value, json};
use wasm_bindgen::prelude::*;

mod answer;
mod archive;
mod ask;
mod baseline;
mod drive;
mod edit;
mod experiments;
mod train;

use answer::Answer;
use ask::Session;

#[wasm_bindgen]
extern "C" {
    /// Milliseconds since the worker started.
    fn now() -> f64;
    /// Milliseconds since the start of 1970.
    #[wasm_bindgen(js_namespace = Date, js_name = now)]
    fn date() -> f64;
    /// Waits until `wake` is called. The worker replaces this import with one that suspends WebAssembly.
    fn park();
    fn wake();
    /// Sends progress to the page, as JSON.
    fn tell(text: &str);
}

thread_local! {
    static SESSION: RefCell<Session> = RefCell::default();
    static ASKED: RefCell<(String, Vec<u8>)> = RefCell::default();
    static ANSWERED: RefCell<Answer> = RefCell::default();
}

fn milliseconds(count: f64) -> Duration {
    Duration::from_secs_f64(count / 1000.0)
}

/// Installs the panic hook and the host functions. Call it once, before any other function.
#[wasm_bindgen]
pub fn start() {
    std::panic::set_hook(Box::new(|info| tell(&json!({ "panic": info.to_string() }).to_string())));
    let since_1970 = || milliseconds(date());
    host::install(Host { now: || milliseconds(now()), since_1970, park: || park(), wake: || wake() });
}

/// Sets the request that the next [`call`] runs.
#[wasm_bindgen]
pub fn put(text: String, bytes: Vec<u8>) {
    ASKED.set((text, bytes));
}

/// Runs the request that was set last.
#[wasm_bindgen]
pub fn call() {
    let (text, bytes) = ASKED.take();
    let answered = SESSION.with_borrow_mut(|session| ask::answer(session, &text, &bytes));
    ANSWERED.set(answered.unwrap_or_else(|error| (error.into(), vec![])));
}

/// Returns the JSON of the response, and clears it.
#[wasm_bindgen]
pub fn answer() -> String {
    ANSWERED.with_borrow_mut(|(words, _)| std::mem::take(words).to_string())
}

/// Returns the numbers of the response, and clears them.
#[wasm_bindgen]
pub fn bytes() -> Vec<u8> {
    ANSWERED.with_borrow_mut(|(_, bytes)| std::mem::take(bytes))
}

fn progress(words: Value) {
    tell(&words.to_string());
}
