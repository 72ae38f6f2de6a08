//! Random walks against a model, and pages of lists that grow; on every store.

use std::collections::BTreeMap;

use proptest::prelude::*;
use tokio::runtime::Runtime;

use super::*;

/// What the model knows of a job.
#[derive(Clone, Debug, PartialEq)]
struct Model {
    state: State,
    epoch: u64,
    lost: u32,
    cancel: bool,
    n_sent: u64,
}

#[derive(Clone, Copy, Debug)]
enum Step {
    Create,
    Claim(usize),
    Lose(usize),
    Append(usize),
    Succeed(usize),
    Release(usize),
    Cancel(usize),
    Delete(usize),
}

fn step() -> impl Strategy<Value = Step> {
    let with = |step: fn(usize) -> Step| (0..4usize).prop_map(step);
    prop_oneof![
        Just(Step::Create),
        with(Step::Claim),
        with(Step::Lose),
        with(Step::Append),
        with(Step::Succeed),
        with(Step::Release),
        with(Step::Cancel),
        with(Step::Delete),
    ]
}

/// Jobs by order of creation, and what each worker believes to hold.
struct Walk {
    jobs: Jobs,
    new: NewJob,
    model: BTreeMap<String, Model>,
    leases: BTreeMap<usize, Lease>,
}

impl Walk {
    async fn take(&mut self, step: Step) {
        match step {
            Step::Create => {
                let id = self.jobs.create(self.new.clone(), vec![]).await.unwrap().id;
                let state = State::Queued;
                self.model.insert(id, Model { state, epoch: 0, lost: 0, cancel: false, n_sent: 0 });
            }
            Step::Claim(w) => self.claim(w).await,
            Step::Lose(w) => {
                self.jobs.worker_gone(&format!("w{w}")).await.unwrap();
                self.lose(w, 1);
            }
            Step::Append(w) => {
                let Some(lease) = self.leases.get(&w) else { return };
                let job = self.model.get_mut(&lease.job).filter(|job| holds(job, lease));
                let first = job.as_ref().map_or(0, |job| job.n_sent);
                let appended = self.jobs.append(lease, first, vec![note("x")]).await;
                assert_eq!(appended.is_ok(), job.is_some());
                if let Some(job) = job {
                    job.n_sent += 1;
                }
            }
            Step::Succeed(w) => {
                let Some(lease) = self.leases.remove(&w) else { return };
                let done = self.jobs.complete(&lease, &Outcome::Succeeded(vec![])).await;
                let job = self.model.get_mut(&lease.job).filter(|job| holds(job, &lease));
                assert_eq!(done.is_ok(), job.is_some());
                if let Some(job) = job {
                    job.state = State::Succeeded;
                }
            }
            Step::Release(w) => {
                let Some(lease) = self.leases.get(&w).cloned() else { return };
                let legal = self.model.get(&lease.job).is_some_and(|job| holds(job, &lease));
                let outcome = Outcome::Released(String::new());
                assert_eq!(self.jobs.complete(&lease, &outcome).await.is_ok(), legal);
                self.lose(w, 0);
            }
            Step::Cancel(i) => self.cancel(i).await,
            Step::Delete(i) => {
                let Some(id) = self.model.keys().nth(i).cloned() else { return };
                let legal = self.model[&id].state.is_final();
                assert_eq!(self.jobs.delete(&id).await.is_ok(), legal);
                if legal {
                    self.model.remove(&id);
                }
            }
        }
    }

    async fn claim(&mut self, w: usize) {
        self.lose(w, 1);
        let oldest = self.model.iter_mut().find(|(_, job)| job.state == State::Queued);
        let claimed = claim(&self.jobs, &format!("w{w}")).await;
        assert_eq!(claimed.as_ref().map(|(job, _)| &job.id), oldest.as_ref().map(|(id, _)| *id));
        if let (Some((_, lease)), Some((_, job))) = (claimed, oldest) {
            job.state = State::Running;
            job.epoch += 1;
            job.n_sent = 0;
            self.leases.insert(w, lease);
        }
    }

