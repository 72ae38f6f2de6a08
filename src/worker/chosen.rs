//! What a job was run with, and why: for people who read its report.

use serde::Serialize;

use crate::{
    io::IngestReport,
    jobs::spec::{Effort, Method, Metric, Spec, Topology},
};

use super::{automatic::Model, budget};

/// A setting.
#[derive(Serialize)]
struct Choice<T> {
    value: T,
    why: String,
}

/// See the module.
#[derive(Serialize)]
pub(super) struct Chosen {
    image_size: Choice<u32>,
    views: Choice<usize>,
    metric: Choice<Metric>,
    effort: Choice<Effort>,
    start_factor: Choice<f64>,
    topology: Choice<Topology>,
    /// Evaluations for all levels together; none where another limit was asked for.
    optimization_evaluations: Choice<Option<u64>>,
    locked_vertices: Choice<usize>,
}

/// What the choices depend on besides the specification.
pub(super) struct Facts<'a> {
    /// The specification as it came.
    pub asked: &'a Spec,
    /// Vertices that stay where they are.
    pub n_locked: usize,
    /// Triangles of the levels that are optimized, before that.
    pub n_optimized: usize,
    /// What decided the rest.
    pub model: &'a Model<'a>,
}

impl Chosen {
    /// Of a job with this specification, `facts.asked` with what was left to the model decided.
    pub fn of(spec: &Spec, model: &IngestReport, facts: &Facts<'_>) -> Self {
        let default = Spec::new(Vec::new());
        let (render, usual) = (&spec.render, &default.render);
        Self {
            image_size: image_size(spec, facts),
            views: views(render.view_count(), usual.view_count()),
            metric: metric(spec, facts),
            effort: plain(spec.effort, default.effort),
            start_factor: start_factor(spec, facts),
            topology: topology(spec, model, facts),
            optimization_evaluations: evaluations(spec, facts),
            locked_vertices: locked(spec, facts),
        }
    }
}

/// Of a setting that a specification always has: whoever asks for the default gets the default.
fn plain<T: PartialEq>(value: T, default: T) -> Choice<T> {
    let why = if value == default { "default" } else { "asked" };
    Choice { value, why: why.into() }
}

fn views(value: usize, default: usize) -> Choice<usize> {
    let why = match value {
        n if n == default => "default: fewer look worse, on every kind of model",
        _ => "asked",
    };
    Choice { value, why: why.into() }
}

fn image_size(spec: &Spec, facts: &Facts<'_>) -> Choice<u32> {
    let is_asked = facts.asked.render.image_size > 0;
    let why = if is_asked { "asked".into() } else { facts.model.why_image_size(spec) };
    Choice { value: spec.render.image_size, why }
}

fn metric(spec: &Spec, facts: &Facts<'_>) -> Choice<Metric> {
    let (value, asked) = (spec.render.metric, facts.asked.render.metric);
    if value == asked {
        return plain(value, Metric::default());
    }
    let why =
        "asked was rgb: the model shows nothing but greys, whose channels are as their luminance";
    Choice { value, why: why.into() }
}

fn start_factor(spec: &Spec, facts: &Facts<'_>) -> Choice<f64> {
    let is_asked = facts.asked.start_factor > 0.0;
    let are_pictures_asked = facts.asked.render.image_size > 0;
    let why = if is_asked {
        "asked".into()
    } else {
        facts.model.why_start_factor(spec, are_pictures_asked)
    };
    Choice { value: spec.start_factor, why }
}

fn topology(spec: &Spec, model: &IngestReport, facts: &Facts<'_>) -> Choice<Topology> {
    let why = if facts.asked.topology != Topology::Auto {
        "asked".to_owned()
    } else if spec.topology == Topology::Free {
        let (parts, edges) = (model.components, model.non_manifold_edges);
        format!("the model has {parts} parts and {edges} edges of more than two triangles")
    } else {
        "the model is one piece".to_owned()
    };
    Choice { value: spec.topology, why }
}

