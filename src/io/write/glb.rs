//! GLB (glTF 2.0), valid by the rules of the Khronos validator.
//!
//! One mesh and node for each part that has triangles (`nodes`); in it one primitive per material
//! that its faces use, in the order of materials; within that the faces keep their order. Each
//! accessor has a buffer view of its own, in the order indices, positions, attributes (`store`);
//! images follow (`appearance`). What glTF demands is put right on the way: normals and tangents are
//! brought to length 1, colours into 0..=1, texture-coordinate and colour sets are numbered without
//! gaps. Custom layers of up to four values are written as `_CUSTOM_n`. Skins come first (`skins`).

use glam::{DVec3, Vec3};
use serde_json::{Value, json};

use super::{
    IoError,
    appearance::Appearance,
    check,
    columns::Grid,
    nodes::put_nodes,
    points::Points,
    skins::{SkinOfPart, Skins, put_skins},
    store::{MESHOPT, Store},
};
use crate::{
    io::weld::{area_normals, unit_or_z},
    mesh::{AttributeLayer, FaceId, Mesh, Semantic},
};

const QUANTIZATION: &str = "KHR_mesh_quantization";
const LOD: &str = "MSFT_lod";
/// How far from 1 a squared length may be and still count as unit (single precision rounds).
const UNIT_TOLERANCE: f32 = 1e-5;

/// How much room numbers take.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GlbOptions {
    /// Integers (KHR_mesh_quantization): positions and texture coordinates of 16 bits, normals of 8.
    pub quantize: bool,
    /// Compressed too (EXT_meshopt_compression); implies `quantize`.
    pub compress: bool,
}

/// One of several levels of detail in a file.
#[derive(Clone, Copy, Debug)]
pub struct GlbLevel<'a> {
    /// Name of its node.
    pub name: &'a str,
    /// What it shows; all levels have the materials, textures and images of the first.
    pub mesh: &'a Mesh,
    /// The least share of the screen at which it is shown.
    pub screen_coverage: f64,
}

/// Writes the mesh, with the nodes that its parts come from.
///
/// # Errors
/// [`IoError::Unwritable`] for a mesh without triangles, one that breaks its invariants, or one
/// over the 4 GiB of the format.
pub fn write_glb(mesh: &Mesh) -> Result<Vec<u8>, IoError> {
    write_glb_with(mesh, GlbOptions::default())
}

/// Likewise, with other options.
///
/// # Errors
/// As [`write_glb`].
pub fn write_glb_with(mesh: &Mesh, options: GlbOptions) -> Result<Vec<u8>, IoError> {
    check("GLB", mesh)?;
    let mut file = Builder::new(&[mesh], options);
    let roots = file.level(mesh)?;
    roots.iter().for_each(|root| file.undo_grid(*root));
    file.finish(mesh, &roots)
}

