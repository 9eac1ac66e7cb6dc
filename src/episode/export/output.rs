//! A writer that stores its first error and reports success to the crate `mcap`, which panics when
//! its writer is dropped after some errors, for example if the disk is full.
//! [`McapFile`](super::container::McapFile) returns the stored error.

use std::cell::Cell;
use std::io::{self, Seek, SeekFrom, Write};
use std::rc::Rc;

/// Where an output keeps its failure.
pub(super) type Failure = Rc<Cell<Option<io::Error>>>;

pub(super) struct Output<W> {
    inner: W,
    /// Position of the next byte.
    position: u64,
    has_failed: bool,
    failure: Failure,
}

impl<W> Output<W> {
    pub(super) fn new(inner: W, failure: Failure) -> Self {
        Self { inner, position: 0, has_failed: false, failure }
    }

    /// The value of a success; after a failure, `otherwise`.
    fn keep<T>(&mut self, done: io::Result<T>, otherwise: T) -> T {
        done.unwrap_or_else(|error| {
            // From now on `inner` is not called, so that no later error replaces this one.
            self.has_failed = true;
            self.failure.set(Some(error));
            otherwise
        })
    }
}

impl<W: Write> Write for Output<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if !self.has_failed {
            // All of the bytes, so that the success that mcap is told of is true until the first
            // error.
            let written = self.inner.write_all(bytes);
            self.keep(written, ());
        }
        // It advances after a failure as well: mcap computes the offsets of its index from
        // positions.
        self.position += bytes.len() as u64;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        if !self.has_failed {
            let flushed = self.inner.flush();
            self.keep(flushed, ());
        }
        Ok(())
    }
}

impl<W: Seek> Seek for Output<W> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let expected = match to {
            SeekFrom::Start(at) => at,
            // A file that was only appended to ends at the position. For all other seeks `inner`
            // knows better.
            SeekFrom::Current(by) => self.position.saturating_add_signed(by),
            SeekFrom::End(by) => self.position.saturating_add_signed(by),
        };
        self.position = if self.has_failed {
            expected
        } else {
            let sought = self.inner.seek(to);
            self.keep(sought, expected)
        };
        Ok(self.position)
    }
}
