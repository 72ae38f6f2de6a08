//! Every kind of compound move, in every kind of drawing: what the evaluator accumulates is what
//! a full re-render of the edited mesh shows.

use glam::DVec3;
use proptest::prelude::*;

use super::{
    Change, Free, Objective, Pictures, bounding_sphere, reference_pictures, scene_of_edit_mesh,
    scene_with_normals, stored_normal, with_vertex_normals,
};
use crate::{
    mesh::{
        AttributeLayer, Collapse, EdgeId, EdgeTable, EditMesh, Mesh, Semantic, Split, Topology,
        VertexId, shapes,
    },
    render::{
        Move, RenderParams, Shading, Twin,
        view::{Projection, ViewParams, cameras, directions},
    },
};

/// How the model of a test is drawn.
#[derive(Clone, Copy, Debug)]
struct Look {
    shading: Shading,
    is_coloured: bool,
    has_own_normals: bool,
}

const LOOKS: [Look; 4] = [
    Look { shading: Shading::Flat, is_coloured: false, has_own_normals: false },
    Look { shading: Shading::Flat, is_coloured: true, has_own_normals: false },
    Look { shading: Shading::Smooth, is_coloured: true, has_own_normals: false },
    Look { shading: Shading::Smooth, is_coloured: false, has_own_normals: true },
];

fn pictures(mesh: &Mesh, shading: Shading) -> Pictures {
    let view_params = ViewParams {
        directions: directions(4).unwrap(),
        fov_degrees: 60.0,
        projection: Projection::Perspective,
        light_degrees: 10.0,
    };
    let params = RenderParams {
        image_size: 64,
        shading,
        ambient: 0.1,
        background: 128,
        interior_views: 1,
        hides_back_faces: false,
    };
    Pictures::of(mesh, params, cameras(&bounding_sphere(mesh), &view_params))
}

/// A grey of its own at every vertex.
fn coloured(mut mesh: Mesh) -> Mesh {
    let grey = |v: usize| [((v * 37) % 97) as f32 / 97.0; 4];
    mesh.face_wedges = mesh.faces.clone();
    mesh.layers.push(AttributeLayer {
        semantic: Semantic::Color(0),
        width: 4,
        values: (0..mesh.positions.len()).flat_map(grey).collect(),
    });
    mesh
}

struct Bench {
    look: Look,
    pictures: Pictures,
    original: Mesh,
    mesh: EditMesh,
    objective: Objective,
}

impl Bench {
    fn new(look: Look) -> Self {
        let mut original = shapes::torus(10, 7, 0.15);
        if look.is_coloured {
            original = coloured(original);
        }
        if look.has_own_normals {
            original = with_vertex_normals(original);
        }
        let pictures = pictures(&original, look.shading);
        let mesh = EditMesh::new(original.clone()).unwrap();
        let objective = show(look, &pictures, &original, &mesh);
        Self { look, pictures, original, mesh, objective }
    }

    /// The energy of the mesh as it is, from nothing.
    fn energy_of_re_render(&self) -> u64 {
        show(self.look, &self.pictures, &self.original, &self.mesh).energy()
    }

    fn free(&self, vertices: &[VertexId], off: DVec3) -> Vec<Free> {
        let free = |&v: &VertexId| Free {
            vertex: v,
            at: self.mesh.position(v) + off,
            normal: stored_normal(&self.mesh, v).unwrap_or_default() + off,
        };
        vertices.iter().map(free).collect()
    }

    /// Makes a move in pictures and mesh; the judged change must be what happens.
    fn make(&mut self, mv: &Move, edit: impl FnOnce(&mut EditMesh)) {
        let judged = self.objective.evaluate(std::slice::from_ref(mv)).unwrap()[0];
        let before = self.objective.energy();
        let back = self.objective.inverse(&self.mesh, mv);
        assert_eq!(self.objective.commit(mv).unwrap(), judged);
        assert_eq!(self.objective.commit(&back).unwrap(), -judged);
        assert_eq!(self.objective.energy(), before);
        self.objective.commit(mv).unwrap();
        edit(&mut self.mesh);
        self.mesh.validate().unwrap();
        self.objective.follow(&self.mesh);
    }

    /// Tries the edit that four random numbers choose.
    fn edit(&mut self, [what, which, x, y]: [u32; 4]) {
        let edges = EdgeTable::new(&self.mesh);
        let [a, b] = edges.ends(EdgeId(which % edges.n_slots() as u32));
        let part = |n: u32| f64::from(n % 200) / 1000.0 - 0.1;
        let off = DVec3::new(part(x), part(y), part(x ^ y));
        let middle = self.mesh.position(a).midpoint(self.mesh.position(b)) + off;
        match what % 4 {
            0 => self.displace(&[a, b], off),
            1 => self.swap(a, b, off),
            2 => self.split(a, b, middle),
            _ => self.collapse(a, b, middle),
        }
    }

    fn displace(&mut self, vertices: &[VertexId], off: DVec3) {
        let free = self.free(vertices, off);
        let template = self.objective.template(&self.mesh, Change::Nothing, &free).unwrap();
        let mv = template.start().clone();
        self.make(&mv, |mesh| settle(mesh, &free));
    }

    fn swap(&mut self, a: VertexId, b: VertexId, off: DVec3) {
        let Some(plan) = self.mesh.plan_swap(a, b) else { return };
        let free = self.free(&plan.apexes, off);
        let change = Change::Swap(&plan);
        let template = self.objective.template(&self.mesh, change, &free).unwrap();
        let mv = template.start().clone();
        self.make(&mv, |mesh| {
            mesh.reswap(&plan);
            settle(mesh, &free);
        });
    }

