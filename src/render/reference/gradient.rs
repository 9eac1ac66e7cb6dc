//! Gradients by definition, in f64: every pixel against every Gaussian, and every chain rule
//! written out.
//!
//! Order, cut, cap and stop are steps, so that differences of the image are wrong by any amount
//! where one of them lies between the two images: of 24 differences of a rig half were, with a step
//! of 1e-6. [`Decisions`] holds them: which Gaussians each pixel blends, in which order, and which
//! of them are at the cap. An image with given decisions is a smooth function of the parameters.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::Reference;
use super::project::{Footprint, Gaussian, Splat, sort};
use crate::gradient::{
    Differentiate, FootprintGradient, GaussianGradient, GaussianImages, GradientError, Gradients,
    LossGradient, Twist, check_finite, check_frame, check_sizes, color_gradient, mask,
};
use crate::layout::PixelFilter;
use crate::{Backend, Frame, FrameStats, View};
use wildcity_scene::{Chunk, RenderProfile, Scene};

/// A Gaussian of a scene, and how it is seen.
#[derive(Clone, Copy, Debug)]
pub struct Source {
    pub gaussian: Gaussian,
    /// Index of the view that sees it in [`Sources::views`].
    pub view: usize,
    /// Factor of red, green and blue.
    pub tint: DVec3,
}

/// The Gaussians of a scene in order of global ids, and one view from the axes of each.
#[derive(Clone, Debug)]
pub struct Sources<'a> {
    pub profile: &'a RenderProfile,
    pub gaussians: Vec<Source>,
    /// The view from the world, then that from the axes of each placed chunk.
    pub views: Vec<View>,
    /// Depth and order are those of z for every lens, as in gsplat, whose gradients this can be
    /// compared with, and not those of [`Camera::depth_m`](wildcity_scene::geometry::Camera).
    pub depth_is_z: bool,
}

/// The images of a view in f64.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Images {
    pub rgb: Vec<DVec3>,
    pub opacity: Vec<f64>,
    pub depth_sum_m: Vec<f64>,
}

/// The steps of an image: for each pixel the Gaussians that it blends, from front to back.
#[derive(Clone, Debug, PartialEq)]
pub struct Decisions(Vec<Vec<Contribution>>);

#[derive(Clone, Copy, Debug, PartialEq)]
struct Contribution {
    gaussian: usize,
    is_capped: bool,
}

/// The derivatives of a loss by a splat.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SplatGradient {
    pub mean_px: DVec2,
    /// By (xx, xy, yy) of the inverse covariance: xy stands twice in its matrix.
    pub conic: DVec3,
    pub opacity: f64,
    pub rgb: DVec3,
    pub depth_m: f64,
}

/// The derivatives of a loss by one Gaussian.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SourceGradient {
    pub geometry: GaussianGradient,
    pub sh: [DVec3; 16],
}

impl<'a> Sources<'a> {
    /// The Gaussians of a scene as one view sees them.
    pub fn from_scene(scene: &Scene, profile: &'a RenderProfile, view: &View) -> Self {
        let mut views = vec![*view];
        let mut gaussians = Vec::new();
        let mut add = |chunk: &Chunk, view: usize, tint: DVec3| {
            let source =
                |index| Source { gaussian: Gaussian::from_chunk(chunk, index), view, tint };
            gaussians.extend((0..chunk.len()).map(source));
        };
        for chunk in &scene.chunks {
            add(chunk, 0, DVec3::ONE);
        }
        for placed in &scene.placed {
            let tint = DVec3::from_array(placed.tint.map(f64::from));
            add(&placed.chunk, views.len(), tint);
            views.push(view.seen_from(placed));
        }
        Self { profile, gaussians, views, depth_is_z: false }
    }

    /// The splats that are drawn; `None` for the others.
    fn splats(&self) -> Vec<Option<Splat>> {
        let mut splats = self.splats_of_any_opacity();
        for splat in &mut splats {
            *splat = splat.filter(|splat| splat.opacity >= self.profile.alpha_cut);
        }
        splats
    }

    /// The splats whatever their opacity, for an image with given decisions.
    fn splats_of_any_opacity(&self) -> Vec<Option<Splat>> {
        let splat = |source: &Source| {
            let view = &self.views[source.view];
            let mut splat = source.gaussian.project_any_opacity(self.profile, view)?;
            if self.depth_is_z {
                splat.depth_m = view.project_extrapolated(source.gaussian.mean_m, 1.0).point_m.z;
            }
            Some(Splat { rgb: splat.rgb * source.tint, ..splat })
        };
        self.gaussians.par_iter().map(splat).collect()
    }

