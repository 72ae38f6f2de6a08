//! Through a network that breaks, and with replies that are lost: the same results, and nothing done twice.
//!
//! Client and worker each reach the server through a proxy of their own. `LOOKALIKE_CHAOS_ROUNDS` (2) says how many
//! jobs, `LOOKALIKE_TORTURE_SEED` when connections break.

mod forgetful;
mod proxy;

use std::{io::Write as _, path::Path, process::Output, time::Instant};

use lookalike::service::proto::v1;
use tokio::process::Command;

use self::{forgetful::Forgetful, proxy::Proxy};
use crate::{
    support::{JOB, Server, create_request, job, log, results, small_torus, upload},
    torture::{
        checks::{Acknowledged, PATIENCE, Reference},
        fleet::Joined,
        number,
    },
};

/// A server without workers of its own.
fn server() -> Server {
    Server::start_with(&[
        "--workers=0",
        "--lease-secs=4",
        "--heartbeat-secs=0.5",
        "--max-attempts=1000000",
    ])
}

fn join(server: &Server, url: &str) -> Joined {
    let id = format!("joined-{}", uuid::Uuid::new_v4().simple());
    Joined::start(id, 0, url, server.dir.path())
}

/// A whole job as a client sees it: submitted, followed, fetched into `out`. A client that found nobody at its
/// first call is started again.
async fn whole(mut client: Command) {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let output: Output = client.output().await.unwrap();
        if output.status.success() {
            return;
        }
        assert_eq!(output.status.code(), Some(3), "{output:?}");
        assert!(Instant::now() < deadline, "{output:?}");
    }
}

fn submit(url: &str, server: &Server, request_id: &str, out: &Path) -> Command {
    let file = server.file("torus.ply", &small_torus());
    let (request_id, out) = (format!("--request-id={request_id}"), out.display().to_string());
    let mut command = Command::from(crate::support::lookalike());
    command.args(["submit", &*file, "--server", url, &*request_id, "--out", &*out]).args(JOB);
    command
}

/// The Python client doing the same.
fn submit_in_python(
    python: &str,
    url: &str,
    server: &Server,
    request_id: &str,
    out: &Path,
) -> Command {
    let file = server.file("torus.ply", &small_torus());
    let mut command = Command::new(python);
    command.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/service/chaos/submit.py"));
    command.args([url, &*file, request_id]).arg(out);
    command
}

/// Everything that must hold of the jobs of these requests, seen without a proxy.
async fn check(server: &Server, reference: &Reference, requests: &[String]) {
    let mut client = server.client();
    let listed = client.list_jobs(v1::ListJobsRequest::default()).await.unwrap().into_inner().jobs;
    // The oldest is the undisturbed one.
    assert_eq!(listed.len(), requests.len() + 1);
    for (listed, request_id) in listed.into_iter().rev().skip(1).zip(requests) {
        let log = log(&mut client, &listed.name, 0).await;
        let request_id = request_id.clone();
        let acknowledged = Acknowledged { name: listed.name, request_id, server: 0, log };
        acknowledged.check(std::slice::from_ref(server), reference).await;
    }
}

/// An undisturbed run, by a worker that leaves before the trouble begins.
async fn undisturbed(server: &Server) -> Reference {
    let _worker = join(server, &server.url);
    Reference::of_undisturbed(server).await
}

/// Clients through a network that breaks.
async fn broken_network(client: impl Fn(&str, &Server, &str, &Path) -> Command) {
    let seed = number("LOOKALIKE_TORTURE_SEED", u64::from(std::process::id()));
    let rounds = number("LOOKALIKE_CHAOS_ROUNDS", 2);
    eprintln!("chaos: {rounds} rounds, LOOKALIKE_TORTURE_SEED={seed}");
    let server = server();
    let reference = undisturbed(&server).await;
    let to_client = Proxy::start(&server.url, seed).await;
    let to_worker = Proxy::start(&server.url, seed.wrapping_add(1)).await;
    let mut worker = join(&server, &to_worker.url);
    let requests: Vec<_> = (0..rounds).map(|round| format!("round-{round}")).collect();
    for request_id in &requests {
        let out = server.dir.path().join(request_id);
        whole(client(&to_client.url, &server, request_id, &out)).await;
        assert_eq!(&results(&out), reference.files(), "{request_id}");
    }
    assert!(worker.lives(), "the worker ended: {}", server.logged());
    check(&server, &reference, &requests).await;
    let (client, worker) = (to_client.fates(), to_worker.fates());
    assert!(!client.is_empty() && !worker.is_empty());
    eprintln!("chaos: {rounds} jobs; connections of clients {client:?}, of the worker {worker:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn chaos_between_command_line_server_and_worker() {
    broken_network(submit).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn chaos_between_python_server_and_worker() {
    // `make python` installs the client, and runs this test again.
    let Ok(python) = std::env::var("LOOKALIKE_PYTHON") else {
        let _ = writeln!(
            std::io::stderr(),
            "skipped: LOOKALIKE_PYTHON names no Python that has the client (make python)"
        );
        return;
    };
    broken_network(|url, server, id, out| submit_in_python(&python, url, server, id, out)).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn calls_whose_reply_is_lost_are_repeated_and_take_effect_once() {
    let server = server();
    let reference = undisturbed(&server).await;
    let [to_client, to_worker] =
        [Forgetful::start(&server.url).await, Forgetful::start(&server.url).await];
    let mut worker = join(&server, &to_worker.url);
    let requests: Vec<_> = (0..2).map(|round| format!("round-{round}")).collect();
    for request_id in &requests {
        let out = server.dir.path().join(request_id);
        whole(submit(&to_client.url, &server, request_id, &out)).await;
        assert_eq!(&results(&out), reference.files(), "{request_id}");
    }
    assert!(worker.lives(), "the worker ended");
    check(&server, &reference, &requests).await;
    let lost: Vec<_> = to_client.lost().into_keys().chain(to_worker.lost().into_keys()).collect();
    let wanted = [
        &["CreateJob", "GetJob", "ListArtifacts", "UploadMesh"][..],
        &["AppendEvents", "Claim", "Complete", "Heartbeat", "PutArtifact"],
    ];
    assert_eq!(lost, wanted.concat());
    // One creation was answered, and once more.
    assert!(server.logged().matches("job created").count() > requests.len() + 1);
}

#[tokio::test]
async fn calls_of_clients_may_be_repeated() {
    let server = server();
    let mut client = server.client();
    let mesh = upload(&mut client, small_torus()).await;
    assert_eq!(upload(&mut client, small_torus()).await, mesh);
    let request = create_request(&mesh, "once");
    let name = client.create_job(request.clone()).await.unwrap().into_inner().job.unwrap().name;
    let again = client.create_job(request).await.unwrap().into_inner().job.unwrap().name;
    assert_eq!(again, name);
    let pin = v1::PinJobRequest { name: name.clone(), pinned: true };
    let cancel = v1::CancelJobRequest { name: name.clone() };
    let delete = v1::DeleteJobRequest { name: name.clone(), allow_missing: true };
    for _ in 0..2 {
        client.pin_job(pin.clone()).await.unwrap();
        client.cancel_job(cancel.clone()).await.unwrap();
    }
    assert_eq!(log(&mut client, &name, 0).await.len(), 2);
    assert!(job(&mut client, &name).await.pinned);
    for _ in 0..2 {
        client.delete_job(delete.clone()).await.unwrap();
    }
}
