//! Losses over time.

use std::fmt::Write as _;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::learner::Update;
use crate::error::PlannerError;
use crate::tensor_file::write_atomically;

/// Name of the file in a run folder.
pub(crate) const HISTORY_FILE: &str = "losses.csv";
/// Updates in a row.
const INTERVAL: u64 = 100;

/// Mean losses of every network, a row for every hundred of its updates and one for the rest of its training.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub(crate) struct History {
    /// Whole rows.
    rows: Vec<Row>,
    /// Sums of the rows to come.
    open: Vec<Row>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Row {
    phase: String,
    network: String,
    /// Updates of the network at the end of the row.
    update: u64,
    n: u64,
    loss: f64,
    gradient_norm: f64,
    learning_rate: f64,
}

impl History {
    /// Adds update number `update`, from 1, of a network. `last` closes its row.
    pub(crate) fn push(&mut self, phase: &str, network: &str, at: (u64, bool), update: &Update) {
        let (number, last) = at;
        let place = self.open.iter().position(|row| row.network == network);
        let place = place.unwrap_or_else(|| {
            self.open.push(Row {
                phase: phase.to_owned(),
                network: network.to_owned(),
                update: 0,
                n: 0,
                loss: 0.0,
                gradient_norm: 0.0,
                learning_rate: 0.0,
            });
            self.open.len() - 1
        });
        let row = &mut self.open[place];
        row.update = number;
        row.n = row.n.saturating_add(1);
        row.loss += update.loss;
        row.gradient_norm += update.gradient_norm;
        row.learning_rate = update.learning_rate;
        if number % INTERVAL == 0 || last {
            let mut row = self.open.remove(place);
            row.loss /= row.n as f64;
            row.gradient_norm /= row.n as f64;
            self.rows.push(row);
        }
    }

    /// Mean loss of the last row of every network, in the order of training.
    pub(crate) fn last_losses(&self) -> Vec<(String, f64)> {
        let mut losses: Vec<(String, f64)> = Vec::new();
        for row in &self.rows {
            match losses
                .iter_mut()
                .find(|(network, _)| *network == row.network)
            {
                Some((_, loss)) => *loss = row.loss,
                None => losses.push((row.network.clone(), row.loss)),
            }
        }
        losses
    }

    /// Writes the whole rows as CSV.
    ///
    /// # Errors
    /// The file cannot be written.
    pub(crate) fn write(&self, run: &Path) -> Result<(), PlannerError> {
        let mut text = String::from("phase,network,update,loss,gradient_norm,learning_rate\n");
        for row in &self.rows {
            let _ = writeln!(
                text,
                "{},{},{},{},{},{}",
                row.phase, row.network, row.update, row.loss, row.gradient_norm, row.learning_rate
            );
        }
        write_atomically(&run.join(HISTORY_FILE), |file| std::fs::write(file, text))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_hold_means_and_the_rest_has_a_row_of_its_own() {
        let mut history = History::default();
        for number in 1..=150_u32 {
            let update = Update {
                loss: f64::from(number),
                gradient_norm: 2.0,
                learning_rate: 0.1,
            };
            history.push("a", "net", (number.into(), number == 150), &update);
        }
        let losses: Vec<f64> = history.rows.iter().map(|row| row.loss).collect();
        assert_eq!(losses, [50.5, 125.5]);
        assert_eq!(history.last_losses(), [("net".to_owned(), 125.5)]);
        assert!(history.open.is_empty());
    }
}
