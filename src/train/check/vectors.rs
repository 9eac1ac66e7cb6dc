//! Gradients that others computed: PyTorch's, over gsplat's own projection, in f64.

use std::sync::Arc;

use glam::{DMat3, DQuat, DVec3};
use safetensors::{Dtype, SafeTensors};
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
use wildcity_scene::geometry::camera::{Fisheye, Lens, Pinhole};
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::{Chunk, RenderProfile, Scene};

use super::{CheckError, MOST_ERROR, Row};
use crate::compose::{Background, Exposure, compose, compose_gradient};
use crate::loss::{disparity, dssim, l1};

/// The tensors of `gradients/vectors.safetensors`.
#[derive(Debug)]
pub struct Vectors {
    bytes: Vec<u8>,
}

/// Why vectors cannot be compared with.
#[derive(Debug, thiserror::Error)]
pub enum VectorError {
    /// It is no file of safetensors.
    #[error("not a whole safetensors file: {0}; make_vectors.py writes it")]
    File(String),
    /// A tensor that is missing, or of another type or size.
    #[error("the tensor {tensor} is missing, or not {wanted} floats; make_vectors.py writes it")]
    Tensor { tensor: String, wanted: usize },
}

/// Largest error of the reference: it linearises the camera by differences, to 1e-10.
const MOST_REFERENCE_ERROR: f64 = 1e-5;

const SIZE_PX: [u32; 2] = [64, 48];
const PIXELS: usize = 64 * 48;
const COUNT: usize = 100;

/// The parameters by which there are derivatives, and the values of each Gaussian.
const GROUPS: [(&str, usize); 5] =
    [("means", 3), ("log_scales", 3), ("quats", 4), ("logits", 1), ("sh", 48)];

impl Vectors {
    /// The vectors of a file that has been read.
    ///
    /// # Errors
    /// It is no file of safetensors, or it is cut off.
    pub fn new(bytes: Vec<u8>) -> Result<Self, VectorError> {
        match SafeTensors::deserialize(&bytes) {
            Ok(_) => Ok(Self { bytes }),
            Err(error) => Err(VectorError::File(error.to_string())),
        }
    }

