//! What image-driven optimization reaches, for what work.
//!
//! Without arguments: the generated jellyfish and, where they are present, the Stanford bunny and the
//! armadillo, from memoryless and from image-driven simplification. Arguments of the form `key=value`
//! choose one experiment, so that single ones are cheap:
//!
//! | key | values | default |
//! |---|---|---|
//! | `model` | `jellyfish`, or the name of a file in the folder of test models | all three |
//! | `start` | `memoryless`, `image` (the simplifier's balanced effort), `cluster` (meshoptimizer's sloppy one) | `memoryless` |
//! | `triangles` | of the start | 1336 |
//! | `budget` | evaluations for each triangle | 300 |
//! | `looks` | times to look at unseen views | 6 |
//! | `views`, `size` | the pictures | 20, 256 |
//! | `shading` | `flat`, `smooth`, or `normals`: smooth, by normals that are optimized too | `flat` |
//! | `turn`, `others`, `sets` | view sets in turn: evaluations for each triangle of a turn, turns between, number of sets | 0 (no turns), 3, 16 |
//! | `first`, `steps`, `rest` | steps of descents: the first, those between, the last | 48, 24, 48 |
//! | `cycle` | evaluations for each triangle of a cycle of more and fewer triangles | 0 (none) |
//! | `until`, `seed`, `delta`, `solver`, `bits`, `rounds`, `edges`, `teleports`, `sweeps`, `uphill`, `holes` | the optimizer's own | its defaults |
//! | `save` | a file to write the result to (GLB) | |
//!
//! E is the energy in the run's own pictures. Unseen d2 is `compare`'s: 24 other views of 512²,
//! anti-aliased (with normals of their own, which it does not draw: 20 views turned away from the
//! run's). Seconds leave out the looking; processor seconds are those of all threads, which other
//! programs on the machine disturb less than the wall clock.

#![allow(clippy::expect_used, clippy::panic, reason = "a benchmark fails by panicking")]

mod support;

use std::{
    collections::BTreeMap,
    env, fs,
    ops::ControlFlow,
    path::PathBuf,
    str::FromStr,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Instant,
};

use lookalike::{
    cluster, compare, io, memoryless,
    mesh::{EditMesh, Mesh, MoveCount, Step, Topology},
    metric::{
        Objective, Pictures, ViewSet, bounding_sphere, reference_pictures, scene_as_drawn,
        scene_of_edit_mesh, with_vertex_normals,
    },
    optimize::{OptimizeError, Optimizer, Outcome, Params, Solver, Turns, alternate},
    render::{
        Evaluator, Move, Reference, RenderError, RenderParams, Scene, Shading, make_evaluator,
        view::{Projection, ViewParams, cameras, directions},
    },
    simplify::{self, Policy, Rules, Simplifier},
    tape::Tape,
};

use support::cpu_seconds;

fn main() {
    let options = Options::read();
    if options.0.contains_key("model") {
        return experiment(&options);
    }
    for model in ["jellyfish", "stanford_bunny", "armadillo"] {
        for start in ["memoryless", "image"] {
            experiment(&options.and("model", model).and("start", start));
        }
    }
}

/// The arguments.
#[derive(Clone)]
struct Options(BTreeMap<String, String>);

impl Options {
    fn read() -> Self {
        let pair = |a: String| a.split_once('=').map(|(k, v)| (k.to_owned(), v.to_owned()));
        Self(env::args().skip(1).filter(|a| !a.starts_with("--")).filter_map(pair).collect())
    }

    fn and(&self, key: &str, value: &str) -> Self {
        let mut all = self.clone();
        all.0.entry(key.to_owned()).or_insert_with(|| value.to_owned());
        all
    }

    fn get<T: FromStr>(&self, key: &str, default: T) -> T {
        let parse = |v: &String| v.parse().unwrap_or_else(|_| panic!("{key}={v}"));
        self.0.get(key).map_or(default, parse)
    }

