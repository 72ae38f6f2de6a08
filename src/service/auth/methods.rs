//! What each method of each service asks of its caller: the one table.

use crate::jobs::principal::Act;

/// Who may call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Need {
    /// Anybody, known or not.
    Nothing,
    /// Anybody who is known.
    Known,
    /// Whose role may do this.
    May(Act),
}

/// What is written about a call that was not refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Audit {
    /// Nothing: it changes nothing, or a job's own log tells of it.
    No,
    /// An entry.
    Yes,
}

/// What a method asks.
#[derive(Debug)]
pub(super) struct Method {
    /// Its path.
    pub path: &'static str,
    /// Who may call it.
    pub need: Need,
    /// What is written about it.
    pub audit: Audit,
    /// It may stay open for long: a principal may have only so many.
    pub is_stream: bool,
}

const READ: Need = Need::May(Act::Read);
const WRITE: Need = Need::May(Act::Write);
const WORK: Need = Need::May(Act::Work);
const MANAGE: Need = Need::May(Act::Manage);

const fn row(path: &'static str, need: Need, audit: Audit, is_stream: bool) -> Method {
    Method { path, need, audit, is_stream }
}

#[rustfmt::skip]
const METHODS: &[Method] = &[
    row("/lookalike.v1.LookalikeService/UploadMesh",        WRITE, Audit::Yes,   true),
    row("/lookalike.v1.LookalikeService/QueryUpload",       WRITE, Audit::No,    false),
    row("/lookalike.v1.LookalikeService/CreateJob",         WRITE, Audit::Yes,   false),
    row("/lookalike.v1.LookalikeService/GetJob",            READ,  Audit::No,    false),
    row("/lookalike.v1.LookalikeService/ListJobs",          READ,  Audit::No,    false),
    row("/lookalike.v1.LookalikeService/WatchJob",          READ,  Audit::No,    true),
    row("/lookalike.v1.LookalikeService/CancelJob",         WRITE, Audit::Yes,   false),
    row("/lookalike.v1.LookalikeService/RetryJob",          WRITE, Audit::Yes,   false),
    row("/lookalike.v1.LookalikeService/PinJob",            WRITE, Audit::Yes,   false),
    row("/lookalike.v1.LookalikeService/DeleteJob",         WRITE, Audit::Yes,   false),
    row("/lookalike.v1.LookalikeService/ListArtifacts",     READ,  Audit::No,    false),
    row("/lookalike.v1.LookalikeService/ReadArtifact",      READ,  Audit::No,    true),
    row("/lookalike.v1.LookalikeService/ListWorkers",       MANAGE, Audit::No,   false),
    row("/lookalike.v1.LookalikeService/DrainWorker",       MANAGE, Audit::Yes,  false),
    row("/lookalike.v1.LookalikeService/ReinstateWorker",   MANAGE, Audit::Yes,  false),
    row("/lookalike.worker.v1.WorkerService/Claim",         WORK,  Audit::No,    false),
    row("/lookalike.worker.v1.WorkerService/Heartbeat",     WORK,  Audit::No,    false),
    row("/lookalike.worker.v1.WorkerService/FetchMesh",     WORK,  Audit::No,    false),
    row("/lookalike.worker.v1.WorkerService/AppendEvents",  WORK,  Audit::No,    false),
    row("/lookalike.worker.v1.WorkerService/PutArtifact",   WORK,  Audit::No,    false),
    row("/lookalike.worker.v1.WorkerService/PutCheckpoint",   WORK, Audit::No,  false),
    row("/lookalike.worker.v1.WorkerService/FetchCheckpoint", WORK, Audit::No,  false),
    row("/lookalike.worker.v1.WorkerService/Complete",      WORK,  Audit::Yes,   false),
    row("/lookalike.worker.v1.WorkerService/Leave",         WORK,  Audit::No,    false),
    row("/grpc.health.v1.Health/Check",                     Need::Nothing, Audit::No, false),
    row("/grpc.health.v1.Health/Watch",                     Need::Nothing, Audit::No, false),
];

/// Methods that have no row, such as reflection and those that do not exist, are for the known.
const OTHER: Method = row("", Need::Known, Audit::No, false);

/// The row of a method.
pub(super) fn method(path: &str) -> &'static Method {
    METHODS.iter().find(|method| method.path == path).unwrap_or(&OTHER)
}

#[cfg(test)]
mod tests {
    use prost::Message;
    use prost_types::FileDescriptorSet;

    use super::*;
    use crate::service::proto::DESCRIPTORS;

    #[test]
    fn every_method_of_both_services_has_a_row_of_its_own() {
        let files = FileDescriptorSet::decode(DESCRIPTORS).unwrap().file;
        let mut paths = Vec::new();
        for file in files.iter().filter(|file| file.package().starts_with("lookalike")) {
            for service in &file.service {
                let path = |m: &prost_types::MethodDescriptorProto| {
                    format!("/{}.{}/{}", file.package(), service.name(), m.name())
                };
                paths.extend(service.method.iter().map(path));
            }
        }
        assert_eq!(paths.len(), 24, "{paths:?}");
        for path in paths {
            assert!(matches!(method(&path).need, Need::May(_)), "{path} has no row");
        }
        assert_eq!(method("/lookalike.v1.LookalikeService/Nothing").need, Need::Known);
    }
}
