//! The scene of a file or of a twin, for images outside of sessions.

use std::borrow::Cow;
use std::ops::Deref;
use std::sync::Arc;

use wildcity_render::View;
use wildcity_scene::{RenderProfile, Scene};
use wildcity_twin::residency::{PinnedScene, ResidencyError, Resident};
use wildcity_twin::store::Version;

use crate::viewpoint::viewpoints;

/// A scene outside of sessions, as commands render it.
pub enum OpenScene {
    /// A file: always drawn at full detail.
    File(Scene),
    /// A twin: drawn with as much detail as the cameras need.
    Twin(Arc<Resident>),
}

/// The part of a source that a frame draws. It stays in memory for as long as this value lives.
pub enum FrameScene<'a> {
    /// All of a file.
    Whole(Cow<'a, Scene>),
    /// The sections of a twin that the cameras need.
    Needed(PinnedScene),
}

impl Deref for FrameScene<'_> {
    type Target = Scene;

    fn deref(&self) -> &Scene {
        match self {
            Self::Whole(scene) => scene,
            Self::Needed(pinned) => pinned,
        }
    }
}

impl OpenScene {
    /// The version of the twin; `None` for a file.
    pub fn version(&self) -> Option<&Version> {
        match self {
            Self::Twin(resident) => Some(&resident.version),
            Self::File(_) => None,
        }
    }

    /// The part of the source that a frame of these views draws.
    pub fn scene(
        &self,
        views: &[View],
        profile: &RenderProfile,
    ) -> Result<FrameScene<'_>, ResidencyError> {
        Ok(match self {
            Self::Twin(_) if views.is_empty() => FrameScene::Whole(Cow::default()),
            Self::Twin(resident) => {
                FrameScene::Needed(resident.scene(&viewpoints(views), profile)?)
            }
            Self::File(scene) => FrameScene::Whole(Cow::Borrowed(scene)),
        })
    }
}
