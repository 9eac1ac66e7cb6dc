//! The image loss of a training step against PyTorch's.

use safetensors::SafeTensors;
use wildcity_train::loss::{dssim, l1};

use crate::data::real;

#[test]
fn the_image_loss_has_the_derivatives_of_pytorch() {
    let Some(path) = real("gradients/vectors.safetensors") else { return };
    let bytes = std::fs::read(path).expect("the vectors");
    let tensors = SafeTensors::deserialize(&bytes).expect("safetensors");
    let values = |name: &str| -> Vec<f64> {
        let tensor = tensors.tensor(name).unwrap();
        tensor.data().as_chunks().0.iter().map(|&bytes| f64::from_le_bytes(bytes)).collect()
    };
    let image = values("image_loss.in");
    let target = values("target");
    let by = values("image_loss.d");
    let similarity = dssim([64, 48], &image, &target).scaled(0.2);
    let loss = l1(&image, &target, None).scaled(0.8).plus(&similarity);
    let most = by.iter().fold(0.0_f64, |most, value| most.max(value.abs()));
    let off = loss.by.iter().zip(&by).fold(0.0_f64, |off, (a, b)| off.max((a - b).abs()));
    assert!(off < 1e-10 * most, "{:e}", off / most);

    let f32s = |values: &[f64]| values.iter().map(|&value| value as f32).collect::<Vec<f32>>();
    let (image, target) = (f32s(&image), f32s(&target));
    let similarity = dssim([64, 48], &image, &target).scaled(0.2);
    let single = l1(&image, &target, None).scaled(0.8).plus(&similarity);
    let off =
        single.by.iter().zip(&by).fold(0.0_f64, |off, (&a, b)| off.max((f64::from(a) - b).abs()));
    // f32 resolves variances of 0.1 to 1e-8, against C₂ = 0.0009.
    assert!(off < 1e-4 * most, "in f32 {:e}", off / most);
}
