//! Bearer tokens: each has a role and the twins that it may use.
//!
//! A server without tokens listens on a loopback address only, and every client may do everything.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use blake3::Hash;
use parking_lot::Mutex;
use serde::Deserialize;
use sha2::{Digest as _, Sha256};

use wildcity_twin::ingest;

use crate::fault::Fault;
use crate::limits;

/// What the holder of a token may do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Read the metrics, and nothing else.
    Metrics,
    /// Open sessions.
    Drive,
    /// Open sessions, upload and push.
    Push,
    /// Everything.
    Admin,
}

/// What a client may do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Grant {
    /// Name of the token; empty on a server without tokens.
    pub(crate) name: String,
    role: Role,
    /// Names of the twins that it may use; all twins if there is no list.
    twins: Option<BTreeSet<String>>,
    pub(crate) limits: TokenLimits,
}

/// What a token may have at once; without a value, as much as the server allows to all.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct TokenLimits {
    /// Sessions, connected or waiting to be resumed.
    pub(crate) sessions: Option<usize>,
    /// WebSocket connections, those of watchers too.
    pub(crate) connections: Option<usize>,
    /// Pushes and edits that wait or run.
    pub(crate) pushes: Option<usize>,
    /// Bytes of uploads.
    pub(crate) upload_bytes: Option<u64>,
}

/// The tokens that a server accepts.
#[derive(Clone, Debug)]
pub struct Tokens {
    tokens: Vec<Token>,
    /// The file that they were read from.
    file: Option<PathBuf>,
}

/// The tokens of a running server, which can be read again.
#[derive(Debug)]
pub(crate) struct CurrentTokens(Mutex<Arc<Tokens>>);

#[derive(Clone, Debug)]
struct Token {
    grant: Arc<Grant>,
    secret: Secret,
}

/// A hash of a token. It cannot be inverted, and comparing two hashes takes the same time whether they
/// are equal or not.
#[derive(Clone, Debug)]
enum Secret {
    /// BLAKE3 of the token.
    OfToken(Hash),
    /// BLAKE3 of the token's SHA-256.
    OfSha256(Hash),
}

/// Why a file of tokens cannot be used. The message contains no token.
#[derive(Debug, thiserror::Error)]
#[error("{location}: {reason}")]
pub struct TokensError {
    /// The location in the file, as `tokens[2].hash`.
    pub location: String,
    /// What is wrong, and what is expected.
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
    #[serde(default)]
    limits: TokenLimits,
}

/// Bytes of the shortest token that is accepted: 16 characters of base64 have 96 bits, too many to guess.
const MIN_TOKEN_BYTES: usize = 16;

impl Tokens {
    /// Reads a file, as [`Self::parse`] does, and notes its path: a running server reads it again at SIGHUP.
    ///
    /// # Errors
    /// The file cannot be read, is larger than [`limits::TOKENS_FILE_BYTES`], or has an entry that cannot be used.
    pub fn read(path: &Path) -> Result<Self, TokensError> {
        let text = ingest::read_whole(path, limits::TOKENS_FILE_BYTES).map_err(|error| {
            TokensError { location: "the file".to_owned(), reason: error.to_string() }
        })?;
        Ok(Self { file: Some(path.to_owned()), ..Self::parse(&text)? })
    }