    /// The steps of the image.
    pub fn decisions(&self) -> Decisions {
        let mut splats: Vec<Splat> = self
            .splats()
            .into_iter()
            .enumerate()
            // The index leads back to the source; the order of splats does not depend on it.
            .filter_map(|(index, splat)| splat.map(|splat| Splat { gaussian: [0, index], ..splat }))
            .collect();
        sort(&mut splats);
        let pixel = |at_px: DVec2| {
            let mut contributions = Vec::new();
            let mut transmittance = 1.0;
            for splat in &splats {
                let alpha = splat.alpha(at_px);
                let touches = alpha.min(self.profile.alpha_cap) >= self.profile.alpha_cut;
                if !touches {
                    continue;
                }
                let after = transmittance * (1.0 - alpha.min(self.profile.alpha_cap));
                // The splat that would bring the pixel to the stop is left out, like all behind it.
                if after <= self.profile.stop {
                    break;
                }
                transmittance = after;
                let is_capped = alpha > self.profile.alpha_cap;
                contributions.push(Contribution { gaussian: splat.gaussian[1], is_capped });
            }
            contributions
        };
        Decisions(self.pixel_centers().into_par_iter().map(pixel).collect())
    }

    /// The images with given decisions.
    pub fn images(&self, decisions: &Decisions) -> Images {
        let splats = self.splats_of_any_opacity();
        let pixel = |(at_px, contributions): (DVec2, &Vec<Contribution>)| {
            let mut rgb = DVec3::ZERO;
            let mut depth_sum_m = 0.0;
            let mut transmittance = 1.0;
            for (splat, contribution) in drawn(&splats, contributions) {
                let alpha = self.alpha(splat, contribution, at_px);
                rgb += alpha * transmittance * splat.rgb;
                depth_sum_m += alpha * transmittance * splat.depth_m;
                transmittance *= 1.0 - alpha;
            }
            (rgb, (1.0 - transmittance, depth_sum_m))
        };
        let pixels = self.pixel_centers().into_par_iter().zip(&decisions.0).map(pixel);
        let (rgb, (opacity, depth_sum_m)) = pixels.unzip();
        Images { rgb, opacity, depth_sum_m }
    }

    /// The derivatives of a loss by every splat, given those by the images.
    pub fn splat_gradients(&self, decisions: &Decisions, by: &Images) -> Vec<SplatGradient> {
        let splats = self.splats_of_any_opacity();
        let centers_px = self.pixel_centers();
        let mut gradients = vec![SplatGradient::default(); splats.len()];
        for (pixel, contributions) in decisions.0.iter().enumerate() {
            let at_px = centers_px[pixel];
            let energy = |splat: &Splat| {
                splat.rgb.dot(by.rgb[pixel]) + splat.depth_m * by.depth_sum_m[pixel]
            };
            // What is in front of everything: the whole image of the pixel, and the end's
            // transmittance, which opacity has with a minus.
            let mut behind = 0.0;
            let mut transmittance = 1.0;
            for (splat, contribution) in drawn(&splats, contributions) {
                let alpha = self.alpha(splat, contribution, at_px);
                behind += alpha * transmittance * energy(splat);
                transmittance *= 1.0 - alpha;
            }
            behind -= transmittance * by.opacity[pixel];

            transmittance = 1.0;
            for (splat, contribution) in drawn(&splats, contributions) {
                let alpha = self.alpha(splat, contribution, at_px);
                let weight = alpha * transmittance;
                behind -= weight * energy(splat);
                let by_alpha = transmittance * energy(splat) - behind / (1.0 - alpha);
                transmittance *= 1.0 - alpha;

                let gradient = &mut gradients[contribution.gaussian];
                gradient.rgb += weight * by.rgb[pixel];
                gradient.depth_m += weight * by.depth_sum_m[pixel];
                if contribution.is_capped {
                    continue;
                }
                // alpha = opacity exp(power), power = -(xx dx² + yy dy²)/2 - xy dx dy.
                let by_power = by_alpha * alpha;
                let d = at_px - splat.mean_px;
                let Splat { conic, .. } = splat;
                gradient.opacity += by_power / splat.opacity;
                gradient.mean_px += by_power
                    * DVec2::new(conic.x * d.x + conic.y * d.y, conic.y * d.x + conic.z * d.y);
                gradient.conic -=
                    by_power * DVec3::new(0.5 * d.x * d.x, d.x * d.y, 0.5 * d.y * d.y);
            }
        }
        gradients
    }

