//! The tokens that a server accepts, and the look-up of one.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use blake3::Hash;
use parking_lot::Mutex;
use sha2::{Digest as _, Sha256};

use super::error::TokensError;
use super::grant::{Grant, Role};
use crate::fault::Fault;

/// The tokens that a server accepts.
#[derive(Clone, Debug)]
pub struct Tokens {
    pub(super) tokens: Vec<Token>,
    /// The file that they were read from.
    pub(super) file: Option<PathBuf>,
}

/// The tokens of a running server, which can be read again.
#[derive(Debug)]
pub(crate) struct CurrentTokens(Mutex<Arc<Tokens>>);

#[derive(Clone, Debug)]
pub(super) struct Token {
    pub(super) grant: Arc<Grant>,
    pub(super) secret: Secret,
}

/// A hash of a token. It cannot be inverted, and comparing two hashes takes the same time whether
/// they are equal or not.
#[derive(Clone, Debug)]
pub(super) enum Secret {
    /// BLAKE3 of the token.
    OfToken(Hash),
    /// BLAKE3 of the token's SHA-256.
    OfSha256(Hash),
}

impl Tokens {
    /// Number of tokens that may upload.
    pub(crate) fn uploaders(&self) -> usize {
        self.tokens.iter().filter(|token| token.grant.has(Role::Push)).count()
    }

    /// Bytes that the uploads of a token may use, by name, for tokens with a limit of their own.
    pub(crate) fn upload_bytes(&self) -> BTreeMap<String, u64> {
        let limited = |token: &Token| {
            let bytes = token.grant.limits.upload_bytes?;
            Some((token.grant.name.clone(), bytes))
        };
        self.tokens.iter().filter_map(limited).collect()
    }

    /// The rights of the token in the value of an `Authorization` header.
    ///
    /// # Errors
    /// [`Fault::Unauthorized`]: there is no token, or it is unknown.
    pub(crate) fn grant(&self, authorization: Option<&[u8]>) -> Result<Arc<Grant>, Fault> {
        let token = authorization.and_then(bearer).ok_or(Fault::Unauthorized)?;
        // Both hashes are computed for every request, whichever kind the file has, so that the time
        // says nothing about the file.
        let of_token = blake3::hash(token);
        let of_sha256 = blake3::hash(&Sha256::digest(token));
        // Compare with all tokens even after a match: the time must not depend on which token
        // matches.
        let mut matching = None;
        for Token { grant, secret } in &self.tokens {
            let is_equal = match secret {
                Secret::OfToken(hash) => *hash == of_token,
                Secret::OfSha256(hash) => *hash == of_sha256,
            };
            if is_equal {
                matching = Some(grant);
            }
        }
        matching.cloned().ok_or(Fault::Unauthorized)
    }
}

impl CurrentTokens {
    pub(crate) fn new(tokens: Tokens) -> Self {
        Self(Mutex::new(Arc::new(tokens)))
    }

    /// The tokens of this moment.
    pub(crate) fn get(&self) -> Arc<Tokens> {
        self.0.lock().clone()
    }

    /// Reads the file again, if the tokens came from one, and returns its path. Existing
    /// connections keep the rights of their token.
    ///
    /// # Errors
    /// The path, and why the file cannot be used: then the old tokens stay.
    pub(crate) fn read_again(&self) -> Result<Option<PathBuf>, (PathBuf, TokensError)> {
        let Some(file) = self.get().file.clone() else { return Ok(None) };
        match Tokens::read(&file) {
            Ok(tokens) => *self.0.lock() = Arc::new(tokens),
            Err(error) => return Err((file, error)),
        }
        Ok(Some(file))
    }
}

impl Secret {
    /// Parses `blake3:` or `sha-256:` and 64 hex digits.
    pub(super) fn parse(text: &str) -> Option<Self> {
        let (algorithm, hex) = text.split_once(':')?;
        let hash = Hash::from_hex(hex).ok()?;
        match algorithm {
            "blake3" => Some(Self::OfToken(hash)),
            // Hashed once more, so that both kinds are compared by BLAKE3's type, in constant time.
            "sha-256" => Some(Self::OfSha256(blake3::hash(hash.as_bytes()))),
            _ => None,
        }
    }
}

/// The token of `Bearer TOKEN` (RFC 6750, section 2.1; the scheme is case-insensitive).
fn bearer(authorization: &[u8]) -> Option<&[u8]> {
    // Bytes and not text: a header may have any bytes, and a token that is not UTF-8 is only
    // unknown.
    let (scheme, token) = authorization.split_at_checked("Bearer ".len())?;
    scheme.eq_ignore_ascii_case(b"Bearer ").then(|| token.trim_ascii())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_are_known_by_themselves_and_by_their_hashes() {
        let blake3 = blake3::hash(b"one");
        let sha256 = blake3::Hash::from_bytes(Sha256::digest(b"two").into());
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
        // The hash of a token is not itself a token.
        assert!(name(&format!("Bearer {blake3}")).is_err());
        let grant = tokens.grant(Some(b"Bearer one")).unwrap();
        assert!(grant.has(Role::Drive) && !grant.has(Role::Push));
        assert!(grant.allows_twin("street") && !grant.allows_twin("road"));
    }

    #[test]
    fn a_file_is_read_again_and_a_damaged_one_changes_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("tokens.json");
        let write = |token: &str| {
            let text =
                format!(r#"{{"tokens": [{{"name": "a", "role": "push", "token": "{token}"}}]}}"#);
            std::fs::write(&path, text).unwrap();
        };
        write("first-first-first");
        let tokens = CurrentTokens::new(Tokens::read(&path).unwrap());
        let knows =
            |token: &str| tokens.get().grant(Some(format!("Bearer {token}").as_bytes())).is_ok();
        // Writing the file changes nothing until it is read again.
        write("second-second-second");
        assert!(knows("first-first-first") && !knows("second-second-second"));
        assert_eq!(tokens.read_again().unwrap(), Some(path.clone()));
        assert!(!knows("first-first-first") && knows("second-second-second"));
        write("short");
        let (file, error) = tokens.read_again().unwrap_err();
        assert_eq!((file, error.location.as_str()), (path.clone(), "tokens[0].token"));
        assert!(knows("second-second-second"));
        std::fs::remove_file(&path).unwrap();
        assert_eq!(tokens.read_again().unwrap_err().1.location, "the file");
        // Tokens that came from no file stay as they are.
        let text = br#"{"tokens": [{"name": "a", "role": "push", "token": "0123456789abcdef"}]}"#;
        let parsed = CurrentTokens::new(Tokens::parse(text).unwrap());
        assert_eq!(parsed.read_again().unwrap(), None);
    }
}
