// @ts-check
// The part of the map to show, and the start as an episode without steps.
import { state } from "./state.js";

// Returns the part of the map that contains all POIs and every place that agents can reach in an episode.
export function reach({ world, motion }) {
  const far = world.steps * world.dt * motion.max_speed + 2, [width, height] = world.map;
  const starts = [...world.leaders, ...world.followers].map(place => [...place, far]);
  const all = [...starts, ...world.pois.map(place => [...place, world.observation_radius + 1])];
  const side = (axis, sign) => all.map(place => place[axis] + sign * place[2]);
  // A margin beyond the walls, so that agents at a wall are drawn whole.
  const low = axis => Math.max(-1.5, Math.min(...side(axis, -1))), high = (axis, end) => Math.min(end + 1.5, Math.max(...side(axis, 1)));
  let [left, below, right, above] = [low(0), low(1), high(0, width), high(1, height)];
  const least = (right - left) * 0.42;
  if (above - below < least) { above = Math.min(height + 1.5, below + least); below = Math.max(-1.5, above - least); }
  return [left, below, right, above];
}

// Returns the start as an episode without steps.
export function start_scene(config) {
  const { world, follow } = config, agents = [...world.leaders, ...world.followers];
  const coupling = Array.isArray(world.coupling) ? world.coupling : world.pois.map(() => world.coupling);
  const nearest = place => {
    const away = world.leaders.map(leader => Math.hypot(leader[0] - place[0], leader[1] - place[1]));
    const best = away.indexOf(Math.min(...away));
    return away[best] <= follow.attraction_radius ? best : -1;
  };
  return {
    map: world.map, pois: world.pois, observation_radius: world.observation_radius, attraction_radius: follow.attraction_radius,
    dt: world.dt, steps: world.steps, exact: true, colors: state.palettes,
    observers: world.observers, windows: world.windows, after: world.after,
    episodes: [{
      leaders: world.leaders.length, agents: agents.length, coupling, shown: [0], g: 0, generation: 0, trial: 0,
      owner: agents.map((place, agent) => agent < world.leaders.length ? agent : nearest(place)),
      observed: world.pois.map(() => null), near: new Uint16Array(world.pois.length), led: new Uint32Array(0),
      positions: Float32Array.from(agents.flat()), headings: Float32Array.from(headings_of(world).flatMap((angle) => [Math.cos(angle), Math.sin(angle)])),
    }],
  };
}
// Returns the heading of each agent at the start. If headings are given per leader, each follower uses that of its
// nearest leader.
function headings_of({ heading, leaders, followers }) {
  const agents = [...leaders, ...followers];
  if (!Array.isArray(heading)) return agents.map(() => heading);
  if (heading.length === agents.length) return heading;
  const nearest = ([x, y]) => {
    const away = leaders.map(([u, v]) => (u - x) ** 2 + (v - y) ** 2);
    return away.indexOf(Math.min(...away));
  };
  return [...heading, ...followers.map((place) => heading[nearest(place)])];
}
