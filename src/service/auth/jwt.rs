//! Tokens of an identity provider: JWTs, verified against its public keys in a local JWKS file.
//!
//! RS256, ES256 and EdDSA; `exp`, `aud` and `iss` are required and checked. Keys of other kinds in the
//! file are passed over. The signatures are ring's, which TLS has anyway.

use std::sync::Once;

use jsonwebtoken::{
    Algorithm, DecodingKey, DecodingKeyKind, Validation,
    crypto::{CryptoProvider, JwtVerifier, KeyUtils},
    decode, decode_header,
    errors::{Error, ErrorKind},
    jwk::{AlgorithmParameters, Jwk, JwkSet, KeyAlgorithm},
};
use ring::signature::{
    ECDSA_P256_SHA256_FIXED, ED25519, RSA_PKCS1_2048_8192_SHA256, RsaPublicKeyComponents,
    UnparsedPublicKey,
};
use serde_json::{Map, Value};

use crate::jobs::principal::{Principal, Role, is_name};

/// What a JWT must say.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct JwtRules {
    /// The `iss` that is trusted.
    pub issuer: String,
    /// The `aud` that means this server.
    pub audience: String,
    /// The claim that names the owner.
    pub owner_claim: String,
    /// The claim that names the role.
    pub role_claim: String,
}

/// The public keys of an identity provider.
#[derive(Debug)]
pub(super) struct Keys(Vec<Key>);

#[derive(Debug)]
struct Key {
    id: Option<String>,
    algorithm: Algorithm,
    public: DecodingKey,
}

impl Keys {
    /// Reads a JWKS file's text.
    pub(super) fn parse(text: &str) -> Result<Self, String> {
        install_verifier();
        let set: JwkSet = serde_json::from_str(text).map_err(|e| format!("no JWKS: {e}"))?;
        let keys: Vec<_> = set.keys.iter().filter_map(key).collect();
        if keys.is_empty() {
            return Err("it has no public key for RS256, ES256 or EdDSA".into());
        }
        Ok(Self(keys))
    }

    /// Who a token says its bearer is, or why it is not accepted.
    pub(super) fn verify(&self, token: &str, rules: &JwtRules) -> Result<Principal, String> {
        let header = decode_header(token).map_err(|error| fault(&error))?;
        let fits = |key: &&Key| {
            key.algorithm == header.alg && (header.kid.is_none() || key.id == header.kid)
        };
        let mut last = "no key of the JWKS file fits its `kid` and `alg`".to_owned();
        for key in self.0.iter().filter(fits) {
            match decode::<Map<String, Value>>(
                token,
                &key.public,
                &validation(key.algorithm, rules),
            ) {
                Ok(data) => return principal(&data.claims, rules),
                Err(error) => last = fault(&error),
            }
        }
        Err(last)
    }
}

fn key(jwk: &Jwk) -> Option<Key> {
    let named = jwk.common.key_algorithm;
    let algorithm = match (&jwk.algorithm, named) {
        (AlgorithmParameters::RSA(_), None | Some(KeyAlgorithm::RS256)) => Algorithm::RS256,
        (AlgorithmParameters::EllipticCurve(_), None | Some(KeyAlgorithm::ES256)) => {
            Algorithm::ES256
        }
        (AlgorithmParameters::OctetKeyPair(_), None | Some(KeyAlgorithm::EdDSA)) => {
            Algorithm::EdDSA
        }
        _ => return None,
    };
    let public = DecodingKey::from_jwk(jwk).ok()?;
    Some(Key { id: jwk.common.key_id.clone(), algorithm, public })
}

fn validation(algorithm: Algorithm, rules: &JwtRules) -> Validation {
    let mut validation = Validation::new(algorithm);
    validation.set_required_spec_claims(&["exp", "iss", "aud"]);
    validation.set_issuer(&[&rules.issuer]);
    validation.set_audience(&[&rules.audience]);
    validation.validate_nbf = true;
    validation.leeway = 30;
    validation
}

fn principal(claims: &Map<String, Value>, rules: &JwtRules) -> Result<Principal, String> {
    let claim = |name: &str| {
        let text = claims.get(name).and_then(Value::as_str);
        text.ok_or_else(|| format!("it has no text `{name}`"))
    };
    let owner = claim(&rules.owner_claim)?;
    if !is_name(owner) {
        let text = "use 1 to 64 characters of [A-Za-z0-9._@:/+-]";
        return Err(format!("its `{}` names no owner: {text}", rules.owner_claim));
    }
    let role = claim(&rules.role_claim)?.parse::<Role>().map_err(|unknown| unknown.to_string())?;
    let name = claims.get("sub").and_then(Value::as_str).filter(|sub| is_name(sub));
    let name = format!("jwt:{}", name.unwrap_or(owner));
    Ok(Principal { name, owner: owner.into(), role })
}

