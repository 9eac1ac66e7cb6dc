//! Pushes: trained scenes become a new version of a twin, all of their cells at once or none; and
//! assets of actors.
//!
//! ```text
//! request   the request for a push, and the checks that need neither files nor twin
//! base      the version that a push is made from, and conflicts with later versions
//! queue     the pushes of a server: waiting, running, recently ended
//! status    the progress of a push
//! source    reads scene files and converts them to the twin's axes; `wildcity import` uses it, too
//! read      joins the files of one push, and transforms them to the twin's frame
//! frame     the axes of a push: the twin's, or those of its capture before it was aligned
//! report    contents of the files, and cells that would change
//! preview   compares small images before and after
//! commit    writes the version
//! asset     assets of actors from files, as `wildcity actor import` makes them
//! edit      the same Gaussians on level ground, with a drive and a rig
//! publish   the pipeline: read, check, preview, commit, preload
//! ```
//!
//! Nothing of a push is visible before its version is committed, or its asset is stored. This
//! package contains neither HTTP nor JSON: the server converts requests and answers.

mod asset;
mod base;
mod blocking;
mod commit;
mod edit;
mod error;
mod frame;
pub mod limits;
mod preview;
mod publish;
mod queue;
mod read;
mod report;
mod request;
mod source;
mod status;

pub use asset::{AssetRequest, AssetSettings, AssetSource, make_asset, publish_asset};
pub use base::{check_base, default_id};
pub use edit::{DriveRequest, EditRequest, Survey, publish_edit, survey};
pub use error::PushError;
pub use frame::Frame;
pub use preview::PsnrPreview;
pub use publish::{Viewpoints, publish};
pub use queue::{Begun, PushQueue, QueueLimits};
pub use report::{CellChange, FileReport, PushReport, Ranges};
pub use request::{CellSelection, PushRequest, RequestedFile, profile_with};
pub use source::{
    SourceAxes, SourceFile, SourceScene, provenance, read_actor, read_scene, read_tracked,
};
pub use status::{Progress, Push, PushedVersion, State, Status};
