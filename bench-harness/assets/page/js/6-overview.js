// All episodes: their steps as rows of colors, and their K-Sim beside how they ended.

const MOST_ROWS = 400;

/** Length of an episode as its steps are numbered, which may leave out numbers. */
const lengthOf = (episode) => Math.max(offset(episode, episode.n - 1) + 1, episode.value("n_steps"));

/** That of the longest. */
const LONGEST = episodes.reduce((most, episode) => Math.max(most, lengthOf(episode)), 1);

/** Steps since the first of an episode. */
function offset({ group, from }, k) {
  return group.step ? group.step[from + k] - group.step[from] : k;
}

/** Rows of colors: an episode each, or several where there are very many. */
function drawOverview() {
  const figure = byId("overview");
  const perRow = Math.ceil(episodes.length / MOST_ROWS);
  const rows = [];
  for (const group of groups) {
    const own = episodes.filter((episode) => episode.group === group);
    for (let i = 0; i < own.length; i += perRow) rows.push(own.slice(i, i + perRow));
  }
  const rowHeight = clamp(Math.floor(420 / rows.length), 2, 14);
  const names = 110;
  const width = Math.max(60, figure.clientWidth - names);
  const longest = LONGEST;
  const columns = Math.min(width, longest);
  let canvas = figure.querySelector("canvas");
  if (!canvas) {
    canvas = h("canvas", { tabindex: 0, role: "group", "aria-label": "K-Sim of the steps of all episodes: up and down choose an episode, left and right a step" });
    canvas.addEventListener("keydown", (event) => {
      const by = { ArrowDown: 1, ArrowUp: -1 }[event.key];
      if (!by) return walkSteps(event);
      event.preventDefault();
      const next = episodes[episodes.indexOf(chosen.episode) + by];
      if (next) pick(next);
    });
    figure.append(h("div", { class: "rows" }, canvas), colorBar(SCALES.score));
    canvas.addEventListener("pointermove", overviewHover);
    canvas.addEventListener("pointerleave", () => tip(figure, null));
    canvas.addEventListener("click", (event) => {
      const found = overviewAt(event);
      if (found) pick(found.episode, nearestPlace(found.episode, found.step));
    });
  }
  const ratio = devicePixelRatio || 1;
  const height = rows.length * rowHeight + 22;
  canvas.width = Math.round((names + width) * ratio);
  canvas.height = Math.round(height * ratio);
  canvas.style.width = `${names + width}px`;
  canvas.style.height = `${height}px`;
  const ctx = canvas.getContext("2d");
  ctx.scale(ratio, ratio);
  const lowest = new Float64Array(columns);
  rows.forEach((row, i) => {
    lowest.fill(Infinity);
    for (const episode of row) {
      for (let k = 0; k < episode.n; k++) {
        const column = Math.floor((offset(episode, k) * columns) / longest);
        const value = score(episode.group.scaled[episode.from + k]);
        if (value < lowest[column]) lowest[column] = value;
      }
    }
    paintRow(ctx, lowest, { left: names, top: i * rowHeight, width, height: rowHeight - (rowHeight > 4 ? 1 : 0) }, row);
  });
  nameRows(ctx, rows, rowHeight, names);
  ctx.fillStyle = css("--soft");
  for (const tick of ticks(0, longest, 8)) {
    ctx.textAlign = tick === 0 ? "left" : tick > 0.97 * longest ? "right" : "center";
    ctx.fillText(String(tick), names + (tick / longest) * width, rows.length * rowHeight + 16);
  }
  figure.overview = { rows, rowHeight, names, width, longest, canvas };
  markOverview();
}

const nearestPlace = (episode, steps) => placeOf(episode, steps + (episode.group.step ? episode.group.step[episode.from] : 0));

/** A row of colors, up to the end of its longest episode: gaps of thinned steps take the color before them. */
function paintRow(ctx, lowest, box, row) {
  const columns = lowest.length;
  const end = row.reduce((most, episode) => Math.max(most, lengthOf(episode)), 0);
  const until = Math.min(columns, Math.ceil((end * columns) / LONGEST));
  const x = (column) => box.left + (column * box.width) / columns;
  const color = (value) => (value === Infinity ? null : colorOf(SCALES.score, value));
  let [start, last] = [0, null];
  for (let column = 0; column <= until; column++) {
    const next = column === until ? null : (color(lowest[column]) ?? last);
    if (column < until && next === last) continue;
    if (last !== null) {
      ctx.fillStyle = last;
      ctx.fillRect(x(start), box.top, x(column) - x(start) + 0.4, box.height);
    }
    [start, last] = [column, next];
  }
}

