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
mod worst;

pub use cache::{Cache, Resident, Ticket};
pub use demand::{Eye, Needed, demand};
pub use error::ResidencyError;
pub use index::Index;
pub use pager::Pinned;
pub use requests::{Done, Urgency};
pub use reservation::{Expectation, Reservation};
pub use source::Source;
pub use stats::Stats;
pub use worst::Lens;
