// Runs the WebAssembly of tests/ports in Node.
//
//     node run.mjs FILE.wasm

import { readFileSync } from "node:fs";

const lines = [];
const { instance } = await WebAssembly.instantiate(readFileSync(process.argv[2]), {
  host: {
    say(at, length) {
      const text = new TextDecoder().decode(new Uint8Array(instance.exports.memory.buffer, at, length));
      lines.push(text);
      console.log(text);
    },
  },
});
instance.exports.run();
if (lines.length !== 1) throw new Error(`expected one line: ${lines}`);
