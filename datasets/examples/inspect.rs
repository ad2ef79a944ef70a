//! Opens a dataset by name or path and prints what it holds: `cargo run --example inspect -- NAME`.

use std::error::Error;
use std::io::Write;

use ksim_datasets::{OpenOptions, SearchRoots, TransitionOptions, TransitionReader};

fn main() -> Result<(), Box<dyn Error>> {
    let name = std::env::args().nth(1).ok_or("usage: inspect NAME|PATH")?;
    let found = ksim_datasets::resolve(&name, &SearchRoots::from_env())?;
    let source = ksim_datasets::open(&found.path, &OpenOptions::default())?;
    let mut out = std::io::stdout().lock();
    let info = source.info();
    writeln!(
        out,
        "{} ({}), episodes {}",
        info.id, info.format, info.episode_rule
    )?;
    for warning in &info.warnings {
        writeln!(out, "warning: {warning}")?;
    }
    let summary = ksim_datasets::summarize(source.as_ref())?;
    writeln!(
        out,
        "{} episodes, {} steps",
        summary.n_episodes, summary.n_steps
    )?;
    for column in &summary.columns {
        writeln!(
            out,
            "  {} {}[{}]",
            column.name, column.data_type, column.width
        )?;
    }
    writeln!(
        out,
        "returns {:?}\nsuccess {:?}\nends {:?}",
        summary.returns, summary.success_rate, summary.ends
    )?;
    let reader = TransitionReader::new(source.as_ref(), &TransitionOptions::default())?;
    writeln!(
        out,
        "states {} wide, actions {} wide",
        reader.state_width(),
        reader.action_width()
    )?;
    Ok(())
}
