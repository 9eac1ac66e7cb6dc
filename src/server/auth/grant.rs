//! Rights of a client: roles, twins, and the limits of a token.

use std::collections::BTreeSet;
use std::sync::Arc;

use serde::Deserialize;

use crate::fault::Fault;

/// Rights of the holder of a token.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Read the metrics, and nothing else.
    Metrics,
    Drive,
    /// Open sessions, upload and push.
    Push,
    Admin,
}

/// Which tokens may use a route. No route can be made without it: `Operation::new` requires it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Access {
    /// Everyone, also without a token.
    Public,
    /// Every token, except those with the role [`Role::Metrics`].
    AnyToken,
    /// Tokens with this role, or with one that includes it.
    Role(Role),
}

/// Rights of a client.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Grant {
    /// Name of the token; empty on a server without tokens.
    pub(crate) name: String,
    pub(super) role: Role,
    /// Names of the twins that it may use; all twins if there is no list.
    pub(super) twins: Option<BTreeSet<String>>,
    pub(crate) limits: TokenLimits,
}

/// Limits of a token; without a value, the limit of the server for all tokens applies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct TokenLimits {
    /// Sessions, connected or waiting to be resumed.
    pub(crate) sessions: Option<usize>,
    /// WebSocket connections, those of watchers too.
    pub(crate) connections: Option<usize>,
    /// Pushes and edits that wait or run.
    pub(crate) pushes: Option<usize>,
    pub(crate) upload_bytes: Option<u64>,
}

impl Grant {
    /// The grant of every client of a server without tokens.
    pub(crate) fn everything() -> Arc<Self> {
        // Without tokens the server listens on a loopback address only, so each client is an
        // administrator.
        let limits = TokenLimits::default();
        Arc::new(Self { name: String::new(), role: Role::Admin, twins: None, limits })
    }

    /// Requires what a route requires of a token.
    ///
    /// # Errors
    /// [`Fault::Forbidden`] if the token has another role.
    pub(crate) fn require(&self, access: Access) -> Result<(), Fault> {
        let Some(needed) = access.role() else { return Ok(()) };
        if self.has(needed) {
            return Ok(());
        }
        // The message names both roles: the one there is, and the one to ask the operator for.
        let reason = match self.role {
            Role::Metrics => "its role is metrics: it may GET /metrics alone".to_owned(),
            role => format!("its role is {}, not {}", role.name(), needed.name()),
        };
        Err(Fault::Forbidden { field: "authorization", reason })
    }

    /// Whether the token has a role, or one that includes it: [`Role::Admin`] includes all, and
    /// [`Role::Push`] includes [`Role::Drive`].
    pub(crate) fn has(&self, role: Role) -> bool {
        self.role.includes(role)
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

    /// Requires access to all twins: for changes of data that all twins share.
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
        // No list allows all twins, and an empty list allows none.
        self.twins.as_ref().is_none_or(|twins| twins.contains(twin))
    }
}

impl Access {
    /// The role that a token needs.
    fn role(self) -> Option<Role> {
        match self {
            Self::Public => None,
            // All roles but `Metrics` include `Drive`.
            Self::AnyToken => Some(Role::Drive),
            Self::Role(role) => Some(role),
        }
    }
}

impl Role {
    fn includes(self, role: Self) -> bool {
        // `Metrics` is included by `Admin` alone: a monitor needs no scene, and a driver needs no
        // numbers of others.
        self == role || self == Self::Admin || (self == Self::Push && role == Self::Drive)
    }

    pub(super) const ALL: [Self; 4] = [Self::Metrics, Self::Drive, Self::Push, Self::Admin];

    /// The role of this name.
    pub(super) fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|role| role.name() == name)
    }

    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Metrics => "metrics",
            Self::Drive => "drive",
            Self::Push => "push",
            Self::Admin => "admin",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
}
