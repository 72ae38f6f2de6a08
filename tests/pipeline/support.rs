//! Runs a job in a temporary folder and collects what it said and left.

use std::{collections::BTreeMap, fs, ops::ControlFlow, path::PathBuf};

use lookalike::{
    compare::sample_mesh,
    io::write_glb,
    jobs::{event::Report, spec::Spec},
    progressive::Reader,
    worker::pipeline::{DeviceChoice, PipelineError, run},
};

/// What a job left: artifacts by name, notes as (code, text).
pub struct Done {
    pub files: BTreeMap<String, Vec<u8>>,
    pub notes: Vec<(String, String)>,
    pub records: u64,
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
    let dir = tempfile::tempdir().unwrap();
    let (mut notes, mut records) = (Vec::new(), 0);
    let device = DeviceChoice(device.into());
    let result = run(spec, name, input, dir.path(), &device, &mut |report| {
        match report {
            Report::Note { code, text } => notes.push((code, text)),
            Report::Records { first, count, bytes } => {
                assert_eq!(first, records, "records come in order, without gaps");
                assert_eq!(count_records(&bytes), count);
                records += u64::from(count);
            }
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
    Done { files, notes, records, result }
}

/// Every level comes out of the progressive file as it was written; the file, opened.
pub fn check_levels(done: &Done) -> Reader<'_> {
    let reader = Reader::open(&done.files["progressive.lkpm"]).unwrap();
    for level in &reader.header().levels {
        let mesh = reader.extract(level.faces).unwrap();
        let wanted = &done.files[&format!("{}.glb", level.name)];
        assert_eq!(&write_glb(&mesh).unwrap(), wanted, "{}", level.name);
        mesh.check().unwrap();
    }
    reader
}

/// Records in a chunk of the stream.
fn count_records(mut bytes: &[u8]) -> u32 {
    let mut count = 0;
    while !bytes.is_empty() {
        let (_, n_bytes) = lookalike::progressive::decode_collapse(bytes).unwrap();
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
        eprintln!("skipped: {} is not there", models.join(file).display());
    }
    bytes
}
