//! Webhooks: an address that is called when a job has ended, signed (as <https://www.standardwebhooks.com> has it),
//! and called again until it is heard.
//!
//! 1. What is to be called stands in the database since the job was created; a server that dies on the way loses
//!    nothing. Receivers know repetitions by `webhook-id`.
//! 2. Only hosts that the configuration names are called, and only at public addresses unless it says otherwise:
//!    each address that a name resolves to is looked at, and the connection goes to what was looked at.
//! 3. Addresses may hold secrets: logs name the host alone. Answers are not read beyond their status.

mod address;
mod sign;

use std::{sync::Arc, time::Duration};

use futures::{StreamExt, stream};
use reqwest::{
    Client, StatusCode, Url,
    dns::{Addrs, Name, Resolve, Resolving},
    redirect::Policy,
};
use serde_json::json;
use tokio_util::sync::CancellationToken;

use self::address::is_public;
use super::{convert, web::Shapes};
use crate::jobs::{
    Jobs,
    store::{CallEnd, DueCall},
};

pub use self::{address::HostPattern, sign::SigningKey};

/// The database is asked this often for calls that are due.
const POLL: Duration = Duration::from_millis(500);
/// Calls at a time, and calls that are taken at a time.
const AT_ONCE: usize = 32;
const TAKEN: u32 = 8;
/// What an attempt may take, and for how long it is this server's: longer.
const TIMEOUT: Duration = Duration::from_secs(10);
const HELD_FOR: Duration = Duration::from_mins(1);
/// Pauses between attempts: the first, by how much each is longer, the longest; all in all 15 hours.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
const GROWTH: u32 = 3;
const LONGEST_PAUSE: Duration = Duration::from_hours(3);
const MAX_ATTEMPTS: u32 = 14;
const MAX_URL: usize = 2048;

/// Whom jobs may have called, and how calls are signed.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct WebhookRules {
    /// Called for jobs that name nobody.
    pub default_url: Option<String>,
    /// Whom jobs may name.
    pub allow: Vec<HostPattern>,
    /// Also addresses of this machine and of private networks, and without encryption.
    pub allow_private: bool,
    /// Signs calls. Without it there are none.
    pub key: Option<SigningKey>,
}

impl WebhookRules {
    /// What is wrong with the address that a job names, if anything.
    pub fn fault(&self, url: &str) -> Option<String> {
        if self.key.is_none() {
            return Some(
                "this server calls nobody: it was started without --webhook-secret".into(),
            );
        }
        self.check(url).err()
    }

    /// Whom to call for a job that names `asked`, or nobody.
    pub fn url_for(&self, asked: String) -> String {
        if asked.is_empty() { self.default_url.clone().unwrap_or_default() } else { asked }
    }

    /// Whether an address may be called.
    pub fn check(&self, url: &str) -> Result<Url, String> {
        let parsed: Url = url.parse().map_err(|error| format!("it is no URL ({error})"))?;
        let schemes: &[&str] = if self.allow_private { &["https", "http"] } else { &["https"] };
        if !schemes.contains(&parsed.scheme()) {
            return Err(format!("use {}://", schemes.join(":// or ")));
        }
        if url.len() > MAX_URL || !parsed.username().is_empty() || parsed.password().is_some() {
            return Err(format!("use at most {MAX_URL} bytes, and no user or password"));
        }
        let host = parsed.host_str().unwrap_or_default().to_owned();
        let is_default = self.default_url.as_deref() == Some(url);
        if !is_default && !self.allow.iter().any(|pattern| pattern.fits(&host)) {
            return Err(format!("the host `{host}` is not among those of --webhook-allow"));
        }
        let bare = host.trim_start_matches('[').trim_end_matches(']');
        let is_private = bare.parse().is_ok_and(|address| !is_public(address));
        if is_private && !self.allow_private {
            return Err(format!("{host} is no public address: see --webhook-allow-private"));
        }
        Ok(parsed)
    }
}

/// The client cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum WebhookError {
    /// TLS, most likely: the system trusts nobody.
    #[error("webhooks cannot be called: {0}; install the system's certificates (ca-certificates)")]
    Client(reqwest::Error),
    /// The protos and the binary disagree.
    #[error("webhooks cannot be written: {0}")]
    Descriptors(#[from] prost_reflect::DescriptorError),
}

