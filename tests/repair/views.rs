//! The input of a model, and the use of its output.

use serde_json::json;
use wildcity_repair::{Halo, Image, RepairError, View};

use crate::onnx_doubles as doubles;
use crate::onnx_models::Folder;
use crate::support::picture;

#[test]
fn a_residual_of_a_model_that_changes_nothing_changes_no_byte() {
    let image = picture(131, 77);
    for size in [
        json!({"multiple_of": 16, "fit": "pad"}),
        json!({"multiple_of": 16, "fit": "resize", "pixels": 4000}),
        json!({"multiple_of": 1, "fit": "tile", "tile": [64, 64]}),
    ] {
        let changes = json!({"size": size, "merge": "residual"});
        let model = Folder::new(&doubles::identity(), changes).load().unwrap();
        let repaired = model.repair(&View::new(&image)).unwrap();
        assert_eq!(repaired.image, image, "{size}");
        assert_eq!(repaired.hash, repaired.rendered_hash);
    }
    // A replacement of the image loses detail, since the image is resampled there and back.
    let changes = json!({"size": {"multiple_of": 16, "fit": "resize", "pixels": 4000}});
    let model = Folder::new(&doubles::identity(), changes).load().unwrap();
    assert_ne!(model.repair(&View::new(&image)).unwrap().image, image);
}

#[test]
fn ranges_layouts_and_roles_of_the_output_mean_what_the_manifest_says() {
    let image = Image { width: 2, height: 1, rgb8: vec![0, 10, 20, 100, 200, 255] };
    let repaired = |onnx: Vec<u8>, changes| {
        let model = Folder::new(&onnx, changes).load().unwrap();
        model.repair(&View::new(&image)).unwrap().image.rgb8
    };
    // 0.4 more of a range of 1 is 102 more of 255, clamped.
    let more = repaired(doubles::arithmetic("Add", 0.4), json!({}));
    assert_eq!(more, [102, 112, 122, 202, 255, 255]);
    // With a range of 2 it is half of that.
    let wide = json!({
        "inputs": [{"name": "image", "role": "rgb", "range": [-1, 1]}],
        "outputs": [{"name": "repaired", "role": "rgb", "range": [-1, 1]}],
    });
    assert_eq!(repaired(doubles::arithmetic("Add", 0.4), wide), [51, 61, 71, 151, 251, 255]);
    // A residual of the image itself doubles it.
    let residual =
        json!({"merge": "residual", "outputs": [{"name": "repaired", "role": "residual"}]});
    assert_eq!(repaired(doubles::identity(), residual), [0, 20, 40, 200, 255, 255]);
    let residual = json!({"merge": "residual"});
    assert_eq!(repaired(doubles::arithmetic("Mul", 0.4), residual), [0, 4, 8, 40, 80, 102]);
}

#[test]
fn outside_the_mask_the_image_is_black() {
    let image = Image { width: 2, height: 1, rgb8: vec![9; 6] };
    let model = Folder::new(&doubles::arithmetic("Add", 0.4), json!({})).load().unwrap();
    let view = View { mask: Some(&[1.0, 0.0]), ..View::new(&image) };
    assert_eq!(model.repair(&view).unwrap().image.rgb8, [111, 111, 111, 0, 0, 0]);
}

#[test]
fn the_halo_of_strides_and_kernels_is_measured_and_tiles_equal_the_whole() {
    let image = picture(150, 90);
    for (side, stride, halo) in [(1, 1, 0), (3, 1, 1), (9, 1, 4), (3, 2, 2), (7, 4, 6)] {
        let onnx = doubles::convolution(side, stride);
        let whole = json!({"size": {"multiple_of": stride, "fit": "pad"}, "merge": "residual"});
        let tiles = json!({"size": {"multiple_of": stride, "fit": "tile", "tile": [48, 64]}, "merge": "residual"});
        let whole = Folder::new(&onnx, whole).load().unwrap();
        let tiled = Folder::new(&onnx, tiles).load().unwrap();
        assert_eq!(tiled.halo(), Some(Halo::Pixels(halo)), "{side} / {stride}");
        let view = View::new(&image);
        let whole = whole.repair(&view).unwrap();
        assert_eq!(whole.image, tiled.repair(&view).unwrap().image, "{side} / {stride}");
        assert_ne!(whole.image, image, "{side} / {stride}");
    }
}

#[test]
fn a_model_that_looks_at_the_whole_image_is_refused_as_tiles() {
    let tiles = json!({"size": {"multiple_of": 1, "fit": "tile", "tile": [64, 64]}});
    let error = Folder::new(&doubles::global(), tiles).load().unwrap_err();
    assert!(matches!(error, RepairError::Tiles { .. }), "{error}");
    assert!(error.to_string().contains("size.fit"), "{error}");
}

fn difix() -> Folder {
    let changes = json!({
        "name": "difix-double", "merge": "residual",
        "size": {"multiple_of": 64, "fit": "resize", "pixels": 16384},
        "inputs": [
            {"name": "image", "role": "rgb", "dtype": "f16", "range": [-1, 1]},
            {"name": "reference", "role": "reference", "dtype": "f16", "range": [-1, 1]},
            {"name": "strength", "role": "constant", "dtype": "f16", "value": 0.5},
        ],
        "outputs": [{"name": "repaired", "role": "rgb", "range": [-1, 1]}],
    });
    Folder::new(&doubles::difix(), changes)
}

#[test]
fn the_double_of_difix_uses_its_reference() {
    let model = difix().load().unwrap();
    let image = Image { width: 160, height: 100, rgb8: vec![100; 3 * 16_000] };
    let reference = Image { rgb8: vec![200; 3 * 16_000], ..image.clone() };
    let view = View { reference: Some(&reference), ..View::new(&image) };
    let repaired = model.repair(&view).unwrap();
    // Half-way to the reference, in steps of f16 (2^-11 near 0.5: an eighth of a step of 8 bits).
    assert!(
        repaired.image.rgb8.iter().all(|value| value.abs_diff(150) <= 1),
        "{:?}",
        &repaired.image.rgb8[..6]
    );
    assert_eq!(repaired.image.width, 160);
    let error = model.repair(&View::new(&image)).unwrap_err();
    assert_eq!(error.to_string(), "reference: missing; the manifest has this role");
}
