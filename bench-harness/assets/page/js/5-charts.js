// Lines over numbers, by uPlot: one episode over its steps, and the distances of all.

const chosen = { episode: episodes[0], k: 0 };

// The last line is drawn over the others.
const QUANTITIES = {
  score: {
    name: "K-Sim",
    lines: [["state part", (step) => step.stateScore], ["action part", (step) => step.actionScore], ["K-Sim", (step) => step.score]],
    range: [0, 1.05],
    text: fixed,
  },
  scaled: {
    name: "distance, d/√d",
    lines: [["state part", (step) => step.state], ["action part", (step) => step.action], ["d/√d", (step) => step.scaled]],
    text: decimals,
    limit: gamma,
  },
};
if (groups.some((group) => group.novelty)) {
  QUANTITIES.novelty = { name: "curiosity of the plan", lines: [["novelty", (step) => step.novelty]], text: decimals };
}

const axis = (label, size) => ({
  label,
  size,
  labelSize: 20,
  font: "11px system-ui, sans-serif",
  labelFont: "12px system-ui, sans-serif",
  stroke: () => css("--text"),
  grid: { stroke: () => css("--line"), width: 1 },
  ticks: { stroke: () => css("--line"), width: 1 },
});

let timeline = null;

/** Shades the steps with score 1, which say no more than that. */
function shadeSaturated(plot) {
  const { episode } = chosen;
  const { ctx } = plot;
  ctx.save();
  ctx.fillStyle = css("--shade");
  const half = (k) => (k + 1 < episode.n ? (plot.data[0][k + 1] - plot.data[0][k]) / 2 : 0.5);
  for (let k = 0; k < episode.n; k++) {
    if (score(episode.group.scaled[episode.from + k]) < 1) continue;
    const start = k;
    while (k + 1 < episode.n && score(episode.group.scaled[episode.from + k + 1]) === 1) k++;
    const [left, right] = [plot.data[0][start] - half(start), plot.data[0][k] + half(k)].map((x) => clamp(plot.valToPos(x, "x", true), plot.bbox.left, plot.bbox.left + plot.bbox.width));
    ctx.fillRect(left, plot.bbox.top, Math.max(1, right - left), plot.bbox.height);
  }
  const { limit } = QUANTITIES[byId("quantity").value];
  if (limit !== undefined) mark(plot, limit, true);
  ctx.restore();
}

/** A dashed line across at a value, or from bottom to top. */
function mark(plot, value, across) {
  const { ctx, bbox } = plot;
  const at = plot.valToPos(value, across ? "y" : "x", true);
  ctx.save();
  ctx.strokeStyle = css("--soft");
  ctx.setLineDash([6, 5]);
  ctx.beginPath();
  if (across && at >= bbox.top && at <= bbox.top + bbox.height) {
    ctx.moveTo(bbox.left, at);
    ctx.lineTo(bbox.left + bbox.width, at);
  } else if (!across && at >= bbox.left && at <= bbox.left + bbox.width) {
    ctx.moveTo(at, bbox.top);
    ctx.lineTo(at, bbox.top + bbox.height);
  }
  ctx.stroke();
  ctx.restore();
}

/** The timeline of the chosen episode, anew. */
function drawTimeline() {
  const figure = byId("timeline");
  const { episode } = chosen;
  const quantity = QUANTITIES[byId("quantity").value];
  const steps = Array.from({ length: episode.n }, (_, k) => stepOf(episode, k));
  const paint = groupPaint(episode.group);
  const parts = [{ dash: [5, 3] }, { dash: [1.5, 2.5] }].map((style) => ({ stroke: css("--soft"), width: 1, alpha: 0.6, ...style }));
  const styles = [...parts.slice(0, quantity.lines.length - 1), { stroke: paint, width: 1.8 }];
  const series = quantity.lines.map(([label], i) => ({
    label,
    ...styles[i],
    value: (_, value) => (value === null ? "–" : quantity.text(value)),
    points: { show: episode.n < 3 },
  }));
  const options = {
    width: figure.clientWidth,
    height: 230,
    series: [{ label: "step", value: (_, value) => (value === null ? "–" : String(value)) }, ...series],
    axes: [axis("step", 42), axis(quantity.name, 52)],
    scales: { x: { time: false }, y: { range: quantity.range ?? ((_, low, high) => [Math.min(0, low), high > 0 ? 1.05 * high : 1]) } },
    cursor: { points: { size: 7 }, drag: { x: true, y: false } },
    hooks: { ready: [followTimeline], drawClear: [shadeSaturated], setCursor: [(plot) => plot.cursor.event && plot.cursor.idx !== null && choose(plot.cursor.idx, "timeline")] },
  };
  timeline?.destroy();
  const values = quantity.lines.map(([, of]) => steps.map((step) => (Number.isFinite(of(step)) ? of(step) : null)));
  timeline = new uPlot(options, [steps.map((step) => step.step), ...values], figure);
}

