//! Certificate and key of the server, and reading them again while it runs.

use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use parking_lot::Mutex;
use rustls::ServerConfig;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::TlsAcceptor;

/// The files of a certificate and its key, in PEM.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TlsFiles {
    /// The server's certificate first, then those of the authorities between it and the root.
    pub cert: PathBuf,
    /// The key, in PKCS#8, PKCS#1 or SEC1.
    pub key: PathBuf,
}

/// Why a certificate or a key cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{}: {reason}", path.display())]
pub struct TlsError {
    /// The file.
    pub path: PathBuf,
    /// What is wrong with it.
    pub reason: String,
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

    pub(crate) fn acceptor(&self) -> TlsAcceptor {
        self.acceptor.lock().clone()
    }

    fn read_again(&self) {
        match read(&self.files) {
            Ok(acceptor) => {
                *self.acceptor.lock() = acceptor;
                tracing::info!(cert = %self.files.cert.display(), "read the certificate again");
            }
            Err(error) => tracing::error!("the old certificate stays: {error}"),
        }
    }
}

/// Reads the files again with every SIGHUP, until dropped. Connections that exist keep their certificate. If the new
/// files cannot be used, the old ones stay. From the call on, SIGHUP does not end the process.
pub(crate) fn reload(tls: Option<Arc<Tls>>) -> impl Future<Output = ()> + Send {
    #[cfg(unix)]
    let hangup = tls.is_some().then(|| {
        use tokio::signal::unix::{SignalKind, signal};
        signal(SignalKind::hangup())
    });
    async move {
        #[cfg(unix)]
        match (&tls, hangup) {
            (Some(tls), Some(Ok(mut hangup))) => {
                while hangup.recv().await.is_some() {
                    tls.read_again();
                }
            }
            (_, Some(Err(error))) => {
                tracing::error!("SIGHUP does not read the certificate again: {error}");
            }
            _ => {}
        }
        std::future::pending().await
    }
}

fn read(files: &TlsFiles) -> Result<TlsAcceptor, TlsError> {
    let wrong = |path: &Path, reason: &dyn Display| TlsError {
        path: path.to_owned(),
        reason: reason.to_string(),
    };
    let certificates = CertificateDer::pem_file_iter(&files.cert)
        .and_then(Iterator::collect::<Result<Vec<_>, _>>)
        .map_err(|error| wrong(&files.cert, &error))?;
    if certificates.is_empty() {
        return Err(wrong(&files.cert, &"there is no certificate in PEM in it"));
    }
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
