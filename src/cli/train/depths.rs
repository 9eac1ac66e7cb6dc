//! Depths of the points of a LiDAR in an image.

/// Pixels of a cell in which only the nearest points are seen.
const CELL_PX: usize = 6;

/// A point farther than the nearest of its cell by this factor is hidden behind it.
const HIDDEN: f32 = 1.1;

/// Depths of single pixels, of which the near ones hide the far ones around them.
pub(super) struct Depths {
    size_px: [usize; 2],
    depth_m: Vec<f32>,
    /// The nearest depth in each cell.
    nearest_m: Vec<f32>,
}

impl Depths {
    pub(super) fn new(size_px: [u32; 2]) -> Self {
        let [width, height] = size_px.map(|px| px as usize);
        let cells = width.div_ceil(CELL_PX) * height.div_ceil(CELL_PX);
        Self {
            size_px: [width, height],
            depth_m: vec![0.0; width * height],
            nearest_m: vec![f32::INFINITY; cells],
        }
    }

    fn cell(&self, [x, y]: [usize; 2]) -> usize {
        y / CELL_PX * self.size_px[0].div_ceil(CELL_PX) + x / CELL_PX
    }

    pub(super) fn add(&mut self, at: [u32; 2], depth_m: f32) {
        let [x, y] = at.map(|px| px as usize);
        // Behind a camera that sees more than half of the world, a depth along z is not positive.
        if x >= self.size_px[0] || y >= self.size_px[1] || depth_m <= 0.0 {
            return;
        }
        let cell = self.cell([x, y]);
        self.nearest_m[cell] = self.nearest_m[cell].min(depth_m);
        let own = &mut self.depth_m[y * self.size_px[0] + x];
        // 0 means that no point is there: it must not win as the nearest.
        *own = if *own == 0.0 { depth_m } else { own.min(depth_m) };
    }

    /// The depths that no nearer point hides.
    pub(super) fn seen(mut self) -> Vec<f32> {
        for pixel in 0..self.depth_m.len() {
            let cell = self.cell([pixel % self.size_px[0], pixel / self.size_px[0]]);
            // Points are sparse: one of the background shows between those of what hides it, a few
            // pixels away.
            if self.depth_m[pixel] > HIDDEN * self.nearest_m[cell] {
                self.depth_m[pixel] = 0.0;
            }
        }
        self.depth_m
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_lies_behind_a_near_point_is_not_seen() {
        let mut depths = Depths::new([20, 12]);
        depths.add([3, 2], 5.0);
        depths.add([4, 2], 9.0);
        depths.add([4, 3], 5.3);
        depths.add([3, 2], 7.0);
        depths.add([14, 8], 9.0);
        depths.add([20, 8], 1.0);
        depths.add([15, 8], -1.0);
        let seen = depths.seen();
        let at = |x: usize, y: usize| seen[y * 20 + x];
        assert_eq!([at(3, 2), at(4, 2), at(4, 3), at(14, 8)], [5.0, 0.0, 5.3, 9.0]);
        assert_eq!(seen.iter().filter(|depth_m| **depth_m > 0.0).count(), 3);
    }
}
