// @ts-check
// The guided start: one sentence and one button per step.
import { remove_leader } from "./credit.js";
import { $ } from "./dom.js";
import { exhibit } from "./gallery.js";
import { shown } from "./state.js";
import { train } from "./train.js";
import { replay } from "./views.js";

const best = () => shown().find(({ data }) => data.episodes[0].without);
const STEPS = [
  {
    says: "These twelve agents are a trained team: four leaders learned, eight followers follow. A point of interest (POI) counts once six agents are near it at the same time, so groups have to meet.",
    button: "Whose credit is it?",
    act() {
      const view = best();
      if (!view) return;
      const { df = [] } = view.data.episodes[0];
      remove_leader(view, { leader: df.indexOf(Math.max(...df)), group: true });
      if (!view.playing) replay();
    },
  },
  {
    says: "Now one leader is gone, with the followers that it led. The POIs that go dark are its Df: Df rewards a leader for what the team loses without it and its followers.",
    button: "Train such teams",
    act() {
      const view = best();
      if (view) remove_leader(view, null);
      train();
    },
  },
  {
    says: "Two kinds of team learn side by side: leaders with followers, and teams in which all twelve agents learn. Dotted lines are what a constant action and random teams observe, without any learning.",
    button: "What does a larger population change?",
    act() { exhibit("population", { trains: true }); },
  },
  {
    says: "The same task with 50, 500 and 2500 policies per agent, all of which learn: a larger population finds what a small one misses. Choose another experiment below, or change anything.",
    button: "Done",
    act() {},
  },
];

let at = 0;

function show_step() {
  $("guide").hidden = at >= STEPS.length;
  if ($("guide").hidden) return;
  $("guide-step").textContent = `${at + 1} of ${STEPS.length}`;
  $("guide-says").textContent = STEPS[at].says;
  $("guide-next").textContent = STEPS[at].button;
}

export function guide() {
  show_step();
  $("guide-next").addEventListener("click", () => {
    const step = STEPS[at];
    at += 1;
    show_step();
    step.act();
  });
  $("guide-end").addEventListener("click", leave_guide);
}

// Ends the guided start.
export function leave_guide() {
  at = STEPS.length;
  show_step();
}
