// Workers that run flotilla, and the detection of a GPU.
import { $, Failure } from "./dom.js";

export const pool = (() => {
  /** @type {Promise<WebAssembly.Module> | null} */
  let compiled = null;
  /** @type {string | null} */
  let script = null;

  // The page contains the WebAssembly module, compressed. It is compiled once for all workers.
  async function compile() {
    const packed = await fetch(`data:application/octet-stream;base64,${$("wasm").textContent}`);
    const plain = /** @type {ReadableStream} */ (packed.body).pipeThrough(new DecompressionStream("deflate"));
    return WebAssembly.compile(await new Response(plain).arrayBuffer());
  }

  class Player {
    constructor() {
      /** @type {Map<number, { resolve(data: unknown): void, reject(failure: Failure): void }>} */
      this.asked = new Map();
      this.count = 0;
      this.failed = false;
      /** @type {(progress: { verified: number }) => void} */
      this.progress = () => {};
      script ??= URL.createObjectURL(new Blob([$("worker").textContent], { type: "text/javascript" }));
      this.worker = new Worker(script);
      this.worker.onerror = event => this.fail(event.message || "the worker could not be started");
      this.worker.onmessage = ({ data }) => {
        if (data.told) return data.told.panic ? this.fail(data.told.panic) : this.progress(data.told);
        const asked = this.asked.get(data.id);
        this.asked.delete(data.id);
        if (!asked) return;
        if (!data.words || !data.words.error) return asked.resolve(data);
        const failure = new Failure(data.words.error, data.words);
        asked.reject(failure);
        // A trap leaves the state of the module inconsistent.
        if (failure.fatal) this.end(failure);
      };
    }
    /** @param {string} reason */
    fail(reason) { this.end(new Failure(reason, { fatal: true })); }
    /** Terminates the worker. Its requests fail, including later ones. @param {Failure} failure */
    end(failure) {
      this.failed = true;
      this.worker.terminate();
      for (const { reject } of this.asked.values()) reject(failure);
      this.asked.clear();
    }
    /**
     * Buffers in `transferred` move to the worker, and cannot be used here afterwards.
     * @template {keyof Answers} K
     * @param {{ ask: K, [key: string]: unknown }} words @param {Bytes | Bytes[]} [bytes] @param {object} [more] @param {Transferable[]} [transferred]
     * @returns {Promise<{ words: Answers[K], bytes: Bytes }>}
     */
    ask(words, bytes, more = {}, transferred = []) {
      if (this.failed) return Promise.reject(new Failure("the worker has failed; try again", { fatal: true }));
      const id = this.count++;
      return new Promise((resolve, reject) => {
        this.asked.set(id, { resolve, reject });
        this.worker.postMessage({ id, words, bytes, ...more }, transferred);
      });
    }
    stop() { this.end(new Failure("stopped", { stopped: true })); }
  }

  // Starts a worker, and returns it once it accepts requests.
  async function open() {
    // The module comes after the script, and may still be on its way.
    if (document.readyState === "loading") await new Promise(done => document.addEventListener("DOMContentLoaded", done, { once: true }));
    // If compiling fails, the next worker tries again.
    compiled ??= compile().catch(thrown => { compiled = null; throw thrown; });
    const player = new Player();
    try {
      await player.ask({ ask: "start" }, undefined, { module: await compiled });
    } catch (thrown) {
      player.stop();
      throw thrown;
    }
    return player;
  }

  // Returns the name of the browser's GPU and whether it is a software renderer, or the reason why none can be used.
  /** @returns {Promise<Gpu>} */
  async function gpu() {
    if (!navigator.gpu) return { reason: "this browser has no WebGPU, or allows it only for pages from https or localhost" };
    if (typeof WebAssembly.Suspending !== "function") return { reason: "this browser cannot suspend WebAssembly, which is necessary to wait for a GPU" };
    const adapter = await navigator.gpu.requestAdapter().catch(() => null);
    if (!adapter) return { reason: "this browser offers no GPU" };
    const { vendor, architecture, device, description, isFallbackAdapter } = adapter.info;
    const name = description || [vendor, architecture, device].filter(Boolean).join(" ") || "GPU";
    return { name, software: isFallbackAdapter || /swiftshader|llvmpipe|software/i.test(`${architecture} ${description}`) };
  }

  return { open, gpu };
})();

/** The worker that answers requests while the players train. */
export const clerk = (() => {
  /** The player, once it is open. @type {Player | null} */
  let player = null;
  /** The same player, or one that is being opened. @type {Promise<Player> | null} */
  let opened = null;
  /** Ends when all work that goes first has ended. @type {Promise<unknown>} */
  let first = Promise.resolve();

  // Returns the player. Opens another one if it has failed or could not be opened.
  function working() {
    if (player && player.failed) opened = player = null;
    opened ??= pool.open().then(made => player = made, thrown => { opened = null; throw thrown; });
    return opened;
  }

  return {
    /**
     * Sends a request, like `Player.ask`.
     * @template {keyof Answers} K
     * @param {{ ask: K, [key: string]: unknown }} words @param {Bytes | Bytes[]} [bytes] @param {Transferable[]} [transferred]
     */
    ask: async (words, bytes, transferred) => (await working()).ask(words, bytes, {}, transferred),
    /** Starts work that makes many requests. Whoever awaits `is_free` makes none until the work ends. @template T @param {() => Promise<T>} work */
    put_first: work => {
      const made = work();
      first = Promise.allSettled([first, made]);
      return made;
    },
    is_free: () => first,
  };
})();
