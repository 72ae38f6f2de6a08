//! Our off-line evaluation against one that shares no code with it: OpenGL draws, trimesh loads,
//! MeshLab measures (`evaluate.py` beside the models, `--metro`; d2 on a scale of 0 to 255, distances
//! in percent of the diagonal).

use std::{collections::BTreeMap, fs, io::Write as _, path::PathBuf, process::Command};

use lookalike::{
    compare::{Comparison, Look, Params, Shading, compare},
    io::{Limits, read, write_glb},
    jobs::spec::{Method, Spec},
    mesh::Mesh,
    metric::surface::SurfaceParams,
};

use super::support::{job, real_model};

const BUNNY: &str = "stanford_bunny.glb";

fn bunny() -> Option<Mesh> {
    let bytes = real_model(BUNNY)?;
    Some(read(BUNNY, &bytes, &Limits::default()).unwrap().mesh)
}

/// The mesh with its vertices merged within the cells of a grid: crude, but it stays the same
/// whatever becomes of our simplification.
fn clustered(mesh: &Mesh, n_cells: f64) -> Mesh {
    let corners = || mesh.positions.iter().copied();
    let low = corners().reduce(glam::DVec3::min).unwrap();
    let high = corners().reduce(glam::DVec3::max).unwrap();
    let cell = (high - low).max_element() / n_cells;
    let mut of_cell = BTreeMap::new();
    let mut positions = Vec::new();
    let slots: Vec<u32> = corners()
        .map(|p| {
            let key = ((p - low) / cell).floor().to_array().map(|c| c as u32);
            *of_cell.entry(key).or_insert_with(|| {
                positions.push(p);
                positions.len() as u32 - 1
            })
        })
        .collect();
    let merged = mesh.faces.iter().map(|f| f.map(|v| slots[v as usize]));
    let faces = merged.filter(|f| f[0] != f[1] && f[1] != f[2] && f[0] != f[2]).collect();
    Mesh::from_parts(positions, faces)
}

fn our_figures(original: &Mesh, simplified: &Mesh, shading: Shading) -> Comparison {
    let look = Look { shading, ..Look::default() };
    let surface = (shading == Shading::Flat).then(SurfaceParams::default);
    compare(original, simplified, &Params { look, surface, ..Params::default() })
}

fn check(what: &str, ours: f64, theirs: f64, tolerance: f64) {
    eprintln!("{what}: {ours:.5}, by the independent evaluator {theirs:.5}");
    assert!((ours / theirs - 1.0).abs() <= tolerance, "{what}: {ours} is not {theirs}");
}

/// What `evaluate.py` said of the bunny in clusters, once: cells, triangles, d2 flat, d2 smooth,
/// mean distance.
const FIGURES: [(f64, usize, f64, f64, f64); 2] =
    [(24.0, 3584, 16.7810, 16.5582, 0.16822), (48.0, 13_333, 9.3585, 8.3288, 0.04515)];

#[test]
fn figures_agree_with_those_of_an_independent_evaluator() {
    let Some(original) = bunny() else { return };
    for (n_cells, triangles, flat, smooth, mean) in FIGURES {
        let simplified = clustered(&original, n_cells);
        assert_eq!(simplified.faces.len(), triangles);
        let ours = our_figures(&original, &simplified, Shading::Flat);
        check("d2 flat", ours.d2_255, flat, 0.01);
        check("mean distance", ours.metro.unwrap().mean, mean, 0.02);
        let ours = our_figures(&original, &simplified, Shading::Smooth);
        check("d2 smooth", ours.d2_255, smooth, 0.01);
    }
}

/// What must be reached: CGAL's Lindstrom–Turk by the same evaluator, 10.51 and 0.0556, and 1% and
/// 2% for the distance between two evaluators.
#[test]
fn memoryless_simplification_is_as_good_as_its_reference() {
    let Some(original) = bunny() else { return };
    let simplified = memoryless();
    let ours = our_figures(&original, &simplified, Shading::Flat);
    assert!(simplified.faces.len() <= 1336);
    assert!(ours.d2_255 <= 10.62, "{ours:?}");
    assert!(ours.metro.unwrap().mean <= 0.0567, "{ours:?}");
}

fn memoryless() -> Mesh {
    let spec = Spec { method: Method::Memoryless, ..Spec::new(vec![1336]) };
    let done = job(&spec, BUNNY, &real_model(BUNNY).unwrap(), "cpu");
    read("lod-0.glb", &done.files["lod-0.glb"], &Limits::default()).unwrap().mesh
}

/// The same figures taken now, where the evaluator and its packages are installed:
/// `LOOKALIKE_EVAL_PYTHON` names their interpreter.
#[test]
fn figures_agree_with_the_independent_evaluator_itself() {
    let Some(original) = bunny() else { return };
    let shared = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared");
    let script = shared.join("eval/evaluate.py");
    let python = std::env::var("LOOKALIKE_EVAL_PYTHON").unwrap_or_else(|_| "python3".into());
    let mut probe = Command::new(&python);
    let packages = probe.args(["-c", "import moderngl, numpy, pymeshlab, trimesh"]).output();
    if !script.exists() || !packages.is_ok_and(|output| output.status.success()) {
        let _ = writeln!(
            std::io::stderr(),
            "skipped: no {} or no packages for it in {python}",
            script.display()
        );
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let meshes = [memoryless(), clustered(&original, 24.0), clustered(&original, 48.0)];
    let mut command = Command::new(python);
    command.arg(script).arg(shared.join("models").join(BUNNY));
    for (i, mesh) in meshes.iter().enumerate() {
        let path = dir.path().join(format!("{i}.glb"));
        fs::write(&path, write_glb(mesh).unwrap()).unwrap();
        command.arg(path);
    }
    let output = command.args(["--json", "--metro"]).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let theirs: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    for (mesh, theirs) in meshes.iter().zip(theirs.as_array().unwrap()) {
        let ours = our_figures(&original, mesh, Shading::Flat);
        check("d2 flat", ours.d2_255, theirs["d2"].as_f64().unwrap(), 0.01);
        let mean = theirs["metro"]["mean"].as_f64().unwrap();
        check("mean distance", ours.metro.unwrap().mean, mean, 0.02);
    }
}
