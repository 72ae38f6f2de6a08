//! Edge collapse in the most obvious way, to compare with: lists of faces, no connectivity.

use glam::DVec3;
use serde_json::json;

use crate::mesh::{
    AttributeLayer, Collapse, Corner, FaceId, Image, Material, Mesh, Node, Part, RemovedFace,
    Rewedged, Semantic, Texture, TextureUse, Tree, VertexId, WedgeId, Wrap,
};

/// A small random number generator (SplitMix64), so that a sequence is given by one seed.
#[derive(Clone, Debug)]
pub(super) struct Rng(pub(super) u64);

impl Rng {
    pub(super) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    pub(super) fn below(&mut self, n: usize) -> usize {
        (self.next() % n.max(1) as u64) as usize
    }

    /// In −1..1, all bits of the fraction in use.
    pub(super) fn signed(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    }
}

/// The reference mesh: ids never change, dead faces are `None`.
#[derive(Clone, Debug)]
pub(super) struct Plain {
    pub(super) positions: Vec<DVec3>,
    pub(super) faces: Vec<Option<[u32; 3]>>,
    pub(super) wedges: Vec<[u32; 3]>,
    /// All layers of each wedge.
    values: Vec<Vec<f32>>,
    source: Mesh,
}

impl Plain {
    pub(super) fn of(mesh: &Mesh) -> Self {
        let values = (0..mesh.n_wedges() as u32)
            .map(|w| mesh.layers.iter().flat_map(|l| l.get(WedgeId(w)).to_vec()).collect());
        Self {
            positions: mesh.positions.clone(),
            faces: mesh.faces.iter().map(|f| Some(*f)).collect(),
            wedges: mesh.face_wedges.clone(),
            values: values.collect(),
            source: mesh.clone(),
        }
    }

