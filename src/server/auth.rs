//! Who may do what: bearer tokens, with a role and the twins that they reach.
//!
//! A server without tokens listens on this machine alone, and whoever reaches it may do everything.

use std::collections::BTreeSet;
use std::sync::Arc;

use blake3::Hash;
use serde::Deserialize;
use sha2::{Digest as _, Sha256};

use super::fault::Fault;

/// What a token allows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// To open sessions.
    Drive,
    /// To upload and push.
    Push,
    /// Everything.
    Admin,
}

/// Whoever sends requests.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Grant {
    /// Of the token; empty where there are none.
    pub(super) name: String,
    role: Role,
    /// Twins that it sees; all if none is said.
    twins: Option<BTreeSet<String>>,
}

/// The tokens that a server knows.
#[derive(Clone, Debug)]
pub struct Tokens(Vec<Token>);

#[derive(Clone, Debug)]
struct Token {
    grant: Arc<Grant>,
    secret: Secret,
}

/// BLAKE3 of a token, or of the SHA-256 of one: neither can be turned back, and comparing two of
/// them takes the same time whatever they are.
#[derive(Clone, Debug)]
enum Secret {
    OfToken(Hash),
    OfSha256(Hash),
}

/// Why a file of tokens cannot be used. Says nothing of the tokens themselves.
#[derive(Debug, thiserror::Error)]
#[error("{place}: {reason}")]
pub struct TokensError {
    /// Where in the file, as `tokens[2].hash`.
    pub place: String,
    /// What is wrong, and what must hold instead.
    pub reason: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    tokens: Vec<Entry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    name: String,
    role: Role,
    token: Option<String>,
    hash: Option<String>,
    twins: Option<BTreeSet<String>>,
}

/// Shortest token that cannot be guessed: 16 characters of base64 are 96 bits.
const MIN_TOKEN_BYTES: usize = 16;

impl Tokens {
    /// Reads a file of tokens: `{"tokens": [{"name", "role", "token" or "hash", "twins"}]}`, where
    /// `hash` is `blake3:` or `sha-256:` and the hash of the token in hex.
    ///
    /// # Errors
    /// Names the first entry that cannot be used.
    pub fn parse(text: &[u8]) -> Result<Self, TokensError> {
        let wrong = |place: String, reason: &str| TokensError { place, reason: reason.to_owned() };
        let file: File = serde_json::from_slice(text).map_err(|error| {
            // serde's own words would repeat a token that stands where something else should.
            let place = format!("line {}, column {}", error.line(), error.column());
            wrong(place, "not {\"tokens\": [{\"name\", \"role\", \"token\" or \"hash\", ..}]}")
        })?;
        if file.tokens.is_empty() {
            return Err(wrong("tokens".to_owned(), "there is none: nobody could come in"));
        }
        let mut tokens: Vec<Token> = Vec::with_capacity(file.tokens.len());
        for (index, Entry { name, role, token, hash, twins }) in file.tokens.into_iter().enumerate()
        {
            // Sessions belong to the name.
            if name.is_empty() || tokens.iter().any(|other| other.grant.name == name) {
                let reason = "a name is not empty, and of one token only";
                return Err(wrong(format!("tokens[{index}].name"), reason));
            }
            let secret = match (token, hash) {
                (Some(token), None) if token.len() >= MIN_TOKEN_BYTES => {
                    Secret::OfToken(blake3::hash(token.as_bytes()))
                }
                (Some(_), None) => {
                    let reason = format!("a token has {MIN_TOKEN_BYTES} characters and more");
                    return Err(wrong(format!("tokens[{index}].token"), &reason));
                }
                (None, Some(hash)) => Secret::parse(&hash).ok_or_else(|| {
                    let reason = "expected blake3: or sha-256: and 64 hex digits";
                    wrong(format!("tokens[{index}].hash"), reason)
                })?,
                _ => {
                    let reason = "expected either token or hash";
                    return Err(wrong(format!("tokens[{index}]"), reason));
                }
            };
            tokens.push(Token { grant: Arc::new(Grant { name, role, twins }), secret });
        }
        Ok(Self(tokens))
    }

    /// What the value of an `Authorization` header allows.
    ///
    /// # Errors
    /// [`Fault::Unauthorized`]: there is none, or it is not known.
    pub(super) fn grant(&self, authorization: Option<&[u8]>) -> Result<Arc<Grant>, Fault> {
        let token = authorization.and_then(bearer).ok_or(Fault::Unauthorized)?;
        let of_token = blake3::hash(token);
        let of_sha256 = blake3::hash(&Sha256::digest(token));
        // All of them, however early one fits: time says nothing of which.
        let mut found = None;
        for Token { grant, secret } in &self.0 {
            let fits = match secret {
                Secret::OfToken(hash) => *hash == of_token,
                Secret::OfSha256(hash) => *hash == of_sha256,
            };
            if fits {
                found = Some(grant);
            }
        }
        found.cloned().ok_or(Fault::Unauthorized)
    }
}

