//! Who is told of the end of a job. Whom it is right to call, and how, others decide.

use std::time::Duration;

use super::{
    Jobs,
    error::Result,
    store::{CallEnd, DueCall},
};

impl Jobs {
    /// Takes at most `limit` calls that are due; each is due again when nothing is heard of it for so long.
    pub async fn take_calls(&self, limit: u32, held_for: Duration) -> Result<Vec<DueCall>> {
        self.0.store.take_calls(limit, held_for).await
    }

    /// Notes how an attempt of a call ended.
    pub async fn end_call(&self, call: &DueCall, end: &CallEnd) -> Result<()> {
        self.0.store.end_call(call, end).await
    }
}
