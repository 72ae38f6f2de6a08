//! Each call has a name, `x-request-id`: the caller's own, or a new one. Logs have it, and the answer.

use http::{HeaderMap, HeaderValue};

pub(super) const HEADER: &str = "x-request-id";
/// Bytes of a name.
const MAX: usize = 64;

/// The name of the call with these headers, which say it from now on.
pub(super) fn ensure(headers: &mut HeaderMap) -> HeaderValue {
    let is_name = |name: &&HeaderValue| {
        (1..=MAX).contains(&name.len()) && name.as_bytes().iter().all(u8::is_ascii_graphic)
    };
    let given = headers.get(HEADER).filter(is_name).cloned();
    let name = given.unwrap_or_else(|| {
        let new = uuid::Uuid::new_v4().to_string();
        HeaderValue::from_str(&new).unwrap_or(HeaderValue::from_static("-"))
    });
    headers.insert(HEADER, name.clone());
    name
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_kept_where_they_are_names() {
        for (given, is_kept) in
            [("trace-7", true), ("", false), ("a b", false), (&*"x".repeat(65), false)]
        {
            let mut headers = HeaderMap::from_iter([(
                http::HeaderName::from_static(HEADER),
                HeaderValue::from_str(given).unwrap(),
            )]);
            let name = ensure(&mut headers);
            assert_eq!((name == given, headers[HEADER] == name), (is_kept, true), "{given}");
        }
        let mut none = HeaderMap::new();
        assert_eq!(ensure(&mut none).len(), 36);
    }
}
