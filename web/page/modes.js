// What to do with the map: watch, rearrange, or take a leader.
import { show_start } from "./arrange.js";
import { $, all } from "./dom.js";
import { drive_off, drive_view } from "./drive.js";
import { join } from "./scene.js";
import { part, render, state } from "./state.js";
import { add_view, aim, ask_all, build, clear, follow, reveal, shape_of, show } from "./views.js";

part(() => [state.mode], () => {
  for (const button of all("[data-mode]")) button.ariaPressed = String(button.dataset.mode === state.mode);
  $("arrange").hidden = state.mode !== "arrange";
  $("drive").hidden = state.mode !== "drive";
});

/** Returns what the maps show: a training, an episode, or the start of the experiment. */
const subject = () => state.mode === "watch" && (state.training || state.exhibit) || state.config;

part(() => [state.mode, subject()], () => {
  const { mode, training, exhibit } = state;
  drive_off();
  if (mode === "drive") drive_view();
  else if (mode === "watch" && training) {
    build(training);
    if (state.follow) follow(); else ask_all();
  } else if (mode === "watch" && exhibit) {
    clear();
    const crop = exhibit.scenes.map(({ data }) => stage.busy(data)).reduce(join), shape = exhibit.scenes.length > 1 ? shape_of(crop) : undefined;
    for (const { title, status, label, ghosts = [] } of exhibit.scenes) {
      const view = add_view(title, crop);
      view.describe = (step, observed, text) => [status(step, observed), `${label}, step ${step}: ${text}`];
      view.ghosts = ghosts;
      aim(view, crop, shape);
    }
    // Their sizes depend on how many they are.
    exhibit.scenes.forEach(({ data }, index) => show(state.views[index], data));
  } else show_start();
});

/** @param {State["mode"]} mode */
export function mode(mode) {
  if (state.mode === mode) return;
  const { training } = state;
  if (mode !== "watch" && training) training.paused = true;
  // A leader is taken in a leader-follower team: that of the present settings, if it is trained.
  const teams = mode === "drive" && training ? training.arms.filter(({ config, ended }) => ended.length && config.learning.paradigm !== "all-leaders") : [];
  const led = teams.find(({ toml }) => toml === state.toml) ?? teams[0];
  if (led) state.policies = { each: 1, weights: led.ended[Math.min(state.trial, led.ended.length - 1)], of: led.label };
  if (led && led.toml !== state.toml && led.config.world.leaders.length !== state.config.world.leaders.length) state.policies = null;
  render({ mode });
  reveal();
}
