//! The files of a result.

use std::{fmt::Write as _, fs, path::Path};

use serde::Serialize;
use serde_json::{Value, json};

use crate::{
    compare,
    io::IngestReport,
    jobs::{event::EnergySample, spec::Spec},
    mesh::{Mesh, Stage},
    render::adapters,
};

use super::{
    chain,
    chosen::{Chosen, Facts},
    critic::look,
    gauge::Gauge,
    levels::{Level, Levels, Optimized},
    params,
    pipeline::PipelineError,
    recorder::Recorder,
    stopped::StoppedBy,
    switching::Switching,
    vanished::Vanished,
};

/// No screen is higher, in pixels: what [`Spec::screen_size`] may be.
const TALLEST_SCREEN: f64 = 65_536.0;

const GLB: &str = "model/gltf-binary";
/// The evaluator that needs no adapter.
const NATIVE: &str = "native";

/// What a stage cost.
#[derive(Clone, Debug, Serialize)]
pub struct StageFigures {
    /// `memoryless`, `image` or `optimize`.
    pub stage: &'static str,
    /// Who judged: `native` or the adapter's name.
    pub device: String,
    /// Seconds, set-up included.
    pub seconds: f64,
    /// Of these, seconds of set-up: pictures of the original, measuring devices.
    pub setup_secs: f64,
    /// Candidate moves judged.
    pub evaluations: u64,
    /// Per second, set-up left out.
    pub evaluations_per_second: f64,
    /// Edges collapsed by a stage that simplifies.
    pub collapses: u64,
    /// Edits made by optimization.
    pub edits: u64,
    /// By the job's clock.
    #[serde(skip)]
    prepared_secs: f64,
    #[serde(skip)]
    begun_secs: Option<f64>,
}

impl StageFigures {
    /// A stage gets ready; now, as everywhere here, by the job's clock.
    pub fn prepare(stage: Stage, now_secs: f64) -> Self {
        Self {
            stage: stage.name(),
            device: String::new(),
            seconds: 0.0,
            setup_secs: 0.0,
            evaluations: 0,
            evaluations_per_second: 0.0,
            collapses: 0,
            edits: 0,
            prepared_secs: now_secs,
            begun_secs: None,
        }
    }

    /// It is ready: set-up is over. Only the first call counts.
    pub fn start(&mut self, device: &str, now_secs: f64) {
        if self.begun_secs.is_none() {
            self.device = device.into();
            self.begun_secs = Some(now_secs);
            self.setup_secs = now_secs - self.prepared_secs;
        }
    }

    /// A stage without set-up begins.
    pub fn begin(stage: Stage, device: &str, now_secs: f64) -> Self {
        let mut figures = Self::prepare(stage, now_secs);
        figures.start(device, now_secs);
        figures
    }

    /// Adds work done.
    pub fn add(&mut self, collapses: u64, evaluations: u64) {
        self.collapses += collapses;
        self.evaluations += evaluations;
    }

    /// The stage is over.
    #[must_use]
    pub fn end(mut self, now_secs: f64) -> Self {
        let running = self.begun_secs.map_or(0.0, |begun| now_secs - begun);
        self.seconds = now_secs - self.prepared_secs;
        self.evaluations_per_second = self.evaluations as f64 / running.max(1e-9);
        self
    }
}

/// What `report.json` is made of.
pub(super) struct Attempt<'a> {
    /// The job.
    pub spec: &'a Spec,
    /// What was read.
    pub ingest: &'a IngestReport,
    /// What its settings depend on.
    pub facts: Facts<'a>,
    /// What measures levels.
    pub gauge: &'a Gauge<'a>,
    /// What the stages cost.
    pub figures: &'a [StageFigures],
    /// Triangles of the original that no run-time view sees, if they were drawn.
    pub n_unseen: Option<usize>,
}

#[derive(Serialize)]
struct ReportFile<'a> {
    version: &'static str,
    seed: u64,
    device: &'a str,
    /// What the system says of the device; null for the native evaluator.
    adapter: Option<Value>,
    input: &'a IngestReport,
    /// Triangles of the original that are in front in no pixel of the run-time pictures; absent
    /// without pictures.
    never_seen_triangles: Option<usize>,
    spec: &'a Spec,
    chosen: Chosen,
    levels: Vec<LevelReport<'a>>,
    stages: &'a [StageFigures],
    records: u32,
    seconds: f64,
}

