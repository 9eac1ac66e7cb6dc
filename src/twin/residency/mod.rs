//! Which sections of twins are in memory.
//!
//! ```text
//! demand, index       which sections each view draws, computed only from the table of a version
//! cache, resident     the open versions, and requests for the frames of one
//! pager               loads what frames request and hands each frame all of it at once
//! requests            which request waits for which section, and which section is loaded next
//! table               which sections are in memory, and which may be evicted
//! reading             which sections are being read, in memory as they are stored
//! reservation         a session's share of the memory, and what it prefetches
//! budget, worst_case  which sessions may open: the most that one frame of a session can need
//! actors              assets of scenarios, which are in memory as long as these are open
//! ```
//!
//! # Decisions
//!
//! A view draws exactly the sections that [`BlockIndex::select`] returns for it; the memory in use
//! and the other views of its frame only affect how long it waits. A frame gets the sections of all
//! its views at once, or it waits. It is never drawn with fewer sections.
//!
//! **Each view has its own levels of detail.** Levels chosen once for all views of a frame made an
//! image a function of the cameras beside it (35 dB between a wide camera alone and among six), and
//! a wide camera drew what only the longest lens beside it needs. Where views need several levels
//! of a block, all of them are in memory. A level has at most 0.65 of the Gaussians of the one
//! before, so that all of them have 2.9 times those of the first; on a dense scene six cameras took
//! 30 % more than with common levels.
//!
//! **A section is in memory once**, under a key made of everything that its chunk depends on:
//! content hash, cell, block, level, origin, and record. Fifty versions of a twin that differ in
//! ten blocks take the memory of one twin plus ten blocks each. Sections of a closed version stay
//! until their memory is needed.
//!
//! **A frame's scene pins its sections.** The scene holds the chunks' `Arc`s, so a section may be
//! evicted when the table holds the only `Arc`. There is no pin count that could get out of step,
//! and evicted memory is free at once.
//!
//! **A waiting frame holds no memory**, but only older frames may evict what it waits for. The
//! oldest frame may evict everything that is not being drawn, and drawing ends by itself. So at
//! least one frame makes progress, with any number of sessions and even without admission control.
//! Admission control only keeps sessions out of this slow state.
//!
//! **Memory is reserved before a load begins**, because the table has the size of each section.
//! Sections that are being loaded count as in use. The budget covers chunks; outside it are 16 MiB
//! of sections as they are stored, or one larger one, twice that with those in which sessions look
//! for contacts, and 64 B of bookkeeping per section.
//!
//! **Memory is allocated in pages**: the next section is read into the pages of an evicted one
//! (`wildcity_scene::pages`). The heap loses a few per cent of the budget between pages.
//!
//! **Eviction is least recently used; a prefetch counts as a use.** As far as prefetching predicts
//! the need for sections, this evicts first what is needed last. A prefetch evicts nothing that was
//! used since its session's last prefetch, and is dropped if this does not free enough memory. So a
//! prefetch can evict neither its own sections nor those that other sessions at the same pace are
//! about to need.
//!
//! **Prefetching uses the exact poses of the next steps**, with the rig's own cameras. One point in
//! the middle of the rig would be cheaper, but levels change at exact distances, so that a point
//! two metres away needs other sections.
//!
//! **A session reserves the memory of its worst frame**, wherever it drives: the frame that needs
//! the most. The search halves rectangles of the twin's map, the one with the highest bound first,
//! until that one is as small as a cell. A bound computed from the distance of a rectangle is never
//! below the need of a point in it. The searched rectangles lie along the road, so 20 km of road
//! take about as many as it has cells.
//!
//! **A failed load** is tried three times within 0.3 s, by any free thread; then the frames that
//! wait for it get the error. The section then counts as absent, so the next frame that needs it
//! tries again.
//!
//! There are no watermarks (such as 90 % and 80 %): a load evicts as much as it needs. The GPU's
//! pages are not tied to this table: the GPU copy of the chunks has a budget of its own.

mod actors;
mod budget;
mod cache;
mod demand;
mod error;
mod index;
mod load_times;
mod pager;
mod reading;
mod requests;
mod reservation;
mod resident;
mod source;
mod stats;
mod table;
mod worst_case;

pub use actors::ResidentActor;
pub use budget::{FrameBytes, default_memory_bytes};
pub use cache::Cache;
pub use demand::{SectionRef, SelectedSections, Viewpoint};
pub use error::ResidencyError;
pub use index::BlockIndex;
pub use pager::{PinnedScene, SceneCallback};
pub use reading::{Reading, ReadingBytes};
pub use requests::Urgency;
pub use reservation::{Prefetcher, Reservation, SceneBytes};
pub use resident::{Resident, SceneRequest};
pub use source::SectionSource;
pub use stats::Stats;
pub use worst_case::RigExtent;
