//! Files, environments and flags as tables of what comes out of them.

use std::collections::BTreeMap;

use clap::Parser;

use super::*;
use crate::config::{ServeArgs, ServeConfig};

#[derive(Parser)]
struct Root {
    #[command(subcommand)]
    command: Subcommand,
}

#[derive(clap::Subcommand)]
enum Subcommand {
    Serve(Box<ServeArgs>),
    /// Another table of the same file.
    Worker,
}

/// What a server is told: the file at `path` holds `file`.
fn gather(path: &Path, file: &str, env: &[(&str, &str)], flags: &[&str]) -> Settings {
    fs::write(path, file).unwrap();
    let env: BTreeMap<OsString, OsString> = env.iter().map(|(k, v)| (k.into(), v.into())).collect();
    let config = format!("--config={}", path.display());
    let argv = ["lookalike", "serve", &config].into_iter().chain(flags.iter().copied());
    let root = <Root as clap::CommandFactory>::command();
    Settings::gather(&root, argv.map(OsString::from).collect(), |name| env.get(name).cloned())
}

/// The same as a configuration, as far as the command line says it: clap reads the real environment.
fn config(settings: &Settings) -> ServeConfig {
    assert_eq!(settings.faults, [""; 0]);
    let Subcommand::Serve(args) = Root::try_parse_from(&settings.argv).unwrap().command else {
        panic!("another command")
    };
    args.check().unwrap()
}

const FILE: &str = "# A farm.\n[serve]\ndata_dir = 'd'\nworkers = 3\nlease_secs = 40.5\nlog_json = true\n\
                    allow_origin = ['https://a.test', 'https://b.test']\n[worker]\ndevice = 'cpu'\n";

#[test]
fn flags_win_over_files_and_files_over_defaults() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("c.toml");
    let table: [(&[&str], usize, f64); 4] = [
        (&[], 3, 40.5),
        (&["--workers=5"], 5, 40.5),
        (&["--workers", "5", "--lease-secs=60"], 5, 60.0),
        (&["--lease-secs", "60", "--log-json"], 3, 60.0),
    ];
    for (flags, workers, lease) in table {
        let config = config(&gather(&path, FILE, &[], flags));
        assert_eq!(
            (config.n_workers, config.terms.lease.as_secs_f64()),
            (workers, lease),
            "{flags:?}"
        );
        assert!(config.log_json && config.guard.origins.len() == 2);
    }
    assert_eq!(config(&gather(&path, "[serve]\ndata_dir = 'd'", &[], &[])).n_workers, 1);
}

#[test]
fn the_environment_wins_over_files_and_loses_to_flags() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("c.toml");
    let env = [("LOOKALIKE_WORKERS", "7"), ("LOOKALIKE_LOG_JSON", "false")];
    let told = gather(&path, FILE, &env, &[]);
    assert_eq!(told.set["workers"].place, "LOOKALIKE_WORKERS");
    // Nothing of the file is left that would win over it.
    assert!(!told.argv.iter().any(|arg| arg.to_string_lossy().starts_with("--workers")));
    assert!(!told.argv.iter().any(|arg| arg == "--log-json"));
    let told = gather(&path, FILE, &env, &["--workers=9"]);
    assert_eq!(told.set["workers"], Setting { place: "--workers".into(), text: "9".into() });
    assert_eq!(config(&told).n_workers, 9);
}

#[test]
fn every_fault_is_told_at_once_with_its_place() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("c.toml");
    let file = "colour = 1\n[serve]\nworkers = 'many'\ncolour = 'red'\nlog_json = 3\nlisten = [1]\n\
                lock = 'x'\nmax_queued = 0x10\n[worker]\ncolour = 'not ours'\n";
    let env = [("LOOKALIKE_LEASE_SECS", "long"), ("LOOKALIKE_DATABASE", "postgres://u:hush@h/db")];
    let told = gather(&path, file, &env, &["--max-attempts=-1", "--drain-secs", "soon"]);
    let at = |line: u32| format!("{}:{line}: ", path.display());
    let wanted = [
        (at(1), "[serve] and [worker]"),
        (at(3), "invalid value 'many'"),
        (at(4), "`colour` is no setting"),
        (at(5), "true or false"),
        (at(6), "no list"),
        (at(7), "`lock` is no setting"),
        (at(8), "a text or a number"),
        ("LOOKALIKE_LEASE_SECS: ".into(), "invalid value 'long'"),
        ("--max-attempts: ".into(), "invalid value '-1'"),
        ("--drain-secs: ".into(), "invalid value 'soon'"),
        ("--data-dir: ".into(), "required"),
    ];
    for (place, text) in &wanted {
        let is_told = |fault: &String| fault.starts_with(place) && fault.contains(text);
        assert!(told.faults.iter().any(is_told), "{place}{text} is not in {:#?}", told.faults);
    }
    assert_eq!(told.faults.len(), wanted.len(), "{:#?}", told.faults);
    assert!(!told.faults.concat().contains("hush"));
    let broken = gather(&path, "[serve\nworkers = \n", &[], &[]).faults;
    assert!(broken.iter().any(|fault| fault.starts_with(&at(1))), "{broken:#?}");
    let places = gather(&path, FILE, &[], &["--drain-secs=1"]);
    let fault = places.with_places("--lease-secs is less than --drain-secs: use more");
    assert!(fault.ends_with(&format!("(--lease-secs is set at {}:5)", path.display())), "{fault}");
}

#[test]
fn what_is_shown_says_the_same_and_hides_secrets() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("c.toml");
    let env = [("LOOKALIKE_DATABASE", "postgres://u:hush@h/db")];
    let root = <Root as clap::CommandFactory>::command();
    let shown = gather(&path, FILE, &env, &["--metrics-listen=127.0.0.1:9"]).show(&root);
    assert!(shown.contains("# database is set at LOOKALIKE_DATABASE, and hidden\n"), "{shown}");
    assert!(!shown.contains("hush"), "{shown}");
    for line in [
        "workers = 3  # ",
        "metrics_listen = \"127.0.0.1:9\"  # --metrics-listen\n",
        "max_attempts = 3  # default\n",
    ] {
        assert!(shown.contains(line), "{line} is not in\n{shown}");
    }
    let again = config(&gather(&path, &shown, &[], &[]));
    assert_eq!(again, config(&gather(&path, FILE, &[], &["--metrics-listen=127.0.0.1:9"])));
}
