//! The header `Range`, of which one range of bytes is understood.

/// What of a file is wanted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Wanted {
    /// All of it: no range is asked for, or none that is understood.
    Whole,
    /// So many bytes (at least one) from an offset on.
    Part(u64, u64),
    /// A range behind the end.
    Nothing,
}

/// What `header` asks of a file of `size` bytes.
pub(super) fn wanted(header: &str, size: u64) -> Wanted {
    let range = header.trim().strip_prefix("bytes=").and_then(|range| range.split_once('-'));
    let Some((first, last)) = range else { return Wanted::Whole };
    let number =
        |text: &str| text.bytes().all(|c| c.is_ascii_digit()).then(|| text.parse().ok())?;
    let (start, end) = match (number(first), number(last)) {
        // The last so many bytes.
        (None, Some(n)) if first.is_empty() => (size.saturating_sub(n), size),
        (Some(start), None) if last.is_empty() => (start, size),
        (Some(start), Some(last)) if start <= last => (start, size.min(last.saturating_add(1))),
        _ => return Wanted::Whole,
    };
    if start < end { Wanted::Part(start, end - start) } else { Wanted::Nothing }
}

#[cfg(test)]
mod tests {
    use super::{Wanted::*, *};

    #[test]
    fn ranges_are_held_to_the_file() {
        let table = [
            ("bytes=0-0", Part(0, 1)),
            ("bytes=2-4", Part(2, 3)),
            ("bytes=2-", Part(2, 8)),
            ("bytes=-3", Part(7, 3)),
            ("bytes=-30", Part(0, 10)),
            ("bytes=9-99999999999999999999", Whole),
            ("bytes=9-18446744073709551615", Part(9, 1)),
            ("bytes=10-", Nothing),
            ("bytes=-0", Nothing),
            ("bytes=4-2", Whole),
            ("bytes=-", Whole),
            ("bytes=0-1,3-4", Whole),
            ("bytes=+1-2", Whole),
            ("lines=0-1", Whole),
            ("", Whole),
        ];
        for (header, expected) in table {
            assert_eq!(wanted(header, 10), expected, "{header}");
        }
        assert_eq!(wanted("bytes=0-", 0), Nothing);
    }
}
