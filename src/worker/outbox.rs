//! The outbox: takes what the pipeline reports and brings it to the server, in order, for certain.
//!
//! 1. Events go in batches of at most 100 ms, 100 events or 1 MiB of records; a batch is repeated
//!    unchanged until it is acknowledged.
//! 2. A file is stored before the event that tells of it is sent.
//! 3. A piece of the checkpoint is sent when all events before it are acknowledged, and before any event after it.
//!
//! While the server is away the channel fills and then the pipeline waits: memory stays bounded.

use std::{path::PathBuf, time::Duration};

use prost::bytes::Bytes;
use tokio::{
    sync::{mpsc, watch},
    time::{Instant, timeout_at},
};

use super::{
    attempt::Stop,
    link::{Link, LinkError},
};
use crate::{
    jobs::{event::Report, lease::Lease, store::Artifact},
    service::{convert, proto::worker::v1::WorkerEvent},
};

/// Reports that the pipeline may be ahead.
pub const AHEAD: usize = 512;
const MAX_EVENTS: usize = 100;
const MAX_BYTES: usize = 1 << 20;
const MAX_DELAY: Duration = Duration::from_millis(100);

/// Media types by extension, for files that the pipeline wrote without a word.
const MEDIA_TYPES: [(&str, &str); 8] = [
    ("glb", "model/gltf-binary"),
    ("ply", "application/octet-stream"),
    ("lkpm", "application/octet-stream"),
    ("csv", "text/csv"),
    ("json", "application/json"),
    ("png", "image/png"),
    ("svg", "image/svg+xml"),
    ("txt", "text/plain"),
];

/// What one attempt has to say.
#[derive(Debug)]
pub struct Outbox {
    /// The connection.
    pub link: Link,
    /// The right to speak.
    pub lease: Lease,
    /// Where the pipeline writes its files.
    pub out_dir: PathBuf,
    /// Told when the server wants the attempt to stop.
    pub stop: watch::Sender<Option<Stop>>,
    /// Events acknowledged.
    pub n_sent: u64,
    /// Files stored.
    pub files: Vec<String>,
    /// Pieces of the checkpoint stored, those of the attempts before included.
    pub n_pieces: u32,
}

/// What the pipeline's thread sends.
#[derive(Debug)]
pub enum Parcel {
    /// For the event log.
    Report(Report),
    /// The next piece of the checkpoint: all reports before it belong to it.
    Piece(Vec<u8>),
}

impl Outbox {
    /// Sends what arrives until the channel closes.
    pub async fn run(&mut self, parcels: &mut mpsc::Receiver<Parcel>) -> Result<(), LinkError> {
        while let Some(first) = parcels.recv().await {
            let deadline = Instant::now() + MAX_DELAY;
            let (mut batch, mut piece) = (Batch::default(), None);
            let mut next = Some(first);
            while let Some(parcel) = next {
                match parcel {
                    Parcel::Report(report) => self.add(&mut batch, report).await?,
                    Parcel::Piece(bytes) => piece = Some(Bytes::from(bytes)),
                }
                let has_room = piece.is_none() && !batch.is_full();
                next = if has_room {
                    timeout_at(deadline, parcels.recv()).await.ok().flatten()
                } else {
                    None
                };
            }
            self.send(batch).await?;
            if let Some(piece) = piece {
                self.link.put_piece(&self.lease, self.n_pieces, &piece).await?;
                self.n_pieces += 1;
            }
        }
        Ok(())
    }

    async fn add(&mut self, batch: &mut Batch, report: Report) -> Result<(), LinkError> {
        if let Report::Artifact { name, media_type, .. } = &report {
            self.store(name, media_type).await?;
        }
        batch.add(report);
        Ok(())
    }

