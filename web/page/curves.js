// The learning curves below the map.
import { chart } from "./chart.js";
import { $, make, make_key } from "./dom.js";
import { TONES, part, state } from "./state.js";

/** The chart, once it is drawn. @type {ReturnType<typeof chart.paint> | null} */
export let drawn_chart = null;
part(() => [state.training, state.training && state.training.version, state.follow || state.generation, state.over], curves);

export function curves() {
  const { training, follow, generation, over } = state;
  // Before a training, there is neither a chart nor a generation to choose.
  $("curves").hidden = $("legend").hidden = $("training").hidden = !training;
  $("needless").textContent = needless(training);
  if (!training) return;
  // If the number of POIs differs between stages, the curves show shares instead.
  const pois = training.pois ?? 1;
  // About 1000 points per curve are enough for the width of the chart.
  const every = Math.ceil(Math.max(1, training.reached) / 1000);
  const sample = (/** @type {Row[]} */ trial) => Array.from({ length: Math.ceil(trial.length / every) }, (_, index) => trial[index * every].champion * pois);
  const scaled = (/** @type {Place[] | null} */ points) => points && points.map(([generation, g]) => /** @type {Place} */ ([generation, g * pois]));
  const arms = training.arms.map(({ style, trials, constant, random }, index) => {
    const found = training.found && training.found.curves[index];
    return {
      tone: TONES[style], dashes: chart.DASHES[style], trials: trials.map(sample), constant: constant === null ? null : constant * pois, random: random.map(g => g * pois),
      mean: found ? scaled(found.generation.map((generation, at) => /** @type {Place} */ ([generation, found.mean[at]]))) : null, band: found ? scaled(found.band) : null,
    };
  });
  const cursor = over ?? (follow ? null : generation);
  drawn_chart = chart.paint($("curves"), arms, every, training.last, pois, cursor);
  $("legend").replaceChildren();
  const many = training.unit, own = training.arms;
  const reached = Math.min(...own.map(({ trials }) => Math.min(...trials.map(trial => trial.length)) - 1), Infinity), at = Math.min(cursor ?? reached, reached);
  /** @param {string} tone @param {number[]} dashes @param {string} text */
  const item = (tone, dashes, text) => {
    const place = make("span", "", $("legend"));
    make_key(tone, dashes, place);
    make("span", ` ${text}`, place);
  };
  const words = own.map(({ label, style, trials }) => {
    const mean = trials.reduce((sum, trial) => sum + trial[Math.min(Math.max(0, at), trial.length - 1)]?.champion, 0) / trials.length * pois;
    const value = at >= 0 ? `${mean.toFixed(2)} of ${pois}` : "–";
    item(TONES[style], chart.DASHES[style], `${label}: ${value}`);
    return `${label} ${value} ${many} at generation ${Math.max(0, at)}`;
  });
  /** Adds the key of a baseline. @param {number[]} dashes @param {string} name @param {(number | null | undefined)[]} values */
  const baseline = (dashes, name, values, drawn = false) => {
    const found = own.flatMap(({ label }, index) => typeof values[index] === "number" ? [{ label, value: (values[index] * pois).toFixed(2) }] : []);
    if (!found.length) return drawn ? item("--faint", dashes, `${name}: being played…`) : undefined;
    const alike = found.length === own.length && found.every(({ value }) => value === found[0].value);
    item("--faint", dashes, `${name}: ${alike ? found[0].value : found.map(({ label, value }) => `${value} (${label})`).join(", ")}`);
  };
  baseline(chart.CONSTANT, "best constant action", own.map(({ constant }) => constant));
  baseline(chart.RANDOM, "best of as many random teams", own.map(({ random }) => random[Math.max(0, at)]), own.some(({ random }) => random.length));
  // Otherwise nobody expects an interval around a flat line.
  const few = own.some(({ trials }) => trials.length < 10), interval = arms.some(arm => arm.band) ? `, with its 95 % interval${few ? ", wide because trials are few" : ""}` : "";
  make("span", `${many[0].toUpperCase()}${many.slice(1)} observed by the champion, the team of each population's best policy${at >= 0 ? `, at generation ${at}` : ""}. Thick: mean over trials${interval}. Thin: each trial.`, $("legend"));
  $("curves").setAttribute("aria-label", `Learning curves, champion, mean over trials: ${words.join("; ")}`);
}

/** Says if a constant action observes as much as what was trained, because then nothing had to be learned. @param {Training | null} training */
function needless(training) {
  if (!training || training.state !== "done") return "";
  const final = (/** @type {Arm} */ { trials }) => trials.reduce((sum, trial) => sum + trial[trial.length - 1].champion, 0) / trials.length;
  const alike = training.arms.flatMap(arm => arm.constant !== null && arm.constant > 0 && arm.constant >= final(arm) - 1e-9 ? [{ arm, constant: arm.constant }] : []);
  if (!alike.length) return "";
  const all = training.pois ?? 1, many = (/** @type {number} */ g) => (g * all).toFixed(2);
  return `No learning is needed here. ${alike.map(({ arm, constant }) => `${arm.label} observes ${many(final(arm))} of ${all}${training.pois === null ? "" : " POIs"}, and the best constant action ${many(constant)}`).join("; ")}. In "Two groups must meet", a constant action observes nothing.`;
}
