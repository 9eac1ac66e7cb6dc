//! Repair of a session's images by a model: which images, by which model, and what is reported of
//! each.
//!
//! An image is repaired if its trust is low ([`Selection`]); on the recorded drive the trust is 1
//! and no byte changes. The selection does not depend on the clock: the budget counts images, so a
//! replay makes the same decisions. The one exception is a model that fails, for example because it
//! runs too long: its image is delivered as rendered, and is marked so in the observation and in
//! the record.
//!
//! The overlay of a camera is in the rendered image, which the model gets. Afterwards it is
//! restored: a repaired image has the rendered pixels where the overlay is opaque, and a mixture
//! where it is in part.
//!
//! A model may get recorded images in addition to the rendered one. `references` chooses them,
//! `drawn` reads or renders them.

pub(crate) mod drawn;
pub(crate) mod offline;
pub(crate) mod references;
pub(crate) mod rendered_image;
pub(crate) mod session_repair;
pub(crate) mod status;
