//! The model that comes with the project, as its manifest says.

use std::fs;

use wildcity_repair::{
    Fit, Halo, Image, InputRole, LoadOptions, Merge, Model, Models, OutputRole, Provider, View,
};

use crate::onnx_models::library;
use crate::root::root;
use crate::support::picture;

/// Halo of three levels of convolutions of 3 x 3 with halving and doubling between them, in pixels.
const HALO_PX: usize = 21;

#[test]
fn the_manifest_has_the_hash_and_the_roles_of_its_file() {
    let path = root().join("scenes/repair.json");
    let models = Models::read(std::slice::from_ref(&path), LoadOptions::new(library())).unwrap();
    assert_eq!(models.names().collect::<Vec<_>>(), ["street-repair"]);
    let model = Model::load(&path, &LoadOptions::new(library())).unwrap();
    let manifest = model.manifest();
    let onnx = fs::read(root().join("scenes/repair.onnx")).unwrap();
    assert_eq!(manifest.files.len(), 1);
    assert_eq!(manifest.files[0].path, "repair.onnx");
    assert_eq!(manifest.files[0].blake3, blake3::hash(&onnx).to_hex().to_string());
    let roles: Vec<InputRole> = manifest.inputs.iter().map(|input| input.role).collect();
    let wanted = [InputRole::Rgb, InputRole::ReferenceWarped, InputRole::ReferenceValid];
    assert_eq!(roles, wanted);
    assert_eq!((manifest.outputs[0].role, manifest.outputs[0].scale), (OutputRole::Residual, 1));
    assert_eq!((manifest.merge, manifest.size.fit), (Merge::Residual, Fit::Tile));
    assert_eq!((model.provider(), model.is_deterministic()), (Provider::Cpu, true));
    assert_eq!(model.halo(), Some(Halo::Pixels(HALO_PX)));
}

#[test]
fn it_takes_recorded_images_where_there_are_some() {
    let model = Model::load(&root().join("scenes/repair.json"), &LoadOptions::new(library()));
    let model = model.unwrap();
    let truth = picture(151, 93);
    // A tint, as in a colour that training could not determine.
    let tinted = |value: &u8| value.saturating_sub(30);
    let rendered = Image { rgb8: truth.rgb8.iter().map(tinted).collect(), ..truth.clone() };
    let pixels = 151 * 93;
    let valid: Vec<f32> = (0..pixels).map(|at| f32::from(u8::from(at % 151 < 90))).collect();
    let error = |image: &Image, wanted: &Image, columns: std::ops::Range<usize>| {
        let is_within = |at: &usize| columns.contains(&(at / 3 % 151));
        let at: Vec<usize> = (0..3 * pixels).filter(is_within).collect();
        let off = |at: &usize| f64::from(image.rgb8[*at].abs_diff(wanted.rgb8[*at]));
        at.iter().map(off).sum::<f64>() / at.len() as f64
    };
    let view = View {
        reference_warped: Some(&truth),
        reference_valid: Some(&valid),
        ..View::new(&rendered)
    };
    let repaired = model.repair(&view).unwrap().image;
    let before = error(&rendered, &truth, 10..80);
    let after = error(&repaired, &truth, 10..80);
    assert!(before > 25.0 && after < 0.5 * before, "{after} of {before}");
}
