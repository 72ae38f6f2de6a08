//! By what pictures are compared: what other metrics than luminance see, and that they cost nothing where there is
//! nothing else to be seen.

use std::io::Cursor;

use glam::DVec3;
use lookalike::{
    compare::{self, Appearance, Look},
    io::{Limits, read, write_glb},
    jobs::spec::{Effort, Metric, Optimize, Render, Spec},
    mesh::{AttributeLayer, Image, Material, Mesh, Semantic, Texture, TextureUse, shapes},
    metric,
};

use super::support::{Done, check_levels, job, simplify_only};

const SIZE: u32 = 128;

fn spec(metric: Metric, triangles: u32) -> Spec {
    let render = Render { n_views: 6, image_size: SIZE, metric, ..Render::default() };
    Spec { effort: Effort::Fast, start_factor: 4.0, render, ..simplify_only(vec![triangles]) }
}

/// A ball in two colours, of which one goes over into the other along a wave.
fn ball(colours: [[f32; 3]; 2]) -> Mesh {
    let mut mesh = shapes::sphere(5);
    let is_second = |face: &[u32; 3]| {
        let center = face.iter().map(|v| mesh.positions[*v as usize]).sum::<DVec3>() / 3.0;
        u32::from(center.x > 0.3 * libm::sin(5.0 * center.y))
    };
    mesh.face_materials = mesh.faces.iter().map(is_second).collect();
    let material =
        |[r, g, b]: [f32; 3]| Material { base_color: [r, g, b, 1.0], ..Material::default() };
    mesh.materials = colours.map(material).to_vec();
    mesh
}

/// Red and green of the same luminance.
fn two_colours() -> Mesh {
    ball([[1.0, 0.0, 0.0], [0.0, 0.2126 / 0.7152, 0.0]])
}

fn level(done: &Done) -> Mesh {
    assert!(done.result.is_ok(), "{:?}", done.result);
    check_levels(done);
    read("lod-0.glb", &done.files["lod-0.glb"], &Limits::default()).unwrap().mesh
}

/// d2 in views that no job works with.
fn d2(original: &Mesh, mesh: &Mesh, metric: metric::Metric) -> f64 {
    let look = Look {
        appearance: Appearance::Coloured,
        image_size: 256,
        supersampling: 2,
        metric,
        ..Look::default()
    };
    let params = compare::Params { look, ..compare::Params::default() };
    compare::compare(original, mesh, &params).d2_percent
}

/// Where colours are of the same luminance, luminance sees no seam between them; red, green and blue do.
#[test]
fn rgb_sees_seams_that_luminance_does_not() {
    let original = two_colours();
    let input = write_glb(&original).unwrap();
    let of = |metric| job(&spec(metric, 200), "ball.glb", &input, "cpu");
    let (luminance, rgb) = (of(Metric::Luminance), of(Metric::Rgb));
    let report = rgb.report();
    let chosen = &report["chosen"]["metric"];
    assert_eq!((&chosen["value"], &chosen["why"]), (&"rgb".into(), &"asked".into()));
    assert_eq!(luminance.report()["chosen"]["metric"]["value"], "luminance");
    // d2 is a mean over pixels and channels.
    let energy = report["levels"][0]["energy"].as_f64().unwrap();
    let found = report["levels"][0]["d2_percent"].as_f64().unwrap();
    let wanted = (energy / f64::from(3 * 6 * SIZE * SIZE)).sqrt() / 2.55;
    assert!((found - wanted).abs() < 1e-9 * wanted, "{found}, not {wanted}");
    let of_colours = [&luminance, &rgb].map(|d| d2(&original, &level(d), metric::Metric::Rgb));
    let of_greys = [&luminance, &rgb].map(|d| d2(&original, &level(d), metric::Metric::Luminance));
    eprintln!("d2 by luminance and by rgb: {of_colours:.3?}, of their luminances {of_greys:.3?}");
    assert!(of_colours[1] < 0.7 * of_colours[0], "{of_colours:?}");
}

/// Optimization goes by the metric too: slopes and moves.
#[test]
fn optimization_sees_colours() {
    let input = write_glb(&two_colours()).unwrap();
    let optimize =
        Optimize { max_evaluations: Some(20_000), until: Some(0.5), ..Optimize::default() };
    let done = job(&Spec { optimize, ..spec(Metric::Rgb, 150) }, "ball.glb", &input, "cpu");
    level(&done);
    let report = done.report();
    let optimized = &report["levels"][0]["optimization"];
    let [before, after] =
        ["energy_before", "energy_after"].map(|key| optimized[key].as_u64().unwrap());
    assert!(after < before * 9 / 10, "{before} to {after}");
}

