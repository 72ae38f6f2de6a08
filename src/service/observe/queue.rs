//! The queue on the page of metrics: how many jobs wait and how long the oldest has, by owner and priority.
//!
//! Written anew for each page, since owners come and go. Those with most waiting jobs are named; there may be thousands.

use std::{
    cmp::Reverse,
    collections::{BTreeMap, BTreeSet},
    fmt::Write as _,
};

use crate::jobs::store::Waiting;

/// Owners that are named.
const NAMED: usize = 50;
/// All others together.
const OTHER: &str = "other";

/// The queue in Prometheus' text format.
pub fn queue_page(queue: &[Waiting]) -> String {
    let mut by_owner = BTreeMap::<&str, u64>::new();
    for waiting in queue {
        *by_owner.entry(&waiting.owner).or_default() += waiting.n_jobs;
    }
    let mut owners: Vec<_> = by_owner.into_iter().collect();
    owners.sort_by_key(|&(owner, n_jobs)| (Reverse(n_jobs), owner));
    let named: BTreeSet<_> = owners.iter().take(NAMED).map(|&(owner, _)| owner).collect();
    let mut rows = BTreeMap::<(&str, i32), (u64, f64)>::new();
    for waiting in queue {
        let owner = named.get(&*waiting.owner).copied().unwrap_or(OTHER);
        let (n_jobs, oldest_secs) = rows.entry((owner, waiting.priority)).or_default();
        *n_jobs += waiting.n_jobs;
        *oldest_secs = oldest_secs.max(waiting.oldest_secs);
    }
    let mut page = String::new();
    family(&mut page, ("lookalike_queue_jobs", "Jobs that wait"), &rows, |row| row.0 as f64);
    let oldest = ("lookalike_queue_oldest_seconds", "How long the oldest of them has waited");
    family(&mut page, oldest, &rows, |row| row.1);
    page
}

fn family(
    page: &mut String,
    (name, help): (&str, &str),
    rows: &BTreeMap<(&str, i32), (u64, f64)>,
    value: impl Fn(&(u64, f64)) -> f64,
) {
    let _ = writeln!(page, "# HELP {name} {help}, by owner and priority\n# TYPE {name} gauge");
    for ((owner, priority), row) in rows {
        let (owner, value) = (escaped(owner), value(row));
        let _ = writeln!(page, "{name}{{owner=\"{owner}\",priority=\"{priority}\"}} {value}");
    }
}

/// A label's value; JWTs may name owners in any way.
fn escaped(text: &str) -> String {
    text.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn waiting(owner: &str, priority: i32, n_jobs: u64, oldest_secs: f64) -> Waiting {
        Waiting { owner: owner.into(), priority, n_jobs, oldest_secs }
    }

    #[test]
    fn owners_with_most_jobs_are_named() {
        let mut queue = vec![waiting("ann", 0, 9, 1.5), waiting("ann", 5, 1, 0.25)];
        queue.extend((0..NAMED + 2).map(|i| waiting(&format!("o{i:03}"), 0, 2, i as f64)));
        let page = queue_page(&queue);
        for line in [
            "# TYPE lookalike_queue_jobs gauge",
            "lookalike_queue_jobs{owner=\"ann\",priority=\"0\"} 9",
            "lookalike_queue_jobs{owner=\"ann\",priority=\"5\"} 1",
            "lookalike_queue_jobs{owner=\"o048\",priority=\"0\"} 2",
            "lookalike_queue_jobs{owner=\"other\",priority=\"0\"} 6",
            "lookalike_queue_oldest_seconds{owner=\"ann\",priority=\"0\"} 1.5",
            "lookalike_queue_oldest_seconds{owner=\"other\",priority=\"0\"} 51",
        ] {
            assert!(page.lines().any(|l| l == line), "{line} is not in\n{page}");
        }
        assert!(!page.contains("o049"), "{page}");
        assert_eq!(queue_page(&[]).lines().count(), 4);
    }

    #[test]
    fn names_are_escaped() {
        let page = queue_page(&[waiting("a\\b\"c\nd", -3, 1, 0.0)]);
        assert!(page.contains("{owner=\"a\\\\b\\\"c\\nd\",priority=\"-3\"} 1\n"), "{page}");
    }
}
