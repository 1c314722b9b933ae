// The page: its state, its views, and its event listeners.
const page = (() => {
  const $ = id => document.getElementById(id);
  const make = (name, text = "", parent = null, more = {}) => {
    const element = Object.assign(document.createElement(name), more);
    if (text !== "") element.textContent = text;
    if (parent) parent.append(element);
    return element;
  };
  const still = matchMedia("(prefers-reduced-motion: reduce)");
  const number = value => String(Number(value.toFixed(3)));
  const count = (many, what) => `${many} ${what}${many === 1 ? "" : "s"}`;
  const NAMES = { "leader-follower": "Leader-follower: leaders learn, followers follow", "all-leaders": "All-leaders: every agent learns" };
  const TONES = { "leader-follower": "--leader-follower", "all-leaders": "--all-leaders" };
  // Controls that set a key of the config.
  const KEYS = { fitness: "learning.fitness", coupling: "world.coupling", seed: "learning.seed", generations: "learning.generations", trials: "learning.trials", population: "learning.population" };
  const quote = key => key === "fitness" ? value => `"${value}"` : value => String(value);

  const state = {
    text: "", config: null, toml: null, pois: 4, both: true, file: null, mode: "watch",
    training: null, follow: true, generation: 0, trial: 0, views: [], gpu: {}, machine: null, settled: null, players: [], policies: null,
    // `clerk`: the worker that answers requests while the players train. `valid`: whether the text is a valid config.
    // `past`: earlier texts, for undo.
    clerk: null, valid: false, past: [],
  };

  // ---- Configs ----

  // Makes a text the config. If it is invalid, shows its problems and returns false.
  let newest = 0;
  async function take(text, { edited = false, address = true } = {}) {
    const turn = ++newest;
    state.text = text;
    if (!edited) $("text").value = text;
    let resolved;
    try {
      resolved = (await state.clerk.ask({ ask: "resolve", text, name: "config.toml", changes: [] })).words;
    } catch (error) {
      if (turn === newest) { mark(error.problems, error.message); $("train").disabled = true; state.valid = false; }
      return false;
    }
    if (turn !== newest) return false;
    mark([]);
    Object.assign(state, { config: resolved.config, toml: resolved.toml, pois: resolved.pois, valid: true });
    $("train").disabled = false;
    fill();
    if (address) remember();
    stale();
    return true;
  }

  // Sets keys of the config, and keeps its comments if possible. Changes run one after the other.
  let changing = Promise.resolve();
  const change = changes => (changing = changing.catch(() => {}).then(() => change_now(changes)));
  async function change_now(changes) {
    let text = state.text;
    keep();
    for (const [key, value] of changes) text = configs.set(text, key, value);
    try {
      const [plain, wanted] = await Promise.all([
        state.clerk.ask({ ask: "resolve", text, name: "config.toml", changes: [] }),
        state.clerk.ask({ ask: "resolve", text: state.text, name: "config.toml", changes }),
      ]);
      if (plain.words.toml !== wanted.words.toml) text = wanted.words.toml;
    } catch { /* What is wrong is shown with the text. */ }
    return take(text);
  }

  // Saves the current text for undo.
  function keep() {
    if (state.past.at(-1)?.text !== state.text) state.past.push({ text: state.text, file: state.file });
    if (state.past.length > 100) state.past.shift();
    $("undo").disabled = false;
  }

  async function undo() {
    let last;
    do last = state.past.pop(); while (last && last.text === state.text);
    $("undo").disabled = state.past.length === 0;
    if (!last) return;
    state.file = last.file;
    await take(last.text);
  }

  // Shows a note if the results were trained with settings that differ from those in the form.
  function stale() {
    const { training } = state, differs = training && training.source && (training.source.text !== state.text || training.source.both !== state.both);
    $("stale").hidden = !differs;
    if (!differs) return;
    const { fitness, seed, population, generations } = training.arms[0].config.learning;
    $("stale").textContent = `The results below were trained with other settings: fitness ${fitness}, seed ${seed}, population ${population}, ${generations} generations. Train again to see the present ones.`;
  }

  // Edits are applied after a delay. `entered` applies pending ones at once, so that what follows uses them.
  let typed = null;
  const type = () => { typed = null; return take($("text").value, { edited: true }); };
  async function entered() {
    if (typed !== null) { clearTimeout(typed); await type(); }
    await changing;
  }

  // Sets the controls to the values of the config.
  function fill() {
    const { learning, world } = state.config;
    for (const id of ["seed", "generations", "trials", "population"]) $(id).value = learning[id];
    $("fitness").value = learning.fitness;
    const each = Array.isArray(world.coupling);
    $("coupling").value = each ? "" : world.coupling;
    $("coupling").placeholder = each ? "each" : "";
    $("paradigm").value = state.both ? "both" : learning.paradigm;
    const layout = configs.LAYOUTS.find(name => same_world(name));
    $("layout").querySelector("[value=own]").hidden = Boolean(layout);
    $("layout").value = layout || "own";
    if (!state.training || state.mode === "arrange") show_start();
    options();
  }

  // `plain` removes the keys that have a command-line flag. `same_world` compares the rest with a layout.
  const plain = text => text.split("\n").filter(line => !/^\s*(paradigm|fitness|seed|trials|generations|population)\s*=/.test(line)).join("\n");
  const same_world = name => plain(state.text) === plain(configs.layout(name));

  function mark(problems, message = "") {
    $("marks").replaceChildren();
    $("problems").replaceChildren();
    $("text").setAttribute("aria-invalid", problems.length > 0);
    for (const { line, key, message } of problems) {
      const item = make("li", "", $("problems")), words = `${key ? key + ": " : ""}${message}`;
      const button = make("button", line ? `Line ${line}: ${words}` : words, item, { type: "button" });
      button.addEventListener("click", () => go_to(line || 1));
      if (line) {
        const place = make("div", "", $("marks"), { className: "mark" });
        place.dataset.line = line;
        make("span", words, place);
      }
    }
    trouble(problems.length ? `The config cannot be used: ${count(problems.length, "problem")}, beside its lines below.` : message);
    if (problems.length || message) $("config").open = true;
    lines();
  }

  function go_to(line) {
    const from = $("text").value.split("\n").slice(0, line - 1).join("\n").length + (line > 1 ? 1 : 0);
    $("text").focus();
    $("text").setSelectionRange(from, from);
    $("text").scrollTop = Math.max(0, (line - 6) * 20);
    lines();
  }

  function lines() {
    const many = $("text").value.split("\n").length;
    $("lines").textContent = Array.from({ length: many }, (_, line) => line + 1).join("\n");
    $("lines").scrollTop = $("text").scrollTop;
    for (const place of $("marks").children) place.style.top = `${8 + (place.dataset.line - 1) * 20 - $("text").scrollTop}px`;
  }

  function trouble(message) {
    $("trouble").textContent = message;
    $("trouble").hidden = !message;
  }

  // ---- The address ----

  let remembered = 0;
  async function remember() {
    const turn = ++remembered, words = new URLSearchParams(), layout = $("layout").value;
    if (layout === "own") {
      // If the browser cannot compress, there is no link. The rest of the page works.
      try { words.set("config", await configs.pack(state.text)); } catch { return; }
    } else {
      words.set("layout", layout);
      for (const id of Object.keys(KEYS).filter(id => id !== "coupling")) words.set(id, $(id).value);
    }
    words.set("learners", state.both ? "both" : state.config.learning.paradigm);
    if ($("on").value !== "auto") words.set("on", $("on").value);
    if ($("pace").value !== "watch") words.set("pace", $("pace").value);
    if (turn === remembered) history.replaceState(null, "", `#${words}`);
  }

  // Opens the experiment in the address. Reports the parts that cannot be read, and then leaves the address unchanged.
  async function recall() {
    const words = new URLSearchParams(location.hash.slice(1)), unknown = [];
    for (const id of ["on", "pace"]) {
      const value = words.get(id);
      if ([...$(id).options].some(option => option.value === value)) $(id).value = value;
      else if (value !== null) unknown.push(`${id}=${value}`);
    }
    const layout = words.get("layout");
    if (layout !== null && !configs.LAYOUTS.includes(layout)) unknown.push(`layout=${layout}`);
    let text = configs.layout(configs.LAYOUTS.find(name => name === layout) || "generally_forward");
    if (words.has("config")) {
      try { text = await configs.unpack(words.get("config")); } catch { unknown.push("config"); }
    } else {
      for (const [id, key] of Object.entries(KEYS)) if (words.has(id)) text = configs.set(text, key, quote(id)(words.get(id)));
    }
    const learners = words.get("learners"), known = learners !== null && Object.hasOwn(NAMES, learners);
    if (learners !== null && learners !== "both" && !known) unknown.push(`learners=${learners}`);
    state.both = !known;
    if (known) text = configs.set(text, "learning.paradigm", `"${learners}"`);
    const damage = unknown.length ? `This link is damaged: ${unknown.join(", ")} cannot be read. Ask for a new link; what you see is not what it was made for.` : "";
    const taken = await take(text, { address: !damage });
    if (!taken && !state.config) {
      // Show a map even if the config in the link is invalid.
      await take(configs.layout("generally_forward"), { address: false });
      await take(text);
    }
    if (damage) trouble(damage);
  }

  // ---- Players ----

  // Opens the chosen backend, or the CPU if no GPU is exact. `auto` also ignores software renderers.
  async function settle() {
    const wanted = $("on").value, { gpu } = state;
    if (state.settled === wanted) return;
    let why = "";
    if (wanted === "gpu" || wanted === "auto" && gpu.name && !gpu.software) {
      try {
        if (!gpu.name) throw new Error(gpu.reason);
        $("machine").textContent = `Testing ${gpu.name} for exactness…`;
        state.machine = (await state.players[0].ask({ ask: "open", gpu: true, pass: null })).words;
        state.machine.adapter = gpu.name;
        state.machine.description = `${gpu.name} by WebGPU${gpu.software ? ", a software renderer" : ""}, proved exact`;
        state.settled = wanted;
        return told();
      } catch (error) { why = error.message; }
    } else if (wanted === "auto") why = gpu.software ? `this browser's GPU is a software renderer, ${gpu.name}` : gpu.reason;
    state.machine = (await state.players[0].ask({ ask: "open", gpu: false, pass: null })).words;
    state.machine.threads = state.players.length;
    state.machine.why = why;
    state.settled = wanted;
    told();
  }

  function told() {
    const { training, machine } = state, workers = machine.backend === "cpu" ? `${machine.description.replace(/, \d+ threads?/, "")} in ${count(state.players.length, "worker")}` : machine.description;
    const speed = training && training.teams ? ` · ${Math.round(training.rate).toLocaleString("en")} teams a second` : "";
    $("machine").textContent = `Runs on ${workers}${speed}${machine.why ? ` (${machine.why})` : ""}`;
  }

  // Replaces the players, for example after they stopped responding.
  async function renew() {
    const many = Math.max(1, Math.min(16, navigator.hardwareConcurrency || 2)), old = state.players;
    [state.clerk, ...state.players] = await Promise.all([state.clerk || pool.open(), ...Array.from({ length: many }, () => pool.open())]);
    state.settled = null;
    old.forEach(player => player.stop());
  }

  // ---- Training ----

  let starting = false;
  async function train() {
    if (starting) return;
    starting = true;
    const busy = state.training && ["starting", "training"].includes(state.training.state);
    if (state.training) state.training.stop();
    trouble("");
    mode("watch");
    $("digests").replaceChildren();
    $("announced").textContent = "";
    let training;
    try {
      // A worker that still plays a long generation would delay the new training.
      if (busy) await renew();
      await entered();
      if (!state.valid) return;
      await settle();
      const paradigms = state.both && state.config.world.followers.length ? ["leader-follower", "all-leaders"] : [state.config.learning.paradigm];
      const arms = await Promise.all(paradigms.map(async paradigm => {
        const changes = [["learning.paradigm", `"${paradigm}"`]];
        const { words } = await state.clerk.ask({ ask: "resolve", text: state.text, name: "config.toml", changes });
        return { bytes: words.bytes, label: paradigm, toml: words.toml, config: words.config, pois: words.pois, parameters: words.parameters, command: command(words.config), name: name_of() };
      }));
      const bytes = arms.reduce((sum, arm) => sum + arm.bytes, 0);
      if (bytes > 3 * 2 ** 30) throw new Error(`This takes ${(bytes / 2 ** 30).toFixed(1)} GiB, and a tab has at most 4. Choose a smaller population, fewer trials or one paradigm, or use the command line.`);
      training = state.training = new Training(arms, state.machine);
      training.source = { text: state.text, both: state.both };
      Object.assign(state, { generation: 0, trial: 0, policies: null });
      following(true);
      build(training);
      await training.start(state.players);
    } catch (error) {
      if (error.fatal) await renew();
      trouble(error.message);
      return;
    } finally { starting = false; }
    stale();
    controls();
    // For watching, the pace is limited to `last / 8` generations per second, but at least 1. Pauses do not count.
    let shown = 0, clock = performance.now(), dirty = true, news = clock;
    const allowed = () => {
      const now = performance.now(), each = training.last / 8;
      if (!training.paused) shown += (now - clock) / 1000 * Math.max(1, each);
      clock = now;
      return $("pace").value === "full" ? Infinity : shown + 1;
    };
    const paint = () => {
      if (state.training !== training) return;
      if (dirty) { dirty = false; news = performance.now(); curves(); follow(); }
      const silent = (performance.now() - news) / 1000;
      if (silent > 2 && !training.paused && training.state === "training" && training.reached < training.last) {
        $("generation").textContent = `generation ${training.reached + 1} of ${training.last}: ${Math.round(silent)} s so far`;
      }
      if (training.state === "training" || training.state === "starting") requestAnimationFrame(paint);
    };
    requestAnimationFrame(paint);
    try {
      await training.play(allowed, () => { dirty = true; });
    } catch (error) {
      if (!error.stopped && state.training === training) {
        training.stop();
        if (error.fatal || state.machine.backend === "gpu") await renew();
        trouble(`${error.message}\nTraining stopped there. ${state.machine.backend === "gpu" ? "Train again, on the CPU if need be: it comes to the same." : "Train again: it comes to the same."}`);
      }
    }
    if (state.training !== training) return;
    controls();
    curves();
    follow();
    told();
    if (training.state === "done") {
      digests();
      const found = training.arms.map(arm => {
        const last = arm.trials.map(trial => trial.at(-1).best), mean = last.reduce((sum, best) => sum + best, 0) / last.length;
        return `${arm.label} observes ${(mean * (arm.pois ?? 1)).toFixed(2)} ${arm.pois === null ? "of its POIs (a share)" : `of ${arm.pois} POIs`}`;
      });
      $("announced").textContent = `Training is finished. On average over trials, the best team of ${found.join("; ")}.`;
    }
  }

  // Stops a training. The generations played so far can still be watched.
  function stop() {
    const { training } = state;
    if (!training || training.state !== "training") return;
    training.stop();
    controls();
    $("announced").textContent = `Stopped after generation ${Math.max(0, training.reached)}.`;
  }

  // Discards a training and its results.
  function forget() {
    if (state.training) state.training.stop();
    Object.assign(state, { training: null, policies: null });
    $("digests").replaceChildren();
    $("scrub").value = 0;
    $("generation").textContent = "";
    $("announced").textContent = "";
    $("trial").replaceChildren();
    clear();
    controls();
    stale();
  }

  const name_of = () => state.file || ($("layout").value === "own" ? "config" : $("layout").value);

  // Returns the command that gives the same results.
  function command({ learning }) {
    const layout = $("layout").value;
    if (layout === "own") return `flotilla train ${name_of()}.toml --paradigm ${learning.paradigm}`;
    const flags = ["paradigm", "fitness", "seed"].map(key => `--${key} ${learning[key]}`);
    const base = /^\s*(generations|trials|population)\s*=\s*(\d+)/gm, given = Object.fromEntries([...configs.layout(layout).matchAll(base)].map(found => [found[1], Number(found[2])]));
    for (const key of ["generations", "trials", "population"]) if (given[key] !== learning[key]) flags.push(`--${key} ${learning[key]}`);
    return `flotilla train configs/${layout}.toml ${flags.join(" ")}`;
  }

  function digests() {
    $("digests").replaceChildren();
    for (const arm of state.training.arms) {
      const place = make("div", "", $("digests"), { className: "digest" });
      const head = make("div", "", place, { className: "row" });
      make("b", `${arm.label}:`, head);
      make("code", arm.digest, head, { className: "sha" });
      if (arm.command) make("code", arm.command, place);
      const acts = make("div", "", place, { className: "row" });
      if (arm.zip) make("button", `Save the ${arm.label} run (.zip)`, acts, { type: "button", className: "home" }).addEventListener("click", () => save(`${arm.name}-${arm.label}.zip`, arm.zip, "application/zip"));
      const { source } = state.training;
      if (source && arm.command && !arm.command.includes(" configs/")) {
        make("button", `Save ${arm.name}.toml`, acts, { type: "button" }).addEventListener("click", () => save(`${arm.name}.toml`, source.text, "text/plain"));
      }
      if (arm.command) make("button", "Copy the command", acts, { type: "button" }).addEventListener("click", () => copy(arm.command, "The command is copied: it comes to the same digest."));
    }
  }

  function save(name, content, type) {
    const link = make("a", "", document.body, { href: URL.createObjectURL(new Blob([content], { type })), download: name });
    link.click();
    link.remove();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    $("said").textContent = `${name} is saved.`;
  }

  async function copy(text, said) {
    try {
      await navigator.clipboard.writeText(text);
      $("said").textContent = said;
    } catch { $("said").textContent = `This browser does not let a page copy. Here it is: ${text}`; }
  }

  // ---- Views ----

  // Returns the part of the map that contains all POIs and every place that agents can reach in an episode.
  function reach({ world, motion }) {
    const far = world.steps * world.dt * motion.max_speed + 2, [width, height] = world.map;
    const starts = [...world.leaders, ...world.followers].map(place => [...place, far]);
    const all = [...starts, ...world.pois.map(place => [...place, world.observation_radius + 1])];
    const side = (axis, sign) => all.map(place => place[axis] + sign * place[2]);
    // A margin beyond the walls, so that agents at a wall are drawn whole.
    const low = axis => Math.max(-1.5, Math.min(...side(axis, -1))), high = (axis, end) => Math.min(end + 1.5, Math.max(...side(axis, 1)));
    let [left, below, right, above] = [low(0), low(1), high(0, width), high(1, height)];
    const least = (right - left) * 0.42;
    if (above - below < least) { above = Math.min(height + 1.5, below + least); below = Math.max(-1.5, above - least); }
    return [left, below, right, above];
  }

  function view(label) {
    const card = make("section", "", $("views"), { className: "card" });
    const head = make("h2", "", card);
    const dash = make("span", "", head, { className: `key${label === "all-leaders" && state.views.length ? " dashed" : ""}` });
    dash.style.color = `var(${TONES[label]})`;
    const title = make("span", NAMES[label] || label, head);
    const said = make("p", "", card, { role: "status" });
    said.setAttribute("aria-live", "off");
    const canvas = make("canvas", "", card);
    canvas.setAttribute("role", "img");
    const made = { label, card, title, said, canvas, data: null, place: 0, playing: false, over: null, wanted: null, asking: false, crop: [0, 0, 1, 1] };
    canvas.addEventListener("pointermove", event => pointed(made, event));
    canvas.addEventListener("pointerleave", () => { made.over = null; draw(made); });
    state.views.push(made);
    return made;
  }

  function build(training) {
    clear();
    for (const arm of training.arms) Object.assign(view(arm.label), { crop: reach(arm.config) });
    $("views").classList.toggle("one", training.arms.length === 1);
    const [arm] = training.arms;
    $("trial").replaceChildren(...arm.trials.map((_, trial) => make("option", String(trial))));
    $("scrub").max = training.last;
    $("scrub").value = 0;
  }

  function clear() {
    state.views = [];
    $("views").replaceChildren();
  }

  function draw(view) {
    if (!view.data) return;
    const { data } = view, [episode] = data.episodes;
    const look = { crop: view.crop, trails: $("trails").checked, radii: $("radii").checked, groups: true, over: view.over };
    const { step, positions } = stage.paint(data, episode, view.canvas, view.place, look);
    view.drawn = positions;
    if (view === state.views[0]) steps(view);
    const [observed, said] = stage.say(episode, step);
    if (view.tell) view.tell(step, observed, said);
    else {
      const end = number(episode.g * data.pois.length);
      view.said.textContent = `generation ${episode.generation}, trial ${episode.trial} · ${observed} of ${data.pois.length} POIs by step ${step} · ends at ${end}`;
      view.canvas.setAttribute("aria-label", `${NAMES[view.label]}: the best team of generation ${episode.generation}, step ${step}: ${said}`);
    }
    if (view.chosen) ring(view);
  }

  // Plays an episode from its start, or shows its end if `moving` is false. Visitors who prefer reduced motion also see
  // the end, unless they asked to play it.
  function show(view, data, moving = true, asked = false) {
    const last = data.episodes[0].shown.length - 1;
    const plays = moving && (asked || !still.matches), [left, below, right, above] = view.crop;
    // Stages and jitter may move POIs out of the view.
    if (data.pois.some(([x, y]) => x < left || x > right || y < below || y > above)) view.crop = stage.whole(data);
    Object.assign(view, { data, place: plays ? 0 : last, playing: plays, ended: plays ? null : performance.now() });
    draw(view);
    wake_up();
  }

  // Sets the step slider to the first view's step.
  function steps(view) {
    const last = view.data.episodes[0].shown.length - 1;
    $("step").disabled = last === 0;
    $("step").max = last;
    $("step").value = Math.floor(view.place);
    $("step").setAttribute("aria-valuetext", `step ${view.data.episodes[0].shown[Math.floor(view.place)]} of ${view.data.steps}`);
  }

  // Shows all views at a step, and pauses them.
  function step_to(place) {
    for (const view of state.views.filter(view => view.data)) {
      Object.assign(view, { playing: false, place: Math.min(place, view.data.episodes[0].shown.length - 1), ended: performance.now() });
      draw(view);
    }
  }

  let clock = null, running = false;
  function wake_up() {
    if (running) return;
    running = true;
    clock = null;
    requestAnimationFrame(tick);
  }

  function tick(time) {
    const seconds = clock === null ? 0 : Math.min((time - clock) / 1000, 0.25);
    clock = time;
    const { training } = state, live = training && training.state === "training" && state.follow;
    for (const view of state.views.filter(view => view.playing)) {
      const [episode] = view.data.episodes, last = episode.shown.length - 1;
      // An episode takes 1.6 s during training. Afterwards it plays in simulated time, but for at most 4 s.
      const whole = view.data.steps * view.data.dt, times = whole / (live ? 1.6 : Math.min(whole, 4));
      view.place = stage.later(view.data, episode, view.place, seconds * times);
      if (view.place >= last) {
        view.playing = false;
        view.ended = time;
      }
      draw(view);
    }
    if (state.follow) follow();
    running = state.views.some(view => view.playing);
    if (running) requestAnimationFrame(tick);
  }

  // Requests the current best team for every view that has finished its episode.
  function follow() {
    const { training } = state;
    if (!training || state.mode !== "watch" || !state.follow || training.state === "starting") return;
    state.generation = Math.max(0, training.reached);
    position();
    state.views.forEach((view, run) => {
      const at = view.data ? view.data.episodes[0].generation : -1;
      const rest = still.matches ? 700 : 250;
      if (view.playing || view.asking || at >= training.last || at === state.generation && training.state !== "done") return;
      if (view.ended && performance.now() - view.ended < rest) return void setTimeout(follow, rest);
      ask(view, run, training.state === "done" ? training.last : state.generation);
    });
  }

  async function ask(view, run, generation) {
    const { training, trial } = state;
    view.asking = true;
    try {
      const data = await training.best(run, trial, generation);
      if (state.training === training && state.views[run] === view && state.mode === "watch") show(view, data);
    } catch (error) {
      if (!error.stopped && state.training === training && !/worker/.test(error.message)) trouble(error.message);
    }
    view.asking = false;
    if (view.wanted !== null) {
      const wanted = view.wanted;
      view.wanted = null;
      ask(view, run, wanted);
    }
  }

  // Shows a generation of all arms.
  function seek(generation) {
    const { training } = state;
    if (!training || training.state === "starting") return;
    following(training.state === "training" && generation >= training.reached);
    state.generation = Math.max(0, Math.min(training.reached, generation));
    position();
    curves();
    state.views.forEach((view, run) => {
      if (view.asking) view.wanted = state.generation;
      else ask(view, run, state.generation);
    });
  }

  function following(follow) {
    state.follow = follow;
    $("following").checked = follow;
  }

  function position() {
    const { training, generation } = state, ahead = state.follow && training.state === "training";
    $("scrub").value = generation;
    $("generation").textContent = `${ahead ? "trained to generation" : "generation"} ${generation} of ${training.last}`;
    $("scrub").setAttribute("aria-valuetext", $("generation").textContent);
  }

  function controls() {
    const { training } = state, going = training && training.state === "training";
    $("pause").disabled = $("stop").disabled = $("following").disabled = !going;
    $("pause").textContent = going && training.paused ? "Continue" : "Pause";
    $("scrub").disabled = $("replay").disabled = !training || training.state === "starting";
  }

  function pause() {
    const { training } = state;
    if (!training || training.state !== "training") return;
    training.paused = !training.paused;
    if (!training.paused) following(true);
    controls();
    follow();
  }

  let drawn_chart = null;
  function curves() {
    const { training } = state;
    // If the number of POIs differs between stages, the curves show shares instead.
    const pois = (training ? training.arms[0].pois : state.pois) ?? 1;
    // About 1000 points per curve are enough for the width of the chart.
    const every = training ? Math.ceil(Math.max(1, training.reached) / 1000) : 1;
    const sample = trial => Array.from({ length: Math.ceil(trial.length / every) }, (_, index) => trial[index * every].best * pois);
    const arms = (training ? training.arms : []).map(({ label, trials }) => ({ tone: TONES[label], trials: trials.map(sample) }));
    const last = training ? training.last : state.config ? state.config.learning.generations : 100;
    drawn_chart = chart.paint($("curves"), arms, every, last, pois, training && !state.follow ? state.generation : null);
    $("legend").replaceChildren();
    const many = training && training.arms[0].pois === null ? "share of POIs" : "POIs";
    const words = (training ? training.arms : []).map(({ label, trials }, index) => {
      const reached = Math.min(...trials.map(trial => trial.length)) - 1, at = state.follow ? reached : Math.min(state.generation, reached);
      const item = make("span", "", $("legend"));
      make("span", "", item, { className: `key${index ? " dashed" : ""}` }).style.color = `var(${TONES[label]})`;
      const mean = at >= 0 && trials.reduce((sum, trial) => sum + trial[at].best, 0) / trials.length * pois;
      const value = at >= 0 ? `${mean.toFixed(2)} of ${pois}` : "–";
      make("span", ` ${label}: ${value}`, item);
      return `${label} ${value} ${many} at generation ${Math.max(0, at)}`;
    });
    make("span", `${many} observed by the best team, mean over trials; thin: each trial`, $("legend"));
    $("curves").setAttribute("aria-label", `Learning curves, best team, mean over trials: ${words.join("; ") || "nothing trained yet"}`);
    if (training) told();
  }

  // ---- Start positions ----

  // Returns the start as an episode without steps.
  function start_scene(config) {
    const { world, follow } = config, agents = [...world.leaders, ...world.followers];
    const coupling = Array.isArray(world.coupling) ? world.coupling : world.pois.map(() => world.coupling);
    const nearest = place => {
      const away = world.leaders.map(leader => Math.hypot(leader[0] - place[0], leader[1] - place[1]));
      const best = away.indexOf(Math.min(...away));
      return away[best] <= follow.attraction_radius ? best : -1;
    };
    return {
      map: world.map, pois: world.pois, observation_radius: world.observation_radius, attraction_radius: follow.attraction_radius,
      dt: world.dt, steps: world.steps, exact: true, colors: palettes,
      observers: world.observers, windows: world.windows, after: world.after,
      episodes: [{
        leaders: world.leaders.length, agents: agents.length, coupling, shown: [0], g: 0, generation: 0, trial: 0,
        owner: agents.map((place, agent) => agent < world.leaders.length ? agent : nearest(place)),
        observed: world.pois.map(() => null), near: new Uint16Array(world.pois.length), led: new Uint32Array(0),
        positions: Float32Array.from(agents.flat()), headings: Float32Array.from(headings_of(world).flatMap((angle) => [Math.cos(angle), Math.sin(angle)])),
      }],
    };
  }
  // Returns the heading of each agent at the start. If headings are given per leader, each follower uses that of its
  // nearest leader.
  function headings_of({ heading, leaders, followers }) {
    const agents = [...leaders, ...followers];
    if (!Array.isArray(heading)) return agents.map(() => heading);
    if (heading.length === agents.length) return heading;
    const nearest = ([x, y]) => {
      const away = leaders.map(([u, v]) => (u - x) ** 2 + (v - y) ** 2);
      return away.indexOf(Math.min(...away));
    };
    return [...heading, ...followers.map((place) => heading[nearest(place)])];
  }
  let palettes = null;

  function show_start() {
    const { config } = state;
    if (!state.views.length || state.training || state.mode === "arrange") {
      if (state.mode !== "arrange" || state.views.length !== 1) {
        clear();
        view("leader-follower");
        $("views").classList.add("one");
      }
      const [only] = state.views;
      only.tell = (step, observed, said) => {
        const { world } = config;
        only.said.textContent = `${count(world.leaders.length, "leader")}, ${count(world.followers.length, "follower")}, ${count(world.pois.length, "POI")} · ${world.steps} steps`;
        only.canvas.setAttribute("aria-label", `Map of the start: ${only.said.textContent}${only.chosen ? `; chosen: ${name_chosen(only.chosen)}` : ""}`);
      };
      only.title.textContent = "Where everyone starts";
      only.card.querySelector(".key").hidden = true;
    }
    const [only] = state.views;
    only.crop = state.mode === "arrange" ? [0, 0, ...config.world.map] : reach(config);
    if (only.chosen && !config.world[only.chosen[0]][only.chosen[1]]) only.chosen = null;
    if (state.mode === "arrange") {
      // Show the whole map, as high as the window allows below the row of modes.
      const [width, height] = config.world.map;
      only.canvas.style.maxWidth = `${Math.max(280, (innerHeight - 250) * width / height)}px`;
      only.canvas.style.marginInline = "auto";
      hands(only);
    }
    show(only, start_scene(config), false);
    if (!state.training) curves();
  }

  const name_chosen = ([list, index]) => `${{ leaders: "leader", followers: "follower", pois: "POI" }[list]} ${index} at ${state.config.world[list][index].map(number).join(", ")}`;

  function ring(view) {
    const [list, index] = view.chosen, place = state.config.world[list][index];
    if (!place) return;
    const { X, Y } = stage.place_on(view.canvas, view.crop), pen = view.canvas.getContext("2d");
    pen.strokeStyle = getComputedStyle(document.documentElement).getPropertyValue("--accent").trim();
    pen.lineWidth = 2.5;
    pen.beginPath(); pen.arc(X(place[0]), Y(place[1]), 17, 0, 2 * Math.PI); pen.stroke();
  }

  const items = ({ world }) => ["leaders", "followers", "pois"].flatMap(list => world[list].map((place, index) => [list, index, place]));

  function choose(view, chosen) {
    view.chosen = chosen;
    $("chosen").textContent = chosen ? `Chosen: ${name_chosen(chosen)}` : "";
    draw(view);
  }

  // Lets the pointer and the keys move agents and POIs.
  function hands(view) {
    if (view.canvas.classList.contains("hands")) return;
    view.canvas.classList.add("hands");
    view.canvas.tabIndex = 0;
    view.canvas.setAttribute("role", "application");
    let held = null;
    const place = event => {
      const { scale } = stage.place_on(view.canvas, view.crop), [width, height] = state.config.world.map;
      const tenth = (value, most) => Math.round(Math.max(0, Math.min(most, value)) * 10) / 10;
      return [tenth(view.crop[0] + event.offsetX / scale, width), tenth(view.crop[3] - event.offsetY / scale, height)];
    };
    view.canvas.addEventListener("pointerdown", event => {
      const { scale } = stage.place_on(view.canvas, view.crop), at = place(event);
      // Agents are drawn above POIs, so they take precedence.
      const away = ([list, , [x, y]]) => Math.hypot(x - at[0], y - at[1]) + (list === "pois" ? 1 : 0);
      const near = items(state.config).sort((a, b) => away(a) - away(b))[0];
      if (!near || away(near) > Math.max(18 / scale, state.config.world.observation_radius * 0.6)) return choose(view, null);
      held = near.slice(0, 2);
      choose(view, held);
      view.canvas.setPointerCapture(event.pointerId);
      view.canvas.focus();
    });
    view.canvas.addEventListener("pointermove", event => {
      if (!held) return;
      state.config.world[held[0]][held[1]] = place(event);
      show(view, start_scene(state.config), false);
      choose(view, held);
    });
    const release = () => {
      if (held) moved(held[0]);
      held = null;
    };
    view.canvas.addEventListener("pointerup", release);
    view.canvas.addEventListener("pointercancel", release);
    view.canvas.addEventListener("keydown", event => {
      const all = items(state.config), index = view.chosen ? all.findIndex(([list, at]) => list === view.chosen[0] && at === view.chosen[1]) : -1;
      const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
      if (event.key === "]" || event.key === "[") {
        const next = (index + (event.key === "]" ? 1 : -1) + all.length + (index < 0 && event.key === "[" ? 1 : 0)) % all.length;
        choose(view, all[next].slice(0, 2));
      } else if (by && view.chosen) {
        const [list, at] = view.chosen, [width, height] = state.config.world.map, size = event.shiftKey ? 0.1 : 1;
        const [x, y] = state.config.world[list][at], fix = (value, most) => Math.round(Math.max(0, Math.min(most, value)) * 10) / 10;
        state.config.world[list][at] = [fix(x + by[0] * size, width), fix(y + by[1] * size, height)];
        moved(list);
        choose(view, view.chosen);
      } else if (event.key === "Delete" && view.chosen) remove();
      else return;
      event.preventDefault();
      event.stopPropagation();
    });
  }

  function moved(list) {
    state.file = null;
    return change([[`world.${list}`, configs.positions(state.config.world[list])]]);
  }

  function add(list) {
    const { world } = state.config, [width, height] = world.map, [first] = state.views;
    const taken = items(state.config).map(([, , place]) => place);
    // Search for a free place, on a spiral from the middle of the map.
    let place = [width / 2, height / 2];
    for (let ring = 0; taken.some(([x, y]) => Math.hypot(x - place[0], y - place[1]) < 2) && ring < 200; ring++) {
      place = [width / 2 + 1.5 * Math.sqrt(ring) * Math.cos(2.4 * ring), height / 2 + 1.5 * Math.sqrt(ring) * Math.sin(2.4 * ring)].map(at => Math.round(at * 10) / 10);
    }
    world[list].push(place);
    moved(list);
    choose(first, [list, world[list].length - 1]);
  }

  function remove() {
    const [first] = state.views;
    if (!first || !first.chosen) return;
    const [list, index] = first.chosen;
    state.config.world[list].splice(index, 1);
    first.chosen = null;
    moved(list);
    $("chosen").textContent = "";
  }

  function pointed(view, event) {
    if (state.mode !== "watch" || !view.data) return;
    const over = stage.poi_at(view.data, view.canvas, view.crop, event.offsetX, event.offsetY);
    if (over !== view.over) { view.over = over; draw(view); }
  }

  // ---- Driving a leader ----

  const drive = { on: false, timer: null, wish: [0, 0], pointer: null, keys: new Set() };

  function options() {
    if (!state.config) return;
    const many = state.config.world.leaders.length, chosen = $("leader").value;
    $("leader").replaceChildren(...Array.from({ length: many }, (_, leader) => make("option", String(leader))));
    if (Number(chosen) < many && chosen !== "") $("leader").value = chosen;
  }

  function drive_view() {
    clear();
    const only = view("leader-follower");
    $("views").classList.add("one");
    only.title.textContent = "In your hands";
    only.card.querySelector(".key").hidden = true;
    only.crop = reach(state.config);
    only.canvas.classList.add("steer");
    only.canvas.tabIndex = 0;
    only.canvas.setAttribute("role", "application");
    only.tell = (step, observed, said) => {
      only.said.textContent = `step ${step} of ${state.config.world.steps} · ${observed} of ${state.config.world.pois.length} POIs`;
      only.canvas.setAttribute("aria-label", `You steer leader ${$("leader").value}: step ${step}, ${said}`);
    };
    show(only, start_scene(state.config), false);
    only.chosen = ["leaders", Number($("leader").value) || 0];
    draw(only);
    const at = event => {
      const { scale } = stage.place_on(only.canvas, only.crop);
      drive.pointer = [only.crop[0] + event.offsetX / scale, only.crop[3] - event.offsetY / scale];
    };
    only.canvas.addEventListener("pointermove", at);
    only.canvas.addEventListener("pointerdown", event => { at(event); only.canvas.focus(); if (!drive.on) drive_on(); });
    // Lifting a finger also fires `pointerleave`. The leader then keeps going to the last place touched.
    only.canvas.addEventListener("pointerleave", event => { if (event.pointerType !== "touch") drive.pointer = null; });
    const key = event => {
      if (!/^Arrow/.test(event.key)) return;
      if (event.type === "keydown") { drive.keys.add(event.key); drive.pointer = null; if (!drive.on) drive_on(); } else drive.keys.delete(event.key);
      event.preventDefault();
      event.stopPropagation();
    };
    only.canvas.addEventListener("keydown", key);
    only.canvas.addEventListener("keyup", key);
    return only;
  }

  // Returns the wanted turn, in half turns to the left, and speed, each in -1..1. Returns null without input.
  function wish(positions, headings, leader) {
    const [x, y] = positions.slice(2 * leader, 2 * leader + 2), [cos, sin] = headings.slice(2 * leader, 2 * leader + 2);
    if (drive.pointer) {
      const [dx, dy] = [drive.pointer[0] - x, drive.pointer[1] - y], away = Math.hypot(dx, dy);
      if (away < 0.3) return [0, -1];
      const angle = Math.atan2(cos * dy - sin * dx, cos * dx + sin * dy);
      return [Math.max(-1, Math.min(1, angle / Math.PI)), Math.max(-1, Math.min(1, away / 2 - 1))];
    }
    if (!drive.keys.size) return null;
    const turn = (drive.keys.has("ArrowLeft") ? 0.4 : 0) - (drive.keys.has("ArrowRight") ? 0.4 : 0);
    return [turn, drive.keys.has("ArrowUp") ? 1 : drive.keys.has("ArrowDown") ? -1 : 0.2];
  }

  async function drive_on() {
    drive_off();
    const only = drive_view(), leader = Number($("leader").value) || 0;
    only.canvas.focus({ preventScroll: true });
    only.chosen = null;
    drive.on = true;
    $("again").textContent = "Start over";
    const player = state.clerk, toml = configs.set(state.toml, "learning.paradigm", '"leader-follower"');
    const { each, weights } = state.policies || { each: 0 };
    let told;
    try {
      told = (await player.ask({ ask: "drive", text: toml, leader, policies: each }, weights)).words;
      $("driven").textContent = told.learned ? "The other leaders do what they learned." : state.policies ? "The other leaders go straight ahead: what was learned is not for these teams." : "The other leaders go straight ahead: train first, and they do what they learned.";
    } catch (error) {
      drive_off();
      return trouble(error.message);
    }
    const data = start_scene(state.config), [episode] = data.episodes;
    const track = { positions: [], headings: [], near: [] };
    const take = words => {
      track.positions.push(...words.positions);
      track.headings.push(...words.headings);
      track.near.push(...words.near);
      Object.assign(episode, {
        positions: Float32Array.from(track.positions), headings: Float32Array.from(track.headings), near: Uint16Array.from(track.near),
        shown: Array.from({ length: words.step + 1 }, (_, step) => step), observed: words.observed,
      });
    };
    take(told);
    show(only, data, false);
    const turn = drive.turn = {};
    const pace = Math.max(60, data.dt * 1000 * 0.75);
    const step = async () => {
      if (drive.turn !== turn || state.mode !== "drive") return;
      const from = performance.now(), wanted = wish(told.positions, told.headings, leader);
      if (!wanted) return void (drive.timer = setTimeout(step, 30));
      const [angle, speed] = wanted;
      try { told = (await player.ask({ ask: "step", turn: angle, speed })).words; } catch (error) { return trouble(error.message); }
      if (drive.turn !== turn) return;
      take(told);
      Object.assign(only, { place: told.step });
      draw(only);
      if (told.scores) {
        drive_off();
        const { g, d, df } = told.scores, pois = state.config.world.pois.length;
        $("driven").textContent = `The team observed ${Math.round(g * pois)} of ${count(pois, "POI")} (G = ${number(g)}). Yours: D = ${number(d[leader])}, Df = ${number(df[leader])}.`;
        return;
      }
      drive.timer = setTimeout(step, Math.max(0, pace - (performance.now() - from)));
    };
    step();
  }

  function drive_off() {
    clearTimeout(drive.timer);
    drive.turn = null;
    drive.on = false;
    drive.keys.clear();
    $("again").textContent = "Start";
  }

  // ---- Modes ----

  const HINTS = {
    watch: "", arrange: "Drag leaders, followers and POIs, then train again.",
    drive: "Point where your leader shall go, or use the arrow keys; time waits for you.",
  };

  function mode(wanted) {
    if (state.mode === wanted) return;
    drive_off();
    state.mode = wanted;
    for (const button of document.querySelectorAll("[data-mode]")) button.setAttribute("aria-pressed", button.dataset.mode === wanted);
    $("hint").textContent = HINTS[wanted];
    $("arrange").hidden = wanted !== "arrange";
    $("drive").hidden = wanted !== "drive";
    const { training } = state;
    if (wanted === "arrange") {
      if (training && training.state === "training") { training.paused = true; controls(); }
      clear();
      show_start();
      $("modes").scrollIntoView({ block: "start" });
    } else if (wanted === "drive") {
      if (training && training.state === "training") { training.paused = true; controls(); }
      const led = training && training.arms.find(arm => arm.label === "leader-follower" && arm.ended.length);
      if (led) state.policies = { each: 1, weights: led.ended[Math.min(state.trial, led.ended.length - 1)] };
      if (led && led.toml !== state.toml && led.config.world.leaders.length !== state.config.world.leaders.length) state.policies = null;
      options();
      drive_view();
      $("driven").textContent = "";
      $("modes").scrollIntoView({ block: "start" });
    } else if (training) {
      const { generation, trial } = state;
      build(training);
      position();
      $("trial").value = trial;
      if (training.state === "done" || !state.follow) {
        state.views.forEach((view, run) => ask(view, run, state.follow ? training.last : generation));
      } else follow();
    } else {
      clear();
      show_start();
    }
  }

  // ---- Files ----

  async function take_file(file) {
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
        Object.assign(state, { both: false, trial: 0, generation: training.last, policies: null });
        following(false);
        training.source = { text: found.words.toml, both: false };
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
        show(only, stage.unpack(data));
        $("said").textContent = `${file.name}: ${count(words.policies, "policy").replace(/ys$/, "ies")} a leader. Take a leader to play with them.`;
      } else {
        if (!/\.toml$/i.test(file.name)) throw new Error("it is no config (.toml), no run (.zip) and no policies (.safetensors)");
        const text = new TextDecoder("utf-8", { fatal: true }).decode(bytes);
        keep();
        state.file = file.name.replace(/\.toml$/i, "");
        state.both = false;
        forget();
        mode("watch");
        show_start();
        const taken = await take(text);
        $("said").textContent = taken ? `${file.name} is the config now.` : `${file.name} has problems; they stand beside its lines.`;
      }
    } catch (error) { trouble(`${file.name}: ${error.message}`); }
  }

  // ---- Verify ----

  async function verify() {
    const output = $("verified"), worlds = 8, teams = 24;
    $("verify").disabled = true;
    output.className = "";
    output.textContent = "…";
    let player;
    try {
      player = await pool.open();
      player.told = ({ verified }) => { output.textContent = `${verified} of ${worlds} worlds`; };
      const pass = $("plain").checked ? "plain" : null;
      const { words } = await player.ask({ ask: "verify", worlds, teams, seed: 0, pass });
      output.className = words.mismatch ? "bad" : "good";
      output.textContent = words.mismatch ? `DIFFERENT: ${words.mismatch}` : `Equal: this browser's GPU and CPU agree on every bit of ${words.agent_steps.toLocaleString("en")} agent-steps in ${words.worlds} random worlds.`;
    } catch (error) {
      output.className = "bad";
      output.textContent = error.message;
    }
    if (player) player.stop();
    $("verify").disabled = false;
  }

  // ---- Event listeners ----

  function listen() {
    $("setup").addEventListener("submit", event => { event.preventDefault(); train(); });
    $("layout").addEventListener("change", async () => {
      const { fitness, seed } = state.config ? state.config.learning : {};
      let text = configs.layout($("layout").value);
      if (fitness) text = configs.set(configs.set(text, "learning.fitness", `"${fitness}"`), "learning.seed", String(seed));
      keep();
      forget();
      state.file = null;
      const arranging = state.mode === "arrange";
      mode(arranging ? "arrange" : "watch");
      await take(text);
    });
    $("paradigm").addEventListener("change", () => {
      state.both = $("paradigm").value === "both";
      if (state.both) { remember(); stale(); } else change([["learning.paradigm", `"${$("paradigm").value}"`]]);
    });
    for (const [id, key] of Object.entries(KEYS)) {
      // An empty field is reset to the config's value.
      $(id).addEventListener("change", () => { if ($(id).value !== "") change([[key, quote(id)($(id).value)]]); else if (state.config) fill(); });
    }
    for (const id of ["on", "pace"]) $(id).addEventListener("change", remember);
    // A training in progress keeps its backend. The next one uses the new choice.
    $("on").addEventListener("change", () => { if (!state.training || state.training.state === "done" || state.training.state === "stopped") settle().catch(error => trouble(error.message)); });
    for (const button of document.querySelectorAll("[data-mode]")) button.addEventListener("click", () => mode(button.dataset.mode));
    for (const button of document.querySelectorAll("[data-add]")) button.addEventListener("click", () => add(button.dataset.add));
    $("remove").addEventListener("click", remove);
    $("again").addEventListener("click", drive_on);
    $("leader").addEventListener("change", () => { if (state.mode === "drive") { drive_off(); drive_view(); } });
    $("pause").addEventListener("click", pause);
    $("stop").addEventListener("click", stop);
    $("undo").addEventListener("click", undo);
    $("step").addEventListener("input", () => step_to(Number($("step").value)));
    $("following").addEventListener("change", () => {
      following($("following").checked);
      if (state.follow) follow(); else seek(state.generation);
    });
    $("scrub").addEventListener("input", () => {
      if (state.mode !== "watch") mode("watch");
      seek(Number($("scrub").value));
    });
    $("trial").addEventListener("change", () => {
      state.trial = Number($("trial").value);
      if (!state.follow) return seek(state.generation);
      // Keep following, in the other trial.
      state.views.forEach((view, run) => { if (view.asking) view.wanted = state.generation; else ask(view, run, state.generation); });
    });
    $("replay").addEventListener("click", () => {
      if (state.mode !== "watch") mode("watch");
      for (const view of state.views) if (view.data) show(view, view.data, true, true);
    });
    for (const id of ["trails", "radii"]) $(id).addEventListener("change", () => state.views.forEach(draw));
    $("curves").addEventListener("click", event => { if (drawn_chart && state.training) { if (state.mode !== "watch") mode("watch"); seek(drawn_chart.generation(event.offsetX)); } });
    $("verify").addEventListener("click", verify);
    $("share").addEventListener("click", async () => {
      if (!state.valid) return void ($("said").textContent = "No link was copied: the config has problems. Correct them first.");
      await remember(); copy(location.href, "The link is copied: whoever opens it trains the same.");
    });
    $("open").addEventListener("click", () => $("file").click());
    $("file").addEventListener("change", () => { if ($("file").files[0]) take_file($("file").files[0]); $("file").value = ""; });
    $("save").addEventListener("click", () => save("config.toml", state.text, "text/plain"));
    $("text").addEventListener("input", () => {
      lines();
      clearTimeout(typed);
      typed = setTimeout(type, 250);
    });
    $("text").addEventListener("scroll", lines);
    $("config").addEventListener("toggle", lines);
    addEventListener("dragover", event => { event.preventDefault(); document.body.classList.add("dropping"); });
    addEventListener("dragleave", event => { if (!event.relatedTarget) document.body.classList.remove("dropping"); });
    addEventListener("drop", event => {
      event.preventDefault();
      document.body.classList.remove("dropping");
      if (event.dataTransfer.files[0]) take_file(event.dataTransfer.files[0]);
    });
    addEventListener("keydown", event => {
      if (event.key !== " " || event.target.closest("button, input, select, textarea, summary, a")) return;
      event.preventDefault();
      pause();
    });
    const again = () => { state.views.forEach(draw); if (state.config) curves(); };
    addEventListener("resize", again);
    stage.night.addEventListener("change", again);
    addEventListener("hashchange", recall);
  }

  async function start() {
    try {
      [state.gpu] = await Promise.all([pool.gpu(), renew()]);
    } catch (error) {
      $("machine").textContent = "";
      return trouble(`This browser cannot run it: ${error.message}. It takes WebAssembly with SIMD, as browsers have had since 2023.`);
    }
    palettes = (await state.clerk.ask({ ask: "colors" })).words;
    $("verify").disabled = !state.gpu.name;
    $("plain-label").hidden = !state.gpu.name;
    $("verified").textContent = state.gpu.name ? "Compares this browser's GPU with its CPU, bit for bit." : `There is no GPU to verify: ${state.gpu.reason}.`;
    $("on").querySelector("[value=gpu]").disabled = !state.gpu.name;
    listen();
    await recall();
    await settle();
    document.body.dataset.ready = "";
  }
  start();

  return { state, seek, take_file };
})();
