//! Wavefront OBJ: `v` (with colours), `vt`, `vn`, `f` (polygons, negative indices), `usemtl`.
//!
//! Polygons are split into triangles (see `polygon`). `usemtl` makes materials by name, which
//! the material libraries define (see `mtl`) where the file is in an archive with them; alone, it
//! makes all white. Names may have a `#`, which begins a comment elsewhere. Colours after the
//! coordinates are taken as sRGB, as Blender takes them. Points, lines, curves, groups and smoothing groups are passed over.
//! Positions that are not finite are refused where they stand, used or not.

use std::collections::BTreeMap;

use glam::DVec3;

use super::{
    IoError,
    intern::Interner,
    mtl::{self, split_word},
    polygon::Splitter,
    soup::{Attribute, Patch, PatchMaterials, PointMarks, Soup},
    source::{Source, without_mark},
};
use crate::{
    io::ply::linear_from_srgb,
    mesh::{Material, Semantic},
};

const REMEDY: &str = "correct the line or export the model again";
const NONE: u32 = u32::MAX;

/// Reads the file line by line.
pub(super) fn read(source: &Source<'_>) -> Result<Soup, IoError> {
    let mut reader = Reader::new(source);
    let mut joined = Vec::new();
    for (i, line) in without_mark(source.bytes).split(|b| *b == b'\n').enumerate() {
        reader.line = i + 1;
        let line = line.strip_suffix(b"\r").unwrap_or(line);
        if let Some(begin) = line.strip_suffix(b"\\").filter(|begin| !has_comment(begin)) {
            joined.extend_from_slice(begin);
            joined.push(b' ');
            continue;
        }
        if joined.is_empty() {
            reader.statement(line)?;
        } else {
            joined.extend_from_slice(line);
            reader.statement(&joined)?;
            joined.clear();
        }
    }
    reader.statement(&joined)?;
    reader.finish()
}

/// Whether a comment begins in the line, or what may be one in a name: it ends with the line, so that no backslash
/// there continues it.
fn has_comment(line: &[u8]) -> bool {
    line.split(u8::is_ascii_whitespace).any(|word| word.starts_with(b"#"))
}

struct Reader<'a> {
    source: &'a Source<'a>,
    line: usize,
    positions: Vec<DVec3>,
    /// Linear RGB per position; empty until the first coloured vertex.
    colors: Vec<[f32; 3]>,
    uvs: Vec<[f32; 2]>,
    normals: Vec<[f32; 3]>,
    /// Distinct corners: position, texture coordinate, normal (`NONE` where absent).
    corners: Interner,
    triangles: Vec<[u32; 3]>,
    face_materials: Vec<u32>,
    material_ids: BTreeMap<Vec<u8>, u32>,
    material: u32,
    polygon: Vec<u32>,
    /// Where the polygon's corners are.
    outline: Vec<DVec3>,
    splitter: Splitter,
    /// Entries of the archive.
    libraries: Vec<usize>,
    soup: Soup,
}

impl<'a> Reader<'a> {
    fn new(source: &'a Source<'a>) -> Self {
        Self {
            source,
            line: 0,
            positions: Vec::new(),
            colors: Vec::new(),
            uvs: Vec::new(),
            normals: Vec::new(),
            corners: Interner::new(3),
            triangles: Vec::new(),
            face_materials: Vec::new(),
            material_ids: BTreeMap::new(),
            material: 0,
            polygon: Vec::new(),
            outline: Vec::new(),
            splitter: Splitter::default(),
            libraries: Vec::new(),
            soup: Soup::of_one_instance(),
        }
    }

    fn statement(&mut self, line: &[u8]) -> Result<(), IoError> {
        let (key, rest) = split_word(line);
        // Names may have a `#`, numbers none.
        let numbers = rest.split(|b| *b == b'#').next().unwrap_or(rest);
        let words = numbers.split(u8::is_ascii_whitespace).filter(|w| !w.is_empty());
        match key {
            b"v" => self.vertex(words),
            b"vt" => {
                let [u, v] = self.numbers(words, 1)?;
                // OBJ counts v upwards, the mesh downwards as glTF does.
                self.uvs.push([u as f32, (1.0 - v) as f32]);
                Ok(())
            }
            b"vn" => {
                let n: [f64; 3] = self.numbers(words, 3)?;
                self.normals.push(n.map(|x| x as f32));
                Ok(())
            }
            b"f" => self.face(words),
            b"usemtl" => {
                self.use_material(rest);
                Ok(())
            }
            b"mtllib" => {
                self.name_library(rest);
                Ok(())
            }
            _ => Ok(()),
        }
    }

