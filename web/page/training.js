// A training of some arms, or runs that were opened. On the GPU, one worker trains everything as one batch. On the CPU, the trials are
// divided among the workers. The division does not change the results.

import { styles } from "./compare.js";

/** Milliseconds after which a player that waits asks again whether it may play. */
const REST = 40;

export class Training {
  /** @param {Planned[]} arms @param {Machine} machine */
  constructor(arms, machine) {
    const own = styles(arms.map(({ label }) => label));
    /** The text and the comparison that were trained. @type {{ text: string, compared: Comparison | null } | null} */
    this.source = null;
    /** The comparison of the arms, once it is made. @type {Found | null} */
    this.found = null;
    /** @type {Arm[]} */
    this.arms = arms.map((arm, index) => ({ ...arm, style: own[index], trials: Array.from({ length: arm.config.learning.trials }, () => []), ended: [] }));
    this.machine = machine;
    /** @type {Player[]} */
    this.players = [];
    /** The player of each trial. @type {Map<string, Player>} */
    this.owners = new Map();
    this.paused = false;
    this.state = "starting";
    this.teams = 0;
    /** Counts the changes of what is shown of the results. */
    this.version = 0;
    /** Seconds that each player has worked. @type {number[]} */
    this.busy = [];
    this.started = new Date().toISOString().replace(/\.\d+Z$/, "Z");
  }

  get last() { return Math.max(...this.arms.map(last_of)); }
  // Returns the last generation that all trials have finished, or -1.
  get reached() {
    return Math.min(...this.arms.map(arm => {
      const reached = Math.min(...arm.trials.map(trial => trial.length)) - 1;
      return reached >= last_of(arm) ? this.last : reached;
    }));
  }
  // Returns the number of POIs if it is the same in all arms and stages, otherwise null.
  get pois() { return this.arms.every(arm => arm.pois === this.arms[0].pois) ? this.arms[0].pois : null; }
  // Returns what is shown of a team: how many POIs it observes, or G if that does not count POIs.
  get unit() { return this.pois !== null ? "POIs" : this.arms.some(({ config }) => config.pois?.length) ? "share of the POIs' value" : "share of POIs"; }
  get rate() { return this.teams / Math.max(1e-9, Math.max(0, ...this.busy)); }

  /** Divides the trials among players, and starts the training. @param {Player[]} players */
  async start(players) {
    const tasks = this.arms.flatMap((arm, run) => arm.trials.map((_, trial) => [run, trial]));
    const whole = this.machine.backend === "gpu";
    this.players = whole ? players.slice(0, 1) : players.slice(0, Math.min(players.length, tasks.length));
    await Promise.all(this.players.map((player, index) => {
      const own = tasks.filter((_, task) => whole || task % this.players.length === index);
      for (const [run, trial] of own) this.owners.set(`${run}/${trial}`, player);
      const trials = (/** @type {number} */ run) => whole ? null : own.filter(([of]) => of === run).map(([, trial]) => trial);
      return player.ask({ ask: "train", runs: this.arms.map((arm, run) => ({ text: arm.toml, trials: trials(run) })) });
    }));
    this.busy = this.players.map(() => 0);
    // It may have been stopped meanwhile.
    if (this.state === "starting") this.state = "training";
  }

