//! What is read, told to whoever waits for it.

use std::io::{self, BufRead, Read};

use super::Progress;

/// A reader that reports how far it is each time so many bytes have passed.
pub(super) struct ProgressReader<'a, R> {
    inner: R,
    done: u64,
    told: u64,
    file_bytes: u64,
    progress: Progress<'a>,
}

/// Bytes between two reports.
const REPORT_EVERY_BYTES: u64 = 1 << 20;

impl<'a, R> ProgressReader<'a, R> {
    /// Of a file of a known size.
    pub(super) fn new(inner: R, file_bytes: u64, progress: Progress<'a>) -> Self {
        Self { inner, done: 0, told: 0, file_bytes, progress }
    }

    fn add(&mut self, bytes: usize) {
        self.done += bytes as u64;
        if self.done - self.told >= REPORT_EVERY_BYTES || self.done == self.file_bytes {
            self.told = self.done;
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
