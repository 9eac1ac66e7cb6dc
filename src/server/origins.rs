//! Checks which web pages may send requests, and which host names are accepted.
//!
//! A page of any site can send requests to 127.0.0.1, and browsers name the site of the page in
//! `Origin`. A site can also make its own host name resolve to 127.0.0.1 (DNS rebinding): requests
//! of its pages then have no foreign `Origin`, but this name as `Host`. Programs send no `Origin`.

use std::net::IpAddr;

use axum::http::{HeaderMap, HeaderValue, Uri, header};

use crate::fault::Fault;

/// The pages of other sites that are served, as browsers send them: without the scheme's own port.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Origins(Vec<String>);

/// An origin that cannot be used.
#[derive(Debug, thiserror::Error)]
#[error(
    "{origin:?} is no origin: expected http:// or https:// and a host, as https://sim.example.org:8443"
)]
pub struct OriginError {
    origin: String,
}

impl Origins {
    /// Origins: scheme, host and port. Browsers leave out the scheme's own port, and so does the
    /// list.
    ///
    /// # Errors
    /// Names the first one that no browser would send.
    pub fn new(origins: Vec<String>) -> Result<Self, OriginError> {
        // The text must be exactly what a browser sends, because `lists` compares bytes.
        let is_origin = |origin: &str| {
            let uri: Result<Uri, _> = origin.parse();
            let Ok(uri) = uri else { return false };
            let scheme = uri.scheme_str().filter(|scheme| ["http", "https"].contains(scheme));
            // Only an authority, and no user in it.
            let plain =
                scheme.zip(uri.authority()).map(|(scheme, host)| format!("{scheme}://{host}"));
            plain.is_some_and(|plain| plain == origin && !plain.contains('@'))
                && origin.to_ascii_lowercase() == origin
        };
        match origins.iter().find(|origin| !is_origin(origin)) {
            Some(origin) => Err(OriginError { origin: origin.clone() }),
            None => Ok(Self(origins.into_iter().map(without_own_port).collect())),
        }
    }

    /// Whether a page of another site is listed.
    pub(crate) fn lists(&self, origin: &[u8]) -> bool {
        self.0.iter().any(|listed| listed.as_bytes() == origin)
    }

    /// Refuses requests of pages that are neither local, nor listed, nor from this server itself.
    /// The last exception applies only to servers with tokens, because a foreign page has no token.
    ///
    /// # Errors
    /// [`Fault::ForbiddenOrigin`].
    pub(crate) fn check_page(
        &self,
        headers: &HeaderMap,
        has_tokens: bool,
        host: Option<&str>,
    ) -> Result<(), Fault> {
        // Programs send none. Browsers send one with each request that may change something, or
        // whose answer a page can read.
        let Some(origin) = headers.get(header::ORIGIN) else {
            // An image, a script or a frame in a page of another site comes without: the page
            // cannot read the answer, but could make the server work for it.
            return match headers.get("sec-fetch-site").map(HeaderValue::as_bytes) {
                Some(b"cross-site") => {
                    Err(Fault::ForbiddenOrigin { origin: "a page of another site".to_owned() })
                }
                _ => Ok(()),
            };
        };
        // An origin that is no text is neither local nor own, and is refused below.
        let text = origin.to_str().unwrap_or_default();
        let authority = text.split_once("://").map(|(_, authority)| authority);
        // Without tokens this would admit rebound names: there `Origin` and `Host` agree, too.
        let is_own = has_tokens && authority.is_some() && authority == host;
        if is_local_origin(text) || self.lists(origin.as_bytes()) || is_own {
            return Ok(());
        }
        let origin = String::from_utf8_lossy(origin.as_bytes()).into_owned();
        Err(Fault::ForbiddenOrigin { origin })
    }

    /// Refuses requests for other hosts. Without tokens, and with a list of origins, the host must
    /// be this machine or in the list; with tokens it may also be an address, which no site can
    /// rebind. A server with tokens and without a list accepts all hosts, because its names are not
    /// configured.
    ///
    /// # Errors
    /// [`Fault::ForbiddenHost`].
    pub(crate) fn check_host(&self, has_tokens: bool, host: Option<&str>) -> Result<(), Fault> {
        // HTTP/1.0 has no host. No browser speaks it.
        let Some(host) = host else { return Ok(()) };
        // The scheme of the request is unknown behind a proxy, so the port is compared under the
        // scheme of each listed origin.
        let listed = |origin: &String| {
            let scheme = origin.split_once("://").map_or("", |(scheme, _)| scheme);
            without_own_port(format!("{scheme}://{host}")) == *origin
        };
        let is_address =
            has_tokens && host_name(host).trim_matches(['[', ']']).parse::<IpAddr>().is_ok();
        // A rebound name does no harm then: the page has no token to send.
        let knows_none = has_tokens && self.0.is_empty();
        if knows_none || is_address || is_local_authority(host) || self.0.iter().any(listed) {
            return Ok(());
        }
        let served = if has_tokens {
            "the hosts of --origin, addresses and localhost"
        } else {
            "localhost and the hosts of --origin (the server has no tokens)"
        };
        Err(Fault::ForbiddenHost { host: host.to_owned(), served })
    }
}

