//! The object store that a URL names, and the credentials for it.

use std::sync::{Arc, Once};

use object_store::aws::AmazonS3Builder;
use object_store::azure::MicrosoftAzureBuilder;
use object_store::gcp::GoogleCloudStorageBuilder;
use object_store::path::Path as Key;
use object_store::{ObjectStore, RetryConfig};

use crate::store::StoreError;

use super::same_host::SameHost;

/// Opens the store of a URL, as `s3://bucket/twins`, with credentials and endpoints from the
/// environment: `AWS_*`, `GOOGLE_*`, `AZURE_*`. Also returns the prefix of its keys.
pub(super) fn open(url: &str) -> Result<(Arc<dyn ObjectStore>, Key), StoreError> {
    let refused = |reason: String| StoreError::Url { url: url.to_owned(), reason };
    let unknown = || refused("one of s3://, gs://, az://, and file:// is needed".to_owned());
    let (scheme, place) = url.split_once("://").ok_or_else(unknown)?;
    let (bucket, prefix) = place.split_once('/').unwrap_or((place, ""));
    if bucket.is_empty() {
        return Err(refused(format!("it names no bucket: give {scheme}://BUCKET/FOLDER")));
    }
    let prefix = Key::parse(prefix).map_err(|error| refused(error.to_string()))?;
    provide_tls();
    // Retries are made only in `retry.rs`.
    let retry = RetryConfig { max_retries: 0, ..RetryConfig::default() };
    let store: object_store::Result<Arc<dyn ObjectStore>> = match scheme {
        "s3" | "s3a" => AmazonS3Builder::from_env()
            .with_url(url)
            .with_retry(retry)
            .with_http_connector(SameHost)
            .build()
            .map(|store| Arc::new(store) as _),
        "gs" => GoogleCloudStorageBuilder::from_env()
            .with_url(url)
            .with_retry(retry)
            .with_http_connector(SameHost)
            .build()
            .map(|store| Arc::new(store) as _),
        "az" | "azure" | "abfs" | "abfss" => MicrosoftAzureBuilder::from_env()
            .with_url(url)
            .with_retry(retry)
            .with_http_connector(SameHost)
            .build()
            .map(|store| Arc::new(store) as _),
        _ => return Err(unknown()),
    };
    Ok((store.map_err(|error| refused(error.to_string()))?, prefix))
}

/// Selects ring as the cryptography of TLS, once. The default, aws-lc, would add more C code to the
/// build than all other dependencies together.
fn provide_tls() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        // This fails if the program has selected a provider already, which is used then.
        let _ = rustls::crypto::ring::default_provider().install_default();
    });
}
