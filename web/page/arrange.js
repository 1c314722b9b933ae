// Rearranging the map by pointer and keys.
import { configs } from "./config.js";
import { $, count, make, number, write_text } from "./dom.js";
import { change } from "./experiment.js";
import { start_scene } from "./scene.js";
import { part, render, state } from "./state.js";
import { aim, draw, only_view, show } from "./views.js";

/** The view of the start. @type {View | null} */
let start_view = null;
export function show_start() {
  const { config, views } = state;
  if (!start_view || !views.includes(start_view)) {
    start_view = only_view("Where everyone starts", stage.busy(start_scene(config)));
    start_view.describe = describe_start;
  }
  const { chosen } = start_view;
  if (chosen && !items().some(([list, index]) => list === chosen[0] && index === chosen[1])) start_view.chosen = null;
  aim(start_view, state.mode === "arrange" ? [0, 0, ...config.world.map] : stage.busy(start_scene(config)));
  if (state.mode === "arrange") hands(start_view);
  show(start_view, start_scene(config), false);
}

/** @returns {[string, string]} */
function describe_start() {
  const { world } = state.config, chosen = start_view && start_view.chosen && name_chosen(start_view.chosen);
  const who = groups().filter(({ list, size }) => list !== "pois" && size > 0).map(({ name, table, size }) => table === "world" ? count(size, name) : `${size} × ${name}`);
  $("remove").disabled = !chosen;
  write_text($("chosen"), chosen ? `Chosen: ${chosen}` : "Nothing is chosen.");
  const status = `${who.join(", ")}, ${count(world.pois.length, "POI")} · ${world.steps} steps`;
  return [status, `Map of the start: ${status}${chosen ? `; chosen: ${chosen}` : ""}`];
}

/**
 * Returns what lies on the map: leaders, followers and POIs, or classes of agents and groups of POIs. `table` is the config's table with
 * their `places` as its key `key`. They are entries `from` to `end` of a list of the world. Groups that start in a region, or of which
 * only some are drawn, are `fixed`: they have no places that could be changed.
 */
function groups() {
  const { world, agents = [], pois = [] } = state.config, { start } = state, end = { leaders: 0, followers: 0, pois: 0 };
  const short = (/** @type {List} */ list, /** @type {string} */ name) => ({
    list, name, table: "world", key: /** @type {string} */ (list), places: world[list], fixed: false, count: world[list].length, size: world[list].length,
    own: /** @type {Group | Config["world"]} */ (world),
  });
  const full = (/** @type {"agents" | "pois"} */ table, /** @type {Group} */ own, /** @type {number} */ index, /** @type {{ count: number, size?: number } | undefined} */ { count, size = count } = { count: 0 }) => {
    // Places may have changed since the module resolved them. The rest cannot change here.
    const at = size === count ? own.at : undefined;
    return {
      list: /** @type {List} */ (table === "pois" ? "pois" : /^(policy|choose)/.test(own.control ?? "") ? "leaders" : "followers"), name: table === "pois" ? `POI (${own.name})` : own.name,
      table: `${table}.${index}`, key: "at", places: at ?? [], fixed: !at, count: at?.length ?? count, size: at?.length ?? size,
      own: /** @type {Group | Config["world"]} */ (own),
    };
  };
  const all = [
    ...agents.length ? agents.map((own, index) => full("agents", own, index, start.classes?.[index])) : [short("leaders", "leader"), short("followers", "follower")],
    ...pois.length ? pois.map((own, index) => full("pois", own, index, start.groups?.[index])) : [short("pois", "POI")],
  ];
  return all.map(group => ({ ...group, from: end[group.list], end: end[group.list] += group.count }));
}
/** @typedef {ReturnType<typeof groups>[0]} Placed */

/** Returns the group of what is chosen. @param {Chosen} chosen */
const group_of = ([list, index]) => /** @type {Placed} */ (groups().find(group => group.list === list && index < group.end));
const name_chosen = (/** @type {Chosen} */ chosen) => `${group_of(chosen).name} ${chosen[1]} at ${state.config.world[chosen[0]][chosen[1]].map(number).join(", ")}`;

/** Returns everything on the map: its list, its index and its place. @returns {[List, number, Place][]} */
const items = () => groups().flatMap(({ list, from, places }) => places.map((place, index) => /** @type {[List, number, Place]} */ ([list, from + index, place])));

const movable = () => groups().filter(({ fixed }) => !fixed);
part(() => [movable().map(({ name }) => name).join()], () => {
  $("adds").replaceChildren(...movable().map(({ name, table, key }) => {
    const button = make("button", `Add a ${name}`, null, { type: "button" });
    button.dataset.add = key === "at" ? table : key;
    button.addEventListener("click", () => add(table, key));
    return button;
  }));
});

/** @param {View} view @param {Chosen | null} chosen */
function choose(view, chosen) {
  view.chosen = chosen;
  draw(view);
}

/** Shows other places of a group before the module has resolved them. @param {Placed} group @param {Place[]} places */
function put({ list, table, from, end, own }, places) {
  const { config } = state, { world } = config, [name, index] = table.split(".");
  const full = name === "world" ? {} : { [name]: config[/** @type {"agents" | "pois"} */ (name)]?.with(Number(index), { .../** @type {Group} */ (own), at: places }) };
  render({ config: { ...config, ...full, world: { ...world, [list]: world[list].toSpliced(from, end - from, ...places) } } });
}