/** Names of the rollouts beside their rows. */
function nameRows(ctx, rows, rowHeight, room) {
  ctx.font = "11px system-ui, sans-serif";
  ctx.textBaseline = "middle";
  ctx.textAlign = "left";
  groups.forEach((group) => {
    const own = rows.map((row, i) => [row[0].group, i]).filter(([of]) => of === group);
    if (own.length === 0) return;
    const [from, to] = [own[0][1] * rowHeight, (own[own.length - 1][1] + 1) * rowHeight];
    ctx.fillStyle = groupPaint(group);
    ctx.fillRect(room - 8, from, 4, to - from - 1);
    if (to - from < 11) return;
    ctx.fillStyle = css("--text");
    ctx.fillText(shortened(ctx, group.label, room - 14), 0, (from + to) / 2);
  });
  ctx.textBaseline = "alphabetic";
}

function shortened(ctx, text, room) {
  if (ctx.measureText(text).width <= room) return text;
  let kept = text;
  while (kept.length > 1 && ctx.measureText(`${kept}…`).width > room) kept = kept.slice(0, -1);
  return `${kept}…`;
}

function overviewAt(event) {
  const { rows, rowHeight, names, width, longest, canvas } = byId("overview").overview;
  const box = canvas.getBoundingClientRect();
  const [x, y] = [event.clientX - box.left, event.clientY - box.top];
  const row = rows[Math.floor(y / rowHeight)];
  if (!row || x < names) return null;
  const step = Math.floor(((x - names) / width) * longest);
  const episode = row.length === 1 ? row[0] : row.reduce((a, b) => (b.value("k_sim") < a.value("k_sim") ? b : a));
  return { row, episode, step, at: [x, y] };
}

function overviewHover(event) {
  const found = overviewAt(event);
  if (!found || found.step >= lengthOf(found.episode)) return tip(byId("overview"), null);
  const { episode, row } = found;
  const step = stepOf(episode, nearestPlace(episode, found.step));
  const name = row.length === 1 ? `episode ${episode.number}` : `episode ${episode.number}, the lowest of ${row.length} in this row`;
  tip(byId("overview"), `${episode.group.label}\n${name}: K-Sim ${fixed(episode.value("k_sim"))}\nstep ${step.step}: ${fixed(step.score)}`, found.at);
}

/** A frame around the chosen episode's row. */
function markOverview() {
  const figure = byId("overview");
  const { rows, rowHeight, names, width } = figure.overview;
  let frame = figure.querySelector(".row-mark");
  if (!frame) {
    frame = h("div", { class: "row-mark" });
    figure.querySelector(".rows").append(frame);
  }
  const row = rows.findIndex((row) => row.includes(chosen.episode));
  Object.assign(frame.style, { left: `${names}px`, top: `${row * rowHeight - 1}px`, width: `${width}px`, height: `${rowHeight + 1}px` });
}

function overviewNote() {
  const perRow = Math.ceil(episodes.length / MOST_ROWS);
  byId("overview-note").textContent = `${perRow === 1 ? "A row is an episode" : `A row is up to ${perRow} episodes`}, from its first step to its last, in the color of ${perRow === 1 ? "the" : "their lowest"} K-Sim; 1, the brightest, is saturated. Where steps are more than pixels, a pixel shows the lowest. Choose one to see it below.`;
}

/** K-Sim of every episode beside how it ended. */
const OUTCOMES = {
  success: { name: "success", of: (episode, i) => (episode.value("success") === null ? null : Number(episode.value("success")) + 0.56 * (((i * 0.618034) % 1) - 0.5)) },
  return: { name: "return", of: (episode) => episode.value("return") },
  distance: { name: "mean d/√d", of: (episode) => episode.value("mean_scaled_distance") },
};

const outcomeKinds = () => {
  const known = ["success", "return"].filter((name) => episodes.some((episode) => episode.value(name) !== null));
  return known.length > 0 ? known : ["distance"];
};

