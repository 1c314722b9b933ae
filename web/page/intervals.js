// Intervals over trials, and the comparison of arms. The module computes them as `flotilla compare` does.
import { $, make } from "./dom.js";
import { clerk } from "./pool.js";
import { news, part, state } from "./state.js";

/** Shows the intervals and tests of a training that has ended, or of opened runs. @param {Training} training */
export async function intervals(training) {
  const arms = training.arms.map(({ label, toml, trials }) => ({ name: label, text: toml, lengths: trials.map(trial => trial.length) }));
  const numbers = Float64Array.from(training.arms.flatMap(({ trials }) => trials.flatMap(rows => rows.flatMap(({ best, champion, test }) => [best, champion, test]))));
  const { words } = await clerk.ask({ ask: "compare", arms }, new Uint8Array(numbers.buffer));
  if (state.training !== training) return;
  training.found = words;
  news(training);
}

/** Returns the comparison on show. */
const compared = () => state.training && state.training.found;

part(() => [compared()], () => {
  const found = compared();
  $("compared").hidden = !found;
  if (!found) return;
  const { means = [], pairs = [], refused, legend = "", notes = [] } = found;
  $("means").replaceChildren(...(means.length ? [grid(means)] : []));
  $("pairs").replaceChildren(...(pairs.length > 1 ? [grid(pairs)] : []));
  $("tests").hidden = pairs.length < 2;
  $("compared-says").textContent = refused ? `The arms are not compared: ${refused}.` : [...notes.map(note => `${note[0].toUpperCase()}${note.slice(1)}.`), legend].join(" ").replaceAll("\n", " ");
});

/** Makes a table of rows, of which the first is the head. Narrow windows show a block per row. @param {string[][]} rows */
function grid([head, ...rows]) {
  const made = make("table", "", null, { className: "stacks" }), top = make("tr", "", make("thead", "", made)), body = make("tbody", "", made);
  for (const name of head) make("th", name, top, { scope: "col" });
  for (const cells of rows) {
    const row = make("tr", "", body);
    cells.forEach((cell, column) => { make(column ? "td" : "th", cell, row, column ? {} : { scope: "row" }).dataset.column = head[column]; });
  }
  return made;
}
