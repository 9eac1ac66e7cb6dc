//! What is found in the files of a push, before anything is committed.

use std::collections::{BTreeMap, BTreeSet};

use crate::limits;
use wildcity_scene::{Gaussians, Manifest};
use wildcity_session::PsnrPreview;
use wildcity_twin::ingest::BadGaussian;

use super::fault::Fault;
use super::push::AskedCells;

/// How far a push is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum State {
    /// Waiting for pushes before it.
    Queued,
    /// Its files are read.
    Ingesting,
    /// They are compared with what is there.
    Validating,
    /// The version is written.
    Committing,
    /// It is loaded for those who will ask for it.
    Prefetching,
    /// It is the latest.
    Ready,
    /// Its content cannot be accepted.
    Refused,
    /// The server could not do it.
    Failed,
}

/// What was found.
#[derive(Clone, Debug, Default)]
pub(super) struct Report {
    pub(super) files: Vec<FileReport>,
    pub(super) gaussians: u64,
    pub(super) left_out: u64,
    pub(super) sh_degree: u8,
    pub(super) ranges: Option<Ranges>,
    /// Cells that are replaced, in order of (y, x).
    pub(super) cells: Vec<CellChange>,
    pub(super) golden: Vec<PsnrPreview>,
}

/// A cell that is replaced, and its Gaussians before and after.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct CellChange {
    pub(super) cell: [i32; 2],
    pub(super) before: u64,
    pub(super) after: u64,
}

/// One file.
#[derive(Clone, Debug)]
pub(super) struct FileReport {
    pub(super) name: String,
    pub(super) gaussians: u64,
    pub(super) bad: u64,
    pub(super) first_bad: Vec<BadGaussian>,
}

/// Smallest and largest values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Ranges {
    pub(super) mean_m: [[f64; 3]; 2],
    pub(super) scale_m: [f64; 2],
    pub(super) opacity: [f64; 2],
    pub(super) quat_length: [f64; 2],
}

impl Ranges {
    /// Of Gaussians that have passed the gate; none of none.
    pub(super) fn of(gaussians: &Gaussians) -> Option<Self> {
        let range = |values: &mut dyn Iterator<Item = f64>| {
            values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], value| {
                [low.min(value), high.max(value)]
            })
        };
        let axis = |axis: usize| range(&mut gaussians.means_m.iter().map(|mean| mean[axis]));
        let means_m = [0, 1, 2].map(axis);
        let scale = |ln: &f32| f64::from(*ln).exp();
        let opacity = |logit: &f32| 1.0 / (1.0 + (-f64::from(*logit)).exp());
        let length =
            |quat: &[f32; 4]| quat.iter().map(|&q| f64::from(q).powi(2)).sum::<f64>().sqrt();
        (!gaussians.is_empty()).then(|| Self {
            mean_m: [means_m.map(|range| range[0]), means_m.map(|range| range[1])],
            scale_m: range(&mut gaussians.ln_scales.as_flattened().iter().map(scale)),
            opacity: range(&mut gaussians.logit_opacities.iter().map(opacity)),
            quat_length: range(&mut gaussians.quats_wxyz.iter().map(length)),
        })
    }
}

/// The cells that a push replaces, with their Gaussians before and after, and how many Gaussians lie
/// in none of them. `after` is how many Gaussians of the push each cell has.
///
/// # Errors
/// [`Fault::Content`]: a cell that was asked for has none, or one that was not named would lose
/// nearly all that it has.
pub(super) fn cells(
    asked: &AskedCells,
    base: Option<&Manifest>,
    after: &BTreeMap<[i32; 2], u64>,
) -> Result<(Vec<CellChange>, u64), Fault> {
    let chunks = base.map_or(&[][..], |base| &base.chunks[..]);
    let before: BTreeMap<[i32; 2], u64> =
        chunks.iter().map(|chunk| (chunk.cell, chunk.count)).collect();
    let both = |cell: [i32; 2]| {
        let count = |of: &BTreeMap<[i32; 2], u64>| of.get(&cell).copied().unwrap_or(0);
        CellChange { cell, before: count(&before), after: count(after) }
    };
    let mut cells: Vec<_> = match asked {
        AskedCells::These(cells) => cells.iter().map(|&cell| both(cell)).collect(),
        AskedCells::Touched => after.keys().map(|&cell| both(cell)).collect(),
        AskedCells::All => {
            let all: BTreeSet<_> = before.keys().chain(after.keys()).collect();
            all.into_iter().map(|&cell| both(cell)).collect()
        }
    };
    cells.sort_by_key(|change| (change.cell[1], change.cell[0]));
    let named = |cells: Vec<[i32; 2]>, reason: String| Err(Fault::Content { reason, cells });
    match asked {
        AskedCells::These(_) => {
            let empty: Vec<_> = cells.iter().filter(|change| change.after == 0).collect();
            if let Some(CellChange { cell: [x, y], .. }) = empty.first() {
                let reason = format!(
                    "{} of the cells named have no Gaussian in the push, as ({x}, {y}): leave them \
                     out of cells, or look at the axes and scale",
                    empty.len()
                );
                return named(empty.iter().map(|change| change.cell).collect(), reason);
            }
        }
        AskedCells::Touched => {
            let shrinks = |change: &&CellChange| {
                (change.after as f64) < limits::SHRUNK_SHARE * change.before as f64
            };
            let shrunk: Vec<_> = cells.iter().filter(shrinks).collect();
            if let Some(CellChange { cell: [x, y], before, after }) = shrunk.first() {
                let reason = format!(
                    "{} cells would lose nearly all that they have, as ({x}, {y}): {after} \
                     Gaussians in place of {before}. If that is meant, name the cells; if they are \
                     a neighbour's margin, name only the others",
                    shrunk.len()
                );
                return named(shrunk.iter().map(|change| change.cell).collect(), reason);
            }
        }
        AskedCells::All => {}
    }
    let kept: u64 = cells.iter().map(|change| change.after).sum();
    Ok((cells, after.values().sum::<u64>() - kept))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_of_two_gaussians() {
        let gaussians = Gaussians {
            sh_degree: 0,
            means_m: vec![[1.0, -2.0, 3.0], [-1.0, 5.0, 0.0]],
            quats_wxyz: vec![[1.0, 0.0, 0.0, 0.0], [0.0, 3.0, 4.0, 0.0]],
            ln_scales: vec![[0.0; 3], [0.0, -1.0, 1.0]],
            logit_opacities: vec![0.0, 100.0],
            sh: vec![0.0; 6],
        };
        let ranges = Ranges::of(&gaussians).unwrap();
        assert_eq!(ranges.mean_m, [[-1.0, -2.0, 0.0], [1.0, 5.0, 3.0]]);
        assert_eq!(ranges.scale_m, [f64::exp(-1.0), f64::exp(1.0)]);
        assert_eq!((ranges.opacity, ranges.quat_length), ([0.5, 1.0], [1.0, 5.0]));
        assert_eq!(Ranges::of(&Gaussians::default()), None);
    }
}
