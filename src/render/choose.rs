//! Which evaluator to use: results are bit-identical, so this is a matter of speed alone.
//!
//! The one place of the geometry that looks at a clock: what it measures decides who computes,
//! never what comes out.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use super::{
    device::{self, Gpu, describe},
    evaluator::{Evaluator, Reference, RenderError},
    gpu::Device,
    moves::{AddedFace, Move},
    scene::Scene,
    twin::Twin,
};

/// How long each evaluator is measured.
const MEASURE_FOR: Duration = Duration::from_millis(100);
/// Moves of a measured batch: what the lazy queue asks for at once.
const SAMPLE: usize = 32;
/// Other names that users know adapters by.
const ALIASES: [(&str, &str); 1] = [("lavapipe", "llvmpipe")];

/// The evaluator that was chosen, and why.
pub struct Choice {
    /// Ready to judge moves.
    pub evaluator: Box<dyn Evaluator>,
    /// Who was measured, and evaluations (moves judged in all views) per second. Empty when the
    /// user named a device, or there is nothing to choose from.
    pub figures: Vec<(String, f64)>,
    /// What the user may want to know: devices that failed, drivers to install.
    pub notes: Vec<String>,
}

/// Builds the evaluator that `choice` names: `cpu` (the native twin), `auto` (the fastest of the twin and
/// all GPUs, by measurement on this scene), or a part of an adapter's name in any case; `lavapipe` is known as
/// well as `llvmpipe`.
pub fn choose(choice: &str, scene: &Scene, reference: Reference) -> Result<Choice, RenderError> {
    match choice {
        "cpu" => Ok(Choice::of(Box::new(Twin::new(scene, &reference)))),
        "auto" => Ok(fastest(scene, reference)),
        name => named(name, scene, reference),
    }
}

/// [`choose`], for callers that want nothing but the evaluator.
pub fn make_evaluator(
    choice: &str,
    scene: &Scene,
    reference: Reference,
) -> Result<Box<dyn Evaluator>, RenderError> {
    choose(choice, scene, reference).map(|c| c.evaluator)
}

impl Choice {
    fn of(evaluator: Box<dyn Evaluator>) -> Self {
        Self { evaluator, figures: Vec::new(), notes: Vec::new() }
    }
}

fn named(name: &str, scene: &Scene, reference: Reference) -> Result<Choice, RenderError> {
    let wanted = name.to_lowercase();
    let wanted = ALIASES.iter().find(|a| a.0 == wanted).map_or(wanted.as_str(), |a| a.1);
    let adapters = device::enumerate();
    let Some(adapter) = adapters
        .iter()
        .find(|a| !wanted.is_empty() && a.get_info().name.to_lowercase().contains(wanted))
    else {
        let names: Vec<_> = adapters.iter().map(|a| format!("`{}`", a.get_info().name)).collect();
        let present = if names.is_empty() { NO_DRIVER.to_owned() } else { names.join(", ") };
        return Err(RenderError::NoAdapter { wanted: name.to_owned(), present });
    };
    let device = Device::new(Gpu::open(adapter)?, scene, reference)?;
    Ok(Choice::of(Box::new(device)))
}

/// Advice when there is no Vulkan driver.
const NO_DRIVER: &str = "no Vulkan driver; Debian's package `mesa-vulkan-drivers` brings one";

/// Measures the twin, which always is there, against every GPU. Not the adapters that compute on the
/// processor: the twin does so at twice to five times their speed (benches/evaluator.rs), and opening one takes
/// as long as a small job.
fn fastest(scene: &Scene, reference: Reference) -> Choice {
    let mut best = Choice::of(Box::new(Twin::new(scene, &reference)));
    let (software, gpus): (Vec<_>, Vec<_>) =
        device::enumerate().into_iter().partition(|a| describe(a).kind == device::SOFTWARE);
    if software.is_empty() && gpus.is_empty() {
        best.notes.push(format!("{NO_DRIVER}; computing natively"));
    }
    for name in software.iter().map(|a| describe(a).name) {
        best.notes.push(format!("`{name}` is this processor, which is faster natively: left out"));
    }
    if !gpus.is_empty() {
        measure_all(&mut best, &gpus, scene, &reference);
    }
    best
}

/// Takes whoever is fastest; `best` is the twin.
fn measure_all(best: &mut Choice, gpus: &[wgpu::Adapter], scene: &Scene, reference: &Reference) {
    let sample = sample_moves(scene);
    let mut best_rate = 0.0;
    if let Ok(rate) = measure(best.evaluator.as_mut(), scene, &sample) {
        best.figures.push((best.evaluator.name(), rate));
        best_rate = rate;
    }
    for adapter in gpus {
        let info = describe(adapter);
        match measured_device(adapter, scene, reference, &sample) {
            Ok((device, rate)) => {
                best.figures.push((info.name, rate));
                if rate > best_rate {
                    (best.evaluator, best_rate) = (Box::new(device), rate);
                }
            }
            Err(e) => best.notes.push(format!("`{}` was left out: {e}", info.name)),
        }
    }
}

