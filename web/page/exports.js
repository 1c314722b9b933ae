// Pictures, films and tables of what is on show.
import { slug } from "./compare.js";
import { failure, pen_of } from "./dom.js";
import { name_of } from "./experiment.js";
import { clerk } from "./pool.js";
import { report, save, shown, state, trouble } from "./state.js";
import { csv } from "./table.js";
import { draw, end_of, hold, moving } from "./views.js";

// Most frames of a film, and its width in pixels per view.
const FRAMES = 80, WIDTH = 420;

const readable = (/** @type {HTMLCanvasElement} */ canvas) => pen_of(canvas, { willReadFrequently: true });

// Draws all views side by side, each with its title and state, onto a canvas.
/** @param {HTMLCanvasElement} canvas @param {number} wide */
function compose(canvas, wide) {
  const views = shown(), pen = readable(canvas), style = getComputedStyle(document.documentElement);
  const tall = Math.max(...views.map(view => wide * view.canvas.height / view.canvas.width)), scale = wide / WIDTH;
  const size = [Math.round(views.length * wide), Math.round(tall + 52 * scale)];
  if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
  pen.fillStyle = style.getPropertyValue("--card").trim();
  pen.fillRect(0, 0, size[0], size[1]);
  views.forEach((view, index) => {
    const left = index * wide, from = left + 6 * scale, room = wide - 12 * scale;
    pen.fillStyle = style.getPropertyValue("--ink").trim();
    pen.font = `600 ${15 * scale}px system-ui, sans-serif`;
    pen.fillText(view.title.textContent ?? "", from, 20 * scale, room);
    pen.font = `${13 * scale}px system-ui, sans-serif`;
    pen.fillText(view.status.textContent ?? "", from, 40 * scale, room);
    pen.drawImage(view.canvas, left, 50 * scale, wide, wide * view.canvas.height / view.canvas.width);
  });
}

const base = () => slug(`${name_of()}${state.training ? `-generation-${state.generation}-trial-${state.trial}` : ""}`);

export async function save_png() {
  if (!shown().length) return;
  const canvas = document.createElement("canvas");
  compose(canvas, shown()[0].canvas.width);
  /** @type {Blob | null} */
  const blob = await new Promise(done => canvas.toBlob(done, "image/png"));
  if (blob) save(`${base()}.png`, blob, "image/png");
}

// Calls `each` with the composed picture of every frame of the film, and then shows what was shown before.
/** @param {HTMLCanvasElement} canvas @param {(frame: number, many: number) => Promise<void>} each */
async function film(canvas, each) {
  const views = shown(), before = views.map(({ place, playing }) => ({ place, playing }));
  views.forEach(view => { view.playing = false; });
  const last = Math.max(...views.map(end_of)), many = Math.max(1, Math.min(FRAMES, 2 * last));
  for (let frame = 0; frame <= many; frame++) {
    const now = shown();
    if (now.length !== views.length || now.some((view, index) => view !== views[index])) throw new Error("other maps are on show now. Save it again");
    for (const view of views) {
      view.place = Math.min(end_of(view), frame / many * last);
      draw(view);
    }
    compose(canvas, WIDTH);
    await each(frame, many);
  }
  views.forEach((view, index) => { Object.assign(view, before[index]); draw(view); });
  return last;
}

// Simulated time per frame, in seconds, at least 1/25 s.
const pause_of = (/** @type {number} */ many) => {
  const [view] = shown(), whole = view.data.steps * view.data.dt;
  return Math.max(0.04, Math.min(whole, 8) / many);
};

let busy = false;
/** @param {() => Promise<void>} act */
async function one_at_a_time(act) {
  if (busy) return;
  if (!moving().length) return report("There is no film yet: nothing on the map moves. Train first.");
  busy = true;
  trouble("file", "");
  const made = act();
  hold(made.catch(() => {}));
  try { await made; } catch (thrown) { trouble("file", `The film could not be made: ${failure(thrown).message}`); } finally { busy = false; }
}

export const save_gif = () => one_at_a_time(async () => {
  report("Making the GIF…");
  const canvas = document.createElement("canvas"), pictures = /** @type {Bytes[]} */ ([]);
  let many = 1;
  await film(canvas, async (_, frames) => {
    many = frames;
    pictures.push(new Uint8Array(readable(canvas).getImageData(0, 0, canvas.width, canvas.height).data.buffer));
  });
  const delay = Math.round(100 * pause_of(many));
  const { bytes } = await clerk.ask({ ask: "gif", width: canvas.width, height: canvas.height, delay }, pictures, pictures.map(picture => picture.buffer));
  save(`${base()}.gif`, bytes, "image/gif");
});

export const save_webm = () => one_at_a_time(async () => {
  if (typeof MediaRecorder !== "function") throw new Error("this browser cannot record a canvas");
  report("Recording the film…");
  const canvas = document.createElement("canvas");
  compose(canvas, WIDTH);
  const recorder = new MediaRecorder(canvas.captureStream(25), { mimeType: "video/webm" }), parts = /** @type {Blob[]} */ ([]);
  recorder.ondataavailable = ({ data }) => parts.push(data);
  const stopped = new Promise(done => { recorder.onstop = done; });
  recorder.start();
  try {
    await film(canvas, (_, many) => new Promise(done => setTimeout(done, 1000 * pause_of(many))));
    await new Promise(done => setTimeout(done, 400));
  } finally { recorder.stop(); }
  await stopped;
  save(`${base()}.webm`, new Blob(parts, { type: "video/webm" }), "video/webm");
});

export function save_csv() {
  if (state.training) save(`${slug(name_of())}-curves.csv`, csv(state.training.arms), "text/csv");
  else report("There are no curves yet. Train first.");
}
