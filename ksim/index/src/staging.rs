//! Steps on their way into an index: held in temporary files, so that a dataset need not fit into memory.

use std::collections::HashSet;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use ksim::{Buffer, DataError, EpisodeRows, Matrix, Trajectories};

use crate::error::IndexError;
use crate::limit::{LIMIT, Limiter};
use crate::mapping::Mapping;

/// Rows that came in, in raw units. The files have no names: nothing is left of them however the process ends.
#[derive(Debug)]
pub struct StagedSteps {
    states: StagedMatrix,
    actions: StagedMatrix,
    episodes: Vec<EpisodeRows>,
    seen: HashSet<i64>,
    n_rows: usize,
}

impl StagedSteps {
    /// No steps yet, of the given widths; the temporary files lie in `folder`.
    ///
    /// # Errors
    /// [`DataError::NoColumns`] if a width is 0; a folder that cannot be written into.
    pub fn new(folder: &Path, state_dim: usize, action_dim: usize) -> Result<Self, IndexError> {
        Ok(Self {
            states: StagedMatrix::new(folder, state_dim)?,
            actions: StagedMatrix::new(folder, action_dim)?,
            episodes: Vec::new(),
            seen: HashSet::new(),
            n_rows: 0,
        })
    }

    /// The episodes so far.
    pub fn episodes(&self) -> &[EpisodeRows] {
        &self.episodes
    }

    /// As [`Trajectories::push`].
    ///
    /// # Errors
    /// As there, as [`IndexError::Data`]; a disk that is full.
    pub fn push(
        &mut self,
        episode_index: i64,
        states: &[f64],
        actions: &[f64],
    ) -> Result<(), IndexError> {
        let continues = self
            .episodes
            .last()
            .is_some_and(|last| last.episode_index == episode_index);
        if !continues && self.seen.contains(&episode_index) {
            return Err(DataError::SplitEpisode { episode_index }.into());
        }
        let known = match self.episodes.last() {
            Some(last) if continues => last.rows.len(),
            _ => 0,
        };
        let states = self
            .states
            .checked(states, "state", (episode_index, known))?;
        let actions = self
            .actions
            .checked(actions, "action", (episode_index, known))?;
        if states.n_rows() != actions.n_rows() {
            return Err(DataError::UnequalRows {
                states: states.n_rows(),
                actions: actions.n_rows(),
            }
            .into());
        }
        let n = states.n_rows();
        if self.n_rows + n > u32::MAX as usize {
            return Err(DataError::TooManyRows.into());
        }
        self.states.append(&states)?;
        self.actions.append(&actions)?;
        match self.episodes.last_mut() {
            Some(last) if continues => last.rows.end += n,
            _ => {
                self.seen.insert(episode_index);
                let rows = self.n_rows..self.n_rows + n;
                self.episodes.push(EpisodeRows {
                    episode_index,
                    rows,
                });
            }
        }
        self.n_rows += n;
        Ok(())
    }

    /// [`Trajectories::fingerprint`] of all steps.
    ///
    /// # Errors
    /// Temporary files that cannot be read back.
    pub fn fingerprint(self) -> Result<String, IndexError> {
        let (data, _limiter) = self.into_trajectories()?;
        Ok(data.fingerprint())
    }

    /// All steps, read from the files where they are needed, and what keeps them from filling memory.
    pub(crate) fn into_trajectories(self) -> Result<(Trajectories, Limiter), IndexError> {
        let limiter = Limiter::start(LIMIT);
        let states = self.states.mapped(&limiter)?;
        let actions = self.actions.mapped(&limiter)?;
        let data = Trajectories::from_parts(states, actions, self.episodes)?;
        Ok((data, limiter))
    }
}

/// One matrix in two files, one for each plane.
#[derive(Debug)]
struct StagedMatrix {
    width: usize,
    folder: PathBuf,
    high: BufWriter<File>,
    /// Begun with the first value that is not an f32.
    low: Option<BufWriter<File>>,
    n_values: usize,
}

const STAGE: &str = "write a temporary file beside the index";

impl StagedMatrix {
    fn new(folder: &Path, width: usize) -> Result<Self, IndexError> {
        Matrix::new(width)?;
        Ok(Self {
            width,
            folder: folder.to_owned(),
            high: temporary(folder)?,
            low: None,
            n_values: 0,
        })
    }

