//! What an earlier job has left in a folder of results, where it would pass for a result of this one.

use std::{fs, path::Path};

/// What the worker writes, but for `report.json`, which every job writes anew.
const NAMES: [&str; 7] = [
    "comparison.json",
    "energy.csv",
    "energy.svg",
    "levels.png",
    "lods.glb",
    "optimization.svg",
    "progressive.lkpm",
];
/// Of the same there may be several: what stands before and behind their number.
const NUMBERED: [(&str, &str); 2] = [("contact-", ".png"), ("lod-", ".glb")];
/// Whoever has written these has written all levels. Other jobs write nothing that could be mistaken.
const WHOLE: [&str; 2] = ["lod-0.glb", "report.json"];

/// Removes files of an earlier job, and says so. What this job has `written` stays, and so do files with names of its
/// `inputs`, wherever these lie.
pub(crate) fn remove(folder: &Path, written: &[String], inputs: &[String]) {
    if !WHOLE.iter().all(|name| written.iter().any(|file| file == name)) {
        return;
    }
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let files = entries.filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_file()));
    let names = files.filter_map(|entry| entry.file_name().into_string().ok());
    let is_left =
        |name: &String| is_ours(name) && !written.contains(name) && !inputs.contains(name);
    let mut left: Vec<String> = names.filter(is_left).collect();
    left.sort_unstable();
    let (gone, stuck): (Vec<String>, Vec<String>) =
        left.into_iter().partition(|name| fs::remove_file(folder.join(name)).is_ok());
    for (what, names) in [("are removed", gone), ("cannot be removed", stuck)] {
        if !names.is_empty() {
            eprintln!("these files of an earlier job {what}: {}", names.join(", "));
        }
    }
}

/// Exactly a name that the worker gives.
fn is_ours(name: &str) -> bool {
    let is_numbered = |(before, behind): &(&str, &str)| {
        let number = name.strip_prefix(*before).and_then(|rest| rest.strip_suffix(*behind));
        number.is_some_and(|text| text.parse::<u32>().is_ok_and(|n| n.to_string() == text))
    };
    NAMES.contains(&name) || NUMBERED.iter().any(is_numbered)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is left in a folder of these files.
    fn left(files: &[&str], written: &[&str], inputs: &[&str]) -> Vec<String> {
        let folder = tempfile::tempdir().unwrap();
        for file in files.iter().chain(written) {
            fs::write(folder.path().join(file), b"").unwrap();
        }
        let owned =
            |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>();
        remove(folder.path(), &owned(written), &owned(inputs));
        let entries = fs::read_dir(folder.path()).unwrap();
        let mut names: Vec<_> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort_unstable();
        names
    }

    #[test]
    fn only_files_of_an_earlier_job_go() {
        let written = ["lod-0.glb", "report.json"];
        let earlier = ["lod-1.glb", "lod-12.glb", "lods.glb", "contact-1.png", "comparison.json"];
        assert_eq!(left(&earlier, &written, &[]), written);
        // What was simplified may lie in the same folder.
        assert_eq!(
            left(&earlier, &written, &["lod-1.glb"]),
            ["lod-0.glb", "lod-1.glb", "report.json"]
        );
        let others = ["lod-01.glb", "lod-1.obj", "lod-.glb", "lod-+1.glb", "mine.glb"];
        assert_eq!(left(&others, &written, &[]).len(), others.len() + written.len());
    }

    #[test]
    fn a_job_without_levels_removes_nothing() {
        let earlier = ["lod-1.glb", "lods.glb"];
        for written in [&["comparison.json", "report.json"][..], &["lod-0.glb"], &[]] {
            let found = left(&earlier, written, &[]);
            assert_eq!(found.len(), earlier.len() + written.len(), "{found:?}");
        }
    }
}
