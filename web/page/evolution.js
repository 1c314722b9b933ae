// Whole populations of the first experiment, at some generations.
import { text_of } from "./gallery.js";
import { OPENED } from "./opening.js";
import { clerk } from "./pool.js";

const GENERATIONS = [0, 15, 60], POPULATION = 50;
const NAME = "evolution", title = (/** @type {number} */ generation) => `Generation ${generation}`;

/** Returns what is shown until the populations are trained: where all start, in views of the final size. @returns {Exhibit} */
export function evolution_starts() {
  const [{ data }] = OPENED.scenes, [episode] = data.episodes;
  const start = { ...data, episodes: [{ ...episode, shown: [0], observed: data.pois.map(() => null), senses: undefined, without: undefined }] };
  const scene = { data: start, label: "Where all start", status: () => `training ${POPULATION} policies per leader…` };
  return { name: NAME, pending: true, scenes: GENERATIONS.map(generation => ({ ...scene, title: title(generation) })) };
}

/** @type {Promise<Exhibit> | null} */
let made = null;
// Trains until each generation, and plays every policy. Policy n of a leader plays with policy n of the others. Trainings with the same
// seed are equal until one ends.
export const evolution = () => made ??= clerk.put_first(make_evolution).catch(thrown => { made = null; throw thrown; });

async function make_evolution() {
  const resolve = (/** @type {number} */ generations) => clerk.ask({
    ask: "resolve", text: text_of("two_groups"), name: "two_groups.toml",
    // So few policies learn with some seeds only. This is one of them.
    changes: Object.entries({ "learning.generations": String(generations), "learning.population": String(POPULATION), "learning.trials": "1", "learning.seed": "9" }),
  });
  const configs = await Promise.all(GENERATIONS.map(async generations => (await resolve(generations)).words));
  await clerk.ask({ ask: "train", runs: configs.map(({ toml }) => ({ text: toml, trials: [0] })) });
  while (!(await clerk.ask({ ask: "advance", generations: 1000, milliseconds: 60 })).words.done);
  /** @type {Exhibit} */
  const exhibit = { name: NAME, scenes: [] };
  for (const [run, { toml, parameters }] of configs.entries()) {
    const { words: [{ policies }], bytes } = await clerk.ask({ ask: "ends", run }), weights = new Float32Array(bytes.buffer, bytes.byteOffset, policies);
    /** @type {Scene[]} */
    const ghosts = [];
    for (let policy = 0; policy < POPULATION; policy++) {
      const own = Float32Array.from({ length: policies / POPULATION }, (_, at) => weights[(Math.floor(at / parameters) * POPULATION + policy) * parameters + at % parameters]);
      ghosts.push(stage.unpack((await clerk.ask({ ask: "play", text: toml, policies: 1 }, new Uint8Array(own.buffer))).words));
    }
    const best = ghosts.reduce((best, ghost) => ghost.episodes[0].g > best.episodes[0].g ? ghost : best), generation = GENERATIONS[run];
    exhibit.scenes.push({
      title: title(generation), data: best, ghosts, label: `${POPULATION} teams of generation ${generation}; the best of them`,
      status: (step, observed) => `the best of these ${POPULATION} teams: ${observed} of ${best.pois.length} POIs by step ${step}`,
    });
  }
  return exhibit;
}
