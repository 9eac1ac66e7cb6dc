//! Bearer tokens: each has a role and the twins that it may use.
//!
//! A server without tokens listens on a loopback address only, and every client may do everything.

mod error;
mod file;
mod grant;
mod tokens;

pub use error::TokensError;
pub use grant::Role;
pub use tokens::Tokens;

pub(crate) use grant::{Access, Grant};
pub(crate) use tokens::CurrentTokens;
