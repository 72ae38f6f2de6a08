//! Who did what: calls that change something, and calls that were refused.
//!
//! An entry is written when the call has been answered. Claims, and what workers report
//! of a job at work, are not among them: the job's own log tells of those.

use std::sync::Arc;

use tokio::sync::{mpsc, oneshot};

use super::{Jobs, error::Error, store::Store};

/// Entries of one transaction.
const AT_ONCE: usize = 256;

/// Whether an entry was written; those of one transaction share an error.
type Written = Result<(), Arc<Error>>;

/// Takes entries to the table. Those that come while others are written go together: one commit for all.
pub(super) type Ledger = mpsc::Sender<(AuditEntry, oneshot::Sender<Written>)>;

/// A call worth remembering.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AuditEntry {
    /// Whose credentials; empty for a stranger.
    pub principal: String,
    /// For which owner; empty for a stranger.
    pub owner: String,
    /// Where it came from.
    pub peer: String,
    /// The method's name.
    pub method: String,
    /// What it was about, such as `jobs/{id}`; empty when that was never known.
    pub resource: String,
    /// `OK`, or the code of the refusal.
    pub outcome: String,
}

impl Jobs {
    /// Writes an entry.
    pub async fn audit(&self, entry: AuditEntry) -> Written {
        let (tell, told) = oneshot::channel();
        // A server that ends takes no more; then nobody tells, either.
        let _ = self.0.ledger.send((entry, tell)).await;
        told.await.unwrap_or_else(|_| Err(Arc::new(Error::Sql(sqlx::Error::PoolClosed))))
    }
}

/// The way to the table, and what has to be run for it.
pub(super) fn open(store: Store) -> (Ledger, impl Future<Output = ()>) {
    let (ledger, mut entries) = mpsc::channel(AT_ONCE);
    let keep = async move {
        let mut waiting = Vec::new();
        while entries.recv_many(&mut waiting, AT_ONCE).await > 0 {
            let (entries, tell): (Vec<_>, Vec<oneshot::Sender<Written>>) =
                waiting.drain(..).unzip();
            let written = store.audit(&entries).await.map_err(Arc::new);
            for tell in tell {
                // Whoever asked may have gone.
                let _ = tell.send(written.clone());
            }
        }
    };
    (ledger, keep)
}