impl Secret {
    fn parse(text: &str) -> Option<Self> {
        let (algorithm, hex) = text.split_once(':')?;
        let hash = Hash::from_hex(hex).ok()?;
        match algorithm {
            "blake3" => Some(Self::OfToken(hash)),
            "sha-256" => Some(Self::OfSha256(blake3::hash(hash.as_bytes()))),
            _ => None,
        }
    }
}

impl Grant {
    /// Of whoever reaches a server without tokens.
    pub(super) fn everything() -> Arc<Self> {
        Arc::new(Self { name: String::new(), role: Role::Admin, twins: None })
    }

    /// # Errors
    /// [`Fault::Forbidden`] if the token is of another role.
    pub(super) fn may(&self, role: Role) -> Result<(), Fault> {
        if self.role == role || self.role == Role::Admin {
            return Ok(());
        }
        let needs = role.name();
        Err(Fault::Forbidden { reason: format!("its role is {}, not {needs}", self.role.name()) })
    }

    /// # Errors
    /// [`Fault::Forbidden`] if the token does not reach the twin.
    pub(super) fn reaches(&self, twin: &str) -> Result<(), Fault> {
        if self.sees(twin) {
            return Ok(());
        }
        Err(Fault::Forbidden { reason: format!("it does not reach twin {twin:?}") })
    }

    /// Whether the twin is shown to it.
    pub(super) fn sees(&self, twin: &str) -> bool {
        self.twins.as_ref().is_none_or(|twins| twins.contains(twin))
    }
}

impl Role {
    fn name(self) -> &'static str {
        match self {
            Self::Drive => "drive",
            Self::Push => "push",
            Self::Admin => "admin",
        }
    }
}

/// The token of `Bearer TOKEN` (RFC 6750, section 2.1; the scheme has no case).
fn bearer(authorization: &[u8]) -> Option<&[u8]> {
    let (scheme, token) = authorization.split_at_checked("Bearer ".len())?;
    scheme.eq_ignore_ascii_case(b"Bearer ").then(|| token.trim_ascii())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_are_known_by_themselves_and_by_their_hashes() {
        let (blake3, sha256) = (blake3::hash(b"one"), Sha256::digest(b"two"));
        let sha256 = blake3::Hash::from_bytes(sha256.into());
        let text = format!(
            r#"{{"tokens": [
                {{"name": "a", "role": "drive", "hash": "blake3:{blake3}", "twins": ["street"]}},
                {{"name": "b", "role": "push", "hash": "sha-256:{sha256}"}},
                {{"name": "c", "role": "admin", "token": "0123456789abcdef"}}]}}"#
        );
        let tokens = Tokens::parse(text.as_bytes()).unwrap();
        let name = |header: &str| tokens.grant(Some(header.as_bytes())).map(|g| g.name.clone());
        assert_eq!(name("Bearer one").unwrap(), "a");
        assert_eq!(name("bearer two").unwrap(), "b");
        assert_eq!(name("Bearer 0123456789abcdef").unwrap(), "c");
        for bad in ["Bearer three", "one", "Basic one", "Bearer", "Bearer ", ""] {
            assert!(matches!(name(bad), Err(Fault::Unauthorized)), "{bad}");
        }
        assert!(matches!(tokens.grant(None), Err(Fault::Unauthorized)));
        // The hash of a token is none.
        assert!(name(&format!("Bearer {blake3}")).is_err());
        let grant = tokens.grant(Some(b"Bearer one")).unwrap();
        assert!(grant.may(Role::Drive).is_ok() && grant.may(Role::Push).is_err());
        assert!(grant.sees("street") && !grant.sees("road"));
    }

    #[test]
    fn a_file_of_tokens_is_refused_without_repeating_them() {
        for (text, place) in [
            (r#"{"tokens": []}"#, "tokens"),
            (
                r#"{"tokens": [{"name": "a", "role": "king", "token": "secretsecretsecret"}]}"#,
                "line",
            ),
            (r#"{"tokens": ["secretsecretsecret"]}"#, "line"),
            (
                r#"{"tokens": [{"name": "a", "role": "drive", "token": "secret"}]}"#,
                "tokens[0].token",
            ),
            (r#"{"tokens": [{"name": "a", "role": "drive"}]}"#, "tokens[0]"),
            (
                r#"{"tokens": [{"name": "", "role": "drive", "token": "secretsecretsecret"}]}"#,
                "tokens[0].name",
            ),
            (
                r#"{"tokens": [{"name": "a", "role": "drive", "token": "secretsecretsecret"},
                    {"name": "a", "role": "push", "token": "secretsecretsecrets"}]}"#,
                "tokens[1].name",
            ),
            (r#"{"tokens": [{"name": "a", "role": "drive", "hash": "secret"}]}"#, "tokens[0].hash"),
        ] {
            let error = Tokens::parse(text.as_bytes()).unwrap_err().to_string();
            assert!(error.starts_with(place) && !error.contains("secret"), "{error}");
        }
    }
}
