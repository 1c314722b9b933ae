// The episode of a trained team with which the page opens. It was played when the page was made, so it waits for no worker.
import { NAMES, opening } from "./state.js";

/** Name of the experiment in the gallery. */
export const OPENING = "two_groups";

/** @type {Exhibit} */
export const OPENED = (() => {
  const { config, trial, generation } = opening, data = stage.unpack(opening.data);
  return {
    name: "opening",
    scenes: [{
      title: "A trained team, in a task where learning matters", data,
      status: (step, observed) => `${observed} of ${data.pois.length} POIs by step ${step} · trained for ${generation} generations with population ${config.learning.population}`,
      label: `${NAMES["leader-follower"]}: the best team of generation ${generation}, trial ${trial}`,
    }],
  };
})();
