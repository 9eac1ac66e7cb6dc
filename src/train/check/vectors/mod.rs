//! Gradients that others computed: PyTorch's, over gsplat's own projection, in f64.

mod file;
mod losses;

use std::sync::Arc;

use glam::{DQuat, DVec3};
use wildcity_render::compare::gradients::GroupError;
use wildcity_render::gradient::{
    Differentiate, GaussianGradient, GaussianImages, Gradients, RigTwists, Twist,
};
use wildcity_render::reference::gradient::{
    Images, Source, SourceGradient, Sources, SplatGradient,
};
use wildcity_render::reference::{Gaussian, Reference};
use wildcity_render::{Frame, View};
use wildcity_scene::chunk::{RawGaussian, column};
use wildcity_scene::geometry::Camera;
use wildcity_scene::{Chunk, RenderProfile, Scene};

use self::file::{COUNT, Groups};
pub use self::file::{VectorError, Vectors};
use self::losses::{ImageLoss, LossAt};
use super::{CheckError, MOST_ERROR, Row};

/// Largest error of the reference: it linearises the camera by differences, to 1e-10.
const MOST_REFERENCE_ERROR: f64 = 1e-5;

impl Vectors {
    /// Compares the reference and some backends with all cases.
    pub(super) fn rows(&self, backends: &[&dyn Differentiate]) -> Result<Vec<Row>, CheckError> {
        let mut rows = Vec::new();
        let classic = RenderProfile::DEFAULT;
        let antialiased = RenderProfile { antialiased: true, ..classic };
        let pinhole = self.pinhole()?;
        let products = ImageLoss::Products(self.products()?);
        let step = ImageLoss::TrainingStep(self.training_step()?);
        let cases: [(&str, Camera, RenderProfile, &ImageLoss); 4] = [
            ("classic", pinhole, classic, &products),
            ("antialiased", pinhole, antialiased, &products),
            ("fisheye_unscented", self.fisheye()?, classic, &products),
            ("train_step", pinhole, classic, &step),
        ];
        for (case, camera, profile, loss) in cases {
            let view = View::new(camera, self.pose("viewmat")?.inverse());
            let mut theirs = self.case(case)?;
            let ours = self.reference(view, &profile, loss, true)?;
            let mut add = |backend, against, ours: &Groups, theirs: &Groups, most_error| {
                let groups = group_errors(ours, theirs);
                rows.push(Row::new(case, backend, against, groups, most_error));
            };
            add("reference", "vectors", &ours, &theirs, MOST_REFERENCE_ERROR);
            // Their fisheye blends in the order of z, and ours in that of distances: an image of
            // its own, which the reference has, too.
            let mut against = "vectors";
            if camera.depth_is_distance() {
                theirs = self.reference(view, &profile, loss, false)?;
                against = "reference";
            }
            for backend in backends {
                let ours = self.backend(*backend, view, &profile, loss)?;
                add(backend.name(), against, &ours, &theirs, MOST_ERROR);
            }
        }
        rows.push(self.splat_row()?);
        rows.extend(self.rig_rows(backends)?);
        Ok(rows)
    }

    /// Compares the derivatives by splats, which the reference alone has: by their centres, inverse
    /// covariances, opacities, colours and depths.
    fn splat_row(&self) -> Result<Row, VectorError> {
        let view = View::new(self.pinhole()?, self.pose("viewmat")?.inverse());
        let profile = RenderProfile::DEFAULT;
        let gaussians = self.sources()?;
        let sources = Sources { profile: &profile, gaussians, views: vec![view], depth_is_z: true };
        let decisions = sources.decisions();
        let loss = ImageLoss::Products(self.products()?).at(&sources.images(&decisions));
        let splats = sources.splat_gradients(&decisions, &loss.by);
        let mut groups = Vec::new();
        let mut add = |group, name: &str, values: usize, of: fn(&SplatGradient) -> Vec<f64>| {
            let theirs = self.values(&format!("raster.d.{name}"), values * COUNT)?;
            let ours: Vec<f64> = splats.iter().flat_map(of).collect();
            groups.push(GroupError::new(group, &ours, &theirs, 0.0));
            Ok(())
        };
        add("ln scale", "conic", 3, |splat| splat.conic.to_array().to_vec())?;
        add("opacity", "opacity", 1, |splat| vec![splat.opacity])?;
        add("sh", "rgb", 3, |splat| splat.rgb.to_array().to_vec())?;
        add("depth", "depth", 1, |splat| vec![splat.depth_m])?;
        // The centres lie column by column in the file.
        let by_columns = self.values("raster.d.mean_px", 2 * COUNT)?;
        let theirs: Vec<f64> =
            (0..COUNT).flat_map(|i| [by_columns[i], by_columns[COUNT + i]]).collect();
        let ours: Vec<f64> = splats.iter().flat_map(|splat| splat.mean_px.to_array()).collect();
        groups.push(GroupError::new("mean", &ours, &theirs, 0.0));
        Ok(Row::new("raster", "reference", "vectors", groups, MOST_REFERENCE_ERROR))
    }

