//! Objects in a bucket of any S3-compatible store. An upload shows nothing before it is whole, and what
//! the store has acknowledged it keeps.
//!
//! Credentials, region and endpoint come from the usual `AWS_*` variables.

use std::{
    net::IpAddr,
    ops::Range,
    sync::Arc,
    time::{Duration, SystemTime},
};

use futures::{FutureExt, StreamExt, TryStreamExt, future::BoxFuture, stream, stream::BoxStream};
use object_store::{
    ClientOptions, GetOptions, GetRange, ObjectStore, ObjectStoreExt, RetryConfig,
    aws::{AmazonS3Builder, AmazonS3ConfigKey},
    buffered::BufWriter,
    path::Path,
    prefix::PrefixStore,
};
use tokio::io::{AsyncWriteExt, BufReader};
use tokio_util::bytes::Bytes;

use super::{Objects, Staged};
use crate::jobs::error::{Error, Result};

/// Least bytes of a part of an upload, and how many parts are in flight.
const PART: u64 = 8 << 20;
const PARTS_AHEAD: usize = 2;
/// S3 allows 10,000 parts.
const MAX_PARTS: u64 = 9_000;
/// A request is repeated for so long before the caller hears of it.
const PATIENCE: Duration = Duration::from_secs(15);
/// A connection that says nothing for so long is given up.
const SILENCE: Duration = Duration::from_secs(30);

/// A bucket and a prefix in it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BucketName {
    bucket: String,
    prefix: String,
}

impl BucketName {
    /// Reads `s3://bucket/prefix`.
    pub fn parse(url: &str) -> std::result::Result<Self, String> {
        let fault = || format!("`{}`: use s3://BUCKET or s3://BUCKET/PREFIX", url.escape_default());
        let rest = url.strip_prefix("s3://").ok_or_else(fault)?;
        let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
        let is_name = |c: u8| c.is_ascii_alphanumeric() || b"-._".contains(&c);
        let prefix = prefix.trim_end_matches('/');
        if bucket.is_empty() || !bucket.bytes().all(is_name) || Path::parse(prefix).is_err() {
            return Err(fault());
        }
        Ok(Self { bucket: bucket.into(), prefix: prefix.into() })
    }
}

impl std::fmt::Display for BucketName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "s3://{}/{}", self.bucket, self.prefix)
    }
}

/// The bucket.
#[derive(Debug)]
pub(super) struct Bucket {
    store: Arc<dyn ObjectStore>,
}

impl Bucket {
    /// Opens the bucket without asking whether it is there.
    pub(super) fn open(
        name: &BucketName,
        environment: impl IntoIterator<Item = (String, String)>,
    ) -> Result<Self> {
        let config =
            environment.into_iter().fold(AmazonS3Builder::new(), |config, (name, value)| {
                // An empty variable is none.
                match name.to_ascii_lowercase().parse() {
                    Ok(key) if name.starts_with("AWS_") && !value.is_empty() => {
                        config.with_config(key, value)
                    }
                    _ => config,
                }
            });
        // A second call finds it installed.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let fault = |source| Error::Objects { key: name.to_string(), source };
        let endpoint = [AmazonS3ConfigKey::S3Endpoint, AmazonS3ConfigKey::Endpoint]
            .iter()
            .find_map(|key| config.get_config_value(key));
        let plain = endpoint.as_deref().is_some_and(|url| url.starts_with("http://"));
        if let Some(endpoint) = endpoint.filter(|url| plain && !is_loopback(url)) {
            return Err(Error::PlainEndpoint(endpoint));
        }
        let client = ClientOptions::new()
            .with_allow_http(plain)
            // Bodies may be of any size: what counts is that they keep coming.
            .with_timeout_disabled()
            .with_read_timeout(SILENCE)
            .with_connect_timeout(Duration::from_secs(5));
        let retry = RetryConfig { max_retries: 6, retry_timeout: PATIENCE, ..Default::default() };
        let config = config.with_bucket_name(&name.bucket).with_client_options(client);
        let store = config.with_retry(retry).build().map_err(fault)?;
        Ok(Self { store: Arc::new(PrefixStore::new(store, name.prefix.as_str())) })
    }
}

