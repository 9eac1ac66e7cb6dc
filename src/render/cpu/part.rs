//! Parts of a frame: the views that are rendered together, so that the intermediate buffers stay
//! small.

use rayon::prelude::*;

use super::background::Background;
use crate::layout::Frustum;
use crate::unscented::UnscentedView;
use crate::{Frame, View};
use wildcity_scene::chunk::{CLUSTER, Cluster};

/// Some of a frame's views, which are rendered together.
#[derive(Clone, Copy)]
pub(super) struct FramePart<'a> {
    /// The frame with only these views: those of the samples, where pixels have several.
    pub(super) frame: Frame<'a>,
    /// The views of the images.
    pub(super) shown: &'a [View],
    /// One per view of the part, or none.
    pub(super) backgrounds: &'a [Background],
    /// Index of the part's first view in the whole frame.
    pub(super) first_view: usize,
}

impl FramePart<'_> {
    /// This part cut into two.
    pub(super) fn halves(&self) -> [Self; 2] {
        let middle = self.frame.views.len() / 2;
        let (first, second) = self.frame.views.split_at(middle);
        let (first_shown, second_shown) = self.shown.split_at(middle);
        // Without a background the slice is empty and cannot be split in the middle.
        let (behind_first, behind_second) = if self.backgrounds.is_empty() {
            (self.backgrounds, self.backgrounds)
        } else {
            self.backgrounds.split_at(middle)
        };
        let part = |views, shown, backgrounds, first_view| Self {
            frame: Frame { views, ..self.frame },
            shown,
            backgrounds,
            first_view,
        };
        [
            part(first, first_shown, behind_first, self.first_view),
            part(second, second_shown, behind_second, self.first_view + middle),
        ]
    }

    /// An upper bound of its splats: all Gaussians of actors and of the clusters that its views may
    /// see. The clusters of scenes with at most `few` Gaussians for all views are not tested.
    pub(super) fn max_splats(&self, few: usize) -> usize {
        let Frame { scene, views, .. } = self.frame;
        let all = scene.gaussians() * views.len();
        // The scene as a whole fits, so that no cluster has to be tested.
        if all <= few {
            return all;
        }
        let views = views.par_iter().enumerate();
        views.map(|(index, view)| self.visible_gaussians(view, self.first_view + index)).sum()
    }

    /// Gaussians of the twin's clusters that a view may see, and of the actors that it draws. The
    /// index is that in the whole frame.
    fn visible_gaussians(&self, view: &View, index: usize) -> usize {
        let Frame { scene, profile, .. } = self.frame;
        let unscented = UnscentedView::new(view, profile);
        let mut clusters = 0;
        let chunks = scene.chunks.iter().enumerate();
        for (_, chunk) in chunks.filter(|(number, _)| scene.draws(*number, index)) {
            let frustum = Frustum::new(view, chunk, profile);
            let may_see = |cluster: &&Cluster| {
                let Cluster { min_m, max_m, sigma_m, .. } = **cluster;
                match &unscented {
                    Some(unscented) => unscented.may_see(chunk.origin_m(), min_m, max_m, sigma_m),
                    None => frustum.may_see(min_m, max_m, sigma_m),
                }
            };
            clusters += chunk.clusters().iter().filter(may_see).count();
        }
        // Actors are few and small: all of their Gaussians count.
        let placed = scene.placed.iter().filter(|placed| placed.views.contains(index));
        let of_actors: usize = placed.map(|placed| placed.chunk.len()).sum();
        // A chunk's last cluster may be partly filled, which an upper bound allows.
        clusters * CLUSTER + of_actors
    }
}