    /// Whatever worker `w` holds is lost, and counts `blame` against the job.
    fn lose(&mut self, w: usize, blame: u32) {
        let Some(lease) = self.leases.remove(&w) else { return };
        let Some(job) = self.model.get_mut(&lease.job).filter(|job| holds(job, &lease)) else {
            return;
        };
        job.lost += blame;
        job.state = match (job.cancel, job.lost) {
            (true, _) => State::Cancelled,
            (false, 3..) => State::Failed,
            (false, _) => State::Queued,
        };
    }

    async fn cancel(&mut self, i: usize) {
        let Some((id, job)) = self.model.iter_mut().nth(i) else { return };
        let legal = !matches!(job.state, State::Succeeded | State::Failed) || job.cancel;
        assert_eq!(self.jobs.cancel(id).await.is_ok(), legal);
        job.cancel |= legal;
        if job.state == State::Queued {
            job.state = State::Cancelled;
        }
    }

    async fn check(&self) {
        let listed = self.jobs.list(None, &[], None, 1000).await.unwrap();
        assert_eq!(listed.len(), self.model.len());
        for job in listed {
            let appended = job.appended;
            let (state, epoch, lost) = (job.state, job.epoch, job.lost);
            let cancel = job.cancel_requested;
            let found = Model { state, epoch, lost, cancel, n_sent: appended };
            assert_eq!(&found, &self.model[&job.id]);
        }
    }
}

fn holds(job: &Model, lease: &Lease) -> bool {
    job.state == State::Running && job.epoch == lease.epoch
}

async fn follow_the_model(home: Home, steps: &[Step]) {
    let jobs = home.open().await;
    let new = new_job(&jobs, "").await;
    let (model, leases) = (BTreeMap::new(), BTreeMap::new());
    let mut walk = Walk { jobs, new, model, leases };
    for &step in steps {
        walk.take(step).await;
        walk.check().await;
    }
    for id in walk.model.keys() {
        let job = walk.jobs.job(id).await.unwrap();
        let log = walk.jobs.0.store.events(id, 0, 10_000).await.unwrap();
        let seqs: Vec<_> = log.iter().map(|stored| stored.event.seq).collect();
        assert_eq!(seqs, (1..=job.last_seq).collect::<Vec<_>>());
        let last = log.iter().rev().find_map(|stored| stored.event.body.state());
        assert_eq!(last, Some(job.state));
    }
    walk.jobs.close().await;
}

/// Reads pages of so many jobs, after each of which so many come in.
async fn read_pages(home: Home, n_before: usize, sizes: &[(u32, usize)]) {
    let jobs = home.open().await;
    let new = new_job(&jobs, "").await;
    let mut wanted = Vec::new();
    for _ in 0..n_before {
        wanted.insert(0, jobs.create(new.clone(), vec![]).await.unwrap().id);
    }
    let (mut before, mut seen) = (None, Vec::new());
    for &(size, n_inserted) in sizes.iter().cycle().take(40) {
        let page = jobs.list(None, &[State::Queued], before, size).await.unwrap();
        before = page.last().map(|job| job.n).or(before);
        seen.extend(page.into_iter().map(|job| job.id));
        for _ in 0..n_inserted {
            jobs.create(new.clone(), vec![]).await.unwrap();
        }
    }
    assert_eq!(seen, wanted);
    jobs.close().await;
}

fn on_every_store(test: impl AsyncFn(Home)) {
    for home in [|| Some(Home::on_sqlite()), Home::on_postgres] {
        if let Some(home) = home() {
            Runtime::new().unwrap().block_on(test(home));
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]
    #[test]
    fn random_walks_follow_the_model(steps in prop::collection::vec(step(), 1..60)) {
        on_every_store(async |home| follow_the_model(home, &steps).await);
    }

    #[test]
    fn pages_neither_repeat_nor_skip(
        n_before in 1..20usize,
        sizes in prop::collection::vec((1..6u32, 0..4usize), 1..30),
    ) {
        on_every_store(async |home| read_pages(home, n_before, &sizes).await);
    }
}
