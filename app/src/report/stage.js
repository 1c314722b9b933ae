// Draws episodes on every page that shows them. Motion is stored in flat arrays, [frames][agents].
const stage = (() => {
  "use strict";
  // Dashes distinguish groups once all colours are used; beyond that, only the leaders' numbers do.
  const DASHES = [[], [5, 3], [1.5, 2]];
  const night = matchMedia("(prefers-color-scheme: dark)");
  const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer;
  const turn = Array.from({ length: 256 }, (_, index) => index / 256 * 2 * Math.PI);

  // Decodes the base64 texts into arrays, in place.
  function unpack(data) {
    for (const episode of data.episodes) {
      episode.positions = data.exact ? new Float32Array(bytes(episode.positions)) : new Uint16Array(bytes(episode.positions));
      episode.headings = data.exact ? new Float32Array(bytes(episode.headings)) : new Uint8Array(bytes(episode.headings));
      episode.near = new Uint32Array(bytes(episode.near));
      episode.led = new Uint32Array(bytes(episode.led));
      if (episode.senses) episode.senses = new Float32Array(bytes(episode.senses));
      for (const { alone, group } of episode.without || []) for (const part of [alone, group]) part.near = new Uint32Array(bytes(part.near));
    }
    return data;
  }

  // Returns position and heading of an agent at a frame: [x, y, heading x, heading y].
  function moment(data, episode, frame, agent) {
    const at = frame * episode.agents + agent, { positions, headings } = episode;
    if (data.exact) return [positions[2 * at], positions[2 * at + 1], headings[2 * at], headings[2 * at + 1]];
    const angle = turn[headings[at]], [width, height] = data.map;
    return [positions[2 * at] * (width / 65535), positions[2 * at + 1] * (height / 65535), Math.cos(angle), Math.sin(angle)];
  }

  // Returns the same between two frames, interpolated linearly.
  function between(data, episode, place, agent) {
    const last = episode.shown.length - 1, frame = Math.min(Math.floor(place), last), part = place - frame;
    const now = moment(data, episode, frame, agent);
    if (part === 0 || frame === last) return now;
    const next = moment(data, episode, frame + 1, agent);
    return now.map((value, index) => value + (next[index] - value) * part);
  }

  // Returns the part of the map that holds all POIs and agents of all episodes. An agent widens it by at most a sixth
  // of what POIs and starts take, so that one that strays does not make everything small. The shorter side is at least
  // half the longer.
  function busy(data) {
    const [width, height] = data.map;
    let [left, below, right, above] = [Infinity, Infinity, -Infinity, -Infinity];
    const include = (x, y, margin) => {
      left = Math.min(left, x - margin); right = Math.max(right, x + margin);
      below = Math.min(below, y - margin); above = Math.max(above, y + margin);
    };
    const most = (value, low, high) => Math.min(high, Math.max(low, value));
    data.pois.forEach(([x, y], poi) => include(x, y, radius(data, poi) + 1));
    for (const episode of data.episodes)
      for (let agent = 0; agent < episode.agents; agent++) { const [x, y] = moment(data, episode, 0, agent); include(x, y, 2); }
    const beyond = Math.max(right - left, above - below) / 6, [west, south, east, north] = [left - beyond, below - beyond, right + beyond, above + beyond];
    for (const episode of data.episodes)
      for (let frame = 1; frame < episode.shown.length; frame++)
        for (let agent = 0; agent < episode.agents; agent++) {
          const [x, y] = moment(data, episode, frame, agent);
          include(most(x, west + 2, east - 2), most(y, south + 2, north - 2), 2);
        }
    const grow = (low, high, least, end) => {
      const more = Math.max(0, (least - (high - low)) / 2);
      low -= more; high += more;
      // A margin beyond the walls, so that agents at a wall are drawn whole.
      const shift = low < -1 ? -1 - low : Math.min(0, end + 1 - high);
      return [Math.max(-1, low + shift), Math.min(end + 1, high + shift)];
    };
    [left, right] = grow(left, right, (above - below) / 2, width);
    [below, above] = grow(below, above, (right - left) / 2, height);
    return [left, below, right, above];
  }

  // Returns the leaders of an agent at a frame: for Dt those of that step, otherwise the one whose group it joins for
  // Df.
  function leaders_of(episode, frame, agent) {
    if (agent < episode.leaders) return [agent];
    if (episode.led.length === 0) return episode.owner[agent] < 0 ? [] : [episode.owner[agent]];
    const words = Math.ceil(episode.leaders / 32), followers = episode.agents - episode.leaders;
    const first = (frame * followers + agent - episode.leaders) * words, found = [];
    for (let leader = 0; leader < episode.leaders; leader++)
      if (episode.led[first + (leader >> 5)] >>> (leader & 31) & 1) found.push(leader);
    return found;
  }

  // is_open reports whether a POI can be observed at a step. when describes its value, window and order.
  function is_open(data, episode, poi, step) {
    const [first, end] = data.windows[poi] || [1, data.steps], others = data.after[poi] || [];
    const done = other => episode.observed[other] !== null && episode.observed[other] < step;
    return step >= first && step <= end && others.every(done);
  }
  function when(data, poi) {
    const window = data.windows[poi], others = data.after[poi] || [];
    return (data.values ? `, value ${data.values[poi]}` : "") + (window ? `, steps ${window[0]} to ${window[1]}` : "") + (others.length ? `, after ${others.join(" and ")}` : "");
  }
  // size_of returns how large the mark of a POI is: 1 if all have the same value, otherwise more for more valuable ones.
  const size_of = ({ values }, poi) => values ? 0.7 + 0.8 * Math.sqrt(values[poi] / Math.max(...values)) : 1;
  const radius = (data, poi) => (data.radii && data.radii[poi]) ?? data.observation_radius;
  // of_each returns the index of the class of each agent, or of the group of each POI.
  const of_each = (parts = []) => parts.flatMap(({ count }, index) => Array(count).fill(index));
  // outline returns the outline of the marks of a class, as [ahead, aside]. Without classes, all agents have the same.
  const outline = ({ classes = [], outline }, index = 0) => (classes[index] || { outline }).outline;
  // learns reports whether a class learns. Those that do come first.
  const learns = ({ classes, episodes }, index) => classes.slice(0, index).reduce((sum, { count }) => sum + count, 0) < episodes[0].leaders;
  // Returns, for each class, an element with its mark, number and name.
  function legend(data) {
    return (data.classes || []).map(({ size, name }, index) => {
      const item = document.createElement("span"), filled = learns(data, index);
      const points = outline(data, index).map(([ahead, aside]) => `${7 * aside},${-7 * ahead}`).join(" ");
      item.innerHTML = `<svg viewBox="-9 -9 18 18" width="16" height="16"><polygon points="${points}" fill="${filled ? "currentColor" : "none"}" stroke="currentColor" stroke-width="1.5"/></svg> `;
      item.append(`${size} × ${name}`);
      return item;
    });
  }
  // Returns the classes that count at a POI, or null if all do.
  function observers_of({ classes = [], groups = [] }, poi) {
    const group = groups[of_each(groups)[poi]];
    return group && group.observers.length < classes.length ? group.observers : null;
  }
  // counts_at_pois reports whether an agent counts at POIs. With classes, these show it.
  const counts_at_pois = (data, episode, agent) =>
    data.classes || data.observers === "all" || (data.observers === "leaders") === (agent < episode.leaders);

  // who names the classes that count at a POI, if not all do.
  function who(data, poi) {
    const observers = observers_of(data, poi);
    return observers ? `, only ${observers.map(own => data.classes[own].name).join(" and ")}` : "";
  }

  const whole = ({ map: [width, height] }) => [-1, -1, width + 1, height + 1];

  // Maps positions in a part of the map to positions on a canvas.
  function place_on(canvas, [left, below, right, above]) {
    const wide = canvas.clientWidth, scale = wide / (right - left);
    return { wide, tall: (above - below) * scale, scale, X: x => (x - left) * scale, Y: y => (above - y) * scale };
  }

  const overlap = (a, b) => a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];

  // Returns the number of a leader's colour. Without followers, agents that share a population share their colour.
  const hue = ({ populations }, leader) => populations && leader in populations ? populations[leader] : leader;
  // Returns the colour of a leader and its followers.
  function tint(data, leader) {
    const colors = night.matches ? data.colors.dark : data.colors.light;
    return colors[hue(data, leader) % colors.length];
  }

  // Draws how often agents were at a place up to a frame, in squares of one unit.
  function paint_heat(draw, data, episode, frame, { X, Y, scale }, tone) {
    const counts = new Map();
    for (let past = 0; past <= frame; past++)
      for (let agent = 0; agent < episode.agents; agent++) {
        const [x, y] = moment(data, episode, past, agent), place = `${Math.floor(x)} ${Math.floor(y)}`;
        counts.set(place, (counts.get(place) || 0) + 1);
      }
    let most = 1;
    for (const many of counts.values()) most = Math.max(most, many);
    draw.fillStyle = tone;
    for (const [place, many] of counts) {
      const [x, y] = place.split(" ").map(Number);
      draw.globalAlpha = 0.12 + 0.6 * Math.sqrt(many / most);
      draw.fillRect(X(x), Y(y + 1), scale + 0.5, scale + 0.5);
    }
    draw.globalAlpha = 1;
  }

  // Draws an episode, `place` frames from its start, at the canvas's width. `look` selects what to show: `crop` (a part
  // of the map), `trails`, `radii`, `groups`, and `over` (the POI under the pointer, or null). It may have `heat` (where
  // agents were), `removed` (a leader, and whether its followers are removed, too) and `lost` (the POIs lost by that).
  function paint(data, episode, canvas, place, look) {
    const { wide, tall, scale, X, Y } = place_on(canvas, look.crop);
    const dots = window.devicePixelRatio || 1;
    if (canvas.width !== Math.round(wide * dots) || canvas.height !== Math.round(tall * dots)) {
      canvas.style.height = `${tall}px`;
      canvas.width = Math.round(wide * dots);
      canvas.height = Math.round(tall * dots);
    }
    const style = getComputedStyle(document.documentElement), tones = {};
    const color = name => tones[name] ??= style.getPropertyValue(name).trim();
    // Marks are smaller on a small canvas, where they would hide each other. The smallest ones have no room for labels.
    const fit = Math.max(0.55, Math.min(1, wide / 240)), labelled = wide >= 150;
    const led = Array.from({ length: episode.agents }, (_, agent) => leaders_of(episode, Math.floor(place), agent));
    const dashes = agent => DASHES[Math.floor(hue(data, led[agent][0] || 0) / data.colors.light.length) % DASHES.length];
    const group = agent => led[agent].length === 0 ? color("--faint") : tint(data, led[agent][0]);
    const draw = canvas.getContext("2d");
    const taken = [];
    // Writes text with a pale outline.
    const label = (text, x, y, align) => {
      draw.font = "600 12px system-ui, sans-serif";
      const half = draw.measureText(text).width / 2, middle = align === "left" ? x + half : x;
      taken.push([middle - half - 1, y - 11, middle + half + 1, y + 3]);
      draw.textAlign = "center";
      draw.lineWidth = 3;
      draw.strokeStyle = color("--sea");
      draw.strokeText(text, middle, y);
      draw.fillStyle = color("--ink");
      draw.fillText(text, middle, y);
    };
    draw.setTransform(dots, 0, 0, dots, 0, 0);
    draw.clearRect(0, 0, wide, tall);
    draw.lineJoin = "round";
    const [width, height] = data.map;
    draw.strokeStyle = color("--ink");
    draw.lineWidth = 2;
    draw.strokeRect(X(0), Y(height), width * scale, height * scale);
    const frame = Math.floor(place), step = episode.shown[frame];
    if (look.heat) paint_heat(draw, data, episode, frame, { X, Y, scale }, color("--all-leaders"));
    const gone = agent => Boolean(look.removed) && (agent === look.removed.leader || look.removed.group && led[agent].includes(look.removed.leader));
    const circle = (x, y, radius) => { draw.beginPath(); draw.arc(X(x), Y(y), radius * scale, 0, 2 * Math.PI); };

    // POIs: a ring fills as agents arrive, and the disc changes colour once the POI is observed.
    const pois = data.pois.length, near = episode.near.slice(frame * pois, (frame + 1) * pois);
    const counts = data.pois.map(([x, y], poi) => {
      const ring = Math.max(7 * fit, Math.min(12, 1.3 * scale)) * size_of(data, poi);
      const done = episode.observed[poi] !== null && episode.observed[poi] <= step, needed = episode.coupling[poi];
      const closed = !done && !is_open(data, episode, poi, Math.max(1, step));
      const lost = (look.lost || []).includes(poi), tone = color(lost ? "--wrong" : done ? "--seen" : "--poi");
      circle(x, y, radius(data, poi));
      draw.fillStyle = tone;
      draw.globalAlpha = lost ? 0.16 : done ? 0.22 : closed ? 0.02 : 0.07;
      draw.fill();
      draw.globalAlpha = 1;
      if (look.radii) {
        draw.strokeStyle = tone;
        draw.lineWidth = 1.2 * fit;
        draw.setLineDash(done ? [] : closed ? [1.5, 6] : [5, 4]);
        draw.stroke();
        draw.setLineDash([]);
      }
      draw.lineWidth = 4 * fit;
      draw.strokeStyle = color("--line");
      draw.beginPath(); draw.arc(X(x), Y(y), ring, 0, 2 * Math.PI); draw.stroke();
      draw.strokeStyle = tone;
      if (near[poi] > 0) {
        const full = Math.min(near[poi] / needed, 1) * 2 * Math.PI;
        draw.beginPath(); draw.arc(X(x), Y(y), ring, -Math.PI / 2, full - Math.PI / 2); draw.stroke();
      }
      // Marks below the ring show which classes count, if not all do.
      const observers = observers_of(data, poi) || [], small = Math.max(3 * fit, 0.45 * ring);
      observers.forEach((own, index) => {
        const middle = X(x) + 3 * small * (index - (observers.length - 1) / 2), base = Math.min(Y(y) + ring + 2.4 * small, tall - 1.2 * small);
        draw.beginPath();
        for (const [ahead, aside] of outline(data, own)) draw.lineTo(middle + small * aside, base - small * ahead);
        draw.closePath();
        draw.fillStyle = draw.strokeStyle = color("--poi");
        draw.lineWidth = 1.2 * fit;
        if (learns(data, own)) draw.fill(); else draw.stroke();
      });
      // The counts of POIs at the same place are above each other.
      const same = data.pois.flatMap(([left, low], other) => left === x && low === y ? [other] : []);
      const base = Math.max(Y(y) - ring - 6, 15 * same.length - 3) - 15 * same.indexOf(poi);
      return [`${near[poi]}/${needed}${done ? " ✓" : lost ? " ✗" : ""}`, X(x), base];
    });

    const many = episode.agents > 100;
    if (look.trails) {
      draw.lineWidth = 1.4 * fit;
      draw.globalAlpha = many ? 0.3 : 0.6;
      const from = many ? Math.max(0, frame - 40) : 0;
      for (let agent = 0; agent < episode.agents; agent++) {
        if (gone(agent)) continue;
        draw.strokeStyle = group(agent);
        draw.setLineDash(dashes(agent));
        draw.beginPath();
        for (let past = from; past <= frame; past++) {
          const [x, y] = moment(data, episode, past, agent);
          draw.lineTo(X(x), Y(y));
        }
        const [x, y] = between(data, episode, place, agent);
        draw.lineTo(X(x), Y(y));
        draw.stroke();
      }
      draw.setLineDash([]);
      draw.globalAlpha = 1;
    }

    const now = Array.from({ length: episode.agents }, (_, agent) => between(data, episode, place, agent));
    const followers = episode.agents > episode.leaders, classes = of_each(data.classes);
    for (let leader = 0; leader < episode.leaders && followers && look.radii; leader++) {
      const own = data.classes && data.classes[classes[leader]];
      if (gone(leader)) continue;
      circle(now[leader][0], now[leader][1], own ? own.influence : data.attraction_radius);
      draw.strokeStyle = group(leader);
      draw.globalAlpha = many ? 0.3 : 0.7;
      draw.lineWidth = 1;
      draw.setLineDash([1.5, 4]);
      draw.stroke();
      draw.setLineDash([]);
      draw.globalAlpha = 1;
    }
    if (look.groups) {
      draw.lineWidth = 1;
      draw.globalAlpha = 0.55;
      for (let agent = episode.leaders; agent < episode.agents; agent++) {
        for (const leader of led[agent]) {
          if (gone(agent) || gone(leader)) continue;
          draw.strokeStyle = group(leader);
          draw.beginPath();
          draw.moveTo(X(now[agent][0]), Y(now[agent][1]));
          draw.lineTo(X(now[leader][0]), Y(now[leader][1]));
          draw.stroke();
        }
      }
      draw.globalAlpha = 1;
    }
    // Leaders are drawn last, on top of followers, and stand out from many.
    const size = Math.max(many ? 2.5 : 5 * fit, Math.min(9, 0.8 * scale));
    const leader_size = Math.max(1.35 * size, episode.leaders > 60 ? 0 : 6 * fit);
    for (let agent = episode.agents - 1; agent >= 0; agent--) {
      const [x, y, ahead, aside] = now[agent], leads = agent < episode.leaders, own = classes[agent];
      const free = own !== undefined && data.classes[own].free, long = Math.hypot(ahead, aside) || 1;
      const [cos, sin] = free ? [0, 1] : [ahead / long, aside / long];
      // An agent outside the part on show is drawn pale at its edge.
      const strays = X(x) < 0 || X(x) > wide || Y(y) < 0 || Y(y) > tall;
      const inside = (place, end) => strays ? Math.max(1.5 * size, Math.min(end - 1.5 * size, place)) : place;
      const left = inside(X(x), wide), high = inside(Y(y), tall);
      const own_size = leads ? leader_size : size;
      const point = (a, b) => [left + own_size * (a * cos - b * sin), high - own_size * (a * sin + b * cos)];
      draw.beginPath();
      for (const [a, b] of outline(data, own)) draw.lineTo(...point(a, b));
      draw.closePath();
      draw.fillStyle = leads ? group(agent) : color("--card");
      draw.strokeStyle = leads ? color("--ink") : group(agent);
      draw.lineWidth = (leads ? 1.2 : 1.6) * fit;
      draw.globalAlpha = gone(agent) ? 0.18 : strays ? 0.5 : 1;
      draw.fill();
      draw.stroke();
      draw.globalAlpha = 1;
      if (gone(agent) || strays) continue;
      if (!counts_at_pois(data, episode, agent)) {
        for (const [tone, wide] of [[color("--sea"), 4], [color("--ink"), 1.6]]) {
          draw.strokeStyle = tone;
          draw.lineWidth = wide;
          draw.beginPath(); draw.moveTo(...point(0, 1.1)); draw.lineTo(...point(0, -1.1)); draw.stroke();
        }
      }
    }
    // Labels come last: all counts if they fit, and that of the POI under the pointer; then the leaders' numbers.
    draw.font = "600 12px system-ui, sans-serif";
    // On a small canvas, values and windows would hide agents. The POI under the pointer has them.
    const told = counts.map(([text], poi) => wide >= 480 && when(data, poi) ? `${poi}: ${text}${when(data, poi)}` : text);
    const areas = counts.map((count, poi) => {
      const [, x, y] = count, half = draw.measureText(told[poi]).width / 2;
      count[1] = Math.max(half, Math.min(wide - half, x));
      return [count[1] - half - 2, y - 11, count[1] + half + 2, y + 3];
    });
    const clear = areas.every((area, index) => areas.slice(0, index).every(other => !overlap(area, other)));
    if (clear && labelled && (fit === 1 || wide * tall > 5000 * pois)) counts.forEach(([, x, y], poi) => { if (poi !== look.over) label(told[poi], x, y); });
    if (look.over !== null) {
      const [text, x, y] = counts[look.over];
      const words = `POI ${look.over}: ${text}${when(data, look.over)}${who(data, look.over)}`, half = Math.max(40, draw.measureText(words).width / 2 + 4);
      label(words, Math.max(half, Math.min(wide - half, x)), Math.max(12, y));
    }
    // A leader's number is placed at the first corner of its arrow where it is on the map and hides no other label, and omitted if there is none.
    const corners = [[1.1, 1.2], [1.1, -0.7], [-1.85, 1.2], [-1.85, -0.7]];
    for (let agent = 0; agent < episode.leaders && labelled; agent++) {
      const [x, y] = now[agent], text = String(agent), long = draw.measureText(text).width;
      const hides = ([across, down]) => {
        const left = X(x) + leader_size * across, base = Y(y) + leader_size * down;
        return left < 1 || left + long + 1 > wide || taken.some(other => overlap([left - 1, base - 11, left + long + 1, base + 3], other));
      };
      const corner = corners.find(corner => !hides(corner));
      if (corner) label(text, X(x) + leader_size * corner[0], Y(y) + leader_size * corner[1], "left");
    }
    return { step, near, led, positions: now.map(([x, y]) => [x, y]) };
  }

  // Returns the number of POIs observed by a step, and a description.
  function say(episode, step) {
    const seen = episode.observed.flatMap((at, poi) => at !== null && at <= step ? [`POI ${poi} at step ${at}`] : []);
    const list = seen.slice(0, 12).join(", ") + (seen.length > 12 ? " and more" : "");
    return [seen.length, `${seen.length} of ${episode.observed.length} POIs observed${list ? ": " + list : ""}`];
  }

  // Returns the POI nearest to a place on a canvas, if it is within the POI's radius.
  function poi_at(data, canvas, crop, x, y) {
    const { scale, X, Y } = place_on(canvas, crop);
    let [best, least] = [null, Infinity];
    data.pois.forEach(([px, py], poi) => {
      const away = Math.hypot(X(px) - x, Y(py) - y);
      if (away <= Math.min(least, Math.max(14, radius(data, poi) * scale))) [best, least] = [poi, away];
    });
    return best;
  }

  // Returns the place after some more seconds of play. Frames are not equally spaced: the last interval may be shorter.
  function later(data, episode, place, seconds) {
    const { shown } = episode, last = shown.length - 1;
    let left = seconds / data.dt;
    while (left > 0 && place < last) {
      const frame = Math.floor(place), gap = shown[frame + 1] - shown[frame];
      const part = Math.min(left, (frame + 1 - place) * gap);
      place = part === (frame + 1 - place) * gap ? frame + 1 : place + part / gap;
      left -= part;
    }
    return place;
  }

  return { night, bytes, moment, unpack, busy, whole, place_on, tint, paint, say, poi_at, later, legend };
})();
