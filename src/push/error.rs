//! Why a push was refused or failed.

use std::time::Duration;

use wildcity_session::SessionError;
use wildcity_twin::ingest::IngestError;
use wildcity_twin::store::StoreError;

/// Why a push was not accepted, or did not end with a version.
#[derive(Debug, thiserror::Error)]
pub enum PushError {
    /// A field of the request is outside its limits.
    #[error("{field} is {must}")]
    OutOfRange {
        /// The field, as it is called on the wire.
        field: String,
        /// Its value, and the accepted values.
        must: String,
    },
    /// A field of the request cannot be understood.
    #[error("{field}: {reason}")]
    InvalidField {
        /// The field, as it is called on the wire.
        field: String,
        reason: String,
    },
    /// A field of the request is not a name.
    #[error(
        "{name:?} is not a name: a name has 1 to 64 of a-z 0-9 . _ - and does not start with ."
    )]
    InvalidName {
        /// The field, as it is called on the wire.
        field: &'static str,
        name: String,
    },
    /// The content of the files cannot be accepted.
    #[error("{reason}")]
    Content {
        reason: String,
        /// The cells (x, y) at fault; empty if the fault is not in cells.
        cells: Vec<[i32; 2]>,
    },
    /// There is no such push, or its status is no longer kept.
    #[error("there is no push {id:?} of twin {twin:?} any more; send it again")]
    UnknownPush {
        /// The id asked for.
        id: String,
        twin: String,
    },
    /// Too many pushes wait or run.
    #[error("there are {limit} pushes already; try again later")]
    Busy {
        /// How many may wait or run.
        limit: usize,
    },
    /// Its client cancelled it.
    #[error("the push was cancelled; send it again if it is wanted after all")]
    Cancelled,
    /// It can no longer be cancelled.
    #[error("the push {id:?} {why}")]
    TooLate { id: String, why: &'static str },
    /// Reading and checking it took too long.
    #[error(
        "reading and checking took longer than {limit:?}; push the scene in parts, some cells each"
    )]
    TimedOut {
        /// The most that it may take.
        limit: Duration,
    },
    #[error("the server is shutting down; send the push again when it is back")]
    ShuttingDown,
    /// The store, the cache of twins, or the renderer refused.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// A file of the push cannot be read, although it was accepted.
    #[error("cannot read {name}: {reason}")]
    Unreadable {
        /// Name of the file.
        name: String,
        /// The operating system's error.
        reason: String,
    },
    /// The process abandoned it before it began.
    #[error("the push did not begin: {reason}")]
    Abandoned { reason: String },
    /// A defect of the program.
    #[error("a task crashed; the server's log says where")]
    Crashed,
}

impl PushError {
    /// Whether the request, its files, or the base that it names are at fault, so that the same
    /// push would be refused again. After any other error it may be tried again.
    pub fn is_refusal(&self) -> bool {
        match self {
            Self::OutOfRange { .. }
            | Self::InvalidField { .. }
            | Self::InvalidName { .. }
            | Self::Content { .. }
            // The same files take the same time again, so the client has to divide the push.
            | Self::TimedOut { .. } => true,
            Self::Session(SessionError::Twin(error)) => is_refused_content(error),
            // No wildcard in this match: an added variant has to be sorted into one of the two
            // groups.
            Self::UnknownPush { .. }
            | Self::Busy { .. }
            | Self::Cancelled
            | Self::TooLate { .. }
            | Self::ShuttingDown
            | Self::Session(_)
            | Self::Unreadable { .. }
            | Self::Abandoned { .. }
            | Self::Crashed => false,
        }
    }
}

impl From<StoreError> for PushError {
    fn from(error: StoreError) -> Self {
        Self::Session(error.into())
    }
}

/// Whether a commit was refused because of its content or its base, and not because of a fault of
/// the store.
fn is_refused_content(error: &StoreError) -> bool {
    match error {
        // A file that the system cannot read says nothing about its content.
        StoreError::Gaussians(error) => !matches!(error, IngestError::File(_)),
        // These depend on the content, the settings or the base alone.
        StoreError::Clamped { .. }
        | StoreError::Profile(_)
        | StoreError::FieldMismatch { .. }
        | StoreError::Alignment(_)
        | StoreError::Scattered { .. }
        | StoreError::ManifestSize { .. }
        | StoreError::ViewSize { .. }
        | StoreError::ActorExists { .. }
        | StoreError::TwinExists { .. }
        | StoreError::Overlap { .. } => true,
        // These depend on the medium, on its other users, or on a defect of the program.
        StoreError::Io { .. }
        | StoreError::Name { .. }
        | StoreError::NoTwin { .. }
        | StoreError::NoVersion { .. }
        | StoreError::NoActor { .. }
        | StoreError::ActorDamaged { .. }
        | StoreError::NothingToCut { .. }
        | StoreError::NothingToLabel
        | StoreError::GarbageCollected { .. }
        | StoreError::Leased { .. }
        | StoreError::Damaged { .. }
        | StoreError::Format { .. }
        | StoreError::Conflict { .. }
        | StoreError::DuplicateCell { .. }
        | StoreError::SideFileSize { .. }
        | StoreError::NotSynced { .. }
        | StoreError::OutcomeUnknown { .. }
        | StoreError::Url { .. }
        | StoreError::Rig(_)
        | StoreError::Geo(_)
        | StoreError::Trajectory(_)
        | StoreError::DuplicateTrajectory { .. } => false,
    }
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;
    use wildcity_scene::RecordFormat;

    /// A client sends a failed push again, and must not send a refused one again.
    #[test]
    fn only_faults_of_the_push_itself_are_refusals() {
        let name = || "city".to_owned();
        let io = |kind: io::ErrorKind| StoreError::Io {
            action: "write",
            path: "city/chunk".into(),
            cause: kind.into(),
        };
        let overlap = StoreError::Overlap {
            name: name(),
            base: 1,
            latest: 2,
            cells: vec![[0, 0]],
            settings: Vec::new(),
        };
        let clamped = StoreError::Clamped {
            record: RecordFormat::default(),
            field: "mean",
            count: 1,
            gaussians: 2,
        };
        // One fault of the base and one of the content; sending either again gives the same answer.
        for error in [overlap, clamped] {
            assert!(PushError::from(error).is_refusal());
        }
        // Nothing is known about the outcome, or the disk did not take it: sending it again settles
        // this, because a push of equal content makes no second version.
        let unsettled = StoreError::OutcomeUnknown {
            name: name(),
            number: 2,
            cause: io::ErrorKind::TimedOut.into(),
        };
        let not_synced = StoreError::NotSynced {
            name: name(),
            number: 2,
            cause: Box::new(io(io::ErrorKind::Other)),
        };
        for error in [
            io(io::ErrorKind::StorageFull),
            io(io::ErrorKind::QuotaExceeded),
            io(io::ErrorKind::PermissionDenied),
            unsettled,
            not_synced,
            StoreError::Url { url: "s3://x".to_owned(), reason: "no credentials".to_owned() },
            StoreError::GarbageCollected { name: name(), number: 2 },
            StoreError::Format { path: "city/log/2".into(), found: 9, supported: 1 },
            StoreError::Conflict { name: name(), number: 2 },
        ] {
            let error = PushError::from(error);
            assert!(!error.is_refusal(), "{error}");
        }
    }
}
