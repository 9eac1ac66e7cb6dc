//! Refuses Gaussians that are scattered over many cells.

use crate::limits;

use super::StoreError;

/// Checks that the Gaussians of one commit do not cost far more on disk than they are worth: each
/// cell is an object of 12 kB at least, whatever it holds.
///
/// # Errors
/// [`StoreError::Scattered`].
pub fn check_density(cells: usize, gaussians: u64) -> Result<(), StoreError> {
    let needed = limits::GAUSSIANS_PER_CELL.saturating_mul(cells as u64);
    if cells > limits::SPARSE_CELLS && gaussians < needed {
        return Err(StoreError::Scattered { gaussians, cells });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scattered_gaussians_are_refused_and_cities_are_not() {
        let sparse = limits::SPARSE_CELLS + 1;
        let needed = limits::GAUSSIANS_PER_CELL * sparse as u64;
        let error = check_density(100_000, 100_000).unwrap_err();
        assert!(error.to_string().contains("100000 cells"), "{error}");
        // Beyond 4096 cells, 16 Gaussians per cell are needed. Up to 4096, one in each is enough.
        assert!(check_density(sparse, needed - 1).is_err());
        assert!(check_density(sparse, needed).is_ok());
        assert!(check_density(limits::SPARSE_CELLS, limits::SPARSE_CELLS as u64).is_ok());
    }
}
