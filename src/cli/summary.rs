//! What became of each level, one line each, for whoever looks at the terminal.

use std::{fs, path::Path};

use serde::Deserialize;

/// The file that knows.
const REPORT: &str = "report.json";
/// The level is the mesh that came with the job, or has as many triangles: nothing had to stop.
const AS_IT_CAME: &str = "input";

/// What is told of it.
#[derive(Default, Deserialize)]
struct Report {
    /// Absent from the report of an evaluation.
    #[serde(default)]
    levels: Vec<Level>,
}

#[derive(Deserialize)]
struct Level {
    file: String,
    triangles: u64,
    d2_percent: Option<f64>,
    stopped_by: String,
}

/// Tells it of a job that has `written` these files into the folder. Standard output is for their names.
pub(crate) fn tell(folder: &Path, written: &[String]) {
    if written.iter().any(|name| name == REPORT) {
        let report = fs::read(folder.join(REPORT)).unwrap_or_default();
        lines(&report).iter().for_each(|line| eprintln!("{line}"));
    }
}

/// Nothing where the report is of another version, which is no reason to fail.
fn lines(report: &[u8]) -> Vec<String> {
    let report: Report = serde_json::from_slice(report).unwrap_or_default();
    let line = |level: &Level| {
        let Level { file, triangles, d2_percent, stopped_by } = level;
        let d2 = d2_percent.map(|d2| format!(", d2 {d2:.2} %")).unwrap_or_default();
        let end = if stopped_by == AS_IT_CAME {
            String::new()
        } else {
            format!(", stopped by {stopped_by}")
        };
        format!("{file}: {triangles} triangles{d2}{end}")
    };
    report.levels.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_level_is_a_line() {
        let report = br#"{"seed": 0, "levels": [
            {"file": "lod-0.glb", "asked": 300, "triangles": 300, "d2_percent": 4.689, "stopped_by": "triangles"},
            {"file": "lod-1.glb", "triangles": 20, "d2_percent": null, "stopped_by": "no_legal_collapse"},
            {"file": "lod-2.glb", "triangles": 12, "d2_percent": 5, "stopped_by": "input"}
        ]}"#;
        let wanted = [
            "lod-0.glb: 300 triangles, d2 4.69 %, stopped by triangles",
            "lod-1.glb: 20 triangles, stopped by no_legal_collapse",
            "lod-2.glb: 12 triangles, d2 5.00 %",
        ];
        assert_eq!(lines(report), wanted);
        for none in [&br#"{"comparison": {}}"#[..], b"", b"[]"] {
            assert!(lines(none).is_empty());
        }
    }
}
