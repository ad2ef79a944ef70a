//! One pass over the rows, past all checks.

use arrow::array::RecordBatch;

use super::facts::Facts;
use super::report::{Coverage, Findings, Report};
use super::rows::{Rows, Segment};
use super::{
    actions, duplicates, flags, goals, jumps, lengths, next, numbers, opening, times, values,
};
use crate::error::Result;
use crate::source::{DatasetSource, Scan};

/// Values of a batch, about.
const BATCH_VALUES: usize = 1 << 22;
const BATCH_ROWS: usize = 16_384;

/// One kind of fault, or a few that are seen in the same place.
///
/// Segments come in order; those of an episode follow each other, then [`Check::end_episode`].
pub(super) trait Check {
    /// Stable name.
    fn name(&self) -> &'static str;

    /// Rows of one episode.
    fn visit(&mut self, segment: &Segment<'_>);

    /// The episode's last row was visited.
    fn end_episode(&mut self, _episode: &Episode) {}

    /// All rows were visited: says what was found.
    fn finish(self: Box<Self>, found: &mut Findings);
}

/// An episode that ended.
#[derive(Debug, Clone, Copy)]
pub(super) struct Episode {
    pub(super) index: i64,
    pub(super) n_steps: u64,
    pub(super) n_rows: u64,
    /// Number of the last row's step.
    pub(super) last_step: i64,
}

/// Makes a check where it applies.
type Maker = fn(&Facts<'_>) -> Option<Box<dyn Check>>;

/// The checks that apply.
fn checks(facts: &Facts<'_>) -> Vec<Box<dyn Check>> {
    let makers: [Maker; 10] = [
        lengths::check,
        numbers::check,
        values::check,
        actions::check,
        flags::check,
        next::check,
        jumps::check,
        goals::check,
        duplicates::check,
        times::check,
    ];
    makers.iter().filter_map(|make| make(facts)).collect()
}

pub(super) fn run(source: &dyn DatasetSource) -> Report {
    let facts = Facts::new(source);
    let mut found = Findings::default();
    opening::warnings(facts.info, &mut found);
    let mut checks = checks(&facts);
    let mut names = vec!["opening"];
    names.extend(checks.iter().map(|check| check.name()));
    let mut pass = Pass {
        coverage: Coverage {
            columns: facts.columns.iter().map(|c| c.name.clone()).collect(),
            checks: names,
            ..Coverage::default()
        },
        current: None,
    };
    match pass.read(source, &facts, &mut checks) {
        Ok(()) => pass.coverage.complete = true,
        Err(error) => found.push(opening::unreadable(&facts.info.path, &error)),
    }
    if pass.coverage.complete {
        opening::counts(facts.info, &pass.coverage, &mut found);
    }
    for check in checks {
        check.finish(&mut found);
    }
    Report {
        id: facts.info.id.clone(),
        format: Some(facts.info.format),
        path: facts.info.path.clone(),
        coverage: pass.coverage,
        findings: found.sorted(),
    }
}

struct Pass {
    coverage: Coverage,
    current: Option<Episode>,
}

impl Pass {
    fn read(
        &mut self,
        source: &dyn DatasetSource,
        facts: &Facts<'_>,
        checks: &mut [Box<dyn Check>],
    ) -> Result<()> {
        let width: usize = facts.columns.iter().map(|column| column.width).sum();
        let scan = Scan {
            batch_rows: (BATCH_VALUES / width.max(1)).clamp(1, BATCH_ROWS),
            ..Scan::default()
        };
        // The last row of the batch before, so that every pair of rows is seen.
        let mut before: Option<RecordBatch> = None;
        for batch in source.scan(&scan)? {
            let batch = batch?;
            if batch.num_rows() == 0 {
                continue;
            }
            let joined = match &before {
                Some(before) => arrow::compute::concat_batches(&facts.schema, [before, &batch])?,
                None => batch.clone(),
            };
            let new = joined.num_rows() - batch.num_rows()..joined.num_rows();
            let rows = Rows::new(&joined, &facts.columns)?;
            for segment in rows.segments(new) {
                self.visit(&segment, checks);
            }
            before = Some(batch.slice(batch.num_rows() - 1, 1));
        }
        self.end_episode(checks);
        Ok(())
    }

    fn visit(&mut self, segment: &Segment<'_>, checks: &mut [Box<dyn Check>]) {
        if !segment.continues {
            self.end_episode(checks);
        }
        let rows = segment.rows();
        let n_steps = segment.step_rows().count() as u64;
        let episode = self.current.get_or_insert(Episode {
            index: segment.episode,
            n_steps: 0,
            n_rows: 0,
            last_step: 0,
        });
        episode.n_steps += n_steps;
        episode.n_rows += rows.len() as u64;
        episode.last_step = segment.step(rows.end - 1);
        self.coverage.n_steps += n_steps;
        self.coverage.n_rows += rows.len() as u64;
        for check in checks {
            check.visit(segment);
        }
    }

    fn end_episode(&mut self, checks: &mut [Box<dyn Check>]) {
        if let Some(episode) = self.current.take() {
            self.coverage.n_episodes += 1;
            for check in checks {
                check.end_episode(&episode);
            }
        }
    }
}
