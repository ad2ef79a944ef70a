// The tables: summary, episodes, worst steps, and how all was computed.

const PAGE = 20;

const swatch = (group) => s("svg", { class: "swatch", viewBox: "0 0 12 12", "aria-hidden": "true" }, s("path", { d: groupShape(group)(6, 6, 4.2), fill: groupColor(group) }));

/** An interval as a line with a dot, on an axis from 0 to 1. */
function whisker(group) {
  const { result } = group;
  const [width, height] = [130, 18];
  const x = (value) => 4 + value * (width - 8);
  const svg = s("svg", { width, height, "aria-hidden": "true" });
  svg.append(s("line", { x1: x(0), x2: x(1), y1: 9, y2: 9, stroke: "var(--line)" }));
  for (const tick of [0, 0.5, 1]) svg.append(s("line", { x1: x(tick), x2: x(tick), y1: 6, y2: 12, stroke: "var(--line)" }));
  if (result.interval_95) {
    const [low, high] = result.interval_95;
    svg.append(s("line", { x1: x(low), x2: x(high), y1: 9, y2: 9, stroke: groupColor(group), "stroke-width": 3 }));
  }
  svg.append(s("circle", { cx: x(result.k_sim_episode_mean), cy: 9, r: 4.5, fill: groupColor(group) }));
  return svg;
}

function summaryTable() {
  const headline = data.document.parameters.headline;
  const star = (field, name) => name + (field === headline ? "*" : "");
  const head = ["rollouts", "episodes", "steps", star("k_sim", "K-Sim"), star("k_sim_episode_mean", "episode mean"), "95 % interval", "0 – 1", "state", "action", "saturated", "mean d/√d"];
  const rows = groups.map((group) => {
    const { result } = group;
    const interval = result.interval_95;
    return h(
      "tr",
      {},
      h("td", { class: "name", title: group.label }, swatch(group), group.label),
      cell(result.n_episodes, result.n_episodes.toLocaleString("en-US")),
      cell(result.n_steps, result.n_steps.toLocaleString("en-US")),
      cell(result.k_sim),
      cell(result.k_sim_episode_mean),
      h("td", { "data-value": interval && interval.join(" "), title: interval && interval.join(" – ") }, interval ? `[${fixed(interval[0])}, ${fixed(interval[1])}]` : "none"),
      h("td", {}, whisker(group)),
      cell(result.k_sim_state),
      cell(result.k_sim_action),
      cell(result.saturated_share, percent(result.saturated_share)),
      cell(result.mean_scaled_distance, decimals(result.mean_scaled_distance)),
    );
  });
  byId("summary").replaceChildren(h("thead", {}, h("tr", {}, ...head.map((name) => h("th", { scope: "col" }, name)))), h("tbody", {}, ...rows));
  const warnings = [...groups.flatMap((group) => group.result.warnings.map((text) => `${group.label}: ${text}`)), ...data.document.dataset.warnings.map((text) => `${data.document.dataset.name}: ${text}`)];
  byId("warnings").replaceChildren(...warnings.map((text) => h("p", { class: "notice" }, text)));
}

/** The list of episodes, a page of it at a time. */
const list = { order: "recorded", descending: false, filter: "", page: 0, shown: episodes };

const COLUMNS = [
  { key: "recorded", name: "episode" },
  { key: "n_steps", name: "steps" },
  { key: "k_sim", name: "K-Sim" },
  { key: "saturated_share", name: "saturated" },
  { key: "outcome", name: "outcome" },
];

function sortList() {
  const kept = episodes.filter((episode) => list.filter === "" || episode.group.place === Number(list.filter));
  const key = {
    recorded: () => 0,
    outcome: (episode) => Number(episode.value("success") ?? 0) * 1e12 + (episode.value("return") ?? 0),
  }[list.order] ?? ((episode) => episode.value(list.order));
  const sign = list.descending ? -1 : 1;
  const places = new Map(kept.map((episode, i) => [episode, i]));
  const keys = new Map(kept.map((episode) => [episode, key(episode)]));
  kept.sort((a, b) => sign * (keys.get(a) - keys.get(b) || (list.order === "recorded" ? places.get(a) - places.get(b) : 0)) || places.get(a) - places.get(b));
  list.shown = kept;
  list.page = 0;
}

function episodeRow(episode) {
  const is = chosen.episode === episode;
  const name = `${episode.number}`;
  const button = h("button", { type: "button", "aria-pressed": String(is), "aria-label": `episode ${name} of ${episode.group.label}`, click: () => pick(episode) }, name);
  const [kSim, share] = [episode.value("k_sim"), episode.value("saturated_share")];
  return h(
    "tr",
    { class: is ? "picked" : null },
    h("td", {}, swatch(episode.group), button),
    cell(episode.value("n_steps"), String(episode.value("n_steps"))),
    cell(kSim),
    cell(share, percent(share)),
    h("td", { class: "left outcome" }, outcome(episode)),
  );
}

function episodeTable() {
  const head = COLUMNS.map(({ key, name }) => {
    const sorted = list.order === key ? (list.descending ? "descending" : "ascending") : "none";
    const sort = () => {
      list.descending = list.order === key && !list.descending;
      list.order = key;
      sortList();
      episodeTable();
      byId("episode-list").querySelector(`th[data-key="${key}"] button`).focus();
    };
    const mark = { ascending: " ▲", descending: " ▼", none: "" }[sorted];
    return h("th", { scope: "col", "aria-sort": sorted, "data-key": key, class: key === "outcome" ? "left" : null }, h("button", { type: "button", click: sort }, name + mark));
  });
  const n = list.shown.length;
  const start = list.page * PAGE;
  const rows = list.shown.slice(start, start + PAGE).map(episodeRow);
  byId("episode-list").replaceChildren(h("thead", {}, h("tr", {}, ...head)), h("tbody", { keydown: walk }, ...rows));
  byId("page").textContent = `${start + 1}–${Math.min(n, start + PAGE)} of ${n.toLocaleString("en-US")}`;
  byId("previous").disabled = list.page === 0;
  byId("next").disabled = start + PAGE >= n;
}

