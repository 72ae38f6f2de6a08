//! Flags of who is called when a job ends.

use clap::Args;
use lookalike::service::{
    auth::Secret,
    webhook::{HostPattern, SigningKey, WebhookRules},
};

/// Flags of `lookalike serve` about webhooks.
#[derive(Args, Clone, Debug)]
pub(crate) struct WebhookArgs {
    /// Signs webhooks, without which there are none: whsec_ and 24 to 64 bytes in base64. Better given by the
    /// environment or a file: others can read command lines.
    #[arg(
        long = "webhook-secret",
        env = "LOOKALIKE_WEBHOOK_SECRET",
        hide_env_values = true,
        value_name = "SECRET"
    )]
    secret: Option<Secret>,
    /// Called when a job ends that names nobody.
    #[arg(
        long = "webhook-url",
        env = "LOOKALIKE_WEBHOOK_URL",
        hide_env_values = true,
        value_name = "URL"
    )]
    url: Option<String>,
    /// Hosts that jobs may have called: HOST, or *.HOST for all below it.
    #[arg(
        long = "webhook-allow",
        env = "LOOKALIKE_WEBHOOK_ALLOW",
        value_delimiter = ',',
        value_name = "HOST"
    )]
    allow: Vec<HostPattern>,
    /// Call private addresses and this machine too, and http://.
    #[arg(long = "webhook-allow-private", env = "LOOKALIKE_WEBHOOK_ALLOW_PRIVATE")]
    allow_private: bool,
}

impl WebhookArgs {
    /// The rules; adds what is wrong with them to `faults`.
    pub(super) fn check(self, faults: &mut Vec<String>) -> WebhookRules {
        let given = self.secret.filter(|secret| !secret.reveal().is_empty());
        let is_given = given.is_some();
        let key = given.map(|secret| SigningKey::parse(secret.reveal()));
        let key = key.and_then(|key| {
            key.map_err(|text| faults.push(format!("--webhook-secret: {text}"))).ok()
        });
        let rules = WebhookRules {
            default_url: self.url.filter(|url| !url.is_empty()),
            allow: self.allow,
            allow_private: self.allow_private,
            key,
        };
        if !is_given && (rules.default_url.is_some() || !rules.allow.is_empty()) {
            let text = "without --webhook-secret nobody is called";
            faults.push(format!("--webhook-url and --webhook-allow: {text}"));
        }
        let url = rules.default_url.clone();
        if let Some(fault) = url.and_then(|url| rules.check(&url).err()) {
            faults.push(format!("--webhook-url: {fault}"));
        }
        rules
    }
}
