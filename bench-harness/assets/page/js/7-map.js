// Where the chosen episode went: through its maze, or in the two main components of the states.

const LEVELS = 6;

/** Meters or components to pixels. */
function mapFrame(width) {
  const { x, y } = data.map;
  const [left, right, top, bottom] = [46, 8, 8, 34];
  const free = width - left - right;
  // A maze is equally scaled both ways.
  const tall = data.map.kind === "maze" ? (free * (y[1] - y[0])) / (x[1] - x[0]) : 0.72 * free;
  return {
    left,
    top,
    right: left + free,
    bottom: top + tall,
    width,
    height: top + tall + bottom,
    x: (value) => left + ((value - x[0]) / (x[1] - x[0])) * free,
    y: (value) => top + (1 - (value - y[0]) / (y[1] - y[0])) * tall,
  };
}

/** The training data as a cloud: darker where there is more of them. */
function cloud(frame) {
  const { n, levels } = data.map.density;
  const { x, y } = data.map;
  const places = unpack(levels);
  const [width, height] = [(x[1] - x[0]) / n[0], (y[1] - y[0]) / n[1]];
  const paths = Array.from({ length: LEVELS }, () => "");
  places.forEach((level, i) => {
    if (level === 0) return;
    const [column, row] = [i % n[0], Math.floor(i / n[0])];
    const [left, top] = [frame.x(x[0] + column * width), frame.y(y[0] + (row + 1) * height)];
    const [right, bottom] = [frame.x(x[0] + (column + 1) * width), frame.y(y[0] + row * height)];
    paths[Math.ceil((level * LEVELS) / 255) - 1] += `M${left.toFixed(1)} ${top.toFixed(1)}H${right.toFixed(1)}V${bottom.toFixed(1)}H${left.toFixed(1)}Z`;
  });
  return s("g", { fill: "var(--cloud)", "shape-rendering": "crispEdges" }, ...paths.map((d, i) => s("path", { d, "fill-opacity": 0.1 + (0.45 * i) / (LEVELS - 1) })));
}

function walls(frame) {
  const { rows, cell } = data.map;
  const { x, y } = data.map;
  let d = "";
  rows.forEach((row, i) => {
    [...row].forEach((tile, j) => {
      if (tile !== "1") return;
      const [left, right] = [frame.x(x[0] + j * cell), frame.x(x[0] + (j + 1) * cell)];
      const [top, bottom] = [frame.y(y[1] - i * cell), frame.y(y[1] - (i + 1) * cell)];
      d += `M${left.toFixed(2)} ${top.toFixed(2)}H${right.toFixed(2)}V${bottom.toFixed(2)}H${left.toFixed(2)}Z`;
    });
  });
  return s("path", { d, fill: "var(--wall)", stroke: "var(--wall)", "stroke-width": 0.4 });
}

function mapAxes(frame) {
  const { x, y, labels } = data.map;
  const group = s("g");
  for (const tick of ticks(x[0], x[1], 5)) group.append(s("line", { x1: frame.x(tick), x2: frame.x(tick), y1: frame.bottom, y2: frame.bottom + 4, stroke: "var(--soft)" }), s("text", { x: frame.x(tick), y: frame.bottom + 15, "text-anchor": "middle" }, String(tick)));
  for (const tick of ticks(y[0], y[1], 5)) group.append(s("line", { x1: frame.left - 4, x2: frame.left, y1: frame.y(tick), y2: frame.y(tick), stroke: "var(--soft)" }), s("text", { x: frame.left - 7, y: frame.y(tick) + 4, "text-anchor": "end" }, String(tick)));
  const middle = (frame.top + frame.bottom) / 2;
  group.append(s("text", { x: (frame.left + frame.right) / 2, y: frame.bottom + 30, "text-anchor": "middle" }, labels[0]), s("text", { x: 12, y: middle, "text-anchor": "middle", transform: `rotate(-90 12 ${middle})` }, labels[1]));
  return group;
}

/** The path in its colors, on a line that keeps light ones visible. */
function coloredPath(frame, points, scale) {
  const group = s("g", { fill: "none", "stroke-linejoin": "round", "stroke-linecap": "round" });
  const at = points.map((step) => `${frame.x(step.at[0]).toFixed(1)} ${frame.y(step.at[1]).toFixed(1)}`);
  group.append(s("path", { d: `M${at.join("L")}`, stroke: "var(--text)", "stroke-width": 3.6, "stroke-opacity": 0.75, class: "path" }));
  let start = 0;
  for (let k = 1; k <= points.length; k++) {
    const color = colorOf(scale, scale.of(points[start]));
    if (k < points.length - 1 && colorOf(scale, scale.of(points[k])) === color) continue;
    group.append(s("path", { d: `M${at.slice(start, k + 1).join("L")}`, stroke: color, "stroke-width": 2.4 }));
    start = k;
  }
  return group;
}

