//! Jobs and log entries for people and for scripts.

use std::io::Write;

use lookalike::{
    jobs::{
        event::{Body, Event, Report},
        state::State,
    },
    service::{convert, proto::v1},
};
use serde_json::{Value, json};

/// Prints to standard output. A reader that went away (`| head`) is no error.
pub(crate) fn print(text: &str) {
    let _ = std::io::stdout().write_all(text.as_bytes());
}

/// The state of a job from the wire.
pub(crate) fn state_of(job: &v1::Job) -> Option<State> {
    convert::state_from_wire(job.state)
}

/// A job as one JSON object.
pub(crate) fn job_json(job: v1::Job) -> Value {
    let state = state_of(&job).map_or("UNKNOWN", State::name);
    let time = |time: Option<&prost_types::Timestamp>| time.map(convert::time_from_wire);
    json!({
        "name": job.name,
        "mesh": job.mesh,
        "file_name": job.file_name,
        "state": state,
        "stage": job.stage,
        "fraction": job.fraction,
        "attempt": job.attempt,
        "last_seq": job.last_seq,
        "cancel_requested": job.cancel_requested,
        "created_ms": time(job.create_time.as_ref()),
        "started_ms": time(job.start_time.as_ref()),
        "ended_ms": time(job.end_time.as_ref()),
        "failure": job.failure.map(|f| json!({"reason": f.reason, "text": f.text})),
        "spec": convert::spec_from_wire(job.spec).0,
    })
}

/// A log entry as one JSON object; of records only their number and size.
pub(crate) fn event_json(event: &Event) -> Value {
    let mut value = serde_json::to_value(&event.body).unwrap_or_default();
    if let Value::Object(fields) = &mut value {
        fields.insert("seq".into(), event.seq.into());
        fields.insert("epoch".into(), event.epoch.into());
        fields.insert("at_ms".into(), event.at_ms.into());
        if let Body::Worker(Report::Records { bytes, .. }) = &event.body {
            fields.insert("size".into(), bytes.len().into());
        }
    }
    value
}

/// A job as one line of a table.
pub(crate) fn job_line(job: &v1::Job) -> String {
    let state = state_of(job).map_or("UNKNOWN", State::name);
    let spec = convert::spec_from_wire(job.spec.clone()).0;
    let triangles = spec.triangles.iter().map(ToString::to_string);
    let shares = spec.ratios.iter().map(ToString::to_string);
    let levels: Vec<_> = triangles.chain(shares).collect();
    let what = spec.simplified.map_or_else(|| levels.join(","), |i| i.file_name);
    let percent = job.fraction * 100.0;
    format!("{}  {state:<9}  {percent:>3.0}%  {what}  {}\n", job.name, job.file_name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entries_become_flat_objects() {
        let body =
            Body::Worker(Report::Records { level: None, first: 3, count: 2, bytes: vec![0; 9] });
        let value = event_json(&Event { seq: 7, epoch: 1, at_ms: 5, body });
        let wanted = json!({
            "kind": "records", "first": 3, "count": 2, "size": 9, "seq": 7, "epoch": 1, "at_ms": 5
        });
        assert_eq!(value, wanted);
    }
}
