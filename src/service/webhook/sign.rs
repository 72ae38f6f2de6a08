//! Signatures of calls, as <https://www.standardwebhooks.com> has them: HMAC-SHA256 of name, time and body.

use std::time::{SystemTime, UNIX_EPOCH};

use base64::{Engine, engine::general_purpose::STANDARD};
use ring::hmac::{HMAC_SHA256, Key, sign};

use crate::service::auth::Secret;

const PREFIX: &str = "whsec_";
/// Bytes of a secret.
const LENGTHS: std::ops::RangeInclusive<usize> = 24..=64;

/// The secret that calls are signed with: `whsec_` and 24 to 64 bytes in base64.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SigningKey(Secret);

impl SigningKey {
    /// Reads a secret; the fault does not show it.
    pub fn parse(text: &str) -> Result<Self, String> {
        let bytes = text.trim().strip_prefix(PREFIX).and_then(|text| STANDARD.decode(text).ok());
        match bytes.filter(|bytes| LENGTHS.contains(&bytes.len())) {
            Some(_) => Ok(Self(Secret::new(text.trim()))),
            None => Err("use whsec_ and what `openssl rand -base64 32` prints".into()),
        }
    }

    fn bytes(&self) -> Vec<u8> {
        let text = self.0.reveal();
        STANDARD.decode(text.strip_prefix(PREFIX).unwrap_or(text)).unwrap_or_default()
    }

    /// The headers of a call.
    pub(super) fn sign(&self, id: &str, at_secs: u64, body: &str) -> [(&'static str, String); 3] {
        let key = Key::new(HMAC_SHA256, &self.bytes());
        let tag = sign(&key, format!("{id}.{at_secs}.{body}").as_bytes());
        [
            ("webhook-id", id.into()),
            ("webhook-timestamp", at_secs.to_string()),
            ("webhook-signature", format!("v1,{}", STANDARD.encode(tag.as_ref()))),
        ]
    }
}

pub(super) fn now_secs() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signatures_are_those_of_the_standard() {
        // The example of the reference libraries.
        let key = SigningKey::parse("whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw").unwrap();
        let body = "{\"test\": 2432232314}";
        let headers = key.sign("msg_p5jXN8AQM9LWM0D4loKWxJek", 1_614_265_330, body);
        assert_eq!(headers[2].1, "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE=");
        assert!(!format!("{key:?}").contains("MfKQ"));
    }

    #[test]
    fn weak_secrets_are_refused_and_not_shown() {
        for bad in ["", "whsec_", "whsec_c2hvcnQ=", "MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw", "whsec_?"] {
            let fault = SigningKey::parse(bad).unwrap_err();
            assert!(
                fault.contains("openssl") && (bad.len() < 8 || !fault.contains(bad)),
                "{bad}: {fault}"
            );
        }
    }
}
