// Writes web/page/opening.json: the episode with which the page opens, of the best team of the gallery's first experiment.
//
//     node web/opening.mjs PAGE
//
// PAGE is an index.html that web/build makes. web/golden.mjs tests that the file is what training gives.

import { writeFileSync } from "node:fs";
import { Player, contents } from "./player.mjs";

const TRIAL = 0;

export async function opening(player, text) {
  const { words } = await player.ask({ ask: "resolve", text: text("gallery-two_groups"), name: "two_groups.toml", changes: [] });
  const generation = words.config.learning.generations;
  await player.ask({ ask: "train", runs: [{ text: words.toml, trials: [TRIAL] }] });
  for (let done = false; !done;) done = (await player.ask({ ask: "advance", generations: 1000, milliseconds: 1e6 })).words.done;
  const { words: data } = await player.ask({ ask: "best", run: 0, trial: TRIAL, generation });
  return JSON.stringify({ trial: TRIAL, generation, config: words.config, data }) + "\n";
}

if (process.argv[1] === new URL(import.meta.url).pathname) {
  const text = contents(process.argv[2]), player = await Player.of(text);
  await player.ask({ ask: "open", gpu: false, pass: null });
  const written = await opening(player, text);
  writeFileSync(new URL("page/opening.json", import.meta.url), written);
  console.log(`web/page/opening.json: ${written.length} bytes`);
}
