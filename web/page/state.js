// @ts-check
// The state of the page, and the names that it shows.

/** @type {Record<string, string>} */
export const NAMES = { "leader-follower": "Leader-follower: leaders learn, followers follow", "all-leaders": "All-leaders: every agent learns" };
// Colours of arms, in order.
export const TONES = ["--leader-follower", "--all-leaders", "--arm-2", "--arm-3", "--arm-4", "--arm-5"];
// Controls that set a key of the config.
/** @type {Record<string, string>} */
export const KEYS = { fitness: "learning.fitness", coupling: "world.coupling", seed: "learning.seed", generations: "learning.generations", trials: "learning.trials", population: "learning.population" };
/** Returns what writes a control's value as TOML. @type {(key: string) => (value: string) => string} */
export const quote = key => key === "fitness" ? value => `"${value}"` : value => String(value);

/**
 * One canvas: its arm, its episode, and the place in it. `tell` writes the text of a view that shows no training.
 * @typedef {{ label: string, card: HTMLElement, title: HTMLElement, said: HTMLElement, canvas: HTMLCanvasElement, data: any,
 *   place: number, playing: boolean, over: number | null, wanted: number | null, asking: boolean, crop: number[],
 *   ended?: number | null, chosen?: Chosen | null, drawn?: number[][], removed?: { leader: number, group: boolean } | null, selected?: number | null, sensed?: any, tell?: (step: number, observed: number, said: string) => void }} View
 */
/**
 * `mode` is what the map is for, and `follow` whether the views follow the training. `training` has the results on show, and
 * its `source` the settings that they are of. `clerk` is the worker that answers requests while the players train. `valid`
 * tells whether the text is a valid config. `start` is what the module knows of its start. `past` has earlier texts, for undo. `layouts` has the config of each layout.
 * @type {{ text: string, config: any, toml: string | null, pois: number | null, start: { owner: number[], coupling: number[], headings: number[] }, compared: import("./compare.js").Comparison | null, file: string | null,
 *   mode: "watch" | "arrange" | "drive", training: import("./training.js").Training | null, follow: boolean, generation: number,
 *   trial: number, views: View[], gpu: any, machine: any, settled: string | null, players: any[],
 *   policies: { each: number, weights: Uint8Array } | null, clerk: any, valid: boolean,
 *   past: { text: string, file: string | null, compared: import("./compare.js").Comparison | null }[], layouts: Record<string, any>, palettes: any, version: string }}
 */
export const state = {
  text: "", config: null, toml: null, pois: 4, start: { owner: [], coupling: [], headings: [] }, compared: { key: "learning.paradigm", values: ["leader-follower", "all-leaders"] }, file: null, mode: "watch",
  training: null, follow: true, generation: 0, trial: 0, views: [], gpu: {}, machine: null, settled: null, players: [], policies: null,
  clerk: null, valid: false, past: [], layouts: {}, palettes: null, version: "",
};
