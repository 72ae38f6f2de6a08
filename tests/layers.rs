//! Who may import whom: the table of ARCHITECTURE.md, checked against every source file.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test fails by panicking"
)]

use std::{
    collections::BTreeSet,
    fs,
    path::{Path, PathBuf},
};

/// Module → modules of this crate that it may import (itself always).
const MAY_IMPORT: [(&str, &[&str]); 19] = [
    ("intrinsics", &[]),
    ("mesh", &["intrinsics"]),
    ("io", &["mesh"]),
    ("progressive", &["mesh"]),
    ("memoryless", &["mesh", "intrinsics", "tape"]),
    ("cluster", &["mesh"]),
    ("tape", &[]),
    ("render", &["intrinsics", "tape"]),
    ("metric", &["mesh", "render"]),
    ("simplify", &["mesh", "memoryless", "metric", "render"]),
    ("optimize", &["mesh", "memoryless", "metric", "render", "simplify", "tape"]),
    ("compare", &["intrinsics", "mesh", "render", "metric"]),
    ("jobs", &[]),
    (
        "worker",
        &[
            "jobs",
            "mesh",
            "io",
            "progressive",
            "memoryless",
            "cluster",
            "render",
            "metric",
            "simplify",
            "optimize",
            "compare",
            "service",
            "tape",
        ],
    ),
    ("service", &["jobs", "telemetry"]),
    ("telemetry", &[]),
    ("config", &["jobs", "service"]),
    (
        "cli",
        &[
            "jobs",
            "mesh",
            "io",
            "progressive",
            "memoryless",
            "cluster",
            "render",
            "metric",
            "simplify",
            "optimize",
            "compare",
            "worker",
            "tape",
            "service",
            "telemetry",
            "config",
        ],
    ),
    ("main", &["cli", "telemetry"]),
];

/// External crate → the only modules that may name it. Wire stubs live in `service`; the worker
/// speaks to a server through them, and the command line is a client.
const SOLE_OWNERS: [(&str, &[&str]); 27] = [
    ("basisu", &["io"]),
    ("draco_core", &["io"]),
    ("gltf", &["io"]),
    ("gltf_json", &["io"]),
    ("rawzip", &["io"]),
    ("flate2", &["io"]),
    ("wgpu", &["render"]),
    ("bytemuck", &["render", "io"]),
    ("meshopt", &["cluster", "io"]),
    ("plotters", &["compare"]),
    ("sqlx", &["jobs"]),
    ("object_store", &["jobs"]),
    ("axum", &["telemetry"]),
    ("opentelemetry", &["telemetry"]),
    ("opentelemetry_otlp", &["telemetry"]),
    ("opentelemetry_sdk", &["telemetry"]),
    ("tonic", &["service", "worker", "cli"]),
    ("prost", &["service", "worker", "cli"]),
    ("prost_reflect", &["service"]),
    ("reqwest", &["service"]),
    ("tonic_web", &["service"]),
    ("tower_http", &["service"]),
    ("tokio_rustls", &["service"]),
    ("jsonwebtoken", &["service"]),
    ("governor", &["service"]),
    ("toml", &["service", "config"]),
    ("seccompiler", &["worker"]),
];

fn sources(dir: &Path, out: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, out);
        } else if path.extension().is_some_and(|e| e == "rs") {
            out.push(path);
        }
    }
}

/// `src/mesh/edit.rs` → `mesh`; `src/main.rs` → `main`.
fn module_of(path: &Path, src: &Path) -> String {
    let first = path.strip_prefix(src).unwrap().components().next().unwrap();
    first.as_os_str().to_string_lossy().trim_end_matches(".rs").to_owned()
}

/// Names that follow `prefix` in a source, at word boundaries, comments and strings aside.
fn names_after(text: &str, prefix: &str) -> BTreeSet<String> {
    let mut names = BTreeSet::new();
    for line in text.lines().map(|l| l.split("//").next().unwrap_or_default()) {
        for (at, _) in line.match_indices(prefix) {
            let before = line[..at].chars().next_back();
            if before.is_some_and(|c| c.is_alphanumeric() || c == '_' || c == ':') {
                continue;
            }
            let rest = &line[at + prefix.len()..];
            let end = rest.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(rest.len());
            names.insert(rest[..end].to_owned());
        }
    }
    names.remove("");
    names
}