    /// Stores the files that the pipeline did not report.
    pub async fn store_rest(&mut self) -> Result<(), LinkError> {
        for name in self.unstored().await? {
            let media_type = media_type_of(&name);
            let size = self.store(&name, media_type).await?;
            let report = Report::Artifact { name, media_type: media_type.into(), size };
            let mut batch = Batch::default();
            batch.add(report);
            self.send(batch).await?;
        }
        Ok(())
    }

    async fn send(&mut self, batch: Batch) -> Result<(), LinkError> {
        if batch.events.is_empty() {
            return Ok(());
        }
        let appended = self.link.append(&self.lease, self.n_sent, batch.events).await?;
        self.n_sent = appended.held;
        Stop::obey(appended.orders, &self.stop);
        Ok(())
    }

    /// Stores a file; its size.
    async fn store(&mut self, name: &str, media_type: &str) -> Result<u64, LinkError> {
        let path = self.out_dir.join(name);
        let (size, blake3) = {
            let path = path.clone();
            tokio::task::spawn_blocking(move || hash(&path)).await.unwrap_or_else(|e| Err(e.into()))
        }
        .map_err(|source| LinkError::File { path: path.display().to_string(), source })?;
        let (file, media_type) = (name.to_owned(), media_type.to_owned());
        let artifact = Artifact { file, media_type, size, blake3 };
        self.link.put_artifact(&self.lease, &artifact, &path).await?;
        if !self.files.contains(&artifact.file) {
            self.files.push(artifact.file);
        }
        Ok(size)
    }

    async fn unstored(&self) -> Result<Vec<String>, LinkError> {
        let fault = |source| LinkError::File { path: self.out_dir.display().to_string(), source };
        let mut folder = tokio::fs::read_dir(&self.out_dir).await.map_err(fault)?;
        let mut names = Vec::new();
        while let Some(entry) = folder.next_entry().await.map_err(fault)? {
            let is_file = entry.file_type().await.map_err(fault)?.is_file();
            let name = entry.file_name().to_string_lossy().into_owned();
            if is_file && !self.files.contains(&name) {
                names.push(name);
            }
        }
        names.sort();
        Ok(names)
    }
}

#[derive(Debug, Default)]
struct Batch {
    events: Vec<WorkerEvent>,
    n_bytes: usize,
}

impl Batch {
    fn add(&mut self, report: Report) {
        if let Report::Records { bytes, .. } = &report {
            self.n_bytes += bytes.len();
        }
        self.events.push(WorkerEvent { body: Some(convert::report_to_wire(report)) });
    }

    fn is_full(&self) -> bool {
        self.events.len() >= MAX_EVENTS || self.n_bytes >= MAX_BYTES
    }
}

/// The media type of a file, by its extension.
pub fn media_type_of(name: &str) -> &'static str {
    let extension = name.rsplit_once('.').map_or("", |(_, extension)| extension);
    let row = MEDIA_TYPES.iter().find(|(known, _)| *known == extension);
    row.map_or("application/octet-stream", |(_, media_type)| media_type)
}

fn hash(path: &std::path::Path) -> std::io::Result<(u64, String)> {
    let mut hasher = blake3::Hasher::new();
    let size = std::io::copy(&mut std::fs::File::open(path)?, &mut hasher)?;
    Ok((size, hasher.finalize().to_hex().to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn batches_fill_by_count_and_by_bytes() {
        let mut batch = Batch::default();
        for _ in 0..MAX_EVENTS - 1 {
            batch.add(Report::Note { code: "A".into(), text: String::new() });
        }
        assert!(!batch.is_full());
        batch.add(Report::Note { code: "A".into(), text: String::new() });
        assert!(batch.is_full());
        let mut batch = Batch::default();
        batch.add(Report::Records { level: None, first: 0, count: 1, bytes: vec![0; MAX_BYTES] });
        assert!(batch.is_full());
    }

    #[test]
    fn media_types_follow_extensions() {
        assert_eq!(media_type_of("lod-0.glb"), "model/gltf-binary");
        assert_eq!(media_type_of("strange"), "application/octet-stream");
    }
}
