//! Why a scenario, a tracks file or a map was refused.

/// A mistake in a file: where it is, what is wrong, and what to write instead.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{path}: {message}")]
pub struct FileError {
    /// The place in the file, such as `actors[2].idm.speed`; a line for XML.
    pub path: String,
    /// The error, and the accepted values.
    pub message: String,
}

impl FileError {
    /// A mistake at `path`.
    pub fn new(path: impl Into<String>, message: impl Into<String>) -> Self {
        Self { path: path.into(), message: message.into() }
    }

    /// This mistake within an outer object.
    pub(crate) fn within(self, outer: &str) -> Self {
        // A path within a list begins with its index, without a dot.
        let separator = if self.path.starts_with('[') || self.path.is_empty() { "" } else { "." };
        Self { path: format!("{outer}{separator}{}", self.path), message: self.message }
    }
}

/// Reads JSON as a type; the error names the path within it, from `root` on.
pub(crate) fn typed<T: serde::de::DeserializeOwned>(
    value: serde_json::Value,
    root: &str,
) -> Result<T, FileError> {
    serde_path_to_error::deserialize(value).map_err(|error| {
        let path = error.path().to_string();
        let message = error.into_inner().to_string();
        match path.as_str() {
            // The root of the value itself. `serde_path_to_error` writes it as a dot.
            "." => FileError::new(root, message),
            _ => FileError::new(path, message),
        }
    })
}

/// Parses JSON text of at most `limit_bytes`.
pub(crate) fn json(
    bytes: &[u8],
    root: &str,
    limit_bytes: usize,
) -> Result<serde_json::Value, FileError> {
    if bytes.len() > limit_bytes {
        let message = format!("{} bytes; at most {limit_bytes} are accepted", bytes.len());
        return Err(FileError::new(root, message));
    }
    serde_json::from_slice(bytes).map_err(|error| {
        FileError::new(root, format!("not JSON: {error}; correct the syntax there"))
    })
}

/// Checks the field `format` of a file.
///
/// # Errors
/// It is another format, or absent.
pub fn check_format(found: Option<&str>, wanted: &str) -> Result<(), FileError> {
    if found == Some(wanted) {
        return Ok(());
    }
    let found = found.map_or("it is absent".to_owned(), |found| format!("{found:?}"));
    Err(FileError::new("format", format!("{found}; write {wanted:?}")))
}

/// Checks that a number is within bounds; NaN is not.
pub(crate) fn in_range(path: &str, value: f64, [least, most]: [f64; 2]) -> Result<f64, FileError> {
    let accepted = (least..=most).contains(&value);
    if accepted {
        return Ok(value);
    }
    Err(FileError::new(path, format!("{value:?}; {least:?} to {most:?} is accepted")))
}

/// Checks a name: 1 to 64 of `a-z 0-9 . _ -`, not starting with a dot.
pub(crate) fn named(path: &str, name: &str) -> Result<(), FileError> {
    if wildcity_scene::rig::is_name(name) {
        return Ok(());
    }
    let message =
        format!("{name:?} is no name: use 1 to 64 of a-z 0-9 . _ - that do not start with a dot");
    Err(FileError::new(path, message))
}

/// Checks a BLAKE3 hash: 64 lower-case hex digits.
pub(crate) fn hashed(path: &str, hash: &str) -> Result<(), FileError> {
    let is_hash = hash.len() == 64 && hash.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'));
    if is_hash {
        return Ok(());
    }
    Err(FileError::new(path, format!("{hash:?} is no BLAKE3 hash: write 64 lower-case hex digits")))
}

/// The known names for a message, or `none`.
pub(crate) fn listed<'a>(names: impl Iterator<Item = &'a str>) -> String {
    // Twenty names are enough to see a misspelling, and keep the message short.
    let names: Vec<&str> = names.take(20).collect();
    if names.is_empty() { "none".to_owned() } else { names.join(", ") }
}
