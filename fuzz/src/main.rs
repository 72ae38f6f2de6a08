//! The mutation loop: `mutate [TARGET|all] [MUTATIONS] [SEED]`.

use std::{
    env, fs,
    panic::catch_unwind,
    path::Path,
    process::ExitCode,
    time::{Duration, Instant},
};

use lookalike_fuzz::{TARGETS, Target, input};

/// An input that takes longer counts as a hang.
const SLOW: Duration = Duration::from_secs(2);

fn main() -> ExitCode {
    let args: Vec<String> = env::args().skip(1).collect();
    let name = args.first().map_or("all", String::as_str);
    let number = |i: usize, default: u64| match args.get(i).map(|a| a.parse()) {
        None => Some(default),
        Some(found) => found.ok(),
    };
    let targets: Vec<&Target> =
        TARGETS.iter().filter(|t| name == "all" || t.name == name).collect();
    let (Some(n_mutations), Some(seed)) = (number(1, 100_000), number(2, 1)) else {
        eprintln!("usage: mutate [TARGET|all] [MUTATIONS] [SEED]");
        return ExitCode::from(2);
    };
    if targets.is_empty() {
        let names: Vec<&str> = TARGETS.iter().map(|t| t.name).collect();
        eprintln!("no target '{name}'; there are: all, {}", names.join(", "));
        return ExitCode::from(2);
    }
    let n_failed = targets.iter().filter(|t| !run(t, n_mutations, seed)).count();
    if n_failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Whether all inputs of the run did well.
fn run(target: &Target, n_mutations: u64, seed: u64) -> bool {
    let seeds = (target.seeds)();
    let begin = Instant::now();
    for index in 0..n_mutations {
        let bytes = input(target, &seeds, seed, index);
        let started = Instant::now();
        let survived = catch_unwind(|| (target.body)(&bytes)).is_ok();
        if !survived || started.elapsed() > SLOW {
            let what = if survived { "slow" } else { "panic" };
            let path = Path::new(env!("CARGO_MANIFEST_DIR"))
                .join("artifacts")
                .join(format!("{}-{what}-{seed}-{index}", target.name));
            let saved = fs::create_dir_all(path.parent().unwrap_or(&path))
                .and_then(|()| fs::write(&path, &bytes));
            println!("{}: {what} at input {index}: {} ({saved:?})", target.name, path.display());
            return false;
        }
    }
    println!("{}: {n_mutations} inputs in {:.1} s", target.name, begin.elapsed().as_secs_f64());
    true
}
