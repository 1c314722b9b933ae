// @ts-check
// Draws learning curves: POIs observed by the best team, per arm the mean over trials, with each trial as a thin line.

export const chart = (() => {
  const DASHES = [[], [7, 3], [12, 4], [3, 3], [10, 3, 3, 3], [16, 3]];
  // `arms` are { tone, trials, constant, random }. Each trial is an array of POIs, one value per `every` generations.
  // `constant` is what the best constant action observes, or null, and `random` the best random team, per generation. `cursor` is the
  // generation to mark, or null.
  function paint(canvas, arms, every, last, pois, cursor) {
    const wide = canvas.clientWidth, tall = canvas.clientHeight, dots = window.devicePixelRatio || 1;
    if (canvas.width !== Math.round(wide * dots) || canvas.height !== Math.round(tall * dots)) {
      canvas.width = Math.round(wide * dots);
      canvas.height = Math.round(tall * dots);
    }
    const style = getComputedStyle(document.documentElement), color = name => style.getPropertyValue(name).trim();
    const draw = canvas.getContext("2d");
    draw.setTransform(dots, 0, 0, dots, 0, 0);
    draw.clearRect(0, 0, wide, tall);
    const [left, right, above, below] = [30, 14, 12, 36];
    const X = generation => left + (wide - left - right) * (last > 0 ? generation / last : 0);
    const Y = value => tall - below - (tall - above - below) * (pois > 0 ? value / pois : 0);
    draw.font = "12px system-ui, sans-serif";
    draw.lineWidth = 1;
    draw.textBaseline = "middle";
    draw.textAlign = "right";
    const step = Math.max(1, Math.ceil(pois / 5));
    for (let value = 0; value <= pois; value += step) {
      draw.strokeStyle = color("--line");
      draw.beginPath(); draw.moveTo(left, Y(value)); draw.lineTo(wide - right, Y(value)); draw.stroke();
      draw.fillStyle = color("--faint");
      draw.fillText(String(value), left - 7, Y(value));
    }
    draw.textAlign = "center";
    const rough = Math.max(1, last) / Math.max(2, Math.min(10, Math.floor(wide / 90)));
    const size = 10 ** Math.floor(Math.log10(rough)), apart = Math.max(1, [1, 2, 5, 10].find(n => n * size >= rough) * size);
    for (let generation = 0; generation <= last; generation += apart) draw.fillText(String(Math.round(generation)), X(generation), tall - below + 13);
    draw.fillText("generation", (left + wide - right) / 2, tall - 7);
    if (cursor !== null) {
      draw.strokeStyle = color("--edge");
      draw.setLineDash([3, 3]);
      draw.beginPath(); draw.moveTo(X(cursor), above); draw.lineTo(X(cursor), tall - below); draw.stroke();
      draw.setLineDash([]);
    }
    draw.lineJoin = "round";
    for (const { tone, trials } of arms) {
      draw.strokeStyle = color(tone);
      draw.lineWidth = 1;
      draw.globalAlpha = 0.32;
      for (const trial of trials) line(draw, trial, every, X, Y);
      draw.globalAlpha = 1;
    }
    // Baselines: a dotted line for the best constant action, and a dotted curve for random teams.
    for (const { tone, constant, random } of arms) {
      draw.strokeStyle = color(tone);
      draw.lineWidth = 1.6;
      draw.setLineDash([1.5, 4]);
      if (constant !== null) { draw.beginPath(); draw.moveTo(left, Y(constant)); draw.lineTo(wide - right, Y(constant)); draw.stroke(); }
      draw.setLineDash([6, 3, 1.5, 3]);
      if (random.length) line(draw, random, 1, X, Y);
      draw.setLineDash([]);
    }
    arms.forEach(({ tone, trials }, index) => {
      const means = mean(trials);
      if (!means.length) return;
      draw.strokeStyle = color(tone);
      draw.lineWidth = 2.5;
      draw.setLineDash(DASHES[index % DASHES.length]);
      line(draw, means, every, X, Y);
      draw.setLineDash([]);
      const end = means.length - 1;
      draw.fillStyle = color(tone);
      draw.beginPath(); draw.arc(X(end * every), Y(means[end]), 4, 0, 2 * Math.PI); draw.fill();
    });
    return { generation: x => Math.round(Math.max(0, Math.min(1, (x - left) / (wide - left - right))) * last) };
  }

  function line(draw, values, every, X, Y) {
    draw.beginPath();
    values.forEach((value, index) => draw.lineTo(X(index * every), Y(value)));
    draw.stroke();
  }

  // Returns the mean over trials, up to the last generation that all trials have reached.
  function mean(trials) {
    const length = trials.length ? Math.min(...trials.map(trial => trial.length)) : 0;
    return Array.from({ length }, (_, generation) => trials.reduce((sum, trial) => sum + trial[generation], 0) / trials.length);
  }

  return { paint };
})();
