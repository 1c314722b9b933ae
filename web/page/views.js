// Views of episodes: one canvas per arm.
import { chart } from "./chart.js";
import { $, failure, make, make_key, pen_of, still, write_text } from "./dom.js";
import { join, start_scene } from "./scene.js";
import { angles, moment, name_of_leader, words } from "./senses.js";
import { NAMES, TONES, part, render, shown, state, trouble } from "./state.js";
import { last_of } from "./training.js";

/** Adds a view: of an arm with a style, or without one. @param {string} label @param {Crop} crop @param {number | null} style */
export function add_view(label, crop, style = null) {
  const card = make("section", "", $("views"), { className: "card" });
  const head = make("h2", "", card);
  if (style !== null) make_key(TONES[style], chart.DASHES[style], head);
  const title = make("span", "", head), [name, ...more] = (NAMES[label] || label).split(/(?=: )/);
  title.append(name, make("small", more.join("")));
  const status = make("p", "", card, { role: "status", ariaLive: "off" });
  const canvas = make("canvas", "", card, { role: "img" });
  const marks = make("p", "", card, { className: "marks", hidden: true }), sensed = make("p", "", card, { className: "sensed", hidden: true });
  /** @type {View} */
  const view = {
    label, card, title, status, canvas, marks, sensed, crop, data: null, place: 0, playing: false, ended: null, over: null, wanted: null,
    asking: false, chosen: null, removed: null, selected: null, drawn: [], ghosts: [], haunted: null, describe: null,
  };
  canvas.addEventListener("pointermove", event => pointed(view, event));
  canvas.addEventListener("click", event => picked(view, event));
  canvas.addEventListener("pointerleave", () => { view.over = null; draw(view); });
  state.views.push(view);
  aim(view, crop);
  return view;
}

/**
 * Sets the part of a map that a view shows, extended to the shape of its canvas: width divided by height.
 * @param {View} view @param {Crop} crop
 */
export function aim(view, [left, below, right, above], shape = (right - left) / (above - below), map = (view.data ?? state.config.world).map) {
  const wide = Math.max(right - left, (above - below) * shape), tall = wide / shape;
  // The middle moves so that no more than a margin beyond the walls is shown, unless the map is smaller than the canvas.
  const [x, y] = [[left, right, wide], [below, above, tall]].map(([low, high, size], axis) => {
    const most = map[axis] + 1.5 - size / 2, least = size / 2 - 1.5, middle = (low + high) / 2;
    return most < least ? middle : Math.max(least, Math.min(most, middle));
  });
  view.crop = [x - wide / 2, y - tall / 2, x + wide / 2, y + tall / 2];
  view.canvas.style.setProperty("--wide", String(shape));
}

/** Scrolls the maps into view if they are not, with the guide and the bar above them, and what arranges or steers below them. */
export function reveal() {
  const above = $("guide").hidden ? $("views") : $("guide"), least = above === $("views") ? $("bar").offsetHeight : 0;
  const below = state.mode === "watch" ? $("views") : $(state.mode);
  if (above.getBoundingClientRect().top < least || below.getBoundingClientRect().bottom > innerHeight) above.scrollIntoView({ block: "start" });
}

/** Shows a single view that belongs to no arm. @param {string} title @param {Crop} crop */
export function only_view(title, crop) {
  clear();
  return add_view(title, crop);
}

/** Makes a view for each arm. All show the same part of the map, in a shape that leaves room for the chart. @param {Training} training */
export function build(training) {
  clear();
  const crop = training.arms.map(({ config }) => stage.busy(start_scene(config))).reduce(join);
  const shape = shape_of(crop);
  for (const { label, style } of training.arms) aim(add_view(label, crop, style), crop, shape);
}

/** Returns the shape of views that are beside each other: near that of the part of the map that they show. @param {Crop} crop */
export const shape_of = ([left, below, right, above]) => Math.max(1, Math.min(1.6, (right - left) / (above - below)));

export function clear() {
  state.views = [];
  $("views").replaceChildren();
}

