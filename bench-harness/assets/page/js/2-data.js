// What the page shows: the document of `ksim score`, and columns of steps as packed numbers.

const data = JSON.parse(byId("data").textContent);
const groups = data.groups;

const TYPES = { u8: Uint8Array, u16: Uint16Array, u32: Uint32Array, f32: Float32Array, f64: Float64Array };

/** A column: `{type, low?, high?, base64}`. Integers between low and high stand for places between them. */
function unpack(column) {
  if (!column) return null;
  const text = atob(column.base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  const numbers = new TYPES[column.type](bytes.buffer);
  if (column.low === undefined) return numbers;
  const most = 2 ** (8 * numbers.BYTES_PER_ELEMENT) - 1;
  const places = new Float64Array(numbers.length);
  const scale = (column.high - column.low) / most;
  for (let i = 0; i < places.length; i++) places[i] = column.low + scale * numbers[i];
  return places;
}

const { gamma, state_dim: stateDim, action_dim: actionDim } = data.document.parameters;

groups.forEach((group, place) => {
  const steps = group.steps;
  group.place = place;
  group.result = data.document.results[place];
  for (const name of ["step", "scaled", "state", "action", "match_episode", "match_step", "x", "y", "match_x", "match_y", "novelty"]) {
    group[name] = unpack(steps[name]);
  }
  group.first = [0];
  for (const n of steps.n) group.first.push(group.first[group.first.length - 1] + n);
  group.goals = goalsOf(group.episodes.goals);
});

/** Goals of every episode. */
function goalsOf(packed) {
  if (!packed) return null;
  const [x, y] = [unpack(packed.x), unpack(packed.y)];
  let next = 0;
  return packed.n.map((n) => Array.from({ length: n }, () => [x[next], y[next++]]));
}

/** Every episode of the page, in the order of the rollouts. */
const episodes = groups.flatMap((group) =>
  group.episodes.episode_index.map((number, place) => ({
    group,
    place,
    number,
    from: group.first[place],
    n: group.steps.n[place],
    value: (name) => group.episodes[name]?.[place] ?? null,
  })),
);

const score = (scaled) => Math.min(1, gamma / Math.max(scaled, 1e-12));

/** What is known of a step: `k` counts the episode's steps that are on the page. */
function stepOf(episode, k) {
  const { group } = episode;
  const row = episode.from + k;
  return {
    step: group.step ? group.step[row] : k,
    score: score(group.scaled[row]),
    scaled: group.scaled[row],
    state: group.state[row],
    action: group.action[row],
    stateScore: score(group.state[row]),
    actionScore: score(group.action[row]),
    matchEpisode: data.reference.episodes[group.match_episode[row]],
    matchStep: group.match_step[row],
    at: group.x ? [group.x[row], group.y[row]] : null,
    match: group.match_x ? [group.match_x[row], group.match_y[row]] : null,
    novelty: group.novelty && Number.isFinite(group.novelty[row]) ? group.novelty[row] : null,
  };
}

/** The place among the page's steps of an episode that is nearest to a step number. */
function placeOf(episode, step) {
  const { group, from, n } = episode;
  if (!group.step) return clamp(step, 0, n - 1);
  let best = 0;
  for (let k = 1; k < n; k++) {
    if (Math.abs(group.step[from + k] - step) < Math.abs(group.step[from + best] - step)) best = k;
  }
  return best;
}

const outcome = (episode) => {
  const success = episode.value("success");
  const parts = [];
  if (success !== null) parts.push(success ? "success" : "no success");
  if (episode.value("return") !== null) parts.push(`return ${Number(episode.value("return").toFixed(4))}`);
  return parts.join(", ");
};
