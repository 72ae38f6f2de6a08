//! An image-driven stage that begins with more triangles than 16 bits count.

use lookalike::{
    io::{Limits, read},
    jobs::spec::{Effort, Render, Spec},
    render::adapters,
};

use super::support::{Done, check_levels, job, sample, simplify_only};

/// Where the image-driven stage ends, and by which factor it begins above 65,536.
const TARGET: u32 = 65_400;
const FACTOR: f64 = 1.012;

fn large_job(input: &[u8], device: &str) -> Done {
    let render = Render { n_views: 4, image_size: 64, ..Render::default() };
    let spec =
        Spec { effort: Effort::Fast, start_factor: FACTOR, render, ..simplify_only(vec![TARGET]) };
    let done = job(&spec, "sample.glb", input, device);
    assert!(done.result.is_ok(), "{device}: {:?}", done.result);
    done
}

#[test]
fn more_than_sixteen_bits_of_triangles_are_judged_by_their_looks() {
    let input = sample(100_000);
    let original = read("sample.glb", &input, &Limits::default()).unwrap().mesh;
    assert!(original.faces.len() > 95_000, "{}", original.faces.len());
    let native = large_job(&input, "cpu");
    let report = native.report();
    let level = &report["levels"][0];
    assert_eq!(level["stopped_by"], "triangles");
    assert!((TARGET - 1..=TARGET).contains(&(level["triangles"].as_u64().unwrap() as u32)));
    assert!(level["d2_percent"].as_f64().unwrap() < 5.0, "{level}");
    let stage = report["stages"].as_array().unwrap().iter().find(|s| s["stage"] == "image");
    let collapses = stage.unwrap()["collapses"].as_u64().unwrap();
    assert!(collapses > (65_536 - u64::from(TARGET)) / 2, "{collapses}: it began below 65,536");

    // Every level on either side of the 16-bit boundary comes out of the records.
    let reader = check_levels(&native);
    for n_faces in [66_000, 65_537, 65_536, 65_535, 65_500] {
        let mesh = reader.extract(n_faces).unwrap();
        mesh.check().unwrap();
        assert!((n_faces - 1..=n_faces).contains(&(mesh.faces.len() as u32)));
    }
    assert_eq!(reader.extract(original.faces.len() as u32).unwrap(), original);

    for adapter in adapters().into_iter().filter(|a| a.unfit.is_none()) {
        let device = large_job(&input, &adapter.name);
        assert_eq!(native.timeless(), device.timeless(), "{}", adapter.name);
    }
}
