//! Bytes in and out, chunk by chunk: client streams into a bounded channel, files into streams.

use std::path::PathBuf;

use futures::{Stream, stream};
use tokio::{
    fs::File,
    io::{AsyncReadExt, AsyncSeekExt},
    sync::mpsc,
};
use tonic::{Status, Streaming, codegen::tokio_stream::StreamExt};

use super::status;
use crate::jobs::error::{Error, Result};
use prost::bytes::{Bytes, BytesMut};

/// Bytes of a chunk sent.
const CHUNK: usize = 256 << 10;
/// Chunks received ahead of the disk.
const AHEAD: usize = 8;

/// Feeds the chunks of a client's stream to `put`. A stream that breaks off puts nothing.
pub(super) async fn receive<M, T, F>(
    mut messages: Streaming<M>,
    chunk_of: fn(M) -> Option<Bytes>,
    put: impl FnOnce(mpsc::Receiver<Bytes>) -> F,
) -> std::result::Result<T, Status>
where
    F: Future<Output = Result<T>>,
{
    let (send, receive) = mpsc::channel(AHEAD);
    let feed = async move {
        while let Some(message) = messages.next().await {
            let chunk = chunk_of(message?);
            let chunk = chunk.ok_or_else(|| status::invalid("part", "only chunks may follow"))?;
            if send.send(chunk).await.is_err() {
                // `put` gave up, and will say why.
                break;
            }
        }
        Ok(())
    };
    let put = async { put(receive).await.map_err(|error| status::status_of(&error)) };
    // When `feed` fails, `put` is dropped before it learns that no more will come.
    let ((), stored) = tokio::try_join!(feed, put)?;
    Ok(stored)
}

/// The bytes of a file from `offset` on, at most `limit` of them.
pub(super) async fn send(
    path: PathBuf,
    offset: u64,
    limit: u64,
) -> Result<impl Stream<Item = Result<Bytes>>> {
    let mut file = File::open(&path).await.map_err(Error::io(&path))?;
    file.seek(std::io::SeekFrom::Start(offset)).await.map_err(Error::io(&path))?;
    let file = file.take(limit);
    Ok(stream::try_unfold((file, path), |(mut file, path)| async move {
        let mut chunk = BytesMut::with_capacity(CHUNK);
        let n_read = file.read_buf(&mut chunk).await.map_err(Error::io(&path))?;
        Ok((n_read > 0).then(|| (chunk.freeze(), (file, path))))
    }))
}
