//! Where geometry and jobs meet: runs one attempt of a job, stage by stage.

pub mod pipeline;
