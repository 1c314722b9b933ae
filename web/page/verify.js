// Compares the browser's GPU with its CPU.
import { $, failure } from "./dom.js";
import { pool } from "./pool.js";

export async function verify() {
  const output = $("verified"), worlds = 8, teams = 24;
  $("verify").disabled = true;
  output.className = "";
  output.textContent = "…";
  let player;
  try {
    player = await pool.open();
    player.progress = ({ verified }) => { output.textContent = `${verified} of ${worlds} worlds`; };
    const pass = $("plain").checked ? "plain" : null;
    const { words } = await player.ask({ ask: "verify", worlds, teams, seed: 0, pass });
    output.className = words.mismatch ? "bad" : "good";
    output.textContent = words.mismatch ? `DIFFERENT: ${words.mismatch}` : `Equal: this browser's GPU and CPU agree on every bit of ${words.agent_steps.toLocaleString("en")} agent-steps in ${words.worlds} random worlds.`;
  } catch (thrown) {
    output.className = "bad";
    output.textContent = failure(thrown).message;
  }
  if (player) player.stop();
  $("verify").disabled = false;
}
