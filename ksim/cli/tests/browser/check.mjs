// Opens pages of `ksim report` in a headless browser and uses them: node check.mjs FOLDER
//
// FOLDER holds pages (NAME.html) and beside each what `ksim score --format json` says of the same rollouts (NAME.json).
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
  page.on("console", (message) => page.faults.push(`console ${message.type()}: ${message.text()}`));
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

/** Whether a canvas has more than one color on it. */
const isDrawn = (page, selector) =>
  page.locator(selector).first().evaluate((canvas) => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    const seen = new Set();
    for (let i = 0; i < data.length && seen.size < 3; i += 4) seen.add((data[i] << 16) | (data[i + 1] << 8) | data[i + 2] | (data[i + 3] << 24));
    return seen.size > 2;
  });

async function figuresAreThere(page) {
  for (const canvas of ["#overview canvas", "#timeline canvas", "#distances canvas"]) {
    assert.ok(await isDrawn(page, canvas), `${canvas} is empty`);
  }
  assert.match(await page.locator("#outcome .dots").first().getAttribute("d"), /^M[\d.]+ [\d.]+h0/);
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
    assert.notEqual(await text(page, "#picked"), before[0]);
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
  }
}

async function darkAndPaper(page, file) {
  const back = () => page.evaluate(() => getComputedStyle(document.body).backgroundColor);
  const light = await back();
  await page.emulateMedia({ colorScheme: "dark" });
  await page.waitForTimeout(100);
  assert.notEqual(await back(), light);
  assert.ok(await isDrawn(page, "#timeline canvas"));
  if (process.env.SCREENSHOTS) await page.screenshot({ path: path.join(process.env.SCREENSHOTS, `${path.basename(file, ".html")}-dark.png`), fullPage: true });
  await page.evaluate(() => dispatchEvent(new Event("beforeprint")));
  assert.equal(await back(), "rgb(255, 255, 255)", "paper is light");
  await page.evaluate(() => dispatchEvent(new Event("afterprint")));
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
    await figuresAreThere(page);
    await numbersAreThose(page, document);
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
