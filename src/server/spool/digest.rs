//! Digests of uploads.

use std::io::{self, ErrorKind, Read};

use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

/// A digest, written as `blake3:` or `sha-256:` and 64 lower-case hex digits.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub(crate) struct Digest {
    algorithm: Algorithm,
    hash: [u8; 32],
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Algorithm {
    Blake3,
    Sha256,
}

impl Digest {
    /// The id of an upload with this digest, which is also a file name.
    pub(super) fn id(&self) -> String {
        // A colon is not allowed in file names everywhere.
        String::from(self.clone()).replace(':', "-")
    }

    /// The digest of an id.
    pub(super) fn from_id(id: &str) -> Option<Self> {
        // From the end: `sha-256` has a hyphen itself.
        let (algorithm, hex) = id.rsplit_once('-')?;
        format!("{algorithm}:{hex}").try_into().ok()
    }

    /// The digest of the content of a file of `size` bytes, with the algorithm of this digest.
    ///
    /// # Errors
    /// The file cannot be read, or ends early ([`ErrorKind::UnexpectedEof`]).
    pub(super) fn hash_same_kind(&self, mut file: impl Read, size: u64) -> io::Result<Self> {
        let bytes;
        let hash = match self.algorithm {
            Algorithm::Blake3 => {
                let mut hasher = blake3::Hasher::new();
                bytes = io::copy(&mut file, &mut hasher)?;
                *hasher.finalize().as_bytes()
            }
            Algorithm::Sha256 => {
                let mut hasher = Sha256::new();
                bytes = io::copy(&mut file, &mut hasher)?;
                hasher.finalize().into()
            }
        };
        // A file that lost bytes has another hash, too, but this is a fault of the disk and not of
        // the content.
        if bytes < size {
            let reason = format!("the file ended after {bytes} of {size} bytes");
            return Err(io::Error::new(ErrorKind::UnexpectedEof, reason));
        }
        Ok(Self { algorithm: self.algorithm, hash })
    }
}

impl TryFrom<String> for Digest {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let parsed = text.split_once(':').and_then(|(algorithm, hex)| {
            let algorithm = [Algorithm::Blake3, Algorithm::Sha256]
                .into_iter()
                .find(|known| known.name() == algorithm)?;
            // One spelling for each digest, because the id is a file name. Both algorithms have 32
            // bytes, so one parser reads both.
            let is_lower_case = hex.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'));
            let hash = blake3::Hash::from_hex(hex).ok().filter(|_| is_lower_case)?;
            Some(Self { algorithm, hash: *hash.as_bytes() })
        });
        parsed.ok_or_else(|| {
            format!(
                "{text:?} is no digest: expected blake3: or sha-256: and 64 lower-case hex digits"
            )
        })
    }
}

impl From<Digest> for String {
    fn from(Digest { algorithm, hash }: Digest) -> Self {
        format!("{}:{}", algorithm.name(), blake3::Hash::from_bytes(hash).to_hex())
    }
}

impl Algorithm {
    fn name(self) -> &'static str {
        match self {
            Self::Blake3 => "blake3",
            Self::Sha256 => "sha-256",
        }
    }
}
