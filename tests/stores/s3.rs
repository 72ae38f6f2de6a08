//! An S3-compatible server of the tests' own: the crate `s3s-fs`, on a folder.

use std::{fs, net::SocketAddr, path::Path, sync::Arc};

use hyper_util::{
    rt::{TokioExecutor, TokioIo},
    server::conn::auto::Builder,
};
use s3s::{auth::SimpleAuth, service::S3ServiceBuilder};
use tempfile::TempDir;
use tokio::{net::TcpListener, runtime::Runtime, task::JoinSet};

const BUCKET: &str = "farm";
const KEY: &str = "tester";
const SECRET: &str = "of the tests' own";

/// A server with one bucket; it ends when it is dropped.
pub(crate) struct S3 {
    address: SocketAddr,
    folder: TempDir,
    /// A runtime of its own serves it, whoever waits.
    runtime: Option<Runtime>,
}

impl S3 {
    pub(crate) fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join(BUCKET)).unwrap();
        let mut builder = S3ServiceBuilder::new(s3s_fs::FileSystem::new(folder.path()).unwrap());
        builder.set_auth(SimpleAuth::from_single(KEY, SECRET));
        let service = builder.build();
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        listener.set_nonblocking(true).unwrap();
        let address = listener.local_addr().unwrap();
        let runtime = Runtime::new().unwrap();
        runtime.handle().spawn(async move {
            let listener = TcpListener::from_std(listener).unwrap();
            let server = Arc::new(Builder::new(TokioExecutor::new()));
            let mut connections = JoinSet::new();
            while let Ok((socket, _)) = listener.accept().await {
                let (server, service) = (Arc::clone(&server), service.clone());
                connections.spawn(async move {
                    let _ = server.serve_connection(TokioIo::new(socket), service).await;
                });
            }
        });
        Self { address, folder, runtime: Some(runtime) }
    }

    /// What `--objects` takes.
    pub(crate) fn url() -> String {
        format!("s3://{BUCKET}/some/prefix")
    }

    /// What a client of it finds in its environment.
    pub(crate) fn environment(&self) -> Vec<(String, String)> {
        let variables = [
            ("AWS_ENDPOINT_URL", format!("http://{}", self.address)),
            ("AWS_ACCESS_KEY_ID", KEY.into()),
            ("AWS_SECRET_ACCESS_KEY", SECRET.into()),
            ("AWS_REGION", "eu-test-1".into()),
        ];
        variables.map(|(name, value): (&str, String)| (name.into(), value)).into()
    }

    /// Where its objects are.
    pub(crate) fn folder(&self) -> &Path {
        self.folder.path()
    }
}

impl Drop for S3 {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}
