//! Malformed, degenerate and impossible models, sent to a server: the log of each job says why it
//! failed, or what was unusual about its success.

use std::{fs, io::Write as _, path::PathBuf};

use serde_json::Value;

use crate::support::{Server, small_torus};

const SMALL: [&str; 4] = ["--views=4", "--image-size=64", "--effort=fast", "--no-wait"];

/// Submits bytes, waits for the end: the log, an entry a line, and the code that `watch` ended with.
fn log_of(server: &Server, name: &str, bytes: &[u8], triangles: &str) -> (Vec<Value>, Option<i32>) {
    let file = server.file(name, bytes);
    let submitted =
        server.run("submit", &[&[&*file, "--triangles", triangles], &SMALL[..]].concat());
    assert!(submitted.status.success(), "{submitted:?}");
    let job = String::from_utf8(submitted.stdout).unwrap();
    let watched = server.run("watch", &[job.trim(), "--json"]);
    let lines = String::from_utf8(watched.stdout).unwrap();
    let log = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    (log, watched.status.code())
}

fn obj(faces: &str) -> Vec<u8> {
    format!("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n{faces}").into_bytes()
}

/// Two caps of five triangles on a pentagon.
fn ten_triangles() -> Vec<u8> {
    let mut lines = vec!["v 0 0 1".to_owned(), "v 0 0 -1".to_owned()];
    for k in 0..5 {
        let (sin, cos) = (f64::from(k) * std::f64::consts::TAU / 5.0).sin_cos();
        lines.push(format!("v {cos} {sin} 0"));
    }
    for k in 0..5 {
        let (a, b) = (3 + k, 3 + (k + 1) % 5);
        lines.push(format!("f 1 {a} {b}"));
        lines.push(format!("f 2 {b} {a}"));
    }
    lines.join("\n").into_bytes()
}

#[test]
fn the_log_says_why_a_model_was_refused() {
    let server = Server::start();
    let torus = small_torus();
    let cases: [(&str, Vec<u8>, &str); 5] = [
        ("empty.glb", Vec::new(), "EMPTY_FILE"),
        ("cut.ply", torus[..torus.len() / 2].to_vec(), "TRUNCATED_FILE"),
        ("nan.obj", b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n".into(), "NON_FINITE_POSITION"),
        ("far.obj", obj("f 1 2 9\n"), "INDEX_OUT_OF_RANGE"),
        ("points.obj", obj("f 1 1 2\nf 3 3 3\n"), "NO_TRIANGLES"),
    ];
    for (name, bytes, reason) in cases {
        let (log, code) = log_of(&server, name, &bytes, "20");
        let last = log.last().unwrap();
        assert_eq!((&last["state"], &last["reason"]), (&"FAILED".into(), &reason.into()), "{last}");
        assert!(last["text"].as_str().unwrap().contains(name), "{last}");
        assert_eq!(code, Some(1));
        // A model's fault is no reason to try again.
        assert_eq!(last["attempt"], 1, "{last}");
    }
}

#[test]
fn the_log_says_what_a_model_forbids() {
    let server = Server::start();
    let (log, code) = log_of(&server, "ten.obj", &ten_triangles(), "20");
    let note = log.iter().find(|e| e["code"] == "TARGET_NOT_BELOW_INPUT").expect("a note");
    assert!(note["text"].as_str().unwrap().contains("the model has 10"), "{note}");
    assert_eq!((&log.last().unwrap()["state"], code), (&"SUCCEEDED".into(), Some(0)));

    let house = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/models/house_scene.glb");
    let Ok(bytes) = fs::read(&house) else {
        let _ = writeln!(std::io::stderr(), "skipped: {} is not there", house.display());
        return;
    };
    let (log, code) = log_of(&server, "house.glb", &bytes, "1000");
    assert_eq!((&log.last().unwrap()["state"], code), (&"SUCCEEDED".into(), Some(0)));
    let read = log.iter().find(|e| e["code"] == "MODEL_READ").expect("what was read");
    assert!(read["text"].as_str().unwrap().contains("3666 non-manifold"), "{read}");
}
