// Types that several modules use: what the worker sends, what the page is made of, and what stage.js draws.

interface Window { page: object }
// Browsers that can suspend WebAssembly have this.
declare namespace WebAssembly { const Suspending: Function | undefined }

type Training = import("./training.js").Training;
type Comparison = import("./compare.js").Comparison;
type Player = Awaited<ReturnType<typeof import("./pool.js").pool.open>>;
type Bytes = Uint8Array<ArrayBuffer>;
type Place = [number, number];
/** A part of the map: left, below, right and above. */
type Crop = [number, number, number, number];
/** Lists of the config that hold what lies on the map, and an index into one. */
type List = "leaders" | "followers" | "pois";
type Chosen = [List, number];
type Kind = "leader-follower" | "all-leaders";

/** The keys of a config that the page reads. The seed is text, because numbers cannot represent every seed. */
interface Config {
  world: Record<List, Place[]> & Rule & { map: Place, coupling: number | number[], observation_radius: number, steps: number, dt: number, heading: number | number[] };
  motion: { max_speed: number };
  follow: { attraction_radius: number };
  agents?: Group[];
  credit?: { removes?: number[][] };
  pois?: Group[];
  learning: {
    paradigm?: Kind, fitness: string, seed: string, generations: number, trials: number, population: number, partners?: number, hall_of_fame?: number,
    episodes_per_team: number, test_episodes: number,
  };
}
/** Which agents count at POIs, when, and after which others. */
interface Rule { observers: "all" | "leaders" | "followers", windows: Place[], after: number[][] }
/** An entry of `[[agents]]` or `[[pois]]`. The lists have a value for each place, or one for all. */
interface Group { name: string, at?: Place[], motion: { max_speed: number }, control?: string, coupling?: number | number[], windows?: Place[], heading?: number | number[] }
/** What the page needs of a config besides its keys. `common_fitness` tells whether any class learns by `learning.fitness`. */
interface Start extends Parts { owner: number[], coupling: number[], headings: number[], notes: string[], common_fitness: boolean }
interface Described { toml: string, config: Config, pois: number | null, parameters: number, start: Start }
interface Palettes { light: string[], dark: string[] }

/** At which steps POIs were observed, and how many agents were near them, `[shown][pois]`. */
interface Seen { observed: (number | null)[], near: Uint32Array }
/** An episode. Starts and steered episodes have no scores. Very long ones have neither `senses` nor `without`. */
interface Episode extends Seen {
  leaders: number, agents: number, coupling: number[], shown: number[], g: number, generation: number, trial: number, owner: number[],
  led: Uint32Array, positions: Float32Array, headings: Float32Array, team_g?: number, d?: number[], df?: number[], dpp?: number[], dt?: number[],
  senses?: Float32Array, without?: { alone: Seen, group: Seen }[],
}
/** A channel of a class's senses, and a class of agents. Those that learn come first. */
interface Channel { of: string | string[], pois?: string | string[], sectors: number, each?: boolean, frame: "heading" | "map" }
interface AgentClass { name: string, size: number, count: number, free: boolean, outline: Place[], senses: Channel[], choose?: { name: string, agents: number[] } }
/**
 * What only some scenes have: classes of agents, groups of POIs, the radius and value of each POI if they differ, and the population of each
 * agent if they share some and none follows.
 */
interface Parts { populations?: number[], classes?: AgentClass[], groups?: { name: string, count: number }[], radii?: number[], values?: number[] }
interface Scene extends Rule, Parts {
  map: Place, pois: Place[], observation_radius: number, attraction_radius: number, dt: number, steps: number, exact: boolean,
  colors: Palettes, outline: Place[], fitness?: string, episodes: Episode[],
}
/** A scene as it is sent: arrays are base64 until `stage.unpack`. */
interface Packed { colors: Palettes, outline: Place[], episodes: { generation: number, team_g: number }[] }

