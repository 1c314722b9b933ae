// Learning curves as CSV.

/**
 * @typedef {{ best: number, mean: number, champion: number, test: number, seconds: number }} Row
 * @param {{ label: string, trials: Row[][] }[]} arms
 */
export function csv(arms) {
  const quoted = (/** @type {string} */ text) => /[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  const lines = ["arm,trial,generation,best_g,mean_g,champion_g"];
  for (const { label, trials } of arms) {
    trials.forEach((rows, trial) => rows.forEach(({ best, mean, champion }, generation) => {
      lines.push([quoted(label), trial, generation, best, mean, champion].join(","));
    }));
  }
  return lines.join("\n") + "\n";
}
