//! PSNR, SSIM and FLIP against scikit-image, torchmetrics and flip-evaluator (`image_metrics.py`
//! wrote the values).

use serde::Deserialize;
use wildcity_render::compare::flip::flip;
use wildcity_render::compare::psnr::psnr_db_u8;
use wildcity_render::compare::ssim::Ssim;

#[derive(Deserialize)]
struct Case {
    name: String,
    size_px: [u32; 2],
    truth: String,
    image: String,
    psnr_db: f64,
    ssim_within: f64,
    ssim_mirrored: f64,
    flip: f64,
    flip_map: Vec<f64>,
}

/// The bytes of an image that is written in hexadecimal digits.
fn bytes(hex: &str) -> Vec<u8> {
    let digits = hex.as_bytes().chunks_exact(2);
    let byte = |pair: &[u8]| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap();
    digits.map(byte).collect()
}

fn cases() -> Vec<Case> {
    let cases: Vec<Case> = serde_json::from_str(include_str!("image_metrics.json")).unwrap();
    assert_eq!(cases.len(), 3);
    cases
}

#[test]
fn psnr_and_ssim_are_those_of_scikit_image_and_torchmetrics() {
    for case in cases() {
        let [image, truth] = [&case.image, &case.truth].map(|hex| bytes(hex));
        let psnr_db = psnr_db_u8(image.iter().zip(&truth));
        let values = |image: &[u8]| -> Vec<f64> {
            image.iter().map(|&byte| f64::from(byte) / 255.0).collect()
        };
        let ssim = Ssim::compare(&values(&image), &values(&truth), case.size_px, None);
        for (what, own, other) in [
            ("PSNR", psnr_db, case.psnr_db),
            ("SSIM within", ssim.within, case.ssim_within),
            ("SSIM mirrored", ssim.mirrored, case.ssim_mirrored),
        ] {
            assert!((own - other).abs() < 1e-12, "{}: {what} {own}, not {other}", case.name);
        }
    }
}

#[test]
fn flip_is_that_of_flip_evaluator() {
    for case in cases() {
        let values = |hex: &str| -> Vec<f32> {
            bytes(hex).iter().map(|&byte| f32::from(byte) / 255.0).collect()
        };
        let errors = flip(&values(&case.image), &values(&case.truth), case.size_px);
        let mean = errors.iter().map(|&error| f64::from(error)).sum::<f64>() / errors.len() as f64;
        // Both compute in f32, in different orders.
        assert!((mean - case.flip).abs() < 2e-6, "{}: {mean}, not {}", case.name, case.flip);
        for (own, other) in errors.iter().step_by(7).zip(&case.flip_map) {
            let off = (f64::from(*own) - other).abs();
            assert!(off < 2e-5, "{}: a pixel has {own}, not {other}", case.name);
        }
    }
}
