//! Stands for `files` in a build without the feature `tls`.

use std::io;
use std::sync::Arc;
use std::time::SystemTime;

use tokio::net::TcpStream;

use super::{TlsError, TlsFiles};

impl TlsFiles {
    /// In the place of the check of the files, in a build without `tls`.
    ///
    /// # Errors
    /// Always: it says what to build.
    pub fn check(&self) -> Result<SystemTime, TlsError> {
        let reason = "built without `tls`: cargo build --release --features full".to_owned();
        Err(TlsError { path: self.cert.clone(), reason })
    }
}

/// Accepts connections: there are none with TLS in this build.
pub(crate) enum Tls {}

impl Tls {
    /// # Errors
    /// Always, as [`TlsFiles::check`] has them.
    pub(crate) fn load(files: TlsFiles) -> Result<Arc<Self>, TlsError> {
        Err(match files.check() {
            Err(error) => error,
            Ok(_) => TlsError { path: files.cert, reason: "it cannot be used".to_owned() },
        })
    }

    pub(crate) async fn accept(&self, _: TcpStream) -> io::Result<TcpStream> {
        match *self {}
    }

    pub(crate) fn read_again(&self) {
        match *self {}
    }
}
