// Times the page's CPU backend against the program on one thread: whole trainings, by turns, in seconds of the processor.
//
//     node web/speed.mjs PAGE FLOTILLA [ROUNDS [LEAST]]
//
// PAGE is the index.html that web/build makes, FLOTILLA a release build. Fails where a layout's median is under LEAST % of
// the program's speed.

import { spawnSync } from "node:child_process";
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { Player, contents } from "./player.mjs";

const [page, flotilla, rounds = "5", least = "0"] = process.argv.slice(2);
const text = contents(page), player = await Player.of(text);
const median = values => values.sort((a, b) => a - b)[values.length >> 1];
const folder = mkdtempSync(join(tmpdir(), "flotilla-speed-"));
let slow = false;

async function by_wasm(toml) {
  await player.ask({ ask: "train", runs: [{ text: toml, trials: null }] });
  const from = process.cpuUsage();
  await player.ask({ ask: "advance", generations: 1e6, milliseconds: 1e9 });
  const { user, system } = process.cpuUsage(from);
  return (user + system) / 1e6;
}

function by_program(config) {
  const words = [flotilla, "train", config, "--out", join(folder, "run"), "--force", "--quiet", "--backend", "cpu"];
  const env = { ...process.env, RAYON_NUM_THREADS: "1", TIMEFORMAT: "%U %S" };
  const { status, stderr } = spawnSync("bash", ["-c", 'time "$@" > /dev/null', "bash", ...words], { env, encoding: "utf8" });
  if (status !== 0) throw new Error(stderr);
  return stderr.trim().split(/\s+/).slice(-2).map(Number).reduce((sum, part) => sum + part);
}

try {
  for (const layout of ["generally_forward", "chaotic"]) {
    const changes = [["learning.trials", "2"], ["learning.population", "500"], ["learning.generations", "100"]];
    const { words } = await player.ask({ ask: "resolve", text: text(`layout-${layout}`), name: layout, changes });
    const config = join(folder, "config.toml"), shares = [], seconds = [];
    writeFileSync(config, words.toml);
    // What runs first is compiled in haste.
    await by_wasm(words.toml);
    for (let round = 0; round < Number(rounds); round++) {
      const [wasm, native] = [await by_wasm(words.toml), by_program(config)];
      shares.push(100 * native / wasm);
      seconds.push(wasm);
    }
    const { description } = JSON.parse(readFileSync(join(folder, "run", "run.json"), "utf8"));
    const [lowest, highest] = [Math.min(...shares), Math.max(...shares)], share = median(shares);
    const range = `${lowest.toFixed(0)} to ${highest.toFixed(0)}`;
    console.log(`${layout}: ${share.toFixed(0)} % (${range}) of the speed of ${description}; ${median(seconds).toFixed(2)} s`);
    slow ||= share < Number(least);
  }
} finally {
  rmSync(folder, { recursive: true });
}
if (slow) {
  console.error(`too slow: the median is to be at least ${least} %`);
  process.exit(1);
}
