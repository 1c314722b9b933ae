// Compares the speed of the page's CPU backend with the program on one thread, in seconds of processor time.
//
//     node web/speed.mjs PAGE FLOTILLA [ROUNDS [MINIMUM]]
//
// PAGE is the index.html that web/build writes, and FLOTILLA a release build. Both train whole runs, in alternating
// rounds. Fails if the median for a layout is under MINIMUM percent of the program's speed.

import { spawnSync } from "node:child_process";
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { Player, contents } from "./player.mjs";

const [page, flotilla, rounds = "5", minimum = "0"] = process.argv.slice(2);
const text = contents(page), player = await Player.start(text);
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
  const command = [flotilla, "train", config, "--out", join(folder, "run"), "--force", "--quiet", "--backend", "cpu"];
  const env = { ...process.env, RAYON_NUM_THREADS: "1", TIMEFORMAT: "%U %S" };
  const time = ["-c", 'time "$@" > /dev/null', "bash", ...command];
  const { status, stderr } = spawnSync("bash", time, { env, encoding: "utf8" });
  if (status !== 0) throw new Error(stderr);
  return stderr.trim().split(/\s+/).slice(-2).map(Number).reduce((sum, part) => sum + part);
}

try {
  for (const layout of ["generally_forward", "chaotic"]) {
    const changes = [["learning.trials", "2"], ["learning.population", "500"], ["learning.generations", "100"]];
    const { words } = await player.ask({ ask: "resolve", text: text(`layout-${layout}`), name: layout, changes });
    const config = join(folder, "config.toml"), shares = [], seconds = [];
    writeFileSync(config, words.toml);
    // Warm up: Node optimises WebAssembly only after its first use.
    await by_wasm(words.toml);
    for (let round = 0; round < Number(rounds); round++) {
      const [wasm, native] = [await by_wasm(words.toml), by_program(config)];
      shares.push(100 * native / wasm);
      seconds.push(wasm);
    }
    const { description } = JSON.parse(readFileSync(join(folder, "run", "run.json"), "utf8"));
    const [lowest, highest] = [Math.min(...shares), Math.max(...shares)], share = median(shares);
    const range = `${lowest.toFixed(0)} to ${highest.toFixed(0)}`;
    const median_seconds = median(seconds).toFixed(2);
    console.log(`${layout}: ${share.toFixed(0)} % (${range}) of the speed of ${description}; ${median_seconds} s`);
    slow ||= share < Number(minimum);
  }
} finally {
  rmSync(folder, { recursive: true });
}
if (slow) {
  console.error(`FAILED: a median is under ${minimum} %`);
  process.exit(1);
}
