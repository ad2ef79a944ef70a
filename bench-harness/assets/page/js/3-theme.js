// Colors: of the style sheet, and of numbers.

const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** Rollouts are told apart by color, and by shape or dash: both together come again only after 30 of them. */
const COLORS = 6;
const groupColor = (group) => `var(--g${group.place % COLORS})`;
const groupPaint = (group) => css(`--g${group.place % COLORS}`);
const DASHES = [[], [9, 3], [2, 2.5], [9, 3, 2, 3], [5, 3]];
const groupDash = (group) => DASHES[group.place % DASHES.length];

/** Outlines around a point, of about the same area at a radius. */
const polygon = (corners) => (x, y, r) => `M${corners.map(([a, b]) => `${(x + a * r).toFixed(1)} ${(y + b * r).toFixed(1)}`).join("L")}Z`;
const SHAPES = [
  (x, y, r) => `M${(x - r).toFixed(1)} ${y.toFixed(1)}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0Z`,
  polygon([[0, -1.25], [1.15, 0.8], [-1.15, 0.8]]),
  polygon([[-0.9, -0.9], [0.9, -0.9], [0.9, 0.9], [-0.9, 0.9]]),
  polygon([[-0.4, -1.2], [0.4, -1.2], [0.4, -0.4], [1.2, -0.4], [1.2, 0.4], [0.4, 0.4], [0.4, 1.2], [-0.4, 1.2], [-0.4, 0.4], [-1.2, 0.4], [-1.2, -0.4], [-0.4, -0.4]]),
  polygon([[0, -1.35], [1.1, 0], [0, 1.35], [-1.1, 0]]),
  polygon([[0, 1.25], [1.15, -0.8], [-1.15, -0.8]]),
  polygon([[-1.2, -0.65], [-0.65, -1.2], [0, -0.55], [0.65, -1.2], [1.2, -0.65], [0.55, 0], [1.2, 0.65], [0.65, 1.2], [0, 0.55], [-0.65, 1.2], [-1.2, 0.65], [-0.55, 0]]),
];
const groupShape = (group) => SHAPES[group.place % SHAPES.length];

/** How numbers of steps become colors. */
const SCALES = {
  score: {
    name: "K-Sim of the step",
    colors: data.palettes.k_sim,
    low: 0,
    high: 1,
    of: (step) => step.score,
  },
};
if (groups.some((group) => group.novelty)) {
  let [low, high] = [Infinity, -Infinity];
  for (const group of groups) {
    for (const value of group.novelty ?? []) {
      if (value < low) low = value;
      if (value > high) high = value;
    }
  }
  SCALES.novelty = {
    name: "curiosity: novelty of the plan",
    colors: data.palettes.novelty,
    low,
    high: high > low ? high : low + 1,
    of: (step) => step.novelty,
  };
}
SCALES.step = {
  name: "step",
  colors: data.palettes.step,
  low: 0,
  high: 1,
  of: (step) => step.step,
};

function colorOf(scale, value) {
  if (!Number.isFinite(value)) return css("--soft");
  const level = Math.floor(((value - scale.low) / (scale.high - scale.low)) * scale.colors.length);
  return scale.colors[clamp(level, 0, scale.colors.length - 1)];
}

/** The bar that explains a scale. */
function colorBar(scale) {
  const width = 180;
  const svg = s("svg", { width: width + 40, height: 34, role: "img", "aria-label": `color scale: ${scale.name} from ${scale.low} to ${scale.high}` });
  const band = width / scale.colors.length;
  scale.colors.forEach((color, i) => svg.append(s("rect", { x: 10 + i * band, y: 2, width: band + 0.5, height: 10, fill: color })));
  for (const tick of ticks(scale.low, scale.high, 4)) {
    const x = 10 + ((tick - scale.low) / (scale.high - scale.low)) * width;
    svg.append(s("text", { x, y: 25, "text-anchor": "middle" }, String(tick)));
  }
  return h("div", { class: "key" }, svg, h("span", { class: "small" }, scale.name));
}

/** Functions that draw what depends on size or colors. */
const drawn = [];
function redraw() {
  for (const draw of drawn) draw();
}

/** Draws now, and again when the element gets another width. */
function keepDrawn(element, draw) {
  let width = element.clientWidth;
  drawn.push(draw);
  draw();
  new ResizeObserver(() => {
    if (Math.abs(element.clientWidth - width) < 2) return;
    width = element.clientWidth;
    draw();
  }).observe(element);
}

matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
// Paper is light and narrow, whatever the screen is.
function onPaper(is) {
  document.documentElement.classList.toggle("print", is);
  redraw();
}
addEventListener("beforeprint", () => onPaper(true));
addEventListener("afterprint", () => onPaper(false));
matchMedia("print").addEventListener("change", (event) => onPaper(event.matches));

/** A note beside the pointer; `null` hides it. */
function tip(figure, text, [x, y] = [0, 0]) {
  let note = figure.querySelector(":scope > .tip");
  if (!note) {
    note = h("div", { class: "tip", hidden: true });
    figure.append(note);
  }
  note.hidden = text === null;
  if (text === null) return;
  note.textContent = text;
  const right = x > figure.clientWidth / 2;
  note.style.left = right ? "" : `${x + 14}px`;
  note.style.right = right ? `${figure.clientWidth - x + 14}px` : "";
  note.style.top = `${Math.max(0, y - 10)}px`;
}
