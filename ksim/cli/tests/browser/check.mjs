// Opens pages of `ksim report` in a headless browser and uses them: node check.mjs FOLDER
//
// FOLDER holds pages (NAME.html) and beside each what `ksim score --format json` says of the same rollouts (NAME.json),
// with columns of `--per-step` as its field "steps".
// CHROMIUM is the browser, SCREENSHOTS a folder for pictures of every page.
import assert from "node:assert/strict";
import fs from "node:fs";
import path from "node:path";
import { pathToFileURL } from "node:url";
import { chromium } from "playwright-core";

const [folder] = process.argv.slice(2);
const OPENS_WITHIN_MS = 2000;
const ATTEMPTS = 4;

const browser = await chromium.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
  args: ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run"],
});

/** A new tab that takes note of everything a page must not do. */
async function tab(options = {}) {
  const page = await browser.newPage({ viewport: { width: 1280, height: 900 }, ...options });
  page.faults = [];
  page.on("console", (message) => {
    // The check itself looks at canvases.
    if (!message.text().includes("willReadFrequently")) page.faults.push(`console ${message.type()}: ${message.text()}`);
  });
  page.on("pageerror", (error) => page.faults.push(`error: ${error.stack}`));
  page.on("dialog", (dialog) => page.faults.push(`dialog: ${dialog.message()}`));
  await page.route("**", (route) => {
    const url = route.request().url();
    if (url === page.expected) return route.continue();
    page.faults.push(`request: ${url}`);
    return route.abort();
  });
  return page;
}

/** Opens a page; milliseconds from the start of the navigation to the page being drawn and usable. */
async function open(page, file) {
  page.expected = pathToFileURL(file).href;
  await page.goto(page.expected);
  await page.waitForFunction(() => document.documentElement.dataset.ready !== undefined);
  // What is ready must be on the screen, too.
  return page.evaluate(() => new Promise((done) => requestAnimationFrame(() => done(performance.now()))));
}

const text = (page, selector) => page.locator(selector).textContent();

/** How many pixels of each row of a canvas have about a color, such as "#0072b2". Axes and text are gray. */
const pixelRows = (page, selector, color) =>
  page.locator(selector).first().evaluate((canvas, color) => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    const [r, g, b] = [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16));
    const rows = new Array(canvas.height).fill(0);
    for (let i = 0; i < data.length; i += 4) {
      const away = Math.max(Math.abs(data[i] - r), Math.abs(data[i + 1] - g), Math.abs(data[i + 2] - b));
      if (data[i + 3] > 90 && away < 16) rows[Math.floor(i / 4 / canvas.width)]++;
    }
    return rows;
  }, color);

const pixels = async (page, selector, color) => (await pixelRows(page, selector, color)).reduce((a, b) => a + b, 0);

/** Color of the rollouts at a place. */
const groupColor = (page, place) => page.evaluate((place) => getComputedStyle(document.documentElement).getPropertyValue(`--g${place % 6}`).trim(), place);

const dataOf = (page) => page.evaluate(() => JSON.parse(document.getElementById("data").textContent));

/** Which rollouts the chosen episode is of, and its number. */
async function picked(page, groups) {
  const [, label, number] = (await text(page, "#picked")).match(/^(.*), episode (-?\d+): K-Sim/s);
  return [groups.findIndex((group) => group.label === label), number];
}

/** Series are in their own colors, not only axes. */
async function canvasesAreDrawn(page) {
  const { groups, palettes } = await dataOf(page);
  const painted = await Promise.all(palettes.k_sim.map((color) => pixels(page, "#overview canvas", color)));
  assert.ok(Math.max(...painted) > 20, "#overview has no row");
  const [place] = await picked(page, groups);
  assert.ok((await pixels(page, "#timeline canvas", await groupColor(page, place))) > 5, "#timeline has no line");
  for (const place of groups.keys()) {
    assert.ok((await pixels(page, "#distances canvas", await groupColor(page, place))) > 5, `#distances has no line ${place}`);
  }
}

