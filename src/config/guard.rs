//! Flags of who may call the server, how much, and under which encryption.

use std::{net::SocketAddr, num::NonZeroU32, path::PathBuf};

use clap::{Args, ValueEnum};
use lookalike::service::{
    auth::{Credentials, JwtRules, Rates},
    crowd::Crowding,
    tls::TlsFiles,
    web::Origin,
};

/// A port.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Port {
    /// `--listen`.
    Grpc,
    /// `--metrics-listen`.
    Metrics,
}

/// Flags of `lookalike serve` that say who may call.
#[derive(Args, Clone, Debug)]
pub(crate) struct GuardArgs {
    /// The file of principals (`lookalike token` adds to it). With this or --jwks, callers must say
    /// who they are.
    #[arg(long, env = "LOOKALIKE_TOKENS", value_name = "FILE")]
    tokens: Option<PathBuf>,
    /// Accept JWTs signed by the keys of this JWKS file (RS256, ES256, EdDSA).
    #[arg(long, env = "LOOKALIKE_JWKS", value_name = "FILE")]
    jwks: Option<PathBuf>,
    /// The issuer (`iss`) that JWTs must have.
    #[arg(long, env = "LOOKALIKE_JWT_ISSUER", value_name = "TEXT")]
    jwt_issuer: Option<String>,
    /// The audience (`aud`) that JWTs must have.
    #[arg(long, env = "LOOKALIKE_JWT_AUDIENCE", value_name = "TEXT")]
    jwt_audience: Option<String>,
    /// The claim of JWTs that names the owner.
    #[arg(long, env = "LOOKALIKE_JWT_OWNER_CLAIM", default_value = "sub", value_name = "NAME")]
    jwt_owner_claim: String,
    /// The claim of JWTs that names the role: viewer, user, worker, admin.
    #[arg(long, env = "LOOKALIKE_JWT_ROLE_CLAIM", default_value = "role", value_name = "NAME")]
    jwt_role_claim: String,
    #[command(flatten)]
    tls: TlsArgs,
    /// Let pages of this origin, https://HOST or https://HOST:PORT, call from a browser.
    #[arg(long, env = "LOOKALIKE_ALLOW_ORIGIN", value_delimiter = ',', value_name = "ORIGIN")]
    allow_origin: Vec<Origin>,
    /// Let this port be reached from other machines without TLS and authentication.
    #[arg(long, env = "LOOKALIKE_INSECURE_LISTEN", value_delimiter = ',', value_name = "PORT")]
    insecure_listen: Vec<Port>,
    /// Requests a second that one principal may make; twice as many at once.
    #[arg(long, env = "LOOKALIKE_MAX_REQUESTS_PER_SEC", default_value = "1000", value_name = "N")]
    max_requests_per_sec: NonZeroU32,
    /// Uploads, downloads and logs that one principal may have open.
    #[arg(long, env = "LOOKALIKE_MAX_STREAMS", default_value_t = 1000, value_name = "N")]
    max_streams: usize,
    /// MiB a second of the uploads of one owner; more wait.
    #[arg(
        long,
        env = "LOOKALIKE_MAX_UPLOAD_MIB_PER_SEC",
        default_value = "100",
        value_name = "MIB"
    )]
    max_upload_mib_per_sec: NonZeroU32,
    /// Connections that may be open, half of them from one address.
    #[arg(long, env = "LOOKALIKE_MAX_CONNECTIONS", default_value_t = 10_000, value_name = "N")]
    max_connections: usize,
    /// New connections a second from one address; four times as many at once. More wait, or are cut off.
    #[arg(long, env = "LOOKALIKE_MAX_CONNECTIONS_PER_SEC", default_value = "64", value_name = "N")]
    max_connections_per_sec: NonZeroU32,
}