    fn split(&mut self, a: VertexId, b: VertexId, at: DVec3) {
        let Some(plan) = self.mesh.plan_split(a, b, at) else { return };
        let mut free = vec![Free { vertex: plan.vertex, at, normal: at }];
        free.extend(self.free(&[a], DVec3::Y * 0.02));
        let template = self.objective.template(&self.mesh, Change::Split(&plan), &free).unwrap();
        let mv = template.start().clone();
        self.make(&mv, |mesh| {
            mesh.redo(&Split { at, ..plan });
            settle(mesh, &free);
        });
    }

    fn collapse(&mut self, a: VertexId, b: VertexId, to: DVec3) {
        if !self.mesh.may_collapse(a, b, Topology::Preserve) || self.mesh.n_faces() < 60 {
            return;
        }
        let plan = self.mesh.plan_collapse(a, b, to);
        let free = [Free { vertex: a, at: to, normal: to }];
        let change = Change::Collapse(&plan);
        let Some(template) = self.objective.template(&self.mesh, change, &free) else { return };
        let mv = template.start().clone();
        if self.look.is_coloured || self.look.shading == Shading::Flat {
            let other = self.objective.collapse_move(&self.mesh, &plan).unwrap();
            let judged = self.objective.evaluate(&[mv.clone(), other]).unwrap();
            assert_eq!(judged[0], judged[1], "the two ways to plan a collapse disagree");
        }
        self.make(&mv, |mesh| {
            mesh.redo(&Collapse { to, ..plan });
            settle(mesh, &free);
        });
    }
}

fn show(look: Look, pictures: &Pictures, original: &Mesh, mesh: &EditMesh) -> Objective {
    let reference = reference_pictures(original, pictures);
    let scene = if look.has_own_normals {
        scene_with_normals(mesh, pictures)
    } else {
        scene_of_edit_mesh(mesh, pictures)
    };
    let twin = Twin::new(&scene, &reference);
    let objective = Objective::new(mesh, &pictures.palette, scene, Box::new(twin));
    if look.has_own_normals { objective.with_own_normals() } else { objective }
}

/// Moves vertices, and sets their normals where the mesh has some.
fn settle(mesh: &mut EditMesh, free: &[Free]) {
    for f in free {
        mesh.move_vertex(f.vertex, f.at);
    }
    let normals: Vec<_> = free.iter().map(|f| (f.vertex, f.normal.as_vec3().to_array())).collect();
    mesh.revalue(Semantic::Normal, &normals);
}

#[test]
fn energy_accumulated_over_compound_moves_is_that_of_a_re_render() {
    let config = proptest::test_runner::Config { cases: 6, ..Default::default() };
    for look in LOOKS {
        proptest!(config.clone(), |(choices in prop::collection::vec(any::<[u32; 4]>(), 1..40))| {
            let mut bench = Bench::new(look);
            for choice in choices {
                bench.edit(choice);
            }
            prop_assert_eq!(bench.objective.energy(), bench.energy_of_re_render());
        });
    }
}

#[test]
fn a_template_may_be_filled_in_again_and_again() {
    for look in LOOKS {
        let mut bench = Bench::new(look);
        let free = bench.free(&[VertexId(3), VertexId(4)], DVec3::ZERO);
        let template = bench.objective.template(&bench.mesh, Change::Nothing, &free).unwrap();
        let normals: Vec<DVec3> = free.iter().map(|f| f.normal).collect();
        for k in 1..5 {
            let off = DVec3::new(0.01, -0.02, 0.03) * f64::from(k);
            let places: Vec<DVec3> = free.iter().map(|f| f.at + off).collect();
            let from_template = template.at(&places, &normals);
            let moved: Vec<Free> =
                free.iter().zip(&places).map(|(f, at)| Free { at: *at, ..*f }).collect();
            let anew = bench.objective.template(&bench.mesh, Change::Nothing, &moved).unwrap();
            let judged = bench.objective.evaluate(&[from_template, anew.start().clone()]).unwrap();
            assert_eq!(judged[0], judged[1], "{look:?}");
        }
    }
}

#[test]
fn a_move_that_raises_the_energy_leaves_no_trace() {
    let mut bench = Bench::new(LOOKS[0]);
    let free = bench.free(&[VertexId(0)], DVec3::splat(0.2));
    let template = bench.objective.template(&bench.mesh, Change::Nothing, &free).unwrap();
    let before: Vec<_> = (0..4).map(|v| bench.objective.picture(v).unwrap()).collect();
    let made = bench.objective.commit_if_better(&bench.mesh, template.start()).unwrap();
    assert_eq!((made, bench.objective.energy()), (None, 0));
    let after: Vec<_> = (0..4).map(|v| bench.objective.picture(v).unwrap()).collect();
    assert!(before == after);
}

#[test]
fn turned_cameras_still_see_the_whole_model() {
    let original = shapes::torus(10, 7, 0.15);
    let pictures = pictures(&original, Shading::Flat);
    let sphere = bounding_sphere(&original);
    let same = pictures.turned(sphere.center, 0);
    assert_eq!(same.views, pictures.views);
    for turn in 1..20 {
        let turned = pictures.turned(sphere.center, turn);
        assert_ne!(turned.views, pictures.views);
        for view in &turned.views {
            let p = original.positions.iter().map(|p| view.project(*p));
            let inside = |x: f64| (-1e-9..=1.0 + 1e-9).contains(&x);
            assert!(p.clone().all(|p| inside(p.x) && inside(p.y) && inside(p.depth)));
        }
    }
}
