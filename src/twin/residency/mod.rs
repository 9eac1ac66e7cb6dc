//! Which sections of twins are in memory.
//!
//! ```text
//! demand, index       which sections a frame draws, computed from the table of a version alone
//! cache, resident     the open versions, and requests for the frames of one
//! pager               loads what frames request and hands each frame all of it at once
//! requests            which request waits for which section, and which section is loaded next
//! table               which sections are in memory, and which may be evicted
//! reservation         a session's share of the memory, and what it prefetches
//! budget, worst_case  which sessions may open: the most that one frame of a session can need
//! ```
//!
//! # Decisions
//!
//! A frame draws the set of sections that [`demand`](demand()) names; memory decides only when. A
//! frame therefore gets all of its sections at once, or it waits. It is never drawn with fewer
//! sections.
//!
//! **A section is in memory once**, under a key made of everything that its chunk depends on:
//! content hash, cell, block, level, origin, and record. Fifty versions of a twin that differ in
//! ten blocks take the memory of one twin plus ten blocks each. Sections of a closed version stay
//! until their room is needed.
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
//! **Room is reserved before a load begins**, because the table says how much a section takes.
//! Sections that are being loaded count as in use. The budget covers chunks; outside it are the
//! bytes of one section per loader thread (eight), and 64 B of bookkeeping per section.
//!
//! **Eviction is least recently used; a prefetch counts as a use.** Where prefetching foresees what
//! is needed, this order is the order of time until use. A prefetch evicts nothing that was used
//! since its session's last prefetch, and is dropped if that leaves no room. So a prefetch can
//! evict neither its own sections nor those that other cars at the same pace are about to need.
//!
//! **Prefetching uses the exact places of the next steps**, with the rig's own cameras. One point
//! in the middle of the rig would be cheaper, but levels change at exact distances: a point two
//! metres away needs other sections.
//!
//! **A session reserves the memory of its worst frame**, wherever it drives. The search halves
//! squares of the twin's map, the worst first, until the worst is as small as a cell. A bound
//! computed from the distance of a square is never below the need of a place in it. The searched
//! squares lie along the road, so 20 km of road take about as many of them as it has cells.
//!
//! **A failed load** is tried three times within 0.3 s, by whichever thread is free; then the
//! frames that wait for it get the error. The section is then simply absent, so the next frame
//! tries again.
//!
//! There are no watermarks (such as 90 % and 80 %): a load evicts as much as it needs. The GPU's
//! pages are not tied to this table: the GPU copy of the chunks has a budget of its own.

mod budget;
mod cache;
mod demand;
mod error;
mod index;
mod load_times;
mod pager;
mod requests;
mod reservation;
mod resident;
mod source;
mod stats;
mod table;
mod worst_case;

pub use budget::default_memory_bytes;
pub use cache::Cache;
pub use demand::{SectionRef, Viewpoint};
pub use error::ResidencyError;
pub use index::{BlockIndex, demand};
pub use pager::{PinnedScene, SceneCallback};
pub use requests::Urgency;
pub use reservation::{Prefetcher, Reservation};
pub use resident::{Resident, SceneRequest};
pub use source::SectionSource;
pub use stats::Stats;
pub use worst_case::RigExtent;
