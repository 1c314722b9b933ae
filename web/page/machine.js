// The workers, and the backend that trains.
import { $, count, failure, write_text } from "./dom.js";
import { pool } from "./pool.js";
import { part, render, state } from "./state.js";

// Opens the chosen backend, or the CPU if no GPU is exact. `auto` also ignores software renderers.
export async function settle() {
  await renew_failed();
  const wanted = $("on").value, { gpu } = state;
  if (state.settled === wanted) return;
  let why = "";
  if (wanted === "gpu" || wanted === "auto" && gpu.name && !gpu.software) {
    try {
      if (!gpu.name) throw new Error(gpu.reason);
      $("machine").textContent = `Testing ${gpu.name} for exactness…`;
      const { words } = await state.players[0].ask({ ask: "open", gpu: true, pass: null });
      const description = `${gpu.name}${gpu.software ? ", a software renderer," : ""} with WebGPU, which passed the exactness test`;
      return render({ machine: { ...words, adapter: gpu.name, description }, settled: wanted });
    } catch (thrown) { why = failure(thrown).message; }
  } else if (wanted === "auto") why = gpu.software ? `this browser's GPU is a software renderer, ${gpu.name}` : gpu.reason ?? "";
  const { words } = await state.players[0].ask({ ask: "open", gpu: false, pass: null });
  render({ machine: { ...words, threads: state.players.length, why }, settled: wanted });
}

part(() => [state.machine, state.training, state.training && state.training.version], () => {
  if (!state.settled) return;
  const { training, machine } = state, workers = machine.backend === "cpu" ? `${machine.description.replace(/, \d+ threads?/, "")} in ${count(state.players.length, "worker")}` : machine.description;
  const speed = training && training.teams ? ` · ${Math.round(training.rate).toLocaleString("en")} teams per second` : "";
  write_text($("machine"), `Runs on ${workers}${speed}${machine.why ? ` (${machine.why})` : ""}`);
});

// Replaces the players, for example after they stopped responding.
export async function renew() {
  const many = Math.max(1, Math.min(16, navigator.hardwareConcurrency || 2)), old = state.players;
  state.players = await Promise.all(Array.from({ length: many }, () => pool.open()));
  state.settled = null;
  old.forEach(player => player.stop());
}

// Replaces the players if one of them has failed, because it answers no further requests.
export async function renew_failed() {
  if (state.players.some(player => player.failed)) await renew();
}
