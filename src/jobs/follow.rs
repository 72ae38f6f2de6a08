//! Following a log: replay after a number, then wait for more, until the job has ended.
//!
//! A follower reads at its own pace from the database and holds one page and one segment; however
//! slow it is, no worker waits for it.

use std::{collections::VecDeque, time::Duration};

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
    id: String,
    last_seq: u64,
    page: VecDeque<StoredEvent>,
    grew: watch::Receiver<()>,
    /// The segment last unpacked: neighbours in the log share it.
    segment: (String, Vec<u8>),
    ended: bool,
    /// The last entry that was handed out ended the job.
    saw_end: bool,
}

impl Jobs {
    /// The log of a job after `after_seq`, live; ends after the entry that ended the job for the last time. Fails when
    /// there is no such job, also when it is deleted before its end was seen.
    pub fn follow(&self, id: &str, after_seq: u64) -> impl Stream<Item = Result<Event>> + use<> {
        let follower = Follower {
            jobs: self.clone(),
            id: id.into(),
            last_seq: after_seq,
            page: VecDeque::new(),
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
        while self.page.is_empty() && !self.ended {
            self.grew.mark_unchanged();
            // The job first: if it has ended, the page that follows holds the last entry.
            let job = match self.jobs.job(&self.id).await {
                Err(Error::NotFound(_)) if self.saw_end => return Ok(None),
                found => found?,
            };
            let page = self.jobs.0.store.events(&self.id, self.last_seq, PAGE).await?;
            self.ended = page.is_empty() && job.state.is_final();
            if page.is_empty() && !self.ended {
                // Time out or not: look again.
                let _ = timeout(POLL, self.grew.changed()).await;
            }
            self.page = page.into();
        }
        let Some(StoredEvent { mut event, bytes }) = self.page.pop_front() else {
            return Ok(None);
        };
        if let (Body::Worker(Report::Records { bytes, .. }), Some(range)) = (&mut event.body, bytes)
        {
            *bytes = self.read(event.epoch, range).await?;
        }
        self.last_seq = event.seq;
        self.saw_end = event.body.state().is_some_and(super::state::State::is_final);
        Ok(Some(event))
    }

    async fn read(&mut self, epoch: u64, range: SegmentRange) -> Result<Vec<u8>> {
        if self.segment.0 != range.segment {
            let packed = self.jobs.0.blobs.segment(&self.id, epoch, &range.segment).await?;
            let unpacked = tokio::task::spawn_blocking(move || segment::unpack(&packed)).await?;
            let unpacked = unpacked.map_err(Error::io(&range.segment))?;
            self.segment = (range.segment, unpacked);
        }
        let span = range.offset as usize..(range.offset + range.len) as usize;
        let fault = || Error::Corrupt {
            what: format!("record segment {}", self.segment.0),
            fault: format!("it has no bytes {span:?}"),
        };
        Ok(self.segment.1.get(span.clone()).ok_or_else(fault)?.to_vec())
    }
}
