// Draws learning curves: POIs observed by the champion, per arm the mean over trials, with each trial as a thin line.
import { pen_of } from "./dom.js";

/**
 * An arm of the chart. Each trial is a list of POIs, one value per `every` generations. `mean` and the outline `band` of its interval are
 * lists of [generation, POIs], or null: then the mean is drawn without an interval. `constant` is what the best constant action
 * observes, or null, and `random` the best random team, per generation.
 * @typedef {{ tone: string, dashes: number[], trials: number[][], constant: number | null, random: number[], mean: Place[] | null, band: Place[] | null }} Drawn
 */

export const chart = (() => {
  // Dashes of arms, by style, and of the baselines.
  const DASHES = [[], [7, 3], [12, 4], [3, 3], [10, 3, 3, 3], [16, 3]], CONSTANT = [1.5, 4], RANDOM = [6, 3, 1.5, 3];
  /**
   * `cursor` is the generation to mark, or null. Then the means have a dot there, otherwise at their end.
   * @param {HTMLCanvasElement} canvas @param {Drawn[]} arms @param {number} every @param {number} last @param {number} pois
   * @param {number | null} cursor
   */
  function paint(canvas, arms, every, last, pois, cursor) {
    const wide = canvas.clientWidth, tall = canvas.clientHeight, dots = window.devicePixelRatio || 1;
    if (canvas.width !== Math.round(wide * dots) || canvas.height !== Math.round(tall * dots)) {
      canvas.width = Math.round(wide * dots);
      canvas.height = Math.round(tall * dots);
    }
    const style = getComputedStyle(document.documentElement), color = (/** @type {string} */ name) => style.getPropertyValue(name).trim();
    const draw = pen_of(canvas);
    draw.setTransform(dots, 0, 0, dots, 0, 0);
    draw.clearRect(0, 0, wide, tall);
    const [left, right, above, below] = [36, 14, 12, 36];
    const X = (/** @type {number} */ generation) => left + (wide - left - right) * (last > 0 ? generation / last : 0);
    const Y = (/** @type {number} */ value) => tall - below - (tall - above - below) * (pois > 0 ? value / pois : 0);
    draw.font = "12px system-ui, sans-serif";
    draw.lineWidth = 1;
    draw.textBaseline = "middle";
    draw.textAlign = "right";
    const step = pois > 1 ? Math.ceil(pois / 5) : 0.25;
    for (let value = 0; value <= pois; value += step) {
      draw.strokeStyle = color("--line");
      draw.beginPath(); draw.moveTo(left, Y(value)); draw.lineTo(wide - right, Y(value)); draw.stroke();
      draw.fillStyle = color("--faint");
      draw.fillText(String(value), left - 7, Y(value));
    }
    draw.textAlign = "center";
    const rough = Math.max(1, last) / Math.max(2, Math.min(10, Math.floor(wide / 90)));
    const size = 10 ** Math.floor(Math.log10(rough)), apart = Math.max(1, ([1, 2, 5].find(n => n * size >= rough) ?? 10) * size);
    for (let generation = 0; generation <= last; generation += apart) draw.fillText(String(Math.round(generation)), X(generation), tall - below + 13);
    draw.fillText("generation", (left + wide - right) / 2, tall - 7);
    if (cursor !== null) {
      draw.strokeStyle = color("--edge");
      draw.setLineDash([3, 3]);
      draw.beginPath(); draw.moveTo(X(cursor), above); draw.lineTo(X(cursor), tall - below); draw.stroke();
      draw.setLineDash([]);
    }
    draw.lineJoin = "round";
    for (const { tone, band } of arms) {
      if (!band) continue;
      draw.fillStyle = color(tone);
      draw.globalAlpha = 0.1;
      draw.beginPath();
      for (const [generation, value] of band) draw.lineTo(X(generation), Y(value));
      draw.fill();
      draw.globalAlpha = 1;
    }
    for (const { tone, trials } of arms) {
      draw.strokeStyle = color(tone);
      draw.lineWidth = 1;
      draw.globalAlpha = 0.32;
      for (const trial of trials) line(draw, trial, every, X, Y);
      draw.globalAlpha = 1;
    }
    // Baselines: a dotted line for the best constant action, and a dotted curve for random teams.
    for (const { tone, constant, random } of arms) {
      draw.strokeStyle = color(tone);
      draw.lineWidth = 1.6;
      draw.setLineDash(CONSTANT);
      if (constant !== null) { draw.beginPath(); draw.moveTo(left, Y(constant)); draw.lineTo(wide - right, Y(constant)); draw.stroke(); }
      draw.setLineDash(RANDOM);
      if (random.length) line(draw, random, 1, X, Y);
      draw.setLineDash([]);
    }
    for (const { tone, dashes, trials, mean: found } of arms) {
      const means = found || averages(trials).map((value, at) => /** @type {Place} */ ([at * every, value]));
      if (!means.length) continue;
      draw.strokeStyle = color(tone);
      draw.lineWidth = 2.5;
      draw.setLineDash(dashes);
      draw.beginPath();
      for (const [generation, value] of means) draw.lineTo(X(generation), Y(value));
      draw.stroke();
      draw.setLineDash([]);
      const [generation, value] = means.findLast(([generation]) => cursor !== null && generation <= cursor) ?? means[means.length - 1];
      draw.fillStyle = color(tone);
      draw.beginPath(); draw.arc(X(generation), Y(value), 4, 0, 2 * Math.PI); draw.fill();
    }
    return { generation: (/** @type {number} */ x) => Math.round(Math.max(0, Math.min(1, (x - left) / (wide - left - right))) * last) };
  }

  /** @typedef {(value: number) => number} Scale */
  /** @param {CanvasRenderingContext2D} draw @param {number[]} values @param {number} every @param {Scale} X @param {Scale} Y */
  function line(draw, values, every, X, Y) {
    draw.beginPath();
    values.forEach((value, index) => draw.lineTo(X(index * every), Y(value)));
    draw.stroke();
  }

  /** Returns the mean over trials, up to the last generation that all trials have reached. @param {number[][]} trials */
  function averages(trials) {
    const length = trials.length ? Math.min(...trials.map(trial => trial.length)) : 0;
    return Array.from({ length }, (_, generation) => trials.reduce((sum, trial) => sum + trial[generation], 0) / trials.length);
  }

  return { paint, DASHES, CONSTANT, RANDOM };
})();
