//! Records in memory as bytes, first in, last out.

use super::{
    error::ProgressiveError,
    record::{decode_collapse, encode_collapse},
};
use crate::mesh::Collapse;

/// A stack of records, about a third of the size of the structs.
#[derive(Clone, Debug, Default)]
pub(super) struct RecordLog {
    bytes: Vec<u8>,
    /// Where each record begins.
    begins: Vec<usize>,
}

impl RecordLog {
    pub(super) fn len(&self) -> usize {
        self.begins.len()
    }

    pub(super) fn push(&mut self, collapse: &Collapse) {
        self.begins.push(self.bytes.len());
        encode_collapse(collapse, &mut self.bytes);
    }

    /// The record pushed last; `None` when all are gone.
    pub(super) fn pop(&mut self) -> Result<Option<Collapse>, ProgressiveError> {
        let Some(begin) = self.begins.pop() else { return Ok(None) };
        let (collapse, _) = decode_collapse(self.bytes.get(begin..).unwrap_or_default())?;
        self.bytes.truncate(begin);
        Ok(Some(collapse))
    }
}
