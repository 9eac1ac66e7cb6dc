//! Images, and what a process has mapped.

use std::fs;
use std::path::Path;

use wildcity_repair::Image;

/// An image with smooth parts, edges and noise; the same every time.
pub(crate) fn picture(width: usize, height: usize) -> Image {
    let mut rgb8 = Vec::new();
    let mut state = 12_345_u32;
    for y in 0..height {
        for x in 0..width {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let noise = (state >> 28) as usize;
            let edge = if (x / 37 + y / 23) % 2 == 0 { 60 } else { 0 };
            rgb8.extend(
                [x * 150 / width, y * 150 / height, 40].map(|base| (base + edge + noise) as u8),
            );
        }
    }
    Image { width, height, rgb8 }
}

/// Whether a library with that word in its name is mapped by a process.
pub(crate) fn maps(process: &str, word: &str) -> bool {
    fs::read_to_string(Path::new("/proc").join(process).join("maps")).unwrap().contains(word)
}
