//! Means over images: gains of a repair, networks, LiDAR; the order of images, and what JSON and
//! CSV say of them.

use wildcity_eval::{
    EvaluatedImage, Evaluation, LidarBin, LidarDepth, Pair, PairScores, Scored, Subject,
};
use wildcity_scene::RenderProfile;

/// Scores of a noisy image that is off by some steps of 255 in addition to the noise.
fn scores(off: u8, lpips: Option<f64>) -> PairScores {
    let truth: Vec<u8> = (0..3 * 16 * 16).map(|at| 60 + (at * 7919 % 90) as u8).collect();
    let rendered = truth.iter().enumerate().map(|(at, value)| value + off + (at * 31 % 5) as u8);
    let pair = Pair::new([16, 16], truth.clone(), rendered.collect(), None).unwrap();
    let mut scores = PairScores::compare(&pair, true);
    scores.scores.lpips = lpips;
    scores
}

fn image(name: &str, scores: &PairScores) -> EvaluatedImage {
    EvaluatedImage::new(name.to_owned(), [16, 16], 1.0, scores)
}

fn evaluation(images: Vec<EvaluatedImage>) -> Evaluation {
    let subject = Subject {
        scene: "street".into(),
        version: None,
        version_hash: None,
        images: "views.jsonl".into(),
        alignment: "identity".into(),
        every: 1,
        backend: "cpu",
        profile: RenderProfile::DEFAULT,
        repair: None,
        lpips_network: None,
        boxes: None,
        lidar: None,
    };
    Evaluation::new(subject, images)
}

fn near(found: f64, wanted: f64) {
    assert!((found - wanted).abs() < 1e-9, "{found} instead of {wanted}");
}

/// An image of one colour that is off by some steps of 255; no pixel counts if `is_hidden`.
fn flat(name: &str, off: u8, is_hidden: bool) -> EvaluatedImage {
    let counts = is_hidden.then(|| vec![false; 144]);
    let pair = Pair::new([12, 12], vec![100; 432], vec![100 + off; 432], counts).unwrap();
    EvaluatedImage::new(name.to_owned(), [12, 12], 1.0, &PairScores::compare(&pair, false))
}

#[test]
fn means_are_of_the_images_values() {
    let made = evaluation(vec![
        flat("front/1.png", 1, false),
        flat("front/2.png", 10, false),
        flat("left/1.png", 100, false),
        flat("left/2.png", 50, true),
    ]);
    let db = |off: f64| 20.0 * (255.0 / off).log10();
    assert_eq!((made.all.images, made.cameras.len()), (3, 2));
    assert!((made.all.rendered.psnr_db - (db(1.0) + db(10.0) + db(100.0)) / 3.0).abs() < 1e-9);
    let pooled = -10.0 * ((1.0 + 100.0 + 10_000.0) / 3.0 / 255.0_f64.powi(2)).log10();
    assert!((made.all.rendered.pooled_psnr_db - pooled).abs() < 1e-9);
    assert!((made.cameras[0].means.rendered.psnr_db - (db(1.0) + db(10.0)) / 2.0).abs() < 1e-9);
    let order: Vec<&str> = made.worst_first().iter().map(|image| &*image.name).collect();
    assert_eq!(order, ["left/1.png", "front/2.png", "front/1.png", "left/2.png"]);
}

#[test]
fn json_and_csv_have_words_for_infinity_and_nan() {
    let made = evaluation(vec![flat("a.png", 0, false), flat("say \"b\".png", 9, true)]);
    let csv = made.csv();
    let lines: Vec<&str> = csv.lines().collect();
    let columns = lines[0].split(',').count();
    assert_eq!(lines[1], "\"a.png\",\"\",12,12,1,1,inf,1,1,0,,,,,,,,,,,,,,");
    assert_eq!(lines[1].split(',').count(), columns);
    assert!(lines[2].starts_with("\"say \"\"b\"\".png\",\"\",12,12,0,1,NaN,NaN,"), "{csv}");
    assert_eq!((made.all.images, made.all.rendered.psnr_db), (1, f64::INFINITY));
}

#[test]
fn flip_is_the_mean_of_its_map_and_an_aligned_image_keeps_its_noise() {
    let noisy = scores(20, None);
    let sum: f64 = noisy.error_map.iter().map(|error| f64::from(*error)).sum();
    near(noisy.scores.flip, sum / 256.0);
    let aligned = noisy.scores.aligned.unwrap();
    assert!(aligned.ssim < 0.9999, "{aligned:?}");
}

