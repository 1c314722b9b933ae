// What the build puts before the modules: src/report/stage.js, which every page that shows episodes shares.
declare const stage: any;
interface Window { page: any }
// Browsers that can suspend WebAssembly have these.
declare namespace WebAssembly { const Suspending: any, promising: any }
interface Navigator { gpu: any }

// Types that several modules use. `any` is what the module sends: configs and episodes.
type Training = import("./training.js").Training;
type View = import("./state.js").View;
type Comparison = import("./compare.js").Comparison;
type Player = Awaited<ReturnType<typeof import("./pool.js").pool.open>>;
type Bytes = Uint8Array<ArrayBuffer>;
/** Lists of the config that hold what lies on the map, and an index into one. */
type List = "leaders" | "followers" | "pois";
type Chosen = [List, number];
type Place = [number, number];
/** G of a generation of a trial: of the best team, the mean, and of the champion. */
interface Row { best: number, mean: number, champion: number, seconds: number }
/** What an arm is made of. `constant` and `random` are G of baselines. */
interface Planned {
  name: string, label: string, toml: string, config: any, pois: number | null, parameters: number, command?: string, digest?: string,
  zip?: Bytes, bytes?: number, constant: number | null, random: number[],
}
/** An arm of a training. `ended` has the champions of each trial. */
interface Arm extends Planned { trials: Row[][], ended: Bytes[] }
/** A run from a file. */
interface Opened { name: string, label: string, words: any, bytes: Bytes }
/** The comparison of arms: curves with intervals, and tables. */
interface Found {
  curves: { generation: number[], mean: number[], band: Place[] | null }[],
  means?: string[][], pairs?: string[][], refused?: string, legend?: string, notes?: string[],
}
