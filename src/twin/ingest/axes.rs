//! Converts from the axes and unit of a file to a twin's: metres, x east, y north, z up.
//!
//! Hardly any file says what its axes are (two PLY files may differ), so an import has options for
//! them. An SPZ file may say it in an extension, and its specification says it for the others.

use std::str::FromStr;

use glam::{DMat3, DQuat, DVec3};

use wildcity_scene::align::Alignment;
use wildcity_scene::geometry::Pose;
use wildcity_scene::{Gaussians, sh};

use super::IngestError;

/// The transform from a file to a twin: a rotation, perhaps with a reflection, and then a scale.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Axes {
    twin_from_file: DMat3,
    metres_per_unit: f64,
}

/// Name, description, and the twin's x, y, z axes in the file's axes, which are the rows of
/// `twin_from_file`.
const PRESETS: [(&str, &str, [[f64; 3]; 3]); 4] = [
    ("identity", "x, y, z stay; z is up", [[1., 0., 0.], [0., 1., 0.], [0., 0., 1.]]),
    (
        "y-down-z-forward",
        "OpenCV, COLMAP: x right to east, z forward to north, y down",
        [[1., 0., 0.], [0., 0., 1.], [0., -1., 0.]],
    ),
    (
        "y-up-z-back",
        "OpenGL, SPZ: x right to east, -z forward to north, y up",
        [[1., 0., 0.], [0., 0., -1.], [0., 1., 0.]],
    ),
    (
        "y-up-z-forward",
        "Unity: x right to east, z forward to north, y up; left-handed, so mirrored",
        [[1., 0., 0.], [0., 0., 1.], [0., 1., 0.]],
    ),
];

impl Axes {
    /// The file has a twin's axes and unit.
    pub const IDENTITY: Self = Self { twin_from_file: DMat3::IDENTITY, metres_per_unit: 1.0 };

    /// Largest difference of an entry of `M Mᵀ` from the identity's: a matrix typed with four
    /// digits is accepted.
    const MAX_ERROR: f64 = 1e-3;

    /// From a matrix. Its rows are the twin's axes in the file's axes.
    ///
    /// # Errors
    /// [`IngestError::InvalidAxes`] if the rows are not orthonormal.
    pub fn from_rows(rows: [[f64; 3]; 3]) -> Result<Self, IngestError> {
        Self::orthonormal(rows).ok_or_else(|| stretched(format!("{rows:?}")))
    }

    /// `None` if the rows are not orthonormal.
    fn orthonormal(rows: [[f64; 3]; 3]) -> Option<Self> {
        // glam takes columns, and these are rows.
        let given = DMat3::from_cols_array_2d(&rows).transpose();
        let error = given * given.transpose() - DMat3::IDENTITY;
        let is_orthonormal = error.to_cols_array().iter().all(|e| e.abs() <= Self::MAX_ERROR);
        if !is_orthonormal {
            return None;
        }
        // Gram-Schmidt, so that rounding to four digits does not stretch the scene.
        let [x, y, z] = rows.map(DVec3::from_array);
        let x = x.normalize();
        let y = (y - x * x.dot(y)).normalize();
        // Its cross product is right-handed. The sign of the given z restores a reflection.
        let z_right = x.cross(y);
        let z = z_right * z_right.dot(z).signum();
        Some(Self { twin_from_file: DMat3::from_cols(x, y, z).transpose(), ..Self::IDENTITY })
    }

    /// From the directions of the file's x, y and z: of each pair right or left (R, L), up or down
    /// (U, D), forward or back (F, B), as in "RDF". Right is east, and forward is north. `None` for
    /// other letters.
    pub(super) fn from_letters(name: &str) -> Option<Self> {
        let letters: [u8; 3] = name.as_bytes().try_into().ok()?;
        let mut rows = [[0.0; 3]; 3];
        for (column, letter) in letters.into_iter().enumerate() {
            let (row, sign) = match letter {
                b'R' => (0, 1.0),
                b'L' => (0, -1.0),
                b'F' => (1, 1.0),
                b'B' => (1, -1.0),
                b'U' => (2, 1.0),
                b'D' => (2, -1.0),
                _ => return None,
            };
            rows[row][column] = sign;
        }
        // A direction that occurs twice leaves a row of zeros.
        Self::orthonormal(rows)
    }

    /// The change from these axes to those of `other`, without a change of the unit.
    pub(super) fn to(&self, other: &Self) -> Self {
        // To the twin's axes and back from them: the inverse of a rotation is its transpose.
        let twin_from_file = other.twin_from_file.transpose() * self.twin_from_file;
        Self { twin_from_file, ..Self::IDENTITY }
    }

    /// These axes, with a unit of `metres_per_unit`.
    ///
    /// # Errors
    /// [`IngestError::InvalidAxes`] if the scale is not from 1e-6 to 1e6.
    pub fn scaled(self, metres_per_unit: f64) -> Result<Self, IngestError> {
        if !(1e-6..=1e6).contains(&metres_per_unit) {
            let reason = "a scale is from 1e-6 to 1e6 metres per unit".to_owned();
            return Err(frame_error("--scale", format!("{metres_per_unit:?}"), reason));
        }
        Ok(Self { metres_per_unit, ..self })
    }