    fn alive(&self) -> impl Iterator<Item = (usize, [u32; 3])> + '_ {
        self.faces.iter().enumerate().filter_map(|(i, f)| f.map(|f| (i, f)))
    }

    /// A random side of a random face; `None` when no face is left.
    pub(super) fn random_edge(&self, rng: &mut Rng) -> Option<(u32, u32)> {
        let alive: Vec<_> = self.alive().collect();
        let (_, face) = alive.get(rng.below(alive.len()))?;
        let k = rng.below(3);
        Some((face[k], face[(k + 1 + rng.below(2)) % 3]))
    }

    /// Collapses (keep, drop) with random placement and, if there are layers, random wedges: kept,
    /// merged into a new one, or taken from elsewhere; now and then outside the ring or unused.
    pub(super) fn collapse(&mut self, keep: u32, drop: u32, rng: &mut Rng) -> Collapse {
        let (a, b) = (self.positions[keep as usize], self.positions[drop as usize]);
        let to = match rng.below(5) {
            0 => a,
            1 => b,
            2 => (a + b) / 2.0,
            _ => (a + b) / 2.0 + DVec3::new(rng.signed(), rng.signed(), rng.signed()) * 0.01,
        };
        let mut c = Collapse {
            keep: VertexId(keep),
            drop: VertexId(drop),
            keep_from: a,
            drop_from: b,
            to,
            removed: Vec::new().into(),
            moved: Vec::new().into(),
            rewedged: Vec::new().into(),
            first_new_wedge: WedgeId(self.values.len() as u32),
            new_wedges: Vec::new(),
        };
        for (i, face) in self.alive().filter(|(_, f)| f.contains(&drop)) {
            if face.contains(&keep) {
                let wedges = self.wedges.get(i).copied().unwrap_or_default().map(WedgeId);
                let (face, vertices) = (FaceId(i as u32), face.map(VertexId));
                c.removed.push(RemovedFace { face, vertices, wedges });
            } else {
                let k = face.iter().position(|v| *v == drop).unwrap();
                c.moved.push(Corner::new(FaceId(i as u32), k));
            }
        }
        self.apply_shape(&c);
        if !self.wedges.is_empty() {
            self.change_wedges(&mut c, rng);
        }
        c
    }

    fn apply_shape(&mut self, c: &Collapse) {
        self.positions[c.keep.index()] = c.to;
        for face in &c.removed {
            self.faces[face.face.index()] = None;
        }
        for corner in &c.moved {
            if let Some(face) = &mut self.faces[corner.face().index()] {
                face[corner.k()] = c.keep.0;
            }
        }
    }

    fn change_wedges(&mut self, c: &mut Collapse, rng: &mut Rng) {
        let width = self.values.first().map_or(0, Vec::len);
        let n_new = rng.below(3);
        for _ in 0..n_new {
            let like = self.values[rng.below(self.values.len())].clone();
            self.values.push(like.iter().map(|v| v + rng.signed() as f32 * 0.1).collect());
        }
        for values in &self.values[c.first_new_wedge.index()..] {
            assert_eq!(values.len(), width);
            c.new_wedges.extend(values);
        }
        let policy = rng.below(4);
        let at_random = self.values.len();
        for (i, face) in self.faces.iter().enumerate() {
            let Some(face) = face else { continue };
            for (k, vertex) in face.iter().enumerate() {
                let wedge = &mut self.wedges[i][k];
                let is_changed = match policy {
                    0 => false,
                    1 => *vertex == c.keep.0,
                    2 => *vertex == c.keep.0 && rng.below(2) == 0,
                    _ => rng.below(20) == 0,
                };
                let last = at_random as u32 - 1;
                let to = if policy == 1 { last } else { rng.below(at_random) as u32 };
                if is_changed && *wedge != to {
                    let corner = Corner::new(FaceId(i as u32), k);
                    c.rewedged.push(Rewedged { corner, from: WedgeId(*wedge), to: WedgeId(to) });
                    *wedge = to;
                }
            }
        }
    }

    /// The level as a mesh: faces in order, used vertices and wedges in order.
    pub(super) fn mesh(&self) -> Mesh {
        let alive: Vec<_> = self.alive().collect();
        let faces: Vec<_> = alive.iter().map(|(_, f)| *f).collect();
        let wedges: Vec<_> =
            alive.iter().filter_map(|(i, _)| self.wedges.get(*i).copied()).collect();
        let used = |list: &[[u32; 3]]| {
            let mut ids: Vec<u32> = list.iter().flatten().copied().collect();
            ids.sort_unstable();
            ids.dedup();
            ids
        };
        let (used_vertices, used_wedges) = (used(&faces), used(&wedges));
        let place = |ids: &[u32], id: u32| ids.binary_search(&id).unwrap() as u32;
        let mut begin = 0;
        let mut layers = Vec::new();
        for layer in &self.source.layers {
            let of = |w: &u32| self.values[*w as usize][begin..begin + layer.width].to_vec();
            let values = used_wedges.iter().flat_map(of).collect();
            layers.push(AttributeLayer { semantic: layer.semantic, width: layer.width, values });
            begin += layer.width;
        }
        let materials = &self.source.face_materials;
        let parts = &self.source.face_parts;
        Mesh {
            positions: used_vertices.iter().map(|v| self.positions[*v as usize]).collect(),
            faces: faces.iter().map(|f| f.map(|v| place(&used_vertices, v))).collect(),
            face_wedges: wedges.iter().map(|f| f.map(|w| place(&used_wedges, w))).collect(),
            face_materials: alive.iter().filter_map(|(i, _)| materials.get(*i).copied()).collect(),
            layers,
            materials: self.source.materials.clone(),
            textures: self.source.textures.clone(),
            images: self.source.images.clone(),
            face_parts: alive.iter().filter_map(|(i, _)| parts.get(*i).copied()).collect(),
            tree: self.source.tree.clone(),
        }
    }
}

/// What a test mesh has beside positions and faces.
#[derive(Clone, Copy, Debug)]
#[expect(clippy::struct_excessive_bools, reason = "independent properties of a test mesh")]
pub(super) struct Extras {
    pub(super) layers: bool,
    pub(super) materials: bool,
    pub(super) parts: bool,
    /// Third triangles on edges, vertices and wedges that no face uses.
    pub(super) ugly: bool,
}

