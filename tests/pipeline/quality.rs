//! Image quality on real models: what the product is for. Figures by our own off-line evaluation
//! (24 views that no run has seen), which agrees with the independent one to 1%.

use lookalike::{
    compare::{Params, Reference},
    io::{Limits, read},
    jobs::spec::{Effort, Method, Spec},
    mesh::Mesh,
};

use super::support::{job, real_model, simplify_only};

fn level(spec: &Spec, name: &str, input: &[u8]) -> Mesh {
    let done = job(spec, name, input, "cpu");
    assert!(done.result.is_ok(), "{name}: {:?}", done.result);
    read("lod-0.glb", &done.files["lod-0.glb"], &Limits::default()).unwrap().mesh
}

/// Image-driven d2 as a share of memoryless d2 at the same triangle count.
fn check(file: &str, triangles: u32, effort: Effort, at_most: f64) {
    let Some(input) = real_model(file) else { return };
    let original = read(file, &input, &Limits::default()).unwrap().mesh;
    let reference = Reference::new(&original, &Params::default());
    let spec = Spec { effort, ..simplify_only(vec![triangles]) };
    let image = level(&spec, file, &input);
    let memoryless = level(&Spec { method: Method::Memoryless, ..spec }, file, &input);
    assert!(image.faces.len().abs_diff(memoryless.faces.len()) <= 1);
    let (i, m) = (reference.compare(&image).d2_255, reference.compare(&memoryless).d2_255);
    eprintln!("{file} → {triangles} {effort:?}: d2 {i:.3} against {m:.3} = {:.3}", i / m);
    assert!(i <= at_most * m, "{file} → {triangles} {effort:?}: {i:.3} > {at_most} × {m:.3}");
}

#[test]
fn the_bunny_looks_better_than_memoryless() {
    check("stanford_bunny.glb", 1333, Effort::Fast, 0.92);
    check("stanford_bunny.glb", 654, Effort::Balanced, 0.90);
}

#[test]
fn the_armadillo_looks_better_than_memoryless() {
    check("armadillo.glb", 864, Effort::Fast, 0.93);
}
