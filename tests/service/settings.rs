//! Settings by file, environment and flags, as processes read them.

use std::{fs, process::Output};

use lookalike::service::status::reason_of;

use crate::support::{Server, create, create_request, lookalike, small_torus, upload};

fn serve(file: &str, env: &[(&str, &str)], flags: &[&str]) -> Output {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("farm.toml");
    fs::write(&path, file).unwrap();
    let mut command = lookalike();
    command.arg("serve").args(flags).env("LOOKALIKE_CONFIG", &path);
    command.envs(env.iter().copied()).output().unwrap()
}

#[test]
fn settings_are_shown_without_secrets() {
    let file = "[serve]\ndata_dir = 'd'\nworkers = 3\nmax_queued = 5\nlease_secs = 50\n";
    let env = [("LOOKALIKE_DATABASE", "postgres://u:hush@h/db"), ("LOOKALIKE_MAX_QUEUED", "6")];
    let shown = serve(file, &env, &["--print-config", "--workers=4"]);
    assert!(shown.status.success(), "{shown:?}");
    let text = String::from_utf8(shown.stdout).unwrap();
    for line in [
        "workers = 4  # --workers\n",
        "max_queued = 6  # LOOKALIKE_MAX_QUEUED\n",
        "farm.toml:5\n",
        "device = \"auto\"  # default\n",
        "# database is set at LOOKALIKE_DATABASE, and hidden\n",
    ] {
        assert!(text.contains(line), "{line} is not in\n{text}");
    }
    assert!(!text.contains("hush"), "{text}");
}

#[test]
fn all_faults_are_told_at_once_with_their_places() {
    let file = "[serve]\nworkers = 'many'\ncolour = 'red'\n";
    let env = [("LOOKALIKE_LEASE_SECS", "long"), ("LOOKALIKE_DATABASE", "x://hush")];
    let refused = serve(file, &env, &["--max-attempts=x"]);
    assert_eq!(refused.status.code(), Some(2), "{refused:?}");
    let text = String::from_utf8(refused.stderr).unwrap();
    for fault in [
        "farm.toml:2: invalid value 'many'",
        "farm.toml:3: `colour` is no setting",
        "LOOKALIKE_LEASE_SECS: invalid value 'long'",
        "--max-attempts: invalid value 'x'",
        "--data-dir: it is required",
    ] {
        assert!(text.contains(fault), "{fault} is not in\n{text}");
    }
    assert!(!text.contains("hush"), "{text}");
    // What does not fit together names its places, too.
    let file = "[serve]\ndata_dir = 'd'\nlease_secs = 5\n";
    let refused = serve(file, &[], &["--heartbeat-secs=4"]);
    let text = String::from_utf8(refused.stderr).unwrap();
    assert!(text.contains("(--lease-secs is set at ") && text.contains("farm.toml:3)"), "{text}");
}

#[tokio::test]
async fn a_server_does_what_its_file_says() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("farm.toml");
    fs::write(&path, "[serve]\nmax_queued = 1\nworkers = 0\n").unwrap();
    let config = format!("--config={}", path.display());
    let server = Server::start_with(&[&config]);
    let mut client = server.client();
    create(&mut client).await;
    let mesh = upload(&mut client, small_torus()).await;
    let refused = client.create_job(create_request(&mesh, "")).await.unwrap_err();
    assert_eq!(reason_of(&refused).as_deref(), Some("QUEUE_FULL"));
}