#[derive(Serialize)]
struct LevelReport<'a> {
    file: String,
    /// Triangles asked for, if any were.
    asked: Option<u32>,
    triangles: usize,
    vertices: usize,
    /// On the run-time views, percent of full scale; absent without pictures.
    d2_percent: Option<f64>,
    energy: Option<u64>,
    stopped_by: StoppedBy,
    /// Distance from the centre, in bounding radii, from which on the level may stand in for the original.
    switch_distance_radii: Option<f64>,
    /// How high the bounding sphere may be on the screen, in pixels, for that; absent where no screen is too high.
    screen_size_pixels: Option<f64>,
    /// Size of the file.
    bytes: usize,
    /// Triangles of the level that are in front in no pixel of the run-time pictures.
    never_seen_triangles: Option<usize>,
    /// Parts of the original of which nothing is left; absent for a level that came with the job.
    parts_vanished: Option<Vanished>,
    /// Absent where the level was not optimized.
    #[serde(skip_serializing_if = "Option::is_none")]
    optimization: Option<&'a Optimized>,
}

fn adapter(device: &str) -> Option<Value> {
    let mut known = if device == NATIVE { Vec::new() } else { adapters() }.into_iter();
    let found = known.find(|adapter| adapter.name == device)?;
    Some(json!({ "name": found.name, "kind": found.kind, "driver": found.driver }))
}

/// Writes every artifact and tells of each.
pub(super) fn write_all(
    out_dir: &Path,
    original: &Mesh,
    levels: &Levels,
    recorder: &mut Recorder<'_>,
    attempt: &Attempt<'_>,
) -> Result<(), PipelineError> {
    let progressive = recorder.finish()?;
    fs::create_dir_all(out_dir)?;
    let mut out = Output { dir: out_dir, recorder };
    let mut reports = Vec::new();
    let options = params::glb_options(attempt.spec);
    for (i, level) in levels.in_order().enumerate() {
        let file = format!("lod-{i}.glb");
        let glb = attempt.gauge.glb(&level.mesh)?;
        out.write(&file, GLB, &glb)?;
        let report = level_report((file, glb.len()), level, original, attempt.gauge);
        if let Some(note) = report.parts_vanished.as_ref().and_then(|v| v.note(&level.name())) {
            out.recorder.note("PARTS_VANISHED", &note)?;
        }
        reports.push(report);
    }
    let distances: Vec<_> = reports.iter().map(|r| r.switch_distance_radii).collect();
    if let Some(bytes) = chain::file(levels, &distances, options)? {
        out.write("lods.glb", GLB, &bytes)?;
    }
    out.write("progressive.lkpm", "application/octet-stream", &progressive)?;
    write_pictures(&mut out, attempt.spec, original, levels)?;
    let samples = &out.recorder.samples;
    let csv = energy_csv(samples);
    let plots = plots(samples, reports.iter().map(|r| r.triangles as u32).collect());
    out.write("energy.csv", "text/csv", csv.as_bytes())?;
    for (name, plot) in plots {
        out.write(name, "image/svg+xml", plot.as_bytes())?;
    }
    let device = attempt.figures.last().map_or(NATIVE, |f| f.device.as_str());
    let report = ReportFile {
        version: env!("CARGO_PKG_VERSION"),
        seed: attempt.spec.seed,
        device,
        adapter: adapter(device),
        input: attempt.ingest,
        never_seen_triangles: attempt.n_unseen,
        spec: attempt.spec,
        chosen: Chosen::of(attempt.spec, attempt.ingest, &attempt.facts),
        levels: reports,
        stages: attempt.figures,
        records: out.recorder.n_records(),
        seconds: out.recorder.clock().glance(),
    };
    let json = serde_json::to_vec_pretty(&report)
        .map_err(|e| PipelineError::Machine(format!("cannot write report.json: {e}")))?;
    out.write("report.json", "application/json", &json)
}

struct Output<'a, 'r> {
    dir: &'a Path,
    recorder: &'a mut Recorder<'r>,
}

impl Output<'_, '_> {
    fn write(&mut self, name: &str, media_type: &str, bytes: &[u8]) -> Result<(), PipelineError> {
        fs::write(self.dir.join(name), bytes)?;
        self.recorder.artifact(name, media_type, bytes.len() as u64)
    }
}

