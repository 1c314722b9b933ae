// The guided start: one sentence and one button per step. Until it ends, the map is above the settings.
import { remove_leader } from "./credit.js";
import { $ } from "./dom.js";
import { exhibit } from "./gallery.js";
import { shown, state } from "./state.js";
import { train } from "./train.js";
import { replay } from "./views.js";

/** Returns the view in which leaders can be removed. */
const removable = () => shown().find(({ data }) => data.episodes[0].without);
/** Returns the leader with the largest Df, and what the team loses without it. @param {Episode} episode */
function dearest({ df = [], observed }) {
  const most = Math.max(...df);
  return { leader: df.indexOf(most), lost: Math.round(most * observed.length), pois: observed.length };
}

/** @type {{ says: () => string, button: string, act: () => Promise<void> | void }[]} */
const STEPS = [
  {
    says: () => "This team was trained: its four leaders (filled arrows) learned where to go, and eight followers (hollow arrows) follow them. A point of interest (POI, a circle) is observed once six agents are inside it at the same time, so groups have to meet.",
    button: "What is one leader worth?",
    act() {
      const view = removable();
      if (!view) return;
      remove_leader(view, { leader: dearest(view.data.episodes[0]).leader, group: true });
      if (!view.playing) replay();
    },
  },
  {
    says() {
      const view = removable(), { leader, lost, pois } = view ? dearest(view.data.episodes[0]) : { leader: 0, lost: 0, pois: 1 };
      return `Leader ${leader} and its followers (pale) no longer count, and ${lost} of ${pois} POIs are lost (dark). This loss, ${lost / pois}, is the leader's Df. Training with Df keeps the leaders without which the team would lose most.`;
    },
    button: "Train such teams",
    act() {
      const view = removable();
      if (view) remove_leader(view, null);
      return train();
    },
  },
  {
    says: () => "Two kinds of team learn this task from nothing: leaders with followers, and teams in which all twelve agents learn. The chart shows how many POIs their best teams observe, generation by generation.",
    button: "What does a larger population change?",
    act: () => exhibit("population", { trains: true }),
  },
  {
    says: () => "The same task, with followers. This time each leader's policy is chosen from a population of 20, 100 or 500 policies. Compare the three lines of the chart.",
    button: "Done",
    act() {},
  },
];

let at = 0;

/** Shows a step, or its result once there is one. */
function show_step(result = "") {
  const goes_on = at < STEPS.length;
  $("guide").hidden = !goes_on;
  $(goes_on ? "credit" : "guide").after($("setup"));
  if (!goes_on) return;
  $("guide-step").textContent = `${at + 1} of ${STEPS.length}`;
  $("guide-says").textContent = result || STEPS[at].says();
  $("guide-next").textContent = STEPS[at].button;
  $("guide-end").hidden = at === STEPS.length - 1;
}

export function guide() {
  show_step();
  $("guide-next").addEventListener("click", async () => {
    const { act } = STEPS[at];
    at += 1;
    const now = at, trained = act();
    show_step();
    if (!trained) return;
    // A step that trains ends with the result.
    await trained;
    if (at === now && state.training && state.training.state === "done") show_step($("announced").textContent ?? "");
  });
  $("guide-end").addEventListener("click", leave_guide);
}

// Ends the guided start.
export function leave_guide() {
  at = STEPS.length;
  show_step();
}
