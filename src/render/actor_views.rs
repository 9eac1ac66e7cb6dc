//! How the views of a frame see its actors: each view from the axes of each placed chunk.

use wildcity_scene::actor::PlacedChunk;

use crate::{Frame, View};

/// The views of a frame from the axes of each actor. A frame without actors has none.
#[derive(Debug, Default)]
pub(crate) struct ActorViews {
    /// One list per view of the frame, in order of
    /// [`Scene::placed`](wildcity_scene::Scene::placed).
    relative: Vec<Vec<View>>,
}

impl ActorViews {
    pub(crate) fn new(frame: &Frame<'_>) -> Self {
        let placed: &[PlacedChunk] = &frame.scene.placed;
        if placed.is_empty() {
            return Self::default();
        }
        // The outer list is per view and not per actor, as the stages go through the views.
        let of_view = |view: &View| placed.iter().map(|placed| view.seen_from(placed)).collect();
        Self { relative: frame.views.iter().map(of_view).collect() }
    }

    /// One view of the frame from the axes of each placed chunk, in order.
    pub(crate) fn for_view(&self, view: usize) -> &[View] {
        // Without actors the outer list is empty, and a view sees none.
        self.relative.get(view).map_or(&[], Vec::as_slice)
    }

    /// For each view of the frame, the view from the axes of each placed chunk.
    pub(crate) fn all(&self) -> impl Iterator<Item = &[View]> {
        self.relative.iter().map(Vec::as_slice)
    }
}
