//! The part of an image that the own vehicle covers: the overlay of the rig's camera of the same
//! name.

use wildcity_scene::Rig;

/// Largest difference of the shapes of a real image and of an overlay, as a share.
const SAME_SHAPE: f64 = 0.01;

/// The pixels of an image outside of the overlay of the rig's camera of a name. `None` without such
/// a camera or overlay, and if the image has another shape: then another camera took it.
pub fn outside(
    rig: Option<&Rig>,
    camera_name: &str,
    [width, height]: [u32; 2],
) -> Option<Vec<bool>> {
    let camera = rig?.cameras.iter().find(|camera| camera.name == camera_name)?;
    let overlay = camera.appearance.overlay.as_ref()?;
    let own_px = overlay.size_px();
    let across = f64::from(own_px[0]) / f64::from(width);
    let down = f64::from(own_px[1]) / f64::from(height);
    if (across / down - 1.0).abs() > SAME_SHAPE {
        return None;
    }
    let at = |pixel: u32, scale: f64, side: u32| {
        (((f64::from(pixel) + 0.5) * scale) as u32).min(side - 1) as usize
    };
    let rgba8 = overlay.rgba8();
    let is_outside = |row: u32, column: u32| {
        let pixel = at(row, down, own_px[1]) * own_px[0] as usize + at(column, across, own_px[0]);
        rgba8[4 * pixel + 3] == 0
    };
    Some(
        (0..height)
            .flat_map(|row| (0..width).map(move |column| (row, column)))
            .map(|(row, column)| is_outside(row, column))
            .collect(),
    )
}

/// The pixels that count in both of two masks, if there are any masks.
pub fn both(one: Option<Vec<bool>>, other: Option<Vec<bool>>) -> Option<Vec<bool>> {
    match (one, other) {
        (Some(one), Some(other)) => Some(one.iter().zip(&other).map(|(a, b)| *a && *b).collect()),
        (one, other) => one.or(other),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use wildcity_scene::appearance::Overlay;

    #[test]
    fn what_the_overlay_covers_is_the_own_vehicle() {
        let mut rig = Rig::preset("vehicle6").unwrap();
        assert_eq!(outside(Some(&rig), "front", [4, 2]), None);
        // 8 x 4: the two rows below are covered, the last one in part.
        let alpha = |row: usize| [0, 0, 255, 1][row];
        let rgba8 = (0..32).flat_map(|pixel| [9, 9, 9, alpha(pixel / 8)]).collect();
        rig.cameras[0].appearance.overlay = Some(Arc::new(Overlay::new(8, rgba8).unwrap()));
        let name = rig.cameras[0].name.clone();
        let half = [[true; 4], [false; 4]].concat();
        assert_eq!(outside(Some(&rig), &name, [4, 2]), Some(half));
        let whole = outside(Some(&rig), &name, [8, 4]).unwrap();
        assert_eq!(whole, [vec![true; 16], vec![false; 16]].concat());
        assert_eq!(outside(Some(&rig), &name, [4, 3]), None, "another shape");
        assert_eq!(outside(Some(&rig), "unknown", [4, 2]), None);
        assert_eq!(outside(None, &name, [4, 2]), None);
    }

    #[test]
    fn two_masks_leave_what_both_leave() {
        let masks = [Some(vec![true, true, false]), Some(vec![true, false, false])];
        let [one, other] = masks.clone();
        assert_eq!(both(one, other), Some(vec![true, false, false]));
        let [one, _] = masks;
        assert_eq!(both(None, one.clone()), one);
        assert_eq!(both(one.clone(), None), one);
        assert_eq!(both(None, None), None);
    }
}