fn measured_device(
    adapter: &wgpu::Adapter,
    scene: &Scene,
    reference: &Reference,
    sample: &[Move],
) -> Result<(Device, f64), RenderError> {
    let mut device = Device::new(Gpu::open(adapter)?, scene, reference.clone())?;
    let rate = measure(&mut device, scene, sample)?;
    Ok((device, rate))
}

/// Evaluations per second.
fn measure(
    evaluator: &mut dyn Evaluator,
    scene: &Scene,
    sample: &[Move],
) -> Result<f64, RenderError> {
    if sample.is_empty() {
        return Ok(0.0);
    }
    // The first batch compiles and warms; it does not count.
    evaluator.evaluate(scene, sample)?;
    let start = Instant::now();
    let mut n_evaluated = 0;
    while start.elapsed() < MEASURE_FOR {
        n_evaluated += evaluator.evaluate(scene, sample)?.len();
    }
    Ok(n_evaluated as f64 / start.elapsed().as_secs_f64())
}

/// Vertices spread over the model, each moved to the middle of its triangles.
fn sample_moves(scene: &Scene) -> Vec<Move> {
    let live: Vec<_> = scene.faces.iter().flatten().collect();
    let step = live.len().div_ceil(SAMPLE).max(1);
    let mut moves: BTreeMap<u32, Move> =
        live.iter().step_by(step).map(|f| (f.vertices[0], Move::default())).collect();
    for (id, face) in scene.faces.iter().enumerate() {
        let Some(face) = face else { continue };
        for corner in face.vertices {
            if let Some(mv) = moves.get_mut(&corner)
                && mv.removed.last() != Some(&(id as u32))
            {
                let (vertices, surface) = (face.vertices, face.surface);
                mv.removed.push(id as u32);
                mv.added.push(AddedFace { face: id as u32, vertices, surface });
            }
        }
    }
    for (vertex, mv) in &mut moves {
        let corners: Vec<_> = mv.added.iter().flat_map(|a| a.vertices).collect();
        let sum: glam::DVec3 = corners.iter().map(|v| scene.position(*v)).sum();
        mv.moved.push((*vertex, sum / corners.len().max(1) as f64));
    }
    moves.into_values().collect()
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use super::super::{contract, raster};
    use super::*;

    fn chosen(choice: &str) -> Result<Choice, RenderError> {
        let scene = contract::scene(8, contract::LOOKS[0]);
        choose(choice, &scene, raster::reference(&scene))
    }

    #[test]
    fn cpu_is_the_native_twin() {
        assert_eq!(chosen("cpu").unwrap().evaluator.name(), "native");
    }

    #[test]
    fn auto_measures_gpus_and_takes_the_fastest() {
        let choice = chosen("auto").unwrap();
        let best = choice.figures.iter().max_by(|a, b| a.1.total_cmp(&b.1));
        assert_eq!(choice.evaluator.name(), best.map_or("native", |b| &b.0));
        assert!(choice.figures.iter().all(|f| f.1 > 0.0), "{:?}", choice.figures);
        let adapters = device::adapters();
        let n_gpus = adapters.iter().filter(|a| a.kind != device::SOFTWARE).count();
        if adapters.is_empty() {
            assert!(choice.notes[0].contains("mesa-vulkan-drivers"));
        }
        // Everything is accounted for: the twin has a figure where there is somebody to beat.
        let n_told = choice.figures.len() + choice.notes.len();
        assert_eq!(n_told, adapters.len().max(1) + usize::from(n_gpus > 0));
    }

    #[test]
    fn measuring_takes_the_fastest_of_all_there_are() {
        let scene = contract::scene(8, contract::LOOKS[0]);
        let reference = raster::reference(&scene);
        let mut best = Choice::of(Box::new(Twin::new(&scene, &reference)));
        measure_all(&mut best, &device::enumerate(), &scene, &reference);
        let (name, _) = best.figures.iter().max_by(|a, b| a.1.total_cmp(&b.1)).unwrap();
        assert_eq!(best.evaluator.name(), *name);
        assert_eq!(best.figures.len() + best.notes.len(), 1 + device::adapters().len());
    }

    #[test]
    fn an_unknown_name_is_an_error_that_lists_what_is_there() {
        let Err(error) = chosen("Voodoo2") else { panic!("there is no such adapter") };
        let text = error.to_string();
        assert!(text.contains("`Voodoo2`"), "{text}");
        for adapter in device::adapters() {
            assert!(text.contains(&adapter.name), "{text}");
        }
    }

    #[test]
    fn lavapipe_is_known_by_both_names() {
        if !device::adapters().iter().any(|a| a.name.contains("llvmpipe")) {
            let _ = writeln!(std::io::stderr(), "skipped: no lavapipe");
            return;
        }
        for name in ["lavapipe", "LLVMpipe"] {
            assert!(chosen(name).unwrap().evaluator.name().contains("llvmpipe"));
        }
    }
}
