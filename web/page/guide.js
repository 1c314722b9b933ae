// The guided start: one sentence and one button per step. Until it ends, the map is above the settings.
import { remove_leader } from "./credit.js";
import { $, still } from "./dom.js";
import { exhibit, is_of } from "./gallery.js";
import { OPENED } from "./opening.js";
import { part, render, shown, state } from "./state.js";
import { forget } from "./train.js";
import { replay } from "./views.js";

/** Returns the leader with the largest Df, and what the team loses without it. @param {Episode} episode */
function dearest({ df = [], observed }) {
  const most = Math.max(...df);
  return { leader: df.indexOf(most), lost: Math.round(most * observed.length), pois: observed.length };
}

/**
 * A step: `of` is the experiment of the gallery that it is about, or null for the opening. `enter` shows it.
 * @type {{ of: string | null, says: () => string, button: string, enter: () => void }[]}
 */
const STEPS = [
  {
    of: null, enter: () => open(null), button: "What is one leader worth?",
    says: () => "This team was trained: its four leaders (filled arrows) learned where to go, and eight followers (hollow arrows) follow them. A point of interest (POI, a circle) is observed once six agents are inside it at the same time, so groups have to meet.",
  },
  {
    of: null, button: "Train such teams",
    enter: () => open({ leader: dearest(OPENED.data.episodes[0]).leader, group: true }),
    says() {
      const { leader, lost, pois } = dearest(OPENED.data.episodes[0]);
      return `Leader ${leader} and its followers (pale) no longer count, and ${lost} of ${pois} POIs are lost (dark). This loss, ${lost / pois}, is the leader's Df. Training with Df keeps the leaders without which the team would lose most.`;
    },
  },
  {
    of: "two_groups", enter: () => exhibit("two_groups", { trains: true }), button: "What does a larger population change?",
    says: () => "Two kinds of team learn this task from nothing: leaders with followers, and teams in which all twelve agents learn. The chart shows how many POIs their best teams observe, generation by generation.",
  },
  {
    of: "population", enter: () => exhibit("population", { trains: true }), button: "Done",
    says: () => "The same task, with followers. This time each leader's policy is chosen from a population of 20, 100 or 500 policies. Compare the three lines of the chart.",
  },
];

/** Shows the opening, without a leader if given. @param {Removed | null} removed */
function open(removed) {
  if (state.exhibit !== OPENED) forget();
  render({ mode: "watch", exhibit: OPENED });
  const [view] = shown();
  remove_leader(view, removed);
  if (!view.playing && !still.matches) replay();
}

/** Returns whether the page shows what a step is about. @param {string | null} of */
const is_shown = of => state.mode === "watch" && (of === null ? state.exhibit === OPENED : is_of(of));

part(() => [state.guide, state.mode, state.exhibit, state.text, state.compared, state.training, state.training && state.training.state], () => {
  const { guide, training } = state;
  $("guide").hidden = guide === null;
  $(guide === null ? "guide" : "credit").after($("setup"));
  if (guide === null) return;
  const { of, says, button } = STEPS[guide], here = is_shown(of);
  $("guide-step").textContent = `${guide + 1} of ${STEPS.length}`;
  // A step that trains ends with the result.
  const result = training && training.state === "done" ? $("announced").textContent : "";
  $("guide-says").textContent = here ? result || says() : "The guide is about another experiment than the one on show.";
  $("guide-next").textContent = here ? button : "Back to the guide";
  $("guide-end").hidden = here && guide === STEPS.length - 1;
});

export function guide() {
  render({ guide: 0 });
  $("guide-next").addEventListener("click", () => {
    const at = state.guide ?? 0, next = is_shown(STEPS[at].of) ? at + 1 : at;
    if (next === STEPS.length) return leave_guide();
    render({ guide: next });
    STEPS[next].enter();
  });
  $("guide-end").addEventListener("click", leave_guide);
}

// Ends the guided start.
export const leave_guide = () => render({ guide: null });
