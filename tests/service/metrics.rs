//! The page of metrics: the queue, claims and losses, as jobs come and go.

use lookalike::service::proto::{v1, worker::v1 as wire};

use crate::{
    api::http_get,
    support::{Server, create_request, small_torus, upload},
};

/// Lines of the page that begin so, without the seconds that nobody can foresee.
fn lines(server: &Server, prefix: &str) -> Vec<String> {
    let page = http_get(&server.metrics, "/metrics");
    let lines = page.lines().filter(|line| line.starts_with(prefix));
    let without_seconds = |line: &str| match line.split_once("_seconds{") {
        Some(_) => line.rsplit_once(' ').map_or(line, |(name, _)| name).to_owned(),
        None => line.to_owned(),
    };
    lines.map(without_seconds).collect()
}

#[tokio::test]
async fn the_page_tells_of_the_queue_and_of_losses() {
    let server = Server::start_with(&["--workers=0"]);
    let mut client = server.client();
    assert_eq!(lines(&server, "lookalike_queue"), [""; 0]);
    let torus = small_torus();
    let n_bytes = torus.len();
    let mesh = upload(&mut client, torus).await;
    let mut names = Vec::new();
    for priority in [-3, 0, 0] {
        let request = v1::CreateJobRequest { priority, ..create_request(&mesh, "") };
        let job = client.create_job(request).await.unwrap().into_inner().job.unwrap();
        names.push(job.name);
    }
    let queue = |rows: &[(&str, u32)]| -> Vec<String> {
        let row = |(priority, n): &(&str, u32)| {
            format!("lookalike_queue_jobs{{owner=\"local\",priority=\"{priority}\"}} {n}")
        };
        let oldest = |(priority, _): &(&str, u32)| {
            format!("lookalike_queue_oldest_seconds{{owner=\"local\",priority=\"{priority}\"}}")
        };
        rows.iter().map(row).chain(rows.iter().map(oldest)).collect()
    };
    assert_eq!(lines(&server, "lookalike_queue"), queue(&[("-3", 1), ("0", 2)]));
    let claim = wire::ClaimRequest {
        worker: "w".into(),
        version: env!("CARGO_PKG_VERSION").into(),
        wait_secs: 5.0,
        ..Default::default()
    };
    // Whoever asks again has dropped what it had; whoever leaves hands it back.
    let mut worker = server.worker_client();
    for _ in 0..2 {
        worker.claim(claim.clone()).await.unwrap().into_inner().assignment.unwrap();
    }
    worker.leave(wire::LeaveRequest { worker: "w".into() }).await.unwrap();
    let lost = |reason: &str| format!("lookalike_lost_attempts_total{{reason=\"{reason}\"}} 1");
    crate::support::eventually("the losses", || async {
        let told = lines(&server, "lookalike_lost_attempts_total");
        (told.contains(&lost("ABANDONED")) && told.contains(&lost("RELEASED"))).then_some(())
    })
    .await;
    assert_eq!(lines(&server, "lookalike_claims_total"), ["lookalike_claims_total 2"]);
    let received = format!("lookalike_received_bytes_total{{what=\"mesh\"}} {n_bytes}");
    assert_eq!(lines(&server, "lookalike_received_bytes_total"), [received]);
    for name in names {
        client.cancel_job(v1::CancelJobRequest { name }).await.unwrap();
    }
    assert_eq!(lines(&server, "lookalike_queue"), [""; 0]);
}