/** What to show of an episode. */
interface Look {
  crop: Crop, trails: boolean, radii: boolean, groups: boolean, over: number | null, heat: boolean, removed: Removed | null, lost: number[],
}
interface Removed { leader: number, group: boolean }
interface OnCanvas { wide: number, tall: number, scale: number, X: (x: number) => number, Y: (y: number) => number }
/** The build puts this before the modules: app/src/report/stage.js, which every page that shows episodes shares. */
declare const stage: {
  night: MediaQueryList,
  unpack(data: Packed): Scene,
  moment(data: Scene, episode: Episode, frame: number, agent: number): [number, number, number, number],
  busy(data: Scene): Crop,
  whole(data: Scene): Crop,
  place_on(canvas: HTMLCanvasElement, crop: Crop): OnCanvas,
  tint(data: Scene, leader: number): string,
  paint(data: Scene, episode: Episode, canvas: HTMLCanvasElement, place: number, look: Look): { step: number, positions: Place[] },
  say(episode: Episode, step: number): [number, string],
  poi_at(data: Scene, canvas: HTMLCanvasElement, crop: Crop, x: number, y: number): number | null,
  legend(data: Scene): HTMLElement[],
  later(data: Scene, episode: Episode, place: number, seconds: number): number,
};

/** One canvas: its arm, its episode, and the place in it. `describe` returns the line below the title of a view that shows no training, and its
 * description for screen readers. */
interface View {
  label: string, card: HTMLElement, title: HTMLElement, status: HTMLElement, marks: HTMLElement, sensed: HTMLElement, canvas: HTMLCanvasElement,
  data: Scene | null, place: number, playing: boolean, ended: number | null, over: number | null, wanted: number | null, asking: boolean,
  crop: Crop, chosen: Chosen | null, removed: Removed | null, selected: number | null, drawn: Place[], ghosts: Scene[], haunted: { look: string, picture: HTMLCanvasElement } | null,
  describe: ((step: number, observed: number, text: string) => [string, string]) | null,
}
/**
 * Episodes that belong to no training. `status` writes the line below a title, `label` names the episode for screen readers, and `ghosts` are
 * other teams, whose leaders' ways are drawn faintly. One that is `pending` only shows where they start, until they are made.
 */
interface Exhibit { name: string, pending?: boolean, scenes: { title: string, data: Scene, label: string, status: (step: number, observed: number) => string, ghosts?: Scene[] }[] }
/** A view that shows an episode. */
type Shown = View & { data: Scene };

/**
 * The state of the page. `mode` is what the map is for, `follow` whether the views follow the training, and `over` the
 * generation under the pointer. `training` has the results on
 * show, and without one `exhibit` the episode. `valid` tells whether the text is a valid config, `problems` why not, and `config`, `toml`, `pois`
 * and `start` are those of the last valid text. `linked` tells whether the address holds it. `past` has earlier texts, for undo. `chosen` is
 * the latest experiment of the gallery, `note` is about the version of the opened link, and `guide` the step of the guided start, what the visitor predicted, and whether it waits for what it shows. `told` is what `guide` was when it was last about what is on show. `layouts` has the config of each layout. `settled` is the choice that `machine` was opened for.
 */
interface State extends Past {
  valid: boolean, config: Config, toml: string | null, pois: number | null, start: Start, past: Past[], problems: Problem[], linked: boolean,
  mode: "watch" | "arrange" | "drive", training: Training | null, exhibit: Exhibit | null, follow: boolean, generation: number, over: number | null, trial: number,
  views: View[], chosen: Picked | null, guide: Guide | null, told: Guide | null, troubles: Record<string, string>, message: string, note: string, gpu: Gpu, machine: Machine, settled: string | null,
  players: Player[], policies: { each: number, weights: Bytes, of?: string } | null, layouts: Record<string, Config>, version: string,
}
interface Guide { step: number, said: string | null, waits?: boolean }
interface Past { text: string, file: string | null, compared: Comparison | null }
/** An experiment of the gallery, and what it set. */
interface Picked { name: string, text: string, compared: Comparison }
/** The browser's GPU, or the reason why none can be used. */
interface Gpu { name?: string, software?: boolean, reason?: string }

