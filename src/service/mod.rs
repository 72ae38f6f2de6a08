//! gRPC, gRPC-Web and HTTP/JSON: thin adapters between the wire and [`crate::jobs`].
//!
//! 1. A handler is: read the request, call [`Jobs`](crate::jobs::Jobs), convert the answer.
//! 2. Wire types stop in `convert/`; errors become statuses in `status.rs` and nowhere else.
//! 3. No call reaches a handler past the gate (`auth/`).
//! 4. Every error carries a `google.rpc.ErrorInfo` of domain `lookalike`, so that clients can tell
//!    an answer from a broken connection.
//!
//! Knows nothing of geometry, of processes, or of the command line.

pub mod accept;
pub mod auth;
pub mod client;
pub mod convert;
pub mod crowd;
pub mod job_trace;
pub mod observe;
pub mod proto;
pub mod server;
pub mod status;
pub mod tls;
pub mod web;
pub mod webhook;

mod api;
mod call_name;
mod call_span;
mod pace;
mod transfer;
mod worker_api;
