// Tests the modules of the page that need no browser, or only a small imitation of one: node --test web/units.mjs

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { deflateSync } from "node:zlib";
import { choice_of, comparison, label, read, slug, styles, toml, write } from "./page/compare.js";
import { angles, moment, words } from "./page/senses.js";
import { csv } from "./page/table.js";

test("comparisons are written to links and read back, and damaged ones are rejected", () => {
  for (const choice of ["paradigm", "fitness", "population"]) {
    const compared = comparison(choice, 500);
    assert.deepEqual(read(write(compared)), compared);
    assert.equal(choice_of(compared, 500), choice);
  }
  assert.equal(comparison("none", 500), null);
  assert.equal(choice_of(null, 500), "none");
  assert.equal(choice_of({ key: "sense.poi_range", values: ["0", "inf"] }, 500), "own");
  const damaged = ["", "learning.fitness", "learning.fitness:G", "fitness:G,D", "a.b:1,1", "a.b:1,,2", "a.b:1, 2"];
  const too_many = "a.b:1,2,3,4,5,6,7";
  for (const text of [...damaged, too_many]) assert.equal(read(text), null, text);
});

test("compared populations are a tenth, one and ten times as large, at least 2, and distinct", () => {
  assert.deepEqual(comparison("population", 50).values, ["5", "50", "500"]);
  assert.deepEqual(comparison("population", 2).values, ["2", "20"]);
});

test("values are written as TOML, labels name arms, and slugs are safe file names", () => {
  const values = ["50", "-1.5", "inf", "D++", "all-leaders"];
  assert.deepEqual(values.map(toml), ["50", "-1.5", "inf", '"D++"', '"all-leaders"']);
  assert.equal(label({ key: "learning.start_jitter", values: ["0.0", "2.0"] }, "2.0"), "start jitter 2.0");
  assert.equal(label({ key: "learning.fitness", values: ["G", "D"] }, "D"), "trained with D");
  assert.equal(slug("../my config/D++ run"), "my-config-Dpp-run");
  assert.equal(slug("…"), "run");
});

test("an arm has the same style in every order and in every comparison", () => {
  assert.deepEqual(styles(["all-leaders", "leader-follower"]), [1, 0]);
  assert.deepEqual(styles(["all-leaders"]), [1]);
  assert.deepEqual(styles(["fitness Dt", "fitness G"]), [4, 0]);
  assert.deepEqual(styles(["100 policies each", "20 policies each", "500 policies each"]), [1, 0, 2]);
  assert.deepEqual(styles(["G, seed 2", "G, seed 1"]), [1, 0]);
});

test("curves are written as CSV, with labels quoted if necessary", () => {
  const row = { best: 0.5, mean: 0.25, champion: 0, seconds: 1 };
  const header = "arm,trial,generation,best_g,mean_g,champion_g\n";
  assert.equal(csv([{ label: 'a "b", c', trials: [[row], []] }]), header + '"a ""b"", c",0,0,0.5,0.25,0\n');
});

test("the inputs shown are those of the chosen leader and frame, and quadrants are relative to the heading", () => {
  const numbers = Float32Array.from({ length: 2 * 3 * 10 }, (_, index) => index);
  const found = moment({}, { senses: numbers, leaders: 3, shown: [0, 1] }, 1, 2);
  assert.deepEqual(found.channels.map(({ of, values }) => [of, values]), [["pois", [50, 51, 52, 53]], ["agents", [54, 55, 56, 57]]]);
  assert.deepEqual(found.answer, [58, 59]);
  // Front left is between the heading and 90 degrees counterclockwise.
  assert.deepEqual(angles(2, { sectors: 4, frame: "heading" }), [0, Math.PI / 2]);
  const inputs = moment({}, { senses: Float32Array.of(0, 0, 1, 0, 0, 0, 0, 0, 0.5, 1), leaders: 1, shown: [0] }, 0, 0);
  assert.match(words(inputs), /senses POIs: .*front left 1\.00.*; agents: .* 90° to the left, at 100 %/);
  // The second class has fewer inputs than the first, and moves freely.
  const channel = (of, sectors) => ({ of, sectors, frame: "map" });
  const classes = [{ count: 2, free: false, senses: [channel("pois", 3)] }, { count: 1, free: true, senses: [channel(["a", "b"], 2)] }];
  const free = moment({ classes }, { senses: Float32Array.from({ length: 15 }, (_, index) => index / 16), leaders: 3, shown: [0] }, 0, 2);
  assert.deepEqual(free.channels[0].values, [10 / 16, 11 / 16]);
  assert.match(words(free), /senses a and b: 0\.63, 0\.69\. It moves by 81 % .* 88 % along y/);
  assert.deepEqual(angles(1, free.channels[0]), [Math.PI, 2 * Math.PI]);
});

