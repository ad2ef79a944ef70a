// What is chosen, and how the figures and tables follow.

/** Chooses an episode, and one of its steps: the farthest from the data, if none is said. */
function pick(episode, k = farthest(episode)) {
  chosen.episode = episode;
  chosen.k = clamp(k, 0, episode.n - 1);
  const range = byId("step");
  range.max = episode.n - 1;
  const said = outcome(episode);
  byId("picked").replaceChildren(swatch(episode.group), `${episode.group.label}, episode ${episode.number}: K-Sim ${fixed(episode.value("k_sim"))}, ${percent(episode.value("saturated_share"))} saturated${said ? `, ${said}` : ""}`);
  const focused = document.activeElement?.closest("#episode-list tbody") !== null && document.activeElement !== document.body;
  reveal(episode);
  episodeTable();
  if (focused) byId("episode-list").querySelector('button[aria-pressed="true"]')?.focus();
  drawTimeline();
  drawMap();
  markOverview();
  markOutcome();
  choose(chosen.k);
}

function farthest(episode) {
  let worst = 0;
  for (let k = 1; k < episode.n; k++) {
    if (episode.group.scaled[episode.from + k] > episode.group.scaled[episode.from + worst]) worst = k;
  }
  return worst;
}

/** Chooses a step of the chosen episode. */
function choose(k, from) {
  chosen.k = k;
  const step = stepOf(chosen.episode, k);
  const range = byId("step");
  range.value = k;
  range.setAttribute("aria-valuetext", `step ${step.step}, K-Sim ${fixed(step.score)}`);
  if (from !== "timeline") followTimeline();
  markMap();
  const rows = [
    ["step", String(step.step)],
    ["K-Sim", fixed(step.score) + (step.score === 1 ? " (saturated)" : "")],
    ["state part", fixed(step.stateScore)],
    ["action part", fixed(step.actionScore)],
    ["d/√d", decimals(step.scaled)],
    ["of state", decimals(step.state)],
    ["of action", decimals(step.action)],
    ["matched with", `episode ${step.matchEpisode}, step ${step.matchStep}`],
  ];
  if (step.novelty !== null) rows.push(["curiosity", decimals(step.novelty)]);
  byId("values").replaceChildren(...rows.flatMap(([name, text]) => [h("dt", {}, name), h("dd", {}, text)]));
}

/** Arrow keys go from step to step. */
function walkSteps(event) {
  const last = chosen.episode.n - 1;
  const next = { ArrowRight: chosen.k + 1, ArrowLeft: chosen.k - 1, Home: 0, End: last }[event.key];
  if (next === undefined) return;
  event.preventDefault();
  choose(clamp(next, 0, last));
}

let playing = null;

/** Goes through the steps of the episode; ends at the last. */
function play() {
  const button = byId("play");
  if (playing !== null) {
    clearInterval(playing);
    playing = null;
  } else {
    if (chosen.k >= chosen.episode.n - 1) choose(0);
    playing = setInterval(() => {
      if (chosen.k >= chosen.episode.n - 1) return play();
      choose(chosen.k + 1);
    }, 40);
  }
  button.setAttribute("aria-pressed", String(playing !== null));
  button.textContent = playing === null ? "Play" : "Stop";
}

function lead() {
  const { dataset, search } = data.document;
  const steps = groups.reduce((sum, group) => sum + group.result.n_steps, 0);
  byId("lead").textContent = `${count(episodes.length, "episode")} (${count(steps, "step")}) against ${dataset.name}: ${count(dataset.n_episodes, "demonstration")}, ${count(dataset.n_steps, "step")}; ${search.exact ? "exact search" : "approximate search"}.`;
}

function options(select, entries) {
  byId(select).append(...Object.entries(entries).map(([value, { name }]) => h("option", { value }, name)));
}

lead();
summaryTable();
overviewNote();
outcomeNote();
distancesNote();
distancesTable();
mapNote();
listControls();
worstTable();
provenance();
options("quantity", QUANTITIES);
options("color", SCALES);
if (SCALES.novelty) byId("color").value = "score";
byId("quantity").addEventListener("change", drawTimeline);
byId("color").addEventListener("change", drawMap);
byId("outcome-by").addEventListener("change", drawOutcome);
byId("step").addEventListener("input", () => choose(Number(byId("step").value)));
byId("play").addEventListener("click", play);

// First what is chosen, which all figures show; it is the episode with the lowest K-Sim.
chosen.episode = episodes.reduce((a, b) => (b.value("k_sim") < a.value("k_sim") ? b : a));
chosen.k = farthest(chosen.episode);
keepDrawn(byId("overview"), drawOverview);
keepDrawn(byId("outcome"), drawOutcome);
keepDrawn(byId("distances"), drawDistances);
keepDrawn(byId("timeline"), drawTimeline);
keepDrawn(byId("map"), drawMap);
sortList();
pick(chosen.episode, chosen.k);
document.documentElement.dataset.ready = String(Math.round(performance.now()));
