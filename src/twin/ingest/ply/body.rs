//! The rows of a PLY file in any of its encodings.

use std::io::{BufRead, Read};
use std::str::FromStr;

use super::header::{Element, Encoding, Scalar};
use crate::ingest::{IngestError, Progress};
use crate::limits;

/// The bytes after the header.
pub(super) struct Body<'a, R> {
    pub(super) input: R,
    pub(super) encoding: Encoding,
    /// Bytes of the file that have been read.
    pub(super) done: u64,
    pub(super) file_bytes: u64,
    pub(super) progress: Progress<'a>,
}

/// Rows between two reports of progress.
const REPORT_EVERY: u64 = 16_384;

impl<R: BufRead> Body<'_, R> {
    /// Calls `take` with each row of the next element, little-endian.
    pub(super) fn rows(
        &mut self,
        element: &Element,
        mut take: impl FnMut(&[u8]),
    ) -> Result<(), IngestError> {
        let mut row = vec![0; element.stride];
        let mut line = Vec::new();
        // A row without columns takes no bytes, so that its count, which is untrusted, must not
        // drive a loop.
        let count = if element.stride == 0 { 0 } else { element.count };
        for index in 0..count {
            match self.encoding {
                Encoding::Ascii => {
                    self.read_line(&mut line)?;
                    parse_row(element, &line, &mut row).map_err(|reason| {
                        error(format!("row {index} of {}", element.name), reason)
                    })?;
                }
                Encoding::BigEndian => {
                    self.input.read_exact(&mut row)?;
                    swap_bytes(element, &mut row);
                    self.done += row.len() as u64;
                }
                Encoding::LittleEndian => {
                    self.input.read_exact(&mut row)?;
                    self.done += row.len() as u64;
                }
            }
            take(&row);
            if index % REPORT_EVERY == REPORT_EVERY - 1 {
                (self.progress)(self.done, self.file_bytes);
            }
        }
        (self.progress)(self.done, self.file_bytes);
        Ok(())
    }

    /// Checks that nothing but white space follows the last row of a text.
    pub(super) fn check_end(&mut self) -> Result<(), IngestError> {
        let mut line = Vec::new();
        while self.encoding == Encoding::Ascii && self.done < self.file_bytes {
            self.read_line(&mut line)?;
            if !line.trim_ascii().is_empty() {
                let text = String::from_utf8_lossy(&line[..line.len().min(40)]).into_owned();
                let reason = format!("{text:?} follows the last row: write or copy it again");
                return Err(error("end".into(), reason));
            }
        }
        Ok(())
    }

    /// Reads the next line of a text, which the end of the file may end. Empty after the last one.
    fn read_line(&mut self, line: &mut Vec<u8>) -> Result<(), IngestError> {
        line.clear();
        let limit = limits::PLY_LINE_BYTES;
        // Bounded, because a binary file that claims to be text may have no line break at all.
        let read = (&mut self.input).take(limit).read_until(b'\n', line)? as u64;
        self.done += read;
        if read == limit && line.last() != Some(&b'\n') {
            return Err(error("a line".into(), format!("it is longer than {limit} bytes")));
        }
        Ok(())
    }
}

/// Parses a line of numbers into a row.
fn parse_row(element: &Element, line: &[u8], row: &mut [u8]) -> Result<(), String> {
    let text = std::str::from_utf8(line).map_err(|_| "is not text".to_owned())?;
    let mut words = text.split_ascii_whitespace();
    let wanted = element.properties.len();
    for (index, property) in element.properties.iter().enumerate() {
        let word = words.next().ok_or_else(|| format!("{index} numbers; {wanted} are declared"))?;
        let to = &mut row[property.offset..property.offset + property.scalar.bytes()];
        parse_scalar(property.scalar, word, to)
            .ok_or_else(|| format!("{} is {word:?}, not a number of its type", property.name))?;
    }
    // A number too many shows that the columns are not those that the header declares.
    match words.next() {
        None => Ok(()),
        Some(_) => Err(format!("more than the {wanted} numbers that are declared")),
    }
}

/// Writes a number, little-endian; `None` if the word is none of the type.
fn parse_scalar(scalar: Scalar, word: &str, to: &mut [u8]) -> Option<()> {
    fn parsed<T: FromStr>(word: &str) -> Option<T> {
        word.parse().ok()
    }
    match scalar {
        Scalar::I8 => to.copy_from_slice(&parsed::<i8>(word)?.to_le_bytes()),
        Scalar::U8 => to.copy_from_slice(&parsed::<u8>(word)?.to_le_bytes()),
        Scalar::I16 => to.copy_from_slice(&parsed::<i16>(word)?.to_le_bytes()),
        Scalar::U16 => to.copy_from_slice(&parsed::<u16>(word)?.to_le_bytes()),
        Scalar::I32 => to.copy_from_slice(&parsed::<i32>(word)?.to_le_bytes()),
        Scalar::U32 => to.copy_from_slice(&parsed::<u32>(word)?.to_le_bytes()),
        Scalar::F32 => to.copy_from_slice(&parsed::<f32>(word)?.to_le_bytes()),
        Scalar::F64 => to.copy_from_slice(&parsed::<f64>(word)?.to_le_bytes()),
    }
    Some(())
}

/// Turns a big-endian row into a little-endian one.
fn swap_bytes(element: &Element, row: &mut [u8]) {
    for property in &element.properties {
        row[property.offset..property.offset + property.scalar.bytes()].reverse();
    }
}

/// An error of the body.
fn error(place: String, reason: String) -> IngestError {
    IngestError::Body { format: "PLY", place, reason }
}
