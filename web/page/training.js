// One training of one or two arms: on the GPU all of it as one batch by one worker, on the CPU trial by trial by as many
// workers as there are cores. Which of them plays what changes no bit.
class Training {
  constructor(arms, machine) {
    this.arms = arms.map(arm => ({ ...arm, trials: Array.from({ length: arm.config.learning.trials }, () => []), ended: [] }));
    this.machine = machine;
    this.players = [];
    this.owners = new Map();
    this.paused = false;
    this.state = "starting";
    this.teams = 0;
    this.busy = [];
    this.started = new Date().toISOString().replace(/\.\d+Z$/, "Z");
  }

  get last() { return Math.max(...this.arms.map(arm => arm.config.learning.generations)); }
  // The generation that all trials have reached.
  get reached() { return Math.min(...this.arms.flatMap(arm => arm.trials.map(trial => trial.length))) - 1; }
  get rate() { return this.teams / Math.max(1e-9, Math.max(0, ...this.busy)); }

  // Divides the work among players, and starts it.
  async start(players) {
    const tasks = this.arms.flatMap((arm, run) => arm.trials.map((_, trial) => [run, trial]));
    const whole = this.machine.backend === "gpu";
    this.players = whole ? players.slice(0, 1) : players.slice(0, Math.min(players.length, tasks.length));
    await Promise.all(this.players.map((player, index) => {
      const own = tasks.filter((_, task) => whole || task % this.players.length === index);
      for (const [run, trial] of own) this.owners.set(`${run}/${trial}`, player);
      const trials = run => whole ? null : own.filter(([of]) => of === run).map(([, trial]) => trial);
      return player.ask({ ask: "train", runs: this.arms.map((arm, run) => ({ text: arm.toml, trials: trials(run) })) });
    }));
    this.busy = this.players.map(() => 0);
    this.state = "training";
  }

  // Plays on until all is done or it is stopped; `allowed` tells up to which generation, `changed` is told of news.
  async play(allowed, changed) {
    const from = performance.now();
    let idle = 0;
    const work = async (player, index) => {
      for (let next = 0; this.state === "training";) {
        const most = Math.floor(allowed()) - next;
        if (this.paused || most <= 0) {
          await new Promise(done => setTimeout(done, 15));
          idle += 15 / this.players.length;
          continue;
        }
        const { words, bytes } = await player.ask({ ask: "advance", generations: Math.min(most, 1000), milliseconds: 40 });
        const numbers = new Float64Array(bytes.buffer), seconds = (performance.now() - from - idle) / 1000;
        for (let at = 0; at < numbers.length; at += 6) {
          const [run, trial, generation, best, mean, champion] = numbers.subarray(at, at + 6);
          this.arms[run].trials[trial][generation] = { best, mean, champion, seconds };
          const { population, episodes_per_team } = this.arms[run].config.learning;
          this.teams += (population + 1) * episodes_per_team;
        }
        this.busy[index] += words.seconds;
        next = words.next;
        changed();
        if (words.done) return;
      }
    };
    await Promise.all(this.players.map(work));
    if (this.state === "training") await this.finish();
    changed();
  }

  // Brings home what came out, and its digest.
  async finish() {
    for (const player of this.players) {
      const { words, bytes } = await player.ask({ ask: "ends" });
      let at = bytes.byteOffset;
      for (const { run, trial, policies, fitness, pending } of words) {
        const take = count => { const part = new Float32Array(bytes.buffer, at, count); at += 4 * count; return part; };
        this.arms[run].ended[trial] = { policies: take(policies), fitness: take(fitness), pending };
      }
    }
    await Promise.all(this.arms.map(arm => this.record(arm)));
    this.state = "done";
  }

  async record(arm) {
    const { trials, ended } = arm, rows = [];
    for (let generation = 0; generation <= arm.config.learning.generations; generation++) {
      const seconds = Math.max(...trials.map(trial => trial[generation].seconds));
      trials.forEach((trial, index) => {
        const { best, mean, champion } = trial[generation];
        rows.push(0, index, generation, best, mean, champion, seconds);
      });
    }
    const parts = ended.flatMap(({ policies, fitness }) => [policies, fitness]);
    const bytes = new Uint8Array(rows.length * 8 + parts.reduce((sum, part) => sum + part.byteLength, 0));
    bytes.set(new Uint8Array(Float64Array.from(rows).buffer));
    let at = rows.length * 8;
    for (const part of parts) { bytes.set(new Uint8Array(part.buffer, part.byteOffset, part.byteLength), at); at += part.byteLength; }
    const { description, backend, adapter, driver, threads } = this.machine;
    const { words, bytes: zip } = await this.players[0].ask({
      ask: "record", text: arm.toml, command: arm.command, description, backend, adapter, driver, threads,
      started: this.started, rows: rows.length / 7, pending: ended.map(({ pending }) => pending),
    }, bytes);
    Object.assign(arm, { digest: words.digest, zip });
  }

  // A run from a file, that nothing is left to do of.
  static async read(player, machine, name, { words, bytes }) {
    const arm = { name, label: words.config.learning.paradigm, toml: words.toml, config: words.config, digest: words.digest };
    const training = new Training([arm], machine), [own] = training.arms;
    const numbers = new Float64Array(bytes.buffer, bytes.byteOffset, words.rows * 7);
    for (let at = 0; at < numbers.length; at += 7) {
      const [, trial, generation, best, mean, champion, seconds] = numbers.subarray(at, at + 7);
      own.trials[trial][generation] = { best, mean, champion, seconds };
    }
    const size = (bytes.byteLength - words.rows * 56) / 4 / own.trials.length;
    own.trials.forEach((_, trial) => {
      const start = bytes.byteOffset + words.rows * 56 + trial * size * 4;
      own.ended[trial] = { policies: new Float32Array(bytes.buffer.slice(start, start + size * 4)) };
      training.owners.set(`0/${trial}`, player);
    });
    training.players = [player];
    await player.ask({ ask: "train", runs: [{ text: words.toml, trials: [] }] });
    training.state = "done";
    return training;
  }

  // The best team of a generation of a trial, as a page shows it; the one that is at hand where none is named.
  async best(run, trial, generation) {
    const { words } = await this.owners.get(`${run}/${trial}`).ask({ ask: "best", run, trial, generation });
    return stage.unpack(words);
  }

  stop() { if (this.state !== "done") this.state = "stopped"; }
}
