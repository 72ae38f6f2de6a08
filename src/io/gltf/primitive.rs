//! Primitives: attributes and triangles of a placed mesh, in world space.

use glam::{DMat3, DMat4, DVec3};
use gltf::json::{
    accessor::Type,
    mesh::{Mode, Primitive, Semantic as JsonSemantic},
    validation::Checked,
};

use super::{
    super::soup::{Attribute, Patch, PatchMaterials, PointMarks, defaults_of},
    Document, IoError, REMEDY, Soup,
    draco::Packed,
    material::default_material,
    scene::Placement,
    skin,
};
use crate::mesh::Semantic;

/// Attribute sets with a higher number are left out with a note.
const MAX_SETS: u32 = 8;

/// Reads all primitives of the placed mesh.
pub(super) fn read_mesh(
    document: &Document<'_>,
    soup: &mut Soup,
    placement: &Placement,
) -> Result<(), IoError> {
    let Some(mesh) = document.root.meshes.get(placement.mesh) else {
        let place = format!("node {}", placement.node);
        let n = document.root.meshes.len() as u64;
        return Err(document.source.out_of_range(place, "meshes", placement.mesh as i64, n));
    };
    soup.n_instances += 1;
    let name: String = mesh.name.iter().flat_map(|n| n.chars()).take(64).collect();
    for (i, primitive) in mesh.primitives.iter().enumerate() {
        let place = format!("mesh {} '{name}', primitive {i}", placement.mesh);
        if primitive.targets.as_ref().is_some_and(|t| !t.is_empty()) {
            soup.notes.add("morph_targets_ignored", "morph targets are ignored");
        }
        read_primitive(document, soup, placement, (i, primitive), place)?;
    }
    Ok(())
}

fn read_primitive(
    document: &Document<'_>,
    soup: &mut Soup,
    placement: &Placement,
    (number, primitive): (usize, &Primitive),
    place: String,
) -> Result<(), IoError> {
    let Checked::Valid(mode) = primitive.mode else {
        return Err(document.source.malformed(place, "unknown primitive mode", REMEDY));
    };
    let Some(split) = Split::of(mode) else {
        soup.notes.add("points_and_lines_ignored", "points and lines are ignored");
        return Ok(());
    };
    if !primitive.attributes.contains_key(&Checked::Valid(JsonSemantic::Positions)) {
        soup.notes.add("primitive_without_positions", "primitives without positions are ignored");
        return Ok(());
    }
    let packed = Packed::of(document, placement.mesh, number, &place)?;
    let mut values = Values { document, primitive, packed, n_points: 0 };
    let n_corners = values.count(&place)?;
    // Claimed before anything of that size is allocated.
    soup.claim(document.source, &place, values.n_points, (split.count)(n_corners))?;
    let corners = values.corners(&place)?;
    let positions = values.positions(&place)?;
    let mut attributes = read_attributes(&values, soup, &place)?;
    attributes.extend(skin::read_joints(&values, &placement.joints, soup, &place)?);
    let mut patch = Patch {
        positions: positions
            .as_chunks::<3>()
            .0
            .iter()
            .map(|p| place_point(placement, *p))
            .collect(),
        triangles: (split.triangles)(&corners),
        attributes,
        marks: read_marks(&values, &place)?,
        materials: PatchMaterials::All(match primitive.material {
            Some(material) => check_material(document, material.value(), &place)?,
            None => default_material(document, soup),
        }),
        part: placement.part,
        place,
    };
    transform_attributes(&mut patch, &placement.world_from_mesh);
    soup.push(document.source, patch)
}

/// The values of a primitive, in accessors or packed.
pub(super) struct Values<'d> {
    pub(super) document: &'d Document<'d>,
    pub(super) primitive: &'d Primitive,
    packed: Option<Packed<'d>>,
    pub(super) n_points: u64,
}

