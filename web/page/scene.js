// The part of the map to show, and the start as an episode without steps.
import { opening, state } from "./state.js";

// Returns the part of the map that contains all POIs and every place that agents can reach in an episode.
/** @param {Config} config @returns {Crop} */
export function reach({ world, motion, agents = [] }) {
  const fastest = Math.max(...(agents.length ? agents : [{ motion }]).map(({ motion }) => motion.max_speed));
  const far = world.steps * world.dt * fastest + 2, [width, height] = world.map;
  const starts = [...world.leaders, ...world.followers].map(place => [...place, far]);
  const all = [...starts, ...world.pois.map(place => [...place, world.observation_radius + 1])];
  const side = (/** @type {number} */ axis, /** @type {number} */ sign) => all.map(place => place[axis] + sign * place[2]);
  // A margin beyond the walls, so that agents at a wall are drawn whole.
  const low = (/** @type {number} */ axis) => Math.max(-1.5, Math.min(...side(axis, -1))), high = (/** @type {number} */ axis, /** @type {number} */ end) => Math.min(end + 1.5, Math.max(...side(axis, 1)));
  let [left, below, right, above] = [low(0), low(1), high(0, width), high(1, height)];
  const least = (right - left) * 0.42;
  if (above - below < least) { above = Math.min(height + 1.5, below + least); below = Math.max(-1.5, above - least); }
  return [left, below, right, above];
}

/** Returns the smallest part of the map that holds two. @param {Crop} one @param {Crop} other @returns {Crop} */
export const join = (one, other) => [Math.min(one[0], other[0]), Math.min(one[1], other[1]), Math.max(one[2], other[2]), Math.max(one[3], other[3])];

/**
 * Returns the start as an episode without steps. Places are those of the config, which may have moved since the module resolved it.
 * @param {Config} config @returns {Scene}
 */
export function start_scene(config) {
  const { world, follow } = config, agents = [...world.leaders, ...world.followers], { coupling, headings, owner: owners, notes, common_fitness, ...parts } = state.start;
  // After an addition or a removal, the owners are those of the former agents until the module has resolved it.
  const owner = agents.map((_, agent) => owners[agent] < world.leaders.length ? owners[agent] : -1);
  return {
    map: world.map, pois: world.pois, observation_radius: world.observation_radius, attraction_radius: follow.attraction_radius,
    dt: world.dt, steps: world.steps, exact: true, colors: opening.data.colors, outline: opening.data.outline,
    observers: world.observers, windows: world.windows, after: world.after, ...parts,
    episodes: [{
      leaders: world.leaders.length, agents: agents.length, coupling, shown: [0], g: 0, generation: 0, trial: 0, owner,
      observed: world.pois.map(() => null), near: new Uint32Array(world.pois.length), led: new Uint32Array(0),
      positions: Float32Array.from(agents.flat()), headings: Float32Array.from(headings.flatMap(angle => [Math.cos(angle), Math.sin(angle)])),
    }],
  };
}