impl Objects for Bucket {
    fn commit(&self, staged: Staged, key: String) -> BoxFuture<'_, Result<()>> {
        Box::pin(async move {
            let file = tokio::fs::File::open(&staged.path).await;
            let file = file.map_err(Error::io(&staged.path))?;
            let mut file = BufReader::with_capacity(1 << 20, file);
            let part = PART.max(staged.size / MAX_PARTS + 1) as usize;
            let upload = BufWriter::with_capacity(Arc::clone(&self.store), path(&key), part);
            let mut upload = upload.with_max_concurrency(PARTS_AHEAD);
            let sent = async {
                tokio::io::copy_buf(&mut file, &mut upload).await?;
                upload.shutdown().await
            };
            if let Err(source) = sent.await {
                // Parts of an upload that cannot be taken back now are for the bucket's life cycle.
                let _ = upload.abort().await;
                let source = object_store::Error::Generic { store: "S3", source: source.into() };
                return Err(Error::Objects { key, source });
            }
            staged.discard();
            Ok(())
        })
    }

    fn put(&self, bytes: Vec<u8>, key: String) -> BoxFuture<'_, Result<()>> {
        Box::pin(async move {
            let done = self.store.put(&path(&key), bytes.into()).await;
            done.map(drop).map_err(|source| Error::Objects { key, source })
        })
    }

    fn read(
        &self,
        key: String,
        range: Range<u64>,
    ) -> BoxFuture<'_, Result<BoxStream<'static, Result<Bytes>>>> {
        Box::pin(async move {
            let range = match range {
                range if range.is_empty() => return Ok(stream::empty().boxed()),
                Range { start: 0, end: u64::MAX } => None,
                Range { start, end: u64::MAX } => Some(GetRange::Offset(start)),
                range => Some(GetRange::Bounded(range)),
            };
            let options = GetOptions { range, ..GetOptions::default() };
            let location = path(&key);
            let fault = move |source| Error::Objects { key: key.clone(), source };
            let found = self.store.get_opts(&location, options).await.map_err(&fault)?;
            Ok(found.into_stream().map_err(fault).boxed())
        })
    }

    fn exists(&self, key: String) -> BoxFuture<'_, Result<bool>> {
        Box::pin(async move {
            match self.store.head(&path(&key)).await {
                Ok(_) => Ok(true),
                Err(object_store::Error::NotFound { .. }) => Ok(false),
                Err(source) => Err(Error::Objects { key, source }),
            }
        })
    }

    fn remove(&self, key: String) -> BoxFuture<'_, Result<()>> {
        Box::pin(async move {
            match self.store.delete(&path(&key)).await {
                Ok(()) | Err(object_store::Error::NotFound { .. }) => Ok(()),
                Err(source) => Err(Error::Objects { key, source }),
            }
        })
    }

    fn remove_folder(&self, key: String) -> BoxFuture<'_, Result<()>> {
        let files = self.store.list(Some(&path(&key))).map_ok(|file| file.location).boxed();
        let removed = self.store.delete_stream(files).filter_map(async |done| match done {
            Err(object_store::Error::NotFound { .. }) => None,
            done => Some(done.map(drop)),
        });
        let removed = removed.try_collect::<()>();
        removed.map(|done| done.map_err(|source| Error::Objects { key, source })).boxed()
    }

    fn folders(&self, key: String) -> BoxFuture<'_, Result<Vec<String>>> {
        Box::pin(async move {
            let listed = self.store.list_with_delimiter(Some(&path(&key))).await;
            let listed = listed.map_err(|source| Error::Objects { key, source })?;
            Ok(listed.common_prefixes.iter().filter_map(name).collect())
        })
    }

    fn files(&self, key: String) -> BoxFuture<'_, Result<Vec<(String, SystemTime)>>> {
        let files = self.store.list(Some(&path(&key)));
        let files = files.try_filter_map(async |file| {
            Ok(name(&file.location).map(|name| (name, SystemTime::from(file.last_modified))))
        });
        let files = files.try_collect::<Vec<_>>();
        files.map(|found| found.map_err(|source| Error::Objects { key, source })).boxed()
    }
}

/// Keys consist of safe names: nothing in them is escaped.
fn path(key: &str) -> Path {
    Path::from(key)
}

fn name(path: &Path) -> Option<String> {
    path.filename().map(Into::into)
}

/// Whether a URL leads to this machine, so that nobody can listen in.
fn is_loopback(url: &str) -> bool {
    let rest = url.split_once("://").map_or("", |(_, rest)| rest);
    let authority = rest.split(['/', '?', '#']).next().unwrap_or_default();
    let host = authority.rsplit_once('@').map_or(authority, |(_, host)| host);
    let host = match host.strip_prefix('[').and_then(|host| host.split_once(']')) {
        Some((address, _)) => address,
        None => host.split(':').next().unwrap_or_default(),
    };
    host == "localhost" || host.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_buckets_are_checked() {
        for (url, shown) in
            [("s3://b", "s3://b/"), ("s3://b/", "s3://b/"), ("s3://a-b.c/d/e/", "s3://a-b.c/d/e")]
        {
            assert_eq!(BucketName::parse(url).unwrap().to_string(), shown);
        }
        for bad in ["", "b", "http://b", "s3://", "s3:///p", "s3://b c", "s3://b/p//q", "s3://b/.."]
        {
            assert!(BucketName::parse(bad).unwrap_err().contains("s3://BUCKET"), "{bad}");
        }
    }

    #[test]
    fn plain_http_stays_on_this_machine() {
        let name = BucketName::parse("s3://b").unwrap();
        let open = |url: &str| Bucket::open(&name, [("AWS_ENDPOINT_URL".into(), url.into())]);
        for good in ["http://127.0.0.1:1", "http://localhost/x", "http://[::1]:9", "https://x.org"]
        {
            open(good).unwrap();
        }
        for bad in ["http://10.0.0.1", "http://localhost.org", "http://127.0.0.1@x.org/"] {
            assert!(matches!(open(bad), Err(Error::PlainEndpoint(_))), "{bad}");
        }
    }
}
