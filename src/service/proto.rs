//! The generated messages and stubs of `proto/`, and their descriptors for reflection.

#![allow(
    missing_docs,
    unreachable_pub,
    clippy::pedantic,
    clippy::allow_attributes_without_reason,
    reason = "generated code; the protos carry the documentation"
)]

/// Package `lookalike.v1`: the public API.
pub mod v1 {
    tonic::include_proto!("lookalike.v1");
}

/// Package `lookalike.worker.v1`: the API between a server and its workers.
pub mod worker {
    /// Version 1.
    pub mod v1 {
        tonic::include_proto!("lookalike.worker.v1");
    }
}

/// The encoded `FileDescriptorSet` of both packages.
pub const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));
