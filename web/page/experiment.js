// The experiment: its text, its controls, and its editor.
import { choice_of, slug } from "./compare.js";
import { configs } from "./config.js";
import { $, all, count, failure, make, option } from "./dom.js";
import { clerk } from "./pool.js";
import { KEYS, KEY_IDS, part, render, state, trouble } from "./state.js";

/** The controls that set a key. @type {Map<string, keyof typeof KEYS>} */
const fields = new Map(KEY_IDS.map(id => [KEYS[id], id]));

let newest = 0;
/**
 * Makes a text the config. If it is invalid, shows its problems and returns false. `linked` puts the experiment into the address, and `keeps`
 * keeps the episode with which the page opens.
 * @param {string} text
 */
export async function take(text, { edited = false, linked = true, keeps = false } = {}) {
  const turn = ++newest;
  Object.assign(state, { text, exhibit: keeps ? state.exhibit : null });
  if (!edited) $("text").value = text;
  let resolved;
  try {
    resolved = (await clerk.ask({ ask: "resolve", text, name: "config.toml", changes: [] })).words;
  } catch (thrown) {
    const { problems, message } = failure(thrown);
    if (turn === newest) render({ problems, valid: false });
    if (turn === newest) trouble("config", problems.length ? `The config cannot be used: ${count(problems.length, "problem")}, beside ${problems.some(({ key }) => !fields.has(key ?? "")) ? "the lines of the config below" : "the settings"}.` : message);
    return false;
  }
  if (turn !== newest) return false;
  const { config, toml, pois, start } = resolved;
  render({ config, toml, pois, start, valid: true, problems: [], linked });
  trouble("config", "");
  return true;
}

/** Keys of the config and their new values as TOML. @typedef {[string, string][]} Changes */

/** @type {Promise<unknown>} */
let changing = Promise.resolve();
/** Sets keys of the config, and keeps its comments if possible. Changes run one after the other. @param {Changes} changes */
export const change = changes => (changing = changing.catch(() => {}).then(() => change_now(changes)));
/** @param {Changes} changes */
async function change_now(changes) {
  keep();
  return take(await edited(state.text, changes));
}

/**
 * Returns a text with keys set to TOML values. A text that is not TOML is returned as it is: reading it shows why.
 * @param {string} text @param {Changes} changes
 */
export async function edited(text, changes) {
  try { return (await clerk.ask({ ask: "edit", text, changes })).words.text; } catch { return text; }
}

/** Compares other values, or nothing. @param {Comparison | null} compared */
export function compare(compared) {
  keep();
  render({ compared, linked: true });
}

/** Returns whether an earlier experiment is the present one. @param {Past | undefined} past */
const is_now = past => past && past.text === state.text && JSON.stringify(past.compared) === JSON.stringify(state.compared);

// Saves the current experiment for undo.
export function keep() {
  if (!is_now(state.past.at(-1))) state.past.push({ text: state.text, file: state.file, compared: state.compared });
  if (state.past.length > 100) state.past.shift();
}

export async function undo() {
  let last;
  do last = state.past.pop(); while (is_now(last));
  if (!last) return render();
  render({ file: last.file, compared: last.compared });
  await take(last.text);
}
part(() => [state.past.length, state.valid], () => {
  $("undo").disabled = state.past.length === 0;
  $("train").disabled = !state.valid;
});

// Shows a note if the results were trained with settings that differ from those in the form. A new text has no config until it is read.
part(() => [state.training, state.config, state.valid, state.compared], () => {
  const { training } = state, differs = training && training.source && (training.source.text !== state.text || JSON.stringify(training.source.compared) !== JSON.stringify(state.compared));
  $("stale").hidden = !differs;
  if (!differs) return;
  const { arms } = training, alike = (/** @type {keyof Config["learning"]} */ key) => arms.every(({ config }) => config.learning[key] === arms[0].config.learning[key]);
  const values = /** @type {const} */ (["fitness", "seed", "population", "generations"]).filter(alike).map(key => /** @type {const} */ ([key, arms[0].config.learning[key]]));
  const listed = values.some(([key, value]) => value !== state.config.learning[key]);
  const which = listed ? `other settings: ${values.map(pair => pair.join(" ")).join(", ")}` : "another config or comparison";
  $("stale").textContent = `The results below were trained with ${which}. Train again to see the present ones.`;
});

// Edits are applied after a delay. `entered` applies pending ones at once, so that what follows uses them.
/** @type {number | undefined} */
let typed;
const type = () => { typed = undefined; return take($("text").value, { edited: true }); };
export function typing() {
  if (typed === undefined) keep();
  clearTimeout(typed);
  typed = setTimeout(type, 250);
}
export async function entered() {
  if (typed !== undefined) { clearTimeout(typed); await type(); }
  await changing;
}

// Returns whether the experiment has paradigms. Without followers there is only one, and classes replace them.
const has_paradigms = () => state.config.learning.paradigm !== undefined && state.config.world.followers.length > 0;
/** Returns whether a key is of use: where every class has its own fitness, the common one is not. @param {string} key */
const is_used = key => key === "learning.paradigm" ? has_paradigms() : key !== "learning.fitness" || state.start.common_fitness;
/** Returns what the arms differ in, or null for a single arm. */
export const effective = () => state.compared && is_used(state.compared.key) ? state.compared : null;

