//! Who did what: calls that change something, and calls that were refused.
//!
//! An entry is written when the call has been answered. Claims, and what workers report
//! of a job at work, are not among them: the job's own log tells of those.

use super::{Jobs, error::Result};

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
    pub async fn audit(&self, entry: &AuditEntry) -> Result<()> {
        self.0.store.audit(entry).await
    }
}
