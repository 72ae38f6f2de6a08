//! What every reader produces: patches of indexed triangles, in world space, not yet joined.
//!
//! Invariants of a [`Soup`], established by [`Soup::push`]:
//! 1. every triangle index is below its patch's number of points;
//! 2. the points that triangles use are finite;
//! 3. each attribute has `width` values for every point, marks have one or none;
//! 4. counts are within the limits.

use glam::DVec3;

use super::{IoError, report::Note, source::Source, weld::name_of};
use crate::mesh::{Image, Material, Semantic, Texture, Tree, skin};

/// A primitive as placed, or all faces of a file without primitives.
#[derive(Debug, Default)]
pub(super) struct Patch {
    /// Where in the file, for errors.
    pub(super) place: String,
    pub(super) positions: Vec<DVec3>,
    pub(super) triangles: Vec<[u32; 3]>,
    pub(super) attributes: Vec<Attribute>,
    pub(super) marks: PointMarks,
    pub(super) materials: PatchMaterials,
    /// Index into the parts of [`Soup::tree`].
    pub(super) part: u32,
}

/// What is said of single points.
#[derive(Debug, Default)]
pub(super) struct PointMarks {
    /// What is not 0 locks the point; empty: none.
    pub(super) locks: Vec<f32>,
    /// How much the surroundings of the point matter; empty: 1 everywhere.
    pub(super) weights: Vec<f32>,
}

/// Which material the triangles of a patch have.
#[derive(Debug)]
pub(super) enum PatchMaterials {
    /// The same one.
    All(u32),
    /// One index per triangle.
    Each(Vec<u32>),
}

impl Default for PatchMaterials {
    fn default() -> Self {
        Self::All(0)
    }
}

/// `width` values for each point.
#[derive(Debug)]
pub(super) struct Attribute {
    pub(super) semantic: Semantic,
    pub(super) values: Vec<f32>,
}

/// Values per point, and what a point without the attribute gets.
pub(super) fn defaults_of(semantic: Semantic) -> &'static [f32] {
    match semantic {
        Semantic::Normal => &[0.0, 0.0, 0.0],
        Semantic::Tangent => &[0.0, 0.0, 0.0, 1.0],
        Semantic::TexCoord(_) => &[0.0, 0.0],
        Semantic::Color(_) => &[1.0, 1.0, 1.0, 1.0],
        Semantic::Skin => &[0.0; skin::WIDTH],
        Semantic::Custom(_) => &[0.0],
    }
}

/// All that a file holds.
#[derive(Debug, Default)]
pub(super) struct Soup {
    pub(super) patches: Vec<Patch>,
    pub(super) materials: Vec<Material>,
    pub(super) textures: Vec<Texture>,
    pub(super) images: Vec<Image>,
    pub(super) tree: Tree,
    pub(super) notes: Notes,
    /// Meshes placed by nodes; 1 where the format has no nodes.
    pub(super) n_instances: u64,
    n_points: u64,
    n_triangles: u64,
}

impl Soup {
    /// For formats without nodes.
    pub(super) fn of_one_instance() -> Self {
        Self { n_instances: 1, ..Self::default() }
    }

    /// Counts points and triangles that are about to be read against the limits.
    pub(super) fn claim(
        &mut self,
        source: &Source<'_>,
        place: &str,
        n_points: u64,
        n_triangles: u64,
    ) -> Result<(), IoError> {
        self.n_points = self.n_points.saturating_add(n_points);
        self.n_triangles = self.n_triangles.saturating_add(n_triangles);
        source.check_limit(place, "vertices", self.n_points, source.limits.max_vertices)?;
        source.check_limit(place, "triangles", self.n_triangles, source.limits.max_triangles)
    }

    /// Vertices as the file stores them, instances placed.
    pub(super) fn n_points(&self) -> u64 {
        self.n_points
    }

    /// Takes a patch after checking invariants 1 to 3.
    pub(super) fn push(&mut self, source: &Source<'_>, patch: Patch) -> Result<(), IoError> {
        check_widths(source, &patch)?;
        let n = patch.positions.len();
        for (t, triangle) in patch.triangles.iter().enumerate() {
            for &v in triangle {
                let Some(&p) = patch.positions.get(v as usize) else {
                    let place = format!("{}: triangle {t}", patch.place);
                    return Err(source.out_of_range(place, "vertices", v.into(), n as u64));
                };
                if !p.is_finite() {
                    return Err(IoError::NonFinite {
                        file: source.file.to_owned(),
                        place: patch.place,
                        vertex: v.into(),
                        x: p.x,
                        y: p.y,
                        z: p.z,
                    });
                }
            }
        }
        self.patches.push(patch);
        Ok(())
    }
}

/// Invariant 3.
fn check_widths(source: &Source<'_>, patch: &Patch) -> Result<(), IoError> {
    let n = patch.positions.len();
    let attributes = patch.attributes.iter().map(|a| {
        let width = defaults_of(a.semantic).len();
        (name_of(a.semantic), a.values.len(), n.saturating_mul(width))
    });
    let PointMarks { locks, weights } = &patch.marks;
    let marks = [("locks", locks), ("weights", weights)].into_iter();
    let marks = marks.filter(|(_, marks)| !marks.is_empty());
    let marks = marks.map(|(name, marks)| (name.to_owned(), marks.len(), n));
    match attributes.chain(marks).find(|(_, have, want)| have != want) {
        None => Ok(()),
        Some((name, have, want)) => {
            let problem = format!("{name}: {have} values for {n} vertices, which need {want}");
            Err(source.malformed(patch.place.as_str(), problem, "export the model again"))
        }
    }
}

/// Remarks for the user. At most 64 distinct ones: file content cannot swell the report.
#[derive(Debug, Default)]
pub(super) struct Notes(Vec<Note>);

impl Notes {
    const MAX: usize = 64;

    pub(super) fn add(&mut self, code: &'static str, text: impl Into<String>) {
        let text = text.into();
        if let Some(note) = self.0.iter_mut().find(|n| n.code == code && n.text == text) {
            note.count += 1;
        } else if self.0.len() < Self::MAX {
            self.0.push(Note { code, text, count: 1 });
        }
    }

    pub(super) fn into_vec(self) -> Vec<Note> {
        self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::Limits;

    #[test]
    fn every_point_has_its_values() {
        let limits = Limits::default();
        let source = Source { file: "test", bytes: &[], limits: &limits, beside: None };
        let refused = |patch: Patch| {
            let error = Soup::default().push(&source, patch).unwrap_err();
            assert_eq!(error.code(), "MALFORMED_FILE");
            error.to_string()
        };
        let patch = || Patch { positions: vec![DVec3::ZERO; 2], ..Patch::default() };
        let normals = Attribute { semantic: Semantic::Normal, values: vec![0.0; 3] };
        let text = refused(Patch { attributes: vec![normals], ..patch() });
        assert!(text.contains("normal: 3 values for 2 vertices, which need 6"), "{text}");
        let marks = PointMarks { locks: Vec::new(), weights: vec![1.0; 3] };
        let text = refused(Patch { marks, ..patch() });
        assert!(text.contains("weights: 3 values for 2 vertices, which need 2"), "{text}");
    }
}
