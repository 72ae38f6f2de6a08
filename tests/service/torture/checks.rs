//! What must hold of every job that was acknowledged, whatever happened to the processes.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex},
    time::Duration,
};

use lookalike::{
    jobs::{
        event::{Body, CREATED_SEQ, EnergySample, Event, Report, ServerEvent},
        state::State,
    },
    service::{
        convert::event_from_wire,
        proto::{v1, worker::v1 as wire},
        status::reason_of,
    },
};
use tonic::Code;

use super::{Random, fleet::Fleet, submission, submit};
use crate::{
    support::{Client, Server, create, ended, job, log, reference, results, state},
    workers::every_call,
};

/// Everything ends within this time, also on a busy machine.
pub(crate) const PATIENCE: Duration = Duration::from_mins(4);

/// The bytes of records of each level; of the chain of collapses where there is none.
type Records = BTreeMap<Option<u32>, Vec<u8>>;

/// What an undisturbed run of the job gives.
pub(crate) struct Reference {
    files: BTreeMap<String, Vec<u8>>,
    records: Records,
    /// Reports that do not depend on time, in their order.
    told: Vec<String>,
}

impl Reference {
    pub(crate) async fn of_undisturbed(server: &Server) -> Self {
        let mut client = server.client();
        let name = create(&mut client).await;
        assert_eq!(state(&ended(&client, &name).await), State::Succeeded);
        let log = log(&mut client, &name, 0).await;
        let log = effective(&log);
        Self { files: reference(server), records: records(&log), told: told(&log) }
    }

    pub(crate) fn files(&self) -> &BTreeMap<String, Vec<u8>> {
        &self.files
    }
}

/// A job whose creation was answered, and what its watcher has heard of it.
pub(crate) struct Acknowledged {
    pub(crate) name: String,
    pub(crate) request_id: String,
    /// Where it was submitted.
    pub(crate) server: usize,
    pub(crate) log: Vec<Event>,
}

impl Acknowledged {
    pub(crate) fn n_attempts(&self) -> u64 {
        self.claims().count() as u64
    }

    /// Epoch and worker of each attempt.
    fn claims(&self) -> impl Iterator<Item = (u64, &str)> {
        self.log.iter().filter_map(|event| match &event.body {
            Body::Server(ServerEvent::StateChanged { state: State::Running, worker, .. }) => {
                Some((event.epoch, worker.as_str()))
            }
            _ => None,
        })
    }

    /// Everything; how many writes of stale leases were refused.
    pub(crate) async fn check(&self, servers: &[Server], reference: &Reference) -> u64 {
        let server = &servers[self.server];
        let done = job(&mut server.client(), &self.name).await;
        assert_eq!(state(&done), State::Succeeded, "{done:?}");
        assert_eq!(u64::from(done.attempt), self.n_attempts(), "{}", self.name);
        self.check_log();
        let effective = effective(&self.log);
        assert_eq!(records(&effective), reference.records, "{}", self.name);
        assert_eq!(told(&effective), reference.told, "{}", self.name);
        let n_refused = self.check_fences(server).await;
        // What was heard, through whatever happened, is what there is, and stays so.
        for server in servers {
            assert_eq!(log(&mut server.client(), &self.name, 0).await, self.log, "{}", self.name);
        }
        self.check_files(server, reference);
        let again = submission(server, &self.request_id);
        assert_eq!(submit(again).await, self.name, "the same request made another job");
        n_refused
    }

    /// No gaps, one creation, one success, and epochs that only grow.
    fn check_log(&self) {
        let log = &self.log;
        let seqs = log.iter().map(|event| event.seq);
        assert!(seqs.eq(1..=log.len() as u64), "{}: its log has gaps", self.name);
        assert!(log.is_sorted_by_key(|event| event.epoch), "{}: an old epoch writes", self.name);
        let epochs = self.claims().map(|(epoch, _)| epoch);
        assert!(epochs.eq(1..=self.n_attempts()), "{}: epochs of claims", self.name);
        let states: Vec<_> = log.iter().filter_map(|event| event.body.state()).collect();
        assert_eq!(states.iter().filter(|state| state.is_final()).count(), 1, "{states:?}");
        assert_eq!(states.last(), Some(&State::Succeeded), "{states:?}");
        assert!(
            log.last().unwrap().body.state().is_some(),
            "{}: it goes on after its end",
            self.name
        );
    }

