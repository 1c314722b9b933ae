// @ts-check
// Views of episodes: one canvas per arm.
import { ring } from "./arrange.js";
import { credits, dark, select } from "./credit.js";
import { curves } from "./curves.js";
import { $, make, number, pen_of, still, trouble } from "./dom.js";
import { reach } from "./scene.js";
import { angles, moment, words } from "./senses.js";
import { NAMES, TONES, state } from "./state.js";
import { last_of } from "./training.js";

/** Adds a view. @param {string} label */
export function view(label) {
  const card = make("section", "", $("views"), { className: "card" });
  const head = make("h2", "", card);
  const dash = make("span", "", head, { className: `key${state.views.length ? " dashed" : ""}` });
  dash.style.color = `var(${TONES[state.views.length]})`;
  const title = make("span", NAMES[label] || label, head);
  const said = make("p", "", card, { role: "status" });
  said.setAttribute("aria-live", "off");
  const canvas = make("canvas", "", card);
  canvas.setAttribute("role", "img");
  /** @type {View} */
  const made = { label, card, title, said, canvas, data: null, place: 0, playing: false, over: null, wanted: null, asking: false, crop: [0, 0, 1, 1], removed: null, selected: null };
  canvas.addEventListener("pointermove", (/** @type {PointerEvent} */ event) => pointed(made, event));
  canvas.addEventListener("click", (/** @type {MouseEvent} */ event) => picked(made, event));
  canvas.addEventListener("pointerleave", () => { made.over = null; draw(made); });
  state.views.push(made);
  return made;
}

/** Makes a view for each arm. @param {Training} training */
export function build(training) {
  clear();
  $("loop").checked = false;
  for (const arm of training.arms) view(arm.label).crop = reach(arm.config);
  $("views").classList.toggle("one", training.arms.length === 1);
  $("views").classList.toggle("many", training.arms.length > 2);
  // Trials that all arms have.
  const trials = Math.min(...training.arms.map(arm => arm.trials.length));
  $("trial").replaceChildren(...Array.from({ length: trials }, (_, trial) => make("option", String(trial))));
  $("scrub").max = training.last;
  $("scrub").value = 0;
}

/** Decodes an episode and its details, in place. @param {any} data */
export function unpack(data) {
  stage.unpack(data);
  for (const episode of data.episodes) {
    if (episode.senses) episode.senses = new Float32Array(stage.bytes(episode.senses));
    for (const { alone, group } of episode.without || []) for (const part of [alone, group]) part.near = new Uint16Array(stage.bytes(part.near));
  }
  return data;
}

export function clear() {
  state.views = [];
  $("views").replaceChildren();
  $("credit").hidden = true;
}

/** Draws a view at its place in the episode. @param {View} view */
export function draw(view) {
  if (!view.data) return;
  const { data } = view, [own] = data.episodes;
  const { removed } = view, gone = removed && own.without && own.without[removed.leader][removed.group ? "group" : "alone"];
  const episode = gone ? { ...own, ...gone } : own;
  const look = {
    crop: view.crop, trails: $("trails").checked, radii: $("radii").checked, groups: true, over: view.over,
    heat: $("heat").checked, removed: gone ? removed : null, dark: dark(view),
  };
  const { step, positions } = stage.paint(data, episode, view.canvas, view.place, look);
  view.drawn = positions;
  if (view === state.views[0]) steps(view);
  const [observed, said] = stage.say(episode, step);
  if (view.tell) view.tell(step, observed, said);
  else {
    const end = number(episode.g * data.pois.length);
    view.said.textContent = `generation ${episode.generation}, trial ${episode.trial} · ${observed} of ${data.pois.length} POIs by step ${step} · ends at ${end}`;
    view.canvas.setAttribute("aria-label", `${NAMES[view.label] || view.label}: the best team of generation ${episode.generation}, step ${step}: ${said}`);
  }
  if (view.chosen) ring(view);
  senses(view, own);
  if (view === state.views[0]) playing();
}