async function figuresAreThere(page, document) {
  await canvasesAreDrawn(page);
  const { groups } = await dataOf(page);
  const marks = await page.locator("#outcome .dots").evaluateAll((paths) => paths.map((path) => path.getAttribute("d").split("M").length - 1));
  assert.deepEqual(marks, document.results.map((result) => result.n_episodes));
  // Rows are as long as their episodes: the farther end has color, too.
  const ends = await page.locator("#overview canvas").evaluate((canvas) => {
    const ratio = canvas.width / canvas.clientWidth;
    const alpha = (x) => canvas.getContext("2d").getImageData(Math.round(x * ratio), Math.round(2 * ratio), 1, 1).data[3];
    return [alpha(112), alpha(canvas.clientWidth - 3)];
  });
  const steps = groups[0].steps;
  assert.ok(ends[0] === 255 && (steps.n.some((n) => n !== steps.n[0]) || ends[1] === 255), "a row ends early");
  // What lies beyond the last edge is in a bin as wide as any.
  const counts = groups[0].histogram;
  if (groups.length === 1 && Math.max(...counts) === counts[counts.length - 1]) {
    const rows = await pixelRows(page, "#distances canvas", await groupColor(page, 0));
    const top = rows.findIndex((n) => n > 0);
    assert.ok(Math.max(...rows.slice(top, top + 3)) > 4, "the last bin has no width");
  }
  assert.match(await page.locator("#distances-table thead th").last().textContent(), /and more$/);
  assert.match(await page.locator("#map .path").getAttribute("d"), /^M[\d.]+ [\d.]+/);
  assert.ok((await page.locator("#worst tbody tr").count()) > 0);
}

/** The numbers in the tables are those of the document, to the last digit. */
async function numbersAreThose(page, document) {
  const full = (rows) => page.locator(`${rows}`).evaluateAll((rows) => rows.map((row) => [...row.querySelectorAll("[data-value]")].map((cell) => cell.dataset.value)));
  const summary = await full("#summary tbody tr");
  assert.equal(summary.length, document.results.length);
  document.results.forEach((result, i) => {
    const interval = result.interval_95 ? [result.interval_95.join(" ")] : [];
    const expected = [result.n_episodes, result.n_steps, result.k_sim, result.k_sim_episode_mean, ...interval, result.k_sim_state, result.k_sim_action, result.saturated_share, result.mean_scaled_distance];
    assert.deepEqual(summary[i], expected.map(String));
  });
  const episodes = document.results.flatMap((result) => result.episodes);
  const rows = await full("#episode-list tbody tr");
  const [from] = (await text(page, "#page")).split("–");
  assert.ok(rows.length > 0);
  rows.forEach((row, i) => {
    const episode = episodes[Number(from) - 1 + i];
    assert.deepEqual(row, [episode.n_steps, episode.k_sim, episode.saturated_share].map(String));
  });
  assert.ok((await text(page, "#provenance")).includes(document.fingerprint));
}

/** Every episode with its rows of the evidence. */
function rowsOf(document) {
  let start = 0;
  return document.results.flatMap((result, group) =>
    result.episodes.map((episode) => {
      const from = start;
      start += episode.n_steps;
      return { group, episode, from, until: start };
    }),
  );
}

const near = (shown, expected, what) => assert.ok(Math.abs(Number(shown) - expected) <= 1.01e-4 * Math.max(1, Math.abs(expected)), `${what} is ${shown}, expected ${expected}`);

/** The chosen step and the worst steps have the numbers of the evidence. */
async function stepsAreThose(page, document) {
  const { steps, parameters } = document;
  const { groups } = await dataOf(page);
  const [states, actions] = [parameters.state_dim, parameters.action_dim];
  const all = rowsOf(document);
  const range = page.locator("#step");
  await range.focus();
  for (const key of ["Home", "ArrowRight", "End"]) {
    await page.keyboard.press(key);
    const values = await page.locator("#values dd").allTextContents();
    const [place, number] = await picked(page, groups);
    const { from, until } = all.find(({ group, episode }) => group === place && String(episode.episode_index) === number);
    const row = from + steps.step_index.slice(from, until).indexOf(Number(values[0]));
    assert.ok(row >= from, `step ${values[0]} is there`);
    const [kSim, note] = values[1].split(" (");
    near(kSim, steps.score[row], "K-Sim");
    assert.equal(note === "saturated)", steps.score[row] === 1);
    const scaled = [steps.distance[row] / Math.sqrt(states + actions), steps.state_distance[row] / Math.sqrt(states), steps.action_distance[row] / Math.sqrt(actions)];
    near(values[2], Math.min(1, parameters.gamma / scaled[1]), "the state part");
    near(values[3], Math.min(1, parameters.gamma / scaled[2]), "the action part");
    scaled.forEach((distance, i) => near(values[4 + i], distance, "d/√d"));
    assert.equal(values[7], `episode ${steps.reference_episode_index[row]}, step ${steps.reference_step_index[row]}`);
  }
  const farthest = all.map(({ group, episode, from, until }) => {
    let row = from;
    for (let i = from + 1; i < until; i++) if (steps.distance[i] > steps.distance[row]) row = i;
    return { group, episode, row };
  });
  farthest.sort((a, b) => steps.distance[b.row] - steps.distance[a.row]);
  const shown = await page.locator("#worst tbody tr").evaluateAll((rows) => rows.map((row) => [...row.cells].slice(1, 8).map((cell) => cell.dataset.value ?? cell.textContent)));
  const expected = farthest.slice(0, 20).map(({ episode, row }) => [
    String(episode.episode_index),
    String(steps.step_index[row]),
    String(steps.score[row]),
    String(steps.distance[row] / Math.sqrt(states + actions)),
    String(steps.state_distance[row] / Math.sqrt(states)),
    String(steps.action_distance[row] / Math.sqrt(actions)),
    `episode ${steps.reference_episode_index[row]}, step ${steps.reference_step_index[row]}`,
  ]);
  assert.deepEqual(shown, expected);
}

