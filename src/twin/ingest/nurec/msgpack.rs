//! MessagePack, as far as NuRec uses it.
//!
//! Source: the format's specification, msgpack.org. Values point into the bytes they come from.

use std::collections::BTreeMap;

use crate::limits;

/// A value; types that NuRec's reader does not need are `Other`.
#[derive(Debug)]
pub(super) enum Value<'a> {
    Map(Vec<(Value<'a>, Value<'a>)>),
    Array(Vec<Value<'a>>),
    Text(&'a str),
    Bytes(&'a [u8]),
    Count(u64),
    Bool(bool),
    Other,
}

/// Deepest nesting of maps and arrays.
const MAX_DEPTH: usize = 32;

/// Parses one value, which must take all of the bytes.
///
/// # Errors
/// Says what is wrong.
pub(super) fn parse(bytes: &[u8]) -> Result<Value<'_>, String> {
    let mut parser = Parser { bytes, at: 0, values: 0 };
    let value = parser.value(0)?;
    if parser.at != bytes.len() {
        return Err(format!("{} bytes, but the value ends at {}", bytes.len(), parser.at));
    }
    Ok(value)
}

impl<'a> Value<'a> {
    /// The value of a key of a map.
    pub(super) fn get(&self, name: &str) -> Option<&Value<'a>> {
        let Value::Map(entries) = self else { return None };
        entries
            .iter()
            .find(|(key, _)| matches!(key, Value::Text(key) if *key == name))
            .map(|e| &e.1)
    }

    /// The values of a map by their text keys, as [`Value::get`] finds them, but in logarithmic
    /// time.
    pub(super) fn index(&self) -> BTreeMap<&'a str, &Value<'a>> {
        let mut index = BTreeMap::new();
        let entries = if let Value::Map(entries) = self { &entries[..] } else { &[] };
        for (key, value) in entries {
            if let Value::Text(key) = key {
                // The first of equal keys, as `get`.
                index.entry(*key).or_insert(value);
            }
        }
        index
    }

    /// The text keys of a map.
    pub(super) fn keys(&self) -> impl Iterator<Item = &'a str> {
        let entries = if let Value::Map(entries) = self { &entries[..] } else { &[] };
        entries
            .iter()
            .filter_map(|(key, _)| if let Value::Text(key) = key { Some(*key) } else { None })
    }

    pub(super) fn as_usize(&self) -> Option<usize> {
        if let Value::Count(count) = self { usize::try_from(*count).ok() } else { None }
    }
}

struct Parser<'a> {
    bytes: &'a [u8],
    at: usize,
    values: usize,
}

impl<'a> Parser<'a> {
    fn value(&mut self, depth: usize) -> Result<Value<'a>, String> {
        self.values += 1;
        // Each level is a call of this function, so that the bound protects the stack.
        if depth > MAX_DEPTH {
            return Err(format!("byte {}: more than {MAX_DEPTH} values in each other", self.at));
        }
        // A value of one byte in the file takes 32 bytes in memory.
        if self.values > limits::NUREC_VALUES {
            return Err(format!("more than {} values", limits::NUREC_VALUES));
        }
        let start = self.at;
        let kind = self.number(1)?;
        Ok(match kind {
            // In the first four kinds, the low bits of the first byte are the number or the length.
            0x00..=0x7f => Value::Count(kind),
            0x80..=0x8f => self.map(kind & 0x0f, depth)?,
            0x90..=0x9f => self.array(kind & 0x0f, depth)?,
            0xa0..=0xbf => self.text(kind & 0x1f)?,
            0xc2 | 0xc3 => Value::Bool(kind == 0xc3),
            // nil; small negative numbers.
            0xc0 | 0xe0..=0xff => Value::Other,
            // The length has 1, 2 or 4 bytes.
            0xc4..=0xc6 => {
                let length = self.number(1 << (kind - 0xc4))?;
                Value::Bytes(self.take(length)?)
            }
            // Extensions have one more byte, their type.
            0xc7..=0xc9 => {
                let length = self.number(1 << (kind - 0xc7))?;
                self.skip(length.saturating_add(1))?
            }
            // Floats, of 4 and of 8 bytes.
            0xca => self.skip(4)?,
            0xcb => self.skip(8)?,
            0xcc..=0xcf => Value::Count(self.number(1 << (kind - 0xcc))?),
            // Signed numbers of 1, 2, 4 or 8 bytes. The highest bit is set in those below 0.
            0xd0..=0xd3 => {
                let bytes = 1 << (kind - 0xd0);
                let number = self.number(bytes)?;
                if number >> (8 * bytes - 1) == 0 { Value::Count(number) } else { Value::Other }
            }
            // Extensions of 1, 2, 4, 8 or 16 bytes, after a byte for their type.
            0xd4..=0xd8 => self.skip((1 << (kind - 0xd4)) + 1)?,
            0xd9..=0xdb => {
                let length = self.number(1 << (kind - 0xd9))?;
                self.text(length)?
            }
            0xdc | 0xdd => {
                // The length has 2 or 4 bytes.
                let length = self.number(2 << (kind - 0xdc))?;
                self.array(length, depth)?
            }
            0xde | 0xdf => {
                let length = self.number(2 << (kind - 0xde))?;
                self.map(length, depth)?
            }
            _ => return Err(format!("byte {start}: {kind:#x} begins no value")),
        })
    }

    // A length is only a claim of the file, so nothing is allocated for it in advance.

    fn map(&mut self, length: u64, depth: usize) -> Result<Value<'a>, String> {
        let mut entries = Vec::new();
        for _ in 0..length {
            let key = self.value(depth + 1)?;
            entries.push((key, self.value(depth + 1)?));
        }
        Ok(Value::Map(entries))
    }

    fn array(&mut self, length: u64, depth: usize) -> Result<Value<'a>, String> {
        let mut values = Vec::new();
        for _ in 0..length {
            values.push(self.value(depth + 1)?);
        }
        Ok(Value::Array(values))
    }

    fn text(&mut self, length: u64) -> Result<Value<'a>, String> {
        let start = self.at;
        let bytes = self.take(length)?;
        let text = std::str::from_utf8(bytes);
        text.map(Value::Text).map_err(|e| format!("byte {start}: a text is no UTF-8: {e}"))
    }

    fn skip(&mut self, length: u64) -> Result<Value<'a>, String> {
        self.take(length).map(|_| Value::Other)
    }

    /// An unsigned number, its most significant byte first.
    fn number(&mut self, bytes: u64) -> Result<u64, String> {
        Ok(self.take(bytes)?.iter().fold(0, |number, &byte| number << 8 | u64::from(byte)))
    }

    fn take(&mut self, length: u64) -> Result<&'a [u8], String> {
        let left = &self.bytes[self.at..];
        let found = usize::try_from(length).ok().and_then(|length| left.get(..length));
        let taken = found.ok_or_else(|| {
            format!("byte {}: {length} bytes are wanted, {} are left", self.at, left.len())
        })?;
        self.at += taken.len();
        Ok(taken)
    }
}
