//! Clients that follow no redirect to another host.
//!
//! A store decides what its answers are, and not where else this machine sends requests: a redirect
//! could lead to services that only this machine reaches.

use std::time::Duration;

use object_store::client::{HttpClient, HttpConnector};
use object_store::{ClientConfigKey, ClientOptions};
use reqwest::redirect::{Attempt, Policy};
use reqwest::{Client, NoProxy, Proxy, Url};

use crate::limits;

/// Makes the clients of a store.
#[derive(Debug)]
pub(super) struct SameHost;

impl HttpConnector for SameHost {
    /// A client with the options that the environment may set: `*_ALLOW_HTTP`,
    /// `*_ALLOW_INVALID_CERTIFICATES`, `*_PROXY_URL` and `*_PROXY_EXCLUDES`.
    fn connect(&self, options: &ClientOptions) -> object_store::Result<HttpClient> {
        use ClientConfigKey::{AllowHttp, AllowInvalidCertificates, ProxyExcludes, ProxyUrl};
        for key in UNSUPPORTED {
            let is_default =
                options.get_config_value(key) == ClientOptions::default().get_config_value(key);
            if !is_default {
                let reason = format!("the option {} is not supported", key.as_ref());
                return Err(failed(reason));
            }
        }
        let value = |key| options.get_config_value(&key);
        let is_set = |key| value(key).as_deref() == Some("true");
        let mut builder = Client::builder()
            .user_agent(concat!("wildcity/", env!("CARGO_PKG_VERSION")))
            .redirect(Policy::custom(follow))
            // One of 30 s would end a request before `retry.rs` does.
            .timeout(limits::REMOTE_TIMEOUT)
            .connect_timeout(CONNECT_TIMEOUT)
            .https_only(!is_set(AllowHttp))
            .danger_accept_invalid_certs(is_set(AllowInvalidCertificates))
            // Or the lengths of objects would not be those of their bodies.
            .no_gzip()
            .no_brotli()
            .no_zstd()
            .no_deflate();
        if let Some(url) = value(ProxyUrl) {
            let excludes = value(ProxyExcludes).and_then(|hosts| NoProxy::from_string(&hosts));
            builder = builder.proxy(Proxy::all(url).map_err(failed)?.no_proxy(excludes));
        }
        builder.build().map(HttpClient::new).map_err(failed)
    }
}

/// Options that would have no effect here.
const UNSUPPORTED: &[ClientConfigKey] = &[
    ClientConfigKey::Http1Only,
    ClientConfigKey::Http2Only,
    ClientConfigKey::NoSystemCertificates,
    ClientConfigKey::ProxyCaCertificate,
];

/// How long a connection may take.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

/// Redirects of one request, all of them to the same host.
const REDIRECTS: usize = 4;

fn failed(error: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> object_store::Error {
    object_store::Error::Generic { store: "object store", source: error.into() }
}

fn follow(attempt: Attempt<'_>) -> reqwest::redirect::Action {
    let place = |url: &Url| {
        let host = url.host_str().map(str::to_owned);
        (url.scheme().to_owned(), host, url.port_or_known_default())
    };
    let target = place(attempt.url());
    let is_same = attempt.previous().first().is_some_and(|first| place(first) == target);
    if is_same && attempt.previous().len() <= REDIRECTS {
        return attempt.follow();
    }
    let reason = format!(
        "the store redirects to {}, which is another place: name that one",
        attempt.url().origin().ascii_serialization()
    );
    attempt.error(reason)
}