test("sectors of their own are named by the numbers of agents and POIs, not as quadrants", () => {
  const channel = { sectors: 4, each: true, frame: "heading" };
  const classes = [
    { name: "scout", size: 1, senses: [{ ...channel, of: "pois" }, { ...channel, of: "sheep" }, { ...channel, of: "pois", pois: "gate", sectors: 2 }] },
    { name: "sheep", size: 4, senses: [] },
  ].map(own => ({ ...own, count: own.size, free: false }));
  const groups = [{ name: "den", count: 2 }, { name: "gate", count: 2 }];
  const now = moment({ classes, groups }, { senses: new Float32Array(12), leaders: 1, shown: [0] }, 0, 0);
  const each = from => [0, 1, 2, 3].map(index => `${from + index}: 0.00`).join(", ");
  assert.equal(words(now).split(". ")[0], `senses POIs: ${each(0)}; sheep: ${each(1)}; POIs: 2: 0.00, 3: 0.00`);
});

test("a config of any size is packed for a link", async () => {
  globalThis.matchMedia = () => ({ matches: false });
  const { configs } = await import("./page/config.js"), text = Array.from({ length: 40000 }, () => Math.random()).join();
  assert.equal(await configs.unpack(await configs.pack(text)), text);
});

test("requests open another worker after one has failed or could not be opened", async () => {
  const packed = content => deflateSync(content).toString("base64");
  const texts = { wasm: packed("no module"), worker: "" }, workers = [];
  const started = { words: { suspends: false } }, about = { words: { version: "1" } };
  // Messages that workers post in response to `start` and to other requests.
  let on_start = started, on_request = about;
  globalThis.matchMedia = () => ({ matches: false });
  globalThis.document = { getElementById: id => ({ textContent: texts[id] }) };
  globalThis.Worker = class {
    constructor() { workers.push(this); }
    postMessage({ id, words }) {
      const posted = words.ask === "start" ? on_start : on_request;
      queueMicrotask(() => this.onmessage({ data: { id, ...posted } }));
    }
    terminate() { this.terminated = true; }
  };
  const { clerk } = await import("./page/pool.js");
  const ask = () => clerk.ask({ ask: "about" });
  const works_with = async number => {
    on_request = about;
    assert.equal((await ask()).words.version, "1");
    assert.equal(workers.length, number);
  };

  await assert.rejects(ask(), WebAssembly.CompileError);
  // The smallest module.
  texts.wasm = packed(Uint8Array.of(0, 0x61, 0x73, 0x6d, 1, 0, 0, 0));
  on_start = { words: { error: "no memory", fatal: true } };
  await assert.rejects(ask(), /no memory/);
  on_start = started;
  await Promise.all([works_with(3), works_with(3)]);
  // An error of a request does not end the worker.
  on_request = { words: { error: "not a config" } };
  await assert.rejects(ask(), /not a config/);
  await works_with(3);
  // A trap and a panic do.
  on_request = { words: { error: "unreachable", fatal: true } };
  await assert.rejects(ask(), /unreachable/);
  await works_with(4);
  on_request = { told: { panic: "out of bounds" } };
  await assert.rejects(ask(), /out of bounds/);
  await works_with(5);
  // So does a failure between requests.
  workers[4].onerror({ message: "killed" });
  await works_with(6);
  assert.deepEqual(workers.map(({ terminated = false }) => terminated), [true, true, true, true, true, false]);
});

test("elements have the types that globals.d.ts declares", () => {
  const files = ["index.html", "globals.d.ts"];
  const [html, types] = files.map(name => readFileSync(new URL(`page/${name}`, import.meta.url), "utf8"));
  const tags = new Map([...html.matchAll(/<(\w+)[^>]* id="([a-z-]+)"/g)].map(([, tag, id]) => [id, tag]));
  for (const [, names, type] of types.matchAll(/Record<([^>]*), (HTML\w*Element)>/g)) {
    for (const [, id] of names.matchAll(/"([a-z-]+)"/g)) {
      // The build adds these elements.
      if (["wasm", "worker", "opening"].includes(id)) continue;
      assert.ok(tags.has(id), `no element is called ${id}`);
      const matches = type === "HTMLElement" || type.toLowerCase() === `html${tags.get(id)}element`;
      assert.ok(matches, `${id} is a ${tags.get(id)}, not a ${type}`);
    }
  }
});
