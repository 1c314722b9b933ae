// The page's worker in Node, with its caller in the page's place.

import { readFileSync } from "node:fs";
import { inflateSync } from "node:zlib";

// What the page in this file carries: WebAssembly, the worker, the paper's layouts.
export function contents(page) {
  const html = readFileSync(page, "utf8");
  return id => html.split(`<script type="text/plain" id="${id}">`)[1].split("</script>")[0];
}

export class Player {
  static async of(text) {
    const player = new Player();
    player.asked = [];
    player.self = { postMessage: message => player.asked.shift()?.(message) };
    new Function("self", text("worker"))(player.self);
    const module = new WebAssembly.Module(inflateSync(Buffer.from(text("wasm"), "base64")));
    await player.ask({}, undefined, { module });
    return player;
  }

  async ask(words, bytes, more = {}) {
    const answered = new Promise(resolve => this.asked.push(resolve));
    this.self.onmessage({ data: { words, bytes, ...more } });
    const answer = await answered;
    if (answer.words?.error) throw new Error(answer.words.error);
    return answer;
  }
}
