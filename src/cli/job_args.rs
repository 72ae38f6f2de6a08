//! The flags that say what to do with a mesh, the same for `run` and `submit`.

use std::{fmt::Display, str::FromStr};

use clap::{
    ArgGroup, Args,
    builder::{PossibleValuesParser, TypedValueParser},
};
use lookalike::jobs::spec::{Effort, Fault, Lock, Method, Spec, Topology};
use serde::de::DeserializeOwned;

use super::{
    exit::Failure, optimize_args::OptimizeArgs, output_args::OutputArgs, picture_args::PictureArgs,
};

/// What a level may go by; there must be one of them.
const TARGETS: [&str; 5] = ["triangles", "ratio", "max_d2", "screen_size", "max_bytes"];

/// What to make of a mesh.
#[derive(Args, Clone, Debug)]
#[command(group(ArgGroup::new("targets").args(TARGETS).required(true).multiple(true)))]
pub(crate) struct JobArgs {
    /// Triangles of each level of detail, separated by commas.
    #[arg(long, value_delimiter = ',', value_name = "N")]
    triangles: Vec<u32>,
    /// The same as shares of the model's triangles, such as 0.25,0.1.
    #[arg(long, value_delimiter = ',', value_parser = share, value_name = "SHARE")]
    ratio: Vec<f64>,
    /// How the levels are made: by what they look like, by geometry alone, or by vertex clustering
    /// (crude; one level).
    #[arg(
        long,
        default_value = "image",
        value_parser = word::<Method>(&["image", "memoryless", "cluster"])
    )]
    simplify: Method,
    /// How much work each collapse is worth.
    #[arg(long, default_value = "balanced", value_parser = word::<Effort>(&["fast", "balanced", "best"]))]
    effort: Effort,
    /// Keep parts and holes, or let them go where a target asks for it; `auto` keeps them in models of one
    /// piece.
    #[arg(
        long,
        default_value = "auto",
        value_parser = word::<Topology>(&["auto", "preserve", "free"])
    )]
    topology: Topology,
    /// Each level goes no further than to so much of d2, in percent; one value is for all levels, 0 for no
    /// limit.
    #[arg(long, value_delimiter = ',', value_name = "PERCENT")]
    max_d2: Vec<f64>,
    /// Each level may stand in for the model where its bounding sphere is so many pixels high on the screen;
    /// one value is for all levels, 0 for no limit.
    #[arg(long, value_delimiter = ',', value_name = "PIXELS")]
    screen_size: Vec<f64>,
    /// The file of each level has at most so many bytes, images included; one value is for all levels, 0 for
    /// no limit.
    #[arg(long, value_delimiter = ',', value_name = "BYTES")]
    max_bytes: Vec<u64>,
    #[command(flatten)]
    locks: LockArgs,
    #[command(flatten)]
    pictures: PictureArgs,
    /// The image-driven stage starts at this multiple of the largest level; `auto`: 4, or 8 for models of several
    /// parts or with textures where that is at most a third of the model.
    #[arg(long, default_value = "auto", value_parser = automatic::<f64>, value_name = "K")]
    start_factor: f64,
    /// Weight of the surface against the boundary in the memoryless cost, 0 to 1.
    #[arg(long, default_value_t = 0.5)]
    lambda: f64,
    #[command(flatten)]
    optimize: OptimizeArgs,
    #[command(flatten)]
    output: OutputArgs,
    /// Stop after this many energy evaluations; 0 for no limit.
    #[arg(long, default_value_t = 0, value_name = "N")]
    max_evaluations: u64,
    /// Stop after this many seconds; 0 for no limit.
    #[arg(long, default_value_t = 0.0, value_name = "SECS")]
    max_secs: f64,
    /// Seed of everything random.
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

