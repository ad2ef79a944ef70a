//! Decoding row groups ahead of the reader, on more than one core.

use std::collections::VecDeque;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread;

use arrow::array::RecordBatch;
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::{ArrowReaderMetadata, ParquetRecordBatchReaderBuilder};

use crate::error::{DatasetError, Result};
use crate::guard;

/// Neighboring row groups are decoded as one until they have so many rows: small groups would give small
/// batches.
const JOB_ROWS: u64 = 32_768;
/// More threads would wait for the one that puts the batches in order.
const MAX_THREADS: usize = 4;
/// Batches that a thread may be ahead.
const BATCHES_AHEAD: usize = 2;

/// A batch, and the row of the file it starts at.
pub(super) type Decoded = (u64, RecordBatch);

/// What to decode.
#[derive(Clone)]
pub(super) struct Selection {
    pub(super) path: PathBuf,
    pub(super) metadata: ArrowReaderMetadata,
    /// Columns.
    pub(super) mask: ProjectionMask,
    /// Rows of a batch, at most.
    pub(super) batch_rows: usize,
}

/// A run of neighboring row groups.
struct Job {
    groups: Vec<usize>,
    first_row: u64,
    n_rows: u64,
}

/// What a thread says about a job. A job that ends without a word is an error.
enum Said {
    Batch(Decoded),
    End,
    Failed(DatasetError),
}

/// The batches of some row groups in order. Memory: per thread, the pages it is at and a few batches.
pub(super) struct Ahead {
    jobs: VecDeque<Receiver<Said>>,
}

impl Ahead {
    /// Starts decoding the row groups given, in ascending order. One thread does so per core; which of them
    /// does what has no influence on the batches.
    pub(super) fn start(selection: &Selection, groups: &[usize]) -> Self {
        let jobs = jobs(&selection.metadata, groups);
        let cores = thread::available_parallelism().map_or(1, usize::from);
        let n_threads = cores.min(MAX_THREADS).min(jobs.len()).max(1);
        let mut queues: Vec<Vec<(Job, SyncSender<Said>)>> = Vec::new();
        queues.resize_with(n_threads, Vec::new);
        let mut receivers = VecDeque::with_capacity(jobs.len());
        for (number, job) in jobs.into_iter().enumerate() {
            let (sender, receiver) = sync_channel(BATCHES_AHEAD);
            receivers.push_back(receiver);
            queues[number % n_threads].push((job, sender));
        }
        for queue in queues {
            let selection = selection.clone();
            // Ends by itself: once the receivers are dropped, the next send fails.
            thread::spawn(move || {
                for (job, sender) in queue {
                    let end = match job.run(&selection, &sender) {
                        Ok(()) => Said::End,
                        Err(error) => Said::Failed(error),
                    };
                    if sender.send(end).is_err() {
                        return;
                    }
                }
            });
        }
        Self { jobs: receivers }
    }

    /// The next batch; `None` after the last. After an error nothing more comes.
    pub(super) fn next(&mut self) -> Option<Result<Decoded>> {
        while let Some(job) = self.jobs.front() {
            let error = match job.recv() {
                Ok(Said::Batch(decoded)) => return Some(Ok(decoded)),
                Ok(Said::End) => {
                    self.jobs.pop_front();
                    continue;
                }
                Ok(Said::Failed(error)) => error,
                Err(_) => DatasetError::corrupt("its decoder gave up"),
            };
            self.jobs.clear();
            return Some(Err(error));
        }
        None
    }
}

impl Job {
    fn run(&self, selection: &Selection, sender: &SyncSender<Said>) -> Result<()> {
        // A file of its own: clones of one share their position.
        let file = open(&selection.path)?;
        let mut reader =
            ParquetRecordBatchReaderBuilder::new_with_metadata(file, selection.metadata.clone())
                .with_projection(selection.mask.clone())
                .with_batch_size(selection.batch_rows)
                .with_row_groups(self.groups.clone())
                .build()
                .map_err(DatasetError::parquet("read rows"))?;
        let mut row = self.first_row;
        loop {
            let batch = guard::decode(|| {
                let batch = reader.next().transpose();
                batch.map_err(DatasetError::arrow("read rows"))
            })?;
            let Some(batch) = batch else {
                let expected = self.first_row + self.n_rows;
                return match row == expected {
                    true => Ok(()),
                    false => Err(DatasetError::corrupt(format!(
                        "rows end at {row}, expected {expected} by the footer"
                    ))),
                };
            };
            let n_rows = batch.num_rows() as u64;
            if sender.send(Said::Batch((row, batch))).is_err() {
                return Ok(()); // nobody listens any more
            }
            row += n_rows;
        }
    }
}

fn open(path: &Path) -> Result<File> {
    File::open(path).map_err(|e| DatasetError::io("open", e))
}

/// Runs of neighboring row groups of some size.
fn jobs(metadata: &ArrowReaderMetadata, groups: &[usize]) -> Vec<Job> {
    let mut jobs: Vec<Job> = Vec::new();
    let mut first_row = 0;
    for (group, rows) in metadata.metadata().row_groups().iter().enumerate() {
        let n_rows = u64::try_from(rows.num_rows()).unwrap_or(0);
        if groups.binary_search(&group).is_ok() {
            let neighbor = jobs.last_mut().filter(|job| {
                job.n_rows < JOB_ROWS && job.groups.last() == group.checked_sub(1).as_ref()
            });
            match neighbor {
                Some(job) => {
                    job.groups.push(group);
                    job.n_rows += n_rows;
                }
                None => jobs.push(Job {
                    groups: vec![group],
                    first_row,
                    n_rows,
                }),
            }
        }
        first_row += n_rows;
    }
    jobs
}
