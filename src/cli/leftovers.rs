//! What an earlier job has left in a folder of results, where it would pass for a result of this one. Its own report
//! says what it has written: without one, nothing is touched.

use std::{fs, path::Path};

use serde::Deserialize;

/// What a job with levels writes besides these, but for `report.json`, which every job writes anew.
const NAMES: [&str; 6] =
    ["energy.csv", "energy.svg", "levels.png", "lods.glb", "optimization.svg", "progressive.lkpm"];
/// Whoever has written these has written all levels. Other jobs write nothing that could be mistaken.
const WHOLE: [&str; 2] = ["lod-0.glb", "report.json"];

/// What the report of an earlier job tells.
#[derive(Default, Deserialize)]
struct Report {
    #[serde(default)]
    levels: Vec<Level>,
}

#[derive(Deserialize)]
struct Level {
    file: String,
}

/// Files that an earlier job has written.
#[derive(Debug)]
pub(crate) struct Earlier(Vec<String>);

impl Earlier {
    /// Reads its report, before another one replaces it.
    pub(crate) fn of(folder: &Path) -> Self {
        let report = fs::read(folder.join("report.json")).unwrap_or_default();
        let report: Report = serde_json::from_slice(&report).unwrap_or_default();
        let n_levels = report.levels.len();
        if n_levels == 0 {
            return Self(Vec::new());
        }
        let levels = report.levels.into_iter().map(|level| level.file);
        let levels = levels.filter(|file| is_level(file));
        let sheets = (0..n_levels).map(|level| format!("contact-{level}.png"));
        Self(levels.chain(sheets).chain(NAMES.map(str::to_owned)).collect())
    }

    /// Removes what is left of it, and says so. What this job has `written` stays. Nothing goes where the two belong
    /// together: one of the `inputs` of this job has the name of a level, wherever it lies.
    pub(crate) fn remove(self, folder: &Path, written: &[String], inputs: &[String]) {
        let is_whole = WHOLE.iter().all(|name| written.iter().any(|file| file == name));
        if !is_whole || self.0.iter().any(|name| inputs.contains(name)) {
            return;
        }
        let is_left = |name: &String| !written.contains(name) && folder.join(name).is_file();
        let left = self.0.into_iter().filter(is_left);
        let (gone, stuck): (Vec<String>, Vec<String>) =
            left.partition(|name| fs::remove_file(folder.join(name)).is_ok());
        for (what, names) in [("are removed", gone), ("cannot be removed", stuck)] {
            if !names.is_empty() {
                eprintln!("these files of an earlier job {what}: {}", names.join(", "));
            }
        }
    }
}

/// A name that the worker gives.
fn is_level(file: &str) -> bool {
    let number = file.strip_prefix("lod-").and_then(|rest| rest.strip_suffix(".glb"));
    number.is_some_and(|text| text.bytes().all(|c| c.is_ascii_digit()))
}

#[cfg(test)]
mod tests {
    use super::*;

    const REPORT: &str =
        r#"{"levels": [{"file": "lod-0.glb"}, {"file": "lod-1.glb"}, {"file": "../x"}]}"#;

    /// What is left in a folder of these files, of which a job has written some and read others.
    fn left(report: &str, files: &[&str], written: &[&str], inputs: &[&str]) -> Vec<String> {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("report.json"), report).unwrap();
        for file in files {
            fs::write(folder.path().join(file), b"").unwrap();
        }
        let earlier = Earlier::of(folder.path());
        for file in written {
            fs::write(folder.path().join(file), b"").unwrap();
        }
        let owned =
            |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>();
        earlier.remove(folder.path(), &owned(written), &owned(inputs));
        let entries = fs::read_dir(folder.path()).unwrap();
        let mut names: Vec<_> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort_unstable();
        names
    }

    #[test]
    fn files_of_an_earlier_job_go_and_no_others() {
        let written = ["lod-0.glb", "report.json"];
        let files = ["lod-1.glb", "lods.glb", "contact-1.png", "lod-2.glb", "mine.glb"];
        assert_eq!(
            left(REPORT, &files, &written, &["a.glb"]),
            ["lod-0.glb", "lod-2.glb", "mine.glb", "report.json"]
        );
        // Whoever made these did not say so.
        for report in ["", "{}", r#"{"comparison": {}}"#] {
            assert_eq!(left(report, &files, &written, &[]).len(), files.len() + written.len());
        }
    }

    #[test]
    fn levels_that_belong_together_stay_together() {
        let (files, written) = (["lod-1.glb", "lods.glb"], ["lod-0.glb", "report.json"]);
        // One of them was optimized, in the same place.
        assert_eq!(left(REPORT, &files, &written, &["a.glb", "lod-1.glb"]).len(), 4);
        // A comparison, and what was broken off.
        for written in [&["comparison.json"][..], &["lod-0.glb"], &[]] {
            let found = left(REPORT, &files, written, &[]);
            assert_eq!(found.len(), files.len() + written.len() + 1, "{found:?}");
        }
    }
}
