//! Capital letters as strokes, and the names of shops.

/// A stroke from (x, y) to (x, y), in widths and heights of the letter from its lower left corner.
pub(super) type Stroke = [f64; 4];

/// Names that fit on a shop's sign.
pub(super) const NAMES: [&str; 14] = [
    "BAKERY", "BOOKS", "CAFE", "OPTICIAN", "BIKES", "TAILOR", "PHARMACY", "GROCER", "FLOWERS",
    "PIZZA", "TOYS", "HAIR", "SHOES", "MUSIC",
];

/// The strokes of a letter; none of a character that no name has.
pub(super) fn strokes(letter: char) -> &'static [Stroke] {
    const LEFT: Stroke = [0.0, 0.0, 0.0, 1.0];
    const RIGHT: Stroke = [1.0, 0.0, 1.0, 1.0];
    const TOP: Stroke = [0.0, 1.0, 0.95, 1.0];
    const MIDDLE: Stroke = [0.05, 0.52, 0.9, 0.52];
    const BOTTOM: Stroke = [0.0, 0.0, 0.95, 0.0];
    const UPPER_RIGHT: Stroke = [0.95, 0.55, 0.95, 0.97];
    const LOWER_RIGHT: Stroke = [1.0, 0.03, 1.0, 0.5];
    const UPPER_LEFT: Stroke = [0.0, 0.55, 0.0, 0.97];
    match letter {
        'A' => &[[0.0, 0.0, 0.5, 1.0], [0.5, 1.0, 1.0, 0.0], [0.22, 0.36, 0.78, 0.36]],
        'B' => &[LEFT, TOP, MIDDLE, BOTTOM, UPPER_RIGHT, LOWER_RIGHT],
        'C' => &[LEFT, TOP, BOTTOM],
        'E' => &[LEFT, TOP, MIDDLE, BOTTOM],
        'F' => &[LEFT, TOP, MIDDLE],
        'G' => &[LEFT, TOP, BOTTOM, LOWER_RIGHT, [0.55, 0.45, 0.95, 0.45]],
        'H' => &[LEFT, RIGHT, MIDDLE],
        'I' => &[[0.5, 0.0, 0.5, 1.0]],
        'K' => &[LEFT, [0.05, 0.42, 0.95, 1.0], [0.32, 0.6, 1.0, 0.0]],
        'L' => &[LEFT, BOTTOM],
        'M' => &[LEFT, RIGHT, [0.0, 1.0, 0.5, 0.35], [0.5, 0.35, 1.0, 1.0]],
        'N' => &[LEFT, RIGHT, [0.0, 1.0, 1.0, 0.0]],
        'O' => &[LEFT, RIGHT, TOP, BOTTOM],
        'P' => &[LEFT, TOP, MIDDLE, UPPER_RIGHT],
        'R' => &[LEFT, TOP, MIDDLE, UPPER_RIGHT, [0.4, 0.5, 1.0, 0.0]],
        'S' => &[TOP, UPPER_LEFT, MIDDLE, LOWER_RIGHT, BOTTOM],
        'T' => &[TOP, [0.5, 0.0, 0.5, 1.0]],
        'U' => &[LEFT, RIGHT, BOTTOM],
        'W' => &[
            [0.0, 1.0, 0.25, 0.0],
            [0.25, 0.0, 0.5, 0.7],
            [0.5, 0.7, 0.75, 0.0],
            [0.75, 0.0, 1.0, 1.0],
        ],
        'X' => &[[0.0, 0.0, 1.0, 1.0], [0.0, 1.0, 1.0, 0.0]],
        'Y' => &[[0.0, 1.0, 0.5, 0.5], [1.0, 1.0, 0.5, 0.5], [0.5, 0.5, 0.5, 0.0]],
        'Z' => &[TOP, BOTTOM, [0.0, 0.0, 1.0, 1.0]],
        _ => &[],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_letter_of_a_name_has_strokes() {
        for letter in NAMES.iter().flat_map(|name| name.chars()) {
            assert!(!strokes(letter).is_empty(), "{letter}");
        }
    }
}
