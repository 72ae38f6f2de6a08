//! TLS: clients, workers and certificates that are replaced while the server runs.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Stdio,
    time::Duration,
};

use lookalike::service::{
    auth::Secret,
    client::{Access, connection},
    proto::v1::{self, lookalike_service_client::LookalikeServiceClient},
};
use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};
use tempfile::TempDir;
use tonic::Code;

use crate::{
    auth::{Client, token},
    support::{
        JOB, Server, create_request, eventually, lookalike, reference, results, small_torus,
        upload_as,
    },
};

/// An authority that signs certificates.
struct Authority {
    issuer: Issuer<'static, KeyPair>,
    pem: String,
}

impl Authority {
    fn new() -> Self {
        let mut params = CertificateParams::new(vec![]).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let key = KeyPair::generate().unwrap();
        let pem = params.self_signed(&key).unwrap().pem();
        Self { issuer: Issuer::new(params, key), pem }
    }

    /// Writes `{name}.pem`, `{name}.key` for a host, and the authority's `{name}-ca.pem`.
    fn write(&self, folder: &Path, name: &str, host: &str) {
        let key = KeyPair::generate().unwrap();
        let params = CertificateParams::new(vec![host.to_owned()]).unwrap();
        let certificate = params.signed_by(&key, &self.issuer).unwrap();
        fs::write(folder.join(format!("{name}.pem")), certificate.pem()).unwrap();
        fs::write(folder.join(format!("{name}.key")), key.serialize_pem()).unwrap();
        fs::write(folder.join(format!("{name}-ca.pem")), &self.pem).unwrap();
    }
}

/// A server with TLS that knows Ann's token and one worker's certificate.
struct Secured {
    server: Server,
    folder: TempDir,
    ann: String,
}

impl Secured {
    fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let at = folder.path();
        Authority::new().write(at, "server", "127.0.0.1");
        Authority::new().write(at, "worker", "w1.example.org");
        let ann = token(at, "ann", "ann", "user");
        let row = "\n[[principal]]\nname = \"w1\"\nowner = \"farm\"\nrole = \"worker\"\n\
                   certificate = \"w1.example.org\"\n";
        let tokens = at.join("tokens.toml");
        fs::write(&tokens, fs::read_to_string(&tokens).unwrap() + row).unwrap();
        let flag = |flag: &str, file: &str| format!("--{flag}={}", at.join(file).display());
        let flags = [
            flag("tokens", "tokens.toml"),
            flag("tls-cert", "server.pem"),
            flag("tls-key", "server.key"),
            flag("tls-client-ca", "worker-ca.pem"),
            "--workers=0".into(),
        ];
        let server = Server::start_with(&flags.each_ref().map(String::as_str));
        Self { server, folder, ann }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn client(&self, access: Access) -> Client {
        LookalikeServiceClient::new(connection(&self.server.url, &access).unwrap())
    }

    fn ann(&self) -> Access {
        let (token, ca) = (Some(Secret::new(&*self.ann)), Some(self.path("server-ca.pem")));
        Access { token, ca, ..Access::default() }
    }
}

async fn list(mut client: Client) -> Code {
    let answer = client.list_jobs(v1::ListJobsRequest::default()).await;
    answer.map_or_else(|status| status.code(), |_| Code::Ok)
}

#[tokio::test]
async fn a_job_under_tls_by_command_line_and_a_worker_with_a_certificate() {
    let secured = Secured::start();
    let mut worker = lookalike();
    worker.args(["worker", "--device=cpu", "--connect", &secured.server.url]);
    worker.arg("--ca").arg(secured.path("server-ca.pem"));
    worker.arg("--tls-cert").arg(secured.path("worker.pem"));
    worker.arg("--tls-key").arg(secured.path("worker.key"));
    let mut worker = worker.stderr(Stdio::null()).spawn().unwrap();
    let wanted = reference(&secured.server);
    let (file, out) = (
        secured.server.file("torus.ply", &small_torus()),
        secured.path("out").display().to_string(),
    );
    let mut submit =
        secured.server.command("submit", &[&[&*file, "--out", &out], &JOB[..]].concat());
    submit.arg("--ca").arg(secured.path("server-ca.pem")).env("LOOKALIKE_TOKEN", &secured.ann);
    let output = submit.output();
    worker.kill().unwrap();
    worker.wait().unwrap();
    let output = output.unwrap();
    assert!(output.status.success(), "{output:?}");
    assert_eq!(results(Path::new(&out)), wanted);
    assert!(!secured.server.logged().contains(&secured.ann));
}

#[tokio::test]
async fn only_the_right_certificates_are_trusted() {
    let secured = Secured::start();
    let (cert, key) = (Some(secured.path("worker.pem")), Some(secured.path("worker.key")));
    let strange = secured.folder.path();
    Authority::new().write(strange, "stranger", "w1.example.org");
    let stranger = (Some(secured.path("stranger.pem")), Some(secured.path("stranger.key")));
    let table = [
        ("a token", secured.ann(), Code::Ok),
        ("nothing", Access { token: None, ..secured.ann() }, Code::Unauthenticated),
        // Workers may not list jobs: that they are refused tells that they are known.
        (
            "a certificate",
            Access { token: None, cert, key, ..secured.ann() },
            Code::PermissionDenied,
        ),
        (
            "a certificate of another authority",
            Access { token: None, cert: stranger.0, key: stranger.1, ..secured.ann() },
            Code::Unavailable,
        ),
        (
            "a server of another authority",
            Access { ca: Some(secured.path("worker-ca.pem")), ..secured.ann() },
            Code::Unavailable,
        ),
    ];
    for (what, access, wanted) in table {
        let code = list(secured.client(access)).await;
        // A broken handshake is told in more than one way.
        let is_broken = matches!(code, Code::Unknown | Code::Cancelled);
        let code = if is_broken { Code::Unavailable } else { code };
        assert_eq!(code, wanted, "{what}");
    }
    // In the clear nobody is heard.
    let clear = secured.server.url.replace("https", "http");
    let client = LookalikeServiceClient::new(connection(&clear, &Access::default()).unwrap());
    assert_ne!(list(client).await, Code::Ok);
}

#[tokio::test]
async fn certificates_are_replaced_without_a_restart() {
    let secured = Secured::start();
    let old = secured.ann();
    let mut open = secured.client(old.clone());
    let mesh = upload_as(&mut open, small_torus()).await;
    let before = fs::read(secured.path("server-ca.pem")).unwrap();
    fs::write(secured.path("old-ca.pem"), before).unwrap();
    Authority::new().write(secured.folder.path(), "server", "127.0.0.1");
    eventually("the new certificate", || async {
        (list(secured.client(secured.ann())).await == Code::Ok).then_some(())
    })
    .await;
    let old = Access { ca: Some(secured.path("old-ca.pem")), ..old };
    assert_ne!(list(secured.client(old)).await, Code::Ok);
    // Who was connected stays connected.
    open.create_job(create_request(&mesh, "")).await.unwrap();
    // Nonsense in the files changes nothing.
    fs::write(secured.path("server.key"), "nonsense").unwrap();
    tokio::time::sleep(Duration::from_millis(600)).await;
    assert_eq!(list(secured.client(secured.ann())).await, Code::Ok);
    assert!(secured.server.logged().contains("what was read before still holds"));
}
