//! The faces of a PLY file: polygons and strips, and the texture coordinates of their corners.
//!
//! A polygon is a fan until its vertices are known, which may come later in the file; then `polygon` splits it.
//! Where corners have texture coordinates (`texcoord`, two for each, as MeshLab writes them), those that differ in
//! them become points of their own.

use std::ops::Range;

use glam::DVec3;

use super::{
    super::{
        intern::Interner,
        soup::{Attribute, PointMarks, defaults_of},
    },
    Body, IoError, REMEDY,
    body::Values,
    header::{Element, Kind, Property, Scalar},
};
use crate::mesh::Semantic;

/// Texture coordinates of the three corners of a triangle, v downwards.
pub(super) type Uvs = [[f32; 2]; 3];

/// What has none takes that of its vertices.
const NONE: Uvs = [[f32::NAN; 2]; 3];

/// What a list of indices stands for.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Shape {
    Polygon,
    Strips,
}

impl Shape {
    /// Adds the triangles of a list, those of a polygon as a fan.
    fn split(self, list: &[i64], triangles: &mut Vec<[i64; 3]>) {
        match self {
            Self::Polygon => add_fan(list, triangles),
            Self::Strips => add_strips(list, triangles),
        }
    }
}

fn add_fan(list: &[i64], triangles: &mut Vec<[i64; 3]>) {
    if let Some((first, rest)) = list.split_first() {
        triangles.extend(rest.windows(2).map(|pair| [*first, pair[0], pair[1]]));
    }
}

/// Strips are separated by −1; every second triangle is turned.
fn add_strips(list: &[i64], triangles: &mut Vec<[i64; 3]>) {
    for strip in list.split(|i| *i == -1) {
        triangles.extend(strip.windows(3).enumerate().map(|(i, t)| match i % 2 {
            0 => [t[0], t[1], t[2]],
            _ => [t[1], t[0], t[2]],
        }));
    }
}

/// The properties of a face that are read, as places among all.
struct Places {
    indices: usize,
    uvs: Option<usize>,
    /// Which texture file the face shows.
    texture: Option<usize>,
}

