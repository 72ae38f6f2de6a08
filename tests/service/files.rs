//! What scripts rely on: the files that a job leaves, their columns and fields, and the commands that
//! read them.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::Path,
    process::Output,
};

use serde_json::Value;

use crate::support::{lookalike, small_torus};

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Runs the program in a folder; it must succeed.
fn run(folder: &Path, flags: &[&str]) -> Output {
    let output = lookalike().current_dir(folder).args(flags).output().unwrap();
    assert!(output.status.success(), "{flags:?}: {output:?}");
    output
}

/// A folder with a torus of 5,000 triangles and what became of it.
fn job(flags: &[&str]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("torus.ply"), small_torus()).unwrap();
    let common = ["run", "torus.ply", "--out=out", "--device=cpu", "--views=4", "--image-size=64"];
    run(folder.path(), &[&common, flags].concat());
    folder
}

fn names(folder: &Path) -> BTreeSet<String> {
    let entries = fs::read_dir(folder).unwrap();
    entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
}

fn report(folder: &Path) -> Value {
    serde_json::from_slice(&fs::read(folder.join("out/report.json")).unwrap()).unwrap()
}

#[test]
fn a_job_leaves_its_files_in_the_order_asked() {
    let folder = job(&["--triangles=300,900,600", "--effort=fast", "--seed=5"]);
    let curves = ["energy.csv", "energy.svg", "optimization.svg"];
    let mut wanted: BTreeSet<String> =
        ["lods.glb", "progressive.lkpm", "levels.png", "report.json"].map(String::from).into();
    wanted.extend(curves.map(String::from));
    for i in 0..3 {
        wanted.extend([format!("lod-{i}.glb"), format!("contact-{i}.png")]);
    }
    assert_eq!(names(&folder.path().join("out")), wanted);
    for (i, asked) in [300, 900, 600].into_iter().enumerate() {
        let glb = fs::read(folder.path().join(format!("out/lod-{i}.glb"))).unwrap();
        let mesh = lookalike::io::read("l.glb", &glb, &lookalike::io::Limits::default());
        let n_faces = mesh.unwrap().mesh.faces.len();
        assert!((asked - 1..=asked).contains(&n_faces), "{n_faces} of {asked}");
        let png = fs::read(folder.path().join(format!("out/contact-{i}.png"))).unwrap();
        assert!(png.starts_with(b"\x89PNG"));
        let level = &report(folder.path())["levels"][i];
        assert_eq!(level["file"], format!("lod-{i}.glb"));
        assert_eq!((level["asked"].as_u64(), level["triangles"].as_u64()), {
            (Some(asked as u64), Some(n_faces as u64))
        });
    }
}

#[test]
fn the_report_has_its_fields() {
    // The energy of these pictures is asked for: no others judge whether edits help.
    let flags = ["--triangles=300", "--effort=fast", "--seed=5", "--optimize-until=0.5"];
    let folder = job(&flags);
    let report = report(folder.path());
    assert_eq!(report["version"], env!("CARGO_PKG_VERSION"));
    assert_eq!((report["seed"].as_u64(), report["device"].as_str()), (Some(5), Some("native")));
    assert!(report["adapter"].is_null(), "the native evaluator has none");
    assert_eq!(report["input"]["triangles"], 5000);
    assert_eq!(report["input"]["vertices"], 2500);
    assert_eq!(report["input"]["boundary_edges"], 0);
    let level = &report["levels"][0];
    assert!(level["vertices"].as_u64().unwrap() >= 100);
    assert!(level["d2_percent"].as_f64().unwrap() > 0.0);
    assert_eq!(level["stopped_by"], "triangles");
    let stages = report["stages"].as_array().unwrap();
    let stage_names: Vec<_> = stages.iter().map(|s| s["stage"].as_str().unwrap()).collect();
    assert_eq!(stage_names, ["memoryless", "image", "optimize"]);
    for stage in stages {
        assert_eq!(stage["device"], "native");
        let edits = if stage["stage"] == "optimize" { "edits" } else { "collapses" };
        for figure in ["seconds", "evaluations", "evaluations_per_second", edits] {
            assert!(stage[figure].as_f64().unwrap() > 0.0, "{figure} of {stage}");
        }
    }
    let n_collapses: u64 = stages.iter().map(|s| s["collapses"].as_u64().unwrap()).sum();
    assert_eq!(report["records"].as_u64(), Some(n_collapses));
}