impl Values<'_> {
    /// Finds out the number of points, and returns that of corners.
    fn count(&mut self, place: &str) -> Result<u64, IoError> {
        if let Some(packed) = &self.packed {
            self.n_points = packed.n_points() as u64;
            return Ok(packed.n_corners() as u64);
        }
        let key = Checked::Valid(JsonSemantic::Positions);
        if let Some(positions) = self.primitive.attributes.get(&key) {
            let place = format!("{place}, POSITION");
            self.n_points = self.document.accessor(positions.value(), &[Type::Vec3], &place)?.count;
        }
        match self.primitive.indices {
            Some(i) => {
                let place = format!("{place}, indices");
                Ok(self.document.accessor(i.value(), &[Type::Scalar], &place)?.count)
            }
            None => Ok(self.n_points),
        }
    }

    /// The points of all corners.
    fn corners(&self, place: &str) -> Result<Vec<u32>, IoError> {
        match (&self.packed, self.primitive.indices) {
            (Some(packed), _) => Ok(packed.corners()),
            (None, Some(i)) => {
                let place = format!("{place}, indices");
                let view = self.document.accessor(i.value(), &[Type::Scalar], &place)?;
                self.document.indices(&view, &place)
            }
            (None, None) => Ok((0..self.n_points as u32).collect()),
        }
    }

    fn positions(&self, place: &str) -> Result<Vec<f32>, IoError> {
        let column = self.column(&JsonSemantic::Positions, (&[Type::Vec3], false), place)?;
        Ok(column.map_or_else(Vec::new, |(values, _)| values))
    }

    /// An attribute's values for all points, and how many a point has; `None` when there is no such attribute.
    /// Integers are normalized if the file or the caller says so.
    pub(super) fn column(
        &self,
        name: &JsonSemantic,
        (types, normalize): (&[Type], bool),
        place: &str,
    ) -> Result<Option<(Vec<f32>, usize)>, IoError> {
        let Some(index) = self.primitive.attributes.get(&Checked::Valid(name.clone())) else {
            return Ok(None);
        };
        let place = format!("{place}, {}", name.to_string());
        let view = self.document.accessor(index.value(), types, &place)?;
        let packed =
            self.packed.as_ref().and_then(|p| p.floats(&name.to_string(), &view, normalize));
        if let Some(values) = packed {
            return Ok(Some((values, view.width)));
        }
        if view.count != self.n_points {
            let problem = format!("{} values for {} positions", view.count, self.n_points);
            return Err(self.document.source.malformed(place, problem, REMEDY));
        }
        Ok(Some((self.document.floats(&view, normalize, &place)?, view.width)))
    }
}

fn place_point(placement: &Placement, p: [f32; 3]) -> DVec3 {
    placement.world_from_mesh.transform_point3(DVec3::from_array(p.map(f64::from)))
}

fn check_material(document: &Document<'_>, index: usize, place: &str) -> Result<u32, IoError> {
    let n = document.root.materials.len();
    if index < n {
        return Ok(index as u32);
    }
    Err(document.source.out_of_range(place, "materials", index as i64, n as u64))
}

/// How the corners of a primitive make triangles.
struct Split {
    count: fn(u64) -> u64,
    triangles: fn(&[u32]) -> Vec<[u32; 3]>,
}

impl Split {
    /// `None` for points and lines.
    fn of(mode: Mode) -> Option<Self> {
        let strip_count: fn(u64) -> u64 = |n| n.saturating_sub(2);
        match mode {
            Mode::Triangles => Some(Self { count: |n| n / 3, triangles: split_list }),
            Mode::TriangleStrip => Some(Self { count: strip_count, triangles: split_strip }),
            Mode::TriangleFan => Some(Self { count: strip_count, triangles: split_fan }),
            _ => None,
        }
    }
}

fn split_list(corners: &[u32]) -> Vec<[u32; 3]> {
    corners.as_chunks::<3>().0.to_vec()
}

/// Every second triangle is turned (glTF 2.0 §3.7.2.1).
fn split_strip(corners: &[u32]) -> Vec<[u32; 3]> {
    let turn = |(i, t): (usize, &[u32])| match i % 2 {
        0 => [t[0], t[1], t[2]],
        _ => [t[0], t[2], t[1]],
    };
    corners.windows(3).enumerate().map(turn).collect()
}

fn split_fan(corners: &[u32]) -> Vec<[u32; 3]> {
    let Some((first, rest)) = corners.split_first() else { return Vec::new() };
    rest.windows(2).map(|pair| [pair[0], pair[1], *first]).collect()
}

