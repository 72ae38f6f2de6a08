//! What a running job reports: the body of one entry of its event log.

use serde::{Deserialize, Serialize};

/// A point of the energy curve, with the time the worker measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EnergySample {
    /// `memoryless`, `image` or `optimize`.
    pub stage: String,
    /// Energy evaluations of the stage so far.
    pub evaluations: u64,
    /// Seconds since the attempt began.
    pub seconds: f64,
    /// Triangles now.
    pub triangles: u32,
    /// Sum of squared luminance differences (0..=255 units); absent where no pictures are kept.
    pub energy: Option<u64>,
    /// The papers' d2, percent of full scale.
    pub d2: Option<f64>,
}

/// What a worker says of its attempt.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Report {
    /// Something a person should know: what was read, repaired, refused or cut short.
    Note {
        /// Stable upper-snake-case code.
        code: String,
        /// One sentence: what, where, and what to do.
        text: String,
    },
    /// How far the attempt is.
    Progress {
        /// The stage at work.
        stage: String,
        /// 0 to 1 of the whole job.
        fraction: f64,
        /// Estimated seconds to the end; absent until it can be told.
        eta_secs: Option<f64>,
    },
    /// A point of the energy curve.
    Sample(EnergySample),
    /// Encoded progressive-mesh records (`progressive::codec`), in order.
    Records {
        /// Index of the first record in the chunk.
        first: u64,
        /// Records in the chunk.
        count: u32,
        /// The encoded records.
        #[serde(skip)]
        bytes: Vec<u8>,
    },
    /// A file of the result was written.
    Artifact {
        /// File name, such as `lod-0.glb`.
        name: String,
        /// IANA media type.
        media_type: String,
        /// Size in bytes.
        size: u64,
    },
}
