//! Hashes a file while it is read.

use std::io::{self, Read};

use super::StopFlag;

/// A reader that hashes what passes through it, and fails once reading is to stop.
pub(super) struct HashReader<R> {
    inner: R,
    hasher: blake3::Hasher,
    stop: StopFlag,
}

impl<R> HashReader<R> {
    /// Nothing has been read yet.
    pub(super) fn new(inner: R, stop: StopFlag) -> Self {
        Self { inner, hasher: blake3::Hasher::new(), stop }
    }

    /// BLAKE3 of everything that was read, 64 lower-case hex digits.
    pub(super) fn finish(&self) -> String {
        self.hasher.finalize().to_hex().to_string()
    }
}

impl<R: Read> Read for HashReader<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        self.stop.check().map_err(io::Error::other)?;
        let read = self.inner.read(buffer)?;
        self.hasher.update(&buffer[..read]);
        Ok(read)
    }
}
