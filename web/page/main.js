// The page's event listeners and its start.
import { are_runs, autoplay, link, recall, remember, shows_opening, trained } from "./address.js";
import { remove } from "./arrange.js";
import { comparison } from "./compare.js";
import { configs } from "./config.js";
import { curves, drawn_chart } from "./curves.js";
import { $, all, failure, option } from "./dom.js";
import { drive_off, drive_on, drive_view } from "./drive.js";
import { change, compare, edited, entered, fill, keep, lines, take, typing, undo } from "./experiment.js";
import { save_csv, save_gif, save_png, save_webm } from "./exports.js";
import { take_files } from "./files.js";
import { gallery, text_of } from "./gallery.js";
import { guide, leave_guide } from "./guide.js";
import { renew, settle } from "./machine.js";
import { mode } from "./modes.js";
import { OPENED, OPENING } from "./opening.js";
import { arrive, go_back } from "./past.js";
import { clerk, pool } from "./pool.js";
import { KEYS, KEY_IDS, copy, quote, render, report, save, state, trouble } from "./state.js";
import { forget, stop, train } from "./train.js";
import { verify } from "./verify.js";
import { ask_all, draw, end_of, follow, moving, pause, replay, seek, step_to, wake_up } from "./views.js";

function listen() {
  $("setup").addEventListener("submit", event => { event.preventDefault(); train(); });
  $("layout").addEventListener("change", async () => {
    const { fitness, seed } = state.config.learning;
    const text = await edited(configs.layout($("layout").value), [["learning.fitness", `"${fitness}"`], ["learning.seed", seed]]);
    keep();
    forget();
    render({ file: null, mode: state.mode === "arrange" ? "arrange" : "watch" });
    await take(text);
  });
  $("paradigm").addEventListener("change", () => {
    if (state.compared && state.compared.key === "learning.paradigm") state.compared = null;
    change([["learning.paradigm", `"${$("paradigm").value}"`]]);
  });
  $("compare").addEventListener("change", () => {
    if ($("compare").value !== "own") compare(comparison($("compare").value, state.config.learning.population));
  });
  for (const id of KEY_IDS) {
    // An empty field is reset to the config's value.
    $(id).addEventListener("change", () => { if ($(id).value !== "") change([[KEYS[id], quote(id)($(id).value)]]); else fill(); });
  }
  for (const id of /** @type {const} */ (["on", "pace", "credited"])) $(id).addEventListener("change", () => render());
  // A training in progress keeps its backend. The next one uses the new choice.
  $("on").addEventListener("change", () => { if (!state.training || state.training.state === "done" || state.training.state === "stopped") settle().catch(thrown => trouble("run", failure(thrown).message)); });
  for (const button of all("[data-mode]")) button.addEventListener("click", () => mode(/** @type {typeof state.mode} */ (button.dataset.mode)));
  $("remove").addEventListener("click", remove);
  $("again").addEventListener("click", drive_on);
  $("leader").addEventListener("change", () => { if (state.mode === "drive") { drive_off(); drive_view(); } });
  $("pause").addEventListener("click", pause);
  $("stop").addEventListener("click", stop);
  $("undo").addEventListener("click", undo);
  $("step").addEventListener("input", () => step_to(Number($("step").value)));
  $("following").addEventListener("change", () => {
    render({ follow: $("following").checked });
    if (state.follow) follow(); else seek(state.generation);
  });
  $("scrub").addEventListener("input", () => {
    if (state.mode !== "watch") mode("watch");
    seek(Number($("scrub").value));
  });
  $("trial").addEventListener("change", () => {
    // Following goes on in the other trial.
    render({ trial: Number($("trial").value) });
    ask_all();
  });
  $("replay").addEventListener("click", () => {
    if (state.mode !== "watch") mode("watch");
    replay();
  });
  $("loop").addEventListener("change", () => { if ($("loop").checked) wake_up(); });
  for (const id of /** @type {const} */ (["trails", "radii", "heat"])) $(id).addEventListener("change", () => state.views.forEach(draw));
  $("curves").addEventListener("pointermove", event => { if (drawn_chart && state.training) render({ over: drawn_chart.generation(event.offsetX) }); });
  $("curves").addEventListener("pointerleave", () => render({ over: null }));
  $("curves").addEventListener("click", event => { if (drawn_chart && state.training) { if (state.mode !== "watch") mode("watch"); seek(drawn_chart.generation(event.offsetX)); } });
  $("verify").addEventListener("click", verify);
  $("share").addEventListener("click", async () => {
    await entered();
    if (shows_opening()) return void copy(await link(), "The link is copied: whoever opens it sees the same team.");
    if (!state.valid) return report("No link was copied: the config has problems. Correct them first.");
    if (!await remember()) return report("No link was copied: this browser cannot compress a config. Save config.toml instead.");
    const training = trained(), has = are_runs(training) ? "it has the settings of the first run, but not the runs"
      : training ? "whoever opens it sees the same generation of the same training"
        : state.mode === "watch" && state.exhibit ? "it has the settings, but not the teams on show" : "whoever opens it trains the same";
    copy(await link(), `The link is copied: ${has}.`);
  });
  $("png").addEventListener("click", save_png);
  $("gif").addEventListener("click", save_gif);
  $("webm").addEventListener("click", save_webm);
  $("csv").addEventListener("click", save_csv);
  $("open").addEventListener("click", () => $("file").click());
  $("file").addEventListener("change", () => { take_files([...$("file").files ?? []]); $("file").value = ""; });
  $("save").addEventListener("click", async () => { await entered(); save("config.toml", state.text, "text/plain"); });
  $("text").addEventListener("input", () => {
    lines();
    typing();
  });
  $("text").addEventListener("scroll", lines);
  $("config").addEventListener("toggle", lines);
  addEventListener("dragover", event => { event.preventDefault(); document.body.classList.add("dropping"); });
  addEventListener("dragleave", event => { if (!event.relatedTarget) document.body.classList.remove("dropping"); });
  addEventListener("drop", event => {
    event.preventDefault();
    document.body.classList.remove("dropping");
    if (event.dataTransfer) take_files([...event.dataTransfer.files]);
  });
  addEventListener("keydown", event => {
    if (event.key !== " " || /** @type {Element} */ (event.target).closest("button, input, select, textarea, summary, a")) return;
    // Where nothing plays or is paused, Space scrolls.
    const { training, mode } = state, going = training && training.state === "training";
    if (mode !== "watch" || !going && !moving().some(view => view.playing || view.place > 0 && view.place < end_of(view))) return;
    event.preventDefault();
    if (going) pause(); else replay();
  });
  const again = () => { state.views.forEach(draw); curves(); };
  addEventListener("resize", again);
  stage.night.addEventListener("change", again);
  addEventListener("popstate", go_back);
  addEventListener("hashchange", async () => {
    if (arrive()) return;
    leave_guide();
    await recall();
    await autoplay();
  });
}

