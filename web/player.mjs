// Runs the page's worker in Node, for tests.

import { readFileSync } from "node:fs";
import { inflateSync } from "node:zlib";

// Returns a function from ids to the texts embedded in the page: WebAssembly, the worker, and layouts.
export function contents(page) {
  const html = readFileSync(page, "utf8");
  return id => html.split(`<script type="text/plain" id="${id}">`)[1].split("</script>")[0];
}

// Sends questions to the worker and waits for its answers, like the page.
export class Player {
  static async start(text) {
    const player = new Player();
    player.waiting = [];
    player.self = { postMessage: message => player.waiting.shift()?.(message) };
    new Function("self", text("worker"))(player.self);
    const module = new WebAssembly.Module(inflateSync(Buffer.from(text("wasm"), "base64")));
    await player.ask({}, undefined, { module });
    return player;
  }

  async ask(words, bytes, more = {}) {
    const answered = new Promise(resolve => this.waiting.push(resolve));
    this.self.onmessage({ data: { words, bytes, ...more } });
    const answer = await answered;
    if (answer.words?.error) throw new Error(answer.words.error);
    return answer;
  }
}