/** Draws what the selected leader senses: a sector per quadrant, outside for POIs and inside for agents. @param {View} view @param {any} episode */
function senses(view, episode) {
  const leader = view.selected ?? -1, shows = leader >= 0 && episode.senses && leader < episode.leaders;
  view.sensed ??= make("p", "", view.card, { className: "sensed" });
  view.sensed.hidden = !shows;
  if (!shows) return;
  const frame = Math.min(Math.floor(view.place), episode.shown.length - 1);
  const now = moment(episode.senses, episode.leaders, frame, leader), { X, Y } = stage.place_on(view.canvas, view.crop);
  view.sensed.textContent = frame === 0 ? `Leader ${leader} has not sensed anything yet.` : `Leader ${leader} ${words(now)}`;
  if (frame === 0) return;
  const [x, y, cos, sin] = stage.moment(view.data, episode, frame - 1, leader), ahead = Math.atan2(sin, cos);
  const pen = pen_of(view.canvas), style = getComputedStyle(document.documentElement);
  for (const { values, tone, size } of [{ values: now.pois, tone: "--poi", size: 46 }, { values: now.agents, tone: "--accent", size: 26 }]) {
    const most = Math.max(...values, 1e-9);
    values.forEach((value, quadrant) => {
      const [from, to] = angles(quadrant).map(angle => -(ahead + angle));
      pen.beginPath();
      pen.moveTo(X(x), Y(y));
      pen.arc(X(x), Y(y), size, from, to, true);
      pen.closePath();
      pen.globalAlpha = 0.08 + 0.4 * Math.max(0, value) / most;
      pen.fillStyle = style.getPropertyValue(tone).trim();
      pen.fill();
      pen.globalAlpha = 0.7;
      pen.strokeStyle = pen.fillStyle;
      pen.lineWidth = 1;
      pen.stroke();
    });
  }
  pen.globalAlpha = 1;
}

/** Selects the leader under a click, or none. @param {View} view @param {MouseEvent} event */
function picked(view, event) {
  if (state.mode !== "watch" || !view.data || !view.drawn || !view.data.episodes[0].senses) return;
  const { X, Y } = stage.place_on(view.canvas, view.crop), { leaders } = view.data.episodes[0];
  const away = view.drawn.slice(0, leaders).map(([x, y]) => Math.hypot(X(x) - event.offsetX, Y(y) - event.offsetY));
  const nearest = away.indexOf(Math.min(...away));
  if (away[nearest] <= 18) select(view, nearest);
}

/**
 * Plays an episode from its start, or shows its end if `moving` is false. Visitors who prefer reduced motion also see the end.
 * @param {View} view @param {any} data
 */
export function show(view, data, moving = true) {
  const last = data.episodes[0].shown.length - 1;
  const plays = moving && !still.matches, [left, below, right, above] = view.crop;
  // Stages and jitter may move POIs out of the view.
  if (data.pois.some((/** @type {Place} */ [x, y]) => x < left || x > right || y < below || y > above)) view.crop = stage.whole(data);
  // A removed leader stays removed while the episode is the same.
  if (data !== view.data) view.removed = null;
  if (view.selected && view.selected >= data.episodes[0].leaders) view.selected = null;
  Object.assign(view, { data, place: plays ? 0 : last, playing: plays, ended: plays ? null : performance.now() });
  draw(view);
  credits();
  wake_up();
}

/** Sets the step slider to the first view's step. @param {View} view */
export function steps(view) {
  const last = view.data.episodes[0].shown.length - 1;
  $("step").disabled = last === 0;
  $("step").max = last;
  $("step").value = Math.floor(view.place);
  $("step").setAttribute("aria-valuetext", `step ${view.data.episodes[0].shown[Math.floor(view.place)]} of ${view.data.steps}`);
}

/** Shows all views at a step, and pauses them. @param {number} place */
export function step_to(place) {
  $("loop").checked = false;
  for (const view of state.views.filter(view => view.data)) {
    Object.assign(view, { playing: false, place: Math.min(place, view.data.episodes[0].shown.length - 1), ended: performance.now() });
    draw(view);
  }
}

// Sets the button of the player.
function playing() {
  const plays = state.views.some(view => view.playing);
  if ($("replay").textContent !== (plays ? "Pause the episode" : "Play")) $("replay").textContent = plays ? "Pause the episode" : "Play";
}

// Plays the episodes, from their start if they have ended, or pauses them.
export function replay() {
  const views = state.views.filter(view => view.data && view.data.episodes[0].shown.length > 1), plays = views.some(view => view.playing);
  const ended = views.every(view => view.place >= view.data.episodes[0].shown.length - 1);
  if (plays) $("loop").checked = false;
  for (const view of views) {
    if (plays) Object.assign(view, { playing: false, ended: performance.now() });
    else Object.assign(view, { place: ended ? 0 : view.place, playing: true, ended: null });
    draw(view);
  }
  wake_up();
}

/** When the last frame was drawn, or null. @type {number | null} */
let clock = null;
let running = false, has_moved = false;
export function wake_up() {
  if (running) return;
  running = true;
  clock = null;
  requestAnimationFrame(tick);
}

