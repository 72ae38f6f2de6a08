//! Jobs and log entries for people and for scripts.

use std::io::Write;

use lookalike::{
    jobs::{
        event::{Body, Event, Report},
        spec::{Kind, Spec},
        state::State,
    },
    service::{convert, proto::v1},
};
use serde_json::{Value, json};

/// Prints to standard output. A reader that went away (`| head`) is no error.
pub(crate) fn print(text: &str) {
    let _ = std::io::stdout().write_all(text.as_bytes());
}

/// Prints a line of a stream that goes on for nobody else: where the reader has gone, the program ends, well.
pub(crate) fn print_or_end(line: &str) {
    let broken = std::io::stdout().write_all(line.as_bytes());
    if broken.is_err_and(|e| e.kind() == std::io::ErrorKind::BrokenPipe) {
        std::process::exit(0);
    }
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
        "owner": job.owner,
        "mesh": job.mesh,
        "file_name": job.file_name,
        "labels": job.labels.into_iter().collect::<std::collections::BTreeMap<_, _>>(),
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
    let levels: Vec<_> = (0..spec.n_levels()).map(|i| level_words(&spec, i)).collect();
    let simplified = spec.simplified.as_ref().map_or("", |input| &input.file_name);
    let what = match spec.kind() {
        Kind::Simplify => levels.join(","),
        kind => format!("{} {simplified}", kind.name()),
    };
    let percent = job.fraction * 100.0;
    format!("{}  {state:<9}  {percent:>3.0}%  {what}  {}\n", job.name, job.file_name)
}

/// What a level goes by, such as `500`, `0.25` or `d2<=2.5%+300px`.
fn level_words(spec: &Spec, level: usize) -> String {
    let budget = spec.level_budgets()[level];
    let share = spec.ratios.get(level).filter(|share| **share > 0.0);
    let words = [
        budget.triangles.map(|n| n.to_string()),
        share.map(ToString::to_string),
        budget.max_d2.map(|d2| format!("d2<={d2}%")),
        budget.screen_size.map(|pixels| format!("{pixels}px")),
        budget.max_bytes.map(|n| format!("{n}B")),
    ];
    words.into_iter().flatten().collect::<Vec<_>>().join("+")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_are_told_by_what_they_go_by() {
        let mut spec = Spec { max_d2: vec![2.5], ..Spec::new(vec![500, 0]) };
        spec.screen_size = vec![0.0, 300.0];
        assert_eq!([0, 1].map(|i| level_words(&spec, i)), ["500+d2<=2.5%", "d2<=2.5%+300px"]);
        let spec = Spec { ratios: vec![0.25], max_bytes: vec![9000], ..Spec::new(Vec::new()) };
        assert_eq!(level_words(&spec, 0), "0.25+9000B");
    }

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