    fn text(&self, key: &str, default: &str) -> String {
        self.get(key, default.to_owned())
    }

    /// The optimizer's parameters for a mesh of so many triangles.
    fn params(&self, n_triangles: u64) -> Params {
        let usual = Params::default();
        Params {
            seed: self.get("seed", usual.seed),
            max_evaluations: self.get("budget", 300) * n_triangles,
            until: self.get("until", usual.until),
            delta: self.get("delta", usual.delta),
            solver: match self.text("solver", "quadratic").as_str() {
                "simplex" => Solver::Simplex,
                _ => Solver::Quadratic,
            },
            simplex_bits: self.get("bits", usual.simplex_bits),
            quadratic_rounds: self.get("rounds", usual.quadratic_rounds),
            edges_per_iteration: self.get("edges", usual.edges_per_iteration),
            has_sweeps: self.get("sweeps", usual.has_sweeps),
            has_teleports: self.get("teleports", usual.has_teleports),
            allows_uphill: self.get("uphill", usual.allows_uphill),
            closes_holes: self.get("holes", self.text("start", "") == "cluster"),
            optimizes_normals: self.has_normals(),
            sample_every: (self.get("budget", 300) * n_triangles / 200).max(1),
            ..usual
        }
    }

    fn has_normals(&self) -> bool {
        self.text("shading", "flat") == "normals"
    }

    fn shading(&self) -> Shading {
        if self.text("shading", "flat") == "flat" { Shading::Flat } else { Shading::Smooth }
    }
}

/// One run and what came of it.
fn experiment(options: &Options) {
    let name = options.text("model", "jellyfish");
    let Some(original) = model(&name) else {
        return println!("{name}: not among the test models here, skipped");
    };
    let stage = Stage::new(&original, options);
    let start = start(&stage, &name, options);
    let start = if options.has_normals() { with_vertex_normals(start) } else { start };
    let n_triangles = start.faces.len();
    let plain = by_geometry(&original, n_triangles as u32);
    let plain = if options.has_normals() { with_vertex_normals(plain) } else { plain };
    let given: Vec<String> = options.0.iter().map(|(k, v)| format!("{k}={v}")).collect();
    println!("{}: {n_triangles} triangles", given.join(" "));
    let judge = Judge::new(&original, &stage);
    let unseen = [judge.d2(&stage, &start), judge.d2(&stage, &plain)];
    println!(
        "  unseen d2 {:.3} at the start, {:.3} memoryless (percent of full scale)",
        unseen[0], unseen[1]
    );
    let mut mesh = EditMesh::new(start.clone()).expect("a mesh");
    let params = options.params(n_triangles as u64);
    let mut watch = Watch {
        stage: &stage,
        judge: &judge,
        replay: EditMesh::new(start).expect("a mesh"),
        unseen,
        first_energy: None,
        next_look: 0,
        looks_apart: params.max_evaluations / options.get("looks", 6_u64).max(1),
        began: Instant::now(),
        cpu_at_start: cpu_seconds(),
        looking: (0.0, 0.0),
        moves: Vec::new(),
    };
    let outcome = optimize(&stage, options, &params, &mut mesh, &mut watch);
    watch.report(&outcome, &stage);
    if let Some(path) = options.0.get("save") {
        fs::write(path, io::write_glb(&mesh.snapshot()).expect("it can be written")).expect(path);
    }
}

