//! Repair of a session's images by a model: which images, by which model, and what is told of each.
//!
//! An image is repaired if its trust is low ([`Selection`]); on the recorded drive the trust is 1 and no byte
//! changes. No clock decides: the budget counts images, so a replay decides alike. The one exception is a
//! model that fails, for example because it runs too long: its image is delivered as rendered, says so, and
//! is on record as such.
//!
//! The overlay of a camera is in the rendered image, so the model sees it. Afterwards it is put back: a
//! repaired image has the rendered pixels where the overlay is opaque, and a mixture where it is in part.
//!
//! A model may see recorded images beside the rendered one. `references` says which, `drawn` reads or draws them.

pub(crate) mod drawn;
pub(crate) mod offline;
pub(crate) mod references;
pub(crate) mod rendered_image;
pub(crate) mod session_repair;
pub(crate) mod status;
