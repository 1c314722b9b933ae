// Credit of each leader, and the episode without a leader: the POIs that are lost are its credit.
import { $, all, count, make, number } from "./dom.js";
import { name_of_leader } from "./senses.js";
import { part, render, shown, state } from "./state.js";
import { draw, lost_pois, reveal, select } from "./views.js";

// Most leaders in the table.
const SHOWN = 32;
const narrow = matchMedia("(max-width: 640px)");
narrow.addEventListener("change", () => render());

// The table changes with the episodes, but not with their steps.
part(() => [state.mode, state.exhibit, narrow.matches, $("credited").value, ...shown().flatMap(view => [view, view.data, view.removed, view.selected])], credits);

// Shows the credits of the view that is chosen in the list.
function credits() {
  // What is being made will have a table, too. Its place is kept.
  const pending = Boolean(state.exhibit?.pending) && state.mode === "watch";
  $("credit").style.visibility = pending ? "hidden" : "";
  if (pending) return void ($("credit").hidden = false);
  const views = shown().filter(({ data: { episodes: [episode] } }) => episode.without && episode.shown.length > 1);
  $("credit").hidden = views.length === 0 || state.mode !== "watch";
  if ($("credit").hidden) return;
  const picked = Math.min(Number($("credited").value) || 0, views.length - 1), view = views[picked];
  const names = views.map(view => view.title.textContent);
  if ([...$("credited").options].map(option => option.textContent).join("\n") !== names.join("\n")) {
    $("credited").replaceChildren(...names.map((name, index) => new Option(name ?? "", String(index))));
  }
  $("credited").value = String(picked);
  $("team").hidden = views.length === 1;
  table(view);
}

/** @param {Shown} view */
function table(view) {
  const { data } = view, [episode] = data.episodes;
  const leaders = Array.from({ length: Math.min(episode.leaders, SHOWN) }, (_, leader) => leader);
  const scores = Object.entries({ D: episode.d, Df: episode.df, "D++": episode.dpp, Dt: episode.dt }).flatMap(([name, values]) => values && values.length ? [{ name, values }] : []);
  /** A list per measure and action: its name, and then a cell per leader. @type {(string | HTMLElement)[][]} */
  const lists = [
    ["Leader", ...leaders.map(leader => sense_button(view, leader))],
    ...scores.map(({ name, values }) => [name === data.fitness ? `${name} (fitness)` : name, ...leaders.map(leader => number(values[leader]))]),
    ["Remove it", ...leaders.map(leader => remove_button(view, { leader, group: false }))],
  ];
  if (episode.agents > episode.leaders) lists.push(["Remove it and its followers", ...leaders.map(leader => remove_button(view, { leader, group: true }))]);
  const selects = 1 + scores.findIndex(({ name }) => name === data.fitness);
  const focused = document.activeElement instanceof HTMLElement && document.activeElement.dataset.credit;
  const body = make("table"), head = make("thead", "", body), rest = make("tbody", "", body);
  // Each list is a row. In a narrow window or with many leaders it is a column.
  const turned = narrow.matches || leaders.length > 8, [high, wide] = turned ? [leaders.length + 1, lists.length] : [lists.length, leaders.length + 1];
  for (let row = 0; row < high; row++) {
    const line = make("tr", "", row === 0 ? head : rest);
    for (let column = 0; column < wide; column++) {
      const [list, place] = turned ? [column, row] : [row, column];
      const cell = make(row === 0 || column === 0 ? "th" : "td", "", line, { className: list > 0 && list === selects ? "selects" : "" });
      if (row === 0 || column === 0) cell.scope = row === 0 ? "col" : "row";
      cell.append(lists[list][place]);
    }
  }
  $("credits").replaceChildren(body);
  if (episode.leaders > SHOWN) make("p", `and ${count(episode.leaders - SHOWN, "more leader")}`, $("credits"));
  if (focused) all("button", $("credits")).find(button => button.dataset.credit === focused)?.focus();
  $("lost").textContent = lost(view);
}

/** Makes the button that shows what a leader senses. @param {Shown} view @param {number} leader */
function sense_button(view, leader) {
  const name = name_of_leader(view.data, leader);
  const button = make("button", view.data.classes ? name : String(leader), null, { type: "button", title: "Show what it senses" });
  button.setAttribute("aria-label", `${name}: show what it senses`);
  button.setAttribute("aria-pressed", String(view.selected === leader));
  button.dataset.credit = `sense ${leader}`;
  button.style.borderBottom = `4px solid ${stage.tint(view.data, leader)}`;
  button.addEventListener("click", () => { select(view, leader); reveal(); });
  return button;
}

/** Makes the button that removes a leader, or puts it back. @param {Shown} view @param {Removed} removal */
function remove_button(view, { leader, group }) {
  const is = view.removed && view.removed.leader === leader && view.removed.group === group;
  const button = make("button", is ? "Put back" : "Remove", null, { type: "button" });
  button.setAttribute("aria-label", `${is ? "Put back" : "Remove"} ${name_of_leader(view.data, leader)}${group ? " and its followers" : ""}`);
  button.setAttribute("aria-pressed", String(Boolean(is)));
  button.dataset.credit = `${group} ${leader}`;
  button.addEventListener("click", () => remove_leader(view, is ? null : { leader, group }));
  return button;
}

/** Removes a leader from a view's episode, or puts it back. @param {View} view @param {Removed | null} removed */
export function remove_leader(view, removed) {
  view.removed = removed;
  draw(view);
  render();
  reveal();
}

/** Says what the removal costs. @param {Shown} view */
function lost(view) {
  if (!view.removed) return "Remove a leader: the POIs that are lost are its credit. D removes the leader alone, Df the leader and its followers.";
  const { leader, group } = view.removed, { data } = view, [episode] = data.episodes, gone = lost_pois(data, view.removed);
  const who = `Without ${name_of_leader(data, leader)}${group ? " and its followers" : ""}`;
  const which = gone.length ? `POI${gone.length > 1 ? "s" : ""} ${gone.join(", ")} ${gone.length > 1 ? "are" : "is"} lost` : "no POI is lost";
  const [name, values] = !group ? ["D", episode.d] : episode.led.length > 0 ? ["Dt", episode.dt] : ["Df", episode.df];
  return `${who}, ${which}: its ${name} is ${number(values ? values[leader] : 0)}.`;
}
