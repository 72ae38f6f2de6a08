//! Routes and the methods that they call: the one table.

use http::Method;

use super::{
    ROOT,
    fault::{Fault, Result},
};

/// What an answer is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Answer {
    /// The method's answer, as JSON.
    Message,
    /// Each message of the stream, as a Server-Sent Event.
    Events,
    /// The bytes of the stream, or a range of them.
    File,
    /// The method's answer, as JSON; the body is a file.
    Upload,
}

#[derive(Debug)]
struct Route {
    verb: Method,
    /// What is named, below the root; each `*` stands for an id or a file name.
    resource: &'static str,
    /// What follows it.
    suffix: &'static str,
    /// The field of the request that takes the resource's name; empty for none.
    field: &'static str,
    method: &'static str,
    answer: Answer,
}

const fn row(
    verb: Method,
    (resource, suffix): (&'static str, &'static str),
    field: &'static str,
    method: &'static str,
    answer: Answer,
) -> Route {
    Route { verb, resource, suffix, field, method, answer }
}

#[rustfmt::skip]
const ROUTES: &[Route] = &[
    row(Method::GET,    ("",                   "jobs"),       "",       "ListJobs",      Answer::Message),
    row(Method::POST,   ("",                   "jobs"),       "",       "CreateJob",     Answer::Message),
    row(Method::GET,    ("jobs/*",             ""),           "name",   "GetJob",        Answer::Message),
    row(Method::DELETE, ("jobs/*",             ""),           "name",   "DeleteJob",     Answer::Message),
    row(Method::POST,   ("jobs/*",             ":pin"),       "name",   "PinJob",        Answer::Message),
    row(Method::POST,   ("jobs/*",             ":retry"),     "name",   "RetryJob",      Answer::Message),
    row(Method::POST,   ("jobs/*",             ":cancel"),    "name",   "CancelJob",     Answer::Message),
    row(Method::GET,    ("jobs/*",             "/events"),    "name",   "WatchJob",      Answer::Events),
    row(Method::GET,    ("jobs/*",             "/artifacts"), "parent", "ListArtifacts", Answer::Message),
    row(Method::GET,    ("jobs/*/artifacts/*", ""),           "name",   "ReadArtifact",  Answer::File),
    row(Method::POST,   ("",                   "meshes"),     "",       "UploadMesh",    Answer::Upload),
    row(Method::GET,    ("meshes/*",           ":upload"),    "mesh",   "QueryUpload",   Answer::Message),
    row(Method::GET,    ("",                   "workers"),    "",       "ListWorkers",   Answer::Message),
    row(Method::POST,   ("workers/*",          ":drain"),    "name",   "DrainWorker",   Answer::Message),
    row(Method::POST,   ("workers/*",          ":reinstate"), "name",   "ReinstateWorker", Answer::Message),
];

/// A route, and what its path names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Found<'a> {
    pub method: &'static str,
    pub field: &'static str,
    pub resource: &'a str,
    pub answer: Answer,
    /// It may change something.
    pub is_write: bool,
}

/// The route of a request. HEAD is GET without a body.
pub(super) fn find<'a>(verb: &Method, path: &'a str) -> Result<Found<'a>> {
    let verb = if verb == Method::HEAD { &Method::GET } else { verb };
    let below = path.strip_prefix(ROOT).unwrap_or_default();
    let fits = |route: &&Route| {
        below.strip_suffix(route.suffix).is_some_and(|name| is_named(route.resource, name))
    };
    let here: Vec<_> = ROUTES.iter().filter(fits).collect();
    if here.is_empty() {
        return Err(Fault::no_route(path));
    }
    let Some(route) = here.iter().find(|route| route.verb == verb) else {
        let verbs: Vec<_> = here.iter().map(|route| route.verb.as_str()).collect();
        return Err(Fault::no_verb(&verbs.join(", ")));
    };
    Ok(Found {
        method: route.method,
        field: route.field,
        resource: below.strip_suffix(route.suffix).unwrap_or_default(),
        answer: route.answer,
        is_write: verb != Method::GET,
    })
}

fn is_named(pattern: &str, name: &str) -> bool {
    let is_safe = |c: u8| c.is_ascii_alphanumeric() || b"._-".contains(&c);
    let fits = |(wanted, given): (&str, &str)| match wanted {
        "*" => !given.is_empty() && given.bytes().all(is_safe),
        wanted => wanted == given,
    };
    pattern.split('/').count() == name.split('/').count()
        && pattern.split('/').zip(name.split('/')).all(fits)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_find_their_methods() {
        let table = [
            ("GET", "/api/v1/jobs", Ok(("ListJobs", ""))),
            ("HEAD", "/api/v1/jobs", Ok(("ListJobs", ""))),
            ("POST", "/api/v1/jobs", Ok(("CreateJob", ""))),
            ("GET", "/api/v1/jobs/0a", Ok(("GetJob", "jobs/0a"))),
            ("DELETE", "/api/v1/jobs/0a", Ok(("DeleteJob", "jobs/0a"))),
            ("POST", "/api/v1/jobs/0a:cancel", Ok(("CancelJob", "jobs/0a"))),
            ("POST", "/api/v1/jobs/0a:retry", Ok(("RetryJob", "jobs/0a"))),
            ("POST", "/api/v1/jobs/0a:pin", Ok(("PinJob", "jobs/0a"))),
            ("GET", "/api/v1/jobs/0a/events", Ok(("WatchJob", "jobs/0a"))),
            ("GET", "/api/v1/jobs/0a/artifacts", Ok(("ListArtifacts", "jobs/0a"))),
            (
                "GET",
                "/api/v1/jobs/0a/artifacts/a-0.glb",
                Ok(("ReadArtifact", "jobs/0a/artifacts/a-0.glb")),
            ),
            ("POST", "/api/v1/meshes", Ok(("UploadMesh", ""))),
            ("GET", "/api/v1/meshes/0a:upload", Ok(("QueryUpload", "meshes/0a"))),
            ("GET", "/api/v1/workers", Ok(("ListWorkers", ""))),
            ("POST", "/api/v1/workers/a-0:drain", Ok(("DrainWorker", "workers/a-0"))),
            ("POST", "/api/v1/workers/a-0:reinstate", Ok(("ReinstateWorker", "workers/a-0"))),
            ("GET", "/api/v1/", Err(404)),
            ("GET", "/api/v1/jobs/", Err(404)),
            ("GET", "/api/v1/jobs/0a/", Err(404)),
            ("GET", "/api/v1/jobs/a%2Fb", Err(404)),
            ("GET", "/api/v1/jobs/0a/artifacts/", Err(404)),
            ("GET", "/api/v1/jobs/0a/artifacts/a/b", Err(404)),
            ("GET", "/api/v1/jobs/0a:cancel", Err(405)),
            ("PUT", "/api/v1/jobs", Err(405)),
        ];
        for (verb, path, wanted) in table {
            let found = find(&verb.parse().unwrap(), path);
            let found = found.map(|found| (found.method, found.resource));
            assert_eq!(found.map_err(|f| f.response().status().as_u16()), wanted, "{verb} {path}");
        }
    }
}
