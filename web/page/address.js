// The experiment in the address.
import { comparison, read, write } from "./compare.js";
import { configs } from "./config.js";
import { $ } from "./dom.js";
import { edited, take } from "./experiment.js";
import { OPENED } from "./opening.js";
import { KEYS, KEY_IDS, NAMES, part, quote, render, state } from "./state.js";
import { train } from "./train.js";
import { seek } from "./views.js";

let asked = 0, written = 0;
part(() => [state.linked && state.toml, state.compared, $("on").value, $("pace").value], () => { if (state.linked) remember(); });

/**
 * Writes the experiment into the address. Returns false if this browser cannot. The address is then empty, because the old one is of
 * another experiment. Packing a config takes a moment, and an older experiment never replaces a newer one.
 */
export async function remember() {
  const turn = ++asked;
  /** @type {URLSearchParams} */
  let words;
  try { words = await words_of(state, state.config, $("layout").value); } catch {
    history.replaceState(history.state, "", "#");
    return false;
  }
  if (turn < written) return true;
  written = turn;
  history.replaceState(history.state, "", `#${words}`);
  return true;
}

/** Returns an experiment as words of an address. @param {{ text: string, compared: Comparison | null }} experiment @param {Config} config @param {string} layout */
async function words_of({ text, compared }, config, layout) {
  const words = new URLSearchParams();
  if (layout === "own") words.set("config", await configs.pack(text));
  else {
    words.set("layout", layout);
    for (const id of KEY_IDS) if (id !== "coupling") words.set(id, $(id).value);
  }
  const both = compared && compared.key === "learning.paradigm";
  if (config.learning.paradigm) words.set("learners", both ? "both" : config.learning.paradigm);
  if (compared && !both) words.set("compare", write(compared));
  if ($("on").value !== "auto") words.set("on", $("on").value);
  if ($("pace").value !== "watch") words.set("pace", $("pace").value);
  return words;
}

// Opens the experiment in the address. Reports the parts that cannot be read, and then leaves the address unchanged.
export async function recall() {
  const words = new URLSearchParams(location.hash.slice(1)), unknown = [], word = (/** @type {string} */ key) => words.get(key) ?? "";
  for (const id of /** @type {const} */ (["on", "pace"])) {
    const value = words.get(id);
    if (value === null) continue;
    if ([...$(id).options].some(option => option.value === value)) $(id).value = value;
    else unknown.push(`${id}=${value}`);
  }
  const layout = words.get("layout");
  if (layout !== null && !configs.LAYOUTS.includes(layout)) unknown.push(`layout=${layout}`);
  let text = configs.layout(configs.LAYOUTS.find(name => name === layout) || "generally_forward");
  if (words.has("config")) {
    try { text = await configs.unpack(word("config")); } catch { unknown.push("config"); }
  } else {
    text = await edited(text, KEY_IDS.filter(id => words.has(id)).map(id => [KEYS[id], quote(id)(word(id))]));
  }
  const learners = words.get("learners"), known = learners !== null && Object.hasOwn(NAMES, learners);
  if (learners !== null && learners !== "both" && !known) unknown.push(`learners=${learners}`);
  let compared = known ? null : comparison("paradigm", 0);
  if (words.has("compare")) {
    compared = read(word("compare"));
    if (!compared) unknown.push("compare");
  }
  if (known) text = await edited(text, [["learning.paradigm", `"${learners}"`]]);
  const whole = (/** @type {string} */ key) => /^\d{1,7}$/.test(word(key)) ? Number(word(key)) : null;
  for (const key of ["generation", "trial", "play"]) if (words.has(key) && whole(key) === null) unknown.push(`${key}=${words.get(key)}`);
  wanted = whole("play") === 1 ? { generation: whole("generation") ?? Infinity, trial: whole("trial") ?? 0 } : null;
  const known_words = [...KEY_IDS, "on", "pace", "layout", "config", "learners", "compare", "generation", "trial", "play", "version"];
  for (const [key, value] of words) if (!known_words.includes(key)) unknown.push(value ? `${key}=${value}` : key);
  const damage = unknown.length ? `This link is damaged: ${unknown.join(", ")} cannot be read. Ask for a new link; this page shows another experiment.` : "";
  Object.assign(state, { compared, troubles: { link: damage } });
  const taken = await take(text, { linked: !damage });
  if (!taken && state.toml === null) {
    // Show a map even if the config in the link is invalid.
    await take(configs.layout("generally_forward"), { linked: false });
    await take(text);
  }
  const version = words.get("version");
  render({ note: version !== null && version !== state.version ? `This link is from version ${version}, and this page is version ${state.version}: results may differ.` : "" });
}

/** Returns the training on show, if any. */
export const trained = () => state.mode === "watch" ? state.training : null;
/** Returns whether several opened runs are on show. No link holds them. @param {Training | null} training */
export const are_runs = training => Boolean(training && training.arms.length > 1 && training.source && !training.source.compared);
/** Returns whether the opening is on show. */
export const shows_opening = () => state.mode === "watch" && state.exhibit === OPENED;

/**
 * Returns a link to what is on show: a training with its generation and trial, the opening, or otherwise the experiment. Whoever opens a
 * training trains at once. Digests depend on the version.
 */
export async function link() {
  const { generation, trial } = state, training = trained(), page = location.href.split("#")[0];
  if (shows_opening()) return page;
  const source = training && !are_runs(training) ? training.source : null, old = source && (source.text !== state.text || source.compared !== state.compared);
  const words = old && training ? await words_of(source, training.arms[0].config, "own") : new URLSearchParams(location.hash.slice(1));
  if (source) for (const [key, value] of Object.entries({ generation, trial, play: 1 })) words.set(key, String(value));
  words.set("version", state.version);
  return `${page}#${words}`;
}

/** What the opened link asks to show after training, or null. @type {{ generation: number, trial: number } | null} */
let wanted = null;

// Trains if the opened link asks for that, and shows its generation and trial.
export async function autoplay() {
  if (!wanted || !state.valid) return;
  const { generation, trial } = wanted;
  wanted = null;
  const pace = $("pace").value;
  $("pace").value = "full";
  await train();
  $("pace").value = pace;
  if (!state.training || state.training.state !== "done") return;
  render({ trial: Math.min(trial, state.training.arms[0].trials.length - 1) });
  seek(generation);
}