/// What stays where it is.
#[derive(Args, Clone, Debug)]
pub(crate) struct LockArgs {
    /// Leave vertices where they are that lie along these edges: border, seam, hard-edge.
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "EDGES",
        value_parser = word::<Lock>(&["border", "seam", "hard-edge"])
    )]
    pub(crate) lock: Vec<Lock>,
    /// Where the surface turns by so much or more, an edge is hard (--lock hard-edge).
    #[arg(long, default_value_t = 60.0, value_name = "DEGREES")]
    pub(crate) hard_edge_degrees: f64,
}

/// Fields of the specification whose flag has another name.
const FLAGS: [(&str, &str); 12] = [
    ("ratios", "--ratio"),
    ("optimize", "--optimize-evaluations"),
    ("optimize.max_evaluations", "--optimize-evaluations"),
    ("optimize.max_secs", "--optimize-seconds"),
    ("optimize.until", "--optimize-until"),
    ("optimize.delta", "--optimize-delta"),
    ("optimize.normals", "--optimize-normals"),
    ("optimize.keep_attributes", "--keep-attributes"),
    ("render.n_views", "--views"),
    ("render.custom_views", "--view"),
    ("render.fov_degrees", "--fov"),
    ("method", "--simplify"),
];

impl JobArgs {
    /// The specification, or everything that is wrong with it.
    pub(crate) fn spec(self) -> Result<Spec, Failure> {
        let spec = Spec {
            triangles: self.triangles,
            ratios: self.ratio,
            method: self.simplify,
            effort: self.effort,
            topology: self.topology,
            start_factor: self.start_factor,
            lambda: self.lambda,
            max_d2: self.max_d2,
            screen_size: self.screen_size,
            max_bytes: self.max_bytes,
            lock: self.locks.lock,
            hard_edge_degrees: self.locks.hard_edge_degrees,
            render: self.pictures.render(),
            optimize: self.optimize.optimize(),
            output: self.output.output(),
            max_evaluations: self.max_evaluations,
            max_secs: self.max_secs,
            seed: self.seed,
            simplified: None,
            evaluate: None,
        };
        checked(spec)
    }
}

fn share(text: &str) -> Result<f64, String> {
    text.parse::<f64>().map_err(|_| "use a share such as 0.1, which is 10 %".into())
}

/// A number; `auto` is 0, which no such flag takes otherwise.
pub(crate) fn automatic<T: FromStr<Err: Display> + Default + PartialEq>(
    text: &str,
) -> Result<T, String> {
    if text == "auto" {
        return Ok(T::default());
    }
    let number: T = text.parse().map_err(|e: T::Err| format!("{e}: use a number, or `auto`"))?;
    if number == T::default() { Err("0: use `auto`".into()) } else { Ok(number) }
}

/// The specification, or everything that is wrong with it.
pub(crate) fn checked(spec: Spec) -> Result<Spec, Failure> {
    let faults = spec.validate();
    if faults.is_empty() {
        return Ok(spec);
    }
    Err(Failure::faults(&faults.iter().map(line).collect::<Vec<_>>()))
}

fn line(fault: &Fault) -> String {
    let (field, index) = fault.field.split_once('[').unwrap_or((&fault.field, ""));
    let flag = FLAGS.iter().find(|(known, _)| *known == field).map(|(_, flag)| (*flag).to_owned());
    let flag = flag.unwrap_or_else(|| {
        format!("--{}", field.rsplit('.').next().unwrap_or(field).replace('_', "-"))
    });
    match index.trim_end_matches(']').parse::<usize>() {
        Ok(index) => format!("{flag}, number {}: {}", index + 1, fault.text),
        Err(_) => format!("{flag}: {}", fault.text),
    }
}