    /// Nobody can write any more: neither the workers that lost it, nor the one that ended it.
    async fn check_fences(&self, server: &Server) -> u64 {
        let mut n_refused = 0;
        let last = self.n_attempts();
        for (epoch, worker) in self.claims() {
            let lease = wire::Lease { job: self.name.clone(), epoch, worker: worker.into() };
            let mut calls = every_call(server, &lease).await;
            if epoch == last {
                // A repetition of the call that ended the job is answered as it was the first time.
                calls.pop().unwrap().unwrap();
            }
            n_refused += calls.len() as u64;
            for refused in calls {
                let status = refused.expect_err("a stale worker may write");
                assert_eq!(status.code(), Code::FailedPrecondition, "{status:?}");
                assert_eq!(reason_of(&status).as_deref(), Some("STALE_LEASE"));
            }
        }
        n_refused
    }

    fn check_files(&self, server: &Server, reference: &Reference) {
        let out = server.dir.path().join("out");
        let _ = std::fs::remove_dir_all(&out);
        let fetched = server.run("fetch", &[&self.name, "--out", &out.display().to_string()]);
        assert!(fetched.status.success(), "{fetched:?}");
        assert_eq!(results(&out), reference.files, "{}", self.name);
    }
}

/// Follows a log to its end, from server to server, and keeps what it hears.
pub(crate) async fn watch(clients: Vec<Client>, name: String, heard: Arc<Mutex<Vec<Event>>>) {
    let mut turns = clients.iter().cycle();
    loop {
        let after_seq = heard.lock().unwrap().len() as u64;
        let request = v1::WatchJobRequest { name: name.clone(), after_seq };
        let mut client = turns.next().unwrap().clone();
        let end = async {
            let mut events = client.watch_job(request).await?.into_inner();
            while let Some(message) = events.message().await? {
                let event = event_from_wire(message.event.unwrap()).unwrap();
                let mut heard = heard.lock().unwrap();
                assert_eq!(event.seq, heard.len() as u64 + 1, "{name}: a gap");
                heard.push(event);
            }
            Ok::<_, tonic::Status>(())
        };
        // A frozen server says nothing; another one may.
        match tokio::time::timeout(Duration::from_secs(20), end).await {
            Ok(Ok(())) => return,
            Ok(Err(status)) if status.code() == Code::NotFound => panic!("{name} is lost"),
            _ => tokio::time::sleep(Duration::from_millis(50)).await,
        }
    }
}

/// Every acknowledged job is listed once and nothing else, and one of them is looked at again.
pub(crate) async fn all_are_there(fleet: &Fleet, jobs: &[Acknowledged], random: &mut Random) {
    let mut client = fleet.client(random.below(2) as usize);
    let mut request = v1::ListJobsRequest::default();
    let mut listed = Vec::new();
    loop {
        let page = client.list_jobs(request.clone()).await.unwrap().into_inner();
        listed.extend(page.jobs.into_iter().map(|job| job.name));
        if page.next_page_token.is_empty() {
            break;
        }
        request.page_token = page.next_page_token;
    }
    // The oldest is the undisturbed one.
    let oldest = listed.pop();
    let wanted: Vec<_> = jobs.iter().rev().map(|job| job.name.clone()).collect();
    assert!(oldest.is_some() && listed == wanted, "{listed:?} are not {wanted:?}");
    let one = &jobs[random.below(jobs.len() as u64) as usize];
    assert_eq!(log(&mut client, &one.name, 0).await, one.log, "{} has changed", one.name);
}

/// What of a log still counts: less what lost attempts have reported since where the next one went on.
fn effective(log: &[Event]) -> Vec<Event> {
    let mut kept: Vec<Event> = Vec::new();
    for event in log {
        if let Body::Server(ServerEvent::Restarted { rewind_to_seq, .. }) = &event.body {
            assert!(*rewind_to_seq >= CREATED_SEQ && *rewind_to_seq < event.seq);
            kept.retain(|event| event.seq <= *rewind_to_seq);
        }
        kept.push(event.clone());
    }
    kept
}

/// The records of a log without its restarts; each follows the one before.
fn records(log: &[Event]) -> Records {
    let (mut records, mut next_record) = (Records::new(), BTreeMap::new());
    for event in log {
        if let Body::Worker(Report::Records { level, first, count, bytes }) = &event.body {
            let next = next_record.entry(*level).or_insert(0);
            assert_eq!(first, next);
            *next += u64::from(*count);
            records.entry(*level).or_default().extend(bytes);
        }
    }
    assert!(next_record[&None] > 0 && next_record[&Some(0)] > 0);
    records
}

/// What else the worker has told: samples without their seconds, moves, and files in their order.
fn told(log: &[Event]) -> Vec<String> {
    let tell = |event: &Event| match &event.body {
        Body::Worker(Report::Sample(sample)) => {
            Some(format!("{:?}", EnergySample { seconds: 0.0, ..sample.clone() }))
        }
        Body::Worker(moves @ Report::Moves { .. }) => Some(format!("{moves:?}")),
        Body::Worker(Report::Artifact { name, .. }) => Some(name.clone()),
        _ => None,
    };
    log.iter().filter_map(tell).collect()
}
