// Starts, shows and ends trainings.
import { constants, randoms } from "./baselines.js";
import { label, slug, team, toml } from "./compare.js";
import { $, failure, make, write_text } from "./dom.js";
import { command, effective, entered, name_of } from "./experiment.js";
import { intervals } from "./intervals.js";
import { renew, settle } from "./machine.js";
import { mode } from "./modes.js";
import { leave } from "./past.js";
import { clerk } from "./pool.js";
import { copy, news, part, render, save, state, trouble } from "./state.js";
import { Training } from "./training.js";
import { follow, reveal } from "./views.js";

/** The experiment whose training is being started. @type {Training["source"]} */
let starting = null;
export async function train() {
  if (starting && starting.text === state.text && starting.compared === state.compared) return;
  const own = starting = { text: state.text, compared: state.compared };
  const busy = state.training && ["starting", "training"].includes(state.training.state);
  if (state.training) state.training.stop();
  render({ troubles: { link: state.troubles.link }, message: "" });
  mode("watch");
  /** @type {Training} */
  let training;
  try {
    // A worker that still plays a long generation would delay the new training.
    if (busy) await renew();
    await entered();
    if (!state.valid) return;
    await settle();
    const source = { text: state.text, compared: state.compared }, compared = effective();
    const arms = await Promise.all((compared ? compared.values : [""]).map(async value => {
      const changes = compared ? [[compared.key, toml(value)]] : [];
      const { words } = await clerk.ask({ ask: "resolve", text: source.text, name: "config.toml", changes });
      return {
        bytes: words.bytes, label: compared ? label(compared, value) : team(words.config), toml: words.toml, config: words.config, pois: words.pois, parameters: words.parameters,
        command: command(words.config, !compared || compared.key === "learning.paradigm" ? [] : [[compared.key, value]]), name: slug(name_of()), constant: null, random: [],
      };
    }));
    // Another experiment may have replaced it meanwhile.
    if (starting !== own) return;
    const bytes = arms.reduce((sum, arm) => sum + arm.bytes, 0);
    if (bytes > 3 * 2 ** 30) throw new Error(`This takes ${(bytes / 2 ** 30).toFixed(1)} GiB, and a tab has at most 4. Choose a smaller population, fewer trials or fewer arms, or use the command line.`);
    training = new Training(arms, state.machine);
    training.source = source;
    leave();
    render({ training, exhibit: null, generation: 0, trial: 0, policies: null, follow: true });
    reveal();
    await training.start(state.players);
  } catch (thrown) {
    const { message, fatal } = failure(thrown);
    if (fatal) await renew();
    if (starting !== own) return;
    if (state.training && state.training.state === "starting") forget();
    trouble("run", message);
    return;
  } finally { if (starting === own) starting = null; }
  render();
  constants(training).catch(() => {});
  // For watching, the pace is limited to `last / 8` generations per second, but at least 1. Pauses do not count.
  let played = 0, clock = performance.now(), dirty = true, latest = clock;
  const allowed = () => {
    const now = performance.now(), each = training.last / 8;
    if (!training.paused) played += (now - clock) / 1000 * Math.max(1, each);
    clock = now;
    return $("pace").value === "full" ? Infinity : played + 1;
  };
  // Four charts a second are enough, and leave the main thread free.
  const painting = setInterval(() => {
    if (state.training !== training || document.hidden) return;
    if (dirty) { dirty = false; latest = performance.now(); news(training); follow(); }
    const silent = (performance.now() - latest) / 1000;
    if (silent > 2 && !training.paused && training.reached < training.last) {
      write_text($("generation"), `generation ${training.reached + 1} of ${training.last}: ${Math.round(silent)} s so far`);
    }
  }, 250);
  try {
    await training.play(allowed, () => { dirty = true; });
  } catch (thrown) {
    const { message, stopped, fatal } = failure(thrown);
    if (!stopped && state.training === training) {
      training.stop();
      if (fatal || state.machine.backend === "gpu") await renew();
      trouble("run", `${message}\nTraining stopped there. ${state.machine.backend === "gpu" ? "Train again, if necessary on the CPU: the result is the same." : "Train again: the result is the same."}`);
    }
  }
  clearInterval(painting);
  if (state.training !== training) return;
  news(training);
  follow();
  intervals(training).catch(() => {});
  if (training.state === "done") randoms(training).catch(() => {});
}

/** Returns what the newest champions of each arm observe, or 0 before the first. @param {Training} training */
export function found_by({ arms, pois, unit }) {
  const found = arms.map(({ label, trials }) => {
    const sum = trials.reduce((sum, trial) => sum + (trial.at(-1)?.champion ?? 0), 0);
    return `${(sum / trials.length * (pois ?? 1)).toFixed(2)} (${label})`;
  });
  return `Champions observe on average, ${pois === null ? `as a ${unit}` : `of ${pois} POIs`}: ${found.join(", ")}.`;
}

// A training that was stopped still reports the generation that it had begun.
part(() => [state.training, state.training && state.training.state, state.training && state.training.state === "stopped" && state.training.reached], () => {
  const { training } = state;
  if (training && training.state === "done") $("announced").textContent = `Training is finished. ${found_by(training)}`;
  else $("announced").textContent = training && training.state === "stopped" ? `Stopped after generation ${Math.max(0, training.reached)}.` : "";
});

// Stops a training. The generations played so far can still be watched.
export function stop() {
  const { training } = state;
  if (!training || training.state !== "training") return;
  training.stop();
  render();
}

// Discards a training and its results, even if it has not started yet.
export function forget() {
  starting = null;
  if (state.training) state.training.stop();
  leave();
  render({ training: null, exhibit: null, policies: null, generation: 0, trial: 0, troubles: {}, message: "", note: "" });
}

part(() => [state.training, state.training && state.training.state === "done"], () => {
  const { training } = state;
  $("digests").replaceChildren();
  if (!training || training.state !== "done") return;
  for (const arm of training.arms) {
    const place = make("div", "", $("digests"), { className: "digest" });
    const head = make("div", "", place, { className: "row" });
    make("b", `${arm.label}:`, head);
    make("code", arm.digest, head, { className: "sha" });
    if (arm.command) make("code", arm.command, place);
    const { command, zip } = arm, { source } = training;
    const acts = make("div", "", place, { className: "row" });
    if (zip) make("button", `Save the run (.zip): ${arm.label}`, acts, { type: "button", className: "home" }).addEventListener("click", () => save(`${arm.name}-${slug(arm.label)}.zip`, zip, "application/zip"));
    if (source && command && !command.includes(" configs/")) {
      make("button", `Save ${arm.name}.toml`, acts, { type: "button" }).addEventListener("click", () => save(`${arm.name}.toml`, source.text, "text/plain"));
    }
    if (command) make("button", "Copy the command", acts, { type: "button" }).addEventListener("click", () => copy(command, "The command is copied. It gives the same digest."));
  }
});