const isHidden = (page, figure) => page.locator(`${figure} > .tip`).evaluate((tip) => tip.hidden);

async function hoveringShowsValues(page) {
  const timeline = page.locator("#timeline .u-over");
  await timeline.scrollIntoViewIfNeeded();
  const box = await timeline.boundingBox();
  const seen = new Set();
  for (const share of [0.2, 0.7]) {
    await page.mouse.move(box.x + share * box.width, box.y + box.height / 2);
    await page.waitForTimeout(60);
    const values = await text(page, "#timeline .u-legend");
    assert.match(values, /K-Sim:?\s*(0\.\d{4}|1\.0000)/);
    const step = values.match(/step:?\s*(\d+)/)[1];
    assert.equal(await page.locator("#values dd").first().textContent(), step, "the table of the step follows the timeline");
    seen.add(step);
  }
  assert.equal(seen.size, Number(await page.locator("#step").getAttribute("max")) > 0 ? 2 : 1);
  const distances = page.locator("#distances .u-over");
  await distances.scrollIntoViewIfNeeded();
  await distances.hover();
  assert.match(await text(page, "#distances .u-legend"), /\d+\.\d\d %/);
  await page.locator("#outcome circle").scrollIntoViewIfNeeded();
  const dot = await page.locator("#outcome circle").boundingBox();
  await page.mouse.move(dot.x + dot.width / 2, dot.y + dot.height / 2);
  assert.match(await text(page, "#outcome > .tip"), /episode -?\d+: K-Sim/);
  assert.equal(await isHidden(page, "#outcome"), false);
  const rows = page.locator("#overview canvas");
  await rows.scrollIntoViewIfNeeded();
  await rows.hover({ position: { x: 130, y: 4 } });
  assert.match(await text(page, "#overview > .tip"), /step -?\d+: [01]\.\d{4}/);
  await page.mouse.move(2, 2);
  assert.equal(await isHidden(page, "#overview"), true);
  const map = page.locator("#map > svg");
  await map.scrollIntoViewIfNeeded();
  const start = (await page.locator("#map .path").getAttribute("d")).match(/^M([\d.]+) ([\d.]+)/);
  await map.hover({ position: { x: Number(start[1]), y: Number(start[2]) } });
  assert.match(await text(page, "#map > .tip"), /step -?\d+: K-Sim/);
}

async function pickingLinksFigureAndTable(page) {
  const buttons = page.locator("#episode-list tbody button");
  const n = await buttons.count();
  const before = [await text(page, "#picked"), await page.locator("#map .path").getAttribute("d")];
  const other = page.locator('#episode-list tbody button[aria-pressed="false"]').first();
  if (n > 1) {
    const label = await other.getAttribute("aria-label");
    await other.click();
    const [, number, group] = label.match(/^episode (-?\d+) of (.*)$/s);
    assert.ok((await text(page, "#picked")).startsWith(`${group}, episode ${number}:`));
    assert.notDeepEqual([await text(page, "#picked"), await page.locator("#map .path").getAttribute("d")], before);
    assert.equal(await page.locator("#episode-list tr.picked").count(), 1);
    const kSim = (await page.locator("#values dd").nth(1).textContent()).split(" ")[0];
    await page.waitForFunction((kSim) => document.querySelector("#timeline .u-legend").textContent.includes(kSim), kSim);
    // A figure chooses as well.
    const rows = page.locator("#overview canvas");
    await rows.scrollIntoViewIfNeeded();
    await rows.click({ position: { x: 150, y: 2 } });
    const { groups } = await dataOf(page);
    const [place, chosen] = await picked(page, groups);
    const all = groups.reduce((sum, group) => sum + group.episodes.n_steps.length, 0);
    // Beyond 400 episodes a row has several.
    assert.ok(place === 0 && (all > 400 || chosen === String(groups[0].episodes.episode_index[0])), `the first row is episode ${chosen}`);
  }
  const worst = page.locator("#worst tbody button").last();
  await worst.click();
  assert.equal(await page.locator("#values dd").first().textContent(), await worst.textContent());
}

