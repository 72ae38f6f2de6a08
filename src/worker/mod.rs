//! Where geometry and jobs meet: a process that claims jobs and runs them, one at a time.
//!
//! 1. A worker speaks only gRPC to its server: it opens no database and no object directory.
//! 2. What the pipeline reports is kept until the server acknowledged it ([`outbox`]).
//! 3. A lease that the server calls stale ends the attempt at once; nothing of it is sent any more.
//! 4. A local worker is confined before it claims ([`confine`]), and has no way out but its server's socket.
//! 5. A worker that cannot reach its server for a minute ends.
//!
//! [`agent`] is the claim loop, [`attempt`] runs one job, [`supervisor`] keeps local workers alive.

pub mod agent;
pub mod attempt;
mod automatic;
mod branch;
mod budget;
mod build;
mod chain;
mod checkpoint;
mod chosen;
mod clock;
pub mod confine;
mod course;
mod critic;
pub mod evaluating;
mod gauge;
mod illustrator;
mod levels;
pub mod link;
mod optimizing;
pub mod outbox;
mod params;
pub mod pipeline;
mod progress;
mod recorder;
mod results;
mod simplifying;
mod stopped;
mod studio;
pub mod supervisor;
mod survey;
mod switching;
mod vanished;
