//! Reading a certificate and its key, also again while the server runs.

use std::fmt::Display;
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::time::SystemTime;

use parking_lot::Mutex;
use rustls::ServerConfig;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio::net::TcpStream;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;

use super::certificate::expiry;
use super::{TlsError, TlsFiles};

impl TlsFiles {
    /// Reads both files as a server does, and returns when the server's certificate expires.
    ///
    /// # Errors
    /// Names the file that cannot be used.
    pub fn check(&self) -> Result<SystemTime, TlsError> {
        read(self)?;
        let expires = certificates(self)?.first().and_then(|certificate| expiry(certificate));
        let reason = "when the certificate expires cannot be read".to_owned();
        expires.ok_or(TlsError { path: self.cert.clone(), reason })
    }
}

/// Accepts connections with the certificate that was read last.
pub(crate) struct Tls {
    files: TlsFiles,
    acceptor: Mutex<TlsAcceptor>,
}

impl Tls {
    /// Reads the files.
    ///
    /// # Errors
    /// Names the file that cannot be used.
    pub(crate) fn load(files: TlsFiles) -> Result<Arc<Self>, TlsError> {
        let acceptor = Mutex::new(read(&files)?);
        Ok(Arc::new(Self { files, acceptor }))
    }

    /// Does the handshake of a connection.
    ///
    /// # Errors
    /// The client and the server do not agree, or the connection ends.
    pub(crate) async fn accept(&self, tcp: TcpStream) -> io::Result<TlsStream<TcpStream>> {
        let acceptor = self.acceptor.lock().clone();
        acceptor.accept(tcp).await
    }

    /// Reads the files again. Existing connections keep their certificate. If the new files cannot
    /// be used, the old ones stay.
    pub(crate) fn read_again(&self) {
        match read(&self.files) {
            // The files are read before the lock is taken, so that no handshake waits for the disk.
            Ok(acceptor) => {
                *self.acceptor.lock() = acceptor;
                tracing::info!(cert = %self.files.cert.display(), "read the certificate again");
            }
            Err(error) => tracing::error!("the old certificate stays: {error}"),
        }
    }
}

fn wrong(path: &Path, reason: &dyn Display) -> TlsError {
    TlsError { path: path.to_owned(), reason: reason.to_string() }
}

/// The certificates of a file, at least one.
fn certificates(files: &TlsFiles) -> Result<Vec<CertificateDer<'static>>, TlsError> {
    let certificates = CertificateDer::pem_file_iter(&files.cert)
        .and_then(Iterator::collect::<Result<Vec<_>, _>>)
        .map_err(|error| wrong(&files.cert, &error))?;
    if certificates.is_empty() {
        return Err(wrong(&files.cert, &"there is no certificate in PEM in it"));
    }
    Ok(certificates)
}

fn read(files: &TlsFiles) -> Result<TlsAcceptor, TlsError> {
    let certificates = certificates(files)?;
    let key =
        PrivateKeyDer::from_pem_file(&files.key).map_err(|error| wrong(&files.key, &error))?;
    // One provider is named, because a program may have several.
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let config = ServerConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .map_err(|error| wrong(&files.cert, &error))?
        .with_no_client_auth()
        .with_single_cert(certificates, key)
        .map_err(|error| wrong(&files.key, &error))?;
    Ok(TlsAcceptor::from(Arc::new(config)))
}
