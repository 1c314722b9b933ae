// Baselines without learning: the best constant action, and the best of as many random teams as training evaluates.
import { clerk } from "./pool.js";
import { news, state } from "./state.js";
import { last_of } from "./training.js";

/** Milliseconds of a slice of a baseline. The clerk answers other requests between slices. */
const SLICE = 60;

/** Plays the constant actions of those arms of a training that lack them. @param {Training} training */
export async function constants(training) {
  for (const arm of training.arms.filter(({ constant }) => constant === null)) {
    while (arm.constant === null) {
      await clerk.is_free();
      if (state.training !== training) return;
      arm.constant = (await clerk.ask({ ask: "constant", text: arm.toml, milliseconds: SLICE })).words.g;
    }
    news(training);
  }
}

/** Identifies the latest call of `randoms`. The clerk plays the random teams of one arm at a time. */
let turn = {};
/**
 * Plays as many random teams as the training evaluated, in slices. They cost as much as the training, and are played after it, and after
 * what the guide waits for. Arms that have them are left out.
 * @param {Training} training
 */
export async function randoms(training) {
  const own = turn = {}, ended = async () => { await clerk.is_free(); return state.training !== training || turn !== own; };
  for (const arm of training.arms.filter(arm => arm.random.length <= last_of(arm))) {
    if (await ended()) return;
    await clerk.ask({ ask: "random", text: arm.toml });
    for (let done = false; !done;) {
      if (await ended()) return;
      const { words } = await clerk.ask({ ask: "more_random", milliseconds: SLICE });
      arm.random = words.g;
      done = words.done;
      news(training);
    }
  }
}
