//! The file of tokens: reading and checking it.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;

use serde::Deserialize;

use wildcity_twin::ingest;

use super::error::TokensError;
use super::grant::{Grant, Role, TokenLimits};
use super::tokens::{Secret, Token, Tokens};
use crate::limits;

#[derive(Deserialize)]
#[serde(deny_unknown_fields, expecting = "an object with tokens")]
struct File {
    tokens: Vec<Entry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields, expecting = "an object with name and role")]
struct Entry {
    name: String,
    role: String,
    token: Option<String>,
    hash: Option<String>,
    twins: Option<BTreeSet<String>>,
    #[serde(default)]
    limits: TokenLimits,
}

/// The part of a message of serde that quotes nothing of the file, where a token may stand in the
/// wrong place.
fn hint(message: &str) -> Option<String> {
    // From the end, because a quoted text may contain the same words.
    let (message, _position) = message.rsplit_once(" at line ")?;
    if message.starts_with("missing field ") || message.starts_with("duplicate field ") {
        // These name fields of the structs above.
        return Some(message.to_owned());
    }
    // The part before the last `, expected ` may quote a token. The part after it has only names of
    // fields and types.
    let (_quoted, expected) = message.rsplit_once(", expected ")?;
    Some(format!("expected {expected}"))
}

/// Bytes of the shortest token that is accepted: 16 characters of base64 have 96 bits, too many to
/// guess.
const MIN_TOKEN_BYTES: usize = 16;

impl Tokens {
    /// Reads a file, as [`Self::parse`] does, and notes its path: a running server reads it again
    /// at SIGHUP.
    ///
    /// # Errors
    /// The file cannot be read, is larger than [`limits::TOKENS_FILE_BYTES`], or has an entry that
    /// cannot be used.
    pub fn read(path: &Path) -> Result<Self, TokensError> {
        let text = ingest::read_whole(path, limits::TOKENS_FILE_BYTES).map_err(|error| {
            TokensError { location: "the file".to_owned(), reason: error.to_string() }
        })?;
        Ok(Self { file: Some(path.to_owned()), ..Self::parse(&text)? })
    }

    /// Parses a file of tokens:
    /// `{"tokens": [{"name", "role", "token" or "hash", "twins", "limits"}]}`, where `hash` is
    /// `blake3:` or `sha-256:` and the hash of the token in hex.
    ///
    /// # Errors
    /// Names the first entry that cannot be used.
    pub fn parse(text: &[u8]) -> Result<Self, TokensError> {
        let wrong =
            |location: String, reason: &str| TokensError { location, reason: reason.to_owned() };
        let file: File = serde_json::from_slice(text).map_err(|error| {
            // serde's message could quote a token that is in the wrong place; what it expected
            // there quotes nothing.
            let location = format!("line {}, column {}", error.line(), error.column());
            let hint = hint(&error.to_string()).map(|hint| format!("{hint}; ")).unwrap_or_default();
            let form =
                "the file is {\"tokens\": [{\"name\", \"role\", \"token\" or \"hash\", ..}]}";
            wrong(location, &format!("{hint}{form}"))
        })?;
        if file.tokens.is_empty() {
            return Err(wrong("tokens".to_owned(), "there is none: no client could connect"));
        }
        // Names are compared with all earlier ones: quadratic, but a file of 1 MiB has a few
        // thousand.
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
            // The message does not repeat the role: a token may stand in its place.
            let role = Role::named(&role).ok_or_else(|| {
                let roles = Role::ALL.map(Role::name).join(", ");
                wrong(
                    format!("tokens[{index}].role"),
                    &format!("no such role; the roles are {roles}"),
                )
            })?;
            let secret = match (token, hash) {
                (Some(token), None) if token.len() >= MIN_TOKEN_BYTES => {
                    // Only the hash is kept, so that a copy of the server's memory has no token.
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
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A reader of the documentation must replace the token in the example.
    #[test]
    fn the_examples_of_the_documentation_are_no_tokens() {
        // An example that worked would be a token that everyone knows.
        let page = include_str!("../../../docs/operators.md");
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
        // One byte more than a name may have.
        let long_name = with_name(256);
        for (text, location) in [
            (r#"{"tokens": []}"#, "tokens"),
            (
                r#"{"tokens": [{"name": "a", "role": "secret", "token": "secretsecretsecret"}]}"#,
                "tokens[0].role: no such role; the roles are metrics, drive, push, admin",
            ),
            (
                r#"{"tokens": ["secretsecretsecret"]}"#,
                "line 1, column 32: expected an object with name and role; ",
            ),
            (
                r#"{"tokens": [{"name": "a", "role": "drive", "token": "secretsecretsecret",
                    "limits": {"secret": 1}}]}"#,
                "line 2, column 39: expected one of `sessions`, ",
            ),
            (r#"{"tokens": [{"name": "a"}]}"#, "line 1, column 25: missing field `role`; "),
            (
                r#"{"tokens": [{"secret, expected secret": 1}]}"#,
                "line 1, column 38: expected one of `name`, ",
            ),
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