/** Puts the timeline's cursor on the chosen step, once it knows its scales. */
function followTimeline() {
  if (timeline?.status !== 1) return;
  const left = timeline.valToPos(timeline.data[0][chosen.k], "x");
  const value = timeline.data[timeline.data.length - 1][chosen.k];
  timeline.setCursor({ left, top: value === null ? 0 : timeline.valToPos(value, "y") }, false);
  timeline.setLegend({ idx: chosen.k }, false);
}

let distances = null;

/** Distances of all steps, and of demonstrations held against all others. */
function drawDistances() {
  const figure = byId("distances");
  const { low, high, n } = data.histogram;
  const width = (high - low) / n;
  const edges = Array.from({ length: n + 1 }, (_, i) => (i === n ? high : low + width * i));
  // A bin reaches from its edge to the next; the last edge only ends the last bin.
  const outline = (counts) => [...shares(counts), shares(counts)[n - 1]];
  const shown = groups.map((group) => ({ label: group.label, stroke: groupPaint(group), width: 2, dash: groupDash(group), counts: group.histogram }));
  if (data.held_out) shown.push({ label: HELD_OUT, stroke: css("--data"), width: 1, fill: css("--held"), counts: data.held_out.histogram });
  const bin = (value) => (value > high - 1.5 * width ? `${edges[n - 1].toFixed(3)} and more` : `${value.toFixed(3)} – ${(value + width).toFixed(3)}`);
  const options = {
    width: figure.clientWidth,
    height: 280,
    series: [
      { label: "d/√d", value: (_, value) => (value === null ? "–" : bin(value)) },
      ...shown.map(({ counts, ...style }) => ({ ...style, points: { show: false }, paths: uPlot.paths.stepped({ align: 1 }), value: (_, value) => (value === null ? "–" : `${value.toFixed(2)} %`) })),
    ],
    axes: [axis("distance to the matched step, d/√d", 42), axis("steps, %", 52)],
    scales: { x: { time: false }, y: { range: (_, __, most) => [0, 1.05 * (most || 1)] } },
    cursor: { dataIdx: (plot, series, nearest, value) => clamp(Math.floor((value - low) / width), 0, n - 1) },
    hooks: { drawClear: [(plot) => mark(plot, gamma, false)] },
  };
  distances?.destroy();
  distances = new uPlot(options, [edges, ...shown.map(({ counts }) => outline(counts))], figure);
  // Lines of the legend as they are in the figure.
  figure.querySelectorAll(".u-series .u-marker").forEach((marker, i) => {
    const style = shown[i - 1];
    if (!style) return;
    const { stroke, fill = "none", dash = [] } = style;
    marker.removeAttribute("style");
    marker.replaceChildren(s("svg", { width: 26, height: 10, "aria-hidden": "true" }, s("path", { d: fill === "none" ? "M0 5H26" : "M0.5 10V0.5H25.5V10", fill, stroke, "stroke-width": style.width, "stroke-dasharray": dash.join(" ") || null })));
  });
}

const HELD_OUT = "held-out demonstrations";

/** Counts of bins in percent. */
function shares(counts) {
  const total = counts.reduce((a, b) => a + b, 0) || 1;
  return counts.map((count) => (100 * count) / total);
}

/** The same numbers as a table, of a few bins together; γ is an edge where bins have it as one. */
function distancesTable() {
  const MOST = 12;
  const { low, high, n } = data.histogram;
  const width = (high - low) / n;
  const perGamma = gamma / width >= 0.5 && gamma < high ? Math.round(gamma / width) : 1;
  const parts = Array.from({ length: perGamma }, (_, i) => i + 1).filter((part) => perGamma % part === 0);
  const together = parts.find((part) => n / part <= MOST) ?? perGamma * Math.ceil(n / perGamma / MOST);
  const starts = Array.from({ length: Math.ceil(n / together) }, (_, i) => i * together);
  const edge = (bin) => String(Number((low + width * Math.min(n, bin)).toPrecision(4)));
  const head = starts.map((start) => (start + together >= n ? `${edge(start)} and more` : `${edge(start)} – ${edge(start + together)}`));
  const row = (name, counts) => {
    const all = shares(counts);
    const sum = (start) => all.slice(start, start + together).reduce((a, b) => a + b, 0);
    return h("tr", {}, h("th", { scope: "row", class: "name" }, name), ...starts.map((start) => cell(sum(start), `${sum(start).toFixed(1)} %`)));
  };
  const rows = groups.map((group) => row(group.label, group.histogram));
  if (data.held_out) rows.push(row(HELD_OUT, data.held_out.histogram));
  byId("distances-table").replaceChildren(h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "d/√d"), ...head.map((name) => h("th", { scope: "col" }, name)))), h("tbody", {}, ...rows));
}

function distancesNote() {
  const held = data.held_out;
  byId("distances-note").textContent =
    `Left of the dashed line at γ = ${gamma} a step is saturated: its score is 1. The last bin holds all that lies farther. ` +
    (held
      ? `Shaded, what “in the data” looks like: ${count(held.n_episodes, "episode")} of the dataset itself (${count(held.n_steps, "step")}, chosen by seed ${held.seed}), each compared with all other episodes: K-Sim ${fixed(held.k_sim)}, mean d/√d ${decimals(held.mean_scaled_distance)}.`
      : data.held_out_missing);
}
