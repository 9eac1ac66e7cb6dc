//! What is in memory now.
//!
//! ```text
//! demand, index  what a frame draws, from the table of a version alone
//! cache          the versions that are open
//! pager          loads what frames ask for and hands it over all at once; threads, one lock
//! requests       who waits for what, and what is loaded next
//! table          which sections are in memory, and which may be dropped for others
//! reservation    a session's part of the memory, and what it expects to need
//! budget, worst  who may open a session: the most that a frame of it can need
//! ```

mod budget;
mod cache;
mod demand;
mod error;
mod index;
mod load_times;
mod pager;
mod requests;
mod reservation;
mod source;
mod stats;
mod table;
mod worst_case;

pub use cache::{Cache, Resident, SceneRequest};
pub use demand::{SectionRef, Viewpoint, demand};
pub use error::ResidencyError;
pub use index::BlockIndex;
pub use pager::PinnedScene;
pub use requests::{SceneCallback, Urgency};
pub use reservation::{Prefetcher, Reservation};
pub use source::SectionSource;
pub use stats::Stats;
pub use worst_case::RigExtent;
