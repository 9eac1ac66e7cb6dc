//! The images as CSV.

use super::evaluated_image::EvaluatedImage;
use super::evaluation::Evaluation;
use super::scores::Scores;

const HEADER: &str = "name,camera,width,height,counted,covered,psnr_db,ssim,ssim_mirrored,flip,aligned_psnr_db,\
                      aligned_ssim,lpips,repaired_psnr_db,repaired_ssim,repaired_ssim_mirrored,repaired_flip,\
                      repaired_aligned_psnr_db,repaired_aligned_ssim,repaired_lpips,moving,lidar_points,lidar_mean_m,\
                      lidar_median_m\n";

impl Evaluation {
    /// The images as CSV: a header, and one line per image. Numbers that are infinite or NaN are
    /// the words `inf` and `NaN`. Cells of scores that were not requested are empty.
    pub fn csv(&self) -> String {
        let lines = self.images.iter().map(line);
        std::iter::once(HEADER.to_owned()).chain(lines).collect()
    }
}

fn line(image: &EvaluatedImage) -> String {
    // Names are quoted always, because a file name may contain commas, quotes and line breaks.
    let quoted = |text: &str| format!("\"{}\"", text.replace('"', "\"\""));
    let [width, height] = image.size_px;
    let mut cells = vec![quoted(&image.name), quoted(&image.camera)];
    cells.extend([width, height].map(|side| side.to_string()));
    cells.extend([image.rendered.scores.counted, image.covered].map(|share| share.to_string()));
    cells.extend(scores(Some(&image.rendered.scores)));
    cells.extend(scores(image.repaired.as_ref().map(|repaired| &repaired.scores)));
    // `None` is an empty cell: not requested, which differs from `NaN`, requested and without a
    // value.
    cells.push(cell(image.moving));
    cells.push(image.lidar.as_ref().map_or(String::new(), |lidar| lidar.points.to_string()));
    cells.push(cell(image.lidar.as_ref().map(|lidar| lidar.mean_m)));
    cells.push(cell(image.lidar.as_ref().map(|lidar| lidar.median_m)));
    cells.join(",") + "\n"
}

/// PSNR, SSIM twice, FLIP, both aligned, LPIPS.
fn scores(scores: Option<&Scores>) -> [String; 7] {
    let aligned = scores.and_then(|scores| scores.aligned);
    [
        cell(scores.map(|scores| scores.psnr_db)),
        cell(scores.map(|scores| scores.ssim)),
        cell(scores.map(|scores| scores.ssim_mirrored)),
        cell(scores.map(|scores| scores.flip)),
        cell(aligned.map(|aligned| aligned.psnr_db)),
        cell(aligned.map(|aligned| aligned.ssim)),
        cell(scores.and_then(|scores| scores.lpips)),
    ]
}

fn cell(value: Option<f64>) -> String {
    value.map_or(String::new(), |value| value.to_string())
}
