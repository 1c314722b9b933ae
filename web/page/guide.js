// The guided start: each step asks for a prediction, shows what happens, and says why. Until it ends, the map is above the settings.
import { remove_leader } from "./credit.js";
import { $, all, failure, make, number, still } from "./dom.js";
import { evolution, evolution_starts } from "./evolution.js";
import { exhibit, is_of } from "./gallery.js";
import { mode } from "./modes.js";
import { OPENED } from "./opening.js";
import { part, render, shown, state, trouble } from "./state.js";
import { forget, found_by } from "./train.js";
import { replay } from "./views.js";

/** The leader of the opening with the largest Df, and what the team loses without it. */
const dearest = (() => {
  const [{ data: { episodes: [{ df = [], observed }] } }] = OPENED.scenes, most = Math.max(...df);
  return { df, leader: df.indexOf(most), lost: Math.round(most * observed.length), pois: observed.length };
})();

/**
 * A step: `of` names the exhibit that `watch` shows, once `ready` has made it, and `meanwhile` until then. A step without `watch` trains the
 * experiment `of` of the gallery. `right` is the index of the choice that comes true.
 * @typedef {{ of: string, asks: string, choices: string[], right: number, ready?: () => Promise<unknown>, meanwhile?: () => Exhibit, watch?: (answered: boolean) => unknown, why: string }} Step
 * @type {Step[]}
 */
const STEPS = [
  {
    of: "opening", watch: answered => show_opening(answered ? { leader: dearest.leader, group: true } : null),
    asks: `This team was trained. Its four leaders (filled arrows) learned where to go. The eight followers (hollow arrows) never learn: each goes after its leader. A point of interest (POI, circle) is observed, and stays green, once six agents are inside at the same time, so groups have to meet. How many of the four POIs are still observed without leader ${dearest.leader} and its followers?`,
    choices: ["One", "Two", "Three"], right: dearest.pois - dearest.lost - 1,
    why: `Leader ${dearest.leader} and its followers (pale) no longer count, and ${dearest.lost} of ${dearest.pois} POIs are lost (red). This loss, ${dearest.lost / dearest.pois}, is the leader's Df. The Df of the four leaders are ${dearest.df.map(number).join(", ")}: one score of the team, but different credits. Training with Df keeps those policies of each leader without which its team would lose most.`,
  },
  {
    of: "two_groups",
    asks: "Now two kinds of team start from nothing: leaders with followers, and teams in which all twelve agents learn. Each learner has a population: many candidate policies, of which selection keeps the best. The team of the best policies is the champion. Whose champions observe more POIs?",
    choices: ["Leader-follower", "All-leaders", "Both alike"], right: 0,
    why: "Six independent learners almost never coincide. If each were at a POI in 3 of 10 episodes, all six would be there in 7 of 10 000. All teams then score 0, and there is nothing to select. Two leaders that bring their followers would coincide in 9 of 100.",
  },
  {
    of: "population",
    asks: "The same task, with followers. How many policies must each leader's population have until champions observe three of the four POIs, on average over trials at the last generation?",
    choices: ["20 are enough", "100", "500"], right: 2,
    why: "The first policies are random. Among many, some leaders meet, and selection has something to copy and change. With 20, training ends below mere luck: the best of as many random teams (dash-dotted). Four trials are too few to tell 100 from 500.",
  },
  {
    of: "evolution", ready: evolution, meanwhile: evolution_starts, watch: async () => show_exhibit(await evolution()),
    asks: "Selection changes whole populations. The 50 policies of each leader start at random. Where do they go after 60 generations?",
    choices: ["Everywhere", "Most the same way"], right: 1,
    why: "Each faint line is the way of one policy, in the colour of its leader. At first most circle near their start. Selection keeps the few that meet, and their changed copies fill the populations. By generation 15, all policies of leaders 0 and 1 (blue, orange) go to the second POI. By generation 60, most policies of every leader reach the third.",
  },
  {
    of: "groups",
    asks: "Do followers make the difference? Take them away: all twelve agents learn, from a population for each (twelve), from one for the three agents of a group (four), or from one for all. How many POIs do the champions of four populations observe?",
    choices: ["Nothing", "Two or three", "All four"], right: 1,
    why: "With followers it was 3.00. With twelve populations, six learners have to coincide again. A group starts side by side, and with one policy (one colour) it goes much the same way, as followers do. So shared policies do most of what followers do. In 30 trials of another layout it was 0.7 with twelve, 3.1 with four, 3.6 with followers. Four trials cannot rank four and one.",
  },
];

/** Returns a choice within a sentence. @param {string} choice */
const small = choice => choice[0].toLowerCase() + choice.slice(1);

/** Shows an exhibit instead of a training. @param {Exhibit} exhibit */
function show_exhibit(exhibit) {
  if (state.exhibit?.name !== exhibit.name) forget();
  render({ mode: "watch", exhibit });
}

