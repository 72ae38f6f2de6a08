//! PLY: ASCII, binary little and big endian.
//!
//! Read: positions, normals, texture coordinates and colours of the `vertex` element, polygons of
//! the `face` element (see `polygon`) with texture coordinates of their corners (`texcoord`), and Stanford's
//! `tristrips`. What MeshLab calls `TextureFile` is looked for in the archive that the file is in.
//! The vertex properties `lock` (not 0: the vertex stays) and `weight` mark vertices.
//! Other elements and properties are passed over and named in notes. Integer
//! colours are taken as sRGB, as Blender takes them, floating-point colours as linear.

mod body;
mod faces;
mod header;

use std::ops::Range;

use glam::DVec3;

use super::{
    IoError,
    mtl::Textures,
    polygon::Splitter,
    soup::{Attribute, Patch, PatchMaterials, PointMarks, Soup, defaults_of},
    source::Source,
};
use crate::mesh::{Material, Semantic};
use body::{AsciiValues, BinaryValues, Values};
use faces::{Shape, Uvs};
use header::{Element, Encoding, Header, Kind, Property};

const REMEDY: &str = "export the model again, as binary PLY if possible";
/// The values of a vertex that are read, as places in a row.
const ROW: usize = 14;
/// Where `lock` and `weight` go in that row.
const MARKS: [usize; 2] = [12, 13];

/// Where a vertex property goes in the row of values that are read.
const SLOTS: [(&str, usize); 24] = [
    ("x", 0),
    ("y", 1),
    ("z", 2),
    ("nx", 3),
    ("ny", 4),
    ("nz", 5),
    ("s", 6),
    ("t", 7),
    ("u", 6),
    ("v", 7),
    ("texture_u", 6),
    ("texture_v", 7),
    ("texture_s", 6),
    ("texture_t", 7),
    ("red", 8),
    ("green", 9),
    ("blue", 10),
    ("alpha", 11),
    ("diffuse_red", 8),
    ("diffuse_green", 9),
    ("diffuse_blue", 10),
    ("diffuse_alpha", 11),
    ("lock", MARKS[0]),
    ("weight", MARKS[1]),
];

/// Reads any encoding.
pub(super) fn read(source: &Source<'_>) -> Result<Soup, IoError> {
    let header = header::parse(source)?;
    let rest = &source.bytes[header.body_offset..];
    match header.encoding {
        Encoding::Ascii => Body::new(source, AsciiValues::new(rest, header.n_lines)).read(&header),
        Encoding::Little => Body::new(source, BinaryValues::<false>::new(rest)).read(&header),
        Encoding::Big => Body::new(source, BinaryValues::<true>::new(rest)).read(&header),
    }
}

struct Body<'a, V> {
    source: &'a Source<'a>,
    values: V,
    soup: Soup,
    patch: Patch,
    n_vertices: u64,
    splitter: Splitter,
    /// Fans whose vertices come later in the file, as ranges of triangles.
    unsettled: Vec<Range<usize>>,
    /// By triangle, where faces have any.
    uvs: Vec<Uvs>,
    /// Which texture file each triangle shows, where faces say so.
    textures: Vec<u32>,
}

impl<'a, V: Values> Body<'a, V> {
    fn new(source: &'a Source<'a>, values: V) -> Self {
        let patch = Patch { place: "element vertex".to_owned(), ..Patch::default() };
        Self {
            source,
            values,
            soup: Soup::of_one_instance(),
            patch,
            n_vertices: 0,
            splitter: Splitter::default(),
            unsettled: Vec::new(),
            uvs: Vec::new(),
            textures: Vec::new(),
        }
    }

    fn read(mut self, header: &Header) -> Result<Soup, IoError> {
        let vertex = header.elements.iter().find(|e| e.name == "vertex");
        self.n_vertices = vertex.map_or(0, |e| e.count);
        let n_lists =
            header.elements.iter().filter(|e| e.name == "face" || e.name == "tristrips").count();
        if n_lists == 0 {
            let reason = "the header has no element 'face' (a point cloud?)";
            return Err(self.source.no_triangles(reason));
        }
        for element in &header.elements {
            self.check_length(element)?;
            match element.name.as_str() {
                "vertex" => self.read_vertices(element)?,
                "face" => self.read_lists(element, Shape::Polygon)?,
                "tristrips" => self.read_lists(element, Shape::Strips)?,
                _ => self.skip(element)?,
            }
        }
        for fan in std::mem::take(&mut self.unsettled) {
            self.settle(fan);
        }
        self.give_uvs();
        self.give_textures(&header.texture_files)?;
        self.soup.push(self.source, self.patch)?;
        Ok(self.soup)
    }