function star(x, y, radius) {
  const corner = (i) => {
    const [angle, far] = [(i * Math.PI) / 5, i % 2 ? 0.42 * radius : radius];
    return `${(x + far * Math.sin(angle)).toFixed(1)} ${(y - far * Math.cos(angle)).toFixed(1)}`;
  };
  return s("path", { d: `M${Array.from({ length: 10 }, (_, i) => corner(i)).join("L")}Z`, fill: "#d55e00", stroke: "var(--back)" });
}

/** The map of the chosen episode, anew. */
function drawMap() {
  const figure = byId("map");
  const { episode } = chosen;
  const frame = mapFrame(clamp(figure.clientWidth, 220, 620));
  const scale = { ...SCALES[byId("color").value] };
  const points = Array.from({ length: episode.n }, (_, k) => stepOf(episode, k));
  if (byId("color").value === "step") scale.high = Math.max(1, points[points.length - 1].step);
  const svg = s("svg", { width: frame.width, height: frame.height, viewBox: `0 0 ${frame.width} ${frame.height}`, tabindex: 0, role: "group", "aria-label": `path of episode ${episode.number}: left and right choose a step` });
  svg.append(s("rect", { x: frame.left, y: frame.top, width: frame.right - frame.left, height: frame.bottom - frame.top, fill: "var(--floor)" }), cloud(frame));
  if (data.map.kind === "maze") svg.append(walls(frame));
  svg.append(mapAxes(frame), coloredPath(frame, points, scale));
  const goals = episode.group.goals?.[episode.place] ?? [];
  for (const goal of goals) svg.append(star(frame.x(goal[0]), frame.y(goal[1]), goals.length > 12 ? 4 : 9));
  const [x, y] = [frame.x(points[0].at[0]), frame.y(points[0].at[1])];
  svg.append(s("circle", { cx: x, cy: y, r: 4.5, fill: "var(--back)", stroke: "var(--text)", "stroke-width": 1.8 }));
  const link = s("line", { stroke: "var(--text)", "stroke-width": 1.4, "stroke-dasharray": "3 2" });
  const match = s("rect", { width: 10, height: 10, fill: "var(--back)", stroke: "var(--text)", "stroke-width": 2 });
  const here = s("circle", { r: 6.5, fill: groupColor(episode.group), stroke: "var(--text)", "stroke-width": 2 });
  svg.append(link, match, here);
  svg.addEventListener("pointermove", (event) => {
    const box = svg.getBoundingClientRect();
    const [px, py] = [event.clientX - box.left, event.clientY - box.top];
    let [best, least] = [null, 30 ** 2];
    points.forEach((step, k) => {
      const away = (frame.x(step.at[0]) - px) ** 2 + (frame.y(step.at[1]) - py) ** 2;
      if (away < least) [best, least] = [k, away];
    });
    if (best !== null) choose(best);
    tip(figure, best === null ? null : `step ${points[best].step}: K-Sim ${fixed(points[best].score)}`, [px, py]);
  });
  svg.addEventListener("pointerleave", () => tip(figure, null));
  svg.addEventListener("keydown", walkSteps);
  figure.replaceChildren(svg, colorBar(scale));
  figure.map = { frame, link, match, here };
  markMap();
}

/** Puts the markers on the chosen step and its match. */
function markMap() {
  const { frame, link, match, here } = byId("map").map;
  const step = stepOf(chosen.episode, chosen.k);
  const [x, y] = [frame.x(step.at[0]), frame.y(step.at[1])];
  const [mx, my] = [frame.x(step.match[0]), frame.y(step.match[1])];
  fill(here, { cx: x, cy: y }, []);
  fill(match, { x: mx - 5, y: my - 5 }, []);
  fill(link, { x1: x, y1: y, x2: mx, y2: my }, []);
}

function mapNote() {
  const what = data.map.kind === "maze" ? "The maze from above" : data.map.explained;
  byId("map-note").textContent = `${what}. Shaded: where the dataset’s steps are. Ring: start${groups.some((group) => group.goals) ? ", star: goal" : ""}. Disc: the chosen step; square: the demonstration’s step it was matched with.`;
}
