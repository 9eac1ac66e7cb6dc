//! Extensions of SPZ: records of a type, a length, and a payload (nianticlabs/spz,
//! extensions/README.md).

use std::io::{self, Read};

use crate::ingest::notes::Reading;
use crate::ingest::{Axes, IngestError};

/// `SPZ_ADOBE_coordinate_system`: a u32.
const COORDINATE_SYSTEM: u32 = 0xADBE_0003;
/// `SPZ_ADOBE_safe_orbit_camera`: where a viewer's camera may go, which has no effect on the
/// picture.
const SAFE_ORBIT_CAMERA: u32 = 0xADBE_0002;
/// Bytes of the extensions after the payload of versions 2 and 3 that are read.
pub(super) const LEGACY_BYTES: u64 = 64 << 10;
/// Coordinate systems by number (splat-types.h): the directions of x, y and z. 0 is unspecified.
const SYSTEMS: [&str; 17] = [
    "", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF", "LFD", "RFD", "LFU", "RFU", "LBD",
    "RBD", "LBU", "RBU",
];

/// Reads extensions of so many bytes in all.
pub(super) fn read(
    input: &mut impl Read,
    mut left: u64,
    reading: &mut Reading,
) -> Result<(), IngestError> {
    // A head takes 8 bytes. Fewer than that are no extension.
    while let Some(after) = left.checked_sub(8) {
        let mut head = [0; 8];
        input.read_exact(&mut head)?;
        let [kind, bytes] = head.as_chunks().0 else { return Ok(()) };
        let [kind, bytes] = [*kind, *bytes].map(u32::from_le_bytes);
        left = after;
        // With a wrong length, the place of the next extension is lost as well.
        if u64::from(bytes) > left {
            reading.warn(format!(
                "SPZ extension {kind:#010x} says {bytes} bytes of {left}: it and what follows are not read"
            ));
            break;
        }
        left -= u64::from(bytes);
        match (kind, bytes) {
            (COORDINATE_SYSTEM, 4) => {
                let mut system = [0; 4];
                input.read_exact(&mut system)?;
                note_system(u32::from_le_bytes(system), reading);
            }
            _ => {
                skip(input, bytes.into())?;
                if kind != SAFE_ORBIT_CAMERA {
                    reading.warn(format!("SPZ extension {kind:#010x} ({bytes} bytes) is not read"));
                }
            }
        }
    }
    // The caller reads on from the end of the extensions.
    skip(input, left)
}

/// Notes the axes of a file that records none: by the specification, right, up, back.
pub(super) fn assume_system(reading: &mut Reading) {
    if let Some(axes) = Axes::from_letters("RUB") {
        reading.assume_axes(axes, "the specification of SPZ".to_owned());
    }
}

fn skip(input: &mut impl Read, bytes: u64) -> Result<(), IngestError> {
    io::copy(&mut input.take(bytes), &mut io::sink())?;
    Ok(())
}

fn note_system(number: u32, reading: &mut Reading) {
    let name = SYSTEMS.get(number as usize).copied().unwrap_or_default();
    match Axes::from_letters(name) {
        Some(axes) => {
            reading.set_axes(axes, format!("SPZ_ADOBE_coordinate_system {number} ({name})"));
        }
        None if number == 0 => {}
        None => reading.warn(format!(
            "SPZ_ADOBE_coordinate_system {number} is unknown; 1 to 16 are read: give --axes"
        )),
    }
}
