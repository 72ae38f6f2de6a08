//! Jobs: specification, states, leases, events, stores. Knows nothing of geometry or of gRPC.

pub mod event;
pub mod spec;
