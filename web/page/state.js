// The state of the page, and the names that it shows.
import { $, make } from "./dom.js";

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
  text: "", valid: false, config: opening.config, toml: null, pois: opening.config.world.pois.length, start: { owner: [], coupling: [], headings: [], notes: [], common_fitness: true },
  compared: { key: "learning.paradigm", values: ["leader-follower", "all-leaders"] }, file: null, past: [], problems: [], linked: false, mode: "watch",
  training: null, exhibit: null, follow: true, generation: 0, over: null, trial: 0, views: [], chosen: null, guide: null, told: null, troubles: {}, message: "", note: "", gpu: {},
  machine: { description: "", backend: "cpu", adapter: null, driver: null, threads: 0 }, settled: null, players: [], policies: null, layouts: {}, version: "",
};

/** Returns the views that show an episode. @returns {Shown[]} */
export const shown = () => state.views.filter(/** @type {(view: View) => view is Shown} */ (view => view.data !== null));

/** The parts of the page, in order. @type {{ values: () => unknown[], paint: () => void, before: unknown[] | null }[]} */
const parts = [];
/** Adds a part of the page: it is painted when one of the values that it shows has changed. @param {() => unknown[]} values @param {() => void} paint */
export const part = (values, paint) => { parts.push({ values, paint, before: null }); };

/** Shows the state. Whatever changes the state ends with this. @param {Partial<State>} [changes] */
export function render(changes = {}) {
  Object.assign(state, changes);
  for (const part of parts) {
    const now = part.values(), { before } = part;
    if (before && before.length === now.length && now.every((value, index) => value === before[index])) continue;
    part.before = now;
    part.paint();
  }
}

/** Shows new results of a training. @param {Training} training */
export function news(training) {
  training.version += 1;
  render();
}

/** Shows an error, or none, and keeps those about other things. @param {"config" | "link" | "run" | "file"} about @param {string} text */
export const trouble = (about, text) => render({ troubles: { ...state.troubles, [about]: text } });
/** Reports what was done. @param {string} message */
export const report = message => render({ message });

part(() => [state.troubles], () => {
  $("trouble").textContent = Object.values(state.troubles).filter(Boolean).join("\n");
  $("trouble").hidden = !$("trouble").textContent;
});
part(() => [state.note], () => { $("version").textContent = state.note; });
part(() => [state.message], () => { $("message").textContent = state.message; });

/** Saves a file. @param {string} name @param {BlobPart} content @param {string} type */
export function save(name, content, type) {
  const link = make("a", "", document.body, { href: URL.createObjectURL(new Blob([content], { type })), download: name });
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  report(`${name} is saved.`);
}

/** Copies a text, and reports it. @param {string} text @param {string} message */
export async function copy(text, message) {
  try {
    await navigator.clipboard.writeText(text);
    report(message);
  } catch { report(`This browser does not let a page copy. Here it is: ${text}`); }
}
