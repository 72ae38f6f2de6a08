//! What a specification leaves to the model: topology, the size of the pictures, where image-driven simplification
//! begins, and whether colours need pictures of their own. Rules are tables; `report.json` says what was chosen, and why (`chosen.rs`).
//!
//! Measured at effort fast on ten models at a quarter, a tenth, 3% and 1% of their triangles; unseen d2 as a share of
//! that with 256² and 4 times the finest level, geometric means, and what it costs in processor time:
//!
//! | | finest level, triangles | d2 | time |
//! |---|---|---:|---:|
//! | 512², scans in one piece (bunny, armadillo, frog) | 482 to 864 | .99 | 2.3 |
//! | likewise | 1,450 to 2,594 | .93 | 1.8 |
//! | likewise | 4,834 to 21,620 | .91 | 1.6 |
//! | 512², textures or several parts | 38 to 183 | 1.01 | 1.9 |
//! | likewise | 315 to 1,103 | .95 | 2.0 |
//! | likewise | 1,464 to 27,583 | .87 | 2.1 |
//! | 1,024² beside 512², scans | 4,834 to 21,620 | .96 | 2.2 |
//! | 1,024² beside 512², textures or several parts | 966 to 6,916 | .93 | 2.3 |
//! | 8 times, textures or several parts | 1% and 3% of the model | .98 | 1.2 |
//! | 8 times, 512², textures or several parts | 3% | .97 | 1.1 |
//! | likewise | 10% | 1.02 | 1.2 |
//!
//! Pictures are a worse guide than geometry where triangles are smaller than they show: unseen d2 of the dragon
//! (871,414) at effort fast as a share of memoryless simplification, by the pixels that a triangle of the level has in
//! all pictures together, image-driven from 1.3 to 1.5 times the level:
//!
//! | | level | pixels a triangle | simplified | and optimized |
//! |---|---:|---:|---:|---:|
//! | 512² | 87,130 | 60 | 1.07 | 1.10 |
//! | from 4 times, which begins at 15 pixels and takes eight times as long | | | 1.12 | 1.09 |
//! | 512² | 60,000 | 87 | 1.01 | .99 |
//! | 512² | 40,000 | 131 | .96 | .92 |
//! | 1,024² | 87,130 | 241 | .98 | .94 |
//!
//! 20 views throughout: with 12 of them ten models at 1% to 10% (pictures as above, before coordinates were unknowns) look
//! worse, each of them, by 7% in the geometric mean (bunny and house by .4%, armadillo 2, spot 3, barramundi 3, ship 4,
//! helmet 5, corset 7, frog 12, the engine, of which most is hidden, 34), for three quarters of the time. 24 are those
//! that levels are judged by, which therefore cannot judge them. 8 times brings bunny and armadillo nothing (1.00). Memory
//! grows with the pictures: 150 to 320, 300 to 630 and 920 to 1,390 MiB for 256², 512² and 1,024².

use crate::{
    io::IngestReport,
    jobs::spec::{Effort, Method, Metric, Spec, Topology},
};

/// What a specification is settled by.
pub(super) struct Model<'a> {
    /// The original, as it was read.
    pub report: &'a IngestReport,
    /// Triangles of the original.
    pub n_triangles: usize,
    /// Triangles of what some tool has simplified it to.
    pub n_simplified: Option<usize>,
    /// Whether there is anything but greys to be seen, on either; asked only where that matters.
    pub shows_colours: bool,
}

/// What suits a kind of model.
struct Row {
    kind: &'static str,
    /// A picture is large enough if all views together have so many pixels for each triangle of the finest level;
    /// at 512² half of that will do.
    pixels_per_triangle: u64,
    /// Multiple of the finest level at which the image-driven stage begins.
    start_factor: f64,
}

/// Geometry alone is a good guide.
const PLAIN: Row = Row {
    kind: "a model of one piece without textures",
    pixels_per_triangle: 870,
    start_factor: 4.0,
};
/// It is a bad one.
const DRESSED: Row = Row {
    kind: "a model of several parts or with textures",
    pixels_per_triangle: 2600,
    start_factor: 8.0,
};

/// Triangles that have fewer pixels than this, all pictures together, are left to geometry.
const LEAST_PIXELS: u64 = 90;
/// Pixels along a side of a picture.
const SIZES: [u32; 3] = [256, 512, 1024];
/// The image-driven stage begins at no more than this share of the original, or at the least multiple.
const MOST_TO_START_WITH: f64 = 1.0 / 3.0;

