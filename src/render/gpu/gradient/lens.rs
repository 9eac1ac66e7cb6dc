//! Projection backwards on the host: views of lenses and rolling shutters. The Gaussians are those
//! of the chunk, as they are before the mirror rounds them; the splats are the device's.

use glam::DVec3;
use rayon::prelude::*;

use super::GradientClusters;
use crate::actor_views::ActorViews;
use crate::gpu::layout::SplatShape;
use crate::gpu::project_work::{ProjectWork, Projection};
use crate::gradient::{
    FootprintGradient, GaussianGradient, Gradients, Partial, Twist, chunks, color_gradient, partial,
};
use crate::layout::PixelFilter;
use crate::reference::Gaussian;
use crate::{Frame, View};
use wildcity_scene::RenderProfile;
use wildcity_scene::chunk::CLUSTER;

/// What the device has of each splat.
#[derive(Clone, Copy, Debug)]
pub(in crate::gpu) struct HostSplats<'a> {
    pub(in crate::gpu) shapes: &'a [SplatShape],
    pub(in crate::gpu) sums: &'a [Partial],
    /// For each cluster view, words of its visible Gaussians.
    pub(in crate::gpu) visible: &'a [u32],
    /// For each cluster view, its first splat.
    pub(in crate::gpu) first_splats: &'a [u32],
}

/// One Gaussian as a view that is no static pinhole sees it.
#[derive(Clone, Copy, Debug)]
struct Seen<'a> {
    gaussian: Gaussian,
    /// The view from the Gaussian's axes.
    view: &'a View,
    profile: &'a RenderProfile,
    tint: DVec3,
}

/// Cluster views that are projected backwards before their derivatives are added: 37 MB of these.
const AT_A_TIME: usize = 256;

/// The derivatives by one Gaussian in one view.
type OfSplat = (usize, GaussianGradient, [DVec3; 16], Twist);

/// Adds the derivatives of all splats of views that are no static pinholes.
pub(in crate::gpu) fn back_project(
    frame: &Frame<'_>,
    actors: &ActorViews,
    work: &ProjectWork,
    clusters: &GradientClusters,
    splats: HostSplats<'_>,
    gradients: &mut Gradients,
) {
    let scene = frame.scene;
    let chunks = chunks(scene);
    let unscented =
        work.dispatches.iter().filter(|d| d.variant.projection == Projection::Unscented);
    let mut cluster_views: Vec<u32> =
        unscented.flat_map(|dispatch| work.cluster_views_in(dispatch.span)).copied().collect();
    // In the order of (view, global id), so that sums have one order.
    cluster_views.sort_unstable();
    let of_cluster_view = |&cluster_view: &u32| -> Vec<OfSplat> {
        let index = cluster_view as usize;
        let (number, first) = clusters.first_gaussian(index);
        let view_index = work.view(cluster_view);
        let placed = number.checked_sub(scene.chunks.len());
        let (view, tint) = match placed {
            None => (&frame.views[view_index], DVec3::ONE),
            Some(placed) => (
                &actors.for_view(view_index)[placed],
                DVec3::from_array(scene.placed[placed].tint.map(f64::from)),
            ),
        };
        let words = &splats.visible[index * CLUSTER / 32..][..CLUSTER / 32];
        let is_visible = |lane: &usize| words[lane / 32] >> (lane % 32) & 1 == 1;
        let visible = (0..CLUSTER).filter(is_visible);
        // The splats of a cluster view follow each other in the order of its visible lanes.
        let own = visible.zip(splats.first_splats[index] as usize..);
        own.map(|(lane, splat)| {
            let gaussian = Gaussian::from_chunk(chunks[number], first + lane);
            let seen = Seen { gaussian, view, profile: frame.profile, tint };
            let factor = splats.shapes[splat].factor;
            let (geometry, sh, twist) = seen.back_project(factor, &splats.sums[splat]);
            (first + lane, geometry, sh, twist)
        })
        .collect()
    };
    for cluster_views in cluster_views.chunks(AT_A_TIME) {
        let all: Vec<Vec<OfSplat>> = cluster_views.par_iter().map(of_cluster_view).collect();
        // By one thread in order: a Gaussian that several views see has several summands, and the
        // sum of floats depends on their order.
        for (&cluster_view, of_splats) in cluster_views.iter().zip(all) {
            let (chunk, _) = clusters.first_gaussian(cluster_view as usize);
            let view = work.view(cluster_view);
            for (index, geometry, sh, twist) in of_splats {
                gradients.chunks[chunk].add(index, &geometry, &sh);
                gradients.twists[view] += twist;
            }
        }
    }
}

impl Seen<'_> {
    fn back_project(
        &self,
        factor: [f32; 3],
        sums: &Partial,
    ) -> (GaussianGradient, [DVec3; 16], Twist) {
        let Self { gaussian, view, profile, tint } = self;
        let center = view.project_extrapolated(gaussian.mean_m, 1.0);
        let toward = gaussian.mean_m - center.world_from_camera.position_m;
        let [red, green, blue] = [0, 1, 2].map(|channel| f64::from(sums[partial::RGB + channel]));
        let by_rgb = DVec3::new(red, green, blue) * *tint;
        let (sh, by_toward) = color_gradient(&gaussian.sh, toward, by_rgb);
        let filter = PixelFilter::new(profile, &view.camera);
        let footprint =
            FootprintGradient::from_sums(sums, factor, &filter, profile.antialiased, by_toward);
        let axes_m = gaussian.axes_m();
        let shape = footprint.to_shape(view, gaussian.mean_m, axes_m);
        let (ln_scale, quat_wxyz) =
            shape.to_scale_and_rotation(axes_m, gaussian.rotation.normalize());
        let geometry = GaussianGradient {
            mean_m: shape.mean_m.to_array(),
            quat_wxyz,
            ln_scale,
            // The sum is by the natural logarithm of alpha, and ln x = ln 2 log2 x.
            log2_opacity: f64::from(sums[partial::G]) * std::f64::consts::LN_2,
        };
        (geometry, sh, shape.twist)
    }
}
