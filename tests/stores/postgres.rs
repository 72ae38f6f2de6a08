//! A PostgreSQL of the tests' own, which ends with the process that started it.

use std::{
    io::{BufRead, BufReader, Write},
    process::{Child, ChildStdin, ChildStdout, Command, Stdio},
};

/// A cluster in a folder of its own.
pub(crate) struct Cluster {
    folder: String,
    n_databases: usize,
    orders: ChildStdin,
    answers: BufReader<ChildStdout>,
    /// Ends when `orders` closes, and removes the folder.
    _script: Child,
}

impl Cluster {
    /// Starts one; `None`, and a line that says so, when PostgreSQL is missing.
    pub(crate) fn start() -> Option<Self> {
        // PostgreSQL refuses to run as root.
        let as_other = ["runuser", "-u", "nobody", "--"];
        let as_other = if rustix::process::getuid().is_root() { &as_other[..] } else { &[] };
        let words = [as_other, &["sh", "-c", include_str!("postgres.sh")]].concat();
        let mut command = Command::new(words[0]);
        command.args(&words[1..]).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut script = command.spawn().unwrap();
        let orders = script.stdin.take().unwrap();
        let mut answers = BufReader::new(script.stdout.take().unwrap());
        let folder = line(&mut answers);
        if folder.is_empty() {
            assert!(script.wait().unwrap().success(), "PostgreSQL does not start: see above");
            let _ =
                writeln!(std::io::stderr(), "skipped: no PostgreSQL (apt-get install postgresql)");
            return None;
        }
        Some(Self { folder, n_databases: 0, orders, answers, _script: script })
    }

    /// A new, empty database; its URL.
    pub(crate) fn create(&mut self) -> String {
        self.n_databases += 1;
        let name = format!("t{}", self.n_databases);
        self.order(&format!("create {name}"));
        format!("postgres:///{name}?host={}&user=lookalike", self.folder)
    }

    /// `stop`, `start`, `crash`, `freeze` or `thaw`; returns when it is done.
    pub(crate) fn order(&mut self, order: &str) {
        writeln!(self.orders, "{order}").unwrap();
        assert_eq!(line(&mut self.answers), "done", "{order}");
    }
}

fn line(answers: &mut BufReader<ChildStdout>) -> String {
    let mut line = String::new();
    answers.read_line(&mut line).unwrap();
    line.trim_end().to_owned()
}