fn optimize(
    stage: &Stage<'_>,
    options: &Options,
    params: &Params,
    mesh: &mut EditMesh,
    watch: &mut Watch<'_>,
) -> Outcome {
    let n_triangles = mesh.n_faces() as u64;
    let evaluations = options.get("turn", 0) * n_triangles;
    let mut on = |step: Step<'_>| watch.see(step);
    if evaluations == 0 {
        let mut objective = stage.objective(mesh, 0);
        return Optimizer::new(mesh, &mut objective, params.clone())
            .run(&mut on)
            .expect("the twin never fails");
    }
    let n_sets = options.get("sets", 16);
    let turns = Turns {
        n_looked_at: n_sets,
        evaluations,
        n_others: options.get("others", 3),
        steps: [options.get("first", 48), options.get("steps", 24), options.get("rest", 48)],
        cycle: options.get("cycle", 0) * n_triangles,
    };
    let center = bounding_sphere(stage.original).center;
    let set = |turn| ViewSet::turned(stage.original, &stage.pictures, center, turn);
    let sets: Vec<ViewSet> = (0..n_sets as u64).map(set).collect();
    let mut show = |set: usize, mesh: &EditMesh| Ok(stage.shown(mesh, &sets[set]));
    alternate::<OptimizeError>(mesh, params, turns, (&sets, &Tape::off()), &mut show, &mut on)
        .expect("the twin never fails")
}

/// The original in the run's pictures.
struct Stage<'m> {
    original: &'m Mesh,
    pictures: Pictures,
    reference: Reference,
    has_normals: bool,
    /// Nanoseconds spent in evaluators.
    spent: Arc<AtomicU64>,
}

impl<'m> Stage<'m> {
    fn new(original: &'m Mesh, options: &Options) -> Self {
        let view_params = ViewParams {
            directions: directions(options.get("views", 20)).expect("a view set"),
            fov_degrees: 60.0,
            projection: Projection::Perspective,
            light_degrees: 10.0,
        };
        let params = RenderParams {
            image_size: options.get("size", 256),
            shading: options.shading(),
            ambient: 0.1,
            background: 128,
            interior_views: 0,
            hides_back_faces: false,
        };
        let views = cameras(&bounding_sphere(original), &view_params);
        let pictures = Pictures::of(original, params, views);
        Self {
            original,
            reference: reference_pictures(original, &pictures),
            pictures,
            has_normals: options.has_normals(),
            spent: Arc::default(),
        }
    }

    /// The mesh in the views of a turn.
    fn objective(&self, mesh: &EditMesh, turn: u64) -> Objective {
        let center = bounding_sphere(self.original).center;
        self.shown(mesh, &ViewSet::turned(self.original, &self.pictures, center, turn))
    }

    fn shown(&self, mesh: &EditMesh, set: &ViewSet) -> Objective {
        let scene = scene_as_drawn(mesh, &set.pictures, self.has_normals);
        let reference = set.reference.clone();
        let inner = make_evaluator("cpu", &scene, reference.clone()).expect("the twin");
        let timed = Box::new(Timed { inner, spent: Arc::clone(&self.spent) });
        let objective = Objective::new(mesh, &set.pictures.palette, scene, timed);
        let objective = objective.with_reference(reference);
        if self.has_normals { objective.with_own_normals() } else { objective }
    }
}

/// An evaluator and the time spent in it.
struct Timed {
    inner: Box<dyn Evaluator>,
    spent: Arc<AtomicU64>,
}

impl Timed {
    fn add(&self, since: Instant) {
        self.spent.fetch_add(since.elapsed().as_nanos() as u64, Ordering::Relaxed);
    }
}

impl Evaluator for Timed {
    fn name(&self) -> String {
        self.inner.name()
    }

    fn evaluate(&mut self, scene: &Scene, moves: &[Move]) -> Result<Vec<i64>, RenderError> {
        let start = Instant::now();
        let result = self.inner.evaluate(scene, moves);
        self.add(start);
        result
    }

    fn commit(&mut self, scene: &mut Scene, mv: &Move) -> Result<i64, RenderError> {
        let start = Instant::now();
        let result = self.inner.commit(scene, mv);
        self.add(start);
        result
    }

    fn energy(&self) -> u64 {
        self.inner.energy()
    }

    fn picture(&mut self, scene: &Scene, view: usize) -> Result<Vec<u8>, RenderError> {
        self.inner.picture(scene, view)
    }
}

/// Judges meshes by views that no run sees.
enum Judge<'m> {
    Views(Box<compare::Reference<'m>>),
    /// `compare` draws no normals but those of the triangles.
    Turned,
}

