// Baselines without learning: the best constant action, and the best of as many random teams as training evaluates.
import { clerk } from "./pool.js";
import { news, state } from "./state.js";

/** Plays the constant actions of a training's arms. @param {Training} training */
export async function constants(training) {
  for (const arm of training.arms) {
    if (state.training !== training) return;
    arm.constant = (await clerk.ask({ ask: "constant", text: arm.toml })).words.g;
    news(training);
  }
}

/**
 * Plays as many random teams as the training evaluated, in slices, so that the clerk still answers other requests. They cost as much as
 * the training, and are played after it, and after what the guide waits for.
 * @param {Training} training
 */
export async function randoms(training) {
  for (const arm of training.arms) {
    await clerk.ask({ ask: "random", text: arm.toml });
    for (let done = false; !done;) {
      await clerk.is_free();
      if (state.training !== training) return;
      const { words } = await clerk.ask({ ask: "more_random", milliseconds: 60 });
      arm.random = words.g;
      done = words.done;
      news(training);
    }
  }
}
