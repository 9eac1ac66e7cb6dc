//! Gradients that others computed: PyTorch's, over gsplat's own projection, in f64.

use glam::{DMat3, DQuat, DVec3};
use safetensors::{Dtype, SafeTensors};
use wildcity_render::compare::gradients::GroupError;
use wildcity_render::gradient::{Differentiate, GaussianImages, Gradients, Twist};
use wildcity_render::reference::Gaussian;
use wildcity_render::reference::gradient::{Images, Source, SourceGradient, Sources};
use wildcity_render::{Frame, View};
use wildcity_scene::chunk::column;
use wildcity_scene::geometry::camera::{Fisheye, Lens, Pinhole};
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::{Gaussians, RenderProfile, Scene};

use super::{CheckError, MOST_ERROR, Row};

/// The tensors of `gradients/vectors.safetensors`.
#[derive(Debug)]
pub struct Vectors {
    bytes: Vec<u8>,
}

/// A tensor that is missing, or of another type or size.
#[derive(Debug, thiserror::Error)]
#[error("the tensor {tensor} of the vectors is missing, or not {wanted} floats")]
pub struct VectorError {
    tensor: String,
    wanted: usize,
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
    pub fn new(bytes: Vec<u8>) -> Self {
        Self { bytes }
    }

    /// Compares the reference and some backends with all cases.
    pub(super) fn rows(&self, backends: &[&dyn Differentiate]) -> Result<Vec<Row>, CheckError> {
        let mut rows = Vec::new();
        let classic = RenderProfile::DEFAULT;
        let antialiased = RenderProfile { antialiased: true, ..classic };
        let pinhole = self.pinhole()?;
        for (case, camera, profile) in [
            ("classic", pinhole, classic),
            ("antialiased", pinhole, antialiased),
            ("fisheye_unscented", self.fisheye()?, classic),
        ] {
            let view = View::new(camera, self.pose("viewmat")?.inverse());
            let theirs = self.derivatives(case)?;
            let ours = self.reference(view, &profile)?;
            let groups = group_errors(&ours, &theirs);
            rows.push(Row::new(case, "reference", "vectors", groups, MOST_REFERENCE_ERROR));
            // Their fisheye has z as its depth, which only the reference can have, too.
            if camera.depth_is_distance() {
                continue;
            }
            for backend in backends {
                let ours = self.backend(*backend, view, &profile)?;
                let groups = group_errors(&ours, &theirs);
                rows.push(Row::new(case, backend.name(), "vectors", groups, MOST_ERROR));
            }
        }
        Ok(rows)
    }

    fn values(&self, name: &str, wanted: usize) -> Result<Vec<f64>, VectorError> {
        let values = self.floats(name).filter(|values| values.len() == wanted);
        values.ok_or_else(|| VectorError { tensor: name.to_owned(), wanted })
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
    fn loss(&self) -> Result<Images, VectorError> {
        let background = DVec3::from_slice(&self.values("background", 3)?);
        let rgb = self.points("v.rgb", PIXELS)?;
        let mut opacity = self.values("v.alpha", PIXELS)?;
        for (opacity, rgb) in opacity.iter_mut().zip(&rgb) {
            *opacity -= rgb.dot(background);
        }
        Ok(Images { rgb, opacity, depth_sum_m: self.values("v.depth", PIXELS)? })
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
    fn reference(&self, view: View, profile: &RenderProfile) -> Result<Vec<Vec<f64>>, VectorError> {
        let gaussians = self.sources()?;
        let sources = Sources { profile, gaussians, views: vec![view], depth_is_z: true };
        let by_splats = sources.splat_gradients(&sources.decisions(), &self.loss()?);
        let (gradients, twist) = sources.gradients(&by_splats);
        let one = |(source, by): (&Source, &SourceGradient)| {
            let geometry = by.geometry;
            let raw = RawGradient::new(&source.gaussian, geometry.quat_wxyz, geometry.log2_opacity);
            (
                geometry.mean_m,
                geometry.ln_scale,
                raw,
                by.sh.iter().flat_map(|c| c.to_array()).collect(),
            )
        };
        Ok(flattened(sources.gaussians.iter().zip(&gradients).map(one), twist))
    }

    /// The derivatives of a backend, by parameters that are rounded to f32.
    fn backend(
        &self,
        backend: &dyn Differentiate,
        view: View,
        profile: &RenderProfile,
    ) -> Result<Vec<Vec<f64>>, CheckError> {
        let sources = self.sources()?;
        let mut gaussians = Gaussians::with_capacity(3, COUNT);
        let logits = self.values("in.logits", COUNT)?;
        for (Source { gaussian, .. }, logit) in sources.iter().zip(logits) {
            gaussians.means_m.push(gaussian.mean_m.to_array());
            let DQuat { x, y, z, w } = gaussian.rotation;
            gaussians.quats_wxyz.push([w, x, y, z].map(|q| q as f32));
            gaussians.ln_scales.push(gaussian.scale_m.to_array().map(|s| s.ln() as f32));
            gaussians.logit_opacities.push(logit as f32);
            gaussians.sh.extend(gaussian.sh.iter().flat_map(|c| c.as_vec3().to_array()));
        }
        let scene = Scene::from_gaussians(&gaussians);
        let Images { rgb, opacity, depth_sum_m } = self.loss()?;
        let to_f32 = |values: &[f64]| values.iter().map(|&value| value as f32).collect();
        let by = GaussianImages {
            rgb: rgb.iter().flat_map(|rgb| rgb.as_vec3().to_array()).collect(),
            opacity: to_f32(&opacity),
            depth_sum_m: to_f32(&depth_sum_m),
        };
        let mut gradients = Gradients::default();
        let frame = Frame { scene: &scene, profile, views: &[view] };
        backend.differentiate(&frame, true, &mut |_| vec![by.clone()], &mut gradients)?;

        // The chunk has the Gaussians in another order: each is found by its place.
        let mut found = vec![None; COUNT];
        for (chunk, by) in scene.chunks.iter().zip(&gradients.chunks) {
            for index in 0..chunk.len() {
                let at_m = Gaussian::from_chunk(chunk, index).mean_m;
                let distance = |i: &usize| sources[*i].gaussian.mean_m.distance(at_m);
                let nearest = (0..COUNT).min_by(|a, b| distance(a).total_cmp(&distance(b)));
                if let Some(i) = nearest {
                    let geometry = by.gaussian(index);
                    let value = |k| f64::from(by.value(index, column::SH + k));
                    let sh: Vec<f64> = (0..48).map(value).collect();
                    found[i] = Some((geometry, sh));
                }
            }
        }
        let one = |(source, found): (&Source, &Option<_>)| {
            let (geometry, sh): (wildcity_render::gradient::GaussianGradient, Vec<f64>) =
                found.clone().unwrap_or_default();
            let raw = RawGradient::new(&source.gaussian, geometry.quat_wxyz, geometry.log2_opacity);
            (geometry.mean_m, geometry.ln_scale, raw, sh)
        };
        let twist = gradients.twists.first().copied().unwrap_or_default();
        Ok(flattened(sources.iter().zip(&found).map(one), twist))
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
    gaussians: impl Iterator<Item = ([f64; 3], [f64; 3], RawGradient, Vec<f64>)>,
    twist: Twist,
) -> Vec<Vec<f64>> {
    let mut groups = vec![Vec::new(); GROUPS.len()];
    for (mean_m, ln_scale, raw, sh) in gaussians {
        groups[0].extend(mean_m);
        groups[1].extend(ln_scale);
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