/// An origin without the port of its scheme.
fn without_own_port(origin: String) -> String {
    let port = if origin.starts_with("https:") { ":443" } else { ":80" };
    origin.strip_suffix(port).map(str::to_owned).unwrap_or(origin)
}

/// Whether an origin is a page served from this machine.
pub(crate) fn is_local_origin(origin: &str) -> bool {
    // Only the schemes of web pages: an application may register any other.
    origin.split_once("://").is_some_and(|(scheme, authority)| {
        ["http", "https"].contains(&scheme) && is_local_authority(authority)
    })
}

/// Whether a host, with or without a port, is this machine.
fn is_local_authority(authority: &str) -> bool {
    let host = host_name(authority);
    host.eq_ignore_ascii_case("localhost") || ["127.0.0.1", "[::1]"].contains(&host)
}

/// A host without its port.
fn host_name(authority: &str) -> &str {
    match authority.rsplit_once(':') {
        // The last colon, because an IPv6 address has more of them. In `[::1]` it is followed by
        // `1]`, which are not only digits.
        Some((host, port)) if port.bytes().all(|b| b.is_ascii_digit()) => host,
        _ => authority,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn local_origins() {
        for origin in
            ["http://localhost", "http://127.0.0.1:8080", "https://[::1]:1", "http://[::1]"]
        {
            assert!(is_local_origin(origin), "{origin}");
        }
        for origin in [
            "null",
            "evil://localhost",
            "http://example.org",
            // Names that only begin, contain or end like a local one, and users that look like a
            // host.
            "http://localhost.example.org",
            "http://127.0.0.1.example.org:80",
            "http://example.org:127",
            "http://user@example.org",
            "http://localhost:80@example.org",
        ] {
            assert!(!is_local_origin(origin), "{origin}");
        }
    }

    #[test]
    fn pages_are_local_listed_or_own() {
        let origins = Origins::new(vec!["https://sim.example.org:8443".to_owned()]).unwrap();
        let is_served = |origin: &str, has_tokens: bool| {
            let headers = HeaderMap::from_iter([(header::ORIGIN, origin.parse().unwrap())]);
            origins.check_page(&headers, has_tokens, Some("10.1.2.3:8080")).is_ok()
        };
        for (origin, without_tokens, with_tokens) in [
            ("http://localhost:5173", true, true),
            ("https://sim.example.org:8443", true, true),
            ("http://10.1.2.3:8080", false, true),
            ("https://sim.example.org", false, false),
            ("http://sim.example.org:8443", false, false),
            ("null", false, false),
        ] {
            assert_eq!(is_served(origin, false), without_tokens, "{origin}");
            assert_eq!(is_served(origin, true), with_tokens, "{origin}");
        }
    }

    #[test]
    fn an_image_in_a_page_of_another_site_is_refused() {
        let is_served = |site: &str| {
            let headers =
                HeaderMap::from_iter([("sec-fetch-site".parse().unwrap(), site.parse().unwrap())]);
            [false, true]
                .map(|tokens| Origins::default().check_page(&headers, tokens, None).is_ok())
        };
        assert_eq!(is_served("cross-site"), [false; 2]);
        // An address that was typed, and pages of this machine.
        for site in ["none", "same-origin", "same-site"] {
            assert_eq!(is_served(site), [true; 2], "{site}");
        }
    }

    #[test]
    fn hosts_are_local_listed_or_addresses() {
        let listed = Origins::new(vec!["https://sim.example.org".to_owned()]).unwrap();
        let none = Origins::default();
        // Columns: neither tokens nor list, a list, tokens, both.
        for (host, open, with_list, with_tokens, with_both) in [
            ("localhost:8080", true, true, true, true),
            ("[::1]:8080", true, true, true, true),
            ("sim.example.org", false, true, true, true),
            ("10.1.2.3:8080", false, false, true, true),
            ("[fe80::1]:8080", false, false, true, true),
            ("evil.example.org", false, false, true, false),
            ("sim.example.org:443", false, true, true, true),
            ("sim.example.org:80", false, false, true, false),
        ] {
            let is_served =
                |origins: &Origins, tokens| origins.check_host(tokens, Some(host)).is_ok();
            let found = [(&none, false), (&listed, false), (&none, true), (&listed, true)]
                .map(|(o, t)| is_served(o, t));
            assert_eq!(found, [open, with_list, with_tokens, with_both], "{host}");
        }
    }

    #[test]
    fn the_port_of_the_scheme_is_left_out_as_browsers_do() {
        for (given, sent) in [
            ("https://a.org:443", "https://a.org"),
            ("http://a.org:80", "http://a.org"),
            ("https://a.org:80", "https://a.org:80"),
            ("http://a.org:443", "http://a.org:443"),
            ("https://a.org:8443", "https://a.org:8443"),
        ] {
            let origins = Origins::new(vec![given.to_owned()]).unwrap();
            assert!(origins.lists(sent.as_bytes()), "{given}");
        }
    }

    #[test]
    fn an_origin_is_what_a_browser_sends() {
        for wrong in [
            "sim.example.org",
            "https://sim.example.org/",
            "ftp://a",
            "https://A.org",
            "https://u@a.org",
            "*",
            "",
        ] {
            assert!(Origins::new(vec![wrong.to_owned()]).is_err(), "{wrong}");
        }
    }
}
