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
    /// `*_ALLOW_INVALID_CERTIFICATES`, `*_CONNECT_TIMEOUT`, `*_PROXY_URL` and `*_PROXY_EXCLUDES`.
    /// Others are refused if they ask for something else than this client does.
    fn connect(&self, options: &ClientOptions) -> object_store::Result<HttpClient> {
        use ClientConfigKey::{
            AllowHttp, AllowInvalidCertificates, ConnectTimeout, ProxyExcludes, ProxyUrl,
        };
        let defaults = ClientOptions::default();
        for key in UNSUPPORTED {
            let [value, default] = [options, &defaults].map(|all| all.get_config_value(key));
            let is_default = value == default
                || matches!((&value, &default), (Some(value), Some(default))
                    if boolean(value).is_some() && boolean(value) == boolean(default));
            if !is_default {
                return Err(failed(format!("the option {} is not supported", key.as_ref())));
            }
        }
        let value = |key| options.get_config_value(&key);
        let is_set = |key: ClientConfigKey| match value(key) {
            None => Ok(false),
            Some(text) => boolean(&text)
                .ok_or_else(|| failed(format!("{} is {text:?}, not true or false", key.as_ref()))),
        };
        let seconds = value(ConnectTimeout).map_or(Ok(CONNECT_S), |text| {
            let seconds = text.strip_suffix('s').and_then(|seconds| seconds.parse().ok());
            seconds.ok_or_else(|| failed(format!("connect_timeout is {text:?}, not as 5s")))
        })?;
        let mut builder = Client::builder()
            .user_agent(concat!("wildcity/", env!("CARGO_PKG_VERSION")))
            .redirect(Policy::custom(follow))
            // One of 30 s would end a request before `retry.rs` does.
            .timeout(limits::REMOTE_TIMEOUT)
            .connect_timeout(Duration::from_secs(seconds))
            // Slower with HTTP/2, for large objects.
            .http1_only()
            .https_only(!is_set(AllowHttp)?)
            .danger_accept_invalid_certs(is_set(AllowInvalidCertificates)?)
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
    ClientConfigKey::DefaultContentType,
    ClientConfigKey::Http1Only,
    ClientConfigKey::Http2KeepAliveInterval,
    ClientConfigKey::Http2KeepAliveTimeout,
    ClientConfigKey::Http2KeepAliveWhileIdle,
    ClientConfigKey::Http2MaxFrameSize,
    ClientConfigKey::Http2Only,
    ClientConfigKey::NoSystemCertificates,
    ClientConfigKey::PoolIdleTimeout,
    ClientConfigKey::PoolMaxIdlePerHost,
    ClientConfigKey::ProxyCaCertificate,
    ClientConfigKey::RandomizeAddresses,
    ClientConfigKey::ReadTimeout,
    ClientConfigKey::Timeout,
    ClientConfigKey::UserAgent,
];

/// How long a connection may take, in seconds.
const CONNECT_S: u64 = 5;

/// Redirects of one request, all of them to the same host.
const REDIRECTS: usize = 4;

/// True and false as `object_store` reads them from the environment.
fn boolean(text: &str) -> Option<bool> {
    match text.to_ascii_lowercase().as_str() {
        "1" | "true" | "on" | "yes" | "y" => Some(true),
        "0" | "false" | "off" | "no" | "n" => Some(false),
        _ => None,
    }
}

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
    if !is_same {
        let reason = format!(
            "the store redirects to {}, which is another place: name that one",
            attempt.url().origin().ascii_serialization()
        );
        return attempt.error(reason);
    }
    if attempt.previous().len() > REDIRECTS {
        return attempt.error(format!("the store redirects more than {REDIRECTS} times"));
    }
    attempt.follow()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_are_honoured_or_refused() {
        // As `url.rs` does. It fails if another test was first.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let with = |key: ClientConfigKey, value: &str| {
            SameHost.connect(&ClientOptions::default().with_config(key, value)).map(|_| ())
        };
        for value in ["1", "TRUE", "yes", "no", "0"] {
            with(ClientConfigKey::AllowHttp, value).unwrap();
        }
        with(ClientConfigKey::Http1Only, "1").unwrap();
        with(ClientConfigKey::ConnectTimeout, "2s").unwrap();
        for (key, value, said) in [
            (ClientConfigKey::AllowHttp, "maybe", "allow_http is \"maybe\""),
            (ClientConfigKey::Http1Only, "no", "http1_only is not supported"),
            (ClientConfigKey::PoolMaxIdlePerHost, "3", "pool_max_idle_per_host is not supported"),
            (ClientConfigKey::Timeout, "3s", "timeout is not supported"),
            (ClientConfigKey::ConnectTimeout, "2 minutes", "connect_timeout is"),
        ] {
            let error = with(key, value).unwrap_err().to_string();
            assert!(error.contains(said), "{key:?}={value}: {error}");
        }
        assert_eq!([boolean("On"), boolean("N"), boolean("")], [Some(true), Some(false), None]);
    }
}
