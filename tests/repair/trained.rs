//! The two trained models of the data, in the same manifest format.

use serde_json::json;
use wildcity_repair::{Halo, View};

use crate::onnx_models::{Folder, trained};
use crate::support::picture;

const ZERO_DCE: &str = "zero_dce_pp_rgb.onnx";

fn zero_dce(size: serde_json::Value) -> Option<Folder> {
    let changes = json!({
        "name": "zero-dce", "size": size,
        "inputs": [{"name": "input", "role": "rgb"}], "outputs": [{"name": "output", "role": "rgb"}],
    });
    Some(Folder::new(&trained(ZERO_DCE)?, changes))
}

#[test]
fn tiles_equal_the_whole_to_the_bit_with_the_measured_halo() {
    let Some(whole) = zero_dce(json!({"multiple_of": 1, "fit": "pad"})) else { return };
    let tiled = zero_dce(json!({"multiple_of": 1, "fit": "tile", "tile": [96, 80]})).unwrap();
    let image = picture(231, 159);
    let tiled = tiled.load().unwrap();
    // Seven convolutions of 3 x 3.
    assert_eq!(tiled.halo(), Some(Halo::Pixels(7)));
    let whole = whole.load().unwrap().repair(&View::new(&image)).unwrap();
    let tiled = tiled.repair(&View::new(&image)).unwrap();
    assert_eq!(whole.image, tiled.image);
    assert_eq!(whole.hash, tiled.hash);
    assert_eq!(whole.rendered_hash, image.hash());
    assert_ne!(whole.hash, whole.rendered_hash, "the model brightens");
}

#[test]
fn one_and_two_threads_and_repeated_runs_give_the_same_hash() {
    let Some(folder) = zero_dce(json!({"multiple_of": 1, "fit": "pad"})) else { return };
    let image = picture(300, 200);
    let one = folder.load_with_threads(1);
    let two = folder.load_with_threads(2);
    assert!(one.is_deterministic() && two.is_deterministic());
    let hashes: Vec<_> = [&one, &two, &one, &two]
        .map(|model| model.repair(&View::new(&image)).unwrap().hash)
        .into_iter()
        .collect();
    assert!(hashes.iter().all(|hash| *hash == hashes[0]), "{hashes:?}");
    assert_eq!(one.repair_hash(), two.repair_hash());
    let runtime = one.runtime();
    assert!(runtime.contains("onnxruntime") && runtime.contains(", commit "), "{runtime}");
    // Beside another.
    let beside = std::thread::scope(|scope| {
        let jobs = [&one, &two]
            .map(|model| scope.spawn(|| model.repair(&View::new(&image)).unwrap().hash));
        jobs.map(|job| job.join().unwrap())
    });
    assert_eq!(beside, [hashes[0]; 2]);
}

#[test]
fn super_resolution_of_a_fixed_size_takes_luma_in_tiles_and_gives_three_times_the_size() {
    let Some(onnx) = trained("super_resolution_224_niazwazir.onnx") else { return };
    let folder = Folder::new(
        &onnx,
        json!({
            "name": "super-resolution", "size": {"fixed": [224, 224], "fit": "tile"},
            "inputs": [{"name": "input", "role": "luma"}],
            "outputs": [{"name": "output", "role": "luma", "scale": 3}],
        }),
    );
    let model = folder.load().unwrap();
    let Some(Halo::Pixels(halo)) = model.halo() else { panic!("{:?}", model.halo()) };
    // Convolutions of 5, 3, 3 and 3.
    assert_eq!(halo, 5);
    // One tile, and the same pixels as a part of a larger image: away from the cut they are equal.
    let large = picture(300, 260);
    let repaired = model.repair(&View::new(&large)).unwrap().image;
    assert_eq!((repaired.width, repaired.height), (900, 780));
    let mean = |image: &wildcity_repair::Image| {
        image.rgb8.iter().map(|value| f64::from(*value)).sum::<f64>() / image.rgb8.len() as f64
    };
    assert!((mean(&repaired) - mean(&large)).abs() < 2.0, "{} {}", mean(&repaired), mean(&large));
    let again = model.repair(&View::new(&large)).unwrap().image;
    assert_eq!(repaired, again);
}
