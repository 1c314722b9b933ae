// Experiments to start from. Each has a config in web/gallery or configs, and what it compares.
import { $, make } from "./dom.js";
import { edited, keep, take } from "./experiment.js";
import { render, state } from "./state.js";
import { forget, train } from "./train.js";

/**
 * `config` names the config if it is that of another experiment, and `changes` sets keys of it.
 * @type {{ name: string, title: string, says: string, compare: Comparison, config?: string, changes?: [string, string][] }[]}
 */
const GALLERY = [
  {
    name: "two_groups", title: "Two groups must meet", compare: { key: "learning.paradigm", values: ["leader-follower", "all-leaders"] },
    says: "Six agents must be at one POI at once. Leader-follower teams learn it. Teams in which all twelve agents learn, each with a population of its own, do not.",
  },
  {
    name: "population", config: "two_groups", title: "Few policies or many", compare: { key: "learning.population", values: ["20", "100", "500"] },
    says: "The same task. With 20 policies per leader, champions end with at most one of the four POIs; with 500, with three on average.",
  },
  {
    name: "groups", config: "two_groups", title: "Who shares a population?", changes: [["learning.paradigm", '"all-leaders"']],
    compare: { key: "learning.sharing", values: ["none", "group", "all"] },
    says: "The same task without followers. With a population per agent, nothing is learned. With one per group of three agents, champions observe two or three of the four POIs on average.",
  },
  {
    name: "blind", title: "Blind leaders", compare: { key: "learning.start_jitter", values: ["0.0", "2.0", "4.0"] },
    says: "Leaders that sense no POI learn the way by heart. If the starts are scattered, champions observe at most a quarter of the POIs.",
  },
  {
    name: "eight_followers", title: "Eight followers per leader", compare: { key: "learning.paradigm", values: ["leader-follower", "all-leaders"] },
    says: "Two policies are enough to steer eighteen agents. Teams in which all eighteen agents learn, each with a population of its own, observe less than half.",
  },
  {
    name: "relay", title: "A relay", compare: { key: "learning.fitness", values: ["D", "Df", "Dt"] },
    says: "A leader has to hand its followers over to another. Only followers count at POIs, so D, which removes a leader alone, is always 0.",
  },
  {
    name: "places", title: "POIs that move", compare: { key: "learning.paradigm", values: ["leader-follower", "all-leaders"] },
    says: "POIs are elsewhere in every generation. No way can be learned by heart, and teams of both kinds learn to sense.",
  },
  {
    name: "swarm", title: "A swarm", compare: { key: "learning.fitness", values: ["G", "D", "Df"] },
    says: "Two leaders with twelve followers each. D, which removes a leader alone, is nearly always 0 with that many. Df removes its followers, too.",
  },
  {
    name: "rovers", title: "Rovers and drones", compare: { key: "learning.fitness", values: ["G", "D"] },
    says: "Two classes learn: slow rovers, and fast drones without a heading. Some POIs count rovers, some drones, one both, and their values differ.",
  },
];

/** Returns the config of an experiment. @param {string} name */
export const text_of = name => $(`gallery-${name}`).textContent ?? "";

/** Returns whether the page shows an experiment. @param {string} name */
export const is_of = name => {
  const { chosen, text, compared } = state;
  return chosen !== null && chosen.name === name && chosen.text === text && chosen.compared === compared;
};

let turns = 0;
/** Replaces the experiment by one of the gallery, and trains it if asked. @param {string} name */
export async function exhibit(name, { trains = false } = {}) {
  const found = GALLERY.find(exhibit => exhibit.name === name);
  if (!found) return;
  const turn = ++turns, own = text_of(found.config ?? name), text = found.changes ? await edited(own, found.changes) : own;
  if (turn !== turns) return;
  keep();
  forget();
  render({ chosen: { name, text, compared: found.compare }, file: null, compared: found.compare, mode: "watch" });
  if (await take(text) && trains) await train();
}

export function gallery() {
  for (const { name, title, says } of GALLERY) {
    const button = make("button", "", make("li", "", $("gallery")), { type: "button" });
    make("b", title, button);
    make("span", says, button);
    button.dataset.exhibit = name;
    button.addEventListener("click", () => exhibit(name, { trains: true }));
  }
}
