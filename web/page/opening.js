// The episode of a trained team with which the page opens. It was played when the page was made, so it waits for no worker.
import { NAMES, opening, state } from "./state.js";

/** Name of the experiment in the gallery. */
export const OPENING = "two_groups";

/** @type {Exhibit} */
export const OPENED = (() => {
  const { config, trial, generation } = opening, data = stage.unpack(opening.data), [{ agents, coupling, headings }] = data.episodes;
  // Until the module has resolved a config, everyone starts as in this episode.
  Object.assign(state.start, { coupling, headings: Array.from({ length: agents }, (_, agent) => Math.atan2(headings[2 * agent + 1], headings[2 * agent])) });
  return {
    name: "opening",
    scenes: [{
      title: "A trained team, in a task where learning matters", data,
      status: (step, observed) => `${observed} of ${data.pois.length} POIs by step ${step} · trained for ${generation} generations with ${config.learning.population} policies per leader`,
      label: `${NAMES["leader-follower"]}: the champion of generation ${generation}, trial ${trial}`,
    }],
  };
})();
