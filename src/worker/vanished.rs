//! Parts of the original of which a level has nothing left.

use serde::Serialize;

use crate::mesh::Mesh;

/// So many names are told, of the first parts.
const MAX_NAMES: usize = 32;

/// Parts that have triangles in the original and none in a level.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(super) struct Vanished {
    /// How many.
    pub count: usize,
    /// Names of the first 32.
    pub names: Vec<String>,
}

impl Vanished {
    /// `None` for a level whose parts are not those of the original: it came with the job.
    pub fn of(original: &Mesh, level: &Mesh) -> Option<Self> {
        if original.tree != level.tree {
            return None;
        }
        let sizes = original.part_sizes().into_iter().zip(level.part_sizes());
        let gone = (0..).zip(sizes).filter(|(_, (before, after))| *before > 0 && *after == 0);
        let parts: Vec<u32> = gone.map(|(part, _)| part).collect();
        let named = parts.iter().take(MAX_NAMES);
        let names = named.map(|part| original.tree.part_name(*part)).collect();
        Some(Self { count: parts.len(), names })
    }

    /// What to tell of a level; `None` where all parts are left.
    pub fn note(&self, level: &str) -> Option<String> {
        let Self { count, names } = self;
        let more = match count - names.len() {
            0 => String::new(),
            n => format!(" and {n} more"),
        };
        let names = names.join("', '");
        let text = || format!("{level}: parts gone: {count} ('{names}'{more})");
        (*count > 0).then(text)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::{FaceId, Part, Tree};
    use glam::DVec3;

    /// A triangle for each part, but for part 0.
    #[track_caller]
    fn check(n_parts: u32, left: &[u32], count: usize, note: Option<&str>) {
        let corners = vec![DVec3::ZERO, DVec3::X, DVec3::Y];
        let mut original = Mesh::from_parts(corners, vec![[0, 1, 2]; n_parts as usize - 1]);
        original.face_parts = (1..n_parts).collect();
        let part = |i| Part { node: 0, mesh: format!("m{i}"), ..Part::default() };
        original.tree = Tree { parts: (0..n_parts).map(part).collect(), ..Tree::default() }.into();
        let level = original.subset(left.iter().map(|f| FaceId(*f)).collect()).mesh;
        let found = Vanished::of(&original, &level).unwrap();
        assert_eq!((found.count, found.note("lod-0").as_deref()), (count, note));
        assert!(found.names.len() <= MAX_NAMES);
    }

    #[test]
    fn parts_without_triangles_are_named() {
        check(4, &[0, 1, 2], 0, None);
        check(4, &[1], 2, Some("lod-0: parts gone: 2 ('m1', 'm3')"));
        let many: Vec<String> = (1..33).map(|i| format!("'m{i}'")).collect();
        let note = format!("lod-0: parts gone: 39 ({} and 7 more)", many.join(", "));
        check(41, &[39], 39, Some(&note));
    }

    #[test]
    fn other_parts_are_not_compared() {
        let original = crate::mesh::shapes::octahedron();
        let tree = Tree { parts: vec![Part::default()], ..Tree::default() }.into();
        assert_eq!(Vanished::of(&original, &Mesh { tree, ..original.clone() }), None);
    }
}
