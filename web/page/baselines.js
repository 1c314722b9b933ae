// @ts-check
// Baselines without learning: the best constant action, and the best of as many random teams as training evaluates.
import { curves } from "./curves.js";
import { state } from "./state.js";

// Plays the baselines of a training's arms on the clerk, in slices, so that it still answers other requests.
export async function constants(training) {
  for (const arm of training.arms) {
    if (state.training !== training) return;
    arm.constant = (await state.clerk.ask({ ask: "constant", text: arm.toml })).words.g;
    curves();
  }
}

// Random teams cost as much as the training. They are played after it.
export async function randoms(training) {
  for (const arm of training.arms) {
    await state.clerk.ask({ ask: "random", text: arm.toml });
    for (let done = false; !done;) {
      if (state.training !== training) return;
      const { words } = await state.clerk.ask({ ask: "more_random", milliseconds: 60 });
      arm.random = words.g;
      done = words.done;
      curves();
    }
  }
}
