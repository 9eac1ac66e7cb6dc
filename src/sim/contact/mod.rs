//! Contact between oriented boxes, and the fault for it.
//!
//! | file | what it computes |
//! |---|---|
//! | `footprint.rs` | a box seen from above: corners, gap and distance to another |
//! | `body.rs` | a footprint with its heights, from a pose and a size |
//! | `sweep.rs` | when two footprints at constant velocity overlap; time to contact |
//! | `detector.rs` | the contacts of the ego, sub-step by sub-step |
//! | `fault.rs` | which side of the ego was hit, and the fault |
//! | `solid.rs` | contact with the twin's own Gaussians |
//! | `solids.rs` | these Gaussians in a grid, and the area of them that the ego overlaps at a pose |
//!
//! All of it is f64 and relative to the ego, so that a decision is the same at any distance from
//! the world's origin. Boxes are closed sets: boxes that touch are in contact.

mod body;
mod detector;
mod fault;
mod footprint;
mod solid;
mod solids;
mod sweep;

pub use body::Body;
pub use detector::{Contact, Detector, MAX_SWEPT_SPEED_MPS};
pub use fault::{
    BEHIND_RAD, CollisionType, FaultInput, LanePosition, STANDING_MPS, is_ego_at_fault,
};
pub use footprint::{Footprint, TOUCH_M};
pub use solid::{
    FREE_AREA_M2, GROUND_MARGIN_M, SIDE_MARGIN_M, SOLID_OPACITY, SolidPoint, StaticLimit,
    solid_area_m2,
};
pub use solids::{SolidSums, Solids, TestedBox};
pub use sweep::{Moving, overlap_s, time_to_contact_s};