    /// The derivatives of a loss by every Gaussian and by the view's twist, given those by splats.
    pub fn gradients(&self, by_splats: &[SplatGradient]) -> (Vec<SourceGradient>, Twist) {
        let one = |(source, by): (&Source, &SplatGradient)| {
            // Also of Gaussians that a chunk has emptied, which have no rotation.
            if *by == SplatGradient::default() {
                return Default::default();
            }
            self.back_project(source, by).unwrap_or_default()
        };
        let all: Vec<_> = self.gaussians.par_iter().zip(by_splats).map(one).collect();
        let mut twist = Twist::default();
        let mut gradients = Vec::with_capacity(all.len());
        // In the order of the Gaussians, so that the sum does not depend on threads.
        for (gradient, of_one) in all {
            twist += of_one;
            gradients.push(gradient);
        }
        (gradients, twist)
    }

    /// `None` for a Gaussian out of the range of depths or angles.
    fn back_project(&self, source: &Source, by: &SplatGradient) -> Option<(SourceGradient, Twist)> {
        let Source { gaussian, tint, .. } = source;
        let view = &self.views[source.view];
        let splat = gaussian.project_any_opacity(self.profile, view)?;
        let Footprint { camera_m, .. } = gaussian.footprint(self.profile, view)?;
        let filter = PixelFilter::new(self.profile, &view.camera);

        // Q = C⁻¹, so that V_C = -Q V_Q Q; and d ln det C = Q dC, for the opacity's scales.
        let by_conic = by.conic * DVec3::new(1.0, 0.5, 1.0);
        let by_ln_opacity = by.opacity * splat.opacity;
        let by_ln_shrink = PixelFilter::SHRINK_POWER * by_ln_opacity;
        let covariance = -congruence(splat.conic, by_conic) - by_ln_shrink * splat.conic;

        let axes_m = gaussian.axes_m();
        let toward = gaussian.mean_m - camera_m;
        let (sh, by_toward) = color_gradient(&gaussian.sh, toward, by.rgb * *tint);
        let footprint = FootprintGradient {
            mean_px: by.mean_px,
            covariance,
            ln_blur_share: if self.profile.antialiased { 0.5 * by_ln_opacity } else { 0.0 },
            ln_det_native: by_ln_shrink,
            native_px2: filter.native_px2,
            depth_m: by.depth_m,
            depth_is_z: self.depth_is_z,
            toward: by_toward,
        };
        let shape = footprint.to_shape(view, gaussian.mean_m, axes_m);
        let (ln_scale, quat_wxyz) =
            shape.to_scale_and_rotation(axes_m, gaussian.rotation.normalize());
        let geometry = GaussianGradient {
            mean_m: shape.mean_m.to_array(),
            quat_wxyz,
            ln_scale,
            log2_opacity: by_ln_opacity * std::f64::consts::LN_2,
        };
        Some((SourceGradient { geometry, sh }, shape.twist))
    }

    /// The alpha of a splat at a pixel.
    fn alpha(&self, splat: &Splat, contribution: &Contribution, at_px: DVec2) -> f64 {
        if contribution.is_capped { self.profile.alpha_cap } else { splat.alpha(at_px) }
    }

    /// The centres of all pixels, row by row.
    fn pixel_centers(&self) -> Vec<DVec2> {
        let camera = &self.views[0].camera;
        let center = |row: u32, column: u32| DVec2::new(f64::from(column), f64::from(row)) + 0.5;
        let rows = 0..camera.height_px;
        rows.flat_map(|row| (0..camera.width_px).map(move |column| center(row, column))).collect()
    }
}

/// Whether a splat reaches the centre of a pixel of an image of this size.
fn is_on_image(splat: &Option<Splat>, size_px: DVec2) -> bool {
    splat.is_some_and(|Splat { mean_px, reach_px, .. }| {
        (mean_px + reach_px).cmpge(DVec2::splat(0.5)).all()
            && (mean_px - reach_px).cmple(size_px - 0.5).all()
    })
}

