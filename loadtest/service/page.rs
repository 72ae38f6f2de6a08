//! The figures as a section of a Markdown page.

use std::{fmt::Write as _, fs, path::Path, process::Command};

use crate::{Figures, quantile};

/// The section's first line. It ends where the next one of its rank begins.
const HEADING: &str = "## The service";

/// A figure.
pub(crate) struct Row {
    pub(crate) what: &'static str,
    pub(crate) value: f64,
    pub(crate) asked: &'static str,
}

/// Quantiles of times in milliseconds.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Waits {
    p50: f64,
    p99: f64,
}

impl Waits {
    pub(crate) fn of(times: Vec<f64>) -> Self {
        Self { p50: quantile(times.clone(), 0.5), p99: quantile(times, 0.99) }
    }
}

/// What a bad tenant did, and how long the good one's submissions took.
pub(crate) struct Abused {
    pub(crate) what: &'static str,
    pub(crate) alone: Waits,
    pub(crate) beset: Waits,
}

pub(crate) type Abuses = (&'static str, Vec<Abused>);

pub(crate) fn section(figures: &[Figures], abuses: &[Abuses], note: Option<&str>) -> String {
    let mut text = format!("{HEADING}\n\n{}", machine());
    if let Some(note) = note {
        let _ = write!(text, " {note}");
    }
    text += "\n";
    // Of the pairs the one with the most figures names them: not all have each.
    if let Some((_, first)) = figures.iter().max_by_key(|(_, rows)| rows.len()) {
        let names: Vec<_> = figures.iter().map(|(name, _)| *name).collect();
        let _ = write!(text, "\n| | {} | asked for |\n|---|", names.join(" | "));
        text += &"---:|".repeat(names.len() + 1);
        for (i, row) in first.iter().enumerate() {
            let values = figures.iter().map(|(_, rows)| rows.get(i).map_or(f64::NAN, |r| r.value));
            let values: Vec<_> = values.map(number).collect();
            let _ = write!(text, "\n| {} | {} | {} |", row.what, values.join(" | "), row.asked);
        }
        text += "\n";
    }
    for (name, rows) in abuses {
        let _ = write!(text, "\n| {name}: while the bad tenant | p50 (ms) | alone | p99 (ms) ");
        text += "| alone | p99, of alone |\n|---|---:|---:|---:|---:|---:|";
        for Abused { what, alone, beset } in rows {
            let times = [beset.p50, alone.p50, beset.p99, alone.p99].map(number).join(" | ");
            let _ = write!(text, "\n| {what} | {times} | {:.2} |", beset.p99 / alone.p99);
        }
        text += "\n";
    }
    text
}

/// Puts the section into a page, in place of what it was.
pub(crate) fn write(path: &Path, section: &str) {
    let page = fs::read_to_string(path).unwrap_or_else(|_| "# Results\n".into());
    let (before, after) = match page.find(HEADING) {
        Some(at) => {
            let rest = &page[at + HEADING.len()..];
            let end = rest.find("\n## ").map_or("", |end| &rest[end + 1..]);
            (&page[..at], end)
        }
        None => (&*page, ""),
    };
    let parts = [before.trim_end(), section.trim_end(), after.trim_end()];
    let parts: Vec<_> = parts.into_iter().filter(|part| !part.is_empty()).collect();
    fs::write(path, parts.join("\n\n") + "\n").unwrap();
}

fn number(value: f64) -> String {
    match value {
        v if v.is_nan() => "–".into(),
        v if v < 100.0 => format!("{v:.1}"),
        v => {
            let digits = format!("{v:.0}");
            let groups = digits.as_bytes().rchunks(3).rev();
            let groups: Vec<_> = groups.map(String::from_utf8_lossy).collect();
            groups.join(",")
        }
    }
}

/// What it was measured on, and when.
fn machine() -> String {
    let said = |program: &str, args: &[&str]| {
        let output = Command::new(program).args(args).output().ok()?;
        Some(String::from_utf8_lossy(&output.stdout).trim().to_owned())
    };
    let info = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = info.lines().find_map(|line| line.strip_prefix("model name")).unwrap_or_default();
    let model = model.trim_start_matches([' ', '\t', ':']).trim().to_owned();
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let date = said("date", &["-u", "+%Y-%m-%d"]).unwrap_or_default();
    format!(
        "Measured on {date} by `make loadtest`: server, generator and PostgreSQL together on {cores} cores ({model})."
    )
}
