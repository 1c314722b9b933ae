// Rearranging the map by pointer and keys.
import { configs } from "./config.js";
import { $, count, number, write_text } from "./dom.js";
import { change } from "./experiment.js";
import { start_scene } from "./scene.js";
import { render, state } from "./state.js";
import { aim, draw, only_view, show } from "./views.js";

/** The view of the start. @type {View | null} */
let start_view = null;
export function show_start() {
  const { config, views } = state, { world } = config;
  if (!start_view || !views.includes(start_view)) {
    start_view = only_view("Where everyone starts", stage.busy(start_scene(config)));
    start_view.describe = describe_start;
  }
  if (start_view.chosen && !world[start_view.chosen[0]][start_view.chosen[1]]) start_view.chosen = null;
  aim(start_view, state.mode === "arrange" ? [0, 0, ...world.map] : stage.busy(start_scene(config)));
  if (state.mode === "arrange") hands(start_view);
  show(start_view, start_scene(config), false);
}

function describe_start() {
  const { world } = state.config;
  if (!start_view) return;
  write_text($("chosen"), start_view.chosen ? `Chosen: ${name_chosen(start_view.chosen)}` : "");
  start_view.status.textContent = `${count(world.leaders.length, "leader")}, ${count(world.followers.length, "follower")}, ${count(world.pois.length, "POI")} · ${world.steps} steps`;
  start_view.canvas.ariaLabel = `Map of the start: ${start_view.status.textContent}${start_view.chosen ? `; chosen: ${name_chosen(start_view.chosen)}` : ""}`;
}

const KINDS = { leaders: "leader", followers: "follower", pois: "POI" };
const name_chosen = (/** @type {Chosen} */ [list, index]) => `${KINDS[list]} ${index} at ${state.config.world[list][index].map(number).join(", ")}`;

const LISTS = /** @type {List[]} */ (["leaders", "followers", "pois"]);
/** Returns everything on the map: its list, its index and its place. @type {(config: Config) => [List, number, Place][]} */
const items = ({ world }) => LISTS.flatMap(list => world[list].map((place, index) => /** @type {[List, number, Place]} */ ([list, index, place])));

/** @param {View} view @param {Chosen | null} chosen */
function choose(view, chosen) {
  view.chosen = chosen;
  draw(view);
}

/** Shows a list of the world before the module has resolved it. @param {List} list @param {Place[]} places */
const put = (list, places) => render({ config: { ...state.config, world: { ...state.config.world, [list]: places } } });

// Positions are rounded to a tenth, and stay on the map.
const tenth = (/** @type {number} */ value, /** @type {number} */ most) => Math.round(Math.max(0, Math.min(most, value)) * 10) / 10;
/** @type {Record<string, number[]>} */
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

/** Lets the pointer and the keys move agents and POIs. @param {View} view */
function hands(view) {
  if (view.canvas.classList.contains("hands")) return;
  view.canvas.classList.add("hands");
  view.canvas.tabIndex = 0;
  view.canvas.setAttribute("role", "application");
  /** @type {Chosen | null} */
  let held = null;
  /** @type {(event: PointerEvent) => Place} */
  const place = event => {
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
    put(held[0], state.config.world[held[0]].with(held[1], place(event)));
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
      put(list, state.config.world[list].with(at, [tenth(x + by[0] * size, width), tenth(y + by[1] * size, height)]));
      moved(list);
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
  /** @type {Place} */
  let place = [width / 2, height / 2];
  for (let ring = 0; taken.some(([x, y]) => Math.hypot(x - place[0], y - place[1]) < 2) && ring < 200; ring++) {
    const away = 1.5 * Math.sqrt(ring), angle = 2.4 * ring;
    place = [tenth(width / 2 + away * Math.cos(angle), width), tenth(height / 2 + away * Math.sin(angle), height)];
  }
  put(list, [...world[list], place]);
  choose(first, [list, world[list].length]);
  moved(list);
}

export function remove() {
  const [first] = state.views;
  if (!first || !first.chosen) return;
  const [list, index] = first.chosen;
  first.chosen = null;
  put(list, state.config.world[list].toSpliced(index, 1));
  moved(list);
}
