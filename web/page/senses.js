// What a leader senses, channel by channel, and its answer.

/** Names of the quadrants, in the order of a policy's inputs. */
const QUADRANTS = ["back right", "front right", "front left", "back left"];
/** What leaders sense if the config has no `[[agents]]`. @type {Omit<AgentClass, "outline" | "size">} */
const QUADRANTS_ONLY = { name: "leader", count: 1, free: false, senses: ["pois", "agents"].map(of => ({ of, sectors: 4, frame: "heading" })) };

/**
 * Returns the angles at which a sector starts and ends, counterclockwise: from the heading, or from the x axis of the map.
 * @param {number} sector
 * @param {Pick<Channel, "sectors" | "frame">} channel
 */
export const angles = (sector, { sectors, frame }) =>
  [sector, sector + 1].map(edge => edge * 2 * Math.PI / sectors - (frame === "heading" ? Math.PI : 0));

/** Returns the class of a leader. @param {Pick<Scene, "classes">} data @param {number} leader */
export function class_of({ classes = [] }, leader) {
  let left = leader;
  return classes.find(({ count }) => (left -= count) < 0) ?? QUADRANTS_ONLY;
}

/** Names a leader by its class. @param {Pick<Scene, "classes">} data @param {number} leader */
export const name_of_leader = (data, leader) => `${class_of(data, leader).name} ${leader}`;

/**
 * Returns what a leader senses and answers at a frame, from `[frames][leaders][inputs, 2 outputs]`. At the start it has not yet sensed
 * anything. Each channel has its values, one per sector.
 * @param {Pick<Scene, "classes">} data
 * @param {Pick<Episode, "senses" | "leaders" | "shown">} episode
 * @param {number} frame
 * @param {number} leader
 */
export function moment(data, { senses = new Float32Array(), leaders, shown }, frame, leader) {
  const size = senses.length / (shown.length * leaders), at = (frame * leaders + leader) * size, own = [...senses.subarray(at, at + size)];
  const { free, choose, senses: channels } = class_of(data, leader), answer = own.slice(-2);
  return { channels: channels.map(channel => ({ ...channel, names: names_of(data, channel), values: own.splice(0, channel.sectors) })), free, choose, answer };
}

/** Returns names of a channel's sectors: quadrants, or the numbers of agents or POIs. Others have none. @param {Pick<Scene, "classes" | "groups">} data @param {Channel} channel */
function names_of({ classes = [], groups = [] }, { of, pois = [], sectors, each, frame }) {
  if (!each) return sectors === 4 && frame === "heading" ? QUADRANTS : [];
  const own = of === "pois" ? pois : of, all = (of === "pois" ? groups : classes).flatMap(({ name, count }) => Array(count).fill(name));
  return all.flatMap((name, index) => own.length === 0 || own === "agents" || [own].flat().includes(name) ? [`${index}:`] : []);
}

/** Describes a moment in words. @param {ReturnType<typeof moment>} now */
export function words({ channels, free, choose, answer: [turn, speed] }) {
  const list = channels.map(({ of, names, values }) => {
    const name = [of].flat().map(name => name === "pois" ? "POIs" : name).join(" and ");
    return `${name}: ${values.map((value, sector) => (sector in names ? `${names[sector]} ` : "") + value.toFixed(2)).join(", ")}`;
  });
  if (choose) {
    const chosen = choose.agents[Math.round((turn + 1) / 2 * choose.agents.length)];
    return `senses ${list.join("; ")}. It goes to ${chosen === undefined ? "nobody" : `${choose.name} ${chosen}`}.`;
  }
  if (free) return `senses ${list.join("; ")}. It moves by ${(turn * 100).toFixed(0)} % of the largest speed along x, ${(speed * 100).toFixed(0)} % along y.`;
  const way = Math.abs(turn) < 0.02 ? "straight ahead" : `${(Math.abs(turn) * 180).toFixed(0)}° to the ${turn > 0 ? "left" : "right"}`;
  return `senses ${list.join("; ")}. It answers ${way}, at ${((speed + 1) * 50).toFixed(0)} % of the largest speed.`;
}
