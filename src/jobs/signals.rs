//! Wake-up calls inside one process: "this log grew", "the queue grew".
//!
//! They are hints. Whoever waits reads the database first and again after a while, so a lost call
//! costs time and nothing else.

use std::{
    collections::BTreeMap,
    sync::{Mutex, PoisonError},
};

use tokio::sync::watch;

/// Wake-up calls by job, and one for the queue.
#[derive(Debug)]
pub struct Signals {
    logs: Mutex<BTreeMap<String, watch::Sender<()>>>,
    queue: watch::Sender<()>,
}

impl Default for Signals {
    fn default() -> Self {
        Self { logs: Mutex::default(), queue: watch::Sender::new(()) }
    }
}

impl Signals {
    /// Calls whenever the log of `job` may have grown from now on.
    pub fn watch_log(&self, job: &str) -> watch::Receiver<()> {
        let mut logs = self.logs.lock().unwrap_or_else(PoisonError::into_inner);
        logs.entry(job.into()).or_insert_with(|| watch::Sender::new(())).subscribe()
    }

    /// Calls whenever a job may have been queued from now on.
    pub fn watch_queue(&self) -> watch::Receiver<()> {
        self.queue.subscribe()
    }

    /// The log of `job` grew.
    pub fn log_grew(&self, job: &str) {
        let mut logs = self.logs.lock().unwrap_or_else(PoisonError::into_inner);
        // Nobody watches any more: forget the job, so that the map stays as small as its audience.
        if logs.get(job).is_some_and(|log| log.send(()).is_err()) {
            logs.remove(job);
        }
    }

    /// A job was queued.
    pub fn queue_grew(&self) {
        self.queue.send_replace(());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn calls_reach_watchers_and_nobody_else() {
        let signals = Signals::default();
        let (a, b) = (signals.watch_log("a"), signals.watch_log("b"));
        signals.log_grew("a");
        assert!(a.has_changed().unwrap());
        assert!(!b.has_changed().unwrap());
        drop((a, b));
        signals.log_grew("a");
        assert_eq!(signals.logs.lock().unwrap().len(), 1, "`a` is forgotten, `b` not yet");
    }
}
