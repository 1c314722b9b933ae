// Compares the page's digests with those of the program and of tests/golden.txt.
//
//     node web/golden.mjs PAGE FLOTILLA
//
// PAGE is the index.html that web/build writes, and FLOTILLA the program. The page's own worker trains, in Node. Also
// tests the page's opening episode, teammates in drive mode, and that the program can resume the page's runs.

import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { opening } from "./opening.mjs";
import { Training } from "./page/training.js";
import { Player, contents } from "./player.mjs";

const [page, flotilla] = process.argv.slice(2);
const text = contents(page);
const source = name => readFileSync(new URL(name, import.meta.url), "utf8");

const player = await Player.start(text);
const { words: machine } = await player.ask({ ask: "open", gpu: false, pass: null });
assert.equal(machine.description, "cpu (SIMD128, 1 thread)");

const SMALL = [["learning.trials", "2"], ["learning.generations", "8"], ["learning.population", "20"]];
async function train_in_page(layout, changes) {
  const question = { ask: "resolve", text: text(`layout-${layout}`), name: layout, changes: [...SMALL, ...changes] };
  const { words } = await player.ask(question);
  const training = new Training([{ ...words, name: "web", label: layout, command: "" }], machine);
  await training.start([player]);
  await training.play(() => Infinity, () => {});
  assert.equal(training.state, "done");
  return { toml: words.toml, digest: training.arms[0].digest, zip: training.arms[0].zip };
}

const rows = source("../tests/golden.txt").split("\n").map(line => line.split(/\s+/));
const golden = Object.fromEntries(rows.map(([name, , digest]) => [name, digest]));
for (const [name, layout, changes] of [
  ["generally-forward", "generally_forward", []],
  ["strictly-forward", "strictly_forward", [["learning.fitness", "'D++'"]]],
  ["chaotic", "chaotic", [["learning.fitness", "'G'"]]],
]) {
  assert.equal((await train_in_page(layout, changes)).digest, golden[name], `golden digest ${name}`);
  console.log(`${name}: the golden digest`);
}

// `equal` would print both episodes if they differ.
assert.ok(
  await opening(player, text) === source("page/opening.json"),
  "web/page/opening.json is out of date: run node web/opening.mjs web/dist/index.html, then web/build",
);
console.log("web/page/opening.json is current");

// If the user drives one leader, the other leaders follow their trained policies. If the driven leader acts like its
// policy, too, the episode has the same bits as that of the trained team.
const numbers = text => new Float32Array(Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer);
const GROUPS = [["learning.sharing", "'group'"], ["learning.groups", "[[0, 1], [2, 3]]"]];
for (const sharing of [[], GROUPS]) {
  const { words: resolved } = await player.ask({ ask: "resolve", text: text("layout-generally_forward"), name: "", changes: [...SMALL, ...sharing] });
  const trained = new Training([{ ...resolved, label: "", command: "" }], machine);
  await trained.start([player]);
  await trained.play(() => Infinity, () => {});
  const weights = trained.arms[0].ended[0];
  const { words: whole } = await player.ask({ ask: "play", text: resolved.toml, policies: 1 }, weights);
  const [episode] = whole.episodes, { agents, leaders } = episode;
  const [positions, headings, senses] = [episode.positions, episode.headings, episode.senses].map(numbers);
  await player.ask({ ask: "drive", text: resolved.toml, leader: 0, policies: 1 }, weights);
  let driven = null;
  for (let step = 1; step <= whole.steps; step++) {
    // Per step and leader, there are inputs and 2 outputs.
    const size = senses.length / (episode.shown.length * leaders), end = (step * leaders + 1) * size;
    const [turn, speed] = senses.slice(end - 2, end);
    driven = (await player.ask({ ask: "step", turn, speed })).words;
    for (const [found, expected] of [[driven.positions, positions], [driven.headings, headings]]) {
      const frame = expected.slice(step * agents * 2, (step + 1) * agents * 2);
      assert.deepEqual(Float32Array.from(found), frame, `step ${step} of the driven episode differs`);
    }
  }
  assert.ok(driven.learned);
  assert.equal(driven.scores.g, episode.g);
}
console.log("teammates follow their policies");

const folder = mkdtempSync(join(tmpdir(), "flotilla-web-"));
try {
  for (const layout of ["generally_forward", "strictly_forward", "chaotic"]) {
    for (const paradigm of ["leader-follower", "all-leaders"]) {
      const changes = [["learning.paradigm", `'${paradigm}'`], ["learning.seed", "7"]];
      const { toml, digest } = await train_in_page(layout, changes);
      const config = join(folder, "config.toml"), out = join(folder, `${layout}-${paradigm}`);
      writeFileSync(config, toml);
      const stdio = ["ignore", "ignore", "inherit"];
      execFileSync(flotilla, ["train", config, "--out", out, "--quiet", "--backend", "cpu"], { stdio });
      assert.equal(digest, JSON.parse(readFileSync(join(out, "run.json"), "utf8")).digest, `${layout}, ${paradigm}`);
      console.log(`${layout}, ${paradigm}: the program's digest`);
    }
  }
  for (const method of ["tournament", "openai-es"]) {
    const { toml, digest, zip } = await train_in_page("chaotic", [["learning.method", `'${method}'`]]);
    const [config, archive, run] = ["config.toml", "run.zip", "web-chaotic"].map(name => join(folder, name));
    rmSync(run, { recursive: true, force: true });
    writeFileSync(config, toml);
    writeFileSync(archive, zip);
    execFileSync("python3", ["-m", "zipfile", "-e", archive, folder]);
    assert.equal(JSON.parse(readFileSync(join(run, "run.json"), "utf8")).digest, digest);
    const more = ["--generations", "18", "--json", "--quiet", "--backend", "cpu"];
    const train = (config, out, ...flags) =>
      JSON.parse(execFileSync(flotilla, ["train", config, "--out", join(folder, out), ...more, ...flags]));
    const extended = train(join(run, "config.toml"), "web-chaotic", "--resume");
    assert.equal(extended.digest, train(config, `uninterrupted-${method}`).digest, method);
    assert.equal(extended.trained_generations, 10, `${method}: generations were trained again`);
    console.log(`${method}: the program extends the page's run without training again`);
  }
} finally {
  rmSync(folder, { recursive: true });
}
