//! Labels: what clients call their jobs by, to find them again.

use std::collections::BTreeMap;

/// Values by key.
pub type Labels = BTreeMap<String, String>;

/// Most labels of a job.
pub const MOST: usize = 16;
/// Bytes of a key, and of a value.
const KEY_BYTES: usize = 63;
const VALUE_BYTES: usize = 128;

/// What is wrong with the labels of a job.
pub(super) fn faults(labels: &Labels) -> Vec<String> {
    let mut faults = Vec::new();
    if labels.len() > MOST {
        faults.push(format!("{} labels: use at most {MOST}", labels.len()));
    }
    for (key, value) in labels.iter().take(MOST) {
        if !is_key(key) {
            faults.push(format!(
                "the key `{}`: use 1 to {KEY_BYTES} of the characters a-z, A-Z, 0-9, `_`, `-`, `.` and `/`",
                key.escape_default()
            ));
        }
        if value.len() > VALUE_BYTES || value.chars().any(char::is_control) {
            faults.push(format!(
                "the value of `{}`: use at most {VALUE_BYTES} bytes without control characters",
                key.escape_default()
            ));
        }
    }
    faults
}

fn is_key(key: &str) -> bool {
    let is_fit = |c: u8| c.is_ascii_alphanumeric() || b"_-./".contains(&c);
    (1..=KEY_BYTES).contains(&key.len()) && key.bytes().all(is_fit)
}

/// Key and value of `key=value`; or what to write.
pub fn parse(text: &str) -> Result<(String, String), String> {
    let found = text.split_once('=').filter(|(key, _)| is_key(key));
    let (key, value) = found.ok_or_else(|| {
        format!("`{}` is no label: write key=value", text.chars().take(99).collect::<String>())
    })?;
    Ok((key.into(), value.into()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(labels: &[(&str, &str)], wanted: &[&str]) {
        let labels = labels.iter().map(|(k, v)| ((*k).into(), (*v).into())).collect();
        let found = faults(&labels);
        assert_eq!(found.len(), wanted.len(), "{found:?}");
        for (found, wanted) in found.iter().zip(wanted) {
            assert!(found.contains(wanted), "{found}");
        }
    }

    #[test]
    fn faults_name_the_label() {
        check(&[], &[]);
        check(&[("asset/kind", "tree, old"), ("x", ""), ("Gr.-_0", "ä")], &[]);
        check(&[("", "x"), ("a b", "x"), (&"k".repeat(64), "x")], &["``", "`a b`", "kkk"]);
        check(&[("a", &"v".repeat(129)), ("b", "\0")], &["value of `a`", "value of `b`"]);
        let many: Vec<String> = (0..17).map(|k| format!("k{k}")).collect();
        let many: Vec<_> = many.iter().map(|key| (key.as_str(), "")).collect();
        check(&many, &["17 labels"]);
    }

    #[test]
    fn labels_are_written_with_an_equals_sign() {
        assert_eq!(parse("a=b=c"), Ok(("a".into(), "b=c".into())));
        assert_eq!(parse("a="), Ok(("a".into(), String::new())));
        for bad in ["", "a", "=b", "a b=c"] {
            assert!(parse(bad).unwrap_err().contains("key=value"), "{bad}");
        }
    }
}