/** Draws a view at its place in the episode. @param {View} view */
export function draw(view) {
  const { data, removed } = view;
  if (!data) return;
  const [own] = data.episodes, gone = without(own, removed), episode = gone ? { ...own, ...gone } : own;
  const look = {
    crop: view.crop, trails: $("trails").checked, radii: $("radii").checked, groups: true, over: view.over,
    heat: $("heat").checked, removed: gone ? removed : null, lost: lost_pois(data, removed),
  };
  const { step, positions } = stage.paint(data, episode, view.canvas, view.place, look);
  view.drawn = positions;
  haunt(view);
  if (view === state.views[0]) steps(data, view.place);
  const [observed, text] = stage.say(episode, step);
  const [status, label] = view.describe ? view.describe(step, observed, text) : [
    `generation ${episode.generation}, trial ${episode.trial} · ${observed} of ${data.pois.length} POIs by step ${step}`,
    `${NAMES[view.label] || view.label}: the champion of generation ${episode.generation}, step ${step}: ${text}`,
  ];
  const missing = gone && removed ? `, without ${name_of_leader(data, removed.leader)}${removed.group ? " and its followers" : ""}` : "";
  write_text(view.status, status + missing);
  view.canvas.ariaLabel = label + missing;
  if (view.chosen) ring(view, view.chosen);
  senses(view, data);
  if (view === state.views[0]) playing();
}

/** Returns what an episode observes without a leader. @param {Episode} episode @param {Removed | null} removed */
const without = (episode, removed) => removed && episode.without ? episode.without[removed.leader][removed.group ? "group" : "alone"] : null;

/** Returns the POIs that only the removed agents' presence observed. @param {Scene} data @param {Removed | null} removed */
export function lost_pois(data, removed) {
  const [episode] = data.episodes, gone = without(episode, removed);
  return gone ? episode.observed.flatMap((at, poi) => at !== null && gone.observed[poi] === null ? [poi] : []) : [];
}

/** Draws the ways of the leaders of other teams as faint lines, once for each look of the view. @param {View} view */
function haunt(view) {
  const { canvas, ghosts, crop } = view, look = [canvas.width, canvas.height, stage.night.matches, ...crop].join();
  if (!ghosts.length) return;
  if (!view.haunted || view.haunted.look !== look) view.haunted = { look, picture: ways(canvas, crop, ghosts) };
  const pen = pen_of(canvas);
  pen.save();
  pen.resetTransform();
  pen.drawImage(view.haunted.picture, 0, 0);
  pen.restore();
}

/** Returns a picture of the ways of leaders, of a canvas's size. @param {HTMLCanvasElement} canvas @param {Crop} crop @param {Scene[]} ghosts */
function ways(canvas, crop, ghosts) {
  const { X, Y } = stage.place_on(canvas, crop), picture = make("canvas", "", null, { width: canvas.width, height: canvas.height }), pen = pen_of(picture);
  pen.setTransform(pen_of(canvas).getTransform());
  pen.globalAlpha = 0.2;
  for (const ghost of ghosts) {
    const [episode] = ghost.episodes;
    for (let leader = 0; leader < episode.leaders; leader++) {
      pen.strokeStyle = stage.tint(ghost, leader);
      pen.beginPath();
      for (let frame = 0; frame < episode.shown.length; frame++) {
        const [x, y] = stage.moment(ghost, episode, frame, leader);
        pen.lineTo(X(x), Y(y));
      }
      pen.stroke();
    }
  }
  return picture;
}

/** Draws a ring around what is chosen in a view. @param {View} view @param {Chosen} chosen */
function ring(view, [list, index]) {
  const place = state.config.world[list][index];
  if (!place) return;
  const { X, Y } = stage.place_on(view.canvas, view.crop), pen = pen_of(view.canvas);
  pen.strokeStyle = getComputedStyle(document.documentElement).getPropertyValue("--accent").trim();
  pen.lineWidth = 2.5;
  pen.beginPath(); pen.arc(X(place[0]), Y(place[1]), 17, 0, 2 * Math.PI); pen.stroke();
}

