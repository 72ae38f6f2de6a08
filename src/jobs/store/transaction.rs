//! Transactions: all or nothing, and over when their answer is there.
//!
//! 1. What fails is rolled back before anybody hears of it: a dropped transaction would be rolled back later, in the
//!    background, and hold its rows until then.
//! 2. What lost against another transaction (a deadlock, a serialization failure) is tried again, a few times.

use std::time::Duration;

use super::{Store, Tx};
use crate::jobs::error::{Error, Result};

/// A transaction that loses is tried so often.
const TRIES: u32 = 5;
/// Pause before it is tried again, times the tries so far.
const PAUSE: Duration = Duration::from_millis(10);

/// Runs a block in a transaction: `transaction!(store, tx, { … })` is the `Result` that the block ends with, once it is
/// committed or rolled back. The block may run several times.
macro_rules! transaction {
    ($store:expr, $tx:ident, $block:block) => {{
        let mut n_tries = 0;
        loop {
            let mut $tx = $store.begin().await?;
            let done: $crate::jobs::error::Result<_> = async { $block }.await;
            n_tries += 1;
            if let Some(done) = $store.settle($tx, done, n_tries).await {
                break done;
            }
        }
    }};
}

impl Store {
    /// Ends a transaction; nothing when it is to be tried again.
    pub(super) async fn settle<T>(
        &self,
        tx: Tx,
        done: Result<T>,
        n_tries: u32,
    ) -> Option<Result<T>> {
        let done = match done {
            Ok(value) => tx.commit().await.map(|()| value).map_err(Error::from),
            Err(error) => {
                // A connection that is broken rolls back by itself.
                let _ = tx.rollback().await;
                Err(error)
            }
        };
        match done {
            Err(error) if error.has_lost() && n_tries < TRIES => {
                tracing::debug!(%error, n_tries, "a transaction lost, and is tried again");
                tokio::time::sleep(PAUSE * n_tries).await;
                None
            }
            done => Some(done),
        }
    }
}