async function keysAreEnough(page) {
  await page.locator("#filter").focus();
  for (let i = 0; i < 12; i++) {
    await page.keyboard.press("Tab");
    if (await page.evaluate(() => document.activeElement.closest("#episode-list tbody") !== null)) break;
  }
  const focused = () => page.evaluate(() => document.activeElement.getAttribute("aria-label"));
  const first = await focused();
  assert.match(first, /^episode/);
  assert.ok(await page.evaluate(() => getComputedStyle(document.activeElement).outlineStyle === "solid"), "the focus shows");
  await page.keyboard.press("ArrowDown");
  const second = await focused();
  if ((await page.locator("#episode-list tbody button").count()) > 1) assert.notEqual(second, first);
  await page.keyboard.press("Enter");
  const [, number, group] = second.match(/^episode (-?\d+) of (.*)$/s);
  assert.ok((await text(page, "#picked")).startsWith(`${group}, episode ${number}:`));
  assert.equal(await focused(), second, "choosing keeps the focus");
  const range = page.locator("#step");
  if (Number(await range.getAttribute("max")) > 0) {
    await range.focus();
    await page.keyboard.press("Home");
    const start = await page.locator("#values dd").first().textContent();
    await page.keyboard.press("ArrowRight");
    assert.notEqual(await page.locator("#values dd").first().textContent(), start);
    await page.locator("#map > svg").focus();
    await page.keyboard.press("Home");
    assert.equal(await page.locator("#values dd").first().textContent(), start, "the map takes keys");
  }
  if ((await page.locator("#episode-list tbody button").count()) > 1) {
    for (const [figure, keys] of [["#overview canvas", ["ArrowDown", "ArrowUp"]], ["#outcome > svg", ["ArrowRight", "ArrowLeft"]]]) {
      await page.locator(figure).focus();
      const before = await text(page, "#picked");
      await page.keyboard.press(keys[0]);
      // At the last episode it goes the other way.
      if ((await text(page, "#picked")) === before) await page.keyboard.press(keys[1]);
      assert.notEqual(await text(page, "#picked"), before, `${figure} takes keys`);
    }
  }
}

/** Colors of rollouts differ for every color vision (Machado et al., 2009: severe; CIE 1976). */
async function colorsAreToldApart(page) {
  const colors = await page.evaluate(() => ["g0", "g1", "g2", "g3", "g4", "g5", "data"].map((name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim()));
  const VISIONS = [
    [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
    [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.3039]],
  ];
  const times = (matrix, vector) => matrix.map((row) => row.reduce((sum, value, i) => sum + value * vector[i], 0));
  const linear = (color) => [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16) / 255).map((c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4));
  const lab = (rgb) => {
    const root = (t) => (t > 0.008856 ? Math.cbrt(t) : 7.787 * t + 16 / 116);
    const xyz = times([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]], rgb.map((c) => Math.min(1, Math.max(0, c))));
    const [x, y, z] = [xyz[0] / 0.95047, xyz[1], xyz[2] / 1.08883].map(root);
    return [116 * y - 16, 500 * (x - y), 200 * (y - z)];
  };
  for (const vision of VISIONS) {
    const seen = colors.map((color) => lab(times(vision, linear(color))));
    seen.forEach((a, i) => seen.slice(0, i).forEach((b, j) => assert.ok(Math.hypot(...a.map((value, k) => value - b[k])) > 15, `${colors[j]} and ${colors[i]} look alike`)));
  }
}

