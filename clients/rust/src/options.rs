//! Options of a client in addition to the address of the server.

use std::fmt;

/// How a client authenticates, and which certificates it trusts.
///
/// By default it sends no token and trusts the root certificates of the operating system.
///
/// ```
/// use wildcity_client::ConnectOptions;
///
/// let options = ConnectOptions { token: Some("secret".into()), ..ConnectOptions::default() };
/// // The token is never printed.
/// assert!(!format!("{options:?}").contains("secret"));
/// ```
#[derive(Clone, Default)]
pub struct ConnectOptions {
    /// Bearer token, for a server that was started with tokens.
    pub token: Option<String>,
    /// Root certificates in PEM format that `wss://` and `https://` trust in addition to those of
    /// the operating system, for example that of a private certificate authority.
    pub root_certificates_pem: Vec<u8>,
    /// Whether observations arrive in memory that the server shares, instead of the socket. The
    /// server must run on this machine, in the same container and as the same user; otherwise
    /// connecting fails.
    pub shared_memory: bool,
}

impl ConnectOptions {
    /// The default options with a token, if there is one.
    pub fn with_token(token: Option<String>) -> Self {
        Self { token, ..Self::default() }
    }
}

/// Shows whether there is a token, and not the token.
impl fmt::Debug for ConnectOptions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let token = if self.token.is_some() { "hidden" } else { "none" };
        f.debug_struct("ConnectOptions")
            .field("token", &token)
            .field(
                "root_certificates_pem",
                &format_args!("{} bytes", self.root_certificates_pem.len()),
            )
            .field("shared_memory", &self.shared_memory)
            .finish()
    }
}
