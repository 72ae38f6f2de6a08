//! A data directory as one principal sees it: what is another owner's does not exist.
//!
//! 1. Whatever names a job or a mesh is asked here first; the answer for something of somebody else is
//!    word for word that for something that never was.
//! 2. Quotas count by owner.
//!
//! An owner never changes and ids are never used again, so that a look before an act is enough.

use tokio::sync::mpsc;
use tokio_util::bytes::Bytes;

use super::{
    Jobs,
    blobs::Blob,
    clients::{Announced, StoredMesh},
    error::{Error, Quota, Result},
    principal::{Act, Listed, Principal},
    spec::Fault,
    store::{Artifact, Attempt, Filter, Job, NewJob},
};

/// What one principal may see and do.
#[derive(Clone, Copy, Debug)]
pub struct Desk<'a> {
    jobs: &'a Jobs,
    who: &'a Principal,
}

impl Jobs {
    /// This data directory as `who` sees it.
    pub fn desk<'a>(&'a self, who: &'a Principal) -> Desk<'a> {
        Desk { jobs: self, who }
    }
}

impl Desk<'_> {
    /// A mesh that this owner uploaded before and means to use again.
    pub async fn reuse_mesh(&self, hash: &str) -> Result<Option<StoredMesh>> {
        self.jobs.reuse_mesh(&self.who.owner, hash).await
    }

    /// Stores the bytes that arrive on `chunks` until it closes.
    pub async fn put_mesh(
        &self,
        announced: Announced,
        chunks: mpsc::Receiver<Bytes>,
    ) -> Result<StoredMesh> {
        self.check_bytes().await?;
        let _turn = self.jobs.0.uploads.at_once(&self.who.owner).ok_or(Error::Busy)?;
        self.jobs.put_mesh(&self.who.owner, announced, chunks).await
    }

    /// How many of the first bytes of an upload are held by this server.
    pub async fn held_of_upload(&self, upload: &str) -> Result<u64> {
        self.jobs.held_of_upload(&self.who.owner, upload).await
    }

    /// Creates a job; `faults` are those that the caller found already.
    pub async fn create(&self, new: NewJob, mut faults: Vec<Fault>) -> Result<Job> {
        if let Err(full) = self.check_bytes().await {
            // Who did not hear the first answer hears it now.
            let store = &self.jobs.0.store;
            if !store.is_requested(&self.who.owner, &new.request_id).await? {
                return Err(full);
            }
        }
        if new.priority > 0 && !self.who.role.may(Act::Manage) {
            let text = "only administrators may put a job before those of others: use 0 or less";
            faults.push(Fault { field: "priority".into(), text: text.into() });
        }
        self.jobs.create(NewJob { owner: self.who.owner.clone(), ..new }, faults).await
    }

    /// One job.
    pub async fn job(&self, id: &str) -> Result<Job> {
        let job = self.jobs.job(id).await?;
        if self.who.sees(&job.owner) { Ok(job) } else { Err(Error::NotFound(job.name())) }
    }

    /// One job, and its latest attempts, the last one first.
    pub async fn job_and_attempts(&self, id: &str) -> Result<(Job, Vec<Attempt>)> {
        Ok((self.job(id).await?, self.jobs.attempts(id).await?))
    }

    /// Jobs that pass `filter` (all that may be seen where it names no owner), newest first, older than the job
    /// numbered `before`.
    pub async fn list(&self, filter: &Filter, before: Option<i64>, limit: u32) -> Result<Vec<Job>> {
        let owner = match self.who.listed(filter.owner.as_deref().unwrap_or_default()) {
            Listed::All => None,
            Listed::Of(owner) => Some(owner.to_owned()),
            Listed::Nothing => return Ok(Vec::new()),
        };
        self.jobs.list(&Filter { owner, ..filter.clone() }, before, limit).await
    }

    /// Cancels a queued job, or asks the worker of a running one to stop; says whether this call
    /// ended the job.
    pub async fn cancel(&self, id: &str) -> Result<(Job, bool)> {
        self.job(id).await?;
        self.jobs.cancel(id).await
    }

    /// Queues a job anew that failed or was cancelled.
    pub async fn retry(&self, id: &str) -> Result<Job> {
        self.job(id).await?;
        self.check_bytes().await?;
        self.jobs.retry(id).await
    }

    /// Keeps the results of a job beyond their time, or no longer so.
    pub async fn pin(&self, id: &str, pinned: bool) -> Result<Job> {
        self.job(id).await?;
        self.jobs.pin(id, pinned).await
    }

    /// Deletes an ended job with its log and artifacts.
    pub async fn delete(&self, id: &str) -> Result<()> {
        self.job(id).await?;
        self.jobs.delete(id).await
    }

    /// The artifacts of an ended job, by name; none before.
    pub async fn artifacts(&self, id: &str) -> Result<Vec<Artifact>> {
        self.job(id).await?;
        self.jobs.artifacts(id).await
    }

    /// One artifact of an ended job, and its bytes.
    pub async fn artifact(&self, id: &str, file: &str) -> Result<(Artifact, Blob)> {
        // Word for word what a missing artifact is called.
        let missing = |_| Error::NotFound(format!("jobs/{id}/artifacts/{file}"));
        match self.job(id).await {
            Err(Error::NotFound(name)) => return Err(missing(name)),
            found => drop(found?),
        }
        self.jobs.artifact(id, file).await
    }

    /// Refuses when this owner has stored as much as it may.
    async fn check_bytes(&self) -> Result<()> {
        let limit = self.jobs.0.limits.max_owner_bytes;
        // What has no limit need not be summed up.
        if limit < u64::MAX && self.jobs.0.store.stored_bytes(&self.who.owner).await? >= limit {
            return Err(Error::Quota { quota: Quota::Bytes, limit });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jobs::{
        Limits,
        labels::Labels,
        lease::Terms,
        principal::Role,
        spec::Spec,
        state::State,
        tests::{Home, in_homes},
    };

    in_homes! { [on_sqlite on_postgres] [
        what_is_another_owners_does_not_exist,
        owners_may_have_only_so_much,
    ] }

    const MESH: &[u8] = b"twelve bytes";

    fn user(owner: &str) -> Principal {
        Principal { name: format!("{owner}-laptop"), owner: owner.into(), role: Role::User }
    }

    async fn open(home: &Home, limits: Limits) -> Jobs {
        Jobs::open(home.places(), Terms::default(), limits).await.unwrap()
    }

    async fn put(desk: Desk<'_>) -> Result<StoredMesh> {
        let (send, chunks) = mpsc::channel(1);
        send.try_send(Bytes::from_static(MESH)).unwrap();
        drop(send);
        desk.put_mesh(Announced::default(), chunks).await
    }

    fn job_on(mesh: &str, request_id: &str) -> NewJob {
        let (owner, file_name) = (String::new(), "a.ply".into());
        let spec = Spec::new(vec![5]);
        NewJob {
            owner,
            request_id: request_id.into(),
            mesh: mesh.into(),
            file_name,
            spec,
            priority: 0,
            labels: Labels::new(),
            webhook: String::new(),
            trace: String::new(),
        }
    }

    /// What a refusal says, with the name of the thing taken out.
    fn text<T: std::fmt::Debug>(refused: Result<T>, name: &str) -> String {
        refused.unwrap_err().to_string().replace(name, "X")
    }

    async fn what_is_another_owners_does_not_exist(home: Home) {
        let jobs = open(&home, Limits::default()).await;
        let (ann, bob, admin) = (user("ann"), user("bob"), Principal::local());
        let (ann, bob, admin) = (jobs.desk(&ann), jobs.desk(&bob), jobs.desk(&admin));
        let mesh = put(ann).await.unwrap().hash;
        let job = ann.create(job_on(&mesh, "r"), vec![]).await.unwrap();
        let (id, nobodys) = (job.id.as_str(), "0".repeat(32));
        assert_eq!((job.owner.as_str(), ann.job(id).await.unwrap()), ("ann", job.clone()));
        assert_eq!(admin.job(id).await.unwrap(), job);
        let refusals = [
            (text(bob.job(id).await, id), text(bob.job(&nobodys).await, &nobodys)),
            (text(bob.cancel(id).await, id), text(bob.cancel(&nobodys).await, &nobodys)),
            (text(bob.delete(id).await, id), text(bob.delete(&nobodys).await, &nobodys)),
            (text(bob.artifacts(id).await, id), text(bob.artifacts(&nobodys).await, &nobodys)),
            (
                text(bob.artifact(id, "f").await, id),
                text(bob.artifact(&nobodys, "f").await, &nobodys),
            ),
        ];
        for (theirs, nobodys) in refusals {
            assert!(theirs.contains("does not exist") && theirs == nobodys, "{theirs} {nobodys}");
        }
        let unknown = "0".repeat(64);
        let theirs = text(bob.create(job_on(&mesh, ""), vec![]).await, &mesh);
        assert_eq!(theirs, text(bob.create(job_on(&unknown, ""), vec![]).await, &unknown));
        assert!(bob.reuse_mesh(&mesh).await.unwrap().is_none());
        // Their own upload of the same bytes is new to them, and theirs to use under the same request.
        assert!(!put(bob).await.unwrap().existed && put(bob).await.unwrap().existed);
        let bobs = bob.create(job_on(&mesh, "r"), vec![]).await.unwrap();
        assert_ne!(bobs.id, job.id);
        assert_eq!(ann.create(job_on(&mesh, "r"), vec![]).await.unwrap(), job);
        let of = |owner: &str, states: &[State]| Filter {
            owner: Some(owner.into()).filter(|owner: &String| !owner.is_empty()),
            states: states.into(),
            ..Filter::default()
        };
        let list = async |desk: Desk<'_>, owner: &str| -> Vec<String> {
            let jobs = desk.list(&of(owner, &[]), None, 9).await.unwrap();
            jobs.into_iter().map(|job| job.id).collect()
        };
        let (hers, his) = (job.id.clone(), bobs.id.clone());
        assert_eq!(list(ann, "").await, std::slice::from_ref(&hers));
        assert_eq!(list(ann, "bob").await, [""; 0]);
        assert_eq!(list(admin, "").await, [his.clone(), hers]);
        assert_eq!(list(admin, "bob").await, [his]);
        assert_eq!(list(admin, "bob\0").await, [""; 0]);
        let ended = of("ann", &[State::Cancelled, State::Failed]);
        assert_eq!(ann.list(&ended, None, 9).await.unwrap(), []);
        let waiting = of("", &[State::Running, State::Queued]);
        assert_eq!(ann.list(&waiting, None, 9).await.unwrap(), [job]);
        assert_eq!(jobs.0.blobs.jobs().await.unwrap().len(), 0);
    }

    async fn owners_may_have_only_so_much(home: Home) {
        let limits = Limits { max_owner_queued: 1, max_owner_bytes: 20, ..Limits::default() };
        let jobs = open(&home, limits).await;
        let (ann, bob) = (user("ann"), user("bob"));
        let (ann, bob) = (jobs.desk(&ann), jobs.desk(&bob));
        let mesh = put(ann).await.unwrap().hash;
        ann.create(job_on(&mesh, "r"), vec![]).await.unwrap();
        let second = ann.create(job_on(&mesh, ""), vec![]).await;
        assert!(matches!(second, Err(Error::Quota { quota: Quota::Queued, limit: 1 })));
        // The same request again makes no second job; another owner's queue is its own.
        ann.create(job_on(&mesh, "r"), vec![]).await.unwrap();
        put(bob).await.unwrap();
        bob.create(job_on(&mesh, ""), vec![]).await.unwrap();
        let (send, chunks) = mpsc::channel(1);
        send.try_send(Bytes::from_static(b"nine more")).unwrap();
        drop(send);
        let too_many = ann.put_mesh(Announced::default(), chunks).await;
        assert!(matches!(too_many, Err(Error::Quota { quota: Quota::Bytes, limit: 20 })));
        assert_eq!(jobs.0.store.stored_bytes("ann").await.unwrap(), MESH.len() as u64);
    }
}
