//! The summary of an evaluation on standard output.

use std::io::{self, Write};

use crate::cli::output::counted;
use wildcity_eval::{Extrapolation, Gain, LidarMeans, Means, ScoreMeans};

pub(super) fn print_means(out: &mut impl Write, means: &Means) -> io::Result<()> {
    let images = means.images;
    print_scores(out, &format!("mean of {}", counted(images, "image")), &means.rendered)?;
    if let Some(repaired) = &means.repaired {
        print_scores(out, "repaired", repaired)?;
    }
    if let Some(lidar) = &means.lidar {
        let LidarMeans { points, mean_m, median_m, .. } = lidar;
        match points {
            0 => writeln!(out, "depth: {}", wildcity_eval::NO_LIDAR_POINT)?,
            _ => writeln!(
                out,
                "depth against {points} LiDAR points: mean {mean_m:.3} m, median {median_m:.3} m"
            )?,
        }
    }
    if let Some(gain) = &means.gain {
        let Gain { psnr_db, ssim, flip, .. } = gain;
        writeln!(out, "gain: PSNR {psnr_db:+.2} dB, SSIM {ssim:+.4}, FLIP {flip:+.4}")?;
    }
    Ok(())
}

fn print_scores(out: &mut impl Write, what: &str, means: &ScoreMeans) -> io::Result<()> {
    let ScoreMeans { psnr_db, ssim, ssim_mirrored, flip, .. } = means;
    let psnr = mean_decibels(*psnr_db);
    writeln!(
        out,
        "{what}: PSNR {psnr}, SSIM {ssim:.4} (mirrored edges: {ssim_mirrored:.4}), FLIP {flip:.4}"
    )?;
    if let Some(lpips) = means.lpips {
        writeln!(out, "  LPIPS {lpips:.4}")?;
    }
    if let Some(aligned) = &means.aligned {
        let psnr = mean_decibels(aligned.psnr_db);
        writeln!(out, "with aligned exposure: PSNR {psnr}, SSIM {:.4}", aligned.ssim)?;
    }
    Ok(())
}

pub(super) fn print_off_trajectory(out: &mut impl Write, one: &Extrapolation) -> io::Result<()> {
    let Extrapolation { offset_m, trust, covered, .. } = one;
    writeln!(
        out,
        "{offset_m} m beside the drive: trust {trust:.2}, covered {:.1} %",
        100.0 * covered
    )?;
    let means = [("rendered", Some(&one.rendered)), ("repaired", one.repaired.as_ref())];
    for (what, means) in means {
        let Some(means) = means else { continue };
        writeln!(
            out,
            "  {what}: reprojection {} ({:.1} % came back), flicker {:.4}",
            mean_decibels(means.reprojection_psnr_db),
            100.0 * means.reprojection_share,
            means.flicker
        )?;
    }
    Ok(())
}

/// A mean of decibels. One exact image of many makes it infinite, and the others are not exact.
fn mean_decibels(db: f64) -> String {
    if db == f64::INFINITY { "infinite".to_owned() } else { decibels(db) }
}

pub(super) fn decibels(db: f64) -> String {
    if db == f64::INFINITY { "exact".to_owned() } else { format!("{db:.2} dB") }
}
