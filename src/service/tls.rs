//! TLS for the server's TCP socket: rustls with ring.

use std::{fs, path::PathBuf, sync::Arc};

use tokio_rustls::{
    TlsAcceptor,
    rustls::{
        RootCertStore, ServerConfig,
        crypto::ring::default_provider,
        pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject},
        server::WebPkiClientVerifier,
    },
};

use super::auth::Watched;

/// Where the server's certificate and key are, in PEM.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TlsFiles {
    /// The certificate, then those that lead to its authority.
    pub cert: PathBuf,
    /// Its private key.
    pub key: PathBuf,
    /// The authorities of client certificates; where there are none, clients need none.
    pub client_ca: Option<PathBuf>,
}

/// What a server's certificate says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Identity {
    /// DNS names and URIs.
    pub names: Vec<String>,
    /// From when to when it is good, in seconds since 1970.
    pub valid_secs: (i64, i64),
}

impl TlsFiles {
    /// What the certificate says, if all files can be used together; else why not.
    pub fn identity(&self) -> Result<Identity, String> {
        ServerTls::open(self)?;
        let fault = |what: &str| format!("{}: {what}", self.cert.display());
        let pem = fs::read(&self.cert).map_err(|error| fault(&error.to_string()))?;
        let chain = certificates(&pem).map_err(|text| fault(&text))?;
        let first = chain.first().ok_or_else(|| fault("there is no certificate in it"))?;
        let (_, parsed) =
            x509_parser::parse_x509_certificate(first).map_err(|e| fault(&e.to_string()))?;
        let valid = parsed.validity();
        let valid_secs = (valid.not_before.timestamp(), valid.not_after.timestamp());
        Ok(Identity { names: certificate_names(first), valid_secs })
    }
}

/// What TLS connections are accepted with.
#[derive(Debug)]
pub struct ServerTls(Watched<ServerConfig>);

impl ServerTls {
    /// Reads the files now, and again when they change; the fault names them.
    pub fn open(files: &TlsFiles) -> Result<Self, String> {
        let paths = [Some(&files.cert), Some(&files.key), files.client_ca.as_ref()];
        let paths = paths.into_iter().flatten().cloned().collect();
        Ok(Self(Watched::open(paths, config)?))
    }

    /// For the next connection.
    pub(super) fn acceptor(&self) -> TlsAcceptor {
        TlsAcceptor::from(self.0.get())
    }
}

fn config(contents: &[Vec<u8>]) -> Result<ServerConfig, String> {
    let [cert, key, client_ca @ ..] = contents else {
        return Err("a certificate and its key are needed".into());
    };
    let chain = certificates(cert).map_err(|fault| format!("the certificate: {fault}"))?;
    let key = PrivateKeyDer::from_pem_slice(key).map_err(|e| format!("the private key: {e}"))?;
    let provider = Arc::new(default_provider());
    let versions = ServerConfig::builder_with_provider(Arc::clone(&provider))
        .with_safe_default_protocol_versions()
        .map_err(|error| error.to_string())?;
    let clients = match client_ca.first() {
        None => versions.with_no_client_auth(),
        Some(pem) => {
            let mut roots = RootCertStore::empty();
            for authority in certificates(pem).map_err(|f| format!("the clients' CA: {f}"))? {
                roots.add(authority).map_err(|e| format!("the clients' CA: {e}"))?;
            }
            // Those without a certificate may have a token.
            let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider);
            let verifier = verifier.allow_unauthenticated().build();
            versions.with_client_cert_verifier(verifier.map_err(|e| e.to_string())?)
        }
    };
    let mut config = clients.with_single_cert(chain, key).map_err(|error| error.to_string())?;
    config.alpn_protocols = vec![b"h2".to_vec(), b"http/1.1".to_vec()];
    Ok(config)
}

fn certificates(pem: &[u8]) -> Result<Vec<CertificateDer<'static>>, String> {
    let found: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(pem).collect();
    let found = found.map_err(|error| error.to_string())?;
    if found.is_empty() { Err("it is not in PEM".into()) } else { Ok(found) }
}

/// The DNS names and URIs of a certificate; none when it cannot be read.
pub(super) fn certificate_names(certificate: &CertificateDer<'_>) -> Vec<String> {
    let Ok(certificate) = webpki::EndEntityCert::try_from(certificate) else { return Vec::new() };
    let names = certificate.valid_dns_names().chain(certificate.valid_uri_names());
    names.map(Into::into).collect()
}
