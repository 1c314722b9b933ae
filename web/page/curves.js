// The learning curves below the map.
import { chart } from "./chart.js";
import { $, make } from "./dom.js";
import { TONES, part, state } from "./state.js";

/** The chart, once it is drawn. @type {ReturnType<typeof chart.paint> | null} */
export let drawn_chart = null;
part(() => [state.training, state.training && state.training.version, state.follow || state.generation, state.pois, state.config.learning.generations], curves);

export function curves() {
  const { training } = state;
  // If the number of POIs differs between stages, the curves show shares instead.
  const pois = (training ? training.pois : state.pois) ?? 1;
  // About 1000 points per curve are enough for the width of the chart.
  const every = training ? Math.ceil(Math.max(1, training.reached) / 1000) : 1;
  const sample = (/** @type {Row[]} */ trial) => Array.from({ length: Math.ceil(trial.length / every) }, (_, index) => trial[index * every].best * pois);
  const scaled = (/** @type {Place[] | null} */ points) => points && points.map(([generation, g]) => /** @type {Place} */ ([generation, g * pois]));
  const arms = (training ? training.arms : []).map(({ trials, constant, random }, index) => {
    const found = training && training.found && training.found.curves[index];
    return {
      tone: TONES[index], trials: trials.map(sample), constant: constant === null ? null : constant * pois, random: random.map(g => g * pois),
      mean: found ? scaled(found.generation.map((generation, at) => /** @type {Place} */ ([generation, found.mean[at]]))) : null, band: found ? scaled(found.band) : null,
    };
  });
  const last = training ? training.last : state.config.learning.generations;
  drawn_chart = chart.paint($("curves"), arms, every, last, pois, training && !state.follow ? state.generation : null);
  $("legend").replaceChildren();
  const many = training && training.pois === null ? "share of POIs" : "POIs";
  const words = (training ? training.arms : []).map(({ label, trials, constant, random }, index) => {
    const reached = Math.min(...trials.map(trial => trial.length)) - 1, at = state.follow ? reached : Math.min(state.generation, reached);
    const item = make("span", "", $("legend"));
    make("span", "", item, { className: `key${index ? " dashed" : ""}` }).style.color = `var(${TONES[index]})`;
    const mean = at < 0 ? 0 : trials.reduce((sum, trial) => sum + trial[at].best, 0) / trials.length * pois;
    const value = at >= 0 ? `${mean.toFixed(2)} of ${pois}` : "–";
    make("span", ` ${label}: ${value}`, item);
    const beside = [];
    if (constant !== null) beside.push(`best constant action ${(constant * pois).toFixed(2)}`);
    if (random.length) beside.push(`best random team ${(random[Math.min(Math.max(0, at), random.length - 1)] * pois).toFixed(2)}`);
    if (beside.length) make("small", ` (without learning: ${beside.join(", ")})`, item);
    return `${label} ${value} ${many} at generation ${Math.max(0, at)}`;
  });
  make("span", `${many} observed by the best team, mean over trials${arms.some(arm => arm.band) ? " with its 95 % interval" : ""}; thin: each trial${arms.some(arm => arm.constant !== null) ? "; dotted: the best constant action, and the best of as many random teams" : ""}`, $("legend"));
  $("curves").setAttribute("aria-label", `Learning curves, best team, mean over trials: ${words.join("; ") || "nothing trained yet"}`);
  $("needless").textContent = needless(training);
}

/** Says if a constant action observes as much as what was trained, because then nothing had to be learned. @param {Training | null} training */
function needless(training) {
  if (!training || training.state !== "done") return "";
  const final = (/** @type {Arm} */ { trials }) => trials.reduce((sum, trial) => sum + trial[trial.length - 1].best, 0) / trials.length;
  const alike = training.arms.filter(arm => arm.constant !== null && arm.constant > 0 && arm.constant >= final(arm) - 1e-9);
  if (!alike.length) return "";
  return `A constant action observes as much as ${alike.map(arm => arm.label).join(", ")}. No learning is needed for that. In "Two groups must meet", a constant action observes nothing.`;
}
