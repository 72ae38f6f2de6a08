//! What whoever keeps objects has to do: one suite, on a directory and on an S3-compatible server.

use std::time::Duration;

use tempfile::TempDir;

use super::*;
use crate::jobs::{
    error::Error,
    tests::{in_homes, s3::S3},
};

/// Objects, and what they are kept in.
pub(super) struct Home {
    blobs: Blobs,
    dir: TempDir,
    server: Option<S3>,
}

impl Home {
    fn in_a_directory() -> Self {
        let dir = tempfile::tempdir().unwrap();
        Self { blobs: Blobs::open(dir.path(), None).unwrap(), dir, server: None }
    }

    fn in_a_bucket() -> Self {
        let (dir, server) = (tempfile::tempdir().unwrap(), S3::start());
        let staging = Arc::new(Staging::open(&dir.path().join("tmp")).unwrap());
        let name = BucketName::parse(&S3::url()).unwrap();
        let objects = Arc::new(Bucket::open(&name, server.environment()).unwrap());
        let partials = Arc::new(Partials::open(&dir.path().join("partial")).unwrap());
        Self { blobs: Blobs { staging, partials, objects }, dir, server: Some(server) }
    }

    /// Stages bytes in pieces of a mebibyte.
    async fn stage(&self, bytes: &[u8], limit: u64) -> Result<Staged> {
        let (send, receive) = mpsc::channel(1);
        let feed = async move {
            for piece in bytes.chunks(1 << 20) {
                if send.send(Bytes::copy_from_slice(piece)).await.is_err() {
                    break;
                }
            }
        };
        tokio::join!(self.blobs.stage(receive, limit), feed).0
    }

    fn n_staged(&self) -> usize {
        std::fs::read_dir(self.dir.path().join("tmp")).unwrap().count()
    }
}

async fn bytes_of(blob: &Blob, offset: u64, limit: u64) -> Vec<u8> {
    let chunks: Vec<_> = blob.read(offset, limit).await.unwrap().try_collect().await.unwrap();
    chunks.concat()
}

in_homes! { [in_a_directory in_a_bucket] [
    staged_bytes_vanish_unless_committed,
    transfers_are_capped,
    large_objects_come_back_whole_and_in_ranges,
    jobs_and_attempts_are_removed_as_a_whole,
    meshes_are_listed_with_their_age,
    what_is_not_there_is_a_fault_or_fine,
] }

async fn staged_bytes_vanish_unless_committed(home: Home) {
    let staged = home.stage(b"abc", 3).await.unwrap();
    let hash = blake3::hash(b"abc").to_hex().to_string();
    assert_eq!((staged.size, &staged.hash), (3, &hash));
    assert!(!home.blobs.has_mesh(&hash).await.unwrap());
    home.blobs.commit_mesh(staged).await.unwrap();
    assert!(home.blobs.has_mesh(&hash).await.unwrap());
    if let Some(server) = &home.server {
        let mesh = format!("farm/some/prefix/meshes/{}/{hash}", &hash[..2]);
        assert!(server.folder().join(mesh).exists());
    }
    assert_eq!(bytes_of(&home.blobs.mesh(&hash, 3), 0, u64::MAX).await, b"abc");
    drop(home.stage(b"def", 3).await.unwrap());
    assert_eq!(home.n_staged(), 0);
}

async fn transfers_are_capped(home: Home) {
    assert!(matches!(home.stage(b"0123456789", 9).await, Err(Error::TooLarge { limit: 9, .. })));
    assert_eq!(home.n_staged(), 0);
}

async fn large_objects_come_back_whole_and_in_ranges(home: Home) {
    // Three parts of an upload, the last of which is short.
    let bytes: Vec<u8> = (0..5_000_000u32).flat_map(u32::to_le_bytes).collect();
    let size = bytes.len() as u64;
    for again in 0..2 {
        let staged = home.stage(&bytes[again..], size).await.unwrap();
        home.blobs.commit_artifact(staged, "j", 1, "lod-0.glb").await.unwrap();
    }
    // The second replaced the first.
    let (bytes, size) = (&bytes[1..], size - 1);
    let blob = home.blobs.artifact("j", 1, "lod-0.glb", size);
    assert!(bytes_of(&blob, 0, u64::MAX).await == bytes);
    for (offset, limit) in [(0, 1), (9_999_999, 3_000_000), (size - 1, u64::MAX), (size, 1), (7, 0)]
    {
        let end = offset.saturating_add(limit).min(size);
        let wanted = &bytes[offset as usize..end as usize];
        assert!(bytes_of(&blob, offset, limit).await == wanted, "{offset} {limit}");
    }
    let staged = home.stage(b"", 0).await.unwrap();
    home.blobs.commit_artifact(staged, "j", 1, "empty").await.unwrap();
    assert_eq!(bytes_of(&home.blobs.artifact("j", 1, "empty", 0), 0, 9).await, b"");
}

async fn jobs_and_attempts_are_removed_as_a_whole(home: Home) {
    let blobs = &home.blobs;
    for job in ["a", "ab"] {
        for epoch in [1, 2, 10] {
            blobs.put_segment(vec![7; 9], job, epoch, "s.zst").await.unwrap();
            let staged = home.stage(b"x", 1).await.unwrap();
            blobs.commit_artifact(staged, job, epoch, "x").await.unwrap();
        }
    }
    blobs.remove_artifacts_before("a", 10).await.unwrap();
    for (epoch, is_there) in [(1, false), (2, false), (10, true)] {
        let read = blobs.artifact("a", epoch, "x", 1).read(0, 1).await;
        assert_eq!(read.is_ok(), is_there, "epoch {epoch}");
        assert_eq!(blobs.segment("a", epoch, "s.zst").await.unwrap(), [7; 9]);
    }
    blobs.remove_job("a").await.unwrap();
    assert!(blobs.segment("a", 10, "s.zst").await.is_err());
    assert_eq!(blobs.jobs().await.unwrap(), ["ab"]);
    assert_eq!(bytes_of(&blobs.artifact("ab", 1, "x", 1), 0, 1).await, b"x");
}

async fn meshes_are_listed_with_their_age(home: Home) {
    assert_eq!(home.blobs.meshes().await.unwrap(), []);
    let mut hashes = Vec::new();
    for bytes in [b"one", b"two"] {
        let staged = home.stage(bytes, 3).await.unwrap();
        hashes.push(staged.hash.clone());
        home.blobs.commit_mesh(staged).await.unwrap();
    }
    let mut listed = home.blobs.meshes().await.unwrap();
    for (_, written) in &listed {
        assert!(written.elapsed().unwrap_or_default() < Duration::from_mins(1));
    }
    listed.sort();
    hashes.sort();
    assert!(listed.iter().map(|(hash, _)| hash).eq(&hashes));
    home.blobs.remove_mesh(&hashes[0]).await.unwrap();
    assert_eq!(home.blobs.meshes().await.unwrap().len(), 1);
}

async fn what_is_not_there_is_a_fault_or_fine(home: Home) {
    let hash = "0".repeat(64);
    let fault = home.blobs.mesh(&hash, 9).read(0, 9).await.err().unwrap();
    assert!(fault.to_string().contains(&hash) && !fault.is_passing(), "{fault}");
    home.blobs.remove_mesh(&hash).await.unwrap();
    home.blobs.remove_job("none").await.unwrap();
    assert_eq!(home.blobs.jobs().await.unwrap(), Vec::<String>::new());
}
