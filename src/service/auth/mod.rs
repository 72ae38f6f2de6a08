//! Who calls, and whether they may: one place for every method of every service on the port.
//!
//! 1. A call reaches a handler only with a [`Call`] that says who makes it (`layer.rs`).
//! 2. What a method asks of its caller is a row of `methods.rs`; what a role may do, a row of
//!    [`crate::jobs::principal`]. Whose things they may do it to, [`crate::jobs::owners`] decides.
//! 3. Credentials that are sent must be good: nobody is let in as somebody less for a wrong token.
//! 4. On the Unix socket there are only workers, whatever they send.
//! 5. Secrets are in no log and in no `Debug`.

mod jwt;
mod layer;
mod limits;
mod methods;
mod secret;
mod tokens;
mod watched;

use std::{path::PathBuf, sync::Arc, time::Duration};

use tonic::{Code, Request, Status, metadata::MetadataMap};

use self::{
    jwt::Keys,
    limits::{Limiter, OpenStream},
    methods::{Method, Need},
    tokens::Roster,
};
use super::{accept::Peer, pace::Pace, status};
use crate::jobs::principal::{Act, Principal};

pub use self::{jwt::JwtRules, limits::Rates, secret::Secret, tokens::issue};
pub(super) use self::{
    layer::{Call, GateLayer, code_name},
    watched::Watched,
};

/// The refusal of one call too many is held back so long at least.
const HURRIED: Duration = Duration::from_millis(100);

/// How callers prove who they are.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Credentials {
    /// The file of principals, with hashes of tokens and names of certificates.
    pub tokens: Option<PathBuf>,
    /// A JWKS file, and what JWTs must say.
    pub jwt: Option<(PathBuf, JwtRules)>,
}

impl Credentials {
    /// Nobody has to say who they are.
    pub fn are_none(&self) -> bool {
        self.tokens.is_none() && self.jwt.is_none()
    }
}

/// Lets calls in, or not.
#[derive(Debug)]
pub struct Gate {
    roster: Option<Watched<Roster>>,
    keys: Option<(Watched<Keys>, JwtRules)>,
    limiter: Limiter,
    uploads: Arc<Pace<String>>,
}

/// Why a call is not let in.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Refusal {
    /// Nothing says who calls, or what says so is wrong.
    Unknown(String),
    /// The role may not do this.
    Forbidden { role: &'static str, act: Act },
    /// Too many requests; when to try again.
    Hurried(Duration),
    /// Too many open streams, of which there may be so many.
    Streams(usize),
}

impl Refusal {
    fn status(&self) -> Status {
        let (code, reason, text, retry) = match self {
            Self::Unknown(text) => (Code::Unauthenticated, "UNAUTHENTICATED", text.clone(), None),
            Self::Forbidden { role, act } => {
                let text = format!("the role `{role}` may not {act:?} here: use other credentials");
                (Code::PermissionDenied, "FORBIDDEN", text.to_lowercase(), None)
            }
            Self::Hurried(wait) => {
                let text = format!("too many requests: try again in {wait:?}");
                (Code::ResourceExhausted, "RATE_LIMITED", text, Some(*wait))
            }
            Self::Streams(most) => {
                let text = format!("{most} streams are open, which is the limit: close some");
                let wait = Duration::from_secs(1);
                (Code::ResourceExhausted, "TOO_MANY_STREAMS", text, Some(wait))
            }
        };
        status::refusal(code, reason, &text, retry)
    }
}

/// A call that was let in.
struct Admitted {
    who: Principal,
    stream: Option<OpenStream>,
}

impl Gate {
    /// Reads what credentials are checked against; the fault names the file.
    pub fn open(credentials: &Credentials, rates: Rates) -> Result<Self, String> {
        let text = |files: &[Vec<u8>]| {
            let bytes = files.first().cloned().unwrap_or_default();
            String::from_utf8(bytes).map_err(|_| "it is not UTF-8".to_owned())
        };
        let roster = credentials.tokens.as_ref().map(|path| {
            Watched::open(vec![path.clone()], move |files| Roster::parse(&text(files)?))
        });
        let keys = credentials.jwt.as_ref().map(|(path, rules)| {
            let keys = Watched::open(vec![path.clone()], move |files| Keys::parse(&text(files)?));
            keys.map(|keys| (keys, rules.clone()))
        });
        let (roster, keys) = (roster.transpose()?, keys.transpose()?);
        let uploads = Arc::new(rates.uploads());
        Ok(Self { roster, keys, limiter: Limiter::new(rates), uploads })
    }

