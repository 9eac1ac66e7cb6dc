//! Windows of an image whose outputs together equal the output for the whole image.
//!
//! Every window has the size of a tile and begins at a multiple of `multiple_of`, so that strides
//! fall on the same pixels as in the whole image. Only the part of a window counts that is at least
//! a halo away from its borders. Borders of the image are an exception: there, the model pads as it
//! does in the whole image.

use crate::error::RepairError;
use crate::planes::Rect;

/// Most windows of an image: a 4K image in tiles of 128 px with a halo of 32 px has 2,040. Each is
/// a run of the model, with a time-out of its own.
const WINDOWS: usize = 4096;

/// A tile: the window that the model sees, and the part of its output that is used.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Window {
    /// The window, in the image.
    pub(crate) seen: Rect,
    /// The part that is used, in the image and within `seen`. The parts of all windows cover each
    /// pixel once.
    pub(crate) used: Rect,
}

/// The sizes with which images are cut into windows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Tiling {
    /// Height and width of a window.
    pub(crate) tile: [usize; 2],
    pub(crate) multiple_of: usize,
    pub(crate) halo: usize,
}

impl Tiling {
    /// The windows of an image whose sides are multiples of `multiple_of`.
    pub(crate) fn windows(&self, height: usize, width: usize) -> Result<Vec<Window>, RepairError> {
        let rows = self.spans(height, self.tile[0])?;
        let columns = self.spans(width, self.tile[1])?;
        let count = rows.len() * columns.len();
        if count > WINDOWS {
            let [tall, wide] = self.tile;
            let message = format!(
                "{tall} x {wide} px make {count} windows of an image of {height} x {width} px; at \
                 most {WINDOWS} are run: use larger tiles"
            );
            return Err(RepairError::Tiles { message });
        }
        let mut windows = Vec::with_capacity(count);
        for row in &rows {
            for column in &columns {
                windows.push(Window {
                    seen: Rect {
                        top: row.start,
                        left: column.start,
                        height: row.len,
                        width: column.len,
                    },
                    used: Rect {
                        top: row.used.0,
                        left: column.used.0,
                        height: row.used.1 - row.used.0,
                        width: column.used.1 - column.used.0,
                    },
                });
            }
        }
        Ok(windows)
    }

    /// The windows along one axis.
    fn spans(&self, side: usize, tile: usize) -> Result<Vec<Span>, RepairError> {
        // The whole side is seen, with the model's own padding at both ends.
        if side <= tile {
            return Ok(vec![Span { start: 0, len: side, used: (0, side) }]);
        }
        // From one window to the next: without both halos, rounded down so that phases stay.
        let stride = tile.saturating_sub(2 * self.halo) / self.multiple_of * self.multiple_of;
        if stride == 0 {
            let message = format!(
                "a tile of {tile} px has nothing within its halo of {} px on each side; use larger tiles",
                self.halo
            );
            return Err(RepairError::Tiles { message });
        }
        let mut spans = Vec::new();
        let mut start = 0;
        let mut covered = 0;
        loop {
            // The last window ends with the image. It is moved back rather than made smaller, since
            // a model of a fixed size takes no other.
            let is_last = start + tile >= side;
            let start_here = if is_last { side - tile } else { start };
            // A halo before the window's end, except at the image's own border.
            let end = if is_last { side } else { start_here + tile - self.halo };
            // Invariant: all pixels below `covered` are used once. The next window begins at least
            // a halo before `covered`.
            spans.push(Span { start: start_here, len: tile, used: (covered, end) });
            if is_last {
                return Ok(spans);
            }
            covered = end;
            start += stride;
        }
    }
}

/// A window along one axis.
struct Span {
    start: usize,
    len: usize,
    /// First pixel, and the pixel after the last.
    used: (usize, usize),
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_cover_each_pixel_once_with_a_halo_to_spare() {
        // Sides that no tile divides; multiples; a halo that leaves 2 px of a tile; a stride of one
        // multiple.
        for (height, width, tile, multiple_of, halo) in [
            (231, 359, [64, 80], 1, 7),
            (256, 512, [64, 64], 4, 20),
            (40, 300, [64, 64], 1, 31),
            (192, 192, [128, 128], 64, 30),
        ] {
            let tiling = Tiling { tile, multiple_of, halo };
            let windows = tiling.windows(height, width).unwrap();
            let mut count = vec![0; height * width];
            for Window { seen, used } in &windows {
                assert!(seen.top % multiple_of == 0 && seen.left % multiple_of == 0);
                assert!(seen.height <= tile[0] && seen.width <= tile[1]);
                let spare = |start: usize, from: usize| start == 0 || from >= start + halo;
                assert!(
                    spare(seen.top, used.top) && spare(seen.left, used.left),
                    "{seen:?} {used:?}"
                );
                let end = |start: usize, len: usize, to: usize, side: usize| {
                    start + len == side || to + halo <= start + len
                };
                assert!(end(seen.top, seen.height, used.top + used.height, height));
                assert!(end(seen.left, seen.width, used.left + used.width, width));
                for y in used.top..used.top + used.height {
                    for x in used.left..used.left + used.width {
                        count[y * width + x] += 1;
                    }
                }
            }
            assert!(count.iter().all(|n| *n == 1), "{tiling:?}");
        }
    }

    #[test]
    fn a_halo_that_fills_the_tile_is_refused() {
        // 64 - 2 x 32 leaves nothing between the halos.
        let tiling = Tiling { tile: [64, 64], multiple_of: 1, halo: 32 };
        let error = tiling.windows(100, 100).unwrap_err();
        assert!(error.to_string().contains("use larger tiles"), "{error}");
    }
}