/// Scripts rely on the first seven.
const COLUMNS: &str =
    "seq,stage,evaluations,seconds,triangles,energy,d2,level,energy_ratio,d2_unseen,turn";

#[test]
fn the_curve_has_its_columns() {
    for (flags, stages) in [
        (&["--effort=fast"][..], &["memoryless", "image", "optimize"][..]),
        (&["--simplify=memoryless"], &["memoryless"]),
    ] {
        let folder = job(&[&["--triangles=300"], flags].concat());
        let csv = fs::read_to_string(folder.path().join("out/energy.csv")).unwrap();
        let mut lines = csv.lines();
        assert_eq!(lines.next(), Some(COLUMNS));
        let rows: Vec<Vec<&str>> = lines.map(|line| line.split(',').collect()).collect();
        check_curve(&rows, stages);
    }
}

/// Numbers from 0 on; in each stage evaluations and seconds grow, and triangles get fewer.
fn check_curve(rows: &[Vec<&str>], stages: &[&str]) {
    assert!(rows.len() > 20, "{} rows", rows.len());
    let mut last: BTreeMap<&str, [f64; 3]> = BTreeMap::new();
    for (seq, row) in rows.iter().enumerate() {
        let [number, stage, evaluations, seconds, triangles, energy, d2, ref rest @ ..] = row[..]
        else {
            panic!("{row:?}");
        };
        assert_eq!(rest.len(), 4, "{row:?}");
        let has_level = stage == "optimize";
        assert!(rest.iter().all(|x| has_level || x.is_empty()), "{row:?}");
        assert_eq!(number, seq.to_string());
        let now = [evaluations, seconds, triangles].map(|x| x.parse::<f64>().unwrap());
        if let Some(before) = last.insert(stage, now) {
            let grows = before[0] <= now[0] && before[1] <= now[1] && before[2] >= now[2];
            assert!(grows, "{before:?}, then {now:?}");
        }
        let has_pictures = stage != "memoryless";
        assert_eq!(energy.parse::<u64>().is_ok(), has_pictures, "{row:?}");
        assert_eq!(d2.parse::<f64>().is_ok(), has_pictures, "{row:?}");
    }
    assert_eq!(last.into_keys().collect::<BTreeSet<_>>(), stages.iter().copied().collect());
}

#[test]
fn results_are_compared_and_levels_extracted() {
    let folder = job(&["--triangles=600,300", "--effort=fast"]);
    let flags = ["compare", "torus.ply", "out/lod-0.glb", "--json", "--sheet=sheet.png"];
    let figures: Value = serde_json::from_slice(&run(folder.path(), &flags).stdout).unwrap();
    assert_eq!(figures["triangles_original"], 5000);
    assert_eq!(figures["per_view"].as_array().unwrap().len(), 24);
    let of = |name: &str| figures[name].as_f64().unwrap();
    assert!(of("d2_percent") > 0.0);
    assert!((of("d2_255") - 2.55 * of("d2_percent")).abs() < 1e-9);
    for distance in ["mean", "max"] {
        assert!(figures["metro"][distance].as_f64().unwrap() > 0.0, "{figures}");
    }
    assert!(fs::read(folder.path().join("sheet.png")).unwrap().starts_with(b"\x89PNG"));
    let flags = ["compare", "torus.ply", "torus.ply", "--shading=smooth"];
    let said = text(&run(folder.path(), &flags).stdout);
    assert!(said.contains("d2 = 0.0000 % of full scale (0.0000 of 255)"), "{said}");

    let extract = |n: &str, out: &str| {
        let flags = ["extract", "out/progressive.lkpm", "--triangles", n, "--out", out];
        run(folder.path(), &flags);
        fs::read(folder.path().join(out)).unwrap()
    };
    let lod = fs::read(folder.path().join("out/lod-0.glb")).unwrap();
    assert_eq!(extract("600", "level.glb"), lod);
    assert!(extract("4000", "level.ply").starts_with(b"ply\n"));
    let flags = ["extract", "out/progressive.lkpm", "--triangles=1"];
    let refused = lookalike().current_dir(folder.path()).args(flags).output().unwrap();
    assert_eq!(refused.status.code(), Some(1), "{refused:?}");
    assert!(text(&refused.stderr).contains("300"), "{refused:?}");
}
