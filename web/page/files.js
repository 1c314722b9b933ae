// @ts-check
// Files that are dropped or opened.
import { show_start } from "./arrange.js";
import { curves } from "./curves.js";
import { $, count, trouble } from "./dom.js";
import { keep, take } from "./experiment.js";
import { settle } from "./machine.js";
import { mode } from "./modes.js";
import { reach } from "./scene.js";
import { state } from "./state.js";
import { digests, forget } from "./train.js";
import { Training } from "./training.js";
import { build, clear, controls, following, seek, show, unpack, view } from "./views.js";

export async function take_file(file) {
  trouble("");
  $("said").textContent = "";
  try {
    const bytes = new Uint8Array(await file.arrayBuffer());
    if (/\.zip$/i.test(file.name) || bytes[0] === 0x50 && bytes[1] === 0x4b) {
      const found = await state.players[0].ask({ ask: "read", text: null }, bytes, {}, [bytes.buffer]);
      await settle();
      const training = await Training.read(state.players[0], state.machine, file.name, found);
      if (state.training) state.training.stop();
      state.training = training;
      keep();
      Object.assign(state, { compared: null, trial: 0, generation: training.last, policies: null });
      following(false);
      training.source = { text: found.words.toml, compared: null };
      mode("watch");
      await take(found.words.toml);
      build(training);
      controls();
      curves();
      digests();
      seek(training.last);
      $("said").textContent = `${file.name}: the run is whole, its digest is right.`;
    } else if (/\.safetensors$/i.test(file.name)) {
      const { words, bytes: weights } = await state.clerk.ask({ ask: "read", text: state.toml }, bytes);
      forget();
      state.policies = { each: words.policies, weights };
      const { words: data } = await state.clerk.ask({ ask: "play", text: state.toml, policies: words.policies }, weights);
      mode("watch");
      clear();
      const only = view(state.config.learning.paradigm);
      only.crop = reach(state.config);
      only.title.textContent = `The champion of ${file.name}`;
      only.tell = (step, observed) => {
        only.said.textContent = `${observed} of ${data.pois.length} POIs by step ${step}`;
        only.canvas.setAttribute("aria-label", `${only.title.textContent}, step ${step}: ${only.said.textContent}`);
      };
      $("views").classList.add("one");
      show(only, unpack(data));
      $("said").textContent = `${file.name}: ${count(words.policies, "policy").replace(/ys$/, "ies")} a leader. Take a leader to play with them.`;
    } else {
      if (!/\.toml$/i.test(file.name)) throw new Error("it is no config (.toml), no run (.zip) and no policies (.safetensors)");
      const text = new TextDecoder("utf-8", { fatal: true }).decode(bytes);
      keep();
      state.file = file.name.replace(/\.toml$/i, "");
      state.compared = null;
      forget();
      mode("watch");
      show_start();
      const taken = await take(text);
      $("said").textContent = taken ? `${file.name} is the config now.` : `${file.name} has problems; they stand beside its lines.`;
    }
  } catch (error) { trouble(`${file.name}: ${error.message}`); }
}
