//! The file of principals: who has which token or certificate, and what they may do.
//!
//! ```toml
//! [[principal]]
//! name = "ann-laptop"        # shown in logs
//! owner = "ann"              # whose jobs and meshes it sees
//! role = "user"              # viewer, user, worker, admin
//! token_blake3 = "64 hex…"   # or: certificate = "a DNS name or URI of the client's certificate"
//! ```
//!
//! Only hashes of tokens are kept. A token is 32 random bytes, so that a plain hash is enough; hashes
//! are compared in constant time.

use std::collections::BTreeSet;

use base64::{Engine, engine::general_purpose::URL_SAFE_NO_PAD};
use serde::{Deserialize, Serialize};

use super::secret::Secret;
use crate::jobs::principal::{Principal, Role, is_name};

/// By this, people and scanners of leaked secrets know a token.
const PREFIX: &str = "lkl_";

/// A row of the file.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Row {
    name: String,
    owner: String,
    role: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    token_blake3: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    certificate: Option<String>,
}

#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(default)]
    principal: Vec<Row>,
}

#[derive(Debug)]
enum Credential {
    Token(blake3::Hash),
    Certificate(String),
}

/// Who is known by a token or a certificate.
#[derive(Debug, Default)]
pub(super) struct Roster(Vec<(Credential, Principal)>);

impl Roster {
    /// Reads the file's text; the fault names the row.
    pub(super) fn parse(text: &str) -> Result<Self, String> {
        let file: File = toml::from_str(text).map_err(|error| error.to_string())?;
        let mut names = BTreeSet::new();
        let mut rows = Vec::with_capacity(file.principal.len());
        for (i, row) in file.principal.into_iter().enumerate() {
            let at = |fault: String| format!("principal {} (`{}`): {fault}", i + 1, row.name);
            if !names.insert(row.name.clone()) {
                return Err(at("the name is taken: choose another".into()));
            }
            rows.push(entry(&row).map_err(at)?);
        }
        Ok(Self(rows))
    }

    /// Whose token this is.
    pub(super) fn by_token(&self, token: &str) -> Option<&Principal> {
        let hash = blake3::hash(token.as_bytes());
        // `Hash` compares in constant time; the loop goes through all rows whatever it finds.
        let mut found = None;
        for (credential, principal) in &self.0 {
            if matches!(credential, Credential::Token(known) if *known == hash) {
                found = Some(principal);
            }
        }
        found
    }

    /// Who is named in a certificate that was verified.
    pub(super) fn by_certificate(&self, names: &[String]) -> Option<&Principal> {
        let is = |credential: &Credential| matches!(credential, Credential::Certificate(name) if names.contains(name));
        self.0.iter().find(|(credential, _)| is(credential)).map(|(_, principal)| principal)
    }
}

fn entry(row: &Row) -> Result<(Credential, Principal), String> {
    for (key, text) in [("name", &row.name), ("owner", &row.owner)] {
        if !is_name(text) {
            return Err(format!("{key}: use 1 to 64 characters of [A-Za-z0-9._@:/+-]"));
        }
    }
    let role = row.role.parse::<Role>().map_err(|unknown| format!("role: {unknown}"))?;
    let credential = match (&row.token_blake3, &row.certificate) {
        (Some(hash), None) => {
            let hash = blake3::Hash::from_hex(hash);
            Credential::Token(hash.map_err(|_| "token_blake3: use 64 hexadecimal digits")?)
        }
        (None, Some(name)) if !name.is_empty() => Credential::Certificate(name.clone()),
        _ => return Err("give either token_blake3 or certificate".into()),
    };
    let principal = Principal { name: row.name.clone(), owner: row.owner.clone(), role };
    Ok((credential, principal))
}

/// Makes a token for a new principal: the token, to be shown once, and the lines for the file, whose
/// text so far is `file`.
pub fn issue(file: &str, name: &str, owner: &str, role: Role) -> Result<(Secret, String), String> {
    let mut bytes = [0; 32];
    getrandom::fill(&mut bytes).map_err(|error| format!("no randomness to be had: {error}"))?;
    let token = format!("{PREFIX}{}", URL_SAFE_NO_PAD.encode(bytes));
    let row = Row {
        name: name.into(),
        owner: owner.into(),
        role: role.name().into(),
        token_blake3: Some(blake3::hash(token.as_bytes()).to_hex().to_string()),
        certificate: None,
    };
    let lines = toml::to_string(&File { principal: vec![row] }).map_err(|e| e.to_string())?;
    // The whole file must still make sense.
    let gap = if file.is_empty() || file.ends_with("\n\n") { "" } else { "\n" };
    let lines = format!("{gap}{lines}");
    Roster::parse(&format!("{file}{lines}"))?;
    Ok((Secret::new(token), lines))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn issued_tokens_are_known_and_not_in_the_file() {
        let (mut file, mut tokens) = (String::new(), Vec::new());
        for (name, role) in [("a", Role::User), ("b", Role::Admin)] {
            let (token, lines) = issue(&file, name, "ann", role).unwrap();
            file.push_str(&lines);
            tokens.push((name, role, token));
        }
        let roster = Roster::parse(&file).unwrap();
        for (name, role, token) in &tokens {
            let found = roster.by_token(token.reveal()).unwrap();
            assert_eq!((found.name.as_str(), found.role, &*found.owner), (*name, *role, "ann"));
            assert!(!file.contains(token.reveal()) && token.reveal().len() == 47);
        }
        assert_eq!(roster.by_token(""), None);
        assert_eq!(roster.by_token(&format!("{}x", tokens[0].2.reveal())), None);
        assert!(issue(&file, "a", "bob", Role::User).unwrap_err().contains("taken"));
        assert!(issue(&file, "a b", "bob", Role::User).unwrap_err().contains("name"));
    }

    #[test]
    fn every_fault_of_the_file_names_its_place() {
        let hash = "0".repeat(64);
        let row = |rest: &str| format!("[[principal]]\nname = \"n\"\nowner = \"o\"\n{rest}\n");
        let table = [
            (row("role = \"root\"\ncertificate = \"x\""), "role: `root`"),
            (row("role = \"user\""), "either token_blake3 or certificate"),
            (row("role = \"user\"\ntoken_blake3 = \"12\""), "64 hexadecimal"),
            (
                row(&format!("role = \"user\"\ntoken_blake3 = \"{hash}\"\ncertificate = \"x\"")),
                "either",
            ),
            (row("role = \"user\"\npassword = \"x\""), "password"),
            ("nonsense".into(), "TOML"),
        ];
        for (text, wanted) in table {
            let fault = Roster::parse(&text).unwrap_err();
            assert!(fault.contains(wanted), "{fault}");
        }
    }

    #[test]
    fn certificates_are_found_by_any_of_their_names() {
        let text = "[[principal]]\nname = \"n\"\nowner = \"o\"\nrole = \"worker\"\n\
                    certificate = \"w1.example.org\"\n";
        let roster = Roster::parse(text).unwrap();
        let names = |names: &[&str]| names.iter().map(|&name| name.into()).collect::<Vec<_>>();
        let found = roster.by_certificate(&names(&["x", "w1.example.org"])).unwrap();
        assert_eq!(found.role, Role::Worker);
        assert_eq!(roster.by_certificate(&names(&["w2.example.org"])), None);
        assert_eq!(roster.by_certificate(&[]), None);
    }
}