    /// Compares the derivatives by the poses of a rig: two keyframes of two cameras.
    fn rig_rows(&self, backends: &[&dyn Differentiate]) -> Result<Vec<Row>, CheckError> {
        // The first pose is that of `viewmat`: rig.ego0 lies column by column in the file.
        let egos = [self.pose("viewmat")?.inverse(), self.pose("rig.ego1")?];
        let cameras = [self.pose("rig.rig0")?, self.pose("rig.rig1")?];
        let by_egos = self.values("rig.d.ego", 12)?;
        let by_cameras = self.values("rig.d.rig", 12)?;
        let value = self.values("rig.loss", 1)?;
        let products = self.products()?;
        let reference: &dyn Differentiate = &Reference;
        let mut rows = Vec::new();
        for backend in [reference].into_iter().chain(backends.iter().copied()) {
            let mut ours = [[0.0; 12]; 2];
            let mut our_value = 0.0;
            for (time, ego) in egos.iter().enumerate() {
                for (number, camera) in cameras.iter().enumerate() {
                    // A weight of its own for each of the four images, so that none passes for
                    // another.
                    let weight = (1 + time + 2 * number) as f64;
                    let loss = ImageLoss::Products(products.colors_alone(weight));
                    let view = View::new(self.pinhole()?, *ego * *camera);
                    let profile = RenderProfile::DEFAULT;
                    let (gradients, at) = self.gradients(backend, view, &profile, &loss)?;
                    our_value += at.value;
                    let twist = gradients.twists.first().copied().unwrap_or_default();
                    let RigTwists { ego, camera } = twist.on_rig(camera);
                    for (sums, index, twist) in [(0, time, ego), (1, number, camera)] {
                        for (sum, value) in ours[sums][6 * index..].iter_mut().zip(twist.to_array())
                        {
                            *sum += value;
                        }
                    }
                }
            }
            let most_error =
                if backend.name() == "reference" { MOST_REFERENCE_ERROR } else { MOST_ERROR };
            for (case, ours, theirs) in
                [("rig: egos", &ours[0], &by_egos), ("rig: cameras", &ours[1], &by_cameras)]
            {
                let twist = GroupError::new("twist", ours, theirs, 0.0);
                let loss = GroupError::new("loss", &[our_value], &value, 0.0);
                rows.push(Row::new(case, backend.name(), "vectors", vec![twist, loss], most_error));
            }
        }
        Ok(rows)
    }

    /// The derivatives of the reference, by its own f64 parameters.
    fn reference(
        &self,
        view: View,
        profile: &RenderProfile,
        loss: &ImageLoss,
        depth_is_z: bool,
    ) -> Result<Groups, VectorError> {
        let gaussians = self.sources()?;
        let sources = Sources { profile, gaussians, views: vec![view], depth_is_z };
        let decisions = sources.decisions();
        let at = loss.at(&sources.images(&decisions));
        let (gradients, twist) = sources.gradients(&sources.splat_gradients(&decisions, &at.by));
        let one = |(source, by): (&Source, &SourceGradient)| {
            let sh = by.sh.iter().flat_map(|c| c.to_array()).collect();
            (source.gaussian, by.geometry, sh)
        };
        Ok(groups(sources.gaussians.iter().zip(&gradients).map(one), twist, &at))
    }

