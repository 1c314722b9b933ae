// Tests the pure modules of the page in Node: node --test web/units.mjs

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { choice_of, comparison, label, read, slug, toml, write } from "./page/compare.js";
import { angles, moment, words } from "./page/senses.js";
import { csv } from "./page/table.js";

test("a comparison survives a link, and damaged ones are refused", () => {
  for (const choice of ["paradigm", "fitness", "population"]) {
    const compared = comparison(choice, 500);
    assert.deepEqual(read(write(compared)), compared);
    assert.equal(choice_of(compared, 500), choice);
  }
  assert.equal(comparison("none", 500), null);
  assert.equal(choice_of(null, 500), "none");
  assert.equal(choice_of({ key: "sense.poi_range", values: ["0", "inf"] }, 500), "own");
  for (const word of ["", "learning.fitness", "learning.fitness:G", "fitness:G,D", "a.b:1,2,3,4,5,6,7", "a.b:1,1", "a.b:1,,2", "a.b:1, 2"]) {
    assert.equal(read(word), null, word);
  }
});

test("populations are a tenth, one and ten times as large, at least two and none twice", () => {
  assert.deepEqual(comparison("population", 50).values, ["5", "50", "500"]);
  assert.deepEqual(comparison("population", 2).values, ["2", "20"]);
});

test("values are TOML, and arms and files have names", () => {
  assert.deepEqual(["50", "-1.5", "inf", "D++", "all-leaders"].map(toml), ["50", "-1.5", "inf", '"D++"', '"all-leaders"']);
  assert.equal(label({ key: "learning.start_jitter", values: ["0.0", "2.0"] }, "2.0"), "start jitter 2.0");
  assert.equal(label({ key: "learning.fitness", values: ["G", "D"] }, "D"), "D");
  assert.equal(slug("../my config/D++ run"), "my-config-Dpp-run");
  assert.equal(slug("…"), "run");
});

test("curves are CSV, with names in quotes if need be", () => {
  const row = { best: 0.5, mean: 0.25, champion: 0, seconds: 1 };
  assert.equal(csv([{ label: 'a "b", c', trials: [[row], []] }]), 'arm,trial,generation,best_g,mean_g,champion_g\n"a ""b"", c",0,0,0.5,0.25,0\n');
});

test("senses are those of the leader and frame, with quadrants around the heading", () => {
  const numbers = Float32Array.from({ length: 2 * 3 * 10 }, (_, index) => index);
  assert.deepEqual(moment(numbers, 3, 1, 2), { pois: [50, 51, 52, 53], agents: [54, 55, 56, 57], turn: 58, speed: 59 });
  // Front left lies between the heading and 90 degrees counterclockwise.
  assert.deepEqual(angles(2), [0, Math.PI / 2]);
  assert.match(words({ pois: [0, 0, 1, 0], agents: [0, 0, 0, 0], turn: 0.5, speed: 1 }), /front left 1\.00.* 90° to the left, at 100 %/);
});

test("elements are of the types that are declared", () => {
  const [html, types] = ["index.html", "globals.d.ts"].map(name => readFileSync(new URL(`page/${name}`, import.meta.url), "utf8"));
  const tags = new Map([...html.matchAll(/<(\w+)[^>]* id="([a-z-]+)"/g)].map(([, tag, id]) => [id, tag]));
  for (const [, names, type] of types.matchAll(/Record<([^>]*), (HTML\w*Element)>/g)) {
    for (const [, id] of names.matchAll(/"([a-z-]+)"/g)) {
      // The build adds these.
      if (["wasm", "worker", "opening"].includes(id)) continue;
      assert.ok(tags.has(id), `no element is called ${id}`);
      assert.ok(type === "HTMLElement" || type.toLowerCase() === `html${tags.get(id)}element`, `${id} is a ${tags.get(id)}, not a ${type}`);
    }
  }
});
