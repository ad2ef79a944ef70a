//! The page of `ksim report`: one HTML file that holds its data, figures and tables.
//!
//! [`Page`] is what it shows, as plain numbers; [`html`] puts it, the charting library and our own scripts
//! (`assets/page`) into one document that loads nothing. The document of `ksim score` goes in as it is, so that the
//! tables cannot differ from it. Columns of steps are packed: see [`Column`]. The same data give the same bytes.

mod data;
mod density;
mod held_out;
mod html;
mod pack;
mod projection;
mod steps;
mod worst;

pub use data::{EpisodeFacts, Goals, Group, HeldOutPart, Histogram, Map, Page, ReferencePart};
pub use density::Density;
pub use held_out::{HeldOut, NoHeldOut};
pub use html::html;
pub use pack::Column;
pub use projection::Projection;
pub use steps::{Kept, MAX_EPISODES, MAX_STEPS, Places, Scored, StepColumns, stride};
pub use worst::{Difference, WorstStep, worst};
