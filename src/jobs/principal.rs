//! Who asks, and what a role may do: one table.
//!
//! Plain data. Who a caller is, is found out elsewhere (`service::auth`); what becomes of a request
//! for somebody else's job is `owners.rs`.

use std::{fmt, str::FromStr};

/// Owner of what was made where nobody has to say who they are.
pub const LOCAL: &str = "local";

/// What somebody may be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Reads what is its owner's.
    Viewer,
    /// Reads and writes what is its owner's.
    User,
    /// Takes jobs and reports on them; sees nothing else.
    Worker,
    /// Everything of everybody.
    Admin,
}

/// What a call does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Act {
    /// Looks at meshes, jobs, logs, results.
    Read,
    /// Makes, stops or deletes them.
    Write,
    /// Takes work and reports on it.
    Work,
    /// Looks after the workers.
    Manage,
}

struct RoleRow {
    role: Role,
    name: &'static str,
    may: &'static [Act],
    sees_all: bool,
}

#[rustfmt::skip]
const ROLES: [RoleRow; 4] = [
    RoleRow { role: Role::Viewer, name: "viewer", sees_all: false, may: &[Act::Read] },
    RoleRow { role: Role::User,   name: "user",   sees_all: false, may: &[Act::Read, Act::Write] },
    RoleRow { role: Role::Worker, name: "worker", sees_all: false, may: &[Act::Work] },
    RoleRow { role: Role::Admin,  name: "admin",  sees_all: true,  may: &[Act::Read, Act::Write, Act::Work, Act::Manage] },
];

impl Role {
    fn row(self) -> &'static RoleRow {
        // A role without a row may least of all; the test below forbids that.
        ROLES.iter().find(|row| row.role == self).unwrap_or(&ROLES[0])
    }

    /// Its name in files, tokens and logs.
    pub fn name(self) -> &'static str {
        self.row().name
    }

    /// Whether it may do this at all.
    pub fn may(self, act: Act) -> bool {
        self.row().may.contains(&act)
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The text names no role.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{0}` is no role: use viewer, user, worker or admin")]
pub struct UnknownRole(String);

impl FromStr for Role {
    type Err = UnknownRole;

    fn from_str(text: &str) -> Result<Self, UnknownRole> {
        let row = ROLES.iter().find(|row| row.name == text);
        row.map(|row| row.role).ok_or_else(|| UnknownRole(text.escape_default().to_string()))
    }
}

/// Somebody who may call.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Principal {
    /// Names the credentials, for people: logs and the audit table show it.
    pub name: String,
    /// Whose jobs and meshes it sees and makes.
    pub owner: String,
    /// What it may do.
    pub role: Role,
}

impl Principal {
    /// Everybody, where nobody has to say who they are.
    pub fn local() -> Self {
        Self { name: LOCAL.into(), owner: LOCAL.into(), role: Role::Admin }
    }

    /// A worker that the server itself started.
    pub fn local_worker() -> Self {
        Self { name: "local-worker".into(), owner: LOCAL.into(), role: Role::Worker }
    }

    /// Whether it sees what belongs to `owner`.
    pub fn sees(&self, owner: &str) -> bool {
        self.role.row().sees_all || self.owner == owner
    }

    /// Whose things a list shows when those of `asked` are wanted (empty: no matter whose).
    pub fn listed<'a>(&'a self, asked: &'a str) -> Listed<'a> {
        match (self.role.row().sees_all, asked) {
            (true, "") => Listed::All,
            (true, asked) => Listed::Of(asked),
            (false, asked) if asked.is_empty() || asked == self.owner => Listed::Of(&self.owner),
            (false, _) => Listed::Nothing,
        }
    }
}

/// Whose things a list shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Listed<'a> {
    /// Everybody's.
    All,
    /// One owner's.
    Of(&'a str),
    /// Nobody's: they are not for the one who asks.
    Nothing,
}

/// Whether a text can name an owner or credentials: 1 to 64 characters of `[A-Za-z0-9._@:/+-]`.
pub fn is_name(text: &str) -> bool {
    let allowed = |c: u8| c.is_ascii_alphanumeric() || b"._@:/+-".contains(&c);
    (1..=64).contains(&text.len()) && text.bytes().all(allowed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn roles_do_what_their_rows_say() {
        for role in [Role::Viewer, Role::User, Role::Worker, Role::Admin] {
            assert_eq!(role.row().role, role);
            assert_eq!(role.name().parse(), Ok(role));
        }
        assert!("root".parse::<Role>().is_err());
        assert!(Role::Viewer.may(Act::Read) && !Role::Viewer.may(Act::Write));
        assert!(Role::Worker.may(Act::Work) && !Role::Worker.may(Act::Read));
        assert!(!Role::User.may(Act::Work));
    }

    #[test]
    fn lists_show_what_is_ones_own_and_admins_everything() {
        let (admin, mut ann) = (Principal::local(), Principal::local());
        (ann.owner, ann.role) = ("ann".into(), Role::User);
        let table = [
            (&admin, "", Listed::All),
            (&admin, "bob", Listed::Of("bob")),
            (&ann, "", Listed::Of("ann")),
            (&ann, "ann", Listed::Of("ann")),
            (&ann, "bob", Listed::Nothing),
        ];
        for (who, asked, shown) in table {
            assert_eq!(who.listed(asked), shown, "{} asks for {asked:?}", who.owner);
        }
        assert!(admin.sees("bob") && ann.sees("ann") && !ann.sees("bob"));
    }

    #[test]
    fn names_are_plain() {
        for good in ["ann", "build@example.org", "spiffe://x/y", &"a".repeat(64)] {
            assert!(is_name(good), "{good}");
        }
        for bad in ["", "a b", "a\n", "é", "\"", &"a".repeat(65)] {
            assert!(!is_name(bad), "{bad:?}");
        }
    }
}
