//! Random walks against a model, and pages of lists that grow; on every store.

use std::collections::{BTreeMap, BTreeSet};

use proptest::prelude::*;
use tokio::runtime::Runtime;

use super::*;
use crate::jobs::lease::blame;

/// What the model knows of a job.
#[derive(Clone, Debug, PartialEq)]
struct Model {
    state: State,
    epoch: u64,
    /// The workers that have lost it, each as often as it has.
    losers: Vec<usize>,
    cancel: bool,
    n_sent: u64,
}

impl Model {
    fn lost(&self) -> u32 {
        let distinct: BTreeSet<_> = self.losers.iter().collect();
        blame(distinct.len() as u32, self.losers.len() as u32)
    }
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
    Retry(usize),
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
        with(Step::Retry),
    ]
}

/// Jobs by order of creation, and what each worker believes to hold.
struct Walk {
    jobs: Jobs,
    new: NewJob,
    model: BTreeMap<String, Model>,
    /// Those that have asked for a job.
    hosts: BTreeSet<usize>,
    leases: BTreeMap<usize, Lease>,
}

impl Walk {
    async fn take(&mut self, step: Step) {
        match step {
            Step::Create => {
                let id = self.jobs.create(self.new.clone(), vec![]).await.unwrap().id;
                let state = State::Queued;
                let losers = Vec::new();
                self.model.insert(id, Model { state, epoch: 0, losers, cancel: false, n_sent: 0 });
            }
            Step::Claim(w) => self.claim(w).await,
            Step::Lose(w) => {
                self.jobs.worker_gone(&format!("w{w}")).await.unwrap();
                self.lose(w, true);
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
                self.lose(w, false);
            }
            Step::Cancel(i) => self.cancel(i).await,
            Step::Retry(i) => self.retry(i).await,
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
        self.lose(w, true);
        self.hosts.insert(w);
        // A job goes to another worker than those that have lost it, as long as there is one.
        let queued = |job: &Model| job.state == State::Queued;
        let fits = |job: &Model| queued(job) && !job.losers.contains(&w);
        let is_left =
            |job: &Model| queued(job) && self.hosts.iter().all(|h| job.losers.contains(h));
        let oldest = self.model.iter().find(|(_, job)| fits(job));
        let oldest = oldest.or_else(|| self.model.iter().find(|(_, job)| is_left(job)));
        let oldest = oldest.map(|(id, _)| id.clone());
        let claimed = claim(&self.jobs, &format!("w{w}")).await;
        assert_eq!(claimed.as_ref().map(|(job, _)| &job.id), oldest.as_ref());
        let oldest = oldest.and_then(|id| self.model.get_mut(&id));
        if let (Some((_, lease)), Some(job)) = (claimed, oldest) {
            job.state = State::Running;
            job.epoch += 1;
            job.n_sent = 0;
            self.leases.insert(w, lease);
        }
    }

    /// Whatever worker `w` holds is lost, which may speak against the job.
    fn lose(&mut self, w: usize, counts: bool) {
        let Some(lease) = self.leases.remove(&w) else { return };
        let Some(job) = self.model.get_mut(&lease.job).filter(|job| holds(job, &lease)) else {
            return;
        };
        job.losers.extend(counts.then_some(w));
        job.state = match (job.cancel, job.lost()) {
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

    async fn retry(&mut self, i: usize) {
        let Some((id, job)) = self.model.iter_mut().nth(i) else { return };
        let legal = match job.state {
            State::Succeeded => false,
            State::Running => !job.cancel,
            _ => true,
        };
        assert_eq!(self.jobs.retry(id).await.is_ok(), legal);
        if legal && matches!(job.state, State::Failed | State::Cancelled) {
            (job.state, job.cancel) = (State::Queued, false);
            job.losers.clear();
        }
    }

    async fn check(&self) {
        let listed = self.jobs.list(&Filter::default(), None, 1000).await.unwrap();
        assert_eq!(listed.len(), self.model.len());
        for job in listed {
            let appended = job.appended;
            let model = &self.model[&job.id];
            let found = (job.state, job.epoch, job.lost, job.cancel_requested, appended);
            let wanted = (model.state, model.epoch, model.lost(), model.cancel, model.n_sent);
            assert_eq!(found, wanted);
        }
    }
}

fn holds(job: &Model, lease: &Lease) -> bool {
    job.state == State::Running && job.epoch == lease.epoch
}

async fn follow_the_model(home: Home, steps: &[Step]) {
    // Workers that lose many jobs are another story.
    let (lease, max_in_a_row) = (Duration::from_hours(1), u32::MAX);
    let terms = Terms { lease, max_in_a_row, ..Terms::default() };
    let jobs = Jobs::open(home.places(), terms, Limits::default()).await.unwrap();
    let new = new_job(&jobs, "").await;
    let (model, leases) = (BTreeMap::new(), BTreeMap::new());
    let mut walk = Walk { jobs, new, model, hosts: BTreeSet::new(), leases };
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
    let waiting = Filter { states: vec![State::Queued], ..Filter::default() };
    for &(size, n_inserted) in sizes.iter().cycle().take(40) {
        let page = jobs.list(&waiting, before, size).await.unwrap();
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