impl<V: Values> Body<'_, V> {
    /// Rows of polygons or strips.
    pub(super) fn read_lists(&mut self, element: &Element, shape: Shape) -> Result<(), IoError> {
        let places = self.places_of(element, shape)?;
        let (mut values, mut uvs) = (Vec::new(), Vec::new());
        let (mut indices, mut triangles) = (Vec::new(), Vec::new());
        for row in 0..element.count {
            let mut texture = 0;
            for (at, property) in element.properties.iter().enumerate() {
                match property.kind {
                    Kind::List { count, item } if at == places.indices => {
                        self.read_list((count, item), element, row, &mut values)?;
                    }
                    Kind::List { count, item } if Some(at) == places.uvs => {
                        self.read_list((count, item), element, row, &mut uvs)?;
                    }
                    _ => {
                        let value = self.value(property, element, row)?;
                        if Some(at) == places.texture {
                            texture = value.unwrap_or_default() as u32;
                        }
                    }
                }
            }
            indices.clear();
            indices.extend(values.iter().map(|index| *index as i64));
            triangles.clear();
            shape.split(&indices, &mut triangles);
            self.take(&triangles, element, row)?;
            if places.uvs.is_some() {
                self.take_uvs(&uvs, triangles.len());
            }
            if places.texture.is_some() {
                self.textures.resize(self.patch.triangles.len(), texture);
            }
            if shape == Shape::Polygon && triangles.len() > 1 {
                self.take_fan(triangles.len());
            }
        }
        Ok(())
    }

    /// Finds what is read and notes the rest. Triangles so far have none of it.
    fn places_of(&mut self, element: &Element, shape: Shape) -> Result<Places, IoError> {
        let find = |names: &[&str], is_list: bool| {
            let is_it = |p: &Property| {
                names.contains(&p.name.as_str()) && is_list == matches!(p.kind, Kind::List { .. })
            };
            element.properties.iter().position(is_it)
        };
        let Some(indices) = find(&["vertex_indices", "vertex_index"], true) else {
            let problem = "no list property 'vertex_indices'";
            return Err(self.source.malformed(self.place(element, 0), problem, REMEDY));
        };
        let of_polygons = |place: &usize| shape == Shape::Polygon && *place != indices;
        let uvs = find(&["texcoord"], true).filter(of_polygons);
        let texture = find(&["texnumber"], false).filter(of_polygons);
        for (at, property) in element.properties.iter().enumerate() {
            if at != indices && ![uvs, texture].contains(&Some(at)) {
                self.note_ignored(element, property);
            }
        }
        let n_before = self.patch.triangles.len();
        if uvs.is_some() {
            self.uvs.resize(n_before, NONE);
        }
        if texture.is_some() {
            self.textures.resize(n_before, 0);
        }
        Ok(Places { indices, uvs, texture })
    }

    fn read_list(
        &mut self,
        (count, item): (Scalar, Scalar),
        element: &Element,
        row: u64,
        list: &mut Vec<f64>,
    ) -> Result<(), IoError> {
        list.clear();
        for _ in 0..self.list_length(count, element, row)? {
            let value = self.values.next(item);
            list.push(value.ok_or_else(|| self.bad_value(element, row))?);
        }
        Ok(())
    }

    fn take(&mut self, triangles: &[[i64; 3]], element: &Element, row: u64) -> Result<(), IoError> {
        self.soup.claim(self.source, "element face", 0, triangles.len() as u64)?;
        for triangle in triangles {
            if let Some(&index) =
                triangle.iter().find(|i| !(0..self.n_vertices as i64).contains(*i))
            {
                let place = self.place(element, row);
                return Err(self.source.out_of_range(place, "vertices", index, self.n_vertices));
            }
            self.patch.triangles.push(triangle.map(|i| i as u32));
        }
        Ok(())
    }

    /// Keeps the texture coordinates of the polygon that was read last, which is a fan so far.
    fn take_uvs(&mut self, list: &[f64], n_triangles: usize) {
        // PLY counts v upwards, the mesh downwards as glTF does.
        let turned = |[u, v]: &[f64; 2]| [*u as f32, (1.0 - v) as f32];
        let corners: Vec<[f32; 2]> = list.as_chunks::<2>().0.iter().map(turned).collect();
        if list.len() == 2 * (n_triangles + 2) {
            let fan = corners.windows(2).skip(1).map(|pair| [corners[0], pair[0], pair[1]]);
            self.uvs.extend(fan);
        } else if n_triangles > 0 {
            let text = "faces without two texture coordinates for each corner have those of their vertices";
            self.soup.notes.add("texcoord_filled", text);
        }
        self.uvs.resize(self.patch.triangles.len(), NONE);
    }

    /// Notes that the last triangles are a polygon, or settles which they are.
    fn take_fan(&mut self, n_triangles: usize) {
        let end = self.patch.triangles.len();
        let fan = end.saturating_sub(n_triangles)..end;
        if self.patch.positions.is_empty() {
            self.unsettled.push(fan);
        } else {
            self.settle(fan);
        }
    }

    /// Splits a polygon that is a fan so far as its corners lie.
    pub(super) fn settle(&mut self, fan: Range<usize>) {
        let Some(triangles) = self.patch.triangles.get_mut(fan.clone()) else { return };
        let place = |corner: &u32| self.patch.positions.get(*corner as usize).copied();
        // A vertex that is not there is refused later.
        let places: Option<Vec<DVec3>> = corners_of(triangles).iter().map(place).collect();
        let Some(places) = places else { return };
        let split = self.splitter.triangulate(&places, &mut self.soup.notes);
        rearrange(triangles, &split);
        if let Some(uvs) = self.uvs.get_mut(fan) {
            rearrange(uvs, &split);
        }
    }

    /// Makes points of corners, where corners have texture coordinates.
    pub(super) fn give_uvs(&mut self) {
        let patch = &mut self.patch;
        let n_points = patch.positions.len();
        // A vertex that is not there is refused later.
        let is_whole = patch.triangles.as_flattened().iter().all(|v| (*v as usize) < n_points);
        let is_none = |uv: &[f32; 2]| uv.iter().any(|x| x.is_nan());
        if !is_whole || self.uvs.as_flattened().iter().all(is_none) {
            return;
        }
        self.uvs.resize(patch.triangles.len(), NONE);
        let own = patch.attributes.iter().find(|a| a.semantic == Semantic::TexCoord(0));
        let own = own.map_or(&[][..], |a| a.values.as_chunks::<2>().0);
        let mut corners = Interner::new(3);
        let flat = patch.triangles.as_flattened_mut().iter_mut();
        for (vertex, uv) in flat.zip(self.uvs.as_flattened()) {
            let own = || own.get(*vertex as usize).copied().unwrap_or_default();
            let [u, v] = if is_none(uv) { own() } else { *uv };
            *vertex = corners.intern(&[*vertex, u.to_bits(), v.to_bits()]);
        }
        let words = corners.into_words();
        let corners = words.as_chunks::<3>().0;
        patch.positions = gathered(&patch.positions, 1, corners);
        patch.attributes.retain(|a| a.semantic != Semantic::TexCoord(0));
        for attribute in &mut patch.attributes {
            let width = defaults_of(attribute.semantic).len();
            attribute.values = gathered(&attribute.values, width, corners);
        }
        let PointMarks { locks, weights } = &mut patch.marks;
        for marks in [locks, weights] {
            *marks = gathered(marks, 1, corners);
        }
        let values = corners.iter().flat_map(|[_, u, v]| [f32::from_bits(*u), f32::from_bits(*v)]);
        let values = values.collect();
        patch.attributes.push(Attribute { semantic: Semantic::TexCoord(0), values });
    }
}

/// What the corners of a polygon have, which is a fan.
fn corners_of<T: Copy>(fan: &[[T; 3]]) -> Vec<T> {
    let first = fan.iter().take(1).flat_map(|[a, b, _]| [*a, *b]);
    first.chain(fan.iter().map(|[_, _, c]| *c)).collect()
}

/// From a fan to as many other triangles of the same polygon.
fn rearrange<T: Copy>(fan: &mut [[T; 3]], split: &[[usize; 3]]) {
    let corners = corners_of(fan);
    for (triangle, of_corners) in fan.iter_mut().zip(split) {
        *triangle = of_corners.map(|i| corners[i]);
    }
}

/// The values that each corner's vertex, its first word, has.
fn gathered<T: Copy>(values: &[T], width: usize, corners: &[[u32; 3]]) -> Vec<T> {
    let of = move |corner: &[u32; 3]| {
        values.iter().skip(corner[0] as usize * width).take(width).copied()
    };
    corners.iter().flat_map(of).collect()
}