/// Says what is wrong with a token without saying anything of it.
fn fault(error: &Error) -> String {
    match error.kind() {
        ErrorKind::ExpiredSignature => "it has expired: get a new one".into(),
        ErrorKind::ImmatureSignature => "it is not valid yet".into(),
        ErrorKind::InvalidIssuer => "its issuer (`iss`) is not the one trusted here".into(),
        ErrorKind::InvalidAudience => "it is for another audience (`aud`)".into(),
        ErrorKind::MissingRequiredClaim(claim) => format!("it has no `{claim}`"),
        ErrorKind::InvalidSignature => "its signature does not verify".into(),
        _ => "it is no JWT of RS256, ES256 or EdDSA".into(),
    }
}

/// Verifies what ring can verify; there is nothing here that signs.
static RING: CryptoProvider = CryptoProvider {
    signer_factory: |_, _| Err(ErrorKind::InvalidAlgorithm.into()),
    verifier_factory: |algorithm, key| {
        Ok(Box::new(RingVerifier { algorithm: *algorithm, key: key.clone() }))
    },
    key_utils: KeyUtils::new_unimplemented(),
};

fn install_verifier() {
    static ONCE: Once = Once::new();
    // Only fails when it is installed already.
    ONCE.call_once(|| {
        let _ = RING.install_default();
    });
}

struct RingVerifier {
    algorithm: Algorithm,
    key: DecodingKey,
}

impl jsonwebtoken::signature::Verifier<Vec<u8>> for RingVerifier {
    fn verify(
        &self,
        message: &[u8],
        signature: &Vec<u8>,
    ) -> Result<(), jsonwebtoken::signature::Error> {
        let verified = match (self.algorithm, self.key.kind()) {
            (Algorithm::RS256, DecodingKeyKind::RsaModulusExponent { n, e }) => {
                let key = RsaPublicKeyComponents { n, e };
                key.verify(&RSA_PKCS1_2048_8192_SHA256, message, signature)
            }
            (Algorithm::ES256, DecodingKeyKind::SecretOrDer(point)) => {
                UnparsedPublicKey::new(&ECDSA_P256_SHA256_FIXED, point).verify(message, signature)
            }
            (Algorithm::EdDSA, DecodingKeyKind::SecretOrDer(point)) => {
                UnparsedPublicKey::new(&ED25519, point).verify(message, signature)
            }
            _ => Err(ring::error::Unspecified),
        };
        verified.map_err(|_| jsonwebtoken::signature::Error::new())
    }
}

impl JwtVerifier for RingVerifier {
    fn algorithm(&self) -> Algorithm {
        self.algorithm
    }
}

#[cfg(test)]
mod tests {
    use base64::{Engine, engine::general_purpose::URL_SAFE_NO_PAD};
    use ring::{
        rand::SystemRandom,
        signature::{ECDSA_P256_SHA256_FIXED_SIGNING, EcdsaKeyPair, Ed25519KeyPair, KeyPair},
    };
    use serde_json::json;

    use super::*;

    /// An RSA key and what it signed (OpenSSL; nobody has its private half any more): issuer `i`,
    /// audience `a`, until the year 2100, owner `ann`, role `viewer`.
    const RSA_N: &str = "5VkD60_mbK6vGBhDIxX8sawhcQYoR9t51r4zvb-OdeMp7Sehqyt8oLsUijZiyT7fDf4pAY0T6BYUFYEqP_cu\
        5W_hzFkdoLt9rsX9o450rdBuY7wwdQjt2UhXYCJfz9BrJ2zfFdl1PVgvjY9OHgbEbC8szPkXaMPw2z7Zu2-p\
        yAQ31RL-zn-mJWDAflLN8vy_VKsSCuDv5rZMgPLFkCh9C7D6CAyfU2rDHqacV-px1YcXjzXAzzOjUDFo9yit\
        VDBV4DD2I4qgAkIEnL2TKTbwp21A0ymABkV_JrYfGFIASoJ8QEN_NgQPN26CxQjEXTCtNNkbvgPW1nmM5NJ3\
        SW2a7w";
    const RSA_TOKEN: &str = "eyJhbGciOiJSUzI1NiIsImtpZCI6InJzYSJ9.eyJpc3MiOiJpIiwiYXVkIjoiYSIsImV4cCI6NDEwMjQ0NDg\
        wMCwic3ViIjoiYW5uIiwicm9sZSI6InZpZXdlciJ9.t5pnHq5ISOyNCXyQDkEaXlSvxi00LRx7QE_I6yPPwN\
        4IDidlCRGgz1VXOhyEcNyg-pAZwa2_P0kBIlGHaXaeb0KhmQNaCHuqYhpa1Zvggl6dGifgdTKc7xKPMuVH0Z\
        U_-7PSozvsGT12RTsZAXohJybGQyKRYpUrhIHppqwJWUWIKUEBYD6K-Sw4GJUMRbRBEi31lD8-4yapzB3Eg4\
        lGSaLBR6ADspsSOzoZg2y59mFyeDwKNUXNzl2qDGK85k_Kki9A5NfcYnAeYwYYI-rvPjnbA4cIROwA4Rryvj\
        HgpcoSFx0gvVdfx4sCXahXjhxUmflgTier74L71_qHcz1vmw";

    fn rules() -> JwtRules {
        JwtRules {
            issuer: "i".into(),
            audience: "a".into(),
            owner_claim: "sub".into(),
            role_claim: "role".into(),
        }
    }