/** Shows the opening, without a leader if given. @param {Removed | null} removed */
function show_opening(removed) {
  show_exhibit(OPENED);
  const [view] = shown();
  remove_leader(view, removed);
  if (!view.playing && !still.matches) replay();
}

/** Returns whether the page shows an exhibit or an experiment. @param {string} name */
const is_shown = name => state.mode === "watch" && (state.exhibit ? state.exhibit.name === name : is_of(name));
/** Returns the step that a question or an answer is about. @param {Guide} at */
const about = ({ step, said }) => STEPS[said === null ? Math.max(0, step - 1) : step];
/** Shows what a question or an answer is about. Only the first question is about what its own step shows. @param {Guide} at */
function show_step(at) {
  const { of, watch } = about(at), answered = at.step > 0 || at.said !== null;
  return watch ? watch(answered) : exhibit(of, { trains: true });
}

/**
 * Returns what the guide says of a prediction and, if it is too early for the answer, what it says once that is known.
 * @param {Guide & { said: string }} at
 */
function answers({ step, said, waits }) {
  const { choices, right, why, watch } = STEPS[step], { training } = state, ended = training && ["done", "stopped"].includes(training.state);
  const says = (/** @type {string} */ text) => `You said: ${small(said)}. ${text}`, answer = said === choices[right] ? "That is right." : `It is: ${small(choices[right])}.`;
  const whole = (/** @type {string | null} */ result) => says([answer, result, why].filter(Boolean).join(" "));
  if (waits) return [says("The populations are being trained…"), whole("")];
  if (!watch && !ended) return [says("Watch the map and the chart."), whole(training && `Training is finished. ${found_by(training)}`)];
  return [whole(training && $("announced").textContent), ""];
}

part(() => [state.guide, state.mode, state.exhibit, state.text, state.compared, state.training, state.training && state.training.state, $("announced").textContent], () => {
  const { guide } = state;
  $("guide").hidden = guide === null;
  $(guide === null ? "guide" : "credit").after($("setup"));
  if (!guide) return void (state.told = null);
  const { step, said, waits = false } = guide, { asks, choices } = STEPS[step], here = is_shown(about(guide).of), last = step === STEPS.length - 1;
  const [says, later] = !here ? ["What is on show is not part of the guide.", ""] : said === null ? [step ? `${asks} (Below is still the previous step.)` : asks, ""] : answers({ ...guide, said });
  if (here && !waits) state.told = guide;
  $("guide-step").textContent = `${step + 1} of ${STEPS.length}`;
  $("guide-says").textContent = says;
  $("guide-text").dataset.later = later && `${step + 1} of ${STEPS.length} ${later}`;
  const asked = here && said === null;
  $("guide-choices").replaceChildren(...(asked ? choices : []).map(choice => {
    const button = make("button", choice, null, { type: "button" });
    button.addEventListener("click", () => enter({ step, said: choice }));
    return button;
  }));
  $("guide-next").hidden = asked;
  $("guide-next").disabled = here && waits;
  $("guide-next").classList.toggle("main", !later);
  $("guide-next").textContent = !here ? "Back to the guide" : last ? "Done" : "Next";
  $("guide-end").hidden = here && last && !asked;
});

/** Shows a step, and what it is about. @param {Guide} at */
async function enter({ step, said }) {
  const had_focus = $("guide").contains(document.activeElement), guide = { step, said }, made = STEPS[step].ready?.();
  made?.catch(() => {});
  if (made && said !== null) {
    const waiting = { ...guide, waits: true }, { meanwhile } = STEPS[step];
    state.guide = waiting;
    if (meanwhile && !is_shown(about(waiting).of)) show_exhibit(meanwhile());
    render();
    try { await made; } catch (thrown) {
      trouble("run", failure(thrown).message);
      return render({ guide: state.guide && { step, said: null } });
    }
    // The visitor may have left the guide, or chosen something else to show.
    if (!is_shown(about(waiting).of)) return state.guide === waiting ? render({ guide }) : undefined;
    if (state.guide !== waiting) return show_step(waiting);
  }
  state.guide = guide;
  const watched = said !== null || !is_shown(about(guide).of) ? show_step(guide) : null;
  render();
  if (had_focus) ($("guide-next").hidden ? all("button", $("guide-choices"))[0] : $("guide-next")).focus({ preventScroll: true });
  await watched;
  render();
}

export function guide() {
  render({ guide: { step: 0, said: null } });
  $("guide-next").addEventListener("click", () => {
    const { guide } = state;
    if (!guide) return;
    const back = state.mode !== "watch";
    if (back) mode("watch");
    if (!is_shown(about(guide).of)) return enter(guide);
    if (back) return;
    if (guide.step + 1 === STEPS.length) return leave_guide();
    enter({ step: guide.step + 1, said: null });
  });
  $("guide-end").addEventListener("click", leave_guide);
}

// Ends the guided start.
export function leave_guide() {
  const had_focus = $("guide").contains(document.activeElement);
  render({ guide: null });
  if (had_focus) $("train").focus();
}
