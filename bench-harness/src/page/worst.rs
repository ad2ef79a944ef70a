//! The steps farthest from the data, beside the demonstrations they were matched with.

use serde::Serialize;

use super::steps::Scored;

/// Steps that are listed, at most.
const LISTED: usize = 20;
/// Columns named of each.
const COLUMNS: usize = 3;

/// A step far from the data. Distances as [`Scored::scaled`] has them.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct WorstStep {
    /// Place of its group.
    pub group: usize,
    /// Place of its episode in the group.
    pub episode: usize,
    /// Its number.
    pub step: i64,
    /// Its K-Sim.
    pub score: f64,
    /// d/√d.
    pub scaled: f64,
    /// The same of the state part.
    pub state: f64,
    /// The same of the action part.
    pub action: f64,
    /// The demonstration.
    pub match_episode: i64,
    /// Its step.
    pub match_step: i64,
    /// The columns that differ most, the largest difference first.
    pub columns: Vec<Difference>,
}

/// One column of a step and of its match.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Difference {
    /// The column.
    pub name: String,
    /// Rollout − demonstration, in the dataset's standard deviations.
    pub difference: f64,
    /// Value of the rollout, raw units.
    pub rollout: f64,
    /// Value of the demonstration, raw units.
    pub demonstration: f64,
}

/// Of every episode the farthest step; of all groups the farthest 20 of these, the farthest first.
pub fn worst(groups: &[Scored<'_>], state_names: &[String]) -> Vec<WorstStep> {
    let mut found: Vec<(f64, usize, usize, usize)> = Vec::new();
    for (group, scored) in groups.iter().enumerate() {
        for (episode, rows) in scored.episodes().enumerate() {
            let row = scored.farthest(rows.rows.clone());
            found.push((scored.report.steps[row].distance, group, episode, row));
        }
    }
    // Stable: of equals the first.
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    found.truncate(LISTED);
    let step =
        |(_, group, episode, row)| describe(&groups[group], [group, episode, row], state_names);
    found.into_iter().map(step).collect()
}

fn describe(
    scored: &Scored<'_>,
    [group, episode, row]: [usize; 3],
    state_names: &[String],
) -> WorstStep {
    let step = &scored.report.steps[row];
    let [scaled, state, action] = scored.scaled(step);
    let (match_episode, match_step) = scored.matched(step.reference_row);
    let first = scored.episodes().nth(episode).map_or(0, |e| e.rows.start);
    WorstStep {
        group,
        episode,
        step: (scored.number)(row, row - first),
        score: step.score,
        scaled,
        state,
        action,
        match_episode,
        match_step,
        columns: differences(scored, row, step.reference_row as usize, state_names),
    }
}

fn differences(
    scored: &Scored<'_>,
    row: usize,
    matched: usize,
    state_names: &[String],
) -> Vec<Difference> {
    let reference = scored.ksim.reference();
    let (of_states, of_actions) = reference.normalizers();
    let states = (
        scored.trajectories.states(),
        &**reference.states(),
        of_states,
    );
    let actions = (
        scored.trajectories.actions(),
        reference.actions(),
        of_actions,
    );
    let action_names = (0..scored.trajectories.action_dim()).map(|i| format!("action[{i}]"));
    let names = state_names.iter().cloned().chain(action_names);
    let columns = [states, actions]
        .into_iter()
        .flat_map(|(own, other, normalizer)| {
            (0..own.n_features()).map(move |column| {
                let (value, there) = (own.value(row, column), other.value(matched, column));
                let difference = normalizer.normalize(column, value) - there;
                let demonstration = normalizer.denormalize(column, there);
                (difference, value, demonstration)
            })
        });
    let mut all: Vec<Difference> = names
        .zip(columns)
        .map(|(name, (difference, rollout, demonstration))| Difference {
            name,
            difference,
            rollout,
            demonstration,
        })
        .collect();
    all.sort_by(|a, b| b.difference.abs().total_cmp(&a.difference.abs()));
    all.truncate(COLUMNS);
    all
}

#[cfg(test)]
mod tests {
    use ksim::{KSim, Trajectories};

    use super::*;

    #[test]
    fn every_episode_gives_its_farthest_step_with_what_differs_most() {
        let mut reference = Trajectories::new(2, 1).unwrap();
        reference
            .push(4, &[0.0, 0.0, 2.0, 20.0], &[-1.0, 1.0])
            .unwrap();
        let mut rollouts = Trajectories::new(2, 1).unwrap();
        rollouts
            .push(0, &[0.0, 0.0, 2.0, 50.0], &[-1.0, 1.0])
            .unwrap();
        rollouts.push(1, &[0.0, 90.0], &[-1.0]).unwrap();
        let ksim = KSim::params().n_neighbors(1).fit(reference).unwrap();
        let report = ksim.score(&rollouts).unwrap();
        let scored = Scored {
            ksim: &ksim,
            trajectories: &rollouts,
            report: &report,
            number: &|_, position| position as i64,
            reference_number: &|_, position| position as i64 + 100,
        };
        let names = ["a", "b"].map(str::to_owned);
        let found = worst(&[scored, scored], &names);
        let places: Vec<_> = found.iter().map(|s| (s.group, s.episode, s.step)).collect();
        assert_eq!(places, [(0, 1, 0), (1, 1, 0), (0, 0, 1), (1, 0, 1)]);
        let step = &found[2];
        assert_eq!((step.match_episode, step.match_step), (4, 101));
        let column = &step.columns[0];
        assert_eq!((column.name.as_str(), column.rollout), ("b", 50.0));
        assert!((column.demonstration - 20.0).abs() < 1e-9);
        assert!((column.difference - 3.0).abs() < 1e-9);
        assert_eq!(step.score, report.steps[1].score);
    }
}