/** @param {number} time */
function tick(time) {
  const seconds = clock === null ? 0 : Math.min((time - clock) / 1000, 0.25);
  clock = time;
  const { training } = state, live = training && training.state === "training" && state.follow;
  for (const view of state.views.filter(view => view.playing)) {
    const [episode] = view.data.episodes, last = episode.shown.length - 1;
    // An episode takes 1.6 s during training. Afterwards it plays in simulated time, but for at most 4 s.
    const whole = view.data.steps * view.data.dt, times = whole / (live ? 1.6 : Math.min(whole, 4)) * Number($("speed").value);
    // The time of the first motion, for measurements.
    if (!has_moved && seconds > 0) { has_moved = true; performance.mark("motion"); }
    view.place = stage.later(view.data, episode, view.place, seconds * times);
    if (view.place >= last) {
      view.playing = false;
      view.ended = time;
    }
    draw(view);
  }
  // Repeats together, a second after the last view has ended.
  const views = state.views.filter(view => view.data && view.data.episodes[0].shown.length > 1);
  const waits = $("loop").checked && !live && state.mode === "watch" && views.length > 0 && views.every(view => !view.playing && view.ended);
  if (waits && views.every(view => time - (view.ended ?? time) > 1000)) views.forEach(view => Object.assign(view, { place: 0, playing: true, ended: null }));
  if (state.follow) follow();
  running = waits || state.views.some(view => view.playing);
  if (running) requestAnimationFrame(tick);
}

// Requests the current best team for every view that has finished its episode.
export function follow() {
  const { training } = state;
  if (!training || state.mode !== "watch" || !state.follow || training.state === "starting") return;
  state.generation = Math.max(0, training.reached);
  position();
  state.views.forEach((view, run) => {
    const at = view.data ? view.data.episodes[0].generation : -1;
    const rest = still.matches ? 700 : 250;
    if (view.playing || view.asking || at >= last_of(training.arms[run]) || at === state.generation && training.state !== "done") return;
    if (view.ended && performance.now() - view.ended < rest) return void setTimeout(follow, rest);
    ask(view, run, training.state === "done" ? training.last : state.generation);
  });
}

/** Requests an episode for a view, and shows it. @param {View} view @param {number} run @param {number} generation */
export async function ask(view, run, generation) {
  const { training, trial } = state;
  if (!training) return;
  view.asking = true;
  try {
    const data = unpack(await training.best(run, trial, generation));
    if (state.training === training && state.views[run] === view && state.mode === "watch") show(view, data);
  } catch (/** @type {any} */ error) {
    if (!error.stopped && state.training === training && !/worker/.test(error.message)) trouble(error.message);
  }
  view.asking = false;
  if (view.wanted !== null) {
    const wanted = view.wanted;
    view.wanted = null;
    ask(view, run, wanted);
  }
}

/** Shows a generation of all arms. @param {number} generation */
export function seek(generation) {
  const { training } = state;
  if (!training || training.state === "starting") return;
  following(training.state === "training" && generation >= training.reached);
  state.generation = Math.max(0, Math.min(training.reached, generation));
  position();
  curves();
  state.views.forEach((view, run) => {
    if (view.asking) view.wanted = state.generation;
    else ask(view, run, state.generation);
  });
}

/** Follows the training, or not. @param {boolean} follow */
export function following(follow) {
  state.follow = follow;
  $("following").checked = follow;
}

export function position() {
  const { training, generation } = state;
  if (!training) return;
  const ahead = state.follow && training.state === "training";
  $("scrub").value = generation;
  $("generation").textContent = `${ahead ? "trained to generation" : "generation"} ${generation} of ${training.last}`;
  $("scrub").setAttribute("aria-valuetext", $("generation").textContent);
}

export function controls() {
  const { training } = state, going = Boolean(training && training.state === "training");
  $("pause").disabled = $("stop").disabled = $("following").disabled = !going;
  $("pause").textContent = going && training && training.paused ? "Continue" : "Pause";
  $("scrub").disabled = !training || training.state === "starting";
}

export function pause() {
  const { training } = state;
  if (!training || training.state !== "training") return;
  training.paused = !training.paused;
  if (!training.paused) following(true);
  controls();
  follow();
}

/** Marks the POI under the pointer. @param {View} view @param {PointerEvent} event */
function pointed(view, event) {
  if (state.mode !== "watch" || !view.data) return;
  const over = stage.poi_at(view.data, view.canvas, view.crop, event.offsetX, event.offsetY);
  if (over !== view.over) { view.over = over; draw(view); }
}
