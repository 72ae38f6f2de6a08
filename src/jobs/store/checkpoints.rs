//! How far lost attempts had come: pieces of a job's checkpoint, and what the next attempt does with them.
//!
//! 1. A piece follows all entries of the log that its attempt had sent when it was cut: an attempt that goes on
//!    from the piece makes void what comes after them, and nothing else.
//! 2. The checkpoint of a job that has ended is of no use, and stays on record until its bytes are removed.
//!
//! Knows nothing of what pieces hold.

use sqlx::{AnyConnection, Row};

use super::{Body, Store, Tx, find_to_write, log, now_ms, storable, workers::held_to_write};
use crate::jobs::{
    error::{Error, Result},
    event::{CREATED_SEQ, ServerEvent},
    lease::Lease,
    points::{Point, pass},
};

/// A piece of a checkpoint.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Piece {
    /// Number of the piece, from 0.
    pub n: u32,
    /// Epoch of the attempt that sent it.
    pub epoch: u64,
    /// The last entry of the log before it.
    pub seq: u64,
    /// Bytes.
    pub size: u64,
    /// The build of the worker that sent it.
    pub build: String,
}

impl Store {
    /// Notes that piece `n` is stored. A repetition is accepted.
    pub async fn add_piece(&self, lease: &Lease, n: u32, size: u64, build: &str) -> Result<()> {
        transaction!(self, tx, {
            let job = held_to_write(&mut tx, lease).await?;
            let pieces = pieces_of(&mut tx, &job.id).await?;
            if let Some(known) = pieces.get(n as usize) {
                let is_same = (known.epoch, known.size) == (lease.epoch, size);
                return if is_same { Ok(()) } else { Err(misplaced(n, pieces.len())) };
            }
            if n as usize != pieces.len() {
                return Err(misplaced(n, pieces.len()));
            }
            let insert = "INSERT INTO checkpoints VALUES ($1, $2, $3, $4, $5, $6)";
            let insert =
                sqlx::query(insert).bind(&job.id).bind(i64::from(n)).bind(job.epoch as i64);
            let insert = insert.bind(job.last_seq as i64).bind(size as i64).bind(storable(build));
            insert.execute(&mut *tx).await?;
            pass(Point::PieceWritten);
            Ok(())
        })
    }

    /// What a worker of this build that has just claimed the job goes on from; nothing where it starts over. The
    /// log tells which, where an attempt was lost that had left a checkpoint.
    pub async fn resume(&self, lease: &Lease, build: &str, max_lost: u32) -> Result<Vec<Piece>> {
        transaction!(self, tx, {
            let mut job = held_to_write(&mut tx, lease).await?;
            let mut pieces = pieces_of(&mut tx, &job.id).await?;
            let Some(last) = pieces.last() else { return Ok(pieces) };
            let refusal = refusal((job.epoch, job.lost), last, build, max_lost);
            let (rewind_to_seq, reason, text) = match refusal {
                None => (last.seq, RESUMED, "it goes on from the last checkpoint".to_owned()),
                Some(why) => {
                    (CREATED_SEQ, "STARTED_OVER", format!("it starts over, because {why}"))
                }
            };
            let lost_attempt = job.attempt.saturating_sub(1);
            let body =
                ServerEvent::Restarted { rewind_to_seq, lost_attempt, reason: reason.into(), text };
            if refusal.is_some() {
                forget(&mut tx, &job.id).await?;
                pieces.clear();
            }
            let now = now_ms(&mut tx).await?;
            log(&mut tx, &mut job, now, &[(Body::Server(body), None)]).await?;
            pass(Point::ResumeWritten);
            Ok(pieces)
        })
    }

