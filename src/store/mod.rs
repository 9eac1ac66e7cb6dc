//! Twins on disk.
