// @ts-check
// The episode of a trained team with which the page opens. It was played when the page was made, so it waits for no worker.
import { $, still } from "./dom.js";
import { curves } from "./curves.js";
import { NAMES, state } from "./state.js";
import { clear, show, unpack, view } from "./views.js";

/** Name of the experiment in the gallery. */
export const OPENING = "two_groups";

/** @type {any} */
let parsed = null;
export function show_opening() {
  parsed ??= JSON.parse($("opening").textContent);
  const { config, trial, generation } = parsed, data = parsed.ready || unpack(parsed.data);
  parsed.ready = data;
  clear();
  $("views").classList.add("one");
  const only = view("leader-follower");
  only.crop = stage.busy(data);
  only.title.textContent = "A trained team, in a task where learning matters";
  only.tell = (step, observed, said) => {
    only.said.textContent = `${observed} of ${data.pois.length} POIs by step ${step} · trained for ${generation} generations with population ${config.learning.population}`;
    only.canvas.setAttribute("aria-label", `${NAMES["leader-follower"]}: the best team of generation ${generation}, trial ${trial}, step ${step}: ${said}`);
  };
  $("loop").checked = !still.matches;
  show(only, data);
  if (state.config) curves();
}