function drawOutcome() {
  const figure = byId("outcome");
  const kind = byId("outcome-by").value;
  const [width, height, left, bottom, top, right] = [Math.max(240, figure.clientWidth), 280, 76, 40, 10, 12];
  const points = episodes.map((episode, i) => ({ episode, x: episode.value("k_sim"), y: OUTCOMES[kind].of(episode, i) })).filter((point) => point.y !== null);
  const values = points.map((point) => point.y);
  const xs = points.map((point) => point.x);
  const [lowX, highX] = around(Math.min(...xs), Math.max(...xs), [0, 1]);
  const [low, high] = kind === "success" ? [-0.42, 1.42] : around(values.reduce((a, b) => Math.min(a, b), Infinity), values.reduce((a, b) => Math.max(a, b), -Infinity));
  const x = (value) => left + ((value - lowX) / (highX - lowX)) * (width - left - right);
  const y = (value) => height - bottom - ((value - low) / (high - low)) * (height - bottom - top);
  const svg = s("svg", { width, height, viewBox: `0 0 ${width} ${height}`, tabindex: 0, role: "group", "aria-label": `K-Sim of every episode beside its ${OUTCOMES[kind].name}: left and right choose the next lower and higher K-Sim` });
  for (const tick of ticks(lowX, highX, 5)) {
    svg.append(s("line", { x1: x(tick), x2: x(tick), y1: top, y2: height - bottom, stroke: "var(--line)" }), s("text", { x: x(tick), y: height - bottom + 15, "text-anchor": "middle" }, String(tick)));
  }
  const marks = kind === "success" ? [[0, "no success"], [1, "success"]] : ticks(low, high, 5).map((tick) => [tick, String(tick)]);
  for (const [value, name] of marks) {
    if (kind !== "success") svg.append(s("line", { x1: left, x2: width - right, y1: y(value), y2: y(value), stroke: "var(--line)" }));
    svg.append(s("text", { x: left - 7, y: y(value) + 4, "text-anchor": "end" }, name));
  }
  if (kind === "success") svg.append(s("line", { x1: left, x2: width - right, y1: y(0.5), y2: y(0.5), stroke: "var(--line)" }));
  svg.append(s("text", { x: (left + width - right) / 2, y: height - 7, "text-anchor": "middle" }, "K-Sim of the episode"));
  const middle = (height - bottom + top) / 2;
  if (kind !== "success") svg.append(s("text", { x: 13, y: middle, "text-anchor": "middle", transform: `rotate(-90 13 ${middle})` }, OUTCOMES[kind].name));
  for (const group of groups) {
    const own = points.filter((point) => point.episode.group === group);
    const few = points.length <= 500;
    const dots = own.map((point) => groupShape(group)(x(point.x), y(point.y), few ? 4.2 : 2.6)).join("");
    svg.append(s("path", { d: dots, fill: groupColor(group), "fill-opacity": few ? 0.85 : 0.6, class: "dots" }));
  }
  const ring = s("circle", { r: 7.5, fill: "none", stroke: "var(--text)", "stroke-width": 2, visibility: "hidden" });
  svg.append(ring);
  figure.replaceChildren(svg, key());
  figure.outcome = { points: points.map((point) => ({ episode: point.episode, x: x(point.x), y: y(point.y) })), ring };
  svg.addEventListener("pointermove", (event) => {
    const near = nearest(figure, event);
    tip(figure, near && `${near.episode.group.label}\nepisode ${near.episode.number}: K-Sim ${fixed(near.episode.value("k_sim"))}\n${outcome(near.episode) || `mean d/√d ${decimals(near.episode.value("mean_scaled_distance"))}`}`, near ? [near.x, near.y] : [0, 0]);
  });
  svg.addEventListener("pointerleave", () => tip(figure, null));
  svg.addEventListener("click", (event) => {
    const near = nearest(figure, event);
    if (near) pick(near.episode);
  });
  const byKSim = [...points].sort((a, b) => a.x - b.x).map((point) => point.episode);
  svg.addEventListener("keydown", (event) => {
    const by = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!by) return;
    event.preventDefault();
    const next = byKSim[byKSim.indexOf(chosen.episode) + by];
    if (next) pick(next);
  });
  markOutcome();
}

/** A range with some room, not beyond the limits. */
function around(low, high, [least, most] = [-Infinity, Infinity]) {
  const size = Math.max(Math.abs(low), Math.abs(high));
  // Numbers that are the same but for rounding have no range of their own.
  const room = high - low > 1e-9 * size ? 0.06 * (high - low) : Math.max(0.05, 0.05 * size);
  return [Math.max(least, low - room), Math.min(most, high + room)];
}

function nearest(figure, event) {
  const box = figure.getBoundingClientRect();
  const [x, y] = [event.clientX - box.left, event.clientY - box.top];
  let [best, least] = [null, 20 ** 2];
  for (const point of figure.outcome.points) {
    const away = (point.x - x) ** 2 + (point.y - y) ** 2;
    if (away < least) [best, least] = [point, away];
  }
  return best;
}

function markOutcome() {
  const { points, ring } = byId("outcome").outcome;
  const own = points.find((point) => point.episode === chosen.episode);
  ring.setAttribute("visibility", own ? "visible" : "hidden");
  if (own) fill(ring, { cx: own.x, cy: own.y }, []);
}

/** Which color is which rollouts. */
const key = () => h("div", { class: "key" }, ...groups.map((group) => h("span", {}, swatch(group), group.label)));

function outcomeNote() {
  const kinds = outcomeKinds();
  byId("outcome-by").append(...kinds.map((name) => h("option", { value: name }, OUTCOMES[name].name)));
  byId("outcome-choice").hidden = kinds.length < 2;
  byId("outcome-note").textContent = kinds[0] === "distance" ? "The files record neither success nor rewards: beside K-Sim stands the mean distance, which does not saturate." : "A mark is an episode. Choose one to see it below.";
}
