// @ts-check
// Credit of each leader, and the episode without a leader: the POIs that go dark are its credit.
import { $, count, make, number } from "./dom.js";
import { state } from "./state.js";
import { draw } from "./views.js";

// Most leaders with a column each.
const COLUMNS = 32;

// Shows the credits of the view that is chosen in the list.
export function credits() {
  const shown = state.views.filter(view => view.data && view.data.episodes[0].without && view.data.episodes[0].shown.length > 1);
  $("credit").hidden = shown.length === 0 || state.mode !== "watch";
  if ($("credit").hidden) return;
  const picked = Math.min(Number($("credited").value) || 0, shown.length - 1), view = shown[picked];
  const names = shown.map(view => view.title.textContent);
  if ([...$("credited").options].map(option => option.textContent).join("\n") !== names.join("\n")) {
    $("credited").replaceChildren(...names.map((name, index) => make("option", name, null, { value: String(index) })));
  }
  $("credited").value = String(picked);
  $("credited").parentElement.hidden = shown.length === 1;
  table(view);
}

/** What the table was drawn of. @type {any[] | null} */
let drawn = null;

/** @param {View} view */
function table(view) {
  const { data } = view, [episode] = data.episodes;
  // The table changes with the episode, but not with its steps.
  const key = [view, data, view.removed, view.selected], before = drawn;
  if (before && key.every((part, index) => part === before[index])) return;
  drawn = key;
  const { leaders } = episode, columns = Math.min(leaders, COLUMNS), followers = episode.agents > leaders;
  const rows = [["D", episode.d], ["Df", episode.df], ["D++", episode.dpp], ["Dt", episode.dt]].filter(([, values]) => values && values.length);
  const body = make("table"), head = make("tr", "", make("thead", "", body));
  const focused = document.activeElement && /** @type {HTMLElement} */ (document.activeElement).dataset.credit;
  make("th", "Leader", head, { scope: "col" });
  for (let leader = 0; leader < columns; leader++) {
    const cell = make("th", "", head, { scope: "col" }), colors = stage.palette(data);
    const button = make("button", String(leader), cell, { type: "button", title: "Show what it senses" });
    button.setAttribute("aria-label", `Leader ${leader}: show what it senses`);
    button.setAttribute("aria-pressed", String(view.selected === leader));
    button.dataset.credit = `sense ${leader}`;
    button.style.borderBottom = `4px solid ${colors[leader % colors.length]}`;
    button.addEventListener("click", () => select(view, leader));
  }
  const places = make("tbody", "", body);
  for (const [name, values] of rows) {
    const row = make("tr", "", places, { className: name === data.fitness ? "selects" : "" });
    make("th", name === data.fitness ? `${name} (selects)` : name, row, { scope: "row" });
    for (let leader = 0; leader < columns; leader++) make("td", number(values[leader]), row);
  }
  for (const group of followers ? [false, true] : [false]) {
    const row = make("tr", "", places);
    make("th", group ? "Remove it and its followers" : "Remove it", row, { scope: "row" });
    for (let leader = 0; leader < columns; leader++) {
      const is = view.removed && view.removed.leader === leader && view.removed.group === group;
      const button = make("button", is ? "Put back" : "Remove", make("td", "", row), { type: "button" });
      button.setAttribute("aria-label", `${is ? "Put back" : "Remove"} leader ${leader}${group ? " and its followers" : ""}`);
      button.setAttribute("aria-pressed", String(Boolean(is)));
      button.dataset.credit = `${group} ${leader}`;
      button.addEventListener("click", () => remove_leader(view, is ? null : { leader, group }));
    }
  }
  $("credits").replaceChildren(body);
  if (leaders > columns) make("p", `and ${count(leaders - columns, "more leader")}`, $("credits"));
  if (focused) [...$("credits").querySelectorAll("button")].find(button => button.dataset.credit === focused)?.focus();
  $("lost").textContent = lost(view);
}

/** Removes a leader from a view's episode, or puts it back. @param {View} view @param {View["removed"]} removed */
export function remove_leader(view, removed) {
  view.removed = removed;
  draw(view);
  credits();
}

/** Selects the leader whose senses are shown. Selecting it again ends that. @param {View} view @param {number} leader */
export function select(view, leader) {
  view.selected = view.selected === leader ? null : leader;
  draw(view);
  credits();
}

/** Returns the POIs that only the removed agents' presence observed. @param {View} view */
export function dark(view) {
  if (!view.removed) return [];
  const [episode] = view.data.episodes, without = episode.without[view.removed.leader][view.removed.group ? "group" : "alone"];
  return episode.observed.flatMap((/** @type {number | null} */ at, /** @type {number} */ poi) => at !== null && without.observed[poi] === null ? [poi] : []);
}

/** Says what the removal costs. @param {View} view */
function lost(view) {
  if (!view.removed) return "Remove a leader: the POIs that go dark are its credit. D counts it alone, Df with the followers that it led.";
  const { leader, group } = view.removed, gone = dark(view), pois = view.data.pois.length;
  const who = `Without leader ${leader}${group ? " and its followers" : ""}`;
  const which = gone.length ? `POI${gone.length > 1 ? "s" : ""} ${gone.join(", ")} ${gone.length > 1 ? "go" : "goes"} dark` : "no POI goes dark";
  return `${who}, ${which}: its ${group ? view.data.fitness === "Dt" ? "Dt" : "Df" : "D"} is ${gone.length} of ${pois}, ${number(gone.length / pois)}.`;
}