// Without an address, the page opens on a trained team. Its motion waits for no worker.
const opens = location.hash.length <= 1;

// Shows the page once it shows what was asked for, so that nothing moves afterwards.
const appear = () => { document.body.dataset.shown = ""; };

async function start() {
  arrive();
  listen();
  gallery();
  if (opens) {
    $("text").value = text_of(OPENING);
    render({ text: text_of(OPENING), exhibit: OPENED });
    guide();
    appear();
  }
  try {
    [state.gpu] = await Promise.all([pool.gpu(), renew()]);
    const layout = async (/** @type {string} */ name) => [name, (await clerk.ask({ ask: "resolve", text: configs.layout(name), name, changes: [] })).words.config];
    state.layouts = Object.fromEntries(await Promise.all(configs.LAYOUTS.map(layout)));
    state.version = (await clerk.ask({ ask: "about" })).words.version;
    $("verify").disabled = !state.gpu.name;
    $("plain-label").hidden = !state.gpu.name;
    $("verified").textContent = state.gpu.name ? "Compares this browser's GPU with its CPU, bit for bit." : `There is no GPU to verify: ${state.gpu.reason}.`;
    option($("on"), "gpu").disabled = !state.gpu.name;
    // The settings become those of the opening, unless others were chosen meanwhile. Its episode goes on.
    if (!opens) await recall();
    else if (state.text === text_of(OPENING)) await take(state.text, { linked: false, keeps: true });
    appear();
    await settle();
  } catch (thrown) {
    $("machine").textContent = "";
    appear();
    return trouble("run", `This browser cannot run flotilla: ${failure(thrown).message}. It needs WebAssembly with SIMD, which browsers have had since 2023.`);
  }
  document.body.dataset.ready = "";
  await autoplay();
}

start();

window.page = { state, seek, take_files, configs, stage };