    /// Rotates directions in the twin to the file's axes; orthonormal.
    pub fn file_from_twin(&self) -> DMat3 {
        self.twin_from_file.transpose()
    }

    /// This change of axes and unit for poses; `None` for axes with a reflection, in which no
    /// camera has a pose.
    pub fn alignment(&self) -> Option<Alignment> {
        let is_mirrored = self.twin_from_file.determinant() < 0.0;
        // Without a reflection the matrix is a rotation; with one the value is not used.
        let rotation = DQuat::from_mat3(&self.twin_from_file).normalize();
        let new_from_old = Pose { rotation, ..Pose::IDENTITY };
        let metres_per_unit = self.metres_per_unit;
        (!is_mirrored).then_some(Alignment { new_from_old, metres_per_unit })
    }

    /// The rotation as `--axes` takes it: the name of a preset, or nine numbers.
    pub fn option_text(&self) -> String {
        let rows = self.twin_from_file.transpose().to_cols_array_2d();
        match PRESETS.iter().find(|(.., preset)| *preset == rows) {
            Some((name, ..)) => (*name).to_owned(),
            // Adding 0 makes a plain zero of a negative one.
            None => rows
                .as_flattened()
                .iter()
                .map(|n| (n + 0.0).to_string())
                .collect::<Vec<_>>()
                .join(" "),
        }
    }

    /// Whether the rotation is that of other axes, whatever the unit.
    pub fn has_same_rotation(&self, other: &Self) -> bool {
        let off = self.twin_from_file - other.twin_from_file;
        off.to_cols_array().iter().all(|e| e.abs() <= Self::MAX_ERROR)
    }

    /// Rotates and then scales Gaussians in place. The identity changes no bit.
    ///
    /// A reflection `M` moves each ellipsoid as the rotation `-M` does, because an ellipsoid equals
    /// its own point reflection through its centre. The colours follow `M` itself.
    pub fn apply(&self, gaussians: &mut Gaussians) {
        if self.twin_from_file != DMat3::IDENTITY {
            self.rotate(gaussians);
        }
        gaussians.scale(self.metres_per_unit);
    }

    fn rotate(&self, gaussians: &mut Gaussians) {
        let matrix = self.twin_from_file;
        for mean in &mut gaussians.means_m {
            *mean = (matrix * DVec3::from_array(*mean)).to_array();
        }
        // See `apply`: the negative of a reflection in three dimensions is a rotation.
        let rotation = DQuat::from_mat3(&if matrix.determinant() < 0.0 { -matrix } else { matrix });
        for quat in &mut gaussians.quats_wxyz {
            let [w, x, y, z] = quat.map(f64::from);
            let turned = rotation * DQuat::from_xyzw(x, y, z, w);
            *quat = [turned.w, turned.x, turned.y, turned.z].map(|q| q as f32);
        }
        // The negative of the matrix would change the sign of SH of odd degree, so the colours need
        // the matrix itself.
        let turn = sh::ShRotation::new(matrix, gaussians.sh_degree);
        for colour in gaussians.sh.chunks_exact_mut(3 * sh::coefficients(gaussians.sh_degree)) {
            turn.apply(colour);
        }
        // A rotation mixes the coefficients of a degree, and may carry one over its bound.
        gaussians.clamp_coefficients();
    }
}

impl FromStr for Axes {
    type Err = IngestError;

    /// Parses the name of a preset, or the nine numbers of the matrix, row by row, separated by
    /// commas or spaces.
    fn from_str(text: &str) -> Result<Self, IngestError> {
        // Presets are orthonormal, so that this never fails.
        if let Some((_, _, rows)) = PRESETS.iter().find(|(name, ..)| *name == text) {
            return Self::from_rows(*rows);
        }
        let words = text.split([',', ' ']).filter(|word| !word.is_empty());
        let numbers: Result<Vec<f64>, _> = words.map(str::parse).collect();
        match numbers.as_deref() {
            Ok(&[a, b, c, d, e, f, g, h, i]) => {
                Self::orthonormal([[a, b, c], [d, e, f], [g, h, i]])
                    .ok_or_else(|| stretched(text.to_owned()))
            }
            _ => {
                let presets: Vec<_> =
                    PRESETS.iter().map(|(name, what, _)| format!("{name} ({what})")).collect();
                let presets = presets.join("; ");
                let reason = format!("expected nine numbers, row by row, or one of {presets}");
                Err(frame_error("--axes", text.to_owned(), reason))
            }
        }
    }
}

fn stretched(given: String) -> IngestError {
    let reason = "the rows of the matrix must have length 1 and be at right angles; give the scale \
                  with --scale";
    frame_error("--axes", given, reason.into())
}

fn frame_error(option: &'static str, given: String, reason: String) -> IngestError {
    IngestError::InvalidAxes { option, given, reason }
}