fn evaluations(spec: &Spec, facts: &Facts<'_>) -> Choice<Option<u64>> {
    let n = facts.n_optimized;
    let value = budget::evaluations(spec, n);
    let why = match (spec.optimizes(), spec.optimize.is_automatic(), value) {
        (false, true, _) => "default: simplification by geometry alone is not optimized".to_owned(),
        (_, true, Some(value)) => {
            let each = value.checked_div(n as u64).unwrap_or(0);
            let effort = format!("{:?}", spec.effort).to_lowercase();
            format!("default: {each} for each of {n} triangles at effort {effort}")
        }
        (.., None) => "asked: a limit of seconds or of energy".to_owned(),
        _ => "asked".to_owned(),
    };
    Choice { value, why }
}

fn locked(spec: &Spec, facts: &Facts<'_>) -> Choice<usize> {
    let is_chain = spec.simplified.is_some() || spec.method != Method::Cluster;
    let why = match (facts.n_locked, spec.lock.is_empty()) {
        _ if !is_chain => "vertex clustering knows no locks",
        (0, true) => "default",
        (_, true) => "asked by the file",
        (_, false) => "asked, by the file or along edges",
    };
    Choice { value: facts.n_locked, why: why.into() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{io, jobs::spec::Optimize};
    use serde_json::{Value, json};

    fn chosen(asked: &Spec, topology: Topology) -> Value {
        let spec = Spec { topology, ..asked.clone() };
        // Three triangles apart.
        let points =
            "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 5\nv 1 0 5\nv 0 1 5\nv 0 0 9\nv 1 0 9\nv 0 1 9\n";
        let text = points.to_owned() + "f 1 2 3\nf 4 5 6\nf 7 8 9\n";
        let model = io::read("a.obj", text.as_bytes(), &io::Limits::default()).unwrap().report;
        let (n_triangles, n_simplified) = (70_000, None);
        let settled = Model { report: &model, n_triangles, n_simplified, shows_colours: false };
        let facts = Facts { asked, n_locked: 0, n_optimized: 500, model: &settled };
        serde_json::to_value(Chosen::of(&settled.settle(&spec), &model, &facts)).unwrap()
    }

    #[test]
    fn every_choice_has_its_reason() {
        let mut asked = Spec::new(vec![500]);
        let found = chosen(&asked, Topology::Free);
        for (field, value) in [("image_size", json!(256)), ("start_factor", json!(8.0))] {
            assert_eq!(found[field]["value"], value);
            let why = found[field]["why"].as_str().unwrap();
            assert!(why.contains("a model of several parts or with textures"), "{why}");
        }
        let why = "default: fewer look worse, on every kind of model";
        assert_eq!(found["views"], json!({ "value": 20, "why": why }));
        let why = "the model has 3 parts and 0 edges of more than two triangles";
        assert_eq!(found["topology"], json!({ "value": "free", "why": why }));
        let why = "default: 200 for each of 500 triangles at effort balanced";
        assert_eq!(found["optimization_evaluations"], json!({ "value": 100_000, "why": why }));
        assert_eq!(found["locked_vertices"], json!({ "value": 0, "why": "default" }));
        assert_eq!(found["metric"], json!({ "value": "luminance", "why": "default" }));
        asked.render.metric = Metric::Rgb;
        let found = chosen(&asked, Topology::Free);
        assert_eq!(found["metric"]["value"], "luminance");
        let why = found["metric"]["why"].as_str().unwrap();
        assert!(why.contains("nothing but greys"), "{why}");
        asked.render.image_size = 128;
        asked.topology = Topology::Preserve;
        asked.optimize = Optimize { until: Some(0.5), ..Optimize::default() };
        let found = chosen(&asked, Topology::Preserve);
        assert_eq!(found["image_size"], json!({ "value": 128, "why": "asked" }));
        assert_eq!(found["topology"], json!({ "value": "preserve", "why": "asked" }));
        let why = "asked: a limit of seconds or of energy";
        assert_eq!(found["optimization_evaluations"], json!({ "value": null, "why": why }));
    }
}
