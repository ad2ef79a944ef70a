//! Times one reading of a dataset's observations and actions: `time_read PATH arrow|matrix [MAPPING]`.
//! Prints `rows seconds`; `scripts/bench_read.py` calls it in turn with h5py.

use std::error::Error;
use std::io::Write;
use std::path::Path;
use std::time::Instant;

use ksim_datasets::{OpenOptions, Scan, TransitionOptions, TransitionReader, open, schema};

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let (Some(path), Some(into)) = (args.next(), args.next()) else {
        return Err("usage: time_read PATH arrow|matrix [MAPPING]".into());
    };
    let options = OpenOptions {
        mapping: args.next().map(Into::into),
        ..OpenOptions::default()
    };
    let start = Instant::now();
    let source = open(Path::new(&path), &options)?;
    let mut n_rows = 0;
    if into == "arrow" {
        let is_wanted = |name: &&String| {
            schema::belongs_to(name, schema::OBSERVATION)
                || schema::belongs_to(name, schema::ACTION)
        };
        let table = source.schema();
        let columns = table
            .fields()
            .iter()
            .map(|field| field.name())
            .filter(is_wanted)
            .cloned()
            .collect();
        for batch in source.scan(&Scan {
            columns: Some(columns),
            ..Scan::default()
        })? {
            n_rows += batch?.num_rows();
        }
    } else {
        for batch in TransitionReader::new(source.as_ref(), &TransitionOptions::default())? {
            n_rows += batch?.n_rows();
        }
    }
    writeln!(
        std::io::stdout(),
        "{n_rows} {:.4}",
        start.elapsed().as_secs_f64()
    )?;
    Ok(())
}
