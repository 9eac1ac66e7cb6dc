//! Contents of the files of a push, and the changes that it would make, before anything is
//! committed.

use std::collections::{BTreeMap, BTreeSet};

use wildcity_scene::{Gaussians, Manifest};
use wildcity_twin::ingest::BadGaussian;

use crate::error::PushError;
use crate::frame::Frame;
use crate::limits;
use crate::preview::psnr::PsnrPreview;
use crate::request::CellSelection;

/// Contents of the files of a push.
#[derive(Clone, Debug, Default)]
pub struct PushReport {
    /// Each file that was read.
    pub files: Vec<FileReport>,
    /// Gaussians of all files.
    pub gaussians: u64,
    /// The frame in which the files were.
    pub frame: Frame,
    /// Whether the base was aligned, so that the frame of its capture differs from its own.
    pub is_aligned: bool,
    /// Gaussians that lie in none of the replaced cells.
    pub left_out: u64,
    /// Highest SH degree of the files.
    pub sh_degree: u8,
    /// Smallest and largest values; none without Gaussians.
    pub ranges: Option<Ranges>,
    /// Cells that are replaced, in order of (y, x).
    pub cells: Vec<CellChange>,
    /// PSNR between the base version and the new one, at each pose of the preview.
    pub preview: Vec<PsnrPreview>,
}

/// A cell that is replaced, and its number of Gaussians before and after.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CellChange {
    /// Grid cell (x, y).
    pub cell: [i32; 2],
    /// Gaussians in the base.
    pub before: u64,
    /// Gaussians of the push.
    pub after: u64,
}

/// One file of a push.
#[derive(Clone, Debug)]
pub struct FileReport {
    /// Name of the file.
    pub name: String,
    pub gaussians: u64,
    /// Gaussians with a number outside its bounds.
    pub bad: u64,
    /// The first of these.
    pub first_bad: Vec<BadGaussian>,
    /// Gaussians with a number outside its bounds that were left out.
    pub dropped: u64,
    /// What of the file was not read, or is drawn in another way than it says.
    pub warnings: Vec<String>,
    /// What was taken where nothing was given.
    pub assumed: Vec<String>,
}

/// Smallest and largest values of the numbers of some Gaussians.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ranges {
    /// Corners of the axis-aligned box around all centres, in metres in the twin's axes.
    pub mean_m: [[f64; 3]; 2],
    /// Standard deviations along the own axes, in metres.
    pub scale_m: [f64; 2],
    /// Opacities after the sigmoid, from 0 to 1.
    pub opacity: [f64; 2],
    /// Lengths of the quaternions, which are normalised only when they are rendered.
    pub quat_length: [f64; 2],
}

impl Ranges {
    /// The ranges of valid Gaussians; none without Gaussians.
    pub fn from_gaussians(gaussians: &Gaussians) -> Option<Self> {
        // Of no values, the smallest would be infinity.
        if gaussians.is_empty() {
            return None;
        }
        let x_m = range(gaussians.means_m.iter().map(|mean| mean[0]));
        let y_m = range(gaussians.means_m.iter().map(|mean| mean[1]));
        let z_m = range(gaussians.means_m.iter().map(|mean| mean[2]));
        let ln_scales = gaussians.ln_scales.as_flattened();
        let scales_m = ln_scales.iter().map(|&ln| f64::from(ln).exp());
        let logits = gaussians.logit_opacities.iter();
        // For a logit of -100 the exponential is 1e43, which f64 holds and f32 does not.
        let opacities = logits.map(|&logit| 1.0 / (1.0 + (-f64::from(logit)).exp()));
        let quats = gaussians.quats_wxyz.iter();
        let lengths = quats.map(|q| q.iter().map(|&q| f64::from(q).powi(2)).sum::<f64>().sqrt());
        Some(Self {
            mean_m: [[x_m[0], y_m[0], z_m[0]], [x_m[1], y_m[1], z_m[1]]],
            scale_m: range(scales_m),
            opacity: range(opacities),
            quat_length: range(lengths),
        })
    }
}

/// The smallest and the largest of some values.
fn range(values: impl Iterator<Item = f64>) -> [f64; 2] {
    // The caller has at least one value, so that neither infinity remains.
    values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], value| {
        [low.min(value), high.max(value)]
    })
}

/// The cells that a push replaces.
#[derive(Debug, PartialEq)]
pub(crate) struct CellChanges {
    /// In order of (y, x).
    pub(crate) cells: Vec<CellChange>,
    /// Gaussians of the push that lie in none of them.
    pub(crate) left_out: u64,
}