    fn signed(header: &Value, claims: &Value, sign: impl Fn(&[u8]) -> Vec<u8>) -> String {
        let part = |value: &Value| URL_SAFE_NO_PAD.encode(value.to_string());
        let message = format!("{}.{}", part(header), part(claims));
        let signature = URL_SAFE_NO_PAD.encode(sign(message.as_bytes()));
        format!("{message}.{signature}")
    }

    fn claims() -> Value {
        json!({"iss": "i", "aud": ["x", "a"], "exp": 4_102_444_800_u64, "sub": "ann", "role": "user"})
    }

    fn ed25519() -> (Ed25519KeyPair, Value) {
        let pair = Ed25519KeyPair::from_seed_unchecked(&[7; 32]).unwrap();
        let x = URL_SAFE_NO_PAD.encode(pair.public_key());
        (pair, json!({"kty": "OKP", "crv": "Ed25519", "kid": "ed", "x": x}))
    }

    #[test]
    fn all_three_kinds_of_signature_verify() {
        let (ed, ed_key) = ed25519();
        let random = SystemRandom::new();
        let ec = EcdsaKeyPair::generate_pkcs8(&ECDSA_P256_SHA256_FIXED_SIGNING, &random).unwrap();
        let ec = EcdsaKeyPair::from_pkcs8(&ECDSA_P256_SHA256_FIXED_SIGNING, ec.as_ref(), &random)
            .unwrap();
        let point = ec.public_key().as_ref();
        let [x, y] = [&point[1..33], &point[33..]].map(|bytes| URL_SAFE_NO_PAD.encode(bytes));
        let ec_key =
            json!({"kty": "EC", "crv": "P-256", "kid": "ec", "alg": "ES256", "x": x, "y": y});
        let rsa_key = json!({"kty": "RSA", "kid": "rsa", "n": RSA_N, "e": "AQAB"});
        // A symmetric key in a file of public ones is passed over.
        let oct = json!({"kty": "oct", "kid": "oct", "alg": "HS256", "k": "AAAA"});
        let keys =
            Keys::parse(&json!({"keys": [oct, ed_key, ec_key, rsa_key]}).to_string()).unwrap();
        assert_eq!(keys.0.len(), 3);
        let ed_token = signed(&json!({"alg": "EdDSA", "kid": "ed"}), &claims(), |message| {
            ed.sign(message).as_ref().to_vec()
        });
        let ec_token = signed(&json!({"alg": "ES256", "kid": "ec"}), &claims(), |message| {
            ec.sign(&random, message).unwrap().as_ref().to_vec()
        });
        let table = [(&*ed_token, Role::User), (&*ec_token, Role::User), (RSA_TOKEN, Role::Viewer)];
        for (token, role) in table {
            let principal = keys.verify(token, &rules()).unwrap();
            assert_eq!((&*principal.owner, &*principal.name), ("ann", "jwt:ann"));
            assert_eq!(principal.role, role);
            // One character of the signature changed.
            let (rest, end) = token.split_at(token.len() - 5);
            let end = if end.starts_with('A') { "BAAAA" } else { "AAAAA" };
            let fault = keys.verify(&format!("{rest}{end}"), &rules()).unwrap_err();
            assert!(fault.contains("signature"), "{fault}");
        }
    }

    #[test]
    fn every_claim_is_checked() {
        let (pair, key) = ed25519();
        let keys = Keys::parse(&json!({"keys": [key]}).to_string()).unwrap();
        let sign = |message: &[u8]| pair.sign(message).as_ref().to_vec();
        let header = json!({"alg": "EdDSA", "kid": "ed"});
        let table = [
            ("exp", json!(1_000_000_000), "expired"),
            ("exp", Value::Null, "exp"),
            ("nbf", json!(4_102_444_000_u64), "not valid yet"),
            ("iss", json!("j"), "issuer"),
            ("iss", Value::Null, "iss"),
            ("aud", json!("b"), "audience"),
            ("aud", Value::Null, "aud"),
            ("sub", json!(""), "names no owner"),
            ("role", json!("root"), "`root` is no role"),
            ("role", Value::Null, "no text `role`"),
        ];
        for (name, value, wanted) in table {
            let mut claims = claims();
            claims[name] = value.clone();
            if value.is_null() {
                claims.as_object_mut().unwrap().remove(name);
            }
            let fault = keys.verify(&signed(&header, &claims, sign), &rules()).unwrap_err();
            assert!(fault.contains(wanted), "{name} {value}: {fault}");
        }
        // Neither an unsigned token nor one that takes the public key for a shared secret.
        for (alg, kid) in [("none", "ed"), ("HS256", "ed"), ("EdDSA", "other")] {
            let token = signed(&json!({"alg": alg, "kid": kid}), &claims(), sign);
            assert!(keys.verify(&token, &rules()).is_err(), "{alg} {kid}");
        }
        assert!(Keys::parse("{\"keys\": []}").unwrap_err().contains("no public key"));
        assert!(Keys::parse("nonsense").unwrap_err().contains("no JWKS"));
    }
}