/// The splats that a pixel blends.
fn drawn<'a>(
    splats: &'a [Option<Splat>],
    contributions: &'a [Contribution],
) -> impl Iterator<Item = (&'a Splat, &'a Contribution)> {
    contributions.iter().filter_map(|contribution| {
        splats[contribution.gaussian].as_ref().map(|splat| (splat, contribution))
    })
}

/// `Q V Q` of symmetric matrices (xx, xy, yy).
fn congruence(q: DVec3, v: DVec3) -> DVec3 {
    let rows = [DVec2::new(q.x, q.y), DVec2::new(q.y, q.z)];
    let [first, second] =
        rows.map(|row| DVec2::new(v.x * row.x + v.y * row.y, v.y * row.x + v.z * row.y));
    DVec3::new(rows[0].dot(first), rows[0].dot(second), rows[1].dot(second))
}

impl Splat {
    /// Its alpha at a place of the image, before cap and cut.
    fn alpha(&self, at_px: DVec2) -> f64 {
        let d = at_px - self.mean_px;
        let power =
            -0.5 * (self.conic.x * d.x * d.x + self.conic.z * d.y * d.y) - self.conic.y * d.x * d.y;
        self.opacity * power.exp()
    }
}

impl Images {
    /// From images of f32, or derivatives by them. Depth may be missing.
    pub fn from_gaussian_images(images: &GaussianImages) -> Self {
        let rgb =
            images.rgb.chunks_exact(3).map(|c| DVec3::new(c[0].into(), c[1].into(), c[2].into()));
        let mut depth_sum_m: Vec<f64> = images.depth_sum_m.iter().map(|&m| m.into()).collect();
        depth_sum_m.resize(images.opacity.len(), 0.0);
        Self {
            rgb: rgb.collect(),
            opacity: images.opacity.iter().map(|&value| value.into()).collect(),
            depth_sum_m,
        }
    }

    /// These images in f32.
    pub fn to_gaussian_images(&self, depth: bool) -> GaussianImages {
        let to_f32 = |values: &[f64]| values.iter().map(|&value| value as f32).collect();
        GaussianImages {
            rgb: self.rgb.iter().flat_map(|rgb| rgb.as_vec3().to_array()).collect(),
            opacity: to_f32(&self.opacity),
            depth_sum_m: if depth { to_f32(&self.depth_sum_m) } else { Vec::new() },
        }
    }
}

impl Differentiate for Reference {
    fn differentiate(
        &self,
        frame: &Frame<'_>,
        depth: bool,
        loss: LossGradient<'_>,
        gradients: &mut Gradients,
    ) -> Result<FrameStats, GradientError> {
        check_frame(frame, self.name())?;
        let sources: Vec<Sources<'_>> = frame
            .views
            .iter()
            .map(|view| Sources::from_scene(frame.scene, frame.profile, view))
            .collect();
        let decisions: Vec<Decisions> = sources.iter().map(Sources::decisions).collect();
        let images: Vec<GaussianImages> = sources
            .iter()
            .zip(&decisions)
            .map(|(sources, decisions)| {
                let mut images = sources.images(decisions).to_gaussian_images(depth);
                mask(&sources.views[0], &mut images);
                images
            })
            .collect();
        let mut derivatives = loss(&images);
        check_sizes(frame, depth, &mut derivatives)?;
        for (view, derivatives) in derivatives.iter().enumerate() {
            check_finite(view, derivatives)?;
        }

        gradients.reset(frame.scene, frame.views.len());
        let mut stats = FrameStats::default();
        for (view, (sources, decisions)) in sources.iter().zip(&decisions).enumerate() {
            let by = Images::from_gaussian_images(&derivatives[view]);
            let (by_sources, twist) = sources.gradients(&sources.splat_gradients(decisions, &by));
            gradients.twists[view] = twist;
            let view_size_px = frame.views[view].camera.size_px();
            let is_drawn: Vec<bool> =
                sources.splats().iter().map(|splat| is_on_image(splat, view_size_px)).collect();
            stats.visible_pairs += is_drawn.iter().filter(|&&is_drawn| is_drawn).count() as u64;
            // The sources are in the order of the chunks, and of the Gaussians of each.
            let mut first = 0;
            for chunk in &mut gradients.chunks {
                for index in 0..chunk.len() {
                    if is_drawn[first + index] {
                        let SourceGradient { geometry, sh } = &by_sources[first + index];
                        chunk.add(index, geometry, sh);
                    }
                }
                first += chunk.len();
            }
        }
        Ok(stats)
    }
}
