//! Paths of the parts of a twin below the root of a directory or an object store, and rules for
//! their names.

use std::path::PathBuf;

use crate::limits;

use super::StoreError;

/// The folder of assets of actors, in place of a twin's name; no twin can have it.
pub(super) const ACTORS: &str = ".actors";

/// The folder of a twin's log records.
pub(super) const LOG: &str = "log";

/// The folder of a twin's objects.
pub(super) const OBJECTS: &str = "objects";

/// The folder of the state of garbage collection.
pub(super) const COLLECTION: &str = "gc";

/// The folder of leases among a twin's side files.
pub(super) const LEASES: &str = "leases";

/// Path of a log record below the root. The number has ten digits, so that names sort as numbers
/// do.
pub(super) fn record_key(name: &str, number: u64) -> String {
    format!("{name}/{LOG}/{number:010}")
}

/// Ending of a side file that a process keeps locked while it uses the side file of the same name.
pub(super) const LOCK_ENDING: &str = ".lock";

/// Path of an object below the root.
pub(super) fn object_key(name: &str, hash: &str) -> String {
    // 256 folders, so that none of them has very many entries. The caller has checked the hash.
    format!("{name}/{OBJECTS}/{}/{hash}", &hash[..2])
}

/// The version numbers among the file names of a log, ascending.
pub(super) fn log_numbers(names: impl IntoIterator<Item = String>) -> Vec<u64> {
    let number = |entry: String| {
        let number: u64 = entry.parse().ok()?;
        // "1" and "+1" parse as numbers, too, but no commit wrote them.
        (format!("{number:010}") == entry).then_some(number)
    };
    let mut numbers: Vec<u64> = names.into_iter().filter_map(number).collect();
    numbers.sort_unstable();
    numbers
}

/// Whether a text is 64 lower-case hex digits, and so may become a file name.
pub(super) fn is_hash(text: &str) -> bool {
    // Upper-case digits would be a second name of the same object.
    text.len() == 64 && text.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'))
}

/// Whether a text is two lower-case hex digits, the name of a folder of objects.
pub(super) fn is_prefix(text: &str) -> bool {
    text.len() == 2 && text.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'))
}

/// Checks that a side file is small enough to be read again.
///
/// # Errors
/// [`StoreError::SideFileSize`].
pub(super) fn check_side_file(path: PathBuf, bytes: &[u8]) -> Result<(), StoreError> {
    let bytes = bytes.len() as u64;
    let limit = limits::SIDE_FILE_BYTES;
    if bytes > limit { Err(StoreError::SideFileSize { path, bytes, limit }) } else { Ok(()) }
}

/// Checks that bytes have a hash.
///
/// # Errors
/// Says which hash they have instead.
pub(super) fn check_hash(bytes: &[u8], hash: &str) -> Result<(), String> {
    let found = blake3::hash(bytes).to_hex();
    if found.as_str() == hash { Ok(()) } else { Err(format!("its bytes hash to {found}")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_that_a_commit_writes_are_versions() {
        // A version has ten digits with zeros in front, or more digits without.
        let names = ["0000000002", "10000000000", "1", "+1", "+000000003", "00000000004", "x"];
        assert_eq!(log_numbers(names.map(str::to_owned)), [2, 10_000_000_000]);
    }
}