/// Modules imported from this crate, `use crate::{a, b::c}` included.
fn imports(text: &str) -> BTreeSet<String> {
    let mut found = names_after(text, "crate::");
    found.extend(names_after(text, "lookalike::"));
    for (at, _) in text.match_indices("crate::{") {
        let mut depth = 0;
        let mut word = String::new();
        for c in text[at + "crate::".len()..].chars() {
            match c {
                '{' => depth += 1,
                '}' => depth -= 1,
                c if depth == 1 && (c.is_alphanumeric() || c == '_') => {
                    word.push(c);
                    continue;
                }
                _ => {}
            }
            if !word.is_empty() && (c == ':' || c == ',' || c == '}') {
                found.insert(std::mem::take(&mut word));
            }
            if c == ':' || c == ',' {
                word.clear();
            }
            if depth == 0 {
                break;
            }
            // Inside `a::{..}` or after `a::` only the first name counts.
            if c == ':' {
                word = String::from("\u{0}");
            }
        }
    }
    found.into_iter().filter(|n| !n.contains('\u{0}')).collect()
}

#[test]
fn modules_import_only_what_their_layer_allows() {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let modules: BTreeSet<&str> = MAY_IMPORT.iter().map(|m| m.0).collect();
    let mut files = Vec::new();
    sources(&src, &mut files);
    let mut faults = Vec::new();
    for file in files {
        let module = module_of(&file, &src);
        if module == "lib" {
            continue;
        }
        let text = fs::read_to_string(&file).unwrap();
        let Some((_, allowed)) = MAY_IMPORT.iter().find(|m| m.0 == module) else {
            faults.push(format!("{}: module `{module}` is not in the table", file.display()));
            continue;
        };
        for import in imports(&text) {
            let is_known = modules.contains(import.as_str());
            if is_known && import != module && !allowed.contains(&import.as_str()) {
                faults.push(format!("{}: {module} imports {import}", file.display()));
            }
        }
        for (owned, owners) in SOLE_OWNERS {
            let is_named = text.lines().any(|l| {
                let l = l.split("//").next().unwrap_or_default();
                l.contains(&format!("{owned}::"))
                    && !l.contains(&format!("_{owned}::"))
                    && !l.contains(&format!("::{owned}::"))
            });
            if is_named && !owners.contains(&module.as_str()) {
                faults.push(format!("{}: {module} names the crate {owned}", file.display()));
            }
        }
    }
    assert!(faults.is_empty(), "\n{}", faults.join("\n"));
}

#[test]
fn only_intrinsics_are_unsafe() {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    sources(&src, &mut files);
    let is_unsafe = |file: &PathBuf| {
        let text = fs::read_to_string(file).unwrap();
        let code = text.lines().map(|l| l.split("//").next().unwrap_or_default());
        code.flat_map(|l| l.split(|c: char| !c.is_alphanumeric() && c != '_'))
            .any(|word| word == "unsafe" || word == "unsafe_code")
    };
    let found: Vec<String> =
        files.iter().filter(|f| is_unsafe(f)).map(|f| module_of(f, &src)).collect();
    assert_eq!(found, ["intrinsics"]);
}

#[test]
fn the_scan_sees_imports_of_every_shape() {
    let text = "use crate::mesh::Mesh;\nuse crate::{\n    io,\n    jobs::{event::X, spec},\n};\n\
                // crate::nothing\nlet x = crate::render::y();";
    let found = imports(text);
    for wanted in ["mesh", "io", "jobs", "render"] {
        assert!(found.contains(wanted), "{wanted} in {found:?}");
    }
    assert!(!found.contains("nothing") && !found.contains("event") && !found.contains("spec"));
}
