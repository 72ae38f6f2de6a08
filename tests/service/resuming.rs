//! Jobs that lose their worker go on from their checkpoints.

use lookalike::jobs::{
    event::{Body, Event, ServerEvent},
    state::State,
};
use rustix::process::Signal;

use crate::support::{
    Server, ended, eventually, log, reference_of, results, signal, small_torus, state,
};

/// A job of some seconds.
const JOB: [&str; 6] = [
    "--triangles=500,200",
    "--views=12",
    "--image-size=128",
    "--effort=balanced",
    "--seed=7",
    "--optimize-evaluations=150000",
];

fn submit(server: &Server) -> String {
    let file = server.file("torus.ply", &small_torus());
    let output = server.run("submit", &[&[&*file, "--no-wait"], &JOB[..]].concat());
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout).unwrap().trim().to_owned()
}

fn n_pieces(server: &Server) -> usize {
    server.files_below("objects").iter().filter(|file| file.contains("/checkpoint/")).count()
}

/// Where the log says that the job went on.
fn resumed(log: &[Event]) -> Vec<u64> {
    let rewind = |event: &Event| match &event.body {
        Body::Server(ServerEvent::Restarted { rewind_to_seq, reason, .. }) => {
            assert_eq!(reason, "RESUMED");
            Some(*rewind_to_seq)
        }
        _ => None,
    };
    log.iter().filter_map(rewind).collect()
}

async fn check_end(server: &Server, name: &str, attempts: u32) -> Vec<u64> {
    let mut client = server.client();
    let done = ended(&client, name).await;
    assert_eq!((state(&done), done.attempt), (State::Succeeded, attempts), "{done:?}");
    let out = server.dir.path().join("out");
    let fetched = server.run("fetch", &[name, "--out", &out.display().to_string()]);
    assert!(fetched.status.success(), "{fetched:?}");
    assert_eq!(results(&out), reference_of(server, &JOB));
    assert_eq!(n_pieces(server), 0, "a checkpoint goes with the end of its job");
    resumed(&log(&mut client, name, 0).await)
}

#[tokio::test]
async fn a_job_goes_on_where_its_killed_workers_left_it() {
    let server = Server::start_with(&["--workers=1", "--checkpoint-secs=0.05"]);
    let name = submit(&server);
    for n_wanted in [2, 5] {
        let has_come_far = || async { (n_pieces(&server) >= n_wanted).then_some(()) };
        eventually("checkpoints", has_come_far).await;
        server.worker_pids().into_iter().for_each(|pid| signal(pid, Signal::KILL));
    }
    let rewinds = check_end(&server, &name, 3).await;
    assert!(rewinds.len() == 2 && rewinds[0] > 2 && rewinds[1] > rewinds[0], "{rewinds:?}");
}

#[tokio::test]
async fn a_server_that_ends_in_peace_keeps_what_its_workers_found_out() {
    // No checkpoint is due before the end.
    let flags = ["--workers=1", "--checkpoint-secs=3600", "--drain-secs=20"];
    let mut server = Server::start_with(&flags);
    let name = submit(&server);
    let client = server.client();
    eventually("the second stage", || async {
        let request = lookalike::service::proto::v1::GetJobRequest { name: name.clone() };
        let job = client.clone().get_job(request).await.ok()?.into_inner().job?;
        (job.stage == "optimize").then_some(())
    })
    .await;
    assert_eq!(n_pieces(&server), 0);
    let (_, well) = server.terminate();
    assert!(well);
    assert_eq!(n_pieces(&server), 1);
    server.restart();
    let rewinds = check_end(&server, &name, 2).await;
    assert!(rewinds.len() == 1 && rewinds[0] > 2, "{rewinds:?}");
}