    /// Compares the reference and some backends with all cases.
    pub(super) fn rows(&self, backends: &[&dyn Differentiate]) -> Result<Vec<Row>, CheckError> {
        let mut rows = Vec::new();
        let classic = RenderProfile::DEFAULT;
        let antialiased = RenderProfile { antialiased: true, ..classic };
        let pinhole = self.pinhole()?;
        let products = self.products()?;
        let products = |_: &Images| products.clone();
        let step = self.training_step()?;
        let step = |images: &Images| step.derivatives(images);
        let cases: [(&str, Camera, RenderProfile, &ImageLoss<'_>); 4] = [
            ("classic", pinhole, classic, &products),
            ("antialiased", pinhole, antialiased, &products),
            ("fisheye_unscented", self.fisheye()?, classic, &products),
            ("train_step", pinhole, classic, &step),
        ];
        for (case, camera, profile, loss) in cases {
            let view = View::new(camera, self.pose("viewmat")?.inverse());
            let theirs = self.derivatives(case)?;
            let mut add = |backend, ours: &[Vec<f64>], most_error| {
                let groups = group_errors(ours, &theirs);
                rows.push(Row::new(case, backend, "vectors", groups, most_error));
            };
            add("reference", &self.reference(view, &profile, loss)?, MOST_REFERENCE_ERROR);
            // Their fisheye has z as its depth, which only the reference can have, too.
            if camera.depth_is_distance() {
                continue;
            }
            for backend in backends {
                let ours = self.backend(*backend, view, &profile, loss)?;
                add(backend.name(), &ours, MOST_ERROR);
            }
        }
        rows.push(self.splat_row()?);
        rows.extend(self.rig_rows(backends)?);
        Ok(rows)
    }

    /// Compares the derivatives by splats, which the reference alone has: by their centres, inverse
    /// covariances, opacities and colours.
    fn splat_row(&self) -> Result<Row, VectorError> {
        let view = View::new(self.pinhole()?, self.pose("viewmat")?.inverse());
        let profile = RenderProfile::DEFAULT;
        let gaussians = self.sources()?;
        let sources = Sources { profile: &profile, gaussians, views: vec![view], depth_is_z: true };
        let splats = sources.splat_gradients(&sources.decisions(), &self.products()?);
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
        let products = self.products()?;
        let rgb: Vec<DVec3> = self.points("v.rgb", PIXELS)?;
        let background = DVec3::from_slice(&self.values("background", 3)?);
        let reference: &dyn Differentiate = &Reference;
        let mut rows = Vec::new();
        for backend in [reference].into_iter().chain(backends.iter().copied()) {
            let mut ours = [[0.0; 12]; 2];
            for (time, ego) in egos.iter().enumerate() {
                for (number, camera) in cameras.iter().enumerate() {
                    let weight = (1 + time + 2 * number) as f64;
                    let by = Images {
                        rgb: rgb.iter().map(|rgb| weight * *rgb).collect(),
                        opacity: rgb.iter().map(|rgb| -weight * rgb.dot(background)).collect(),
                        depth_sum_m: vec![0.0; products.depth_sum_m.len()],
                    };
                    let view = View::new(self.pinhole()?, *ego * *camera);
                    let gradients =
                        self.gradients(backend, view, &RenderProfile::DEFAULT, &|_| by.clone())?;
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
                let group = GroupError::new("twist", ours, theirs, 0.0);
                rows.push(Row::new(case, backend.name(), "vectors", vec![group], most_error));
            }
        }
        Ok(rows)
    }

    fn values(&self, name: &str, wanted: usize) -> Result<Vec<f64>, VectorError> {
        let values = self.floats(name).filter(|values| values.len() == wanted);
        values.ok_or_else(|| VectorError::Tensor { tensor: name.to_owned(), wanted })
    }

    /// The values of a tensor of floats.
    fn floats(&self, name: &str) -> Option<Vec<f64>> {
        let tensors = SafeTensors::deserialize(&self.bytes).ok()?;
        let tensor = tensors.tensor(name).ok()?;
        match tensor.dtype() {
            Dtype::F64 => {
                let values = tensor.data().as_chunks().0.iter();
                Some(values.map(|&bytes| f64::from_le_bytes(bytes)).collect())
            }
            Dtype::F32 => {
                let values = tensor.data().as_chunks().0.iter();
                Some(values.map(|&bytes| f64::from(f32::from_le_bytes(bytes))).collect())
            }
            _ => None,
        }
    }

    fn points(&self, name: &str, wanted: usize) -> Result<Vec<DVec3>, VectorError> {
        let values = self.values(name, 3 * wanted)?;
        Ok(values.as_chunks().0.iter().map(|&values| DVec3::from_array(values)).collect())
    }

    fn pose(&self, name: &str) -> Result<Pose, VectorError> {
        let rows = self.values(name, 16)?;
        // Row by row, and glam has columns.
        let matrix = DMat3::from_cols_slice(&[0, 4, 8, 1, 5, 9, 2, 6, 10].map(|k| rows[k]));
        let position_m = DVec3::new(rows[3], rows[7], rows[11]);
        Ok(Pose { position_m, rotation: DQuat::from_mat3(&matrix).normalize() })
    }

    fn pinhole(&self) -> Result<Camera, VectorError> {
        let k = self.values("K", 9)?;
        let pinhole = Pinhole { fx: k[0], fy: k[4], cx: k[2], cy: k[5] };
        Ok(Camera::from_pinhole(SIZE_PX[0], SIZE_PX[1], pinhole))
    }

    fn fisheye(&self) -> Result<Camera, VectorError> {
        let c = self.values("fisheye.camera", 8)?;
        let pinhole = Pinhole { fx: c[0], fy: c[1], cx: c[2], cy: c[3] };
        let lens = Lens::Fisheye(Fisheye::new([c[4], c[5], c[6], c[7]], None));
        Ok(Camera { lens, ..Camera::from_pinhole(SIZE_PX[0], SIZE_PX[1], pinhole) })
    }

    /// The derivatives of `v.rgb · rgb + v.alpha · alpha + v.depth · depth` by the Gaussians'
    /// images, where the colours are over the background.
    fn products(&self) -> Result<Images, VectorError> {
        let background = DVec3::from_slice(&self.values("background", 3)?);
        let rgb = self.points("v.rgb", PIXELS)?;
        let mut opacity = self.values("v.alpha", PIXELS)?;
        for (opacity, rgb) in opacity.iter_mut().zip(&rgb) {
            *opacity -= rgb.dot(background);
        }
        Ok(Images { rgb, opacity, depth_sum_m: self.values("v.depth", PIXELS)? })
    }

    fn training_step(&self) -> Result<TrainingStep, VectorError> {
        let background = self.values("background", 3)?;
        Ok(TrainingStep {
            background: [background[0], background[1], background[2]],
            target: self.values("target", 3 * PIXELS)?,
            depth_target_m: self.values("depth_target", PIXELS)?,
        })
    }

    /// The derivatives of a case: [`GROUPS`], and the twist.
    fn derivatives(&self, case: &str) -> Result<Vec<Vec<f64>>, VectorError> {
        let mut all = Vec::new();
        for (group, values) in GROUPS {
            all.push(self.values(&format!("{case}.d.{group}"), values * COUNT)?);
        }
        all.push(self.values(&format!("{case}.d.twist"), 6)?);
        Ok(all)
    }

    fn sources(&self) -> Result<Vec<Source>, VectorError> {
        let quats = self.values("in.quats", 4 * COUNT)?;
        let scales = self.points("in.log_scales", COUNT)?;
        let logits = self.values("in.logits", COUNT)?;
        let sh = self.points("in.sh", 16 * COUNT)?;
        let source = |(i, &mean_m): (usize, &DVec3)| {
            let [w, x, y, z] = [0, 1, 2, 3].map(|k| quats[4 * i + k]);
            let gaussian = Gaussian {
                mean_m,
                rotation: DQuat::from_xyzw(x, y, z, w),
                scale_m: scales[i].exp(),
                log2_opacity: -(1.0 + (-logits[i]).exp()).log2(),
                sh: std::array::from_fn(|k| sh[16 * i + k]),
            };
            Source { gaussian, view: 0, tint: DVec3::ONE }
        };
        Ok(self.points("in.means", COUNT)?.iter().enumerate().map(source).collect())
    }

    /// The derivatives of the reference, by its own f64 parameters.
    fn reference(
        &self,
        view: View,
        profile: &RenderProfile,
        loss: &ImageLoss<'_>,
    ) -> Result<Vec<Vec<f64>>, VectorError> {
        let gaussians = self.sources()?;
        let sources = Sources { profile, gaussians, views: vec![view], depth_is_z: true };
        let decisions = sources.decisions();
        let by = loss(&sources.images(&decisions));
        let (gradients, twist) = sources.gradients(&sources.splat_gradients(&decisions, &by));
        let one = |(source, by): (&Source, &SourceGradient)| {
            let sh = by.sh.iter().flat_map(|c| c.to_array()).collect();
            (source.gaussian, by.geometry, sh)
        };
        Ok(flattened(sources.gaussians.iter().zip(&gradients).map(one), twist))
    }

    /// The derivatives of a backend, by parameters that are rounded to f32.
    fn backend(
        &self,
        backend: &dyn Differentiate,
        view: View,
        profile: &RenderProfile,
        loss: &ImageLoss<'_>,
    ) -> Result<Vec<Vec<f64>>, CheckError> {
        let gradients = self.gradients(backend, view, profile, loss)?;
        let twist = gradients.twists.first().copied().unwrap_or_default();
        let sources = self.sources()?;
        let one = |(index, source): (usize, &Source)| {
            let by = &gradients.chunks[0];
            let value = |k| f64::from(by.value(index, column::SH + k));
            (source.gaussian, by.gaussian(index), (0..48).map(value).collect())
        };
        Ok(flattened(sources.iter().enumerate().map(one), twist))
    }

    /// The gradients of a backend. The scene is one chunk, in the order of the vectors.
    fn gradients(
        &self,
        backend: &dyn Differentiate,
        view: View,
        profile: &RenderProfile,
        loss: &ImageLoss<'_>,
    ) -> Result<Gradients, CheckError> {
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
        let mut loss = |images: &[GaussianImages]| {
            let derivatives =
                |images| loss(&Images::from_gaussian_images(images)).to_gaussian_images(true);
            images.iter().map(derivatives).collect()
        };
        backend.differentiate(&frame, true, &mut loss, &mut gradients)?;
        Ok(gradients)
    }
}

/// The derivatives of a loss by images, given these.
type ImageLoss<'a> = dyn Fn(&Images) -> Images + Sync + 'a;

/// The losses of a step: `0.8 L1 + 0.2 D-SSIM` of colours over a background, and
/// 0.1 of disparity.
struct TrainingStep {
    background: [f64; 3],
    target: Vec<f64>,
    depth_target_m: Vec<f64>,
}

impl TrainingStep {
    fn derivatives(&self, images: &Images) -> Images {
        let rgb: Vec<f64> = images.rgb.iter().flat_map(|rgb| rgb.to_array()).collect();
        let background = Background::Color(self.background);
        let exposure = Exposure::identity();
        let image = compose(&rgb, &images.opacity, background, &exposure);
        let similarity = dssim(SIZE_PX.map(|px| px as usize), &image, &self.target).scaled(0.2);
        let by_image = l1(&image, &self.target, None).scaled(0.8).plus(&similarity).by;
        let by = compose_gradient(&rgb, &images.opacity, background, &exposure, &by_image);
        let depth =
            disparity(&images.opacity, &images.depth_sum_m, &self.depth_target_m).scaled(0.1);
        let sums = by.opacity.iter().zip(&depth.by_opacity).map(|(a, b)| a + b);
        Images {
            rgb: by.rgb.as_chunks().0.iter().map(|&rgb| DVec3::from_array(rgb)).collect(),
            opacity: sums.collect(),
            depth_sum_m: depth.by_depth_sum,
        }
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
            quat_wxyz: quat_wxyz.map(|value| value / length),
            logit: log2_opacity * (1.0 - opacity) / std::f64::consts::LN_2,
        }
    }
}

/// Derivatives in the order of [`GROUPS`], and by the twist.
fn flattened(
    gaussians: impl Iterator<Item = (Gaussian, GaussianGradient, Vec<f64>)>,
    twist: Twist,
) -> Vec<Vec<f64>> {
    let mut groups = vec![Vec::new(); GROUPS.len()];
    for (gaussian, geometry, sh) in gaussians {
        let raw = RawGradient::new(&gaussian, geometry.quat_wxyz, geometry.log2_opacity);
        groups[0].extend(geometry.mean_m);
        groups[1].extend(geometry.ln_scale);
        groups[2].extend(raw.quat_wxyz);
        groups[3].push(raw.logit);
        groups[4].extend(sh);
    }
    groups.push(twist.to_array().to_vec());
    groups
}

fn group_errors(ours: &[Vec<f64>], theirs: &[Vec<f64>]) -> Vec<GroupError> {
    let names = ["mean", "ln scale", "quat", "opacity", "sh", "twist"];
    let mut errors = Vec::new();
    for (name, (ours, theirs)) in names.into_iter().zip(ours.iter().zip(theirs)) {
        errors.push(GroupError::new(name, ours, theirs, 0.0));
    }
    errors
}
