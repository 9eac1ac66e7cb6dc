//! Text in pictures, on a dark ground.

use image::{Rgb, RgbImage};
use noto_sans_mono_bitmap::{FontWeight, RasterHeight, get_raster, get_raster_width};

const FONT: (FontWeight, RasterHeight) = (FontWeight::Regular, RasterHeight::Size20);
/// Pixels around the text.
const PAD_PX: u32 = 3;
const GROUND: [u8; 3] = [16, 20, 24];

/// Height of a caption, in pixels.
pub(in crate::cli) const HEIGHT_PX: u32 = FONT.1.val() as u32 + 2 * PAD_PX;

/// Draws a text, with its left upper corner at a place; what does not fit is cut off. Characters
/// that are not ASCII are drawn as question marks.
pub(in crate::cli) fn draw(picture: &mut RgbImage, text: &str, [left, top]: [u32; 2]) {
    let advance = get_raster_width(FONT.0, FONT.1) as u32;
    let width = advance * text.chars().count() as u32 + 2 * PAD_PX;
    for y in top..(top + HEIGHT_PX).min(picture.height()) {
        for x in left..(left + width).min(picture.width()) {
            picture.put_pixel(x, y, Rgb(GROUND));
        }
    }
    for (column, character) in text.chars().enumerate() {
        // A camera's name has underscores for spaces.
        let character = if character == '_' { ' ' } else { character };
        let raster = [character, '?'].into_iter().find_map(|one| get_raster(one, FONT.0, FONT.1));
        let Some(raster) = raster else { continue };
        for (row, lights) in raster.rows().enumerate() {
            for (at, light) in lights.iter().enumerate() {
                let x = left + PAD_PX + advance * column as u32 + at as u32;
                let y = top + PAD_PX + row as u32;
                if let Some(pixel) = picture.get_pixel_mut_checked(x, y) {
                    *pixel = Rgb(GROUND.map(|ground| ground.max(*light)));
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Number of bright pixels of a text.
    fn bright(text: &str) -> usize {
        let mut picture = RgbImage::new(200, 40);
        draw(&mut picture, text, [4, 6]);
        picture.pixels().filter(|pixel| pixel[0] > 128).count()
    }

    #[test]
    fn every_character_is_drawn_and_a_space_is_none() {
        let picture = |character: char| {
            let mut picture = RgbImage::new(40, 40);
            draw(&mut picture, &character.to_string(), [4, 6]);
            picture.into_raw()
        };
        for character in "abcdefghijklmnopqrstuvwxyz0123456789.,:/=+-".chars() {
            assert_ne!(picture(character), picture('?'), "{character:?}");
        }
        assert_eq!(bright("front_left"), bright("front left"));
        assert_eq!(bright("é"), bright("?"));
        assert_eq!(bright(" "), 0);
    }

    #[test]
    fn what_does_not_fit_is_cut_off() {
        let mut picture = RgbImage::new(20, 10);
        draw(&mut picture, "front left", [0, 0]);
        draw(&mut picture, "far away", [100, 100]);
        assert!(picture.pixels().any(|pixel| pixel[0] > 128));
    }
}
