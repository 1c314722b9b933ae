// Configs as text: the paper's layouts, and encoding for links.
import { $ } from "./dom.js";

export const configs = (() => {
  const LAYOUTS = ["generally_forward", "strictly_forward", "chaotic"];
  const layout = (/** @type {string} */ name) => $(`layout-${name}`).textContent ?? "";

  const positions = (/** @type {number[][]} */ list) => `[${list.map(([x, y]) => `[${decimal(x)}, ${decimal(y)}]`).join(", ")}]`;
  const decimal = (/** @type {number} */ value) => Number.isInteger(value) ? value.toFixed(1) : String(value);

  // Texts in links are deflated and encoded as URL-safe base64.
  /** @param {string} text */
  async function pack(text) {
    const packed = new Blob([text]).stream().pipeThrough(new CompressionStream("deflate-raw"));
    const bytes = new Uint8Array(await new Response(packed).arrayBuffer());
    return btoa(Array.from(bytes, byte => String.fromCharCode(byte)).join("")).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
  }
  /** @param {string} word */
  async function unpack(word) {
    const bytes = Uint8Array.from(atob(word.replaceAll("-", "+").replaceAll("_", "/")), c => c.charCodeAt(0));
    const plain = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate-raw"));
    return new Response(plain).text();
  }

  return { LAYOUTS, layout, positions, pack, unpack };
})();
