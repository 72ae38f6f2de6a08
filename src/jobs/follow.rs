//! Following a log: replay after a number, then wait for more, until the job has ended.
//!
//! A follower reads at its own pace from the database and holds one page and one segment, which it shares with
//! those at the same place of the same log; however slow it is, no worker waits for it. Of the followers of one reader
//! some read at a time and the others wait for them, so that a thousand do not keep others from the database.

use std::{sync::Arc, time::Duration};

use futures::Stream;
use tokio::{sync::watch, time::timeout};

use super::{
    Jobs,
    error::{Error, Result},
    event::{Body, Event, Report},
    segment,
    store::{SegmentRange, StoredEvent},
};

/// Entries read at once.
const PAGE: u32 = 256;
/// The log is looked at this often even when nobody calls.
const POLL: Duration = Duration::from_secs(2);

struct Follower {
    jobs: Jobs,
    /// Whose follower it is.
    reader: String,
    id: String,
    last_seq: u64,
    page: Arc<[StoredEvent]>,
    /// Of its entries, so many have been handed out.
    n_out: usize,
    grew: watch::Receiver<()>,
    /// The segment last unpacked: neighbours in the log share it.
    segment: (String, Arc<Vec<u8>>),
    ended: bool,
    /// The last entry that was handed out ended the job.
    saw_end: bool,
}

impl Jobs {
    /// The log of a job after `after_seq`, live; ends after the entry that ended the job for the last time. Fails when
    /// there is no such job, also when it is deleted before its end was seen. `reader` is the owner that asks.
    pub fn follow(
        &self,
        reader: &str,
        id: &str,
        after_seq: u64,
    ) -> impl Stream<Item = Result<Event>> + use<> {
        let follower = Follower {
            jobs: self.clone(),
            reader: reader.into(),
            id: id.into(),
            last_seq: after_seq,
            page: Arc::default(),
            n_out: 0,
            grew: self.0.signals.watch_log(id),
            segment: Default::default(),
            ended: false,
            saw_end: false,
        };
        futures::stream::try_unfold(follower, |mut follower| async move {
            Ok(follower.next().await?.map(|event| (event, follower)))
        })
    }
}

impl Jobs {
    /// At most `limit` entries of a log after `after_seq`, in order, without the bytes of records.
    pub async fn entries(&self, id: &str, after_seq: u64, limit: u32) -> Result<Vec<Event>> {
        let page = self.0.store.events(id, after_seq, limit).await?;
        Ok(page.into_iter().map(|stored| stored.event).collect())
    }
}

impl Follower {
    async fn next(&mut self) -> Result<Option<Event>> {
        while self.n_out == self.page.len() && !self.ended {
            self.grew.mark_unchanged();
            (self.page, self.n_out) = (self.following_page().await?, 0);
            if self.page.is_empty() && !self.ended {
                // Time out or not: look again.
                let _ = timeout(POLL, self.grew.changed()).await;
            }
        }
        let Some(StoredEvent { mut event, bytes }) = self.page.get(self.n_out).cloned() else {
            return Ok(None);
        };
        self.n_out += 1;
        if let (Body::Worker(Report::Records { bytes, .. }), Some(range)) = (&mut event.body, bytes)
        {
            *bytes = self.read(event.epoch, range).await?;
        }
        self.last_seq = event.seq;
        self.saw_end = event.body.state().is_some_and(super::state::State::is_final);
        Ok(Some(event))
    }

    /// What follows in the log, and with nothing, whether it has ended. A full page never changes: it is shared.
    async fn following_page(&mut self) -> Result<Arc<[StoredEvent]>> {
        let inner = &self.jobs.0;
        let _turn = inner.readers.of(&self.reader).await;
        let key = format!("{}/{}", self.id, self.last_seq);
        if let Some(page) = inner.pages.get(&key) {
            return Ok(page);
        }
        // The job first: if it has ended, the page that follows holds the last entry.
        let has_ended = match self.jobs.job(&self.id).await {
            Err(Error::NotFound(_)) if self.saw_end => true,
            found => found?.state.is_final(),
        };
        let page: Arc<[_]> = inner.store.events(&self.id, self.last_seq, PAGE).await?.into();
        self.ended = page.is_empty() && has_ended;
        if page.len() == PAGE as usize {
            inner.pages.keep(key, Arc::clone(&page));
        }
        Ok(page)
    }

    async fn read(&mut self, epoch: u64, range: SegmentRange) -> Result<Vec<u8>> {
        if self.segment.0 != range.segment {
            let bytes = self.unpacked(epoch, &range.segment).await?;
            self.segment = (range.segment, bytes);
        }
        let span = range.offset as usize..(range.offset + range.len) as usize;
        let fault = || Error::Corrupt {
            what: format!("record segment {}", self.segment.0),
            fault: format!("it has no bytes {span:?}"),
        };
        Ok(self.segment.1.get(span.clone()).ok_or_else(fault)?.to_vec())
    }
    /// The bytes of a segment, read anew unless somebody has just done it.
    async fn unpacked(&self, epoch: u64, name: &str) -> Result<Arc<Vec<u8>>> {
        let inner = &self.jobs.0;
        let _turn = inner.readers.of(&self.reader).await;
        let key = format!("{}/{epoch}/{name}", self.id);
        if let Some(bytes) = inner.unpacked.get(&key) {
            return Ok(bytes);
        }
        let packed = inner.blobs.segment(&self.id, epoch, name).await?;
        let bytes = tokio::task::spawn_blocking(move || segment::unpack(&packed)).await?;
        let bytes = Arc::new(bytes.map_err(Error::io(name))?);
        inner.unpacked.keep(key, Arc::clone(&bytes));
        Ok(bytes)
    }
}
