// Files that are dropped or opened.
import { team } from "./compare.js";
import { count, failure } from "./dom.js";
import { keep, take } from "./experiment.js";
import { renew_failed, settle } from "./machine.js";
import { mode } from "./modes.js";
import { intervals } from "./intervals.js";
import { clerk } from "./pool.js";
import { TONES, render, report, state, trouble } from "./state.js";
import { forget } from "./train.js";
import { Training } from "./training.js";
import { reveal } from "./views.js";

/** Most runs that are opened together: each has a colour. */
const MOST_RUNS = TONES.length;

/** @typedef {{ file: File, bytes: Bytes }} Read */

/** Opens files: several runs as arms of one chart, or a single file of any kind. @param {File[]} files */
export async function take_files(files) {
  trouble("file", "");
  report("");
  let now = files[0];
  try {
    /** @type {Read[]} */
    const read = [];
    for (const file of files) {
      now = file;
      const bytes = new Uint8Array(await file.arrayBuffer()), is_run = /\.zip$/i.test(file.name) || bytes[0] === 0x50 && bytes[1] === 0x4b;
      if (files.length > 1 && !is_run) throw new Error("not a run (.zip); only runs can be opened together");
      if (files.length > MOST_RUNS) throw new Error(`these are ${files.length} files; open ${MOST_RUNS} runs at most together`);
      read.push({ file, bytes });
      if (is_run && read.length === files.length) return await take_runs(read, file => { now = file; });
    }
    if (read.length) await take_other(read[0]);
  } catch (thrown) { trouble("file", `${now.name}: ${failure(thrown).message}`); }
}

/** Opens runs as arms of one chart. @param {Read[]} read @param {(file: File) => void} reading */
async function take_runs(read, reading) {
  /** @type {Opened[]} */
  const found = [];
  await renew_failed();
  for (const { file, bytes } of read) {
    reading(file);
    const { words, bytes: numbers } = await state.players[0].ask({ ask: "read", text: null }, bytes, {}, [bytes.buffer]);
    found.push({ name: file.name, label: team(words.config), words, bytes: numbers });
  }
  if (found.length > 1) {
    const { words } = await clerk.ask({ ask: "labels", texts: found.map(({ words }) => words.toml), names: found.map(({ name }) => name) });
    found.forEach((run, index) => { run.label = words.labels[index]; });
  }
  await settle();
  const training = await Training.read(state.players[0], state.machine, found), [{ words }] = found;
  keep();
  forget();
  training.source = { text: words.toml, compared: null };
  mode("watch");
  render({ training, guide: null, compared: null, trial: 0, generation: training.last, follow: false });
  await take(words.toml);
  reveal();
  await intervals(training);
  report(found.length > 1 ? `${found.length} runs are compared. Each is complete, and its digest matches. The settings are those of ${found[0].name}.` : `${found[0].name}: the run is complete, and its digest matches.`);
}

/** Opens policies or a config. @param {Read} read */
async function take_other({ file, bytes }) {
  if (/\.safetensors$/i.test(file.name)) {
    const { words, bytes: weights } = await clerk.ask({ ask: "read", text: state.toml }, bytes);
    const data = stage.unpack((await clerk.ask({ ask: "play", text: state.toml, policies: words.policies }, weights)).words), title = `The champion of ${file.name}`;
    forget();
    mode("watch");
    render({ guide: null, policies: { each: words.policies, weights }, exhibit: { name: file.name, scenes: [{ title, data, label: title, status: (step, observed) => `${observed} of ${data.pois.length} POIs by step ${step}` }] } });
    reveal();
    report(`${file.name}: ${count(words.policies, "policy").replace(/ys$/, "ies")} per leader. Take a leader to play with them.`);
  } else {
    if (!/\.toml$/i.test(file.name)) throw new Error("not a config (.toml), a run (.zip) or policies (.safetensors)");
    const text = new TextDecoder("utf-8", { fatal: true }).decode(bytes);
    keep();
    forget();
    mode("watch");
    render({ guide: null, file: file.name.replace(/\.toml$/i, ""), compared: null });
    const taken = await take(text);
    report(taken ? `${file.name} is the config now.` : `${file.name} has problems; they are shown beside its lines.`);
  }
}
