//! Hashes a file while it is read.

use std::io::{self, Read};

/// A reader that hashes what passes through it.
pub(super) struct HashReader<R> {
    inner: R,
    hasher: blake3::Hasher,
}

impl<R> HashReader<R> {
    /// Nothing has been read yet.
    pub(super) fn new(inner: R) -> Self {
        Self { inner, hasher: blake3::Hasher::new() }
    }

    /// BLAKE3 of everything that was read, 64 lower-case hex digits.
    pub(super) fn finish(&self) -> String {
        self.hasher.finalize().to_hex().to_string()
    }
}

impl<R: Read> Read for HashReader<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.inner.read(buffer)?;
        self.hasher.update(&buffer[..read]);
        Ok(read)
    }
}