#[test]
fn a_gain_is_the_mean_after_the_repair_minus_the_mean_before() {
    let before = [scores(20, Some(0.5)), scores(8, Some(0.3))];
    let after = [scores(4, Some(0.2)), scores(2, Some(0.25))];
    let images = before.iter().zip(&after).map(|(before, after)| {
        let mut image = image("front/a.png", before);
        image.repaired = Some(after.scored());
        image
    });
    let made = evaluation(images.collect());
    let (rendered, repaired) = (&made.all.rendered, made.all.repaired.as_ref().unwrap());
    let mean = |of: &[PairScores; 2], value: &dyn Fn(&Scored) -> f64| {
        of.iter().map(|scores| value(&scores.scored())).sum::<f64>() / 2.0
    };
    for (means, of) in [(rendered, &before), (repaired, &after)] {
        near(means.psnr_db, mean(of, &|one| one.scores.psnr_db));
        near(means.ssim, mean(of, &|one| one.scores.ssim));
        near(means.ssim_mirrored, mean(of, &|one| one.scores.ssim_mirrored));
        near(means.flip, mean(of, &|one| one.scores.flip));
        near(means.lpips.unwrap(), mean(of, &|one| one.scores.lpips.unwrap()));
        let aligned = means.aligned.as_ref().unwrap();
        near(aligned.psnr_db, mean(of, &|one| one.scores.aligned.unwrap().psnr_db));
        near(aligned.ssim, mean(of, &|one| one.scores.aligned.unwrap().ssim));
        assert!(means.ssim != means.ssim_mirrored && aligned.psnr_db > means.psnr_db);
    }
    let gain = made.all.gain.unwrap();
    near(gain.psnr_db, repaired.psnr_db - rendered.psnr_db);
    near(gain.ssim, repaired.ssim - rendered.ssim);
    near(gain.flip, repaired.flip - rendered.flip);
    near(gain.lpips.unwrap(), 0.225 - 0.4);
    assert!(gain.psnr_db > 5.0 && gain.ssim > 0.0 && gain.flip < 0.0, "{gain:?}");
    assert_eq!(evaluation(vec![image("a.png", &before[0])]).all.gain, None);
}

#[test]
fn a_mask_that_leaves_pixels_but_no_window_takes_no_mean_away() {
    let whole = scores(8, None);
    let truth = vec![100; 3 * 16 * 16];
    let counts = (0..256).map(|at| at == 100).collect();
    let pair = Pair::new([16, 16], truth.clone(), vec![104; 3 * 256], Some(counts)).unwrap();
    let narrow = PairScores::compare(&pair, true);
    assert!(narrow.scores.ssim.is_nan() && narrow.scores.psnr_db.is_finite());
    let made = evaluation(vec![image("a.png", &whole), image("b.png", &narrow)]);
    near(made.all.rendered.ssim, whole.scores.ssim);
    near(made.all.rendered.psnr_db, 0.5 * (whole.scores.psnr_db + narrow.scores.psnr_db));
    // An image without pixels is in no mean.
    let nothing = Pair::new([16, 16], truth.clone(), truth, Some(vec![false; 256])).unwrap();
    let nothing = PairScores::compare(&nothing, true);
    let made = evaluation(vec![image("a.png", &whole), image("b.png", &nothing)]);
    assert_eq!(made.all.images, 1);
}

#[test]
fn depth_is_the_mean_of_images_and_a_bin_that_of_points() {
    let depth = |points: [usize; 3], mean_m: f64, median_m: f64, in_bin: [f64; 3]| {
        let bin = |at: usize| {
            let [from_m, to_m] = [[0.0, 10.0], [10.0, 30.0], [30.0, 80.0]][at];
            LidarBin { from_m, to_m, points: points[at], mean_m: in_bin[at] }
        };
        LidarDepth { points: points.iter().sum(), mean_m, median_m, bins: [0, 1, 2].map(bin) }
    };
    let made = [
        depth([1, 3, 0], 1.0, 0.5, [0.25, 1.25, f64::NAN]),
        depth([3, 0, 2], 2.0, 1.5, [0.75, f64::NAN, 4.0]),
        depth([0, 0, 0], f64::NAN, f64::NAN, [f64::NAN; 3]),
    ];
    let images = made.map(|lidar| {
        let mut image = image("a.png", &scores(3, None));
        image.lidar = Some(lidar);
        image
    });
    let lidar = evaluation(images.to_vec()).all.lidar.unwrap();
    assert_eq!((lidar.images, lidar.points), (2, 9));
    assert_eq!((lidar.mean_m, lidar.median_m), (1.5, 1.0));
    assert_eq!(lidar.bins.map(|bin| bin.points), [4, 3, 2]);
    assert_eq!(lidar.bins.map(|bin| bin.mean_m), [(0.25 + 3.0 * 0.75) / 4.0, 1.25, 4.0]);
    assert_eq!(evaluation(vec![image("a.png", &scores(3, None))]).all.lidar, None);
}
