//! The tensors of `gradients/vectors.safetensors`.

use glam::{DMat3, DQuat, DVec3};
use safetensors::{Dtype, SafeTensors};
use wildcity_render::reference::Gaussian;
use wildcity_render::reference::gradient::Source;
use wildcity_scene::geometry::camera::{Fisheye, Lens, Pinhole};
use wildcity_scene::geometry::{Camera, Pose};

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

pub(super) const SIZE_PX: [u32; 2] = [64, 48];
pub(super) const PIXELS: usize = 64 * 48;
/// Number of Gaussians in the vectors.
pub(super) const COUNT: usize = 100;

/// Derivatives by groups of parameters.
pub(super) type Groups = Vec<(&'static str, Vec<f64>)>;

/// The groups of a case with their tensors and sizes; the last is the value of the loss.
const TENSORS: [(&str, &str, usize); 8] = [
    ("mean", "d.means", 3 * COUNT),
    ("ln scale", "d.log_scales", 3 * COUNT),
    ("quat", "d.quats", 4 * COUNT),
    ("opacity", "d.logits", COUNT),
    // 16 coefficients of three channels.
    ("sh", "d.sh", 48 * COUNT),
    ("twist", "d.twist", 6),
    ("background", "d.background", 3),
    ("loss", "loss", 1),
];

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

    /// The derivatives of a case by every group of parameters, and the value of its loss.
    pub(super) fn case(&self, case: &str) -> Result<Groups, VectorError> {
        let mut groups = Vec::new();
        for (group, tensor, values) in TENSORS {
            groups.push((group, self.values(&format!("{case}.{tensor}"), values)?));
        }
        Ok(groups)
    }

    pub(super) fn values(&self, name: &str, wanted: usize) -> Result<Vec<f64>, VectorError> {
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

    pub(super) fn pose(&self, name: &str) -> Result<Pose, VectorError> {
        let rows = self.values(name, 16)?;
        // Row by row, and glam has columns.
        let matrix = DMat3::from_cols_slice(&[0, 4, 8, 1, 5, 9, 2, 6, 10].map(|k| rows[k]));
        let position_m = DVec3::new(rows[3], rows[7], rows[11]);
        Ok(Pose { position_m, rotation: DQuat::from_mat3(&matrix).normalize() })
    }

    pub(super) fn pinhole(&self) -> Result<Camera, VectorError> {
        let k = self.values("K", 9)?;
        // The matrix row by row: fx 0 cx, 0 fy cy, 0 0 1.
        let pinhole = Pinhole { fx: k[0], fy: k[4], cx: k[2], cy: k[5] };
        Ok(Camera::from_pinhole(SIZE_PX[0], SIZE_PX[1], pinhole))
    }

    pub(super) fn fisheye(&self) -> Result<Camera, VectorError> {
        let c = self.values("fisheye.camera", 8)?;
        let pinhole = Pinhole { fx: c[0], fy: c[1], cx: c[2], cy: c[3] };
        let lens = Lens::Fisheye(Fisheye::new([c[4], c[5], c[6], c[7]], None));
        Ok(Camera { lens, ..Camera::from_pinhole(SIZE_PX[0], SIZE_PX[1], pinhole) })
    }

    pub(super) fn sources(&self) -> Result<Vec<Source>, VectorError> {
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
                // The base-2 logarithm of the sigmoid 1/(1 + exp(-x)) of a logit.
                log2_opacity: -(1.0 + (-logits[i]).exp()).log2(),
                sh: std::array::from_fn(|k| sh[16 * i + k]),
            };
            Source { gaussian, view: 0, tint: DVec3::ONE }
        };
        Ok(self.points("in.means", COUNT)?.iter().enumerate().map(source).collect())
    }
}
