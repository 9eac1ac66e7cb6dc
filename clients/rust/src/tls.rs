//! TLS for both transports: rustls with the cryptography of ring.

use std::sync::Arc;

use rustls::crypto::ring;
use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject as _;
use rustls::{ClientConfig, RootCertStore};

/// A configuration that trusts the operating system's root certificates, and those in
/// `extra_roots_pem`.
///
/// # Errors
/// A text with the remedy: `extra_roots_pem` has no certificate or a damaged one, or there is no
/// root certificate.
pub(crate) fn client_config(extra_roots_pem: &[u8]) -> Result<ClientConfig, String> {
    let mut roots = RootCertStore::empty();
    add_pem_roots(&mut roots, extra_roots_pem)?;

    // Operating systems ship certificates that webpki rejects: those are skipped, as browsers do.
    let native = rustls_native_certs::load_native_certs();
    roots.add_parsable_certificates(native.certs);
    if roots.is_empty() {
        let cause = native.errors.first().map_or_else(String::new, |error| format!(" ({error})"));
        return Err(format!(
            "this system has no root certificates{cause}: install ca-certificates, set SSL_CERT_FILE, \
             or give root_certificates_pem"
        ));
    }
    config(roots)
}

/// A configuration that trusts no certificate, for connections without TLS.
pub(crate) fn no_roots_config() -> Result<ClientConfig, String> {
    config(RootCertStore::empty())
}

fn add_pem_roots(roots: &mut RootCertStore, pem: &[u8]) -> Result<(), String> {
    if pem.is_empty() {
        return Ok(());
    }
    for certificate in CertificateDer::pem_slice_iter(pem) {
        let certificate =
            certificate.map_err(|error| format!("root_certificates_pem is not PEM: {error}"))?;
        roots
            .add(certificate)
            .map_err(|error| format!("root_certificates_pem has a damaged certificate: {error}"))?;
    }
    if roots.is_empty() {
        return Err("root_certificates_pem holds no certificate".to_owned());
    }
    Ok(())
}

/// Name the cryptography provider, because rustls otherwise uses the default of the process, which
/// may not be set.
fn config(roots: RootCertStore) -> Result<ClientConfig, String> {
    let builder = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()
        .map_err(|error| error.to_string())?;
    Ok(builder.with_root_certificates(roots).with_no_client_auth())
}