impl CellChanges {
    /// Compares the cells of a base with the number of Gaussians that a push has in each cell.
    ///
    /// # Errors
    /// [`PushError::Content`]: a cell that was named has no Gaussian, or one that was not named
    /// would lose nearly all of its Gaussians.
    pub(crate) fn new(
        selection: &CellSelection,
        base: Option<&Manifest>,
        after: &BTreeMap<[i32; 2], u64>,
    ) -> Result<Self, PushError> {
        let chunks = base.map_or(&[][..], |base| &base.chunks[..]);
        let before: BTreeMap<[i32; 2], u64> =
            chunks.iter().map(|chunk| (chunk.cell, chunk.count)).collect();
        let replaced: BTreeSet<[i32; 2]> = match selection {
            // A named cell is replaced even if the base does not have it.
            CellSelection::These(cells) => cells.clone(),
            CellSelection::Touched => after.keys().copied().collect(),
            // Cells of the base without a Gaussian in the push are removed, and reported as going
            // to 0.
            CellSelection::All => before.keys().chain(after.keys()).copied().collect(),
        };
        let count = |counts: &BTreeMap<[i32; 2], u64>, cell| counts.get(cell).copied().unwrap_or(0);
        let mut cells: Vec<CellChange> = replaced
            .iter()
            .map(|cell| CellChange {
                cell: *cell,
                before: count(&before, cell),
                after: count(after, cell),
            })
            .collect();
        // The set is in order of (x, y), and the store and its reports are in order of (y, x).
        cells.sort_by_key(|change| (change.cell[1], change.cell[0]));
        match selection {
            CellSelection::These(_) => refuse_empty(&cells)?,
            CellSelection::Touched => refuse_shrunk(&cells)?,
            CellSelection::All => {}
        }
        // `kept` sums a part of the same counts, so the difference is not negative.
        let kept: u64 = cells.iter().map(|change| change.after).sum();
        Ok(Self { cells, left_out: after.values().sum::<u64>() - kept })
    }
}

/// Refuses named cells without a Gaussian: most likely the axes or the scale of a file are wrong.
fn refuse_empty(cells: &[CellChange]) -> Result<(), PushError> {
    let empty: Vec<_> = cells.iter().filter(|change| change.after == 0).collect();
    let Some(CellChange { cell: [x, y], .. }) = empty.first() else { return Ok(()) };
    let reason = format!(
        "{} of the cells named have no Gaussian in the push, as ({x}, {y}): leave them out of cells, \
         or look at the axes and scale",
        empty.len()
    );
    Err(PushError::Content { reason, cells: empty.iter().map(|change| change.cell).collect() })
}

/// Refuses cells that were not named and would keep less than [`limits::SHRUNK_SHARE`] (a tenth) of
/// their Gaussians.
///
/// Trained blocks overlap, so the few Gaussians that a push has in such a cell are assumed to be
/// the margin of a neighbouring cell. Without this check a few strays would replace the cell.
fn refuse_shrunk(cells: &[CellChange]) -> Result<(), PushError> {
    let shrinks =
        // Counts below 2^53 are exact in f64. A cell without Gaussians before never shrinks: 0 < 0
        // is false.
        |change: &&CellChange| (change.after as f64) < limits::SHRUNK_SHARE * change.before as f64;
    let shrunk: Vec<_> = cells.iter().filter(shrinks).collect();
    let Some(CellChange { cell: [x, y], before, after }) = shrunk.first() else { return Ok(()) };
    let reason = format!(
        "{} of the cells would lose nearly all of their Gaussians, as ({x}, {y}): {after} Gaussians in place \
         of {before}. If you mean this, name the cells; if these Gaussians are the margin of a \
         neighbouring cell, name only the other cells",
        shrunk.len()
    );
    Err(PushError::Content { reason, cells: shrunk.iter().map(|change| change.cell).collect() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_of_two_gaussians() {
        let gaussians = Gaussians {
            sh_degree: 0,
            means_m: vec![[1.0, -2.0, 3.0], [-1.0, 5.0, 0.0]],
            // The second quaternion has the length 5, and a logit of 100 is an opacity of 1 in f64.
            quats_wxyz: vec![[1.0, 0.0, 0.0, 0.0], [0.0, 3.0, 4.0, 0.0]],
            ln_scales: vec![[0.0; 3], [0.0, -1.0, 1.0]],
            logit_opacities: vec![0.0, 100.0],
            sh: vec![0.0; 6],
            ..Gaussians::default()
        };
        let ranges = Ranges::from_gaussians(&gaussians).unwrap();
        assert_eq!(ranges.mean_m, [[-1.0, -2.0, 0.0], [1.0, 5.0, 3.0]]);
        assert_eq!(ranges.scale_m, [f64::exp(-1.0), f64::exp(1.0)]);
        assert_eq!((ranges.opacity, ranges.quat_length), ([0.5, 1.0], [1.0, 5.0]));
        assert_eq!(Ranges::from_gaussians(&Gaussians::default()), None);
    }

    #[test]
    fn named_cells_decide_what_is_left_out() {
        let after = BTreeMap::from([([0, 0], 5), ([1, 0], 7)]);
        // The five Gaussians of cell (0, 0) are not named and so left out.
        let named = CellSelection::These(BTreeSet::from([[1, 0]]));
        let changes = CellChanges::new(&named, None, &after).unwrap();
        assert_eq!(changes.cells, [CellChange { cell: [1, 0], before: 0, after: 7 }]);
        assert_eq!(changes.left_out, 5);
        let empty = CellSelection::These(BTreeSet::from([[1, 0], [9, 9]]));
        match CellChanges::new(&empty, None, &after) {
            Err(PushError::Content { cells, .. }) => assert_eq!(cells, [[9, 9]]),
            other => panic!("{other:?}"),
        }
        let touched = CellChanges::new(&CellSelection::Touched, None, &after).unwrap();
        assert_eq!((touched.cells.len(), touched.left_out), (2, 0));
    }
}