    /// Refuses a count that the bytes left cannot hold, before anything is allocated for it.
    fn check_length(&self, element: &Element) -> Result<(), IoError> {
        let per_row: u64 = element.properties.iter().map(|p| V::min_bytes(p.kind)).sum();
        // The last value of an ASCII file needs no separator.
        let need = element.count.saturating_mul(per_row).saturating_sub(1);
        let have = self.values.n_left();
        if need > have {
            let place = format!("element {} with {} rows", element.name, element.count);
            return Err(self.source.truncated(place, need, have));
        }
        Ok(())
    }

    fn read_vertices(&mut self, element: &Element) -> Result<(), IoError> {
        let slots = self.slots_of(element);
        self.soup.claim(self.source, "element vertex", element.count, 0)?;
        if element.properties.is_empty() {
            return Ok(());
        }
        let mut columns = Columns::new(&slots, element);
        let (mut locks, mut weights) = (Vec::new(), Vec::new());
        for row in 0..element.count {
            let mut values = [0.0; ROW];
            values[11] = columns.alpha_default();
            for (property, slot) in element.properties.iter().zip(&slots) {
                let value = self.value(property, element, row)?;
                if let (Some(value), Some(slot)) = (value, slot) {
                    values[*slot] = value;
                }
            }
            self.patch.positions.push(DVec3::new(values[0], values[1], values[2]));
            columns.push(&values);
            for (marks, at) in [(&mut locks, MARKS[0]), (&mut weights, MARKS[1])] {
                marks.extend(slots.contains(&Some(at)).then_some(values[at] as f32));
            }
        }
        self.patch.attributes = columns.attributes;
        self.patch.marks = PointMarks { locks, weights };
        Ok(())
    }

    /// Where each property goes; notes the names of those that go nowhere.
    fn slots_of(&mut self, element: &Element) -> Vec<Option<usize>> {
        let slot_of = |p: &Property| match p.kind {
            Kind::Scalar(_) => SLOTS.iter().find(|(name, _)| *name == p.name).map(|(_, s)| *s),
            Kind::List { .. } => None,
        };
        let slots: Vec<_> = element.properties.iter().map(slot_of).collect();
        for (property, _) in element.properties.iter().zip(&slots).filter(|(_, s)| s.is_none()) {
            self.note_ignored(element, property);
        }
        slots
    }

    fn note_ignored(&mut self, element: &Element, property: &Property) {
        let shown: String = property.name.chars().take(64).collect();
        let text = format!("{} property '{shown}' is not carried", element.name);
        self.soup.notes.add("property_ignored", text);
    }

    /// The value of a scalar property; passes over a list.
    fn value(
        &mut self,
        property: &Property,
        element: &Element,
        row: u64,
    ) -> Result<Option<f64>, IoError> {
        match property.kind {
            Kind::Scalar(scalar) => match self.values.next(scalar) {
                Some(value) => Ok(Some(value)),
                None => Err(self.bad_value(element, row)),
            },
            Kind::List { count, item } => {
                for _ in 0..self.list_length(count, element, row)? {
                    self.values.next(item).ok_or_else(|| self.bad_value(element, row))?;
                }
                Ok(None)
            }
        }
    }

    fn list_length(
        &mut self,
        count: header::Scalar,
        element: &Element,
        row: u64,
    ) -> Result<u64, IoError> {
        let n = self.values.next(count).ok_or_else(|| self.bad_value(element, row))?;
        // Each item takes at least one byte, so a length beyond the file cannot be right.
        if n < 0.0 || n.fract() != 0.0 || n > self.values.n_left() as f64 {
            let problem = format!("a list of {n} items with {} bytes left", self.values.n_left());
            return Err(self.source.malformed(self.place(element, row), problem, REMEDY));
        }
        Ok(n as u64)
    }