/** Draws what the selected leader senses: the sectors of each channel, the first channel outside. @param {View} view @param {Scene} data */
function senses(view, data) {
  const [episode] = data.episodes, leader = view.selected;
  view.sensed.hidden = leader === null || !episode.senses;
  if (leader === null || !episode.senses) return;
  const frame = Math.min(Math.floor(view.place), episode.shown.length - 1);
  const now = moment(data, episode, frame, leader), name = name_of_leader(data, leader), { X, Y } = stage.place_on(view.canvas, view.crop);
  view.sensed.textContent = `${name[0].toUpperCase()}${name.slice(1)} ${frame === 0 ? "has not sensed anything yet." : words(now)}`;
  if (frame === 0) return;
  const [x, y, cos, sin] = stage.moment(data, episode, frame - 1, leader), ahead = Math.atan2(sin, cos);
  const pen = pen_of(view.canvas), style = getComputedStyle(document.documentElement);
  now.channels.forEach(({ values, ...channel }, index) => {
    if (channel.each) return;
    const most = Math.max(...values, 1e-9), size = 46 * (1 - index / now.channels.length);
    const tone = channel.of === "pois" ? "--poi" : "--accent", zero = channel.frame === "heading" ? ahead : 0;
    values.forEach((value, sector) => {
      const [from, to] = angles(sector, channel).map(angle => -(zero + angle));
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
  });
  pen.globalAlpha = 1;
}

/** Selects the leader under a click, or none. @param {View} view @param {MouseEvent} event */
function picked(view, event) {
  if (state.mode !== "watch" || !view.data || !view.data.episodes[0].senses) return;
  const { X, Y } = stage.place_on(view.canvas, view.crop), { leaders } = view.data.episodes[0];
  const away = view.drawn.slice(0, leaders).map(([x, y]) => Math.hypot(X(x) - event.offsetX, Y(y) - event.offsetY));
  const nearest = away.indexOf(Math.min(...away));
  if (away[nearest] <= 18) select(view, nearest);
}

/** Selects the leader whose senses are shown. Selecting it again ends that. @param {View} view @param {number} leader */
export function select(view, leader) {
  view.selected = view.selected === leader ? null : leader;
  draw(view);
  render();
}

/**
 * Plays an episode from its start, or shows its end if `moves` is false. Visitors who prefer reduced motion also see the end.
 * @param {View} view @param {Scene} data
 */
export function show(view, data, moves = true) {
  const last = data.episodes[0].shown.length - 1, plays = moves && !still.matches, crop = join(view.crop, stage.busy(data));
  // What is on show grows with the episodes, and is the same in all views.
  if (crop.some((side, index) => side !== view.crop[index])) {
    for (const other of state.views) aim(other, crop, Number(other.canvas.style.getPropertyValue("--wide")), data.map);
    state.views.forEach(draw);
  }
  // A removed leader stays removed while the episode is the same.
  if (data !== view.data) view.removed = view.over = null;
  view.marks.replaceChildren(...stage.legend(data));
  view.marks.hidden = !data.classes;
  if (view.selected && view.selected >= data.episodes[0].leaders) view.selected = null;
  Object.assign(view, { data, place: plays ? 0 : last, playing: plays, ended: plays ? null : performance.now() });
  draw(view);
  render();
  wake_up();
}

/** Sets the step slider to a place in an episode. @param {Scene} data @param {number} place */
function steps({ episodes: [{ shown }], steps }, place) {
  const slider = $("step"), step = String(Math.floor(place));
  if (slider.max === String(shown.length - 1) && slider.value === step && slider.ariaValueText) return;
  slider.disabled = shown.length === 1;
  slider.max = String(shown.length - 1);
  slider.value = step;
  slider.ariaValueText = `step ${shown[Number(step)]} of ${steps}`;
}

/** Returns the last frame of a view's episode. @param {Shown} view */
export const end_of = view => view.data.episodes[0].shown.length - 1;
/** Returns the views whose episodes have steps. */
export const moving = () => shown().filter(view => end_of(view) > 0);

/** Shows all views at a step, and pauses them. @param {number} place */
export function step_to(place) {
  $("loop").checked = false;
  for (const view of shown()) {
    Object.assign(view, { playing: false, place: Math.min(place, end_of(view)), ended: performance.now() });
    draw(view);
  }
}

// Sets the button of the player.
function playing() {
  $("replay").disabled = !moving().length && !state.training && !state.exhibit;
  write_text($("replay"), state.views.some(view => view.playing) ? "Pause the episode" : "Play");
}

// Plays the episodes, from their start if they have ended, or pauses them.
export function replay() {
  const views = moving(), plays = views.some(view => view.playing), ended = views.every(view => view.place >= end_of(view));
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
  for (const view of shown().filter(view => view.playing)) {
    const [episode] = view.data.episodes;
    // An episode takes 1.6 s during training. Afterwards it plays in simulated time, but for at most 4 s.
    const whole = view.data.steps * view.data.dt, times = whole / (live ? 1.6 : Math.min(whole, 4)) * Number($("speed").value);
    // The time of the first motion, for measurements.
    if (!has_moved && seconds > 0) { has_moved = true; performance.mark("motion"); }
    view.place = stage.later(view.data, episode, view.place, seconds * times);
    if (view.place >= end_of(view)) {
      view.playing = false;
      view.ended = time;
    }
    draw(view);
  }
  // Repeats together, a second after the last view has ended.
  const views = moving();
  const waits = $("loop").checked && !live && state.mode === "watch" && views.length > 0 && views.every(view => !view.playing && view.ended);
  if (waits && views.every(view => time - (view.ended ?? time) > 1000)) views.forEach(view => Object.assign(view, { place: 0, playing: true, ended: null }));
  if (state.follow) follow();
  running = waits || state.views.some(view => view.playing);
  // During training, about 20 pictures a second are enough, and leave the main thread free.
  if (running && live) setTimeout(requestAnimationFrame, 32, tick);
  else if (running) requestAnimationFrame(tick);
}

// Requests the newest champion for every view that has finished its episode.
export function follow() {
  const { training } = state;
  if (!training || state.mode !== "watch" || !state.follow || training.state === "starting") return;
  render({ generation: Math.max(0, training.reached) });
  state.views.forEach((view, run) => {
    const at = view.data ? view.data.episodes[0].generation : -1;
    const rest = still.matches ? 700 : 250;
    if (view.playing || view.asking || at >= last_of(training.arms[run]) || at === state.generation && training.state !== "done") return;
    if (view.ended && performance.now() - view.ended < rest) return void setTimeout(follow, rest);
    ask(view, run, training.state === "done" ? training.last : state.generation);
  });
}

/** Ends when the film that is being made of the views has ended. @type {Promise<unknown>} */
let filmed = Promise.resolve();
/** Shows no other episodes until a film is made. @param {Promise<unknown>} made */
export const hold = made => { filmed = made; };

/** Requests an episode for a view, and shows it. @param {View} view @param {number} run @param {number} generation */
export async function ask(view, run, generation) {
  const { training, trial } = state;
  if (!training) return;
  view.asking = true;
  try {
    const data = stage.unpack(await training.champion(run, trial, generation));
    await filmed;
    if (state.training === training && state.views[run] === view && state.mode === "watch") show(view, data);
  } catch (thrown) {
    const { message, stopped, fatal } = failure(thrown);
    if (!stopped && !fatal && state.training === training) trouble("run", message);
  }
  view.asking = false;
  if (view.wanted !== null) {
    const wanted = view.wanted;
    view.wanted = null;
    if (state.views[run] === view) ask(view, run, wanted);
  }
}

/** Shows a generation of all arms. @param {number} generation */
export function seek(generation) {
  const { training } = state;
  if (!training || training.state === "starting") return;
  render({ follow: training.state === "training" && generation >= training.reached, generation: Math.max(0, Math.min(training.reached, generation)) });
  ask_all();
}

// Requests the generation on show for all views.
export function ask_all() {
  state.views.forEach((view, run) => {
    if (view.asking) view.wanted = state.generation;
    else ask(view, run, state.generation);
  });
}

// The player of the training.
part(() => [state.training], () => {
  const { training } = state;
  $("loop").checked = !training && !still.matches;
  // Trials that all arms have.
  const trials = training ? Math.min(...training.arms.map(arm => arm.trials.length)) : 0;
  $("trial").disabled = !trials;
  $("trial").replaceChildren(...Array.from({ length: trials }, (_, trial) => make("option", String(trial))));
  $("scrub").max = String(training ? training.last : 100);
});
part(() => [state.training, state.training && state.training.state, state.training && state.training.paused, state.follow, state.generation, state.trial], () => {
  const { training, generation } = state, going = Boolean(training && training.state === "training");
  $("pause").disabled = $("stop").disabled = $("following").disabled = !going;
  $("pause").textContent = going && training && training.paused ? "Continue" : "Pause";
  $("following").checked = state.follow;
  $("scrub").disabled = !training || training.state === "starting";
  $("scrub").value = String(training ? generation : 0);
  $("trial").value = String(state.trial);
  $("generation").textContent = training ? `${state.follow && going ? "trained to generation" : "generation"} ${generation} of ${training.last}` : "";
  $("scrub").ariaValueText = $("generation").textContent;
});

export function pause() {
  const { training } = state;
  if (!training || training.state !== "training") return;
  training.paused = !training.paused;
  render({ follow: state.follow || !training.paused });
  follow();
}

/** Marks the POI under the pointer. @param {View} view @param {PointerEvent} event */
function pointed(view, event) {
  if (state.mode !== "watch" || !view.data) return;
  const over = stage.poi_at(view.data, view.canvas, view.crop, event.offsetX, event.offsetY);
  if (over !== view.over) { view.over = over; draw(view); }
}