/// Greys have nothing that luminance does not tell: the same bytes, for the same work.
#[test]
fn greys_are_compared_by_luminance() {
    for mesh in [shapes::sphere(5), ball([[0.25; 3], [0.75; 3]])] {
        let input = write_glb(&mesh).unwrap();
        let of = |metric| job(&spec(metric, 500), "grey.glb", &input, "cpu");
        let (luminance, rgb) = (of(Metric::Luminance), of(Metric::Rgb));
        assert!(luminance.timeless() == rgb.timeless());
        let report = rgb.report();
        let chosen = &report["chosen"]["metric"];
        assert_eq!(chosen["value"], "luminance");
        assert!(chosen["why"].as_str().unwrap().contains("nothing but greys"), "{chosen}");
    }
}

/// Hills that are the same left and right of the middle, under a texture that is noise on the left and even on the
/// right.
fn hills() -> Mesh {
    let height = |u: f64, v: f64| 0.05 * libm::sin(40.0 * (u - 0.5).abs()) * libm::cos(37.0 * v);
    let mut mesh =
        shapes::grid([80, 80], [false; 2], |u, v| DVec3::new(u - 0.5, v - 0.5, height(u, v)));
    mesh.face_wedges.clone_from(&mesh.faces);
    let place = |p: &DVec3| [p.x as f32 + 0.5, p.y as f32 + 0.5];
    let values = mesh.positions.iter().flat_map(place).collect();
    mesh.layers = vec![AttributeLayer { semantic: Semantic::TexCoord(0), width: 2, values }];
    let noise = |x: u32, y: u32| (x / 4 * 64 + y / 4).wrapping_mul(2_654_435_761) >> 31;
    let texel = |x: u32, y: u32| if x < 128 { 60 + 140 * noise(x, y) as u8 } else { 130 };
    let image = image::RgbImage::from_fn(256, 256, |x, y| image::Rgb([texel(x, y); 3]));
    let mut bytes = Vec::new();
    image.write_to(&mut Cursor::new(&mut bytes), image::ImageFormat::Png).unwrap();
    mesh.images = vec![Image { mime: "image/png".into(), bytes: bytes.into(), ..Image::default() }];
    mesh.textures = vec![Texture { image: Some(0), ..Texture::default() }];
    let transform = TextureUse::IDENTITY;
    let base_texture = Some(TextureUse { texture: 0, tex_coord: 0, transform });
    mesh.materials = vec![Material { base_texture, ..Material::default() }];
    mesh
}

/// Of a level, the share of the triangles right of the middle.
fn share_right(mesh: &Mesh) -> f64 {
    let is_right =
        |f: &&[u32; 3]| f.iter().map(|v| mesh.positions[*v as usize].x).sum::<f64>() > 0.0;
    mesh.faces.iter().filter(is_right).count() as f64 / mesh.faces.len() as f64
}

/// A texture of noise hides what becomes of the hills beneath it.
#[test]
fn triangles_go_where_differences_are_visible() {
    let input = write_glb(&hills()).unwrap();
    let of = |metric| {
        let mut spec = spec(metric, 1200);
        (spec.render.n_views, spec.render.image_size) = (8, 256);
        job(&spec, "hills.glb", &input, "cpu")
    };
    let (luminance, perceptual) = (of(Metric::Luminance), of(Metric::Perceptual));
    assert_eq!(perceptual.report()["chosen"]["metric"]["why"], "asked");
    let shares = [&luminance, &perceptual].map(|done| share_right(&level(done)));
    eprintln!("triangles where nothing hides them: {shares:.3?}");
    assert!(shares[1] > shares[0] + 0.1, "{shares:?}");
    // d2 is of what is visible: less than all there is.
    let original = read("hills.glb", &input, &Limits::default()).unwrap().mesh;
    let mesh = level(&perceptual);
    let [all, visible] =
        [metric::Metric::Luminance, metric::Metric::Perceptual].map(|m| d2(&original, &mesh, m));
    assert!(0.0 < visible && visible < all, "{visible}, of {all}");
}