/// A bumpy grid of `n` × `n` squares at single-precision points.
pub(super) fn grid(n: usize, extras: Extras, rng: &mut Rng) -> Mesh {
    let mut mesh = Mesh::default();
    for i in 0..(n + 1) * (n + 1) {
        let (x, y) = ((i % (n + 1)) as f64, (i / (n + 1)) as f64);
        let p = DVec3::new(x + 0.3 * rng.signed(), y + 0.3 * rng.signed(), rng.signed());
        mesh.positions.push(p.as_vec3().as_dvec3());
    }
    let at = |x: usize, y: usize| (y * (n + 1) + x) as u32;
    for (x, y) in (0..n * n).map(|i| (i % n, i / n)) {
        let [a, b, c, d] = [at(x, y), at(x + 1, y), at(x, y + 1), at(x + 1, y + 1)];
        mesh.faces.extend([[a, b, c], [c, b, d]]);
    }
    if extras.ugly {
        mesh.positions.push(DVec3::new(-0.0, 1e-300, 5.0));
        mesh.positions.push(DVec3::new(0.1, 0.2, 0.3));
        let last = mesh.positions.len() as u32 - 1;
        mesh.faces.extend([[0, 1, last], [last, 1, 2], [0, 1, 2]]);
    }
    if extras.layers {
        add_layers(&mut mesh, extras.ugly, rng);
    }
    if extras.materials {
        mesh.face_materials = mesh.faces.iter().map(|f| f[0] / 7 % 3).collect();
        mesh.materials = (0..3)
            .map(|i| Material {
                name: format!("m{i}"),
                base_color: [0.1, 1.0 / 3.0, i as f32, 1.0],
                base_texture: (i == 1).then_some(TextureUse {
                    texture: 1,
                    tex_coord: 2,
                    transform: [[0.1, -0.0, 1e-30], [1.0 / 3.0, 3e38, 0.0]],
                }),
                source: (i == 2).then(|| json!({ "name": "m2", "extras": [0.1, -1, null] })),
                ..Material::default()
            })
            .collect();
        add_textures(&mut mesh);
    }
    if extras.parts {
        add_parts(&mut mesh);
    }
    mesh
}

/// Parts in runs and alone, below a node that places none; one part has no triangle.
fn add_parts(mesh: &mut Mesh) {
    mesh.face_parts = mesh.faces.iter().map(|f| [0, 2, 3, 2][f[0] as usize / 3 % 4]).collect();
    let node = |name: &str, parent| Node { name: name.to_owned(), parent, transform: None };
    let nodes = [node("root", None), node("", Some(0)), node("a \"b\" ü", Some(0)), node("", None)];
    let part = |node| Part { node, mesh: format!("mesh {node}"), skin: None };
    let parts = vec![part(1), part(2), part(3), part(0)];
    mesh.tree = Tree { nodes: nodes.to_vec(), parts, skins: Vec::new() }.into();
}

/// Of four images the second has no bytes, the last shares those of the first.
fn add_textures(mesh: &mut Mesh) {
    let image = |i: usize, bytes: &[u8]| Image {
        name: format!("i{i}"),
        mime: "image/png".to_owned(),
        bytes: bytes.into(),
        pixels: None,
    };
    mesh.images = vec![image(0, b"one"), image(1, b""), image(2, &[0; 99]), image(3, b"")];
    mesh.images[3].bytes = mesh.images[0].bytes.clone();
    mesh.textures = vec![
        Texture { name: "t".to_owned(), image: Some(2), ..Texture::default() },
        Texture {
            image: Some(0),
            fallback: Some(9),
            wrap: [Wrap::Clamp, Wrap::Mirror],
            filters: [Some(9729), None],
            ..Texture::default()
        },
    ];
}

/// Normals and coordinates: a wedge per vertex, and one more per vertex on every fourth row.
fn add_layers(mesh: &mut Mesh, ugly: bool, rng: &mut Rng) {
    let n = mesh.positions.len() as u32;
    let wedge =
        |f: usize, v: u32| if v.is_multiple_of(4) && f.is_multiple_of(2) { n + v / 4 } else { v };
    mesh.face_wedges =
        mesh.faces.iter().enumerate().map(|(f, face)| face.map(|v| wedge(f, v))).collect();
    let n_wedges = (n + n / 4 + 1 + u32::from(ugly)) as usize;
    for (semantic, width) in [(Semantic::Normal, 3), (Semantic::TexCoord(0), 2)] {
        let values = (0..n_wedges * width).map(|_| rng.signed() as f32).collect();
        mesh.layers.push(AttributeLayer { semantic, width, values });
    }
}

/// Every level of a random sequence, fine to coarse, and the records between them.
pub(super) fn sequence(mesh: &Mesh, n: usize, rng: &mut Rng) -> (Vec<Mesh>, Vec<Collapse>) {
    let mut plain = Plain::of(mesh);
    let (mut levels, mut records) = (vec![mesh.clone()], Vec::new());
    for _ in 0..n {
        let Some((keep, drop)) = plain.random_edge(rng) else { break };
        records.push(plain.collapse(keep, drop, rng));
        levels.push(plain.mesh());
    }
    (levels, records)
}
