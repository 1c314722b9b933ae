// Runs flotilla in a worker, one request at a time. The build puts the glue code of wasm-bindgen before this script.
const suspends = typeof WebAssembly.Suspending === "function" && typeof WebAssembly.promising === "function";
let woken = false, resume = null;

// Functions that the crate imports.
const now = () => performance.now();
const tell = text => self.postMessage({ told: JSON.parse(text) });
function wake() {
  woken = true;
  if (resume) resume();
}
async function park() {
  if (!woken) await new Promise(done => { resume = done; });
  woken = false;
  resume = null;
}

// If the browser can suspend WebAssembly, replace the import that waits with one that suspends.
if (suspends) {
  const Instance = WebAssembly.Instance;
  WebAssembly.Instance = function (module, imports) {
    for (const group of Object.values(imports))
      for (const name of Object.keys(group)) if (name.startsWith("__wbg_park_")) group[name] = new WebAssembly.Suspending(park);
    return new Instance(module, imports);
  };
}

// Joins numbers that were sent in parts.
function joined(parts) {
  const whole = new Uint8Array(parts.reduce((sum, part) => sum + part.byteLength, 0));
  parts.reduce((at, part) => (whole.set(part, at), at + part.byteLength), 0);
  return whole;
}

let call = null;
async function answer({ id, words, bytes, module }) {
  try {
    if (module) {
      const wasm = wasm_bindgen.initSync({ module });
      wasm_bindgen.start();
      call = suspends ? WebAssembly.promising(wasm.call) : async () => wasm.call();
      return self.postMessage({ id, words: { suspends } });
    }
    wasm_bindgen.put(JSON.stringify(words), Array.isArray(bytes) ? joined(bytes) : bytes || new Uint8Array());
    await call();
    const answered = JSON.parse(wasm_bindgen.answer()), numbers = wasm_bindgen.bytes();
    self.postMessage({ id, words: answered, bytes: numbers }, [numbers.buffer]);
  } catch (error) {
    self.postMessage({ id, words: { error: `the worker failed: ${error}`, fatal: true } });
  }
}

// Requests run one after the other, because only one WebAssembly stack can be suspended at a time.
let turn = Promise.resolve();
self.onmessage = ({ data }) => { turn = turn.then(() => answer(data)); };