/// Writes several levels into one file, the finest first (MSFT_lod): each has a node of its own at
/// the top, and the finest one, which alone is in the scene, names the others.
///
/// # Errors
/// As [`write_glb`], for any of the levels, or where there is none.
pub fn write_lods(levels: &[GlbLevel<'_>], options: GlbOptions) -> Result<Vec<u8>, IoError> {
    let Some(finest) = levels.first() else {
        let problem = "there is no level".to_owned();
        return Err(IoError::Unwritable { format: "GLB", problem });
    };
    levels.iter().try_for_each(|level| check("GLB", level.mesh))?;
    let meshes: Vec<&Mesh> = levels.iter().map(|level| level.mesh).collect();
    let mut file = Builder::new(&meshes, options);
    let mut tops = Vec::with_capacity(levels.len());
    for level in levels {
        let children = file.level(level.mesh)?;
        tops.push(file.nodes.len());
        file.nodes.push(json!({ "name": level.name, "children": children }));
        file.undo_grid(file.nodes.len() - 1);
    }
    let coverage: Vec<f64> = levels.iter().map(|level| level.screen_coverage).collect();
    let first = &mut file.nodes[tops[0]];
    first["extras"] = json!({ "MSFT_screencoverage": coverage });
    if tops.len() > 1 {
        first["extensions"] = json!({ LOD: { "ids": tops[1..] } });
        file.extensions.push((LOD, false));
    }
    file.finish(finest.mesh, &tops[..1])
}

/// A document under construction.
struct Builder {
    store: Store,
    meshes: Vec<Value>,
    nodes: Vec<Value>,
    grid: Option<Grid>,
    skins: Skins,
    /// Names of extensions, and whether a reader must know them.
    extensions: Vec<(&'static str, bool)>,
}

impl Builder {
    fn new(meshes: &[&Mesh], options: GlbOptions) -> Self {
        let store = Store::new(options);
        let GlbOptions { quantize, compress } = store.options;
        let used = [(QUANTIZATION, quantize), (MESHOPT, compress)];
        let mut file = Self {
            grid: if quantize { Some(Grid::of(meshes)) } else { Grid::near(meshes) },
            store,
            meshes: Vec::new(),
            nodes: Vec::new(),
            skins: Skins::default(),
            extensions: used.into_iter().filter(|(_, is_used)| *is_used).collect(),
        };
        if let Some(finest) = meshes.first() {
            let Self { nodes, store, grid, .. } = &mut file;
            file.skins = put_skins(nodes, store, &finest.tree, grid.as_ref());
        }
        file
    }

    /// Adds meshes and nodes of a level; returns the nodes at its top.
    fn level(&mut self, mesh: &Mesh) -> Result<Vec<usize>, IoError> {
        let key = |f: u32| (mesh.part_of(FaceId(f)), mesh.material_of(FaceId(f)));
        let mut faces: Vec<u32> = (0..mesh.faces.len() as u32).collect();
        faces.sort_by_key(|f| key(*f));
        let mut mesh_of_part = Vec::new();
        for of_part in faces.chunk_by(|a, b| key(*a).0 == key(*b).0) {
            let part = key(of_part[0]).0 as usize;
            let by_material = of_part.chunk_by(|a, b| key(*a) == key(*b));
            let skin = self.skins.of_part(&mesh.tree, part);
            let primitives: Result<Vec<Value>, _> = by_material
                .map(|faces| self.primitive(mesh, key(faces[0]).1, faces, skin.as_ref()))
                .collect();
            let mut value = json!({ "primitives": primitives? });
            if let Some(part) = mesh.tree.parts.get(part).filter(|part| !part.mesh.is_empty()) {
                value["name"] = part.mesh.clone().into();
            }
            mesh_of_part.resize(part, None);
            mesh_of_part.push(Some((self.meshes.len(), skin.map(|skin| skin.index))));
            self.meshes.push(value);
        }
        Ok(put_nodes(&mut self.nodes, &mesh.tree, &mesh_of_part))
    }

    /// Brings the steps of the grid, if there is one, back below a node; what a skin moves it brings back itself.
    fn undo_grid(&mut self, node: usize) {
        let value = &self.nodes[node];
        if value.get("skin").is_some() && value.get("children").is_none() {
            return;
        }
        self.grid.iter().for_each(|grid| grid.put_transform(&mut self.nodes[node]));
    }

    fn primitive(
        &mut self,
        mesh: &Mesh,
        material: u32,
        faces: &[u32],
        skin: Option<&SkinOfPart>,
    ) -> Result<Value, IoError> {
        let mut points = Points::of(mesh, faces);
        points.part();
        if self.store.options.compress {
            points.reorder();
        }
        let indices = self.store.indices(&points)?;
        let mut attributes = serde_json::Map::new();
        let positions = self.store.positions(mesh, &points, self.grid.as_ref())?;
        attributes.insert("POSITION".to_owned(), positions.into());
        let mut sets = [0, 0];
        // glTF has no type for other widths.
        for layer in sorted_layers(mesh).into_iter().filter(|l| (1..=4).contains(&l.width)) {
            let name = match layer.semantic {
                Semantic::Skin => continue,
                Semantic::Normal => "NORMAL".to_owned(),
                Semantic::Tangent => "TANGENT".to_owned(),
                Semantic::TexCoord(_) => numbered("TEXCOORD", &mut sets[0]),
                Semantic::Color(_) => numbered("COLOR", &mut sets[1]),
                Semantic::Custom(id) => format!("_CUSTOM_{id}"),
            };
            let values = file_values(layer, mesh, &points);
            let accessor = self.store.attribute(layer.semantic, &values, layer.width)?;
            attributes.insert(name, accessor.into());
        }
        if let (Some(skin), Some(layer)) = (skin, mesh.layer(Semantic::Skin)) {
            attributes.extend(skin.put_attributes(&mut self.store, points.values(layer))?);
        }
        let mut primitive = json!({ "attributes": attributes, "indices": indices, "mode": 4 });
        if !mesh.materials.is_empty() {
            primitive["material"] = material.into();
        }
        Ok(primitive)
    }

    /// The file: `mesh` gives the materials, the scene has these nodes.
    fn finish(mut self, mesh: &Mesh, scene: &[usize]) -> Result<Vec<u8>, IoError> {
        let mut appearance = Appearance::of(mesh, &mut |bytes| self.store.view(bytes));
        for (name, is_required) in &self.extensions {
            appearance.use_extension(name, *is_required);
        }
        let scene = [scene, &self.skins.roots].concat();
        let generator = concat!("Lookalike ", env!("CARGO_PKG_VERSION"));
        let mut document = json!({
            "asset": { "version": "2.0", "generator": generator },
            "scene": 0,
            "scenes": [{ "nodes": scene }],
            "nodes": self.nodes,
            "meshes": self.meshes,
            "accessors": self.store.accessors,
            "bufferViews": self.store.views,
            "buffers": self.store.buffers(),
        });
        if !self.skins.values.is_empty() {
            document["skins"] = self.skins.values.into();
        }
        appearance.put_into(&mut document);
        pack(document.to_string().into_bytes(), &self.store.bin)
    }
}

/// Layers in ascending order of their sets, so that numbering without gaps keeps the order.
fn sorted_layers(mesh: &Mesh) -> Vec<&AttributeLayer> {
    let mut layers: Vec<_> = mesh.layers.iter().collect();
    layers.sort_by_key(|l| match l.semantic {
        Semantic::TexCoord(set) | Semantic::Color(set) => set,
        _ => 0,
    });
    layers
}

fn numbered(stem: &str, next: &mut u32) -> String {
    *next += 1;
    format!("{stem}_{}", *next - 1)
}

/// The values of a layer at each point, as glTF allows them.
fn file_values(layer: &AttributeLayer, mesh: &Mesh, points: &Points) -> Vec<f32> {
    let mut values: Vec<f32> = points.values(layer).flatten().copied().collect();
    match (layer.semantic, layer.width) {
        (Semantic::Normal, 3) => {
            let instead = point_normals(mesh, points, &values);
            make_unit(&mut values, &instead);
        }
        (Semantic::Tangent, 4) => {
            for t in values.as_chunks_mut::<4>().0 {
                let [x, y, z, w] = *t;
                let [x, y, z] = unit([x, y, z]).unwrap_or([1.0, 0.0, 0.0]);
                *t = [x, y, z, if w < 0.0 { -1.0 } else { 1.0 }];
            }
        }
        (Semantic::Color(_), _) => values.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0)),
        _ => {}
    }
    values
}