impl Model<'_> {
    /// The specification with everything decided.
    pub fn settle(&self, asked: &Spec) -> Spec {
        let mut spec = asked.clone().resolved(self.n_triangles);
        if spec.topology == Topology::Auto {
            spec.topology = self.topology();
        }
        if spec.render.metric == Metric::Rgb && !self.shows_colours {
            spec.render.metric = Metric::Luminance;
        }
        if spec.render.image_size == 0 {
            spec.render.image_size = self.image_size(&spec);
        }
        if spec.start_factor == 0.0 {
            let are_pictures_asked = asked.render.image_size > 0;
            spec.start_factor = self.start_factor(&spec, are_pictures_asked);
        }
        spec
    }

    fn topology(&self) -> Topology {
        if self.report.components > 1 || self.report.non_manifold_edges > 0 {
            Topology::Free
        } else {
            Topology::Preserve
        }
    }

    fn row(&self) -> &'static Row {
        let is_textured = self.report.layers.iter().any(|layer| layer.contains("texture"));
        if self.report.components > 1 || is_textured { &DRESSED } else { &PLAIN }
    }

    /// Below 1 where levels are finer than pictures show: these are left to geometry, unless somebody asked for these
    /// pictures, or pictures are to end a level.
    fn start_factor(&self, spec: &Spec, are_pictures_asked: bool) -> f64 {
        let factor = self.row().start_factor;
        let finest = self.finest(spec);
        let start = factor * finest.unwrap_or(self.n_triangles) as f64;
        let is_little = start <= MOST_TO_START_WITH * self.n_triangles as f64;
        let factor = if is_little { factor } else { PLAIN.start_factor };
        let is_needed = are_pictures_asked || spec.max_d2.iter().any(|d2| *d2 > 0.0);
        // A multiple of what was asked for, even where that is more than the model has.
        match spec.triangles.iter().max() {
            Some(n) if spec.method == Method::Image && !is_needed => {
                factor.min(most_shown(spec) as f64 / f64::from(*n))
            }
            _ => factor,
        }
    }

    /// The least size that has pixels enough.
    fn image_size(&self, spec: &Spec) -> u32 {
        if spec.method == Method::Memoryless && !spec.optimizes() {
            return SIZES[0];
        }
        let n_views = spec.render.view_count() as u64;
        let wanted = self.row().pixels_per_triangle * self.finest(spec).unwrap_or(0) as u64;
        let has = |size: u32| n_views * u64::from(size).pow(2);
        match spec.effort {
            _ if has(SIZES[0]) >= wanted => SIZES[0],
            Effort::Best if 2 * has(SIZES[1]) < wanted => SIZES[2],
            _ => SIZES[1],
        }
    }

    /// Triangles of the finest level, as far as they were asked for in triangles.
    pub fn finest(&self, spec: &Spec) -> Option<usize> {
        let asked = spec.triangles.iter().map(|n| (*n as usize).min(self.n_triangles)).max();
        self.n_simplified.or(asked)
    }

    /// Why pictures are so large.
    pub fn why_image_size(&self, spec: &Spec) -> String {
        let (Row { kind, pixels_per_triangle, .. }, n) =
            (self.row(), self.finest(spec).unwrap_or(0));
        format!(
            "default: {kind} is seen best with {pixels_per_triangle} pixels or more, of all views together, for each of \
             {n} triangles; 1,024 only at effort best"
        )
    }

    /// Why the image-driven stage begins where it does.
    pub fn why_start_factor(&self, spec: &Spec, are_pictures_asked: bool) -> String {
        let Row { kind, start_factor, .. } = self.row();
        let why = format!(
            "default: {start_factor} for {kind}, {} where that is more than a third of it",
            PLAIN.start_factor
        );
        if are_pictures_asked {
            return why;
        }
        format!(
            "{why}; and no more than {} triangles, which have {LEAST_PIXELS} pixels each in all pictures together: finer \
             ones are simplified by geometry alone",
            most_shown(spec)
        )
    }
}