fn level_report<'a>(
    (file, bytes): (String, usize),
    level: &'a Level,
    original: &Mesh,
    gauge: &Gauge<'_>,
) -> LevelReport<'a> {
    let deviation = gauge.switching().deviation_radii(&level.mesh);
    let screen_size = deviation.map(Switching::screen_size);
    LevelReport {
        file,
        asked: level.budget.triangles,
        triangles: level.mesh.faces.len(),
        vertices: level.mesh.positions.len(),
        d2_percent: level.d2,
        energy: level.energy,
        stopped_by: level.stopped_by,
        switch_distance_radii: deviation.map(Switching::distance_radii),
        screen_size_pixels: screen_size.filter(|pixels| *pixels <= TALLEST_SCREEN),
        bytes,
        never_seen_triangles: level.n_unseen,
        parts_vanished: Vanished::of(original, &level.mesh),
        optimization: level.optimized.as_ref(),
    }
}

fn write_pictures(
    out: &mut Output<'_, '_>,
    spec: &Spec,
    original: &Mesh,
    levels: &Levels,
) -> Result<(), PipelineError> {
    let chain: Vec<&Mesh> = levels.in_order().map(|l| &l.mesh).collect();
    let drawn = look(spec, original);
    let has_normals = spec.optimize.normals;
    let like =
        |params: compare::SheetParams| params.of_surface(&drawn).with_stored_normals(has_normals);
    let params = like(compare::SheetParams::default());
    let sheets = compare::sheets(original, &chain, &params);
    for (i, png) in sheets.iter().enumerate() {
        out.write(&format!("contact-{i}.png"), "image/png", png)?;
    }
    let params = like(compare::SheetParams::chain(compare::Axis::Y));
    let png = compare::sheet_multi(original, &chain, &params);
    out.write("levels.png", "image/png", &png)
}

fn energy_csv(samples: &[EnergySample]) -> String {
    let mut csv = String::from(
        "seq,stage,evaluations,seconds,triangles,energy,d2,level,energy_ratio,d2_unseen,turn\n",
    );
    let number = |x: Option<f64>| x.map_or_else(String::new, |x| format!("{x:.6}"));
    for (seq, s) in samples.iter().enumerate() {
        let energy = s.energy.map_or_else(String::new, |e| e.to_string());
        let [level, turn] =
            [s.level, s.turn].map(|n| n.map_or_else(String::new, |n| n.to_string()));
        let [d2, ratio, unseen] = [s.d2, s.energy_ratio, s.d2_unseen].map(number);
        // Writing to a String cannot fail.
        let _ = writeln!(
            csv,
            "{seq},{},{},{:.3},{},{energy},{d2},{level},{ratio},{unseen},{turn}",
            s.stage, s.evaluations, s.seconds, s.triangles
        );
    }
    csv
}

/// The curve of the whole job, and that of the optimization closer up, where they have points.
fn plots(samples: &[EnergySample], levels: Vec<u32>) -> Vec<(&'static str, String)> {
    let all: Vec<_> = samples.iter().map(|s| curve_point(s, s.d2)).collect();
    let optimized = samples.iter().filter(|s| s.energy_ratio.is_some());
    let optimized: Vec<_> =
        optimized.map(|s| curve_point(s, s.energy_ratio.map(|r| 100.0 * r))).collect();
    let mut plots = Vec::new();
    if all.iter().any(|p| p.d2.is_some()) {
        let params = compare::PlotParams { levels, ..compare::PlotParams::default() };
        plots.push(("energy.svg", compare::energy_plot(&all, &params)));
    }
    if !optimized.is_empty() {
        let params = compare::PlotParams {
            title: "Energy of each level while optimizing".into(),
            x: compare::PlotX::Evaluations,
            y: "energy, percent of the start",
            ..compare::PlotParams::default()
        };
        plots.push(("optimization.svg", compare::energy_plot(&optimized, &params)));
    }
    plots
}

fn curve_point(s: &EnergySample, d2: Option<f64>) -> compare::CurvePoint {
    let stage = [Stage::Memoryless, Stage::Image, Stage::Optimize]
        .into_iter()
        .find(|stage| stage.name() == s.stage)
        .unwrap_or(Stage::Image);
    let EnergySample { evaluations, triangles, level, .. } = *s;
    compare::CurvePoint { stage, evaluations, triangles, level, d2 }
}
