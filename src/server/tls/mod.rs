//! Certificate and key of the server.

#[cfg(feature = "tls")]
mod certificate;
#[cfg(feature = "tls")]
mod files;
#[cfg(not(feature = "tls"))]
#[path = "left_out.rs"]
mod files;

use std::path::PathBuf;

pub(crate) use files::Tls;

/// The files of a certificate and its key, in PEM.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TlsFiles {
    /// The server's certificate first, then the intermediate certificates.
    pub cert: PathBuf,
    /// The key, in PKCS#8, PKCS#1 or SEC1.
    pub key: PathBuf,
}

/// Why a certificate or a key cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{}: {reason}", path.display())]
pub struct TlsError {
    pub path: PathBuf,
    pub reason: String,
}