/// The most triangles that pictures show well enough.
fn most_shown(spec: &Spec) -> u64 {
    spec.render.view_count() as u64 * u64::from(spec.render.image_size).pow(2) / LEAST_PIXELS
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        io,
        jobs::spec::{Optimize, Render},
    };

    /// Some triangles apart, or one; the report is all that counts.
    fn report(n_parts: usize, has_textures: bool) -> IngestReport {
        let corners = |k: usize| format!("v 0 0 {k}\nv 1 0 {k}\nv 0 1 {k}\nvt 0 0\n");
        let uv = if has_textures { "/1" } else { "" };
        let face = |k: usize| {
            let [a, b, c] = [1, 2, 3].map(|c| 3 * k + c);
            format!("f {a}{uv} {b}{uv} {c}{uv}\n")
        };
        let parts = 0..n_parts;
        let text: String = parts.clone().map(corners).chain(parts.map(face)).collect();
        io::read("a.obj", text.as_bytes(), &io::Limits::default()).unwrap().report
    }

    fn check(report: &IngestReport, spec: &Spec, wanted: (u32, f64)) {
        let model = Model { report, n_triangles: 70_000, n_simplified: None, shows_colours: false };
        let found = model.settle(spec);
        assert_eq!((found.render.image_size, found.start_factor), wanted, "{:?}", spec.triangles);
    }

    #[test]
    fn pictures_and_start_follow_from_model_and_levels() {
        let (plain, parts, textured) = (report(1, false), report(3, false), report(1, true));
        let of = |n: u32, effort| Spec { effort, ..Spec::new(vec![100, n]) };
        for (n, scan, dressed) in [
            (500, (256, 4.0), (256, 8.0)),
            (1_400, (256, 4.0), (512, 8.0)),
            (1_600, (512, 4.0), (512, 8.0)),
            (5_000, (512, 4.0), (1024, 4.0)),
            (13_000, (1024, 4.0), (1024, 4.0)),
        ] {
            let best = of(n, Effort::Best);
            check(&plain, &best, scan);
            check(&parts, &best, dressed);
            check(&textured, &best, dressed);
            for effort in [Effort::Fast, Effort::Balanced] {
                check(&plain, &of(n, effort), (scan.0.min(512), scan.1));
            }
        }
        // All 70,000 triangles: those that are more than pictures show are left to geometry.
        for (effort, size, n_shown) in
            [(Effort::Best, 1024, 233_016.0), (Effort::Balanced, 512, 58_254.0)]
        {
            let spec = of(4_000_000, effort);
            check(&plain, &spec, (size, n_shown / 4_000_000.0));
            check(&plain, &Spec { max_d2: vec![1.0, 0.0], ..spec.clone() }, (size, 4.0));
            let render = Render { image_size: 64, ..Render::default() };
            check(&plain, &Spec { render, ..spec }, (64, 4.0));
        }
    }

    #[test]
    fn what_was_asked_for_stays() {
        let mut spec = Spec { start_factor: 3.0, ..Spec::new(vec![20_000]) };
        spec.render.image_size = 64;
        check(&report(1, false), &spec, (64, 3.0));
    }

    #[test]
    fn greys_need_no_pictures_of_their_colours() {
        let report = report(1, false);
        for (shows_colours, asked, wanted) in [
            (false, Metric::Rgb, Metric::Luminance),
            (true, Metric::Rgb, Metric::Rgb),
            (true, Metric::Luminance, Metric::Luminance),
        ] {
            let mut spec = Spec::new(vec![500]);
            spec.render.metric = asked;
            let model =
                Model { report: &report, n_triangles: 70_000, n_simplified: None, shows_colours };
            assert_eq!(model.settle(&spec).render.metric, wanted);
        }
    }

    #[test]
    fn fewer_views_are_larger_and_geometry_needs_few_pixels() {
        let mut spec = Spec::new(vec![1_400]);
        spec.render.n_views = 6;
        check(&report(1, false), &spec, (512, 4.0));
        spec = Spec { method: Method::Memoryless, ..Spec::new(vec![20_000]) };
        check(&report(1, false), &spec, (256, 4.0));
        spec.optimize = Optimize { max_evaluations: Some(1000), ..Optimize::default() };
        check(&report(1, false), &spec, (512, 4.0));
    }

    #[test]
    fn a_mesh_that_came_simplified_is_the_finest_level() {
        let report = report(1, false);
        let n_simplified = Some(2_000);
        let model =
            Model { report: &report, n_triangles: 70_000, n_simplified, shows_colours: false };
        assert_eq!(model.settle(&Spec::new(Vec::new())).render.image_size, 512);
    }
}