/// A turn that no run comes to.
const UNSEEN_TURN: u64 = 1 << 20;

impl<'m> Judge<'m> {
    fn new(original: &'m Mesh, stage: &Stage<'_>) -> Self {
        if stage.has_normals {
            return Self::Turned;
        }
        let shading = match stage.pictures.params.shading {
            Shading::Flat => compare::Shading::Flat,
            Shading::Smooth => compare::Shading::Smooth,
        };
        let look = compare::Look { shading, ..compare::Look::default() };
        let params = compare::Params { look, ..compare::Params::default() };
        Self::Views(Box::new(compare::Reference::new(original, &params)))
    }

    fn d2(&self, stage: &Stage<'_>, mesh: &Mesh) -> f64 {
        match self {
            Self::Views(reference) => reference.compare(mesh).d2_percent,
            Self::Turned => {
                let mesh = EditMesh::new(mesh.clone()).expect("a mesh");
                stage.objective(&mesh, UNSEEN_TURN).d2_percent()
            }
        }
    }
}

/// Follows a run.
struct Watch<'a> {
    stage: &'a Stage<'a>,
    judge: &'a Judge<'a>,
    /// The mesh as the run's edits make it.
    replay: EditMesh,
    /// d2 on unseen views of the start and of memoryless simplification.
    unseen: [f64; 2],
    first_energy: Option<u64>,
    next_look: u64,
    looks_apart: u64,
    began: Instant,
    cpu_at_start: f64,
    /// Wall and processor seconds spent looking.
    looking: (f64, f64),
    moves: Vec<MoveCount>,
}

impl Watch<'_> {
    fn see(&mut self, step: Step<'_>) -> ControlFlow<()> {
        match step {
            Step::Edit(edit) => self.replay.redo(edit),
            Step::Sample(sample) if sample.evaluations == 0 => self.look(0),
            Step::Moves(moves) => self.moves = moves.to_vec(),
            Step::Progress { done, .. } if done >= self.next_look => self.look(done),
            Step::Sample(_) | Step::Progress { .. } => {}
        }
        ControlFlow::Continue(())
    }

    /// Wall and processor seconds of the run so far.
    fn seconds(&self) -> (f64, f64) {
        let wall = self.began.elapsed().as_secs_f64() - self.looking.0;
        (wall, cpu_seconds() - self.cpu_at_start - self.looking.1)
    }

    /// Prints how things are.
    fn look(&mut self, evaluations: u64) {
        let (wall, cpu) = self.seconds();
        let energy = self.stage.objective(&self.replay, 0).energy();
        let first = *self.first_energy.get_or_insert(energy);
        self.next_look = (evaluations / self.looks_apart.max(1) + 1) * self.looks_apart;
        let d2 = self.judge.d2(self.stage, &self.replay.snapshot());
        println!(
            "  {:>9} evaluations ({:>5.0} a triangle) {wall:>6.1} s wall {cpu:>6.1} s processor: \
             E {:>6.2}%  unseen d2 {:.4} of the start, {:.4} of memoryless",
            evaluations,
            evaluations as f64 / self.replay.n_faces() as f64,
            100.0 * energy as f64 / first as f64,
            d2 / self.unseen[0],
            d2 / self.unseen[1],
        );
        let (wall_now, cpu_now) = self.seconds();
        self.looking.0 += wall_now - wall;
        self.looking.1 += cpu_now - cpu;
    }

    /// Prints what the moves did, and where the time went.
    fn report(&mut self, outcome: &Outcome, stage: &Stage<'_>) {
        self.look(outcome.evaluations);
        let (wall, cpu) = self.seconds();
        let inside = stage.spent.load(Ordering::Relaxed) as f64 / 1e9;
        println!(
            "  stopped by {:?}; {:.0} evaluations/s of wall, {:.1} µs of processor each; {:.0}% of \
             the wall outside the evaluator; {} vertices, {} triangles, {} edges of one triangle",
            outcome.stopped_by,
            outcome.evaluations as f64 / wall,
            1e6 * cpu / outcome.evaluations as f64,
            100.0 * (1.0 - inside / wall),
            self.replay.n_vertices(),
            self.replay.n_faces(),
            boundary_edges(&self.replay),
        );
        let first = self.first_energy.unwrap_or(1) as f64;
        for m in &self.moves {
            println!(
                "  {:>16}: {:>7} tried, {:>7} accepted, {:>9} evaluations, {:>6.2}% of E",
                m.name,
                m.tried,
                m.accepted,
                m.evaluations,
                100.0 * m.reduction as f64 / first,
            );
        }
    }
}

