//! The command line as scripts use it.

use std::{
    fs,
    io::{BufRead, BufReader},
    process::Stdio,
    time::{Duration, Instant},
};

use lookalike::jobs::state::State;

use crate::support::{
    JOB, LONG_JOB, Server, create, ended, eventually, free_ports, job, lookalike, reference,
    results, small_torus, state, torus,
};

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn submit_and_run_leave_the_same_files() {
    let server = Server::start();
    let reference = reference(&server);
    let (file, out) = (server.file("torus.ply", &small_torus()), server.dir.path().join("out"));
    let out_text = out.display().to_string();
    let output = server.run("submit", &[&[&*file, "--out", &out_text], &JOB[..]].concat());
    assert!(output.status.success(), "{output:?}");
    assert_eq!(results(&out), reference);
    let listed = text(&output.stdout);
    for file in ["/lod-1.glb", "/lods.glb"] {
        assert!(listed.lines().any(|line| line.ends_with(file)), "{listed}");
    }

    let said = text(&output.stderr);
    assert!(said.lines().any(|line| line.starts_with("lod-1.glb: 200 triangles")), "{said}");

    let jobs = text(&server.run("jobs", &["--json", "--state=succeeded"]).stdout);
    let job: serde_json::Value = serde_json::from_str(jobs.trim()).unwrap();
    assert_eq!(job["state"], "SUCCEEDED");
    assert_eq!(job["spec"]["triangles"], serde_json::json!([500, 200]));
    assert_eq!(text(&server.run("jobs", &["--state=failed,queued"]).stdout), "");

    let name = job["name"].as_str().unwrap();
    let told = text(&server.run("job", &[name]).stdout);
    assert!(told.contains("SUCCEEDED") && told.contains(": COMPLETED, "), "{told}");
    let watched = server.run("watch", &[name, "--json"]);
    assert!(watched.status.success());
    let events: Vec<serde_json::Value> =
        text(&watched.stdout).lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(events[0]["state"], "QUEUED");
    assert_eq!(events.last().unwrap()["state"], "SUCCEEDED");
    let tail = server.run("watch", &[name, "--json", "--after-seq=3"]);
    assert_eq!(text(&tail.stdout).lines().count(), events.len() - 3);

    let again = server.dir.path().join("again");
    // As an earlier job with more levels would leave it.
    fs::create_dir(&again).unwrap();
    fs::write(again.join("lod-7.glb"), b"earlier").unwrap();
    fs::write(again.join("report.json"), br#"{"levels": [{"file": "lod-7.glb"}]}"#).unwrap();
    let id = name.strip_prefix("jobs/").unwrap();
    let fetched = server.run("fetch", &[id, "--out", &again.display().to_string()]);
    assert!(fetched.status.success(), "{fetched:?}");
    assert_eq!(results(&again), reference);
    assert!(text(&fetched.stderr).contains("removed: lod-7.glb"), "{fetched:?}");
    assert_eq!(
        text(&server.run("pin", &[id]).stdout),
        format!("{name} is pinned: its results are kept\n")
    );
    let unpinned = server.run("pin", &[id, "--undo"]);
    assert_eq!(text(&unpinned.stdout), format!("{name} is not pinned any more\n"));
    let deleted = server.run("delete", &[id]);
    assert!(deleted.status.success());
    assert_eq!(text(&deleted.stdout), format!("{name} is deleted\n"));
    assert_eq!(server.run("delete", &[id]).status.code(), Some(1));
}

#[tokio::test]
async fn a_running_job_is_cancelled() {
    let server = Server::start();
    let file = server.file("torus.ply", &torus(200, 200));
    let out = server.dir.path().join("out").display().to_string();
    let mut submit = server.command("submit", &[&[&*file, "--out", &out], &LONG_JOB[..]].concat());
    let submit = submit.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let name = eventually("the job to run", || async {
        let jobs = text(&server.run("jobs", &["--json", "--state=running"]).stdout);
        let job: serde_json::Value = serde_json::from_str(jobs.lines().next()?).ok()?;
        Some(job["name"].as_str()?.to_owned())
    })
    .await;
    let asked = Instant::now();
    let cancelled = server.run("cancel", &[&name]);
    assert!(cancelled.status.success(), "{cancelled:?}");
    assert!(text(&cancelled.stdout).contains("CANCELLED"));
    assert!(asked.elapsed() < Duration::from_secs(2), "confirmed after {:?}", asked.elapsed());
    assert_eq!(submit.wait_with_output().unwrap().status.code(), Some(130));
    // The worker is free again.
    let mut client = server.client();
    let next = create(&mut client).await;
    assert_eq!(state(&ended(&client, &next).await), State::Succeeded);
    assert_eq!(server.run("watch", &[&name]).status.code(), Some(130));
    assert_eq!(server.run("cancel", &[&next]).status.code(), Some(1));
}

/// `watch --json | head -1`: not to the end of the job.
#[test]
fn who_watches_for_nobody_ends() {
    let server = Server::start_with(&["--workers=0"]);
    let file = server.file("torus.ply", &small_torus());
    let name = text(&server.run("submit", &[&[&*file, "--no-wait"], &JOB[..]].concat()).stdout);
    let mut watch = server.command("watch", &[name.trim(), "--json"]);
    let mut watch = watch.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
    let mut first = String::new();
    BufReader::new(watch.stdout.take().unwrap()).read_line(&mut first).unwrap();
    assert!(first.contains("QUEUED"), "{first}");
    // One more line; without it a watcher that goes on would end by the job's code.
    assert!(server.run("cancel", &[name.trim()]).status.success());
    assert_eq!(watch.wait().unwrap().code(), Some(0));
}

#[test]
fn ctrl_c_cancels_a_submission() {
    let server = Server::start_with(&["--workers=0"]);
    let file = server.file("torus.ply", &small_torus());
    let out = server.dir.path().join("out").display().to_string();
    let mut submit = server.command("submit", &[&[&*file, "--out", &out], &JOB[..]].concat());
    let mut submit = submit.stderr(Stdio::piped()).spawn().unwrap();
    let mut said = std::io::BufReader::new(submit.stderr.take().unwrap());
    let mut line = String::new();
    while !line.contains("QUEUED") {
        line.clear();
        assert_ne!(std::io::BufRead::read_line(&mut said, &mut line).unwrap(), 0);
    }
    crate::support::signal(submit.id(), rustix::process::Signal::INT);
    assert_eq!(submit.wait().unwrap().code(), Some(130));
    assert!(text(&server.run("jobs", &[]).stdout).contains("CANCELLED"));
}

#[test]
fn failures_have_their_exit_codes() {
    let server = Server::start();
    let out = server.dir.path().join("out").display().to_string();
    let empty = server.file("empty.ply", b"");
    let failed = server.run("submit", &[&empty, "--out", &out, "--triangles=5"]);
    assert_eq!(failed.status.code(), Some(1), "{failed:?}");
    assert!(text(&failed.stderr).contains("failed"), "{failed:?}");
    let jobs = text(&server.run("jobs", &["--json"]).stdout);
    let job: serde_json::Value = serde_json::from_str(jobs.trim()).unwrap();
    let nothing = server.dir.path().join("nothing");
    let fetch = ["--out", nothing.to_str().unwrap()];
    let fetched = server.run("fetch", &[&[job["name"].as_str().unwrap()], &fetch[..]].concat());
    assert_eq!(fetched.status.code(), Some(1), "{fetched:?}");
    assert!(text(&fetched.stderr).contains("lookalike retry jobs/"), "{fetched:?}");
    assert!(!nothing.exists());
    let [nobody] = free_ports();
    let nobody = format!("http://{nobody}");
    for flags in [["jobs"].as_slice(), &["watch", "1"], &["cancel", "1"]] {
        let unreachable = lookalike().args(flags).arg("--server").arg(&nobody).output().unwrap();
        assert_eq!(unreachable.status.code(), Some(3), "{unreachable:?}");
        assert!(text(&unreachable.stderr).contains("lookalike serve"));
    }
    for usage in [
        vec!["submit", &*empty, "--out", &out],
        vec!["submit", &*empty, "--out", &out, "--triangles=0"],
        vec!["submit", "/nowhere.ply", "--out", &out, "--triangles=5"],
        vec!["run", &*empty, "--out", &out, "--triangles=5", "--views=7"],
        vec!["run", &*empty, "--out", &out, "--ratio=10%"],
        vec!["extract", &*empty, "--triangles=5", "--out=level.stl"],
        vec!["extract", &*empty, "--triangles=5", "--out=level.ply", "--quantize"],
        vec!["compare", &*empty, &*empty, "--sheet=sheet.jpg"],
        vec!["sample", "sample"],
        vec!["jobs", "--state=lost"],
        vec!["jobs", "--server=nonsense"],
        vec!["serve", "--listen=0.0.0.0:7420", "--data-dir", &out],
    ] {
        let output = lookalike().args(&usage).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{usage:?}: {output:?}");
        assert!(!output.stderr.is_empty());
    }
    let missing = server.run("watch", &["0123"]);
    assert_eq!(missing.status.code(), Some(1), "{missing:?}");
}

#[tokio::test]
async fn requests_with_a_name_of_their_own_can_be_repeated() {
    let server = Server::start();
    let file = server.file("torus.ply", &small_torus());
    let flags = [&[&*file, "--no-wait", "--request-id=mine"], &JOB[..]].concat();
    let first = text(&server.run("submit", &flags).stdout);
    let out = server.dir.path().join("later");
    let again = [&flags[..], &["--out", out.to_str().unwrap()]].concat();
    let again = server.run("submit", &again);
    assert_eq!(text(&again.stdout), first);
    let then = format!("then: lookalike fetch {} --out {}\n", first.trim(), out.display());
    assert!(text(&again.stderr).ends_with(&then) && !out.exists(), "{again:?}");
    let mut client = server.client();
    assert!(state(&job(&mut client, first.trim()).await) != State::Failed);
    assert_eq!(text(&server.run("jobs", &[]).stdout).lines().count(), 1);
}

#[test]
fn doctor_and_completions_print() {
    let server = Server::start_with(&["--workers=0"]);
    let data_dir = server.data_dir().display().to_string();
    let [port] = free_ports();
    let mut doctor = lookalike();
    doctor.args(["doctor", "--json", "--listen", &port, "--data-dir", &data_dir]);
    doctor.env_remove("XDG_RUNTIME_DIR");
    let output = doctor.output().unwrap();
    assert!(output.status.success(), "{output:?}");
    // Mesa, which looks for devices, has nothing to complain of.
    assert!(!text(&output.stderr).contains("XDG_RUNTIME_DIR"), "{output:?}");
    let found: Vec<serde_json::Value> =
        text(&output.stdout).lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let store = found.iter().find(|finding| finding["what"] == "store").unwrap();
    assert!(store["text"].as_str().unwrap().contains("in use"));
    let script = lookalike().args(["completions", "bash"]).output().unwrap();
    assert!(text(&script.stdout).contains("_lookalike"));
    assert!(fs::metadata(server.data_dir().join("jobs.sqlite3")).is_ok());
}
