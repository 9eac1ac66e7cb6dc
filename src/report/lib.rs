//! Measures the cost and the error of each setting of the renderer, on one twin and one machine,
//! and reports them as one HTML page, as JSON, and as CSV.
//!
//! ```text
//! setting         one way to render a twin
//! settings        the settings to compare, and those that cannot affect the twin
//! sample_points   the poses to compare at: on the recorded drive, at offsets from it, or around a capture
//! measure         renders each setting and the f64 reference, and compares them
//! measurement     the error of a setting, and its cost
//! expected        how long a report will take
//! timing          how long a step takes, in turn with the twin as it is served
//! recommend       the Pareto front, and the setting for a required error or time
//! confidence      trust in the images, over the distance from the recorded drive
//! feature_costs   memory and GPU work of one step, with each feature of a scene and without
//! repair          what repair gains on and off the drive, and what it costs
//! plots, page     the HTML page
//! run             all of it, in order
//! ```
//!
//! Data flows one way: `settings` and `sample_points` go into `measure`, its measurements into
//! `recommend`, and everything into a [`Report`], which `page` turns into HTML.

pub mod confidence;
mod error;
mod error_images;
mod expected;
pub mod feature_costs;
pub mod measure;
pub mod measurement;
pub mod page;
mod plots;
pub mod recommend;
pub mod repair;
mod report;
mod run;
pub mod sample_points;
pub mod setting;
pub mod settings;
mod statistics;
mod timing;

pub use error::ReportError;
pub use error_images::ErrorImages;
pub use expected::Expected;
pub use report::{Report, Subject};
pub use run::{Machine, Progress, Settings, Twin, expect, run};
