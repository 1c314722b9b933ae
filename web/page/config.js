// Configs as text: the paper's layouts, changes of single keys, and encoding for links.
const configs = (() => {
  "use strict";
  const LAYOUTS = ["generally_forward", "strictly_forward", "chaotic"];
  const layout = name => document.getElementById(`layout-${name}`).textContent;

  // Returns the index at which a value that starts at `at` ends: at a comment or the end of a line, outside brackets.
  function end(text, at) {
    let depth = 0, quote = null;
    for (; at < text.length; at++) {
      const c = text[at];
      if (quote) { if (c === quote) quote = null; continue; }
      if (c === '"' || c === "'") quote = c;
      else if (c === "[") depth++;
      else if (c === "]") depth--;
      else if (c === "#") {
        if (depth === 0) break;
        at = text.indexOf("\n", at);
        if (at < 0) return text.length;
      } else if (c === "\n" && depth === 0) break;
    }
    return at;
  }

  // Returns the text with `key` set to `value` (as TOML). Comments are kept.
  function set(text, key, value) {
    const [section, leaf] = key.split(".");
    const header = new RegExp(`^[ \\t]*\\[${section}\\][ \\t]*(#.*)?$`, "m").exec(text);
    if (!header) return `${text.trimEnd()}\n\n[${section}]\n${leaf} = ${value}\n`;
    const from = header.index + header[0].length;
    const next = /^[ \t]*\[{1,2}[A-Za-z_.]+\]{1,2}[ \t]*(#.*)?$/m.exec(text.slice(from));
    const to = next ? from + next.index : text.length;
    const found = new RegExp(`^[ \\t]*${leaf}[ \\t]*=[ \\t]*`, "m").exec(text.slice(from, to));
    if (!found) return `${text.slice(0, from)}\n${leaf} = ${value}${text.slice(from)}`;
    const start = from + found.index + found[0].length, stop = end(text, start);
    const gap = text[stop] === "#" ? " ".repeat(Math.max(1, stop - start - value.length)) : "";
    return text.slice(0, start) + value + gap + text.slice(stop);
  }

  const positions = list => `[${list.map(([x, y]) => `[${decimal(x)}, ${decimal(y)}]`).join(", ")}]`;
  const decimal = value => Number.isInteger(value) ? value.toFixed(1) : String(value);

  // Texts in links are deflated and encoded as URL-safe base64.
  async function pack(text) {
    const packed = new Blob([text]).stream().pipeThrough(new CompressionStream("deflate-raw"));
    const bytes = new Uint8Array(await new Response(packed).arrayBuffer());
    return btoa(String.fromCharCode(...bytes)).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
  }
  async function unpack(word) {
    const bytes = Uint8Array.from(atob(word.replaceAll("-", "+").replaceAll("_", "/")), c => c.charCodeAt(0));
    const plain = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate-raw"));
    return new Response(plain).text();
  }

  return { LAYOUTS, layout, set, positions, pack, unpack };
})();
