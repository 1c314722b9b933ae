// Writes web/page/opening.json: the episode that the page shows first, played by a champion of the gallery's first
// experiment.
//
//     node web/opening.mjs PAGE
//
// PAGE is the index.html that web/build writes. web/golden.mjs tests that the file is current.

import { writeFileSync } from "node:fs";
import { Player, contents } from "./player.mjs";

// A generation in which the credits of the leaders differ.
const TRIAL = 2, GENERATION = 55;

export async function opening(player, text) {
  const question = { ask: "resolve", text: text("gallery-two_groups"), name: "two_groups.toml", changes: [] };
  const { words } = await player.ask(question);
  await player.ask({ ask: "train", runs: [{ text: words.toml, trials: [TRIAL] }] });
  const advance = { ask: "advance", generations: 1000, milliseconds: 1e6 };
  for (let done = false; !done;) done = (await player.ask(advance)).words.done;
  const { words: data } = await player.ask({ ask: "champion", run: 0, trial: TRIAL, generation: GENERATION });
  return JSON.stringify({ trial: TRIAL, generation: GENERATION, config: words.config, data }) + "\n";
}

if (process.argv[1] === new URL(import.meta.url).pathname) {
  const text = contents(process.argv[2]), player = await Player.start(text);
  await player.ask({ ask: "open", gpu: false, pass: null });
  const written = await opening(player, text);
  writeFileSync(new URL("page/opening.json", import.meta.url), written);
  console.log(`web/page/opening.json: ${written.length} bytes`);
}