/// Area-weighted normals of the points, computed only where a stored one has no direction.
fn point_normals(mesh: &Mesh, points: &Points, normals: &[f32]) -> Vec<DVec3> {
    if normals.as_chunks().0.iter().all(|n| unit(*n).is_some()) {
        return Vec::new();
    }
    let positions: Vec<DVec3> = points.positions(mesh).collect();
    area_normals(&positions, &points.triangles)
}

fn make_unit(normals: &mut [f32], instead: &[DVec3]) {
    for (i, n) in normals.as_chunks_mut::<3>().0.iter_mut().enumerate() {
        *n = unit(*n)
            .unwrap_or_else(|| unit_or_z(instead.get(i).copied().unwrap_or(DVec3::Z)).to_array());
    }
}

/// `v` at length 1; unchanged where it is that already, so that reading and writing again changes
/// nothing.
fn unit(v: [f32; 3]) -> Option<[f32; 3]> {
    let vector = Vec3::from_array(v);
    if (vector.length_squared() - 1.0).abs() < UNIT_TOLERANCE {
        return Some(v);
    }
    vector.as_dvec3().try_normalize().map(|u| u.as_vec3().to_array())
}

/// Header, JSON chunk padded with spaces, binary chunk padded with zeros.
fn pack(mut json: Vec<u8>, bin: &[u8]) -> Result<Vec<u8>, IoError> {
    json.resize(json.len().next_multiple_of(4), b' ');
    let total = 12 + 8 + json.len() + 8 + bin.len();
    let word = |n: usize| {
        u32::try_from(n).map(u32::to_le_bytes).map_err(|_| IoError::Unwritable {
            format: "GLB",
            problem: format!("{total} bytes are over the 4 GiB of the format"),
        })
    };
    let mut file = Vec::with_capacity(total);
    file.extend_from_slice(b"glTF\x02\0\0\0");
    file.extend_from_slice(&word(total)?);
    file.extend_from_slice(&word(json.len())?);
    file.extend_from_slice(b"JSON");
    file.append(&mut json);
    file.extend_from_slice(&word(bin.len())?);
    file.extend_from_slice(b"BIN\0");
    file.extend_from_slice(bin);
    Ok(file)
}
