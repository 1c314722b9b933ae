// @ts-check
// Rearranging the map by pointer and keys.
import { configs } from "./config.js";
import { curves } from "./curves.js";
import { $, count, find, number, pen_of } from "./dom.js";
import { change } from "./experiment.js";
import { reach, start_scene } from "./scene.js";
import { state } from "./state.js";
import { clear, draw, show, view } from "./views.js";

export function show_start() {
  const { config } = state;
  if (!state.views.length || state.training || state.mode === "arrange") {
    if (state.mode !== "arrange" || state.views.length !== 1) {
      clear();
      view("leader-follower");
      $("views").classList.add("one");
    }
    const [only] = state.views;
    only.tell = (step, observed, said) => {
      const { world } = config;
      only.said.textContent = `${count(world.leaders.length, "leader")}, ${count(world.followers.length, "follower")}, ${count(world.pois.length, "POI")} · ${world.steps} steps`;
      only.canvas.setAttribute("aria-label", `Map of the start: ${only.said.textContent}${only.chosen ? `; chosen: ${name_chosen(only.chosen)}` : ""}`);
    };
    only.title.textContent = "Where everyone starts";
    find(".key", only.card).hidden = true;
  }
  const [only] = state.views;
  only.crop = state.mode === "arrange" ? [0, 0, ...config.world.map] : reach(config);
  if (only.chosen && !config.world[only.chosen[0]][only.chosen[1]]) only.chosen = null;
  if (state.mode === "arrange") {
    // Show the whole map, as high as the window allows below the row of modes.
    const [width, height] = config.world.map;
    only.canvas.style.maxWidth = `${Math.max(280, (innerHeight - 250) * width / height)}px`;
    only.canvas.style.marginInline = "auto";
    hands(only);
  }
  show(only, start_scene(config), false);
  if (!state.training) curves();
}

const KINDS = { leaders: "leader", followers: "follower", pois: "POI" };
const name_chosen = (/** @type {Chosen} */ [list, index]) => `${KINDS[list]} ${index} at ${state.config.world[list][index].map(number).join(", ")}`;

/** Draws a ring around what is chosen in a view. @param {View} view */
export function ring(view) {
  if (!view.chosen) return;
  const [list, index] = view.chosen, place = state.config.world[list][index];
  if (!place) return;
  const { X, Y } = stage.place_on(view.canvas, view.crop), pen = pen_of(view.canvas);
  pen.strokeStyle = getComputedStyle(document.documentElement).getPropertyValue("--accent").trim();
  pen.lineWidth = 2.5;
  pen.beginPath(); pen.arc(X(place[0]), Y(place[1]), 17, 0, 2 * Math.PI); pen.stroke();
}

/** Returns everything on the map: its list, its index and its place. @type {(config: any) => [List, number, Place][]} */
const items = ({ world }) => /** @type {List[]} */ (["leaders", "followers", "pois"]).flatMap(list => world[list].map((/** @type {Place} */ place, /** @type {number} */ index) => [list, index, place]));

/** @param {View} view @param {Chosen | null} chosen */
function choose(view, chosen) {
  view.chosen = chosen;
  $("chosen").textContent = chosen ? `Chosen: ${name_chosen(chosen)}` : "";
  draw(view);
}

// Positions are rounded to a tenth, and stay on the map.
const tenth = (/** @type {number} */ value, /** @type {number} */ most) => Math.round(Math.max(0, Math.min(most, value)) * 10) / 10;
/** @type {Record<string, number[]>} */
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

/** Lets the pointer and the keys move agents and POIs. @param {View} view */
export function hands(view) {
  if (view.canvas.classList.contains("hands")) return;
  view.canvas.classList.add("hands");
  view.canvas.tabIndex = 0;
  view.canvas.setAttribute("role", "application");
  /** @type {Chosen | null} */
  let held = null;
  const place = (/** @type {PointerEvent} */ event) => {
    const { scale } = stage.place_on(view.canvas, view.crop), [width, height] = state.config.world.map;
    return [tenth(view.crop[0] + event.offsetX / scale, width), tenth(view.crop[3] - event.offsetY / scale, height)];
  };
  view.canvas.addEventListener("pointerdown", event => {
    const { scale } = stage.place_on(view.canvas, view.crop), at = place(event);
    // Agents are drawn above POIs, so they take precedence.
    const away = (/** @type {[List, number, Place]} */ [list, , [x, y]]) => Math.hypot(x - at[0], y - at[1]) + (list === "pois" ? 1 : 0);
    const near = items(state.config).sort((a, b) => away(a) - away(b))[0];
    if (!near || away(near) > Math.max(18 / scale, state.config.world.observation_radius * 0.6)) return choose(view, null);
    held = [near[0], near[1]];
    choose(view, held);
    view.canvas.setPointerCapture(event.pointerId);
    view.canvas.focus();
  });
  view.canvas.addEventListener("pointermove", event => {
    if (!held) return;
    state.config.world[held[0]][held[1]] = place(event);
    show(view, start_scene(state.config), false);
    choose(view, held);
  });
  const release = () => {
    if (held) moved(held[0]);
    held = null;
  };
  view.canvas.addEventListener("pointerup", release);
  view.canvas.addEventListener("pointercancel", release);
  view.canvas.addEventListener("keydown", event => {
    const all = items(state.config), { chosen } = view;
    const index = chosen ? all.findIndex(([list, at]) => list === chosen[0] && at === chosen[1]) : -1;
    const by = ARROWS[event.key];
    if (event.key === "]" || event.key === "[") {
      const next = (index + (event.key === "]" ? 1 : -1) + all.length + (index < 0 && event.key === "[" ? 1 : 0)) % all.length;
      choose(view, [all[next][0], all[next][1]]);
    } else if (by && view.chosen) {
      const [list, at] = view.chosen, [width, height] = state.config.world.map, size = event.shiftKey ? 0.1 : 1;
      const [x, y] = state.config.world[list][at];
      state.config.world[list][at] = [tenth(x + by[0] * size, width), tenth(y + by[1] * size, height)];
      moved(list);
      choose(view, view.chosen);
    } else if (event.key === "Delete" && view.chosen) remove();
    else return;
    event.preventDefault();
    event.stopPropagation();
  });
}

/** @param {List} list */
function moved(list) {
  state.file = null;
  return change([[`world.${list}`, configs.positions(state.config.world[list])]]);
}

/** Adds an agent or a POI. @param {List} list */
export function add(list) {
  const { world } = state.config, [width, height] = world.map, [first] = state.views;
  const taken = items(state.config).map(([, , place]) => place);
  // Search for a free place, on a spiral from the middle of the map.
  let place = [width / 2, height / 2];
  for (let ring = 0; taken.some(([x, y]) => Math.hypot(x - place[0], y - place[1]) < 2) && ring < 200; ring++) {
    place = [width / 2 + 1.5 * Math.sqrt(ring) * Math.cos(2.4 * ring), height / 2 + 1.5 * Math.sqrt(ring) * Math.sin(2.4 * ring)].map(at => Math.round(at * 10) / 10);
  }
  world[list].push(place);
  moved(list);
  choose(first, [list, world[list].length - 1]);
}

export function remove() {
  const [first] = state.views;
  if (!first || !first.chosen) return;
  const [list, index] = first.chosen;
  state.config.world[list].splice(index, 1);
  first.chosen = null;
  moved(list);
  $("chosen").textContent = "";
}
