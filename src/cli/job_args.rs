//! The flags that say what to do with a mesh, the same for `run` and `submit`.

use clap::{
    Args,
    builder::{PossibleValuesParser, TypedValueParser},
};
use lookalike::jobs::spec::{Effort, Fault, Method, Projection, Render, Shading, Spec, Topology};
use serde::de::DeserializeOwned;

use super::exit::Failure;

/// What to make of a mesh.
#[derive(Args, Clone, Debug)]
pub(crate) struct JobArgs {
    /// Triangles of each level of detail, separated by commas.
    #[arg(long, required = true, value_delimiter = ',', value_name = "N")]
    triangles: Vec<u32>,
    /// How the levels are made: by what they look like, or by geometry alone.
    #[arg(long, default_value = "image", value_parser = word::<Method>(&["image", "memoryless"]))]
    simplify: Method,
    /// How much work each collapse is worth.
    #[arg(long, default_value = "balanced", value_parser = word::<Effort>(&["fast", "balanced", "best"]))]
    effort: Effort,
    /// Keep parts and holes, or let them go where a target asks for it.
    #[arg(long, default_value = "preserve", value_parser = word::<Topology>(&["preserve", "free"]))]
    topology: Topology,
    /// Number of views: 4, 6, 8, 12, 20 or 24.
    #[arg(long, default_value_t = 20, value_name = "N")]
    views: u32,
    /// A direction from the model's centre to an eye; repeat it. Replaces --views.
    #[arg(long = "view", value_parser = direction, value_name = "X,Y,Z", allow_hyphen_values = true)]
    custom_views: Vec<[f64; 3]>,
    /// Pixels along each side of a picture, 64 to 1024, a multiple of 8.
    #[arg(long, default_value_t = 256, value_name = "PIXELS")]
    image_size: u32,
    /// Surface shading.
    #[arg(long, default_value = "flat", value_parser = word::<Shading>(&["flat", "smooth"]))]
    shading: Shading,
    /// Camera projection.
    #[arg(
        long,
        default_value = "perspective",
        value_parser = word::<Projection>(&["perspective", "orthographic"])
    )]
    projection: Projection,
    /// Field of view in degrees, 5 to 120 (perspective only).
    #[arg(long, default_value_t = 60.0, value_name = "DEGREES")]
    fov: f64,
    /// Background grey, 0 to 1.
    #[arg(long, default_value_t = 0.5, value_name = "GREY")]
    background: f64,
    /// Ambient light, 0 to 1.
    #[arg(long, default_value_t = 0.1, value_name = "LIGHT")]
    ambient: f64,
    /// Angle between view and light, 0 to 90 degrees.
    #[arg(long, default_value_t = 10.0, value_name = "DEGREES")]
    light_degrees: f64,
    /// How many of the views look at the inside.
    #[arg(long, default_value_t = 0, value_name = "N")]
    interior_views: u32,
    /// The image-driven stage starts at this multiple of the largest level.
    #[arg(long, default_value_t = 4.0, value_name = "K")]
    start_factor: f64,
    /// Weight of the surface against the boundary in the memoryless cost, 0 to 1.
    #[arg(long, default_value_t = 0.5)]
    lambda: f64,
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

/// Fields of the specification whose flag has another name.
const FLAGS: [(&str, &str); 4] = [
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
            method: self.simplify,
            effort: self.effort,
            topology: self.topology,
            start_factor: self.start_factor,
            lambda: self.lambda,
            render: Render {
                n_views: self.views,
                custom_views: self.custom_views,
                image_size: self.image_size,
                fov_degrees: self.fov,
                projection: self.projection,
                background: self.background,
                ambient: self.ambient,
                light_degrees: self.light_degrees,
                shading: self.shading,
                interior_views: self.interior_views,
            },
            max_evaluations: self.max_evaluations,
            max_secs: self.max_secs,
            seed: self.seed,
        };
        let faults = spec.validate();
        if faults.is_empty() {
            return Ok(spec);
        }
        Err(Failure::faults(&faults.iter().map(line).collect::<Vec<_>>()))
    }
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
fn word<T: DeserializeOwned + Clone + Send + Sync + 'static>(
    words: &[&'static str],
) -> impl TypedValueParser<Value = T> + use<T> {
    let words = PossibleValuesParser::new(words.to_vec());
    words.try_map(|word| serde_json::from_value(serde_json::Value::String(word)))
}

fn direction(text: &str) -> Result<[f64; 3], String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|part| part.trim().parse()).collect();
    let numbers =
        numbers.map_err(|error| format!("{error}: use three numbers, such as 1,0,-0.5"))?;
    let n_numbers = numbers.len();
    numbers.try_into().map_err(|_| format!("{n_numbers} numbers: use three, such as 1,0,-0.5"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

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
    fn words_and_directions_are_read() {
        let flags =
            ["--triangles=9", "--simplify=memoryless", "--topology=free", "--view=-1,0,0.5"];
        let read = spec(&flags).unwrap();
        assert_eq!((read.method, read.topology), (Method::Memoryless, Topology::Free));
        assert_eq!(read.render.custom_views, [[-1.0, 0.0, 0.5]]);
        for bad in
            ["--simplify=magic", "--topology=bound", "--view=1,2", "--view=a,b,c", "--triangles=-1"]
        {
            assert!(Probe::try_parse_from(["probe", "--triangles=9", bad]).is_err(), "{bad}");
        }
    }

    #[test]
    fn faults_name_their_flags() {
        let failure = spec(&["--triangles=9,0", "--views=7", "--light-degrees=91"]).unwrap_err();
        let text = failure.error.to_string();
        let starts = ["--triangles, number 2: ", "--views: ", "--light-degrees: "];
        for (line, start) in text.lines().zip(starts) {
            assert!(line.starts_with(start), "{line}");
        }
        assert_eq!(text.lines().count(), 3);
    }
}