/// Flags of the encryption.
#[derive(Args, Clone, Debug)]
#[expect(clippy::struct_field_names, reason = "they are the names of the flags")]
pub(crate) struct TlsArgs {
    /// The server's certificate and those that lead to its authority, in PEM; read again when changed.
    #[arg(long, env = "LOOKALIKE_TLS_CERT", value_name = "FILE")]
    tls_cert: Option<PathBuf>,
    /// The certificate's private key, in PEM.
    #[arg(long, env = "LOOKALIKE_TLS_KEY", value_name = "FILE")]
    tls_key: Option<PathBuf>,
    /// The authorities of client certificates, in PEM; --tokens says who is who.
    #[arg(long, env = "LOOKALIKE_TLS_CLIENT_CA", value_name = "FILE")]
    tls_client_ca: Option<PathBuf>,
}

/// Who may call, how much, and under which encryption.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Guard {
    pub(crate) credentials: Credentials,
    pub(crate) tls: Option<TlsFiles>,
    pub(crate) rates: Rates,
    pub(crate) crowding: Crowding,
    /// Pages that may call from a browser.
    pub(crate) origins: Vec<Origin>,
    /// Ports that anybody can reach.
    pub(crate) exposed: Vec<Port>,
}

impl TlsArgs {
    /// The files; adds what is wrong to `faults`.
    pub(crate) fn files(self, faults: &mut Vec<String>) -> Option<TlsFiles> {
        let client_ca = self.tls_client_ca;
        match (self.tls_cert, self.tls_key) {
            (Some(cert), Some(key)) => return Some(TlsFiles { cert, key, client_ca }),
            (None, None) if client_ca.is_none() => {}
            _ => {
                faults.push("TLS needs a certificate and its key: --tls-cert and --tls-key".into());
            }
        }
        None
    }
}

impl GuardArgs {
    /// The same as a whole; adds what is wrong with it to `faults`.
    pub(crate) fn check(
        self,
        listen: SocketAddr,
        metrics: SocketAddr,
        faults: &mut Vec<String>,
    ) -> Guard {
        let has_client_ca = self.tls.tls_client_ca.is_some();
        let tls = self.tls.clone().files(faults);
        let credentials = self.credentials(faults);
        if has_client_ca && credentials.tokens.is_none() {
            faults
                .push("--tls-client-ca: --tokens FILE must say whose the certificates are".into());
        }
        let is_guarded = tls.is_some() && !credentials.are_none();
        let mut exposed = Vec::new();
        for (port, flag, address, is_guarded, remedy) in [
            (
                Port::Grpc,
                "--listen",
                listen,
                is_guarded,
                "give --tls-cert, --tls-key and --tokens, or ",
            ),
            (Port::Metrics, "--metrics-listen", metrics, false, ""),
        ] {
            if address.ip().is_loopback() || is_guarded {
                continue;
            }
            if self.insecure_listen.contains(&port) {
                exposed.push(port);
                continue;
            }
            let name = format!("{port:?}").to_lowercase();
            faults.push(format!(
                "{flag} {address} can be reached from other machines without TLS and authentication: \
                 {remedy}use 127.0.0.1, or accept that with --insecure-listen {name}"
            ));
        }
        let rates = Rates {
            requests_per_sec: self.max_requests_per_sec,
            max_streams: self.max_streams,
            upload_mib_per_sec: self.max_upload_mib_per_sec,
        };
        let crowding = Crowding {
            max_connections: self.max_connections,
            connections_per_sec: self.max_connections_per_sec,
        };
        Guard { credentials, tls, rates, crowding, origins: self.allow_origin, exposed }
    }

    fn credentials(&self, faults: &mut Vec<String>) -> Credentials {
        let rules = match (&self.jwks, &self.jwt_issuer, &self.jwt_audience) {
            (Some(jwks), Some(issuer), Some(audience)) => {
                let rules = JwtRules {
                    issuer: issuer.clone(),
                    audience: audience.clone(),
                    owner_claim: self.jwt_owner_claim.clone(),
                    role_claim: self.jwt_role_claim.clone(),
                };
                Some((jwks.clone(), rules))
            }
            (None, None, None) => None,
            _ => {
                let text = "JWTs need all of --jwks, --jwt-issuer and --jwt-audience";
                faults.push(text.into());
                None
            }
        };
        Credentials { tokens: self.tokens.clone(), jwt: rules }
    }
}