/** Moves what is chosen. @param {Chosen} chosen @param {Place} place */
function move([list, index], place) {
  const group = group_of([list, index]);
  put(group, group.places.with(index - group.from, place));
}

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
    const near = items().sort((a, b) => away(a) - away(b))[0];
    if (!near || away(near) > Math.max(18 / scale, state.config.world.observation_radius * 0.6)) return choose(view, null);
    held = [near[0], near[1]];
    choose(view, held);
    view.canvas.setPointerCapture(event.pointerId);
    view.canvas.focus();
  });
  view.canvas.addEventListener("pointermove", event => {
    if (!held) return;
    move(held, place(event));
  });
  const release = () => {
    if (held) moved(group_of(held));
    held = null;
  };
  view.canvas.addEventListener("pointerup", release);
  view.canvas.addEventListener("pointercancel", release);
  view.canvas.addEventListener("keydown", event => {
    const all = items(), { chosen } = view;
    const index = chosen ? all.findIndex(([list, at]) => list === chosen[0] && at === chosen[1]) : -1;
    const by = ARROWS[event.key];
    if (event.key === "]" || event.key === "[") {
      const next = (index + (event.key === "]" ? 1 : -1) + all.length + (index < 0 && event.key === "[" ? 1 : 0)) % all.length;
      choose(view, [all[next][0], all[next][1]]);
    } else if (by && view.chosen) {
      const [list, at] = view.chosen, [width, height] = state.config.world.map, size = event.shiftKey ? 0.1 : 1;
      const [x, y] = state.config.world[list][at];
      move(view.chosen, [tenth(x + by[0] * size, width), tenth(y + by[1] * size, height)]);
      moved(group_of(view.chosen));
    } else if (event.key === "Delete" && view.chosen) remove();
    else return;
    event.preventDefault();
    event.stopPropagation();
  });
}

/**
 * What is put onto the map (`by` 1) or taken off it (`by` -1): its group as before, and its index in it.
 * @typedef {{ group: Placed, at: number, by: 1 | -1 }} Fit
 */

/** Returns a list with a value more, or without one, at an index. @param {unknown[]} list @param {number} at @param {1 | -1} by @param {unknown} value */
const fitted = (list, at, by, value) => by > 0 ? list.toSpliced(at, 0, value) : list.toSpliced(at, 1);
/** Returns lists of indices that refer to the same things as before. @param {number[][]} lists @param {number} at @param {1 | -1} by */
const renumbered = (lists, at, by) => lists.map(list => list.filter(index => by > 0 || index !== at).map(index => index >= at ? index + by : index));

/**
 * Returns the new values of the keys that have a value per place or refer to places by their numbers.
 * @param {Fit} fit @returns {[string, unknown[]][]}
 */
function fitted_keys({ group: { list, table, own, places }, at, by }) {
  const { world, credit: { removes = [] } = {}, learning: { paradigm } } = state.config, is_poi = list === "pois", whole = table === "world", all = groups();
  const each = is_poi ? ["coupling", "windows"] : whole ? [] : ["heading"];
  /** @type {[string, unknown[]][]} */
  const keys = Object.entries(own).filter(([key, value]) => each.includes(key) && Array.isArray(value) && value.length === places.length)
    .map(([key, value]) => [`${table}.${key}`, fitted(value, at, by, value.at(-1))]);
  if (is_poi) return whole && world.after.length ? [...keys, ["world.after", fitted(renumbered(world.after, at, by), at, by, [])]] : keys;
  // Agents that learn have the first numbers.
  const ordered = ["leaders", "followers"].flatMap(of => all.filter(group => group.list === of));
  const before = ordered.slice(0, ordered.findIndex(group => group.table === table && group.list === list));
  const agent = at + before.reduce((sum, { size }) => sum + size, 0), { heading } = world;
  // There may be a heading for each leader only.
  if (whole && Array.isArray(heading) && agent < heading.length + (by > 0 ? 1 : 0)) keys.push(["world.heading", fitted(heading, agent, by, heading[agent - 1])]);
  if (removes.length) {
    const others = renumbered(removes, agent, by), learns = list === "leaders" || paradigm === "all-leaders";
    keys.push(["credit.removes", learns && removes.length > 1 ? fitted(others, agent, by, [agent]) : others]);
  }
  return keys;
}

/** Writes the places of a group into the config. @param {Placed} group @param {Fit} [fit] */
function moved({ table, key, places }, fit) {
  state.file = null;
  const keys = fit ? fitted_keys(fit) : [];
  return change([[`${table}.${key}`, configs.positions(places)], ...keys.map(([key, value]) => /** @type {[string, string]} */ ([key, JSON.stringify(value)]))]);
}

/** Adds an agent or a POI to a group. @param {string} table @param {string} key */
function add(table, key) {
  const { world } = state.config, [width, height] = world.map, [first] = state.views;
  const taken = items().map(([, , place]) => place);
  // Search for a free place, on a spiral from the middle of the map.
  /** @type {Place} */
  let place = [width / 2, height / 2];
  for (let ring = 0; taken.some(([x, y]) => Math.hypot(x - place[0], y - place[1]) < 2) && ring < 200; ring++) {
    const away = 1.5 * Math.sqrt(ring), angle = 2.4 * ring;
    place = [tenth(width / 2 + away * Math.cos(angle), width), tenth(height / 2 + away * Math.sin(angle), height)];
  }
  const find = () => /** @type {Placed} */ (groups().find(group => group.table === table && group.key === key)), group = find();
  put(group, [...group.places, place]);
  choose(first, [group.list, group.end]);
  moved(find(), { group, at: group.places.length, by: 1 });
}

export function remove() {
  const [first] = state.views;
  if (!first || !first.chosen) return;
  const group = group_of(first.chosen), index = first.chosen[1] - group.from;
  first.chosen = null;
  put(group, group.places.toSpliced(index, 1));
  const find = /** @type {Placed} */ (groups().find(({ table, key }) => table === group.table && key === group.key));
  moved(find, { group, at: index, by: -1 });
  // The button that had the focus is now disabled.
  first.canvas.focus({ preventScroll: true });
}
