// What to do with the map: watch, rearrange, or take a leader.
import { show_start } from "./arrange.js";
import { $, all } from "./dom.js";
import { drive_off, drive_view, options } from "./drive.js";
import { state } from "./state.js";
import { ask, build, clear, controls, follow, position, reveal } from "./views.js";

/** @param {"watch" | "arrange" | "drive"} wanted */
export function mode(wanted) {
  if (state.mode === wanted) return;
  drive_off();
  state.mode = wanted;
  for (const button of all("[data-mode]")) button.ariaPressed = String(button.dataset.mode === wanted);
  $("arrange").hidden = wanted !== "arrange";
  $("drive").hidden = wanted !== "drive";
  const { training } = state;
  if (wanted !== "watch" && training && training.state === "training") { training.paused = true; controls(); }
  if (wanted === "arrange") {
    show_start();
  } else if (wanted === "drive") {
    const led = training && training.arms.find(arm => arm.label === "leader-follower" && arm.ended.length);
    if (led) state.policies = { each: 1, weights: led.ended[Math.min(state.trial, led.ended.length - 1)] };
    if (led && led.toml !== state.toml && led.config.world.leaders.length !== state.config.world.leaders.length) state.policies = null;
    options();
    drive_view();
    $("driven").textContent = "";
  } else if (training) {
    const { generation, trial } = state;
    build(training);
    position();
    $("trial").value = String(trial);
    if (training.state === "done" || !state.follow) {
      state.views.forEach((view, run) => ask(view, run, state.follow ? training.last : generation));
    } else follow();
  } else {
    clear();
    show_start();
  }
  reveal();
}
