//! `lookalike job`: all that a server tells of one job.

use clap::Args;
use lookalike::service::{convert, proto::v1};
use serde_json::{Value, json};

use super::{
    exit::Failure,
    remote::{Remote, ServerArgs, job_name},
    show::{job_json, job_line, print},
};

/// Flags of `lookalike job`.
#[derive(Args, Debug)]
pub(crate) struct JobArgs {
    /// The job, `jobs/{id}` or just the id.
    job: String,
    /// One JSON object.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    server: ServerArgs,
}

pub(crate) async fn run(args: JobArgs) -> Result<(), Failure> {
    let remote = Remote::connect(&args.server).await?;
    let request = v1::GetJobRequest { name: job_name(&args.job) };
    let answer = remote.call(|mut client| {
        let request = request.clone();
        async move { client.get_job(request).await }
    });
    let v1::GetJobResponse { job, attempts } = answer.await?;
    let job = remote.present(job)?;
    if args.json {
        let mut value = job_json(job);
        value["attempts"] = attempts.iter().map(attempt_json).collect();
        print(&format!("{value}\n"));
    } else {
        print(&text(&job, &attempts));
    }
    Ok(())
}

fn attempt_json(attempt: &v1::Attempt) -> Value {
    let ms = |time: Option<&prost_types::Timestamp>| time.map(convert::time_from_wire);
    json!({
        "attempt": attempt.attempt,
        "epoch": attempt.epoch,
        "worker": attempt.worker,
        "host": attempt.host,
        "started_ms": ms(attempt.start_time.as_ref()),
        "ended_ms": ms(attempt.end_time.as_ref()),
        "reason": attempt.reason,
        "text": attempt.text,
        "counts": attempt.counts,
    })
}

/// The line that lists have of it, and below it what they leave out.
fn text(job: &v1::Job, attempts: &[v1::Attempt]) -> String {
    let mut labels: Vec<String> = job.labels.iter().map(|(k, v)| format!("{k}={v}")).collect();
    labels.sort_unstable();
    let failure = job.failure.as_ref();
    let rows = [
        ("owner", Some(job.owner.clone())),
        ("created", job.create_time.map(|time| time.to_string())),
        ("began", job.start_time.map(|time| time.to_string())),
        ("ended", job.end_time.map(|time| time.to_string())),
        ("labels", Some(labels.join(" "))),
        ("pinned", job.pinned.then(|| "its results are kept".into())),
        ("failure", failure.map(|failure| format!("{}: {}", failure.reason, failure.text))),
    ];
    let rows = rows.into_iter().filter_map(|(name, value)| Some((name, value?)));
    let rows = rows.filter(|(_, value)| !value.is_empty());
    let lines = rows.map(|(name, value)| format!("  {name:<8} {value}\n"));
    let lines =
        std::iter::once(job_line(job)).chain(lines).chain(attempts.iter().map(attempt_line));
    lines.collect()
}

fn attempt_line(attempt: &v1::Attempt) -> String {
    let v1::Attempt { attempt: n, host, reason, text, .. } = attempt;
    let began = attempt.start_time.map(|time| format!(", from {time}")).unwrap_or_default();
    let ended = attempt
        .end_time
        .map_or_else(|| ", goes on".to_owned(), |time| format!(" to {time}: {reason}, {text}"));
    let host = host.strip_prefix("workers/").unwrap_or(host);
    format!("  attempt  {n} on {host}{began}{ended}\n")
}

#[cfg(test)]
mod tests {
    use lookalike::jobs::{spec::Spec, state::State};
    use prost_types::Timestamp;

    use super::*;

    #[test]
    fn a_job_is_told_with_its_attempts() {
        let at = |seconds| Some(Timestamp { seconds, nanos: 0 });
        let job = v1::Job {
            name: "jobs/7".into(),
            owner: "ann".into(),
            file_name: "a.glb".into(),
            state: convert::state_to_wire(State::Failed).into(),
            spec: Some(convert::spec_to_wire(&Spec::new(vec![500]))),
            create_time: at(0),
            labels: [("b".into(), "2".into()), ("a".into(), "1".into())].into(),
            failure: Some(v1::JobFailure {
                reason: "POISONED".into(),
                text: "three lost it".into(),
            }),
            ..v1::Job::default()
        };
        let lost = v1::Attempt {
            attempt: 1,
            host: "workers/h".into(),
            start_time: at(1),
            end_time: at(2),
            reason: "WORKER_EXITED".into(),
            text: "its process ended".into(),
            ..v1::Attempt::default()
        };
        let other = v1::Attempt { attempt: 2, end_time: None, ..lost.clone() };
        let wanted = "jobs/7  FAILED       0%  500  a.glb
  owner    ann
  created  1970-01-01T00:00:00Z
  labels   a=1 b=2
  failure  POISONED: three lost it
  attempt  2 on h, from 1970-01-01T00:00:01Z, goes on
  attempt  1 on h, from 1970-01-01T00:00:01Z to 1970-01-01T00:00:02Z: WORKER_EXITED, its process ended
";
        assert_eq!(text(&job, &[other, lost]), wanted);
    }
}