    /// Makes materials of the images that the header names.
    fn give_textures(&mut self, files: &[String]) -> Result<(), IoError> {
        if files.is_empty() {
            return Ok(());
        }
        let Some(archive) = self.source.beside else {
            let text = "texture files are other files: all is white; send a ZIP of the PLY with \
                        its images";
            self.soup.notes.add("texture_files_ignored", text);
            return Ok(());
        };
        let mut textures = Textures::new(archive);
        for file in files {
            let base_texture = textures.plain(file, &mut self.soup)?;
            let name = file.clone();
            self.soup.materials.push(Material { name, base_texture, ..Material::default() });
        }
        if !self.textures.is_empty() {
            let known =
                |texture: &u32| if (*texture as usize) < files.len() { *texture } else { 0 };
            let list = self.textures.iter().map(known).collect();
            self.patch.materials = PatchMaterials::Each(list);
        }
        Ok(())
    }

    fn skip(&mut self, element: &Element) -> Result<(), IoError> {
        if element.properties.is_empty() {
            return Ok(());
        }
        self.soup.notes.add("element_ignored", format!("element '{}' is not read", element.name));
        for row in 0..element.count {
            for property in &element.properties {
                self.value(property, element, row)?;
            }
        }
        Ok(())
    }

    fn place(&self, element: &Element, row: u64) -> String {
        match self.values.line() {
            Some(line) => format!("line {line} (element {}, row {row})", element.name),
            None => format!("element {}, row {row}", element.name),
        }
    }

    fn bad_value(&self, element: &Element, row: u64) -> IoError {
        let place = self.place(element, row);
        if self.values.n_left() == 0 || self.values.line().is_none() {
            return self.source.truncated(place, 1, 0);
        }
        self.source.malformed(place, "cannot read a number", REMEDY)
    }
}

/// The attribute layers that the header promises, filled row by row.
struct Columns {
    attributes: Vec<Attribute>,
    /// First value in the row, of each attribute.
    starts: Vec<usize>,
    /// Divisor of integer colours; `None` for linear floating-point ones.
    color_full_scale: Option<f64>,
}

impl Columns {
    const LAYERS: [(Semantic, usize); 3] =
        [(Semantic::Normal, 3), (Semantic::TexCoord(0), 6), (Semantic::Color(0), 8)];

    fn new(slots: &[Option<usize>], element: &Element) -> Self {
        // A layer counts as there when its first value is.
        let has = |slot: usize| slots.contains(&Some(slot));
        let layers = Self::LAYERS.iter().filter(|(_, start)| has(*start));
        let red = slots.iter().position(|s| *s == Some(8));
        let red = red.and_then(|i| element.properties.get(i)).map(|p| p.kind);
        let color_full_scale = match red {
            Some(Kind::Scalar(scalar)) => scalar.full_scale(),
            _ => None,
        };
        Self {
            starts: layers.clone().map(|(_, start)| *start).collect(),
            attributes: layers
                .map(|(semantic, _)| Attribute { semantic: *semantic, values: Vec::new() })
                .collect(),
            color_full_scale,
        }
    }

    fn alpha_default(&self) -> f64 {
        self.color_full_scale.unwrap_or(1.0)
    }

    fn push(&mut self, row: &[f64; ROW]) {
        for (attribute, start) in self.attributes.iter_mut().zip(&self.starts) {
            let width = defaults_of(attribute.semantic).len();
            let values = row[*start..*start + width].iter().map(|v| *v as f32);
            match (attribute.semantic, self.color_full_scale) {
                // PLY counts v upwards, the mesh downwards as glTF does.
                (Semantic::TexCoord(_), _) => {
                    attribute.values.extend([row[*start] as f32, (1.0 - row[*start + 1]) as f32]);
                }
                (Semantic::Color(_), Some(scale)) => {
                    attribute.values.extend(values.enumerate().map(|(k, v)| match k {
                        3 => v / scale as f32,
                        _ => linear_from_srgb(v / scale as f32),
                    }));
                }
                _ => attribute.values.extend(values),
            }
        }
    }
}

/// The transfer function of IEC 61966-2-1, from display values in 0..=1 to linear light.
pub(super) fn linear_from_srgb(c: f32) -> f32 {
    if c <= 0.04045 { c / 12.92 } else { libm::powf((c + 0.055) / 1.055, 2.4) }
}

/// Its inverse.
pub(super) fn srgb_from_linear(c: f32) -> f32 {
    if c <= 0.003_130_8 { c * 12.92 } else { 1.055 * libm::powf(c, 1.0 / 2.4) - 0.055 }
}
