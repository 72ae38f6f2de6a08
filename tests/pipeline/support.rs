//! Runs a job in a temporary folder and collects what it said and left.

use std::{collections::BTreeMap, fs, io::Write as _, ops::ControlFlow, path::PathBuf};

use lookalike::{
    compare::sample_mesh,
    io::write_glb,
    jobs::{
        event::{EnergySample, Report},
        spec::{Optimize, Spec},
    },
    progressive::Reader,
    tape::Tape,
    worker::pipeline::{DeviceChoice, Inputs, PipelineError, run},
};

/// What a job left: artifacts by name, notes as (code, text).
pub struct Done {
    pub files: BTreeMap<String, Vec<u8>>,
    pub notes: Vec<(String, String)>,
    /// Collapses of the stream.
    pub records: u64,
    /// Edits of the stream that optimize each level, encoded.
    pub edits: BTreeMap<u32, Vec<u8>>,
    pub samples: Vec<EnergySample>,
    pub result: Result<(), PipelineError>,
}

impl Done {
    pub fn has_note(&self, code: &str) -> bool {
        self.notes.iter().any(|n| n.0 == code)
    }

    pub fn report(&self) -> serde_json::Value {
        serde_json::from_slice(&self.files["report.json"]).unwrap()
    }

    /// Everything that must not depend on time, threads or devices.
    pub fn timeless(&self) -> BTreeMap<String, Vec<u8>> {
        let mut files = self.files.clone();
        files.remove("report.json");
        if let Some(csv) = files.get_mut("energy.csv") {
            let text = String::from_utf8(csv.clone()).unwrap();
            // The seconds column is the fourth.
            let rows = text.lines().map(|l| {
                l.split(',').enumerate().filter(|(i, _)| *i != 3).map(|c| c.1).collect::<Vec<_>>()
            });
            *csv = rows.map(|r| r.join(",") + "\n").collect::<String>().into_bytes();
        }
        files
    }
}

/// Runs a job on the given evaluator.
pub fn job(spec: &Spec, name: &str, input: &[u8], device: &str) -> Done {
    job_on(spec, &Inputs::of(name, input), device)
}

/// The same on any inputs.
pub fn job_on(spec: &Spec, inputs: &Inputs<'_>, device: &str) -> Done {
    job_with(spec, inputs, (device, &Tape::off(), false), |_| ())
}

/// The same with what the tape knows, which may be where a run was that goes on here; `hear` hears every report.
pub fn job_with(
    spec: &Spec,
    inputs: &Inputs<'_>,
    (device, tape, goes_on): (&str, &Tape, bool),
    mut hear: impl FnMut(&Report),
) -> Done {
    let dir = tempfile::tempdir().unwrap();
    let mut notes = Vec::new();
    let mut counts: BTreeMap<Option<u32>, u64> = BTreeMap::new();
    let mut edits: BTreeMap<u32, Vec<u8>> = BTreeMap::new();
    let mut samples = Vec::new();
    let device = DeviceChoice(device.into());
    let result = run(spec, inputs, dir.path(), (&device, tape), &mut |report| {
        hear(&report);
        match report {
            Report::Note { code, text } => notes.push((code, text)),
            Report::Records { level, first, count, bytes } => {
                // The first of them were told before.
                let n = counts.entry(level).or_insert(if goes_on { first } else { 0 });
                assert_eq!(first, *n, "records come in order, without gaps");
                assert_eq!(count_records(&bytes), count);
                *n += u64::from(count);
                if let Some(level) = level {
                    edits.entry(level).or_default().extend(bytes);
                }
            }
            Report::Sample(sample) => samples.push(sample),
            _ => {}
        }
        ControlFlow::Continue(())
    });
    let mut files = BTreeMap::new();
    for entry in fs::read_dir(dir.path()).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        files.insert(name, fs::read(path).unwrap());
    }
    let records = counts.get(&None).copied().unwrap_or(0);
    Done { files, notes, records, edits, samples, result }
}

/// Levels of so many triangles, simplified and not optimized.
pub fn simplify_only(triangles: Vec<u32>) -> Spec {
    let optimize = Optimize { max_evaluations: Some(0), ..Optimize::default() };
    Spec { optimize, ..Spec::new(triangles) }
}

/// Every level comes out of the progressive file as it was written; the file, opened.
pub fn check_levels(done: &Done) -> Reader<'_> {
    let reader = Reader::open(&done.files["progressive.lkpm"]).unwrap();
    for level in &reader.header().levels {
        let mesh = reader.extract_level(&level.name).unwrap();
        let wanted = &done.files[&format!("{}.glb", level.name)];
        assert!(&write_glb(&mesh).unwrap() == wanted, "{}", level.name);
        mesh.check().unwrap();
        // The chain alone gives what optimization, if there was any, began with.
        let before = reader.extract(level.faces).unwrap();
        assert!(before == reader.extract_level_before_edits(&level.name).unwrap());
    }
    reader
}

/// Records in a chunk of the stream.
fn count_records(mut bytes: &[u8]) -> u32 {
    let mut count = 0;
    while !bytes.is_empty() {
        let (_, n_bytes) = lookalike::progressive::decode_edit(bytes).unwrap();
        bytes = &bytes[n_bytes..];
        count += 1;
    }
    count
}

/// The bytes of a sample model of about so many triangles.
pub fn sample(triangles: usize) -> Vec<u8> {
    write_glb(&sample_mesh(3, triangles)).unwrap()
}

/// A real model, or a visible skip where the models are absent.
pub fn real_model(file: &str) -> Option<Vec<u8>> {
    let models = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/models");
    let bytes = fs::read(models.join(file)).ok();
    if bytes.is_none() {
        let _ =
            writeln!(std::io::stderr(), "skipped: {} is not there", models.join(file).display());
    }
    bytes
}