    fn checked(
        &self,
        values: &[f64],
        part: &'static str,
        (episode_index, known): (i64, usize),
    ) -> Result<Matrix, DataError> {
        Matrix::from_f64(values, self.width).map_err(|error| match error {
            DataError::NonFinite { row, column, value } => DataError::NonFiniteStep {
                episode_index,
                step_index: known + row,
                part,
                column,
                value,
            },
            other => other,
        })
    }

    fn append(&mut self, rows: &Matrix) -> Result<(), IndexError> {
        let (high, low) = rows.planes();
        let staged = |result: std::io::Result<()>| result.map_err(IndexError::io(STAGE));
        staged(self.high.write_all(bytemuck::cast_slice(high)))?;
        if self.low.is_none() && !low.is_empty() {
            let mut file = temporary(&self.folder)?;
            staged(zeros(&mut file, self.n_values * size_of::<f32>()))?;
            self.low = Some(file);
        }
        if let Some(file) = &mut self.low {
            match low.is_empty() {
                true => staged(zeros(file, size_of_val(high)))?,
                false => staged(file.write_all(bytemuck::cast_slice(low)))?,
            }
        }
        self.n_values += high.len();
        Ok(())
    }

    fn mapped(self, limiter: &Limiter) -> Result<Matrix, IndexError> {
        let plane = |file: BufWriter<File>| {
            let file = file.into_inner().map_err(|error| error.into_error());
            let file = file.map_err(IndexError::io(STAGE))?;
            if self.n_values == 0 {
                return Ok(Buffer::default());
            }
            let mapping = Mapping::new(&file).map_err(IndexError::io("map a temporary file"))?;
            let bytes = mapping.share(0..mapping.bytes().len());
            limiter.add(&mapping);
            Ok::<_, IndexError>(Buffer::lent(bytes)?)
        };
        let high = plane(self.high)?;
        let low = match self.low {
            Some(low) => plane(low)?,
            None => Buffer::default(),
        };
        Ok(Matrix::from_planes(high, low, self.width)?)
    }
}

fn temporary(folder: &Path) -> Result<BufWriter<File>, IndexError> {
    let file = tempfile::tempfile_in(folder).map_err(IndexError::io(STAGE))?;
    Ok(BufWriter::with_capacity(1 << 18, file))
}

fn zeros(file: &mut impl Write, mut n: usize) -> std::io::Result<()> {
    const ZEROS: [u8; 1 << 14] = [0; 1 << 14];
    while n > 0 {
        let part = n.min(ZEROS.len());
        file.write_all(&ZEROS[..part])?;
        n -= part;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn staged_steps_are_the_steps_that_came() {
        let folder = tempfile::tempdir().unwrap();
        let mut staged = StagedSteps::new(folder.path(), 2, 1).unwrap();
        let mut own = Trajectories::new(2, 1).unwrap();
        // The second plane begins late, and a later batch does without it.
        for (episode, states, actions) in [
            (0, [0.5, 1.0, 2.0, 3.0], [1.0, 2.0]),
            (0, [0.1, 1.0, 2.0, 1e-9], [0.25, 0.3]),
            (7, [1.0, 2.0, 3.0, 4.0], [0.5, 0.5]),
        ] {
            staged.push(episode, &states, &actions).unwrap();
            own.push(episode, &states, &actions).unwrap();
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        let (staged, _) = staged.into_trajectories().unwrap();
        assert_eq!(staged.fingerprint(), own.fingerprint());
        assert_eq!(staged.episodes(), own.episodes());
    }

    #[test]
    fn what_a_dataset_may_not_hold_is_refused_with_its_place() {
        let folder = tempfile::tempdir().unwrap();
        let mut staged = StagedSteps::new(folder.path(), 1, 1).unwrap();
        staged.push(0, &[1.0], &[1.0]).unwrap();
        staged.push(1, &[1.0], &[1.0]).unwrap();
        let error = staged.push(1, &[1.0, f64::NAN], &[0.0, 0.0]).unwrap_err();
        let place = DataError::NonFiniteStep {
            episode_index: 1,
            step_index: 2,
            part: "state",
            column: 0,
            value: f64::NAN,
        };
        assert!(
            format!("{error:?}").contains(&format!("{place:?}")),
            "{error:?}"
        );
        let error = staged.push(0, &[1.0], &[1.0]).unwrap_err();
        assert!(matches!(
            error,
            IndexError::Data(DataError::SplitEpisode { episode_index: 0 })
        ));
        assert!(staged.push(1, &[1.0], &[]).is_err());
        assert!(StagedSteps::new(folder.path(), 0, 1).is_err());
    }
}