/// Makes the calls that are due, until `shutdown`. What is under way then is made again by the next server.
pub async fn run(
    jobs: Jobs,
    rules: WebhookRules,
    shutdown: CancellationToken,
) -> Result<(), WebhookError> {
    let Some(key) = rules.key.clone() else {
        shutdown.cancelled().await;
        return Ok(());
    };
    let caller = Caller { client: client(&rules)?, shapes: Shapes::read()?, jobs, rules, key };
    // Some wait here for a place, for less time than they are held; the others where everybody finds them.
    let due = stream::repeat(()).then(|()| caller.take()).map(stream::iter).flatten();
    tokio::select! {
        () = due.for_each_concurrent(AT_ONCE, |call| caller.call(call)) => {}
        () = shutdown.cancelled() => {}
    }
    Ok(())
}

fn client(rules: &WebhookRules) -> Result<Client, WebhookError> {
    // Fails only when there is one already.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let resolver = Arc::new(Resolver { allow_private: rules.allow_private });
    let client = Client::builder()
        .user_agent(concat!("lookalike/", env!("CARGO_PKG_VERSION")))
        .redirect(Policy::none())
        .no_proxy()
        .dns_resolver(resolver)
        .timeout(TIMEOUT)
        // Calls are rare: a connection that waits is one that has ended.
        .pool_max_idle_per_host(0)
        .build();
    client.map_err(WebhookError::Client)
}

/// Names only what may be called: what a name resolves to is looked at here, and nowhere later.
#[derive(Debug)]
struct Resolver {
    allow_private: bool,
}

impl Resolve for Resolver {
    fn resolve(&self, name: Name) -> Resolving {
        let allow_private = self.allow_private;
        Box::pin(async move {
            let found = tokio::net::lookup_host((name.as_str(), 0)).await?;
            let may_be_called = |ip| allow_private || is_public(ip);
            let found: Vec<_> = found.filter(|address| may_be_called(address.ip())).collect();
            if found.is_empty() {
                return Err("it has no public address: see --webhook-allow-private".into());
            }
            Ok(Box::new(found.into_iter()) as Addrs)
        })
    }
}

struct Caller {
    client: Client,
    shapes: Shapes,
    jobs: Jobs,
    rules: WebhookRules,
    key: SigningKey,
}

impl Caller {
    /// Calls that are due; after a while, if there are none.
    async fn take(&self) -> Vec<DueCall> {
        let due = self.jobs.take_calls(TAKEN, HELD_FOR).await.unwrap_or_else(|error| {
            tracing::error!(%error, "webhooks cannot be looked up");
            Vec::new()
        });
        if due.is_empty() {
            tokio::time::sleep(POLL).await;
        }
        due
    }

    /// Makes one attempt, and notes how it ended.
    async fn call(&self, call: DueCall) {
        // Rules may have changed since the job was created.
        let (host, answer) = match self.rules.check(&call.url) {
            Err(fault) => (String::new(), Err(fault)),
            Ok(url) => {
                let host = url.host_str().unwrap_or_default().to_owned();
                (host, self.send(&call, url).await)
            }
        };
        let end = verdict(answer, call.attempt);
        let (outcome, why) = match &end {
            CallEnd::Delivered => ("DELIVERED", ""),
            CallEnd::Again(why, _) => ("FAILED", why.as_str()),
            CallEnd::GivenUp(why) => ("GIVEN_UP", why.as_str()),
        };
        metrics::counter!("lookalike_webhooks_total", "outcome" => outcome).increment(1);
        let (job, attempt) = (&call.job.id, call.attempt);
        tracing::info!(job, host, attempt, outcome, why, "webhook");
        if let Err(error) = self.jobs.end_call(&call, &end).await {
            tracing::error!(job, %error, "the end of a webhook cannot be noted: it is called again");
        }
    }

    async fn send(&self, call: &DueCall, url: Url) -> Result<StatusCode, String> {
        let job = convert::job_to_wire(&call.job);
        let job = self.shapes.json("lookalike.v1.Job", &job).map_err(|e| e.to_string())?;
        let body = json!({"type": "job.ended", "timestamp": job["endTime"], "data": {"job": job}});
        let body = body.to_string();
        let signed = self.key.sign(&call.id, sign::now_secs(), &body);
        let request = self.client.post(url).header("content-type", "application/json").body(body);
        let request =
            signed.iter().fold(request, |request, (name, value)| request.header(*name, value));
        let answer = request.send().await.map_err(|error| causes(&error.without_url()))?;
        Ok(answer.status())
    }
}

/// An error and what led to it.
fn causes(error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(Some(error), |error| error.source());
    causes.map(ToString::to_string).collect::<Vec<_>>().join(": ")
}

