// Steering a leader.
import { $, count, failure, make, number } from "./dom.js";
import { edited } from "./experiment.js";
import { clerk } from "./pool.js";
import { reach, start_scene } from "./scene.js";
import { class_of, name_of_leader } from "./senses.js";
import { part, state, trouble } from "./state.js";
import { draw, only_view, show } from "./views.js";

/** What steers. `turn` identifies the drive in progress. @type {{ on: boolean, timer: number, pointer: Place | null, keys: Set<string>, turn: object | null }} */
const drive = { on: false, timer: 0, pointer: null, keys: new Set(), turn: null };

part(() => [state.config.world.leaders.length, state.start], () => {
  const many = state.config.world.leaders.length, chosen = $("leader").value;
  $("leader").replaceChildren(...Array.from({ length: many }, (_, leader) => make("option", state.start.classes ? name_of_leader(state.start, leader) : String(leader), null, { value: String(leader) })));
  if (Number(chosen) < many && chosen !== "") $("leader").value = chosen;
});

// Nobody can steer until the module has resolved a config.
part(() => [state.toml], () => { $("again").disabled = state.toml === null; });

export function drive_view() {
  const only = only_view("In your hands", reach(state.config));
  $("driven").textContent = "";
  only.canvas.classList.add("steer");
  only.canvas.tabIndex = 0;
  only.canvas.setAttribute("role", "application");
  only.describe = (step, observed, text) => [
    `step ${step} of ${state.config.world.steps} · ${observed} of ${state.config.world.pois.length} POIs`,
    `You steer ${name_of_leader(state.start, Number($("leader").value))}: step ${step}, ${text}`,
  ];
  show(only, start_scene(state.config), false);
  only.chosen = ["leaders", Number($("leader").value) || 0];
  draw(only);
  const at = (/** @type {PointerEvent} */ event) => {
    const { scale } = stage.place_on(only.canvas, only.crop);
    drive.pointer = [only.crop[0] + event.offsetX / scale, only.crop[3] - event.offsetY / scale];
  };
  only.canvas.addEventListener("pointermove", at);
  only.canvas.addEventListener("pointerdown", event => { at(event); only.canvas.focus(); if (!drive.on) drive_on(); });
  // Lifting a finger also fires `pointerleave`. The leader then keeps going to the last place touched.
  only.canvas.addEventListener("pointerleave", event => { if (event.pointerType !== "touch") drive.pointer = null; });
  const key = (/** @type {KeyboardEvent} */ event) => {
    if (!/^Arrow/.test(event.key)) return;
    if (event.type === "keydown") { drive.pointer = null; if (!drive.on) drive_on(); drive.keys.add(event.key); } else drive.keys.delete(event.key);
    event.preventDefault();
    event.stopPropagation();
  };
  only.canvas.addEventListener("keydown", key);
  only.canvas.addEventListener("keyup", key);
  return only;
}

/**
 * Returns a leader's two outputs, each in -1..1: the wanted turn, in half turns to the left, and speed, or if it moves freely, its speed
 * along x and y. A leader that chooses an agent has one output, the choice. Returns null without input.
 * @param {number[]} positions @param {number[]} headings @param {number} leader
 */
function wish(positions, headings, leader) {
  const { free, choose } = class_of(state.start, leader);
  const [x, y] = positions.slice(2 * leader, 2 * leader + 2), [cos, sin] = headings.slice(2 * leader, 2 * leader + 2);
  if (!drive.pointer && !drive.keys.size) return null;
  const [left, right, up, down] = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"].map(key => Number(drive.keys.has(key)));
  if (choose) {
    // The leader chooses the agent nearest to the pointer. Arrow keys point far away.
    const to = drive.pointer ?? [x + 1e6 * (right - left), y + 1e6 * (up - down)];
    const away = choose.agents.map(agent => Math.hypot(positions[2 * agent] - to[0], positions[2 * agent + 1] - to[1]));
    return [2 * away.indexOf(Math.min(...away)) / away.length - 1, 0];
  }
  if (drive.pointer) {
    const [dx, dy] = [drive.pointer[0] - x, drive.pointer[1] - y], away = Math.hypot(dx, dy);
    if (free) return [dx, dy].map(part => part / Math.max(2, away));
    if (away < 0.3) return [0, -1];
    const angle = Math.atan2(cos * dy - sin * dx, cos * dx + sin * dy);
    return [Math.max(-1, Math.min(1, angle / Math.PI)), Math.max(-1, Math.min(1, away / 2 - 1))];
  }
  return free ? [right - left, up - down] : [0.4 * (left - right), up || (down ? -1 : 0.2)];
}

export async function drive_on() {
  if (state.toml === null) return;
  drive_off();
  const only = drive_view(), leader = Number($("leader").value) || 0;
  only.canvas.focus({ preventScroll: true });
  only.chosen = null;
  drive.on = true;
  $("again").textContent = "Start over";
  // Classes already say which agents learn.
  const toml = state.start.classes ? state.toml : await edited(state.toml, [["learning.paradigm", '"leader-follower"']]);
  const { each, weights, of } = state.policies || { each: 0 };
  /** @type {Driven} */
  let now;
  try {
    now = (await clerk.ask({ ask: "drive", text: toml, leader, policies: each }, weights)).words;
    $("driven").textContent = now.learned ? `The other leaders do what they learned${of ? ` (${of})` : ""}.` : `The other leaders have a policy of zeros: ${state.policies ? "what was learned is not for this team" : "train first, and they do what they learned"}.`;
  } catch (thrown) {
    drive_off();
    return trouble("run", failure(thrown).message);
  }
  const data = start_scene(state.config), [episode] = data.episodes;
  /** @type {Record<"positions" | "headings" | "near", number[]>} */
  const track = { positions: [], headings: [], near: [] };
  const take = (/** @type {Driven} */ words) => {
    track.positions.push(...words.positions);
    track.headings.push(...words.headings);
    track.near.push(...words.near);
    Object.assign(episode, {
      positions: Float32Array.from(track.positions), headings: Float32Array.from(track.headings), near: Uint32Array.from(track.near),
      shown: Array.from({ length: words.step + 1 }, (_, step) => step), observed: words.observed,
    });
  };
  take(now);
  show(only, data, false);
  const turn = drive.turn = {};
  const pace = Math.max(60, data.dt * 1000 * 0.75);
  const step = async () => {
    if (drive.turn !== turn || state.mode !== "drive") return;
    const from = performance.now(), wanted = wish(now.positions, now.headings, leader);
    if (!wanted) return void (drive.timer = setTimeout(step, 30));
    const [angle, speed] = wanted;
    try { now = (await clerk.ask({ ask: "step", turn: angle, speed })).words; } catch (thrown) { return trouble("run", failure(thrown).message); }
    if (drive.turn !== turn) return;
    take(now);
    Object.assign(only, { place: now.step });
    draw(only);
    if (now.scores) {
      drive_off();
      const { g, d, df } = now.scores, pois = state.config.world.pois.length;
      $("driven").textContent = `The team observed ${now.observed.filter(at => at !== null).length} of ${count(pois, "POI")} (G = ${number(g)}). Yours: D = ${number(d[leader])}, Df = ${number(df[leader])}.`;
      return;
    }
    drive.timer = setTimeout(step, Math.max(0, pace - (performance.now() - from)));
  };
  step();
}

export function drive_off() {
  clearTimeout(drive.timer);
  drive.turn = null;
  drive.on = false;
  drive.keys.clear();
  $("again").textContent = "Start";
}
