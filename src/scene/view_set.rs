//! Sets of the views of a frame, and which of its views draw which chunks of a scene.

use crate::Rig;

/// Some of the views of a frame, by their indices, which are below [`Rig::MAX_CAMERAS`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ViewSet(u16);

const _: () = assert!(Rig::MAX_CAMERAS == u16::BITS as usize);

impl ViewSet {
    /// Every view that a frame may have.
    pub const ALL: Self = Self(u16::MAX);

    /// Whether a view is one of them.
    #[inline]
    pub fn contains(self, view: usize) -> bool {
        view < Rig::MAX_CAMERAS && self.0 >> view & 1 == 1
    }

    /// Adds a view.
    ///
    /// # Panics
    /// If its index is not below [`Rig::MAX_CAMERAS`].
    pub fn insert(&mut self, view: usize) {
        assert!(view < Rig::MAX_CAMERAS, "view {view} of a frame");
        self.0 |= 1 << view;
    }
}

impl FromIterator<usize> for ViewSet {
    /// # Panics
    /// As [`ViewSet::insert`].
    fn from_iter<I: IntoIterator<Item = usize>>(views: I) -> Self {
        let mut set = Self::default();
        views.into_iter().for_each(|view| set.insert(view));
        set
    }
}

/// Which views of a frame draw which chunks: those of a twin in levels of detail, which each view
/// has of its own.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Selection {
    /// Number of views of the frame.
    pub views: usize,
    /// The views that draw each chunk, in order of [`Scene::chunks`](crate::Scene::chunks).
    pub by_chunk: Vec<ViewSet>,
}