  /**
   * Trains until everything is finished or `stop` is called. `allowed` returns how many generations may be played so far. `changed` is
   * called when there are new results.
   * @param {() => number} allowed @param {() => void} changed
   */
  async play(allowed, changed) {
    const from = performance.now();
    let idle = 0;
    const work = async (/** @type {Player} */ player, /** @type {number} */ index) => {
      for (let next = 0; this.state === "training";) {
        const most = Math.floor(allowed()) - next;
        if (this.paused || most <= 0) {
          await new Promise(done => setTimeout(done, REST));
          idle += REST / this.players.length;
          continue;
        }
        const { words, bytes } = await player.ask({ ask: "advance", generations: Math.min(most, 1000), milliseconds: 40 });
        const numbers = new Float64Array(bytes.buffer), seconds = (performance.now() - from - idle) / 1000;
        for (let at = 0; at < numbers.length; at += 7) {
          const [run, trial, generation, best, mean, champion, test] = numbers.subarray(at, at + 7);
          this.arms[run].trials[trial][generation] = { best, mean, champion, test, seconds };
          const { world, learning } = this.arms[run].config;
          const { population, partners, hall_of_fame, paradigm, episodes_per_team, test_episodes } = learning;
          const learners = world.leaders.length + (paradigm === "all-leaders" ? world.followers.length : 0);
          // Generation 0 has no past champions.
          const past = hall_of_fame && generation > 0 ? learners : 0;
          this.teams += (population * ((partners ?? 1) + past) + 1) * episodes_per_team + test_episodes;
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

  // Makes each run's archive and digest. All policies may take much memory. Their buffers are therefore transferred
  // from worker to worker, and only the champions are kept here.
  async finish() {
    for (const [run, arm] of this.arms.entries()) {
      const answers = await Promise.all(this.players.map(player => player.ask({ ask: "ends", run })));
      const trials = answers.flatMap(({ words, bytes }) => {
        let at = 0;
        return words.map(({ trial, policies, numbers }) => {
          const part = bytes.subarray(at, at += 4 * numbers);
          return { trial, part, champions: champions(arm, part, policies) };
        });
      }).sort((a, b) => a.trial - b.trial);
      arm.ended = trials.map(({ champions }) => champions);
      await this.record(arm, trials, answers.map(({ bytes }) => bytes.buffer));
    }
    this.state = "done";
  }

  /**
   * Makes the archive and the digest of a run.
   * @param {Arm} arm @param {{ part: Bytes }[]} ended @param {ArrayBuffer[]} buffers
   */
  async record(arm, ended, buffers) {
    const { trials, toml: text, command } = arm, last = arm.config.learning.generations;
    const rows = new Float64Array((last + 1) * trials.length * 8);
    let at = 0;
    for (let generation = 0; generation <= last; generation++) {
      let latest = 0;
      for (const trial of trials) latest = Math.max(latest, trial[generation].seconds);
      for (let trial = 0; trial < trials.length; trial++) {
        const { best, mean, champion, test } = trials[trial][generation];
        for (const value of [0, trial, generation, best, mean, champion, test, latest]) rows[at++] = value;
      }
    }
    const { description, backend, adapter, driver, threads } = this.machine;
    const { words, bytes: zip } = await this.players[0].ask({
      ask: "record", name: `${arm.name}-${arm.label}`.replaceAll("++", "pp").replace(/[^\w.-]+/g, "-"), text, command, description, backend, adapter, driver, threads,
      started: this.started, rows: rows.length / 8,
    }, [new Uint8Array(rows.buffer), ...ended.map(({ part }) => part)], {}, [rows.buffer, ...buffers]);
    Object.assign(arm, { digest: words.digest, zip });
  }

  /** Makes a finished training of opened runs, each as an arm. @param {Player} player @param {Machine} machine @param {Opened[]} opened */
  static async read(player, machine, opened) {
    const training = new Training(opened.map(({ name, label, words }) => {
      const { toml, config, pois, parameters, digest } = words;
      return { name, label, toml, config, pois, parameters, digest, constant: null, random: [] };
    }), machine);
    opened.forEach(({ words, bytes }, run) => {
      const own = training.arms[run], numbers = new Float64Array(bytes.buffer, bytes.byteOffset, words.rows * 8);
      for (let at = 0; at < numbers.length; at += 8) {
        const [, trial, generation, best, mean, champion, test, seconds] = numbers.subarray(at, at + 8);
        own.trials[trial][generation] = { best, mean, champion, test, seconds };
      }
      const start = words.rows * 64, size = (bytes.byteLength - start) / own.trials.length;
      own.trials.forEach((_, trial) => { own.ended[trial] = champions(own, bytes.subarray(start + trial * size, start + (trial + 1) * size), size / 4); });
    });
    await training.revive(player);
    training.state = "done";
    return training;
  }

  /** Lets a player replay all generations, after it or others played something else. @param {Player} player */
  async revive(player) {
    this.players = [player];
    this.arms.forEach((arm, run) => arm.trials.forEach((_, trial) => this.owners.set(`${run}/${trial}`, player)));
    await player.ask({ ask: "train", runs: this.arms.map(({ toml }) => ({ text: toml, trials: [] })) });
  }

  /**
   * Returns the episode of the champion of a generation of a trial, for display. A run that ended before that generation gives its last.
   * @param {number} run @param {number} trial @param {number} generation
   */
  async champion(run, trial, generation) {
    const player = this.owners.get(`${run}/${trial}`);
    if (!player) throw new Error(`there is no trial ${trial}`);
    const { words } = await player.ask({ ask: "champion", run, trial, generation });
    // Training here starts from random policies. A run from a file may have started from given ones, or be from another
    // version.
    const [episode] = words.episodes, recorded = this.arms[run].trials[trial][episode.generation];
    if (recorded && recorded.champion !== episode.team_g) throw new Error(`Generation ${episode.generation} cannot be replayed: it gives G = ${episode.team_g} here, and the run has ${recorded.champion}. The run started from given policies, or another version made it.`);
    return words;
  }

  stop() { if (this.state !== "done") this.state = "stopped"; }
}

/** Returns the last generation of an arm. @param {{ config: Config }} arm */
export const last_of = ({ config }) => config.learning.generations;

/**
 * Returns the first policy of each population. `bytes` start with `numbers` f32, `[populations][policies][parameters]`.
 * @param {Arm} arm @param {Uint8Array} bytes @param {number} numbers
 */
function champions({ config, parameters }, bytes, numbers) {
  const each = 4 * config.learning.population * parameters, many = numbers * 4 / each, own = new Uint8Array(many * 4 * parameters);
  for (let at = 0; at < many; at++) own.set(bytes.subarray(at * each, at * each + 4 * parameters), at * 4 * parameters);
  return own;
}
