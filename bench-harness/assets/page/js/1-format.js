// Numbers and elements. Text goes into the page as text only, never as markup.

const SVG = "http://www.w3.org/2000/svg";

/** An element of HTML: `h("td", {class: "left"}, "text", otherElement)`. */
function h(name, attributes = {}, ...children) {
  return fill(document.createElement(name), attributes, children);
}

/** The same of SVG. */
function s(name, attributes = {}, ...children) {
  return fill(document.createElementNS(SVG, name), attributes, children);
}

function fill(element, attributes, children) {
  for (const [key, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (typeof value === "function") element.addEventListener(key, value);
    else element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

const byId = (id) => document.getElementById(id);

/** Four decimals, as the command line prints scores; the number in full is the title. */
const fixed = (value) => (value === null || value === undefined ? "none" : value.toFixed(4));

/** A distance: four decimals, or its power of ten where that would be long. */
function decimals(value) {
  if (value === null || value === undefined) return "none";
  const size = Math.abs(value);
  if (value === 0 || (size >= 1e-4 && size < 1e7)) return value.toFixed(4);
  return value.toExponential(4).replace("e+", "e");
}

const percent = (share) => `${(100 * share).toFixed(1)} %`;

const count = (n, one, many = `${one}s`) => `${n.toLocaleString("en-US")} ${n === 1 ? one : many}`;

/** A cell with a number: rounded to read, in full in its title and for programs. */
function cell(value, text = fixed(value)) {
  const full = value === null || value === undefined ? null : String(value);
  return h("td", { "data-value": full, title: full }, text);
}

const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

/** Round numbers from low to high, about n. */
function ticks(low, high, n) {
  if (!(high > low)) return [low];
  const rough = (high - low) / n;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= rough * 0.999);
  const first = Math.ceil(low / step - 1e-9);
  const found = [];
  // Counted: far from 0 the next of two neighboring numbers may be the same number.
  for (let i = 0; i <= 2 * n; i++) {
    const at = (first + i) * step;
    if (!(at <= high + step * 1e-9)) break;
    const tick = Number(at.toPrecision(12));
    if (tick !== found[found.length - 1]) found.push(tick);
  }
  return found;
}
