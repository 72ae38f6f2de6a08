//! Log entries, to and from the wire.

use super::{state_from_wire, state_to_wire, time_from_wire, time_to_wire, v1, worker};
use crate::jobs::event::{Body, EnergySample, Event, MoveCount, Report, ServerEvent};

/// A log entry on the wire.
pub fn event_to_wire(event: Event) -> v1::JobEvent {
    let body = match event.body {
        Body::Server(body) => server_to_wire(body),
        Body::Worker(report) => client_side(report_to_wire(report)),
    };
    let time = Some(time_to_wire(event.at_ms));
    v1::JobEvent { seq: event.seq, epoch: event.epoch, time, body: Some(body) }
}

/// A log entry from the wire; `None` when this version does not know what it tells.
pub fn event_from_wire(event: v1::JobEvent) -> Option<Event> {
    let body = match event.body? {
        v1::job_event::Body::StateChanged(body) => Body::Server(ServerEvent::StateChanged {
            state: state_from_wire(body.state)?,
            reason: body.reason,
            text: body.text,
            attempt: body.attempt,
            worker: body.worker,
        }),
        v1::job_event::Body::AttemptRestarted(body) => Body::Server(ServerEvent::Restarted {
            rewind_to_seq: body.rewind_to_seq,
            lost_attempt: body.lost_attempt,
            reason: body.reason,
            text: body.text,
        }),
        report => Body::Worker(report_from_wire(worker_side(report)?)),
    };
    let at_ms = event.time.as_ref().map_or(0, time_from_wire);
    Some(Event { seq: event.seq, epoch: event.epoch, at_ms, body })
}

fn server_to_wire(event: ServerEvent) -> v1::job_event::Body {
    match event {
        ServerEvent::StateChanged { state, reason, text, attempt, worker } => {
            let state = state_to_wire(state).into();
            let body = v1::StateChanged { state, reason, text, attempt, worker };
            v1::job_event::Body::StateChanged(body)
        }
        ServerEvent::Restarted { rewind_to_seq, lost_attempt, reason, text } => {
            let body = v1::AttemptRestarted { rewind_to_seq, lost_attempt, reason, text };
            v1::job_event::Body::AttemptRestarted(body)
        }
    }
}

/// A report on the wire. Numbers that are none are left out: they could not be stored.
pub fn report_to_wire(report: Report) -> worker::worker_event::Body {
    use worker::worker_event::Body as Wire;
    match report {
        Report::Note { code, text } => Wire::Note(v1::Note { code, text }),
        Report::Progress { stage, fraction, eta_secs } => {
            Wire::Progress(v1::Progress { stage, fraction: finite(fraction), eta_secs })
        }
        Report::Sample(sample) => Wire::EnergySample(v1::EnergySample {
            stage: sample.stage,
            evaluations: sample.evaluations,
            seconds: finite(sample.seconds),
            triangles: sample.triangles,
            energy: sample.energy,
            d2: sample.d2,
            level: sample.level,
            energy_ratio: sample.energy_ratio,
            d2_unseen: sample.d2_unseen,
            turn: sample.turn,
        }),
        Report::Moves { level, moves } => Wire::MoveStatistics(v1::MoveStatistics {
            level,
            moves: moves.into_iter().map(count_to_wire).collect(),
        }),
        Report::Records { level, first, count, bytes } => {
            Wire::RecordChunk(v1::RecordChunk { level, first, count, data: bytes.into() })
        }
        Report::Artifact { name, media_type, size } => {
            Wire::ArtifactStored(v1::ArtifactStored { file: name, media_type, size })
        }
    }
}

/// A report from the wire.
pub fn report_from_wire(body: worker::worker_event::Body) -> Report {
    use worker::worker_event::Body as Wire;
    let present = |number: &f64| number.is_finite();
    match body {
        Wire::Note(v1::Note { code, text }) => Report::Note { code, text },
        Wire::Progress(body) => Report::Progress {
            stage: body.stage,
            fraction: finite(body.fraction),
            eta_secs: body.eta_secs.filter(present),
        },
        Wire::EnergySample(body) => Report::Sample(EnergySample {
            stage: body.stage,
            evaluations: body.evaluations,
            seconds: finite(body.seconds),
            triangles: body.triangles,
            energy: body.energy,
            d2: body.d2.filter(present),
            level: body.level,
            energy_ratio: body.energy_ratio.filter(present),
            d2_unseen: body.d2_unseen.filter(present),
            turn: body.turn,
        }),
        Wire::MoveStatistics(body) => Report::Moves {
            level: body.level,
            moves: body.moves.into_iter().map(count_from_wire).collect(),
        },
        Wire::RecordChunk(v1::RecordChunk { level, first, count, data }) => {
            Report::Records { level, first, count, bytes: data.into() }
        }
        Wire::ArtifactStored(v1::ArtifactStored { file, media_type, size }) => {
            Report::Artifact { name: file, media_type, size }
        }
    }
}

