//! A new log. Its folder appears when it is complete: until then it has another name.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use wildcity_scene::Rig;
use wildcity_sim::map::MapFile;

use crate::error::{FieldError, LogError};
use crate::header::Header;
use crate::row::Row;
use crate::table::Order;

/// Writes a log, row by row. Without [`LogWriter::finish`] nothing is left of it.
#[derive(Debug)]
pub struct LogWriter {
    /// Where the log will be.
    out: PathBuf,
    /// Where it is until then.
    partial: PathBuf,
    tables: BTreeMap<&'static str, Table>,
    is_finished: bool,
}

#[derive(Debug)]
struct Table {
    path: PathBuf,
    file: BufWriter<File>,
    order: Order,
    line: usize,
}

impl LogWriter {
    /// Begins a log in a folder that does not exist yet.
    ///
    /// # Errors
    /// The folder, or an unfinished one of the same name, exists or cannot be made; the header or
    /// the rig cannot be used.
    pub fn create(out: &Path, header: &Header, rig: &Rig) -> Result<Self, LogError> {
        let mut partial = out.as_os_str().to_owned();
        partial.push(".partial");
        let partial = PathBuf::from(partial);
        if let Some(path) = [out, &partial].into_iter().find(|path| path.exists()) {
            return Err(LogError::Exists { path: path.to_owned() });
        }
        let header_path = out.join("log.json");
        header.check().map_err(|FieldError { field, reason }| LogError::Field {
            path: header_path,
            field,
            reason,
        })?;
        rig.check().map_err(|cause| LogError::Rig { path: out.join("rig.json"), cause })?;
        fs::create_dir_all(&partial).map_err(|error| LogError::file(&partial, &error))?;
        let tables = BTreeMap::new();
        let writer = Self { out: out.to_owned(), partial, tables, is_finished: false };
        writer.put_json("log.json", header)?;
        writer.put_json("rig.json", rig)?;
        Ok(writer)
    }

    /// Adds a row to its table.
    ///
    /// # Errors
    /// The row cannot be used or is out of order, or the file cannot be written.
    pub fn add<R: Row>(&mut self, row: &R) -> Result<(), LogError> {
        // Not `entry().or_insert_with()`: making the file can fail.
        if !self.tables.contains_key(R::FILE) {
            self.tables.insert(R::FILE, Table::create(&self.partial.join(R::FILE))?);
        }
        match self.tables.get_mut(R::FILE) {
            Some(table) => table.add(row),
            None => Ok(()),
        }
    }

    /// Writes a file that a row names, such as an image.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn put(&self, name: &str, bytes: &[u8]) -> Result<(), LogError> {
        let path = self.partial.join(name);
        let folder = path.parent().unwrap_or(&self.partial);
        fs::create_dir_all(folder)
            .and_then(|()| fs::write(&path, bytes))
            .map_err(|error| LogError::file(&path, &error))
    }

    /// Writes the map.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn put_map(&self, map: &MapFile) -> Result<(), LogError> {
        self.put("map.json", map.to_json().as_bytes())
    }

    /// Completes the tables, and gives the folder its name.
    ///
    /// # Errors
    /// A file cannot be written, or the folder exists meanwhile.
    pub fn finish(mut self) -> Result<(), LogError> {
        for table in self.tables.values_mut() {
            table.file.flush().map_err(|error| LogError::file(&table.path, &error))?;
        }
        // A rename would replace an empty folder.
        if self.out.exists() {
            return Err(LogError::Exists { path: self.out.clone() });
        }
        // The rename is the last step: a process that ends before it leaves no folder that looks
        // complete.
        let renamed = fs::rename(&self.partial, &self.out);
        renamed.map_err(|error| LogError::file(&self.out, &error))?;
        self.is_finished = true;
        Ok(())
    }

    fn put_json(&self, name: &str, value: &impl serde::Serialize) -> Result<(), LogError> {
        let text = serde_json::to_string_pretty(value)
            .map_err(|error| LogError::malformed(&self.partial.join(name), error))?;
        self.put(name, format!("{text}\n").as_bytes())
    }
}

impl Drop for LogWriter {
    fn drop(&mut self) {
        if !self.is_finished {
            // The error that ended the log is the one to report.
            let _ = fs::remove_dir_all(&self.partial);
        }
    }
}

impl Table {
    fn create(path: &Path) -> Result<Self, LogError> {
        let file = File::create(path).map_err(|error| LogError::file(path, &error))?;
        let order = Order::default();
        Ok(Self { path: path.to_owned(), file: BufWriter::new(file), order, line: 0 })
    }

    fn add<R: Row>(&mut self, row: &R) -> Result<(), LogError> {
        self.line += 1;
        let checked = row.check().and_then(|()| self.order.add(row));
        checked.map_err(|FieldError { field, reason }| LogError::Row {
            path: self.path.clone(),
            line: self.line,
            field: format!("{field}: "),
            reason,
        })?;
        let text =
            serde_json::to_string(row).map_err(|error| LogError::malformed(&self.path, error))?;
        writeln!(self.file, "{text}").map_err(|error| LogError::file(&self.path, &error))
    }
}