    /// How fast the uploads of each owner may come, in turns of [`Rates::TURN`] bytes.
    pub(super) fn uploads(&self) -> Arc<Pace<String>> {
        Arc::clone(&self.uploads)
    }

    /// Whether callers have to say who they are.
    pub(super) fn asks(&self) -> bool {
        self.roster.is_some() || self.keys.is_some()
    }

    /// Who calls. Asked of every call, so that a change of a file counts from the next one on.
    fn identify(&self, peer: &Peer, headers: &MetadataMap) -> Result<Principal, Refusal> {
        if peer.is_local_worker {
            return Ok(Principal::local_worker());
        }
        if !self.asks() {
            return Ok(Principal::local());
        }
        if let Some(header) = headers.get("authorization") {
            return self.by_token(header.to_str().unwrap_or_default());
        }
        let roster = self.roster.as_ref().map(Watched::get);
        let known = roster.as_ref().and_then(|r| r.by_certificate(&peer.certificate_names));
        known.cloned().ok_or_else(|| {
            let text = match peer.certificate_names.first() {
                None => {
                    "no credentials: send a token (--token or LOOKALIKE_TOKEN), or a certificate"
                }
                Some(_) => "no name of the certificate is in the server's file of principals",
            };
            Refusal::Unknown(text.into())
        })
    }

    fn by_token(&self, header: &str) -> Result<Principal, Refusal> {
        let scheme = header.get(..7).filter(|scheme| scheme.eq_ignore_ascii_case("bearer "));
        let Some(token) = scheme.and_then(|_| header.get(7..)).map(str::trim) else {
            let text = "the header `authorization` must say `Bearer TOKEN`";
            return Err(Refusal::Unknown(text.into()));
        };
        let known = self.roster.as_ref().and_then(|r| r.get().by_token(token).cloned());
        match (known, &self.keys) {
            (Some(known), _) => Ok(known),
            (None, Some((keys, rules))) if token.matches('.').count() == 2 => {
                let verified = keys.get().verify(token, rules);
                verified.map_err(|why| Refusal::Unknown(format!("the token is refused: {why}")))
            }
            _ => Err(Refusal::Unknown("the token is unknown: ask for a new one".into())),
        }
    }

    /// Whether who was identified may make this call now.
    fn admit(&self, method: &Method, who: Principal) -> Result<Admitted, (Principal, Refusal)> {
        let Need::May(act) = method.need else { return Ok(Admitted { who, stream: None }) };
        if !who.role.may(act) {
            let role = who.role.name();
            return Err((who, Refusal::Forbidden { role, act }));
        }
        if act == Act::Work {
            return Ok(Admitted { who, stream: None });
        }
        let key = format!("{} {}", who.owner, who.name);
        if let Err(wait) = self.limiter.request(&key) {
            return Err((who, Refusal::Hurried(wait)));
        }
        match method.is_stream.then(|| self.limiter.stream(&key)).transpose() {
            Ok(stream) => Ok(Admitted { who, stream }),
            Err(most) => Err((who, Refusal::Streams(most))),
        }
    }

    /// How long a refusal is held back. Who does not wait for an answer before the next call cannot have very many
    /// on the way; who does is slowed down.
    fn patience(&self, refusal: &Refusal, peer: &Peer) -> Duration {
        match refusal {
            Refusal::Unknown(_) => self.limiter.stranger(peer.ip()),
            Refusal::Hurried(wait) => (*wait).max(HURRIED),
            Refusal::Forbidden { .. } | Refusal::Streams(_) => Duration::ZERO,
        }
    }
}

/// Who makes the call that a handler has in hand.
pub(super) fn call_of<T>(request: &Request<T>) -> Result<Call, Status> {
    request.extensions().get::<Call>().cloned().ok_or_else(|| {
        status::refusal(Code::Internal, "NO_GATE", "a call came past the gate", None)
    })
}
