//! Same input, specification and build: same bytes, whatever computes them.

use std::io::Write as _;

use lookalike::{
    io::{Limits, read},
    jobs::spec::{Effort, Optimize, Render, Shading, Spec},
    render::adapters,
};

use super::support::{check_levels, job, sample};

/// Optimization with turns of the view sets in the first (its coarser level has the pixels for it),
/// without in the others.
fn specs() -> [Spec; 3] {
    let budget = |n| Optimize { max_evaluations: Some(n), ..Optimize::default() };
    let with_budget = |n, triangles| Spec { optimize: budget(n), ..Spec::new(triangles) };
    let small = Render { n_views: 6, image_size: 128, ..Render::default() };
    let smooth = Render { shading: Shading::Smooth, ..small.clone() };
    [
        Spec { effort: Effort::Fast, render: small.clone(), ..with_budget(50_000, vec![900, 150]) },
        Spec { effort: Effort::Balanced, render: smooth, ..with_budget(8_000, vec![700]) },
        Spec {
            effort: Effort::Best,
            render: small,
            start_factor: 2.0,
            ..with_budget(8_000, vec![700])
        },
    ]
}

#[test]
fn threads_do_not_matter() {
    let input = sample(4000);
    for spec in specs() {
        let runs = [1, 2, 5].map(|n| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
            pool.install(|| job(&spec, "sample.glb", &input, "cpu").timeless())
        });
        assert_eq!(runs[0], runs[1]);
        assert_eq!(runs[0], runs[2]);
    }
}

#[test]
fn devices_do_not_matter() {
    let fit: Vec<_> = adapters().into_iter().filter(|a| a.unfit.is_none()).collect();
    if fit.is_empty() {
        let _ =
            writeln!(std::io::stderr(), "skipped: no Vulkan adapter (install mesa-vulkan-drivers)");
    }
    let input = sample(3000);
    for adapter in fit {
        for spec in &specs()[..2] {
            let native = job(spec, "sample.glb", &input, "cpu");
            let device = job(spec, "sample.glb", &input, &adapter.name);
            assert!(device.result.is_ok(), "{}: {:?}", adapter.name, device.result);
            assert_eq!(native.timeless(), device.timeless(), "{}", adapter.name);
            assert_eq!(device.report()["adapter"]["driver"], adapter.driver);
        }
    }
}

#[test]
fn the_progressive_file_holds_every_level() {
    let input = sample(4000);
    let done = job(&specs()[0], "sample.glb", &input, "cpu");
    let reader = check_levels(&done);
    assert_eq!(reader.header().levels.len(), 2);
    let original = read("sample.glb", &input, &Limits::default()).unwrap().mesh;
    assert_eq!(reader.extract(original.faces.len() as u32).unwrap(), original);
}
