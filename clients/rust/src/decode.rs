//! Decoding of JPEG and PNG files to pixels.

use std::io::Cursor;

use png::{BitDepth, ColorType};
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

/// Why a file has no pixels.
pub(crate) enum DecodeError {
    /// The file is damaged, or has another pixel format than 8-bit RGB.
    Invalid(String),
    /// The file has another size than expected: width and height, in pixels.
    Size([usize; 2]),
}

/// Pixels of a JPEG file, u8 `[height, width, 3]`. `size` is the expected width and height.
///
/// The size is checked before pixels are allocated, so that a small file cannot ask for a large
/// buffer.
pub(crate) fn jpeg(file: &[u8], size: [usize; 2]) -> Result<Vec<u8>, DecodeError> {
    let options = DecoderOptions::default().jpeg_set_out_colorspace(ColorSpace::RGB);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(file), options);
    decoder.decode_headers().map_err(invalid)?;
    let found = decoder.dimensions().ok_or_else(|| invalid("it has no size"))?;
    check_size([found.0, found.1], size)?;
    decoder.decode().map_err(invalid)
}

/// Pixels of a PNG file, u8 `[height, width, 3]`. `size` is the expected width and height.
pub(crate) fn png(file: &[u8], size: [usize; 2]) -> Result<Vec<u8>, DecodeError> {
    let mut reader = png::Decoder::new(Cursor::new(file)).read_info().map_err(invalid)?;
    let info = reader.info();
    check_size([info.width as usize, info.height as usize], size)?;
    let format = reader.output_color_type();
    // Servers write nothing else; converting would hide that the file is another one.
    if format != (ColorType::Rgb, BitDepth::Eight) {
        return Err(invalid(format!("its pixels are {format:?}; 8-bit RGB is expected")));
    }
    let bytes = reader.output_buffer_size().ok_or_else(|| invalid("it is too large"))?;
    let mut pixels = vec![0; bytes];
    reader.next_frame(&mut pixels).map_err(invalid)?;
    Ok(pixels)
}

fn check_size(found: [usize; 2], expected: [usize; 2]) -> Result<(), DecodeError> {
    if found == expected { Ok(()) } else { Err(DecodeError::Size(found)) }
}

fn invalid(reason: impl ToString) -> DecodeError {
    DecodeError::Invalid(reason.to_string())
}