/// One of `words`, which are the names that the specification itself is stored with.
pub(super) fn word<T: DeserializeOwned + Clone + Send + Sync + 'static>(
    words: &[&'static str],
) -> impl TypedValueParser<Value = T> + use<T> {
    let words = PossibleValuesParser::new(words.to_vec());
    words.try_map(|word| serde_json::from_value(serde_json::Value::String(word)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;
    use lookalike::jobs::spec::{Optimize, Solver};

    #[derive(Parser)]
    struct Probe {
        #[command(flatten)]
        job: JobArgs,
    }

    fn spec(flags: &[&str]) -> Result<Spec, Failure> {
        Probe::try_parse_from([&["probe"], flags].concat()).unwrap().job.spec()
    }

    #[test]
    fn the_defaults_are_those_of_the_specification() {
        assert_eq!(spec(&["--triangles=500,100"]).unwrap(), Spec::new(vec![500, 100]));
    }

    #[test]
    fn shares_stand_in_for_triangles() {
        assert_eq!(spec(&["--ratio=0.25,0.1"]).unwrap().ratios, [0.25, 0.1]);
        let refusal = |flags: &[&str]| {
            let parsed = Probe::try_parse_from([&["probe"], flags].concat());
            parsed.err().map(|error| error.to_string()).unwrap_or_default()
        };
        let text = refusal(&["--ratio=10%"]);
        assert!(text.contains("use a share such as 0.1"), "{text}");
        // Whoever names no target learns of all of them.
        let text = refusal(&[]);
        for flag in ["--triangles", "--ratio", "--max-d2", "--screen-size", "--max-bytes"] {
            assert!(text.contains(flag), "{text}");
        }
        let text = spec(&["--triangles=9", "--ratio=0.5,1"]).unwrap_err().error.to_string();
        assert!(text.lines().any(|line| line.starts_with("--ratio, number 2: ")), "{text}");
        assert!(text.lines().any(|line| line.starts_with("--ratio: ")), "{text}");
    }

    #[test]
    fn words_and_directions_are_read() {
        let flags =
            ["--triangles=9", "--simplify=memoryless", "--topology=free", "--view=-1,0,0.5"];
        let read = spec(&flags).unwrap();
        assert_eq!((read.method, read.topology), (Method::Memoryless, Topology::Free));
        assert_eq!(read.render.custom_views, [[-1.0, 0.0, 0.5]]);
        assert_eq!(spec(&["--triangles=9", "--max-d2=1.5"]).unwrap().max_d2, [1.5]);
        let read =
            spec(&["--screen-size=300,60", "--max-bytes=0,90000", "--lock=border,hard-edge"])
                .unwrap();
        assert_eq!((read.screen_size, read.max_bytes), (vec![300.0, 60.0], vec![0, 90_000]));
        assert_eq!((read.lock, read.hard_edge_degrees), (vec![Lock::Border, Lock::HardEdge], 60.0));
        for bad in [
            "--simplify=magic",
            "--lock=all",
            "--topology=bound",
            "--view=1,2",
            "--view=a,b,c",
            "--triangles=-1",
        ] {
            assert!(Probe::try_parse_from(["probe", "--triangles=9", bad]).is_err(), "{bad}");
        }
    }

    #[test]
    fn optimization_is_set_in_evaluations_seconds_or_energy() {
        let read = |flag| spec(&["--triangles=9", flag]).unwrap().optimize;
        let default = Optimize::default();
        let wanted = Optimize { max_evaluations: Some(0), ..default.clone() };
        assert_eq!(read("--optimize-evaluations=0"), wanted);
        assert_eq!(
            read("--optimize-seconds=2"),
            Optimize { max_secs: Some(2.0), ..default.clone() }
        );
        assert_eq!(read("--optimize-until=0.5"), Optimize { until: Some(0.5), ..default.clone() });
        let wanted = Optimize { solver: Solver::Simplex, ..default };
        assert_eq!(read("--optimize-solver=simplex"), wanted);
    }

    #[test]
    fn faults_name_their_flags() {
        let flags = ["--triangles=9,0", "--views=7", "--light-degrees=91", "--optimize-until=2"];
        let failure = spec(&flags).unwrap_err();
        let text = failure.error.to_string();
        let starts =
            ["--triangles, number 2: ", "--views: ", "--light-degrees: ", "--optimize-until: "];
        for (line, start) in text.lines().zip(starts) {
            assert!(line.starts_with(start), "{line}");
        }
        assert_eq!(text.lines().count(), 4);
    }
}
