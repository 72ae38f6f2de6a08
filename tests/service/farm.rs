//! Several servers on one PostgreSQL and one bucket.

use std::{fs, path::Path, time::Duration};

use lookalike::{jobs::state::State, service::proto::v1};

use crate::{
    postgres::Cluster,
    processes::{reasons, running},
    s3::S3,
    support::{
        LONG_JOB, Server, create, ended, eventually, job, log, reference, results, small_torus,
        state,
    },
};

/// What the servers share. `None`, and a line that says so, when PostgreSQL is missing.
pub(crate) struct Farm {
    pub(crate) cluster: Cluster,
    bucket: S3,
    database: String,
}

impl Farm {
    pub(crate) fn start() -> Option<Self> {
        let mut cluster = Cluster::start()?;
        let database = cluster.create();
        Some(Self { cluster, bucket: S3::start(), database })
    }

    pub(crate) fn server(&self, flags: &[&str]) -> Server {
        let mut environment = self.bucket.environment();
        environment.push(("LOOKALIKE_DATABASE".into(), self.database.clone()));
        environment.push(("LOOKALIKE_OBJECTS".into(), S3::url()));
        Server::start_in(flags, environment)
    }
}

#[tokio::test]
async fn a_job_of_one_server_is_done_by_a_worker_of_another() {
    let Some(farm) = Farm::start() else { return };
    let front = farm.server(&["--workers=0"]);
    let back = farm.server(&["--workers=1"]);
    let mut client = front.client();
    let name = create(&mut client).await;
    // Live from its first entry to its last, through the server that has no workers.
    let live = log(&mut client, &name, 0).await;
    assert_eq!(reasons(&live), ["CREATED", "CLAIMED", "COMPLETED"]);
    assert_eq!(log(&mut back.client(), &name, 0).await, live);
    let out = front.dir.path().join("out");
    let out_text = out.display().to_string();
    let id = name.strip_prefix("jobs/").unwrap();
    let output = front.run("fetch", &[id, "--out", &out_text]);
    assert!(output.status.success(), "{output:?}");
    assert_eq!(results(&out), reference(&front));
    assert!(!front.data_dir().join("jobs.sqlite3").exists());
    assert!(!front.data_dir().join("objects/meshes").exists());
    assert!(farm.bucket.folder().join("farm/some/prefix/meshes").exists());
    // Deleted here, gone there.
    client
        .delete_job(v1::DeleteJobRequest { name: name.clone(), allow_missing: false })
        .await
        .unwrap();
    let listed = back.client().list_jobs(v1::ListJobsRequest::default()).await.unwrap();
    assert_eq!(listed.into_inner().jobs, []);
    // The S3 server keeps folders that are empty.
    assert_eq!(n_files(&farm.bucket.folder().join("farm/some/prefix/jobs").join(id)), 0);
}

fn n_files(folder: &Path) -> usize {
    let paths = fs::read_dir(folder).into_iter().flatten().map(|entry| entry.unwrap().path());
    paths.map(|path| if path.is_dir() { n_files(&path) } else { 1 }).sum()
}

#[tokio::test]
async fn cancelling_and_restarting_one_server_reach_the_other_as_they_should() {
    let Some(farm) = Farm::start() else { return };
    let mut front = farm.server(&["--workers=0"]);
    // The lease alone would tell the worker after a long time.
    let back = farm.server(&["--workers=1", "--heartbeat-secs=0.2"]);
    let file = front.file("torus.ply", &small_torus());
    let output = front.run("submit", &[&[&*file, "--no-wait"], &LONG_JOB[..]].concat());
    assert!(output.status.success(), "{output:?}");
    let mut client = front.client();
    let listed = client.list_jobs(v1::ListJobsRequest::default()).await.unwrap().into_inner();
    let name = listed.jobs[0].name.clone();
    running(&front, &name).await;
    // The other server's worker is none of its business when it starts again.
    front.kill();
    front.restart();
    tokio::time::sleep(Duration::from_millis(500)).await;
    assert_eq!(state(&job(&mut client, &name).await), State::Running);
    client.cancel_job(v1::CancelJobRequest { name: name.clone() }).await.unwrap();
    let done = ended(&back.client(), &name).await;
    assert_eq!((state(&done), done.attempt), (State::Cancelled, 1));
    assert_eq!(reasons(&log(&mut client, &name, 0).await), ["CREATED", "CLAIMED", "CANCELLED"]);
}

#[tokio::test]
async fn a_database_that_crashes_costs_no_attempt() {
    let Some(mut farm) = Farm::start() else { return };
    let server = farm.server(&["--workers=1"]);
    let pids = server.workers_up(1).await;
    let mut client = server.client();
    for (order, back) in [("crash", None), ("stop", Some("start"))] {
        let name = create(&mut client).await;
        // Its worker knows of it: a claim whose answer is lost would be made again.
        eventually("the worker to say something", || {
            let (mut client, name) = (client.clone(), name.clone());
            async move { (!job(&mut client, &name).await.stage.is_empty()).then_some(()) }
        })
        .await;
        farm.cluster.order(order);
        if let Some(back) = back {
            // Told to come back, and by whom.
            let status = eventually("an error", || {
                let mut client = client.clone();
                async move { client.list_jobs(v1::ListJobsRequest::default()).await.err() }
            });
            let status = status.await;
            assert_eq!(status.code(), tonic::Code::Unavailable, "{status:?}");
            assert_eq!(lookalike::service::status::reason_of(&status).as_deref(), Some("AWAY"));
            farm.cluster.order(back);
        }
        let done = ended(&client, &name).await;
        assert_eq!((state(&done), done.attempt), (State::Succeeded, 1), "{order}");
        let log = log(&mut client, &name, 0).await;
        assert!(log.iter().map(|event| event.seq).eq(1..=log.len() as u64), "{order}");
        assert_eq!(reasons(&log), ["CREATED", "CLAIMED", "COMPLETED"]);
    }
    assert_eq!(server.worker_pids(), pids);
}