fn boundary_edges(mesh: &EditMesh) -> usize {
    let edges = mesh.faces().flat_map(|f| {
        let [a, b, c] = mesh.vertices_of(f);
        [[a, b], [b, c], [c, a]]
    });
    edges.filter(|[a, b]| mesh.is_boundary_edge(*a, *b)).count()
}

fn model(name: &str) -> Option<Mesh> {
    if name == "jellyfish" {
        return Some(compare::sample_mesh(1, 70_000));
    }
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/models");
    let bytes = fs::read(folder.join(format!("{name}.glb"))).ok()?;
    Some(io::read(name, &bytes, &io::Limits::default()).expect("a model").mesh)
}

/// The mesh to start from. Image-driven ones take a while, so they are kept between runs.
fn start(stage: &Stage<'_>, model: &str, options: &Options) -> Mesh {
    let (kind, n) = (options.text("start", "memoryless"), options.get("triangles", 1336));
    match kind.as_str() {
        "memoryless" => by_geometry(stage.original, n),
        "cluster" => cluster::cluster(stage.original, n as usize),
        "image" => {
            let look = &stage.pictures;
            let (views, size) = (look.views.len(), look.params.image_size);
            let shading = format!("{:?}", look.params.shading).to_lowercase();
            let name = format!("{model}-{n}-{views}x{size}-{shading}.glb");
            let path = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(name);
            if !path.exists() {
                let made = io::write_glb(&by_pictures(stage, n)).expect("it can be written");
                fs::write(&path, made).expect("the folder for temporary files");
            }
            let bytes = fs::read(&path).expect("just written");
            io::read("start.glb", &bytes, &io::Limits::default()).expect("a model").mesh
        }
        path => {
            let bytes = fs::read(path).expect(path);
            io::read(path, &bytes, &io::Limits::default()).expect("a model").mesh
        }
    }
}

/// Memoryless simplification.
fn by_geometry(original: &Mesh, n: u32) -> Mesh {
    let mut mesh = EditMesh::new(original.clone()).expect("a mesh");
    let params = memoryless::Params::default();
    memoryless::simplify(&mut mesh, n, &params, &mut |_| ControlFlow::Continue(()));
    mesh.snapshot()
}

/// Image-driven simplification with balanced effort.
fn by_pictures(stage: &Stage<'_>, n: u32) -> Mesh {
    let mut mesh = EditMesh::new(by_geometry(stage.original, 4 * n)).expect("a mesh");
    let scene = scene_of_edit_mesh(&mesh, &stage.pictures);
    let evaluator = make_evaluator("cpu", &scene, stage.reference.clone()).expect("the twin");
    let mut objective = Objective::new(&mesh, &stage.pictures.palette, scene, evaluator);
    let rules = Rules { topology: Topology::Preserve, memoryless: memoryless::Params::default() };
    let params = simplify::Params {
        policy: Policy::Eager,
        rules,
        batch: simplify::BATCH,
        ahead: 1,
        search_rounds: 5,
        max_evaluations: 0,
        max_energy: None,
    };
    Simplifier::new(&mut mesh, &mut objective, params)
        .run_to(n as usize, &mut |_| ControlFlow::Continue(()))
        .expect("the twin never fails");
    mesh.snapshot()
}
