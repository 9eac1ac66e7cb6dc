//! Reports how much of a file has been read.

use std::io::{self, BufRead, Read};

/// Is called with the number of bytes that have been read and the size of the file.
pub type Progress<'a> = &'a mut dyn FnMut(u64, u64);

/// A reader that reports its progress after every [`REPORT_EVERY_BYTES`], and at the end.
pub(super) struct ProgressReader<'a, R> {
    inner: R,
    done: u64,
    reported: u64,
    file_bytes: u64,
    progress: Progress<'a>,
}

/// Bytes between two reports.
const REPORT_EVERY_BYTES: u64 = 1 << 20;

impl<'a, R> ProgressReader<'a, R> {
    /// Reads a file of a known size.
    pub(super) fn new(inner: R, file_bytes: u64, progress: Progress<'a>) -> Self {
        Self { inner, done: 0, reported: 0, file_bytes, progress }
    }

    fn add(&mut self, bytes: usize) {
        self.done += bytes as u64;
        if self.done - self.reported >= REPORT_EVERY_BYTES || self.done == self.file_bytes {
            self.reported = self.done;
            (self.progress)(self.done, self.file_bytes);
        }
    }
}

impl<R: Read> Read for ProgressReader<'_, R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.inner.read(buffer)?;
        self.add(read);
        Ok(read)
    }
}

impl<R: BufRead> BufRead for ProgressReader<'_, R> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        self.inner.fill_buf()
    }

    fn consume(&mut self, bytes: usize) {
        self.inner.consume(bytes);
        self.add(bytes);
    }
}
