// What a leader senses: the densities of POIs and agents in four quadrants, and its answer.

/** Names of the quadrants, in the order of a policy's inputs. */
const QUADRANTS = ["back right", "front right", "front left", "back left"];

/** Returns the angles at which a quadrant starts and ends, from the heading and counterclockwise. @param {number} quadrant */
export const angles = quadrant => [(quadrant - 2) * Math.PI / 2, (quadrant - 1) * Math.PI / 2];

/**
 * Returns what a leader senses and answers at a frame, from `[frames][leaders][8 inputs, 2 outputs]`. At the start it has not yet
 * sensed anything.
 * @param {Float32Array} numbers
 * @param {number} leaders
 * @param {number} frame
 * @param {number} leader
 */
export function moment(numbers, leaders, frame, leader) {
  const at = (frame * leaders + leader) * 10, own = [...numbers.subarray(at, at + 10)];
  return { pois: own.slice(0, 4), agents: own.slice(4, 8), turn: own[8], speed: own[9] };
}

/** Describes a moment in words. @param {ReturnType<typeof moment>} now */
export function words({ pois, agents, turn, speed }) {
  const list = (/** @type {number[]} */ values) => values.map((value, quadrant) => `${QUADRANTS[quadrant]} ${value.toFixed(2)}`).join(", ");
  const way = Math.abs(turn) < 0.02 ? "straight ahead" : `${(Math.abs(turn) * 180).toFixed(0)}° to the ${turn > 0 ? "left" : "right"}`;
  return `senses POIs: ${list(pois)}; agents: ${list(agents)}. It answers ${way}, at ${((speed + 1) * 50).toFixed(0)} % of the largest speed.`;
}