async function darkAndPaper(page, file) {
  const back = () => page.evaluate(() => getComputedStyle(document.body).backgroundColor);
  const light = await back();
  await page.emulateMedia({ colorScheme: "dark" });
  await page.waitForTimeout(100);
  assert.notEqual(await back(), light);
  await canvasesAreDrawn(page);
  await colorsAreToldApart(page);
  if (process.env.SCREENSHOTS) await page.screenshot({ path: path.join(process.env.SCREENSHOTS, `${path.basename(file, ".html")}-dark.png`), fullPage: true });
  const size = page.viewportSize();
  await page.emulateMedia({ media: "print", colorScheme: "dark" });
  await page.setViewportSize({ width: 720, height: 1000 });
  await page.waitForTimeout(100);
  assert.equal(await back(), "rgb(255, 255, 255)", "paper is light");
  await canvasesAreDrawn(page);
  await colorsAreToldApart(page);
  const [edge, stretched] = await page.locator("#overview canvas").evaluate((canvas) => [canvas.getBoundingClientRect().right, canvas.width / canvas.clientWidth / (canvas.height / canvas.clientHeight)]);
  assert.ok(edge <= 720 && Math.abs(stretched - 1) < 0.02, `the overview ends at ${edge}, stretched by ${stretched}`);
  await isAsWideAsTheWindow(page);
  if (process.env.SCREENSHOTS) await page.screenshot({ path: path.join(process.env.SCREENSHOTS, `${path.basename(file, ".html")}-print.png`), fullPage: true });
  await page.emulateMedia({ media: "screen", colorScheme: "dark" });
  await page.setViewportSize(size);
  // The real thing: the page is as it was afterwards.
  const paper = await page.pdf({ width: "720px", height: "1000px", margin: { top: "10px", bottom: "10px", left: "10px", right: "10px" } });
  assert.ok(paper.length > 20_000);
  if (process.env.SCREENSHOTS) fs.writeFileSync(path.join(process.env.SCREENSHOTS, `${path.basename(file, ".html")}.pdf`), paper);
  assert.notEqual(await back(), light, "after printing it is dark again");
  await page.emulateMedia({ colorScheme: "light" });
}

/** However long its names are, a page is no wider than the window. */
async function isAsWideAsTheWindow(page) {
  const [width, room] = await page.evaluate(() => [document.documentElement.scrollWidth, innerWidth]);
  assert.ok(width <= room, `${width} of ${room} pixels`);
}

/** Names are text: what the test put into them is nowhere an element, and nothing of it ran. */
async function namesAreText(page) {
  assert.equal(await page.evaluate(() => document.querySelectorAll("img, iframe, object, embed, form, link:not([rel=icon])").length), 0);
  assert.equal(await page.evaluate(() => window.injected), undefined);
}

/** In the best of a few attempts: the machine may be busy with other things. */
async function opensInTime(file) {
  const times = [];
  for (let i = 0; i < ATTEMPTS && !(Math.min(...times) < OPENS_WITHIN_MS); i++) {
    const page = await tab();
    times.push(await open(page, file));
    await page.close();
  }
  assert.ok(Math.min(...times) < OPENS_WITHIN_MS, `took ${times.map(Math.round).join(", ")} ms`);
  return Math.min(...times);
}

let failed = 0;
const pages = fs.readdirSync(folder).filter((name) => name.endsWith(".html")).sort();
assert.ok(pages.length > 0, `no pages in ${folder}`);
for (const name of pages) {
  const file = path.resolve(folder, name);
  const document = JSON.parse(fs.readFileSync(file.replace(/html$/, "json"), "utf8"));
  const page = await tab();
  try {
    const took = await opensInTime(file);
    await open(page, file);
    if (process.env.SCREENSHOTS) await page.screenshot({ path: path.join(process.env.SCREENSHOTS, `${path.basename(file, ".html")}-light.png`), fullPage: true });
    await figuresAreThere(page, document);
    await colorsAreToldApart(page);
    await numbersAreThose(page, document);
    await stepsAreThose(page, document);
    await hoveringShowsValues(page);
    await pickingLinksFigureAndTable(page);
    await keysAreEnough(page);
    await darkAndPaper(page, file);
    await namesAreText(page);
    await isAsWideAsTheWindow(page);
    assert.deepEqual(page.faults, []);
    console.log(`ok ${name} (opens in ${Math.round(took)} ms)`);
  } catch (error) {
    failed += 1;
    console.log(`FAILED ${name}: ${error.stack}`);
    if (page.faults.length > 0) console.log(page.faults.join("\n"));
  }
  await page.close();
}
await browser.close();
process.exit(failed === 0 ? 0 : 1);
