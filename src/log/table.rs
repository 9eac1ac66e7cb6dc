//! A table of JSON lines, row by row.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::marker::PhantomData;
use std::path::{Path, PathBuf};

use crate::error::{FieldError, LogError};
use crate::limits;
use crate::row::Row;

/// The rows of a table in order of time, each checked. After an error there are no more.
#[derive(Debug)]
pub struct Rows<R> {
    path: PathBuf,
    lines: BufReader<File>,
    /// The text of the line that is read, kept so that a row allocates nothing.
    text: Vec<u8>,
    line: usize,
    order: Order,
    is_done: bool,
    row: PhantomData<R>,
}

impl<R: Row> Rows<R> {
    pub(crate) fn open(path: &Path) -> Result<Self, LogError> {
        let file = File::open(path).map_err(|error| LogError::file(path, &error))?;
        Ok(Self {
            path: path.to_owned(),
            lines: BufReader::with_capacity(1 << 16, file),
            text: Vec::new(),
            line: 0,
            order: Order::default(),
            is_done: false,
            row: PhantomData,
        })
    }

    /// Reads the next line into `text`; false at the end of the file.
    fn read_line(&mut self) -> Result<bool, LogError> {
        self.text.clear();
        self.line += 1;
        // One byte more than a row may have tells a line that is too long from one that just fits.
        let mut limited = (&mut self.lines).take(limits::LINE_BYTES + 1);
        let read = limited.read_until(b'\n', &mut self.text);
        read.map_err(|error| LogError::file(&self.path, &error))?;
        if self.text.len() as u64 > limits::LINE_BYTES {
            let reason = format!("longer than {} bytes; a row has one line", limits::LINE_BYTES);
            return Err(self.refused(FieldError::new("", reason)));
        }
        Ok(!self.text.is_empty())
    }

    fn next_row(&mut self) -> Result<Option<R>, LogError> {
        while self.read_line()? {
            if !self.text.trim_ascii().is_empty() {
                let row = parse(&self.text).map_err(|error| self.refused(error))?;
                let checked = R::check(&row).and_then(|()| self.order.add(&row));
                checked.map_err(|error| self.refused(error))?;
                return Ok(Some(row));
            }
        }
        Ok(None)
    }

    fn refused(&self, FieldError { field, reason }: FieldError) -> LogError {
        let path = self.path.clone();
        let field = if field.is_empty() { field } else { format!("{field}: ") };
        LogError::Row { path, line: self.line, field, reason }
    }
}

impl<R: Row> Iterator for Rows<R> {
    type Item = Result<R, LogError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.is_done {
            return None;
        }
        let row = self.next_row().transpose();
        // After a line that is too long, the next read would begin in the middle of it.
        self.is_done = !matches!(row, Some(Ok(_)));
        row
    }
}

/// Opens a file of lines, which has at most `limit` bytes, to be read one by one.
///
/// # Errors
/// The file cannot be opened, or is larger.
pub fn open_lines(path: &Path, limit: u64) -> Result<impl BufRead, LogError> {
    let opened = File::open(path).and_then(|file| Ok((file.metadata()?.len(), file)));
    let (length, file) = opened.map_err(|error| LogError::file(path, &error))?;
    if length > limit {
        return Err(LogError::malformed(path, format!("{length} bytes; at most {limit} are read")));
    }
    Ok(BufReader::with_capacity(1 << 16, file))
}

fn parse<R: Row>(text: &[u8]) -> Result<R, FieldError> {
    let mut deserializer = serde_json::Deserializer::from_slice(text);
    serde_path_to_error::deserialize(&mut deserializer).map_err(|error| {
        let path = error.path().to_string();
        // The path of the whole line is a dot.
        FieldError::new(path.trim_start_matches('.'), json_reason(error.inner()))
    })
}

/// What serde says, without the line and the column, which are those of one row.
pub(crate) fn json_reason(error: &serde_json::Error) -> String {
    let text = error.to_string();
    text.split_once(" at line ").map_or(text.as_str(), |(reason, _)| reason).to_owned()
}

/// The times of the rows so far.
#[derive(Debug, Default)]
pub(crate) struct Order {
    last_us: Option<i64>,
    /// The last time of each camera, LiDAR or track.
    by_key: BTreeMap<String, i64>,
}

impl Order {
    /// Adds a row. It may not be before the last one, and two rows of a camera, a LiDAR or a track
    /// have different times; of a table without these, any two rows.
    pub(crate) fn add<R: Row>(&mut self, row: &R) -> Result<(), FieldError> {
        let time_us = row.time_us();
        if let Some(last_us) = self.last_us.filter(|last_us| time_us < *last_us) {
            let reason = format!(
                "{time_us} is before that of the row above, {last_us}; sort the rows by time"
            );
            return Err(FieldError::new("time_us", reason));
        }
        // Rows of different cameras may have one time; two of one camera would be the same image
        // twice.
        let before_us = match row.key() {
            None => self.last_us,
            Some(key) => self.last_key_us(key, time_us),
        };
        self.last_us = Some(time_us);
        if before_us == Some(time_us) {
            let what = row.key().map_or("the table".to_owned(), |key| format!("{key:?}"));
            let reason = format!("{what} has two rows at {time_us}; give one");
            return Err(FieldError::new("time_us", reason));
        }
        Ok(())
    }

    /// Stores the time of a key, and returns the one before.
    fn last_key_us(&mut self, key: &str, time_us: i64) -> Option<i64> {
        match self.by_key.get_mut(key) {
            Some(last_us) => Some(std::mem::replace(last_us, time_us)),
            None => {
                self.by_key.insert(key.to_owned(), time_us);
                None
            }
        }
    }
}
