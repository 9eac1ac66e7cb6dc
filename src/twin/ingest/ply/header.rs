//! The header of a PLY file.
//!
//! Source: Greg Turk, "The PLY Polygon File Format" (1994).

use std::borrow::Cow;
use std::io::{BufRead, Read};

use crate::ingest::IngestError;
use crate::limits;

/// What the lines up to `end_header` say.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Header {
    /// How the numbers of the body are written.
    pub(super) encoding: Encoding,
    /// In the order of the body.
    pub(super) elements: Vec<Element>,
    /// The texts of the comments.
    pub(super) comments: Vec<String>,
    /// The comments with bytes that are not UTF-8, which were replaced.
    pub(super) damaged_comments: Vec<String>,
    /// Where the body starts, in bytes.
    pub(super) bytes: u64,
}

/// How the numbers of a body are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Encoding {
    Ascii,
    BigEndian,
    LittleEndian,
}

/// A table of the body.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Element {
    pub(super) name: String,
    pub(super) count: u64,
    pub(super) properties: Vec<Property>,
    /// Size of one row, in bytes.
    pub(super) stride: usize,
}

/// A column of a table.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Property {
    pub(super) name: String,
    pub(super) scalar: Scalar,
    /// Where in the row it starts, in bytes.
    pub(super) offset: usize,
}

/// The type of a column. In a row it is little-endian, whatever the encoding of the file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Header {
    /// Reads up to and including `end_header`, and no byte of the body.
    pub(super) fn read(input: &mut impl BufRead) -> Result<Self, IngestError> {
        let mut input = input.take(limits::PLY_HEADER_BYTES as u64);
        let mut elements: Vec<Element> = Vec::new();
        let mut comments = Vec::new();
        let mut damaged_comments = Vec::new();
        let mut bytes = 0;
        let mut number = 0;
        let mut encoding = None;
        let mut line = Vec::new();
        loop {
            number += 1;
            let bad = |reason: String| error(format!("line {number}"), reason);
            line.clear();
            bytes += input.read_until(b'\n', &mut line)? as u64;
            if line.last() != Some(&b'\n') {
                let limit = limits::PLY_HEADER_BYTES;
                return Err(bad(format!(
                    "the file or the limit of {limit} bytes ends before end_header"
                )));
            }
            // The first word is the kind of the declaration.
            let text = String::from_utf8_lossy(&line);
            let is_damaged = matches!(text, Cow::Owned(_));
            let text = text.trim();
            let words: Vec<&str> = text.split_ascii_whitespace().collect();
            match words[..] {
                ["ply"] if number == 1 => {}
                _ if number == 1 => return Err(bad(format!("{text:?} must be ply"))),
                [] => {}
                ["comment" | "obj_info", ref words @ ..] => {
                    comments.push(words.join(" "));
                    damaged_comments.extend(is_damaged.then(|| words.join(" ")));
                }
                // Names in other lines decide what is read.
                _ if is_damaged => return Err(bad("is not text".into())),
                ["format", name, "1.0"] => {
                    let known = Encoding::parse(name);
                    encoding = Some(known.ok_or_else(|| bad(format!("{text:?} {FORMATS}")))?);
                }
                ["format", ..] => return Err(bad(format!("{text:?} {FORMATS}"))),
                ["element", name, count] => {
                    let count = count
                        .parse()
                        .map_err(|e| bad(format!("the count of {name}, {count:?}: {e}")))?;
                    if elements.iter().any(|element| element.name == name) {
                        return Err(bad(format!("element {name} occurs twice")));
                    }
                    elements.push(Element { name: name.to_owned(), count, ..Element::default() });
                }
                ["property", "list", ..] => {
                    // A list in an empty table takes no byte: MeshLab writes `element face 0`.
                    if elements.last().is_none_or(|element| element.count > 0) {
                        return Err(bad(format!("{text:?}: Gaussians have no lists")));
                    }
                }
                ["property", kind, name] => {
                    let scalar = Scalar::parse(kind)
                        .ok_or_else(|| bad(format!("{kind:?} is not a type of PLY")))?;
                    let element = elements
                        .last_mut()
                        .ok_or_else(|| bad("there is no element before the property".into()))?;
                    element.push(name, scalar).map_err(bad)?;
                }
                ["end_header"] => break,
                _ => return Err(bad(format!("{text:?} is unknown in a header"))),
            }
        }
        let encoding = encoding.ok_or_else(|| {
            error("end".into(), "there is no line format binary_little_endian 1.0".into())
        })?;
        Ok(Self { encoding, elements, comments, damaged_comments, bytes })
    }

    /// The element of a name.
    pub(super) fn element(&self, name: &str) -> Option<&Element> {
        self.elements.iter().find(|element| element.name == name)
    }

    /// Compares the size that the header implies with the file's, before anything is allocated for
    /// it.
    pub(super) fn check_size(&self, file_bytes: u64) -> Result<(), IngestError> {
        let is_ascii = self.encoding == Encoding::Ascii;
        // A number in text has at least one digit and a separator, which the last one may lack.
        let row_bytes = |e: &Element| if is_ascii { 2 * e.properties.len() } else { e.stride };
        let size = |e: &Element| u128::from(e.count) * row_bytes(e) as u128;
        let promised: u128 = self.elements.iter().map(size).sum();
        let held = u128::from(file_bytes.saturating_sub(self.bytes));
        if promised == held || is_ascii && promised <= held + 1 {
            return Ok(());
        }
        let least = if is_ascii { "at least " } else { "" };
        let tables = self.elements.iter();
        let content: Vec<_> = tables
            .map(|e| format!("{} {} of {least}{} bytes", e.count, e.name, row_bytes(e)))
            .collect();
        let content = content.join(", ");
        Err(IngestError::Size { format: "PLY", promised, held, content })
    }
}