    /// The derivatives of a backend, by parameters that are rounded to f32.
    fn backend(
        &self,
        backend: &dyn Differentiate,
        view: View,
        profile: &RenderProfile,
        loss: &ImageLoss,
    ) -> Result<Groups, CheckError> {
        let (gradients, at) = self.gradients(backend, view, profile, loss)?;
        let twist = gradients.twists.first().copied().unwrap_or_default();
        let sources = self.sources()?;
        let one = |(index, source): (usize, &Source)| {
            let by = &gradients.chunks[0];
            let value = |k| f64::from(by.value(index, column::SH + k));
            (source.gaussian, by.gaussian(index), (0..48).map(value).collect())
        };
        Ok(groups(sources.iter().enumerate().map(one), twist, &at))
    }

    /// The gradients of a backend, and the loss of its image. The scene is one chunk, in the order
    /// of the vectors.
    fn gradients(
        &self,
        backend: &dyn Differentiate,
        view: View,
        profile: &RenderProfile,
        loss: &ImageLoss,
    ) -> Result<(Gradients, LossAt), CheckError> {
        let logits = self.values("in.logits", COUNT)?;
        let mut chunk = Chunk::new([0, 0], DVec3::ZERO, 3, COUNT);
        for (Source { gaussian, .. }, logit) in self.sources()?.iter().zip(logits) {
            let DQuat { x, y, z, w } = gaussian.rotation;
            let sh: Vec<f32> = gaussian.sh.iter().flat_map(|c| c.as_vec3().to_array()).collect();
            chunk.push(&RawGaussian {
                mean_m: gaussian.mean_m.as_vec3().to_array(),
                quat_wxyz: [w, x, y, z].map(|q| q as f32),
                ln_scale: gaussian.scale_m.to_array().map(|s| s.ln() as f32),
                logit_opacity: logit as f32,
                sh: &sh,
            });
        }
        let scene = Scene { chunks: vec![Arc::new(chunk)], ..Scene::default() };
        let frame = Frame { scene: &scene, profile, views: &[view] };
        let mut gradients = Gradients::default();
        let mut at = LossAt::default();
        let mut differentiate = |images: &[GaussianImages]| {
            let mut of_view = |images| {
                at = loss.at(&Images::from_gaussian_images(images));
                at.by.to_gaussian_images(true)
            };
            images.iter().map(&mut of_view).collect()
        };
        backend.differentiate(&frame, true, &mut differentiate, &mut gradients)?;
        Ok((gradients, at))
    }
}

/// Derivatives by parameters before their activation.
struct RawGradient {
    quat_wxyz: [f64; 4],
    logit: f64,
}

impl RawGradient {
    fn new(gaussian: &Gaussian, quat_wxyz: [f64; 4], log2_opacity: f64) -> Self {
        let opacity = gaussian.log2_opacity.exp2();
        let length = gaussian.rotation.length();
        Self {
            // A quaternion is normalised, and a longer one turns less by the same step.
            quat_wxyz: quat_wxyz.map(|value| value / length),
            // The derivative of log2 o by the logit is (1 - o)/ln 2.
            logit: log2_opacity * (1.0 - opacity) / std::f64::consts::LN_2,
        }
    }
}

/// The derivatives by Gaussians and twist, and those of the loss itself.
fn groups(
    gaussians: impl Iterator<Item = (Gaussian, GaussianGradient, Vec<f64>)>,
    twist: Twist,
    loss: &LossAt,
) -> Groups {
    let [mut mean, mut ln_scale, mut quat, mut opacity, mut all_sh]: [Vec<f64>; 5] =
        Default::default();
    for (gaussian, geometry, sh) in gaussians {
        let raw = RawGradient::new(&gaussian, geometry.quat_wxyz, geometry.log2_opacity);
        mean.extend(geometry.mean_m);
        ln_scale.extend(geometry.ln_scale);
        quat.extend(raw.quat_wxyz);
        opacity.push(raw.logit);
        all_sh.extend(sh);
    }
    vec![
        ("mean", mean),
        ("ln scale", ln_scale),
        ("quat", quat),
        ("opacity", opacity),
        ("sh", all_sh),
        ("twist", twist.to_array().to_vec()),
        ("background", loss.by_background.to_vec()),
        ("loss", vec![loss.value]),
    ]
}

fn group_errors(ours: &Groups, theirs: &Groups) -> Vec<GroupError> {
    let mut errors = Vec::with_capacity(ours.len());
    for ((name, ours), (_, theirs)) in ours.iter().zip(theirs) {
        errors.push(GroupError::new(name, ours, theirs, 0.0));
    }
    errors
}
