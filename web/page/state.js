// The state of the page, and the names that it shows.
import { $ } from "./dom.js";

/** @type {Record<string, string>} */
export const NAMES = { "leader-follower": "Leader-follower: leaders learn, followers follow", "all-leaders": "All-leaders: every agent learns" };
// Colours of arms, in order.
export const TONES = ["--leader-follower", "--all-leaders", "--arm-2", "--arm-3", "--arm-4", "--arm-5"];
// Controls that set a key of the config.
export const KEYS = /** @type {const} */ ({ fitness: "learning.fitness", coupling: "world.coupling", seed: "learning.seed", generations: "learning.generations", trials: "learning.trials", population: "learning.population" });
export const KEY_IDS = /** @type {(keyof typeof KEYS)[]} */ (Object.keys(KEYS));
/** Returns what writes a control's value as TOML. @type {(key: string) => (value: string) => string} */
export const quote = key => key === "fitness" ? value => `"${value}"` : value => String(value);

/** The episode with which the page opens, and its config. @type {{ config: Config, trial: number, generation: number, data: Packed }} */
export const opening = JSON.parse($("opening").textContent);

/** @type {State} */
export const state = {
  text: "", valid: false, config: opening.config, toml: null, pois: opening.config.world.pois.length, start: { owner: [], coupling: [], headings: [] },
  compared: { key: "learning.paradigm", values: ["leader-follower", "all-leaders"] }, file: null, past: [], mode: "watch",
  training: null, follow: true, generation: 0, trial: 0, views: [], gpu: {}, machine: { description: "", backend: "cpu", adapter: null, driver: null, threads: 0 },
  settled: null, players: [], policies: null, layouts: {}, version: "",
};

/** Returns the views that show an episode. @returns {Shown[]} */
export const shown = () => state.views.filter(/** @type {(view: View) => view is Shown} */ (view => view.data !== null));

/**
 * What is done after a change, so that modules that change the state need not import those that show it: `config` after the config or
 * what is compared, and `episode` after a view's episode or the leaders selected in it. `main` sets both.
 */
export const after = { config: (/** @type {{ views: boolean, address: boolean }} */ _) => {}, episode: () => {} };