    /// Jobs that have ended and whose checkpoints are on record, with their last epochs.
    pub async fn useless_checkpoints(&self, limit: u32) -> Result<Vec<(String, u64)>> {
        let query = "SELECT id, epoch FROM jobs WHERE ended_ms IS NOT NULL \
                     AND id IN (SELECT job FROM checkpoints) LIMIT $1";
        let rows = sqlx::query(query).bind(i64::from(limit)).fetch_all(&self.readers).await?;
        let known = |row: &sqlx::any::AnyRow| {
            Ok((row.try_get("id")?, row.try_get::<i64, _>("epoch")? as u64))
        };
        rows.iter().map(known).collect()
    }

    /// Notes that the bytes of an ended job's checkpoint are gone.
    pub async fn checkpoint_gone(&self, id: &str) -> Result<()> {
        transaction!(self, tx, {
            // One that was queued anew has another.
            if find_to_write(&mut tx, id).await?.state.is_final() {
                forget(&mut tx, id).await?;
            }
            Ok(())
        })
    }

    /// The pieces of the job under `lease`, in order.
    pub async fn pieces(&self, lease: &Lease) -> Result<Vec<Piece>> {
        self.check(lease).await?;
        pieces_of(&mut *self.readers.acquire().await?, &lease.job).await
    }
}

/// The reason of a restart that is none: the attempt goes on from a checkpoint.
pub const RESUMED: &str = "RESUMED";

/// Why the attempt of an epoch, after so many that were lost, must not go on from a checkpoint that ends with `last`.
fn refusal(
    (epoch, lost): (u64, u32),
    last: &Piece,
    build: &str,
    max_lost: u32,
) -> Option<&'static str> {
    // If it is the checkpoint that kills whoever goes on from it, the last attempt finds out.
    let is_last_chance = lost + 1 >= max_lost && last.epoch + 1 < epoch;
    if last.build != build {
        Some("the checkpoint is of another build of the program")
    } else if is_last_chance {
        Some("the last attempt that went on from the checkpoint came no further")
    } else {
        None
    }
}

/// The checkpoint of a job is of no use any more.
pub(super) async fn forget(tx: &mut Tx, job: &str) -> Result<()> {
    sqlx::query("DELETE FROM checkpoints WHERE job = $1").bind(job).execute(&mut **tx).await?;
    Ok(())
}

/// Whether the next attempt may have something to go on from.
pub(super) async fn exists(tx: &mut Tx, job: &str) -> Result<bool> {
    let query = "SELECT count(*) FROM checkpoints WHERE job = $1";
    let n: i64 = sqlx::query_scalar(query).bind(job).fetch_one(&mut **tx).await?;
    Ok(n > 0)
}

async fn pieces_of(conn: &mut AnyConnection, job: &str) -> Result<Vec<Piece>> {
    let query = "SELECT * FROM checkpoints WHERE job = $1 ORDER BY n";
    let rows = sqlx::query(query).bind(job).fetch_all(conn).await?;
    let piece = |row: &sqlx::any::AnyRow| {
        let int = |column: &str| row.try_get::<i64, _>(column);
        Ok(Piece {
            n: int("n")? as u32,
            epoch: int("epoch")? as u64,
            seq: int("seq")? as u64,
            size: int("size")? as u64,
            build: row.try_get("build")?,
        })
    };
    rows.iter().map(piece).collect()
}

fn misplaced(n: u32, held: usize) -> Error {
    let text = format!("piece {n} does not follow the {held} that are held: send piece {held}");
    Error::invalid("header.piece", text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_may_go_on_from_a_checkpoint() {
        let piece = |epoch| Piece { n: 0, epoch, seq: 9, size: 5, build: "b".into() };
        // Attempt 2 goes on, or 3 where 2 left something; not the third of three where 2 left nothing.
        let cases = [(2, 1, 1, true), (3, 2, 2, true), (3, 2, 1, false), (3, 1, 1, true)];
        for (epoch, lost, of_epoch, may) in cases {
            let refused = refusal((epoch, lost), &piece(of_epoch), "b", 3);
            assert_eq!(refused.is_none(), may, "{epoch} {lost} {of_epoch}: {refused:?}");
        }
        assert!(refusal((2, 0), &piece(1), "another", 3).is_some());
    }
}