    /// Parses a file of tokens: `{"tokens": [{"name", "role", "token" or "hash", "twins", "limits"}]}`, where
    /// `hash` is `blake3:` or `sha-256:` and the hash of the token in hex.
    ///
    /// # Errors
    /// Names the first entry that cannot be used.
    pub fn parse(text: &[u8]) -> Result<Self, TokensError> {
        let wrong =
            |location: String, reason: &str| TokensError { location, reason: reason.to_owned() };
        let file: File = serde_json::from_slice(text).map_err(|error| {
            // serde's message could quote a token that is in the wrong place.
            let location = format!("line {}, column {}", error.line(), error.column());
            wrong(location, "not {\"tokens\": [{\"name\", \"role\", \"token\" or \"hash\", ..}]}")
        })?;
        if file.tokens.is_empty() {
            return Err(wrong("tokens".to_owned(), "there is none: no client could connect"));
        }
        let mut tokens: Vec<Token> = Vec::with_capacity(file.tokens.len());
        for (index, entry) in file.tokens.into_iter().enumerate() {
            let Entry { name, role, token, hash, twins, limits } = entry;
            // A session belongs to the name of a token, so that names are unique.
            if name.is_empty() || tokens.iter().any(|other| other.grant.name == name) {
                let reason = "a name is not empty, and belongs to one token only";
                return Err(wrong(format!("tokens[{index}].name"), reason));
            }
            if name.len() > limits::TOKEN_NAME_BYTES {
                let bytes = name.len();
                let most = limits::TOKEN_NAME_BYTES;
                let reason = format!("a name of {bytes} bytes; choose one of at most {most}");
                return Err(wrong(format!("tokens[{index}].name"), &reason));
            }
            let secret = match (token, hash) {
                (Some(token), None) if token.len() >= MIN_TOKEN_BYTES => {
                    Secret::OfToken(blake3::hash(token.as_bytes()))
                }
                (Some(_), None) => {
                    let reason = format!("a token has at least {MIN_TOKEN_BYTES} characters");
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
            let grant = Grant { name, role, twins, limits };
            tokens.push(Token { grant: Arc::new(grant), secret });
        }
        Ok(Self { tokens, file: None })
    }

    /// Number of tokens that may upload.
    pub(crate) fn uploaders(&self) -> usize {
        self.tokens.iter().filter(|token| token.grant.require(Role::Push).is_ok()).count()
    }

    /// Bytes that the uploads of a token may take, by name, for tokens with a limit of their own.
    pub(crate) fn upload_bytes(&self) -> BTreeMap<String, u64> {
        let limited = |token: &Token| {
            let bytes = token.grant.limits.upload_bytes?;
            Some((token.grant.name.clone(), bytes))
        };
        self.tokens.iter().filter_map(limited).collect()
    }

    /// What the token in the value of an `Authorization` header allows.
    ///
    /// # Errors
    /// [`Fault::Unauthorized`]: there is no token, or the server does not know it.
    pub(crate) fn grant(&self, authorization: Option<&[u8]>) -> Result<Arc<Grant>, Fault> {
        let token = authorization.and_then(bearer).ok_or(Fault::Unauthorized)?;
        let of_token = blake3::hash(token);
        let of_sha256 = blake3::hash(&Sha256::digest(token));
        // Compares with all tokens even after a match: the time must not depend on which one it is.
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

    /// Reads the file again, if the tokens came from one, and returns its path. Connections that exist keep what
    /// their token allowed.
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
    /// The grant of every client of a server without tokens.
    pub(crate) fn everything() -> Arc<Self> {
        let limits = TokenLimits::default();
        Arc::new(Self { name: String::new(), role: Role::Admin, twins: None, limits })
    }

    /// Requires a role, or one that includes it: [`Role::Admin`] includes all, and [`Role::Push`] that of
    /// [`Role::Drive`].
    ///
    /// # Errors
    /// [`Fault::Forbidden`] if the token has another role.
    pub(crate) fn require(&self, role: Role) -> Result<(), Fault> {
        if self.role.includes(role) {
            return Ok(());
        }
        let needs = role.name();
        let reason = format!("its role is {}, not {needs}", self.role.name());
        Err(Fault::Forbidden { field: "authorization", reason })
    }

    /// Requires any role but [`Role::Metrics`].
    ///
    /// # Errors
    /// [`Fault::Forbidden`] if the token may read metrics alone.
    pub(crate) fn require_more_than_metrics(&self) -> Result<(), Fault> {
        if self.role != Role::Metrics {
            return Ok(());
        }
        let reason = "its role is metrics: it may GET /metrics alone".to_owned();
        Err(Fault::Forbidden { field: "authorization", reason })
    }

    /// Requires access to a twin.
    ///
    /// # Errors
    /// [`Fault::Forbidden`] if the token may not use the twin.
    pub(crate) fn require_twin(&self, twin: &str) -> Result<(), Fault> {
        if self.allows_twin(twin) {
            return Ok(());
        }
        Err(Fault::Forbidden {
            field: "twin",
            reason: format!("it does not include twin {twin:?}"),
        })
    }

    /// Requires access to all twins: for changes of what all twins share.
    ///
    /// # Errors
    /// [`Fault::Forbidden`] if the token is limited to some twins.
    pub(crate) fn require_all_twins(&self) -> Result<(), Fault> {
        if self.allows_all_twins() {
            return Ok(());
        }
        let reason = "it is limited to some twins, and all twins share the assets of actors";
        Err(Fault::Forbidden { field: "authorization", reason: reason.to_owned() })
    }

    /// Whether the token is not limited to some twins.
    pub(crate) fn allows_all_twins(&self) -> bool {
        self.twins.is_none()
    }

    /// Whether the token may use the twin. Lists of twins leave out those that it may not use.
    pub(crate) fn allows_twin(&self, twin: &str) -> bool {
        self.twins.as_ref().is_none_or(|twins| twins.contains(twin))
    }
}

impl Role {
    fn includes(self, role: Self) -> bool {
        self == role || self == Self::Admin || (self == Self::Push && role == Self::Drive)
    }

    fn name(self) -> &'static str {
        match self {
            Self::Metrics => "metrics",
            Self::Drive => "drive",
            Self::Push => "push",
            Self::Admin => "admin",
        }
    }
}

/// The token of `Bearer TOKEN` (RFC 6750, section 2.1; the scheme is case-insensitive).
fn bearer(authorization: &[u8]) -> Option<&[u8]> {
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
        assert!(grant.require(Role::Drive).is_ok() && grant.require(Role::Push).is_err());
        assert!(grant.allows_twin("street") && !grant.allows_twin("road"));
    }

    #[test]
    fn admin_includes_all_roles_and_push_includes_drive() {
        use Role::{Admin, Drive, Metrics, Push};
        for (role, included) in [
            (Metrics, [true, false, false, false]),
            (Drive, [false, true, false, false]),
            (Push, [false, true, true, false]),
            (Admin, [true, true, true, true]),
        ] {
            assert_eq!([Metrics, Drive, Push, Admin].map(|other| role.includes(other)), included);
        }
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
        let parsed = br#"{"tokens": [{"name": "a", "role": "push", "token": "0123456789abcdef"}]}"#;
        let parsed = CurrentTokens::new(Tokens::parse(parsed).unwrap());
        assert_eq!(parsed.read_again().unwrap(), None);
    }

    /// A reader of the documentation must replace what is said there of a token.
    #[test]
    fn the_examples_of_the_documentation_are_no_tokens() {
        let page = include_str!("../../docs/operators.md");
        let examples: Vec<&str> = page.split("```json\n{\"tokens\"").skip(1).collect();
        assert_eq!(examples.len(), 2);
        for example in examples {
            let text = format!("{{\"tokens\"{}", example.split("```").next().unwrap());
            let file: serde_json::Value = serde_json::from_str(&text).unwrap();
            for entry in file["tokens"].as_array().unwrap() {
                let one = serde_json::json!({ "tokens": [entry] }).to_string();
                let error = Tokens::parse(one.as_bytes()).unwrap_err();
                assert!(error.location.starts_with("tokens[0]."), "{error}");
            }
        }
    }

    #[test]
    fn a_file_of_tokens_is_refused_without_repeating_them() {
        let with_name = |bytes: usize| {
            let name = "n".repeat(bytes);
            format!(
                r#"{{"tokens": [{{"name": "{name}", "role": "push", "token": "secretsecretsecret"}}]}}"#
            )
        };
        assert!(Tokens::parse(with_name(255).as_bytes()).is_ok());
        let long_name = with_name(256);
        for (text, location) in [
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
            (long_name.as_str(), "tokens[0].name"),
        ] {
            let error = Tokens::parse(text.as_bytes()).unwrap_err().to_string();
            assert!(error.starts_with(location) && !error.contains("secret"), "{error}");
        }
    }
}