fn read_attributes(
    values: &Values<'_>,
    soup: &mut Soup,
    place: &str,
) -> Result<Vec<Attribute>, IoError> {
    let mut attributes = Vec::new();
    for name in values.primitive.attributes.keys() {
        let Checked::Valid(name) = name else {
            soup.notes.add("attribute_ignored", "vertex attributes of unknown name are ignored");
            continue;
        };
        let Some((semantic, types)) = meaning_of(name, soup) else { continue };
        // Integer colours are normalized even where the file forgets to say so.
        let is_color = matches!(semantic, Semantic::Color(_));
        let Some((mut values, width)) = values.column(name, (types, is_color), place)? else {
            continue;
        };
        if width < defaults_of(semantic).len() {
            values =
                values.as_chunks::<3>().0.iter().flat_map(|c| [c[0], c[1], c[2], 1.0]).collect();
        }
        attributes.push(Attribute { semantic, values });
    }
    Ok(attributes)
}

/// The attributes that say something of single points: `_LOCK` and `_WEIGHT`.
const MARKS: [&str; 2] = ["LOCK", "WEIGHT"];

fn read_marks(values: &Values<'_>, place: &str) -> Result<PointMarks, IoError> {
    let read = |name: &str| {
        let name = JsonSemantic::Extras(name.to_owned());
        let column = values.column(&name, (&[Type::Scalar], false), place)?;
        Ok(column.map_or_else(Vec::new, |(values, _)| values))
    };
    let [locks, weights] = MARKS.map(read);
    Ok(PointMarks { locks: locks?, weights: weights? })
}

/// What is read, with the types it may have; notes what is not.
fn meaning_of(name: &JsonSemantic, soup: &mut Soup) -> Option<(Semantic, &'static [Type])> {
    match name {
        // `skin` reads the latter two.
        JsonSemantic::Positions | JsonSemantic::Joints(_) | JsonSemantic::Weights(_) => None,
        JsonSemantic::Extras(name) if MARKS.contains(&name.as_str()) => None,
        JsonSemantic::Normals => Some((Semantic::Normal, &[Type::Vec3])),
        JsonSemantic::Tangents => Some((Semantic::Tangent, &[Type::Vec4])),
        JsonSemantic::TexCoords(n) if *n < MAX_SETS => {
            Some((Semantic::TexCoord(*n), &[Type::Vec2]))
        }
        JsonSemantic::Colors(n) if *n < MAX_SETS => {
            Some((Semantic::Color(*n), &[Type::Vec3, Type::Vec4]))
        }
        other => {
            let shown: String = format!("{other:?}").chars().take(64).collect();
            soup.notes.add("attribute_ignored", format!("vertex attribute {shown} is ignored"));
            None
        }
    }
}

/// Carries normals and tangents into world space and turns triangles that a mirror turned.
fn transform_attributes(patch: &mut Patch, world_from_mesh: &DMat4) {
    let linear = DMat3::from_mat4(*world_from_mesh);
    let is_mirror = linear.determinant() < 0.0;
    if is_mirror {
        patch.triangles.iter_mut().for_each(|t| t.swap(1, 2));
    }
    if linear == DMat3::IDENTITY {
        return;
    }
    let normal_matrix = cofactors(&linear) * if is_mirror { -1.0 } else { 1.0 };
    for attribute in &mut patch.attributes {
        match attribute.semantic {
            Semantic::Normal => attribute.values.as_chunks_mut().0.iter_mut().for_each(|n| {
                *n = turn(&normal_matrix, *n);
            }),
            Semantic::Tangent => attribute.values.as_chunks_mut().0.iter_mut().for_each(|t| {
                let [x, y, z, w] = *t;
                let [x, y, z] = turn(&linear, [x, y, z]);
                *t = [x, y, z, if is_mirror { -w } else { w }];
            }),
            _ => {}
        }
    }
}

/// `det(m)` times the inverse transpose of `m`; defined for singular matrices too.
fn cofactors(m: &DMat3) -> DMat3 {
    DMat3::from_cols(m.y_axis.cross(m.z_axis), m.z_axis.cross(m.x_axis), m.x_axis.cross(m.y_axis))
}

/// A direction after a linear map, at length 1 (zero stays zero).
fn turn(matrix: &DMat3, v: [f32; 3]) -> [f32; 3] {
    let turned = *matrix * DVec3::from_array(v.map(f64::from));
    turned.normalize_or_zero().as_vec3().to_array()
}
