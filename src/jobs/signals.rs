//! Wake-up calls: "this log grew", "the queue grew"; within one process, and between servers that share
//! a PostgreSQL.
//!
//! They are hints. Whoever waits reads the database first and again after a while, so a lost call
//! costs time and nothing else. Other servers are told after the commit, many calls at once: NOTIFY as a
//! part of the transactions would make their commits wait for one another.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

use tokio::{
    sync::{mpsc, watch},
    task::JoinSet,
};

use super::store::{Heard, Store};

/// Calls that wait to be passed on; more are lost.
const AHEAD: usize = 1024;
/// Calls are passed on this often, and a broken connection is tried again this often.
const PAUSE: Duration = Duration::from_millis(20);
const RETRY: Duration = Duration::from_secs(1);
/// Stands for the queue, where other calls are ids of jobs.
const QUEUE: &str = "queue";

/// Wake-up calls by job, and one for the queue.
#[derive(Debug)]
pub struct Signals {
    logs: Mutex<BTreeMap<String, watch::Sender<()>>>,
    queue: watch::Sender<()>,
    /// For other servers.
    calls: Option<mpsc::Sender<String>>,
}

impl Signals {
    fn new(calls: Option<mpsc::Sender<String>>) -> Self {
        Self { logs: Mutex::default(), queue: watch::Sender::new(()), calls }
    }

    /// Signals of this process and of all others that use the same database, as long as the tasks
    /// live.
    pub fn open(store: &Store) -> (Arc<Self>, JoinSet<()>) {
        let mut tasks = JoinSet::new();
        if !store.is_shared() {
            return (Arc::new(Self::new(None)), tasks);
        }
        let (send, calls) = mpsc::channel(AHEAD);
        let signals = Arc::new(Self::new(Some(send)));
        tasks.spawn(speak(store.clone(), calls));
        tasks.spawn(listen(store.clone(), Arc::clone(&signals)));
        (signals, tasks)
    }

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
        self.wake(job);
        self.call(job);
    }

    /// A job was queued.
    pub fn queue_grew(&self) {
        self.wake(QUEUE);
        self.call(QUEUE);
    }

    fn call(&self, what: &str) {
        if let Some(calls) = &self.calls {
            // The others look again by themselves when this one is lost.
            let _ = calls.try_send(what.into());
        }
    }

    fn wake(&self, what: &str) {
        if what == QUEUE {
            self.queue.send_replace(());
            return;
        }
        let mut logs = self.logs.lock().unwrap_or_else(PoisonError::into_inner);
        // Nobody watches any more: forget the job, so that the map stays as small as its audience.
        if logs.get(what).is_some_and(|log| log.send(()).is_err()) {
            logs.remove(what);
        }
    }

    /// Calls may have been lost.
    fn wake_all(&self) {
        self.queue.send_replace(());
        let mut logs = self.logs.lock().unwrap_or_else(PoisonError::into_inner);
        logs.retain(|_, log| log.send(()).is_ok());
    }
}

/// Passes calls on until nobody can make any.
async fn speak(store: Store, mut calls: mpsc::Receiver<String>) {
    let mut waiting = Vec::new();
    while calls.recv_many(&mut waiting, AHEAD).await > 0 {
        let distinct: BTreeSet<String> = waiting.drain(..).collect();
        if let Err(error) = store.call(distinct).await {
            tracing::debug!(%error, "other servers are not told, and look for themselves");
        }
        tokio::time::sleep(PAUSE).await;
    }
}

/// Wakes those whom the calls of other servers concern.
async fn listen(store: Store, signals: Arc<Signals>) {
    loop {
        match store.listen().await {
            Ok(mut ear) => loop {
                match ear.next().await {
                    Heard::Call(what) => signals.wake(&what),
                    Heard::Gap => signals.wake_all(),
                    Heard::Nothing(error) => {
                        tracing::debug!(%error, "other servers are not heard");
                        break;
                    }
                }
            },
            Err(error) => tracing::debug!(%error, "other servers are not heard"),
        }
        tokio::time::sleep(RETRY).await;
        signals.wake_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn calls_reach_watchers_and_nobody_else() {
        let signals = Signals::new(None);
        let (a, b) = (signals.watch_log("a"), signals.watch_log("b"));
        signals.log_grew("a");
        assert!(a.has_changed().unwrap());
        assert!(!b.has_changed().unwrap());
        drop((a, b));
        signals.log_grew("a");
        assert_eq!(signals.logs.lock().unwrap().len(), 1, "`a` is forgotten, `b` not yet");
    }
}
