//! What a person should look at before they believe a comparison: two meshes that can hardly be the same model.

use glam::DVec3;

use crate::mesh::Mesh;

/// Of models that are the same, one is at most so many times as large as the other.
const SAME_SIZE: f64 = 1.25;
/// Their centres are so close, as a share of the original's diagonal.
const SAME_PLACE: f64 = 0.25;

/// Reasons to doubt that `simplified` shows the same as `original`, each as a code and a sentence that says what to do.
pub fn mismatches(original: &Mesh, simplified: &Mesh) -> Vec<(&'static str, String)> {
    let mut found = Vec::new();
    let [fine, crude] = [original, simplified].map(|mesh| mesh.faces.len());
    if crude > fine {
        let text = format!(
            "the simplified mesh has {crude} triangles and the original {fine}: if they are swapped, name them the \
             other way round"
        );
        found.push(("ARE_THEY_SWAPPED", text));
    }
    let [(low, high), (lower, upper)] = [original, simplified].map(bounds);
    let (size, diagonal) = ((upper - lower).length(), (high - low).length());
    let (ratio, offset) = (size / diagonal, lower.midpoint(upper).distance(low.midpoint(high)));
    if !(1.0 / SAME_SIZE..=SAME_SIZE).contains(&ratio) {
        let text = format!(
            "the simplified mesh is {ratio:.4} times as large as the original: bring both to the same units"
        );
        found.push(("SIZES_DIFFER", text));
    } else if offset > SAME_PLACE * diagonal {
        let text = format!(
            "the simplified mesh lies {:.0} % of the original's diagonal away from it: bring both to the same place, \
             and let the same axis be up",
            100.0 * offset / diagonal
        );
        found.push(("PLACES_DIFFER", text));
    }
    found
}

/// The box that holds all triangles.
fn bounds(mesh: &Mesh) -> (DVec3, DVec3) {
    let points = mesh.faces.as_flattened().iter().map(|v| mesh.positions[*v as usize]);
    points
        .map(|p| (p, p))
        .reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
        .unwrap_or((DVec3::ZERO, DVec3::ZERO))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::compare::sample_mesh;

    fn check(change: impl Fn(DVec3) -> DVec3, n_triangles: usize, wanted: &[&str]) {
        let original = sample_mesh(1, 2000);
        let mut simplified = sample_mesh(1, n_triangles);
        simplified.positions.iter_mut().for_each(|p| *p = change(*p));
        let found = mismatches(&original, &simplified);
        assert!(found.iter().map(|f| f.0).eq(wanted.iter().copied()), "{found:?}");
    }

    #[test]
    fn other_units_other_places_and_swapped_meshes_are_noticed() {
        check(|p| p, 2000, &[]);
        check(|p| 1.1 * p + DVec3::splat(0.05), 500, &[]);
        check(|p| 100.0 * p, 500, &["SIZES_DIFFER"]);
        check(|p| 0.01 * p + DVec3::X, 500, &["SIZES_DIFFER"]);
        check(|p| p + 5.0 * DVec3::X, 500, &["PLACES_DIFFER"]);
        check(|p| p, 8000, &["ARE_THEY_SWAPPED"]);
        check(|p| p * f64::NAN, 8000, &["ARE_THEY_SWAPPED", "SIZES_DIFFER"]);
    }
}
