//! Records in memory as bytes, first in, last out.

use super::{
    edits::{decode_edit, encode_edit},
    error::ProgressiveError,
    record::decode_collapse,
};
use crate::mesh::{Collapse, Edit, EditRecord};

/// Reads a record from the start of bytes; gives it and its length too.
type Decode<T> = fn(&[u8]) -> Result<(T, usize), ProgressiveError>;

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

    pub(super) fn push<'a>(&mut self, edit: impl Into<Edit<'a>>) {
        self.begins.push(self.bytes.len());
        encode_edit(edit, &mut self.bytes);
    }

    /// The record pushed last, a collapse; `None` when all are gone.
    pub(super) fn pop(&mut self) -> Result<Option<Collapse>, ProgressiveError> {
        self.pop_by(decode_collapse)
    }

    /// The record pushed last, of any kind; `None` when all are gone.
    pub(super) fn pop_edit(&mut self) -> Result<Option<EditRecord>, ProgressiveError> {
        self.pop_by(decode_edit)
    }

    fn pop_by<T>(&mut self, decode: Decode<T>) -> Result<Option<T>, ProgressiveError> {
        let Some(begin) = self.begins.pop() else { return Ok(None) };
        let (record, _) = decode(self.bytes.get(begin..).unwrap_or_default())?;
        self.bytes.truncate(begin);
        Ok(Some(record))
    }
}