// Sets the controls to the values of the config. Settings that it does not have are hidden.
export function fill() {
  const { learning, world } = state.config;
  for (const id of /** @type {const} */ (["seed", "generations", "trials", "population"])) $(id).value = String(learning[id]);
  $("fitness").value = learning.fitness;
  const each = typeof world.coupling !== "number";
  $("coupling").value = each ? "" : String(world.coupling);
  $("coupling").placeholder = each ? "each" : "";
  const compared = effective(), choice = choice_of(compared, learning.population), own = option($("compare"), "own");
  own.hidden = choice !== "own";
  own.textContent = compared && choice === "own" ? `${compared.key.split(".")[1].replaceAll("_", " ")} ${compared.values.join(", ")}` : "";
  for (const key of ["paradigm", "fitness"]) option($("compare"), key).hidden = !is_used(`learning.${key}`);
  $("compare").value = choice;
  if (learning.paradigm) $("paradigm").value = learning.paradigm;
  for (const [id, has] of /** @type {const} */ ([["paradigm", has_paradigms()], ["fitness", state.start.common_fitness], ["coupling", !state.config.pois?.length]])) {
    const label = $(id).closest("label");
    if (label) label.hidden = !has;
  }
  const layout = configs.LAYOUTS.find(name => same_world(name));
  option($("layout"), "own").hidden = Boolean(layout);
  $("layout").value = layout || "own";
}
part(() => [state.toml, state.compared, state.layouts], fill);

// Returns whether a config differs from a layout at most in keys that have a command-line flag.
const same_world = (/** @type {string} */ name) => rest_of(state.config) === rest_of(state.layouts[name]);
const rest_of = (/** @type {Config | undefined} */ config) => {
  if (!config) return "";
  const { paradigm, fitness, seed, trials, generations, population, ...learning } = config.learning;
  return JSON.stringify({ ...config, learning });
};

// Shows what is valid in the config, but likely a mistake.
part(() => [state.start], () => {
  const { notes } = state.start;
  $("notes").hidden = notes.length === 0;
  $("notes").textContent = notes.map(note => `Note: ${note}.`).join("\n");
});

part(() => [state.problems], () => {
  const { problems } = state;
  $("marks").replaceChildren();
  $("problems").replaceChildren();
  $("text").ariaInvalid = String(problems.length > 0);
  for (const { line, key, message } of problems) {
    const item = make("li", "", $("problems")), words = `${key ? key + ": " : ""}${message}`;
    const button = make("button", line ? `Line ${line}: ${words}` : words, item, { type: "button" });
    button.addEventListener("click", () => go_to(line || 1));
    if (line) {
      const place = make("div", "", $("marks"), { className: "mark" });
      place.dataset.line = String(line);
      make("span", words, place);
    }
  }
  for (const [key, id] of fields) {
    const found = problems.find(problem => problem.key === key), label = /** @type {HTMLElement} */ ($(id).closest("label"));
    label.querySelector(".wrong")?.remove();
    $(id).ariaInvalid = String(Boolean(found));
    if (!found) continue;
    if (!$(id).checkVisibility()) $("more").open = true;
    make("small", found.message, label, { className: "wrong" });
  }
  if (problems.some(({ key }) => !fields.has(key ?? ""))) $("config").open = true;
  lines();
});

/** @param {number} line */
function go_to(line) {
  const from = $("text").value.split("\n").slice(0, line - 1).join("\n").length + (line > 1 ? 1 : 0);
  $("text").focus();
  $("text").setSelectionRange(from, from);
  $("text").scrollTop = Math.max(0, (line - 6) * 20);
  lines();
}

export function lines() {
  const many = $("text").value.split("\n").length;
  $("lines").textContent = Array.from({ length: many }, (_, line) => line + 1).join("\n");
  $("lines").scrollTop = $("text").scrollTop;
  for (const place of all(".mark")) place.style.top = `${8 + (Number(place.dataset.line) - 1) * 20 - $("text").scrollTop}px`;
}

export const name_of = () => state.file || ($("layout").value === "own" ? "config" : $("layout").value);

/** Returns the command that gives the same results. @param {Config} config @param {Changes} given */
export function command({ learning }, given = []) {
  const layout = $("layout").value, flagged = ["fitness", "seed", "generations", "trials", "population"];
  const written = (/** @type {Changes[0]} */ [key, value]) => flagged.includes(key.split(".")[1]) ? ` --${key.split(".")[1]} ${value}` : ` --set ${key}=${value}`;
  const extra = given.filter(([key]) => layout === "own" || !flagged.includes(key.split(".")[1])).map(written).join("");
  if (layout === "own") return `flotilla train ${slug(name_of())}.toml${learning.paradigm ? ` --paradigm ${learning.paradigm}` : ""}${extra}`;
  const flags = /** @type {const} */ (["paradigm", "fitness", "seed"]).map(key => `--${key} ${learning[key]}`);
  const base = state.layouts[layout].learning;
  for (const key of /** @type {const} */ (["generations", "trials", "population"])) if (base[key] !== learning[key]) flags.push(`--${key} ${learning[key]}`);
  return `flotilla train configs/${layout}.toml ${flags.join(" ")}${extra}`;
}
