//! Maps and scenarios from other formats.
//!
//! | module | input |
//! |---|---|
//! | `opendrive` | lanes of OpenDRIVE, by the crate xodr |
//! | `geojson` | lanes and areas of GeoJSON, with nuPlan's layers |
//! | `openscenario` | OpenSCENARIO XML 1.0 to 1.3 with its catalogs and roads |
//!
//! A reader refuses elements that it does not support, with their name and line.

pub mod geojson;
pub mod opendrive;
pub mod openscenario;
mod xml;

/// Largest text that is read, in bytes.
pub const TEXT_BYTES: usize = 256 << 20;

/// Why a file was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{place}: {message}")]
pub struct ConvertError {
    /// Where: a line, or a feature.
    pub place: String,
    /// The error, and the remedy.
    pub message: String,
}

impl ConvertError {
    fn new(place: impl Into<String>, message: impl Into<String>) -> Self {
        Self { place: place.into(), message: message.into() }
    }
}

/// The bytes of a file as text.
fn utf8_text(bytes: &[u8]) -> Result<&str, ConvertError> {
    if bytes.len() > TEXT_BYTES {
        let message = format!("{} bytes; at most {TEXT_BYTES} are read", bytes.len());
        return Err(ConvertError::new("file", message));
    }
    std::str::from_utf8(bytes).map_err(|error| {
        ConvertError::new("file", format!("not UTF-8 ({error}); save it as UTF-8"))
    })
}
