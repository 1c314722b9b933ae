// Experiments that were on show before. Back and Forward return to them with their results.
import { constants, randoms } from "./baselines.js";
import { $, failure } from "./dom.js";
import { intervals } from "./intervals.js";
import { renew_failed } from "./machine.js";
import { render, state, trouble } from "./state.js";

/** Most experiments that are kept, because each holds its policies. */
const MOST = 8;
/** What was on show, by entry of the browser's history. @type {Map<number, Partial<State>>} */
const entries = new Map();
let latest = 0, on_show = 0;

/** Returns the number of the history's present entry. One that the browser made for a link has none. @returns {number | undefined} */
const entry = () => history.state?.entry;

const KEPT = /** @type {const} */ (["text", "file", "compared", "chosen", "config", "toml", "pois", "start", "valid", "problems", "linked", "training", "exhibit", "generation", "trial", "told", "note", "troubles"]);
// Keeps what is on show.
function keep_results() {
  if (!state.training && !state.exhibit) return;
  entries.set(on_show, Object.fromEntries(KEPT.map(key => [key, state[key]])));
  for (const old of [...entries.keys()].slice(0, -MOST)) entries.delete(old);
}

/** Numbers the history's present entry, if it has no number. Returns whether its results are kept here. */
export function arrive() {
  if (entry() !== on_show) keep_results();
  latest = Math.max(latest, entry() ?? 0);
  if (entry() === undefined) history.replaceState({ entry: ++latest }, "", location.href);
  on_show = entry() ?? 0;
  return entries.has(on_show);
}

/** Keeps what is on show before something else replaces it. */
export function leave() {
  if (!state.training && !state.exhibit) return;
  keep_results();
  on_show = ++latest;
  history.pushState({ entry: on_show }, "", location.href);
}

/** Finishes the comparison and the baselines of results that were left before. Opened runs have no baselines. @param {Training} training */
function complete(training) {
  if (!training.found) intervals(training).catch(() => {});
  if (training.teams) constants(training).catch(() => {});
  if (training.teams && training.state === "done") randoms(training).catch(() => {});
}

/** Shows what was on show at this entry of the history, if it is kept. */
export async function go_back() {
  if (entry() === undefined || entry() === on_show || !arrive()) return;
  if (state.training) state.training.stop();
  const found = entries.get(on_show) ?? {}, { training } = found;
  try {
    if (training) {
      await renew_failed();
      // Not awaited: until it is rendered, this entry would keep what was on show before.
      training.revive(state.players[0]).catch(thrown => trouble("run", failure(thrown).message));
    }
  } catch (thrown) { return trouble("run", failure(thrown).message); }
  $("text").value = found.text ?? "";
  render({ ...found, guide: found.told ?? null, mode: "watch", follow: false, policies: null, troubles: { link: found.troubles?.link ?? "" }, message: "" });
  if (training) complete(training);
}