/** G of a generation of a trial: of the best team, the mean, and of the champion. */
interface Row { best: number, mean: number, champion: number, test: number, seconds: number }
/** What an arm is made of. `constant` and `random` are G of baselines. */
interface Planned {
  name: string, label: string, toml: string, config: Config, pois: number | null, parameters: number, command?: string, digest?: string,
  zip?: Bytes, bytes?: number, constant: number | null, random: number[],
}
/** An arm of a training. `style` is the index of its colour and dashes, and `ended` has the champions of each trial. */
interface Arm extends Planned { style: number, trials: Row[][], ended: Bytes[] }
/** A run from a file. */
interface Opened { name: string, label: string, words: Answers["read"], bytes: Bytes }
/** The comparison of arms: curves with intervals, and tables. */
interface Found {
  curves: { generation: number[], mean: number[], band: Place[] | null }[],
  means?: string[][], pairs?: string[][], refused?: string, legend?: string, notes?: string[],
}

/** The backend that trains. `why` says why it is not a GPU. */
interface Machine { description: string, backend: string, adapter: string | null, driver: string | null, threads: number, why?: string }
/** Results of a trial that ended: the counts of its numbers. */
interface Ended { trial: number, policies: number, numbers: number }
interface Driven {
  step: number, learned: boolean, positions: number[], headings: number[], near: number[], observed: (number | null)[],
  scores: { g: number, d: number[], df: number[] } | null,
}
interface Problem { line?: number, key?: string, message: string }

/** The JSON that a worker answers, by what was asked. */
interface Answers {
  start: { suspends: boolean };
  about: { version: string };
  resolve: Described & { bytes: number };
  edit: { text: string };
  labels: { labels: string[] };
  compare: Found;
  constant: { g: number };
  random: {};
  more_random: { g: number[], done: boolean };
  gif: {};
  open: Machine;
  train: {};
  advance: { next: number, played: number, done: boolean, seconds: number };
  champion: Packed;
  play: Packed;
  ends: Ended[];
  record: { digest: string };
  read: Described & { rows: number, digest: string, policies: number };
  verify: { worlds: number, agent_steps: number, mismatch: string | null };
  drive: Driven;
  step: Driven;
}

/** Elements with an id, by what they are. */
type Elements =
  & Record<"layout" | "compare" | "fitness" | "paradigm" | "pace" | "on" | "trial" | "speed" | "leader" | "credited", HTMLSelectElement>
  & Record<"coupling" | "seed" | "generations" | "trials" | "population" | "scrub" | "step" | "file", HTMLInputElement>
  & Record<"following" | "loop" | "trails" | "radii" | "heat" | "plain", HTMLInputElement>
  & Record<"train" | "stop" | "pause" | "replay" | "undo" | "again" | "remove" | "verify" | "share" | "open" | "save", HTMLButtonElement>
  & Record<"png" | "gif" | "webm" | "csv" | "guide-next" | "guide-end", HTMLButtonElement>
  & Record<"text", HTMLTextAreaElement> & Record<"curves", HTMLCanvasElement> & Record<"config" | "more", HTMLDetailsElement>
  & Record<"setup" | "guide" | "guide-text" | "guide-step" | "guide-says" | "guide-choices" | "bar" | "arrange" | "adds" | "drive" | "modes" | "views" | "plain-label", HTMLElement>
  & Record<"credit" | "play" | "training" | "team" | "credits" | "lost" | "compared" | "compared-says" | "means" | "pairs" | "tests" | "gallery" | "digests", HTMLElement>
  & Record<"trouble" | "stale" | "notes" | "announced" | "machine" | "version" | "legend" | "needless" | "problems" | "lines" | "marks", HTMLElement>
  & Record<"chosen" | "driven" | "generation" | "message" | "verified", HTMLElement>
  & Record<"wasm" | "worker" | "opening" | `layout-${string}` | `gallery-${string}`, HTMLElement>;