fn verdict(answer: Result<StatusCode, String>, attempt: u32) -> CallEnd {
    let why = match answer {
        Ok(status) if status.is_success() => return CallEnd::Delivered,
        // Whoever was there wants no more of it.
        Ok(StatusCode::GONE) => return CallEnd::GivenUp("it answers 410 Gone".into()),
        Ok(status) => format!("it answers {status}"),
        Err(why) => why,
    };
    if attempt >= MAX_ATTEMPTS {
        return CallEnd::GivenUp(why);
    }
    let factor = GROWTH.saturating_pow(attempt.saturating_sub(1));
    CallEnd::Again(why, FIRST_PAUSE.saturating_mul(factor).min(LONGEST_PAUSE))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rules(allow: &[&str], allow_private: bool) -> WebhookRules {
        let allow = allow.iter().map(|pattern| pattern.parse().unwrap()).collect();
        let key = Some(SigningKey::parse("whsec_MDEyMzQ1Njc4OTAxMjM0NTY3ODkwMTIz").unwrap());
        let default_url = Some("https://hooks.test/all?token=t".into());
        WebhookRules { default_url, allow, allow_private, key }
    }

    #[test]
    fn addresses_are_held_to_the_rules() {
        let named = rules(
            &["a.test", "*.b.test", "93.184.216.34", "127.0.0.1", "[::1]", "10.0.0.1"],
            false,
        );
        let private = rules(&["127.0.0.1", "[::1]", "a.test"], true);
        let table = [
            (&named, "https://a.test/x", ""),
            (&named, "https://A.test:8443/x?y", ""),
            (&named, "https://c.b.test/", ""),
            (&named, "https://93.184.216.34/", ""),
            (&named, "https://hooks.test/all?token=t", ""),
            (&named, "https://hooks.test/other", "--webhook-allow"),
            (&named, "https://b.test/", "--webhook-allow"),
            (&named, "https://evila.test/", "--webhook-allow"),
            (&named, "https://a.test@evil.test/", "no user"),
            (&named, "http://a.test/", "use https://"),
            (&named, "ftp://a.test/", "use https://"),
            (&named, "https://127.0.0.1/", "no public address"),
            // The same address by other names.
            (&named, "https://0x7f000001/", "no public address"),
            (&named, "https://2130706433/", "no public address"),
            (&named, "https://10.1/", "no public address"),
            (&named, "https://[::1]/", "no public address"),
            (&named, "nonsense", "no URL"),
            (&private, "http://127.0.0.1:8080/x", ""),
            (&private, "http://[::1]:8080/x", ""),
            (&private, "http://127.0.0.2:8080/x", "--webhook-allow"),
        ];
        for (rules, url, wanted) in table {
            let fault = rules.fault(url).unwrap_or_default();
            assert_eq!(fault.is_empty(), wanted.is_empty(), "{url}: {fault}");
            assert!(fault.contains(wanted), "{url}: {fault}");
        }
        let silent = WebhookRules { key: None, ..private };
        assert!(silent.fault("http://127.0.0.1:8080/x").unwrap().contains("--webhook-secret"));
    }

    #[tokio::test]
    async fn names_that_lead_to_private_addresses_are_not_called() {
        for (allow_private, wanted) in [(false, false), (true, true)] {
            let found = Resolver { allow_private }.resolve("localhost".parse().unwrap()).await;
            assert_eq!(found.is_ok(), wanted, "{allow_private}");
        }
    }

    #[test]
    fn pauses_grow_and_end() {
        let busy = || Ok(StatusCode::SERVICE_UNAVAILABLE);
        let pause = |attempt| match verdict(busy(), attempt) {
            CallEnd::Again(_, pause) => pause.as_secs(),
            end => panic!("{end:?}"),
        };
        let pauses: Vec<_> = (1..MAX_ATTEMPTS).map(pause).collect();
        assert_eq!(pauses[..4], [1, 3, 9, 27]);
        let hours = pauses.iter().sum::<u64>() / 3600;
        assert!(pauses.is_sorted() && (12..18).contains(&hours), "{hours} hours");
        assert!(matches!(verdict(busy(), MAX_ATTEMPTS), CallEnd::GivenUp(_)));
        assert!(matches!(verdict(Ok(StatusCode::GONE), 1), CallEnd::GivenUp(_)));
        assert_eq!(verdict(Ok(StatusCode::NO_CONTENT), 1), CallEnd::Delivered);
        // Nobody is followed to elsewhere.
        assert!(matches!(verdict(Ok(StatusCode::FOUND), 1), CallEnd::Again(..)));
    }
}
