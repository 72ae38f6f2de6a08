//! Whose meshes and jobs these are, what an owner has stored, and the audit table.

use std::time::Duration;

use super::{Exclusive, Job, NewJob, Store, Tx, job_of, now_ms, only, storable};
use crate::jobs::{
    audit::AuditEntry,
    error::{Error, Quota, Result},
};

/// Bytes of the meshes that an owner uploaded, and of the results of its jobs.
const STORED_BYTES: &str = "SELECT CAST( \
    (SELECT COALESCE(SUM(size), 0) FROM meshes \
     JOIN mesh_owners ON mesh_owners.mesh = meshes.hash WHERE mesh_owners.owner = $1) + \
    (SELECT COALESCE(SUM(size), 0) FROM artifacts \
     JOIN jobs ON jobs.id = artifacts.job AND jobs.epoch = artifacts.epoch \
     WHERE jobs.owner = $1) AS BIGINT)";

impl Store {
    /// Notes that `owner` has uploaded a stored mesh; false when that was known. Refused when its
    /// things would be more than `limit` bytes with it.
    pub async fn own_mesh(&self, owner: &str, hash: &str, size: u64, limit: u64) -> Result<bool> {
        transaction!(self, tx, {
            only(&mut tx, Exclusive::Count).await?;
            let insert =
                "INSERT INTO mesh_owners (owner, mesh) VALUES ($1, $2) ON CONFLICT DO NOTHING";
            let done = sqlx::query(insert).bind(owner).bind(hash).execute(&mut *tx).await?;
            let is_new = done.rows_affected() == 1;
            if is_new && size > 0 && limit < u64::MAX {
                let stored = sqlx::query_scalar::<_, i64>(STORED_BYTES).bind(owner);
                if stored.fetch_one(&mut *tx).await? as u64 > limit {
                    // The bytes stay without an owner, and go with the meshes that nobody wants.
                    return Err(Error::Quota { quota: Quota::Bytes, limit });
                }
            }
            Ok(is_new)
        })
    }

    /// Refuses where the things of `owner` would be more than `limit` bytes with a mesh that is not stored yet.
    pub async fn check_room(&self, owner: &str, hash: &str, size: u64, limit: u64) -> Result<()> {
        if limit == u64::MAX || self.owned_mesh_size(owner, hash).await?.is_some() {
            return Ok(());
        }
        if self.stored_bytes(owner).await?.saturating_add(size) > limit {
            return Err(Error::Quota { quota: Quota::Bytes, limit });
        }
        Ok(())
    }

    /// Whether a request of this name made a job before.
    pub async fn is_requested(&self, owner: &str, request_id: &str) -> Result<bool> {
        let query = "SELECT count(*) FROM requests WHERE owner = $1 AND request_id = $2";
        let query = sqlx::query_scalar::<_, i64>(query).bind(owner).bind(request_id);
        Ok(!request_id.is_empty() && query.fetch_one(&self.readers).await? > 0)
    }

    /// Size in bytes of a stored mesh that `owner` has uploaded.
    pub async fn owned_mesh_size(&self, owner: &str, hash: &str) -> Result<Option<u64>> {
        let query = "SELECT meshes.size FROM meshes JOIN mesh_owners \
                     ON mesh_owners.mesh = meshes.hash \
                     WHERE mesh_owners.owner = $1 AND mesh_owners.mesh = $2";
        let query = sqlx::query_scalar::<_, i64>(query).bind(owner).bind(hash);
        Ok(query.fetch_optional(&self.readers).await?.map(|size| size as u64))
    }

    /// Bytes of the meshes that an owner uploaded, and of the results of its jobs.
    pub async fn stored_bytes(&self, owner: &str) -> Result<u64> {
        let query = sqlx::query_scalar::<_, i64>(STORED_BYTES).bind(owner);
        Ok(query.fetch_one(&self.readers).await? as u64)
    }

    /// Writes entries of the audit table.
    pub async fn audit(&self, entries: &[AuditEntry]) -> Result<()> {
        transaction!(self, tx, {
            let now = now_ms(&mut tx).await?;
            for entry in entries {
                audit(&mut tx, entry, now).await?;
            }
            Ok(())
        })
    }

    /// Removes the entries of the audit table that are older.
    pub async fn forget_audit(&self, older_than: Duration) -> Result<()> {
        transaction!(self, tx, {
            let age_ms = i64::try_from(older_than.as_millis()).unwrap_or(i64::MAX);
            let before = now_ms(&mut tx).await?.saturating_sub(age_ms);
            let delete = sqlx::query("DELETE FROM audit WHERE at_ms < $1").bind(before);
            delete.execute(&mut *tx).await?;
            Ok(())
        })
    }
}

async fn audit(tx: &mut Tx, entry: &AuditEntry, now: i64) -> Result<()> {
    let insert = "INSERT INTO audit (id, at_ms, principal, owner, peer, method, resource, outcome) \
                  VALUES ($1, $2, $3, $4, $5, $6, $7, $8)";
    let id = uuid::Uuid::now_v7().simple().to_string();
    let texts = [
        &entry.principal,
        &entry.owner,
        &entry.peer,
        &entry.method,
        &entry.resource,
        &entry.outcome,
    ];
    let insert = sqlx::query(insert).bind(id).bind(now);
    let insert = texts.into_iter().fold(insert, |insert, text| insert.bind(storable(text)));
    insert.execute(&mut **tx).await?;
    Ok(())
}

/// The job that an earlier request of the same owner and name made.
pub(super) async fn requested(tx: &mut Tx, new: &NewJob) -> Result<Option<Job>> {
    let query = "SELECT jobs.* FROM jobs JOIN requests ON requests.job = jobs.id \
                 WHERE requests.owner = $1 AND requests.request_id = $2";
    let query = sqlx::query(query).bind(&new.owner).bind(&new.request_id);
    query.fetch_optional(&mut **tx).await?.as_ref().map(job_of).transpose()
}

/// Notes which job a request made, if it has a name.
pub(super) async fn note_request(tx: &mut Tx, new: &NewJob, job: &str) -> Result<()> {
    if !new.request_id.is_empty() {
        let insert = "INSERT INTO requests (owner, request_id, job) VALUES ($1, $2, $3)";
        let insert = sqlx::query(insert).bind(&new.owner).bind(&new.request_id).bind(job);
        insert.execute(&mut **tx).await?;
    }
    Ok(())
}

/// Refuses when `owner` has as many jobs waiting as it may.
pub(super) async fn check_queue(tx: &mut Tx, owner: &str, limit: u64) -> Result<()> {
    let query = "SELECT count(*) FROM jobs WHERE state = 'QUEUED' AND owner = $1";
    let waiting = sqlx::query_scalar::<_, i64>(query).bind(owner).fetch_one(&mut **tx).await?;
    if waiting as u64 >= limit {
        return Err(Error::Quota { quota: Quota::Queued, limit });
    }
    Ok(())
}