    fn vertex<'w>(&mut self, words: impl Iterator<Item = &'w [u8]>) -> Result<(), IoError> {
        let [x, y, z, r, g, b]: [f64; 6] = self.numbers(words, 3)?;
        self.soup.claim(self.source, "vertices", 1, 0)?;
        let p = DVec3::new(x, y, z);
        if !p.is_finite() {
            let vertex = self.positions.len() as u64;
            let (file, place) = (self.source.file.to_owned(), self.place());
            return Err(IoError::NonFinite { file, place, vertex, x, y, z });
        }
        // `numbers` leaves NaN where no word was.
        if b.is_finite() {
            self.colors.resize(self.positions.len(), [1.0; 3]);
            self.colors.push([r, g, b].map(|c| linear_from_srgb(c as f32)));
        } else if !self.colors.is_empty() {
            self.colors.push([1.0; 3]);
        }
        self.positions.push(p);
        Ok(())
    }

    fn face<'w>(&mut self, words: impl Iterator<Item = &'w [u8]>) -> Result<(), IoError> {
        self.polygon.clear();
        self.outline.clear();
        for word in words {
            let corner = self.corner(word)?;
            self.polygon.push(self.corners.intern(&corner));
            self.outline.push(self.positions[corner[0] as usize]);
        }
        if self.polygon.len() < 3 {
            self.soup.notes.add("short_faces", "faces with fewer than three corners are ignored");
            return Ok(());
        }
        let n_triangles = self.polygon.len() as u64 - 2;
        self.soup.claim(self.source, &self.place(), 0, n_triangles)?;
        for triangle in self.splitter.triangulate(&self.outline, &mut self.soup.notes) {
            self.triangles.push(triangle.map(|i| self.polygon[i]));
            self.face_materials.push(self.material);
        }
        Ok(())
    }

    /// `v`, `v/vt`, `v//vn` or `v/vt/vn`, 1-based or negative from the end.
    fn corner(&self, word: &[u8]) -> Result<[u32; 3], IoError> {
        let counts = [self.positions.len(), self.uvs.len(), self.normals.len()];
        let kinds = ["vertices", "texture coordinates", "normals"];
        let mut corner = [NONE; 3];
        let mut parts = word.split(|b| *b == b'/');
        for ((slot, n), what) in corner.iter_mut().zip(counts).zip(kinds) {
            let Some(part) = parts.next().filter(|p| !p.is_empty()) else { continue };
            let index: i64 = parse(part).ok_or_else(|| self.bad_word(part))?;
            let zero_based = if index < 0 { n as i64 + index } else { index - 1 };
            if index == 0 || zero_based < 0 || zero_based >= n as i64 {
                return Err(self.source.out_of_range(self.place(), what, index, n as u64));
            }
            *slot = zero_based as u32;
        }
        if corner[0] == NONE || parts.next().is_some() {
            return Err(self.bad_word(word));
        }
        Ok(corner)
    }

    fn use_material(&mut self, name: &[u8]) {
        if self.material_ids.is_empty() && !self.triangles.is_empty() {
            // Faces before the first `usemtl` keep material 0.
            self.soup.materials.push(Material::default());
        }
        let next = self.soup.materials.len() as u32;
        self.material = *self.material_ids.entry(name.to_vec()).or_insert(next);
        if self.material == next {
            let name = String::from_utf8_lossy(name).into_owned();
            self.soup.materials.push(Material { name, ..Material::default() });
        }
    }

    /// `mtllib`: one name, which may have spaces, or several.
    fn name_library(&mut self, names: &[u8]) {
        let Some(archive) = self.source.beside else {
            let text = "material libraries are other files: all materials are white; send a ZIP of \
                        the OBJ with its MTL and images";
            self.soup.notes.add("mtllib_ignored", text);
            return;
        };
        let names = String::from_utf8_lossy(names);
        let found = match archive.find(&names) {
            Some(entry) => vec![(&*names, Some(entry))],
            None => names.split_ascii_whitespace().map(|n| (n, archive.find(n))).collect(),
        };
        for (name, entry) in found {
            match entry {
                Some(entry) if self.libraries.contains(&entry) => {}
                Some(entry) => self.libraries.push(entry),
                None => {
                    let shown: String = name.chars().take(80).collect();
                    let text = format!("'{shown}' is not in the archive; pack it with the model");
                    self.soup.notes.add("mtllib_missing", text);
                }
            }
        }
    }

    /// Materials as the libraries have them.
    fn define_materials(&mut self) -> Result<(), IoError> {
        let Some(archive) = self.source.beside.filter(|_| !self.libraries.is_empty()) else {
            return Ok(());
        };
        let library = mtl::read(archive, &self.libraries, &mut self.soup.notes)?;
        let names = self.material_ids.iter();
        let mut names: Vec<(u32, &[u8])> = names.map(|(name, id)| (*id, &name[..])).collect();
        names.sort_unstable();
        mtl::apply(archive, &library, &names, &mut self.soup)
    }

    /// `N` numbers of which `at_least` must be there; the others are NaN, or 0 in pairs.
    fn numbers<'w, const N: usize>(
        &self,
        words: impl Iterator<Item = &'w [u8]>,
        at_least: usize,
    ) -> Result<[f64; N], IoError> {
        let mut values = [if N == 2 { 0.0 } else { f64::NAN }; N];
        let mut n = 0;
        for (value, word) in values.iter_mut().zip(words) {
            *value = parse(word).ok_or_else(|| self.bad_word(word))?;
            n += 1;
        }
        if n < at_least {
            let problem = format!("{at_least} numbers are needed, {n} are there");
            return Err(self.source.malformed(self.place(), problem, REMEDY));
        }
        Ok(values)
    }

    fn place(&self) -> String {
        format!("line {}", self.line)
    }

    fn bad_word(&self, word: &[u8]) -> IoError {
        let shown = word[..word.len().min(24)].escape_ascii();
        self.source.malformed(self.place(), format!("cannot read '{shown}'"), REMEDY)
    }

    fn finish(mut self) -> Result<Soup, IoError> {
        self.define_materials()?;
        let corners = std::mem::replace(&mut self.corners, Interner::new(3)).into_words();
        let column = |k: usize| corners.iter().skip(k).step_by(3).map(|i| *i as usize);
        let mut attributes = Vec::new();
        if column(2).any(|i| i != NONE as usize) {
            let values = column(2).flat_map(|i| self.normals.get(i).copied().unwrap_or_default());
            attributes.push(Attribute { semantic: Semantic::Normal, values: values.collect() });
        }
        if column(1).any(|i| i != NONE as usize) {
            let values = column(1).flat_map(|i| self.uvs.get(i).copied().unwrap_or_default());
            attributes
                .push(Attribute { semantic: Semantic::TexCoord(0), values: values.collect() });
        }
        if !self.colors.is_empty() {
            let rgba = |i: usize| {
                let [r, g, b] = self.colors.get(i).copied().unwrap_or([1.0; 3]);
                [r, g, b, 1.0]
            };
            let values = column(0).flat_map(rgba).collect();
            attributes.push(Attribute { semantic: Semantic::Color(0), values });
        }
        let patch = Patch {
            place: "faces".to_owned(),
            positions: column(0).map(|i| self.positions[i]).collect(),
            triangles: self.triangles,
            attributes,
            materials: PatchMaterials::Each(self.face_materials),
            marks: PointMarks::default(),
            part: 0,
        };
        self.soup.push(self.source, patch)?;
        Ok(self.soup)
    }
}

fn parse<T: std::str::FromStr>(word: &[u8]) -> Option<T> {
    str::from_utf8(word).ok()?.parse().ok()
}