/** Arrow keys go from episode to episode. */
function walk(event) {
  const by = { ArrowDown: 1, ArrowUp: -1 }[event.key];
  if (!by) return;
  const buttons = [...byId("episode-list").querySelectorAll("tbody button")];
  const next = buttons[buttons.indexOf(document.activeElement) + by];
  event.preventDefault();
  next?.focus();
}

/** Turns to the page of an episode. */
function reveal(episode) {
  if (list.filter !== "" && Number(list.filter) !== episode.group.place) {
    list.filter = byId("filter").value = "";
    sortList();
  }
  list.page = Math.floor(list.shown.indexOf(episode) / PAGE);
}

function listControls() {
  byId("filter").append(h("option", { value: "" }, "all"), ...groups.map((group) => h("option", { value: group.place }, group.label)));
  byId("filter").addEventListener("change", () => {
    list.filter = byId("filter").value;
    sortList();
    episodeTable();
  });
  for (const [id, by] of [["previous", -1], ["next", 1]]) {
    byId(id).addEventListener("click", () => {
      list.page += by;
      episodeTable();
    });
  }
}

function worstTable() {
  const head = ["rollouts", "episode", "step", "K-Sim", "d/√d", "of state", "of action", "demonstration", "differs most in"];
  const rows = data.worst.map((worst) => {
    const group = groups[worst.group];
    const episode = episodes.find((one) => one.group === group && one.place === worst.episode);
    const show = () => {
      pick(episode, placeOf(episode, worst.step));
      byId("episodes").scrollIntoView({ block: "start" });
      byId("step").focus({ preventScroll: true });
    };
    const label = `${group.label}, episode ${episode.number}, step ${worst.step}: show`;
    const columns = worst.columns.map(({ name, difference, rollout, demonstration }) => `${name} ${difference > 0 ? "+" : "−"}${Math.abs(difference).toFixed(2)} (${shortly(rollout)} against ${shortly(demonstration)})`);
    return h(
      "tr",
      {},
      h("td", { class: "name", title: group.label }, swatch(group), group.label),
      h("td", {}, String(episode.number)),
      h("td", {}, h("button", { type: "button", "aria-label": label, click: show }, String(worst.step))),
      cell(worst.score),
      cell(worst.scaled, decimals(worst.scaled)),
      cell(worst.state, decimals(worst.state)),
      cell(worst.action, decimals(worst.action)),
      h("td", {}, `episode ${worst.match_episode}, step ${worst.match_step}`),
      h("td", { class: "wrap" }, columns.join("; ")),
    );
  });
  byId("worst").replaceChildren(h("thead", {}, h("tr", {}, ...head.map((name) => h("th", { scope: "col", class: name.startsWith("differs") ? "wrap" : null }, name)))), h("tbody", {}, ...rows));
}

/** What an approximate search changes, against an exact one. */
const costOf = (error) => `recall ${error.recall_at_k.toFixed(3)}, ${percent(error.match_differs_share)} of the matches differ, score difference ${error.mean_score_difference.toFixed(4)} in the mean and ${error.max_score_difference.toFixed(4)} at most`;

const shortly = (value) => String(Number(value.toPrecision(4))).replace("-", "−");

function provenance() {
  const { dataset, parameters, search, fingerprint, version } = data.document;
  const names = parameters.state_column_names;
  const listed = names.length > 12 ? `${names.slice(0, 12).join(", ")}, … (${names.length} in all)` : names.join(", ");
  const centers = search.clusters?.centers_file ? ` of ${search.clusters.centers_file}` : "";
  const clusters = search.clusters ? `, ${search.clusters.n_clusters} clusters${centers}, inertia ${search.clusters.inertia}` : "";
  const costs = groups.filter((group) => group.result.approximation_error).map((group) => [`cost of it, ${group.label}`, costOf(group.result.approximation_error)]);
  const rows = [
    ["fingerprint", `${fingerprint} (compare only results with the same)`],
    ["ksim", version],
    ["dataset", `${dataset.name} (${dataset.format}, ${count(dataset.n_episodes, "episode")}, ${count(dataset.n_steps, "step")})`],
    ["dataset’s fingerprint", dataset.fingerprint],
    ["episodes of the dataset", dataset.episode_rule],
    ["rollouts", groups.map((group) => group.label).join(", ")],
    ["definition", `${parameters.definition}; what it calls K-Sim is ${parameters.headline}`],
    ["γ", String(parameters.gamma)],
    ["K, nearest states", String(parameters.n_neighbors)],
    ["search", `${search.engine}, ${search.exact ? "exact" : "approximate"}${clusters}`],
    ...costs,
    ["state columns", `${stateDim}: ${listed}`],
    ["action columns", String(actionDim)],
    ["seed", String(parameters.seed)],
    ["bootstrap", count(parameters.n_resamples, "resample")],
    ["same episode", parameters.exclude_same_episode ? "left out of the comparison" : "not left out"],
  ];
  byId("provenance").replaceChildren(...rows.filter(([, text]) => text).flatMap(([name, text]) => [h("dt", {}, name), h("dd", {}, text)]));
  byId("notes").replaceChildren(...data.notes.map((note) => h("li", { class: "small" }, note)));
  byId("footer").replaceChildren(`Made by ksim ${version}. Charts of steps and distances by uPlot (MIT, © 2022 Leon Sorokin).`);
}
