//! Bytes in, chunk by chunk: client streams into a bounded channel.

use std::time::Duration;

use tokio::{sync::mpsc, time::timeout};
use tonic::{Status, Streaming, codegen::tokio_stream::StreamExt};

use super::{observe, status};
use crate::jobs::error::Result;
use prost::bytes::Bytes;

/// Chunks received ahead of the disk.
const AHEAD: usize = 8;
/// A stream on which nothing comes for so long is given up: each has a thread that waits for it.
const SILENCE: Duration = Duration::from_secs(60);

fn silent() -> Status {
    let text = format!("nothing came for {} s: send it again", SILENCE.as_secs());
    Status::deadline_exceeded(text)
}

/// Feeds the chunks of a client's stream to `put`, and counts them as bytes of `what`; `wait` says how long so many bytes
/// have to. A stream that breaks off puts nothing.
pub(super) async fn receive<M, T, F>(
    what: &'static str,
    mut messages: Streaming<M>,
    (chunk_of, wait): (fn(M) -> Option<Bytes>, impl Fn(usize) -> Option<Duration>),
    put: impl FnOnce(mpsc::Receiver<Bytes>) -> F,
) -> std::result::Result<T, Status>
where
    F: Future<Output = Result<T>>,
{
    let (send, receive) = mpsc::channel(AHEAD);
    let n_bytes = observe::received(what);
    let feed = async move {
        while let Some(message) = timeout(SILENCE, messages.next()).await.map_err(|_| silent())? {
            let chunk = chunk_of(message?);
            let chunk = chunk.ok_or_else(|| status::invalid("part", "only chunks may follow"))?;
            n_bytes.increment(chunk.len() as u64);
            if let Some(wait) = wait(chunk.len()).filter(|wait| !wait.is_zero()) {
                tokio::time::sleep(wait).await;
            }
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
