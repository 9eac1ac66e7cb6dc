//! `.splat`, the format of antimatter15's web viewer: records of 32 bytes, without a header.
//!
//! A record is position (3 f32), standard deviations (3 f32), colour and opacity (4 u8, of 255),
//! and the rotation (w, x, y, z) as u8 around 128. Colours do not depend on the direction.

use std::io::Read;

use wildcity_scene::Gaussians;

use super::notes::Reading;
use super::validate::Field;
use super::{IngestError, activation, check_count};

/// Bytes of a Gaussian.
const RECORD_BYTES: usize = 32;

/// Whether a file that starts like this is likely to be one. There is no magic number, but the
/// first rotation must be a unit quaternion, the position near the origin, and the scales not
/// negative. Text fails these tests.
pub(super) fn is_likely(start: &[u8]) -> bool {
    start.first_chunk().is_some_and(|record| {
        let [means_m, scales, ..] = numbers(record);
        let length = quat_wxyz(record).iter().map(|q| q * q).sum::<f32>().sqrt();
        means_m.iter().all(|m| m.abs() <= 1e8)
            && scales.iter().all(|s| (0.0..=1e5).contains(s))
            // Components are rounded by at most 1/256, and 1 is stored as 127/128.
            && (0.95..=1.05).contains(&length)
    })
}

/// Reads a file of a known size.
pub(super) fn read(
    mut input: impl Read,
    file_bytes: u64,
    reading: &mut Reading,
) -> Result<Gaussians, IngestError> {
    // Rounded up, so that a file with a part of a record holds less than it promises.
    let count = file_bytes.div_ceil(RECORD_BYTES as u64);
    let promised = u128::from(count) * RECORD_BYTES as u128;
    if promised != u128::from(file_bytes) {
        let content = format!("{count} records of {RECORD_BYTES} bytes");
        let held = file_bytes.into();
        return Err(IngestError::Size { format: ".splat", promised, held, content });
    }
    let mut gaussians = Gaussians::with_capacity(0, check_count(count)?);
    let mut record = [0; RECORD_BYTES];
    for _ in 0..count {
        input.read_exact(&mut record)?;
        // No rotation is all zeros: a disk that lost the end of a file gives zeros.
        if record == [0; RECORD_BYTES] {
            let index = gaussians.len();
            let place = format!("record {index}");
            let reason =
                "is all zeros: the file is damaged from there on; copy it again".to_owned();
            return Err(IngestError::Body { format: ".splat", place, reason });
        }
        let [means_m, scales] = numbers(&record);
        gaussians.means_m.push(means_m.map(f64::from));
        gaussians.ln_scales.push(scales.map(|s| activation::ln_scale(s.into())));
        let [r, g, b, opacity] = [24, 25, 26, 27].map(|at| f64::from(record[at]) / 255.0);
        gaussians.sh.extend([r, g, b].map(activation::dc));
        gaussians.logit_opacities.push(activation::logit(opacity));
        gaussians.quats_wxyz.push(quat_wxyz(&record));
    }
    reading.accept(gaussians, &Field::plain_name)
}

/// Position and scales of a record, each as x, y, z in metres.
fn numbers(record: &[u8; RECORD_BYTES]) -> [[f32; 3]; 2] {
    let words = record.as_chunks::<4>().0;
    [0, 3].map(|first| std::array::from_fn(|i| f32::from_le_bytes(words[first + i])))
}

fn quat_wxyz(record: &[u8; RECORD_BYTES]) -> [f32; 4] {
    [28, 29, 30, 31].map(|at| (f32::from(record[at]) - 128.0) / 128.0)
}
