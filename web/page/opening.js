// Shows the episode of a trained team with which the page opens. It was played when the page was made, so it waits for no worker.
import { $, still, write_text } from "./dom.js";
import { NAMES, opening } from "./state.js";
import { only_view, show } from "./views.js";

/** Name of the experiment in the gallery. */
export const OPENING = "two_groups";

export function show_opening() {
  const { config, trial, generation } = opening, data = stage.unpack(opening.data);
  const view = only_view("A trained team, in a task where learning matters", stage.busy(data));
  view.describe = (step, observed, text) => {
    write_text(view.status, `${observed} of ${data.pois.length} POIs by step ${step} · trained for ${generation} generations with population ${config.learning.population}`);
    view.canvas.ariaLabel = `${NAMES["leader-follower"]}: the best team of generation ${generation}, trial ${trial}, step ${step}: ${text}`;
  };
  $("loop").checked = !still.matches;
  show(view, data);
}
