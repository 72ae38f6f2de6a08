//! The event log of a job: what its worker reports, and what the server adds.
//!
//! 1. A log is append-only; its numbers start at 1, have no gaps and are never reused.
//! 2. The first entry says that the job was created; the last one of an ended job says how it ended. A retry goes on
//!    behind it.
//!
//! Knows nothing of how entries are stored or sent.

use serde::{Deserialize, Serialize};

use super::state::State;

/// One entry of the log of a job.
#[derive(Clone, Debug, PartialEq)]
pub struct Event {
    /// Position, from 1.
    pub seq: u64,
    /// The attempt's lease epoch; 0 before the first.
    pub epoch: u64,
    /// When it was stored, milliseconds since 1970.
    pub at_ms: i64,
    /// What happened.
    pub body: Body,
}

/// What happened, and who says so.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Body {
    /// The server.
    Server(ServerEvent),
    /// The worker.
    Worker(Report),
}

/// What the server adds to the log.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum ServerEvent {
    /// The job moved to another state.
    StateChanged {
        /// The new state.
        state: State,
        /// Stable upper-snake-case code.
        reason: String,
        /// One sentence for people.
        text: String,
        /// Number of the attempt, from 1; 0 before the first.
        attempt: u32,
        /// The worker concerned, or empty.
        worker: String,
    },
    /// An attempt was lost; what it reported after `rewind_to_seq` is void, and the next one starts over or, where
    /// the reason is `RESUMED`, goes on from there.
    Restarted {
        /// The last entry that still counts.
        rewind_to_seq: u64,
        /// Number of the lost attempt.
        lost_attempt: u32,
        /// Stable upper-snake-case code.
        reason: String,
        /// One sentence for people.
        text: String,
    },
}

/// The entry that every log begins with, and to which a job without a checkpoint rewinds.
pub const CREATED_SEQ: u64 = 1;

impl Body {
    /// The state this entry moved the job to, if it is such an entry.
    pub fn state(&self) -> Option<State> {
        match self {
            Self::Server(ServerEvent::StateChanged { state, .. }) => Some(*state),
            _ => None,
        }
    }
}

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
    /// Which level is being optimized, from 0 in the order asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub level: Option<u32>,
    /// Energy as a share of what it was when this level's optimization began.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub energy_ratio: Option<f64>,
    /// d2 over views that the job does not work with, percent of full scale; now and then.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub d2_unseen: Option<f64>,
    /// Where view sets take turns, the turn it was taken in: the energy may rise from one to the next.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub turn: Option<u32>,
}

/// What a kind of move has done in an optimization so far.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct MoveCount {
    /// Its name, such as `swap 1`.
    pub name: String,
    /// Times it was tried.
    pub tried: u64,
    /// Times it was accepted.
    pub accepted: u64,
    /// Energy evaluations spent on it.
    pub evaluations: u64,
    /// Energy that it has taken off.
    pub reduction: i64,
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
    /// What each kind of move has done to a level since its optimization began.
    Moves {
        /// The level, from 0 in the order asked for.
        level: u32,
        /// Kinds of moves that were tried.
        moves: Vec<MoveCount>,
    },
    /// Encoded records, in order: collapses from the original to the coarsest level or, with a
    /// level, the edits that optimize it.
    Records {
        /// The level being optimized, from 0 in the order asked for.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        level: Option<u32>,
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