fn count_to_wire(count: MoveCount) -> v1::MoveCount {
    let MoveCount { name, tried, accepted, evaluations, reduction } = count;
    v1::MoveCount { name, tried, accepted, evaluations, reduction }
}

fn count_from_wire(count: v1::MoveCount) -> MoveCount {
    let v1::MoveCount { name, tried, accepted, evaluations, reduction } = count;
    MoveCount { name, tried, accepted, evaluations, reduction }
}

/// The database stores JSON, which has no NaN and no infinities.
fn finite(number: f64) -> f64 {
    if number.is_finite() { number } else { 0.0 }
}

fn client_side(body: worker::worker_event::Body) -> v1::job_event::Body {
    use v1::job_event::Body as To;
    use worker::worker_event::Body as From;
    match body {
        From::Note(body) => To::Note(body),
        From::Progress(body) => To::Progress(body),
        From::EnergySample(body) => To::EnergySample(body),
        From::MoveStatistics(body) => To::MoveStatistics(body),
        From::RecordChunk(body) => To::RecordChunk(body),
        From::ArtifactStored(body) => To::ArtifactStored(body),
    }
}

fn worker_side(body: v1::job_event::Body) -> Option<worker::worker_event::Body> {
    use v1::job_event::Body as From;
    use worker::worker_event::Body as To;
    Some(match body {
        From::Note(body) => To::Note(body),
        From::Progress(body) => To::Progress(body),
        From::EnergySample(body) => To::EnergySample(body),
        From::MoveStatistics(body) => To::MoveStatistics(body),
        From::RecordChunk(body) => To::RecordChunk(body),
        From::ArtifactStored(body) => To::ArtifactStored(body),
        From::StateChanged(_) | From::AttemptRestarted(_) => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jobs::state::State;

    fn sample(d2: f64) -> EnergySample {
        EnergySample {
            stage: "image".into(),
            evaluations: 7,
            seconds: 0.1,
            triangles: 500,
            energy: Some(u64::MAX),
            d2: Some(d2),
            level: Some(1),
            energy_ratio: Some(0.5),
            d2_unseen: None,
            turn: Some(4),
        }
    }

    #[test]
    fn every_kind_of_entry_survives_the_wire() {
        let text = || "why".to_owned();
        let bodies = [
            Body::Server(ServerEvent::StateChanged {
                state: State::Running,
                reason: "CLAIMED".into(),
                text: text(),
                attempt: 2,
                worker: "w".into(),
            }),
            Body::Server(ServerEvent::Restarted {
                rewind_to_seq: 1,
                lost_attempt: 1,
                reason: "LEASE_EXPIRED".into(),
                text: text(),
            }),
            Body::Worker(Report::Note { code: "READ".into(), text: text() }),
            Body::Worker(Report::Progress {
                stage: "image".into(),
                fraction: 0.25,
                eta_secs: Some(3.0),
            }),
            Body::Worker(Report::Sample(sample(1.5))),
            Body::Worker(Report::Moves {
                level: 1,
                moves: vec![MoveCount {
                    name: "swap 1".into(),
                    tried: 9,
                    accepted: 2,
                    evaluations: 90,
                    reduction: -7,
                }],
            }),
            Body::Worker(Report::Records {
                level: Some(0),
                first: 3,
                count: 2,
                bytes: vec![1, 2, 3],
            }),
            Body::Worker(Report::Artifact {
                name: "lod-0.glb".into(),
                media_type: "model/gltf-binary".into(),
                size: 9,
            }),
        ];
        for (i, body) in bodies.into_iter().enumerate() {
            let event = Event { seq: i as u64 + 1, epoch: 2, at_ms: 1234, body };
            assert_eq!(event_from_wire(event_to_wire(event.clone())), Some(event));
        }
    }

    #[test]
    fn numbers_that_are_none_are_left_out() {
        let wire = report_to_wire(Report::Sample(sample(f64::NAN)));
        let Report::Sample(read) = report_from_wire(wire) else { panic!("another kind") };
        assert_eq!(read.d2, None);
    }
}