/// The formats that are read.
const FORMATS: &str = "must be format binary_little_endian 1.0, binary_big_endian 1.0 or ascii 1.0";

impl Encoding {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "ascii" => Self::Ascii,
            "binary_big_endian" => Self::BigEndian,
            "binary_little_endian" => Self::LittleEndian,
            _ => return None,
        })
    }
}

impl Element {
    /// The column of a name.
    pub(super) fn property(&self, name: &str) -> Result<&Property, IngestError> {
        self.properties.iter().find(|property| property.name == name).ok_or_else(|| {
            error(format!("element {}", self.name), format!("there is no property {name}"))
        })
    }

    fn push(&mut self, name: &str, scalar: Scalar) -> Result<(), String> {
        if self.properties.iter().any(|property| property.name == name) {
            return Err(format!("property {name} occurs twice"));
        }
        self.properties.push(Property { name: name.to_owned(), scalar, offset: self.stride });
        self.stride += scalar.bytes();
        Ok(())
    }
}

impl Property {
    /// The value in a row. The row is as long as the element's stride.
    pub(super) fn value(&self, row: &[u8]) -> f64 {
        /// # Panics
        /// If the row is shorter than the element's stride.
        fn at<const N: usize>(row: &[u8], offset: usize) -> [u8; N] {
            let mut bytes = [0; N];
            bytes.copy_from_slice(&row[offset..offset + N]);
            bytes
        }
        match self.scalar {
            Scalar::F32 => f32::from_le_bytes(at(row, self.offset)).into(),
            Scalar::F64 => f64::from_le_bytes(at(row, self.offset)),
            Scalar::U8 => u8::from_le_bytes(at(row, self.offset)).into(),
            Scalar::I8 => i8::from_le_bytes(at(row, self.offset)).into(),
            Scalar::U16 => u16::from_le_bytes(at(row, self.offset)).into(),
            Scalar::I16 => i16::from_le_bytes(at(row, self.offset)).into(),
            Scalar::U32 => u32::from_le_bytes(at(row, self.offset)).into(),
            Scalar::I32 => i32::from_le_bytes(at(row, self.offset)).into(),
        }
    }
}

impl Scalar {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    /// Size in a row, in bytes.
    pub(super) const fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }
}

/// An error of the header.
pub(super) fn error(place: String, reason: String) -> IngestError {
    IngestError::Header { format: "PLY", place, reason }
}
