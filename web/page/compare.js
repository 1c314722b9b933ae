// What a training compares: the values of one key of the config, each of which is an arm.

/** @typedef {{ key: string, values: string[] }} Comparison */

const FITNESSES = ["G", "D", "Df", "D++", "Dt"];
const PARADIGMS = ["leader-follower", "all-leaders"];
/** Most arms of one training. */
const MOST_ARMS = 6;

/**
 * Returns the comparison that a choice stands for: of paradigms, of fitnesses, or of populations a tenth and ten times as large.
 * @param {string} choice
 * @param {number} population
 * @returns {Comparison | null}
 */
export function comparison(choice, population) {
  if (choice === "paradigm") return { key: "learning.paradigm", values: PARADIGMS };
  if (choice === "fitness") return { key: "learning.fitness", values: FITNESSES };
  if (choice !== "population") return null;
  const sizes = [Math.max(2, Math.round(population / 10)), population, population * 10];
  return { key: "learning.population", values: [...new Set(sizes)].map(String) };
}

/**
 * Returns the choice that stands for a comparison: "own" if none does, and "none" without one.
 * @param {Comparison | null} compared
 * @param {number} population
 */
export function choice_of(compared, population) {
  if (!compared) return "none";
  const same = (/** @type {Comparison | null} */ other) => other && other.key === compared.key && other.values.join() === compared.values.join();
  return ["paradigm", "fitness", "population"].find(choice => same(comparison(choice, population))) || "own";
}

/** Writes a comparison as a word of a link. @param {Comparison} compared */
export const write = ({ key, values }) => `${key}:${values.join(",")}`;

/**
 * Reads a comparison from a word of a link. Returns null if the word is not one.
 * @param {string} word
 * @returns {Comparison | null}
 */
export function read(word) {
  const found = /^([a-z_]+\.[a-z_]+):([^,\s]+(?:,[^,\s]+)+)$/.exec(word);
  if (!found) return null;
  const values = found[2].split(",");
  return values.length <= MOST_ARMS && new Set(values).size === values.length ? { key: found[1], values } : null;
}

/** Returns a value as TOML: a number as it is, and a word in quotes. @param {string} value */
export const toml = value => /^-?(\d+(\.\d+)?|inf)$/.test(value) ? value : `"${value}"`;

/** Names of arms that say more than their values. @type {Record<string, Record<string, string>>} */
const SAYS = { "learning.sharing": { none: "a population per agent", group: "one per group", all: "one for all" } };

/** Names an arm. @param {Comparison} compared @param {string} value */
export function label({ key, values }, value) {
  if (key === "learning.paradigm") return value;
  if (key === "learning.fitness" && values.length > 1) return `trained with ${value}`;
  if (key === "learning.population") return `${value} policies each`;
  return SAYS[key]?.[value] ?? `${key.split(".")[1].replaceAll("_", " ")} ${value}`;
}

/** Names the team of a config: by its paradigm, or by its classes. @param {Config} config */
export const team = ({ learning, agents = [] }) => learning.paradigm ?? agents.map(({ name }) => name).join(" and ");

/**
 * Returns the style of each arm: the index of its colour and dashes. Paradigms and fitnesses have their own. Other arms have theirs by the
 * order of their names, whatever the order of files.
 * @param {string[]} labels
 */
export function styles(labels) {
  const own = labels.map(label => [PARADIGMS, FITNESSES].map(names => names.findIndex(name => label.split(/[ ,]+/).includes(name))).find(at => at >= 0) ?? -1);
  if (!own.includes(-1) && new Set(own).size === own.length) return own;
  const sorted = labels.toSorted((a, b) => a.localeCompare(b, "en", { numeric: true }));
  return labels.map(label => sorted.indexOf(label));
}

/** Returns a text as a file name. @param {string} text */
export const slug = text => text.replaceAll("++", "pp").replace(/[^A-Za-z0-9._-]+/g, "-").replace(/^[-.]+|-+$/g, "") || "run";
